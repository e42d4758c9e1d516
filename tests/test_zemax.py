"""Zemax lens files and glass catalogues: units, stops, glasses, and what is refused (see also test_lens_oracle)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vbnfault.core.errors import InputError
from vbnfault.dataset.identity import _lens_digest
from vbnfault.lens import Prescription, load_lens, paraxial_properties
from vbnfault.lens.glass import (
    DISPERSIONS,
    GLASSES,
    Glass,
    dispersion,
    from_coefficients,
    register,
)
from vbnfault.lens.prescription_file import write_lens
from vbnfault.lens.zemax import _FORMULAS, read_catalogue, read_lens
from vbnfault.scene import config
from vbnfault.world import cameras

HEAD = "VERS 190513 0 123457 L123457\nMODE SEQ\nNAME a triplet\nUNIT MM X W X CM MR CPMM\nENPD 10\nGCAT SCHOTT\n"
OBJECT = 'SURF 0\n  TYPE STANDARD\n  CURV 0.0 0 0 0 0 ""\n  DISZ INFINITY\n  DIAM 0 0 0 0 1 ""\n'
# a Cooke triplet: glasses by name and by index, a dummy surface, an asphere, the stop in the air
TRIPLET = (
    HEAD
    + OBJECT
    + """SURF 1
  COMM a dummy surface
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 5
  DIAM 9 0 0 0 1 ""
SURF 2
  TYPE EVENASPH
  CURV 4.5421E-02 0 0 0 0 ""
  COAT AR
  PARM 1 0
  PARM 2 1.5E-06
  PARM 3 -2.0E-09
  DISZ 3.26
  GLAS N-BK7 0 0 1.5168 64.17 0 0 0 0 0 0
  DIAM 8 1 0 0 1 ""
  MEMA 8.2 0 0 0 1 ""
SURF 3
  TYPE STANDARD
  CURV -2.294E-03 0 0 0 0 ""
  CONI -0.7
  DISZ 6.007
  DIAM 8 1 0 0 1 ""
  CLAP 0 7.5 0
SURF 4
  TYPE STANDARD
  CURV -4.502E-02 0 0 0 0 ""
  DISZ 1.0
  GLAS ___BLANK 1 0 1.62 36.37 0 0 0 0 0 0
  DIAM 5 1 0 0 1 ""
SURF 5
  TYPE STANDARD
  CURV 4.928E-02 0 0 0 0 ""
  DISZ 2.0
  DIAM 5 1 0 0 1 ""
SURF 6
  STOP
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 2.75
  DIAM 4 0 0 0 1 ""
SURF 7
  TYPE STANDARD
  CURV 1.255E-02 0 0 0 0 ""
  DISZ 2.95
  GLAS SF6 0 0 1.5 40 0 0 0 0 0 0
  DIAM 6 1 0 0 1 ""
SURF 8
  TYPE STANDARD
  CURV -5.4361E-02 0 0 0 0 ""
  DISZ 42.2
  DIAM 6 1 0 0 1 ""
SURF 9
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 0
  DIAM 18 0 0 0 1 ""
