"""Replay of flight images: the figures on images whose truth is known, and real frames where they are at hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault.fit import frames as fit_frames
from vbnfault.fit import replay as fit_replay
from vbnfault.scene.trajectory import load_trajectory

FRAMES = Path(__file__).resolve().parents[2] / "shared/data/flight/navcam"


@pytest.fixture(scope="module")
def frames() -> Path:
    """The real frames of the navigation camera, which are not part of the project; skips where they are absent."""
    if not (FRAMES / "poses.csv").is_file():
        pytest.skip(f"the flight images are not part of the project: no file {FRAMES / 'poses.csv'}")
    return FRAMES


def disc(x: float, y: float, radius: float = 40.0, size: int = 160) -> np.ndarray:
    """Return a textured disc of mean brightness 150 over a background of 8, with noise of 1 DN."""
    rng = np.random.default_rng(3)
    texture = ndimage.gaussian_filter(rng.normal(size=(2 * size, 2 * size)), 3.0)
    texture = 25 * texture / texture.std()
    row, column = np.indices((size, size)) + 0.5
    inside = np.clip(radius + 0.5 - np.hypot(column - x, row - y), 0, 1)
    moved = ndimage.shift(texture, (y - size / 2, x - size / 2), order=3, mode="wrap")[:size, :size]
    return np.clip(8 + inside * (142 + moved) + rng.normal(size=(size, size)), 0, 255).astype(np.float32)


def test_a_shift_is_found_and_undone() -> None:
    real, rendered = disc(83.3, 77.8), disc(80.0, 80.0)
    shift = fit_frames.shift_between(*map(fit_frames.look, (real, rendered)), search_px=8)
    assert shift == pytest.approx((3.3, -2.2), abs=0.15)
    aligned = fit_frames.look(ndimage.shift(rendered, shift[::-1], order=3, mode="nearest"))
    figures = fit_frames.compare(fit_frames.look(real), aligned, np.array([1.0, 0.0]))
    assert figures["iou"] > 0.985
    assert figures["rank"] > 0.95
    assert figures["limb_px"] <= 1.0
    for octave in ("power_8_16", "power_16_32"):
        assert figures[f"{octave} rendered"] == pytest.approx(figures[f"{octave} real"], rel=0.1)


def test_a_turned_and_larger_image_is_found() -> None:
    """Of 160 px of noise of 1 DN and texture of 25, the corners are found to a tenth of a pixel."""
    rendered = disc(80.0, 80.0)
    angle, scale = np.radians(0.6), 1.006
    turned = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    onto = np.column_stack([turned, np.array([1.4, -2.3]) + (np.eye(2) - turned) @ np.array([79.5, 79.5])])
    real = cv2.warpAffine(
        rendered, onto, rendered.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    looks = fit_frames.look(real), fit_frames.look(rendered)
    found = fit_frames.similarity_between(*looks, fit_frames.shift_between(*looks, search_px=8))
    corners = np.array([[40.0, 120.0, 80.0], [80.0, 80.0, 40.0], [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(found @ corners, onto @ corners, atol=0.1)


def test_a_mended_pose_moves_the_image_as_the_similarity() -> None:
    """A body of 2 km seen from 100 km: perspective differs by a fiftieth of what the scale and shifts move."""
    rng = np.random.default_rng(5)
    points = rng.uniform(-2e3, 2e3, (40, 3))
    camera_from_T = Rotation.from_rotvec([0.3, -0.2, 0.5])
    position = camera_from_T.inv().apply([0.0, 0.0, -1e5])
    pose = SimpleNamespace(camera_position_T_m=position, T_from_C=camera_from_T.inv().as_matrix())
    focal_px = 256 / np.tan(np.radians(2.5))

    def image(place: np.ndarray, turn: Rotation) -> np.ndarray:
        x, y, z = turn.apply(points - place).T
        return np.array([focal_px * x / z + 255.5, focal_px * y / z + 255.5])

    angle, scale = 0.008, 1.005
    turned = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    similarity = np.column_stack([turned, np.array([4.0, -6.0]) + (np.eye(2) - turned) @ np.array([255.5, 255.5])])
    mended, quaternion = fit_replay.mended_pose(pose, similarity, 5.0, (512, 512))
    before = image(position, camera_from_T)
    after = image(mended, Rotation.from_quat(quaternion, scalar_first=True))
    np.testing.assert_allclose(after, similarity[:, :2] @ before + similarity[:, 2:], atol=0.05)


def test_an_image_moves_by_whole_pixels_and_continues_as_its_mirror_image() -> None:
    image = np.arange(20.0).reshape(4, 5)
    moved = fit_frames.shifted(image, (2, -1))
    assert np.array_equal(moved[:3, 2:], image[1:, :3])
    assert np.array_equal(moved[3, 2:], image[3, :3])
    assert np.array_equal(moved[:3, :2], image[1:, 1::-1])
    assert np.array_equal(fit_frames.shifted(image, (0, 0)), image)


def test_raw_images_are_stretched_by_a_root_and_halved() -> None:
    display = fit_replay.Display(bias_dn=100, top_dn=4195, stretch=0.5)
    raw = np.full((12, 12), 4200, dtype=np.uint16)  # above the top code
    raw[6:] = 104
    # 255 √(4 / 4095) = 7.97; next to the edge a neighbour weighs 0.022 in a column, 0.026 in a row
    for image, leak in ((raw, 0.022), (raw.T, 0.026)):
        edge = [round(255 * part + 8 * (1 - part)) for part in (1 - leak, leak)]
        levels = display.developed(image, 2)
        lines = levels if image is raw else levels.T
        assert lines.tolist() == [[value] * 6 for value in (255, 255, *edge, 8, 8)]
    # the mean of -2 and 12 DN is 5, of 9 levels; stretched first, they are levels 0 and 14
    raw[0::2], raw[1::2] = 98, 112
    assert display.developed(raw, 2)[2:-2].tolist() == [[7] * 6] * 2
    # a black 500 DN above the bias: 255 √(3594 / 4095) = 238.9, but the largest number is white
    raw[:] = 4194
    assert (display.developed(raw, 1, -500.0) == 239).all()
    assert (display.developed(raw + 1, 1, -500.0) == 255).all()
    assert display.fraction(display.developed(np.array([[1124]]), 1)[0, 0]) == pytest.approx(0.25, abs=0.002)


def test_an_overexposed_frame_is_metered_on_what_is_not_yet_white() -> None:
    body = disc(80, 80)
    real = fit_frames.look(body)
    assert fit_replay.metered_on(real) == (50.0, np.median(body[real.lit]))
    brighter = 1.75 * body  # its mean is 262
    real = fit_frames.look(np.minimum(brighter, 255))
    percentile, brightness = fit_replay.metered_on(real)
    assert 10 <= percentile <= 40
    assert brightness == pytest.approx(np.percentile(brighter[real.lit], percentile))
    assert brightness < 250 <= np.percentile(brighter[real.lit], percentile + 10)


def test_a_larger_body_has_a_smaller_overlap_and_a_limb_farther_out() -> None:
    a, b = fit_frames.look(disc(80, 80, 40)), fit_frames.look(disc(80, 80, 44))
    figures = fit_frames.compare(a, b, np.array([0.0, -1.0]))
    assert figures["iou"] == pytest.approx((40 / 44) ** 2, abs=0.01)
    assert figures["limb_px"] == pytest.approx(4, abs=0.5)


def test_the_sky_tells_background_glow_columns_and_tracks() -> None:
    image = disc(80, 80)
    rng = np.random.default_rng(5)
    row, column = np.indices(image.shape)
    far = np.hypot(column - 80, row - 80)
    image += 20 * np.exp(-np.clip(far - 40, 0, None) / 20) * (far > 41)
    image += 0.8 * rng.normal(size=160)[None]
    image[20:24, 10:13] += 60
    image[140, 120:131] += 40
    one = fit_frames.look(image)
    figures = fit_frames.sky_figures(one, one.lit)
    scale = one.bright - one.background
    assert figures["glow_0.5"] > 1.5 * figures["glow_2"] > figures["sky"] * 0.5
    assert figures["column"] * scale == pytest.approx(0.8, rel=0.35)
    assert figures["noise"] * scale == pytest.approx(1.0, rel=0.25)
    assert figures["tracks"] == 2


def test_a_frame_that_the_body_fills_tells_nothing_of_the_sky() -> None:
    full = fit_frames.look(np.random.default_rng(2).uniform(90, 110, (80, 80)))
    assert not full.sky.any()
    assert full.clipped
    assert np.isnan([*fit_frames.sky_figures(full, full.lit).values()]).all()


@pytest.mark.parametrize(
    ("power", "table"),
    [
        (2, ((0.7, 1.0), (1.25, 1.0), (1.6, 1.4), (2.2, 1.4), (3.0, 1.4), (9.0, 2.5))),
        (1, ((0.7, 1.0), (1.1, 1.0), (1.25, 1.4), (1.7, 1.4), (2.2, 2.5), (3.0, 2.5))),
    ],
    ids=["readout", "photons"],
)
def test_a_noisy_frame_is_rendered_with_the_higher_gain(
    power: int, table: tuple[tuple[float, float], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Variance in digital numbers goes with the gain's square, or with the gain itself where it is of photons."""
    body, rng = disc(80, 80), np.random.default_rng(3)

    def image(variance: float) -> np.ndarray:
        sky = 8 + variance**0.5 * rng.normal(size=body.shape)
        sky += np.arange(len(body)) % 3 - 1  # columns are no noise
        return np.where(body > 40, body, sky)

    def rendered(self: fit_replay.Replay, row: int, trajectory: Any, settings: dict[str, float]) -> np.ndarray:
        tried[settings["gain"]] = image(settings["gain"] ** power)
        return tried[settings["gain"]]

    monkeypatch.setattr(fit_replay.Replay, "_raw", rendered)
    replay = object.__new__(fit_replay.Replay)
    replay.display = fit_replay.Display(bias_dn=0, top_dn=255, stretch=1.0, step=1e-3)
    for variance, gain in table:
        one, plain = fit_frames.look(image(variance)), image(1.0)
        # of 19,000 differences, each with two neighbours, the variance has a deviation of 1.3 %; spots of 4 levels
        # are left out, which cuts the tails of strong noise
        assert variance > 1 or fit_replay.noise_variance(one, 1.0) == pytest.approx(variance, rel=4 * 0.013)
        for gains, nearest in (((1.0, 1.4, 2.5), gain), ((1.0,), 1.0)):
            replay.gains, tried = gains, {1.0: plain}
            found, raw = replay._nearest_gain(0, None, one, plain, 1, {})  # type: ignore[arg-type]
            assert found == nearest
            assert raw is tried[nearest]
            assert len(tried) == 1 or variance > 1.15  # noise as of the first gain costs no rendering


