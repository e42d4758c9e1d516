"""One device of a sensor at work: from photo-electrons expected in its mosaic to raw numbers and to a picture.

    expected photo-electrons → response of each pixel (PRNU, dead pixels) → smear, parasitic light → dark current,
    that of charge under way, telegraph signals → shot noise → particles → blooming → traps → full well → offsets,
    nodes, noise, converter (`readout`) → raw → defect correction, black level, demosaic, white balance → RGBI

Smear is light that falls on charge under way, so it comes before the shot noise. Offsets (DSNU, "partially stuck"
pixels) are no charge: they have no shot noise, and no well limits them. A stuck pixel shows its level as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.quantities import DEAD, HOT, LUMINANCE, RGBI, RTS, RTS_HIGH, STUCK, TRAP
from .charge import ChargeCloud, bloom, capture, cti, parasitic_light, smear, smear_interline
from .dark import Telegraph
from .demosaic import bounded_at_edges, correct_defects, demosaic, interpolate
from .efficiency import white_balance
from .individual import Individual, IndividualSpec, StuckPixels, dark_rate_e_s, make_individual, offset_e, response
from .mosaic import channel_of
from .readout import ReadoutIndividual, ReadoutNoise, read_out
from .sensor import Sensor
from .three_colour import _normal_field, poisson_quantile

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]

# What may act on a picture under way, and where: on the photo-electrons to which each pixel responds, before smear
# and dark current; on all electrons expected in each pixel, before shot noise; on those collected; on the offsets
# that are added to them; on the raw numbers.
STEPS = ("light", "pixels", "charge", "offsets", "raw")
Acts = Mapping[str, Sequence[Callable[[Any], Any]]]
_NOTHING: Acts = {}

_LEAST_BLACK_DN = 0.05


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
        self.response = response(self.individual)
        self.offset_e = offset_e(self.individual)
        drawn = ReadoutIndividual.draw(
            self.shape, sensor.readout, np.random.default_rng(np.random.SeedSequence([seed, *b"readout"]))
        )
        self.readout_individual = replace(drawn, pixel_e=self.offset_e)
        self.dark_rate_e_s = dark_rate_e_s(self.individual, self.temperature_K)
        self.transfer_dark_e = transfer_dark_e(sensor, self.dark_rate_e_s, direction)
        self._telegraph = self.individual.rts.at(self.temperature_K)

    # --- light to numbers -----------------------------------------------------------------------------------------

    def expected_e(self, photo_e: F32, exposure_s: float, acts: Acts = _NOTHING) -> F32:
        """Return the electrons expected in each pixel, float32[y, x], telegraph signals aside, of photo-electrons
        expected there if all pixels responded alike; `acts` as in `raw`."""
        light: F32 = np.asarray(cv2.multiply(photo_e, self.response))
        for act in acts.get("light", ()):
            light = act(light)
        light = self._smeared(light, exposure_s)
        out = np.asarray(cv2.scaleAdd(self.dark_rate_e_s, exposure_s, light))
        return out if self.transfer_dark_e is None else cv2.add(out, self.transfer_dark_e)

    def _smeared(self, light: F32, exposure_s: float) -> F32:
        """Electrons with those of the light that falls on charge under way, or waiting."""
        sensor, move = self.sensor, self.sensor.transfer
        steps = {
            "frame_transfer_ccd": (
                move.row_transfer_s + move.row_clear_s,
                partial(smear, row_transfer_s=move.row_transfer_s, row_clear_s=move.row_clear_s),
            ),
            "full_frame_ccd": (
                move.row_readout_s * move.shutter_transmission,
                partial(smear, row_transfer_s=move.row_readout_s, shutter_transmission=move.shutter_transmission),
            ),
            "interline_ccd": (
                move.row_transfer_s * move.leak,
                partial(smear_interline, row_transfer_s=move.row_transfer_s, leak=move.leak),
            ),
            # the store of a global shutter; a rolling one reads at once
            "cmos": (move.row_readout_s * move.leak * (sensor.shutter == "global"), None),
        }
        weight, step = steps[sensor.architecture]
        if not weight or exposure_s <= 0:
            return light
        rate = light * np.float32(1 / exposure_s)
        if step is None:
            return parasitic_light(
                light, rate, sensitivity=move.leak, row_period_s=move.row_readout_s, direction=self.direction
            )
        return self._along_columns(partial(step, exposure_s=exposure_s), rate)

    def collected_e(
        self, photo_e: F32, exposure_s: float, noise: MosaicNoise | None = None, acts: Acts = _NOTHING
    ) -> F32:
        """Charge at the output, float32[y, x] in e, before offsets and the readout."""
        sensor, move = self.sensor, self.sensor.transfer
        charge = self.expected_e(photo_e, exposure_s, acts)
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
            if len(self.individual.traps):
                charge = self._along_columns(self._captured, charge)
            cloud = ChargeCloud(full_well_e=sensor.readout.full_well_e) if move.cloud is None else move.cloud
            if move.parallel_traps:
                clock = partial(cti, species=move.parallel_traps, cloud=cloud, transfer_s=move.row_readout_s)
                charge = self._along_columns(clock, charge)
            if move.serial_traps:
                clock = partial(cti, species=move.serial_traps, cloud=cloud, transfer_s=move.pixel_transfer_s)
                charge = self._along_registers(clock, charge)
        return charge

    def raw(self, photo_e: F32, exposure_s: float, noise: MosaicNoise | None = None, acts: Acts = _NOTHING) -> Raw:
        """Raw DN, uint16[y, x]; noise-free without `noise`. `acts` are what faults do at the `STEPS`."""
        charge = self.collected_e(photo_e, exposure_s, noise, acts)
        chain = self.readout_individual
        for act in acts.get("offsets", ()):
            chain = replace(chain, pixel_e=act(chain.pixel_e))
        raw = read_out(charge, self.sensor.readout, None if noise is None else noise.readout, chain)
        show_stuck(raw, self.individual.stuck, self.sensor.readout.top_dn)
        for act in acts.get("raw", ()):
            raw = act(raw)
        return raw

    def _captured(self, charge: F32, *, direction: str) -> F32:
        traps = self.individual.traps
        # of a half, the rows that are read this way
        first = len(self.response) - len(charge) if direction == "down" else 0
        here = (traps.row >= first) & (traps.row < first + len(charge))
        return capture(
            charge, traps.row[here] - first, traps.column[here], traps.depth_e[here], direction=direction
        )

    def _along_columns(self, step: Callable[..., F32], image: F32) -> F32:
        return along_columns(self.sensor, self.direction, step, image)

    def _along_registers(self, step: Callable[..., F32], image: F32) -> F32:
        """As `along_columns`, along rows: to the left, or each half to its own side with two nodes or four."""
        if self.sensor.readout.nodes == 1:
            return step(image, direction="left")
        middle = (image.shape[1] + 1) // 2
        return np.concatenate(
            [step(image[:, :middle], direction="left"), step(image[:, middle:], direction="right")], axis=1
        )

    def _add_telegraph(self, charge: F32, exposure_s: float, seed: int | None) -> None:
        pixels = self.individual.rts
        share = self._telegraph.duty if seed is None else upper_share(self._telegraph, exposure_s, seed)
        high_e_s = self._telegraph.amplitude_e_s * share
        np.add.at(charge, (pixels.row, pixels.column), high_e_s * exposure_s)
        if self.transfer_dark_e is not None:  # charge under way waits in these pixels, too
            rate = np.zeros_like(charge)
            np.add.at(rate, (pixels.row, pixels.column), high_e_s)
            charge += passing_dark_e(self.sensor, rate, self.direction)

    # --- numbers to a picture -------------------------------------------------------------------------------------

    def black_dn(self, exposure_s: float) -> float:
        """Level of no light: bias and mean dark signal, as a camera's covered pixels tell it; that of charge under
        way aside, which is for each row another."""
        readout = self.sensor.readout
        return readout.bias_dn + readout.system_gain_dn_per_e * float(self.dark_rate_e_s.mean()) * exposure_s

    @cached_property
    def row_black_dn(self) -> F32 | None:
        """What each row's level of no light is higher for the dark current of its charge under way, float32[y, 1];
        None where that is too little to matter."""
        if self.transfer_dark_e is None:
            return None
        rows = np.median(self.transfer_dark_e, axis=1, keepdims=True) * self.sensor.readout.system_gain_dn_per_e
        return rows.astype(np.float32) if rows.max() > _LEAST_BLACK_DN else None

    @cached_property
    def saturated_dn(self) -> Raw:
        """Raw number from which each pixel counts as saturated, uint16[y, x] in DN.

        It is what a full well gives there through the pixel's own node, offsets and converter, less what temporal
        noise can take away (interference whole, the rest four standard deviations).
        """
        readout = self.sensor.readout
        full = np.full(self.shape, readout.full_well_e, dtype=np.float32)
        temporal_e = math.hypot(readout.noise_e_rms, readout.row_noise_e_rms)
        margin_dn = (4 * temporal_e + 2 * readout.banding_seen_e) * readout.system_gain_dn_per_e
        level = read_out(full, readout, None, self.readout_individual) - np.float32(margin_dn)
        return np.ceil(np.maximum(level, 0)).astype(np.uint16)

    @cached_property
    def bad(self) -> NDArray[np.bool_]:
        """Pixels that a map of defects would name: hot, dead and stuck ones, bool[y, x]."""
        return (self._kinds & (HOT | DEAD | STUCK)) > 0

    def defects(self, exposure_s: float, noise: MosaicNoise) -> NDArray[np.uint8]:
        """What is wrong with each pixel of the mosaic in one exposure, uint8[y, x]: bits of
        `quantities.DEFECTS`."""
        out = self._kinds.copy()
        pixels = self.individual.rts
        high = upper_share(self._telegraph, exposure_s, noise.telegraph_seed) > 0.5
        out[pixels.row[high], pixels.column[high]] |= RTS_HIGH
        return out

    @cached_property
    def _kinds(self) -> NDArray[np.uint8]:
        out = np.zeros(self.shape, dtype=np.uint8)
        one = self.individual
        for value, some in (
            (HOT, one.hot),
            (DEAD, one.dead),
            (STUCK, one.stuck),
            (RTS, one.rts),
            (TRAP, one.traps),
        ):
            out[some.row, some.column] |= value
        return out

    def rgbi(self, raw: Raw, exposure_s: float) -> RGBI:
        """The 8 bit picture of a raw mosaic: bad pixels corrected first if the sensor does so, I from W where there
        is one."""
        sensor = self.sensor
        mosaic: NDArray[Any] = raw
        if sensor.correct_defects:
            mosaic = correct_defects(raw, self.bad, sensor.pattern)
        saturated = mosaic >= self.saturated_dn
        black, highest = self.black_dn(exposure_s), 0.0
        if self.row_black_dn is not None:
            mosaic, highest = mosaic - self.row_black_dn, float(self.row_black_dn.max())
        # what is left above the highest black level is white: a saturated pixel stays so, also where its full well
        # falls short of the top code
        white = sensor.readout.bias_dn + sensor.readout.system_gain_dn_per_e * sensor.readout.white_e
        full = 255.0 / max(white - black - highest, 1.0)
        scale = {
            name: full * float(gain) for name, gain in zip(sensor.pattern.channels, self.white_balance, strict=True)
        }
        shown = [scale.get(colour, scale.get("W", full)) for colour in "RGB"]
        linear = demosaic(mosaic, sensor.pattern, sensor.method)
        noise_dn = sensor.readout.read_noise_e_rms * sensor.readout.system_gain_dn_per_e
        linear = bounded_at_edges(
            linear, mosaic, sensor.pattern, sensor.method, black=black, noise=noise_dn, clipped=saturated
        )
        rgb = cv2.multiply(cv2.subtract(linear, (black, black, black, 0.0)), (*shown, 0.0), dtype=cv2.CV_8U)
        out = np.empty((*raw.shape, 4), dtype=np.uint8)
        if "W" in sensor.pattern.channels:
            unfiltered = interpolate(mosaic, sensor.pattern, "W")
            intensity = cv2.multiply(cv2.subtract(unfiltered, black), scale["W"], dtype=cv2.CV_8U)
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


def transfer_dark_e(sensor: Sensor, dark_rate_e_s: F32, direction: str) -> F32 | None:
    """Electrons that packets of a CCD gather from dark current on their way, float32[y, x]; None on CMOS.

    A full-frame CCD clocks a packet through all pixels between its own and the register, a row's readout time in
    each, so that a hot pixel draws a line behind it. In the store of a frame-transfer CCD and the registers of an
    interline one packets wait as long, in pixels as the median one of the image (assumed); on its quick way to the
    store a packet of the former passes the image's.
    """
    move = sensor.transfer
    if sensor.architecture == "cmos" or not (move.row_readout_s or move.row_transfer_s):
        return None
    if sensor.architecture == "full_frame_ccd":
        return passing_dark_e(sensor, dark_rate_e_s, direction)
    even = np.full_like(dark_rate_e_s, np.median(dark_rate_e_s))
    waiting = partial(smear, exposure_s=0.0, row_transfer_s=move.row_readout_s)
    return along_columns(sensor, direction, waiting, even) + passing_dark_e(sensor, dark_rate_e_s, direction)


def passing_dark_e(sensor: Sensor, dark_rate_e_s: F32, direction: str) -> F32:
    """The part of `transfer_dark_e` that comes from the image's own pixels, float32[y, x]: linear in their rate."""
    period_s = {
        "full_frame_ccd": sensor.transfer.row_readout_s,
        "frame_transfer_ccd": sensor.transfer.row_transfer_s,
    }.get(sensor.architecture, 0.0)
    if not period_s:
        return np.zeros_like(dark_rate_e_s)
    gather = partial(smear, exposure_s=0.0, row_transfer_s=period_s)
    return along_columns(sensor, direction, gather, dark_rate_e_s)


def along_columns(sensor: Sensor, direction: str, step: Callable[..., F32], image: F32) -> F32:
    """`step(part, direction=…)` for what is read towards one register: all rows, or each half of them where four
    nodes sit in the corners."""
    if sensor.readout.nodes < 4:
        return step(image, direction=direction)
    middle = (len(image) + 1) // 2
    return np.concatenate([step(image[:middle], direction="up"), step(image[middle:], direction="down")])


def show_stuck(raw: Raw, stuck: StuckPixels, top_dn: int) -> None:
    """Set stuck pixels of a raw mosaic, uint16[y, x], to their levels, in place; of two in one pixel the later."""
    raw[stuck.row, stuck.column] = np.rint(stuck.level * top_dn)


def upper_share(signals: Telegraph, exposure_s: float, seed: int) -> NDArray[np.float64]:
    """The share of an exposure that telegraph signals spend in their upper level, float64[n], by a seed."""
    rng = np.random.default_rng(seed)
    return signals.expose(signals.start(rng), exposure_s, rng)[0]


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
