"""Simulate one device with a colour mosaic: from expected photo-electrons to raw DN and to the RGBI image.

    expected photo-electrons → response of each pixel (PRNU, dead pixels) → smear, parasitic light
    → dark current (also during charge transfer), telegraph signals → shot noise → particles → blooming → traps
    → full well → offsets, nodes, noise, converter (`readout`) → raw DN
    → defect correction, black level, demosaicing, white balance → RGBI

Smear is light that falls on charge during its transfer, so it comes before the shot noise. Offsets (DSNU,
"partially stuck" pixels) are not charge: they have no shot noise, and the full well does not limit them. A stuck
pixel always shows its own level.
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
from .noise import normal_field, poisson_quantile
from .readout import ReadoutIndividual, ReadoutNoise, read_out
from .sensor import Sensor

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]

# Steps at which a fault may act on the signal:
#   light    photo-electrons after each pixel's response, before smear and dark current
#   pixels   all electrons expected in each pixel, before shot noise
#   charge   collected electrons, before blooming
#   offsets  electrons that the readout adds to each pixel
#   raw      raw DN
STEPS = ("light", "pixels", "charge", "offsets", "raw")
Acts = Mapping[str, Sequence[Callable[[Any], Any]]]
_NOTHING: Acts = {}

_LEAST_BLACK_DN = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class MosaicNoise:
    """Hold the variates of one exposure.

    `shot` float32[y, x] is standard normal, `readout` holds the variates of the readout. `telegraph_seed` seeds the
    generator of the few pixels with telegraph signals.
    """

    shot: F32
    readout: ReadoutNoise
    telegraph_seed: int = 0

    @classmethod
    def draw(
        cls, shape: tuple[int, int], shot: np.random.Generator, read: np.random.Generator, row: np.random.Generator
    ) -> MosaicNoise:
        """Draw the variates for a (height, width) sensor. Their number does not depend on the signal."""
        return cls(
            shot=normal_field(shape, shot),
            readout=ReadoutNoise.draw(shape, read, row),
            telegraph_seed=int(row.integers(2**63)),
        )


class Device:
    """Simulate one device of a sensor at one temperature.

    Everything that does not change from exposure to exposure is computed once.

    Parameters
    ----------
    sensor
        Type of the sensor.
    seed
        Seed of the device, at least 0. The same seed always gives the same device.
    shape
        (height, width) in pixels of the part in use; default: the whole sensor.
    temperature_K
        Temperature of the sensor in K; default: `sensor.temperature_K`.
    direction
        Direction in which charge moves and rows are read: "up" (row 0 first) or "down".
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

    # --- light to raw DN ------------------------------------------------------------------------------------------

    def expected_e(self, photo_e: F32, exposure_s: float, acts: Acts = _NOTHING) -> F32:
        """Return the electrons expected in each pixel, float32[y, x], without telegraph signals.

        `photo_e` float32[y, x] are the photo-electrons expected if all pixels had the same response. `acts` is as
        in `raw`.
        """
        light: F32 = np.asarray(cv2.multiply(photo_e, self.response))
        for act in acts.get("light", ()):
            light = act(light)
        light = self._smeared(light, exposure_s)
        out = np.asarray(cv2.scaleAdd(self.dark_rate_e_s, exposure_s, light))
        return out if self.transfer_dark_e is None else cv2.add(out, self.transfer_dark_e)

    def _smeared(self, light: F32, exposure_s: float) -> F32:
        """Return the electrons, with the light added that falls on charge while it moves or waits."""
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
            # only a global shutter stores charge; a rolling shutter reads each row at once
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
        """Return the charge at the output, float32[y, x] in e, before the offsets and the readout."""
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
        """Return raw DN, uint16[y, x].

        Without `noise` the result is noise-free. `acts` are the changes that faults make, by the names of `STEPS`.
        """
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
        """Return the charge after the deep traps of the device."""
        traps = self.individual.traps
        # where the sensor is read in two halves, select the traps of this half
        first = len(self.response) - len(charge) if direction == "down" else 0
        here = (traps.row >= first) & (traps.row < first + len(charge))
        return capture(
            charge, traps.row[here] - first, traps.column[here], traps.depth_e[here], direction=direction
        )

    def _along_columns(self, step: Callable[..., F32], image: F32) -> F32:
        """Apply a step along the columns, as the function `along_columns` does."""
        return along_columns(self.sensor, self.direction, step, image)

    def _along_registers(self, step: Callable[..., F32], image: F32) -> F32:
        """Apply a step along the rows: all to the left or, with two or four nodes, each half to its own side."""
        if self.sensor.readout.nodes == 1:
            return step(image, direction="left")
        middle = (image.shape[1] + 1) // 2
        return np.concatenate(
            [step(image[:, :middle], direction="left"), step(image[:, middle:], direction="right")], axis=1
        )

    def _add_telegraph(self, charge: F32, exposure_s: float, seed: int | None) -> None:
        """Add the electrons of the telegraph signals to the charge, in place; without a seed, the expected ones."""
        pixels = self.individual.rts
        share = self._telegraph.duty if seed is None else upper_share(self._telegraph, exposure_s, seed)
        high_e_s = self._telegraph.amplitude_e_s * share
        np.add.at(charge, (pixels.row, pixels.column), high_e_s * exposure_s)
        if self.transfer_dark_e is not None:  # charge that passes these pixels collects this signal, too
            rate = np.zeros_like(charge)
            np.add.at(rate, (pixels.row, pixels.column), high_e_s)
            charge += passing_dark_e(self.sensor, rate, self.direction)

    # --- raw DN to image ------------------------------------------------------------------------------------------

    def black_dn(self, exposure_s: float) -> float:
        """Return the black level in DN: the bias and the mean dark signal of the exposure.

        A real camera measures this level in its covered pixels. The dark signal of the charge transfer is not
        included, because it differs from row to row (`row_black_dn`).
        """
        readout = self.sensor.readout
        return readout.bias_dn + readout.system_gain_dn_per_e * float(self.dark_rate_e_s.mean()) * exposure_s

    @cached_property
    def row_black_dn(self) -> F32 | None:
        """Return how far the dark signal of the charge transfer raises each row's black level, float32[y, 1], DN.

        None if this is at most `_LEAST_BLACK_DN` in every row.
        """
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
        """Return the hot, dead and stuck pixels, bool[y, x], as a camera's defect map would list them."""
        return (self._kinds & (HOT | DEAD | STUCK)) > 0

    def defects(self, exposure_s: float, noise: MosaicNoise) -> NDArray[np.uint8]:
        """Return the defects of each mosaic pixel in one exposure, uint8[y, x], as bits of `quantities.DEFECTS`."""
        out = self._kinds.copy()
        pixels = self.individual.rts
        high = upper_share(self._telegraph, exposure_s, noise.telegraph_seed) > 0.5
        out[pixels.row[high], pixels.column[high]] |= RTS_HIGH
        return out

    @cached_property
    def _kinds(self) -> NDArray[np.uint8]:
        """Return the permanent defects of each mosaic pixel, uint8[y, x], as bits."""
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
        """Return the 8 bit image of a raw mosaic.

        Bad pixels are corrected first if the sensor does so. I comes from the W pixels if there are any, else it is
        the luminance of R, G and B.
        """
        sensor = self.sensor
        mosaic: NDArray[Any] = raw
        if sensor.correct_defects:
            mosaic = correct_defects(raw, self.bad, sensor.pattern)
        saturated = mosaic >= self.saturated_dn
        black, highest = self.black_dn(exposure_s), 0.0
        if self.row_black_dn is not None:
            mosaic, highest = mosaic - self.row_black_dn, float(self.row_black_dn.max())
        # white is the range above the highest black level. A saturated pixel then stays white, even if its full
        # well lies below the top code
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
        """Return the gain of each channel, float32[channel], as `efficiency.white_balance` does."""
        return white_balance(self.sensor.efficiency)


