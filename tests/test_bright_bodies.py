"""Bright bodies beside the target: where planets stand, how bright they are, and the straylight they give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import small_scene
from test_scene_straylight import SINGLET, behind, disc

from vbnfault.core import frames
from vbnfault.core.errors import VbnfaultError
from vbnfault.core.process import llvm
from vbnfault.lens import load_lens
from vbnfault.lens.straylight.scatter import Cleanliness
from vbnfault.lens.straylight.scene import PointSources, surrounding_grids
from vbnfault.scene import config
from vbnfault.scene.surroundings import BrightBodyTable
from vbnfault.world.bright_bodies import PLANETS, bright_bodies, lambert_phase, planet

try:
    llvm.find()
except VbnfaultError as error:
    pytest.skip(f"no usable LLVM: {error}", allow_module_level=True)


def seen_from_earth(name: str, julian_date: float) -> tuple[float, float]:
    """Angle from the Sun in degrees, and V magnitude."""
    sun = -PLANETS["earth"].position_J_au(julian_date)
    body = planet(name, julian_date, sun)
    angle = np.degrees(np.arccos(body.direction_J @ frames.unit(sun)))
    return float(angle), float(-26.76 - 2.5 * np.log10(body.of_sunlight))


@pytest.mark.parametrize(
    ("name", "julian_date", "angle_deg", "magnitude"),
    [
        ("jupiter", 2455461.0, 180.0, -2.94),  # opposition of 2010-09-21, at -2.94
        ("mars", 2452880.2, 180.0, -2.88),  # perihelic opposition of 2003-08-28, at -2.88
        ("venus", 2456084.56, 0.15, None),  # transit of 2012-06-06
        ("mercury", 2457518.12, 0.09, None),  # transit of 2016-05-09
    ],
)
def test_planets_stand_where_they_were_seen(
    name: str, julian_date: float, angle_deg: float, magnitude: float | None
) -> None:
    """Dates, separations and magnitudes as published. A planet in opposition may be 2° off in latitude (Mars 6.6°).
    A planet in transit stands within the Sun's radius; the Earth is up to 0.02° off the barycentre."""
    angle, found = seen_from_earth(name, julian_date)
    assert angle == pytest.approx(angle_deg, abs=7 if name == "mars" else 2 if angle_deg else 0.1)
    if angle_deg < 1:
        assert angle < 0.27
    if magnitude is not None:
        assert found == pytest.approx(magnitude, abs=0.2)  # no opposition surge: 0.11 of Mars at 5°


def test_light_follows_phase_and_distance() -> None:
    assert lambert_phase(0.0) == 1
    assert lambert_phase(np.pi / 2) == pytest.approx(1 / np.pi)
    assert lambert_phase(np.pi) == pytest.approx(0, abs=1e-15)
    # a quarter of Jupiter, 3 au from it: light of its V(1, 0) and distances, by the phase law
    from_sun = PLANETS["jupiter"].position_J_au(2457000.5)
    aside = frames.unit(np.cross(from_sun, [0.0, 0, 1]))
    light = planet("jupiter", 2457000.5, -(from_sun + 3 * aside)).of_sunlight
    full = 10 ** (0.4 * (9.395 - 26.76)) / (3 * np.linalg.norm(from_sun)) ** 2
    assert light == pytest.approx(full / np.pi, rel=1e-12)
    own = BrightBodyTable(right_ascension_deg=90.0, declination_deg=0.0, of_sunlight=1e-3, angular_radius_deg=2.0)
    (body,) = bright_bodies((own,), 2457000.5, np.array([1.0, 0, 0]), 2.0)
    np.testing.assert_allclose(body.direction_J, [0, 1, 0], atol=1e-15)
    assert body.of_sunlight == pytest.approx(1e-3 / 4)
    assert body.angular_radius_rad == pytest.approx(np.radians(2.0))


def test_a_far_body_is_like_a_lit_patch_of_the_same_light(tmp_path: Path) -> None:
    """Beside the frame, against the pixels of a coarse render around it."""
    (tmp_path / "singlet.toml").write_text(SINGLET)
    singlet = load_lens(tmp_path / "singlet.toml")
    dusty = Cleanliness(roughness_nm=1.0, level=100)
    scene = behind(singlet, 32, 30.0, cleanliness=dusty)
    grids = surrounding_grids(scene.render)
    scene = replace(scene, around=grids)
    dark = np.zeros((1, *scene.render.shape), np.float32)
    around = [np.zeros((1, *grid.shape), np.float32) for grid in grids]
    around[0] += disc(grids[0].shape, 0.75, 0.5, 0.06)
    lit = grids[0].irradiance(around[0])[0]
    by_pixels = scene.straylight(dark, np.eye(1), around)
    x, y = (float((lit @ v) / lit.sum()) for v in grids[0].slopes)
    radius = np.arctan(0.06 * grids[0].shape[1] / grids[0].focal_px) / (1 + x * x)
    points, part = PointSources.of_disc(np.array([x, y, 1.0]), float(radius), scene.render.focal_px, scene.reach)
    assert len(points.x) == 19
    irradiance = np.full((1, 19), lit.sum(dtype=np.float64) * part, dtype=np.float32)
    nothing = [np.zeros_like(a) for a in around]
    found = scene.straylight(dark, np.eye(1), nothing, [(points, irradiance)])
    for name in ("ghosts", "glare", "veil"):
        own, oracle = getattr(found, name), getattr(by_pixels, name)
        assert oracle.any(), name
        # a disc of directions is a slightly drawn out disc of pixels, here at 37°
        assert own.sum() == pytest.approx(oracle.sum(), rel=0.03), name


def test_points_beyond_reach_are_left_out() -> None:
    points, part = PointSources.of_disc(np.array([1.0, 0, 0.1]), 0.3, 100.0, 3.0)
    assert 0 < len(points.x) < 19
    assert part == 1 / 19
    assert np.hypot(points.x, points.y).max() < 3
    behind_camera, _ = PointSources.of_disc(np.array([0.0, 0, -1.0]), 0.01, 100.0, 3.0)
    assert not behind_camera.x


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"planet": "pluto"}, "planet"),
        ({"planet": "mars", "of_sunlight": 0.1}, "of_sunlight = 0.1: does not apply to planet = 'mars'"),
        ({"planet": "mars", "angular_radius_deg": 1.0}, "angular_radius_deg = 1"),
        ({"right_ascension_deg": 1.0, "of_sunlight": 0.1}, "declination_deg: is missing"),
        ({"right_ascension_deg": 1.0, "declination_deg": 95.0, "of_sunlight": 0.1}, "declination_deg"),
    ],
)
def test_wrong_bodies_are_refused_in_a_sentence(body: dict[str, object], words: str) -> None:
    with pytest.raises(VbnfaultError, match=words) as caught:
        config.parse_scene(small_scene(sky={"bodies": [body]}), source="test.toml")
    assert len(str(caught.value).splitlines()) <= 2
