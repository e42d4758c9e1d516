"""Relatives of lenses, and prescriptions written and read again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_lens import PUBLISHED

from vbnfault.core.errors import InputError
from vbnfault.lens import load_lens, paraxial_properties
from vbnfault.lens.adapt import relative
from vbnfault.lens.prescription_file import to_table, write_lens


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_lens_survives_being_written(name: str, tmp_path: Path) -> None:
    lens = load_lens(name).coated("v")
    stop = lens.surfaces[lens.stop]
    surfaces = list(lens.surfaces)
    surfaces[lens.stop] = replace(stop, blades=7, blade_rounding=0.25, rotation_deg=12.0)
    surfaces[0] = replace(
        surfaces[0], conic=-0.1, aspheric_mm=(1e-7,), internal_transmittance_10mm=((400.0, 700.0), (0.9, 0.99))
    )
    lens = replace(
        lens, surfaces=tuple(surfaces), sensor_reflectance=0.2, name='a "lens" \\ of old\n[surface]\t\x00\x7f 🌀 α'
    )
    write_lens(lens, tmp_path / "lens.toml")
    again = load_lens(tmp_path / "lens.toml")
    assert (again.name, again.source, again.sensor_reflectance) == (lens.name, lens.source, 0.2)
    for a, b in zip(lens.surfaces, again.surfaces, strict=True):
        assert replace(a, medium=b.medium) == b
        np.testing.assert_allclose(a.medium.index([400.0, 550.0, 900.0]), b.medium.index([400.0, 550.0, 900.0]))


def test_a_scaled_lens_is_written_with_its_own_lengths(tmp_path: Path) -> None:
    """The file holds the lens as scaled; what is read from a file is not scaled yet."""
    lens = load_lens("tessar_50_f2p8")
    lens = replace(lens, surfaces=(replace(lens.surfaces[0], aspheric_mm=(1e-7, 1e-10)), *lens.surfaces[1:]))
    lens = lens.scaled(0.37)
    write_lens(lens, tmp_path / "lens.toml")
    again = load_lens(tmp_path / "lens.toml")
    assert (lens.scale, again.scale) == (0.37, 1.0)
    # media compare by index in the test above: nd and vd give their coefficients but for rounding
    for a, b in zip(lens.surfaces, again.surfaces, strict=True):
        assert replace(a, medium=b.medium) == b
    assert paraxial_properties(again).efl_mm == pytest.approx(paraxial_properties(lens).efl_mm, rel=1e-9)


def test_a_name_without_utf_8_can_be_written(tmp_path: Path) -> None:
    lens = replace(load_lens("tessar_50_f2p8"), name="lens \udcff")  # as a path of undecodable bytes has it
    write_lens(lens, tmp_path / "lens.toml")
    assert load_lens(tmp_path / "lens.toml").name == "lens ?"


def test_relatives_are_valid_alike_and_repeatable() -> None:
    lens = load_lens("distagon_25_f2p8")
    found = [relative(lens, np.random.default_rng(seed), spread=0.03) for seed in (1, 1, 2)]
    assert to_table(found[0]) == to_table(found[1])
    assert to_table(found[0]) != to_table(found[2])
    for one in found:
        assert len(one.surfaces) == len(lens.surfaces)
        assert paraxial_properties(one).efl_mm == pytest.approx(paraxial_properties(lens).efl_mm, rel=1e-9)
    many = [relative(lens, np.random.default_rng(seed), spread=0.02) for seed in range(40)]
    # of two radii the ratio, which no scaling changes: √2 · 0.02, of 40 draws uncertain to 11 %
    logs = np.log([one.surfaces[0].radius_mm / -one.surfaces[-1].radius_mm for one in many])
    assert 0.019 < logs.std() < 0.038
    same = relative(lens, np.random.default_rng(0), spread=0.0, index_spread=0.0)
    assert paraxial_properties(same).bfd_mm == pytest.approx(paraxial_properties(lens).bfd_mm, rel=1e-9)


def test_a_spread_out_of_range() -> None:
    with pytest.raises(InputError, match=r"spread = 0\.5: must be from 0 to 0\.3"):
        relative(load_lens("tessar_50_f2p8"), np.random.default_rng(0), spread=0.5)
