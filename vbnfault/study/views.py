"""Change the camera and the Sun of a rendered view, and take it through the pipeline as far as its clean image."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import spectra
from ..core.quantities import BODY, SunInView
from ..core.sundisc import add_mean
from ..faults import FaultContext
from ..pipeline.development import Development
from ..pipeline.exposure import add_stars, meter
from ..pipeline.injection import fault_context
from ..pipeline.rendering import render_view
from ..pipeline.spec import Pose, Rendering, SampleSpec, SceneExposure, SceneLight
from . import navigation_metrics as nav

F32 = NDArray[np.float32]

_LIT = 0.02  # of the 99th percentile of the ground's signal, above which ground counts as sunlit


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView:
    """Hold a rendered view: its sample, pose and radiance, and its number in a sequence."""

    spec: SampleSpec
    pose: Pose
    rendering: Rendering
    number: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposed(RenderedView):
    """Hold a view with the camera and the Sun of one evaluation, and its exposure."""

    exposure: SceneExposure

    @property
    def camera(self) -> Camera:
        """Return the camera with its exposure."""
        return self.exposure.camera

    @cached_property
    def scene_e(self) -> F32:
        """Return the signal of the scene without straylight and Sun, float32[channel, y, x] in electrons."""
        return _planes(self.exposure.rate.array, self.camera.exposure_s)

    @cached_property
    def direct_e(self) -> F32 | None:
        """Return the same of the Sun's direct image; None where it is out of view."""
        past_rims = self.exposure.rate.past_rims
        return None if past_rims is None else _planes(past_rims, self.camera.exposure_s)

    @cached_property
    def clean(self) -> F32:
        """Return the expected signal without straylight, float32[channel, y, x] in electrons."""
        return self.scene_e if self.direct_e is None else self.scene_e + self.direct_e

    @cached_property
    def lit(self) -> NDArray[np.intp]:
        """Return the indices of the pixels that show sunlit ground."""
        per_s, semantic = self.exposure.rate.array, self.rendering.truth.semantic
        ground = np.flatnonzero(semantic.ravel() == BODY)
        level = per_s.reshape(-1, per_s.shape[-1])[ground].mean(axis=1)
        return ground[level > _LIT * np.percentile(level, 99)] if len(level) else ground

    @cached_property
    def context(self) -> FaultContext:
        """Return the sample as its faults see it."""
        return fault_context(self.pose, self.rendering, self.exposure)


@dataclass(frozen=True, kw_only=True, eq=False)
class CleanView(Exposed):
    """Hold a view of a sequence as far as no fault changes it; both images of `frame` are its clean twin."""

    frame: nav.NavigationFrame

    @classmethod
    def of(cls, view: RenderedView, nominal: Camera) -> CleanView:
        """Return a rendered view with its exposure and its clean twin; a navigator believes the nominal camera."""
        spec, pose, rendering = view.spec, view.pose, view.rendering
        exposure = add_stars(spec, pose, rendering, meter(spec, rendering))
        context = fault_context(pose, rendering, exposure)
        clean = Development(exposure=exposure, context=context, rng=spec.rng).image({}).array
        frame = nav.navigation_frame(pose, rendering.truth, nominal, clean, clean)
        return cls(**vars(view), exposure=exposure, frame=frame)


def rendered_sequence(view: RenderedView, count: int) -> Iterator[RenderedView]:
    """Yield the views of a sequence that begins with a rendered view."""
    yield view
    for k, pose in enumerate(nav.sequence(view.spec, view.pose, view.rendering, count)[1:], start=1):
        spec = nav.spec_of_view(view.spec, k)
        yield RenderedView(spec=spec, pose=pose, rendering=render_view(spec, pose), number=k)


# --- camera and Sun ----------------------------------------------------------------------------------------------


def camera_shape(camera: Camera) -> tuple[int, int]:
    """Return (height, width) in pixels."""
    return camera.height_px, camera.width_px


