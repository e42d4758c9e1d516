"""The dust around a body: its light against closed forms, quadrature and rays, its table, its place in a store."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import ellipsoids_of
from poses_kit import columns_of, row
from scipy.integrate import quad

import vbnfault
from vbnfault import pipeline
from vbnfault.body import Body, ellipsoid, site_at
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import BODY, SKY
from vbnfault.dataset.identity import scene_identity, stored_scene
from vbnfault.render.description import View
from vbnfault.scene import config
from vbnfault.scene.coma import ComaTable, PhaseFunctionTable
from vbnfault.scene.trajectory import as_trajectory
from vbnfault.world.coma import Coma, Lines, Outflow, Shadow, make_coma, relative_phase, sun_axes
from vbnfault.world.coma_ground import diffuse_reflectance, dust_towards_sun, irradiance_of_sky
from vbnfault.world.haze import haze

pytestmark = pytest.mark.filterwarnings("ignore:body.shape = 'ellipsoid'")

RADIUS_M = 1000.0
SUN = np.array([0.9, 0.3, 0.2]) / np.linalg.norm([0.9, 0.3, 0.2])
# x, y, z, full width in degrees, strength
JETS = ((1, 0, 0.3, 10, 0.3), (0.6, 0.8, 0, 5, 0.2), (0, 0.2, 1, 40, 0.2), (-0.5, 0.5, 0.7, 110, 0.4))


def outflow(sunlit_fraction: float = 0.7, jets: Any = JETS) -> Outflow:
    """Dust with jets, all of which are lit."""
    table = np.array(jets, dtype=float).reshape(-1, 5)
    return Outflow(
        sun=SUN,
        sunlit_fraction=sunlit_fraction,
        axes=table[:, :3] / np.linalg.norm(table[:, :3], axis=1, keepdims=True),
        concentration=np.log(2) / (1 - np.cos(np.radians(table[:, 3]) / 2)),
        strength=table[:, 4],
    )


def coma(flow: Outflow) -> Coma:
    """Dust around a sphere of 1 km, with Afρ = 1 m."""
    return Coma(
        centre_L_m=np.zeros(3),
        reach_m=1.06 * RADIUS_M,
        core_m=0.1 * RADIUS_M,
        afrho_m=1.0,
        outflow=flow,
        table=ComaTable(afrho_cm=100.0),
    )


def directions(count: int, seed: int = 3) -> np.ndarray:
    """Return random unit vectors, float64[count, 3]."""
    drawn = np.random.default_rng(seed).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def spiral(count: int) -> np.ndarray:
    """Return even points of the unit sphere, float64[count, 3]."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)


def test_the_density_has_the_mean_of_its_definition() -> None:
    even = spiral(200_000)  # they give the mean of the narrowest jet within 1e-4
    assert outflow(jets=()).density(even).mean() == pytest.approx(1, rel=1e-6)
    assert outflow().density(even).mean() == pytest.approx(1 + sum(jet[4] for jet in JETS), rel=1e-3)
    edge = np.radians(20)
    axis_and_edge = np.array([[0, 0, 1], [np.sin(edge), 0, np.cos(edge)]])
    jet, without = (outflow(jets=jets).density(axis_and_edge) for jets in ([(0, 0, 1, 40, 1)], ()))
    assert np.divide(*(jet - without)[::-1]) == pytest.approx(0.5)


def test_lines_agree_with_adaptive_quadrature() -> None:
    """Also through the axes of narrow jets. The quadrature integrates over the length of the line."""
    flow, camera = outflow(), np.array([2.0, -2.5, 1.0])
    targets = np.concatenate([flow.axes * 1.3, flow.axes * 4, directions(6)])
    rays = (targets - camera) / np.linalg.norm(targets - camera, axis=1, keepdims=True)
    lengths = np.where(np.arange(len(rays)) % 2, 6.0, np.inf)
    lines = Lines.between(camera, rays, lengths)
    got = flow.swept(lines) / lines.distance_m

    def piece(s: float, ray: np.ndarray) -> float:
        point = camera + s * ray
        return float(flow.density((point / np.linalg.norm(point))[None])[0] / (point @ point))

    for ray, length, value in zip(rays, lengths, got, strict=True):
        end = min(length, 1e4)
        stops = [0.0, *np.linalg.norm(targets - camera, axis=1), 3.0, 6.0, 20.0, 300.0, end]
        stops = sorted({s for s in stops if s <= end})
        want = sum(quad(piece, a, b, (ray,), limit=200)[0] for a, b in itertools.pairwise(stops))
        if np.isinf(length):  # far away the direction from the centre is that of the line
            want += flow.density(ray[None])[0] / end
        assert value == pytest.approx(want, rel=1e-4)


