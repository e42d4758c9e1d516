"""Fly the flights of a scene: compute poses, velocities and rates from gravity, spin and the law of each kind.

Motion is integrated in axes that do not turn, which lie along T's at a stated time. Their origin is the body's
centre of mass, about which a free body spins. The attraction is that of the homogeneous polyhedron, at any
distance; the tide and the pressure of sunlight are left out. SciPy's DOP853 integrates with a relative tolerance of
1e-10 and absolute ones of 1e-7 m and 1e-10 m/s. Positions and velocities are then taken to T, which turns about +z.

The camera's z axis follows what it is aimed at. Its attitude has a constant offset and noise in three angles, whose
first-order Gauss-Markov process is limited to ten times its bandwidth, so that the noise has a rate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site, site_at
from ..body.gravity import GRAVITATIONAL_CONSTANT
from ..core import frames
from ..core.errors import InputError
from ..scene import keyed_random
from ..scene.config import Scene
from ..scene.flights import (
    AnyFlight,
    ApproachFlight,
    DescentFlight,
    FlybyFlight,
    HoverFlight,
    OrbitFlight,
    RelocationFlight,
    bounds_of,
    drawn,
    numbered,
    uniform,
)
from ..scene.trajectory import FLIGHTS, JULIAN_DATES, Trajectory
from . import ephemeris
from .ground import below_ground, body_radius_m, first_hit, first_inside, nearest_ground

F64 = NDArray[np.float64]
Chosen = TypeVar("Chosen")

_RTOL, _ATOL = 1e-10, np.array([1e-7] * 3 + [1e-10] * 3)
# While the velocity is searched that leads to a target, tolerances are so many times larger.
_SEARCH = 1e3
_DAY_S = 86400.0
_POLE = np.array([0.0, 0.0, 1.0])
# Sites drawn until one fits the keys, and sites from which a flight is tried until it stays above the ground.
_SITES, _TRIES = 300, 8
_SUN_SEEN_FROM_M = 1.0
_PATH_POINTS = 200  # at least, at which a flight is compared with the ground
_MISS_M = 0.01  # largest miss of the target of a free flight
# A hop leaves flat ground at an angle between these. Lower ones skim the ground, higher ones hardly move.
_HOP_DEG = (10.0, 80.0)
# Distances of the second site that are tried until it lies at the wanted distance, to this fraction.
_STEPS, _DISTANCE_FRACTION = 6, 0.01
_MOST_ORBITS = 200  # of a free fall; each takes some hundred evaluations of gravity
# Harmonics of an angle of the attitude's noise, and the highest of them in 1 / attitude_time_s.
_HARMONICS, _BAND = 64, 10.0
# Least angle between the boresight and what is up in the image; nearer to it, the other axis is.
_UP_SIN = np.sin(np.radians(2.0))
_flown: dict[Any, Trajectory] = {}  # the trajectories that this process has flown, by all that they depend on


@dataclass(frozen=True, kw_only=True, eq=False)
class _Path:
    """Hold positions in T, float64[n, 3] in m, their derivatives in T in m/s, and what the camera is aimed at."""

    position_T_m: F64
    velocity_T_m_s: F64
    target_T_m: F64


@dataclass(frozen=True, kw_only=True, eq=False)
class _Case:
    """Hold what the path of a sequence follows from. Times, float64[n] in s, count from its first frame."""

    scene: Scene
    body: Body
    flight: AnyFlight
    number: int
    time_s: F64
    attempt: int = 0

    def value(self, key: str) -> float:
        """Return the value of a key, drawn if it has bounds."""
        return drawn(self.scene.dataset.seed, self.flight, self.number, key, self.attempt)

    def uniform(self, name: str) -> float:
        """Return a random number in [0, 1)."""
        return uniform(self.scene.dataset.seed, self.flight, self.number, name, self.attempt)

    def dated(self, time_s: float) -> Scene:
        """Return the scene at a time of the sequence."""
        start_s = drawn(self.scene.dataset.seed, self.flight, self.number, "start_s")
        return ephemeris.dated(self.scene, julian_date=self.scene.sun.julian_date + (start_s + time_s) / _DAY_S)

    @property
    def name(self) -> str:
        """Return the name of the sequence."""
        return f"{self.flight.kind}/{self.number}"


def fly(scene: Scene, body: Body) -> Trajectory:
    """Return the trajectory of the flights of a scene, with velocities and rates.

    Raises
    ------
    InputError
        A flight passes through the ground, finds no site, or cannot be flown in the time of its sequence.
    """
    assert scene.trajectory is not None
    around = (scene.sun, scene.orbit, scene.body, scene.spice, scene.trajectory, scene.dataset.seed)
    key = (body.content_hash, body.density_kg_m3, body.rotation_period_s, *around)
    if key not in _flown:
        parts = [_sequence(scene, body, flight, number) for flight, number in numbered(scene.trajectory.flight)]
        if len(_flown) == 4:
            del _flown[next(iter(_flown))]
        _flown[key] = _joined(parts)
    return _flown[key]


def _joined(parts: list[Trajectory]) -> Trajectory:
    """Return trajectories one after the other."""
    values: dict[str, Any] = {
        key: np.concatenate([getattr(part, key) for part in parts])
        for key, value in vars(parts[0]).items()
        if isinstance(value, np.ndarray)
    }
    texts: dict[str, Any] = {
        key: tuple(entry for part in parts for entry in getattr(part, key))
        for key in ("name", "sequence_names", "frames")
    }
    return replace(parts[0], **texts, **values)


def _sequence(scene: Scene, body: Body, flight: AnyFlight, number: int) -> Trajectory:
    """Return one sequence of a flight. Raises InputError."""
    finer = -(-_PATH_POINTS // max(flight.frames - 1, 1))
    time_s = np.arange((flight.frames - 1) * finer + 1) / finer * flight.period_s
    failed: InputError | None = None
    tries = _TRIES if isinstance(flight, DescentFlight | HoverFlight | RelocationFlight) else 1
    for attempt in range(tries):
        case = _Case(scene=scene, body=body, flight=flight, number=number, time_s=time_s, attempt=attempt)
        try:
            path = _PATHS[type(flight)](case)
        except InputError as error:  # another site may do
            failed = error
            continue
        inside = first_inside(body, path.position_T_m)
        if inside is None:
            return _row_by_row(case, path, slice(None, None, finer))
        index, depth_m = inside
        row = _row_by_row(case, path, slice(index, index + 1), first=-(-index // finer)).pose(0)
        failed = InputError(f"{FLIGHTS}: {below_ground(row, depth_m)}")
    assert failed is not None
    raise failed


def _row_by_row(case: _Case, path: _Path, rows: slice, first: int = 0) -> Trajectory:
    """Return some positions of a path as the rows of a trajectory, whose names begin with the number `first`."""
    time_s = case.time_s[rows]
    last_jd = case.dated(float(time_s[-1])).sun.julian_date
    if not JULIAN_DATES[0] <= last_jd <= JULIAN_DATES[1]:
        raise InputError(
            f"{FLIGHTS}: {case.name} ends at Julian date {last_jd:.10g}; must be from {JULIAN_DATES[0]:.10g} to "
            f"{JULIAN_DATES[1]:.10g}, so choose a shorter period_s or fewer frames"
        )
    scenes = [case.dated(float(t)) for t in time_s]
    position, velocity = path.position_T_m[rows], path.velocity_T_m_s[rows]
    T_from_C, rate = _attitude(case, replace(path, position_T_m=position, velocity_T_m_s=velocity), time_s)
    return Trajectory(
        source=FLIGHTS,
        name=tuple(f"{case.name}/{first + k:04d}" for k in range(len(time_s))),
        julian_date=np.array([there.sun.julian_date for there in scenes]),
        camera_position_T_m=position,
        camera_from_T=np.stack([frames.quaternion(axes.T) for axes in T_from_C]),
        sun_direction_T=np.stack([ephemeris.sun_direction_T(there) for there in scenes]),
        sun_distance_au=np.array([ephemeris.sun_distance_au(there) for there in scenes]),
        time_s=time_s,
        sequence_names=(case.name,),
        frames=(len(time_s),),
        velocity_T_m_s=velocity,
        rate_C_rad_s=rate,
    )


# --- motion -----------------------------------------------------------------------------------------------------


def _turned(vectors: F64, angle_rad: F64 | float) -> F64:
    """Return vectors, float64[..., 3], turned about +z."""
    x, y, z = np.moveaxis(np.asarray(vectors), -1, 0)
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack(np.broadcast_arrays(c * x - s * y, s * x + c * y, z), axis=-1)


def _cross_pole(vectors: F64) -> F64:
    """Return the cross product of +z and vectors, float64[..., 3]."""
    x, y, z = np.moveaxis(np.asarray(vectors), -1, 0)
    return np.stack([-y, x, 0 * z], axis=-1)


def _fall(
    body: Body, position_T_m: F64, velocity_T_m_s: F64, time_s: F64, *, loose: float = 1.0
) -> tuple[F64, F64]:
    """Return positions and velocities in T, float64[n, 3] each, of a free fall.

    `time_s`, float64[n], rises; it counts from the time of the given position and velocity, which are in T, and may
    begin before. `loose` is a factor on the tolerances.
    """
    from scipy.integrate import solve_ivp

    spin, centre = body.omega_rad_s, body.centre_of_mass_T_m
    offset = position_T_m - centre
    orbit_s = 2 * np.pi * np.sqrt(np.linalg.norm(offset) ** 3 / _gm_m3_s2(body))
    if np.ptp(time_s) > _MOST_ORBITS * orbit_s:
        raise InputError(
            f"{FLIGHTS}: lasts {np.ptp(time_s):.4g} s; must last at most {_MOST_ORBITS * orbit_s:.4g} s in this "
            f"gravity, {_MOST_ORBITS} orbits, so choose a shorter period_s or fewer frames"
        )
    start = np.concatenate([offset, velocity_T_m_s + spin * _cross_pole(offset)])

    def derivative(t: float, state: F64) -> F64:
        place = centre + _turned(state[:3], -spin * t)
        return np.concatenate([state[3:], _turned(body.gravity.evaluate(place).acceleration_m_s2[0], spin * t)])

    states = np.tile(start, (len(time_s), 1))
    for rows in (np.flatnonzero(time_s < 0)[::-1], np.flatnonzero(time_s > 0)):
        if len(rows):
            when = time_s[rows]
            solved = solve_ivp(
                derivative,
                (0.0, when[-1]),
                start,
                method="DOP853",
                t_eval=when,
                rtol=loose * _RTOL,
                atol=loose * _ATOL,
            )
            if not solved.success:
                raise InputError(f"{FLIGHTS}: the motion cannot be integrated: {solved.message}")
            states[rows] = solved.y.T
    offset = _turned(states[:, :3], -spin * time_s)
    return centre + offset, _turned(states[:, 3:], -spin * time_s) - spin * _cross_pole(offset)


def _fall_to(body: Body, start_T_m: F64, end_T_m: F64, time_s: F64) -> tuple[F64, F64]:
    """Return the free fall, as `_fall`, that begins at a position in T and is at another one at the last time.

    Raises InputError if there is none near the fall in even gravity.
    """
    from scipy.optimize import root

    last = time_s[-1:]
    spin = body.omega_rad_s
    offsets = start_T_m - body.centre_of_mass_T_m, _turned(end_T_m - body.centre_of_mass_T_m, spin * last[0])
    gravity = body.gravity.evaluate(0.5 * (start_T_m + end_T_m)).acceleration_m_s2[0]
    guess = (offsets[1] - offsets[0]) / last[0] - 0.5 * last[0] * _turned(gravity, 0.5 * spin * last[0])

    def miss_m_s(velocity_m_s: F64) -> F64:
        velocity_T_m_s = velocity_m_s - spin * _cross_pole(offsets[0])
        return np.asarray(_fall(body, start_T_m, velocity_T_m_s, last, loose=_SEARCH)[0][0] - end_T_m) / last[0]

    # The motion is nearly that in even gravity, where the miss changes by as much as the turned velocity does.
    turn = _turned(np.eye(3), spin * last[0])
    options = {"fatol": 0.1 * _MISS_M / last[0], "maxiter": 30, "jac_options": {"alpha": -1.0}}
    solution = root(lambda change: miss_m_s(guess + change @ turn), np.zeros(3), method="broyden1", options=options)
    if not np.linalg.norm(solution.fun) * last[0] < _MISS_M:
        raise InputError(
            f"{FLIGHTS}: no free fall from one end to the other takes {last[0]:g} s; choose a shorter period_s or "
            "fewer frames"
        )
    return _fall(body, start_T_m, guess + solution.x @ turn - spin * _cross_pole(offsets[0]), time_s)


def _towards_sun(case: _Case, time_s: float) -> F64:
    """Return a unit vector in T that has the drawn phase angle to the Sun at a time, on a random side of it."""
    sun = ephemeris.sun_direction_T(case.dated(time_s))
    phase, side = np.radians(case.value("phase_deg")), 2 * np.pi * case.uniform("side")
    return np.asarray(np.cos(phase) * sun + np.sin(phase) * _perpendicular(sun, side))


def _perpendicular(direction: F64, angle_rad: float) -> F64:
    """Return the unit vector perpendicular to a direction that is turned about it by an angle."""
    axes = frames.minimal_rotation(_POLE, direction)
    return np.asarray(axes @ np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0]))


# --- kinds ------------------------------------------------------------------------------------------------------


def _approach(case: _Case) -> _Path:
    """Return a straight and even motion towards the centre of mass, in axes that do not turn."""
    flight, body = case.flight, case.body
    assert isinstance(flight, ApproachFlight)
    first, last = flight.range_m
    speed = (first - last) / max(flight.duration_s, flight.period_s)
    if flight.speed_m_s is not None:
        speed = case.value("speed_m_s")
    direction = _turned(_towards_sun(case, 0.0), -body.omega_rad_s * case.time_s)
    offset = (first - speed * case.time_s)[:, None] * direction
    velocity = -speed * direction - body.omega_rad_s * _cross_pole(offset)
    centre = body.centre_of_mass_T_m
    return _Path(position_T_m=centre + offset, velocity_T_m_s=velocity, target_T_m=centre)


def _orbit(case: _Case) -> _Path:
    """Return an orbit that begins with the circular speed of a point mass."""
    body, radius_m = case.body, case.value("radius_m")
    node, inclination, argument = (
        np.radians(case.value(key)) for key in ("node_deg", "inclination_deg", "argument_deg")
    )
    plane = frames.rz(node) @ frames.rx(inclination) @ frames.rz(argument)
    offset = radius_m * plane[:, 0]
    velocity = np.sqrt(_gm_m3_s2(body) / radius_m) * plane[:, 1] - body.omega_rad_s * _cross_pole(offset)
    centre = body.centre_of_mass_T_m
    position, velocity = _fall(body, centre + offset, velocity, case.time_s)
    return _Path(position_T_m=position, velocity_T_m_s=velocity, target_T_m=centre)


def _flyby(case: _Case) -> _Path:
    """Return a motion that is nearest to the centre of mass half-way, perpendicular to its direction there."""
    body, closest_m = case.body, case.value("closest_m")
    middle = 0.5 * case.flight.duration_s
    direction = _towards_sun(case, middle)
    speed = np.sqrt(case.value("speed_m_s") ** 2 + 2 * _gm_m3_s2(body) / closest_m)
    offset = closest_m * direction
    velocity = speed * _perpendicular(direction, 2 * np.pi * case.uniform("plane"))
    centre = body.centre_of_mass_T_m
    velocity = velocity - body.omega_rad_s * _cross_pole(offset)
    position, velocity = _fall(body, centre + offset, velocity, case.time_s - middle)
    return _Path(position_T_m=position, velocity_T_m_s=velocity, target_T_m=centre)


def _gm_m3_s2(body: Body) -> float:
    """Return the gravitational parameter of a body."""
    return GRAVITATIONAL_CONSTANT * body.gravity.mass_kg


def _descent(case: _Case) -> _Path:
    """Return a free fall from beside the vertical of a site to a position on it."""
    site = _site(case)
    north, east, down = site.T_from_L.T
    side = 2 * np.pi * case.uniform("side")
    aside = case.value("aside_m") * (np.cos(side) * north + np.sin(side) * east)
    start = site.position_T_m - case.value("height_m") * down + aside
    end = site.position_T_m - case.value("end_height_m") * down
    lasts_s, gravity = case.flight.duration_s, case.body.effective_gravity(0.5 * (start + end))[0] @ down
    longest_s = np.sqrt(2 * ((end - start) @ down) / max(gravity, 1e-12))
    if lasts_s < 1.5 * longest_s:  # only then worth the search
        position, velocity = _fall_to(case.body, start, end, case.time_s)
        if velocity[0] @ down >= 0:
            return _Path(position_T_m=position, velocity_T_m_s=velocity, target_T_m=_target(case, site))
    raise InputError(
        f"{FLIGHTS}: {case.name} would have to rise first, as it lasts {lasts_s:g} s; a fall from rest takes about "
        f"{longest_s:.0f} s, so choose a shorter period_s or fewer frames"
    )


def _hover(case: _Case) -> _Path:
    """Return parabolas between the thrusts that keep the camera within a band about its station.

    A thrust at the low side of the band sends it to the high side; it falls back in the gravity and centrifugal
    acceleration of the station, until the next thrust. Meanwhile it drifts evenly from one random position in the
    cross-section of the band to another one.
    """
    site, band_m = _site(case), case.value("dead_band_m")
    station = site.position_T_m - case.value("height_m") * site.T_from_L[:, 2]
    axes = site_at(case.body, 0, station).T_from_L
    gravity = float(np.linalg.norm(case.body.effective_gravity(station)))
    arc_s = 2 * np.sqrt(2 * band_m / gravity)
    count = case.uniform("phase") + case.time_s / arc_s
    since = (count % 1) * arc_s
    up = 0.5 * gravity * since * (arc_s - since) - 0.5 * band_m
    up_rate = gravity * (0.5 * arc_s - since)
    knots = [_drift(case, np.floor(count) + k) * 0.5 * band_m for k in (0, 1)]
    aside_rate = (knots[1] - knots[0]) / arc_s
    aside = knots[0] + aside_rate * since[:, None]
    local, rate = (np.column_stack([parts, -along]) for parts, along in ((aside, up), (aside_rate, up_rate)))
    position = station + local @ axes.T
    return _Path(position_T_m=position, velocity_T_m_s=rate @ axes.T, target_T_m=_target(case, site))


def _drift(case: _Case, thrust: F64) -> F64:
    """Return the position of each thrust in the unit circle, float64[n, 2], evenly over its area."""
    seed, numbers = case.scene.dataset.seed, thrust.astype(np.int64)
    radius, angle = (
        keyed_random.keyed_uniform(seed, numbers, "flight", f"{case.name}/{name}") for name in ("radius", "angle")
    )
    return np.sqrt(radius)[:, None] * np.column_stack([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)])


def _relocation(case: _Case) -> _Path:
    """Return a free flight from above a site to above another one at the wanted distance."""
    first, second = _site_pair(case)
    height = case.value("height_m")
    start, end = (site.position_T_m - height * site.T_from_L[:, 2] for site in (first, second))
    # on flat ground a hop of the distance D and the time T leaves at the angle whose tangent is g T² / (2 D)
    lasts_s, distance = case.flight.duration_s, float(np.linalg.norm(end - start))
    gravity = float(np.linalg.norm(case.body.effective_gravity(0.5 * (start + end))))
    low, high = (np.sqrt(2 * distance * np.tan(np.radians(angle)) / gravity) for angle in _HOP_DEG)
    if not low <= lasts_s <= high:
        raise InputError(
            f"{FLIGHTS}: {case.name}: a hop of {distance:.4g} m lasts {lasts_s:g} s; must last from {low:.4g} to "
            f"{high:.4g} s in this gravity, so change period_s, frames or distance_m"
        )
    position, velocity = _fall_to(case.body, start, end, case.time_s)
    return _Path(position_T_m=position, velocity_T_m_s=velocity, target_T_m=_target(case, second))


_PATHS: dict[type, Callable[[_Case], _Path]] = {
    ApproachFlight: _approach,
    OrbitFlight: _orbit,
    FlybyFlight: _flyby,
    DescentFlight: _descent,
    HoverFlight: _hover,
    RelocationFlight: _relocation,
}


# --- sites ------------------------------------------------------------------------------------------------------


def _target(case: _Case, site: Site) -> F64:
    """Return what the camera of a flight over a site is aimed at; straight down is a point far below."""
    if case.flight.look == "site":  # type: ignore[union-attr]
        return site.position_T_m
    return np.asarray(site.position_T_m + 1e12 * site.T_from_L[:, 2])


def _site(case: _Case) -> Site:
    """Return a random site within the bounds of the keys. Raises InputError if there is none."""
    return _fitting_site(case, lambda site, k: site)


def _site_pair(case: _Case) -> tuple[Site, Site]:
    """Return a random site and one at a distance from it, in a random direction. Raises InputError."""
    distance_m = case.value("distance_m")

    def pair(site: Site, k: int) -> tuple[Site, Site] | None:
        turn = 2 * np.pi * case.uniform(f"direction/{k}")
        ahead = site.T_from_L @ np.array([np.cos(turn), np.sin(turn), 0.0])
        step_m = distance_m
        for _ in range(_STEPS):
            other = _ground_at(case.body, site.position_T_m + step_m * ahead)
            if other is None:
                return None
            actual_m = float(np.linalg.norm(other.position_T_m - site.position_T_m))
            if abs(actual_m / distance_m - 1) < _DISTANCE_FRACTION:
                return (site, other) if _fits(case, other) else None
            step_m *= distance_m / actual_m
        return None

    return _fitting_site(case, pair)


def _fitting_site(case: _Case, choose: Callable[[Site, int], Chosen | None]) -> Chosen:
    """Return what `choose` makes of the first random site that fits the keys. Raises InputError if none does."""
    flight = case.flight
    assert isinstance(flight, DescentFlight | HoverFlight | RelocationFlight)
    south, north = np.sin(np.radians(bounds_of(flight.latitude_deg)))
    west, east = np.radians(bounds_of(flight.longitude_deg))
    for k in range(_SITES):
        sine = south + (north - south) * case.uniform(f"latitude/{k}")
        longitude, cosine = west + (east - west) * case.uniform(f"longitude/{k}"), np.sqrt(1 - sine**2)
        site = _ground_at(case.body, np.array([cosine * np.cos(longitude), cosine * np.sin(longitude), sine]))
        if site is not None and _fits(case, site) and (chosen := choose(site, k)) is not None:
            return chosen
    raise InputError(
        f"{FLIGHTS}: {case.name} finds no site in {_SITES} draws; widen latitude_deg, longitude_deg, "
        "sun_elevation_deg or max_slope_deg, or change start_s, which sets where the Sun is"
    )


def _ground_at(body: Body, towards_T: F64) -> Site | None:
    """Return the site on the outermost ground in a direction from T's origin; None where there is no ground."""
    direction = frames.unit(towards_T)
    hit = first_hit(body, 2 * body_radius_m(body) * direction, -direction)
    return None if hit is None else site_at(body, 0, hit)


