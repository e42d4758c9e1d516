"""Views that aim: weights and distances, poses against closed forms, what the stored frames show, stores."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from poses_kit import C_from_T
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault import dataset, store
from vbnfault.body import Body, embedded_nucleus, site_at
from vbnfault.core import frames
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import BODY, Sample
from vbnfault.scene import aims, config, plan
from vbnfault.world import aiming, ground

RADIUS_M = 2000.0
FOV_DEG, WIDTH_PX, HEIGHT_PX = 12.0, 40, 32
SAMPLES, OF_EACH = 20, 4
EVEN = dict.fromkeys(aims.AIMS, 1)


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the path of a sphere of 20480 triangles, whose vertices and centres of facets enclose its radius."""
    import trimesh

    path = tmp_path_factory.mktemp("sphere") / "sphere.obj"
    trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_M * 1.0002).export(path)
    return str(path)


def scene(shape: str = "embedded", **tables: dict[str, Any]) -> vbnfault.Scene:
    """Return a small scene, by default of the embedded nucleus."""
    own = {"unit": "m", "name": "sphere", "density_kg_m3": 500.0, "rotation_period_h": 300.0, "reflectance": 0.06}
    own |= {"pole_ra_deg": 0.0, "pole_dec_deg": 90.0, "prime_meridian_deg": 0.0}
    content: dict[str, Any] = {
        "title": "aimed",
        "dataset": {"samples": 20, "sites": 2, "shard_samples": 4, "layers": ["clean", "depth_m", "semantic"]},
        "body": {} if shape == "embedded" else {"shape": shape, **own},
        "patch": {"facet_m": 1.0, "radius_m": 5.0, "relief": 0.0, "boulders": False, "max_triangles": 45_000},
        "sun": {"distance_au": 2.0},
        "camera": {"fov_deg": FOV_DEG, "width_px": WIDTH_PX, "height_px": HEIGHT_PX},
        "geometry": {"aim": EVEN, "distance_m": [50.0, 300e3], "pointing_error_deg": 0.0},
        "render": {"bands": 2, "samples_per_pixel": 4},
    }
    for name, table in tables.items():
        content[name] = {**content.get(name, {}), **table}
    return config.parse_scene(content, source="test")


def planned(wanted: vbnfault.Scene, *faults: str) -> plan.Plan:
    return plan.make_plan(wanted, faults, need_sun=[name for name in faults if name == "straylight"])


# --------------------------------------------------------------------------------------------------- the plan


def test_weights_set_the_numbers_of_samples_and_distances_fill_every_octave() -> None:
    weights = {"nadir": 2, "limb": 1, "site": 3, "random": 1, "sun": 1}
    table = planned(scene(dataset={"samples": 800}, geometry={"aim": weights}))
    assert table.aim is not None
    count = {name: int((table.aim == k).sum()) for k, name in enumerate(aims.AIMS)}
    assert count == {name: 100 * weight for name, weight in weights.items()}
    np.testing.assert_array_equal(table.stratum == plan.SUN_FACING, table.aim == aims.SUN)
    # n multiples of the golden ratio leave no gap above 1.9 / n (three-distance theorem: at most φ² / √5 + 1 / n)
    u = np.log(table.variables["distance_m"] / 50) / np.log(300e3 / 50)
    for part in (u, u[:100], u[400:404]):
        gaps = np.diff(np.concatenate([[0], np.sort(part), [1]]))
        assert gaps.max() < 1.9 / len(part)
    one = planned(scene(geometry={"aim": "limb"}))
    assert [one.aim_of(k) for k in range(20)] == ["limb"] * 20
    aimless = scene(geometry={"aim": None})  # the file has keys of an aim
    assert planned(aimless).aim is None


def test_faults_that_need_the_sun_have_it_as_their_aim_or_are_refused() -> None:
    every = {"mode": "per_class", "faulty_fraction": 0.5}
    wanted = scene(plan=every, geometry={"aim": {"sun": 1, "limb": 3}})
    table = planned(wanted, "straylight", "vignetting")
    assert table.aim is not None
    assert (table.aim[table.injects("straylight")] == aims.SUN).all()
    assert int((table.aim == aims.SUN).sum()) == 10  # the weight gives 5; the fault needs 10
    few = planned(
        scene(plan={**every, "faulty_fraction": 0.1}, geometry={"aim": {"sun": 1, "limb": 3}}), "straylight"
    )
    assert few.aim is not None
    assert int((few.aim == aims.SUN).sum()) == 5
    with pytest.raises(
        InputError, match=r"geometry\.aim: 10 of 20 samples have a fault that needs the Sun, but .*; "
    ):
        planned(scene(plan=every, geometry={"aim": "limb"}), "straylight")


