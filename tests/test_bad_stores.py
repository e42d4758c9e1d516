"""Every command on what is no store of this version, is not finished, or lies in a bucket that refuses.

One sentence, no traceback, and nothing that was there is lost. A store without fault classes is sound.
"""

from __future__ import annotations

import copy
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import zarr
from s3_server import BUCKET, S3Server, in_environment
from synthetic import filled
from test_cli import run
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


@pytest.fixture(autouse=True)
def no_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no command of this file get as far as a render."""
    monkeypatch.setitem(sys.modules, "mitsuba", None)


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line on standard error besides warnings, notes and progress."""
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("vbnfault: ")]
    assert len(lines) == 1, lines
    return lines[0].removeprefix("vbnfault: ")


@pytest.mark.parametrize("command", ["digest", "preview", "export", "report", "stats", "card"])
def test_every_command_takes_a_store_without_fault_classes(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    store = filled(tmp_path / "s.zarr", 2, faults=(), mask_any_faults=(), layers=("depth_m",))
    assert run(monkeypatch, *COMMANDS[command](store.path, tmp_path, tmp_path)) == 0, capsys.readouterr().err


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
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, out = tmp_path / "s.zarr", tmp_path / "out"
    out.mkdir()
    make(path, described_store)
    before = tree(path)
    assert run(monkeypatch, *COMMANDS[command](path, described_store, out)) == 2
    text = said(capsys)
    assert text.startswith(f"{path}: ")
    assert sentence in text or (command in ("build", "merge into") and "no vbnfault store, so it is left" in text)
    assert tree(path) == before
    assert not [*out.iterdir()]


def _with_attributes(path: Path, sound: Path, key: str, value: Any) -> None:
    """Copy a store and change one root attribute in both documents, with the right checksum; None removes it."""
    store = st.open_store(shutil.copytree(sound, path, dirs_exist_ok=True), "r+")
    attributes = copy.deepcopy(store.root_attributes)
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


@pytest.mark.parametrize("command", COMMANDS)
def test_root_attributes_of_the_wrong_type_are_one_sentence(
    command: str,
    described_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    wrong: dict[str, Any] = {
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
        "store.shard_samples": -1,
    }
    for key, value in wrong.items():
        path = tmp_path / f"{key}.zarr"
        _with_attributes(path, described_store, key, value)
        assert run(monkeypatch, *COMMANDS[command](path, described_store, tmp_path)) == 2, key
        text = said(capsys)
        assert text.startswith(f"{path}: is no vbnfault store: its root attributes are not those of one: {key}"), (
            text
        )


@pytest.mark.parametrize("key", ["scene", "scene.camera", "scene.body", "scene.dataset", "fault_models", "blocks"])
def test_a_store_that_lacks_a_table_of_its_scene_is_one_sentence(
    key: str,
    described_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "s.zarr"
    _with_attributes(path, described_store, key, None)
    for command in ("verify", "retake"):
        assert run(monkeypatch, *COMMANDS[command](path, described_store, tmp_path)) == 2
        assert said(capsys).startswith(f"{path}: its root attributes lack {key}, so its views are not known")
    for command in ("digest", "preview", "export", "report", "stats", "card", "migrate"):  # these need no plan
        assert run(monkeypatch, *COMMANDS[command](path, described_store, tmp_path)) == 0, capsys.readouterr().err


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
    command: str,
    code: int,
    sentence: str,
    described_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    half = st.open_store(shutil.copytree(described_store, tmp_path / "s.zarr"), "r+")
    half._write_done(0, set())
    half._write_done(1, {2})
    before = {name: content for name, content in tree(half.path).items() if "/c/" in name}
    assert run(monkeypatch, *COMMANDS[command](half.path, described_store, tmp_path)) == code
    if code:
        assert sentence in said(capsys)
    after = tree(half.path)
    assert {name: after[name] for name in before} == before


@pytest.mark.parametrize("command", ["preview", "export"])
def test_an_image_with_the_chunk_of_another_sample_is_named(
    command: str,
    described_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store = st.open_store(shutil.copytree(described_store, tmp_path / "s.zarr"), "r+")
    chunks = store.chunk("image", 1)
    store.file("image", 1).write_bytes(codec.join_shard({0: chunks[3], 1: chunks[3]}, 2))
    assert run(monkeypatch, *COMMANDS[command](store.path, described_store, tmp_path)) == 1
    sentence = "s.zarr: sample 2 does not match the stored crc32c of image; the build command repairs it"
    assert sentence in said(capsys)


def test_nothing_finished_is_a_sentence(
    described_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = st.open_store(described_store).spec
    begun = st.create(tmp_path / "s.zarr", spec, 6).path
    for command in ("preview", "report", "export"):
        assert run(monkeypatch, *COMMANDS[command](begun, described_store, tmp_path)) == 2
        assert "s.zarr: no sample is finished yet" in said(capsys)


@pytest.fixture
def copied(described_store: Path, tmp_path: Path) -> Path:
    """A copy of a finished store, to be damaged."""
    return Path(shutil.copytree(described_store, tmp_path / "s.zarr"))


@pytest.fixture
def refusal(
    described_store: Path, copied: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], str]:
    """What a command says of the copied store, which it refuses."""

    def of(command: str) -> str:
        assert run(monkeypatch, *COMMANDS[command](copied, described_store, copied.parent)) in (1, 2)
        return said(capsys)

    return of


@pytest.mark.parametrize("command", ["preview", "report", "export", "stats", "card"])
def test_a_store_that_lacks_what_marks_finished_samples_is_not_called_unfinished(
    command: str, copied: Path, refusal: Callable[[str], str]
) -> None:
    shutil.rmtree(copied / "done")
    before = tree(copied)
    assert "s.zarr: the array done, which marks the finished samples, is missing" in refusal(command)
    assert tree(copied) == before


@pytest.mark.parametrize("text", ["not json", "[]", "3", "[" * 100_000])
@pytest.mark.parametrize("command", ["stats", "card"])
def test_parameters_that_are_no_table_are_a_sentence(
    text: str, command: str, copied: Path, refusal: Callable[[str], str]
) -> None:
    zarr.open_group(copied, mode="r+")["parameters"][2] = text
    assert refusal(command).endswith(
        "s.zarr: sample 2: its parameters are damaged, they are no table in JSON; the build command repairs them"
    )


def test_a_report_warns_once_of_images_that_are_missing(copied: Path, tmp_path: Path) -> None:
    shutil.rmtree(copied / "image")
    with pytest.warns(UserWarning, match="image of sample") as warned:
        vbnfault.report(copied, tmp_path / "r.html")
    assert [str(one.message) for one in warned] == [
        f"{copied}: image of sample 5 cannot be read: the file image/c/2/0/0/0 is missing; the build command "
        "repairs it; the same is true of 5 samples more; the report shows no images"
    ]


def test_a_report_without_readable_scalars_does_not_call_the_store_unfinished(
    copied: Path, refusal: Callable[[str], str]
) -> None:
    shutil.rmtree(copied / "split")
    sentence = "s.zarr: the scalars of all 6 finished samples cannot be read, so there is nothing to show"
    assert refusal("report").endswith(sentence)


def test_the_digest_needs_every_array(copied: Path, refusal: Callable[[str], str]) -> None:
    (copied / "mask/zarr.json").write_bytes((copied / "mask/zarr.json").read_bytes()[:40])
    assert re.search(r"s\.zarr: array mask cannot be opened, .* the build command mends it$", refusal("digest"))


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


def _call(
    command: str, url: str, sound: Path, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, code: int
) -> str:
    """Return what a command says of a store in a bucket; its exit code must be `code`."""
    out.mkdir(exist_ok=True)
    assert run(monkeypatch, *COMMANDS[command](url, sound, out)) == code
    assert not [*out.iterdir()]
    return said(capsys)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_bucket_that_is_missing_or_refuses_is_one_sentence(
    command: str,
    stored: str,
    server: S3Server,
    described_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = described_store, tmp_path / "out", monkeypatch, capsys
    missing = _call(command, "s3://none/s.zarr", *given, code=2)
    assert missing == "s3://none/s.zarr: there is no such bucket; create it, or correct the URL"
    with server.counted() as requests:
        with server.failing(403, lambda method, path: "sound.zarr" in path):
            text = _call(command, stored, *given, code=1 if command == "merge into" else 2)
        assert "access is refused (403 Forbidden)" in text
        assert text.startswith(stored)
        with server.failing(503, lambda method, path: "sound.zarr" in path):
            text = _call(command, stored, *given, code=1)
        assert "503 Service Unavailable; nothing is lost" in text
    assert not [r for r in requests if r.method != "GET"]


@pytest.mark.parametrize("command", ["verify", "preview", "export", "report", "stats", "digest", "merge"])
def test_a_bucket_that_fails_in_the_middle_of_a_command(
    command: str,
    stored: str,
    server: S3Server,
    described_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with server.failing(503, lambda method, path: "/done/c/1" in path or "/image/c/1" in path) as refused:
        assert run(monkeypatch, *COMMANDS[command](stored, described_store, tmp_path)) in (0, 1)
    assert refused
    assert "cannot be read: 503 Service Unavailable; nothing is lost, repeat the command" in said(capsys)


@pytest.mark.parametrize(
    ("url", "variable"),
    [
        ("s3://b/s.zarr", "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true"),
        ("gs://b/s.zarr", "GOOGLE_SERVICE_ACCOUNT"),
        ("az://b/s.zarr", "AZURE_STORAGE_ACCOUNT_KEY"),
    ],
)
def test_missing_credentials_are_one_sentence(
    url: str, variable: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Obstore asks the cloud's machine for them; no answer is that of a machine elsewhere."""
    obstore = pytest.importorskip("obstore")
    asked = "Error performing PUT http://169.254.169.254/latest/api/token in 2 s - HTTP error"

    def refuse(*_: Any, **__: Any) -> None:
        raise obstore.exceptions.GenericError(asked)

    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "a")
    monkeypatch.setattr(obstore, "get", refuse)
    assert run(monkeypatch, "verify", url) == 2
    assert said(capsys) == f"{url}: no credentials were found; set {variable}" + (
        " for a public bucket" if "s3" in url else ""
    )
