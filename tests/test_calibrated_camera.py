"""A calibrated camera in a scene: rays, truth, Sun, stars, flares, blur and store are where OpenCV has them."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
import zarr
from calibrations_kit import SIX, opencv_pixels
from conftest import small_scene, verified_store
from numpy.typing import NDArray
from poses_kit import C_from_T, projected
from scipy.spatial.transform import Rotation
from test_calibration import KALIBR, ROS, YAML_1_0
from test_cli import run
from test_render import NODES, ball, box, join, scene, sun

from vbnfault import inject, render, store
from vbnfault.camera import Camera
from vbnfault.cli.options import SceneOptions
from vbnfault.core.calibration import Calibration
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import BODY, SUN, Electrons, SunInView
from vbnfault.core.sundisc import axes, pixel_sums, sunflower
from vbnfault.detect.navigation_scores import view_of
from vbnfault.detect.severity_labels import severity_level
from vbnfault.detector import ThreeColourDetector
from vbnfault.faults import FaultContext, Levels, from_dict
from vbnfault.faults.straylight import TextureStraylight, flare_centres_px
from vbnfault.faults.straylight_lens import TracedStraylight
from vbnfault.lens import Halo, RealLens, ThinLens, load_lens, scaled_to_field
from vbnfault.output.sample_files import annotated
from vbnfault.pipeline import simulate
from vbnfault.render.description import View
from vbnfault.scene import config
from vbnfault.world import ground
from vbnfault.world.sky import SkyFrame, StarCatalogue, star_radiance

F64 = NDArray[np.float64]

PITCH_UM = 5.5
HALF_M = 40.0
# The camera's axes in L, and its position: anything askew, so that no face of a box is seen at right angles.
L_FROM_C = Rotation.from_euler("xyz", [0.7, -0.4, 1.1]).as_matrix()
POSITION_M = np.array([6.0, -9.0, 4.0])


def seen_by(calibration: Calibration, **more: Any) -> View:
    return View(
        position_L_m=POSITION_M,
        L_from_C=L_FROM_C,
        intrinsics=calibration.intrinsics,
        width_px=calibration.width_px,
        height_px=calibration.height_px,
        projection=calibration,
        **more,
    )


def camera(calibration: Calibration, **lens: Any) -> Camera:
    width, height = calibration.width_px, calibration.height_px
    focal_mm = calibration.focal_length_px * PITCH_UM * 1e-3
    return Camera(
        lens=ThinLens(focal_length_mm=focal_mm, f_number=4.0, calibration=calibration, **lens),
        detector=ThreeColourDetector(width_px=width, height_px=height, pixel_pitch_um=PITCH_UM),
    )


@pytest.mark.parametrize("name", SIX)
def test_ground_is_in_the_frame_where_opencv_projects_it_there(name: str) -> None:
    calibration, rng = SIX[name], np.random.default_rng(4)
    table: Any = SimpleNamespace(
        width_px=calibration.width_px, height_px=calibration.height_px, frame_calibration=calibration
    )
    seen = ground.rays_C(table, np.linspace(0.02, 0.98, 9))
    points = np.concatenate([seen, seen + rng.normal(0, 0.3 * calibration.width_px / 96, seen.shape)])
    points = points[points[:, 2] > 0.05] * rng.uniform(1, 9, (np.count_nonzero(points[:, 2] > 0.05), 1))
    xy = opencv_pixels(calibration, points)
    size = np.array([calibration.width_px, calibration.height_px])
    inside = ((xy >= 0) & (xy <= size)).all(axis=1)
    holds = np.degrees(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])) < calibration.valid_to_deg
    assert np.count_nonzero(inside & holds) > 60
    np.testing.assert_array_equal(ground.in_frame(table, points)[holds], inside[holds])


@pytest.fixture(scope="module")
def room() -> render.TerrainMesh:
    """The inside of a box around the camera: planes all around it, known exactly."""
    return join(box(np.zeros(3), HALF_M))


def off_px(calibration: Calibration, points_C: F64, directions: F64) -> F64:
    """Return by how many pixels the rays missed their directions, float64[n], from where they met the room.

    A ray of length t that is off by the angle ε meets a plane at the distance t ε sin(incidence) from where the ray
    of its pixel does. Rays at less than 30° to the normal show nothing and are left out.
    """
    points_L = points_C @ L_FROM_C.T + POSITION_M
    face = np.argmax(np.abs(points_L), axis=1)
    each = np.arange(len(face))
    miss_m = np.abs(np.abs(points_L)[each, face] - HALF_M)
    cosine = np.abs((directions @ L_FROM_C.T)[each, face])
    good = cosine < np.cos(np.radians(30))
    angle = (miss_m / np.linalg.norm(points_C, axis=1) / np.sqrt(1 - cosine**2))[good]
    return np.asarray(angle / np.sqrt(calibration.solid_angle_sr(directions[good]) / np.abs(directions[good, 2])))


@pytest.mark.parametrize("name", SIX)
def test_truth_reprojects_through_opencv(name: str, room: render.TerrainMesh) -> None:
    """The points that depth and pixels give lie in the walls, and OpenCV projects them to their pixels' centres.

    Both errors together are at most 0.02 px rms and 0.05 px. The renderer's own table of directions, by which the
    light comes, agrees with the exact directions, by which truth comes.
    """
    calibration = SIX[name]
    directions = camera(calibration).seen_directions
    light, view = sun(np.array([0.3, 0.2, -1.0])), seen_by(calibration)
    for how in ({"directions": directions}, {}):
        depth = render.truth(room, view, light, **how).depth_m.astype(np.float64)
        points = (directions * (depth / directions[..., 2])[..., None]).reshape(-1, 3)
        rays = directions.reshape(-1, 3)
        ahead = rays[:, 2] > 0.01
        y, x = np.indices(depth.shape).reshape(2, -1) + 0.5
        off = np.hypot(*(opencv_pixels(calibration, points[ahead]) - np.column_stack([x, y])[ahead]).T)
        assert ahead.mean() > 0.7
        missed = off_px(calibration, points[ahead], rays[ahead])
        assert len(missed) > 0.3 * ahead.sum()
        for error in (off, missed):
            assert np.sqrt(np.mean(error**2)) <= 0.02
            assert error.max() <= 0.05
        # behind the camera too, which OpenCV does not know
        assert np.isfinite(depth).all()
        behind = rays[:, 2] < -0.01
        if behind.any():
            assert off_px(calibration, points[behind], rays[behind]).max() <= 0.05
            assert (depth.ravel()[behind] < 0).all()


@pytest.mark.parametrize("name", SIX)
def test_the_sun_is_where_opencv_projects_it(name: str) -> None:
    """Centroid and light of a disc of 2 px over the frame, against points of it that OpenCV projects.

    The points stand for equal solid angles; their centroid is exact to 1e-3 px, and so is that of pixels.
    """
    calibration = SIX[name]
    shape = calibration.height_px, calibration.width_px
    radius_rad = 2.0 / calibration.focal_length_px
    spread = np.sin(radius_rad) * sunflower(4096)
    points = np.column_stack([spread, np.sqrt(1 - (spread**2).sum(axis=1))])
    for fraction in ((0.2, 0.3), (0.5, 0.55), (0.93, 0.4)):
        xy = np.array(fraction) * shape[::-1]
        direction = calibration.directions_of(xy)
        if direction[2] < 0.1:
            continue
        np.testing.assert_allclose(camera(calibration).project(direction), xy, atol=1e-6)
        disc = SunInView(direction_C=direction, angular_radius_rad=radius_rad, radiance_W_m2_sr_nm=np.ones(1))
        sums = pixel_sums(disc, calibration, shape)
        assert sums is not None
        light = sums.on(shape)[0]
        rows, columns = np.indices(shape) + 0.5
        centroid = np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()
        of_points = points @ axes(direction)
        weight = points[:, 2] ** -1 * (of_points[:, 2] if calibration.foreshortens else 1.0)
        want = np.average(opencv_pixels(calibration, of_points), axis=0, weights=weight)
        assert np.hypot(*(centroid - want)) < 0.01
        facing = direction[2] if calibration.foreshortens else 1.0
        assert light.sum() == pytest.approx(np.pi * np.sin(radius_rad) ** 2 * facing)


def test_the_lens_admits_the_flux_of_its_pupil(room: render.TerrainMesh) -> None:
    """E☉ T A cos θ of a flat pupil, E☉ T A of a fisheye's, wherever the Sun is in the frame (`lens.thin`)."""
    for name in ("rational", "fisheye of 180"):
        calibration = SIX[name]
        c = camera(calibration)
        direction = calibration.directions_of([30.0, 20.0])
        view, light = seen_by(calibration), sun(L_FROM_C @ direction)
        radiance = render.radiance(join(box(np.array([0, 0, 300.0]), 1.0)), scene(view, light))
        assert radiance.sun is not None
        irradiance = c.lens.image_of_sun(replace(radiance, array=radiance.sun, sun=None), PITCH_UM)
        power = irradiance.array.sum(axis=(1, 2), dtype=float) * (PITCH_UM * 1e-3) ** 2
        pupil_mm2 = np.pi * (c.lens.aperture_radius_m * 1e3) ** 2
        facing = direction[2] if calibration.foreshortens else 1.0
        # the mean over a pixel of the disc's share times that pixel's solid angle at its centre: second order
        np.testing.assert_allclose(power / light.irradiance_W_m2_nm, pupil_mm2 * facing, rtol=5e-3)
        truth = render.truth(room, view, light)
        assert not (truth.semantic == SUN).any()  # the walls hide it


