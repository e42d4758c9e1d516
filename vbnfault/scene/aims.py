"""Draw what the camera aims at, and the values from which the pose of an aimed view follows.

A scene with `geometry.aim` draws no bounds of roll, pitch and yaw. A sample has an aim, which it keeps. A view is a
distance from the site, a direction of the Sun, and what the aim needs. `world.aiming` computes the pose from these
values and from the shape of the body. All are uniform within their bounds, except the distance and the pointing
error. The logarithms of the distances of consecutive samples follow a sequence that fills the bounds evenly. So
even a few samples, such as those of one site, show the body from near and from far. Every value is keyed by its
sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from . import keyed_random
from .config import Scene
from .redraw import least_sun_angle_deg

if TYPE_CHECKING:
    from .plan import Plan

F64 = NDArray[np.float64]

AIMS = ("sun", "nadir", "limb", "site", "random")
SUN = AIMS.index("sun")

# Values that a view of each aim needs; the other values of AIM_VARIABLES do not matter for it.
_SUNLIGHT = ("phase_deg", "sun_turn_deg")
_CAMERA = ("distance_m", "target_x_deg", "target_y_deg", "camera_turn_deg")
NEEDED = {
    "sun": (*_CAMERA, "limb_turn_deg", "beyond_limb_deg"),
    "nadir": (*_CAMERA, *_SUNLIGHT),
    "limb": (*_CAMERA, *_SUNLIGHT, "limb_turn_deg"),
    "site": (*_CAMERA, *_SUNLIGHT, "zenith_deg", "azimuth_deg"),
    "random": (*_CAMERA, *_SUNLIGHT, "limb_turn_deg", "cap_fraction"),
}
AIM_VARIABLES = tuple(dict.fromkeys(name for names in NEEDED.values() for name in names))

# Multiples of this number, modulo 1, fill the unit interval most evenly (Knuth 1998, The Art of Computer
# Programming 3, section 6.4).
_GOLDEN = (5**0.5 - 1) / 2
# A sample keeps its distance for so many tries, so that the kept views fill the bounds evenly, too.
_TRIES_PER_DISTANCE = 16
# With the aim "sun", the Sun is at up to this fraction of the way to the border of the frame, so that its whole
# disc is in the frame.
_TO_BORDER = 0.9


def weights(scene: Scene) -> dict[str, float]:
    """Return the fraction of the samples that have each aim, by the names of AIMS; their sum is 1."""
    aim = scene.geometry.aim
    given: dict[str, float] = {aim: 1.0} if isinstance(aim, str) else {} if aim is None else aim.model_dump()
    total = sum(given.values())
    return {name: given.get(name, 0.0) / total for name in AIMS}


def samples_towards_sun(scene: Scene, count: int, needing: int) -> int:
    """Return how many of `count` samples aim at the Sun, of which `needing` have a fault that needs it.

    Raises InputError where the weight of the Sun is 0, but a fault needs it.
    """
    weight = weights(scene)["sun"]
    if needing and not weight:
        raise InputError(
            f"geometry.aim: {needing} of {count} samples have a fault that needs the Sun, but the aim 'sun' has no "
            "weight; give it one above 0, or leave the fault out"
        )
    return max(round(weight * count), needing)


def deal(scene: Scene, towards_sun: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the aim of each sample of a block, uint8[n], an index in AIMS.

    Samples with `towards_sun` aim at the Sun. The others have the other aims, in the numbers that their weights
    give, rounded by the largest remainders.
    """
    aim = np.full(len(towards_sun), SUN, dtype=np.uint8)
    others = np.flatnonzero(~towards_sun)
    if not len(others):
        return aim
    weight = np.array(list(weights(scene).values()))
    weight[SUN] = 0
    exact = weight / weight.sum() * len(others)
    number = np.floor(exact).astype(int)
    number[np.argsort(number - exact, kind="stable")[: len(others) - number.sum()]] += 1
    aim[rng.permutation(others)] = np.repeat(np.arange(len(AIMS)), number)
    return aim


def draw(scene: Scene, samples: NDArray[np.int64], aim: NDArray[np.uint8], attempt: int) -> dict[str, F64]:
    """Return the values of views at an attempt, counted from 0, float64[n] each, by the names of AIM_VARIABLES.

    Parameters
    ----------
    scene
        The scene.
    samples, aim
        int64[n], and uint8[n]: an index in AIMS.
    attempt
        Later attempts are redraws.
    """
    from scipy.special import ndtri

    geometry, camera = scene.geometry, scene.camera
    slope = np.tan(np.radians(camera.fov_deg) / 2)
    half_x, half_y = np.degrees(np.arctan(slope * np.array([1.0, camera.height_px / camera.width_px])))
    narrow = min(half_x, half_y)

    def uniform(name: str, low: float = 0.0, high: float = 1.0) -> F64:
        u = keyed_random.keyed_uniform(scene.dataset.seed, samples, "plan", f"{name}/{attempt}")
        return np.asarray(low + u * (high - low))

    first = keyed_random.keyed_uniform(scene.dataset.seed, np.zeros(1, dtype=np.int64), "plan", "distance_m")
    u = (first + _GOLDEN * samples) % 1 if attempt < _TRIES_PER_DISTANCE else uniform("distance_m")
    low_m, high_m = geometry.distance_m

    def target(name: str, half_deg: float) -> F64:
        u = uniform(name)
        in_frame = np.degrees(np.arctan(_TO_BORDER * (2 * u - 1) * np.tan(np.radians(half_deg))))
        error = geometry.pointing_error_deg * ndtri(np.clip(u, 2.0**-53, 1 - 2.0**-53))
        return np.where(aim == SUN, in_frame, error)

    return {
        "distance_m": low_m * (high_m / low_m) ** u,
        "target_x_deg": target("target_x_deg", half_x),
        "target_y_deg": target("target_y_deg", half_y),
        "camera_turn_deg": uniform("camera_turn_deg", 0, 360),
        "limb_turn_deg": uniform("limb_turn_deg", 0, 360),
        "beyond_limb_deg": uniform("beyond_limb_deg", 0, narrow),
        "phase_deg": uniform("phase_deg", *geometry.phase_deg),
        "sun_turn_deg": uniform("sun_turn_deg", 0, 360),
        "zenith_deg": uniform("zenith_deg", *geometry.zenith_deg),
        "azimuth_deg": uniform("azimuth_deg", 0, 360),
        "cap_fraction": uniform("cap_fraction"),
    }


def of_aim(values: Mapping[str, float], aim: str) -> dict[str, float]:
    """Return the values that a view of an aim needs."""
    return {name: values[name] for name in NEEDED[aim]}


def view(plan: Plan, scene: Scene, index: int, attempt: int) -> dict[str, float]:
    """Return the values of a sample's view at a try, as far as its aim needs them; the aim stays."""
    assert plan.aim is not None
    drawn = draw(scene, plan.draw[index : index + 1], plan.aim[index : index + 1], attempt)
    return of_aim({name: float(column[0]) for name, column in drawn.items()}, plan.aim_of(index))


def sun_elongation_deg(scene: Scene) -> tuple[float, float]:
    """Return the allowed angles between boresight and Sun where the camera aims, but not at the Sun."""
    given = scene.geometry.sun_elongation_deg
    return (least_sun_angle_deg(scene), 180.0) if given is None else (given[0], given[1])
