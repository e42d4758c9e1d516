"""Tables of poses: what is read and refused, the views that follow, and stores made of them."""

from __future__ import annotations

import re
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import recorded_calls
from poses_kit import Rows, columns_of, row
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault import dataset, pipeline
from vbnfault.body import PatchSpec
from vbnfault.body.refine import EdgeLimit
from vbnfault.core.errors import InputError
from vbnfault.dataset import describe
from vbnfault.scene import config, trajectory
from vbnfault.scene.trajectory import COLUMNS, FlownPose, Trajectory, as_trajectory, load_trajectory
from vbnfault.world import assemble, ground

RADIUS_M = 500.0


def rows() -> Rows:
    """Return five rows around the sphere, from 0.2 to 60 of its radii above the ground."""
    return [
        row("near", (600.0, 0, 0), (0.8, 0.6, 0)),
        row("side", (0, 1500.0, 300.0)),
        row("far", (0, 0, 30e3), (0.6, 0, 0.8)),
        row("night", (0, -5e3, 0), (0.0, 1.0, 0.0)),
        row("last", (9e3, 9e3, -9e3), julian_date=2457001.25, sun_distance_au=3.1),
    ]


def write(path: Path, table: Rows, columns: tuple[str, ...] = COLUMNS) -> Path:
    """Write a table as CSV with all digits."""
    text = [",".join(columns)]
    for values in table:
        text.append(",".join(v if isinstance(v, str) else repr(float(v)) for v in (values[c] for c in columns)))
    path.write_text("\n".join(text) + "\n")
    return path


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the path of a sphere of 5120 triangles, whose vertices and centres of facets enclose its radius."""
    import trimesh

    path = tmp_path_factory.mktemp("sphere") / "sphere.obj"
    trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_M * 1.0008).export(path)
    return str(path)


SMALL: dict[str, Any] = {
    "title": "flown",
    "body": {
        "unit": "m",
        "name": "sphere",
        "density_kg_m3": 500.0,
        "rotation_period_h": 10.0,
        "pole_ra_deg": 0.0,
        "pole_dec_deg": 90.0,
        "prime_meridian_deg": 0.0,
        "reflectance": 0.06,
    },
    "patch": {"facet_m": 10.0, "radius_m": 40.0, "relief": 0.0, "boulders": False, "max_triangles": 60_000},
    "camera": {"fov_deg": 40.0, "width_px": 40, "height_px": 32},
    "dataset": {"shard_samples": 2, "layers": ["depth_m"]},
    "render": {"bands": 2, "samples_per_pixel": 1},
}


def small(sphere: str, **camera: Any) -> vbnfault.Scene:
    """Return the scene without a table."""
    content = {**SMALL, "body": {**SMALL["body"], "shape": sphere}, "camera": {**SMALL["camera"], **camera}}
    return config.parse_scene(content, source="test")


def scene_file(folder: Path, sphere: str, table: Rows | None = None) -> Path:
    """Write a scene of a sphere with a table of poses beside it."""
    import tomli_w

    write(folder / "poses.csv", rows() if table is None else table)
    content = {**SMALL, "body": {**SMALL["body"], "shape": sphere}, "trajectory": {"file": "poses.csv"}}
    path = folder / "flown.toml"
    path.write_text(tomli_w.dumps(content))
    return path


# ------------------------------------------------------------------------------------------------ the table


def test_csv_parquet_data_frame_and_mapping_are_the_same_table(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    table = rows()
    written = load_trajectory(str(write(tmp_path / "a.csv", table)))
    shuffled = write(tmp_path / "b.csv", table, tuple(reversed(COLUMNS)))
    shuffled.write_bytes(b"\xef\xbb\xbf" + shuffled.read_bytes().replace(b"\n", b"\r\n"))  # as spreadsheets do
    pyarrow.parquet.write_table(pyarrow.table(columns_of(table)), tmp_path / "c.parquet")
    others = [load_trajectory(str(shuffled)), load_trajectory(str(tmp_path / "c.parquet"))]
    others += [as_trajectory(columns_of(table)), as_trajectory(tmp_path / "a.csv")]
    assert written.name == ("near", "side", "far", "night", "last")
    for other in others:
        assert other.name == written.name
        for key in ("julian_date", "camera_position_T_m", "camera_from_T", "sun_direction_T", "sun_distance_au"):
            np.testing.assert_array_equal(getattr(other, key), getattr(written, key))


def test_the_quaternion_takes_vectors_of_t_to_the_camera() -> None:
    """Against scipy, and a turn by hand: 90° about z takes T's +x to the camera's +y, downwards in the image."""
    half = 0.5**0.5
    turned = row("a", (0, 0, -10.0))
    turned |= dict(zip(COLUMNS[5:9], (half, 0.0, 0.0, half), strict=True))
    pose = as_trajectory(columns_of([turned])).pose(0)
    np.testing.assert_allclose(pose.T_from_C.T @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    trajectory = as_trajectory(columns_of(rows()))
    for k in range(len(trajectory)):
        expected = Rotation.from_quat(trajectory.camera_from_T[k], scalar_first=True).as_matrix().T
        np.testing.assert_allclose(trajectory.pose(k).T_from_C, expected, atol=1e-14)


def change(index: int, **values: Any) -> Callable[[Rows], None]:
    """Return a function that changes a row."""
    return lambda table: table[index].update(values)


@pytest.mark.parametrize(
    ("alter", "sentence"),
    [
        (change(1, camera_x_T_m="far"), r"row 2: camera_x_T_m = 'far': must be a number from -1e.12 to 1e"),
        (
            change(1, julian_date=float("nan")),
            r"row 2: julian_date = 'nan': must be a number from 1000000 to 5000000",
        ),
        (change(3, sun_distance_au=0), r"row 4: sun_distance_au = '0.0': must be a number from 0.01 to 1000"),
        (change(0, camera_from_T_w=1.2), r"row 1: camera_from_T_w = '1.2': must be a number from -1.001 to 1.001"),
        (
            change(2, sun_x_T=0.0),
            r"row 3: sun_x_T, sun_y_T, sun_z_T: their norm is 0.8; must be from 0.999 to 1.001",
        ),
        (change(4, name="near"), r"row 5: name = 'near': row 1 has this name; must differ in every row"),
        (change(4, name=""), r"row 5: name = '': must be a printable text of 1 to 200 characters"),
        (lambda table: table.clear(), r"has no rows; must have at least 1, each a pose"),
    ],
)
def test_a_wrong_value_is_named_with_its_row_and_range(tmp_path: Path, alter: Any, sentence: str) -> None:
    table = rows()
    alter(table)
    with pytest.raises(InputError, match=rf"poses\.csv: {sentence}"):
        load_trajectory(str(write(tmp_path / "poses.csv", table)))


@pytest.mark.parametrize(
    ("change_text", "sentence"),
    [
        (
            lambda t: t.replace("sun_distance_au", "sun_distance_km"),
            r"columns are missing: sun_distance_au; unknown ",
        ),
        (lambda t: t.replace("name,", "name,name,"), r"column 'name' stands twice; must stand once"),
        (
            lambda t: t.split("\n", 1)[1],
            r"its first line is one of numbers; must name the columns: name, julian_date, ",
        ),
        (lambda t: t + "more,1\n", r"row 6 has 2 values; must have 13, as the first line has"),
        (lambda t: "\n", r"columns are missing: name, julian_date, "),
        (lambda t: t + '"open', r"is no CSV file: "),
        (lambda t: t.encode() + b"\xff", r"byte \d+ is no UTF-8"),
    ],
)
def test_a_malformed_file_is_refused_in_a_sentence(tmp_path: Path, change_text: Any, sentence: str) -> None:
    path = write(tmp_path / "poses.csv", rows())
    text = change_text(path.read_text())
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=rf"poses\.csv: {sentence}"):
        load_trajectory(str(path))
    other = tmp_path / "poses.parquet"
    other.write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match=r"poses\.parquet: is no Parquet file: "):
        load_trajectory(str(other))
    with pytest.raises(InputError, match=r"unsupported trajectory type '\.txt'; allowed are \.csv, \.parquet"):
        load_trajectory(str(path.rename(tmp_path / "poses.txt")))


def test_a_table_of_very_many_columns_is_refused_at_once() -> None:
    """300,000 columns once took a minute: each was compared with all before it. Now the comparisons go with n."""
    compared = 0

    class Name(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return str.__eq__(self, other)

    names = [Name(f"c{k}") for k in range(1000)]
    with pytest.raises(InputError, match=r"columns are missing: name, .*; unknown columns: 'c0', "):
        trajectory._check_names(names, "poses.csv")
    assert 0 < compared < 100 * len(names)


@pytest.mark.parametrize(
    ("column", "kind"), [("julian_date", "date32"), ("julian_date", "duration"), ("name", "binary")]
)
def test_a_parquet_column_that_holds_no_numbers_or_texts_is_refused(tmp_path: Path, column: str, kind: str) -> None:
    """A date beyond the year 9999 has no equivalent in Python."""
    import pyarrow
    import pyarrow.parquet

    values = {
        "date32": pyarrow.array([2**31 - 1] * 5, pyarrow.int32()).cast(pyarrow.date32()),
        "duration": pyarrow.array([2**53] * 5, pyarrow.duration("s")),
        "binary": pyarrow.array([b"a", b"b", b"c", b"d", b"e"]),
    }[kind]
    path = tmp_path / "poses.parquet"
    pyarrow.parquet.write_table(pyarrow.table({**columns_of(rows()), column: values}), path)
    wanted = "texts" if column == "name" else "numbers"
    with pytest.raises(
        InputError, match=rf"poses\.parquet: column {column} has the type {kind}.*; must hold {wanted}"
    ):
        load_trajectory(str(path))


def test_rows_set_the_samples_and_too_many_are_refused(tmp_path: Path, sphere: str) -> None:
    path = scene_file(tmp_path, sphere)
    scene = config.load_scene(path)
    assert (scene.dataset.samples, scene.dataset.sites) == (5, 3)
    assert config.load_scene(path, {"dataset.samples": 2}).dataset.samples == 2
    with pytest.raises(
        InputError, match=r"dataset\.samples = 6: .*poses\.csv has 5 rows.*; must be from 1 to 5, or"
    ):
        config.load_scene(path, {"dataset.samples": 6})
    spice = {"kernels": ["k"], "spacecraft": "X", "frame": "F", "camera_frame": "C"}
    with pytest.raises(InputError, match=r"trajectory\.file = .*: spice\.spacecraft = 'X' gives poses, too"):
        config.load_scene(path, {f"spice.{key}": value for key, value in spice.items()})
    with pytest.raises(InputError, match=r"trajectory\.file = '': must be a string that is not empty"):
        config.load_scene(path, {"trajectory.file": ""})
    with pytest.raises(InputError, match=r"poses = 3: must be a path, a data frame, or a mapping"):
        vbnfault.Session(scene, poses=3)


def test_an_edited_table_is_read_again(tmp_path: Path, sphere: str) -> None:
    assert config.load_scene(scene_file(tmp_path, sphere)).dataset.samples == 5
    assert config.load_scene(scene_file(tmp_path, sphere, rows()[:2])).dataset.samples == 2


# ------------------------------------------------------------------------------------------------ the views


def test_a_sphere_has_its_size_and_place_from_any_distance(sphere: str) -> None:
    """The limb of a sphere of radius R at the distance d lies f R / sqrt(d² - R²) px from its centre.

    From 2 to 50 radii; the 1280 sight lines of a frame tell the area of the mesh to 3 %.
    """
    far = [row(f"{k}", np.array([k, 0.2 * k, -0.1 * k]) * RADIUS_M) for k in (30.0, 50.0)]
    close = [row("2.0", np.array([0.2, -2.0, 0.4]) * RADIUS_M)]
    for setting, part in ((small(sphere, fov_deg=5.0), far), (small(sphere, fov_deg=90.0), close)):
        session = vbnfault.Session(setting, poses=columns_of(part))
        for k, values in enumerate(part):
            depth = session.simulate(k).layers["depth_m"]
            distance = np.linalg.norm([values[f"camera_{axis}_T_m"] for axis in "xyz"])
            focal_px = 20 / np.tan(np.radians(setting.camera.fov_deg / 2))
            limb_px = focal_px * RADIUS_M / np.sqrt(distance**2 - RADIUS_M**2)
            y, x = np.nonzero(np.isfinite(depth))
            assert len(x) == pytest.approx(np.pi * limb_px**2, rel=0.03, abs=12)
            assert (x.mean() + 0.5, y.mean() + 0.5) == pytest.approx((20, 16), abs=0.15)
            assert depth.min() == pytest.approx(distance - RADIUS_M, rel=2e-3)


def test_a_body_may_be_smaller_than_a_patch() -> None:
    keys = {**SMALL["body"], "shape": "ellipsoid", "semi_axes_m": [0.1, 0.1, 0.1]}
    scene = config.parse_scene({**SMALL, "body": keys}, source="test")
    session = vbnfault.Session(scene, poses=columns_of([row("a", (2.0, 0, 0))]))
    assert session.simulate(0).layers["depth_m"].min() == pytest.approx(1.9, abs=0.01)


def test_a_wide_camera_may_be_any_distance_away(sphere: str) -> None:
    """A pixel of 18 mrad covers 18,000 km from a million km away, more than the largest facet of a patch."""
    distances_m = (1e9, 1e12)
    session = vbnfault.Session(
        small(sphere), poses=columns_of([row(f"{d:g}", (0, 0, d), (0.6, 0, 0.8)) for d in distances_m])
    )
    assert session.ground_detail(0) == session.ground_detail(1)
    assert np.isinf(session.simulate(0).layers["depth_m"]).mean() > 0.99
    moon = assemble.make_body(config.parse_scene({"title": "", "body": {"name": "Moon"}}, source="test"))
    budget = {"patch": session.scene.patch.model_copy(update={"max_triangles": 1000})}
    for scene in (session.scene, session.scene.model_copy(update=budget)):
        for pose in (session.trajectory.pose(k) for k in range(2)):
            (detail,) = ground.ground_details(scene, moon, [pose])
            PatchSpec(seed=0, facet_m=detail.facet_m, radius_m=detail.radius_m, min_boulder_m=detail.boulder_m)


def test_terrain_is_whole_from_afar_and_shared_and_a_patch_near_the_ground(tmp_path: Path, sphere: str) -> None:
    scene = config.load_scene(scene_file(tmp_path, sphere), {"patch.facet_m": 0.2, "camera.width_px": 1024})
    body = assemble.make_body(scene)

    def detail(*cameras_T_m: Any) -> list[ground.GroundDetail]:
        trajectory = as_trajectory(columns_of([row(f"{k}", c) for k, c in enumerate(cameras_T_m)]))
        return ground.ground_details(scene, body, [trajectory.pose(k) for k in range(len(trajectory))])

    far = detail((0, 0, 60e3), (61e3, 0, 0), (0, -59e3, 0))
    assert far[0] == far[1] == far[2]  # all sides
    # 23 pixels wide, it has the terrain of a body of 64
    assert far[0].facet_m == pytest.approx(2 * RADIUS_M / 64, rel=0.3)
    assert far[0].radius_m >= 1.99 * RADIUS_M  # even over the whole body
    one, other = detail((0, 0, 503.0), (0, 0, -503.0))
    assert one != other  # two sides of a small body, from near: each has its own
    assert one.position_T_m == pytest.approx((0, 0, 500), abs=1)
    assert (one.facet_m, one.radius_m) == (0.2, 40.0)  # as near the ground without a table
    together = detail((0, 0, 503.0), (0.5, 0, 503.0))
    assert together[0] == together[1]
    # few triangles: the body's area, shared among two thirds of them, sets the facets
    poor = scene.model_copy(update={"patch": scene.patch.model_copy(update={"max_triangles": 20_000})})
    near_enough = as_trajectory(columns_of([row("a", (0, 0, 4e3))])).pose(0)
    (coarse,) = ground.ground_details(poor, body, [near_enough])
    assert coarse.facet_m > 1.5 * detail((0, 0, 4e3))[0].facet_m
    triangles = min(np.pi * coarse.radius_m**2, body.area_m2) / (3**0.5 / 4 * coarse.facet_m**2)
    assert triangles == pytest.approx(0.66 * 20_000, rel=1e-6)
    # half-way, the facets in the frame are about a pixel wide, up to a quarter more
    rich = scene.model_copy(update={"patch": scene.patch.model_copy(update={"max_triangles": 20_000_000})})
    (middle,) = ground.ground_details(rich, body, [as_trajectory(columns_of([row("b", (0, 0, 1500.0))])).pose(0)])
    assert middle.position_T_m[2] > 450
    assert 0.7 < middle.facet_m / (1000 * scene.camera.pixel_rad) < 1.25
    # facets of two pixels, with the boulders that they can show
    wide = rich.model_copy(update={"patch": rich.patch.model_copy(update={"facet_px": 2.0})})
    (twice,) = ground.ground_details(wide, body, [as_trajectory(columns_of([row("b", (0, 0, 1500.0))])).pose(0)])
    assert twice.facet_m == pytest.approx(2 * middle.facet_m, rel=1e-9)
    assert (twice.boulder_m, middle.boulder_m) == (
        pytest.approx(2 * twice.facet_m),
        pytest.approx(2 * middle.facet_m),
    )


def test_the_frames_of_a_sequence_share_a_terrain_as_fine_as_each_needs(tmp_path: Path, sphere: str) -> None:
    """Below each camera of a descent, facets are as wide as for its pose alone: a pixel, or `patch.facet_m`.

    Distances are rounded down to powers of sqrt 2 before a pixel is measured, which makes facets finer by as much.
    """
    keys = {"patch.facet_m": 0.2, "patch.max_triangles": 1_000_000, "camera.width_px": 1024}
    scene = config.load_scene(scene_file(tmp_path, sphere), keys)
    heights_m = np.geomspace(20e3, 3, 60)
    table = columns_of([row(f"{k}", (0, 0, 500 + h)) for k, h in enumerate(heights_m)])
    session = vbnfault.Session(scene, poses={**table, "time_s": np.arange(60.0).tolist()})
    details = [session.ground_detail(k) for k in range(60)]
    assert len(set(details)) == 1
    shared = details[0]
    limit = EdgeLimit(shared.facet_m, shared.radius_m)
    below_m = np.linalg.norm(np.array([0, 0, 500]) - np.array(shared.position_T_m))
    facet_m = limit.facet_at(np.array([[below_m, 0.0, 0.0]]))[0]
    wanted_m = np.maximum(0.2, heights_m * scene.camera.pixel_rad)
    assert facet_m <= wanted_m.min() * 1.001
    # from afar all of the body is seen; at its rim, 700 m from the origin, no facet is wider than a pixel
    rim_m = limit.facet_at(np.array([[700.0, 0.0, 0.0]]))[0]
    assert rim_m <= 20e3 * scene.camera.pixel_rad
    far_alone = (
        session.ground_detail(0),
        ground.ground_of_sequence(scene, session.body, [session.trajectory.pose(0)]),
    )
    assert far_alone[1].facet_m > 10 * far_alone[0].facet_m


# ------------------------------------------------------------------------------------------------ stores


def build(path: Path, out: Path, **keywords: Any) -> Any:
    """Build a scene's store without its progress."""
    return vbnfault.build(path, out, progress=False, **keywords)


