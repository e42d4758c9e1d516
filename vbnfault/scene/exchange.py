"""Exchange drawn values between samples, so that the values of all samples stay as they were drawn.

A view that cannot be used could be drawn again, but this bends the distribution: a Sun below the horizon is hidden
more often than a high one, so the kept Suns are too high. With `plan.unusable_views = "exchange"`, a sample keeps
its Sun and its attitude instead, and what makes the view unusable is exchanged:

- Sites are chosen for the Suns that are drawn there (`world.ground`). The Sun-facing samples of a site have Suns
  of one sector of azimuth, and all elevations.
- The Sun-facing samples of a shard exchange positions, the Sun-averted ones whole views (`pipeline.resolve`): a
  view without any light goes to a sample whose faults need none.
- A Sun-averted attitude that looks at the Sun exchanges its pitch with another one.

An exchange moves values between samples, so each variable keeps its distribution. What is not independent any more
is what geometry couples: close above the ground, a Sun below the horizon is rarely seen. Only if no exchange helps,
a value is drawn again: first the position, then the whole view.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.frames import boresight_angle_deg
from . import keyed_random, redraw
from .config import Scene
from .names import SUN_AVERTED, SUN_FACING

if TYPE_CHECKING:
    from .plan import Plan

# Largest distance of two samples of a shard, plus 1: a shard has at most 16.
MOST = 16
# Views that a pitch may be exchanged with: one in three is suitable, so 64 are enough but for 1e-12.
_PITCHES = 64
# Positions that are drawn for a sample, whose Sun is kept, before its Sun is drawn again.
KEPT_TRIES = 64


def by_azimuth(
    seed: int,
    draw: NDArray[np.int64],
    block: NDArray[np.int64],
    stratum: NDArray[np.uint8],
    site: NDArray[np.int32],
) -> NDArray[np.int64]:
    """Return which sample's draws each sample has, int64[n]: the Suns of a site come from one sector of azimuth.

    The Sun-facing samples of each block are sorted by their sites, and their draws by azimuth.
    """
    out = draw.copy()
    azimuth = keyed_random.keyed_uniform(seed, draw, "plan", "sun_azimuth_deg/0")
    for b in np.unique(block):
        here = np.flatnonzero((block == b) & (stratum == SUN_FACING))
        out[here[np.lexsort((here, site[here]))]] = draw[here[np.lexsort((here, azimuth[here]))]]
    return out


def pitches(
    samples: NDArray[np.int64],
    part: NDArray[np.int64],
    roll_deg: NDArray[np.float64],
    pitch_deg: NDArray[np.float64],
    least_deg: float,
) -> None:
    """Exchange pitches, in place, between views of one part until the boresight is `least_deg` from the Sun.

    Parameters
    ----------
    samples
        int64[n]: the sample whose key a view has. Samples with one view have equal numbers.
    part
        int64[n]: views of different parts exchange nothing; -1 takes no part.
    roll_deg, pitch_deg
        float64[n].
    least_deg
        Least angle between boresight and Sun. A view for which no exchange helps is left as it is.
    """
    _, views, view_of = np.unique(samples, return_index=True, return_inverse=True)
    pitch = pitch_deg[views]
    for p in np.unique(part[part >= 0]):
        here = np.flatnonzero(part[views] == p)
        roll = roll_deg[views[here]]
        for k in np.flatnonzero(boresight_angle_deg(roll, pitch[here]) < least_deg):
            others = np.roll(here, -k - 1)[:-1][:_PITCHES]
            good = boresight_angle_deg(roll[k], pitch[others]) >= least_deg
            good &= boresight_angle_deg(roll_deg[views[others]], pitch[here[k]]) >= least_deg
            if good.any():
                other = others[np.argmax(good)]
                pitch[here[k]], pitch[other] = pitch[other], pitch[here[k]]
    pitch_deg[:] = pitch[view_of.ravel()]


def sun_out_of_view(
    scene: Scene,
    samples: NDArray[np.int64],
    stratum: NDArray[np.uint8],
    block: NDArray[np.int64],
    drawn: dict[str, NDArray[np.float64]],
) -> None:
    """Exchange pitches, in place, between Sun-averted samples of a block, so that fewer of them look at the Sun."""
    if redraw.strata(scene)[SUN_AVERTED].reference == "sun":
        averted, least = np.where(stratum == SUN_AVERTED, block, -1), redraw.least_sun_angle_deg(scene)
        pitches(samples, averted, drawn["roll_deg"], drawn["pitch_deg"], least)


def view(plan: Plan, scene: Scene, index: int, attempt: int) -> dict[str, float]:
    """Return the variables of a sample's view at a try: exchanged, then drawn again as little as possible."""
    members, facing = plan.members(index), plan.stratum[index] == SUN_FACING
    if attempt < len(members):
        other = members[(members.index(plan.first_of_view(index)) + attempt) % len(members)]
        taken = redraw.POSITION if facing else redraw.VARIABLES
        whose = {name: other if name in taken else index for name in redraw.VARIABLES}
        return {name: float(plan.variables[name][k]) for name, k in whose.items()}
    kept: tuple[str, ...] = ()
    if attempt < len(members) + KEPT_TRIES:
        kept = (*redraw.SUN, *redraw.ATTITUDE) if facing else redraw.SUN if plan.paired[index] else ()
    row = slice(index, index + 1)
    key = plan.draw[row]  # a Sun that cannot be kept is drawn again
    drawn = redraw.draw(scene, key, plan.stratum[row], key, plan.paired[row], attempt=attempt)
    return {name: float(plan.variables[name][index] if name in kept else v[0]) for name, v in drawn.items()}
