"""Ground of asteroids and moons: laws of craters and boulders, rubble, presets of bodies and on a user's shape."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

from vbnfault.body import Body, Patch, PatchSpec, Regolith, build_patch, choose_sites, ellipsoid, fields, regolith
from vbnfault.body.fields import Octaves, Points
from vbnfault.body.regolith import FRESH_DEPTH, SATURATION, CraterLaw
from vbnfault.body.roughness import Roughness
from vbnfault.core.errors import InputError
from vbnfault.pipeline import Session
from vbnfault.scene import bodies, config
from vbnfault.world import assemble

BODIES = bodies.packaged_bodies()
LAW = CraterLaw(per_m2=8e-4, index=2.5, largest_m=40.0, equilibrium=0.2, depth=0.1)
STEP_M, SIDE = 0.8, 1000
LINE = np.array([3100.0, -2200.0, 1700.0]) + np.linspace(0, 400, 400_001)[:, None] * np.array([0.6, 0.64, 0.48])
ACROSS = np.tile([0.8, -0.48, -0.36], (len(LINE), 1))


def heights(law: CraterLaw) -> np.ndarray:
    """Return heights of craters of 10 to 40 m on a plain of 800 m."""
    x, y = np.meshgrid(np.arange(SIDE) * STEP_M, np.arange(SIDE) * STEP_M, indexing="ij")
    place = np.column_stack([x.ravel() + 3100.0, 0.6 * y.ravel() - 2200.0, 0.8 * y.ravel() + 1700.0])
    # facets of 1.3 m leave out all cells whose smallest craters are below 10 m
    facet_m, up = np.full(len(place), 1.3), np.tile([0.0, -0.8, 0.6], (len(place), 1))
    noise = Octaves(place, facet_m, 5, Roughness(deviation_m=1.0, baseline_m=9.0, hurst=1.0), 50.0, up)
    return regolith.craters(noise, law, 0.0)[0].reshape(SIDE, SIDE)


@pytest.fixture(scope="module")
def plain() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heights of fresh and of worn craters on the plain, and the bowls of the fresh with a number each."""
    fresh = heights(dataclasses.replace(LAW, depth=FRESH_DEPTH))
    return fresh, heights(LAW), ndimage.label(fresh < -1e-4)[0]


def diameters(label: np.ndarray) -> np.ndarray:
    """Return diameters of bowls, which end at the level of the ground, at 0.85 radii (Fassett & Thomson 2014)."""
    return np.asarray(np.sqrt(4 * np.bincount(label.ravel())[1:] * STEP_M**2 / np.pi) / 0.85)


