"""The datasets of a benchmark: what a file may say, and what one command makes of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import Called

from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.dataset import verify
from vbnfault.detect.benchmark import load_benchmark, make_benchmark, read_manifest, scene_of
from vbnfault.detect.leaderboard import read_leaderboard
from vbnfault.store import open_store

FILE = """
title = "tiny"

[common]
"camera.width_px" = 64
"camera.height_px" = 64
"patch.max_triangles" = 20000
"patch.boulders" = false
"dataset.sites" = 3
"dataset.variants_per_view" = 2

[faults.few.broken_pixels]
model = "texture"

[parts.train]
purpose = "train"
scene = "quickstart"
faults = "few"
samples = 40

[parts.nominal]
description = "no fault"
scene = "quickstart"
faults = "few"
samples = 40
set = {"dataset.seed" = 3, "plan.faulty_fraction" = 0.0}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(FILE)
    return path


@pytest.mark.parametrize("name", resources.packaged("scenes/benchmarks"))
def test_every_part_of_a_packaged_benchmark_has_a_scene(name: str) -> None:
    benchmark, path = load_benchmark(name)
    scenes = {part: scene_of(benchmark, part, path) for part in benchmark.parts}
    seeds = {part: scene.dataset.seed for part, scene in scenes.items() if benchmark.parts[part].purpose == "test"}
    train = {scene.dataset.seed for part, scene in scenes.items() if part not in seeds}
    assert len(set(seeds.values())) == len(seeds)
    assert train.isdisjoint(seeds.values())  # so their sites and individuals are others
    for part, scene in scenes.items():
        assert set(scene.faults) == set(benchmark.faults[benchmark.parts[part].faults])
        assert (benchmark.parts[part].samples or 0) % scene.dataset.variants_per_view == 0


def test_one_command_makes_all_parts_and_continues(file: Path, tmp_path: Path, call: Callable[..., Called]) -> None:
    out = tmp_path / "made"
    arguments = ("bench", "--out", out, "--benchmark", file, "--fraction", 0.1)
    planned = call(*arguments, "--dry-run")
    assert planned.code == 0, planned.err
    assert "nominal: no fault" in planned.out
    assert not out.exists()
    assert call(*arguments, "--only", "nominal").code == 0
    assert list(read_manifest(out)["parts"]) == ["nominal"]
    both = call(*arguments)
    assert both.code == 0, both.err
    manifest = json.loads((out / "benchmark.json").read_text())
    assert list(manifest["parts"]) == ["train", "nominal"]
    for name, part in manifest["parts"].items():
        store = open_store(out / part["store"])
        report = verify(store)
        assert not report.problems
        assert report.digest == part["digest"]
        assert part["samples"] == store.samples == 4
        assert f"{name}: 4 samples" in both.out
    assert manifest["parts"]["train"]["purpose"] == "train"
    assert not open_store(out / "nominal.zarr").read("injected").any()


def test_faults_are_put_into_the_images_of_a_folder(
    file: Path, tmp_path: Path, call: Callable[..., Called]
) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for k in range(3):
        cv2.imwrite(str(frames / f"{k}.png"), np.full((48, 80), 60 + k, np.uint8))
    part = '[parts.mine]\nscene = "quickstart"\nfaults = "few"\nframes = true\n'
    part += 'set = {"dataset.variants_per_view" = 1}\n'
    file.write_text(FILE.replace("[parts.train]", f"{part}[parts.train]"))
    out = tmp_path / "made"
    with pytest.raises(InputError, match=r"parts.mine.frames = true: needs a folder of images \(--frames\)"):
        list(make_benchmark(file, out, only=["mine"]))
    assert [name for name, *_ in make_benchmark(file, out, fraction=0.05)] == ["train", "nominal"]
    assert call("bench", "--out", out, "--benchmark", file, "--only", "mine", "--frames", frames).code == 0
    entry = read_manifest(out)["parts"]["mine"]
    store = open_store(out / entry["store"])
    assert entry["samples"] == store.samples == 3
    assert entry["digest"] == verify(store).digest
    assert store.read("clean")[:, 0, 0, 0].tolist() == [60, 61, 62]
    assert store.read("injected").any()
    file.write_text(file.read_text().replace("frames = true", "frames = true\nsamples = 3"))
    with pytest.raises(InputError, match=r"parts.mine.samples: must be .* left out with frames = true"):
        load_benchmark(file)


