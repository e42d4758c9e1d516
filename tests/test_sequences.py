"""Sequences: tables of poses whose rows are frames, what their frames share, and what the store says of them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frames_kit import FRAMES, NAMES, columns, write, write_scene
from poses_kit import columns_of, row

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.quantities import RTS, RTS_HIGH
from vbnfault.dataset import describe_scene
from vbnfault.faults.planes import displaced
from vbnfault.pipeline.development import acting_at
from vbnfault.scene import config, plan
from vbnfault.scene.trajectory import as_trajectory, load_trajectory, place_in_sequence


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of the scene's finished store, which no test changes."""
    folder = tmp_path_factory.mktemp("built")
    vbnfault.build(write_scene(folder), folder / "s.zarr", progress=False)
    return folder / "s.zarr"


# --- tables -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["table", "flight"])
def test_an_exposure_ends_before_the_next_frame(scene: Path, given: str) -> None:
    """Frames are 0.4 s apart, those of other sequences nearer; a metered exposure takes at most as long."""
    keys: dict[str, Any] = {"camera.exposure_s": "auto"}
    if given == "table":
        table = columns()
        table["time_s"] = [0.0, 0.5, 0.9, 0.95, 1.0, 1.4, 2.0, 3.0, 4.0]
        write(scene.parent / "poses.csv", table)
    else:
        flight = {"kind": "hover", "frames": 3, "period_s": 0.4, "height_m": 900.0}
        keys["trajectory"] = {"flight": [flight, {**flight, "period_s": 0.8}]}
    assert config.load_scene(scene, keys).camera.exposure_max_s == pytest.approx(0.4)
    for changes in ({"camera.exposure_s": 0.5}, {**keys, "camera.exposure_min_s": 0.5}):
        name = "min_s" if "camera.exposure_min_s" in changes else "s"
        with pytest.raises(
            InputError, match=rf"camera\.exposure_{name} = 0\.5: must be at most 0\.4, the shortest time"
        ):
            config.load_scene(scene, {**keys, **changes})


