"""Defocused dust against the closed forms of discs, rays of the test's own, and the energy it scatters."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lens_kit import lens_area
from numpy.typing import NDArray
from scipy.special import j0, j1
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.camera import Camera
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.detector import ThreeColourDetector
from vbnfault.faults import FaultContext, dust_lens
from vbnfault.lens import RealLens, ThinLens, load_lens, paraxial_properties, scaled_to_field, stopped_down
from vbnfault.lens.beams import Footprint, beams, disc_overlap
from vbnfault.lens.image_frame import ImageFrame
from vbnfault.lens.rays import real_pupil_diameter_mm, trace

F64 = NDArray[np.float64]

# A window a distance before a stop and a single lens: in front of them, beams are round cylinders.
WINDOW_LENS = """
surface = [
  {{ radius_mm = inf, thickness_mm = {distance}, diameter_mm = 300.0 }},
  {{ stop = true, thickness_mm = 0.0, diameter_mm = {pupil} }},
  {{ radius_mm = 100.0, thickness_mm = 8.0, nd = 1.5, diameter_mm = 56.0 }},
  {{ radius_mm = -100.0, diameter_mm = 56.0 }},
]
"""
PITCH_UM = 40.0
FOCAL_MM = 20.0


def window_lens(tmp_path: Path, *, distance: float, pupil: float) -> str:
    """Path of the lens above, of which the distance and the pupil count once it is scaled to `FOCAL_MM`."""
    # the lensmaker's equation with thickness
    unscaled = 100.0 / (1 - (0.5 / 1.5) * 8.0 / 200.0) / FOCAL_MM
    path = tmp_path / "window.toml"
    path.write_text(WINDOW_LENS.format(distance=distance * unscaled, pupil=pupil * unscaled), encoding="utf-8")
    return str(path)


def thin_context(size: int = 200, *, f_number: float = 1.0, **more: Any) -> FaultContext:
    detector = ThreeColourDetector(width_px=size, height_px=size, pixel_pitch_um=PITCH_UM)
    lens = ThinLens(focal_length_mm=FOCAL_MM, f_number=f_number)
    return FaultContext(camera=Camera(lens=lens, detector=detector), **more)


@cache
def real_context(name: str, size: int = 256) -> FaultContext:
    detector = ThreeColourDetector(width_px=size, height_px=size, pixel_pitch_um=22.0)
    lens = scaled_to_field(load_lens(name), 65.0, size * detector.pixel_pitch_um * 1e-3)
    real = RealLens(prescription=lens, width_px=size, height_px=size, pixel_pitch_um=detector.pixel_pitch_um)
    return FaultContext(camera=Camera(lens=real, detector=detector))


def grains(
    lens: str,
    *places: tuple[float, float, float],
    surface: int = 0,
    on_window: bool = False,
    height_mm: float = 0.5,
    passes: float = 0.0,
) -> dict[str, Any]:
    """Parameters of grains at (x, y) in mm with diameters in mm."""
    return {
        "lens": lens,
        "surface": surface,
        "window_height_mm": height_mm,
        "on_window": [on_window] * len(places),
        "x_mm": [p[0] for p in places],
        "y_mm": [p[1] for p in places],
        "diameter_um": [1e3 * p[2] for p in places],
        "transmission": [passes] * len(places),
        "mask_loss": 0.01,
    }


def transmission(params: dict[str, Any], context: FaultContext) -> F64:
    fault = make("dust_on_optics", model="defocused")
    grey = flat_electrons(context)
    return np.asarray((fault.apply(grey, params, context).array / grey.array)[..., 1], dtype=np.float64)


def test_overlap_of_discs() -> None:
    d = np.linspace(0.0, 3.0, 301)
    for a, b in ((1.0, 1.0), (1.3, 0.4), (0.2, 2.0)):
        expected = lens_area(np.maximum(d, 1e-9), a, b)
        # where the discs all but touch, both lose digits in the arccosines: √ε
        np.testing.assert_allclose(disc_overlap(d, a, b), expected, atol=2e-7)


# --- shadows -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance", "pupil", "grain"), [(20.0, 4.0, 1.5), (12.0, 2.0, 3.0)])
def test_shadow_is_the_overlap_of_beam_and_grain(
    tmp_path: Path, distance: float, pupil: float, grain: float
) -> None:
    context, size = thin_context(256), 256
    path = window_lens(tmp_path, distance=distance, pupil=pupil)
    x, y = 0.3, -0.2
    found = transmission(grains(path, (x, y, grain), passes=0.25), context)
    # a point at the slope t is seen through the beam about -z t: light that goes to the right comes from the left
    slope = (np.arange(size) + 0.5 - size / 2) * PITCH_UM * 1e-3 / FOCAL_MM
    away = np.hypot(-distance * slope[None, :] - x, -distance * slope[:, None] - y)
    share = lens_area(away, pupil / 2, grain / 2) / (np.pi * pupil**2 / 4)
    # between the places where a shadow is told it is linear: `_ERROR` of the light; the polygon's and tables' 1e-3
    # of what is lost
    np.testing.assert_allclose(found, 1 - 0.75 * share, atol=1.5e-3 * share.max() + dust_lens._ERROR)
    # hence f (D + d)/z wide, with a plateau f |D - d|/z wide, min(1, d/D)² deep
    column = found[:, int(size / 2 - x / distance * FOCAL_MM * 1e3 / PITCH_UM)]
    per_px = PITCH_UM * 1e-3 * distance / FOCAL_MM
    depth = 0.75 * min(grain / pupil, 1) ** 2
    assert 1 - column.min() == pytest.approx(depth, rel=5e-3)
    assert np.count_nonzero(column < 1 - 2e-3 * depth) == pytest.approx((pupil + grain) / per_px, abs=3)
    assert np.count_nonzero(column < 1 - 0.995 * depth) == pytest.approx(abs(pupil - grain) / per_px, abs=3)


def test_a_grain_at_the_stop_takes_the_same_everywhere(tmp_path: Path) -> None:
    path = window_lens(tmp_path, distance=1e-4, pupil=4.0)
    found = transmission(grains(path, (0.3, 0.5, 1.0)), thin_context())
    # the beam wanders by 1e-4 mm; the polygon's area errs by 1e-3 of the share
    np.testing.assert_allclose(found, 1 - (1.0 / 4.0) ** 2, atol=1e-4)


def test_losses_of_one_surface_add_up(tmp_path: Path) -> None:
    context, path = thin_context(), window_lens(tmp_path, distance=20.0, pupil=4.0)
    one, other = (0.5, 0.2, 0.6), (-0.4, 0.0, 0.9)
    alone = [1 - transmission(grains(path, g), context) for g in (one, other)]
    both = 1 - transmission(grains(path, one, other), context)
    # each alone may be told at other places than with the other
    np.testing.assert_allclose(both, alone[0] + alone[1], atol=2 * dust_lens._ERROR)
    # nor can more be taken than there is
    crowd = grains(path, *[(0.0, 0.0, 4.0)] * 3)
    assert transmission(crowd, context).min() == 0


def test_places_have_the_pictures_axes(tmp_path: Path) -> None:
    context, path = thin_context(), window_lens(tmp_path, distance=20.0, pupil=2.0)

    def lowest(**keys: Any) -> F64:
        found = 1 - transmission(grains(path, (1.0, 0.4, 0.5), **keys), context)
        y, x = np.mgrid[:200, :200] + 0.5 - 100
        return np.array([(found * x).sum(), (found * y).sum()]) / found.sum()

    # in front, a beam towards the right comes from the left: -x f/z; at the sensor it has arrived
    per_mm = 1e3 / PITCH_UM
    np.testing.assert_allclose(lowest(), np.array([-1.0, -0.4]) * per_mm, atol=0.3)
    # the exit pupil is a focal length away: places at the height s are 1/(1 - s/f) times as far out on the sensor
    on_sensor = np.array([1.0, 0.4]) * per_mm / (1 - 0.5 / FOCAL_MM)
    np.testing.assert_allclose(lowest(on_window=True), on_sensor, atol=0.3)


@pytest.mark.parametrize(("height", "grain"), [(1.0, 0.03), (0.4, 0.1)])
def test_a_grain_on_the_window_lies_in_the_cone(height: float, grain: float) -> None:
    size, pitch_mm, f_number = 128, 2e-3, 16.0
    detector = ThreeColourDetector(width_px=size, height_px=size, pixel_pitch_um=1e3 * pitch_mm)
    prescription = stopped_down(load_lens("tessar_50_f2p8").scaled(0.2), f_number)
    real = RealLens(prescription=prescription, width_px=size, height_px=size, pixel_pitch_um=1e3 * pitch_mm)
    context = FaultContext(camera=Camera(lens=real, detector=detector))
    found = 1 - transmission(grains("", (0.0, 0.0, grain), on_window=True, height_mm=height), context)
    cone = height / f_number
    # the rim's rays come to a focus 5 µm before the sensor: 0.5 and 1.3 % of the heights; the table's cells 1 %
    assert found.max() == pytest.approx(min(1.0, (grain / cone) ** 2), rel=0.025)
    pupil = paraxial_properties(prescription)
    onto_sensor = 1 / (1 - height / (pupil.bfd_mm - pupil.exit_pupil_mm))
    wide = np.count_nonzero(found[size // 2] > 0.002 * found.max()) * pitch_mm
    assert wide == pytest.approx((grain + cone) * onto_sensor, abs=3 * pitch_mm)
    # what is lost altogether is the grain's area, from the exit pupil, whatever the cone
    lost_mm2 = found.sum() * pitch_mm**2
    assert lost_mm2 == pytest.approx(np.pi / 4 * (grain * onto_sensor) ** 2, rel=0.02)


# real lens, its surface (-1: the window), pixels from where the shadow is deepest
RAYS = [
    ("nikkor_28_f2p8", 0, (0, 0)),
    ("nikkor_28_f2p8", 0, (40, -30)),
    ("nikkor_28_f2p8", 5, (10, 0)),
    ("nikkor_28_f2p8", -1, (0, 0)),
    ("nikkor_28_f2p8", -1, (4, 3)),
]


@pytest.mark.parametrize(("name", "surface", "off"), RAYS)
def test_losses_are_those_of_rays_that_hit_grains(name: str, surface: int, off: tuple[int, int]) -> None:
    context = real_context(name)
    lens = context.camera.lens
    assert isinstance(lens, RealLens)
    fault = make("dust_on_optics", model="defocused", surface=surface if surface >= 0 else -2, count=40)
    context = replace(context)  # a memo of its own
    params = fault.draw(context, rng(4)) | {"window_height_mm": 0.7}
    found = transmission(params, context)
    row, column = np.unravel_index(int(found.argmin()), found.shape)
    row, column = min(int(row) + off[1], 255), min(int(column) + off[0], 255)
    # rays towards that pixel, spread evenly over a square that holds the beam
    distance = np.hypot(*(place := np.array([column + 0.5 - 128, row + 0.5 - 128]) / lens.focal_length_px))
    slope = place / distance * float(lens.undistorted(np.array(distance)))
    middle = -slope * paraxial_properties(lens.prescription).entrance_pupil_mm
    half = 1.0 * real_pupil_diameter_mm(lens.prescription)
    x, y = (rng(5).uniform(-half, half, (2, 100_000)).T + middle).T
    start = np.column_stack([x, y, np.zeros_like(x)])
    rays = trace(lens.prescription, start, np.tile([*slope, 1.0], (len(x), 1)), sensor_mm=lens.sensor_mm)
    points = rays.points_mm[1 + surface] if surface >= 0 else rays.points_mm[-1]
    if surface < 0:
        points = points - 0.7 * rays.directions / rays.directions[:, 2:]
    taken = np.zeros(len(x))
    columns = ("x_mm", "y_mm", "diameter_um", "transmission")
    for gx, gy, diameter, passes in zip(*(params[c] for c in columns), strict=True):
        taken += (1 - passes) * (np.hypot(points[:, 0] - gx, points[:, 1] - gy) < diameter / 2e3)
    hit = taken[rays.arrives]
    assert hit.mean() > 0.005
    chance = hit.std() / np.sqrt(len(hit))
    # of what is lost 2 %: the brightness of a footprint is a parabola, a window's shadow has one shape of footprint
    assert 1 - found[row, column] == pytest.approx(hit.mean(), abs=3.5 * chance + 0.02 * hit.mean())


@pytest.mark.parametrize(
    ("name", "surface", "slope", "off", "radius"),
    [
        ("nikkor_35_f2p8", -1, 0.43, 0.0, 0.6),
        ("nikkor_28_f2p8", -1, 0.5, 0.8, 0.3),
        ("nikkor_28_f2p8", 3, 0.65, -0.6, 0.25),
        ("nikkor_35_f2p8", 8, 0.56, -0.5, 0.25),
    ],
)
def test_footprints_are_brighter_where_rays_crowd(
    name: str, surface: int, slope: float, off: float, radius: float
) -> None:
    """A disc off the middle of a footprint, both in the radius of a disc of its area, on the axis of the field."""
    lens = real_context(name).camera.lens
    assert isinstance(lens, RealLens)
    known = beams(lens.prescription, 0.75, lens.sensor_mm)
    table = Footprint.on_row(known, surface) if surface >= 0 else Footprint.above_sensor(known, 0.65)
    footprints = table.towards(np.full((1, 1), slope), np.zeros((1, 1)))
    size = float(np.sqrt(footprints.area_mm2[0, 0] / np.pi))
    x, a = float(footprints.centre_mm[0, 0]) + off * size, radius * size
    cover = footprints.covered if surface >= 0 else footprints.covered_nearby
    found = float(cover(x, 0.0, a)[0, 0])
    half = real_pupil_diameter_mm(lens.prescription)
    start = rng(7).uniform(-half, half, (100_000, 3)) * [1, 1, 0]
    start[:, 0] -= slope * paraxial_properties(lens.prescription).entrance_pupil_mm
    rays = trace(lens.prescription, start, np.tile([slope, 0.0, 1.0], (len(start), 1)), sensor_mm=lens.sensor_mm)
    points = rays.points_mm[1 + surface] if surface >= 0 else rays.points_mm[-1]
    if surface < 0:
        points = points - 0.65 * rays.directions / rays.directions[:, 2:]
    hit = np.hypot(points[rays.arrives, 0] - x, points[rays.arrives, 1]) < a
    chance = np.sqrt(hit.mean() * (1 - hit.mean()) / len(hit))
    assert found == pytest.approx(hit.mean(), abs=3.5 * chance + 0.015 * hit.mean())


def test_between_the_places_where_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    context = make_context(512, fov_deg=65.0)
    params = make("dust_on_optics", model="defocused", count=60).draw(context, rng(2))
    quick = transmission(params, context)
    monkeypatch.setattr(dust_lens, "_COARSEST", 1)
    error = np.abs(quick - transmission(params, replace(context)))
    # where beams are all but cut off, in the corners, they change faster than shadows do
    assert np.percentile(error, 99) < dust_lens._ERROR
    assert 1e-5 < error.max() < 0.02


def test_beams_are_those_of_the_imaging_lens() -> None:
    lens = real_context("nikkor_28_f2p8").camera.lens
    assert isinstance(lens, RealLens)
    found = Footprint.on_row(beams(lens.prescription, 0.8, lens.sensor_mm), 0)
    area = found.area_mm2[0]
    assert 2 * np.sqrt(area / np.pi) == pytest.approx(lens.focal_length_mm / lens.f_number, rel=1e-3)
    # E/E(0) is the beam's area times cos⁴ and the stretch of distortion: without the latter's derivative, at small
    # angles, it is cos⁴ alone
    slope = found.slope[:128]
    place = lens.distorted(slope)
    stretch = np.gradient(place**2, slope**2)
    expected = lens.relative_illumination(place) * stretch * (1 + slope**2) ** 2
    # the area is across the axis on the curved front, not in a plane: 3 % at these angles
    np.testing.assert_allclose(found.area_mm2[2:128] / area, expected[2:], rtol=0.03)


def test_the_lens_is_the_cameras_own_or_the_one_named() -> None:
    own = real_context("nikkor_28_f2p8").camera.lens
    frame = {"width_px": 256, "height_px": 256, "pixel_pitch_um": 22.0}
    assert ImageFrame(lens=own, **frame).real_lens("") is own
    named = ImageFrame(lens=own, **frame).real_lens("tessar_50_f2p8")
    assert paraxial_properties(named.prescription).efl_mm == pytest.approx(own.focal_length_mm)
    thin = ImageFrame(lens=ThinLens(focal_length_mm=7.0, f_number=5.6), **frame).real_lens("")
    assert paraxial_properties(thin.prescription).efl_mm == pytest.approx(7.0)
    # the ray at the beam's rim is traced exactly; its width is told on a grid of heights, within 1e-3
    assert real_pupil_diameter_mm(thin.prescription) == pytest.approx(7.0 / 5.6, rel=1e-3)
    wide = ImageFrame(lens=ThinLens(focal_length_mm=7.0, f_number=1.0), **frame).real_lens("")
    assert real_pupil_diameter_mm(wide.prescription) == pytest.approx(7.0 / 2.8, rel=0.01)


def test_a_closed_stop_keeps_its_blades() -> None:
    lens = load_lens("tessar_50_f2p8")
    rim = replace(lens.surfaces[lens.stop], blades=6, blade_rounding=0.2, rotation_deg=10.0)
    surfaces = list(lens.surfaces)
    surfaces[lens.stop] = rim
    bladed = replace(lens, surfaces=tuple(surfaces))
    assert stopped_down(bladed, 1.0) is bladed
    closed = stopped_down(bladed, 8.0)
    smaller = closed.surfaces[closed.stop]
    assert smaller == replace(rim, semi_diameter_mm=smaller.semi_diameter_mm)
    # its area is that of a round stop closed as far
    assert closed.with_round_stop().surfaces[lens.stop].semi_diameter_mm == pytest.approx(
        stopped_down(lens, 8.0).surfaces[lens.stop].semi_diameter_mm, rel=1e-9
    )


# --- glow --------------------------------------------------------------------------------------------------------


def lit(context: FaultContext, x: float, y: float, bands: int = 3, **more: Any) -> FaultContext:
    """The context with a Sun at the tangents (x, y)."""
    nodes = spectra.band_nodes_nm(450.0, 650.0, bands)
    direction = np.array([x, y, 1.0]) / np.sqrt(1 + x * x + y * y)
    given: dict[str, Any] = {
        "sun_direction_C": direction,
        "wavelength_nm": nodes,
        "sun_irradiance_W_m2_nm": spectra.solar_band_irradiance_W_m2_nm(nodes, 3.0),
        "sun_angular_radius_rad": 0.0,
        "sun_visible_fraction": 1.0,
    }
    return replace(context, **(given | more))


def glow(params: dict[str, Any], context: FaultContext) -> F64:
    black = flat_electrons(context, 0.0)
    fault = make("dust_on_optics", model="defocused")
    return np.asarray(fault.apply(black, params, context).array, dtype=np.float64)


def test_a_grain_scatters_what_it_takes(tmp_path: Path) -> None:
    """The light of the lobe within the frame, by Rayleigh's encircled energy: 1 - J0² - J1² of πa² of sunlight."""
    size, grain = 257, 0.02
    context = lit(thin_context(size), 0.0, 0.0)
    # close before the stop, so that every pixel's beam crosses the grain
    params = grains(window_lens(tmp_path, distance=1e-3, pupil=10.0), (0.0, 0.0, grain), passes=0.2)
    found = glow(params, context)
    camera = context.camera
    assert context.wavelength_nm is not None
    weights = camera.detector.electron_rate_weights(context.wavelength_nm) * camera.exposure_s
    y, x = np.mgrid[:size, :size] + 0.5 - size / 2
    inside = np.hypot(x, y) < size / 2 - 1
    sine = np.sin(np.arctan((size / 2 - 1) * PITCH_UM * 1e-3 / FOCAL_MM))
    k = 2e6 * np.pi / context.wavelength_nm
    # the lobe is a mean over radii: so is the energy that it sends within an angle
    u = np.linspace(-1, 1, 201)
    scale, weight = 1 + 0.5 * u, 1 + np.cos(np.pi * u)
    scale /= np.sqrt(np.average(scale**2, weights=weight))
    ka = k[:, None] * grain / 2 * scale * sine
    encircled = np.average(scale**2 * (1 - j0(ka) ** 2 - j1(ka) ** 2), weights=weight, axis=1)
    pixel_mm2 = (PITCH_UM * 1e-3) ** 2
    whole = 0.8 * np.pi * grain**2 / 4 / pixel_mm2
    expected = weights @ (context.sun_irradiance_W_m2_nm * encircled) * whole
    # solid angles are those near the axis, and the first null is at 7 px: 2 %. What the outside reflects, R < 1 of
    # grazing light, adds (1 - cos θ)/8 of the angles in the frame at most: 0.5 %
    np.testing.assert_allclose(found[inside].sum(axis=0), expected, rtol=0.025)
    assert encircled.min() > 0.9


