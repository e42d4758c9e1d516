"""What the terrain is like: its spectrum, its seams, what lies on it, and that position and seed alone decide."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from conftest import render_threads, small_scene
from ground_kit import deviation_over_law, ground_of, raised_from_two_sites

from vbnfault import render
from vbnfault.body import Body, Patch, PatchSpec, Site, build_patch, choose_sites, load_body, relief
from vbnfault.body.fields import GRADIENT_STD, Points
from vbnfault.body.geometry import mean_edge_m, vertex_normals
from vbnfault.body.noise import fractal_noise
from vbnfault.body.roughness import Roughness, deviogram, model_roughness
from vbnfault.core import frames
from vbnfault.pipeline import Session
from vbnfault.pipeline.spec import Terrain
from vbnfault.render.description import View
from vbnfault.render.runtime import dr
from vbnfault.render.sampling import Optics
from vbnfault.scene import config

FINE = {"seed": 7, "facet_m": 0.5, "radius_m": 40.0, "min_boulder_m": 0.8, "max_triangles": 400_000}


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture(scope="module")
def sites(body: Body) -> tuple[Site, ...]:
    return choose_sites(body, 4, seed=7)


@pytest.fixture(scope="module")
def patches(body: Body, sites: tuple[Site, ...]) -> list[Patch]:
    return [build_patch(body, site, PatchSpec(**FINE)) for site in sites]


# --- fields -----------------------------------------------------------------------------------------------------


def test_fields_are_continuous_far_from_the_origin() -> None:
    # A line three kilometres out in steps of 1 mm; cells of 16 cm, as fine as the finest patch asks for.
    line = np.array([3100.0, -2200.0, 1700.0]) + np.linspace(0, 2, 2001)[:, None] * np.array([0.6, 0.64, 0.48])
    field = Points(line)
    noise = field.gradient(0.16, 5, len(line))
    # Gradient noise is at most about ±1 with slopes of a few per cell: 1 mm is 1/160 of a cell.
    assert np.abs(np.diff(noise)).max() < 4 / 160
    assert noise.std() > 0.1
    # Second differences show float32 steps, if positions were float32: 3 km / 2²⁴ = 0.2 mm, a fifth of a step.
    assert np.abs(np.diff(noise, 2)).max() < 2e-3
    assert np.abs(np.diff(field.craters(0.16, 5, len(line), 1.0))).max() < 0.02
    # A clod's side is steep: up to 4 height/radius · 0.85.
    assert np.abs(np.diff(field.clods(0.16, 5, len(line), 1.0))).max() < 4 * 0.85 / 160 * 2


def test_fields_are_the_same_for_any_neighbours_and_threads() -> None:
    points = np.random.default_rng(3).uniform(-3000, 3000, (70_001, 3))
    together = Points(points)
    found = []
    for count in (1, 2, 5):
        with render_threads(count):
            found.append((together.gradient(7.0, 1, 70_001), *together.blocks(7.0, 1, 70_001)))
    alone = Points(points[313:340])
    for other in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(found[0], other, strict=True))
    np.testing.assert_array_equal(found[0][0][313:340], alone.gradient(7.0, 1, 27))
    np.testing.assert_array_equal(found[0][0][:100], together.gradient(7.0, 1, 100))
    # 70,001 independent values: the standard deviation is known to 0.3 %.
    assert found[0][0].std() == pytest.approx(GRADIENT_STD, rel=0.015)
    assert not np.array_equal(found[0][0], together.gradient(7.0, 2, 70_001))


# --- spectrum ---------------------------------------------------------------------------------------------------


def test_deviogram_of_a_known_surface() -> None:
    # Sine waves of 40 m with 1 m amplitude along x on a plane: ν² = A² (1 - cos(2πL/λ)) for steps along x, and
    # over all directions A² (1 - J0(2πL/λ)), here J0(2π 12 / 40) = 0.29.
    x, y = np.meshgrid(np.arange(0, 300, 1.0), np.arange(0, 300, 1.0), indexing="ij")
    wave = np.column_stack([x.ravel(), y.ravel(), np.sin(2 * np.pi * x.ravel() / 40.0)])
    up = np.tile([0.0, 0.0, 1.0], (len(wave), 1))
    raw = np.sqrt(1 - 0.29)
    found = deviogram(wave, up, np.array([12.0]))[0]
    # The quadric within 36 m takes a part away: what is left lies between a third and all of it.
    assert raw / 3 < found < 1.05 * raw  # windows lie where they lie on the wave
    # Twice the heights, twice the deviation; a plane and a bowl have none.
    np.testing.assert_allclose(deviogram(wave * [1, 1, 0.1], up, np.array([12.0]))[0], found / 10, rtol=0.02)
    bowl = np.column_stack([x.ravel(), y.ravel(), 1e-4 * (x.ravel() ** 2 + y.ravel() ** 2)])
    assert deviogram(bowl, up, np.array([12.0]))[0] < 1e-3
    assert np.isnan(deviogram(wave[:5], up[:5], np.array([12.0]))[0])


def test_model_law_is_anchored_on_the_model(body: Body) -> None:
    law, edge = model_roughness(body.vertices_m, body.faces), mean_edge_m(body.vertices_m, body.faces)
    assert 1.0 < law.baseline_m / edge < 2.0
    assert 0.5 <= law.hurst <= 1.0
    at = deviogram(body.vertices_m, vertex_normals(body.vertices_m, body.faces), np.array([law.baseline_m]))[0]
    assert law.deviation_m == pytest.approx(at, rel=1e-9)
    assert body.roughness == law
    assert float(Roughness(deviation_m=2.0, baseline_m=8.0, hurst=0.5).deviation_at(2.0)) == pytest.approx(1.0)


def test_a_coarse_model_is_as_rough_as_the_body_that_it_samples() -> None:
    """Roundness of a smooth ball is no roughness; 320 plates of a rough one tell that of 20,480 within a third."""
    metres, law = np.array([1.0, 10.0, 100.0]), {}
    wavelengths_m = 250.0 * 1.2 / 2.0 ** np.arange(6)
    for level in (2, 5):
        ball = trimesh.creation.icosphere(subdivisions=level)
        smooth, normals = 250.0 * np.asarray(ball.vertices), np.asarray(ball.vertices)
        assert model_roughness(smooth, ball.faces).deviation_at(1.0) < 1e-3
        height = fractal_noise(smooth + 100.0, 7, wavelengths_m, 24.0 * (wavelengths_m / 300.0) ** 0.8)
        law[level] = model_roughness(smooth + height[:, None] * normals, ball.faces).deviation_at(metres)
    np.testing.assert_allclose(law[2], law[5], rtol=0.35)


def test_terrain_continues_the_models_spectrum(body: Body, patches: list[Patch]) -> None:
    ratio = deviation_over_law(body, patches, [2.0, 5.0, 12.0, 30.0])
    # Four places differ from each other by a factor of two (dust plains, outcrops): their mean square by 1.5.
    assert (ratio > 0.65).all(), ratio
    assert (ratio < 1.5).all(), ratio


# --- seams and the same ground for all --------------------------------------------------------------------------


def test_depth_and_normals_have_no_seam_where_detail_changes(patches: list[Patch]) -> None:
    patch = patches[0]
    points, faces = ground_of(patch)
    mesh = trimesh.Trimesh(points, faces, process=False)
    assert mesh.is_watertight
    # Facets that share an edge: across the border of the fine zone they turn no more than within it.
    pairs, turn = mesh.face_adjacency, mesh.face_adjacency_angles
    distance = np.linalg.norm(mesh.triangles_center[pairs].mean(axis=1), axis=1)
    inside, border = turn[distance < 35.0], turn[(distance > 36.0) & (distance < 48.0)]
    assert len(border) > 1000
    assert np.percentile(border, 99) < 1.5 * np.percentile(inside, 99)
    # Nor do sizes jump: neighbours' areas differ by less than 16 (two bisections each way, relief tilts).
    area = mesh.area_faces[pairs]
    ratio = area.max(axis=1) / area.min(axis=1)
    assert np.percentile(ratio[distance < 100.0], 99.5) < 16.0


def test_neighbouring_sites_see_the_same_ground(body: Body) -> None:
    raised, difference = raised_from_two_sites(body, 150.0, facet_m=4.0, radius_m=250.0)
    assert len(difference) > 1000
    # Only slopes, taken against each site's own expansion of gravity, may tip a threshold here and there.
    assert np.linalg.norm(raised[0], axis=1).std() > 0.5
    assert np.median(difference) < 0.02
    assert np.percentile(difference, 95) < 0.3


def test_patch_is_the_same_for_any_number_of_threads(body: Body, sites: tuple[Site, ...]) -> None:
    coarse = {"seed": 1, "facet_m": 6.0, "radius_m": 60.0, "min_boulder_m": 2.0, "max_triangles": 150_000}
    built = []
    for count in (1, 4):
        with render_threads(count):
            built.append(build_patch(body, sites[1], PatchSpec(**coarse)))
    other = build_patch(body, sites[1], PatchSpec(**{**coarse, "seed": 2}))
    same = min(len(patch.vertices_L_m) for patch in (built[0], other))
    assert np.abs(built[0].vertices_L_m[:same] - other.vertices_L_m[:same]).max() > 0.5
    for name in ("vertices_L_m", "faces", "dust", "boulder_diameter_m", "boulder_position_L_m"):
        np.testing.assert_array_equal(getattr(built[0], name), getattr(built[1], name))


# --- dust and boulders ------------------------------------------------------------------------------------------


def test_dust_lies_on_level_ground_and_not_on_cliffs(body: Body, patches: list[Patch]) -> None:
    dust, slope = [], []
    for patch in patches:
        points, faces = ground_of(patch)
        near = np.linalg.norm(points, axis=1) < 120.0
        slope.append(np.degrees(np.arccos(-vertex_normals(points, faces)[near, 2])))
        dust.append(patch.dust[: len(points)][near])
    covered, steepness = np.concatenate(dust), np.concatenate(slope)
    assert covered[steepness < 12.0].mean() > 0.5
    assert covered[steepness > 50.0].mean() < 0.2
    # Dust is the smoother ground: it turns less from facet to facet.
    turns = {True: [], False: []}
    for patch in patches:
        points, faces = ground_of(patch)
        faces = faces[np.linalg.norm(points[faces[:, 0]], axis=1) < 40.0]
        mesh = trimesh.Trimesh(points, faces, process=False)
        mean = patch.dust[faces].mean(axis=1)[mesh.face_adjacency].mean(axis=1)
        turns[True].append(mesh.face_adjacency_angles[mean > 0.95])
        turns[False].append(mesh.face_adjacency_angles[mean < 0.05])
    assert np.median(np.concatenate(turns[True])) < 0.8 * np.median(np.concatenate(turns[False]))


def test_boulders_rest_in_the_ground(patches: list[Patch]) -> None:
    from vbnfault import render

    held = shown = total = 0
    for patch in patches[:2]:
        points, faces = ground_of(patch)
        ground = render.TerrainMesh(points.astype(np.float32), faces, np.zeros(len(faces), dtype=bool))
        rocks = trimesh.Trimesh(patch.vertices_L_m, patch.faces[patch.face_is_boulder], process=False)
        label = trimesh.graph.connected_component_labels(rocks.face_adjacency, node_count=len(rocks.faces))
        rock = np.zeros(len(patch.vertices_L_m), dtype=np.int64)
        rock[rocks.faces] = label[:, None]
        stones = np.arange(len(points), len(patch.vertices_L_m))
        stones = stones[np.linalg.norm(patch.vertices_L_m[stones], axis=1) < 60.0]
        place = patch.vertices_L_m[stones].astype(np.float64)
        above = -place[:, 2] - render.ground_height_m(ground, place[:, 0], place[:, 1], 300.0)
        for one in np.unique(rock[stones]):
            mine = np.flatnonzero(rock[stones] == one)
            height = -place[mine, 2]
            low = height < height.min() + 0.08 * np.ptp(height)
            total += 1
            held += int((above[mine][low] < 0.02).all())
            shown += int((above[mine] > 0).any())
    assert total > 100
    # Its lowest part lies in the ground. Facets here are as large as the smallest rocks, and ground between their
    # corners may dip once in a while.
    assert held > 0.965 * total, held / total
    assert shown > 0.9 * total  # a few small ones lie wholly in the ground


def test_boulders_are_where_they_are_said_to_be(patches: list[Patch]) -> None:
    patch = patches[0]
    rocks = trimesh.Trimesh(patch.vertices_L_m, patch.faces[patch.face_is_boulder], process=False)
    label = trimesh.graph.connected_component_labels(rocks.face_adjacency, node_count=len(rocks.faces))
    assert label.max() + 1 == len(patch.boulder_diameter_m) == len(patch.boulder_position_L_m)
    first = np.unique(label, return_index=True)[1]
    order = np.argsort(first)
    for k in order[:: max(1, len(order) // 50)]:
        mine = patch.vertices_L_m[np.unique(rocks.faces[label == k])].astype(np.float64)
        at = patch.boulder_position_L_m[np.flatnonzero(order == k)[0]]
        reach = np.linalg.norm(mine - at, axis=1).max()
        # Its longest extent is the diameter, to 6 %, and planes cut its sides unevenly.
        diameter_m = patch.boulder_diameter_m[np.flatnonzero(order == k)[0]]
        assert 0.49 * diameter_m < reach < 0.66 * diameter_m


def test_walls_are_no_steeper_than_facets_can_show() -> None:
    """A wall four times too steep across a mesh slumps to the limit; gentle ground is left as it was."""
    n = 40
    x, y = (axis.ravel().astype(float) for axis in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    points = np.column_stack([x, y, np.zeros(n * n)])
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = (corner[i : n - 1 + i, j : n - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
    faces = np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])
    both = np.concatenate([faces, faces[:, ::-1]]).astype(np.int32)  # closed: every edge runs both ways
    gentle = 0.2 * x + np.sin(y)
    np.testing.assert_array_equal(relief._slumped(points, both, gentle), gentle)
    wall = gentle + 6.0 * (x > n / 2)
    slumped = relief._slumped(points, both, wall)
    i, j = both[:, 0], both[:, 1]
    length = np.linalg.norm(points[i] - points[j], axis=1)
    assert (np.abs(wall[i] - wall[j]) / length).max() > 6
    assert (np.abs(slumped[i] - slumped[j]) / length).max() < 1.001 * relief._STEEPEST
    assert slumped.mean() == pytest.approx(wall.mean(), abs=1e-3)
    assert np.ptp(slumped) == pytest.approx(np.ptp(wall), rel=1e-3)


# --- 200 random views: closed from wherever the camera is, no look behind the ground ------------------------------


VIEWS, SIDE = 200, 48


@pytest.fixture(scope="module")
def terrain() -> tuple[Terrain, np.ndarray]:
    """A patch whose facets grow from 2 m to the model's own, and the geometric normals of its facets."""
    table = small_scene(patch={"facet_m": 2.0, "radius_m": 30.0, "min_boulder_m": 2.0})
    session = Session(config.parse_scene(table, source="test"))
    patch = session.patch(session.sites[1])
    a, b, c = (patch.vertices_L_m[patch.faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    return session.terrain(1), normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]


def test_no_ray_ever_sees_the_inside(terrain: tuple[Terrain, np.ndarray]) -> None:
    ground, normals = terrain
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-150, 150, size=(2, VIEWS))
    height = render.ground_height_m(ground.surface, x, y, 500.0) + rng.uniform(0.5, 100, VIEWS)
    position = np.column_stack([x, y, -height])
    clear = render.is_clear(ground.surface, position, 0.5)
    f = SIDE / 2 / np.tan(np.radians(32.5))
    seen = behind = 0
    for k in np.flatnonzero(clear):
        down = frames.direction_L(0, -90)
        axes = frames.L_from_C(down, *rng.uniform(-120, 120, 2), rng.uniform(0, 360))
        view = View(
            position_L_m=position[k],
            L_from_C=axes,
            intrinsics=np.array([f, f, SIDE / 2, SIDE / 2]),
            width_px=SIDE,
            height_px=SIDE,
        )
        rays = Optics(view).centre_rays()
        found = ground.surface.scene.ray_intersect_preliminary(rays, coherent=True)
        dr.eval(found, rays)
        valid = found.is_valid().numpy().astype(bool)
        away = np.array(rays.d).reshape(3, -1).T[valid]
        facing = np.einsum("ni,ni->n", normals[found.prim_index.numpy()[valid]], away)
        seen += valid.sum()
        # a facet seen edge-on within float32 rounding may fall on either side
        behind += np.count_nonzero(facing > 1e-4)
    assert clear.sum() > 0.8 * VIEWS
    assert seen > 50_000
    assert behind == 0
