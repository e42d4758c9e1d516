"""Lenses stopped down: f-numbers by rays of the tests' own, and everything that must follow the smaller stop."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from lens_kit import paraxial_ghosts
from test_faults_kit import flat_electrons
from typer.testing import CliRunner

from vbnfault import dataset
from vbnfault.cli import app
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.spectra import Bands
from vbnfault.faults import FaultContext, from_dict
from vbnfault.lens import (
    Prescription,
    RealLens,
    load_lens,
    open_f_number,
    paraxial_properties,
    parse_lens,
    scaled_to_focal_length,
    stopped_down,
)
from vbnfault.lens.beams import Footprint
from vbnfault.lens.glass import D_NM
from vbnfault.lens.imaging import point_spreads
from vbnfault.lens.prescription_file import to_table
from vbnfault.lens.rays import trace
from vbnfault.lens.straylight.scatter import Cleanliness, GlareLayout, veiling_glare
from vbnfault.lens.straylight.starburst import starburst
from vbnfault.scene import config
from vbnfault.world import cameras

LENSES = sorted(resources.packaged("scenes/lenses"))
SIDE_PX = 64


def scene(**keys: Any) -> config.Scene:
    camera = {"width_px": SIDE_PX, "height_px": SIDE_PX, "pixel_pitch_um": 88.0, **keys}
    return config.parse_scene(small_scene(camera=camera), source="test")


def real(name: str, f_number: float | None = None, **keys: Any) -> RealLens:
    lens = cameras.base_camera(
        scene(lens=name, **keys, **({} if f_number is None else {"f_number": f_number}))
    ).lens
    assert isinstance(lens, RealLens)
    return lens


def arrives(lens: Prescription, height_mm: float) -> bool:
    return bool(trace(lens, [[height_mm, 0.0, -50.0]], [[0.0, 0.0, 1.0]]).arrives[0])


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("f_number", [4.0, 16.0, 200.0])
def test_the_marginal_ray_is_that_of_the_f_number(name: str, f_number: float) -> None:
    lens = stopped_down(load_lens(name), f_number)
    marginal = paraxial_properties(lens).efl_mm / f_number / 2
    # the stop is set by the very ray: what is left is rounding, far below 1e-9
    assert arrives(lens, marginal * (1 - 1e-9))
    assert not arrives(lens, marginal * (1 + 1e-9))
    assert open_f_number(lens) == pytest.approx(f_number, rel=1e-9)
    others = [k for k, s in enumerate(lens.surfaces) if not s.stop]
    assert all(lens.surfaces[k] == load_lens(name).surfaces[k] for k in others)


@pytest.mark.parametrize("name", LENSES)
def test_light_on_the_axis_falls_with_the_square_of_the_f_number(name: str) -> None:
    nodes = np.array([D_NM])
    for n in (5.6, 100.0):
        lens = real(name, n)
        passed = spectra.band_means(lens.transmittance(spectra.fine_nodes_nm(nodes)), nodes)
        # π T / (4 N²); the beam's area is a midpoint rule over 32 azimuths of a rim known to some 1e-6
        found = lens.axial_solid_angle_sr(nodes) / passed * 4 * n**2 / math.pi
        assert found == pytest.approx(1, rel=1e-5)
        assert lens.f_number == pytest.approx(n, rel=1e-5)
        assert lens.aperture_radius_m == pytest.approx(lens.focal_length_mm / n / 2e3, rel=1e-5)


def test_an_f_number_out_of_reach_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"camera\.f_number = 2\.4: must be from 2\.86, .*AF Nikkor 28 mm.* to 200"
    ):
        real("nikkor_28_f2p8", 2.4)
    widest = real("nikkor_28_f2p8")
    # as told, rounded to two decimals, is not refused, and opens the lens
    assert real("nikkor_28_f2p8", 2.86).f_number == pytest.approx(widest.f_number, rel=1e-9)
    assert real("biotar_100_f1p4", 2.4).f_number == pytest.approx(2.4, rel=1e-5)


def test_an_unset_f_number_survives_the_store() -> None:
    """Resolved scenes hold every default; a scene read from one has the same optics."""
    for keys in ({}, {"lens": "tessar_50_f2p8"}, {"lens": "tessar_50_f2p8", "f_number": 8.0}, {"f_number": 8.0}):
        first = scene(**keys)
        again = config.parse_scene(first.resolved(), source="again")
        assert again == first
        assert cameras.base_camera(again).lens == cameras.base_camera(first).lens
    assert scene().camera.f_number == 4.0
    assert scene().camera.transmission == 0.9
    assert scene(lens="tessar_50_f2p8").camera.f_number is None
    with pytest.raises(InputError, match=r"camera.*transmission = 0\.5: the lens has its own"):
        scene(lens="tessar_50_f2p8", transmission=0.5)
    assert cameras.base_camera(scene(f_number=8.0, transmission=0.5)).lens.transmission == 0.5


def test_the_store_says_what_the_lens_became() -> None:
    from vbnfault.pipeline import Session

    settings = scene(lens="nikkor_35_f2p8", f_number=5.6, fov_deg=40.0)
    faults = {"dust_on_optics": {"model": "defocused"}}
    told = dataset.store_spec(Session(settings.model_copy(update={"faults": faults})), [4]).attributes["optics"]
    focal = SIDE_PX * 88e-3 / 2 / math.tan(math.radians(20))
    assert told["efl_mm"] == pytest.approx(focal, rel=1e-12)
    assert told["scale"] == pytest.approx(
        focal / paraxial_properties(load_lens("nikkor_35_f2p8")).efl_mm, rel=1e-12
    )
    assert told["f_number"] == pytest.approx(5.6, rel=1e-5)
    assert told["name"] == "Nikkor 35 mm f/2.8"


# --- what follows the stop --------------------------------------------------------------------------------------


def context(lens: RealLens) -> FaultContext:
    camera = replace(cameras.base_camera(scene()), lens=lens)
    return FaultContext(camera=camera)


def test_beams_faults_and_other_lenses_follow_the_stop() -> None:
    wide, narrow = real("nikkor_35_f2p8", 4.0), real("nikkor_35_f2p8", 16.0)
    seen = [context(lens) for lens in (wide, narrow)]
    for where, lens in zip(seen, (wide, narrow), strict=True):
        assert where.frame.prescription("", "as_prescribed") is lens.prescription
        # a fault's lens of its own is closed as far as the camera's
        assert where.frame.real_lens("tessar_50_f2p8").f_number == pytest.approx(lens.f_number, rel=1e-5)
    on_front = [Footprint.on_row(where.frame.beams(""), 0).area_mm2[0] for where in seen]
    # on the vertex's plane it is exactly 16; the front's curvature takes a percent of the wide beam at most
    assert on_front[0] / on_front[1] == pytest.approx(16, rel=0.01)
    # a grain that the narrow beam may not hold darkens the wide one a sixteenth as much
    grain = {
        "lens": "",
        "surface": 0,
        "window_height_mm": 0.5,
        "on_window": [False],
        "x_mm": [0.0],
        "y_mm": [0.0],
        "diameter_um": [50.0],
        "transmission": [0.0],
        "mask_loss": 0.01,
    }
    fault = from_dict("dust_on_optics", {"model": "defocused"}, source="test")
    lost = []
    for where in seen:
        electrons = flat_electrons(where)
        out = fault.apply(electrons, grain, where)
        middle = SIDE_PX // 2
        lost.append(1 - float(out.array[middle, middle, 0] / electrons.array[middle, middle, 0]))
    # the middle pixel's beam is off the axis by half a pixel; a shadow's interpolation misses 3e-4 of the light
    assert lost[1] == pytest.approx(16 * lost[0], rel=0.1, abs=1e-3)
    assert lost[1] > 0.005


def test_point_spread_and_rims_follow_the_stop() -> None:
    wide, narrow = real("biotar_100_f1p4", None, fov_deg=20.0), real("biotar_100_f1p4", 8.0, fov_deg=20.0)
    slope = math.tan(math.radians(7))
    radius = []
    for lens in (wide, narrow):
        sharp = replace(lens, width_px=1024, height_px=1024, pixel_pitch_um=lens.pixel_pitch_um * SIDE_PX / 1024)
        kernel = point_spreads(sharp, np.array([slope]), np.zeros(1), D_NM)[0]
        at = np.arange(len(kernel)) - len(kernel) // 2
        radius.append(math.sqrt(float((kernel * (at[:, None] ** 2 + at**2)).sum())))
    assert radius[1] < 0.5 * radius[0]
    # rims clip the wide beam at the corner, not the narrow one
    corner = [float(lens.relative_illumination(np.array([math.hypot(0.176, 0.176)]))[0]) for lens in (wide, narrow)]
    assert corner[1] > 1.2 * corner[0]


def test_ghosts_and_starburst_follow_the_stop() -> None:
    lenses = [real("nikkor_35_f2p8", n).prescription for n in (4.0, 16.0)]
    flux = []
    for lens in lenses:
        pupil_mm2 = math.pi / 4 * paraxial_properties(lens).entrance_pupil_diameter_mm ** 2
        flux.append({g.pair: g.flux_fraction * pupil_mm2 for g in paraxial_ghosts(lens, 0.0)})
    shared = set(flux[0]) & set(flux[1])
    ratio = np.array([flux[0][pair] / flux[1][pair] for pair in shared])
    stops = [lens.surfaces[lens.stop].semi_diameter_mm for lens in lenses]
    area = (stops[0] / stops[1]) ** 2
    assert area == pytest.approx((16 / 4) ** 2, rel=0.03)
    # what bounds a ghost is the stop, of which its light is the area, or another rim; 129 points across hold 3 %
    assert ((ratio > 0.97) & (ratio < 1.03 * area)).all()
    assert (ratio > 0.97 * area).sum() > 0.3 * len(ratio)
    bursts = [starburst(lens, sun_radius_rad=4.65e-3).pupil_radius_mm for lens in lenses]
    assert bursts[0] / bursts[1] == pytest.approx(math.sqrt(area), rel=1e-9)


def test_a_build_tells_how_a_lens_was_scaled(tmp_path: Path) -> None:
    settings = scene(lens="nikkor_35_f2p8", f_number=5.6, fov_deg=40.0).model_copy(
        update={"faults": {"dust_on_optics": {"model": "defocused"}}}
    )
    summary = dataset.build_scene(settings, tmp_path / "x.zarr", source="test", dry_run=True)
    focal = SIDE_PX * 88e-3 / 2 / math.tan(math.radians(20))
    assert f"Nikkor 35 mm f/2.8, scaled by {focal / 35.9993:.4g} to {focal:.4g} mm, f/5.6" in "\n".join(
        summary.lines()
    )
    runner = CliRunner()
    made = tmp_path / "lens.json"
    given = ["--focal-length-mm", "7", "--f-number", "5.6", "--out", str(tmp_path / "x.png"), "--json", str(made)]
    assert runner.invoke(app, ["lens", "nikkor_35_f2p8", *given]).exit_code == 0
    table = json.loads(made.read_text())
    assert (table["efl_mm"], table["real_f_number"]) == (pytest.approx(7.0), pytest.approx(5.6, rel=1e-6))
    assert table["scale"] == pytest.approx(7.0 / paraxial_properties(load_lens("nikkor_35_f2p8")).efl_mm)
    # the same scale and stop by the field that the sensor spans
    by_field = ["--fov-deg", "40", "--sensor-width-mm", str(SIDE_PX * 88e-3), "--f-number", "5.6", *given[4:]]
    assert runner.invoke(app, ["lens", "nikkor_35_f2p8", *by_field]).exit_code == 0
    assert json.loads(made.read_text())["scale"] == pytest.approx(focal / 35.9993, rel=1e-5)
    refused = runner.invoke(app, ["lens", "nikkor_35_f2p8", "--f-number", "1.2"])
    assert "f_number = 1.2: must be from 2.79" in str(refused.exception)


# --- what scaling keeps -----------------------------------------------------------------------------------------


def test_scaling_keeps_films_roughness_and_grains_and_lengthens_paths_in_glass() -> None:
    rows = to_table(load_lens("tessar_50_f2p8").coated("bbar"))
    for row in rows["surface"]:
        if "nd" in row:
            row["internal_transmittance_10mm"] = 0.9
    lens = parse_lens(rows, source="test")
    small = scaled_to_focal_length(lens, 5.0)
    factor = 5.0 / paraxial_properties(lens).efl_mm
    assert small.scale == pytest.approx(factor, rel=1e-12)
    assert small.scaled(2.0).scale == pytest.approx(2 * factor, rel=1e-12)
    for before, after in zip(lens.surfaces, small.surfaces, strict=True):
        assert after.coating == before.coating
        assert after.thickness_mm == pytest.approx(before.thickness_mm * factor)
    figures = [paraxial_properties(v) for v in (lens, small)]
    assert figures[1].f_number == pytest.approx(figures[0].f_number, rel=1e-12)
    # absorption per mm: the glass's share to the power of the scale; reflections as before
    clear = [
        replace(v, surfaces=tuple(replace(s, internal_transmittance_10mm=((D_NM,), (1.0,))) for s in v.surfaces))
        for v in (lens, small)
    ]

    def taken(v: Prescription) -> float:
        return RealLens(prescription=v, width_px=64, height_px=64, pixel_pitch_um=5.0).transmission

    assert taken(clear[0]) == pytest.approx(taken(clear[1]), rel=1e-12)
    assert taken(small) / taken(clear[1]) == pytest.approx((taken(lens) / taken(clear[0])) ** factor, rel=1e-9)
    glass_mm = sum(s.thickness_mm for s in lens.surfaces if s.medium.nd > 1)
    assert taken(lens) / taken(clear[0]) == pytest.approx(0.9 ** (glass_mm / 10), rel=1e-9)
    # in clear glass, roughness of 2 nm and particles of a level scatter the same share, over the same angles
    glare = [
        veiling_glare(v, Bands.lines(D_NM), sun_deg=10.0, cleanliness=Cleanliness(roughness_nm=2.0, level=300.0))
        for v in clear
    ]
    shape, pitch = (32, 32), 1.0
    at = [(f.efl_mm * math.tan(math.radians(10)), 0.0) for f in figures]
    images = [
        g.table[:, GlareLayout(g.efl_mm, xy, shape, pitch * scale).steps]
        for g, xy, scale in zip(glare, at, (1.0, factor), strict=True)
    ]
    # irradiance over the Sun's: of a lens f-number for f-number alike, at places in focal lengths alike
    np.testing.assert_allclose(images[1], images[0], rtol=2e-3)
    # grains: as many µm at either scale
    grains = []
    for focal in (40.0, 20.0):
        fault = from_dict("dust_on_optics", {"model": "defocused", "diameter_um": [80, 80]}, source="test")
        lens_at = real("tessar_50_f2p8", fov_deg=2 * math.degrees(math.atan(SIDE_PX * 88e-3 / 2 / focal)))
        grains.append(fault.draw(context(lens_at), np.random.default_rng(1)))
    assert grains[0]["diameter_um"] == grains[1]["diameter_um"]
    assert set(grains[0]["diameter_um"]) == {80.0}
