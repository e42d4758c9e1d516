"""What a scene will photograph, before a build: counts of the plan, geometry, warnings."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from vbnfault import cli, dataset
from vbnfault.scene import config, plan


def described(*settings: str, scene: str = "quickstart") -> list[str]:
    told = CliRunner().invoke(cli.app, ["describe", scene, *(part for s in settings for part in ("--set", s))])
    assert told.exit_code == 0, told.output
    return told.output.splitlines()


def test_describe_counts_what_is_planned_by_class_stratum_and_split() -> None:
    scene = config.load_scene("quickstart")
    table = plan.make_plan(scene, list(scene.faults), need_sun=("straylight",))
    lines = described()
    rows = {line.split()[0]: [int(n) for n in re.findall(r"\d+", line)] for line in lines if line.startswith("  ")}
    for fault in scene.faults:
        per_split = [int((table.injects(fault) & (table.split == k)).sum()) for k in range(3)]
        assert rows[fault] == [sum(per_split), *per_split]
    assert rows["samples"] == [16, *np.bincount(table.split)]
    assert not [line for line in lines if line.startswith("warning")]


def test_a_pixel_of_a_fisheye_is_that_of_its_focal_length(tmp_path: Path) -> None:
    path = tmp_path / "fisheye.toml"
    path.write_text(
        'title = "fisheye"\n[geometry]\nheight_m = [10, 100]\n[camera]\nwidth_px = 512\nheight_px = 512\n'
        '[camera.calibration]\nmodel = "fisheye"\nfx = 160\ncx = 255.5\ncy = 255.5\n'
    )
    assert "straight down: 0.0625 to 0.625 m a pixel" in "\n".join(described(scene=str(path)))


@pytest.mark.parametrize(("circle_deg", "footprint"), [(170, ", footprint 229 to 2290 m across"), (200, "")])
def test_the_footprint_of_a_fisheye_is_that_of_its_whole_field(
    tmp_path: Path, circle_deg: int, footprint: str
) -> None:
    path = tmp_path / "fisheye.toml"
    path.write_text(
        'title = "fisheye"\n[geometry]\nheight_m = [10, 100]\n[camera]\nwidth_px = 512\nheight_px = 512\n'
        f'[camera.calibration]\nmodel = "fisheye"\nfx = 140\ncx = 255.5\ncy = 255.5\ncircle_deg = {circle_deg}\n'
    )
    (line,) = [line for line in described(scene=str(path)) if line.startswith("straight down")]
    assert line.partition(" m a pixel")[2] == footprint


def test_describe_says_what_the_frame_shows() -> None:
    text = "\n".join(described("geometry.height_m=[10, 100]", "camera.fov_deg=90", "sun.distance_au=2"))
    # 90 degrees across: twice the height, over 512 pixels
    assert "0.0391 to 0.391 m a pixel, footprint 20 to 200 m across" in text
    assert "Sun: 2 au" in text
    assert "at least 20% sunlit ground" in text
    faint = next(line for line in described("sun.distance_au=2") if "exposure" in line)
    bright = next(line for line in described("sun.distance_au=1") if "exposure" in line)
    times = [float(re.search(r"about ([0-9.e-]+) s", line)[1]) for line in (faint, bright)]  # type: ignore[index]
    assert times[0] / times[1] == pytest.approx(4, rel=0.01)  # inverse square, three digits each


def test_a_dry_run_and_describe_say_the_same_and_warn_of_missing_classes(tmp_path: Path) -> None:
    scene = config.load_scene("quickstart", {"dataset.samples": 4})
    lines = dataset.describe_scene(scene, source="quickstart")
    assert [line for line in lines if line.startswith("warning: split val has no samples")]
    summary = dataset.build_scene(scene, tmp_path / "none.zarr", source="quickstart", dry_run=True)
    assert summary.lines()[-len(lines) :] == lines
    assert not (tmp_path / "none.zarr").exists()


def test_describe_prints_the_size_of_the_body_its_doubts_and_the_values_of_67p_that_it_has() -> None:
    def lines(*semi_axes_m: float) -> list[str]:
        scene = config.load_scene("quickstart", {"body.shape": "ellipsoid", "body.semi_axes_m": list(semi_axes_m)})
        with pytest.warns(UserWarning, match="not 67P, whose values it has for body.name"):
            return dataset.describe_scene(scene, source="quickstart")

    right = lines(282.5, 267.5, 254.0)
    assert any("565 x 535 x 508 m along its axes x, y and z, mean radius 267.7 m" in line for line in right)
    assert not [line for line in right if "body.unit" in line]
    (doubt,) = (line for line in lines(1.2, 1.1, 1.0) if "body.unit" in line)
    assert "2.4 m long, has a mean radius below 5 m and is shorter than 3 times patch.radius_m" in doubt


def test_describe_says_how_many_samples_get_no_fault_how_a_defect_looks_and_how_often_suns_are_seen() -> None:
    lines = described("dataset.samples=64", scene="paper67p")
    (faults,) = (line for line in lines if line.startswith("faults: "))
    assert faults.startswith("faults: 32 of 64 samples (50%) get none")
    assert "broken_pixels: each defect shows as a plus of five pixels" in faults
    (suns,) = (line for line in lines if line.startswith("Suns: "))
    own, count, other, none = map(
        int, re.search(r"(\d+) of (\d+) are seen.*, (\d+) only.*and (\d+) from", suns).groups()
    )  # type: ignore[union-attr]
    assert own + other + none == count > 10
    assert own > 0.8 * count
