"""Prescriptions, glass and coatings against published values, closed forms and the package tmm."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lens_kit import paraxial_ghosts

from vbnfault.core.errors import InputError
from vbnfault.core.files import resources, toml_files
from vbnfault.faults.degradation_lens import worn
from vbnfault.lens import load_lens, paraxial_properties, parse_lens, scaled_to_field, scaled_to_focal_length
from vbnfault.lens import rays as trace_module
from vbnfault.lens.adapt import relative
from vbnfault.lens.coating import NAMES, Layer, design, mean_reflectance, reflect_transmit
from vbnfault.lens.glass import AIR, D_NM, GLASSES, from_abbe
from vbnfault.lens.paraxial import along, gap, refraction, system
from vbnfault.lens.prescription import Surface
from vbnfault.lens.prescription_file import to_table, write_lens
from vbnfault.lens.rays import axial_transmittance, ghost, real_pupil_diameter_mm, trace, transmittance
from vbnfault.lens.straylight.bundles import routes

# (EFL, BFD, f-number by the paraxial pupil), the patents' rows recomputed
PUBLISHED = {
    "nikkor_35_f2p8": (36.00, 38.65, 2.72),
    "nikkor_28_f2p8": (28.60, 38.09, 2.76),
    "distagon_25_f2p8": (25.00, 37.19, 2.68),
    "tessar_50_f2p8": (49.94, 40.27, 2.74),
    "heliar_100_f3p5": (100.6, 82.6, 3.49),
    "biotar_100_f1p4": (99.91, 65.33, 1.437),
}


def test_every_published_lens_is_packaged() -> None:
    assert set(PUBLISHED) <= set(resources.packaged("scenes/lenses"))


@pytest.mark.parametrize("name", PUBLISHED)
def test_paraxial_properties(name: str) -> None:
    lens = load_lens(name)
    found = paraxial_properties(lens)
    efl, bfd, f_number = PUBLISHED[name]
    # the published figures are rounded to their last digit
    assert found.efl_mm == pytest.approx(efl, abs=0.006 if efl < 100 else 0.06)
    assert found.bfd_mm == pytest.approx(bfd, abs=0.006 if bfd != 82.6 else 0.06)
    assert found.f_number == pytest.approx(f_number, abs=0.006)
    # a ray along the axis's direction through the entrance pupil's rim meets the rim of the stop
    front = system(lens, 0, lens.stop - 1)
    front = gap(lens.surfaces[lens.stop - 1].thickness_mm) @ front
    rim, _ = front @ [found.entrance_pupil_diameter_mm / 2, 0.0]
    assert rim == pytest.approx(lens.surfaces[lens.stop].semi_diameter_mm, rel=1e-12)
    # a ray to the middle of the entrance pupil leaves from the middle of the exit pupil
    whole = system(lens, 0, len(lens.surfaces) - 1)
    height, slope = whole @ [-found.entrance_pupil_mm * 0.1, 0.1]
    assert height + slope * found.exit_pupil_mm == pytest.approx(0.0, abs=1e-9)


def test_a_thick_lens_and_two_thin_ones() -> None:
    """Closed forms: the lensmaker's equation with thickness; two lenses a distance apart."""
    n, r1, r2, d = 1.5, 50.0, -80.0, 6.0
    lens = parse_lens(
        {
            "surface": [
                {"stop": True, "diameter_mm": 10.0, "thickness_mm": 0.0},
                {"radius_mm": r1, "thickness_mm": d, "nd": n, "diameter_mm": 12.0},
                {"radius_mm": r2, "diameter_mm": 12.0},
            ]
        },
        source="thick",
    )
    power = (n - 1) * (1 / r1 - 1 / r2 + (n - 1) * d / (n * r1 * r2))
    found = paraxial_properties(lens)
    assert found.efl_mm == pytest.approx(1 / power, rel=1e-12)
    assert found.bfd_mm == pytest.approx((1 - (n - 1) * d / (n * r1)) / power, rel=1e-12)
    assert found.entrance_pupil_mm == pytest.approx(0.0, abs=1e-12)
    assert found.f_number == pytest.approx(found.efl_mm / 10.0, rel=1e-12)
    np.testing.assert_allclose(refraction(1.0, 1.5, 0.02) @ [1.0, 0.0], [1.0, -0.5 * 0.02 / 1.5])


