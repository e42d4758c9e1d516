"""Convert collected electrons to raw digital numbers (DN), and simulate the faults of readout and downlink.

    full well → row and column pattern, row noise, banding → read noise → gain and offset of the node
    → non-linearity → converter → stuck bits

One of 1, 2 or 4 output nodes reads each pixel once. All functions are pure: noise, patterns and the positions of
faults are arguments. Raw images are uint16[y, x].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core.errors import InputError
from ..core.tables import table_class
from .blocks import blockwise
from .noise import normal_field

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]
Mask = NDArray[np.bool_]

Axis = Literal["row", "column"]
Fill = Literal["zero", "previous"]

# The cubic u(1-u)(1-2u) has extremes of ±√3/18 at u = (3 ∓ √3)/6. This factor scales them to ±1.
_CUBIC_SCALE = 6 * math.sqrt(3)


@table_class(required=("bits", "full_well_e"))
class ReadoutSpec:
    """Describe the signal chain of a sensor. Electrons are counted at the pixel, DN at the converter.

    By default the chain is ideal, apart from its read noise. The 100 ns of a pixel and the 1 µs of correlated
    double sampling (CDS) are assumed.
    """

    bits: int = Field(default=12, ge=1, le=16, description="bits of the converter")
    full_well_e: float = Field(
        default=13_500.0, gt=0, description="full well; it clips the electrons before all later effects"
    )
    bias_dn: int = Field(default=64, ge=0, le=65535, description="level without light, up to the top code")
    gain_dn_per_e: float | None = Field(
        default=None, gt=0, description="system gain K of EMVA 1288; default: the full well reaches the top code"
    )
    read_noise_e_rms: float = Field(default=13.0, ge=0, description="temporal noise at the output, CDS included")
    reset_noise_e_rms: float = Field(
        default=0.0, ge=0, description="kTC noise of the sense node; CDS removes all of it"
    )
    cds: bool = Field(default=True, description="whether the reset level is subtracted")
    cds_interval_s: float = Field(
        default=1e-6,
        ge=0,
        description="time between sampling the reset level and the signal; interference of frequency f passes with "
        "the factor |2 sin(π f interval)|",
    )
    nodes: Literal[1, 2, 4] = Field(
        default=1,
        description="output nodes: 2 are left and right, 4 the quadrants top left, top right, bottom left, "
        "bottom right",
    )
    node_gains: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(), description="relative gain of each node, default 1; below 1 a full well misses the top code"
    )
    node_offsets_dn: tuple[float, ...] = Field(
        default=(), description="offset that each node adds to the bias, default 0"
    )
    row_pattern_e_rms: float = Field(default=0.0, ge=0, description="fixed pattern of rows; devices differ")
    column_pattern_e_rms: float = Field(default=0.0, ge=0, description="fixed pattern of columns; devices differ")
    row_noise_e_rms: float = Field(default=0.0, ge=0, description="noise with one value per row and exposure")
    banding_amplitude_e: float = Field(
        default=0.0, ge=0, description="amplitude of sinusoidal interference during the readout"
    )
    banding_frequency_hz: float = Field(default=0.0, ge=0, description="its frequency")
    banding_phase_rad: float = Field(default=0.0, description="its phase at the first pixel")
    pixel_time_s: float = Field(
        default=1e-7, ge=0, description="time between two pixels of a line; 0 where a line is converted at once"
    )
    line_time_s: float | None = Field(
        default=None, ge=0, description="time between two lines; default: that of the pixels of a node's line"
    )
    inl_quadratic_dn: float = Field(
        default=0.0, description="integral non-linearity: height of an arc at half range"
    )
    inl_cubic_dn: float = Field(
        default=0.0,
        description="integral non-linearity: an S with extremes of this height at (3 ∓ √3)/6 of the range, with "
        "this sign in the lower half",
    )
    dnl_lsb_rms: float = Field(
        default=0.0, ge=0, description="differential non-linearity: spread of the code widths; devices differ"
    )
    missing_codes: tuple[Annotated[int, Field(ge=0, le=65535)], ...] = Field(
        default=(), description="codes that never occur; their range goes to the next code below, or else above"
    )
    stuck_bits: tuple[tuple[Annotated[int, Field(ge=0, le=15)], Literal[0, 1]], ...] = Field(
        default=(), description="pairs of a bit, 0 the least significant, and its value"
    )

    def __post_init__(self) -> None:
        """Raise ValueError where values contradict each other."""
        for name, codes in (("bias_dn", (self.bias_dn,)), ("missing_codes", self.missing_codes)):
            if codes and max(codes) > self.top_dn:
                raise ValueError(f"{name} = {max(codes)}: must be from 0 to {self.top_dn}, the top code")
        if self.gain_dn_per_e is None and self.bias_dn == self.top_dn:
            raise ValueError(
                f"bias_dn = {self.bias_dn}: must be below the top code where gain_dn_per_e is not given"
            )
        for name in ("node_gains", "node_offsets_dn"):
            values = getattr(self, name)
            if len(values) not in (0, self.nodes):
                raise ValueError(
                    f"{name} = {list(values)}: must hold a value for each of {self.nodes} nodes, or none"
                )
        # a falling curve would map two signals to one code
        steepest = 4 * abs(self.inl_quadratic_dn) + _CUBIC_SCALE * abs(self.inl_cubic_dn)
        if steepest and not steepest < self.top_dn - self.bias_dn:
            raise ValueError(
                f"inl_quadratic_dn = {self.inl_quadratic_dn:g}, inl_cubic_dn = {self.inl_cubic_dn:g}: "
                f"4·|quadratic| + 10.4·|cubic| must be below the {self.top_dn - self.bias_dn} DN of the range"
            )
        if len(set(self.missing_codes)) > self.top_dn:
            raise ValueError(f"missing_codes: must leave one of the {self.top_dn + 1} codes")
        for bit, _ in self.stuck_bits:
            if bit >= self.bits:
                raise ValueError(f"stuck_bits: bit = {bit}: must be from 0 to {self.bits - 1}")

    @property
    def top_dn(self) -> int:
        """Return the highest code."""
        return 2**self.bits - 1

    @property
    def system_gain_dn_per_e(self) -> float:
        """Return K of EMVA 1288, before the mismatch of the nodes."""
        if self.gain_dn_per_e is not None:
            return self.gain_dn_per_e
        return (self.top_dn - self.bias_dn) / self.full_well_e

    @property
    def white_e(self) -> float:
        """Return the largest signal that can be measured in e: the full well, unless the top code comes first."""
        return min(self.full_well_e, max(self.top_dn - self.bias_dn, 1) / self.system_gain_dn_per_e)

    @property
    def noise_e_rms(self) -> float:
        """Return a dark pixel's temporal noise: read noise, and kTC without CDS; no row noise or quantisation."""
        return math.hypot(self.read_noise_e_rms, 0.0 if self.cds else self.reset_noise_e_rms)

    @property
    def banding_seen_e(self) -> float:
        """Return the amplitude of the interference in the image, which is the part that CDS does not remove."""
        if not self.cds:
            return self.banding_amplitude_e
        return self.banding_amplitude_e * abs(
            2 * math.sin(math.pi * self.banding_frequency_hz * self.cds_interval_s)
        )

    @cached_property
    def codes(self) -> Raw:
        """Return the output for each code, uint16[2^bits], after missing codes and then stuck bits."""
        codes = np.arange(self.top_dn + 1)
        if self.missing_codes:
            there = np.setdiff1d(codes, self.missing_codes)
            codes = there[np.maximum(np.searchsorted(there, codes, side="right") - 1, 0)]
        out = _stuck(codes.astype(np.uint16), self.stuck_bits)
        out.flags.writeable = False
        return out


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high or math.isinf(value):
        allowed = f"at least {low}" if math.isinf(high) else f"in {low} to {high}"
        raise InputError(f"{name} is {value}, but must be {allowed}")


