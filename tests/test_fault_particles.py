"""Particles in view: laws of size, distance and number, light and motion against closed forms, and their masks."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import recorded_calls, small_scene, verified_store
from numpy.typing import NDArray
from scipy import stats
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.camera import Camera
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Electrons
from vbnfault.detector import MosaicDetector, ThreeColourDetector, load_sensor
from vbnfault.faults import FaultContext
from vbnfault.faults.particles import _Population, diffracted
from vbnfault.lens import RealLens, ThinLens, load_lens, scaled_to_field
from vbnfault.pipeline import Session
from vbnfault.scene import config
from vbnfault.store import open_dataset

F64 = NDArray[np.float64]

SIZE, FOCAL_MM, PITCH_UM = 128, 20.0, 40.0
FOCAL_PX = FOCAL_MM * 1e3 / PITCH_UM
NODES = spectra.band_nodes_nm(450.0, 650.0, 3)
SUN = spectra.solar_band_irradiance_W_m2_nm(NODES, 2.0)


def context(
    *, exposure_s: float = 0.1, f_number: float = 2.0, focus_m: float = np.inf, **more: Any
) -> FaultContext:
    """A camera of 14.5 degrees that looks away from the Sun, 2 au from it, up along its x axis."""
    camera = Camera(
        lens=ThinLens(focal_length_mm=FOCAL_MM, f_number=f_number, transmission=0.8, focus_distance_m=focus_m),
        detector=ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=PITCH_UM),
        exposure_s=exposure_s,
    )
    about = {
        "sun_direction_C": np.array([0.6, 0.0, -0.8]),
        "sun_irradiance_W_m2_nm": SUN,
        "wavelength_nm": NODES,
        "sun_visible_fraction": 1.0,
        "up_C": np.array([1.0, 0.0, 0.0]),
    }
    return FaultContext(camera=camera, **about | more)


@cache
def behind_surfaces(name: str = "nikkor_28_f2p8") -> Camera:
    lens = scaled_to_field(load_lens(name), 60.0, SIZE * PITCH_UM * 1e-3)
    real = RealLens(prescription=lens, width_px=SIZE, height_px=SIZE, pixel_pitch_um=PITCH_UM)
    detector = ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=PITCH_UM)
    return Camera(lens=real, detector=detector, exposure_s=0.1)


def dark(c: FaultContext) -> Electrons:
    white = c.camera.detector.white_e
    return Electrons(array=np.zeros((*c.shape, len(white)), np.float32), white_e=white)


def one_grain(
    c: FaultContext, *, slope: tuple[float, float] = (0.0, 0.0), depth_m: float = 20.0, **more: Any
) -> Any:
    """Parameters of one grain of 2 mm at rest, with its blur circle."""
    x, y = c.camera.projection.pixel_of(np.array([[*slope, 1.0]]))[0]
    blur = 2 * c.camera.lens.aperture_radius_m * abs(1 / depth_m - 1 / c.camera.lens.focus_distance_m)
    grain = {
        "x_px": x,
        "y_px": y,
        "dx_px": 0.0,
        "dy_px": 0.0,
        "blur_px": blur * c.camera.focal_length_px,
        "radius_mm": 2.0,
        "distance_m": depth_m * np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2),
        "depth_m": depth_m,
        "slope_x": slope[0],
        "slope_y": slope[1],
        "irradiance_W_m2": 1e-6,
    } | more
    scalars = {"density_per_m3": 1.0, "reddening_per_100nm": 0.0, "mask_level_dn": 1.0, "count": 1}
    return scalars | {name: [float(value)] for name, value in grain.items()}


def all_seen(**keys: Any) -> tuple[Any, FaultContext]:
    """A fault whose grains are all bright enough, at rest, in a camera of a tiny pupil, and its context."""
    table = {"radius_mm": [0.1, 10.0], "farthest_m": 30.0, "phase_slope_mag_deg": 0.0, "most_grains": 20_000}
    still = {"speed_m_s": 0.0, "camera_speed_m_s": 0.0, "least_noise": 0.01}
    return make("particles", **table | still | keys), context(exposure_s=100.0)


# --- laws ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [2.0, 3.7])
def test_sizes_and_distances_follow_their_laws(exponent: float) -> None:
    fault, c = all_seen(size_exponent=exponent, density_per_m3=15.0)
    grains = fault.draw(c, rng(3))
    assert 5000 < grains["count"] < 20_000
    radius, depth = np.array(grains["radius_mm"]), np.array(grains["depth_m"])
    p = exponent - 1
    found = stats.kstest(radius, lambda a: (0.1**-p - a**-p) / (0.1**-p - 10.0**-p))
    assert found.pvalue > 1e-3
    # the pupil of 10 mm and the grains make the volume wider by 1 to 3 % of the frame of half a metre at 2 m
    assert stats.kstest(depth, lambda z: (z**3 - 2.0**3) / (30.0**3 - 2.0**3)).pvalue > 1e-3
    for name in ("x_px", "y_px"):
        assert stats.kstest(np.array(grains[name]), stats.uniform(0, SIZE).cdf).pvalue > 1e-3
    assert stats.spearmanr(radius, depth).pvalue > 1e-3


def test_number_of_grains_is_density_times_volume() -> None:
    fault, c = all_seen(density_per_m3=1.0)
    volume = (SIZE / FOCAL_PX) ** 2 * (30.0**3 - 2.0**3) / 3
    counts = np.array([fault.draw(c, rng(seed))["count"] for seed in range(40)])
    # five standard errors of the mean; figures that lap over the frame's edges add 0.5 %
    assert counts.mean() == pytest.approx(1.005 * volume, abs=5 * np.sqrt(volume / 40))
    # Poisson: variance over mean is 1 within five of its standard errors √(2/39)
    assert counts.var(ddof=1) / counts.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / 39))


def test_the_faintest_and_the_rarest() -> None:
    """What is bright enough is never lost to the volume that is searched; at least one grain shows."""
    c = context()
    few = make("particles", density_per_m3=1e-9)
    assert [few.draw(c, rng(seed))["count"] for seed in range(5)] == [1] * 5
    fault = make("particles", density_per_m3=0.002, least_noise=2.0)
    bright = fault.draw(c, rng(1))
    fainter = replace(fault, least_noise=0.5).draw(c, rng(1))
    assert 0 < bright["count"] < fainter["count"]
    most = replace(fault, most_grains=5).draw(c, rng(1))
    at = [bright["x_px"].index(x) for x in most["x_px"]]
    population = _Population(fault, c, density=0.002, camera_velocity=np.zeros(3), up=np.array([1.0, 0, 0]))
    names = population._candidates(1, rng())._fields
    grains = type(population._candidates(1, rng()))(*(np.array(bright[name]) for name in names))
    levels = population._level_e(grains)
    assert levels.min() >= 2.0 * np.sqrt(13.0**2 + 15.0 * 0.1) * (1 - 1e-5)
    assert sorted(at) == sorted(np.argsort(-levels)[:5].tolist())
    # in the shadow of the body nothing shines
    assert fault.draw(replace(c, sun_visible_fraction=0.0), rng())["count"] == 0


def test_a_cloud_so_dense_that_every_grain_is_spread_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 1e6 pebbles and boulders per m³ some are shown, and at most twice the stated number is tried."""
    tried = recorded_calls(monkeypatch, _Population, "_candidates")
    dense = make("particles", density_per_m3=1e6, radius_mm=[1.0, 1000.0], most_grains=300)
    assert dense.draw(context(), rng(1))["count"] == 300
    assert sum(count for _, count, _ in tried) < 2.1 * 300_000


