"""The signal chain and its faults: exact degenerate cases, order, photon transfer, masks by hand."""

from __future__ import annotations

import dataclasses
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from vbnfault.core.errors import InputError
from vbnfault.detector.chain import Device
from vbnfault.detector.readout import (
    ReadoutIndividual,
    ReadoutNoise,
    ReadoutSpec,
    analogue_dn,
    banding_e,
    convert,
    node_of,
    read_out,
    readout_time_s,
    transitions_dn,
    transmission_order,
)
from vbnfault.detector.sensor import Sensor

IDEAL = ReadoutSpec(read_noise_e_rms=0)


def flat(value: float, shape: tuple[int, int] = (40, 50)) -> np.ndarray:
    return np.full(shape, value, np.float32)


def draw(seed: int, shape: tuple[int, int] = (40, 50)) -> ReadoutNoise:
    return ReadoutNoise.draw(shape, np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2]))


# ------------------------------------------------------------------------------------- exact degenerate cases


@pytest.mark.parametrize("bits", [1, 8, 12, 14, 16])
def test_no_light_gives_the_bias_and_saturation_the_top_code(bits: int) -> None:
    bias = 17 if bits > 4 else 0
    spec = ReadoutSpec(bits=bits, bias_dn=bias, inl_quadratic_dn=2 if bits > 4 else 0, inl_cubic_dn=bits > 4)
    np.testing.assert_array_equal(read_out(flat(0), spec), bias)
    for light in (spec.full_well_e, 2 * spec.full_well_e, 1e9):
        raw = read_out(flat(light), spec)
        np.testing.assert_array_equal(raw, 2**bits - 1)
        assert raw.dtype == np.uint16


def test_an_ideal_chain_is_linear() -> None:
    signal = np.linspace(0, 13_500, 2000, dtype=np.float32).reshape(40, 50)
    # half a code, and 4095 · 6e-8 of float32
    assert np.abs(read_out(signal, IDEAL) - (64 + 4031 / 13_500 * signal.astype(np.float64))).max() <= 0.5 + 3e-4


def test_a_given_gain_is_kept() -> None:
    spec = ReadoutSpec(gain_dn_per_e=0.25, bias_dn=100, full_well_e=8000)
    assert read_out(flat(4000), spec)[0, 0] == 1100
    assert read_out(flat(1e6), spec)[0, 0] == 2100  # the well, not the converter, sets the limit


def test_full_well_clips_before_bias_and_read_noise() -> None:
    # a clipped well has the whole read noise: with room above it, mean and spread are those of the noise
    spec = ReadoutSpec(gain_dn_per_e=0.2, full_well_e=10_000, bias_dn=100, read_noise_e_rms=40)
    shape = (300, 300)
    raw = read_out(flat(1e6, shape), spec, draw(2, shape)).astype(np.float64)
    n = raw.size
    assert raw.mean() == pytest.approx(2100, abs=4 * 8 / math.sqrt(n))
    assert raw.var() == pytest.approx(64 + 1 / 12, rel=4 * math.sqrt(2 / n))


def test_read_noise_is_cut_by_the_converter_only() -> None:
    spec = ReadoutSpec(bias_dn=0, gain_dn_per_e=1, read_noise_e_rms=10)
    shape = (300, 300)
    raw = read_out(flat(0, shape), spec, draw(3, shape))
    # codes are 1 wide: what lies below half a code is 0
    assert (raw == 0).mean() == pytest.approx(stats.norm.cdf(0.05), abs=4 * math.sqrt(0.25 / raw.size))
    level = analogue_dn(flat(0, shape), spec, draw(3, shape))
    assert level.min() < -30
    np.testing.assert_array_equal(convert(level, spec), raw)


def test_the_same_noise_for_every_signal() -> None:
    # twins: where their signals agree, so do their pictures
    rng = np.random.default_rng(3)
    a = (rng.random((40, 50)) * 1e4).astype(np.float32)
    b = a.copy()
    b[:7] = 0
    one, two = (read_out(s, ReadoutSpec(row_noise_e_rms=5), draw(4)) for s in (a, b))
    np.testing.assert_array_equal(one[7:], two[7:])
    assert (one[:7] != two[:7]).mean() > 0.9