def test_the_column_through_the_core_is_exact() -> None:
    dust = coma(outflow())
    start, length = np.array([-5e3, -5e3, -50.0, 20.0]), np.array([np.inf, 4970.0, 500.0, 40.0])
    distance = np.array([30.0, 30.0, 30.0, 99.0])
    got = dust.column(start, distance, length)
    for s, b, t, value in zip(start, distance, length, got, strict=True):
        stops = sorted({s, *(x for x in (-95.4, 95.4, 0.0, 14.1) if s < x < s + t), min(s + t, 1e7)})
        want = sum(
            quad(lambda x, b=b: 1 / max(x * x + b * b, dust.core_m**2), p, q, limit=200)[0]
            for p, q in itertools.pairwise(stops)
        )
        assert value == pytest.approx(want, rel=1e-4)


# --- phase function -----------------------------------------------------------------------------------------


def test_phase_functions_have_their_published_values() -> None:
    # Schleicher 2010 as tabulated; sbpy documents 0.5872 at 15°
    got = relative_phase("halley_marcus", np.array([0, 15, 53, 90, 120, 180.0]))
    np.testing.assert_allclose(got, [1, 0.5872, 0.3383, 0.5375, 1.4389, 1231.2], rtol=1e-12)
    # above 42° the composite is Marcus' curve, with the even light of gas of 1/100 at 90°. The formula is
    # independent of the table, whose four digits are rounded by up to 0.00005 / 0.34
    angle = np.arange(46.0, 181.0)
    marcus = relative_phase("marcus", angle) / relative_phase("marcus", 90.0)
    ratio = relative_phase("halley_marcus", angle) / (marcus + 0.01)
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=2.5e-4)
    # between the nodes the table has no steps: half-way is near the geometric mean of the neighbours
    middle = relative_phase("halley_marcus", angle[:-1] + 0.5)
    whole = relative_phase("halley_marcus", angle)
    np.testing.assert_allclose(middle, np.sqrt(whole[1:] * whole[:-1]), rtol=0.012)
    table = PhaseFunctionTable(phase_deg=(0, 90, 180), value=(2.0, 0.5, 8.0))
    np.testing.assert_allclose(relative_phase(table, [0, 45, 90, 135]), [1, 0.5, 0.25, 1.0])


@pytest.mark.filterwarnings("ignore")  # of astropy
def test_the_composite_is_that_of_sbpy() -> None:
    """All 181 values of the table, and 1e-3 between them: sbpy interpolates the values, not their logarithm."""
    units = pytest.importorskip("astropy.units", reason="sbpy (the extra 'oracles') is not installed")
    activity = pytest.importorskip("sbpy.activity", reason="sbpy (the extra 'oracles') is not installed")
    angle = np.arange(181.0)
    theirs = np.asarray(activity.phase_HalleyMarcus(angle * units.deg))
    np.testing.assert_allclose(relative_phase("halley_marcus", angle), theirs, rtol=1e-12)
    between = angle[:-1] + 0.5
    theirs = np.asarray(activity.phase_HalleyMarcus(between * units.deg))
    np.testing.assert_allclose(relative_phase("halley_marcus", between), theirs, rtol=1e-3)


def test_the_phase_angle_is_exact_near_opposition_and_the_sun() -> None:
    dust = coma(outflow())
    for phase in (0.0, 0.5, 179.5, 180.0):
        cosine = -np.cos(np.radians(phase))  # of the angle between the line of sight and the Sun
        want = float(relative_phase("halley_marcus", phase))
        assert dust.phase(np.array([cosine]))[0] == pytest.approx(want, rel=1e-5)


# --- shadow -------------------------------------------------------------------------------------------------


def two_spheres() -> tuple[np.ndarray, np.ndarray]:
    """Two spheres, one beside the other: the shadow of one falls upon the other."""
    vertices, faces = ellipsoid((RADIUS_M, RADIUS_M, RADIUS_M))
    small = 0.5 * vertices + RADIUS_M * np.array([1.2, 0.9, 0.4])
    return np.concatenate([vertices, small]), np.concatenate([faces, faces + len(vertices)])