def test_only_pixels_whose_beam_crosses_the_grain_see_it_glow(tmp_path: Path) -> None:
    context = lit(thin_context(), 0.5, 0.1)  # the Sun is out of the frame
    params = grains(window_lens(tmp_path, distance=20.0, pupil=2.0), (0.8, -0.4, 0.2))
    shadow, light = transmission(params, thin_context()), glow(params, context)
    whole, none = shadow < shadow.min() + 1e-4, shadow == 1
    assert whole.sum() > 500
    assert none.sum() > 5000
    assert (light[whole] > 0).all()
    assert not light[none].any()
    # nearer the Sun it is brighter
    _, x = np.nonzero(whole)
    assert np.corrcoef(x, light[whole][:, 1])[0, 1] > 0.9


def test_far_from_the_sun_glow_is_the_lobes_tail_and_a_reflection(tmp_path: Path) -> None:
    grain, passes = 0.2, 0.1
    context = lit(thin_context(), 0.25, 0.05)
    params = grains(window_lens(tmp_path, distance=20.0, pupil=2.0), (0.8, -0.4, grain), passes=passes)
    row, column = 110, 80  # -20 times its slopes of -0.039 and 0.021 is within the pupil's radius of the grain
    found = glow(params, context)[row, column]
    camera, nodes, sun = context.camera, context.wavelength_nm, context.sun_direction_C
    assert nodes is not None
    assert sun is not None
    place = np.array([column + 0.5 - 100, row + 0.5 - 100, camera.focal_length_px])
    angle = float(np.arccos(place @ sun / np.linalg.norm(place)))
    # the mean of [J1(x)/x]² over rings is 1/(π x³); radii within ±50 % with a mean square of 1: their mean is 0.984
    k, a = 2e6 * np.pi / nodes, grain / 2
    diffracted = 0.984 * a / (np.pi * k * np.sin(angle) ** 3)
    # Fresnel's reflection off an opaque sphere of n = 1.53, of rays that it turns by the angle: a²/4
    inwards = np.pi / 2 - angle / 2
    inside = np.arcsin(np.sin(inwards) / 1.53)
    s = (np.sin(inwards - inside) / np.sin(inwards + inside)) ** 2
    p = (np.tan(inwards - inside) / np.tan(inwards + inside)) ** 2
    reflected = a * a / 4 * (s + p) / 2
    weights = camera.detector.electron_rate_weights(nodes) * camera.exposure_s
    light = (1 - passes) * context.sun_irradiance_W_m2_nm * (diffracted + reflected) / FOCAL_MM**2
    # offsets are told in steps of 5 %, over which 1/sin³ bends by 0.3 %; a mean over rings, 1 %
    np.testing.assert_allclose(found, weights @ light, rtol=0.015)
    assert (diffracted > 0.08 * reflected).all()  # neither is lost beside the other


