"""Simulate vignetting as in the paper (Gallon et al.): the cos⁴ law with a random on-axis illuminance E0.

    factor(θ) = E0 / 255 · cos⁴θ,     tan θ = r / f,

where r is the distance of a pixel's centre from the middle of the frame and f is the focal length in pixels. If E0
is below 255, the whole image becomes darker, like the paper's texture. In place of E0, a scene may set the mean of
255 factor over the frame, which says how much light is lost whatever the field of view. The factor acts on the
expected photo-electrons of all channels alike. The thin lens applies no cos⁴ of its own, so nothing is counted
twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.calibration import Calibration
from ..lens.thin import natural_falloff
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, number


@lru_cache(maxsize=8)
def _mean_falloff(calibration: Calibration | None, shape: tuple[int, int], focal_length_px: float) -> float:
    """Return the mean over the frame of a thin lens's falloff, which is cos⁴θ without a calibration."""
    return float(natural_falloff(calibration, shape, focal_length_px).mean(dtype=np.float64))


@dataclass(frozen=True, kw_only=True)
class Cos4Vignetting(Fault):
    """Darken the image by the cos⁴ law (Gallon et al., table of vignetting parameters)."""

    fault = "vignetting"
    model = "cos4"
    default = True
    after = "optics_degradation"
    axis = 4
    step = "electrons"
    needs_light = True
    severity = Severity(
        key="frame_illuminance_dn",
        low=255.0,
        high=2.0,
        drawn=lambda params, shape, focal_length_px: (
            params["on_axis_illuminance_dn"]
            * (params.get("mean_falloff") or _mean_falloff(None, shape, focal_length_px))
        ),
    )
    localised = False
    soft_layer = "vignetting_factor"
    thin_lens_only = "images fall off as its rays do, and cos⁴ would count that twice; use model 'lens'"

    on_axis_illuminance_dn: Interval = bounds(
        105, 255, limits=(0, 255), unit="DN of 255", doc="E0: 255 leaves the centre as it is"
    )
    frame_illuminance_dn: float | None = number(
        None,
        limits=(0, 255),
        unit="DN of 255",
        doc="mean over the frame, in place of E0, which is then at most 255",
    )
    mask_loss: float = number(0.1, limits=(0, 1), doc="the mask holds the pixels that lose at least this fraction")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return E0, the least loss of the pixels in the mask, and a calibrated frame's mean falloff."""
        e0, camera = self.on_axis_illuminance_dn.uniform(rng), context.camera
        mean = _mean_falloff(camera.lens.calibration, context.shape, camera.focal_length_px)
        if self.frame_illuminance_dn is not None:
            e0 = min(self.frame_illuminance_dn / mean, 255.0)
        of_calibration = {} if camera.lens.calibration is None else {"mean_falloff": mean}
        return {"on_axis_illuminance_dn": e0, "mask_loss": float(self.mask_loss), **of_calibration}

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons times the factor of each pixel."""
        camera, channels = context.camera, quantity.array.shape[2]
        cos4 = _planes(camera.lens.calibration, context.shape, camera.focal_length_px, channels)
        e0 = params["on_axis_illuminance_dn"] / 255
        return quantity.with_array(cv2.multiply(quantity.array, cos4, scale=e0).reshape(cos4.shape))

    def past_rims(self, light: Any, rest: Any, params: Params, context: FaultContext) -> Any:
        """Return the light past the rims as it is."""
        return light.past_rims

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels where the loss reaches `mask_loss`, bool[y, x]."""
        return self.soft(params, context) <= np.float32(1 - params["mask_loss"])

    def soft(self, params: Params, context: FaultContext) -> NDArray[np.float32]:
        """Return the factor on the light, float32[y, x]."""
        e0, camera = np.float32(params["on_axis_illuminance_dn"] / 255), context.camera
        return e0 * natural_falloff(camera.lens.calibration, context.shape, camera.focal_length_px)


@lru_cache(maxsize=2)
def _planes(
    calibration: Calibration | None, shape: tuple[int, int], focal_length_px: float, channels: int
) -> NDArray[np.float32]:
    """Return the falloff as float32[y, x, channel] with equal planes, read-only."""
    # kept for all samples of a camera: one fast product replaces a broadcast
    out = np.repeat(natural_falloff(calibration, shape, focal_length_px)[..., None], channels, axis=2)
    out.flags.writeable = False
    return out
