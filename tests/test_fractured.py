"""Layered and jointed ground: its steps, its dust, its boulders, and what makes it look broken and not melted."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from ground_kit import deviation_over_law, ground_of, raised_from_two_sites
from scipy import stats

from vbnfault.body import (
    Body,
    Fractured,
    Patch,
    PatchSpec,
    build_patch,
    choose_sites,
    fractured,
    load_body,
)
from vbnfault.body.boulders import GroundMesh, _favour
from vbnfault.body.fields import PLANES_STD, Octaves, Points
from vbnfault.body.geometry import vertex_normals
from vbnfault.body.roughness import Roughness
from vbnfault.core.errors import InputError
from vbnfault.scene.config import load_scene

FINE = {"seed": 7, "facet_m": 0.7, "radius_m": 40.0, "min_boulder_m": 0.8, "max_triangles": 300_000}


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture(scope="module")
def patches(body: Body) -> list[Patch]:
    sites = choose_sites(body, 3, seed=7)
    return [build_patch(body, site, PatchSpec(**FINE, fractured=Fractured())) for site in sites]


def octaves(place_m: np.ndarray, facet_m: float) -> Octaves:
    law = Roughness(deviation_m=12.0, baseline_m=75.0, hurst=1.0)
    return Octaves(place_m, np.full(len(place_m), facet_m), 3, law, 80.0)


# --- closed forms -----------------------------------------------------------------------------------------------


def test_layers_cover_a_coordinate_without_gaps() -> None:
    x = np.linspace(-5000.0, 5000.0, 400_001)
    index, inside, thickness = fractured._layers(x, 10.0, (1, 2))
    assert inside.min() >= 0
    assert inside.max() <= 1
    assert set(np.unique(np.diff(index))) == {0, 1}
    # Edges are jittered by up to 0.8 of a cell: layers measure 2 to 18 m, 10 m in the mean.
    assert 2.0 <= thickness.min() < 6.0 < 14.0 < thickness.max() <= 18.0
    assert (index[-1] - index[0]) / 1000.0 == pytest.approx(1.0, abs=0.002)
    # Within a layer the position rises evenly by the step over its thickness; float32 of it: 6e-8.
    same = np.diff(index) == 0
    np.testing.assert_allclose(np.diff(inside)[same], 0.025 / thickness[1:][same], atol=3e-6)


def test_planes_are_linear_between_edges() -> None:
    line = np.array([3100.0, -2200.0, 1700.0]) + np.linspace(0, 300, 60_001)[:, None] * np.array([0.6, 0.64, 0.48])
    height = Points(line).planes(20.0, 5, len(line)).astype(np.float64)
    # Values of neighbours differ by at most 1 over an edge of a cell: 5 mm of 20 m, on each of three axes.
    assert np.abs(np.diff(height)).max() < 3 * 0.005 / 20
    # The line meets some ten faces of tetrahedra in each of its 15 cells; elsewhere only float32 bends it.
    assert np.mean(np.abs(np.diff(height, 2)) > 1e-6) < 15 * 10 / 60_000
    spread = Points(np.random.default_rng(1).uniform(-3000, 3000, (200_000, 3))).planes(20.0, 5, 200_000)
    assert spread.std() == pytest.approx(PLANES_STD, rel=0.01)
    assert spread.mean() == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize(("angularity", "straight"), [(0.0, False), (0.5, False), (1.0, True)])
def test_angular_octaves_are_planes_as_high_as_the_waves(angularity: float, straight: bool) -> None:
    line = np.array([910.0, 470.0, -330.0]) + np.linspace(0, 400, 40_001)[:, None] * np.array([0.6, 0.64, 0.48])
    noise = octaves(line, 0.01)
    height = noise.fractal(80.0, 60.0, 0, angularity).astype(np.float64)  # the octave of 80 m alone
    # Between points 1 m apart, a wave bends by (2 pi / 80)^2, 6e-3, of its height of metres. Float32 of 8 m bends a
    # plane by 1e-6 m, except at the few edges of the 5 cells: found are 0.01 and 0.96 of all points.
    bent = np.abs(height[200::100] - 2 * height[100:-100:100] + height[:-200:100])
    assert (np.mean(bent < 1e-4) > 0.8) == straight
    scattered = np.random.default_rng(2).uniform(-9000, 9000, (100_000, 3))
    spread = octaves(scattered, 1.0).fractal(80.0, 60.0, 0, angularity).std()
    assert spread == pytest.approx(float(noise.amplitude(80.0)), rel=0.02)


def test_layers_turn_an_incline_into_treads_and_scarps() -> None:
    # An incline of 25°, finely sampled. The layers gather its rise into scarps, and change no height by more than
    # two of the thickest layers.
    x = np.arange(0.0, 1500.0, 0.25)
    place = np.column_stack([x, 0.37 * x, 0.11 * x])
    steep = np.tan(np.radians(25.0))
    noise = octaves(place, 0.25)
    rise = fractured._terraces(noise, steep * x, np.full(len(x), steep, np.float32), np.ones(len(x), np.float32))
    slope = np.gradient(steep * x + rise, x)
    assert slope.mean() == pytest.approx(steep, rel=0.1)
    assert np.median(slope) < 0.6 * steep  # treads are most of the way
    assert np.percentile(slope, 97) > 2.5 * steep  # scarps
    assert np.abs(rise).max() < 2 * 1.8 * 34.0
    # none of it where there are no layers, and scarps are as wide as coarse facets can show
    nothing = fractured._terraces(
        noise, steep * x, np.full(len(x), steep, np.float32), np.zeros(len(x), np.float32)
    )
    assert not nothing.any()


def bedrock_of_an_incline(**keys: float) -> fractured.Bedrock:
    """Rock on an incline of 25°, sampled every 0.25 m along 1.5 km."""
    x = np.arange(0.0, 1500.0, 0.25)
    slope = np.full(len(x), 25.0, np.float32)
    place = np.column_stack([x, 0.37 * x, 0.11 * x])
    elevation = np.tan(np.radians(25.0)) * x
    nothing = np.zeros(len(x), np.float32)
    spec = Fractured(**keys)
    return fractured.bedrock(
        octaves(place, 0.25), nothing, elevation, slope, lambda height: slope + 0 * height, spec
    )


def test_the_rock_is_made_of_planes_joints_and_layers() -> None:
    def bend(height: np.ndarray) -> float:
        """Median over the mean of the second differences, 0.85 for a Gaussian, near 0 between sharp edges."""
        second = np.abs(np.diff(height[::8].astype(np.float64), 2))
        return float(np.median(second) / second.mean())

    planes = bedrock_of_an_incline(strata=0.0, joints=0.0)
    np.testing.assert_array_equal(planes.height_m, planes.swell_m)
    assert planes.height_m.std() > 1.0
    assert bend(planes.height_m) < 0.5
    # keys act in proportion, and each brings height of its own
    jointed = [bedrock_of_an_incline(strata=0.0, joints=value).height_m - planes.height_m for value in (1.0, 2.0)]
    assert jointed[0].std() > 0.3
    np.testing.assert_allclose(jointed[1], 2 * jointed[0], atol=1e-3)
    layered = [bedrock_of_an_incline(strata=value, joints=0.0).height_m - planes.height_m for value in (1.0, 2.0)]
    assert layered[0].std() > 0.3
    np.testing.assert_allclose(layered[1], 2 * layered[0], atol=1e-3)


def test_boulders_gather_on_debris_by_the_factor_asked_for() -> None:
    side = 40
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(side) * 5.0, np.arange(side) * 5.0, indexing="ij"))
    corner = np.arange(side * side).reshape(side, side)
    faces = np.column_stack([corner[:-1, :-1].ravel(), corner[1:, :-1].ravel(), corner[:-1, 1:].ravel()]).astype(
        np.int32
    )
    points = np.column_stack([x, y, 0 * x])
    up = np.tile([0.0, 0.0, -1.0], (len(faces), 1))
    for apron in (1.0, 8.0):
        spec = PatchSpec(seed=1, fractured=Fractured(apron=apron))
        density = []
        for talus in (0.0, 1.0):
            ground = GroundMesh(
                points=points,
                faces=faces,
                facet_m=np.full(len(points), 5.0),
                dust=np.full(len(points), 0.3, np.float32),
                talus=np.full(len(points), talus, np.float32),
                place_T_m=points,
            )
            density.append(_favour(ground, up, faces, spec))
        np.testing.assert_allclose(density[1], apron * density[0], rtol=1e-6)
        assert density[0].std() > 0  # clusters


# --- the ground of a patch --------------------------------------------------------------------------------------


def test_fractured_ground_continues_the_models_spectrum(body: Body, patches: list[Patch]) -> None:
    ratio = deviation_over_law(body, patches, [2.5, 5.0, 12.0, 30.0])
    # as for the rounded ground: three places differ from each other by a factor of two
    assert (ratio > 0.6).all(), ratio
    assert (ratio < 1.6).all(), ratio


def test_dust_thins_out_with_the_slope(patches: list[Patch]) -> None:
    dust, slope = [], []
    for patch in patches:
        points, faces = ground_of(patch)
        near = np.linalg.norm(points, axis=1) < 200.0
        slope.append(np.degrees(np.arccos(-vertex_normals(points, faces)[near, 2])))
        dust.append(patch.dust[: len(points)][near])
    cover, steepness = np.concatenate(dust), np.concatenate(slope)
    means = [cover[(steepness >= low) & (steepness < low + 10)].mean() for low in range(0, 70, 10)]
    # falls with the slope, without a step: no more than a third from one ten degrees to the next
    assert all(a > b - 0.02 for a, b in itertools.pairwise(means)), means
    assert max(a - b for a, b in itertools.pairwise(means)) < 0.33
    assert means[0] > 0.5
    assert means[-1] < 0.1
    # The angle of repose: no dust lies on ground steeper than 42 + 2°. Here slopes refer to the vertical of the
    # site; that of the ground differs by some degrees within 200 m.
    assert np.mean(cover[steepness > 47.0] > 0.1) < 2e-3
    # soft borders: an eighth of the ground at least is neither bare nor wholly covered
    assert np.mean((cover > 0.15) & (cover < 0.85)) > 1 / 8


def test_neighbouring_sites_see_the_same_fractured_ground(body: Body) -> None:
    raised, difference = raised_from_two_sites(body, 110.0, facet_m=6.0, radius_m=150.0, fractured=Fractured())
    assert len(difference) > 300
    # Elevation and slopes refer to each site's own expansion of gravity, and scarps slump along each mesh's edges.
    heights = np.linalg.norm(raised, axis=2)
    assert heights[0].std() > 0.5
    assert np.median(difference) < 0.05
    assert stats.spearmanr(*heights)[0] > 0.95


# --- keys -------------------------------------------------------------------------------------------------------


def test_keys_of_the_scene() -> None:
    assert load_scene("quickstart").patch.fractured is None
    assert load_scene("navcam67p", {"patch.fractured": {}}).patch.fractured is not None
    table = load_scene("quickstart", {"patch.fractured": {"dust_m": 2.5}}).patch.fractured
    assert table is not None
    assert Fractured(**table.model_dump()) == Fractured(dust_m=2.5)
    for key, value in (("dust_slope_deg", [40.0, 20.0]), ("apron", 0.0), ("border_m", 0.0), ("strata", -1.0)):
        with pytest.raises(InputError, match=key):
            load_scene("quickstart", {f"patch.fractured.{key}": value})
