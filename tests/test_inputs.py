"""Files and values that no user should give: each is refused in one short sentence, and nothing hangs on one."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vbnfault import config, resources
from vbnfault.body import load_shape
from vbnfault.detector.sensor import load_sensor
from vbnfault.errors import InputError, VbnfaultError, shown
from vbnfault.faults import from_dict
from vbnfault.lens import load_lens
from vbnfault.spacecraft import load_spacecraft

TITLE = 'title = "t"\n'


def texture(path: Path) -> None:
    from_dict("pixel_overwriting", {"texture_file": str(path)}, source="scene.toml")


# Kind of input → what reads it, and a suffix of it.
READERS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "scene": (config.load_scene, ".toml"),
    "lens": (load_lens, ".toml"),
    "detector": (load_sensor, ".toml"),
    "shape": (load_shape, ".obj"),
    "plates": (load_shape, ".tab"),
    "spacecraft": (load_spacecraft, ".glb"),
    "texture": (texture, ".png"),
}


def refused(read: Callable[[Path], Any], path: Path) -> str:
    """The one sentence with which a reader refuses a file."""
    with pytest.raises(InputError) as caught:
        read(path)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert len(sentence) <= 2200
    return sentence


@pytest.mark.parametrize("kind", READERS)
def test_only_regular_files_of_a_size_are_read(kind: str, tmp_path: Path) -> None:
    read, suffix = READERS[kind]
    pipe = tmp_path / f"pipe{suffix}"
    os.mkfifo(pipe)  # an open for reading would wait for a writer for ever
    device = tmp_path / f"device{suffix}"
    device.symlink_to("/dev/zero")  # never ends
    folder = tmp_path / f"folder{suffix}"
    folder.mkdir()
    for path, what in ((pipe, "a pipe"), (device, "a device"), (folder, "a folder")):
        sentence = refused(read, path)
        assert what in sentence
        assert str(path) in sentence
    huge = tmp_path / f"huge{suffix}"
    huge.touch()
    os.truncate(huge, (1 << 40))  # of holes: no disk holds it
    assert "MiB" in refused(read, huge)
    empty = tmp_path / f"empty{suffix}"
    empty.touch()
    assert "is empty" in refused(read, empty)
    for name in ("a" * 300 + suffix, "a\0b" + suffix, "/".join(["a" * 200] * 30) + suffix):
        refused(read, tmp_path / name)
    loop = tmp_path / f"loop{suffix}"
    loop.symlink_to(loop)
    refused(read, loop)


def test_a_pipe_that_takes_the_place_of_a_file_does_not_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scene.toml"
    os.mkfifo(path)
    regular = os.stat(__file__)
    monkeypatch.setattr(resources, "file_status", lambda _: regular)  # as it was a moment ago
    with pytest.raises(InputError, match="is not a file but a pipe"):
        resources.read_input(path, "scene")


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(TITLE * 100)
    status = os.stat_result((*os.stat(path)[:6], 5, *os.stat(path)[7:10]))  # 5 bytes, as it says
    monkeypatch.setattr(resources.os, "fstat", lambda _: status)
    with pytest.raises(InputError, match="at most"):
        resources.read_input(path, "scene", limit_bytes=64)


@pytest.mark.parametrize(
    "text",
    [
        f"a = {'[' * 5000}{']' * 5000}",
        f"a = {'{b=' * 5000}1{'}' * 5000}",
        f"{'.'.join('a' * 5000)} = 1",
        f"[{'.'.join('a' * 5000)}]",
        f"a = 1{'0' * 400}",
        f"a = 1{'0' * 10_000}",
        f"a = 0x1{'0' * 10_000}",
        "a = 9999-99-99",
        f'a = "{"x" * 3_000_000}"',
        f"{'x' * 1_000_000} = 1",
    ],
    ids=["lists", "tables", "keys", "table", "401 digits", "10^4 digits", "hex", "date", "text", "key"],
)
@pytest.mark.parametrize("kind", ["scene", "lens", "detector"])
def test_odd_toml_is_refused_in_one_short_sentence(kind: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.toml"
    path.write_text(text)
    assert refused(READERS[kind][0], path).startswith(f"{path}: ")


@pytest.mark.parametrize("key", ["body.shape", "spacecraft.model", "camera.lens", "camera.detector"])
@pytest.mark.parametrize("name", ["a\0b.obj", "n" * 300 + ".obj", "n" * 1_000_000 + ".obj"])
def test_impossible_paths_name_their_key(key: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(TITLE)
    with pytest.raises(InputError) as caught:
        config.load_scene(path, {key: name})
    assert key in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_errors_shorten_what_they_show() -> None:
    assert shown(3.5) == "3.5"
    assert shown("short") == "'short'"
    for value in ("x" * 10**7, [1] * 10**6, b"\xff" * 10**6, {"k": "y" * 10**6}):
        assert len(shown(value)) < 200
    assert shown(10**400).startswith("1000")
    assert "digits" in shown(10**5000)
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    assert len(shown(deep)) < 200
    long = str(VbnfaultError("a.toml: key = " + "x" * 10**7 + ": must be from 1 to 2"))
    assert len(long) < 2200
    assert long.startswith("a.toml: key")
    assert "must be from 1 to 2" in long


def png(width: int, height: int) -> bytes:
    """A PNG of few bytes whose header says any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def tiff(width: int, height: int) -> bytes:
    """The header of a TIFF of any size."""
    entries = [(256, 4, 1, width), (257, 4, 1, height)]
    rows = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + rows + bytes(4)


@pytest.mark.parametrize("data", [png(30_000, 30_000), tiff(30_000, 30_000)], ids=["png", "tiff"])
def test_vast_textures_are_refused_unread(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(data)
    assert "30000 × 30000 pixels" in refused(texture, path)
