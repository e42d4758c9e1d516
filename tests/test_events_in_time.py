"""Events of sequences: their times and profiles, what they bring, how models grow, and what stores say of them."""

from __future__ import annotations

import csv
import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import Called
from frames_kit import EVENTS, FRAMES, NAMES, columns, write, write_scene
from poses_kit import columns_of, row

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.dataset import scene_identity
from vbnfault.faults import dataset_order, registry
from vbnfault.scene import config, plan
from vbnfault.scene.events import commanded_now, events_of_sequence, striking


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path)


@pytest.mark.parametrize(
    ("keys", "on", "off"),
    [
        ({}, {1.0: 1.0, 99.0: 1.0}, (0.999,)),
        ({"duration_s": 2.0}, {1.0: 1.0, 2.999: 1.0}, (0.0, 3.0, 9.0)),
        ({"profile": "growing", "rise_s": 4.0}, {2.0: 0.25, 4.0: 0.75, 5.0: 1.0, 50.0: 1.0}, (1.0,)),
        (
            {"profile": "intermittent", "period_s": 2.0, "duty": 0.25, "duration_s": 4.0},
            {1.0: 1.0, 1.49: 1.0, 3.2: 1.0},
            (0.9, 1.51, 2.9, 3.6, 5.1),
        ),
        ({"profile": "until_reset", "reset_s": 3.0}, {1.0: 1.0, 2.999: 1.0}, (0.9, 3.0, 99.0)),
        ({"profile": "until_reset", "reset_s": 3.0, "duration_s": 1.0}, {1.0: 1.0, 1.999: 1.0}, (2.0, 3.0)),
    ],
)
def test_profiles_over_time(scene: Path, keys: dict[str, Any], on: dict[float, float], off: tuple[float]) -> None:
    table = {"cause": "test", "faults": ["dust_on_optics"], "onset_s": 1.0, **keys}
    (event,) = events_of_sequence(config.load_scene(scene, {"event": [table]}), 0)
    assert {t: event.fraction(t) for t in on} == pytest.approx(on)
    assert [event.fraction(t) for t in off] == [0.0] * len(off)


@pytest.mark.parametrize("duty", [0.2, 0.5, 0.9])
def test_a_thermal_profile_follows_a_cosine_with_a_drawn_phase(scene: Path, duty: float) -> None:
    """Its mean is ∫ (cos φ − c) dφ / (2π (1 − c)) from −π duty to π duty, so (sin(π duty)/π − c duty) / (1 − c)."""
    table = {"cause": "c", "faults": ["dust_on_optics"], "onset_s": 0.0, "profile": "thermal", "period_s": 90.0}
    loaded = config.load_scene(scene, {"event": [{**table, "duty": duty, "duration_s": 900.0}]})
    time_s, least = np.arange(0, 900, 0.1), np.cos(np.pi * duty)
    peaks_s = []
    for state in range(40):
        (event,) = events_of_sequence(loaded, state)
        fraction = np.array([event.fraction(t) for t in time_s])
        np.testing.assert_allclose(fraction[900:], fraction[:-900], atol=1e-9)
        assert fraction.max() == pytest.approx(1, abs=1e-4)
        assert (fraction > 0).mean() == pytest.approx(duty, abs=2 / 900)  # two edges within steps of 900
        assert fraction.mean() == pytest.approx(
            (np.sin(np.pi * duty) / np.pi - least * duty) / (1 - least), abs=1e-4
        )
        assert event.fraction(900.0) == event.fraction(-0.1) == 0
        peaks_s.append(time_s[np.argmax(fraction[:900])])
    # uniform over the period: Kolmogorov's limit for 40 at 1e-3 is 1.95 / √40
    assert np.abs(np.sort(peaks_s) / 90 - (np.arange(40) + 0.5) / 40).max() < 1.95 / np.sqrt(40)


