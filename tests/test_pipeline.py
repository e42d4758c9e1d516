"""A sample as a whole: labels on their pixels, twins, keyed draws, geometry, exposure."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import ALL_FAULTS, recorded_calls, small_scene

from vbnfault import pipeline
from vbnfault.core import frames
from vbnfault.pipeline import Session, masks
from vbnfault.pipeline.development import without
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import Frame
from vbnfault.scene import config, plan

_SESSIONS: dict[str, Session] = {}


def session(**tables: Any) -> Session:
    """Sessions are kept: terrain takes seconds."""
    key = json.dumps(tables, sort_keys=True, default=str)
    if key not in _SESSIONS:
        scene = config.parse_scene(small_scene(**tables), source="test")
        _SESSIONS[key] = Session(scene)
    return _SESSIONS[key]


@pytest.fixture(scope="module")
def frames_() -> list[Frame]:
    """Sixteen frames, all classes, every optional layer."""
    without = [f"without_{f}" for f in ALL_FAULTS]
    layers = ["clean", "depth_m", "normal", "semantic", "mask_effect", *without]
    s = session(dataset={"layers": layers})
    return [s.frame(i) for i in range(16)]


def test_masks_of_defects_lie_exactly_on_their_pixels(frames_: list[Frame]) -> None:
    # noise-free twins with and without the class differ inside its mask and nowhere else
    seen = set()
    for frame in frames_:
        for k, name in enumerate(frame.spec.faults):
            if name not in frame.drawn:
                assert not frame.labels.masks[k].any()
                continue
            seen.add(name)
            effect = frame.injection.development.effect(frame.injection.draws, name)
            assert effect.any(), f"{name} is claimed and not in the pixels"
            if name == "straylight":
                assert np.array_equal(frame.labels.masks[k], effect)
            elif name in ("broken_pixels", "broken_lines"):
                assert not (effect & ~frame.labels.masks[k]).any()
    assert seen == set(ALL_FAULTS)


def test_broken_lines_are_whole_lines_of_their_value(frames_: list[Frame]) -> None:
    checked = 0
    k = ALL_FAULTS.index("broken_lines")
    for frame in frames_:
        if "broken_lines" not in frame.drawn:
            continue
        mask, image = frame.labels.masks[k], frame.images.image.array
        rows, columns = mask.all(axis=1), mask.all(axis=0)
        rebuilt = rows[:, None] | columns[None, :]
        assert np.array_equal(mask, rebuilt)
        assert np.isin(image[mask], (0, 255)).all()
        assert (image[mask] == image[mask][:, :1]).all()  # all four channels alike
        if frame.camera.architecture in ("full_frame_ccd", "frame_transfer_ccd"):
            assert not (rows.any() and columns.any())
        checked += 1
    assert checked >= 4


def test_flares_lie_on_the_line_from_the_sun_through_the_centre(frames_: list[Frame]) -> None:
    # the light itself is looked at, one flare at a time, and the line comes from the pose alone
    checked = 0
    for frame in frames_:
        if "straylight" not in frame.drawn:
            continue
        pose, fault, params = frame.pose, frame.spec.faults["straylight"], frame.drawn["straylight"]
        fx, fy, cx, cy = frame.camera.intrinsics
        x, y, z = pose.L_from_C.T @ pose.sun_L
        sun, centre = np.array([fx * x / z + cx, fy * y / z + cy]), np.array([48.0, 40.0])
        along = (centre - sun) / np.linalg.norm(centre - sun)
        rate = frame.exposure.rate.merged
        dark = rate.with_array(np.zeros_like(rate.array))
        for flare in params["flares"]:
            alone = {**params, "flares": [flare], "glare": None}
            light = fault.apply(dark, alone, frame.context).array[..., 1].astype(float)
            rows, columns = np.nonzero(light > 1e-3 * max(light.max(), 1e-30))
            if len(rows) < 20 or rows.min() == 0 or columns.min() == 0 or rows.max() == 79 or columns.max() == 95:
                continue  # cut by the frame, so that its centroid is not its centre
            total = light.sum()
            row, column = np.mgrid[:80, :96] + 0.5
            centroid = np.array([(light * column).sum(), (light * row).sum()]) / total
            across = (centroid - centre) @ np.array([-along[1], along[0]])
            # textures are symmetric about the line; sampling a disc of 3 px radius moves its centroid by 0.1 px
            assert abs(across) < 0.2
            # the side on which it lies: position 0 is the Sun, 1 the centre, 2 its mirror image
            position = (centroid - sun) @ along / np.linalg.norm(centre - sun)
            assert abs(position - flare["position"]) * np.linalg.norm(centre - sun) < 0.5 * flare["radius"] * 96
            checked += 1
    assert checked >= 4


def test_optical_faults_act_in_the_stated_order(frames_: list[Frame]) -> None:
    # by hand, in the order of the design document: a flare is blurred and vignetted, a defect is neither
    order = [
        "straylight",
        "dust_on_optics",
        "optics_degradation",
        "vignetting",
    ]
    both = 0
    for frame in frames_:
        drawn, faults, camera = frame.drawn, frame.spec.faults, frame.camera
        rate = frame.exposure.rate
        light = rate.merged.with_array(rate.merged.array * np.float32(camera.exposure_s))
        # the Sun's direct image has met the lens's rims already, and is not vignetted again
        apart = rate.array * np.float32(camera.exposure_s)
        rest = light.with_array(apart)
        for name in order:
            if name in drawn:
                sun = np.maximum(light.array - rest.array, 0)
                light, rest = (faults[name].apply(q, drawn[name], frame.context) for q in (light, rest))
                if name == "vignetting":
                    light = light.with_array(rest.array + sun)
        picture = camera.detector.develop(light, camera.exposure_s, None)
        for name in ("broken_pixels", "broken_lines"):
            if name in drawn:
                picture = faults[name].apply(picture, drawn[name], frame.context)
        assert np.array_equal(
            frame.injection.development.image(frame.injection.draws, noisy=False).array, picture.array
        )
        both += "straylight" in drawn and "optics_degradation" in drawn
    assert both >= 1  # else the order of these two would not be seen


def test_the_image_without_a_class_equals_the_one_of_a_scene_that_lacks_it(frames_: list[Frame]) -> None:
    # switching a class off leaves every other draw, the noise and the exposure unchanged
    for dropped in ("dust_on_optics", "broken_lines"):
        faults = {name: {} for name in ALL_FAULTS if name != dropped}
        lacking = Session(config.parse_scene({**small_scene(), "faults": faults}, source="test"))
        i = next(f.spec.index for f in frames_ if dropped in f.drawn)
        # the same fault matrix for the other classes: take it from the full plan
        columns = [k for k, name in enumerate(ALL_FAULTS) if name != dropped]
        full = frames_[i].spec.plan
        planned = replace(
            lacking.plan, injected=full.injected[:, columns], stratum=full.stratum, variables=full.variables
        )
        frame = pipeline.simulate_frame(
            replace(frames_[i].spec, scene=lacking.scene, plan=planned, faults=lacking.faults)
        )
        assert np.array_equal(frame.images.clean.array, frames_[i].images.clean.array)
        want = frames_[i].images.without[dropped].array
        assert np.array_equal(frame.images.image.array, want)


def test_worn_coatings_raise_the_ghosts_of_the_same_picture_alone() -> None:
    faults = {
        "straylight": {"model": "traced", "coating": "mgf2"},
        "optics_degradation": {"model": "contamination", "coating": "mgf2", "haze": 0.0, "scratches": 0}
        | {"dose_krad": 0.0, "coating_loss": 0.5},
    }

    def of(names: set[str], layers: list[str]) -> Session:
        chosen = {name: faults[name] for name in faults if name in names}
        scene = {**small_scene(dataset={"layers": layers}), "faults": chosen}
        return Session(config.parse_scene(scene, source="test"))

    s = of(set(faults), ["clean", "without_optics_degradation"])
    i = next(i for i in range(16) if all(s.plan.injects(name)[i] for name in faults))
    frame = s.frame(i)
    assert len(frame.drawn) == 2
    alone = of({"straylight"}, ["clean"])
    planned = replace(
        alone.plan,
        injected=s.plan.injected[:, [list(s.faults).index("straylight")]],
        stratum=s.plan.stratum,
        variables=s.plan.variables,
    )
    lacking = pipeline.simulate_frame(replace(frame.spec, scene=alone.scene, plan=planned, faults=alone.faults))
    assert np.array_equal(frame.images.without["optics_degradation"].array, lacking.images.image.array)
    worn, whole = (sum(g["flux_fraction"] for g in f.drawn["straylight"]["ghosts"]) for f in (frame, lacking))
    assert worn > 1.5 * whole
    assert frame.images.image.array.mean() > frame.images.without["optics_degradation"].array.mean()


def test_light_is_traced_once_for_each_state_of_the_coatings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Straylight depends on the coatings' loss; the shadows of dust do not, so they are computed once."""
    from vbnfault.faults import dust_lens
    from vbnfault.lens.straylight.total import SunInLens

    straylight = recorded_calls(monkeypatch, SunInLens, "straylight")
    shadows = recorded_calls(monkeypatch, dust_lens, "_shadows")
    faults = {
        "straylight": {"model": "paraxial"},
        # few grains, whose glow leaves the image below white
        "dust_on_optics": {"model": "defocused", "surface": -2, "count": 5, "diameter_um": 50},
        "optics_degradation": {"model": "contamination"},
    }
    layers = ["clean", "mask_effect", "straylight_added", "dust_opacity", *(f"without_{name}" for name in faults)]
    scene = small_scene(
        camera={"width_px": 48, "height_px": 48},
        dataset={"layers": layers},
        plan={"faulty_fraction": 1.0, "mode": "per_class"},
    )
    s = Session(config.parse_scene({**scene, "faults": faults}, source="test"))
    whole = []
    for i in range(3):
        straylight.clear()
        shadows.clear()
        draws = s.frame(i).injection.draws
        if {draw.key for draw in draws.values()} == {(name, 0) for name in faults}:
            whole.append((len(straylight), len(shadows)))
    # with the worn coatings, and with whole ones where the degradation is left out
    assert whole
    assert set(whole) == {(2, 1)}


