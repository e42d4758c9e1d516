"""Vignetting by a prescription against cos⁴, overlaps of discs, and rays of the test's own."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.camera import Camera
from vbnfault.core.errors import InputError
from vbnfault.detector import ThreeColourDetector
from vbnfault.faults import FaultContext
from vbnfault.lens import RealLens, ThinLens, load_lens, paraxial_properties, scaled_to_field
from vbnfault.lens.rays import real_pupil_diameter_mm, trace

F64 = NDArray[np.float64]

FOCAL_MM, SIZE = 10.0, 160
# A stop before a lens of next to no thickness: no distortion, no vignetting but the natural one.
THIN_ONE = """
surface = [
  {{ stop = true, thickness_mm = 0.0, diameter_mm = {pupil} }},
  {{ radius_mm = 100.0, thickness_mm = {thickness}, nd = 1.5, diameter_mm = {rim} }},
  {{ radius_mm = -100.0, diameter_mm = {rim} }},
]
"""


def thin_lens(tmp_path: Path, *, pupil: float, rim: float, thickness: float) -> str:
    """Path of the lens above, its pupil 100 / FOCAL_MM times as wide as it will be."""
    path = tmp_path / "thin.toml"
    path.write_text(THIN_ONE.format(pupil=pupil * 10, rim=rim * 10, thickness=thickness * 10), encoding="utf-8")
    return str(path)


def context(fov_deg: float = 60.0) -> FaultContext:
    pitch_um = 2e3 * FOCAL_MM * np.tan(np.radians(fov_deg / 2)) / SIZE
    detector = ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=float(pitch_um))
    return FaultContext(camera=Camera(lens=ThinLens(focal_length_mm=FOCAL_MM, f_number=1.0), detector=detector))


@cache
def real_context(name: str) -> FaultContext:
    detector = ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=20.0)
    lens = scaled_to_field(load_lens(name), 65.0, SIZE * 20e-3)
    real = RealLens(prescription=lens, width_px=SIZE, height_px=SIZE, pixel_pitch_um=20.0)
    return FaultContext(camera=Camera(lens=real, detector=detector))


def slopes(where: FaultContext) -> tuple[F64, F64]:
    """Tangents of the field angles of a thin lens's pixels."""
    place = (np.arange(SIZE) + 0.5 - SIZE / 2) / where.camera.focal_length_px
    x, y = np.meshgrid(place, place)
    return x, y


def whole(lens: str = "") -> dict[str, Any]:
    """Parameters without a fault."""
    return {
        "lens": lens,
        "decentre_mm": [0.0, 0.0],
        "hood_distance_mm": 5.0,
        "hood_radius_mm": 1e4,
        "hood_offset_mm": [0.0, 0.0],
        "mask_loss": 0.1,
    }


def left(params: dict[str, Any], where: FaultContext) -> F64:
    grey = flat_electrons(where)
    found = make("vignetting", model="lens").apply(grey, params, where).array / grey.array
    np.testing.assert_allclose(found[..., 0], found[..., 1], rtol=1e-6)  # colours lose alike
    return np.asarray(found[..., 1], dtype=np.float64)


def overlap(d: F64, a: float, b: float) -> F64:
    """Area that discs of radii a and b share, by integrating chords: no closed form in common with the code."""
    x = np.linspace(-a, a, 4001)
    half_a = np.sqrt(np.maximum(a * a - x * x, 0))
    half_b = np.sqrt(np.maximum(b * b - (x - d[..., None]) ** 2, 0))
    return np.asarray(np.trapezoid(2 * np.minimum(half_a, half_b), x, axis=-1))


# --- the lens itself ---------------------------------------------------------------------------------------------


def test_a_small_aperture_follows_cos4(tmp_path: Path) -> None:
    where = context()
    path = thin_lens(tmp_path, pupil=0.05, rim=0.2, thickness=0.002)
    x, y = slopes(where)
    # the thickness, 2e-4 of the focal length, is what is left of distortion
    np.testing.assert_allclose(left(whole(path), where), (1 + x * x + y * y) ** -2, rtol=1e-3)