def test_the_noise_of_a_stretched_frame_is_that_of_its_light() -> None:
    body, rng = disc(80, 80), np.random.default_rng(4)
    noise = rng.normal(0, 3.0, body.shape)
    variances = []
    for black in (0.0, 40.0):
        light = np.where(body > 40, 2000.0, 60.0 + black + noise)
        variances.append(fit_replay.noise_variance(fit_frames.look(np.sqrt(light)), 0.5))
    # as above; levels are not rounded here
    assert variances == pytest.approx([9.0, 9.0], rel=4 * 0.013)


def test_the_black_of_a_frame_is_that_of_its_sky() -> None:
    body, display = disc(80, 80), fit_replay.Display(bias_dn=100, top_dn=4195, stretch=0.5)
    noise = np.random.default_rng(4).normal(size=(2, *body.shape))
    real, rendered = (
        fit_frames.look(np.where(body > 40, body, 255 * np.sqrt(sky_dn / 4095) + 0.6 * grain))
        for sky_dn, grain in zip((5.0, 3.8), noise, strict=True)
    )
    # of 81 pixels, a mean of a level of 9 has a deviation of 0.07, or 0.08 DN, and the median of many far less
    assert display.black_excess_dn(real, rendered) == pytest.approx(1.2, abs=0.04)
    assert display.black_excess_dn(rendered, real) == pytest.approx(-1.2, abs=0.04)
    bright = fit_frames.look(np.where(body > 40, body, 20.0))  # smear or glow, and no black
    assert display.black_excess_dn(bright, rendered) == 0


