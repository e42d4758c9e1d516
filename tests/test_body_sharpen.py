"""Relief that a smoothed shape model has lost: how much is restored, where, and by which rule."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vbnfault
from vbnfault.body import ellipsoid, load_body
from vbnfault.body.geometry import mean_edge_m, vertex_normals
from vbnfault.body.roughness import deviogram, sharpened
from vbnfault.dataset.identity import scene_identity

SPHERE, FACES = ellipsoid((1000.0, 1000.0, 1000.0), 0.0)


def wavy(wavelength_m: float, height_m: float) -> np.ndarray:
    """Return the sphere with waves along z."""
    wave = np.cos(2 * np.pi * SPHERE[:, 2] / wavelength_m)
    return SPHERE * (1 + height_m * wave / 1000.0)[:, None]


def test_waves_are_amplified_by_the_stated_gain() -> None:
    """In a band around the equator, where the waves run along the surface and the sphere is level along them."""
    edge = mean_edge_m(SPHERE, FACES)
    band = np.abs(SPHERE[:, 2]) < 250
    for edges in (6.0, 12.0):
        wavelength = edges * edge
        before = wavy(wavelength, 2.0)
        after = sharpened(before, FACES, 1.0)
        flat = sharpened(SPHERE, FACES, 1.0)
        wave = np.cos(2 * np.pi * SPHERE[band, 2] / wavelength)
        heights = np.linalg.norm(after[band], axis=1) - np.linalg.norm(flat[band], axis=1)
        seen = (heights @ wave) / (wave @ wave) / 2.0
        square = (0.7 * 2 * np.pi / edges) ** 2
        assert seen == pytest.approx(1 + (square / (1 + square)) ** 2, rel=0.08)


def test_no_gain_changes_nothing() -> None:
    assert sharpened(SPHERE, FACES, 0.0) is SPHERE


def test_auto_continues_the_roughness_of_a_smoothed_model(real_shape: Path) -> None:
    """67p_18k.obj is smoothed. Its volume, 18.41 km³, hardly changes, towards the published ones (18.56, 18.8)."""
    body = load_body(real_shape)
    sharp = load_body(real_shape, sharpen="auto")
    edge = mean_edge_m(body.vertices_m, body.faces)
    short = deviogram(body.vertices_m, body.vertex_normals, edge * np.array([1.3]))[0]
    normals = vertex_normals(sharp.vertices_m, sharp.faces)
    restored, long = deviogram(sharp.vertices_m, normals, edge * np.array([1.3, 3.8]))
    assert restored == pytest.approx(long * 1.3 / 3.8, rel=0.1)
    assert restored > 1.3 * short
    assert body.volume_m3 < sharp.volume_m3 < 18.6e9


def test_a_shape_is_scaled_about_its_origin_to_the_volume_that_is_asked_for() -> None:
    body, larger = load_body(), load_body(volume_m3=8 * load_body().volume_m3)
    np.testing.assert_allclose(larger.vertices_m, 2 * body.vertices_m, rtol=1e-12)
    scene = vbnfault.load_scene("paper67p", {"body.volume_km3": 18.8})
    session = vbnfault.Session(scene)
    assert session.body.volume_m3 == pytest.approx(18.8e9, rel=1e-9)
    assert scene_identity(session)["body"]["volume_km3"] == 18.8
    assert "volume_km3" not in scene_identity(vbnfault.Session(vbnfault.load_scene("paper67p")))["body"]
    with pytest.raises(vbnfault.InputError, match=r"volume_km3 = 5: semi_axes_m sets the volume"):
        vbnfault.load_scene("paper67p", {"body.volume_km3": 5.0, "body.shape": "ellipsoid"})


def test_a_shape_file_is_needed() -> None:
    with pytest.raises(vbnfault.InputError, match=r"sharpen = 1.5: needs a shape file"):
        vbnfault.load_scene("paper67p", {"body.sharpen": 1.5})
    plain = vbnfault.Session(vbnfault.load_scene("paper67p")).body
    auto = vbnfault.Session(vbnfault.load_scene("paper67p", {"body.sharpen": "auto"})).body
    assert auto.content_hash == plain.content_hash
    with pytest.raises(vbnfault.InputError, match=r"sharpen"):
        vbnfault.load_scene("paper67p", {"body.sharpen": 5.0, "body.shape": "x.obj"})
