"""Describe in words what a scene will photograph, without rendering.

The commands `vbnfault describe` and `vbnfault build --dry-run` print this description.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import frames
from ..detector import Detector
from ..pipeline import Session
from ..pipeline.exposure import reference_exposure_s
from ..scene import aims, names, plan, redraw
from ..scene.bodies import named_body
from ..scene.config import Scene
from ..scene.trajectory import Trajectory
from ..world import ephemeris, ground
from .progress import duration_text, size_text

_SITES_DESCRIBED = 8  # a site takes 9 ms on a shape of 20,000 facets

# A body below these bounds perhaps has its size in km where m are meant. Approach scenes look at a body from ten
# and more of its lengths, so only many more are doubtful.
_LEAST_RADIUS_M = 5.0
_PATCH_RADII = 3.0
_LENGTHS_AWAY = 50.0
_SITES_SEARCHED = 4  # a site that is chosen for its Suns takes 0.8 s
_ROWS_DESCRIBED = 50  # of a flight whose heights are computed; one takes 10 ms
_POSES_DESCRIBED = 200  # rows of a trajectory whose distance from the ground is computed


def describe(session: Session, *, sample_bytes: int, seconds: float) -> list[str]:
    """Return lines that describe the samples of a session; warnings come last.

    Parameters
    ----------
    session : Session
        Session of the scene, with its plan. The function makes no terrain. It loads the renderer only where sites
        are chosen for their Suns, for a few rays.
    sample_bytes : int
        Approximate size of a sample on disk.
    seconds : float
        Approximate duration of the build on this machine.
    """
    lines = [f"{session.scene.title}: {session.scene.description}".rstrip(": ")]
    lines += _samples(session)
    lines += _body(session)
    lines += _geometry(session)
    lines += _camera(session)
    total = sample_bytes * len(session.plan)
    lines.append(f"size: about {size_text(total)}; time on this machine: about {duration_text(seconds)}")
    doubts = plan.shortcomings(session.scene, session.plan) + _small_body(session)
    return lines + [f"warning: {text}" for text in doubts]


def _samples(session: Session) -> list[str]:
    """Return lines with the numbers of samples for each site, device, stratum, fault class and split."""
    scene, table = session.scene, session.plan
    per_site = np.bincount(table.site)
    per_site = per_site[per_site > 0]
    lines = [
        f"samples: {len(table)} at {len(per_site)} of {scene.dataset.sites} sites, "
        f"{_range(per_site.min(), per_site.max())} at each"
    ]
    if scene.camera.individuals > 1:
        per_device = np.bincount(table.individual, minlength=scene.camera.individuals)
        each = _range(per_device.min(), per_device.max())
        lines[0] += f"; {len(per_device)} devices of the detector, {each} samples each"
    chosen: dict[str, NDArray[np.bool_]] = {"samples": np.ones(len(table), dtype=bool)}
    chosen |= {name: np.asarray(table.stratum == k) for k, name in enumerate(names.STRATA)}
    chosen["no fault"] = np.asarray(~table.injected.any(axis=1))
    chosen |= {name: table.injects(name) for name in table.faults}
    splits = {name: table.split == k for k, name in enumerate(plan.SPLITS)}
    wide = max(map(len, chosen))
    lines.append(f"  {'planned':<{wide}}{'all':>9}" + "".join(f"{name:>9}" for name in splits))
    for name, samples in chosen.items():
        counts = [int(samples.sum()), *(int((samples & split).sum()) for split in splits.values())]
        lines.append(f"  {name:<{wide}}" + "".join(f"{count:>9}" for count in counts))
    nominal = int(chosen["no fault"].sum())
    share = f"faults: {nominal} of {len(table)} samples ({nominal / len(table):.0%}) get none, as plan.mode = "
    share += f"{scene.plan.mode!r} and plan.faulty_fraction = {scene.plan.faulty_fraction:g} set"
    return [*lines, "; ".join([share, *(f"{k}: {f.remark}" for k, f in session.faults.items() if f.remark)])]


def _body(session: Session) -> list[str]:
    """Return a line with the size of the body, and one with the keys that a packaged table sets."""
    axes_m, radius_m = _size_m(session)
    table = session.scene.body
    extent = " x ".join(f"{length:.4g}" for length in axes_m)
    lines = [f"body: {table.name}, {extent} m along its axes x, y and z, mean radius {radius_m:.4g} m"]
    named = named_body(table.name)
    if named is not None:
        packaged = type(table).model_validate(named.body)
        keys = [key for key in named.body if getattr(table, key) == getattr(packaged, key)]
        lines.append(f"  as in the packaged table of {named.name}: {', '.join(keys) or 'nothing'}")
    return lines


def _size_m(session: Session) -> tuple[NDArray[np.float64], float]:
    """Return the body's extent along its axes, float64[3], and the radius of a sphere of its volume, both in m."""
    body = session.body
    return np.ptp(body.vertices_m, axis=0), body.mean_radius_m


