"""The benchmarks still run: tiny frame, coarse terrain, one round, in this process."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import vbnfault
from vbnfault.scene.config import Scene

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))


@pytest.mark.slow
def test_benchmarks_print_every_stage_and_ratio(tmp_path: Path) -> None:
    from report import SAMPLE, table
    from workload import Workload, clock

    work = Workload.load(64, facet_m=12.0)
    folder = work.empty_store(tmp_path / "store.zarr")
    bound, _ = clock(work.bound)
    seconds, frame = work.labelled_sample(folder)
    assert set(SAMPLE) <= set(seconds)
    assert (frame.rendering.truth.semantic == 1).all()
    assert set(work.spec.faults) == set(frame.drawn)
    assert folder.finished() == folder.samples
    printed = table({"bound": bound, **seconds})
    for line in (
        "bound:",
        "render:",
        "inject_faults:",
        "take_images:",
        "store:",
        "labelled sample",
        "at least 0.7",
        "at most 0.25",
    ):
        assert line in printed


def test_the_cost_with_workers_is_that_of_the_samples_between_two_builds(monkeypatch: pytest.MonkeyPatch) -> None:
    import variants_cost

    now, built = [0.0], []

    def build(scene: Scene, _path: Path, *, workers: int) -> None:
        built.append((scene.dataset.samples, scene.dataset.variants_per_view, workers))
        now[0] += 10 + 3 * scene.dataset.samples  # the start of the processes, and the samples

    monkeypatch.setattr(vbnfault, "build", build)
    monkeypatch.setattr(variants_cost.time, "perf_counter", lambda: now[0])
    assert variants_cost.seconds_with_workers("paper67p", 8, 4, 2, {}) == 3
    assert built == [(8, 4, 2), (8, 4, 2), (24, 4, 2)]


def test_the_cost_of_variants_is_measured_on_equal_faults(tmp_path: Path) -> None:
    from variants_cost import STAGES, measure, table

    small = {"camera.width_px": 64, "camera.height_px": 64, "patch.max_triangles": 50_000}
    alone, shared = measure("paper67p", 4, 2, tmp_path, settings=small)
    for build in (alone, shared):
        assert build.store.finished() == 4
        # the stages are all that a build does, so their times add up to its time
        assert set(build.wall_s) == {*STAGES, "sum"}
    assert alone.calls["faulty"] == shared.calls["faulty"] == 2
    assert shared.calls["render_view"] < alone.calls["render_view"]
    assert "K=2 over K=1: " in table(alone, shared)


def test_faults_in_images_are_timed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import inject_speed

    monkeypatch.setattr(sys, "argv", ["inject_speed.py", "--size", "64", "--rounds", "1", "--only", "detector: b"])
    inject_speed.main()
    printed = capsys.readouterr().out
    for name in ("blooming", "banding", "broken_pixels", "broken_lines", "other programs took"):
        assert name in printed


def test_what_a_blur_does_to_light_is_a_figure_of_the_comparison() -> None:
    import inject_beside

    assert inject_beside.light_kept(lambda image, _: image) == 1
    assert inject_beside.white_around_sun(inject_beside.blurred_sun) == pytest.approx(1, abs=0.02)
    assert inject_beside.off_the_line(inject_beside.flare(model="texture")) < 1
    assert inject_beside.shine_in_the_dark(lambda image, _: image + np.uint8(3)) == 3


def test_a_scene_is_drawn_beside_its_twin_and_its_masks(monkeypatch: pytest.MonkeyPatch) -> None:
    import scene_pictures

    load, drawn = scene_pictures.config.load_scene, []
    small = {"camera.width_px": 64, "camera.height_px": 64, "patch.max_triangles": 300_000}
    monkeypatch.setattr(scene_pictures.config, "load_scene", lambda scene, keys: load(scene, {**keys, **small}))
    frames = scene_pictures.frames
    monkeypatch.setattr(scene_pictures, "frames", lambda *given: drawn.extend(frames(*given)) or drawn)
    picture = scene_pictures.paper_example()
    assert picture.shape == (2 * 400 + scene_pictures.GAP_PX, 4 * 400 + 3 * scene_pictures.GAP_PX, 3)
    # the second picture is the twin without straylight, not the image
    images = drawn[0].images
    assert (scene_pictures.rgb(drawn[0], "without_straylight") == images.without["straylight"].array[..., :3]).all()
    assert (images.without["straylight"].array != images.image.array).any()
