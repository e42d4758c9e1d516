"""The renderer against closed forms: radiance, noise, geometry, shadows, determinism."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from conftest import render_threads

from vbnfault import render
from vbnfault.core import frames, spectra
from vbnfault.detector import ThreeColourDetector
from vbnfault.lens import ThinLens
from vbnfault.reflectance import BandReflectance
from vbnfault.reflectance.disc import Lambert
from vbnfault.reflectance.hapke import hapke_at
from vbnfault.render.description import RenderInput, Sunlight, View
from vbnfault.render.runtime import dr, mi, packets

UP = np.array([0.0, 0.0, -1.0])
NODES = spectra.band_nodes_nm(400.0, 700.0, 8)


class CountedScene:
    """Trace rays through a scene of Mitsuba's and count those that are active."""

    def __init__(self, traced: Any) -> None:
        self.traced, self.rays = traced, 0

    def ray_intersect_preliminary(self, rays: Any, *, coherent: bool, active: Any) -> Any:
        self._count(rays, active)
        return self.traced.ray_intersect_preliminary(rays, coherent=coherent, active=active)

    def ray_test(self, rays: Any, coherent: bool, active: Any) -> Any:
        self._count(rays, active)
        return self.traced.ray_test(rays, coherent, active)

    def _count(self, rays: Any, active: Any) -> None:
        each = mi.Bool(active) & (rays.d.x == rays.d.x)
        self.rays += int(dr.count(each)[0])


def plane(half_m: float = 500.0, height_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    z = -height_m
    corners = [[-half_m, -half_m, z], [half_m, -half_m, z], [half_m, half_m, z], [-half_m, half_m, z]]
    return np.array(corners, np.float32), np.array([[0, 2, 1], [0, 3, 2]], np.int32)


def box(centre: np.ndarray, half_m: float) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.box(extents=[2 * half_m] * 3)
    return (mesh.vertices + centre).astype(np.float32), mesh.faces.astype(np.int32)


def ball(radius_m: float = 100.0, subdivisions: int = 6, centre: Any = (0, 0, 0)) -> render.TerrainMesh:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m)
    vertices = (mesh.vertices + np.array(centre)).astype(np.float32)
    return render.TerrainMesh(vertices, mesh.faces.astype(np.int32), np.zeros(len(mesh.faces), bool))


def join(*parts: tuple[np.ndarray, np.ndarray]) -> render.TerrainMesh:
    offset, vertices, faces = 0, [], []
    for v, f in parts:
        vertices.append(v)
        faces.append(f + offset)
        offset += len(v)
    all_faces = np.concatenate(faces).astype(np.int32)
    return render.TerrainMesh(np.concatenate(vertices), all_faces, np.ones(len(all_faces), bool))


def sun(direction: np.ndarray, distance_au: float = 1.0) -> Sunlight:
    return Sunlight(
        direction_L=frames.unit(direction),
        angular_radius_rad=spectra.sun_angular_radius_rad(distance_au),
        irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(NODES, distance_au),
    )


def view(position: np.ndarray, look: np.ndarray, width: int = 64, fov_deg: float = 40.0, **more: float) -> View:
    f = width / 2 / np.tan(np.radians(fov_deg) / 2)
    axes = frames.L_from_C0(np.asarray(look, float))
    intrinsics = np.array([f, f, width / 2, width / 2])
    return View(
        position_L_m=np.asarray(position, float),
        L_from_C=axes,
        intrinsics=intrinsics,
        width_px=width,
        height_px=width,
        **more,
    )


def scene(
    a_view: View,
    light: Sunlight,
    ground: BandReflectance | float | str = 0.06,
    *,
    spp: int = 16,
    key: int = 5,
    **more: Any,
) -> RenderInput:
    """A scene with the reflectance given, or Lambert's of a grey value or a named spectrum."""
    if isinstance(ground, float | str):
        ground = Lambert().at(NODES, spectra.reflectance(ground, NODES))
    return RenderInput(
        view=a_view, sun=light, wavelength_nm=NODES, reflectance=ground, samples_per_pixel=spp, key=key, **more
    )


