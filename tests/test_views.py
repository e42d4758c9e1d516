"""Views of a sample: conditions that are met or named, lit ground, other views for faults that cannot show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from poses_kit import C_from_T

import vbnfault
from vbnfault import dataset, pipeline, render
from vbnfault.body import load_body
from vbnfault.core import frames
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.pipeline import Session, resolve
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.spec import Frame, Pose, SampleSpec, Terrain
from vbnfault.scene import config, plan, redraw
from vbnfault.scene.instrument import CameraTable

SAMPLES = {"samples": 24, "sites": 1, "shard_samples": 8, "layers": ["clean"]}


def session(faults: dict[str, Any] | None = None, **tables: dict[str, Any]) -> Session:
    scene = small_scene(**{**tables, "dataset": {**SAMPLES, **tables.get("dataset", {})}})
    if faults is not None:
        scene["faults"] = faults
    return Session(config.parse_scene(scene, source="test"))


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    """One site for all sessions: geometry and plan change nothing of the ground."""
    return session().terrain(0)


def spec(s: Session, terrain: Terrain, index: int) -> SampleSpec:
    return SampleSpec(index=index, scene=s.scene, plan=s.plan, faults=s.faults, terrain=terrain)


def resolved(s: Session, terrain: Terrain, index: int, first_try: int = 0) -> Pose:
    return resolve.resolve(spec(s, terrain, index), first_try)


# ------------------------------------------------------------------------------------------------- conditions


@pytest.mark.parametrize(
    ("geometry", "stratum", "named"),
    [
        ({"height_m": [0, 0.3], "clearance_m": 0.5}, None, "geometry.clearance_m = 0.5 m to any surface (20 of 20"),
        ({"sun_facing": {"sun_elevation_deg": [-80, -70]}}, plan.SUN_FACING, "the whole Sun visible"),
        ({"sun_facing": {"roll_deg": [120, 240]}}, plan.SUN_FACING, "the whole Sun visible before the camera"),
        (
            {
                "sun_averted": {
                    "reference": "nadir",
                    "sun_elevation_deg": [-90, -89],
                    "roll_deg": [0, 1],
                    "pitch_deg": [0, 1],
                }
            },
            plan.SUN_AVERTED,
            "the Sun at least 46.0 deg from the boresight (20 of 20",
        ),
        ({"min_lit_fraction": 1.0}, None, "geometry.min_lit_fraction = 1 of the frame sunlit ground"),
    ],
)
def test_an_unresolved_pose_is_an_error_that_names_sample_and_condition(
    terrain: Terrain, geometry: dict[str, Any], stratum: int | None, named: str
) -> None:
    s = session(geometry={"max_tries": 20, **geometry})
    index = int(np.flatnonzero(s.plan.stratum == (plan.SUN_FACING if stratum is None else stratum))[0])
    with pytest.raises(VbnfaultError) as caught:
        resolved(s, terrain, index)
    said = str(caught.value)
    assert said.startswith(f"sample {index} (")
    assert named in said
    assert "geometry.max_tries = 20" in said
    assert "\n" not in said


def test_tries_begin_where_the_last_view_ended(terrain: Terrain) -> None:
    s = session()
    for index in range(4):
        first = resolved(s, terrain, index)
        second = resolved(s, terrain, index, first.tries)
        assert second.tries > first.tries
        for found in (first, second):
            assert found.variables == s.plan.view(s.scene, index, found.tries - 1)
            assert found.resolved


def test_height_counts_from_the_ground_or_from_the_site(terrain: Terrain) -> None:
    above = {"x_m": [30, 60], "y_m": [30, 60], "height_m": [40, 80]}
    for reference in ("local_ground", "site"):
        s = session(geometry={**above, "height_reference": reference})
        for index in range(6):
            found = resolved(s, terrain, index)
            x, y, z = found.position_L_m
            ground = float(render.ground_height_m(terrain.surface, np.array([x]), np.array([y]), 300.0)[0])
            level = ground if reference == "local_ground" else 0.0
            assert -z - level == pytest.approx(found.variables["height_m"], abs=1e-9)
            assert -z >= ground
    # inside the body nothing is near, and yet no camera can be there
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-150, 150, 31), np.linspace(-150, 150, 31)))
    ground = render.ground_height_m(terrain.surface, x, y, 500.0)
    k = int(np.argmax(ground))
    below = {"height_m": [0, ground[k] - 5], "x_m": [x[k], x[k]], "y_m": [y[k], y[k]], "max_tries": 9}
    s = session(geometry={**below, "height_reference": "site"})
    with pytest.raises(VbnfaultError, match=r"the camera above the ground \(9 of 9 tries did not\)"):
        resolved(s, terrain, 0)


def test_a_suns_place_is_kept_as_drawn_where_the_scene_says_so(terrain: Terrain) -> None:
    """The paper's simulator draws no Sun again: hidden ones stay, and straylight is then not in the pixels."""
    geometry = {"sun_facing": {"sun_elevation_deg": [-30, 30]}, "sun_visibility": "as_drawn"}
    s = session({"straylight": {}}, geometry=geometry, plan={"mode": "per_class", "faulty_fraction": 1.0})
    hidden = []
    for index in range(len(s.plan)):
        found = resolved(s, terrain, index)
        assert found.resolved
        if found.tries == 1:
            assert found.variables["sun_elevation_deg"] == s.plan.variables["sun_elevation_deg"][index]
        if found.sun_visible_fraction == 0:
            hidden.append(index)
    assert len(hidden) >= 4
    frame = pipeline.simulate_frame(spec(s, terrain, hidden[0]))
    assert frame.views == 1
    sample = to_sample(frame)
    assert not sample.scalars["injected"].any()
    assert sample.scalars["resolved"]
    assert not sample.layers["mask"].any()