def test_speeds_and_directions() -> None:
    """Across the line of sight a grain of the radius a moves v √(1 mm / a) in a second: f v t / Z in the image."""
    still, c = all_seen(density_per_m3=5.0)
    fault = replace(still, speed_m_s=3.0, cone_deg=0.0, nearest_m=10.0)
    c = replace(c, camera=replace(c.camera, exposure_s=0.2))
    grains = {k: np.array(v) for k, v in fault.draw(c, rng(2)).items()}
    length = 3.0 * grains["radius_mm"] ** -0.5 * 0.2 / grains["depth_m"] * FOCAL_PX
    np.testing.assert_allclose(grains["dx_px"], length, rtol=2e-5)
    np.testing.assert_allclose(grains["dy_px"], 0, atol=1e-9)
    # towards the camera they leave the middle of the frame: s V / Z in the exposure
    towards = replace(c, up_C=np.array([0.0, 0.0, -1.0]))
    grains = {k: np.array(v) for k, v in fault.draw(towards, rng(2)).items()}
    moved = 3.0 * grains["radius_mm"] ** -0.5 * 0.2 / grains["depth_m"]
    np.testing.assert_allclose(grains["dx_px"], (grains["x_px"] - SIZE / 2) * moved, rtol=1e-4, atol=1e-4)
    # in a cone around the axis cosines are even; a camera at rest sees all along this line of sight
    wide = replace(fault, cone_deg=60.0, speed_exponent=0.0, nearest_m=25.0, density_per_m3=10.0)
    grains = {k: np.array(v) for k, v in wide.draw(towards, rng(2)).items()}
    across = np.hypot(grains["dx_px"], grains["dy_px"]) * grains["depth_m"] / FOCAL_PX / (3.0 * 0.2)
    middle = (
        np.hypot(grains["slope_x"], grains["slope_y"]) < 0.02
    )  # the motion along the axis shifts by 2 % at most
    sine = across[middle]
    assert middle.sum() > 50
    assert (
        stats.kstest(sine, lambda s: (1 - np.sqrt(1 - np.clip(s, 0, np.sin(np.pi / 3)) ** 2)) / 0.5).pvalue > 1e-3
    )
    # a camera that moves by V sees grains at rest move by (s V_z - V_xy) t / Z
    moving = still.draw(c, rng(4))
    assert np.abs(moving["dx_px"]).max() < 1e-6
    moving = {
        k: np.array(v) for k, v in replace(still, camera_speed_m_s=2.0, nearest_m=10.0).draw(c, rng(4)).items()
    }
    columns = np.zeros((2, moving["count"], 3))
    columns[0, :, 0] = columns[1, :, 1] = -1
    columns[..., 2] = moving["slope_x"], moving["slope_y"]
    shift = np.stack([moving["dx_px"], moving["dy_px"]]) * moving["depth_m"] / FOCAL_PX / 0.2
    velocity, *_ = np.linalg.lstsq(columns.reshape(-1, 3), shift.ravel())
    assert np.linalg.norm(velocity) == pytest.approx(2.0, rel=1e-4)