def with_detector(camera: Camera, changes: Mapping[str, Any]) -> Camera:
    """Return a camera with changed keys of its detector."""
    if not changes:
        return camera
    own: Any = camera.detector
    if camera.detector.mosaic is None:
        whole = {key: round(v) if key in ("adc_bits", "bias_dn") else v for key, v in changes.items()}
        return replace(camera, detector=replace(own, **whole))
    sensor: Any = camera.detector.mosaic.sensor
    for key, value in changes.items():
        sensor = _replaced(sensor, key.split("."), value)
    return replace(camera, detector=replace(own, sensor=sensor))


def _replaced(table: Any, keys: Sequence[str], value: Any) -> Any:
    """Return a description with one value replaced, which nested descriptions may hold."""
    first, *rest = keys
    before = getattr(table, first)
    if rest:
        value = _replaced(before, rest, value)
    elif isinstance(before, int) and not isinstance(before, bool) and float(value).is_integer():
        value = int(value)
    return replace(table, **{first: value})


def dark_e(camera: Camera) -> F32 | float:
    """Return the dark signal in electrons: of each pixel of a device with a mosaic, else the mean."""
    if camera.detector.mosaic is None:
        return camera.detector.dark_current_e_s * camera.exposure_s
    return np.asarray(camera.mosaic.device.dark_rate_e_s * np.float32(camera.exposure_s), dtype=np.float32)


def with_sun(view: RenderedView, sun: Mapping[str, float]) -> tuple[Pose, Rendering]:
    """Return a view's pose and rendering with the Sun moved as the optics see it, and at another distance."""
    pose, rendering = view.pose, view.rendering
    if not sun:
        return pose, rendering
    direction_C = pose.L_from_C.T @ pose.sun_L
    angle = np.arctan2(np.hypot(direction_C[0], direction_C[1]), direction_C[2])
    azimuth = np.arctan2(direction_C[1], direction_C[0])
    angle = np.radians(sun.get("angle_deg", np.degrees(angle)))
    azimuth = np.radians(sun.get("azimuth_deg", np.degrees(azimuth)))
    moved = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    if "angle_deg" not in sun and "azimuth_deg" not in sun:
        moved = direction_C
    source, scale = rendering.scene.sun, 1.0
    if "distance_au" in sun:
        before_au = spectra.SUN_RADIUS_M / (np.sin(source.angular_radius_rad) * spectra.AU_M)
        scale = float((before_au / sun["distance_au"]) ** 2)
        source = replace(
            source,
            irradiance_W_m2_nm=source.irradiance_W_m2_nm * scale,
            angular_radius_rad=spectra.sun_angular_radius_rad(sun["distance_au"]),
        )
    sun_L = pose.L_from_C @ moved
    source = replace(source, direction_L=sun_L)
    light = rendering.light.rendered
    array = light.array if light.sun is None else np.maximum(light.array - light.sun, 0)
    disc = SunInView(
        direction_C=moved,
        angular_radius_rad=source.angular_radius_rad,
        radiance_W_m2_sr_nm=source.radiance_W_m2_sr_nm,
        limb_darkening=source.limb_darkening,
        visible=np.full((1, 1), pose.sun_visible_fraction, np.float32)
        if light.disc is None
        else light.disc.visible,
        blur_slope=0.0 if light.disc is None else light.disc.blur_slope,
    )
    array = array * np.float32(scale)
    own: F32 | None = np.zeros_like(array)
    assert own is not None
    if add_mean(own, disc, rendering.scene.view.pixel_map, range(len(array))) is None:
        own = None
    radiance = replace(
        light,
        array=array if own is None else array + own,
        sun=own,
        disc=None if own is None else disc,
        fine=None if light.fine is None else light.fine.scaled(scale),
    )
    return (
        replace(pose, sun_L=sun_L),
        replace(
            rendering,
            scene=replace(rendering.scene, sun=source),
            light=SceneLight(lens=rendering.light.lens, rendered=radiance),
        ),
    )


def _planes(per_s: F32, seconds: float) -> F32:
    """Return electrons, float32[channel, y, x], from electrons per second, float32[y, x, channel]."""
    planes = np.ascontiguousarray(np.moveaxis(per_s, -1, 0))
    planes *= np.float32(seconds)
    return planes
