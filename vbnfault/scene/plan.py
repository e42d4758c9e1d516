"""Draw the plan: a plain table, made before any rendering, of what each sample sees and which faults it carries.

The sampling is stratified after Gallon et al.: samples with a fault that needs the Sun (straylight) face it, the
others look away from it (`sun_facing_nominal_fraction` adds Sun-facing samples without such a fault). The rows of
the fault matrix are distributed over the shards, so that every site and every split holds every class where the
counts allow. Every number is keyed by its sample, so a longer block keeps the numbers of a shorter one. The
exceptions are the fault matrix, which is balanced over the whole block, and the strata and bounds that follow from
it.

A sample's view (position, Sun, attitude) is a function of (sample, try). `scene.redraw` draws it and says what the
next try is; so do `scene.exchange` with `plan.unusable_views = "exchange"`, and `scene.aims` where the camera aims.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, shown
from . import aims, exchange, keyed_random, redraw
from .config import Scene
from .events import first_classes
from .fault_matrix import draw_block
from .names import SPLITS, SUN_AVERTED, SUN_FACING


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
    - `state` int64[n] is the sample whose key the draws of the instrument's state have: the first frame of each
      sample's sequence, or itself. Dust, defects and wear are states; what happens during an exposure is not.
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
    state: NDArray[np.int64]
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
        if attempt == 0:
            first = {name: float(values[index]) for name, values in self.variables.items()}
            return first if self.aim is None else aims.of_aim(first, self.aim_of(index))
        rule = aims.view if self.aim is not None else exchange.view if self.group is not None else redraw.view
        return rule(self, scene, index, attempt)

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
    sequence, state = _sequences(scene, samples)
    site = _shard_sites(scene, int(shard[-1]) + 1)[shard] if sequence is None else sequence
    split = site_split(scene)[site]
    firsts = np.flatnonzero(state == samples)  # the frames of a sequence carry the same faults
    parts = []
    for b, (start, end) in enumerate(itertools.pairwise(starts.tolist())):
        rows = firsts[(firsts >= start) & (firsts < end)]
        if len(rows):
            classes = tuple(faults), frozenset(need_sun)
            parts.append(draw_block(scene, classes, (b, start), shard[rows], split[rows]))
    unit = np.searchsorted(firsts, state)
    injected = _with_common_causes(scene, faults, np.concatenate([p[0] for p in parts]))[unit]
    stratum = np.concatenate([p[1] for p in parts])[unit]
    block = np.repeat(np.arange(len(sizes)), sizes)
    together = shard if scene.plan.order == "shuffled" else block * scene.dataset.sites + site
    light, paired = _pairs(scene, samples, stratum, together)
    draw, light = samples - samples % variants, light - light % variants
    group = None
    if scene.exchanges_views:
        group = np.unique(np.column_stack([block, shard, stratum]), axis=0, return_inverse=True)[1].ravel()
        draw = exchange.by_azimuth(scene.dataset.seed, draw, block, stratum, site)
        light = draw[light]
    aim = np.concatenate([p[2] for p in parts])[unit] if scene.is_aimed else None
    if aim is not None:
        variables = aims.draw(scene, draw, aim, 0)
    else:
        exchanged = partial(exchange.sun_out_of_view, scene, draw, stratum, block)
        rule = exchanged if scene.exchanges_views else None
        variables = redraw.draw(scene, draw, stratum, light, paired, exchange=rule)
    return Plan(
        faults=tuple(faults),
        variables=variables,
        injected=injected,
        stratum=stratum,
        site=site,
        split=split,
        architecture=_pick(seed, state, "architecture", len(scene.camera.architectures)),
        readout_direction=_pick(seed, state, "readout_direction", len(scene.camera.readout_directions)),
        individual=individuals(scene, state, split),
        light=light,
        paired=paired,
        draw=draw,
        block=block,
        state=state,
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


def _sequences(scene: Scene, samples: NDArray[np.int64]) -> tuple[NDArray[np.int32] | None, NDArray[np.int64]]:
    """Return the sequence of each sample, int32[n], and the sample of its first frame, int64[n].

    Without sequences, there are no such numbers, and each sample is its own first frame. Raises InputError where
    the sequences have fewer frames than there are samples, and where samples share a view.
    """
    frames = scene.frames
    if not frames:
        return None, samples
    if scene.dataset.variants_per_view > 1:
        raise InputError(
            f"dataset.variants_per_view = {scene.dataset.variants_per_view}: the samples are frames of sequences, "
            "each at its own time; must be 1"
        )
    starts = np.cumsum([0, *frames])
    if starts[-1] < len(samples):
        raise InputError(
            f"frames: the sequences have {starts[-1]} frames; must have at least {len(samples)}, one "
            "for each sample"
        )
    sequence = np.searchsorted(starts, samples, side="right") - 1
    return sequence.astype(np.int32), starts[sequence]


def check_time(scene: Scene) -> None:
    """Raise InputError if a scene has events or late metering without a sequence, or motion without poses."""
    if scene.motion is not None and scene.trajectory is None:
        raise InputError("motion: needs velocities and rates, which poses of [trajectory] have; leave it out")
    if scene.event and not scene.frames:
        raise InputError(
            f"event: {shown(scene.event[0].cause)} happens at a time of a sequence, and the scene has none; "
            "trajectory.file must name a table of poses with sequences"
        )
    if (delay := scene.camera.metering_delay_frames) and not scene.frames:
        raise InputError(
            f"camera.metering_delay_frames = {delay}: counts frames of a sequence, and there is none; must be 0"
        )


def _with_common_causes(scene: Scene, faults: Sequence[str], injected: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the fault matrix, bool[sequence, fault], where the first class of each event brings its others.

    A class of no plan's own choice is there only if an event brings it, which others may bring in turn.
    """
    order, firsts = list(faults), first_classes(scene.event)
    free = [k for k, name in enumerate(order) if name in firsts and name not in firsts[name]]
    out = injected.copy()
    out[:, free] = False
    for _ in order:
        for name, causes in firsts.items():
            out[:, order.index(name)] |= out[:, [order.index(cause) for cause in causes]].any(axis=1)
    return out


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
    for name in redraw.SUN:
        low, high = redraw.bounds(scene, name)
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


