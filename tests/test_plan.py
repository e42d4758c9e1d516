"""The plan: bounds and proportions of the sampling, an exact fault matrix, stability under appending."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from conftest import ALL_FAULTS, calls_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from vbnfault.core import frames
from vbnfault.core.errors import InputError
from vbnfault.scene import config, fault_matrix, keyed_random, plan, redraw
from vbnfault.scene.config import Scene, parse_scene

N = 2000
STRAYLIGHT = "straylight"  # the class whose samples face the Sun
FAR = plan.SUN_AVERTED
NEAR = plan.SUN_FACING

# Every statistic below is of fixed seeds, so nothing here is flaky; a wrong plan would have to hide behind
# this level: 1e-3 over about 30 comparisons.
LEVEL = 1e-3 / 30


def scene(**tables: dict[str, Any]) -> Scene:
    dataset = {"samples": N, "seed": 20} | tables.pop("dataset", {})
    return parse_scene({"title": "t", "dataset": dataset, **tables}, source="here")


def planned(s: Scene, faults: Sequence[str], blocks: Sequence[int] | None = None) -> plan.Plan:
    """The plan of a scene, in which straylight needs the Sun."""
    return plan.make_plan(s, faults, blocks, need_sun=(STRAYLIGHT,))


def make(**tables: dict[str, Any]) -> plan.Plan:
    return planned(scene(**tables), ALL_FAULTS)


@pytest.fixture(scope="module")
def paper() -> plan.Plan:
    return make()


def sun_angle_deg(p: plan.Plan) -> np.ndarray:
    roll, pitch = np.radians(p.variables["roll_deg"]), np.radians(p.variables["pitch_deg"])
    return np.degrees(np.arccos(np.clip(np.cos(roll) * np.cos(pitch), -1, 1)))


# -------------------------------------------------------------------------------------------------- proposals

PAPER_BOUNDS = {  # table of the boundaries of dataset variables; degrees, metres
    "sun_azimuth_deg": ((0, 360), (0, 360)),
    "sun_elevation_deg": ((-30, 30), (-30, 90)),
    "roll_deg": ((-32.5, 32.5), (32.5, 327.5)),
    "pitch_deg": ((-32.5, 32.5), (32.5, 327.5)),
    "yaw_deg": ((0, 360), (0, 360)),
    "x_m": ((-150, 150), (-150, 150)),
    "y_m": ((-150, 150), (-150, 150)),
    "height_m": ((0, 100), (0, 100)),
}


@pytest.mark.parametrize("stratum", [NEAR, FAR])
@pytest.mark.parametrize("name", PAPER_BOUNDS)
def test_variables_are_uniform_within_the_papers_bounds(paper: plan.Plan, name: str, stratum: int) -> None:
    lo, hi = PAPER_BOUNDS[name][stratum]
    values = paper.variables[name][paper.stratum == stratum]
    assert len(values) > 400
    assert values.min() >= lo
    assert values.max() <= hi
    # n uniform numbers come within 10/n of the range to both its ends, but for a chance of 2·e^-10
    assert values.min() < lo + 10 / len(values) * (hi - lo)
    assert values.max() > hi - 10 / len(values) * (hi - lo)
    if stratum == FAR and name in ("roll_deg", "pitch_deg"):
        return  # conditional on the Sun: the next test
    assert stats.kstest(values, stats.uniform(lo, hi - lo).cdf).pvalue > LEVEL


def conditional_cdf(lo: float, hi: float, least_deg: float) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """CDF of the roll, and the share kept, of a uniform (roll, pitch) in [lo, hi]² given a Sun angle ≥ least.

    For a given roll the pitches to leave out are arcs about 0 or 180°, of half width
    acos(cos least / |cos roll|).
    """
    roll = np.linspace(lo, hi, 200_001)
    c = np.cos(np.radians(roll))
    # the angle is below least where cos roll cos pitch > cos least: about 0 if cos roll > 0, else about 180
    ratio = np.clip(np.cos(np.radians(least_deg)) / np.maximum(np.abs(c), 1e-12), -1, 1)
    half = np.degrees(np.arccos(ratio))
    out = np.zeros_like(roll)
    for centre in (0.0, 180.0, 360.0):
        mine = (c > 0) if centre != 180 else (c < 0)
        overlap = np.clip(np.minimum(hi, centre + half) - np.maximum(lo, centre - half), 0, None)
        out += np.where(mine, overlap, 0.0)
    density = (hi - lo - out) / (hi - lo) ** 2
    cdf = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(roll))])
    return lambda x: np.interp(x, roll, cdf / cdf[-1]), float(cdf[-1])


@pytest.mark.parametrize("fov_deg", [65.0, 5.0, 100.0])
def test_sun_averted_attitudes_are_the_papers_given_that_the_sun_is_out_of_view(fov_deg: float) -> None:
    p = make(camera={"fov_deg": fov_deg})
    far = p.stratum == FAR
    assert sun_angle_deg(p)[far].min() >= np.sqrt(2) * fov_deg / 2
    assert sun_angle_deg(p)[far].min() < np.sqrt(2) * fov_deg / 2 + 10  # and no farther away than need be
    cdf, _ = conditional_cdf(fov_deg / 2, 360 - fov_deg / 2, np.sqrt(2) * fov_deg / 2)
    for name in ("roll_deg", "pitch_deg"):
        assert stats.kstest(p.variables[name][far], cdf).pvalue > LEVEL
    # another view of a sample keeps to the same law: of 200 samples one more each
    s = scene(camera={"fov_deg": fov_deg})
    rows = np.flatnonzero(far)[:200]
    again = [p.view(s, int(i), 1) for i in rows]
    assert not np.any([v["roll_deg"] for v in again] == p.variables["roll_deg"][rows])
    angle = frames.boresight_angle_deg(*(np.array([v[n] for v in again]) for n in ("roll_deg", "pitch_deg")))
    assert angle.min() >= np.sqrt(2) * fov_deg / 2
    assert stats.kstest([v["roll_deg"] for v in again], cdf).pvalue > LEVEL


def test_variables_are_independent_of_each_other_and_of_the_faults(paper: plan.Plan) -> None:
    near = paper.stratum == NEAR
    for mask in (near, ~near):
        columns = [paper.variables[name][mask] for name in redraw.VARIABLES]
        columns += [paper.injected[mask, k].astype(float) for k, f in enumerate(ALL_FAULTS) if f != STRAYLIGHT]
        columns += [paper.architecture[mask], paper.readout_direction[mask]]
        rho = stats.spearmanr(np.column_stack(columns)).statistic
        v = len(redraw.VARIABLES)
        pairs = np.abs(rho[:v])[np.triu_indices(v, 1, rho.shape[1])]
        # about 170 rank correlations of spread 1/√n: 5 of it is 6e-7 two-sided
        assert pairs.max() < 5 / np.sqrt(mask.sum())


def test_architecture_and_readout_direction_are_uniform_and_independent(paper: plan.Plan) -> None:
    table = np.histogram2d(paper.architecture, paper.readout_direction, bins=4, range=[[0, 4], [0, 4]])[0]
    assert table.sum() == N
    assert stats.chisquare(table.ravel()).pvalue > LEVEL
    one = make(camera={"architectures": ["cmos"], "readout_directions": ["left", "up"]})
    assert set(one.architecture) == {0}
    assert set(one.readout_direction) == {0, 1}


def test_nadir_referenced_attitudes_are_left_alone() -> None:
    p = make(geometry={"sun_averted": {"reference": "nadir", "roll_deg": [-10, 10], "pitch_deg": [-5, 5]}})
    far = p.stratum == FAR
    for name, half in (("roll_deg", 10), ("pitch_deg", 5)):
        assert stats.kstest(p.variables[name][far], stats.uniform(-half, 2 * half).cdf).pvalue > LEVEL


def test_attitudes_that_never_lose_the_sun_are_refused() -> None:
    with pytest.raises(InputError) as caught:
        make(geometry={"sun_averted": {"roll_deg": [-5, 5], "pitch_deg": [-5, 5]}}, dataset={"samples": 4})
    for part in ("geometry.sun_averted", "roll_deg", "46.0"):
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_sun_stays_out_of_an_upright_frame() -> None:
    s = scene(camera={"width_px": 512, "height_px": 1024, "fov_deg": 65})
    diagonal = np.degrees(np.arctan(np.hypot(1, 2) * np.tan(np.radians(32.5))))
    assert redraw.least_sun_angle_deg(s) >= diagonal


# ----------------------------------------------------------------------------------------------- fault matrix

fractions = st.floats(0, 1) | st.sampled_from([0.0, 0.25, 1 / 3, 0.5, 0.75, 1.0])
subsets = st.lists(st.sampled_from(ALL_FAULTS), max_size=6, unique=True).map(tuple)


@st.composite
def size_bounds(draw: st.DrawFn) -> tuple[int, int]:
    lo = draw(st.integers(1, 6))
    return lo, draw(st.integers(lo, 8))


@given(st.integers(1, 300), subsets, fractions, st.integers(0, 2**32))
def test_per_class_gives_every_class_its_exact_share(n: int, faults: tuple[str, ...], p: float, seed: int) -> None:
    spec = fault_matrix.MatrixSpec(samples=n, faults=faults, fraction=p, need_sun=(STRAYLIGHT,))
    matrix = fault_matrix.fault_matrix_per_class(spec, np.random.default_rng(seed))
    assert matrix.shape == (n, len(faults))
    assert matrix.dtype == bool
    for k, fault in enumerate(faults):
        assert matrix[:, k].sum() == round(p * n)
        if fault == STRAYLIGHT:  # Gallon et al., equation of the straylight injection
            np.testing.assert_array_equal(matrix[:, k], np.arange(n) < round(p * n))


@given(st.integers(1, 300), subsets, fractions, st.integers(0, 2**32), size_bounds())
def test_per_sample_gives_exactly_the_faulty_samples(
    n: int, faults: tuple[str, ...], p: float, seed: int, sizes: tuple[int, int]
) -> None:
    spec = fault_matrix.MatrixSpec(samples=n, faults=faults, fraction=p, sizes=sizes, need_sun=(STRAYLIGHT,))
    matrix = fault_matrix.fault_matrix_per_sample(spec, np.random.default_rng(seed))
    assert matrix.shape == (n, len(faults))
    assert matrix.dtype == bool
    in_row = matrix.sum(axis=1)
    faulty = in_row > 0
    assert faulty.sum() == (round(p * n) if faults else 0)
    lo, hi = (min(s, len(faults)) for s in sizes)
    assert set(in_row[faulty]) <= set(range(lo, hi + 1))
    if faults:  # dealt from decks of one card a class
        per_class = matrix.sum(axis=0)
        assert per_class.max() - per_class.min() <= 1
    if STRAYLIGHT in faults:
        column = matrix[:, faults.index(STRAYLIGHT)]
        np.testing.assert_array_equal(column, np.arange(n) < column.sum())


@pytest.mark.parametrize("make_matrix", [fault_matrix.fault_matrix_per_class, fault_matrix.fault_matrix_per_sample])
def test_samples_of_every_fault_that_needs_the_sun_come_first(make_matrix: Any) -> None:
    """A class of a plug-in may need the Sun, too: its draws do not depend on those of straylight."""
    n, two = 4000, (STRAYLIGHT, "vignetting")
    spec = fault_matrix.MatrixSpec(samples=n, faults=ALL_FAULTS, fraction=0.5, need_sun=two)
    matrix = make_matrix(spec, np.random.default_rng(3))
    columns = matrix[:, [ALL_FAULTS.index(name) for name in two]]
    facing = columns.any(axis=1)
    np.testing.assert_array_equal(facing, np.arange(n) < facing.sum())
    if make_matrix is fault_matrix.fault_matrix_per_class:
        assert columns.sum(axis=0).tolist() == [n // 2] * 2
        assert abs(columns.all(axis=1).sum() - n / 4) < 4 * np.sqrt(n / 16)  # hypergeometric: below binomial


@pytest.mark.parametrize(("sizes", "classes"), [((1, 6), 6), ((2, 4), 6), ((1, 6), 3), ((3, 3), 5)])
def test_per_sample_subset_sizes_are_uniform(sizes: tuple[int, int], classes: int) -> None:
    faults = ALL_FAULTS[:classes]
    spec = fault_matrix.MatrixSpec(samples=6000, faults=faults, fraction=1.0, sizes=sizes)
    matrix = fault_matrix.fault_matrix_per_sample(spec, np.random.default_rng(5))
    lo, hi = (min(s, classes) for s in sizes)
    counts = np.bincount(matrix.sum(axis=1), minlength=hi + 1)[lo:]
    assert counts.sum() == 6000
    if hi > lo:
        assert stats.chisquare(counts).pvalue > LEVEL


def test_per_sample_rows_are_shuffled() -> None:
    # without straylight neither the faulty rows nor their sizes depend on the place: rank correlations of
    # spread 1/√n
    n = 4000
    spec = fault_matrix.MatrixSpec(samples=n, faults=ALL_FAULTS[:3], fraction=0.5)
    matrix = fault_matrix.fault_matrix_per_sample(spec, np.random.default_rng(5))
    rank = np.arange(n)
    for column in (matrix.any(axis=1), *matrix.T):
        assert abs(stats.spearmanr(rank, column).statistic) < 4.5 / np.sqrt(n)
    faulty = np.flatnonzero(matrix.any(axis=1))
    assert abs(stats.spearmanr(faulty, matrix[faulty].sum(axis=1)).statistic) < 4.5 / np.sqrt(len(faulty))


@pytest.mark.parametrize("mode", ["per_class", "per_sample"])
def test_2000_samples_in_the_papers_proportions(mode: str) -> None:
    p = make(plan={"mode": mode, "faulty_fraction": 0.5})
    per_class = p.injected.sum(axis=0)
    if mode == "per_class":
        np.testing.assert_array_equal(per_class, 1000)
        # the columns but straylight's fall independently: pairs meet in a quarter of the samples, a
        # hypergeometric count of variance n/16
        for a in range(6):
            for b in range(a):
                both = (p.injected[:, a] & p.injected[:, b]).sum()
                assert abs(both - 500) < 4.5 * np.sqrt(N / 16)
    else:
        assert p.injected.any(axis=1).sum() == 1000
        assert np.ptp(per_class) <= 1
        # sizes 1 … 6 are uniform: 3500 expected in all, variance 35/12 each
        assert abs(per_class.sum() - 3500) < 4.5 * np.sqrt(1000 * 35 / 12)


# ----------------------------------------------------------------------------------------------------- strata


@pytest.mark.parametrize("mode", ["per_class", "per_sample"])
def test_straylight_faces_the_sun(mode: str) -> None:
    p = make(plan={"mode": mode})
    straylight = p.injects("straylight")
    assert 0 < straylight.sum() < N
    np.testing.assert_array_equal(p.stratum, np.where(straylight, NEAR, FAR))


def test_nominal_sun_facing_samples_have_no_straylight() -> None:
    p = make(plan={"sun_facing_nominal_fraction": 0.1})
    straylight = p.injects("straylight")
    assert (p.stratum == NEAR).sum() == straylight.sum() + 200
    assert (p.stratum[straylight] == NEAR).all()


def test_too_many_sun_facing_samples_are_refused() -> None:
    with pytest.raises(InputError) as caught:
        make(plan={"mode": "per_class", "faulty_fraction": 0.8, "sun_facing_nominal_fraction": 0.3})
    for part in ("plan.sun_facing_nominal_fraction = 0.3", "1600", "0.2"):
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)
    # what is said to fit does
    p = make(plan={"mode": "per_class", "faulty_fraction": 0.8, "sun_facing_nominal_fraction": 0.2})
    np.testing.assert_array_equal(p.stratum, NEAR)


def test_a_scene_without_straylight_never_faces_the_sun() -> None:
    faults = tuple(f for f in ALL_FAULTS if f != "straylight")
    p = planned(scene(), faults)
    np.testing.assert_array_equal(p.stratum, FAR)
    assert not p.injects("straylight").any()
    assert p.injects("vignetting").any()


# ------------------------------------------------------------------------------------------- blocks and seeds


def assert_same_rows(a: plan.Plan, b: plan.Plan, rows: slice, *, faults: bool = True) -> None:
    for name in redraw.VARIABLES:
        np.testing.assert_array_equal(a.variables[name][rows], b.variables[name][rows])
    for name in (
        "stratum",
        "site",
        "split",
        "architecture",
        "readout_direction",
        "injected",
    ):
        if faults or name != "injected":
            np.testing.assert_array_equal(getattr(a, name)[rows], getattr(b, name)[rows])


@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.integers(0, 2**63 - 1),
    st.sampled_from(["per_class", "per_sample"]),
)
@settings(max_examples=25)
def test_appending_a_block_leaves_earlier_rows_alone(first: int, more: int, seed: int, mode: str) -> None:
    s = scene(dataset={"samples": first, "seed": seed}, plan={"mode": mode})
    short, long = (planned(s, ALL_FAULTS, blocks) for blocks in ([first], [first, more]))
    assert len(long) == first + more
    assert_same_rows(short, long, slice(0, first))
    # the block appended has the matrix of its own size
    count = round(0.5 * more)
    appended = long.injected[first:]
    faulty = appended.sum(axis=0) if mode == "per_class" else appended.any(axis=1).sum()
    np.testing.assert_array_equal(faulty, count)
    np.testing.assert_array_equal(long.injects("straylight")[first:], long.stratum[first:] == NEAR)


def test_an_appended_block_has_its_own_matrix() -> None:
    p = planned(scene(), ALL_FAULTS, [N, N])
    assert not np.array_equal(p.injected[:N], p.injected[N:])


def test_a_longer_plan_keeps_the_numbers_of_the_shorter_within_a_stratum() -> None:
    facing = {"mode": "per_class", "faulty_fraction": 1.0}
    short = make(plan=facing, dataset={"samples": 50, "seed": 20})
    assert_same_rows(short, make(plan=facing), slice(0, 50))


def test_the_plan_follows_its_seed(paper: plan.Plan) -> None:
    assert_same_rows(paper, make(), slice(None))
    other = make(dataset={"samples": N, "seed": 21})
    for name in redraw.VARIABLES:
        assert not np.any(paper.variables[name] == other.variables[name])
    assert not np.array_equal(paper.injected, other.injected)
    assert not np.array_equal(paper.site, other.site)
    zero = make(dataset={"samples": N, "seed": 0})  # 0 is a seed like any other
    assert not np.array_equal(zero.variables["x_m"], make(dataset={"samples": N, "seed": 1}).variables["x_m"])


def test_another_view_has_other_numbers_of_the_same_bounds(paper: plan.Plan) -> None:
    s, rows = scene(), np.arange(0, N, 4)
    for name, (near, far) in PAPER_BOUNDS.items():
        first = paper.variables[name][rows]
        second = np.array([paper.view(s, int(i), 1)[name] for i in rows])
        assert abs(np.corrcoef(first, second)[0, 1]) < 4.5 / np.sqrt(len(rows))
        lo, hi = np.where(paper.stratum[rows] == NEAR, np.array(near)[:, None], np.array(far)[:, None])
        if name not in ("roll_deg", "pitch_deg"):
            assert stats.kstest((second - lo) / (hi - lo), "uniform").pvalue > LEVEL
    assert paper.view(s, 7, 0) == {name: values[7] for name, values in paper.variables.items()}
    assert paper.view(s, 7, 3) == make().view(s, 7, 3)


# ------------------------------------------------------------------------------------------- sites and splits


@pytest.mark.parametrize(("sites", "shard"), [(32, 8), (3, 16), (1, 1), (500, 4)])
def test_a_shard_has_one_site_and_sites_are_used_evenly(sites: int, shard: int) -> None:
    p = make(dataset={"samples": N, "sites": sites, "shard_samples": shard})
    assert p.site.min() >= 0
    assert p.site.max() < sites
    shards = [p.site[i : i + shard] for i in range(0, N, shard)]
    assert all(len(set(s)) == 1 for s in shards)
    used = np.bincount([s[0] for s in shards], minlength=sites)
    assert used.max() - used.min() <= 1  # shuffled rounds


def test_rounds_of_sites_are_shuffled() -> None:
    p = make(dataset={"samples": N, "sites": 32, "shard_samples": 8})
    order = p.site[::8]
    for k in range(0, len(order) - 31, 32):
        assert sorted(order[k : k + 32]) == list(range(32))
    assert not np.array_equal(order[:32], np.arange(32))
    assert not np.array_equal(order[:32], order[32:64])


@given(st.integers(1, 400), st.integers(0, 100), st.integers(0, 100), st.integers(0, 2**32))
def test_splits_are_whole_sites_in_proportion(sites: int, a: int, b: int, seed: int) -> None:
    lo, hi = sorted((a, b))
    fractions = {"train": lo / 100, "val": (hi - lo) / 100, "test": 1 - hi / 100}
    s = scene(dataset={"sites": sites, "seed": seed, "split": fractions})
    split = plan.site_split(s)
    assert split.shape == (sites,)
    wanted = [name for name in plan.SPLITS if fractions[name] > 0]
    for k, name in enumerate(plan.SPLITS):
        # a whole site more for a split that would have none, at the cost of the others
        assert abs((split == k).sum() - fractions[name] * sites) <= len(wanted)
        assert (split == k).any() == (name in wanted) or sites < len(wanted)


def test_no_site_is_in_two_splits_and_splits_are_not_the_first_sites() -> None:
    p = make(dataset={"samples": N, "sites": 32})
    for site in range(32):
        assert len(set(p.split[p.site == site])) == 1
    by_site = plan.site_split(scene())
    np.testing.assert_array_equal(p.split, by_site[p.site])
    # 0.7 · 32 = 22.4 and 0.15 · 32 = 4.8 sites
    assert [int((by_site == k).sum()) for k in range(3)] == [22, 5, 5]
    assert not np.array_equal(by_site, np.sort(by_site))


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 100), st.integers(0, 100), st.integers(0, 2**32))
@settings(max_examples=30)
def test_no_device_is_in_two_splits(individuals: int, sites: int, a: int, b: int, seed: int) -> None:
    lo, hi = sorted((a, b))
    fractions = {"train": lo / 100, "val": (hi - lo) / 100, "test": 1 - hi / 100}
    table = {"sites": sites, "seed": seed, "split": fractions, "samples": 600, "shard_samples": 1}
    p = make(dataset=table, camera={"detector": "generic_cmos", "individuals": individuals})
    assert p.individual.min() >= 0
    assert p.individual.max() < individuals
    used = set(p.split.tolist())
    if individuals >= 3:
        for device in range(individuals):
            assert len(set(p.split[p.individual == device])) <= 1
    elif individuals < len(used):
        assert len(set(p.individual[p.split == min(used)])) == individuals


def test_devices_are_shared_out_as_sites_are() -> None:
    p = make(dataset={"samples": N, "sites": 32}, camera={"detector": "generic_cmos", "individuals": 20})
    devices = [len(set(p.individual[p.split == k])) for k in range(3)]
    assert devices == [14, 3, 3]  # 0.7, 0.15, 0.15 of 20
    assert not make(dataset={"samples": 64}).individual.any()


# ------------------------------------------------------------------------------------------------------ speed


WHOLE = ("earth_observation", "interplanetary", "quickstart", "sssb_exploration", "navcam67p", "physical67p")


@pytest.mark.parametrize("name", [*WHOLE, "landing", "flares"])
def test_packaged_scenes_have_lit_views_and_every_class_in_every_split(name: str) -> None:
    s = config.load_scene(name)
    p = planned(s, list(s.faults))
    asked = np.array([table.min_lit_fraction for table in redraw.strata(s)])[p.stratum]
    assert (asked >= 0.01).mean() >= 0.8
    if name not in WHOLE:
        return
    assert plan.shortcomings(s, p) == []
    for code in range(len(plan.SPLITS)):
        here = p.split == code
        assert p.injected[here].any(axis=0).all()
        assert {bool(v) for v in p.injected[here].any(axis=1)} == {True, False}  # and samples without a fault


@given(st.integers(24, 300), st.integers(3, 12), st.integers(1, 8), st.sampled_from(["per_class", "per_sample"]))
@settings(max_examples=40)
def test_no_split_is_empty_and_classes_are_dealt_evenly(samples: int, sites: int, shard: int, mode: str) -> None:
    s = scene(dataset={"samples": samples, "sites": sites, "shard_samples": shard}, plan={"mode": mode})
    p = planned(s, ALL_FAULTS)
    present = set(p.split.tolist())
    assert len(present) == min(3, sites, -(-samples // shard))
    missing = plan.shortcomings(s, p)
    assert all(name in " ".join(missing) for code, name in enumerate(plan.SPLITS) if code not in present)
    for code in present:
        here = p.split == code
        lacks = [f for k, f in enumerate(ALL_FAULTS) if not p.injected[here, k].any()]
        assert lacks == [
            f for f in ALL_FAULTS if any(f"{plan.SPLITS[code]} has no" in m and f in m for m in missing)
        ]
        # rows of a split are at least 5; a class has a quarter of all rows or more
        assert not lacks or here.sum() < 5 or p.injected.sum(axis=0).min() < 6
        # the Sun-facing rows stand together in the line that is dealt: over n shards their share is even to one
        # sample a shard, and exchanges that fill a class move a few
        shards = len(set((np.flatnonzero(here) // shard).tolist()))
        facing = (p.stratum == NEAR).mean() * here.sum()
        assert abs((p.stratum[here] == NEAR).sum() - facing) <= shards + 6


def test_splits_that_cannot_hold_every_class_are_told() -> None:
    few = scene(dataset={"samples": 16, "sites": 2, "shard_samples": 8})
    (sentence,) = plan.shortcomings(few, planned(few, ALL_FAULTS))
    assert sentence.startswith(
        "split test has no samples: a site belongs to one split, and 2 sites are in use (dataset.sites = 2, "
    )
    rare = scene(dataset={"samples": 30, "sites": 3, "shard_samples": 1}, plan={"faulty_fraction": 0.04})
    p = planned(rare, ALL_FAULTS[:2])
    assert p.injected.any(axis=1).sum() == 1
    lacking = [m for m in plan.shortcomings(rare, p) if "has no sample with" in m]
    assert len(lacking) == 2  # one row cannot be in three splits


@pytest.mark.parametrize("mode", ["per_class", "per_sample"])
def test_100_000_samples_are_planned_without_a_loop_over_samples(mode: str) -> None:
    planned(scene(dataset={"samples": 1000}), ALL_FAULTS)  # what is made once
    calls = []
    for samples in (1000, 100_000):
        s = scene(dataset={"samples": samples}, plan={"mode": mode})
        calls.append(calls_of(lambda s=s: planned(s, ALL_FAULTS)))
    assert calls[1] < 2 * calls[0] < 4000  # 825 and 742; rare samples need redraws, which few scenes have
    p = planned(s, ALL_FAULTS)
    assert len(p) == 100_000
    far = p.stratum == FAR
    assert sun_angle_deg(p)[far].min() >= 32.5 * np.sqrt(2)


def test_bounds_of_one_value_are_met_exactly() -> None:
    p = make(geometry={"sun_facing": {"yaw_deg": [-4, -4]}, "x_m": [7.25, 7.25]})
    np.testing.assert_array_equal(p.variables["x_m"], 7.25)
    np.testing.assert_array_equal(p.variables["yaw_deg"][p.stratum == NEAR], -4)


def test_every_number_is_keyed_by_its_sample() -> None:
    u = keyed_random.keyed_uniform(20, np.arange(N), "plan", "height_m/0")
    np.testing.assert_allclose(make().variables["height_m"], 100 * u, rtol=1e-15)


def test_the_plan_has_the_papers_variables(paper: plan.Plan) -> None:
    assert tuple(paper.variables) == redraw.VARIABLES == tuple(PAPER_BOUNDS)
    assert len(paper) == N
    assert all(v.shape == (N,) and v.dtype == np.float64 for v in paper.variables.values())


@pytest.mark.parametrize(
    ("theirs", "gains"),
    [
        (["A", "AB"], True),  # B for A and B: the first split wins A, and B stays in both
        (["A", "A", "B"], False),  # B for A: the first split would lose B, its only one
        (["A", "A", "B", "B"], False),  # nor does it matter that the other one has B to spare
        (["B", "B"], False),  # nobody has what it lacks
        (["A", "AC", "B", "C"], False),  # C is too rare to matter, and A costs B
    ],
)
def test_rows_are_exchanged_where_a_split_wins_a_class_and_loses_none(theirs: list[str], gains: bool) -> None:
    """The first split has one sample, with class B alone; the second has those of `theirs`."""
    rows = ["B", *theirs]
    traits = np.array([[name in row for name in "ABC"] for row in rows])
    split = np.array([0] + [2] * len(theirs), dtype=np.uint8)
    present = np.unique(split)
    enough = np.array([traits[:, k].sum() >= 2 for k in range(2)] + [False])
    pair = fault_matrix._exchange(traits, split, present, enough)
    assert (pair is not None) == gains
    if pair is None:
        return
    one, other = pair
    assert (split[one], split[other]) == (0, 2)
    after = traits.copy()
    after[[one, other]] = traits[[other, one]]
    for s in present:
        assert after[split == s][:, enough].any(axis=0).all()