# --- light -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.1, -0.05)])
def test_light_of_a_grain(slope: tuple[float, float]) -> None:
    """E T A_pupil cos θ, over the cos⁴ that vignetting has still to take from the image of a thin lens."""
    c = context()
    params = one_grain(c, slope=slope)
    electrons = make("particles").on_light(dark(c), params, c).array.sum(axis=(0, 1), dtype=np.float64)
    cosine = 1 / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    pupil_m2 = np.pi * (FOCAL_MM * 1e-3 / 4) ** 2
    weights = c.camera.detector.electron_rate_weights(NODES) / (PITCH_UM * 1e-6) ** 2  # per W/nm
    width = np.array([50.0, 100.0, 50.0])
    spectrum = SUN / (SUN @ width) * 1e-6
    expected = weights @ (spectrum * 0.8) * pupil_m2 * cosine * 0.1 / cosine**4
    np.testing.assert_allclose(electrons, expected, rtol=1e-5)


def test_irradiance_at_the_camera() -> None:
    fault, c = all_seen(albedo=0.06, phase_slope_mag_deg=0.047, reddening_per_100nm=0.0, density_per_m3=1.0)
    grains = {k: np.array(v) for k, v in fault.draw(c, rng(1)).items()}
    total = SUN @ np.array([50.0, 100.0, 50.0])
    view = np.stack([grains["slope_x"], grains["slope_y"], np.ones(grains["count"])])
    view /= np.linalg.norm(view, axis=0)
    phase = np.degrees(np.arccos(-np.array([0.6, 0.0, -0.8]) @ view))
    # at these angles diffraction adds at most 5e-4 of it
    light = 0.06 * 10 ** (-0.4 * 0.047 * phase) + diffracted(grains["radius_mm"], phase)
    expected = total * light * (grains["radius_mm"] * 1e-3 / grains["distance_m"]) ** 2
    np.testing.assert_allclose(grains["irradiance_W_m2"], expected, rtol=1e-4)
    assert 29 < phase.min() < phase.max() < 45


