"""Several samples of one view: what they share, what differs, and that no sample depends on another."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ALL_FAULTS, recorded_calls, small_scene
from poses_kit import columns_of, row
from scipy import stats
from synthetic import flip

import vbnfault
from vbnfault import store
from vbnfault.camera import Camera
from vbnfault.core.errors import InputError
from vbnfault.core.shared_results import SharedResults
from vbnfault.dataset.identity import scene_identity, store_spec
from vbnfault.detector import MosaicDetector
from vbnfault.detector.chain import Device
from vbnfault.pipeline import Session, injection, resolve, stages
from vbnfault.pipeline.exposure import exposure_factor
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.spec import SampleSpec
from vbnfault.scene import config, plan
from vbnfault.scene.config import Scene
from vbnfault.store import codec
from vbnfault.world import assemble

NEED_SUN = ["straylight"]


def scene_with(variants: int, samples: int = 16, **tables: dict[str, Any]) -> Scene:
    table = {"samples": samples, "sites": 2, "shard_samples": 8, "variants_per_view": variants}
    tables["dataset"] = {**table, **tables.get("dataset", {})}
    return config.parse_scene(small_scene(**tables), source="test")


def of_views(values: np.ndarray, variants: int) -> np.ndarray:
    return np.asarray(values).reshape(-1, variants, *np.shape(values)[1:])


# --- the plan ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variants", [2, 8])
@pytest.mark.parametrize("mode", ["per_class", "per_sample"])
@pytest.mark.parametrize(
    "extra",
    [
        {},
        {"plan": {"pair_strata": True}, "geometry": {"sun_visibility": "as_drawn"}},
        {"geometry": {"aim": {"sun": 1, "limb": 2}}},
    ],
)
def test_samples_of_a_view_share_it_and_differ_in_faults(variants: int, mode: str, extra: dict[str, Any]) -> None:
    tables = {**extra, "plan": {**extra.get("plan", {}), "mode": mode, "faulty_fraction": 0.4}}
    scene = scene_with(variants, 320, **tables)
    table = plan.make_plan(scene, ALL_FAULTS, [160, 160], need_sun=NEED_SUN)
    for shared in (table.stratum, table.site, table.split, table.paired, table.light, *table.variables.values()):
        per_view = of_views(shared, variants)
        assert (per_view == per_view[:, :1]).all()
    for index in (1, variants - 1, 160 + variants + 1):
        first = index - index % variants
        for attempt in (0, 1, 5):
            assert table.view(scene, index, attempt) == table.view(scene, first, attempt)
    assert len({list(table.view(scene, k, 1).values())[-1] for k in range(0, 320, variants)}) == 320 // variants
    # what a sample with straylight needs holds for its whole view
    assert (table.stratum[table.injects("straylight")] == plan.SUN_FACING).all()
    # counts of the matrix are those of the plan without shared views
    alone = plan.make_plan(scene_with(1, 320, **tables), ALL_FAULTS, [160, 160], need_sun=NEED_SUN)
    assert np.array_equal(table.injected.sum(axis=0), alone.injected.sum(axis=0))
    # no more than one further view faces the Sun than the samples with straylight fill
    if "aim" not in extra.get("geometry", {}):
        facing = [int((one.stratum[:160] == plan.SUN_FACING).sum()) for one in (table, alone)]
        assert 0 <= facing[0] - facing[1] < variants
    distinct = [len(np.unique(rows, axis=0)) for rows in of_views(table.injected, variants)]
    # 40 % of the samples have faults: of 8 samples dealt at random, about 4 differ
    assert np.mean(distinct) > (1.2 if variants == 2 else 3)


def test_the_number_of_samples_must_be_a_multiple() -> None:
    scene = scene_with(4)
    with pytest.raises(
        InputError, match=r"variants_per_view = 4: 6 samples are planned.* multiple of 4, such as 4"
    ):
        plan.make_plan(scene, ALL_FAULTS, [8, 6])
    with pytest.raises(InputError, match=r"variants_per_view = 3, shard_samples = 8.*must be a multiple"):
        scene_with(3)


def test_a_scene_without_variants_keeps_its_identity() -> None:
    """Stores of earlier versions must open and continue."""
    identity = scene_identity(Session(scene_with(1)))
    assert "variants_per_view" not in identity["dataset"]
    assert "exposure_stops" not in identity["camera"]
    scene = scene_with(2, camera={"exposure_stops": [-1, 1]})
    identity = scene_identity(Session(scene))
    assert identity["dataset"]["variants_per_view"] == 2
    assert identity["camera"]["exposure_stops"] == [-1, 1]


# --- samples ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(scene_with(4, camera={"exposure_stops": [-1.0, 1.0]}))


def test_a_view_is_rendered_once_and_no_sample_depends_on_another(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = recorded_calls(monkeypatch, stages, "render_view")
    made = [session.frame(i) for i in range(8)]
    views = [frame.views for frame in made]
    # one render each for views 0 and 4, and one for every further view that some sample needs
    assert {spec.index for spec, _ in rendered} == {0, 4}
    assert len(rendered) == max(views[:4]) + max(views[4:])
    for first in (0, 4):
        same = [frame for frame in made[first : first + 4] if frame.views == 1]
        assert len(same) > 1
        for frame in same[1:]:
            assert np.array_equal(frame.pose.position_L_m, same[0].pose.position_L_m)
            assert frame.rendering.light.rendered.array is same[0].rendering.light.rendered.array
            assert not np.array_equal(frame.images.image.array, same[0].images.image.array)
            # the clean twins differ by noise and exposure
            assert not np.array_equal(frame.images.clean.array, same[0].images.clean.array)
    # in any order, in sessions of their own, across a change of the view
    rendered.clear()
    again = [session.frame(i) for i in (6, 3, 5)]
    for frame, k in zip(again, (6, 3, 5), strict=True):
        assert np.array_equal(frame.images.image.array, made[k].images.image.array)
        assert np.array_equal(frame.labels.masks, made[k].labels.masks)
        assert frame.drawn == made[k].drawn
    assert {spec.index for spec, _ in rendered} == {0, 4}


def test_a_fault_that_needs_light_is_not_drawn_in_a_dark_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """A view in whose place another one is needed in any case costs no draw, and the sample keeps its bits."""
    faults: dict[str, Any] = {"dust_on_optics": {}, "broken_pixels": {}, "optics_degradation": {}}
    scene = small_scene(
        dataset={"samples": 4, "sites": 1, "variants_per_view": 4, "shard_samples": 4},
        plan={"faulty_fraction": 1.0},
    )
    scene["faults"] = faults
    rendered: list[int] = []
    render_view = stages.render_view

    def dark_at_first(spec: Any, pose: Any) -> Any:
        rendering = render_view(spec, pose)
        rendered.append(spec.index)
        light = rendering.light
        if len(rendered) > 1:
            return rendering
        dark = light.rendered.with_array(np.zeros_like(light.rendered.array))
        return dataclasses.replace(rendering, light=dataclasses.replace(light, rendered=dark))

    monkeypatch.setattr(stages, "render_view", dark_at_first)
    drawn = recorded_calls(monkeypatch, injection, "draw_faults")

    def made() -> Any:
        rendered.clear()
        own = Session(config.parse_scene(scene, source="test"))
        optical = {"dust_on_optics", "optics_degradation"}
        index = next(i for i in range(4) if optical & set(own.plan.commanded(i)))
        return own.frame(index)

    quick = made()
    assert (quick.views, len(rendered)) == (2, 2)
    assert min(attempt for *_, attempt in drawn) >= injection._DRAW_TRIES, "no draw belongs to the first view"
    drawn.clear()
    monkeypatch.setattr(injection, "_in_vain", lambda *of: [])
    slow = made()
    assert sorted(attempt for *_, attempt in drawn)[: injection._DRAW_TRIES] == list(range(injection._DRAW_TRIES))
    assert slow.drawn == quick.drawn
    assert np.array_equal(slow.images.image.array, quick.images.image.array)
    # where no other view is tried, the fault is left out and the others are drawn as ever
    monkeypatch.undo()
    spec, development = quick.spec, quick.injection.development
    dark = dataclasses.replace(
        development.exposure,
        rate=development.exposure.rate.with_array(np.zeros_like(quick.images.clean.array[..., :3], np.float32)),
    )
    left = injection.inject_faults(spec, quick.pose, quick.rendering, dark)
    assert set(left.draws) == set(spec.commanded) - {"dust_on_optics", "optics_degradation"}


def test_shared_views_of_faults_that_need_light_are_not_dark(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the samples of a dark view would have another view rendered."""
    faults: dict[str, Any] = {"dust_on_optics": {}, "straylight": {}}
    table = small_scene(
        dataset={"samples": 96, "sites": 1, "variants_per_view": 4, "shard_samples": 4},
        plan={"faulty_fraction": 1.0},
    )
    table["faults"] = faults
    own = Session(config.parse_scene(table, source="test"))

    def lit() -> list[float]:
        """Sunlit fraction of each view's frame, and 1 more where the Sun is in it."""
        specs = [own.spec(k) for k in range(0, 96, 4)]
        poses = [(spec, resolve.resolve(spec)) for spec in specs if "dust_on_optics" in spec.commanded_in_view]
        camera = own.scene.camera
        half_deg = 0.5 * camera.fov_deg * camera.height_px / camera.width_px
        light = []
        for spec, pose in poses:
            axes, sun_L = pose.L_from_C, pose.sun_L
            fraction = resolve._lit_fraction(
                camera, spec.terrain, pose.position_L_m[None], axes[None], sun_L[None]
            )[0]
            light.append(float(fraction) + float(axes[:, 2] @ sun_L > np.cos(np.radians(half_deg))))
        return light

    assert min(lit()) > 0
    monkeypatch.setattr(resolve, "_faults_needing_light", lambda spec: [])
    assert lit().count(0.0) > 0, "no view of this plan is dark, so the test says nothing"
    monkeypatch.undo()
    # a body that may lie between the rays of the grid is left to the render
    far = own.spec(next(k for k in range(0, 96, 4) if "dust_on_optics" in own.spec(k).commanded_in_view))
    views = dataclasses.replace(resolve._Views.of(far, 0), sun_visible=np.zeros(8))
    away = dataclasses.replace(views, position_L_m=views.position_L_m - [0.0, 0.0, 1e7])
    assert not resolve._may_have_light(far, views).any()
    assert resolve._may_have_light(far, away).all()
    # where such a fault is left out instead, and where a sample has a view of its own, views are as they were
    dropping = {**table, "plan": {**table["plan"], "on_invisible": "drop"}}
    left_out = Session(config.parse_scene(dropping, source="test"))
    assert [resolve._faults_needing_light(left_out.spec(k)) for k in range(8)] == [[]] * 8
    single = small_scene(dataset={"samples": 4, "sites": 1}, plan={"faulty_fraction": 1.0})
    single["faults"] = faults
    alone = Session(config.parse_scene(single, source="test"))
    assert [resolve._faults_needing_light(alone.spec(k)) for k in range(4)] == [[]] * 4


