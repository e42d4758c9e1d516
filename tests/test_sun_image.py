"""The Sun's direct image has its power in pixels of any size, with any number of rays."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from test_render import UP, join, plane, scene, sun, view

from vbnfault import render
from vbnfault.camera import Camera
from vbnfault.core import frames, spectra
from vbnfault.core.quantities import SUN, Radiance, SunInView
from vbnfault.core.sundisc import Pinhole, add_mean, pixel_sums
from vbnfault.detector import ThreeColourDetector
from vbnfault.lens import RealLens, ThinLens, load_lens
from vbnfault.render.description import Sunlight, View


@pytest.fixture(scope="module")
def surface() -> render.TerrainMesh:
    return join(plane(1.0))


def looking(light: Sunlight, width: int, fov_deg: float, offset_deg: tuple[float, float]) -> View:
    """A camera 20 m above the ground that sees the Sun at an offset from its boresight."""
    axes = frames.L_from_C(light.direction_L, *offset_deg, 17.0)
    return dataclasses.replace(view(20 * UP, UP, width=width, fov_deg=fov_deg), L_from_C=axes)


def power(radiance: np.ndarray, a_view: View) -> np.ndarray:
    """∫ L cos θ dω of the pixels, float64[band]: dω cos θ = cos⁴θ / f² a pixel."""
    fx, _, cx, cy = a_view.intrinsics
    y, x = np.mgrid[: a_view.height_px, : a_view.width_px] + 0.5
    cos4 = (1 + ((x - cx) ** 2 + (y - cy) ** 2) / fx**2) ** -2
    return np.asarray((radiance.astype(float) * cos4).sum(axis=(1, 2)) / fx**2)


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("width", [16, 61, 128, 1024])
def test_power_of_the_disc(surface: render.TerrainMesh, width: int, samples: int) -> None:
    darkened = dataclasses.replace(
        sun(frames.direction_L(40, 35)), limb_darkening=spectra.limb_darkening(np.linspace(420, 880, 8))
    )
    for light in (darkened, sun(frames.direction_L(40, 35))):
        a_view = looking(light, width, 60.0, (11.0, -17.0))
        found = render.radiance(surface, scene(a_view, light, spp=samples))
        assert found.sun is not None
        cosine = a_view.L_from_C[:, 2] @ light.direction_L
        # the disc's solid angle over its projection is 1 + α² / 4: 5e-6; float32
        np.testing.assert_allclose(power(found.sun, a_view), light.irradiance_W_m2_nm * cosine, rtol=2e-5)
        np.testing.assert_array_equal(found.array >= found.sun, True)


def test_the_rays_of_the_pixels_leave_the_disc_alone(surface: render.TerrainMesh) -> None:
    light = sun(frames.direction_L(40, 35))
    a_view = looking(light, 64, 30.0, (3.0, 4.0))
    one, other = (
        render.radiance(surface, dataclasses.replace(scene(a_view, light, spp=spp), key=key)).sun
        for spp, key in ((1, 3), (16, 8))
    )
    assert one is not None
    np.testing.assert_array_equal(one, other)


def test_a_resolved_disc_is_the_mean_over_each_pixel() -> None:
    """Against 64² points a pixel, edge pixels included."""
    f, radius, size = 900.0, 0.00465, 24
    direction = np.array([0.0021, -0.0012, 1.0])
    direction /= np.linalg.norm(direction)
    coefficients = spectra.limb_darkening(np.array([500.0]))
    disc = SunInView(
        direction_C=direction,
        angular_radius_rad=radius,
        radiance_W_m2_sr_nm=np.ones(1),
        limb_darkening=coefficients,
    )
    found = pixel_sums(disc, Pinhole(np.array([f, f, size / 2, size / 2])), (size, size), coefficients)
    assert found is not None
    at = ((np.arange(size * 64) + 0.5) / 64 - size / 2) / f
    x, y = np.meshgrid(at, at)
    seen = np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(1 + x * x + y * y)[..., None]
    share = ((seen - direction) ** 2).sum(axis=-1) / (2 * np.sin(radius / 2)) ** 2
    value = np.polynomial.polynomial.polyval(np.sqrt(np.maximum(1 - share, 0)), coefficients[0]) * (share < 1)
    expected = value.reshape(size, 64, size, 64).mean(axis=(1, 3)) / f**2
    got = found.on((size, size))[0]
    # cells of 1/15 of a pixel along the rim, where darkening falls as a root: 2/3 · (1 / 64)^1.5 of the disc's
    # light is off by a tenth, and normalised away; 64² points err by a cell's width along the rim, 1/64 · 1/4
    np.testing.assert_allclose(got, expected, atol=4e-3 * expected.max())
    inner = expected > 0.9 * expected.max()
    np.testing.assert_allclose(got[inner], expected[inner], rtol=1e-3)


def test_a_border_cuts_the_disc(surface: render.TerrainMesh) -> None:
    """The part of a disc that the frame's border leaves is a circle's segment."""
    light = sun(frames.direction_L(40, 35))
    for inside in (0.5, 0.13):  # of the radius, within the border from the centre's side
        wide = looking(light, 64, 40.0, (0.0, 0.0))
        # moved so that the border runs at a distance from the disc's centre, which is on the axis
        fx = wide.intrinsics[0]
        edge = fx * np.tan(light.angular_radius_rad) * inside
        a_view = dataclasses.replace(wide, intrinsics=np.array([fx, fx, edge, 32.3]))
        found = render.radiance(surface, scene(a_view, light, spp=1))
        assert found.sun is not None
        expected = 1 - (np.arccos(inside) - inside * np.sqrt(1 - inside**2)) / np.pi
        # cells along the border are whole, and those along the rim 1/128 of the disc: (1/128)² / 8 of sagitta
        got = power(found.sun, a_view) / light.irradiance_W_m2_nm
        np.testing.assert_allclose(got, expected, atol=1e-3)


@pytest.mark.parametrize("width", [16, 512])
@pytest.mark.parametrize("above", [-1.5, -0.4, 0.0, 0.4, 1.5])
def test_a_horizon_hides_a_part(above: float, width: int) -> None:
    """A plane's edge at a height below the eye: the segment above it is left, whatever the pixels."""
    ground = join(plane(5000.0))
    eye_m, edge_m = 50.0, 5000.0
    dip = np.arctan(eye_m / edge_m)
    radius = sun(UP).angular_radius_rad
    light = sun(frames.direction_L(0, float(np.degrees(above * radius - dip))))
    axes = frames.L_from_C(light.direction_L, 2.0, 3.0, 0.0)
    a_view = dataclasses.replace(view(eye_m * UP, UP, width=width, fov_deg=30.0), L_from_C=axes)
    found = render.radiance(ground, scene(a_view, light, spp=1))
    cosine = axes[:, 2] @ light.direction_L
    t = float(np.clip(above, -1, 1))
    expected = 1 - (np.arccos(t) - t * np.sqrt(1 - t * t)) / np.pi
    got = 0.0 if found.sun is None else power(found.sun, a_view)[0] / (light.irradiance_W_m2_nm[0] * cosine)
    # one ray in each of 128 cells along the edge errs by 0.3 of a cell, all of them by 0.3 · √128 / (128² π / 4):
    # 3e-4; linear between cells is even over the edge to (1/64)² · 4 / π; float32 directions 1e-7 / 5e-3
    assert got == pytest.approx(expected, abs=2e-3)
    truth = render.truth(ground, a_view, light)
    marked = truth.semantic == SUN
    assert marked.any() == (expected > 0)
    if found.sun is None:
        return
    holds = found.sun[0] > 0
    assert not (marked & ~holds).any()  # no label without light
    visible = render.sun_visible_fraction(ground, a_view.position_L_m[None], [light])[0]
    # a sunflower's points lie a 36th of the disc's radius apart on average
    assert visible == pytest.approx(got, abs=5e-3)


