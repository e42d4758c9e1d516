"""Ground reflectance: Hapke by angles in float64, closed forms, published albedos, and a model from outside."""

from __future__ import annotations

import itertools
import json
import math
from typing import Any, Literal

import numpy as np
import pytest
from pydantic import Field

from vbnfault.core.errors import InputError
from vbnfault.reflectance import DiscReflectance, radiance_factor, registry
from vbnfault.reflectance.hapke import COLUMNS, HAPKE_TABLES, Hapke, geometric_albedo, hapke_at
from vbnfault.scene import config

# w, g, B0, h_s, B_C0, h_c, roughness (deg), K
SETS = {
    "67P, 649 nm, disc-integrated": (0.045, -0.41, 1.97, 0.026, 0.0, 1.0, 15.0, 1.0),
    "67P, Hapke 2002": (0.042, -0.37, 2.5, 0.079, 0.188, 0.017, 15.0, 1.0),
    "67P, Hapke 2012": (0.034, -0.42, 2.25, 0.061, 0.0, 1.0, 28.0, 1.20),
    "bright, smooth": (0.9, 0.3, 1.0, 0.05, 0.5, 0.02, 0.0, 1.3),
    "bright, rough": (0.95, -0.1, 0.6, 0.1, 0.3, 0.05, 40.0, 1.0),
}
# normal, oblique, grazing; opposition below 0.1°; the principal plane on both sides
ANGLES_DEG = (0.0, 0.03, 0.09, 1.0, 10.0, 30.0, 45.0, 60.0, 75.0, 85.0, 88.0, 89.0, 89.5)
AZIMUTHS_DEG = (0.0, 0.05, 1.0, 30.0, 90.0, 135.0, 179.0, 179.95, 180.0)
GRID = np.radians(list(itertools.product(ANGLES_DEG, ANGLES_DEG, AZIMUTHS_DEG)))


# w, g, B0, h_s, roughness → incidence, emission, azimuth (deg) and BRDF · cos i: the `hapke` BSDF of
# eradiate-mitsuba 0.5.0 in scalar_mono_double, whose c = 1 (0) is g < 0 (> 0), b = |g|
ERADIATE = {
    (0.045, -0.41, 1.97, 0.026, 15): """
           10    10    90  8.8373001763e-03
           10    45   135  3.5463750565e-03
           45     1    90  3.0943605197e-03
           45    45    30  7.2712753413e-03
           60     1   179  1.5915808505e-03
           75    85   135  3.4498030809e-04
           85    45   135  1.4255673282e-04
           85    60     1  1.5778182192e-03
         89.5    60  0.05  1.4658659410e-04
    """,
    (0.9, 0.3, 1, 0.05, 0): """
            1    60    90  1.1627722799e-01
           30  89.5  0.05  9.9795074144e-02
           75     1   135  3.1918397834e-02
           85    60   135  2.3531351366e-02
           88    30    30  4.1896333710e-03
         89.5    10    90  1.0714726069e-03
    """,
    (0.034, -0.42, 2.25, 0.061, 28): """
            1    75    30  1.7702939262e-03
           30    88    30  2.6247777501e-03
           60    30    30  2.8861455502e-03
           85    88    30  1.8135479766e-03
         89.5    45    30  4.2367031959e-05
    """,
    (0.95, -0.1, 0.6, 0.1, 40): """
           10    75    90  1.1654046618e-01
           10  89.5     1  1.2946221814e-01
           60     1    90  6.0466733980e-02
           60  89.5    90  5.3919639885e-02
    """,
}