def test_a_longer_block_keeps_the_views_and_a_redraw_keeps_aim_and_distance() -> None:
    short, long = planned(scene()), planned(scene(dataset={"samples": 40}))
    for name in aims.AIM_VARIABLES:
        if not name.startswith("target"):  # what they mean depends on the aim
            np.testing.assert_array_equal(short.variables[name], long.variables[name][:20])
    wanted = scene()
    for index in range(10):
        first, second = (short.view(wanted, index, attempt) for attempt in (0, 1))
        assert set(first) == set(second) == set(aims.NEEDED[short.aim_of(index)])
        assert first["distance_m"] == second["distance_m"]
        assert first["camera_turn_deg"] != second["camera_turn_deg"]
        assert short.view(wanted, index, 16)["distance_m"] != first["distance_m"]


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"geometry": {"aim": "zenith"}}, r"geometry\.aim = 'zenith': must be 'sun', 'nadir', 'limb', 'site' or "),
        ({"geometry": {"aim": {"limb": 0}}}, r"geometry\.aim: all weights are 0; one of sun, nadir, limb, site, "),
        ({"geometry": {"aim": {"lim": 1}}}, r"geometry\.aim\.lim: unknown key \(did you mean limb\?\)"),
        ({"geometry": {"aim": {"limb": -1}}}, r"geometry\.aim\.limb = -1: must be a number from 0 to 1000000"),
        ({"geometry": {"distance_m": [0, 1]}}, r"geometry\.distance_m\[0\] = 0: must be a number from 0\.1 to 1e"),
        ({"geometry": {"x_m": [0, 1]}}, r"geometry\.x_m = \(0\.0, 1\.0\): does not apply beside geometry\.aim"),
        (
            {"geometry": {"height_reference": "site"}},
            r"geometry\.height_reference = 'site': does not apply beside ",
        ),
        ({"geometry": {"sun_averted": {"roll_deg": [0, 1]}}}, r"geometry\.sun_averted: does not apply beside geom"),
        ({"plan": {"sun_facing_nominal_fraction": 0.2}}, r"geometry\.aim: does not apply beside plan\.sun_facing_"),
        (
            {"trajectory": {"file": "poses.csv"}},
            r"geometry\.aim: does not apply beside a trajectory; leave one out",
        ),
    ],
)
def test_wrong_keys_are_refused_in_a_sentence(tables: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=rf"test: {sentence}"):
        scene(**tables)


@pytest.mark.parametrize(
    ("key", "value", "shown"),
    [
        ("distance_m", [1e3, 2e3], r"\(1000\.0, 2000\.0\)"),
        ("sun_elongation_deg", [90, 180], r"\(90\.0, 180\.0\)"),
        ("pointing_error_deg", 0.0, r"0\.0"),
    ],
)
def test_keys_of_an_aim_are_refused_without_one(key: str, value: Any, shown: str, tmp_path: Path) -> None:
    """The camera would fly at the default heights, whatever distance is asked for."""
    content: dict[str, Any] = {"title": "aimless", "geometry": {key: value}}
    sentence = rf"test: geometry\.{key} = {shown}: applies beside geometry\.aim alone; give geometry\.aim, or leave"
    with pytest.raises(InputError, match=sentence):
        config.parse_scene(content, source="test")
    flown = content | {"trajectory": {"file": str(tmp_path / "poses.csv")}}  # no key of [geometry] applies there
    config.parse_scene(flown, source="test")
    stored = config.parse_scene({"title": "aimless"}, source="test").resolved()
    config.parse_scene(stored, source="test")


# ------------------------------------------------------------------------------------------------- the poses


@lru_cache(maxsize=1)
def nucleus() -> Body:
    vertices, faces = embedded_nucleus()
    return Body(name="nucleus", vertices_m=vertices, faces=faces)