def test_scaling() -> None:
    lens = load_lens("nikkor_35_f2p8")
    scaled = scaled_to_focal_length(lens, 7.9)
    assert paraxial_properties(scaled).efl_mm == pytest.approx(7.9, rel=1e-12)
    assert paraxial_properties(scaled).f_number == pytest.approx(paraxial_properties(lens).f_number, rel=1e-12)
    wide = scaled_to_field(lens, 65.0, 10.0)
    assert math.degrees(2 * math.atan(5.0 / paraxial_properties(wide).efl_mm)) == pytest.approx(65.0, rel=1e-9)
    glass = GLASS | {"conic": -1.0, "aspheric_mm": [1e-5, -2e-8]}
    conic = parse_lens({"surface": [STOP, glass, BACK]}, source="asphere")
    heights = np.array([0.0, 1.0, 4.0])
    np.testing.assert_allclose(
        conic.scaled(3.0).surfaces[1].sag_mm(3 * heights), 3 * conic.surfaces[1].sag_mm(heights), rtol=1e-12
    )
    np.testing.assert_allclose(
        conic.surfaces[1].sag_mm(heights), heights**2 / 100 + 1e-5 * heights**4 - 2e-8 * heights**6, rtol=1e-12
    )


# --- glass ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "nd", "vd"),
    [
        ("N-BK7", 1.5168, 64.17),
        ("F2", 1.62004, 36.37),
        ("SF6", 1.80518, 25.43),
        ("silica", 1.45846, 67.82),
        ("BK7G18", 1.519747, 63.65),
    ],
)
def test_catalogued_glasses_have_their_published_index(name: str, nd: float, vd: float) -> None:
    assert GLASSES[name].nd == pytest.approx(nd, abs=6e-6)
    assert GLASSES[name].vd == pytest.approx(vd, abs=0.006)


def test_a_glass_from_its_abbe_number() -> None:
    glass = from_abbe(1.6516, 58.5)
    assert glass.nd == pytest.approx(1.6516, rel=1e-12)
    assert glass.vd == pytest.approx(58.5, rel=1e-9)
    assert float(from_abbe(1.7, None).index(400.0)) == 1.7


# --- coatings ---------------------------------------------------------------------------------------------------

BK7 = 1.5185  # at 550 nm


def test_coatings_against_tmm() -> None:
    tmm = pytest.importorskip("tmm", reason="tmm (of the extra 'test') is not installed")
    stacks = [design(name, BK7) for name in NAMES] + [
        (Layer(n=1.46, k=0.02, thickness_nm=310.0), Layer(n=0.06, k=3.6, thickness_nm=12.0)),  # with a metal
    ]
    for layers in stacks:
        for front, back in ((1.0, BK7), (BK7, 1.0), (1.33, 1.8)):
            most = math.degrees(math.asin(min(1.0, back / front)))
            for angle in np.radians([0.0, 20.0, 0.95 * most]):
                for wavelength in (400.0, 550.0, 871.0):
                    ours = reflect_transmit(layers, front, back, np.cos(angle), wavelength)
                    n = [front, *(f.n + 1j * f.k for f in layers), back]
                    d = [np.inf, *(f.thickness_nm for f in layers), np.inf]
                    theirs = [tmm.coh_tmm(p, n, d, angle, wavelength) for p in "sp"]
                    expected = [t[key] for key in ("R", "T") for t in theirs]
                    np.testing.assert_allclose([float(v) for v in ours], expected, atol=1e-9)


