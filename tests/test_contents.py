"""Files that a build reads again hold what they held when it was planned; what they are called does not count."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from conftest import small_scene

from vbnfault import dataset, pipeline, store
from vbnfault.core.errors import InputChanged, InputError
from vbnfault.core.files import file_contents, resources, spice, user_files
from vbnfault.dataset import build
from vbnfault.scene import config

KERNEL = "\\begindata\nTEXT_VALUE = ( {} )\n\\begintext\n"


def write_mesh(path: Path, radius_m: float) -> None:
    trimesh.creation.icosphere(subdivisions=2, radius=radius_m).export(path)


def write_texture(path: Path, value: int) -> None:
    assert cv2.imwrite(str(path), np.full((8, 8, 3), value, np.uint8))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """One file of the user's of every kind."""
    made = {
        "shape": tmp_path / "body.obj",
        "lens": tmp_path / "lens.toml",
        "detector": tmp_path / "sensor.toml",
        "spacecraft": tmp_path / "craft.obj",
        "texture": tmp_path / "texture.png",
    }
    write_mesh(made["shape"], 900.0)
    write_mesh(made["spacecraft"], 1.0)
    write_texture(made["texture"], 7)
    shutil.copy(resources.find("scenes/lenses", "tessar_50_f2p8"), made["lens"])
    shutil.copy(next(iter(resources.packaged("scenes/detectors").values())), made["detector"])
    return made


def scene_of(files: dict[str, Path], **tables: dict[str, Any]) -> config.Scene:
    table = small_scene(
        dataset={"samples": 4, "sites": 2},
        body={"shape": str(files["shape"]), "unit": "m"},
        camera={"lens": str(files["lens"]), "detector": str(files["detector"]), "width_px": 64, "height_px": 64},
        spacecraft={"model": str(files["spacecraft"]), "translation_m": [0.0, 0.0, -9.0]},
        **tables,
    )
    table["faults"] = {"pixel_overwriting": {"texture_file": str(files["texture"])}}
    return config.parse_scene(table, source="test")


def change(kind: str, path: Path) -> None:
    if kind in ("shape", "spacecraft"):
        write_mesh(path, 3.0)
    elif kind == "texture":
        write_texture(path, 8)
    else:
        path.write_text(path.read_text() + "\n")


LOADED = {
    "shape": lambda session: session.body,
    "lens": lambda session: session.base_camera,
    "detector": lambda session: session.base_camera,
    "spacecraft": lambda session: session.vehicle,
    "texture": lambda session: next(iter(session.faults.values())).draw(None, None),
}


@pytest.mark.parametrize("kind", LOADED)
def test_a_worker_refuses_a_file_that_is_not_the_planned_one(files: dict[str, Path], kind: str) -> None:
    contents, scene = file_contents.Contents(), scene_of(files)
    with contents.in_use():
        dataset.store_spec(pipeline.Session(scene), (4,))
    contents.complete()
    # as in a worker: another process, or one that has worked for another build before
    there = pickle.loads(pickle.dumps(dataset.SessionFactory(scene, (4,), None, contents)))
    with there.contents.in_use():
        LOADED[kind](there().session)
    change(kind, files[kind])
    late = pickle.loads(pickle.dumps(there))
    sentence = rf"{files[kind].name}: \w+ file has changed since the build began; .*back"
    with late.contents.in_use(), pytest.raises(InputChanged, match=sentence):
        LOADED[kind](late().session)
    files[kind].unlink()
    with late.contents.in_use(), pytest.raises((InputChanged, InputError), match=files[kind].name):
        LOADED[kind](late().session)


