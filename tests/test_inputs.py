"""Files and values that no user should give: each is refused in one short sentence, and nothing hangs on one."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import resource
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
import typer
from conftest import deny

from vbnfault import cli
from vbnfault.body import load_shape
from vbnfault.body.geometry import signed_volume
from vbnfault.core.errors import InputError, VbnfaultError, shown
from vbnfault.core.files import images, path_checks, resources, spice, user_files
from vbnfault.core.files.toml_files import read_toml
from vbnfault.core.files.whole_files import write_json, write_whole
from vbnfault.dataset.lock import locked
from vbnfault.detector.sensor import load_sensor
from vbnfault.faults import from_dict
from vbnfault.faults.levels import Levels
from vbnfault.lens import load_lens
from vbnfault.lens.prescription_file import write_lens
from vbnfault.output.starters import write_template
from vbnfault.scene import config
from vbnfault.study.severity import write_table
from vbnfault.world.spacecraft import load_spacecraft

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


@pytest.mark.parametrize("what", ["file", "folder"])
@pytest.mark.parametrize("kind", [*READERS, "kernel"])
def test_files_that_may_not_be_read_say_so(
    kind: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, suffix = READERS.get(kind, (lambda path: spice.kernels(path).__enter__(), ".tls"))
    path = tmp_path / f"mine{suffix}"
    path.write_text(TITLE)
    deny(monkeypatch, path if what == "file" else tmp_path)
    sentence = refused(read, path)
    assert str(path) in sentence
    assert "Permission denied" in sentence


def test_a_pipe_that_takes_the_place_of_a_file_does_not_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scene.toml"
    os.mkfifo(path)
    regular = os.stat(__file__)
    monkeypatch.setattr(path_checks, "file_status", lambda _: regular)  # as it was a moment ago
    with pytest.raises(InputError, match="is not a file but a pipe"):
        user_files.read_input(path, "scene")


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(TITLE * 100)
    status = os.stat_result((*os.stat(path)[:6], 5, *os.stat(path)[7:10]))  # 5 bytes, as it says
    monkeypatch.setattr(user_files.os, "fstat", lambda _: status)
    with pytest.raises(InputError, match="at most"):
        user_files.read_input(path, "scene", limit_bytes=64)


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


OTHER_KINDS: dict[str, tuple[bytes, str]] = {
    "a.seq": (b'RDM\nLEN NEW\nTITLE "x"\nS 50 3 N-BK7_SCHOTT\nGO\n', "a CODE V sequence file"),
    "b.seq": (b'! from CODE V\nRDM;LEN "VERSION: 10"\n', "a CODE V sequence file"),
    "no_suffix": (b'rdm; len "VERSION: 10"\n', "a CODE V sequence file"),
    "a.len": (b'// OSLO 6.1\nLEN NEW "x" 50 4\nEBR 5\n', "an OSLO lens file"),
    "b.len": (b"\0\1binary\xff", "an OSLO or CODE V lens file"),
    "a.zar": (b"\xea\0\0\0", "a Zemax archive"),
    "a.zos": (b"PK\3\4", "a ZIP archive"),
    "a.otx": (b"BEGIN OPTIX\n", "an OpTaliX lens file"),
    "a.csv": (b"a,b\n1,2\n", "a CSV table"),
    "named.toml": (b'{"a": 1}', "a JSON file"),
    "a.yml": (b"a: 1\n", "a YAML file"),
    "a.txt": ("VERS 1 2\nMODE SEQ\n".encode("utf-16"), "a Zemax lens file"),
    "a.tif": (b"II+\0", "an image"),
}


@pytest.mark.parametrize("kind", ["scene", "lens", "detector", "study"])
def test_a_file_of_another_kind_is_named(kind: str, tmp_path: Path) -> None:
    """The lens files of other programs are no broken TOML, whatever they are handed as."""
    for name, (data, what) in OTHER_KINDS.items():
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_toml(path, kind)
        lens_too = " or a Zemax lens file (.zmx)" if kind == "lens" else ""
        assert str(caught.value) == f"{path}: is {what}, which is not read; a {kind} is a TOML file{lens_too}"
    path = tmp_path / "broken.toml"
    path.write_text("a = [1, 2\n")
    with pytest.raises(InputError, match="not a TOML file: "):
        read_toml(path, kind)
    path = tmp_path / "good.len"  # a suffix alone says nothing
    path.write_text("a = 1")
    assert read_toml(path, kind) == {"a": 1}


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
    assert "30000 x 30000 pixels" in refused(texture, path)


# ------------------------------------------------------------------------------------ meshes

CUBE_V = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
SQUARES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
CUBE_F = SQUARES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
BOTH = pytest.mark.parametrize("load", [load_shape, load_spacecraft])


def obj(faces: np.ndarray, head: str = "# cube\n") -> str:
    rows = [f"v {x} {y} {z}" for x, y, z in 200 * CUBE_V] + [f"f {a} {b} {c}" for a, b, c in faces]
    return head + "\n".join(rows) + "\n"


def cube_of(load: Callable[[Path], Any], path: Path) -> tuple[np.ndarray, np.ndarray]:
    if load is load_shape:
        vertices, faces = load_shape(path)
    else:
        mesh = load_spacecraft(path, unit="cm").merged()
        vertices, faces = 100 * mesh.vertices_B_m, mesh.faces
    return vertices, faces


@BOTH
def test_an_obj_that_counts_from_zero_is_refused_by_line(load: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    path.write_text(obj(CUBE_F))
    assert "line 10: expected vertex numbers from 1 to 8, found 0" in refused(load, path)


@BOTH
def test_objs_in_other_words_are_the_same_body(load: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    path.write_text(obj(CUBE_F + 1))
    vertices, faces = cube_of(load, path)
    np.testing.assert_allclose(vertices, 200 * CUBE_V)
    np.testing.assert_array_equal(faces, CUBE_F)
    for text in (
        obj(CUBE_F - 8),  # counted back from the last vertex
        obj(CUBE_F + 1, "mtllib a.mtl\r\nvn 0 0 1\nvt 0 0\n").replace("\nf 1 2 4", "\nf 1/1/1 2//1 4/1"),
        obj(CUBE_F + 1).replace("\nf 1 2 4", "\nf 1 2 \\\n4"),
        obj(CUBE_F + 1).replace("0.0\n", "0.0 # a corner\n"),
        obj(CUBE_F[:0]) + "".join(f"f {a + 1} {b + 1} {c + 1} {d + 1}\n" for a, b, c, d in SQUARES),
    ):
        path.write_text(text)
        again = cube_of(load, path)
        np.testing.assert_allclose(again[0], vertices)
        assert len(again[1]) == 12
        assert signed_volume(*again) == pytest.approx(200.0**3, rel=1e-6)


@BOTH
def test_vertices_of_an_obj_have_three_numbers(load: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    for bad in ("v 200.0 0.0", "v 200.0 0.0 x", "v 1 nan 1", "v 1 inf 1", "v 1 2 3 4 5", "v 1e400 0 0"):
        path.write_text(obj(CUBE_F + 1).replace("v 200.0 0.0 0.0", bad, 1))
        assert f"line 6: expected 'v x y z', finite numbers, found {bad[2:]!r}" in refused(load, path)


def glb(nodes: list[dict[str, Any]], *, roots: list[Any] | None = None, **more: Any) -> bytes:
    """A GLB of the cube as mesh 0; what `more` holds replaces parts of its JSON."""
    blob = (200 * CUBE_V).astype("<f4").tobytes() + CUBE_F.astype("<u2").tobytes()
    table: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0] if roots is None else roots}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 8},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 36},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": 72},
        ],
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(table | more).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


@BOTH
def test_a_glb_is_read_through_its_nodes(load: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "cube.glb"
    half = np.sqrt(0.5)
    nodes = [
        {"children": [1]},
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [1, 1, -1]},
    ]  # turned, mirrored
    path.write_bytes(glb(nodes))
    vertices, faces = cube_of(load, path)
    assert signed_volume(vertices, faces) == pytest.approx(200.0**3, rel=1e-6)
    np.testing.assert_allclose(vertices.min(axis=0), [-200, 0, -200], atol=1e-4)
    np.testing.assert_allclose(vertices.max(axis=0), [0, 200, 0], atol=1e-4)


@BOTH
@pytest.mark.parametrize(
    ("data", "says"),
    [
        (glb([{"children": [1]}, {"children": [0], "mesh": 0}]), "below itself"),
        (glb([{"children": [0]}]), "below itself"),
        (glb([{"children": [k + 1]} for k in range(5000)] + [{"mesh": 0}]), "more than 64 nodes"),
        (glb([{"mesh": 0}] * 20_000, roots=list(range(20_000))), "10000 parts"),
        # each level has the next one twice: 2^40 cubes
        (glb([{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}]), "below two nodes"),
        (glb([{"mesh": 7}]), "mesh = 7"),
        (glb([{"mesh": 0}], roots=[-1]), "node = -1"),
        (glb([{"mesh": 0, "scale": [1e300, 1, 1]}]), "scale"),
        (
            glb(
                [{"mesh": 0}], accessors=[{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 10**9}]
            ),
            "count",
        ),
        (glb([{"mesh": 0}], bufferViews=[{"buffer": 0, "byteLength": 10**12}] * 2), "byteLength"),
        (glb([{"mesh": 0}], buffers=[{"uri": "/etc/passwd", "byteLength": 168}]), "in the folder of the"),
        (glb([{"mesh": 0}], buffers=[{"uri": "../cube.bin", "byteLength": 168}]), "in the folder of the"),
        (glb([{"mesh": 0}], extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (glb([{"mesh": 0}], meshes=[[[[]]]]), r"meshes\[0\]"),
        (glb([{"mesh": 0}], meshes=7), "meshes = 7"),
    ],
    ids=lambda value: "" if isinstance(value, bytes) else value,
)
def test_broken_glbs_name_what_is_wrong(
    load: Callable[[Path], Any], data: bytes, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "cube.glb"
    path.write_bytes(data)
    assert re.search(says, refused(load, path))


@BOTH
def test_images_of_a_glb_are_never_unpacked(load: Callable[[Path], Any], tmp_path: Path) -> None:
    image = base64.b64encode(png(60_000, 60_000)).decode()  # 3.6 gigapixel
    textured = {
        "images": [{"uri": f"data:image/png;base64,{image}"}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
    }
    path = tmp_path / "cube.glb"
    path.write_bytes(glb([{"mesh": 0}], **textured))
    assert len(cube_of(load, path)[1]) == 12


# ------------------------------------------------------------------------------------ SPICE


def test_a_kernel_that_aborts_native_code_is_refused(tmp_path: Path) -> None:
    from test_formats import lumpy, write_dsk

    path = write_dsk(tmp_path / "body.bds", *lumpy(1))
    load_shape(path)
    data = bytearray(path.read_bytes())
    data[1053] ^= 26  # in the first directory of the file: CSPICE's dlabfs aborts on it
    path.write_bytes(data)
    assert "SPICE" in refused(load_shape, path)


def test_a_vast_kernel_without_a_mark_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "vast.tls"
    path.touch()
    os.truncate(path, 1 << 32)  # a text, as its head says, of holes
    monkeypatch.setattr(user_files, "_sha256_of", lambda _: pytest.fail("4 GiB are read"))
    with pytest.raises(InputError, match=r"SPICE text kernel file has 4\.1e[+]03 MiB or more"), spice.kernels(path):
        pass


def test_a_meta_kernel_that_names_a_pipe_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tls")
    meta = tmp_path / "all.tm"
    meta.write_text(
        "KPL/MK\n\\begindata\nPATH_VALUES = ( '" + str(tmp_path) + "' )\nPATH_SYMBOLS = ( 'K' )\n"
        "KERNELS_TO_LOAD = ( '$K/pi+', 'pe.tls' )\n\\begintext\n"
    )
    with pytest.raises(InputError, match=r"pipe\.tls: SPICE kernel is not a file but a pipe"), spice.kernels(meta):
        pass
    meta.write_text("KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( '" + str(meta) + "' )\n")  # itself
    with pytest.raises(InputError, match=r"all\.tm: "), spice.kernels(meta):
        pass


# ------------------------------------------------------------------------------------ the command line


def command(*arguments: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """The program run with arguments; no traceback whatever happens."""
    given = [sys.executable, "-m", "vbnfault", *arguments]
    done = subprocess.run(given, text=True, check=False, **{"capture_output": True, **more})
    assert "Traceback" not in (done.stderr or ""), done.stderr
    return done


def test_a_full_disk_and_a_lost_folder_are_told_in_a_sentence(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = command("list", "lenses", capture_output=False, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 1
    assert done.stderr == "vbnfault: standard output: No space left on device\n"
    done = command("lens", "tessar_50_f2p8", "--json", "/dev/full", "--out", str(tmp_path / "a.png"))
    assert done.returncode == 1
    assert "/dev/full" in done.stderr
    done = command("list", "--help", env={**os.environ, "COLUMNS": str(2**31)})
    assert done.returncode == 0
    assert len(done.stdout) < 100_000
    gone = tmp_path / "gone"
    gone.mkdir()
    script = (
        "import os, sys; from vbnfault.cli import main; os.rmdir(os.getcwd()); sys.argv[1:] = ['list', 'lenses']; "
    )
    path = os.pathsep.join([str(Path(resources.__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", script + "main()"],
        cwd=gone,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "vbnfault: the working folder does not exist any more; change to another one\n"


@contextlib.contextmanager
def _files_of_at_most(size: int) -> Iterator[None]:
    """Let no file that is written become larger than this number of bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_lock_that_cannot_be_written_is_named_and_removed(tmp_path: Path) -> None:
    with (
        _files_of_at_most(0),
        pytest.raises(VbnfaultError, match=r"\.s\.zarr\.lock: cannot be written: File too large"),
        locked(tmp_path / "s.zarr"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_page_shows_a_file_name_that_is_no_unicode(tmp_path: Path) -> None:
    write_whole(tmp_path / "p.html", os.fsdecode(b"x\xff.zarr"))
    assert (tmp_path / "p.html").read_text(encoding="utf-8") == "x?.zarr"


NOISE = np.random.default_rng(1).integers(0, 256, (32, 32, 3), dtype=np.uint8)
WRITERS: dict[str, Callable[[Path], object]] = {
    "own.toml": lambda path: write_template("scene", path.stem, path.parent, overwrite=True),
    "table.json": lambda path: write_json(path, list(range(100))),
    "lens.toml": lambda path: write_lens(load_lens("tessar_50_f2p8"), path),
    "levels.toml": lambda path: write_table(path, Levels().table),
    "image.png": lambda path: images.write_png(path, NOISE),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_cannot_be_written_keeps_its_content(name: str, tmp_path: Path) -> None:
    path, write = tmp_path / name, WRITERS[name]
    path.write_text("mine")
    with _files_of_at_most(16), pytest.raises((OSError, VbnfaultError)):
        write(path)
    assert path.read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == [name]
    link = tmp_path / f"link{path.suffix}"
    link.symlink_to(name)
    if name != "own.toml":
        write(link)
        assert link.is_symlink()
        assert path.read_bytes() != b"mine"


def test_a_file_that_is_replaced_keeps_its_permissions_and_a_new_one_has_the_usual(tmp_path: Path) -> None:
    path, mask = tmp_path / "mine.txt", os.umask(0o027)
    try:
        write_whole(path, "new")
        assert path.stat().st_mode & 0o7777 == 0o640
        for mode in (0o600, 0o664, 0o444):
            path.chmod(mode)
            write_whole(path, f"{mode:o}")
            assert (path.stat().st_mode & 0o7777, path.read_text()) == (mode, f"{mode:o}")
    finally:
        os.umask(mask)


@pytest.mark.parametrize("key", ["body.shape", "body.albedo_map.file", "trajectory.file", "severity.file"])
def test_a_file_without_a_name_is_not_the_working_folder(key: str) -> None:
    with pytest.raises(InputError, match=rf"{key} = '': must be a string that is not empty"):
        config.load_scene("quickstart", {key: ""})


def test_texts_of_the_command_line_that_are_no_unicode_are_refused() -> None:
    for key in ("title", "body.shape", "dataset.citation"):
        with pytest.raises(InputError, match=rf"{key} = .*udcff.*: must be text in UTF-8"):
            config.load_scene("quickstart", {key: os.fsdecode(b"x\xff")})


def numeric_options() -> list[tuple[str, str, Any, set[type]]]:
    """(command, parameter, its option, its types) of every option that takes a number."""
    found = []
    for one in cli.app.registered_commands:
        for name, hint in get_type_hints(one.callback, include_extras=True).items():
            kind, option = get_args(hint) if hasattr(hint, "__metadata__") else (hint, None)
            kinds = {kind, *get_args(kind), *(k for part in get_args(kind) for k in get_args(part))}
            if {int, float} & kinds:
                found.append((str(one.callback.__name__), name, option, kinds))
    assert len(found) > 20
    return found


def test_every_number_of_the_command_line_has_both_limits_and_is_refused_beyond_them() -> None:
    for name, parameter, option, kinds in numeric_options():
        noun, kind = ("INTEGER", int) if int in kinds else ("NUMBER", float)
        limits = re.fullmatch(rf"{noun} \((\S+) to (\S+)\)", option.metavar or "")
        assert limits, (name, parameter)
        for good in limits.groups():
            assert option.parser(good) == kind(good), (name, parameter)
        low, high = map(kind, limits.groups())
        none = ["1.5", "1e3"] if kind is int else []
        for bad in (str(low - 1), str(2 * high + 1), "nan", "inf", "-inf", "1e400", "some", "", "1_0", "٣", *none):
            words = f"{bad!r} must be a {'whole ' * (kind is int)}number from {limits[1]} to {limits[2]}"
            with pytest.raises(typer.BadParameter, match=re.escape(words) + "$"):
                option.parser(bad)


@pytest.mark.parametrize("text", ["abc", "-1", "1.5", "9" * 400, "٣"])
def test_a_number_of_threads_that_is_none_is_refused(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from vbnfault.store import codec

    monkeypatch.setenv("VBNFAULT_THREADS", text)
    with pytest.raises(InputError, match=r"VBNFAULT_THREADS = .*: must be a whole number from 0 to 1024"):
        codec.threads()


# ------------------------------------------------------------------------------------ keys and their ranges


def test_every_number_of_a_scene_has_both_limits() -> None:
    root = config.Scene.model_json_schema()

    def walk(node: dict[str, Any], at: str) -> None:
        if "$ref" in node:
            walk(root["$defs"][node["$ref"].rsplit("/", 1)[-1]], at)
        if node.get("type") in ("number", "integer"):
            low, high = ("minimum", "exclusiveMinimum"), ("maximum", "exclusiveMaximum")
            if not (any(k in node for k in low) and any(k in node for k in high)):
                without.append(at)
        for key, value in node.get("properties", {}).items():
            walk(value, f"{at}.{key}")
        for value in [*node.get("anyOf", ()), *node.get("allOf", ()), *node.get("prefixItems", ())]:
            walk(value, at)
        for key in ("items", "additionalProperties"):
            if isinstance(node.get(key), dict):
                walk(node[key], at)

    without: list[str] = []
    walk(root, "")
    assert not without


def test_frames_that_no_memory_holds_are_refused() -> None:
    table = {"title": "t", "camera": {"width_px": 16384, "height_px": 16384}, "render": {"bands": 64}}
    with pytest.raises(InputError, match=r"camera\.width_px = 16384, .*render\.bands = 64: .*at most 268435456"):
        config.parse_scene(table, source="scene.toml")


def test_every_enumerated_key_of_a_scene_takes_each_of_its_options() -> None:
    """... as itself, and nothing else."""
    root = config.Scene.model_json_schema()
    tried = 0

    def walk(node: dict[str, Any], path: tuple[str, ...]) -> None:
        nonlocal tried
        if "$ref" in node:
            node = root["$defs"][node["$ref"].rsplit("/", 1)[-1]]
        for key, value in node.get("properties", {}).items():
            walk(value, (*path, key))
        many = node.get("type") == "array"
        options = (node.get("items", {}) if many else node).get("enum", ())
        for option in (*options, *(("no such word",) if options else ())):
            table: dict[str, Any] = {"title": "t"}
            inner = table
            for key in path[:-1]:
                inner = inner.setdefault(key, {})
            inner[path[-1]] = [option] if many else option
            table.setdefault("camera", {})["lens"] = "tessar_50_f2p8"  # which some options need
            if option == "no such word":
                with pytest.raises(InputError, match=rf"{path[-1]}.* = 'no such word': must be "):
                    config.parse_scene(table, source="scene.toml")
                continue
            found: Any = config.parse_scene(table, source="scene.toml")
            for key in path:
                found = getattr(found, key)
            assert found == ((option,) if many else option)
            tried += 1

    walk(root, ())
    assert tried >= 20