def test_glow_follows_the_sun(tmp_path: Path) -> None:
    path = window_lens(tmp_path, distance=20.0, pupil=2.0)
    params = grains(path, (0.1, 0.0, 0.2))
    context = lit(thin_context(), 0.02, 0.01)
    base = glow(params, context)
    assert base.max() > 0
    irradiance = context.sun_irradiance_W_m2_nm
    assert irradiance is not None
    np.testing.assert_allclose(
        glow(params, replace(context, sun_irradiance_W_m2_nm=2 * irradiance)), 2 * base, 1e-5
    )
    np.testing.assert_allclose(glow(params, replace(context, sun_visible_fraction=0.25)), base / 4, 1e-5)
    peak = np.unravel_index(int(base[..., 1].argmax()), base.shape[:2])
    # 0.02 and 0.01 of 500 px from the middle; the pixels about the Sun's place share its light
    np.testing.assert_allclose(np.array(peak) + 0.5, [105.0, 110.0], atol=1.1)
    for dark in (
        replace(context, sun_visible_fraction=0.0),
        replace(context, sun_direction_C=None),
        replace(context, sun_irradiance_W_m2_nm=None),
        replace(context, sun_direction_C=np.array([0.0, 0.6, -0.8])),
    ):
        assert not glow(params, dark).any()
    # the Sun's disc blurs the lobe
    wide = glow(params, replace(context, sun_angular_radius_rad=0.01))
    assert wide.max() < 0.8 * base.max()
    assert wide.sum() == pytest.approx(base.sum(), rel=0.1)


