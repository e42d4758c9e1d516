"""Simulate dust on the optics as in the paper (Gallon et al.): soft grains that darken the image.

A grain is a bivariate normal density, scaled so that its maximum is the drawn peak t (in units of 255):

    t(d) = t · exp(-½ dᵀ C⁻¹ d),      I' = I (1 - t(d) / 255),

where d is the distance from the grain's centre on the paper's square grid and C is the covariance matrix. R, G and
B lose the same fraction as I, so the factor acts on the expected photo-electrons.

Choices where the paper says nothing or contradicts itself:

- σxx and σyy (3-6) are entries of the covariance matrix, as the paper's table names them. The standard deviations
  are then 1.7-2.4 grid units. (If they were standard deviations, grains would be up to 2.5 times as wide.)
- One grid unit is 4.5 px of a 1024 px wide image. Grains are then 33-47 px wide at a tenth of their depth, like the
  soft blobs in the paper's figure, and 44-67 px wide at their ends.
- "The corners of the grid are removed": a grain ends on the ellipse where its darkening falls below 2 DN of 255,
  which removes the corners of any square grid. That step of 0.8 % is smaller than the sensor's noise. Where the
  image is brighter than a quarter of white, a loss of this size changes the 8 bit image. The mask is therefore the
  grain.
- Where grains overlap, their transmissions multiply, as for two grains in one beam. The order does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .context import FaultContext, Params
from .contract import Fault, first_of
from .fields import Interval, Severity, bounds, flag, number
from .planes import times


@dataclass(frozen=True, kw_only=True)
class GaussianDust(Fault):
    """Darken the image by Gaussian dust grains (Gallon et al., table of dust parameters)."""

    fault = "dust_on_optics"
    model = "gaussian"
    default = True
    after = "straylight"
    axis = 0
    step = "electrons"
    needs_light = True
    # the power is measured from 256 to 512 px
    severity = Severity(
        key="count", low=1, high=3000, width_power=0.5, drawn=lambda params, *_: len(params["x_px"])
    )
    soft_layer = "dust_opacity"

    count: Interval = bounds(30, 100, limits=(0, 10_000), integer=True, doc="number of grains in the image")
    peak_dn: Interval = bounds(
        100,
        200,
        limits=(0, 255),
        unit="DN of 255",
        doc="darkening at a grain's centre, t: I' = I (1 - t/255)",
    )
    sigma_xx: Interval = bounds(
        3,
        6,
        limits=(1e-3, 1e4),
        unit="grid units²",
        doc="covariance matrix of a grain, entry xx (a variance)",
    )
    sigma_yy: Interval = bounds(
        3,
        6,
        limits=(1e-3, 1e4),
        unit="grid units²",
        doc="covariance matrix of a grain, entry yy (a variance)",
    )
    sigma_xy: Interval = bounds(
        0, 0, limits=(-1e4, 1e4), unit="grid units²", doc="covariance matrix of a grain, entry xy"
    )
    pixels_per_grid_unit: float = number(
        4.5, limits=(0.01, 1e3), unit="px", doc="size of a grid unit in a 1024 px wide image"
    )
    mask_level_dn: float = number(
        2.0,
        limits=(0.01, 255),
        unit="DN of 255",
        doc="a grain ends where its darkening falls below this level; what remains is its mask",
    )
    scale_with_resolution: bool = flag(True, doc="grain size refers to a 1024 px wide image and scales with it")

    def validate(self) -> None:
        """Raise ValueError if a drawn covariance matrix might not be positive definite."""
        largest = max(abs(v) for v in self.sigma_xy)
        if largest**2 >= self.sigma_xx.lo * self.sigma_yy.lo:
            raise ValueError(
                f"sigma_xy = {list(self.sigma_xy)}: must stay below √(sigma_xx · sigma_yy) in size, or a "
                "covariance matrix is not positive definite"
            )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return one list per property of the grains, the size of a grid unit in px, and the mask level.

        Centres are in px, peaks in DN of 255, covariances in grid units².
        """
        height, width = context.shape
        count = self.count.integer(rng)
        columns = {
            "x_px": rng.uniform(0, width, count),
            "y_px": rng.uniform(0, height, count),
            "peak_dn": self.peak_dn.uniform(rng, count),
            "sigma_xx": self.sigma_xx.uniform(rng, count),
            "sigma_yy": self.sigma_yy.uniform(rng, count),
            "sigma_xy": self.sigma_xy.uniform(rng, count),
        }
        params: Params = {name: np.round(values, 4).tolist() for name, values in columns.items()}
        scale = context.scale if self.scale_with_resolution else 1.0
        params["pixels_per_grid_unit"] = float(self.pixels_per_grid_unit * scale)
        params["mask_level_dn"] = float(self.mask_level_dn)
        return params

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters with only the first `fraction` of the grains."""
        return first_of(params, fraction, "x_px", "y_px", "peak_dn", "sigma_xx", "sigma_yy", "sigma_xy")

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons times the transmission of all grains."""
        # outside the grains the factor is exactly 1; to choose the pixels of the grains takes four times as long
        return quantity.with_array(times(quantity.array, context.once(_transmission, params)))

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels that a grain darkens by more than `mask_level_dn`, bool[y, x]."""
        return context.once(_transmission, params) < 1

    def soft(self, params: Params, context: FaultContext) -> NDArray[np.float32]:
        """Return the fraction of the light that the grains remove, float32[y, x]."""
        return np.float32(1) - context.once(_transmission, params)


def _transmission(params: Params, context: FaultContext) -> NDArray[np.float32]:
    """Return the transmission of all grains."""
    return transmission(params, context.shape)


def transmission(params: Params, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the transmission of all grains, float32[y, x] in [0, 1], exactly 1 outside them."""
    height, width = shape
    out = np.ones(shape, dtype=np.float32)
    unit, level = params["pixels_per_grid_unit"], params["mask_level_dn"]
    names = ("x_px", "y_px", "peak_dn", "sigma_xx", "sigma_yy", "sigma_xy")
    x, y, peak, xx, yy, xy = (np.asarray(params[n], dtype=np.float64) for n in names)
    determinant = xx * yy - xy * xy
    # t > level where dᵀC⁻¹d < reach2: an ellipse with half widths √(reach2 · variance) along x and y
    reach2 = 2 * np.log(np.maximum(peak / level, 1))
    x0, x1 = _spans(x, unit * np.sqrt(reach2 * xx), width)
    y0, y1 = _spans(y, unit * np.sqrt(reach2 * yy), height)
    along_x, dx = _profiles(x, x0, x1, unit, yy / determinant)
    along_y, dy = _profiles(y, y0, y1, unit, xx / determinant)
    along_y *= (peak / 255).astype(np.float32)[:, None]
    for i in np.flatnonzero((x0 < x1) & (y0 < y1)):
        columns, rows = x1[i] - x0[i], y1[i] - y0[i]
        dark = np.multiply.outer(along_y[i, :rows], along_x[i, :columns])
        if xy[i]:
            dark *= np.exp(np.multiply.outer(dy[i, :rows], dx[i, :columns]) * np.float32(xy[i] / determinant[i]))
        cv2.threshold(dark, level / 255, 0, cv2.THRESH_TOZERO, dst=dark)
        np.subtract(1, dark, out=dark)
        out[y0[i] : y1[i], x0[i] : x1[i]] *= dark
    return out


def _spans(
    centre: NDArray[np.float64], half: NDArray[np.float64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first pixel, and the one after the last, that centre ± half covers within the frame."""
    first, last = np.floor(centre - half), np.ceil(centre + half)
    return np.maximum(first, 0).astype(np.int64), np.minimum(last, size).astype(np.int64)


def _profiles(
    centre: NDArray[np.float64],
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
    unit: float,
    weight: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return exp(-½ weight d²) and d for each grain and each pixel from `start` on, float32[grain, pixel].

    d is in grid units.
    """
    longest = max(0, int((stop - start).max(initial=0)))
    d = (start[:, None] + np.arange(longest) + 0.5 - centre[:, None]) / unit
    return np.exp(-0.5 * weight[:, None] * d**2).astype(np.float32), d.astype(np.float32)