def test_a_film_that_absorbs_dims_the_image_and_reflects_otherwise_from_behind() -> None:
    """A neutral filter of 20 nm of metal on a plane plate, by the package tmm."""
    tmm = pytest.importorskip("tmm", reason="tmm (of the extra 'test') is not installed")
    metal = {"n": 3.2, "k": 3.3, "thickness_nm": 20.0}
    plate = {"radius_mm": math.inf, "thickness_mm": 2.0, "diameter_mm": 20.0}
    lens = parse_lens({"surface": [STOP, plate | {"nd": 1.5, "coating": [metal]}, plate, GLASS, BACK]}, source="nd")
    stack = [1.0, 3.2 + 3.3j, 1.5], [np.inf, 20.0, np.inf]
    into, behind = (tmm.coh_tmm("s", n, d, 0, D_NM) for n, d in (stack, (stack[0][::-1], stack[1])))
    bare = 0.04
    assert axial_transmittance(lens, [D_NM]) == pytest.approx([into["T"] * (1 - bare) ** 3], rel=1e-9)
    ghost_of_plate = transmittance(lens, ghost(lens, 1, 2), D_NM)
    assert ghost_of_plate == pytest.approx(into["T"] * bare * behind["R"] * (1 - bare) ** 3, rel=1e-9)
    assert worn(lens, np.array([D_NM]), 0.5) == pytest.approx([(into["T"] + 1 - bare) / (2 * into["T"])], rel=1e-9)


def test_published_reflectances() -> None:
    """Per cent on N-BK7, non-dispersive; V: 125.9 and 19.4 nm; at 45° and 550 nm 2.09 for magnesium fluoride."""
    wavelength = np.array([450.0, 550.0, 650.0, 700.0])
    got = {name: 100 * mean_reflectance(design(name, 1.5168), 1.0, 1.5168, 1.0, wavelength) for name in NAMES}
    assert got["none"][0] == pytest.approx(4.22, abs=0.01)
    np.testing.assert_allclose(got["mgf2"], [1.63, 1.28, 1.46, 1.61], atol=0.03)
    np.testing.assert_allclose(got["v"], [2.60, 0.00, 0.93, 1.62], atol=0.05)
    thick, thin = design("v", 1.5168)
    assert (thick.thickness_nm, thin.thickness_nm) == pytest.approx((125.9, 19.4), abs=0.1)
    tilted = 100 * mean_reflectance(design("mgf2", 1.5168), 1.0, 1.5168, np.sqrt(0.5), 550.0)
    assert tilted == pytest.approx(2.09, abs=0.03)
    for index in (1.5168, 1.65, 1.805, 1.9):  # designed for the glass
        broad = 100 * mean_reflectance(design("bbar", index), 1.0, index, 1.0, np.linspace(430, 670, 25))
        assert broad.mean() < 0.5
        assert 100 * mean_reflectance(design("v", index), 1.0, index, 1.0, 550.0) < 0.05


def test_energy_is_conserved_and_both_ways_alike() -> None:
    cosines = np.cos(np.radians([0.0, 30.0, 60.0, 85.0]))
    wavelength = np.array([[400.0], [700.0]])
    for name in NAMES:
        layers = design(name, BK7)
        rs, rp, ts, tp = reflect_transmit(layers, 1.0, BK7, cosines, wavelength)
        np.testing.assert_allclose(rs + ts, 1, atol=1e-12)
        np.testing.assert_allclose(rp + tp, 1, atol=1e-12)
        inside = np.sqrt(1 - (1 - cosines**2) / BK7**2)
        back = reflect_transmit(layers[::-1], BK7, 1.0, inside, wavelength)
        np.testing.assert_allclose(back[0], rs, atol=1e-10)
        np.testing.assert_allclose(back[3], tp, atol=1e-10)


def test_a_coating_faces_the_air() -> None:
    lens = parse_lens({"surface": [STOP, GLASS | {"coating": "v"}, BACK | {"coating": "v"}]}, source="coated")
    front, back = (surface.coating for surface in lens.surfaces[1:])
    assert front == back[::-1]
    assert front[0].n == 1.38


