"""Motion during an exposure: rates of poses, rolling shutter, blur against sub-frames, star trails, the store."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Called, ellipsoids_of
from poses_kit import columns_of, row
from scipy import ndimage
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault import render
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import BODY
from vbnfault.pipeline import motion
from vbnfault.pipeline.exposure import add_stars, meter
from vbnfault.pipeline.noise_budget import green_per_second
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import SampleSpec
from vbnfault.render.light import _TIME_STEPS
from vbnfault.scene import config
from vbnfault.scene.trajectory import as_trajectory
from vbnfault.world.sky import SkyFrame

RADIUS_M, DISTANCE_M, PX, FIELD_DEG = 100.0, 260.0, 64, 56.0
PIXEL_RAD = np.radians(FIELD_DEG) / PX
EXPOSURE_S = 0.008
MOTION = (*(f"velocity_{a}_T_m_s" for a in "xyz"), *(f"rate_{a}_C_rad_s" for a in "xyz"))
SCENE: dict[str, Any] = {
    "title": "moving",
    "body": {
        "shape": "ellipsoid",
        "name": "ball",
        "reflectance": 0.06,
        "semi_axes_m": [RADIUS_M] * 3,
        "density_kg_m3": 500.0,
        "rotation_period_h": 10.0,
        "pole_ra_deg": 0.0,
        "pole_dec_deg": 90.0,
        "prime_meridian_deg": 0.0,
    },
    "patch": {"facet_m": 1.0, "radius_m": 40.0, "boulders": False, "relief": 0.0, "max_triangles": 200_000},
    "camera": {"width_px": PX, "height_px": PX, "fov_deg": FIELD_DEG, "exposure_s": EXPOSURE_S},
    "render": {"bands": 2, "bounces": 0, "noise_fraction": 0.1},
    "sky": {"stars": "off"},
    "motion": {},
}


@pytest.fixture(scope="module", autouse=True)
def few_facets() -> Iterator[None]:
    """The ball has 20,000 facets: edges of 0.04 R leave its limb within 0.006 px."""
    with ellipsoids_of(5):
        yield


def spec_of(scene: dict[str, Any], velocity: Any = (0, 0, 0), rate: Any = (0, 0, 0)) -> SampleSpec:
    """Return the sample of a camera that looks at the ball, with a velocity in T and a rate in C."""
    values = dict(zip(MOTION, [*velocity, *rate], strict=True))
    table = row("a", (0.0, 0.0, DISTANCE_M), (0.8, 0.0, 0.6), **values)
    poses = columns_of([table]) | {name: [table[name]] for name in MOTION}
    return vbnfault.Session(config.parse_scene(scene, source="test"), poses=poses).spec(0)


# --- rates of poses -----------------------------------------------------------------------------------------------


def test_rates_are_given_or_those_from_frame_to_frame() -> None:
    """A camera that turns and flies evenly: the differences of its poses are its rates, at both ends, too."""
    rate, velocity = np.array([0.01, -0.02, 0.03]), np.array([1.0, -2.0, 3.0])
    time_s = np.array([0.0, 1.0, 1.5, 4.0, 5.0])
    T_from_C = [Rotation.from_rotvec(rate * t) for t in time_s]
    table = [row(f"{k}", (0.0, 0.0, 300.0) + velocity * t) for k, t in enumerate(time_s)]
    for values, turned in zip(table, T_from_C, strict=True):
        quaternion = turned.inv().as_quat(scalar_first=True)
        values |= dict(zip((f"camera_from_T_{a}" for a in "wxyz"), quaternion, strict=True))
    columns = {**columns_of(table), "time_s": time_s.tolist(), "sequence": ["a"] * 4 + ["b"]}
    found = as_trajectory(columns)
    for k in range(4):
        np.testing.assert_allclose(found.pose(k).velocity_T_m_s, velocity, rtol=1e-9)
        np.testing.assert_allclose(found.pose(k).rate_C_rad_s, rate, rtol=1e-7)
    assert not found.pose(4).velocity_T_m_s.any()  # a sequence of one frame
    given = {name: [float(k)] * 5 for k, name in enumerate(MOTION)}
    assert as_trajectory({**columns, **given}).pose(4).velocity_T_m_s.tolist() == [0, 1, 2]
    assert as_trajectory({**columns, **given}).pose(0).rate_C_rad_s.tolist() == [3, 4, 5]
    twice = as_trajectory({**columns_of(table), **given}).repeated(2)
    assert twice.pose(9).rate_C_rad_s.tolist() == [3, 4, 5]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({MOTION[1]: None}, r"columns are missing: velocity_y_T_m_s; must be there together with velocity_x_T_m_s"),
        ({MOTION[3]: 1000.0}, r"row 1: rate_x_C_rad_s = 1000.0: must be a number from -100 to 100"),
        ({MOTION[0]: "fast"}, r"row 1: velocity_x_T_m_s = 'fast': must be a number from -1000000 to 1000000"),
    ],
)
def test_wrong_rates_are_one_sentence(change: dict[str, Any], sentence: str) -> None:
    columns = columns_of([row("a", (0.0, 0.0, 300.0))]) | {name: [0.0] for name in MOTION}
    columns |= {name: [value] for name, value in change.items()}
    with pytest.raises(InputError, match=sentence):
        as_trajectory({name: values for name, values in columns.items() if values != [None]})


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"shutter": "rolling"}, 'shutter = "rolling": line_time_s = 0: must be above 0'),
        (
            {"line_time_s": 1e-4},
            'shutter = "global": line_time_s = 0.0001: must be left out, or shutter = "rolling"',
        ),
        ({"shutter": "rolling", "line_time_s": 2.0}, "motion.line_time_s = 2.0: must be a number from 0 to 1"),
    ],
)
def test_a_wrong_shutter_is_one_sentence(table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        config.parse_scene({**SCENE, "motion": table}, source="test")


# --- a shutter that rolls -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("direction", "later"), [("up", (0, 1)), ("down", (0, -1)), ("left", (1, 0)), ("right", (-1, 0))]
)
def test_a_rolling_shutter_sees_each_line_from_its_own_pose(direction: str, later: tuple[int, int]) -> None:
    """Truth is that of rays against the ball, from the pose at each line's time, to 0.05 px of the limb.

    Facets of up to 4 m lie up to 16 m² / 8R = 2 cm within the ball, and a pixel covers 4 m.
    """
    line_s = 2e-3
    camera = {**SCENE["camera"], "readout_directions": [direction]}
    moving = {**SCENE, "camera": camera, "motion": {"shutter": "rolling", "line_time_s": line_s}}
    velocity, rate = np.array([90.0, -60.0, 150.0]), np.array([0.3, -0.4, 1.2])
    spec = spec_of(moving, velocity, rate)
    pose = resolve(spec)
    truth = render_view(spec, pose).truth
    row_px, column_px = np.mgrid[0:PX, 0:PX] + 0.5
    time_s = line_s * ((column_px - PX / 2) * later[0] + (row_px - PX / 2) * later[1])
    towards = np.stack([(column_px - PX / 2), (row_px - PX / 2), np.full((PX, PX), PX / 2)], axis=-1)
    towards[..., :2] *= np.tan(np.radians(FIELD_DEG) / 2)
    assert spec.flown is not None
    turned = (
        Rotation.from_rotvec(time_s.reshape(-1, 1) * rate).apply(towards.reshape(-1, 3)) @ spec.flown.T_from_C.T
    )
    start = spec.flown.camera_position_T_m + time_s.reshape(-1, 1) * velocity
    turned /= np.linalg.norm(turned, axis=1)[:, None]
    along = -np.einsum("ni,ni->n", start, turned)
    apart = np.linalg.norm(start + along[:, None] * turned, axis=1).reshape(PX, PX)
    inside = RADIUS_M - apart
    clear = np.abs(inside) > 0.05 * DISTANCE_M * PIXEL_RAD
    assert clear.mean() > 0.98
    np.testing.assert_array_equal((truth.semantic == BODY)[clear], (inside > 0)[clear])
    hit = (inside > 5) & clear
    range_m = along.reshape(PX, PX) - np.sqrt(np.maximum(RADIUS_M**2 - apart**2, 0))
    depth_m = range_m * towards[..., 2] / np.linalg.norm(towards, axis=-1)
    np.testing.assert_allclose(truth.depth_m[hit], depth_m[hit], atol=0.05)
    still = render_view(spec_of({**SCENE, "camera": camera}), pose).truth
    assert ((truth.semantic == BODY) != (still.semantic == BODY)).mean() > 0.03  # the ball leans


# --- blur ---------------------------------------------------------------------------------------------------------


def brute_force(spec: SampleSpec, rendered: Any, count: int) -> Any:
    """Return the mean radiance of still sub-frames, with samples of their own."""
    middle, total = rendered.scene.view, 0.0
    for k in range(count):
        t = ((k + 0.5) / count - 0.5) * EXPOSURE_S
        view = replace(
            middle,
            position_L_m=middle.position_L_m + middle.motion.velocity_L_m_s * t,
            L_from_C=middle.L_from_C @ Rotation.from_rotvec(middle.motion.rate_C_rad_s * t).as_matrix(),
            motion=None,
        )
        total = total + render.direct(spec.terrain.surface, replace(rendered.scene, view=view, key=k)).array
    return total / count


@pytest.mark.parametrize("px", [1, 6])
@pytest.mark.parametrize("kind", ["turn", "sideways", "nearer"])
def test_blur_is_the_mean_of_sub_frames(kind: str, px: int) -> None:
    """In 99 % of the lit pixels off the limb, the error is below 0.3 of the sensor's noise.

    The limb is as sharp as the cells of a pixel, a quarter of it wide: an edge that crosses a cell by a fraction f
    of it, taken as a cell of grey f, is wrong by at most 1/8 of the cell, 3 % of a pixel's light. Where the limb
    hides the sky, 100 rays of a pixel, of which f cross it, have a standard error of sqrt(f (1 - f) / 100), 5 %,
    or less as they are stratified.
    """
    rad_s = px * PIXEL_RAD / EXPOSURE_S
    velocity, rate = {
        "turn": ((0, 0, 0), rad_s * np.array([0.6, -0.8, 0.3])),
        "sideways": (rad_s * (DISTANCE_M - RADIUS_M) * np.array([0.8, 0.6, 0.0]), (0, 0, 0)),
        "nearer": (rad_s * (DISTANCE_M - RADIUS_M) / 0.3 * np.array([0, 0, -1.0]), (0, 0, 0)),
    }[kind]
    spec = spec_of(SCENE, velocity, rate)
    pose = resolve(spec)
    rendered = render_view(spec, pose)
    moved = motion.move(spec, rendered, meter(spec, rendered)).light.rendered
    weights = green_per_second(spec) * EXPOSURE_S
    true, got, still = (
        np.einsum("b,byx->yx", weights, array)
        for array in (brute_force(spec, rendered, 48), moved.array, rendered.light.rendered.array)
    )
    noise = np.sqrt(np.maximum(true, 0) + spec.camera.detector.read_noise_e_rms**2)
    lit = true > 0.01 * spec.camera.detector.full_well_e
    error, unmoved = np.abs(got - true), np.abs(still - true)
    reach = 2 * (px // 2 + 2) + 1
    ball = rendered.truth.semantic == BODY
    limb = ndimage.maximum_filter(ball, reach) != ndimage.minimum_filter(ball, reach)
    assert (error < 0.3 * noise)[lit & ~limb].mean() >= 0.99
    assert error.max() < 0.08 * true.max()
    assert unmoved.max() > min(0.04 * px, 0.15) * true.max()
    assert got.sum() == pytest.approx(true.sum(), rel=2e-3)


def test_noisy_pixels_get_more_of_the_new_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the rays goes to all pixels that need some, and then all of them to those that stay noisy."""
    traced, direct = [], render.direct_in_cells

    def counted(surface: Any, scene: Any, weights: Any, cells: Any, samples: int, exposure_s: float = 0.0) -> Any:
        if exposure_s:
            traced.append((len(cells.pixel), samples))
        return direct(surface, scene, weights, cells, samples, exposure_s)

    bright = SCENE | {"body": SCENE["body"] | {"reflectance": 0.6}}
    for fraction in (0.02, 10.0):
        monkeypatch.undo()
        spec = spec_of(bright | {"render": SCENE["render"] | {"noise_fraction": fraction}}, velocity=(0, 500.0, 0))
        rendering = render_view(spec, resolve(spec))
        monkeypatch.setattr(render, "direct_in_cells", counted)
        motion.move(spec, rendering, meter(spec, rendering))
    (all_px, few), (noisy_px, many), (of_all_px, _), (fewer_px, _) = traced
    assert 0 < fewer_px < noisy_px < all_px == of_all_px
    assert many in (4 * few, 8 * few, 16 * few)


