"""Build the surroundings of the camera that a scene describes: ground, body, spacecraft and stars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site, ellipsoid, load_body
from ..camera import Camera
from ..core import frames, spectra
from ..core.errors import InputError, under_key
from ..core.quantities import Radiance, Truth
from ..reflectance import REFERENCE_NM, BandReflectance, radiance_factor
from ..render.description import View
from ..scene import bodies
from ..scene.config import Scene
from ..scene.surroundings import OrbitTable, PoseTable
from ..scene.target import EARTH, BodyTable
from . import sky
from .coma import check_coma
from .ephemeris import sun_distance_au, wavelengths_nm
from .spacecraft import HingePose, Spacecraft, SpacecraftMesh, default_spacecraft, load_spacecraft
from .surface_map import load_albedo_map

if TYPE_CHECKING:
    from ..render import AlbedoMap, EarthAlbedo, Vehicle

F64 = NDArray[np.float64]

# `stars = "auto"` leaves out stars whose brightest pixel collects less than this fraction of the read noise.
_STAR_OVER_READ_NOISE = 0.1

# Standard deviation of a star that a prescription resamples and blurs. Resampling changes the light of a narrower
# star with its position within a pixel. Measured with 65° across a frame: with 0.6 px the light varies by 1.3 % rms
# half-way to the corner and by 2.6 % at two thirds of the way; with 0 px it varies by 2.8 % and 5.1 %, and at two
# thirds its mean is 15 % higher. A wider star would add to the point spread of the prescription.
_STAR_SIGMA_PX = 0.6

_HIDING_RAYS = 16  # along each side of the frame that tell what the spacecraft hides of it
_MUCH_HIDDEN = 0.5  # fraction of the frame


# --- ground -------------------------------------------------------------------------------------------------


def ground_reflectance(scene: Scene) -> BandReflectance:
    """Return how the scene's ground reflects, at its band nodes."""
    wavelength = wavelengths_nm(scene)
    return scene.body.photometry.at(wavelength, spectra.reflectance(_plain(scene.body.reflectance), wavelength))


def dust_contrast(scene: Scene) -> F64 | None:
    """Return the reflectance of dust-covered over bare ground minus 1, float64[band]; None if they are equal.

    Of regolith: the scale by which its albedo varies, the same in all bands.
    """
    wavelength = wavelengths_nm(scene)
    if scene.patch.regolith is not None:
        scale = scene.patch.regolith.albedo_contrast
        return np.full(len(wavelength), scale) if scale else None
    contrast = scene.body.photometry.contrast_of_dust(wavelength)
    return contrast if np.any(contrast) else None


def normal_albedo(scene: Scene, truth: Truth, vehicle: SpacecraftMesh | None = None) -> NDArray[np.float32]:
    """Return I/F at normal incidence and emission, at the band node nearest to 649 nm, float32[y, x].

    Parameters
    ----------
    scene
        The scene.
    truth
        Truth with the dust cover, which is NaN where there is no surface, and with the factor of a map and the
        spacecraft's materials if there are any.
    vehicle
        The spacecraft with these materials. It is a Lambert surface, so its I/F is its reflectance.
    """
    assert truth.dust is not None
    nodes, band = wavelengths_nm(scene), reference_band(scene)
    contrast = dust_contrast(scene)
    bare = radiance_factor(ground_reflectance(scene), [0, 0, 1], [0, 0, 1])[band, 0]
    dusty = 1 + (0 if contrast is None else contrast[band]) * truth.dust
    ground = np.asarray(bare * dusty, dtype=np.float32)
    if truth.albedo_factor is not None:
        ground = ground * truth.albedo_factor
    if truth.material is None or vehicle is None:
        return ground
    reflectance = vehicle.reflectance(nodes)[:, band].astype(np.float32)
    return np.where(truth.material >= 0, reflectance[truth.material], ground)


def reference_band(scene: Scene) -> int:
    """Return the index of the band node nearest to 649 nm."""
    return int(np.argmin(np.abs(wavelengths_nm(scene) - REFERENCE_NM)))


