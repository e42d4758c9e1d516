"""The procedural Earth and its air: land and albedo, scattered light against closed forms and quadrature."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from poses_kit import columns_of, row

from vbnfault import dataset, render
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.pipeline import Session
from vbnfault.render import atmosphere, earth
from vbnfault.render.description import View
from vbnfault.render.runtime import dr, mi
from vbnfault.scene import config
from vbnfault.world import ephemeris

F64 = NDArray[np.float64]
RADIUS_M, SCALE_M = 6.371e6, 8430.0


def points(count: int) -> Any:
    """Return directions that cover the sphere evenly (Fibonacci's lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, k * np.pi * (3 - 5**0.5)
    r = np.sqrt(1 - z * z)
    return mi.Vector3f(*(mi.Float(c.astype(np.float32)) for c in (r * np.cos(turn), r * np.sin(turn), z)))


def colours(up: Any, footprint: Any) -> F64:
    """Return the albedo seen from above with the Sun overhead, [colour, point]."""
    return np.stack([np.array(c) for c in earth.seen_at(up, footprint, up, up)[0]])


def test_land_covers_29_percent_and_the_mean_albedo_is_the_neutral_one() -> None:
    """200,000 points: the lattice's error is far below the tolerances, those of the stated digits."""
    up, footprint = points(200_000), mi.Float(2e-4)
    land = np.array(earth.height_at(up, footprint)) > earth.SEA_LEVEL
    assert land.mean() == pytest.approx(0.29, abs=0.005)
    colour = colours(up, footprint)
    assert colour.mean() == pytest.approx(earth.MEAN_ALBEDO, rel=0.01)
    assert colour.min() > 0
    assert colour.max() < 1
    # white at the poles, blue between them, and green and brown land
    z = np.array(up.z)
    assert colour[:, np.abs(z) > 0.99].mean() > 0.5
    water = (colour[2] > 1.3 * colour[0]) & (colour.mean(axis=0) < 0.12)
    green = (colour[1] > 1.15 * colour[0]) & (colour[1] > 1.15 * colour[2])
    sand = (colour[0] > 1.25 * colour[2]) & (colour[0] > 0.2)
    assert water.mean() > 0.2
    assert green.mean() > 0.005
    assert sand.mean() > 0.02


@pytest.mark.parametrize("footprint_rad", [1e-3, 1e-2, 0.03, 0.1, 0.3])
def test_coarse_pixels_have_the_mean_albedo_of_fine_ones(footprint_rad: float) -> None:
    """From afar, fields without their fine parts once lost 14 to 41 % of the light from 0.03 rad on; now 6 %."""
    up = points(50_000)
    assert colours(up, mi.Float(footprint_rad)).mean() == pytest.approx(earth.MEAN_ALBEDO, rel=0.07)


def test_the_light_of_the_whole_earth_is_as_measured() -> None:
    """Robinson 2025, arXiv 2507.22258, 0.4 to 0.7 µm: geometric albedo 0.242, spherical albedo 0.294.

    From 10⁶ km at four sides at full phase, and at one at five phases, by Simpson's rule: A = 2 ∫ I/F sin α dα.
    Sides differ by 7 %, by their clouds: the mean of four has 4 %, and one 7 %, beside the 6 % of coarse pixels.
    """
    distance_m, size_px, half = 1e9, 32, np.arctan(1.15 * RADIUS_M / 1e9)
    sides = np.array([[1, 0, 0.1], [-1, 0.3, -0.1], [0.2, 1, 0.2], [-0.2, -1, 0.1], *[[1, 0, 0.1]] * 5])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    phases_deg = np.array([1, 1, 1, 1, 30, 60, 90, 120, 150])
    east = np.cross([0, 0, 1.0], sides)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    suns = np.cos(np.radians(phases_deg))[:, None] * sides + np.sin(np.radians(phases_deg))[:, None] * east
    poses = columns_of(
        [row(str(k), distance_m * sides[k], suns[k], sun_distance_au=1.0) for k in range(len(sides))]
    )
    keys = {"camera.width_px": size_px, "camera.height_px": size_px, "camera.fov_deg": float(np.degrees(2 * half))}
    keys |= {"render.samples_per_pixel": 4, "dataset.layers": ["clean", "radiance"]}
    scene = config.load_scene("earth_observation", keys)
    session = Session(scene, poses=poses)
    sun = spectra.solar_band_irradiance_W_m2_nm(ephemeris.wavelengths_nm(scene), 1.0)
    solid_angle = (2 * np.tan(half) / size_px) ** 2
    flux = np.array(
        [
            session.simulate(k).layers["radiance"].astype(float).sum() * np.pi * solid_angle / sun.sum()
            for k in range(9)
        ]
    )
    factor = flux / (np.pi * np.arcsin(RADIUS_M / distance_m) ** 2)
    assert factor[:4].mean() == pytest.approx(0.242, rel=0.10)
    weights = np.array([4, 2, 4, 2, 4]) * np.pi / 18
    assert 2 * (weights * factor[4:] * np.sin(np.radians(phases_deg[4:]))).sum() == pytest.approx(0.294, rel=0.13)


def test_coarse_pixels_show_the_mean_of_fine_ones() -> None:
    """A pixel of 0.02 rad against the mean of 400 fine points in it: noise finer than the pixel averages out.

    Thresholds make coasts and clouds sharper than their fields, so single pixels differ: they correlate by 0.87.
    The mean does not, within 10 %.
    """
    rng = np.random.default_rng(5)
    centre = rng.normal(size=(3, 300))
    centre /= np.linalg.norm(centre, axis=0)
    spread = centre[:, :, None] + rng.uniform(-0.01, 0.01, size=(3, 300, 400))
    spread /= np.linalg.norm(spread, axis=0)
    fine_up = mi.Vector3f(*(mi.Float(c.ravel().astype(np.float32)) for c in spread))
    fine = colours(fine_up, mi.Float(1e-4))[1].reshape(300, 400).mean(axis=1)
    coarse_up = mi.Vector3f(*(mi.Float(c.astype(np.float32)) for c in centre))
    coarse = colours(coarse_up, mi.Float(0.02))[1]
    assert np.corrcoef(fine, coarse)[0, 1] > 0.85
    assert coarse.mean() == pytest.approx(fine.mean(), rel=0.1)


def vectors(zenith_deg: Any, azimuth_deg: Any) -> Any:
    """Return unit vectors with z up."""
    zenith, azimuth = np.broadcast_arrays(np.radians(zenith_deg), np.radians(azimuth_deg))
    parts = (np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith))
    return mi.Vector3f(*(mi.Float(np.ascontiguousarray(c, dtype=np.float32).ravel()) for c in parts))