def test_a_store_of_a_table_is_built_resumed_extended_and_read(tmp_path: Path, sphere: str) -> None:
    path, out = scene_file(tmp_path, sphere), tmp_path / "s.zarr"
    assert build(path, out, samples=3).built == 3
    with pytest.raises(InputError, match=r"7 samples are planned, but .*poses\.csv has 5 rows"):
        build(path, out, samples=3, append=4)
    assert build(path, out, samples=3, append=2).built == 2
    assert build(path, out, samples=3).built == 0
    report = vbnfault.verify(out)
    assert report.problems == []
    table = rows()
    with vbnfault.open_dataset(out) as data:
        assert list(data.coords["name"].values) == [values["name"] for values in table]
        assert data["name"].dims == ("sample",)
        np.testing.assert_array_equal(data["julian_date"], [values["julian_date"] for values in table])
        np.testing.assert_array_equal(data["sun_distance_au"], [values["sun_distance_au"] for values in table])
        for name, columns in (
            ("camera_position_T_m", COLUMNS[2:5]),
            ("camera_from_T", COLUMNS[5:9]),
            ("sun_direction_T", COLUMNS[9:12]),
        ):
            wanted = np.array([[values[column] for column in columns] for values in table])
            wanted *= np.where(wanted[:, :1] < 0, -1, 1) if name == "camera_from_T" else 1  # stored with w >= 0
            np.testing.assert_allclose(data[name], wanted, rtol=0, atol=1e-6 if "_m" in name else 1e-12)
        assert data["site"].values.tolist() == [0, 0, 1, 1, 2]  # two rows each, in order
        assert data["image"][3].values[..., 3].max() < 3  # the night side
        assert data["image"][2].values[..., 3].max() > 50
        again = vbnfault.simulate(path, 4)
        given = vbnfault.simulate(path, 4, poses=columns_of(table))
        for sample in (again, given):
            np.testing.assert_array_equal(sample.layers["image"], data["image"][4])
            np.testing.assert_array_equal(sample.layers["depth_m"], data["depth_m"][4])
    # other poses are another dataset, the same poses in another file are not
    renamed = tmp_path / "same.csv"
    renamed.write_bytes((tmp_path / "poses.csv").read_bytes())
    moved = config.load_scene(path, {"trajectory.file": str(renamed)})
    assert vbnfault.build(moved, out, progress=False, samples=3).built == 0
    write(tmp_path / "poses.csv", [{**values, "sun_distance_au": 2.6} for values in table])
    with pytest.raises(InputError, match=r"holds another dataset: .*trajectory\.file"):
        build(path, out, samples=3)


