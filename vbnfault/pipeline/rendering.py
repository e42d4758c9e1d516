"""Render the view of a sample: the radiance of every band, and the truth layers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core import spectra
from ..core.calibration import Calibration
from ..core.quantities import BODY, SKY, FarSource, FineLight, Radiance, Truth
from ..core.sundisc import Projection, forward
from ..lens.straylight.scene import RenderGrid, surrounding_grids
from ..render.description import RenderInput, View
from ..world import assemble, ephemeris
from .coma import add_coma
from .motion import motion_of
from .noise_budget import SampledRadiance, green_per_second, sample_to_noise
from .spec import Pose, Rendering, SampleSpec, SceneLight

if TYPE_CHECKING:
    from ..render import CloseUp

_SURROUNDING_SAMPLES = 4  # of each pixel of the coarse renders around a view
_SAMPLES_TO_NOISE = 64  # of each pixel of a close-up where the sensor's noise limits that of sampling
_LEAST_RAD = 1e-7  # of a disc whose visible fraction is computed
# layers of truth that need the angles of the light
ANGLE_LAYERS = {"incidence_deg", "emission_deg", "phase_deg", "albedo"}


def describe(spec: SampleSpec, pose: Pose) -> RenderInput:
    """Return the view of a sample as the renderer's input."""
    scene, camera = spec.scene, spec.camera
    guard_x, guard_y = camera.lens.guard_px
    view = View(
        position_L_m=pose.position_L_m,
        L_from_C=pose.L_from_C,
        intrinsics=camera.intrinsics + np.array([0, 0, guard_x, guard_y]),
        width_px=camera.width_px + 2 * guard_x,
        height_px=camera.height_px + 2 * guard_y,
        aperture_radius_m=camera.lens.aperture_radius_m,
        focus_distance_m=camera.lens.focus_distance_m,
        projection=camera.lens.calibration,
        motion=motion_of(spec),
    )
    return RenderInput(
        view=view,
        sun=ephemeris.sunlight(scene, pose.sun_L),
        wavelength_nm=ephemeris.wavelengths_nm(scene),
        reflectance=assemble.ground_reflectance(scene),
        dust_contrast=assemble.dust_contrast(scene),
        bounces=scene.render.bounces,
        samples_per_pixel=scene.render.samples_per_pixel,
        key=int(spec.rng("render", "jitter").integers(2**32)),
    )


def render_view(spec: SampleSpec, pose: Pose) -> Rendering:
    """Render the radiance of every band, and the truth layers.

    With a lens prescription it renders a pinhole's image with a guard band around it, which the lens distorts. A
    calibrated camera is rendered with its own rays. Truth follows the rays of the pixel centres. A body of few
    pixels is rendered in a close-up.
    """
    from .. import render

    camera, scene, surface = spec.camera, describe(spec, pose), spec.terrain.surface
    stars = spec.scene.sky.stars != "off"
    has_coma = spec.scene.coma is not None
    has_air = spec.scene.body.atmosphere is not None
    truth = seen_truth(spec, scene)
    guide: Truth | None = truth
    if camera.lens.resamples:  # bounces, stars, a coma and air need truth on the grid of the render
        needed = scene.bounces or stars or has_coma or has_air
        guide = render.truth(surface, scene.view, scene.sun) if needed else None
    body = body_of_few_pixels(spec, pose, scene)
    shown = scene if body is None else replace(scene, shows_ground=False)
    fraction = spec.scene.render.noise_fraction
    if fraction is None and scene.view.motion is not None:
        fraction = math.inf  # one round of samples, whose cells are kept
    if fraction is None:
        image = render.radiance(surface, shown, guide, None if body is None else body.light)
        sampled = SampledRadiance(radiance=image, samples_per_pixel=float(scene.samples_per_pixel))
    else:
        extra = None if body is None else (body.light, body.error)
        sampled = sample_to_noise(spec, shown, truth, guide, fraction, extra)
    rendered = sampled.radiance
    if has_air and guide is not None and body is None:
        rendered = add_atmosphere(spec, scene, guide, rendered)
    if has_coma and guide is not None:
        rendered = add_coma(spec, pose, scene, surface, guide, rendered, None if body is None else body.near)
    return Rendering(
        scene=scene,
        light=SceneLight(lens=camera.lens, rendered=rendered),
        truth=truth if body is None else with_body(truth, body, camera.projection),
        open_sky=guide.semantic == SKY if stars and guide is not None else None,
        samples_per_pixel=sampled.samples_per_pixel,
        noise_fraction_p99=math.nan if fraction == math.inf else sampled.noise_fraction_p99,
        cells=sampled.cells,
        direct=sampled.direct,
        shows_ground=body is None,
        surroundings=surroundings(spec, scene),
        far_sources=far_sources(spec, pose),
    )