@pytest.mark.parametrize("size", [60.0, 200.0, 600.0])
def test_small_grains_diffract_light_as_mie_says(size: float) -> None:
    """Of dark grains of x = 2π a / λ, whose light is diffraction plus Fresnel's reflection by their surface."""
    import miepython

    index, angle_deg = 1.6 - 0.3j, np.array([10.0, 20, 30, 45, 60, 80])
    mu, cos_i = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg) / 2)
    total = np.zeros(len(mu))
    for x in size * np.linspace(0.8, 1.2, 41):  # so that rings average out
        s1, s2 = miepython.S1_S2(index, x, mu, norm="wiscombe")
        total += (np.abs(s1) ** 2 + np.abs(s2) ** 2) / 2 / x**2 / 41
    inner = np.sqrt(1 - (1 - cos_i**2) / index**2)
    across = np.abs((cos_i - index * inner) / (cos_i + index * inner)) ** 2
    along = np.abs((inner - index * cos_i) / (inner + index * cos_i)) ** 2
    radius_mm = size * 550e-6 / (2 * np.pi)
    got = diffracted(np.full(len(mu), radius_mm), 180 - angle_deg)
    # both kinds of light interfere where they are alike, by up to 15 %
    np.testing.assert_allclose(got + (across + along) / 8, total, rtol=0.16)
    if size == 60:
        assert (got[:2] > 0.5 * total[:2]).all()


def test_backlit_grains_are_all_searched() -> None:
    """At the largest depth that is searched, no grain in the frame is bright enough, whatever its phase angle."""
    sun = np.array([0.35, 0.1, 0.93]) / np.linalg.norm([0.35, 0.1, 0.93])
    c = context(sun_direction_C=sun)
    fault = make("particles", density_per_m3=1.0, radius_mm=[0.02, 5.0])
    shown = fault.draw(c, rng(1))
    without = make("particles", density_per_m3=1.0, radius_mm=[0.02, 5.0], diffraction=False).draw(c, rng(1))
    assert shown["count"] > 2 * without["count"]
    population = _Population(fault, c, density=0.002, camera_velocity=np.zeros(3), up=np.array([1.0, 0, 0]))
    edge = np.linspace(-SIZE / 2, SIZE / 2, 33) / FOCAL_PX
    slopes = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    phase = np.degrees(np.arccos(np.clip(-rays @ sun, -1, 1)))
    assert phase.max() > 160
    for radius in (0.021, 0.1, 0.7, 4.0):
        _, high = population._limits_m(np.array([radius]))
        light = 0.09 * 10 ** (-0.4 * 0.047 * phase) + diffracted(np.full(len(phase), radius), phase)
        irradiance = population.flux_W_m2 * light * (radius * 1e-3 / high) ** 2 * rays[:, 2] ** 2
        pupil_m2 = np.pi * (FOCAL_MM * 1e-3 / 4) ** 2
        electrons = irradiance * pupil_m2 / (PITCH_UM * 1e-6) ** 2 / rays[:, 2] ** 3 * population.electrons
        assert electrons.max() <= population.least_e * 1.001 or high == 10_000.0


@pytest.mark.parametrize("focus_m", [np.inf, 40.0, 5.0])
def test_a_near_grain_is_a_disc_of_the_pupil(focus_m: float) -> None:
    """The blur circle is D f |1/d - 1/g|; of a still grain it is even."""
    c = context(f_number=0.2, focus_m=focus_m)
    fault = make("particles", nearest_m=1.0, farthest_m=6.0, density_per_m3=50.0, phase_slope_mag_deg=0.0)
    grains = {k: np.array(v) for k, v in fault.draw(c, rng(1)).items()}
    expected = FOCAL_MM * 1e-3 / 0.2 * np.abs(1 / grains["depth_m"] - 1 / focus_m) * FOCAL_PX
    np.testing.assert_allclose(grains["blur_px"], expected, rtol=1e-3, atol=1e-4)
    params = one_grain(c, depth_m=2.0)
    image = fault.on_light(dark(c), params, c).array[..., 1]
    y, x = np.indices(image.shape) + 0.5
    radius = np.hypot(params["blur_px"][0] / 2, 2e-3 / 2.0 * FOCAL_PX)
    assert radius > 5
    inside = np.hypot(x - SIZE / 2, y - SIZE / 2) < radius - 1
    # the pixels at the rim, 2 / R of all light, are averaged over few points
    np.testing.assert_allclose(image[inside], image.sum() / (np.pi * radius**2), rtol=0.03)