def by_angles(i: float, e: float, psi: float, parameters: tuple[float, ...]) -> float:
    """r of Hapke (1984, 2002, 2012) from incidence, emission and azimuth in radians, one number at a time."""
    w, g, b0, hs, bc0, hc, theta_deg, k = parameters
    # the chord between the two directions: acos of a cosine has no digits left near opposition
    chord2 = (math.sin(i) - math.sin(e) * math.cos(psi)) ** 2 + (math.sin(e) * math.sin(psi)) ** 2
    chord2 += (math.cos(i) - math.cos(e)) ** 2
    alpha = 2 * math.asin(min(1.0, math.sqrt(chord2) / 2))
    p = (1 - g * g) / (1 + 2 * g * math.cos(alpha) + g * g) ** 1.5
    b_sh = b0 / (1 + math.tan(alpha / 2) / hs)
    z = math.tan(alpha / 2) / hc
    b_cb = bc0 * (1 + (-math.expm1(-z) / z if z > 0 else 1.0)) / (2 * (1 + z) ** 2)
    gamma = math.sqrt(1 - w)
    r0 = (1 - gamma) / (1 + gamma)

    def h(x: float) -> float:
        return 1 / (1 - w * x * (r0 + (1 - 2 * r0 * x) / 2 * math.log((1 + x) / x)))

    mu0, mu, s = math.cos(i), math.cos(e), 1.0
    mu0_e, mu_e = mu0, mu
    if theta_deg > 0:
        t = math.tan(math.radians(theta_deg))
        chi = 1 / math.sqrt(1 + math.pi * t * t)

        def e1(x: float) -> float:
            return math.exp(-2 / math.pi / t / math.tan(x)) if x > 0 else 0.0

        def e2(x: float) -> float:
            return math.exp(-1 / math.pi / (t * math.tan(x)) ** 2) if x > 1e-9 else 0.0

        def eta(x: float) -> float:
            return chi * (math.cos(x) + math.sin(x) * t * e2(x) / (2 - e1(x)))

        f = math.exp(-2 * math.tan(psi / 2)) if psi < math.pi - 1e-9 else 0.0
        half2 = math.sin(psi / 2) ** 2
        if i <= e:
            d = 2 - e1(e) - psi / math.pi * e1(i)
            mu0_e = chi * (mu0 + math.sin(i) * t * (math.cos(psi) * e2(e) + half2 * e2(i)) / d)
            mu_e = chi * (mu + math.sin(e) * t * (e2(e) - half2 * e2(i)) / d)
            s = mu_e / eta(e) * mu0 / eta(i) * chi / (1 - f + f * chi * mu0 / eta(i))
        else:
            d = 2 - e1(i) - psi / math.pi * e1(e)
            mu0_e = chi * (mu0 + math.sin(i) * t * (e2(i) - half2 * e2(e)) / d)
            mu_e = chi * (mu + math.sin(e) * t * (math.cos(psi) * e2(i) + half2 * e2(e)) / d)
            s = mu_e / eta(e) * mu0 / eta(i) * chi / (1 - f + f * chi * mu / eta(e))
    seeliger = w / (4 * math.pi) * k * mu0_e / (mu0_e + mu_e)
    return seeliger * (p * (1 + b_sh) + h(mu0_e / k) * h(mu_e / k) - 1) * (1 + b_cb) * s


def model(parameters: tuple[float, ...]) -> Hapke:
    return Hapke(**{name: np.array([float(v)]) for name, v in zip(COLUMNS, parameters, strict=True)})


