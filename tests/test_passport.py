"""Passport of a camera: frames that the scene itself made agree with it, and a changed scene is found out."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import recorded_calls
from frames_kit import write_body
from poses_kit import row
from scipy.special import ndtr
from typer.testing import CliRunner

import vbnfault
from vbnfault import cli
from vbnfault.core import figures
from vbnfault.core.errors import InputError
from vbnfault.fit import passport as fit_passport
from vbnfault.fit import two_samples
from vbnfault.fit.frames import look, read_frame
from vbnfault.fit.replay import Replay
from vbnfault.fit.stars import encircled_radii
from vbnfault.scene.trajectory import COLUMNS, load_trajectory

SMALL: dict[str, Any] = {
    "camera.width_px": 128,
    "camera.height_px": 128,
    "patch.max_triangles": 15_000,
    "body.sharpen": 0.0,
    "render.samples_per_pixel": 4,
    "sky.stars": "off",
}
FRAMES = 8


@pytest.fixture(scope="module", autouse=True)
def few_facets(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Give the scene a body of 5120 facets in place of 36,000, with relief: without it images have no texture."""
    SMALL["body.shape"] = str(write_body(tmp_path_factory.mktemp("body"), subdivisions=4, relief=0.02))


@pytest.fixture(scope="module", autouse=True)
def few_trees() -> Iterator[None]:
    """A forest of few trees, and figures of a roomy size, tell what these tests need; other files test both."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(two_samples, "_TREES", 30)
        patch.setattr(figures, "_fit", lambda figure, *_: figure.set_layout_engine("none"))
        yield


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare a test the page, which takes longer than the frames."""
    monkeypatch.setattr(fit_passport, "_write_page", lambda *_: None)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of the scene itself, with the noise, tracks and grains of another seed, half the camera's size."""
    folder = tmp_path_factory.mktemp("frames")
    angles = np.linspace(0, 5, FRAMES)
    table = [
        row(f"frame_{k}", (8e4 * np.cos(a), 8e4 * np.sin(a), 2e4), (np.cos(a + 0.8), np.sin(a + 0.8), 0.0))
        for k, a in enumerate(angles)
    ]
    with (folder / "poses.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(table)
    replay = Replay(vbnfault.load_scene("rosetta67p", SMALL), load_trajectory(str(folder / "poses.csv")))
    # other sensors' noise on the same ground: the seed of the ground stays
    for k in range(FRAMES):
        raw = replay.session.simulate(k).layers["raw"]
        rng = np.random.default_rng(k)
        cv2.imwrite(
            str(folder / f"frame_{k}.png"),
            replay.display.developed(np.clip(raw + np.rint(0.3 * rng.normal(size=raw.shape)), 0, 4095), 2),
        )
    return folder


@pytest.fixture(scope="module")
def replay(frames: Path) -> Replay:
    """Return what renders images for the frames."""
    return Replay(vbnfault.load_scene("rosetta67p", SMALL), load_trajectory(str(frames / "poses.csv")))


@pytest.fixture(scope="module")
def result(frames: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("passport")
    options = fit_passport.PassportOptions(part="all", mendings=0, draws=1)
    return fit_passport.passport(frames, "rosetta67p", out, options, overrides=SMALL), out


def test_frames_of_the_scene_itself_agree_with_it(result: tuple[dict[str, Any], Path]) -> None:
    found, out = result
    assert found["pairs"]["iou"] > 0.99
    assert found["pairs"]["rank"] > 0.95
    by_name = {one["name"]: one for one in found["statistics"]}
    assert set(by_name) == set(fit_passport.STATISTICS)
    for name in ("stretch", "power_4_8", "power_16_32", "edge_rise"):
        assert by_name[name]["distance"] < fit_passport.GOOD, name
    assert any("texture at 4 to 8 px: rendered as in the frames" in text for text in found["conclusions"]["may"])
    assert json.loads((out / "passport.json").read_text())["scene"] == "rosetta67p"
    page = (out / "passport.html").read_text(encoding="utf-8")
    assert "What may be concluded" in page
    assert all(text in page for texts in found["conclusions"].values() for text in texts)
    assert page.count("<img") >= FRAMES
    assert "://" not in page  # nothing from elsewhere; pictures in base 64 have no colon


@pytest.mark.usefixtures("no_page")
def test_a_blurred_scene_is_found_out(frames: Path, tmp_path: Path) -> None:
    """A pixel of the frames is 1.36 mrad wide; a core of two pixels takes most of the power below four pixels."""
    blurred = SMALL | {"camera.point_spread.core_urad": 2700.0}
    options = fit_passport.PassportOptions(part="all", mendings=0, draws=1)
    found = fit_passport.passport(frames, "rosetta67p", tmp_path, options, overrides=blurred)
    by_name = {one["name"]: one for one in found["statistics"]}
    assert by_name["power_2_4"]["low"] > fit_passport.GOOD
    assert by_name["power_2_4"]["rendered_median"] < 0.5 * by_name["power_2_4"]["real_median"]
    assert any(text.startswith("texture at 2 to 4 px: ") for text in found["conclusions"]["may_not"])
    assert max(v[0] for name, v in found["classifiers"]["limb"].items() if name.endswith(", all features")) > 0.9


def test_the_command_keeps_frames_back_and_continues(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sets = [word for key, value in SMALL.items() for word in ("--set", f"{key}={json.dumps(value)}")]
    command = ["passport", str(frames), "--scene", "rosetta67p", "--out", str(tmp_path / "out"), *sets]
    command += ["--kept-back", "0.6", "--mend-poses", "1", "--gain", "1", "--gain", "1.4", "--threads", "2"]
    command += ["--poses", str(frames / "poses.csv"), "--workers", "1"]
    monkeypatch.setattr(fit_passport, "_write_page", lambda *_: None)  # the last command writes it
    shown = CliRunner().invoke(cli.app, [*command, "--part", "shown"], catch_exceptions=False)
    assert shown.exit_code == 0
    assert "may not: frames on which settings were chosen flatter the scene" in shown.output
    first = json.loads((tmp_path / "out/passport.json").read_text())["frames"]
    monkeypatch.setattr(Replay, "pair", lambda *_: pytest.fail("a frame was rendered twice"))
    CliRunner().invoke(cli.app, [*command, "--part", "shown"], catch_exceptions=False)
    assert json.loads((tmp_path / "out/passport.json").read_text())["frames"] == first
    monkeypatch.undo()
    judged = CliRunner().invoke(cli.app, [*command, "--part", "kept_back"], catch_exceptions=False)
    assert "flatter" not in judged.output
    assert (tmp_path / "out/passport.html").is_file()
    second = json.loads((tmp_path / "out/passport.json").read_text())["frames"]
    assert set(first).isdisjoint(second)
    assert len(first) + len(second) == FRAMES


def test_wrong_frames_are_refused_before_anything_is_rendered(frames: Path, tmp_path: Path) -> None:
    noise = np.random.default_rng(1).poisson(5, (64, 64))
    for name, image, sentence in (
        ("frame_0.png", None, r"has no frame_0.png or frame_0.tif, which the table of poses names"),
        ("frame_1.png", np.zeros((8, 8), np.uint8), r"frame_1.png: is 8x8 px; must be at least 64 px"),
        ("frame_2.png", b"no image", r"frame_2.png: is not a PNG"),
        ("frame_3.png", np.zeros((100, 64), np.uint8), r"has 64x100 px, and the camera 128x128: must be as many"),
        ("frame_4.png", np.zeros((64, 64), np.uint8), r"frame_4: the frame shows no lit body"),
        ("frame_5.png", np.full((64, 64), 77, np.uint8), r"frame_5: the frame shows no lit body"),
        ("frame_6.png", noise.astype(np.uint8), r"frame_6: the frame shows no lit body"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        for path in frames.iterdir():
            (folder / path.name).write_bytes(path.read_bytes())
        (folder / name).unlink()
        if isinstance(image, bytes):
            (folder / name).write_bytes(image)
        elif image is not None:
            cv2.imwrite(str(folder / name), image)
        options = fit_passport.PassportOptions(part="all", mendings=0)
        with pytest.raises(InputError, match=sentence):
            fit_passport.passport(folder, "rosetta67p", tmp_path / "out", options, overrides=SMALL)
        assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_page")
def test_a_pair_that_is_damaged_or_gone_is_rendered_again(
    frames: Path, tmp_path: Path, result: tuple[dict[str, Any], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four of eight pairs have lost something each; the other four are kept."""
    found, out = result
    shutil.copytree(out / "pairs", tmp_path / "pairs")
    (tmp_path / "pairs/frame_0_rendered.png").unlink()
    real = tmp_path / "pairs/frame_1_real.png"
    real.write_bytes(real.read_bytes()[: real.stat().st_size // 2])
    for name, part in (("frame_2", "figures"), ("frame_3", "settings")):
        path = tmp_path / f"pairs/{name}.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), part: None}))
    rendered = recorded_calls(monkeypatch, Replay, "pair")
    options = fit_passport.PassportOptions(part="all", mendings=0, draws=1)
    again = fit_passport.passport(frames, "rosetta67p", tmp_path, options, overrides=SMALL)
    assert [row for _, row, _ in rendered] == [0, 1, 2, 3]
    assert json.dumps(again["statistics"]) == json.dumps(found["statistics"])  # NaN differs from itself


@pytest.mark.usefixtures("no_page")
def test_processes_give_the_pairs_that_one_gives(
    frames: Path, tmp_path: Path, result: tuple[dict[str, Any], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, out = result
    shutil.copytree(out / "pairs", tmp_path / "pairs")
    for k in (1, 2, 6):
        (tmp_path / f"pairs/frame_{k}.json").unlink()
    monkeypatch.setattr(Replay, "pair", lambda *_: pytest.fail("a frame was rendered in this process"))
    options = fit_passport.PassportOptions(part="all", mendings=0, draws=1, workers=2)
    steps: list[tuple[int, int]] = []
    again = fit_passport.passport(
        frames, "rosetta67p", tmp_path, options, overrides=SMALL, advance=lambda *step: steps.append(step)
    )
    assert json.dumps(again["frames"]) == json.dumps(found["frames"])
    assert json.dumps(again["statistics"]) == json.dumps(found["statistics"])
    assert [done for done, _ in steps] == list(range(len(steps)))
    assert FRAMES < len(steps) <= steps[0][1] + 1


@pytest.mark.parametrize("folder", ["", "../", "deeper/", "..\\"])
def test_names_that_lead_out_of_the_folder_are_refused(frames: Path, tmp_path: Path, folder: str) -> None:
    """Pairs have the names of their frames, and would be written beside them."""
    name = f"{folder or f'{frames}/'}frame_0"
    table = (frames / "poses.csv").read_text(encoding="utf-8").replace("frame_0", name)
    (tmp_path / "poses.csv").write_text(table, encoding="utf-8")
    with pytest.raises(InputError, match=r"poses\.csv: row 1: name = '.*frame_0': must be a name without a folder"):
        fit_passport.passport(frames, "rosetta67p", tmp_path / "out", overrides=SMALL, poses=tmp_path / "poses.csv")
    assert not (tmp_path / "out").exists()


def test_a_colour_camera_and_a_camera_without_a_sensor_file_are_refused(frames: Path, tmp_path: Path) -> None:
    for scene, values, sentence in (
        ("rosetta67p", SMALL | {"camera.detector": "cmv4000"}, "must be monochrome to compare grey frames"),
        ("quickstart", {}, "camera.detector: is missing"),
    ):
        with pytest.raises(InputError, match=sentence):
            fit_passport.passport(frames, scene, tmp_path, overrides=values)


def test_distances_are_those_of_shifted_values() -> None:
    """Values shifted by d have W1 = d; the interquartile range of 0, 1, …, 100 is 50."""
    values = np.arange(101.0)
    one = fit_passport.Statistic.of("sky", values, values + 20)
    assert one.distance == pytest.approx(0.4)
    assert one.low <= 0.4 <= one.high
    assert fit_passport.Statistic.of("sky", values, values).distance == 0
    none = fit_passport.Statistic.of("sky", np.full(5, np.nan), np.arange(5.0))
    assert none.frames == 0
    assert np.isnan(none.distance)
    same = fit_passport.Statistic.of("sky", np.full(5, 3.0), np.arange(5.0))
    assert same.real_median == 3
    assert np.isnan([same.distance, same.low, same.high]).all()


@pytest.mark.parametrize(
    ("distance", "high", "frames", "part", "sentence"),
    [
        (0.4, 0.5, 4, "may", "rendered as in the frames, W1/IQR 0.4; holds for thresholds on the sky"),
        (0.4, 0.6, 4, "undecided", "too few frames to tell, W1/IQR 0.4, up to 0.6 within the interval"),
        (0.6, 0.7, 4, "may_not", "7 in place of 5, W1/IQR 0.6; nothing that rests on thresholds on the sky"),
        (0.1, 0.2, 3, "may_not", "nothing, since too few frames show it"),
        (np.nan, np.nan, 9, "may_not", "nothing, since the frames do not differ"),
    ],
)
def test_what_may_be_concluded_follows_from_the_whole_interval(
    distance: float, high: float, frames: int, part: str, sentence: str
) -> None:
    one = fit_passport.Statistic(
        name="sky", real_median=5, rendered_median=7, distance=distance, low=0.1, high=high, frames=frames
    )
    found = fit_passport.conclusions({"statistics": [vars(one)], "classifiers": {}, "part": "kept_back"})
    assert [name for name, texts in found.items() if texts] == [part]
    assert sentence in found[part][0]


@pytest.mark.parametrize("f_number", [1.5, 1.0])
def test_a_frame_of_a_short_exposure_is_replayed_with_its_smear(
    frames: Path, replay: Replay, f_number: float
) -> None:
    """A wider stop and no attenuator: the exposure is as many times shorter as there is more light.

    At f/1.0 the smear passes for a part of the body, so that only the frame's own body tells how strong it is.
    """
    table = load_trajectory(str(frames / "poses.csv"))
    open_stop = SMALL | {"camera.transmission": 1.0, "camera.f_number": f_number}
    short = Replay(vbnfault.load_scene("rosetta67p", open_stop), table)
    frame = short.display.developed(short.session.simulate(2).layers["raw"], 2)
    assert look(frame).smeared
    pair = replay.pair(2, frame)
    assert pair.settings["transmission"] == pytest.approx((5.1 / f_number) ** 2, rel=0.1)
    assert pair.rendered.smeared
    assert pair.figures["iou"] > 0.98


def test_lost_columns_are_no_smear(frames: Path, replay: Replay) -> None:
    """Grey columns have backgrounds of their own, and say nothing of the exposure."""
    frame = read_frame(frames, "frame_2")
    middle = int(np.flatnonzero(look(frame).lit.any(axis=0)).mean())
    frame[:, middle - 6 : middle : 3] = 40
    assert look(frame).smeared
    assert "transmission" not in replay.pair(2, frame).settings


# --- stars ------------------------------------------------------------------------------------------------------


def star_field(sigma_px: float, stretch: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return levels of a field of Gaussian stars with noise and hits of single pixels, and their light."""
    rng, axis = np.random.default_rng(3), np.arange(257) - 0.5
    light = np.full((256, 256), 20.0)
    for _ in range(count):
        sides = [np.diff(ndtr((axis - middle) / sigma_px)) for middle in rng.uniform(12, 244, 2)]
        light += rng.uniform(300, 1200) * sigma_px**2 * np.outer(*sides)
    light += rng.normal(0, 0.3, light.shape)
    light[tuple(rng.integers(5, 250, (2, 15)))] += 150
    light[100:112, 60] += 120  # a track
    levels = np.rint(255 * np.clip(light / 255, 0, 1) ** stretch).astype(np.float32)
    return levels, (levels / 255) ** (1 / stretch)


@pytest.mark.parametrize(("sigma_px", "stretch"), [(0.8, 1.0), (1.2, 0.5), (1.6, 1.0)])
def test_radii_of_stars_are_those_of_a_gaussian(sigma_px: float, stretch: float) -> None:
    """A Gaussian holds 1 - exp(-r²/2σ²); pixels widen it by 1/12 px² when it is taken, and when it is summed."""
    levels, light = star_field(sigma_px, stretch, 25)
    wide = np.sqrt(sigma_px**2 + 2 / 12)
    found = encircled_radii(levels, light, np.ones(levels.shape, bool))
    # half a level of rounding in 78 px is 5 % of the light of the faintest, and less of the median star
    assert found == pytest.approx((wide * np.sqrt(2 * np.log(2)), wide * np.sqrt(2 * np.log(5))), rel=0.06)


def test_faint_stars_do_not_hide_how_wide_bright_ones_are() -> None:
    """Noise of 1.5 in 78 px is a thirteenth of the light of a faint star at least: its radii mean little."""
    light, rng = star_field(0.9, 1.0, 6)[1], np.random.default_rng(8)
    for y, x in rng.integers(12, 244, (20, 2)):
        light[y - 1 : y + 2, x - 1 : x + 2] += 0.08 * np.outer((1, 2, 1), (1, 2, 1)) / 4
    light = (light + 1.5 / 255 * rng.normal(size=light.shape)).astype(np.float32)
    wide = np.sqrt(0.9**2 + 2 / 12)
    found = encircled_radii(255 * light, light, np.ones(light.shape, bool))
    assert found == pytest.approx((wide * np.sqrt(2 * np.log(2)), wide * np.sqrt(2 * np.log(5))), rel=0.1)


def test_a_sky_without_stars_says_nothing() -> None:
    levels, light = star_field(1.2, 1.0, 0)
    everywhere = np.ones(levels.shape, bool)
    for good in (everywhere, ~everywhere):
        assert np.isnan(encircled_radii(levels, light, good)).all()
    assert np.isnan(encircled_radii(np.zeros_like(levels), np.zeros_like(levels), everywhere)).all()


def test_too_few_frames_with_stars_are_said_and_no_failure() -> None:
    none = np.full(4, np.nan)
    found = fit_passport.Statistic.of("ee50", none, none)
    result = {"statistics": [vars(found)], "classifiers": {}, "part": "all"}
    assert (
        "radius of half the light of stars: nothing, since too few frames show it"
        in (fit_passport.conclusions(result)["may_not"])
    )
