"""Moving points out of focus against closed forms, and against points of the test's own thrown into the figure."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from vbnfault.lens import RealLens, load_lens, parse_lens, scaled_to_field
from vbnfault.lens.image_frame import ImageFrame
from vbnfault.lens.streaks import Streaks, drawn, inside, pupil_support

F64 = NDArray[np.float64]
SHAPE = (90, 120)


def streak(
    x: Any, y: Any, *, dx: Any = 0.0, dy: Any = 0.0, radius: Any = 0.3, support: F64 | None = None
) -> Streaks:
    """One point, or several where the arguments are lists."""
    x, y, dx, dy, radius = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(v, float)) for v in (x, y, dx, dy, radius))
    )
    depth = np.full(len(x), 50.0)
    return Streaks(x_px=x, y_px=y, dx_px=dx, dy_px=dy, radius_px=radius, depth_m=depth, support=support)


def light(points: Streaks, shape: tuple[int, int] = SHAPE, **more: Any) -> F64:
    return drawn(points, np.ones((1, len(points))), shape, **more)[0]


def moments(image: F64) -> tuple[F64, F64]:
    """Middle and covariance of an image, in x and y."""
    y, x = np.indices(image.shape) + 0.5
    middle = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    away = np.stack([x - middle[0], y - middle[1]])
    return middle, np.einsum("iyx,jyx,yx->ij", away, away, image) / image.sum()


@pytest.mark.parametrize("radius", [0.3, 1.0, 4.0, 20.0])
@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.4, 0.1), (12.0, -5.0), (-3.0, 30.0), (0.0, 17.0)])
def test_energy_position_and_length(radius: float, dx: float, dy: float) -> None:
    """A line of the length L has L²/12 along itself, a disc R²/4 along each axis, and a pixel 1/12."""
    image = light(streak(61.37, 44.81, dx=dx, dy=dy, radius=radius))
    assert image.sum() == pytest.approx(1, abs=1e-12)
    assert image.min() >= 0
    middle, spread = moments(image)
    # A figure narrower than a pixel may lie in one pixel, whose middle is up to half a pixel away, with no variance
    # at all. Across a wider one the errors of the pixels at its edge cancel.
    small = np.hypot(max(abs(dx), 2 * radius), max(abs(dy), 2 * radius)) < 4
    narrow = 2 * radius < 3
    np.testing.assert_allclose(middle, [61.37, 44.81], atol=0.5 if narrow else 0.04)
    expected = np.array([[dx * dx, dx * dy], [dx * dy, dy * dy]]) / 12 + np.eye(2) * (radius**2 / 4 + 1 / 12)
    np.testing.assert_allclose(
        spread, expected, atol=0.15 if small or narrow else 0.02 * radius**2 + 0.1, rtol=0.01
    )
    length = np.sqrt(12 * np.linalg.eigvalsh(spread - np.eye(2) * (radius**2 / 4 + 1 / 12)).clip(0)[-1])
    if np.hypot(dx, dy) > 2 * radius:
        assert length == pytest.approx(np.hypot(dx, dy), rel=0.02)


def test_a_disc_is_even_inside_and_a_line_along_its_length() -> None:
    disc = light(streak(60.0, 45.0, radius=20.0))
    y, x = np.indices(SHAPE) + 0.5
    far = np.hypot(x - 60, y - 45)
    # what the 2 × 2 points of the pixels at the rim get wrong scales all: the rim has 2π/R of the area
    np.testing.assert_allclose(disc[far < 19], 1 / (np.pi * 400), rtol=2e-3)
    assert not disc[far > 21].any()
    line = light(streak(60.0, 45.5, dx=40.0, radius=0.3))
    # the rounded ends hold a little less than a line's would
    np.testing.assert_allclose(line[45, 42:78], 1 / 40, rtol=1e-3)
    assert line[45, :39].sum() == line[45, 82:].sum() == 0
    swept = light(streak(60.0, 45.0, dx=24.0, radius=10.0))
    # in the middle the whole disc has passed: 2 √(R² - t²) / (L π R²)
    np.testing.assert_allclose(swept[45, 59:61], 2 * 10 / (24 * np.pi * 100), rtol=5e-3)


def test_light_past_the_edges_is_lost_and_no_more() -> None:
    points = streak([0.0, -30.0, 60.0, 500.0], [40.0, 20.0, 45.0, 20.0], dx=[20.0, 10.0, 4000.0, 0.0], radius=0.4)
    images = [light(points.select(np.array([k]))) for k in range(4)]
    # half of the first, none of the second, 120 of 4000 px of the third, in which its ends are a pixel
    assert images[0].sum() == pytest.approx(0.5, abs=0.4 / 20)
    assert not images[1].any()
    assert images[2].sum() == pytest.approx(120 / 4000, rel=1e-3)
    assert not images[3].any()
    first, last = inside(points, SHAPE)
    assert (last > first).tolist() == [True, False, True, False]


def test_all_at_once_are_the_sum_of_each() -> None:
    rng = np.random.default_rng(5)
    n = 60
    points = streak(
        rng.uniform(-10, 130, n),
        rng.uniform(-10, 100, n),
        dx=rng.normal(0, 15, n),
        dy=rng.normal(0, 15, n),
        radius=rng.uniform(0.1, 6, n),
    )
    weights = rng.uniform(0, 1, (2, n))
    whole = drawn(points, weights, SHAPE)
    each = [drawn(points.select(np.array([k])), weights[:, k : k + 1], SHAPE) for k in range(n)]
    np.testing.assert_allclose(whole, np.sum(each, axis=0), atol=1e-12)
    depth = np.where(np.arange(SHAPE[1]) < 60, 10.0, np.inf) * np.ones((SHAPE[0], 1))
    hidden = drawn(points, weights, SHAPE, depth)
    np.testing.assert_allclose(hidden[..., 60:], whole[..., 60:], atol=1e-12)
    assert not hidden[..., :60].any()


def thrown(points: Streaks, count: int = 400_000) -> F64:
    """The image of one point by random positions on its line and in its figure."""
    rng = np.random.default_rng(1)
    along = rng.uniform(-0.5, 0.5, count)
    x, y = rng.uniform(-2, 2, (2, count)) * points.radius_px
    if points.support is None:
        keep = np.hypot(x, y) < points.radius_px
    else:
        turn = 2 * np.pi * np.arange(points.support.shape[1]) / points.support.shape[1]
        keep = np.all(
            [
                x * np.cos(a) + y * np.sin(a) < h * points.radius_px
                for a, h in zip(turn, points.support[0], strict=True)
            ],
            axis=0,
        )
    x, y = (x + points.x_px + along * points.dx_px)[keep], (y + points.y_px + along * points.dy_px)[keep]
    return np.histogram2d(y, x, bins=SHAPE, range=[[0, SHAPE[0]], [0, SHAPE[1]]])[0] / keep.sum()


@pytest.mark.parametrize(
    ("radius", "dx", "dy", "sides"),
    [(7.0, 9.0, 4.0, 0), (2.0, -3.0, 14.0, 0), (9.0, 12.0, 3.0, 5), (9.0, 0.0, 0.0, 6)],
)
def test_random_points_give_the_same_image(radius: float, dx: float, dy: float, sides: int) -> None:
    support = None
    if sides:
        turn = 2 * np.pi * np.arange(48) / 48
        corners = 2 * np.pi * (np.arange(sides) + 0.2) / sides
        support = np.cos(turn[:, None] - corners).max(axis=1)[None]
    points = streak(58.3, 41.6, dx=dx, dy=dy, radius=radius, support=support)
    found, expected = light(points), thrown(points)
    # both deviate: the throws by their number, pixels at an edge by the points within them
    assert np.abs(found - expected).sum() < 0.08
    assert found.sum() == pytest.approx(1, abs=1e-12)


BLADES = """
surface = [
  { stop = true, thickness_mm = 0.0, diameter_mm = 20.0, blades = 6, rotation_deg = 30.0 },
  { radius_mm = 100.0, thickness_mm = 4.0, nd = 1.5, vd = 60.0, diameter_mm = 30.0 },
  { radius_mm = -100.0, diameter_mm = 30.0 },
]
"""


NEAR_M = np.ones(1)  # of points before the focus


def frame_of(prescription: Any) -> ImageFrame:
    lens = scaled_to_field(prescription, 40.0, 6.4)
    real = RealLens(prescription=lens, width_px=64, height_px=64, pixel_pitch_um=100.0)
    return ImageFrame(lens=real, width_px=64, height_px=64, pixel_pitch_um=100.0)


def area(support: F64) -> F64:
    """Area of the polygons of support values over that of the disc with the radius 1."""
    n = support.shape[1]
    turn = 2 * np.pi / n
    following = np.roll(support, -1, axis=1)
    previous = np.roll(support, 1, axis=1)
    side = (following + previous - 2 * support * np.cos(turn)) / np.sin(turn)
    return np.asarray((support * side).sum(axis=1) / 2 / np.pi)


def test_blades_and_rims_cut_the_figure() -> None:
    bladed = pupil_support(frame_of(parse_lens(tomllib.loads(BLADES), source="b.toml")), np.zeros((1, 2)), NEAR_M)
    assert bladed is not None
    # a hexagon of the area π R²: its corners at R √(2π / (3 √3)), the first at 30 degrees
    corner = np.sqrt(2 * np.pi / (3 * np.sqrt(3)))
    normal = 2 * np.pi * np.arange(48) / 48
    expected = corner * np.cos(normal[:, None] - np.pi / 3 * (np.arange(6) + 0.5)).max(axis=1)
    np.testing.assert_allclose(bladed[0], expected, rtol=5e-3)
    assert area(bladed)[0] == pytest.approx(1, rel=0.01)
    frame = frame_of(load_lens("biotar_100_f1p4"))
    edge = frame.slopes(np.array([64.0]), np.array([32.0]))[0][0, 0]
    slopes = np.array([[0.0, 0.0], [edge, 0.0], [0.0, edge]])
    round_, right, below = (v[None] for v in pupil_support(frame, slopes, NEAR_M))  # type: ignore[union-attr]
    np.testing.assert_allclose(round_, 1, rtol=2e-3)
    passes = frame.lens.pupil_area_mm2([edge])[0] / frame.lens.pupil_area_mm2([0.0])[0]
    assert passes < 0.8  # the lens vignettes there
    # the nearest of the 33 field angles of the table
    assert area(right)[0] == pytest.approx(passes, rel=0.05)
    # narrower along the radius than across it; below the axis it is turned by a right angle
    assert right[0, 0] + right[0, 24] < 0.8 * (right[0, 12] + right[0, 36])
    np.testing.assert_allclose(np.roll(right, 12, axis=1), below, rtol=0.01)


def test_points_beyond_the_focus_draw_the_pupil_turned_by_half_a_turn() -> None:
    """A ray at P of the pupil of a thin lens ends P (1 - s/v) off the image (sensor at s, image at v)."""
    pentagon = parse_lens(tomllib.loads(BLADES.replace("blades = 6", "blades = 5")), source="b.toml")
    frame = frame_of(pentagon)
    frame = replace(frame, lens=replace(frame.lens, focus_distance_m=5.0))  # type: ignore[type-var]
    near, far = pupil_support(frame, np.zeros((2, 2)), np.array([2.0, 20.0]))  # type: ignore[misc]
    first = round(frame.lens.real.prescription.surfaces[pentagon.stop].rotation_deg / 7.5)  # type: ignore[union-attr]
    assert near[first] / near[first - 24] == pytest.approx(1 / np.cos(np.pi / 5), rel=0.01)  # corner over edge
    np.testing.assert_allclose(far, np.roll(near, 24), rtol=1e-9)


def test_an_ideal_lens_draws_discs() -> None:
    from vbnfault.lens import ThinLens

    thin = ImageFrame(
        lens=ThinLens(focal_length_mm=10.0, f_number=2.0), width_px=8, height_px=8, pixel_pitch_um=10.0
    )
    assert pupil_support(thin, np.zeros((3, 2)), NEAR_M) is None
    points = streak([10.0], [10.0], radius=3.0)
    moved = replace(points, x_px=points.x_px + 2).moved(1.0, -3.0)
    assert (moved.x_px[0], moved.y_px[0]) == (13.0, 7.0)