def test_behind_the_front_only_the_suns_own_beam_lights_grains() -> None:
    context = real_context("nikkor_28_f2p8")
    params = make("dust_on_optics", model="defocused", surface=6, count=30).draw(context, rng(0))
    assert glow(params, lit(context, 0.1, 0.0)).any()
    assert not glow(params, lit(context, 3.0, 0.0)).any()


# --- what is drawn -----------------------------------------------------------------------------------------------


def test_draws_keep_to_their_keys() -> None:
    context = make_context(256, fov_deg=65.0)
    own = context.frame.real_lens("").prescription
    keys = {"count": 400, "diameter_um": [50, 300], "transmission": [0.1, 0.2], "size_exponent": 2.0}
    params = make("dust_on_optics", model="defocused", surface=3, **keys).draw(context, rng(1))
    assert json.loads(json.dumps(params)) == params
    assert params["surface"] == 3
    radius = np.hypot(params["x_mm"], params["y_mm"]) / own.surfaces[3].semi_diameter_mm
    assert radius.max() <= 1.001
    # evenly over the disc: half of the grains within 1/√2, ± 4 σ of a coin thrown 400 times
    assert abs((radius < np.sqrt(0.5)).mean() - 0.5) < 0.1
    diameter = np.array(params["diameter_um"])
    assert 50 <= diameter.min() <= diameter.max() <= 300
    # N(> D) ∝ D⁻²: of those above 50 the share (1/4 - 1/36)/(1 - 1/36) lies above 100; ± 4 σ
    assert abs((diameter > 100).mean() - (1 / 4 - 1 / 36) / (1 - 1 / 36)) < 4 * np.sqrt(0.23 * 0.77 / 400)
    assert 0.1 <= min(params["transmission"]) <= max(params["transmission"]) <= 0.2
    mixed = make("dust_on_optics", model="defocused", surface=-1, count=400).draw(context, rng(1))
    assert abs(np.mean(mixed["on_window"]) - 0.5) < 0.1
    window = make("dust_on_optics", model="defocused", surface=-2, window_height_mm=0.4, count=50)
    drawn = window.draw(context, rng(1))
    assert all(drawn["on_window"])
    assert drawn["window_height_mm"] == 0.4
    half = 128 * context.camera.detector.pixel_pitch_um * 1e-3
    assert np.abs(drawn["x_mm"]).max() <= half