def test_glint_has_its_closed_form_and_keeps_the_energy() -> None:
    """Cox & Munk 1954: σ² = 0.003 + 0.00512 U. Facing the Sun, r = F / (4 π σ²) with F = ((n - 1) / (n + 1))²."""
    normal = (0.34 / 2.34) ** 2
    up = vectors(0.0, 0.0)
    assert abs(earth.SLOPE_VARIANCE - 0.03884) < 1e-9
    peak = earth.glint(up, up).numpy()[0]
    assert peak == pytest.approx(normal / (4 * np.pi * earth.SLOPE_VARIANCE), rel=1e-3)
    # a slope of tan β takes 2 β of the view: exp(-tan² β / σ²) / cos⁴ β / cos 2β, less what waves hide (below 1 %)
    beta = np.radians(8.0)
    moved = earth.glint(vectors(0.0, 0.0), vectors(16.0, 40.0)).numpy()[0]
    shape = np.exp(-(np.tan(beta) ** 2) / earth.SLOPE_VARIANCE) / np.cos(beta) ** 4 / np.cos(2 * beta)
    assert moved / peak == pytest.approx(shape, rel=0.01)
    # what leaves for all directions is Fresnel's reflectance averaged over the waves: 2.1 % above, more when low
    zenith, azimuth = np.meshgrid((np.arange(360) + 0.5) / 4, (np.arange(180) + 0.5) * 2, indexing="ij")
    weight = np.cos(np.radians(zenith)) * np.sin(np.radians(zenith)) * np.radians(0.25) * np.radians(2)
    sums = [
        float((earth.glint(vectors(sun, 0.0), vectors(zenith, azimuth)).numpy() * weight.ravel()).sum())
        / np.cos(np.radians(sun))
        for sun in (0.0, 40.0, 70.0)
    ]
    assert sums[0] == pytest.approx(normal, rel=0.02)
    assert normal < sums[1] < 0.03
    assert 0.08 < sums[2] < 0.14  # a flat sea: 0.132
    # reciprocal: r / cos i is the same with light and view exchanged
    a, b = vectors(30.0, 10.0), vectors(55.0, 170.0)
    there, back = earth.glint(a, b).numpy()[0] / a.z[0], earth.glint(b, a).numpy()[0] / b.z[0]
    assert there == pytest.approx(back, rel=1e-4)
    assert earth.glint(vectors(100.0, 0.0), up).numpy()[0] == 0
    # the whole path through the air: once its depth each way straight up, 40 times at the horizon (Rozenberg 1966)
    np.testing.assert_allclose(earth._air_mass(mi.Float([1.0, 0.5, 0.0])).numpy(), [1, 2, 40], rtol=1e-3)
    bands = np.array([450.0, 650.0])
    ground = render.EarthAlbedo(
        RADIUS_M,
        wavelength_nm=bands,
        reference_band=0,
        T_from_L=np.eye(3),
        site_T_m=np.zeros(3),
        air_depth=np.array([0.2, 0.05]),
    )
    terms = [t.numpy()[0] for t in ground._mirrored(mi.Float(0.5), up, up)]
    np.testing.assert_allclose(terms, 0.5 * peak * np.exp([-0.2, -0.05]), rtol=1e-4)


