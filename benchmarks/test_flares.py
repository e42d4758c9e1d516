"""Measure how long all ghosts of the Sun take for each packaged lens.

    python -m pytest benchmarks/test_flares.py --benchmark-only -n 0

The lens is scaled to a field of 65° on 1024 pixels (`--size`), in the channels of the three-colour detector.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from workload import clock

from vbnfault.core import spectra
from vbnfault.core.files.resources import packaged
from vbnfault.core.spectra import Bands
from vbnfault.detector import ThreeColourDetector
from vbnfault.lens import load_lens, scaled_to_focal_length
from vbnfault.lens.straylight.irradiance import FlareModel
from vbnfault.lens.straylight.settings import SensorGrid

SIDE_MM = 5.632
NM = np.linspace(400.0, 700.0, 301)


@pytest.mark.parametrize("sun_deg", [5.0, 14.0, 25.0])
@pytest.mark.parametrize("name", packaged("scenes/lenses"))
def test_flare(benchmark: Any, rounds: int, request: pytest.FixtureRequest, name: str, sun_deg: float) -> None:
    """Time a flare of one lens at one angle of the Sun."""
    size = request.config.getoption("--size")
    model = FlareModel(
        scaled_to_focal_length(load_lens(name), SIDE_MM / 2 / np.tan(np.radians(32.5))),
        Bands.of(NM, ThreeColourDetector().electron_rates(NM) * spectra.solar_irradiance_W_m2_nm(NM)),
        SensorGrid(shape=(size, size), pitch_mm=SIDE_MM / size),
        sun_radius_rad=4.65e-3,
    )
    _, light = benchmark.pedantic(lambda: clock(lambda: model.image(sun_deg, 30.0)), rounds=rounds, warmup_rounds=1)
    assert light.any()
