"""Point spread and best focus of a prescription against rays of the tests' own and closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lens_kit import PITCH_UM, SIDE_PX, bundle, camera, chief_px, real
from scipy.signal import convolve2d
from scipy.special import ndtr

from vbnfault.core import spectra
from vbnfault.core.quantities import Radiance
from vbnfault.lens import (
    imaging,
    paraxial_properties,
    point_spread,
    resampling,
)
from vbnfault.lens.glass import D_NM


@pytest.mark.parametrize(("name", "angle_deg"), [("nikkor_28_f2p8", 38.0), ("biotar_100_f1p4", 15.0)])
def test_point_spreads_have_the_moments_of_their_rays(name: str, angle_deg: float) -> None:
    """Along and across the radius, against a square grid of rays; turned with the azimuth."""
    lens = real(name)
    slope = math.tan(math.radians(angle_deg))
    at, _ = bundle(lens, slope, D_NM, side=201)
    at = at - at.mean(axis=0)
    assert np.hypot(*at.T).max() < point_spread.REACH_PX  # no light is cut off
    distance = lens.distorted(np.array([slope] * 4))
    turns = np.radians([0.0, 90.0, 180.0, 30.0])
    kernels = imaging.point_spreads(lens, distance, turns, D_NM)
    place = np.arange(-point_spread.REACH_PX, point_spread.REACH_PX + 1)
    x, y = np.meshgrid(place, place)
    # diffraction: a Gaussian of 0.42 λ N each way, N by the irradiance there
    light = float(lens.relative_illumination(distance)[0])
    blur = (0.42 * D_NM * 1e-3 * lens.f_number / math.sqrt(light) / PITCH_UM) ** 2
    for kernel, turn in zip(kernels, turns, strict=True):
        along, across = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
        found = [float((kernel * v**2).sum()) for v in (along, across)]
        # ten rings of rays each way, spots between the field angles of the table: 4 %
        np.testing.assert_allclose(found, at.var(axis=0) + blur, rtol=0.04)
        assert kernel.sum() == pytest.approx(1, abs=1e-6)
        assert abs((kernel * x).sum()) + abs((kernel * y).sum()) < 2e-3
    assert kernels.min() >= 0
    np.testing.assert_allclose(kernels[1], kernels[0].T, atol=1e-5)
    np.testing.assert_allclose(kernels[2], kernels[0][:, ::-1], atol=1e-5)
    # coma: the tail lies on the side where the rays have it
    assert np.sign((kernels[0] * x**3).sum()) == np.sign((at[:, 0] ** 3).mean())


# Field angle and azimuth, degrees, of points of a frame of 65°
POINTS = ((0.3, 10.0), (12.0, 77.0), (21.0, 190.0), (29.0, 268.0), (31.0, 2.0), (38.0, 47.0), (40.0, 134.0))


@pytest.mark.parametrize(("sigma", "light"), [(0.6, 0.05), (1.5, 5e-3)])
def test_points_land_where_the_camera_has_them_with_all_their_light(sigma: float, light: float) -> None:
    """Stars on the render's grid: centroid by `project` and the chief rays' colour, flux by the rays that pass.

    A narrow star's light depends on its place among the pixels, as the cubic between them does not overshoot.
    """
    lens = real("nikkor_28_f2p8")
    c = camera(lens)
    gx, gy = lens.guard_px
    nodes = np.array([450.0, 650.0])
    render = np.zeros((2, SIDE_PX + 2 * gy, SIDE_PX + 2 * gx), dtype=np.float32)
    f = lens.focal_length_px
    for angle, azimuth in POINTS:
        slope, turn = math.tan(math.radians(angle)), math.radians(azimuth)
        places = (f * slope * math.cos(turn) + SIDE_PX / 2 + gx, f * slope * math.sin(turn) + SIDE_PX / 2 + gy)
        column, row = (
            np.diff(ndtr((np.arange(n + 1) - at) / sigma))
            for n, at in zip((render.shape[2], render.shape[1]), places, strict=True)
        )
        # irradiance 1 across its direction: Σ L = f² / cos³ θ
        render += (np.outer(row, column) * f**2 * (1 + slope**2) ** 1.5).astype(np.float32)
    image = lens.image(Radiance(array=render, wavelength_nm=nodes))
    slopes = np.tan(np.radians([angle for angle, _ in POINTS]))
    colours = [chief_px(lens, slopes, wavelength) - chief_px(lens, slopes, D_NM) for wavelength in nodes]
    for k, (slope, (_, azimuth)) in enumerate(zip(slopes, POINTS, strict=True)):
        outwards = np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
        place = c.project(np.array([*(slope * outwards), 1.0]))
        assert place is not None
        left, top = (max(int(v) - 20, 0) for v in place)
        _, area = bundle(lens, slope, D_NM)
        in_bands = spectra.band_means(lens.transmittance(spectra.fine_nodes_nm(nodes)), nodes)
        for band, passed in enumerate(in_bands):
            window = image.array[band, top : top + 41, left : left + 41].astype(float)
            total = window.sum()
            x = (window.sum(axis=0) * (np.arange(window.shape[1]) + left + 0.5)).sum() / total
            y = (window.sum(axis=1) * (np.arange(window.shape[0]) + top + 0.5)).sum() / total
            np.testing.assert_allclose([x, y], place + colours[band][k] * outwards, atol=0.05)
            # the grid of rays counts the area to 0.3 %
            flux = area * passed / math.sqrt(1 + slope**2)
            assert total * (PITCH_UM * 1e-3) ** 2 == pytest.approx(flux, rel=light + 3e-3)


def test_what_a_point_spread_leaves_out_moves_no_light() -> None:
    """Coma that reaches beyond a kernel: what is kept has its centroid in the middle all the same."""
    for name, angle_deg in (("distagon_25_f2p8", 18.0), ("nikkor_35_f2p8", 37.0)):
        lens = real(name)
        slope = math.tan(math.radians(angle_deg))
        at, _ = bundle(lens, slope, D_NM)
        assert (np.hypot(*(at - at.mean(axis=0)).T) > point_spread.REACH_PX).mean() > 0.01
        turns = np.radians([0.0, 70.0])
        place = np.arange(-point_spread.REACH_PX, point_spread.REACH_PX + 1)
        for kernel in imaging.point_spreads(lens, lens.distorted(np.full(2, slope)), turns, D_NM):
            assert kernel.sum() == pytest.approx(1, abs=1e-6)
            assert abs((kernel.sum(axis=0) * place).sum()) < 2e-3
            assert abs((kernel.sum(axis=1) * place).sum()) < 2e-3


def test_the_whole_convolution() -> None:
    rng = np.random.default_rng(5)
    light = rng.random((23, 37), dtype=np.float32)
    for n in (3, 11, 13, 15):  # with more than 121 taps it goes in two parts
        kernel = rng.random((n, n), dtype=np.float32)
        np.testing.assert_allclose(point_spread.spread(light, kernel), convolve2d(light, kernel), rtol=1e-5)


def test_a_finer_grid_keeps_its_pixels_and_does_not_ripple() -> None:
    rng = np.random.default_rng(6)
    band = rng.random((9, 12), dtype=np.float32)
    band[4, 5] = 1e6
    fine = resampling.finer(band)
    assert np.array_equal(fine[::2, ::2], band)
    assert fine.min() >= band.min()
    assert fine.max() <= band.max()
    x, y = np.meshgrid(np.arange(12.0), np.arange(9.0))
    bent = resampling.finer((x**2 + 3 * y + 1).astype(np.float32))
    x, y = np.meshgrid(np.arange(0, 11.1, 0.5), np.arange(0, 8.1, 0.5))
    np.testing.assert_allclose(bent[2:-2, 2:-2], (x**2 + 3 * y + 1)[2:-2, 2:-2], rtol=1e-6)  # quadratics are exact


# --- focus -----------------------------------------------------------------------------------------------------


def test_the_best_focus_has_the_least_spots() -> None:
    paraxial, best = real("nikkor_28_f2p8"), real("nikkor_28_f2p8", focus="best")
    assert paraxial.sensor_mm == pytest.approx(paraxial_properties(paraxial.prescription).bfd_mm, rel=1e-12)
    x = np.arange(SIDE_PX) + 0.5 - SIDE_PX / 2
    radius = np.hypot(x[None], x[:, None]) / paraxial.focal_length_px
    angles = np.radians(np.arange(1.0, 42.0, 3.0))
    pixels, _ = np.histogram(np.arctan(radius), np.append(angles - np.radians(1.5), angles[-1] + np.radians(1.5)))

    def mean_square(shift_mm: float) -> float:
        lens = replace(paraxial)
        object.__setattr__(lens, "sensor_mm", paraxial.sensor_mm + shift_mm)
        total = 0.0
        for angle, count in zip(angles, pixels, strict=True):
            at, area = bundle(lens, math.tan(angle), D_NM, side=41)
            total += count * area * math.cos(angle) ** 4 * at.var(axis=0).sum()
        return total

    shift = best.sensor_mm - paraxial.sensor_mm
    around = [mean_square(shift + offset) for offset in (-0.01, 0.0, 0.01)]
    # the vertex of the parabola through them; field and pupil are sampled otherwise here
    vertex = 0.01 * (around[0] - around[2]) / (2 * (around[0] - 2 * around[1] + around[2]))
    assert abs(vertex) < 0.1 * abs(shift)
    # the intrinsics follow the sensor, so that only distortion is left to the coefficients
    slope = np.array([1e-3])
    expected = chief_px(best, slope, D_NM) / slope
    assert best.focal_length_px == pytest.approx(float(expected[0]), rel=1e-6)
    assert best.focal_length_px < paraxial.focal_length_px
    assert best.distortion_residual_px[1] < 1


def test_spreading_keeps_light_and_its_place() -> None:
    lens = real("biotar_100_f1p4")
    spreads = imaging._spreads(lens, (D_NM,))
    light = np.zeros((SIDE_PX + 14, SIDE_PX + 14), dtype=np.float32)
    places = [(519, 519), (515, 648), (640, 400), (651, 655), (300, 519)]
    for row, column in places:
        light[row, column] = 1e5
    out = spreads.applied(light, 0)
    assert out.min() >= 0  # no rounding of the Sun's light elsewhere, no ripples
    for row, column in places:
        window = out[row - 12 : row + 13, column - 12 : column + 13].astype(float)
        assert window.sum() == pytest.approx(1e5, rel=1e-5)
        at = np.arange(-12, 13)
        # what the border of a kernel leaves out, 0.2 % of its light at most, is all that moves the centroid
        assert abs((window * at).sum()) < 1e5 * 2e-3 * 8
        assert abs((window * at[:, None]).sum()) < 1e5 * 2e-3 * 8
    assert (out > 0).sum() < len(places) * 15**2 + 1
