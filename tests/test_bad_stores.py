"""Every command on what is no store of this version, is not finished, or lies in a bucket that refuses.

One sentence, no traceback, and nothing that was there is lost. A store without fault classes is sound.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import zarr
from conftest import Called
from s3_server import BUCKET, S3Server, in_environment
from synthetic import filled
from test_export import tree

import vbnfault
from vbnfault import store as st
from vbnfault.dataset.merge import join_stores
from vbnfault.store import bucket, codec, layout

# What each command is given, for the store, a sound store and a folder for new files.
COMMANDS: dict[str, Callable[[Any, Path, Path], list[Any]]] = {
    "verify": lambda s, _, out: ["verify", s],
    "digest": lambda s, _, out: ["digest", s],
    "preview": lambda s, _, out: ["preview", s, "--out", out / "p.png"],
    "export": lambda s, _, out: ["export", s, "--format", "png", "--out", out / "e"],
    "report": lambda s, _, out: ["report", s, "--out", out / "r.html"],
    "view": lambda s, _, out: ["view", s, "--no-browser"],
    "stats": lambda s, _, out: ["stats", s],
    "card": lambda s, _, out: ["card", s],
    "retake": lambda s, _, out: ["retake", s, "--scene", "quickstart", "--out", out / "n.zarr"],
    "merge": lambda s, sound, out: ["merge", sound, s, "--out", out / "m.zarr"],
    "merge into": lambda s, sound, out: ["merge", sound, "--out", s],
    "migrate": lambda s, _, out: ["migrate", s],
    "build": lambda s, _, out: ["build", "quickstart", "--out", s, "--samples", 50],
}


Call = Callable[..., Called]


@pytest.fixture(autouse=True)
def no_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no command of this file get as far as a render."""
    monkeypatch.setitem(sys.modules, "mitsuba", None)


@pytest.mark.parametrize("command", ["digest", "preview", "export", "report", "stats", "card"])
def test_every_command_takes_a_store_without_fault_classes(command: str, tmp_path: Path, call: Call) -> None:
    store = filled(tmp_path / "s.zarr", 2, faults=(), mask_any_faults=(), layers=("depth_m",))
    assert call(*COMMANDS[command](store.path, tmp_path, tmp_path)).code == 0


# --- on a disk --------------------------------------------------------------------------------------------


def _plain_zarr(path: Path, _sound: Path) -> None:
    data = xarray.Dataset({"image": (("sample", "y", "x"), np.zeros((4, 8, 8), np.uint8))})
    data.to_zarr(path, zarr_format=3, consolidated=False)


def _zarr_2(path: Path, _sound: Path) -> None:
    xarray.Dataset({"image": (("sample", "y"), np.zeros((4, 8)))}).to_zarr(path, zarr_format=2)


def _newer(path: Path, sound: Path) -> None:
    store = st.open_store(shutil.copytree(sound, path), "r+")
    store.update_attributes({"format_version": st.FORMAT_VERSION + 1})


def _without_root(path: Path, sound: Path) -> None:
    shutil.copytree(sound, path)
    (path / "zarr.json").write_text("{")
    (path / "spare/zarr.json").write_text("{")


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (_plain_zarr, "is no vbnfault store"),
        (_zarr_2, "is no vbnfault store"),
        (_newer, "this vbnfault reads up to"),
        (_without_root, "are both damaged; put a copy of either in its place, or choose another --out"),
    ],
)
def test_a_store_of_another_program_or_version_is_left_alone(
    make: Callable[[Path, Path], None],
    sentence: str,
    command: str,
    described_store: Path,
    tmp_path: Path,
    call: Call,
) -> None:
    path, out = tmp_path / "s.zarr", tmp_path / "out"
    out.mkdir()
    make(path, described_store)
    before = tree(path)
    refused = call(*COMMANDS[command](path, described_store, out))
    assert refused.code == 2
    assert refused.said.startswith(f"{path}: ")
    left = command in ("build", "merge into") and "no vbnfault store, so it is left" in refused.said
    assert left or sentence in refused.said
    assert tree(path) == before
    assert not [*out.iterdir()]


def _set_attribute(path: Path, key: str, value: Any) -> None:
    """Change one root attribute of a store in both documents, with the right checksum; None removes it."""
    attributes = copy.deepcopy(st.open_store(path, "r+").root_attributes)
    *tables, last = key.split(".")
    table = attributes
    for name in tables:
        table = table[name]
    if value is None:
        del table[last]
    else:
        table[last] = value
    attributes = layout.sealed(attributes)
    root = json.loads((path / "zarr.json").read_text())
    (path / "spare/zarr.json").write_bytes(layout.to_bytes(layout.group_document(attributes)))
    (path / "zarr.json").write_bytes(layout.to_bytes({**root, "attributes": attributes}))


