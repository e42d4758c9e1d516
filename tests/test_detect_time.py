"""Figures of events in time: delay, missed events, false alarms an hour and flicker, against counts by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frames_kit import EVENTS, FRAMES, SCENE, write_scene

import vbnfault
from vbnfault.detect.prediction import Prediction
from vbnfault.detect.scored_samples import ALL, ScoreOptions
from vbnfault.detect.scoring import score
from vbnfault.detect.time_scores import Frames, time_figures

CLASSES = ("dust_on_optics", "broken_lines")


def frames(said: list[list[int]], injected: list[list[int]], step_s: float = 2.0, **events: Any) -> Frames:
    """Return two sequences of six frames each, from what is said and injected of each class in each of them.

    `events` are the onsets by class, one for each frame.
    """
    order = np.random.default_rng(0).permutation(12)
    parameters = [
        {
            name: {"event": {"onset_s": events[name][k]}} if name in events else {}
            for c, name in enumerate(CLASSES)
            if injected[c][k]
        }
        for k in range(12)
    ]
    return Frames.of(
        np.repeat([4, 7], 6)[order],
        np.tile(np.arange(6) * step_s + 100, 2)[order],
        np.array(injected, bool).T[order],
        np.array(said, bool).T[order],
        [parameters[k] for k in order],
        CLASSES,
    )


def test_delays_misses_alarms_and_flicker_by_hand() -> None:
    injected = [[0, 0, 1, 1, 1, 1, 0, 1, 1, 1, 0, 0], [0] * 12]
    said = [[1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 1], [0, 1, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0]]
    found = time_figures(frames(said, injected), CLASSES, 0)
    assert (found["sequences"], found["hours"]) == (2, pytest.approx(24 / 3600))  # twelve frames of 2 s
    dust, lines = (found["classes"][name] for name in CLASSES)
    assert dust["events"] == 2
    assert dust["missed_fraction"]["value"] == 0.5  # that of the second sequence
    assert dust["delay_s_median"]["value"] == dust["delay_s_largest"] == 2.0  # a frame
    # alarms begin in the first frame of all, and behind the event of the second sequence
    assert dust["false_alarms_per_hour"]["value"] == pytest.approx(2 / (24 / 3600))
    # as the frame before are 1, 3, 4, 5 and 8, 9, 11; said otherwise in 1, 3, 4, 5
    assert dust["flicker"]["value"] == pytest.approx(4 / 7)
    assert (lines["events"], lines["missed_fraction"]["value"], lines["delay_s_largest"]) == (0, None, None)
    assert lines["false_alarms_per_hour"]["value"] == pytest.approx(2 / (24 / 3600))
    assert lines["flicker"]["value"] == pytest.approx(4 / 10)
    both = found["all"]
    assert (both["events"], both["missed_fraction"]["value"]) == (2, 0.5)
    assert both["false_alarms_per_hour"]["value"] == pytest.approx(4 / (24 / 3600))
    assert both["flicker"]["value"] == pytest.approx(8 / 17)


def test_an_intermittent_fault_is_one_event_and_two_onsets_are_two() -> None:
    injected = [[0, 1, 0, 1, 0, 1, 0, 0, 0, 0, 0, 0], [0] * 12]
    said = [[0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0], [0] * 12]
    one = time_figures(frames(said, injected, dust_on_optics=[1.0] * 12), CLASSES, 0)["classes"]["dust_on_optics"]
    assert (one["events"], one["missed_fraction"]["value"], one["delay_s_largest"]) == (1, 0.0, 6.0)
    assert one["false_alarms_per_hour"]["value"] == 0  # said in a pause of the event
    onsets = [1.0, 1.0, 1.0, 5.0, 5.0, 5.0] * 2
    two = time_figures(frames(said, injected, dust_on_optics=onsets), CLASSES, 0)["classes"]["dust_on_optics"]
    assert (two["events"], two["missed_fraction"]["value"], two["delay_s_largest"]) == (2, 0.5, 2.0)


def test_a_perfect_monitor_has_no_delay_and_no_alarm() -> None:
    rng = np.random.default_rng(3)
    injected = (rng.random((2, 12)) < 0.5).astype(int).tolist()
    found = time_figures(frames(injected, injected), CLASSES, 0)["all"]
    assert (found["missed_fraction"]["value"], found["delay_s_largest"]) == (0.0, 0.0)
    assert (found["false_alarms_per_hour"]["value"], found["flicker"]["value"]) == (0.0, 0.0)


def test_the_median_of_all_classes_is_over_events_also_where_two_begin_in_one_frame() -> None:
    """Delays of 0, 10, 0 and 2 s, of which two begin in the first frame of each sequence."""
    said = [[1] * 12, [0, 0, 0, 0, 0, 1, 0, 1, 1, 1, 1, 1]]
    found = time_figures(frames(said, [[1] * 12, [1] * 12]), CLASSES, 0)["all"]
    assert (found["events"], found["delay_s_largest"], found["delay_s_median"]["value"]) == (4, 10.0, 1.0)


def test_intervals_are_over_sequences() -> None:
    """One of two sequences has the event that is missed: resamples hold none, one or two of it."""
    injected = [[1] * 12, [0] * 12]
    said = [[1] * 6 + [0] * 6, [0] * 12]
    missed = time_figures(frames(said, injected), CLASSES, 0)["classes"]["dust_on_optics"]["missed_fraction"]
    assert missed == {"value": 0.5, "low": 0.0, "high": 1.0}


def test_a_single_frame_stands_for_no_time() -> None:
    one = Frames.of(
        np.array([0]), np.array([5.0]), np.ones((1, 1), bool), np.ones((1, 1), bool), [{"x": [1]}], ("x",)
    )
    found = time_figures(one, ("x",), 0)
    assert found["hours"] == 0
    assert found["all"]["false_alarms_per_hour"]["value"] is None
    assert found["all"]["delay_s_largest"] == 0


class Always:
    """Say of every image that it has dust."""

    classes = ("dust_on_optics",)

    def predict(self, images: np.ndarray) -> list[Prediction]:
        empty = np.zeros((1, *images.shape[1:3]), np.float32)
        return [
            Prediction(masks=empty, present=np.ones(1), severity=np.full(1, np.nan), usable_fraction=1.0)
            for _ in images
        ]


def test_a_store_of_sequences_is_scored_in_time(tmp_path: Path) -> None:
    store = tmp_path / "s.zarr"
    vbnfault.build(write_scene(tmp_path, SCENE + EVENTS), store, progress=False)
    result = score(Always(), store, tmp_path / "score", ScoreOptions(split=ALL, navigation=False))
    listed = vbnfault.events(store)
    time = result["time"]
    assert time["sequences"] == len(FRAMES)
    assert time["hours"] == pytest.approx((3 + 5) / 3600)  # of one frame nobody knows
    assert {name: one["events"] for name, one in time["classes"].items()} == {
        name: sum(event.fault == name for event in listed) for name in ("dust_on_optics", "cosmic_rays")
    }
    dust, rays = time["classes"]["dust_on_optics"], time["classes"]["cosmic_rays"]
    assert (dust["missed_fraction"]["value"], dust["delay_s_largest"]) == (0, 0)
    assert rays["missed_fraction"]["value"] == 1
    assert dust["false_alarms_per_hour"]["value"] > 0
    for file in ("score.md", "score.html"):
        assert "Events in time" in (tmp_path / "score" / file).read_text()
