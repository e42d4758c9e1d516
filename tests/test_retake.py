"""Taking a store again: what is kept bit for bit, what a scene may change, and what a kill leaves."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import test_trajectory
from conftest import ALL_FAULTS, small_scene

import vbnfault
from vbnfault import render, store
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.dataset import build
from vbnfault.dataset.identity import plan_numbers, stored_plan
from vbnfault.dataset.retake import _OPTICS, _check_grid, _StoredViews
from vbnfault.dataset.statistics import statistics
from vbnfault.pipeline import retaken
from vbnfault.pipeline.retaken import RetakeSession, StoredView
from vbnfault.pipeline.spec import Pose
from vbnfault.scene import config, plan
from vbnfault.scene.config import Scene
from vbnfault.scene.plan import make_retaken_plan
from vbnfault.store import disk

LAYERS = ["clean", "depth_m", "normal", "semantic", "mask_effect", "without_straylight", "scene_radiance"]
PHYSICAL = {"dust_on_optics": {"model": "defocused"}, "broken_pixels": {"model": "hot_pixels"}}
LENS: dict[str, Any] = {
    "dataset": {"samples": 2, "sites": 1, "shard_samples": 2, "layers": [*LAYERS, "raw"]},
    "camera": {"lens": "tessar_50_f2p8", "detector": "cmv4000", "fov_deg": 40.0},
    "sky": {"stars": "on"},
    "plan": {"faulty_fraction": 1.0, "on_invisible": "drop"},
    "geometry": {"min_lit_fraction": 0.2},
}


def scene_with(faults: dict[str, Any] | None = None, **tables: dict[str, Any]) -> Scene:
    own = {"samples": 8, "sites": 2, "shard_samples": 4, "layers": LAYERS}
    tables["dataset"] = own | tables.get("dataset", {})
    tables["camera"] = {"width_px": 48, "height_px": 40} | tables.get("camera", {})
    table = small_scene(**tables)
    return config.parse_scene({**table, "faults": table["faults"] if faults is None else faults}, source="test")


def samples_of(path: Path) -> list[Any]:
    opened = store.open_store(path)
    return [opened.read_sample(i) for i in range(opened.samples)]


def differing(first: Any, second: Any) -> list[str]:
    """Return the names of the layers and scalars in which two samples differ, NaN being equal to NaN."""

    def same(a: Any, b: Any) -> bool:
        is_text = isinstance(a, str)
        return bool(a == b if is_text else np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind == "f"))

    pairs = ((first.layers, second.layers), (first.scalars, second.scalars))
    return [name for a, b in pairs for name in a if name in b and not same(a[name], b[name])]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of a thin lens with all faults."""
    path = tmp_path_factory.mktemp("source") / "source.zarr"
    vbnfault.build(scene_with(), path, progress=False)
    return path


@pytest.fixture(scope="module")
def through_a_lens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of a lens with a guard band, and of a sky with stars."""
    path = tmp_path_factory.mktemp("lens") / "lens.zarr"
    vbnfault.build(scene_with(PHYSICAL, **LENS), path, progress=False)
    return path


def retake(*given: Any, **more: Any) -> Any:
    """Take a store again as a worker process does, which must not render any radiance."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a radiance is rendered")

    def as_in_a_worker(factory: Any, *rest: Any) -> Any:
        return in_this_process(pickle.loads(pickle.dumps(factory)), *rest)

    in_this_process = build.build
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "build", as_in_a_worker)
        for name in ("radiance", "direct", "direct_by_sample", "direct_in_cells"):
            patch.setattr(render, name, refuse)
        return vbnfault.retake(*given, progress=False, **more)