@pytest.mark.parametrize("distance_m", [60.0, 2e3, 40e3, 300e3])
def test_rays_just_inside_the_outline_meet_the_body_and_rays_beyond_it_do_not(distance_m: float) -> None:
    """On the irregular nucleus, at eight azimuths; the outline of a mesh is exact to rounding."""
    body = nucleus()
    site = site_at(body, 0, body.vertices_m[np.argmax(body.vertices_m[:, 0])])
    camera = site.position_T_m - distance_m * site.T_from_L[:, 2]
    around = site.T_from_L @ frames.L_from_C0(np.array([0.0, 0.0, 1.0]), north_up=True)
    np.testing.assert_allclose(around.T @ site.T_from_L[:, 1], [1, 0, 0], atol=1e-12)  # east is right
    for turn_deg in np.arange(0, 360, 45.0):
        limb_deg = aiming.limb_angle_deg(body, camera, around, turn_deg)
        turn = np.radians(turn_deg)
        outward = np.cos(turn) * site.T_from_L[:, 0] + np.sin(turn) * site.T_from_L[:, 1]  # from north to east
        for angle_deg, meets in ((limb_deg * (1 - 1e-6), True), (limb_deg * (1 + 1e-6), False)):
            angle = np.radians(angle_deg)
            towards = np.cos(angle) * site.T_from_L[:, 2] + np.sin(angle) * outward
            assert (ground.first_hit(body, camera, towards) is not None) is meets


def test_poses_have_the_distance_phase_and_target_of_their_values() -> None:
    body, wanted = nucleus(), scene(geometry={"pointing_error_deg": 2.0, "zenith_deg": [20, 60]})
    site = site_at(body, 0, body.vertices_m[np.argmax(body.vertices_m[:, 2])])
    table = planned(wanted)
    up = -site.T_from_L[:, 2]
    for index in range(20):
        aim, values = table.aim_of(index), table.view(wanted, index, 0)
        pose = aiming.aimed_view(wanted, body, site, aim, values).pose
        to_camera = pose.camera_position_T_m - site.position_T_m
        assert np.linalg.norm(to_camera) == pytest.approx(values["distance_m"], rel=1e-9)
        to_camera = frames.unit(to_camera)
        zenith_deg = np.degrees(np.arccos(min(to_camera @ up, 1.0)))
        assert zenith_deg == pytest.approx(values.get("zenith_deg", 0.0), abs=1e-4)
        np.testing.assert_allclose(pose.T_from_C.T @ pose.T_from_C, np.eye(3), atol=1e-12)
        sun_C = pose.T_from_C.T @ pose.sun_direction_T
        seen = {"sun": sun_C, "nadir": pose.T_from_C.T @ -up, "site": pose.T_from_C.T @ -to_camera}.get(aim)
        if seen is not None:
            angles = np.degrees(np.arctan2(seen[:2], seen[2]))
            assert angles == pytest.approx([values["target_x_deg"], values["target_y_deg"]], abs=1e-6)
        if aim == "sun":
            slope = np.tan(np.radians(FOV_DEG / 2))
            assert np.abs(sun_C[0] / sun_C[2]) <= 0.9 * slope
            assert np.abs(sun_C[1] / sun_C[2]) <= 0.9 * slope * HEIGHT_PX / WIDTH_PX
        else:
            phase_deg = np.degrees(np.arccos(to_camera @ pose.sun_direction_T))
            assert phase_deg == pytest.approx(values["phase_deg"], abs=1e-5)


def test_pointing_errors_are_normal_and_turns_uniform() -> None:
    """2000 views: the standard deviation of normal errors is known to 1.6 % (1 / √(2 n)), the mean to 2.2 %."""
    wanted = scene(dataset={"samples": 2000}, geometry={"aim": "site", "pointing_error_deg": 0.5})
    drawn = planned(wanted).variables
    for name in ("target_x_deg", "target_y_deg"):
        assert drawn[name].std() == pytest.approx(0.5, rel=0.05)
        assert abs(drawn[name].mean()) < 0.035
    for name, high in (("camera_turn_deg", 360), ("phase_deg", 120), ("sun_turn_deg", 360)):
        assert np.abs(np.sort(drawn[name]) / high - (np.arange(2000) + 0.5) / 2000).max() < 0.035


