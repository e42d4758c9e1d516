"""Draw the plan: a plain table, made before any rendering, of what each sample sees and which faults it carries.

The sampling is stratified after Gallon et al.: samples with a fault that needs the Sun (straylight) face it, the
others look away from it (`sun_facing_nominal_fraction` adds Sun-facing samples without such a fault). The rows of
the fault matrix are distributed over the shards, so that every site and every split holds every class where the
counts allow. Every number is keyed by its sample, so a longer block keeps the numbers of a shorter one. The
exceptions are the fault matrix, which is balanced over the whole block, and the strata and bounds that follow from
it.

A sample's view (position, Sun, attitude) is a function of (sample, try). Where a view cannot be used, the whole
view is drawn again within the same bounds. The views that are kept therefore follow the table's distribution, under
the condition that they can be used. With `plan.unusable_views = "exchange"` they follow the table itself: see
`scene.exchange`.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import frames
from ..core.errors import InputError
from . import aims, exchange, keyed_random
from .config import Scene
from .names import SPLITS, SUN_AVERTED, SUN_FACING
from .sampling import StratumTable

_SUN = ("sun_azimuth_deg", "sun_elevation_deg")
_ATTITUDE = ("roll_deg", "pitch_deg", "yaw_deg")
_POSITION = ("x_m", "y_m", "height_m")
VARIABLES = (*_SUN, *_ATTITUDE, *_POSITION)
_MAX_ATTITUDE_TRIES = 1000
# Limits of the search for rows to exchange between splits: rows compared on each side, and exchanges.
_ROWS_COMPARED = 128
_MAX_EXCHANGES = 200


@dataclass(frozen=True, kw_only=True, eq=False)
class EarlierViews:
    """Hold the views that a dataset takes over from an earlier one, as those of `scene` and its `plan`.

    Sample i of the later plan has the view of sample i // `repeats` of the earlier one.
    """

    scene: Scene
    plan: Plan
    repeats: int = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Hold the plan of n samples.

    - `variables` maps the names of VARIABLES, or of `aims.AIM_VARIABLES` if the camera aims, to float64[n], the
      values of each sample's first view.
    - `injected` bool[n, fault], in the order of `faults`, is the fault matrix.
    - `stratum`, `site` and `split` (index in SPLITS) are integers[n].
    - `architecture` and `readout_direction` integers[n] are indices into the scene's lists of allowed values.
    - `individual` integers[n] is the device of the detector.
    - `light` int64[n] is the sample whose Sun each sample has: itself, or the Sun-facing sample of its pair.
    - `paired` bool[n] marks the samples of pairs (`plan.pair_strata`).
    - `aim` uint8[n] is the aim, an index in `aims.AIMS`; None without `geometry.aim`.
    - `draw` int64[n] is the sample whose key the draws of a sample's view have: by default the first of its view.
    - `block` int64[n] is the block that each sample was planned with.
    - `group` int64[n] numbers the samples that exchange views; None if views are drawn again instead.
    - `views` are those of an earlier dataset, if the plan takes them over.

    `variants` consecutive samples share a view. They have the same variables, stratum, site and aim at every try.
    """

    faults: tuple[str, ...]
    variables: dict[str, NDArray[np.float64]]
    injected: NDArray[np.bool_]
    stratum: NDArray[np.uint8]
    site: NDArray[np.int32]
    split: NDArray[np.uint8]
    architecture: NDArray[np.uint8]
    readout_direction: NDArray[np.uint8]
    individual: NDArray[np.int32]
    light: NDArray[np.int64]
    paired: NDArray[np.bool_]
    draw: NDArray[np.int64]
    block: NDArray[np.int64]
    group: NDArray[np.int64] | None = None
    aim: NDArray[np.uint8] | None = None
    views: EarlierViews | None = None
    variants: int = 1

    def __len__(self) -> int:
        return len(self.stratum)

    def injects(self, fault: str) -> NDArray[np.bool_]:
        """Return which samples are commanded to carry a fault, bool[n]; all False where the scene lacks it."""
        if fault not in self.faults:
            return np.zeros(len(self), dtype=bool)
        column: NDArray[np.bool_] = self.injected[:, self.faults.index(fault)]
        return column

    def commanded(self, index: int) -> tuple[str, ...]:
        """Return the faults that a sample is commanded to carry, in the order of `faults`."""
        return tuple(name for name, has in zip(self.faults, self.injected[index], strict=True) if has)

    def first_of_view(self, index: int) -> int:
        """Return the first of the samples that share a sample's view; the draws of the view have its key."""
        return index - index % self.variants

    def members(self, index: int) -> list[int]:
        """Return the first samples of the views that a sample's view may be exchanged with, itself included."""
        if self.group is None:
            return [self.first_of_view(index)]
        near = range(max(0, index - exchange.MOST), min(len(self), index + exchange.MOST))
        return [k for k in near if k % self.variants == 0 and self.group[k] == self.group[index]]

    def commanded_in_view(self, index: int) -> tuple[str, ...]:
        """Return the faults that the samples of a view are commanded to carry, in the order of `faults`."""
        first = self.first_of_view(index)
        has_any = np.any(self.injected[first : first + self.variants], axis=0)
        return tuple(np.array(self.faults, dtype=object)[has_any])

    def view(self, scene: Scene, index: int, attempt: int) -> dict[str, float]:
        """Return the variables of a sample's view at a try, counted from 0, under the names of VARIABLES.

        If the camera aims, the names are those of `aims.AIM_VARIABLES` that the sample's aim needs. `scene` is the
        scene of the plan, unless `views` has another. The stratum, the site, the device and the aim of the sample
        do not change.
        """
        if self.views is not None:
            return self.views.plan.view(self.views.scene, index // self.views.repeats, attempt)
        row = slice(index, index + 1)
        key = self.draw[row]
        first = {name: float(values[index]) for name, values in self.variables.items()}
        if attempt == 0:
            return first if self.aim is None else aims.of_aim(first, self.aim_of(index))
        if self.aim is not None:
            drawn = aims.draw(scene, key, self.aim[row], attempt)
            return aims.of_aim({name: float(column[0]) for name, column in drawn.items()}, self.aim_of(index))
        members = self.members(index)
        kept: tuple[str, ...] = ()
        if self.group is not None:
            facing = self.stratum[index] == SUN_FACING
            if attempt < len(members):
                other = members[(members.index(self.first_of_view(index)) + attempt) % len(members)]
                taken = _POSITION if facing else VARIABLES
                return {name: float(self.variables[name][other if name in taken else index]) for name in VARIABLES}
            if attempt < len(members) + exchange.KEPT_TRIES:
                kept = (*_SUN, *_ATTITUDE) if facing else _SUN if self.paired[index] else ()
        light = self.light[row] if self.group is None else key  # a Sun that cannot be kept is drawn again
        drawn = _views(scene, key, self.stratum[row], light, self.paired[row], attempt=attempt)
        return {name: first[name] if name in kept else float(column[0]) for name, column in drawn.items()}

    def suns_of_site(self, site: int) -> NDArray[np.int64]:
        """Return the Sun-facing samples for whose Suns a site is chosen: those of the first block that has any."""
        here = np.flatnonzero((self.site == site) & (self.stratum == SUN_FACING))
        return here[self.block[here] == self.block[here[:1]]] if len(here) else here

    def aim_of(self, index: int) -> str:
        """Return the name of a sample's aim; "" without `geometry.aim`."""
        return "" if self.aim is None else aims.AIMS[int(self.aim[index])]


def make_plan(
    scene: Scene, faults: Sequence[str], blocks: Sequence[int] | None = None, *, need_sun: Collection[str] = ()
) -> Plan:
    """Draw the plan of all blocks, each with its own fault matrix; default: one block of `dataset.samples`.

    `need_sun` names the faults whose samples face the Sun. Raises InputError where `sun_facing_nominal_fraction`
    and the samples with these faults exceed all samples, where the bounds of a stratum cannot be met, and where a
    block has no whole number of views.
    """
    sizes = [scene.dataset.samples] if blocks is None else list(blocks)
    variants = scene.dataset.variants_per_view
    for size in sizes:
        if size % variants:
            raise InputError(
                f"dataset.variants_per_view = {variants}: {size} samples are planned; their number must be a "
                f"multiple of {variants}, such as {max(size - size % variants, variants)}"
            )
    seed = scene.dataset.seed
    starts = np.cumsum([0, *sizes])
    samples = np.arange(int(starts[-1]), dtype=np.int64)
    shard = samples // scene.dataset.shard_samples
    site = _shard_sites(scene, int(shard[-1]) + 1)[shard]
    split = site_split(scene)[site]
    parts = []
    for b, (start, end) in enumerate(itertools.pairwise(starts.tolist())):
        rows = slice(start, end)
        parts.append(_block(scene, (tuple(faults), frozenset(need_sun)), (b, start), shard[rows], split[rows]))
    injected = np.concatenate([p[0] for p in parts])
    stratum = np.concatenate([p[1] for p in parts])
    block = np.repeat(np.arange(len(sizes)), sizes)
    together = shard if scene.plan.order == "shuffled" else block * scene.dataset.sites + site
    light, paired = _pairs(scene, samples, stratum, together)
    draw, light = samples - samples % variants, light - light % variants
    group = None
    if scene.exchanges_views:
        group = np.unique(np.column_stack([block, shard, stratum]), axis=0, return_inverse=True)[1].ravel()
        draw = exchange.by_azimuth(scene.dataset.seed, draw, block, stratum, site)
        light = draw[light]
    aim = np.concatenate([p[2] for p in parts]) if scene.is_aimed else None
    if aim is None:
        variables = _views(scene, draw, stratum, light, paired, block=block)
    else:
        variables = aims.draw(scene, draw, aim, 0)
    return Plan(
        faults=tuple(faults),
        variables=variables,
        injected=injected,
        stratum=stratum,
        site=site,
        split=split,
        architecture=_pick(seed, samples, "architecture", len(scene.camera.architectures)),
        readout_direction=_pick(seed, samples, "readout_direction", len(scene.camera.readout_directions)),
        individual=individuals(scene, samples, split),
        light=light,
        paired=paired,
        draw=draw,
        block=block,
        group=group,
        aim=aim,
        variants=variants,
    )


def shortcomings(scene: Scene, table: Plan) -> list[str]:
    """Return a sentence for every split without samples, and for every split in which a class is missing."""
    out = []
    fractions = scene.dataset.split.model_dump()
    for code, name in enumerate(SPLITS):
        here = table.split == code
        if not here.any():
            if fractions[name] > 0:
                used = len(np.unique(table.site))
                out.append(
                    f"split {name} has no samples: a site belongs to one split, and {used} "
                    f"{'site is' if used == 1 else 'sites are'} in use (dataset.sites = {scene.dataset.sites}, and "
                    f"dataset.shard_samples = {scene.dataset.shard_samples} samples at each); make more samples "
                    "or lower dataset.shard_samples"
                )
            continue
        lacking = table.injected.any(axis=0) & ~table.injected[here].any(axis=0)
        classes = [fault for fault, lacks in zip(table.faults, lacking, strict=True) if lacks]
        if classes:
            out.append(f"split {name} has no sample with {', '.join(classes)}")
    return out


def least_sun_angle_deg(scene: Scene) -> float:
    """Return the least angle between a Sun-averted boresight and the Sun.

    It is √2·FoV/2, as for the paper's square frame, or the frame's half diagonal where that is larger: in a frame
    that is higher than wide.
    """
    camera = scene.camera
    diagonal = np.hypot(1.0, camera.height_px / camera.width_px) * np.tan(np.radians(camera.fov_deg) / 2)
    return float(max(np.sqrt(2) * camera.fov_deg / 2, np.degrees(np.arctan(diagonal))))


def sun_elongation_deg(scene: Scene) -> tuple[float, float]:
    """Return the allowed angles between boresight and Sun where the camera aims, but not at the Sun."""
    given = scene.geometry.sun_elongation_deg
    return (least_sun_angle_deg(scene), 180.0) if given is None else (given[0], given[1])


def strata(scene: Scene) -> tuple[StratumTable, StratumTable]:
    """Return the bounds of the Sun-facing and of the Sun-averted stratum, with all defaults filled in."""
    facing, averted = scene.geometry.sun_facing, scene.geometry.sun_averted
    assert facing is not None
    assert averted is not None
    return facing, averted


# --- views --------------------------------------------------------------------------------------------------


def bounds(scene: Scene, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and the upper bounds of a variable, float64[stratum] each."""
    tables = (scene.geometry, scene.geometry) if name in _POSITION else strata(scene)
    lo, hi = zip(*(getattr(t, name) for t in tables), strict=True)
    return np.array(lo), np.array(hi)


def _views(
    scene: Scene,
    samples: NDArray[np.int64],
    stratum: NDArray[np.uint8],
    light: NDArray[np.int64],
    paired: NDArray[np.bool_],
    *,
    attempt: int = 0,
    block: NDArray[np.int64] | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Return uniform draws of all variables within the bounds of each sample's stratum, float64[n] each.

    `attempt` counts from 0; later attempts are redraws. Paired samples draw the Sun within the bounds of both
    strata, with the key of one of the two. They keep this Sun at every attempt, unless views are exchanged. If so,
    and `block` is given, Sun-averted samples of a block exchange pitches until the Sun is out of view.
    """
    sun_attempt = attempt if scene.exchanges_views else 0
    drawn = {}
    for name in VARIABLES:
        low, high = bounds(scene, name)
        lo, hi = low[stratum], high[stratum]
        if name in _SUN and scene.plan.pair_strata:
            lo, hi = np.where(paired, low.max(), lo), np.where(paired, high.min(), hi)
            u = keyed_random.keyed_uniform(scene.dataset.seed, light, "plan", f"{name}/{sun_attempt}")
        else:
            u = keyed_random.keyed_uniform(scene.dataset.seed, samples, "plan", f"{name}/{attempt}")
        drawn[name] = lo + u * (hi - lo)
    if scene.exchanges_views and block is not None and strata(scene)[SUN_AVERTED].reference == "sun":
        averted = np.where(stratum == SUN_AVERTED, block, -1)
        pitch = drawn["pitch_deg"]
        exchange.pitches(samples, averted, drawn["roll_deg"], pitch, least_sun_angle_deg(scene))
    _keep_sun_out_of_view(scene, samples, stratum, drawn, attempt)
    return drawn


def _keep_sun_out_of_view(
    scene: Scene,
    samples: NDArray[np.int64],
    stratum: NDArray[np.uint8],
    variables: dict[str, NDArray[np.float64]],
    attempt: int,
) -> None:
    """Draw roll and pitch of Sun-averted samples again, in place, until the Sun is out of view.

    The paper's bounds leave 8 % of the Sun-averted draws looking at the Sun, where roll and pitch are both near
    half a turn. Where the angles count from the Sun, only roll and pitch decide this. Where they count from the
    nadir or the centre, the function does nothing. Raises InputError where the bounds keep the Sun in view.
    """
    if strata(scene)[SUN_AVERTED].reference != "sun":
        return
    names = ("roll_deg", "pitch_deg")
    least = least_sun_angle_deg(scene)
    lo, hi = (np.array(b)[:, SUN_AVERTED] for b in zip(*(bounds(scene, name) for name in names), strict=True))
    again = np.flatnonzero(stratum == SUN_AVERTED)
    for k in range(1, _MAX_ATTITUDE_TRIES):
        angle = frames.boresight_angle_deg(*(variables[name][again] for name in names))
        again = again[angle < least]
        if not len(again):
            return
        for j, name in enumerate(names):
            u = keyed_random.keyed_uniform(scene.dataset.seed, samples[again], "plan", f"{name}/{attempt}.{k}")
            variables[name][again] = lo[j] + u * (hi[j] - lo[j])
    raise InputError(
        f"geometry.sun_averted: its roll_deg and pitch_deg keep the Sun within {least:.1f} deg of the boresight; "
        "widen them"
    )


def _pair(low: NDArray[np.float64], high: NDArray[np.float64], stratum: int) -> list[float]:
    """Return the bounds of one stratum for an error message."""
    return [float(low[stratum]), float(high[stratum])]


def _pairs(
    scene: Scene, samples: NDArray[np.int64], stratum: NDArray[np.uint8], together: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the sample whose Sun each sample has, int64[n], and whether the sample is paired, bool[n].

    The k-th Sun-facing and the k-th Sun-averted sample with the same number `together` are a pair. They share the
    site, so the same Sun in L means the same attitude of the target.
    """
    light, paired = samples.copy(), np.zeros(len(samples), dtype=bool)
    if not scene.plan.pair_strata:
        return light, paired
    for name in _SUN:
        low, high = bounds(scene, name)
        if low.max() > high.min():
            raise InputError(
                f"plan.pair_strata = true: geometry.sun_facing.{name} = {_pair(low, high, SUN_FACING)} and "
                f"geometry.sun_averted.{name} = {_pair(low, high, SUN_AVERTED)} must overlap"
            )
    by_group = np.lexsort((samples, stratum, together))
    group = together[by_group] * 2 + stratum[by_group]
    first = np.searchsorted(group, group, side="left")
    rank = np.arange(len(samples)) - first
    # match the Sun-facing and the Sun-averted samples by (together, rank)
    key = together[by_group] * len(samples) + rank
    facing = stratum[by_group] == SUN_FACING
    _, in_facing, in_averted = np.intersect1d(key[facing], key[~facing], assume_unique=True, return_indices=True)
    leads, follows = by_group[facing][in_facing], by_group[~facing][in_averted]
    light[follows] = samples[leads]
    paired[leads] = paired[follows] = True
    return light, paired


# --- fault matrix -------------------------------------------------------------------------------------------


def _block(
    scene: Scene,
    classes: tuple[tuple[str, ...], frozenset[str]],
    block: tuple[int, int],
    shard: NDArray[np.int64],
    split: NDArray[np.uint8],
) -> tuple[NDArray[np.bool_], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the fault matrix bool[n, fault], the strata uint8[n] and, if the camera aims, the aims uint8[n].

    `classes` are the faults, and those of them that need the Sun. `block` is the number of the block and its first
    sample.
    """
    n = len(shard)
    faults, need_sun = classes
    number, start = block
    rng = keyed_random.rng(scene.dataset.seed, start, "plan", f"fault_matrix/{number}")
    make = fault_matrix_per_class if scene.plan.mode == "per_class" else fault_matrix_per_sample
    lo, hi = scene.plan.classes_per_sample
    spec = MatrixSpec(
        samples=n, faults=faults, fraction=scene.plan.faulty_fraction, sizes=(lo, hi), need_sun=need_sun
    )
    injected = make(spec, rng)
    towards_sun = int(_with_any(injected, faults, need_sun).sum())
    nominal = round(scene.plan.sun_facing_nominal_fraction * n)
    if scene.is_aimed:
        nominal = aims.samples_towards_sun(scene, n, towards_sun) - towards_sun
    if towards_sun + nominal > n:
        names = " or ".join(name for name in faults if name in need_sun)
        raise InputError(
            f"plan.sun_facing_nominal_fraction = {scene.plan.sun_facing_nominal_fraction:g}: with {names} in "
            f"{towards_sun} of {n} samples it must be at most {(n - towards_sun) / n:g}"
        )
    variants = scene.dataset.variants_per_view
    facing = variants * -(-(towards_sun + nominal) // variants)  # the samples of a view share its stratum
    stratum = np.full(n, SUN_AVERTED, dtype=np.uint8)
    stratum[:facing] = SUN_FACING
    views = np.arange(n)[:, None] if variants == 1 else _views_of_rows(injected, stratum, variants, rng)
    traits: NDArray[np.bool_] = np.any(_traits(injected, stratum)[views], axis=1)
    first = facing // variants if scene.plan.order == "sun_first" else 0
    places = [
        start + _dealt(traits[start:end], shard[::variants][start:end], split[::variants][start:end], rng)
        for start, end in ((0, first), (first, len(views)))
        if end > start
    ]
    views = views[np.concatenate(places)]
    order = views.ravel()
    stratum = stratum[order]
    aim = stratum[:0]
    if scene.is_aimed:
        aim = np.repeat(aims.deal(scene, stratum[::variants] == SUN_FACING, rng), variants)
    return injected[order], stratum, aim


def _traits(injected: NDArray[np.bool_], stratum: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return what every split should have of each row, bool[n, trait]: its stratum, its classes, or none."""
    return np.column_stack([stratum == SUN_FACING, injected, ~injected.any(axis=1)])


def _in_order_of_traits(traits: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the rows sorted by their traits, and at random among equal ones, int64[n]."""
    bits = np.uint64(1) << np.arange(traits.shape[1], dtype=np.uint64)[::-1]
    kind = (traits * bits).sum(axis=1, dtype=np.uint64)
    return np.lexsort((rng.random(len(traits)), kind))


def _views_of_rows(
    injected: NDArray[np.bool_], stratum: NDArray[np.uint8], variants: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return the rows of the fault matrix that share a view, int64[view, variant].

    The samples of a view have one stratum, and faults as different as possible.
    """
    line = _in_order_of_traits(_traits(injected, stratum), rng)
    views = [
        line[stratum[line] == which].reshape(variants, -1).T  # neighbours in the line come into different views
        for which in (SUN_FACING, SUN_AVERTED)
    ]
    return np.asarray(rng.permuted(np.concatenate(views), axis=1))


def _with_any(matrix: NDArray[np.bool_], faults: Sequence[str], wanted: Collection[str]) -> NDArray[np.bool_]:
    """Return which rows of a fault matrix bool[n, fault] hold one of the classes `wanted`, bool[n]."""
    return np.asarray(matrix[:, [name in wanted for name in faults]].any(axis=1))


@dataclass(frozen=True, kw_only=True)
class MatrixSpec:
    """Describe a fault matrix: how many samples have which faults.

    Attributes
    ----------
    samples
        Number of samples n.
    faults
        The classes, one for each column of the fault matrix.
    fraction
        Fraction p, in [0, 1], of the samples that have a class (`fault_matrix_per_class`), or that have at least
        one class (`fault_matrix_per_sample`).
    sizes
        Least and greatest number of classes in a faulty sample; only `fault_matrix_per_sample` uses it.
    need_sun
        Classes that need the Sun in view; their samples come first.
    """

    samples: int
    faults: tuple[str, ...]
    fraction: float
    sizes: tuple[int, int] = (1, 6)
    need_sun: Collection[str] = ()


def fault_matrix_per_class(spec: MatrixSpec, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return bool[n, fault] with every class in exactly round(p·n) rows."""
    n, count = spec.samples, round(spec.fraction * spec.samples)
    matrix = np.zeros((n, len(spec.faults)), dtype=bool)
    first = next((name for name in spec.faults if name in spec.need_sun), None)
    for f, name in enumerate(spec.faults):
        rows = np.arange(count) if name == first else rng.permutation(n)[:count]
        matrix[rows, f] = True
    return matrix[np.argsort(~_with_any(matrix, spec.faults, spec.need_sun), kind="stable")]


def fault_matrix_per_sample(spec: MatrixSpec, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return bool[n, fault] with exactly round(p·n) faulty rows, each with a non-empty subset of the classes.

    Subset sizes are uniform in `sizes` (at most the number of classes). All subsets of one size have the same
    probability, until some are changed so that the counts of any two classes differ by at most one.
    """
    n, classes = spec.samples, len(spec.faults)
    matrix = np.zeros((n, classes), dtype=bool)
    faulty = round(spec.fraction * n)
    if classes == 0 or faulty == 0:
        return matrix
    lo, hi = (min(s, classes) for s in spec.sizes)
    size = rng.integers(lo, hi, faulty, endpoint=True)
    # the classes with the `size` smallest random keys are a random subset of that size
    rank = np.argsort(np.argsort(rng.random((faulty, classes), dtype=np.float32), axis=1), axis=1)
    rows = rank < size[:, None]
    _level(rows, rng)
    first = _with_any(rows, spec.faults, spec.need_sun)
    towards_sun = int(first.sum())
    matrix[:towards_sun] = rows[first]
    others = towards_sun + rng.permutation(n - towards_sun)[: faulty - towards_sun]
    matrix[others] = rows[~first]
    return matrix


def _level(rows: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Exchange classes in random rows until the counts of any two classes differ by at most one; in place."""
    classes = rows.shape[1]
    count = rows.sum(axis=0)
    each, extra = divmod(int(count.sum()), classes)
    wanted = np.full(classes, each)
    wanted[rng.permutation(classes)[:extra]] += 1
    while (count != wanted).any():
        most, least = int(np.argmax(count - wanted)), int(np.argmin(count - wanted))
        number = min(count[most] - wanted[most], wanted[least] - count[least])
        # There are enough rows with `most` and without `least`: at least as many as the difference of the two
        # counts, which is at least excess + lack - 1, and so at least `number`.
        chosen = rng.permutation(np.flatnonzero(rows[:, most] & ~rows[:, least]))[:number]
        rows[chosen, most], rows[chosen, least] = False, True
        count[most] -= number
        count[least] += number


# --- sites and splits ---------------------------------------------------------------------------------------


def _dealt(
    traits: NDArray[np.bool_],
    shard: NDArray[np.int64],
    split: NDArray[np.uint8],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Return which row of bool[n, trait] each place of a block takes, int64[n].

    A row is a row of the fault matrix, or those of a view together. The rows are sorted by their traits and
    distributed over the shards, one row per shard and round. Then rows are exchanged between splits where a split
    lacks a trait that the block has often enough.
    """
    n = len(shard)
    line = _in_order_of_traits(traits, rng)
    turn = np.arange(n) - np.searchsorted(shard, shard, side="left")
    order = np.empty(n, dtype=np.int64)
    order[np.lexsort((rng.random(n), turn))] = line
    present = np.unique(split)
    enough = traits.sum(axis=0) >= len(present)
    for _ in range(_MAX_EXCHANGES):
        pair = _exchange(traits[order], split, present, enough)
        if pair is None:
            break
        order[list(pair)] = order[list(pair[::-1])]
    return order


def _exchange(
    traits: NDArray[np.bool_], split: NDArray[np.uint8], present: NDArray[np.uint8], enough: NDArray[np.bool_]
) -> tuple[int, int] | None:
    """Return two samples whose exchange leaves fewer (split, trait) pairs empty, or None without such samples."""
    count = np.stack([traits[split == s].sum(axis=0) for s in present])
    for s, trait in np.argwhere((count == 0) & enough):
        mine = np.flatnonzero(split == present[s])[:_ROWS_COMPARED]
        theirs = np.flatnonzero((split != present[s]) & traits[:, trait])[:_ROWS_COMPARED]
        gain = traits[theirs][None].astype(int) - traits[mine][:, None]  # what split s would gain
        other = np.searchsorted(present, split[theirs])
        after = [count[s] + gain, count[other][None] - gain]
        before = [np.broadcast_to(count[s], gain.shape), np.broadcast_to(count[other][None], gain.shape)]
        change = sum(
            ((a[..., enough] == 0).sum(axis=-1) - (b[..., enough] == 0).sum(axis=-1))
            for a, b in zip(after, before, strict=True)
        )
        a, b = np.unravel_index(np.argmin(change), change.shape)
        if change[a, b] < 0:
            return int(mine[a]), int(theirs[b])
    return None


def _shard_sites(scene: Scene, shards: int) -> NDArray[np.int32]:
    """Return the site of each shard, int32[shards]. All samples of a shard share it, so a task loads one patch.

    Sites come in shuffled rounds, so they are used evenly. In the order of the first round, every split comes as
    early as possible.
    """
    if scene.trajectory is not None:  # a site stands for the rows of a shard, which lie side by side
        return np.arange(shards, dtype=np.int32)
    sites = scene.dataset.sites
    rounds = -(-shards // sites)
    key = keyed_random.keyed_uniform(scene.dataset.seed, np.arange(rounds * sites, dtype=np.int64), "plan", "sites")
    order = np.argsort(key.reshape(rounds, sites), axis=1, kind="stable")
    order[0] = _site_order(scene)
    return order.ravel()[:shards].astype(np.int32)


def _site_order(scene: Scene) -> NDArray[np.int64]:
    """Return the sites in the random order in which splits are assigned to them, int64[sites]."""
    return keyed_random.rng(scene.dataset.seed, 0, "plan", "split").permutation(scene.dataset.sites)


def site_split(scene: Scene) -> NDArray[np.uint8]:
    """Return the split of every site, uint8[sites].

    A site belongs to one split, so that no terrain is in two splits. No split with a fraction above 0 is empty if
    there are as many sites as such splits.
    """
    out = np.empty(scene.dataset.sites, dtype=np.uint8)
    out[_site_order(scene)] = _in_turn(scene, scene.dataset.sites, np.arange(len(SPLITS)))
    return out


def individual_split(scene: Scene) -> NDArray[np.uint8] | None:
    """Return the split of every device of the detector, uint8[individuals], or None.

    No device is in two splits, and each split that has sites has a device. The result is None where there are too
    few devices for this; all splits then share all devices.
    """
    used = np.unique(site_split(scene))
    count = scene.camera.individuals
    if count < len(used):
        return None
    out = np.empty(count, dtype=np.uint8)
    order = keyed_random.rng(scene.dataset.seed, 0, "plan", "individual split").permutation(count)
    out[order] = _in_turn(scene, count, used)
    return out


def _in_turn(scene: Scene, count: int, used: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the splits of `count` ordered items, uint8[count]; every initial part keeps to the scene's fractions.

    The first items go to one split each, the largest split first. After these, the k-th item of a split comes at
    (k + ½) / fraction, as in the Sainte-Laguë method of seat allocation.
    """
    table = scene.dataset.split
    fraction = np.array([table.train, table.val, table.test])
    codes = [code for code in used if fraction[code] > 0]
    fraction = fraction / fraction[codes].sum()
    when, whose = [], []
    for code in codes:
        k = np.arange(int(np.ceil(fraction[code] * count)) + 2)
        turn = (k + 0.5) / fraction[code]
        turn[0] = -fraction[code]
        when.append(turn)
        whose.append(np.full(len(k), code, dtype=np.uint8))
    line = np.concatenate(whose)[np.argsort(np.concatenate(when), kind="stable")]
    return line[:count]


def individuals(scene: Scene, samples: NDArray[np.int64], split: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the device that takes each sample, from the devices of its split, int32[n]."""
    of_split = individual_split(scene)
    u = keyed_random.keyed_uniform(scene.dataset.seed, samples, "plan", "individual")
    if of_split is None:
        return (u * scene.camera.individuals).astype(np.int32)
    out = np.zeros(len(samples), dtype=np.int32)
    for s in np.unique(split):
        devices = np.flatnonzero(of_split == s)
        here = split == s
        out[here] = devices[(u[here] * len(devices)).astype(np.intp)]
    return out


def _pick(seed: int, samples: NDArray[np.int64], name: str, options: int) -> NDArray[np.uint8]:
    """Return a uniform choice of one of `options` for each sample, uint8[n] from 0."""
    return (keyed_random.keyed_uniform(seed, samples, "plan", name) * options).astype(np.uint8)
