"""Auto-exposure that lags: a frame takes the exposure that an earlier frame of its sequence was metered for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import recorded_calls
from frames_kit import FRAMES, columns, write_scene
from poses_kit import columns_of, row

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.pipeline import stages
from vbnfault.pipeline.exposure import exposure_factor
from vbnfault.scene import config

# Between camera and Sun, as the body's centre sees them: out of the night, one frame, and towards the terminator.
ANGLES_DEG = (90, 60, 0, 0, 0, 40, 60, 80, 90)
FIRST = np.repeat(np.cumsum([0, *FRAMES[:-1]]), FRAMES)  # frame of each sample's sequence
DELAY = 2
AUTO = {"camera.exposure_s": "auto", "camera.detector": "generic_cmos"}
LATE = {**AUTO, "camera.metering_delay_frames": DELAY}


def write_poses(folder: Path, angles_deg: tuple[float, ...] = ANGLES_DEG) -> Path:
    """Write the scene with a camera that flies around the body, and return its path."""
    angle = np.radians(angles_deg)
    places = zip(3e3 * np.sin(angle), 3e3 * np.cos(angle), strict=True)
    poses = [row(f"{k}", (x, y, 300.0), (0, 1, 0)) for k, (x, y) in enumerate(places)]
    return write_scene(folder, table={**columns(), **columns_of(poses)})


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_poses(tmp_path)


def exposures(out: Path) -> list[float]:
    with vbnfault.open_dataset(out) as data:
        return list(data["exposure_s"].values)


def test_exposures_are_those_of_earlier_frames_to_the_last_bit(scene: Path, tmp_path: Path) -> None:
    """In one process, in two, and where a build of the last shards came first and rendered frames before them."""
    own, late, shared, resumed = (tmp_path / f"{name}.zarr" for name in ("own", "late", "shared", "resumed"))
    vbnfault.build(config.load_scene(scene, AUTO), own, progress=False)
    loaded = config.load_scene(scene, LATE)
    digest = vbnfault.build(loaded, late, progress=False).digest
    assert vbnfault.build(loaded, shared, progress=False, workers=2).digest == digest
    assert vbnfault.build(loaded, resumed, progress=False, shard_range=range(3, 5)).built == 3
    assert vbnfault.build(loaded, resumed, progress=False).digest == digest
    assert vbnfault.verify(resumed).problems == []
    metered, stored = exposures(own), exposures(late)
    assert len({metered[k] for k in (0, 1, 2, 4, 5, 6, 7, 8)}) == 8
    assert stored == [metered[max(k - DELAY, int(FIRST[k]))] for k in range(9)]
    assert exposures(shared) == exposures(resumed) == stored


def test_light_follows_the_late_exposure(scene: Path) -> None:
    """Electrons scale with it, to the rounding of float32; day after dusk is white, and dusk is dark."""
    own, late = (vbnfault.Session(config.load_scene(scene, keys)) for keys in (AUTO, LATE))
    white = {}
    for k in (2, 8):
        frames = own.frame(k), late.frame(k)
        light = [frame.injection.development.signal({}, []).array for frame in frames]
        factor = frames[1].camera.exposure_s / frames[0].camera.exposure_s
        np.testing.assert_allclose(light[1], light[0] * np.float32(factor), rtol=4 * 2**-24)
        white[k] = [np.mean(frame.images.clean.array[..., 0] == 255) for frame in frames]
        mean = [frame.images.clean.array.mean() for frame in frames]
        assert (factor > 1.5 and mean[1] > 1.5 * mean[0]) if k == 2 else (factor < 0.7 and mean[1] < mean[0])
    assert white[2][0] < 0.01
    assert white[2][1] > 0.1


def test_frames_in_order_are_rendered_once(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered = recorded_calls(monkeypatch, stages, "render_view")
    loaded = config.load_scene(scene, LATE)
    session = vbnfault.Session(loaded)
    in_order = [session.simulate(k) for k in range(9)]
    assert sorted(spec.index for spec, _ in rendered) == list(range(9))
    rendered.clear()
    alone = vbnfault.Session(loaded).simulate(8)
    assert sorted(spec.index for spec, _ in rendered) == [6, 8]
    np.testing.assert_array_equal(alone.layers["image"], in_order[8].layers["image"])
    rendered.clear()
    fixed = config.load_scene(scene, LATE | {"camera.exposure_s": 0.01})
    assert vbnfault.simulate(fixed, 8).scalars["exposure_s"] == 0.01
    assert [spec.index for spec, _ in rendered] == [8]


def test_the_frame_before_has_its_late_exposure_too(scene: Path) -> None:
    """A frame that is repeated as a whole is the one before bit for bit, whatever this process has made."""
    frozen = {"faults.frozen_frame": {"model": "repeated", "rows_fraction": 1.0}, "plan.classes_per_sample": [3, 3]}
    before = vbnfault.simulate(config.load_scene(scene, LATE), 7).layers["image"]
    session = vbnfault.Session(config.load_scene(scene, LATE | frozen))
    for _ in range(2):
        np.testing.assert_array_equal(session.simulate(8).layers["image"], before)


def test_limits_and_stops_are_those_of_the_frame_itself(tmp_path: Path) -> None:
    """The second frame looks over the body's night side at the Sun, 10° beside the boresight in a field of 40°."""
    scene = write_poses(tmp_path, (0, 170, *[0] * 7))
    keys = LATE | {"camera.metering_delay_frames": 1, "camera.exposure_max_towards_sun_s": 1e-3}
    sun = vbnfault.Session(config.load_scene(scene, keys))
    assert sun.frame(0).camera.exposure_s > 2e-3
    assert [sun.frame(k).camera.exposure_s for k in (1, 2)] == [1e-3, 1e-3]  # 2 takes what 1 was metered for
    session = vbnfault.Session(config.load_scene(scene, LATE | {"camera.exposure_stops": [-1.0, 1.0]}))
    frames = [session.frame(k) for k in (4, 6)]
    metered = frames[0].exposure.metered_s
    factors = [exposure_factor(frame.spec) for frame in frames]
    assert metered is not None
    assert factors[0] != factors[1]
    assert [frame.camera.exposure_s for frame in frames] == [metered * factor for factor in factors]