def test_the_black_of_a_clipped_frame_leaves_as_much_of_the_image_dark() -> None:
    display = fit_replay.Display(bias_dn=100, top_dn=4195, stretch=0.5)
    row, column = np.indices((160, 160)) + 0.5
    out = np.hypot(column - 80, row - 80) - 40
    raw = np.where(out < 0, 2100.0, 100 + 60 * np.exp(-np.clip(out, 0, None) / 30))
    real, rendered = (fit_frames.look(display.developed(raw, 1, black)) for black in (-20.0, 0.0))
    assert 0.3 < (real.image == 0).mean() < 0.8
    # levels are whole numbers, of which one is 2.2 DN wide at 20 DN
    assert display.black_excess_dn(real, rendered) == pytest.approx(-20, abs=1.1)


@pytest.mark.parametrize(("stretch", "unit"), [(1.0, 1e-3), (0.5, 5e-4)])
def test_smear_is_no_body_and_tells_the_exposure(stretch: float, unit: float) -> None:
    """A column has 80 px of the disc at most; each row of it and of its sky gets a part of the sum."""
    body = (disc(80, 80) / 255) ** (1 / stretch)
    sums = np.where(body > (40 / 255) ** (1 / stretch), body, 0).sum(axis=0)
    below = np.arange(160)[:, None] >= 80
    still = fit_frames.look(disc(80, 80))
    assert not still.smeared
    for above_row, below_row in ((2 * unit, 2 * unit), (4 * unit, 0.8 * unit)):
        light = body + sums * np.where(below, below_row, above_row)
        one = fit_frames.look(255 * np.clip(light, 0, 1) ** stretch)
        assert one.smeared
        assert (one.lit & still.lit).sum() / (one.lit | still.lit).sum() > 0.98
        # the light of the body has its smear, too: of 80 px, as much again as 80 times the fraction
        own = fit_replay.smear(one, stretch) * (1 + 80 * 0.5 * (above_row + below_row))
        assert own == pytest.approx(0.5 * (above_row + below_row), rel=0.1)


