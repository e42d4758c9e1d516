"""Optical flow and tracks of sequences, against reprojection by OpenCV, a sphere's limb, and the images."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from poses_kit import C_from_T, columns_of, projected, row
from scipy.spatial.transform import Rotation
from test_calibrated_camera import TABLES
from test_trajectory import SMALL

import vbnfault
from vbnfault import store
from vbnfault.core.errors import InputError
from vbnfault.output.export import export_store
from vbnfault.scene import config

F64 = NDArray[np.float64]

SKY, BODY, VEHICLE = (store.SEMANTIC.index(name) for name in ("sky", "body", "spacecraft"))
RADIUS_M = 1000.0
WIDTH, HEIGHT = 96, 80
CAMERAS: dict[str, dict[str, Any]] = {
    "thin": {"fov_deg": 50.0},
    "lens": {"lens": "nikkor_28_f2p8", "detector": "cmv4000", "fov_deg": 65.0},
    "opencv": {"calibration": TABLES["opencv"]},
    "fisheye": {"calibration": TABLES["fisheye"]},
}
FRAMES = (3, 2)


def scene_of(**tables: Any) -> config.Scene:
    """Return a scene of a ball with relief, whose samples store the flow; `tables` are merged into it."""
    table: dict[str, Any] = {
        "title": "flow",
        "body": {**SMALL["body"], "shape": "ellipsoid", "semi_axes_m": [RADIUS_M] * 3},
        "camera": {"width_px": WIDTH, "height_px": HEIGHT, "exposure_s": 0.01},
        "patch": {"facet_m": 10.0, "radius_m": 40.0, "boulders": False, "max_triangles": 100_000},
        "dataset": {"shard_samples": 2, "layers": ["clean", "depth_m", "semantic", "point_T_m", "flow"]},
        "render": {"bands": 2, "samples_per_pixel": 4},
        "sky": {"stars": "off"},
        "faults": {"broken_pixels": {}},
    }
    for name, values in tables.items():
        table[name] = {**table.get(name, {}), **values}
    return config.parse_scene(table, source="test")


def poses(distance_m: float, step_deg: float) -> dict[str, list[Any]]:
    """Return five frames in two sequences, in which the camera goes around the ball and nearer, a minute apart."""
    table, dates = [], []
    for k in range(sum(FRAMES)):
        turn = Rotation.from_euler("yz", [step_deg * k, 0.6 * step_deg * k], degrees=True).as_matrix()
        table.append(row(f"{k}", turn @ [0.0, 0.1, distance_m * 0.98**k], (0.6, 0.0, 0.8)))
        dates.append(2457000.5 + k / 1440)
    times = [60.0 * k for n in FRAMES for k in range(n)]
    return {**columns_of(table), "julian_date": dates, "sequence": [*"aaabb"], "time_s": times}


def centres() -> F64:
    """Return the pixel centres, float64[y, x, 2]."""
    return np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)


@pytest.fixture(scope="module", params=CAMERAS)
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, config.Scene]:
    """A verified store of each camera, and its scene, with the spacecraft in the frame."""
    import pyarrow
    import pyarrow.parquet

    folder = tmp_path_factory.mktemp(request.param)
    pyarrow.parquet.write_table(
        pyarrow.table(poses(1700.0 if request.param == "fisheye" else 2800.0, 14.0)), folder / "poses.parquet"
    )
    scene = scene_of(
        camera=CAMERAS[request.param],
        trajectory={"file": str(folder / "poses.parquet")},
        spacecraft={"model": "default"},
        patch={"relief": 2.0},
    )
    assert vbnfault.build(scene, folder / "s.zarr", progress=False, workers=1).built == sum(FRAMES)
    assert vbnfault.verify(folder / "s.zarr").problems == []
    return folder / "s.zarr", scene


def test_flow_is_the_reprojection_of_stored_points(built: tuple[Path, config.Scene]) -> None:
    """At most 0.05 px from OpenCV's; it ends where the next frame's depth says that something hides the ground.

    Depth is compared with the nearest and the farthest of 3 × 3 pixels; what lies between may be either.
    """
    data = vbnfault.open_dataset(built[0])
    shown = sky = 0
    for k in range(sum(FRAMES)):
        flow, semantic = data["flow"][k].values, data["semantic"][k].values
        assert flow.dtype == np.float32
        assert (np.isnan(flow[..., 0]) == np.isnan(flow[..., 1])).all()
        if k in (2, 4):
            assert np.isnan(flow).all()
            continue
        assert np.isnan(flow[semantic == VEHICLE]).all()
        body, seen = semantic == BODY, np.isfinite(flow[..., 0])
        in_C = (data["point_T_m"][k].values - data["camera_position_T_m"][k + 1].values) @ C_from_T(data, k + 1).T
        after = projected(data, k + 1, in_C[body & seen])
        off = np.hypot(*(after - (centres() + flow)[body & seen]).T)
        assert off.max() <= 0.05
        moved = np.hypot(*flow[body & seen].T)
        assert np.median(moved) > 1  # px, or the test would say nothing
        depth = np.nan_to_num(data["depth_m"][k + 1].values, posinf=1e9)
        low, high = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
        ahead = body & (in_C[..., 2] > 0.2 * np.linalg.norm(in_C, axis=-1))
        at = np.full((HEIGHT, WIDTH, 2), -99.0)
        at[ahead] = projected(data, k + 1, in_C[ahead])
        inside = (at > 0.1).all(axis=-1) & (at < np.array([WIDTH, HEIGHT]) - 0.1).all(axis=-1)
        outside = ahead & ((at < -0.1) | (at > np.array([WIDTH, HEIGHT]) + 0.1)).any(axis=-1)
        assert np.isnan(flow[outside]).all()
        x, y = np.clip(np.floor(at), 0, (WIDTH - 1, HEIGHT - 1)).astype(int)[inside].T
        depth_there, z = (low[y, x], high[y, x]), in_C[inside][:, 2]
        before = (z <= depth_there[1]) & (depth_there[1] < 1.03 * depth_there[0])
        assert seen[inside][before].mean() > 0.999
        behind = z > 1.02 * depth_there[1]
        assert not seen[inside][behind].any()
        shown += int(before.sum())
        # the sky turns with J, which the store has of each frame
        J = data["T_from_J"].values
        later = C_from_T(data, k + 1) @ J[k + 1] @ J[k].T @ C_from_T(data, k).T
        stars = np.random.default_rng(k).normal([0, 0, 1], size=(20_000, 3))
        stars /= np.linalg.norm(stars, axis=1, keepdims=True)
        # farther off the boresight, the models of OpenCV fold back
        least_z = np.cos(np.radians(min(data["distortion"].attrs["valid_to_deg"], 85)))
        stars = stars[(stars[:, 2] > least_z) & ((stars @ later.T)[:, 2] > least_z)]
        stars = stars[np.abs(projected(data, k, stars) - [WIDTH / 2, HEIGHT / 2]).max(axis=1) < WIDTH / 2]
        at = projected(data, k, stars)
        of_sky = np.where((semantic == SKY)[..., None], flow, np.nan)
        # between pixels, the flow bends by some px / f², 80² or more: 1e-3 px of the mean of neighbours
        x, y = ((at[:, k : k + 1] - 0.5).astype(np.float32) for k in (0, 1))
        moved = cv2.remap(of_sky, x, y, cv2.INTER_LINEAR, borderValue=(np.nan,) * 2)
        off = np.hypot(*(projected(data, k + 1, stars @ later.T) - at - moved[:, 0]).T)
        off = off[np.isfinite(off)]
        assert (off <= 0.05).all()
        sky += len(off)
    assert shown > 500
    assert sky > 50


@pytest.mark.parametrize("built", ["lens"], indirect=True)
def test_a_sample_alone_has_the_same_flow(built: tuple[Path, config.Scene]) -> None:
    data, session = vbnfault.open_dataset(built[0]), vbnfault.Session(built[1])
    for k in (4, 1):
        np.testing.assert_array_equal(session.simulate(k).layers["flow"], data["flow"][k].values)


def test_the_next_image_warped_back_is_the_present_one() -> None:
    """Shaded relief correlates when the flow carries it along, and not when it is left in place."""
    ground = {"relief": 2.0, "facet_m": 3.0, "max_triangles": 300_000}
    scene = scene_of(camera={"fov_deg": 20.0}, patch=ground, render={"samples_per_pixel": 16})
    session = vbnfault.Session(scene, poses=poses(2500.0, 3.0))
    first, second = (session.simulate(k).layers for k in range(2))
    # without what is smooth, which is alike in both images
    now, after = (cv2.Laplacian(np.float32(one["clean"][..., 3]), -1, ksize=5) for one in (first, second))
    at = (centres() + first["flow"] - 0.5).astype(np.float32)  # remap counts from the first centre
    warped = cv2.remap(after, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    kept = np.isfinite(warped)
    kept[[0, 1, 2, -3, -2, -1]] = kept[:, [0, 1, 2, -3, -2, -1]] = False
    carried, left = (np.corrcoef(now[kept], image[kept])[0, 1] for image in (warped, after))
    assert kept.sum() > 2000
    assert carried > 0.9
    assert abs(left) < 0.1


def test_tracks_follow_the_flow(built: tuple[Path, config.Scene]) -> None:
    """From frame 0 on, and back from frame 1; tracks use OpenCV's model as stored, within 0.02 px of the rays."""
    data = vbnfault.open_dataset(built[0])
    flow, body = data["flow"][0].values, data["semantic"][0].values == BODY
    xy = centres()[body]
    found = vbnfault.navigation.tracks(data, "a", xy)
    assert found.xy_px.shape == (3, len(xy), 2)
    assert found.visible.shape == (3, len(xy))
    np.testing.assert_allclose(found.xy_px[0], xy, atol=0.02)
    seen = np.isfinite(flow[body][:, 0])
    np.testing.assert_allclose(found.xy_px[1][seen], (xy + flow[body])[seen], atol=0.05)
    assert (found.visible[1] == seen).mean() > 0.95  # but for a pixel along the limb
    assert found.visible[0].mean() > 0.98
    again = vbnfault.navigation.tracks(data.drop_vars("depth_m"), "a", xy)  # the depth of point_T_m
    np.testing.assert_allclose(again.xy_px[1][seen], found.xy_px[1][seen], atol=1e-3)
    other = vbnfault.navigation.tracks(data, "a", [[0.5, 0.5], *found.xy_px[1][:1]], frame=1)
    assert other.xy_px.shape == (3, 2, 2)
    sky = centres()[data["semantic"][0].values != BODY]
    none = vbnfault.navigation.tracks(data, "a", sky)
    assert np.isnan(none.xy_px).all()
    assert not none.visible.any()