def test_the_chain_equals_that_by_hand_and_edits_no_argument() -> None:
    shape = (75, 33)
    signal, noise = (np.random.default_rng(4).random(shape) * 2e4).astype(np.float32), draw(5, shape)
    spec = ReadoutSpec(
        nodes=4,
        node_gains=(1, 1.1, 0.9, 1.05),
        node_offsets_dn=(0, 3, -4, 5),
        row_noise_e_rms=4,
        row_pattern_e_rms=5,
        column_pattern_e_rms=6,
        banding_amplitude_e=9,
        banding_frequency_hz=3e4,
        cds=False,
        inl_quadratic_dn=3,
        dnl_lsb_rms=0.2,
        missing_codes=(900,),
        stuck_bits=((5, 0),),
    )
    individual = ReadoutIndividual.draw(shape, spec, np.random.default_rng(6))
    copies = [x.copy() for x in (signal, noise.read, noise.row)]
    raw = read_out(signal, spec, noise, individual)
    for before, after in zip(copies, (signal, noise.read, noise.row), strict=True):
        np.testing.assert_array_equal(before, after)
    # the chain by hand, in float64 and pixel by pixel
    node = node_of(shape, 4)
    line_s, pixel_s = readout_time_s(shape, spec)
    phase = 2 * math.pi * 3e4 * (line_s[:, None] + pixel_s)
    e = np.minimum(signal, 13_500.0) + individual.row_e[:, None] + individual.column_e + 9 * np.sin(phase)
    e += 4 * noise.row[:, None].astype(np.float64) + 13 * noise.read.astype(np.float64)
    dn = e * (4031 / 13_500) * np.array(spec.node_gains)[node] + 64 + np.array(spec.node_offsets_dn)[node]
    u = np.clip((dn - 64) / 4031, 0, 1)
    dn += 12 * u * (1 - u)
    code = np.searchsorted(individual.transitions_dn, np.clip(dn, 0, 4095), side="right")
    code = np.where(code == 900, 899, code) & ~32
    # float32 puts a level within 1e-3 of a transition on its other side: some 2e-3 of the pixels
    assert (raw != code).mean() < 6e-3
    # the same steps in single precision, one after the other, give the same bits as the kernel
    f = np.float32
    e32 = np.minimum(signal, f(13_500)) + individual.column_e
    e32 += (individual.row_e + noise.row * f(4))[:, None]
    e32 += banding_e(shape, spec)
    e32 += noise.read * f(13)
    gains = np.array(spec.node_gains) * spec.system_gain_dn_per_e
    dn32 = e32 * gains.astype(f)[node] + (np.array(spec.node_offsets_dn) + 64).astype(f)[node]
    u32 = np.clip((dn32 - f(64)) * f(1 / 4031), f(0), f(1))
    dn32 += u32 * (1 - u32) * f(12)
    level = analogue_dn(np.minimum(signal, f(13_500)), spec, noise, individual)
    np.testing.assert_array_equal(level, dn32)
    code = np.searchsorted(individual.transitions_dn, np.clip(dn32, 0, 4095), side="right")
    np.testing.assert_array_equal(raw, np.where(code == 900, 899, code) & ~32)
    spec_2 = pickle.loads(pickle.dumps(spec))
    np.testing.assert_array_equal(raw, read_out(signal, spec_2, noise, individual))


# ------------------------------------------------------------------------------------------ photon transfer