@pytest.mark.parametrize("samples", [n for n in _TIME_STEPS if n >= 64])
def test_times_and_places_of_samples_are_even_together(samples: int) -> None:
    """An edge covers a known fraction of a moving pixel: the distribution of a sum of three uniform numbers."""
    columns = 1 << (samples.bit_length() // 2)  # half the bits, rounded up: one bit less than the length
    k = np.arange(samples)
    rng = np.random.default_rng(samples)
    squares = {"lattice": 0.0, "random": 0.0}
    for px in (1, 5, 20):
        for _ in range(60):
            x, y = (k % columns + rng.random(samples)) / columns, (k // columns + rng.random(samples))
            y *= columns / samples
            edge, along = 2 * np.pi * rng.random(2)
            widths = np.abs([np.cos(edge), np.sin(edge), px * np.cos(along - edge)])
            at = (rng.random() - 0.5) * widths.sum()
            ends = [(1, at)]
            for width in widths:
                ends = [(sign * s, v + s * width / 2) for sign, v in ends for s in (1, -1)]
            covered = sum(sign * max(v, 0) ** 3 for sign, v in ends) / (6 * widths.prod())
            even = (k * _TIME_STEPS[samples] + rng.integers(samples)) % samples
            for name, order in (("lattice", even), ("random", rng.permutation(samples))):
                time = (order + rng.random(samples)) / samples - 0.5
                place = (x - 0.5) * np.cos(edge) + (y - 0.5) * np.sin(edge) + px * time * np.cos(along - edge)
                squares[name] += ((place < at).mean() - covered) ** 2
    # Where an edge cuts points that are even in three dimensions, they err as N^-2/3; with random times, as N^-1/2.
    # The ratio therefore falls as N^-1/6, from 0.71 at 64 samples; 180 errors give it to 8 %.
    assert squares["lattice"] ** 0.5 < 0.9 * (64 / samples) ** (1 / 6) * squares["random"] ** 0.5


def test_nothing_changes_without_motion() -> None:
    """A camera that stands still has the same bits as in a scene without `[motion]`."""
    tables = [SCENE, {name: table for name, table in SCENE.items() if name != "motion"}]
    one, other = (render_view(spec, resolve(spec)).light.rendered.array for spec in map(spec_of, tables))
    np.testing.assert_array_equal(one, other)


def test_a_star_leaves_a_trail_of_its_length_and_light() -> None:
    """A trail of L px has the variance of its star and L² / 12 along it, and the same light."""
    sky = {"stars": "on", "limiting_magnitude": 5.0, "sigma_px": 0.8}
    camera = {**SCENE["camera"], "width_px": 256, "height_px": 256, "fov_deg": 40.0}
    scene = {**SCENE, "sky": sky, "camera": camera}
    px_rad = np.radians(40.0) / 256
    length_px = 9.0
    rate = np.array([0.0, length_px * px_rad / EXPOSURE_S, 0.0])
    images = []
    for turn in (0 * rate, rate):
        spec = spec_of(scene, (1e-9, 0, 0), turn)
        # away from the ball
        flown = replace(spec.flown, T_from_C=spec.flown.T_from_C @ np.diag([1.0, -1.0, -1.0]))
        spec = replace(spec, flown=flown)
        pose = resolve(spec)
        rendered = render_view(spec, pose)
        exposure = meter(spec, rendered)
        starry = add_stars(spec, pose, rendered, exposure).light.rendered.array
        images.append((starry - exposure.light.rendered.array).sum(axis=0).astype(float))
    still, trail = images
    inner = still[30:-30, 30:-30]
    y, x = np.array(np.unravel_index(np.argmax(inner), inner.shape)) + 30
    window = np.s_[y - 6 : y + 7, x - 14 : x + 15]
    across = np.arange(-14, 15)

    def variance(image: Any) -> float:
        profile = image[window].sum(axis=0) / image[window].sum()
        return float(profile @ across**2 - (profile @ across) ** 2)

    assert trail[window].sum() == pytest.approx(still[window].sum(), rel=0.01)
    # the pixels of a pinhole are wider by 1 / cos² away from the boresight: at most 1 + tan²(20°) along a row
    stretch = 1 + ((x + 0.5 - 128) / 128 * np.tan(np.radians(20.0))) ** 2
    measured = np.sqrt(12 * (variance(trail) - variance(still)))
    assert measured == pytest.approx(length_px * stretch * px_rad * 128 / np.tan(np.radians(20.0)), abs=0.1)


def test_a_rolling_shutter_sees_stars_at_the_time_of_their_line() -> None:
    """Each star is where the camera of its own line sees it."""
    line_s, rate = np.array([0.0, 2e-4]), np.array([0.3, -0.5, 0.2])
    turn_per_px = line_s[:, None] * rate
    focal_px, width = 300.0, 200
    frame = SkyFrame(
        J_from_C=np.eye(3), intrinsics=np.array([focal_px, focal_px, 100, 100]), width_px=width, height_px=width
    )
    slopes = np.random.default_rng(1).uniform(-0.3, 0.3, (50, 2))
    stars = np.column_stack([slopes, np.ones(50)])
    found, _, _ = replace(frame, turn_per_px=turn_per_px).positions_px(stars)
    for star, (x, y) in zip(stars, found, strict=True):
        axes = Rotation.from_rotvec(rate * line_s[1] * (y - width / 2)).as_matrix()
        alone, _, _ = replace(frame, J_from_C=axes).positions_px(star[None])
        np.testing.assert_allclose(alone[0], [x, y], atol=1e-3)
    still, _, _ = frame.positions_px(stars)
    assert np.abs(found - still).max() > 3


def moved_and_brute(spec: SampleSpec, count: int) -> tuple[Any, Any, Any]:
    """Return the radiance of a moved frame, of its sub-frames by the whole renderer, and of the still one."""
    pose = resolve(spec)
    rendered = render_view(spec, pose)
    moved = motion.move(spec, rendered, meter(spec, rendered)).light.rendered.array
    camera_motion = rendered.scene.view.motion
    assert camera_motion is not None
    assert spec.flown is not None
    total = 0.0
    for k in range(count):
        t = ((k + 0.5) / count - 0.5) * EXPOSURE_S
        turn = Rotation.from_rotvec(camera_motion.rate_C_rad_s * t).as_matrix()
        still = replace(
            spec.flown,
            camera_position_T_m=spec.flown.camera_position_T_m + spec.flown.velocity_T_m_s * t,
            T_from_C=spec.flown.T_from_C @ turn,
            velocity_T_m_s=np.zeros(3),
            rate_C_rad_s=np.zeros(3),
        )
        frame = replace(spec, flown=still)
        total = total + render_view(frame, resolve(frame)).light.rendered.array
    return moved, total / count, rendered.light.rendered.array


def test_the_disc_of_the_sun_turns_with_the_sky() -> None:
    """Its trail has the light, the middle and the length of the mean of sub-frames."""
    fov_deg, length_px = 12.0, 8.0
    camera = {**SCENE["camera"], "fov_deg": fov_deg}
    rate = np.array([0.0, length_px * np.radians(fov_deg) / PX / EXPOSURE_S, 0.0])
    spec = spec_of({**SCENE, "camera": camera}, (0, 0, 0), rate)
    assert spec.flown is not None
    away = spec.flown.T_from_C @ np.diag([1.0, -1.0, -1.0])
    sun = np.array([0.01, 0.02, 1.0])
    flown = replace(spec.flown, T_from_C=away, sun_direction_T=sun / np.linalg.norm(sun), sun_distance_au=1.0)
    moved, true, still = moved_and_brute(replace(spec, flown=flown), 64)
    across = np.arange(PX)

    def figures(image: Any) -> tuple[float, float, float]:
        profile = image.sum(axis=(0, 1)) / image.sum()
        middle = float(profile @ across)
        return float(image.sum()), middle, float(profile @ (across - middle) ** 2)

    light, middle, variance = figures(moved)
    assert light == pytest.approx(figures(true)[0], rel=0.01)
    assert middle == pytest.approx(figures(true)[1], abs=0.05)
    # between pixels, light is interpolated, which adds f (1 - f) px² for fractions f of a pixel: at most 1/4
    assert -0.02 < variance - figures(true)[2] < 1 / 4
    assert variance - figures(still)[2] > 0.9 * length_px**2 / 12


def test_air_and_light_between_surfaces_move_with_the_ground() -> None:
    """New rays at limb and border see sunlight once; what air adds there is carried, so no dark border appears."""
    air = {"optical_depth": 0.2, "scale_height_m": 40.0}
    scene = {**SCENE, "body": {**SCENE["body"], "atmosphere": air}, "render": {**SCENE["render"], "bounces": 1}}
    rate = 4 * PIXEL_RAD / EXPOSURE_S * np.array([0.6, -0.8, 0.0])
    moved, true, _ = moved_and_brute(spec_of(scene, (0, 0, 0), rate), 8)
    assert moved.min() >= 0
    # the sub-frames are 0.5 px apart, an eighth of the path each
    assert np.abs(moved - true).max() < 0.15 * true.max()
    border = np.ones((PX, PX), bool)
    border[2:-2, 2:-2] = False
    assert moved[:, border].sum() == pytest.approx(true[:, border].sum(), rel=0.05)
    assert true[:, border].sum() > 0


def body_of_few_pixels(scene: dict[str, Any], velocity: Any = (0, 0, 0), rate: Any = (0, 0, 0)) -> SampleSpec:
    """Return the sample of a camera that looks at the ball from so far that it is 6 px wide."""
    values = dict(zip(MOTION, [*velocity, *rate], strict=True))
    table = row("a", (0.0, 0.0, 2000.0), (0.8, 0.0, 0.6), **values)
    poses = columns_of([table]) | {name: [table[name]] for name in MOTION}
    return vbnfault.Session(config.parse_scene(scene, source="test"), poses=poses).spec(0)


def test_a_body_of_few_pixels_keeps_its_light() -> None:
    spec = body_of_few_pixels(SCENE, (2e3, 0, 0))
    rendered = render_view(spec, resolve(spec))
    assert not rendered.shows_ground
    moved = motion.move(spec, rendered, meter(spec, rendered)).light.rendered.array
    assert moved.sum() == pytest.approx(rendered.light.rendered.array.sum(), rel=1e-4)


def test_a_body_of_few_pixels_is_blurred_as_its_sub_frames_are() -> None:
    px_s = 8 * PIXEL_RAD / EXPOSURE_S
    scene = {**SCENE, "render": {"bands": 2}}
    spec = body_of_few_pixels(scene, (800 * px_s, 0, 0), (0, 0.8 * px_s, 0.3 * px_s))
    moved, true, still = moved_and_brute(spec, 16)
    assert np.abs(still - true).max() > 0.3 * true.max()
    assert np.abs(moved - true).max() < 0.01 * true.max()


def test_lines_of_a_rolling_shutter_see_a_body_of_few_pixels_where_its_truth_is() -> None:
    line_s = 1e-4
    spec = body_of_few_pixels({**SCENE, "motion": {"shutter": "rolling", "line_time_s": line_s}})
    assert spec.flown is not None
    turned = spec.flown.T_from_C @ Rotation.from_rotvec([15 * PIXEL_RAD, 0, 0]).as_matrix()
    rate = np.array([1.0, 3.0, 0.0]) * PIXEL_RAD / (15 * line_s)
    spec = replace(spec, flown=replace(spec.flown, T_from_C=turned, rate_C_rad_s=rate))
    rendered = render_view(spec, resolve(spec))
    assert not rendered.shows_ground
    still = replace(spec, flown=replace(spec.flown, rate_C_rad_s=np.zeros(3)))
    lit, truth = rendered.light.rendered.array[0], rendered.truth.semantic == BODY
    before = render_view(still, resolve(still)).truth.semantic == BODY
    places = [ndimage.center_of_mass(image.astype(float)) for image in (lit > 0, truth, before)]
    assert np.hypot(*np.subtract(places[2], places[1])) > 2
    np.testing.assert_allclose(places[0], places[1], atol=0.4)


def test_a_monochrome_camera_moves() -> None:
    camera = {"detector": "rosetta_navcam", "width_px": PX, "height_px": PX, "fov_deg": FIELD_DEG}
    camera |= {"exposure_s": EXPOSURE_S}
    rate = 4 * PIXEL_RAD / EXPOSURE_S * np.array([0.6, -0.8, 0.0])
    moved, true, still = moved_and_brute(spec_of({**SCENE, "camera": camera}, (0, 0, 0), rate), 8)
    assert np.abs(moved - true).mean() < 0.2 * np.abs(still - true).mean()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"spacecraft": {"model": "default"}}, "spacecraft.model = 'default': does not apply beside"),
        ({"dataset": {"layers": ["point_T_m"]}}, "dataset.layers: 'point_T_m' is that of one pose"),
    ],
)
def test_what_does_not_go_with_motion_is_one_sentence(change: dict[str, Any], sentence: str) -> None:
    flight = {"kind": "approach", "frames": 2, "period_s": 60.0, "range_m": [3e3, 2e3]}
    rolling = {"shutter": "rolling", "line_time_s": 1e-5}
    table = {**SCENE, "motion": rolling, "trajectory": {"flight": [flight]}, **change}
    with pytest.raises(InputError, match=re.escape(sentence)):
        vbnfault.Session(config.parse_scene(table, source="test"))


