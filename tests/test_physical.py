"""The physical scene: truth on its pixels, spacecraft, stars, samples to the sensor's noise, finest relief."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import small_scene
from scipy.spatial.transform import Rotation
from test_render import NODES, UP, CountedScene, join, plane, scene, sun, view

from vbnfault import render
from vbnfault.core import frames
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import BODY, SKY, SPACECRAFT
from vbnfault.pipeline import Session
from vbnfault.pipeline.exposure import add_stars, meter
from vbnfault.pipeline.noise_budget import green_per_second
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.rendering import describe, render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import Frame
from vbnfault.render.detail import _LEVELS, _SIDE, _UNIT, _pyramid
from vbnfault.render.runtime import mi
from vbnfault.render.surface import World
from vbnfault.scene import config
from vbnfault.world import assemble, ephemeris, sky

TRUTH = ["depth_m", "normal", "semantic", "point_T_m", "incidence_deg", "emission_deg", "phase_deg", "albedo"]


def physical(**tables: dict[str, object]) -> dict[str, object]:
    base = small_scene(
        body={"photometry": {"model": "hapke", "dust_contrast": 0.16}},
        dataset={"layers": ["clean", "without_straylight", *TRUTH]},
        render={"samples_per_pixel": 16, "bounces": 1},
        camera={"width_px": 96, "height_px": 96},
        spacecraft={"model": "default"},
    )
    for name, table in tables.items():
        base[name] = {**base.get(name, {}), **table}
    return base


def session(**tables: dict[str, object]) -> Session:
    return Session(config.parse_scene(physical(**tables), source="test"))


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """The matrix of a unit quaternion, w first."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


@pytest.fixture(scope="module")
def samples() -> tuple[Session, list[Frame]]:
    s = session()
    return s, [s.frame(i) for i in range(6)]


def test_the_relief_below_the_facets_follows_the_exponent_of_the_patch() -> None:
    """On a self-affine surface, slopes over the length L vary as L to the power of the exponent minus 1.

    Below 5 m the exponent is at least that of the model.
    """
    fine = {}
    for hurst in (0.4, 0.9):
        s = session(patch={"relief": 0.05, "hurst": hurst})  # so low that no slope reaches its limit
        fine[hurst] = s.surface(s.patch(s.sites[0])).fine
        assert fine[hurst].hurst == max(hurst, s.body.roughness.hurst)
    law, length_m = s.body.roughness, fine[0.4].longest_m / 4
    assert fine[0.4].slope / fine[0.9].slope == pytest.approx(
        (max(length_m, 5.0) / law.baseline_m) ** -0.5, rel=1e-6
    )


def test_truth_angles_are_those_of_the_points(samples: tuple[Session, list[Frame]]) -> None:
    _, all_frames = samples
    for frame in all_frames:
        sample = to_sample(frame)
        on = sample.layers["semantic"] == BODY
        if not on.any():
            continue
        C_from_T = rotation(sample.scalars["camera_from_T"])
        sun_C = C_from_T @ sample.scalars["sun_direction_T"]
        towards = -((sample.layers["point_T_m"][on] - sample.scalars["camera_position_T_m"]) @ C_from_T.T)
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        normal = sample.layers["normal"][on].astype(float)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        for name, a, b in (
            ("incidence_deg", normal, sun_C[None]),
            ("emission_deg", normal, towards),
            ("phase_deg", towards, sun_C[None]),
        ):
            expected = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))
            # normals are stored with half precision: 5e-4 of a radian in each of three entries
            atol = 1e-3 if name == "phase_deg" else 0.1
            np.testing.assert_allclose(sample.layers[name][on], expected, atol=atol)
        albedo = sample.layers["albedo"][on]
        bare_ground = dataclasses.replace(frame.rendering.truth, dust=np.zeros(1, np.float32), material=None)
        bare = assemble.normal_albedo(frame.spec.scene, bare_ground)[0]
        assert albedo.min() >= bare * (1 - 1e-5)
        assert albedo.max() <= bare * 1.16 * (1 + 1e-5)


