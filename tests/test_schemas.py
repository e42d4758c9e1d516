"""The JSON Schemas of scene, lens and sensor files accept the packaged files and refuse wrong ones."""

from __future__ import annotations

import copy
import dataclasses
import json
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.detector.readout import ReadoutSpec
from vbnfault.detector.sensor import Sensor, parse_sensor
from vbnfault.faults import registry
from vbnfault.lens import parse_lens
from vbnfault.output.starters import SCHEMAS, file_schema
from vbnfault.pipeline.session import configure_faults
from vbnfault.scene.config import parse_scene
from vbnfault.scene.instrument import OF_A_SENSOR_FILE, CameraTable
from vbnfault.study.spec import parse_study

FOLDERS = {"scene": "scenes", "lens": "scenes/lenses", "sensor": "scenes/detectors", "study": "scenes/studies"}
PACKAGED = [(kind, name) for kind in SCHEMAS for name in resources.packaged(FOLDERS[kind])]
VALIDATORS = {kind: Draft202012Validator(file_schema(kind)) for kind in SCHEMAS}


def packaged(kind: str, name: str) -> dict[str, Any]:
    return tomllib.loads(resources.packaged(FOLDERS[kind])[name].read_text(encoding="utf-8"))


def read(kind: str, table: dict[str, Any]) -> None:
    """Read a table as the program reads a file of the kind, faults included."""
    if kind == "scene":
        configure_faults(parse_scene(table, source="x.toml"), "x.toml")
    else:
        parsers = {"lens": parse_lens, "sensor": parse_sensor, "study": parse_study}
        parsers[kind](table, source="x.toml")


@pytest.mark.parametrize("kind", SCHEMAS)
def test_a_schema_is_one_and_plain_json(kind: str) -> None:
    schema = file_schema(kind)
    Draft202012Validator.check_schema(schema)
    assert json.loads(json.dumps(schema, allow_nan=False)) == schema


@pytest.mark.parametrize(("kind", "name"), PACKAGED)
def test_packaged_files_follow_their_schema(kind: str, name: str) -> None:
    errors = list(VALIDATORS[kind].iter_errors(packaged(kind, name)))
    assert not errors, errors[0]


def changed(kind: str, name: str, path: str, value: Any) -> dict[str, Any]:
    """A packaged file with one value changed, or removed where the value is None."""
    table = copy.deepcopy(packaged(kind, name))
    node: Any = table
    *parents, leaf = [int(key) if key.isdigit() else key for key in path.split(".")]
    for key in parents:
        node = node[key] if isinstance(key, int) else node.setdefault(key, {})
    if value is None:
        del node[leaf]
    else:
        node[leaf] = value
    return table


WRONG = [
    ("scene", "quickstart", "title", None),
    ("scene", "quickstart", "camera.fov_deg", 200),
    ("scene", "quickstart", "camera.exposure_s", "fast"),
    ("scene", "quickstart", "camera.fov", 30),
    ("scene", "quickstart", "dataset.layers", ["nonsense"]),
    ("scene", "quickstart", "geometry.height_m", [1]),
    ("scene", "quickstart", "body.photometry.model", "x"),
    ("scene", "quickstart", "faults.vigneting", {}),
    ("scene", "quickstart", "faults.broken_lines", {"white_count": 1.5}),
    ("scene", "quickstart", "faults.dust_on_optics", {"count": [1, 10**6]}),
    ("scene", "quickstart", "faults.dust_on_optics", {"no_such_key": 1}),
    ("scene", "quickstart", "faults.dust_on_optics", {"model": "traced"}),
    ("lens", "tessar_50_f2p8", "surface", []),
    ("lens", "tessar_50_f2p8", "surface.0.diameter_mm", None),
    ("lens", "tessar_50_f2p8", "surface.0.nd", 9.0),
    ("lens", "tessar_50_f2p8", "surface.0.radius", 9.0),
    ("lens", "tessar_50_f2p8", "surface.0.coating", [{"n": 1.4}]),
    ("lens", "tessar_50_f2p8", "surface.0.sensor", True),
    ("sensor", "generic_cmos", "architecture", None),
    ("sensor", "generic_cmos", "readout.bits", None),
    ("sensor", "generic_cmos", "readout", None),
    ("sensor", "generic_cmos", "readout.bits", 17),
    ("sensor", "generic_cmos", "readout.nodes", 3),
    ("sensor", "generic_cmos", "pattern", "plaid"),
    ("sensor", "generic_cmos", "individual.prnuu", 0.1),
    ("sensor", "generic_cmos", "transfer.parallel_traps", [{"density_per_px": 1.0}]),
]


@pytest.mark.parametrize(("kind", "name", "path", "value"), WRONG)
def test_a_wrong_file_is_refused_by_schema_and_program(kind: str, name: str, path: str, value: Any) -> None:
    table = changed(kind, name, path, value)
    assert not VALIDATORS[kind].is_valid(table)
    with pytest.raises(InputError, match=r"^x\.toml: ") as refused:
        read(kind, table)
    assert path.rsplit(".", 1)[-1] in str(refused.value)