def render_albedo(scene: Scene, site: Site) -> AlbedoMap | EarthAlbedo | None:
    """Return the renderer's copy of the scene's map of the albedo, or None if it has none. Raises InputError."""
    if scene.body.albedo_map is None:
        return None
    from .. import render

    if scene.body.albedo_map.file == EARTH:
        return render.EarthAlbedo(
            float(np.linalg.norm(site.position_T_m)),
            wavelength_nm=wavelengths_nm(scene),
            reference_band=reference_band(scene),
            T_from_L=site.T_from_L,
            site_T_m=site.position_T_m,
            air_depth=air_depth(scene),
        )
    loaded = load_albedo_map(scene.body.albedo_map)
    return render.AlbedoMap(
        loaded.levels,
        loaded.left_longitude_deg,
        wavelength_nm=wavelengths_nm(scene),
        reference_band=reference_band(scene),
        T_from_L=site.T_from_L,
        site_T_m=site.position_T_m,
    )


def air_depth(scene: Scene) -> F64:
    """Return the optical depth of the body's air straight up, float64[band]; 0 without air."""
    from ..render.atmosphere import rayleigh_depth

    nodes, table = wavelengths_nm(scene), scene.body.atmosphere
    return np.zeros(len(nodes)) if table is None else rayleigh_depth(nodes, table.optical_depth)


def make_body(scene: Scene) -> Body:
    """Return the scene's body. Raises InputError, also for a wrong map of its albedo or a coma it cannot have."""
    body = _body(scene)
    if scene.coma is not None:
        check_coma(scene.coma, body, sun_distance_au(scene))
    return body


def _body(scene: Scene) -> Body:
    """Return the scene's body without a check of its coma."""
    table = scene.body
    if table.albedo_map is not None and table.albedo_map.file != EARTH:
        load_albedo_map(table.albedo_map)  # refused before any sample is rendered
    physical = {
        "density_kg_m3": table.density_kg_m3,
        "rotation_period_s": table.rotation_period_h * 3600,
    }
    if table.shape == "ellipsoid":
        vertices, faces = ellipsoid(table.semi_axes_m, table.relief_m)
        return Body(name=table.name, vertices_m=vertices, faces=faces, **physical)
    volume_m3 = None if table.volume_km3 is None else 1e9 * table.volume_km3
    with under_key("body.shape"):
        return load_body(
            table.shape, unit=table.unit, name=table.name, sharpen=table.sharpen, volume_m3=volume_m3, **physical
        )


# A shape that differs by more than these fractions in volume or longest extent belongs to another body.
_VOLUME_FRACTION, _LENGTH_FRACTION = 0.25, 0.2


def values_of_another_body(scene: Scene, body: Body) -> str:
    """Return one sentence that lists values of the named body in use for another body, or "" if there are none.

    The named body is that of a packaged table, and 67P in all other scenes. A value counts whether the scene sets
    it or leaves its default. The size of the shape model decides whether it is that body.
    """
    table, named = scene.body, bodies.named_body(scene.body.name)
    known = named or bodies.packaged_bodies()[bodies.DEFAULT]
    reference = BodyTable() if named is None else BodyTable.model_validate(named.body)
    length_m = float(np.ptp(body.vertices_m, axis=0).max())
    same_volume = abs(body.volume_m3 * 3 / (4 * np.pi * known.mean_radius_m**3) - 1) <= _VOLUME_FRACTION
    if same_volume and abs(length_m / known.length_m - 1) <= _LENGTH_FRACTION:
        if named is None and table.shape == "embedded" and table.name != reference.name:
            packaged = ", ".join(bodies.packaged_bodies())
            return (
                f"body.name = {table.name!r}: no packaged body ({packaged}), so the body has the shape of 67P and "
                "those of its values that the scene does not give"
            )
        return ""
    keys = ["name"] if named is None else []
    keys += ["density_kg_m3", "rotation_period_h"]
    keys += [] if scene.spice.frame else ["pole_ra_deg", "pole_dec_deg", "prime_meridian_deg"]
    keys += ["reflectance"] if table.photometry.scales_reflectance else []
    # compare values, not whether they were set: a packaged scene of 67P sets them, and its shape may be replaced
    values = [(key, getattr(table, key)) for key in keys if getattr(table, key) == getattr(reference, key)]
    assumed = [f"body.{key}{_short(value)}" for key, value in values]
    if named is not None:
        assumed += ["[body.photometry]"] if table.photometry == reference.photometry else []
    else:
        of_67p = table.photometry.keys_of_67p
        assumed += [f"body.photometry.{key} = {getattr(table.photometry, key)!r}" for key in of_67p]
    # if the scene or its table of poses gives a distance, the orbit only rotates the stars
    has_table = scene.trajectory is not None and not scene.trajectory.flight
    has_distance = scene.sun.distance_au is not None or has_table
    own_orbit = None if known.orbit is None else OrbitTable.model_validate(known.orbit)
    if scene.orbit == own_orbit and not scene.spice.kernels and not has_distance:
        assumed.append("[orbit]")
    if not assumed:
        return ""
    size = f"{body.volume_m3 * 1e-9:.3g} km³ and is {length_m * 1e-3:.3g} km long"
    return (
        f"body.shape = {Path(table.shape).name!r} has {size}: not {known.name.split('/')[0]}, whose values it has "
        f"for {', '.join(assumed)}; give the body's own"
    )


