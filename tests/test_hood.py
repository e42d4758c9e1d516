"""A hood before the lens: which rays pass it, against the closed form of overlapping circles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import needs_llvm
from lens_kit import lens_area
from test_scene_straylight import SINGLET, behind, flux_of

from vbnfault.core.errors import VbnfaultError
from vbnfault.core.spectra import Bands
from vbnfault.lens import load_lens
from vbnfault.lens.prescription import Hood, Prescription
from vbnfault.lens.prescription_file import parse_lens, to_table
from vbnfault.lens.straylight import ghost_response
from vbnfault.lens.straylight.bundles import Rays, Tracer
from vbnfault.lens.straylight.irradiance import ParaxialTracer
from vbnfault.lens.straylight.scatter import Cleanliness, hood_transmission
from vbnfault.lens.straylight.settings import SensorGrid, StraylightSettings, SunSource
from vbnfault.lens.straylight.total import SunInLens

needs_llvm()

LENGTH, RADIUS, RIM = 40.0, 14.0, 8.0
HOOD = f"hood = {{ length_mm = {LENGTH}, radius_mm = {RADIUS} }}\n"


@pytest.fixture(scope="module")
def hooded(tmp_path_factory: pytest.TempPathFactory) -> Prescription:
    path = tmp_path_factory.mktemp("lens") / "hooded.toml"
    path.write_text(SINGLET + HOOD)
    return load_lens(path)


def overlap(shift: float) -> float:
    """The part of a circle of radius `RIM` within the hood's edge, in closed form."""
    return float(lens_area(max(shift, 1e-9), RIM, RADIUS) / (np.pi * RIM**2))


@pytest.mark.parametrize("kind", [Tracer, ParaxialTracer])
@pytest.mark.parametrize("slope", [0.0, 0.14, 0.2, 0.35, 0.5, 0.56])
def test_rays_through_a_hood_are_two_overlapping_circles(
    hooded: Prescription, kind: type[Tracer], slope: float
) -> None:
    """Of a lattice over the first rim."""
    made = kind(hooded, np.array([550.0]), routes_=[()])
    across = 400
    rays = Rays(
        route=np.zeros(1, dtype=np.int64),
        wavelength=np.zeros(1, dtype=np.int64),
        box_mm=np.array([[0.0, 0.0, RIM, RIM]]),
        direction=np.array([[slope, 0.0, 1.0]]) / np.hypot(1, slope),
    )
    start = made._start(rays, np.array([across]), True, False)
    outside = made._hood_rim(start)[0].numpy()
    x, y = start.x.numpy(), start.y.numpy()
    rim = np.hypot(x, y) < RIM
    # a cell at the edge counts whole or not at all: 4 · 400 of 125,000 cells, of random sign
    assert (outside[rim] < 1).mean() == pytest.approx(overlap(LENGTH * slope), abs=2e-3)
    assert float(hood_transmission(hooded, slope)) == pytest.approx(overlap(LENGTH * slope), abs=1e-9)
    # the shadow moves with the source: light from the right leaves the rim's right side dark
    if 0.2 < slope < 0.5:
        assert x[rim & (outside < 1)].mean() > 0.3


def test_ghosts_of_rays_past_the_hood(hooded: Prescription) -> None:
    """Unchanged within the angle where the rim is lit wholly, dimmed beyond, gone beyond the cutoff."""
    bare = replace(hooded, hood=None)
    full, cutoff = (RADIUS - RIM) / LENGTH, (RADIUS + RIM) / LENGTH
    sensor = SensorGrid(shape=(48, 48), pitch_mm=0.8)

    def light(lens: Prescription, slope: float) -> tuple[float, float, float]:
        sun = SunSource(angle_deg=float(np.degrees(np.arctan(slope))), radius_rad=2e-3)
        settings = StraylightSettings(cleanliness=Cleanliness(roughness_nm=1.0, level=100))
        of = SunInLens(lens=lens, bands=Bands.lines(550.0), sensor=sensor, sun=sun, settings=settings)
        parts = of.straylight().parts()
        return tuple(float(parts[name].sum()) for name in ("ghosts", "glare", "veil"))  # type: ignore[return-value]

    within, plain = light(hooded, 0.9 * full), light(bare, 0.9 * full)
    assert within == pytest.approx(plain, rel=1e-6)
    between, plain = light(hooded, 0.4), light(bare, 0.4)
    part = overlap(LENGTH * 0.4)
    assert between[1:] == pytest.approx([part * v for v in plain[1:]], rel=1e-6)
    assert 0 < between[0] < plain[0]
    assert light(hooded, 1.02 * cutoff) == (0, 0, 0)


def test_a_scene_past_the_hood(hooded: Prescription) -> None:
    """The response has no ghosts of sources beyond the cutoff, and another key than without the hood."""
    scene = behind(hooded, 24, 70.0)
    response = scene.response
    slopes = np.array(response.cells.slopes)
    flux = flux_of(response)[0]
    assert (flux[slopes < 0.1] > 0).all()
    # a ring holds the sources as far as its neighbours
    assert not flux[slopes > (RADIUS + RIM) / LENGTH + 2 * slopes[1]].any()
    assert slopes[-1] > 0.7
    # glare and veil are dimmed by the shade of the hood, as for the Sun
    angles = np.array([0.0, 0.4, 1.02 * (RADIUS + RIM) / LENGTH])
    np.testing.assert_allclose(scene._lit(angles), [1.0, overlap(LENGTH * 0.4), 0.0], atol=1e-9)
    keys = {
        ghost_response.response_key(lens, Bands.lines(550.0), response.cells, scene.settings.ghosts, 0.0)
        for lens in (hooded, replace(hooded, hood=None), replace(hooded, hood=Hood(length_mm=41, radius_mm=RADIUS)))
    }
    assert len(keys) == 3


def test_a_hood_is_written_and_scaled_with_its_lens(hooded: Prescription) -> None:
    assert hooded.hood == Hood(length_mm=LENGTH, radius_mm=RADIUS)
    assert parse_lens(to_table(hooded), source="again").hood == hooded.hood
    assert hooded.scaled(2.0).hood == Hood(length_mm=2 * LENGTH, radius_mm=2 * RADIUS)
    assert "hood" not in to_table(replace(hooded, hood=None))


@pytest.mark.parametrize(
    ("hood", "words"),
    [
        ("{ length_mm = 10.0, radius_mm = 7.0 }", "hood.radius_mm = 7: must be at least 8"),
        ("{ length_mm = 0.0, radius_mm = 9.0 }", "hood.length_mm = 0"),
        ("{ length_mm = 10.0 }", "hood.radius_mm"),
    ],
)
def test_a_wrong_hood_is_refused_in_a_sentence(tmp_path: Path, hood: str, words: str) -> None:
    (tmp_path / "wrong.toml").write_text(f"{SINGLET}hood = {hood}\n")
    with pytest.raises(VbnfaultError, match=words):
        load_lens(tmp_path / "wrong.toml")