def test_times_of_events_are_drawn_within_their_bounds_for_each_sequence(scene: Path) -> None:
    """Of 400 uniform numbers, the mean is within three of its errors, 0.29 / 20 of the width."""
    table = {"cause": "c", "faults": ["dust_on_optics"], "onset_s": [2.0, 6.0], "duration_s": [1.0, 3.0]}
    loaded = config.load_scene(scene, {"event": [table, {**table, "cause": "d"}]})
    drawn = [events_of_sequence(loaded, state) for state in range(400)]
    onset = np.array([[event.onset_s for event in events] for events in drawn])
    length = np.array([[event.end_s - event.onset_s for event in events] for events in drawn])
    assert (onset.min(), onset.max()) == (pytest.approx(2, abs=0.05), pytest.approx(6, abs=0.05))
    assert abs(onset.mean() - 4) < 3 * 4 * 0.29 / np.sqrt(800)
    assert (length.min(), length.max()) == (pytest.approx(1, abs=0.03), pytest.approx(3, abs=0.03))
    correlation = np.corrcoef([*onset.T, *length.T]) - np.eye(4)
    assert np.abs(correlation).max() < 0.2  # four times 1 / √400
    assert drawn[7] == events_of_sequence(loaded, 7)


def test_an_event_brings_all_of_its_faults_and_takes_them_away(scene: Path, tmp_path: Path) -> None:
    """What the store says of events is what changes in the pixels of its frames."""
    scene.write_text(scene.read_text() + EVENTS)
    out = tmp_path / "s.zarr"
    summary = vbnfault.build(scene, out, progress=False)
    assert vbnfault.verify(out).problems == []
    with vbnfault.open_dataset(out) as data:
        injected = data["injected"].values
        changed = (data["image"].values != data["clean"].values).any(axis=(1, 2, 3))
        parameters = [json.loads(text) for text in data["parameters"].values]
    time_s, sequence = np.array(columns()["time_s"]), np.repeat(range(3), FRAMES)
    listed = vbnfault.events(out)
    expected = np.zeros((9, 2), bool)
    for event in listed:
        assert (event.cause, event.end_s) == ("dust event", pytest.approx(event.onset_s + 2))
        mine = sequence == NAMES.index(event.sequence)
        active = mine & (time_s >= event.onset_s) & (time_s < event.end_s)
        expected[active, ["dust_on_optics", "cosmic_rays"].index(event.fault)] = True
        frames = (np.flatnonzero(active) - np.flatnonzero(mine)[0]).tolist()
        assert (event.first_frame, event.last_frame, event.frames) == (frames[0], frames[-1], len(frames))
    assert {event.sequence for event in listed} == {"approach", "leave"}  # the other has one frame, at 0 s
    assert {event.fault for event in listed} == {"dust_on_optics", "cosmic_rays"}
    onsets = {event.sequence: event.onset_s for event in listed}
    assert [event.onset_s for event in listed] == [onsets[event.sequence] for event in listed]
    np.testing.assert_array_equal(injected, expected)
    for counts in (vbnfault.statistics(out).counts, summary.counts):
        for c, fault in enumerate(("dust_on_optics", "cosmic_rays")):
            assert counts.planned(fault) == counts.realised(fault) == expected[:, c].sum()
    np.testing.assert_array_equal(changed, expected.any(axis=1))
    assert {one["dust_on_optics"]["event"]["cause"] for one in parameters if one} == {"dust event"}


MODELS = {fault: list(models) for fault, models in registry().items()}
SUN_BEHIND, SUN_AHEAD = (0.0, 1.0, 0.0), (0.0, -0.98, 0.199)  # and 17 degrees from the axis, beside the body


