"""A map of the albedo: where its pixels appear, its filter at the seam and the poles, and how it is refused."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vbnfault import dataset, store
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import BODY
from vbnfault.dataset.identity import scene_identity, stored_scene
from vbnfault.pipeline import Session
from vbnfault.scene import config
from vbnfault.scene.target import AlbedoMapTable
from vbnfault.world import surface_map
from vbnfault.world.surface_map import load_albedo_map

Array = NDArray[np.float64]


def written(path: Path, image: NDArray[Any]) -> Path:
    assert cv2.imwrite(str(path), image if image.ndim == 2 else image[..., ::-1])
    return path


def quadrant(rows: int = 64) -> NDArray[np.uint8]:
    """Bright from 0 to 90° east and 0 to 90° north, in a map that begins at 180° west."""
    image = np.full((rows, 2 * rows), 50, dtype=np.uint8)
    image[: rows // 2, rows : rows + rows // 2] = 200
    return image


def in_quadrant(longitude_deg: Array, latitude_deg: Array) -> NDArray[np.bool_]:
    return (longitude_deg > 0) & (longitude_deg < 90) & (latitude_deg > 0)


def orbit_scene(path: Path, **map_keys: Any) -> dict[str, Any]:
    """Views of a whole sphere from 12 km, looking straight down, the Sun high above the ground below the camera."""
    view = {
        "reference": "nadir",
        "sun_elevation_deg": [60.0, 80.0],
        "roll_deg": [-1.0, 1.0],
        "pitch_deg": [-1.0, 1.0],
    }
    layers = ["point_T_m", "albedo", "radiance", "semantic", "incidence_deg"]
    return {
        "title": "map",
        "dataset": {"samples": 4, "sites": 4, "shard_samples": 1, "layers": layers},
        "body": {
            "name": "sphere",
            "shape": "ellipsoid",
            "semi_axes_m": [2000.0, 2000.0, 2000.0],
            "reflectance": 0.1,
            "albedo_map": {"file": str(path), "neutral": 50 / 255, **map_keys},
        },
        "patch": {"facet_m": 100.0, "radius_m": 1000.0, "relief": 0.0, "boulders": False, "craters_per_km2": 0.0},
        "camera": {"width_px": 64, "height_px": 64, "fov_deg": 25.0},
        "geometry": {
            "x_m": [-1.0, 1.0],
            "y_m": [-1.0, 1.0],
            "height_m": [12000.0, 12001.0],
            "sun_facing": view,
            "sun_averted": view,
        },
        "plan": {"faulty_fraction": 0.0},
        "render": {"bands": 2, "samples_per_pixel": 4},
        "faults": {},
    }


@pytest.mark.filterwarnings("ignore:body.shape = 'ellipsoid'")  # it turns as 67P does, which does not matter here
@pytest.mark.parametrize(
    ("projection", "left_longitude_deg"),
    [("equirectangular", 0.0), ("equirectangular", -180.0), ("cylindrical_equal_area", 90.0)],
)
def test_a_bright_quadrant_lies_at_its_longitudes_and_latitudes(
    tmp_path: Path, projection: str, left_longitude_deg: float
) -> None:
    image = np.roll(quadrant(), -round((left_longitude_deg + 180) / 360 * 128), axis=1)
    if projection == "cylindrical_equal_area":
        image = image[::2]  # half as many rows: any height will do, and the equator stays in the middle
    path = written(tmp_path / "map.png", image)
    table = orbit_scene(path, left_longitude_deg=left_longitude_deg, projection=projection)
    scene = config.parse_scene(table, source="t.toml")
    dataset.build_scene(scene, tmp_path / "s.zarr", source="t.toml", workers=1)
    seen = np.zeros(2, dtype=int)
    with store.open_dataset(tmp_path / "s.zarr") as data:
        for k in range(4):
            sample = data.isel(sample=k)
            x, y, z = np.moveaxis(sample["point_T_m"].values, -1, 0)
            on = sample["semantic"].values == BODY
            longitude, latitude = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
            edges = [np.abs(latitude), np.abs(longitude), np.abs(longitude - 90), 90 - np.abs(latitude)]
            # four degrees from an edge: a pixel at the limb covers several degrees
            inner = cv2.erode(on.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            clear = inner & (np.minimum.reduce(edges) > 4) & (sample["incidence_deg"].values < 70)
            bright = clear & in_quadrant(longitude, latitude)
            dark = clear & ~bright
            seen += [bright.sum(), dark.sum()]
            np.testing.assert_allclose(sample["albedo"].values[bright], 0.4, rtol=0.02)
            np.testing.assert_allclose(sample["albedo"].values[dark], 0.1, rtol=0.02)
            # Lambert: radiance over cos i has the ratio of the albedos
            shade = sample["radiance"].values[0] / np.cos(np.radians(sample["incidence_deg"].values))
            level = np.median(np.concatenate([shade[dark], shade[bright] / 4]))
            np.testing.assert_allclose(shade[bright], 4 * level, rtol=0.1)
            np.testing.assert_allclose(shade[dark], level, rtol=0.1)
    assert seen.min() > 100


def device_map(path: Path, *, wavelength_nm: Any = (550.0,), **keys: Any) -> Any:
    from vbnfault import render

    loaded = load_albedo_map(AlbedoMapTable(file=str(path), **{"neutral": 1.0, **keys}))
    return render.AlbedoMap(
        loaded.levels,
        loaded.left_longitude_deg,
        wavelength_nm=np.array(wavelength_nm),
        reference_band=0,
        T_from_L=np.eye(3),
        site_T_m=np.array([0.0, 0, 500.0]),
    )


def looked_up(albedo: Any, longitude_deg: Any, latitude_deg: Any, footprint_m: float = 1e-3) -> Array:
    """Factors [band, point] on a sphere of 1000 m about the origin of T."""
    from vbnfault.render.albedo import GroundPoints
    from vbnfault.render.runtime import mi

    lon, lat = np.broadcast_arrays(np.radians(longitude_deg), np.radians(latitude_deg))
    p = 1000 * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]) - [[0], [0], [500]]
    point = mi.Point3f(*(mi.Float(np.ascontiguousarray(row, np.float32)) for row in p))
    up = mi.Vector3f(0, 0, 1)  # from where it is seen and lit does not matter
    ground = GroundPoints(
        point_L_m=point, footprint_m=mi.Float(footprint_m), valid=mi.Bool(True), view_L=up, sun_L=up
    )
    factors, water = albedo.factors(ground)
    assert water is None
    return np.stack([f.numpy() for f in factors]).astype(float)


def test_the_map_is_interpolated_across_the_seam_and_at_the_poles(tmp_path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 65536, (16, 32)).astype(np.uint16)
    albedo = device_map(written(tmp_path / "m.png", image), left_longitude_deg=30.0)
    value = image / 65535
    # at the centres of pixels near the equator the factors are the values themselves
    rows, columns = np.meshgrid([6, 7, 8, 9], np.arange(32), indexing="ij")
    longitude, latitude = 30 + (columns.ravel() + 0.5) * 11.25, 90 - (rows.ravel() + 0.5) * 11.25
    np.testing.assert_allclose(looked_up(albedo, longitude, latitude)[0], value[6:10].ravel(), atol=2e-4)
    # halfway between the last and the first column
    seam = looked_up(albedo, [30.0], [90 - 8.5 * 11.25])[0]
    assert seam == pytest.approx([(value[8, 31] + value[8, 0]) / 2], abs=2e-4)
    near = looked_up(albedo, [30 - 1e-3, 30 + 1e-3, 390.0, -330.0], np.full(4, 90 - 8.5 * 11.25))[0]
    np.testing.assert_allclose(near, seam[0], atol=2e-3)
    # one value at each pole, from whatever side: the mean of the row beside it
    for latitude_deg, row in ((89.999, 0), (-89.999, 15)):
        around = looked_up(albedo, np.arange(0, 360, 7.0), latitude_deg)[0]
        np.testing.assert_allclose(around, value[row].mean(), atol=2e-3)


def test_a_map_finer_than_the_pixels_is_averaged(tmp_path: Path) -> None:
    board = np.indices((256, 512)).sum(axis=0) % 2 * 255
    albedo = device_map(written(tmp_path / "m.png", board.astype(np.uint8)))
    texel_m = np.pi * 1000 / 256
    longitude, latitude = np.random.default_rng(2).uniform(-60, 60, (2, 500))
    assert looked_up(albedo, longitude, latitude).std() > 0.15  # 1/6: bilinear between 0 and 1 along both axes
    np.testing.assert_allclose(looked_up(albedo, longitude, latitude, 4 * texel_m), 0.5, atol=0.01)


@pytest.mark.parametrize("rows", [181, 180])
def test_a_map_of_any_number_of_rows_has_coarser_levels(tmp_path: Path, rows: int) -> None:
    """181 rows have no even half, 180 have the half of a half of 45."""
    board = np.indices((rows, 2 * rows)).sum(axis=0) % 2 * 255
    map_file = written(tmp_path / "m.png", board.astype(np.uint8))
    loaded = load_albedo_map(AlbedoMapTable(file=str(map_file), neutral=1.0))
    assert [level.shape[0] - 2 for level in loaded.levels] == [
        rows,
        *((91, 46, 23, 12, 6) if rows == 181 else (90, 45, 23, 12, 6)),
    ]
    assert all(level.shape[1] == 2 * (level.shape[0] - 2) for level in loaded.levels)
    longitude, latitude = np.random.default_rng(2).uniform(-60, 60, (2, 500))
    for texels in (8, 32):
        values = looked_up(device_map(map_file), longitude, latitude, texels * np.pi * 1000 / rows)
        np.testing.assert_allclose(values, 0.5, atol=0.02)
    # east is where it was: the bright quadrant keeps its borders in every level
    image = np.zeros((rows, 2 * rows), dtype=np.uint8)
    image[:, rows:] = 255
    halves = load_albedo_map(AlbedoMapTable(file=str(written(tmp_path / "half.png", image)), neutral=1.0))
    for level in halves.levels:
        assert level[1:-1].mean() == pytest.approx(0.5, abs=1e-5)
        assert level[1:-1, level.shape[1] // 2 :].mean() > 0.9


def test_a_coloured_map_acts_on_its_bands(tmp_path: Path) -> None:
    image = np.zeros((8, 16, 3), dtype=np.uint8)
    image[:] = (255, 102, 51)
    albedo = device_map(
        written(tmp_path / "m.png", image), wavelength_nm=(400.0, 450.0, 500.0, 550.0, 650.0, 900.0)
    )
    factors = looked_up(albedo, [10.0], [10.0])[:, 0]
    np.testing.assert_allclose(factors, [0.2, 0.2, 0.3, 0.4, 1, 1], atol=1e-5)
    # sRGB of 102 is 0.1329 (IEC 61966-2-1)
    srgb = device_map(tmp_path / "m.png", encoding="srgb", wavelength_nm=(550.0,))
    assert looked_up(srgb, [10.0], [10.0])[0, 0] == pytest.approx(0.1329, abs=1e-4)
    # by the mean over body and channels, the colour stays
    mean = looked_up(
        device_map(tmp_path / "m.png", neutral="mean", wavelength_nm=(450.0, 550.0, 650.0)), [0.0], [0.0]
    )
    np.testing.assert_allclose(mean[:, 0], np.array([51, 102, 255]) / 136, atol=1e-4)


def test_an_equal_area_map_keeps_area_and_latitudes(tmp_path: Path) -> None:
    """Rows are at equal steps of the sine: the cap north of 30°, a quarter of the area, is the upper quarter."""
    image = np.full((400, 360), 51, dtype=np.uint8)
    image[:100] = 255
    keys = {"file": str(written(tmp_path / "m.png", image)), "projection": "cylindrical_equal_area"}
    loaded = load_albedo_map(AlbedoMapTable(**keys))
    assert loaded.levels[0].shape == (182, 360, 1)
    latitude = 90 - (np.arange(180) + 0.5)
    rows = loaded.levels[0][1:-1, 0, 0]
    np.testing.assert_allclose(rows[latitude > 30.5], 1 / 0.4, rtol=1e-5)  # 0.4: a quarter of 1, the rest 0.2
    np.testing.assert_allclose(rows[latitude < 29.5], 0.2 / 0.4, rtol=1e-5)
    rng = np.random.default_rng(3).uniform(0.1, 1, (50, 64, 1)).astype(np.float32)
    weights = np.cos((0.5 - (np.arange(32) + 0.5) / 32) * np.pi)
    even = surface_map._with_equal_latitudes(rng)
    assert even.shape == (32, 64, 1)
    # the weights of the test are those of the rows' centres, 2e-4 from those of their areas
    np.testing.assert_allclose(np.average(even, axis=0, weights=weights), rng.mean(axis=0), rtol=2e-3)
    odd = {**keys, "file": str(written(tmp_path / "odd.png", image[:, :-1]))}
    with pytest.raises(InputError, match=r"has 359 x 400 pixels; a map with projection = 'cylindrical_equal_area'"):
        load_albedo_map(AlbedoMapTable(**odd))
    with pytest.raises(InputError, match=r"body\.albedo_map\.projection = 'mercator': must be "):
        config.parse_scene(orbit_scene(Path("m.png"), projection="mercator"), source="t.toml")


def test_the_mean_is_over_the_area_of_the_body(tmp_path: Path) -> None:
    image = np.full((180, 360), 51, dtype=np.uint8)
    image[:30] = 255  # north of 60°: (1 - sin 60°) / 2 of the sphere
    loaded = load_albedo_map(AlbedoMapTable(file=str(written(tmp_path / "m.png", image))))
    mean = 0.2 + 0.8 * (1 - np.sin(np.radians(60))) / 2
    assert loaded.levels[0][90, 0, 0] == pytest.approx(0.2 / mean, rel=1e-3)


@pytest.mark.parametrize(
    ("image", "sentence"),
    [
        (
            np.zeros((10, 30), np.uint8),
            "has 30 x 10 pixels; a map of the whole body has twice as many columns as rows",
        ),
        (np.zeros((2, 4), np.uint8), "and at least 4 rows"),
        (np.zeros((8, 16), np.uint8), r"is black; give body\.albedo_map\.neutral"),
        (np.full((8, 16), -1, np.float32), "has values that are negative or not finite"),
        (b"no image", "is not a PNG or TIFF image"),
        (b"II*\0 no image", "is a damaged TIFF file"),
        # the header alone of 65536 x 32768 pixels: refused before anything is decoded
        (
            b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 65536, 32768),
            r"has 65536 x 32768 pixels of 1 channel\(s\); pixels times channels must be at most 134217728",
        ),
    ],
)
def test_a_wrong_map_is_refused(tmp_path: Path, image: NDArray[Any] | bytes, sentence: str) -> None:
    path = tmp_path / "map.tif"
    if isinstance(image, bytes):
        path.write_bytes(image)
    else:
        written(path, image)
    with pytest.raises(InputError, match=f"body.albedo_map.file = {re.escape(repr(str(path)))}: .*{sentence}"):
        load_albedo_map(AlbedoMapTable(file=str(path)))


def test_a_wrong_map_is_refused_before_any_sample_is_rendered(tmp_path: Path) -> None:
    written(tmp_path / "map.tif", np.zeros((10, 30), np.uint8))
    scene = config.parse_scene(orbit_scene(tmp_path / "map.tif"), source="map.toml")
    with pytest.raises(InputError, match="has 30 x 10 pixels"):
        dataset.build_scene(scene, tmp_path / "s.zarr", source="map.toml", dry_run=True)


def test_the_identity_of_a_store_is_of_the_contents_of_its_map(tmp_path: Path) -> None:
    def identity(name: str, image: NDArray[np.uint8]) -> dict[str, Any]:
        table = orbit_scene(written(tmp_path / name, image))
        return scene_identity(Session(config.parse_scene(table, source="t.toml")))

    first, copy, other = (identity(f"{k}.png", quadrant(rows)) for k, rows in enumerate((64, 64, 32)))
    assert first == copy
    assert first["body"]["albedo_map"]["file"].startswith("sha256:")
    assert first["body"]["albedo_map"] != other["body"]["albedo_map"]
    assert stored_scene({"scene": first, "blocks": [4]}).body.albedo_map is not None
