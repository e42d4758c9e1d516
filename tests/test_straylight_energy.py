"""Where the Sun's light goes: power of its image at every angle, and what straylight takes from it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import needs_llvm
from lens_kit import sunlit
from numpy.typing import NDArray
from test_faults_kit import make_context

from vbnfault.camera import Camera
from vbnfault.core import spectra
from vbnfault.core.files import resources
from vbnfault.core.quantities import Electrons, Radiance
from vbnfault.core.spectra import Bands
from vbnfault.detector import ThreeColourDetector
from vbnfault.faults import FaultContext, from_dict, registry
from vbnfault.lens import (
    Prescription,
    RealLens,
    ThinLens,
    load_lens,
    paraxial_properties,
    parse_lens,
    scaled_to_field,
)
from vbnfault.lens.coating import mean_reflectance
from vbnfault.lens.straylight.scatter import Cleanliness
from vbnfault.lens.straylight.settings import DirectPath, GhostSettings, SensorGrid, StraylightSettings, SunSource
from vbnfault.lens.straylight.total import SunInLens, SunStraylight, anew
from vbnfault.output import flare_images

needs_llvm()

F64 = NDArray[np.float64]

NODES = np.array([450.0, 550.0, 650.0])
SIZE = 128
RATES = np.array([0.2, 0.7, 3.0])
# A biconvex lens of an absorbing glass behind its stop.
ABSORBING: dict[str, Any] = {
    "name": "absorbing",
    "surface": [
        {"stop": True, "thickness_mm": 1.0, "diameter_mm": 8.0},
        {
            "radius_mm": 50.0,
            "thickness_mm": 4.0,
            "nd": 1.6,
            "vd": 45.0,
            "diameter_mm": 12.0,
            "internal_transmittance_10mm": {"wavelength_nm": [450.0, 650.0], "value": [0.5, 0.9]},
        },
        {"radius_mm": -50.0, "diameter_mm": 12.0},
    ],
}


def flux(layer: NDArray[Any], pitch_mm: float) -> F64:
    """Of every band, over the frame, mm²."""
    return np.asarray(layer.sum(axis=(1, 2), dtype=np.float64) * pitch_mm**2)


def beyond_mm2(light: SunStraylight) -> F64:
    """What leaves the frame; the veil falls as cos⁴, whose integral over the plane is π f²."""
    layout = light.layout
    veil = np.pi * layout.efl_mm**2 - layout.cos4.sum(dtype=np.float64) * layout.pitch_mm**2
    return np.asarray(light.starburst.beyond_mm2 + light.glare_beyond_mm2 + light.veil * veil)


# --- the direct image --------------------------------------------------------------------------------------------


def transmitted(lens: Prescription, wavelength_nm: F64 = NODES) -> F64:
    """Along the axis, surface by surface."""
    out = []
    for nm in wavelength_nm:
        index, share = lens.indices(nm), 1.0
        for k, surface in enumerate(lens.surfaces):
            share *= 1 - float(mean_reflectance(surface.coating, index[k], index[k + 1], 1.0, nm))
            if k < len(lens.surfaces) - 1:
                share *= float(np.interp(nm, *surface.internal_transmittance_10mm)) ** (surface.thickness_mm / 10)
        out.append(share)
    return np.array(out)


@pytest.mark.parametrize("sun_deg", [0.0, 13.0])
def test_a_flares_direct_image_has_the_lens_transmission(sun_deg: float) -> None:
    """What the pupil admits and the lens transmits: starburst, glare and veil are in it, ghosts are not."""
    lens = parse_lens(ABSORBING, source="test")
    view = flare_images.FlareRequest(
        lens=lens, sun_deg=sun_deg, azimuth_deg=20.0, fov_deg=60.0, pixels=96, wavelength_nm=NODES, model="paraxial"
    )
    pupil = np.pi / 4 * paraxial_properties(lens).entrance_pupil_diameter_mm ** 2 * np.cos(np.radians(sun_deg))
    direct = flux(flare_images.layers(replace(view, model="texture"))["sun"], view.pitch_mm)
    passed = view.bands.mean(transmitted(lens, view.bands.wavelength_nm))
    assert passed.max() / passed.min() > 1.15  # bands differ
    np.testing.assert_allclose(direct, pupil * passed, rtol=1e-5)  # sums of float32
    left = flux(flare_images.layers(view)["sun"], view.pitch_mm)
    assert (left < direct).all()
    assert (left > 0.93 * direct).all()


# --- a whole frame -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sun_deg", [0.0, 9.0])
def test_starburst_glare_and_veil_come_from_the_direct_light(sun_deg: float) -> None:
    """The books of a small frame, what leaves it named by the model, and of one nine times as wide.

    `beyond_mm2` of the small frame is checked by what the large one holds: no formula is shared.
    """
    lens = load_lens("nikkor_28_f2p8").coated("mgf2")
    optics = paraxial_properties(lens)
    pitch = 2 * optics.efl_mm * np.tan(np.radians(10)) / SIZE
    admitted = np.pi / 4 * optics.entrance_pupil_diameter_mm**2 * np.cos(np.radians(sun_deg)) * transmitted(lens)
    books = []
    for size in (SIZE, 9 * SIZE):
        light = SunInLens(
            lens=lens,
            bands=Bands.lines(*NODES),
            sensor=SensorGrid(shape=(size, size), pitch_mm=pitch),
            sun=SunSource(angle_deg=sun_deg, azimuth_deg=20.0, radius_rad=spectra.sun_angular_radius_rad(1.0)),
            settings=StraylightSettings(
                ghosts=GhostSettings(model="paraxial"), cleanliness=Cleanliness(level=300.0), veil_fraction=0.02
            ),
        )
        once = cache(anew)
        found = light.straylight(once=once)
        parts, in_channels = found.parts(), light.straylight(RATES, once)
        # 4e-6: each value is a sum of 4 parts, rounded to 6e-8 some ten times
        expected = 0.5 * RATES[:, None, None] * sum(layer.astype(np.float64) for layer in parts.values())
        np.testing.assert_allclose(in_channels.total(0.5), expected, rtol=4e-6)
        np.testing.assert_allclose(in_channels.direct_fraction, found.direct_fraction, rtol=1e-6)
        for name, of_part in in_channels.flux_mm2.items():
            np.testing.assert_allclose(of_part, RATES * flux(parts[name], pitch), rtol=1e-5)
        strayed = sum(flux(parts[name], pitch) for name in ("starburst", "glare", "veil"))
        beyond = beyond_mm2(found)
        books.append((strayed, beyond, found.direct_fraction))
        # 1e-6: sums of float32
        np.testing.assert_allclose(found.direct_fraction * admitted + strayed + beyond, admitted, rtol=1e-5)
        assert (flux(parts["ghosts"], pitch) < admitted * (1 / transmitted(lens) - 1)).all()
    (near, beyond, left), (wide, farther, left_again) = books
    assert (beyond > 2 * farther).all()
    np.testing.assert_allclose(near + beyond, wide + farther, atol=1e-3 * admitted.min())
    np.testing.assert_allclose(left, left_again, atol=1e-3)
    assert (1 - left > 0.02).all()  # the veil, and more


def thin_context(sun_deg: float, size: int = SIZE, fov_deg: float = 40.0) -> FaultContext:
    made = make_context(size, fov_deg=fov_deg, exposure_s=1e-3)
    x = size / 2 + made.camera.focal_length_px * np.tan(np.radians(sun_deg))
    return sunlit(made, NODES, 1.0, sun_xy_px=np.array([x, size / 2]), sun_visible_fraction=1.0)


def real_context(sun_deg: float) -> FaultContext:
    lens = scaled_to_field(load_lens("nikkor_28_f2p8").coated("bbar"), 60.0, SIZE * 20e-3)
    detector = ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=20.0)
    real = RealLens(prescription=lens, width_px=SIZE, height_px=SIZE, pixel_pitch_um=20.0)
    where = thin_context(sun_deg)
    camera = Camera(lens=real, detector=detector, exposure_s=1e-3)
    slope = np.tan(np.radians(sun_deg))
    x = SIZE / 2 + camera.focal_length_px * float(real.distorted(np.array(slope)))
    return replace(where, camera=camera, sun_xy_px=np.array([x, SIZE / 2]))


def direct_sun(where: FaultContext, sun_deg: float) -> tuple[Electrons, F64]:
    """A picture of a grey scene and the Sun's image, in one pixel, with all that the pupil admits; and the latter's
    electrons of every colour."""
    lens, detector = where.camera.lens, where.camera.detector
    assert where.sun_irradiance_W_m2_nm is not None
    assert where.sun_xy_px is not None
    pitch_mm = detector.pixel_pitch_um * 1e-3
    area = float(lens.pupil_area_mm2(np.tan(np.radians(sun_deg)))) * np.cos(np.radians(sun_deg))
    power = where.sun_irradiance_W_m2_nm * area / pitch_mm**2
    electrons = where.camera.electron_rate_weights(NODES) @ power * where.camera.exposure_s
    past = np.zeros((SIZE, SIZE, 3), dtype=np.float32)
    past[int(where.sun_xy_px[1]), int(where.sun_xy_px[0])] = electrons
    scene = np.broadcast_to(0.5 * detector.white_e, past.shape).astype(np.float32)
    return Electrons(array=scene, white_e=detector.white_e, past_rims=past), electrons


@pytest.mark.parametrize("camera", ["thin", "real"])
@pytest.mark.parametrize("sun_deg", [4.0, 14.0])
def test_a_frame_with_all_straylight_holds_what_enters(camera: str, sun_deg: float) -> None:
    """Electrons of the frame, and of the light that leaves it, over those of scene and Sun: 1 to 0.1 %.

    A thin lens without losses gives the ghosts their light too; a real one has reflected it before.
    """
    where = thin_context(sun_deg) if camera == "thin" else real_context(sun_deg)
    fault = registry()["straylight"]["traced"](
        coating="bbar", cleanliness_level=200, roughness_nm=1.0, veil_fraction=0.02
    )
    params = fault.draw(where, np.random.default_rng(0))
    before, sun_e = direct_sun(where, sun_deg)
    after = fault.on_light(before, params, where)
    assert after.past_rims is not None
    # the scene: its image and its veil on the unbounded plane
    scene_e = before.array.sum(axis=(0, 1), dtype=np.float64)
    kept = after.array.sum(axis=(0, 1), dtype=np.float64) / scene_e
    assert (kept < 0.98).all()
    assert (kept > 0.97).all()
    # the share of cos⁴ / (π f²) that a frame catches, by the field angles of its pixels
    x = (np.arange(SIZE) + 0.5 - SIZE / 2) / where.camera.focal_length_px
    caught = ((1 + x[None, :] ** 2 + x[:, None] ** 2) ** -2).sum() / np.pi / where.camera.focal_length_px**2
    # what of the Sun's light leaves the frame, from the model itself, checked by a wider frame above
    pitch_mm = where.camera.detector.pixel_pitch_um * 1e-3
    area = where.camera.lens.pupil_area_mm2([np.tan(np.radians(sun_deg)), 0.0])
    assert where.sun_xy_px is not None
    nm = spectra.fine_nodes_nm(NODES)
    sensed = where.camera.detector.electron_rates(nm) * spectra.solar_irradiance_W_m2_nm(nm)
    found = SunInLens(
        lens=where.frame.prescription(params["lens"], params["coating"]),
        bands=Bands.of(nm, sensed),
        sensor=SensorGrid(shape=where.shape, pitch_mm=pitch_mm),
        sun=SunSource(
            angle_deg=sun_deg,
            radius_rad=spectra.sun_angular_radius_rad(1.0),
            image_xy_mm=(float((where.sun_xy_px[0] - SIZE / 2) * pitch_mm), 0.0),
        ),
        settings=StraylightSettings(cleanliness=Cleanliness(level=200.0, roughness_nm=1.0), veil_fraction=0.02),
        path=DirectPath(
            transmittance=where.camera.lens.transmittance(nm),
            admitted_mm2=float(area[0] * np.cos(np.radians(sun_deg))),
            beam_fraction=float(area[0] / area[1]),
        ),
    ).straylight()
    to_e = np.trapezoid(sensed, nm, axis=1) * where.camera.exposure_s / pitch_mm**2
    gone = to_e * beyond_mm2(found)
    ghosts = to_e * found.ghosts.flux_mm2
    total = after.past_rims.sum(axis=(0, 1), dtype=np.float64) + gone - scene_e * (1 - kept) * caught
    paid = ghosts if camera == "real" else 0 * ghosts
    np.testing.assert_allclose(total - paid, sun_e, rtol=1e-3)
    assert (after.past_rims.max(axis=(0, 1)) < 0.98 * sun_e).all()  # the Sun's own image is fainter


# --- rims --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["traced", "paraxial", "texture"])
@pytest.mark.parametrize("vignetting", ["cos4", "lens"])
def test_light_that_has_met_the_rims_is_not_vignetted_again(model: str, vignetting: str) -> None:
    where = thin_context(12.0)
    keys = {"decentre": 0.0, "hood_offset": 0.0} if vignetting == "lens" else {"on_axis_illuminance_dn": 180}
    rims = from_dict("vignetting", {"model": vignetting} | keys, source="test")
    stray = from_dict("straylight", {"model": model}, source="test")
    before, _ = direct_sun(where, 12.0)
    rng = np.random.default_rng(1)
    rims_params, stray_params = rims.draw(where, rng), stray.draw(where, rng)
    lit = stray.on_light(before, stray_params, where)
    dimmed = rims.on_light(lit, rims_params, where)
    assert before.past_rims is not None
    assert lit.past_rims is not None
    assert dimmed.past_rims is not None
    np.testing.assert_array_equal(dimmed.past_rims, lit.past_rims)
    alone = rims.apply(replace(lit, past_rims=None), rims_params, where)
    np.testing.assert_array_equal(dimmed.array, alone.array)
    assert (dimmed.array[0, 0] < lit.array[0, 0]).all()
    # flares from textures lie before the rims, as in the paper
    added = lit.past_rims - before.past_rims
    # where the Sun is, its own rounding: float32 of 2⁻²⁴
    assert (np.abs(added) > 1e-6 * before.past_rims).any() == (model != "texture")
    # dust and blur between the two act on all light alike
    for fault in ("dust_on_optics", "optics_degradation"):
        other = from_dict(fault, {}, source="test")
        params = other.draw(where, rng)
        apart, whole = other.on_light(lit, params, where), other.apply(lit.merged, params, where)
        np.testing.assert_allclose(apart.merged.array, whole.array, rtol=1e-5)


@pytest.mark.parametrize(
    "moved", [{"hood_offset": 0.6}, {"decentre": 0.7}, {"hood_offset": 0.4, "decentre": 0.4}, {"hood_offset": 10.0}]
)
def test_a_moved_hood_or_ring_takes_of_the_sun_what_it_takes_of_its_beam(moved: dict[str, float]) -> None:
    """All light past the rims loses the fraction that the scene loses by the fault at the Sun's pixel."""
    where = thin_context(12.0)
    assert where.sun_xy_px is not None
    x, y = (int(v) for v in where.sun_xy_px)
    stray = from_dict("straylight", {"model": "paraxial"}, source="test")
    before, _ = direct_sun(where, 12.0)
    lit = stray.on_light(before, stray.draw(where, np.random.default_rng(1)), where)
    assert lit.past_rims is not None
    maps, past = [], []
    for keys in ({}, moved):
        rims = from_dict("vignetting", {"model": "lens", "decentre": 0.0, "hood_offset": 0.0} | keys, source="test")
        params = rims.draw(where, np.random.default_rng(5))
        # to the right, where the Sun is: its beam comes in from the left
        params["hood_offset_mm"] = [float(np.hypot(*params["hood_offset_mm"])), 0.0]
        maps.append(rims.soft(params, where))
        after = rims.on_light(lit, params, where).past_rims
        assert after is not None
        past.append(after)
    np.testing.assert_array_equal(past[0], lit.past_rims)
    expected = float(maps[1][y, x] / maps[0][y, x])
    assert expected < 0.95
    # the Sun lies within half a pixel of that pixel's centre, where the map changes by less than 1 %
    np.testing.assert_allclose(past[1], past[0] * np.float32(expected), rtol=0.01)