def _small_body(session: Session) -> list[str]:
    """Return a sentence if the body is so small that its file is perhaps in another unit, otherwise nothing."""
    axes_m, radius_m = _size_m(session)
    scene, longest_m = session.scene, float(axes_m.max())
    reasons = [f"has a mean radius below {_LEAST_RADIUS_M:g} m"] if radius_m < _LEAST_RADIUS_M else []
    if longest_m < _PATCH_RADII * scene.patch.radius_m:
        reasons.append(f"is shorter than {_PATCH_RADII:g} times patch.radius_m = {scene.patch.radius_m:g}")
    key = "distance_m" if scene.is_aimed else "height_m"
    height_m = getattr(scene.geometry, key)[0]
    if not scene.is_flown and longest_m < height_m / _LENGTHS_AWAY:
        reasons.append(f"is over {_LENGTHS_AWAY:g} of its lengths below the lowest of geometry.{key}, {height_m:g}")
    if not reasons:
        return []
    return [
        f"body.shape = {Path(scene.body.shape).name!r}: the body, {longest_m:.3g} m long, {' and '.join(reasons)}; "
        "if its size is wrong, give body.unit or body.semi_axes_m"
    ]


def _geometry(session: Session) -> list[str]:
    """Return lines about the camera's positions and attitudes (or its SPICE trajectory) and about the Sun."""
    scene, table = session.scene, session.plan
    geometry = scene.geometry
    if session.trajectory is not None:
        return _trajectory(session, session.trajectory)
    sun = f"Sun: {ephemeris.sun_distance_au(scene):.4g} au away"
    if scene.spice.spacecraft:
        until = scene.spice.until_julian_date or scene.sun.julian_date
        return [
            f"trajectory: {scene.spice.spacecraft} from Julian date {scene.sun.julian_date:.5f} to {until:.5f}; "
            "poses are kept, and faults that cannot show are recorded as not injected",
            sun,
        ]
    if table.aim is not None:
        return _aims(session, table.aim)
    low, high = geometry.height_m
    above = "the ground below the camera" if geometry.height_reference == "local_ground" else "the site"
    field_deg, pixel = session.base_camera.fov_deg, scene.camera.pixel_rad
    across = 2 * np.tan(np.radians(min(field_deg, 180)) / 2)
    # a pose is refused if a surface is closer than the clearance, so no camera is lower than the clearance
    nearest = max(low, min(geometry.clearance_m, high))
    lines = [
        f"heights: {low:g} to {high:g} m above {above}, x {_bounds(geometry.x_m)} m, y {_bounds(geometry.y_m)} m",
        f"straight down: {_span(pixel * nearest, pixel * high)} m a pixel"
        + (f", footprint {_span(across * nearest, across * high)} m across" if field_deg < 180 else ""),
        f"{sun}, date {scene.sun.julian_date:.1f} TDB",
    ]
    if any(s.reference == "nadir" for k, s in enumerate(redraw.strata(scene)) if (table.stratum == k).any()):
        lines.append(_down(session))
    for k, stratum in enumerate(redraw.strata(scene)):
        if not (table.stratum == k).any():
            continue
        towards = _REFERENCES[stratum.reference]
        lit = f"at least {stratum.min_lit_fraction:.0%} sunlit ground" if stratum.min_lit_fraction else "any ground"
        lines.append(
            f"  {names.STRATA[k]}: Sun elevation {_bounds(stratum.sun_elevation_deg)}, azimuth "
            f"{_bounds(stratum.sun_azimuth_deg)} deg; camera from {towards} by roll {_bounds(stratum.roll_deg)}, "
            f"pitch {_bounds(stratum.pitch_deg)}, yaw {_bounds(stratum.yaw_deg)} deg; {lit}"
        )
    suns = scene.exchanges_views and (session.plan.stratum == plan.SUN_FACING).any()
    return [*lines, _redrawn(session), *([_suns_seen(session)] if suns else [])]


