"""The detector: noise against Poisson, the photon-transfer relation, exact degenerate cases, twins."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtri

from vbnfault.core import spectra
from vbnfault.core.quantities import Electrons, Irradiance
from vbnfault.detector import (
    EXACT_POISSON_BELOW_E,
    Noise,
    ThreeColourDetector,
    poisson_quantile,
)
from vbnfault.detector.noise import NormalField, poisson_cumulative, poisson_least_count, uniform_codes

SHORT_S = 1e-3
NODES = spectra.band_nodes_nm(400, 700, 8)
MEANS = [0.1, 0.7, 1.0, 3.0, 3.99, 4.0, 4.5, 6.0, 8.0, 12.0, 30.0, 100.0, 999.0, 1000.0, 1e4, 1e5]


def flat(detector: ThreeColourDetector, value: float, shape: tuple[int, int] = (64, 64)) -> Electrons:
    return Electrons(array=np.full((*shape, 3), value, np.float32), white_e=detector.white_e)


def raw_dn(detector: ThreeColourDetector, signal: np.ndarray, noise: Noise | None = None) -> np.ndarray:
    """The codes of a signal after `SHORT_S`, by the single steps."""
    shot, read = (None, None) if noise is None else (noise.shot.values(), noise.read.values())
    return detector.converted_dn(detector.collected_e(signal, SHORT_S, shot), read)


def draw(seed: int, shape: tuple[int, int] = (64, 64)) -> Noise:
    return Noise.draw(shape, np.random.default_rng(seed))


# ------------------------------------------------------------------------------------------------------ noise


def split_mix(key: list[int], place: int) -> int:
    """Return a word of 64 bits by the published steps of SplitMix64, with a second number mixed in halfway."""
    low = 2**64 - 1
    z = (key[0] + place * 0x9E3779B97F4A7C15) & low
    z = ((z ^ z >> 30) * 0xBF58476D1CE4E5B9 & low) ^ key[1]
    z = (z ^ z >> 27) * 0x94D049BB133111EB & low
    return z ^ z >> 31


def test_the_published_numbers_of_split_mix() -> None:
    """The oracle gives what the authors' code gives for the seed 1234567, whose state advances before a number."""
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert [split_mix([1234567, 0], k) for k in (1, 2, 3, 4)] == published