def test_the_description_shows_names_dates_and_distances(tmp_path: Path, sphere: str) -> None:
    text = "\n".join(dataset.describe_scene(config.load_scene(scene_file(tmp_path, sphere)), source="flown"))
    assert "samples: 5 at 3 of 3 sites, 1 to 2 at each" in text
    assert "trajectory: 5 of 5 rows of poses.csv, from near to last; a site stands for 2 rows side by side" in text
    assert "nearest ground: 99.6 to 29500 m from the camera" in text
    assert "look past the body" not in text
    assert "Sun: 2.5 to 3.1 au away, dates 2457000.50000 to 2457001.25000 TDB" in text


@pytest.mark.parametrize(
    ("camera_from_T", "looks_past"),
    [
        ((0.5, 0.5, 0.5, -0.5), False),  # from +x at the body: boresight −x
        ((0.5, 0.5, -0.5, 0.5), True),  # boresight +x
        ((-0.5, 0.5, 0.5, 0.5), True),  # the first one with w last
    ],
)
def test_the_description_warns_of_rows_that_look_past_the_body(
    camera_from_T: tuple[float, ...], looks_past: bool, tmp_path: Path, sphere: str
) -> None:
    turned = dict(zip(("w", "x", "y", "z"), camera_from_T, strict=True))
    values = {f"camera_from_T_{name}": value for name, value in turned.items()}
    path = scene_file(tmp_path, sphere, [row("far", (30000.0, 0.0, 0.0), **values)])
    text = "\n".join(dataset.describe_scene(config.load_scene(path), source="flown"))
    assert ("1 of 1 rows look past the body, the first is far" in text) == looks_past


