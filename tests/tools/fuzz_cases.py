"""The cases of the fuzz command: each damages a valid input and returns the arguments to run the program with."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools import fuzz_stores
from tools.fuzz_inputs import NUMBERS, TEXTS, Seeds, any_toml, changed, flipped, hostile, places, toml, toml_value

Case = tuple[list[str], dict[str, str]]  # arguments, and environment variables


def dry(scene: Path, *settings: str) -> list[str]:
    """Return the arguments of a dry run of a scene, with `--set` for each setting."""
    out = str(scene.parent / "out.zarr")
    return ["build", str(scene), "--out", out, "--dry-run", *(x for s in settings for x in ("--set", s))]


COMA: dict[str, Any] = {
    "afrho_cm": 900.0,
    "phase_function": {"phase_deg": [0.0, 90.0, 180.0], "value": [1.0, 0.4, 5.0]},
    "jets": [{"latitude_deg": 10.0, "longitude_deg": 20.0, "width_deg": 9.0, "strength": 0.2}],
    "random_jets": 3,
    "random_jet_width_deg": [5.0, 10.0],
}


def case_scene(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a scene file: the small one or a packaged one."""
    table = rng.choice([seeds.scene, seeds.scene, *seeds.scenes])
    if rng.random() < 0.2:
        table = {**table, "coma": COMA}
    path = here / "scene.toml"
    path.write_bytes(any_toml(table, rng))
    return dry(path), {}


def whole_scene(seeds: Seeds, here: Path, **tables: Any) -> Path:
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
    return dry(whole_scene(seeds, here, faults={name: table})), {}