def test_exposures_follow_their_stops(session: Session) -> None:
    scene = scene_with(4, camera={"exposure_stops": [-1.0, 1.0], "exposure_s": 0.02}, dataset={"samples": 400})

    own = Session(scene)
    terrain = session.terrain(0)
    stops = np.log2(
        [
            exposure_factor(SampleSpec(index=k, scene=scene, plan=own.plan, faults=own.faults, terrain=terrain))
            for k in range(400)
        ]
    )
    assert stats.kstest(stops, "uniform", args=(-1, 2)).pvalue > 1e-3
    exposure_s = session.frame(1).camera.exposure_s
    nominal_s = Session(scene_with(4)).frame(1).camera.exposure_s
    assert exposure_s != nominal_s
    assert 0.5 <= exposure_s / nominal_s <= 2


# --- the store --------------------------------------------------------------------------------------------------


def test_a_dataset_of_variants_through_the_store_and_back(tmp_path: Path) -> None:
    layers = ["clean", "depth_m", "normal", "radiance"]
    scene = scene_with(4, 8, dataset={"layers": layers, "shard_samples": 4}, plan={"faulty_fraction": 1.0})
    path = tmp_path / "one.zarr"
    one = vbnfault.build(scene, path, progress=False)
    assert store.examine(path).problems == []
    data = vbnfault.open_dataset(path)
    first = (data["views"].values == 1).reshape(2, 4)
    assert (first.sum(axis=1) > 1).all()
    for name in ("depth_m", "radiance", "camera_position_T_m", "camera_from_T", "sun_direction_T"):
        for view, members in zip(of_views(data[name].values, 4), first, strict=True):
            assert np.array_equal(
                view[members], np.broadcast_to(view[members][0], view[members].shape), equal_nan=True
            )
    # the file of a shard, here of one view, holds once what its samples share
    opened = store.open_store(path)
    for name in ("depth_m", "radiance", "image"):
        chunks = list(opened.chunk(name, 0).values())
        assert name == "image" or len({*chunks}) <= 4 - first[0].sum() + 1
        size = (path / opened.file_name(name, 0)).stat().st_size
        assert size == sum(map(len, {*chunks})) + codec.index_size(4)
    images = of_views(data["image"].values, 4)
    for view in images:
        assert len({image.tobytes() for image in view}) == 4
    splits = of_views(data["split"].values, 4)
    assert (splits == splits[:, :1]).all()
    # a stored sample is what its scene gives alone
    alone = Session(scene).simulate(6)
    assert np.array_equal(alone.layers["image"], data["image"].values[6])
    assert np.array_equal(alone.layers["mask"], data["mask"].values[6])
    # one damaged sample in the middle of a view is made again with the same bits
    (damaged,) = path.glob("image/c/0/*/*/*")
    flip(damaged, damaged.stat().st_size // 2)
    again = vbnfault.build(scene, path, progress=False)
    assert 0 < again.built < 4
    assert again.digest == one.digest is not None
    # an appended block has whole views, too
    vbnfault.build(scene, path, progress=False, append=4)
    assert store.examine(path).problems == []
    with pytest.raises(InputError, match="multiple of 4"):
        vbnfault.build(scene, path, progress=False, append=3)


def test_damage_to_a_shared_chunk_concerns_all_that_share_it(tmp_path: Path) -> None:
    scene = scene_with(4, 8, dataset={"shard_samples": 8, "layers": ["depth_m"]}, plan={"faulty_fraction": 1.0})
    path = tmp_path / "one.zarr"
    before = vbnfault.build(scene, path, progress=False).digest
    opened = store.open_store(path)
    chunks = opened.chunk("depth_m", 0)
    assert opened.chunk("depth_m", 0, [1, 3]) == {k: chunks[k] for k in (1, 3)}
    file = path / opened.file_name("depth_m", 0)
    ranges = codec.chunk_ranges(file.read_bytes()[-codec.index_size(8) :], 8)
    sharing = [k for k, (start, _) in ranges.items() if start == ranges[0][0]]
    assert 1 < len(sharing) < 8
    assert sharing == [k for k, chunk in chunks.items() if chunk == chunks[0]]
    flip(file, ranges[0][0] + 40)
    assert store.problem_samples(path) == sharing
    again = vbnfault.build(scene, path, progress=False)
    assert (again.built, again.digest) == (len(sharing), before)
    assert store.examine(path).problems == []
    assert opened.chunk("depth_m", 0) == chunks


def test_rows_of_a_table_of_poses_are_seen_several_times() -> None:
    scene = config.load_scene("navcam67p", {"dataset.variants_per_view": 2, "dataset.shard_samples": 8})
    rows = [row(name, (camera_x_T_m, 0, 0), (1.0, 0, 0)) for name, camera_x_T_m in (("a", 60e3), ("b", 80e3))]
    session = Session(scene, poses=columns_of(rows))
    assert session.trajectory is not None
    assert session.trajectory.name == ("a/0", "a/1", "b/0", "b/1")
    assert len(session.plan) == 4
    assert [session.trajectory.pose(k).camera_position_T_m[0] for k in range(4)] == [60e3, 60e3, 80e3, 80e3]
    assert [session.plan.first_of_view(k) for k in range(4)] == [0, 0, 2, 2]


def test_what_the_samples_of_a_view_share_is_computed_and_compressed_once(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    exposed = recorded_calls(monkeypatch, Camera, "expose")
    samples = [to_sample(frame) for frame in map(session.frame, range(8, 12)) if frame.views == 1]
    assert len(samples) > 1
    assert len(exposed) <= 2  # one for each view that was rendered
    compressed: list[int] = []
    pack = codec._pack
    monkeypatch.setattr(codec, "_pack", lambda array, name: compressed.append(id(array)) or pack(array, name))
    spec, shared = store_spec(session, (16,)), codec.SharedChunks()
    together = [codec.encode(spec, sample, shared) for sample in samples]
    truth = {id(samples[0].layers[name]) for name in ("depth_m", "normal", "semantic")}
    assert [compressed.count(key) for key in truth] == [1, 1, 1]
    # a layer that differs is not taken for another one; whoever asks alone gets the same bytes
    alone = [codec.encode(spec, sample) for sample in samples]
    assert [one.digest for one in together] == [one.digest for one in alone]
    assert [one.chunks for one in together] == [one.chunks for one in alone]
    assert len({one.chunks["image"] for one in together}) == len(samples)
    # nothing is kept for an array that is gone, or that may still change
    own = np.zeros((80, 96), np.float32)
    shared.packed({"own": (own, "zstd 1")})
    assert not any(key == id(own) for key, _ in shared._known)
    held = len(shared._known)
    del samples
    session._shared_views._kept.clear()
    assert len(shared._known) < held


def test_shared_results_are_the_last_of_their_name() -> None:
    made: list[int] = []

    def make() -> int:
        made.append(len(made))
        return made[-1]

    shared = SharedResults(kept=True)
    assert [shared.once("a", 1, make), shared.once("a", 1, make), shared.once("b", 1, make)] == [0, 0, 1]
    assert [shared.once("a", 2, make), shared.once("a", 1, make), shared.once("b", 1, make)] == [2, 3, 1]
    assert [SharedResults().once("a", 1, make) for _ in range(2)] == [4, 5]


def test_stars_and_raw_numbers_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = small_scene(
        dataset={"samples": 4, "sites": 1, "variants_per_view": 4, "shard_samples": 4, "layers": ["clean", "raw"]},
        camera={"detector": "cmv4000"},
        sky={"stars": "on"},
        plan={"faulty_fraction": 0.0},
    )
    starred = recorded_calls(monkeypatch, assemble, "visible_stars")
    developed = [recorded_calls(monkeypatch, *of) for of in ((MosaicDetector, "collected_e"), (Device, "read"))]
    own = Session(config.parse_scene(scene, source="test"))
    frames = [own.frame(k) for k in range(4)]
    assert len(starred) == frames[0].views == 1
    assert [len(calls) for calls in developed] == [4, 4]  # the raw numbers of an image are those that are stored
    assert all(frame.images.raw is not None for frame in frames)
    assert len({frame.images.raw.tobytes() for frame in frames}) == 4
    rates = [frame.exposure.rate.array for frame in frames]
    alone = Session(config.parse_scene(scene, source="test")).frame(3)
    np.testing.assert_array_equal(rates[3], alone.exposure.rate.array)
    np.testing.assert_array_equal(frames[3].images.raw, alone.images.raw)
    # samples without faults have one array of empty masks, which is then compressed once
    assert len({id(to_sample(frame).layers["mask"]) for frame in frames}) == 1