def test_the_shadow_agrees_with_rays_to_the_sun() -> None:
    """Shadow rays from 4000 points of each line: their light agrees within what a step of the map leaves."""
    from vbnfault.render import TerrainMesh, heights_towards_sun
    from vbnfault.render.runtime import mi

    vertices, faces = two_spheres()
    surface = TerrainMesh(vertices.astype(np.float32), faces, np.zeros(len(faces), dtype=bool))
    reach = 1.06 * float(np.linalg.norm(vertices, axis=1).max())
    axes = sun_axes(SUN)
    shadow = Shadow.of(heights_towards_sun(surface, np.zeros(3), axes, reach, 256), axes, reach)
    flow, camera = outflow(), np.array([-3e3, 9e3, 2e3])
    behind = -SUN * np.linspace(1500, 20e3, 60)[:, None] + 1500 * directions(60, seed=5)
    before = 1700 * directions(60, seed=6) + 600 * SUN  # also between the spheres
    rays = np.concatenate([behind, before]) - camera
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for centre, radius in ((np.zeros(3), RADIUS_M), (RADIUS_M * np.array([1.2, 0.9, 0.4]), 0.5 * RADIUS_M)):
        rays = rays[np.linalg.norm(np.cross(centre - camera, rays), axis=1) > 1.02 * radius]
    rays = rays[:: len(rays) // 40][:40]
    lines = Lines.between(camera, rays, np.full(40, np.inf))
    lit = 1 - shadow.swept(lines, flow) / flow.swept(lines)
    angle = lines.start_rad[:, None] + lines.swept_rad[:, None] * (np.arange(4000) + 0.5) / 4000
    units = (
        lines.nearest[:, None] * np.cos(angle)[..., None] + lines.along[:, None] * np.sin(angle)[..., None]
    ).reshape(-1, 3)
    points = units * (lines.distance_m[:, None] / np.cos(angle)).reshape(-1, 1)
    columns = [mi.Float(np.ascontiguousarray(c, np.float32)) for c in points.T]
    hidden = surface.occluded(mi.Ray3f(mi.Point3f(*columns), mi.Vector3f(*SUN.tolist())), True, coherent=False)
    weights = flow.density(units).reshape(40, -1)
    want = (weights * ~hidden.numpy().astype(bool).reshape(40, -1)).sum(axis=1) / weights.sum(axis=1)
    assert np.ptp(want) > 0.3
    # a step is a 48th of the part that the shadow can reach; its edges are located within a few percent of a step
    np.testing.assert_allclose(lit, want, atol=0.004)


def sphere_shadow(half_m: float) -> Shadow:
    """Return the shadow of the sphere of 1 km."""
    along = (np.arange(256) + 0.5) * 2 * half_m / 256 - half_m
    square = along[None] ** 2 + along[:, None] ** 2
    heights = np.where(square < RADIUS_M**2, np.sqrt(np.maximum(RADIUS_M**2 - square, 0)), -np.inf)
    return Shadow.of(heights.astype(np.float32), sun_axes(SUN), half_m)


def test_the_body_is_dark_behind_itself_and_lit_before_itself() -> None:
    shadow = sphere_shadow(1.06 * RADIUS_M)
    axes, across = shadow.axes, shadow.axes[0]
    for point, is_lit in (
        (2 * RADIUS_M * SUN, True),
        (-9 * RADIUS_M * SUN + 0.97 * RADIUS_M * across, False),
        (-9 * RADIUS_M * SUN + 1.03 * RADIUS_M * across, True),
        (1.02 * RADIUS_M * (0.6 * SUN + 0.8 * across), True),
        (-1.01 * RADIUS_M * SUN, False),
    ):
        at = [np.array([[axis @ point]], dtype=np.float32) for axis in axes]
        assert (shadow.clearance_m(*at)[0, 0] > 0) == is_lit


# --- image --------------------------------------------------------------------------------------------------


def view_of(position: Any, target: Any, fov_deg: float, size: int = 96) -> View:
    z = np.array(target, float) - position
    z /= np.linalg.norm(z)
    x = np.cross([0.3, 0.2, 1.0], z)
    x /= np.linalg.norm(x)
    focal = size / 2 / np.tan(np.radians(fov_deg) / 2)
    return View(
        position_L_m=np.array(position, float),
        L_from_C=np.stack([x, np.cross(z, x), z], axis=1),
        intrinsics=np.array([focal, focal, size / 2, size / 2]),
        width_px=size,
        height_px=size,
    )


@pytest.mark.parametrize(
    ("position", "target", "fov_deg", "size"),
    [
        ((2500.0, -14e3, 4e3), (0, 0, 0), 12, 96),
        ((1e5, 5e4, 0), (0, 0, 0), 5, 520),  # nodes lie two pixels apart
        ((0, -1010.0, 0), (1500, -1250.0, 150), 65, 96),  # the ground below, from inside the coma
        ((-4500.0, 500, 250), (0, 0, 0), 40, 96),  # the Sun behind the body
    ],
)
def test_an_image_agrees_with_lines_through_every_pixel(
    position: Any, target: Any, fov_deg: float, size: int
) -> None:
    """Coarse grids, against the same integrals without interpolation, of a sphere with its shadow."""
    view, dust = view_of(position, target, fov_deg, size), coma(outflow())
    shadow = sphere_shadow(dust.reach_m)
    tangent = (np.arange(size) + 0.5 - size / 2) / view.intrinsics[0]
    x, y = np.meshgrid(tangent, tangent)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ view.L_from_C.T
    norm = np.linalg.norm(rays, axis=1)
    rays /= norm[:, None]
    start = rays @ view.position_L_m
    distance2 = view.position_L_m @ view.position_L_m - start**2
    reached = -start - np.sqrt(np.maximum(RADIUS_M**2 - distance2, 0))
    length = np.where((distance2 < RADIUS_M**2) & (reached > 0), reached, np.inf)
    semantic = np.where(np.isinf(length), SKY, BODY).astype(np.uint8).reshape(size, size)
    depth = (length / norm).astype(np.float32).reshape(size, size)

    got, optical_depth = haze(dust, shadow, view, depth, semantic)
    light = dust.relative(view.position_L_m, rays, length, shadow)[0] * dust.phase(rays @ SUN)
    column = dust.column(start, np.sqrt(np.maximum(distance2, 1e-6)), length)
    want = (light * column / (8 * np.pi**2)).reshape(size, size)
    # of the ground: Afρ / (2 π 4 p) for each unit of the column, with the dust in shadow
    ground = np.isfinite(length)
    lines = Lines.between(view.position_L_m, rays, length)
    dust_column = dust.outflow.swept(lines) / lines.distance_m / (8 * np.pi * 0.04)
    apart = np.abs(optical_depth.ravel()[ground] / dust_column[ground] - 1)
    assert np.percentile(apart, 95) < 0.04  # nodes two pixels apart across jets at the limb; one apart: 1e-6
    assert not optical_depth.ravel()[~ground].any()
    # pixels at the limb are averaged over both sides
    sky, kernel = (semantic == SKY).astype(np.uint8), np.ones((3, 3), np.uint8)
    inner = cv2.dilate(sky, kernel) == cv2.erode(sky, kernel)
    error = np.abs(got - want)[inner] / np.maximum(want, 0.01 * np.percentile(want, 99))[inner]
    # the map of the shadow has steps of 5 m; nodes are 1.25° and 2 to 10 % of the distance from the centre apart
    assert np.percentile(error, 50) < 3e-4
    assert np.percentile(error, 95) < 0.01
    assert np.percentile(error, 99) < 0.03


# --- ground -------------------------------------------------------------------------------------------------


def normals_of(up: np.ndarray, sunward: np.ndarray, tilt_deg: float, turn_deg: float) -> np.ndarray:
    """Return the normal at a tilt from the vertical, and at an azimuth from the Sun's."""
    tilt, turn = np.radians([tilt_deg, turn_deg])
    level = np.cos(turn) * sunward + np.sin(turn) * np.cross(up, sunward)
    return np.asarray(np.cos(tilt) * up + np.sin(tilt) * level)


@pytest.mark.parametrize("zenith_deg", [0.0, 30.0, 80.0, 95.0, 130.0, 170.0])
def test_light_of_the_sky_is_the_sum_over_20000_directions(zenith_deg: float) -> None:
    """From points of a sphere, through its shadow; facets of any tilt, in the sunlight and at night."""
    dust, shadow = coma(outflow(jets=())), sphere_shadow(1.06 * RADIUS_M)
    even = spiral(40_000)
    zenith, across = np.radians(zenith_deg), sun_axes(SUN)[0]
    up = np.cos(zenith) * SUN + np.sin(zenith) * across
    sunward = across if zenith_deg == 0 else (SUN - np.cos(zenith) * up) / np.sin(zenith)
    camera, rays = 1.0005 * RADIUS_M * up, even[even @ up > 0]
    endless = np.full(len(rays), np.inf)
    start = rays @ camera
    column = dust.column(start, np.sqrt(np.maximum(camera @ camera - start**2, 1.0)), endless)
    phase_deg = np.degrees(np.arccos(np.clip(-rays @ SUN, -1, 1)))
    light = dust.relative(camera, rays, endless, shadow)[0] * column * RADIUS_M
    light *= relative_phase("halley_marcus", np.minimum(phase_deg, 150))
    tilts = [(0, 0), (40, 0), (40, 90), (60, 180), (90, 60), (120, 120)]
    facets = np.array([normals_of(up, sunward, *tilt) for tilt in tilts])
    want = np.maximum(facets @ rays.T, 0) @ light * 4 * np.pi / len(even)
    got = irradiance_of_sky(
        "halley_marcus", 0.7, np.full(6, SUN @ up), facets @ up, np.cos(np.radians([t[1] for t in tilts]))
    )
    # 576 directions by Gauss and Legendre, and a point 0.5 m above the shadow's edge: 1.5 %, measured below 1.4 %
    np.testing.assert_allclose(got, want, rtol=0.015)


@pytest.mark.parametrize(
    ("radius_m", "afrho_m", "lost", "by_day", "by_night"),
    [(1700, 0.06, 8.5e-5, 1.6e-5, 9.4e-7), (1700, 4, 5.7e-3, 1e-3, 6.3e-5), (5500, 300, 0.13, 0.024, 1.5e-3)],
)
def test_the_light_of_the_ground_that_the_how_to_states(
    radius_m: float, afrho_m: float, lost: float, by_day: float, by_night: float
) -> None:
    """On level ground; for 67P less than half of the noise of an image."""
    cosine, level = np.cos(np.radians([30.0, 110.0])), np.ones(2)
    sky = irradiance_of_sky("halley_marcus", 0.7, cosine, level, level) * afrho_m / (8 * np.pi**2 * radius_m)
    depth = dust_towards_sun("halley_marcus", 0.7, cosine)[0] * afrho_m / (8 * np.pi * 0.04 * radius_m)
    got = [depth, sky[0] / cosine[0], sky[1]]
    np.testing.assert_allclose(got, (lost, by_day, by_night), rtol=0.05)  # two digits
    if radius_m == 1700:
        electrons, read_noise_e = 13_500 / 2, 13.0
        assert max(got) * electrons < 0.5 * np.hypot(read_noise_e, np.sqrt(electrons))


def test_a_lambert_surface_sends_even_light_to_all_sides() -> None:
    scene = config.parse_scene({"title": "t"}, source="t.toml")
    lambert = scene.body.photometry.at(np.array([500.0, 600.0]), np.array([0.1, 0.2]))
    factor = diffuse_reflectance(lambert)
    np.testing.assert_allclose(factor, np.array([[0.1], [0.2]]) / np.pi * np.ones(factor.shape), rtol=1e-9)


def test_dust_dims_and_lights_the_ground() -> None:
    """Of a sphere from 300 radii: sunlit ground fades by both optical depths, the night side shines a little."""
    far = pose((300e3, 0, 0), (np.cos(np.radians(60)), 0, np.sin(np.radians(60))))
    keys = {"afrho_cm": 15_000.0, "sunlit_fraction": 0.0, "reddening_per_100nm": 0.0}
    table = small_scene()
    without, only_haze, whole = (
        simulated({**table, **more}, far)[0].layers["radiance"][1].astype(np.float64)
        for more in ({}, {"coma": {**keys, "affects_ground": False}}, {"coma": keys})
    )
    sun_C = sun_seen_from(far)
    x, y = tangents()
    px, py = (300e3 * v / RADIUS_M for v in (x, y))
    ground = px**2 + py**2 < 0.8**2
    normal = np.stack([px, py, -np.sqrt(np.maximum(1 - px**2 - py**2, 0))], axis=-1)
    cosine = normal @ sun_C
    afrho_m = 150 * 1.5**-4.15
    k = afrho_m / (2 * np.pi * 0.16)
    # a line of a length without end from the ground at the zenith angle z sweeps z, and passes at R sin z
    zenith, emission = np.arccos(np.clip(cosine, -0.99, 0.999)), np.arccos(np.clip(-normal[..., 2], 0, 0.9999))
    depth = k / RADIUS_M * (zenith / np.sin(zenith) + emission / np.sin(emission))
    nodes = spectra.band_nodes_nm(400, 700, 3)
    sunlight = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.5)[1]
    sky = irradiance_of_sky("halley_marcus", 0.0, cosine[ground], np.ones(ground.sum()), np.ones(ground.sum()))
    reflectance = 0.06 / np.pi
    own = sunlight * reflectance * afrho_m / (8 * np.pi**2 * RADIUS_M) * sky
    want = without[ground] * np.exp(-depth[ground]) + only_haze[ground] - without[ground] + own
    day, night = cosine[ground] > 0.3, cosine[ground] < -0.3
    assert 0.02 < depth[ground][day].min() < 0.1
    # facets of the coarse sphere turn by some degrees; the light of the dust is 1 to 10 % of that of the ground
    np.testing.assert_allclose(whole[ground][day], want[day], rtol=2e-3)
    lit_by_dust = whole[ground][night] - only_haze[ground][night]
    np.testing.assert_allclose(lit_by_dust, own[night], rtol=0.15)
    assert (lit_by_dust > 0).all()
    sky_px = px**2 + py**2 > 1.2**2
    np.testing.assert_array_equal(whole[sky_px], only_haze[sky_px])