@pytest.mark.expects_warnings
def test_a_frame_without_a_sequence_meters_itself(scene: Path, tmp_path: Path) -> None:
    """One that a session takes; those of a retake, which refuses the key."""
    table = columns_of([row("0", (3e4, 0.0, 300.0), (1, 0, 0))])
    pose = {name: values[0] for name, values in table.items()}
    taken = [
        vbnfault.Session(config.load_scene(scene, keys)).take(pose, sample=8).scalars["exposure_s"]
        for keys in (AUTO, LATE)
    ]
    assert taken[0] == taken[1]
    loaded = config.load_scene(scene, LATE | {"dataset.layers": ["scene_radiance"]})
    store = tmp_path / "s.zarr"
    vbnfault.build(loaded, store, progress=False, shard_range=range(2))
    with pytest.raises(
        InputError, match=r"camera\.metering_delay_frames = 2: a retake meters each frame itself; m"
    ):
        vbnfault.retake(store, loaded, tmp_path / "new.zarr")
    vbnfault.retake(store, config.load_scene(scene, AUTO), tmp_path / "new.zarr", progress=False)
    own = vbnfault.Session(config.load_scene(scene, AUTO))
    expected = [own.frame(k).camera.exposure_s for k in range(4)]
    np.testing.assert_allclose(exposures(tmp_path / "new.zarr"), expected, rtol=1e-6)
    assert exposures(store)[:4] == [expected[0]] * 3 + [expected[3]]


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"camera.metering_delay_frames": 11}, r"camera\.metering_delay_frames = 11: must be .* 10"),
        ({"camera.metering_delay_frames": -1}, r"camera\.metering_delay_frames = -1: must be .* 0"),
        ({"camera.metering_delay_frames": 0.5}, r"camera\.metering_delay_frames = 0\.5"),
    ],
)
def test_a_wrong_delay_is_one_sentence(scene: Path, keys: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        config.load_scene(scene, keys)
    assert "\n" not in str(caught.value)


def test_a_delay_needs_sequences(tmp_path: Path) -> None:
    loaded = config.load_scene("quickstart", {"camera.metering_delay_frames": 1})
    sentence = r"camera\.metering_delay_frames = 1: counts frames of a sequence, and there is none; must be 0"
    with pytest.raises(InputError, match=sentence):
        vbnfault.Session(loaded).simulate(0)
    with pytest.raises(InputError, match=sentence):
        vbnfault.build(loaded, tmp_path / "s.zarr", progress=False)
