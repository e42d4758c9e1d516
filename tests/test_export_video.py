"""Films of sequences: what PyAV reads back is the store, frame by frame, at its times."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from conftest import Called
from sequences_kit import FRAMES, STEP_S, sequences
from test_export import tree

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.output.contact_sheet import COLOURS
from vbnfault.output.export import export_store
from vbnfault.output.export.formats.video import _film

FILES = ("train/{}/0_approach.mp4", "val/{}/1_still.mp4", "test/{}/2_leave_night_day.mp4")
FIRST = (0, FRAMES[0], FRAMES[0] + FRAMES[1])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> st.Store:
    return sequences(tmp_path_factory.mktemp("films") / "s.zarr")


@pytest.fixture(scope="module")
def exported(data: st.Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("films") / "e"
    assert export_store(data, out, "video", progress=False).warnings == ()
    return out


def frames(path: Path) -> tuple[np.ndarray, list[float], Fraction]:
    """Return the frames of a film, uint8[frame, y, x, RGB], their times in s, and its rate."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        decoded = [(frame.to_ndarray(format="rgb24"), float(frame.time)) for frame in container.decode(stream)]
        return np.stack([image for image, _ in decoded]), [time for _, time in decoded], stream.average_rate


def test_films_hold_the_frames_in_order_at_their_times(data: st.Store, exported: Path) -> None:
    """The rate factor of 12 is a step of 2.5 DN in the transform: 0.7 DN rms, and 1 DN of YCbCr in limited range.

    Frames differ from the next by 12 DN. A tick of the film's clock is below 1/10000 s.
    """
    for name, first, count in zip(FILES, FIRST, FRAMES, strict=True):
        shown, times, rate = frames(exported / name.format("image"))
        assert shown.shape == (count, 34, 42, 3)  # of 33 and 41: both are even
        stored = data.read("image", first, first + count)[..., :3].astype(float)
        cropped = shown[:, :33, :41].astype(float)
        rms = np.sqrt(np.mean((cropped[:, None] - stored[None]) ** 2, axis=(2, 3, 4)))
        assert np.diag(rms).max() < 2.5
        assert (rms + 100 * np.eye(count)).min() > 5
        assert np.abs(cropped.mean(axis=(1, 2, 3)) - stored.mean(axis=(1, 2, 3))).max() < 2
        np.testing.assert_allclose(shown[:, -1].astype(float), shown[:, -2], atol=6)  # the last row, once more
        seconds = data.read("time_s", first, first + count)
        np.testing.assert_allclose(times, seconds - seconds[0], atol=1e-4)
        assert rate == (1 / Fraction(str(STEP_S)) if count > 1 else 1)


def test_four_pixels_share_the_mean_of_their_colours(tmp_path: Path) -> None:
    """A red pixel counts as much in whichever of the four it is; rounding changes their mean by at most 3 DN."""
    image = np.full((32, 32, 3), 60, np.uint8)
    image[8, 8] = image[8, 17] = image[17, 24] = image[25, 25] = (255, 60, 60)
    with _film(tmp_path / "red.mp4", Fraction(1)) as add:
        add(image)
    shown, *_ = frames(tmp_path / "red.mp4")
    for y, x in ((8, 8), (8, 16), (16, 24), (24, 24)):
        of_four = shown[0, y : y + 2, x : x + 2].astype(float).mean(axis=(0, 1))
        np.testing.assert_allclose(of_four, (60 + 195 / 4, 60, 60), atol=3)


def test_masks_have_the_colours_of_the_contact_sheet(data: st.Store, exported: Path, tmp_path: Path) -> None:
    """Images of 41 px are enlarged eight times, with a caption of 46 px below. Colours have half the resolution."""
    shown, *_ = frames(exported / FILES[0].format("masks"))
    assert shown.shape == (FRAMES[0], 8 * 33 + 46, 8 * 41, 3)
    effects = tmp_path / "effects"
    export_store(data, effects, "video", masks="effect", progress=False)
    effect, *_ = frames(effects / FILES[0].format("masks"))
    y, x = 8 * 22 + 4, 8 * 6 + 4  # within the footprint of dust, from the third frame on
    tinted = 0.7 * data.read("image", 4, 5)[0, 22, 6, :3] + 0.3 * np.array(COLOURS[0])
    np.testing.assert_allclose(shown[4, y, x], tinted, atol=4)
    np.testing.assert_allclose(effect[4, y, x], tinted, atol=4)
    plain = data.read("image", 4, 5)[0, 23, 6, :3]
    np.testing.assert_allclose(effect[4, 8 * 24 - 2, x], plain, atol=4)  # the effect has a row less
    assert np.ptp(shown[4, 8 * 24 - 2, x].astype(int)) > 20
    np.testing.assert_allclose(shown[2, y, x], data.read("image", 2, 3)[0, 22, 6, :3], atol=4)
    assert (effects / FILES[0].format("image")).read_bytes() == (exported / FILES[0].format("image")).read_bytes()