# --- scenes -------------------------------------------------------------------------------------------------


def pose(camera_T_m: Any, sun_T: Any, name: str = "far") -> dict[str, Any]:
    """Return a row of a table of poses at 1.5 au."""
    return row(name, camera_T_m, np.array(sun_T, float) / np.linalg.norm(sun_T), sun_distance_au=1.5)


@pytest.fixture(scope="module", autouse=True)
def few_facets() -> Iterator[None]:
    """The sphere of a scene has 20,000 facets: edges of 0.04 R put its limb within 0.01 px at 45 km."""
    with ellipsoids_of(5):
        yield


def small_scene(**coma_table: Any) -> dict[str, Any]:
    """A sphere of 1 km over coarse ground, with a coma if it has keys."""
    return {
        "title": "coma",
        "dataset": {"sites": 1, "shard_samples": 2, "layers": ["clean", "radiance", "semantic", "depth_m"]},
        "body": {
            "name": "sphere",
            "shape": "ellipsoid",
            "semi_axes_m": [RADIUS_M] * 3,
            "reflectance": 0.06,
            "density_kg_m3": 500.0,
        },
        "patch": {
            "facet_m": 60.0,
            "radius_m": 100.0,
            "max_triangles": 40_000,
            "relief": 0.0,
            "boulders": False,
            "craters_per_km2": 0.0,
        },
        "camera": {"width_px": 64, "height_px": 64, "fov_deg": 2.0},
        "render": {"bands": 3, "samples_per_pixel": 4},
        "faults": {},
        **({"coma": coma_table} if coma_table else {}),
    }


