"""Scenes with a prescription: its identity, stars through it, and labels and light on the same pixels."""

from __future__ import annotations

import dataclasses
import math
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import small_scene
from lens_kit import bundle

from vbnfault import dataset, pipeline
from vbnfault.camera import Camera
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.quantities import BODY, SUN, Radiance
from vbnfault.lens import (
    RealLens,
    ThinLens,
)
from vbnfault.lens.glass import D_NM
from vbnfault.lens.image_frame import DEFAULT_LENS
from vbnfault.pipeline.exposure import _rate_with
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.spec import SceneExposure, SceneLight
from vbnfault.render.description import View
from vbnfault.scene import config, plan
from vbnfault.store.schema import spec_from_plain
from vbnfault.world import assemble, cameras, ephemeris, sky


def scene(tmp: Path | None = None, **keys: Any) -> config.Scene:
    table = small_scene(camera={"width_px": 128, "height_px": 112, "pixel_pitch_um": 44.0, **keys})
    table["dataset"] |= {"layers": ["clean", "depth_m", "semantic", "normal", "radiance", "point_T_m"]}
    return config.parse_scene(table, source="test")


def test_bad_lenses_are_told_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"camera.*lens_coating = 'mgf2': needs lens"):
        scene(lens_coating="mgf2")
    with pytest.raises(InputError, match=r"camera.*focus = 'best': needs lens"):
        scene(focus="best")
    with pytest.raises(InputError, match=r"camera\.lens: no_such: .*nikkor_35_f2p8"):
        cameras.base_camera(scene(lens="no_such"))
    with pytest.raises(InputError, match=r"camera\.lens_coating = 'gold': must be one of none, mgf2"):
        cameras.base_camera(scene(lens="tessar_50_f2p8", lens_coating="gold"))


def test_a_lens_beside_the_scene_file_is_found_and_told_by_its_contents(tmp_path: Path) -> None:
    source = resources.find("scenes/lenses", "tessar_50_f2p8")
    (tmp_path / "own.toml").write_text(source.read_text())
    (tmp_path / "scene.toml").write_text('title = "x"\n[camera]\nlens = "own.toml"\nlens_coating = "v"\n')
    found = config.load_scene(tmp_path / "scene.toml")
    assert found.camera.lens == str((tmp_path / "own.toml").resolve())
    lens = cameras.base_camera(found).lens
    assert isinstance(lens, RealLens)
    assert lens.prescription.surfaces[0].coating
    named = config.load_scene(tmp_path / "scene.toml", {"camera.lens": "tessar_50_f2p8"})
    assert named.camera.lens == "tessar_50_f2p8"
    identities = [dataset.scene_identity(pipeline.Session(s)) for s in (found, named)]
    assert identities[0]["camera"] == identities[1]["camera"]
    assert identities[0]["camera"]["lens"].startswith("sha256:")
    assert cameras.base_camera(named).lens is cameras.base_camera(named).lens  # its tables are made once


