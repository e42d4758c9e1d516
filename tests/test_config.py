"""The scene file: strict, one sentence an error, the paper's tables as printed, keyed randomness."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from vbnfault import faults
from vbnfault.core import tables
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources, toml_files
from vbnfault.dataset.identity import content_hash
from vbnfault.detector import ThreeColourDetector
from vbnfault.detector.sensor import load_sensor, parse_sensor
from vbnfault.scene import config, keyed_random
from vbnfault.scene.config import Scene, load_scene, parse_scene

PACKAGED = sorted(resources.packaged("scenes"))


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "scene.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(text: str | bytes, folder: Path, **overrides: Any) -> str:
    """The sentence with which the scene is refused: one line, beginning with the file."""
    path = write(folder, text)
    with pytest.raises(InputError) as caught:
        load_scene(path, overrides)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.startswith(f"{path}: ")
    assert len(sentence) < 600
    return sentence.removeprefix(f"{path}: ")


# ------------------------------------------------------------------------------------------------- strictness

TITLE = 'title = "t"\n'


@pytest.mark.parametrize(
    ("text", "must_say"),
    [
        ("", ["scene file is empty"]),
        ("\n", ["title", "missing"]),
        ("[camera]\nfov_deg = 30", ["title", "missing"]),
        ("title = 3", ["title = 3", "string"]),
        # unknown keys, with a hint where one is close
        (TITLE + "[camera]\nfov_dg = 3", ["camera.fov_dg", "unknown key", "did you mean fov_deg?"]),
        (TITLE + "[cammera]\nfov_deg = 3", ["cammera", "unknown key", "did you mean camera?"]),
        (TITLE + "zzz = 1", ["zzz", "unknown key", "known:", "camera"]),
        (
            TITLE + "[geometry.sun_facing]\nrol_deg = [0, 1]",
            ["geometry.sun_facing.rol_deg", "did you mean roll_deg?"],
        ),
        # field of view
        (TITLE + "[camera]\nfov_deg = 0", ["camera.fov_deg = 0:", "0.01 to 140"]),
        (TITLE + "[camera]\nfov_deg = nan", ["camera.fov_deg = nan:", "0.01 to 140"]),
        # types are not converted
        (TITLE + '[camera]\nfov_deg = "65"', ["camera.fov_deg = '65':", "number", "0.01 to 140"]),
        (TITLE + "[dataset]\nseed = 1e3", ["dataset.seed = 1000.0:", "whole number"]),
        (TITLE + "camera = 3", ["camera = 3:", "must be"]),
        (TITLE + "[[camera]]\nfov_deg = 3", ["camera =", "must be"]),
        (TITLE + '[dataset]\nlayers = "clean"', ["dataset.layers = 'clean':", "must be"]),
        (TITLE + "[sun]\njulian_date = 2014-11-12", ["sun.julian_date", "2014-11-12", "number"]),
        # ranges
        (TITLE + "[plan]\nclasses_per_sample = [0, 3]", ["plan.classes_per_sample", "= 0:", "1 to 64"]),
        (TITLE + "[geometry]\nheight_m = [-3, 1]", ["geometry.height_m", "= -3:", "from 0"]),
        (TITLE + "[camera]\nexposure_s = 2e4", ["exposure_s = 20000.0:", "'auto'", "at most 10000"]),
        (TITLE + "[camera]\nexposure_s = 0", ["exposure_s = 0", "'auto'", "above 0"]),
        (TITLE + "[render]\nsamples_per_pixel = 8", ["samples_per_pixel = 8:", "1, 4, 16, 64"]),
        # names
        (TITLE + '[plan]\nmode = "x"', ["plan.mode = 'x':", "'per_class' or 'per_sample'"]),
        (TITLE + '[camera]\nresponse = "foo"', ["response = 'foo':", "nikon_5100"]),
        (TITLE + '[camera]\narchitectures = ["cmoss"]', ["camera.architectures", "'cmoss'", "'cmos'"]),
        (TITLE + '[body]\nreflectance = "foo"', ["reflectance = 'foo':", "67p"]),
        (TITLE + '[dataset]\nlayers = ["foo"]', ["dataset.layers", "'foo'", "depth_m", "without_"]),
        # a converter without a code above that of no light
        (TITLE + "[camera]\nadc_bits = 8\nbias_dn = 300", ["bias_dn = 300:", "from 0 to 254", "adc_bits = 8"]),
        (TITLE + "[camera]\nadc_bits = 9\nbias_dn = 511", ["bias_dn = 511:", "from 0 to 510", "adc_bits = 9"]),
        # reversed bounds
        (TITLE + "[geometry]\nx_m = [3, 1]", ["geometry.x_m = [3, 1]:", "reversed"]),
        (
            TITLE + "[geometry.sun_facing]\nroll_deg = [5, 1]",
            ["geometry.sun_facing.roll_deg = [5, 1]:", "reversed"],
        ),
        (TITLE + "[plan]\nclasses_per_sample = [4, 3]", ["plan.classes_per_sample = [4, 3]:", "reversed"]),
        (TITLE + '[dataset]\nlayers = ["clean", "clean"]', ["dataset.layers = ", "'clean' is given twice"]),
        (
            TITLE + "[camera]\nexposure_min_s = 3\nexposure_max_s = 1",
            ["exposure_min_s = 3", "exposure_max_s", "reversed"],
        ),
        (
            TITLE + "[render]\nband_min_nm = 700\nband_max_nm = 400",
            ["band_min_nm = 700", "band_max_nm", "reversed"],
        ),
        # not TOML
        (TITLE + "x = ", ["not a TOML file"]),
        (TITLE + TITLE, ["not a TOML file"]),
        ('title = "a\n', ["not a TOML file", "line 1"]),
        (b"\xff\xfe\x00", ["not a TOML file"]),
        # shapes and sums
        (TITLE + "[geometry]\nx_m = [3]", ["geometry.x_m = [3]"]),
        (TITLE + "[geometry]\nx_m = 3", ["geometry.x_m = 3:", "two"]),
        (TITLE + "[body]\nsemi_axes_m = [0, 1, 1]", ["body.semi_axes_m[0] = 0:", "1e+09"]),
        (TITLE + '[camera]\nexposure_s = "fast"', ["exposure_s = 'fast'", "'auto'"]),
        (TITLE + "[dataset]\nsplit = {train = 0.5}", ["train", "0.5"]),
        ("title = 2020-01-01", ["title"]),
        (TITLE + '"a\\nb" = 1', ["unknown key"]),
    ],
)
def test_refused_in_one_sentence(text: str | bytes, must_say: list[str], tmp_path: Path) -> None:
    sentence = refusal(text, tmp_path)
    for part in must_say:
        assert part in sentence


def schema_numbers() -> list[tuple[str, str, dict[str, Any]]]:
    """(table, key, schema) of every plain number of the scene file, from its JSON schema."""
    root = Scene.model_json_schema()
    found = []
    for table, node in root["properties"].items():
        definition = root["$defs"].get(node.get("$ref", "").rsplit("/", 1)[-1], {})
        for key, schema in definition.get("properties", {}).items():
            options = [s for s in schema.get("anyOf", [schema]) if s.get("type") in ("number", "integer")]
            if options and any("inimum" in k or "aximum" in k for k in options[0]):
                found.append((table, key, options[0]))
    return found


@pytest.mark.parametrize(
    ("table", "key", "schema"), schema_numbers(), ids=lambda v: v if isinstance(v, str) else ""
)
def test_every_number_is_refused_just_outside_its_range(table: str, key: str, schema: dict[str, Any]) -> None:
    lo = schema.get("minimum", schema.get("exclusiveMinimum"))
    hi = schema.get("maximum", schema.get("exclusiveMaximum"))
    bad: list[Any] = [True, [1], float("nan")]
    if lo is not None:
        bad.append(lo if "exclusiveMinimum" in schema else lo - (1 if schema["type"] == "integer" else 1e-6))
    if hi is not None:
        bad.append(hi + 1 if schema["type"] == "integer" else hi * (1 + 1e-6))
    if schema["type"] == "integer":
        bad.append(lo + 0.5)
    for value in bad:
        with pytest.raises(InputError) as caught:
            parse_scene({"title": "t", table: {key: value}}, source="here")
        sentence = str(caught.value)
        assert "\n" not in sentence
        assert sentence.startswith(f"here: {table}.{key} = {value!r}: must be ")
        for bound in (lo, hi):
            assert bound is None or tables._plain(bound) in sentence


def test_every_number_is_accepted_at_its_bounds() -> None:
    assert len(schema_numbers()) > 30
    for table, key, schema in schema_numbers():
        if (table, key) in (("render", "band_min_nm"), ("render", "band_max_nm"), ("dataset", "split")):
            continue  # bound to each other
        for bound in ("minimum", "maximum"):
            if bound in schema:
                value = int(schema[bound]) if schema["type"] == "integer" else schema[bound]
                extra = {"exposure_max_s": 1e4} if key == "exposure_min_s" else {}
                extra |= {"exposure_min_s": 1e-9} if key == "exposure_max_s" else {}
                extra |= {"shape": "x.obj"} if key == "sharpen" else {}
                extra |= {"shard_samples": 16} if key == "variants_per_view" else {}
                extra |= {"aim": "nadir"} if key == "pointing_error_deg" else {}
                extra |= {"width_px": 16 if bound == "minimum" else 16384} if key == "focal_length_mm" else {}
                extra |= {"regolith": {}} if key == "craters_per_km2" else {}
                extra |= {"detector": "x"} if key in ("individuals", "detector_temperature_K", "stretch") else {}
                scene = parse_scene({"title": "t", table: {key: value, **extra}}, source="here")
                assert getattr(getattr(scene, table), key) == value


@pytest.mark.parametrize(("bits", "bias"), [(8, 254), (10, 1000)])
def test_a_bias_below_the_largest_number_leaves_a_gain(bits: int, bias: int) -> None:
    camera = parse_scene({"title": "t", "camera": {"adc_bits": bits, "bias_dn": bias}}, source="here").camera
    assert ThreeColourDetector(adc_bits=camera.adc_bits, bias_dn=camera.bias_dn).gain_dn_per_e > 0


@pytest.mark.parametrize("bias", [-1, 255, 4096])
def test_a_detector_made_in_python_refuses_a_bias_without_codes_for_the_signal(bias: int) -> None:
    with pytest.raises(InputError, match=rf"bias_dn = {bias}: must be from 0 to 254 with adc_bits = 8"):
        ThreeColourDetector(adc_bits=8, bias_dn=bias)


@settings(max_examples=60)  # the first example loads what the faults need
@given(
    st.dictionaries(
        st.sampled_from(["title", "camera", "geometry", "dataset", "faults", "body", "x"]),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text('ab"\n\0é', max_size=4),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(
                    st.sampled_from(["fov_deg", "x_m", "split", "train", "shape", "é"]), inner, max_size=3
                )
            ),
            max_leaves=6,
        ),
        max_size=4,
    )
)
def test_whatever_is_in_it_a_scene_is_accepted_or_refused_in_a_line(table: dict[str, Any]) -> None:
    sentence = "here: "
    try:
        parse_scene(table, source="here")
    except InputError as error:
        sentence = str(error)
    assert sentence.startswith("here: ")
    assert "\n" not in sentence


@pytest.mark.parametrize("kind", ["missing", "folder", "name", "name_like"])
def test_no_such_scene(kind: str, tmp_path: Path) -> None:
    wanted = {
        "missing": tmp_path / "absent.toml",
        "folder": tmp_path,
        "name": "nosuchscene",
        "name_like": "quickstar",
    }[kind]
    with pytest.raises(InputError) as caught:
        load_scene(wanted)
    sentence = str(caught.value)
    assert sentence.startswith(f"{wanted}: ")
    assert "\n" not in sentence
    if kind.startswith("name"):  # the packaged ones are offered
        assert all(name in sentence for name in PACKAGED)
    else:
        assert "no such file" in sentence


# ----------------------------------------------------------------------------------------------------- values


def test_defaults_follow_the_paper() -> None:
    scene = parse_scene({"title": "t"}, source="here")
    assert (scene.camera.fov_deg, scene.camera.width_px, scene.camera.height_px) == (65, 1024, 1024)
    assert scene.dataset.sites == 32
    assert scene.render.bands == 8
    assert scene.geometry.sun_facing is not None
    assert scene.geometry.sun_facing.roll_deg == (-32.5, 32.5)
    assert scene.geometry.sun_averted is not None
    assert scene.geometry.sun_averted.pitch_deg == (32.5, 327.5)
    assert scene.geometry.sun_averted.sun_elevation_deg == (-30, 90)
    assert parse_scene({"title": "t"}, source="elsewhere") == scene


def test_unset_bounds_follow_the_field_of_view_and_set_ones_stay() -> None:
    table = {"title": "t", "camera": {"fov_deg": 30}, "geometry": {"sun_facing": {"roll_deg": [1, 2]}}}
    scene = parse_scene(table, source="here")
    assert scene.geometry.sun_facing is not None
    assert scene.geometry.sun_averted is not None
    assert scene.geometry.sun_facing.roll_deg == (1, 2)
    assert scene.geometry.sun_facing.pitch_deg == (-15, 15)
    assert scene.geometry.sun_averted.roll_deg == (15, 345)


def test_resolved_scene_is_a_scene_again() -> None:
    for name in PACKAGED:
        scene = load_scene(name)
        assert scene.title == name
        plain = scene.resolved()
        assert json.loads(json.dumps(plain)) == plain
        assert parse_scene(plain, source="again") == scene


@pytest.mark.parametrize(
    ("body", "render", "airfall", "albedos"),
    [  # cover of dust from -2 to 1 + 2 times the airfall
        ("reflectance = 0.1\nphotometry = {dust_contrast = 0.5}", "", 3.0, "from -0.2 to 0.45"),
        ("reflectance = 0.1\nphotometry = {dust_contrast = -0.9}", "", 1.0, "from -0.17 to 0.28"),
        ("reflectance = 0.5\nphotometry = {dust_contrast = 1.5}", "", 0.0, "from 0.5 to 1.25"),
        ("reflectance = 0.1\nphotometry = {dust_slope_per_100nm = -0.2}", "band_max_nm = 2000", 0.0, "from -0."),
    ],
)
def test_dust_leaves_no_negative_albedo(
    tmp_path: Path, body: str, render: str, airfall: float, albedos: str
) -> None:
    text = f"{TITLE}[body]\n{body}\n[patch]\npreset = 'none'\nairfall = {airfall}\n[render]\n{render}\n"
    assert f"the ground would have albedos {albedos}" in refusal(text.encode(), tmp_path)


def test_overrides_replace_the_file(tmp_path: Path) -> None:
    path = write(tmp_path, TITLE + "[camera]\nfov_deg = 30\nwidth_px = 64")
    scene = load_scene(path, {"camera.fov_deg": 40, "dataset.split.train": 0.7, "title": "other"})
    assert (scene.camera.fov_deg, scene.camera.width_px, scene.title) == (40, 64, "other")
    assert load_scene(path).camera.fov_deg == 30
    assert "camera.fov_deg = 'x':" in refusal(path.read_bytes(), tmp_path, **{"camera.fov_deg": "x"})
    assert "unknown key" in refusal(path.read_bytes(), tmp_path, **{"camera.nothing": 1})


def test_an_override_replaces_an_entry_of_a_list() -> None:
    table = {"factor": [{"low": 1}, {"low": 2}], "names": ["a", ["b"]]}
    tables.replace(table, {"factor[0].low": 3, "factor.1.high": 4, "names[1][0]": "c"}, source="file")
    assert table == {"factor": [{"low": 3}, {"low": 2, "high": 4}], "names": ["a", ["c"]]}
    for key, sentence in (
        ("factor[2].low", r"file: factor\[2\].low = 5: factor is a list; its entries are 0 to 1"),
        ("factor.x", r"file: factor.x = 5: factor is a list"),
        ("names[0].low", r"file: names\[0\].low = 5: 0 is a value, not a table"),
    ):
        with pytest.raises(InputError, match=sentence):
            tables.replace(table, {key: 5}, source="file")


@pytest.mark.parametrize("key", ["title.a", "camera.fov_deg.x"])
def test_override_below_a_value_is_refused(key: str, tmp_path: Path) -> None:
    assert key in refusal(TITLE + "[camera]\nfov_deg = 30", tmp_path, **{key: 1})


def test_paths_count_from_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, elsewhere = tmp_path / "scene", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    (folder / "comet.obj").write_text("")
    monkeypatch.chdir(elsewhere)
    scene = load_scene(write(folder, TITLE + '[body]\nshape = "comet.obj"'))
    assert scene.body.shape == str(folder / "comet.obj")
    assert load_scene(write(folder, TITLE + '[body]\nshape = "embedded"')).body.shape == "embedded"


def test_a_scene_cannot_be_edited() -> None:
    scene = parse_scene({"title": "t"}, source="here")
    with pytest.raises(ValueError, match="frozen"):
        scene.camera.fov_deg = 3.0  # type: ignore[misc]


# -------------------------------------------------------------------------------------------- packaged scenes


def test_mission_classes_carry_the_faults_of_the_papers_table() -> None:
    # Gallon et al., table "Applicability of Fault Cases": earth observation, landing, SSSB, interplanetary
    applicable = {
        "dust_on_optics": "NYYN",
        "broken_pixels": "NNYY",
        "broken_lines": "YYYY",
        "straylight": "YNYY",
        "vignetting": "YYYY",
        "optics_degradation": "NNYY",
    }
    for column, name in enumerate(("earth_observation", "landing", "sssb_exploration", "interplanetary")):
        expected = {fault for fault, row in applicable.items() if row[column] == "Y"}
        assert set(load_scene(name).faults) == expected, name


def paper_faults(name: str) -> dict[str, dict[str, Any]]:
    return {k: faults.from_dict(k, t, source=name).to_dict() for k, t in load_scene(name).faults.items()}


def test_paper67p_is_the_papers_tables() -> None:
    scene = load_scene("paper67p")
    assert scene.dataset.samples == 5000  # abstract and conclusion
    camera = scene.camera  # table of camera and image parameters
    assert (camera.fov_deg, camera.width_px, camera.height_px) == (65, 1024, 1024)
    assert set(camera.architectures) == {"full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos"}
    assert set(camera.readout_directions) == {"up", "down", "right", "left"}

    # table of the boundaries of dataset variables, in degrees and metres
    half = 65 / 2
    facing, averted = scene.geometry.sun_facing, scene.geometry.sun_averted
    assert facing is not None
    assert averted is not None
    for stratum in (facing, averted):
        assert stratum.reference == "sun"
        assert stratum.sun_azimuth_deg == (0, math.degrees(2 * math.pi))
        assert stratum.yaw_deg == (0, math.degrees(2 * math.pi))
    assert facing.sun_elevation_deg == pytest.approx(np.degrees([-np.pi / 6, np.pi / 6]))
    assert averted.sun_elevation_deg == pytest.approx(np.degrees([-np.pi / 6, np.pi / 2]))
    assert facing.roll_deg == facing.pitch_deg == (-half, half)
    assert averted.roll_deg == averted.pitch_deg == (half, 360 - half)
    assert scene.geometry.x_m == scene.geometry.y_m == (-150, 150)
    assert scene.geometry.height_m == (0, 100)

    tables = {  # the tables of fault parameters
        "dust_on_optics": {
            "model": "gaussian",
            "count": [30, 100],
            "peak_dn": [100, 200],
            "sigma_xx": [3, 6],
            "sigma_yy": [3, 6],
            "sigma_xy": [0, 0],
        },
        "broken_pixels": {
            "model": "texture",
            "count": [10, 150],
            "brightness_dn": [0, 255],
            "line_offset_dn": [0, 65],
        },
        "broken_lines": {"model": "texture", "count": [1, 5]},
        "straylight": {
            "model": "texture",
            "count": [1, 10],
            "index": [1, 10],
            "position": [0.5, 2],
            "radius": [0.05, 0.3],
            "brightness": [1.5, 2.5],
        },
        "vignetting": {"model": "cos4", "on_axis_illuminance_dn": [105, 255]},
        "optics_degradation": {"model": "gaussian", "filter_size_px": [3, 17]},
    }
    found = paper_faults("paper67p")
    assert set(found) == set(tables)
    for fault, table in tables.items():
        assert {key: found[fault][key] for key in table} == table


def test_the_models_own_defaults_are_the_papers_bounds() -> None:
    found = paper_faults("paper67p")
    # the text names dead and hot pixels, the table has a brightness that is uniform without them
    assert found["broken_pixels"].pop("salt_and_pepper_fraction") == 0
    found["broken_pixels"]["salt_and_pepper_fraction"] = 0.05
    for fault, table in found.items():
        assert faults.from_dict(fault, {"model": table["model"]}, source="t").to_dict() == table


# ------------------------------------------------------------------------------------------------ JSON schema


def test_json_schema_describes_the_scene_file() -> None:
    schema = json.loads(json.dumps(config.json_schema(faults.json_schema())))
    assert schema["$schema"].endswith("2020-12/schema")
    assert schema["required"] == ["title"]
    assert schema["additionalProperties"] is False
    assert set(schema["properties"]) == set(Scene.model_fields)
    assert set(schema["properties"]["faults"]["properties"]) == set(faults.registry())
    fov = schema["$defs"]["CameraTable"]["properties"]["fov_deg"]
    assert (fov["type"], fov["minimum"], fov["maximum"], fov["default"]) == ("number", 0.01, 140, 65)

    def walk(node: Any) -> None:
        if isinstance(node, dict):
            if "$ref" in node:  # no reference leads nowhere
                assert node["$ref"].rsplit("/", 1)[-1] in schema["$defs"]
            if node.get("type") == "object" and "properties" in node:
                assert node.get("additionalProperties") is False
            if "minimum" in node and "maximum" in node:
                assert node["minimum"] < node["maximum"]
            for value in node.values():
                walk(value)
        elif isinstance(node, list):
            for value in node:
                walk(value)

    walk(schema)


# -------------------------------------------------------------------------------------------------- hash, rng


def test_content_hash_tells_everything_apart() -> None:
    base = {"a": 1, "b": [1, 2]}
    different = [
        content_hash(),
        content_hash(base),
        content_hash({**base, "a": 2}),
        content_hash({**base, "b": [2, 1]}),
        content_hash({**base, "c": None}),
        content_hash(base, b""),
        content_hash(b"", base),
        content_hash(b"ab", b"c"),
        content_hash(b"a", b"bc"),  # the border between parts counts
        content_hash(b"abc"),
        content_hash(1),
        content_hash("1"),
        content_hash(1.0),
    ]
    assert len(set(different)) == len(different)
    assert all(len(h) == 64 and int(h, 16) >= 0 for h in different)
    # the order of a table's keys does not count
    assert content_hash(base) == content_hash({"b": [1, 2], "a": 1})


def test_hash_of_a_scene_follows_every_number_of_it() -> None:
    plain = load_scene("quickstart").resolved()
    reference = content_hash(plain)
    for table, key, schema in schema_numbers():
        value = plain[table][key]
        if isinstance(value, int | float):
            changed = {
                **plain,
                table: {**plain[table], key: value + (1 if schema["type"] == "integer" else 1e-9)},
            }
            assert content_hash(changed) != reference, (table, key)


def test_rng_is_keyed_by_all_four_and_by_nothing_else() -> None:
    first = keyed_random.rng(1, 2, "stage", "name").random(4)
    keyed_random.rng(9, 9, "other", "draws").random(1000)  # what else is drawn, and when, does not matter
    np.testing.assert_array_equal(keyed_random.rng(1, 2, "stage", "name").random(4), first)
    keys = [(0, 2, "stage", "name"), (1, 3, "stage", "name"), (1, 2, "stag", "name"), (1, 2, "stage", "nam")]
    # the borders between the keys count too
    keys += [
        (12, 2, "stage", "name"),
        (1, 22, "stage", "name"),
        (1, 2, "stagen", "ame"),
        (2, 1, "stage", "name"),
    ]
    drawn = {tuple(keyed_random.rng(*key).random(4)) for key in keys} | {tuple(first)}
    assert len(drawn) == len(keys) + 1


def test_rng_streams_of_neighbours_are_uniform_and_uncorrelated() -> None:
    # first number of 6000 streams that differ in the sample only, against those of the next name
    n = 6000
    a, b = (np.array([keyed_random.rng(3, i, "fault", name).random() for i in range(n)]) for name in ("x", "y"))
    assert stats.kstest(a, "uniform").pvalue > 1e-4
    # a correlation of independent numbers has the spread 1/√n: 4.5 of it is 7e-6 two-sided
    for pair in ((a, b), (a[:-1], a[1:])):
        assert abs(np.corrcoef(*pair)[0, 1]) < 4.5 / np.sqrt(n)


SAMPLES = np.arange(100_000)


def test_keyed_uniform_is_uniform() -> None:
    tests = 0
    for seed in (0, 1, 2**63 - 1):
        for name in ("roll_deg/0", "roll_deg/1", "height_m/0"):
            for start in (0, 10_000_000):
                u = keyed_random.keyed_uniform(seed, SAMPLES + start, "plan", name)
                assert u.dtype == np.float64
                assert u.min() >= 0
                assert u.max() < 1
                # 36 tests in all: 1e-4 / 36 each
                assert stats.kstest(u, "uniform").pvalue > 1e-4 / 36
                # and serially, in 20 × 20 cells of (u_i, u_i+1)
                cells = np.histogram2d(u[::2], u[1::2], bins=20, range=[[0, 1], [0, 1]])[0]
                assert stats.chisquare(cells.ravel()).pvalue > 1e-4 / 36
                tests += 2
    assert tests == 36


def test_keyed_uniform_uses_its_low_bits() -> None:
    # 53 bits: each is set in half of the numbers, 4.5 standard deviations of √(n/4)
    bits = (keyed_random.keyed_uniform(5, SAMPLES, "plan", "x") * 2.0**53).astype(np.uint64)
    for b in range(53):
        ones = int(((bits >> np.uint64(b)) & np.uint64(1)).sum())
        assert abs(ones - len(SAMPLES) / 2) < 4.5 * np.sqrt(len(SAMPLES) / 4)


def test_keyed_uniform_is_independent_across_names_seeds_and_stages() -> None:
    columns = [
        keyed_random.keyed_uniform(seed, SAMPLES, stage, name)
        for seed in (1, 2)
        for stage in ("plan", "resolve")
        for name in ("roll_deg/0", "pitch_deg/0", "roll_deg/1")
    ]
    correlation = np.corrcoef(columns)[np.triu_indices(len(columns), 1)]
    assert len(correlation) == 66
    # 66 correlations of spread 1/√n: 5.2 of it is 2e-7 two-sided, 1e-5 in all
    assert np.abs(correlation).max() < 5.2 / np.sqrt(len(SAMPLES))


def test_keyed_uniform_does_not_depend_on_what_else_is_asked() -> None:
    u = keyed_random.keyed_uniform(7, SAMPLES[:100], "plan", "x")
    pick = np.array([3, 99, 0])
    np.testing.assert_array_equal(keyed_random.keyed_uniform(7, pick, "plan", "x"), u[pick])
    assert not np.array_equal(keyed_random.keyed_uniform(8, SAMPLES[:100], "plan", "x"), u)


def test_keyed_uniform_is_the_published_finaliser() -> None:
    # splitmix64 (Steele et al. 2014) in Python's own integers, the finaliser applied twice
    import hashlib

    u64 = (1 << 64) - 1
    start = int.from_bytes(hashlib.sha256(b"7\0plan\0x").digest()[:8], "little")
    for sample in (0, 1, 12_345_678):
        x = (sample * 0x9E3779B97F4A7C15 + start) & u64
        for _ in range(2):
            x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & u64
            x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & u64
            x ^= x >> 31
        assert keyed_random.keyed_uniform(7, np.array([sample]), "plan", "x")[0] == (x >> 11) / 2**53


@pytest.mark.expects_warnings
def test_shares_of_version_0_2_are_fractions_now(caplog: pytest.LogCaptureFixture) -> None:
    old = parse_scene({"title": "t", "faults": {"adc": {"missing_share": [0.1, 0.2]}}}, source="old.toml")
    assert old.faults == {"adc": {"missing_fraction": [0.1, 0.2]}}
    assert caplog.messages == [
        "old.toml: faults.adc.missing_share: is called missing_fraction now; the old name still works"
    ]
    both = {"title": "t", "faults": {"adc": {"missing_share": [0.1, 0.2], "missing_fraction": [0.1, 0.2]}}}
    with pytest.raises(InputError, match=r"missing_share: is the old name of missing_fraction, which is given"):
        parse_scene(both, source="both.toml")
    with pytest.raises(InputError, match=r"dust_on_optics\.my_share: unknown key"):
        config.load_scene("quickstart", {"faults.dust_on_optics.my_share": 1})


def test_shares_of_a_sensor_file_are_fractions_now(caplog: pytest.LogCaptureFixture) -> None:
    table = toml_files.read_toml(resources.find("scenes/detectors", "generic_cmos"), "detector")
    individual = {**table["individual"], "rts_share": table["individual"]["rts_fraction"]}
    sources = {**table["sources"], "individual.rts_share": "assumed"}
    del individual["rts_fraction"], sources["individual.rts_fraction"]
    made = parse_sensor({**table, "individual": individual, "sources": sources}, source="old.toml")
    assert made == load_sensor("generic_cmos")
    assert len(caplog.messages) == 2