def test_ground_that_other_ground_hides_is_found_and_does_not_make_facets_coarser() -> None:
    """Against a search through all facets, from above a site between the lobes of the nucleus."""
    from vbnfault import render

    body, wanted = nucleus(), scene(patch={"facet_m": 0.05, "max_triangles": 1_000_000})
    smooth = np.zeros(len(body.faces), dtype=bool)
    model = render.TerrainMesh(body.vertices_m.astype(np.float32), body.faces, smooth)
    camera = np.array([900.0, 300.0, 2500.0])
    facing = np.einsum("ni,ni->n", body.vertex_normals, body.vertices_m - camera) < 0
    points = body.vertices_m[facing][::60]
    expected = []
    for point in points:
        distance = np.linalg.norm(point - camera)
        hit = ground.first_hit(body, camera, (point - camera) / distance)
        expected.append(hit is not None and np.linalg.norm(hit - camera) < 0.999 * distance)
    hidden = render.hidden_points(model, camera, points)
    assert 5 < hidden.sum() < len(points) - 5
    assert (hidden != expected).sum() <= 0.01 * len(points)  # float32
    # straight down, the ground in the frame is about as far as the site: facets of a pixel, or somewhat more
    site = site_at(body, 0, body.vertices_m[np.argmax(body.vertices_m[:, 2])])
    values = {"distance_m": 700.0, "target_x_deg": 0.0, "target_y_deg": 0.0, "camera_turn_deg": 0.0}
    pose = aiming.aimed_view(wanted, body, site, "nadir", values | {"phase_deg": 30.0, "sun_turn_deg": 0.0}).pose
    (detail,) = ground.ground_details(wanted, body, [pose])
    assert detail.radius_m < 2 * 700 * np.tan(np.radians(FOV_DEG / 2))
    assert detail.facet_m < 1.1 * 700 * wanted.camera.pixel_rad


# ------------------------------------------------------------------------------------------- stored samples


def disc_px(distance_m: float) -> float:
    """Return the radius in pixels of the sphere's outline, from a distance above its surface."""
    focal_px = WIDTH_PX / 2 / np.tan(np.radians(FOV_DEG / 2))
    centre_m = distance_m + RADIUS_M
    return float(focal_px * RADIUS_M / np.sqrt(centre_m**2 - RADIUS_M**2))


@lru_cache(maxsize=1)
def frames_of(shape: str) -> tuple[vbnfault.Session, list[Sample]]:
    """Return samples of the sphere, as many of each aim, from 50 m to 300 km."""
    session = vbnfault.Session(scene(shape, dataset={"samples": SAMPLES, "sites": 1}))
    return session, [session.simulate(index) for index in range(SAMPLES)]


def each(shape: str, aim: str) -> list[tuple[float, Sample]]:
    """Return the distances and the samples of one aim."""
    session, samples = frames_of(shape)
    chosen = [k for k in range(SAMPLES) if session.plan.aim_of(k) == aim]
    assert len(chosen) == OF_EACH
    return [(json_of(samples[k])["distance_m"], samples[k]) for k in chosen]


def json_of(sample: Sample) -> dict[str, Any]:
    return dict(sample.scalars["proposal"])


def seen(sample: Sample) -> np.ndarray:
    """Return which pixels show the body, bool[y, x], after a check that both layers of truth agree."""
    body = np.isfinite(sample.layers["depth_m"])
    np.testing.assert_array_equal(body, sample.layers["semantic"] == BODY)
    return body


def test_nadir_and_site_are_in_the_middle_in_sunlight_at_their_distance(sphere: str) -> None:
    """Half a pixel beside the middle, ground that is tilted by the zenith angle is off by its tangent at most.

    The terrain bulges over the model's facets by 0.8 m (see below).
    """
    for aim in ("nadir", "site"):
        for distance_m, sample in each(sphere, aim):
            depth = sample.layers["depth_m"][15:17, 19:21]
            if disc_px(distance_m) > 4:  # else the four pixels also see the sky
                tilt_deg = json_of(sample).get("zenith_deg", 0.0)
                pixel = np.radians(FOV_DEG) / WIDTH_PX
                tilted = 0.5 * pixel * np.tan(np.radians(tilt_deg))
                far_enough = 1.0 / np.cos(np.radians(tilt_deg)) + distance_m * (tilted + 1e-3)
                assert depth.mean() == pytest.approx(distance_m, abs=far_enough)
                assert (sample.layers["clean"][15:17, 19:21, 3] > 10).any()
        assert all(seen(sample).any() for _, sample in each(sphere, aim))
        lit = [float((sample.layers["clean"][seen(sample), 3] > 10).mean()) for _, sample in each(sphere, aim)]
        assert np.median(lit) > 0.6