def _suns_seen(session: Session) -> str:
    """Say how often the Suns of Sun-facing views are seen at the sites that are chosen for them, at a few sites."""
    scene, table = session.scene, session.plan
    used = np.unique(table.site[table.stratum == plan.SUN_FACING])
    some = used[np.linspace(0, len(used) - 1, min(_SITES_SEARCHED, len(used))).astype(int)]
    model = ground.shape_model(session.body)
    of_sites = []
    for index in some.tolist():
        suns = table.suns_of_site(index)
        drawn = {name: values[suns] for name, values in table.variables.items()}
        of_sites.append(ground.suns_seen(scene, model, session.sites[index], drawn))
    own, never, count = (
        sum(int(number) for number in numbers)
        for numbers in zip(*((s.diagonal().sum(), (~s.any(axis=0)).sum(), len(s)) for s in of_sites), strict=True)
    )
    return (
        f"Suns: on the shape model, at {len(some)} of {len(used)} sites chosen for them, {own} of {count} are seen "
        f"from the position drawn for them, {count - own - never} only from that of another sample, and {never} "
        "from none, so that a new position is drawn, or at last another Sun"
    )


def _aims(session: Session, aim: NDArray[np.uint8]) -> list[str]:
    """Return lines about the aims of the samples (uint8[n]), their distances and the Sun."""
    scene = session.scene
    geometry, (low, high) = scene.geometry, scene.geometry.distance_m
    counts = np.bincount(aim, minlength=len(aims.AIMS))
    mixed = ", ".join(f"{name} {count}" for name, count in zip(aims.AIMS, counts, strict=True) if count)
    pixel = scene.camera.pixel_rad
    kept_away = aims.sun_elongation_deg(scene)
    return [
        f"aims: {mixed}; {geometry.pointing_error_deg:g} deg of pointing error about each axis, any turn about the "
        "boresight; roll, pitch and yaw are stored relative to the Sun",
        f"distances: {low:g} to {high:g} m from the site, evenly in their logarithm; at the site "
        f"{_span(pixel * low, pixel * high)} m a pixel",
        f"Sun: {ephemeris.sun_distance_au(scene):.4g} au away, date {scene.sun.julian_date:.1f} TDB; phase angle "
        f"at the site {_bounds(geometry.phase_deg)} deg, {_span(*kept_away)} deg from the boresight unless it is "
        "the aim",
        _redrawn(session),
    ]


def _redrawn(session: Session) -> str:
    """Return a line about the views that are drawn again."""
    scene, geometry = session.scene, session.scene.geometry
    if scene.exchanges_views:
        return (
            f"views: nothing within {geometry.clearance_m:g} m; Suns and attitudes stay as drawn: sites are chosen "
            "for the Suns, and the samples of a shard exchange positions or views that they cannot use"
        )
    hidden = "is drawn again" if geometry.sun_visibility == "required" else "is kept, without this fault"
    unseen = f"gets another view, of {scene.plan.max_views} at most"
    if scene.plan.on_invisible == "drop":
        unseen = "is recorded as not injected"
    return (
        f"views: nothing within {geometry.clearance_m:g} m; a view whose fault needs the Sun, which is hidden, "
        f"{hidden}; a fault that cannot show {unseen}"
    )


def _trajectory(session: Session, table: Trajectory) -> list[str]:
    """Return lines about a table of poses: its rows, distances and dates, and the terrains that they need."""
    body, count = session.body, len(session.plan)
    first_poses = table.camera_position_T_m[: min(count, _POSES_DESCRIBED)]
    # pose by pose: all at once would take gigabytes for a detailed shape
    range_m = np.array([np.linalg.norm(body.vertices_m - camera, axis=1).min() for camera in first_poses])
    phase = [
        np.degrees(np.arccos(np.clip(frames.unit(position) @ sun, -1, 1)))
        for position, sun in zip(
            table.camera_position_T_m[:count] - body.centre_of_mass_T_m, table.sun_direction_T[:count], strict=True
        )
    ]
    first = f" (first {len(range_m)} rows)" if len(range_m) < count else ""
    date = table.julian_date[:count]
    distance = table.sun_distance_au[:count]
    return [
        f"trajectory: {count} of {len(table)} rows of {Path(table.source).name}, from {table.name[0]} to "
        f"{table.name[count - 1]}; {_rows_of_a_site(session, table)}; "
        "poses are kept, and faults that cannot show are recorded as not injected",
        f"nearest ground: {_span(range_m.min(), range_m.max())} m from the camera{first}, "
        f"{_span(*(session.scene.camera.pixel_rad * range_m[[range_m.argmin(), range_m.argmax()]]))} m a pixel; "
        f"phase angle at the centre of mass {_span(min(phase), max(phase))} deg",
        f"Sun: {_span(distance.min(), distance.max())} au away, dates {date.min():.5f} to {date.max():.5f} TDB",
        *_flights(session, table),
        *_rows_that_miss_the_body(session, table, count),
        *_rows_without_the_sun(session, table, count),
    ]


