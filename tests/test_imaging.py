"""Distortion, lateral colour, light and point spread of a lens against rays of the tests' own and closed forms."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import small_scene
from lens_kit import LENSES, PITCH_UM, SIDE_PX, beam, bundle, camera, chief_px, rays, real
from scipy.signal import convolve2d
from scipy.special import ndtr

from vbnfault import navigation, pipeline
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.quantities import Radiance
from vbnfault.lens import (
    RealLens,
    imaging,
    load_lens,
    paraxial_properties,
    parse_lens,
    point_spread,
    resampling,
    scaled_to_field,
)
from vbnfault.lens.coating import design, mean_reflectance
from vbnfault.lens.glass import C_NM, D_NM, F_NM
from vbnfault.lens.point_spread import REACH_PX
from vbnfault.lens.rays import real_pupil_diameter_mm
from vbnfault.output import lens_sheet
from vbnfault.scene import config
from vbnfault.world import cameras


@pytest.mark.parametrize("name", LENSES)
def test_distortion_is_that_of_chief_rays(name: str) -> None:
    lens = real(name)
    assert lens.focal_length_px == pytest.approx(SIDE_PX / 2 / math.tan(math.radians(32.5)), rel=1e-9)
    slope = np.tan(np.radians(LENSES[name]))
    for wavelength in (D_NM, 440.0):
        expected = chief_px(lens, slope, wavelength)
        found = lens.distorted(slope, wavelength) * lens.focal_length_px
        # With three of the lenses the corners have no chief rays: the fit may leave 0.01 px, and more in the outer
        # part of the field; of the Biotar, whose heights all but stop rising, that is the outer quarter.
        followed = slope < np.tan(np.radians(22)) if name == "biotar_100_f1p4" else slope > 0
        np.testing.assert_allclose(found[followed], expected[followed], atol=0.012)
        np.testing.assert_allclose(found, expected, atol=0.5)
        np.testing.assert_allclose(lens.undistorted(found / lens.focal_length_px, wavelength), slope, rtol=1e-6)
    assert abs(expected / (slope * lens.focal_length_px) - 1).max() > 1e-3  # there is some


def test_a_wide_lens_whose_heights_follow_the_angle_has_them_to_the_corners() -> None:
    """At 55 degrees such a lens rises by a third of what it does on the axis, per tangent: no ray turns back."""
    glass = {"thickness_mm": 2.0, "nd": 1.7, "diameter_mm": 60.0, "radius_mm": 60.0}
    rows = [
        glass,
        {"radius_mm": 10.0, "thickness_mm": 16.0, "diameter_mm": 19.8},
        {"stop": True, "thickness_mm": 0.5, "diameter_mm": 1.5},
        glass | {"radius_mm": math.inf, "thickness_mm": 4.0, "diameter_mm": 16.0},
        {"radius_mm": -10.0, "diameter_mm": 16.0},
    ]
    wide = parse_lens({"surface": rows}, source="wide")
    lens = RealLens(prescription=wide, width_px=1024, height_px=1024, pixel_pitch_um=14.8)
    assert lens.guard_px[0] > 200
    slope = np.tan(np.radians([30.0, 45.0, 52.0, 54.0, 55.5]))
    expected = chief_px(lens, slope, D_NM)
    assert np.diff(expected)[-1] < 0.3 * np.diff(slope)[-1] * lens.focal_length_px
    np.testing.assert_allclose(lens.distorted(slope) * lens.focal_length_px, expected, atol=0.012)
    assert lens.coverage.corner_deg > 55
    # the spots there are those of their own rays, too; across the radius they lie within reach of the point spread
    spot, _ = bundle(lens, float(slope[-1]), D_NM)
    kernel = imaging.point_spreads(lens, lens.distorted(slope[-1:]), np.zeros(1), D_NM)[0]
    across = float((kernel.sum(axis=1) * np.arange(-REACH_PX, REACH_PX + 1) ** 2).sum())
    assert across == pytest.approx(spot[:, 1].var(), rel=0.15)
    with pytest.raises(InputError, match="light from beyond 63 degrees into the corners"):
        lens_sheet.opencv_fit(wide, 80.0, 1024, 1024)


def test_lateral_colour_is_that_of_chief_rays() -> None:
    lens = real("nikkor_28_f2p8")
    slope = np.tan(np.radians([20.0, 41.0]))
    blue, red = (lens.distorted(slope, wavelength) * lens.focal_length_px for wavelength in (F_NM, C_NM))
    expected = chief_px(lens, slope, F_NM) - chief_px(lens, slope, C_NM)
    np.testing.assert_allclose(blue - red, expected, atol=2e-3)
    assert expected[0] < -0.1 < 0.1 < expected[1]  # it changes its sign on the way out


@pytest.mark.parametrize("name", ["distagon_25_f2p8", "nikkor_28_f2p8", "heliar_100_f3p5"])
def test_opencv_reproduces_the_map(name: str) -> None:
    c = camera(real(name))
    fx, fy, cx, cy = c.intrinsics
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0, SIDE_PX, (600, 2))
    offset = (pixels - [cx, cy]) / [fx, fy]
    distance = np.hypot(*offset.T)
    lens = c.lens
    assert isinstance(lens, RealLens)
    keep = lens.relative_illumination(distance) > 0
    slope = offset * (lens.undistorted(distance) / distance)[:, None]
    directions = np.column_stack([slope, np.ones(len(slope))])[keep]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    seen, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), matrix, c.lens.distortion)
    exact = np.array([c.project(direction) for direction in directions])
    np.testing.assert_allclose(exact, pixels[keep], atol=1e-4)
    off = np.hypot(*(seen[:, 0] - exact).T)
    # a table of 4097 slopes with linear heights between: (1.5 / 4096)² / 8 of some 800 px is 1e-5
    assert off.max() <= 1e-4
    rms, most = c.lens.distortion_residual_px
    assert 0 < rms < 0.1
    assert rms < most


@pytest.mark.parametrize(("name", "fov_deg"), [("biotar_100_f1p4", 12.0), ("tessar_50_f2p8", 40.0)])
def test_no_direction_from_afar_lands_in_the_frame(name: str, fov_deg: float) -> None:
    """OpenCV's model folds back behind the field: for the first lens from 45 degrees off the axis on."""
    c = camera(real(name, prescription=scaled_to_field(load_lens(name), fov_deg, SIDE_PX * PITCH_UM * 1e-3)))
    angle = np.radians(np.arange(0.01, 89.9, 0.05))
    directions = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    matrix = np.array([[c.intrinsics[0], 0, c.intrinsics[2]], [0, c.intrinsics[1], c.intrinsics[3]], [0, 0, 1]])
    seen, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), matrix, c.lens.distortion)
    in_frame = np.abs(seen[:, 0, 0] - SIDE_PX / 2) < SIDE_PX / 2
    assert (in_frame & (np.degrees(angle) > fov_deg)).any()
    corner = np.degrees(np.arctan(np.sqrt(2) * np.tan(np.radians(fov_deg / 2))))
    for limit in (c.lens.distortion_valid_to_deg, None):  # as a store has it, and as it follows from the model
        view = navigation.CameraView(
            intrinsics=c.intrinsics,
            distortion=c.lens.distortion,
            camera_from_T=np.eye(3),
            camera_position_T_m=np.zeros(3),
            valid_to_deg=limit,
        )
        pixels = view.project(directions)
        known = np.isfinite(pixels[:, 0])
        assert known[np.degrees(angle) < corner].all()
        np.testing.assert_allclose(pixels[known], seen[known, 0], atol=1e-6)
        assert np.degrees(angle[np.abs(pixels[:, 0] - SIDE_PX / 2) < SIDE_PX / 2]).max() < corner
        assert (np.diff(pixels[known, 0]) > 0).all()
        assert np.isfinite(view.slopes(np.array([[0.0, 0.0], [SIDE_PX, SIDE_PX]]))).all()


