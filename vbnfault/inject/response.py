"""Convert the numbers of an image to fractions of white in linear light, and back."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, in_file, under_key
from ..core.files import user_files
from ..core.process.llvm import empty
from ..scene.instrument import ResponseCurve

F64 = NDArray[np.float64]
T = TypeVar("T", bound=np.generic)


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

    def of_image(self, numbers: NDArray[Any], function: Callable[[Any], NDArray[T]]) -> NDArray[T]:
        """Return a function of numbers, in their shape; for whole numbers of 16 bits or less by a table of all."""
        if numbers.dtype not in (np.uint8, np.uint16):
            return function(numbers)
        table = function(np.arange(np.iinfo(numbers.dtype).max + 1, dtype=numbers.dtype))
        if numbers.dtype == np.uint8:
            out = empty(numbers.shape, table.dtype)
            cv2.LUT(numbers, table, out)  # ten times as fast as numpy
            return out
        return np.take(table, numbers)

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

    def shown(self, numbers: ArrayLike) -> NDArray[np.float32]:
        """Return the light of numbers, float32 in their shape, as `light` does: below 0 for numbers below black."""
        return self.light(numbers).astype(np.float32)

    def levels(self, numbers: ArrayLike) -> NDArray[np.uint8]:
        """Return the numbers as levels of 8 bits from black to white, uint8 in their shape."""
        scale = np.float32(255 / (self.white_dn - self.black_dn))
        code = (np.asarray(numbers, dtype=np.float32) - np.float32(self.black_dn)) * scale
        return np.clip(np.rint(code), 0, 255).astype(np.uint8)

    def numbers(self, light: Any, xp: Any = np) -> Any:
        """Return the numbers of linear light, neither rounded nor clipped.

        `xp` is the array namespace, numpy (float64) or drjit (single precision, which knows no table).
        """
        value = np.asarray(light, dtype=np.float64) if xp is np else light
        where = np.where if xp is np else xp.select
        if self.curve == "table":
            assert self.table is not None
            value = np.interp(value, self.table[:, 0], self.table[:, 1])
        elif self.curve == "gamma":
            value = xp.sign(value) * xp.power(xp.abs(value), 1 / self.gamma)
        elif self.curve == "srgb":
            bright = xp.maximum(value, 0.0031308)
            value = where(value <= 0.0031308, 12.92 * value, 1.055 * xp.power(bright, 1 / 2.4) - 0.055)
        return self.black_dn + (self.white_dn - self.black_dn) * value


def read_table(path: str) -> F64:
    """Return a response of a CSV file: fraction of white in light and in numbers, float64[n, 2], from 0 to 1.

    Raises InputError if it cannot be read, or does not rise.
    """
    if not path:
        raise InputError("image.response_file: is missing; response = 'table' needs a CSV file of two columns")
    with under_key("image.response_file"), in_file(path):
        return _table(user_files.read_input(path, "response"))


@lru_cache(maxsize=8)
def _table(data: bytes) -> F64:
    """Return what `read_table` does from the contents of the file."""
    try:
        rows = np.atleast_2d(np.loadtxt(io.StringIO(data.decode()), delimiter=",", comments="#"))
    except ValueError as error:  # also of text that is no UTF-8
        raise InputError(f"cannot be read: {error}") from None
    if rows.shape[1] != 2 or len(rows) < 2:
        raise InputError("needs two columns, light and number, and two rows or more")
    if not (np.isfinite(rows).all() and (np.diff(rows, axis=0) > 0).all()):
        raise InputError("both columns must rise from row to row")
    first, last = rows[0], rows[-1]
    return np.asarray((rows - first) / (last - first))
