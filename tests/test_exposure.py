"""Exposure: the reference against a frame of one radiance, metering against its percentile and its limits."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import small_scene

from vbnfault.camera import Camera
from vbnfault.core import spectra
from vbnfault.core.quantities import BODY, SKY, Electrons, Radiance
from vbnfault.pipeline import exposure
from vbnfault.render.description import View
from vbnfault.scene import config
from vbnfault.scene.config import Scene
from vbnfault.world import cameras, ephemeris

SIZE = {"width_px": 32, "height_px": 32}


def parsed(**tables: Any) -> Scene:
    scene = small_scene(**{**tables, "camera": {**SIZE, **tables.get("camera", {})}})
    return config.parse_scene(scene, source="test")


def facet(scene: Scene) -> Radiance:
    """A frame full of Lambert's ground whose normal is 45 degrees from the Sun: L = rho E cos(45) / pi."""
    wavelength = ephemeris.wavelengths_nm(scene)
    sun = ephemeris.sunlight(scene, np.array([0.0, 0.0, -1.0])).irradiance_W_m2_nm
    table = scene.body.reflectance
    rho = spectra.reflectance(table if isinstance(table, str | float) else table.model_dump(), wavelength)
    light = (rho * sun * np.cos(np.radians(45)) / np.pi).astype(np.float32)
    return Radiance(array=np.tile(light[:, None, None], (1, 32, 32)), wavelength_nm=wavelength)


@pytest.mark.parametrize(("level", "slope_mag_deg"), [(0.3, 0.0), (0.6, 0.0), (0.6, 0.04)])
def test_the_reference_exposure_puts_a_facet_at_45_degrees_at_the_metering_level(
    level: float, slope_mag_deg: float
) -> None:
    scene = parsed(camera={"metering_level": level}, body={"photometry": {"phase_slope_mag_deg": slope_mag_deg}})
    camera = cameras.base_camera(scene)
    found = camera.expose(facet(scene), exposure.reference_exposure_s(scene, camera))
    # a facet that light meets and leaves at 45 degrees in planes at right angles has a phase of 60 degrees
    dimmed = 10 ** (-0.4 * slope_mag_deg * 60)
    # the four pixels about the axis: natural vignetting takes 1 - cos⁴ of half a pixel's diagonal, 2e-3
    brightness = (found.array / found.white_e).max(axis=-1)[15:17, 15:17]
    np.testing.assert_allclose(brightness * dimmed, level, rtol=3e-3)


def metered(scene: Scene, brightness: np.ndarray, semantic: np.ndarray) -> tuple[float, float]:
    """Return the metered exposure of a frame of given brightness after one second, and the reference."""
    camera: Camera = cameras.base_camera(scene)
    white = np.ones(4, dtype=np.float32)
    rate = Electrons(array=np.tile(brightness[..., None].astype(np.float32), (1, 1, 4)), white_e=white)
    truth: Any = SimpleNamespace(semantic=semantic)
    return exposure.metered_exposure_s(scene, camera, truth, rate), exposure.reference_exposure_s(scene, camera)


def test_metering_puts_the_percentile_of_the_lit_body_at_its_level_within_its_range() -> None:
    scene = parsed(camera={"metering_level": 0.5, "metering_percentile": 90.0})
    body = np.full((32, 32), BODY, dtype=np.uint8)
    body[:, 16:] = SKY
    _, reference = metered(scene, np.ones((32, 32)), body)
    facet_rate = 0.5 / reference  # what a facet of the reference gives in a second
    rng = np.random.default_rng(3)
    lit = facet_rate * rng.uniform(0.5, 2.0, (32, 32))
    lit[:, 16:] = 100 * facet_rate  # the sky is not metered
    lit[:16:2, :16] = 1e-3 * facet_rate  # and shadow neither
    measured = lit[::2, :16:2]
    want = 0.5 / np.percentile(measured[measured > 0.02 / reference].astype(np.float32), 90)
    assert metered(scene, lit, body)[0] == pytest.approx(want, rel=1e-5)
    # grazing light alone raises the exposure eightfold at most, glints lower it to a quarter at least
    for factor, limit in ((0.06, 8.0), (50.0, 0.25)):
        assert metered(scene, np.full((32, 32), factor * facet_rate), body)[0] == pytest.approx(limit * reference)