def test_the_sun_in_a_build_is_vignetted_once() -> None:
    """From scene file to electrons: behind a thin lens, cos⁴ falls on the scene and not on the Sun again."""
    from conftest import small_scene

    from vbnfault.pipeline import Session
    from vbnfault.pipeline.development import Development
    from vbnfault.pipeline.exposure import meter
    from vbnfault.pipeline.injection import draw_faults, fault_context
    from vbnfault.pipeline.rendering import render_view
    from vbnfault.pipeline.resolve import resolve
    from vbnfault.scene import config

    table = small_scene(
        camera={"width_px": 64, "height_px": 64, "fov_deg": 2.0},
        render={"samples_per_pixel": 16},
        plan={"faulty_fraction": 1.0, "mode": "per_sample"},
        geometry={"sun_facing": {"roll_deg": [-0.5, 0.5], "pitch_deg": [-0.5, 0.5]}},
    )
    table["faults"] = {"straylight": {"model": "paraxial"}, "vignetting": {"on_axis_illuminance_dn": 255}}
    session = Session(config.parse_scene(table, source="test"))
    for index in range(16):
        spec = session.spec(index)
        pose = resolve(spec)
        rendering = render_view(spec, pose)
        exposure = meter(spec, rendering)
        context = fault_context(pose, rendering, exposure)
        sun = context.sun_xy_px
        inside = sun is not None and bool(((sun > 10) & (sun < 54)).all())
        if exposure.rate.past_rims is not None and pose.sun_visible_fraction == 1 and inside:
            break
    else:
        pytest.fail("no sample has all of the Sun in its frame")
    assert context.sun_direction_C is not None
    cosine = float(context.sun_direction_C[2])
    lens, detector = context.camera.lens, context.camera.detector
    area = float(lens.pupil_area_mm2(0.0)) / (detector.pixel_pitch_um * 1e-3) ** 2
    nodes, irradiance = context.wavelength_nm, context.sun_irradiance_W_m2_nm
    assert nodes is not None
    weights = detector.electron_rate_weights(nodes) * irradiance * lens.transmittance(nodes)
    admitted = weights.sum(axis=1) * area * cosine * context.camera.exposure_s
    development = Development(exposure=exposure, context=context, rng=spec.rng)
    draws = draw_faults(spec, development, ["vignetting"], {}, attempt=0)
    plain, dimmed = (development.signal(draws, names) for names in ([], ["vignetting"]))
    assert plain.past_rims is not None
    assert dimmed.past_rims is not None
    # the disc's image is exact in total; float32 sums
    np.testing.assert_allclose(plain.past_rims.sum(axis=(0, 1), dtype=np.float64), admitted, rtol=1e-4)
    np.testing.assert_array_equal(plain.past_rims, dimmed.past_rims)
    assert dimmed.array[0].sum() < plain.array[0].sum() or not plain.array[0].any()


