"""The event camera: its pixels against closed forms, and its files from a scene."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Called, ellipsoids_of
from numpy.typing import NDArray
from poses_kit import columns_of, row

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.detector.event_camera import EVENT, EventCamera, EventPixels
from vbnfault.output.event_files import write_events
from vbnfault.pipeline.event_camera import EventFlight
from vbnfault.scene import keyed_random
from vbnfault.scene.config import parse_scene

pytestmark = pytest.mark.filterwarnings("ignore:body.shape = 'ellipsoid'")  # its values are those of 67P

Call = Callable[..., Called]
Events = NDArray[Any]

# of pixels that are alike and free of noise
QUIET: dict[str, Any] = {
    "threshold_sigma": 0.0,
    "refractory_s": 0.0,
    "leak_rate_hz": 0.0,
    "shot_noise_rate_hz": 0.0,
    "dark_e_s": 1e-6,
}


def pixels(shape: tuple[int, int], **values: Any) -> EventPixels:
    """Return quiet pixels but for some values."""
    device, noise = (partial(keyed_random.rng, 3, 0, stage) for stage in ("device", "noise"))
    return EventPixels(EventCamera(**{**QUIET, **values}), shape, device, noise)


def seen(camera: EventPixels, images: Iterator[tuple[float, NDArray[np.float64]]]) -> Events:
    """Return all events of images, each with its time in s."""
    return np.concatenate([camera.advance(image, time_s) for time_s, image in images])


def ramp(camera: EventPixels, shape: tuple[int, int], slope: float, times_s: Any, start_e_s: float = 1e4) -> Events:
    """Return the events of light whose logarithm rises evenly in all pixels."""
    return seen(camera, ((t, np.full(shape, start_e_s * np.exp(slope * t))) for t in times_s))


# --- the pixels ---------------------------------------------------------------------------------------------------


def test_an_edge_that_moves_sends_its_contrast_over_the_threshold_at_the_times_of_the_closed_form() -> None:
    """A bar of 8 times the light of its background, 10 px wide, at 5 px/s over rows of 24 pixels.

    The light of a pixel changes linearly while an edge crosses it, since its area is a box: it is I0 (1 + 7 s) at
    the fraction s of the way, so event k comes at s = (exp(k θ) - 1) / 7, and on the way back at
    (8 exp(-k θ) - 1) / 7. Between two images the logarithm is taken as straight, which shifts an event by
    h²/8 · |L''/L'| ≤ h²/8 · 7 px = 0.04 % of a pixel's crossing, for h = 1/50 px between images.
    """
    speed, width, theta = 5.0, 10, 0.2
    shape = (2, 24)
    x = np.arange(shape[1])

    def image(time_s: float) -> NDArray[np.float64]:
        front, back = (np.clip(speed * time_s - x - behind, 0, 1) for behind in (0, width))
        return np.broadcast_to(1000 * (1 + 7 * (front - back)), shape)

    times = np.arange(0, 35 * 50 + 1) / 50 / speed
    events = seen(pixels(shape), ((t, image(t)) for t in times.tolist()))
    each = int(np.log(8) / theta)  # 10.4: ten up, and ten down
    assert each == 10
    assert len(events) == 2 * each * shape[0] * shape[1]
    k = np.arange(1, each + 1)
    up = (np.exp(k * theta) - 1) / 7
    # on its way down the logarithm starts 0.4 thresholds above what is remembered
    down = 1 - (np.exp((each - k) * theta) - 1) / 7
    for column in (0, 7, 23):
        mine = events[(events["x"] == column) & (events["y"] == 1)]
        assert mine["p"].tolist() == [1] * each + [0] * each
        expected = np.concatenate([column + up, column + width + down]) / speed
        np.testing.assert_allclose(mine["t"] / 1e6, expected, rtol=0, atol=0.01 / speed)
        np.testing.assert_allclose(mine["t"] / 1e6, expected, rtol=0, atol=4e-4 / speed + 1e-6)
    assert (np.diff(events["t"]) >= 0).all()
    assert events.dtype == EVENT


def test_a_ramp_sends_events_at_equal_steps_of_the_logarithm_up_and_down() -> None:
    for slope, polarity, theta in ((1.7, 1, 0.2), (-1.7, 0, 0.3)):
        events = ramp(pixels((1, 1), threshold_on=0.2, threshold_off=0.3), (1, 1), slope, (0.0, 3.1))
        expected = np.arange(1, int(3.1 * 1.7 / theta) + 1) * theta / 1.7
        np.testing.assert_allclose(events["t"], expected * 1e6, atol=0.51)  # rounded to 1 us
        assert set(events["p"].tolist()) == {polarity}


def test_events_do_not_depend_on_how_time_is_cut() -> None:
    """With thresholds, refractory period, leak and noise; the logarithm is straight between the same nodes."""
    rng, shape = np.random.default_rng(5), (6, 7)
    nodes, logs = np.arange(9) * 0.5 - 1, rng.normal(8, 1, (9, *shape))
    values = {
        "threshold_sigma": 0.03,
        "refractory_s": 0.02,
        "leak_rate_hz": 3.0,
        "shot_noise_rate_hz": 20.0,
        "hot_pixel_fraction": 0.1,
    }

    def events(times: NDArray[np.float64]) -> Events:
        def images() -> Iterator[tuple[float, NDArray[np.float64]]]:
            for t in times.tolist():
                k = min(int((t + 1) // 0.5), 7)
                part = (t - nodes[k]) / 0.5
                yield t, np.exp(logs[k] + part * (logs[k + 1] - logs[k])) - 1e-6

        return seen(pixels(shape, **values), images())

    whole = events(nodes)
    cut = events(np.unique(np.concatenate([nodes, rng.uniform(-1, 3, 60)])))
    assert len(whole) > 1500
    order = ("t", "y", "x", "p")
    whole, cut = np.sort(whole, order=order), np.sort(cut, order=order)
    np.testing.assert_array_equal(whole[["x", "y", "p"]], cut[["x", "y", "p"]])
    np.testing.assert_allclose(whole["t"], cut["t"], atol=1)


def test_the_refractory_period_limits_the_rate() -> None:
    """A crossing each ms, and none sent within 9.5 ms: one in ten is sent, the first at 1 ms."""
    events = ramp(pixels((1, 1), refractory_s=0.0095), (1, 1), 200.0, np.arange(11) / 100)
    np.testing.assert_allclose(events["t"], 1000 + 10_000 * np.arange(10), atol=1)


def test_what_is_remembered_moves_within_the_refractory_period() -> None:
    """The light goes up by ten thresholds and back, so that the pixel remembers its first light again."""
    camera = pixels((1, 1), refractory_s=5.0)
    up, level, down = 1000 * np.exp(2.1), 1000 * np.exp(2.1), 1000.0
    lights = [(0.0, 1000.0), (1.0, up), (20.0, level), (21.0, down), (40.0, down), (41.0, 1000 * np.exp(0.15))]
    events = seen(camera, ((t, np.full((1, 1), e)) for t, e in lights))
    assert events["p"].tolist() == [1, 0]  # and none for the rise of 0.15 at the end


def test_the_leak_sends_on_events_at_its_rate() -> None:
    """Each pixel at an even pace from a phase of its own: 100 in 20 s at 5 Hz, or one fewer by rounding."""
    shape = (20, 30)
    camera = pixels(shape, leak_rate_hz=5.0, threshold_sigma=0.03)
    events = ramp(camera, shape, 0.0, np.linspace(0, 20, 41))
    assert (events["p"] == 1).all()
    count = np.bincount(events["y"].astype(int) * 30 + events["x"], minlength=600)
    assert set(count.tolist()) <= {99, 100}
    one = events["t"][(events["x"] == 3) & (events["y"] == 4)]
    np.testing.assert_allclose(np.diff(one), 200_000, atol=1)
    first = np.array([events["t"][(events["x"] == k) & (events["y"] == 0)][0] for k in range(30)])
    assert first.std() > 0.02e6  # uniform over 0.2 s: 0.058 s


def test_shot_noise_has_its_rate_and_falls_with_light() -> None:
    """Poisson: the count of dark pixels is within 3 sigma of rate · pixels · time, of bright ones of a quarter."""
    shape, seconds, rate = (40, 50), 30.0, 2.0
    for light, factor in ((0.0, 1.0), (5e5, 1 - 0.75 / 2), (1e6, 0.25), (1e9, 0.25)):
        camera = pixels(shape, shot_noise_rate_hz=rate, dark_e_s=10.0, bright_e_s=1e6)
        events = ramp(camera, shape, 0.0, np.linspace(-5, seconds - 5, 17), light)
        expected = factor * rate * seconds * 2000
        assert abs(len(events) - expected) < 3 * np.sqrt(expected)
        assert abs(events["p"].sum() - len(events) / 2) < 1.5 * np.sqrt(len(events))  # 3 sigma of a fair coin
        count = np.bincount(events["y"].astype(int) * 50 + events["x"], minlength=2000)
        # the variance of a Poisson count is its mean; that of n pixels varies by sqrt(2/n), 3.2 %
        assert abs(count.var() / count.mean() - 1) < 3 * np.sqrt(2 / 2000)


def test_hot_pixels_are_the_devices_and_send_on_events() -> None:
    shape = (100, 100)
    camera = pixels(shape, hot_pixel_fraction=0.02, hot_pixel_rate_hz=50.0)
    assert abs(len(camera.hot) - 200) < 3 * np.sqrt(200 * 0.98)
    events = ramp(camera, shape, 0.0, (0.0, 4.0, 10.0))
    assert (events["p"] == 1).all()
    assert set((events["y"].astype(int) * 100 + events["x"]).tolist()) <= set(camera.hot.tolist())
    expected = 50 * 10 * len(camera.hot)
    assert abs(len(events) - expected) < 3 * np.sqrt(expected)
    other = partial(keyed_random.rng, 3, 1, "noise")
    again = EventPixels(camera._camera, shape, partial(keyed_random.rng, 3, 0, "device"), other)
    np.testing.assert_array_equal(camera.hot, again.hot)
    assert ramp(again, shape, 0.0, (0.0, 10.0)).tobytes() != events.tobytes()


def test_the_mismatch_of_thresholds_is_recovered_from_first_events() -> None:
    """The first event of a ramp comes at threshold / slope. The deviation of n values varies by 1/sqrt(2 n)."""
    shape = (60, 80)
    for slope, mean in ((0.5, 0.25), (-0.5, 0.3)):
        camera = pixels(shape, threshold_on=0.25, threshold_off=0.3, threshold_sigma=0.03)
        events = ramp(camera, shape, slope, (0.0, 2.0))
        first = np.full(4800, np.inf)
        np.minimum.at(first, events["y"].astype(int) * 80 + events["x"], events["t"] / 1e6 * 0.5)
        assert abs(first.std() / 0.03 - 1) < 3 / np.sqrt(2 * 4800)
        assert abs(first.mean() - mean) < 3 * 0.03 / np.sqrt(4800)


def test_the_low_pass_delays_a_step_as_its_closed_form() -> None:
    """A step by C passes as C (1 - exp(-t/tau)); images come every tau/200, so lines are off by C (1/200)²/8.

    The last event comes where the slope is a twentieth of that at first, so 6e-5 tau too late at most.
    """
    tau_s, contrast, theta = 1 / (2 * np.pi * 10.0), 2.1, 0.2
    times = np.concatenate([[-1e-9], np.arange(1, 2001) * tau_s / 200])
    camera = pixels((1, 1), cutoff_hz=10.0)
    light = [(-1.0, 1000.0), (-2e-9, 1000.0), *((t, 1000 * np.exp(contrast)) for t in times.tolist())]
    events = seen(camera, ((t, np.full((1, 1), e)) for t, e in light))
    k = np.arange(1, 11)
    np.testing.assert_allclose(events["t"], -1e6 * tau_s * np.log(1 - k * theta / contrast), rtol=1e-4, atol=1)


def test_the_dark_signal_hides_contrast_in_the_dark() -> None:
    """From 100 to 200 e/s: ln 2 = 6.9 thresholds of 0.1 without dark signal, ln(12/11) = 0.87 with 1000 e/s."""
    for dark, count in ((1e-6, 6), (1000.0, 0)):
        camera = pixels((1, 1), threshold_on=0.1, dark_e_s=dark)
        assert len(ramp(camera, (1, 1), np.log(2), (0.0, 1.0), 100.0)) == count


# --- from a scene to files ----------------------------------------------------------------------------------------

SCENE = """
title = "events"
body = {shape = "ellipsoid", semi_axes_m = [500.0, 500.0, 500.0], rotation_period_h = 12.0}
camera = {detector = "generic_ccd", width_px = 64, height_px = 48, fov_deg = 40.0}
render = {bands = 2, samples_per_pixel = 4}
patch = {boulders = false, relief = 0.0, max_triangles = 20_000}
trajectory.file = "poses.csv"
event_camera = {leak_rate_hz = 0.0, shot_noise_rate_hz = 0.0, threshold_sigma = 0.0}
"""
MOVED_M = 200.0


def write_poses(path: Path, **columns: Any) -> None:
    """Write poses: a camera that hovers, and one that flies along x of its image."""
    x, y = np.array([1.0, 0, 0]), 2000.0
    poses = [row(str(k), (0.0, y, 1.0), (0.0, 1.0, 0.0)) for k in range(5)]
    quaternion = [poses[0][f"camera_from_T_{axis}"] for axis in "wxyz"]
    from scipy.spatial.transform import Rotation

    x = Rotation.from_quat(quaternion, scalar_first=True).inv().apply([1.0, 0, 0])
    for k in range(3):
        for axis, shift in zip("xyz", (k - 1) * MOVED_M / 2 * x, strict=True):
            poses[2 + k][f"camera_{axis}_T_m"] += shift
    table = {
        **columns_of(poses),
        "sequence": ["hover"] * 2 + ["fly by/1"] * 3,
        "time_s": [0.0, 1.0, 10.0, 11.0, 12.0],
        **columns,
    }
    lines = [",".join(table), *(",".join(map(str, v)) for v in zip(*table.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module", autouse=True)
def few_facets() -> Iterator[None]:
    """The ball has 5120 facets: edges of 0.08 R leave its limb within 0.02 px."""
    with ellipsoids_of(4):
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("events") / "scene.toml"
    path.write_text(SCENE)
    write_poses(path.with_name("poses.csv"))
    return path


def read(path: Path) -> Events:
    import h5py

    with h5py.File(path) as file:
        assert file.attrs["geometry"] == "64x48"
        events: Events = file["CD/events"][:]
    return events


def test_the_command_writes_the_same_files_twice_with_events_at_the_limbs(
    scene: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow.parquet

    out, again = tmp_path / "a", tmp_path / "b"
    done = call("event-camera", scene, "--out", out)
    assert done.code == 0
    names = sorted(path.name for path in out.iterdir())
    stems = ("0_hover", "1_fly_by_1")
    assert names == sorted([*(f"{s}.{e}" for s in stems for e in ("h5", "parquet")), "event_camera.json"])
    hover, fly = (read(out / f"{stem}.h5") for stem in stems)
    assert len(hover) == 0  # the same samples in each render: no noise of sampling
    # The camera moves to the right, so the body moves to the left of the image: its left limb covers the dark sky
    # (ON), its right limb leaves it (OFF). The limb is at f R / sqrt(d² - R²) = 22.7 px from the middle on average.
    assert fly["t"].min() >= 10e6
    assert fly["t"].max() <= 12e6
    middle = fly["y"] // 4 == 6
    left, right = (fly[middle & side]["p"].mean() for side in (fly["x"] < 16, fly["x"] >= 48))
    assert left > 0.9
    assert right < 0.1
    assert (np.abs(fly["x"][middle] - 31.5) > 15).mean() > 0.8
    table = pyarrow.parquet.read_table(out / "1_fly_by_1.parquet")
    for name in EVENT.names or ():
        np.testing.assert_array_equal(table[name].to_numpy(), fly[name])
    written = json.loads((out / "event_camera.json").read_text())
    assert written["event_camera"]["threshold_on"] == 0.2
    assert written["scene"]["camera"]["width_px"] == 64

    # killed in the second sequence, and resumed
    events = EventFlight.events

    def stopped(self: EventFlight) -> Iterator[Events]:
        yield next(events(self))
        assert self.course.name == "hover", "killed"

    monkeypatch.setattr(EventFlight, "events", stopped)
    with pytest.raises(AssertionError, match="killed"):
        list(write_events(vbnfault.load_scene(scene), again, source=str(scene), progress=False))
    assert sorted(path.name for path in again.iterdir()) == ["0_hover.h5", "0_hover.parquet", "event_camera.json"]
    monkeypatch.undo()
    lines = list(write_events(vbnfault.load_scene(scene), again, source=str(scene), progress=False))
    assert lines[0].endswith("0_hover.h5: kept")
    for name in names:
        assert (out / name).read_bytes() == (again / name).read_bytes(), name
    done = call("event-camera", scene, "--out", again, "--seed", "8")
    assert (done.code, done.said) == (
        2,
        f"{again}/event_camera.json: is of another scene, event camera or version; choose another --out",
    )


def test_renders_are_as_far_apart_as_the_ground_moves(scene: Path) -> None:
    """The nearest ground is 1500 m away, so it moves by f · 100 m / 1500 m in each of two intervals.

    One in 64 pixels is looked at, and of these nearly the fastest: its ground lies up to 4 px from the middle of
    the image, hence up to 25 m farther away.
    """
    for step_px in (1.0, 0.25):
        session = vbnfault.Session(vbnfault.load_scene(scene, {"event_camera.step_px": step_px}))
        flight = EventFlight(session, 1)
        focal_px = 32 / np.tan(np.radians(20))
        most = focal_px * MOVED_M / 2 / 1500 / step_px
        count = len(flight.times_s) - 1
        assert 2 * np.ceil(most * 1500 / 1525) <= count <= 2 * np.ceil(most)
        assert {10.0, 11.0, 12.0} <= set(flight.times_s.tolist())


def test_rounded_times_do_not_lead_past_the_last_frame(tmp_path: Path) -> None:
    """Of 25 Hz: 0.16 + 0.999 · (0.2 - 0.16) + 0.001 · (0.2 - 0.16) is more than 0.2."""
    (tmp_path / "scene.toml").write_text(SCENE)
    write_poses(tmp_path / "poses.csv", time_s=[0.0, 0.04, 0.12, 0.16, 0.2])
    scene = vbnfault.load_scene(tmp_path / "scene.toml", {"event_camera.step_px": 16.0})
    assert EventFlight(vbnfault.Session(scene), 1).times_s[-1] == 0.2


def test_a_grey_camera_sends_events(scene: Path) -> None:
    changes = {"camera.detector": "rosetta_navcam", "event_camera.step_px": 8.0}
    flight = EventFlight(vbnfault.Session(vbnfault.load_scene(scene, changes)), 1)
    assert sum(map(len, flight.events())) > 100


def test_events_have_neither_faults_nor_blur_nor_samples_where_noise_asks_for_them(scene: Path) -> None:
    changes = {
        "render.noise_fraction": 0.5,
        "motion.shutter": "global",
        "faults.straylight.model": "texture",
        "faults.cosmic_rays.flux_per_cm2_s": 3000.0,
        "event_camera.step_px": 4.0,
    }
    first, second = (
        np.concatenate(list(EventFlight(vbnfault.Session(vbnfault.load_scene(scene, values)), 1).events()))
        for values in ({"event_camera.step_px": 4.0}, changes)
    )
    assert len(first) > 1000
    assert first.tobytes() == second.tobytes()


def test_the_course_keeps_to_poses_velocities_and_the_sun(scene: Path, tmp_path: Path) -> None:
    """The cubic of two poses with given velocities; attitude and Sun are half-way between at half the time."""
    from vbnfault.pipeline.event_camera import Course
    from vbnfault.scene.trajectory import as_trajectory

    poses = [row("a", (0, 3000.0, 0), (0, 1.0, 0)), row("b", (100.0, 3000.0, 0), (1.0, 0, 0))]
    velocity = {f"velocity_{axis}_T_m_s": [3.0 * (axis == "z")] * 2 for axis in "xyz"}
    table = as_trajectory({**columns_of(poses), "time_s": [0.0, 2.0], **velocity})
    course = Course.of(table, slice(0, 2), "0")
    middle = course.pose(1.0)
    # Hermite: the middle is the mean of the ends, plus (v0 - v1) T / 8 = 0; the speed there 1.5 Δx/T - (v0 + v1)/4
    np.testing.assert_allclose(middle.camera_position_T_m, [50, 3000, 0], atol=1e-9)
    np.testing.assert_allclose(course.position_T_m(1.0, 1), [75, 0, -1.5], atol=1e-9)
    np.testing.assert_allclose(middle.sun_direction_T, [0.5**0.5, 0.5**0.5, 0])
    ends = [course.pose(t).T_from_C for t in (0.0, 1.0, 2.0)]
    np.testing.assert_allclose(ends[0].T @ ends[1], ends[1].T @ ends[2], atol=1e-12)
    np.testing.assert_allclose(ends[0], table.pose(0).T_from_C, atol=1e-12)


def test_mistakes_are_said_in_a_sentence(scene: Path, tmp_path: Path, call: Call) -> None:
    out = tmp_path / "out"

    def said(*arguments: object) -> str:
        done = call("event-camera", *arguments, "--out", out)
        assert done.code == 2
        assert not out.exists()
        return done.said

    assert said("quickstart") == (
        "quickstart: has no sequences; needs [trajectory] with a table of poses that has the column time_s or "
        "sequence"
    )
    assert said(scene, "--sequence", "hover", "--sequence", "hoover") == (
        f"--sequence 'hoover': must be one of hover, fly by/1 of {scene.with_name('poses.csv')}"
    )
    sentence = said(scene, "--set", "event_camera.threshold_on=0")
    assert sentence.endswith(
        "event_camera.threshold_on = 0: must be a number from 0.01 to 5 (set in place of the file)"
    )
    one = tmp_path / "scene.toml"
    one.write_text(SCENE)
    write_poses(tmp_path / "poses.csv", sequence=["hover"] * 2 + ["fly by"] * 2 + ["last"])
    assert said(one) == f"{tmp_path / 'poses.csv'}: sequence last has 1 frame; must have at least 2"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    done = call("event-camera", scene, "--out", out)
    assert done.said == f"{out}: holds files, but no event_camera.json; choose a new or empty folder as --out"


def test_datasets_do_not_depend_on_the_event_camera(scene: Path) -> None:
    from vbnfault.dataset import scene_identity

    changed = {"event_camera.threshold_on": 0.5}
    one, other = (vbnfault.Session(vbnfault.load_scene(scene, values)) for values in ({}, changed))
    assert scene_identity(one) == scene_identity(other)
    with pytest.raises(InputError, match=r"event_camera\.cutoff_hz"):
        parse_scene({"title": "x", "event_camera": {"cutoff_hz": 0}}, source="x")