@pytest.mark.parametrize("distance_au", [1.0, 2.0])
@pytest.mark.parametrize("elevation_deg", [90.0, 30.0, 5.0])
def test_lambert_plane_has_the_analytic_radiance(distance_au: float, elevation_deg: float) -> None:
    # L = ρ E cos i / π. The mean of cos over the disc is cos i · cos α-ish: 1e-5 off; the disc's sampling over
    # 64² × 16 draws leaves tan(α)·cot(i)/4/√65536 < 2e-4 of noise. Hence 5e-4.
    light = sun(frames.direction_L(40, elevation_deg), distance_au)
    got = render.radiance(join(plane()), scene(view(10 * UP, -UP), light)).array.mean(axis=(1, 2))
    e = spectra.solar_band_irradiance_W_m2_nm(NODES, 1.0) / distance_au**2
    want = 0.06 * e * np.sin(np.radians(elevation_deg)) / np.pi
    np.testing.assert_allclose(got, want, rtol=5e-4)


def test_lambert_sphere_integrates_to_its_geometric_albedo() -> None:
    # A Lambert sphere seen from the Sun: I = ρ E cos i / π, disk mean (2/3) ρ E / π (the geometric albedo 2ρ/3).
    # from 1e5 radii away, so that the outline is the great circle to 1e-10
    a_view = view(1e5 * UP, -UP, width=128, fov_deg=np.degrees(2 * np.arctan(1.1e-3)))
    image = render.radiance(ball(), scene(a_view, sun(UP))).array[3]
    pixel_m2 = (2 * 1.1e-3 * 1e5 / 128) ** 2
    got = image.sum() * pixel_m2 / (np.pi * 100.0**2)
    want = 2 / 3 * 0.06 * spectra.solar_band_irradiance_W_m2_nm(NODES, 1.0)[3] / np.pi
    # facets of 2 m lose (2/100)²/8·… ~ 1e-4 of the area; pixel strata another 1e-4; 0.2 % is ample
    assert got == pytest.approx(want, rel=2e-3)


def test_spectral_sampling_adds_no_noise_and_no_bias() -> None:
    """Flat Lambert plane at 16 samples per pixel: spread < 0.3 of the sensor's noise, bias < 0.5 %."""
    light = sun(frames.direction_L(0, 60), 2.0)
    image = render.radiance(join(plane()), scene(view(10 * UP, -UP), light, "67p"))
    detector = ThreeColourDetector(width_px=64, height_px=64)
    lens = ThinLens(focal_length_mm=4.4, f_number=4.0)
    one = detector.electrons_expected(lens.image(image), 1.0)
    exposure = 0.5 * float((one.white_e / one.array.mean(axis=(0, 1))).min())  # half white
    signal = one.array * np.float32(exposure)
    noise = np.sqrt(signal.mean(axis=(0, 1)) + detector.read_noise_e_rms**2)
    assert (signal.std(axis=(0, 1)) < 0.3 * noise).all()
    # the converged render: 1 nm steps through the same optics and responses, written out
    fine = np.arange(400.0, 700.5, 1.0)
    radiance = (
        spectra.reflectance("67p", fine)
        * spectra.solar_irradiance_W_m2_nm(fine, 2.0)
        * np.sin(np.radians(60))
        / np.pi
    )
    photons = fine * 1e-9 / (spectra.PLANCK_J_S * spectra.LIGHT_SPEED_M_S)
    rate = spectra.response(detector.response, fine, detector.quantum_efficiency_peak) * radiance * photons
    area = (detector.pixel_pitch_um * 1e-6) ** 2
    want = np.trapezoid(rate, fine, axis=1) * area * np.pi / (4 * 4.0**2)
    got = one.array.mean(axis=(0, 1))
    np.testing.assert_allclose(got, want, rtol=5e-3)
    intensity = np.array([0.2126, 0.7152, 0.0722]) / one.white_e
    assert got @ intensity == pytest.approx(want @ intensity, rel=5e-3)


def test_depth_normal_and_class_of_a_tilted_plane() -> None:
    # pinhole rays through pixel centres: depth along the boresight is h / (d·down) in closed form
    a_view = view(20 * UP, np.array([0.5, 0.0, 1.0]))
    truth = render.truth(join(plane(5000.0)), a_view, sun(UP))
    fx, fy, cx, cy = a_view.intrinsics
    x, y = np.meshgrid((np.arange(64) + 0.5 - cx) / fx, (np.arange(64) + 0.5 - cy) / fy)
    rays_L = np.stack([x, y, np.ones_like(x)], -1) @ a_view.L_from_C.T
    np.testing.assert_allclose(truth.depth_m, 20.0 / rays_L[..., 2], rtol=2e-6)
    # the plane's normal (up) in C, stored as float16: 11 bits
    np.testing.assert_allclose(truth.normal, np.broadcast_to(UP @ a_view.L_from_C, (64, 64, 3)), atol=1e-3)
    assert (truth.semantic == 1).all()


