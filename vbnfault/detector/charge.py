"""Simulate how charge moves through a sensor before it is measured.

Every function takes one plane of electrons (a mosaic), float32[y, x], with row 0 at the top, and returns a new
one. The physical order is: light falls on charge during the frame transfer (`smear`) or while it waits
(`parasitic_light`); wells overflow (`bloom`); packets lose charge to traps (`capture`, then `cti`, first parallel,
then serial).

A direction ("up", "down", "left", "right") says where the charge moves. "up" has its register above row 0, so row
0 is read first. Effects along one line never depend on other lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core.process.llvm import backend, evaluated, flat
from ..core.tables import table_class

if TYPE_CHECKING:
    from .sensor import Sensor

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

ROWS_PER_BLOCK = 64  # measured as the fastest for steps on one plane


# ------------------------------------------------------------------------------------------------------ smear


def smear(
    rate_e_s: F32,
    *,
    exposure_s: float,
    row_transfer_s: float,
    row_clear_s: float = 0.0,
    shutter_transmission: float = 1.0,
    direction: str = "up",
) -> F32:
    """Return the electrons of a frame-transfer exposure, float32[y, x].

    For charge that moves up,

        S_i = t_exp I_i + τ_row Σ_{k<i} I_k + τ_clear Σ_{k>i} I_k .

    On the transfer to the store, the packet of row i passes every row nearer to it. Before the exposure, it came
    through the rows behind. The light is assumed constant during exposure and transfer.

    Parameters
    ----------
    rate_e_s
        Electrons per second, float32[y, x].
    exposure_s, row_transfer_s, row_clear_s
        t_exp, τ_row and τ_clear in s, at least 0. `row_clear_s` is 0 for a fast clear, or for an electronic shutter
        that dumps the image before the exposure.
    shutter_transmission
        Fraction of the light that passes the shutter during the transfer: 1 without a shutter, 0 when closed.
    direction
        Direction of the charge.
    """
    late, early = row_transfer_s * shutter_transmission, row_clear_s * shutter_transmission
    rate = _facing(rate_e_s, direction)
    if not (late or early):
        return rate_e_s * np.float32(exposure_s)
    passed = np.empty_like(rate)  # the rows before row i; numpy's cumsum is ten times slower along this axis
    passed[:1] = 0
    for above, here, total in zip(passed[:-1], rate[:-1], passed[1:], strict=True):
        np.add(above, here, out=total)
    every = (passed[-1] + rate[-1]) * np.float32(early)

    for start in range(0, len(rate), ROWS_PER_BLOCK):
        rows = slice(start, start + ROWS_PER_BLOCK)
        cv2.addWeighted(rate[rows], exposure_s - early, passed[rows], late - early, 0.0, dst=passed[rows])
        if early:
            passed[rows] += every
    return _facing(passed, direction, back=True)


def smear_interline(
    rate_e_s: F32,
    *,
    exposure_s: float,
    row_transfer_s: float,
    leak: float,
    direction: str = "up",
) -> F32:
    """Return the electrons of an interline exposure, float32[y, x]: S_i = t_exp I_i + leak τ_row Σ_k I_k.

    The covered register runs all the time. A packet therefore starts at the far end of the register and collects
    light along the whole column. This draws a line above and below a bright spot.

    `leak` in [0, 1] is the fraction of a pixel's light that reaches the covered register beside it. Other arguments
    are as in `smear`.
    """

    rate = _facing(rate_e_s, direction)
    gathered = rate.sum(axis=0, dtype=np.float64) * (leak * row_transfer_s)
    out = rate * np.float32(exposure_s)
    out += gathered.astype(np.float32)
    return _facing(out, direction, back=True)


# ------------------------------------------------------------------------------ paths of charge, dark current


def transfer_dark_e(sensor: Sensor, dark_rate_e_s: F32, direction: str) -> F32 | None:
    """Return the electrons from dark current that charge packets collect during transfer, float32[y, x].

    A full-frame CCD moves each packet through all pixels between its own pixel and the register. It stays in each
    for the readout time of a row, so a hot pixel leaves a line. Packets wait equally long in the store of a
    frame-transfer CCD and in the registers of an interline CCD, whose pixels are of the same silicon: they have the
    rates of the image's pixels, turned by 180°. So a pattern of columns grows from the row that is read first, as
    in frames of Rosetta's navigation camera. In a frame-transfer CCD a packet also passes the image pixels on its
    quick transfer to the store.

    Returns None for a CMOS sensor, and for a CCD without transfer times.
    """
    move = sensor.transfer
    if sensor.architecture == "cmos" or not (move.row_readout_s or move.row_transfer_s):
        return None
    if sensor.architecture == "full_frame_ccd":
        return passing_dark_e(sensor, dark_rate_e_s, direction)
    store = np.ascontiguousarray(dark_rate_e_s[::-1, ::-1])
    waiting = partial(smear, exposure_s=0.0, row_transfer_s=move.row_readout_s)
    return along_columns(sensor, direction, waiting, store) + passing_dark_e(sensor, dark_rate_e_s, direction)


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


def along_registers(sensor: Sensor, step: Callable[..., F32], image: F32) -> F32:
    """Apply `step(part, direction=…)` along the rows of an image.

    All rows move to the left or, with two or four nodes, each half to its own side.
    """
    if sensor.readout.nodes == 1:
        return step(image, direction="left")
    middle = (image.shape[1] + 1) // 2
    return np.concatenate(
        [step(image[:, :middle], direction="left"), step(image[:, middle:], direction="right")], axis=1
    )


# ------------------------------------------------------------------------------------------------- blooming


def bloom(signal_e: F32, *, full_well_e: float, antiblooming: float = 0.0, direction: str = "up") -> F32:
    """Return the electrons after wells above the full well have overflowed along their columns.

    Half of the excess moves in each direction until other wells have taken it. Excess that reaches an end of the
    column is lost. Everything else is conserved to float32 rounding, and no pixel exceeds the full well afterwards.
    Where currents from both sides meet, the result is the mean of two cases: each current enters first in one of
    them. So the result prefers no side. Columns without excess are returned bit for bit.

    Parameters
    ----------
    signal_e
        Electrons, float32[y, x], at least 0.
    full_well_e
        Full well in e, above 0.
    antiblooming
        Fraction of the excess that a drain removes in the pixel itself, 0 to 1.
    direction
        Direction of the charge, which selects columns or rows.
    """
    if signal_e.size == 0 or signal_e.max() <= full_well_e:
        return signal_e.copy()
    image = _facing(signal_e.copy() if direction == "up" else signal_e, direction)
    columns = np.flatnonzero(image.max(axis=0) > full_well_e)
    count = len(columns)
    # compute both orders side by side: in the left part the current towards the last row enters first, in the
    # right part it enters last
    excess = np.empty((len(image), 2 * count))
    np.subtract(np.take(image, columns, axis=1), full_well_e, out=excess[:, :count], dtype=np.float64)
    excess[:, count:] = excess[::-1, :count]
    np.multiply(excess, (1.0 - antiblooming) / 2, out=excess, where=excess > 0)
    _run_over(excess, first=True)
    _run_over(excess[::-1], first=False)
    left = excess[:, :count]
    left += excess[::-1, count:]
    left *= 0.5
    left += full_well_e
    image[:, columns] = left
    return _facing(image, direction, back=True)


def _run_over(excess: F64, *, first: bool) -> None:
    """Let a current of excess charge run from row 0 to the last row, in place.

    Positive values join the current, negative values (free room) take charge from it. The current behind a row is
    max(0, before + excess): Lindley's recursion for a queue. After the `first` of two currents, positive values
    stay for the second one; otherwise only the remaining room is left, as numbers up to 0. The loop works row by
    row, so that it makes no large array and a row stays in the cache.
    """
    current = np.zeros(excess.shape[1])
    room = np.empty_like(current)
    zero = np.zeros_like(current)  # twice as fast as a Python number
    for row in excess:
        current += row
        if first:
            np.minimum(current, zero, out=room)
            np.maximum(row, zero, out=row)
            row += room
        else:
            np.minimum(current, zero, out=row)
        np.maximum(current, zero, out=current)


# ------------------------------------------------------------------------------------------------------ CTI


@table_class()
class TrapSpecies:
    """Describe traps of one kind."""

    density_per_px: float = Field(ge=0, description="number of traps per pixel")
    release_time_s: float = Field(gt=0, description="mean time until a trap releases its electron")


@table_class()
class ChargeCloud:
    """Describe how a packet fills the volume of its well.

    The filled fraction is ((n − notch) / (full well − notch))^fill_power, in [0, 1] (Massey et al. 2010, MNRAS 401,
    371).
    """

    full_well_e: float = Field(gt=0, description="full well, above notch_e")
    notch_e: float = Field(
        default=0.0, ge=0, description="charge in a supplementary buried channel, which meets no trap"
    )
    fill_power: float = Field(
        default=0.5, gt=0, le=1, description="exponent; 1 makes the loss proportional to the charge"
    )

    def __post_init__(self) -> None:
        """Raise ValueError unless the full well is above the notch."""
        if not self.full_well_e > self.notch_e:
            raise ValueError(f"full_well_e = {self.full_well_e:g}: must be above notch_e = {self.notch_e:g}")

    def volume(self, signal_e: F32) -> F32:
        """Return the filled fraction of the well, float32 in [0, 1], in the shape of `signal_e`."""
        fill = np.ascontiguousarray(signal_e) - np.float32(self.notch_e)
        fill *= np.float32(1 / (self.full_well_e - self.notch_e))
        # OpenCV clips and takes powers several times faster than numpy
        cv2.max(fill, 0.0, dst=fill)
        cv2.min(fill, 1.0, dst=fill)
        if self.fill_power == 0.5:
            return np.sqrt(fill, out=fill)
        return fill if self.fill_power == 1 else cv2.pow(fill, self.fill_power, dst=fill)


def cti(
    signal_e: F32,
    species: Sequence[TrapSpecies],
    *,
    cloud: ChargeCloud,
    transfer_s: float,
    direction: str = "up",
) -> F32:
    """Return the image after readout through a register with traps, float32[y, x] in e.

    The register is parallel ("up", "down") or serial ("left", "right"). Call the function twice for both.

    The model is volume-driven (ArCTIC: Massey et al. 2010, MNRAS 401, 371; 2014, MNRAS 439, 887). A packet fills
    every trap within its cloud at once. A trap releases its electron with probability 1 − exp(−t/τ) per transfer of
    `transfer_s`, into the packet that is there at that time. Row i passes the traps of pixels 0 … i, including its
    own pixel. All traps are empty when readout
    starts.

    The computation is an express approximation: a packet's cloud keeps its size during the pass, instead of
    shrinking from pixel to pixel. The total charge is conserved, except for charge that is still trapped when the
    last row has left.

    Parameters
    ----------
    signal_e
        Electrons, float32[y, x].
    species, cloud
        Kinds of traps, and the charge cloud of a packet.
    transfer_s, direction
        Time per transfer in s, above 0, and direction of the charge.
    """
    species = [s for s in species if s.density_per_px > 0]
    image = _facing(signal_e.copy() if direction == "up" else signal_e, direction)
    if not species or not image.size:
        return signal_e.copy()
    met = sum(s.density_per_px for s in species) * (np.arange(len(image)) + 1.0)  # traps that a packet passes
    # a cloud meets no more traps than its packet has electrons
    volume = np.minimum(cloud.volume(image), image * (1 / met).astype(np.float32)[:, None])
    traps = [(s.density_per_px, float(np.exp(-transfer_s / s.release_time_s))) for s in species]
    return _facing(_clocked(image, volume, traps), direction, back=True)


def _clocked(image: F32, volume: F32, traps: Sequence[tuple[float, float]]) -> F32:
    """Return the packets, float32[y, x], after one pass of `cti` towards row 0; `volume` are their clouds.

    `traps` holds the density ρ of each species and the fraction w of its full traps that stay full for a transfer.
    With V(m, i) the largest cloud among the packets m … i, the traps hold Σ_m V(m, i) ρ wⁱ⁻ᵐ [1 + (1 - w) m]
    electrons after packet i, which leaves with its charge less the change of that sum over all species.

    Going from a packet to the next one multiplies the sums of V wⁱ⁻ᵐ and m V wⁱ⁻ᵐ by w. Then the new cloud raises V
    wherever it is the largest so far. V rises with the distance behind packet i in steps, so a stack of steps is
    kept for each column: a new cloud removes those below its own size and adds one. Each lane goes its own way
    through a column: a round of the loop either removes a step or lets a packet leave. Sums are in double
    precision, so that columns that differ in one packet agree again once its trail has ended.
    """
    be = backend()
    dr, Float, Double, UInt32 = be.dr, be.Float, be.Float64, be.UInt32
    height, width = image.shape
    lags = np.arange(height + 2)
    # sums of wᵏ and k wᵏ over the lags before each
    sums = [[Double(np.cumsum(k * w**lags) - k * w**lags) for k in (np.ones_like(lags), lags)] for _, w in traps]
    kept = [dr.opaque(Double, w) for _, w in traps]
    densities = [[dr.opaque(Double, value) for value in (rho, rho * (1 - w))] for rho, w in traps]
    packets, clouds, out = Float(flat(image)), Float(flat(volume)), dr.empty(Float, height * width)
    rows, columns = dr.opaque(UInt32, height), dr.opaque(UInt32, width)
    column = dr.arange(UInt32, width)
    deep = 1 << (height - 1).bit_length()  # few sizes, since each has a kernel of its own
    stack = [dr.alloc_local(kind, deep) for kind in (Float, UInt32)]  # size of a step, and the row where it begins

    def more(row: Any, *_: Any) -> Any:
        return row < rows

    def turn(
        row: Any, depth: Any, cloud: Any, step: Any, began: Any, begins: Any, before: Any, held: Any, stack: Any
    ) -> tuple[Any, ...]:
        """Remove the last step, of the size `step` from the row `began` on, or let the packet of `row` leave.

        The step of its cloud begins in the row `begins`, and `before` electrons were held after the packet before.
        """
        below = (depth > 0) & (step <= cloud)
        leaves = ~below
        rise = Double(dr.select(below, cloud - step, 0))
        near, far, here = row - begins + 1, row - began + 1, row * columns + column
        raised = []
        for (total, moment), (of_one, of_lag) in zip(held, sums, strict=True):
            one, lag = (
                dr.gather(Double, table, far, below) - dr.gather(Double, table, near, below)
                for table in (of_one, of_lag)
            )
            raised.append((dr.fma(rise, one, total), dr.fma(rise, Double(row) * one - lag, moment)))
        now = sum(a * total + b * moment for (a, b), (total, moment) in zip(densities, raised, strict=True))
        # what is below 0 is a rounding error
        left = dr.maximum(dr.gather(Float, packets, here, leaves) - Float(now - before), 0)
        dr.scatter(out, left, here, leaves)
        for memory, value in zip(stack, (cloud, begins), strict=True):
            # The bound holds in any case. As a literal it gives each size of the stack a kernel of its own: Dr.Jit
            # 1.5 takes kernels that differ in the size of local memory alone for one.
            memory.write(value, dr.minimum(depth, deep - 1), leaves)
        depth, row = dr.select(leaves, depth + 1, depth - 1), dr.select(leaves, row + 1, row)
        new = dr.gather(Float, clouds, row * columns + column, leaves & (row < rows))
        moved = []
        for w, (total, moment) in zip(kept, raised, strict=True):
            pair = dr.fma(total, w, Double(new)), dr.fma(moment, w, Double(row) * Double(new))
            moved.append(tuple(dr.select(leaves, b, a) for a, b in zip((total, moment), pair, strict=True)))
        older = below & (depth > 0)
        size, start = (memory.read(depth - 1, older) for memory in stack)
        return (
            row,
            depth,
            dr.select(leaves, new, cloud),
            dr.select(leaves, cloud, size),
            dr.select(leaves, begins, start),
            dr.select(leaves, row, began),
            dr.select(leaves, now, before),
            moved,
            stack,
        )

    first, zero = dr.gather(Float, clouds, column), dr.zeros(Double, width)
    state = (
        *(dr.zeros(kind, width) for kind in (UInt32, UInt32)),
        first,
        *(dr.zeros(kind, width) for kind in (Float, UInt32, UInt32)),
        zero,
    )
    held = [(Double(first), zero) for _ in traps]
    dr.while_loop((*state, held, stack), more, turn, mode="symbolic")
    return evaluated(out).reshape(height, width)


def capture(
    signal_e: F32,
    row: NDArray[np.integer],
    column: NDArray[np.integer],
    depth_e: NDArray[np.floating],
    *,
    direction: str = "up",
) -> F32:
    """Return the image after readout past single deep traps, float32[y, x] in e.

    Each trap takes the first `depth_e` electrons that pass it and never releases them during the readout. Traps are
    empty when readout starts. The packet of a trap's own pixel passes it first, then the packets behind. A packet
    meets the traps farthest from the register first.

    Parameters
    ----------
    signal_e
        Electrons, float32[y, x].
    row, column
        Pixel of each trap, int[n].
    depth_e
        Electrons that each trap holds, float[n].
    direction
        "up" or "down".
    """
    out = signal_e.copy()
    image = out if direction == "up" else out[::-1]
    distance = row if direction == "up" else len(image) - 1 - row
    order = np.lexsort((-distance, column))
    distance, column, depth = distance[order], column[order], np.asarray(depth_e, dtype=np.float64)[order]
    # each round handles one trap in every column, starting with the farthest; a few rounds are enough
    first = np.flatnonzero(np.append(True, np.diff(column) != 0)) if len(column) else column
    rank = np.arange(len(column)) - np.repeat(first, np.diff(np.append(first, len(column))))
    rows = np.arange(len(image))[:, None]
    for turn in range(int(rank.max(initial=-1)) + 1):
        now = rank == turn
        packets = image[:, column[now]].astype(np.float64)
        taken = np.minimum(np.cumsum(np.where(rows >= distance[now], packets, 0), axis=0), depth[now])
        image[:, column[now]] = packets - np.diff(taken, axis=0, prepend=0.0)
    return out


# ------------------------------------------------------------------------------------ shutters, waiting


def parasitic_light(
    signal_e: F32,
    exposure_s: float,
    *,
    sensitivity: float,
    row_period_s: float,
    direction: str = "up",
) -> F32:
    """Return the electrons of a global shutter, float32[y, x], including light that falls on the waiting charge.

    The scene shines on during the wait as it did during the exposure, so the stored charge gains sensitivity ×
    signal / exposure × waiting time of its row. `sensitivity` in [0, 1] is the parasitic light sensitivity: that of
    the storage node over that of the photodiode (1/50 000 for a CMV4000, recalled from its data sheet).
    """
    wait = np.arange(len(signal_e)) * np.float64(row_period_s)
    wait = wait if direction == "up" else wait[::-1]
    return signal_e * (1 + sensitivity / exposure_s * wait).astype(np.float32)[:, None]


# ---------------------------------------------------------------------------------------------------- helpers


def _facing(image: F32, direction: str, *, back: bool = False) -> F32:
    """Turn the image so that charge moves to row 0, or turn it `back`.

    The result is contiguous, and a copy unless `direction` is "up".
    """
    sideways = direction in ("left", "right")
    if direction == "up":
        return np.ascontiguousarray(image)
    if sideways and not back:
        image = cv2.transpose(image)  # much faster than numpy's
    if direction in ("down", "right"):
        image = cv2.flip(image, 0)
    return cv2.transpose(image) if sideways and back else image