@pytest.mark.parametrize("number", range(max(map(len, MODELS.values()))))
def test_every_fault_changes_the_frames_of_its_event_and_no_other(tmp_path: Path, number: int) -> None:
    """Four frames at 0, 1, 2 and 3 s, an event from 1 s to before 3 s: frames 1 and 2 differ from the clean ones.

    Each class has a sequence of its own, and the model with this number. The Sun is behind the camera, and for
    straylight in the frame, beside the body. What is left of the frame before, by `persistence` and `frozen_frame`,
    acts in frame 1 already: frame 0 is there, although it has no fault.
    """
    chosen = {fault: {"model": models[number]} for fault, models in MODELS.items() if len(models) > number}
    if "pixel_overwriting" in chosen:
        chosen["pixel_overwriting"]["texture_file"] = str(tmp_path / "texture.png")
        assert cv2.imwrite(str(tmp_path / "texture.png"), np.full((8, 8, 4), 200, np.uint8))
    if chosen.get("broken_pixels", {}).get("model") == "hot_pixels":
        chosen["broken_pixels"]["dose_TeV_g"] = 10.0  # 1024 pixels of a young sensor may have no defect
    if "particles" in chosen:
        chosen["particles"]["density_per_m3"] = 20.0  # so that each frame shows some
    keys = {
        "faults": chosen,
        "plan.classes_per_sample": [1, 1],
        "camera.width_px": 40,
        "camera.height_px": 40,
        "camera.exposure_s": 0.04,  # so long that some pixels are full, as blooming needs
        "dataset.shard_samples": 4,
        "event": [
            {"cause": f"cause of {fault}", "faults": [fault], "onset_s": 1.0, "duration_s": 2.0} for fault in chosen
        ],
    }
    path = write_scene(tmp_path)
    order, fault_of = dataset_order(chosen), [""] * len(chosen)
    for _ in range(2):  # which sequence has which class does not depend on the Suns, but these on the classes
        suns = [SUN_AHEAD if fault == "straylight" else SUN_BEHIND for fault in fault_of]
        poses = [row(f"{k}/{t}", (0.0, 9e3 - t, 0.9e3), sun) for k, sun in enumerate(suns) for t in range(4)]
        names, time_s = [f"s{k}" for k in range(len(suns))], [0.0, 1.0, 2.0, 3.0] * len(suns)
        table = {**columns_of(poses), "sequence": np.repeat(names, 4).tolist(), "time_s": time_s}
        write(tmp_path / "poses.csv", table)
        scene = config.load_scene(path, keys)
        planned = vbnfault.Session(scene).plan.injected
        fault_of = [order[k] for k in planned[::4].argmax(axis=1)]
    out = tmp_path / "s.zarr"
    vbnfault.build(scene, out, progress=False)
    with vbnfault.open_dataset(out) as data:
        changed = (data["image"].values != data["clean"].values).any(axis=(1, 2, 3)).reshape(-1, 4)
        injected = data["injected"].values.reshape(-1, 4, len(chosen))
    assert sorted(fault_of) == sorted(chosen)
    during = [False, True, True, False]
    for k, fault in enumerate(fault_of):
        model = f"{fault}/{chosen[fault]['model']}"
        assert changed[k].tolist() == during, model
        assert injected[k].any(axis=1).tolist() == injected[k, :, order.index(fault)].tolist() == during, model
    listed = [
        (e.sequence, e.fault, e.cause, e.onset_s, e.end_s, e.first_frame, e.last_frame, e.frames)
        for e in vbnfault.events(out)
    ]
    assert listed == [
        (name, fault, f"cause of {fault}", 1.0, 3.0, 1, 2, 2) for name, fault in zip(names, fault_of, strict=True)
    ]


