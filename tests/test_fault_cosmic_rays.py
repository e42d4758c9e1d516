"""Cosmic rays in a mosaic: their number, their charge by hand, and where they show."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from test_faults_kit import flat_electrons, make, make_context, noisy, rng, with_mosaic

from vbnfault.core.quantities import Charge
from vbnfault.detector.cosmic import stopping_power_MeV_cm2_g
from vbnfault.detector.noise import poisson_above_0
from vbnfault.faults import FaultContext


def context(architecture: str = "cmos", size: int = 96, **sensor: Any) -> FaultContext:
    return with_mosaic(make_context(size, architecture=architecture, exposure_s=0.01), **sensor)


def one_track(**keys: float) -> dict[str, Any]:
    """Straight down through pixel x 30, y 20, 300 e."""
    track = {"x_px": 30.5, "y_px": 20.5, "depth_um": 0.0, "theta_deg": 0.0, "phi_deg": 0.0, "length_um": 3.0}
    params = {"flux_per_cm2_s": 1.0, "thickness_um": 3.0, "diffusion_um": 0.0, "least_diffusion_um": 0.0}
    return params | {"least_dn": 1.0, "tracks": [track | {"electrons": 300.0, "seed": 7}]} | keys


def test_a_track_by_hand() -> None:
    c = context()
    fault, params = make("cosmic_rays"), one_track()
    charge = noisy("charge", c)
    gained = fault.apply(charge, params, c).array - charge.array
    at = np.argwhere(gained != 0)
    assert at.tolist() == [[20, 30]]
    assert gained[20, 30] == pytest.approx(300, abs=0.01)  # a float32 of up to 27 000
    mask = fault.footprint(params, c)
    assert mask is not None
    # red of an rggb mosaic: Malvar's kernels reach two pixels
    assert mask[20, 30]
    assert np.abs(np.argwhere(mask) - [20, 30]).max() == 2


def test_what_is_too_weak_is_left_out() -> None:
    c = context()  # full well 13 500 e: 53 e to a DN of 255
    fault, params = make("cosmic_rays"), one_track(least_dn=6.0)
    charge = noisy("charge", c)
    assert np.array_equal(fault.apply(charge, params, c).array, charge.array)
    mask = fault.footprint(params, c)
    assert mask is not None
    assert not mask.any()


def test_number_of_tracks() -> None:
    c = context()
    # 96² pixels of 5.5 µm, half the flux, 10 ms and the least readout time of 50 ms
    mean = 0.5 * 1e5 * (96 * 5.5e-4) ** 2 * 0.06
    fault = make("cosmic_rays", flux_per_cm2_s=1e5)
    counts = []
    for seed in range(40):
        params = fault.draw(c, rng(seed))
        assert params["mean_count"] == pytest.approx(mean)
        assert params["count"] == len(params["tracks"])
        counts.append(params["count"])
    # given that it is not 0: mean/(1 − e^−mean); five standard errors
    expected = mean / -np.expm1(-mean)
    assert np.mean(counts) == pytest.approx(expected, abs=5 * np.sqrt(mean / 40))
    assert len(make("cosmic_rays", flux_per_cm2_s=0.01).draw(c, rng())["tracks"]) == 1
    assert make("cosmic_rays", flux_per_cm2_s=1e7, most_tracks=50).draw(c, rng())["count"] == 50


def test_fluxes_of_a_range_are_even_in_their_logarithm() -> None:
    fault, c = make("cosmic_rays", flux_per_cm2_s=[5.0, 5e3], most_tracks=1), context()
    drawn = [fault.draw(c, rng(seed))["flux_per_cm2_s"] for seed in range(200)]
    assert stats.kstest(np.log10(np.array(drawn) / 5) / 3, "uniform").pvalue > 1e-3


def test_slower_protons_leave_more_charge() -> None:
    """80 e/µm of minimum ionisation by Bethe's formula; energies by their power law, as its distribution has it."""
    c = context(size=256)
    fault = make("cosmic_rays", flux_per_cm2_s=3e6, energy_MeV=[50, 1000], spectral_index=2.0)
    tracks = fault.draw(c, rng(3))["tracks"]
    assert len(tracks) > 1000
    energy, electrons, length = (np.array([t[k] for t in tracks]) for k in ("energy_MeV", "electrons", "length_um"))
    # above E: (1/E − 1/1000)/(1/50 − 1/1000)
    found = stats.kstest(energy, lambda e: 1 - (1 / e - 1e-3) / (1 / 50 - 1e-3))
    assert found.pvalue > 1e-3
    expected = 80 * stopping_power_MeV_cm2_g(energy) / 1.664
    # each track's total has Moyal's deviation of π/√2 · 4.88/80 of its mean
    assert np.mean(electrons / length / expected) == pytest.approx(1, abs=4 * 0.136 / np.sqrt(len(tracks)))


