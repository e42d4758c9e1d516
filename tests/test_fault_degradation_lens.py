"""Contaminated optics: energy, kernels against their integrals, transmission against closed forms."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Electrons
from vbnfault.faults import FaultContext, degradation_lens, planes
from vbnfault.faults.degradation_lens import browned, colours, haze_kernel, scratch_kernel, stabilised, worn
from vbnfault.lens import parse_lens

F64 = NDArray[np.float64]

NONE: dict[str, Any] = {
    "lens": "",
    "coating": "mgf2",
    "haze": 0.0,
    "haze_knee": 0.02,
    "haze_slope": -2.0,
    "dose_krad": 0.0,
    "coating_loss": 0.0,
    "scratches": [],
    "scratch_bend_deg": 1.5,
    "browning_per_mm_krad": 7e-4,
    "browning_exponent": 4.0,
}


def applied(quantity: Electrons, params: dict[str, Any], where: FaultContext) -> F64:
    out = make("optics_degradation", model="contamination").apply(quantity, params, where)
    return np.asarray(out.array, dtype=np.float64)


def point(where: FaultContext, x: int, y: int, whites: float = 1e3) -> Electrons:
    """A black frame with one bright pixel."""
    black = flat_electrons(where, 0.0)
    array = black.array.copy()
    array[y, x] = whites * black.white_e
    return black.with_array(array)


def scratch(angle_deg: float, share: float = 0.02, width_um: float = 5.0) -> dict[str, float]:
    return {"angle_deg": angle_deg, "width_um": width_um, "share": share}


def ring(log_tangent: float, knee: float, slope: float) -> float:
    """Haze per logarithm of the distance from the image's place."""
    tangent = np.exp(log_tangent)
    return float(2 * np.pi * tangent**2 * haze_kernel(np.array(tangent), knee, slope))


# --- kernels -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("knee", "slope"), [(0.01, -1.8), (0.05, -2.0), (0.02, -2.5), (0.2, -1.0)])
def test_haze_goes_somewhere_within_the_sphere(knee: float, slope: float) -> None:
    # on the whole plane, but for angles above 89.9 degrees, which have less than 2 · 0.0017² of it
    total, _ = quad(ring, np.log(1e-7), np.log(573.0), args=(knee, slope), limit=200)
    assert total == pytest.approx(1.0, abs=1e-5)
    # Harvey's: flat within the knee, then a slope of S in double logarithms; on the sensor times cos⁴
    middle, at_knee = haze_kernel(np.array([0.0, knee / np.sqrt(1 - knee**2)]), knee, slope)
    assert at_knee == pytest.approx(middle * 2 ** (slope / 2) * (1 - knee**2) ** 2)


def test_a_scratchs_streak_is_whole_and_falls_as_its_slit_does() -> None:
    width_um, bend, soft = 5.0, 0.02, 1e-3
    half = 0.55 / (2 * np.pi * width_um)

    def strip(along: float) -> float:
        across = np.linspace(-8, 8, 801) * np.hypot(soft, bend * along)
        values = scratch_kernel(
            np.full_like(across, along), across, width_um=width_um, bend_rad=bend, soft=soft, cell=1e-5
        )
        return float(np.trapezoid(values, across))

    # Lorentz: the share within ± a is 2/π atan(a / half)
    total, _ = quad(strip, 0, 0.5, points=[half, 10 * half], limit=200)
    assert 2 * total == pytest.approx(2 / np.pi * np.arctan(0.5 / half), rel=1e-6)
    # far out it is the mean of w/λ sinc²(π w β/λ)
    for beta in (0.1, 0.2):
        assert strip(beta) == pytest.approx(0.55 / (2 * np.pi**2 * width_um * beta**2), rel=0.04)