def test_a_camera_below_the_sun_sees_the_glint_of_the_sea() -> None:
    """A site in the open sea, the Sun and the camera above it: red light there against 35° off the mirror."""
    up = points(5000)
    land = [np.array(earth.height_at(up, mi.Float(1e-4))) > earth.SEA_LEVEL - 0.05]
    opacity = np.array(earth._clouds(up, mi.Float(0.03))[0])
    directions = np.stack([np.array(c) for c in up], axis=1)
    open_sea = (opacity == 0) & ~land[0] & (np.abs(directions[:, 2]) < 0.5)
    # the one whose surroundings within 5° are the freest
    free = [(opacity[directions @ d > 0.996].mean(), k) for k, d in enumerate(directions) if open_sea[k]]
    site = directions[min(free)[1]]
    poses = columns_of([row("a", 6.9e6 * site, site, sun_distance_au=1.0)])
    keys = {"camera.width_px": 33, "camera.height_px": 33, "camera.fov_deg": 70.0, "render.samples_per_pixel": 4}
    scene = config.load_scene("earth_observation", {**keys, "dataset.layers": ["clean", "radiance"]})
    red = Session(scene, poses=poses).simulate(0).layers["radiance"][-2]
    assert red[16, 16] > 2.5 * np.median(np.concatenate([red[0], red[-1], red[:, 0], red[:, -1]]))


def test_clouds_have_shadows_away_from_the_sun_and_hide_the_glint() -> None:
    up, footprint = points(20_000), mi.Float(1e-4)
    east = dr.normalize(mi.Vector3f(-up.y, up.x, 0))
    # the Sun 60° from the zenith: a layer at h is passed h tan 60° away
    sun = 0.5 * up + 0.75**0.5 * east
    shading = earth._shifted(up, sun, 0.001)
    np.testing.assert_allclose(np.array(dr.norm(shading - up)), 0.001 * 3**0.5, rtol=0.01)
    assert (np.array(dr.dot(shading - up, east)) > 0).all()
    lit, water = earth.seen_at(up, footprint, up, None)
    shaded, beam = earth.seen_at(up, footprint, up, shading)
    opacity, albedo = (np.array(x) for x in earth._clouds(shading, footprint))
    above = np.array(earth._clouds(up, footprint)[0])
    clear = above == 0
    assert clear.mean() > 0.2
    ratio = np.array(shaded.y)[clear] / np.array(lit.y)[clear]
    np.testing.assert_allclose(ratio, (1 - opacity * albedo)[clear], atol=1e-4)
    sea = clear & (np.array(water) > 0.99)
    np.testing.assert_allclose(np.array(beam)[sea], ((1 - opacity) * np.array(water))[sea], atol=1e-4)
    np.testing.assert_array_equal(np.array(shaded.y)[above == 1], np.array(lit.y)[above == 1])
    assert (np.array(water)[above == 1] == 0).all()


