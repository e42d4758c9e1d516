"""Convert the numbers of an image to fractions of white in linear light, and back."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from ..core.files import user_files
from ..scene.instrument import ResponseCurve

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """Describe how the numbers of an image follow from linear light.

    Attributes
    ----------
    black_dn, white_dn
        Numbers without light and at white; white is above black.
    curve
        `linear`; `srgb` of IEC 61966-2-1; `gamma`, where the fraction between black and white is that of the light
        to the power 1 / `gamma`; `table`.
    table
        Fractions of light and of the numbers, float64[n, 2], both rising from 0 to 1.
    """

    black_dn: float
    white_dn: float
    curve: ResponseCurve = "linear"
    gamma: float = 2.2
    table: F64 | None = None

    def light(self, numbers: ArrayLike) -> F64:
        """Return linear light over that of white, float64 in the shape of the numbers; negative below black."""
        code = (np.asarray(numbers, dtype=np.float64) - self.black_dn) / (self.white_dn - self.black_dn)
        if self.curve == "linear":
            return code
        if self.curve == "table":
            assert self.table is not None
            return np.interp(code, self.table[:, 1], self.table[:, 0])
        if self.curve == "gamma":
            return np.sign(code) * np.abs(code) ** self.gamma
        bright = np.maximum(code, 0.04045)
        return np.where(code <= 0.04045, code / 12.92, ((bright + 0.055) / 1.055) ** 2.4)

    def numbers(self, light: ArrayLike) -> F64:
        """Return the numbers of linear light, float64, neither rounded nor clipped."""
        value = np.asarray(light, dtype=np.float64)
        if self.curve == "table":
            assert self.table is not None
            value = np.interp(value, self.table[:, 0], self.table[:, 1])
        elif self.curve == "gamma":
            value = np.sign(value) * np.abs(value) ** (1 / self.gamma)
        elif self.curve == "srgb":
            bright = np.maximum(value, 0.0031308)
            value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * bright ** (1 / 2.4) - 0.055)
        return self.black_dn + (self.white_dn - self.black_dn) * value


@lru_cache(maxsize=8)
def read_table(path: str) -> F64:
    """Return a response of a CSV file: fraction of white in light and in numbers, float64[n, 2], from 0 to 1.

    Raises InputError if it cannot be read, or does not rise.
    """
    try:
        text = user_files.read_input(path, "response").decode()
        rows = np.atleast_2d(np.loadtxt(io.StringIO(text), delimiter=",", comments="#"))
    except ValueError as error:  # also of text that is no UTF-8
        raise InputError(f"image.response_file = {path!r}: cannot be read: {error}") from None
    if rows.shape[1] != 2 or len(rows) < 2:
        raise InputError(
            f"image.response_file = {path!r}: needs two columns, light and number, and two rows or more"
        )
    if not (np.isfinite(rows).all() and (np.diff(rows, axis=0) > 0).all()):
        raise InputError(f"image.response_file = {path!r}: both columns must rise from row to row")
    first, last = rows[0], rows[-1]
    return np.asarray((rows - first) / (last - first))