def test_motion_needs_poses() -> None:
    session = vbnfault.Session(config.parse_scene(SCENE, source="test"))
    with pytest.raises(InputError, match=r"motion: needs velocities and rates, which poses of"):
        session.simulate(0)


# --- through the store --------------------------------------------------------------------------------------------


def test_a_store_holds_frames_in_motion(tmp_path: Path, call: Callable[..., Called]) -> None:
    """Three frames of a flight over the ball: built, verified, and taken again, with their rates."""
    import xarray

    names = ["body", "patch", "camera", "render", "sky"]
    poses = columns_of([row(f"{k}", (8.0 * k, 0.0, DISTANCE_M), (0.8, 0.0, 0.6)) for k in range(3)])
    lines = [",".join([*poses, "time_s"])]
    lines += [",".join([*(str(values[k]) for values in poses.values()), f"{k}"]) for k in range(3)]
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    tables = {**{name: SCENE[name] for name in names}, "trajectory": {"file": str(tmp_path / "poses.csv")}}
    scene = config.parse_scene(
        {**SCENE, **tables, "faults": {"dust_on_optics": {}}, "dataset": {"layers": ["clean", "scene_radiance"]}},
        source="test",
    )
    vbnfault.build(scene, tmp_path / "moving.zarr")
    assert call("verify", tmp_path / "moving.zarr").code == 0
    data = xarray.open_zarr(tmp_path / "moving.zarr")
    np.testing.assert_allclose(data["velocity_T_m_s"].values, [[8, 0, 0]] * 3, atol=1e-9)
    assert data["rate_C_rad_s"].attrs["units"] == "rad s-1"
    sample = vbnfault.simulate(scene, 1)
    np.testing.assert_array_equal(sample.layers["clean"], data["clean"].values[1])
    changed = scene.model_copy(update={"camera": scene.camera.model_copy(update={"exposure_s": 0.5})})
    with pytest.raises(InputError, match=r"camera.exposure_s .*a retake keeps"):
        vbnfault.retake(tmp_path / "moving.zarr", changed, tmp_path / "again.zarr")
    still = scene.model_copy(update={"motion": None})
    assert (vbnfault.simulate(still, 1).layers["clean"] != sample.layers["clean"]).any()