def _fits(case: _Case, site: Site) -> bool:
    """Return whether a site has the Sun and the slope that the keys allow.

    If the Sun must be up, no ground hides it from `_SUN_SEEN_FROM_M` above the site.
    """
    flight, body = case.flight, case.body
    assert isinstance(flight, DescentFlight | HoverFlight | RelocationFlight)
    sun, up = ephemeris.sun_direction_T(case.dated(0.5 * flight.duration_s)), -site.T_from_L[:, 2]
    low, high = np.sin(np.radians(flight.sun_elevation_deg))
    if not low <= sun @ up <= high:
        return False
    if low > 0 and first_hit(body, site.position_T_m + _SUN_SEEN_FROM_M * up, sun) is not None:
        return False
    corners = body.vertices_m[body.faces[nearest_ground(body, site.position_T_m)[1]]]
    normal = frames.unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    return bool(normal @ up >= np.cos(np.radians(flight.max_slope_deg)))


# --- attitude ---------------------------------------------------------------------------------------------------


def _attitude(case: _Case, path: _Path, time_s: F64) -> tuple[F64, F64]:
    """Return T_from_C, float64[n, 3, 3], and the rate of C relative to T, float64[n, 3] in rad/s in C's axes."""
    z, z_rate = _unit_and_rate(path.target_T_m - path.position_T_m, -path.velocity_T_m_s)
    axes, rate = _turning_axes(z, z_rate, *_up(case, z, time_s))
    noise, noise_rate = _noise(case, time_s)
    angle = np.linalg.norm(noise, axis=1)[:, None]
    skew = np.swapaxes(np.cross(noise[:, None], np.eye(3)), 1, 2)
    # rotation of a rotation vector, and the right Jacobian that takes its derivative to the angular velocity
    sine, versine = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        rest = np.where(angle < 1e-3, 1 / 6, (1 - sine) / angle**2)
    square = skew @ skew
    turn = np.eye(3) + sine[..., None] * skew + versine[..., None] * square
    jacobian = np.eye(3) - versine[..., None] * skew + rest[..., None] * square
    total = np.einsum("nji,nj->ni", turn, rate) + np.einsum("nij,nj->ni", jacobian, noise_rate)
    return axes @ turn, total