def test_the_ground_is_hidden_behind_the_limb_of_a_ball() -> None:
    """A point P of a sphere faces the camera c where P · (c - P) > 0.

    Facets of 10 m leave the sphere by 10² / 8 / 1000 = 13 mm, and turn by up to 0.3 deg: cosines beyond 0.02 are
    sure. The float32 of a pixel is far below.
    """
    table = columns_of([row(f"{k}", Rotation.from_rotvec([0, 0.4 * k, 0]).apply([0, 0, 4e3])) for k in range(2)])
    scene = scene_of(camera={"fov_deg": 36.0}, patch={"relief": 0.0, "max_triangles": 400_000})
    session = vbnfault.Session(scene, poses={**table, "time_s": [0.0, 1.0]})
    first, second = (session.simulate(k) for k in range(2))
    body, points_T_m = first.layers["semantic"] == BODY, first.layers["point_T_m"]
    camera_T_m = second.scalars["camera_position_T_m"]
    towards = camera_T_m - points_T_m[body]
    cosine = (towards * points_T_m[body]).sum(axis=1) / np.linalg.norm(towards, axis=1) / RADIUS_M
    seen = np.isfinite(first.layers["flow"][body][:, 0])
    assert seen[cosine > 0.02].all()
    assert not seen[cosine < -0.02].any()
    assert (cosine < -0.02).sum() > 100
    assert np.isfinite(first.layers["flow"][first.layers["semantic"] == SKY]).any()
    rows = {0: first, 1: second}
    data = as_dataset(rows)
    found = vbnfault.navigation.tracks(data, "0", centres()[body])
    assert found.visible[1][cosine > 0.02].all()
    # one pixel, of 3 km / 148, along the limb, whose ground is foreshortened by up to √(2 · 20 m / R) = 0.2
    assert not found.visible[1][cosine < -0.25].any()


