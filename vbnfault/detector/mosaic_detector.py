"""A device of a sensor as a camera's detector: with a mosaic, where `Detector` has all colours in every pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.quantities import RGBI, Electrons, Irradiance
from .chain import Acts, Device, MosaicNoise
from .demosaic import footprint, mended_from
from .efficiency import white_balance
from .mosaic import sample
from .sensor import Sensor
from .three_colour import electron_rate_weights, electrons_of

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
        return spec.dark_current_e_s * spec.dark_factor(self.sensor.temperature_K)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of its pattern: planes of the light on it, before the mosaic."""
        return self.sensor.pattern.channels

    @property
    def white_balance(self) -> F32:
        """Gain of each channel, float32[channel], at least 1, that makes a grey surface in sunlight grey."""
        return white_balance(self.sensor.efficiency)

    @property
    def white_e(self) -> F32:
        """Signal of each channel, float32[channel] in electrons, that the 8 bit image shows as 255."""
        return np.asarray(self.sensor.readout.white_e / self.white_balance, dtype=np.float32)

    def electron_rate_weights(self, wavelength_nm: NDArray[np.float64]) -> F32:
        """float32[channel, band]: electrons per second and pixel for 1 W m⁻² nm⁻¹ in a band, behind each filter."""
        return electron_rate_weights(self.sensor.efficiency, self.pixel_pitch_um, wavelength_nm)

    def electrons_expected(self, irradiance: Irradiance, exposure_s: float) -> Electrons:
        """Expected photo-electrons per pixel behind each filter, noise-free, not clipped."""
        weights = self.electron_rate_weights(irradiance.wavelength_nm) * np.float32(exposure_s)
        return Electrons(array=electrons_of(irradiance, weights), white_e=self.white_e)

    def draw_noise(self, shape: tuple[int, int], rng: Callable[[str], np.random.Generator]) -> MosaicNoise:
        """Variates of one exposure, by the generators of their names."""
        return MosaicNoise.draw(shape, rng("shot"), rng("read"), rng("row"))

    def raw(
        self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts | None = None
    ) -> NDArray[np.uint16]:
        """Raw mosaic, uint16[y, x]; noise-free without `noise`, which is what `draw_noise` gives. `acts` are what
        faults do on the way (`chain.STEPS`)."""
        return self.device.raw(sample(expected.array, self.sensor.pattern), exposure_s, noise, acts or {})

    def develop(self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts | None = None) -> RGBI:
        """The 8 bit picture of expected photo-electrons."""
        return self.device.rgbi(self.raw(expected, exposure_s, noise, acts), exposure_s)

    @property
    def step_e(self) -> float:
        """Electrons of one DN of 255 in a channel whose white balance is 1."""
        return self.sensor.readout.white_e / 255

    def footprint(self, changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """bool[y, x]: pixels of the picture that pixels of the mosaic, bool[y, x], can reach."""
        sensor = self.sensor
        if sensor.correct_defects:
            changed = changed | mended_from(changed, self.device.bad, sensor.pattern)
        return footprint(changed, sensor.pattern, sensor.method)

    @property
    def optics_key(self) -> Any:
        """What the electrons expected behind the filters depend on."""
        return (
            self.sensor.efficiency,
            self.sensor.readout.white_e,
            self.pixel_pitch_um,
            self.width_px,
            self.height_px,
        )

    @property
    def device(self) -> Device:
        """The device at work."""
        return _device(self.sensor, self.seed, (self.height_px, self.width_px), self.direction)


@lru_cache(maxsize=4)
def _device(sensor: Sensor, seed: int, shape: tuple[int, int], direction: str) -> Device:
    return Device(sensor, seed, shape=shape, direction=direction)
