"""Scarps and unevenly spread relief: where they are made, what they keep, and what leaves the ground as it is."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from conftest import small_scene

from vbnfault.body import Body, PatchSpec, build_patch, site_at
from vbnfault.body.fields import _UNITS_M, Octaves, smooth_step
from vbnfault.body.geometry import mean_edge_m
from vbnfault.body.relief import _contour_scarps, _unevenness
from vbnfault.body.roughness import Roughness
from vbnfault.body.scarps import Form, form, gathered
from vbnfault.pipeline import Session
from vbnfault.pipeline import session as sessions
from vbnfault.scene import config


def sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere of 1 km."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1000.0)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int32)


SPHERE, FACES = sphere(5)
EDGE = mean_edge_m(SPHERE, FACES)
OUTWARD = SPHERE / np.linalg.norm(SPHERE, axis=1)[:, None]
WAVELENGTH_M = 500.0
WAVE = np.cos(2 * np.pi * SPHERE[:, 2] / WAVELENGTH_M)
BAND = np.abs(SPHERE[:, 2]) < 400  # where the waves run along the surface


def steps(height_m: np.ndarray) -> np.ndarray:
    """Return the differences in height over the edges of the band, float64[n] in metres."""
    ends = np.concatenate([FACES[:, [0, 1]], FACES[:, [1, 2]], FACES[:, [2, 0]]])
    ends = ends[BAND[ends].all(axis=1)]
    return np.asarray(np.abs(height_m[ends[:, 0]] - height_m[ends[:, 1]]))


def after(height_m: np.ndarray) -> np.ndarray:
    """Return the heights of the sphere with waves after the filter, crests where the waves are high."""
    points = SPHERE + height_m[:, None] * OUTWARD
    where = Form(up=OUTWARD, crest=2 * WAVE, rough=np.ones(len(SPHERE)))
    # a model whose scarps reach a sixth of the waves
    return height_m + gathered(points, FACES, where, np.zeros(len(SPHERE)), WAVELENGTH_M / 3)


def test_slopes_gather_between_level_crests_and_floors() -> None:
    before = 10 * WAVE
    height = after(before)
    # of a sine, a fifth lies within 5 % of its extremes; of a square wave all
    level = np.abs(height[BAND]) > 9.5
    assert level.mean() > 1.5 * (np.abs(before[BAND]) > 9.5).mean()
    assert steps(height).max() > 1.3 * steps(before).max()
    # the differences along the edges say that a sphere curves, by up to half of edge²/radius
    curved_m = 0.5 * EDGE**2 / 1000.0
    assert np.abs(height).max() < 10 + 20 * curved_m


def test_a_plane_has_no_scarps() -> None:
    """The sphere's facets alone raise crests by at most a step of its curvature each time."""
    assert np.abs(after(np.zeros(len(SPHERE)))).max() < 20 * 0.5 * EDGE**2 / 1000.0


@pytest.fixture(scope="module")
def half_rough() -> Body:
    """Return a sphere that is rough where z > 0."""
    vertices, faces = sphere(3)
    height = np.random.default_rng(3).normal(size=len(vertices)) * np.where(vertices[:, 2] > 0, 0.02, 0.0025)
    return Body(name="half rough", vertices_m=vertices * (1 + height[:, None]), faces=faces)


def test_form_tells_rough_ground_from_smooth(half_rough: Body) -> None:
    found = form(half_rough, half_rough.vertices_m)
    rough, smooth = (found.rough[sign * half_rough.vertices_m[:, 2] > 300] for sign in (1, -1))
    assert np.median(rough) > 3 * np.median(smooth)
    assert rough.min() > smooth[np.argsort(smooth)[-20]]
    outward = half_rough.vertices_m / np.linalg.norm(half_rough.vertices_m, axis=1)[:, None]
    assert np.einsum("ni,ni->n", found.up, outward).min() > 0.98


def heights(body: Body, **keys: float) -> np.ndarray:
    """Return the height of a patch over the model (edges of 150 m) at the model's vertices, float64[n] in m."""
    spec = {"facet_m": 45.0, "radius_m": 3000.0, "min_boulder_m": 1e6, "relief": 0.0, "craters_per_km2": 0.0}
    site = site_at(body, 0, body.vertices_m[0])
    patch = build_patch(body, site, PatchSpec(seed=4, **{**spec, **keys}))
    points = patch.vertices_L_m[: len(body.vertices_m)] @ site.T_from_L.T + site.position_T_m
    return np.asarray(np.einsum("ni,ni->n", points - body.vertices_m, body.vertex_normals))


def test_uneven_relief_lies_on_rough_ground(half_rough: Body) -> None:
    even, uneven = (heights(half_rough, relief=1.0, intermittency=how) for how in (0.0, 1.0))
    north, south = (sign * half_rough.vertices_m[:, 2] > 300 for sign in (1, -1))
    assert uneven[north].std() / uneven[south].std() > 3 * even[north].std() / even[south].std()


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_uneven_relief_nearly_vanishes_on_level_ground(half_rough: Body, strength: float) -> None:
    law = Roughness(deviation_m=12.0, baseline_m=75.0, hurst=1.0)
    count = len(half_rough.vertices_m)
    noise = Octaves(half_rough.vertices_m, np.full(count, 45.0), 3, law, 400.0)
    # the other two causes are the same in all
    level, also, bare, steep = (
        _unevenness(half_rough, noise, np.full(count, slope, np.float32), strength) for slope in (0, 10, 38, 80)
    )
    np.testing.assert_allclose(level / steep, 0.03**strength, rtol=1e-6)  # float32 of the slope
    np.testing.assert_array_equal(level, also)
    np.testing.assert_allclose(bare, steep, rtol=1e-6)


