"""Read from a store what its report shows: scalars of all finished samples, pixels of some of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...core.errors import VbnfaultError
from ...core.quantities import Sample
from ...dataset.statistics import drawn_values, key_of, pair_of
from ...faults import registry
from ...store import SPLITS, STRATA, Store, drawn_table
from ..contact_sheet import spread

F64 = NDArray[np.float64]

_MOST_DRAWN = 20_000  # samples whose drawn parameters are read
_SATURATED_DN = 255
_READ = (
    "injected",
    "split",
    "stratum",
    "exposure_s",
    "position_L_m",
    "sun_direction_T",
    "camera_from_T",
    "T_from_L",
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "roll_deg",
    "pitch_deg",
    "yaw_deg",
    "sun_distance_au",
    "sun_visible_fraction",
)
_OF_SEQUENCES = ("sequence", "time_s")


@dataclass(frozen=True, kw_only=True, eq=False)
class Scalars:
    """Hold the scalars of the finished samples of a store that can be read.

    Attributes
    ----------
    samples
        Their indices, int64[n], ascending.
    split_names, split
        Names of the splits that have samples, and of each sample the index of its split, int64[n].
    columns
        Values by name of the scalar, the first axis is that of `samples`.
    unreadable
        Number of finished samples that could not be read.
    """

    samples: NDArray[np.int64]
    split_names: tuple[str, ...]
    split: NDArray[np.int64]
    columns: Mapping[str, NDArray[Any]]
    unreadable: int

    @property
    def injected(self) -> NDArray[np.bool_]:
        """Return the faults that are in the pixels, bool[n, fault]."""
        return self.columns["injected"].astype(bool).reshape(len(self.samples), -1)

    @property
    def strata(self) -> NDArray[np.int64]:
        """Return the index of each sample's stratum, int64[n]."""
        return self.columns["stratum"].astype(np.int64)

    def stratum(self, position: int) -> str:
        """Return the name of a sample's stratum."""
        k = int(self.strata[position])
        return STRATA[k] if k < len(STRATA) else f"stratum {k}"

    @cached_property
    def sun_L(self) -> F64:
        """Return the unit vectors towards the Sun in the local level frame L (x north, y east, z down), [n, 3]."""
        return np.einsum("nji,nj->ni", self.columns["T_from_L"], self.columns["sun_direction_T"])

    @cached_property
    def sun_C(self) -> F64:
        """Return the unit vectors towards the Sun in the camera frame C (x right, y down, z boresight), [n, 3]."""
        quaternion = self.columns["camera_from_T"]
        is_any = np.linalg.norm(quaternion, axis=1) > 0  # a damaged one may be none
        directions = np.full((len(quaternion), 3), np.nan)
        camera_from_T = Rotation.from_quat(quaternion[is_any], scalar_first=True)
        directions[is_any] = camera_from_T.apply(self.columns["sun_direction_T"][is_any])
        return directions

    def by_split(self, values: F64, of: NDArray[np.int64] | None = None) -> list[tuple[str, F64]]:
        """Return the finite values of each split with its name.

        `of`: the positions in `samples` that the values belong to; by default all.
        """
        split = self.split if of is None else self.split[of]
        chosen = [(name, values[split == k]) for k, name in enumerate(self.split_names)]
        return [(name, part[np.isfinite(part)]) for name, part in chosen]


def read_scalars(store: Store) -> Scalars:
    """Return the scalars of the finished samples; samples whose files are damaged are counted and left out."""
    samples: list[int] = []
    names = (*_READ, *_OF_SEQUENCES) if store.spec.sequence_names else _READ
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    unreadable = 0
    for number in store.begun():
        finished = [i for i, done in store.done(number).items() if done]
        chosen = [i - store.shard(number).start for i in finished]
        try:
            columns = {name: store.column(name, number)[chosen] for name in names} if finished else {}
        except (OSError, ValueError):
            unreadable += len(finished)
            continue
        samples += finished
        for name, column in columns.items():
            parts[name].append(column)
    columns = {name: np.concatenate(part) if part else np.zeros(0) for name, part in parts.items()}
    words = [str(word) for word in columns["split"]]
    split_names = tuple(sorted(set(words), key=lambda w: (SPLITS.index(w) if w in SPLITS else len(SPLITS), w)))
    return Scalars(
        samples=np.array(samples, dtype=np.int64),
        split_names=split_names,
        split=np.array([split_names.index(word) for word in words], dtype=np.int64),
        columns=columns,
        unreadable=unreadable,
    )


# --- drawn parameters ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """Hold the drawn numbers of one parameter of a fault, with the index of the split of each."""

    fault: str
    name: str
    values: F64
    split: NDArray[np.int64]