@pytest.mark.parametrize("name", SIX)
def test_stars_are_where_opencv_projects_them(name: str) -> None:
    calibration = SIX[name]
    xy = np.array([0.4, 0.7]) * (calibration.width_px, calibration.height_px)
    x, y, z = direction = calibration.directions_of(xy)
    one = {
        "right_ascension_deg": np.degrees(np.arctan2(y, x)),
        "declination_deg": np.degrees(np.arcsin(z)),
        "proper_motion_ra_mas_year": 0.0,
        "proper_motion_dec_mas_year": 0.0,
        "magnitude_V": 2.0,
        "colour_BV": 0.5,
    }
    frame = SkyFrame(
        J_from_C=np.eye(3),
        intrinsics=calibration.intrinsics,
        width_px=calibration.width_px,
        height_px=calibration.height_px,
        projection=calibration,
    )
    catalogue = StarCatalogue(**{key: np.array([value]) for key, value in one.items()})
    star = star_radiance(catalogue, frame, wavelength_nm=NODES, sigma_px=1.0)
    weight = star.radiance[0].astype(float)
    centroid = np.array([weight @ (star.columns + 0.5), weight @ (star.rows + 0.5)]) / weight.sum()
    # a Gaussian of 1 px, averaged over pixels and cut at 5 σ, keeps its centroid to 1e-5 px
    assert np.hypot(*(centroid - opencv_pixels(calibration, direction[None])[0])) < 1e-3


