"""Packaged lenses as they stand in a camera: filter, cover glass, and the sensor as a mirror."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vbnfault.core import llvm
from vbnfault.core.errors import VbnfaultError
from vbnfault.core.spectra import Bands
from vbnfault.lens import RealLens, load_lens, paraxial_properties, scaled_to_field
from vbnfault.lens.straylight.settings import SensorGrid, SunSource
from vbnfault.lens.straylight.total import SunInLens

LENSES = ("nikkor_28_f2p8", "nikkor_35_f2p8")
SENSOR_MM = 5.632  # 1024 pixels of 5.5 µm


@pytest.mark.parametrize("name", LENSES)
def test_plates_shift_the_focus_and_leave_the_lens(name: str) -> None:
    bare, lens = load_lens(name), load_lens(f"{name}_camera")
    count = len(bare.surfaces)
    plates = lens.surfaces[count:]
    assert lens.surfaces[: count - 1] == bare.surfaces[:-1]
    assert replace(lens.surfaces[count - 1], thickness_mm=0.0) == replace(bare.surfaces[-1], thickness_mm=0.0)
    assert [s.medium.nd > 1 for s in plates] == [True, False, True, False]
    figures, before = paraxial_properties(lens), paraxial_properties(bare)
    assert figures.efl_mm == pytest.approx(before.efl_mm, rel=1e-12)
    assert figures.f_number == pytest.approx(before.f_number, rel=1e-12)
    # t (n - 1) / n of every plate
    shift = sum(s.thickness_mm * (1 - 1 / s.medium.nd) for s in plates if s.medium.nd > 1)
    behind = sum(s.thickness_mm for s in lens.surfaces[count - 1 : -1]) + figures.bfd_mm
    assert behind == pytest.approx(before.bfd_mm + shift, rel=1e-12)
    # the file's last gap is where the sensor stands, to its three decimals
    assert plates[-1].thickness_mm == pytest.approx(figures.bfd_mm, abs=1e-3)
    assert lens.sensor_reflectance == 0.1
    assert all(s.coating for s in plates)
    # no plate clips the frame: what is left is the plates' own distortion
    seen = []
    for v in (bare, lens):
        real = RealLens(
            prescription=scaled_to_field(v, 65.0, SENSOR_MM), width_px=64, height_px=64, pixel_pitch_um=88.0
        )
        seen.append(real.relative_illumination(np.linspace(0.01, 0.85, 8)))
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.03)


@pytest.mark.parametrize("name", LENSES)
def test_the_sensor_raises_ghosts_near_the_axis(name: str) -> None:
    try:
        llvm.find()
    except VbnfaultError as error:
        pytest.skip(f"no usable LLVM: {error}")
    lens = scaled_to_field(load_lens(f"{name}_camera"), 65.0, SENSOR_MM).coated("bbar")
    at = np.arange(32) + 0.5 - 16
    near = np.hypot(at, at[:, None]) < 4
    light = []
    for reflectance in (0.0, 0.05, 0.1):
        found = SunInLens(
            lens=replace(lens, sensor_reflectance=reflectance),
            bands=Bands.lines(450.0, 650.0),
            sensor=SensorGrid(shape=(32, 32), pitch_mm=SENSOR_MM / 32),
            sun=SunSource(angle_deg=3.0, radius_rad=4.65e-3),
        ).straylight()
        light.append(float(found.ghosts.planes[:, near].sum()))
    # of two reflections one is the sensor's: linear in its reflectance; brighter ghosts are drawn with more rays,
    # and a spot of half a pixel may move across the circle's edge (3 % met)
    assert light[2] - light[0] == pytest.approx(2 * (light[1] - light[0]), rel=0.06)
    assert light[2] > 5 * light[0]