def test_a_small_sun_owns_its_pixel(surface: render.TerrainMesh) -> None:
    light = sun(frames.direction_L(40, 35))
    a_view = looking(light, 16, 60.0, (11.0, -17.0))
    truth = render.truth(surface, a_view, light)
    x, y, z = a_view.L_from_C.T @ light.direction_L
    f = a_view.intrinsics[0]
    found = render.radiance(surface, scene(a_view, light, spp=1)).sun
    assert found is not None
    assert truth.semantic[int(8 + f * y / z), int(8 + f * x / z)] == SUN
    np.testing.assert_array_equal(truth.semantic == SUN, found[0] > 0)


def thin(pixels: int) -> Camera:
    detector = ThreeColourDetector(width_px=pixels, height_px=pixels, pixel_pitch_um=12800 / pixels)
    return Camera(lens=ThinLens(focal_length_mm=12.0, f_number=4.0, transmission=0.9), detector=detector)


def real(pixels: int) -> Camera:
    found = load_lens("distagon_25_f2p8")
    detector = ThreeColourDetector(width_px=pixels, height_px=pixels, pixel_pitch_um=18000 / pixels)
    lens = RealLens(prescription=found, width_px=pixels, height_px=pixels, pixel_pitch_um=18000 / pixels)
    return Camera(lens=lens, detector=detector)