def test_the_sun_stands_where_it_should() -> None:
    light = sun(frames.direction_L(10, 20), 0.3)  # a disc of 1.8 degrees: 14 pixels across
    axes = frames.L_from_C(light.direction_L, 3.0, -5.0, 30.0)
    a_view = dataclasses.replace(view(20 * UP, UP, width=256, fov_deg=30.0), L_from_C=axes)
    image = render.radiance(join(plane(1.0)), scene(a_view, light))
    direction = axes.T @ light.direction_L
    fx, _, cx, cy = a_view.intrinsics
    want = np.array([cx, cy]) + fx * direction[:2] / direction[2]
    disc = image.array[0]
    y, x = np.mgrid[:256, :256] + 0.5
    centroid = np.array([(disc * x).sum(), (disc * y).sum()]) / disc.sum()
    # perspective makes an ellipse whose centroid is off by r² ~ f α² tan θ: 0.01 px; sampling 14² · 16: 0.02 px
    np.testing.assert_allclose(centroid, want, atol=0.05)
    # the flux of the disc: E = ∫ L cos θ dΩ, dΩ = cos³θ / f² per pixel
    cos = 1 / np.sqrt(1 + ((x - cx) ** 2 + (y - cy) ** 2) / fx**2)
    flux = (disc * cos**3).sum() / fx**2
    assert flux == pytest.approx(light.irradiance_W_m2_nm[0], rel=0.01)
    truth = render.truth(join(plane(1.0)), a_view, light)
    # the class reaches half a pixel past the disc: radius 7.0 + 0.5 pixels
    radius = fx * np.tan(light.angular_radius_rad)
    assert (truth.semantic == 2).sum() == pytest.approx(np.pi * (radius + 0.5) ** 2, rel=0.06)


@pytest.mark.parametrize("away_m", [0.0, 2500.0])
def test_contact_shadow_of_a_small_stone(away_m: float) -> None:
    """A 0.15 m stone keeps its shadow up to the contact, also 2.5 km from the origin of the scene."""
    half = 0.075
    place = np.array([away_m, 0.0, 0.0])
    stone = box(place + half * UP, half)
    surface = join(plane(4000.0), stone)
    light = sun(np.array([-1.0, 0.0, -1.0]), 3.0)  # from the south, 45 degrees up: a shadow of 0.15 m to the north
    a_view = view(place + 2 * UP, -UP, width=256, fov_deg=20.0)
    image = render.radiance(surface, scene(a_view, light)).array[0]
    f = a_view.intrinsics[0]
    lit = image[10:40].mean()

    def at(north_m: float) -> float:
        point = np.array([north_m, 0.0, 2.0])  # from the camera, L axes
        c = a_view.L_from_C.T @ point
        return float(image[int(128 + f * c[1] / c[2]), int(128 + f * c[0] / c[2])])

    # one pixel is 2.8 mm on the ground; the offset of a shadow ray at 2.5 km is 8 · 2⁻²³ · 5 km = 5 mm
    for north in (half + 0.010, half + 0.03, half + 0.07, half + 0.13):
        assert at(north) < 0.02 * lit
    for north in (half + 0.17, -half - 0.02):
        assert at(north) == pytest.approx(lit, rel=0.05)


def test_a_lit_sphere_far_away_has_no_acne() -> None:
    # facets that face the Sun by 3 degrees and more must not shadow themselves, 4 km from the origin
    centre = np.array([4000.0, 1000.0, 500.0])
    surface = ball(1500.0, 5, centre)
    light = sun(np.array([-0.3, 1.0, -0.5]))
    a_view = view(np.zeros(3), centre, width=256, fov_deg=50.0)
    image = render.radiance(surface, scene(a_view, light, spp=1)).array[0]
    truth = render.truth(surface, a_view, light)
    normal_L = truth.normal.astype(float) @ a_view.L_from_C.T
    facing = (truth.semantic == 1) & (normal_L @ light.direction_L > np.sin(np.radians(3)))
    inner = facing.copy()
    for axis in (0, 1):  # one pixel in from any edge: the image is sampled off-centre
        inner &= np.roll(facing, 1, axis) & np.roll(facing, -1, axis)
    assert inner.sum() > 5000
    assert (image[inner] > 0).mean() > 0.9995


