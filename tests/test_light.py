"""Rendered light against closed forms: phase curves, limb, penumbrae, light between surfaces, the plugin."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys

import numpy as np
import pytest
from test_reflectance import SETS, by_angles, directions
from test_render import NODES, UP, CountedScene, ball, join, plane, scene, sun, view

import vbnfault.render.bsdf  # noqa: F401 - registers Mitsuba's plug-ins
from vbnfault import render
from vbnfault.core import frames, spectra
from vbnfault.reflectance import DiscReflectance, radiance_factor, registry
from vbnfault.reflectance.disc import Lambert
from vbnfault.reflectance.hapke import COLUMNS, HAPKE_TABLES, hapke_at
from vbnfault.render.description import Sunlight
from vbnfault.render.runtime import dr, mi
from vbnfault.render.sampling import disc_sets


@pytest.mark.parametrize("phase_deg", [0.0, 0.09, 5.0, 30.0, 90.0, 130.0])
def test_phase_curve_of_a_hapke_sphere(phase_deg: float) -> None:
    """I/F of a rendered sphere over its disc against the integral of the independent evaluation, within 1 %."""
    band = 5
    set_649 = SETS["67P, 649 nm, disc-integrated"]
    ground = hapke_at(np.full(len(NODES), 649.0))
    towards_sun = frames.unit(np.array([np.sin(np.radians(phase_deg)), 0.0, -np.cos(np.radians(phase_deg))]))
    light = dataclasses.replace(sun(towards_sun), angular_radius_rad=1e-5)  # phase angles of one direction
    # so far that phase angles over the disc differ by 2e-4 rad: the opposition peak is 0.026 wide
    away, half = 5e5, 2.1e-4
    a_view = view(away * UP, -UP, width=256, fov_deg=float(np.degrees(2 * np.arctan(half))))
    image = render.radiance(ball(subdivisions=7), scene(a_view, light, ground)).array[band].astype(float)
    disc = image.sum() * (2 * half * away / 256) ** 2 / (np.pi * 100.0**2)
    got = disc * np.pi / light.irradiance_W_m2_nm[band]

    # luminance longitude and latitude: the lit and seen part of the sphere, Gauss-Legendre in both
    x, w = np.polynomial.legendre.leggauss(40)
    alpha = np.radians(phase_deg)
    longitude = (alpha - np.pi / 2) + (x + 1) / 2 * (np.pi - alpha)
    latitude = x * np.pi / 2
    lon, lat = (a.ravel() for a in np.meshgrid(longitude, latitude, indexing="ij"))
    weight = np.outer(w * (np.pi - alpha) / 2, w * np.pi / 2).ravel() * np.cos(lat)
    mu, mu0 = np.cos(lat) * np.cos(lon), np.cos(lat) * np.cos(lon - alpha)
    cos_psi = (np.cos(alpha) - mu * mu0) / np.maximum(np.sqrt((1 - mu**2) * (1 - mu0**2)), 1e-12)
    psi = np.arccos(np.clip(cos_psi, -1, 1)) if phase_deg else np.zeros_like(mu)
    r = [by_angles(np.arccos(a), np.arccos(b), c, set_649) for a, b, c in zip(mu0, mu, psi, strict=True)]
    expected = float(np.sum(np.array(r) * mu * weight)) / np.pi * np.pi
    assert got == pytest.approx(expected, rel=0.005)
    if phase_deg == 0:
        # Fornasier et al. 2015's fit; the integral itself gives 0.0678
        assert got == pytest.approx(0.068, rel=0.01)


def test_every_band_has_its_own_phase_function() -> None:
    light = sun(frames.direction_L(70, 35), 2.0)
    a_view = view(10 * UP, -UP, width=16, fov_deg=1.0)
    got = render.radiance(join(plane()), scene(a_view, light, hapke_at(NODES))).array.mean(axis=(1, 2))
    rows = np.column_stack([getattr(hapke_at(NODES), name) for name in COLUMNS])
    i = np.radians(55.0)
    expected = [by_angles(i, 1e-6, 0.0, tuple(row)) for row in rows] * light.irradiance_W_m2_nm
    # half a degree of field and a quarter of disc change cos i by 0.2 % at most, and cancel to first order
    np.testing.assert_allclose(got, expected, rtol=1e-3)


@pytest.mark.parametrize("name", ["67P, Hapke 2002", "bright, rough"])
def test_plugin(name: str) -> None:
    """The Mitsuba plugin: the same values; its samples integrate to the hemispherical albedo."""
    keys = ("w", "g", "B0", "h_s", "B_C0", "h_c", "roughness_deg", "K")
    plugin = mi.load_dict({"type": "hapke", **dict(zip(keys, SETS[name], strict=True))})
    angles = np.radians([[20, 50, 60], [50, 20, 60], [70, 70, 180], [5, 5, 0.05]])
    light, seen = directions(angles)
    si = dr.zeros(mi.SurfaceInteraction3f, len(angles))
    si.wi = mi.Vector3f(*(mi.Float(c.astype(np.float32)) for c in seen.T.copy()))
    wo = mi.Vector3f(*(mi.Float(c.astype(np.float32)) for c in light.T.copy()))
    context = mi.BSDFContext()
    got = plugin.eval(context, si, wo)[0].numpy()
    np.testing.assert_allclose(got, [by_angles(*a, SETS[name]) for a in angles], rtol=1e-4)

    count = 1 << 18
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(0, 0, 1)
    rng = np.random.default_rng(1)
    u = mi.Point2f(*(mi.Float(rng.random(count, dtype=np.float32)) for _ in range(2)))
    sample, weight = plugin.sample(context, si, 0.5, u)
    estimate = weight[0].numpy()
    mu, gauss = np.polynomial.legendre.leggauss(64)
    expected = sum(
        0.5 * c * 2 * np.pi * by_angles(np.arccos((m + 1) / 2), 1e-7, 0.0, SETS[name])
        for m, c in zip(mu, gauss, strict=True)
    )
    # r of light arriving from e, seen from the normal; four standard errors of the mean
    assert estimate.mean() == pytest.approx(expected, abs=4 * estimate.std() / np.sqrt(count))
    pdf = plugin.pdf(context, si, sample.wo).numpy()
    np.testing.assert_allclose(pdf, sample.pdf.numpy(), rtol=1e-6)


def test_plugin_by_wavelength() -> None:
    plugin = mi.load_dict({"type": "hapke", "parameters": "67p_fornasier2015"})
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    light, seen = directions(np.radians([[30.0, 40.0, 70.0]]))
    si.wi = mi.Vector3f(*(float(c) for c in seen[0]))
    si.wavelengths = type(si.wavelengths)(480.0, 592.0, 649.0, 1200.0)
    got = np.array(plugin.eval(mi.BSDFContext(), si, mi.Vector3f(*(float(c) for c in light[0])))).ravel()
    rows = {row[0]: row[1:] for row in HAPKE_TABLES["67p_fornasier2015"]}
    of = {nm: by_angles(*np.radians([30.0, 40.0, 70.0]), rows[nm]) for nm in (480.0, 535.0, 649.0, 989.0)}
    expected = [of[480.0], (of[535.0] + of[649.0]) / 2, of[649.0], of[989.0]]
    np.testing.assert_allclose(got, expected, rtol=1e-4)


def limb(distance_au: float = 1.0) -> Sunlight:
    return dataclasses.replace(sun(UP, distance_au), limb_darkening=spectra.limb_darkening(NODES))


def test_limb_profile_is_as_tabulated() -> None:
    light = limb()
    half = 1.1 * light.angular_radius_rad
    a_view = view(10 * UP, UP, width=256, fov_deg=float(np.degrees(2 * np.arctan(np.tan(half)))))
    image = render.radiance(join(plane()), scene(a_view, light, 0.06, spp=16)).array.astype(float)
    centre = (np.arange(256) + 0.5 - 128) / 128 * 1.1
    rho = np.hypot(*np.meshgrid(centre, centre))
    inside = rho < 0.98
    mu = np.sqrt(1 - rho[inside] ** 2)
    # Neckel & Labs 1994 at 541.76 nm, node by node through the interpolation; the table itself in test_spectra.py
    table = spectra.limb_darkening(NODES)
    for band in (0, 3, 7):
        expected = light.radiance_W_m2_sr_nm[band] * np.polynomial.polynomial.polyval(mu, table[band])
        # a pixel is 0.9 % of the radius: near the rim μ changes by 4 % within one, half-way cancelled
        np.testing.assert_allclose(image[band][inside], expected, rtol=0.02)
        np.testing.assert_allclose(image[band][rho < 0.8], expected[rho[inside] < 0.8], rtol=2e-3)
    # and the disc as a whole sends what it should: 1 % of its area is lost or won by the pixels on its rim
    pixel_sr = (2 * half / 256) ** 2
    np.testing.assert_allclose(image.sum(axis=(1, 2)) * pixel_sr, light.irradiance_W_m2_nm, rtol=0.005)


@pytest.mark.parametrize("darkened", [False, True])
@pytest.mark.parametrize("distance_au", [1.0, 2.0])
def test_penumbra_of_a_straight_edge(distance_au: float, *, darkened: bool) -> None:
    """Profile across the shadow of a half-plane: the chord integral of the disc, its width within 2 %."""
    light = limb(distance_au) if darkened else sun(UP, distance_au)
    radius = light.angular_radius_rad
    height, reach = 50.0, 500.0
    # a plate that covers y > 0 at 50 m, seen from beneath it
    z = -height
    corners = np.array([[-reach, 0, z], [reach, 0, z], [reach, reach, z], [-reach, reach, z]], np.float32)
    plate = corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    half = 1.5 * height * np.tan(radius)  # of the strip looked at
    a_view = view(20 * UP, -UP, width=128, fov_deg=float(np.degrees(2 * np.arctan(half / 20))))
    image = render.radiance(join(plane(), plate), scene(a_view, light, 0.06, spp=64)).array[4].astype(float)
    along = frames.L_from_C0(-UP)[1]  # y of L in camera axes: which way the profile runs
    profile = image.mean(axis=1 if abs(along[1]) > 0.5 else 0)
    y = (np.arange(128) + 0.5 - 64) / 64 * half * (along[1] if abs(along[1]) > 0.5 else along[0])
    got = profile / (0.06 / np.pi * light.irradiance_W_m2_nm[4])

    s = np.clip(-y / (height * np.tan(radius)), -1, 1)  # where the edge cuts the disc
    fine = np.linspace(-1, 1, 4001)
    if darkened:
        c = spectra.limb_darkening(NODES)[4]
        across = np.linspace(-1, 1, 801)
        mu2 = np.maximum(1 - fine[:, None] ** 2 - across[None] ** 2, 0)
        value = np.polynomial.polynomial.polyval(np.sqrt(mu2), c) * (mu2 > 0)
        chord = value.mean(axis=1)
    else:
        chord = np.sqrt(1 - fine**2)
    visible = np.cumsum(chord) / chord.sum()
    expected = np.interp(s, fine, visible)
    assert (
        np.abs(got - expected).max() < 0.03
    )  # 128 × 64 samples a row of 16 strata: 4 standard errors at half light

    def width(curve: np.ndarray) -> float:
        order = np.argsort(curve)
        lo, hi = np.interp([0.1, 0.9], curve[order], y[order])
        return abs(hi - lo)

    assert width(got) == pytest.approx(width(expected), rel=0.02)


def wall_and_floor(height_m: float = 10.0) -> tuple[render.TerrainMesh, Sunlight]:
    """A wall in the plane x = 0 facing +x, lit, on a floor that the Sun does not reach."""
    floor = plane(60.0)
    z, reach = -height_m, 60.0
    corners = np.array([[0, -reach, 0], [0, reach, 0], [0, reach, z], [0, -reach, z]], np.float32)
    wall = corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    # a hair below the horizon: no light on the floor, and what it hides of the wall lies 60 m · 1e-4 up
    light = dataclasses.replace(sun(np.array([1.0, 0.0, 1e-4])), angular_radius_rad=1e-5)
    return join(floor, wall), light


@pytest.mark.parametrize("bounces", [1, 2])
@pytest.mark.parametrize("dusty", [False, True])
def test_light_from_a_wall(bounces: int, *, dusty: bool) -> None:
    """Floor beside a sunlit wall: E = ρ E0 F with the form factor of an infinite strip; within 0.5 %."""
    surface, light = wall_and_floor()
    position = np.array([4.0, 0.0, -3.0])
    a_view = view(position, -UP, width=64, fov_deg=4.0)
    contrast = np.zeros(len(NODES)) if dusty else None
    image = render.radiance(
        surface, scene(a_view, light, 0.3, spp=256, bounces=bounces, dust_contrast=contrast)
    ).array.mean(axis=(1, 2))
    # strip of height h at distance d, ends 60 m away: F = (1 - d / √(d² + h²)) / 2, short by (h/60)²/4·… < 0.3 %
    d, h = 4.0, 10.0
    factor = _strip_factor(d, h, 60.0)
    once = 0.3 * light.irradiance_W_m2_nm * factor * 0.3 / np.pi
    if bounces == 1:
        np.testing.assert_allclose(image, once, rtol=0.005)
    else:  # a second reflection adds wall, floor, wall, floor: some per cent
        assert (image >= once * 0.995).all()
        assert (image < once * 1.1).all()


def _strip_factor(d: float, h: float, half_length: float) -> float:
    """Configuration factor of a floor element and a wall of height h and length 2 · half_length at distance d."""
    # (1/2π)[atan(b/d) - d/√(d²+h²) · atan(b/√(d²+h²))] twice, for the two halves (Howell, C-4)
    r = np.hypot(d, h)
    return float(2 / (2 * np.pi) * (np.arctan(half_length / d) - d / r * np.arctan(half_length / r)))


@pytest.mark.parametrize("bounces", [1, 2])
def test_light_between_surfaces_takes_few_rays(bounces: int) -> None:
    """For each pixel of half the resolution: one ray to it, and for each bounce one ray and one to the Sun."""
    surface, light = wall_and_floor()
    a_view = view(np.array([20.0, 0.0, -5.0]), np.array([-1.0, 0.0, 0.0]), width=61)
    a_scene = scene(a_view, light, 0.3, bounces=bounces)
    guide = render.truth(surface, a_scene.view, a_scene.sun)
    surface.scene = counted = CountedScene(surface.scene)
    image = render.indirect(surface, a_scene, guide)
    assert image.shape == (len(NODES), 61, 61)
    assert image.any()
    assert 0 < counted.rays <= 31 * 31 * (1 + 2 * bounces)


def test_dust_colours_its_ground() -> None:
    vertices, faces = plane()
    surface = render.TerrainMesh(vertices, faces, np.ones(2, bool), dust=np.ones(4, np.float32))
    a_view, light = view(10 * UP, -UP, width=16), sun(frames.direction_L(0, 50))
    contrast = np.linspace(0.1, 0.3, len(NODES))
    for ground in (Lambert().at(NODES, np.full(len(NODES), 0.06)), hapke_at(NODES)):
        bare, dusty = (
            render.radiance(surface, scene(a_view, light, ground, dust_contrast=c)).array.mean(axis=(1, 2))
            for c in (None, contrast)
        )
        np.testing.assert_allclose(dusty / bare, 1 + contrast, rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "more"),
    [(name, {}) for name in registry()]
    + [(name, {"phase_slope_mag_deg": 0.047}) for name, c in registry().items() if issubclass(c, DiscReflectance)],
)
def test_a_plane_has_the_radiance_of_its_model(name: str, more: dict[str, float]) -> None:
    """Every model, with dust and without, with bounces and without: radiance_factor · E / π at every pixel."""
    vertices, faces = plane()
    dust = np.full(4, 0.5, np.float32)
    surface = render.TerrainMesh(vertices, faces, np.ones(2, bool), dust=dust)
    a_view = view(np.array([0.0, 0.0, -10.0]), np.array([0.5, 0.2, 1.0]), width=8, fov_deg=2.0)
    light = dataclasses.replace(sun(frames.direction_L(40, 35)), angular_radius_rad=1e-5)
    ground = registry()[name](**more).at(NODES, np.full(len(NODES), 0.06))
    fx, fy, cx, cy = a_view.intrinsics
    x, y = np.meshgrid((np.arange(8) + 0.5 - cx) / fx, (np.arange(8) + 0.5 - cy) / fy)
    seen = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ a_view.L_from_C.T
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    # the surface's z axis is L's up
    turn = np.diag([1.0, -1.0, -1.0])
    factor = radiance_factor(ground, light.direction_L @ turn, -seen @ turn)
    bare = factor * (light.irradiance_W_m2_nm / np.pi)[:, None]
    for contrast, bounces in itertools.product((None, np.full(len(NODES), 0.16)), (0, 1, 2)):
        a_scene = scene(a_view, light, ground, spp=4, dust_contrast=contrast, bounces=bounces)
        got = render.radiance(surface, a_scene).array.reshape(len(NODES), -1)
        # a plane throws no light on itself. The mean of four strata lies within a quarter of a pixel, 0.06° each
        # way, of the centre, where the steepest of the models changes by 4.3 % a degree
        dusty = 1 if contrast is None else 1.08
        np.testing.assert_allclose(got, np.broadcast_to(bare * dusty, got.shape), rtol=5e-3)


# --- samples of the disc ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [4, 16, 256])
def test_samples_of_the_disc_lie_one_to_a_ring_and_a_sector(samples: int) -> None:
    points = disc_sets(samples, 3)
    radius2, turn = (points**2).sum(axis=2), np.arctan2(points[..., 1], points[..., 0]) % (2 * np.pi)
    for k, of in ((samples, radius2), (samples, turn / (2 * np.pi))):
        cells = np.sort(np.floor(of * k).astype(int), axis=1)
        assert (cells == np.arange(samples)).all()
    # a limb-darkened disc that is wholly seen: the same from every set, and from each half of a chessboard
    profile = np.polynomial.polynomial.polyval(np.sqrt(1 - radius2), spectra.limb_darkening(NODES)[0])
    assert profile.mean(axis=1).std() < 1e-12
    assert profile.mean() == pytest.approx(1, abs=0.05 / samples)
    side = round(samples**0.5)
    white = (np.arange(samples) % side + np.arange(samples) // side) % 2 == 0
    apart = profile[:, white].mean(axis=1) - profile[:, ~white].mean(axis=1)
    # the digits' parity cancels what is smooth in the ring's number; what is left comes from the outermost rings,
    # where the cosine goes as a root: samples^-3/2 of the profile's 0.7. By chance it would be 0.3 samples^-1/2
    assert np.abs(apart).max() < 0.8 * samples**-1.5


def test_limb_darkening_adds_no_noise() -> None:
    """A level plane under a limb-darkened Sun, 4 and 16 samples: alike in every pixel, and the halves too."""
    a_view = view(10 * UP, -UP, width=32, fov_deg=1.0)
    light = dataclasses.replace(limb(), direction_L=frames.direction_L(20, 60))
    for spp in (4, 16):
        signal = render.direct(join(plane()), scene(a_view, light, 0.06, spp=spp)).array.sum(axis=0)
        assert signal.std() / signal.mean() < 1e-3
        weights = np.ones(len(NODES))
        sampled = render.direct_by_sample(join(plane()), scene(a_view, light, 0.06, spp=spp), weights)
        expected = 0.06 / np.pi * light.irradiance_W_m2_nm.sum() * np.sin(np.radians(60))
        assert sampled.radiance.array.sum(axis=0).mean() == pytest.approx(expected, rel=1e-3)
        # Points of the Sun are drawn by the limb darkening of the signal, so single samples are alike, too. What is
        # left is the cosine of incidence across the disc, and the rounding of float16.
        single = sampled.samples.astype(float)
        apart = light.angular_radius_rad * np.tan(np.radians(30)) + 2.0**-11
        assert np.abs(single / single.mean() - 1).max() < 1.01 * apart
        assert np.abs(sampled.error).max() / signal.mean() < apart


def test_what_lies_between() -> None:
    ground = join(plane())
    above, below = np.array([[3.0, 0.0, -0.5], [0.0, 1.0, -1.9]]), np.array([[1.0, 1.0, 0.2]])
    origin = np.array([0.0, 0.0, -2.0])
    assert not render.is_between(ground, origin, above)
    assert render.is_between(ground, origin, np.concatenate([above, below]))


def test_the_plugin_is_registered_by_one_import() -> None:
    """A user's own Mitsuba scene needs `import vbnfault.render.bsdf` only, as the README says."""
    script = (
        "import vbnfault.render.bsdf; import mitsuba as mi; "
        "print(mi.load_dict({'type': 'hapke', 'parameters': '67p_fornasier2015'}))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout.startswith("Hapke["), done.stderr
