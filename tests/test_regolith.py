"""Ground of asteroids and moons: laws of craters and boulders, rubble, presets of bodies and on a user's shape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from vbnfault.body import Body, Patch, PatchSpec, Regolith, build_patch, choose_sites, ellipsoid, regolith
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


@pytest.fixture(scope="module")
def plain() -> tuple[np.ndarray, np.ndarray]:
    """Return heights of craters of 10 to 40 m on a plain of 800 m, and their bowls with a number each."""
    x, y = np.meshgrid(np.arange(SIDE) * STEP_M, np.arange(SIDE) * STEP_M, indexing="ij")
    place = np.column_stack([x.ravel() + 3100.0, 0.6 * y.ravel() - 2200.0, 0.8 * y.ravel() + 1700.0])
    noise = Octaves(place, np.full(len(place), 1.7), 5, Roughness(deviation_m=1.0, baseline_m=9.0, hurst=1.0), 50.0)
    # facets of 1.7 m leave out all cells whose smallest craters are below 10 m
    height = regolith.craters(noise, LAW, 0.0)[0].reshape(SIDE, SIDE)
    return height, ndimage.label(height < -1e-4)[0]


def test_craters_follow_their_size_law(plain: tuple[np.ndarray, np.ndarray]) -> None:
    """Areas of bowls, measured on the heights alone, against the law."""
    _, label = plain
    area = np.bincount(label.ravel())[1:] * STEP_M**2
    diameter = np.sqrt(4 * area / np.pi)
    ground = (SIDE * STEP_M) ** 2
    # The bowl of a parabola with a rim of a fifth of its depth ends at 0.89 radii, that of a worn one near its rim.
    for least in (12.0, 16.0, 24.0):
        expected = (LAW.above(least) - LAW.above(LAW.largest_m)) * ground
        found = np.count_nonzero(diameter > 0.93 * least)
        # Poisson's three deviations, and a tenth for overlaps and for the edge of the bowl
        assert abs(found - expected) < 3 * np.sqrt(expected) + 0.1 * expected, (least, found, expected)


def test_craters_are_as_deep_as_told(plain: tuple[np.ndarray, np.ndarray]) -> None:
    height, label = plain
    numbers = np.arange(1, label.max() + 1)
    area = np.bincount(label.ravel())[1:] * STEP_M**2
    diameter = np.sqrt(4 * area / np.pi)
    wide = diameter > 11.0
    lowest = -np.asarray(ndimage.minimum(height, label, numbers))[wide]
    ratio = lowest / diameter[wide]
    # Below the ground lie 0.32 of the 0.4 radii from rim to floor, within 0.93 diameters; some ghosts drop out.
    assert (ratio * 0.93 * 0.4 / 0.32).mean() == pytest.approx(LAW.depth, rel=0.12)
    assert ratio.max() < 1.15 * FRESH_DEPTH
    assert np.percentile(ratio, 10) < 0.3 * LAW.depth  # ghosts


def test_no_crater_is_cut() -> None:
    """Along a line, heights change no faster than the steepest wall; cells that miss a crater would cut it."""
    line = np.array([3100.0, -2200.0, 1700.0]) + np.linspace(0, 400, 400_001)[:, None] * np.array([0.6, 0.64, 0.48])
    height, _ = Points(line).impacts(6.0, 5, len(line), 1.0, 3.0, 0.5, 0.3)
    # walls of a fresh crater: 0.32 · 2 + 0.08 · 2 = 0.8; two may overlap
    assert np.abs(np.diff(height)).max() < 2 * 0.8 * 1e-3
    assert height.min() < -0.2
    # a comet's pits: 0.42 · 2 of the bowl, at most 0.07 · 3 of the rim, three of which may overlap
    pits = Points(line).craters(6.0, 5, len(line), 1.0)
    assert np.abs(np.diff(pits)).max() < 3 * 1.05 * 1e-3
    assert pits.min() < -0.2


def test_no_block_is_cut() -> None:
    """The level of the nearest cell jumps only at a border, where the gap is 0; a missed cell has no gap there."""
    line = np.array([3100.0, -2200.0, 1700.0]) + np.linspace(0, 400, 400_001)[:, None] * np.array([0.6, 0.64, 0.48])
    level, _, gap = Points(line).blocks(6.0, 5, len(line))
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
            "patch": {"facet_m": 2.0, "radius_m": 60.0, "max_triangles": 400_000},
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


def test_many_craters_need_regolith() -> None:
    with pytest.raises(InputError, match=r"craters_per_km2 = 800: must be at most 600 without \[patch.regolith\]"):
        config.parse_scene({"title": "t", "patch": {"craters_per_km2": 800.0}}, source="t.toml")