# --- bad input --------------------------------------------------------------------------------------------------

GLASS: dict[str, Any] = {"radius_mm": 50.0, "thickness_mm": 4.0, "nd": 1.5, "vd": 60.0, "diameter_mm": 20.0}
GLASS |= {"stop": False}
BACK: dict[str, Any] = {"radius_mm": -50.0, "diameter_mm": 20.0}
STOP: dict[str, Any] = {"stop": True, "thickness_mm": 1.0, "diameter_mm": 10.0}


def lens_of(*rows: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"surface": list(rows), **more}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, ["surface: is missing"]),
        ({"surface": []}, ["surface = []", "at least 1"]),
        (lens_of(GLASS, BACK), ["stop", "none has"]),
        (lens_of(STOP, GLASS, BACK | {"thickness_mm": 1.0}, STOP), ["stop", "surfaces 0, 3"]),
        (lens_of(STOP, GLASS | {"radius_mm": 9.0}, BACK), ["surface[1]", "diameter_mm = 20", "radius_mm = 9"]),
        (
            lens_of(STOP, GLASS | {"thickness_mm": -1.0}, BACK),
            ["surface[1]", "thickness_mm = -1.0", "0 to 1000000"],
        ),
        (lens_of(STOP, GLASS | {"thickness_mm": 0.5}, BACK), ["surface[1]", "thickness_mm = 0.5", "cross"]),
        (
            lens_of(STOP, GLASS | {"coating": [{"n": 1.2, "k": 7.0, "thickness_nm": 6000.0}]}, BACK),
            ["surface[1].coating: transmits 0 of", "must be at least 1e-09"],
        ),
        (lens_of(STOP, GLASS | {"nd": 0.9}, BACK), ["surface[1]", "nd = 0.9", "from 1 to 5"]),
        (lens_of(STOP, GLASS | {"coating": "gold"}, BACK), ["surface[1]", "'gold'", "mgf2"]),
        (lens_of(STOP, GLASS | {"coating": [{"n": 1.4}]}, BACK), ["coating[0]", "thickness_nm", "missing"]),
        (lens_of(STOP, {**GLASS, "glass": "X9"}, BACK), ["surface[1]", "either glass or nd"]),
        (lens_of(STOP, {k: v for k, v in GLASS.items() if k[1] != "d"} | {"glass": "X9"}, BACK), ["'X9'", "N-BK7"]),
        (lens_of(STOP, GLASS, BACK | {"nd": 1.5}), ["surface[2]", "air"]),
        (lens_of(STOP, GLASS | {"radius": 3.0}, BACK), ["surface[1]", "radius", "unknown key"]),
        (lens_of(STOP, GLASS | {"radius_mm": True}, BACK), ["surface[1].radius_mm = True: must be a number"]),
        (lens_of(STOP, GLASS | {"radius_mm": 0.0}, BACK), ["radius_mm = 0", "inf"]),
        (lens_of(STOP, GLASS | {"radius_mm": 1e-308}, BACK), ["radius_mm = 1e-308", "from 1e-09", "inf"]),
        (lens_of(STOP, GLASS | {"conic": 80.0}, BACK), ["diameter_mm = 20", "conic = 80", "at most 11.1111"]),
        (
            lens_of(STOP, GLASS | {"aspheric_mm": [0.0] * 400}, BACK),
            ["aspheric_mm", "a list of at most 20"],
        ),
        (lens_of(STOP, GLASS, BACK, surfaces=[]), ["surfaces", "unknown key"]),
    ],
)
def test_bad_prescriptions_are_told_in_a_sentence(table: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(InputError) as told:
        parse_lens(table, source="x.toml")
    sentence = str(told.value)
    assert sentence.startswith("x.toml: ")
    assert "\n" not in sentence
    assert all(word in sentence for word in words), sentence


def test_a_lens_that_does_not_focus(tmp_path: Path) -> None:
    diverging = parse_lens(
        lens_of(STOP, GLASS | {"radius_mm": -50.0}, BACK | {"radius_mm": 50.0}), source="diverging"
    )
    with pytest.raises(InputError, match=r"no ray reaches the sensor"):
        paraxial_properties(diverging)
    window = parse_lens(
        lens_of(STOP, GLASS | {"radius_mm": math.inf}, BACK | {"radius_mm": math.inf}), source="window"
    )
    with pytest.raises(InputError, match="afocal"):
        paraxial_properties(window)
    path = tmp_path / "window.toml"
    write_lens(window, path)
    with pytest.raises(InputError, match=r"window\.toml: window: surface 0 to 2: .* afocal"):
        load_lens(path)  # so that a scene whose fault has such a lens is refused before anything is rendered
    path = tmp_path / "broken.toml"
    path.write_text("surface = ")
    with pytest.raises(InputError, match=r"broken\.toml: not a TOML file"):
        load_lens(path)
    with pytest.raises(InputError, match="nikkor_35_f2p8"):
        load_lens("no_such_lens")


# --- exact rays -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "f_number"),
    [
        ("nikkor_35_f2p8", 2.80),
        ("nikkor_28_f2p8", 2.86),
        ("distagon_25_f2p8", 2.80),
        ("tessar_50_f2p8", 2.80),
        ("heliar_100_f3p5", 3.54),
        ("biotar_100_f1p4", 1.405),
    ],
)
def test_f_numbers_of_real_rays(name: str, f_number: float) -> None:
    lens = load_lens(name)
    assert paraxial_properties(lens).efl_mm / real_pupil_diameter_mm(lens) == pytest.approx(f_number, abs=0.006)


