"""Draw views within the bounds of their strata, and draw a view again that cannot be used.

Where a view cannot be used, the whole view is drawn again within the same bounds. The views that are kept therefore
follow the table's distribution, under the condition that they can be used. `scene.exchange` and `scene.aims` are
other rules, with a function `view` of the same form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core import frames
from ..core.errors import InputError
from . import keyed_random
from .config import Scene
from .names import SUN_AVERTED
from .sampling import StratumTable

if TYPE_CHECKING:
    from .plan import Plan

SUN = ("sun_azimuth_deg", "sun_elevation_deg")
ATTITUDE = ("roll_deg", "pitch_deg", "yaw_deg")
POSITION = ("x_m", "y_m", "height_m")
VARIABLES = (*SUN, *ATTITUDE, *POSITION)
_MAX_ATTITUDE_TRIES = 1000


def view(plan: Plan, scene: Scene, index: int, attempt: int) -> dict[str, float]:
    """Return the variables of a sample's view at a try, under the names of VARIABLES; a paired Sun stays."""
    row = slice(index, index + 1)
    drawn = draw(scene, plan.draw[row], plan.stratum[row], plan.light[row], plan.paired[row], attempt=attempt)
    return {name: float(column[0]) for name, column in drawn.items()}


def least_sun_angle_deg(scene: Scene) -> float:
    """Return the least angle between a Sun-averted boresight and the Sun.

    It is √2·FoV/2, as for the paper's square frame, or the frame's half diagonal where that is larger: in a frame
    that is higher than wide.
    """
    camera = scene.camera
    diagonal = np.hypot(1.0, camera.height_px / camera.width_px) * np.tan(np.radians(camera.fov_deg) / 2)
    return float(max(np.sqrt(2) * camera.fov_deg / 2, np.degrees(np.arctan(diagonal))))


def strata(scene: Scene) -> tuple[StratumTable, StratumTable]:
    """Return the bounds of the Sun-facing and of the Sun-averted stratum, with all defaults filled in."""
    facing, averted = scene.geometry.sun_facing, scene.geometry.sun_averted
    assert facing is not None
    assert averted is not None
    return facing, averted


def bounds(scene: Scene, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and the upper bounds of a variable, float64[stratum] each."""
    tables = (scene.geometry, scene.geometry) if name in POSITION else strata(scene)
    lo, hi = zip(*(getattr(t, name) for t in tables), strict=True)
    return np.array(lo), np.array(hi)


def draw(
    scene: Scene,
    samples: NDArray[np.int64],
    stratum: NDArray[np.uint8],
    light: NDArray[np.int64],
    paired: NDArray[np.bool_],
    *,
    attempt: int = 0,
    exchange: Callable[[dict[str, NDArray[np.float64]]], None] | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Return uniform draws of all variables within the bounds of each sample's stratum, float64[n] each.

    `attempt` counts from 0; later attempts are redraws. Paired samples draw the Sun within the bounds of both
    strata, with the key of one of the two. They keep this Sun at every attempt, unless views are exchanged.
    `exchange` may exchange values, in place, before Sun-averted samples that look at the Sun are drawn again.
    """
    sun_attempt = attempt if scene.exchanges_views else 0
    drawn = {}
    for name in VARIABLES:
        low, high = bounds(scene, name)
        lo, hi = low[stratum], high[stratum]
        if name in SUN and scene.plan.pair_strata:
            lo, hi = np.where(paired, low.max(), lo), np.where(paired, high.min(), hi)
            u = keyed_random.keyed_uniform(scene.dataset.seed, light, "plan", f"{name}/{sun_attempt}")
        else:
            u = keyed_random.keyed_uniform(scene.dataset.seed, samples, "plan", f"{name}/{attempt}")
        drawn[name] = lo + u * (hi - lo)
    if exchange is not None:
        exchange(drawn)
    keep_sun_out_of_view(scene, samples, stratum, drawn, attempt)
    return drawn


def keep_sun_out_of_view(
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