# --- sites and splits ---------------------------------------------------------------------------------------


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


# --- a plan that takes over earlier views ---------------------------------------------------------------------


def make_retaken_plan(
    scene: Scene,
    faults: Sequence[str],
    views: EarlierViews,
    blocks: Sequence[int],
    *,
    need_sun: Collection[str] = (),
) -> Plan:
    """Draw the plan of a scene whose views are those of an earlier plan.

    The fault matrix is that of the scene's own plan. Where that gives a fault that needs the Sun to a view that
    does not face it, the sample's faults are exchanged with those of a sample that faces it and does not need it,
    of the same split if there is one. So a scene with the faults and the seed of the earlier plan gets the earlier
    plan.

    Parameters
    ----------
    scene
        The scene.
    faults
        Its fault classes.
    views
        The earlier views; `views.repeats` samples of the new plan share each.
    blocks
        Numbers of samples of the new plan that were planned together.
    need_sun
        The classes whose samples must face the Sun.

    Raises
    ------
    InputError
        More samples must face the Sun than views do.
    """
    own = make_plan(scene, faults, blocks, need_sun=need_sun)
    earlier, repeats = views.plan, views.repeats
    stratum, split = np.repeat(earlier.stratum, repeats), np.repeat(earlier.split, repeats)
    injected = own.injected
    if not scene.is_flown:  # a trajectory faces the Sun or not, whatever the faults are
        names = [name for name in faults if name in need_sun]
        wanted = [name in need_sun for name in faults]
        injected = injected.copy()
        for first, last in itertools.pairwise(np.cumsum([0, *blocks]).tolist()):
            rows = slice(first, last)
            needs, facing = (
                np.asarray(injected[rows][:, wanted].any(axis=1)),
                np.asarray(stratum[rows] == SUN_FACING),
            )
            _check_enough(scene, names, int(needs.sum()), int(facing.sum()), last - first)
            injected[rows] = injected[rows][_exchanged(needs, facing, split[rows])]
    return replace(
        own,
        variables={name: np.repeat(values, repeats) for name, values in earlier.variables.items()},
        injected=injected,
        stratum=stratum,
        site=np.repeat(earlier.site, repeats),
        split=split,
        individual=individuals(scene, own.state, split),
        light=np.repeat(earlier.light, repeats) * repeats,
        paired=np.repeat(earlier.paired, repeats),
        aim=None if earlier.aim is None else np.repeat(earlier.aim, repeats),
        views=views,
        group=None,
    )


def _check_enough(scene: Scene, names: Sequence[str], needs: int, facing: int, samples: int) -> None:
    """Raise InputError if more samples of a block need the Sun than views face it; `names`: of the faults."""
    if needs > facing:
        raise InputError(
            f"plan.faulty_fraction = {scene.plan.faulty_fraction:g}: {' or '.join(names)} would be in {needs} of "
            f"{samples} samples, but only {facing} of the stored views face the Sun; lower it, "
            "or build the store with a larger plan.sun_facing_nominal_fraction"
        )


def _exchanged(needs: NDArray[np.bool_], facing: NDArray[np.bool_], split: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return which row of the fault matrix each sample gets, int64[n], so that rows that need the Sun face it."""
    order = np.arange(len(needs))
    wrong, free = needs & ~facing, facing & ~needs
    for samples in (*(split == s for s in np.unique(split)), np.ones(len(needs), dtype=bool)):
        pairs = zip(np.flatnonzero(wrong & samples).tolist(), np.flatnonzero(free & samples).tolist(), strict=False)
        for a, b in pairs:
            order[a], order[b] = order[b], order[a]
            wrong[a] = free[b] = False
    return order
