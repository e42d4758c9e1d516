"""Spectra: the Sun, band weights and photons against tables, direct integration and hand calculations."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from colour.characterisation.datasets.cameras.dslr.sensitivities import MSDS_CAMERA_SENSITIVITIES_DSLR
from colour.plotting.datasets.astm_g_173 import DATA_ASTMG173_ETR
from hypothesis import given
from hypothesis import strategies as st

from vbnfault.core import spectra
from vbnfault.core.files import resources
from vbnfault.core.quantities import LUMINANCE, Irradiance
from vbnfault.detector import ThreeColourDetector

NODES = spectra.band_nodes_nm(400, 700, 8)
TABLE_NM, TABLE_W_M2_NM = np.loadtxt(
    resources.data_dir("catalogues") / "solar_spectrum.csv", delimiter=",", skiprows=1
).T


def direct_electrons(reflectance: np.ndarray, wavelength_nm: np.ndarray, peak: float = 0.5) -> np.ndarray:
    """∫ QE S ρ λ/(hc) dλ for R, G, B by the trapezium rule from the tables themselves: 1 / (s m²)."""
    camera = MSDS_CAMERA_SENSITIVITIES_DSLR["Nikon 5100 (NPL)"]
    sun = np.interp(wavelength_nm, TABLE_NM, TABLE_W_M2_NM)
    photons_per_joule = wavelength_nm * 1e-9 / (6.62607015e-34 * 299792458)
    out = []
    for column in np.asarray(camera.values).T:
        efficiency = peak * np.interp(wavelength_nm, camera.wavelengths, column, left=0, right=0)
        f = efficiency * sun * reflectance * photons_per_joule
        out.append(((f[1:] + f[:-1]) / 2 * np.diff(wavelength_nm)).sum())
    return np.array(out)


def band_weights(peak: float, nodes: np.ndarray) -> np.ndarray:
    return spectra.electron_weights(lambda nm: spectra.response("nikon_5100", nm, peak), nodes)


def band_electrons(reflectance_at_nodes: np.ndarray, nodes: np.ndarray = NODES) -> np.ndarray:
    return band_weights(0.5, nodes) @ (reflectance_at_nodes * spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0))


# -------------------------------------------------------------------------------------------------------- Sun


def test_the_solar_spectrum_has_the_total_of_the_solar_constant() -> None:
    """Kopp & Lean 2011: 1360.8 ± 0.5 W/m². Below 280 nm lie 6.5 W/m² of TSIS-1 HSRS, from 4000 nm a black body."""
    beyond_nm = np.geomspace(4000, 1e6, 20_000)
    photon_J = spectra.PLANCK_J_S * spectra.LIGHT_SPEED_M_S / (beyond_nm * 1e-9)
    radius = np.sin(spectra.sun_angular_radius_rad(1.0))
    planck = 2 * photon_J * spectra.LIGHT_SPEED_M_S / (beyond_nm * 1e-9) ** 4
    # brightness temperatures of the Sun there, 5000 to 5772 K (effective): 11.1 to 13.3 W/m², so 12.2 ± 1.1
    tail = [
        np.trapezoid(np.pi * planck * radius**2 / np.expm1(photon_J / 1.380649e-23 / t), beyond_nm) * 1e-9
        for t in (5000, 5772)
    ]
    total = np.trapezoid(TABLE_W_M2_NM, TABLE_NM) + 6.5 + np.mean(tail)
    assert total == pytest.approx(1360.8, abs=0.5 + 1.1)


def test_the_solar_table_is_the_published_one() -> None:
    # TSIS-1 HSRS v2, 280 to 2730 nm, whole: 1319.295 W/m²; sampled at 1 nm, with five digits: 1e-4
    published = TABLE_NM <= 2730
    assert np.trapezoid(TABLE_W_M2_NM[published], TABLE_NM[published]) == pytest.approx(1319.295, rel=1e-4)
    # independent: ASTM G173-03, of other instruments. By 100 nm they differ by 2.9 % at most (1200 to 1300 nm).
    g173_nm, g173 = np.array(list(DATA_ASTMG173_ETR.items())).T
    for low in range(300, 1700, 100):
        parts = [
            np.trapezoid(y[(x >= low) & (x <= low + 100)], x[(x >= low) & (x <= low + 100)])
            for x, y in ((TABLE_NM, TABLE_W_M2_NM), (g173_nm, g173))
        ]
        assert parts[0] == pytest.approx(parts[1], rel=0.03)
    np.testing.assert_array_equal(spectra.solar_irradiance_W_m2_nm(TABLE_NM), TABLE_W_M2_NM)
    between = (TABLE_NM[1:] + TABLE_NM[:-1]) / 2  # no row is missing or additional
    np.testing.assert_array_equal(
        spectra.solar_irradiance_W_m2_nm(between), np.interp(between, TABLE_NM, TABLE_W_M2_NM)
    )
    # independent: ASTM E490 averaged by Simpson's rule on samples of its own (W m⁻² µm⁻¹ at 600, 650, 700 nm:
    # 1760, 1582, 1406). Two instruments and the sampling of lines: 3 %.
    red = (TABLE_NM >= 600) & (TABLE_NM <= 700)
    mean = np.trapezoid(TABLE_W_M2_NM[red], TABLE_NM[red]) / 100
    assert mean == pytest.approx((1760 + 4 * 1582 + 1406) / 6 * 1e-3, rel=0.03)


@pytest.mark.parametrize("bands", [2, 3, 8, 17, 31])
def test_bands_together_hold_the_in_band_solar_irradiance(bands: int) -> None:
    nodes = spectra.band_nodes_nm(400, 700, bands)
    step = 300 / (bands - 1)
    width = np.full(bands, step)
    width[[0, -1]] = step / 2  # half a hat at the ends
    total = (width * spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0)).sum()
    inside = (TABLE_NM >= 400) & (TABLE_NM <= 700)
    # from 400 nm on the table has 1 nm steps. What is left is the discrete area of a hat whose node falls
    # between them, against its true width: (1 nm)² / (8 · step) each
    assert total == pytest.approx(np.trapezoid(TABLE_W_M2_NM[inside], TABLE_NM[inside]), rel=2e-4)


def test_inverse_square() -> None:
    wavelength = np.array([300.0, 555.5, 1000.0])
    for law, nm in ((spectra.solar_irradiance_W_m2_nm, wavelength), (spectra.solar_band_irradiance_W_m2_nm, NODES)):
        for distance in (0.5, 1.243, 3.6):
            np.testing.assert_allclose(law(nm, distance) * distance**2, law(nm, 1.0), rtol=1e-15)


@pytest.mark.parametrize(("au", "arcmin"), [(1, 15.99), (1.243, 12.86), (2, 7.99), (3.6, 4.44)])
def test_angular_radius_of_the_sun(au: float, arcmin: float) -> None:
    assert np.degrees(spectra.sun_angular_radius_rad(au)) * 60 == pytest.approx(arcmin, abs=0.005)


def test_constants_are_the_published_ones() -> None:
    assert (spectra.AU_M, spectra.SUN_RADIUS_M) == (149_597_870_700, 695_700_000)
    assert pytest.approx(1.98644586e-25, rel=1e-9) == spectra.PLANCK_J_S * spectra.LIGHT_SPEED_M_S  # CODATA hc


# ----------------------------------------------------------------------------------------------- reflectances


def test_reflectance_of_67p_is_fornasier_2015() -> None:
    nm = np.array([325.0, 480, 535, 649, 700, 743, 882, 989])
    albedo = [0.0316, 0.0554, 0.0589, 0.0677, 0.0720, 0.0766, 0.0780, 0.0820]
    np.testing.assert_array_equal(spectra.reflectance("67p", nm), albedo)
    # halfway between two filters, and beyond both ends
    np.testing.assert_allclose(
        spectra.reflectance("67p", np.array([592.0, 200.0, 2000.0])), [(0.0589 + 0.0677) / 2, 0.0316, 0.0820]
    )


def test_reflectance_from_a_number_and_from_a_table() -> None:
    np.testing.assert_array_equal(spectra.reflectance(0.3, NODES), np.full(8, 0.3))
    table = {"wavelength_nm": (400.0, 500.0), "value": (0.1, 0.3)}
    np.testing.assert_allclose(spectra.reflectance(table, np.array([450.0, 475.0, 900.0])), [0.2, 0.25, 0.3])


# ----------------------------------------------------------------------------------------------- band weights


@given(
    st.integers(2, 16).flatmap(lambda n: st.lists(st.floats(0, 1), min_size=n, max_size=n)),
    st.sampled_from([(400.0, 700.0), (420.0, 680.0), (450.0, 900.0)]),
)
def test_exact_for_reflectances_linear_between_the_nodes(values: list[float], ends: tuple[float, float]) -> None:
    nodes = spectra.band_nodes_nm(*ends, len(values))
    one_nm = np.arange(ends[0], ends[1] + 0.5)
    expected = direct_electrons(np.interp(one_nm, nodes, values), one_nm)
    # the same sum in another order, 300 terms of either sign-free size: 300 · 1.1e-16
    np.testing.assert_allclose(band_electrons(np.array(values), nodes), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("values", [np.linspace(0.2, 1, 8) ** 2, np.arange(8) % 2.0, np.ones(8)])
def test_the_1_nm_grid_is_fine_enough_for_such_reflectances(values: np.ndarray) -> None:
    # QE, sunlight, reflectance and λ are linear between whole nanometres, but where a node falls between two;
    # the trapezium rule then errs by products of their changes over 1 nm: below 1e-4 even for a full zigzag
    fine = np.linspace(400, 700, 30_001)
    expected = direct_electrons(np.interp(fine, NODES, values), fine)
    np.testing.assert_allclose(band_electrons(values), expected, rtol=1e-4)


def test_67p_in_eight_bands_is_within_half_a_percent_of_the_converged_integral() -> None:
    fine = np.linspace(400, 700, 30_001)
    expected = direct_electrons(spectra.reflectance("67p", fine), fine)
    got = band_electrons(spectra.reflectance("67p", NODES))
    np.testing.assert_allclose(got, expected, rtol=5e-3)
    balance = ThreeColourDetector().white_balance
    assert LUMINANCE @ (balance * got) == pytest.approx(LUMINANCE @ (balance * expected), rel=5e-3)
    # and the bands do better than the same nodes with monochromatic weights, which miss the lines of the Sun
    naive = []
    for c in range(3):
        f = spectra.response("nikon_5100", NODES, 0.5)[c] * spectra.solar_irradiance_W_m2_nm(NODES)
        f = f * spectra.reflectance("67p", NODES) * NODES * 1e-9 / (spectra.PLANCK_J_S * spectra.LIGHT_SPEED_M_S)
        naive.append(np.trapezoid(f, NODES))
    assert np.abs(got / expected - 1).max() < np.abs(np.array(naive) / expected - 1).max() / 5


def test_one_band_stands_for_the_visible_range() -> None:
    nodes = spectra.band_nodes_nm(400, 700, 1)
    one_nm = np.arange(400, 701.0)
    expected = direct_electrons(np.full(301, 0.25), one_nm)
    np.testing.assert_allclose(band_electrons(np.array([0.25]), nodes), expected, rtol=1e-12)


# ------------------------------------------------------------------------------------------ response, photons


@pytest.mark.parametrize(
    ("name", "measured"), [("nikon_5100", "Nikon 5100 (NPL)"), ("sigma_sd_merrill", "Sigma SDMerill (NPL)")]
)
def test_response_is_the_published_one(name: str, measured: str) -> None:
    camera = MSDS_CAMERA_SENSITIVITIES_DSLR[measured]
    wavelength = np.arange(300, 1100, 0.5)  # at every row and between: equal only if the tables have the same rows
    for curve, column in zip(spectra.response(name, wavelength, 1.0), np.asarray(camera.values).T, strict=True):
        np.testing.assert_array_equal(
            curve, np.interp(wavelength, np.asarray(camera.wavelengths), column, left=0, right=0)
        )


def test_the_sources_note_names_every_table() -> None:
    folder = resources.data_dir("catalogues")
    note = (folder / "SOURCES.md").read_text(encoding="utf-8")
    tables = [*folder.glob("*.csv"), folder / "stars.npz"]
    assert {f"response_{name}.csv" for name in spectra.RESPONSES} < {path.name for path in tables}
    for path in tables:
        assert f"`{path.name}`" in note
        assert hashlib.sha256(path.read_bytes()).hexdigest() in note


@pytest.mark.parametrize("name", spectra.RESPONSES)
def test_response_is_scaled_to_its_peak_and_ends_with_its_table(name: str) -> None:
    wavelength = np.arange(300, 1100.0)
    curves = spectra.response(name, wavelength, 0.4)
    assert curves.shape == (3, len(wavelength))
    assert curves.min() >= 0
    np.testing.assert_allclose(curves.max(axis=1), 0.4, rtol=0.02)  # a peak may lie between whole nanometres
    assert not curves[:, wavelength < 380].any()
    # R, G, B in the order of their colours: centres of weight from long to short wavelengths
    centre = (curves * wavelength).sum(axis=1) / curves.sum(axis=1)
    assert centre[0] > centre[1] > centre[2]


def test_photons_of_nearly_monochromatic_light() -> None:
    # 2 nm of light about 552.5 nm, 1 W m⁻² nm⁻¹ on a 10 µm pixel for 1 ms: 2e-13 J, at hc/λ = 3.5954e-19 J.
    # The response table has 5 nm steps: the middle of one, so that QE is linear through it
    camera = MSDS_CAMERA_SENSITIVITIES_DSLR["Nikon 5100 (NPL)"]
    at = list(camera.wavelengths).index(550)
    efficiency = 0.5 * (np.asarray(camera.values)[at] + np.asarray(camera.values)[at + 1]) / 2
    photons = 2.0 * 1e-3 * (10e-6) ** 2 / (6.62607015e-34 * 299792458 / 552.5e-9)
    assert photons == pytest.approx(2e-13 / 3.5954e-19, rel=1e-4)
    nodes = np.array([551.5, 552.5, 553.5])
    detector = ThreeColourDetector(width_px=2, height_px=2, pixel_pitch_um=10)
    light = Irradiance(array=np.ones((3, 2, 2), np.float32), wavelength_nm=nodes)
    got = detector.electrons_expected(light, 1e-3)
    # QE changes by up to 4 % a nm (in R), and the Sun's lines weight the halves by 3 %: their product
    np.testing.assert_allclose(got.array, np.broadcast_to(photons * efficiency, (2, 2, 3)), rtol=2e-3)


def test_electrons_scale_with_energy_exposure_area_and_efficiency() -> None:
    np.testing.assert_allclose(band_weights(0.25, NODES), band_weights(0.5, NODES) / 2, rtol=1e-15)
    light = Irradiance(array=np.full((8, 2, 2), 0.01, np.float32), wavelength_nm=NODES)
    base, *others = (
        ThreeColourDetector(pixel_pitch_um=pitch_um).electrons_expected(light, exposure_s).array
        for pitch_um, exposure_s in ((5, 1e-3), (10, 1e-3), (5, 3e-3))
    )
    np.testing.assert_allclose(others, [4 * base, 3 * base], rtol=1e-6)  # float32: 8 products, each to 6e-8
