"""Truth in a store: every layer comes back as its schema says, and agrees with the others and with the pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr
from conftest import small_scene
from test_light import ball
from test_render import UP, sun, view

from vbnfault import config, dataset, render, store

SIDE_PX = 64


def built(folder: Path, **tables: dict[str, object]) -> zarr.Group:
    """A small store with every optional layer, built and verified."""
    layers = [name for name in store.LAYERS if name not in store.REQUIRED_LAYERS]
    table = small_scene(
        dataset={"samples": 3, "sites": 1, "layers": ["clean", "without_straylight", *layers]},
        camera={"width_px": SIDE_PX, "height_px": SIDE_PX, "detector": "cmv4000"},
        body={"photometry": {"model": "mcewen", "phase_slope_mag_deg": 0.047, "dust_contrast": 0.16}},
        render={"samples_per_pixel": 4, "bounces": 1},
        spacecraft={"model": "default"},
        **tables,
    )
    table["faults"] = {"straylight": {}}
    scene = config.parse_scene(table, source="test")
    dataset.build_scene(scene, folder / "store.zarr", source="test", threads=2)
    assert not store.verify(folder / "store.zarr")
    return zarr.open_group(folder / "store.zarr", mode="r")


@pytest.fixture(scope="module")
def thin(tmp_path_factory: pytest.TempPathFactory) -> zarr.Group:
    return built(tmp_path_factory.mktemp("thin"))


def test_every_optional_layer_comes_back(thin: zarr.Group) -> None:
    body = thin["semantic"][:] == store.SEMANTIC.index("body")
    sky = ~np.isfinite(thin["depth_m"][:])
    assert body.any()
    assert sky.any()
    for name, row in store.LAYERS.items():
        layer = thin[name][:]
        assert layer.dtype == row.dtype if name != "radiance" else layer.dtype == np.float32
        assert np.isfinite(layer[body] if name.endswith("_deg") or name == "albedo" else 0).all(), name
    for name, most in (("incidence_deg", 180), ("emission_deg", 90), ("phase_deg", 180)):
        angle = thin[name][:]
        assert np.isnan(angle[sky]).all()
        assert 0 <= angle[body].min() < angle[body].max() <= most
    assert np.isnan(thin["point_T_m"][:][sky]).all()
    np.testing.assert_array_equal(thin["normal"][:][sky], 0)


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