def test_a_store_tells_profiles_of_temperature_and_resets(scene: Path, tmp_path: Path) -> None:
    """Grains follow the temperature; rays come from 0 s to the reset at 2 s, so in frames 0 and 1."""
    tables = [
        {"cause": "heat", "faults": ["dust_on_optics"], "onset_s": 0.0, "profile": "thermal", "period_s": 9.0},
        {"cause": "latch-up", "faults": ["cosmic_rays"], "onset_s": 0.0, "profile": "until_reset", "reset_s": 2.0},
    ]
    keys = {"event": tables, "faults.dust_on_optics.count": 40}
    loaded, out = config.load_scene(scene, keys), tmp_path / "s.zarr"
    vbnfault.build(loaded, out, progress=False)
    with vbnfault.open_dataset(out) as data:
        parameters = [json.loads(text) for text in data["parameters"].values][4:]
    (heat, _) = events_of_sequence(loaded, 4)
    fractions = [heat.fraction(float(t)) for t in range(5)]
    grains = [one.get("dust_on_optics", {"x_mm": [], "event": {"fraction": 0}}) for one in parameters]
    assert [one["event"]["fraction"] for one in grains] == fractions
    assert [len(one["x_mm"]) for one in grains] == [max(1, round(40 * f)) if f else 0 for f in fractions]
    assert 0 < fractions.count(0.0) < 5
    listed = {event.fault: event for event in vbnfault.events(out) if event.sequence == "leave"}
    rays, dust = listed["cosmic_rays"], listed["dust_on_optics"]
    assert (rays.cause, rays.end_s, rays.first_frame, rays.last_frame, rays.frames) == ("latch-up", 2, 0, 1, 2)
    assert (dust.cause, dust.end_s, dust.largest_fraction) == ("heat", None, max(fractions))


def test_common_causes_strike_together(scene: Path) -> None:
    scene.write_text(scene.read_text() + EVENTS)
    keys = {"plan.classes_per_sample": [1, 1], "plan.faulty_fraction": 0.7}
    loaded = config.load_scene(scene, keys)
    frames = (2,) * 50
    loaded = loaded.model_copy(
        update={
            "dataset": loaded.dataset.model_copy(update={"samples": 100, "sites": 50}),
            "trajectory": loaded.trajectory.model_copy(update={"frames": frames}),
        }
    )
    without = plan.make_plan(loaded.model_copy(update={"event": ()}), ["dust_on_optics", "cosmic_rays"])
    together = plan.make_plan(loaded, ["dust_on_optics", "cosmic_rays"])
    assert not without.injected.all(axis=1).any()
    np.testing.assert_array_equal(together.injected[:, 0], without.injected[:, 0])
    np.testing.assert_array_equal(together.injected[:, 1], without.injected[:, 0])


def test_an_event_strikes_only_the_sequences_that_carry_its_first_fault(scene: Path) -> None:
    """A brings b with a, B brings c with b: so a brings all three, b brings c, and of b alone the cause is B."""
    tables = [
        {"cause": "A", "faults": ["dust_on_optics", "vignetting"], "onset_s": 1.0},
        {"cause": "B", "faults": ["vignetting", "cosmic_rays"], "onset_s": 2.0},
    ]
    keys = {"faults.vignetting.model": "lens", "plan.classes_per_sample": [1, 1], "event": tables}
    loaded = config.load_scene(scene, keys)
    loaded = loaded.model_copy(
        update={
            "dataset": loaded.dataset.model_copy(update={"samples": 60, "sites": 60}),
            "trajectory": loaded.trajectory.model_copy(update={"frames": (1,) * 60}),
        }
    )
    order = ["dust_on_optics", "vignetting", "cosmic_rays"]
    rows = {tuple(row) for row in plan.make_plan(loaded, order).injected.tolist()}
    assert rows == {
        (True, True, True),
        (False, True, True),
        (False, False, False),
    }  # rays alone: nothing brings them
    events = events_of_sequence(loaded, 0)
    assert [event.cause for event in striking(events, ["vignetting", "cosmic_rays"])] == ["B"]
    assert commanded_now(loaded, order, [False, True, True], 0, 1.5) == [False, False, False]
    assert commanded_now(loaded, order, [True, True, True], 0, 1.5) == [True, True, False]
    assert commanded_now(loaded, order, [False, True, True], 0, 2.5) == [False, True, True]