def test_a_lens_that_sees_more_than_the_render_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imaging, "_BEYOND", 0.8)
    with pytest.raises(InputError, match=r"AF Nikkor.*fov_deg.*36 degrees"):
        _ = real("nikkor_28_f2p8", focus_distance_m=10.0).guard_px  # another lens to the caches


def test_a_frame_wider_than_the_lenss_field_is_told() -> None:
    sizes = {"width_px": 96, "height_px": 96}
    table = small_scene(camera={**sizes, "lens": "tessar_50_f2p8"}) | {"faults": {"dust_on_optics": {}}}
    scene = config.parse_scene(table, source="test")
    lens = cameras.base_camera(scene).lens.real
    assert lens is not None
    field = lens.coverage
    for off_deg, is_lit in ((-0.5, True), (1.5, False)):  # field angles of the tables are 0.9 deg apart
        slope = np.tan(np.radians(field.field_deg + off_deg))
        assert (lens.pupil_area_mm2([slope])[0] > 0) == is_lit
    half_px = np.arange(48) + 0.5
    pixels = np.hypot(half_px[None, :], half_px[:, None]) / lens.focal_length_px
    lit = np.degrees(np.arctan(lens.undistorted(pixels.ravel()))) < field.field_deg
    # a pixel at the edge of the lit part counts as a whole here: of some 75 px along it, half a pixel each
    assert field.lit_fraction == pytest.approx(lit.mean(), abs=75 * 0.5 / 48**2)
    sentence = cameras.dark_corners(scene)
    assert sentence.startswith("camera.fov_deg = 65: Tessar 50 mm f/2.8 passes light up to 35.")
    assert f"the frame's corners lie at {field.corner_deg:.1f} deg, so 5.3% of the frame is dark" in sentence
    with pytest.warns(UserWarning, match=r"camera\.fov_deg = 65"):
        pipeline.Session(scene).warn_of_doubts()
    narrow = config.parse_scene(
        small_scene(camera={**sizes, "lens": "tessar_50_f2p8", "fov_deg": 45.0}), source="t"
    )
    for quiet in (narrow, *map(config.load_scene, resources.packaged("scenes"))):
        assert cameras.dark_corners(quiet) == ""


def test_directions_far_outside_have_a_place_too() -> None:
    for name in ("nikkor_28_f2p8", "biotar_100_f1p4"):
        c = camera(real(name))
        angles = np.radians(np.arange(1.0, 89.5, 0.5))
        x = [c.project(np.array([np.sin(a), 0.0, np.cos(a)]))[0] for a in angles]  # type: ignore[index]
        assert (np.diff(x) > 0).all()
        assert np.isfinite(x).all()
    assert camera(real("nikkor_28_f2p8")).project(np.array([0.0, 0.0, 1.0])).tolist() == [512.0, 512.0]  # type: ignore[union-attr]
    assert camera(real("nikkor_28_f2p8")).project(np.array([0.0, 0.0, -1.0])) is None


# --- light that passes: cos⁴, relative illumination, transmission -------------------------------------------------


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


# --- point spread and best focus ----------------------------------------------------------------------------------


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