def test_no_grains_change_nothing() -> None:
    context = lit(make_context(128), 0.1, 0.0)
    fault = make("dust_on_optics", model="defocused", count=0)
    params = fault.draw(context, rng())
    grey = flat_electrons(context)
    assert np.array_equal(fault.apply(grey, params, context).array, grey.array)
    assert not fault.footprint(params, context).any()  # type: ignore[union-attr]


def test_mask_holds_what_loses_enough(tmp_path: Path) -> None:
    context = thin_context()
    params = grains(window_lens(tmp_path, distance=20.0, pupil=4.0), (0.3, 0.1, 1.0))
    fault = make("dust_on_optics", model="defocused")
    for loss in (0.01, 0.05):
        mask = fault.footprint(params | {"mask_loss": loss}, context)
        assert np.array_equal(mask, transmission(params, context).astype(np.float32) <= np.float32(1 - loss))
        assert 0 < mask.sum() < mask.size  # type: ignore[union-attr]


def test_mask_holds_the_glow_too(tmp_path: Path) -> None:
    """Outside the mask a black picture gains less than the level; the mask holds glow where no shadow is."""
    context = lit(thin_context(), 0.02, 0.0)
    context = replace(context, camera=replace(context.camera, exposure_s=1.0))
    # so small that it takes less than the mask's level of any beam, and scatters sunlight widely
    params = grains(window_lens(tmp_path, distance=20.0, pupil=4.0), (-0.3, 0.1, 0.2))
    fault = make("dust_on_optics", model="defocused")
    mask = fault.footprint(params | {"mask_loss": 0.01}, context)
    assert mask is not None
    gained = (glow(params, context) / np.asarray(context.camera.detector.white_e)).max(axis=2)
    assert gained.max() > 0.05
    assert gained[~mask].max() < 0.01
    assert (transmission(params, context)[mask] > 0.99).any()


