"""Stores that a stranger may have made: names that are paths, files and chunks of any size, links, odd attributes.

Each is written with valid checksums, so that what opens it cannot take it for damage.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import struct
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tools.fuzz_inputs import NUMBERS, TEXTS, changed, hostile, places

from vbnfault.core.errors import VbnfaultError

NAMES = [
    "../../../pwned",
    "/pwned",
    "a/b",
    "..",
    ".",
    "",
    "a\0b",
    "a\nb: c",
    "<script>alert(1)</script>",
    "A b",
]
NAMES += [
    "a" * 300,
    "\u202ea",
    "con",
    "-rf",
    "mask_any",
    "{x}",
    "%s%n",
    "🦇",
    "a\\b",
    "sample",
    "image",
    "x" * 100_000,
]
_BOMB_BYTES = 6 << 30


def made_by_a_stranger(sound: Path, store: Path, rng: random.Random, private: Path) -> None:
    """Copy a store and do one to three things to it that its own writer never does."""
    shutil.copytree(sound, store)
    ways: list[Callable[[Path, random.Random, Path], None]] = [_rename, _rename, _attribute, _attribute, _resize]
    ways += [_sparse, _sparse, _bomb, _bomb, _link, _link, _text, _text, _index]
    for way in rng.sample(ways, rng.choice((1, 1, 1, 2, 3))):
        # what an earlier way has removed or spoilt
        with contextlib.suppress(OSError, LookupError, ValueError, TypeError, AttributeError, VbnfaultError):
            way(store, rng, private)


# Commands that may change the store itself.
WRITING = ("card", "migrate", "merge", "build")


def command(store: Path, sound: Path, out: Path, rng: random.Random) -> list[str]:
    """Return the arguments of a command that reads the store of a stranger, or writes to it."""
    scene = str(sound.parent / "seed.toml")
    formats = ("png", "coco", "yolo", "exr", "webdataset", "huggingface")
    commands: list[list[str]] = [
        ["verify", str(store)],
        ["digest", str(store)],
        ["stats", str(store), *rng.choice(([], ["--json"]))],
        ["card", str(store)],
        ["preview", str(store), "--out", str(out / "sheet.png")],
        ["report", str(store), "--out", str(out / "report.html")],
        *(["export", str(store), "--out", str(out / "e"), "--format", kind] for kind in rng.sample(formats, 3)),
        ["merge", str(store), "--out", str(out / "m.zarr")],
        ["merge", str(store), "--out", str(out / "m.zarr"), "--move"],
        ["merge", str(store), str(sound), "--out", str(out / "m.zarr")],
        ["merge", str(sound), "--out", str(store)],
        ["migrate", str(store), *rng.choice(([], ["--out", str(out / "g.zarr")]))],
        ["retake", str(store), "--scene", scene, "--out", str(out / "r.zarr"), "--dry-run"],
        ["build", scene, "--out", str(store), "--dry-run"],
        ["read", str(store)],
        ["view", str(store)],
    ]
    return rng.choice(commands)


def state(here: Path, arguments: list[str]) -> dict[str, tuple[int, bytes]]:
    """Return size and first bytes of all that a command may not change, by path: what is neither its output nor its
    store, and the names beside its output."""
    changing = ["out", *(["store.zarr"] if arguments[0] in WRITING else [])]
    seen = {}
    for path in sorted(p for p in here.rglob("*") if p.relative_to(here).parts[0] not in changing):
        content = b""
        if path.is_file() and not path.is_symlink():
            with path.open("rb") as file:
                content = file.read(64)
        seen[str(path)] = path.lstat().st_size if content else 0, content
    return seen


def escaped(here: Path, arguments: list[str]) -> str:
    """Return what a command has written where it may not, "" if nothing."""
    own = {Path(arguments[arguments.index("--out") + 1]).name} if "--out" in arguments else set()
    beside = {p.name for p in (here / "out").iterdir() if not p.name.startswith(tuple(f".{n}." for n in own))} - own
    beside |= {p.name for p in (*here.parent.iterdir(), *Path("/").iterdir()) if "pwned" in p.name}
    if beside:
        return f"files beside the output: {sorted(beside)}"
    for path in (here / "out").rglob("*"):
        if path.suffix == ".tar":
            with tarfile.open(path) as tar:
                if any("/" in name or ".." in name for name in tar.getnames()):
                    return f"{path}: members outside"
        elif path.suffix == ".html" and "<script>alert(" in path.read_text():
            return f"{path}: a script of the store"
        elif path.is_symlink():
            return f"{path}: a link"
    return ""


def read(path: str) -> None:
    """Read everything as a trainer does. Raises VbnfaultError."""
    from vbnfault.store import ShardReader, open_store
    from vbnfault.train import order, reader  # noqa: F401 - they must load

    store = open_store(path)
    files = ShardReader(store, [*store.spec.pixel_layers])
    for number in store.begun():
        finished = [i for i, done in store.done(number).items() if done]
        for fetched in files.fetch(number, finished).values():
            for name, row in store.spec.pixel_layers.items():
                files.decode(fetched, name, np.empty(store.spec.shape(row), row.dtype))
        for i in finished:
            store.read_sample(i)


def look(path: str) -> None:
    """Ask a viewer for everything that its page asks for."""
    from vbnfault.output.viewer import server
    from vbnfault.store import open_store

    viewer = server.Viewer(open_store(path))
    try:
        paths = ["api/store", "api/listing", "api/severity", *(f"api/sample/{i}" for i in (0, 1))]
        paths += [f"api/small/{i}" for i in (0, 1)] + ["api/layer/image/0", "api/layer/normal/1"]
        paths += [
            "zarr.json",
            "api/../zarr.json",
            "store/image/c/0/0/0/0",
            "api/layer/../image/0",
            "api/layer/split/0",
        ]
        for name in paths:
            with contextlib.suppress(VbnfaultError, server.Missing):
                assert b"precious" not in viewer.answer(name, {"masks": "1"})[0]
    finally:
        viewer.server.server_close()


# --- the ways -------------------------------------------------------------------------------------------------


def _content(path: Path) -> bytes:
    """Return the content of a file, which an earlier way may have made too large, or a link to a device."""
    if not path.is_file() or path.stat().st_size > 1 << 27:
        raise ValueError("no file, or too large")
    return path.read_bytes()


def _attributes(store: Path) -> dict[str, Any]:
    table: dict[str, Any] = json.loads(_content(store / "zarr.json"))["attributes"]
    return table


def _write(store: Path, attributes: dict[str, Any]) -> None:
    """Write root attributes, with their checksum, in both documents."""
    from vbnfault.store import layout

    attributes = layout.sealed(attributes)
    root = json.loads(_content(store / "zarr.json"))
    (store / "spare/zarr.json").write_bytes(layout.to_bytes(layout.group_document(attributes)))
    (store / "zarr.json").write_bytes(layout.to_bytes({**root, "attributes": attributes}))


def _rename(store: Path, rng: random.Random, _: Path) -> None:
    """Give a class, a layer, a list of names or a title another name, and rename what has it in the store."""
    attributes, name = _attributes(store), rng.choice(NAMES)
    key = rng.choice(
        ("faults", "faults", "layers", "soft_layers", "site_names", "lens_names", "mask_rules", "title")
    )
    if key == "title":
        attributes[rng.choice(("title", "licence", "description", "citation", "scene_hash", "created"))] = name
    elif attributes["store"][key]:
        names = attributes["store"][key]
        k = rng.randrange(len(names))
        old, names[k] = names[k], name
        if key == "faults":
            for other in ("mask_any_faults", "localised_faults", "layers"):
                values = attributes["store"][other] or []
                attributes["store"][other] = [v.replace(old, name) for v in values]
            for folder in store.glob(f"*{old}"):
                with contextlib.suppress(OSError, ValueError):
                    folder.rename(store / folder.name.replace(old, name))
    _write(store, attributes)


def _attribute(store: Path, rng: random.Random, _: Path) -> None:
    """Change some values anywhere in the root attributes, or in one of the documents."""
    if rng.random() < 0.7:
        attributes = _attributes(store)
        if rng.random() < 0.5:
            scene = attributes["scene"]
            scene |= {rng.choice(("trajectory", "spacecraft", "coma", "spice", "sky", "aim")): hostile(rng)}
        else:
            attributes = changed(attributes, rng)
        _write(store, attributes)
        return
    path = rng.choice(sorted(store.glob("*/zarr.json")))
    path.write_text(json.dumps(changed(json.loads(_content(path)), rng)))


def _resize(store: Path, rng: random.Random, _: Path) -> None:
    """Let the root attributes claim other sizes."""
    attributes = _attributes(store)
    number = rng.choice((*(n for n in NUMBERS if isinstance(n, int)), 10**7, 40_000, 17))
    key = rng.choice(
        ("height", "width", "shard_samples", "samples", "rendered_shape", "wavelength_nm", "format_version")
    )
    if key in ("samples", "format_version"):
        attributes[key] = number
    elif key == "wavelength_nm":
        attributes["store"][key] = [500.0] * rng.choice((0, 1, 100_000))
    else:
        attributes["store"][key] = [number, number] if key == "rendered_shape" else number
    _write(store, attributes)


def _files(store: Path) -> list[Path]:
    return sorted(p for p in store.rglob("*") if p.is_file() and not p.is_symlink())


def _sparse(store: Path, rng: random.Random, _: Path) -> None:
    """Let a file end far behind its content; it takes no place on the disk."""
    os.truncate(rng.choice(_files(store)), _BOMB_BYTES)


def zeros(size: int, claimed: int | None) -> bytes:
    """Return a Zstd frame of zeros that claims to hold so many; None: it says nothing.

    RFC 8878, sections 3.1.1.1 and 3.1.1.2: a block of the type RLE holds one byte and how often it is repeated.
    """
    head = b"\x28\xb5\x2f\xfd" + (b"\x00\x58" if claimed is None else b"\xc0\x58" + struct.pack("<Q", claimed))
    blocks = [min(1 << 17, size - start) for start in range(0, size, 1 << 17)]
    last = len(blocks) - 1
    return head + b"".join((n << 3 | 2 | (k == last)).to_bytes(3, "little") + b"\0" for k, n in enumerate(blocks))


def _bomb(store: Path, rng: random.Random, _: Path) -> None:
    """Put a chunk in the place of another that is far larger once it is decompressed."""
    from vbnfault.store import codec, compressors, open_store

    spec = open_store(store).spec
    size = rng.choice((1 << 20, 2 << 30, _BOMB_BYTES))
    if rng.random() < 0.7:
        claimed = rng.choice((None, size, 0, 1, 100, spec.height * spec.width * 4, 2**32, 2**63))
        chunk = zeros(size, claimed) * rng.choice((1, 1, 20))
    else:
        chunk = compressors.Compressor(1, "shuffle", 2).encode(np.zeros(64 << 20, np.uint8))
    if rng.random() < 0.5:
        name = rng.choice([*spec.pixel_layers])
        file = rng.choice(sorted(p for p in (store / name / "c").rglob("*") if p.is_file()))
        file.write_bytes(codec.join_shard(dict.fromkeys(range(spec.shard_samples), chunk), spec.shard_samples))
    else:
        rng.choice([p for p in _files(store) if "c" in p.parts]).write_bytes(chunk)


def _index(store: Path, rng: random.Random, _: Path) -> None:
    """Let the index of a shard name other places."""
    import google_crc32c

    from vbnfault.store import open_store

    spec = open_store(store).spec
    file = rng.choice([p for p in _files(store) if p.parent.name != "c" and "image" in p.parts and "c" in p.parts])
    data = bytearray(_content(file))
    table = np.frombuffer(bytes(data[-16 * spec.shard_samples - 4 : -4]), "<u8").copy()
    table[rng.randrange(len(table))] = rng.choice((0, 1, 2**31, 2**40, 2**63, 2**64 - 1, len(data)))
    data[-16 * spec.shard_samples - 4 :] = table.tobytes() + struct.pack("<I", google_crc32c.value(table.tobytes()))
    if rng.random() < 0.5:  # the places exist
        data[:0] = bytes(1 << 20)
    file.write_bytes(bytes(data))


def _link(store: Path, rng: random.Random, private: Path) -> None:
    """Put a link in the place of a file or of a folder: to a private folder, a device, or itself."""
    path = rng.choice(sorted(p for p in store.rglob("*")))
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
    path.symlink_to(
        rng.choice([private, private, private / "mine.txt", path, Path("/dev/zero"), Path("/dev/full")])
    )


def _text(store: Path, rng: random.Random, _: Path) -> None:
    """Write other texts into a column of texts, with a checksum that fits in one of two cases."""
    from vbnfault import store as stores
    from vbnfault.store import codec, layout

    opened = stores.open_store(store)
    name, number = rng.choice(("split", "parameters", "proposal")), rng.randrange(opened.shards)
    column = opened.column(name, number).copy()
    if name == "split":
        text = rng.choice([*NAMES, "other"])
    else:
        tables: list[Any] = [hostile(rng), {f: hostile(rng) for f in opened.spec.faults}, [[]] * 900]
        drawn = json.loads(str(column[0]) or "{}")
        tables += [changed(drawn, rng), changed(drawn, rng), dict.fromkeys(opened.spec.faults, drawn)]
        text = rng.choice([*TEXTS, "[" * 900 + "]" * 900, "{" + '"a":{' * 300, "NaN", "9" * 5000, '{"a": 1e999}'])
        if rng.random() < 0.7 and places(tables):
            text = json.dumps(rng.choice(tables))
    column[:] = text
    padded = np.full(opened.spec.shard_samples, "", dtype=object)
    padded[: len(column)] = column
    opened.file(name, number).write_bytes(layout.encode_values(padded))
    if rng.random() < 0.8:
        columns = {n: opened.column(n, number) for n in (*opened.spec.scalars, "crc32c") if n != name} | {
            name: column
        }
        crcs = np.zeros((opened.spec.shard_samples, len(opened.spec.checked)), np.uint32)
        crcs[: len(column)] = columns["crc32c"]
        for k in range(len(column)):
            crcs[k, -1] = codec.crc_of_scalars({n: columns[n][k] for n in opened.spec.scalars})
        opened.file("crc32c", number).write_bytes(layout.encode_values(crcs))