def context(calibration: Calibration, xy: tuple[float, float]) -> FaultContext:
    c = replace(camera(calibration), exposure_s=1e-4)
    direction = calibration.directions_of(xy)
    return FaultContext(
        camera=c,
        sun_xy_px=c.project(direction),
        sun_direction_C=direction,
        sun_visible_fraction=1.0,
        sun_angular_radius_rad=0.00465,
    )


def test_flares_lie_on_the_line_from_the_sun_to_the_principal_point() -> None:
    calibration = replace(SIX["brown"], cx=60.0, cy=33.0)
    where = context(calibration, (20.0, 60.0))
    flare = [{"index": 2, "position": position, "radius": 0.1, "brightness": 2.0} for position in (0, 1, 1.5)]
    params = TextureStraylight(flares=flare).draw(where, np.random.default_rng(0))
    assert where.sun_xy_px is not None
    centres = flare_centres_px(params, where.sun_xy_px)
    towards = calibration.directions_of([20.0, 60.0])[None]
    np.testing.assert_allclose(centres[0], opencv_pixels(calibration, towards)[0], atol=1e-6)
    np.testing.assert_allclose(centres[1], (60.0, 33.0))


def test_the_annotated_line_passes_the_principal_point() -> None:
    where = context(replace(SIX["brown"], cx=70.5, cy=30.5), (20.5, 60.5))
    flares = {"flares": [{"index": 1, "position": 9.0, "radius": 0.01}], "centre_xy_px": [70.5, 30.5]}
    black = np.zeros((*where.shape, 3), np.uint8)
    frame: Any = SimpleNamespace(
        spec=SimpleNamespace(faults=("straylight",)),
        images=SimpleNamespace(image=SimpleNamespace(array=black)),
        labels=SimpleNamespace(masks=[black[..., 0] > 0]),
        drawn={"straylight": flares},
        context=where,
        camera=where.camera,
    )
    assert annotated(frame, "straylight")[30, 70].min() > 200


def test_traced_straylight_turns_about_the_principal_point() -> None:
    """The same lens with its axis elsewhere in the frame makes the same light, moved with the axis."""
    middle = Calibration(width_px=96, height_px=80, fx=90.0, fy=90.0, cx=48.0, cy=40.0)
    moved = replace(middle, cx=58.0, cy=33.0)
    light = []
    for calibration in (middle, moved):
        where = context(calibration, (calibration.cx - 22.0, calibration.cy + 14.0))
        fault = TracedStraylight()
        params = fault.draw(where, np.random.default_rng(0))
        white = np.asarray(where.camera.detector.white_e)
        dark = Electrons(array=np.zeros((*where.shape, 3), np.float32), white_e=white)
        added = fault.on_light(replace(dark, past_rims=np.zeros_like(dark.array)), params, where).past_rims
        assert added is not None
        light.append(added)
        burst = np.unravel_index(np.argmax(added[..., 1]), added.shape[:2])
        assert where.sun_xy_px is not None
        # the starburst has a bright ring a pixel around the Sun
        assert np.hypot(burst[1] + 0.5 - where.sun_xy_px[0], burst[0] + 0.5 - where.sun_xy_px[1]) < 3
        ghosts = [(g["x_px"] - calibration.cx, g["y_px"] - calibration.cy) for g in params["ghosts"][:3]]
        along = np.array([-22.0, 14.0]) / np.hypot(22, 14)
        # ghosts of a lens with rotational symmetry lie in the plane of the Sun and the axis
        assert np.abs([x * along[1] - y * along[0] for x, y in ghosts]).max() < 0.1
    inner = light[0][7:, :86], light[1][:73, 10:96]
    # the rays that draw a ghost depend on the size of the frame, and so does the noise of its bright edges
    assert (np.abs(inner[1] - inner[0]) < 0.02 * inner[0]).mean() > 0.9