def test_every_key_of_every_fault_is_in_the_schema() -> None:
    classes = file_schema("scene")["properties"]["faults"]["properties"]
    for fault, models in registry().items():
        for model, cls in models.items():
            options = classes[fault].get("anyOf", [classes[fault]])
            (option,) = [o for o in options if o["properties"]["model"]["const"] == model]
            for field in dataclasses.fields(cls):
                described = option["properties"][field.name]
                assert described["description"]
                assert set(described) & {"type", "anyOf", "enum", "const"}, (fault, model, field.name)


def keys_of(schema: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the owner, the name and the schema of every key of every table of a JSON Schema."""

    def walk(owner: str, node: Any) -> Iterator[tuple[str, str, dict[str, Any]]]:
        if isinstance(node, list):
            for part in node:
                yield from walk(owner, part)
        elif isinstance(node, dict):
            for key, described in node.get("properties", {}).items():
                yield node.get("title", owner), key, described
            for key, part in node.items():
                yield from walk(f"{owner}.{key}", part)

    return walk("", schema)


@pytest.mark.parametrize("kind", SCHEMAS)
def test_every_key_has_a_description(kind: str) -> None:
    schema = file_schema(kind)
    described = list(keys_of(schema))
    assert len(described) > 25

    def meaning(node: dict[str, Any]) -> str:
        if "$ref" in node:  # a table, whose docstring describes it
            node = {**schema["$defs"][node["$ref"].rsplit("/", 1)[-1]], **node}
        return node.get("description", "") or " ".join(meaning(part) for part in node.get("anyOf", ()))

    bare = [
        f"{owner}.{key}"
        for owner, key, node in described
        # a key with a single value says all by itself; the rows of a fault's key have the names of its other keys
        if "const" not in node and owner != "Row" and not meaning(node).strip()
    ]
    assert not bare


def test_all_sources_and_all_keys_that_are_missing_are_named_at_once() -> None:
    table = packaged("sensor", "generic_cmos")
    del table["sources"]
    with pytest.raises(InputError) as refused:
        parse_sensor(table, source="x.toml")
    for key in ("pixel_pitch_um", "readout.bits", "readout.full_well_e"):
        assert key in str(refused.value)
    for keys, table in (
        (("architecture", "pixel_pitch_um", "readout.bits", "readout.full_well_e"), {}),
        (("readout.bits", "readout.full_well_e"), {"architecture": "cmos", "pixel_pitch_um": 5.0, "readout": {}}),
    ):
        with pytest.raises(InputError, match=rf"^x\.toml: {', '.join(keys)}: are missing$"):
            parse_sensor(table, source="x.toml")
    rows = [{"diameter_mm": 1.0, "thickness_mm": 1.0, "stop": True}, *[{"diameter_mm": 1.0, "radius_mm": 9.0}] * 3]
    with pytest.raises(InputError, match=r"surface\[1\]\.thickness_mm, surface\[2\]\.thickness_mm: are missing"):
        parse_lens({"surface": rows}, source="x.toml")


def test_keys_of_a_sensor_file_under_camera_are_told_where_they_belong() -> None:
    with pytest.raises(InputError, match=r"^x\.toml: camera\.pattern = 'mono': is a key of a sensor.*pattern = "):
        parse_scene({"title": "t", "camera": {"pattern": "mono"}}, source="x.toml")
    with pytest.raises(InputError, match=r"camera\.demosaic = 'malvar': is a key of a sensor.*camera\.detector$"):
        parse_scene({"title": "t", "camera": {"demosaic": "malvar"}}, source="x.toml")
    assert set(OF_A_SENSOR_FILE) <= {*Sensor.__dataclass_fields__, *ReadoutSpec.__dataclass_fields__}
    assert not set(OF_A_SENSOR_FILE) & set(CameraTable.model_fields)


def test_misspelt_required_keys_are_named_beside_the_missing_ones() -> None:
    with pytest.raises(InputError, match=r"tilte: unknown key \(did you mean title\?\); title: is missing"):
        parse_scene({"tilte": "t"}, source="x.toml")
    with pytest.raises(InputError, match=r"camera\.fov_dg: .*fov_deg.*camera\.with_px: .*width_px"):
        parse_scene({"title": "t", "camera": {"fov_dg": 3, "with_px": 3}}, source="x.toml")


def test_a_wrong_response_says_how_to_describe_a_monochrome_camera() -> None:
    with pytest.raises(InputError, match=r"camera\.response = 'mono': .*pattern = \"mono\""):
        parse_scene({"title": "t", "camera": {"response": "mono"}}, source="x.toml")
    sensor = packaged("sensor", "generic_cmos") | {"response": "mono"}
    with pytest.raises(InputError, match=r"response = 'mono': .*pattern = \"mono\", .*quantum_efficiency_peak"):
        parse_sensor(sensor, source="x.toml")