# ------------------------------------------------------------------------------------------------ lit ground


def lit_fraction(of: SampleSpec, pose: Pose) -> float:
    """Return the estimate of the fraction of the frame that shows sunlit ground."""
    view = pose.position_L_m[None], pose.L_from_C[None], pose.sun_L[None]
    return float(resolve._lit_fraction(of.scene.camera, of.terrain, *view)[0])


def test_the_fraction_of_sunlit_ground_agrees_with_the_renderers_angles(terrain: Terrain) -> None:
    """Against the render: pixels that a noise-free frame shows brighter than ground in shadow, which is black."""
    s = session({"vignetting": {}}, geometry={"min_lit_fraction": 0.05}, plan={"faulty_fraction": 0.0})
    for index in range(4):
        sample_spec = spec(s, terrain, index)
        pose = resolve.resolve(sample_spec)
        rendering = render_view(sample_spec, pose)
        lit = (rendering.light.on_image.array.sum(axis=0) > 0) & (rendering.truth.semantic == 1)
        estimate = lit_fraction(sample_spec, pose)
        assert estimate >= 0.05
        # 576 rays against 7680 pixels of four samples each: a border of shadow through the frame crosses at most
        # 2 · 24 of the grid's cells, each told wrong by half of it
        assert estimate == pytest.approx(lit.mean(), abs=24 / 576 + 0.02)


def test_views_without_lit_ground_are_drawn_again_and_the_strata_may_differ(terrain: Terrain) -> None:
    asked = session(geometry={"min_lit_fraction": 0.3, "sun_facing": {"min_lit_fraction": 0.0}})
    facing, averted = redraw.strata(asked.scene)
    assert (facing.min_lit_fraction, averted.min_lit_fraction) == (0.0, 0.3)
    free = session()
    tries: dict[int, list[int]] = {plan.SUN_FACING: [], plan.SUN_AVERTED: []}
    for index in range(len(asked.plan)):
        stratum = int(asked.plan.stratum[index])
        more, few = (resolved(s, terrain, index).tries for s in (asked, free))
        tries[stratum].append(more - few)
        if stratum == plan.SUN_AVERTED:
            sample_spec = spec(asked, terrain, index)
            assert lit_fraction(sample_spec, resolve.resolve(sample_spec)) >= 0.3
    assert not any(tries[plan.SUN_FACING])
    assert sum(tries[plan.SUN_AVERTED]) > 5


# ------------------------------------------------------------------------------------- faults that cannot show