# --- scattered light ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [96, 384])
def test_haze_keeps_the_light(size: int) -> None:
    # of 140 degrees the frame's half is 2.7 focal lengths: nearly all of the haze lands on it
    where = make_context(size, fov_deg=140.0)
    source = point(where, size // 2, size // 2)
    # the second has its core within a cell
    for slope, knee in ((-1.8, 0.1), (-2.5, 0.02)):
        params = NONE | {"haze": 0.3, "haze_slope": slope, "haze_knee": knee}
        found = applied(source, params, where)
        # between what lands within the circle in the frame and within that around it; the kernel's sum over cells
        # is its integral within 3e-3
        total = found.sum(axis=(0, 1)) / source.array.sum(axis=(0, 1))
        inner, outer = (
            quad(ring, np.log(1e-7), np.log(reach * np.tan(np.radians(70))), args=(knee, slope), limit=200)[0]
            for reach in (1, np.sqrt(2))
        )
        assert inner > 0.85
        assert (0.7 + 0.3 * inner - 1e-3 < total).all()
        assert (total < 0.7 + 0.3 * outer + 1e-3).all()
        # what is left in place, but for the haze of the core
        kept = found[size // 2, size // 2, 1] / source.array.max(axis=(0, 1))[1]
        assert 0.7 < kept < 0.7 + 0.3 * 0.5


def test_scratches_keep_the_light() -> None:
    size = 384
    where = make_context(size, fov_deg=140.0)
    source = point(where, size // 2, size // 2)
    shares = [scratch(20.0), scratch(100.0, width_um=10.0)]
    found = applied(source, NONE | {"scratches": shares}, where)
    # a Lorentz curve's share beyond the grid, which is as wide as the frame each way and more along the diagonal
    reach = size / where.camera.focal_length_px
    beyond = [
        s["share"] * (1 - 2 / np.pi * np.arctan(reach / (0.55 / (2 * np.pi * s["width_um"])))) for s in shares
    ]
    total = found.sum(axis=(0, 1)) / source.array.sum(axis=(0, 1))
    # a streak is as long as the grid along one side, and longer along the diagonal; half of it may miss the frame
    assert (total < 1 + 1e-4).all()
    assert (total > 1 - 2.5 * sum(beyond)).all()
    assert 2.5 * sum(beyond) < 0.1 * 0.04


def test_a_streak_lies_across_its_scratch() -> None:
    where = make_context(256, fov_deg=40.0)
    source = point(where, 128, 128)
    for angle, direction in ((90.0, (1.0, 0.0)), (0.0, (0.0, 1.0)), (45.0, (-1.0, 1.0))):
        light = applied(source, NONE | {"scratches": [scratch(angle)]}, where)[..., 1]
        light[126:131, 126:131] = 0
        y, x = np.mgrid[:256, :256] - 128.0
        unit = np.array(direction) / np.hypot(*direction)
        along = (light * (x * unit[0] + y * unit[1]) ** 2).sum()
        across = (light * (y * unit[0] - x * unit[1]) ** 2).sum()
        assert along > 50 * across


def test_against_a_sum_over_all_pixels() -> None:
    """Small frames have a pixel to a cell: what the transforms give is the sum over the frame and its mirror."""
    size = 32
    where = make_context(size, fov_deg=50.0)
    source = flat_electrons(where)
    array = rng(2).uniform(0, 0.9, source.array.shape).astype(np.float32) * source.white_e
    array[20, 9] *= 200  # beyond white, it has no mirror image
    params = NONE | {"haze": 0.2, "scratches": [scratch(30.0)]}
    found = applied(source.with_array(array), params, where)
    frame = where.frame
    kernel = degradation_lens.kernel(params, frame, (2 * size, 2 * size)).astype(np.float64)
    world = np.pad(np.minimum(array, source.white_e), ((16, 16), (16, 16), (0, 0)), mode="symmetric")
    world[16:48, 16:48] = array
    expected = np.zeros_like(found)
    for dy in range(2 * size):
        for dx in range(2 * size):
            expected += kernel[dy, dx] * np.roll(world, (dy, dx), axis=(0, 1))[16:48, 16:48]
    expected += (1 - 0.2 - 0.02) * array
    # single precision over 4096 terms of up to 200 white
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_cells_of_several_pixels_tell_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    where = make_context(384, fov_deg=60.0)
    rough = rng(0).uniform(0, 1, (12, 12)).astype(np.float32)
    scene = np.kron(rough, np.ones((32, 32), np.float32))[..., None] * flat_electrons(where, 0.5).array
    quantity = flat_electrons(where).with_array(scene)
    params = NONE | {"haze": 0.3, "haze_knee": 0.03, "scratches": [scratch(25.0)]}
    exact = applied(quantity, params, where)  # two pixels to a cell
    monkeypatch.setattr(planes, "_CELLS", 96)
    coarse = applied(quantity, params, where)
    assert planes.cell_px(where.frame) == 4
    # a core of 10 px is smoothed by one of 4: at the steps of the scene, where the haze changes by half of it over
    # the core, by a few per cent of the haze
    assert np.abs(coarse - exact).max() < 0.04 * 0.32 * scene.max()
    assert np.abs(coarse - exact).mean() < 2e-3 * scene.mean()


def test_the_suns_light_is_not_clipped() -> None:
    where = make_context(256)
    params = NONE | {"haze": 0.05}
    one, ten = (applied(point(where, 100, 90, whites), params, where) for whites in (1e4, 1e5))
    far = np.hypot(*(np.mgrid[:256, :256] - np.array([90, 100])[:, None, None])) > 20
    np.testing.assert_allclose(ten[far], 10 * one[far], rtol=1e-3)
    assert one[far].min() > 0


# --- what passes -------------------------------------------------------------------------------------------------


def singlet(**glass: Any) -> dict[str, Any]:
    return {
        "surface": [
            {"stop": True, "diameter_mm": 4.0, "thickness_mm": 0.5},
            {"radius_mm": 50.0, "thickness_mm": 3.0, "diameter_mm": 8.0, **glass},
            {"radius_mm": -50.0, "diameter_mm": 8.0},
        ]
    }


def test_browning_is_that_of_the_glass_on_the_axis() -> None:
    nodes = np.array([400.0, 500.0, 700.0])
    given = {"dose_krad": 100.0, "per_mm_krad": 7e-4, "exponent": 4.0}
    ordinary = browned(parse_lens(singlet(glass="N-BK7"), source="singlet"), nodes, **given)
    np.testing.assert_allclose(ordinary, np.exp(-3.0 * 7e-2 * (400 / nodes) ** 4), rtol=1e-12)
    # air, before and behind, does not brown; ten times the dose is ten times the optical depth
    np.testing.assert_allclose(
        browned(parse_lens(singlet(glass="N-BK7"), source="s"), nodes, **(given | {"dose_krad": 1000.0})),
        ordinary**10,
        rtol=1e-12,
    )
    hard = browned(parse_lens(singlet(glass="BK7G18"), source="singlet"), nodes, **given)
    np.testing.assert_allclose(hard, ordinary**0.01, rtol=1e-12)
    assert hard.min() > 0.997


def test_which_glasses_are_stabilised() -> None:
    assert [stabilised(n) for n in ("BK7G18", "F2G12", "LAK9G15", "SF6G05", "silica")] == [True] * 5
    assert [stabilised(n) for n in ("N-BK7", "F2", "SF6", "1.51680/64.2", "air", "GK7")] == [False] * 6


def test_a_worn_coating_reflects_as_its_parts_do() -> None:
    lens = parse_lens(singlet(nd=1.5168, coating="mgf2"), source="singlet")
    lens = lens.coated("mgf2")
    nodes = np.array([550.0])
    bare = (0.5168 / 2.5168) ** 2
    # a quarter wave: ((n - m²)/(n + m²))² with m = 1.38, at its own wavelength
    film = ((1.5168 - 1.38**2) / (1.5168 + 1.38**2)) ** 2
    for loss in (0.0, 0.4, 1.0):
        expected = ((1 - film - loss * (bare - film)) / (1 - film)) ** 2
        np.testing.assert_allclose(worn(lens, nodes, loss), expected, rtol=1e-6)


def test_dose_reddens_and_darkens() -> None:
    where = make_context(64)
    before = np.ones(3)
    for dose in (100.0, 1000.0, 5000.0):
        after = colours(NONE | {"dose_krad": dose}, where)
        assert (after < before).all()
        assert after[0] > after[1] > after[2]  # red, green, blue
        before = after
    np.testing.assert_allclose(colours(NONE, where), 1.0, rtol=1e-12)
    worn_ones = [colours(NONE | {"coating_loss": loss}, where) for loss in (0.0, 0.2, 0.6, 1.0)]
    assert (np.diff(worn_ones, axis=0) < -1e-3).all()


def test_colours_weigh_every_nanometre_as_the_detector_does() -> None:
    where = make_context(64)
    nodes = spectra.band_nodes_nm(400.0, 700.0, 4)
    sun = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0)
    lit = replace(where, wavelength_nm=nodes, sun_irradiance_W_m2_nm=sun)
    params = NONE | {"dose_krad": 2000.0}
    nm = np.linspace(400.0, 700.0, 301)
    passes = browned(
        where.frame.real_lens("").prescription,
        nm,
        dose_krad=2000.0,
        per_mm_krad=7e-4,
        exponent=4.0,
    )
    grey = flat_electrons(where)
    sensed = where.camera.detector.electron_rates(nm) * spectra.solar_irradiance_W_m2_nm(nm)
    expected = (sensed * passes).sum(axis=1) / sensed.sum(axis=1)
    found = applied(grey, params, lit) / grey.array
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-4)  # sums, not trapezia


# --- what is drawn -----------------------------------------------------------------------------------------------


def test_draws_keep_to_their_keys() -> None:
    where = make_context(128)
    keys = {"haze": [0.02, 0.03], "scratches": 6, "scratch_width_um": [4, 8], "scratch_length": [0.5, 1.0]}
    for seed in range(5):
        params = make("optics_degradation", model="contamination", **keys).draw(where, rng(seed))
        assert json.loads(json.dumps(params)) == params
        assert 0.02 <= params["haze"] <= 0.03
        assert len(params["scratches"]) == 6
        beam_mm = where.camera.lens.focal_length_mm / where.camera.lens.f_number
        for one in params["scratches"]:
            # share of a beam's disc that a strip takes: between the narrowest and shortest, and the widest, longest
            assert 4e-3 * 0.5 / (np.pi / 4 * beam_mm) <= one["share"] <= 8e-3 / (np.pi / 4 * beam_mm)
    # on a lens of the width of a hair scratches cannot take more than there is
    tiny = make("optics_degradation", model="contamination", scratches=50, scratch_width_um=1000, haze=0.5)
    params = tiny.draw(where, rng(0))
    assert sum(s["share"] for s in params["scratches"]) == pytest.approx(0.25)
    assert applied(flat_electrons(where), params, where).min() > 0


def test_the_mask_is_the_whole_image_and_a_clean_lens_does_nothing() -> None:
    where = make_context(64)
    fault = make("optics_degradation", model="contamination")
    assert fault.footprint(NONE, where).all()  # type: ignore[union-attr]
    grey = flat_electrons(where)
    np.testing.assert_allclose(applied(grey, NONE, where), grey.array, rtol=1e-6)


def test_lenses_are_found_or_refused() -> None:
    with pytest.raises(InputError, match="no_such_lens"):
        make("optics_degradation", model="contamination", lens="no_such_lens")
    where = make_context(64)
    params = NONE | {"dose_krad": 3000.0}
    packaged = colours(params | {"lens": "nikkor_35_f2p8"}, where)
    np.testing.assert_allclose(colours(params, where), packaged, rtol=1e-12)
    assert np.abs(colours(params | {"lens": "biotar_100_f1p4"}, where) - packaged).max() > 0.01


def test_a_flat_field_stays_flat() -> None:
    where = make_context(512)
    found = (
        applied(flat_electrons(where), NONE | {"haze": 0.2, "haze_slope": -2.5}, where)
        / flat_electrons(where).array
    )
    assert np.ptp(found) < 1e-4
    # but for what goes farther than a frame's width: of the sphere's share, (1 + ...)
    reach = 512 / where.camera.focal_length_px
    inside, _ = quad(lambda b: 2 * np.pi * b * float(haze_kernel(np.array(b), 0.02, -2.5)), 0, reach, points=[0.02])
    assert 0.8 + 0.2 * inside - 1e-3 < found.mean() < 1
