"""Straylight of the whole scene: against every lit pixel as a source, energy, and what the fault makes of it."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import needs_llvm, recorded_calls, small_scene, verified_store
from lens_kit import paraxial_ghosts, sunlit
from numpy.typing import NDArray
from test_faults_kit import flat_electrons, make_context

import vbnfault
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.files import array_files
from vbnfault.core.quantities import Electrons, Radiance
from vbnfault.core.spectra import Bands
from vbnfault.faults import FaultContext, from_dict
from vbnfault.lens import ThinLens, load_lens, paraxial_properties
from vbnfault.lens.prescription import Prescription
from vbnfault.lens.straylight import ghost_response
from vbnfault.lens.straylight.bundles import Tracer
from vbnfault.lens.straylight.ghosts import boxes, lit_cells
from vbnfault.lens.straylight.irradiance import traced_ghosts
from vbnfault.lens.straylight.scatter import Cleanliness
from vbnfault.lens.straylight.scene import PointSources, RenderGrid, SceneInLens, surrounding_grids
from vbnfault.lens.straylight.scene_convolution import POINT_SPREAD_PX, starburst_of_source, wing_fraction
from vbnfault.lens.straylight.settings import Baffle, DirectPath, SensorGrid, StraylightSettings, SunSource
from vbnfault.lens.straylight.starburst import StarburstFrame
from vbnfault.lens.straylight.total import SpreadLight, SunInLens, SunStraylight, ghosts
from vbnfault.lens.thin import Halo
from vbnfault.pipeline.record import to_sample
from vbnfault.scene import config

needs_llvm()

SKY_BODY = {"declination_deg": 0.0, "of_sunlight": 0.01}
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

NODES = np.array([550.0])
SINGLET = """
name = "singlet"
source = "test"
surface = [
  { radius_mm = 60.0, thickness_mm = 4.0, nd = 1.6, vd = 45.0, diameter_mm = 16.0 },
  { radius_mm = -60.0, thickness_mm = 2.0, diameter_mm = 16.0 },
  { stop = true, thickness_mm = 0.0, diameter_mm = 10.0 },
]
"""


def behind(
    lens: Prescription, size: int, fov_deg: float, *, guard: int = 0, nodes: F64 = NODES, **settings: Any
) -> SceneInLens:
    """A square frame behind a lens, and a render of it with a guard band."""
    efl_mm = paraxial_properties(lens).efl_mm
    focal_px = size / 2 / np.tan(np.radians(fov_deg / 2))
    return SceneInLens(
        lens=lens,
        bands=Bands.lines(*nodes),
        of_nodes=np.eye(len(nodes)),
        sensor=SensorGrid(shape=(size, size), pitch_mm=efl_mm / focal_px),
        render=RenderGrid(shape=(size + 2 * guard, size + 2 * guard), focal_px=float(focal_px)),
        image=ThinLens(focal_length_mm=efl_mm, f_number=2.8),
        settings=StraylightSettings(**settings),
        passed=np.full(len(nodes), 0.8),
    )


def disc(shape: tuple[int, int], x: float, y: float, radius: float) -> F32:
    """A lit disc, in fractions of the width, float32[1, y, x]."""
    height, width = shape
    row, column = np.mgrid[:height, :width] + 0.5
    lit = (np.hypot(column / width - x, row / height - y) < radius).astype(np.float32)
    return lit[None]


def points(grid: RenderGrid, radiance: F32, within: int) -> list[tuple[float, float, F64]]:
    """Slopes and irradiance float64[band] of points in all lit pixels, `within`² in each."""
    height, width = grid.shape
    focal = grid.focal_px
    offsets = (np.arange(within) + 0.5) / within
    out = []
    for row, column in zip(*np.nonzero(radiance.any(axis=0)), strict=True):
        for dy in offsets:
            for dx in offsets:
                x, y = (column + dx - width / 2) / focal, (row + dy - height / 2) / focal
                solid_sr = (1 + x * x + y * y) ** -1.5 / focal**2 / within**2
                out.append((x, y, radiance[:, row, column] * solid_sr))
    return out


def ghosts_of_every_pixel(
    scene: SceneInLens, radiance: F32, across: int = 64, within: int = 2, grid: RenderGrid | None = None
) -> F64:
    """Ghosts of points in all lit pixels, by exact rays that are counted in the pixels that they meet."""
    made = Tracer(scene.lens, scene.bands.nodes_nm)
    (height, width), pitch = scene.sensor.shape, scene.sensor.pitch_mm
    bands = len(scene.bands)
    out, rng = np.zeros((bands, height * width)), np.random.default_rng(1)
    for x, y, irradiance in points(grid or scene.render, radiance, within):
        slope, azimuth = np.hypot(x, y), np.arctan2(y, x)
        rays, _ = boxes(made, float(np.degrees(np.arctan(slope))))
        cosine = 1 / np.hypot(1, slope)
        for band in range(bands):
            # the same lattice for all sources would leave rings in the sum
            box = rays.box_mm + np.pad(
                rays.box_mm[:, 2:] * rng.uniform(-1, 1, (len(rays), 2)) / across, ((0, 0), (0, 2))
            )
            rays = replace(rays, wavelength=np.full(len(rays), band), box_mm=box)
            spots = made.trace(rays, across, centred=True)
            cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2 * cosine
            light = (lit_cells(spots, across).numpy().reshape(len(rays), -1) * cell[:, None]).ravel()
            sx, sy = spots.x_mm.numpy(), spots.y_mm.numpy()
            column = np.floor((sx * np.cos(azimuth) - sy * np.sin(azimuth)) / pitch + width / 2).astype(int)
            row = np.floor((sx * np.sin(azimuth) + sy * np.cos(azimuth)) / pitch + height / 2).astype(int)
            seen = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (light > 0)
            pixel = row[seen] * width + column[seen]
            out[band] += irradiance[band] * np.bincount(pixel, weights=light[seen], minlength=height * width)
    return out.reshape(bands, height, width) / pitch**2


def but_for_ghosts(light: SunInLens) -> SunStraylight:
    """Straylight of a Sun whose ghosts, which take most of the time, are left out."""

    def once(function: Any, *arguments: Any) -> Any:
        if function is not ghosts:
            return function(*arguments)
        bands, sensor = light.bands, light.sensor
        return SpreadLight.of(np.zeros((len(bands), *sensor.shape), np.float32), np.zeros(len(bands)), sensor)

    return light.straylight(once=once)


def scattered_of_every_pixel(
    scene: SceneInLens, radiance: F32, within: int = 2, grid: RenderGrid | None = None
) -> tuple[F64, F64]:
    """Glare and veil of points in all lit pixels, each computed as that of a Sun."""
    glare = np.zeros((len(scene.bands), *scene.sensor.shape))
    veil = np.zeros_like(glare)
    for x, y, irradiance in points(grid or scene.render, radiance, within):
        sun = SunSource(
            angle_deg=float(np.degrees(np.arctan(np.hypot(x, y)))),
            azimuth_deg=float(np.degrees(np.arctan2(y, x))),
            radius_rad=1e-3,  # of ghosts and starburst, which do not count here
        )
        light = SunInLens(
            lens=scene.lens,
            bands=scene.bands,
            sensor=scene.sensor,
            sun=sun,
            settings=scene.settings,
            path=DirectPath(transmittance=scene.passed, admitted_mm2=1.0),
        )
        parts = but_for_ghosts(light).parts()
        glare += irradiance[:, None, None] * parts["glare"]
        veil += irradiance[:, None, None] * parts["veil"]
    return glare, veil


def test_every_lit_pixel_as_a_source() -> None:
    """The added light is that of every lit pixel as a source, within 2 % of it, pixel by pixel."""
    scene = behind(
        load_lens("tessar_50_f2p8"),
        24,
        35.0,
        cleanliness=Cleanliness(roughness_nm=1.0, level=100),
        veil_fraction=0.01,
    )
    radiance = disc(scene.render.shape, 0.7, 0.4, 0.08)
    assert np.count_nonzero(radiance) == 10
    found = scene.straylight(radiance, np.eye(1))
    glare, veil = scattered_of_every_pixel(scene, radiance)
    oracle = ghosts_of_every_pixel(scene, radiance, within=3) + glare + veil
    # rays that are counted in pixels leave 1 %, and ghosts that are spread by half a pixel as much
    assert np.abs(found.total - oracle).sum() < 0.02 * oracle.sum()
    # the sum over the pixels has neither error
    assert found.total.sum() == pytest.approx(oracle.sum(), rel=0.005)


def with_blades(blades: int) -> Prescription:
    """A lens whose stop has so many blades; 0 is round."""
    lens = load_lens("tessar_50_f2p8")
    stop = replace(lens.surfaces[lens.stop], blades=blades, rotation_deg=17.0)
    return replace(lens, surfaces=(*lens.surfaces[: lens.stop], stop, *lens.surfaces[lens.stop + 1 :]))


def wings_of(scene: SceneInLens, points: list[tuple[float, float, F64]], width_px: float = 1) -> F64:
    """Starbursts of Suns as wide as so many pixels in place of points, beyond the point spread, at 550 nm."""
    (size, _), pitch, efl_mm = scene.sensor.shape, scene.sensor.pitch_mm, paraxial_properties(scene.lens).efl_mm
    side = (np.arange(size) + 0.5 - size / 2) * pitch / efl_mm
    cosine = 1 / np.sqrt(1 + side**2 + side[:, None] ** 2)
    expected = np.zeros((size, size))
    for x, y, irradiance in points:
        sun = SunSource(
            angle_deg=float(np.degrees(np.arctan(np.hypot(x, y)))),
            azimuth_deg=float(np.degrees(np.arctan2(y, x))),
            radius_rad=float(np.pi**-0.5 * width_px / scene.render.focal_px),
        )
        path = DirectPath(transmittance=scene.passed, admitted_mm2=1.0)
        light = but_for_ghosts(
            SunInLens(lens=scene.lens, bands=scene.bands, sensor=scene.sensor, sun=sun, path=path)
        )
        shorter = 1 / np.sqrt(1 + x * x + y * y)
        away = np.hypot(side * cosine - x * shorter, side[:, None] * cosine - y * shorter)
        fade = np.clip((away * efl_mm / pitch - POINT_SPREAD_PX + 1) / 2, 0, 1)
        expected += irradiance[0] * light.starburst.planes[0] * fade
    return expected


@pytest.mark.parametrize(("blades", "within"), [(0, 0.01), (5, 0.02)])
def test_the_stop_diffracts_light_of_every_lit_pixel(blades: int, within: float) -> None:
    """Beyond the point spread, every lit pixel has the starburst of a Sun as wide as the pixel."""
    scene = replace(behind(with_blades(blades), 48, 35.0), diffraction=True)
    radiance = disc(scene.render.shape, 0.55, 0.45, 0.05)
    made = scene.starburst([(scene.render, scene.render.irradiance(radiance))], np.eye(1))[0]
    expected = wings_of(scene, points(scene.render, radiance, 1))
    assert np.abs(made - expected).sum() < within * expected.sum()
    assert made.sum() == pytest.approx(expected.sum(), rel=0.005)


def test_what_the_stop_diffracts_is_part_of_the_straylight(singlet: Prescription) -> None:
    scene = replace(behind(singlet, 48, 35.0), diffraction=True)
    radiance = disc(scene.render.shape, 0.55, 0.45, 0.05)
    assert (
        scene.straylight(radiance, np.eye(1)).total.sum()
        > replace(scene, diffraction=False).straylight(radiance, np.eye(1)).total.sum()
    )


def test_the_stop_diffracts_light_of_points() -> None:
    """Of a point at 20 degrees, which counts as four pixels wide; two sources add up; a tube takes its part."""
    scene = replace(behind(with_blades(0), 48, 35.0), diffraction=True)
    light = np.ones((1, 1), np.float32)
    one, other = (PointSources(x=(x,), y=(0.2,), focal_px=scene.render.focal_px) for x in (0.3, -0.1))
    made = scene.starburst([(one, light)], np.eye(1))[0]
    expected = wings_of(scene, [(0.3, 0.2, np.ones(1))], one.block)
    assert made.sum() == pytest.approx(expected.sum(), rel=0.005)
    # nearer, the fade-in is finer than the steps of so wide a source
    column, row = scene.render.focal_px * np.array([0.3, 0.2]) + 24
    far = np.hypot(np.arange(48) + 0.5 - column, np.arange(48)[:, None] + 0.5 - row) > 16
    assert np.abs(made - expected)[far].sum() < 0.02 * expected[far].sum()
    both = scene.starburst([(one, light), (other, 2 * light)], np.eye(1))[0]
    apart = made + scene.starburst([(other, 2 * light)], np.eye(1))[0]
    assert np.abs(both - apart).sum() < 0.01 * apart.sum()  # where each of them is cut off at 0, the sum is not
    tube = Baffle(length_mm=18.0, radius_mm=8.0)
    behind_tube = replace(scene, settings=replace(scene.settings, baffle=tube))
    (lit,) = tube.lit_fraction(scene.lens, np.array([np.hypot(0.3, 0.2)]))
    assert 0.1 < lit < 0.9
    np.testing.assert_allclose(behind_tube.starburst([(one, light)], np.eye(1))[0], lit * made, rtol=1e-5)


def test_wings_lie_around_the_image_of_a_lens_that_distorts() -> None:
    """Also in the corner, farther from the axis than half the width."""

    @dataclass(frozen=True)
    class Distorting(ThinLens):
        def distorted(self, tangent: Any) -> Any:
            return np.asarray(tangent) * (1 + 0.5 * np.asarray(tangent) ** 2)

    plain = replace(behind(with_blades(0), 48, 35.0), diffraction=True)
    bent = replace(plain, image=Distorting(focal_length_mm=plain.image.focal_length_mm, f_number=2.8))
    x, light = 0.28, np.ones((1, 1), np.float32)
    tangent = float(np.hypot(x, x))
    assert tangent > max(plain.render.half)
    farther = x * (1 + 0.5 * tangent**2)
    made, wanted = (
        scene.starburst([(PointSources(x=(at,), y=(at,), focal_px=plain.render.focal_px), light)], np.eye(1))[0]
        for scene, at in ((bent, x), (plain, farther))
    )
    same = np.hypot(1, tangent) / np.hypot(1, np.hypot(farther, farther))  # light across the direction
    assert np.abs(made * same - wanted).sum() < 1e-3 * wanted.sum()


def test_the_tables_of_wings_are_made_once_and_not_for_dark_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    lens, nodes = with_blades(0), Bands.lines(450.0, 650.0)
    assert starburst_of_source(lens, nodes, 1e-3) == starburst_of_source(lens, nodes, 1e-3)  # and so their tables
    # a narrower disc would have rings that the tables do not resolve: at least three Airy units of the longest wave
    airy_rad = 650e-6 / paraxial_properties(lens).entrance_pupil_diameter_mm
    assert starburst_of_source(lens, nodes, 1e-9).sun_radius_rad == pytest.approx(3 * airy_rad)
    monkeypatch.setattr("vbnfault.lens.straylight.scene._wings", pytest.fail)
    scene = replace(behind(lens, 16, 35.0), diffraction=True)
    dark = np.zeros((1, scene.render.shape[0] ** 2), np.float32)
    assert not scene.starburst([(scene.render, dark)], np.eye(1)).any()


def test_the_image_loses_what_the_stop_diffracts() -> None:
    """Light in the frame and beyond it, beyond 7 px, is the fraction that the image loses, but for the fade-in."""
    scene = replace(behind(with_blades(6), 96, 20.0), diffraction=True)
    burst = starburst_of_source(scene.lens, scene.bands, 1 / scene.render.focal_px)
    point = np.zeros((1, 96, 96), dtype=np.float32)
    point[0, 48, 48] = 1
    irradiance = scene.render.irradiance(point)
    inside = (
        scene.starburst([(scene.render, irradiance)], np.eye(1)).sum(dtype=np.float64) * scene.sensor.pitch_mm**2
    )
    frame = StarburstFrame(sun_xy_mm=(0.0, 0.0), bands=scene.bands, sensor=scene.sensor)
    passed_mm2 = (
        0.8 * irradiance.sum() * np.pi / 4 * paraxial_properties(scene.lens).entrance_pupil_diameter_mm ** 2
    )
    beyond = 0.8 * irradiance.sum() * burst.beyond_mm2(frame)[0]
    lost = wing_fraction(burst, scene.bands, scene.sensor)[0]
    assert (inside + beyond) / passed_mm2 == pytest.approx(lost, rel=0.03)


def flux_of(response: ghost_response.GhostResponse) -> F64:
    """The flux of the ghosts on all rings of the sensor in mm², float64[band, source ring]."""
    cells = response.cells
    area_mm2 = 2 * np.pi * (np.arange(cells.rings) + 0.5) * cells.ring_mm**2
    return np.asarray(np.einsum("bmk,m->bk", response.table[:, 0].astype(np.float64) / cells.azimuths, area_mm2))


def test_the_response_has_the_flux_of_the_traced_ghosts(singlet: Prescription) -> None:
    """On a sensor that holds the whole ghost, for every field angle."""
    scene = behind(singlet, 32, 150.0)
    response = scene.response
    slopes = np.array(response.cells.slopes)
    pupil_mm2 = np.pi / 4 * paraxial_properties(singlet).entrance_pupil_diameter_mm ** 2
    for ring in (0, 1, 2, 3):
        angle_deg = float(np.degrees(np.arctan(slopes[ring])))
        ghosts = traced_ghosts(singlet, angle_deg, bands=Bands.lines(550.0))
        flux_mm2 = sum(g.flux_fraction for g in ghosts) * pupil_mm2 * np.cos(np.radians(angle_deg))
        # the flux falls between neighbouring rings, over which a ring is the mean, by about 1 %
        assert flux_of(response)[0, ring] == pytest.approx(flux_mm2, rel=0.02)


def test_sources_without_ghosts_on_the_sensor(singlet: Prescription) -> None:
    """Far out of the field no ghost arrives; in it, a sensor that is small beside the ghost has its irradiance."""
    scene = behind(singlet, 8, 1.0)
    scene = replace(scene, around=surrounding_grids(scene.render))
    table = scene.response.table
    (ghost,) = paraxial_ghosts(singlet, 0.0, bands=Bands.lines(550.0))
    # near the axis exact rays are paraxial; rings are sums over few rays each
    irradiance = table[0, 0, :, 0].mean() / scene.response.cells.azimuths
    assert irradiance == pytest.approx(ghost.peak_irradiance_fraction, rel=0.01)
    assert not table[..., -1].any()


def test_worn_coatings_are_a_polynomial_in_the_loss(singlet: Prescription) -> None:
    """So a loss that was not traced has the flux of one that is."""
    coated = singlet.coated("mgf2")
    for loss in (0.3, 1.0):
        scene = behind(coated, 16, 30.0, coating_loss=loss)
        made = Tracer(coated, NODES).worn(loss)
        x = 0.5 * scene.response.cells.slopes[-1]
        ring = int(np.argmin(np.abs(np.array(scene.response.cells.slopes) - x)))
        rays, _ = boxes(made, float(np.degrees(np.arctan(scene.response.cells.slopes[ring]))))
        spots = made.trace(rays, 200, centred=True)
        cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / 200**2
        near = np.hypot(spots.x_mm.numpy(), spots.y_mm.numpy()) < 0.8 * scene.response.cells.reach_mm
        exact = (lit_cells(spots, 200).numpy() * near).sum() * cell[0]
        table = scene.response.table[0, 0, :, ring] / scene.response.cells.azimuths
        radius = (np.arange(len(table)) + 0.5) * scene.response.cells.ring_mm
        inside = radius < 0.8 * scene.response.cells.reach_mm
        flux = (table * 2 * np.pi * radius * scene.response.cells.ring_mm)[inside].sum()
        edge = radius[inside][-1] + scene.response.cells.ring_mm / 2
        flux *= (0.8 * scene.response.cells.reach_mm / edge) ** 2
        assert flux == pytest.approx(exact, rel=0.02)


def test_nothing_reflects_nothing_scatters_nothing_is_added(singlet: Prescription) -> None:
    """A single surface has no pair that reflects; a smooth and clean one scatters nothing."""
    glass = singlet.surfaces[0].medium
    single = replace(singlet, surfaces=tuple(replace(s, medium=glass) for s in singlet.surfaces))
    for lens, has_ghosts in ((single, False), (singlet, True)):
        scene = behind(lens, 16, 30.0, cleanliness=Cleanliness(roughness_nm=0.0, level=0), veil_fraction=0.0)
        found = scene.straylight(disc(scene.render.shape, 0.6, 0.4, 0.2), np.eye(1))
        assert found.ghosts.any() == has_ghosts
        assert not found.glare.any()
        assert not found.veil.any()


def test_linear_in_the_radiance(singlet: Prescription) -> None:
    """Twice the light is twice the straylight, bit for bit; two sources add up."""
    scene = behind(singlet, 32, 30.0, guard=4, cleanliness=Cleanliness(roughness_nm=1.0, level=100))
    one, other = (disc(scene.render.shape, *place) for place in ((0.7, 0.4, 0.1), (0.02, 0.9, 0.05)))
    light = scene.straylight(one, np.eye(1)).total
    np.testing.assert_array_equal(scene.straylight(2 * one, np.eye(1)).total, 2 * light)
    both = scene.straylight(one + other, np.eye(1)).total
    np.testing.assert_allclose(both, light + scene.straylight(other, np.eye(1)).total, rtol=1e-4)
    assert not scene.straylight(0 * one, np.eye(1)).total.any()


def test_sources_out_of_the_field() -> None:
    """A lit patch beside the frame, in a coarse render around it, as points of that patch."""
    scene = behind(
        load_lens("tessar_50_f2p8"),
        24,
        35.0,
        cleanliness=Cleanliness(roughness_nm=1.0, level=100),
        veil_fraction=0.01,
    )
    grids = surrounding_grids(scene.render)
    scene = replace(scene, around=grids)
    dark = np.zeros((1, *scene.render.shape), np.float32)
    around = [np.zeros((1, *grid.shape), np.float32) for grid in grids]
    # the frame covers ± 16 of these pixels
    around[0][0, 61:64, 84:87] = 1
    assert grids[0].outside[62, 86] == 1
    found = scene.straylight(dark, np.eye(1), around)
    glare, veil = scattered_of_every_pixel(scene, around[0], grid=grids[0])
    ghosts = ghosts_of_every_pixel(scene, around[0], grid=grids[0])
    for own, oracle in ((found.ghosts, ghosts), (found.glare, glare), (found.veil, veil)):
        assert oracle.any()
        # cells of sources are as coarse as the pixels of the patch
        assert own.sum() == pytest.approx(oracle.sum(), rel=0.03)
        assert np.corrcoef(own.ravel(), oracle.ravel())[0, 1] > 0.99


def test_what_two_renders_show_counts_once() -> None:
    """A sky of one brightness: the pixels of all renders together have its projected solid angle, π sin² of 75°."""
    main = RenderGrid(shape=(48, 64), focal_px=600.0)
    total = 0.0
    for grid in (main, *surrounding_grids(main)):
        slope = np.hypot(*grid.slopes)
        sky = grid.irradiance(np.ones((1, *grid.shape), np.float32))[0]
        inside = slope < np.tan(np.radians(70))
        total += float((sky / np.hypot(1, slope))[inside].sum())
    # pixels at the edge of the circle count whole or not at all
    assert total == pytest.approx(np.pi * np.sin(np.radians(70)) ** 2, rel=0.005)


def test_light_of_the_guard_band_counts_and_a_baffle_keeps_it_out(singlet: Prescription) -> None:
    open_ = behind(singlet, 32, 30.0, guard=8, cleanliness=Cleanliness(roughness_nm=1.0, level=100))
    beyond = np.zeros((1, *open_.render.shape), dtype=np.float32)
    beyond[:, :, :8] = 1
    assert open_.straylight(beyond, np.eye(1)).total.min() > 0
    tube = Baffle(length_mm=18.0, radius_mm=8.0)
    behind_tube = replace(open_, settings=replace(open_.settings, baffle=tube))
    added, less = (scene.straylight(beyond, np.eye(1)) for scene in (open_, behind_tube))
    # at the edge of the guard band, 22 degrees, the tube lights 43 % of the entrance
    for part in ("ghosts", "glare", "veil"):
        assert 0.2 < getattr(less, part).sum() / getattr(added, part).sum() < 0.6


# --- the response on disk -----------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder."""
    monkeypatch.setenv(array_files.FOLDER_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def fresh(scene: SceneInLens) -> F32:
    """The table that a new process gets."""
    ghost_response._response.cache_clear()
    return scene.response.table


def test_a_response_is_traced_once_and_read_by_others(
    singlet: Prescription, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bit for bit; damage is found, whichever byte it is in, and the response is traced and kept again."""
    scene = behind(singlet, 8, 30.0)
    tables = recorded_calls(monkeypatch, ghost_response._Tracing, "table")
    traced = fresh(scene)
    (path,) = folder.iterdir()
    good = path.read_bytes()
    np.testing.assert_array_equal(fresh(scene), traced)
    assert len(tables) == 1
    for place in (3, 40, 300, len(good) // 2, len(good) - 5):
        damaged = bytearray(good)
        damaged[place] ^= 4
        path.write_bytes(damaged)
        np.testing.assert_array_equal(fresh(scene), traced)
        assert "the response of ghosts kept there is damaged" in capsys.readouterr().err
        assert path.read_bytes() == good
    assert len(tables) == 6


def test_what_changes_a_response_changes_its_key(singlet: Prescription) -> None:
    scene = behind(singlet, 8, 30.0)

    def key(
        lens: Prescription = singlet, nm: float = 550.0, loss: float = 0.0, of: Any = scene, **keys: Any
    ) -> str:
        settings = replace(scene.settings.ghosts, **keys)
        return ghost_response.response_key(lens, Bands.lines(nm), of.response.cells, settings, loss)

    first, *others = singlet.surfaces
    changed = [
        replace(first, radius_mm=61.0),
        replace(first, semi_diameter_mm=7.9),
        replace(first, medium=replace(first.medium, coefficients=(1.61, 0.0))),
        replace(first, conic=0.1),
        replace(first, internal_transmittance_10mm=((400.0, 700.0), (0.9, 0.9))),
    ]
    keys = [
        key(),
        *(key(replace(singlet, surfaces=(surface, *others))) for surface in changed),
        key(singlet.coated("mgf2")),
        key(replace(singlet, sensor_reflectance=0.1)),
        key(nm=551.0),
        key(loss=0.5),
        key(model="paraxial"),
        key(of=behind(singlet, 8, 31.0)),
        key(of=behind(singlet, 10, 30.0)),
    ]
    assert len(set(keys)) == len(keys)
    assert key(replace(singlet, name="other", source="other")) == keys[0]


# --- the fault --------------------------------------------------------------------------------------------------


def context(sun: tuple[float, float] | None, *, lit: bool = True, size: int = 64) -> FaultContext:
    """A frame with a lit disc in it, or a user's own image without a radiance."""
    made = make_context(size, sun_xy_px=sun, exposure_s=1e-3)
    nodes = spectra.band_nodes_nm(400.0, 700.0, 2)
    lit_disc = np.repeat(disc((size, size), 0.6, 0.6, 0.25), 2, axis=0) * np.float32(10)
    radiance = Radiance(array=lit_disc, wavelength_nm=nodes) if lit else None
    return sunlit(made, nodes, 3.0, radiance=radiance)


def injected(where: FaultContext, light: Electrons, lens: Path, **keys: Any) -> tuple[F32, Any]:
    """The light after straylight, [y, x, channel], and the fault."""
    fault = from_dict("straylight", {"model": "traced", "lens": str(lens), **keys}, source="test.toml")
    params = fault.draw(where, np.random.default_rng(3))
    return fault.apply(light, params, where).array, fault


def test_the_scene_adds_light_without_a_sun(singlet_file: Path) -> None:
    where = context(None)
    black = flat_electrons(where, 0.0)
    nothing, of_sun = injected(where, black, singlet_file)
    added, of_scene = injected(where, black, singlet_file, sources="scene")
    assert not nothing.any()
    assert added.min() > 0
    assert of_sun.needs_sun
    assert not of_scene.needs_sun
    grey = flat_electrons(where, 0.5)
    left = injected(where, grey, singlet_file, sources="scene")[0] - added
    lost = 1 - left / grey.array
    assert (lost > 0.004).all()  # the veil takes at least 0.5 % of the image
    assert (lost < 0.04).all()


def scene_lost(where: FaultContext, lens: Path, **keys: Any) -> F64:
    """The fraction of the image that becomes straylight, with diffraction unless `keys` say otherwise."""
    given = {"model": "traced", "lens": str(lens), "sources": "scene", "scene_diffraction": True, **keys}
    fault = from_dict("straylight", given, source="test.toml")
    return np.asarray(fault.scene_lost(fault.draw_state(where, np.random.default_rng(3)), where))


def test_the_scenes_diffraction_is_off_unless_asked_for(singlet_file: Path) -> None:
    where = context(None)
    grey = flat_electrons(where, 0.5)
    plain = injected(where, grey, singlet_file, sources="scene")[0]
    wings, fault = injected(where, grey, singlet_file, sources="scene", scene_diffraction=True)
    assert "scene_diffraction" not in injected(where, grey, singlet_file, sources="scene")[1].draw_state(
        where, np.random.default_rng(3)
    )
    assert fault.draw_state(where, np.random.default_rng(3))["scene_diffraction"] is True
    assert wings.mean() > plain.mean()  # the lit disc is far brighter than the grey image
    assert (wings > 0.9 * plain).all()  # which loses some percent at most
    lost = scene_lost(where, singlet_file)
    veil_alone = scene_lost(where, singlet_file, scene_diffraction=False)
    wings_alone = scene_lost(where, singlet_file, veil_fraction=0.0, roughness_nm=0.0, cleanliness_level=0)
    assert (wings_alone > 0.001).all()
    np.testing.assert_allclose(1 - lost, (1 - veil_alone) * (1 - wings_alone), atol=1e-4)
    # nothing is in the image of what is not rendered, and a measured point spread holds the wings already
    halo = Halo(core_rad=1e-4, halo_fraction=0.1, halo_rad=1e-3, halo_index=3.0)
    blurred = replace(where, camera=replace(where.camera, lens=replace(where.camera.lens, halo=halo)))
    for without in (context(None, lit=False), blurred):
        np.testing.assert_array_equal(scene_lost(without, singlet_file), veil_alone)
    with pytest.raises(InputError, match="scene_diffraction: needs sources = 'scene'"):
        from_dict("straylight", {"model": "traced", "scene_diffraction": True}, source="scene.toml")


def test_the_scene_comes_on_top_of_the_sun(singlet_file: Path) -> None:
    sun, both = (
        injected(context((50.0, 20.0)), flat_electrons(context(None), 0.0), singlet_file, sources=s)[0]
        for s in ("sun", "scene")
    )
    alone = injected(context(None), flat_electrons(context(None), 0.0), singlet_file, sources="scene")[0]
    np.testing.assert_allclose(both, sun + alone, rtol=1e-5)


def test_an_image_without_a_radiance_gets_the_veil_of_its_own_light(singlet_file: Path) -> None:
    where = context((50.0, 20.0), lit=False)
    grey = flat_electrons(where, 0.5)
    np.testing.assert_array_equal(
        injected(where, grey, singlet_file, sources="scene")[0], injected(where, grey, singlet_file)[0]
    )


@pytest.fixture(scope="module")
def singlet_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("lens") / "singlet.toml"
    path.write_text(SINGLET)
    return path


@pytest.fixture(scope="module")
def singlet(singlet_file: Path) -> Prescription:
    return load_lens(singlet_file)


# --- a dataset --------------------------------------------------------------------------------------------------


def test_a_store_holds_the_straylight_of_the_scene(tmp_path: Path, singlet_file: Path) -> None:
    """Built, verified and simulated again: the same pixels, and labels that belong to them."""
    table = small_scene(
        dataset={
            "samples": 1,
            "layers": ["clean", "without_straylight", "mask_effect", "straylight_added"],
        },
        camera={"width_px": 64, "height_px": 48},
        plan={"faulty_fraction": 1.0},
        geometry={"min_lit_fraction": 0.2},
        sky={"bodies": [{"planet": "jupiter"}, *(SKY_BODY | {"right_ascension_deg": ra} for ra in (0.0, 180.0))]},
    )
    table["faults"] = {"straylight": {"model": "traced", "sources": "scene", "lens": str(singlet_file)}}
    scene = config.parse_scene(table, source="test")
    out = tmp_path / "scene.zarr"
    verified_store(scene, out)
    data = vbnfault.open_dataset(out)
    frame = vbnfault.Session(scene).frame(0)
    stored, sample = data.isel(sample=0), to_sample(frame)
    jupiter, *both = frame.context.far_sources
    sunlight = spectra.solar_band_irradiance_W_m2_nm(frame.context.wavelength_nm, 1.0)
    assert (jupiter.irradiance_W_m2_nm < 1e-9 * sunlight).all()
    # of two opposite bodies, the ground hides at least one
    assert sum(source.irradiance_W_m2_nm.any() for source in both) <= 1
    np.testing.assert_allclose(both[0].direction_C, -both[1].direction_C, atol=1e-12)
    for name in ("image", "clean", "mask", "mask_effect", "straylight_added"):
        np.testing.assert_array_equal(stored[name].values, sample.layers[name])
    assert stored["injected"].values.all()
    assert json.loads(str(stored["parameters"].values))["straylight"]["sources"] == "scene"
    assert (stored["straylight_added"].values > 0).all()
