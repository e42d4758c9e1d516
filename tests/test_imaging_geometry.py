"""Distortion and lateral colour of a prescription against chief rays of the tests' own, and OpenCV."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from conftest import small_scene
from lens_kit import LENSES, PITCH_UM, SIDE_PX, bundle, camera, chief_px, real

from vbnfault import navigation, pipeline
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.lens import (
    RealLens,
    imaging,
    load_lens,
    parse_lens,
    scaled_to_field,
)
from vbnfault.lens.glass import C_NM, D_NM, F_NM
from vbnfault.lens.point_spread import REACH_PX
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