def test_photon_transfer_gives_gain_and_read_noise_back() -> None:
    # EMVA 1288: of pairs of flats, σ² = (difference)²/2 = K (μ - μ_dark) + K² σ_read² + 1/12; fixed patterns
    # drop out. One variance of n pixels errs by √(2/n); the slope from six levels of equal relative error, by
    # √(2/n)/√6 or a little more for the dark's share; the read noise by half of √(2/n) and 1/12 of 4.6² below
    # notice. At n = 160,000 that is 0.14 % and 0.18 %: 1 % is more than four σ of either
    shape = (400, 400)
    spec = ReadoutSpec(
        nodes=2, node_offsets_dn=(0, 7), row_pattern_e_rms=20, column_pattern_e_rms=30, read_noise_e_rms=15.3
    )
    individual = ReadoutIndividual.draw(shape, spec, np.random.default_rng(11))
    rng = np.random.default_rng(12)

    def pair(mean_e: float) -> tuple[float, float]:
        a, b = (
            read_out(rng.poisson(mean_e, shape).astype(np.float32), spec, draw(i, shape), individual)
            for i in (int(mean_e) + 1, int(mean_e) + 500_001)
        )
        difference = a.astype(np.float64) - b
        return float((a.mean(dtype=np.float64) + b.mean(dtype=np.float64)) / 2), float(difference.var() / 2)

    dark_mean, dark_variance = pair(0)
    levels = [pair(mean) for mean in (1000, 2500, 4000, 6000, 8000, 10_000)]
    gain = np.mean([(variance - dark_variance) / (mean - dark_mean) for mean, variance in levels])
    read_noise_e = math.sqrt(dark_variance - 1 / 12) / gain
    assert gain == pytest.approx(4031 / 13_500, rel=0.01)
    assert read_noise_e == pytest.approx(15.3, rel=0.01)


@pytest.mark.parametrize(("cds", "expected_e"), [(True, 12.0), (False, 20.0)])
def test_correlated_double_sampling_removes_reset_noise(cds: bool, expected_e: float) -> None:
    spec = ReadoutSpec(read_noise_e_rms=12, reset_noise_e_rms=16, cds=cds, gain_dn_per_e=1, bias_dn=500)
    raw = read_out(flat(0, (300, 300)), spec, draw(7, (300, 300)))
    assert raw.var() - 1 / 12 == pytest.approx(expected_e**2, rel=4 * math.sqrt(2 / raw.size))


# ------------------------------------------------------------------------------------- nodes, patterns, noise


def test_node_maps() -> None:
    np.testing.assert_array_equal(node_of((3, 4), 1), np.zeros((3, 4)))
    np.testing.assert_array_equal(node_of((2, 5), 2), [[0, 0, 0, 1, 1]] * 2)
    np.testing.assert_array_equal(node_of((3, 4), 4), [[0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 3, 3]])
    assert node_of((3, 4), 4).dtype == np.uint8


@pytest.mark.parametrize("nodes", [1, 2, 4])
def test_nodes_have_their_own_gain_and_offset(nodes: int) -> None:
    shape = (70, 31)  # three blocks of rows, one of them in both halves; odd halves
    gains, offsets = (1.0, 1.01, 0.98, 1.03)[:nodes], (0.0, 5.0, -9.0, 12.0)[:nodes]
    spec = dataclasses.replace(IDEAL, nodes=nodes, node_gains=gains, node_offsets_dn=offsets, gain_dn_per_e=0.2)
    raw = read_out(flat(10_000, shape), spec)
    for node in range(nodes):
        own = raw[node_of(shape, nodes) == node]
        np.testing.assert_array_equal(own, round(64 + offsets[node] + 2000 * gains[node]))


def test_readout_runs_from_the_corners() -> None:
    # 2 × 2 quadrants of 2 × 3 pixels: lines 10 apart, pixels 1 apart
    spec = ReadoutSpec(nodes=4, pixel_time_s=1, line_time_s=10)
    line_s, pixel_s = readout_time_s((4, 6), spec)
    np.testing.assert_array_equal(line_s, [0, 10, 10, 0])
    np.testing.assert_array_equal(pixel_s, [0, 1, 2, 2, 1, 0])
    line_s, _ = readout_time_s((4, 6), dataclasses.replace(spec, line_time_s=None, nodes=2))
    np.testing.assert_array_equal(line_s, [0, 3, 6, 9])  # a line takes its three pixels
    order = transmission_order((4, 6), 4)
    np.testing.assert_array_equal(order[:8], [0, 5, 18, 23, 1, 4, 19, 22])
    np.testing.assert_array_equal(np.sort(order), np.arange(24))
    np.testing.assert_array_equal(transmission_order((2, 3), 1), np.arange(6))
    odd = transmission_order((5, 7), 4)
    np.testing.assert_array_equal(np.sort(odd), np.arange(35))


