"""Bodies of few pixels: their light against closed forms and larger images, at every size, pointing and phase."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import REAL_SHAPE, render_threads
from test_render import NODES, sun
from test_render import scene as render_scene

from vbnfault import pipeline, render
from vbnfault.body import ellipsoid
from vbnfault.core.calibration import Calibration
from vbnfault.core.quantities import BODY, splat
from vbnfault.render.description import RenderInput, View

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from unresolved_body import RADIUS_M, poses, relative_light, scene

PIXEL_RAD = 3e-5
PIXELS = 96
AXES_M = ((500.0, 500.0, 500.0), (800.0, 300.0, 500.0))


@lru_cache
def surface(axes_m: tuple[float, ...] = AXES_M[0], wall: tuple[float, float] | None = None) -> render.TerrainMesh:
    """An ellipsoid, perhaps behind a wall of the camera's own spacecraft between two tangents to the right."""
    vertices, faces = ellipsoid(axes_m)
    vehicle = None
    if wall is not None:
        corners = np.array([[x, y, 1.0] for x in wall for y in (-1, 1)], np.float32)
        faces_of_wall = np.array([[0, 1, 3], [0, 3, 2]], np.int32)
        vehicle = render.Vehicle(corners, faces_of_wall, np.zeros(2, np.int32), np.zeros((1, len(NODES))))
    return render.TerrainMesh(vertices.astype(np.float32), faces, np.zeros(len(faces), bool), vehicle=vehicle)


def seen(width_px: float, phase_deg: float, shift_px: Any = (0.0, 0.0), **more: Any) -> RenderInput:
    """A Lambert body of 1 km, so many pixels wide, whose centre is `shift_px` from the middle of the frame."""
    distance = 2 * RADIUS_M / (width_px * PIXEL_RAD)
    x, y = np.array(shift_px) * PIXEL_RAD * distance
    a_view = View(
        position_L_m=np.array([-x, -y, -distance]),
        L_from_C=np.eye(3),
        intrinsics=np.array([1 / PIXEL_RAD, 1 / PIXEL_RAD, PIXELS / 2, PIXELS / 2]),
        width_px=PIXELS,
        height_px=PIXELS,
        **more,
    )
    phase = np.radians(phase_deg)
    return render_scene(a_view, sun(np.array([np.sin(phase), 0, -np.cos(phase)])))


def light_px(image: Any) -> float:
    """The sum of the radiance over the frame in the middle band."""
    return float(image.array[4].sum(dtype=np.float64))


@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 120.0, 150.0])
@pytest.mark.parametrize("width_px", [0.01, 0.3, 1.0, 7.0, 62.0])
def test_a_sphere_has_the_light_of_the_closed_form(width_px: float, phase_deg: float) -> None:
    """Lambert's sphere: L summed over pixels = (2/3) ρ E / π (π r²) (sin α + (π - α) cos α) / π."""
    a_scene = seen(width_px, phase_deg, (0.37, -2.21))
    alpha = np.radians(phase_deg)
    law = (np.sin(alpha) + (np.pi - alpha) * np.cos(alpha)) / np.pi
    want = 2 / 3 * 0.06 * a_scene.sun.irradiance_W_m2_nm[4] * (width_px / 2) ** 2 * law
    # noise of samples: 0.03 % to 0.2 %; at 62 pixels the camera, 1000 radii away, sees 0.1° less: 1 % of a crescent
    assert light_px(render.radiance(surface(), a_scene)) == pytest.approx(
        want, rel=0.004 if phase_deg < 150 else 0.012
    )


def test_the_light_of_an_ellipsoid_is_that_of_its_wide_image() -> None:
    """Of the axes 800, 300 and 500 m, 80 pixels wide, which the rays of the frame render."""
    body = surface(AXES_M[1])
    wide = light_px(render.radiance(body, seen(50.0, 40.0))) / 50.0**2
    for width in (0.02, 0.6, 5.0):
        assert light_px(render.radiance(body, seen(width, 40.0, (1.3, 0.4)))) / width**2 == pytest.approx(
            wide, rel=0.003
        )


def test_a_body_at_the_edge_of_the_frame_is_divided_between_both_sides() -> None:
    """Two frames side by side have the light of the whole body, that of both in the right proportion."""
    for width in (0.4, 40.0):
        whole = light_px(render.radiance(surface(), seen(width, 30.0)))
        for at in (-0.3, 0.2):
            parts = [
                light_px(render.radiance(surface(), seen(width, 30.0, (at * width + side * PIXELS / 2, 0.7))))
                for side in (1, -1)
            ]
            assert sum(parts) == pytest.approx(whole, rel=2e-3)
            assert all(part > 0 for part in parts)


