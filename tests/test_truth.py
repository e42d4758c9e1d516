"""Truth in a store: every layer comes back as its schema says, and agrees with the others and with the pose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import zarr
from conftest import small_scene
from scipy.spatial.transform import Rotation
from test_light import ball
from test_render import UP, sun, view

from vbnfault import config, dataset, frames, render, store
from vbnfault.camera import Camera
from vbnfault.detector import Detector
from vbnfault.lens import RealLens, load_lens, scaled_to_field
from vbnfault.lens.glass import D_NM
from vbnfault.lens.imaging import chief_heights_mm

SIDE_PX = 160
BODY = store.SEMANTIC.index("body")


@pytest.fixture(scope="module", params=["nikkor_28_f2p8", "nikkor_35_f2p8"])
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> zarr.Group:
    """A small store of a wide lens with every optional layer, built and verified."""
    layers = [name for name in store.LAYERS if name not in store.REQUIRED_LAYERS]
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
    scene = config.parse_scene(table, source="test")
    out = tmp_path_factory.mktemp(request.param) / "store.zarr"
    dataset.build_scene(scene, out, source="test", threads=2)
    assert not store.verify(out)
    return zarr.open_group(out, mode="r")


def test_every_optional_layer_comes_back(built: zarr.Group) -> None:
    body = built["semantic"][:] == BODY
    sky = ~np.isfinite(built["depth_m"][:])
    assert body.any()
    assert sky.any()
    for name, row in store.LAYERS.items():
        layer = built[name][:]
        assert layer.dtype == row.dtype if name != "radiance" else layer.dtype == np.float32
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
        w, x, y, z = built["camera_from_T"][i]
        C_from_T = Rotation.from_quat([x, y, z, w]).as_matrix()
        in_C = (built["point_T_m"][i][body] - built["camera_position_T_m"][i]) @ C_from_T.T
        # depth is z along the boresight, not the range
        np.testing.assert_allclose(in_C[:, 2], built["depth_m"][i][body], rtol=1e-5)
        fx, fy, cx, cy = built["intrinsics"][i]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        seen, _ = cv2.projectPoints(in_C, np.zeros(3), np.zeros(3), matrix, built["distortion"][i])
        rows, columns = np.nonzero(body)
        off.append(np.hypot(*(seen[:, 0] - np.column_stack([columns, rows]) - 0.5).T))
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
        w, x, y, z = built["camera_from_T"][i]
        L_from_C = T_from_L.T @ Rotation.from_quat([x, y, z, w]).as_matrix().T
        angles = (built[name][i] for name in ("roll_deg", "pitch_deg", "yaw_deg"))
        np.testing.assert_allclose(L_from_C, frames.L_from_C(reference, *angles), atol=1e-9)
    assert seen == set(names)


@pytest.mark.parametrize(
    ("name", "fov_deg"),
    [
        ("nikkor_28_f2p8", 70.0),
        ("nikkor_35_f2p8", 70.0),
        ("distagon_25_f2p8", 65.0),
        ("biotar_100_f1p4", 50.0),
        ("heliar_100_f3p5", 30.0),
        ("tessar_50_f2p8", 30.0),
    ],
)
def test_the_stored_model_follows_the_exact_rays(name: str, fov_deg: float) -> None:
    """What OpenCV makes of the stored coefficients, of directions seen by exact rays, on 1024 px."""
    prescription = scaled_to_field(load_lens(name), fov_deg, 1024 * 5.5e-3)
    lens = RealLens(prescription=prescription, width_px=1024, height_px=1024, pixel_pitch_um=5.5)
    c = Camera(lens=lens, detector=Detector(width_px=1024, height_px=1024))
    slopes = c.seen_slopes[::7, ::7].reshape(-1, 2)
    centres = np.stack(np.meshgrid(np.arange(0, 1024, 7) + 0.5, np.arange(0, 1024, 7) + 0.5), -1).reshape(-1, 2)
    lit = lens.relative_illumination(np.hypot(*(centres - 512).T) / lens.focal_length_px) > 0
    in_C = np.column_stack([slopes, np.ones(len(slopes))])[lit]
    fx, fy, cx, cy = c.intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    seen, _ = cv2.projectPoints(in_C, np.zeros(3), np.zeros(3), matrix, c.distortion)
    off = np.hypot(*(seen[:, 0] - centres[lit]).T)
    assert np.sqrt(np.mean(off**2)) <= 0.02
    assert off.max() <= 0.05
    # the exact map, from a fan of its own: where chief rays of these directions meet the sensor
    radius = np.hypot(*(centres[lit][::97] - 512).T)
    order = np.argsort(radius)
    slope = np.hypot(*slopes[lit][::97].T)[order]
    height = chief_heights_mm(prescription.with_round_stop(), slope, wavelength_nm=D_NM, sensor_mm=lens.sensor_mm)
    known = np.isfinite(height)
    assert known.sum() > 0.9 * len(slope)
    # beyond the last of the table's chief rays, 1/64 of the field apart, its map goes straight on
    np.testing.assert_allclose((height * 1e3 / 5.5)[known], radius[order][known], atol=0.05)


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