def test_a_lens_with_surfaces_spreads_and_vignettes_the_light() -> None:
    camera = behind_surfaces()
    c = replace(context(), camera=camera)
    fault = make("particles")
    for slope in ((0.05, 0.0), (0.3, 0.25)):
        params = one_grain(c, slope=slope, depth_m=1000.0)
        light = fault.on_light(dark(c), params, c).array
        angle = np.hypot(*slope)
        pupil_m2 = float(camera.lens.pupil_area_mm2([angle])[0]) * 1e-6
        weights = camera.electron_rate_weights(NODES) / (PITCH_UM * 1e-6) ** 2
        spectrum = SUN / (SUN @ np.array([50.0, 100.0, 50.0])) * 1e-6
        expected = weights @ spectrum * pupil_m2 / np.sqrt(1 + angle**2) * 0.1
        # the borders of the point spread that are cut off are given back to its middle
        np.testing.assert_allclose(light.sum(axis=(0, 1), dtype=np.float64), expected, rtol=1e-4)
        y, x = np.unravel_index(light[..., 1].argmax(), light.shape[:2])
        assert abs(x + 0.5 - params["x_px"][0]) <= 1.5
        assert abs(y + 0.5 - params["y_px"][0]) <= 1.5
    drawn = fault.draw(c, rng(1))
    assert drawn["count"] > 0
    assert fault.on_light(flat_electrons(c), drawn, c).array.min() >= 0


def test_a_grain_hides_what_is_behind_it_and_the_ground_hides_a_grain() -> None:
    c = context(f_number=0.5)
    fault = make("particles")
    params = one_grain(c, depth_m=4.0, radius_mm=30.0, irradiance_W_m2=0.0, blur_px=4.0)
    light = flat_electrons(c)
    left = fault.on_light(light, params, c).array / light.array
    # a dark ball of 30 mm at 4 m covers π (0.03 / 4 · f)² pixels
    assert (1 - left[..., 0]).sum() == pytest.approx(np.pi * (0.03 / 4 * FOCAL_PX) ** 2, rel=1e-3)
    assert left[SIZE // 2, SIZE // 2, 0] == pytest.approx(1 - 3.75**2 / (3.75**2 + 2**2), abs=0.05)
    mask = fault.footprint(params, c)
    assert mask is not None
    assert mask.sum() == pytest.approx(np.pi * (3.75**2 + 2**2), rel=0.3)
    ground = np.full(c.shape, 3.0, np.float32)
    near = replace(c, depth_m=ground)
    assert np.array_equal(fault.on_light(light, params, near).array, light.array)
    ground[:, SIZE // 2 :] = 5.0
    half = fault.on_light(light, params, replace(c, depth_m=ground)).array / light.array
    assert (1 - half[..., 0]).sum() == pytest.approx(0.5 * np.pi * (0.03 / 4 * FOCAL_PX) ** 2, rel=0.1)
    drawn = fault.draw(replace(c, depth_m=np.full(c.shape, 50.0, np.float32)), rng(1))
    assert drawn["count"] > 0
    assert max(drawn["depth_m"]) < 50.0


def test_tracks_in_a_navigation_camera() -> None:
    """Published loss of dust, sizes and albedo give some tens of tracks at perihelion, hardly one at 3.6 au."""
    detector = MosaicDetector(
        sensor=load_sensor("rosetta_navcam"), seed=3, width_px=1024, height_px=1024, direction="up"
    )
    lens = ThinLens(focal_length_mm=152.5, f_number=5.1, transmission=0.0083)
    camera = Camera(lens=lens, detector=detector, architecture="frame_transfer_ccd", exposure_s=0.43)
    nodes = spectra.band_nodes_nm(400.0, 1000.0, 8)
    noise_e = detector.read_noise_e_rms
    tracks = []
    for distance_au, per_m3 in ((1.25, 0.014), (3.6, 6e-4)):
        sunlight = spectra.solar_band_irradiance_W_m2_nm(nodes, distance_au)
        c = context(wavelength_nm=nodes, sun_irradiance_W_m2_nm=sunlight, sun_direction_C=np.array([0, -1, 0.0]))
        c = replace(c, camera=camera)
        # the number whose mean signal over their figures reaches five times the noise
        fault = make("particles", density_per_m3=per_m3, least_noise=5.0)
        tracks.append(np.mean([fault.draw(c, rng(seed))["count"] for seed in range(4)]))
    assert noise_e == 2.2
    assert 10 < tracks[0] < 100
    assert tracks[1] < 6


def test_masks_sit_on_the_grains() -> None:
    c = context(exposure_s=0.05)
    fault = make("particles", density_per_m3=1.0, mask_level_dn=2.0)
    params = json.loads(json.dumps(fault.draw(c, rng(6))))
    light = dark(c)
    added = fault.on_light(light, params, c).array
    mask = fault.footprint(params, c)
    assert mask is not None
    assert np.array_equal(mask, (added >= np.float32(2 / 255) * light.white_e).any(axis=2))
    assert 20 < mask.sum() < 0.2 * mask.size
    # every masked pixel lies on a streak: within its blur and a pixel of the line
    y, x = np.argwhere(mask).T + 0.5
    px, py, dx, dy, blur = (np.array(params[k]) for k in ("x_px", "y_px", "dx_px", "dy_px", "blur_px"))
    along = np.clip(((x[:, None] - px) * dx + (y[:, None] - py) * dy) / np.maximum(dx**2 + dy**2, 1e-12), -0.5, 0.5)
    far = np.hypot(x[:, None] - px - along * dx, y[:, None] - py - along * dy)
    radius = np.hypot(blur / 2, np.array(params["radius_mm"]) * 1e-3 / np.array(params["depth_m"]) * FOCAL_PX)
    assert (far < np.maximum(radius, 0.3) + 0.8).any(axis=1).all()
    again = fault.on_light(light, params, replace(c)).array
    assert again.tobytes() == added.tobytes()


def test_a_users_own_image_needs_no_sun() -> None:
    c = make_context(64, exposure_s=0.05)
    fault = make("particles", density_per_m3=20.0)
    params = fault.draw(c, rng(1))
    assert params["count"] > 0
    assert fault.on_light(dark(c), params, c).array.max() > 0
    debris = make("particles", model="debris")
    assert debris.draw(c, rng(1))["count"] > 0
    assert max(debris.draw(c, rng(1))["depth_m"]) <= 40.0


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"nearest_m": 50.0, "farthest_m": 50.0}, r"nearest_m = 50: must be below farthest_m = 50"),
        ({"model": "debris", "nearest_m": 60.0}, r"nearest_m = 60: must be below farthest_m = 40"),
        ({"radius_mm": [5, 1]}, r"radius_mm = \[5, 1\]"),
        ({"cone_deg": 190}, r"cone_deg = 190: must be .*180"),
        ({"density": 3}, r"density: unknown key \(did you mean density_per_m3\?\)"),
        ({"model": "grains"}, r"model = 'grains': must be one of coma_grains, debris"),
    ],
)
def test_bad_input_is_one_sentence(table: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=rf"^test.toml: faults\.particles.*{message}") as caught:
        make("particles", **table)
    assert "\n" not in str(caught.value)