def _short(value: object) -> str:
    """Return " = value" for a message, or "" for a table."""
    if isinstance(value, str | float):
        return f" = {value:.6g}" if isinstance(value, float) else f" = {value!r}"
    return ""


# --- spacecraft ---------------------------------------------------------------------------------------------


def spacecraft(scene: Scene) -> SpacecraftMesh | None:
    """Return the spacecraft that carries the camera, in B, or None if the scene has none. Raises InputError."""
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
    roll, pitch, yaw = np.radians([table.roll_deg, table.pitch_deg, table.yaw_deg])
    with under_key("spacecraft.model"):
        vehicle = load_spacecraft(
            Path(table.model),
            unit=table.unit,
            B_from_V=frames.rx(roll) @ frames.ry(pitch) @ frames.rz(yaw),
            translation_B_m=table.translation_m,
            materials={name: _plain(value) for name, value in table.materials.items()},
            poses={name: _pose(name, t, None) for name, t in table.pose.items()},
            default_material=_plain(table.default_material),
        )
        mesh = vehicle.merged()
        if hidden_fraction(scene, mesh) == 1.0:
            alone = [
                p.name for p in vehicle.parts if hidden_fraction(scene, Spacecraft(parts=(p,)).merged()) == 1.0
            ]
            named = f" (its part {alone[0]!r} alone does)" if alone else ""
            raise InputError(
                f"{Path(table.model).name}: hides the whole frame{named}: the camera, at the origin of B, is in "
                "the model or looks at its back; move the model with spacecraft.translation_m, turn it with "
                "spacecraft.yaw_deg, pitch_deg and roll_deg, or leave out the parts around the camera"
            )
        return mesh


def hidden_fraction(scene: Scene, mesh: SpacecraftMesh) -> float:
    """Return the fraction of the camera's frame that a spacecraft hides."""
    camera = scene.camera
    return mesh.blocked_fraction(camera.fov_deg, _HIDING_RAYS, camera.height_px / camera.width_px)


def much_hidden(scene: Scene, mesh: SpacecraftMesh | None) -> str:
    """Return a sentence if the spacecraft hides more than half of the frame, else an empty one."""
    fraction = 0.0 if mesh is None else hidden_fraction(scene, mesh)
    if fraction <= _MUCH_HIDDEN:
        return ""
    return (
        f"spacecraft.model = {Path(scene.spacecraft.model).name!r}: hides {100 * fraction:.0f} % of the frame; if "
        "the camera shall see more, move the model with spacecraft.translation_m, or turn it"
    )


def _plain(material: object) -> Any:
    """Return a material as plain data."""
    return material.model_dump() if hasattr(material, "model_dump") else material


