"""Light that a prescription passes: cos⁴, relative illumination, transmission, against rays and closed forms."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from lens_kit import PITCH_UM, SIDE_PX, beam, rays, real

from vbnfault.core.quantities import Radiance
from vbnfault.lens import (
    RealLens,
    paraxial_properties,
    parse_lens,
)
from vbnfault.lens.coating import design, mean_reflectance
from vbnfault.lens.glass import D_NM
from vbnfault.lens.rays import real_pupil_diameter_mm


def thin_one(**changes: Any) -> RealLens:
    """A lens of next to no thickness behind its stop: no distortion, and the pupil is the stop."""
    back = {"radius_mm": -100.0, "diameter_mm": 2.4}
    rows = [
        {"stop": True, "diameter_mm": 0.5, "thickness_mm": 0.0},
        {"radius_mm": 100.0, "thickness_mm": 0.02, "nd": 1.5, "diameter_mm": 2.4} | changes,
        back | {key: changes[key] for key in ("coating",) if key in changes},
    ]
    lens = parse_lens({"surface": rows}, source="thin")
    return RealLens(prescription=lens, width_px=200, height_px=160, pixel_pitch_um=800.0)


def test_a_thin_lens_of_small_aperture_follows_cos4() -> None:
    lens = thin_one()
    slope = np.linspace(0.01, 0.85, 25)
    # the thickness, 2e-4 of the focal length, is what is left of distortion; the rim's table holds 1e-5
    np.testing.assert_allclose(lens.distorted(slope), slope, rtol=2e-4)
    np.testing.assert_allclose(lens.relative_illumination(lens.distorted(slope)), (1 + slope**2) ** -2, rtol=1e-3)
    assert lens.f_number == pytest.approx(paraxial_properties(lens.prescription).efl_mm / 0.5, rel=1e-4)
    np.testing.assert_allclose(lens.distortion, 0, atol=1e-3)


@pytest.mark.parametrize(("name", "distance_px"), [("nikkor_28_f2p8", 620.0), ("tessar_50_f2p8", 300.0)])
def test_light_that_lands_on_a_ring_of_the_sensor(name: str, distance_px: float) -> None:
    """Rays of a uniform field, counted where they arrive: both vignettings and distortion at once."""
    lens = real(name)

    def per_area(near: float, far: float) -> float:
        """Σ cos θ dΩ dA of the rays that land on a ring, over its area; one azimuth stands for all."""
        edges = lens.undistorted(np.linspace(max(near - 12, 0), far + 12, 65) / lens.focal_length_px)
        slope, step = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
        middle, half = beam(lens, slope)
        grid = (np.arange(51) + 0.5) / 51 * 2 - 1
        x, y = (v.ravel() for v in np.meshgrid(grid, grid))
        found = rays(lens, slope[:, None], middle[:, None] + half * x, half * y, D_NM)
        at = np.hypot(*found.points_mm[-1, :, :2].T) * 1e3 / PITCH_UM
        there = (found.arrives & (at >= near) & (at < far)).reshape(len(slope), -1).sum(axis=1)
        # cos θ sin θ dθ = t dt / (1 + t²)²
        return float(there @ (slope * step / (1 + slope**2) ** 2) * half**2 / (far**2 - near**2))

    # 40 steps across each ring, a thousand points of the grid in each beam: 0.5 % each; coma's shift from the chief
    # ray, which is left out, changes over the field and moves light by 0.6 % of it
    expected = per_area(distance_px - 12, distance_px + 12) / per_area(0.0, 24.0)
    found = lens.relative_illumination(np.array([distance_px, 12.0]) / lens.focal_length_px)
    assert found[0] / found[1] == pytest.approx(expected, rel=0.015)
    assert found[0] < 0.9 * math.cos(math.atan(distance_px / lens.focal_length_px)) ** 4  # rims take their share


def test_coatings_and_glass_take_their_share() -> None:
    wavelength = np.array([450.0, 650.0])
    lens = thin_one(coating="mgf2", internal_transmittance_10mm=0.5, thickness_mm=2.0)
    reflected = mean_reflectance(design("mgf2", 1.5), 1.0, 1.5, 1.0, wavelength)
    np.testing.assert_allclose(lens.transmittance(wavelength), (1 - reflected) ** 2 * 0.5**0.2, rtol=1e-9)


def test_a_uniform_field_shows_the_relative_illumination() -> None:
    lens = real("nikkor_28_f2p8", width_px=96, height_px=64, pixel_pitch_um=PITCH_UM * SIDE_PX / 96)
    gx, gy = lens.guard_px
    nodes = np.array([450.0, D_NM, 650.0])
    field = Radiance(array=np.full((3, 64 + 2 * gy, 96 + 2 * gx), 3.0, np.float32), wavelength_nm=nodes)
    image = lens.image(field)
    assert image.array.shape == (3, 64, 96)
    assert image.array.dtype == np.float32
    x, y = np.meshgrid(np.arange(96) + 0.5 - 48, np.arange(64) + 0.5 - 32)
    distance = np.hypot(x, y) / lens.focal_length_px
    on_axis = lens.axial_solid_angle_sr(nodes)
    for band, wavelength in enumerate(nodes):
        expected = 3 * on_axis[band] * lens.relative_illumination(distance, wavelength)
        np.testing.assert_allclose(image.array[band], expected, rtol=5e-4)
    assert image.array[1].min() < 0.5 * image.array[1].max()
    np.testing.assert_allclose(lens.on_frame(field).array, 3.0, rtol=1e-6)
    with pytest.raises(ValueError, match="guard band"):
        lens.image(Radiance(array=np.ones((3, 64, 96), np.float32), wavelength_nm=nodes))


def test_a_stop_with_blades_counts_by_its_area() -> None:
    lens = real("tessar_50_f2p8")
    rows = list(lens.prescription.surfaces)
    rows[lens.prescription.stop] = replace(rows[lens.prescription.stop], blades=6)
    bladed = replace(lens, prescription=replace(lens.prescription, surfaces=tuple(rows)))
    hexagon = 6 * math.sin(math.pi / 3) * math.cos(math.pi / 3) / math.pi  # of its circle
    stop = rows[lens.prescription.stop]
    rows[lens.prescription.stop] = replace(
        stop, blades=0, semi_diameter_mm=math.sqrt(hexagon) * stop.semi_diameter_mm
    )
    smaller = replace(lens.prescription, surfaces=tuple(rows))
    n = paraxial_properties(smaller).efl_mm / real_pupil_diameter_mm(smaller)
    assert bladed.f_number == pytest.approx(n, rel=1e-4)
    assert n > 1.05 * lens.f_number


@pytest.mark.parametrize("name", ["nikkor_35_f2p8", "biotar_100_f1p4"])
def test_irradiance_on_the_axis(name: str) -> None:
    """E = π T L / (4 N²) with the f-number of real rays; T by the coatings' own function."""
    lens = real(name)
    n = paraxial_properties(lens.prescription).efl_mm / real_pupil_diameter_mm(lens.prescription)
    index = lens.prescription.indices(D_NM)
    loss = [mean_reflectance((), a, b, 1.0, D_NM) for a, b in itertools.pairwise(index) if a != b]
    share = float(np.prod(1 - np.array(loss)))
    assert lens.transmission == pytest.approx(share, rel=1e-9)
    patch = Radiance(array=np.full((1, 2, 3), 7.0, np.float32), wavelength_nm=np.array([D_NM]))
    assert lens.f_number == pytest.approx(n, rel=0.01)
    np.testing.assert_allclose(lens.on_axis(patch).array, 7 * math.pi * share / (4 * n**2), rtol=0.01)