def test_a_sphere_has_its_size_at_every_distance(sphere: str) -> None:
    """Area of the disc against the closed form; pixels on its rim make an error of √(8 r / π) px at most, twice."""
    counted = 0
    for distance_m, sample in each(sphere, "nadir"):
        radius_px = disc_px(distance_m)
        if 1 < radius_px < HEIGHT_PX / 2 - 1:
            area = float(seen(sample).sum())
            assert area == pytest.approx(np.pi * radius_px**2, abs=2 * np.sqrt(8 * radius_px / np.pi) + 1)
            counted += 1
        elif radius_px > HEIGHT_PX:
            assert seen(sample).all()
            counted += 1
    assert counted >= OF_EACH - 1


def test_limbs_pass_through_the_middle_with_sky_on_one_side(sphere: str) -> None:
    for distance_m, sample in each(sphere, "limb"):
        body = seen(sample)
        assert 0 < body.mean() < 0.75
        y, x = np.nonzero(body)
        nearest = np.hypot(x + 0.5 - WIDTH_PX / 2, y + 0.5 - HEIGHT_PX / 2).min()
        assert nearest < 1.5
        # the outline is a circle through the middle: sky begins within two pixels of it, too
        y, x = np.nonzero(~body)
        assert np.hypot(x + 0.5 - WIDTH_PX / 2, y + 0.5 - HEIGHT_PX / 2).min() < 1.5
        if disc_px(distance_m) > 2:
            assert (sample.layers["clean"][body, 3] > 10).mean() > 0.15


def test_the_sun_is_in_the_frame_whole_and_others_keep_it_out(sphere: str) -> None:
    session, samples = frames_of(sphere)
    low_deg, _ = aims.sun_elongation_deg(session.scene)
    for index, sample in enumerate(samples):
        x, y = sample.scalars["sun_xy_px"]
        if session.plan.aim_of(index) == "sun":
            assert 0 < x < WIDTH_PX
            assert 0 < y < HEIGHT_PX
            assert sample.scalars["sun_visible_fraction"] == 1
        else:
            assert not (0 < x < WIDTH_PX and 0 < y < HEIGHT_PX)
            angle = frames.boresight_angle_deg(sample.scalars["roll_deg"], sample.scalars["pitch_deg"])
            assert angle >= low_deg - 1e-6