@pytest.mark.parametrize(
    ("key", "value"),
    {
        "scene": [],
        "scene.camera": 7,
        "scene.faults.straylight": "x",
        "fault_models.straylight": [],
        "scene.faults.straylight.model": {},
        "blocks": [],
        "versions": "x",
        "versions_of_samples": [7],
        "retake": {},
        "samples": -1,
        "store": 7,
        "store.mask_kinds": 7,
        "store.wavelength_nm": "x",
        "store.attitude_references": ["sun", "moon"],
        "store.centre_of_mass_T_m": [1.0, 2.0],
        "store.height": 0,
        "store.width": 2**63,
        "store.rendered_shape": [2**40, 2],
        "store.shard_samples": -1,
    }.items(),
)
def test_root_attributes_of_the_wrong_type_are_one_sentence(key: str, value: Any, copied: Path, call: Call) -> None:
    sound = Path(shutil.copytree(copied, copied.parent / "sound.zarr"))
    _set_attribute(copied, key, value)
    for command, arguments in COMMANDS.items():
        refused = call(*arguments(copied, sound, copied.parent))
        assert refused.code == 2, command
        start = f"{copied}: is no vbnfault store: its root attributes are not those of one: {key}"
        assert refused.said.startswith(start)


_TABLES = ("scene.camera", "scene.body", "scene.dataset", "scene", "fault_models", "blocks")


@pytest.mark.parametrize("key", _TABLES)
def test_a_store_that_lacks_a_table_of_its_scene_is_one_sentence(key: str, copied: Path, call: Call) -> None:
    _set_attribute(copied, key, None)
    for command in ("verify", "retake"):
        refused = call(*COMMANDS[command](copied, copied, copied.parent))
        assert refused.code == 2
        assert refused.said.startswith(f"{copied}: its root attributes lack {key}, so its views are not known")


@pytest.mark.parametrize("keys", [_TABLES[:3], _TABLES[3:]], ids=["parts of the scene", "all tables"])
def test_commands_that_need_no_plan_take_a_store_that_lacks_tables(
    keys: tuple[str, ...], copied: Path, call: Call
) -> None:
    for key in keys:
        _set_attribute(copied, key, None)
    for command in ("digest", "preview", "export", "report", "stats", "card", "migrate"):
        assert call(*COMMANDS[command](copied, copied, copied.parent)).code == 0, command


@pytest.mark.parametrize(
    ("command", "code", "sentence"),
    [
        ("verify", 1, "2 problems; run the build command again to repair the store"),
        ("export", 2, "3 of 6 samples are finished; run the build command again, and export the store when"),
        ("retake", 2, r"a retake keeps view, ground, light and render"),
        ("build", 2, r"the store was made with 6; use --append to add some"),
        *((name, 0, "") for name in ("digest", "preview", "report", "stats", "card", "merge", "migrate")),
    ],
)
def test_a_half_finished_store_keeps_its_samples(
    command: str, code: int, sentence: str, copied: Path, described_store: Path, tmp_path: Path, call: Call
) -> None:
    half = st.open_store(copied, "r+")
    half._write_done(0, set())
    half._write_done(1, {2})
    before = {name: content for name, content in tree(half.path).items() if "/c/" in name}
    done = call(*COMMANDS[command](half.path, described_store, tmp_path))
    assert done.code == code
    assert not code or sentence in done.said
    after = tree(half.path)
    assert {name: after[name] for name in before} == before


def _chunk_of_another(path: Path) -> None:
    store = st.open_store(path, "r+")
    chunks = store.chunk("image", 1)
    store.file("image", 1).write_bytes(codec.join_shard({0: chunks[3], 1: chunks[3]}, 2))


def _without(name: str) -> Callable[[Path], None]:
    return lambda path: shutil.rmtree(path / name)


def _parameters(text: str) -> Callable[[Path], None]:
    return lambda path: zarr.open_group(path, mode="r+")["parameters"].set_basic_selection(2, text)


def _nothing_finished(path: Path) -> None:
    spec = st.open_store(path).spec
    shutil.rmtree(path)
    st.create(path, spec, 6)


_NO_TABLE = "sample 2: its parameters are damaged, they are no table in JSON; the build command repairs them"