def test_rows_that_a_lens_lacks_are_refused() -> None:
    with pytest.raises(InputError, match=r"surface = 40: nikkor_35_f2p8 has rows 0 to"):
        make("dust_on_optics", model="defocused", lens="nikkor_35_f2p8", surface=40)


# --- fine dust on the front --------------------------------------------------------------------------------------


def cover(context: FaultContext, light: F64, **keys: Any) -> F64:
    """Of one channel, in units of white, under a third of the front covered by fine dust and no single grain."""
    fault = make("dust_on_optics", model="defocused", count=0, cover=1 / 3, **keys)
    params = json.loads(json.dumps(fault.draw(context, rng())))
    white = flat_electrons(context, 1.0)
    after = fault.apply(white.with_array(white.array * light[..., None].astype(np.float32)), params, context)
    assert fault.footprint(params, context).all()  # type: ignore[union-attr]
    np.testing.assert_allclose(fault.soft(params, context), 1 / 3, rtol=1e-6)
    return np.asarray((after.array / white.array)[..., 1], dtype=np.float64)


def test_fine_dust_dims_a_field_and_dims_a_point_more() -> None:
    context = thin_context()
    np.testing.assert_allclose(cover(context, np.full((200, 200), 0.5)), 0.5 * 2 / 3, rtol=1e-4)
    point = np.zeros((200, 200))
    point[100, 100] = 1e4
    found = cover(context, point)
    # Babinet: (1 - c)² stays, c (1 - c) is diffracted, nearly all of it within the frame
    halo = found.sum() - 1e4 * (2 / 3) ** 2
    assert halo == pytest.approx(1e4 * 2 / 9, rel=0.05)
    assert found[100, 100] == pytest.approx(1e4 * (2 / 3) ** 2, rel=0.1)


def test_finer_dust_has_a_wider_halo() -> None:
    context = thin_context()
    point = np.zeros((200, 200))
    point[100, 100] = 1e4
    distance_mm = np.hypot(*(np.mgrid[:200, :200] - 100)) * PITCH_UM * 1e-3
    for diameter_um in (5.0, 10.0, 20.0):
        found = cover(context, point, cover_um=diameter_um)
        # a disc diffracts 1 - J0² - J1² of its light within x = k a sin θ: 84 % within the first dark ring at 3.83;
        # grains of unlike sizes blur the rings
        ring_mm = FOCAL_MM * 3.83 / (np.pi * diameter_um * 1e3 / 587.6)
        inside = found[distance_mm <= ring_mm].sum() - 1e4 * (2 / 3) ** 2
        assert inside / (1e4 * 2 / 9) == pytest.approx(0.84, abs=0.08)
