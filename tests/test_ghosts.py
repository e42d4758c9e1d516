"""Ghosts by exact rays and their pictures, against the double-precision trace, matrices and closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import needs_llvm, recorded_calls, render_threads
from lens_kit import paraxial_ghosts, pixel_mm
from test_lens import BACK, GLASS, STOP

from vbnfault.core.spectra import Bands
from vbnfault.lens import load_lens, paraxial_properties, parse_lens, scaled_to_focal_length
from vbnfault.lens.glass import D_NM
from vbnfault.lens.prescription import Prescription
from vbnfault.lens.rays import path_of, trace
from vbnfault.lens.straylight import ghosts, irradiance
from vbnfault.lens.straylight.bundles import Rays, Tracer, name_of, routes
from vbnfault.lens.straylight.ghosts import boxes, lit_cells
from vbnfault.lens.straylight.irradiance import FlareModel, disc_samples, traced_ghosts
from vbnfault.lens.straylight.raster import _EDGE_NODES, EDGE_HIGH, EDGE_LOW, Sums, edge_profiles
from vbnfault.lens.straylight.settings import GhostSettings, SensorGrid

needs_llvm()

LENSES = (
    "nikkor_35_f2p8",
    "nikkor_28_f2p8",
    "distagon_25_f2p8",
    "tessar_50_f2p8",
    "heliar_100_f3p5",
    "biotar_100_f1p4",
)


def bundle(route: int, box: tuple[float, float, float, float], direction: Any) -> Rays:
    direction = np.asarray(direction, dtype=float)
    return Rays(
        route=np.array([route]),
        wavelength=np.array([0]),
        box_mm=np.array([box]),
        direction=(direction / np.linalg.norm(direction))[None],
    )


def both_ways(lens: Prescription, made: Tracer, rays: Rays, across: int) -> tuple[Any, Any, Any, Any]:
    """Places in single and in double precision, float64[n, 2], radii in single, and what arrives in double."""
    spots = made.trace(rays, across)
    single = np.column_stack([spots.x_mm.numpy(), spots.y_mm.numpy()]).astype(np.float64)
    cx, cy, hx, hy = rays.box_mm[0]
    side = np.linspace(-1, 1, across)
    x, y = np.meshgrid(cx + hx * side, cy + hy * side)
    start = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    path = path_of(lens, made.routes[rays.route[0]])
    found = trace(lens, start, np.tile(rays.direction[0], (len(start), 1)), path=path)
    return single, found.points_mm[-1, :, :2], spots.radius.numpy(), found


@pytest.mark.parametrize("name", LENSES)
def test_single_precision_keeps_to_a_hundredth_of_a_pixel(name: str) -> None:
    lens = load_lens(name)
    made = Tracer(lens, np.array([D_NM]), routes_=[()])
    radius = paraxial_properties(lens).entrance_pupil_diameter_mm / 2
    for degrees in (0.0, 10.0, 20.0):
        slope = np.tan(np.radians(degrees))
        aim = -slope * paraxial_properties(lens).entrance_pupil_mm
        rays = bundle(0, (aim, 0.0, radius, radius), [slope, 0.0, 1.0])
        single, double, beyond, found = both_ways(lens, made, rays, 31)
        kept = found.arrives
        assert kept.sum() > 100
        np.testing.assert_array_equal(beyond[kept] < 1 + 1e-5, True)
        assert np.hypot(*(single - double)[kept].T).max() < 0.01 * pixel_mm(lens)


def test_ghosts_of_a_kernel_are_those_of_exact_rays() -> None:
    """Every ghost of a lens. Float32 carries 6e-8 of some 50 mm through up to 27 surfaces, and a ghost's last
    gap magnifies angles: the worst ray errs by a fiftieth of a pixel, half of them by less than a thousandth."""
    lens = load_lens("nikkor_35_f2p8")
    made = Tracer(lens, np.array([D_NM]))
    rays = replace(boxes(made, 12.0)[0], disc=None)  # on the lattice that is traced in double precision
    assert len(rays) > 40
    off = []
    for k in range(len(rays)):
        single, double, beyond, found = both_ways(lens, made, rays.take(np.array([k])), 15)
        kept = found.arrives
        assert ((beyond <= 1) == kept).mean() > 0.99  # a rim's own ray may fall on either side
        off.append(np.hypot(*(single - double)[kept & (beyond <= 1)].T))
    every = np.concatenate(off) / pixel_mm(lens)
    assert every.max() < 0.02
    assert np.median(every) < 1e-3


def test_aspheres_conics_and_glass_that_absorbs() -> None:
    rows = [
        STOP,
        GLASS | {"conic": -0.7, "aspheric_mm": [2e-6, -1e-8], "internal_transmittance_10mm": 0.5},
        BACK | {"conic": 1.2},
    ]
    lens = parse_lens({"surface": rows}, source="asphere")
    made = Tracer(lens, np.array([D_NM]), routes_=[(), (2, 1)])
    for route in (0, 1):
        rays = bundle(route, (0.0, 0.0, 4.0, 4.0), [0.1, 0.0, 1.0])
        single, double, _, found = both_ways(lens, made, rays, 15)
        assert np.abs(single - double)[found.arrives].max() < 1e-4
    straight = made.trace(bundle(0, (0.0, 0.0, 1e-3, 1e-3), [0.0, 0.0, 1.0]), 3).fraction.numpy()
    n = 1.5
    assert straight == pytest.approx((1 - ((n - 1) / (n + 1)) ** 2) ** 2 * 0.5**0.4, rel=1e-4)


def test_paths_of_four_reflections_and_the_sensor_as_a_mirror() -> None:
    lens = load_lens("tessar_50_f2p8")
    mirrors = 7
    assert len(routes(lens)) == mirrors * (mirrors - 1) / 2
    four = [r for r in routes(lens, 4) if len(r) == 4]
    assert all(b > a and d > c and d > a for b, a, d, c in four)
    rows = [(row, mirror) for row, mirror in path_of(lens, (3, 1, 2, 0)) if mirror]
    assert rows == [(3, True), (1, True), (2, True), (0, True)]
    # two ghosts of four reflections on the same rows keep names of their own
    assert name_of((3, 1, 2, 0)) == (1, 3, 0, 2) != name_of((3, 0, 2, 1))
    assert [row for row, _ in path_of(lens, (2, 0, 1, 0))] == [0, 1, 2, 1, 0, 1, 0, 1, 2, 3, 4, 5, 6, 7]
    made = Tracer(lens, np.array([D_NM]), routes_=[(3, 1, 2, 0)])
    single, double, _, found = both_ways(lens, made, bundle(0, (0, 0, 1.0, 1.0), [0.02, 0, 1]), 9)
    assert np.abs(single - double)[found.arrives].max() < 5e-4
    shiny = replace(lens, sensor_reflectance=0.3)
    assert len(routes(shiny)) == (mirrors + 1) * mirrors / 2
    back = {g.pair: g for g in traced_ghosts(shiny, 1.0, across=64)}
    assert back[(0, 8)].flux_fraction > back[(0, 7)].flux_fraction
    dark = {g.pair: g for g in traced_ghosts(replace(lens, sensor_reflectance=0.15), 1.0, across=64)}
    assert dark[(0, 8)].flux_fraction == pytest.approx(back[(0, 8)].flux_fraction / 2, rel=1e-5)


def test_one_side_tells_of_the_other() -> None:
    """With the blades of a stop the sides differ by what passes, and not by where it goes."""
    lens = load_lens("tessar_50_f2p8")
    stop = lens.surfaces[lens.stop]
    bladed = replace(stop, blades=5, rotation_deg=13.0)
    lens = replace(lens, surfaces=tuple(bladed if s is stop else s for s in lens.surfaces))
    made = Tracer(lens, np.array([450.0, 600.0]), routes_=[(3, 1), (7, 5)]).turned(0.4)
    rays = Rays(
        route=np.array([0, 1]),
        wavelength=np.array([1, 0]),
        box_mm=np.array([[0.0, 0.0, 6.0, 7.0], [1.0, 0.0, 8.0, 5.0]]),
        direction=np.tile([np.sin(0.1), 0.0, np.cos(0.1)], (2, 1)),
        disc=np.array([0.0, 1.2]),
    )
    width = np.full(len(made.rows), 0.01)
    for across in (np.array([8, 8]), np.array([9, 12])):
        half, whole = (made.trace(rays, across, width, halved=h) for h in (True, False))
        kept = [spots.margin.numpy() > -1 for spots in (half, whole)]
        assert kept[0].shape == ((across**2).sum(),)
        assert (kept[0] == kept[1]).mean() > 0.99
        both = kept[0] & kept[1]
        for name in ("x_mm", "y_mm", "fraction", "radius", "margin"):
            one, other = (getattr(spots, name).numpy()[both] for spots in (half, whole))
            # single precision, from mirrored starts; margins are a hundred times radii
            np.testing.assert_allclose(one, other, rtol=5e-5, atol=2e-3 if name == "margin" else 5e-5)
        assert len(np.unique(half.radius.numpy() <= 1)) == 2


# --- the table of ghosts ----------------------------------------------------------------------------------------


def test_flux_converges_with_the_number_of_rays() -> None:
    lens = load_lens("tessar_50_f2p8")
    counts = (32, 64, 128, 256)
    found = [{g.pair: g.flux_fraction for g in traced_ghosts(lens, 8.0, across=n)} for n in (*counts, 1024)]
    best = found[-1]
    worst = [max(abs(f.get(pair, 0) / best[pair] - 1) for pair in best) for f in found[:-1]]
    # what a rim's cells err by falls at least as fast as the rays' spacing
    slope = np.polyfit(np.log(counts), np.log(worst), 1)[0]
    assert slope < -1
    assert worst[-1] < 0.003


@pytest.mark.parametrize("model_", ["traced", "paraxial"])
def test_ghosts_turn_with_the_sun_and_lie_on_the_axis_under_it(model_: str) -> None:
    lens = load_lens("nikkor_35_f2p8")
    one, other = (traced_ghosts(lens, 9.0, azimuth_deg=a, across=96, model=model_) for a in (0.0, 130.0))
    turn = np.radians(130.0)
    for a, b in zip(one, other, strict=True):
        assert a.pair == b.pair
        assert b.flux_fraction == pytest.approx(a.flux_fraction, rel=1e-9)
        x, y = a.centroid_mm
        expected = (x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn))
        assert b.centroid_mm == pytest.approx(expected, abs=1e-9)
        assert abs(y) < 1e-6 * a.rms_radius_mm
    for ghost in traced_ghosts(lens, 0.0, across=96, model=model_):
        assert np.hypot(*ghost.centroid_mm) < 1e-6 * ghost.rms_radius_mm


def test_paraxial_rays_are_the_limit_of_a_small_stop_and_angle() -> None:
    """Flux and place of every ghost: what differs falls as the square of aperture and angle together."""
    lens = load_lens("nikkor_28_f2p8")
    differ = []
    shares = (1.0, 0.5, 0.25)
    for share in shares:
        surfaces = list(lens.surfaces)
        rim = surfaces[lens.stop].semi_diameter_mm
        surfaces[lens.stop] = replace(surfaces[lens.stop], semi_diameter_mm=0.2 * share * rim)
        small = replace(lens, surfaces=tuple(surfaces))
        angle = 2.0 * share
        traced = {g.pair: g for g in traced_ghosts(small, angle, across=160)}
        first = {g.pair: g for g in paraxial_ghosts(small, angle, across=160)}
        pairs = [p for p in first if p in traced]
        assert len(pairs) > 60
        apart = [
            np.hypot(*np.subtract(traced[p].centroid_mm, first[p].centroid_mm)) / np.hypot(*first[p].centroid_mm)
            for p in pairs
        ]
        differ.append(np.median(apart))
    slope = np.polyfit(np.log(shares), np.log(differ), 1)[0]
    assert 1.6 < slope < 2.4
    assert differ[-1] < 2e-3


def test_coatings_and_blades_in_the_flux() -> None:
    lens = load_lens("tessar_50_f2p8")
    flux = [sum(g.flux_fraction for g in traced_ghosts(lens.coated(c), 5.0, across=64)) for c in ("none", "bbar")]
    assert flux[1] < 0.02 * flux[0]


def test_blades_bound_the_beam() -> None:
    """A beam along the axis, through a stop alone: what passes is the area of its outline."""
    rows = [STOP | {"blades": 5, "blade_rounding": 0.3, "rotation_deg": 20.0}, GLASS, BACK]
    lens = parse_lens({"surface": rows}, source="bladed")
    stop = lens.surfaces[0]
    made = Tracer(lens, np.array([D_NM]), routes_=[()])
    across = 400
    spots = made.turned(0.0).trace(bundle(0, (0, 0, 5.0, 5.0), [0, 0, 1]), across, centred=True)
    angle = np.linspace(0, 2 * np.pi, 100_000, endpoint=False)
    area = np.mean(stop.rim_mm(angle) ** 2) / (4 / np.pi * stop.semi_diameter_mm**2)
    passes = spots.radius.numpy().reshape(across, across) <= 1
    assert passes.mean() == pytest.approx(area, rel=2e-3)
    # a corner at 20° from +x towards +y, the middle of an edge opposite
    side = (np.arange(across) + 0.5) / across * 10 - 5
    x, y = np.meshgrid(side, side)
    reach = [np.max((x * np.cos(t) + y * np.sin(t)) * passes) for t in np.radians([20.0, 200.0])]
    assert reach == pytest.approx([5.0, float(stop.rim_mm(np.radians(200.0)))], abs=0.03)


# --- pictures ---------------------------------------------------------------------------------------------------


def model(lens: Prescription, **more: Any) -> FlareModel:
    given: dict[str, Any] = {"shape": (160, 200), "pitch_mm": 0.2, "sun_radius_rad": 2e-3} | more
    sensor = SensorGrid(shape=given.pop("shape"), pitch_mm=given.pop("pitch_mm"))
    bands, radius = given.pop("bands", Bands.lines(D_NM)), given.pop("sun_radius_rad")
    return FlareModel(lens, bands, sensor, sun_radius_rad=radius, settings=GhostSettings(**given))


@pytest.mark.parametrize(("kind", "worst"), [("traced", 0.05), ("paraxial", 0.01)])
def test_a_picture_holds_the_flux_of_its_ghosts(kind: str, worst: float) -> None:
    """Every ghost by itself that lies within the frame: light and place as its rays have them. Cells of a lattice
    are linear in it: exact for paraxial ghosts but for their rims; of the others the most distorted err most."""
    lens = load_lens("tessar_50_f2p8")
    pitch, half = 0.5, 120
    made = model(lens, model=kind, pitch_mm=pitch, shape=(2 * half, 2 * half), diffraction=False, across=73)
    area = np.pi / 4 * paraxial_properties(lens).entrance_pupil_diameter_mm ** 2
    told = (
        {g.pair: g for g in traced_ghosts(lens, 6.0, azimuth_deg=40.0, across=192)}
        if kind == "traced"
        else {g.pair: g for g in paraxial_ghosts(lens, 6.0, azimuth_deg=40.0, across=192)}
    )
    axis = (np.arange(2 * half) + 0.5 - half) * pitch
    rays, arrivals = boxes(made._tracer, 6.0)
    off = []
    for route, least, most in zip(rays.route, arrivals.least_mm, arrivals.most_mm, strict=True):
        ghost = told[name_of(made._tracer.routes[route])]
        if max(np.abs(least).max(), np.abs(most).max()) > 0.7 * half * pitch:
            continue
        picture = made.image(6.0, 40.0, only=ghost.pair)[0].astype(np.float64)
        light = picture.sum()
        off.append(light * pitch**2 / (np.cos(np.radians(6.0)) * area) / ghost.flux_fraction - 1)
        x, y = (picture.sum(axis=0) @ axis) / light, (picture.sum(axis=1) @ axis) / light
        apart = np.hypot(x - ghost.centroid_mm[0], y - ghost.centroid_mm[1])
        assert apart < 0.1 * pitch + 0.03 * ghost.rms_radius_mm, ghost.pair
    assert len(off) >= 10
    assert np.abs(off).max() < worst
    assert np.median(np.abs(off)) < 0.008


@pytest.mark.parametrize("size", [24, 96])
def test_a_small_frame_holds_the_light_of_the_rays_in_it(size: int) -> None:
    """Few pixels must not flatten ghosts that are as large as the frame, which lose light from its middle."""
    lens, pitch = load_lens("tessar_50_f2p8").with_round_stop(), 31.5 / size
    made = model(lens, pitch_mm=pitch, shape=(size, size), sun_radius_rad=1e-5, diffraction=False)
    tracer = Tracer(lens, np.array([D_NM]))
    rays, across = boxes(tracer, 6.0)[0], 400
    spots = tracer.trace(rays, across, centred=True)
    cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2 * np.cos(np.radians(6.0))
    light = lit_cells(spots, across).numpy().reshape(len(rays), -1) * cell[:, None]
    seen = (np.abs(spots.x_mm.numpy()) < 31.5 / 2) & (np.abs(spots.y_mm.numpy()) < 31.5 / 2)
    expected = light.ravel()[seen].sum(dtype=np.float64)
    # cells of the lattice leave 0.3 to 0.5 %; coarse levels took 3.1 and 1.4 %
    assert made.image(6.0).sum(dtype=np.float64) * pitch**2 == pytest.approx(expected, rel=0.008)


def test_a_caustic_is_a_line_and_no_string_of_beads() -> None:
    """A ghost of a Sun on the axis is a figure of revolution, its fold too, whatever lattice its rays start on."""
    lens = scaled_to_focal_length(load_lens("heliar_100_f3p5"), 20.0)
    picture = model(lens, shape=(200, 200), pitch_mm=0.03, sun_radius_rad=1.5e-3).image(0.0, only=(0, 8))[0]
    y, x = np.mgrid[:200, :200] - 99.5
    radius, sector = np.hypot(x, y), ((np.arctan2(y, x) / np.pi + 1) * 45).astype(int) % 90
    rings = np.bincount(radius.astype(int).ravel(), picture.ravel()) / np.bincount(radius.astype(int).ravel())
    caustic = 20 + int(np.argmax(rings[20:95]))
    assert rings[caustic] > 2 * rings[caustic - 12]
    on_it = np.abs(radius - caustic - 0.5) < 3
    light = np.bincount(sector[on_it], picture[on_it]) / np.bincount(sector[on_it])
    # pixels of the ring fall in and out of a sector: a tenth of them at most, where it is steepest
    assert light.std() < 0.06 * light.mean()


def test_a_picture_turns_with_the_sun() -> None:
    made = model(load_lens("tessar_50_f2p8"), shape=(160, 160))
    right, down = made.image(10.0, 0.0)[0], made.image(10.0, 90.0)[0]
    np.testing.assert_allclose(np.rot90(right, -1), down, atol=2e-3 * right.max(), rtol=0.02)


@pytest.mark.parametrize(("field_deg", "sun_deg"), [(45, 1.0), (65, 5.0), (30, 14.0), (20, 0.5)])
def test_a_ghost_that_aberrations_spread_is_drawn_as_its_rays_fall(
    monkeypatch: pytest.MonkeyPatch, field_deg: float, sun_deg: float
) -> None:
    """To first order, one ghost of the Biotar is smaller than the Sun's disc, in truth a hundred times larger.

    The picture is compared with the light of 160,000 single rays that land within circles about their middle.
    """
    side, of_frame_mm, ghost = 512, 5.632, (4, 8)
    lens = scaled_to_focal_length(load_lens("biotar_100_f1p4"), of_frame_mm / 2 / np.tan(np.radians(field_deg / 2)))
    sensor = SensorGrid(shape=(side, side), pitch_mm=of_frame_mm / side)
    made = FlareModel(lens, Bands.lines(500.0), sensor, sun_radius_rad=4.65e-3)
    tracer, rays, _ = made._boxes(sun_deg, 0.0)
    rays = rays.take(ghosts.named(tracer, rays, [ghost]))
    assert len(rays) == 1
    spots = tracer.trace(rays, 400, centred=True)
    cell = 4 * rays.box_mm[0, 2] * rays.box_mm[0, 3] / 400**2 * np.cos(np.radians(sun_deg))
    light = np.array(lit_cells(spots, 400)) * cell
    place = np.column_stack([spots.x_mm, spots.y_mm])
    place, light = place[light > 0], light[light > 0]
    seen = (np.abs(place) < of_frame_mm / 2).all(axis=1)
    middle = np.average(place[seen], axis=0, weights=light[seen])
    from_middle = np.linalg.norm(place - middle, axis=1)

    traced = recorded_calls(monkeypatch, Tracer, "trace")
    picture = made.image(sun_deg, 0.0, only=ghost)[0].astype(float) * sensor.pitch_mm**2
    assert sum(len(rays) for _, rays, *_ in traced) == 1  # not one for each sample of the disc
    y, x = (np.indices(picture.shape) + 0.5 - side / 2) * sensor.pitch_mm
    # 4 %: along the rim, 73 rays across lose half a cell, 1/72 of the radius or 2.8 % of the light; and the circles
    # cut pixels of up to 4 pixels of the frame
    for radius_mm in (0.3, 0.6, 1.0, 2.0, 4.0):
        within = np.hypot(x - middle[0], y - middle[1]) < radius_mm
        expected = light[seen & (from_middle < radius_mm)].sum()
        assert picture[within].sum() == pytest.approx(expected, abs=0.04 * light[seen].sum())


def test_threads_do_not_change_a_bit() -> None:
    made = model(load_lens("tessar_50_f2p8"), bands=Bands.sunlit(np.linspace(400, 700, 3)))
    pictures = []
    for count in (1, 2, 2):
        with render_threads(count):
            pictures.append(made.image(7.0, 20.0).tobytes())
    assert len(set(pictures)) == 1


def test_parts_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ghosts are drawn in parts to bound memory; each part has lattices of all sizes, as their sum would round."""
    made = model(load_lens("nikkor_35_f2p8"), bands=Bands.sunlit(np.linspace(400, 700, 2)))
    drawn, sizes, pictures = recorded_calls(monkeypatch, Sums, "draw"), [], []
    for rays in (1 << 40, 1 << 14):
        monkeypatch.setattr(irradiance, "_RAYS_AT_ONCE", rays)
        drawn.clear()
        pictures.append(made.image(7.0, 20.0).tobytes())
        sizes.append([len(np.unique(spots.across)) for _, spots, *_ in drawn])
    assert sizes[0] == [2]
    assert len(sizes[1]) > 2
    assert set(sizes[1]) == {2}
    assert pictures[0] == pictures[1]