@pytest.mark.parametrize(("radii", "looks_past"), [(0.8, False), (1.2, True)])
def test_a_row_that_shows_the_rim_of_the_body_looks_not_past_it(
    radii: float, looks_past: bool, tmp_path: Path, sphere: str
) -> None:
    """The body's centre lies so many of its angular radii beyond the corner of the frame."""
    corner = np.arctan(np.tan(np.radians(40.0 / 2)) * np.hypot(1, 32 / 40))
    half = 0.5 * (corner + radii * np.arcsin(RADIUS_M / 8000.0))
    w, x, y, z = 0.5, 0.5, 0.5, -0.5  # from +x at the body, then turned about the camera's y
    c, s = np.cos(half), np.sin(half)
    turned = {"w": c * w - s * y, "x": c * x + s * z, "y": c * y + s * w, "z": c * z - s * x}
    values = {f"camera_from_T_{name}": float(value) for name, value in turned.items()}
    path = scene_file(tmp_path, sphere, [row("near", (8000.0, 0.0, 0.0), **values)])
    text = "\n".join(dataset.describe_scene(config.load_scene(path), source="flown"))
    assert ("1 of 1 rows look past the body" in text) == looks_past


@pytest.mark.parametrize(("away_deg", "looks_past"), [(85.0, False), (115.0, True)])
def test_a_fisheye_looks_past_the_body_only_beyond_its_image_circle(
    away_deg: float, looks_past: bool, tmp_path: Path, sphere: str
) -> None:
    (w, x, y, z), half = (0.5, 0.5, 0.5, -0.5), np.radians(away_deg) / 2  # turned as in the test above
    c, s = np.cos(half), np.sin(half)
    turned = {"w": c * w - s * y, "x": c * x + s * z, "y": c * y + s * w, "z": c * z - s * x}
    values = {f"camera_from_T_{name}": float(value) for name, value in turned.items()}
    path = scene_file(tmp_path, sphere, [row("far", (30000.0, 0.0, 0.0), **values)])
    calibration = {"model": "fisheye", "fx": 11.0, "cx": 19.5, "cy": 15.5, "circle_deg": 200.0}
    scene = config.load_scene(path, {"camera": {"width_px": 40, "height_px": 32, "calibration": calibration}})
    text = "\n".join(dataset.describe_scene(scene, source="flown"))
    assert ("1 of 1 rows look past the body" in text) == looks_past