def test_chapmans_function_against_quadrature() -> None:
    """The asymptotic form is within 1 / x = 0.13 % or a few times that, also below the horizon."""
    x = RADIUS_M / SCALE_M
    for start in (x, x + 3):
        for zenith_deg in (0, 30, 60, 80, 85, 88, 90, 91, 92):
            cosine = np.cos(np.radians(zenith_deg))
            along = np.linspace(0, 500, 200_001)
            height = np.sqrt(start**2 + along**2 + 2 * start * along * cosine) - start
            exact = np.trapezoid(np.exp(-height), along)
            assert float(atmosphere.chapman(start, cosine, np)) == pytest.approx(exact, rel=0.005)


def air_light(
    L_from_C: F64, depth_m: Any, sun: F64, optical_depth: float, *, is_ground: Any, camera_m: float = 7e6
) -> tuple[F64, F64]:
    """Return what a row of pixels gets from a camera on the x axis above a sphere, and what it leaves."""
    depth = np.array([depth_m], dtype=np.float32)
    view = View(
        position_L_m=np.array([camera_m, 0.0, 0.0]),
        L_from_C=L_from_C,
        intrinsics=np.array([1e3, 1e3, 0.5, 0.5]),
        width_px=depth.shape[1],
        height_px=1,
    )
    air = render.Air(
        semi_axes_m=np.full(3, RADIUS_M),
        centre_L_m=np.zeros(3),
        T_from_L=np.eye(3),
        optical_depth=np.array([optical_depth]),
        scale_height_m=SCALE_M,
    )
    added, left = render.air_light(air, view, sun, depth, np.array([is_ground]))
    return added[0, 0], left[0, 0]


def light(towards: F64, sun: F64, optical_depth: float, camera_m: float = 7e6) -> tuple[float, float]:
    """Return what one line of sight gets, and what it leaves."""
    z = towards / np.linalg.norm(towards)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    along = -camera_m * z[0]
    miss2 = camera_m**2 - along**2
    hits = miss2 < RADIUS_M**2 and along > 0
    depth = along - np.sqrt(RADIUS_M**2 - miss2) if hits else np.inf
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    added, left = air_light(axes, [depth], sun, optical_depth, is_ground=[hits], camera_m=camera_m)
    return float(added[0]), float(left[0])


def test_thin_air_has_its_closed_forms_at_nadir_and_limb() -> None:
    """Nadir: P(180°) τ / 4π. Limb at the height h: β exp(-h/H) √(2π (R + h) H), to H / R = 0.1 % and float32."""
    depth = 1e-6
    added, left = light(np.array([-1.0, 0, 0]), np.array([1.0, 0, 0]), depth)
    assert added == pytest.approx(0.75 * 2 * depth / (4 * np.pi), rel=2e-3)
    assert left == pytest.approx(1, abs=1e-5)
    for height_m in (5e3, 20e3, 50e3):
        miss = RADIUS_M + height_m
        towards = np.array([-np.sqrt(1 - (miss / 7e6) ** 2), miss / 7e6, 0.0])
        added, _ = light(towards, np.array([0.0, 1.0, 0.0]), depth)  # the Sun above the middle of the line
        cosine = towards[1]
        column = depth / SCALE_M * np.exp(-height_m / SCALE_M) * np.sqrt(2 * np.pi * miss * SCALE_M)
        assert added == pytest.approx(0.75 * (1 + cosine**2) / (4 * np.pi) * column, rel=0.01)