def test_the_severity_of_vignetting_is_that_of_the_frame() -> None:
    """A level sets the mean over the frame, and the drawn parameters give that level again."""
    where, table = context(SIX["fisheye of 180"], (20.0, 60.0)), Levels().table
    fault = from_dict("vignetting", {"model": "cos4", "severity": 4}, source="test")
    params = {"model": "cos4", **fault.draw(where, np.random.default_rng(0))}
    focal_px = where.camera.focal_length_px
    assert severity_level("vignetting", params, where.shape, focal_px, table) == pytest.approx(4)


def test_a_stored_skew_counts_where_navigation_projects() -> None:
    calibration = SIX["fisheye"]
    spec = SimpleNamespace(distortion_model="fisheye", distortion_valid_to_deg=None, skew_px=calibration.skew)
    scalars = {"intrinsics": calibration.intrinsics, "distortion": np.array(calibration.coefficients)}
    scalars |= {"camera_from_T": np.array([1.0, 0, 0, 0]), "camera_position_T_m": np.zeros(3)}
    view = view_of(spec, {name: value[None] for name, value in scalars.items()}, 0, None)  # type: ignore[arg-type]
    point = np.array([[0.3, 0.5, 1.0]])
    np.testing.assert_allclose(view.project(point), opencv_pixels(calibration, point), atol=1e-9)


def test_the_thin_lens_still_blurs(room: render.TerrainMesh) -> None:
    """Depth of field in the rays, and the point spread in the image; both keep the mean of the light."""
    calibration = SIX["fisheye"]
    light = sun(L_FROM_C[:, 2] + np.array([0.1, 0.2, 0.1]))
    sharp = render.radiance(room, scene(seen_by(calibration), light, spp=64))
    # the room's walls shade it: light comes from a plane beyond the camera instead
    slab = join(box(np.array([0.0, 0, 60.0]), 20.0), box(np.array([30.0, -45.0, 25.0]), 12.0))
    views = [seen_by(calibration), seen_by(calibration, aperture_radius_m=6.0, focus_distance_m=400.0)]
    images = [render.radiance(slab, scene(v, light, spp=64)).array.mean(axis=0) for v in views]
    assert sharp.array.shape == (len(NODES), 80, 96)
    steps = [np.abs(np.diff(image, axis=1)).max() for image in images]
    assert images[0].any()
    assert steps[1] < 0.7 * steps[0]
    assert images[1].mean() == pytest.approx(images[0].mean(), rel=0.05)
    halo = Halo(core_rad=2.0 / calibration.focal_length_px, halo_fraction=0.0, halo_rad=1.0, halo_index=3.0)
    blurred = camera(calibration, halo=halo, pixel_rad=1 / calibration.focal_length_px).lens
    radiance = render.radiance(slab, scene(views[0], light, spp=4))
    plain, spread = (lens.image(radiance).array for lens in (camera(calibration).lens, blurred))
    assert spread.sum(dtype=float) == pytest.approx(plain.sum(dtype=float), rel=1e-4)
    assert np.abs(np.diff(spread, axis=2)).max() < 0.5 * np.abs(np.diff(plain, axis=2)).max()


# --- scenes


TABLES: dict[str, dict[str, Any]] = {
    "opencv": {
        "model": "opencv",
        "fx": 80.0,
        "fy": 80.5,
        "cx": 49.0,
        "cy": 37.5,
        "k1": -0.28,
        "k2": 0.1,
        "p1": 1e-3,
        "p2": -7e-4,
        "k3": -0.02,
        "s1": 1e-3,
    },
    "fisheye": {"model": "fisheye", "fx": 30.0, "cx": 47.5, "cy": 39.5, "k1": 0.004, "k2": -0.0002},
}


def with_calibration(calibration: dict[str, Any], **tables: Any) -> dict[str, Any]:
    table = small_scene(**tables)
    table["camera"] = {"width_px": 96, "height_px": 80, "calibration": calibration, **tables.get("camera", {})}
    return table