def seen_truth(spec: SampleSpec, scene: RenderInput) -> Truth:
    """Return truth at the chief rays of the image's pixel centres, without a body of few pixels."""
    from .. import render

    camera, angles = spec.camera, bool(ANGLE_LAYERS & set(spec.scene.dataset.layers))
    is_distorted = camera.lens.resamples or camera.lens.calibration is not None
    lens: dict[str, Any] = (
        {"directions": camera.seen_directions, "projection": camera.projection} if is_distorted else {}
    )
    truth = render.truth(spec.terrain.surface, scene.view, scene.sun, angles=angles, **lens)
    calibration = camera.lens.calibration
    return truth if calibration is None else _in_circle(truth, calibration, camera.seen_directions)


def _in_circle(truth: Truth, calibration: Calibration, directions: NDArray[np.float64]) -> Truth:
    """Return truth that has the sky where no light reaches the frame, beyond the image circle."""
    dark = ~calibration.is_lit(directions)
    if not dark.any():
        return truth
    sky = {"depth_m": np.inf, "normal": 0, "semantic": SKY, "material": -1}
    arrays = {}
    for name, values in vars(truth).items():
        if values is not None:
            arrays[name] = values.copy()
            arrays[name][dark] = sky.get(name, np.nan)
    return replace(truth, **arrays)


@dataclass(frozen=True, kw_only=True, eq=False)
class FewPixels:
    """Hold what a close-up shows of a body of few pixels.

    Attributes
    ----------
    near
        The close-up.
    light
        The light of the body in the frame.
    error
        float32[y, x]: error of the light's signal in the frame, as in `Sampled`; zeros if it is not asked for.
    truth
        Truth in the close-up.
    """

    near: CloseUp
    light: FineLight
    error: NDArray[np.float32]
    truth: Truth


def body_of_few_pixels(spec: SampleSpec, pose: Pose, scene: RenderInput) -> FewPixels | None:
    """Return the body in a close-up, with its air and the dust in front of it; None if the body is wider."""
    from .. import render

    if scene.view.projection is not None and spec.scene.coma is not None:
        return None  # the dust around a close-up is known on the grid of a pinhole only
    air = spec.scene.body.atmosphere
    near = render.close_up(
        spec.terrain.surface, scene.view, 0.0 if air is None else render.TOP_SCALE_HEIGHTS * air.scale_height_m
    )
    if near is None:
        return None
    seen = near.seen_in(scene)
    error = np.zeros((scene.view.height_px, scene.view.width_px), np.float32)
    truth = render.truth(
        near.ground, seen.view, seen.sun, angles=bool(ANGLE_LAYERS & set(spec.scene.dataset.layers))
    )
    if spec.scene.render.noise_fraction is None:
        light = render.radiance(near.ground, seen, truth)
    else:
        seen = replace(seen, samples_per_pixel=max(seen.samples_per_pixel, _SAMPLES_TO_NOISE))
        sampled = render.direct_by_sample(near.ground, seen, green_per_second(spec))
        light, halves = sampled.radiance, sampled.radiance.with_array(sampled.error[None])
        error = near.light(halves).added_to(error[None])[0]
        if scene.bounces:
            light = light.with_array(light.array + render.indirect(near.ground, seen, truth))
    if air is not None:
        light = add_atmosphere(spec, seen, truth, light)
    if spec.scene.coma is not None:
        light = add_coma(spec, pose, seen, near.ground, truth, light)
    return FewPixels(near=near, light=near.light(light), error=error, truth=truth)


