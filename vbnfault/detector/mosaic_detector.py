"""A device of a sensor as a camera's detector: with a mosaic, where `Detector` has all colours in every pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..quantities import RGBI, Electrons, Irradiance
from .chain import Acts, Device, MosaicNoise
from .dark import silicon_factor
from .mosaic import sample
from .sensor import Sensor
from .three_colour import Detector

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class MosaicDetector:
    """One individual of a sensor, of `width_px` × `height_px` pixels of it, read towards `direction`."""

    sensor: Sensor
    seed: int = 0
    width_px: int = 1024
    height_px: int = 1024
    direction: str = "up"

    # a pixel of the picture depends on others of the mosaic
    local: ClassVar[bool] = False

    def __post_init__(self) -> None:
        sensor = self.sensor
        if not (sensor.pattern.is_bayer or len(sensor.pattern.channels) == 1):
            raise InputError(
                f"{sensor.name}: pattern = {sensor.pattern.name!r}: scenes have light for R, G and B; must be "
                "a Bayer pattern or mono"
            )
        for key in ("width_px", "height_px"):
            if getattr(self, key) > getattr(sensor, key):
                raise InputError(
                    f"{key} = {getattr(self, key)}: {sensor.name} has {getattr(sensor, key)}; must be at most that"
                )

    @property
    def name(self) -> str:
        return self.sensor.name

    @property
    def pixel_pitch_um(self) -> float:
        return self.sensor.pixel_pitch_um

    @property
    def full_well_e(self) -> float:
        return self.sensor.readout.full_well_e

    @property
    def read_noise_e_rms(self) -> float:
        return self.sensor.readout.noise_e_rms

    @property
    def dark_current_e_s(self) -> float:
        """Of undamaged pixels at the sensor's temperature."""
        spec = self.sensor.individual
        return spec.dark_current_e_s * silicon_factor(self.sensor.temperature_K, spec.reference_K)

    @property
    def _planes(self) -> Detector:
        """A detector with all colours in every pixel, for what happens before the mosaic."""
        sensor = self.sensor
        return Detector(
            name=sensor.name,
            width_px=self.width_px,
            height_px=self.height_px,
            pixel_pitch_um=sensor.pixel_pitch_um,
            full_well_e=sensor.readout.full_well_e,
            response=sensor.response if sensor.pattern.is_bayer else "flat",
            quantum_efficiency_peak=sensor.quantum_efficiency_peak,
        )

    @property
    def white_balance(self) -> F32:
        """Gain of R, G, B, float32[3], at least 1, that makes a grey surface in sunlight grey."""
        return self._planes.white_balance

    @property
    def white_e(self) -> F32:
        """Signal of R, G, B, in electrons, that the 8 bit image shows as 255."""
        return self._planes.white_e

    def electron_rate_weights(self, wavelength_nm: NDArray[np.float64]) -> F32:
        """float32[3, band]: electrons per second and pixel for 1 W m⁻² nm⁻¹ in a band, behind each filter."""
        return self._planes.electron_rate_weights(wavelength_nm)

    def electrons_expected(self, irradiance: Irradiance, exposure_s: float) -> Electrons:
        """Expected photo-electrons per pixel behind each filter, noise-free, not clipped."""
        return self._planes.electrons_expected(irradiance, exposure_s)

    def draw_noise(self, shape: tuple[int, int], rng: Callable[[str], np.random.Generator]) -> MosaicNoise:
        """Variates of one exposure, by the generators of their names."""
        return MosaicNoise.draw(shape, rng("shot"), rng("read"), rng("row"))

    def raw(
        self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts | None = None
    ) -> NDArray[np.uint16]:
        """Raw mosaic, uint16[y, x]; noise-free without `noise`, which is what `draw_noise` gives. `acts` are what
        faults do on the way (`chain.STEPS`)."""
        pattern = self.sensor.pattern
        mosaic = sample(expected.array, pattern) if pattern.is_bayer else expected.array[..., 0]
        return self.device.raw(np.ascontiguousarray(mosaic), exposure_s, noise, acts or {})

    def develop(self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts | None = None) -> RGBI:
        """The 8 bit picture of expected photo-electrons."""
        return self.device.rgbi(self.raw(expected, exposure_s, noise, acts), exposure_s)

    @property
    def optics_key(self) -> Any:
        """What the electrons expected behind the filters depend on."""
        return self._planes

    @property
    def device(self) -> Device:
        """The device at work."""
        return _device(self.sensor, self.seed, (self.height_px, self.width_px), self.direction)


@lru_cache(maxsize=4)
def _device(sensor: Sensor, seed: int, shape: tuple[int, int], direction: str) -> Device:
    return Device(sensor, seed, shape=shape, direction=direction)
