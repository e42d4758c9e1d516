"""Run the program on many malformed inputs: `python -m tests.fuzz --count 5000 --seed 7`.

Each case damages a valid input: a scene, lens or sensor file, a mesh of any format, a spacecraft, a texture, a
SPICE kernel or DSK, options and environment variables, or a store. The program then runs as from the command line.
It may succeed or refuse the input: exit code 0, 1 or 2, with a short message if it is not 0. A case fails if it
ends with a traceback or a signal, or uses more than 20 s of processor time or 2 GiB of memory. A failure is printed
with the command that repeats it (`--only N`).

A few processes run all cases, so that the imports are paid once; a process that dies is replaced. A case depends
only on the seed and its number. The default seed is a hash of the package's sources.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import copy
import hashlib
import io
import json
import math
import os
import random
import resource
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CPU_S = 20
MEMORY_BYTES = 2 << 30
# Limit for a case that waits without using the processor, for example for a pipe. It is far longer than any wait
# on a busy machine.
BLOCKED_S = 600
LONGEST_MESSAGE = 3000

TEXTS = [
    "",
    " ",
    "x" * 100_000,
    "n" * 300 + ".toml",
    "a\0b",
    "\u202e\U0001f600",
    "..",
    "/",
    "/dev/zero",
    "/dev/null",
]
TEXTS += ["/proc/self/mem", "nan", "67p", "auto", "traced", "none", "\n", "%s%n", "$HOME", "../../x.obj"]
NUMBERS = [
    0,
    1,
    -1,
    2,
    3,
    7,
    1e9,
    1e-9,
    255,
    256,
    65536,
    2**31,
    2**63 - 1,
    2**63,
    2**64,
    10**30,
    10**400,
    -(10**400),
]
NUMBERS += [1e150, -1e150, 1e308, 5e-324, math.nan, math.inf, -math.inf, 0.5, -0.0, 1e6, 90, 360, 1.0000001]


def deep(levels: int) -> Any:
    """Return nested lists."""
    node: Any = []
    for _ in range(levels):
        node = [node]
    return node


def hostile(rng: random.Random) -> Any:
    """Return a random value that a key may not expect."""
    kind = rng.random()
    if kind < 0.5:
        return rng.choice(NUMBERS)
    if kind < 0.75:
        return rng.choice(TEXTS)
    plain = [True, False, [], {}, [[]], [1, 2], [3, 1], [math.nan] * 3, {"a": 1}, deep(30), deep(200), [0] * 5000]
    return copy.deepcopy(rng.choice(plain))


def places(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths (tuples of keys and indices) of all values in plain data."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    found = []
    for key, value in items:
        found += [(*path, key), *places(value, (*path, key))]
    return found


def changed(table: Any, rng: random.Random) -> Any:
    """Return plain data with one to three changes: a value deleted, renamed, repeated, scaled or replaced."""
    table = copy.deepcopy(table)
    for _ in range(rng.choice((1, 1, 2, 3))):
        where = places(table)
        if not where:
            break
        *above, key = rng.choice(where)
        node = table
        for part in above:
            node = node[part]
        action = rng.random()
        if action < 0.15:
            del node[key]
        elif action < 0.22 and isinstance(node, dict):
            node[rng.choice(["x", "Name", "", "\0", "k" * 300, f"{key}s"])] = node.pop(key)
        elif action < 0.3 and isinstance(node, list):
            node.extend(copy.deepcopy(node) * rng.choice((1, 3, 50)))
        elif action < 0.4 and type(node[key]) in (int, float):
            with contextlib.suppress(OverflowError):
                node[key] = node[key] * rng.choice((-1, 0, 10, 1e3, 1e-3, 1e12, 1 + 1e-12))
        elif action < 0.45:
            node[key] = copy.deepcopy(table)
        else:
            node[key] = hostile(rng)
    return table


def flipped(data: bytes, rng: random.Random, other: bytes = b"") -> bytes:
    """Return damaged bytes: changed, cut, spliced with `other`, zeroed, repeated, or with odd words inserted."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        at = rng.randrange(len(out) + 1)
        length = rng.choice((1, 1, 2, 4, 8, 64, 512))
        action = rng.randrange(9)
        if action <= 2:
            for k in range(at, min(at + rng.choice((1, 1, 4)), len(out))):
                out[k] = rng.randrange(256)
        elif action == 3:
            del out[at:]
        elif action == 4:
            del out[at : at + length]
        elif action == 5:
            out[at : at + length] = bytes(length)
        elif action == 6:
            start = rng.randrange(len(other) + 1)
            out[at:at] = other[start : start + length]
        elif action == 7:
            out[at:at] = out[max(0, at - length) : at] * rng.choice((1, 3, 100))
        else:
            words = [b"nan", b"1e400", b"-1", b"0", b"9" * 400, b"\xff" * 8, b"\0" * 9, b"\n", b'"', b"[" * 3000]
            out[at:at] = rng.choice(words)
    return bytes(out)


