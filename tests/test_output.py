"""What the commands write: JSON without NaN, drawings with row numbers, and flares with a fixed exposure."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.transforms import Bbox

from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.files.whole_files import write_json
from vbnfault.lens import load_lens
from vbnfault.lens.adapt import LensRequest, adapted_lens
from vbnfault.output import flare_images, lens_sheet


def test_json_has_null_where_a_number_is_not_finite(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    values = {"a": float("nan"), "b": (np.float32("inf"), 1), "c": np.array([[1.5, -np.inf]]), "d": [{"e": True}]}
    write_json(path, values)
    read = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert read == {"a": None, "b": [None, 1], "c": [[1.5, None]], "d": [{"e": True}]}


@pytest.mark.parametrize("name", sorted(resources.packaged("scenes/lenses")))
def test_a_lens_is_drawn_with_the_number_of_every_row_and_none_overlaps(name: str) -> None:
    lens = load_lens(name)
    figure = lens_sheet.layout(lens)
    numbers = [text for text in figure.axes[0].texts if text.get_text().isdigit()]
    assert [text.get_text() for text in numbers] == [str(row) for row in range(len(lens.surfaces))]
    boxes = [text.get_window_extent() for text in numbers]
    for k, box in enumerate(boxes):
        assert not any(Bbox.intersection(box, other) for other in boxes[k + 1 :])
    frame = figure.axes[0].get_window_extent()
    assert all(frame.x0 < box.x0 and box.x1 < frame.x1 and box.y1 < frame.y1 for box in boxes)


def linear(image: np.ndarray) -> np.ndarray:
    """Linear light of an sRGB image, by IEC 61966-2-1."""
    level = image / 255
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)


def test_flares_of_one_white_level_have_one_exposure() -> None:
    """Bare glass reflects more than coated glass, and pictures of one level show it."""
    level = 1e-3
    request = flare_images.FlareRequest(
        lens=load_lens("tessar_50_f2p8"),
        sun_deg=12.0,
        wavelength_nm=flare_images.wavelengths_nm(550.0),
        pixels=32,
        model="paraxial",
        white=level,
    )
    brightness: list[float] = []
    for coating in ("none", "mgf2"):
        flare = flare_images.compute(replace(request, lens=request.lens.coated(coating)))
        assert flare.white == level
        irradiance = sum(flare.layers.values())[0]
        shown = linear(flare_images.picture(flare)[..., 1])
        dim = irradiance < level
        assert dim.any()
        # the largest step between two of the 256 codes of sRGB is 0.0089 at white; half of it rounds
        np.testing.assert_allclose(shown[dim], irradiance[dim] / level, atol=0.0045)
        assert (shown[~dim] == 1).all()
        brightness.append(float(shown.mean()))
        alone = flare_images.Flare(request=replace(request, white=None), layers=flare.layers)
        assert alone.white != level
    assert brightness[0] > 2 * brightness[1]
    texture = flare_images.compute(replace(request, model="texture", white=None))
    assert (texture.white, texture.ghosts) == (1.0, ())
    with pytest.raises(InputError, match=r"white = 0: must be from 1e-12 to 1e\+06"):
        replace(request, white=0)


def test_a_flares_progress_has_as_many_steps_as_it_says() -> None:
    steps: list[int] = []
    request = flare_images.FlareRequest(
        lens=load_lens("tessar_50_f2p8"), sun_deg=12.0, wavelength_nm=np.array([500.0, 600.0]), pixels=16
    )
    for model in ("paraxial", "texture"):
        steps.clear()
        flare_images.compute(replace(request, model=model), steps.append)
        assert sum(steps) == replace(request, model=model).steps == {"paraxial": 9, "texture": 1}[model]


def test_changes_of_a_lens_that_contradict_each_other_are_refused() -> None:
    sentence = "focal_length_mm = 9: contradicts fov_deg = 40 and sensor_width_mm = 5; leave one out"
    with pytest.raises(InputError, match=sentence):
        LensRequest(lens="tessar_50_f2p8", fov_deg=40.0, sensor_width_mm=5.0, focal_length_mm=9.0)


def test_a_lens_request_makes_its_changes() -> None:
    request = LensRequest(lens="tessar_50_f2p8", coating="none", focal_length_mm=10.0, f_number=8.0)
    lens, figures = adapted_lens(request), lens_sheet.figures(adapted_lens(request))
    assert figures["efl_mm"] == pytest.approx(10.0)
    assert figures["real_f_number"] == pytest.approx(8.0, rel=1e-6)
    assert not any(surface.coating for surface in lens.surfaces)