def _unit_and_rate(vector: F64, derivative: F64) -> tuple[F64, F64]:
    """Return vectors scaled to length 1, float64[n, 3], and the derivatives of these."""
    length = np.linalg.norm(vector, axis=1)[:, None]
    direction = vector / length
    along = np.einsum("ni,ni->n", direction, derivative)[:, None]
    return direction, (derivative - along * direction) / length


def _turning_axes(z: F64, z_rate: F64, up: F64, up_rate: F64) -> tuple[F64, F64]:
    """Return axes as columns, float64[n, 3, 3], whose image shows `up` at the top, and their rate in these axes.

    All are float64[n, 3]: the unit vector z, what is up in the image, and their derivatives.
    """
    up_z = np.einsum("ni,ni->n", up, z)[:, None]
    up_z_rate = np.einsum("ni,ni->n", up_rate, z)[:, None] + np.einsum("ni,ni->n", up, z_rate)[:, None]
    y, y_rate = _unit_and_rate(up_z * z - up, up_z_rate * z + up_z * z_rate - up_rate)
    x, x_rate = np.cross(y, z), np.cross(y_rate, z) + np.cross(y, z_rate)
    rates = [np.einsum("ni,ni->n", *pair) for pair in ((z, y_rate), (x, z_rate), (y, x_rate))]
    return np.stack([x, y, z], axis=-1), np.stack(rates, axis=-1)


