"""One device of a sensor at work: from photo-electrons expected in its mosaic to raw numbers and to a picture.

    expected photo-electrons → response of each pixel (PRNU, dead pixels) → smear, parasitic light → dark current,
    telegraph signals → shot noise → particles → blooming → traps → offsets → full well, nodes, noise, converter
    (`readout`) → raw → black level, defect correction, demosaic, white balance → RGBI

Smear is light that falls on charge under way, so it comes before the shot noise. Offsets (DSNU, "partially stuck"
pixels) are no charge: they have no shot noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..quantities import LUMINANCE, RGBI
from .charge import ChargeCloud, bloom, cti, parasitic_light, smear, smear_interline
from .demosaic import correct_defects, demosaic, interpolate
from .efficiency import white_balance
from .individual import Individual, IndividualSpec, dark_rate_e_s, make_individual, offset_e, response
from .mosaic import channel_of
from .readout import ReadoutIndividual, ReadoutNoise, read_out
from .sensor import Sensor
from .three_colour import _normal_field, poisson_quantile

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]

# What may act on a picture under way, and where: on the electrons expected in each pixel, before shot noise; on
# those collected; on the raw numbers.
STEPS = ("pixels", "charge", "raw")
Acts = Mapping[str, Sequence[Callable[[Any], Any]]]
_NOTHING: Acts = {}


@dataclass(frozen=True, kw_only=True, eq=False)
class MosaicNoise:
    """Variates of one exposure: `shot` float32[y, x], standard normal, those of the readout, and a generator's seed
    for the few pixels whose dark current jumps."""

    shot: F32
    readout: ReadoutNoise
    telegraph_seed: int = 0

    @classmethod
    def draw(
        cls, shape: tuple[int, int], shot: np.random.Generator, read: np.random.Generator, row: np.random.Generator
    ) -> MosaicNoise:
        """For a (height, width) sensor: as many variates whatever the signal."""
        return cls(
            shot=_normal_field(shape, shot),
            readout=ReadoutNoise.draw(shape, read, row),
            telegraph_seed=int(row.integers(2**63)),
        )


class Device:
    """One individual of a sensor at a temperature: what its pictures share is made once.

    Parameters
    ----------
    seed
        Of the individual, at least 0: the same seed is the same device for life.
    shape
        (height, width) of the part that is looked at; default: the whole sensor.
    temperature_K
        Default: the sensor's own.
    direction
        Towards which a CCD's rows are read: "up" or "down".
    """

    def __init__(
        self,
        sensor: Sensor,
        seed: int,
        *,
        shape: tuple[int, int] | None = None,
        temperature_K: float | None = None,
        direction: str = "up",
    ) -> None:
        self.sensor, self.direction = sensor, direction
        self.shape = (sensor.height_px, sensor.width_px) if shape is None else shape
        self.temperature_K = sensor.temperature_K if temperature_K is None else temperature_K
        self.individual = individual(sensor.individual, self.shape, sensor.pixel_pitch_um, seed)
        self.readout_individual = ReadoutIndividual.draw(
            self.shape, sensor.readout, np.random.default_rng(np.random.SeedSequence([seed, *b"readout"]))
        )
        self.response = response(self.individual)
        self.offset_e = offset_e(self.individual)
        self.dark_rate_e_s = dark_rate_e_s(self.individual, self.temperature_K)
        self._telegraph = self.individual.rts.at(self.temperature_K)

    # --- light to numbers -----------------------------------------------------------------------------------------

    def expected_e(self, photo_e: F32, exposure_s: float) -> F32:
        """Electrons expected in each pixel, float32[y, x], telegraph signals aside, of photo-electrons expected
        there if all pixels responded alike."""
        sensor, move = self.sensor, self.sensor.transfer
        light = cv2.multiply(photo_e, self.response)
        rate = light * np.float32(1 / exposure_s) if exposure_s > 0 else 0 * light
        if sensor.architecture == "frame_transfer_ccd" and (move.row_transfer_s or move.row_clear_s):
            light = smear(
                rate,
                exposure_s=exposure_s,
                row_transfer_s=move.row_transfer_s,
                row_clear_s=move.row_clear_s,
                direction=self.direction,
            )
        elif sensor.architecture == "interline_ccd" and move.leak:
            light = smear_interline(
                rate,
                exposure_s=exposure_s,
                row_transfer_s=move.row_transfer_s,
                leak=move.leak,
                direction=self.direction,
            )
        elif sensor.architecture == "cmos" and sensor.shutter == "global" and move.leak:
            light = parasitic_light(
                light, rate, sensitivity=move.leak, row_period_s=move.row_readout_s, direction=self.direction
            )
        return np.asarray(cv2.scaleAdd(self.dark_rate_e_s, exposure_s, light))

    def collected_e(
        self, photo_e: F32, exposure_s: float, noise: MosaicNoise | None = None, acts: Acts = _NOTHING
    ) -> F32:
        """Charge at the output, float32[y, x] in e, before offsets and the readout."""
        sensor, move = self.sensor, self.sensor.transfer
        charge = self.expected_e(photo_e, exposure_s)
        if len(self.individual.rts):
            self._add_telegraph(charge, exposure_s, None if noise is None else noise.telegraph_seed)
        for act in acts.get("pixels", ()):
            charge = act(charge)
        if noise is not None:
            charge = poisson_quantile(charge, noise.shot)
        for act in acts.get("charge", ()):
            charge = act(charge)
        if sensor.architecture != "cmos":
            charge = bloom(
                charge,
                full_well_e=sensor.readout.full_well_e,
                antiblooming=move.antiblooming,
                direction=self.direction,
            )
            cloud = ChargeCloud(full_well_e=sensor.readout.full_well_e) if move.cloud is None else move.cloud
            if move.parallel_traps:
                charge = cti(
                    charge,
                    move.parallel_traps,
                    cloud=cloud,
                    transfer_s=move.row_readout_s,
                    direction=self.direction,
                )
            if move.serial_traps:
                charge = cti(
                    charge, move.serial_traps, cloud=cloud, transfer_s=move.pixel_transfer_s, direction="left"
                )
        return charge

    def raw(self, photo_e: F32, exposure_s: float, noise: MosaicNoise | None = None, acts: Acts = _NOTHING) -> Raw:
        """Raw DN, uint16[y, x]; noise-free without `noise`. `acts` are what faults do at the `STEPS`."""
        charge = cv2.add(self.collected_e(photo_e, exposure_s, noise, acts), self.offset_e)
        stuck = self.individual.stuck
        raw = read_out(
            charge,
            self.sensor.readout,
            None if noise is None else noise.readout,
            self.readout_individual,
        )
        if len(stuck):
            raw[stuck.row, stuck.column] = np.rint(stuck.level * self.sensor.readout.top_dn)
        for act in acts.get("raw", ()):
            raw = act(raw)
        return raw

    def _add_telegraph(self, charge: F32, exposure_s: float, seed: int | None) -> None:
        signals, pixels = self._telegraph, self.individual.rts
        if seed is None:
            share: Any = signals.duty
        else:
            rng = np.random.default_rng(seed)
            share, _ = signals.expose(signals.start(rng), exposure_s, rng)
        np.add.at(charge, (pixels.row, pixels.column), signals.amplitude_e_s * share * exposure_s)

    # --- numbers to a picture -------------------------------------------------------------------------------------

    def black_dn(self, exposure_s: float) -> float:
        """Level of no light: bias and mean dark signal, as a camera's covered pixels tell it."""
        readout = self.sensor.readout
        return readout.bias_dn + readout.system_gain_dn_per_e * float(self.dark_rate_e_s.mean()) * exposure_s

    @cached_property
    def bad(self) -> NDArray[np.bool_]:
        """Pixels that a map of defects would name: hot, dead and stuck ones, bool[y, x]."""
        out = np.zeros(self.shape, dtype=bool)
        for defects in (self.individual.hot, self.individual.dead, self.individual.stuck):
            out[defects.row, defects.column] = True
        return out

    def rgbi(self, raw: Raw, exposure_s: float) -> RGBI:
        """The 8 bit picture of a raw mosaic: bad pixels corrected first if the sensor does so, I from W where there
        is one."""
        sensor = self.sensor
        mosaic: NDArray[Any] = raw
        if sensor.correct_defects:
            mosaic = correct_defects(raw, self.bad, sensor.pattern)
        black = self.black_dn(exposure_s)
        full = 255.0 / max(sensor.readout.top_dn - black, 1.0)
        scale = {
            name: full * float(gain) for name, gain in zip(sensor.pattern.channels, self.white_balance, strict=True)
        }
        shown = [scale.get(colour, scale.get("W", full)) for colour in "RGB"]
        linear = demosaic(mosaic, sensor.pattern, sensor.method)
        rgb = cv2.multiply(cv2.subtract(linear, (black, black, black, 0.0)), (*shown, 0.0), dtype=cv2.CV_8U)
        out = np.empty((*raw.shape, 4), dtype=np.uint8)
        if "W" in sensor.pattern.channels:
            white = interpolate(mosaic, sensor.pattern, "W")
            intensity = cv2.multiply(cv2.subtract(white, black), scale["W"], dtype=cv2.CV_8U)
        else:
            intensity = cv2.transform(rgb, LUMINANCE.reshape(1, 3).astype(np.float64))
        intensity = intensity.reshape(*raw.shape, 1)
        cv2.mixChannels([rgb, intensity], [out], [0, 0, 1, 1, 2, 2, 3, 3])
        return RGBI(array=out)

    @property
    def white_balance(self) -> NDArray[np.float32]:
        """Gain of each channel, float32[channel], as `efficiency.white_balance`."""
        return white_balance(self.sensor.efficiency)


@lru_cache(maxsize=4)
def individual(spec: IndividualSpec, shape: tuple[int, int], pixel_pitch_um: float, seed: int) -> Individual:
    """An individual, made once."""
    return make_individual(spec, shape, pixel_pitch_um=pixel_pitch_um, seed=seed)


def channel_sites(sensor: Sensor) -> dict[str, tuple[slice, slice]]:
    """Of each channel, a regular grid of its pixels: the first place of it in a tile."""
    tile = np.array(sensor.pattern.tile)
    out = {}
    for k, name in enumerate(sensor.pattern.channels):
        row, column = np.argwhere(tile == k)[0]
        out[name] = (slice(int(row), None, tile.shape[0]), slice(int(column), None, tile.shape[1]))
    return out


def by_channel(sensor: Sensor, shape: tuple[int, int], values: Sequence[float]) -> F32:
    """A mosaic with a value for each channel, float32[y, x]."""
    return np.asarray(values, dtype=np.float32)[channel_of(sensor.pattern, shape)]