def tangents() -> np.ndarray:
    """Return x/z and y/z of the pixels of `small_scene`, float64[2, y, x]."""
    tangent = (np.arange(64) + 0.5 - 32) / 32 * np.tan(np.radians(1))
    return np.stack(np.meshgrid(tangent, tangent))


def sun_seen_from(flown: dict[str, Any]) -> np.ndarray:
    """Return the direction of the Sun in C of a row of poses."""
    seen = as_trajectory(columns_of([flown])).pose(0)
    return np.asarray(seen.T_from_C.T @ seen.sun_direction_T)


def simulated(table: dict[str, Any], *rows: dict[str, Any]) -> list[Any]:
    """Return the samples of a scene, one for each row of poses."""
    scene = config.parse_scene(table, source="t.toml")
    session = pipeline.Session(scene, poses=columns_of(rows))
    return [session.simulate(k) for k in range(len(rows))]


def test_the_radiance_of_an_even_coma_is_that_of_a_column_that_falls_as_one_over_b() -> None:
    """L = E Afρ Φ / (8 π b) from 300 radii away, at the phase angle where Φ has its minimum."""
    far = pose((300e3, 0, 0), (np.cos(np.radians(53)), 0, np.sin(np.radians(53))))
    keys = {"afrho_cm": 5000.0, "sunlit_fraction": 0.0, "reddening_per_100nm": 0.1, "distance_exponent": 3.0}
    keys |= {"affects_ground": False}
    without = simulated(small_scene(), far)[0].layers
    layers = simulated(small_scene(**keys), far)[0].layers
    added = layers["radiance"].astype(np.float64) - without["radiance"]
    np.testing.assert_array_equal(layers["semantic"], without["semantic"])
    np.testing.assert_array_equal(layers["depth_m"], without["depth_m"])
    x, y = tangents()
    angle = np.arctan(np.hypot(x, y))
    b_m = 300e3 * np.sin(angle)
    nodes = spectra.band_nodes_nm(400, 700, 3)
    bands = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.5) * (1 + 0.1 * (nodes - 550) / 100)
    want = bands[:, None, None] * 50 * 1.5**-3 * 0.3383 / (8 * np.pi * b_m)
    # on the side of the Sun no line meets the shadow; two pixels at the limb are averaged over both sides
    sun_C = sun_seen_from(far)
    sunward_m = 300e3 * (x * sun_C[0] + y * sun_C[1]) / np.hypot(*sun_C[:2])
    sky = (without["semantic"] == SKY) & (sunward_m > 1.4 * RADIUS_M)
    assert sky.sum() > 1200
    # the camera stands in the coma: it misses the angle/π of the line that lies behind it, 0.8 % in the corners
    assert np.abs(added[:, sky] / want[:, sky] - 1).max() < 0.01
    assert np.median(np.abs(added[:, sky] / want[:, sky] - 1)) < 0.005
    # with this part and the phase angle of each pixel, only interpolation and float32 are left. Near a body of few
    # pixels (12 here) the light is the mean over a pixel, 1 / (24 b²) above that in its middle: 6e-4 at 8 px
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(1 + x * x + y * y)[..., None]
    phase_deg = 180 - np.degrees(np.arccos(np.clip(rays @ sun_C, -1, 1)))
    exact = want * relative_phase("halley_marcus", phase_deg) / 0.3383
    np.testing.assert_allclose(added[:, sky], (exact * (1 - angle / np.pi))[:, sky], rtol=7e-4)
    # before the ground the line sweeps less: from the camera, at ψ from the centre, to where it meets the sphere
    ground = (without["semantic"] == BODY) & (b_m < 0.5 * RADIUS_M)
    part = (np.arcsin(np.clip(b_m / RADIUS_M, 0, 1)) - angle) / np.pi
    # the facets of the sphere lie up to 1 % of its radius below it
    np.testing.assert_allclose(added[:, ground], (exact * part)[:, ground], rtol=0.03)