def _pose(name: str, table: PoseTable, vehicle: Spacecraft | None) -> HingePose:
    """Return the turn of a joint. Raises InputError if hinge or axis is missing."""
    hinge = None if vehicle is None else vehicle.hinges[name]
    hinge_m = table.hinge_m or (hinge.hinge_B_m if hinge else None)
    axis = table.axis or (hinge.axis_B if hinge else None)
    if hinge_m is None or axis is None:
        raise InputError(f"spacecraft.pose.{name}: hinge_m and axis are missing")
    return HingePose(hinge_B_m=hinge_m, axis_B=axis, angle_deg=table.angle_deg)


def render_vehicle(scene: Scene, mesh: SpacecraftMesh | None) -> Vehicle | None:
    """Return the renderer's copy of the spacecraft, if there is one."""
    from .. import render

    if mesh is None:
        return None
    return render.Vehicle(
        mesh.vertices_B_m, mesh.faces, mesh.face_material, mesh.reflectance(wavelengths_nm(scene))
    )


# --- stars --------------------------------------------------------------------------------------------------


def visible_stars(
    scene: Scene,
    radiance: Radiance,
    camera: Camera,
    J_from_C: Sequence[F64],
    open_sky: NDArray[np.bool_],
    view: View | None = None,
    turn_per_px: F64 | None = None,
) -> sky.StarRadiance | None:
    """Return the stars that the scene asks for and the exposure can show; None if there are none.

    Parameters
    ----------
    scene
        The scene.
    radiance
        Radiance without stars.
    camera
        The camera with its exposure.
    J_from_C
        Camera axes in J, float64[3, 3], at one or more times that share the exposure.
    open_sky
        Pixels that see neither a body nor the Sun, bool[y, x].
    view
        Grid of the radiance, if it is not the camera's frame.
    turn_per_px
        As in `sky.SkyFrame`.

    A lens with a point spread blurs the stars itself. For it they are drawn with `_STAR_SIGMA_PX`, whatever
    `sky.sigma_px` is. A lens that is focused on something near makes discs of them.
    """
    if scene.sky.stars == "off" or not open_sky.any():
        return None
    sigma_px = _STAR_SIGMA_PX if camera.lens.blurs else scene.sky.sigma_px
    grid = camera if view is None else view
    blur_px = camera.lens.aperture_radius_m / camera.lens.focus_distance_m * float(grid.intrinsics[0])
    faintest = _faintest_star(scene, camera, radiance.wavelength_nm, float(np.hypot(sigma_px, blur_px / 2)))
    if faintest < sky.BRIGHTEST_V:
        return None
    catalogue = sky.load_catalogue().brighter_than(faintest)
    at_times = [
        sky.star_radiance(
            catalogue,
            sky.SkyFrame(
                J_from_C=attitude,
                intrinsics=grid.intrinsics,
                width_px=grid.width_px,
                height_px=grid.height_px,
                projection=camera.lens.calibration,
                turn_per_px=turn_per_px,
            ),
            wavelength_nm=radiance.wavelength_nm,
            sigma_px=sigma_px,
            blur_px=blur_px,
            julian_date=scene.sun.julian_date,
            sky=open_sky,
            lens_falloff=camera.lens.falls_off,
        )
        for attitude in J_from_C
    ]
    stars = sky.StarRadiance.mean(at_times, grid.width_px)
    return stars if len(stars.rows) else None


def _faintest_star(scene: Scene, camera: Camera, wavelength_nm: F64, sigma_px: float) -> float:
    """Return the magnitude of the faintest star to draw: the scene's limit, or that of the exposure for "auto"."""
    limit = scene.sky.limiting_magnitude
    if scene.sky.stars != "auto":
        return limit
    lens, detector = camera.lens, camera.detector
    visible = sky.limiting_magnitude(
        electron_rate_weights=detector.electron_rate_weights(wavelength_nm),
        wavelength_nm=wavelength_nm,
        irradiance_per_radiance=np.pi * lens.transmission / (4 * lens.f_number**2),
        focal_length_px=camera.focal_length_px,
        exposure_s=camera.exposure_s,
        sigma_px=sigma_px,
        threshold_e=_STAR_OVER_READ_NOISE * max(detector.read_noise_e_rms, 1.0),
    )
    return min(limit, visible)