@pytest.mark.parametrize("size", [0, 1, 3, 4, 4 * 50_001, 4 * 50_001 + 2])
def test_uniform_numbers_are_those_of_split_mix(size: int) -> None:
    key = np.random.default_rng(8).integers(0, 2**64, 2, dtype=np.uint64)
    codes, outermost = uniform_codes(size, key)
    words = [split_mix([int(k) for k in key], place) for place in range(-(-size // 4))]
    expected = [word >> shift & 0xFFFF for word in words for shift in (0, 16, 32, 48)][:size]
    np.testing.assert_array_equal(codes, expected)
    np.testing.assert_array_equal(outermost, [k for k, code in enumerate(expected) if code in (0, 65535)])


def test_uniform_numbers_have_no_pattern() -> None:
    """Counts of the numbers, and correlations in space, between keys and between bits, are those of chance."""
    size, keys = 1 << 22, np.random.default_rng(9).integers(0, 2**64, (2, 2), dtype=np.uint64)
    one, two = (uniform_codes(size, key)[0] for key in keys)
    near = uniform_codes(size, keys[0] + np.array([1, 0], np.uint64))[0]
    for codes in (one, two):
        chi2 = ((np.bincount(codes, minlength=65536) - 64.0) ** 2 / 64).sum()
        assert abs(chi2 - 65535) < 5 * np.sqrt(2 * 65535)  # mean and variance of chi squared
    centred = one - 32767.5
    pairs = [(centred[:-lag], centred[lag:]) for lag in (1, 2, 3, 4, 6, 1024, 6 * 1024)]
    pairs += [(centred, two - 32767.5), (centred, near - 32767.5)]
    bits = np.unpackbits(one.view(np.uint8)).reshape(-1, 16)[: 1 << 18] - 0.5
    correlation = bits.T @ bits / (0.25 * len(bits)) - np.eye(16)
    for a, b in pairs:
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(len(a))  # standard deviation 1 / √n
    assert np.abs(correlation).max() < 5 / np.sqrt(len(bits))


def test_noise_fields_are_standard_normal_and_unrelated() -> None:
    noise = draw(3, (400, 400))
    n = 400 * 400 * 3
    shot, read = noise.shot.values(), noise.read.values()
    for field in (shot, read):
        assert field.shape == (400, 400, 3)
        assert field.dtype == np.float32
        # fixed seeds; 1e-3 shared by eight comparisons. At 480,000 values the largest step a 16 bit table may
        # make in the distribution, 1.5e-5, is far below the 1.4e-3 that Kolmogorov and Smirnov see
        assert stats.kstest(field.ravel(), "norm").pvalue > 1e-3 / 8
        assert abs(field.mean()) < 4 / np.sqrt(n)
        assert abs(field.var() - 1) < 4 * np.sqrt(2 / n)
        for z in (3.0, 4.2, 4.5):  # both tails, as many as there should be: Poisson within 4 σ
            expected = n * stats.norm.sf(z)
            for tail in ((field > z).sum(), (field < -z).sum()):
                assert abs(tail - expected) < 4 * np.sqrt(expected) + 1
        # neither along a row, nor down a column, nor from colour to colour
        for a, b in (
            (field[1:], field[:-1]),
            (field[:, 1:], field[:, :-1]),
            (field[..., 1:], field[..., :-1]),
        ):
            assert abs((a * b).mean()) < 4.5 / np.sqrt(a.size)
    assert abs((shot * read).mean()) < 4 / np.sqrt(n)


# ---------------------------------------------------------------------------------------------------- Poisson

# midpoints of a million equal slices of the distribution: no sampling noise
SLICES = (np.arange(1_000_000) + 0.5) / 1e6
QUANTILES = stats.norm.ppf(SLICES).astype(np.float32)


def exact_count(normal: np.ndarray, mean: float) -> np.ndarray:
    """The least count whose cumulative probability reaches Φ(normal)."""
    if mean == 0:
        return np.zeros(normal.shape)
    counts = np.arange(int(mean + 9 * np.sqrt(mean) + 30))
    return np.searchsorted(stats.poisson.cdf(counts, mean), stats.norm.cdf(normal.astype(np.float64)))


@pytest.mark.parametrize("mean", MEANS)
def test_poisson_quantile_keeps_its_stated_errors(mean: float) -> None:
    got = poisson_quantile(np.full(len(QUANTILES), mean, np.float32), QUANTILES).astype(np.float64)
    mean = float(np.float32(mean))
    exact = exact_count(QUANTILES, mean)
    off = got - exact
    if mean < EXACT_POISSON_BELOW_E:
        # one slice may fall on either side of a step for the rounding of its last bit
        assert np.count_nonzero(off) <= 2
        return
    assert np.abs(off).max() <= 1
    assert (off != 0).mean() <= (0.002 if mean <= 1e4 else 0.005)
    assert abs(off.mean()) <= (0.0005 if mean <= 1e4 else 0.005)
    assert got.var() == pytest.approx(exact.var(), rel=1e-3)


@pytest.mark.parametrize("mean", [0.1, 1.0, 3.99, 4.0, 6.0, 8.0, 12.5, 16.5, 30.0, 100.0, 999.0, 1001.0, 1e4])
def test_every_probability_is_right_to_a_hundredth(mean: float) -> None:
    """The variate at which each count begins, by bisection, gives its probability; the lower tail was 43 % off."""
    counts = np.arange(int(mean + 6 * np.sqrt(mean) + 9))
    probability = stats.poisson.pmf(counts, mean)
    low, high = np.full(len(counts), -9.0, np.float32), np.full(len(counts), 9.0, np.float32)
    for _ in range(30):
        middle = (low + high) / 2
        reached = poisson_quantile(np.full(len(counts), mean, np.float32), middle) > counts
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    ends = high.astype(np.float64)
    below = np.diff(stats.norm.cdf(ends), prepend=0.0)
    above = -np.diff(stats.norm.sf(ends), prepend=1.0)
    got = np.where(ends < 0, below, above)
    likely = probability > 1e-6
    # float32 rounds a count near 1e4 to 0.001, and the boundaries of a count by as much
    np.testing.assert_allclose(got[likely], probability[likely], rtol=0.01)


@pytest.mark.parametrize("mean", [1e-6, 0.3, 4.0, 31.7, 5000.0])
def test_poisson_functions_have_the_bits_of_scipy(mean: float) -> None:
    count = np.arange(int(mean + 12 * np.sqrt(mean) + 20))
    np.testing.assert_array_equal(poisson_cumulative(count, mean), stats.poisson.cdf(count, mean))
    for upper in (0.9, 0.5, 1e-3, 1e-9):
        assert poisson_least_count(1 - upper, mean) == stats.poisson.isf(upper, mean)


def test_poisson_rises_with_the_variate_and_spares_its_arguments() -> None:
    for mean in (0.0, 1e-20, 0.5, 3.9, 4.0, 20.0, 999.0, 1001.0, 1e4):
        z = np.linspace(-5, 5, 20_001, dtype=np.float32)
        m = np.full(z.shape, mean, np.float32)
        counts = poisson_quantile(m, z)
        assert np.all(np.diff(counts) >= 0)
        assert counts.dtype == np.float32
        assert mean > 1e-9 or not counts.any()
        np.testing.assert_array_equal(m, np.float32(mean))
        np.testing.assert_array_equal(z, np.linspace(-5, 5, 20_001, dtype=np.float32))


@pytest.mark.parametrize("dark_e", [0.0, 0.015, 3.0, 20.0, 75.0, 2000.0])
def test_dark_frame_is_the_poisson_of_its_dark_current(dark_e: float) -> None:
    # pixels without light go a quicker way: the same draws, but for the error stated
    detector = ThreeColourDetector(dark_current_e_s=dark_e / SHORT_S)
    noise = draw(5, (128, 128))
    shot = noise.shot.values().astype(np.float64)
    electrons = detector.collected_e(flat(detector, 0.0, (128, 128)).array, SHORT_S, noise.shot.values())
    exact = stats.poisson.ppf(stats.norm.cdf(shot), np.float32(dark_e)) if dark_e else 0.0
    assert np.abs(electrons - exact).max() <= 1
    assert (electrons != exact).mean() <= 0.003


# ---------------------------------------------------------------------------------------------------- photons


def test_electrons_expected_is_the_weighted_sum_of_the_bands() -> None:
    detector = ThreeColourDetector()
    light = np.random.default_rng(1).random((8, 37, 53), dtype=np.float32)
    got = detector.electrons_expected(Irradiance(array=light, wavelength_nm=NODES), 0.02)
    weights = (
        spectra.electron_weights(lambda nm: spectra.response("nikon_5100", nm, 0.5), NODES) * (5.5e-6) ** 2 * 0.02
    )
    expected = np.einsum("cb,byx->yxc", weights, light.astype(np.float64))
    # eight products of float32 numbers: 8 · 6e-8
    np.testing.assert_allclose(got.array, expected, rtol=1e-6)
    assert got.array.dtype == np.float32
    assert got.array.shape == (37, 53, 3)


@pytest.mark.parametrize("rows", [1, 7, 1000])
def test_expected_electrons_of_a_pixel_depend_on_neither_the_others_nor_the_blocks(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    light = np.random.default_rng(1).random((8, 90, 77), dtype=np.float32)
    whole, crop = (
        ThreeColourDetector().electrons_expected(Irradiance(array=part.copy(), wavelength_nm=NODES), 0.02).array
        for part in (light, light[:, 7:23, 5:68])
    )
    np.testing.assert_array_equal(crop, whole[7:23, 5:68])
    monkeypatch.setattr("vbnfault.detector.interface._ROWS_PER_BLOCK", rows)
    again = ThreeColourDetector().electrons_expected(Irradiance(array=light, wavelength_nm=NODES), 0.02).array
    np.testing.assert_array_equal(again, whole)


def test_a_grey_surface_in_sunlight_is_grey() -> None:
    detector = ThreeColourDetector(width_px=4, height_px=4)
    assert detector.white_balance.min() == 1
    for level in (0.02, 0.2, 0.7):
        sun = spectra.solar_band_irradiance_W_m2_nm(NODES, 2.0)
        light = np.broadcast_to(sun[:, None, None], (8, 4, 4)).astype(np.float32)
        light_e = detector.electrons_expected(Irradiance(array=light.copy(), wavelength_nm=NODES), 1.0).array
        scale = level * float((detector.white_e / light_e[0, 0]).mean())
        expected = detector.electrons_expected(
            Irradiance(array=light * np.float32(scale), wavelength_nm=NODES), 1.0
        )
        # white balance and bands integrate the same tables on the same grid: float32 is all that differs
        balanced = expected.array * detector.white_balance
        np.testing.assert_allclose(balanced, np.broadcast_to(balanced[..., :1], balanced.shape), rtol=1e-5)
        image = detector.develop(expected, SHORT_S, None).array
        assert np.ptp(image) <= 1  # three converters, each rounding
        assert abs(float(image.mean()) - 255 * level) <= 1


# ------------------------------------------------------------------------------------- exact degenerate cases


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_no_light_gives_the_bias_and_black(bits: int) -> None:
    detector = ThreeColourDetector(dark_current_e_s=0, adc_bits=bits, bias_dn=17)
    dark = flat(detector, 0.0)
    np.testing.assert_array_equal(raw_dn(detector, dark.array), 17)
    np.testing.assert_array_equal(detector.develop(dark, SHORT_S, None).array, 0)
    # shot noise of no electrons is none
    np.testing.assert_array_equal(detector.collected_e(dark.array, SHORT_S, draw(1).shot.values()), 0)


@pytest.mark.parametrize("dark_current_e_s", [0.0, 125.0, 30_000.0])
def test_dark_current_is_subtracted_as_black_level(dark_current_e_s: float) -> None:
    detector = ThreeColourDetector(dark_current_e_s=dark_current_e_s)
    image = detector.develop(flat(detector, 0.0), 0.1, None)
    # half a code of rounding is 0.03 of a step at most: it rounds to 0
    np.testing.assert_array_equal(image.array, 0)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_saturation_gives_the_top_code_and_255(bits: int) -> None:
    detector = ThreeColourDetector(adc_bits=bits, dark_current_e_s=0)
    for light in (detector.full_well_e, 2 * detector.full_well_e, 1e9):
        np.testing.assert_array_equal(raw_dn(detector, flat(detector, light).array), 2**bits - 1)
        np.testing.assert_array_equal(detector.develop(flat(detector, light), SHORT_S, None).array, 255)


@pytest.mark.parametrize("exposure_s", [5.0, 1e4])
def test_saturation_is_white_after_a_long_exposure_too(exposure_s: float) -> None:
    # after 1e4 s the dark signal alone fills the well
    detector = ThreeColourDetector(dark_current_e_s=125)
    np.testing.assert_array_equal(detector.develop(flat(detector, 1e6), exposure_s, None).array, 255)


def test_full_well_clips_before_bias_and_read_noise() -> None:
    # read noise is added to a clipped well and then cut at the top code: what is left below it is the mean of
    # min(0, N(0, σ)) = -σ/√(2π), and half of the pixels. Clipping afterwards would leave no noise at all
    detector = ThreeColourDetector(read_noise_e_rms=50.0)
    shape = (200, 200)
    raw = raw_dn(detector, flat(detector, 1e6, shape).array, draw(8, shape))
    sigma_dn = 50.0 * detector.gain_dn_per_e
    short = 4095 - raw.astype(np.float64)
    n = short.size
    assert short.mean() == pytest.approx(sigma_dn / np.sqrt(2 * np.pi), abs=4 * sigma_dn / np.sqrt(n))
    # codes are 1 wide: those within half a code of the top count as top
    expected = stats.norm.cdf(-0.5 / sigma_dn)
    assert (short > 0).mean() == pytest.approx(expected, abs=4 * np.sqrt(0.25 / n))


def test_the_bias_keeps_the_noise_of_a_dark_frame_whole() -> None:
    detector = ThreeColourDetector(dark_current_e_s=0)
    shape = (200, 200)
    dark, noise = flat(detector, 0.0, shape).array, draw(9, shape)
    raw = raw_dn(detector, dark, noise).astype(np.float64)
    sigma = 13 * detector.gain_dn_per_e
    assert raw.mean() == pytest.approx(64, abs=4 * sigma / np.sqrt(raw.size))
    assert raw.var() == pytest.approx(sigma**2 + 1 / 12, rel=4 * np.sqrt(2 / raw.size))
    # a bias too low would cut it: with none, half of the pixels stick at 0
    cut = raw_dn(ThreeColourDetector(dark_current_e_s=0, bias_dn=0), dark, noise)
    assert (cut == 0).mean() == pytest.approx(stats.norm.cdf(0.5 / sigma), abs=4 * np.sqrt(0.25 / cut.size))


# -------------------------------------------------------------------------------------------- gain, linearity


def test_noise_free_response_is_linear() -> None:
    detector = ThreeColourDetector(dark_current_e_s=0)
    signal = np.linspace(0, 13_500, 64 * 64 * 3, dtype=np.float32).reshape(64, 64, 3)
    given = Electrons(array=signal.copy(), white_e=detector.white_e)
    raw = raw_dn(detector, signal)
    ideal = 64 + (4095 - 64) / 13_500 * signal.astype(np.float64)
    # half a code, and 4095 · 6e-8 of float32
    assert np.abs(raw - ideal).max() <= 0.5 + 3e-4
    image = detector.develop(given, SHORT_S, None).array[..., :3]
    ideal = np.clip(255 / 4031 * (raw - 64.0) * detector.white_balance, 0, 255)
    assert np.abs(image - ideal).max() <= 0.5 + 1e-4


@pytest.mark.parametrize("signal_e", [0.0, 5.0, 50.0, 500.0, 3000.0, 9000.0])
def test_photon_transfer(signal_e: float) -> None:
    # EMVA 1288: σ² = K² (signal + dark + read²) + 1/12
    detector = ThreeColourDetector(dark_current_e_s=20.0 / SHORT_S)
    shape = (256, 256)
    noise = draw(int(signal_e) + 10, shape)
    raw = raw_dn(detector, flat(detector, signal_e, shape).array, noise)
    k = detector.gain_dn_per_e
    n = raw.size
    expected = k**2 * (signal_e + 20 + 13**2) + 1 / 12
    # nearly normal: a variance spreads by √(2/n); excess kurtosis below 1/20
    assert raw.var(dtype=np.float64) == pytest.approx(expected, rel=4 * np.sqrt(2.05 / n))
    assert raw.mean(dtype=np.float64) == pytest.approx(64 + k * (signal_e + 20), abs=4 * np.sqrt(expected / n))


def test_intensity_is_the_luminance() -> None:
    detector = ThreeColourDetector()
    raw = np.random.default_rng(4).integers(0, 4096, (50, 60, 3)).astype(np.float32)
    image = detector.shown(raw, SHORT_S)
    luminance = image[..., :3].astype(np.float64) @ [0.2126, 0.7152, 0.0722]  # Rec. 709
    # rounding of the result, and of three weights to whole 65536ths
    assert np.abs(image[..., 3] - luminance).max() <= 0.5 + 3 * 255 * 0.5 / 65536
    assert len(np.unique(image[..., 3])) > 200


def test_colours_stay_in_their_channels() -> None:
    detector = ThreeColourDetector(dark_current_e_s=0)
    for c in range(3):
        only = np.zeros((8, 8, 3), np.float32)
        only[..., c] = detector.white_e[c] / 2
        image = detector.develop(Electrons(array=only, white_e=detector.white_e), SHORT_S, None).array
        assert image[..., c].min() >= 127
        np.testing.assert_array_equal(np.delete(image[..., :3], c, axis=-1), 0)


# ------------------------------------------------------------------------------------------- twins and blocks


def gradient(detector: ThreeColourDetector, shape: tuple[int, int]) -> np.ndarray:
    signal = np.linspace(0, 1.2 * detector.full_well_e, shape[0] * shape[1] * 3, dtype=np.float32)
    signal[: len(signal) // 4] = 0  # sky
    return signal.reshape(*shape, 3)


@pytest.mark.parametrize("brighter", [1.0, 30.0, 1e5])
def test_brightening_a_patch_changes_no_other_pixel(brighter: float) -> None:
    detector = ThreeColourDetector()
    shape = (101, 70)
    noise, signal = draw(6, shape), gradient(detector, shape)
    patch = np.zeros(shape, dtype=bool)
    patch[10:40, 5:33] = True  # over sky and ground
    lit = signal + np.float32(brighter) * patch[..., None]
    one, two = (
        detector.develop(Electrons(array=a, white_e=detector.white_e), 0.1, noise).array for a in (signal, lit)
    )
    np.testing.assert_array_equal(one[~patch], two[~patch])
    assert (one[patch] != two[patch]).any() or brighter == 1.0
    assert np.all(two[patch] >= one[patch])  # at the same quantile more light gives no fewer electrons


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_can_develop_too() -> None:
    # data loaders of learning frameworks fork their workers
    script = """
import os, signal
import numpy as np
from vbnfault.detector import Noise
rng = np.random.default_rng(1)
Noise.draw((64, 64), rng)
child = os.fork()
if not child:
    signal.alarm(600)  # it guards against a test that hangs
    Noise.draw((64, 64), rng)
    os._exit(0)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=False).returncode == 0


def noise_of_bytes(*rngs: np.random.Generator) -> Noise:
    """Return noise for 64 × 64 pixels from the bytes of two generators, as those figures have it."""
    codes = np.stack([np.frombuffer(r.bytes(2 * 64 * 64 * 3), np.uint16).reshape(64, 64, 3) for r in rngs], -1)
    fields = []
    for k, rng in enumerate(rngs):
        tail = np.flatnonzero((codes[..., k] == 0) | (codes[..., k] == 65535))
        values = ndtri((1 - rng.random(len(tail))) / 65536) * np.where(codes[..., k].flat[tail] == 0, 1, -1)
        fields.append(NormalField(codes=codes[..., k], tail=tail, tail_values=values.astype(np.float32)))
    return Noise(codes=codes, shot=fields[0], read=fields[1])


def test_the_paper_worlds_detector_is_what_it_was() -> None:
    """Block means of a picture of fixed light and noise, as first published: sensors with a mosaic must not change
    the one without. A block has 256 pixels, of which five may round otherwise on another processor."""
    d = ThreeColourDetector(width_px=64, height_px=64)
    ramp = np.linspace(0, 1.2, 64, dtype=np.float32)
    light = np.stack([np.tile(ramp, (64, 1)), np.tile(ramp[:, None], (1, 64)), np.full((64, 64), 0.05)], axis=-1)
    expected = Electrons(array=(light * d.white_e).astype(np.float32), white_e=d.white_e)
    noise = noise_of_bytes(*(np.random.default_rng([7, *name]) for name in (b"shot", b"read")))
    image = d.develop(expected, 0.02, noise).array.astype(float)
    blocks = image.reshape(4, 16, 4, 16, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(blocks[0, :, 0], [36.34, 114.18, 191.83, 251.25], atol=0.02)
    np.testing.assert_allclose(blocks[:, 1, 1], [36.38, 114.29, 191.95, 251.06], atol=0.02)
    np.testing.assert_allclose(blocks[2, 2], [191.71, 191.56, 12.82, 178.70], atol=0.02)
    np.testing.assert_allclose(d.white_balance, [1.4455802, 1.0, 1.3421254], rtol=1e-6)  # under TSIS-1 HSRS


@pytest.mark.parametrize("mean", MEANS)
def test_poisson_quantile_of_random_variates_is_poisson(mean: float) -> None:
    n = 300_000
    normal = np.random.default_rng([7, int(10 * mean)]).standard_normal(n, dtype=np.float32)
    counts = poisson_quantile(np.full(n, mean, np.float32), normal)
    assert counts.dtype == np.float32
    np.testing.assert_array_equal(counts, np.rint(counts))
    assert counts.min() >= 0
    # spread of a mean √(m/n); of a variance √((2 + 1/m)/n) of itself. The stated errors (0.001 e, at 1e5
    # 0.005 e; 0.05 %) are far below both
    assert abs(counts.mean(dtype=np.float64) - mean) < 4 * np.sqrt(mean / n)
    assert counts.var(dtype=np.float64) == pytest.approx(mean, rel=4 * np.sqrt((2 + 1 / mean) / n))
    # cells of about 1/30 of the probability, none expected fewer than 5 times
    edges = np.unique(stats.poisson.ppf(np.linspace(0, 1, 31)[1:-1], mean))
    cdf = np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]])
    expected = n * np.diff(cdf)
    observed = np.bincount(np.searchsorted(edges, counts), minlength=len(expected))
    keep = expected > 5
    merged = [np.append(v[keep], v[~keep].sum()) if not keep.all() else v for v in (observed, expected)]
    if merged[1][-1] == 0:
        merged = [v[:-1] for v in merged]
    assert stats.chisquare(*merged).pvalue > 1e-3 / len(MEANS)


def test_poisson_does_not_depend_on_neighbours_or_layout() -> None:
    rng = np.random.default_rng(2)
    mean = (10 ** rng.uniform(-1, 4, (30, 40))).astype(np.float32)
    z = rng.standard_normal((30, 40), dtype=np.float32)
    together = poisson_quantile(mean, z)
    alone = [poisson_quantile(m[None], v[None])[0] for m, v in zip(mean.ravel(), z.ravel(), strict=True)]
    np.testing.assert_array_equal(together.ravel(), alone)
    np.testing.assert_array_equal(poisson_quantile(np.asfortranarray(mean), np.asfortranarray(z)), together)
    np.testing.assert_array_equal(poisson_quantile(mean.T, z.T), together.T)


def test_white_is_where_255_begins() -> None:
    detector = ThreeColourDetector(dark_current_e_s=0)
    for share, value in ((1.0, 255), (0.5, 127.5)):
        white = Electrons(
            array=np.broadcast_to(share * detector.white_e, (4, 4, 3)).astype(np.float32),
            white_e=detector.white_e,
        )
        image = detector.develop(white, SHORT_S, None).array
        # a code is 255/4031/wb of a step wide: half a code and half a step
        assert np.abs(image.astype(float) - value).max() <= 0.5 + 0.5 * 255 / 4031 * float(
            detector.white_balance.max()
        )


@pytest.mark.parametrize(("bits", "bias", "full_well"), [(12, 64, 13_500.0), (8, 0, 1000.0), (16, 500, 100_000.0)])
def test_gain_takes_the_full_well_to_the_top_code(bits: int, bias: int, full_well: float) -> None:
    detector = ThreeColourDetector(adc_bits=bits, bias_dn=bias, full_well_e=full_well)
    assert detector.adc_max_dn == 2**bits - 1
    assert detector.gain_dn_per_e * full_well + bias == pytest.approx(2**bits - 1)
