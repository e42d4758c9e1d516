"""Dark current and individual sensors against closed forms, quadrature, published values and scipy's laws."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from vbnfault.core.errors import InputError
from vbnfault.detector import dark
from vbnfault.detector.dark import (
    APS_GROWTH,
    CCD_GROWTH,
    HotPixelGrowth,
    RadiationDamage,
    Telegraph,
    annealing_factor,
    arrhenius_factor,
    silicon_factor,
)
from vbnfault.detector.individual import (
    Defects,
    Individual,
    IndividualSpec,
    aged,
    dark_rate_e_s,
    make_individual,
    offset_e,
    response,
)

SHAPE = (256, 256)
PIXELS = SHAPE[0] * SHAPE[1]
PITCH_UM = 5.5
PER_UM3_TEV_G = 2.370230e-5  # 0.09717943/4100

# every kind of defect in numbers, growing with years and dose
BUSY = IndividualSpec(
    dose_TeV_g=100.0,
    years=5.0,
    iso=1e6,
    hot_growth=replace(APS_GROWTH, log10_scale=0.5),
    hot_clustered_fraction=0.3,
    dead_fraction=1e-3,
    dead_fraction_yr=1e-3,
    stuck_fraction=1e-3,
    stuck_fraction_yr=1e-3,
    rts_fraction=1e-3,
    trap_fraction=1e-3,
    trap_fraction_TeV_g=1e-4,
)
KINDS = ("hot", "dead", "stuck", "rts", "traps")


def sensor(
    spec: IndividualSpec, seed: int = 1, shape: tuple[int, int] = SHAPE, pitch: float = PITCH_UM
) -> Individual:
    return make_individual(spec, shape, pixel_pitch_um=pitch, seed=seed)


def damage_of(interactions: float, anneal_s: float = dark.WEEK_S) -> RadiationDamage:
    return RadiationDamage(
        dose_TeV_g=interactions / (100 * PER_UM3_TEV_G), depletion_volume_um3=100.0, anneal_s=anneal_s
    )


def arrays(defects: Defects) -> dict[str, Any]:
    return {f.name: getattr(defects, f.name) for f in fields(defects) if f.name != "reference_K"}


# --- temperature ------------------------------------------------------------------------------------------------


def test_dark_current_of_silicon() -> None:
    """1 nA/cm² is 6.2415e9 e/s/cm², in (5.5 µm)² 1888.1 e/s; at 273 K worked by hand."""
    assert dark.rate_e_s(1.0, 5.5) == pytest.approx(6.241509e9 * 3.025e-7, rel=1e-6)
    # Eg(300) = 1.1557 - 63.189/1408 = 1.1108214, Eg(273) = 1.1557 - 52.3268/1381 = 1.1178095 eV;
    # 2kT = 0.0517040 and 0.0470506 eV; 0.91^1.5 = 0.868080. Six digits of a quotient of 23 leave 3e-5
    ratio = 0.868080 * math.exp(1.1108214 / 0.0517040 - 1.1178095 / 0.0470506)
    assert silicon_factor(273.0, 300.0) == pytest.approx(ratio, rel=5e-5)
    assert silicon_factor(250.0, 250.0) == arrhenius_factor(250.0, 250.0) == 1.0


# --- displacement damage ----------------------------------------------------------------------------------------


def test_damage_factors() -> None:
    """ν ≈ 8.0e3 e/s at 300 K after a week; its mean is the universal damage factor times volume and dose."""
    damage = RadiationDamage(dose_TeV_g=500.0, depletion_volume_um3=90.0)
    assert damage.interactions == pytest.approx(0.09717943 / 4100 * 90 * 500, rel=1e-12)
    assert damage.step_e_s() == pytest.approx(8.0e3, rel=3e-3)
    # 1.9e5 e/cm³/s per MeV/g, 90e-12 cm³, 500e6 MeV/g; after a week the annealing line passes 1 within 1e-3
    assert damage.interactions * damage.step_e_s() == pytest.approx(1.9e5 * 90e-12 * 500e6, rel=1e-3)
    assert damage.step_e_s(273.0) / damage.step_e_s() == pytest.approx(arrhenius_factor(273.0, 300.0), rel=1e-12)


def test_annealing_stops_where_it_was_measured() -> None:
    assert annealing_factor(dark.WEEK_S) == pytest.approx(1.0, abs=1e-3)
    assert annealing_factor(0.0) == annealing_factor(1e4) == pytest.approx((3.5948 - 0.3965 * 4) / 1.3024)
    assert annealing_factor(1e9) == annealing_factor(5e6) < annealing_factor(4.9e6)


def follows(rates: np.ndarray, damage: RadiationDamage, temperature_K: float) -> None:
    hit = rates[rates > 0]
    idle = math.exp(-damage.interactions)
    expected = rates.size * idle
    assert abs(rates.size - len(hit) - expected) < 4 * math.sqrt(expected * (1 - idle)) + 1
    above = stats.kstest(
        # of two Poisson counts, P(N_µ > N_x), given at least one interaction
        hit,
        lambda x: 1 - stats.skellam.sf(0, damage.interactions, x / damage.step_e_s(temperature_K)) / (1 - idle),
    )
    assert above.pvalue > 1e-3  # fixed seeds
    error = damage.step_e_s(temperature_K) * math.sqrt(2 * damage.interactions / rates.size)
    assert abs(rates.mean(dtype=np.float64) - damage.interactions * damage.step_e_s(temperature_K)) < 4 * error


def test_damage_of_an_individual_follows_the_law_and_so_does_each_further_dose() -> None:
    spec = IndividualSpec(dose_TeV_g=400.0, hot_growth=None, anneal_s=1e6)
    young = sensor(spec, seed=5, shape=(160, 180))
    old = aged(young, dose_TeV_g=700.0)
    follows(young.damage_e_s, spec.radiation(PITCH_UM), spec.reference_K)
    more = old.damage_e_s - young.damage_e_s
    assert more.min() >= 0
    # rounding of the sums leaves no false steps: a float32 of 1e5 e/s moves by 0.01
    follows(np.where(more > 0.05, more, 0), replace(spec, dose_TeV_g=300.0).radiation(PITCH_UM), spec.reference_K)


# --- hot pixels -------------------------------------------------------------------------------------------------


def test_growth_laws_as_published() -> None:
    assert APS_GROWTH.per_yr_mm2(1.0, 1.0) == pytest.approx(10**-1.13, rel=1e-12)
    assert CCD_GROWTH.per_yr_mm2(1.0, 1.0) == pytest.approx(10**-1.849, rel=1e-12)
    assert APS_GROWTH.per_yr_mm2(2.0, 1.0) / APS_GROWTH.per_yr_mm2(4.0, 1.0) == pytest.approx(2**3.05, rel=1e-12)
    assert CCD_GROWTH.per_yr_mm2(2.0, 1.0) / CCD_GROWTH.per_yr_mm2(4.0, 1.0) == pytest.approx(2**2.25, rel=1e-12)
    assert APS_GROWTH.per_yr_mm2(2.0, 400.0) / APS_GROWTH.per_yr_mm2(2.0, 100.0) == pytest.approx(4**0.505)
    assert CCD_GROWTH.per_yr_mm2(2.0, 400.0) / CCD_GROWTH.per_yr_mm2(2.0, 100.0) == pytest.approx(4**0.687)


@pytest.mark.parametrize("pitch", [2.2, 5.5, 10.0])
@pytest.mark.parametrize("growth", [APS_GROWTH, CCD_GROWTH], ids=["aps", "ccd"])
def test_counts_of_hot_pixels(growth: HotPixelGrowth, pitch: float) -> None:
    years, iso, shape = 50.0, 1e6, (500, 400)
    scale, size, gain = (10**-1.13, -3.05, 0.505) if growth is APS_GROWTH else (10**-1.849, -2.25, 0.687)
    expected = scale * pitch**size * iso**gain * years * 200_000 * (pitch * 1e-3) ** 2
    hot = sensor(IndividualSpec(hot_growth=growth, years=years, iso=iso), 4, shape, pitch).hot
    assert expected > 60
    assert abs(len(hot) - expected) < 4 * math.sqrt(expected)
    # at a constant rate, and anywhere
    assert stats.kstest(hot.born_yr, "uniform", (0, years)).pvalue > 1e-3
    assert np.all(np.diff(hot.born_yr) > 0)
    assert stats.kstest(hot.row, "uniform", (-0.5, 500)).pvalue > 1e-3
    assert stats.kstest(hot.column, "uniform", (-0.5, 400)).pvalue > 1e-3


@pytest.mark.parametrize("iso", [100.0, 6400.0])
def test_the_iso_setting_shows_more_of_the_same_hot_pixels(iso: float) -> None:
    """A gain makes no defects: above a rate are as many hot pixels at any ISO, with as many offsets."""
    growth = replace(APS_GROWTH, log10_scale=1.5)
    spec = IndividualSpec(years=50.0, hot_growth=growth)
    few, many = (sensor(replace(spec, iso=v), 5, (500, 400), 5.5).hot for v in sorted((iso, 400.0)))
    limit = 100 * 400 / min(iso, 400.0)  # the smallest rate at the lower setting, in e/s
    ratio = (max(iso, 400.0) / min(iso, 400.0)) ** growth.iso_power
    assert len(few) > 300
    assert abs(len(many) - ratio * len(few)) < 4 * math.sqrt((ratio + ratio**2) * len(few))
    assert few.rate_e_s.min() == pytest.approx(limit, rel=0.05)
    assert many.rate_e_s.min() == pytest.approx(100 * 400 / max(iso, 400.0), rel=0.05)
    above = many.rate_e_s >= limit
    for one, other in ((len(few), above.sum()), ((few.offset_e > 0).sum(), (many.offset_e[above] > 0).sum())):
        assert abs(one - other) < 4 * math.sqrt(one + other)  # both counts are Poisson's
    assert stats.ks_2samp(few.rate_e_s, many.rate_e_s[above]).pvalue > 1e-3


def many_hot(**changes: Any) -> Individual:
    """About 6000 hot pixels and nothing else dark."""
    spec = IndividualSpec(
        years=100.0, dark_current_e_s=0.0, dsnu_e=0.0, hot_growth=replace(APS_GROWTH, log10_scale=2.2)
    )
    return sensor(replace(spec, **changes), seed=8, shape=(1200, 600), pitch=5.5)


def test_hot_pixels_are_linear_in_exposure_with_their_offset() -> None:
    made = many_hot()
    hot = made.hot
    assert len(hot) > 3000
    flat = hot.row * 600 + hot.column
    _, where, times = np.unique(flat, return_index=True, return_counts=True)
    lone = where[times == 1]
    row, column = hot.row[lone], hot.column[lone]
    exposure = np.array([0.0, 0.01, 0.1, 1.0, 4.0])
    for temperature_K, warmer in ((298.15, 1.0), (288.0, arrhenius_factor(288.0, 298.15))):
        rate = dark_rate_e_s(made, temperature_K)[row, column]
        signal = offset_e(made)[row, column] + exposure[:, None] * rate
        slope, intercept = np.polynomial.polynomial.polyfit(exposure, signal, 1)[::-1]
        # float32 of up to 4e5 e: 0.03 e; the fit shares it
        np.testing.assert_allclose(slope, hot.rate_e_s[lone] * warmer, rtol=1e-5, atol=0.05)
        np.testing.assert_allclose(intercept, hot.offset_e[lone], rtol=1e-5, atol=0.05)
    # elsewhere nothing
    assert np.count_nonzero(made.damage_e_s) == len(where)


def test_sizes_of_hot_pixels() -> None:
    """Offsets: their share and mean. Rates: the power law between its ends, so that N(> R) falls as R^-0.505."""
    hot = many_hot().hot
    n = len(hot)
    stuck = hot.offset_e > 0
    assert abs(stuck.mean() - 0.45) < 4 * math.sqrt(0.45 * 0.55 / n)
    assert stats.kstest(hot.offset_e[stuck], "expon", (0, 500)).pvalue > 1e-3
    assert stats.kstest(hot.rate_e_s, stats.truncpareto(0.505, 1000, scale=100).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(hot.offset_e, hot.rate_e_s)[0, 1]) < 4 / math.sqrt(n)
    # more gain of ISO brings more above a threshold, as the law of growth counts them: with a far upper end,
    # N(> R/4)/N(> R) is 4^0.505
    hot = many_hot(hot_rate_e_s=(100.0, 1e8)).hot
    few, more = ((hot.rate_e_s > level).sum() for level in (1600.0, 400.0))
    # cut at 1e8: 0.4 % of those above 1600; their number counts within 4 σ
    assert more / few == pytest.approx(4**0.505, rel=4 * math.sqrt((1 - few / more) / few) + 0.005)


def test_clusters() -> None:
    def beside(made: Individual) -> float:
        """Share of defects with another on one of the eight pixels about them."""
        present = np.zeros(np.add(made.shape, 2), dtype=bool)
        row, column = made.hot.row + 1, made.hot.column + 1
        present[row, column] = True
        near = np.zeros(len(row), dtype=bool)
        for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
            near |= present[row + dy, column + dx]
        return float(near.mean())

    lone, paired = many_hot(), many_hot(hot_clustered_fraction=0.3)
    n = len(lone.hot)
    chance = 1 - math.exp(-8 * n / lone.gain.size)
    # neighbours come in pairs, which doubles the variance
    assert abs(beside(lone) - chance) < 4 * math.sqrt(2 * chance / n)
    # 0.3 are children, and at most as many, all others among 0.7, their parents
    parents = 0.7 * (1 - math.exp(-0.3 / 0.7))
    assert 0.3 + 0.5 * parents < beside(paired) < 0.3 + 0.3 + chance
    assert len(paired.hot) == n
    # whoever is not moved stays
    same = (paired.hot.row == lone.hot.row) & (paired.hot.column == lone.hot.column)
    assert abs(same.mean() - 0.7) < 4 * math.sqrt(0.21 / n)
    # and whoever is, stands beside one who was there before and stayed
    row, column = paired.hot.row, paired.hot.column
    for child in np.flatnonzero(~same)[:500]:
        apart = np.maximum(abs(row[:child] - row[child]), abs(column[:child] - column[child]))
        assert (same[:child] & (apart == 1)).any()
    tiny = sensor(replace(BUSY, hot_clustered_fraction=1.0, years=100.0), shape=(3, 7), pitch=30.0).hot
    assert len(tiny) == 0 or (tiny.row.max() < 3 and tiny.column.max() < 7 and tiny.row.min() >= 0)


# --- random telegraph signals -----------------------------------------------------------------------------------


def telegraph(high_s: float, low_s: float, n: int = 20_000) -> Telegraph:
    one = np.ones(n)
    return Telegraph(amplitude_e_s=100 * one, high_s=high_s * one, low_s=low_s * one)


@pytest.mark.parametrize(("high_s", "low_s", "exposure_s"), [(1.0, 3.0, 2.0), (5.0, 5.0, 0.5), (0.02, 0.01, 1.0)])
def test_exposures_of_telegraph_signals(high_s: float, low_s: float, exposure_s: float) -> None:
    """Mean, variance and memory of the two-level Markov process (Machlup 1954, doi 10.1063/1.1721637)."""
    signal = telegraph(high_s, low_s)
    n = len(signal.duty)
    rng = np.random.default_rng(6)
    state = signal.start(rng)
    share, end = signal.expose(state, exposure_s, rng)
    p = high_s / (high_s + low_s)
    tau = 1 / (1 / high_s + 1 / low_s)
    ratio = tau / exposure_s
    variance = 2 * p * (1 - p) * ratio * (1 - ratio * -math.expm1(-1 / ratio))
    assert share.min() >= 0
    assert share.max() <= 1
    assert abs(share.mean() - p) < 4 * math.sqrt(variance / n)
    # the square of the share varies by at most half of its range, so its variance by √(p q v)/√n
    assert abs(share.var() - variance) < 4 * math.sqrt(0.25 * variance / n)
    assert abs(end.mean() - p) < 4 * math.sqrt(p * (1 - p) / n)
    memory = ((state - p) * (end - p)).mean() / (p * (1 - p))
    assert abs(memory - math.exp(-exposure_s / tau)) < 4 * max(p / (1 - p), (1 - p) / p) / math.sqrt(n)
    # those that never switch: each level's own exponential times
    for level, mean_s, all_of_it in ((True, high_s, 1.0), (False, low_s, 0.0)):
        here = state == level
        stay = math.exp(-exposure_s / mean_s)
        found = (share[here] == all_of_it).sum()
        assert abs(found - here.sum() * stay) < 4 * math.sqrt(here.sum() * stay * (1 - stay)) + 1e-6


def test_telegraph_signals_at_their_limits() -> None:
    rng = np.random.default_rng(1)
    frozen = telegraph(1e12, 1e12, 50)
    state = frozen.start(rng)
    assert 0 < state.sum() < 50
    for exposure_s in (0.0, 10.0):
        share, end = frozen.expose(state, exposure_s, rng)
        np.testing.assert_allclose(share, state, atol=1e-12)
        np.testing.assert_array_equal(end, state)
    quick, _ = telegraph(1e-3, 3e-3, 20).expose(np.ones(20, dtype=bool), 50.0, rng)
    assert np.abs(quick - 0.25).max() < 5 * math.sqrt(2 * 0.1875 * 0.75e-3 / 50)
    none = telegraph(1.0, 1.0, 0)
    share, end = none.expose(none.start(rng), 1.0, rng)
    assert len(share) == len(end) == 0
    # far more switches than anyone can draw, as in the heat: the mean over many memories
    share, end = telegraph(1e-4, 3e-4, 20_000).expose(np.ones(20_000, dtype=bool), 1000.0, rng)
    assert share.mean() == pytest.approx(0.25, rel=1e-5)
    assert share.std() == pytest.approx(math.sqrt(2 * 0.1875 * 0.75e-4 / 1000), rel=0.03)
    assert end.mean() == pytest.approx(0.25, abs=0.015)
    with pytest.raises(InputError, match="exposure_s = inf: must be from 0"):
        none.expose(none.start(rng), math.inf, rng)


def levels(signal: Telegraph, times_s: np.ndarray, seed: int) -> np.ndarray:
    """Return the levels at times, bool[time, n], seen by exposures that are too short for a switch."""
    return np.array([signal.expose_at(float(t), 1e-9, seed) for t in times_s]) > 0.5


@pytest.mark.parametrize(("high_s", "low_s"), [(8.0, 20.0), (10.0, 10.0), (20.0, 6.0)])
def test_dwell_times_between_frames_are_exponential(high_s: float, low_s: float) -> None:
    """Frames 1 s apart see a chain that stays with a probability q, so dwell times exceed k frames with q^k.

    This is an exponential law at whole numbers, with the largest distance of Kolmogorov's test at 1e-3, 1.95/√n.
    The first dwell times of each signal count, all of which end long before the last frame.
    """
    signal, wanted = telegraph(high_s, low_s, 400), 4
    seen = levels(signal, np.arange(-300, 300, 1.0), 11)
    p, tau = signal.duty[0], signal.correlation_s[0]
    assert abs(seen.mean() - p) < 4 * math.sqrt(2 * p * (1 - p) * (tau + 0.5) / 600 / 400)
    for level, q in ((True, 1 - (1 - p) * -math.expm1(-1 / tau)), (False, 1 - p * -math.expm1(-1 / tau))):
        dwells = []
        for one in seen.T:
            switch = np.flatnonzero(np.diff(one)) + 1
            dwell = np.diff(switch)[one[switch[:-1]] == level][:wanted]
            assert len(dwell) == wanted
            dwells.extend(dwell)
        k = np.arange(1, 300)
        found = (np.asarray(dwells)[:, None] > k).mean(axis=0)
        assert np.abs(found - q**k).max() < 1.95 / math.sqrt(len(dwells))


def test_exposures_see_one_course_of_telegraph_signals() -> None:
    """Exposures that follow each other sum to the long one, in any order. Seeds and signals are independent."""
    signal = telegraph(3.0, 7.0, 5000)
    order = np.random.default_rng(3).permutation(20)
    parts = {k: signal.expose_at(1e6 + 0.5 * k, 0.5, 5) for k in order.tolist()}
    np.testing.assert_allclose(np.mean(list(parts.values()), axis=0), signal.expose_at(1e6, 10.0, 5), atol=1e-8)
    first, other = signal.expose_at(0.0, 1e-9, 5), signal.expose_at(0.0, 1e-9, 6)
    for one, two in ((first, other), (first[:-1], first[1:]), (parts[0], parts[0][::-1])):
        assert abs(np.corrcoef(one, two)[0, 1]) < 4 / math.sqrt(5000)
    np.testing.assert_array_equal(telegraph(3.0, 7.0, 50).expose_at(0.0, 1e-9, 5), first[:50])


@pytest.mark.parametrize(("high_s", "low_s", "exposure_s"), [(1.0, 3.0, 2.0), (5.0, 5.0, 0.5), (0.02, 0.01, 1.0)])
def test_exposures_of_a_course_vary_as_those_of_single_images(
    high_s: float, low_s: float, exposure_s: float
) -> None:
    """The last of them has 150 correlation times; see `test_exposures_of_telegraph_signals` for the closed form."""
    signal = telegraph(high_s, low_s)
    fraction = signal.expose_at(123.4, exposure_s, 2)
    p, ratio = signal.duty[0], signal.correlation_s[0] / exposure_s
    variance = 2 * p * (1 - p) * ratio * (1 - ratio * -math.expm1(-1 / ratio))
    assert abs(fraction.mean() - p) < 4 * math.sqrt(variance / 20_000)
    assert abs(fraction.var() - variance) < 4 * math.sqrt(0.25 * variance / 20_000)
    assert 0 <= fraction.min() <= fraction.max() <= 1
    mixed = Telegraph(**{name: np.concatenate([v, 1e4 * v]) for name, v in vars(signal).items()})
    np.testing.assert_array_equal(mixed.expose_at(123.4, exposure_s, 2)[:20_000], fraction)


def test_telegraph_pixels() -> None:
    """One in 1000 has more than 0.4 nA/cm² at 21 °C; the mean times are log-uniform; all follow temperature."""
    rts = sensor(IndividualSpec(rts_fraction=0.3, reference_K=294.15)).rts
    n = len(rts)
    assert abs(n - 0.3 * PIXELS) < 4 * math.sqrt(0.3 * PIXELS)
    limit = 0.4 * 6.241509e9 * (PITCH_UM * 1e-4) ** 2
    assert abs((rts.amplitude_e_s > limit).sum() - n / 1000) < 4 * math.sqrt(n / 1000)
    for times in (rts.high_s, rts.low_s):
        assert stats.kstest(times, stats.loguniform(1, 1e4).cdf).pvalue > 1e-3
    cold = rts.at(274.15)
    np.testing.assert_allclose(cold.amplitude_e_s, rts.amplitude_e_s * arrhenius_factor(274.15, 294.15))
    np.testing.assert_allclose(cold.high_s, rts.high_s * arrhenius_factor(294.15, 274.15, 0.9))
    np.testing.assert_allclose(cold.low_s * rts.high_s, cold.high_s * rts.low_s)
    # quoted at 294.15 K, whatever the reference temperature
    warm = sensor(IndividualSpec(rts_fraction=0.3, reference_K=310.0)).rts
    np.testing.assert_allclose(warm.at(294.15).amplitude_e_s, rts.amplitude_e_s)


# --- individuals ------------------------------------------------------------------------------------------------


def test_patterns_of_an_individual() -> None:
    made = sensor(IndividualSpec(prnu=0.02, dsnu_e=3.0, dark_current_e_s=40.0, dark_nonuniformity=0.2), seed=9)
    n = PIXELS
    for field, mean, deviation in ((made.gain, 1.0, 0.02), (made.dsnu_e, 0.0, 3.0), (made.dark_e_s, 40.0, 8.0)):
        assert field.shape == SHAPE
        assert field.dtype == np.float32
        assert not field.flags.writeable
        z = (field.astype(np.float64) - mean) / deviation
        assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
        for a, b in ((z[1:], z[:-1]), (z[:, 1:], z[:, :-1])):  # white
            assert abs((a * b).mean()) < 4 / math.sqrt(n)
    assert abs(np.corrcoef(made.gain.ravel(), made.dark_e_s.ravel())[0, 1]) < 4 / math.sqrt(n)


def test_rows_columns_and_slow_parts_of_the_gain() -> None:
    plain = IndividualSpec(prnu=0.0)
    shape = (300, 400)
    np.testing.assert_array_equal(sensor(plain, shape=shape).gain, 1)
    rows = sensor(replace(plain, prnu_row=0.01), shape=shape).gain
    np.testing.assert_array_equal(rows, rows[:, :1].repeat(400, axis=1))
    # spread of a standard deviation: 1/√(2n) of itself
    assert rows[:, 0].std() == pytest.approx(0.01, rel=4 / math.sqrt(600))
    columns = sensor(replace(plain, prnu_column=0.01), shape=shape).gain
    np.testing.assert_array_equal(columns, columns[:1].repeat(300, axis=0))
    assert columns[0].std() == pytest.approx(0.01, rel=4 / math.sqrt(800))
    slow = sensor(replace(plain, prnu_low=0.03), shape=shape).gain.astype(np.float64)
    assert slow.mean() == pytest.approx(1.0, abs=1e-5)
    assert slow.std() == pytest.approx(0.03, rel=1e-3)
    # six cells across: 50 rows each, so a step of one pixel is a small part of it
    assert np.abs(np.diff(slow, axis=0)).max() < 0.1 * np.ptp(slow)
    assert np.abs(np.diff(slow, axis=1)).max() < 0.1 * np.ptp(slow)
    wide = sensor(replace(plain, prnu=0.5), shape=shape).gain
    assert wide.min() == 0  # no negative response
    offsets = sensor(IndividualSpec(dsnu_e=0.0, dsnu_row_e=2.0), shape=shape).dsnu_e
    np.testing.assert_array_equal(offsets, offsets[:, :1].repeat(400, axis=1))
    assert offsets[:, 0].std() == pytest.approx(2.0, rel=4 / math.sqrt(600))


def test_offsets_with_heavy_tails_follow_students_t() -> None:
    spec = IndividualSpec(dsnu_e=2.0, dsnu_freedom=3.0)
    offsets = sensor(spec, shape=(200, 200)).dsnu_e.astype(np.float64).ravel()
    # t of ν degrees of freedom has the deviation √(ν / (ν - 2)): scaled, it keeps that of the spec
    assert stats.kstest(offsets / 2.0 * math.sqrt(3.0), stats.t(3).cdf).pvalue > 1e-3
    with pytest.raises(InputError, match="dsnu_freedom"):
        IndividualSpec(dsnu_freedom=2.0)


def test_same_seed_same_device_other_seed_another() -> None:
    a, b, c = sensor(BUSY, 3), sensor(BUSY, 3), sensor(BUSY, 4)
    for name in ("gain", "dsnu_e", "dark_e_s", "damage_e_s"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert (getattr(a, name) != getattr(c, name)).mean() > 0.1  # undamaged pixels stay at 0
    for kind in KINDS:
        one, same, other = (arrays(getattr(made, kind)) for made in (a, b, c))
        for name, values in one.items():
            assert len(values) > 5
            np.testing.assert_array_equal(values, same[name])
            n = min(len(values), len(other[name]))
            assert (values[:n] != other[name][:n]).any()


def test_one_property_leaves_the_others_alone() -> None:
    made = sensor(BUSY)
    changes: dict[str, set[str]] = {
        "prnu": {"gain"},
        "prnu_low": {"gain"},
        "dsnu_e": {"dsnu_e"},
        "dark_current_e_s": {"dark_e_s"},
        "iso": {"damage_e_s", "hot"},
        "hot_offset_e": {"hot"},
        "depletion_depth_um": {"damage_e_s", "rts"},
        "dead_fraction": {"dead"},
        "stuck_fraction": {"stuck"},
        "rts_fraction": {"rts"},
        "trap_fraction": {"traps"},
    }
    for key, touched in changes.items():
        other = sensor(replace(BUSY, **{key: getattr(BUSY, key) * 1.5 + 0.001}))
        for name in ("gain", "dsnu_e", "dark_e_s", "damage_e_s"):
            same = np.array_equal(getattr(made, name), getattr(other, name))
            assert same == (name not in touched), (key, name)
        for kind in KINDS:
            one, two = arrays(getattr(made, kind)), arrays(getattr(other, kind))
            same = all(np.array_equal(one[name], two[name]) for name in one)
            assert same == (kind not in touched), (key, kind)


def test_ageing_keeps_every_earlier_defect() -> None:
    young = sensor(BUSY, 7)
    old = aged(young, years=20.0, dose_TeV_g=250.0)
    for kind in KINDS:
        before, after = arrays(getattr(young, kind)), arrays(getattr(old, kind))
        for name, values in before.items():
            assert 0 < len(values) < len(after[name]), (kind, name)
            np.testing.assert_array_equal(values, after[name][: len(values)])
    for name in ("gain", "dsnu_e", "dark_e_s"):
        assert getattr(young, name) is getattr(old, name)
    assert np.all(old.damage_e_s >= young.damage_e_s)
    assert np.all(young.hot.born_yr <= 5)
    assert np.all(old.hot.born_yr[len(young.hot) :] > 5)
    for kind, expected in (("dead", 0.021), ("stuck", 0.021), ("traps", 0.026)):
        assert abs(len(getattr(old, kind)) - expected * PIXELS) < 4 * math.sqrt(expected * PIXELS)
    # the same as one made so old
    made = sensor(replace(BUSY, years=20.0, dose_TeV_g=250.0), 7)
    assert old.spec == made.spec
    np.testing.assert_array_equal(old.damage_e_s, made.damage_e_s)
    for kind in KINDS:
        one, two = arrays(getattr(old, kind)), arrays(getattr(made, kind))
        for name in one:
            np.testing.assert_array_equal(one[name], two[name])
    # clustering from now on moves none of those there were
    apart = aged(young, years=20.0, hot_clustered_fraction=0.0)
    np.testing.assert_array_equal(apart.hot.row[: len(young.hot)], young.hot.row)
    assert (apart.hot.row[len(young.hot) :] != old.hot.row[len(young.hot) : len(apart.hot)]).any()


def test_annealing_lowers_the_damage_of_radiation() -> None:
    fresh = sensor(IndividualSpec(dose_TeV_g=300.0, hot_growth=None))
    healed = aged(fresh, anneal_s=5e6)
    ratio = annealing_factor(5e6) / annealing_factor(dark.WEEK_S)
    np.testing.assert_allclose(healed.damage_e_s, fresh.damage_e_s * np.float32(ratio), rtol=1e-6)


def test_dark_rate_over_temperature() -> None:
    """Undamaged silicon and bulk damage, each by its own law."""
    made = sensor(replace(BUSY, dark_current_e_s=100.0), 2)
    np.testing.assert_allclose(dark_rate_e_s(made, 298.15), made.dark_e_s + made.damage_e_s, rtol=1e-6)
    rate = dark_rate_e_s(made, 268.15)
    assert rate.dtype == np.float32
    whole = made.damage_e_s == 0
    assert 0.5 < whole.mean() < 1
    np.testing.assert_allclose(rate[whole], made.dark_e_s[whole] * silicon_factor(268.15, 298.15), rtol=1e-6)
    hottest = np.unravel_index(made.damage_e_s.argmax(), SHAPE)
    by_hand = made.dark_e_s[hottest] * silicon_factor(268.15, 298.15)
    by_hand += made.damage_e_s[hottest] * arrhenius_factor(268.15, 298.15)
    assert rate[hottest] == pytest.approx(by_hand, rel=1e-6)


def test_a_data_sheets_doubling_temperature() -> None:
    """k T² ln 2/ΔT: 6.5 K at 298.15 K, to second order about it."""
    energy = 8.617333e-5 * 298.15**2 * math.log(2) / 6.5
    assert energy == pytest.approx(0.816, abs=1e-3)
    made = sensor(IndividualSpec(dark_activation_eV=energy, hot_growth=None))
    up, down = (float(dark_rate_e_s(made, t).mean()) for t in (298.15 + 3.25, 298.15 - 3.25))
    assert up / down == pytest.approx(2, rel=1e-3)
    with pytest.raises(InputError, match=r"dark_activation_eV = 3\.0: must be a number from 0\.1 to 2"):
        IndividualSpec(dark_activation_eV=3.0)


def test_dead_pixels_and_axes() -> None:
    shape = (40, 900)
    made = sensor(replace(BUSY, dead_fraction=0.02), shape=shape)
    assert made.shape == shape
    for kind in KINDS:
        defects = getattr(made, kind)
        assert defects.row.dtype == defects.column.dtype == np.int32
        assert defects.row.min() >= 0
        assert defects.row.max() < 40
        assert 700 < defects.column.max() < 900 or len(defects) < 20
    dead = made.dead
    assert dead.response.min() >= 0
    assert dead.response.max() < 1
    ratio = response(made) / made.gain
    assert (ratio < 1).sum() == len(np.unique(dead.row * 900 + dead.column))
    once = np.bincount(dead.row * 900 + dead.column, minlength=36_000)[dead.row * 900 + dead.column] == 1
    np.testing.assert_allclose(ratio[dead.row[once], dead.column[once]], dead.response[once], rtol=1e-5)


# --- errors -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: silicon_factor(20.0, 300.0), "temperature_K = 20: must be from 80 to 400"),
        (lambda: arrhenius_factor(300.0, math.nan), "reference_K = nan: must be from 80 to 400"),
        (lambda: damage_of(2000.0), "dose_TeV_g = .*: must be from 0 to 421900"),
        (lambda: replace(APS_GROWTH, iso_power=0.0), "iso_power = 0.0: must be a number from 0.01 to 5"),
        (lambda: IndividualSpec(prnu=0.6), "prnu = 0.6: must be a number from 0 to 0.5"),
        (lambda: IndividualSpec(rts_time_s=(5.0, 1.0)), "rts_time_s = .*: bounds reversed"),
        (
            lambda: IndividualSpec(hot_rate_e_s=(0.0, 1.0)),
            r"hot_rate_e_s\[0\] = 0.0: must be a number from 1e-09",
        ),
        (
            lambda: sensor(IndividualSpec(years=100.0, hot_growth=replace(APS_GROWTH, log10_scale=19.0))),
            "expected number of hot pixels = .*: must be from 0 to 2e",
        ),
    ],
)
def test_errors_name_key_value_and_range(call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