@lru_cache(maxsize=4)
def individual(spec: IndividualSpec, shape: tuple[int, int], pixel_pitch_um: float, seed: int) -> Individual:
    """Return an individual from the cache, or make it."""
    return make_individual(spec, shape, pixel_pitch_um=pixel_pitch_um, seed=seed)


def transfer_dark_e(sensor: Sensor, dark_rate_e_s: F32, direction: str) -> F32 | None:
    """Return the electrons from dark current that charge packets collect during transfer, float32[y, x].

    A full-frame CCD moves each packet through all pixels between its own pixel and the register. It stays in each
    for the readout time of a row, so a hot pixel leaves a line. Packets in the store of a frame-transfer CCD and in
    the registers of an interline CCD wait equally long; their dark current is assumed to be the median of the
    image. In a frame-transfer CCD a packet also passes the image pixels on its quick transfer to the store.

    Returns None for a CMOS sensor, and for a CCD without transfer times.
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
    """Return the part of `transfer_dark_e` from the image's own pixels, float32[y, x]: linear in their rate."""
    period_s = {
        "full_frame_ccd": sensor.transfer.row_readout_s,
        "frame_transfer_ccd": sensor.transfer.row_transfer_s,
    }.get(sensor.architecture, 0.0)
    if not period_s:
        return np.zeros_like(dark_rate_e_s)
    gather = partial(smear, exposure_s=0.0, row_transfer_s=period_s)
    return along_columns(sensor, direction, gather, dark_rate_e_s)


def along_columns(sensor: Sensor, direction: str, step: Callable[..., F32], image: F32) -> F32:
    """Apply `step(part, direction=…)` along the columns of an image.

    A part holds all rows that are read towards one register: the whole image or, with four nodes, each half of it.
    """
    if sensor.readout.nodes < 4:
        return step(image, direction=direction)
    middle = (len(image) + 1) // 2
    return np.concatenate([step(image[:middle], direction="up"), step(image[middle:], direction="down")])


def show_stuck(raw: Raw, stuck: StuckPixels, top_dn: int) -> None:
    """Set the stuck pixels of a raw mosaic, uint16[y, x], to their levels, in place.

    If two of them share a pixel, the later one counts.
    """
    raw[stuck.row, stuck.column] = np.rint(stuck.level * top_dn)


def upper_share(signals: Telegraph, exposure_s: float, seed: int) -> NDArray[np.float64]:
    """Return the fraction of an exposure that each telegraph signal spends in its upper level, float64[n]."""
    rng = np.random.default_rng(seed)
    return signals.expose(signals.start(rng), exposure_s, rng)[0]


def channel_sites(sensor: Sensor) -> dict[str, tuple[slice, slice]]:
    """Return, for each channel, (row, column) slices that select a regular grid of its pixels.

    The grid starts at the channel's first pixel in the tile and has one pixel per tile.
    """
    tile = np.array(sensor.pattern.tile)
    out = {}
    for k, name in enumerate(sensor.pattern.channels):
        row, column = np.argwhere(tile == k)[0]
        out[name] = (slice(int(row), None, tile.shape[0]), slice(int(column), None, tile.shape[1]))
    return out


def by_channel(sensor: Sensor, shape: tuple[int, int], values: Sequence[float]) -> F32:
    """Return a mosaic float32[y, x] that holds one value per channel."""
    return np.asarray(values, dtype=np.float32)[channel_of(sensor.pattern, shape)]