def _rows_of_a_site(session: Session, table: Trajectory) -> str:
    """Return the clause that says which rows share a site, and how far apart frames of sequences are."""
    if not table.frames:
        return f"a site stands for {session.scene.dataset.shard_samples} rows side by side"
    frames, last = np.array(table.frames), np.cumsum(table.frames)[:-1]
    apart_s = np.delete(np.diff(table.time_s), last - 1)
    times = f", {_span(apart_s.min(), apart_s.max())} s apart" if len(apart_s) else ""
    number = f"{len(frames)} sequences" if len(frames) > 1 else "one sequence"
    return f"{number} of {_span(frames.min(), frames.max())} frames{times}, each with one camera and its faults"


def _rows_that_miss_the_body(session: Session, table: Trajectory, count: int) -> list[str]:
    """Return a warning of the rows whose frames cannot show the sphere around the body; [] if there are none."""
    camera, body = session.scene.camera, session.body
    half_width = np.tan(np.radians(camera.fov_deg) / 2)
    half_diagonal = np.arctan(half_width * np.hypot(1, camera.height_px / camera.width_px))
    if (calibration := camera.frame_calibration) is not None:
        half_diagonal = np.radians(calibration.field_deg)
    radius_m = np.linalg.norm(body.vertices_m - body.centre_of_mass_T_m, axis=1).max()
    to_body_m = body.centre_of_mass_T_m - table.camera_position_T_m[:count]
    distance_m = np.maximum(np.linalg.norm(to_body_m, axis=1), radius_m)
    cosine = np.clip((to_body_m * table.boresight_T[:count]).sum(axis=1) / distance_m, -1, 1)
    past = np.flatnonzero(np.arccos(cosine) > half_diagonal + np.arcsin(radius_m / distance_m))
    if not past.size:
        return []
    return [
        f"warning: {len(past)} of {count} rows look past the body, the first is {table.name[past[0]]}; "
        "camera_from_T takes the components of a vector from T to the camera's axes, w first"
    ]


def _flights(session: Session, table: Trajectory) -> list[str]:
    """Return a line for each flight of the scene: time, distances, heights, speeds, pixels on the ground, turns."""
    flights = () if session.scene.trajectory is None else session.scene.trajectory.flight
    if not flights or table.velocity_T_m_s is None or table.rate_C_rad_s is None:
        return []
    body, pixel = session.body, session.scene.camera.pixel_rad
    lines, start = [], 0
    for flight in flights:
        rows = np.arange(start, start + flight.sequences * flight.frames)
        start += len(rows)
        position = table.camera_position_T_m[rows]
        # first and last rows, and some in between
        some = np.unique([0, flight.frames - 1, *np.linspace(0, len(rows) - 1, _ROWS_DESCRIBED).astype(int)])
        height_m = np.array([ground.nearest_ground(body, place)[0] for place in position[some]])
        range_m = np.linalg.norm(position - body.centre_of_mass_T_m, axis=1)
        speed_m_s = np.linalg.norm(table.velocity_T_m_s[rows], axis=1)
        turn_px = np.linalg.norm(table.rate_C_rad_s[rows, :2], axis=1) * flight.period_s / pixel
        first_m, last_m = height_m[0], height_m[some == flight.frames - 1][0]
        lines.append(
            f"  {flight.kind}: {flight.sequences} {'sequences' if flight.sequences > 1 else 'sequence'} of "
            f"{flight.frames} frames, {flight.duration_s:g} s; "
            f"{_span(range_m.min(), range_m.max())} m from the centre of mass, "
            f"{_span(height_m.min(), height_m.max())} m from the ground; "
            f"{_span(speed_m_s.min(), speed_m_s.max())} m/s in T; "
            f"{pixel * first_m:.3g} m a pixel first, {pixel * last_m:.3g} last; the boresight turns "
            f"{_span(turn_px.min(), turn_px.max())} px a frame"
        )
    return lines