"""
)
# Glasses of makers' catalogues, one for each formula that these use below 600 nm, with the index that they print.
CATALOGUE = """CC excerpts of catalogues
NM N-BK7 2 517642.251 1.5168 64.17 0 1
CD 1.039612120E+00 6.000698670E-03 2.317923440E-01 2.001791440E-02 1.010469450E+00 1.035606530E+02
IT 4.00000E-01 9.92000E-01 2.50000E+01
IT 3.80000E-01 -9.99000E+02 1.00000E+01
IT 3.50000E-01 9.30000E-01 2.50000E+01
NM QUARTZ 1 1 1.544296 70.132045 0 0 0
CD 2.356764950E+00 -1.139969240E-02 1.087416560E-02 3.320669140E-05 1.086093460E-05 -3.101239840E-07
NM KCL 3 0 1.490213 43.338570 0 0 0
CD 1.474596440E+00 5.054600850E-03 -2.574806930E-05 -1.782830090E-04 -4.495950450E-08 -2.075729940E-11
NM BASF5 5 0 1.603233 42.504788 0 0 0
CD 1.574103270E+00 1.397861490E-02 8.300451100E-04 0 0
NM CALCITE 6 1 1.658643 48.541403 0 0 0
CD 8.559E-01 3.45744E-03 8.391E-01 1.9881E-02 9.0E-04 3.8809E-02 6.845E-01 4.907002500E+01
NM ALN 9 1 2.154291 50.733102 0 0 0
CD 3.139900000E+00 1.378600000E+00 2.941000000E-02 3.861000000E+00 2.259009000E+02
NM P-LAF010S 12 1 1.742999 49.277592 0 2 0
CD 2.971455510E+00 -1.230843360E-02 2.294064430E-02 5.557501220E-04
-1.482403630E-05 1.438426280E-06 -1.144491200E-04 0.000000000E+00
NM J-LASFH17 13 1 2.000690 25.455728 0 0 1
CD 3.810716760E+00 -1.637379360E-02 0.000000000E+00 5.836728750E-02
4.127261080E-03 -5.522291260E-04 1.413028160E-04 -1.455178620E-05
7.444268000E-07 0.000000000E+00
"""


def written(folder: Path, text: str = TRIPLET, name: str = "lens.zmx") -> Path:
    """The path of a file with this text."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


# --- lens files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance", "given"), [("INFINITY", False), ("1e10", False), ("500", True)])
def test_a_near_object_is_named_in_the_source(tmp_path: Path, distance: str, given: bool) -> None:
    text = TRIPLET.replace(OBJECT, OBJECT.replace("INFINITY", distance))
    source = read_lens(written(tmp_path, text))[0]["source"]
    assert source.endswith("object at 500 mm; camera.focus_distance_m is used instead") == given


def test_the_unit_scales_every_length(tmp_path: Path) -> None:
    lens = load_lens(written(tmp_path))
    inches = load_lens(written(tmp_path, TRIPLET.replace("UNIT MM", "UNIT IN"), "inches.zmx"))
    wanted = lens.scaled(25.4)
    for mine, other in zip(inches.surfaces, wanted.surfaces, strict=True):
        assert mine.aspheric_mm == pytest.approx(other.aspheric_mm)
        for key in ("radius_mm", "thickness_mm", "semi_diameter_mm", "conic"):
            assert getattr(mine, key) == pytest.approx(getattr(other, key))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"])