def read_drawn(store: Store, scalars: Scalars) -> tuple[list[Drawn], int]:
    """Return the drawn parameters of the faults but seeds, and from how many samples they were read."""
    found: dict[tuple[str, str], list[tuple[F64, int]]] = {}  # by fault and name: numbers of a sample, its split
    chosen = spread(len(scalars.samples), _MOST_DRAWN)
    shard, first = np.divmod(scalars.samples[chosen], store.spec.shard_samples)
    for number in np.unique(shard).tolist():
        try:
            texts = store.column("parameters", number)
        except (OSError, ValueError):
            continue
        for position, index in zip(chosen[shard == number], first[shard == number], strict=True):
            for fault, parameters in parsed(texts[index]).items():
                for name, value in drawn_values(parameters):
                    if type(value) in (int, float, list):
                        numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
                        found.setdefault((fault, name), []).append((numbers, int(scalars.split[position])))
    order = {fault: k for k, fault in enumerate(store.spec.faults)}
    drawn = []
    for fault, name in sorted(found, key=lambda key: (order.get(key[0], len(order)), key[1])):
        values, splits = zip(*found[fault, name], strict=True)
        split = np.repeat(splits, [len(numbers) for numbers in values])
        drawn.append(Drawn(fault=fault, name=name, values=np.concatenate(values), split=split))
    return drawn, len(chosen)


def parsed(text: Any) -> dict[str, Any]:
    """Return the parameters of a sample by fault; empty if the text is no table in JSON."""
    try:
        return drawn_table(text)
    except ValueError:
        return {}


def key_bounds(bounds: Mapping[str, Mapping[str, tuple[float, float]]], drawn: Drawn) -> tuple[float, float] | None:
    """Return the bounds that the scene gives for a parameter; None if it has none under the parameter's name."""
    keys = bounds.get(drawn.fault, {})
    return keys.get(key_of(drawn.name, keys))


def key_unit(models: Mapping[str, str], drawn: Drawn) -> str:
    """Return the unit of the key that a parameter belongs to; "" if it has none or the model is not loaded.

    `models` holds the model of each fault class of a store.
    """
    model = registry().get(drawn.fault, {}).get(models.get(drawn.fault, ""))
    if model is None:
        return ""
    units = {field.name: str(field.metadata.get("unit", "")) for field in dataclasses.fields(model)}
    return units.get(key_of(drawn.name, units), "")


def geometry_bounds(store: Store, name: str) -> list[tuple[str, tuple[float, float]]]:
    """Return the bounds of a variable of the geometry: of all samples (""), or one pair for each stratum."""
    geometry = store.attributes.get("scene", {}).get("geometry", {})
    if not isinstance(geometry, Mapping):
        return []
    if (pair := pair_of(geometry.get(name))) is not None:
        return [("", pair)]
    tables = [(stratum, geometry.get(stratum.replace("-", "_"))) for stratum in STRATA]
    found = [(stratum, pair_of(t.get(name)) if isinstance(t, Mapping) else None) for stratum, t in tables]
    return [(stratum, pair) for stratum, pair in found if pair is not None]


# --- pixels -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelResults:
    """Hold what was computed from the pixels of some samples.

    Attributes
    ----------
    positions
        Positions of these samples in `Scalars.samples`, int64[m].
    saturated, mean_dn
        By layer (`image`, `clean`): the fraction of the pixels in which a colour is at full scale, and the mean
        intensity in DN; float64[m].
    areas
        By layer (`mask`, `mask_effect`): the fraction of the frame that each mask covers, float64[m, fault].
    unreadable
        Number of further samples whose pixels could not be read.
    """

    positions: NDArray[np.int64]
    saturated: Mapping[str, F64]
    mean_dn: Mapping[str, F64]
    areas: Mapping[str, F64]
    unreadable: int


def read_pixels(store: Store, scalars: Scalars, most: int, unread: dict[int, str]) -> PixelResults:
    """Return what the pixels of up to `most` finished samples, evenly spaced, say.

    The reasons why samples cannot be read are added to `unread`, by position.
    """
    images = [name for name in ("image", "clean") if name in store.spec.pixel_layers]
    masks = [name for name in ("mask", "mask_effect") if name in store.spec.pixel_layers and store.spec.faults]
    rows: dict[str, list[Any]] = {name: [] for name in (*images, *masks)}
    positions = []
    chosen = spread(len(scalars.samples), most).tolist()
    for position, sample in readable(store, scalars, chosen, {*images, *masks}, unread):
        layers = sample.layers
        positions.append(position)
        for image in images:
            saturated = (layers[image][..., :3] >= _SATURATED_DN).any(axis=-1)
            rows[image].append((saturated.mean(), layers[image][..., -1].mean()))
        for mask in masks:
            rows[mask].append(layers[mask].mean(axis=(1, 2)))
    of_images = {name: np.array(rows[name], dtype=np.float64).reshape(-1, 2) for name in images}
    return PixelResults(
        positions=np.array(positions, dtype=np.int64),
        saturated={name: values[:, 0] for name, values in of_images.items()},
        mean_dn={name: values[:, 1] for name, values in of_images.items()},
        areas={n: np.array(rows[n], dtype=np.float64).reshape(-1, len(store.spec.faults)) for n in masks},
        unreadable=len(chosen) - len(positions),
    )


def readable(
    store: Store, scalars: Scalars, positions: Sequence[int], layers: Collection[str], unread: dict[int, str]
) -> Iterator[tuple[int, Sample]]:
    """Yield the position and the sample, with some layers, of each sample that can be read.

    The reasons why others cannot be read are added to `unread`, by position.
    """
    for position in positions:
        try:
            sample = store.read_sample(int(scalars.samples[position]), layers)
        except VbnfaultError as error:
            unread[position] = str(error)
            continue
        yield position, sample