def test_the_centre_of_light_is_that_of_the_body() -> None:
    """Bright pixels lie where the body is, and the light within pixels is known to a hundredth of the body."""
    image = render.radiance(surface(), seen(0.5, 0.0, (3.27, -8.61)))
    assert image.fine is not None
    assert image.array[4].max() == image.array[4, PIXELS // 2 - 9, PIXELS // 2 + 3]
    weights = image.fine.power[4].astype(np.float64)
    centre = (image.fine.slopes * weights[:, None]).sum(axis=0) / weights.sum() / PIXEL_RAD
    np.testing.assert_allclose(centre, [3.27, -8.61], atol=0.005)
    shape = (PIXELS, PIXELS)
    spread = splat(image.fine.slopes / PIXEL_RAD + PIXELS / 2, weights, shape)
    assert spread.sum() == pytest.approx(weights.sum(), rel=1e-5)
    x, y = (spread.sum(axis=axis) @ (np.arange(PIXELS) + 0.5) / spread.sum() - PIXELS / 2 for axis in (0, 1))
    np.testing.assert_allclose([x, y], [3.27, -8.61], atol=0.005)


def test_distortion_leaves_the_brightness_of_a_body_as_it_is() -> None:
    """Each pixel has the light that its own rays have, though pixels of the close-up lie across its border."""
    focal_px, middle_px = 1 / PIXEL_RAD, PIXELS / 2
    distorted = Calibration(
        width_px=PIXELS,
        height_px=PIXELS,
        fx=focal_px,
        fy=focal_px,
        cx=middle_px,
        cy=middle_px,
        coefficients=(-3e4,),
    )
    of = seen(60.0, 0.0, projection=distorted)
    assert render.close_up(surface(), of.view) is not None
    image, rays = render.radiance(surface(), of).array[4], render.direct(surface(), of).array[4]
    bright = rays > 0.6 * rays.max()
    assert bright.sum() > 1000
    assert np.abs(image[bright] / rays[bright] - 1).max() < 0.05


def test_defocus_spreads_the_light_and_keeps_it() -> None:
    """A blur circle of 4 pixels: radius = aperture / focus / pixel; the rms radius of a disc is r / √2."""
    blurred = seen(0.5, 20.0, (0.3, 0.1), aperture_radius_m=0.012, focus_distance_m=100.0)
    sharp = replace(blurred, view=replace(blurred.view, aperture_radius_m=0.0))
    first, second = (render.radiance(surface(), one) for one in (blurred, sharp))
    assert light_px(first) == pytest.approx(light_px(second), rel=1e-5)
    image = first.array[4].astype(np.float64)
    y, x = np.indices(image.shape) + 0.5 - PIXELS / 2 - np.array([0.1, 0.3])[:, None, None]
    rms = np.sqrt((image * (x**2 + y**2)).sum() / image.sum())
    # pixels and the body add 1/6 and 0.03 px²
    assert rms == pytest.approx(np.sqrt(4.0**2 / 2 + 1 / 6), rel=0.02)


def test_the_cameras_own_spacecraft_hides_the_body() -> None:
    """A wall up to the middle of the body takes half of its light, one before all of it takes all."""
    alone = light_px(render.radiance(surface(), seen(0.4, 0.0)))
    for wall, left in (((0.0, 1.0), 0.5), ((-1.0, 1.0), 0.0), ((0.01, 1.0), 1.0)):
        hidden = render.radiance(surface(wall=wall), seen(0.4, 0.0))
        # a column of the close-up's pixels across the middle: 1/128 of the light
        assert light_px(hidden) == pytest.approx(left * alone, abs=0.01 * alone)


@pytest.mark.parametrize(("width_px", "length_px"), [(0.02, 25.0), (0.5, 25.0), (0.05, 0.05), (0.6, 0.8)])
def test_a_part_of_the_spacecraft_below_a_pixel_has_the_light_of_its_area(
    width_px: float, length_px: float
) -> None:
    """A plate across the boresight, turned and moved: its radiance ρ E cos i / π times its area in pixels."""
    focal, distance = 60.0, 5.0
    intrinsics = np.array([focal, focal, PIXELS / 2, PIXELS / 2])
    a_view = replace(seen(1.0, 0.0).view, intrinsics=intrinsics, position_L_m=np.zeros(3))
    a_scene = replace(seen(1.0, 40.0), view=a_view)
    vertices, ground = ellipsoid(AXES_M[0])
    far = (vertices + np.array([0, 0, 1e7])).astype(np.float32)
    rng = np.random.default_rng(4)
    for turn, x, y in rng.uniform((0, -9, -9), (np.pi, 9, 9), (4, 3)):
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width_px / 2, length_px / 2]
        c, s = np.cos(turn), np.sin(turn)
        plate = (square @ [[c, s], [-s, c]] + [x, y]) * distance / focal
        corners = np.column_stack([plate, np.full(4, distance)]).astype(np.float32)
        faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
        vehicle = render.Vehicle(corners, faces, np.zeros(2, np.int32), np.full((1, len(NODES)), 0.5))
        image = render.radiance(
            render.TerrainMesh(far, ground, np.zeros(len(ground), bool), vehicle=vehicle), a_scene
        )
        body = render.radiance(render.TerrainMesh(far, ground, np.zeros(len(ground), bool)), a_scene)
        cosine = np.cos(np.radians(40))
        want = 0.5 * a_scene.sun.irradiance_W_m2_nm[4] * cosine / np.pi * width_px * length_px
        # the corners are rounded to float32: 2e-7 m of 1.7 mm and more
        assert light_px(image) - light_px(body) == pytest.approx(want, rel=2e-3)


