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
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.special import gammaincc

from ..core.errors import InputError
from ..core.tables import table_class
from .poisson import poisson_probability

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
_TABLE = 4096
_RAREST = 40.0  # -ln of the rarest survival in the table; a float64 uniform number reaches 36.7


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


def dark_current_e_s(temperature_K: float, *, figure_of_merit_nA_cm2: float, pixel_pitch_um: float) -> float:
    """Return the dark current of a pixel of undamaged silicon in e/s.

    `figure_of_merit_nA_cm2` is the current density at 300 K. Raises InputError as `silicon_factor` does.
    """
    return rate_e_s(figure_of_merit_nA_cm2, pixel_pitch_um) * silicon_factor(temperature_K, 300.0)


def doubling_temperature_K(
    temperature_K: float, *, activation_energy_eV: float | None = None, local: bool = False
) -> float:
    """Return the rise in temperature, in K, that doubles the dark current.

    Parameters
    ----------
    temperature_K
        Temperature from which it rises, 100 to 330 K.
    activation_energy_eV
        Activation energy, 0.1 to 3 eV; None stands for undamaged silicon.
    local
        Whether to use the slope at `temperature_K` (with an activation energy: k T² ln2/Ea) instead of the full
        step, which is longer.

    Raises
    ------
    InputError
        A value is out of range.
    """
    from scipy.optimize import brentq  # takes half a second to import; no detector of a build needs it

    t = checked("temperature_K", temperature_K, 100.0, 330.0)
    k = BOLTZMANN_EV_K
    if activation_energy_eV is not None:
        energy = checked("activation_energy_eV", activation_energy_eV, 0.1, 3.0)
        per_K = k * math.log(2) / energy
        return t * t * per_K / (1 if local else 1 - t * per_K)
    if local:
        gap_slope = -7.021e-4 * t * (t + 2 * 1108.0) / (t + 1108.0) ** 2
        return math.log(2) / (1.5 / t + band_gap_eV(t) / (2 * k * t * t) - gap_slope / (2 * k * t))
    return float(brentq(lambda step: silicon_factor(t + step, t) - 2.0, 0.0, 70.0, xtol=1e-10))


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
        checked("dose_TeV_g", self.dose_TeV_g, 0.0, 1e6)
        checked("depletion_volume_um3", self.depletion_volume_um3, 0.0, 1e6)
        checked("anneal_s", self.anneal_s, 0.0, 1e12)
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

    def mean_e_s(self, temperature_K: float = DAMAGE_REFERENCE_K) -> float:
        """Return the mean rate per pixel in e/s: µν."""
        return self.interactions * self.step_e_s(temperature_K)

    def survival(self, rate_e_s: ArrayLike, temperature_K: float = DAMAGE_REFERENCE_K) -> F64:
        """Return the fraction of pixels above a rate of at least 0: Σ Poisson(n; µ) Γ(n, x/ν)/Γ(n) over n ≥ 1."""
        return _survival(np.asarray(rate_e_s, dtype=np.float64) / self.step_e_s(temperature_K), self.interactions)

    def cdf(self, rate_e_s: ArrayLike, temperature_K: float = DAMAGE_REFERENCE_K) -> F64:
        """Return the fraction of pixels at or below a rate of at least 0.

        At rate 0 it is exp(-µ), the fraction of pixels without an interaction.
        """
        return 1.0 - self.survival(rate_e_s, temperature_K)

    def quantile(self, uniform: F64, temperature_K: float = DAMAGE_REFERENCE_K) -> F32:
        """Return the rate below which the fraction `uniform` of the pixels lies, float32 in e/s.

        `uniform` is in [0, 1): one variate per pixel. The result is interpolated in a table of the distribution.
        The error in probability is at most 1e-6 up to 30 interactions per pixel, and 1e-5 up to 1000.
        """
        out = np.zeros(uniform.shape, dtype=np.float32)
        if self.interactions == 0:
            return out
        hit = uniform > math.exp(-self.interactions)
        rarity, steps = _quantile_table(self.interactions)
        out[hit] = np.interp(-np.log1p(-uniform[hit]), rarity, steps * self.step_e_s(temperature_K))
        return out

    def draw(
        self, shape: tuple[int, int], rng: np.random.Generator, temperature_K: float = DAMAGE_REFERENCE_K
    ) -> F32:
        """Draw rates of pixels that received one dose, float32[y, x] in e/s.

        `make_individual` draws rates that grow with the dose.
        """
        return self.quantile(rng.random(shape), temperature_K)