def test_patterns_lie_along_their_lines_and_have_their_spread() -> None:
    shape = (400, 500)
    spec = ReadoutSpec(
        read_noise_e_rms=0, row_pattern_e_rms=40, column_pattern_e_rms=90, gain_dn_per_e=1, bias_dn=900
    )
    individual = ReadoutIndividual.draw(shape, spec, np.random.default_rng(8))
    picture = analogue_dn(flat(0, shape), spec, None, individual) - 900
    rows, columns = picture.mean(axis=1), picture.mean(axis=0)
    np.testing.assert_allclose(picture, rows[:, None] + columns - picture.mean(), atol=1e-2)
    assert rows.std() == pytest.approx(40, rel=4 / math.sqrt(2 * 400))
    assert columns.std() == pytest.approx(90, rel=4 / math.sqrt(2 * 500))
    # as many variates whatever the spreads: the columns stay when the rows' spread goes
    other = ReadoutIndividual.draw(
        shape, dataclasses.replace(spec, row_pattern_e_rms=0, dnl_lsb_rms=0.1), np.random.default_rng(8)
    )
    np.testing.assert_array_equal(other.column_e, individual.column_e)
    assert individual.transitions_dn is None


def test_row_noise_is_one_value_a_row_and_exposure() -> None:
    spec = ReadoutSpec(read_noise_e_rms=0, row_noise_e_rms=30, gain_dn_per_e=1, bias_dn=900)
    one, two = (analogue_dn(flat(0, (500, 20)), spec, draw(s, (500, 20))) for s in (1, 2))
    assert np.ptp(one, axis=1).max() == 0
    assert one[:, 0].std() == pytest.approx(30, rel=4 / math.sqrt(2 * 500))
    assert abs(np.corrcoef(one[:, 0], two[:, 0])[0, 1]) < 4 / math.sqrt(500)


def test_banding_is_a_sine_of_the_readout_time() -> None:
    spec = ReadoutSpec(
        banding_amplitude_e=8, banding_frequency_hz=20_000, banding_phase_rad=0.4, cds=False, pixel_time_s=1e-6
    )
    got = banding_e((64, 48), spec)
    t = 48e-6 * np.arange(64)[:, None] + 1e-6 * np.arange(48)
    np.testing.assert_allclose(got, 8 * np.sin(2 * np.pi * 20_000 * t + 0.4), atol=1e-5)
    # one node: the stream of pixels shows one line, at the frequency
    power = np.abs(np.fft.rfft(got.ravel())) ** 2
    assert np.fft.rfftfreq(got.size, 1e-6)[power.argmax()] == pytest.approx(20_000, abs=0.5e6 / got.size * 2)
    # lines converted at once: horizontal bands
    rows = banding_e((64, 48), dataclasses.replace(spec, pixel_time_s=0, line_time_s=48e-6))
    assert np.ptp(rows, axis=1).max() == 0
    # it rides on the signal, before the gain
    level = analogue_dn(flat(100, (64, 48)), dataclasses.replace(spec, gain_dn_per_e=2, read_noise_e_rms=0))
    np.testing.assert_allclose(level, 264 + 2 * got, atol=1e-3)


def test_double_sampling_passes_interference_by_twice_its_sine() -> None:
    # of the difference sin(ωt) - sin(ω(t-τ)) the amplitude is 2|sin(ωτ/2)|: none at 1/τ, twice at 1/2τ
    spec = ReadoutSpec(banding_amplitude_e=5, cds_interval_s=1e-6)
    for hertz, seen in ((0.0, 0.0), (5e5, 10.0), (1e6, 0.0), (1e5, 10 * math.sin(0.1 * math.pi))):
        assert dataclasses.replace(spec, banding_frequency_hz=hertz).banding_seen_e == pytest.approx(
            seen, abs=1e-12
        )


# -------------------------------------------------------------------------------------------------- converter


def ramp(spec: ReadoutSpec, per_code: int = 8) -> np.ndarray:
    """Levels from 0 to the top code, in equal steps, one row."""
    return np.linspace(0, spec.top_dn, spec.top_dn * per_code + 1, dtype=np.float32)[None]