def test_retaken_frames_have_the_same_flow(tmp_path: Path) -> None:
    """A loop knows no next frame, and has none."""
    given = poses(2500.0, 3.0)
    lines = [",".join(given), *(",".join(map(str, values)) for values in zip(*given.values(), strict=True))]
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    scene = scene_of(
        trajectory={"file": str(tmp_path / "poses.csv")},
        dataset={"samples": 2, "layers": ["clean", "depth_m", "normal", "semantic", "scene_radiance", "flow"]},
    )
    vbnfault.build(scene, tmp_path / "s.zarr", progress=False)  # frame 2 is in the table only
    other = config.parse_scene({**scene.resolved(), "faults": {"vignetting": {}}}, source="test")
    vbnfault.retake(tmp_path / "s.zarr", other, tmp_path / "again.zarr", progress=False)
    flows = [vbnfault.open_dataset(tmp_path / name)["flow"].values for name in ("s.zarr", "again.zarr")]
    np.testing.assert_array_equal(*flows)
    assert np.isfinite(flows[0][1]).mean() > 0.5
    taken = vbnfault.Session(scene).take({name: values[0] for name, values in given.items()})
    assert np.isnan(taken.layers["flow"]).all()


def as_dataset(samples: dict[int, Any]) -> Any:
    """Return samples of one sequence as a store would give them."""
    import xarray

    names = ("intrinsics", "distortion", "camera_from_T", "camera_position_T_m", "frame", "sequence")
    out = {n: xarray.DataArray(np.array([s.scalars[n] for s in samples.values()])) for n in names}
    out["done"] = xarray.DataArray(np.ones(len(samples)))
    out["sequence"].attrs["names"] = ["0"]
    depth = np.array([s.layers["depth_m"] for s in samples.values()])
    return {**out, "depth_m": xarray.DataArray(depth)}