def test_the_mask_level_is_that_of_the_mask() -> None:
    """The mask holds the pixels that change by `mask_level_dn` or more, the effect all that change."""
    from conftest import small_scene

    from vbnfault.dataset import store_spec
    from vbnfault.pipeline import Session
    from vbnfault.scene import config

    table = small_scene(
        camera={"width_px": 48, "height_px": 48},
        plan={"faulty_fraction": 1.0, "mode": "per_class"},
        dataset={"layers": ["clean", "mask_effect"]},
    )
    table["faults"] = {"straylight": {"model": "texture", "mask_level_dn": 40}}
    session = Session(config.parse_scene(table, source="test"))
    seen = 0
    for index in range(8):
        frame = session.frame(index)
        if "straylight" not in frame.drawn:
            continue
        development, draws = frame.injection.development, frame.injection.draws
        with_it, without = (development.image(d, noisy=False).array.astype(int) for d in (draws, {}))
        change = np.abs(with_it - without).max(axis=2)
        np.testing.assert_array_equal(frame.labels.masks[0], change >= 40)
        np.testing.assert_array_equal(frame.labels.effects["straylight"], change >= 1)
        seen += (frame.labels.masks[0] != frame.labels.effects["straylight"]).any()
    assert seen
    spec = store_spec(session, [16])
    assert spec.mask_kinds == ("strong effect",)
    assert "mask_level_dn = 40 DN" in spec.mask_rules[0]