@pytest.fixture(scope="module", params=TABLES)
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small verified store of a calibrated camera, with faults of every kind, stars, bounces and a spacecraft."""
    layers = ["clean", "depth_m", "semantic", "point_T_m", "normal", "radiance"]
    table = with_calibration(
        TABLES[request.param],
        dataset={"samples": 2, "sites": 1, "layers": layers},
        render={"samples_per_pixel": 4, "bounces": 1},
        sky={"stars": "on"},
        spacecraft={"model": "default"},
        plan={"faulty_fraction": 1.0, "on_invisible": "drop"},
        geometry={"sun_averted": {"reference": "nadir", "roll_deg": [-40, 40], "pitch_deg": [-40, 40]}},
    )
    table["faults"] = {
        "straylight": {"model": "traced"},
        "vignetting": {},
        "dust_on_optics": {"model": "defocused"},
        "particles": {},
    }
    out = tmp_path_factory.mktemp(request.param) / "store.zarr"
    verified_store(table, out, threads=2)
    return out


def test_a_store_keeps_the_calibration(built: Path) -> None:
    """Intrinsics, coefficients with their names, model and skew; stored points reproject through them by OpenCV."""
    group = zarr.open_group(built, mode="r")
    attributes = dict(group["distortion"].attrs)
    is_fisheye = attributes["model"] == "fisheye"
    names = [str(name) for name in group["coefficient"][:]]
    table = TABLES[attributes["model"]]
    assert len(names) == (4 if is_fisheye else 12)
    assert dict(zip(names, group["distortion"][0].tolist(), strict=True)) == {n: table.get(n, 0.0) for n in names}
    fx, fy, cx, cy = group["intrinsics"][0].tolist()
    assert (fx, fy) == (table["fx"], table.get("fy", table["fx"]))
    assert (cx, cy) == (table["cx"] + 0.5, table["cy"] + 0.5)
    assert group["intrinsics"].attrs["skew_px"] == 0
    assert attributes["residual_px_max"] == 0
    for i in range(2):
        seen = group["semantic"][i] == BODY
        points = (group["point_T_m"][i][seen] - group["camera_position_T_m"][i]) @ C_from_T(group, i).T
        ahead = points[:, 2] > 0.01 * np.linalg.norm(points, axis=1)
        rows, columns = np.nonzero(seen)
        off = np.hypot(*(projected(group, i, points[ahead]) - np.column_stack([columns, rows])[ahead] - 0.5).T)
        assert ahead.sum() > 1000
        assert np.sqrt(np.mean(off**2)) <= 0.02
        assert off.max() <= 0.05


def test_the_scene_of_a_store_holds_the_numbers(built: Path) -> None:
    opened = store.open_dataset(built)
    kept = opened.attrs["scene"]["camera"]["calibration"]
    assert kept["fx"] == TABLES[kept["model"]]["fx"]
    assert kept["file"] == ""
    lines = (built / "README.md").read_text().splitlines()  # a fisheye's field may be wider than fov_deg can be
    assert sum("| of the calibration, at most 140 |" in line for line in lines if "camera.fov_deg" in line) == 1


FILES = {"camera_info.yaml": (ROS, {}), "chain.yaml": (KALIBR, {"camera": "cam0"}), "cv.yml": (YAML_1_0, {})}


@pytest.mark.parametrize("name", FILES)
def test_files_give_a_scene_the_rays_of_their_numbers(tmp_path: Path, name: str) -> None:
    text, options = FILES[name]
    path = tmp_path / name
    path.write_text(text)
    table = with_calibration({"file": str(path), **options}, camera={"width_px": 1024, "height_px": 768})
    camera_table = config.parse_scene(table, source="test").camera
    in_numbers = {
        "fx": 900.0,
        "fy": 905.0,
        "cx": 520.3,
        "cy": 371.2,
        "k1": -0.28,
        "k2": 0.1,
        "p1": 1e-3,
        "p2": -7e-4,
    }
    table["camera"]["calibration"] = in_numbers
    other = config.parse_scene(table, source="test").camera
    assert camera_table.frame_calibration == other.frame_calibration
    assert camera_table.fov_deg == other.fov_deg == pytest.approx(other.frame_calibration.fov_deg)  # type: ignore[union-attr]
    # without the file: a store's scene is read again
    path.unlink()
    again = config.parse_scene(config.parse_scene(table, source="test").resolved(), source="test").camera
    assert again.frame_calibration == camera_table.frame_calibration


def test_a_calibration_is_scaled_only_when_asked() -> None:
    calibration = {**TABLES["opencv"], "width_px": 192, "height_px": 160, "fx": 160.0, "fy": 161.0}
    calibration |= {"cx": 98.5, "cy": 75.5}
    with pytest.raises(
        InputError, match=r"camera.calibration: is of an image of 192 x 160 px, and the camera has 96"
    ):
        config.parse_scene(with_calibration(calibration), source="test")
    scaled = config.parse_scene(with_calibration({**calibration, "scale_to_frame": True}), source="test")
    found = scaled.camera.frame_calibration
    assert found is not None
    np.testing.assert_allclose(found.intrinsics, np.array([160.0, 161.0, 99.0, 76.0]) / 2)


def test_faults_strike_an_own_image_of_a_calibrated_camera(tmp_path: Path) -> None:
    """The frame has the size of the file's image, and the Sun's pixel its direction by the calibration."""
    path = tmp_path / "cameras.txt"
    path.write_text("1 OPENCV 96 80 80 80.5 49.5 38 -0.28 0.1 0.001 -0.0007\n")
    grey = np.full((80, 96), 60, np.uint8)
    known = {"camera": {"calibration": {"file": str(path)}, "exposure_s": 0.01}, "sun": (20.0, 30.0)}
    result = inject(grey, {"straylight": {"model": "texture"}}, **known)
    assert result.camera.lens.calibration == Calibration.read(path)
    assert result.sun_xy_px == pytest.approx((20.0, 30.0), abs=1e-9)
    assert result.injected.all()
    assert not any("fov_deg" in text for text in result.assumptions)
    with pytest.raises(InputError, match="is of an image of 96 x 80 px, and the camera has 96 x 96 px"):
        inject(np.full((96, 96), 60, np.uint8), {"straylight": {}}, **known)


def test_a_preview_with_fewer_pixels_sees_the_same_field(tmp_path: Path) -> None:
    """Also where the numbers of a scene name no size: they are those of its frame."""
    path = tmp_path / "scene.toml"
    path.write_text(tomli_w.dumps(with_calibration(TABLES["opencv"])))
    whole, half = (SceneOptions(scale=scale).load(str(path)).camera for scale in (1.0, 0.3))
    assert (half.width_px, half.height_px) == (29, 24)
    assert half.fov_deg == pytest.approx(whole.fov_deg, rel=1e-9)
    assert half.frame_calibration is not None
    assert half.frame_calibration.fx == pytest.approx(80 * 29 / 96)


@pytest.mark.parametrize(
    ("calibration", "camera_keys", "message"),
    [
        ({}, {"lens": "nikkor_28_f2p8"}, "calibration: camera.lens = 'nikkor_28_f2p8' has its own distortion"),
        ({}, {"focal_length_mm": 8.0}, "focal_length_mm = 8: the calibration has its own; leave one out"),
        ({}, {"fov_deg": 20.0}, r"fov_deg = 20: the calibration has a field of 6\d\.\d+ deg; leave fov_deg out"),
        ({"k1": -2.0}, {}, r"calibration: the opencv polynomial folds back \d+\.\d px from the principal point"),
        ({"model": "omni"}, {}, "camera.calibration.model = 'omni': must be"),
        ({"fx": None}, {}, "fx: is missing; give fx, cx and cy, or file"),
        ({"fx": -1.0}, {}, r"camera.calibration.fx = -1.0: must be a number from 0.001"),
        ({"model": "fisheye"}, {}, "p1 = 0.001: the model fisheye has k1, k2, k3, k4"),
        ({"model": "brown_conrady"}, {}, "sense = '': must be distorting or undistorting"),
        ({"sense": "undistorting"}, {}, "sense = 'undistorting': must be distorting or undistorting with model"),
        ({"camera": "cam0"}, {}, "camera = 'cam0': chooses a camera of a file; needs file"),
        ({"file": "camera.yaml"}, {}, "fx: comes from the file; leave it or file out"),
        (
            {"file": "camera.yaml", "origin": "pixel_corner"},
            {},
            "origin: comes from the file; leave it or file out",
        ),
    ],
)
def test_a_wrong_table_is_refused_in_one_sentence(
    calibration: dict[str, Any], camera_keys: dict[str, Any], message: str
) -> None:
    table = {k: v for k, v in {**TABLES["opencv"], **calibration}.items() if v is not None}
    with pytest.raises(InputError, match=message) as raised:
        config.parse_scene(with_calibration(table, camera=camera_keys), source="test")
    assert "\n" not in f"{raised.value}"


def test_light_from_around_the_frame_is_refused() -> None:
    table = with_calibration(TABLES["opencv"])
    table["faults"] = {"straylight": {"model": "traced", "sources": "scene"}}
    with pytest.raises(InputError, match=r"rectilinear cameras only; leave camera.calibration out"):
        config.configure_faults(config.parse_scene(table, source="test"))


@pytest.mark.parametrize("sense", ["distorting", "undistorting"])
def test_the_sense_of_brown_and_conrady_counts(sense: str) -> None:
    numbers = {key: value for key, value in TABLES["opencv"].items() if key != "model"}
    table = with_calibration({**numbers, "model": "brown_conrady", "sense": sense})
    found = config.parse_scene(table, source="test").camera.frame_calibration
    assert found is not None
    assert found.model == {"distorting": "opencv", "undistorting": "undistorting"}[sense]
    # k1 < 0: barrel where the polynomial distorts, so the corner sees farther than a pinhole's; else pincushion
    corner = found.directions_of([0.0, 0.0])
    farther = np.hypot(*corner[:2]) / corner[2] > np.hypot(found.cx / found.fx, found.cy / found.fy)
    assert farther == (sense == "distorting")


def test_beyond_the_image_circle_the_frame_is_dark() -> None:
    """The polynomial turns back at 1 / sqrt(-3 k1) rad, 44.8 px from the axis: in the frame, beyond the circle."""
    fisheye = {"model": "fisheye", "fx": 26.0, "cx": 47.5, "cy": 39.5, "k1": -0.05}
    with pytest.raises(InputError, match=r"folds back 44.8 px .* its corner lies 62.5 px away; .* circle_deg"):
        config.parse_scene(with_calibration(fisheye), source="test")
    with pytest.raises(InputError, match=r"folds back 44.8 px .* the rim of its image circle lies 4\d.\d px away"):
        config.parse_scene(with_calibration({**fisheye, "circle_deg": 320.0}), source="test")
    with pytest.raises(InputError, match=r"circle_deg = 185: must be below 180 for the model opencv"):
        config.parse_scene(with_calibration({**TABLES["opencv"], "circle_deg": 185.0}), source="test")
    nadir = {"reference": "nadir", "roll_deg": [-20, 20], "pitch_deg": [-20, 20], "sun_elevation_deg": [30, 60]}
    table = with_calibration(
        {**fisheye, "circle_deg": 190.0},
        dataset={"samples": 1, "sites": 1, "layers": ["clean", "depth_m", "semantic"]},
        geometry={"sun_averted": nadir, "sun_facing": nadir},
    )
    table["faults"] = {}
    parsed = config.parse_scene(table, source="test")
    sample, found = simulate(parsed, 0), parsed.camera.frame_calibration
    assert found is not None
    assert found.valid_to_deg == found.field_deg == 95.0
    angle = np.radians(95)
    y, x = np.indices((80, 96)) + 0.5
    dark = np.hypot(x - 48, y - 40) > 26 * angle * (1 - 0.05 * angle**2)
    semantic, clean = sample.layers["semantic"], sample.layers["clean"][..., 3].astype(float)
    assert (semantic[dark] == 0).all()
    assert np.isinf(sample.layers["depth_m"][dark]).all()
    assert (semantic[~dark] == BODY).mean() > 0.5
    assert clean[dark].max() < 8  # noise
    assert clean[~dark & (semantic == BODY)].mean() > 40


def test_a_lens_is_printed_as_a_calibration_with_its_residual(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The printed table is one of a scene, and takes directions where the chief rays of the lens go."""
    frame = ["--width-px", 96, "--height-px", 80]
    out = ["--out", tmp_path / "lens.png"]
    assert run(monkeypatch, "lens", "nikkor_28_f2p8", "--fov-deg", 62.0, "--fit-opencv", *frame, *out) == 0
    printed = capsys.readouterr().out
    text = printed[printed.index("[camera.calibration]") :]
    found = re.search(r"residual over the lit frame: ([\d.]+) px rms, ([\d.]+) px at most", text)
    assert found is not None
    assert float(found[1]) <= float(found[2]) <= 0.02
    table = tomllib.loads(text[: text.index("#")])["camera"]["calibration"]
    calibration = config.parse_scene(with_calibration(table), source="test").camera.frame_calibration
    assert calibration is not None
    lens = RealLens(
        prescription=scaled_to_field(load_lens("nikkor_28_f2p8"), 62.0, 96 * PITCH_UM * 1e-3),
        width_px=96,
        height_px=80,
        pixel_pitch_um=PITCH_UM,
    )
    xy = np.array([[0.5, 0.5], [90.0, 40.0], [30.0, 70.0]])
    rays = calibration.directions_of(xy)
    heights = lens.distorted(np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]) * lens.focal_length_px
    # the lens's own map is a table of 4097 slopes, off by 1e-3 px
    np.testing.assert_allclose(heights, np.hypot(*(xy - (48, 40)).T), atol=2e-3)