def test_ground_height_clearance_and_occlusion() -> None:
    wall = box(np.array([40.0, 0.0, -10.0]), 10.0)  # a cube of 20 m on the ground, 30 m north
    surface = join(plane(height_m=3.0), wall)
    x, y = np.array([0.0, 40.0, 40.0]), np.array([0.0, 0.0, 100.0])
    np.testing.assert_allclose(render.ground_height_m(surface, x, y, 300.0), [3.0, 20.0, 3.0], atol=1e-4)
    positions = np.array([[0, 0, -3.4], [0, 0, -3.6], [29.6, 0, -13.0]])
    assert render.is_clear(surface, positions, 0.5).tolist() == [False, True, False]
    # towards the wall's upper edge, from 30 m away at 10 m height: it hides everything below 18.4 degrees
    eye = np.array([[0.0, 0.0, -10.0]])
    edge = float(np.degrees(np.arctan2(10.0, 30.0)))
    fractions = [
        float(render.sun_visible_fraction(surface, eye, [sun(frames.direction_L(0, edge + d))])[0])
        for d in (-1.0, 0.0, 1.0)
    ]
    # half a disc at the edge; 1024 points of a sunflower know an edge to a few of them
    assert fractions[0] == 0.0
    assert fractions[1] == pytest.approx(0.5, abs=5e-3)
    assert fractions[2] == 1.0


def test_clearance_is_the_distance_to_the_nearest_facet() -> None:
    """Faces, edges and corners of a cube: it is clear up to a millimetre less than its distance, no further."""
    rng = np.random.default_rng(11)
    corner = np.array([40.0, 0.0, -10.0])
    cube = join(box(corner, 10.0))
    away = rng.normal(size=(60, 3))
    away /= np.linalg.norm(away, axis=1)[:, None]
    points = corner + 40.0 * away
    outside = np.maximum(np.abs(points - corner) - 10.0, 0)  # of a cube: its faces, edges and corners
    for point, distance in zip(points, np.linalg.norm(outside, axis=1), strict=True):
        clear = [bool(render.is_clear(cube, point[None], distance + d)[0]) for d in (-1e-3, 1e-3)]
        assert clear == [True, False]
    # needles thinner than the angle between any directions that one would look along
    needle = (np.array([[0, 0, -5.0], [1e-3, 0, 0], [0, 1e-3, 0]]), np.array([[0, 1, 2]], np.int32))
    surface = render.TerrainMesh(needle[0], needle[1], np.ones(1, bool))
    positions = np.array([[0.0, 0.0, -6.0], [0.5, 0.5, -6.0]])
    assert render.is_clear(surface, positions, 0.999).tolist() == [True, True]
    assert render.is_clear(surface, positions, 1.001).tolist() == [False, True]
    assert render.is_clear(surface, positions, 0.0).all()


def test_facets_near_a_position_are_all_found() -> None:
    """Every facet whose box is within reach of a position; there are more positions than one kernel takes."""
    rng = np.random.default_rng(4)
    vertices = rng.uniform(-50, 50, (900, 3)).astype(np.float32) + np.float32(2000)
    faces = rng.permutation(900).reshape(300, 3).astype(np.int32)
    surface = render.TerrainMesh(vertices, faces, np.ones(300, bool))
    positions = rng.uniform(-50, 50, (11, 3)) + 2000
    corners = vertices[faces].astype(float)
    np.testing.assert_array_equal(surface.corners_m(np.array([7, 3])), corners[[7, 3]])
    low, high = corners.min(axis=1), corners.max(axis=1)
    away = np.maximum(np.maximum(low[None] - positions[:, None], positions[:, None] - high[None]), 0)
    distance = np.linalg.norm(away, axis=2)
    reach = float(np.quantile(distance, 0.05))
    found = surface.facets_near(positions, reach)
    assert set(np.flatnonzero((distance <= reach).any(axis=0))) <= set(found)
    assert 0 < len(found) < 300
    assert (distance[:, found].min(axis=0) < reach + 0.01).all()  # 2000 m has 0.0002 m in float32


