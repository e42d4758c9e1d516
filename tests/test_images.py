"""Image files keep their pixels and the order of their channels; sRGB has its published values."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from vbnfault.core.images import decoded_image, image_size_px, srgb8, write_png


@pytest.mark.parametrize("channels", [0, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_png_holds_red_first(channels: int, dtype: type, tmp_path: Path) -> None:
    shape = (5, 7, channels) if channels else (5, 7)
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape, dtype=dtype)
    path = write_png(tmp_path / "image.png", image, smallest=dtype is np.uint16)
    again = decoded_image(path.read_bytes())
    assert again is not None
    assert again.dtype == dtype
    np.testing.assert_array_equal(again, image)
    if channels:  # OpenCV shows what the file holds, in its own order
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(stored[..., 2], image[..., 0])
        np.testing.assert_array_equal(stored[..., 0], image[..., 2])


def test_other_data_are_no_image() -> None:
    assert decoded_image(b"") is None
    assert decoded_image(b"no image") is None


def test_a_png_that_claims_more_than_it_holds_is_no_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV would allocate what a chunk claims to hold, here 1.7 GiB, before it finds the file shorter."""
    good = write_png(tmp_path / "image.png", np.arange(35, dtype=np.uint8).reshape(5, 7)).read_bytes()
    start = good.index(b"IDAT") - 4
    wrong = [
        good[:start] + (0x6CE00183).to_bytes(4, "big") + good[start + 4 :],
        good[:-4],
        good[: good.index(b"IEND") - 4],
    ]
    assert decoded_image(good + b"and more") is not None
    decoded: list[bytes] = []
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: decoded.append(data.tobytes()))
    for data in wrong:
        assert decoded_image(data) is None
    assert decoded == []


def test_the_size_is_in_the_header(tmp_path: Path) -> None:
    image = np.zeros((5, 7, 3), np.uint8)
    assert image_size_px(write_png(tmp_path / "image.png", image).read_bytes()) == (7, 5)
    done, tiff = cv2.imencode(".tiff", image)
    assert done
    assert image_size_px(tiff.tobytes()) == (7, 5)
    assert image_size_px(b"no image") == (0, 0)
    assert image_size_px(tiff.tobytes()[:7]) == (0, 0)


def test_srgb_has_the_values_of_its_standard() -> None:
    # IEC 61966-2-1: 12.92 L up to 0.0031308, then 1.055 L^(1/2.4) - 0.055; 0.5 is encoded as 0.7354 of white
    np.testing.assert_array_equal(
        srgb8([-1.0, 0.0, 0.001, 0.5, 1.0, 2.0]), [0, 0, round(255 * 0.01292), 188, 255, 255]
    )
    assert srgb8(np.zeros((2, 3), np.float32)).shape == (2, 3)