def test_csv_parquet_and_columns_are_the_same_sequences(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    given = columns()
    pyarrow.parquet.write_table(pyarrow.table(given), tmp_path / "poses.parquet")
    files = write(tmp_path / "poses.csv", given), tmp_path / "poses.parquet"
    for table in (as_trajectory(given), *(load_trajectory(str(path)) for path in files)):
        assert (table.sequence_names, table.frames) == (NAMES, FRAMES)
        assert table.time_s.tolist() == given["time_s"]
        pose = table.pose(5)
        assert (pose.sequence, pose.frame, pose.time_s) == (2, 1, 1.0)


def test_either_column_alone_is_enough() -> None:
    """A date is a float64 of 2.5 million days, whose digits are 40 us."""
    given = columns()
    del given["time_s"]
    given["julian_date"] = [2457000.5 + k / 8640 for k in range(9)]
    dated = as_trajectory(given)
    np.testing.assert_allclose(dated.time_s, [0, 10, 20, 0, 0, 10, 20, 30, 40], atol=1e-4)
    del given["sequence"]
    one = as_trajectory({**given, "time_s": list(range(9))})
    assert (one.sequence_names, one.frames, one.time_s[8]) == (("0",), (9,), 8.0)
    rows = as_trajectory(given)
    assert (rows.sequence_names, rows.frames, rows.pose(3).sequence) == ((), (), -1)
    assert np.isnan(rows.time_s).all()


def test_the_place_of_a_row_is_that_of_counting() -> None:
    counted = [(s, k) for s, n in enumerate(FRAMES) for k in range(n)]
    assert [place_in_sequence(FRAMES, k) for k in range(sum(FRAMES))] == counted
    assert place_in_sequence((), 4) == (-1, 0)


@pytest.mark.parametrize(
    ("column", "row_number", "value", "sentence"),
    [
        ("time_s", 6, 0.0, r"row 7: 6 is at 0 s of its sequence, and the row before, 5, at 1 s; time_s must rise"),
        ("time_s", 6, 1.0, r"row 7: 6 is at 1 s of its sequence"),
        ("time_s", 2, "soon", r"row 3: time_s = 'soon': must be a number from -1000000000 to 1000000000"),
        ("time_s", 2, float("nan"), r"row 3: time_s = nan: must be a number"),
        ("sequence", 3, "leave", r""),
        ("sequence", 8, "approach", r"row 9: sequence = 'approach': has ended before, and began in row 1"),
        ("sequence", 8, "", r"row 9: sequence = '': must be a printable text of 1 to 200 characters"),
        ("sequence", 8, None, r"row 9: sequence = '': must be a printable text"),
        ("sequence", 8, float("nan"), r"row 9: sequence = '': must be a printable text"),
    ],
)
def test_frames_out_of_order_are_named(column: str, row_number: int, value: Any, sentence: str) -> None:
    table = columns()
    table[column][row_number] = value
    if not sentence:
        table["time_s"][row_number] = -1.0  # now the first frame of the last sequence
        assert as_trajectory(table).frames == (3, 6)
        return
    with pytest.raises(InputError, match=sentence):
        as_trajectory(table)


def test_dates_that_run_backward_are_named() -> None:
    table = columns()
    del table["time_s"]
    with pytest.raises(InputError, match=r"row 2: 1 is at 0 s .* julian_date must rise through a sequence"):
        as_trajectory(table)


def test_frames_at_two_times_share_no_view(scene: Path) -> None:
    with pytest.raises(InputError, match=r"dataset\.variants_per_view = 2: .* frames of sequences.*; must be 1"):
        vbnfault.Session(config.load_scene(scene, {"dataset.variants_per_view": 2}))


# --- plans and stores ---------------------------------------------------------------------------------------------


def test_a_plan_keeps_sequences_whole(scene: Path) -> None:
    """Over many sequences, splits, devices and faults change from one to the next, and never inside one."""
    loaded = config.load_scene(scene, {"camera.individuals": 6, "plan.classes_per_sample": [1, 2]})
    frames = tuple(np.random.default_rng(1).integers(1, 30, 40).tolist())
    dataset = loaded.dataset.model_copy(update={"samples": sum(frames), "sites": len(frames)})
    table = loaded.trajectory.model_copy(update={"frames": frames})
    loaded = loaded.model_copy(update={"dataset": dataset, "trajectory": table})
    blocks = [sum(frames) - 100, 100]  # the second begins inside a sequence
    planned = plan.make_plan(loaded, ["dust_on_optics", "cosmic_rays"], blocks)
    sequence = np.repeat(np.arange(len(frames)), frames)
    np.testing.assert_array_equal(planned.site, sequence)
    for name in ("split", "individual", "injected", "stratum", "architecture", "readout_direction", "state"):
        values = getattr(planned, name)
        first = np.concatenate([[0], np.cumsum(frames)[:-1]])
        np.testing.assert_array_equal(values, np.repeat(values[first], frames, axis=0))
        assert name in ("stratum", "architecture", "readout_direction") or len(np.unique(values, axis=0)) > 1
    short = table.model_copy(update={"frames": frames[:-1]})
    with pytest.raises(InputError, match=r"frames: the sequences have .* frames; must have at least"):
        plan.make_plan(loaded.model_copy(update={"trajectory": short}), ["dust_on_optics"])


def test_frames_share_the_instrument_and_not_what_happens_in_an_exposure(
    scene: Path, built: Path, tmp_path: Path
) -> None:
    out = tmp_path / "s.zarr"
    assert vbnfault.build(scene, out, samples=4, progress=False).built == 4  # ends within the last sequence
    assert vbnfault.build(scene, out, samples=4, append=5, progress=False).built == 5
    assert vbnfault.verify(out).problems == []
    with vbnfault.open_dataset(out) as data:
        assert data["sequence"].attrs["names"] == list(NAMES)
        assert data["sequence"].values.tolist() == [0, 0, 0, 1, 2, 2, 2, 2, 2]
        assert data["frame"].values.tolist() == [0, 1, 2, 0, 0, 1, 2, 3, 4]
        assert data["time_s"].values.tolist() == columns()["time_s"]
        assert data["time_s"].attrs["units"] == "s"
        drawn = [json.loads(text) for text in data["parameters"].values]
        images = data["image"].values
    dust, rays = ([json.dumps(one.get(name)) for one in drawn] for name in ("dust_on_optics", "cosmic_rays"))
    assert len(set(dust[:3])) == len(set(dust[4:])) == 1
    assert len({dust[0], dust[3], dust[4]}) == 3
    assert "null" not in dust + rays
    assert len(set(rays)) == 9
    assert len({image.tobytes() for image in images}) == 9
    with vbnfault.open_dataset(built) as data:
        assert [json.dumps(json.loads(text).get("dust_on_optics")) for text in data["parameters"].values] == dust
        np.testing.assert_array_equal(data["image"].values[:4], images[:4])
    np.testing.assert_array_equal(vbnfault.simulate(scene, 8).layers["image"], images[8])


def test_a_fault_that_one_frame_does_not_show_is_not_drawn_again(scene: Path, tmp_path: Path) -> None:
    """A grain that darkens the near body lies before the sky where the body is far away, a quarter as wide.

    Any other draw of a few would lie on the body in half of the tries near, and in a few of a hundred far away.
    """
    poses = [row(f"{k}", (0.0, 5e3 + 15e3 * (k % 2), 300.0), (0, 1, 0)) for k in range(8)]
    write(tmp_path / "poses.csv", {**columns_of(poses), "time_s": list(map(float, range(8)))})
    grains = {"faults.dust_on_optics.count": 2, "faults.dust_on_optics.diameter_um": 100.0}
    session = vbnfault.Session(config.load_scene(scene, {**grains, "dataset.seed": 1}))
    taken = [session.simulate(k).scalars["parameters"].get("dust_on_optics") for k in range(8)]
    assert taken[0] is not None
    assert taken == [taken[0], None] * 4


@pytest.mark.parametrize("fault", [False, True])
def test_telegraph_pixels_blink_from_frame_to_frame(scene: Path, tmp_path: Path, fault: bool) -> None:
    """Those of the device, and those of the fault: their pixels stay, and a frame needs no other one.

    All dwell 10 s on average, so 4 ms apart one in 2000 has switched, and an hour apart half of them.
    """
    given = columns()
    given["time_s"] = [0.0, 0.004, 3600.0, 0.0, -7.0, 0.0, 0.004, 3600.0, 7200.0]
    write(tmp_path / "poses.csv", given)
    text = resources.find("scenes/detectors", "generic_cmos").read_text()
    fraction = 0 if fault else 0.05
    dwell = f"rts_fraction = {fraction}\nrts_time_s = [9.999, 10.001]\nrts_per_interaction = 1.0"
    sources = '[sources]\n"individual.rts_time_s" = "test"\n"individual.rts_per_interaction" = "test"'
    text = text.replace("rts_fraction = 1e-4", dwell).replace("[sources]", sources)
    (tmp_path / "cmos.toml").write_text(text)
    keys: dict[str, Any] = {"camera.detector": str(tmp_path / "cmos.toml"), "camera.exposure_s": 0.003}
    keys["dataset.layers"] = ["defects"]
    if fault:
        keys["faults.broken_pixels"] = {"model": "hot_pixels", "dose_TeV_g": 10.0}
        keys["plan.classes_per_sample"] = [3, 3]
    loaded = config.load_scene(scene, keys)
    session = vbnfault.Session(loaded)
    defects = np.array([session.simulate(k).layers["defects"] for k in range(8, -1, -1)])[::-1]
    signals = (defects & RTS) > 0
    assert signals[0].sum() > 40
    for first, frames in ((0, 3), (4, 5)):
        of_sequence, high = signals[first : first + frames], (defects[first : first + frames] & RTS_HIGH) > 0
        assert (of_sequence == of_sequence[0]).all()
        level = high[:, of_sequence[0]]
        n = level.shape[1]
        far = [-3, -1] if first else [0, 2]
        assert abs(level.mean(axis=1) - 0.5).max() < 4 * 0.5 / np.sqrt(n)
        assert abs((level[far[0]] ^ level[far[1]]).mean() - 0.5) < 4 * 0.5 / np.sqrt(n)
        near = (level[1] ^ level[2]) if first else (level[0] ^ level[1])
        assert near.sum() <= 3  # below 0.1 are expected
    np.testing.assert_array_equal(vbnfault.simulate(loaded, 7).layers["defects"], defects[7])
    taken = session.take({name: values[2] for name, values in given.items()}, sample=2)
    np.testing.assert_array_equal(taken.layers["defects"], defects[2])


def test_a_frozen_frame_is_the_frame_before_bit_for_bit(scene: Path, built: Path, tmp_path: Path) -> None:
    """Beside it, dust and rays strike; without the class, the scene has the same dust, rays and noise."""
    frozen = {"faults.frozen_frame": {"model": "repeated", "rows_fraction": 0.4, "shift_px": 160.0}}
    struck = config.load_scene(scene, {**frozen, "plan.classes_per_sample": [3, 3]})
    with vbnfault.open_dataset(built) as data:
        images = data["image"].values
    out = tmp_path / "s.zarr"
    vbnfault.build(struck, out, progress=False, workers=2)
    with vbnfault.open_dataset(out) as data:
        taken, clean = data["image"].values, data["clean"].values
        masks = data["mask"].sel(fault="frozen_frame").values
        parameters = [json.loads(text)["frozen_frame"] for text in data["parameters"].values]
    for k, one in enumerate(parameters):
        stale = np.zeros((48, 64), bool)
        stale[slice(*one["rows"])] = True
        assert stale.sum() == 19 * 64  # 0.4 of 48 rows
        np.testing.assert_array_equal(masks[k], stale)
        np.testing.assert_array_equal(taken[k][~stale], images[k][~stale])
        still = k in (0, 3, 4)
        assert ("shift_px" in one) == still
        before = displaced(images[k], *one["shift_px"]) if still else images[k - 1]
        np.testing.assert_array_equal(taken[k][stale], before[stale])
        assert (clean[k] != taken[k]).any()
    np.testing.assert_array_equal(vbnfault.simulate(struck, 6).layers["image"], taken[6])


def test_light_of_the_frame_before_meets_the_dust_once(scene: Path) -> None:
    """The model `displaced` in a whole frame: the light is that of the frame before; then dust acts on it."""
    keys = {"faults.frozen_frame.rows_fraction": 1.0, "plan.classes_per_sample": [3, 3]}
    struck, plain = (vbnfault.Session(config.load_scene(scene, some)) for some in (keys, {}))
    now, before = struck.frame(6).injection, plain.frame(5).injection
    assert acting_at(now.draws, "electrons") == ["frozen_frame", "dust_on_optics"]
    for name in (["frozen_frame"], ["frozen_frame", "dust_on_optics"]):
        expected = before.development.signal(before.draws, name[1:]).array
        np.testing.assert_array_equal(now.development.signal(now.draws, name).array, expected)


def test_charge_of_the_frame_before_is_released_in_the_next(scene: Path, tmp_path: Path) -> None:
    """A frame of the near body, and one of the sky 4 s later: what it gains is the raw frame, times a fraction.

    Noise, interference and non-linearity of that frame are 20 DN of up to 4000, so the slope is right to 1 %.
    """
    poses = [row(f"{k}", (0.0, 3e3 if k == 0 else 3e7, 300.0), (0, 1, 0)) for k in range(2)]
    write(tmp_path / "poses.csv", {**columns_of(poses), "time_s": [10.0, 14.0]})
    keys = {
        "camera.detector": "generic_cmos",
        "camera.exposure_s": 0.006,
        "dataset.layers": ["raw"],
        "faults": {"persistence": {"lag_fraction": 0.2, "trap_fraction": 0.01, "source": "drawn"}},
        "plan.classes_per_sample": [1, 1],
    }
    text = re.sub(r"(?m)^faults.*\n|^plan.classes.*\n", "", scene.read_text())
    scene.write_text(text)
    session = vbnfault.Session(config.load_scene(scene, keys))
    now = session.frame(1).injection
    bright = session.frame(0).injection.development.raw({}).astype(float)
    draw = now.draws["persistence"]
    raws = [now.development.raw(draws, noisy=False).astype(float) for draws in (now.draws, {})]
    slope, offset = np.polyfit(bright.ravel() - 64, (raws[0] - raws[1]).ravel(), 1)
    assert np.ptp(bright) > 1000
    assert draw.params["source"] == "before"
    assert draw.params["wait_s"] == pytest.approx(4 - 0.006)
    released = 0.2 + 0.01 * np.log(4.0 / 3.994)
    assert draw.params["released"] == pytest.approx(released)
    assert slope == pytest.approx(released, rel=0.01)
    assert abs(offset) < 5
    assert session.frame(0).injection.draws["persistence"].params["source"] in ("frame", "sun")


def test_readers_give_the_columns_of_sequences(built: Path) -> None:
    from vbnfault.store import open_store
    from vbnfault.train import Columns

    table = Columns(open_store(built))
    assert table["frame"].tolist() == [0, 1, 2, 0, 0, 1, 2, 3, 4]
    assert {"sequence", "frame", "time_s"} <= set(table)


def test_frames_of_a_loop_are_those_of_a_table(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a scene with sequences, a call is one of its frames from another pose, and keeps its terrain."""
    table = columns()  # near the ground, where another pose alone would have a terrain of its own
    session = vbnfault.Session(
        config.load_scene(scene, {"faults.persistence": {}, "plan.classes_per_sample": [3, 3]})
    )
    expected = [session.simulate(k) for k in range(3)]
    monkeypatch.setattr(session, "aimed_terrain", None)  # none is built for a call
    for k in (0, 2):
        camera = {name: values[k] for name, values in table.items() if "camera" in name or "velocity" in name}
        for pose in (camera, {name: values[k] for name, values in table.items()}):
            frame = session.take(pose, sample=k)
            assert frame.scalars["parameters"] == expected[k].scalars["parameters"]
            np.testing.assert_array_equal(frame.layers["image"], expected[k].layers["image"])
            assert frame.scalars["time_s"] == k
    moved = session.take(camera | {"camera_x_T_m": camera["camera_x_T_m"] + 1.0}, sample=2)
    np.testing.assert_array_equal(moved.scalars["site_T_m"], expected[2].scalars["site_T_m"])
    np.testing.assert_array_equal(moved.scalars["injected"], expected[2].scalars["injected"])
    assert (moved.layers["image"] != expected[2].layers["image"]).any()
    bright = session.take(camera, sample=2, faults={"dust_on_optics": True}, exposure=0.03)
    assert bright.scalars["exposure_s"] == 0.03
    assert bright.scalars["injected"].sum() == 1


def test_windows_are_frames_that_follow_each_other(built: Path) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")
    from vbnfault.torch import SampleDataset, WindowDataset

    data = SampleDataset(str(built), None, ["time_s", "masks"])
    windows = WindowDataset(data, 2)
    assert [window["sample"].tolist() for window in windows] == [[k, k + 1] for k in (0, 1, 4, 5, 6, 7)]
    for window in windows:
        assert window["image"].shape == (2, 4, 48, 64)
        np.testing.assert_allclose(np.diff(window["time_s"]), 1.0)
        for k in range(2):
            alone = data[int(window["sample"][k])]
            assert all(torch.equal(window[name][k], alone[name]) for name in alone)
    assert [w["sample"].tolist() for w in WindowDataset(data, 2, step=2)] == [[0, 1], [4, 5], [6, 7]]
    batches = list(torch.utils.data.DataLoader(WindowDataset(data, 3, step=2), batch_size=2))
    assert [batch["sample"].tolist() for batch in batches] == [[[0, 1, 2], [4, 5, 6]], [[6, 7, 8]]]
    without = SampleDataset(str(built), None, where=lambda columns: columns["frame"] != 1)
    assert [w["sample"].tolist() for w in WindowDataset(without, 2)] == [[6, 7], [7, 8]]  # no gap inside
    brighter = WindowDataset(data, 5, transform=lambda window: int(window["image"].max()))
    assert list(brighter) == [int(max(data[k]["image"].max() for k in range(4, 9)))]
    for options, sentence in (
        ({"frames": 6}, "frames = 6, step = 1: no sequence has as many frames side by side"),
        ({"frames": 0}, "frames = 0: must be a whole number of at least 1"),
        ({"frames": 2, "step": 1.5}, "step = 1.5: must be a whole number of at least 1"),
    ):
        with pytest.raises(InputError, match=sentence):
            WindowDataset(data, **options)
    with pytest.raises(InputError, match="changes each frame by itself"):
        WindowDataset(SampleDataset(str(built), transform=dict), 2)


def test_a_contact_sheet_has_film_strips(built: Path, tmp_path: Path) -> None:
    """Two of three sequences, the first and the last, a row each: tiles of 320 px, with gaps of 14 px."""
    import cv2

    from vbnfault.output import contact_sheet

    sheet = tmp_path / "sheet.png"
    assert contact_sheet.preview(built, sheet) == 3 + 5
    picture = cv2.imread(str(sheet))
    assert picture.shape[1] == 14 + 5 * (320 + 14)
    rows = picture.shape[0] - 14 - 2 * (240 + 46 + 14)
    assert 46 < rows < 120  # the header
    second = picture[-(240 + 46 + 14) :, :, 0]
    first = picture[-2 * (240 + 46 + 14) : -(240 + 46 + 14), :, 0]
    beyond = slice(14 + 3 * 334, None)  # the first strip has three frames
    assert np.ptp(first[:, beyond]) == 0 < np.ptp(second[:, beyond])
    assert contact_sheet.preview(built, sheet, max_samples=1) == 1


def test_the_description_counts_sequences(scene: Path) -> None:
    text = "\n".join(describe_scene(config.load_scene(scene), source="frames"))
    assert "3 sequences of 1 to 5 frames, 1 s apart, each with one camera and its faults" in text