def test_a_trainer_and_openexr_get_the_flow(built: tuple[Path, config.Scene], tmp_path: Path) -> None:
    from vbnfault.torch import SampleDataset

    flow = vbnfault.open_dataset(built[0])["flow"].values
    given = SampleDataset(str(built[0]), None, ["flow"])[0]["flow"].numpy()
    np.testing.assert_array_equal(given, np.moveaxis(flow[0], -1, 0))
    openexr = importlib.import_module("OpenEXR")
    export_store(built[0], tmp_path / "exr", "exr", progress=False)
    (path,) = (tmp_path / "exr").glob("*/000000.exr")
    with openexr.File(str(path), separate_channels=True) as file:
        for k, axis in enumerate("XY"):
            np.testing.assert_array_equal(file.channels()[f"flow.{axis}"].pixels, flow[0][..., k])


def test_what_has_no_flow_is_refused(built: tuple[Path, config.Scene], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dataset\.layers: 'flow' needs the next frame: .* sequence or time_s"):
        vbnfault.Session(scene_of())
    with pytest.raises(InputError, match=r"dataset\.layers: 'flow' needs the next frame"):
        vbnfault.build(scene_of(), tmp_path / "s.zarr", progress=False)
    still = poses(2500.0, 1.0)
    del still["sequence"], still["time_s"]
    with pytest.raises(InputError, match=r"dataset\.layers: 'flow' needs the next frame"):
        vbnfault.Session(scene_of(), poses=still)
    rolling = scene_of(motion={"shutter": "rolling", "line_time_s": 1e-5}, dataset={"layers": ["flow"]})
    with pytest.raises(InputError, match=r"'flow' is that of one pose, .* motion\.shutter = 'rolling'"):
        vbnfault.Session(rolling, poses=poses(2500.0, 1.0))
    data = vbnfault.open_dataset(built[0])
    for arguments, sentence in (
        ({"sequence": "c"}, r"sequence = 'c': must be one of a, b"),
        ({"sequence": "a", "frame": 3}, r"frame = 3: must be a finished frame of a: 0, 1, 2"),
        ({"sequence": "a", "xy_px": [1.0, 2.0]}, r"xy_px: shape \(2,\): must be \[point, 2\]"),
        ({"sequence": "a", "data": data[["frame"]]}, "data: has no sequences"),
        ({"sequence": "a", "data": data.drop_vars(["depth_m", "point_T_m"])}, "neither the layer depth_m nor"),
    ):
        with pytest.raises(InputError, match=sentence):
            vbnfault.navigation.tracks(**{"data": data, "xy_px": [[1.0, 2.0]], **arguments})