@pytest.mark.parametrize(
    ("damage", "commands", "code", "sentence"),
    [
        (
            _chunk_of_another,
            "preview export",
            1,
            "sample 2 does not match the stored crc32c of image; the build command repairs it",
        ),
        (_nothing_finished, "preview report export", 2, "no sample is finished yet"),
        (
            _without("done"),
            "preview report export stats card",
            None,
            "the array done, which marks the finished samples, is missing",
        ),
        *((_parameters(text), "stats card", 1, _NO_TABLE) for text in ("not json", "[]", "3", "[" * 100_000)),
        (
            _without("split"),
            "report",
            2,
            "the scalars of all 6 finished samples cannot be read, so there is nothing to show",
        ),
        (
            lambda path: os.truncate(path / "mask/zarr.json", 40),
            "digest",
            1,
            "array mask cannot be opened, mask/zarr.json is damaged",
        ),
    ],
)
def test_damage_is_one_sentence_of_every_command_that_meets_it(
    damage: Callable[[Path], None],
    commands: str,
    code: int | None,
    sentence: str,
    copied: Path,
    described_store: Path,
    call: Call,
) -> None:
    damage(copied)
    before = tree(copied)
    for command in commands.split():
        refused = call(*COMMANDS[command](copied, described_store, copied.parent))
        assert refused.code == code or (code is None and refused.code in (1, 2)), command
        assert f"s.zarr: {sentence}" in refused.said
        assert tree(copied) == before


def test_a_report_warns_once_of_images_that_are_missing(copied: Path, tmp_path: Path) -> None:
    shutil.rmtree(copied / "image")
    with pytest.warns(UserWarning, match="image of sample") as warned:
        vbnfault.report(copied, tmp_path / "r.html")
    assert [str(one.message) for one in warned] == [
        f"{copied}: image of sample 5 cannot be read: the file image/c/2/0/0/0 is missing; the build command "
        "repairs it; the same is true of 5 samples more; the report shows no images"
    ]


# --- in a bucket ------------------------------------------------------------------------------------------


@pytest.fixture
def server(s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """The server, which this process finds; requests are not repeated."""
    monkeypatch.setattr(bucket, "RETRIES", {"max_retries": 0})
    with in_environment(s3_server):
        yield s3_server


@pytest.fixture
def stored(described_store: Path, server: S3Server) -> str:
    """The URL of a sound store."""
    url = f"s3://{BUCKET}/bad/sound.zarr"
    if not st.is_store(url):
        join_stores([described_store], url, progress=False)
    return url


@pytest.mark.parametrize("command", COMMANDS)
def test_a_bucket_that_is_missing_or_refuses_is_one_sentence(
    command: str, stored: str, server: S3Server, described_store: Path, tmp_path: Path, call: Call
) -> None:
    def said(url: str, code: int) -> str:
        refused = call(*COMMANDS[command](url, described_store, tmp_path))
        assert refused.code == code
        assert not [*tmp_path.iterdir()]
        return refused.said

    missing = "s3://none/s.zarr: there is no such bucket; create it, or correct the URL"
    assert said("s3://none/s.zarr", 2) == missing
    with server.counted() as requests:
        with server.failing(403, lambda method, path: "sound.zarr" in path):
            text = said(stored, 1 if command == "merge into" else 2)
        assert "access is refused (403 Forbidden)" in text
        assert text.startswith(stored)
        with server.failing(503, lambda method, path: "sound.zarr" in path):
            assert "503 Service Unavailable; nothing is lost" in said(stored, 1)
    assert not [r for r in requests if r.method != "GET"]


@pytest.mark.parametrize("command", ["verify", "preview", "export", "report", "stats", "digest", "merge"])
def test_a_bucket_that_fails_in_the_middle_of_a_command(
    command: str, stored: str, server: S3Server, described_store: Path, tmp_path: Path, call: Call
) -> None:
    with server.failing(503, lambda method, path: "/done/c/1" in path or "/image/c/1" in path) as refused:
        done = call(*COMMANDS[command](stored, described_store, tmp_path))
    assert refused
    assert done.code in (0, 1)
    assert "cannot be read: 503 Service Unavailable; nothing is lost, repeat the command" in done.said


@pytest.mark.parametrize(
    ("url", "variable"),
    [
        ("s3://b/s.zarr", "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true"),
        ("gs://b/s.zarr", "GOOGLE_SERVICE_ACCOUNT"),
        ("az://b/s.zarr", "AZURE_STORAGE_ACCOUNT_KEY"),
    ],
)
def test_missing_credentials_are_one_sentence(
    url: str, variable: str, monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    """Obstore asks the cloud's machine for them; no answer is that of a machine elsewhere."""
    obstore = pytest.importorskip("obstore")
    asked = "Error performing PUT http://169.254.169.254/latest/api/token in 2 s - HTTP error"

    def refuse(*_: Any, **__: Any) -> None:
        raise obstore.exceptions.GenericError(asked)

    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "a")
    monkeypatch.setattr(obstore, "get", refuse)
    refused = call("verify", url)
    more = " for a public bucket" if "s3" in url else ""
    assert (refused.code, refused.said) == (2, f"{url}: no credentials were found; set {variable}{more}")