def test_a_redrawn_fault_leaves_the_draws_and_results_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A degradation that changes nothing is drawn until it is given up; dust is drawn and computed once."""
    from vbnfault.faults import degradation_lens, dust_lens

    dust = recorded_calls(monkeypatch, dust_lens.DefocusedDust, "draw")
    degradation = recorded_calls(monkeypatch, degradation_lens.Contamination, "draw")
    shadows = recorded_calls(monkeypatch, dust_lens, "_shadows")
    nothing = {"haze": 0.0, "scratches": 0, "dose_krad": 0.0, "coating_loss": 0.0}
    faults = {
        "dust_on_optics": {"model": "defocused"},
        "optics_degradation": {"model": "contamination", **nothing},
    }
    plan_ = {"faulty_fraction": 1.0, "mode": "per_class", "on_invisible": "drop"}
    camera = {"width_px": 48, "height_px": 48}
    for layers in (["clean"], ["clean", "mask_effect"]):
        for calls in (dust, degradation, shadows):
            calls.clear()
        scene = {**small_scene(camera=camera, plan=plan_, dataset={"layers": layers}), "faults": faults}
        frame = Session(config.parse_scene(scene, source="test")).frame(0)
        assert [draw.key for draw in frame.injection.draws.values()] == [("dust_on_optics", 0)]
        assert (len(dust), len(degradation), len(shadows)) == (1, 8, 1)


@pytest.mark.parametrize("layers", [["clean"], ["clean", "mask_effect"]])
def test_a_fault_that_only_moves_roundings_is_not_injected_unless_the_delivered_image_changes(
    layers: list[str],
) -> None:
    """A grain of 0.1 µm far out of focus takes 10⁻¹⁰ of the light: by chance it changes a pixel or two by 1 DN.

    Without noise these are other pixels than with noise. Labels are of the image that is delivered.
    """
    dust = {"model": "defocused", "diameter_um": [0.1, 0.1], "count": [1, 1]}
    scene = {
        **small_scene(
            camera={"width_px": 192, "height_px": 192},
            plan={"faulty_fraction": 1.0, "on_invisible": "drop"},
            geometry={"min_lit_fraction": 0.3},
            dataset={"layers": layers, "samples": 8, "variants_per_view": 8, "shard_samples": 8},
        ),
        "faults": {"dust_on_optics": dust},
    }
    s = Session(config.parse_scene(scene, source="test"))
    for index in range(8):
        sample = to_sample(s.frame(index))
        changes = not np.array_equal(sample.layers["image"], sample.layers["clean"])
        assert sample.scalars["injected"].tolist() == [changes]


def test_a_mosaic_detector_takes_raw_pictures_with_its_own_device() -> None:
    faults = {"broken_pixels": {"model": "hot_pixels", "growth_factor": 1e5, "years": 10.0}, "broken_lines": {}}
    camera = {"width_px": 96, "height_px": 80, "detector": "generic_cmos", "individuals": 4}
    scene = {
        **small_scene(camera=camera, dataset={"layers": ["clean", "raw", "defects", "without_broken_pixels"]}),
        "faults": faults,
    }
    s = Session(config.parse_scene(scene, source="test"))
    devices: dict[int, int] = {}
    stuck = 0
    for i in range(6):
        frame = s.frame(i)
        sample = to_sample(frame)
        raw = sample.layers["raw"]
        assert (raw.shape, raw.dtype) == ((80, 96), np.uint16)
        detector: Any = frame.camera.detector
        kinds = sample.layers["defects"]
        assert (kinds.shape, kinds.dtype) == ((80, 96), np.uint8)
        own = detector.device.bad
        assert (kinds[own] > 0).all()
        if "broken_pixels" in frame.drawn:
            named = frame.drawn["broken_pixels"]
            assert (kinds[named["y"], named["x"]] > 0).all()
            # of two in one pixel only one shows
            shown = {(one["y"], one["x"]): one["level"] for one in named["stuck"]}
            stuck += len(shown)
            assert sum(abs(int(raw[at]) - level * 4095) > 1 for at, level in shown.items()) <= len(shown) // 20
        else:
            assert not (kinds[~own] & 7).any()
        assert devices.setdefault(int(sample.scalars["detector_individual"]), detector.seed) == detector.seed
        if "broken_pixels" in frame.drawn:
            changed = (frame.images.image.array != frame.images.without["broken_pixels"].array).any(axis=2)
            mask = frame.labels.masks[list(s.faults).index("broken_pixels")]
            lines = frame.labels.masks[list(s.faults).index("broken_lines")]
            assert not (changed & ~mask & ~lines).any()
            assert (changed & mask).any()
        again = s.frame(i)
        assert np.array_equal(again.images.image.array, frame.images.image.array)
    assert len(set(devices.values())) == len(devices) > 1
    assert stuck > 10


def test_what_overflows_from_a_track_is_in_its_mask() -> None:
    """A slow proton fills a well of a CCD many times over: its charge runs along the column, past the footprint."""
    faults = {"cosmic_rays": {"flux_per_cm2_s": 5e4, "energy_MeV": 2.0}}
    camera = {"width_px": 96, "height_px": 80, "detector": "generic_ccd", "exposure_s": 0.02}
    scene = {**small_scene(camera=camera, plan={"faulty_fraction": 1.0}), "faults": faults}
    s = Session(config.parse_scene(scene, source="test"))
    frame = s.frame(1)
    footprint = s.faults["cosmic_rays"].footprint(frame.drawn["cosmic_rays"], frame.context)
    assert footprint is not None
    change = np.abs(frame.images.image.array.astype(int) - frame.images.clean.array).max(axis=2)
    assert change[~footprint].max() > 5
    mask, draws, development = frame.labels.masks[0], frame.injection.draws, frame.injection.development
    images = [development.image(of, noisy=False).array for of in (draws, {})]
    assert not (images[0] != images[1])[~mask].any()
    # How far the charge runs depends on its shot noise, which the mask does not know: with noise it may reach one
    # more pixel, and so change the colours of those around it.
    detector, signal = s.base_camera.detector, development.signal({}, []).merged
    alone = [detector.raw(signal, frame.camera.exposure_s, None, development.acts(of)) for of in (draws, {})]
    more = np.abs(development.raw(draws).astype(int) - development.raw({}))
    farther = (more > 1) & (alone[0] == alone[1])
    ends = cv2.dilate(farther.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    # elsewhere, noise rounds to another number here and there, where a trail is too weak to show without it
    assert change[~mask & ~ends].max(initial=0) <= 1
    tracks, readout = frame.drawn["cosmic_rays"]["tracks"], detector.sensor.readout
    assert np.count_nonzero(farther) <= len(tracks)
    # at the ends, three standard deviations of the charge of the strongest track
    noise_dn = 255 * float(detector.device.white_balance.max()) / readout.white_e
    noise_dn *= np.sqrt(max(track["electrons"] for track in tracks))
    assert change[~mask].max(initial=0) <= 1 + 3 * noise_dn
    assert not (footprint & ~frame.labels.masks[0]).any()


def test_geometry_scalars_agree_with_one_another(frames_: list[Frame]) -> None:
    from scipy.spatial.transform import Rotation

    for frame in frames_:
        sample = to_sample(frame)
        s = sample.scalars
        assert s["lens"] == 0  # the index in a list of one name
        camera_from_T = Rotation.from_quat(s["camera_from_T"], scalar_first=True).as_matrix()
        sun_C = camera_from_T @ s["sun_direction_T"]
        np.testing.assert_allclose(sun_C, frame.context.sun_direction_C, atol=1e-12)
        fx, fy, cx, cy = s["intrinsics"]
        if sun_C[2] > 0:
            want = [cx + fx * sun_C[0] / sun_C[2], cy + fy * sun_C[1] / sun_C[2]]
            np.testing.assert_allclose(s["sun_xy_px"], want, rtol=1e-9)
        position = s["site_T_m"] + s["T_from_L"] @ s["position_L_m"]
        np.testing.assert_allclose(position, s["camera_position_T_m"], atol=1e-9)
        # the commanded Sun, by way of the target's attitude in J
        sun_J = -frames.unit(frames.ORBIT_67P.position_J_au(s["julian_date"]))
        np.testing.assert_allclose(s["T_from_J"] @ sun_J, s["sun_direction_T"], atol=1e-12)
        azimuth, elevation = frames.azimuth_elevation_deg(s["T_from_L"].T @ s["sun_direction_T"])
        assert azimuth == pytest.approx(s["sun_azimuth_deg"] % 360, abs=1e-9)
        assert elevation == pytest.approx(s["sun_elevation_deg"], abs=1e-9)


def test_cameras_are_above_ground_and_clear() -> None:
    # close to the ground, where three proposals in four come nearer than the clearance
    from scipy.spatial import cKDTree

    from vbnfault import render

    low = session(geometry={"height_m": [0.0, 40.0], "clearance_m": 30.0}, dataset={"sites": 1})
    vertices = low.patch(low.sites[0]).vertices_L_m
    tree = cKDTree(vertices)
    for i in range(16):
        spec = low.spec(i)
        pose = resolve(spec)
        assert pose.resolved
        p = pose.position_L_m
        assert tree.query(p)[0] >= 30.0  # no vertex is nearer than the surface
        ground = render.ground_height_m(spec.terrain.surface, p[:1], p[1:2], 500.0)[0]
        assert -1e-3 <= -p[2] - ground <= 40 + 1e-3


def test_a_fixed_exposure_is_kept_and_scales_the_signal() -> None:
    compared = 0
    for i in range(8, 12):
        short, long = (session(camera={"exposure_s": t}).frame(i) for t in (0.002, 0.004))
        assert (short.camera.exposure_s, long.camera.exposure_s) == (0.002, 0.004)
        one, two = (frame.injection.development.image({}, noisy=False).array.astype(int) for frame in (short, long))
        shown = (two < 255) & (one > 0)
        # both are rounded to whole numbers, 2 · 0.5 + 0.5, after the converter rounded them to finer ones
        assert not shown.any() or np.abs(two - 2 * one)[shown].max() <= 2
        compared += np.count_nonzero(shown & (one > 20))
    assert compared > 1000


def test_the_paper_example_has_the_papers_parameters() -> None:
    shrink = {"camera.width_px": 256, "camera.height_px": 256}
    shrink |= {"patch.facet_m": 12.0, "patch.radius_m": 60.0, "patch.max_triangles": 100_000}
    s = Session(config.load_scene("paper_example", shrink))
    parameters = to_sample(s.frame(0)).scalars["parameters"]
    assert len(parameters["dust_on_optics"]["x_px"]) == 50
    assert parameters["broken_pixels"]["sensor"] == "ccd"
    assert parameters["broken_pixels"]["line_direction"] == "right"
    assert len(parameters["broken_pixels"]["x"]) == 9
    values = parameters["broken_lines"]["row_values"] + parameters["broken_lines"]["column_values"]
    assert sorted(values) == [0, 0, 255, 255, 255]
    assert parameters["optics_degradation"]["filter_size_px"] == 3
    flares = parameters["straylight"]["flares"]
    assert [(f["index"], f["position"], f["radius"], f["brightness"]) for f in flares] == [
        (3, 0.83, 0.11, 1.5),
        (4, 1.00, 0.13, 1.5),
        (5, 1.17, 0.16, 1.5),
    ]
    assert parameters["vignetting"]["on_axis_illuminance_dn"] == 255
    spec = s.spec(0)
    assert spec.scene.camera.readout_directions == ("right",)
    (architecture,) = spec.scene.camera.architectures
    assert architecture.endswith("_ccd")


def test_the_effect_by_rows_equals_the_effect_of_whole_pictures(frames_: list[Frame]) -> None:
    # the pipeline develops only the rows whose signal changes
    for frame in frames_:
        development, draws = frame.injection.development, frame.injection.draws
        whole = development.image(draws, noisy=False).array
        for name in draws:
            other = development.image(without(draws, name), noisy=False).array
            assert np.array_equal(development.effect(draws, name), (whole != other).any(axis=-1))


def test_clean_twin_differs_only_where_faults_are(frames_: list[Frame]) -> None:
    local = [ALL_FAULTS.index(n) for n in ("dust_on_optics", "broken_pixels", "broken_lines")]
    checked = 0
    for frame in frames_:
        if not set(frame.drawn) <= {ALL_FAULTS[k] for k in local}:
            continue
        changed = masks.effect(frame.images.image.array, frame.images.clean.array)
        assert not (changed & ~frame.labels.masks[local].any(axis=0)).any()
        checked += 1
    assert checked >= 1


def test_surface_points_reproject_to_their_pixels(frames_: list[Frame]) -> None:
    """Depth, pose and intrinsics agree: the 3-D point of a pixel, seen from it, lies on the body's surface."""
    from vbnfault import render

    checked = 0
    for frame in frames_:
        body = frame.rendering.truth.semantic == 1
        if body.mean() < 0.2:
            continue
        y, x = np.nonzero(body)
        pick = slice(None, None, max(1, len(y) // 200))
        depth = frame.rendering.truth.depth_m[y[pick], x[pick]].astype(float)
        fx, fy, cx, cy = frame.camera.intrinsics
        in_C = np.stack([(x[pick] + 0.5 - cx) / fx, (y[pick] + 0.5 - cy) / fy, np.ones_like(depth)], -1)
        point = frame.pose.position_L_m + (in_C * depth[:, None]) @ frame.pose.L_from_C.T
        # a probe half a millimetre-per-metre in front is in the open, and surface lies within twice that
        away = frame.pose.position_L_m - point
        reach = np.linalg.norm(away, axis=1)
        probe = point + away * 5e-4
        hits = [
            not render.is_clear(frame.spec.terrain.surface, probe[j : j + 1], 0.02 * reach[j] + 1e-3)[0]
            for j in range(0, len(probe), 20)
        ]
        assert np.mean(hits) > 0.95
        checked += 1
    assert checked >= 2


def test_sun_is_whole_and_a_flare_is_in_the_frame_where_straylight_is(frames_: list[Frame]) -> None:
    for frame in frames_:
        if "straylight" in frame.drawn:
            assert frame.pose.sun_visible_fraction == 1.0
            assert frame.labels.masks[ALL_FAULTS.index("straylight")].any()
            assert frame.spec.plan.stratum[frame.spec.index] == plan.SUN_FACING
        else:
            angle = np.degrees(np.arccos(frame.pose.L_from_C[:, 2] @ frame.pose.sun_L))
            assert angle >= np.sqrt(2) * 32.5 - 1e-9