def test_a_thin_lens_is_given_the_prescriptions_illumination_once() -> None:
    where = make_context(SIZE, fov_deg=60.0)
    found = left(whole("nikkor_28_f2p8"), where)
    own = make("vignetting", model="lens")
    # the lens as the camera has it: at its focal length, and closed to f/4
    focal, f_number = where.camera.lens.focal_length_mm, 4.0
    lens = load_lens("nikkor_28_f2p8").scaled(focal / paraxial_properties(load_lens("nikkor_28_f2p8")).efl_mm)
    stop = lens.surfaces[lens.stop]
    heights = trace(lens, [[focal / f_number / 2, 0.0, -1.0]], [[0.0, 0.0, 1.0]]).points_mm[1 + lens.stop, 0, 0]
    surfaces = list(lens.surfaces)
    surfaces[lens.stop] = replace(stop, semi_diameter_mm=float(heights))
    closed = replace(lens, surfaces=tuple(surfaces))
    pitch = where.camera.detector.pixel_pitch_um
    real = RealLens(prescription=closed, width_px=SIZE, height_px=SIZE, pixel_pitch_um=pitch)
    x, y = slopes(where)
    expected = real.relative_illumination(real.distorted(np.hypot(x, y)))
    np.testing.assert_allclose(found, expected, atol=2e-4)  # linear between 2049 angles
    assert found.min() < 0.7
    # no cos⁴ on top: with it the corner would have half as much
    corner = (1 + (x * x + y * y)[0, 0]) ** -2
    assert found[0, 0] > 0.8 * corner
    assert own.footprint(whole("nikkor_28_f2p8"), where) is not None


def test_a_real_lens_without_a_fault_is_left_alone() -> None:
    for name in ("nikkor_28_f2p8", "tessar_50_f2p8"):  # the corners of the latter are dark
        where = real_context(name)
        grey = flat_electrons(where)
        assert np.array_equal(make("vignetting", model="lens").apply(grey, whole(), where).array, grey.array)
        assert not make("vignetting", model="lens").footprint(whole(), where).any()  # type: ignore[union-attr]


# --- faults ------------------------------------------------------------------------------------------------------