@pytest.mark.parametrize(("distance_m", "most"), [(45e3, 0.05), (150e3, 0.05), (6e6, 0.02)])
def test_pixels_that_the_limb_crosses_have_the_light_of_both_sides(distance_m: float, most: float) -> None:
    """Against the mean of 64 pixels of a render eight times as fine, of a sphere 82, 24 and 0.6 pixels wide."""
    far = pose((distance_m, 0, 0), (np.cos(np.radians(53)), 0, np.sin(np.radians(53))))
    pixels = 96 if distance_m < 1e5 else 48

    def dust(finer: int, **keys: Any) -> np.ndarray:
        of = [small_scene(**more) for more in ({"afrho_cm": 5000.0, "affects_ground": False}, {})]
        for table in of:
            table["camera"] |= {
                "width_px": finer * pixels,
                "height_px": finer * pixels,
                "fov_deg": 2.0 * pixels / 64,
            }
            table["render"] = {"samples_per_pixel": 4, "bounces": 0}
        first, second = (simulated(table, far)[0].layers["radiance"][1].astype(np.float64) for table in of)
        return first - second

    got, fine = dust(1), dust(8)
    want = fine.reshape(pixels, 8, pixels, 8).mean(axis=(1, 3))
    # a fine pixel at the limb may count to the wrong side: half a fine pixel moves 6 % of a pixel by a factor of 2
    np.testing.assert_allclose(got, want, rtol=most)
    assert got.sum() == pytest.approx(want.sum(), rel=2e-3)