def case_lens(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a lens file; run `lens` on it, or a scene that uses it."""
    path = here / "lens.toml"
    path.write_bytes(any_toml(rng.choice(seeds.lenses), rng))
    if rng.random() < 0.5:
        return ["lens", str(path), "--out", str(here / "lens.png")], {}
    camera = {**seeds.scene["camera"], "lens": str(path)}
    return dry(whole_scene(seeds, here, camera=camera, faults={})), {}


def case_sensor(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a sensor file that a scene uses."""
    path = here / "sensor.toml"
    path.write_bytes(any_toml(rng.choice(seeds.sensors), rng))
    camera = {**seeds.scene["camera"], "detector": str(path)}
    return dry(whole_scene(seeds, here, camera=camera, faults={"cosmic_rays": {}})), {}


def case_calibration(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a camera's calibration: the file of a scene, or the numbers in it."""
    from test_calibrated_camera import TABLES
    from test_calibration import COLMAP, KALIBR, ROS, ROS_MESSAGE, YAML_1_0

    camera = {key: value for key, value in seeds.scene["camera"].items() if key != "fov_deg"}
    if rng.random() < 0.4:
        table = changed(rng.choice(list(TABLES.values())), rng)
    else:
        texts = [text.encode() for text in (ROS, ROS_MESSAGE, KALIBR, COLMAP, YAML_1_0)]
        path = here / "camera.yaml"
        path.write_bytes(flipped(rng.choice(texts), rng, rng.choice(texts)))
        table = {"file": str(path), "scale_to_frame": True, "camera": rng.choice(("", "cam0", "1"))}
        camera |= {"width_px": 64, "height_px": 48}
    return dry(whole_scene(seeds, here, camera={**camera, "calibration": table}, faults={})), {}


def case_study(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a study file, its scene, or values given by `--set`.

    Most cases are dry runs. The others evaluate a few points of a tiny scene, whatever the file asks for.
    """
    scene = whole_scene(seeds, here, faults={"straylight": {"model": "texture"}})
    path, settings = here / "study.toml", []
    table, sound = rng.choice(seeds.studies), rng.random() < 0.2
    path.write_bytes(toml(table) if sound else any_toml(table, rng))
    for _ in range(rng.choice((1, 1, 2)) if sound else rng.choice((0, 0, 0, 1))):
        keys = [".".join(map(str, where)) for where in places(table)]
        settings.append(f"{rng.choice([*keys, 'scene.a.b.c', 'design', ''])}={toml_value(hostile(rng))}")
    if rng.random() < 0.15:
        small = {"design.n": 1, "design.method": "one_at_a_time", "design.half_width": 0, "scene.samples": 1}
        small |= {"scene.base": str(scene), "scene.camera.width_px": 32, "scene.camera.height_px": 32}
        settings += [f"{key}={toml_value(value)}" for key, value in small.items()]
    else:
        settings.append("--dry-run")
    arguments = ["study", str(path), "--out", str(here / "study")]
    for setting in settings:
        arguments += [setting] if setting == "--dry-run" else ["--set", setting.replace("\0", "")]
    return arguments, {}


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
    return dry(whole_scene(seeds, here, body=body)), {}


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
    return dry(whole_scene(seeds, here, spacecraft=craft)), {}


def case_texture(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage the texture of a fault, or the map of the body's albedo."""
    name = rng.choice(list(seeds.textures))
    path = here / name
    path.write_bytes(flipped(seeds.textures[name], rng, seeds.textures["a.png"]))
    if rng.random() < 0.4:
        table = {"file": str(path)}
        body = {**seeds.scene["body"], "albedo_map": changed(table, rng) if rng.random() < 0.2 else table}
        return dry(whole_scene(seeds, here, body=body)), {}
    faults = {"pixel_overwriting": {"texture_file": str(path), "blend": "add"}}
    return dry(whole_scene(seeds, here, faults=faults)), {}


def case_image(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage an image into which faults go, or what describes it, or options."""
    name = rng.choice(list(seeds.images))
    path = here / name
    for label in (path.with_suffix(ending).name for ending in (".img", ".lbl", ".xml")):
        if path.suffix in (".img", ".lbl", ".xml") and label in seeds.images:
            (here / label).write_bytes(seeds.images[label])
    damaged = rng.random() < 0.7
    path.write_bytes(flipped(seeds.images[name], rng, seeds.images["a.png"]) if damaged else seeds.images[name])
    path = path.with_suffix(".img") if path.suffix in (".lbl", ".xml") else path
    keys = ("black_dn", "white_dn", "response", "gamma", "response_file", "sun", "raw", "noise_free")
    table = {} if rng.random() < 0.6 else {key: hostile(rng) for key in rng.sample(keys, rng.choice((1, 2)))}
    models = {"dust_on_optics": {}, "broken_pixels": {"model": "texture"}, "straylight": {}}
    scene = whole_scene(seeds, here, faults=models, **({"image": table} if table else {}))
    arguments = ["inject", str(path), "--scene", str(scene), "--out", str(here / "injected")]
    if rng.random() < 0.5:
        arguments += ["--sun", rng.choice(["auto", "10,12", "0,0,1", "1,2,3,4", "nan,1", "0,0,0", "1e300,1", ""])]
    return [*arguments, *rng.choice([[], [], ["--labels", "zarr"], ["--seed", "-1"], ["--workers", "0"]])], {}


_FLIGHTS: tuple[dict[str, Any], ...] = (
    {"kind": "approach", "range_m": [60e3, 15e3]},
    {"kind": "orbit", "radius_m": 15e3},
    {"kind": "flyby", "closest_m": 9e3, "speed_m_s": 2.0},
    {"kind": "descent", "height_m": 300.0, "end_height_m": 299.0},
    {"kind": "hover", "height_m": [200.0, 300.0]},
    {"kind": "relocation", "distance_m": 1.0, "height_m": 5.0},
)


def case_poses(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Damage a table of poses: values of a CSV file, or bytes of either kind of file."""
    name = rng.choice(list(seeds.poses))
    data = seeds.poses[name]
    if name.endswith(".csv") and rng.random() < 0.6:
        rows = [row.split(",") for row in data.decode().split("\n")]
        for _ in range(rng.choice((1, 1, 3))):
            row = rng.choice(rows)
            row[rng.randrange(len(row))] = rng.choice(
                [*map(str, NUMBERS[:16]), "x", "nan", "", "1e400", '"', "name"]
            )
        data = "\n".join(map(",".join, rows)).encode()
    else:
        data = flipped(data, rng, rng.choice(list(seeds.poses.values())))
    (here / name).write_bytes(data)
    scene = {key: table for key, table in seeds.scene.items() if key not in ("faults", "geometry")}
    scene["dataset"] = {key: value for key, value in scene["dataset"].items() if key != "samples"}
    table = {"file": str(here / name)}
    scene["trajectory"] = changed(table, rng) if rng.random() < 0.1 else table
    if rng.random() < 0.3:
        scene["trajectory"] = {"flight": [changed({**rng.choice(_FLIGHTS), "frames": 2, "period_s": 60.0}, rng)]}
    if rng.random() < 0.3:
        scene["motion"] = changed({"shutter": "rolling", "line_time_s": 1e-5}, rng)
    if rng.random() < 0.5:
        event = {"cause": "c", "faults": ["dust_on_optics"], "onset_s": [1.0, 3.0], "duration_s": 2.0}
        event |= rng.choice(
            [
                {},
                {"profile": "growing", "rise_s": 2.0},
                {"profile": "intermittent", "period_s": 1.0},
                {"profile": "thermal", "period_s": 90.0},
                {"profile": "until_reset", "reset_s": 9.0},
            ]
        )
        scene |= {"faults": {"dust_on_optics": {}}, "event": [changed(event, rng)]}
        scene["plan"] = {"classes_per_sample": [1, 1]}
    path = here / "scene.toml"
    path.write_bytes(toml(scene))
    return dry(path), {}


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
    return dry(whole_scene(seeds, here, spice=table)), {}


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
    return dry(whole_scene(seeds, here), f"{key}={value}"), {}


def case_options(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Give unexpected options and environment variables to several commands; the work itself stays small."""
    scene = str(whole_scene(seeds, here))
    out = str(here / "out")
    sound: dict[str, list[str]] = {
        "build": ["build", scene, "--out", out + ".zarr", "--dry-run"],
        "retake": ["retake", str(seeds.store), "--scene", scene, "--out", out + ".zarr", "--dry-run"],
        "verify": ["verify", str(seeds.store)],
        "digest": ["digest", str(seeds.store)],
        "stats": ["stats", str(seeds.store)],
        "export": ["export", str(seeds.store), "--format", "coco", "--out", out],
        "merge": ["merge", str(seeds.store), "--out", out + "m.zarr"],
        "preview": ["preview", str(seeds.store), "--out", out + ".png"],
        "report": ["report", str(seeds.store), "--out", out + ".html"],
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
        "event-camera": ["event-camera", scene, "--out", out],
        "score": ["score", out, str(seeds.store), "--split", "all", "--batch", "2"],
        "train": ["train", str(seeds.store), "--out", out, "--epochs", "1", "--crop-px", "32"],
        "shape": ["shape", "Bennu", "--out", out, "--url", "http://127.0.0.1:9/bennu.bds"],  # nobody listens there
    }
    name = rng.choice(list(sound))
    arguments = sound[name]
    options = {
        "build": [
            "--samples",
            "--seed",
            "--workers",
            "--threads",
            "--append",
            "--set",
            "--out",
            "--scheduler",
            "--shard-range",
        ],
        "retake": ["--seed", "--workers", "--threads", "--set", "--out", "--scene"],
        "preview": ["--samples", "--out"],
        "report": ["--samples", "--pixels", "--out"],
        "export": ["--format", "--out", "--workers"],
        "merge": ["--out", "--move"],
        "event-camera": ["--out", "--sequence", "--seed", "--set"],
        "score": ["--out", "--split", "--masks", "--calibrate", "--batch", "--seed", "--name"],
        "train": ["--out", "--classes", "--crop-px", "--batch-size", "--learning-rate", "--weights", "--device"],
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
    command = rng.choice(("verify", "verify", "preview", "digest", "stats", "export", "report"))
    more = {
        "preview": ["--out", str(here / "sheet.png")],
        "report": ["--out", str(here / "report.html")],
        "export": ["--out", str(here / "export"), "--format", "yolo"],
    }
    return [command, str(store), *more.get(command, [])], {}


def case_stranger(seeds: Seeds, rng: random.Random, here: Path) -> Case:
    """Give a command the store of a stranger; `fuzz.attempt` looks where it has written."""
    private = here / "private"
    private.mkdir()
    (private / "mine.txt").write_text("precious")
    for name in ("0", "0/0", "0/0/0"):
        (private / name).mkdir()
    (private / "0/0/0/0").write_text("precious")
    (here / "out").mkdir()
    fuzz_stores.made_by_a_stranger(seeds.store, here / "store.zarr", rng, private)
    return fuzz_stores.command(here / "store.zarr", seeds.store, here / "out", rng), {}


CASES: dict[str, tuple[Callable[[Seeds, random.Random, Path], Case], int]] = {  # function, weight
    "scene": (case_scene, 12),
    "fault": (case_fault, 11),
    "lens": (case_lens, 12),
    "sensor": (case_sensor, 9),
    "calibration": (case_calibration, 6),
    "study": (case_study, 8),
    "mesh": (case_mesh, 12),
    "spacecraft": (case_spacecraft, 8),
    "texture": (case_texture, 5),
    "image": (case_image, 5),
    "poses": (case_poses, 3),
    "kernel": (case_kernel, 3),
    "special": (case_special, 4),
    "options": (case_options, 8),
    "store": (case_store, 5),
    "stranger": (case_stranger, 20),
}