def test_ground_that_is_bright_at_zero_phase_is_metered_too() -> None:
    scene = parsed(camera={"metering_level": 0.5}, body={"photometry": {"phase_slope_mag_deg": 0.04}})
    body = np.full((32, 32), BODY, dtype=np.uint8)
    _, reference = metered(scene, np.ones((32, 32)), body)
    # a facet that faces Sun and camera has no loss by 60 degrees of phase, and a cosine of 1 instead of cos(45)
    brighter = 10 ** (0.4 * 0.04 * 60) * np.sqrt(2)
    for factor, want in ((8.0, 1 / 8), (brighter, 1 / brighter), (50.0, 1 / brighter)):
        lit = np.full((32, 32), factor * 0.5 / reference)
        assert metered(scene, lit, body)[0] == pytest.approx(want * reference, rel=1e-5)


def test_fewer_than_64_lit_pixels_are_not_metered() -> None:
    scene = parsed(camera={"metering_level": 0.5})
    body = np.full((32, 32), BODY, dtype=np.uint8)
    _, reference = metered(scene, np.ones((32, 32)), body)
    for count, want in ((63, reference), (64, 0.5 * reference)):
        lit = np.zeros((16, 16))
        lit.ravel()[:count] = 2 * 0.5 / reference  # twice the reference facet's
        assert metered(scene, np.kron(lit, np.ones((2, 2))), body)[0] == pytest.approx(want)


def test_the_exposure_stays_within_the_cameras_limits() -> None:
    scene = parsed()
    body = np.full((32, 32), BODY, dtype=np.uint8)
    _, reference = metered(scene, np.ones((32, 32)), body)
    for limits, want in (
        ({"exposure_max_s": reference / 3}, reference / 3),
        ({"exposure_min_s": 3 * reference, "exposure_max_s": 9 * reference}, 3 * reference),
    ):
        limited = scene.model_copy(update={"camera": scene.camera.model_copy(update=limits)})
        # black: the reference's exposure
        assert metered(limited, np.zeros((32, 32)), body)[0] == pytest.approx(want)


def test_electrons_of_a_second_are_the_rate() -> None:
    scene = parsed()
    camera = cameras.base_camera(scene)
    light = facet(scene)
    rate = camera.expose(light, 1.0)
    # by the lens's irradiance and the detector's exposure of a quarter of a second, apart from Camera.expose
    quarter = camera.detector.electrons_expected(camera.lens.image(light), 0.25)
    np.testing.assert_allclose(quarter.array, 0.25 * rate.array, rtol=1e-6)
    assert dataclasses.replace(camera, exposure_s=9.0).expose(light, 0.25).array.max() == quarter.array.max()


@pytest.mark.parametrize("detector", ["", "cmv4000"])
def test_a_view_without_ground_is_foreseen_at_the_references_exposure(detector: str) -> None:
    """The ground of a view whose frame is all sky has no pixels, which both detectors must accept."""
    scene = parsed(camera={"detector": detector} if detector else {})
    camera = cameras.base_camera(scene)
    sky = SimpleNamespace(semantic=np.full((32, 32), SKY, dtype=np.uint8))
    view = View(
        position_L_m=np.zeros(3),
        L_from_C=np.eye(3),
        intrinsics=np.array([40.0, 40.0, 16.0, 16.0]),
        width_px=32,
        height_px=32,
    )
    foreseen = exposure.foreseen_exposure_s(scene, camera, sky, view, facet(scene))
    assert foreseen == exposure.reference_exposure_s(scene, camera)


@pytest.mark.parametrize(("away_deg", "shorter"), [(0, True), (30, True), (42, True), (60, False), (180, False)])
def test_the_exposure_is_shorter_where_the_sun_is_near_the_frame(away_deg: float, shorter: bool) -> None:
    """A frame of 65° across has its corners at 42°; within 10° of them the Sun's veil limits the exposure."""
    scene = parsed(camera={"exposure_max_s": 2.0, "exposure_max_towards_sun_s": 0.01, "fov_deg": 65.0})
    focal_px = 16 / np.tan(np.radians(32.5))
    view = View(
        position_L_m=np.zeros(3),
        L_from_C=np.eye(3),
        intrinsics=np.array([focal_px, focal_px, 16.0, 16.0]),
        width_px=32,
        height_px=32,
    )
    angle = np.radians(away_deg)
    towards = SimpleNamespace(direction_L=np.array([np.sin(angle), 0.0, np.cos(angle)]))
    rendered: Any = SimpleNamespace(view=view, sun=towards)
    assert exposure.limited(scene, rendered).camera.exposure_max_s == (0.01 if shorter else 2.0)
    plain = parsed(camera={"exposure_max_s": 2.0})
    assert exposure.limited(plain, rendered) is plain
