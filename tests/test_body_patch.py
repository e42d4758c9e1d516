"""Terrain patches: closed, fine where it matters, deterministic, with the published boulders."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import stats

from vbnfault.body import (
    Body,
    Patch,
    PatchSpec,
    Site,
    boulders,
    build_patch,
    choose_sites,
    load_body,
    refine,
    relief,
)
from vbnfault.body.boulders import PER_KM2, SizeLaw, scatter, smallest_at
from vbnfault.body.shape import check_mesh
from vbnfault.core.errors import InputError
from vbnfault.pipeline import Session
from vbnfault.scene.config import load_scene
from vbnfault.scene.target import PatchTable

QUICK = {"facet_m": 4.0, "radius_m": 150.0, "min_boulder_m": 0.8, "max_triangles": 1_200_000}


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture(scope="module")
def site(body: Body) -> Site:
    return choose_sites(body, 3, seed=7)[2]


@pytest.fixture(scope="module")
def patch(body: Body, site: Site) -> Patch:
    return build_patch(body, site, PatchSpec(seed=7, **QUICK))


@pytest.fixture(scope="module")
def full(body: Body, site: Site) -> Patch:
    return build_patch(body, site, PatchSpec(seed=7))


def ground(patch: Patch) -> trimesh.Trimesh:
    return trimesh.Trimesh(patch.vertices_L_m, patch.faces[~patch.face_is_boulder], process=False)


def near_edges(patch: Patch, radius_m: float) -> np.ndarray:
    faces = patch.faces[~patch.face_is_boulder]
    faces = faces[np.linalg.norm(patch.vertices_L_m[faces].mean(axis=1), axis=1) < radius_m]
    a, b = patch.vertices_L_m[faces], patch.vertices_L_m[np.roll(faces, 1, axis=1)]
    return np.linalg.norm(a - b, axis=2)


def test_full_patch_keeps_its_budget_and_resolution(full: Patch) -> None:
    assert full.vertices_L_m.dtype == full.dust.dtype == np.float32
    assert full.faces.dtype == np.int32
    assert full.face_is_boulder.dtype == full.face_is_flat.dtype == np.bool_
    assert full.triangles == len(full.face_is_boulder) == len(full.face_is_flat) <= 1_600_000
    # Twelve centimetres, coarsened by at most sqrt(2) to keep the budget; relief lengthens edges.
    assert 0.10 < near_edges(full, 20.0).mean() < 0.22
    # Beyond, less than three pixels of the widest view (65° over 1024 px: 1.24 mm per metre) from 100 m above.
    assert near_edges(full, 60.0).mean() < 3 * 100.0 * 1.24e-3 * 1.5
    assert full.face_is_boulder.sum() > 100_000
    assert len(full.dust) == len(full.vertices_L_m)
    assert 0.0 <= full.dust.min() < full.dust.max() <= 1.0
    assert full.dust[full.faces[full.face_is_boulder].min() :].max() == 0.0


def test_ground_and_boulders_are_closed(patch: Patch, body: Body) -> None:
    # No T-junctions, no seams, wound outwards: every edge twice, once each way.
    assert ground(patch).is_watertight
    assert ground(patch).is_winding_consistent
    # Metres of relief over a square kilometre are 1e-4 of the volume; float32 adds less.
    assert ground(patch).volume == pytest.approx(body.volume_m3, rel=2e-3)
    rocks = trimesh.Trimesh(patch.vertices_L_m, patch.faces[patch.face_is_boulder], process=False)
    assert rocks.is_watertight
    label = trimesh.graph.connected_component_labels(rocks.face_adjacency, node_count=len(rocks.faces))
    # Volumes about each rock's first corner: about the origin, float32's rounding would hide a small rock.
    corner = rocks.triangles - rocks.triangles[np.unique(label, return_index=True)[1]][label][:, :1]
    volume = np.bincount(label, np.linalg.det(corner) / 6.0)
    assert len(volume) > 1000
    assert (volume > 0).all()


def test_smooth_patch_stays_near_the_model(body: Body, site: Site) -> None:
    plain = {**QUICK, "min_boulder_m": 100.0}
    smooth = build_patch(body, site, PatchSpec(seed=7, relief=0.0, **plain))
    assert not smooth.face_is_boulder.any()
    model = (body.vertices_m - site.position_T_m) @ site.T_from_L
    # The model's own points come first and do not move: float32 of kilometres keeps 0.25 mm.
    np.testing.assert_allclose(smooth.vertices_L_m[: len(model)], model, atol=3e-4)
    # The site is on the model's surface; new points leave a chord by at most 6 % of it, level after level:
    # under 0.06 · 2 · 100 m for edges of up to 100 m.
    assert np.linalg.norm(smooth.vertices_L_m, axis=1).min() < 12.0
    check_mesh(smooth.vertices_L_m, smooth.faces, "smooth patch")
    # Longest edges first keeps shapes: the worst angle of the fine ground stays above a third of the model's
    # worst tenth of a percent.
    assert _smallest_angles(smooth, 150.0).min() > 3.0


def test_slope_and_elevation_all_over_the_body_are_those_of_its_gravity(body: Body, site: Site) -> None:
    """Airfall lies by slope and elevation; both are compared with the polyhedron's gravity at 200 vertices.

    Gravity is interpolated between 400 places, 340 m apart. Half of that, over the body's radius of 1.65 km, turns
    the vertical by 6 deg, and departs from its tangent by 9 m; both are the scale of the errors in the median.
    """
    dust = [
        build_patch(body, site, PatchSpec(seed=1, facet_m=1e6, relief=0, airfall=factor, boulders_per_km2=0)).dust
        for factor in (0.0, 1.0)
    ]
    airfall = (dust[1] - dust[0])[: len(body.vertices_m)]
    chosen = np.random.default_rng(3).choice(len(body.vertices_m), 200, replace=False)
    points = body.vertices_m[chosen]
    gravity = body.effective_gravity(points)
    up = -gravity / np.linalg.norm(gravity, axis=1)[:, None]
    slope = np.degrees(np.arccos(np.einsum("ni,ni->n", up, body.vertex_normals[chosen])))
    potential = body.gravity.evaluate(points).potential_m2_s2 + 0.5 * body.omega_rad_s**2 * np.sum(
        points[:, :2] ** 2, axis=1
    )
    elevation = -potential / body.mean_gravity_m_s2 - np.median(body.places[2])
    expected = np.clip(-elevation / (0.18 * 1650), -1, 1) + np.clip(1 - slope / 30, -1, 1)
    error = np.abs(airfall[chosen] - expected)
    assert np.median(error) < 6 / 30 + 9 / 300
    assert np.quantile(error, 0.95) < 2.5 * (6 / 30 + 9 / 300)


def test_the_vertical_all_over_a_small_body_is_that_of_its_gravity() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    axes_m = np.array([267.0, 147.0, 104.0])
    small = Body(name="s", vertices_m=ball.vertices * axes_m, faces=ball.faces, rotation_period_s=40_000.0)
    near = choose_sites(small, 1, seed=5)[0]
    points = small.vertices_m[::13]
    up, elevation_m = relief._vertical(small, near, points - near.position_T_m)
    gravity = small.effective_gravity(points)
    sine = np.linalg.norm(np.cross(up, gravity), axis=1) / np.linalg.norm(gravity, axis=1)
    assert np.degrees(np.arcsin(sine)).max() < 0.5
    potential = small.gravity.evaluate(points).potential_m2_s2
    potential += 0.5 * small.omega_rad_s**2 * np.sum(points[:, :2] ** 2, axis=1)
    assert np.abs(elevation_m + potential / small.mean_gravity_m_s2).max() < 0.1


def _smallest_angles(patch: Patch, radius_m: float) -> np.ndarray:
    corners = patch.vertices_L_m[patch.faces].astype(np.float64)
    corners = corners[np.linalg.norm(corners.mean(axis=1), axis=1) < radius_m]
    angles = []
    for k in range(3):
        u, v = (corners[:, (k + j) % 3] - corners[:, k] for j in (1, 2))
        angles.append(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("ij,ij->i", u, v)))
    return np.degrees(np.min(angles, axis=0))


def test_refining_a_coarse_ball_rounds_it() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1000.0)
    body = Body(name="ball", vertices_m=np.array(ball.vertices), faces=np.array(ball.faces))
    site = choose_sites(body, 1, seed=0)[0]
    fine = build_patch(
        body, site, PatchSpec(seed=0, facet_m=10.0, radius_m=3000.0, relief=0.0, min_boulder_m=100.0)
    )
    centre = -site.position_T_m @ site.T_from_L
    radius = np.linalg.norm(fine.vertices_L_m - centre, axis=1)
    # Edges of 0.31 rad: the midpoint rule errs by 0.24 m, of fourth order; area-weighted normals are up to
    # 0.03 rad from radial, which moves a midpoint by 0.03 · 310 m / 4 = 2.3 m.
    assert np.abs(radius - 1000.0).max() < 3.0
    chord = 1000.0 * (1 - np.cos(np.radians(9.3)))
    assert chord > 12.0  # what straight midpoints would have missed by


def test_relief_is_a_few_percent_of_its_wavelength(body: Body, site: Site) -> None:
    plain = {**QUICK, "min_boulder_m": 100.0}
    smooth = build_patch(body, site, PatchSpec(seed=7, relief=0.0, **plain))
    rough = build_patch(body, site, PatchSpec(seed=7, **plain))
    np.testing.assert_array_equal(smooth.faces, rough.faces)
    near = np.linalg.norm(smooth.vertices_L_m, axis=1) < 150.0
    moved = np.linalg.norm(rough.vertices_L_m - smooth.vertices_L_m, axis=1)
    # Octaves of 3 m at 57 m wavelength and less below, scarps, pits: metres, neither centimetres nor tens of them.
    assert 0.5 < moved[near].std() < 8.0
    assert moved.max() < 40.0
    # Far away, where facets are coarser than half of every wavelength, nothing moves.
    far = np.linalg.norm(smooth.vertices_L_m, axis=1) > 2500.0
    assert moved[far].max() == 0.0


def test_rocks_are_cut_in_blocks_as_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    drawn = rng.normal(size=(42, 3)), rng.normal(size=(7, 5, 3))
    sphere, planes = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in drawn)
    depth = rng.uniform(0.45, 0.8, (7, 5))
    radius = np.minimum(1, (depth[..., None] / np.maximum(planes @ sphere.T, 0.05)).min(axis=1))
    for corners in (1 << 20, 100, 1):
        monkeypatch.setattr(boulders, "_CORNERS_AT_ONCE", corners)
        # the product rounds twice more than the sum of three terms, in float64
        np.testing.assert_allclose(
            boulders._cut(sphere, planes, depth), radius / radius.max(axis=1, keepdims=True), rtol=1e-13
        )


def test_boulder_sizes_and_numbers_follow_the_published_law() -> None:
    # Ten flat square kilometres in unequal strips, boulders from 2 m; half the ground avoided.
    x = np.array([0.0, 1000.0, 4000.0, 10_000.0])
    points = np.concatenate([np.column_stack([x, 0 * x, 0 * x]), np.column_stack([x, 0 * x + 1000.0, 0 * x])])
    faces = np.array([f for k in range(3) for f in ((k, k + 1, k + 5), (k, k + 5, k + 4))], dtype=np.int32)
    favour = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    rng = np.random.default_rng(4)
    diameter, face, at, least = scatter(points, faces, favour, np.full(6, 2.0), SizeLaw(), rng)
    assert (least == 2.0).all()
    # N(>= D) = 98 (D/7)^-3.6 per km² (Pajola 2015), Poisson; less the truncation above 45 m, 0.1 %.
    for size in (2.0, 3.0, 7.0):
        expected = 10 * 98.0 * (size / 7.0) ** -3.6
        assert abs((diameter >= size).sum() - expected) < 4 * np.sqrt(expected) + 2e-3 * expected
    assert stats.kstest(_quantiles(diameter, least, 3.6), "uniform").pvalue > 1e-3
    assert diameter.max() <= 45.0
    assert set(np.unique(face)) == {0, 1, 2, 3}
    # On the favoured strips alone, and even over them: the mean of x over 0..4000 m within 4 sigma.
    assert abs(at[:, 0].mean() - 2000.0) < 4 * 4000.0 / np.sqrt(12 * len(at))


def _quantiles(diameter: np.ndarray, smallest: np.ndarray, index: float) -> np.ndarray:
    """Where each size stands in the law truncated at the smallest and at 45 m: uniform over 0..1 if it holds."""
    d, s = diameter.astype(np.float64), smallest.astype(np.float64)
    return (1 - (s / d) ** index) / (1 - (s / 45.0) ** index)


@pytest.mark.parametrize("index", [2.5, 3.6])
def test_boulders_of_a_patch_follow_the_law(body: Body, site: Site, index: float) -> None:
    stony = build_patch(body, site, PatchSpec(seed=7, **QUICK, boulder_index=index))
    diameter, smallest = stony.boulder_diameter_m, stony.boulder_smallest_m
    assert len(diameter) > 500
    quantiles = _quantiles(diameter, smallest, index)
    # Float32 rounds sizes by 6e-8 of themselves, quantiles by less than 1e-6.
    assert -1e-6 < quantiles.min() <= quantiles.max() < 1 + 1e-6
    assert stats.kstest(quantiles, "uniform").pvalue > 1e-3
    distance = np.linalg.norm(stony.boulder_position_L_m, axis=1)
    assert (smallest > 0.95 * smallest_at(distance, 0.8) - 0.1).all()


def test_the_density_of_boulders_is_the_published_one() -> None:
    """3546 boulders on 36.4 km² (Pajola et al. 2015), to the Poisson error of that count; scenes start from it."""
    assert abs(PER_KM2 - 3546 / 36.4) <= np.sqrt(3546) / 36.4
    assert PatchTable.model_fields["boulders_per_km2"].default == PER_KM2


def test_density_of_boulders_is_what_was_asked_for(body: Body, site: Site) -> None:
    # Large ones only, so that neither paving nor the triangle budget leaves any out.
    counts = {}
    for density in (0.0, 24.5, 98.0):
        sparse = build_patch(
            body, site, PatchSpec(seed=7, facet_m=12.0, radius_m=400.0, min_boulder_m=1.5, boulders_per_km2=density)
        )
        counts[density] = len(sparse.boulder_diameter_m)
    assert counts[0.0] == 0
    assert not build_patch(body, site, PatchSpec(seed=7, facet_m=12.0, min_boulder_m=1e6)).face_is_boulder.any()
    # Four times the density, Poisson; paving takes the smallest in the densest places.
    assert 2.5 < counts[98.0] / counts[24.5] < 4.6


@pytest.mark.parametrize("min_boulder_m", [0.05, 100.0])
def test_a_warning_counts_the_boulders_that_the_budget_leaves_out(min_boulder_m: float) -> None:
    changes = {"patch.facet_m": 20.0, "patch.min_boulder_m": min_boulder_m, "patch.max_triangles": 10_000}
    session = Session(load_scene("quickstart", changes), source="quickstart")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        patch = session.patch(session.sites[0])
    kept, drawn = len(patch.boulder_diameter_m), patch.boulders_drawn
    wanted = [f"site 0: {drawn - kept} of {drawn} boulders are left out"] if min_boulder_m < 1 else []
    assert [str(w.message).split(",")[0] for w in caught] == wanted


def test_too_few_triangles_for_the_model_are_refused(body: Body, site: Site) -> None:
    with pytest.raises(InputError, match="max_triangles = 100: must be at least twice the model's"):
        build_patch(body, site, PatchSpec(seed=0, max_triangles=100))


@pytest.mark.parametrize("radius_m", [40.0, 400.0, 1e8])
def test_fine_facets_all_over_a_body_are_foreseen_without_making_them(
    radius_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The default facets over 4e6 m² or more would be 6e8 triangles: the limit grows, and no mesh is that large."""
    made: list[int] = []
    refined = refine.refine

    def counted(*model: Any) -> Any:
        mesh = refined(*model)
        made.append(len(mesh[2]))
        return mesh

    monkeypatch.setattr(refine, "refine", counted)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=600.0)
    points = np.array(ball.vertices) - [600.0, 0.0, 0.0]
    model = (points, np.array(ball.vertices) / 600.0, np.array(ball.faces))
    budget = 50_000
    limit = refine.affordable(refine.EdgeLimit(0.12, radius_m), model, budget)
    assert max(made) < 10 * budget
    # edges are halved, so that the number of triangles goes by steps of up to a factor of two on either side
    assert budget / 2 < len(refined(*model, limit)[2]) < 2 * budget


def test_facets_near_the_size_of_the_models_own_are_foreseen() -> None:
    """Facets of four times the size asked for would split no edge of this model of 11 m edges."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=300.0)
    points = np.array(ball.vertices) - [300.0, 0.0, 0.0]
    model = (points, np.array(ball.vertices) / 300.0, np.array(ball.faces))
    budget = 60_000
    limit = refine.affordable(refine.EdgeLimit(2.0, 250.0), model, budget)
    # as above
    assert budget / 2 < len(refine.refine(*model, limit)[2]) < 2 * budget