# --- the veil ----------------------------------------------------------------------------------------------------


def test_every_packaged_lens_has_the_veil_of_real_ones() -> None:
    """ISO 9358: a black spot in a uniform field; indices of camera lenses lie between 0.5 and 5 %."""
    import importlib.util

    path = Path(__file__).parents[1] / "benchmarks/veil_table.py"
    spec = importlib.util.spec_from_file_location("veil_table", path)
    assert spec is not None
    assert spec.loader is not None
    veil_table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(veil_table)
    for name in resources.packaged("scenes/lenses"):
        parts = veil_table.index_of(load_lens(name).coated("mgf2"), veil_fraction=0.01, cleanliness_level=0.0)
        assert 0.005 < sum(parts.values()) < 0.05, name
        assert parts["veil"] == pytest.approx(0.01, rel=0.02)


def disc(camera: Camera, sun_deg: float, radius_rad: float) -> tuple[Radiance, float]:
    """Radiance of a disc of radiance 1 on the camera's pixels, each the mean over 32² points; its solid angle."""
    fine = 32
    place = (np.arange(SIZE * fine) + 0.5) / fine
    x, y = ((place - SIZE / 2) / camera.focal_length_px for _ in range(2))
    sun = np.array([np.sin(np.radians(sun_deg)), 0.0, np.cos(np.radians(sun_deg))])
    length = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
    cosine = (x[None, :] * sun[0] + sun[2]) / length
    seen = (cosine > np.cos(radius_rad)).astype(np.float32)
    mean = seen.reshape(SIZE, fine, SIZE, fine).mean(axis=(1, 3))
    array = np.broadcast_to(mean, (len(NODES), SIZE, SIZE)).astype(np.float32)
    solid = 2 * np.pi * (1 - np.cos(radius_rad))
    return Radiance(array=array, wavelength_nm=NODES, sun=array.copy()), float(solid)


