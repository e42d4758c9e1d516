"""Generate one device of a sensor type.

A seed fixes the properties of the device; age and radiation add defects.

Every property has its own random stream, keyed by (seed, name). Every defect has a fixed position in an endless
list in order of birth; the age or dose says how much of the list exists. So more hot pixels do not change the gain
map, and an older device keeps all its earlier defects.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core.tables import Fraction, pair_within, table_class
from .dark import (
    APS_GROWTH,
    WEEK_S,
    HotPixelGrowth,
    RadiationDamage,
    Telegraph,
    arrhenius_factor,
    checked,
    rate_e_s,
    silicon_factor,
)
from .noise import normal_field

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_LOW_FREQUENCY_CELLS = 6  # nodes across the sensor of the slowly varying gain
_BIRTHS = 1 << 15  # births drawn at once; another number changes the result of a seed
_MOST_DEFECTS = 2e8  # limit for defects of one kind: drawing them takes seconds

# Assumed, within the range of energies of silicon's traps: the switching rate of a defect depends more steeply on
# temperature than its dark current.
_RTS_TIME_EV = 0.9
_RTS_REFERENCE_K = 294.15

_RATES_ISO = 400.0  # ISO setting for which `hot_rate_e_s` holds


@table_class()
class IndividualSpec:
    """Describe what devices of one sensor type, age and dose have in common.

    Rates refer to `reference_K`, signals are in electrons (e), fractions are of all pixels. Numbers marked * are
    assumed. Hot pixels are displacement damage too: with a dose from the same years, damage counts twice.
    """

    prnu: float = Field(
        default=0.01, ge=0, le=0.5, description="standard deviation of the gain about 1, per pixel*"
    )
    prnu_row: float = Field(default=0.0, ge=0, le=0.5, description="of the gain of rows")
    prnu_column: float = Field(default=0.0, ge=0, le=0.5, description="of the gain of columns")
    prnu_low: float = Field(default=0.0, ge=0, le=0.5, description="of the slow variation of the gain")
    dsnu_e: float = Field(default=2.0, ge=0, le=1e5, description="standard deviation of the offset, per pixel*")
    dsnu_freedom: float | None = Field(
        default=None,
        ge=2.1,
        le=1000,
        description="degrees of freedom of Student's t, whose heavy tails the pixels' offsets then have; default: "
        "they are normal",
    )
    dsnu_row_e: float = Field(default=0.0, ge=0, le=1e5, description="of the offset of rows")
    dsnu_column_e: float = Field(default=0.0, ge=0, le=1e5, description="of the offset of columns")
    dark_current_e_s: float = Field(
        default=15.0, ge=0, le=1e8, description="mean dark current of undamaged pixels, e/s"
    )
    dark_nonuniformity: float = Field(default=0.1, ge=0, le=1, description="its spread* over the mean")
    dark_activation_eV: float | None = Field(
        default=None,
        ge=0.1,
        le=2,
        description="activation energy of the dark current, k T² ln 2/ΔT of a data sheet's doubling temperature "
        "ΔT; default: silicon's band gap",
    )
    reference_K: float = Field(default=298.15, ge=80, le=400, description="temperature of these rates")
    dose_TeV_g: float = Field(default=0.0, ge=0, le=1e6, description="displacement damage dose")
    depletion_depth_um: float = Field(
        default=3.0, ge=0, le=100, description="depth* of a pixel's depleted volume; times its area"
    )
    anneal_s: float = Field(default=WEEK_S, ge=0, le=1e12, description="time since the irradiation")
    years: float = Field(default=0.0, ge=0, le=100, description="age")
    hot_growth: HotPixelGrowth | None = Field(
        default=APS_GROWTH, description="growth law of hot pixels; default: that of the architecture"
    )
    # A camera sees a hot pixel above a threshold that falls as 1/ISO; with this power the number above it grows
    # with ISO as in the growth law. So the setting decides which of the same hot pixels there are. How bright each
    # is in the image follows from the gain.
    iso: float = Field(
        default=_RATES_ISO,
        ge=1,
        le=1e7,
        description="ISO setting at which hot pixels are counted: more and fainter ones the higher it is; how "
        "bright they are follows from the converter's gain",
    )
    hot_rate_e_s: pair_within(1e-9, 1e8) = Field(  # type: ignore[valid-type]
        default=(100.0, 1e5),
        description=f"smallest, at ISO {_RATES_ISO:g}, and largest rate* of a hot pixel; the smallest falls as "
        "1/iso, and the number above a rate R as R^-iso_power",
    )
    hot_offset_fraction: Fraction = Field(
        default=0.45, description="fraction of hot pixels with an offset; over 0.4: Chapman et al. 2013"
    )
    hot_offset_e: float = Field(
        default=500.0, ge=0, le=1e6, description="mean* of the exponentially distributed offset"
    )
    hot_clustered_fraction: Fraction = Field(
        default=0.0, description="fraction of hot pixels that are born next to an earlier one"
    )
    dead_fraction: float = Field(default=1e-6, ge=0, le=0.1, description="fraction* of dead pixels at delivery")
    dead_fraction_yr: float = Field(default=0.0, ge=0, le=0.1, description="its growth per year")
    stuck_fraction: float = Field(default=0.0, ge=0, le=0.1, description="fraction of stuck pixels at delivery")
    stuck_fraction_yr: float = Field(default=0.0, ge=0, le=0.1, description="its growth per year")
    rts_fraction: Fraction = Field(default=0.0, description="fraction of pixels with telegraph signals at delivery")
    rts_per_interaction: Fraction = Field(default=0.05, description="more of them per radiation interaction*")
    # In proton-irradiated CCDs at 21 °C many pixels have up to 0.1 nA/cm² and one in 1000 up to 0.4 (Hopkins &
    # Hopkinson 1993, doi 10.1109/23.273552).
    rts_amplitude_nA_cm2: float = Field(
        default=0.4 / math.log(1000),
        ge=0,
        le=100,
        description="mean of the exponentially distributed amplitude at 294 K",
    )
    rts_time_s: pair_within(1e-3, 1e9) = Field(  # type: ignore[valid-type]
        default=(1.0, 1e4),
        description="shortest and longest mean time* in a level at reference_K; log-uniform",
    )
    trap_fraction: float = Field(
        default=0.0, ge=0, le=0.1, description="fraction of pixels with CCD traps at delivery"
    )
    trap_fraction_TeV_g: float = Field(default=0.0, ge=0, le=0.1, description="its growth per TeV/g")
    trap_depth_e: float = Field(
        default=200.0, ge=0, le=1e6, description="mean* of their exponentially distributed depth"
    )

    def dark_factor(self, temperature_K: float) -> float:
        """Return the dark current of undamaged pixels over that at the reference temperature."""
        if self.dark_activation_eV is None:
            return silicon_factor(temperature_K, self.reference_K)
        return arrhenius_factor(temperature_K, self.reference_K, self.dark_activation_eV)

    def radiation(self, pixel_pitch_um: float) -> RadiationDamage:
        """Return the radiation damage that this dose causes in a pixel."""
        volume = self.depletion_depth_um * pixel_pitch_um**2
        return RadiationDamage(dose_TeV_g=self.dose_TeV_g, depletion_volume_um3=volume, anneal_s=self.anneal_s)


def _freeze(holder: Any) -> None:
    """Make all arrays of a dataclass read-only."""
    for field in fields(holder):
        value = getattr(holder, field.name)
        if isinstance(value, np.ndarray):
            value.flags.writeable = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Defects:
    """Hold the pixels of some defects, int32[n] each, in order of birth. Two defects can share a pixel."""

    row: I32
    column: I32

    def __post_init__(self) -> None:
        _freeze(self)

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True, kw_only=True, eq=False)
class HotPixelTable(Defects):
    """Hold hot pixels.

    `rate_e_s` float64[n] refers to the reference temperature, `offset_e` float64[n] is in electrons. `born_yr`
    float64[n] is the age of the sensor at their birth.
    """

    rate_e_s: F64
    offset_e: F64
    born_yr: F64


@dataclass(frozen=True, kw_only=True, eq=False)
class DeadPixels(Defects):
    """Hold dead pixels. `response`, float64[n] from 0 to below 1, multiplies their gain."""

    response: F64


@dataclass(frozen=True, kw_only=True, eq=False)
class StuckPixels(Defects):
    """Hold stuck pixels. They always show `level`, a fraction of full scale, float64[n] from 0 to 1."""

    level: F64


@dataclass(frozen=True, kw_only=True, eq=False)
class RtsPixels(Defects):
    """Hold pixels with telegraph signals: amplitude and mean time in each level at `reference_K`, float64[n]."""

    amplitude_e_s: F64
    high_s: F64
    low_s: F64
    reference_K: float

    def at(self, temperature_K: float) -> Telegraph:
        """Return the signals at a temperature of 80 to 400 K. Heat raises both amplitudes and switching rates.

        The activation energy of the amplitudes is 0.63 eV, as for other bulk damage; that of the times is 0.9 eV
        (both assumed). Raises InputError outside the range.
        """
        slower = 1 / arrhenius_factor(temperature_K, self.reference_K, _RTS_TIME_EV)
        return Telegraph(
            amplitude_e_s=self.amplitude_e_s * arrhenius_factor(temperature_K, self.reference_K),
            high_s=self.high_s * slower,
            low_s=self.low_s * slower,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Traps(Defects):
    """Hold CCD traps. Each holds up to `depth_e` electrons, float64[n]."""

    depth_e: F64


@dataclass(frozen=True, kw_only=True, eq=False)
class Individual:
    """Hold all fixed properties of one device.

    Maps are float32[y, x] and read-only. Rates refer to `spec.reference_K`.

    Attributes
    ----------
    gain
        Response over the mean response, at least 0, without dead pixels.
    dsnu_e
        Fixed offset in electrons of either sign, without hot pixels.
    dark_e_s
        Dark current of undamaged silicon in e/s.
    damage_e_s
        Dark current of bulk damage (radiation and hot pixels) in e/s.
    """

    spec: IndividualSpec
    seed: int
    pixel_pitch_um: float
    gain: F32
    dsnu_e: F32
    dark_e_s: F32
    damage_e_s: F32
    hot: HotPixelTable
    dead: DeadPixels
    stuck: StuckPixels
    rts: RtsPixels
    traps: Traps

    def __post_init__(self) -> None:
        _freeze(self)

    @property
    def shape(self) -> tuple[int, int]:
        """Return (height, width) in pixels."""
        height, width = self.gain.shape
        return height, width


def make_individual(
    spec: IndividualSpec, shape: tuple[int, int], *, pixel_pitch_um: float, seed: int
) -> Individual:
    """Generate the (height, width) device of a seed, at the age and dose of the spec.

    Raises InputError for a spec that makes more than 2e8 defects of one kind.
    """
    # every pattern has its own generator, so switching one off does not change the others
    gain = _pattern(seed, "prnu", shape, spec.prnu, spec.prnu_row, spec.prnu_column)
    if spec.prnu_low > 0:
        gain += _slow(seed, shape) * np.float32(spec.prnu_low)
    gain += np.float32(1)
    np.maximum(gain, 0, out=gain)
    dark = _pattern(seed, "dark", shape, spec.dark_nonuniformity)
    dark += np.float32(1)
    np.maximum(dark, 0, out=dark)
    dark *= np.float32(spec.dark_current_e_s)
    return Individual(
        spec=spec,
        seed=seed,
        pixel_pitch_um=pixel_pitch_um,
        gain=gain,
        dsnu_e=_pattern(
            seed, "dsnu", shape, spec.dsnu_e, spec.dsnu_row_e, spec.dsnu_column_e, freedom=spec.dsnu_freedom
        ),
        dark_e_s=dark,
        **_defects(spec, shape, pixel_pitch_um, seed),
    )


def aged(individual: Individual, **changes: Any) -> Individual:
    """Return the same device at a later state.

    `changes` may set a later age (`years`), a higher dose (`dose_TeV_g`), another time since the irradiation
    (`anneal_s`) or another growth of defects. Defects keep their positions; annealing lowers the rates of radiation
    damage. The result equals `make_individual` with such a spec, bit for bit. The exception is
    `hot_clustered_fraction`, which applies to new hot pixels only.
    """
    spec = individual.spec
    new = replace(spec, **changes)
    earlier = len(individual.hot), spec.hot_clustered_fraction
    changed = _defects(new, individual.shape, individual.pixel_pitch_um, individual.seed, earlier)
    return replace(individual, spec=new, **changed)


def _defects(
    spec: IndividualSpec,
    shape: tuple[int, int],
    pixel_pitch_um: float,
    seed: int,
    earlier: tuple[int, float] = (0, 0.0),
) -> dict[str, Any]:
    """Return the properties of an individual that depend on its age and dose.

    `earlier` holds the number of hot pixels placed before, and the clustered fraction used for them.
    """
    hot = _hot(spec, shape, pixel_pitch_um, seed, earlier)
    return {
        "damage_e_s": _damage(spec, shape, pixel_pitch_um, seed, hot),
        "hot": hot,
        "dead": _dead(spec, shape, seed),
        "stuck": _stuck(spec, shape, seed),
        "rts": _rts(spec, shape, pixel_pitch_um, seed),
        "traps": _traps(spec, shape, seed),
    }


def dark_rate_e_s(individual: Individual, temperature_K: float) -> F32:
    """Return the dark current of each pixel at 80 to 400 K, float32[y, x] in e/s, without telegraph signals.

    Raises InputError outside the range.
    """
    silicon = individual.spec.dark_factor(temperature_K)
    bulk = arrhenius_factor(temperature_K, individual.spec.reference_K)
    return np.asarray(cv2.addWeighted(individual.dark_e_s, silicon, individual.damage_e_s, bulk, 0.0))


def offset_e(individual: Individual) -> F32:
    """Return the offset of each pixel, float32[y, x] in electrons: its DSNU plus the offset b of hot pixels."""
    out = individual.dsnu_e.copy()
    np.add.at(out, (individual.hot.row, individual.hot.column), individual.hot.offset_e)
    return out


def response(individual: Individual) -> F32:
    """Return the response of each pixel over the mean response, float32[y, x], at least 0, with dead pixels."""
    out = individual.gain.copy()
    np.multiply.at(out, (individual.dead.row, individual.dead.column), individual.dead.response)
    return out


# --- draws ------------------------------------------------------------------------------------------------------


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random generator of a device for (seed of the device, name)."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence([seed, *name.encode()])))


def _pattern(
    seed: int,
    name: str,
    shape: tuple[int, int],
    pixel: float,
    row: float = 0.0,
    column: float = 0.0,
    *,
    freedom: float | None = None,
) -> F32:
    """Draw normal variates of mean 0 per pixel, plus others that are constant along a row or a column.

    With `freedom`, above 2, those of the pixels follow Student's t with so many degrees of freedom instead. `pixel`
    stays their standard deviation.
    """
    if pixel > 0:
        out = normal_field(shape, stream(seed, name))
        out *= np.float32(pixel)
        if freedom is not None:
            # t = normal / √(χ² / ν), of variance ν / (ν - 2); χ² is twice a gamma variate of shape ν/2
            half_chi2 = stream(seed, f"{name} tails").standard_gamma(freedom / 2, shape, dtype=np.float32)
            out *= np.sqrt(np.float32(freedom / 2 - 1) / half_chi2)
    else:
        out = np.zeros(shape, dtype=np.float32)
    if row > 0:
        out += stream(seed, f"{name} row").standard_normal((shape[0], 1), dtype=np.float32) * np.float32(row)
    if column > 0:
        out += stream(seed, f"{name} column").standard_normal((1, shape[1]), dtype=np.float32) * np.float32(column)
    return out


def _slow(seed: int, shape: tuple[int, int]) -> F32:
    """Draw a smooth field of mean 0 and standard deviation 1 from the same nodes at any resolution."""
    nodes = stream(seed, "prnu low").standard_normal((_LOW_FREQUENCY_CELLS, _LOW_FREQUENCY_CELLS), dtype=np.float32)
    field = cv2.resize(nodes, shape[::-1], interpolation=cv2.INTER_CUBIC)
    mean, deviation = cv2.meanStdDev(field)
    return np.asarray((field - np.float32(mean[0, 0])) / np.float32(max(deviation[0, 0], 1e-6)), dtype=np.float32)


def _birth_blocks(rng: np.random.Generator, expected: float) -> Iterator[F64]:
    """Draw the births of a Poisson process of rate 1 in [0, expected], in order.

    A larger `expected` only appends births.
    """
    now = 0.0
    while now < expected:
        births = now + np.cumsum(rng.standard_exponential(_BIRTHS))
        now = float(births[-1])
        yield births if now <= expected else births[: np.searchsorted(births, expected, side="right")]


def _births(seed: int, name: str, expected: float) -> F64:
    """Return all births of `_birth_blocks`. Raises InputError if too many are expected."""
    checked(f"expected number of {name} pixels", expected, 0.0, _MOST_DEFECTS)
    return np.concatenate([np.zeros(0), *_birth_blocks(stream(seed, f"{name} birth"), expected)])


def _uniform(seed: int, name: str, count: int) -> F64:
    """Draw the first `count` numbers of an endless list; a larger count keeps the first numbers."""
    return stream(seed, name).random(count)


def _places(seed: int, name: str, count: int, shape: tuple[int, int]) -> tuple[I32, I32]:
    """Draw the row and column of each defect."""
    row = _uniform(seed, f"{name} row", count) * shape[0]
    column = _uniform(seed, f"{name} column", count) * shape[1]
    return row.astype(np.int32), column.astype(np.int32)


def _damage(
    spec: IndividualSpec, shape: tuple[int, int], pixel_pitch_um: float, seed: int, hot: HotPixelTable
) -> F32:
    """Return the dark current of bulk damage in each pixel, float32[y, x] in e/s at the reference temperature."""
    radiation = spec.radiation(pixel_pitch_um)
    pixels = shape[0] * shape[1]
    expected = checked("expected number of interactions", radiation.interactions * pixels, 0.0, _MOST_DEFECTS)
    births, places, sizes = (stream(seed, f"radiation {name}") for name in ("birth", "place", "size"))
    steps = np.zeros(pixels, dtype=np.float32)
    for born in _birth_blocks(births, expected):
        place = (places.random(len(born)) * pixels).astype(np.intp)
        np.add.at(steps, place, sizes.standard_exponential(len(born)).astype(np.float32))
    # one activation energy serves all damage, so one factor scales it from 300 K
    damage = steps.reshape(shape)
    damage *= np.float32(radiation.step_e_s(spec.reference_K))
    np.add.at(damage, (hot.row, hot.column), hot.rate_e_s.astype(np.float32))
    return damage


def _hot(
    spec: IndividualSpec, shape: tuple[int, int], pixel_pitch_um: float, seed: int, earlier: tuple[int, float]
) -> HotPixelTable:
    """Draw the hot pixels born up to the age of the spec."""
    growth = spec.hot_growth
    per_yr = 0.0 if growth is None else growth.expected(1.0, shape, pixel_pitch_um, spec.iso)
    born = _births(seed, "hot", per_yr * spec.years)
    count = len(born)
    fraction = np.where(np.arange(count) < earlier[0], earlier[1], spec.hot_clustered_fraction)
    row, column = _clustered(*_places(seed, "hot", count, shape), fraction, shape, seed)
    rate = hot_rates_e_s(spec, _uniform(seed, "hot rate", count))
    # those that only a higher ISO shows are faint, so they have no offset either
    sticks = (_uniform(seed, "hot sticks", count) < spec.hot_offset_fraction) & (rate >= min(spec.hot_rate_e_s))
    offset = -np.log1p(-_uniform(seed, "hot offset", count)) * spec.hot_offset_e
    return HotPixelTable(
        row=row,
        column=column,
        rate_e_s=rate,
        offset_e=np.where(sticks, offset, 0.0),
        born_yr=born / max(per_yr, 1e-300),
    )


def hot_rates_e_s(spec: IndividualSpec, chance: F64) -> F64:
    """Return the rates of hot pixels at the reference temperature, float64[n], for uniform variates."""
    # inverse distribution function of a power law between two limits
    seen, most = spec.hot_rate_e_s
    least = min(seen * _RATES_ISO / spec.iso, most)
    power = 1.0 if spec.hot_growth is None else spec.hot_growth.iso_power
    return least * (1 - chance * (1 - (least / most) ** power)) ** (-1 / power)


def _clustered(row: I32, column: I32, fraction: F64, shape: tuple[int, int], seed: int) -> tuple[I32, I32]:
    """Move each defect, with probability `fraction`, next to an earlier, unmoved defect."""
    count = len(row)
    moved = _uniform(seed, "hot clustered", count) < fraction
    alone = np.flatnonzero(~moved)
    before = np.cumsum(~moved)  # for a moved defect: the number of unmoved ones before it
    moved &= before > 0
    which = np.flatnonzero(moved)
    parent = alone[(_uniform(seed, "hot parent", count)[which] * before[which]).astype(np.intp)]
    side = (_uniform(seed, "hot side", count)[which] * 8).astype(np.intp)
    neighbours = np.array([(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)])[side]
    out = []
    for place, step, size in zip((row, column), neighbours.T, shape, strict=True):
        to = place[parent] + step
        to = np.where((to < 0) | (to >= size), place[parent] - step, to)  # at an edge, use the other side
        place[which] = np.clip(to, 0, size - 1)
        out.append(place)
    return out[0], out[1]


def _expected(spec: IndividualSpec, shape: tuple[int, int], fraction: float, fraction_yr: float) -> float:
    """Return the expected number of defects at the age of the spec."""
    return (fraction + fraction_yr * spec.years) * shape[0] * shape[1]


def _dead(spec: IndividualSpec, shape: tuple[int, int], seed: int) -> DeadPixels:
    count = len(_births(seed, "dead", _expected(spec, shape, spec.dead_fraction, spec.dead_fraction_yr)))
    row, column = _places(seed, "dead", count, shape)
    return DeadPixels(row=row, column=column, response=_uniform(seed, "dead response", count))


def _stuck(spec: IndividualSpec, shape: tuple[int, int], seed: int) -> StuckPixels:
    count = len(_births(seed, "stuck", _expected(spec, shape, spec.stuck_fraction, spec.stuck_fraction_yr)))
    row, column = _places(seed, "stuck", count, shape)
    return StuckPixels(row=row, column=column, level=_uniform(seed, "stuck level", count))


def _rts(spec: IndividualSpec, shape: tuple[int, int], pixel_pitch_um: float, seed: int) -> RtsPixels:
    interactions = spec.radiation(pixel_pitch_um).interactions
    expected = (spec.rts_fraction + spec.rts_per_interaction * interactions) * shape[0] * shape[1]
    count = len(_births(seed, "rts", expected))
    return rts_pixels(spec, pixel_pitch_um, seed, "rts", *_places(seed, "rts", count, shape))


def rts_pixels(
    spec: IndividualSpec, pixel_pitch_um: float, seed: int, name: str, row: I32, column: I32
) -> RtsPixels:
    """Draw the telegraph signals of given pixels, by the random streams of a name."""
    count = len(row)
    mean = rate_e_s(spec.rts_amplitude_nA_cm2, pixel_pitch_um) * arrhenius_factor(
        spec.reference_K, _RTS_REFERENCE_K
    )
    shortest, longest = spec.rts_time_s
    return RtsPixels(
        row=row,
        column=column,
        amplitude_e_s=-np.log1p(-_uniform(seed, f"{name} amplitude", count)) * mean,
        high_s=shortest * (longest / shortest) ** _uniform(seed, f"{name} high", count),
        low_s=shortest * (longest / shortest) ** _uniform(seed, f"{name} low", count),
        reference_K=spec.reference_K,
    )


def _traps(spec: IndividualSpec, shape: tuple[int, int], seed: int) -> Traps:
    expected = (spec.trap_fraction + spec.trap_fraction_TeV_g * spec.dose_TeV_g) * shape[0] * shape[1]
    count = len(_births(seed, "trap", expected))
    row, column = _places(seed, "trap", count, shape)
    return Traps(
        row=row, column=column, depth_e=-np.log1p(-_uniform(seed, "trap depth", count)) * spec.trap_depth_e
    )