def test_jets_turn_with_the_body_and_stop_at_night() -> None:
    """A jet from the north pole, seen from the equator with the Sun over the pole, and below it."""
    jet = {"latitude_deg": 90.0, "longitude_deg": 0.0, "width_deg": 10.0, "strength": 1.0}
    keys = {"afrho_cm": 5000.0, "sunlit_fraction": 0.0, "jets": [jet]}
    rows = [pose((0, 120e3, 0), (0.0, 0, 1), "day"), pose((0, 120e3, 0), (0.0, 0, -1), "night")]
    day, night = (s.layers["radiance"][1] for s in simulated(small_scene(**keys), *rows))
    seen = as_trajectory(columns_of(rows[:1])).pose(0)
    north = seen.T_from_C.T @ np.array([0, 0, 1.0])
    focal = 32 / np.tan(np.radians(1))
    place = 32 + focal * (1600 * north)[:2] / 120e3
    opposite = 64 - place
    at, mirrored = ((int(p[1]), int(p[0])) for p in (place, opposite))
    assert day[at] > 5 * day[mirrored]
    # at night the jet is off, and its axis is that of the shadow: of a line across it, 2 atan(R/b) of π is dark
    b_m = np.hypot(at[1] + 0.5 - 32, at[0] + 0.5 - 32) / focal * 120e3
    assert night[at] / night[mirrored] == pytest.approx(1 - 2 * np.arctan(RADIUS_M / b_m) / np.pi, rel=0.04)
    # the axis is where the light is: the brightest pixel of a ring lies on it
    row, column = np.indices(day.shape) + 0.5
    radius = np.hypot(row - 32, column - 32)
    ring = np.abs(radius - np.hypot(*(place - 32))) < 1.5
    brightest = np.argmax(np.where(ring, day, 0))
    turn = np.arctan2(row.ravel()[brightest] - 32, column.ravel()[brightest] - 32)
    assert turn == pytest.approx(np.arctan2(place[1] - 32, place[0] - 32), abs=0.15)


def test_a_store_holds_the_coma_and_scenes_without_one_stay_as_they_are(tmp_path: Path) -> None:
    table = small_scene(afrho_cm=3000.0, random_jets=3, phase_function="marcus")
    table["dataset"] |= {"samples": 2}
    table["geometry"] = {"height_m": [4000.0, 5000.0], "min_lit_fraction": 0.0}
    scene = config.parse_scene(table, source="t.toml")
    session = pipeline.Session(scene)
    vbnfault.dataset.build_scene(scene, tmp_path / "s.zarr", source="t.toml", workers=1)
    with vbnfault.open_dataset(tmp_path / "s.zarr") as data:
        sample = session.simulate(1)
        for name in ("radiance", "clean"):
            np.testing.assert_array_equal(data[name][1].values, sample.layers[name])
    identity = scene_identity(session)
    assert identity["coma"]["random_jets"] == 3
    assert stored_scene({"scene": identity, "blocks": [2]}).coma == scene.coma
    without = scene.model_copy(update={"coma": None})
    assert "coma" not in scene_identity(pipeline.Session(without))
    other = pipeline.Session(without).simulate(1)
    assert (other.layers["radiance"] < sample.layers["radiance"]).all()  # dust before every pixel
    np.testing.assert_array_equal(other.layers["semantic"], sample.layers["semantic"])