@pytest.mark.parametrize(("radii", "is_inside"), [(0.98, True), (1.02, False)])
def test_rows_inside_the_body_are_refused_before_a_build(
    radii: float, is_inside: bool, tmp_path: Path, sphere: str
) -> None:
    """The facets of the sphere are within 0.1 % of its radius, 0.5 m, of its radius."""
    table = [row("out", (30000.0, 0.0, 0.0)), row("low", (0.0, radii * RADIUS_M, 0.0))]
    scene = config.load_scene(scene_file(tmp_path, sphere, table))
    if not is_inside:
        assert dataset.describe_scene(scene, source="flown")
        return
    with pytest.raises(InputError, match=r"row 'low', at Julian date 2457000.500000, is (\S+) m below") as caught:
        dataset.describe_scene(scene, source="flown")
    depth_m = float(re.findall(r"is (\S+) m below", str(caught.value))[0])
    assert depth_m == pytest.approx((1 - radii) * RADIUS_M, abs=0.5)
    with pytest.raises(InputError, match="row 'low'"):
        vbnfault.build(scene, tmp_path / "s.zarr", progress=False)
    assert not (tmp_path / "s.zarr").exists()


def test_the_boresights_of_a_table_are_those_of_its_poses() -> None:
    turns = np.random.default_rng(3).standard_normal((20, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    turned = [dict(zip("wxyz", map(float, turn), strict=True)) for turn in turns]
    rows = [
        row(f"r{k}", (0, 0, 9e3), **{f"camera_from_T_{n}": v for n, v in turn.items()})
        for k, turn in enumerate(turned)
    ]
    table = as_trajectory({name: [r[name] for r in rows] for name in COLUMNS})
    assert np.array_equal(table.boresight_T, np.stack([table.pose(k).T_from_C[:, 2] for k in range(len(rows))]))


def test_a_description_of_many_rows_makes_no_pose_of_each(
    tmp_path: Path, sphere: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    turned = dict(zip((f"camera_from_T_{n}" for n in "wxyz"), (1.0, 0.0, 0.0, 0.0), strict=True))  # boresight +z
    scene = config.load_scene(
        scene_file(tmp_path, sphere, [row(f"r{k}", (0, 0, 9e3), **turned) for k in range(50)])
    )
    made = recorded_calls(monkeypatch, Trajectory, "pose")
    session = pipeline.Session(scene)
    assert describe._rows_that_miss_the_body(session, session.trajectory, 50)
    assert not made


def test_a_scene_made_in_python_has_the_samples_of_its_table(tmp_path: Path, sphere: str) -> None:
    path = scene_file(tmp_path, sphere)
    scene = small(sphere).model_copy(update={"trajectory": config.load_scene(path).trajectory})
    assert scene.dataset.samples != 5
    assert vbnfault.build(scene, tmp_path / "o.zarr", dry_run=True, progress=False).samples == 5
    assert "samples: 5 at 3 of 3 sites, 1 to 2 at each" in dataset.describe_scene(scene, source="flown")


def test_the_description_has_the_exposure_at_the_distances_of_the_table(tmp_path: Path, sphere: str) -> None:
    def exposure_s(table: Rows) -> list[float]:
        scene = config.load_scene(scene_file(tmp_path, sphere, table))
        text = "\n".join(dataset.describe_scene(scene, source="flown"))
        (about,) = re.findall(r"metered, about (.*?) s for ground", text)
        return [float(number) for number in about.split(" to ")]

    (one,) = exposure_s([row("a", (0, 0, 2000.0), sun_distance_au=1.0)])
    near, far = exposure_s(
        [row("a", (0, 0, 2000.0), sun_distance_au=1.0), row("b", (0, 0, 2e3), sun_distance_au=3.0)]
    )
    assert (near, far) == pytest.approx((one, 9 * one), rel=0.01)


def test_the_description_takes_one_pose_after_the_other(tmp_path: Path, sphere: str) -> None:
    """All vertices from 200 poses at once would take gigabytes for a detailed shape."""
    table = [row(f"{k}", (0, 0, 2000.0 + k)) for k in range(250)]
    scene = config.load_scene(scene_file(tmp_path, sphere, table))
    session = vbnfault.Session(scene)
    vertices = len(session.body.vertices_m)
    tracemalloc.start()
    lines = describe._trajectory(session, session.trajectory)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 20 * vertices * 24
    assert "m from the camera (first 200 rows)" in lines[1]


def test_a_camera_in_the_ground_is_named_with_its_row(tmp_path: Path, sphere: str) -> None:
    path = scene_file(tmp_path, sphere, [row("inside", (RADIUS_M - 50, 0, 0)), row("deep", (20.0, 0, 0))])
    session = vbnfault.Session(config.load_scene(path))
    for k, name in enumerate(("inside", "deep")):
        sentence = rf"sample {k}: row '{name}', at Julian date .* m below the ground; .* they were made for"
        with pytest.raises(InputError, match=sentence):
            session.simulate(k)
    body = session.body
    assert not ground.encloses(body, np.array([0.0, 0.0, RADIUS_M + 1]))
    assert not ground.encloses(body, np.array([400.0, 400.0, 400.0]))  # in the bounding box, but outside


def test_a_view_past_the_body_uses_the_ground_nearest_to_the_line_of_sight(sphere: str) -> None:
    scene = small(sphere)
    body = assemble.make_body(scene)
    pose = as_trajectory(columns_of([row("away", (0, 0, 520.0))])).pose(0)
    away: FlownPose = replace(pose, T_from_C=pose.T_from_C @ np.diag([1.0, -1.0, -1.0]))
    scene = scene.model_copy(update={"patch": scene.patch.model_copy(update={"facet_m": 0.05})})
    (detail,) = ground.ground_details(scene, body, [away])
    assert detail.position_T_m == pytest.approx((0, 0, 500), abs=20)
