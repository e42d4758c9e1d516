"""Pixel overwriting: blends, channels, transparency, and bad files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from test_faults_kit import flat_rgbi, make, make_context, rng

from vbnfault.core.errors import InputError


def save(path: Path, array: np.ndarray) -> str:
    assert cv2.imwrite(str(path), array)
    return str(path)


def run(file: str, value: int = 100, **table: Any) -> tuple[np.ndarray, np.ndarray]:
    context = make_context(16, 12)
    fault = make("pixel_overwriting", texture_file=file, **table)
    params = fault.draw(context, rng())
    mask = fault.footprint(params, context)
    assert mask is not None
    return fault.apply(flat_rgbi(context, value), params, context).array, mask


@pytest.mark.parametrize(
    ("blend", "expected"),
    [("replace", 200), ("add", 255), ("multiply", round(100 * 200 / 255)), ("mixture", 125)],
)
def test_blends(tmp_path: Path, blend: str, expected: int) -> None:
    file = save(tmp_path / "t.png", np.full((12, 16), 200, np.uint8))
    out, mask = run(file, blend=blend, strength=0.25)
    assert (out == expected).all()
    assert mask.all()


def test_transparent_pixels_are_left_alone(tmp_path: Path) -> None:
    texture = np.full((12, 16, 4), 255, np.uint8)
    texture[:, 8:, 3] = 0
    texture[:, :2, 3] = 51  # a fifth
    out, mask = run(save(tmp_path / "t.png", texture))
    assert (out[:, 8:] == 100).all()
    assert (out[:, 2:8] == 255).all()
    assert (out[:, :2] == 131).all()
    assert np.array_equal(mask, np.tile(np.arange(16) < 8, (12, 1)))


def test_channels_and_colour_order(tmp_path: Path) -> None:
    bgr = np.zeros((12, 16, 3), np.uint8)
    bgr[:] = (10, 20, 30)
    file = save(tmp_path / "t.tiff", bgr)
    assert run(file, channels="RGB")[0][0, 0].tolist() == [30, 20, 10, 100]
    assert run(file, channels="R")[0][0, 0].tolist() == [30, 100, 100, 100]
    # I alone: 0.2126 · 30 + 0.7152 · 20 + 0.0722 · 10 = 21.4, and RGB by the same ratio
    assert run(file, channels="I")[0][0, 0].tolist() == [21, 21, 21, 21]


def test_masks_of_add_and_multiply(tmp_path: Path) -> None:
    texture = np.zeros((12, 16), np.uint8)
    texture[3, 4] = 9
    texture[5, 5] = 255
    file = save(tmp_path / "t.png", texture)
    assert np.argwhere(run(file, blend="add")[1]).tolist() == [[3, 4], [5, 5]]
    assert np.argwhere(~run(file, blend="multiply")[1]).tolist() == [[5, 5]]


def test_16_bit_and_stretching(tmp_path: Path) -> None:
    file = save(tmp_path / "t.png", np.full((6, 8), 257 * 40, np.uint16))
    assert (run(file)[0] == 40).all()


def test_bad_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"faults\.pixel_overwriting: texture_file is missing"):
        make("pixel_overwriting")
    with pytest.raises(InputError, match=r"texture_file = '.*nowhere\.png': texture file not found"):
        make("pixel_overwriting", texture_file=str(tmp_path / "nowhere.png"))
    junk = tmp_path / "junk.png"
    junk.write_text("no image")
    with pytest.raises(InputError, match=r"texture_file = .*junk\.png.*: is not a PNG or TIFF image"):
        run(str(junk))
    good = save(tmp_path / "good.png", np.full((12, 16), 200, np.uint8))
    for channels in ("", "RGX", "RR"):
        with pytest.raises(InputError, match="channels = "):
            make("pixel_overwriting", texture_file=str(good), channels=channels)


def test_a_file_that_changed_is_refused(tmp_path: Path) -> None:
    file = save(tmp_path / "t.png", np.full((12, 16), 200, np.uint8))
    context = make_context(16, 12)
    fault = make("pixel_overwriting", texture_file=file)
    params = fault.draw(context, rng())
    save(tmp_path / "t.png", np.full((12, 16), 10, np.uint8))
    with pytest.raises(InputError, match="changed since"):
        fault.apply(flat_rgbi(context, 1), params, context)