# --- beside the rectilinear camera


def rectilinear_twin(table: dict[str, Any], calibration: dict[str, float]) -> list[Any]:
    """Return sample 0 of a scene, taken by a camera of the field 2 arctan(48 / 80) and by a calibrated one."""
    plain = {"width_px": 96, "height_px": 80, "fov_deg": float(np.degrees(2 * np.arctan(0.6)))}
    calibrated = {**plain, "calibration": {"fx": 80.0, "cx": 47.5, "cy": 39.5, **calibration}}
    del calibrated["fov_deg"]
    return [simulate(config.parse_scene({**table, "camera": c}, source="test"), 0) for c in (plain, calibrated)]


def test_without_coefficients_the_image_is_that_of_the_plain_camera() -> None:
    """Every effect of a scene at once. The rays come from a table in float32, which turns them by 1e-7; where they
    pass an edge, a sample of a pixel changes."""
    table = small_scene(
        dataset={"samples": 1, "sites": 1, "layers": ["clean", "depth_m", "semantic", "radiance"]},
        render={"samples_per_pixel": 4, "bounces": 1},
        sky={"stars": "on"},
        coma={"afrho_cm": 1200.0},
        spacecraft={"model": "default"},
        plan={"faulty_fraction": 1.0, "on_invisible": "drop"},
    )
    table["faults"] = {
        "straylight": {"model": "traced"},
        "vignetting": {"model": "lens"},
        "dust_on_optics": {"model": "defocused"},
        "particles": {},
    }
    plain, calibrated = rectilinear_twin(table, {})
    for name in ("image", "clean"):
        one, other = (sample.layers[name].astype(float) for sample in (plain, calibrated))
        assert one.std() > 10
        assert np.abs(one - other).mean() < 0.02
    np.testing.assert_array_equal(plain.layers["semantic"], calibrated.layers["semantic"])
    np.testing.assert_allclose(calibrated.layers["depth_m"], plain.layers["depth_m"], rtol=1e-4)
    light = [sample.layers["radiance"].astype(float) for sample in (plain, calibrated)]
    assert np.abs(light[0] - light[1]).mean() < 1e-3 * light[0].mean()
    np.testing.assert_allclose(calibrated.scalars["sun_xy_px"], plain.scalars["sun_xy_px"], atol=1e-9)