def test_the_lens_of_a_thin_camera_is_told_by_its_contents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another prescription under the name of `DEFAULT_LENS` makes another scene, where light passes that lens."""
    scenes = tmp_path / "scenes"
    shutil.copytree(resources.data_dir("scenes"), scenes)
    find = resources.data_dir
    monkeypatch.setattr(resources, "data_dir", lambda kind: scenes if kind == "scenes" else find(kind))

    def identity(faults: dict[str, object], **camera: object) -> dict[str, object]:
        table = small_scene(camera={"width_px": 64, "height_px": 64, **camera})
        table["faults"] = faults
        return dataset.scene_identity(pipeline.Session(config.parse_scene(table, source="test")))

    cases = [
        ({"straylight": {"model": "traced"}}, {}, True),
        ({"vignetting": {"model": "lens"}}, {}, True),
        ({"straylight": {"model": "traced", "lens": "tessar_50_f2p8"}}, {}, False),
        ({"straylight": {"model": "traced"}}, {"lens": "tessar_50_f2p8"}, False),
        ({"straylight": {"model": "texture"}}, {}, False),
    ]
    before = [identity(faults, **camera) for faults, camera, _ in cases]
    named = identity({"straylight": {"model": "traced", "lens": DEFAULT_LENS}})
    assert named == before[0]
    lens = scenes / "lenses" / f"{DEFAULT_LENS}.toml"
    lens.write_text(lens.read_text() + "\n")
    for (faults, camera, other), was in zip(cases, before, strict=True):
        assert (identity(faults, **camera) != was) == other, (faults, camera)


def _check_stars_are_imaged_alone(scene: config.Scene, camera: Camera, dark: Radiance, view: View) -> None:
    """Above ground that fills the lower half, stars have the electrons that an image of all light together has."""
    sky_part = np.arange(view.height_px)[:, None] < view.height_px // 2 + np.zeros(view.width_px)
    ground = dark.with_array(np.where(sky_part, np.float32(0), np.float32(1e-7)) + np.zeros_like(dark.array))
    stars = assemble.visible_stars(scene, ground, camera, [np.eye(3)], sky_part, view)
    assert stars is not None
    starry = stars.added_to(ground)
    light = SceneLight(lens=camera.lens, rendered=ground)
    exposure = SceneExposure(camera=camera, light=light, rate=camera.expose(ground, 1.0))
    rate, together = _rate_with(stars, exposure, starry).array, camera.expose(starry, 1.0).array
    assert (together - exposure.rate.array).max() > 0.1 * together.max()
    np.testing.assert_allclose(rate, together, rtol=1e-5, atol=1e-6 * float(together.max()))


@pytest.mark.parametrize("sigma_px", [0.0, 2.5])
def test_stars_go_through_the_lens(sigma_px: float) -> None:
    """A catalogue's stars on the sensor: where the camera has them, with the light that the beam lets pass.

    The prescription spreads them, whatever point spread the scene states for a thin lens.
    """
    table = small_scene(
        camera={"width_px": 256, "height_px": 256, "pixel_pitch_um": 22.0, "lens": "nikkor_28_f2p8"},
        sky={"stars": "on", "limiting_magnitude": 2.5, "sigma_px": sigma_px},
        render={"bands": 3, "band_min_nm": 550.0, "band_max_nm": 620.0},
    )
    stars = config.parse_scene(table, source="test")
    c, nodes, date = cameras.base_camera(stars), ephemeris.wavelengths_nm(stars), stars.sun.julian_date
    lens = c.lens
    assert isinstance(lens, RealLens)
    gx, gy = c.lens.guard_px
    view = View(
        position_L_m=np.zeros(3),
        L_from_C=np.eye(3),
        intrinsics=c.intrinsics + np.array([0, 0, gx, gy]),
        width_px=256 + 2 * gx,
        height_px=256 + 2 * gy,
    )
    dark = Radiance(array=np.zeros((3, view.height_px, view.width_px), np.float32), wavelength_nm=nodes)
    bright = assemble.visible_stars(stars, dark, c, [np.eye(3)], np.ones(dark.array.shape[1:], dtype=bool), view)
    assert bright is not None
    seen = bright.added_to(dark)
    image = lens.image(seen)
    _check_stars_are_imaged_alone(stars, c, seen, view)
    catalogue = sky.load_catalogue().brighter_than(2.5)
    found = [
        (place, k)
        for k, direction in enumerate(catalogue.direction_J(date))
        if (place := c.project(direction)) is not None and (np.abs(place - 128) < 115).all()
    ]
    assert len(found) >= 4
    checked = 0
    for place, k in found:
        if min(np.hypot(*(other - place)) for other, j in found if j != k) < 20:
            continue
        checked += 1
        left, top = (int(v) - 8 for v in place)
        window = image.array[1, top : top + 17, left : left + 17].astype(float)
        at, total = np.arange(17) + 0.5, window.sum()
        centroid = [left + (window.sum(axis=0) * at).sum() / total, top + (window.sum(axis=1) * at).sum() / total]
        np.testing.assert_allclose(centroid, place, atol=0.06)
        z = float(catalogue.direction_J(date)[k, 2])
        flux = sky.star_irradiance_W_m2_nm(catalogue.magnitude_V[k], catalogue.colour_BV[k], nodes)[0, 1]
        _, area = bundle(lens, math.sqrt(1 / z**2 - 1), D_NM)
        passed = flux * area * z * lens.transmittance(nodes)[1]
        assert total * 22e-3**2 == pytest.approx(passed, rel=0.06)
    assert checked >= 3


def test_a_star_out_of_focus_is_a_disc_of_the_pupil() -> None:
    """Focused at 0.2 m, the pupil's radius of f / 2N makes discs of radius f / (2 N 0.2 m) in tangents."""
    images = []
    for focus in ({}, {"focus_distance_m": 0.2}):
        table = small_scene(
            camera={"width_px": 256, "height_px": 256, "pixel_pitch_um": 100.0, "f_number": 2.0, **focus},
            sky={"stars": "on", "limiting_magnitude": 2.0},
            render={"bands": 3},
        )
        scene = config.parse_scene(table, source="test")
        c, nodes = cameras.base_camera(scene), ephemeris.wavelengths_nm(scene)
        dark = Radiance(array=np.zeros((3, 256, 256), np.float32), wavelength_nm=nodes)
        stars = assemble.visible_stars(scene, dark, c, [np.eye(3)], np.ones((256, 256), dtype=bool))
        assert stars is not None
        images.append(stars.added_to(dark).array[1].astype(float))
    radius_px = c.focal_length_px**2 * 100e-6 / (2 * 2.0 * 0.2)
    assert 4 < radius_px < 6
    sharp, soft = images
    top, left = np.unravel_index(sharp[20:-20, 20:-20].argmax(), (216, 216))
    light, disc = (picture[top + 8 : top + 33, left + 8 : left + 33] for picture in images)
    assert disc.sum() == pytest.approx(light.sum(), rel=1e-3)
    assert disc.max() == pytest.approx(light.sum() / (np.pi * (radius_px**2 + (2 * 0.6) ** 2)), rel=0.03)
    assert soft.max() < sharp.max() / 20