def test_tracks_that_end_leave_a_part_of_their_charge_and_length() -> None:
    c = context(size=256)
    bounds = {"flux_per_cm2_s": 3e6, "energy_MeV": [50, 1000]}
    whole, some = (
        make("cosmic_rays", **bounds, ending_fraction=part).draw(c, rng(3))["tracks"] for part in (0, 0.6)
    )
    assert len(whole) == len(some) > 1000
    parts = np.array(
        [[b[key] / a[key] for key in ("electrons", "length_um")] for a, b in zip(whole, some, strict=True)]
    )
    # lengths are rounded to 0.001 µm; those of the whole tracks are at least a micrometre but at the edge
    long = np.array([track["length_um"] for track in whole]) > 1
    np.testing.assert_allclose(parts[long, 0], parts[long, 1], atol=1e-3)
    ended = parts[:, 0] < 1 - 1e-3
    # u⁸ is above 1 - 1e-3 in 0.013 % of them; four standard deviations
    assert ended.mean() == pytest.approx(0.6, abs=4 * np.sqrt(0.24 / len(parts)) + 0.001)
    # electrons are rounded to 0.001, so the least parts are 0; those of 0.01 or more keep 3 digits. Of all, 0.01 to
    # the power of 1/8 are below; four standard deviations
    large, below = parts[ended & (parts[:, 0] > 0.01), 0], 0.01**0.125
    assert len(large) / ended.sum() == pytest.approx(1 - below, abs=4 * np.sqrt(below * (1 - below) / ended.sum()))
    assert stats.kstest(large, lambda part: (part**0.125 - 0.01**0.125) / (1 - 0.01**0.125)).pvalue > 1e-3


def test_tracks_that_end_lie_at_any_depth() -> None:
    c = context(size=256)
    fault = make("cosmic_rays", flux_per_cm2_s=3e6, ending_fraction=1.0, thickness_um=10.0)
    tracks = fault.draw(c, rng(5))["tracks"]
    depth, length, theta = (np.array([t[key] for t in tracks]) for key in ("depth_um", "length_um", "theta_deg"))
    far = depth + length * np.cos(np.radians(theta))
    assert far.max() <= 10 + 2e-3  # rounded to 0.001 µm
    short = length < 0.01
    assert short.sum() > 500
    assert stats.kstest(depth[short], lambda z: z / 10).pvalue > 1e-3


def test_poisson_above_0() -> None:
    generator = rng(4)
    for mean in (1e-12, 0.3, 2.0, 1e5):
        drawn = poisson_above_0(mean, generator.random(400))
        expected = mean / -np.expm1(-mean)
        assert drawn.min() >= 1
        # five standard errors of the untruncated distribution, which is wider
        assert drawn.mean() == pytest.approx(expected, abs=5 * np.sqrt(mean / 400))


def test_the_layer_is_the_sensors_own() -> None:
    ccd = context("full_frame_ccd", 64)
    params = make("cosmic_rays").draw(ccd, rng())
    assert params["thickness_um"] == 10.0
    assert params["time_s"] == pytest.approx(0.01 + 64 * 1.024e-3)  # its rows, above the least
    given = make("cosmic_rays", thickness_um=20, readout_s=0).draw(ccd, rng())
    assert (given["thickness_um"], given["time_s"]) == (20.0, 0.01)
    lengths = [t["length_um"] for t in given["tracks"]]
    assert min(lengths) > 0


@pytest.mark.parametrize("architecture", ["cmos", "full_frame_ccd"])
def test_the_mask_has_all_that_changes(architecture: str) -> None:
    c = context(architecture)
    detector: Any = c.camera.detector
    # without traps, which trail charge beyond it
    sensor = replace(detector.sensor, transfer=replace(detector.sensor.transfer, parallel_traps=()))
    c = replace(c, camera=replace(c.camera, detector=replace(detector, sensor=sensor)))
    detector = c.camera.detector
    fault = make("cosmic_rays", flux_per_cm2_s=1e5)
    params = json.loads(json.dumps(fault.draw(c, rng(2))))
    light = flat_electrons(c, 0.1)
    noise = detector.draw_noise(c.shape, lambda name: rng(len(name)))
    acts = {"charge": [lambda a: fault.apply(Charge(array=a), params, c).array]}
    before, after = (detector.develop(light, 0.01, noise, a).array for a in ({}, acts))
    changed = (before != after).any(axis=-1)
    mask = fault.footprint(params, c)
    assert mask is not None
    assert not (changed & ~mask).any()
    assert changed.sum() > 0.5 * mask.sum()
    # its strongest pixel stands out
    assert (after.astype(int) - before).max() > 5


def test_diffusion_keeps_the_charge() -> None:
    c = context()
    fault = make("cosmic_rays", least_dn=0.001)
    dark = Charge(array=np.zeros(c.shape, np.float32))
    params = one_track(diffusion_um=3.0, least_dn=0.001)
    wide = fault.apply(dark, params, c).array
    assert wide.sum() == pytest.approx(300, rel=1e-3)
    assert 0 < wide[20, 31] < wide[20, 30] < 300
