"""Every packaged lens and detector takes pictures; noise hides converters' steps; NAVCAM is as published."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import needs_llvm, small_scene, verified_store

from vbnfault import pipeline
from vbnfault.core import spectra
from vbnfault.core.errors import VbnfaultError
from vbnfault.core.files import resources
from vbnfault.core.process import llvm
from vbnfault.core.quantities import Electrons, Irradiance
from vbnfault.core.spectra import Bands
from vbnfault.detector import MosaicDetector
from vbnfault.detector.mosaic import sample
from vbnfault.detector.readout import ReadoutNoise, analogue_dn, read_out
from vbnfault.detector.sensor import load_sensor
from vbnfault.lens import RealLens, ThinLens, load_lens, paraxial_properties, scaled_to_field
from vbnfault.lens.straylight.settings import SensorGrid, SunSource
from vbnfault.lens.straylight.total import SunInLens
from vbnfault.reflectance.contract import SingleTerm
from vbnfault.scene import config
from vbnfault.world import assemble, cameras, ephemeris

LENSES = sorted(resources.packaged("scenes/lenses"))
DETECTORS = sorted(resources.packaged("scenes/detectors"))


@pytest.mark.parametrize("name", sorted(resources.packaged("scenes")))
def test_the_sun_in_the_field_does_not_saturate_a_packaged_scene(name: str) -> None:
    """The veil of the largest fraction that a scene draws, at its longest exposure, by its closed form.

    The flux Φ = E☉ T π f² / (4 N²) gives v Φ / (π f²) in the middle of the frame; towards the corners it falls with
    cos⁴. At most 60 % of white, so that ground, ghosts and glare still show on top of it.
    """
    scene = config.load_scene(name)
    fault = pipeline.configure_faults(scene).get("straylight")
    if fault is None or "veil_fraction" not in fault.to_dict():
        assert fault is None or fault.model == "texture"  # no veil
        return
    camera, nodes = cameras.base_camera(scene), ephemeris.wavelengths_nm(scene)
    sun = ephemeris.sunlight(scene, np.array([0.0, 0.0, -1.0])).irradiance_W_m2_nm
    veil = max(fault.to_dict()["veil_fraction"]) * sun * camera.lens.transmittance(nodes)
    veil /= 4 * camera.lens.f_number**2
    on_sensor = Irradiance(array=veil.astype(np.float32)[:, None, None], wavelength_nm=nodes)
    longest_s = scene.camera.exposure_max_towards_sun_s or scene.camera.exposure_max_s
    electrons = camera.detector.electrons_expected(on_sensor, longest_s)
    assert (electrons.array / electrons.white_e).max() < 0.6


@pytest.mark.parametrize("number", range(max(len(LENSES), len(DETECTORS))))
def test_every_lens_and_detector_makes_a_store(number: int, tmp_path: Path) -> None:
    """A small store of every lens, with one detector after the other: built, verified, read back."""
    try:
        llvm.find()
    except VbnfaultError as error:
        pytest.skip(f"no usable LLVM: {error}")
    lens, detector = LENSES[number % len(LENSES)], DETECTORS[number % len(DETECTORS)]
    table = small_scene(
        dataset={"samples": 1, "seed": 3, "sites": 1, "shard_samples": 1, "layers": ["clean", "raw"]},
        camera={
            "width_px": 40,
            "height_px": 32,
            "lens": lens,
            "detector": detector,
            "fov_deg": 30.0,
            "f_number": 5.6,
        },
        plan={"faulty_fraction": 0.0},
        geometry={"height_m": [100.0, 200.0]},
    )
    table["faults"] = {"dust_on_optics": {"model": "defocused"}}
    made = verified_store(table, tmp_path / "store.zarr")
    assert made.attributes["optics"]["name"] == load_lens(lens).name
    assert made.attributes["optics"]["f_number"] == pytest.approx(5.6, rel=1e-4)
    assert made.attributes["detector"]["name"] == load_sensor(detector).name
    raw = made.read("raw")
    bias = load_sensor(detector).readout.bias_dn
    assert raw.shape == (1, 32, 40)
    # ground is in the picture, metered to three quarters of white
    assert raw.max() > 2 * bias + 100


# --- the converter's steps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DETECTORS)
def test_noise_hides_the_steps_of_the_converter(name: str) -> None:
    """The mean of many pixels follows levels between two codes."""
    sensor = load_sensor(name)
    spec = sensor.readout
    sigma = spec.noise_e_rms * spec.system_gain_dn_per_e
    # the offsets of pixels hide the steps as well: those of rosetta_navcam exceed its read noise
    offset, freedom = sensor.individual.dsnu_e * spec.system_gain_dn_per_e, sensor.individual.dsnu_freedom
    assert sigma >= 0.5 or (freedom == 3 and math.hypot(sigma, offset) >= 0.5)
    shape, rng = (256, 512), np.random.default_rng([7, 3])
    offsets_e = np.zeros(shape) if sigma >= 0.5 else sensor.individual.dsnu_e / 3**0.5 * rng.standard_t(3, shape)
    noise = ReadoutNoise.draw(shape, np.random.default_rng([7, 1]), np.random.default_rng([7, 2]))
    noise = ReadoutNoise(read=noise.read, row=np.zeros_like(noise.row))
    # before a rounding a Gaussian of σ steps leaves exp(-2 π² σ²) / π of a sine over the step in the mean
    # (Widrow & Kollár 2008, Quantization Noise, 4.3), 0.2 % of a step at σ = 0.5; Student's t of 3 degrees and
    # scale s multiplies that by its characteristic function at 2 π, (1 + 2 π s √3) exp(-2 π s √3), s √3 = its
    # deviation; and five standard errors of the mean, of both and of the rounding's own 1/12
    turn = 0.0 if sigma >= 0.5 else 2 * math.pi * offset
    chance = math.sqrt((sigma**2 + (turn > 0) * offset**2 + 1 / 12) / math.prod(shape))
    allowed = math.exp(-2 * math.pi**2 * sigma**2) / math.pi * (1 + turn) * math.exp(-turn) + 5 * chance
    for part in np.linspace(0, 1, 11):
        electrons = ((20 + part) / spec.system_gain_dn_per_e + offsets_e).astype(np.float32)
        level = analogue_dn(electrons, spec).mean(dtype=np.float64) + sigma * noise.read.mean(dtype=np.float64)
        assert read_out(electrons, spec, noise).mean(dtype=np.float64) == pytest.approx(level, abs=allowed)


@pytest.mark.parametrize("name", [n for n in DETECTORS if load_sensor(n).pattern.is_bayer])
@pytest.mark.parametrize("method", ["malvar", "menon"])
def test_nothing_is_darker_beside_a_saturated_strut_than_it_is_measured(name: str, method: str) -> None:
    """A strut of 3 px, ten times white, before ground at 40 % of white."""
    y, x = np.indices((48, 64))
    strut = (np.abs(x - 12) <= 1) | (np.abs(x - y - 16) <= 1) | (np.abs(y - 40) <= 1)
    sensor = load_sensor(name)
    light = np.where(strut, 10.0, 0.4).astype(np.float32)[..., None]
    pictures = {}
    for how in (method, "bilinear"):
        detector = MosaicDetector(sensor=replace(sensor, demosaic=how), seed=3, width_px=64, height_px=48)
        expected = Electrons(array=light * detector.white_e, white_e=detector.white_e)
        pictures[how] = detector.develop(expected, 1e-3, None).array[..., :3]
    # bilinear interpolation keeps what is measured, so its least value within one pixel is at most the least that
    # is measured there
    least = cv2.erode(pictures["bilinear"], np.ones((3, 3), np.uint8))
    saturated = detector.device.raw(sample(expected.array, sensor.pattern), 1e-3) >= detector.device.saturated_dn
    assert saturated[strut].all()
    assert saturated.mean() < 0.9  # a CCD without antiblooming fills the columns
    beside = detector.footprint(saturated) & ~saturated
    assert (pictures[method][beside] >= least[beside]).all()


# --- Rosetta's navigation camera ---------------------------------------------------------------------------------


def test_the_navigation_camera_is_the_published_one() -> None:
    """NSSDCA 2004-006A-17: 152.5 mm; 70 mm, f/2.2; behind the attenuator 30 mm, f/5.1, and 580 times less light."""
    scene = config.load_scene("navcam67p")
    camera = cameras.base_camera(scene)
    lens = camera.lens
    assert isinstance(lens, ThinLens)
    # the published figures have two to four digits
    assert lens.focal_length_mm == pytest.approx(152.5, abs=0.5)
    assert lens.focal_length_mm / lens.f_number == pytest.approx(30.0, rel=0.01)
    light, whole = (n_t[1] / n_t[0] ** 2 for n_t in ((lens.f_number, lens.transmission), (2.2, 0.9)))
    assert whole / light == pytest.approx(580, rel=0.01)
    assert (camera.width_px, camera.height_px, camera.detector.pixel_pitch_um) == (1024, 1024, 13.0)


def test_the_navigation_camera_sees_to_1000_nm() -> None:
    scene = config.load_scene("navcam67p")
    nodes = ephemeris.wavelengths_nm(scene)
    assert (nodes[0], nodes[-1]) == (400.0, 1000.0)
    detector = cameras.base_camera(scene).detector
    assert isinstance(detector, MosaicDetector)
    efficiency = detector.sensor.efficiency.at(np.array([400.0, 450.0, 650.0, 900.0, 1000.0]))[0]
    assert (efficiency > 0.03).all()
    assert efficiency[4] < 0.1 < efficiency[3] < 0.4 < efficiency[2] < 0.8
    # 67P's own light in all of it: sunlight at 1000 nm is 0.74 W/m²/nm at 1 au
    assert spectra.solar_irradiance_W_m2_nm(np.array([1000.0]))[0] == pytest.approx(0.74, rel=0.03)
    sun = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0)
    ground = assemble.ground_reflectance(scene)
    assert isinstance(ground, SingleTerm)  # whose spectrum is that of the geometric albedo, but for a factor
    albedo = np.asarray(ground.reflectance, dtype=np.float64)
    # Fornasier et al. 2015: 11 to 16 % per 100 nm in the visible; 0.0820 at 989 nm, 0.0677 at 649 nm, 5 % each
    near, red = (float(np.interp(nm, nodes, albedo)) for nm in (989.0, 649.0))
    assert near / red == pytest.approx(0.0820 / 0.0677, rel=0.1)
    slope = (np.interp(743.0, nodes, albedo) / np.interp(535.0, nodes, albedo) - 1) / 2.08
    assert 0.10 < slope < 0.17
    electrons = detector.electron_rate_weights(nodes)[0] * sun * albedo
    # an eye-like camera would lose that share
    assert 0.25 < electrons[nodes > 700].sum() / electrons.sum() < 0.55


# --- lenses as they stand in a camera: filter, cover glass, and the sensor as a mirror ----------------------------


WITH_PLATES = ("nikkor_28_f2p8", "nikkor_35_f2p8")
SENSOR_MM = 5.632  # 1024 pixels of 5.5 µm


@pytest.mark.parametrize("name", WITH_PLATES)
def test_plates_shift_the_focus_and_leave_the_lens(name: str) -> None:
    bare, lens = load_lens(name), load_lens(f"{name}_camera")
    count = len(bare.surfaces)
    plates = lens.surfaces[count:]
    assert lens.surfaces[: count - 1] == bare.surfaces[:-1]
    assert replace(lens.surfaces[count - 1], thickness_mm=0.0) == replace(bare.surfaces[-1], thickness_mm=0.0)
    assert [s.medium.nd > 1 for s in plates] == [True, False, True, False]
    figures, before = paraxial_properties(lens), paraxial_properties(bare)
    assert figures.efl_mm == pytest.approx(before.efl_mm, rel=1e-12)
    assert figures.f_number == pytest.approx(before.f_number, rel=1e-12)
    # t (n - 1) / n of every plate
    shift = sum(s.thickness_mm * (1 - 1 / s.medium.nd) for s in plates if s.medium.nd > 1)
    behind = sum(s.thickness_mm for s in lens.surfaces[count - 1 : -1]) + figures.bfd_mm
    assert behind == pytest.approx(before.bfd_mm + shift, rel=1e-12)
    # the file's last gap is where the sensor stands, to its three decimals
    assert plates[-1].thickness_mm == pytest.approx(figures.bfd_mm, abs=1e-3)
    assert lens.sensor_reflectance == 0.1
    assert all(s.coating for s in plates)
    # no plate clips the frame: what is left is the plates' own distortion
    seen = []
    for v in (bare, lens):
        real = RealLens(
            prescription=scaled_to_field(v, 65.0, SENSOR_MM), width_px=64, height_px=64, pixel_pitch_um=88.0
        )
        seen.append(real.relative_illumination(np.linspace(0.01, 0.85, 8)))
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.03)


@pytest.mark.parametrize("name", WITH_PLATES)
def test_the_sensor_raises_ghosts_near_the_axis(name: str) -> None:
    needs_llvm()
    lens = scaled_to_field(load_lens(f"{name}_camera"), 65.0, SENSOR_MM).coated("bbar")
    at = np.arange(32) + 0.5 - 16
    near = np.hypot(at, at[:, None]) < 4
    light = []
    for reflectance in (0.0, 0.05, 0.1):
        found = SunInLens(
            lens=replace(lens, sensor_reflectance=reflectance),
            bands=Bands.lines(450.0, 650.0),
            sensor=SensorGrid(shape=(32, 32), pitch_mm=SENSOR_MM / 32),
            sun=SunSource(angle_deg=3.0, radius_rad=4.65e-3),
        ).straylight()
        light.append(float(found.ghosts.planes[:, near].sum()))
    # of two reflections one is the sensor's: linear in its reflectance; brighter ghosts are drawn with more rays,
    # and a spot of half a pixel may move across the circle's edge (3 % met)
    assert light[2] - light[0] == pytest.approx(2 * (light[1] - light[0]), rel=0.06)
    assert light[2] > 5 * light[0]
