"""Straylight by physics: ghosts, starburst and veiling glare of a lens whose prescription is known.

Two models of the ghosts, everything else alike: `traced` follows exact rays along every path of two reflections
(Hullin et al. 2011), `paraxial` draws each path's first-order image of the stop (Lee & Eisemann 2013). The light is
added to what the scene gives, as irradiance on the sensor, from the Sun's irradiance at the camera.

The parameters of a sample hold the ghosts in the frame, as they would be without each other: `pair` (rows of the
prescription), `flux_fraction`, `x_px`, `y_px`, `rms_radius_px`, the brightest first. Coatings worn off by another
fault raise them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import spectra
from ..quantities import Irradiance
from .base import FaultContext, Interval, LensFault, Params, bounds, choice, intensity_dn, number, plus

F32 = NDArray[np.float32]

_MOST_GHOSTS = 24
_LEAST_SUN_RAD = 1e-5


@dataclass(frozen=True, kw_only=True)
class _LensStraylight(LensFault):
    fault = "straylight"
    step = "electrons"
    needs_sun = True
    effect_mask = True
    soft_layer = "straylight_added"

    coating: str = choice(
        "bbar",
        ("as_prescribed", "none", "mgf2", "v", "bbar"),
        doc="of every surface between glass and air",
    )
    roughness_nm: Interval = bounds(0.2, 1.0, limits=(0, 100), unit="nm", doc="rms roughness of the surfaces")
    cleanliness_level: Interval = bounds(
        20, 100, limits=(0, 2000), doc="of particles on the surfaces, IEST-STD-CC1246; 0: none"
    )
    reflections: int = number(2, limits=(2, 4), integer=True, doc="of the ghosts: 2, or 4 for those of four too")
    baffle_length_mm: float = number(0.0, limits=(0, 1e4), unit="mm", doc="of a tube in front of the lens")
    baffle_radius_mm: float = number(0.0, limits=(0, 1e4), unit="mm", doc="of that tube")
    mask_level_dn: float = number(
        1.0,
        limits=(0.01, 255),
        unit="DN of 255",
        doc="the footprint holds the pixels that gain at least this much",
    )

    def validate(self) -> None:
        super().validate()
        if self.reflections not in (2, 4):
            raise ValueError(f"reflections = {self.reflections}: must be 2 or 4")
        if self.baffle_length_mm and not self.baffle_radius_mm:
            raise ValueError("baffle_length_mm: needs baffle_radius_mm")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Lens, coating, roughness, cleanliness, and the ghosts in the frame."""
        params: Params = {
            "lens": self.lens,
            "coating": self.coating,
            "roughness_nm": self.roughness_nm.uniform(rng),
            "cleanliness_level": self.cleanliness_level.uniform(rng),
            "reflections": int(self.reflections),
            "baffle_mm": [float(self.baffle_length_mm), float(self.baffle_radius_mm)],
            "mask_level_dn": float(self.mask_level_dn),
        }
        params["ghosts"] = self._ghosts(params, context)
        return params

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Expected electrons plus what the lens sends astray."""
        layer = self._layer_once(params, context)
        return quantity if layer is None else quantity.with_array(plus(quantity.array, layer))

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """bool[y, x]: where any colour gains at least `mask_level_dn`."""
        layer = self._layer_once(params, context)
        if layer is None:
            return np.zeros(context.shape, dtype=bool)
        white = context.camera.detector.white_e
        return np.asarray((layer >= white * np.float32(params["mask_level_dn"] / 255)).any(axis=2))

    def soft(self, params: Params, context: FaultContext) -> F32:
        """Return the intensity of what the lens sends astray, float32[y, x] in DN of 255."""
        layer = self._layer_once(params, context)
        return np.zeros(context.shape, np.float32) if layer is None else intensity_dn(layer, context.camera)

    def _layer_once(self, params: Params, context: FaultContext) -> F32 | None:
        return context.once("straylight.lens", params, lambda: self._layer(params, context))

    def _layer(self, params: Params, context: FaultContext) -> F32 | None:
        """All straylight, electrons float32[y, x, channel]; None without a Sun in front of the camera."""
        from ..lens.straylight import Baffle, Cleanliness, straylight

        sun = _sun(context)
        if sun is None:
            return None
        theta, azimuth = sun
        camera = context.camera
        nodes, irradiance = _sunlight(context)
        pitch_mm = camera.detector.pixel_pitch_um * 1e-3
        assert context.sun_xy_px is not None
        middle = np.array([camera.width_px / 2, camera.height_px / 2])
        x, y = (np.asarray(context.sun_xy_px) - middle) * pitch_mm
        found = straylight(
            context.frame.prescription(params["lens"], params["coating"]),
            model=self.model,
            wavelength_nm=nodes,
            shape=context.shape,
            pitch_mm=pitch_mm,
            sun_deg=theta,
            azimuth_deg=azimuth,
            sun_radius_rad=_sun_radius_rad(context),
            sun_xy_mm=(float(x), float(y)),
            cleanliness=Cleanliness(roughness_nm=params["roughness_nm"], level=params["cleanliness_level"]),
            baffle=Baffle(length_mm=params["baffle_mm"][0], radius_mm=params["baffle_mm"][1]),
            reflections=params["reflections"],
            coating_loss=context.coating_loss,
        )
        visible = 1.0 if context.sun_visible_fraction is None else float(context.sun_visible_fraction)
        light = found.total * (irradiance * visible).astype(np.float32)[:, None, None]
        on_sensor = Irradiance(array=light, wavelength_nm=nodes)
        return camera.detector.electrons_expected(on_sensor, camera.exposure_s).array

    def _ghosts(self, params: Params, context: FaultContext) -> list[dict[str, Any]]:
        from ..lens.flare import flare_model

        sun = _sun(context)
        if sun is None:
            return []
        camera = context.camera
        pitch_mm = camera.detector.pixel_pitch_um * 1e-3
        made = flare_model(
            context.frame.prescription(params["lens"], params["coating"]),
            tuple(float(v) for v in _sunlight(context)[0]),
            context.shape,
            pitch_mm,
            _sun_radius_rad(context),
            self.model,
            params["reflections"],
        )
        ghosts = sorted(made.worn(context.coating_loss).ghosts(*sun), key=lambda g: -g.peak_irradiance_fraction)[
            :_MOST_GHOSTS
        ]
        return [
            {
                "pair": list(g.pair),
                "flux_fraction": g.flux_fraction,
                "peak_irradiance_fraction": g.peak_irradiance_fraction,
                "x_px": g.centroid_mm[0] / pitch_mm + camera.width_px / 2,
                "y_px": g.centroid_mm[1] / pitch_mm + camera.height_px / 2,
                "rms_radius_px": g.rms_radius_mm / pitch_mm,
            }
            for g in ghosts
        ]


@dataclass(frozen=True, kw_only=True)
class TracedStraylight(_LensStraylight):
    """Ghosts by exact rays, starburst and veiling glare."""

    model = "traced"


@dataclass(frozen=True, kw_only=True)
class ParaxialStraylight(_LensStraylight):
    """Ghosts to first order, starburst and veiling glare."""

    model = "paraxial"


def _sun(context: FaultContext) -> tuple[float, float] | None:
    """The Sun's angle from the axis and azimuth in the picture, degrees; None where it gives no light."""
    if context.sun_xy_px is None or context.sun_visible_fraction == 0:
        return None
    direction = context.sun_direction_C
    if direction is None:  # a picture without a pose
        fx, fy, cx, cy = context.camera.intrinsics
        x, y = context.sun_xy_px
        direction = np.array([(x - cx) / fx, (y - cy) / fy, 1.0])
    theta = float(np.degrees(np.arctan2(np.hypot(direction[0], direction[1]), direction[2])))
    return (theta, float(np.degrees(np.arctan2(direction[1], direction[0])))) if theta < 89.9 else None


def _sunlight(context: FaultContext) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Band nodes and the Sun's irradiance in them."""
    if context.wavelength_nm is not None and context.sun_irradiance_W_m2_nm is not None:
        return context.wavelength_nm, context.sun_irradiance_W_m2_nm
    nodes = spectra.band_nodes_nm(400.0, 700.0, 8)
    return nodes, spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0)


def _sun_radius_rad(context: FaultContext) -> float:
    found = context.sun_angular_radius_rad
    return spectra.sun_angular_radius_rad(1.0) if found is None else max(float(found), _LEAST_SUN_RAD)