def test_opencv_undistorts_the_image_to_that_of_the_plain_camera() -> None:
    """To 0.03 px in every quarter, by the least-squares shift along the image's gradient (Lucas & Kanade 1981);
    the image before is off by half a pixel and more."""
    nadir = {"reference": "nadir", "roll_deg": [-20, 20], "pitch_deg": [-20, 20], "sun_elevation_deg": [30, 60]}
    table = small_scene(
        dataset={"samples": 1, "sites": 1, "layers": ["clean", "radiance"]},
        render={"samples_per_pixel": 64},
        geometry={"sun_averted": nadir, "sun_facing": nadir},
    )
    table["faults"] = {}
    coefficients = {"k1": -0.35, "k2": 0.14, "p1": 5e-3, "p2": -5e-3}
    plain, calibrated = (s.layers["radiance"][4].astype(float) for s in rectilinear_twin(table, coefficients))
    matrix = np.array([[80.0, 0, 47.5], [0, 80.0, 39.5], [0, 0, 1]])
    undistorted = cv2.undistort(calibrated, matrix, np.array([*coefficients.values()]))
    for image, is_undone in ((undistorted, True), (calibrated, False)):
        down, across = np.gradient((plain + image) / 2)
        for y, x in ((12, 12), (12, 48), (40, 12), (40, 48)):
            part = slice(y, y + 28), slice(x, x + 36)
            columns = np.column_stack([across[part].ravel(), down[part].ravel(), np.ones(28 * 36)])
            shift = np.linalg.lstsq(columns, (plain - image)[part].ravel(), rcond=None)[0][:2]
            assert np.hypot(*shift) < 0.03 if is_undone else np.hypot(*shift) > 0.5


