"""A calibration by itself: its models against OpenCV, its inverses, and the files that it is read from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from calibrations_kit import SIX, opencv_pixels

from vbnfault.core.calibration import EXACT, Calibration
from vbnfault.core.errors import InputError
from vbnfault.core.sundisc import Pinhole
from vbnfault.lens.thin import natural_falloff

FRAME = {"width_px": 1024, "height_px": 768}
PLAIN: dict[str, Any] = {**FRAME, "fx": 900.0, "fy": 905.0, "cx": 520.3, "cy": 371.2}
BROWN = (-0.28, 0.1, 1e-3, -7e-4)


def grid(calibration: Calibration, step_px: float = 3.0) -> Any:
    x, y = (np.arange(0.5, size, step_px) for size in (calibration.width_px, calibration.height_px))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


# --- models


@pytest.mark.parametrize("name", SIX)
def test_directions_of_pixels_are_those_of_opencv(name: str) -> None:
    """OpenCV's projection is explicit, so the error is that of the inversion, 1e-10 focal lengths."""
    calibration = SIX[name].checked()
    xy = grid(calibration)
    seen = calibration.directions_of(xy)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1, rtol=1e-12)
    exact_px = 2 * EXACT * calibration.focal_length_px
    np.testing.assert_allclose(calibration.pixel_of(seen), xy, atol=exact_px)
    ahead = seen[:, 2] > 1e-3  # OpenCV projects what lies behind the camera as if it were in front
    assert ahead.mean() > 0.7
    # of a point near 90° OpenCV takes the arctangent of a large number, which costs digits
    np.testing.assert_allclose(opencv_pixels(calibration, 7.0 * seen[ahead]), xy[ahead], atol=max(exact_px, 1e-9))