def test_integral_non_linearity_has_its_stated_heights() -> None:
    straight = ReadoutSpec(bits=14, bias_dn=200, read_noise_e_rms=0)
    signal = np.linspace(0, 13_500, 40_001, dtype=np.float32)[None]
    ideal = analogue_dn(signal, straight)
    u = (ideal - 200) / (straight.top_dn - 200)
    for quadratic, cubic in ((12.0, 0.0), (-12.0, 0.0), (0.0, 7.0)):
        bent = analogue_dn(signal, dataclasses.replace(straight, inl_quadratic_dn=quadratic, inl_cubic_dn=cubic))
        off = (bent - ideal)[0]
        assert abs(off).max() == pytest.approx(abs(quadratic or cubic), abs=4e-3)  # float32 at 16384
        assert off[0] == 0
        assert off[-1] == pytest.approx(0, abs=4e-3)
        at = float(u[0, abs(off).argmax()])
        extremes = [0.5] if quadratic else [(3 - math.sqrt(3)) / 6, (3 + math.sqrt(3)) / 6]
        assert min(abs(at - x) for x in extremes) < 0.02
        assert off[10_000] * (quadratic or cubic) > 0
        assert np.all(np.diff(bent[0]) > 0)


def test_stuck_bits_by_hand() -> None:
    levels = np.array([[0, 5, 8, 13, 15, 3]], np.float32)
    spec = ReadoutSpec(bits=4, bias_dn=0, stuck_bits=((0, 1), (3, 0)))
    # 0000 0101 1000 1101 1111 0011 → bit 0 set, bit 3 cleared
    np.testing.assert_array_equal(convert(levels, spec), [[1, 5, 1, 5, 7, 3]])


def test_missing_codes_never_come_and_the_code_below_takes_their_range() -> None:
    spec = ReadoutSpec(bits=6, bias_dn=0, missing_codes=(0, 7, 8, 63))
    codes = convert(ramp(spec), spec)
    assert set(range(64)) - set(codes.ravel().tolist()) == {0, 7, 8, 63}
    np.testing.assert_array_equal(convert(np.float32([[0, 6.6, 8.4, 8.6, 63]]), spec), [[1, 6, 6, 9, 62]])


def test_transitions_make_the_stated_code_widths() -> None:
    # code 3 twice as wide, code 5 missing: widths keep their sum, so nothing is scaled
    dnl = np.zeros(16)
    dnl[3], dnl[5] = 1.0, -1.0
    transitions = transitions_dn(dnl)
    np.testing.assert_allclose(transitions, [0.5, 1.5, 2.5, 4.5, 5.5, 5.5, *np.arange(6.5, 15)])
    spec = ReadoutSpec(bits=4, bias_dn=0)
    codes, count = np.unique(convert(ramp(spec, 1000), spec, transitions), return_counts=True)
    assert 5 not in codes
    widths = dict(zip(codes.tolist(), (count / 1000).tolist(), strict=True))
    assert widths[3] == pytest.approx(2, abs=2e-3)
    assert widths[4] == pytest.approx(1, abs=2e-3)
    np.testing.assert_allclose(transitions_dn(np.zeros(256)), np.arange(255) + 0.5)


@pytest.mark.parametrize("rms", [0.05, 0.4, 1.5])
def test_conversion_by_transitions_is_the_plain_search(rms: float) -> None:
    spec = ReadoutSpec(bits=10, bias_dn=0, dnl_lsb_rms=rms)
    transitions = ReadoutIndividual.draw((4, 4), spec, np.random.default_rng(9)).transitions_dn
    assert transitions is not None
    assert np.all(np.diff(transitions) >= 0)
    assert transitions[0] == 0.5
    assert transitions[-1] == pytest.approx(1022.5, abs=1e-3)
    levels = (np.random.default_rng(10).random((90, 300)) * 1100 - 40).astype(np.float32)
    levels[0] = transitions[:300]
    expected = np.searchsorted(transitions, np.clip(levels, 0, 1023), side="right")
    np.testing.assert_array_equal(convert(levels, spec, transitions), expected)


