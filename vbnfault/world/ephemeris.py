"""Find Sun, orbit, attitude and trajectory of a scene: from its tables, or from SPICE."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site, Sites, site_at
from ..core import frames, spectra
from ..core.errors import under_key
from ..core.files import file_contents, spice
from ..render.description import Sunlight
from ..scene import redraw
from ..scene.config import Scene
from ..scene.surroundings import OrbitTable, SpiceTable, SunTable
from ..scene.target import BodyTable
from ..scene.trajectory import FlownPose
from . import bright_bodies as far
from .ground import looked_at

F64 = NDArray[np.float64]


@file_contents.cached_with_contents(maxsize=8)
def _ephemeris(
    sun: SunTable, body: BodyTable, orbit: OrbitTable | None, kernels: SpiceTable
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the Sun's position in J and T_from_J as plain numbers, which the cache can hold."""
    date = sun.julian_date
    own = frames.Rotation(
        pole_ra_deg=body.pole_ra_deg,
        pole_dec_deg=body.pole_dec_deg,
        prime_meridian_deg=body.prime_meridian_deg,
        period_h=body.rotation_period_h,
        prime_meridian_deg_day2=body.prime_meridian_deg_day2,
    ).J_from_T(date)
    sun_J_au = -_orbit(orbit).position_J_au(date)
    if kernels.kernels:
        with under_key("spice.kernels"), spice.kernels(*kernels.kernels):
            et_s = spice.et_s_from_julian_date(date)
            sun_J_au = spice.sun_position_J_au(kernels.target, et_s)
            if kernels.frame:
                own = spice.J_from_T(kernels.frame, et_s)
    return tuple(sun_J_au), tuple(own.T.ravel())


def ephemeris(scene: Scene) -> tuple[F64, F64]:
    """Return the Sun's position relative to the target in J, float64[3] in au, and T_from_J, float64[3, 3].

    If the scene names SPICE kernels, the Sun's position comes from them, else from the two-body `[orbit]` (default:
    that of 67P). T_from_J is the target's own attitude. It comes from the kernels if the scene names a frame in
    them, else from the pole and period in `[body]`. Raises InputError for kernels that lack the data.
    """
    sun_J_au, own = _ephemeris(scene.sun, scene.body, scene.orbit, scene.spice)
    return np.array(sun_J_au), np.array(own).reshape(3, 3)


def _orbit(table: OrbitTable | None) -> frames.Orbit:
    """Return the orbit of a scene's table, by default that of 67P."""
    return frames.ORBIT_67P if table is None else frames.Orbit(**table.model_dump())


def epoch_jd(scene: Scene, site: int, fraction: float) -> float:
    """Return the TDB Julian date at the given fraction in [0, 1] of a site's time on the trajectory."""
    start, end = scene.sun.julian_date, scene.spice.until_julian_date
    return start if end is None else start + (end - start) * (site + fraction) / scene.dataset.sites


@file_contents.cached_with_contents(maxsize=256)
def _spacecraft_pose(table: SpiceTable, julian_date: float) -> spice.SpacecraftState:
    """Return `spacecraft_pose` from the cache, or compute it."""
    axes = None if table.camera_axes is None else np.array(table.camera_axes).reshape(3, 3)
    with under_key("spice.kernels"), spice.kernels(*table.kernels):
        et_s = spice.et_s_from_julian_date(julian_date)
        return spice.pose_T(table.spacecraft, table.target, table.frame, table.camera_frame, et_s, axes)


def spacecraft_pose(scene: Scene, julian_date: float) -> spice.SpacecraftState:
    """Return the pose of the spacecraft's camera from SPICE. Raises InputError if kernels lack the data."""
    return _spacecraft_pose(scene.spice, julian_date)


def trajectory_sites(scene: Scene, body: Body) -> Sites:
    """Return the sites of a scene on a spacecraft's trajectory.

    A site is the ground at the centre of the image, half-way through the time of the site. If the camera looks past
    the body, it is the ground nearest to the line of sight.
    """

    def site(index: int) -> Site:
        pose = spacecraft_pose(scene, epoch_jd(scene, index, 0.5))
        return site_at(body, index, looked_at(body, pose.camera_position_T_m, pose.T_from_C[:, 2]))

    return Sites(scene.dataset.sites, site)


def flown_pose(scene: Scene) -> FlownPose:
    """Return camera and Sun in T from SPICE, at the scene's date. Raises InputError if kernels lack the data."""
    spacecraft = spacecraft_pose(scene, scene.sun.julian_date)
    return FlownPose(
        name=f"spice.spacecraft = {scene.spice.spacecraft!r}",
        julian_date=scene.sun.julian_date,
        camera_position_T_m=spacecraft.camera_position_T_m,
        T_from_C=spacecraft.T_from_C,
        sun_direction_T=sun_direction_T(scene),
        sun_distance_au=sun_distance_au(scene),
    )


def dated(scene: Scene, **values: float) -> Scene:
    """Return a scene with other values of its Sun, such as `julian_date`."""
    return scene.model_copy(update={"sun": scene.sun.model_copy(update=values)})


def sun_direction_T(scene: Scene) -> F64:
    """Return the unit vector from the body to the Sun in T, float64[3], at the scene's date."""
    sun_J_au, T_from_J = ephemeris(scene)
    return np.asarray(T_from_J @ frames.unit(sun_J_au))


def sun_distance_au(scene: Scene) -> float:
    """Return the body's distance from the Sun: as given, or from the ephemeris at the Julian date."""
    if scene.sun.distance_au is not None:
        return scene.sun.distance_au
    return float(np.linalg.norm(ephemeris(scene)[0]))


def wavelengths_nm(scene: Scene) -> F64:
    """Return the band nodes of the scene in nm, float64[band]."""
    r = scene.render
    return spectra.band_nodes_nm(r.band_min_nm, r.band_max_nm, r.bands)


def sunlight(scene: Scene, direction_L: F64) -> Sunlight:
    """Return the sunlight of the scene from a direction in L."""
    distance = sun_distance_au(scene)
    return Sunlight(
        direction_L=direction_L,
        angular_radius_rad=spectra.sun_angular_radius_rad(distance),
        irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(wavelengths_nm(scene), distance),
        limb_darkening=spectra.limb_darkening(wavelengths_nm(scene)) if scene.sun.limb_darkening else None,
    )


def bright_bodies(scene: Scene) -> tuple[far.BrightBody, ...]:
    """Return the bright bodies beside the target that `sky.bodies` lists, at the date of the scene."""
    if not scene.sky.bodies:
        return ()
    sun_J_au, _ = ephemeris(scene)
    return far.bright_bodies(scene.sky.bodies, scene.sun.julian_date, sun_J_au, sun_distance_au(scene))


def target_attitude(scene: Scene, sun_T: F64) -> F64:
    """Return T_from_J of the target under the commanded Sun: the attitude nearest to the body's own at the date."""
    sun_J_au, own = ephemeris(scene)
    return frames.T_from_J_commanded(own, frames.unit(sun_J_au), sun_T)


def attitude_references(scene: Scene) -> tuple[str, str]:
    """Return the references of attitudes ("sun", "nadir" or "centre"): Sun-facing stratum, Sun-averted stratum."""
    if scene.is_flown or scene.is_aimed:  # no bounds of the attitude; it is stored relative to the Sun
        return "sun", "sun"
    facing, averted = redraw.strata(scene)
    return facing.reference, averted.reference