def _rows_without_the_sun(session: Session, table: Trajectory, count: int) -> list[str]:
    """Return a warning if faults need the Sun and the spacecraft hides it in every row that faces it."""
    faults = [name for name, fault in session.faults.items() if fault.needs_sun]
    if session.vehicle is None or not faults:
        return []
    poses = [table.pose(k) for k in range(min(count, _POSES_DESCRIBED))]
    sun_C = np.array([pose.T_from_C.T @ pose.sun_direction_T for pose in poses])
    facing = sun_C[sun_C[:, 2] > 0]
    if not len(facing) or not session.vehicle.blocked(facing).all():
        return []
    return [
        f"warning: spacecraft.model = {Path(session.scene.spacecraft.model).name!r} hides the Sun in all of the "
        f"{len(facing)} rows whose camera faces it, so {' and '.join(faults)} cannot show; check its unit, "
        "spacecraft.translation_m and the turns of the model"
    ]


# The references of attitude (`geometry.sun_facing.reference`) in words.
_REFERENCES = {"sun": "the Sun", "nadir": "straight down", "centre": "the body's centre of mass"}


def _down(session: Session) -> str:
    """Describe how far straight down is from the direction to the body's centre of mass, at a few sites.

    Down follows gravity and the centrifugal force. On a fast rotator or an irregular body, it does not point at the
    centre.
    """
    used = np.unique(session.plan.site)
    some = used[np.linspace(0, len(used) - 1, min(_SITES_DESCRIBED, len(used))).astype(int)]
    sites = [session.sites[int(index)] for index in some]
    centre_T_m = session.body.centre_of_mass_T_m
    cosine = [site.T_from_L[:, 2] @ frames.unit(centre_T_m - site.position_T_m) for site in sites]
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return (
        f"straight down (gravity and rotation) is {_range(round(angle.min()), round(angle.max()))} deg from the "
        f"direction to the body's centre of mass, at {len(sites)} of the sites"
    )


def _camera(session: Session) -> list[str]:
    """Return lines about the camera, the lens, the detector and the exposure."""
    scene, camera = session.scene, session.base_camera
    settings = scene.camera
    if settings.exposure_s == "auto":
        about = [reference_exposure_s(scene_there, camera) for scene_there in _at_least_and_most_sun(session)]
        clipped = np.clip(about, settings.exposure_min_s, settings.exposure_max_s)
        exposure = (
            f"metered, about {_span(clipped.min(), clipped.max())} s for ground lit and seen at 45 deg, 60 deg of "
            f"phase, from {settings.exposure_min_s:g} to {settings.exposure_max_s:g} s"
        )
    else:
        exposure = f"{settings.exposure_s:g} s"
    field_deg = settings.fov_deg if settings.calibration is None else camera.fov_deg
    architectures = (camera.architecture,) if settings.detector else settings.architectures
    return [
        f"camera: {camera.width_px} x {camera.height_px} px, {field_deg:.6g} deg across; "
        f"lens: {camera.lens.figures['summary']}",
        f"detector: {camera.detector.name}{_effects(camera.detector)}, {', '.join(architectures)}; "
        f"exposure: {exposure}",
    ]


def _at_least_and_most_sun(session: Session) -> list[Scene]:
    """Return the scene; with a table of poses, the scene at the least and at the greatest distance of the Sun."""
    scene = session.scene
    if session.trajectory is None:
        return [scene]
    distance = session.trajectory.sun_distance_au[: len(session.plan)]
    suns = [scene.sun.model_copy(update={"distance_au": float(d)}) for d in (distance.min(), distance.max())]
    return [scene.model_copy(update={"sun": sun}) for sun in suns]


def _range(low: float, high: float) -> str:
    """Return `low to high` as text, or a single number if both bounds are equal."""
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _span(low: float, high: float) -> str:
    """Return a range as text, with three significant digits."""
    return _range(float(f"{low:.3g}"), float(f"{high:.3g}"))


def _bounds(pair: tuple[float, float] | None) -> str:
    """Return bounds as text. The bounds are never None, because the scene is resolved."""
    assert pair is not None
    return _range(*pair)


def _effects(detector: Detector) -> str:
    """Return the effects of plug-ins that act in a detector, as a clause."""
    effects = [] if detector.mosaic is None else [effect.name for effect in detector.mosaic.sensor.effects]
    return f" with {' and '.join(effects)}" if effects else ""