def test_spacecraft_is_in_its_own_pictures(samples: tuple[Session, list[Frame]]) -> None:
    s, all_frames = samples
    assert s.vehicle is not None
    height, width = all_frames[0].context.shape
    camera = s.base_camera
    x = (np.arange(width) + 0.5 - width / 2) / camera.focal_length_px
    y = (np.arange(height) + 0.5 - height / 2) / camera.focal_length_px
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1).reshape(-1, 3)
    blocked = s.vehicle.blocked(rays / np.linalg.norm(rays, axis=1)[:, None]).reshape(height, width)
    assert blocked.any()
    for frame in all_frames:
        np.testing.assert_array_equal(
            frame.rendering.truth.semantic == 3, blocked & (frame.rendering.truth.semantic == 3)
        )
        # ground may lie before a footpad, nothing else may hide one
        hidden = blocked & (frame.rendering.truth.semantic != 3)
        assert (frame.rendering.truth.semantic[hidden] == BODY).all()


def test_albedo_on_the_spacecraft_is_that_of_its_material(samples: tuple[Session, list[Frame]]) -> None:
    """The reflectance of the facet that each pixel's ray meets first, by a float64 search over all facets."""
    s, all_frames = samples
    mesh = s.vehicle
    assert mesh is not None
    sample = next(to_sample(f) for f in all_frames if (f.rendering.truth.semantic == SPACECRAFT).any())
    rows, columns = np.nonzero(sample.layers["semantic"] == SPACECRAFT)
    fx, fy, cx, cy = sample.scalars["intrinsics"]
    rays = np.column_stack([(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones(len(rows))])
    corners = mesh.vertices_B_m[mesh.faces].astype(float)
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(rays[:, None], c[None])
    det = np.einsum("fk,rfk->rf", b, across)
    with np.errstate(divide="ignore", invalid="ignore"):  # facets seen edge on
        u = np.einsum("fk,rfk->rf", -a, across) / det
        v = np.einsum("rk,fk->rf", rays, np.cross(-a, b)) / det
        z = np.einsum("fk,fk->f", c, np.cross(-a, b)) / det
    z[~((u >= 0) & (v >= 0) & (u + v <= 1) & (z > 0))] = np.inf
    nodes = ephemeris.wavelengths_nm(s.scene)
    near = int(np.argmin(np.abs(nodes - 649.0)))
    expected = mesh.reflectance(nodes)[mesh.face_material[z.argmin(axis=1)], near]
    got = sample.layers["albedo"][rows, columns]
    # the layer is float32; a ray on the border of two parts may fall to either
    assert (np.abs(got - expected) < 1e-6).mean() > 0.98
    assert len(np.unique(got)) > 1


def test_spacecraft_casts_its_shadow() -> None:
    plate = np.array([[-1, -1, -5], [1, -1, -5], [1, 1, -5], [-1, 1, -5]], np.float32)  # 5 m behind the camera
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    vehicle = render.Vehicle(plate, faces, np.zeros(2, np.int32), np.full((1, len(NODES)), 0.5))
    vertices, ground = plane()
    surface = render.TerrainMesh(vertices, ground, np.ones(2, bool), vehicle=vehicle)
    # looking straight down from 10 m with the Sun at the zenith: the plate's shadow is its own size, 2 m
    a_view, light = view(10 * UP, -UP, width=128, fov_deg=40.0), sun(UP, 2.0)
    image = render.radiance(surface, scene(a_view, light, 0.06)).array[4]
    dark = image < 0.5 * image.max()
    side_px = 2.0 * a_view.intrinsics[0] / 10
    # half light lies on the geometric edge; a pixel's width of it may fall either way
    assert np.sqrt(dark.sum()) == pytest.approx(side_px, abs=1.0)
    rows, columns = np.nonzero(dark)
    assert rows.mean() + 0.5 == pytest.approx(64, abs=0.5)
    assert columns.mean() + 0.5 == pytest.approx(64, abs=0.5)


@pytest.mark.parametrize("look", [-UP, np.array([1.0, 0.0, 0.6])])
def test_only_rays_that_may_meet_the_spacecraft_search_for_it(
    monkeypatch: pytest.MonkeyPatch, look: np.ndarray
) -> None:
    """A plate in the corner of the view and one behind the camera: the same bits with a tenth of the rays."""
    behind = np.array([[-1, -1, -5], [1, -1, -5], [1, 1, -5], [-1, 1, -5]])
    ahead = np.array([[0.5, 0.5, 2], [1.5, 0.5, 2], [1.5, 1.5, 2.5], [0.5, 1.5, 2.5]])
    vertices = np.concatenate([behind, ahead]).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    a_view = view(40 * UP, look, width=64, fov_deg=40.0, aperture_radius_m=1e-3)
    lit = dataclasses.replace(scene(a_view, sun(UP, 2.0), 0.06), bounces=1)
    images, rays = [], []
    for culled in (True, False):
        vehicle = render.Vehicle(vertices, faces, np.zeros(4, np.int32), np.full((1, len(NODES)), 0.5))
        vehicle.scene = counted = CountedScene(vehicle.scene)
        if not culled:
            monkeypatch.setattr(World, "_may_meet", lambda self, rays: mi.Bool(True) & (rays.o.x == rays.o.x))
            monkeypatch.setattr(vehicle, "slopes_in", lambda view: np.array([[-9.0, -9.0], [9.0, 9.0]]))
        surface = render.TerrainMesh(*plane(), np.ones(2, bool), vehicle=vehicle)
        images.append(render.radiance(surface, lit).array)
        rays.append(counted.rays)
    np.testing.assert_array_equal(*images)
    assert images[0].std() > 0
    assert 0 < rays[0] < 0.35 * rays[1]


def test_stars_fall_where_the_catalogue_says() -> None:
    table = physical(
        sky={"stars": "on", "limiting_magnitude": 3.0, "sigma_px": 0.7},
        camera={"exposure_s": 2.0, "fov_deg": 60.0, "width_px": 256, "height_px": 256},
        spacecraft={"model": "none"},
        plan={"faulty_fraction": 0.0},
    )
    s = Session(config.parse_scene(table, source="test"))
    checked = 0
    for i in range(8):
        frame = s.frame(i)
        sample = to_sample(frame)
        J_from_C = sample.scalars["T_from_J"].T @ rotation(sample.scalars["camera_from_T"]).T
        bright = sky.load_catalogue().brighter_than(2.0)
        in_C = bright.direction_J(s.scene.sun.julian_date) @ J_from_C
        for direction in in_C[in_C[:, 2] > 0.3]:
            xy = frame.camera.project(direction)
            assert xy is not None
            column, row = np.floor(xy).astype(int)
            if not (4 <= column < 252 and 4 <= row < 252):
                continue
            window = np.s_[row - 3 : row + 4, column - 3 : column + 4]
            if (frame.rendering.truth.semantic[window] != SKY).any():
                continue
            light = frame.exposure.light.on_image.array[4][window].astype(float)
            y, x = np.mgrid[-3:4, -3:4] + 0.5
            centroid = np.array([(light * x).sum(), (light * y).sum()]) / light.sum() + [column, row]
            np.testing.assert_allclose(centroid, xy, atol=0.05)  # other stars of V < 3 may shine into the window
            checked += 1
    assert checked >= 3


def test_noise_of_sampling_stays_below_the_sensors() -> None:
    """Error against a converged render, not the estimate: below the fraction in 99 % of the lit pixels."""
    table = physical(
        render={"samples_per_pixel": 16, "bounces": 0, "noise_fraction": 0.3, "max_samples_per_pixel": 4096},
        spacecraft={"model": "none"},
        camera={"width_px": 64, "height_px": 64},
        dataset={"layers": ["clean", "without_straylight"]},
    )
    s = Session(config.parse_scene(table, source="test"))
    judged = 0
    for i in range(10):
        spec = s.spec(i)
        pose = resolve(spec)
        rendering = render_view(spec, pose)
        exposure = add_stars(spec, pose, rendering, meter(spec, rendering))
        camera, light = exposure.camera, exposure.light.on_image
        described = dataclasses.replace(describe(spec, pose), samples_per_pixel=4096, key=99)
        converged = render.direct(spec.terrain.surface, described)
        to_e = camera.exposure_s * green_per_second(spec)
        signal, error = (np.einsum("b,byx->yx", to_e, a) for a in (converged.array, light.array))
        detector = camera.detector
        sensor = np.sqrt(signal + detector.read_noise_e_rms**2 + detector.dark_current_e_s * camera.exposure_s)
        lit = (signal > 0.01 * detector.full_well_e) & (signal < 0.9 * detector.full_well_e)
        if lit.sum() < 200:
            continue
        judged += 1
        share = np.abs(error - signal)[lit] / sensor[lit]
        # the fraction is a standard deviation: two thirds of the errors lie within it, so ask that those of the
        # 99 % whose deviation is allowed to reach it exceed three of it in no more than another 1 %
        assert np.mean(share > 3 * 0.3) < 0.02
        assert rendering.samples_per_pixel > 16
        if judged == 3:
            break
    assert judged == 3


def test_finest_relief_has_its_slopes_and_fades_into_the_pixel() -> None:
    table, start = np.array(_pyramid()), 0
    rms = []
    for level in range(_LEVELS):
        block = table[start : start + 4 * (_SIDE >> level) ** 2]
        start += len(block)
        slopes = block.reshape(-1, 4)[:, :1].copy().view(np.int16) * _UNIT
        rms.append(np.sqrt(np.mean(slopes**2)))
    octaves = np.log2(_SIDE / 2 / (2.03 / 0.3))
    assert rms[0] == pytest.approx(np.sqrt(octaves), rel=1e-6)  # unit variance an octave, both axes
    assert (np.diff(rms) < 0).all()
    assert rms[-1] < 0.2 * rms[0]

    vertices, faces = plane()
    light = sun(frames.direction_L(0, 30), 2.0)
    spread = []
    for height in (2.0, 400.0):
        a_view = view(height * UP, -UP, width=64, fov_deg=30.0)
        rough = render.TerrainMesh(vertices, faces, np.ones(2, bool), fine=render.FineRelief(slope=0.08))
        image = render.radiance(rough, scene(a_view, light, 0.06)).array[4]
        flat = render.radiance(join(plane()), scene(a_view, light, 0.06)).array[4]
        # slopes to all sides cancel in the mean, up to the curvature of the cosine: tilt² / 2, 3 %
        assert image.mean() == pytest.approx(flat.mean(), rel=0.05)
        spread.append(image.std() / image.mean())
    assert spread[0] > 0.1
    assert spread[1] < 0.05


def test_finest_relief_is_the_same_through_every_pixel() -> None:
    """A principal point that moves by whole pixels moves the image: no pixel shows the ground in its own way."""
    vertices, faces = plane()
    ground = render.TerrainMesh(vertices, faces, np.ones(2, bool), fine=render.FineRelief(slope=0.08))
    light = sun(frames.direction_L(0, 30), 2.0)
    images = []
    for moved_px, key in ((0, 5), (3, 6)):
        a_view = view(6.0 * UP, -UP, width=64, fov_deg=30.0)
        a_view = dataclasses.replace(a_view, intrinsics=a_view.intrinsics + np.array([0, 0, moved_px, 0]))
        images.append(render.radiance(ground, scene(a_view, light, 0.06, spp=1024, key=key)).array[4])
    still, moved = images[0][:, :-3], images[1][:, 3:]
    # 1024 stratified samples of a smooth texture err by far less than a hundredth of its contrast; levels of detail
    # that were chosen pixel by pixel made a third of it
    assert (moved - still).std() < 0.02 * still.std()


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (
            {"spacecraft": {"model": "default", "pose": {"wing": {"angle_deg": 3}}}},
            ["spacecraft.pose.wing", "joint"],
        ),
        ({"spacecraft": {"model": "no/such.glb"}}, ["no/such.glb"]),
        ({"spice": {"kernels": ["no_such.tm"]}}, ["no_such.tm"]),
    ],
)
def test_bad_worlds_are_told_in_a_sentence(tables: dict[str, dict[str, object]], words: list[str]) -> None:
    scene_ = config.parse_scene(physical(**tables), source="test")

    def whole() -> None:
        assemble.spacecraft(scene_)
        ephemeris.ephemeris(scene_)

    with pytest.raises(InputError) as told:
        whole()
    assert all(word in str(told.value) for word in words)
    assert "\n" not in str(told.value)


def test_surface_points_reproject_onto_their_pixels(samples: tuple[Session, list[Frame]]) -> None:
    """A surface point, carried through T and the stored pose, lands on its pixel's centre to 0.01 px."""
    s, all_frames = samples
    seen = 0
    for frame in all_frames:
        sample = to_sample(frame)
        points = sample.layers["point_T_m"].reshape(-1, 3)
        body = sample.layers["semantic"].ravel() == BODY
        seen += body.sum()
        C_from_T = rotation(sample.scalars["camera_from_T"])
        in_C = (points[body] - sample.scalars["camera_position_T_m"]) @ C_from_T.T
        fx, fy, cx, cy = sample.scalars["intrinsics"]
        xy = np.column_stack([in_C[:, 0] / in_C[:, 2] * fx + cx, in_C[:, 1] / in_C[:, 2] * fy + cy])
        rows, columns = np.divmod(np.flatnonzero(body), s.scene.camera.width_px)
        np.testing.assert_allclose(xy, np.column_stack([columns, rows]) + 0.5, atol=0.01)
        assert np.isnan(points[sample.layers["semantic"].ravel() == SKY]).all()
    assert seen > 5000
