"""Simulate one device with a colour mosaic: from expected photo-electrons to raw DN and to the RGBI image.

    expected photo-electrons → effects of the chain, in order (`effects`) → raw DN
    → defect correction, black level, demosaicing, white balance → RGBI

Smear is light that falls on charge during its transfer, so it comes before the shot noise. Offsets (DSNU,
"partially stuck" pixels) are not charge: they have no shot noise, and the full well does not limit them. A stuck
pixel always shows its own level.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import VbnfaultError
from ..core.quantities import DEAD, HOT, RGBI, RTS, RTS_HIGH, STUCK, TRAP
from .charge import transfer_dark_e
from .demosaic import bounded_at_edges, correct_defects, demosaic, interpolate
from .effects import Acts, Effect, Exposure, chain_of, is_packaged
from .effects.electrons import upper_fraction
from .effects.output import Nonlinearity
from .efficiency import white_balance
from .individual import Individual, IndividualSpec, dark_rate_e_s, make_individual, offset_e, response
from .interface import luminance
from .measured import as_measured
from .mosaic import channel_of
from .noise import NormalField, draw_normals
from .readout import ReadoutIndividual, ReadoutNoise, ReadoutSpec, read_out
from .sensor import Sensor

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]

_NOTHING: Acts = {}

_LEAST_BLACK_DN = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class MosaicNoise:
    """Hold the variates of one exposure.

    `shot` are the standard normal variates of the shot noise [y, x], `readout` those of the readout. `seed` seeds
    the generators of effects that need few variates. `sequence` is the seed of the telegraph signals of a sequence,
    and the time in s at which the exposure begins in it.
    """

    shot: NormalField
    readout: ReadoutNoise
    seed: int = 0
    sequence: tuple[int, float] | None = None

    @property
    def telegraph(self) -> tuple[int] | tuple[int, float]:
        """Return the seed of the telegraph signals, with the time of the exposure in a sequence."""
        return self.sequence or (self.seed,)

    @classmethod
    def draw(
        cls, shape: tuple[int, int], shot: np.random.Generator, read: np.random.Generator, row: np.random.Generator
    ) -> MosaicNoise:
        """Draw the variates for a (height, width) sensor. Their number does not depend on the signal."""
        return cls(
            shot=draw_normals(shape, shot),
            readout=ReadoutNoise.draw(shape, read, row),
            seed=int(row.integers(2**63)),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Maps:
    """Hold the maps of a device that do not depend on its readout; a fault that changes this leaves them alone."""

    drawn: Individual
    individual: Individual
    response: F32
    offset_e: F32
    dark_rate_e_s: F32
    transfer_dark_e: F32 | None

    @cached_property
    def transfer_rows_e(self) -> F32:
        """Return the median of `transfer_dark_e` in each row, float32[y, 1]."""
        assert self.transfer_dark_e is not None
        return np.asarray(np.median(self.transfer_dark_e, axis=1, keepdims=True))


@lru_cache(maxsize=2)
def _maps(sensor: Sensor, seed: int, shape: tuple[int, int], temperature_K: float, direction: str) -> _Maps:
    """Return the maps of a device of a sensor without its readout, except its nodes."""
    drawn = individual(sensor.individual, shape, sensor.pixel_pitch_um, seed)
    own = as_measured(drawn, sensor)
    rate = dark_rate_e_s(own, temperature_K)
    moved = None  # a dark frame has this signal, too
    if sensor.measured is None or sensor.measured.dark_e_s is None:
        moved = transfer_dark_e(sensor, rate, direction)
    offset = offset_e(own)
    if moved is not None and sensor.transfer.column_reference:
        last = moved.max(axis=0)  # of the row that waits longest
        offset -= last - last.mean()
    return _Maps(
        drawn=drawn,
        individual=own,
        response=response(own),
        offset_e=offset,
        dark_rate_e_s=rate,
        transfer_dark_e=moved,
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
        self.sensor, self.seed, self.direction = sensor, seed, direction
        self.shape = (sensor.height_px, sensor.width_px) if shape is None else shape
        self.temperature_K = sensor.temperature_K if temperature_K is None else temperature_K
        bare = replace(
            sensor,
            readout=ReadoutSpec(nodes=sensor.readout.nodes),
            transfer=replace(sensor.transfer, parallel_traps=(), serial_traps=()),
            effects=(),
        )
        self.maps = _maps(bare, seed, self.shape, self.temperature_K, direction)
        self.drawn, self.individual = self.maps.drawn, self.maps.individual
        self.response, self.offset_e = self.maps.response, self.maps.offset_e
        self.dark_rate_e_s, self.transfer_dark_e = self.maps.dark_rate_e_s, self.maps.transfer_dark_e
        drawn = ReadoutIndividual.draw(
            self.shape, sensor.readout, np.random.default_rng(np.random.SeedSequence([seed, *b"readout"]))
        )
        if sensor.measured is not None and sensor.measured.offset_e is not None:
            drawn = replace(drawn, row_e=None, column_e=None)  # the measured offsets have these patterns
        self.readout_individual = replace(drawn, pixel_e=self.offset_e)
        self.telegraph = self.individual.rts.at(self.temperature_K)
        self.chain = chain_of(sensor.effects)

    # --- light to raw DN ------------------------------------------------------------------------------------------

    def expected_e(self, photo_e: F32, exposure_s: float, acts: Acts = _NOTHING) -> F32:
        """Return the electrons expected in each pixel, float32[y, x], without telegraph signals.

        `photo_e` float32[y, x] are the photo-electrons expected if all pixels had the same response. `acts` is as
        in `raw`.
        """
        electrons: F32 = self._run(photo_e, exposure_s, None, acts, before="telegraph")
        return electrons

    def light_e(self, photo_e: F32, exposure_s: float) -> F32:
        """Return the electrons that light leaves in each pixel, float32[y, x]: with response, crosstalk and smear.

        `photo_e` is as in `expected_e`.
        """
        electrons: F32 = self._run(photo_e, exposure_s, None, _NOTHING, before="dark_current")
        return electrons

    def collected_e(
        self, photo_e: F32, exposure_s: float, noise: MosaicNoise | None = None, acts: Acts = _NOTHING
    ) -> F32:
        """Return the charge at the output, float32[y, x] in e, before the full well and the readout."""
        electrons: F32 = self._run(photo_e, exposure_s, noise, acts, before="full_well")
        return electrons

    def raw(self, photo_e: F32, exposure_s: float, noise: MosaicNoise | None = None, acts: Acts = _NOTHING) -> Raw:
        """Return raw DN, uint16[y, x].

        Without `noise` the result is noise-free. `acts` are the changes that faults make, by the names of `STEPS`.
        """
        return self.read(self.collected_e(photo_e, exposure_s, noise, acts), exposure_s, noise, acts)

    def read(self, collected_e: F32, exposure_s: float, noise: MosaicNoise | None, acts: Acts) -> Raw:
        """Return raw DN, uint16[y, x], of the charge at the output, as `collected_e` gives it."""
        numbers: Raw = self._run(collected_e, exposure_s, noise, acts, start="full_well")
        return numbers

    def _run(
        self,
        signal: Any,
        exposure_s: float,
        noise: MosaicNoise | None,
        acts: Acts,
        start: str | None = None,
        before: str | None = None,
    ) -> Any:
        """Return the signal after the effects of the chain from `start` up to but without `before`, by name."""
        exposure = Exposure(device=self, exposure_s=exposure_s, noise=noise, acts=acts)
        names = [effect.name for effect in self.chain]
        first, last = (names.index(name) if name else None for name in (start, before))
        for effect in self.chain[first:last]:
            signal = _checked(effect, signal, effect.apply(signal, exposure))
        return signal

    @cached_property
    def charge_key(self) -> Hashable:
        """Return a key of all of the device on which `collected_e` depends."""
        sensor = self.sensor
        readout: Hashable = sensor.readout
        if all(is_packaged(type(effect)) for effect in self.chain):  # those of others may use all of it
            readout = sensor.readout.nodes, sensor.readout.full_well_e
        rest = (getattr(sensor, f.name) for f in fields(sensor) if f.name != "readout" and f.hash is not False)
        return *rest, readout, self.seed, self.shape, self.temperature_K, self.direction

    # --- raw DN to image ------------------------------------------------------------------------------------------

    def black_dn(self, exposure_s: float) -> float:
        """Return the black level in DN: the bias and the mean dark signal of the exposure.

        A real camera measures this level in its covered pixels. The dark signal of the charge transfer is not
        included, because it differs from row to row (`row_black_dn`). With `Sensor.black` "bias" it is the bias.
        """
        readout = self.sensor.readout
        if self.sensor.black == "bias":
            return float(readout.bias_dn)
        return readout.bias_dn + readout.system_gain_dn_per_e * float(self.dark_rate_e_s.mean()) * exposure_s

    @cached_property
    def row_black_dn(self) -> F32 | None:
        """Return how far the dark signal of the charge transfer raises each row's black level, float32[y, 1], DN.

        None if this is at most `_LEAST_BLACK_DN` in every row.
        """
        if self.transfer_dark_e is None or self.sensor.black == "bias":
            return None
        rows = self.maps.transfer_rows_e * self.sensor.readout.system_gain_dn_per_e
        return rows.astype(np.float32) if rows.max() > _LEAST_BLACK_DN else None

    @cached_property
    def saturated_dn(self) -> Raw:
        """Return the raw number from which each pixel counts as saturated, uint16[y, x] in DN.

        It is what a full well gives there through the pixel's own node, offsets and converter, less what temporal
        noise can take away (interference whole, the rest four standard deviations).
        """
        readout = self.sensor.readout
        full = np.full(self.shape, self._full_e, np.float32)
        temporal_e = math.hypot(readout.noise_e_rms, readout.row_noise_e_rms)
        margin_dn = (4 * temporal_e + 2 * readout.banding_seen_e) * readout.system_gain_dn_per_e
        level = read_out(full, readout, None, self.readout_individual) - np.float32(margin_dn)
        return np.ceil(np.maximum(level, 0)).astype(np.uint16)

    @cached_property
    def _full_e(self) -> float:
        """Return the electrons as which a full well reads, by the table of `nonlinearity` if the sensor has it."""
        full_e = self.sensor.readout.full_well_e
        for effect in self.chain:
            if isinstance(effect, Nonlinearity):
                full_e = float(effect.read(np.asarray(full_e, np.float32)))
        return full_e

    @cached_property
    def bad(self) -> NDArray[np.bool_]:
        """Return the hot, dead and stuck pixels, bool[y, x], as a camera's defect map would list them."""
        return (self._kinds & (HOT | DEAD | STUCK)) > 0

    def defects(self, exposure_s: float, noise: MosaicNoise) -> NDArray[np.uint8]:
        """Return the defects of each mosaic pixel in one exposure, uint8[y, x], as bits of `quantities.DEFECTS`."""
        out = self._kinds.copy()
        pixels = self.individual.rts
        high = upper_fraction(self.telegraph, exposure_s, *noise.telegraph) > 0.5
        out[pixels.row[high], pixels.column[high]] |= RTS_HIGH
        return out

    @cached_property
    def _kinds(self) -> NDArray[np.uint8]:
        """Return the permanent defects of each mosaic pixel, uint8[y, x], as bits."""
        out = np.zeros(self.shape, dtype=np.uint8)
        device = self.individual
        for value, defects in (
            (HOT, device.hot),
            (DEAD, device.dead),
            (STUCK, device.stuck),
            (RTS, device.rts),
            (TRAP, device.traps),
        ):
            out[defects.row, defects.column] |= value
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
        black, highest = self.black_dn(exposure_s), 0.0
        if self.row_black_dn is not None:
            mosaic, highest = mosaic - self.row_black_dn, float(self.row_black_dn.max())
        # white is the range above the highest black level. A saturated pixel then stays white, even if its full
        # well lies below the top code or dark signal alone fills it (1 % of the range is then left)
        white_e = min(sensor.readout.white_e, self._full_e)
        white = sensor.readout.bias_dn + sensor.readout.system_gain_dn_per_e * white_e
        black = min(black, white - highest - 0.01 * (white - sensor.readout.bias_dn))
        full = 255.0 / (white - black - highest)
        scale = {
            name: full * float(gain) for name, gain in zip(sensor.pattern.channels, self.white_balance, strict=True)
        }
        intensity = None
        if "W" in scale:
            unfiltered = interpolate(mosaic, sensor.pattern, "W")
            intensity = self._levels(cv2.subtract(unfiltered, black), scale["W"])
            if len(scale) == 1:
                return RGBI(array=cv2.merge([intensity] * 4))
        red, green, blue = (scale[colour] for colour in "RGB")
        noise_dn = sensor.readout.read_noise_e_rms * sensor.readout.system_gain_dn_per_e
        linear = demosaic(mosaic, sensor.pattern, sensor.method)
        if sensor.pattern.is_bayer and sensor.method != "bilinear":
            clipped = mosaic >= self.saturated_dn
            linear = bounded_at_edges(
                linear, mosaic, sensor.pattern, sensor.method, black=black, noise=noise_dn, clipped=clipped
            )
        above = cv2.subtract(linear, (black, black, black, 0.0))
        rgb = self._levels(above, (red, green, blue, 0.0))
        out = np.empty((*raw.shape, 4), dtype=np.uint8)
        shown = luminance(rgb) if intensity is None else intensity
        cv2.mixChannels([rgb, shown.reshape(*raw.shape, 1)], [out], [0, 0, 1, 1, 2, 2, 3, 3])
        return RGBI(array=out)

    def _levels(self, above: Any, scale: Any) -> NDArray[np.uint8]:
        """Return the 8 bit levels of DN above black times a factor, or one of each channel, stretched."""
        exponent = self.sensor.stretch
        if exponent == 1:
            # OpenCV multiplies with 64 bits, rounds to even and saturates at 0 and 255 as it converts
            return np.asarray(cv2.multiply(above, scale, dtype=cv2.CV_8U))
        fraction = np.clip(np.asarray(cv2.multiply(above, scale)) / np.float32(255), 0, 1)
        return np.rint(255 * fraction ** np.float32(exponent)).astype(np.uint8)

    @property
    def white_balance(self) -> NDArray[np.float32]:
        """Return the gain of each channel, float32[channel], as `efficiency.white_balance` does."""
        return white_balance(self.sensor.efficiency)


def _checked(effect: Effect, given: Any, result: Any) -> Any:
    """Return the result of an effect. Raise VbnfaultError if one from outside changed the shape or the dtype."""
    if not is_packaged(type(effect)) and (np.shape(result), getattr(result, "dtype", None)) != (
        given.shape,
        given.dtype,
    ):
        size = ", ".join(map(str, np.shape(result)))
        got = f"{result.dtype}[{size}]" if isinstance(result, np.ndarray) else type(result).__name__
        raise VbnfaultError(
            f"detector effect {effect.name}: apply returned {got}, but must return "
            f"{given.dtype}[{', '.join(map(str, given.shape))}]"
        )
    return result


@lru_cache(maxsize=4)
def individual(spec: IndividualSpec, shape: tuple[int, int], pixel_pitch_um: float, seed: int) -> Individual:
    """Return an individual from the cache, or make it."""
    return make_individual(spec, shape, pixel_pitch_um=pixel_pitch_um, seed=seed)


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