def test_kernels_are_those_of_the_plan_also_where_a_meta_kernel_names_them(tmp_path: Path) -> None:
    pytest.importorskip("spiceypy")
    kernel, meta = tmp_path / "one.tpc", tmp_path / "meta.tm"
    kernel.write_text(KERNEL.format(1))
    # a string of a kernel has at most 80 characters
    folder = f"PATH_VALUES = ( '{tmp_path}' )\nPATH_SYMBOLS = ( 'HERE' )"
    meta.write_text(f"KPL/MK\n\\begindata\n{folder}\nKERNELS_TO_LOAD = ( '$HERE/one.tpc' )\n\\begintext\n")
    contents = file_contents.Contents()
    with contents.in_use(), spice.kernels(meta):
        pass
    contents.complete()
    late = pickle.loads(pickle.dumps(contents))
    kernel.write_text(KERNEL.format(2))
    sentence = r"one.tpc: SPICE .*kernel file has changed since"
    for one in (contents, late):
        with one.in_use(), pytest.raises(InputChanged, match=sentence), spice.kernels(meta):
            pass
    other = tmp_path / "two.tpc"
    other.write_text(KERNEL.format(1))
    sentence = r"two.tpc: .* was not there, or not used, when the build"
    with late.in_use(), pytest.raises(InputChanged, match=sentence), spice.kernels(other):
        pass


@pytest.mark.filterwarnings("ignore:.*67P:UserWarning")  # the body keeps values of 67P
@pytest.mark.filterwarnings("ignore:.*of the frame is dark:UserWarning")  # the lens has no field of 65 degrees
@pytest.mark.parametrize("workers", [1, 2])
def test_a_mesh_replaced_during_a_build_ends_it_with_nothing_wrong_written(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    planned = build.build

    def replaced(*args: Any, **kwargs: Any) -> build.Summary:
        write_mesh(files["shape"], 700.0)
        return planned(*args, **kwargs)

    monkeypatch.setattr(build, "build", replaced)
    out = tmp_path / "s.zarr"
    with pytest.raises(InputChanged, match=r"body.obj: shape file has changed since the build began") as e:
        dataset.build_scene(scene_of(files), out, source="test", workers=workers, progress=False)
    assert e.value.exit_code == 1
    assert store.open_store(out).finished() == 0
    with pytest.raises(InputError, match=r"holds another dataset: scene.body.shape"):
        dataset.build_scene(scene_of(files), out, source="test")


def test_a_second_plan_in_one_process_reads_anew(files: dict[str, Path]) -> None:
    def lens_of(scene: config.Scene) -> Any:
        with file_contents.Contents().in_use():
            return pipeline.Session(scene).base_camera.lens.prescription

    scene = scene_of(files)
    before = lens_of(scene)
    text = files["lens"].read_text()
    name = next(line for line in text.splitlines() if line.startswith("name"))
    files["lens"].write_text(text.replace(name, 'name = "another"'))
    assert before.name != lens_of(scene).name == "another"


def test_renamed_files_of_equal_content_make_the_same_store(files: dict[str, Path], tmp_path: Path) -> None:
    before = dataset.store_spec(pipeline.Session(scene_of(files)), (4,))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    renamed = {kind: elsewhere / f"renamed_{path.name}" for kind, path in files.items()}
    for kind, path in files.items():
        path.rename(renamed[kind])
    after = dataset.store_spec(pipeline.Session(scene_of(renamed)), (4,))
    assert after == before
    for kind in files:
        change(kind, renamed[kind])
        changed = dataset.store_spec(pipeline.Session(scene_of(renamed)), (4,))
        assert changed.attributes["scene_hash"] != after.attributes["scene_hash"]
        after = changed


# --- results kept outside a run ---------------------------------------------------------------------------


def test_a_result_is_kept_until_a_file_that_it_was_read_from_changes(tmp_path: Path) -> None:
    path, calls = tmp_path / "lens.toml", []

    @file_contents.cached_with_contents(maxsize=4)
    def text(name: str) -> str:
        calls.append("text")
        return user_files.read_input(name, "lens").decode()

    @file_contents.cached_with_contents(maxsize=4)
    def size(name: str) -> int:
        calls.append("size")
        return len(text(name))

    with pytest.raises(InputError, match="not found"):
        size(str(path))
    calls.clear()
    for content in ("a", "bcd"):
        path.write_text(content)
        text(str(path))  # the outer function then finds this result and must still know its file
        assert [size(str(path)) for _ in range(3)] == [len(content)] * 3
    assert calls == ["text", "size"] * 2
    with file_contents.Contents().in_use():  # a run compares the contents itself, and keeps its results
        assert size(str(path)) == 3
        path.write_text("ef")
        assert size(str(path)) == 3
