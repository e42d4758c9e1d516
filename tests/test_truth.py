"""Truth in a store: every layer comes back as its schema says, and agrees with the others and with the pose."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import zarr
from conftest import small_scene, verified_store
from numpy.typing import NDArray
from poses_kit import C_from_T, projected
from test_render import UP, ball, sun, view

from vbnfault import render, store
from vbnfault.camera import Camera
from vbnfault.core import frames
from vbnfault.detector import ThreeColourDetector
from vbnfault.lens import RealLens, load_lens, scaled_to_field
from vbnfault.lens.adapt import stopped_down
from vbnfault.lens.glass import D_NM
from vbnfault.lens.mapping import chief_heights_mm, fitted
from vbnfault.lens.prescription import Prescription

F64 = NDArray[np.float64]

SIDE_PX = 160
BODY = store.SEMANTIC.index("body")


@pytest.fixture(scope="module", params=["nikkor_28_f2p8", "nikkor_35_f2p8"])
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> zarr.Group:
    """A small store of a wide lens with every optional layer, built and verified."""
    layers = [name for name in store.LAYERS if name not in (*store.REQUIRED_LAYERS, "flow")]
    table = small_scene(
        dataset={"samples": 2, "sites": 1, "layers": ["clean", "without_straylight", *layers]},
        camera={"width_px": SIDE_PX, "height_px": SIDE_PX, "detector": "cmv4000", "fov_deg": 70.0},
        body={"photometry": {"model": "mcewen", "phase_slope_mag_deg": 0.047, "dust_contrast": 0.16}},
        render={"samples_per_pixel": 4, "bounces": 1},
        geometry={"sun_averted": {"reference": "nadir", "roll_deg": [-40, 40], "pitch_deg": [-40, 40]}},
        plan={"faulty_fraction": 0.5},
        spacecraft={"model": "default"},
    )
    table["camera"]["lens"] = request.param
    table["faults"] = {"straylight": {}}
    out = tmp_path_factory.mktemp(request.param) / "store.zarr"
    verified_store(table, out, threads=2)
    return zarr.open_group(out, mode="r")


def test_every_optional_layer_comes_back(built: zarr.Group) -> None:
    body = built["semantic"][:] == BODY
    sky = ~np.isfinite(built["depth_m"][:])
    assert body.any()
    assert sky.any()
    for name, row in store.LAYERS.items():
        if name == "flow":  # of sequences
            continue
        layer = built[name][:]
        assert layer.dtype == (np.float32 if name in ("radiance", "scene_radiance") else row.dtype), name
        assert np.isfinite(layer[body] if name.endswith("_deg") or name == "albedo" else 0).all(), name
    for name, most in (("incidence_deg", 180), ("emission_deg", 90), ("phase_deg", 180)):
        angle = built[name][:]
        assert np.isnan(angle[sky]).all()
        assert 0 <= angle[body].min() < angle[body].max() <= most
    assert np.isnan(built["point_T_m"][:][sky]).all()
    np.testing.assert_array_equal(built["normal"][:][sky], 0)


def test_points_reproject_through_what_is_stored(built: zarr.Group) -> None:
    """Surface points through stored pose, intrinsics and distortion: at most 0.02 px rms and 0.05 px from the
    centres of their pixels."""
    off = []
    for i in range(built["semantic"].shape[0]):
        body = built["semantic"][i] == BODY
        in_C = (built["point_T_m"][i][body] - built["camera_position_T_m"][i]) @ C_from_T(built, i).T
        # depth is z along the boresight, not the range
        np.testing.assert_allclose(in_C[:, 2], built["depth_m"][i][body], rtol=1e-5)
        rows, columns = np.nonzero(body)
        off.append(np.hypot(*(projected(built, i, in_C) - np.column_stack([columns, rows]) - 0.5).T))
    found = np.concatenate(off)
    assert len(found) > 0.3 * SIDE_PX**2
    assert np.sqrt(np.mean(found**2)) <= 0.02
    assert found.max() <= 0.05


def test_roll_and_pitch_count_from_what_their_attribute_names(built: zarr.Group) -> None:
    references = built["roll_deg"].attrs["reference"]
    assert references == {"sun-facing": "sun", "sun-averted": "nadir"}
    assert built["pitch_deg"].attrs["reference"] == built["yaw_deg"].attrs["reference"] == references
    names = built["stratum"].attrs["flag_meanings"].split()
    seen = set()
    for i in range(built["stratum"].shape[0]):
        stratum = names[built["stratum"][i]]
        seen.add(stratum)
        T_from_L = built["T_from_L"][i]
        sun_L = T_from_L.T @ built["sun_direction_T"][i]
        reference = sun_L if references[stratum] == "sun" else np.array([0.0, 0.0, 1.0])
        L_from_C = T_from_L.T @ C_from_T(built, i).T
        angles = (built[name][i] for name in ("roll_deg", "pitch_deg", "yaw_deg"))
        np.testing.assert_allclose(L_from_C, frames.L_from_C(reference, *angles), atol=1e-9)
    assert seen == set(names)


PACKAGED = (
    "nikkor_28_f2p8",
    "nikkor_35_f2p8",
    "distagon_25_f2p8",
    "biotar_100_f1p4",
    "heliar_100_f3p5",
    "tessar_50_f2p8",
)


def behind(lens: Prescription, fov_deg: float, width_px: int = 1024, height_px: int = 1024) -> Camera:
    """A camera of 5.5 µm behind a lens scaled to that field across the width."""
    real = RealLens(
        prescription=scaled_to_field(lens, fov_deg, width_px * 5.5e-3),
        width_px=width_px,
        height_px=height_px,
        pixel_pitch_um=5.5,
    )
    detector = ThreeColourDetector(width_px=width_px, height_px=height_px, pixel_pitch_um=5.5)
    return Camera(lens=real, detector=detector)


def centres_and_directions(camera: Camera) -> tuple[F64, F64]:
    """Some of the pixels' centres, corners among them, float64[n, 2]; and the directions that they see, as
    tangents, float64[n, 2]."""
    rows = np.unique(np.append(np.arange(0, camera.height_px, 13), camera.height_px - 1))
    columns = np.unique(np.append(np.arange(0, camera.width_px, 13), camera.width_px - 1))
    centres = np.stack(np.meshgrid(columns + 0.5, rows + 0.5), -1).reshape(-1, 2)
    return centres, camera.seen_directions[np.ix_(rows, columns)][..., :2].reshape(-1, 2)


def assert_opencv_agrees(camera: Camera) -> None:
    """All of the frame, dark corners too: OpenCV with the stored coefficients sends what pixels see to them,
    its iteration inverts that, and farther pixels see farther directions."""
    centres, slopes = centres_and_directions(camera)
    fx, fy, cx, cy = camera.intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    in_C = np.column_stack([slopes, np.ones(len(slopes))])
    seen, _ = cv2.projectPoints(in_C, np.zeros(3), np.zeros(3), matrix, camera.lens.distortion)
    off = np.hypot(*(seen[:, 0] - centres).T)
    # a table of 4097 slopes in between which heights are linear: h'' (T / 4096)² / 8 focal lengths, T up to 7
    assert off.max() < 0.002
    # an error of the iteration shrinks by a factor of 0.9 or better a step
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-12)
    undone = cv2.undistortPoints(centres[:, None], matrix, camera.lens.distortion, criteria=ends)[:, 0]
    again, _ = cv2.projectPoints(
        np.column_stack([undone, np.ones(len(undone))]), np.zeros(3), np.zeros(3), matrix, camera.lens.distortion
    )
    assert np.hypot(*(again[:, 0] - centres).T).max() < 0.002
    np.testing.assert_allclose(undone, slopes, rtol=1e-4, atol=1e-6)
    order = np.argsort(np.hypot(*(centres - [cx, cy]).T), kind="stable")
    radius, slope = np.hypot(*(centres - [cx, cy]).T)[order], np.hypot(*slopes.T)[order]
    assert (np.diff(slope)[np.diff(radius) > 1e-3] > 0).all()


@pytest.mark.parametrize("fov_deg", [70.0, 120.0])
@pytest.mark.parametrize("name", PACKAGED)
def test_the_stored_model_is_the_camera_for_every_field(name: str, fov_deg: float) -> None:
    """Within the field of a lens and far beyond it, where no chief ray arrives."""
    assert_opencv_agrees(behind(load_lens(name), fov_deg))


@pytest.mark.parametrize("seed", range(6))
def test_the_stored_model_is_the_camera_for_other_lenses(seed: int) -> None:
    """Packaged lenses with all radii, gaps and openings some per cent off, stopped down, on frames of any shape."""
    rng = np.random.default_rng(seed)
    lens = load_lens(PACKAGED[seed])
    surfaces = tuple(
        replace(
            s,
            radius_mm=s.radius_mm * rng.uniform(0.97, 1.03),
            thickness_mm=s.thickness_mm * rng.uniform(0.97, 1.03),
        )
        for s in lens.surfaces
    )
    c = behind(replace(lens, surfaces=surfaces), rng.uniform(20, 70), 1024, int(rng.integers(300, 1025)))
    assert isinstance(c.lens, RealLens)
    closed = stopped_down(c.lens.prescription, rng.uniform(4, 16))
    assert_opencv_agrees(replace(c, lens=replace(c.lens, prescription=closed)))


@pytest.mark.parametrize(
    ("name", "fov_deg"),
    [
        ("nikkor_28_f2p8", 70.0),
        ("nikkor_35_f2p8", 70.0),
        ("distagon_25_f2p8", 70.0),
        ("biotar_100_f1p4", 30.0),
        ("heliar_100_f3p5", 40.0),
        ("tessar_50_f2p8", 40.0),
    ],
)
def test_within_its_field_the_stored_model_is_that_of_chief_rays(name: str, fov_deg: float) -> None:
    """A fan of the test's own: where chief rays of the directions seen meet the sensor."""
    c = behind(load_lens(name), fov_deg)
    lens = c.lens
    assert isinstance(lens, RealLens)
    centres, slopes = centres_and_directions(c)
    radius, slope = np.hypot(*(centres - 512)[::97].T), np.hypot(*slopes[::97].T)
    height = chief_heights_mm(
        lens.prescription.with_round_stop(), slope, wavelength_nm=D_NM, sensor_mm=lens.sensor_mm
    )
    known = np.isfinite(height)
    lit = lens.relative_illumination(radius / lens.focal_length_px) > 0
    assert known.mean() > 0.95
    off = (height * 1e3 / 5.5 - radius)[known & lit]
    # the rays of the lens's own tables lie 1/64 of the field apart, which a steep end shows
    assert np.sqrt(np.mean(off**2)) <= 0.02
    assert np.abs(off).max() <= 0.05
    rms, most = lens.distortion_residual_px
    assert rms <= most <= 0.02