def test_angular_relief_differs_where_it_is_longer_than_20_m(half_rough: Body) -> None:
    round_, angular = (heights(half_rough, relief=1.0, angularity=part) for part in (0.0, 1.0))
    assert np.corrcoef(round_, angular)[0, 1] < 0.9
    assert angular.std() == pytest.approx(round_.std(), rel=0.3)
    # the longest octave is as long as the model's edges, 15 m here
    small = Body(name="small", vertices_m=half_rough.vertices_m / 10, faces=half_rough.faces)
    spec = {"facet_m": 4.5, "radius_m": 300.0, "min_boulder_m": 1e6, "craters_per_km2": 0.0}
    np.testing.assert_array_equal(*(heights(small, relief=1.0, angularity=part, **spec) for part in (0.0, 1.0)))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("relief", 0.3),
        ("hurst", 0.4),
        ("scarps", 0.2),
        ("contour_scarps", 0.4),
        ("intermittency", 0.6),
        ("angularity", 0.7),
        ("craters_per_km2", 5.0),
        ("boulder_index", 2.5),
        ("boulders_per_km2", 30.0),
        ("min_boulder_m", 3.0),
        ("radius_m", 77.0),
    ],
)
def test_keys_of_a_scene_reach_the_ground(monkeypatch: pytest.MonkeyPatch, key: str, value: float) -> None:
    class BuiltError(Exception):
        pass

    def built(body: Body, site: object, spec: PatchSpec) -> None:
        raise BuiltError(spec)

    session = Session(config.parse_scene(small_scene(patch={key: value}), source="test"))
    monkeypatch.setattr(sessions, "cached_patch", built)
    with pytest.raises(BuiltError) as found:
        session.patch(session.sites[0])
    assert getattr(found.value.args[0], key) == value


def test_scarps_move_the_ground_by_their_fraction(half_rough: Body) -> None:
    flat, half, whole = (heights(half_rough, facet_m=30.0, scarps=part) for part in (0.0, 0.5, 1.0))
    assert np.abs(whole - flat).max() > 1.0
    # the patch holds float32 of some 2000 m, within 1e-4 m
    np.testing.assert_allclose(half - flat, 0.5 * (whole - flat), atol=1e-3)


def test_facets_too_coarse_for_scarps_leave_the_ground(half_rough: Body) -> None:
    np.testing.assert_array_equal(heights(half_rough, facet_m=45.0), heights(half_rough, facet_m=45.0, scarps=1.0))


def test_contour_scarps_gather_the_rise_of_a_slope_in_steep_lines() -> None:
    """A slope of 20° over 2 km: where layers crop out, a rise of up to 45 m stands in a scarp between treads.

    Heights return to the slope at the edge of each layer, so they stray by less than a layer.
    """
    side = np.arange(0.0, 2000.0, 4.0)
    x, y = np.meshgrid(side, side, indexing="ij")
    slope = np.tan(np.radians(20.0))
    place = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    law = Roughness(deviation_m=5.0, baseline_m=75.0, hurst=0.8)
    noise = Octaves(place, np.full(x.size, 4.0), 3, law, 400.0)
    added = _contour_scarps(noise, slope * place[:, 0], np.full(x.size, 20.0, np.float32)).reshape(x.shape)
    assert np.abs(added).max() < 45
    rise = np.gradient(slope * x + added, 4.0, axis=0)
    steep = rise > 2 * slope
    assert 0.01 < steep.mean() < 0.2  # lines, and not areas
    gentle = rise[(np.abs(added) > 0.5) & ~steep]
    assert np.median(gentle) < 0.9 * slope
    # lines run across the slope: what is steep has steep neighbours along y more often than along x
    along, across = (np.mean(steep & np.roll(steep, 5, axis)) for axis in (1, 0))
    assert along > 1.5 * across


def test_dust_covers_over_metres_where_facets_are_coarse() -> None:
    """The cover depends on the height over rock; the relief that coarse facets do not show widens its edge."""
    law = Roughness(deviation_m=5.0, baseline_m=75.0, hurst=0.8)
    rng = np.random.default_rng(0)
    place, deviates, spread = rng.uniform(0, 5000.0, (4000, 3)), rng.normal(size=100_000), []
    for facet_m in (0.1, 20.0):
        noise = Octaves(place, np.full(len(place), facet_m), 3, law, 400.0)
        above = [noise.dust_cover(np.full(len(place), h, np.float32), 0.5) for h in (-40.0, -1.0, 1.0, 40.0)]
        assert [cover.mean() for cover in above] == sorted(cover.mean() for cover in above)
        assert above[0].max() < 0.05
        # deep dust differs by units with normal deviations of these sizes, as far as the facets show them
        sigma = np.sqrt(sum((part * noise.shown(wavelength)[0]) ** 2 for wavelength, part in _UNITS_M))
        expected = smooth_step(-1.6, 2.0, 1 + sigma * deviates)
        # 0.16 over the root of 4000 points is 0.003; gradient noise has shorter tails than the normal law
        assert above[3].mean() == pytest.approx(expected.mean(), abs=0.015)
        assert above[3].std() == pytest.approx(expected.std(), rel=0.1)
        spread.append(above[2].mean() - above[1].mean())
        assert above[2].std() > 0.05  # units of 30 to 300 m differ
    assert spread[1] < 0.6 * spread[0]