def test_centre_and_limb_of_the_body_lie_where_the_table_says(frames: Path, real_shape: Path) -> None:
    """Projected by the documented convention, the shape covers the frame's lit body, within the labels' 7 px."""
    from vbnfault.body import load_body

    body, table = load_body(real_shape), load_trajectory(str(frames / "poses.csv"))
    focal_px = 256 / np.tan(np.radians(2.5))
    for k in (4, 12, 20):  # nearly full discs
        pose = table.pose(k)
        seen = (body.vertices_m - pose.camera_position_T_m) @ pose.T_from_C
        xy = seen[:, :2] / seen[:, 2:] * focal_px + 256
        lit = fit_frames.look(fit_frames.read_frame(frames, table.name[k])).lit
        y, x = np.nonzero(lit)
        sun_C = pose.T_from_C.T @ pose.sun_direction_T
        towards = sun_C[:2] / np.linalg.norm(sun_C[:2])
        # the bright limb, along the Sun's direction in the image, and the extent across it
        limb = (np.stack([x, y], axis=1) + 0.5) @ towards
        assert np.percentile(limb, 99.9) == pytest.approx((xy @ towards).max(), abs=9)
        across = np.array([-towards[1], towards[0]])
        width = np.ptp((np.stack([x, y], axis=1) + 0.5) @ across)
        assert width == pytest.approx(np.ptp(xy @ across), rel=0.08)
        assert ((xy.min(axis=0) > -8) & (xy.max(axis=0) < 520)).all()


def test_a_replay_of_real_frames_agrees(frames: Path, real_shape: Path) -> None:
    """At a quarter of the size; the floors leave 0.03 to what was reached: IoU 0.945 to 0.96, rank 0.83."""
    table, row = load_trajectory(str(frames / "poses.csv")), 12
    values = {"body.shape": str(real_shape), "patch.max_triangles": 100_000}
    values |= {"camera.width_px": 256, "camera.height_px": 256, "camera.fov_deg": 5.0}
    frame = fit_frames.read_frame(frames, table.name[row])
    small = cv2.resize(frame, (128, 128), interpolation=cv2.INTER_AREA)
    pair = fit_replay.Replay(vbnfault.load_scene("rosetta67p", values), table, mendings=1).pair(row, small)
    assert pair.figures["iou"] > 0.915
    assert pair.figures["rank"] > 0.8
    assert pair.figures["limb_px"] < 2