# one dead line: it shows where the ground is lit, and not on a black sky or a night side
DEAD_LINE = {"broken_lines": {"white_count": 0, "black_count": 1, "count": 1}}
EVERY = {"mode": "per_class", "faulty_fraction": 1.0}
# looking sideways from above: sky and ground alternate from view to view
ASIDE = {
    "x_m": [-20, 20],
    "y_m": [-20, 20],
    "height_m": [300, 400],
    "sun_averted": {
        "reference": "nadir",
        "roll_deg": [-180, 180],
        "pitch_deg": [0, 0],
        "sun_elevation_deg": [40, 60],
    },
}


@pytest.fixture(scope="module")
def redrawn(terrain: Terrain) -> tuple[Session, list[Frame]]:
    s = session(DEAD_LINE, plan=EVERY, geometry=ASIDE)
    return s, [pipeline.simulate_frame(spec(s, terrain, i)) for i in range(8)]


def test_a_commanded_fault_that_cannot_show_gets_another_view(
    redrawn: tuple[Session, list[Frame]], terrain: Terrain
) -> None:
    s, all_frames = redrawn
    views = [frame.views for frame in all_frames]
    assert max(views) > 1  # sky alone is half of all directions
    dropping = session(DEAD_LINE, plan={**EVERY, "on_invisible": "drop"}, geometry=ASIDE)
    for index, frame in enumerate(all_frames):
        sample = to_sample(frame)
        assert sample.scalars["injected"].tolist() == s.plan.injected[index].tolist() == [True]
        assert (sample.scalars["views"], sample.scalars["tries"]) == (frame.views, frame.pose.tries)
        assert frame.views <= frame.pose.tries
        # what is stored is the view that was kept
        kept = s.plan.view(s.scene, index, frame.pose.tries - 1)
        assert {name: sample.scalars["proposal"][name] for name in redraw.VARIABLES} == kept
        angles = [sample.scalars[name] for name in ("roll_deg", "pitch_deg", "yaw_deg")]
        down = np.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(frame.pose.L_from_C, frames.L_from_C(down, *angles), atol=1e-12)
        # a view that is kept at once has the bits of a scene that never asks for another
        if frame.views == 1:
            other = to_sample(pipeline.simulate_frame(spec(dropping, terrain, index)))
            assert np.array_equal(other.layers["image"], sample.layers["image"])
    first = next(i for i, n in enumerate(views) if n > 1)
    dropped = to_sample(pipeline.simulate_frame(spec(dropping, terrain, first)))
    assert not dropped.scalars["injected"].any()
    assert dropped.scalars["views"] == 1
    again = to_sample(pipeline.simulate_frame(spec(s, terrain, first)))
    assert np.array_equal(again.layers["image"], all_frames[first].images.image.array)


def test_the_plans_comparison_knows_the_view_that_was_kept(redrawn: tuple[Session, list[Frame]]) -> None:
    s, all_frames = redrawn
    models = {name: fault.model for name, fault in s.faults.items()}
    attributes = {"scene": {**s.scene.resolved(), "plugins": {}}, "blocks": [len(s.plan)], "fault_models": models}
    expected = dataset.planned(attributes, list(s.faults))
    index = next(i for i, frame in enumerate(all_frames) if frame.views > 1)
    scalars = to_sample(all_frames[index]).scalars
    for name, value in expected(index, scalars["tries"]).items():
        assert np.array_equal(value, scalars[name]), name
    assert expected(index, scalars["tries"] - 1)["proposal"] != scalars["proposal"]


def test_a_fault_that_shows_in_no_view_is_an_error_that_names_it(terrain: Terrain) -> None:
    night = {"sun_averted": {"reference": "nadir", "roll_deg": [180, 180], "sun_elevation_deg": [-80, -60]}}
    s = session(DEAD_LINE, plan={**EVERY, "max_views": 2}, geometry={"height_m": [5e4, 6e4], **night})
    with pytest.raises(VbnfaultError) as caught:
        pipeline.simulate_frame(spec(s, terrain, 1))
    for part in (
        "sample 1: broken_lines",
        "plan.max_views = 2",
        "image is black in ",
        "plan.on_invisible = 'drop'",
    ):
        assert part in str(caught.value)


