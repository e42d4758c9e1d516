"""Provide the camera's detector for a sensor with a colour mosaic.

`three_colour.ThreeColourDetector` is the simpler alternative, in which every pixel senses all colours.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.quantities import RGBI, Electrons
from .chain import Device, MosaicNoise
from .demosaic import footprint, mended_from
from .effects import Acts, Effect
from .efficiency import QuantumEfficiency
from .interface import Detector
from .mosaic import sample
from .sensor import Sensor

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class MosaicDetector(Detector):
    """Represent one device of a sensor type as the detector of a camera.

    The detector uses `width_px` × `height_px` pixels of the sensor. Charge moves and rows are read in `direction`
    ("up" or "down"). `seed` selects the device. Raises InputError if the sensor has fewer pixels.
    """

    sensor: Sensor
    seed: int = 0
    width_px: int = 1024
    height_px: int = 1024
    direction: str = "up"

    def __post_init__(self) -> None:
        sensor = self.sensor
        for key in ("width_px", "height_px"):
            if getattr(self, key) > getattr(sensor, key):
                raise InputError(
                    f"{key} = {getattr(self, key)}: {sensor.name} has {getattr(sensor, key)}; must be at most that"
                )
        if sensor.measured is not None:
            sensor.measured.corner((self.height_px, self.width_px), sensor)

    @property
    def name(self) -> str:
        """Return the name of the sensor."""
        return self.sensor.name

    @property
    def pixel_pitch_um(self) -> float:
        """Return the pixel pitch in µm."""
        return self.sensor.pixel_pitch_um

    @property
    def full_well_e(self) -> float:
        """Return the full well in electrons."""
        return self.sensor.readout.full_well_e

    @property
    def read_noise_e_rms(self) -> float:
        """Return the temporal noise of a dark pixel, as `ReadoutSpec.noise_e_rms`."""
        return self.sensor.readout.noise_e_rms

    @property
    def dark_current_e_s(self) -> float:
        """Return the mean dark current of undamaged pixels in e/s at the sensor's temperature."""
        spec = self.sensor.individual
        return spec.dark_current_e_s * spec.dark_factor(self.sensor.temperature_K)

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the channels of the pattern: the planes of the light on the sensor, before the mosaic."""
        return self.sensor.pattern.channels

    @property
    def efficiency(self) -> QuantumEfficiency:
        """Return the quantum efficiency behind each filter."""
        return self.sensor.efficiency

    @property
    def white_e(self) -> F32:
        """Return the signal of each channel in electrons that the 8 bit image shows as 255, float32[channel]."""
        return np.asarray(self.sensor.readout.white_e / self.white_balance, dtype=np.float32)

    def draw_noise(self, shape: tuple[int, int], rng: Callable[[str], np.random.Generator]) -> MosaicNoise:
        """Draw the variates of one exposure. `rng` returns the random generator for a name."""
        return MosaicNoise.draw(shape, rng("shot"), rng("read"), rng("row"))

    def raw(
        self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts | None = None
    ) -> NDArray[np.uint16]:
        """Return the raw mosaic, uint16[y, x].

        `noise` comes from `draw_noise`; None gives a noise-free mosaic. `acts` are the changes that faults make at
        the steps of `effects.STEPS`.
        """
        return self.device.raw(sample(expected.array, self.sensor.pattern), exposure_s, noise, acts or {})

    def collected_e(self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts) -> F32:
        """Return the charge at the output, float32[y, x] in e, before the full well; arguments are as in `raw`."""
        return self.device.collected_e(sample(expected.array, self.sensor.pattern), exposure_s, noise, acts)

    def develop(self, expected: Electrons, exposure_s: float, noise: Any, acts: Acts | None = None) -> RGBI:
        """Return the 8 bit image of the expected photo-electrons. Arguments are as in `raw`."""
        return self.rgbi(self.raw(expected, exposure_s, noise, acts), exposure_s)

    def rgbi(self, raw: NDArray[np.uint16], exposure_s: float) -> RGBI:
        """Return the 8 bit image of a raw mosaic uint16[y, x]."""
        return self.device.rgbi(raw, exposure_s)

    @property
    def step_e(self) -> float:
        """Return the electrons per DN of the 8 bit image, in a channel whose white balance is 1."""
        return self.sensor.readout.white_e / 255

    def footprint(self, changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the pixels of the image that the given mosaic pixels, bool[y, x], can influence, bool[y, x]."""
        sensor = self.sensor
        if sensor.correct_defects:
            changed = changed | mended_from(changed, self.device.bad, sensor.pattern)
        return footprint(changed, sensor.pattern, sensor.method)

    @property
    def optics_key(self) -> Any:
        """Return a key of everything on which the expected electrons behind the filters depend."""
        return (
            self.sensor.efficiency,
            self.sensor.readout.white_e,
            self.pixel_pitch_um,
            self.width_px,
            self.height_px,
        )

    @property
    def mosaic(self) -> MosaicDetector:
        """Return the detector itself, which has a colour mosaic."""
        return self

    @property
    def description(self) -> dict[str, Any]:
        """Return what a user of the raw mosaic or of the noise needs to know, as plain JSON data."""
        sensor = self.sensor
        readout, tile = sensor.readout, sensor.pattern.tile
        return {
            "name": self.name,
            "pixel_pitch_um": self.pixel_pitch_um,
            "full_well_e": self.full_well_e,
            "read_noise_e_rms": self.read_noise_e_rms,
            "architecture": sensor.architecture,
            "shutter": sensor.shutter,
            "mosaic": [[sensor.pattern.channels[k] for k in row] for row in tile],
            "bits": readout.bits,
            "bias_dn": readout.bias_dn,
            "gain_dn_per_e": readout.system_gain_dn_per_e,
            "nodes": readout.nodes,
            "node_gains": list(readout.node_gains),
            "node_offsets_dn": list(readout.node_offsets_dn),
            "white_balance": dict(zip(self.channels, self.white_balance.tolist(), strict=True)),
            "temperature_K": sensor.temperature_K,
            "row_readout_s": sensor.transfer.row_readout_s,
            "demosaic": sensor.method,
            # the whole description of the sensor, with the sources of its values
            "sensor": json.loads(json.dumps(_plain_sensor(sensor), default=_plain)),
        }

    @property
    def device(self) -> Device:
        """Return the simulated device, which is cached."""
        return _device(self.sensor, self.seed, shape=(self.height_px, self.width_px), direction=self.direction)


_device = lru_cache(maxsize=6)(Device)  # one of another readout takes 2 MB for 1024 pixels (`chain._maps`)


def _plain_sensor(sensor: Sensor) -> dict[str, Any]:
    """Return the description of a sensor as plain data; measured files have names and digests, not paths."""
    plain = asdict(replace(sensor, defects=None, measured=None))
    del plain["measured"], plain["defects"]
    return plain if sensor.measured is None else plain | {"defects": sensor.measured.description}


def _plain(effect: Effect) -> dict[str, Any]:
    """Return an effect of a sensor as plain data."""
    return {"name": effect.name, **effect.model_dump(mode="json")}
