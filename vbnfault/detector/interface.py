"""Define what every detector of a camera answers, with and without a colour mosaic.

`three_colour.ThreeColourDetector` and `mosaic_detector.MosaicDetector` are the two kinds. Code above this package
asks a detector what it does and never which class it has.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import RGBI, Electrons, Irradiance
from .effects import Acts

if TYPE_CHECKING:
    from .mosaic_detector import MosaicDetector

F32 = NDArray[np.float32]


class Detector(Protocol):
    """Convert irradiance to electrons, and these to an 8 bit image. Detectors are immutable and hashable."""

    def __hash__(self) -> int:
        """Return a hash, which caches need; equal detectors have equal hashes."""

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
    def local(self) -> bool:
        """Return whether each pixel of the image depends on the light on this pixel alone."""

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
    def white_balance(self) -> F32:
        """Return each channel's gain that shows a grey surface in sunlight as grey, float32[channel], ≥ 1."""

    @property
    def white_e(self) -> F32:
        """Return the signal of each channel in electrons that the 8 bit image shows as 255, float32[channel]."""

    def electron_rate_weights(
        self, wavelength_nm: NDArray[np.float64], transmittance: NDArray[np.float64] | None = None
    ) -> F32:
        """Return electrons per second and pixel for 1 W m⁻² nm⁻¹ in each band, float32[channel, band].

        `transmittance` is as in `Irradiance`.
        """

    def electron_rates(self, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return electrons per second and pixel for 1 W m⁻² at each wavelength, float64[channel, n]."""

    def electrons_expected(self, irradiance: Irradiance, exposure_s: float) -> Electrons:
        """Return the expected photo-electrons per pixel and channel, noise-free and not clipped."""

    def draw_noise(self, shape: tuple[int, int], rng: Callable[[str], np.random.Generator]) -> Any:
        """Draw the variates of one exposure. `rng` returns the random generator for a name."""

    def develop(
        self,
        expected: Electrons,
        exposure_s: float,
        noise: Any,
        acts: Acts | None = None,
        base: tuple[Electrons, RGBI] | None = None,
    ) -> RGBI:
        """Return the 8 bit image of the expected photo-electrons.

        `noise` comes from `draw_noise`; None gives a noise-free image. `acts` are the changes that faults make at
        the steps of `effects.STEPS`, for a detector with a colour mosaic. `base` is another signal with its image
        for the same exposure and noise, from which a `local` detector takes the pixels with this signal.
        """