# --- in a dataset ----------------------------------------------------------------------------------------------


def test_through_the_store_and_back(tmp_path: Any) -> None:
    """The stored mask is the effect, and the stored parameters draw the stored grains again."""
    scene = small_scene(
        dataset={"samples": 4, "sites": 1, "layers": ["clean", "without_particles", "mask_effect"]},
        plan={"faulty_fraction": 1.0, "classes_per_sample": [1, 1]},
    )
    scene["faults"] = {"particles": {"model": "debris", "density_per_m3": 3.0, "phase_slope_mag_deg": 0.0}}
    parsed = config.parse_scene(scene, source="test")
    out = tmp_path / "store.zarr"
    store = verified_store(parsed, out)
    session = Session(parsed)
    data = open_dataset(out)
    assert data["injected"].sel(fault="particles").values.any()
    for index in np.flatnonzero(data["injected"].sel(fault="particles").values):
        sample = store.read_sample(int(index))
        params = json.loads(sample.scalars["parameters"])["particles"]
        assert params.pop("model") == "debris"
        frame = session.frame(int(index))
        assert frame.drawn["particles"] == params
        assert np.isfinite(frame.context.depth_m).any()
        assert np.linalg.norm(frame.context.up_C) == pytest.approx(1)
        changed = (sample.layers["image"] != sample.layers["without_particles"]).any(axis=2)
        assert np.array_equal(sample.layers["mask"][0], sample.layers["mask_effect"][0])
        # noise rounds to another number in a few pixels that gain less than 1 DN
        assert (changed & sample.layers["mask"][0]).sum() > 0.5 * sample.layers["mask"][0].sum() > 0
        assert np.array_equal(sample.layers["without_particles"], sample.layers["clean"])