def test_bands_differ_by_colour_alone() -> None:
    """Without dispersion and coating all bands are one picture; with glass of its own they part."""
    lens = load_lens("tessar_50_f2p8")
    grey = replace(
        lens,
        surfaces=tuple(
            replace(s, medium=replace(s.medium, formula="cauchy", coefficients=(s.medium.nd, 0.0)))
            for s in lens.surfaces
        ),
    )
    nodes = np.array([400.0, 550.0, 700.0])
    bands = model(grey, bands=Bands.lines(*nodes), diffraction=False).image(8.0)
    np.testing.assert_allclose(bands[0], bands[2], rtol=1e-5, atol=1e-9 * bands.max())
    bands = model(lens, bands=Bands.lines(*nodes)).image(8.0)
    assert np.abs(bands[0] - bands[2]).max() > 0.05 * bands[1].max()


def test_four_reflections_add_little_light() -> None:
    lens = scaled_to_focal_length(load_lens("tessar_50_f2p8"), 10.0)
    two, four = (model(lens, pitch_mm=0.05, reflections=n).image(5.0).sum() for n in (2, 4))
    assert 1.0 < four / two < 1.05


def test_ghosts_far_inside_a_wide_edge_are_drawn_coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rim whose edge is wide does not make all of a large ghost its edge, and the picture stays the same."""
    lens = scaled_to_focal_length(load_lens("nikkor_28_f2p8_camera"), 4.42)
    fill, drawn, pictures = Sums._fill, [], []

    def counted(self: Sums, cells: Any) -> None:
        first, last = (v.numpy() for v in cells.pixel_rows(cells.ends()))
        low, high, area = (np.asarray(v.numpy()) for v in (cells.low[1], cells.high[1], cells.area))
        drawn[-1] += int(((last - first + 1) * (1 + area / (high - low + 1))).sum())
        fill(self, cells)

    monkeypatch.setattr(Sums, "_fill", counted)
    for widest in (1.0, irradiance._WIDEST):
        monkeypatch.setattr(irradiance, "_WIDEST", widest)
        sensor = SensorGrid(shape=(1024, 1024), pitch_mm=0.0055)
        made = FlareModel(lens, Bands.lines(450.0, 600.0), sensor, sun_radius_rad=1.55e-3)
        drawn.append(0)
        pictures.append(made.image(10.0, 30.0).astype(float))
    assert drawn[1] < 0.5 * drawn[0]
    before, after = pictures
    # Far from edges, light is interpolated from pixels 4 times as wide as before. Single pixels in dark corners
    # differ by 0.4 %. With _WIDEST = 64 the lattice of rays showed along the edges, as a sawtooth.
    lit = before > 0.01 * before.mean()
    assert np.abs(after[lit] / before[lit] - 1).max() < 0.005
    assert after.mean() == pytest.approx(before.mean(), rel=1e-3)


def test_soft_edges() -> None:
    s = np.linspace(EDGE_LOW, EDGE_HIGH, _EDGE_NODES)
    profiles = edge_profiles()
    # a uniform disc, a straight edge through it: half the light where the edge crosses its middle
    assert np.interp(0.0, s, profiles[0]) == pytest.approx(0.5, abs=1e-3)
    assert np.interp(0.5, s, profiles[0]) == pytest.approx(
        0.5 + (0.5 * np.sqrt(0.75) + np.arcsin(0.5)) / np.pi, abs=1e-3
    )
    # Fresnel's straight edge: a quarter at the edge, 1.370 at v = 1.217 (Born & Wolf, section 8.7.3)
    assert np.interp(0.0, s, profiles[-1]) == pytest.approx(0.25, abs=2e-3)
    assert profiles[-1].max() == pytest.approx(1.370, abs=2e-3)
    assert s[np.argmax(profiles[-1])] == pytest.approx(1.217, abs=0.01)
    # an edge redistributes light: as much is missing inside as lies outside
    light = ((profiles - (s > 0)) @ np.ones_like(s)) * (s[1] - s[0])
    assert np.abs(light[0]) < 1e-3
    points = disc_samples(3)
    assert len(points) == 37
    assert (points**2).sum(axis=1).mean() == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("kind", ["traced", "paraxial"])
def test_the_brightest_ghosts_are_listed(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are those of the list of all ghosts, to the last digit, and each wavelength is traced once."""
    made = model(load_lens("nikkor_28_f2p8"), bands=Bands.lines(450.0, 550.0, 650.0), model=kind)
    traced = recorded_calls(monkeypatch, type(made._tracer), "trace")
    for worn in (0.0, 0.3):
        lens = made.worn(worn)
        every = lens.ghosts(11.0, 20.0)
        assert len(every) > 30
        assert [ghost.pair for ghost in every] == sorted(ghost.pair for ghost in every)
        traced.clear()
        few = lens.ghosts(11.0, 20.0, most=6)
        assert [across for _, _, across, *_ in traced] == [13, 48, 48, 48]  # the spectra; the boxes are known
        highest = sorted(every, key=lambda g: -g.peak_irradiance_fraction)[:6]
        assert few == tuple(sorted(highest, key=lambda g: g.pair))
        assert lens.ghosts(11.0, 20.0, most=1000) == every


