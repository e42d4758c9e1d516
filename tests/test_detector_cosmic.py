"""Cosmic rays: their rate, directions, lengths and charge against closed forms; chords by hand; what is kept."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from vbnfault.detector.cosmic import (
    FLUX_UNSHIELDED_CM2_S,
    LEAST_MEV_CM2_G,
    MOYAL_MEAN,
    XI_E_PER_UM,
    CosmicRayModel,
    CosmicRays,
    stopping_power_MeV_cm2_g,
)

SHAPE = (1000, 1000)
MODEL = CosmicRayModel(pixel_pitch_um=10.0, thickness_um=20.0)  # 1 cm²
EVEN = replace(MODEL, width_e_per_um=0.0)

# p-values: fixed seeds, 1e-3 shared by the comparisons of a test
N = 20_000


def many(model: CosmicRayModel = MODEL, seed: int = 1) -> CosmicRays:
    return model.draw(SHAPE, N / model.expected_count(SHAPE, 1.0), np.random.default_rng(seed))


def one(**kwargs: float) -> CosmicRays:
    """A single track; 80 electrons per µm."""
    track = {"x_px": 0.5, "y_px": 0.5, "depth_um": 0.0, "theta_deg": 0.0, "phi_deg": 0.0, "length_um": 20.0}
    track |= kwargs
    return CosmicRays.from_params([{"electrons": 80 * track["length_um"], "seed": 7, **track}])


def image_of(model: CosmicRayModel, rays: CosmicRays, shape: tuple[int, int]) -> np.ndarray:
    """The electrons of tracks as an image."""
    out = np.zeros(shape, dtype=np.float32)
    index, electrons = model.deposit(rays, shape)
    out.ravel()[index] = electrons
    return out


# -------------------------------------------------------------------------------------------- what is drawn


def test_the_rate_is_half_the_flux_through_a_plane() -> None:
    assert MODEL.expected_count(SHAPE, 100.0) == pytest.approx(FLUX_UNSHIELDED_CM2_S / 2 * 100, rel=1e-12)
    assert FLUX_UNSHIELDED_CM2_S == 4.67


def test_counts_are_poisson() -> None:
    mean, exposures = 9.34, 1000
    rng = np.random.default_rng(2)
    counts = np.array([len(MODEL.draw(SHAPE, 4.0, rng)) for _ in range(exposures)])
    edges = np.array([5, 6, 7, 8, 9, 10, 11, 12, 13])
    expected = exposures * np.diff(np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]]))
    observed = np.bincount(np.searchsorted(edges, counts), minlength=len(expected))
    assert stats.chisquare(observed, expected).pvalue > 1e-3


def test_directions_follow_the_cosine_law_and_places_are_even() -> None:
    rays = many()
    assert len(rays) == pytest.approx(N, abs=4 * np.sqrt(N))
    # density 2 sinθ cosθ: distribution sin²θ
    assert stats.kstest(np.sin(np.radians(rays.theta_deg)) ** 2, "uniform").pvalue > 1e-3 / 4
    assert stats.kstest(rays.phi_deg / 360, "uniform").pvalue > 1e-3 / 4
    assert stats.kstest(rays.x_px / SHAPE[1], "uniform").pvalue > 1e-3 / 4
    assert stats.kstest(rays.y_px / SHAPE[0], "uniform").pvalue > 1e-3 / 4
    assert np.all(rays.depth_um == 0)


def test_lengths_follow_from_the_cosine_law() -> None:
    rays = many()
    # P(length > l) = P(cosθ < t/l) = (t/l)²; the sensor's edge, 1 cm off, cuts fewer than one in a thousand
    assert stats.kstest(rays.length_um, lambda length: np.maximum(1 - (20.0 / length) ** 2, 0)).pvalue > 1e-3
    whole = 20.0 / np.cos(np.radians(rays.theta_deg))
    cut = rays.length_um < whole * (1 - 1e-9)
    assert 0 < cut.mean() < 5e-3
    np.testing.assert_allclose(rays.length_um[~cut], whole[~cut], rtol=1e-9)
    # those that are cut end on the edge
    end = rays.x_px + rays.length_um * np.sin(np.radians(rays.theta_deg)) * np.cos(np.radians(rays.phi_deg)) / 10
    far = rays.y_px + rays.length_um * np.sin(np.radians(rays.theta_deg)) * np.sin(np.radians(rays.phi_deg)) / 10
    off = np.min(np.abs([end, end - 1000, far, far - 1000]), axis=0)
    np.testing.assert_allclose(off[cut], 0, atol=1e-6)


def test_charge_is_moyals_with_80_electrons_per_um() -> None:
    rays = many()
    per_um = rays.electrons / rays.length_um
    # standard deviation of Moyal's distribution: π/√2 widths
    assert per_um.mean() == pytest.approx(80, abs=4 * np.pi / np.sqrt(2) * XI_E_PER_UM / np.sqrt(N))
    location = 80 - XI_E_PER_UM * MOYAL_MEAN
    assert stats.kstest(per_um, stats.moyal(loc=location, scale=XI_E_PER_UM).cdf).pvalue > 1e-3
    assert stats.moyal.mean() == pytest.approx(MOYAL_MEAN)
    # ½ · 0.307 MeV cm²/mol · 0.498 mol/g · 2.33 g/cm³ = 178 keV/cm; 3.65 eV a pair
    assert abs(XI_E_PER_UM - 17.8 / 3.65) < 0.01
    assert per_um.min() > 40


def test_stopping_power_is_bethes() -> None:
    """Minimum ionisation of silicon, 1.664 MeV cm²/g at βγ = 3.4 or so (Particle Data Group), and its slopes: a
    fall before, and a slow rise above."""
    energy = np.geomspace(1.0, 1e5, 2000)
    power = stopping_power_MeV_cm2_g(energy)
    assert power.min() == pytest.approx(LEAST_MEV_CM2_G, rel=2e-3)
    gamma = 1 + energy[power.argmin()] / 938.272
    assert np.sqrt(gamma**2 - 1) == pytest.approx(3.4, abs=0.3)
    assert np.all(np.diff(power[: power.argmin()]) < 0)
    assert 1 < power[-1] / power.min() < 1.5


def test_no_time_no_tracks() -> None:
    rays = MODEL.draw(SHAPE, 0.0, np.random.default_rng(0))
    assert len(rays) == 0
    assert rays.params == []
    assert len(CosmicRays.from_params([])) == 0
    for model in (MODEL, replace(MODEL, diffusion_um=3.0)):
        assert not image_of(model, model.draw((5, 7), 0.0, np.random.default_rng(0)), (5, 7)).any()


# ----------------------------------------------------------------------------------------- charge in pixels


def test_chords_by_hand() -> None:
    # along +x at 45°: 20 µm deep, so 20 µm or two pixels far, from the middle of a pixel
    got = image_of(EVEN, one(x_px=3.5, y_px=2.5, theta_deg=45.0, length_um=20 * np.sqrt(2)), (6, 8))
    expected = np.zeros((6, 8))
    expected[2, 3:6] = 80 * np.sqrt(2) * np.array([5, 10, 5])
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-9)
    # the same towards +y, -x, -y
    for phi, x, y, picture in (
        (90.0, 2.5, 3.5, expected.T),
        (180.0, 4.5, 2.5, expected[:, ::-1]),
        (270.0, 2.5, 4.5, expected[:, ::-1].T),
    ):
        ray = one(x_px=x, y_px=y, theta_deg=45.0, phi_deg=phi, length_um=20 * np.sqrt(2))
        np.testing.assert_allclose(image_of(EVEN, ray, picture.shape), picture, rtol=1e-6, atol=1e-9)
    # straight down: one pixel
    got = image_of(EVEN, one(x_px=3.25, y_px=1.75), (6, 8))
    assert got[1, 3] == 1600
    assert np.count_nonzero(got) == 1


@pytest.mark.parametrize("model", [EVEN, MODEL], ids=["even", "fluctuating"])
def test_chords_against_points_along_the_track(model: CosmicRayModel) -> None:
    rng = np.random.default_rng(4)
    points = 20_001
    for _ in range(20):
        ray = one(
            x_px=rng.uniform(8, 22),
            y_px=rng.uniform(8, 22),
            theta_deg=rng.uniform(0, 75),
            phi_deg=rng.uniform(0, 360),
            length_um=60.0,
        )
        index, electrons = replace(model, thickness_um=60.0).deposit(ray, (30, 30))
        s = (np.arange(points) + 0.5) / points * 6.0 * np.sin(np.radians(ray.theta_deg[0]))
        x = np.floor(ray.x_px[0] + s * np.cos(np.radians(ray.phi_deg[0]))).astype(int)
        y = np.floor(ray.y_px[0] + s * np.sin(np.radians(ray.phi_deg[0]))).astype(int)
        share = np.bincount(y * 30 + x, minlength=900) / points
        chord_um = 60.0 * share[index]
        assert set(np.flatnonzero(share)) <= set(index)
        assert electrons.sum(dtype=np.float64) == pytest.approx(4800, rel=1e-6)
        if model is EVEN:
            # each end of a chord is known to one of the points
            np.testing.assert_allclose(electrons, 80 * chord_um, rtol=0, atol=80 * 60 * 2 / points)
        elif len(index) > 2:
            assert np.abs(electrons - 80 * chord_um).max() > 10


def test_pixels_fluctuate_as_moyals_distribution_does() -> None:
    # 20 pixels each: the scale to the total takes one of 20 degrees of freedom
    track = {
        "depth_um": 0.0,
        "theta_deg": 90.0,
        "phi_deg": 0.0,
        "length_um": 200.0,
        "electrons": 16_000.0,
        "x_px": 0.0,
    }
    params = [{**track, "y_px": row + 0.5, "seed": row} for row in range(500)]
    image = image_of(MODEL, CosmicRays.from_params(params), (500, 20)).astype(np.float64)
    np.testing.assert_allclose(image.sum(axis=1), 16_000, rtol=1e-6)
    per_um = image / 10
    sigma = np.pi / np.sqrt(2) * XI_E_PER_UM
    # excess kurtosis 4: the variance of 10,000 is known to √(6/10,000) = 2.4 % of itself; dividing by the mean of
    # the same 20 pixels takes 5 % and, being skewed, a little more
    assert per_um.var() == pytest.approx(0.95 * sigma**2, rel=0.1)
    assert stats.skew(per_um.ravel()) == pytest.approx(1.5, abs=0.4)
    # neither from pixel to pixel (but for that division: −1/19) nor from track to track
    along = np.corrcoef(image[:, 1:].ravel(), image[:, :-1].ravel())[0, 1]
    assert along == pytest.approx(-1 / 19, abs=4 / 100)
    for other, same in ((image[1:], image[:-1]), (image[1:, :-1], image[:-1, 1:])):  # seeds that follow each other
        assert np.corrcoef(other.ravel(), same.ravel())[0, 1] == pytest.approx(0, abs=4 / 100)


def test_image_holds_what_was_drawn() -> None:
    rays = many()
    image = image_of(MODEL, rays, SHAPE)
    assert image.dtype == np.float32
    assert image.shape == SHAPE
    # sums in float64, then one rounding a pixel
    assert image.sum(dtype=np.float64) == pytest.approx(rays.electrons.sum(), rel=1e-6)
    index, electrons = MODEL.deposit(rays, SHAPE)
    assert np.all(np.diff(index) > 0)
    np.testing.assert_array_equal(image.ravel()[index], electrons)
    assert np.count_nonzero(image) == np.count_nonzero(electrons)


def test_a_smaller_sensor_sees_its_part_of_a_track() -> None:
    ray = one(x_px=1.0, y_px=0.5, theta_deg=90.0, length_um=100.0)
    got = image_of(EVEN, ray, (1, 5))
    np.testing.assert_allclose(got, [[0, 800, 800, 800, 800]], rtol=1e-6)


# ----------------------------------------------------------------------------------------------- what is kept


@pytest.mark.parametrize("diffusion_um", [0.0, 4.0])
def test_params_restore_the_image_bit_for_bit(diffusion_um: float) -> None:
    model = replace(MODEL, diffusion_um=diffusion_um)
    rays = model.draw((200, 300), 500.0, np.random.default_rng(5))
    assert len(rays) > 30
    again = CosmicRays.from_params(json.loads(json.dumps(rays.params)))
    np.testing.assert_array_equal(image_of(model, again, (200, 300)), image_of(model, rays, (200, 300)))
    twin = model.draw((200, 300), 500.0, np.random.default_rng(5))
    assert twin.params == rays.params
    other = CosmicRays.from_params([{**row, "seed": row["seed"] ^ 1} for row in rays.params])
    assert (image_of(model, other, (200, 300)) != image_of(model, rays, (200, 300))).any()


def test_tracks_do_not_know_each_other() -> None:
    rays = MODEL.draw((100, 100), 3000.0, np.random.default_rng(6))
    alone = sum(
        image_of(MODEL, CosmicRays.from_params([row]), (100, 100)).astype(np.float64) for row in rays.params
    )
    # sums of a few float32 per pixel
    np.testing.assert_allclose(image_of(MODEL, rays, (100, 100)), alone, rtol=1e-6, atol=1e-9)


# --------------------------------------------------------------------------------- diffusion


def test_diffusion_spreads_charge_by_its_depth() -> None:
    model = CosmicRayModel(pixel_pitch_um=1.0, thickness_um=20.0, diffusion_um=3.0, width_e_per_um=0.0)
    image = image_of(model, one(x_px=30.5, y_px=25.5), (51, 61)).astype(np.float64)
    assert image.sum() == pytest.approx(1600, rel=1e-6)
    for axis, centre in ((0, 30.5), (1, 25.5)):
        profile = image.sum(axis=axis) / 1600
        at = np.arange(len(profile)) + 0.5
        # σ² ∝ depth: its mean is half of 9 µm²; a pixel adds 1/12. Eight steps of depth are exact for it; cut at
        # 4 σ of the far face, a Gaussian loses at most 0.1 % of its variance
        assert (profile * at).sum() == pytest.approx(centre, abs=1e-6)
        assert (profile * (at - centre) ** 2).sum() == pytest.approx(4.5 + 1 / 12, rel=2e-3)
    aside = image_of(model, one(x_px=33.5, y_px=25.0), (51, 61))
    np.testing.assert_allclose(aside[:, 3:].sum(axis=0), image[:, :-3].sum(axis=0), rtol=1e-4, atol=1e-3)
    rows = aside[:50].sum(axis=1)  # the track on the border of two rows
    np.testing.assert_allclose(rows, rows[::-1], rtol=1e-4, atol=0.1)
    assert rows[24] > 1.001 * rows[23]
    shallow = image_of(model, one(x_px=30.5, y_px=25.5, length_um=0.1), (51, 61))
    assert shallow[25, 30] > 0.9 * shallow.sum()  # σ is 0.15 µm there
    deep = image_of(model, one(x_px=30.5, y_px=25.5, depth_um=19.9, length_um=0.1), (51, 61))
    assert deep[25, 30] < 0.05 * deep.sum()


def test_diffusion_of_all_depths_adds_in_squares() -> None:
    model = CosmicRayModel(
        pixel_pitch_um=1.0, thickness_um=20.0, diffusion_um=3.0, least_diffusion_um=4.0, width_e_per_um=0.0
    )
    at = np.arange(101) + 0.5
    for depth, expected in ((0.0, 16.0), (19.98, 25.0)):
        image = image_of(model, one(x_px=50.5, y_px=50.5, depth_um=depth, length_um=0.01), (101, 101))
        profile = image.sum(axis=0, dtype=np.float64) / image.sum(dtype=np.float64)
        # a pixel adds 1/12; cut at 4 σ, a Gaussian loses at most 0.1 % of its variance
        assert (profile * (at - 50.5) ** 2).sum() == pytest.approx(expected + 1 / 12, rel=3e-3)


def test_little_diffusion_is_none() -> None:
    rays = MODEL.draw(SHAPE, 500.0, np.random.default_rng(9))
    sharp, soft = image_of(EVEN, rays, SHAPE), image_of(replace(EVEN, diffusion_um=1e-6), rays, SHAPE)
    # steps of a quarter of a pixel lie within one piece, so nothing is moved
    np.testing.assert_allclose(soft, sharp, rtol=1e-5, atol=1e-3)


def test_charge_that_diffuses_over_the_edge_is_lost() -> None:
    model = replace(EVEN, diffusion_um=5.0)
    inside = image_of(model, one(x_px=5.0, y_px=5.0), (10, 10)).sum(dtype=np.float64)
    corner = image_of(model, one(x_px=0.0, y_px=0.0), (10, 10)).sum(dtype=np.float64)
    assert inside == pytest.approx(1600, rel=1e-6)
    assert corner == pytest.approx(400, rel=1e-4)  # of the 6e-5 beyond 4 σ
