"""Coatings, filters and efficiencies count at every nanometre, whatever the number of bands of a render."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import tmm
from conftest import needs_llvm
from lens_kit import paraxial_ghosts, sunlit
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from test_faults_kit import make_context

from vbnfault.camera import Camera
from vbnfault.core import spectra
from vbnfault.core.quantities import Radiance
from vbnfault.core.spectra import Bands
from vbnfault.detector import ThreeColourDetector
from vbnfault.detector.efficiency import Curve, QuantumEfficiency
from vbnfault.faults import FaultContext, registry
from vbnfault.faults.straylight_lens import channel_bands
from vbnfault.lens import Prescription, load_lens, parse_lens, scaled_to_field
from vbnfault.lens.coating import Layer
from vbnfault.lens.imaging import RealLens
from vbnfault.lens.rays import path_of, trace
from vbnfault.lens.straylight.bundles import Rays, Tracer, name_of, routes
from vbnfault.lens.straylight.irradiance import FlareModel
from vbnfault.lens.straylight.scene import in_channels
from vbnfault.lens.straylight.settings import SensorGrid
from vbnfault.lens.straylight.total import anew

needs_llvm()

F64 = NDArray[np.float64]
NM = np.linspace(400.0, 700.0, 301)
SUN = spectra.solar_irradiance_W_m2_nm(NM)
SIZE = 48
# A mirror for green of quarter waves at 540 nm: reflects 94 % there, and a few per cent 80 nm away.
STACK = tuple(Layer(n=n, thickness_nm=540.0 / 4 / n) for n in (2.35, 1.46) * 5)


@dataclass(frozen=True, kw_only=True)
class Narrow(ThreeColourDetector):
    """A sensor with a narrow red filter, whose edges are steep, and a plain one; blue has a slope."""

    @property
    def efficiency(self) -> QuantumEfficiency:
        red = Curve(channel="R", wavelength_nm=(590.0, 591.0, 609.0, 610.0), value=(0.0, 0.4, 0.4, 0.0))
        green = Curve(channel="G", wavelength_nm=(400.0, 700.0), value=(0.5, 0.5))
        blue = Curve(channel="B", wavelength_nm=(400.0, 500.0), value=(0.6, 0.0))
        return QuantumEfficiency(curves=(red, green, blue))


def doublet() -> Prescription:
    """A crown and a flint in air, whose stop lies behind them."""
    rows: list[dict[str, Any]] = []
    for radius, thickness, index in ((30.0, 4.0, 1.52), (-25.0, 0.5, 1.0), (-24.0, 1.5, 1.62), (-90.0, 2.0, 1.0)):
        glass = {} if index == 1 else {"nd": index, "vd": 60.0 if index < 1.6 else 36.0}
        rows.append({"radius_mm": radius, "thickness_mm": thickness, "diameter_mm": 16.0} | glass)
    rows.append({"stop": True, "thickness_mm": 0.0, "diameter_mm": 9.0})
    return scaled_to_field(parse_lens({"name": "doublet", "surface": rows}, source="test"), 30.0, SIZE * 0.02)


def without_dispersion(lens: Prescription) -> Prescription:
    media = [replace(s.medium, formula="cauchy", coefficients=(s.medium.nd, 0.0)) for s in lens.surfaces]
    surfaces = tuple(replace(s, medium=medium) for s, medium in zip(lens.surfaces, media, strict=True))
    return replace(lens, surfaces=surfaces)


def with_films(lens: Prescription, films: tuple[Layer, ...]) -> Prescription:
    """The films on every surface between glass and air, the first next to the air."""
    index = lens.indices()
    surfaces = tuple(
        replace(s, coating=() if index[k] == index[k + 1] else films if index[k] == 1 else films[::-1])
        for k, s in enumerate(lens.surfaces)
    )
    return replace(lens, surfaces=surfaces)


def context(lens: Prescription, bands: int, detector: ThreeColourDetector) -> FaultContext:
    real = RealLens(prescription=lens, width_px=SIZE, height_px=SIZE, pixel_pitch_um=20.0)
    nodes = spectra.band_nodes_nm(400.0, 700.0, bands)
    camera = Camera(lens=real, detector=detector, exposure_s=1e-3)
    return sunlit(make_context(SIZE, sun_xy_px=(0.75 * SIZE, 0.4 * SIZE)), nodes, 1.0, camera=camera)


def pairs(lens: Prescription) -> list[tuple[int, ...]]:
    return [name_of(route) for route in routes(lens)]


def detector(kind: type[ThreeColourDetector] = Narrow) -> ThreeColourDetector:
    return kind(width_px=SIZE, height_px=SIZE, pixel_pitch_um=20.0)


@pytest.mark.parametrize(
    ("films", "model", "worn"), [("bbar", "traced", 0.4), ("stack", "traced", 0.0), ("stack", "paraxial", 0.0)]
)
def test_ghosts_of_every_channel_are_those_of_single_wavelengths(films: str, model: str, worn: float) -> None:
    """The flux of all ghosts in each channel is within 1 % of an integral over lines, for any number of bands.

    Bands as nodes were wrong by factors of 2 to 70 with two bands, and by a quarter to three quarters with eight.
    """
    lens = doublet().coated("bbar") if films == "bbar" else with_films(doublet(), STACK)
    fault = registry()["straylight"][model]()
    sums = []
    for bands in (2, 3, 16):
        where = replace(context(lens, bands, detector()), coating_loss=worn)
        source = fault.sun_in_lens(fault.draw_state(where, np.random.default_rng(0)), where)
        flux = source.of_ghosts.model.flux_mm2(*source.of_ghosts.sun, pairs(lens))
        sums.append(channel_bands(where)[1] * sum(flux.values()))
    sun = source.sun
    assert sun.angle_deg > 5
    sensor = SensorGrid(shape=(SIZE, SIZE), pitch_mm=0.02)
    some = np.arange(400.0, 701.0, 6.0)
    settings = source.settings.ghosts
    lines = []
    for nm in some:
        made = FlareModel(lens, Bands.lines(nm), sensor, sun_radius_rad=sun.radius_rad, settings=settings).worn(
            worn
        )
        lines.append(sum(made.flux_mm2(sun.angle_deg, sun.azimuth_deg, pairs(lens)).values())[0])
    expected = np.trapezoid(detector().electron_rates(NM) * SUN * CubicSpline(some, lines)(NM), NM, axis=1)
    for found in sums:
        np.testing.assert_allclose(found, expected, rtol=0.01)


def test_rays_near_total_reflection_cancel_in_the_spectrum() -> None:
    """A Biotar's ghosts of the Sun on the axis are within 1 % of single wavelengths.

    Rays near total reflection carry much of the light of its brightest ghost. A lattice that met them at some
    wavelengths only made blue 6 % too bright.
    """
    lens = scaled_to_field(load_lens("biotar_100_f1p4"), 65.0, SIZE * 0.02).coated("bbar")
    sensor = SensorGrid(shape=(SIZE, SIZE), pitch_mm=0.02)
    sensed = Bands.of(NM, ThreeColourDetector().electron_rates(NM) * SUN)
    some = np.arange(400.0, 701.0, 15.0)

    def flux(bands: Bands) -> F64:
        model = FlareModel(lens, bands, sensor, sun_radius_rad=0.005)
        return np.asarray(sum(model.flux_mm2(0, 0, pairs(lens), across=192).values()))

    lines = CubicSpline(some, [flux(Bands.lines(nm))[0] for nm in some])(NM)
    np.testing.assert_allclose(flux(sensed), sensed.weights @ lines, rtol=0.01)


@pytest.mark.parametrize("case", ["a line filter where the coating reflects nothing", "a glass that blocks red"])
def test_ghosts_beside_dark_wavelengths_stay(case: str) -> None:
    """They are within 2 % of single wavelengths: the light at the dark ones is no measure of that beside them."""
    lens = scaled_to_field(load_lens("tessar_50_f2p8"), 65.0, SIZE * 0.02).coated("bbar")
    if case.startswith("a line"):
        nm, low, high = np.linspace(450.0, 800.0, 351), 548.0, 552.0
    else:
        nm, low, high = np.linspace(400.0, 1000.0, 601), 570.0, 700.0
        first = replace(
            lens.surfaces[0], internal_transmittance_10mm=((400.0, 690.0, 700.0, 1000.0), (1, 0.9, 0, 0))
        )
        lens = replace(lens, surfaces=(first, *lens.surfaces[1:]))
    sensed = Bands.of(nm, ((nm >= low) & (nm <= high)).astype(float)[None])
    sensor = SensorGrid(shape=(SIZE, SIZE), pitch_mm=0.02)

    def total(bands: Bands) -> float:
        return float(FlareModel(lens, bands, sensor, sun_radius_rad=0.005).image(5.0).sum(axis=(1, 2))[0])

    some = np.arange(low, high + 1, 4.0 if high - low > 10 else 1.0)
    lines = CubicSpline(some, [total(Bands.lines(at)) for at in some])(nm)
    assert total(sensed) == pytest.approx(
        float(sensed.weights[0] @ np.where(sensed.weights[0] > 0, lines, 0)), rel=0.02
    )


@cache
def reflectance(n0: float, n1: float, nm: float, films: tuple[Layer, ...], angle_rad: float = 0.0) -> float:
    """Of the package tmm, the mean of both polarisations."""
    indices, thicknesses = [n0, *(f.n for f in films), n1], [np.inf, *(f.thickness_nm for f in films), np.inf]
    return float(np.mean([tmm.coh_tmm(p, indices, thicknesses, angle_rad, nm)["R"] for p in "sp"]))


def light(lens: Prescription, pair: tuple[int, int], nm: F64) -> F64:
    """What a ghost along the axis of the doublet has of its light, by the package tmm."""
    first, second = pair
    index, films = lens.indices(), [s.coating for s in lens.surfaces]
    r = np.array([[reflectance(index[k], index[k + 1], w, films[k]) for w in nm] for k in range(4)])
    passes = np.prod([(1 - r[k]) ** (3 if first < k < second else 1) for k in range(4)], axis=0)
    return np.asarray(r[first] * r[second] * passes)


# How far the spline between the wavelengths of the list lies from the light at every nanometre: 2.0e-3 for the
# mirror, whose fringes are the steepest, 2.4e-4, 4.7e-6 and 5.3e-7 for the others.
@pytest.mark.parametrize(("films", "apart"), [("stack", 2.1e-3), ("bbar", 2.6e-4), ("v", 6e-6), ("mgf2", 1e-6)])
def test_the_list_of_ghosts_has_the_means_of_both_coatings(films: str, apart: float) -> None:
    """Without dispersion a paraxial ghost has one geometry, and its light is that of the package tmm."""
    bare = without_dispersion(doublet())
    coated = with_films(bare, STACK) if films == "stack" else bare.coated(films)
    sun = Bands.sunlight(400.0, 700.0)
    nodes = sun.sampled_nm(coated.spectral_step_nm)
    listed = {
        nm: {g.pair: g.flux_fraction for g in paraxial_ghosts(lens, 4.0, bands=bands)}
        for nm, lens, bands in (
            (0.0, bare, Bands.lines(550.0)),
            (450.0, coated, Bands.lines(450.0)),
            (620.0, coated, Bands.lines(620.0)),
        )
    }
    ghosts = paraxial_ghosts(coated, 4.0, bands=sun)
    assert len(ghosts) == 6
    for ghost in ghosts:
        # all use the same rays, so their ratios are those of the coatings; sums in single precision
        area = listed[0.0][ghost.pair] / light(bare, ghost.pair, np.array([550.0]))[0]
        for nm in (450.0, 620.0):
            of_line = area * light(coated, ghost.pair, np.array([nm]))[0]
            assert listed[nm][ghost.pair] == pytest.approx(of_line, rel=1e-6)
        spline = CubicSpline(nodes, light(coated, ghost.pair, nodes))(NM)
        assert ghost.flux_fraction == pytest.approx(area * sun.weights[0] @ spline, rel=1e-6)
        mean = area * sun.weights[0] @ light(coated, ghost.pair, NM)
        assert ghost.flux_fraction == pytest.approx(mean, rel=apart)


def reflectance_between(n0: float, n1: float, nm: float, films: tuple[Layer, ...], angle_rad: float) -> float:
    """The line through the reflectances at the next of 256 even cosines of the angle in the thinner medium."""
    ratio = n0 / min(n0, n1)
    at = 255 * np.sqrt(1 - (ratio * np.sin(angle_rad)) ** 2)
    low, high = (
        reflectance(n0, n1, nm, films, float(np.arcsin(np.sqrt(1 - (k / 255) ** 2) / ratio)))
        for k in (np.floor(at), np.ceil(at))
    )
    return float(low + (high - low) * (at % 1))


# How far lines between 256 cosines lie from each coating's reflectances, over whole paths: 1.1e-5, 9.8e-4, 2.9e-4
@pytest.mark.parametrize(("films", "apart"), [("bare", 1.2e-5), ("stack", 1.1e-3), ("bbar", 3.2e-4)])
def test_rays_of_ghosts_have_the_light_of_tmm_at_their_own_angles(films: str, apart: float) -> None:
    """Every ray by itself, at its angles to the radii of the spheres that it meets in double precision."""
    lens = {"bare": doublet(), "stack": with_films(doublet(), STACK), "bbar": doublet().coated("bbar")}[films]
    nm, side = 480.0, 0.2 * lens.surfaces[0].semi_diameter_mm * np.array([-1.0, 0.0, 1.0])
    index, made = lens.indices(nm), Tracer(lens, np.array([nm]))
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    direction = np.array([[np.sin(np.radians(4.0)), 0.0, np.cos(np.radians(4.0))]])
    for number, route in enumerate(made.routes):
        box = np.array([[0.0, 0.0, side[-1], side[-1]]])
        bundle = Rays(route=np.array([number]), wavelength=np.array([0]), box_mm=box, direction=direction)
        spots = made.trace(bundle, 3)
        path, start = path_of(lens, route), np.column_stack([x, y, np.zeros(9)])
        rays = trace(lens, start, np.tile(direction, (9, 1)), path=path, wavelength_nm=nm)
        expected, onward, towards = np.ones((2, 9)), True, np.tile(direction, (9, 1))
        for step, (row, mirror) in enumerate(path):
            surface, at = lens.surfaces[row], rays.points_mm[step + 1]
            if not surface.stop:
                to_centre = at - [0, 0, lens.vertices_mm[row] + 1 / surface.curvature_per_mm]
                cosine = np.abs((towards * to_centre).sum(axis=1)) / np.linalg.norm(to_centre, axis=1)
                media, coating = (index[row], index[row + 1]), surface.coating
                if not onward:
                    media, coating = media[::-1], coating[::-1]
                for k, reflect in enumerate((reflectance_between, reflectance)):
                    r = np.array([reflect(*media, nm, coating, angle) for angle in np.arccos(cosine)])
                    expected[k] *= r if mirror else 1 - r
            onward ^= mirror
            towards = rays.points_mm[step + 2] - at
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        # products in single precision, and cosines: reflectances of films change 100 times faster with them
        rounding = 1e-6 if films == "bare" else 3e-5
        np.testing.assert_allclose(spots.fraction.numpy(), expected[0], rtol=rounding)
        np.testing.assert_allclose(spots.fraction.numpy(), expected[1], rtol=apart)


@pytest.mark.parametrize("bands", [2, 5, 32])
def test_the_image_of_grey_ground_has_the_transmission_that_each_channel_sees(bands: int) -> None:
    """∫ QE S T λ/hc dλ behind coatings that reflect one colour, and a filter of 20 nm, within 0.1 %."""
    lens = with_films(doublet(), STACK)
    camera = context(lens, bands, detector()).camera
    nodes = spectra.band_nodes_nm(400.0, 700.0, bands)
    grey = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0).astype(np.float32)
    light = camera.lens.on_axis(Radiance(array=grey[:, None, None], wavelength_nm=nodes))
    found = camera.detector.electrons_expected(light, 1.0).array[0, 0]
    plain = camera.lens.axial_solid_angle_sr(nodes) / spectra.band_means(camera.lens.transmittance(NM), nodes)
    sensed = camera.detector.electron_rates(NM) * SUN * camera.lens.transmittance(NM)
    # the focal length changes with wavelength by less than 2 %, linearly between the bands
    np.testing.assert_allclose(found, np.trapezoid(sensed, NM, axis=1) * plain.mean(), rtol=0.02)
    np.testing.assert_allclose(
        camera.electron_rate_weights(nodes) @ grey, np.trapezoid(sensed, NM, axis=1), rtol=1e-3
    )
    # the mean over the bands would be wrong by more than a tenth in the narrow channel
    assert (
        bands > 2
        or abs(
            camera.detector.electron_rate_weights(nodes)[0]
            @ (grey * spectra.band_means(camera.lens.transmittance(NM), nodes))
            / np.trapezoid(sensed, NM, axis=1)[0]
            - 1
        )
        > 0.1
    )


def test_all_straylight_of_the_sun_is_the_same_for_any_number_of_bands() -> None:
    """Ghosts, starburst, glare and veil, the fraction of the Sun and of the scene that is left."""
    fault = registry()["straylight"]["traced"]()
    made = []
    for bands in (2, 32):
        where = context(doublet().coated("v"), bands, detector(ThreeColourDetector))
        params = fault.draw_state(where, np.random.default_rng(0))
        made.append(fault.added_light(params, where, anew))
    few, many = made
    assert few is not None
    assert many is not None
    for name in ("added", "direct_left", "scene_lost"):
        np.testing.assert_allclose(getattr(few, name), getattr(many, name), rtol=1e-4)


def test_a_scene_of_linear_reflectance_has_exact_bands_in_every_channel() -> None:
    """The two bands of a channel hold ∫ rate S ρ f dλ for linear ρ and any filter f."""
    rates = detector().electron_rates(NM)
    for count in (2, 5, 16):
        nodes = spectra.band_nodes_nm(400.0, 700.0, count)
        bands, of_nodes, weights = in_channels(rates, nodes)
        reflectance = 0.04 + 1e-4 * (NM - 400)
        radiance = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0) * (0.04 + 1e-4 * (nodes - 400))
        for filtered in (np.ones(len(NM)), np.exp(-(((NM - 595) / 4) ** 2))):
            expected = np.trapezoid(rates * SUN * reflectance * filtered, NM, axis=1)
            np.testing.assert_allclose(
                weights @ (bands.mean(filtered) * (of_nodes @ radiance)), expected, rtol=1e-9
            )