def test_overhang_does_not_count_as_ground_from_below() -> None:
    # the start lies inside the cube: its bottom faces down, the plane below is the ground
    surface = join(plane(), box(np.array([0.0, 0.0, -300.0]), 20.0))
    height = render.ground_height_m(surface, np.zeros(1), np.zeros(1), 300.0)
    assert height[0] == pytest.approx(0.0, abs=1e-3)


def test_bits_do_not_depend_on_threads_or_history() -> None:
    """Also of light between surfaces, under a limb-darkened Sun."""

    def surface() -> render.TerrainMesh:
        stones = (box(np.array([np.cos(k) * 3, np.sin(2 * k) * 3, -0.3]), 0.4) for k in range(12))
        return join(plane(60.0), *stones)

    light = dataclasses.replace(sun(frames.direction_L(30, 20), 2.0), limb_darkening=spectra.limb_darkening(NODES))
    a = scene(view(12 * UP, -UP), light, hapke_at(NODES), bounces=1)
    b = scene(view(6 * UP, np.array([0.3, 0.2, 1.0])), sun(frames.direction_L(90, 10)), key=6)
    one = surface()
    with render_threads(2):
        first = render.radiance(one, a).array
        other = render.radiance(one, b).array
    with render_threads(1):
        again = render.radiance(one, a).array
        fresh = render.radiance(surface(), a).array
    assert np.array_equal(first, again)
    assert np.array_equal(first, fresh)
    assert not np.array_equal(first, other)


def test_a_new_view_compiles_nothing() -> None:
    surface = join(plane(), box(np.array([2.0, 1.0, -1.0]), 1.0))
    render.radiance(surface, scene(view(10 * UP, -UP), sun(UP)))
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        render.radiance(surface, scene(view(7 * UP, np.array([0.1, 0, 1.0])), sun(frames.direction_L(3, 4), 2.0)))
        history = dr.kernel_history()
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    compiled = [k for k in history if "hash" in k and not k["cache_hit"]]
    assert history
    assert not compiled


def test_tables_of_packets_are_aligned() -> None:
    """Wherever numpy's memory begins: otherwise drjit makes another kernel, which fetches single numbers."""
    values = np.arange(97, dtype=np.float32)
    for start in range(3):
        table = packets(mi.Float, values[start : start + 94].reshape(2, 47))
        assert table.numpy().ctypes.data % 64 == 0
        np.testing.assert_array_equal(table.numpy(), values[start : start + 94])


def test_large_images_are_cut_without_a_seam() -> None:
    # rows are traced in slabs; a slab must not change what a pixel sees
    from vbnfault.render import light

    surface = join(plane(), box(np.array([0.0, 0.0, -1.0]), 1.0))
    a = scene(view(10 * UP, -UP), sun(frames.direction_L(0, 30)))
    whole = render.radiance(surface, a).array
    limit, light.WAVEFRONT = light.WAVEFRONT, 64 * 16 * 10
    try:
        cut = render.radiance(surface, a).array
    finally:
        light.WAVEFRONT = limit
    assert np.array_equal(whole, cut)


def test_defocus_blurs_by_the_thin_lens_law() -> None:
    # focused at 2 m, aperture radius 0.05 m, an edge at 1 m: the blur disc on it spans 2·0.05·(1 - 1/2) = 0.05 m
    half_plane = (
        np.array([[-9, -9, 0], [0, -9, 0], [0, 9, 0], [-9, 9, 0]], np.float32),
        np.array([[0, 2, 1], [0, 3, 2]], np.int32),
    )
    a_view = view(UP, -UP, width=256, fov_deg=20.0, aperture_radius_m=0.05, focus_distance_m=2.0)
    image = render.radiance(join(half_plane), scene(a_view, sun(UP), spp=64)).array[0]
    axis = int(np.argmax(np.abs(a_view.L_from_C[0, :2])))  # the image axis that runs north
    profile = image.mean(axis=axis)  # the mean over the other one
    profile = profile / profile.max()
    width_px = float(np.abs(np.diff(profile)) @ np.ones(255) and (np.abs(profile - 0.5) < 0.4999).sum())
    want_px = 0.05 * a_view.intrinsics[0] / 1.0
    assert width_px == pytest.approx(want_px, rel=0.08)
