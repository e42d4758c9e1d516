"""Levels of severity of stored faults: those of the table, of absent and of unknown faults."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_faults_kit import make_context, with_mosaic

from vbnfault.detect.severity_labels import severity_level
from vbnfault.faults import Levels, from_dict, registry

LEVELLED = [
    (fault, model, k + 1)
    for fault, models in Levels().table.levels.items()
    for model, levels in models.items()
    for k, value in enumerate(levels.values)
    if not math.isnan(value) and k % 2 == 0
]
# the parameters hold electrons, codes or packets, which without the sensor are no value of the key
UNSAID = {"adc/converter", "banding/interference", "blooming/overflow", "transmission/packets"}


@pytest.mark.parametrize(("fault", "model", "level"), LEVELLED)
def test_a_fault_of_a_level_has_this_level(fault: str, model: str, level: int) -> None:
    table, needs = Levels().table, registry()[fault][model]
    assert needs.severity is not None
    context = make_context(1024, sun_xy_px=(400.0, 300.0))
    if needs.needs_mosaic:
        context = with_mosaic(context)
    made = from_dict(fault, {"model": model, "severity": level}, source="test.toml")
    params = {"model": model, **made.draw(context, np.random.default_rng(3))}
    focal = float(context.camera.intrinsics[0])
    found = severity_level(fault, params, context.shape, focal, table)
    if f"{fault}/{model}" in UNSAID:
        assert math.isnan(found)
    else:  # a whole number that is drawn from two neighbours is off by half a step: 17 px for 16 px, level 1.25
        assert found == pytest.approx(level, abs=0.26)


def test_levels_of_absent_and_unknown_faults() -> None:
    table, (fault, model, _) = Levels().table, LEVELLED[0]
    assert severity_level(fault, None, (8, 8), 8.0, table) == 0
    assert math.isnan(severity_level(fault, {"model": "of_a_plug_in"}, (8, 8), 8.0, table))
    assert math.isnan(severity_level(fault, {"model": model}, (8, 8), 8.0, table))


def test_a_value_milder_than_the_mildest_is_level_0() -> None:
    """A blur by 3 px in a frame of 256 px is less than none in one of 1024 px, whose logarithm does not exist."""
    params = {"model": "gaussian", "filter_size_px": 3}
    assert severity_level("optics_degradation", params, (256, 256), 200.0, Levels().table) == 0


def test_a_level_is_linear_in_the_logarithm_of_its_value() -> None:
    """Half way from the mildest value, 1 in a frame of 1024 px, to the first level, and then to the second."""
    values = np.array(Levels().table.levels["broken_pixels"]["texture"].values)
    values *= 4  # the table's frames have 256 px

    def level(count: float) -> float:
        params = {"model": "texture", "x": [0] * round(count)}
        return severity_level("broken_pixels", params, (1024, 1024), 900.0, Levels().table)

    # a count is rounded to a whole number of about 14 and 270
    assert level(math.sqrt(values[0])) == pytest.approx(0.5, abs=0.5 / 14 / math.log(values[0]) + 1e-9)
    assert level(math.sqrt(values[0] * values[1])) == pytest.approx(
        1.5, abs=0.5 / 270 / math.log(values[1] / values[0])
    )
    assert level(9999) == 5
