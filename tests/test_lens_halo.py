"""The point spread of a thin lens: its energy, its width, its wings, its edges, and the scene file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import vbnfault
from vbnfault.core.quantities import Radiance
from vbnfault.lens import Halo, ThinLens

PIXEL_RAD = 1e-4
HALO = Halo(core_rad=1.2e-4, halo_fraction=0.3, halo_rad=1.5e-4, halo_index=2.8)


def point(size: int = 201, row: int = 100, column: int = 100) -> np.ndarray:
    """Return a frame with one bright pixel."""
    frame = np.zeros((size, size))
    frame[row, column] = 1.0
    return frame


def test_a_point_keeps_its_light_wherever_it_lies() -> None:
    for row, column in ((100, 100), (0, 37), (200, 200)):
        image = HALO.applied(point(row=row, column=column), PIXEL_RAD)
        assert image.sum() == pytest.approx(1, abs=1e-12)
        assert image.min() >= 0


def test_the_core_has_its_width_and_follows_the_axes() -> None:
    for along_y in (None, 3e-4):
        core = Halo(core_rad=2e-4, core_y_rad=along_y, halo_fraction=0.0, halo_rad=1e-4, halo_index=3.0)
        image = core.applied(point(row=80, column=120), PIXEL_RAD)
        row, column = np.indices(image.shape)
        assert ((image * column).sum(), (image * row).sum()) == pytest.approx((120, 80), abs=1e-9)
        # a pixel adds the variance of its own width, 1/12, to that of the core
        for offset, sigma_px in ((row - 80, 3.0 if along_y else 2.0), (column - 120, 2.0)):
            assert (image * offset**2).sum() == pytest.approx(sigma_px**2 + 1 / 12, rel=1e-6)


def test_the_halo_is_the_stated_law() -> None:
    """At 20 px the core is gone; beyond the frame lie h (1 + (R/θ₀)²)^(1 - p/2) = 2.6 % of the light or less."""
    image = HALO.applied(point(size=401, row=200, column=200), PIXEL_RAD)
    for away in (20, 40, 80):
        angle = away / 1.5
        law = 0.3 * 0.8 / (2 * np.pi * 1.5**2) * (1 + angle**2) ** -1.4
        assert image[200, 200 + away] == pytest.approx(law, rel=0.1)
    slope = np.log(image[200, 280] / image[200, 220]) / np.log(4)
    assert slope == pytest.approx(-2.8, abs=0.15)


def test_wings_are_a_second_and_wider_halo() -> None:
    """Wings alone are a halo of the same law; what they take, the core lacks."""
    winged = replace(HALO, wing_fraction=0.02, wing_rad=5e-3, wing_index=4.0)
    alone = Halo(core_rad=HALO.core_rad, halo_fraction=0.02, halo_rad=5e-3, halo_index=4.0)
    core = Halo(core_rad=HALO.core_rad, halo_fraction=0.0, halo_rad=1e-4, halo_index=3.0)
    made, *parts = (one.on_pixels(PIXEL_RAD, (150, 150)) for one in (winged, HALO, alone, core))
    np.testing.assert_allclose(made, parts[0] + parts[1] - parts[2], rtol=1e-9, atol=1e-15)
    assert winged.applied(point(), PIXEL_RAD).sum() == pytest.approx(1, abs=1e-12)
    law = 0.02 * 2 / (2 * np.pi * 50**2)  # of a pixel in the middle of the wings, whose frame holds nearly all
    assert (made - parts[0])[0, 40] == pytest.approx(law * (1 + 0.8**2) ** -2, rel=0.1)


def test_a_body_that_fills_the_frame_is_as_bright_at_its_edges() -> None:
    assert HALO.applied(np.full((64, 96), 3.0), PIXEL_RAD) == pytest.approx(3.0, rel=1e-12)


def test_the_number_of_pixels_does_not_change_the_image() -> None:
    """Twice as many pixels of half the size: the same image after sums of 2x2, but for the width of the pixels."""
    wide = Halo(core_rad=4e-4, halo_fraction=0.3, halo_rad=5e-4, halo_index=2.8)
    disc = (np.hypot(*(np.indices((128, 128)) - 63.5)) < 30).astype(float)
    fine = wide.applied(np.kron(disc, np.ones((2, 2))), PIXEL_RAD / 2)
    assert fine.reshape(128, 2, 128, 2).mean(axis=(1, 3)) == pytest.approx(wide.applied(disc, PIXEL_RAD), abs=0.01)


def test_every_band_of_a_thin_lens_is_blurred() -> None:
    sharp = ThinLens(focal_length_mm=100.0, f_number=4.0)
    soft = ThinLens(focal_length_mm=100.0, f_number=4.0, halo=HALO, pixel_rad=PIXEL_RAD)
    scene = np.stack([point(), 2 * point(row=50)]).astype(np.float32)
    radiance = Radiance(array=scene, wavelength_nm=np.array([500.0, 600.0]))
    made, ideal = soft.image(radiance).array, sharp.image(radiance).array
    assert made.dtype == np.float32
    assert made.sum(axis=(1, 2)) == pytest.approx(ideal.sum(axis=(1, 2)), rel=1e-5)
    peak = HALO.on_pixels(PIXEL_RAD, (201, 201))[0, 0]
    assert made.max(axis=(1, 2)) == pytest.approx(ideal.max(axis=(1, 2)) * peak, rel=1e-4)
    assert soft.on_axis(radiance).array == pytest.approx(ideal)
    assert soft.blurs
    assert not sharp.blurs
    assert (soft.spread(scene[0], 500.0) > 0).all()


def test_the_suns_image_has_the_point_spread_too() -> None:
    soft = ThinLens(focal_length_mm=100.0, f_number=4.0, halo=HALO, pixel_rad=PIXEL_RAD)
    sun = Radiance(array=1e7 * point()[None].astype(np.float32), wavelength_nm=np.array([500.0]))
    image = soft.image_of_sun(sun, 10.0).array[0]
    assert image[100, 110] > 0
    assert image[100, 100] < 0.5 * image.sum()


def test_a_scene_sets_the_point_spread_in_angles() -> None:
    values = {"camera.point_spread.core_urad": 60.0, "camera.width_px": 64, "camera.height_px": 64}
    scene = vbnfault.load_scene("paper67p", values)
    lens = vbnfault.Session(scene).base_camera.lens
    assert lens.halo.core_y_rad is None
    wider = vbnfault.load_scene("paper67p", values | {"camera.point_spread.core_y_urad": 90.0})
    assert vbnfault.Session(wider).base_camera.lens.halo.core_y_rad == pytest.approx(90e-6)
    seen = (lens.halo.core_rad, lens.halo.halo_fraction, lens.halo.halo_rad, lens.halo.halo_index)
    assert seen == pytest.approx((60e-6, 0.0, 100e-6, 3.0))
    assert lens.pixel_rad == pytest.approx(2 * np.tan(np.radians(32.5)) / 64)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"camera.point_spread.core_urad": 0.0}, "core_urad = 0.0"),
        ({"camera.point_spread.core_urad": 60.0, "camera.point_spread.halo_index": 2.0}, "halo_index = 2.0"),
        ({"camera.point_spread.halo_fraction": 0.1}, "core_urad"),
        (
            {f"camera.point_spread.{key}": 0.5 for key in ("core_urad", "halo_fraction", "wing_fraction")},
            "halo_fraction = 0.5, wing_fraction = 0.5: must be below 1",
        ),
        ({"camera.point_spread.core_urad": 60.0, "camera.lens": "tessar"}, "point_spread: the lens has its own"),
    ],
)
def test_wrong_values_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(vbnfault.InputError, match=message):
        vbnfault.load_scene("paper67p", values)
