"""Charge on its way: closed forms, a clock-by-clock register, published software, conservation, axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from vbnfault.core.quantities import READOUT_DIRECTIONS
from vbnfault.detector import charge, load_sensor
from vbnfault.detector.chain import Device
from vbnfault.detector.charge import (
    ChargeCloud,
    TrapSpecies,
    bloom,
    capture,
    cti,
    parasitic_light,
    smear,
    smear_interline,
)

# more rows than a block, and no multiple of one
SHAPE = (2 * charge.ROWS_PER_BLOCK + 7, 11)

# moves an image so that charge that moved up moves in the named direction
TURN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "up": lambda image: image,
    "down": lambda image: image[::-1],
    "left": lambda image: image.T,
    "right": lambda image: image.T[:, ::-1],
}


def scene(seed: int = 0, shape: tuple[int, int] = SHAPE, mean_e: float = 2000.0) -> np.ndarray:
    """A contrasty image: bright points on a dim, noisy background."""
    return np.random.default_rng(seed).gamma(0.3, mean_e / 0.3, shape).astype(np.float32)


# every effect, for the tests that all of them share
TRAPS = [TrapSpecies(density_per_px=0.3, release_time_s=6.0), TrapSpecies(density_per_px=0.1, release_time_s=0.5)]
CLOUD = ChargeCloud(full_well_e=84_700.0, notch_e=96.5, fill_power=0.576)
EFFECTS: dict[str, Callable[..., np.ndarray]] = {
    "smear": lambda image, d: smear(image, exposure_s=0.5, row_transfer_s=1e-3, row_clear_s=2e-3, direction=d),
    "interline": lambda image, d: smear_interline(
        image, exposure_s=0.5, row_transfer_s=1e-3, leak=0.01, direction=d
    ),
    "bloom": lambda image, d: bloom(image, full_well_e=5000.0, antiblooming=0.2, direction=d),
    "cti": lambda image, d: cti(image, TRAPS, cloud=CLOUD, transfer_s=1.0, direction=d),
}


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
@pytest.mark.parametrize("effect", EFFECTS)
def test_effects_turn_with_their_direction(effect: str, direction: str) -> None:
    image = scene()
    expected = TURN[direction](EFFECTS[effect](image, "up"))
    turned = np.ascontiguousarray(TURN[direction](image))
    kept = turned.copy()
    got = EFFECTS[effect](turned, direction)
    assert got.dtype == np.float32
    # every value has the same neighbours in the same order; a column sum alone may round otherwise
    np.testing.assert_allclose(got, expected, rtol=1e-6 if effect == "interline" else 0, atol=0)
    np.testing.assert_array_equal(turned, kept)
    assert not np.shares_memory(got, turned)


@pytest.mark.parametrize("effect", EFFECTS)
def test_lines_do_not_know_each_other(effect: str) -> None:
    image = scene()
    other = image.copy()
    other[:, 4] = 30_000
    got, twin = EFFECTS[effect](image, "up"), EFFECTS[effect](other, "up")
    np.testing.assert_array_equal(np.delete(got, 4, axis=1), np.delete(twin, 4, axis=1))
    assert (got[:, 4] != twin[:, 4]).mean() > 0.5


@pytest.mark.parametrize("direction", ["up", "left", "right"])
@pytest.mark.parametrize("effect", EFFECTS)
def test_read_only_planes_of_a_mosaic_are_taken(effect: str, direction: str) -> None:
    mosaic = scene(1, (2 * SHAPE[0], 2 * SHAPE[1]))
    mosaic.flags.writeable = False
    for plane in (mosaic[::2, 1::2], mosaic.T[:, ::3], mosaic[:1, :1], mosaic[:1], mosaic[:, :1]):
        expected = EFFECTS[effect](plane.copy("C"), direction)
        np.testing.assert_array_equal(EFFECTS[effect](plane, direction), expected)


def test_charge_moves_where_the_direction_says() -> None:
    image = np.zeros((9, 9), np.float32)
    image[4, 4] = 1000.0
    for direction, trail in {"up": (5, 4), "down": (3, 4), "left": (4, 5), "right": (4, 3)}.items():
        for got in (
            smear(image, exposure_s=1.0, row_transfer_s=0.01, direction=direction),
            cti(image, TRAPS, cloud=CLOUD, transfer_s=1.0, direction=direction),
        ):
            assert got[trail] > 0.01  # behind, away from the register
            assert got[8 - trail[0], 8 - trail[1]] == 0


# ------------------------------------------------------------------------------------------------------ smear


def test_smear_of_a_bright_row_by_hand() -> None:
    rate = np.zeros((5, 1), np.float32)
    rate[2] = 1000.0
    got = smear(rate, exposure_s=2.0, row_transfer_s=0.01, row_clear_s=0.003)
    np.testing.assert_array_equal(got[:, 0], np.float32([3, 3, 2000, 10, 10]))


def test_smear_follows_its_equation() -> None:
    rate = scene()
    row = np.arange(len(rate))
    late, early = (row[:, None] > row).astype(float), (row[:, None] < row).astype(float)
    truth = 0.5 * rate + (3e-3 * late + 1e-3 * early) @ rate.astype(np.float64)
    got = smear(rate, exposure_s=0.5, row_transfer_s=6e-3, row_clear_s=2e-3, shutter_transmission=0.5)
    # a running sum of n float32 is off by at most n half units in the last place
    np.testing.assert_allclose(got, truth, rtol=len(rate) * 2.0**-24)


def test_smear_of_equal_times_leaves_each_pixel_its_column() -> None:
    rate = scene()
    got = smear(rate, exposure_s=0.0, row_transfer_s=1e-3, row_clear_s=1e-3)
    expected = 1e-3 * (rate.sum(axis=0, dtype=np.float64) - rate)
    np.testing.assert_allclose(got, expected, rtol=len(rate) * 2.0**-23)


def test_no_smear_behind_a_closed_shutter() -> None:
    rate = scene()
    for kwargs in ({"row_transfer_s": 0.0}, {"row_transfer_s": 1e-3, "shutter_transmission": 0.0}):
        np.testing.assert_array_equal(smear(rate, exposure_s=0.5, **kwargs), rate * np.float32(0.5))


def test_interline_smear_is_a_share_of_the_column() -> None:
    rate = scene()
    got = smear_interline(rate, exposure_s=0.5, row_transfer_s=1e-3, leak=0.02)
    truth = 0.5 * rate + 2e-5 * rate.sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(got, truth, rtol=3 * 2.0**-24)  # three roundings
    np.testing.assert_array_equal(
        smear_interline(rate, exposure_s=0.5, row_transfer_s=1e-3, leak=0.0), rate * np.float32(0.5)
    )


# --------------------------------------------------------------------------------------------------- blooming


def bloomed(column: np.ndarray, full_well_e: float, kept: float) -> np.ndarray:
    """One column, charge by charge: each excess runs on from its own pixel, row after row."""

    def run(level: np.ndarray, excess: np.ndarray, step: int) -> np.ndarray:
        level = level.copy()
        # the nearest source to the end first, so that a current finds what those before it left
        for i in sorted(np.flatnonzero(excess), reverse=step > 0):
            current, at = excess[i], i
            while current > 0 and 0 <= (at := at + step) < len(level):
                taken = min(current, full_well_e - level[at])
                level[at] += taken
                current -= taken
        return level

    excess = np.maximum(column - full_well_e, 0) * kept / 2
    level = np.minimum(column, full_well_e)
    return (run(run(level, excess, 1), excess, -1) + run(run(level, excess, -1), excess, 1)) / 2


def test_blooming_by_hand() -> None:
    column = np.float32([0, 90, 100, 500, 0, 0, 250, 100, 60])[:, None]
    got = bloom(column, full_well_e=100.0)[:, 0]
    # 400 e above: 200 up fill 10 and 100, 90 are lost; 200 down fill the two empty wells or, when the 75 e that
    # come up are there first, leave 75 of them for the pixel below; of 75 e down, 40 find room, 35 are lost
    np.testing.assert_array_equal(got, np.float32([100, 100, 100, 100, 100, 100, 100, 100, 100]))
    kept = bloom(np.float32([0, 0, 0, 340, 0, 0, 0, 0])[:, None], full_well_e=100.0)[:, 0]
    np.testing.assert_array_equal(kept, np.float32([0, 20, 100, 100, 100, 20, 0, 0]))


@pytest.mark.parametrize("antiblooming", [0.0, 0.4, 1.0])
def test_blooming_against_a_column_done_charge_by_charge(antiblooming: float) -> None:
    image = scene(3, (60, 40))
    got = bloom(image, full_well_e=6000.0, antiblooming=antiblooming)
    truth = [bloomed(c, 6000.0, 1 - antiblooming) for c in image.T.astype(np.float64)]
    assert 0.05 < (image > 6000).mean() < 0.2
    # rounded to float32 once; tiny signals are counted from the full well, in float64
    np.testing.assert_allclose(got, np.transpose(truth), rtol=2.0**-24, atol=1e-10)
    assert got.max() <= 6000
    if antiblooming == 1:
        np.testing.assert_allclose(got, np.minimum(image, 6000), rtol=0, atol=1e-10)


def test_blooming_keeps_all_charge_that_finds_room() -> None:
    image = scene(4, (200, 50), 500.0)
    image[:50] = image[150:] = 0  # room enough at the ends
    image[100, ::2] = 2e5
    got = bloom(image, full_well_e=9000.0)
    # each of 200 values is rounded by 2⁻²⁵ of itself at most (half a unit in the last place of 9000 is 5e-4)
    np.testing.assert_allclose(
        got.sum(axis=0, dtype=np.float64), image.sum(axis=0, dtype=np.float64), rtol=2.0**-24
    )
    assert (got == 9000).sum(axis=0)[::2].min() > 18  # 190 ke fill more than 18 wells of 9 ke beside


def test_blooming_has_no_preferred_side_and_leaves_other_columns_alone() -> None:
    image = scene(5)
    np.testing.assert_array_equal(
        bloom(image, full_well_e=5000.0)[::-1], bloom(image[::-1].copy(), full_well_e=5000.0)
    )
    image[:, 3] = np.minimum(image[:, 3], 4999)
    got = bloom(image, full_well_e=5000.0)
    np.testing.assert_array_equal(got[:, 3], image[:, 3])
    np.testing.assert_array_equal(bloom(image, full_well_e=1e9), image)


# -------------------------------------------------------------------------------------------------------- CTI


def clocked_traps(
    column: np.ndarray, species: list[TrapSpecies], cloud: ChargeCloud, transfer_s: float, before: int = 0
) -> np.ndarray:
    """Every transfer of every packet through every pixel's traps, with clouds that shrink on the way.

    The traps of a pixel are followed in 4000 layers of the well, so that each remembers the last cloud that
    reached it.
    """
    n = column.astype(np.float64)
    stay = [np.exp(-transfer_s / s.release_time_s) for s in species]
    layer = (np.arange(4000) + 0.5) / 4000
    filled = np.zeros((len(species), before + len(n), 4000))
    for i in range(len(n)):
        for pixel in range(before + i, -1, -1):
            f = filled[:, pixel]
            for k, s in enumerate(species):
                n[i] += s.density_per_px * f[k].mean() * (1 - stay[k])
                f[k] *= stay[k]
            volume = np.clip((n[i] - cloud.notch_e) / (cloud.full_well_e - cloud.notch_e), 0, 1) ** cloud.fill_power
            within = layer < volume
            # the layer in which the cloud ends counts by its part, for a smooth dependence
            share = np.clip(volume * 4000 - np.arange(4000), 0, 1)
            for k, s in enumerate(species):
                n[i] -= s.density_per_px * (share * (1 - f[k])).mean()
                f[k] = np.where(within, 1, f[k] + share * (1 - f[k]))
    return n


# arcticpy-no-gsl 2.6 (the ArCTIC of Massey et al. 2014), every transfer (parallel_express=0), traps empty at the
# first transfer, instant capture; species 0.3 per pixel of τ = 10.4 and 0.1 of τ = 0.88 transfers, full well
# 84 700 e, notch 96.5 e, power 0.576, 100 pixels before the image. Output minus input.
ARCTIC_INPUT = np.array(
    [
        [200, 12000, 150, 40, 900, 3000, 10, 10, 700, 0],
        [0, 0, 0, 500, 0, 0, 0, 2500, 0, 0],
        [0, 0, 9000, 20, 0, 0, 0, 0, 300, 0],
        [30, 700, 60, 5000, 5000, 4000, 90, 10, 0, 1],
    ]
).T.astype(np.float32)
ARCTIC_CHANGE = np.array(
    [
        [-0.8468, -12.3341, 2.996, 1.6152, -0.2289, -1.0424, 1.8061, 1.0268, -0.3906, 1.0675],
        [0, 0, 0, -1.9112, 0.4558, 0.2235, 0.1418, -4.4619, 1.3242, 0.6492],
        [0, 0, -11.2593, 2.6855, 1.3167, 0.8356, 0.6434, 0.5473, -0.328, 0.7097],
        [0, -2.3641, 0.5639, -6.2626, -0.0805, 0.1711, 1.8366, 0.9174, 0.5923, 0.4607],
    ]
).T


def behind(rows: int, image: np.ndarray) -> np.ndarray:
    """An image whose charge passes the traps of some more rows, which are dark."""
    return np.concatenate([np.zeros((rows, image.shape[1]), np.float32), image])


def test_cti_against_arctic() -> None:
    species = [TrapSpecies(density_per_px=r, release_time_s=t) for r, t in ((0.3, 10.4), (0.1, 0.88))]
    got = cti(behind(100, ARCTIC_INPUT), species, cloud=CLOUD, transfer_s=1.0)[100:]
    # a packet of 12 000 e loses 0.1 %, so its cloud, and its loss of 12 e, half of 0.6 · 0.1 % too little: 4e-3 e;
    # float32 rounds 12 000 e to 5e-4; the digits above end at 5e-5
    np.testing.assert_allclose(got - ARCTIC_INPUT, ARCTIC_CHANGE, rtol=0, atol=0.006)


def test_cti_against_a_register_clocked_trap_by_trap() -> None:
    image = scene(1, (charge.ROWS_PER_BLOCK + 9, 3))
    got = cti(behind(3, image), TRAPS, cloud=CLOUD, transfer_s=1.0)[3:]
    truth = np.transpose([clocked_traps(c, TRAPS, CLOUD, 1.0, before=3) for c in image.T])
    effect = np.abs(truth - image).max()
    assert effect > 3
    # as against ArCTIC, and a layer holds 1e-4 e of a pixel's traps
    np.testing.assert_allclose(got, truth, rtol=0, atol=2e-3 * effect)


# both heights in one process, the low one first: each needs room of its own for the clouds that it remembers
@pytest.mark.parametrize("rows", [20, 200])
def test_cti_of_slow_traps_is_the_sum_over_all_clouds(rows: int) -> None:
    # traps hold Σ_m V(m, i) Σ_s ρ wⁱ⁻ᵐ [1 + (1 - w) m] after packet i, with V the largest cloud of packets m … i
    falling = np.linspace(9000, 10, rows * 4, dtype=np.float32).reshape(rows, 4)  # so that no cloud hides another
    image = np.concatenate([scene(6, (rows, 4)), falling])
    species = [TrapSpecies(density_per_px=r, release_time_s=t) for r, t in ((0.8, 0.7), (2.0, 40.0), (1.0, 1e5))]
    got = cti(image, species, cloud=CLOUD, transfer_s=1.0)
    met = 3.8 * (np.arange(len(image)) + 1)[:, None]
    volume = np.minimum(CLOUD.volume(image), image / met).astype(np.float64)
    held = np.zeros(image.shape)
    for i in range(len(image)):
        m = np.arange(i, -1, -1)
        largest = np.maximum.accumulate(volume[m], axis=0)
        for s in species:
            w = np.exp(-1 / s.release_time_s)
            held[i] += (s.density_per_px * w ** (i - m) * (1 + (1 - w) * m)) @ largest
    expected = np.maximum(image - np.diff(held, axis=0, prepend=0), 0)
    assert np.abs(expected - image).max() > rows / 2
    # clouds are float32: 3e-8 of what 400 rows' traps hold at most (1500 e), and packets round to 5e-4 of 10 000 e
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-3)


def test_cti_of_one_bright_row_by_hand() -> None:
    image = np.zeros((60, 1), np.float32)
    image[9] = 20_000.0
    cloud = ChargeCloud(full_well_e=80_000.0, fill_power=0.5)
    species = [TrapSpecies(density_per_px=2.0, release_time_s=4.0)]
    got = cti(image, species, cloud=cloud, transfer_s=2.0)
    # ten transfers (its own pixel's included), half the well: 10 × 2 × ½ electrons are left behind
    stay = np.exp(-0.5)
    expected = np.zeros(60)
    expected[9] = 20_000 - 10
    expected[10:] = 10 * (1 - stay) * stay ** np.arange(50)
    np.testing.assert_allclose(got[:, 0], expected, rtol=0, atol=1e-3)  # 20 000 in float32: 1e-3


def test_cti_of_a_linear_cloud_is_the_constant_one_to_first_order() -> None:
    # traps that let go at once hand ε = ρ/w of a packet to the next
    image = scene(2)
    cloud = ChargeCloud(full_well_e=1e6, fill_power=1.0)
    species = [TrapSpecies(density_per_px=100.0, release_time_s=1e-3)]
    got = cti(image, species, cloud=cloud, transfer_s=1.0)
    classic = np.transpose([clocked_constant(c, 1e-4, 0) for c in image.T])
    assert np.abs(classic - image).max() > 20
    # what the first order leaves out: (P ε)² of a packet and of those before it
    reach = (SHAPE[0] * 1e-4) ** 2 * image.max()
    np.testing.assert_allclose(got, classic, rtol=0, atol=reach)


def test_cti_keeps_sums_and_never_goes_below_zero() -> None:
    image = scene(6, (300, 20), 40.0)
    image[250:] = 0
    heavy = [TrapSpecies(density_per_px=5.0, release_time_s=3.0)]
    got = cti(image, heavy, cloud=ChargeCloud(full_well_e=50_000.0), transfer_s=1.0)
    assert got.min() >= 0
    assert (np.abs(got - image) > 0.5 * image)[100:].mean() > 0.2  # faint packets lose most of what they have
    # traps end empty: a trail ends after at most 14 rows. Rounding of up to 300 × 5 trapped electrons: 1e-4 a pixel
    np.testing.assert_allclose(got.sum(axis=0, dtype=np.float64), image.sum(axis=0, dtype=np.float64), atol=0.03)


def test_cti_of_nothing_changes_nothing() -> None:
    image = scene()
    np.testing.assert_array_equal(cti(image, [], cloud=CLOUD, transfer_s=1.0), image)
    none = [TrapSpecies(density_per_px=0.0, release_time_s=1.0)]
    np.testing.assert_array_equal(cti(image, none, cloud=CLOUD, transfer_s=1.0), image)
    below = np.full(SHAPE, 96.0, np.float32)  # within the notch
    np.testing.assert_array_equal(cti(below, TRAPS, cloud=CLOUD, transfer_s=1.0), below)


def test_cloud_volume_is_its_formula() -> None:
    signal = np.float32([[0, 96.5, 100, 1000, 84_700, 1e5]])
    for power in (0.3, 0.5, 0.576, 1.0):
        cloud = ChargeCloud(full_well_e=84_700.0, notch_e=96.5, fill_power=power)
        expected = np.clip((signal.astype(np.float64) - 96.5) / (84_700 - 96.5), 0, 1) ** power
        np.testing.assert_allclose(cloud.volume(signal), expected, rtol=1e-5)
        columns = np.repeat(signal, 3, axis=0).T  # any layout
        np.testing.assert_array_equal(cloud.volume(columns), np.repeat(cloud.volume(signal), 3, axis=0).T)


def clocked_constant(column: np.ndarray, inefficiency: float, before: int) -> np.ndarray:
    """A register clock by clock: of each pixel the share 1 − ε moves on, the rest stays for the next packet."""
    register = np.concatenate([np.zeros(before), column.astype(np.float64)])
    out = []
    for _ in range(len(register)):
        moved = register * (1 - inefficiency)
        out.append(moved[0])
        register -= moved
        register[:-1] += moved[1:]
    return np.array(out[before:])


# ------------------------------------------------------------------------------------------------- single traps


def test_a_trap_takes_the_first_electrons_that_come_by() -> None:
    image = np.full((6, 3), 30.0, np.float32)
    got = capture(image, np.array([2]), np.array([1]), np.array([70.0]))
    # packets of rows 2, 3, 4 pass it in turn; the first two lose all, the third ten
    np.testing.assert_allclose(got[:, 1], [30, 30, 0, 0, 20, 30])
    np.testing.assert_array_equal(got[:, [0, 2]], image[:, [0, 2]])
    down = capture(image, np.array([2]), np.array([1]), np.array([70.0]), direction="down")
    np.testing.assert_allclose(down[:, 1], [20, 0, 0, 30, 30, 30])


def test_traps_of_a_column_are_met_one_after_the_other() -> None:
    """Against a register clocked packet by packet."""
    generator = np.random.default_rng(4)
    image = generator.gamma(1.0, 40.0, (40, 5)).astype(np.float32)
    row, column = generator.integers(40, size=12), generator.integers(5, size=12)
    depth = generator.exponential(150.0, 12)
    left, truth = depth.copy(), image.astype(np.float64)
    for y in range(40):
        for trap in sorted(range(12), key=lambda k: -row[k]):
            if row[trap] <= y:
                x = column[trap]
                taken = min(truth[y, x], left[trap])
                truth[y, x] -= taken
                left[trap] -= taken
    np.testing.assert_allclose(capture(image, row, column, depth), truth, atol=1e-4)


# ---------------------------------------------------------------------------------------- shutters, waiting


def test_waiting_charge_gathers_light() -> None:
    signal = scene(8)
    rate = signal.astype(np.float64) / 4e-3
    got = parasitic_light(signal, 4e-3, sensitivity=1 / 50_000, row_period_s=1e-2)
    wait = 1e-2 * np.arange(len(signal))[:, None]
    # two roundings to single precision: of the factor and of the product
    np.testing.assert_allclose(got, signal + rate * wait / 50_000, rtol=3 * 2.0**-24)
    np.testing.assert_array_equal(got[0], signal[0])  # read at once
    upside_down = parasitic_light(signal, 4e-3, sensitivity=1.0, row_period_s=1.0, direction="down")
    np.testing.assert_array_equal(upside_down[-1], signal[-1])
    assert (upside_down[0] > signal[0]).all()


def test_four_nodes_read_a_global_shutter_from_both_ends() -> None:
    """The last row that a node reads waits for half of the rows, as its other effects have it."""
    sensor = load_sensor("generic_cmos")
    sensor = replace(
        sensor,
        individual=replace(sensor.individual, prnu=0.0, dead_fraction=0.0),
        readout=replace(sensor.readout, nodes=4),
        transfer=replace(sensor.transfer, leak=1e-3, row_readout_s=1e-3),
    )
    light = Device(sensor, 1, shape=(8, 8)).light_e(np.full((8, 8), 1000, np.float32), 0.01)
    waits_s = 1e-3 * np.array([0, 1, 2, 3, 3, 2, 1, 0])
    np.testing.assert_allclose(light[:, 0], 1000 * (1 + 1e-3 * waits_s / 0.01), rtol=1e-6)