def test_a_thin_lens_has_neither_distortion_nor_guard_band() -> None:
    thin = cameras.base_camera(scene())
    assert isinstance(thin.lens, ThinLens)
    assert thin.lens.guard_px == (0, 0)
    assert thin.lens.name == "thin lens"
    assert not thin.lens.distortion.any()


def test_samples_of_a_scene_with_a_lens() -> None:
    """Render, picture and labels of a small frame: all on the picture's grid, and on each other's pixels."""
    settings = scene(lens="nikkor_28_f2p8", lens_coating="mgf2")
    with pytest.raises(InputError, match=r"vignetting\.model = 'cos4'.*would count that twice"):
        pipeline.Session(settings)
    faults = settings.faults | {"vignetting": {"model": "lens"}}
    # pixels of half a degree: fewer rays might all miss a Sun of a fifth of that
    render = settings.render.model_copy(update={"samples_per_pixel": 64})
    towards = settings.geometry.sun_facing.model_copy(update={"min_lit_fraction": 0.2})  # type: ignore[union-attr]
    geometry = settings.geometry.model_copy(update={"sun_facing": towards})
    session = pipeline.Session(
        settings.model_copy(update={"faults": faults, "render": render, "geometry": geometry})
    )
    c = session.base_camera
    spec = dataset.store_spec(session, [16])
    assert spec.lens_names == ("AF Nikkor 28 mm f/2.8D",)
    members = spec.members(16)
    attributes = members["distortion"].attributes
    assert attributes["residual_px_max"] == c.lens.distortion_residual_px[1] > 0
    assert attributes["valid_to_deg"] == c.lens.distortion_valid_to_deg < 90
    # stores of earlier versions have no such angle, and count as the same data
    older = dataclasses.replace(spec, distortion_valid_to_deg=None)
    assert older.data == spec.data
    assert "valid_to_deg" not in older.members(16)["distortion"].attributes
    assert spec_from_plain(spec.plain(), {}) == dataclasses.replace(spec, attributes={})
    # Sun and ground in one frame
    frames_ = (session.frame(int(i)) for i in np.flatnonzero(session.plan.stratum == plan.SUN_FACING))
    frame = next(
        f
        for f in frames_
        if (f.context.sun_xy_px > 5).all()
        and (f.context.sun_xy_px < (123, 107)).all()
        and 0.2 < (f.rendering.truth.semantic == BODY).mean() < 0.9
    )
    lens = frame.camera.lens
    assert isinstance(lens, RealLens)
    light, guard_px = frame.exposure.light, c.lens.guard_px
    assert light.rendered.array.shape[1:] == (112 + 2 * guard_px[1], 128 + 2 * guard_px[0])
    sample = to_sample(frame)
    for name, layer in sample.layers.items():
        assert (112, 128) in (layer.shape[:2], layer.shape[1:3], layer.shape[-2:]), name
    np.testing.assert_array_equal(sample.scalars["distortion"], c.lens.distortion)
    assert sample.scalars["intrinsics"].tolist() == c.intrinsics.tolist()

    # the Sun is in this frame: label and light where the camera has it
    sun = sample.scalars["sun_xy_px"]
    assert (sun > 5).all()
    assert (sun < (123, 107)).all()
    rows, columns = np.nonzero(sample.layers["semantic"] == SUN)
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], sun, atol=0.8)
    bright = np.argmax(frame.exposure.rate.merged.array[..., 1])
    assert np.hypot(bright % 128 + 0.5 - sun[0], bright // 128 + 0.5 - sun[1]) < 1

    # surface points through the stored pose, the intrinsics and OpenCV's model
    body = sample.layers["semantic"] == BODY
    assert 0.2 < body.mean() < 0.9
    T_from_C = frame.spec.terrain.site.T_from_L @ frame.pose.L_from_C
    in_C = (sample.layers["point_T_m"][body] - sample.scalars["camera_position_T_m"]) @ T_from_C
    np.testing.assert_allclose(in_C[:, 2], sample.layers["depth_m"][body], rtol=1e-5)
    fx, fy, cx, cy = sample.scalars["intrinsics"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    seen, _ = cv2.projectPoints(in_C, np.zeros(3), np.zeros(3), matrix, sample.scalars["distortion"])
    rows, columns = np.nonzero(body)
    off = np.abs(seen[:, 0] - np.column_stack([columns, rows]) - 0.5)
    # truth follows the centres' own rays, in float32
    assert off.max() < 1e-3

    # light ends where the body does: dark sky holds none
    lit = frame.exposure.rate.merged.array[..., 1] > 0
    away = cv2.dilate((sample.layers["semantic"] > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert not (lit & away).any()
    assert (lit & body).sum() > 0.3 * body.sum()
    # and the stored radiance, with the light the lens takes, is the picture up to its blur
    solid = lens.axial_solid_angle_sr(frame.exposure.light.on_image.wavelength_nm)
    x, y = np.arange(128) + 0.5 - 64, np.arange(112) + 0.5 - 56
    distance = np.hypot(x[None], y[:, None]) / lens.focal_length_px
    band = 4
    expected = frame.exposure.light.on_image.array[band] * solid[band] * lens.relative_illumination(distance)
    image = lens.image(frame.exposure.light.rendered).array[band]
    inner = cv2.erode((body & lit).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert inner.sum() > 500
    assert image[inner].sum() == pytest.approx(expected[inner].sum(), rel=5e-3)
