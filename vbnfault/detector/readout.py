"""Convert collected electrons to raw digital numbers (DN).

    full well → row and column pattern, row noise, banding → read noise → gain and offset of the node
    → non-linearity → converter → stuck bits

All functions are pure: noise and patterns are arguments. Raw images are uint16[y, x].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import ndtr, stdtrit

from ..core.errors import InputError
from ..core.process.llvm import backend, empty, evaluated, on_device
from ..core.tables import table_class
from .noise import normal_field

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]

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
    bias_drift_dn_rms: float = Field(
        default=0.0, ge=0, description="standard deviation of the bias from exposure to exposure"
    )
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
    column_pattern_freedom: float | None = Field(
        default=None,
        gt=2,
        description="degrees of freedom of Student's t, which the pattern then follows: a few columns stand out; "
        "default: normal",
    )
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
        bits = dict(self.stuck_bits)
        high, low = (sum(1 << bit for bit, value in bits.items() if value == state) for state in (1, 0))
        out = (codes.astype(np.uint16) | np.uint16(high)) & np.uint16(0xFFFF ^ low)
        out.flags.writeable = False
        return out


# ------------------------------------------------------------------------------------------ output nodes
# One of 1, 2 or 4 output nodes reads each pixel once. Nodes sit in the sensor's corners, the first at the top left
# (assumed), and are read at the same time.


def node_of(shape: tuple[int, int], nodes: int) -> NDArray[np.uint8]:
    """Return the output node that reads each pixel, uint8[y, x].

    A single node has the number 0. Of two nodes, 0 reads the left half and 1 the right half. Of four nodes, 0 and
    1 read the upper quadrants and 2 and 3 the lower ones, from left to right. A middle row belongs to the upper
    half, a middle column to the left half.
    """
    down, right = halves(shape, nodes)
    return (2 * down[:, None] + right).astype(np.uint8)


def halves(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the half, 0 or 1, in which each row and each column lies; 0 where the sensor is not halved."""
    if nodes not in (1, 2, 4):
        raise InputError(f"nodes is {nodes}, but must be 1, 2 or 4")
    down, right = ((np.arange(n) >= (n + 1) // 2).astype(np.intp) for n in shape)
    return down * (nodes == 4), right * (nodes > 1)


def readout_steps(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return how many rows a node reads before each row, int[y], and pixels before each column, int[x]."""
    down, right = halves(shape, nodes)
    y, x = (np.arange(n) for n in shape)
    return np.where(down, shape[0] - 1 - y, y), np.where(right, shape[1] - 1 - x, x)


def last_before(lost: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return, for each of the increasing indices `lost`, the nearest lower index that is not lost, or -1."""
    run_begins = np.append(True, np.diff(lost) > 1)
    return (lost[run_begins] - 1)[np.cumsum(run_begins) - 1] if len(lost) else lost


def transmission_order(shape: tuple[int, int], nodes: int) -> NDArray[np.intp]:
    """Return the flat indices of the pixels, int[y·x], in the order in which they leave the sensor.

    Each step sends one pixel of every node, in the order of the nodes. With one node this is row by row.
    """
    if nodes == 1:
        return np.arange(shape[0] * shape[1])
    lines, pixels = readout_steps(shape, nodes)
    step = lines[:, None] * shape[1] + pixels
    return np.argsort((step * nodes + node_of(shape, nodes)).ravel(), kind="stable")


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
        """Draw patterns of the spec's spreads. It always draws one variate per row, column and code."""
        row, column = (rng.standard_normal(n, dtype=np.float32) for n in shape)
        if (freedom := spec.column_pattern_freedom) is not None:  # scaled to the same standard deviation
            tailed = stdtrit(freedom, ndtr(column.astype(np.float64)))
            column = (tailed * (1 - 2 / freedom) ** 0.5).astype(np.float32)
        widths = rng.standard_normal(spec.top_dn + 1, dtype=np.float32)
        return cls(
            row_e=row * np.float32(spec.row_pattern_e_rms),
            column_e=column * np.float32(spec.column_pattern_e_rms),
            transitions_dn=transitions_dn(widths * spec.dnl_lsb_rms) if spec.dnl_lsb_rms else None,
        )


def readout_time_s(shape: tuple[int, int], spec: ReadoutSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the time at which each line is reached, float64[y], and the delay of its pixels, float64[x], in s."""
    lines, pixels = readout_steps(shape, spec.nodes)
    line_time_s = spec.line_time_s
    if line_time_s is None:
        line_time_s = spec.pixel_time_s * (int(pixels.max()) + 1)
    return lines * np.float64(line_time_s), pixels * np.float64(spec.pixel_time_s)


# ------------------------------------------------------------------------------------------------- the chain


def read_out(
    electrons: F32,
    spec: ReadoutSpec,
    noise: ReadoutNoise | None = None,
    individual: ReadoutIndividual | None = None,
) -> Raw:
    """Return raw DN, uint16[y, x], of collected electrons float32[y, x].

    Without `noise` the result is noise-free. Without `individual` it has no fixed pattern and no differential
    non-linearity.
    """
    level = analogue_dn(clip_full_well(electrons, spec.full_well_e), spec, noise, individual)
    return convert(level, spec, None if individual is None else individual.transitions_dn)


def analogue_dn(
    electrons: F32,
    spec: ReadoutSpec,
    noise: ReadoutNoise | None = None,
    individual: ReadoutIndividual | None = None,
) -> F32:
    """Return the level at the converter, float32[y, x] in DN, neither rounded nor clipped to its range.

    `electrons` are those that the full well has left (`clip_full_well`); other arguments are as in `read_out`.
    """
    height, width = electrons.shape
    if individual is None:
        individual = ReadoutIndividual()
    rows = np.zeros(height, dtype=np.float32) if individual.row_e is None else individual.row_e
    if noise is not None:
        rows = rows + noise.row * np.float32(spec.row_noise_e_rms)
    out = on_device(electrons)
    if individual.pixel_e is not None:
        out = out + on_device(individual.pixel_e)
    # values of a line are copied to all its pixels: a kernel that gathers them takes longer
    for line in (individual.column_e, rows[:, None]):
        if line is not None and line.any():
            out = out + on_device(np.broadcast_to(line, electrons.shape))
    if spec.banding_seen_e:
        out = out + on_device(banding_e((height, width), spec))
    if noise is not None:
        out = out + on_device(noise.read) * _opaque(spec.noise_e_rms)
    gains = np.array(spec.node_gains or (1.0,) * spec.nodes) * spec.system_gain_dn_per_e
    offsets = np.array(spec.node_offsets_dn or (0.0,) * spec.nodes) + spec.bias_dn
    if spec.nodes == 1:
        out = out * _opaque(gains[0]) + _opaque(offsets[0])
    else:
        node = node_of((height, width), spec.nodes)
        out = out * on_device(gains[node]) + on_device(offsets[node])
    return evaluated(_bent(out, spec)).reshape(electrons.shape)


def convert(analogue: F32, spec: ReadoutSpec, transitions_dn: F32 | None = None) -> Raw:
    """Return the code, uint16[y, x], of a level float32[y, x] in DN; half codes round to even.

    With `transitions_dn` (see `ReadoutIndividual`) a code begins at its transition.
    """
    be = backend()
    dr, UInt32 = be.dr, be.UInt32
    level = dr.clip(on_device(analogue), 0, _opaque(spec.top_dn))
    if transitions_dn is None:
        code = UInt32(be.Int32(dr.round(level)))
    else:
        # levels with integer part k have at least low[k] transitions at or below them, and at most the greatest
        # difference of `low` further ones
        low = np.searchsorted(transitions_dn, np.arange(spec.top_dn + 2), side="right")
        code = dr.gather(UInt32, UInt32(low.astype(np.uint32)), UInt32(be.Int32(level)))
        above = on_device(np.append(transitions_dn, np.float32(np.inf)))
        for _ in range(int(np.diff(low).max(initial=0))):
            code = code + dr.select(dr.gather(be.Float, above, code) <= level, UInt32(1), UInt32(0))
    if spec.missing_codes or spec.stuck_bits:
        code = dr.gather(UInt32, UInt32(spec.codes.astype(np.uint32)), code)
    return evaluated(code).reshape(analogue.shape).astype(np.uint16)


def clip_full_well(electrons: F32, full_well_e: float) -> F32:
    """Return the electrons, clipped to the full well; float32 of any shape."""
    return np.minimum(electrons, np.float32(full_well_e))


@lru_cache(maxsize=1)
def banding_e(shape: tuple[int, int], spec: ReadoutSpec) -> F32:
    """Return the interference in electrons, float32[y, x], read-only: A sin(2π f t + φ) at each pixel's time t."""
    # sin(a + b) of the line's and the pixel's phase is a sum of two products [y] × [x]: no sine per pixel is needed
    line_s, pixel_s = readout_time_s(shape, spec)
    turn = 2 * math.pi * spec.banding_frequency_hz
    line, pixel = turn * line_s + spec.banding_phase_rad, turn * pixel_s
    wave = (spec.banding_seen_e * np.stack([np.sin(line), np.cos(line)])).astype(np.float32)
    across = np.stack([np.cos(pixel), np.sin(pixel)]).astype(np.float32)
    # BLAS is avoided: its sums may depend on the shape
    out: F32 = np.multiply(wave[0][:, None], across[0], out=empty(shape))
    out += wave[1][:, None] * across[1]
    out.flags.writeable = False
    return out


def _bent(dn: Any, spec: ReadoutSpec) -> Any:
    """Apply the integral non-linearity, which has no deviation at the bias and at the top code."""
    if not (spec.inl_quadratic_dn or spec.inl_cubic_dn):
        return dn
    u = (dn - _opaque(spec.bias_dn)) * _opaque(1 / (spec.top_dn - spec.bias_dn))
    # outside the range the polynomials diverge, so the curve continues as a straight line
    u = backend().dr.clip(u, 0, 1)
    arc = u * (1 - u)
    s = 4 * spec.inl_quadratic_dn + _CUBIC_SCALE * spec.inl_cubic_dn
    return dn + arc * (_opaque(s) - _opaque(2 * _CUBIC_SCALE * spec.inl_cubic_dn) * u)


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


def _opaque(value: float) -> Any:
    """Return a number as an argument of a kernel; as a literal it would give each sensor a kernel of its own."""
    be = backend()
    return be.dr.opaque(be.Float, float(value))