def _survival(steps: F64, interactions: float) -> F64:
    """Return the fraction of pixels above a rate, given in units of the mean rate of one interaction."""
    # numbers outside this range have a probability below 1e-21, by Chernoff's bound
    spread = 10 * math.sqrt(interactions)
    out = np.zeros(steps.shape)
    for n in range(max(1, int(interactions - spread)), int(interactions + spread) + 60):
        out += poisson_probability(n, interactions) * gammaincc(n, steps)
    return out


@lru_cache(maxsize=16)
def _quantile_table(interactions: float) -> tuple[F64, F64]:
    """Return -ln(survival) and the rates at which it is reached, in units of the mean rate of one interaction."""
    # as a function of -ln(survival) the curve is nearly straight. Chernoff's bound, survival < exp(-(√x - √µ)²),
    # gives the end of the table
    steps = np.linspace(0, math.sqrt(interactions) + math.sqrt(_RAREST), _TABLE) ** 2
    return -np.log(_survival(steps, interactions)), steps


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
        """Return the number of new defects per year and mm².

        The pitch is 0.1 to 100 µm, the ISO setting 1 to 1e7. Raises InputError outside the ranges.
        """
        size = checked("pixel_pitch_um", pixel_pitch_um, 0.1, 100.0)
        return 10**self.log10_scale * size**self.size_power * checked("iso", iso, 1.0, 1e7) ** self.iso_power

    def expected(self, years: float, shape: tuple[int, int], pixel_pitch_um: float, iso: float) -> float:
        """Return the mean number of defects of a (height, width) sensor after `years`."""
        area_mm2 = shape[0] * shape[1] * (pixel_pitch_um * 1e-3) ** 2
        return self.per_yr_mm2(pixel_pitch_um, iso) * area_mm2 * years


APS_GROWTH = HotPixelGrowth(log10_scale=-1.13, size_power=-3.05, iso_power=0.505)
CCD_GROWTH = HotPixelGrowth(log10_scale=-1.849, size_power=-2.25, iso_power=0.687)


def hot_pixel_signal(
    exposure_s: ArrayLike, *, photo_e_s: ArrayLike, dark_e_s: ArrayLike, offset_e: ArrayLike, gain: float = 1.0
) -> F64:
    """Return the signal of a hot pixel, I = m (R_photo T + R_dark T + b), in electrons times the gain m.

    The gain is proportional to the ISO setting. All arguments are at least 0 and broadcast. Source: Chapman et al.
    2013.
    """
    rate = np.asarray(photo_e_s, dtype=np.float64) + np.asarray(dark_e_s, dtype=np.float64)
    charge = rate * np.asarray(exposure_s, dtype=np.float64) + np.asarray(offset_e, dtype=np.float64)
    return np.asarray(gain * charge)


# --- random telegraph signals -----------------------------------------------------------------------------------

_SWITCHES = 32  # switching times drawn at once
_MOST_CYCLES = 1e4  # signals with more cycles in an exposure use the normal approximation


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

    def later(self, state: NDArray[np.bool_], gap_s: float, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Draw the states `gap_s` after the given states.

        The result is exact for any gap, without drawing the switches in between. Raises InputError for a negative
        gap.
        """
        memory = np.exp(-checked("gap_s", gap_s, 0.0, math.inf) / self.correlation_s)
        return rng.random(len(state)) < self.duty + (state - self.duty) * memory

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