def toml_value(value: Any) -> str:
    """Return a value as TOML text; for some values it is only similar to TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(str(k))} = {toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, int) and abs(value) > 10**300:
        return f"{'-' if value < 0 else ''}1{'0' * 400}"
    return json.dumps(value)


def toml(table: dict[str, Any]) -> bytes:
    """Return plain data as the bytes of a TOML file."""
    lines = [f"{json.dumps(str(key))} = {toml_value(value)}" for key, value in table.items()]
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")


def any_toml(table: dict[str, Any], rng: random.Random) -> bytes:
    """Return a damaged TOML file: in three of four cases with damaged values, otherwise with damaged text."""
    if rng.random() < 0.75:
        return toml(changed(table, rng))
    return flipped(toml(table), rng, toml(table))


# --- valid inputs ---------------------------------------------------------------------------------------------


class Seeds:
    """Valid inputs, made once in `folder`; the cases damage them."""

    def __init__(self, folder: Path) -> None:
        sys.path.insert(0, str(ROOT / "tests"))
        from conftest import small_scene

        self.folder = folder
        scene = small_scene(dataset={"samples": 8, "sites": 2})
        scene["body"] = {"shape": "ellipsoid", "semi_axes_m": [200.0, 150.0, 120.0], "unit": "m"}
        self.scene: dict[str, Any] = scene
        packaged = ROOT / "scenes"
        self.scenes = [scene, *(tomllib.loads(p.read_text()) for p in sorted(packaged.glob("*.toml")))]
        self.lenses = [tomllib.loads(p.read_text()) for p in sorted((packaged / "lenses").glob("*.toml"))]
        self.sensors = [tomllib.loads(p.read_text()) for p in sorted((packaged / "detectors").glob("*.toml"))]
        self.store = folder / "seed.zarr"
        self.meshes = _meshes(folder)
        self.kernels = _kernels(folder)
        self.textures = _textures()

    def build(self) -> None:
        """Build the store that `case_store` damages; it has two small samples."""
        path = self.folder / "seed.toml"
        path.write_bytes(toml({**self.scene, "dataset": {**self.scene["dataset"], "samples": 2, "sites": 1}}))
        done = run(["build", str(path), "--out", str(self.store)])
        if done[0] != 0:
            raise SystemExit(f"the store to be damaged cannot be built: {done[1]}")


def _meshes(folder: Path) -> dict[str, bytes]:
    """Return a small valid mesh in every format, by file name."""
    import numpy as np
    import trimesh
    from test_formats import both_counts, letters, lumpy, vrml1, vrml2

    v, f = lumpy(1)
    mesh = trimesh.Trimesh(v, f, process=False)
    quads = b"o a\ng b\nusemtl c\n" + bytes(mesh.export(file_type="obj"), "utf-8")
    found = {
        "a.obj": quads,
        "b.obj": letters(v, f).encode(),
        "a.tab": both_counts(v, f).encode(),
        "a.ver": both_counts(v, f).encode(),
        "a.wrl": vrml2(v, f).encode(),
        "b.wrl": vrml1(v, f).encode(),
        "a.ply": mesh.export(file_type="ply"),
        "b.ply": mesh.export(file_type="ply", encoding="ascii"),
        "a.stl": mesh.export(file_type="stl"),
        "b.stl": mesh.export(file_type="stl_ascii").encode(),
        "a.glb": mesh.export(file_type="glb"),
    }
    q = 2
    grid = np.random.default_rng(1).normal(size=(6 * (q + 1) ** 2, 3))
    found["a.icq"] = (f"{q}\n" + "\n".join(" ".join(f"{x:.5f}" for x in row) for row in grid)).encode()
    blob = v.astype("<f4").tobytes() + f.astype("<u4").tobytes()
    gltf = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1, 2]}, {"mesh": 0, "name": "a", "scale": [1, 2, 1]}, {"children": []}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0, "mode": 4}]}],
        "materials": [{"name": "gold_mli"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(v), "byteOffset": 0},
            {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": 3 * len(f)},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 12 * len(v), "byteStride": 12},
            {"buffer": 0, "byteOffset": 12 * len(v), "byteLength": 12 * len(f)},
        ],
        "buffers": [
            {
                "byteLength": len(blob),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(blob).decode(),
            }
        ],
    }
    found["a.gltf"] = json.dumps(gltf).encode()
    with contextlib.suppress(ImportError):
        from test_formats import write_dsk

        path = folder / "seed.bds"
        path.unlink(missing_ok=True)
        found["a.bds"] = write_dsk(path, v, f).read_bytes()
    return found


def _kernels(folder: Path) -> dict[str, bytes]:
    """Return small valid SPICE kernels by file name; the meta-kernel refers to a file in `folder`."""
    text = (
        "KPL/PCK\n\\begindata\nBODY399_RADII = ( 6378.1 6378.1 6356.8 )\nBODY399_PM = ( 190.147 360.9 0. )\n"
        "BODY399_POLE_RA = ( 0. -0.641 0. )\nBODY399_POLE_DEC = ( 90. -0.557 0. )\n\\begintext\n"
    )
    leap = (
        "KPL/LSK\n\\begindata\nDELTET/DELTA_T_A = 32.184\nDELTET/K = 1.657D-3\nDELTET/EB = 1.671D-2\n"
        "DELTET/M = ( 6.239996 1.99096871D-7 )\nDELTET/DELTA_AT = ( 10, @1972-JAN-1 37, @2017-JAN-1 )\n"
    )
    meta = f"KPL/MK\n\\begindata\nPATH_VALUES = ( '{folder}' )\nPATH_SYMBOLS = ( 'K' )\n"
    found = {"a.tpc": text.encode(), "a.tls": leap.encode()}
    (folder / "sound.tls").write_bytes(leap.encode())
    found["a.tm"] = (meta + "KERNELS_TO_LOAD = ( '$K/sound+', '.tls' )\n\\begintext\n").encode()
    with contextlib.suppress(ImportError):
        import numpy as np
        import spiceypy

        path = folder / "seed.bsp"
        path.unlink(missing_ok=True)
        handle = spiceypy.spkopn(str(path), "test", 0)
        times = np.linspace(-1e8, 1e9, 30)
        states = np.random.default_rng(2).normal(1e8, 1e7, (30, 6))
        spiceypy.spkw13(handle, 1000012, 10, "J2000", times[0], times[-1], "a", 7, 30, states, times)
        spiceypy.spkcls(handle)
        found["a.bsp"] = path.read_bytes()
    return found


def _textures() -> dict[str, bytes]:
    """Return small valid images by file name."""
    import cv2
    import numpy as np

    rng = np.random.default_rng(3)
    found = {}
    for name, shape, dtype in (("a.png", (9, 7, 3), "u1"), ("b.png", (8, 8, 4), "u2"), ("a.tif", (6, 5), "u2")):
        image = rng.integers(0, 255, shape).astype(dtype)
        found[name] = cv2.imencode(name[-4:], image)[1].tobytes()
    return found


# --- cases ----------------------------------------------------------------------------------------------------

Case = tuple[list[str], dict[str, str]]  # arguments, and environment variables


def dry(scene: Path, *settings: str) -> list[str]:
    """Return the arguments of a dry run of a scene, with `--set` for each setting."""
    out = str(scene.parent / "out.zarr")
    return ["build", str(scene), "--out", out, "--dry-run", *(x for s in settings for x in ("--set", s))]


def case_scene(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a scene file: the small one or a packaged one."""
    table = rng.choice([seeds.scene, seeds.scene, *seeds.scenes])
    path = here / "scene.toml"
    path.write_bytes(any_toml(table, rng))
    return dry(path), {}