@pytest.mark.parametrize("pixels", [16, 96])
@pytest.mark.parametrize("camera", [thin, real])
def test_a_lens_images_the_power_that_it_admits(camera: Callable[[int], Camera], pixels: int) -> None:
    """∫ E dA = E☉ T A(θ) cos θ for Suns all over the frame."""
    c = camera(pixels)
    nodes = np.array([486.1, 587.6, 656.3])
    sin_a = np.sin(0.00465)
    guard = c.lens.guard_px
    for sx, sy in ((0.003, 0.001), (0.11, -0.17), (-0.2, 0.13)):
        direction = np.array([sx, sy, 1.0]) / np.sqrt(1 + sx * sx + sy * sy)
        disc = SunInView(
            direction_C=direction, angular_radius_rad=0.00465, radiance_W_m2_sr_nm=np.full(3, 1 / np.pi / sin_a**2)
        )
        shape = (3, pixels + 2 * guard[1], pixels + 2 * guard[0])
        array = np.zeros(shape, np.float32)
        f = c.focal_length_px
        where = Pinhole(np.array([f, f, shape[2] / 2, shape[1] / 2]))
        assert add_mean(array, disc, where, range(3)) is not None
        radiance = Radiance(array=array, wavelength_nm=nodes, sun=array.copy(), disc=disc)
        light = c.lens.image_of_sun(radiance, c.detector.pixel_pitch_um)
        got = light.array.sum(axis=(1, 2), dtype=float) * (c.detector.pixel_pitch_um * 1e-3) ** 2
        slope = float(np.hypot(sx, sy))
        passed = spectra.band_means(c.lens.transmittance(spectra.fine_nodes_nm(nodes)), nodes)
        admitted = passed * c.lens.pupil_area_mm2(slope) * direction[2]
        # the beam's area is a table over 65 angles, linear here and cubic there, and bends over the disc
        np.testing.assert_allclose(got, admitted, rtol=1e-3)
        peak = np.unravel_index(np.argmax(light.array[1]), light.array[1].shape)
        want = c.project(direction)
        assert want is not None
        assert np.hypot(peak[1] + 0.5 - want[0], peak[0] + 0.5 - want[1]) < 1.1


@pytest.mark.parametrize("aperture_m", [0.0, 0.02])
def test_a_part_of_the_spacecraft_hides_a_half(aperture_m: float) -> None:
    """A plate at 1 m that covers one half of the field leaves half of the disc, in the light and in the scalar."""
    corners = np.array([[0, -1, 1], [1, -1, 1], [1, 1, 1], [0, 1, 1]], np.float32)
    plate = render.Vehicle(
        corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros(2, np.int32), np.full((1, 8), 0.3)
    )
    ground, faces = plane(1.0)
    surface = render.TerrainMesh(ground, faces, np.ones(2, bool), vehicle=plate)
    light = sun(frames.direction_L(40, 35))
    a_view = dataclasses.replace(looking(light, 32, 20.0, (0.0, 0.0)), aperture_radius_m=aperture_m)
    found = render.radiance(surface, scene(a_view, light, spp=1)).sun
    assert found is not None
    # linear between cells along the edge; 65536 points of the pupil over all cells err by less than 1e-3
    assert power(found, a_view)[0] / light.irradiance_W_m2_nm[0] == pytest.approx(0.5, abs=3e-3)
    seen = render.sun_visible_fraction(surface, a_view.position_L_m[None], [light], a_view.L_from_C[None])
    np.testing.assert_allclose(seen, 0.5, atol=5e-3)
