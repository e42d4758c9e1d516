"""Draw the plan of a dataset that is taken again: its views are those of an earlier dataset, its faults its own."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .config import Scene
from .plan import SUN_FACING, EarlierViews, Plan, individuals, make_plan


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
    samples = np.arange(len(stratum), dtype=np.int64)
    return replace(
        own,
        variables={name: np.repeat(values, repeats) for name, values in earlier.variables.items()},
        injected=injected,
        stratum=stratum,
        site=np.repeat(earlier.site, repeats),
        split=split,
        individual=individuals(scene, samples, split),
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
