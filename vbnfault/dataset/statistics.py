"""Compute the planned and realised statistics of a store: counts, co-occurrence, exposure, ranges of parameters.

Only scalars are read, a shard at a time, so a store of any size fits in memory.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import store as stores
from ..core.errors import VbnfaultError
from ..scene.events import commanded_in_time
from ..store import STRATA, FaultCounts, Store, aligned
from .identity import plan_numbers, stored_plan

# scalars of one number a sample whose ranges are reported
_RANGED = (
    "exposure_s",
    "sun_elevation_deg",
    "sun_azimuth_deg",
    "sun_distance_au",
    "sun_visible_fraction",
    "roll_deg",
    "pitch_deg",
    "yaw_deg",
    "tries",
    "views",
    "samples_per_pixel",
    "noise_fraction_p99",
)
_WRAPPING = frozenset(("sun_azimuth_deg", "roll_deg", "pitch_deg", "yaw_deg"))  # 359° and 1° have no mean of 180°
_READ = ("injected", "split", "stratum", "site", "parameters", *_RANGED)
_SHARDS_AT_ONCE = 16
_MOST_WORDS = 12  # different texts of a parameter that are counted


@dataclass
class Range:
    """Hold how many finite numbers there were, the least, the mean and the greatest of them.

    Angles that wrap have no mean.
    """

    wraps: bool = False
    count: int = 0
    low: float = math.inf
    high: float = -math.inf
    total: float = 0.0

    def add(self, values: NDArray[np.float64]) -> None:
        """Add the finite ones of some numbers."""
        finite = values[np.isfinite(values)]
        if finite.size:
            self.count += finite.size
            self.low, self.high = min(self.low, float(finite.min())), max(self.high, float(finite.max()))
            self.total += float(finite.sum())

    @property
    def mean(self) -> float | None:
        """Return the mean; None without a number, and of angles that wrap."""
        return self.total / self.count if self.count and not self.wraps else None

    def plain(self) -> dict[str, Any]:
        """Return the range as JSON-able data; `min`, `mean` and `max` are None without a number."""
        if not self.count:
            return {"count": 0, "min": None, "mean": None, "max": None}
        return {"count": self.count, "min": self.low, "mean": self.mean, "max": self.high}


@dataclass
class _Parameter:
    """Hold the drawn values of one parameter: the range of its numbers, and how often it has each text.

    `pending` are numbers that `settle` adds to the range, many at once.
    """

    numbers: Range = field(default_factory=Range)
    words: Counter[str] = field(default_factory=Counter)
    pending: list[float] = field(default_factory=list)

    def settle(self) -> None:
        """Add the pending numbers to the range."""
        if self.pending:
            self.numbers.add(np.array(self.pending, dtype=np.float64))
            self.pending.clear()

    def plain(self) -> dict[str, Any]:
        """Return the values as JSON-able data."""
        if self.words:
            return {"values": dict(sorted(self.words.items())[:_MOST_WORDS])}
        return self.numbers.plain()


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """Describe the finished samples of a store, and what was planned for them.

    Attributes
    ----------
    samples, finished
        Numbers of samples of the store and of those that are finished. Everything else is over the finished ones.
    counts
        How often each class is planned, and how often it is in the pixels, by split.
    has_plan
        Whether the plan could be computed from the scene in the store.
    together
        Co-occurrence, int[fault, fault]: the samples in which both classes are; the diagonal counts each class.
    faults_per_sample
        Number of samples by number of injected faults.
    strata, sites
        Number of samples by stratum, and number of different sites by split.
    ranges
        Range of each scalar, over all samples (`all`) and by split.
    parameters
        By class and parameter, the range of the drawn numbers or the count of each text.
    bounds
        By class and parameter, the bounds in the scene from which it was drawn.
    """

    samples: int
    finished: int
    counts: FaultCounts
    has_plan: bool
    together: NDArray[np.int64]
    faults_per_sample: Mapping[int, int]
    strata: Mapping[str, int]
    sites: Mapping[str, int]
    ranges: Mapping[str, Mapping[str, Range]]
    parameters: Mapping[str, Mapping[str, _Parameter]]
    bounds: Mapping[str, Mapping[str, tuple[float, float]]]

    @property
    def splits(self) -> list[str]:
        """Return the splits that have samples, in their usual order."""
        return self.counts.splits

    def plain(self) -> dict[str, Any]:
        """Return the statistics as JSON-able data."""
        faults, counts = self.counts.faults, self.counts
        return {
            "samples": self.samples,
            "finished": self.finished,
            "splits": {name: counts.samples[name] for name in self.splits},
            "sites": dict(self.sites),
            "strata": dict(self.strata),
            "faults": {
                fault: {
                    "planned": counts.planned(fault) if self.has_plan else None,
                    "realised": counts.realised(fault),
                    "by_split": {
                        split: {
                            "planned": counts.planned(fault, split) if self.has_plan else None,
                            "realised": counts.realised(fault, split),
                        }
                        for split in self.splits
                    },
                }
                for fault in faults
            },
            "faults_per_sample": {str(n): count for n, count in sorted(self.faults_per_sample.items())},
            "co_occurrence": {
                fault: dict(zip(faults, row.tolist(), strict=True))
                for fault, row in zip(faults, self.together, strict=True)
            },
            "ranges": {n: {of: r.plain() for of, r in ranges.items()} for n, ranges in self.ranges.items()},
            "parameters": {
                fault: {name: values.plain() for name, values in sorted(parameters.items())}
                for fault, parameters in self.parameters.items()
            },
            "bounds": {f: {key: list(pair) for key, pair in keys.items()} for f, keys in self.bounds.items()},
        }

    def lines(self) -> list[str]:
        """Return the statistics as lines of text: one table for each kind."""
        text = [f"{self.finished} of {self.samples} samples are finished"]
        text += ["", *self.counts.lines()]
        if not self.has_plan:
            text.append("the plan is not known, because the scene in the store cannot be planned here")
        for title, table in self.tables():
            text += ["", title, *aligned(table)]
        return text

    def tables(self) -> Iterator[tuple[str, list[list[str]]]]:
        """Yield title and rows of each table except that of the counts; the first row of each is its head."""
        faults = self.counts.faults
        yield "samples by stratum", [["stratum", "samples"], *([k, str(v)] for k, v in self.strata.items())]
        yield (
            "samples by number of faults",
            [["faults", "samples"], *([str(k), str(v)] for k, v in sorted(self.faults_per_sample.items()))],
        )
        if faults:
            rows = [[f, *map(str, row.tolist())] for f, row in zip(faults, self.together, strict=True)]
            yield "samples in which two classes occur together", [["fault", *faults], *rows]
        head = ["min", "mean", "max"]
        rows = [
            [name, of, *_numbers(one)]
            for name, ranges in self.ranges.items()
            for of, one in ranges.items()
            if one.count and (of == "all" or name == "exposure_s")
        ]
        yield "scalars of the samples", [["scalar", "split", *head], *rows]
        rows = [
            [fault, name, *_described(values), self._bounds(fault, name)]
            for fault, parameters in self.parameters.items()
            for name, values in sorted(parameters.items())
        ]
        if rows:
            yield "drawn parameters of the faults", [["fault", "parameter", "values", *head, "bounds"], *rows]

    def _bounds(self, fault: str, name: str) -> str:
        """Return the bounds that the scene gives for a parameter as text, "" if it gives none of this name."""
        keys = self.bounds.get(fault, {})
        low_high = keys.get(key_of(name, keys))
        return f"{low_high[0]:g} to {low_high[1]:g}" if low_high else ""


def key_of(parameter: str, keys: Collection[str]) -> str:
    """Return the key of the scene file that a drawn parameter belongs to, or "" if none of `keys` is its key.

    A parameter `glare.radius` belongs to the key `glare_radius`, and `flares.radius` to `radius` unless a key
    begins with `flares_`.
    """
    table, _, name = parameter.rpartition(".")
    joined = parameter.replace(".", "_")
    if joined in keys or not table or any(key.startswith(f"{table}_") for key in keys):
        return joined if joined in keys else ""
    return name if name in keys else ""


def _numbers(one: Range) -> list[str]:
    """Return least, mean and greatest as text."""
    return [f"{one.low:.4g}", "" if one.mean is None else f"{one.mean:.4g}", f"{one.high:.4g}"]


def _described(values: _Parameter) -> list[str]:
    """Return number of values, least, mean and greatest of a parameter as text, or the count of each text."""
    if values.words:
        common = ", ".join(f"{word} {count}" for word, count in sorted(values.words.items())[:_MOST_WORDS])
        return [common, "", "", ""]
    return [str(values.numbers.count), *(_numbers(values.numbers) if values.numbers.count else ("", "", ""))]


def statistics(path: str | os.PathLike[str] | Store) -> Statistics:
    """Return the planned and realised statistics of the finished samples of a store.

    Scalars are not compared with their checksums: one checksum covers all scalars of a sample, so that all of their
    arrays would have to be read. `verify` does so.

    Raises
    ------
    InputError
        If there is no store at `path`.
    VbnfaultError
        If scalars of finished samples cannot be read.
    """
    store = stores.open_store(path)
    commanded, faults = _commanded(store), store.spec.faults
    counts = FaultCounts(faults)
    together = np.zeros((len(faults), len(faults)), dtype=np.int64)
    per_sample: Counter[int] = Counter()
    strata: Counter[str] = Counter()
    sites: dict[str, set[int]] = {}
    ranges: dict[str, dict[str, Range]] = {name: {} for name in _RANGED}
    parameters: dict[str, dict[str, _Parameter]] = {fault: {} for fault in faults}
    for samples, columns in finished_scalars(store, _READ):
        injected = columns["injected"].astype(np.int64).reshape(len(samples), len(faults))
        together += injected.T @ injected
        per_sample.update(injected.sum(axis=1).tolist())
        strata.update(STRATA[k] for k in columns["stratum"].tolist())
        split = columns["split"]
        counts.add(split, None if commanded is None else commanded[samples], injected > 0)
        samples_of = {of: split == of for of in dict.fromkeys(split.tolist())}
        for of, chosen in samples_of.items():
            sites.setdefault(of, set()).update(columns["site"][chosen].tolist())
        for sample, text in zip(samples, columns["parameters"].tolist(), strict=True):
            for fault, drawn in store.table(sample, "parameters", text).items():
                _add_parameters(parameters.setdefault(fault, {}), drawn)
        for values in parameters.values():
            for parameter in values.values():
                parameter.settle()
        for name in _RANGED:
            numbers, wraps = columns[name].astype(np.float64), name in _WRAPPING
            ranges[name].setdefault("all", Range(wraps)).add(numbers)
            for of, chosen in samples_of.items():
                ranges[name].setdefault(of, Range(wraps)).add(numbers[chosen])
    if not counts.samples.total() and store.lacks_done():
        raise VbnfaultError(f"{store.path}: {store.why_none_is_finished()}; the build command restores it")
    return Statistics(
        samples=store.samples,
        finished=counts.samples.total(),
        counts=counts,
        has_plan=commanded is not None,
        together=together,
        faults_per_sample=dict(per_sample),
        strata={name: strata[name] for name in STRATA if strata[name]},
        sites={name: len(found) for name, found in sorted(sites.items())},
        ranges=ranges,
        parameters={fault: values for fault, values in parameters.items() if values},
        bounds=_bounds(store),
    )


def _bounds(store: Store) -> dict[str, dict[str, tuple[float, float]]]:
    """Return by class and key the pairs of numbers in the faults of the stored scene."""
    tables = store.spec.attributes.get("scene", {}).get("faults", {})
    return {
        fault: {key: pair for key, value in table.items() if (pair := pair_of(value)) is not None}
        for fault, table in tables.items()
    }


def pair_of(value: Any) -> tuple[float, float] | None:
    """Return a list of two numbers as bounds, None for anything else."""
    if not isinstance(value, list) or len(value) != 2 or not _NUMBERS.issuperset(map(type, value)):
        return None
    return value[0], value[1]


def _commanded(store: Store) -> NDArray[np.bool_] | None:
    """Return the commanded faults bool[sample, fault], or None if the stored scene cannot be planned here.

    Of a sequence with events, those that are there at the time of each frame.
    """
    attributes, faults = store.spec.attributes, store.spec.faults
    try:
        scene, table = stored_plan(attributes, faults)
        numbers = plan_numbers(attributes)
    except (VbnfaultError, KeyError):  # a scene of another program or of a plug-in that is not loaded
        return None
    injected: NDArray[np.bool_] = table.injected[numbers]
    if scene.event and store.spec.sequence_names:
        for samples, columns in finished_scalars(store, ("time_s",)):
            state = table.state[numbers[samples]]
            injected[samples] = commanded_in_time(
                scene, faults, injected[samples], state, columns["time_s"].tolist()
            )
    return injected


def finished_scalars(store: Store, names: Collection[str]) -> Iterator[tuple[list[int], dict[str, NDArray[Any]]]]:
    """Yield the finished samples of some shards at once, and their scalars by name.

    Raises VbnfaultError for scalars that cannot be read.
    """
    begun = store.begun()
    for start in range(0, len(begun), _SHARDS_AT_ONCE):
        samples: list[int] = []
        columns: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
        for number in begun[start : start + _SHARDS_AT_ONCE]:
            finished = [i for i, done in store.done(number).items() if done]
            if not finished:
                continue
            chosen = [i - store.shard(number).start for i in finished]
            try:
                for name in names:
                    columns[name].append(store.column(name, number)[chosen])
            except (OSError, ValueError) as error:
                raise VbnfaultError(
                    f"{store.path}: the scalars of samples {finished[0]}-{finished[-1]} cannot be read ({error}); "
                    "the build command repairs them"
                ) from error
            samples += finished
        if samples:
            yield samples, {name: np.concatenate(parts) for name, parts in columns.items()}


_NUMBERS = frozenset((int, float))


def is_seed(name: str) -> bool:
    """Return whether a drawn parameter is the seed of further random numbers, which has no distribution to show."""
    return name.rpartition(".")[2].rpartition("_")[2] == "seed"


def drawn_values(drawn: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of the drawn parameters of a fault but seeds, each with its dotted name.

    A value is a number, a list of numbers, a text or a truth value. Entries of other lists have the list's name.
    """
    if is_seed(name):
        return
    kind = type(drawn)
    if kind is dict:
        for key, value in drawn.items():
            yield from drawn_values(value, f"{name}.{key}" if name else key)
    elif kind is list and not (drawn and _NUMBERS.issuperset(map(type, drawn))):
        for value in drawn:
            yield from drawn_values(value, name)
    elif drawn is not None:
        yield name, drawn


def _add_parameters(known: dict[str, _Parameter], drawn: Any) -> None:
    """Add the drawn parameters of one fault."""
    for name, value in drawn_values(drawn):
        if name not in known:
            known[name] = _Parameter()
        parameter, kind = known[name], type(value)
        if kind in _NUMBERS:
            parameter.pending.append(value)
        elif kind is list:
            parameter.pending.extend(value)
        else:
            word = str(value).lower() if kind is bool else value
            if word in parameter.words or len(parameter.words) < _MOST_WORDS:
                parameter.words[word] += 1
