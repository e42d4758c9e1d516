"""Simulate light from outside the field: baffle, deck and insulation, lit by the Sun.

Sunlit structure around the front of a camera lies far out of focus. What it sends onto the front element is
scattered by mount and glass, and reaches the sensor as a smooth veil that is brightest on the side of the Sun.
Examples from flight: the insulation at the edge of Hayabusa2's ONC-W2 (Yokota et al. 2024, EPSC2024-961); sunlight
that bounces off the taller structures on the deck of OSIRIS-REx into OCAMS and TAGCAMS (mission update of 22
January 2018); the straylight of ONC-T, which depends on the spacecraft's attitude (Tatsumi et al. 2019, Icarus 325,
153).

The veil has the radiance of a Lambertian surface of the reflectance I/F = R that fills the field, so that its
irradiance on the sensor is

    E = R E☉ T / (4 N²)

with the transmittance T and the f-number N of the lens: R of 10⁻³ is a point-source transmittance of 3·10⁻⁵ at
f/2.8. R holds for a Sun at the corner of the frame. The Sun lights a tube to the depth of its diameter over tan θ,
so R falls with the angle θ of the Sun from the axis as 1 / tan θ, and is 0 from 90° on. Across the frame the veil
falls exponentially, by `falloff` from the corner next to the Sun to the one farthest from it. The shadow of the
baffle's rim may cut off the far part. Its edge is soft, since the rim is out of focus, and bent like the rim.

With the Sun in the frame the tube is lit too; what that Sun's light does inside the lens is left to the models
`traced` and `paraxial`. A Sun behind the camera lights nothing that faces the lens: the fault then asks for another
view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ..core import spectra
from ..core.quantities import Electrons
from .context import FaultContext, Params
from .contract import Fault, mask_level
from .fields import Interval, bounds, number
from .planes import intensity_dn

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class SurroundingsStraylight(Fault):
    """Add a veil with a gradient, from structure beside the field that the Sun lights."""

    fault = "straylight"
    model = "surroundings"
    step = "electrons"
    effect_mask = True
    soft_layer = "straylight_added"

    reflectance: Interval = bounds(
        3e-4,
        1e-2,
        limits=(1e-8, 1),
        doc="I/F of the surface that the veil looks like next to the Sun, drawn evenly in its logarithm; ground "
        "of 67P at phase 90 degrees: 0.01; assumed",
    )
    falloff: Interval = bounds(
        2.0, 20.0, limits=(1, 1e4), doc="veil on the side of the Sun over that on the far side; assumed"
    )
    shadow_chance: float = number(
        0.3, limits=(0, 1), doc="chance that the shadow of the baffle's rim crosses the frame; assumed"
    )
    shadow_depth: Interval = bounds(
        0.5, 0.9, limits=(0, 1), doc="fraction of the veil that is missing in that shadow; assumed"
    )
    shadow_softness: Interval = bounds(
        0.05, 0.3, limits=(1e-3, 2), unit="half diagonals", doc="standard deviation of its edge; assumed"
    )
    mask_level_dn: float = mask_level()

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the reflectance for this Sun (0: no veil), its fall, and the shadow of the rim.

        The shadow has its position on the line towards the Sun, the radius and softness of its edge, in half
        diagonals of the frame, and its depth, 0 without a shadow.
        """
        reflectance = float(self.reflectance.power_law(rng.random(1), 0.0)[0])
        falloff, shadow = self.falloff.uniform(rng), rng.random() < self.shadow_chance
        depth, softness = self.shadow_depth.uniform(rng), self.shadow_softness.uniform(rng)
        return {
            "reflectance": reflectance * _lit_depth(context),
            "falloff": falloff,
            "shadow_at": float(rng.uniform(-0.5, 0.5)),
            "shadow_radius": float(rng.uniform(1.5, 5.0)),
            "shadow_softness": softness,
            "shadow_depth": depth if shadow else 0.0,
            "mask_level_dn": float(self.mask_level_dn),
        }

    def on_light(self, light: Electrons, params: Params, context: FaultContext) -> Electrons:
        """Return the light with the veil, which no rim of the lens vignettes, added to that past the rims."""
        veil = context.once(_veil_e, params)
        return replace(light, past_rims=veil if light.past_rims is None else light.past_rims + veil)

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons plus the veil."""
        return quantity.with_array(quantity.array + context.once(_veil_e, params))

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels that the veil brightens by at least `mask_level_dn`, bool[y, x]."""
        return np.asarray(self.soft(params, context) >= np.float32(params["mask_level_dn"]))

    def soft(self, params: Params, context: FaultContext) -> F32:
        """Return the intensity of the veil, float32[y, x] in DN of 255."""
        return intensity_dn(context.once(_veil_e, params), context.camera)


def _lit_depth(context: FaultContext) -> float:
    """Return the lit depth of a tube before the lens over that for a Sun at the frame's corner, at most 1."""
    sun = context.sun_before_camera
    if sun is None:
        return 0.0
    corner = float(np.hypot(*context.shape)) / 2 / context.camera.focal_length_px
    return float(min(corner * sun[2] / max(np.hypot(sun[0], sun[1]), 1e-9), 1.0)) * context.sun_visible


def _veil_e(params: Params, context: FaultContext) -> F32:
    """Return the electrons of the veil, float32[y, x, channel]."""
    camera, (height, width) = context.camera, context.shape
    sun = context.sun_before_camera
    if sun is None or not params["reflectance"]:
        return np.zeros((height, width, len(camera.detector.channels)), dtype=np.float32)
    nodes, irradiance = context.sunlight
    nm = spectra.fine_nodes_nm(nodes)
    spectrum = camera.electron_rates(nm) * spectra.sunlike(irradiance, nodes)
    sunlight_e = np.trapezoid(spectrum, nm, axis=1) * camera.exposure_s
    half = np.hypot(height, width) / 2
    y, x = ((np.arange(n, dtype=np.float32) + 0.5 - n / 2) / np.float32(half) for n in (height, width))
    cos, sin = (sun[:2] / max(np.hypot(sun[0], sun[1]), 1e-9)).astype(np.float32)
    # from -1 in the corner farthest from the Sun to 1 in the nearest, and across
    along, across = x * cos + (y * sin)[:, None], (y * cos)[:, None] - x * sin
    veil = np.exp((along - 1) * np.float32(0.5 * np.log(params["falloff"])))
    if params["shadow_depth"]:
        edge = along - params["shadow_at"] - across**2 / (2 * params["shadow_radius"])
        veil *= 1 - params["shadow_depth"] * ndtr(-edge / params["shadow_softness"]).astype(np.float32)
    level_e = params["reflectance"] * sunlight_e / (4 * camera.lens.f_number**2)
    return np.asarray(veil[..., None] * level_e, dtype=np.float32)