def test_a_lens_that_no_model_follows_is_refused() -> None:
    """Heights that rise, past the last own one, so fast that every model has a pole or cannot be inverted."""
    slope = np.linspace(0, 1, 65)[1:]
    assert fitted(slope, slope, 1000.0, known=64, reach=0.99) is not None
    folded = np.where(slope < 0.5, slope, 1 - slope)
    assert fitted(slope, folded, 1000.0, known=32, reach=2.0) is None


def test_normals_face_the_camera() -> None:
    """A ball of few facets: its interpolated normals point away at the limb, those of truth do not."""
    surface, a_view = ball(subdivisions=2), view(400 * UP, -UP, width=128, fov_deg=30.0)
    truth = render.truth(surface, a_view, sun(UP), angles=True)
    fx, fy, cx, cy = a_view.intrinsics
    x, y = np.meshgrid((np.arange(128) + 0.5 - cx) / fx, (np.arange(128) + 0.5 - cy) / fy)
    away = -np.stack([x, y, np.ones_like(x)], axis=-1)
    body = truth.semantic == 1
    cosine = (truth.normal.astype(float) * away).sum(axis=-1)[body] / np.linalg.norm(away, axis=-1)[body]
    assert cosine.min() >= 0
    assert (cosine < 1e-3).sum() > 10  # there are some that had to be turned
    assert truth.emission_deg is not None
    emission = truth.emission_deg[body]
    assert emission.max() <= 90
    # half precision of each entry, near 90° where a cosine is as good as an angle
    np.testing.assert_allclose(np.cos(np.radians(emission)), cosine, atol=1e-3)