def test_craters_follow_their_size_law(plain: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    """Areas of bowls, measured on the heights alone, against the law."""
    diameter = diameters(plain[2])
    ground = (SIDE * STEP_M) ** 2
    for least in (12.0, 16.0, 24.0):
        expected = (LAW.above(least) - LAW.above(LAW.largest_m)) * ground
        found = np.count_nonzero(diameter > least)
        # Poisson's three deviations, and a tenth for overlaps and for what later ones erase
        assert abs(found - expected) < 3 * np.sqrt(expected) + 0.1 * expected, (least, found, expected)


def test_craters_are_as_deep_as_told(plain: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    """Below the ground lie 0.33 of the 0.4 radii of a fresh crater, and all of one without a rim."""
    fresh, worn, label = plain
    numbers = np.arange(1, label.max() + 1)
    lowest, now = (-np.asarray(ndimage.minimum(height, label, numbers)) for height in (fresh, worn))
    wide = diameters(label) > 11.0
    assert (lowest / diameters(label))[wide].mean() == pytest.approx(0.163, rel=0.08)
    profiles = fields._worn_craters()
    depth = np.interp((now / lowest)[wide], profiles[:, 0] / profiles[-1, 0], np.linspace(0, FRESH_DEPTH, 32))
    # later ones deepen those on which they lie, which they cover to some tenths
    assert depth.mean() == pytest.approx(LAW.depth, rel=0.15)
    assert np.percentile(depth, 10) < 0.6 * LAW.depth  # ghosts, many of which are erased


def test_craters_wear_as_diffusion_asks_for() -> None:
    """Profiles of the table, diffused once more, are its profiles of smaller depth."""
    profiles = fields._worn_craters()
    x = np.linspace(0, 1.5, profiles.shape[1])
    depth = profiles.max(axis=1) - profiles[:, 0]
    # the first rounding takes 2 % of the depth, and tapering the worn ones up to 3 %
    np.testing.assert_allclose(depth, np.linspace(0, 0.4, 32), atol=0.015)
    axis = np.arange(-1.5, 1.51, 0.02)
    fresh = np.interp(np.hypot(axis, axis[:, None]), x, profiles[-1])
    middle = len(axis) // 2
    for width in (0.1, 0.2, 0.33):
        worn = ndimage.gaussian_filter(fresh, width / 0.02, mode="constant")[middle, middle:]
        row = (worn.max() - worn[0]) / 0.4 * 31
        here = [np.interp(row, np.arange(32), column) for column in profiles.T]
        # the tapered ejecta and steps between rows: 0.01 radii, of a fresh rim of 0.07 and a depth of 0.4
        assert np.abs(np.interp(axis[middle:], x, here) - worn)[:60].max() < 0.01
    # a rim is round over a tenth of the radius: its slope changes by 0.8 + 0.3 over no less than that
    assert np.abs(np.diff(profiles[-1], 2)).max() < 1.1 * (x[1] - x[0]) ** 2 / 0.1


def test_ground_holds_no_craters_that_are_older() -> None:
    """Craters of cells of 6 m last for 2 to 6 m, and within 0.8 of the longest they share the ground."""
    law = (1.0, 3.0, 0.5, 0.0, 1e9)

    def on(age_m: float) -> tuple[np.ndarray, ...]:
        return Points(LINE, ACROSS).impacts(6.0, 5, np.full(len(LINE), age_m, np.float32), 1, *law)

    height, _, age = on(np.inf)
    assert age.min() < 6.0
    np.testing.assert_array_equal(on(9.0)[0], height)
    young, bright, still = on(0.1)
    assert np.abs(young).mean() < 0.35 * np.abs(height).mean()
    assert bright.max() > 0.2  # the freshest are as young, and on ground of their age half of them shows
    np.testing.assert_allclose(still, np.minimum(age, 0.1), rtol=1e-6)


def test_no_crater_is_cut() -> None:
    """Along a line, heights change no faster than the steepest wall; cells that miss a crater would cut it."""
    never = np.full(len(LINE), np.inf, np.float32)
    height, *_ = Points(LINE, ACROSS).impacts(6.0, 5, never, 1, 1.0, 3.0, 0.5, 0.3, 1e9)
    # walls of a fresh crater: 0.8; two may overlap, and the edge of what a later one erases is as steep
    assert np.abs(np.diff(height)).max() < 2 * 0.8 * 1e-3
    assert height.min() < -0.2
    complex_, *_ = Points(LINE, ACROSS).impacts(6.0, 5, never, 1, 1.0, 3.0, 0.5, 0.3, 0.5)
    assert np.abs(np.diff(complex_)).max() < 2 * 0.8 * 1e-3
    assert complex_.min() > 0.6 * height.min()  # they are shallower
    # a comet's pits: 0.42 · 2 of the bowl, at most 0.07 · 3 of the rim, three of which may overlap
    pits = Points(LINE).craters(6.0, 5, len(LINE), 1.0)
    assert np.abs(np.diff(pits)).max() < 3 * 1.05 * 1e-3
    assert pits.min() < -0.2


def test_no_block_is_cut() -> None:
    """The level of the nearest cell jumps only at a border, where the gap is 0; a missed cell has no gap there."""
    level, _, gap = Points(LINE).blocks(6.0, 5, len(LINE))
    jumps = np.flatnonzero(np.abs(np.diff(level)) > 0.05)
    assert len(jumps) > 30
    # nearest points lie within the eight cells but for a few in a hundred: the jitter moves them by 0.35 cells
    assert np.mean(gap[jumps] < 0.01) > 0.95


def test_equilibrium_bounds_the_law() -> None:
    law = CraterLaw(per_m2=1e-2, index=3.0, largest_m=1e3, equilibrium=0.05, depth=0.13)
    assert law.above(1.0) == pytest.approx(0.05 * SATURATION)
    assert law.above(500.0) == pytest.approx(1e-2 * 50.0**-3)
    # half of geometric saturation needs more craters than a layer of cells holds
    assert law.octave(2.0)[0] > 1 > law.octave(400.0)[0] > 0
    assert law.octave(2.0)[1] == pytest.approx(2)
    assert law.octave(400.0)[1] == pytest.approx(3)


def small_body() -> Body:
    vertices, faces = ellipsoid((260.0, 240.0, 230.0), 4.0)
    return Body(name="small", vertices_m=vertices, faces=faces, density_kg_m3=1190.0, rotation_period_s=15_000.0)


def test_rubble_leaves_no_ground_between_and_fine_material_levels_it() -> None:
    x, y = np.meshgrid(np.arange(300) * 0.1, np.arange(300) * 0.1, indexing="ij")
    place = np.column_stack([x.ravel() + 90.0, y.ravel() + 70.0, np.zeros(x.size)])
    noise = Octaves(place, np.full(len(place), 0.1), 5, Roughness(deviation_m=0.5, baseline_m=9.0, hurst=1.0), 12.0)
    level, zero = np.zeros(len(place), np.float32), np.zeros(len(place))
    keys: dict[str, Any] = {"seed": 5, "min_boulder_m": 0.4, "relief": 0.0, "craters_per_km2": 0.0}
    spec = PatchSpec(**keys, regolith=Regolith(rubble=1.0))
    height = regolith.surface(noise, zero, level, 0.0, spec)[1].reshape(300, 300)
    rise = np.hypot(*np.gradient(height, 0.1))
    assert np.mean(rise < 0.03) < 0.05
    smooth = PatchSpec(**keys, regolith=Regolith(rubble=1.0, smooth=0.5))
    filled = regolith.surface(noise, zero, level, 50.0, smooth)  # all of it lies below 50 m
    assert filled[2].min() > 0.99
    assert np.abs(filled[1]).max() < 0.1 * np.abs(height).max()


def test_boulders_lie_all_around_a_small_body_and_have_two_albedos() -> None:
    body = small_body()
    site = choose_sites(body, 1, seed=3)[0]
    spec = PatchSpec(
        seed=3,
        facet_m=4.0,
        radius_m=600.0,
        min_boulder_m=5.0,
        boulder_near_m=600.0,
        boulders_per_km2=720.0,
        boulder_index=2.9,
        max_triangles=400_000,
        regolith=Regolith(rubble=0.9),
    )
    patch = build_patch(body, site, spec)
    far = patch.boulder_position_L_m[:, 2] > 230.0  # L's z is down: the other half of the body
    assert far.mean() == pytest.approx(0.5, abs=0.1)
    expected = 720e-6 * ((5.0 / 7.0) ** -2.9 - (45.0 / 7.0) ** -2.9) * body.area_m2
    assert patch.boulders_drawn == pytest.approx(expected, abs=4 * np.sqrt(expected))
    shade = patch.dust[patch.faces[patch.face_is_boulder][:, 0]]
    assert np.mean(shade < 0) == pytest.approx(0.65, abs=0.1)
    assert np.abs(patch.dust).max() <= 1.5


def test_boulders_are_as_long_as_their_diameters() -> None:
    """What counts of boulders measure is their largest extent; 42 directions tell it within 6 %."""
    body = small_body()
    spec = PatchSpec(
        seed=3, facet_m=8.0, radius_m=600.0, min_boulder_m=12.0, boulder_near_m=600.0, boulders_per_km2=720.0
    )
    patch = build_patch(body, choose_sites(body, 1, seed=3)[0], spec)
    faces = patch.faces[patch.face_is_boulder]
    label = trimesh.graph.connected_component_labels(trimesh.graph.face_adjacency(faces), node_count=len(faces))
    order = np.unique(label, return_index=True)[1].argsort()
    assert len(order) > 20
    for number, diameter_m in zip(order, patch.boulder_diameter_m, strict=True):
        corners = patch.vertices_L_m[np.unique(faces[label == number])]
        longest_m = np.linalg.norm(corners[:, None] - corners, axis=2).max()
        assert 0.99 * diameter_m < longest_m < 1.06 * diameter_m


# --- presets ----------------------------------------------------------------------------------------------------


def patch_of(scene: config.Scene) -> tuple[Session, Patch]:
    session = Session(scene)
    return session, session.patch(session.sites[0])


@pytest.mark.parametrize("name", [name for name in BODIES if name != "67p"])
def test_the_preset_of_every_body_renders(name: str) -> None:
    scene = config.parse_scene(
        {
            "title": "t",
            "dataset": {"samples": 1, "sites": 1, "layers": ["depth_m"]},
            "body": {"name": name},
            "patch": {"facet_m": 3.0, "radius_m": 40.0, "max_triangles": 400_000},
            "camera": {"width_px": 48, "height_px": 48},
            "geometry": {"height_m": [150.0, 160.0], "min_lit_fraction": 0.5},
        },
        source="t.toml",
    )
    assert scene.patch.regolith is not None
    assert scene.patch.boulder_index == BODIES[name].patch["boulder_index"]
    image = Session(scene).simulate(0).layers["image"]
    assert image.std() > 0.02 * image.max()  # a ground with relief, not a grey plain


def test_a_preset_refines_a_users_own_shape(tmp_path: Path) -> None:
    path = tmp_path / "mine.obj"
    trimesh.creation.icosphere(subdivisions=4, radius=250.0).export(path)  # edges of 17 m
    tables = {
        "title": "t",
        "dataset": {"samples": 1, "sites": 1},
        "body": {"name": "mine", "shape": str(path), "unit": "m", "density_kg_m3": 1190.0},
        "patch": {"preset": "bennu", "facet_m": 1.5, "radius_m": 60.0, "max_triangles": 400_000},
    }
    scene = config.parse_scene(tables, source="t.toml")
    assert (
        scene.patch.regolith
        == config.parse_scene({"body": {"name": "Bennu"}, "title": "t"}, source="t").patch.regolith
    )
    session, patch = patch_of(scene)
    assert patch.boulders_drawn > 100
    # larger boulders and craters are those of the shape
    assert 10.0 < patch.boulder_diameter_m.max() < 20.0
    contrast = assemble.dust_contrast(session.scene)
    assert contrast is not None
    assert np.all(contrast == scene.patch.regolith.albedo_contrast)


def test_a_smooth_shape_has_the_roughness_of_a_preset(tmp_path: Path) -> None:
    """Points 10 m apart differ in height as the key says, which regions vary by some tens of per cent."""
    path = tmp_path / "ball.obj"
    trimesh.creation.icosphere(subdivisions=3, radius=250.0).export(path)
    patch: dict[str, Any] = {"preset": "moon", "craters_per_km2": 0.0, "boulders": False, "relief": 1.0}
    deviation = {}
    for roughness in (0.0, 0.05):
        patch |= {"facet_m": 2.0, "radius_m": 120.0, "max_triangles": 200_000, "roughness": roughness}
        body = {"name": "mine", "shape": str(path), "unit": "m"}
        _, ground = patch_of(
            config.parse_scene(
                {"title": "t", "dataset": {"sites": 1}, "body": body, "patch": patch}, source="t.toml"
            )
        )
        near = ground.vertices_L_m[np.linalg.norm(ground.vertices_L_m, axis=1) < 120.0].astype(np.float64)
        height_m = np.linalg.norm(near + ground.site.position_T_m @ ground.site.T_from_L, axis=1)
        tree = cKDTree(near)
        a, b = tree.query_pairs(10.5, output_type="ndarray").T
        apart = np.linalg.norm(near[a] - near[b], axis=1) > 9.5
        deviation[roughness] = np.sqrt(np.mean((height_m[a] - height_m[b])[apart] ** 2))
    assert deviation[0.0] < 0.1 * deviation[0.05]
    assert 0.5 * 0.5 < deviation[0.05] < 2.0 * 0.5


@pytest.mark.parametrize("name", BODIES)
def test_the_roughness_of_a_preset_is_that_of_the_packaged_shape(name: str) -> None:
    session = Session(config.parse_scene({"title": "t", "body": {"name": name}}, source="t.toml"))
    law, roughness = session.body.roughness, session.scene.patch.roughness
    assert law.at_least(roughness) == law
    assert law.at_least(1.05 * roughness) != law


def test_craters_of_a_large_body_do_not_swallow_a_small_one() -> None:
    """Craters of the Moon are up to 100 km wide: one of those turned this body inside out."""
    tables = {
        "title": "t",
        "dataset": {"samples": 1, "sites": 1, "seed": 3},
        "body": {"name": "mine", "shape": "ellipsoid", "semi_axes_m": [250.0, 240.0, 230.0], "relief_m": 4.0},
        "patch": {"preset": "moon", "facet_m": 12.0, "radius_m": 1e3, "boulders": False, "max_triangles": 200_000},
    }
    _, patch = patch_of(config.parse_scene(tables, source="t.toml"))
    centre = -patch.site.position_T_m @ patch.site.T_from_L
    radius_m = np.linalg.norm(patch.vertices_L_m - centre, axis=1)
    assert 150.0 < radius_m.min() < radius_m.max() < 300.0


def test_many_craters_need_regolith() -> None:
    with pytest.raises(InputError, match=r"craters_per_km2 = 800: must be at most 600 without \[patch.regolith\]"):
        config.parse_scene({"title": "t", "patch": {"craters_per_km2": 800.0}}, source="t.toml")