def test_scattered_light_against_quadrature() -> None:
    """Brute force: 1500 steps on the line, each with 800 towards the Sun and the sphere's shadow; 1 %."""
    optical_depth = 0.2
    for tangent_m, sun_deg in ((-2e6, 20.0), (-3e5, 70.0), (8e3, 60.0), (15e3, 95.0), (10e3, 150.0)):
        miss = RADIUS_M + tangent_m
        towards = np.array([-np.sqrt(1 - (miss / 7e6) ** 2), miss / 7e6, 0.0])
        sun = np.array([np.cos(np.radians(sun_deg)), np.sin(np.radians(sun_deg)), 0.0])
        along = 7e6 * -towards[0]
        half = np.sqrt(max((RADIUS_M + 12 * SCALE_M) ** 2 - miss**2, 0))
        end = along - np.sqrt(RADIUS_M**2 - miss**2) if tangent_m < 0 else along + half
        edges = np.linspace(max(along - half, 0), end, 1501)
        s, step = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        point = np.array([7e6, 0, 0])[:, None] + towards[:, None] * s
        beta = optical_depth / SCALE_M * np.exp(-(np.linalg.norm(point, axis=0) - RADIUS_M) / SCALE_M)
        before = np.cumsum(beta * step) - 0.5 * beta * step
        t = 2.5e6 * np.linspace(0, 1, 801) ** 2
        path = np.linalg.norm(point[:, :, None] + sun[:, None, None] * t, axis=0)
        shadowed = (path < RADIUS_M - 1).any(axis=1)
        sunward = optical_depth / SCALE_M * np.trapezoid(np.exp(-(path - RADIUS_M) / SCALE_M), t, axis=1)
        total = float((beta * step * np.where(shadowed, 0, np.exp(-sunward - before))).sum())
        exact = 0.75 * (1 + (towards @ sun) ** 2) / (4 * np.pi) * total
        added, left = light(towards, sun, optical_depth)
        assert added == pytest.approx(exact, rel=0.01, abs=1e-7)
        if tangent_m < 0:
            assert left == pytest.approx(np.exp(-0.5 * (sunward[-1] + (beta * step).sum())), rel=0.02)


def test_the_optical_depth_of_air_follows_its_published_values() -> None:
    """Hansen & Travis 1974: 0.008569 λ⁻⁴ (1 + 0.0113 λ⁻² + 0.00013 λ⁻⁴), λ in µm; 0.0973 at 550 nm."""
    nm = np.array([400.0, 550.0, 700.0])
    um = nm / 1000
    published = 0.008569 / um**4 * (1 + 0.0113 / um**2 + 0.00013 / um**4)
    np.testing.assert_allclose(atmosphere.rayleigh_depth(nm, 0.0973), published, rtol=1e-3)


def test_ground_behind_the_body_counts_as_the_body() -> None:
    """A ray between two facets may see the far side of the body. Its line of sight still ends near the ground."""
    axes = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])
    depth_m = [7e6 - RADIUS_M, 7e6 + RADIUS_M]
    for near, far in air_light(axes, depth_m, np.array([1.0, 0, 0]), 0.1, is_ground=[True, True]):
        assert far == pytest.approx(near, rel=0.06)  # it ends 0.05 H below the sphere


def test_the_limb_of_the_scene_is_blue_and_thin_and_samples_repeat() -> None:
    small = {"camera.width_px": 48, "camera.height_px": 48, "render.samples_per_pixel": 1, "dataset.sites": 1}
    layers = {"dataset.layers": ["clean", "radiance", "semantic", "albedo"]}
    scene = config.load_scene("earth_observation", {**small, **layers})
    session = Session(scene)
    facing = int(np.flatnonzero(session.plan.stratum == 0)[0])
    one, other = session.simulate(facing), Session(scene).simulate(facing)
    for name in one.layers:
        np.testing.assert_array_equal(one.layers[name], other.layers[name])
    radiance, ground = one.layers["radiance"], one.layers["semantic"] == 1
    beside = cv2.dilate(ground.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # rays there may hit the ground
    glow = radiance[:, (one.layers["semantic"] == 0) & ~beside]
    air = glow[:, glow.sum(axis=0) > 0]
    assert air.shape[1] > 0
    assert air[1].sum() > 2 * air[-2].sum()  # blue before red
    albedo = one.layers["albedo"][one.layers["semantic"] == 1]
    assert ((albedo > 0) & (albedo < 1.1)).all()
    identity = dataset.scene_identity(session)
    assert identity["body"]["albedo_map"]["file"] == "earth"


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"atmosphere": {}}, r"body\.atmosphere: needs shape = 'ellipsoid' without relief_m"),
        (
            {"shape": "ellipsoid", "relief_m": 5.0, "atmosphere": {}},
            r"body\.atmosphere: needs shape = 'ellipsoid' ",
        ),
        (
            {"shape": "ellipsoid", "atmosphere": {"optical_depth": 3}},
            r"body\.atmosphere\.optical_depth = 3: must be a number above 0 and at most 1",
        ),
        (
            {"albedo_map": {"file": "earth", "neutral": 0.4}},
            r"body\.albedo_map\.file = 'earth': takes no left_long",
        ),
    ],
)
def test_wrong_keys_are_refused_in_a_sentence(table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=rf"test: {sentence}"):
        config.parse_scene({"title": "t", "body": table}, source="test")