def with_body(truth: Truth, body: FewPixels, projection: Projection) -> Truth:
    """Return truth in which a body smaller than a pixel has the pixel in which its middle is visible.

    That pixel has the depth, the normal and the angles of the middle.
    """
    near = body.near
    row, column = np.nonzero((body.truth.semantic == BODY) & near.unhidden)
    if near.size_px >= 1 or not len(row):
        return truth
    k = np.argmin((row - row.mean()) ** 2 + (column - column.mean()) ** 2)
    x, y = np.floor(projection.pixel_of(forward(near.slopes[row[k], column[k]]))).astype(int)
    height, width = truth.semantic.shape
    if not (0 <= x < width and 0 <= y < height):
        return truth
    arrays = {}
    for name, values in vars(truth).items():
        if values is None:
            continue
        source = getattr(body.truth, name)
        arrays[name] = values.copy()
        arrays[name][y, x] = -1 if source is None else source[row[k], column[k]]
    arrays["depth_m"][y, x] += near.nearer_m
    return replace(truth, **arrays)


def _has_sources_around(spec: SampleSpec) -> bool:
    """Return whether a fault of the scene needs the light around the view.

    It does so also in samples that do not carry the fault, since a study injects it into any view.
    """
    return any(fault.lit_by_surroundings for fault in spec.faults.values())


def far_sources(spec: SampleSpec, pose: Pose) -> tuple[FarSource, ...]:
    """Return the light of the bodies of `sky.bodies` that ground and spacecraft do not hide."""
    from .. import render

    scene, site = spec.scene, spec.terrain.site
    bodies = ephemeris.bright_bodies(scene) if _has_sources_around(spec) else ()
    if not bodies:
        return ()
    T_from_J = ephemeris.target_attitude(scene, site.T_from_L @ pose.sun_L)
    L_from_J = site.T_from_L.T @ T_from_J
    sunlight = spectra.solar_band_irradiance_W_m2_nm(ephemeris.wavelengths_nm(scene), 1.0)
    out = []
    for body in bodies:
        direction_L = L_from_J @ body.direction_J
        disc = replace(
            ephemeris.sunlight(scene, direction_L), angular_radius_rad=max(body.angular_radius_rad, _LEAST_RAD)
        )
        seen = render.sun_visible_fraction(
            spec.terrain.surface, pose.position_L_m[None], [disc], pose.L_from_C[None]
        )
        out.append(
            FarSource(
                direction_C=pose.L_from_C.T @ direction_L,
                angular_radius_rad=body.angular_radius_rad,
                irradiance_W_m2_nm=sunlight * body.of_sunlight * float(seen[0]),
            )
        )
    return tuple(out)


def surroundings(spec: SampleSpec, scene: RenderInput) -> tuple[Radiance, ...]:
    """Render what lies around the view, coarsely, if a fault of the scene needs it."""
    from .. import render

    if not _has_sources_around(spec):
        return ()
    view, out = scene.view, []
    own = RenderGrid(shape=(view.height_px, view.width_px), focal_px=float(view.intrinsics[0]))
    for grid in surrounding_grids(own):
        height, width = grid.shape
        wide = replace(
            view,
            intrinsics=np.array([grid.focal_px, grid.focal_px, width / 2, height / 2]),
            width_px=width,
            height_px=height,
            aperture_radius_m=0.0,
            motion=None,
        )
        out.append(
            render.radiance(
                spec.terrain.surface,
                replace(scene, view=wide, bounces=0, samples_per_pixel=_SURROUNDING_SAMPLES),
            )
        )
    return tuple(out)


def add_atmosphere(spec: SampleSpec, scene: RenderInput, truth: Truth, radiance: Radiance) -> Radiance:
    """Return the radiance behind and within the scene's atmosphere; without one it is returned as it is.

    `truth` is on the grid of the radiance.
    """
    body, site = spec.scene.body, spec.terrain.site
    if body.atmosphere is None:
        return radiance
    from .. import render
    from ..render.atmosphere import rayleigh_depth

    air = render.Air(
        semi_axes_m=np.array(body.semi_axes_m),
        centre_L_m=-site.T_from_L.T @ site.position_T_m,
        T_from_L=site.T_from_L,
        optical_depth=rayleigh_depth(scene.wavelength_nm, body.atmosphere.optical_depth),
        scale_height_m=body.atmosphere.scale_height_m,
    )
    is_ground = truth.semantic == BODY
    added, left = render.air_light(air, scene.view, scene.sun.direction_L, truth.depth_m, is_ground)
    sunlight = scene.sun.irradiance_W_m2_nm.astype(np.float32)[:, None, None]
    return replace(radiance, array=radiance.array * left + sunlight * added)