def directions(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    i, e, psi = angles.T
    light = np.column_stack([np.sin(i), np.zeros_like(i), np.cos(i)])
    return light, np.column_stack([np.sin(e) * np.cos(psi), np.sin(e) * np.sin(psi), np.cos(e)])


@pytest.mark.parametrize("name", SETS)
def test_hapke_in_float64(name: str) -> None:
    expected = np.array([by_angles(*angles, SETS[name]) for angles in GRID])
    got = radiance_factor(model(SETS[name]), *directions(GRID))[0] / np.pi
    # the azimuth comes from vectors: at ψ = π its sine keeps 1e-16 of 1, its half-angle tangent is cut at 3e7
    np.testing.assert_allclose(got, expected, rtol=1e-7)


def test_hapke_against_eradiate() -> None:
    for (w, g, b0, hs, theta), table in ERADIATE.items():
        ground = model((w, g, b0, hs, 0.0, 1.0, theta, 1.0))
        values = np.array(table.split(), dtype=np.float64).reshape(-1, 4)
        got = radiance_factor(ground, *directions(np.radians(values[:, :3])))[0] / np.pi
        assert got == pytest.approx(values[:, 3], rel=1e-8)  # printed with ten digits, angles with six


@pytest.mark.parametrize("name", SETS)
def test_reciprocity(name: str) -> None:
    light, view = directions(GRID)
    there = radiance_factor(model(SETS[name]), light, view)[0] / light[:, 2]
    back = radiance_factor(model(SETS[name]), view, light)[0] / view[:, 2]
    np.testing.assert_allclose(there, back, rtol=1e-7)


def hemispherical_albedo(parameters: tuple[float, ...], incidence_deg: float) -> float:
    """Reflected over incident power: ∫ r cos e dω / cos i by Gauss-Legendre in cos e, trapezoid in azimuth."""
    mu, weight = np.polynomial.legendre.leggauss(96)
    mu, weight = (mu + 1) / 2, weight / 2
    azimuth = (np.arange(128) + 0.5) * 2 * np.pi / 128
    e, psi = (a.ravel() for a in np.meshgrid(np.arccos(mu), azimuth, indexing="ij"))
    light, view = directions(np.column_stack([np.full(e.shape, math.radians(incidence_deg)), e, psi]))
    r = radiance_factor(model(parameters), light, view)[0] / np.pi
    cells = np.repeat(weight * mu, len(azimuth)) * 2 * np.pi / len(azimuth)
    return float(np.sum(r * cells) / math.cos(math.radians(incidence_deg)))


@pytest.mark.parametrize("incidence_deg", [0.0, 45.0, 80.0])
def test_energy_is_conserved_by_isotropic_scatterers(incidence_deg: float) -> None:
    # g = 0, B0 = 0, K = 1, smooth. With the exact H functions the albedo is 1 - γ H(μ0). Hapke's H errs by under
    # 1 % (Hapke 2002): 2 % of an albedo up to 1 through the product of two, 1 % of γ H through the closed form.
    for w in (0.05, 0.5, 0.9, 0.999999):
        albedo = hemispherical_albedo((w, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0), incidence_deg)
        gamma = math.sqrt(1 - w)
        r0, x = (1 - gamma) / (1 + gamma), math.cos(math.radians(incidence_deg))
        h = 1 / (1 - w * x * (r0 + (1 - 2 * r0 * x) / 2 * math.log((1 + x) / x)))
        assert albedo == pytest.approx(1 - gamma * h, abs=0.02)
        assert albedo < 1.005


def test_published_geometric_albedos() -> None:
    # Fornasier et al. 2015, table 3; its parameters have two digits: 1/2 in the last of w = 0.028 is 2 %
    published = {480: 0.0554, 535: 0.0589, 649: 0.0677, 700: 0.0720, 743: 0.0766, 882: 0.0780}
    got = geometric_albedo(hapke_at(np.array([*published], dtype=float)))
    np.testing.assert_allclose(got, [*published.values()], rtol=0.03)
    assert got[2] == pytest.approx(0.0677, rel=0.01)


def test_parameters_by_wavelength() -> None:
    middle = hapke_at(np.array([592.0]))
    assert middle.single_scattering_albedo == pytest.approx([(0.037 + 0.045) / 2])
    assert hapke_at(np.array([200.0])).asymmetry == pytest.approx([-0.35])
    # a set of one wavelength takes its colour from the published albedos of the disc, of three digits
    published = {480: 0.0554, 535: 0.0589, 649: 0.0677, 743: 0.0766, 882: 0.0780, 989: 0.0820}
    for name in ("67p_hapke2002", "67p_hapke2012"):
        albedo = geometric_albedo(hapke_at(np.array([*published], dtype=float), name))
        ratios = np.array([*published.values()]) / published[649]
        np.testing.assert_allclose(albedo / albedo[2], ratios, rtol=0.03)
    assert hapke_at(np.array([649.0]), "67p_hapke2012").porosity_factor == pytest.approx([1.20])
    own = ((500.0, 0.1, -0.3, 1.0, 0.05, 0.0, 1.0, 20.0, 1.0),)
    assert hapke_at(np.array([400.0]), own).roughness_deg == pytest.approx([20.0])
    assert all(len(row) == 1 + len(COLUMNS) for rows in HAPKE_TABLES.values() for row in rows)


def test_disc_functions() -> None:
    light, view = directions(np.radians([[0, 0, 0], [60, 0, 0], [60, 60, 180], [30, 60, 0]]))

    def of(disc: str, slope: float = 0.0) -> np.ndarray:
        return radiance_factor(
            registry()[disc](phase_slope_mag_deg=slope).at(np.array([550.0]), np.array([0.06])),
            light,
            view,
        )[0]

    np.testing.assert_allclose(of("lambert") / 0.06, [1, 0.5, 0.5, math.cos(math.radians(30))], rtol=1e-12)
    c = math.cos(math.radians(30))
    np.testing.assert_allclose(of("lommel_seeliger") / 0.06, [1, 2 * 0.5 / 1.5, 1, 2 * c / (c + 0.5)], rtol=1e-12)
    share = 1 - 0.019 * 60 + 2.42e-4 * 3600 - 1.46e-6 * 216000
    assert of("mcewen")[1] / 0.06 == pytest.approx(share * 2 / 3 + (1 - share) / 2, rel=1e-12)
    # on the equator in mid-phase, γ = α/2, and at the mirror point D = cos(α/2) / cos(γ) = 1; at i = 0, e = 60°,
    # γ = 60° = α: D = cos(30°) cos(π/4) / cos(60°) (Shkuratov et al. 2011)
    at_limb = math.cos(math.radians(30)) * math.cos(math.pi / 4) / 0.5
    np.testing.assert_allclose(of("akimov")[[0, 2]] / 0.06, [1, 1], rtol=1e-9)
    akimov = radiance_factor(
        registry()["akimov"]().at(np.array([550.0]), np.array([1.0])),
        *directions(np.radians([[0, 60, 0], [30, 30, 180]])),
    )[0]
    np.testing.assert_allclose(akimov, [at_limb, 1], rtol=1e-9)
    # 0.047 mag per degree: 60° are 2.82 magnitudes
    np.testing.assert_allclose(of("lambert", 0.047)[:2] / of("lambert")[:2], [1, 10 ** (-0.4 * 2.82)], rtol=1e-9)


# --- the registry -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", registry())
def test_every_model_is_the_same_in_numpy_and_in_the_renderer(name: str) -> None:
    from vbnfault.render.runtime import dr, mi

    ground = registry()[name]().at(np.array([450.0, 650.0]), np.array([0.05, 0.06]))
    light, view = directions(GRID)
    triples = (
        tuple(mi.Float(np.ascontiguousarray(column)) for column in d.astype(np.float32).T) for d in (light, view)
    )
    terms = np.stack(np.broadcast_arrays(*(term.numpy() for term in ground.evaluate(dr, *triples))))
    got = np.pi * np.einsum("tb,tn->bn", ground.weights, terms)
    assert len(terms) == ground.terms
    # float32: see test_hapke_in_the_renderers_float32; the limb of Akimov's function is 3e-4 off at e = 89°
    np.testing.assert_allclose(got, radiance_factor(ground, light, view), rtol=4e-4 if name == "akimov" else 2e-4)
    assert not radiance_factor(ground, [[0.6, 0, -0.8]], [[0, 0, 1]]).any(), "light from below the surface"


@pytest.mark.parametrize("name", registry())
def test_every_model_survives_the_scene_file(name: str) -> None:
    model = registry()[name](dust_contrast=0.16)
    scene = config.parse_scene({"title": "t", "body": {"photometry": model.model_dump()}}, source="t.toml")
    assert scene.body.photometry == model
    assert config.parse_scene(scene.resolved(), source="t.toml").body.photometry == model


class Minnaert(DiscReflectance):
    """Reflect after Minnaert (1941): D = cos(i)^k cos(e)^(k - 1)."""

    model: Literal["powered"] = "powered"
    exponent: float = Field(0.7, ge=0.5, le=1, description="k; 1: as Lambert")

    def disc(self, m: Any, cos_i: Any, cos_e: Any, phase_deg: Any) -> Any:
        bright = m.exp(self.exponent * m.log(m.maximum(cos_i, 1e-9)) + (self.exponent - 1) * m.log(cos_e))
        return m.select(cos_i > 0, bright, 0)


def test_a_model_defined_here_alone_is_a_key_of_the_scene_file() -> None:
    """And it is rendered: `test_light.test_a_plane_has_the_radiance_of_its_model` takes every registered one."""

    def parsed(**table: Any) -> config.Scene:
        return config.parse_scene({"title": "t", "body": {"photometry": table}}, source="t.toml")

    scene = parsed(model="powered", exponent=0.6)
    assert scene.body.photometry == Minnaert(exponent=0.6)
    assert scene.resolved()["body"]["photometry"]["exponent"] == 0.6  # the identity of a store is made of this
    for wrong, sentence in (
        ({"model": "powered", "exponent": 3}, "body.photometry.exponent = 3: must be a number from 0.5 to 1"),
        ({"model": "lambert", "exponent": 0.6}, "exponent = 0.6: is a key of powered, not of model = 'lambert'"),
        ({"model": "powered", "exponant": 0.6}, r"exponant: unknown key \(did you mean exponent\?\)"),
        ({"model": "minnart"}, r"model = 'minnart': must be one of akimov, .*mcewen, .*powered"),
    ):
        with pytest.raises(InputError, match=sentence):
            parsed(**wrong)
    assert "exponent" in json.dumps(config.json_schema({}))
    # every store of an earlier version lists the keys of all models of that time
    assert parsed(model="powered", phase_slope_mag_deg=0.0, parameters="67p_fornasier2015", hapke=None)