# --- the same scene --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("of", ["source", "through_a_lens"])
def test_the_same_scene_gives_the_same_bits(of: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    path = request.getfixturevalue(of)
    scene = scene_with() if of == "source" else scene_with(PHYSICAL, **LENS)
    summary = retake(path, scene, tmp_path / "new.zarr")
    assert summary.built == scene.dataset.samples
    assert vbnfault.verify(tmp_path / "new.zarr").problems == []
    before, after = samples_of(path), samples_of(tmp_path / "new.zarr")
    assert [differing(a, b) for a, b in zip(before, after, strict=True)] == [[]] * len(before)
    assert {a.layers.keys() == b.layers.keys() for a, b in zip(before, after, strict=True)} == {True}
    says = store.open_store(tmp_path / "new.zarr").attributes["retake"]
    old = store.open_store(path).attributes
    assert says["samples"] == [[0, len(before) - 1]]
    assert says["repeats"] == 1
    assert says["source"]["scene_hash"] == old["scene_hash"]
    assert says["source"]["versions"] == old["versions"]
    assert len(says["source"]["checksums_sha256"]) == 64


def test_the_radiance_alone_is_enough_for_a_thin_lens_without_stars(tmp_path: Path) -> None:
    layers = ["clean", "radiance"]  # truth is traced anew
    scene = scene_with(dataset={"samples": 4, "sites": 1, "layers": layers})
    vbnfault.build(scene, tmp_path / "old.zarr", progress=False)
    retake(tmp_path / "old.zarr", scene, tmp_path / "new.zarr")
    pairs = zip(samples_of(tmp_path / "old.zarr"), samples_of(tmp_path / "new.zarr"), strict=True)
    assert [differing(a, b) for a, b in pairs] == [[]] * 4


def test_a_radiance_in_float16_is_right_within_its_rounding(tmp_path: Path) -> None:
    """Rounding to 11 binary digits changes a radiance by at most 2^-12 of it, if it is at least 6e-5.

    The metered exposure is a level over a radiance, so it changes by at most 2^-12, too, and each expected signal
    by 2^-11 at most: by 0.125 of 255 DN. So codes differ by 1 DN at most, and on average by no more than 0.125.
    Noise changes by half of that fraction of itself, which is far less.
    """
    tables = {"samples": 4, "sites": 1, "layers": LAYERS}
    exact = scene_with({"vignetting": {}}, dataset=tables)
    half = scene_with({"vignetting": {}}, dataset={**tables, "radiance_dtype": "float16"})
    for name, scene in (("exact", exact), ("half", half)):
        vbnfault.build(scene, tmp_path / f"{name}.zarr", progress=False)
    assert store.open_store(tmp_path / "half.zarr").read("scene_radiance", 0, 1).dtype == np.float16
    retake(tmp_path / "half.zarr", exact, tmp_path / "new.zarr")
    for a, b in zip(samples_of(tmp_path / "exact.zarr"), samples_of(tmp_path / "new.zarr"), strict=True):
        assert b.scalars["exposure_s"] == pytest.approx(a.scalars["exposure_s"], rel=2**-12)
        for name in ("image", "clean"):
            off = np.abs(a.layers[name].astype(int) - b.layers[name])
            assert off.max() <= 1
            assert off.mean() < 0.125


def _of_a_table(folder: Path) -> dict[str, Any]:
    """Return a scene of a sphere with a table of two poses."""
    import trimesh

    test_trajectory.write(folder / "poses.csv", test_trajectory.rows()[:2])
    trimesh.creation.icosphere(subdivisions=4, radius=test_trajectory.RADIUS_M * 1.0008).export(folder / "s.obj")
    own, body = test_trajectory.SMALL, {**test_trajectory.SMALL["body"], "shape": str(folder / "s.obj")}
    return {**own, "body": body, "trajectory": {"file": str(folder / "poses.csv")}}


def _of_a_flight(folder: Path) -> dict[str, Any]:
    """Return a scene of a sphere above which the camera hovers for two frames."""
    hover = {"kind": "hover", "frames": 2, "period_s": 10.0, "height_m": 50.0}
    return {**_of_a_table(folder), "sun": {"distance_au": 2.0}, "trajectory": {"flight": [hover]}}


def _of_spice(folder: Path) -> dict[str, Any]:
    """Return a scene of a spacecraft whose kernels are written to a folder."""
    test_spice = pytest.importorskip("test_spice")
    return dict(test_spice.flown_scene(test_spice.write_kernels(folder)))


def _aimed(folder: Path) -> dict[str, Any]:
    """Return a scene of a sphere whose views aim at its middle and at its limb."""
    table = _of_a_table(folder)
    del table["trajectory"]
    patch = {**table["patch"], "facet_m": 1.0, "radius_m": 5.0}
    return {
        **table,
        "patch": patch,
        "sun": {"distance_au": 2.0},
        "geometry": {"aim": {"nadir": 1, "limb": 1}, "distance_m": [2e3, 9e3]},
    }


@pytest.mark.parametrize("kind", [_of_a_table, _of_a_flight, _of_spice, _aimed])
def test_views_that_are_flown_or_aimed_are_taken_again_by_ranges(kind: Any, tmp_path: Path) -> None:
    """Two commands, each with a shard of one sample, make the bits of the store."""
    table = kind(tmp_path)
    sampling = {"sites": 2, "shard_samples": 1, "layers": LAYERS}
    if "trajectory" not in table:
        sampling["samples"] = 2
    scene = {**table, "dataset": {**table["dataset"], **sampling}, "faults": {"vignetting": {}, "broken_lines": {}}}
    scene["camera"] = {**table["camera"], "width_px": 24, "height_px": 20}
    old, new = tmp_path / "old.zarr", tmp_path / "new.zarr"
    vbnfault.build(config.parse_scene(scene, source="test"), old, progress=False)
    before = samples_of(old)
    assert len(before) == 2
    for k in range(2):
        assert retake(old, config.parse_scene(scene, source="test"), new, shard_range=range(k, k + 1)).built == 1
    assert [differing(a, b) for a, b in zip(before, samples_of(new), strict=True)] == [[], []]
    assert vbnfault.verify(new).problems == []


# --- other scenes ----------------------------------------------------------------------------------------------


def test_other_faults_on_the_same_views(source: Path, tmp_path: Path) -> None:
    faults = {"broken_lines": {"count": 3}, "straylight": {}, "vignetting": {"on_axis_illuminance_dn": [110, 120]}}
    scene = scene_with(faults, plan={"faulty_fraction": 0.75}, dataset={"layers": ["clean", "depth_m"]})
    new = tmp_path / "new.zarr"
    retake(source, scene, new)
    assert vbnfault.verify(new).problems == []
    before, after = samples_of(source), samples_of(new)
    for a, b in zip(before, after, strict=True):
        # the views, their exposure and their noise are the same
        assert set(differing(a, b)) <= {"image", "mask", "mask_any", "injected", "parameters", "proposal"}
    injected = np.array([b.scalars["injected"] for b in after])
    assert injected.any(axis=0).all()
    opened = store.open_store(new)
    commanded = stored_plan(opened.attributes, opened.spec.faults)[1].injected
    assert (injected <= commanded).all()
    assert statistics(new).has_plan
    # and once more, from a store that was taken again, for which it stores the radiance
    kept = scene_with(faults, dataset={"layers": ["clean", "scene_radiance"]})
    retake(source, kept, tmp_path / "kept.zarr")
    retake(tmp_path / "kept.zarr", scene_with(), tmp_path / "again.zarr")
    assert vbnfault.verify(tmp_path / "again.zarr").problems == []
    again = samples_of(tmp_path / "again.zarr")
    assert [differing(a, b) for a, b in zip(before, again, strict=True)] == [[]] * len(before)


def test_several_samples_of_each_stored_view(source: Path, tmp_path: Path) -> None:
    scene = scene_with(
        dataset={"variants_per_view": 2, "layers": ["clean"], "seed": 12}, camera={"exposure_stops": [-1.0, 1.0]}
    )
    new = tmp_path / "new.zarr"
    assert retake(source, scene, new).samples == 16
    assert vbnfault.verify(new).problems == []
    before, after = samples_of(source), samples_of(new)
    for k, sample in enumerate(after):
        view = before[k // 2]
        for name in ("camera_position_T_m", "camera_from_T", "sun_direction_T", "site", "split", "stratum"):
            assert np.array_equal(sample.scalars[name], view.scalars[name]), name
    assert len({sample.layers["clean"].tobytes() for sample in after}) == 16
    assert len({sample.scalars["exposure_s"] for sample in after}) == 16


def test_another_lens_and_another_detector(through_a_lens: Path, tmp_path: Path) -> None:
    """A thin lens sees the stored radiance without its guard band; truth then follows its own pixels."""
    table = {**LENS, "camera": {"fov_deg": 40.0, "exposure_s": 0.01}}
    thin = scene_with({}, **{**table, "dataset": {**LENS["dataset"], "layers": ["depth_m", "radiance"]}})
    retake(through_a_lens, thin, tmp_path / "thin.zarr")
    assert vbnfault.verify(tmp_path / "thin.zarr").problems == []
    opened = store.open_store(through_a_lens)
    (rows, columns), had = opened.spec.rendered_shape, samples_of(through_a_lens)
    y, x = (rows - 40) // 2, (columns - 48) // 2
    assert min(x, y) > 0
    for a, b in zip(had, samples_of(tmp_path / "thin.zarr"), strict=True):
        stored = a.layers["scene_radiance"][:, y : y + 40, x : x + 48]
        added = b.layers["radiance"] - stored
        assert (added >= 0).all()
        # the sky has stars, which spread over the pixels beside it
        assert (added[:, np.isfinite(b.layers["depth_m"])] == 0).mean() > 0.98
        assert not np.array_equal(a.layers["depth_m"], b.layers["depth_m"])
        assert b.scalars["exposure_s"] == 0.01
    # the metered exposure makes up for a smaller stop
    closed = scene_with(PHYSICAL, **{**LENS, "camera": {**LENS["camera"], "f_number": 8.0, "exposure_max_s": 50.0}})
    retake(through_a_lens, closed, tmp_path / "closed.zarr")
    for a, b in zip(had, samples_of(tmp_path / "closed.zarr"), strict=True):
        assert not {"depth_m", "normal", "semantic"} & set(differing(a, b))
        assert 4 < b.scalars["exposure_s"] / a.scalars["exposure_s"] < 12  # (8 / 2.8)² = 8.2


def test_faults_that_need_the_sun_go_to_views_that_face_it() -> None:
    table = {"dataset": {"samples": 64, "sites": 4, "shard_samples": 4}, "plan": {"faulty_fraction": 0.5}}
    first, other = scene_with(**table), scene_with(**{**table, "dataset": {**table["dataset"], "seed": 5}})
    views = plan.make_plan(first, ALL_FAULTS, [32, 32], need_sun=["straylight"])
    earlier = plan.EarlierViews(scene=first, plan=views)
    same = make_retaken_plan(first, ALL_FAULTS, earlier, [32, 32], need_sun=["straylight"])
    assert np.array_equal(same.injected, views.injected)
    assert np.array_equal(same.individual, views.individual)
    own = plan.make_plan(other, ALL_FAULTS, [32, 32], need_sun=["straylight"])
    again = make_retaken_plan(other, ALL_FAULTS, earlier, [32, 32], need_sun=["straylight"])
    assert (again.stratum[again.injects("straylight")] == plan.SUN_FACING).all()
    assert not (views.stratum[own.injects("straylight")] == plan.SUN_FACING).all()
    for block in (slice(0, 32), slice(32, 64)):
        assert np.array_equal(again.injected[block].sum(axis=0), own.injected[block].sum(axis=0))
    assert again.view(other, 7, 3) == views.view(first, 7, 3) != own.view(other, 7, 3)
    twice = make_retaken_plan(
        other, ["adc"], plan.EarlierViews(scene=first, plan=views, repeats=2), [64, 64], need_sun=[]
    )
    assert twice.view(other, 15, 1) == views.view(first, 7, 1)
    all_of_it = scene_with(**{**table, "plan": {"faulty_fraction": 1.0, "classes_per_sample": [6, 6]}})
    with pytest.raises(InputError, match=r"straylight would be in 32 of 32 samples, but only \d+ of the stored"):
        make_retaken_plan(all_of_it, ALL_FAULTS, earlier, [32, 32], need_sun=["straylight"])


# --- kills, workers, half a store ------------------------------------------------------------------------------


class Killed(BaseException):
    """Stands for the end of the process at a file operation; `tools.kills --rendering retake` kills in earnest."""


def test_a_killed_retake_resumes_to_the_same_digest(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_with({"vignetting": {}, "broken_lines": {}}, dataset={"layers": ["clean"]})
    whole = retake(source, scene, tmp_path / "whole.zarr")
    assert whole.digest is not None
    write, left = disk.write, [0]

    def counted(*given: Any, **more: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise Killed
        return write(*given, **more)

    killed = tmp_path / "killed.zarr"
    for operations in (2, 1):  # in the middle of a shard: its files are there, `done` is not
        left[0] = operations
        with monkeypatch.context() as patch:
            patch.setattr(disk, "write", counted)
            with pytest.raises(Killed):
                retake(source, scene, killed)
    resumed = retake(source, scene, killed)
    assert 0 <= resumed.finished < 8
    assert resumed.digest == whole.digest


def test_of_half_a_store_the_finished_samples_are_taken(
    source: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    half = store.open_store(shutil.copytree(source, tmp_path / "half.zarr"), "r+")
    half._write_done(0, {1, 2})
    scene = scene_with()
    new = tmp_path / "new.zarr"
    assert retake(half.path, scene, new).samples == 6
    assert "half.zarr: 6 of 8 samples are taken, those that were finished" in caplog.text
    assert vbnfault.verify(new).problems == []
    assert store.open_store(new).attributes["retake"]["samples"] == [[1, 2], [4, 7]]
    assert plan_numbers(store.open_store(new).attributes).tolist() == [1, 2, 4, 5, 6, 7]
    before, after = samples_of(source), samples_of(new)
    assert [differing(before[k], b) for k, b in zip((1, 2, 4, 5, 6, 7), after, strict=True)] == [[]] * 6
    assert statistics(new).samples == 6
    # once the old store is complete, the new one keeps to its samples
    half._write_done(0, {0, 1, 2, 3})
    assert retake(half.path, scene, new).finished == 6
    assert retake(half.path, scene, new, overwrite=True).built == 8


# --- bad input -------------------------------------------------------------------------------------------------


def test_what_cannot_be_taken_again_is_refused_in_a_sentence(
    source: Path, through_a_lens: Path, tmp_path: Path
) -> None:
    new = tmp_path / "new.zarr"

    def refused(match: str, scene: Scene, path: Path = source, out: Path = new) -> None:
        with pytest.raises(InputError, match=match):
            retake(path, scene, out, source="other")
        assert not new.exists()

    def changed(**tables: dict[str, Any]) -> Scene:
        return scene_with(**tables)

    refused("no such store", scene_with(), tmp_path / "none.zarr")
    refused("is the store itself", scene_with(), out=source)
    kept = r"a retake keeps view, ground, light and render; only faults, lens, detector and exposure may differ"
    for scene, said in (
        (changed(body={"reflectance": 0.1}), rf"other: body\.reflectance is .* in \S*source\.zarr and .*: {kept}"),
        (changed(camera={"width_px": 64}), r"camera\.width_px is 48 in \S*source\.zarr and 64 now"),
        (changed(camera={"fov_deg": 30.0}), r"fov_deg is "),
        (changed(camera={"focus_distance_m": 7.0}), r"camera\.focus_distance_m is "),
        (changed(render={"samples_per_pixel": 16}), r"render\.samples_per_pixel is 4 .* and 16 now"),
        (changed(sun={"julian_date": 2456000.0}), r"sun\.julian_date is "),
        (changed(geometry={"height_m": [0.0, 50.0]}), r"geometry\.height_m"),
        (changed(dataset={"sites": 3}), r"dataset\.sites is 2 .* and 3 now"),
        (changed(sky={"stars": "on"}), r"sky\."),
        (changed(plan={"sun_facing_nominal_fraction": 0.1}), r"plan\.sun_facing_nominal_fraction is 0\.0"),
    ):
        refused(said, scene)
    refused(
        r"camera\.lens = 'tessar_50_f2p8': needs light from \d+ px around the frame, and \S+ has 0 px",
        scene_with({}, camera={"lens": "tessar_50_f2p8"}),
    )
    without = {"layers": ["clean", "depth_m"]}
    for name, stored, said in (
        ("none", without, r'stores no radiance.*dataset\.layers = \["depth_m", "scene_radiance"\]'),
        ("two", {"layers": ["scene_radiance"], "variants_per_view": 2}, r"must be a multiple of 2"),
    ):
        old = tmp_path / f"{name}.zarr"
        vbnfault.build(
            scene_with({}, dataset={"samples": 2, "sites": 1, "shard_samples": 2} | stored), old, progress=False
        )
        refused(
            said,
            scene_with({}, dataset={"samples": 2, "sites": 1, "shard_samples": 3, "variants_per_view": 3}),
            old,
        )
    empty = store.open_store(shutil.copytree(through_a_lens, tmp_path / "empty.zarr"), "r+")
    empty._write_done(0, set())
    refused("no sample is finished yet", scene_with(PHYSICAL, **LENS), empty.path)


def test_a_store_with_radiance_behind_a_lens_or_with_stars_says_which_layer_is_missing(tmp_path: Path) -> None:
    for tables, said in (
        ({"camera": {"lens": "tessar_50_f2p8", "fov_deg": 20.0}}, "on the distorted grid of its lens"),
        ({"sky": {"stars": "auto"}}, "that with stars"),
    ):
        scene = scene_with({}, **{**tables, "dataset": {"samples": 1, "sites": 1, "layers": ["radiance"]}})
        old = tmp_path / f"{len(said)}.zarr"
        vbnfault.build(scene, old, dry_run=True, progress=False)
        store.create(old, vbnfault.dataset.store_spec(vbnfault.Session(scene), (1,)), 1)
        with pytest.raises(InputError, match=rf'its radiance is {said}.*layers = \["scene_radiance"\]'):
            retake(old, scene, tmp_path / "new.zarr")


def test_a_view_that_its_plan_does_not_give_is_refused(source: Path, tmp_path: Path) -> None:
    """As in a store that was planned by other code."""
    scene = scene_with({"vignetting": {}}, dataset={"layers": ["clean"]})
    other = store.open_store(shutil.copytree(source, tmp_path / "other.zarr"), "r+")
    sample = other.read_sample(2)
    turned = np.asarray(sample.scalars["camera_from_T"]) * [1, 1, 1, 1 + 1e-6]
    scalars = {**sample.scalars, "camera_from_T": turned}
    other.write_shard(0, {2: store.encode(other.spec, dataclasses.replace(sample, scalars=scalars))})
    with pytest.raises(VbnfaultError, match=r"sample 2 .*: its stored attitude is not that of its plan"):
        retake(other.path, scene, tmp_path / "new.zarr")


def test_a_retake_that_began_with_other_data_is_not_continued(source: Path, tmp_path: Path) -> None:
    scene = scene_with({"vignetting": {}}, dataset={"layers": ["clean"]})
    new = tmp_path / "new.zarr"
    retake(source, scene, new)
    other = store.open_store(shutil.copytree(source, tmp_path / "other.zarr"), "r+")
    sample = other.read_sample(2)
    layers = {**sample.layers, "scene_radiance": sample.layers["scene_radiance"] * np.float32(2)}
    changed = store.encode(other.spec, type(sample)(index=2, layers=layers, scalars=sample.scalars))
    other.write_shard(0, {2: changed})
    with pytest.raises(InputError, match=r"new\.zarr: holds another dataset: retake\.source\.checksums_sha256 is"):
        retake(other.path, scene, new)


# --- parts: which stored truth and radiance are used, which views count as resolved, which lenses fit -------------


ROWS, COLUMNS = 4, 6


def stored_view(*, same_optics: bool = True, dtype: Any = np.float32, **scalars: Any) -> StoredView:
    """Return a view whose render is 2 px wider and 1 px higher on each side than its image."""
    rng = np.random.default_rng(4)
    truth = {
        "depth_m": np.ones((ROWS, COLUMNS), np.float32),
        "normal": np.zeros((ROWS, COLUMNS, 3), np.float16),
        "semantic": np.ones((ROWS, COLUMNS), np.uint8),
        "albedo": np.ones((ROWS, COLUMNS), np.float32),
        "emission_deg": np.full((ROWS, COLUMNS), 7, np.float32),
    }
    known = {"intrinsics": np.array([9.0, 9, 3, 2]), "distortion": np.zeros(8)}
    radiance = rng.random((2, ROWS + 2, COLUMNS + 4)).astype(dtype)
    return StoredView(scalars=known | scalars, radiance=radiance, truth=truth, same_optics=same_optics)


def spec_of(**changes: Any) -> Any:
    """Return what the functions read of a specification."""
    lens = SimpleNamespace(distortion=np.zeros(8))
    camera = SimpleNamespace(intrinsics=np.array([9.0, 9, 3, 2]), lens=lens)
    layers = changes.pop("layers", ("depth_m",))
    own = {"camera": camera, "scene": SimpleNamespace(dataset=SimpleNamespace(layers=layers))}
    return SimpleNamespace(**own, terrain=SimpleNamespace(surface=None), **changes)


# --- truth ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("layers", "scalars"),
    [
        (("depth_m",), {"intrinsics": np.array([9.0, 9, 3, 2.5])}),
        (("depth_m",), {"distortion": np.full(8, 1e-6)}),
        (("albedo",), {}),  # stored, but it needs the dust and the materials that pixels show
        (("incidence_deg",), {}),
    ],
)
def test_other_pixels_and_other_layers_need_new_truth(layers: tuple[str, ...], scalars: dict[str, Any]) -> None:
    assert retaken._stored_truth(spec_of(layers=layers), stored_view(**scalars)) is None


# --- radiance ---------------------------------------------------------------------------------------------


def _radiance(monkeypatch: pytest.MonkeyPatch, stored: StoredView, *, sees_sun: bool) -> Any:
    """Return the radiance of a view; the Sun, if seen, gives 5 in the pixel (1, 2)."""

    def add(out: Any, *_: Any) -> str:
        out[:, 1, 2] += 5
        return "the disc is seen"

    view = SimpleNamespace(height_px=ROWS, width_px=COLUMNS, pixel_map=None)
    scene = SimpleNamespace(view=view, sun=None, wavelength_nm=(450.0, 550.0))
    monkeypatch.setattr(retaken, "may_see_sun", lambda *_: sees_sun)
    monkeypatch.setattr(render, "sun_in_view", lambda *_: "disc")
    monkeypatch.setattr(retaken, "add_mean", add)
    return retaken._radiance(spec_of(), scene, stored)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("same_optics", "dtype", "exact"),
    [(True, np.float32, True), (False, np.float32, False), (True, np.float16, False)],
)
def test_pixels_of_the_sun_are_exact_or_as_if_the_scene_were_dark(
    monkeypatch: pytest.MonkeyPatch, same_optics: bool, dtype: Any, exact: bool
) -> None:
    """The stored sum is kept if the same aperture saw the Sun; otherwise the Sun stands alone there."""
    stored = stored_view(same_optics=same_optics, dtype=dtype)
    middle = stored.radiance[:, 1:-1, 2:-2].astype(np.float32)
    made = _radiance(monkeypatch, stored, sees_sun=True)
    assert (made.sun[:, 1, 2] == 5).all()
    assert (made.sun.sum(axis=(1, 2)) == 5).all()
    if not exact:
        middle[:, 1, 2] = 5
    assert np.array_equal(made.array, middle)


# --- which views are resolved -----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Spec:
    """A specification of a sample whose faults are given."""

    commanded: tuple[str, ...]
    index: int = 0
    scene: Any = None
    plan: Any = None


@pytest.mark.parametrize("required", [True, False])
@pytest.mark.parametrize("commanded", [("straylight",), ("vignetting",)])
@pytest.mark.parametrize(("visible", "towards"), [(1.0, 1.0), (0.9, 1.0), (1.0, -1.0)])
def test_a_fault_that_needs_the_sun_is_resolved_only_where_it_is_seen(
    monkeypatch: pytest.MonkeyPatch, required: bool, commanded: tuple[str, ...], visible: float, towards: float
) -> None:
    pose = Pose(
        position_L_m=np.zeros(3),
        L_from_C=np.eye(3),
        sun_L=np.array([0.0, 0.0, towards]),
        sun_azimuth_deg=0.0,
        sun_elevation_deg=90.0,
        sun_visible_fraction=visible,
        tries=1,
        variables={},
        resolved=True,
    )
    session = object.__new__(RetakeSession)
    scene = SimpleNamespace(
        geometry=SimpleNamespace(sun_visibility="required" if required else "any"),
        is_flown=False,
        model_copy=lambda update: None,
    )
    faults = {"straylight": SimpleNamespace(needs_sun=True), "vignetting": SimpleNamespace(needs_sun=False)}
    session._scene, session._plan = scene, None  # type: ignore[assignment]
    session._views = SimpleNamespace(repeats=1)  # type: ignore[assignment]
    session._world = SimpleNamespace(faults=faults)  # type: ignore[assignment]
    spec = _Spec(commanded, scene=SimpleNamespace(sun=None))
    monkeypatch.setattr(session, "_view", lambda _: (spec, pose, None, 1))
    monkeypatch.setattr(retaken, "simulate_stored_view", lambda spec, pose, *_: pose)
    seen = visible == 1.0 and towards > 0
    expected = seen or not required or commanded == ("vignetting",)
    assert session.frame(0).resolved == expected  # type: ignore[attr-defined]


# --- which lenses fit -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("focal_length_px", "guard_px", "says"),
    [
        (100.0, (2, 1), ""),
        (100.0 * (1 + 2e-6), (0, 0), "its focal length is 100 px, but the radiance of .* has 100 px"),
        (100.1, (0, 0), "its focal length is 100.1 px"),
        (100.0, (3, 0), "needs light from 3 px around the frame, and .* has 1 px"),
        (100.0, (0, 2), "needs light from 2 px around the frame, and .* has 1 px"),
    ],
)
def test_a_lens_must_have_the_scale_and_the_guard_band_of_the_store(
    focal_length_px: float, guard_px: tuple[int, int], says: str
) -> None:
    shape = SimpleNamespace(rendered_shape=(ROWS + 2, COLUMNS + 4), height=ROWS, width=COLUMNS)
    opened: Any = SimpleNamespace(
        begun=lambda: [0], column=lambda *_: np.array([[100.0, 100, 3, 2]]), spec=shape, path="s.zarr"
    )
    session: Any = SimpleNamespace(
        base_camera=SimpleNamespace(focal_length_px=focal_length_px, lens=SimpleNamespace(guard_px=guard_px)),
        scene=SimpleNamespace(camera=SimpleNamespace(lens="a", focus="infinity")),
    )
    if not says:
        _check_grid(opened, session, "scene")
        return
    with pytest.raises(InputError, match=says):
        _check_grid(opened, session, "scene")


@pytest.mark.parametrize("key", _OPTICS)
def test_any_other_optics_make_another_aperture(finished_store: Any, key: str) -> None:
    opened = store.open_store(finished_store)
    attributes = {**opened.attributes, "scene": {"camera": {"lens": "a", "f_number": 4.0}}}
    stub: Any = SimpleNamespace(spec=opened.spec, attributes={**attributes, "blocks": [opened.samples]})
    before = stub.attributes["scene"]["camera"]
    assert _StoredViews(stub, before)._same_optics
    assert not _StoredViews(stub, {**before, key: "other"})._same_optics