def test_the_peak_of_a_ghost_is_that_of_its_densest_cell() -> None:
    """Light over area of the cells whose corners pass all rims, from the traced rays, bundle by bundle."""
    made = model(load_lens("nikkor_28_f2p8"), bands=Bands.lines(550.0))
    tracer, rays, _ = made._boxes(11.0, 0.0)
    side = 48
    spots = tracer.trace(rays, side, centred=True)
    found = ghosts.peaks(spots, side, 11.0)
    assert len(np.unique(found)) > 30
    x, y, fraction, radius = (
        v.numpy().reshape(-1, side, side) for v in (spots.x_mm, spots.y_mm, spots.fraction, spots.radius)
    )
    for k in range(len(rays)):
        along, aside = (np.stack([np.diff(v[k], axis=a) for v in (x, y)]) for a in (1, 0))
        area = np.abs(along[0, 1:] * aside[1, :, 1:] - along[1, 1:] * aside[0, :, 1:])
        passes = radius[k] <= 1
        lit = passes[1:, 1:] & passes[1:, :-1] & passes[:-1, 1:] & (area > 0)
        densest = (fraction[k, 1:, 1:][lit] / area[lit]).max(initial=0)
        cell = 4 * rays.box_mm[k, 2:].prod() / side**2 * np.cos(np.radians(11.0))
        # 1e-5: the area is a difference of products in single precision, which may be fused on the device
        assert found[k] == pytest.approx(densest * cell, rel=1e-5)
        if k < 5:
            alone = tracer.trace(rays.take(np.array([k])), side, centred=True)
            assert ghosts.peaks(alone, side, 11.0)[0] == found[k]
