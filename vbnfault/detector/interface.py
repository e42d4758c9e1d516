"""Define what every detector of a camera answers, with and without a colour mosaic.

`three_colour.ThreeColourDetector` and `mosaic_detector.MosaicDetector` are the two kinds. Code above this package
asks a detector what it does and never which class it has.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.quantities import LUMINANCE, RGBI, Electrons, Irradiance
from ..core.spectra import per_joule
from .effects import Acts
from .efficiency import QuantumEfficiency, white_balance

if TYPE_CHECKING:
    from .mosaic_detector import MosaicDetector

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

# The weights of R, G and B are rounded to whole 65536ths, and their sum is 1. Their products with levels, and the
# sums of these, are exact in single precision, so every order of the sum, fused or not, gives the same bits.
LUMINANCE_WEIGHTS = np.rint(LUMINANCE.astype(np.float64) * 65536) / 65536

_ROWS_PER_BLOCK = 64  # measured as the fastest; two threads would wait for the interpreter's lock


class Detector(Protocol):
    """Convert irradiance to electrons, and these to an 8 bit image. Detectors are immutable and hashable."""

    @property
    def name(self) -> str:
        """Return the name that the dataset stores."""

    @property
    def description(self) -> dict[str, Any]:
        """Return, as plain JSON data, what a user of the raw mosaic or of the noise needs to know."""

    @property
    def mosaic(self) -> MosaicDetector | None:
        """Return the detector itself if it has a colour mosaic, with its device and raw DN; else None."""

    @property
    def optics_key(self) -> Any:
        """Return a hashable key of all on which the expected electrons depend."""

    @property
    def width_px(self) -> int:
        """Return the number of columns."""

    @property
    def height_px(self) -> int:
        """Return the number of rows."""

    @property
    def pixel_pitch_um(self) -> float:
        """Return the pixel pitch in µm."""

    @property
    def full_well_e(self) -> float:
        """Return the full well in electrons."""

    @property
    def read_noise_e_rms(self) -> float:
        """Return the temporal noise of a dark pixel in electrons."""

    @property
    def dark_current_e_s(self) -> float:
        """Return the mean dark current in electrons per second."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the names of the channels in which the sensor collects electrons."""

    @property
    def efficiency(self) -> QuantumEfficiency:
        """Return the quantum efficiency (electrons per photon) of each channel."""

    @property
    def white_balance(self) -> F32:
        """Return each channel's gain that shows a grey surface in sunlight as grey, float32[channel], ≥ 1."""
        return white_balance(self.efficiency)

    @property
    def white_e(self) -> F32:
        """Return the signal of each channel in electrons that the 8 bit image shows as 255, float32[channel]."""

    def electron_rate_weights(
        self, wavelength_nm: NDArray[np.float64], transmittance: NDArray[np.float64] | None = None
    ) -> F32:
        """Return electrons per second and pixel for 1 W m⁻² nm⁻¹ in each band, float32[channel, band].

        `transmittance` is as in `Irradiance`.
        """
        area_m2 = (self.pixel_pitch_um * 1e-6) ** 2
        return np.asarray(
            self.efficiency.electron_weights(wavelength_nm, transmittance) * area_m2, dtype=np.float32
        )

    def electron_rates(self, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return electrons per second and pixel for 1 W m⁻² at each wavelength, float64[channel, n]."""
        return self.efficiency.at(wavelength_nm) * per_joule(wavelength_nm) * (self.pixel_pitch_um * 1e-6) ** 2

    def electrons_expected(self, irradiance: Irradiance, exposure_s: float) -> Electrons:
        """Return the expected photo-electrons per pixel and channel, noise-free and not clipped."""
        weights = self.electron_rate_weights(irradiance.wavelength_nm, irradiance.transmittance)
        weights = weights * np.float32(exposure_s)
        return Electrons(array=electrons_of(irradiance, weights), white_e=self.white_e)

    def draw_noise(self, shape: tuple[int, int], rng: Callable[[str], np.random.Generator]) -> Any:
        """Draw the variates of one exposure. `rng` returns the random generator for a name."""

    def develop(self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts | None = None) -> RGBI:
        """Return the 8 bit image of the expected photo-electrons.

        `noise` comes from `draw_noise`; None gives a noise-free image. `acts` are the changes that faults make at
        the steps of `effects.STEPS`, for a detector with a colour mosaic.
        """


def electrons_of(irradiance: Irradiance, weights: F32) -> F32:
    """Return the electrons per pixel and channel, float32[y, x, channel], with weights float32[channel, band]."""
    _, height, width = irradiance.array.shape
    out = np.empty((height, width, len(weights)), dtype=np.float32)
    # a matrix product over the bands, in blocks of rows that stay in the cache: BLAS is slow for 3 × 8
    for start in range(0, height if width else 0, _ROWS_PER_BLOCK):  # OpenCV refuses empty arrays
        block = out[start : start + _ROWS_PER_BLOCK]
        energy = np.moveaxis(irradiance.array[:, start : start + len(block)], 0, 1)
        colours = np.zeros((len(weights), *block.shape[:2]), dtype=np.float32)
        for colour, row in zip(colours, weights.tolist(), strict=True):
            for band, weight in enumerate(row):
                cv2.scaleAdd(energy[:, band], weight, colour, dst=colour)
        block[...] = cv2.merge(list(colours)).reshape(block.shape)
    return out


def luminance(rgb: U8) -> U8:
    """Return the luminance, uint8[y, x], of R, G and B, uint8[y, x, 3]; halves become the even level."""
    return np.asarray(cv2.transform(rgb, LUMINANCE_WEIGHTS.reshape(1, 3))).reshape(rgb.shape[:2])


def with_luminance(rgb: U8) -> U8:
    """Return R, G, B and the luminance as I, uint8[y, x, 4], of R, G and B, uint8[y, x, 3]."""
    return np.asarray(cv2.insertChannel(luminance(rgb), cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA), 3))