@pytest.mark.parametrize("sun_deg", [0.0, 20.0, 38.0])
def test_a_thin_lens_images_what_its_pupil_admits_of_the_sun(sun_deg: float) -> None:
    detector = ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=20.0)
    lens = ThinLens(focal_length_mm=1.4, f_number=2.0, transmission=0.8)
    camera = Camera(lens=lens, detector=detector)
    radiance, solid = disc(camera, sun_deg, 0.04)
    light = lens.image_of_sun(radiance, 20.0)
    power = flux(light.array, 20e-3)
    pupil = np.pi / 4 * (1.4 / 2.0) ** 2
    # cos over the disc of 2.3°: its mean is cos θ · (1 - σ²/4); edges by 32² points a pixel: 2e-3 of 100 pixels
    np.testing.assert_allclose(power, 0.8 * pupil * solid * np.cos(np.radians(sun_deg)), rtol=3e-3)
    # an extended scene keeps the paper's rule, and the camera holds the two apart
    np.testing.assert_allclose(lens.image(radiance).array, radiance.array * np.float32(np.pi * 0.8 / 16), rtol=1e-6)
    found = camera.expose(replace(radiance, array=radiance.array + np.float32(1e-3)), 1.0)
    scene = camera.expose(replace(radiance, array=np.full_like(radiance.array, 1e-3), sun=None), 1.0)
    assert found.past_rims is not None
    np.testing.assert_allclose(found.array, scene.array, rtol=1e-3)
    np.testing.assert_allclose(found.past_rims, detector.electrons_expected(light, 1.0).array, rtol=1e-6)


def test_a_hood_in_front_of_the_sun_leaves_none_of_its_light() -> None:
    where = thin_context(12.0)
    stray = from_dict("straylight", {"model": "paraxial"}, source="test")
    before, _ = direct_sun(where, 12.0)
    lit = stray.on_light(before, stray.draw(where, np.random.default_rng(1)), where)
    rims = from_dict("vignetting", {"model": "lens", "hood_offset": 10.0}, source="test")
    after = rims.on_light(lit, rims.draw(where, np.random.default_rng(2)), where).past_rims
    assert after is not None
    np.testing.assert_array_equal(after, 0)
