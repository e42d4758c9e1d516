"""From a study's frames to metrics of navigation: sequences of views, faults that last, values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import vbnfault
from vbnfault import navigation
from vbnfault.core.errors import VbnfaultError
from vbnfault.pipeline.spec import Injection, Pose, Rendering, SampleSpec
from vbnfault.pipeline.stages import add_stars, inject_faults, meter, render_view, resolve, take_images
from vbnfault.study import navigation_metrics as bridge

NAMES = [metric.name for metric in bridge.METRICS]
SIZE_PX = 96


@pytest.fixture(scope="module")
def spec() -> SampleSpec:
    """Return a sample that faces away from the Sun, with dust, defects and cosmic rays."""
    values: dict[str, Any] = {
        "camera.width_px": SIZE_PX,
        "camera.height_px": SIZE_PX,
        "camera.detector": "generic_ccd",
        "dataset.samples": 1,
        "dataset.sites": 1,
        "patch.max_triangles": 60_000,
        "plan.on_invisible": "drop",
        "plan.faulty_fraction": 1.0,
        "plan.mode": "per_sample",
        "plan.classes_per_sample": [3, 3],
        "faults": {
            "dust_on_optics": {"model": "gaussian"},
            "broken_pixels": {"model": "texture"},
            "cosmic_rays": {"flux_per_cm2_s": 1e4},
        },
    }
    return vbnfault.Session(vbnfault.load_scene("quickstart", values)).spec(0)


@pytest.fixture(scope="module")
def first(spec: SampleSpec) -> tuple[Pose, Rendering]:
    pose = resolve(spec)
    return pose, render_view(spec, pose)


@pytest.fixture(scope="module")
def poses(spec: SampleSpec, first: tuple[Pose, Rendering]) -> list[Pose]:
    return bridge.sequence(spec, *first, 4)


@pytest.fixture(scope="module")
def taken(
    spec: SampleSpec, first: tuple[Pose, Rendering], poses: list[Pose]
) -> list[tuple[Injection, bridge.NavigationFrame]]:
    """Return injection and frame of two views."""
    out: list[tuple[Injection, bridge.NavigationFrame]] = []
    for k, pose in enumerate(poses[:2]):
        here = bridge.spec_of_view(spec, k)
        rendering = first[1] if k == 0 else render_view(here, pose)
        exposure = add_stars(here, pose, rendering, meter(here, rendering))
        if k == 0:
            injection = inject_faults(here, pose, rendering, exposure)
        else:
            injection = bridge.continue_faults(here, pose, rendering, exposure, out[0][0])
        images = take_images(here, injection)
        frame = bridge.navigation_frame(pose, rendering.truth, here.camera, images.clean.array, images.image.array)
        out.append((injection, frame))
    return out


def test_a_sequence_is_a_straight_track_of_overlapping_views(
    spec: SampleSpec, first: tuple[Pose, Rendering], poses: list[Pose]
) -> None:
    positions = np.array([pose.position_L_m for pose in poses])
    steps = np.diff(positions, axis=0)
    assert poses[0] is first[0]
    assert np.ptp(steps, axis=0) == pytest.approx([0, 0, 0], abs=1e-9)
    assert steps[0, 2] == 0  # level
    axes = np.abs(poses[0].L_from_C)
    k = int(np.argmin(axes[2, :2]))
    assert abs(steps[0] @ poses[0].L_from_C[:, k]) > 0.7 * np.linalg.norm(steps[0])  # along the more level axis
    for pose in poses[1:]:
        assert np.array_equal(pose.L_from_C, poses[0].L_from_C)
        assert np.array_equal(pose.sun_L, poses[0].sun_L)
    truth = first[1].truth
    before, after = (
        bridge.navigation_frame(pose, truth, spec.camera, *[np.zeros((SIZE_PX, SIZE_PX, 4), np.uint8)] * 2).view
        for pose in poses[:2]
    )
    row, column = np.nonzero(np.isfinite(truth.depth_m))
    moved = navigation.reprojected(np.column_stack([column, row]) + 0.5, before, after)
    kept = ((moved >= 0) & (moved < SIZE_PX)).all(axis=1).mean()
    assert kept == pytest.approx(bridge.OVERLAP, abs=0.02)  # or more, had the ground been in the way
    assert bridge.sequence(spec, *first, 1) == [first[0]]
    again = bridge.sequence(spec, *first, 4)
    assert all(np.array_equal(a.position_L_m, b.position_L_m) for a, b in zip(poses, again, strict=True))


def test_a_track_turns_where_the_ground_is_in_the_way(
    spec: SampleSpec, first: tuple[Pose, Rendering], poses: list[Pose], monkeypatch: pytest.MonkeyPatch
) -> None:
    step = poses[1].position_L_m - poses[0].position_L_m
    monkeypatch.setattr(bridge, "_is_free", lambda _, at: bool(((at - poses[0].position_L_m) @ step <= 1e-9).all()))
    other = bridge.sequence(spec, *first, 3)
    assert (other[1].position_L_m - other[0].position_L_m) @ step < 0
    monkeypatch.setattr(bridge, "_is_free", lambda _, at: bool(np.ptp(at) < 0))
    with pytest.raises(VbnfaultError, match="sample 0: no straight track of 3 views is free"):
        bridge.sequence(spec, *first, 3)


def test_a_fault_lasts_and_noise_does_not(
    spec: SampleSpec, taken: list[tuple[Injection, bridge.NavigationFrame]]
) -> None:
    (before, frame), (after, later) = taken
    assert set(before.draws) == set(after.draws) == {"dust_on_optics", "broken_pixels", "cosmic_rays"}
    for name in ("dust_on_optics", "broken_pixels"):
        assert before.draws[name].params == after.draws[name].params
    assert before.draws["cosmic_rays"].params != after.draws["cosmic_rays"].params
    assert bridge.spec_of_view(spec, 0) is spec
    here = bridge.spec_of_view(spec, 1)
    assert here.camera == spec.camera
    assert here.rng("detector", "read").random() != spec.rng("detector", "read").random()
    assert here.rng("fault", "dust_on_optics/0").random() == spec.rng("fault", "dust_on_optics/0").random()
    assert not np.array_equal(frame.clean, later.clean)
    # the view itself is the true one: the ground of the first clean twin lies where the truth says in the second
    matches = navigation.match(frame.clean, later.clean)
    assert len(matches) > 20
    assert navigation.match_precision(matches, frame.view, later.view) > 0.7


def test_only_what_is_asked_for_is_computed(
    taken: list[tuple[Injection, bridge.NavigationFrame]], monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = [frame for _, frame in taken]
    asked = ([], ["snr"], NAMES[:4], ["matches_lost", "snr"], NAMES)
    assert [bridge.views_needed(names) for names in asked] == [0, 0, 1, 2, 10]
    assert bridge.navigation_values(frames[:1], ["snr"]) == {}
    values = bridge.navigation_values(frames, NAMES[:8])
    assert list(values) == NAMES[:8]
    assert 0 < values["matches_lost"] <= 1
    assert 0 < values["corner_repeatability"] < 1
    ten = [*frames, *[frames[1]] * 8]
    lost = bridge.navigation_values(ten, NAMES[4:])
    clean = bridge.navigation_values([replace(frame, image=frame.clean) for frame in ten], NAMES[4:])
    for name, kept in (("match_precision_lost", NAMES[4]), ("feature_lifetime_lost_views", NAMES[8])):
        assert lost[name] == clean[kept] - lost[kept]
        assert lost["feature_lifetime_lost_views"] != 0
    calls = []
    monkeypatch.setattr(navigation, "match", lambda *images: calls.append(images))
    assert bridge.navigation_values(frames, NAMES[2:4]) == {name: values[name] for name in NAMES[2:4]}
    assert not calls


def test_clean_frames_have_no_error(taken: list[tuple[Injection, bridge.NavigationFrame]]) -> None:
    frames = [replace(frame, image=frame.clean) for _, frame in taken]
    values = bridge.navigation_values([*frames, *[frames[1]] * 8], NAMES)
    for name in ("centroid_shift_px", "matches_lost", "rotation_error_deg", "translation_error_deg", *NAMES[9:]):
        assert values[name] == 0
    assert values["limb_error_px"] == 0 or np.isnan(values["limb_error_px"])
    assert values["corner_repeatability"] == values["orb_repeatability"] == 1
    still = bridge.navigation_values([frames[0]] * 10, ["feature_lifetime_views"])["feature_lifetime_views"]
    assert still > 9  # 10, but for corners of noise on the sky


def test_every_metric_has_unit_meaning_and_source() -> None:
    for metric in bridge.METRICS:
        assert metric.unit in ("px", "1", "deg", "views")
        assert metric.description
        assert metric.source
        higher = "repeatability" in metric.name or metric.name in ("match_precision", "feature_lifetime_views")
        assert metric.better == ("high" if higher else "low")
