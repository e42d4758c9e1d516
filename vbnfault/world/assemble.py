"""What a scene file stands for: its Sun and ephemeris, ground, body, camera, spacecraft and stars, as objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import camera as cameras
from ..body import Body, Site, Sites, load_body, site_at
from ..camera import Camera
from ..core import frames, photometry, resources, spectra, spice
from ..core.errors import InputError
from ..core.photometry import Photometry
from ..core.quantities import Radiance
from ..detector import Detector, MosaicDetector, Sensor, load_sensor
from ..lens import RealLens, ThinLens, closed_to, coating, load_lens, scaled_to_focal_length
from ..render.description import Sunlight, View
from ..scene import config
from ..scene.config import BodyTable, CameraTable, OrbitTable, PoseTable, Scene, SpiceTable, SunTable
from . import sky
from .spacecraft import HingePose, ModelPlacement, Spacecraft, SpacecraftMesh, default_spacecraft, load_spacecraft

if TYPE_CHECKING:
    from ..render import Vehicle

F64 = NDArray[np.float64]

# Stars whose brightest pixel collects less than this share of the read noise are left out by `stars = "auto"`.
_STAR_OVER_READ_NOISE = 0.1

# Narrower, a star's light would depend on its place among the pixels that a lens resamples: 1 % at this deviation.
_STAR_SIGMA_PX = 0.6


# --- Sun and ephemeris --------------------------------------------------------------------------------------


@resources.cached_with_contents(maxsize=8)
def _ephemeris(
    sun: SunTable, body: BodyTable, orbit: OrbitTable | None, kernels: SpiceTable
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    date = sun.julian_date
    own = frames.Rotation(
        pole_ra_deg=body.pole_ra_deg,
        pole_dec_deg=body.pole_dec_deg,
        prime_meridian_deg=body.prime_meridian_deg,
        period_h=body.rotation_period_h,
    ).J_from_T(date)
    sun_J_au = -_orbit(orbit).position_J_au(date)
    if kernels.kernels:
        with spice.kernels(*kernels.kernels):
            et_s = spice.et_s_from_julian_date(date)
            sun_J_au = spice.sun_position_J_au(kernels.target, et_s)
            if kernels.frame:
                own = spice.J_from_T(kernels.frame, et_s)
    return tuple(sun_J_au), tuple(own.T.ravel())


def ephemeris(scene: Scene) -> tuple[F64, F64]:
    """The Sun seen from the target in J, float64[3] in au, and the target's own T_from_J, float64[3, 3].

    From SPICE kernels where the scene names some, else from the two-body `[orbit]` (67P's by default) and the pole
    and period of `[body]`. Raises InputError for kernels that do not serve.
    """
    sun_J_au, own = _ephemeris(scene.sun, scene.body, scene.orbit, scene.spice)
    return np.array(sun_J_au), np.array(own).reshape(3, 3)


def _orbit(table: OrbitTable | None) -> frames.Orbit:
    return frames.ORBIT_67P if table is None else frames.Orbit(**table.model_dump())


def epoch_jd(scene: Scene, site: int, share: float) -> float:
    """TDB Julian date at that share, 0 to 1, of the time that a site has on the spacecraft's way."""
    start, end = scene.sun.julian_date, scene.spice.until_julian_date
    return start if end is None else start + (end - start) * (site + share) / scene.dataset.sites


@resources.cached_with_contents(maxsize=256)
def _spacecraft_pose(table: SpiceTable, julian_date: float) -> spice.SpacecraftState:
    axes = None if table.camera_axes is None else np.array(table.camera_axes).reshape(3, 3)
    with spice.kernels(*table.kernels):
        et_s = spice.et_s_from_julian_date(julian_date)
        return spice.pose_T(table.spacecraft, table.target, table.frame, table.camera_frame, et_s, axes)


def spacecraft_pose(scene: Scene, julian_date: float) -> spice.SpacecraftState:
    """Where SPICE has the scene's spacecraft and its camera. Raises InputError for kernels that do not serve."""
    return _spacecraft_pose(scene.spice, julian_date)


def way_sites(scene: Scene, body: Body) -> Sites:
    """Return the sites of a scene on a spacecraft's trajectory: the ground in the middle of the image, half-way
    through each site's time; where the camera looks past the body, the ground nearest to the line of sight."""

    def site(index: int) -> Site:
        pose = spacecraft_pose(scene, epoch_jd(scene, index, 0.5))
        return site_at(body, index, looked_at(body, pose.camera_position_T_m, pose.T_from_C[:, 2]))

    return Sites(scene.dataset.sites, site)


def looked_at(body: Body, origin_T_m: F64, direction_T: F64) -> F64:
    """Where a ray first meets the body's shape model, float64[3] metres in T; else the vertex nearest to it."""
    a, b, c = (body.vertices_m[body.faces[:, k]] - origin_T_m for k in range(3))
    normal = np.cross(b - a, c - a)
    turn = np.stack([np.cross(p, q) @ direction_T for p, q in ((a, b), (b, c), (c, a))])
    facing = normal @ direction_T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.einsum("ni,ni->n", a, normal) / facing
    hit = ((turn >= 0).all(axis=0) | (turn <= 0).all(axis=0)) & (distance > 0)
    if hit.any():
        return np.asarray(origin_T_m + distance[hit].min() * direction_T)
    away = body.vertices_m - origin_T_m
    along = np.maximum(away @ direction_T, 0)
    return np.asarray(body.vertices_m[np.argmin(np.linalg.norm(away - along[:, None] * direction_T, axis=1))])


def sun_distance_au(scene: Scene) -> float:
    """The body's distance from the Sun: as given, or by the ephemeris at the Julian date."""
    if scene.sun.distance_au is not None:
        return scene.sun.distance_au
    return float(np.linalg.norm(ephemeris(scene)[0]))


def sunlight(scene: Scene, direction_L: F64) -> Sunlight:
    """The Sun at the scene's distance in a direction of L."""
    distance = sun_distance_au(scene)
    return Sunlight(
        direction_L=direction_L,
        angular_radius_rad=spectra.sun_angular_radius_rad(distance),
        irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(wavelengths_nm(scene), distance),
        limb_darkening=spectra.limb_darkening(wavelengths_nm(scene)) if scene.sun.limb_darkening else None,
    )


def target_attitude(scene: Scene, sun_T: F64) -> F64:
    """T_from_J of the target under the commanded Sun: the attitude nearest to the body's own at the date."""
    sun_J_au, own = ephemeris(scene)
    return frames.T_from_J_commanded(own, frames.unit(sun_J_au), sun_T)


def attitude_references(scene: Scene) -> tuple[str, str]:
    """Return what attitudes count from in the Sun-facing and the Sun-averted stratum, "sun" or "nadir"."""
    if scene.spice.spacecraft:  # the attitude is that of the kernels, expressed from the Sun
        return "sun", "sun"
    facing, averted = scene.geometry.sun_facing, scene.geometry.sun_averted
    assert facing is not None
    assert averted is not None
    return facing.reference, averted.reference


# --- ground -------------------------------------------------------------------------------------------------


def wavelengths_nm(scene: Scene) -> F64:
    """Band nodes of the scene."""
    r = scene.render
    return spectra.band_nodes_nm(r.band_min_nm, r.band_max_nm, r.bands)


def photometric_model(scene: Scene) -> Photometry:
    """How the scene's ground reflects, at its band nodes."""
    table, wavelength = scene.body.photometry, wavelengths_nm(scene)
    if table.model == "hapke":
        rows = table.parameters if table.hapke is None else table.rows()
        return photometry.hapke_at(wavelength, rows)
    return photometry.Diffuse(
        reflectance=spectra.reflectance(_plain(scene.body.reflectance), wavelength),
        disc=table.model,
        phase_slope_mag_deg=table.phase_slope_mag_deg,
    )


def dust_contrast(scene: Scene) -> F64 | None:
    """Reflectance of dust-covered over bare ground, minus 1, float64[band]; None where they are alike."""
    table, wavelength = scene.body.photometry, wavelengths_nm(scene)
    slope = table.dust_slope_per_100nm * (wavelength - photometry.REFERENCE_NM) / 100
    contrast = (1 + table.dust_contrast) * (1 + slope) - 1
    return contrast if np.any(contrast) else None


def normal_albedo(
    scene: Scene,
    dust: NDArray[np.float32],
    material: NDArray[np.int32] | None = None,
    vehicle: SpacecraftMesh | None = None,
) -> NDArray[np.float32]:
    """Return I/F at normal incidence and emission, at the band node nearest to 649 nm, float32 like `dust`.

    Parameters
    ----------
    dust
        How far the ground is covered, in [0, 1]; NaN where there is nothing.
    material
        The spacecraft's material in each place, -1 where that is none: a Lambert surface, whose I/F is its
        reflectance. Default: none anywhere.
    vehicle
        The spacecraft with these materials.
    """
    nodes = wavelengths_nm(scene)
    band = int(np.argmin(np.abs(nodes - photometry.REFERENCE_NM)))
    contrast = dust_contrast(scene)
    bare = photometry.radiance_factor(photometric_model(scene), [0, 0, 1], [0, 0, 1])[band, 0]
    ground = np.asarray(bare * (1 + (0 if contrast is None else contrast[band]) * dust), dtype=np.float32)
    if material is None or vehicle is None:
        return ground
    reflectance = vehicle.reflectance(nodes)[:, band].astype(np.float32)
    return np.where(material >= 0, reflectance[material], ground)


def make_body(scene: Scene) -> Body:
    """The scene's body. Raises InputError."""
    table = scene.body
    physical = {
        "density_kg_m3": table.density_kg_m3,
        "rotation_period_s": table.rotation_period_h * 3600,
    }
    if table.shape == "ellipsoid":
        vertices, faces = ellipsoid(table.semi_axes_m)
        return Body(name=table.name, vertices_m=vertices, faces=faces, **physical)
    return load_body(table.shape, unit=table.unit, name=table.name, **physical)


# 67P: volume, and length of its longest extent (Preusker et al. 2015, A&A 583, A33); a shape that differs by more
# than these shares is another body's.
_67P_VOLUME_M3, _67P_LENGTH_M = 18.7e9, 5.0e3
_VOLUME_SHARE, _LENGTH_SHARE = 0.25, 0.2


def assumed_of_67p(scene: Scene, body: Body) -> str:
    """Return one sentence on the values of 67P that a body of another size has, left in place or set, or ""."""
    length_m = float(np.ptp(body.vertices_m, axis=0).max())
    if (
        abs(body.volume_m3 / _67P_VOLUME_M3 - 1) <= _VOLUME_SHARE
        and abs(length_m / _67P_LENGTH_M - 1) <= _LENGTH_SHARE
    ):
        return ""
    table = scene.body
    keys = ["name", "density_kg_m3", "rotation_period_h"]
    keys += [] if scene.spice.frame else ["pole_ra_deg", "pole_dec_deg", "prime_meridian_deg"]
    keys += [] if table.photometry.model == "hapke" else ["reflectance"]
    # not by what was left unset: a packaged scene of 67P whose shape is replaced says its values itself
    values = [
        (key, getattr(table, key)) for key in keys if getattr(table, key) == BodyTable.model_fields[key].default
    ]
    assumed = [f"body.{key} = {v:.6g}" if isinstance(v, float) else f"body.{key} = {v!r}" for key, v in values]
    if table.photometry.model == "hapke" and table.photometry.hapke is None:
        assumed.append(f"body.photometry.parameters = {table.photometry.parameters!r}")
    # with a distance of its own the orbit only turns the stars
    if scene.orbit is None and not scene.spice.kernels and scene.sun.distance_au is None:
        assumed.append("[orbit]")
    if not assumed:
        return ""
    return (
        f"body.shape = {Path(table.shape).name!r} has {body.volume_m3 * 1e-9:.3g} km³ and is {length_m * 1e-3:.3g} "
        f"km long: not 67P, whose values it has for {', '.join(assumed)}; give the body's own"
    )


def ellipsoid(semi_axes_m: tuple[float, float, float]) -> tuple[F64, NDArray[np.int32]]:
    """A triaxial ellipsoid as a closed mesh of 82,000 triangles: vertices float64[n, 3] in m, faces int32."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=6)
    return np.asarray(sphere.vertices) * np.array(semi_axes_m), np.asarray(sphere.faces, dtype=np.int32)


# --- camera and spacecraft ----------------------------------------------------------------------------------


def base_camera(scene: Scene, *, architecture: int = 0, readout_direction: int = 0, individual: int = 0) -> Camera:
    """The scene's camera without exposure; the integers index its lists of options."""
    c = scene.camera
    direction = c.readout_directions[readout_direction]
    if c.detector:
        sensor = mosaic_sensor(c)
        detector: Detector | MosaicDetector = _detector_of(scene, sensor, individual, direction)
        pitch_um, which = sensor.pixel_pitch_um, sensor.architecture
    else:
        detector, pitch_um, which = _three_colours(c), c.pixel_pitch_um, c.architectures[architecture]
    return Camera(
        lens=real_lens(c, pitch_um) if c.lens else _thin_lens(c, pitch_um),
        detector=detector,
        architecture=which,
        readout_direction=direction,
    )


def _three_colours(c: CameraTable) -> Detector:
    return Detector(
        width_px=c.width_px,
        height_px=c.height_px,
        pixel_pitch_um=c.pixel_pitch_um,
        full_well_e=c.full_well_e,
        read_noise_e_rms=c.read_noise_e_rms,
        dark_current_e_s=c.dark_current_e_s,
        adc_bits=c.adc_bits,
        bias_dn=c.bias_dn,
        response=c.response,
        quantum_efficiency_peak=c.quantum_efficiency_peak,
    )


@resources.cached_with_contents(maxsize=4)
def mosaic_sensor(c: CameraTable) -> Sensor:
    """The sensor that a camera names, at the camera's temperature. Raises InputError."""
    try:
        sensor = load_sensor(c.detector)
    except InputError as error:
        raise InputError(f"camera.detector: {error}") from None
    if c.detector_temperature_K is not None:
        sensor = replace(sensor, temperature_K=c.detector_temperature_K)
    return sensor


def _detector_of(scene: Scene, sensor: Sensor, individual: int, direction: str) -> MosaicDetector:
    # CCDs are read towards an end of their columns
    towards = direction if direction in ("up", "down") else "up"
    seed = int(config.rng(scene.dataset.seed, individual, "detector", "device").integers(2**31))
    try:
        made = MosaicDetector(
            sensor=sensor,
            seed=seed,
            width_px=scene.camera.width_px,
            height_px=scene.camera.height_px,
            direction=towards,
        )
    except InputError as error:
        raise InputError(f"camera.detector: {error}") from None
    for channel, row in zip(made.channels, made.electron_rate_weights(wavelengths_nm(scene)), strict=True):
        if not row.any():
            low, high = scene.render.band_min_nm, scene.render.band_max_nm
            raise InputError(
                f"render.band_min_nm = {low:g}, band_max_nm = {high:g}: the {channel} pixels of camera.detector = "
                f"{scene.camera.detector!r} see no such light"
            )
    return made


def _focus_distance_m(c: CameraTable) -> float:
    return float("inf") if c.focus_distance_m is None else c.focus_distance_m


def _thin_lens(c: CameraTable, pixel_pitch_um: float) -> ThinLens:
    return ThinLens(
        focal_length_mm=cameras.focal_length_mm(c.fov_deg, c.width_px, pixel_pitch_um),
        f_number=config.THIN_LENS["f_number"] if c.f_number is None else c.f_number,
        transmission=config.THIN_LENS["transmission"] if c.transmission is None else c.transmission,
        focus_distance_m=_focus_distance_m(c),
    )


@resources.cached_with_contents(maxsize=4)
def real_lens(c: CameraTable, pixel_pitch_um: float) -> RealLens:
    """Return the prescription that a camera names, scaled to its field of view and closed to its f-number.

    Raises InputError for a file that is no lens, and for an f-number that it does not reach.
    """
    try:
        prescription = load_lens(c.lens)
    except InputError as error:
        raise InputError(f"camera.lens: {error}") from None
    if c.lens_coating:
        if c.lens_coating not in coating.NAMES:
            known = ", ".join(coating.NAMES)
            raise InputError(f"camera.lens_coating = {c.lens_coating!r}: must be one of {known}")
        prescription = prescription.coated(c.lens_coating)
    focal_length_mm = cameras.focal_length_mm(c.fov_deg, c.width_px, pixel_pitch_um)
    prescription = scaled_to_focal_length(prescription, focal_length_mm)
    if c.f_number is not None:
        prescription = closed_to(prescription, c.f_number, "camera.f_number")
    return RealLens(
        prescription=prescription,
        width_px=c.width_px,
        height_px=c.height_px,
        pixel_pitch_um=pixel_pitch_um,
        focus=c.focus,
        focus_distance_m=_focus_distance_m(c),
    )


def spacecraft(scene: Scene) -> SpacecraftMesh | None:
    """The vehicle that carries the camera, in B; None where the scene has none. Raises InputError."""
    table = scene.spacecraft
    if table.model == "none":
        return None
    if table.model == "default":
        vehicle = default_spacecraft()
        unknown = sorted(set(table.pose) - set(vehicle.hinges))
        if unknown:
            known = ", ".join(vehicle.hinges)
            raise InputError(f"spacecraft.pose.{unknown[0]}: the default vehicle has no such joint; it has {known}")
        return vehicle.posed({name: _pose(name, t, vehicle) for name, t in table.pose.items()}).merged()
    return load_spacecraft(
        Path(table.model),
        unit=table.unit,
        placement=ModelPlacement(
            roll_deg=table.roll_deg,
            pitch_deg=table.pitch_deg,
            yaw_deg=table.yaw_deg,
            translation_B_m=table.translation_m,
        ),
        materials={name: _plain(value) for name, value in table.materials.items()},
        poses={name: _pose(name, t, None) for name, t in table.pose.items()},
        default_material=_plain(table.default_material),
    ).merged()


def _plain(material: object) -> Any:
    return material.model_dump() if hasattr(material, "model_dump") else material


def _pose(name: str, table: PoseTable, vehicle: Spacecraft | None) -> HingePose:
    hinge = None if vehicle is None else vehicle.hinges[name]
    at = table.hinge_m or (hinge.hinge_B_m if hinge else None)
    axis = table.axis or (hinge.axis_B if hinge else None)
    if at is None or axis is None:
        raise InputError(f"spacecraft.pose.{name}: hinge_m and axis are missing")
    return HingePose(hinge_B_m=at, axis_B=axis, angle_deg=table.angle_deg)


def render_vehicle(scene: Scene, mesh: SpacecraftMesh) -> Vehicle:
    """The renderer's copy of the spacecraft."""
    from .. import render

    return render.Vehicle(
        mesh.vertices_B_m, mesh.faces, mesh.face_material, mesh.reflectance(wavelengths_nm(scene))
    )


# --- stars --------------------------------------------------------------------------------------------------


def with_stars(
    scene: Scene,
    radiance: Radiance,
    camera: Camera,
    J_from_C: F64,
    open_sky: NDArray[np.bool_],
    view: View | None = None,
) -> Radiance:
    """The radiance with the stars that the scene asks for and the exposure can show.

    `camera` has its exposure; `open_sky` bool[y, x]: pixels that see neither a body nor the Sun; `view`: the grid
    of the radiance where it is not the camera's frame. A prescription blurs the stars itself: they then come to it
    as small as a grid can hold them in place.
    """
    table = scene.sky
    if table.stars == "off" or not open_sky.any():
        return radiance
    lens = camera.lens
    real = isinstance(lens, RealLens)
    sigma_px = min(table.sigma_px, _STAR_SIGMA_PX) if real else table.sigma_px
    faintest = table.limiting_magnitude
    if table.stars == "auto":
        faintest = min(
            faintest,
            sky.limiting_magnitude(
                electron_rate_weights=camera.detector.electron_rate_weights(radiance.wavelength_nm),
                wavelength_nm=radiance.wavelength_nm,
                irradiance_per_radiance=np.pi * lens.transmission / (4 * lens.f_number**2),
                focal_length_px=camera.focal_length_px,
                exposure_s=camera.exposure_s,
                sigma_px=sigma_px,
                threshold_e=_STAR_OVER_READ_NOISE * max(camera.detector.read_noise_e_rms, 1.0),
            ),
        )
    if faintest < sky.BRIGHTEST_V:
        return radiance
    stars = sky.star_radiance(
        sky.load_catalogue().brighter_than(faintest),
        J_from_C=J_from_C,
        intrinsics=camera.intrinsics if view is None else view.intrinsics,
        width_px=camera.width_px if view is None else view.width_px,
        height_px=camera.height_px if view is None else view.height_px,
        wavelength_nm=radiance.wavelength_nm,
        sigma_px=sigma_px,
        julian_date=scene.sun.julian_date,
        sky=open_sky,
        lens_falloff=real,
    )
    return stars.added_to(radiance)