def test_calls_with_a_sequence_and_without_one_do_not_mix(scene: Path) -> None:
    table = config.load_scene(scene).resolved()
    table |= {"trajectory": None, "dataset": table["dataset"] | {"samples": 2, "sites": 1}}
    session = vbnfault.Session(config.parse_scene(table, source="test"))
    row_of = {name: values[0] for name, values in columns().items() if name not in ("sequence", "time_s")}
    alone = session.take(row_of, sample=1).scalars["parameters"]["dust_on_optics"]
    framed = session.take({**row_of, "sequence": "s", "time_s": 0.0}, sample=1).scalars["parameters"][
        "dust_on_optics"
    ]
    again = session.take(row_of, sample=1).scalars["parameters"]["dust_on_optics"]
    assert alone == again != framed


def test_a_scene_without_sequences_has_the_identity_of_before(scene: Path) -> None:
    assert "event" not in scene_identity(vbnfault.Session(config.load_scene("quickstart")))
    table = columns()
    del table["sequence"], table["time_s"]
    write(scene.parent / "poses.csv", table)
    plain = scene_identity(vbnfault.Session(config.load_scene(scene)))
    assert set(plain["trajectory"]) == {"file"}


def test_a_growing_fault_keeps_what_was_there(scene: Path) -> None:
    event = {"cause": "storm", "faults": ["dust_on_optics"], "onset_s": -1.0, "profile": "growing", "rise_s": 5.0}
    session = vbnfault.Session(config.load_scene(scene, {"event": [event]}))
    grains = [session.simulate(k).scalars["parameters"]["dust_on_optics"]["x_mm"] for k in range(4, 9)]
    assert [len(one) for one in grains] == [round(len(grains[-1]) * f) for f in (0.2, 0.4, 0.6, 0.8, 1)]
    assert all(after[: len(before)] == before for before, after in itertools.pairwise(grains))


@pytest.mark.parametrize(
    ("fault", "model", "fraction", "smaller"),
    [
        ("dust_on_optics", "gaussian", 0.5, {"x_px": 2, "peak_dn": 2}),
        ("broken_pixels", "texture", 0.25, {"x": 1, "y": 1, "brightness_dn": 1}),
        ("broken_lines", "texture", 0.5, {"rows": 2, "row_values": 2, "columns": 2}),
        ("broken_lines", "readout", 0.5, {"lines": 2}),
        ("optics_degradation", "contamination", 0.5, {"haze": 0.2, "coating_loss": 0.2, "scratches": 2}),
        ("vignetting", "lens", 0.5, {"decentre": 0.2, "decentre_mm": [0.2, 0.2]}),
    ],
)
def test_models_grow(fault: str, model: str, fraction: float, smaller: dict[str, Any]) -> None:
    lists = ("x_px", "y_px", "peak_dn", "sigma_xx", "sigma_yy", "sigma_xy", "x", "y", "brightness_dn", "lines")
    lists += ("rows", "row_values", "columns", "column_values", "scratches")
    params = {name: [1, 2, 3, 4] for name in lists}
    params |= dict.fromkeys(("haze", "dose_krad", "coating_loss", "decentre"), 0.4)
    params |= {"decentre_mm": [0.4, 0.4], "hood_offset_mm": [0.4, 0.4]}
    cls = registry()[fault][model]
    grown = cls.grown(cls(), params, fraction)
    for name, value in smaller.items():
        now = len(grown[name]) if isinstance(value, int) else grown[name]
        assert now == (pytest.approx(value) if not isinstance(value, int) else value)
    assert cls.grown(cls(), params, 1.0) == params
    assert cls.grown(cls(), {**params, "lines": [], "x": []}, 1e-9).get("lines") == []


