"""Bring the images of a comparison to the forms that the metrics need, and check them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.quantities import LUMINANCE

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]


def intensity(image: NDArray[Any], name: str = "image") -> F32:
    """Return the intensity of an image, float32[y, x], in the image's own unit.

    Parameters
    ----------
    image
        [y, x]; or [y, x, 3] with R, G, B, whose luminance (Rec. 709) is returned; or [y, x, 4] with R, G, B, I,
        whose last channel is returned. Integers of any width, or floats without NaN and infinity.
    name
        Name of the image in messages.

    Raises
    ------
    InputError
        The array is no such image.
    """
    array = np.asarray(image)
    kind = array.dtype.kind
    if kind not in "uif" or array.ndim not in (2, 3) or not array.size:
        raise InputError(
            f"{name}: shape {array.shape} of {array.dtype}: must be numbers of shape [y, x], [y, x, 3] or "
            "[y, x, 4], and not empty"
        )
    if array.ndim == 3:
        if array.shape[2] not in (3, 4):
            raise InputError(f"{name}: {array.shape[2]} channels: must be 3 (R, G, B) or 4 (R, G, B, I)")
        array = array[..., 3] if array.shape[2] == 4 else array.astype(np.float32) @ LUMINANCE
    out = np.ascontiguousarray(array, dtype=np.float32)
    if kind == "f" and not np.isfinite(out).all():
        raise InputError(f"{name}: holds NaN or infinity; every pixel must be a finite number")
    return out


def same_shape(first: NDArray[Any], second: NDArray[Any], first_name: str, second_name: str) -> None:
    """Raise InputError if two images, or an image and a map, differ in height or width."""
    a, b = np.shape(first)[:2], np.shape(second)[:2]
    if a != b:
        raise InputError(
            f"{second_name}: {_size(b)} (height x width) px: must have the {_size(a)} px of {first_name}"
        )


def _size(shape: tuple[int, ...]) -> str:
    """Return a height and a width for a message."""
    return " x ".join(str(length) for length in shape)


def white_level(image: NDArray[Any]) -> float:
    """Return the signal that detectors of features see as 255: 255 for uint8, else the image's largest value."""
    array = np.asarray(image)
    return 255.0 if array.dtype == np.uint8 else float(max(array.max(), 0))


def eight_bit(image: NDArray[Any], white: float, name: str = "image") -> U8:
    """Return the intensity as detectors of features need it, uint8[y, x], 255 at `white` and above.

    Raises
    ------
    InputError
        The array is no image (`intensity`).
    """
    if white <= 0:
        return np.zeros(intensity(image, name).shape, dtype=np.uint8)
    scaled = intensity(image, name) * np.float32(255 / white)
    return np.asarray(np.clip(np.rint(scaled), 0, 255).astype(np.uint8))