def test_exact_rays_near_the_axis_are_paraxial() -> None:
    for name in PUBLISHED:
        lens = load_lens(name)
        theta, height = 1e-4, 1e-3
        found = paraxial_properties(lens)
        rays = trace(lens, [[height, 0.0, 0.0], [0.0, -height, 0.0]], [[np.tan(theta), 0.0, 1.0], [0.0, 0.0, 1.0]])
        # third order: a millionth of these heights and slopes, over a few of the lens's radii
        assert rays.points_mm[-1, 0, 0] == pytest.approx(found.efl_mm * np.tan(theta), rel=1e-6)
        assert np.hypot(*rays.points_mm[-1, 1, :2]) < 1e-8
        assert rays.arrives.all()


# the AF Nikkor's pairs of rows → M00 and M01
GHOSTS = {
    (0, 1): (-0.70089, 26.5483),
    (1, 3): (5.35157, 46.674),
    (2, 5): (4.27177, 95.588),
    (8, 13): (-3.11568, -26.0005),
    (10, 12): (0.17949, 32.572),
    (3, 9): (-17.4788, -495.97),
}


def test_ghosts_near_the_axis_are_the_published_matrices() -> None:
    """Spot values of Lee & Eisemann's matrix for the AF Nikkor: 0-based rows, M00 and M01."""
    lens = load_lens("nikkor_28_f2p8")
    tiny = 1e-6
    for (a, b), (m00, m01) in GHOSTS.items():
        rays = trace(lens, [[tiny, 0, 0], [0, 0, 0]], [[0, 0, 1], [tiny, 0, 1]], path=ghost(lens, a, b))
        np.testing.assert_allclose(rays.points_mm[-1, :, 0] / tiny, [m00, m01], rtol=2e-5)