def test_a_hood_takes_what_its_opening_does_not_overlap(tmp_path: Path) -> None:
    where = context()
    path = thin_lens(tmp_path, pupil=2.0, rim=2.8, thickness=0.2)
    x, y = slopes(where)
    distance, radius, moved = 4.0, 2.2, (0.9, -0.5)
    params = whole(path) | {
        "hood_distance_mm": distance,
        "hood_radius_mm": radius,
        "hood_offset_mm": list(moved),
    }
    found = left(params, where) / left(whole(path), where)
    # a beam to the right crosses the opening's plane on the left
    away = np.hypot(-distance * x - moved[0], -distance * y - moved[1])
    expected = overlap(away[::8, ::8], 1.0, radius) / np.pi
    # linear between places a twelfth of the soft edge's width apart, whose ends go with a power of 1.5
    np.testing.assert_allclose(found[::8, ::8], expected, atol=(1 / 12) ** 1.5 / 4)
    assert np.abs(found[::8, ::8] - expected).mean() < 1e-3
    assert expected.min() == 0
    assert expected.max() == pytest.approx(1, abs=1e-3)
    # what was moved to the right lets more pass on the left
    assert found[:, : SIZE // 2].mean() > found[:, SIZE // 2 :].mean()


@pytest.mark.parametrize("slip", [0.15, 0.7, 1.6, 2.1])
def test_a_slipped_ring_leaves_the_overlap_of_two_discs(tmp_path: Path, slip: float) -> None:
    where = context(30.0)
    path = thin_lens(tmp_path, pupil=2.0, rim=2.8, thickness=0.2)
    params = whole(path) | {"decentre_mm": [slip * 0.6, -slip * 0.8]}
    found = left(params, where) / left(whole(path), where)
    # of 64 lines of rays through a beam some touch the edge: (π/32)^1.5 / 8
    np.testing.assert_allclose(found, overlap(np.array(slip), 1.0, 1.0) / np.pi, atol=4e-3)


@pytest.mark.parametrize(("column", "row"), [(80, 80), (130, 60), (25, 25), (140, 150)])
def test_what_is_left_of_a_real_lenss_rays(column: int, row: int) -> None:
    where = real_context("nikkor_28_f2p8")
    lens = where.camera.lens
    assert isinstance(lens, RealLens)
    stop_mm = lens.prescription.surfaces[lens.prescription.stop].semi_diameter_mm
    params = whole() | {
        "decentre_mm": [0.3 * stop_mm, 0.2 * stop_mm],
        "hood_distance_mm": 2.0,
        "hood_radius_mm": 3.6,
        "hood_offset_mm": [1.2, -0.4],
    }
    found = left(params, where)[row, column]
    place = np.array([column + 0.5 - SIZE / 2, row + 0.5 - SIZE / 2]) / lens.focal_length_px
    distance = float(np.hypot(*place))
    slope = place / distance * float(lens.undistorted(np.array(distance)))
    middle = -slope * paraxial_properties(lens.prescription).entrance_pupil_mm
    half = real_pupil_diameter_mm(lens.prescription)
    x, y = (rng(1).uniform(-half, half, (2, 60_000)).T + middle).T
    start = np.column_stack([x, y, np.zeros_like(x)])
    rays = trace(lens.prescription, start, np.tile([*slope, 1.0], (len(x), 1)), sensor_mm=lens.sensor_mm)
    at_stop = rays.points_mm[1 + lens.prescription.stop]
    clears = np.hypot(at_stop[:, 0] - 0.3 * stop_mm, at_stop[:, 1] - 0.2 * stop_mm) <= stop_mm
    clears &= np.hypot(x - 2.0 * slope[0] - 1.2, y - 2.0 * slope[1] + 0.4) <= 3.6
    share = clears[rays.arrives].mean()
    chance = np.sqrt(share * (1 - share) / rays.arrives.sum())
    # rays lie on straight lines in the stop, as they do at the entrance, but for its aberrations: 3e-3
    assert found == pytest.approx(share, abs=3.5 * chance + 6e-3)


def test_never_above_one_and_less_with_more_slip() -> None:
    where = make_context(SIZE, fov_deg=60.0)
    for seed in range(3):
        params = make("vignetting", model="lens", decentre=[0, 1], hood_offset=[0, 1]).draw(where, rng(seed))
        found = left(params, where)
        assert 0 <= found.min() <= found.max() <= 1
    real = real_context("nikkor_28_f2p8")
    stop_mm = real.camera.lens.prescription.surfaces[real.camera.lens.prescription.stop].semi_diameter_mm  # type: ignore[union-attr]
    before = np.ones((SIZE, SIZE))
    for slip in (0.2, 0.5, 0.9):
        after = left(whole() | {"decentre_mm": [slip * stop_mm, 0.0]}, real)
        assert (after <= before + 1e-6).all()
        assert after.mean() < 0.95 * before.mean()
        before = after


# --- what is drawn -----------------------------------------------------------------------------------------------


def test_draws_are_plain_and_scale_with_the_lens() -> None:
    fault = make("vignetting", model="lens", decentre=0.25, hood_offset=0.5)
    small, large = (
        fault.draw(replace(where), rng(3)) for where in (make_context(SIZE), make_context(2 * SIZE, 2 * SIZE))
    )
    assert json.loads(json.dumps(small)) == small
    # the same field of view on twice the sensor: all lengths are twice as long
    for key in ("hood_distance_mm", "hood_radius_mm"):
        assert large[key] == pytest.approx(2 * small[key], rel=1e-3)
    assert np.hypot(*large["decentre_mm"]) == pytest.approx(2 * np.hypot(*small["decentre_mm"]), rel=1e-3)
    assert np.hypot(*small["hood_offset_mm"]) == pytest.approx(0.5 * small["hood_radius_mm"])
    given = make("vignetting", model="lens", hood_distance_mm=7.5, hood_radius_mm=3.25).draw(
        make_context(SIZE), rng(3)
    )
    assert (given["hood_distance_mm"], given["hood_radius_mm"]) == (7.5, 3.25)
    # a hood that has not moved clears the frame
    centred = make("vignetting", model="lens", decentre=0, hood_offset=0).draw(make_context(SIZE), rng(0))
    without = left(whole(), make_context(SIZE))
    np.testing.assert_allclose(left(centred, make_context(SIZE)), without, rtol=1e-6)


def test_mask_starts_at_the_stated_loss() -> None:
    where = make_context(SIZE, fov_deg=60.0)
    fault = make("vignetting", model="lens", decentre=0.1)
    params = fault.draw(where, rng(0))
    for loss in (0.1, 0.3):
        mask = fault.footprint(params | {"mask_loss": loss}, where)
        found = left(params, where)
        clear = np.abs(found - (1 - loss)) > 1e-6
        assert np.array_equal(mask[clear], found[clear] < 1 - loss)  # type: ignore[index]


def test_a_lens_that_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match="no_such_lens"):
        make("vignetting", model="lens", lens="no_such_lens")