def test_a_path_starts_from_the_file_of_the_benchmark(file: Path, tmp_path: Path) -> None:
    table = tmp_path / "poses.csv"
    table.write_text(
        "name,julian_date,camera_x_T_m,camera_y_T_m,camera_z_T_m,camera_from_T_w,camera_from_T_x,camera_from_T_y,"
        "camera_from_T_z,sun_x_T,sun_y_T,sun_z_T,sun_distance_au\n"
        "a,2457000.5,0,0,30000,0,1,0,0,0.6,0,0.8,2.5\n"
    )
    set_keys = 'set = {"dataset.variants_per_view" = 1, "trajectory.file" = "poses.csv"}'
    part = f'[parts.flown]\nscene = "quickstart"\nfaults = "few"\nsamples = 1\n{set_keys}\n'
    file.write_text(FILE.replace("[parts.train]", f"{part}[parts.train]"))
    benchmark, path = load_benchmark(file)
    scene = scene_of(benchmark, "flown", path)
    assert scene.trajectory is not None
    assert Path(scene.trajectory.file) == table


def test_a_model_is_scored_on_all_tests_and_listed(file: Path, tmp_path: Path, call: Callable[..., Called]) -> None:
    out, masks = tmp_path / "made", tmp_path / "nothing"
    for _ in make_benchmark(file, out, fraction=0.1):
        pass
    (masks / "broken_pixels").mkdir(parents=True)
    for k in range(4):
        cv2.imwrite(str(masks / "broken_pixels" / f"{k}.png"), np.full((64, 64), 255 * (k == 1), np.uint8))
    for name in ("first", "second", "first"):
        scored = call("score", masks, out, "--name", name)
        assert scored.code == 0, scored.err
        assert "nominal: false alarms: in 25.0% of 4 nominal frames" in scored.out
    assert (tmp_path / "nothing_on_made" / "nominal" / "score.html").is_file()
    table = read_leaderboard(out)
    assert list(table) == ["first", "second"]
    assert table["first"] == table["second"]
    (part,) = table["first"]["parts"].values()  # the other dataset is for training
    assert part["nominal_frames_with_alarm"]["all"]["value"] == 0.25  # one of four is marked
    assert part["good_pixels_kept"]["value"] == 0.75
    split = call("score", masks, out, "--split", "val")
    assert "of the tests of a benchmark, all samples are scored" in split.said
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "model.json").write_text("{}")
    refused = call("score", masks, out / "nominal.zarr", "--out", tmp_path / "model")
    assert "is a model, in which no other file may lie" in refused.said
    (out / "leaderboard.json").write_text("[]")
    with pytest.raises(InputError, match="is no leaderboard"):
        read_leaderboard(out)
    for _ in make_benchmark(file, tmp_path / "train", fraction=0.1, only=["train"]):
        pass
    none = call("score", masks, tmp_path / "train")
    assert none.code == 2
    assert "lists no dataset for a test" in none.said


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            'faults = "few"\nsamples',
            'faults = "fev"\nsamples',
            r"parts.train.faults = 'fev': .* \(did you mean few\?\)",
        ),
        ("samples = 40\n\n", "samples = 0\n\n", "parts.train.samples = 0: must be a whole number from 1"),
        ('purpose = "train"', 'purpose = "tests"', "parts.train.purpose"),
        ('"camera.width_px" = 64', '"camera.width" = 64', r"parts.train: .*camera.width"),
        ('scene = "quickstart"', 'scene = "quick"', "parts.train: quick: neither a file nor a packaged name"),
        ("[parts.", "[pieces.", "parts"),
    ],
)
def test_a_wrong_file_is_told_in_one_sentence(
    file: Path, tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    file.write_text(FILE.replace(old, new))
    with pytest.raises(InputError, match=sentence):
        list(make_benchmark(file, tmp_path / "made"))
    assert not (tmp_path / "made").exists()


def test_an_unknown_part_and_a_broken_manifest_are_refused(file: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no part 'nominl' \(did you mean nominal\?\); train, nominal"):
        list(make_benchmark(file, tmp_path / "made", only=["nominl"]))
    (tmp_path / "benchmark.json").write_text('{"parts": {"a": 3}}')
    with pytest.raises(InputError, match="is no list of a benchmark's datasets"):
        read_manifest(tmp_path)