def test_a_paraboloid_focuses_every_ray_and_an_asphere_is_met() -> None:
    """A concave paraboloidal mirror met twice would be a telescope: its rays cross the axis at half its radius."""
    mirror = Surface(radius_mm=-200.0, thickness_mm=0.0, medium=AIR, semi_diameter_mm=60.0, conic=-1.0)
    rays = np.array([[20.0, 0.0, -1.0], [0.0, 55.0, -1.0], [-10.0, 30.0, -1.0]])

    def meet(surface: Surface, directions: Any) -> tuple[Any, Any]:
        """Points and normals, [ray, 3]; the function holds vectors by component."""
        return tuple(v.T for v in trace_module._meet(surface, rays.T.copy(), directions.T.copy()))

    hit, normal = meet(mirror, np.tile([0.0, 0.0, 1.0], (3, 1)))
    incoming = np.array([0.0, 0.0, 1.0])
    out = incoming - 2 * (normal @ incoming)[:, None] * normal
    crossing = hit[:, 2] - out[:, 2] * (hit * out)[:, :2].sum(axis=1) / (out[:, :2] ** 2).sum(axis=1)
    np.testing.assert_allclose(crossing, -100.0, rtol=1e-12)
    bent = replace(mirror, conic=0.4, aspheric_mm=(1e-6, -3e-10))
    direction = np.tile([0.05, -0.02, 0.9], (3, 1))
    hit, normal = meet(bent, direction / np.linalg.norm(direction, axis=1, keepdims=True))
    np.testing.assert_allclose(hit[:, 2], bent.sag_mm(np.hypot(hit[:, 0], hit[:, 1])), atol=1e-12)
    step = 1e-4
    for axis in (0, 1):  # the normal is across the surface: a step along it stays on the surface to second order
        beside = hit.copy()
        beside[:, axis] += step
        rise = bent.sag_mm(np.hypot(beside[:, 0], beside[:, 1])) - hit[:, 2]
        np.testing.assert_allclose(normal[:, axis] * step + normal[:, 2] * rise, 0, atol=1e-9)


def test_rims_lose_rays() -> None:
    """The stop loses a ray that meets every surface, 7 mm off the axis of a beam with a radius of 6.4 mm."""
    lens = load_lens("nikkor_35_f2p8")
    heights = [[x, 0, -5] for x in (0, 6.0, 7.0, 14.0, 20.0)]
    found = trace(lens, heights, np.tile([0.0, 0, 1], (5, 1)))
    assert found.arrives.tolist() == [True, True, False, False, False]
    assert 1 < found.relative_radius[2] < 1.2
    assert np.isinf(found.relative_radius[4])


# --- the command ------------------------------------------------------------------------------------------------