# ----------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"bits": 0}, "bits = 0: must be a whole number from 1 to 16"),
        ({"bias_dn": 4096}, "bias_dn = 4096: must be from 0 to 4095"),
        ({"bias_dn": 4095}, "bias_dn = 4095: must be below the top code"),
        ({"full_well_e": 0}, "full_well_e = 0: must be a finite number above 0"),
        ({"gain_dn_per_e": -1}, "gain_dn_per_e = -1: "),
        ({"read_noise_e_rms": -1}, "read_noise_e_rms = -1: must be a finite number of at least 0"),
        ({"row_noise_e_rms": math.nan}, "row_noise_e_rms = nan: "),
        ({"nodes": 3}, "nodes = 3: must be 1, 2 or 4"),
        ({"nodes": 2, "node_gains": (1.0,)}, r"node_gains = \[1.0\]: must hold a value for each of 2 nodes"),
        ({"node_gains": (0.0,)}, r"node_gains\[0\] = 0.0: "),
        ({"line_time_s": -1.0}, "line_time_s = -1.0: "),
        ({"inl_quadratic_dn": 2000}, "must be below the 4031 DN"),
        ({"missing_codes": (4096,)}, "missing_codes = 4096: must be from 0 to 4095"),
        ({"bits": 1, "bias_dn": 0, "missing_codes": (0, 1)}, "missing_codes: must leave one of the 2 codes"),
        ({"stuck_bits": ((12, 1),)}, "bit = 12: must be from 0 to 11"),
    ],
)
def test_a_bad_spec_is_told_in_a_sentence(values: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        ReadoutSpec(**values)


def test_a_bad_number_of_nodes_is_told_in_a_sentence() -> None:
    with pytest.raises(InputError, match="nodes is 3"):
        node_of((4, 4), 3)


@pytest.mark.parametrize("pattern", ["mono", "rggb"])
def test_a_stretched_image_shows_powers_of_the_fraction_of_white_and_the_bias_as_black(pattern: str) -> None:
    """255 (DN / range)^0.5 of a linear ramp, and levels of the dark signal above 0 where the bias is black."""
    sensor = Sensor(width_px=32, height_px=32, pattern=pattern, temperature_K=300.0)
    raw = np.tile(np.linspace(sensor.readout.bias_dn, sensor.readout.top_dn, 32).astype(np.uint16), (32, 1))
    linear, root = (
        Device(replace(sensor, stretch=stretch, black="bias"), 1).rgbi(raw, 1.0).array for stretch in (1.0, 0.5)
    )
    # both are rounded to half a level; the root of a level l moves by 8 / sqrt(l) for each
    exact = 255 * np.sqrt(linear / 255.0)
    bright = linear > 16
    assert np.abs(root - exact)[bright].max() <= 0.5 + 8 * 0.5 / np.sqrt(16) + 0.5
    assert (root[linear == 255] == 255).all()
    warm = replace(sensor, individual=replace(sensor.individual, dark_current_e_s=300.0))
    dark = Device(warm, 1).raw(np.zeros((32, 32), np.float32), 3.0, None)
    above, at_zero = (
        Device(replace(warm, black=black), 1).rgbi(dark, 3.0).array[..., 3] for black in ("bias", "dark")
    )
    assert np.median(at_zero) <= 1 < np.median(above)


def test_columns_that_stand_out_keep_the_standard_deviation() -> None:
    """Student's t with 5 degrees of freedom has a kurtosis of 6; its quantile at 0.75, 0.7267, is in tables."""
    spec = replace(IDEAL, column_pattern_e_rms=4.0, column_pattern_freedom=5.0, bits=8)
    column = ReadoutIndividual.draw((2, 100_000), spec, np.random.default_rng(2)).column_e
    assert column is not None
    # of kurtosis 6, the variance of 1e5 variates errs by √(8/1e5) = 0.9 %
    assert column.std() == pytest.approx(4.0, rel=4 * 0.0045)
    # half of them lie within 0.7267 of t, whose standard deviation is √(5/3); the median errs by 0.4 %
    assert np.median(np.abs(column)) == pytest.approx(4.0 * 0.7267 / np.sqrt(5 / 3), rel=0.02)