def test_table_and_card_name_the_films(data: st.Store, exported: Path) -> None:
    rows = [json.loads(line) for line in (exported / "samples.jsonl").read_text().splitlines()]
    assert [row["sample"] for row in sorted(rows, key=lambda row: row["sample"])] == list(range(sum(FRAMES)))
    for row in rows:
        assert row["file"] == FILES[row["sequence"]].format("image")
        assert row["frame"] == row["sample"] - FIRST[row["sequence"]]
    card = (exported / "README.md").read_text()
    assert "`test/*/2_leave_night_day.mp4`: 12 frames, 5 a second." in card
    assert sorted(path.relative_to(exported).as_posix() for path in exported.rglob("*.mp4")) == sorted(
        name.format(kind) for name in FILES for kind in ("image", "masks")
    )


def test_an_interrupted_export_makes_only_the_sequences_that_lack(
    data: st.Store, exported: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    read_sample = st.Store.read_sample

    def until_the_last(store: st.Store, index: int, *given: Any) -> Any:
        if index == sum(FRAMES) - 1:
            raise VbnfaultError("the disk is gone")
        return read_sample(store, index, *given)

    out = tmp_path / "e"
    with monkeypatch.context() as patch:
        patch.setattr(st.Store, "read_sample", until_the_last)
        with pytest.raises(VbnfaultError, match="gone"):
            export_store(data, out, "video", workers=2, progress=False)
    assert not [*out.rglob("2_*.mp4")]
    assert export_store(data, out, "video", workers=3, progress=False).written == FRAMES[2]
    assert tree(out) == tree(exported)
    assert export_store(data, out, "video", progress=False).written == 0


def test_the_frame_rate_is_that_asked_for(data: st.Store, tmp_path: Path, call: Callable[..., Called]) -> None:
    out = tmp_path / "e"
    assert call("export", data.path, "--format", "video", "--out", out, "--fps", 12.5).code == 0
    assert [frames(out / name.format("image"))[2] for name in FILES] == [Fraction(25, 2)] * 3
    other = call("export", data.path, "--format", "video", "--out", out)
    assert (other.code, "fps is 12.5 there and None now" in other.said) == (2, True)
    assert call("export", data.path, "--format", "video", "--out", out, "--fps", 2000).code == 2


def test_times_that_a_film_does_not_show_are_said(tmp_path: Path) -> None:
    slow = sequences(tmp_path / "slow.zarr", step_s=600.0)
    summary = export_store(slow, tmp_path / "slow", "video", progress=False)
    assert summary.warnings == (
        "0_approach: frames are 600 to 600 s apart in the sequence, and 10 s in the film; --fps sets another rate; "
        "the same is true of 1 films more",
    )
    assert frames(tmp_path / "slow" / FILES[0].format("image"))[2] == Fraction(1, 10)


def test_what_has_no_films_is_refused_before_anything_is_written(
    data: st.Store, described_store: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    out = tmp_path / "e"
    with pytest.raises(
        InputError, match=r"has no sequences, of which video makes films: .*export single images as png"
    ):
        export_store(described_store, out, "video", progress=False)
    with pytest.raises(InputError, match=r"--fps 5: png has no films; leave it out"):
        export_store(data, out, "png", fps=5, progress=False)
    for fps in (0, 1001, "5", float("nan")):
        with pytest.raises(InputError, match=r"--fps .*: must be a number from 0\.1 to 1000, in frames a second"):
            export_store(data, out, "video", fps=fps, progress=False)  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"a film needs PyAV: pip install 'vbnfault\[video\]'"):
        export_store(data, out, "video", progress=False)
    assert not out.exists()


def test_a_store_without_faults_has_films(tmp_path: Path) -> None:
    store = sequences(tmp_path / "s.zarr", faults=(), mask_any_faults=(), layers=())
    export_store(store, tmp_path / "e", "video", progress=False)
    assert frames(tmp_path / "e" / FILES[0].format("masks"))[0].shape[0] == FRAMES[0]