def test_a_fisheye_of_180_degrees_sees_sideways_and_behind() -> None:
    """An equidistant image: the angle from the axis is the distance from the principal point over f."""
    fisheye = Calibration(
        model="fisheye", width_px=100, height_px=100, fx=30.0, fy=30.0, cx=50.0, cy=50.0
    ).checked()
    assert fisheye.fov_deg == pytest.approx(np.degrees(100 / 30))
    assert fisheye.field_deg == pytest.approx(np.degrees(np.hypot(50, 50) / 30))
    at = 50 + 30 * np.pi / 2
    np.testing.assert_allclose(fisheye.directions_of([at, 50]), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(fisheye.pixel_of([0, 3.0, 0]), [50, at])
    angle = np.radians(100)
    np.testing.assert_allclose(fisheye.pixel_of([np.sin(angle), 0, np.cos(angle)]), [50 + 30 * angle, 50])


def test_without_coefficients_the_map_is_a_pinhole() -> None:
    plain = Calibration(**PLAIN)
    pinhole = Pinhole(plain.intrinsics)
    xy = grid(plain, 100)
    directions = pinhole.directions_of(xy)
    np.testing.assert_array_equal(plain.pixel_of(directions), pinhole.pixel_of(directions))
    np.testing.assert_allclose(plain.directions_of(xy), directions / np.linalg.norm(directions, axis=1)[:, None])
    np.testing.assert_allclose(plain.solid_angle_sr(directions), pinhole.solid_angle_sr(directions), rtol=1e-12)
    assert np.isnan(plain.pixel_of([0.1, 0, -1.0])).all()


@pytest.mark.parametrize("name", SIX)
def test_solid_angles_are_those_of_small_pixels(name: str) -> None:
    """The cross product of the sides of a cell, 2h wide, has errors of the third derivative, h²."""
    calibration, h = SIX[name], 1e-3
    xy = grid(calibration, 17.0)

    def side(across: float, down: float) -> Any:
        step = np.array([across, down])
        return (calibration.directions_of(xy + step) - calibration.directions_of(xy - step)) / (2 * h)

    seen = calibration.directions_of(xy)
    area = np.linalg.norm(np.cross(side(h, 0), side(0, h)), axis=1)
    if calibration.foreshortens:
        area *= seen[:, 2]
    np.testing.assert_allclose(calibration.solid_angle_sr(seen), area, rtol=1e-5)


def test_the_undistorting_sense_is_the_same_polynomial_the_other_way() -> None:
    """What one sense takes from the directions to the image, the other takes from the image to the directions."""
    there = Calibration(**PLAIN, coefficients=BROWN)
    back = Calibration(**PLAIN, model="undistorting", coefficients=BROWN)
    corner = (np.array([0.0, 0.0]) - (there.cx, there.cy)) / (there.fx, there.fy)
    image = (there.pixel_of([*corner, 1.0]) - (there.cx, there.cy)) / (there.fx, there.fy)
    slopes = back.directions_of([0.0, 0.0])
    np.testing.assert_allclose(slopes[:2] / slopes[2], image, rtol=1e-12)
    xy = grid(back, 50)
    np.testing.assert_allclose(back.pixel_of(back.directions_of(xy)), xy, atol=2 * EXACT * 905)


def test_far_outside_the_frame_nothing_folds_back_into_it() -> None:
    """k1 = -0.28 alone turns back at 1 / sqrt(-3 k1) focal lengths; the map goes on instead."""
    calibration = Calibration(**PLAIN, coefficients=(-0.28,))
    assert calibration.valid_to_deg == pytest.approx(np.degrees(np.arctan(np.sqrt(1 / 0.84))), rel=2e-3)
    angle = np.radians(np.arange(0, 89.5, 0.5))
    seen = calibration.pixel_of(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1))
    assert (np.diff(seen[:, 0]) > 0).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"coefficients": (-0.6,)},
            r"folds back 44\d\.\d px from the principal point.*its corner lies 6\d\d\.\d px",
        ),
        ({"model": "fisheye", "coefficients": (-0.6,)}, r"fisheye polynomial folds back 4\d\d\.\d px"),
        ({"model": "fisheye", "fx": 100.0, "fy": 100.0}, "fisheye polynomial reaches 180 deg .* 314.2 px"),
        ({"model": "undistorting", "coefficients": (-0.9,)}, r"undistorting polynomial folds back 5\d\d\.\d px"),
        ({"coefficients": (0, 0, 0.4)}, "folds back"),  # of a tangential term
    ],
)
def test_a_polynomial_that_folds_inside_the_frame_names_its_radius(fields: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Calibration(**{**PLAIN, **fields}).checked()


def test_a_file_with_a_matrix_alone_is_of_a_rectified_camera(tmp_path: Path) -> None:
    file = written(tmp_path, "rectified.yml", YAML_1_0.split("distortion_coefficients")[0])
    assert not any(Calibration.read(file).coefficients)


def test_the_named_radius_is_where_the_polynomial_turns() -> None:
    """x (1 + k1 x²) is greatest at x² = -1 / 3 k1, where it is 2x / 3. The map ends 1e-4 before."""
    calibration = Calibration(**{**PLAIN, "fy": 900.0}, coefficients=(-0.6,))
    turn_px = 900 * 2 / 3 * np.sqrt(1 / 1.8)
    with pytest.raises(InputError, match=f"folds back {turn_px:.0f}"):
        calibration.checked()


def test_a_frame_that_ends_before_the_fold_on_each_side_is_taken() -> None:
    """Tangential terms move the fold away on one side, and the farthest corner lies there."""
    fields: dict[str, Any] = {"width_px": 128, "height_px": 96, "cx": 64, "cy": 60}
    fields["coefficients"] = (-0.3, 0, -0.004, 0.002)
    calibration = Calibration(**fields, fx=126, fy=126).checked()
    xy = np.array([[0.0, 0.0], [128, 0], [0, 96], [128, 96]])
    np.testing.assert_allclose(opencv_pixels(calibration, calibration.directions_of(xy)), xy, atol=1e-6)
    with pytest.raises(InputError, match="folds back"):
        Calibration(**fields, fx=124, fy=124).checked()


def test_beyond_an_image_circle_each_pixel_still_has_a_direction() -> None:
    """A rational polynomial, beyond whose pole no slope lies in many pixels; the circle is far within."""
    coefficients = (0.5, 0.1, 1e-3, -7e-4, 0.002, 0.85, 0.2, 0.01)
    circle = Calibration(
        width_px=96, height_px=80, fx=20, fy=20, cx=48, cy=40, coefficients=coefficients, circle_deg=120
    ).checked()
    seen = circle.directions_at(np.arange(96) + 0.5, np.arange(80) + 0.5)
    assert np.isfinite(seen).all()
    assert np.isfinite(natural_falloff(circle, (80, 96), 20.0)).all()
    assert circle.field_deg == pytest.approx(60)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"model": "omni"}, "model = 'omni': must be one of opencv"),
        ({"fx": 0.0}, "fx = 0: must be from 0.001 to 1e\\+09"),
        ({"fy": float("inf")}, "fy = inf: must be"),
        ({"cx": float("nan")}, "cx = nan: must be from -1e\\+09"),
        ({"coefficients": (0.1, float("inf"))}, "k2 = inf: must be from -1e\\+30 to 1e\\+30"),
        ({"coefficients": (0.0,) * 15}, "the model opencv has 14, not 15"),
        ({"coefficients": (0.0,) * 12 + (1.6,)}, "tau_x = 1.6: must be from -1.5 to 1.5"),
        ({"width_px": 0}, "width_px = 0: must be at least 1"),
    ],
)
def test_wrong_values_are_refused_by_name(fields: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Calibration(**{**PLAIN, **fields})


def test_a_scaled_calibration_sees_the_same_from_the_same_part_of_the_frame() -> None:
    calibration = Calibration(**PLAIN, coefficients=BROWN, skew=1.5)
    half = calibration.scaled_to(512, 384)
    xy = grid(calibration, 100)
    np.testing.assert_allclose(half.directions_of(xy / 2), calibration.directions_of(xy), atol=1e-9)
    with pytest.raises(
        InputError, match=r"calibrates an image of 1024 x 768 px, which cannot be scaled .* 512 x 512"
    ):
        calibration.scaled_to(512, 512)


# --- files

ROS = """\
image_width: 1024
image_height: 768
camera_name: navcam
camera_matrix:
  rows: 3
  cols: 3
  data: [900, 0, 520.3, 0, 905, 371.2, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.1, 1e-3, -7e-4, 0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
ROS_MESSAGE = """\
header: {stamp: {sec: 0, nanosec: 0}, frame_id: camera}
height: 768
width: 1024
distortion_model: equidistant
d: [0.02, -0.004, 0.001, -0.0002]
k: [900.0, 0.0, 520.3, 0.0, 905.0, 371.2, 0.0, 0.0, 1.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
header: {stamp: {sec: 1, nanosec: 0}, frame_id: camera}
"""
KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.1, 0.001, -0.0007]
  distortion_model: radtan
  intrinsics: [900, 905, 520.3, 371.2]
  resolution: [1024, 768]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  camera_model: pinhole
  distortion_coeffs: [0.02, -0.004, 0.001, -0.0002]
  distortion_model: equidistant
  intrinsics: [900, 905, 520.3, 371.2]
  resolution: [1024, 768]
"""
COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 OPENCV 1024 768 900 905 520.8 371.7 -0.28 0.1 0.001 -0.0007
2 SIMPLE_RADIAL 1024 768 900 512 384 -0.1
3 OPENCV_FISHEYE 1024 768 900 905 520.8 371.7 0.02 -0.004 0.001 -0.0002
4 FOV 1024 768 900 905 520.8 371.7 0.9
"""
# as OpenCV 4 writes it
YAML_1_0 = """\
%YAML:1.0
---
image_width: 1024
image_height: 768
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900., 0., 520.3, 0., 905., 371.2, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -0.28, 0.1, 1.0e-03, -7.0e-04 ]
"""


def written(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_files_of_four_programs_give_the_same_rays(tmp_path: Path) -> None:
    """The principal points of ROS, Kalibr and OpenCV count from the centre of the first pixel, COLMAP's from its
    corner, as vbnfault's pixels do."""
    want = Calibration(**{**PLAIN, "cx": 520.8, "cy": 371.7}, coefficients=BROWN)
    ros = Calibration.read(written(tmp_path, "camera_info.yaml", ROS))
    assert ros == want
    assert Calibration.read(written(tmp_path, "camchain.yaml", KALIBR), camera="cam0") == want
    assert Calibration.read(written(tmp_path, "cameras.txt", COLMAP), camera="1") == want
    assert Calibration.read(written(tmp_path, "old.yml", YAML_1_0)) == want
    xy = np.array([[0.5, 0.5], [1023.5, 767.5]])
    np.testing.assert_allclose(opencv_pixels(ros, ros.directions_of(xy)), xy, atol=1e-6)
    # OpenCV's own pixel (0, 0) is the centre of the first pixel
    matrix = np.array([[900, 0, 520.3], [0, 905, 371.2], [0, 0, 1]])
    first, _ = cv2.projectPoints(ros.directions_of([[0.5, 0.5]]), np.zeros(3), np.zeros(3), matrix, np.array(BROWN))
    np.testing.assert_allclose(first[0, 0], 0, atol=1e-6)

    fisheye = Calibration(
        **{**PLAIN, "cx": 520.8, "cy": 371.7}, model="fisheye", coefficients=(0.02, -4e-3, 1e-3, -2e-4)
    )
    whole_roi = ROS_MESSAGE.replace("height: 0, width: 0", "height: 768, width: 1024")
    assert whole_roi != ROS_MESSAGE
    for name, text, camera in (
        ("i.yaml", ROS_MESSAGE, ""),
        ("r.yaml", whole_roi, ""),
        ("k.yaml", KALIBR, "cam1"),
        ("c.txt", COLMAP, "3"),
    ):
        assert Calibration.read(written(tmp_path, name, text), camera=camera) == fisheye, name
    assert Calibration.read(tmp_path / "cameras.txt", camera="2") == Calibration(
        **FRAME, fx=900, fy=900, cx=512, cy=384, coefficients=(-0.1,)
    )


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_what_opencv_writes_is_read(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"camera.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "yesterday")
    storage.write("image_width", 1024)
    storage.write("image_height", 768)
    storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array([[900, 2.0, 520.3], [0, 905, 371.2], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([0.02, -4e-3, 1e-3, -2e-4])[:, None])
    storage.release()
    assert Calibration.read(path) == Calibration.of_centres(
        **PLAIN, model="fisheye", skew=2.0, coefficients=(0.02, -4e-3, 1e-3, -2e-4)
    )
    with pytest.raises(InputError, match=r"fisheye_model = 1: contradicts model = 'opencv'"):
        Calibration.read(path, model="opencv")


def test_an_opencv_file_without_size_or_model_takes_them_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "intrinsics.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("M1", np.array([[900, 0, 520.3], [0, 905, 371.2], [0, 0, 1]]))
    storage.write("D1", np.array([[0.02, -4e-3, 1e-3, -2e-4]]))
    storage.release()
    read = Calibration.read(path, camera="1", model="fisheye", size_px=(1024, 768))
    assert read == Calibration.of_centres(**PLAIN, model="fisheye", coefficients=(0.02, -4e-3, 1e-3, -2e-4))
    with pytest.raises(InputError, match="has no image_width and image_height; give width_px and height_px"):
        Calibration.read(path, camera="1")
    with pytest.raises(InputError, match=r"has no camera_matrix of camera '2'; it has: M1, D1"):
        Calibration.read(path, camera="2")


KNOWN = "must be a camera_info YAML of ROS"


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (bytes(range(128, 200)), {}, f"is no text; {KNOWN}"),
        ("- 1\n- 2\n", {}, f"is no calibration of a camera; {KNOWN}"),
        ("title = 'scene'\n", {}, f"is no calibration of a camera; {KNOWN}"),
        ("a: [1, 2\nb: }", {}, f"cannot be read as YAML in line 2; {KNOWN}"),
        ("a: !!python/object/apply:os.system ['true']", {}, f"cannot be read as YAML in line 1; {KNOWN}"),
        ("[" * 3000, {}, f"cannot be read as YAML.*{KNOWN}"),
        (ROS.replace("distortion_coefficients", "others"), {}, "distortion_coefficients: is missing"),
        (ROS.replace("image_width: 1024\n", ""), {}, "image_width: is missing"),
        (
            ROS.replace("image_width: 1024", "image_width: 1024.5"),
            {},
            "image_width, image_height = 1024.5: must be",
        ),
        (ROS.replace("plumb_bob", "kannala"), {}, "distortion_model = 'kannala': must be one of plumb_bob"),
        (
            ROS.replace("plumb_bob", "[plumb_bob]"),
            {},
            r"distortion_model = \['plumb_bob'\]: must be one of plumb_bob",
        ),
        (ROS.replace("[900,", "[.nan,"), {}, "fx = nan: must be from 0.001"),
        (ROS.replace("[900,", "[[1],"), {}, r"camera_matrix: \[1\]: must be a number"),
        (
            ROS.replace("-7e-4, 0]", "-7e-4, 0, 0]"),
            {},
            "distortion_coefficients: has 6; must be 0 or 4 or 5 numbers",
        ),
        (ROS.replace("0, 0, 1]\n", "0, 1, 1]\n", 1), {}, r"camera_matrix: must be \[fx, skew, cx"),
        (ROS, {"size_px": (9, 9)}, "only an OpenCV file may leave them out"),
        (ROS_MESSAGE.replace("binning_x: 0", "binning_x: 2"), {}, "binning_x = 2: must be 0 or 1"),
        (ROS_MESSAGE.replace("x_offset: 0", "x_offset: 8"), {}, "roi: must be empty"),
        (ROS, {"camera": "cam1"}, "camera = 'cam1': is not in the file; name one of navcam as camera"),
        (KALIBR, {}, "holds 2 cameras; name one of cam0, cam1 as camera"),
        (KALIBR, {"camera": "cam7"}, "camera = 'cam7': is not in the file; name one of cam0, cam1"),
        (KALIBR.replace("pinhole", "omni"), {"camera": "cam0"}, "camera_model = 'omni': must be pinhole"),
        (KALIBR.replace("radtan", "fov"), {"camera": "cam0"}, "distortion_model = 'fov': must be radtan"),
        (COLMAP, {"camera": "4"}, "camera 4: model 'FOV': must be one of SIMPLE_PINHOLE"),
        (COLMAP.replace(" -0.0007", ""), {"camera": "1"}, "the parameters of OPENCV: has 7; must be 8 numbers"),
        (YAML_1_0.replace("camera_matrix", "matrix"), {}, "has no camera_matrix; it has: image_width"),
        (
            YAML_1_0.replace("distortion_coefficients", "lens_terms"),
            {},
            "has no distortion_coefficients; it has: image_width, image_height, camera_matrix, lens_terms",
        ),
        ("%YAML:1.0\n---\na: [1,", {}, f"cannot be read as a FileStorage of OpenCV; {KNOWN}"),
        ("<?xml version='1.0'?><opencv_storage><K>5</K></opencv_storage>", {}, "K: must be a matrix of numbers"),
        ("<?xml version='1.0'?><svg/>", {}, f"cannot be read as a FileStorage of OpenCV; {KNOWN}"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path: Path, text: Any, options: Any, message: str) -> None:
    path = written(tmp_path, "camera", text)
    with pytest.raises(InputError, match=message) as raised:
        Calibration.read(path, **options)
    assert f"{raised.value}".startswith(f"{path}: ")
    assert "\n" not in f"{raised.value}"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="calibration file not found"):
        Calibration.read(tmp_path / "none.yaml")