# ------------------------------------------------------------------------------------- the centre of the body

FROM_AFAR = {
    "height_m": [20e3, 30e3],
    "height_reference": "site",
    "x_m": [-3e3, 3e3],
    "y_m": [-3e3, 3e3],
    "sun_averted": {"reference": "centre", "roll_deg": [0, 0], "pitch_deg": [0, 0], "sun_elevation_deg": [20, 60]},
}


def test_the_boresight_points_at_the_centre_of_mass_through_the_store_and_back(tmp_path: Path) -> None:
    """The packaged nucleus is bilobed, and its centre of mass lies 145 m from the origin of T."""
    table = small_scene(
        dataset={"samples": 2, "sites": 1, "layers": ["clean"]},
        camera={"fov_deg": 20.0, "width_px": 32, "height_px": 32},
        geometry=FROM_AFAR,
    )
    table["faults"] = {"broken_pixels": {}}
    scene = config.parse_scene(table, source="test")
    out = tmp_path / "centre.zarr"
    dataset.build_scene(scene, out, source="test", threads=2)
    data = vbnfault.open_dataset(out)
    attributes = data["roll_deg"].attrs
    assert attributes["reference"] == {"sun-facing": "sun", "sun-averted": "centre"}
    centre_T_m = np.array(attributes["centre_of_mass_T_m"])
    np.testing.assert_allclose(centre_T_m, load_body().centre_of_mass_T_m)
    assert np.linalg.norm(centre_T_m) > 100
    for i in range(2):
        sample = data.isel(sample=i)
        from_T = C_from_T(data, i)
        centre_C_m = from_T @ (centre_T_m - sample["camera_position_T_m"].values)
        # rounding of 30 km in float64 and of the quaternion: some 1e-16 rad each
        assert np.hypot(*centre_C_m[:2]) / centre_C_m[2] < 1e-14
        down_L = sample["T_from_L"].values.T @ from_T.T[:, 2]
        assert np.degrees(np.arccos(down_L[2])) > 1  # the plumb line points elsewhere
        towards = sample["T_from_L"].values.T @ frames.unit(centre_T_m - sample["camera_position_T_m"].values)
        want = frames.L_from_C(towards, 0, 0, float(sample["yaw_deg"]), north_up=True)
        np.testing.assert_allclose(sample["T_from_L"].values.T @ from_T.T, want, atol=1e-9)


def test_roll_and_pitch_tilt_the_boresight_away_from_the_centre(terrain: Terrain) -> None:
    averted = {**FROM_AFAR["sun_averted"], "roll_deg": [3, 3], "pitch_deg": [-4, -4]}
    s = session({"broken_pixels": {}}, geometry={**FROM_AFAR, "sun_averted": averted})
    pose = resolved(s, terrain, 0)
    site = terrain.site
    towards = frames.unit(
        site.T_from_L.T @ (terrain.body.centre_of_mass_T_m - site.position_T_m) - pose.position_L_m
    )
    angle = np.degrees(np.arccos(pose.L_from_C[:, 2] @ towards))
    assert angle == pytest.approx(float(frames.boresight_angle_deg(3, -4)), abs=1e-6)


# ------------------------------------------------------------------------------------------- the paper's pairs


def test_paired_strata_share_site_and_target_attitude(terrain: Terrain) -> None:
    geometry = {"sun_visibility": "as_drawn"}
    s = session(geometry=geometry, plan={"pair_strata": True, "mode": "per_class", "faulty_fraction": 0.5})
    p = s.plan
    assert p.paired.sum() >= 16
    leads = np.flatnonzero(p.light != np.arange(len(p)))
    for follower in leads:
        leader = p.light[follower]
        assert (p.stratum[leader], p.stratum[follower]) == (plan.SUN_FACING, plan.SUN_AVERTED)
        assert p.site[leader] == p.site[follower]
        assert -30 <= p.variables["sun_elevation_deg"][leader] <= 30
        for name in ("sun_azimuth_deg", "sun_elevation_deg"):
            assert p.variables[name][leader] == p.variables[name][follower]
            # whatever is drawn again, the Sun stays
            assert p.view(s.scene, int(follower), 5)[name] == p.variables[name][leader]
        assert p.variables["x_m"][leader] != p.variables["x_m"][follower]
    follower = int(leads[0])
    one, other = (resolved(s, terrain, i) for i in (int(p.light[follower]), follower))
    np.testing.assert_array_equal(one.sun_L, other.sun_L)