def _up(case: _Case, z: F64, time_s: F64) -> tuple[F64, F64]:
    """Return what is up in the image, float64[n, 3] in T, and its derivative.

    It is the pole, or the Sun of the first frame, which stands still in axes that do not turn. Where the boresight
    comes near to it, it is T's x axis, for a site at all times, else that of the first frame, which stands still.
    """
    spin = case.body.omega_rad_s
    at_site = isinstance(case.flight, DescentFlight | HoverFlight | RelocationFlight)
    wanted = ephemeris.sun_direction_T(case.dated(0.0)) if case.flight.roll == "sun" else _POLE
    choices = []
    for direction, turns in ((wanted, True), (np.array([1.0, 0.0, 0.0]), not at_site)):
        up = _turned(direction, -spin * turns * time_s)
        choices.append((up, -spin * turns * _cross_pole(up)))
    least = [np.linalg.norm(np.cross(up, z), axis=1).min() for up, _ in choices]
    return choices[0] if least[0] > min(_UP_SIN, least[1]) else choices[1]


def _noise(case: _Case, time_s: F64) -> tuple[F64, F64]:
    """Return the rotation vector from the aimed axes to the camera's, float64[n, 3] in rad, and its derivative.

    It is a constant offset and a sum of harmonics. Their frequencies have the spectrum 1 / (1 + (ω τ)²) up to
    `_BAND` / τ, where τ is the correlation time, in equal parts of its power.
    """
    flight, side = case.flight, 2 * np.pi * case.uniform("offset side")
    rng = keyed_random.rng(case.scene.dataset.seed, case.number, "flight", f"{flight.kind}/attitude")
    parts = (np.arange(_HARMONICS)[:, None] + rng.random((_HARMONICS, 3))) / _HARMONICS
    frequency = np.tan(parts * np.arctan(_BAND)) / flight.attitude_time_s
    size = np.radians(flight.attitude_noise_deg) / np.sqrt(_HARMONICS)
    cosines, sines = size * rng.standard_normal((2, _HARMONICS, 3))
    noise = np.tile(
        np.radians(case.value("offset_deg")) * np.array([np.cos(side), np.sin(side), 0.0]), (len(time_s), 1)
    )
    rate = np.zeros_like(noise)
    for omega, a, b in zip(frequency, cosines, sines, strict=True):
        c, s = np.cos(time_s[:, None] * omega), np.sin(time_s[:, None] * omega)
        noise += a * c + b * s
        rate += omega * (b * c - a * s)
    return noise, rate
