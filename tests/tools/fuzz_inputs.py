"""Valid inputs for the fuzz command, and ways to damage plain data, text and bytes."""

from __future__ import annotations

import base64
import contextlib
import copy
import json
import math
import random
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

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
        from conftest import small_scene

        self.folder = folder
        scene = small_scene(dataset={"samples": 8, "sites": 2})
        scene["body"] = {"shape": "ellipsoid", "semi_axes_m": [200.0, 150.0, 120.0], "unit": "m"}
        self.scene: dict[str, Any] = scene
        packaged = ROOT / "scenes"
        self.scenes = [scene, *(tomllib.loads(p.read_text()) for p in sorted(packaged.glob("*.toml")))]
        self.study = _study()
        studies = sorted((packaged / "studies").glob("*.toml"))
        self.studies = [self.study, self.study, *(tomllib.loads(p.read_text()) for p in studies)]
        self.lenses = [tomllib.loads(p.read_text()) for p in sorted((packaged / "lenses").glob("*.toml"))]
        self.sensors = [tomllib.loads(p.read_text()) for p in sorted((packaged / "detectors").glob("*.toml"))]
        self.store = folder / "seed.zarr"
        self.meshes = _meshes(folder)
        self.kernels = _kernels(folder)
        self.textures = _textures()
        self.poses = _poses()
        self.images = _images(folder)


def _study() -> dict[str, Any]:
    """Return a small valid study with factors of every distribution and kind."""
    return {
        "title": "fuzz",
        "design": {"method": "sobol", "n": 2, "seed": 3, "resamples": 100, "confidence": 0.9, "half_width": 0.0},
        "scene": {"base": "scene.toml", "samples": [0], "seeds": [1], "camera": {"exposure_s": 0.01}},
        "factor": [
            {"key": "sun.distance_au", "distribution": "uniform", "low": 1.0, "high": 2.0, "unit": "au"},
            {"key": "detector.full_well_e", "distribution": "log_uniform", "low": 1e4, "high": 2e4, "unit": "e"},
            {
                "key": "scene.faults.straylight.brightness",
                "distribution": "truncated_normal",
                "mean": 2.0,
                "deviation": 0.2,
                "low": 1.5,
                "high": 2.5,
            },
            {"key": "scene.camera.fov_deg", "distribution": "categorical", "values": [40.0, 50]},
        ],
        "metrics": {"names": ["straylight_total_e", "snr", "mask_area"]},
    }


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


def _images(folder: Path) -> dict[str, bytes]:
    """Return small valid images into which faults may go, by file name."""
    import numpy as np
    import tifffile
    from astropy.io import fits
    from test_inject_formats import film_file, pds3_file, pds4_file

    from vbnfault.core.files.images import write_exr, write_png

    rng = np.random.default_rng(4)
    grey, colours = rng.integers(0, 60000, (20, 24), np.uint16), rng.integers(0, 250, (20, 24, 3), np.uint8)
    made = folder / "images"
    made.mkdir()
    write_png(made / "a.png", grey)
    write_png(made / "b.png", np.dstack([colours, colours[..., :1]]))
    tifffile.imwrite(made / "a.tif", grey, compression="zlib", predictor=True)
    tifffile.imwrite(made / "b.tiff", colours, photometric="rgb", tile=(16, 16), bigtiff=True)
    fits.writeto(made / "a.fits", grey)
    fits.writeto(made / "b.fits", grey.astype(np.float32))
    np.save(made / "a.npy", grey)
    write_exr(made / "a.exr", {name: grey.astype(np.float32) / 60000 for name in ("R", "G", "B", "Z")})
    pds3_file(made / "attached.img", grey, "LSB_UNSIGNED_INTEGER")
    pds3_file(made / "beside.img", grey.astype(">f4"), "IEEE_REAL", attached=False)
    pds4_file(made / "pds4.img", grey, "UnsignedLSB2")
    film_file(made / "a.mkv", "ffv1", "bgr0", frames=2)
    film_file(made / "a.mp4", "mpeg4", "yuv420p", frames=2)
    return {path.name: path.read_bytes() for path in sorted(made.iterdir())}


def _poses() -> dict[str, bytes]:
    """Return one table of two frames of a sequence as CSV and as Parquet, by file name."""
    import io

    import pyarrow
    import pyarrow.parquet

    from vbnfault.scene.trajectory import COLUMNS, MOTION_COLUMNS, SEQUENCE_COLUMNS

    motion = (0.0, 0.0, -1.0, 0.0, 0.01, 0.0)
    rows = [
        ("a", 2456875.4, 0.0, 0.0, 9000.0, 0.0, 1.0, 0.0, 0.0, 0.6, 0.0, 0.8, 3.6, "s", 0.0, *motion),
        ("b", 2456876.4, 0.0, 0.0, 900.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.6, 0.8, 3.6, "s", 5.0, *motion),
    ]
    names = (*COLUMNS, *SEQUENCE_COLUMNS, *MOTION_COLUMNS)
    lines = [",".join(names), *(",".join(map(str, row)) for row in rows)]
    file = io.BytesIO()
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    pyarrow.parquet.write_table(pyarrow.table(columns), file)
    return {"poses.csv": "\n".join(lines).encode(), "poses.parquet": file.getvalue()}
