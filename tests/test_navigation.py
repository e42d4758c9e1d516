"""Metrics of navigation: exact cases, planted shifts and motions, and inputs of every kind."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from navigation_oracle import INTRINSICS, SIZE_PX, disc, ground, texture

from vbnfault import navigation
from vbnfault.core import frames
from vbnfault.core.errors import InputError

RADIAL = (-0.2, 0.05, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0)
STILL = (np.eye(3), np.zeros(3))
MOTIONS = {
    "sideways": (np.eye(3), np.array([12.0, 0.0, 0.0])),
    "turning": (frames.ry(0.05) @ frames.rx(-0.03) @ frames.rz(0.1), np.array([11.0, 3.0, -4.0])),
    "descending": (frames.rz(-0.06), np.array([1.0, 2.0, 18.0])),
}


def as_type(image: np.ndarray, dtype: str) -> np.ndarray:
    """Return an image in [0, 1] as floats, or with a white level of 220 of 255 as integers."""
    if dtype.startswith("float"):
        return image.astype(dtype)
    return np.rint(image * np.iinfo(dtype).max * 220 / 255).astype(dtype)


# --- limb and centre of brightness ---------------------------------------------------------------------------


@pytest.mark.parametrize("lit", ["all", "left"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_shifts_are_recovered(lit: str, dtype: str) -> None:
    start = np.array([80.3, 79.6])
    clean, body = disc(start, 40, lit=lit)
    for length in (0.1, 0.35, 1.0, 3.0):
        shift = length * np.array([0.8, -0.6])
        moved, _ = disc(start + shift, 40, lit=lit)
        limb = navigation.limb_error(as_type(clean, dtype), as_type(moved, dtype), body)
        centre = navigation.centroid_shift(as_type(clean, dtype), as_type(moved, dtype))
        # sampling of the discs, quantisation to 8 bits and the pixel's width leave some 0.02 px
        assert limb.shift_px == pytest.approx(shift, abs=0.03)
        assert centre.shift_px == pytest.approx(shift, abs=0.01)
        assert centre.distance_px == pytest.approx(length, abs=0.01)
        assert limb.lost_fraction == 0
        if lit == "all":  # a whole circle: the mean square of a normal's component is 1/2
            assert limb.rms_px == pytest.approx(length / np.sqrt(2), abs=0.02)


def test_a_shift_along_a_straight_limb_shows_across_it_only() -> None:
    clean = np.zeros((96, 96), np.float32)
    clean[:, 40:] = 1.0
    moved = np.zeros_like(clean)
    moved[:, 42:], moved[:, 41] = 1.0, 0.5  # the edge at x = 40 moves to 41.5
    found = navigation.limb_error(clean, moved, clean > 0)
    assert found.rms_px == pytest.approx(1.5, abs=0.01)
    assert found.median_px == pytest.approx(1.5, abs=0.01)
    assert (found.displacements_px < 0).all()  # away from the sky
    assert found.normals == pytest.approx(np.tile([-1.0, 0.0], (len(found.normals), 1)), abs=1e-6)
    assert found.xy[:, 0] == pytest.approx(np.full(len(found.xy), 40.0), abs=0.01)
    assert np.isnan(found.shift_px).all()


def test_noise_moves_the_limb_by_chance_only() -> None:
    clean, body = disc(np.array([80.0, 80.0]), 40)
    noisy = clean + np.random.default_rng(3).normal(0, 0.02, clean.shape)
    found = navigation.limb_error(clean, noisy, body)
    # gradient of the edge 0.4 per px, its noise 0.02 / (2 √π σ²) ≈ 0.006, so an edge moves by some 0.03 px
    assert 0 < found.median_px < 0.06
    assert found.shift_px == pytest.approx([0, 0], abs=0.02)


def test_what_has_no_limb_says_so() -> None:
    clean, body = disc(np.array([80.0, 80.0]), 40)
    full = navigation.limb_error(clean, clean, np.ones_like(body))
    assert np.isnan(full.rms_px)
    assert full.reason == "no limb is in the frame: it shows no edge between body and sky"
    dark = navigation.limb_error(np.zeros_like(clean), clean, body)
    assert dark.reason == "the clean twin shows no lit limb"
    gone = navigation.limb_error(clean, np.ones_like(clean), body)
    assert (gone.reason, gone.lost_fraction) == ("the image shows no limb where the clean twin has it", 1.0)
    # neither body nor sky lies beside the limb: a spacecraft hides it
    hidden = navigation.limb_error(clean, clean, body, sky=np.zeros_like(body))
    assert hidden.reason.startswith("no limb")
    black = navigation.centroid_shift(np.zeros((8, 8)), np.ones((8, 8)))
    assert (np.isnan(black.distance_px), black.reason) == (True, "the clean twin has no signal above its threshold")


def test_only_the_lit_part_of_the_limb_counts() -> None:
    clean, body = disc(np.array([80.0, 80.0]), 40, lit="left")
    found = navigation.limb_error(clean, clean, body)
    assert found.xy[:, 0].max() < 80 + 40 * 0.62  # the terminator meets the limb at cos⁻¹ 0.6 from the Sun's side
    assert found.normals[:, 0].min() < -0.99


# --- identity --------------------------------------------------------------------------------------------------


def test_identical_images_have_no_error() -> None:
    clean, body = disc(np.array([80.3, 79.6]), 40)
    rng = np.random.default_rng(0)
    image = as_type(
        np.clip(clean * (0.6 + 0.4 * texture(160) / 210) + rng.normal(0, 0.01, clean.shape), 0, 1), "uint8"
    )
    view = navigation.CameraView(
        intrinsics=[150, 150, 80, 80],
        camera_from_T=np.eye(3),
        camera_position_T_m=np.zeros(3),
        depth_m=np.where(body, 100.0, np.inf),
    )
    limb = navigation.limb_error(image, image, body)
    assert (limb.rms_px, limb.median_px, limb.lost_fraction) == (0, 0, 0)
    assert not limb.shift_px.any()
    assert navigation.centroid_shift(image, image).distance_px == 0
    assert navigation.corner_repeatability(image, image).fraction == 1
    assert navigation.orb_repeatability(image, image).fraction == 1
    matches = navigation.match(image, image)
    assert len(matches) > 50
    on_body = navigation.Matches(
        first_xy=matches.first_xy[np.isfinite(view.depth_at(matches.first_xy))],
        second_xy=matches.second_xy[np.isfinite(view.depth_at(matches.first_xy))],
    )
    assert navigation.match_precision(on_body, view, view) == 1
    assert navigation.matches_lost(matches, matches, view, view) == 0


def test_a_feature_lives_as_long_as_the_views_are_the_same() -> None:
    image, view = ground(*STILL)
    found = navigation.feature_lifetime([image] * 10, [view] * 10)
    assert found.mean_views == 10
    assert (found.views == 10).all()
    assert navigation.feature_lifetime([image], [view]).mean_views == 1


# --- features ----------------------------------------------------------------------------------------------


def test_repeatability_falls_with_blur() -> None:
    image, _ = ground(*STILL)
    sigmas = (0.3, 0.6, 1.0, 1.6, 2.5, 4.0)
    blurred = [cv2.GaussianBlur(image, (0, 0), sigma) for sigma in sigmas]
    for repeatability in (navigation.corner_repeatability, navigation.orb_repeatability):
        fractions = [repeatability(image, other).fraction for other in blurred]
        assert np.all(np.diff([1.0, *fractions]) <= 0), fractions
        assert fractions[0] > 0.8
        assert fractions[-1] < 0.3


def test_repeatability_counts_pairs() -> None:
    image = np.full((64, 64), 20, np.uint8)
    image[10:20, 10:20] = 200
    image[40:50, 40:50] = 200
    half = image.copy()
    half[32:] = 20
    found = navigation.corner_repeatability(image, half)
    assert (found.clean, found.image, found.repeated, found.fraction) == (4, 2, 2, 0.5)
    moved = np.roll(image, 2, axis=1)
    assert navigation.corner_repeatability(image, moved).fraction == 0
    assert navigation.corner_repeatability(image, moved, tolerance_px=2.0).fraction == 1


def test_corners_lie_at_pixel_centres_plus_a_half() -> None:
    image = np.zeros((41, 61), np.uint8)
    image[:21, :31] = 255  # one corner, between the pixels 20, 21 and 30, 31
    ((x, y),) = navigation.corners(image)
    assert (x, y) == pytest.approx((30, 20), abs=1)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("distortion", [None, RADIAL], ids=["pinhole", "distorted"])
def test_reprojected_truth_is_right_and_gives_the_true_motion(motion: str, distortion: Any) -> None:
    _, first = ground(*STILL, relief_m=3, distortion=distortion)
    _, second = ground(*MOTIONS[motion], relief_m=3, distortion=distortion)
    # pixel centres, whose depth is known exactly
    pixels = np.random.default_rng(1).integers(8, SIZE_PX - 8, (300, 2)) + 0.5
    truth = navigation.Matches(first_xy=pixels, second_xy=navigation.reprojected(pixels, first, second))
    assert navigation.match_precision(truth, first, second) == 1
    assert navigation.match_precision(truth, first, second, tolerance_px=1e-9) == 1
    wrong = navigation.Matches(first_xy=pixels, second_xy=truth.second_xy + 2.4)
    assert navigation.match_precision(wrong, first, second) == 0  # 3.39 px
    error = navigation.relative_pose_error(truth, first, second)
    assert max(error.rotation_deg, error.translation_deg) < 1e-4
    spoilt = navigation.Matches(first_xy=pixels, second_xy=truth.second_xy.copy())
    spoilt.second_xy[::3] += 40 * np.random.default_rng(2).normal(size=(100, 2))
    error = navigation.relative_pose_error(spoilt, first, second)
    assert max(error.rotation_deg, error.translation_deg) < 0.1
    estimate = navigation.relative_pose(spoilt, first, second)
    assert not estimate.inliers[::3].mean() > 0.2


@pytest.mark.parametrize("motion", MOTIONS)
def test_planted_motions_are_recovered_from_images(motion: str) -> None:
    image, first = ground(*STILL, relief_m=4, distortion=RADIAL)
    other, second = ground(*MOTIONS[motion], relief_m=4, distortion=RADIAL)
    matches = navigation.match(image, other)
    assert len(matches) > 80
    assert navigation.match_precision(matches, first, second) > 0.9
    error = navigation.relative_pose_error(matches, first, second)
    # matches of 0.5 px over 100: 0.5/250/√100 rad = 0.01 deg in a well-conditioned case, rotation and translation
    # of a narrow field trade off by a factor of some tens
    assert error.rotation_deg < 1
    assert error.translation_deg < 6
    again = navigation.relative_pose(matches, first, second)
    np.random.seed(1)  # noqa: NPY002 — no global generator may matter
    cv2.setRNGSeed(77)
    assert np.array_equal(again.rotation, navigation.relative_pose(matches, first, second).rotation)
    lost = navigation.match(image, cv2.GaussianBlur(other, (0, 0), 2.5))
    assert 0.3 < navigation.matches_lost(matches, lost, first, second) <= 1


def test_a_track_is_right_only_where_the_ground_moved() -> None:
    image, first = ground(*STILL, relief_m=3)
    other, second = ground(*MOTIONS["sideways"], relief_m=3)
    moving = navigation.feature_lifetime([image, other], [first, second])
    assert 1.5 < moving.mean_views <= 2
    stuck = navigation.feature_lifetime([image, image], [first, second])
    assert stuck.mean_views == 1  # as dust does: the features stay in the frame, the ground does not
    on_the_sky = navigation.CameraView(**{**vars(first), "depth_m": np.full((SIZE_PX, SIZE_PX), np.inf)})
    assert navigation.feature_lifetime([image, image], [on_the_sky, first]).mean_views == 0
    assert navigation.match_precision(navigation.match(image, image), on_the_sky, first) == 0


def test_pixels_follow_the_stored_camera_model() -> None:
    _, view = ground(*MOTIONS["turning"], relief_m=3, distortion=RADIAL)
    rng = np.random.default_rng(4)
    xy = rng.integers(0, SIZE_PX, (200, 2)) + 0.5
    assert view.project(view.points_T_m(xy)) == pytest.approx(xy, abs=1e-9)
    points = view.points_T_m(xy)
    rotation = cv2.Rodrigues(view.camera_from_T)[0]
    translation = -view.camera_from_T @ view.camera_position_T_m
    oracle, _ = cv2.projectPoints(points[:, None], rotation, translation, view.matrix, view.distortion)
    assert view.project(points) == pytest.approx(oracle[:, 0], abs=1e-9)
    tangential = navigation.CameraView(**{**vars(view), "distortion": np.array([0.1, -0.02, 0.01, -0.02, 0.003])})
    slopes = tangential.slopes(xy)
    oracle, _ = cv2.projectPoints(
        np.column_stack([slopes, np.ones(200)])[:, None],
        np.zeros(3),
        np.zeros(3),
        view.matrix,
        tangential.distortion,
    )
    assert oracle[:, 0] == pytest.approx(xy, abs=1e-9)
    quaternion = navigation.CameraView(**{**vars(view), "camera_from_T": frames.quaternion(view.camera_from_T)})
    assert quaternion.camera_from_T == pytest.approx(view.camera_from_T, abs=1e-12)


def test_directions_behind_the_fold_of_the_distortion_have_no_pixel() -> None:
    """With k1 = -0.2, t - 0.2 t³ rises up to t = √(1 / 0.6), 52.24°; the limit is a multiple of 0.02°."""
    view = navigation.CameraView(
        intrinsics=INTRINSICS,
        distortion=np.array([-0.2, 0, 0, 0]),
        camera_from_T=np.eye(3),
        camera_position_T_m=np.zeros(3),
    )
    angle = np.radians([10.0, 52.2, 52.3, 66.0])  # at 66 degrees the model is back at the axis
    pixels = view.project(np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)]))
    np.testing.assert_array_equal(np.isfinite(pixels[:, 0]), [True, True, False, False])
    beyond = INTRINSICS[2:] + INTRINSICS[:2] * [0.9, 0]  # t - 0.2 t³ is at most 0.861
    assert np.isnan(view.slopes(beyond[None])).all()
    inside = INTRINSICS[2:] + np.random.default_rng(1).uniform(-50, 50, (20, 2))
    for first, second in ((inside, inside + beyond), (inside + beyond, inside)):
        with pytest.raises(InputError, match="farther from the centre than the distortion of their view reaches"):
            navigation.relative_pose(navigation.Matches(first_xy=first, second_xy=second), view, view)
    with pytest.raises(InputError, match=r"view\.valid_to_deg = 0: must be above 0"):
        navigation.CameraView(
            intrinsics=INTRINSICS, camera_from_T=np.eye(3), camera_position_T_m=np.zeros(3), valid_to_deg=0
        )


def test_a_camera_that_turns_only_has_no_direction_of_translation() -> None:
    _, first = ground(*STILL, relief_m=3)
    _, second = ground(MOTIONS["turning"][0], np.zeros(3), relief_m=3)
    pixels = np.random.default_rng(1).integers(8, SIZE_PX - 8, (200, 2)) + 0.5
    truth = navigation.Matches(first_xy=pixels, second_xy=navigation.reprojected(pixels, first, second))
    error = navigation.relative_pose_error(truth, first, second)
    assert error.rotation_deg < 0.01
    assert (np.isnan(error.translation_deg), error.reason) == (True, "the camera does not move between the views")


# --- every kind of input ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "float64"])
@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (40, 33), (40, 33, 3), (40, 33, 4)])
def test_no_image_is_too_plain_or_too_small(dtype: str, shape: tuple[int, ...]) -> None:
    top = np.iinfo(dtype).max if dtype.startswith("u") else 1.0
    size = shape[:2]
    view = navigation.CameraView(
        intrinsics=INTRINSICS, camera_from_T=np.eye(3), camera_position_T_m=np.zeros(3), depth_m=np.full(size, 9.0)
    )
    noise = (np.random.default_rng(0).random(shape) * top).astype(dtype)
    blank, saturated = np.zeros(shape, dtype), np.full(shape, top, dtype)
    body = np.zeros(size, bool)
    body[:, : size[1] // 2] = True
    for first in (blank, saturated, noise):
        for second in (blank, saturated, noise):
            matches = navigation.match(first, second)
            results = [
                navigation.limb_error(first, second, body).rms_px,
                navigation.centroid_shift(first, second).distance_px,
                navigation.corner_repeatability(first, second).fraction,
                navigation.orb_repeatability(first, second).fraction,
                navigation.match_precision(matches, view, view),
                navigation.matches_lost(matches, matches, view, view),
                navigation.relative_pose_error(matches, view, view).rotation_deg,
                navigation.feature_lifetime([first, second], [view, view]).mean_views,
            ]
            assert all(np.isnan(r) or 0 <= r <= max(180, *size) for r in results)


def test_mistakes_are_named_in_one_sentence() -> None:
    a, b = np.zeros((8, 9)), np.zeros((9, 8))
    same = "image: 9 x 8 (height x width) px: must have the 8 x 9 px of clean"
    for call in (
        lambda: navigation.limb_error(a, b, a > 0),
        lambda: navigation.centroid_shift(a, b),
        lambda: navigation.corner_repeatability(a, b),
        lambda: navigation.orb_repeatability(a, b),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == same
    view = navigation.CameraView(intrinsics=INTRINSICS, camera_from_T=np.eye(3), camera_position_T_m=np.zeros(3))
    with pytest.raises(InputError, match=r"^images\[1\]: 9 x 8 .* of images\[0\]$"):
        navigation.feature_lifetime([a, b], [view, view])
    with pytest.raises(InputError, match=r"images: 1, views: 2: must be equally many"):
        navigation.feature_lifetime([a], [view, view])
    with pytest.raises(InputError, match=r"^body: 9 x 8"):
        navigation.limb_error(a, a, b > 0)
    with pytest.raises(InputError, match=r"image: holds NaN or infinity"):
        navigation.centroid_shift(a, a * np.nan)
    with pytest.raises(InputError, match=r"clean: 2 channels: must be 3"):
        navigation.centroid_shift(np.zeros((4, 4, 2)), a)
    with pytest.raises(InputError, match=r"clean: shape \(0, 4\) of float64"):
        navigation.centroid_shift(np.zeros((0, 4)), a)
    with pytest.raises(InputError, match=r"search_px = 2: must be from 3 to 64 px"):
        navigation.limb_error(a, a, a > 0, search_px=2)
    with pytest.raises(InputError, match=r"view.intrinsics: shape \(3,\)"):
        navigation.CameraView(intrinsics=np.ones(3), camera_from_T=np.eye(3), camera_position_T_m=np.zeros(3))
    with pytest.raises(InputError, match=r"view.camera_from_T: is no rotation"):
        navigation.CameraView(intrinsics=INTRINSICS, camera_from_T=np.ones(4), camera_position_T_m=np.zeros(3))
    matches = navigation.Matches(first_xy=np.ones((3, 2)), second_xy=np.ones((3, 2)))
    with pytest.raises(InputError, match=r"view.depth_m: is None"):
        navigation.match_precision(matches, view, view)
    with pytest.raises(InputError, match=r"tolerance_px = 0: must be above 0"):
        navigation.right_matches(matches, view, view, tolerance_px=0)