def test_the_command_draws_and_tabulates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import cv2
    from test_cli import run

    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "lens", "tessar_50_f2p8", "--json", tmp_path / "t.json") == 0
    assert "efl_mm" in capsys.readouterr().out
    table = json.loads((tmp_path / "t.json").read_text())
    assert table["bfd_mm"] == pytest.approx(40.27, abs=0.006)
    picture = cv2.imread("tessar_50_f2p8.png")
    blue = (picture == (242, 227, 207)).all(axis=2)  # glass
    assert 0.005 < blue.mean() < 0.3
    assert run(monkeypatch, "lens", "no_such_lens") == 2
    assert "biotar_100_f1p4" in capsys.readouterr().err
    assert run(monkeypatch, "lens", "tessar_50_f2p8", "--out", tmp_path / "x.gif", "--json", "x.json") == 2
    assert not Path("x.json").exists()
    assert run(monkeypatch, "lens", "tessar_50_f2p8", "--json", tmp_path) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_no_output_replaces_another_or_the_prescription(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from test_cli import run

    monkeypatch.chdir(tmp_path)
    write_lens(load_lens("tessar_50_f2p8"), Path("mine.toml"))
    before = Path("mine.toml").read_bytes()
    assert run(monkeypatch, "lens", "mine.toml", "--vary-seed", 1, "--toml", tmp_path / "mine.toml") == 2
    assert "mine.toml: is also the file of the input; choose another path" in capsys.readouterr().err
    assert run(monkeypatch, "lens", "mine.toml", "--out", "a.png", "--json", "./a.png") == 2
    assert "--out a.png: is also the file of --json; choose another path" in capsys.readouterr().err
    assert run(monkeypatch, "flare", "mine.toml", "--sun-deg", 3, "--out", "a.png", "--json", "mine.toml") == 2
    assert "--json mine.toml: is also the file of the input" in capsys.readouterr().err
    assert Path("mine.toml").read_bytes() == before
    assert not Path("a.png").exists()


def test_a_lens_without_a_source_with_its_stop_behind_reads_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from test_cli import run

    monkeypatch.chdir(tmp_path)
    glass = {"radius_mm": 50.0, "thickness_mm": 2.0, "nd": 1.5, "diameter_mm": 10.0}
    plane = {"radius_mm": float("inf"), "thickness_mm": 3.0, "diameter_mm": 10.0}
    rows = [glass, plane, {"stop": True, "diameter_mm": 8.0}]
    Path("rear.toml").write_text(toml_files.toml_text({"name": "Rear stop", "surface": rows}))
    assert run(monkeypatch, "lens", "rear.toml") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("Rear stop: 3 surfaces\n")  # no comma before a source that is not there
    assert re.search(r"exit_pupil_mm +0\.0000", printed)  # not -0.0000


# --- paraxial ghosts --------------------------------------------------------------------------------------------


def test_ghost_matrices_are_the_published_ones() -> None:
    lens = load_lens("nikkor_28_f2p8")
    assert len(routes(lens)) == 66  # 12 interfaces: the stop and an air-air dummy left out
    for (a, b), expected in GHOSTS.items():
        matrix, met = along(lens, ghost(lens, a, b))
        np.testing.assert_allclose(matrix[0], expected, rtol=2e-5)
        assert len(met) == len(ghost(lens, a, b))


@pytest.mark.parametrize("name", ["nikkor_28_f2p8", "tessar_50_f2p8"])
def test_paraxial_ghosts_are_the_limit_of_exact_ones(name: str) -> None:
    """A stop of a hundredth and the Sun at 0.05°: flux, place and size of every ghost against exact rays."""
    lens = load_lens(name)
    rows = list(lens.surfaces)
    rows[lens.stop] = replace(rows[lens.stop], semi_diameter_mm=0.01 * rows[lens.stop].semi_diameter_mm)
    small = replace(lens, surfaces=tuple(rows))
    angle = 0.05
    pupil = np.pi / 4 * paraxial_properties(small).entrance_pupil_diameter_mm ** 2
    slope = np.tan(np.radians(angle))
    compared = 0
    for found in paraxial_ghosts(small, angle, across=256):
        path = ghost(small, *found.pair)
        _, met = along(small, path)
        rims = np.array([small.surfaces[row].semi_diameter_mm for row, _ in path])
        least = int(np.argmin(rims / np.abs(met[:, 0, 0])))
        radius, middle = (rims / np.abs(met[:, 0, 0]))[least], -met[least, 0, 1] / met[least, 0, 0] * slope
        if radius > 0.3:  # a ghost that the stop hardly limits is wide, and not paraxial
            continue
        side = 1.02 * radius * ((np.arange(101) + 0.5) / 101 * 2 - 1)
        x, y = (axis.ravel() for axis in np.meshgrid(side, side))
        origin = np.column_stack([middle + x, y, np.zeros_like(x)])
        rays = trace(small, origin, np.tile([slope, 0.0, 1.0], (len(x), 1)), path=path)
        if rays.arrives.sum() < 800:
            continue
        compared += 1
        at = rays.points_mm[-1, rays.arrives, :2]
        share = transmittance(small, path)
        flux = share * rays.arrives.sum() * (2.04 * radius / 101) ** 2 / pupil
        # both count points of a grid: a disc of 100 across holds 8e3, its rim errs by 0.5 %
        assert flux == pytest.approx(found.flux_fraction, rel=0.015)
        spread = np.sqrt(np.mean(np.sum((at - at.mean(axis=0)) ** 2, axis=1)))
        assert spread == pytest.approx(found.rms_radius_mm, rel=0.015)
        np.testing.assert_allclose(at.mean(axis=0), found.centroid_mm, atol=0.01 * spread + 1e-5)
    assert compared > 20 if name.startswith("nikkor") else compared > 10


# --- relatives of lenses, and prescriptions written and read again ------------------------------------------------


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_lens_survives_being_written(name: str, tmp_path: Path) -> None:
    lens = load_lens(name).coated("v")
    stop = lens.surfaces[lens.stop]
    surfaces = list(lens.surfaces)
    surfaces[lens.stop] = replace(stop, blades=7, blade_rounding=0.25, rotation_deg=12.0)
    surfaces[0] = replace(
        surfaces[0], conic=-0.1, aspheric_mm=(1e-7,), internal_transmittance_10mm=((400.0, 700.0), (0.9, 0.99))
    )
    lens = replace(
        lens, surfaces=tuple(surfaces), sensor_reflectance=0.2, name='a "lens" \\ of old\n[surface]\t\x00\x7f 🌀 α'
    )
    write_lens(lens, tmp_path / "lens.toml")
    again = load_lens(tmp_path / "lens.toml")
    assert (again.name, again.source, again.sensor_reflectance) == (lens.name, lens.source, 0.2)
    for a, b in zip(lens.surfaces, again.surfaces, strict=True):
        assert replace(a, medium=b.medium) == b
        np.testing.assert_allclose(a.medium.index([400.0, 550.0, 900.0]), b.medium.index([400.0, 550.0, 900.0]))


def test_a_scaled_lens_is_written_with_its_own_lengths(tmp_path: Path) -> None:
    """The file holds the lens as scaled; what is read from a file is not scaled yet."""
    lens = load_lens("tessar_50_f2p8")
    lens = replace(lens, surfaces=(replace(lens.surfaces[0], aspheric_mm=(1e-7, 1e-10)), *lens.surfaces[1:]))
    lens = lens.scaled(0.37)
    write_lens(lens, tmp_path / "lens.toml")
    again = load_lens(tmp_path / "lens.toml")
    assert (lens.scale, again.scale) == (0.37, 1.0)
    # media compare by index in the test above: nd and vd give their coefficients but for rounding
    for a, b in zip(lens.surfaces, again.surfaces, strict=True):
        assert replace(a, medium=b.medium) == b
    assert paraxial_properties(again).efl_mm == pytest.approx(paraxial_properties(lens).efl_mm, rel=1e-9)


def test_a_name_without_utf_8_can_be_written(tmp_path: Path) -> None:
    lens = replace(load_lens("tessar_50_f2p8"), name="lens \udcff")  # as a path of undecodable bytes has it
    write_lens(lens, tmp_path / "lens.toml")
    assert load_lens(tmp_path / "lens.toml").name == "lens ?"


def test_relatives_are_valid_alike_and_repeatable() -> None:
    lens = load_lens("distagon_25_f2p8")
    found = [relative(lens, np.random.default_rng(seed), spread=0.03) for seed in (1, 1, 2)]
    assert to_table(found[0]) == to_table(found[1])
    assert to_table(found[0]) != to_table(found[2])
    for one in found:
        assert len(one.surfaces) == len(lens.surfaces)
        assert paraxial_properties(one).efl_mm == pytest.approx(paraxial_properties(lens).efl_mm, rel=1e-9)
    many = [relative(lens, np.random.default_rng(seed), spread=0.02) for seed in range(40)]
    # of two radii the ratio, which no scaling changes: √2 · 0.02, of 40 draws uncertain to 11 %
    logs = np.log([one.surfaces[0].radius_mm / -one.surfaces[-1].radius_mm for one in many])
    assert 0.019 < logs.std() < 0.038
    same = relative(lens, np.random.default_rng(0), spread=0.0, index_spread=0.0)
    assert paraxial_properties(same).bfd_mm == pytest.approx(paraxial_properties(lens).bfd_mm, rel=1e-9)


def test_a_spread_out_of_range() -> None:
    with pytest.raises(InputError, match=r"spread = 0\.5: must be from 0 to 0\.3"):
        relative(load_lens("tessar_50_f2p8"), np.random.default_rng(0), spread=0.5)
