"""A fault monitor's log, scored in time: delays, alarms and reactions against counts by hand, and its mistakes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.csv
import pyarrow.parquet
import pytest
from conftest import Called
from sequences_kit import sequences
from synthetic import make_spec

from vbnfault.core.errors import InputError
from vbnfault.detect.scored_samples import ALL, ScoreOptions
from vbnfault.detect.scoring import score
from vbnfault.scene.events import EventTable
from vbnfault.store import Store, create

# Frames a second apart, from 5 s on: 9 of `approach`, 1 of `still`, 12 of `leave: night/day`. Dust is in the frames
# from 3 on, broken pixels in the odd ones, vignetting from 5 on, straylight in none.
EVENTS = [
    {"cause": "dust event", "faults": ["dust_on_optics"], "onset_s": 8.0},
    {
        "cause": "heat",
        "faults": ["broken_pixels"],
        "onset_s": 6.0,
        "profile": "intermittent",
        "period_s": 2.0,
    },
    {"cause": "latch-up", "faults": ["vignetting"], "onset_s": 10.0, "profile": "until_reset", "reset_s": 99.0},
]
LOG = """sequence,time_s,class,reaction,present
approach,5,any,,1
approach,6,any,,0
approach,9.004,dust_on_optics,isolate,1
approach,6,broken_pixels,reset,1
approach,7,broken_pixels,wait,1
approach,8,broken_pixels,,0
leave: night/day,14,vignetting,reset,1
leave: night/day,12.5,,wait,1
leave: night/day,15,any,,0
leave: night/day,5,vignetting,,1
leave: night/day,6,vignetting,,0
"""
HOURS = 21 / 3600  # 9 and 12 frames of 1 s; that of a single frame is unknown


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    drawn = {one["faults"][0]: {"event": {"cause": one["cause"], "onset_s": one["onset_s"]}} for one in EVENTS}
    scene = {"body": {"name": "67P"}, "event": EVENTS}
    attributes = {"scene": scene, "scene_hash": "abc", "seed": 7}
    path = tmp_path_factory.mktemp("log") / "s.zarr"
    return sequences(path, step_s=1.0, drawn=drawn, attributes=attributes)


def scored(log: Path, store: Store, split: str = ALL) -> dict[str, Any]:
    return dict(score(log, store, log.parent / "score", ScoreOptions(split=split)))


def by_frame(log: Path) -> Path:
    """Write a log as Parquet with numbers of frames in place of times, and return its path."""
    table = pyarrow.csv.read_csv(log)
    frames = [4 if t == 9.004 else 8 if t == 12.5 else int(t - 5) for t in table["time_s"].to_pylist()]
    table = table.drop_columns("time_s").append_column("frame", [frames])
    pyarrow.parquet.write_table(table, log.with_suffix(".parquet"))
    return log.with_suffix(".parquet")


@pytest.mark.parametrize("written", [lambda log: log, by_frame])
def test_a_log_is_scored_as_counted_by_hand(tmp_path: Path, store: Store, written: Callable[[Path], Path]) -> None:
    log = tmp_path / "log.csv"
    log.write_text(LOG)
    result = scored(written(log), store)
    time = result["time"]
    assert (time["sequences"], time["hours"], result["samples"]) == (3, pytest.approx(HOURS), 22)
    values = {
        name: (
            one["events"],
            one["missed_fraction"]["value"],
            one["delay_s_median"]["value"],
            one["delay_s_largest"],
            round((one["false_alarms_per_hour"]["value"] or 0) * HOURS, 9),
            one["flicker"]["value"],
        )
        for name, one in {**time["classes"], "any": time["any"], "all": time["all"]}.items()
    }
    assert values == {
        # told in frame 4 of 3 to 8, and by `any` in frame 8 of 3 to 11; 7 and 10 frames are like the one before
        "dust_on_optics": (2, 0.0, 3.0, 5.0, 0.0, pytest.approx(1 / 17)),
        # in frame 1 of 1 to 7, and by `any` in frame 8 of 1 to 11; no frame is like the one before
        "broken_pixels": (2, 0.0, 3.5, 7.0, 0.0, None),
        "straylight": (0, None, None, None, 0.0, 0.0),
        # never, and by `any` in frame 8 of 5 to 11; said in frame 0, and again from 9 on
        "vignetting": (2, 0.5, 3.0, 3.0, 1.0, pytest.approx(2 / 17)),
        # frame 0 of `approach` has no fault; frames 4 to 8 and 4 to 11 are like the one before
        "any": (0, None, None, None, 1.0, pytest.approx(2 / 13)),
        "all": (6, pytest.approx(1 / 6), 3.0, 7.0, 2.0, pytest.approx(5 / (17 + 19 + 17 + 13))),
    }
    assert time["reactions"]["given"] == {
        "isolate": {"isolate": 1, "reset": 0, "wait": 1, "none": 0},
        "reset": {"isolate": 0, "reset": 0, "wait": 1, "none": 1},
        "wait": {"isolate": 0, "reset": 1, "wait": 1, "none": 0},
    }
    # resamples hold none, one or two of the sequences with an event, in each of which one of three is right
    assert time["reactions"]["right_fraction"] == pytest.approx({"value": 1 / 3, "low": 1 / 3, "high": 1 / 3})
    for file in ("score.md", "score.html"):
        page = (tmp_path / "score" / file).read_text()
        assert all(text in page for text in ("Events in time", "Reactions", "isolate given"))
        assert "Navigation" not in page


def test_a_split_and_a_log_without_reactions(tmp_path: Path, store: Store) -> None:
    """The split test is the sequence `leave`; a log that says nothing misses all, and reacts to nothing."""
    log = tmp_path / "log.csv"
    log.write_text("sequence,frame,class\nleave: night/day,4,dust_on_optics\n")
    time = scored(log, store, "test")["time"]
    assert (time["sequences"], time["all"]["events"], "any" in time) == (1, 3, False)
    assert time["classes"]["dust_on_optics"]["delay_s_largest"] == 1
    assert time["reactions"]["right_fraction"]["value"] == 0
    assert [one["none"] for one in time["reactions"]["given"].values()] == [1, 1, 1]
    log.write_text("sequence,frame,class\n")
    assert scored(log, store)["time"]["all"]["missed_fraction"]["value"] == 1


@pytest.mark.parametrize(
    ("keys", "reaction"),
    [
        ({}, "isolate"),
        ({"profile": "growing", "rise_s": 3.0}, "isolate"),
        ({"duration_s": 5.0}, "wait"),
        ({"profile": "growing", "rise_s": 3.0, "duration_s": 5.0}, "wait"),
        ({"profile": "intermittent", "period_s": 3.0}, "wait"),
        ({"profile": "thermal", "period_s": 3.0}, "wait"),
        ({"profile": "until_reset", "reset_s": 3.0}, "reset"),
        ({"profile": "until_reset", "reset_s": 3.0, "duration_s": 9.0}, "reset"),
    ],
)
def test_the_right_reaction_follows_from_the_profile(keys: dict[str, Any], reaction: str) -> None:
    assert EventTable(cause="c", faults=("adc",), onset_s=1.0, **keys).reaction == reaction


def test_a_log_is_scored_by_the_command(tmp_path: Path, store: Store, call: Callable[..., Called]) -> None:
    log, out = tmp_path / "log.csv", tmp_path / "out"
    log.write_text(LOG)
    done = call("score", log, store.path, "--out", out, "--split", "all")
    assert done.code == 0
    for line in ("events missed: 0.1667", "median delay in s: 3", "false alarms an hour: 342.9"):
        assert line in done.out
    assert "right reactions: 0.3333" in done.out
    result = json.loads((out / "score.json").read_text())
    assert result["model"]["classes"] == ["dust_on_optics", "broken_pixels", "vignetting", "any"]
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "benchmark.json").write_text("{}")
    assert "a log is scored on one dataset" in call("score", log, tmp_path / "bench", "--out", out).err


@pytest.mark.parametrize(
    ("header", "row", "sentence"),
    [
        (
            "sequence,time_s,class",
            "approach,5,glint",
            r"row 1: class = 'glint': must be one of dust_on_optics, .*any",
        ),
        ("sequence,time_s,class", "away,5,any", r"row 1: sequence = 'away': must be one of approach, still, leave"),
        (
            "sequence,time_s,class",
            "approach,14,any",
            r"row 1: time_s = 14: must be from 5 to 13 in the .* approach",
        ),
        ("sequence,frame,class", "still,1,any", r"row 1: frame = 1: must be from 0 to 0 in the sequence still"),
        ("sequence,frame,class", "still,soon,any", r"row 1: frame = 'soon': must be a number from 0 to 1000000000"),
        (
            "sequence,time_s,class,reaction",
            "approach,5,any,run",
            r"row 1: reaction = 'run': must be one of isolate, reset",
        ),
        (
            "sequence,time_s,class,present",
            "approach,5,any,2",
            r"row 1: present = '2': must be a number from 0 to 1",
        ),
        ("sequence,class", "approach,any", r"columns are missing: time_s or frame \(one of them\); a log has"),
        (
            "sequence,time_s,frame,class",
            "approach,5,0,any",
            r"columns are missing: time_s or frame \(one of them\)",
        ),
        ("sequence,time_s", "approach,5", r"columns are missing: class; a log has the columns sequence, class"),
        ("sequence,time_s,class,pose", "approach,5,any,1", r"unknown columns: 'pose'; a log has"),
        ("sequence,time_s,class,class", "approach,5,any,any", r"column 'class' stands twice"),
    ],
)
def test_a_wrong_log_is_told_in_a_sentence(
    tmp_path: Path, store: Store, header: str, row: str, sentence: str
) -> None:
    log = tmp_path / "log.csv"
    log.write_text(f"{header}\n{row}\n")
    with pytest.raises(InputError, match=rf"log\.csv: {sentence}") as caught:
        scored(log, store)
    assert "\n" not in str(caught.value)


def test_a_log_needs_sequences_and_has_no_masks(tmp_path: Path, store: Store) -> None:
    log = tmp_path / "log.csv"
    log.write_text(LOG)
    still = create(tmp_path / "still.zarr", make_spec(24), 4)
    with pytest.raises(InputError, match=r"still\.zarr: has no sequences, so a log cannot be scored in time"):
        scored(log, still)
    with pytest.raises(InputError, match=r"a log has no masks; leave out masks and calibrate"):
        score(log, store, tmp_path / "out", ScoreOptions(split=ALL, masks="effect"))
    with pytest.raises(InputError, match=r"none\.csv: data file not found"):
        scored(tmp_path / "none.csv", store)