def test_the_result_does_not_depend_on_threads() -> None:
    images = []
    for count in (1, 2):
        with render_threads(count):
            images.append(render.radiance(surface(), seen(0.7, 50.0, (0.2, 0.9))))
    np.testing.assert_array_equal(images[0].array, images[1].array)
    np.testing.assert_array_equal(images[0].fine.power, images[1].fine.power)  # type: ignore[union-attr]


# --- scenes --------------------------------------------------------------------------------------------------

pytestmark = pytest.mark.filterwarnings("ignore:body.shape = 'ellipsoid'")


@pytest.mark.parametrize("phase_deg", [37.0, 150.0])
@pytest.mark.parametrize("shape", ["", "67p"])
def test_a_scene_has_the_same_light_at_every_size(shape: str, phase_deg: float) -> None:
    """From a hundredth of a pixel past the change to the rays of the frame, of a sphere and of 67P."""
    if shape and not REAL_SHAPE.is_file():
        pytest.skip("the shape of 67P is not at hand")
    of = scene(shape=str(REAL_SHAPE) if shape else "")
    light = relative_light(of, (0.01, 0.5, 65.0), 2, phase_deg)
    # 150° of phase: the camera at 65 px is 450 radii away, and sees 1 % less of the crescent than one far away
    for values in light.values():
        np.testing.assert_allclose(values, 1, atol=0.01 if phase_deg < 90 else 0.03)


def test_a_lens_keeps_the_light_wherever_it_falls_within_pixels() -> None:
    """A Tessar's electrons and radiance from four pointings.

    They differ by a pixel of 0.16°, over which the phase of the body changes its light by 0.2 %.
    """
    of = scene(lens="tessar_50_f2p8", camera={"fov_deg": 20.0})
    session = pipeline.Session(of, poses=poses((0.05, 1.0), 4, 37.0, 2 * RADIUS_M, 20.0, 0.5))
    for first in (0, 4):
        sums = [session.frame(k).exposure.rate.merged.array.sum(dtype=np.float64) for k in range(first, first + 4)]
        sums_of_layer = [
            session.simulate(k).layers["radiance"].sum(dtype=np.float64) for k in range(first, first + 4)
        ]
        for values in (sums, sums_of_layer):
            assert np.ptp(values) / np.mean(values) < 4e-3


def test_the_truth_shows_a_body_below_a_pixel_in_one_pixel() -> None:
    """The pixel of its middle, with its distance and the normal of the middle, for a thin lens and a Tessar."""
    for lens in ("", "tessar_50_f2p8"):
        of = scene(lens=lens, dataset={"layers": ["clean", "semantic", "depth_m", "normal", "phase_deg"]})
        session = pipeline.Session(of, poses=poses((0.03, 0.9), 2, 37.0, 2 * RADIUS_M))
        for k in range(4):
            layers = session.simulate(k).layers
            (row,), (column,) = np.nonzero(layers["semantic"] == BODY)
            width, pixel = (0.03, 0.9)[k // 2], np.radians(0.5) / 128
            assert layers["depth_m"][row, column] == pytest.approx(2 * RADIUS_M / (width * pixel), rel=1e-3)
            np.testing.assert_allclose(layers["normal"][row, column], [0, 0, -1], atol=0.1)
            assert layers["phase_deg"][row, column] == pytest.approx(37, abs=0.1)
            assert np.isfinite(layers["depth_m"]).sum() == 1


def test_a_budget_of_noise_follows_the_close_up() -> None:
    """The light is that without a budget, and the noise that is told is that of the close-up, below the limit."""
    noisy = {"noise_fraction": 0.1, "max_samples_per_pixel": 256}
    table = poses((0.5,), 2, 37.0, 2 * RADIUS_M)
    plain, limited = (pipeline.Session(scene(render=more), poses=table) for more in ({}, noisy))
    for k in range(2):
        rendering = limited.frame(k).rendering
        light = rendering.light.rendered.array.sum(dtype=np.float64)
        assert light == pytest.approx(plain.frame(k).rendering.light.rendered.array.sum(dtype=np.float64), rel=1e-3)
        assert 0 < rendering.noise_fraction_p99 < 0.1


def test_a_body_that_is_wide_is_rendered_by_the_frame_alone() -> None:
    assert render.close_up(surface(), seen(65.0, 0.0).view) is None
    near = render.close_up(surface(), seen(60.0, 0.0).view)
    assert near is not None
    assert near.per_px == 4
    # behind the camera, and beside the frame
    turned = replace(seen(1.0, 0.0).view, L_from_C=np.diag([1.0, -1.0, -1.0]))
    assert render.close_up(surface(), turned) is None
    assert render.close_up(surface(), seen(1.0, 0.0, (PIXELS, 0.0)).view) is None