@pytest.mark.parametrize(("name", "xy"), [("fisheye", (28.4, 55.7)), ("fisheye", (93.2, 71.4))])
def test_a_body_smaller_than_a_pixel_is_where_opencv_projects_it(name: str, xy: tuple[float, float]) -> None:
    """Its light and its class; the light is that of the same body before a rectilinear camera.

    In the corner of the frame, the rectilinear camera would have it outside of a frame of this size.
    """
    calibration = SIX[name]
    direction = calibration.directions_of(xy)
    far = ball(5.0, subdivisions=4, centre=POSITION_M + 3000 * L_FROM_C @ direction)
    light = sun(-L_FROM_C @ direction + 0.3 * L_FROM_C[:, 0])
    view = seen_by(calibration)
    wide = np.array([0, 0, 300.0, 300.0]) + calibration.intrinsics
    pinhole = replace(view, projection=None, intrinsics=wide, width_px=696, height_px=680)
    images = [render.radiance(far, scene(v, light)) for v in (view, pinhole)]
    assert images[0].fine is not None
    sums = [image.array[4].astype(float).sum() for image in images]
    rows, columns = np.nonzero(images[0].array[4])
    want = opencv_pixels(calibration, direction[None])[0]
    assert (rows.mean() + 0.5, columns.mean() + 0.5) == pytest.approx((want[1], want[0]), abs=1)
    solid = [v.pixel_map.solid_angle_sr(direction) for v in (view, pinhole)]
    facing = 1 / direction[2]  # a fisheye's pupil turns
    assert sums[0] * solid[0] == pytest.approx(sums[1] * solid[1] * facing, rel=2e-2)