def test_a_jet_follows_the_cosine_of_the_suns_zenith_angle_and_the_distance_its_power() -> None:
    vertices, faces = ellipsoid((RADIUS_M, RADIUS_M, RADIUS_M))
    body = Body(name="sphere", vertices_m=vertices, faces=faces)
    site = site_at(body, 0, (RADIUS_M, 0.0, 0.0))
    jets = [{"latitude_deg": 0.0, "longitude_deg": turn, "strength": 0.5} for turn in (0.0, 60.0, 200.0)]
    table = ComaTable.model_validate({"afrho_cm": 200.0, "jets": jets, "random_jets": 5, "reference_au": 2.0})
    sun_L = site.T_from_L.T @ np.array([1.0, 0, 0])
    dust, same, other = (make_coma(table, body, site, sun_L, 4.0, seed) for seed in (7, 7, 8))
    np.testing.assert_allclose(dust.outflow.strength[:2], [0.5, 0.25], rtol=1e-6)  # the third is at night
    np.testing.assert_allclose(site.T_from_L @ dust.outflow.axes[1], [0.5, 0.75**0.5, 0], atol=1e-9)
    assert dust.afrho_m == pytest.approx(2 * 2.0**-4.15)
    np.testing.assert_array_equal(same.outflow.axes, dust.outflow.axes)
    assert other.outflow.axes.shape != dust.outflow.axes.shape or not np.allclose(
        other.outflow.axes[2:], dust.outflow.axes[2:]
    )


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"afrho_cm": 0.0}, "coma.afrho_cm = 0.0: must be a number above 0 and at most 1e[+]07"),
        ({}, "coma.afrho_cm: is missing"),
        ({"afrho_cm": 1.0, "random_jet_width_deg": [9.0, 8.0]}, "coma.random_jet_width_deg = .*bounds reversed"),
        ({"afrho_cm": 1.0, "phase_function": "halley"}, "coma.phase_function = 'halley': must be .*halley_marcus"),
        (
            {"afrho_cm": 1.0, "phase_function": {"phase_deg": [0.0, 90.0], "value": [1.0, 2.0]}},
            "coma.phase_function.phase_deg = 0 to 90: must be from 0 to 180",
        ),
        (
            {"afrho_cm": 1.0, "phase_function": {"phase_deg": [0.0, 90.0, 180.0], "value": [1.0, 2.0]}},
            "coma.phase_function: phase_deg has 3 and value 2 values: must be as many",
        ),
        (
            {"afrho_cm": 1.0, "phase_function": {"phase_deg": [0.0, 90.0, 80.0, 180.0], "value": [1.0] * 4}},
            "coma.phase_function.phase_deg = .*: must increase",
        ),
        (
            {"afrho_cm": 1.0, "jets": [{"latitude_deg": 91.0, "longitude_deg": 0.0}]},
            r"coma.jets\[0\].latitude_deg = 91",
        ),
        ({"afrho_cm": 1.0, "jets": [{"latitude_deg": 9.0}]}, r"coma.jets\[0\].longitude_deg: is missing"),
        (
            {"afrho_cm": 1.0, "jets": [{"latitude_deg": 0.0, "longitude_deg": 0.0, "width_deg": 1.0}]},
            r"coma.jets\[0\].width_deg = 1.0: must be a number from 3 to 120",
        ),
    ],
)
def test_a_wrong_key_is_named_with_its_range(keys: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=f"^t.toml: {sentence}"):
        config.parse_scene({"title": "t", "coma": keys}, source="t.toml")


def test_a_body_that_holds_its_dust_has_no_coma() -> None:
    scene = config.parse_scene({"title": "t", "body": {"name": "Moon"}, "coma": {"afrho_cm": 1.0}}, source="t.toml")
    with pytest.raises(
        InputError, match=r"coma\.afrho_cm: Moon has an escape speed of 23\d\d m/s.*must be at most"
    ):
        _ = pipeline.Session(scene).body


def test_dust_that_is_not_thin_is_refused() -> None:
    """The optical depth Afρ / (8 p R) at the limb, also at the row of a table that is nearest to the Sun."""
    table = small_scene(afrho_cm=1e5, distance_exponent=2.0)  # 1 km over 8 · 0.04 · 1 km at 1 au
    sentence = r"coma\.afrho_cm = 100000: at 1 au .* optical depth of 3\.13 at the limb .* at most 3\.2e\+04$"
    scene = config.parse_scene({**table, "sun": {"distance_au": 1.0}}, source="t.toml")
    with pytest.raises(InputError, match=sentence):
        _ = pipeline.Session(scene).body
    scene = config.parse_scene({**table, "sun": {"distance_au": 2.0}}, source="t.toml")
    _ = pipeline.Session(scene).body
    rows = [pose((3e5, 0, 0), (1, 0, 0.5)), {**pose((3e5, 0, 0), (1, 0, 0.5), "near"), "sun_distance_au": 1.0}]
    with pytest.raises(InputError, match=sentence):
        _ = pipeline.Session(scene, poses=columns_of(rows)).body
