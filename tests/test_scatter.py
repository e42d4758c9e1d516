"""Scatter in a lens against closed forms, quadrature, published values and miepython; a baffle against a grid."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import j1

from vbnfault.core.files import resources
from vbnfault.core.spectra import Bands
from vbnfault.lens import Prescription, load_lens, paraxial_properties, parse_lens
from vbnfault.lens.paraxial import gap, mirrors, refraction, system
from vbnfault.lens.rays import forward, transmittance
from vbnfault.lens.straylight import particles, scatter
from vbnfault.lens.straylight.particles import (
    DUST_INDEX,
    particle_bsdf,
    particle_count,
    particle_scatter_fraction,
    scattered_intensity,
)
from vbnfault.lens.straylight.scatter import (
    Cleanliness,
    GlareLayout,
    Harvey,
    VeilingGlare,
    baffle_transmission,
    scattered_fraction,
    veiling_glare,
)

F64 = NDArray[np.float64]
GREEN = Bands.lines(550.0)


def integral(function: Callable[[float], float], low: float, high: float) -> float:
    return float(quad(function, low, high, limit=500, epsabs=0, epsrel=1e-10)[0])


def over_hemisphere(surface: Harvey) -> float:
    """∫ BSDF cos θ dΩ = 2π ∫ BSDF β dβ, by quadrature in ln β."""
    return integral(lambda u: 2 * np.pi * surface.bsdf(np.exp(u)) * np.exp(2 * u), -25, 0)


def image_of(glare: VeilingGlare, xy_mm: tuple[float, float], shape: tuple[int, int], pitch_mm: float) -> Any:
    """The table of a glare on a frame, float32[band, y, x], without cos⁴."""
    return glare.table[:, GlareLayout(glare.efl_mm, xy_mm, shape, pitch_mm).steps]


# --- roughness --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("S", [-0.5, -1.5, -2.0, -2.0 + 1e-9, -2.5, -3.0])
@pytest.mark.parametrize("L", [1e-4, 1e-2, 0.3])
def test_total_scatter_is_the_integral_of_the_bsdf(S: float, L: float) -> None:
    surface = Harvey(b0=0.7, L=L, S=S)
    # the quadrature's own tolerance, with room for its sum
    assert surface.tis == pytest.approx(over_hemisphere(surface), rel=1e-8)
    if S == -2.0:
        assert surface.tis == pytest.approx(np.pi * 0.7 * L**2 * np.log(1 + L**-2), rel=1e-12)
    elif abs(S + 2) > 0.1:
        closed = 2 * np.pi * 0.7 * L**2 / (S + 2) * ((1 + L**-2) ** ((S + 2) / 2) - 1)
        assert surface.tis == pytest.approx(closed, rel=1e-12)


def test_published_total_scatter() -> None:
    """3.3e-5 of a polished surface; 0.015791 of a mirror of 5 nm at 500 nm (FRED's manual, Harvey-Shack)."""
    polished = Harvey.of_roughness(roughness_nm=1.0, index_step=0.5)
    assert polished.tis == pytest.approx(3.3e-5, abs=0.05e-5)
    for S in (-1.0, -2.0, -2.4):
        mirror = Harvey.of_roughness(roughness_nm=5.0, index_step=2.0, wavelength_nm=500.0, L=0.01, S=S)
        assert mirror.tis == pytest.approx(0.015791, abs=5e-7)
        assert over_hemisphere(mirror) == pytest.approx(0.015791, abs=5e-7)


def test_scatter_over_wavelength_is_that_of_one_surface() -> None:
    """TIS = (2π Δn/λ)² σ², σ² the integral of the surface's spectrum up to 1/λ, for every shape of it."""
    step, sigma = 0.5, 1.0
    for S, L in ((-1.5, 0.01), (-2.0, 1e-3), (-3.9, 1e-3)):
        surface = Harvey.of_roughness(roughness_nm=sigma, index_step=step, L=L, S=S)
        corner = L / 550.0  # 1/nm

        def shape(u: float, S: float = S, corner: float = corner) -> float:
            f = np.exp(u)
            return 2 * np.pi * f * f * (1 + (f / corner) ** 2) ** (S / 2)

        power = {nm: integral(shape, -35, -np.log(nm)) for nm in (400.0, 550.0, 900.0)}
        for nm in (400.0, 900.0):
            rms2 = sigma**2 * power[nm] / power[550.0]
            assert surface.at(nm).tis == pytest.approx((2 * np.pi * step / nm) ** 2 * rms2, rel=1e-7)
        widening = surface.at(900.0).L / L
        assert widening == pytest.approx(900 / 550, rel=1e-12)
    # all of a steep spectrum lies below 1/λ but for (L)^1.9 = 2e-6, of a shallow one it grows as (1/λ)^(S+2)
    steep = Harvey.of_roughness(roughness_nm=1.0, index_step=0.5, L=1e-3, S=-3.9)
    assert steep.at(1100.0).tis / steep.tis == pytest.approx(0.25, rel=1e-5)
    shallow = Harvey.of_roughness(roughness_nm=1.0, index_step=0.5, L=1e-4, S=-1.5)
    # the knee's own part is L^0.5 = 1 % of it
    assert shallow.at(1100.0).tis / shallow.tis == pytest.approx(2**-2.5, rel=0.01)


# --- particles --------------------------------------------------------------------------------------------------


def test_counts_of_the_standard() -> None:
    """Level 100 as tabulated by MIL-STD-1246C: 1785, 265, 78.4 and 10.7 above 5, 15, 25 and 50 µm."""
    found = particle_count(100.0, [5.0, 15.0, 25.0, 50.0])
    for ours, table, last_digit in zip(found, [1785, 265, 78.4, 10.7], [1, 1, 0.1, 0.1], strict=True):
        assert ours == pytest.approx(table, abs=0.51 * last_digit)
    assert particle_count(500.0, 100.0) == pytest.approx(1100, abs=0.5)
    for level in (10.0, 300.0, 1000.0):
        assert particle_count(level, level) == pytest.approx(1.0, rel=1e-12)
    assert particle_count(0.0, 5.0) == 0


def test_mie_against_miepython() -> None:
    mie = pytest.importorskip("miepython")
    cosine = np.cos(np.radians([0.0, 0.1, 2.0, 20.0, 80.0, 130.0, 180.0]))
    sizes = [0.05, 1.0, 7.0, 40.0, 90.0]
    ours = scattered_intensity(sizes, cosine)
    for row, x in zip(ours, sizes, strict=True):
        theirs = mie.i_unpolarized(np.conj(DUST_INDEX), x, cosine, norm="wiscombe")
        np.testing.assert_allclose(row, theirs, rtol=1e-9)
    # all directions together: the cross-section, which miepython sums without angles. The intensity is a polynomial
    # of the cosine of degree 2N < 2 × nodes - 1, so that Gauss's rule is exact; 1e-6 is Wiscombe's truncation
    node, weight = np.polynomial.legendre.leggauss(140)
    for row, x in zip(scattered_intensity(sizes, node), sizes, strict=True):
        _, q_scattered, _, _ = mie.efficiencies_mx(np.conj(DUST_INDEX), x)
        assert row @ weight == pytest.approx(q_scattered * x**2 / 2, rel=2e-6)


def test_mie_coefficients_against_miepython() -> None:
    mie = pytest.importorskip("miepython")
    sizes = np.array([1e-2, 0.3, 1.0, 7.9, 8.0, 50.0, 499.0])
    # miepython has the opposite sign of absorption, and errors up to 1.1e-11; those here are below 1e-13, both
    # against Bessel functions of mpmath with 50 digits
    for index in (DUST_INDEX, 1.33 + 0j, 1.6 + 0.3j, 0.75 + 0j):
        for x, *ours in zip(sizes, *particles._coefficients(sizes, index), strict=True):
            for row, expected in zip(ours, mie.coefficients(np.conj(index), float(x)), strict=True):
                np.testing.assert_allclose(row[: len(expected)], expected, rtol=0, atol=2e-11)
                assert (row[len(expected) :] == 0).all()


def test_mie_against_bohren_and_huffman() -> None:
    """Their appendix A: a sphere of radius 0.525 µm and index 1.55 at 0.6328 µm has Q_sca = 3.10543."""
    x = 2 * np.pi * 0.525 / 0.6328
    node, weight = np.polynomial.legendre.leggauss(40)  # exact: the degree is twice the 15 orders
    found = 2 / x**2 * (scattered_intensity(x, node, index=1.55 + 0j)[0] @ weight)
    assert found == pytest.approx(3.10543, abs=5e-6)  # of its last digit


def test_large_spheres_join_small_ones() -> None:
    """Mie's series averaged over sizes of ±15 % against diffraction and rays, at a size parameter of 500."""
    sizes = 500 * np.exp(np.linspace(-0.15, 0.15, 100))
    angle = np.radians([0.01, 0.05, 0.1, 0.15, 0.5, 1.0, 3.0, 10.0, 25.0, 45.0, 70.0, 88.0])
    series = particles._mie(sizes, np.cos(angle), DUST_INDEX) / sizes[:, None] ** 2
    rays = particles._large(sizes, np.cos(angle), DUST_INDEX) / sizes[:, None] ** 2
    ratio = rays.mean(axis=0) / series.mean(axis=0)
    # within the lobe the rays agree to a thousandth, 5e-3 where it is steep; outside, single sizes differ by 35 %
    # as rays interfere: 3.5 % over 100, besides the edge's light, which keeps its phase to the refracted ray's
    np.testing.assert_allclose(ratio[:4], 1, atol=0.005)
    np.testing.assert_allclose(ratio[4:-1], 1, atol=0.08)
    assert 0.75 < ratio[-1] < 1  # towards grazing more than two refractions count


def test_forward_lobe_is_that_of_a_disc() -> None:
    """k²a⁴ [J1(x)/x]², x = k a sin θ, times k²: of an opaque disc; a sphere's is (1 + ka^(-2/3))² higher."""
    ka = 400.0
    angle = np.array([1e-4, 1e-3, 3e-3, 5e-3])
    across = ka * np.sin(angle)
    disc = ka**4 * (j1(across) / across) ** 2
    found = scattered_intensity(ka, np.cos(angle))[0]
    excess = (1 + ka ** (-2 / 3)) ** 2
    # the edge also narrows the lobe: ka grows by half of 1.8 %, which at across = 2 lowers it by 2 %
    np.testing.assert_allclose(found / disc, excess, rtol=0.025)
    dusty = particle_bsdf(1000.0, 550.0, [1e-4, 0.9])
    assert dusty[0] > 1e4 * dusty[1]  # nearly all light goes ahead


def test_particles_scatter_their_cross_section() -> None:
    """A surface of level 30 from miepython alone, by 40 sizes: the share of light scattered into the hemisphere."""
    mie = pytest.importorskip("miepython")
    wavelength = 0.8  # µm
    edges = np.geomspace(1.0, 30.0, 41)
    number = -np.diff(particle_count(30.0, edges)) * 1e-12 / 0.1  # per µm²
    diameter = np.sqrt(edges[1:] * edges[:-1])
    node, weight = np.polynomial.legendre.leggauss(48)
    half, share_weight = (node + 1) / 2, weight / 2
    whole = ahead = 0.0
    for n, d in zip(number, diameter, strict=True):
        x = np.pi * d / wavelength
        _, q, _, _ = mie.efficiencies_mx(np.conj(DUST_INDEX), x)
        # what goes back is smooth, a few hundredths: 48 nodes do
        back = mie.i_unpolarized(np.conj(DUST_INDEX), x, -half, norm="wiscombe") @ share_weight
        section = q * np.pi * d * d / 4
        whole += n * section
        ahead += n * (section - 2 * np.pi * back * (wavelength / (2 * np.pi)) ** 2)
    found = particle_scatter_fraction(30.0, 1e3 * wavelength)
    # ripples of Mie's cross-section, ±5 % in a bin, over some 20 bins that count
    assert found == pytest.approx(ahead, rel=0.02)
    assert 0.9 * whole < found < whole
    # and as ∫ BSDF β dβ; the last 6°, with a mean cosine, have 1 % of the light, a tenth brighter where they begin
    beta = np.geomspace(1e-5, 1, 20001)[:-1]
    around = np.trapezoid(2 * np.pi * beta**2 * particle_bsdf(30.0, 800.0, beta), x=np.log(beta))
    assert around == pytest.approx(found, rel=2e-3)


def test_particles_grow_with_the_level_and_vanish_when_clean() -> None:
    beta = np.array([0.0, 1e-3, 0.1, 0.5, 0.999])
    levels = [particle_bsdf(level, 550.0, beta) for level in (0.0, 100.0, 300.0, 500.0)]
    assert (levels[0] == 0).all()
    for cleaner, dirtier in pairwise(levels):
        assert (dirtier > cleaner).all()
    np.testing.assert_array_equal(particle_bsdf(500.0, 550.0, [1.0, 1.7]), 0)


# --- a lens -----------------------------------------------------------------------------------------------------

STOP: dict[str, Any] = {"stop": True, "thickness_mm": 0.0, "diameter_mm": 10.0}
FRONT: dict[str, Any] = {"radius_mm": 60.0, "thickness_mm": 5.0, "nd": 1.6, "diameter_mm": 30.0}
BACK: dict[str, Any] = {"radius_mm": -60.0, "diameter_mm": 30.0}


def singlet(*before: dict[str, Any]) -> Prescription:
    return parse_lens({"surface": [*before, STOP, FRONT, BACK]}, source="singlet")


@pytest.mark.parametrize("name", ["nikkor_35_f2p8", "heliar_100_f3p5"])
def test_light_scattered_at_a_surface_lands_where_it_is_said_to(name: str) -> None:
    """A ray turned by β at surface j, through the rest of the lens: at r = β f a_j / a_ent on the sensor."""
    lens = load_lens(name)
    figures, index = paraxial_properties(lens), lens.indices()
    last = len(lens.surfaces) - 1
    stretch = scatter._surfaces(lens, 587.5618, scatter.POLISHED).stretch
    for row, found in zip(mirrors(lens), stretch, strict=True):
        rest = system(lens, row + 1, last)
        if row < last:
            rest = rest @ gap(lens.surfaces[row].thickness_mm)
        turned = gap(figures.bfd_mm) @ rest @ [0.0, 1e-3 / index[row + 1]]
        assert abs(turned[0]) == pytest.approx(1e-3 * figures.efl_mm / found, rel=1e-9)
        # and a_j is the height of the marginal ray
        front = system(lens, 0, row - 1)
        if row:
            front = gap(lens.surfaces[row - 1].thickness_mm) @ front
        assert abs(front[0, 0]) == pytest.approx(1 / found, rel=1e-9)


@pytest.mark.parametrize("level", [0.0, 300.0])
@pytest.mark.parametrize("name", resources.packaged("scenes/lenses"))
def test_a_wide_frame_and_what_lies_beyond_have_all_scattered_light(name: str, level: float) -> None:
    """A frame of 150° of every packaged lens, summed over its pixels, and the flux outside it."""
    lens = load_lens(name)
    glare = veiling_glare(lens, GREEN, sun_deg=0.0, cleanliness=Cleanliness(level=level))
    size = 1001
    pitch = 2 * np.tan(np.radians(75)) * glare.efl_mm / size
    image = image_of(glare, (0.0, 0.0), (size, size), pitch)[0].astype(np.float64)
    x = (np.arange(size) - size // 2) * pitch / glare.efl_mm
    cos4 = 1 / (1 + x**2 + x[:, None] ** 2) ** 2
    near = np.hypot(x, x[:, None]) < 0.1
    inner = glare.offset < 0.1 / np.sqrt(1.01)
    # around the source a pixel is wider than the peak: there the profile is integrated
    r = glare.efl_mm * glare.offset[inner]
    flux = np.trapezoid(2 * np.pi * r * r * glare.irradiance[0, inner], x=np.log(r))
    layout = GlareLayout(glare.efl_mm, (0.0, 0.0), (size, size), pitch)
    flux += (image * cos4)[~near].sum() * pitch**2 + glare.beyond_mm2(layout)[0]
    figures = paraxial_properties(lens, 550.0)
    entering = np.pi * figures.entrance_pupil_diameter_mm**2 / 4 * (glare.efl_mm / figures.efl_mm) ** 2
    fraction = scattered_fraction(lens, GREEN, Cleanliness(level=level))[0]
    want = transmittance(lens, forward(lens), 550.0) * entering * fraction / glare.kept_of_single[0]
    # rings of 13 pixels at the border of the two sums: 0.5 %; dust's law beyond 84° has a mean cosine: 0.3 %
    assert flux == pytest.approx(want, rel=0.01)


def test_flux_of_an_image() -> None:
    """S = -4 in closed form: x²/(1+x²) of the light lies within x = r / (L f a_j/a_ent)."""
    lens, L = singlet(), 2e-3
    glare = veiling_glare(lens, Bands.lines(587.5618), sun_deg=0.0, cleanliness=Cleanliness(knee=L, slope=-4.0))
    pitch, size = 0.02, 301
    image = image_of(glare, (0.0, 0.0), (size, size), pitch)[0].astype(np.float64)
    y, x = np.indices(image.shape) - (size - 1) / 2
    within = 2.8
    caught = image[np.hypot(x, y) * pitch < within].sum() * pitch**2
    figures = paraxial_properties(lens)
    # the knee at 587.56 nm; the front surface is at the stop, the back one's beam is narrower
    knee = L * 587.5618 / 550.0 * figures.efl_mm
    narrow = 1 - 5.0 * (1 - 1 / 1.6) / 60.0
    reach = [(within / (knee * a)) ** 2 for a in (1.0, narrow)]
    tis = (2 * np.pi * 0.6 / 550.0) ** 2 * (550.0 / 587.5618) ** 2
    share = transmittance(lens, forward(lens)) * np.pi * 25.0 * tis * sum(q / (1 + q) for q in reach)
    # pixels of a fifth of the knee: the sum over a peak of half-width 0.1 mm errs by under 1e-3, the circle's rim
    # by less; the sines of directions take 1.5 (r/f)², weighted with the light out there: under 1e-3
    assert caught == pytest.approx(share, rel=3e-3)


def test_an_image_is_the_formula_at_every_pixel() -> None:
    """Pixels against Peterson's sum written out, with the directions' sines from unit vectors."""
    lens = load_lens("tessar_50_f2p8")
    sun = np.array([9.0, -4.0])
    f = paraxial_properties(lens).efl_mm
    angle = np.degrees(np.arctan(np.hypot(*sun) / f))
    glare = veiling_glare(lens, Bands.lines(500.0, 700.0), sun_deg=angle, cleanliness=Cleanliness(level=300.0))
    image = image_of(glare, (9.0, -4.0), (40, 60), 0.3)
    assert image.shape == (2, 40, 60)
    assert image.dtype == np.float32
    toward_sun = np.array([*sun, f]) / np.linalg.norm([*sun, f])
    lit = scatter._lit(lens, angle)
    for band, nm in enumerate((500.0, 700.0)):
        figures, index = paraxial_properties(lens, nm), lens.indices(nm)
        na = figures.entrance_pupil_diameter_mm / 2 / figures.efl_mm
        passing = transmittance(lens, forward(lens), nm)
        for row, column in ((0, 0), (39, 59), (10, 50), (20, 30)):
            place = np.array([(column - 29.5) * 0.3, (row - 19.5) * 0.3, f])
            away = np.hypot(*(place / np.linalg.norm(place) - toward_sun)[:2])
            height, slope, expected = 1.0, 0.0, 0.0
            for k, surface in enumerate(lens.surfaces):
                if index[k] != index[k + 1]:
                    harvey = Harvey.of_roughness(roughness_nm=1.0, index_step=index[k + 1] - index[k]).at(nm)
                    bsdf = harvey.bsdf(away / height)
                    if 1.0 in index[k : k + 2]:
                        bsdf = bsdf + particle_bsdf(300.0, nm, away / height)
                    expected += lit[mirrors(lens).index(k)] * bsdf / height**2
                step = refraction(index[k], index[k + 1], surface.curvature_per_mm)
                height, slope = gap(surface.thickness_mm) @ step @ [height, slope]
            expected *= np.pi * na**2 * passing * np.cos(np.radians(angle))
            # a step of the table is 4e-4 in r², half of it to either side, and slopes go to -3 in r; interpolation
            # between offsets 1.4 % apart: (0.014)²/8 × 9
            assert image[band, row, column] == pytest.approx(expected, rel=1e-3)


def test_images_turn_with_the_sun() -> None:
    lens = load_lens("nikkor_35_f2p8")
    on_axis = veiling_glare(lens, GREEN, sun_deg=0.0)
    image = image_of(on_axis, (0.0, 0.0), (65, 65), 0.1)[0]
    for turned in (np.rot90(image), image[::-1], image.T):
        np.testing.assert_allclose(turned, image, rtol=1e-3)  # a step of the table: 4e-4 in r², times slope/2
    assert np.isfinite(image).all()
    assert np.unravel_index(image.argmax(), image.shape) == (32, 32)
    assert (np.diff(image[32, 32:]) < 0).all()
    aside = veiling_glare(lens, Bands.lines(450.0, 550.0), sun_deg=20.0)
    far = paraxial_properties(lens).efl_mm * np.tan(np.radians(20.0))
    right = image_of(aside, (far, 0.0), (33, 33), 0.2)
    assert (np.diff(right[:, 16], axis=1) > 0).all()  # brighter towards +x, where the Sun is
    np.testing.assert_allclose(image_of(aside, (-far, 0.0), (33, 33), 0.2), right[..., ::-1], rtol=1e-3)
    below = image_of(aside, (0.0, far), (33, 33), 0.2)
    np.testing.assert_allclose(below, np.swapaxes(right, 1, 2), rtol=1e-3)
    assert (right[0] > right[1]).all()  # bluer


def test_light_past_a_rim_in_front() -> None:
    """A window whose rim stands 20 mm before the stop lights what two discs have in common."""
    window = {"radius_mm": np.inf, "thickness_mm": 0.0, "nd": 1.5, "diameter_mm": 12.0}
    behind = {"radius_mm": np.inf, "thickness_mm": 20.0, "diameter_mm": 12.0}
    lens = singlet(window, behind)
    for angle in (0.0, 5.0, 15.0, 25.0, 40.0):
        expected = baffle_transmission(
            angle, length_mm=20.0, radius_mm=6.0, entrance_radius_mm=5.0, vane_attenuation=0.0
        )
        # 65 points across: their rim errs by 1 / (2 × 65), times the share of it that counts
        lit = scatter._lit(lens, angle)
        np.testing.assert_allclose(lit[2:], expected, atol=0.008)
        # the window's own beam, as the field's middle sees it, is all lit
        np.testing.assert_array_equal(lit[:2], 1)
    assert (scatter._lit(load_lens("biotar_100_f1p4"), 0.0) == 1).all()


# --- a baffle ---------------------------------------------------------------------------------------------------


def test_a_baffle_against_a_grid() -> None:
    side = (np.arange(1201) + 0.5) / 1201 * 2 - 1
    x, y = np.meshgrid(10.0 * side, 10.0 * side)
    entrance = np.hypot(x, y) < 10.0
    angles = np.array([0.0, 2.0, 5.0, 8.0, 12.0, 15.0, 20.0])
    found = baffle_transmission(angles, length_mm=80.0, radius_mm=13.0, entrance_radius_mm=10.0)
    for angle, share in zip(angles, found, strict=True):
        through = np.hypot(x - 80.0 * np.tan(np.radians(angle)), y) < 13.0
        # cells of 0.017 mm on rims of some 60 mm, their errors random: 60 × 0.017 / √3600 = 0.02 of 314 mm²
        assert max(share, 1e-6) == pytest.approx((entrance & through).sum() / entrance.sum(), abs=1e-4)
    assert found[0] == 1
    assert found[-1] == 1e-6
    bare = baffle_transmission(
        [20.0, 90.0], length_mm=80.0, radius_mm=13.0, entrance_radius_mm=10.0, vane_attenuation=0.0
    )
    np.testing.assert_array_equal(bare, 0)


def test_a_baffle_only_shades() -> None:
    angles = np.linspace(0, 180, 721)
    for radius in (10.0, 10.001, 30.0):
        share = baffle_transmission(
            angles, length_mm=50.0, radius_mm=radius, entrance_radius_mm=10.0, vane_attenuation=1e-9
        )
        assert (np.diff(share) <= 0).all()
        assert share.min() == 1e-9
        assert share[0] == pytest.approx(1.0, rel=1e-12)
    assert (baffle_transmission(angles, entrance_radius_mm=10.0) == 1).all()
    # equal discs: (2/π)(arccos q - q √(1-q²)), q = length tan θ / 2a
    q = 50.0 * np.tan(np.radians(10.0)) / 20.0
    lens_shaped = 2 / np.pi * (np.arccos(q) - q * np.sqrt(1 - q * q))
    equal = baffle_transmission(10.0, length_mm=50.0, radius_mm=10.0, entrance_radius_mm=10.0)
    assert equal == pytest.approx(lens_shaped, rel=1e-9)


@pytest.mark.parametrize("name", ["nikkor_28_f2p8", "heliar_100_f3p5"])
def test_all_scattered_flux_arrives(name: str) -> None:
    """∫ E dA over the sensor's plane = T Σ TIS × what enters, for any BSDF that ends at β = 1."""
    lens, wavelength = load_lens(name), [450.0, 800.0]
    glare = veiling_glare(
        lens,
        Bands.lines(*wavelength),
        sun_deg=0.0,
        cleanliness=Cleanliness(roughness_nm=2.0, level=200.0, knee=3e-3, slope=-2.2),
    )
    r = glare.efl_mm * glare.offset
    for row, total, nm in zip(glare.irradiance, glare.glare_total_fraction, wavelength, strict=True):
        figures = paraxial_properties(lens, nm)
        flux = np.trapezoid(2 * np.pi * r * r * row, x=np.log(r))
        # f on the sensor is that of the d line, the beam's is its own
        entering = np.pi * figures.entrance_pupil_diameter_mm**2 / 4 * (glare.efl_mm / figures.efl_mm) ** 2
        # steps of 1.4 % of r: 1e-4 by the trapezoidal rule; half a step at the edge that the surfaces share, where
        # 10 to 20 % of the light per e-fold remains: 7e-4 to 1.4e-3
        assert flux == pytest.approx(transmittance(lens, forward(lens), nm) * total * entering, rel=1.5e-3)
    surfaces = [Harvey.of_roughness(roughness_nm=1.0, index_step=s) for s in np.diff(lens.indices(550.0))]
    clean = veiling_glare(lens, GREEN, sun_deg=0.0)
    assert clean.glare_total_fraction[0] == pytest.approx(sum(s.tis for s in surfaces), rel=1e-9)


def test_the_table_of_dust_is_the_same_from_disk() -> None:
    """The table that the process keeps equals the one read from disk and, at some sizes, the one computed."""
    edges, angles, kept = particles._intensities()
    particles._intensities.cache_clear()
    read = particles._intensities()[2]
    assert read is not kept
    np.testing.assert_array_equal(read, kept)
    assert not read.flags.writeable
    some = slice(0, None, 200)
    middle = np.sqrt(edges[1:] * edges[:-1])[some]
    # a matrix product of other rows may be summed in another order
    np.testing.assert_allclose(particles.scattered_intensity(middle, np.cos(angles)), kept[some], rtol=1e-9)