def test_random_frames_hold_some_of_the_body_anywhere(sphere: str) -> None:
    random = [(distance_m, seen(sample)) for distance_m, sample in each(sphere, "random")]
    towards_sun = [(distance_m, seen(sample)) for distance_m, sample in each(sphere, "sun")]
    assert all(body.any() for distance_m, body in random + towards_sun if disc_px(distance_m) > 1)
    near = [body for distance_m, body in random if disc_px(distance_m) > HEIGHT_PX]
    assert any(not body.all() for body in near)
    off = [body[HEIGHT_PX // 2, WIDTH_PX // 2] for _, body in random]
    assert not all(off)


def test_terrain_and_shape_model_have_no_seam(sphere: str) -> None:
    """Every depth against the intersection of its ray with the sphere, from patch to global model.

    The model's facets leave the sphere by 0.04 % at most, so by 0.8 m along the normal; a ray at 0.9 radii from the
    centre meets them at 64°, where this is 1.8 m along the ray. Single rays within 1e-5 of an edge pass between its
    two facets, because Embree computes in float32.
    """
    _, samples = frames_of(sphere)
    checked = wrong = 0
    for sample in samples:
        intrinsics = sample.scalars["intrinsics"]
        x, y = np.meshgrid(np.arange(WIDTH_PX) + 0.5, np.arange(HEIGHT_PX) + 0.5)
        rays = np.stack(
            [(x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1], np.ones_like(x)], -1
        )
        length = np.linalg.norm(rays, axis=-1)
        turn = Rotation.from_quat(sample.scalars["camera_from_T"], scalar_first=True)
        towards = turn.inv().apply((rays / length[..., None]).reshape(-1, 3))
        camera = sample.scalars["camera_position_T_m"]
        along = -towards @ camera
        miss = np.sqrt(np.maximum(camera @ camera - along**2, 0))
        exact = along - np.sqrt(np.maximum(RADIUS_M**2 - miss**2, 0))
        depth = sample.layers["depth_m"].ravel() * length.ravel()
        chosen = np.isfinite(depth) & (miss < 0.9 * RADIUS_M) & (along > 0)
        with np.errstate(invalid="ignore"):
            wrong += int((np.abs(depth - exact)[chosen] > 1.8 + 1e-6 * np.linalg.norm(camera)).sum())
        checked += int(chosen.sum())
    assert checked > 5000
    assert wrong <= checked / 5000


# ------------------------------------------------------------------------------------------------------ stores


def test_a_store_is_built_resumed_extended_and_verified(sphere: str, tmp_path: Path) -> None:
    wanted = scene(
        sphere,
        dataset={"samples": 4, "shard_samples": 2, "layers": ["depth_m"]},
        geometry={"aim": {"sun": 1, "site": 1}, "distance_m": [200.0, 2000.0]},
        faults={"straylight": {}, "broken_lines": {}},
        plan={"mode": "per_class", "faulty_fraction": 0.5},
    )
    out = tmp_path / "s.zarr"
    assert vbnfault.build(wanted, out, progress=False).built == 4
    assert vbnfault.build(wanted, out, progress=False).built == 0
    assert vbnfault.build(wanted, out, progress=False, append=2).built == 2
    opened = store.open_store(out)
    report = store.examine(opened, expected=dataset.planned(opened.attributes, opened.spec.faults))
    assert report.problems == []
    session = vbnfault.Session(wanted, blocks=[4, 2])
    with vbnfault.open_dataset(out) as data:
        assert data["roll_deg"].attrs["reference"] == {"sun-facing": "sun", "sun-averted": "sun"}
        for index in range(6):
            proposal = json.loads(str(data["proposal"].values[index]))
            assert proposal["aim"] == session.plan.aim_of(index)
            assert (proposal["aim"] == "sun") == (int(data["stratum"][index]) == plan.SUN_FACING)
            # roll and pitch count from the Sun
            sun_C = C_from_T(data, index) @ data["sun_direction_T"].values[index]
            angle = frames.boresight_angle_deg(float(data["roll_deg"][index]), float(data["pitch_deg"][index]))
            assert angle == pytest.approx(np.degrees(np.arccos(np.clip(sun_C[2], -1, 1))), abs=1e-6)
    other = scene(sphere, geometry={"aim": None, "distance_m": [100.0, 10e3], "pointing_error_deg": 0.1})
    identity = dataset.scene_identity(vbnfault.Session(other))
    assert "aim" not in identity["geometry"]


def test_a_sample_does_not_depend_on_the_samples_before_it(sphere: str) -> None:
    wanted = scene(sphere, dataset={"samples": 4, "layers": ["depth_m"]}, geometry={"distance_m": [60.0, 900.0]})
    forwards, backwards = vbnfault.Session(wanted), vbnfault.Session(wanted)
    first = [forwards.simulate(index) for index in range(4)]
    last = [backwards.simulate(index) for index in reversed(range(4))][::-1]
    for one, other in zip(first, last, strict=True):
        np.testing.assert_array_equal(one.layers["image"], other.layers["image"])
        np.testing.assert_array_equal(one.layers["depth_m"], other.layers["depth_m"])


def test_a_condition_that_no_view_meets_is_named_with_the_aim(sphere: str) -> None:
    hopeless = [
        ({"phase_deg": [100, 180], "sun_elongation_deg": [0, 180]}, "sunlit ground where the camera aims"),
        ({"sun_elongation_deg": [0, 1]}, "the Sun 0 to 1 deg from the boresight"),
        (
            {"clearance_m": 1e3, "distance_m": [50, 60], "phase_deg": [30, 60]},
            r"geometry.clearance_m = 1000 m to any surface",
        ),
    ]
    for geometry, condition in hopeless:
        session = vbnfault.Session(scene(sphere, geometry={"aim": "nadir", "max_tries": 5, **geometry}))
        with pytest.raises(
            vbnfault.VbnfaultError, match=rf"sample 0 \(aim 'nadir', site \d\): .*: {condition} \(5 of"
        ):
            session.simulate(0)


def test_the_description_counts_aims_and_gives_distances() -> None:
    text = "\n".join(dataset.describe_scene(scene(), source="aimed"))
    assert "aims: sun 4, nadir 4, limb 4, site 4, random 4; 0 deg of pointing error" in text
    assert "distances: 50 to 300000 m from the site" in text
    assert "phase angle at the site 0 to 120 deg, 8.49 to 180 deg from the boresight unless it is the aim" in text