def test_encodings(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "lens.ZMX"
    path.write_bytes(TRIPLET.replace("a triplet", "für Zemax").encode(encoding))
    lens = load_lens(path)
    assert lens.name == "für Zemax"
    assert lens.surfaces == load_lens(written(tmp_path)).surfaces


def test_a_stop_on_a_refracting_surface_is_a_row_of_its_shape(tmp_path: Path) -> None:
    """The same light passes as through a stop in the air just in front of the surface's vertex."""
    stop = 'SURF 6\n  STOP\n  TYPE STANDARD\n  CURV 0.0 0 0 0 0 ""\n  DISZ 2.75\n  DIAM 4 0 0 0 1 ""\n'
    assert stop in TRIPLET
    text = TRIPLET.replace(stop, "").replace("  DISZ 2.0\n", "  DISZ 4.75\n")
    text = text.replace("SURF 7\n", "SURF 7\n  STOP\n").replace("SURF 9", "SURF 8")
    lens = load_lens(written(tmp_path, text))
    k = lens.stop
    assert lens.surfaces[k].thickness_mm == 0
    assert lens.surfaces[k].radius_mm == lens.surfaces[k + 1].radius_mm == pytest.approx(1 / 1.255e-2)
    assert lens.surfaces[k].semi_diameter_mm == lens.surfaces[k + 1].semi_diameter_mm == 6
    before = load_lens(written(tmp_path))
    assert paraxial_properties(lens).efl_mm == pytest.approx(paraxial_properties(before).efl_mm)
    np.testing.assert_allclose(lens.vertices_mm[k:], before.vertices_mm[[5, 5, 6]], atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("MODE SEQ", "MODE NSC", "MODE NSC: must be SEQ"),
        ("UNIT MM", "UNIT FT", "UNIT FT: must be one of MM, CM, IN"),
        ("TYPE EVENASPH", "TYPE ODDASPHE", "SURF 2: TYPE ODDASPHE: must be STANDARD or EVENASPH"),
        ("PARM 1 0", "PARM 1 0.1", "SURF 2: PARM 1 0.1: the term of r² must be 0"),
        ("PARM 1 0\n", "PARM 9 1e-20\n", "SURF 2: PARM 9 1e-20: the number of the parameter must be from 1 to 8"),
        (
            "PARM 1 0\n",
            "PARM 2.5 1e-9\n",
            "SURF 2: PARM 2.5 1e-09: the number of the parameter must be from 1",
        ),
        ("CURV 4.5421E-02 0", "CURV often 0", "SURF 2: CURV: value 1 is 'often'; must be a number"),
        ("CLAP 0 7.5", "CLAP 1 7.5", "SURF 3: CLAP 1: the inner radius of the aperture must be 0"),
        ("CLAP 0 7.5", "SQAP 7 7.5", "SURF 3: SQAP: a rectangular aperture cannot be read"),
        ("GLAS SF6 0 0 1.5 40", "GLAS MIRROR 0 0 1.5 40", "SURF 7: GLAS MIRROR: lenses with mirrors"),
        (
            "GLAS SF6 0 0 1.5 40",
            "GLAS SF66 0 0 1.5 40",
            "SURF 7: GLAS SF66: unknown; known are the glasses of",
        ),
        ("DISZ 2.75", "DISZ -2.75", "SURF 6: DISZ -2.75: the distance to the next surface comes to -2.75 mm"),
        ("STOP", "HIDE", "STOP: must stand at exactly one surface from SURF 1 to SURF 8; it stands nowhere"),
        ("SURF 2\n", "SURF 2\n  STOP\n", "SURF 1 to SURF 8; it stands at SURF 2, 6"),
        ("SURF 9\n", "SURF 9\n  STOP\n", "SURF 1 to SURF 8; it stands at SURF 6, 9"),
        ("CLAP 0 7.5", "CLAP 0 -7.5", "SURF 3: CLAP -7.5: the radius of the aperture must be above 0"),
        # what only the prescription knows is said with the file's own numbers
        ("1 0 1.62 36.37", "1 0 9 36.37", "SURF 4: nd = 9.0: must be a number from 1 to 5"),
        (
            "CONI -0.7",
            "CONI 1e5",
            "SURF 3: diameter_mm = 15: a surface with radius_mm = -435.92 and conic = 100000",
        ),
        ("DISZ 3.26", "DISZ 0.1", "SURF 2: thickness_mm = 0.1: SURF 2 and SURF 3 cross"),
        ("CURV -5.4361E-02", "CURV 5.4361E-02", "a triplet: surface 6: no ray reaches the sensor"),
        (TRIPLET[TRIPLET.index("SURF 1") :], "", "not a lens: between the first SURF"),
        ("  DISZ 0\n  DIAM 18", "  CURV 0.1\n  DIAM 18", "SURF 9: CURV 0.1: the image must be plane"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in TRIPLET
    path = written(tmp_path, TRIPLET.replace(old, new))
    with pytest.raises(InputError) as error:
        load_lens(path)
    assert str(error.value).startswith(str(path))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def without(text: str, *starts: str) -> str:
    """The text without the lines that begin so."""
    return "\n".join(line for line in text.splitlines() if not line.strip().startswith(starts)) + "\n"


FIELDS = "FTYP 0 0 3 1 0 0 0 1\nXFLN 0 0 6 0 0 0 0 0 0 0 0 0\nYFLN 0 7 8 0 0 0 0 0 0 0 0 0\n"


@pytest.mark.parametrize("named", ["ENPD", "FNUM", "stop", "others"])
@pytest.mark.parametrize("distance_mm", [math.inf, 200.0])
def test_missing_rims_let_the_beams_of_the_file_pass(tmp_path: Path, named: str, distance_mm: float) -> None:
    """They are the heights of the marginal and the chief ray, here traced surface by surface with y and n u."""
    whole = load_lens(written(tmp_path, TRIPLET, "whole.zmx"))
    curvatures = [1 / s.radius_mm for s in whole.surfaces]
    media = [1.0, *(s.medium.nd for s in whole.surfaces)]
    gaps = [s.thickness_mm for s in whole.surfaces]

    def heights(y: float, nu: float) -> list[float]:
        out = []
        for k, curvature in enumerate(curvatures):
            out.append(y)
            nu -= y * curvature * (media[k + 1] - media[k])
            y += gaps[k] * nu / media[k + 1]
        return out

    # the entrance pupil, of radius 5, is where a ray through the middle of the stop meets the axis in front
    a, b = heights(1, 0)[4], heights(0, 1)[4]
    behind = b / a
    slope = 0 if math.isinf(distance_mm) else 5 / (distance_mm + 5 + behind)  # SURF 1 is 5 mm before the lens
    axial = heights(5 - slope * behind, slope)
    tangent = math.tan(math.radians(10))  # the third field, of 6 and 8 degrees
    chief = heights(-behind * tangent, tangent)
    expected = np.abs(axial) + np.abs(chief)
    assert abs(chief[4]) < 1e-12

    place = "INFINITY" if math.isinf(distance_mm) else f"{distance_mm}"
    text = TRIPLET.replace("UNIT", FIELDS + "UNIT").replace(OBJECT, OBJECT.replace("INFINITY", place))
    if named == "FNUM":
        text = text.replace("ENPD 10", f"FNUM {paraxial_properties(whole).efl_mm / 10} 0")
    elif named in ("stop", "others"):
        text = text.replace("ENPD 10\n", "")
    if named == "others":  # the axial beam is as wide as the narrowest rim lets it be, here that of SURF 5
        rims = [7, 7, abs(axial[2]) * 1.2, abs(axial[3]), 0, 7, 7]
        text = without(text, "CLAP")
        for number, rim in zip((2, 3, 4, 5, 6, 7, 8), rims, strict=True):
            start, end = text.index(f"SURF {number}\n"), text.index(f"SURF {number + 1}\n")
            text = text[:start] + without(text[start:end], "DIAM") + (f"  DIAM {rim}\n" if rim else "") + text[end:]
        lens = load_lens(written(tmp_path, text))
        assert lens.surfaces[4].semi_diameter_mm == pytest.approx(abs(axial[4]))
        assert lens.source.endswith("DIAM of SURF 6 from the paraxial beams of the other rims")
        return
    text = without(text, "DIAM", "CLAP")
    if named == "stop":
        text = text.replace("SURF 6\n", f"SURF 6\n  DIAM {abs(axial[4])}\n")
    lens = load_lens(written(tmp_path, text))
    np.testing.assert_allclose([s.semi_diameter_mm for s in lens.surfaces], expected, rtol=1e-9)
    listed = "2, 3, 4, 5, 7, 8" if named == "stop" else "2, 3, 4, 5, 6, 7, 8"
    assert f"DIAM of SURF {listed} from the paraxial beams of " in lens.source


def test_an_automatic_stop_is_no_wider_than_the_beam(tmp_path: Path) -> None:
    """OpticStudio widens it for oblique beams; the f-number stays that of ENPD or FNUM, as in optiland."""
    wide = TRIPLET.replace("DIAM 4 0 0 0 1", "DIAM 6 0 0 0 1")
    for text, pupil in (
        (wide, {"entrance_pupil_diameter_mm": 10.0}),
        (wide.replace("ENPD 10", "FNUM 5 0"), {"f_number": 5.0}),
        (TRIPLET, {"entrance_pupil_diameter_mm": 9.468772}),
        (wide.replace("DIAM 6 0", "DIAM 6 1"), {"entrance_pupil_diameter_mm": 1.5 * 9.468772}),
    ):
        lens = load_lens(written(tmp_path, text))
        got = {name: getattr(paraxial_properties(lens), name) for name in pupil}
        assert got == pytest.approx(pupil, rel=1e-6)


def test_a_missing_rim_stays_within_its_ball(tmp_path: Path) -> None:
    """A paraxial beam may be wider than a ball lens in glass, whose rim then lies just inside the equator."""
    ball = "SURF 1\n CURV 0.2\n DISZ 10\n GLAS N-BK7 0 0 1.5168 64.17\nSURF 2\n CURV -0.2\n DISZ 2\n"
    text = HEAD.replace("ENPD 10", "ENPD 12") + OBJECT + ball + "SURF 3\n STOP\n CURV 0\n DISZ 1\nSURF 4\n CURV 0\n"
    table, _, _ = read_lens(written(tmp_path, text))
    assert table["surface"][0]["diameter_mm"] == pytest.approx(9.99)


def test_a_stop_of_no_known_width_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="SURF 2: DIAM: the semi-diameter is missing, and neither ENPD, FNUM nor"):
        load_lens(written(tmp_path, without(TRIPLET, "DIAM", "CLAP", "ENPD")))


def test_names_of_glasses_are_found_in_any_case(tmp_path: Path) -> None:
    lens = load_lens(
        written(tmp_path, TRIPLET.replace("GLAS SF6", "GLAS SILICA").replace("GLAS N-BK7", "GLAS n-bk7"))
    )
    assert lens.surfaces[5].medium == GLASSES["silica"]
    assert lens.surfaces[0].medium == GLASSES["N-BK7"]


def test_glasses_are_those_beside_the_lens_file(tmp_path: Path) -> None:
    """From the catalogue that GCAT names, then from the packaged ones; the record's index serves last."""
    written(tmp_path, CATALOGUE.replace("NM QUARTZ", "NM SF6"), "Schott.AGF")
    written(tmp_path, "this is not read", "other.agf")
    lens = load_lens(written(tmp_path))
    assert lens.surfaces[5].medium.nd == pytest.approx(1.544296, abs=1e-6)
    assert lens.surfaces[0].medium.nd == pytest.approx(1.5168, abs=5e-6)
    nodes, fractions = lens.surfaces[0].internal_transmittance_10mm
    assert nodes == (350.0, 400.0)
    assert fractions == pytest.approx((0.93**0.4, 0.992**0.4))
    by_index = load_lens(written(tmp_path, TRIPLET.replace("GLAS SF6 0 0 1.5 40", "GLAS XYZ 0 0 1.7 30"), "b.zmx"))
    assert by_index.source.endswith("; GLAS XYZ by nd and vd of the record, as no catalogue beside the file has it")
    assert "GLAS" not in load_lens(written(tmp_path)).source
    assert by_index.surfaces[5].medium.nd == pytest.approx(1.7)
    assert by_index.surfaces[5].medium.vd == pytest.approx(30)


def test_a_lens_written_as_toml_is_the_same(tmp_path: Path) -> None:
    written(tmp_path, CATALOGUE, "lens.agf")
    lens = load_lens(written(tmp_path))
    write_lens(lens, tmp_path / "lens.toml")
    again = load_lens(tmp_path / "lens.toml")
    for mine, other in zip(again.surfaces, lens.surfaces, strict=True):
        np.testing.assert_allclose(mine.medium.index([450.0, 900.0]), other.medium.index([450.0, 900.0]))
        assert mine.internal_transmittance_10mm == other.internal_transmittance_10mm
        assert mine.radius_mm == other.radius_mm


def test_a_scene_takes_a_zemax_lens_and_knows_its_catalogues(tmp_path: Path) -> None:
    path = written(tmp_path)
    catalogue = written(tmp_path, CATALOGUE, "schott.agf")
    scene = config.load_scene("quickstart", {"camera.lens": str(path), "faults.vignetting.model": "lens"})
    assert cameras.base_camera(scene).lens.name == "a triplet"
    before = _lens_digest(scene.camera.lens)
    assert before.count("+") == 1
    catalogue.write_text(CATALOGUE.replace("9.92000E-01", "9.91000E-01"), encoding="utf-8")
    after = _lens_digest(scene.camera.lens)
    assert after.split("+")[0] == before.split("+")[0]
    assert after != before


# --- glasses --------------------------------------------------------------------------------------------------


def test_catalogues_give_the_index_that_they_print(tmp_path: Path) -> None:
    catalogue = read_catalogue(written(tmp_path, CATALOGUE, "x.agf"))
    for name, records in catalogue.records.items():
        glass = catalogue.glass(name.lower())
        assert glass is not None
        assert glass.nd == pytest.approx(float(records[0][4]), abs=5e-6)  # printed with five or six decimals
    assert catalogue.glass("unknown") is None


def test_a_glass_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    """A public catalogue has liquids with B₁ 0 C₁ 0 0 0 where the formula takes B₁ C₁ B₂ C₂ B₃ C₃."""
    text = "NM GLYCEROL 2 0 1.47096 61.17 0 1 -\nCD 1.1306E+00 0.0 9.8E-03 0.0 0.0 0.0\n"
    text += "NM MENDED 2 0 1.47096 61.17 0 1 -\nCD 1.1306E+00 9.8E-03 0 0 0 0\n"
    text += "NM INFRARED 2 0 1.0 0.0 0 1 -\nCD 1.1306E+00 9.8E-03 0 0 0 0\n"  # no index printed at the d line
    catalogue = read_catalogue(written(tmp_path, text, "liquids.agf"))
    with pytest.raises(InputError, match=r"GLYCEROL: CD: formula 2 has the index 1\.46301 .* but NM says 1\.47096"):
        catalogue.glass("glycerol")
    for name in ("mended", "infrared"):
        glass = catalogue.glass(name)
        assert glass is not None
        assert glass.nd == pytest.approx(1.47096, abs=2e-4)  # Liebetraut et al. 2013 print four digits of B


def test_every_formula_of_catalogues_is_registered() -> None:
    for name, count, _ in _FORMULAS.values():
        assert count in DISPERSIONS[name].counts


@pytest.mark.parametrize(
    ("formula", "coefficients", "square"),
    [
        ("sellmeier_2", (1.2, 0.9, 0.1, 0.01, 0.12), lambda s: 2.2 + 0.9 * s / (s - 0.01) + 0.01 / (s - 0.0144)),
        ("handbook_1", (2.2, 0.01, 0.02, 0.003), lambda s: 2.2 + 0.01 / (s - 0.02) - 0.003 * s),
        ("handbook_2", (1.3, 0.9, 0.02, 0.003), lambda s: 1.3 + 0.9 * s / (s - 0.02) - 0.003 * s),
        (
            "polynomial",
            (2.3, -0.01, 0.01, 2e-4, 3e-5, 4e-6, 5e-7, 6e-8),
            lambda s: (
                2.3 - 0.01 * s + 0.01 / s + 2e-4 / s**2 + 3e-5 / s**3 + 4e-6 / s**4 + 5e-7 / s**5 + 6e-8 / s**6
            ),
        ),
        (
            "sellmeier",
            (0.1, 0.2, 0.3, 0.4, 0.5, 0.01, 0.02, 0.03, 0.04, 50.0),
            lambda s: (
                1
                + 0.1 * s / (s - 0.01)
                + 0.2 * s / (s - 0.02)
                + 0.3 * s / (s - 0.03)
                + 0.4 * s / (s - 0.04)
                + 0.5 * s / (s - 50)
            ),
        ),
    ],
)
def test_formulas_that_no_packaged_glass_uses(formula: str, coefficients: tuple[float, ...], square) -> None:
    um = np.array([0.45, 0.7, 1.0])
    index = from_coefficients(formula, coefficients).index(1e3 * um)
    np.testing.assert_allclose(index, np.sqrt(square(um**2)), rtol=1e-12)


def test_a_lens_in_toml_names_catalogues(tmp_path: Path) -> None:
    written(tmp_path, CATALOGUE, "mine.agf")
    text = """glass_catalogues = ["mine.agf"]
[[surface]]
stop = true
thickness_mm = 1.0
diameter_mm = 5.0
[[surface]]
radius_mm = 50.0
thickness_mm = 3.0
diameter_mm = 10.0
glass = "BASF5"
[[surface]]
radius_mm = -50.0
diameter_mm = 10.0
"""
    lens = load_lens(written(tmp_path, text, "lens.toml"))
    assert lens.surfaces[1].medium.nd == pytest.approx(1.603233, abs=1e-6)
    for changed, said in (
        (text.replace("BASF5", "BASF55"), "glass = 'BASF55': unknown; known are those of"),
        (text.replace("mine.agf", "none.agf"), "none.agf: glass catalogue file not found"),
        (text.replace('["mine.agf"]', "3"), "glass_catalogues = 3: must be a list of strings"),
        (text.replace("mine.agf", "lens.toml"), "unsupported glass catalogue type '.toml'; allowed are .agf"),
    ):
        with pytest.raises(InputError, match=r"lens\.toml") as error:
            load_lens(written(tmp_path, changed, "lens.toml"))
        assert said in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("NM KCL 3", "NM KCL 14", "KCL: dispersion formula 14: must be from 1 to 13"),
        ("NM KCL 3", "NM KCL x", "KCL: NM: value 2 is 'x'; must be a number"),
        ("CD 1.474596440E+00", "CD 1.47q", "KCL: CD: value 1 is '1.47q'; must be a number"),
        (
            "CD 1.474596440E+00",
            "XX 1.474596440E+00",
            "KCL: CD: the coefficients",
        ),
    ],
)
def test_a_wrong_glass_is_named_when_it_is_used(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in CATALOGUE
    catalogue = read_catalogue(written(tmp_path, CATALOGUE.replace(old, new), "x.agf"))
    assert catalogue.glass("QUARTZ") is not None
    with pytest.raises(InputError) as error:
        catalogue.glass("KCL")
    assert said in str(error.value)


def test_a_glass_and_a_formula_register_in_one_place() -> None:
    from vbnfault.core.registry import undoing_registrations
    from vbnfault.lens import parse_lens

    with undoing_registrations(always=True):

        @dispersion("flat", 1)
        def _flat(um2: np.ndarray, c: tuple[float, ...]) -> np.ndarray:
            return np.full(np.shape(um2), c[0])

        register(Glass(name="jelly", formula="flat", coefficients=(1.4,)))
        stop = {"stop": True, "thickness_mm": 1.0, "diameter_mm": 5.0}
        rows = [stop, {"radius_mm": 50.0, "thickness_mm": 3.0, "diameter_mm": 9.0, "glass": "jelly"}]
        rows.append({"radius_mm": -50.0, "diameter_mm": 9.0})
        lens: Prescription = parse_lens({"surface": rows}, source="test")
        assert lens.surfaces[1].medium.nd == 1.4
        assert math.isinf(lens.surfaces[1].medium.vd)
        with pytest.raises(TypeError, match=r"glass jelly is defined twice: in .*test_zemax.py"):
            register(Glass(name="jelly", formula="flat", coefficients=(1.5,)))
        with pytest.raises(TypeError, match=r"dispersion formula flat is defined twice: in .*test_zemax.py"):
            dispersion("flat", 1)(lambda um2, c: um2)
    assert "jelly" not in GLASSES
    assert "flat" not in DISPERSIONS


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"formula": "cauchi"}, r"glass.formula = 'cauchi': must be one of "),
        ({"coefficients": (1.4,)}, r"glass.coefficients: cauchy takes 2 numbers; got 1"),
        ({"coefficients": (1.4, "0")}, r"glass 'jelly': coefficients = .*: must be numbers"),
        (
            {"coefficients": (1.4, float("nan"))},
            r"glass 'jelly': its index must be from 1 to 5 between .*; got nan",
        ),
        ({"formula": "sellmeier", "coefficients": (-9.0,) * 6}, r"glass 'jelly': its index must be .*; got nan"),
        ({"coefficients": (0.4, 0.0)}, r"glass 'jelly': its index must be from 1 to 5 between 400 .*; got 0.4"),
        ({"coefficients": (6.5, 0.0)}, r"glass 'jelly': its index must be from 1 to 5 between 400 .*; got 6.5"),
        ({"internal_transmittance_10mm": ((500.0, 400.0), (1.0, 1.0))}, r"needs rising wavelengths and as many"),
        ({"internal_transmittance_10mm": 0.9}, r"internal_transmittance_10mm: must be wavelengths and values"),
        (
            {"internal_transmittance_10mm": ((400.0,), (1.2,))},
            r"internal_transmittance_10mm = \[1.2\]: must be from",
        ),
        ({"name": ""}, r"glass '': its name must be a text that is not empty"),
    ],
)
def test_a_wrong_glass_is_refused_and_stays_unknown(wrong: dict[str, Any], sentence: str) -> None:
    before = dict(GLASSES)
    with pytest.raises(InputError, match=sentence):
        register(Glass(**{"name": "jelly", "formula": "cauchy", "coefficients": (1.4, 0.0)} | wrong))
    assert dict(GLASSES) == before