# ------------------------------------------------------------------------------- noise and fixed pattern


@dataclass(frozen=True, kw_only=True, eq=False)
class ReadoutNoise:
    """Hold the variates of one exposure, standard normal: `read` float32[y, x] and `row` float32[y]."""

    read: F32
    row: F32

    @classmethod
    def draw(cls, shape: tuple[int, int], read: np.random.Generator, row: np.random.Generator) -> ReadoutNoise:
        """Draw the variates for a (height, width) sensor. Their number does not depend on signal or spec."""
        return cls(read=normal_field(shape, read), row=row.standard_normal(shape[0], dtype=np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class ReadoutIndividual:
    """Hold the differences of one sensor's chain from others of its type; None means no difference.

    `row_e` float32[y], `column_e` float32[x] and `pixel_e` float32[y, x] are fixed patterns in electrons, which the
    full well does not limit. `transitions_dn` float32[2^bits - 1] increases: the converter gives code k from
    transition k - 1 to transition k.
    """

    row_e: F32 | None = None
    column_e: F32 | None = None
    pixel_e: F32 | None = None
    transitions_dn: F32 | None = None

    @classmethod
    def draw(cls, shape: tuple[int, int], spec: ReadoutSpec, rng: np.random.Generator) -> ReadoutIndividual:
        """Draw normal patterns of the spec's spreads. It always draws one variate per row, column and code."""
        row, column = (rng.standard_normal(n, dtype=np.float32) for n in shape)
        widths = rng.standard_normal(spec.top_dn + 1, dtype=np.float32)
        return cls(
            row_e=row * np.float32(spec.row_pattern_e_rms),
            column_e=column * np.float32(spec.column_pattern_e_rms),
            transitions_dn=transitions_dn(widths * spec.dnl_lsb_rms) if spec.dnl_lsb_rms else None,
        )


def transitions_dn(dnl_lsb: NDArray[np.floating]) -> F32:
    """Return the transition levels, float32[2^bits - 1], of a converter whose codes are 1 + dnl_lsb[2^bits] wide.

    A width below 0 counts as 0: that code is missing. The widths are scaled, as in an end-point fit, so that the
    first transition stays at half a code and the last at half a code below the top. The outermost codes have one
    transition only, so their widths do not matter.
    """
    widths = np.maximum(1.0 + np.asarray(dnl_lsb, dtype=np.float64)[1:-1], 0.0)
    if widths.size and widths.sum() > 0:
        widths *= widths.size / widths.sum()
    return np.concatenate([[0.5], 0.5 + np.cumsum(widths)]).astype(np.float32)


# ---------------------------------------------------------------------------- position and time of readout


def node_of(shape: tuple[int, int], nodes: int) -> NDArray[np.uint8]:
    """Return the output node that reads each pixel, uint8[y, x].

    One node is 0. Two nodes are 0 left and 1 right. Four nodes number the quadrants in reading order. The middle
    row or column of an odd number belongs to the top or left.
    """
    down, right = _halves(shape, nodes)
    return (2 * down[:, None] + right).astype(np.uint8)


def _halves(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return, for each row and each column, the half (0 or 1) in which it lies, if the sensor is read in halves."""
    if nodes not in (1, 2, 4):
        raise InputError(f"nodes is {nodes}, but must be 1, 2 or 4")
    down, right = ((np.arange(n) >= (n + 1) // 2).astype(np.intp) for n in shape)
    return down * (nodes == 4), right * (nodes > 1)


def readout_steps(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return how many lines, int[y], and pixels, int[x], the node of each reads before it.

    Nodes sit in the sensor's corners, the first at the top left (assumed), and are read at the same time.
    """
    down, right = _halves(shape, nodes)
    y, x = (np.arange(n) for n in shape)
    return np.where(down, shape[0] - 1 - y, y), np.where(right, shape[1] - 1 - x, x)


def readout_time_s(shape: tuple[int, int], spec: ReadoutSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the time at which each line is reached, float64[y], and the delay of its pixels, float64[x], in s."""
    lines, pixels = readout_steps(shape, spec.nodes)
    line_time_s = spec.line_time_s
    if line_time_s is None:
        line_time_s = spec.pixel_time_s * (int(pixels.max()) + 1)
    return lines * np.float64(line_time_s), pixels * np.float64(spec.pixel_time_s)


def transmission_order(shape: tuple[int, int], nodes: int) -> NDArray[np.intp]:
    """Return the flat indices of the pixels, int[y·x], in the order in which they leave the sensor.

    Each step sends one pixel of every node, in the order of the nodes. With one node this is row by row.
    """
    if nodes == 1:
        return np.arange(shape[0] * shape[1])
    lines, pixels = readout_steps(shape, nodes)
    step = lines[:, None] * shape[1] + pixels
    return np.argsort((step * nodes + node_of(shape, nodes)).ravel(), kind="stable")


# ------------------------------------------------------------------------------------------------- the chain


def read_out(
    electrons: F32,
    spec: ReadoutSpec,
    noise: ReadoutNoise | None = None,
    individual: ReadoutIndividual | None = None,
) -> Raw:
    """Return raw DN, uint16[y, x], of collected electrons float32[y, x]; the chain runs in blocks of rows.

    Without `noise` the result is noise-free. Without `individual` it has no fixed pattern and no differential
    non-linearity.
    """
    transitions = None if individual is None else individual.transitions_dn
    chain = _Chain(electrons.shape, spec, noise, individual)
    code_of = _Converter(spec, transitions)
    return blockwise(
        lambda *block: code_of(chain.amplify(*block)),
        _picture(electrons),
        *chain.of_rows,
    )


def analogue_dn(
    electrons: F32,
    spec: ReadoutSpec,
    noise: ReadoutNoise | None = None,
    individual: ReadoutIndividual | None = None,
) -> F32:
    """Return the level at the converter, float32[y, x] in DN, neither rounded nor clipped to its range."""
    chain = _Chain(electrons.shape, spec, noise, individual)
    return blockwise(chain.amplify, _picture(electrons), *chain.of_rows)


def convert(analogue: F32, spec: ReadoutSpec, transitions_dn: F32 | None = None) -> Raw:
    """Return the code, uint16[y, x], of a level float32[y, x] in DN; half codes round to even.

    With `transitions_dn` (see `ReadoutIndividual`) a code begins at its transition.
    """
    return blockwise(_Converter(spec, transitions_dn), _picture(analogue))


def clip_full_well(electrons: F32, full_well_e: float) -> F32:
    """Return the electrons, clipped to the full well; float32 of any shape."""
    return np.minimum(electrons, np.float32(full_well_e))


def banding_e(shape: tuple[int, int], spec: ReadoutSpec) -> F32:
    """Return the interference in electrons, float32[y, x]: A sin(2π f t + φ) at the time t of each pixel."""
    return _product(*_waves(shape, spec))


def _picture(array: F32) -> F32:
    if array.ndim != 2:
        raise InputError(f"the picture has shape {array.shape}, but must be [y, x]")
    return np.asarray(array, dtype=np.float32)


def _waves(shape: tuple[int, int], spec: ReadoutSpec) -> tuple[F32, F32]:
    """Return the interference as two factors, float32[y, 2] and float32[2, x]."""
    # sin(a + b) of the line's and the pixel's phase is a sum of two products [y] × [x]: no sine per pixel is needed
    line_s, pixel_s = readout_time_s(shape, spec)
    turn = 2 * math.pi * spec.banding_frequency_hz
    line, pixel = turn * line_s + spec.banding_phase_rad, turn * pixel_s
    wave = spec.banding_seen_e * np.stack([np.sin(line), np.cos(line)], axis=1)
    return wave.astype(np.float32), np.stack([np.cos(pixel), np.sin(pixel)]).astype(np.float32)


def _product(wave: F32, across: F32) -> F32:
    # BLAS is avoided: its sums may depend on the size of the block
    out = wave[:, :1] * across[0]
    out += wave[:, 1:] * across[1]
    return out


class _Chain:
    """Prepare the analogue chain of one exposure for blocks of rows."""

    def __init__(
        self,
        shape: tuple[int, ...],
        spec: ReadoutSpec,
        noise: ReadoutNoise | None,
        individual: ReadoutIndividual | None,
    ) -> None:
        if len(shape) != 2:
            raise InputError(f"the picture has shape {shape}, but must be [y, x]")
        height, width = shape
        self.spec = spec
        self.full_well_e = spec.full_well_e
        rows = np.zeros(height, dtype=np.float32)
        self.column_e: F32 | None = None
        if individual is not None:
            _fits("row_e", individual.row_e, (height,))
            _fits("column_e", individual.column_e, (width,))
            if individual.row_e is not None:
                rows = rows + individual.row_e
            self.column_e = individual.column_e
            _fits("pixel_e", individual.pixel_e, (height, width))
        if noise is not None:
            _fits("read", noise.read, (height, width))
            _fits("row", noise.row, (height,))
            rows = rows + noise.row * np.float32(spec.row_noise_e_rms)
        wave: F32 | None = None
        if spec.banding_seen_e:
            wave, self.across = _waves((height, width), spec)
        down, right = _halves((height, width), spec.nodes)
        gains = np.array(spec.node_gains or (1.0,) * spec.nodes) * spec.system_gain_dn_per_e
        offsets = np.array(spec.node_offsets_dn or (0.0,) * spec.nodes) + spec.bias_dn
        # gains and offsets of the upper and the lower half, float32[2, x]
        table = np.array([[0, 1], [2, 3]]) if spec.nodes == 4 else np.array([[0, 1]] * 2)
        by_column = np.minimum(table[:, right], spec.nodes - 1)
        self.gains, self.offsets = (v[by_column].astype(np.float32) for v in (gains, offsets))
        pixel_e = None if individual is None else individual.pixel_e
        self.of_rows = (rows if rows.any() else None, down, wave, None if noise is None else noise.read, pixel_e)

    def amplify(
        self,
        electrons: F32,
        row_e: F32 | None,
        half: NDArray[np.intp],
        wave: F32 | None,
        read: F32 | None,
        pixel_e: F32 | None,
    ) -> F32:
        """Return the level at the converter, in DN, of a block of rows."""
        out = clip_full_well(electrons, self.full_well_e)
        if pixel_e is not None:
            out += pixel_e
        if self.column_e is not None:
            out += self.column_e
        if row_e is not None:
            out += row_e[:, None]
        if wave is not None:
            out += _product(wave, self.across)
        if read is not None:
            out += read * np.float32(self.spec.noise_e_rms)
        # a block may lie in both halves
        for lower in (0, 1):
            rows = half == lower
            if rows.all():
                out *= self.gains[lower]
                out += self.offsets[lower]
            elif rows.any():
                out[rows] = out[rows] * self.gains[lower] + self.offsets[lower]
        return self._bend(out)

    def _bend(self, dn: F32) -> F32:
        """Apply the integral non-linearity, which has no deviation at the bias and at the top code."""
        spec = self.spec
        if not (spec.inl_quadratic_dn or spec.inl_cubic_dn):
            return dn
        u = (dn - np.float32(spec.bias_dn)) * np.float32(1 / (spec.top_dn - spec.bias_dn))
        # outside the range the polynomials diverge, so the curve continues as a straight line
        np.clip(u, 0, 1, out=u)
        arc = u * (1 - u)
        s = 4 * spec.inl_quadratic_dn + _CUBIC_SCALE * spec.inl_cubic_dn
        dn += arc * (np.float32(s) - np.float32(2 * _CUBIC_SCALE * spec.inl_cubic_dn) * u)
        return dn


def _fits(name: str, array: F32 | None, shape: tuple[int, ...]) -> None:
    if array is not None and array.shape != shape:
        raise InputError(f"{name} has shape {array.shape}, but must have {shape}")


class _Converter:
    """Convert levels to codes with tables that are made once."""

    def __init__(self, spec: ReadoutSpec, transitions: F32 | None) -> None:
        self.top = spec.top_dn
        self.table = spec.codes if spec.missing_codes or spec.stuck_bits else None
        self.transitions = transitions
        if transitions is not None:
            _fits("transitions_dn", transitions, (self.top,))
            # levels with integer part k have at least low[k] transitions at or below them, and at most `more`
            # further ones
            low = np.searchsorted(transitions, np.arange(self.top + 2), side="right")
            self.low = low.astype(np.int32)
            self.more = int(np.diff(low).max(initial=0))
            self.padded = np.append(transitions, np.float32(np.inf))

    def __call__(self, level: F32) -> Raw:
        level = np.clip(level, 0, self.top)
        if self.transitions is None:
            code = np.rint(level).astype(np.uint16)
        else:
            count = self.low.take(level.astype(np.int32))
            for _ in range(self.more):
                count += self.padded.take(count) <= level
            code = count.astype(np.uint16)
        return code if self.table is None else self.table.take(code)


def _check_bits(stuck_bits: Sequence[tuple[int, int]], bits: int) -> None:
    for bit, value in stuck_bits:
        if not 0 <= bit < bits or value not in (0, 1):
            raise InputError(
                f"stuck_bits holds ({bit}, {value}), but must be (bit, value), bit in 0 to {bits - 1}, value 0 or 1"
            )


def _stuck(raw: Raw, stuck_bits: Sequence[tuple[int, int]]) -> Raw:
    high = sum(1 << bit for bit, value in dict(stuck_bits).items() if value)
    low = sum(1 << bit for bit, value in dict(stuck_bits).items() if not value)
    return (raw | np.uint16(high)) & np.uint16(0xFFFF ^ low)


# ------------------------------------------------------------------------------------- faults of the readout


@dataclass(frozen=True, kw_only=True, eq=False)
class Damaged:
    """Hold a raw image uint16[y, x] after a fault.

    `region` bool[y, x] is where the fault acted; `changed` bool[y, x] are its pixels whose value changed.
    """

    raw: Raw
    region: Mask
    changed: Mask


def _damaged(before: Raw, after: Raw, region: Mask) -> Damaged:
    return Damaged(raw=after, region=region, changed=after != before)


def _checked(raw: Raw) -> Raw:
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise InputError(f"the raw picture is {raw.dtype} of shape {raw.shape}, but must be uint16[y, x]")
    return raw


def _indices(name: str, values: Sequence[int] | NDArray[np.integer], count: int) -> NDArray[np.intp]:
    found = np.unique(np.asarray(values, dtype=np.intp))
    for value in found[(found < 0) | (found >= count)]:
        raise InputError(f"{name} holds {value}, but must be in 0 to {count - 1}")
    return found


def _along(array: NDArray, axis: Axis) -> NDArray:
    """Return the array with the lines of `axis` as its first index."""
    if axis not in ("row", "column"):
        raise InputError(f"axis is '{axis}', but must be row or column")
    return array if axis == "row" else array.T


def _last_before(lost: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return, for each of the increasing indices `lost`, the nearest lower index that is not lost, or -1."""
    run_begins = np.append(True, np.diff(lost) > 1)
    return (lost[run_begins] - 1)[np.cumsum(run_begins) - 1] if len(lost) else lost


def _with_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis, name: str
) -> tuple[Raw, Mask, NDArray[np.intp]]:
    """Return a copy of the image, the region of the lines, and their checked numbers."""
    at = _indices(name, lines, len(_along(_checked(raw), axis)))
    region = np.zeros(raw.shape, dtype=np.bool_)
    _along(region, axis)[at] = True
    return raw.copy(), region, at


def dead_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "column", level_dn: int = 0
) -> Damaged:
    """Set rows or columns to one level, such as 0 or the bias."""
    _within("level_dn", level_dn, 0, 65535)
    out, region, at = _with_lines(raw, lines, axis, "lines")
    _along(out, axis)[at] = level_dn
    return _damaged(raw, out, region)


def saturated_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "column", bits: int = 12
) -> Damaged:
    """Set rows or columns to the top code."""
    _within("bits", bits, 1, 16)
    return dead_lines(raw, lines, axis, 2**bits - 1)


def duplicated_lines(raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "row") -> Damaged:
    """Make rows or columns repeat the line before, as if an address failed to advance.

    A run of them repeats the last line before the run. Lines at the border without a line before them stay.
    """
    out, region, at = _with_lines(raw, lines, axis, "lines")
    source = _last_before(at)
    at, source = at[source >= 0], source[source >= 0]
    _along(out, axis)[at] = _along(raw, axis)[source]
    return _damaged(raw, out, region)


def shifted_lines(
    raw: Raw,
    lines: Sequence[int] | NDArray[np.integer],
    axis: Axis = "row",
    shift_px: int = 1,
    fill_dn: int | None = 0,
) -> Damaged:
    """Shift rows or columns along themselves, as after a lost or added clock.

    A positive `shift_px` is towards larger indices. Vacated pixels take `fill_dn`; with None the line wraps round.
    """
    if fill_dn is not None:
        _within("fill_dn", fill_dn, 0, 65535)
    out, region, at = _with_lines(raw, lines, axis, "lines")
    length = raw.shape[1] if axis == "row" else raw.shape[0]
    moved = np.roll(_along(raw, axis)[at], shift_px, axis=1)
    if fill_dn is not None:
        from_pixel = np.arange(length) - shift_px
        moved[:, (from_pixel < 0) | (from_pixel >= length)] = fill_dn
    _along(out, axis)[at] = moved
    return _damaged(raw, out, region)


def lost_node(raw: Raw, nodes: int, node: int, level_dn: int = 0) -> Damaged:
    """Set all pixels of one output node (see `node_of`) to one level."""
    _within("level_dn", level_dn, 0, 65535)
    _indices("node", [node], nodes)
    region = node_of(_checked(raw).shape, nodes) == node  # type: ignore[arg-type]
    return _damaged(raw, np.where(region, np.uint16(level_dn), raw), region)


def stick_bits(
    raw: Raw, stuck_bits: Sequence[tuple[int, int]], bits: int = 12, where: Mask | None = None
) -> Damaged:
    """Hold the bits of (bit, value) pairs at 0 or 1, in the whole image or in the pixels `where` bool[y, x]."""
    _within("bits", bits, 1, 16)
    _check_bits(stuck_bits, bits)
    region = np.ones(_checked(raw).shape, dtype=np.bool_) if where is None else np.array(where, dtype=np.bool_)
    return _damaged(raw, np.where(region, _stuck(raw, stuck_bits), raw), region)


# -------------------------------------------------------------------------------------- faults of the downlink


def packet_count(shape: tuple[int, int], packet_px: int) -> int:
    """Return how many packets of `packet_px` pixels carry an image; the last one may be short."""
    if packet_px < 1:
        raise InputError(f"packet_px is {packet_px}, but must be at least 1")
    return -(-shape[0] * shape[1] // packet_px)


def _stream(
    raw: Raw, packets: Sequence[int] | NDArray[np.integer], packet_px: int, order: NDArray[np.intp] | None
) -> tuple[Raw, NDArray[np.intp], NDArray[np.intp]]:
    """Return the pixels in the order sent, the checked packets, and the positions of their pixels in that order.

    The positions, int[packet, packet_px], include those beyond the end of a short last packet.
    """
    at = _indices("packets", packets, packet_count(_checked(raw).shape, packet_px))  # type: ignore[arg-type]
    if order is not None and order.shape != (raw.size,):
        raise InputError(f"order has shape {order.shape}, but must have ({raw.size},)")
    stream = raw.ravel() if order is None else raw.ravel()[order]
    return stream.copy(), at, at[:, None] * packet_px + np.arange(packet_px)


def _received(raw: Raw, stream: Raw, hit: NDArray[np.intp], order: NDArray[np.intp] | None) -> Damaged:
    """Return the image that the receiver makes from a stream that was damaged at the positions `hit`."""
    region, out = np.zeros(raw.size, dtype=np.bool_), stream
    if order is None:
        region[hit] = True
    else:
        region[order[hit]] = True
        out = np.empty_like(stream)
        out[order] = stream
    return _damaged(raw, out.reshape(raw.shape), region.reshape(raw.shape))


def lost_packets(
    raw: Raw,
    packets: Sequence[int] | NDArray[np.integer],
    packet_px: int,
    fill: Fill = "zero",
    order: NDArray[np.intp] | None = None,
) -> Damaged:
    """Fill packets that never arrive with 0 or with the last packet that did arrive (0 if none did).

    A packet is a run of `packet_px` pixels in the order sent: row by row, or by the flat indices `order`
    (`transmission_order`).
    """
    stream, at, places = _stream(raw, packets, packet_px, order)
    there = places < raw.size
    value = np.zeros(places.shape, dtype=np.uint16)
    if _checked_fill(fill) == "previous":
        source = _last_before(at)
        held = source >= 0
        value[held] = stream[source[held, None] * packet_px + np.arange(packet_px)]
    stream[places[there]] = value[there]
    return _received(raw, stream, places[there], order)


def corrupted_packets(
    raw: Raw,
    packets: Sequence[int] | NDArray[np.integer],
    packet_px: int,
    bit_error_rate: float,
    rng: np.random.Generator,
    bits: int = 12,
    order: NDArray[np.intp] | None = None,
) -> Damaged:
    """Flip each of the `bits` of a pixel in some packets, independently, with probability `bit_error_rate`.

    The number of uniform variates (one per bit) does not depend on the signal or the rate.
    """
    _within("bit_error_rate", bit_error_rate, 0, 1)
    _within("bits", bits, 1, 16)
    stream, _, places = _stream(raw, packets, packet_px, order)
    flips = np.zeros(places.shape, dtype=np.uint16)
    for bit in range(bits):
        flips |= (rng.random(places.shape) < bit_error_rate).astype(np.uint16) << np.uint16(bit)
    there = places < raw.size
    stream[places[there]] ^= flips[there]
    return _received(raw, stream, places[there], order)


def lost_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "row", fill: Fill = "zero"
) -> Damaged:
    """Fill rows or columns that never arrive with 0 or with the last line that did arrive (0 if none did)."""
    out, region, at = _with_lines(raw, lines, axis, "lines")
    _along(out, axis)[at] = 0
    if _checked_fill(fill) == "previous":
        source = _last_before(at)
        _along(out, axis)[at[source >= 0]] = _along(raw, axis)[source[source >= 0]]
    return _damaged(raw, out, region)


def _checked_fill(fill: Fill) -> Fill:
    if fill not in ("zero", "previous"):
        raise InputError(f"fill is '{fill}', but must be zero or previous")
    return fill