def test_paired_strata_need_a_sun_that_stays_and_bounds_that_overlap() -> None:
    with pytest.raises(InputError, match=r"plan\.pair_strata = true: needs .* 'as_drawn'"):
        session(plan={"pair_strata": True})
    apart = {"sun_facing": {"sun_elevation_deg": [-30, -20]}, "sun_averted": {"sun_elevation_deg": [0, 90]}}
    with pytest.raises(InputError, match=r"sun_elevation_deg = .* must overlap"):
        session(plan={"pair_strata": True}, geometry={"sun_visibility": "as_drawn", **apart})


# ------------------------------------------------------------------------------------------------ trajectories


def test_a_flown_pose_is_kept_with_its_sun_hidden_and_refused_within_the_ground(
    terrain: Terrain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses of SPICE are what was flown: straylight without a Sun is not injected, and the sample says so."""
    from vbnfault.core.files import spice
    from vbnfault.world import ephemeris

    s = session({"straylight": {}}, plan=EVERY)
    spice_table = s.scene.spice.model_copy(update={"spacecraft": "X", "kernels": ("k",), "frame": "F"})
    flown = replace(s.plan)
    scene = s.scene.model_copy(update={"spice": spice_table})
    site = terrain.site

    def at(height_m: float, sun_L: list[float], boresight: np.ndarray) -> Pose:
        position = site.position_T_m + site.T_from_L @ np.array([0.0, 0.0, -height_m])
        placed = spice.SpacecraftState(
            camera_position_T_m=position, T_from_C=site.T_from_L @ frames.L_from_C0(boresight)
        )
        sun_T = site.T_from_L @ frames.unit(np.array(sun_L))
        monkeypatch.setattr(ephemeris, "spacecraft_pose", lambda *_: placed)
        monkeypatch.setattr(ephemeris, "ephemeris", lambda *_: (3.0 * sun_T, np.eye(3)))
        return resolve.resolve(SampleSpec(index=0, scene=scene, plan=flown, faults=s.faults, terrain=terrain))

    up, down = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
    seen = at(500.0, [0, 0.1, -1], up)
    assert seen.resolved
    assert seen.tries == 1  # nothing is drawn in its place
    assert not at(500.0, [0, 0.1, -1], down).resolved  # behind the camera
    assert not at(500.0, [0, 0.1, 1], down).resolved  # behind the body
    with pytest.raises(VbnfaultError, match=r"sample 0: .* is within geometry.clearance_m = 0.5 m of the ground"):
        at(float(render.ground_height_m(terrain.surface, np.zeros(1), np.zeros(1), 300.0)[0]) + 0.1, [0, 0, -1], up)


@pytest.mark.parametrize(("fov_deg", "height_over_width"), [(90.0, 1.0), (40.0, 0.5), (65.0, 1.5)])
def test_rays_that_look_for_lit_ground_cover_the_frame(fov_deg: float, height_over_width: float) -> None:
    """Unit directions through the centres of equal cells: their slopes are symmetric, evenly spaced, row by row."""
    table = CameraTable(width_px=200, height_px=round(200 * height_over_width), fov_deg=fov_deg)
    rays = resolve._grid_rays_C(table)
    n = round(np.sqrt(len(rays)))
    assert rays.shape == (n * n, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, rtol=1e-14)
    assert (rays[:, 2] > 0).all()
    slopes = (rays[:, :2] / rays[:, 2:]).reshape(n, n, 2)
    half = np.tan(np.radians(fov_deg / 2))
    cells = half * (2 * np.arange(n) + 1 - n) / n
    np.testing.assert_allclose(slopes[..., 0], np.broadcast_to(cells, (n, n)), atol=1e-12)
    np.testing.assert_allclose(
        slopes[..., 1], np.broadcast_to(height_over_width * cells[:, None], (n, n)), atol=1e-12
    )