def test_events_are_listed_by_the_command(scene: Path, tmp_path: Path, call: Callable[..., Called]) -> None:
    scene.write_text(scene.read_text() + EVENTS.replace(', "cosmic_rays"', ""))
    out, table = tmp_path / "s.zarr", tmp_path / "events.csv"
    vbnfault.build(scene, out, progress=False)
    lines = call("events", out).out.splitlines()
    assert any(
        re.match(r"leave: dust_on_optics: dust event, from .* s to .* s; in \d frames, \d to \d", line)
        for line in lines
    )
    assert "still: cosmic_rays: from the start; in 1 frames, 0 to 0" in lines
    assert call("events", out, "--out", table).out.strip() == f"{table}: {len(lines)} events"
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == len(lines)
    assert {row["onset_s"] for row in rows if row["fault"] == "cosmic_rays"} == {""}
    assert call("events", tmp_path / "none.zarr").code == 2


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"cause": "", "faults": ["dust_on_optics"], "onset_s": 1.0}, r"event\[0\]\.cause"),
        (
            {"cause": "c", "faults": ["glint"], "onset_s": 1.0},
            r"event\[0\]\.faults: 'glint' is no fault class of the scene; it has dust",
        ),
        ({"cause": "c", "faults": [], "onset_s": 1.0}, r"event\[0\]\.faults"),
        ({"cause": "c", "faults": ["dust_on_optics"] * 2, "onset_s": 1.0}, r"given twice"),
        ({"cause": "c", "faults": ["dust_on_optics"]}, r"event\[0\]\.onset_s"),
        ({"cause": "c", "faults": ["dust_on_optics"], "onset_s": [3.0, 1.0]}, r"event\[0\]\.onset_s"),
        (
            {"cause": "c", "faults": ["dust_on_optics"], "onset_s": 1.0, "duration_s": 0.0},
            r"event\[0\]\.duration_s",
        ),
        ({"cause": "c", "faults": ["dust_on_optics"], "onset_s": 1.0, "profile": "slow"}, r"event\[0\]\.profile"),
        ({"cause": "c", "faults": ["dust_on_optics"], "onset_s": 1.0, "profile": "growing"}, r"rise_s must be set"),
        ({"cause": "c", "faults": ["dust_on_optics"], "onset_s": 1.0, "rise_s": 1.0}, r"rise_s must not be set"),
        (
            {"cause": "c", "faults": ["dust_on_optics"], "onset_s": 1.0, "profile": "thermal"},
            r'profile = "thermal": period_s must be set; it is for the profile intermittent or thermal',
        ),
        (
            {"cause": "c", "faults": ["dust_on_optics"], "onset_s": 1.0, "profile": "until_reset"},
            r"reset_s must be set; it is for the profile until_reset",
        ),
        ({"cause": "c", "faults": ["dust_on_optics"], "onset_s": 1.0, "reset_s": 2.0}, r"reset_s must not be set"),
        (
            {
                "cause": "c",
                "faults": ["dust_on_optics"],
                "onset_s": [1.0, 5.0],
                "profile": "until_reset",
                "reset_s": [4.0, 9.0],
            },
            r"reset_s = 4: must be later than onset_s, which is up to 5",
        ),
        (
            {
                "cause": "c",
                "faults": ["dust_on_optics"],
                "onset_s": 1.0,
                "profile": "intermittent",
                "period_s": 1.0,
                "duty": 1.5,
            },
            r"event\[0\]\.duty",
        ),
    ],
)
def test_a_wrong_event_is_told_in_a_sentence(scene: Path, table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        config.load_scene(scene, {"event": [table]})
    assert "\n" not in str(caught.value)


def test_events_need_sequences(scene: Path) -> None:
    table = columns()
    del table["sequence"], table["time_s"]
    write(scene.parent / "poses.csv", table)
    scene.write_text(scene.read_text() + EVENTS)
    with pytest.raises(
        InputError, match=r"event: 'dust event' happens at a time of a sequence, and the scene has none"
    ):
        vbnfault.Session(config.load_scene(scene)).simulate(0)
    with pytest.raises(InputError, match="and the scene has none"):
        vbnfault.build(scene, scene.parent / "s.zarr", progress=False)
    with pytest.raises(InputError, match="event: images of one's own have no times; leave the events out"):
        vbnfault.Injector(config.load_scene(scene))
