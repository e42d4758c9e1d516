"""Stars: the catalogue, magnitudes to light, the place and the energy of a point spread."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import constants

from vbnfault.core import spectra
from vbnfault.core.frames import J2000_JD, minimal_rotation, rx, ry
from vbnfault.core.quantities import Radiance
from vbnfault.detector import ThreeColourDetector
from vbnfault.lens import ThinLens
from vbnfault.world import sky

NODES_NM = spectra.band_nodes_nm(400.0, 700.0, 8)
WIDTH, HEIGHT, FOCAL_PX = 96, 64, 120.0
FRAME: dict[str, Any] = {
    "intrinsics": np.array([FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2]),
    "width_px": WIDTH,
    "height_px": HEIGHT,
    "wavelength_nm": NODES_NM,
}
AXES = np.eye(3)


def star_radiance(
    catalogue: sky.StarCatalogue, *, J_from_C: Any, intrinsics: Any, width_px: int, height_px: int, **more: Any
) -> sky.StarRadiance:
    frame = sky.SkyFrame(J_from_C=J_from_C, intrinsics=intrinsics, width_px=width_px, height_px=height_px)
    return sky.star_radiance(catalogue, frame, **more)


def hms(hours: float, minutes: float, seconds: float) -> float:
    return 15 * (hours + minutes / 60 + seconds / 3600)


def direction(ra_deg: float, dec_deg: float) -> np.ndarray:
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def at(*places_px: tuple[float, float], magnitude: float = 0.0, colour: float = 0.0) -> sky.StarCatalogue:
    """Equal stars that the frame with J = C shows at these image points."""
    x, y = np.array(places_px, dtype=float).T
    ray = np.stack([(x - WIDTH / 2) / FOCAL_PX, (y - HEIGHT / 2) / FOCAL_PX, np.ones(len(x))], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    zero = np.zeros(len(x))
    return sky.StarCatalogue(
        right_ascension_deg=np.degrees(np.arctan2(ray[:, 1], ray[:, 0])),
        declination_deg=np.degrees(np.arcsin(ray[:, 2])),
        proper_motion_ra_mas_year=zero,
        proper_motion_dec_mas_year=zero,
        magnitude_V=zero + magnitude,
        colour_BV=zero + colour,
    )


def image(stars: sky.StarRadiance) -> np.ndarray:
    """float64[band, y, x] of the frame, black but for the stars."""
    frame = np.zeros((len(NODES_NM), HEIGHT, WIDTH))
    frame[:, stars.rows, stars.columns] = stars.radiance
    return frame


def centroid(light: np.ndarray) -> tuple[float, float]:
    """x and y of the centre of light of an image."""
    y, x = np.indices(light.shape) + 0.5
    return (light * x).sum() / light.sum(), (light * y).sum() / light.sum()


# ------------------------------------------------------------------------------------ catalogue


# Of the 9110 objects of the Bright Star Catalogue, some of them fainter, about 8400 lie above V = 6.5; Hipparcos
# has a few more stars there: 172 with V < 3 and 8789 with V < 6.5.
@pytest.mark.parametrize(("limit", "fewest", "most"), [(1.5, 20, 24), (3.0, 165, 190), (6.5, 8400, 9110)])
def test_counts_by_magnitude(limit: float, fewest: int, most: int) -> None:
    stars = sky.load_catalogue()
    assert fewest <= len(stars.brighter_than(limit)) <= most
    assert len(stars.brighter_than(limit)) == (stars.magnitude_V < limit).sum()
    assert (np.diff(stars.magnitude_V) >= 0).all()
    assert len(stars) == 15_544
    # as many directions at random have a mean of about 1/sqrt(15544) = 0.008; the Milky Way and Gould's belt add
    assert np.linalg.norm(stars.direction_J().mean(axis=0)) < 0.08


@pytest.mark.parametrize(
    ("ra_deg", "dec_deg", "magnitude", "colour"),
    [  # ICRS J2000, SIMBAD (van Leeuwen 2007); V and B-V of ESA 1997
        (hms(6, 45, 8.91728), -(16 + 42 / 60 + 58.0171 / 3600), -1.44, 0.009),
        (hms(18, 36, 56.33635), 38 + 47 / 60 + 1.2802 / 3600, 0.03, -0.001),
        (hms(5, 55, 10.30536), 7 + 24 / 60 + 25.4304 / 3600, 0.45, 1.500),
    ],
    ids=["Sirius", "Vega", "Betelgeuse"],
)
def test_known_stars(ra_deg: float, dec_deg: float, magnitude: float, colour: float) -> None:
    stars = sky.load_catalogue()
    offset = np.linalg.norm(stars.direction_J() - direction(ra_deg, dec_deg), axis=1)
    nearest = int(offset.argmin())
    # the two reductions differ by some mas of position and proper motion over 8.75 years; the step is 1 mas
    assert np.degrees(offset[nearest]) * 3600 < 0.05
    assert stars.magnitude_V[nearest] == pytest.approx(magnitude, abs=0.005)
    assert stars.colour_BV[nearest] == pytest.approx(colour, abs=0.0005)


def test_proper_motion() -> None:
    sirius = sky.load_catalogue().brighter_than(-1.0)
    now, later = sirius.direction_J(), sirius.direction_J(J2000_JD + 36525)
    moved_arcsec = np.degrees(np.arccos((now * later).sum())) * 3600
    assert moved_arcsec == pytest.approx(100 * np.hypot(0.54601, 1.22308), rel=1e-3)
    assert later[0, 2] < now[0, 2]  # southwards
    assert np.linalg.norm(later) == pytest.approx(1, abs=1e-12)


# ------------------------------------------------------------------------------------ magnitudes


@pytest.mark.parametrize("colour", [-0.2, 0.0, 0.65, 1.5])
def test_magnitude_zero_is_the_zero_point(colour: float) -> None:
    fine = np.arange(470.0, 701.0)
    passband = np.interp(fine, sky.PASSBAND_V_NM, sky.PASSBAND_V)
    spectrum = sky.star_spectrum_W_m2_nm(np.array([0.0, 2.5]), np.array([colour, colour]), fine)
    mean = np.trapezoid(spectrum * passband, fine) / np.trapezoid(passband, fine)
    # the passband's own steps of 10 nm against 1 nm: a spectrum's curvature over 10 nm
    np.testing.assert_allclose(mean, [3.631e-11, 3.631e-12], rtol=2e-3)


def test_the_sun_as_a_star() -> None:
    # V = -26.76, B-V = 0.65 (Bessell 1998; Ramírez 2012): the black body against TSIS-1 HSRS; lines apart, which
    # take up to a tenth at 400 nm
    star = sky.star_irradiance_W_m2_nm(-26.76, 0.653, NODES_NM)[0]
    sun = spectra.solar_band_irradiance_W_m2_nm(NODES_NM, 1.0)
    np.testing.assert_allclose(star[1:], sun[1:], rtol=0.07)
    assert star[0] == pytest.approx(sun[0], rel=0.15)


def test_hotter_stars_are_bluer() -> None:
    temperature = sky.colour_temperature_K(np.array([-0.3, 0.0, 0.65, 1.6, 9.0]))
    assert (np.diff(temperature) < 0).all()
    assert temperature[2] == pytest.approx(5778, abs=2)  # Ballesteros 2012: the Sun
    light = sky.star_irradiance_W_m2_nm(np.zeros(3), np.array([-0.3, 0.65, 1.6]), NODES_NM)
    assert (np.diff(light[:, 0] / light[:, -1]) < 0).all()


@pytest.mark.parametrize("off_axis_px", [0.0, 40.0])
def test_electrons_of_a_star_of_magnitude_zero(off_axis_px: float) -> None:
    lens = ThinLens(focal_length_mm=FOCAL_PX * 5.5e-3, f_number=2.8, transmission=0.9)
    detector = ThreeColourDetector(
        width_px=WIDTH, height_px=HEIGHT, pixel_pitch_um=5.5, quantum_efficiency_peak=0.5
    )
    stars = star_radiance(at((WIDTH / 2 + off_axis_px, HEIGHT / 2)), J_from_C=AXES, sigma_px=0.8, **FRAME)
    black = Radiance(array=np.zeros((8, HEIGHT, WIDTH), dtype=np.float32), wavelength_nm=NODES_NM)
    exposed = detector.electrons_expected(lens.image(stars.added_to(black)), 2.0).array
    collected = exposed.sum(axis=(0, 1), dtype=np.float64)

    # by hand: 3.631e-11 W m⁻² nm⁻¹ in the mean over V, a black body of 10125 K (B-V = 0), through the pupil
    nm = np.linspace(400, 700, 3001)

    def planck(wavelength_nm: np.ndarray) -> np.ndarray:
        m = wavelength_nm * 1e-9
        return m**-5 / np.expm1(constants.h * constants.c / (constants.k * 10125.237 * m))

    light = 3.631e-11 * planck(nm) / np.average(planck(sky.PASSBAND_V_NM), weights=sky.PASSBAND_V)
    photons = light * nm * 1e-9 / (constants.h * constants.c)
    area_m2 = np.pi / 4 * (FOCAL_PX * 5.5e-6 / 2.8) ** 2
    cosine = FOCAL_PX / np.hypot(FOCAL_PX, off_axis_px)
    efficiency = spectra.response("nikon_5100", nm, 0.5)
    by_hand = 0.9 * area_m2 * cosine * 2.0 * np.trapezoid(photons * efficiency, nm, axis=1)
    # eight bands follow the ratio to sunlight in straight pieces: 1 %
    np.testing.assert_allclose(collected, by_hand, rtol=0.012)
    assert (by_hand > 100).all()


def test_falloff_of_the_lens_takes_the_same_electrons() -> None:
    star = at((WIDTH - 10.5, 8.5))
    plain = star_radiance(star, J_from_C=AXES, sigma_px=0.5, **FRAME)
    divided = star_radiance(star, J_from_C=AXES, sigma_px=0.5, lens_falloff=True, **FRAME)
    cosine = star.direction_J()[0, 2]
    np.testing.assert_allclose(divided.radiance * cosine**4, plain.radiance, rtol=1e-6)
    # the solid angle of a small pixel: cos³ θ / f²
    irradiance = sky.star_irradiance_W_m2_nm(0.0, 0.0, NODES_NM)[0]
    solid_angle_sr = cosine**3 / FOCAL_PX**2
    np.testing.assert_allclose(divided.radiance.sum(axis=1), irradiance / solid_angle_sr, rtol=2e-6)


# ------------------------------------------------------------------------------------ the point spread


@pytest.mark.parametrize("sigma_px", [0.0, 0.3, 1.0, 3.0])
def test_energy_is_kept(sigma_px: float) -> None:
    stars = at((40.3, 30.9), (52.0, 33.0), (60.7, 21.2))
    total = image(star_radiance(stars, J_from_C=AXES, sigma_px=sigma_px, **FRAME)).sum(axis=(1, 2))
    expected = sky.star_irradiance_W_m2_nm(0.0, 0.0, NODES_NM)[0] * FOCAL_PX**2 * stars.direction_J()[:, 2].sum()
    np.testing.assert_allclose(total, expected, rtol=3e-6)  # 1.2e-6 is cut; float32 rounds by 6e-8 a pixel


def test_a_point_without_spread_lights_one_pixel() -> None:
    stars = star_radiance(at((70.9, 10.1)), J_from_C=AXES, sigma_px=0.0, **FRAME)
    assert (stars.rows.tolist(), stars.columns.tolist()) == ([10], [70])
    assert stars.radiance.shape == (8, 1)


def test_the_edge_of_the_frame_takes_its_part() -> None:
    whole = image(star_radiance(at((30.0, 30.0)), J_from_C=AXES, sigma_px=1.0, **FRAME))
    half = image(star_radiance(at((0.0, 30.0)), J_from_C=AXES, sigma_px=1.0, **FRAME))
    beyond = image(star_radiance(at((-1.0, 30.0)), J_from_C=AXES, sigma_px=1.0, **FRAME))
    cosine = [at((x, 30.0)).direction_J()[0, 2] for x in (30.0, 0.0, -1.0)]
    assert half.sum() / cosine[1] == pytest.approx(0.5 * whole.sum() / cosine[0], rel=1e-5)
    # one sigma beyond the edge 15.866 % of a Gaussian reach in
    assert beyond.sum() / cosine[2] == pytest.approx(0.158655 * whole.sum() / cosine[0], rel=1e-4)
    assert len(star_radiance(at((-6.1, 30.0)), J_from_C=AXES, sigma_px=1.0, **FRAME).rows) == 0


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("place", [(40.5, 30.5), (41.07, 29.81), (44.0, 33.0)])
def test_centroid(sigma_px: float, place: tuple[float, float]) -> None:
    # a Gaussian integrated over pixels errs by exp(-2 pi² sigma²) / pi: 0.0023 px at 0.5, nothing at 1
    light = image(star_radiance(at(place), J_from_C=AXES, sigma_px=sigma_px, **FRAME)).sum(axis=0)
    assert centroid(light) == pytest.approx(place, abs=0.01)
    variance = (light * (np.arange(WIDTH) + 0.5 - place[0]) ** 2).sum() / light.sum()
    assert variance == pytest.approx(sigma_px**2 + 1 / 12, rel=0.03)  # the pixel's own width added


def test_axes_of_the_camera() -> None:
    vega = direction(hms(18, 36, 56.33635), 38.783689)
    catalogue = sky.load_catalogue().brighter_than(0.04)
    J_from_C = minimal_rotation(np.array([0.0, 0.0, 1.0]), vega)
    ahead = image(star_radiance(catalogue, J_from_C=J_from_C, sigma_px=1.0, **FRAME)).sum(axis=0)
    assert np.unravel_index(ahead.argmax(), ahead.shape) in {(31, 47), (31, 48), (32, 47), (32, 48)}
    # turned to the right (+x), the star moves left; turned down (+y), it moves up
    for turn, (row, column) in ((ry(0.1), (HEIGHT / 2, WIDTH / 2 - 12.04)), (rx(-0.1), (HEIGHT / 2 - 12.04, 48))):
        moved = image(star_radiance(catalogue, J_from_C=J_from_C @ turn, sigma_px=1.0, **FRAME)).sum(axis=0)
        assert centroid(moved) == pytest.approx((column, row), abs=0.05)


def test_no_star_behind_the_camera() -> None:
    star = at((20.0, 20.0))
    assert len(star_radiance(star, J_from_C=AXES, sigma_px=1.0, **FRAME).rows) > 0
    behind = star_radiance(star, J_from_C=np.diag([-1.0, -1.0, -1.0]), sigma_px=1.0, **FRAME)
    assert behind.radiance.shape == (8, 0)
    none = star_radiance(star.brighter_than(-9.0), J_from_C=AXES, sigma_px=1.0, **FRAME)
    assert none.radiance.shape == (8, 0)
    assert none.radiance.dtype == np.float32


def test_stars_in_view_share_the_whole_sky() -> None:
    catalogue = sky.load_catalogue()
    views = [rx(0), rx(np.pi / 2), rx(np.pi), rx(-np.pi / 2), ry(np.pi / 2), ry(-np.pi / 2)]
    cube: dict[str, Any] = {**FRAME, "width_px": 64, "intrinsics": np.array([32.0, 32.0, 32.0, 32.0])}
    total = np.zeros(8)
    for view in views:  # six faces of a cube; lens_falloff gives the light per solid angle, cos³ per pixel
        stars = star_radiance(catalogue, J_from_C=view, sigma_px=0.0, lens_falloff=True, **cube)
        slope = np.stack([stars.columns + 0.5 - 32, stars.rows + 0.5 - 32]) / 32
        total += (stars.radiance * (1 + (slope**2).sum(axis=0)) ** -1.5 / 32**2).sum(axis=1)
    light = sky.star_irradiance_W_m2_nm(catalogue.magnitude_V, catalogue.colour_BV, NODES_NM).sum(axis=0)
    np.testing.assert_allclose(total, light, rtol=0.02)  # cos³ of the pixel's centre, not of the star


def test_light_of_near_stars_adds_up() -> None:
    one, other = at((40.2, 30.5)), at((41.1, 30.7))
    both = image(star_radiance(at((40.2, 30.5), (41.1, 30.7)), J_from_C=AXES, sigma_px=1.0, **FRAME))
    apart = [image(star_radiance(star, J_from_C=AXES, sigma_px=1.0, **FRAME)) for star in (one, other)]
    np.testing.assert_allclose(both, apart[0] + apart[1], rtol=1e-5, atol=1e-14)


def test_bodies_hide_stars() -> None:
    stars = at((20.5, 20.5), (22.5, 20.5), (-0.5, 20.5))
    visible = np.ones((HEIGHT, WIDTH), dtype=bool)
    visible[20, 20] = visible[20, 0] = False
    seen = star_radiance(stars, J_from_C=AXES, sigma_px=1.0, sky=visible, **FRAME)
    alone = star_radiance(at((22.5, 20.5), (-0.5, 20.5)), J_from_C=AXES, sigma_px=1.0, **FRAME)
    np.testing.assert_array_equal(image(seen), image(alone))
    assert image(seen)[0, 20, 20] > 0  # the neighbour's light spreads over the body


def test_adding_leaves_the_rest_bit_for_bit() -> None:
    rng = np.random.default_rng(1)
    before = Radiance(array=rng.random((8, HEIGHT, WIDTH), dtype=np.float32), wavelength_nm=NODES_NM)
    stars = star_radiance(at((20.5, 20.5)), J_from_C=AXES, sigma_px=1.0, **FRAME)
    after = stars.added_to(before)
    changed = (after.array != before.array).any(axis=0)
    assert changed.any()
    assert not changed[~image(stars).any(axis=0)].any()
    assert after.array.dtype == np.float32


def test_the_faintest_star_that_an_exposure_shows() -> None:
    lens = ThinLens(focal_length_mm=8.0, f_number=2.8, transmission=0.9)
    detector = ThreeColourDetector(width_px=WIDTH, height_px=HEIGHT)
    focal_px = 8e3 / detector.pixel_pitch_um
    limit: dict[str, Any] = {
        "electron_rate_weights": detector.electron_rate_weights(NODES_NM),
        "wavelength_nm": NODES_NM,
        "irradiance_per_radiance": np.pi * lens.transmission / (4 * lens.f_number**2),
        "focal_length_px": focal_px,
        "sigma_px": 0.7,
        "threshold_e": 13.0,
    }
    faintest = sky.limiting_magnitude(exposure_s=1.0, **limit)
    assert sky.limiting_magnitude(exposure_s=0.01, **limit) == pytest.approx(faintest - 5)
    assert sky.limiting_magnitude(exposure_s=0.0, **limit) == -np.inf
    # a comet by daylight takes 0.1 ms: nothing but noise of the brightest star
    assert sky.limiting_magnitude(exposure_s=1e-4, **limit) < sky.BRIGHTEST_V

    frame = {**FRAME, "intrinsics": np.array([focal_px, focal_px, WIDTH / 2, HEIGHT / 2])}
    star = at((WIDTH / 2 + 0.5, HEIGHT / 2 + 0.5), magnitude=faintest, colour=0.6)
    turned = minimal_rotation(
        np.array([0.5 / focal_px, 0.5 / focal_px, 1.0]) / np.hypot(1, 0.5**0.5 / focal_px), star.direction_J()[0]
    )
    added = star_radiance(star, J_from_C=turned, sigma_px=0.7, **frame)
    black = Radiance(array=np.zeros((8, HEIGHT, WIDTH), dtype=np.float32), wavelength_nm=NODES_NM)
    electrons = detector.electrons_expected(lens.image(added.added_to(black)), 1.0).array
    assert electrons.max() == pytest.approx(13.0, rel=1e-4)


def test_the_stars_cover_the_whole_sky() -> None:
    mean = sky.load_catalogue().direction_J().mean(axis=0)
    # 15544 directions at random have a mean of about 1/sqrt(15544) = 0.008; the Milky Way and Gould's belt add
    assert np.linalg.norm(mean) < 0.08