def _whole_scene(seeds: Seeds, here: Path, **tables: Any) -> Path:
    """Write the small valid scene with some tables replaced; return its path."""
    path = here / "scene.toml"
    path.write_bytes(toml({**seeds.scene, **tables}))
    return path


def case_fault(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Give one or two keys of a fault model unexpected values."""
    from vbnfault import faults

    models = [(name, model, kind) for name, of in faults.registry().items() for model, kind in of.items()]
    name, model, kind = rng.choice(models)
    keys = list(kind.__dataclass_fields__)
    table = {"model": model, **{key: hostile(rng) for key in rng.sample(keys, min(len(keys), rng.choice((1, 2))))}}
    return dry(_whole_scene(seeds, here, faults={name: table})), {}


def case_lens(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a lens file; run `lens` on it, or a scene that uses it."""
    path = here / "lens.toml"
    path.write_bytes(any_toml(rng.choice(seeds.lenses), rng))
    if rng.random() < 0.5:
        return ["lens", str(path), "--out", str(here / "lens.png")], {}
    camera = {**seeds.scene["camera"], "lens": str(path)}
    return dry(_whole_scene(seeds, here, camera=camera, faults={})), {}


def case_sensor(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a sensor file that a scene uses."""
    path = here / "sensor.toml"
    path.write_bytes(any_toml(rng.choice(seeds.sensors), rng))
    camera = {**seeds.scene["camera"], "detector": str(path)}
    return dry(_whole_scene(seeds, here, camera=camera, faults={"cosmic_rays": {}})), {}


def _damaged_mesh(name: str, data: bytes, rng: random.Random, seeds: Seeds) -> bytes:
    """Return a damaged mesh file: in most cases with damaged values, otherwise with damaged bytes."""
    if rng.random() < 0.6:
        if name.endswith(".gltf"):
            return json.dumps(changed(json.loads(data), rng)).encode()
        if name.endswith(".glb"):
            (length,) = struct.unpack_from("<I", data, 12)
            text = json.dumps(changed(json.loads(data[20 : 20 + length]), rng)).encode()
            text += b" " * (-len(text) % 4)
            return (
                data[:8]
                + struct.pack("<IIII", 20 + len(text), 0, len(text), 0x4E4F534A)[:4]
                + struct.pack("<I4s", len(text), b"JSON")
                + text
                + data[20 + length :]
            )
        if not name.endswith((".ply", ".stl", ".bds")):
            rows = data.decode().split("\n")
            for _ in range(rng.choice((1, 1, 3))):
                k = rng.randrange(len(rows))
                words = rows[k].split(" ")
                words[rng.randrange(len(words))] = str(
                    rng.choice([*NUMBERS[:16], "x", "nan", "", "1/2/3", "-1", 1e150])
                )
                rows[k] = " ".join(words)
            return "\n".join(rows).encode()
    return flipped(data, rng, rng.choice(list(seeds.meshes.values())))


def case_mesh(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage the shape of the body."""
    # a DSK is read in a process of its own, which takes time: choose it less often
    name = rng.choice([n for n in seeds.meshes if n != "a.bds" or rng.random() < 0.3])
    path = here / name
    path.write_bytes(_damaged_mesh(name, seeds.meshes[name], rng, seeds))
    body = {"shape": str(path), "unit": rng.choice(("auto", "m", "km"))}
    return dry(_whole_scene(seeds, here, body=body)), {}


def case_spacecraft(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage the model of the spacecraft, and at times its table in the scene."""
    name = rng.choice(("a.obj", "b.obj", "a.glb", "a.gltf"))
    path = here / name
    path.write_bytes(_damaged_mesh(name, seeds.meshes[name], rng, seeds))
    craft: dict[str, Any] = {"model": str(path), "unit": "m", "default_material": "gold_mli"}
    if rng.random() < 0.2:
        craft = changed(
            {**craft, "translation_m": [0, 0, 1], "pose": {"a": {"hinge_m": [0, 0, 0], "axis": [1, 0, 0]}}}, rng
        )
    return dry(_whole_scene(seeds, here, spacecraft=craft)), {}


def case_texture(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage the texture of a fault."""
    name = rng.choice(list(seeds.textures))
    path = here / name
    path.write_bytes(flipped(seeds.textures[name], rng, seeds.textures["a.png"]))
    faults = {"pixel_overwriting": {"texture_file": str(path), "blend": "add"}}
    return dry(_whole_scene(seeds, here, faults=faults)), {}


def case_kernel(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage one of the SPICE kernels, and at times their table in the scene."""
    paths = []
    broken = rng.choice(list(seeds.kernels))
    for name, data in seeds.kernels.items():
        path = here / name
        path.write_bytes(flipped(data, rng, data) if name == broken else data)
        paths.append(str(path))
    table: dict[str, Any] = {"kernels": paths, "target": "1000012"}
    if rng.random() < 0.3:
        table = changed({**table, "frame": "IAU_EARTH"}, rng)
    return dry(_whole_scene(seeds, here, spice=table)), {}


def case_special(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Replace an input file by a pipe, device, folder, circular link or sparse file, or give a bad name."""
    key, suffix = rng.choice(
        [
            ("body.shape", ".obj"),
            ("spacecraft.model", ".glb"),
            ("camera.lens", ".toml"),
            ("camera.detector", ".toml"),
            ("faults.pixel_overwriting.texture_file", ".png"),
            ("spice.kernels", ".tls"),
            ("", ".toml"),
        ]
    )
    path = here / f"special{suffix}"
    kind = rng.randrange(7)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.symlink_to(
            rng.choice(("/dev/zero", "/dev/null", "/dev/urandom", "/proc/self/mem", "/proc/kmsg", "/dev/tty"))
        )
    elif kind == 2:
        path.mkdir()
    elif kind == 3:
        path.symlink_to(path)
    elif kind == 4:
        path.touch()
        os.truncate(path, rng.choice((0, 1, 1 << 20, 1 << 28, 1 << 36, 1 << 42)))
    elif kind == 5:
        path = here / ("n" * rng.choice((251, 260, 5000)) + suffix)
    if not key:
        return dry(path), {}
    value = toml_value([str(path)] if key == "spice.kernels" else str(path))
    return dry(_whole_scene(seeds, here), f"{key}={value}"), {}


def case_options(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Give unexpected options and environment variables to several commands; the work itself stays small."""
    scene = str(_whole_scene(seeds, here))
    out = str(here / "out")
    sound: dict[str, list[str]] = {
        "build": ["build", scene, "--out", out + ".zarr", "--dry-run"],
        "verify": ["verify", str(seeds.store)],
        "digest": ["digest", str(seeds.store)],
        "preview": ["preview", str(seeds.store), "--out", out + ".png"],
        "lens": ["lens", "tessar_50_f2p8", "--out", out + ".png"],
        "flare": [
            "flare",
            "tessar_50_f2p8",
            "--out",
            out + ".png",
            "--sun-deg",
            "10",
            "--pixels",
            "16",
            "--model",
            "paraxial",
            "--wavelength-nm",
            "550",
        ],
        "list": ["list", "scenes"],
    }
    name = rng.choice(list(sound))
    arguments = sound[name]
    options = {
        "build": ["--samples", "--seed", "--workers", "--threads", "--append", "--set", "--out", "--scheduler"],
        "preview": ["--samples", "--out"],
        "lens": ["--vary-seed", "--spread", "--json", "--toml", "--out"],
        "flare": [
            "--sun-deg",
            "--azimuth-deg",
            "--model",
            "--wavelength-nm",
            "--json",
            "--coating",
            "--focal-length-mm",
            "--fov-deg",
            "--sun-distance-au",
            "--reflections",
            "--roughness-nm",
            "--cleanliness-level",
        ],
    }.get(name, ["--help", "--nonsense"])
    values = [str(v) if not isinstance(v, int) or abs(v) < 10**300 else "1" + "0" * 400 for v in NUMBERS]
    values += [text.replace("\0", "") for text in TEXTS] + [
        f"{out}/a/b.png",
        "/dev/full",
        str(here),
        "a.b.c=1",
        "=",
        "x=",
    ]
    keys = [".".join(map(str, path)) for path in places(seeds.scene)]
    for _ in range(rng.choice((1, 1, 2))):
        option, value = rng.choice(options), rng.choice(values)
        if option == "--set":
            value = f"{rng.choice(keys)}={rng.choice([*values, '[' * 3000, '9' * 5000, '{a=1}'])}"
        arguments = [*arguments, option, value]
    if rng.random() < 0.1:
        del arguments[rng.randrange(len(arguments))]
        if "--dry-run" not in arguments and arguments[:1] == ["build"]:
            arguments.append("--dry-run")
    variables = {}
    if rng.random() < 0.3:
        names = ("VBNFAULT_THREADS", "VBNFAULT_CACHE_GIB", "VBNFAULT_CACHE_DIR", "COLUMNS")
        variables[rng.choice(names)] = rng.choice([v for v in values if len(v) < 10_000])
    return arguments, variables


def case_store(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage one or two files of a store."""
    store = here / "store.zarr"
    shutil.copytree(seeds.store, store)
    files = sorted(p for p in store.rglob("*") if p.is_file())
    described = [p for p in files if p.suffix == ".json"]
    for _ in range(rng.choice((1, 1, 2))):
        path = rng.choice(described if rng.random() < 0.7 else files)
        if rng.random() < 0.5 and path.suffix == ".json":
            with contextlib.suppress(ValueError):
                path.write_text(json.dumps(changed(json.loads(path.read_bytes()), rng)))
        elif rng.random() < 0.15:
            path.unlink()
            action = rng.randrange(4)
            if action == 1:
                path.mkdir()
            elif action == 2:
                os.mkfifo(path)
            elif action == 3:
                path.symlink_to("/dev/zero")
        else:
            path.write_bytes(flipped(path.read_bytes(), rng))
        files = [p for p in files if p.is_file()]
        described = [p for p in described if p.is_file()]
    command = rng.choice(("verify", "verify", "preview", "digest"))
    return [command, str(store), *(["--out", str(here / "sheet.png")] if command == "preview" else [])], {}


CASES: dict[str, tuple[Callable[[Seeds, random.Random, Path], Case], int]] = {  # function, percentage of cases
    "scene": (case_scene, 17),
    "fault": (case_fault, 12),
    "lens": (case_lens, 12),
    "sensor": (case_sensor, 10),
    "mesh": (case_mesh, 14),
    "spacecraft": (case_spacecraft, 9),
    "texture": (case_texture, 5),
    "kernel": (case_kernel, 3),
    "special": (case_special, 4),
    "options": (case_options, 9),
    "store": (case_store, 5),
}


# --- one case -------------------------------------------------------------------------------------------------


def run(arguments: list[str]) -> tuple[int, str, str]:
    """Run the program in this process.

    Return its exit code (-1 for a traceback), its standard error and its standard output.
    """
    from vbnfault import cli

    output, errors = io.StringIO(), io.StringIO()
    before = sys.argv
    sys.argv = ["vbnfault", *arguments]
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                cli.main()
                code = 0
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) else 0
            except BaseException:
                traceback.print_exc()
                code = -1
    finally:
        sys.argv = before
    return code, errors.getvalue(), output.getvalue()


def attempt(seeds: Seeds, seed: str, number: int, keep: Path | None = None) -> dict[str, Any]:
    """Run case `number` and return its result; its files are kept in the folder `keep`, if given."""
    rng = random.Random(f"{seed}/{number}")
    kind = rng.choices(list(CASES), [weight for _, weight in CASES.values()])[0]
    here = Path(tempfile.mkdtemp(dir=seeds.folder)) if keep is None else keep
    cpu_before = sum(os.times()[:4])
    arguments, variables = CASES[kind][0](seeds, rng, here)
    before = dict(os.environ)
    os.environ.update(variables)
    folder = os.getcwd()
    os.chdir(here)  # commands may write to the working folder
    try:
        code, errors, _ = run(arguments)
    finally:
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(before)
        if keep is None:
            shutil.rmtree(here, ignore_errors=True)
    problem = ""
    if code not in (0, 1, 2) or "Traceback" in errors:
        problem = f"exit code {code}"
    elif code and not errors.strip():
        problem = f"exit code {code} without a word"
    elif kind != "options" and code and max(map(len, errors.splitlines())) > LONGEST_MESSAGE:
        problem = f"a message of {len(errors)} characters"
    elif "not enough memory" in errors:
        problem = "not enough memory"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if peak > MEMORY_BYTES:
        problem = problem or f"{peak / 2**30:.1f} GiB of memory"
    return {
        "number": number,
        "kind": kind,
        "code": code,
        "problem": problem,
        "text": errors[-1500:] if problem else errors[:200],
        "arguments": [a[:200] for a in arguments],
        "variables": {k: v[:100] for k, v in variables.items()},
        "cpu_s": sum(os.times()[:4]) - cpu_before,
        "recycle": peak > MEMORY_BYTES,
    }


def worker(folder: Path, seed: str) -> None:
    """Run the cases whose numbers arrive on standard input; answer each with one line of JSON."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    seeds = Seeds(Path(tempfile.mkdtemp(dir=folder)))
    seeds.store = folder / "seed.zarr"
    run(dry(_whole_scene(seeds, seeds.folder)))  # imports everything before the time of a case is measured
    for limit, value in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_AS, _address_space() + 2 * MEMORY_BYTES)):
        resource.setrlimit(limit, (value, resource.getrlimit(limit)[1]))
    for line in sys.stdin:
        used = resource.getrusage(resource.RUSAGE_SELF)
        until = math.ceil(used.ru_utime + used.ru_stime) + CPU_S
        resource.setrlimit(resource.RLIMIT_CPU, (until, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        print(json.dumps(attempt(seeds, seed, int(line))), file=answers, flush=True)


def _address_space() -> int:
    """Return the size of this process's address space, in bytes; 0 if the system does not report it."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmSize:"):
            return int(line.split()[1]) * 1024
    return 0


# --- all cases ------------------------------------------------------------------------------------------------


class Process:
    """A worker process and the number of its current case."""

    def __init__(self, folder: Path, seed: str) -> None:
        self.number: int | None = None
        self.cpu_s, self.since = 0.0, time.monotonic()
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            "VBNFAULT_CACHE_DIR": str(folder / "cache"),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz", "--worker", str(folder), "--seed", seed],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=ROOT,
            env=environment,
            start_new_session=True,
        )

    def give(self, number: int | None) -> None:
        """Send it a case; None ends the process."""
        assert self.process.stdin is not None
        self.number, self.since = number, time.monotonic()
        if number is None:
            self.process.stdin.close()
        else:
            with contextlib.suppress(BrokenPipeError):
                self.process.stdin.write(f"{number}\n".encode())
                self.process.stdin.flush()

    def blocked(self) -> bool:
        """Return whether the case has used no processor time for `BLOCKED_S`."""
        import psutil

        with contextlib.suppress(psutil.Error):
            one = psutil.Process(self.process.pid)
            used = sum(sum(p.cpu_times()[:2]) for p in [one, *one.children(recursive=True)])
            if used > self.cpu_s + 0.2:
                self.cpu_s, self.since = used, time.monotonic()
        return time.monotonic() - self.since > BLOCKED_S


def fuzz(count: int, seed: str, processes: int, progress: bool = True) -> list[dict[str, Any]]:
    """Run cases 0 to `count` - 1; print and return the failures."""
    failures: list[dict[str, Any]] = []
    outcomes: Counter[tuple[str, Any]] = Counter()
    slowest, began = 0.0, time.monotonic()
    with tempfile.TemporaryDirectory(prefix="vbnfault-fuzz-") as temporary:
        folder = Path(temporary)
        os.environ["VBNFAULT_CACHE_DIR"] = str(folder / "cache")
        Seeds(folder).build()
        waiting = iter(range(count))
        workers = [Process(folder, seed) for _ in range(processes)]
        for one in workers:
            one.give(next(waiting, None))
        ended = 0
        while any(one.number is not None for one in workers):
            streams = {one.process.stdout: one for one in workers if one.number is not None}
            ready, _, _ = select.select(list(streams), [], [], 10.0)
            for one in [streams[stream] for stream in ready]:
                assert one.process.stdout is not None
                line = one.process.stdout.readline()
                if line:
                    result = json.loads(line)
                else:
                    code = one.process.wait()
                    result = {
                        "number": one.number,
                        "kind": "?",
                        "problem": f"the process died with {code}",
                        "code": code,
                    }
                outcomes[result["kind"], result["code"]] += 1
                slowest = max(slowest, result.get("cpu_s", 0.0))
                if result["problem"]:
                    failures.append(result)
                    report(result, seed)
                if not line or result["recycle"]:
                    one.process.kill()
                    workers[workers.index(one)] = one = Process(folder, seed)
                one.give(next(waiting, None))
                ended += 1
                if progress and ended % 100 == 0:
                    rate = ended / (time.monotonic() - began) * 60
                    print(f"{ended} of {count} cases, {rate:.0f} a minute, {len(failures)} failures", flush=True)
            for one in workers:
                if one.number is not None and one.blocked():
                    one.process.kill()  # the loop above then reports that the process died
        for one in workers:
            one.process.wait()
            assert one.process.stdout is not None
            one.process.stdout.close()
    for kind in sorted({kind for kind, _ in outcomes}):
        codes = {code: n for (of, code), n in sorted(outcomes.items(), key=str) if of == kind}
        print(f"{kind:<12}" + "  ".join(f"exit {code}: {n}" for code, n in codes.items()))
    minutes = (time.monotonic() - began) / 60
    print(
        f"{ended} cases of seed {seed} in {minutes:.1f} minutes: {len(failures)} failures; "
        f"the longest took {slowest:.1f} s of computing"
    )
    return failures


def report(result: dict[str, Any], seed: str) -> None:
    """Print a failure and the command that repeats it."""
    print(f"FAILED case {result['number']} ({result['kind']}): {result['problem']}")
    for key in ("arguments", "variables", "text"):
        if result.get(key):
            print(f"  {key}: {result[key]}")
    print(f"  repeat: python -m tests.fuzz --seed {seed} --only {result['number']}", flush=True)


def source_hash() -> str:
    """Return a hash of the package's sources, so that each commit has its own cases."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "vbnfault").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def main() -> None:
    """Run all cases or one; the exit code is 1 if a case of a full run failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", default=None, help="default: a hash of the sources")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", type=int, help="one case, in this process, its files kept")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    seed = given.seed or source_hash()
    if given.worker:
        worker(given.worker, seed)
    elif given.only is not None:
        folder = Path(tempfile.mkdtemp(prefix="vbnfault-fuzz-"))
        seeds = Seeds(folder)
        seeds.build()
        keep = folder / "case"
        keep.mkdir()
        result = attempt(seeds, seed, given.only, keep)
        print(json.dumps(result, indent=1))
        print(result["text"])
        print(f"files: {keep}")
    else:
        sys.exit(bool(fuzz(given.count, seed, given.processes)))


if __name__ == "__main__":
    main()
