"""Model dark current: how it depends on temperature, and what radiation and age add to it.

Rates are in electrons per second and pixel (e/s). The dark current of undamaged silicon follows the band gap. The
dark current of displacement damage in the bulk follows one activation energy. There are three models of damage:

- interactions of particles, each with its own rate (in space, from the displacement damage dose)
- hot pixels as counted in cameras on the ground (from age, pixel size and ISO)
- random telegraph signals: rates that jump between two levels
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core import hashing
from ..core.errors import InputError
from ..core.tables import table_class

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

BOLTZMANN_EV_K = 8.617333262e-5  # CODATA 2018
ELECTRON_C = 1.602176634e-19
DAMAGE_REFERENCE_K = 300.0  # temperature at which damage factors are quoted
BULK_DAMAGE_EV = 0.63  # Srour & Lo 2000
WEEK_S = 7 * 24 * 3600.0

# Srour & Lo 2000 (doi 10.1109/23.903792); Belloir et al. 2016 (doi 10.1364/OE.24.004299)
_DAMAGE_E_CM3_S_MEV_G = 1.9e5  # one week after the irradiation
_INTERACTIONS_UM3_TEV_G = 0.09717943 / 4100
_ANNEAL_S = (1e4, 5e6)  # range of times in which the annealing was measured

_MOST_INTERACTIONS = 1000.0


def checked(name: str, value: float, low: float, high: float) -> float:
    """Return `value`. Raises InputError if it is not between `low` and `high`."""
    if not low <= value <= high:
        raise InputError(f"{name} = {value:g}: must be from {low:g} to {high:g}")
    return float(value)


def _kelvin(name: str, value: float) -> float:
    return checked(name, value, 80.0, 400.0)


# --- temperature ------------------------------------------------------------------------------------------------


def band_gap_eV(temperature_K: float) -> float:
    """Return the band gap of silicon in eV: 1.1557 - 7.021e-4 T²/(T + 1108).

    Source: Varshni 1967, doi 10.1016/0031-8914(67)90062-6.
    """
    return 1.1557 - 7.021e-4 * temperature_K**2 / (temperature_K + 1108.0)


def silicon_factor(temperature_K: float, reference_K: float) -> float:
    """Return the dark current of undamaged silicon over that at `reference_K`: the ratio of T^1.5 exp(-Eg(T)/2kT).

    Both temperatures are 80 to 400 K; InputError otherwise. Source: Konnik & Welsh 2014 (arXiv 1412.4031).
    """

    def log(t: float) -> float:
        return 1.5 * math.log(t) - band_gap_eV(t) / (2 * BOLTZMANN_EV_K * t)

    return math.exp(log(_kelvin("temperature_K", temperature_K)) - log(_kelvin("reference_K", reference_K)))


def arrhenius_factor(
    temperature_K: float, reference_K: float, activation_energy_eV: float = BULK_DAMAGE_EV
) -> float:
    """Return a rate over that at `reference_K`: the ratio of exp(-Ea/kT).

    Both temperatures are 80 to 400 K, Ea is 0 to 3 eV. Raises InputError outside the ranges.
    """
    inverse = 1 / _kelvin("temperature_K", temperature_K) - 1 / _kelvin("reference_K", reference_K)
    energy = checked("activation_energy_eV", activation_energy_eV, 0.0, 3.0)
    return math.exp(-energy / BOLTZMANN_EV_K * inverse)


def rate_e_s(current_nA_cm2: float, pixel_pitch_um: float) -> float:
    """Convert a current density to electrons per second and pixel."""
    return current_nA_cm2 * 1e-9 / ELECTRON_C * (pixel_pitch_um * 1e-4) ** 2


# --- displacement damage ----------------------------------------------------------------------------------------


def annealing_factor(anneal_s: float) -> float:
    """Return the damage left after `anneal_s` at room temperature, over that left after a week.

    The damage falls linearly with log time: a line through Srour & Lo 2000 (doi 10.1109/23.903792), measured from
    1e4 to 5e6 s. Times outside take the value of the nearer end, 1.54 or 0.72.
    """
    t = min(max(anneal_s, _ANNEAL_S[0]), _ANNEAL_S[1])
    return (-0.3965 * math.log10(t) + 3.5948) / 1.3024


@dataclass(frozen=True, kw_only=True)
class RadiationDamage:
    """Model the dark current from displacement damage.

    The number of interactions in a pixel is Poisson distributed. Each adds a rate with an exponential distribution.
    Sources: Belloir et al. 2016 (doi 10.1364/OE.24.004299), Le Roch et al. 2019 (doi 10.1109/TNS.2019.2892645),
    with the universal damage factor of Srour & Lo 2000 (doi 10.1109/23.903792).

    Attributes
    ----------
    dose_TeV_g
        Displacement damage dose, 0 to 1e6 TeV/g.
    depletion_volume_um3
        Depleted volume of one pixel, 0 to 1e6 µm³.
    anneal_s
        Time since the irradiation, at least 0 s.

    Raises
    ------
    InputError
        A value is out of range, or dose and volume cause over 1000 interactions per pixel.
    """

    dose_TeV_g: float
    depletion_volume_um3: float
    anneal_s: float = WEEK_S

    def __post_init__(self) -> None:
        if self.interactions > _MOST_INTERACTIONS:
            most = _MOST_INTERACTIONS / (_INTERACTIONS_UM3_TEV_G * self.depletion_volume_um3)
            raise InputError(
                f"dose_TeV_g = {self.dose_TeV_g:g}: must be from 0 to {most:g}"
                f" ({_MOST_INTERACTIONS:g} interactions per pixel of {self.depletion_volume_um3:g} µm³)"
            )

    @property
    def interactions(self) -> float:
        """Return the mean number of interactions per pixel, µ."""
        return _INTERACTIONS_UM3_TEV_G * self.depletion_volume_um3 * self.dose_TeV_g

    def step_e_s(self, temperature_K: float = DAMAGE_REFERENCE_K) -> float:
        """Return the mean rate ν that one interaction adds, in e/s: 8.0e3 at 300 K a week after irradiation."""
        per_um3_TeV_g = _DAMAGE_E_CM3_S_MEV_G * 1e-12 * 1e6
        heat = arrhenius_factor(temperature_K, DAMAGE_REFERENCE_K)
        return per_um3_TeV_g / _INTERACTIONS_UM3_TEV_G * annealing_factor(self.anneal_s) * heat


# --- hot pixels -------------------------------------------------------------------------------------------------


@table_class()
class HotPixelGrowth:
    """Describe how the number of hot pixels grows: D = 10^log10_scale S^size_power ISO^iso_power per year and mm².

    S is the pixel pitch in µm. The fits of Chapman, Leung, Koren and Koren (Chapman et al. 2013, Leung et al. 2009)
    describe consumer cameras on the ground, so they are not rates in space.
    """

    log10_scale: float = Field(ge=-20, le=20, description="log10 of the rate at 1 µm and ISO 1")
    size_power: float = Field(ge=-10, le=10, description="power of the pixel pitch")
    iso_power: float = Field(ge=0.01, le=5, description="power of the ISO setting")

    def per_yr_mm2(self, pixel_pitch_um: float, iso: float) -> float:
        """Return the number of new defects per year and mm²."""
        return 10**self.log10_scale * pixel_pitch_um**self.size_power * iso**self.iso_power

    def expected(self, years: float, shape: tuple[int, int], pixel_pitch_um: float, iso: float) -> float:
        """Return the mean number of defects of a (height, width) sensor after `years`."""
        area_mm2 = shape[0] * shape[1] * (pixel_pitch_um * 1e-3) ** 2
        return self.per_yr_mm2(pixel_pitch_um, iso) * area_mm2 * years


APS_GROWTH = HotPixelGrowth(log10_scale=-1.13, size_power=-3.05, iso_power=0.505)
CCD_GROWTH = HotPixelGrowth(log10_scale=-1.849, size_power=-2.25, iso_power=0.687)


# --- random telegraph signals -----------------------------------------------------------------------------------

_SWITCHES = 32  # switching times drawn at once
_MOST_CYCLES = 1e4  # signals with more cycles in an exposure use the normal approximation
_MOST_MEMORIES = 64.0  # correlation times in an exposure
# Events in a correlation time, of which one is expected: the chance of more than 12 is 6e-11.
_MOST_EVENTS = 12
_COUNT_CHANCE = np.cumsum([math.exp(-1) / math.factorial(k) for k in range(_MOST_EVENTS)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Telegraph:
    """Hold two-level random telegraph signals, one per pixel, with exponential dwell times in either level.

    All fields are float64[n], above 0. A state is bool[n], True in the upper level.

    Attributes
    ----------
    amplitude_e_s
        Step between the levels in e/s.
    high_s, low_s
        Mean dwell time in the upper and lower level in s.
    """

    amplitude_e_s: F64
    high_s: F64
    low_s: F64

    @property
    def duty(self) -> F64:
        """Return the fraction of time in the upper level."""
        return self.high_s / (self.high_s + self.low_s)

    @property
    def correlation_s(self) -> F64:
        """Return the time in s after which the correlation of a state has fallen to 1/e."""
        return self.high_s * self.low_s / (self.high_s + self.low_s)

    def start(self, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Draw states of signals that have run for a long time."""
        return rng.random(len(self.duty)) < self.duty

    def expose(
        self, state: NDArray[np.bool_], exposure_s: float, rng: np.random.Generator
    ) -> tuple[F64, NDArray[np.bool_]]:
        """Return the fraction of the exposure in the upper level, float64[n] in [0, 1], and the states at its end.

        The switching times are drawn, so the result is exact. Signals with over 1e4 cycles in the exposure, as at
        high temperature, use an approximation: the fraction is normal about the duty, and the final state is drawn
        separately. An exposure of 0 s returns the given states. Raises InputError unless the exposure is finite and
        at least 0.
        """
        n = len(state)
        checked("exposure_s", exposure_s, 0.0, sys.float_info.max)
        if exposure_s == 0:
            return state.astype(np.float64), state.copy()
        high_total, end = np.zeros(n), state.copy()
        quick = exposure_s > _MOST_CYCLES * (self.high_s + self.low_s)
        left, now = np.flatnonzero(~quick), np.zeros(np.count_nonzero(~quick))
        while len(left):
            # exponential dwell times have no memory, so the time since the last switch does not matter
            first = state[left, None] ^ (np.arange(_SWITCHES) % 2 == 1)
            mean = np.where(first, self.high_s[left, None], self.low_s[left, None])
            switch = now[:, None] + np.cumsum(rng.standard_exponential((len(left), _SWITCHES)) * mean, axis=1)
            inside = np.minimum(switch, exposure_s)
            dwell = np.diff(inside, axis=1, prepend=now[:, None])
            high_total[left] += np.sum(dwell, axis=1, where=first)
            done = switch[:, -1] >= exposure_s
            passed = np.count_nonzero(switch < exposure_s, axis=1)
            end[left[done]] = state[left[done]] ^ (passed[done] % 2 == 1)
            left, now = left[~done], switch[~done, -1]
        fraction = np.minimum(high_total / exposure_s, 1.0)
        if quick.any():
            # variance of the mean over the exposure, for a correlation exp(-t/τ)
            duty, memory = self.duty[quick], self.correlation_s[quick] / exposure_s
            spread = np.sqrt(2 * memory * duty * (1 - duty))
            fraction[quick] = np.clip(duty + spread * rng.standard_normal(len(duty)), 0, 1)
            end[quick] = rng.random(len(duty)) < duty
        return fraction, end

    def expose_at(self, time_s: float, exposure_s: float, seed: int) -> F64:
        """Return the fraction in the upper level of an exposure that begins at a time, float64[n] in [0, 1].

        The signals of a seed are the same at all times, so that exposures in any order see one course of each. It
        is exact: events at the rate 1/correlation_s, at which a signal forgets its level and is in the upper one
        with the probability `duty`, are the same process. The last event before the exposure thus fixes the level
        at its start, and nothing before it matters. Of exposures over `_MOST_MEMORIES` times that long, only the
        start is of this course; they then go on as in `expose`.
        """
        start, span = time_s / self.correlation_s, exposure_s / self.correlation_s
        begin = np.floor(start)
        long = span > _MOST_MEMORIES
        cell, span = begin.copy(), np.where(long, np.spacing(1.0), span)
        number = np.arange(len(begin))
        back = number[~(self._events(seed, number, cell)[0] <= (start - begin)[:, None]).any(axis=1)]
        while len(back):
            cell[back] -= 1
            back = back[np.isinf(self._events(seed, back, cell[back])[0][:, 0])]
        total, upper = np.zeros(len(begin)), np.zeros(len(begin), bool)
        left = number
        while len(left):
            moment, after = self._events(seed, left, cell[left])
            cuts = np.pad(moment, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1)))
            cuts = np.clip(np.minimum(cuts, 1) + (cell - start)[left, None], 0, span[left, None])
            level = np.concatenate([upper[left, None], after], axis=1)
            total[left] += np.sum(np.diff(cuts, axis=1), axis=1, where=level)
            upper[left] = level[np.arange(len(left)), np.isfinite(moment).sum(axis=1)]
            cell[left] += 1
            left = left[(cell - start - span)[left] < 0]
        fraction = np.minimum(total / span, 1.0)
        if long.any():
            quick = Telegraph(**{name: values[long] for name, values in vars(self).items()})
            rng = np.random.default_rng([seed, int(np.float64(time_s).view(np.uint64))])
            fraction[long] = quick.expose(fraction[long] > 0.5, exposure_s, rng)[0]
        return fraction

    def _events(self, seed: int, number: NDArray[np.intp], cell: F64) -> tuple[F64, NDArray[np.bool_]]:
        """Return the events of signals within a cell of one correlation time, and the level after each.

        The moments are float64[n, `_MOST_EVENTS`], rising in [0, 1) from the start of the cell, infinite behind the
        last event. The levels are bool of this shape.
        """
        key = hashing.mixed(number.astype(np.uint64) * hashing.STEP + np.uint64(seed))
        key = hashing.mixed(key + cell.astype(np.int64).astype(np.uint64) * hashing.STEP)
        numbers = np.arange(1, 2 * _MOST_EVENTS + 2, dtype=np.uint64) * hashing.STEP
        drawn = hashing.uniform(hashing.mixed(key[:, None] + numbers))
        count = np.searchsorted(_COUNT_CHANCE, drawn[:, :1], side="right")
        moment, level = drawn[:, 1 : 1 + _MOST_EVENTS], drawn[:, 1 + _MOST_EVENTS :]
        moment = np.where(np.arange(_MOST_EVENTS) < count, moment, np.inf)
        return np.sort(moment, axis=1), level < self.duty[number, None]
