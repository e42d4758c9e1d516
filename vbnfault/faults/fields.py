"""Declare, check and describe the fields of a fault model, which are its keys in the scene file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import field
from functools import lru_cache
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, StrictBool, StrictStr, TypeAdapter, create_model

from ..core import tables


class Interval(NamedTuple):
    """Hold the closed bounds of a uniform draw. If `lo == hi`, the value is fixed."""

    lo: float
    hi: float

    def uniform(self, rng: np.random.Generator, size: int | None = None) -> Any:
        """Return one uniform float in [lo, hi], or float64[size] if `size` is given."""
        value = rng.uniform(self.lo, self.hi, size)
        return float(value) if size is None else value

    def power_law(self, uniform: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
        """Return values in [lo, hi] with density ∝ v^-(exponent + 1), one for each uniform number in [0, 1].

        Far below `hi`, the number of values above v therefore falls as v^-exponent. Exponent 0 gives a density that
        is uniform in log v. `lo` must be above 0.
        """
        if abs(exponent) < 1e-9:
            return np.asarray(self.lo * (self.hi / self.lo) ** uniform)
        a, b = self.lo**-exponent, self.hi**-exponent
        return np.asarray((a + (b - a) * uniform) ** (-1 / exponent))

    def integer(self, rng: np.random.Generator) -> int:
        """Return one uniform integer in [lo, hi], both bounds included."""
        return int(rng.integers(int(self.lo), int(self.hi), endpoint=True))


# Keys in pixels and the range of a severity are given for a frame of this width; other widths scale them.
REFERENCE_WIDTH_PX = 1024


@dataclasses.dataclass(frozen=True, kw_only=True)
class Severity:
    """Name the key by which a model becomes more severe, with the mildest and the most severe value.

    Where less is worse, `low` is above `high`. Values between them are spaced evenly in their logarithm, so both
    are above 0. They hold for a frame of 1024 px.

    Attributes
    ----------
    step
        Step of a whole number.
    width_power, offset
        How a value changes with the width of the frame, so that it costs navigation the same:
        (value + offset) ∝ width^width_power. 0: a value costs the same in frames of all widths; 1: it does if it
        rises with the width, as a number of defects that each take a line.
    keys
        Other keys of the model that hold at every level, unless the scene sets them.
    drawn
        Called with the drawn parameters of a sample, and the shape and the focal length of its frame in px; returns
        the key's value. By default the parameters hold it under the key's name.
    """

    key: str
    low: float
    high: float
    step: int = 1
    width_power: float = 0.0
    offset: float = 0.0
    keys: Mapping[str, Any] = field(default_factory=dict, hash=False)
    drawn: Callable[[Mapping[str, Any], tuple[int, int], float], float] | None = field(default=None, compare=False)

    def of_sample(self, params: Mapping[str, Any], shape: tuple[int, int], focal_length_px: float) -> float:
        """Return the key's value in a sample; nan where its drawn parameters do not say it (see `drawn`)."""
        try:
            value = self.drawn(params, shape, focal_length_px) if self.drawn else params[self.key]
            return math.nan if isinstance(value, bool) else float(value)
        except (KeyError, TypeError, ValueError):  # of a model that keeps something else, or of another version
            return math.nan

    def position(self, value: float, width_px: int = REFERENCE_WIDTH_PX) -> float:
        """Return the position of a value for frames of a width: 0 the mildest, 1 the most severe."""
        value = self.at_width(value, REFERENCE_WIDTH_PX, given_for_px=width_px)
        return math.log(value / self.low) / math.log(self.high / self.low)

    def value(self, position: float, width_px: int = REFERENCE_WIDTH_PX) -> float:
        """Return the value for frames of a width at a position from 0, mildest, to 1, most severe."""
        return self.at_width(self.low * (self.high / self.low) ** position, width_px)

    def at_width(self, value: float, width_px: int, *, given_for_px: int = REFERENCE_WIDTH_PX) -> float:
        """Return the value that does to frames of one width what `value` does to frames of another."""
        return float((value + self.offset) * (width_px / given_for_px) ** self.width_power - self.offset)

    def setting(self, value: float, declared: Mapping[str, Any]) -> float | int | list[int]:
        """Return what a scene sets the key to, so that the value is the mean of the draws.

        A whole number is rounded to halves of a step: a half is drawn from both of its neighbours.

        Parameters
        ----------
        value
            The value.
        declared
            Metadata of the key's field.
        """
        if not declared.get("integer"):
            return float(f"{value:.6g}")
        # whole numbers are 1, 1 + step, …: none of something is no fault
        halves = max(round(2 * (value - 1) / self.step), 0)
        low = 1 + self.step * (halves // 2)
        drawn = declared["kind"] == "bounds" and halves % 2
        return [low, low + self.step] if drawn else low


def _declared(kind: str, checked: Any, default: Any, doc: str, **more: Any) -> Any:
    """Declare a field with the type by which pydantic checks its value and describes it in JSON Schema."""
    return field(default=default, metadata={"kind": kind, "type": checked, "doc": doc, **more})


def bounds(
    lo: float, hi: float, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """Declare a field that is drawn uniformly from [lo, hi].

    A scene may set other bounds, or one fixed value, within `limits`.
    """
    pair_of: Any = tuple
    value = _number(*limits, integer=integer)
    either = value | Annotated[pair_of[value, value], AfterValidator(tables.ordered)]
    return _declared("bounds", either, Interval(lo, hi), doc, limits=limits, unit=unit, integer=integer)


def number(
    default: float | None, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """Declare a fixed number within `limits`. If its default is None, a scene may leave it out."""
    value = _number(*limits, integer=integer)
    return _declared("number", value, default, doc, limits=limits, unit=unit, integer=integer)


def flag(default: bool, *, doc: str) -> Any:
    """Declare a fixed true or false."""
    return _declared("flag", StrictBool, default, doc)


def choice(default: str, options: tuple[str, ...], *, doc: str) -> Any:
    """Declare a string that must be one of `options`."""
    one_of: Any = Literal
    return _declared("choice", one_of[options], default, doc, options=options)


def text(default: str, *, doc: str) -> Any:
    """Declare a fixed string. For the path of a file, use `path`."""
    return _declared("text", StrictStr, default, doc)


def path(*, content: str = "data", packaged: str = "", doc: str) -> Any:
    """Declare the path of a file; empty by default.

    A relative path in a scene file starts from the scene file's folder, or from the working folder if nothing lies
    there. The contents of the file, not its path, belong to the identity of a store. Read the file with
    `core.files.user_files.read_input`, so that a change during a build is noticed.

    Parameters
    ----------
    content
        Kind of file in error messages, a key of `core.files.user_files.LIMIT_BYTES`.
    packaged
        Folder of packaged files, such as `scenes/lenses`. A value without a suffix is then the name of one of them.
    """
    return _declared("path", StrictStr, "", doc, content=content, packaged=packaged)


def paths(*, content: str = "data", doc: str) -> Any:
    """Declare a list of paths of files, each as `path` declares one; empty by default. One path needs no list."""
    return _declared("paths", StrictStr | list[StrictStr], (), doc, content=content, packaged="")


def rows(columns: Mapping[str, tuple[float, float]], *, doc: str) -> Any:
    """Declare a list of tables with the given numeric columns and their limits.

    The list is empty by default; the model then draws these values.
    """
    typed: dict[str, Any] = {name: (_number(*limits), ...) for name, limits in columns.items()}
    list_of: Any = list
    row = list_of[create_model("Row", __base__=tables.Table, **typed)]
    return _declared("rows", row, (), doc, columns=dict(columns))


def parse_field(value: Any, f: dataclasses.Field[Any], where: str) -> Any:
    """Return the value of one field after its check; `where` names the key in an InputError."""
    kind = f.metadata["kind"]
    if kind == "number" and value is None and f.default is None:
        return None
    tables.check(_checks(f), value, where, whole_value=kind == "bounds")
    # the numbers stay as they were given, 1 a whole number
    if kind == "rows":
        return tuple(dict(row) for row in value)
    if kind == "paths":
        return (value,) if isinstance(value, str) else tuple(value)
    if kind == "bounds":
        return Interval(*value) if isinstance(value, list | tuple) else Interval(value, value)
    return value


def field_schema(f: dataclasses.Field[Any]) -> dict[str, Any]:
    """Return the JSON Schema of one field."""
    unit = f" [{f.metadata['unit']}]" if f.metadata.get("unit") else ""
    schema = {"description": f.metadata["doc"] + unit, **_checks(f).json_schema()}
    row = schema.pop("$defs", {}).get("Row")
    if row:
        schema["items"] = row  # without a reference, which would not reach beyond this field
    if f.default is None:
        return schema
    return schema | {"default": list(f.default) if isinstance(f.default, tuple) else f.default}


@lru_cache(maxsize=1024)
def _checks(f: dataclasses.Field[Any]) -> TypeAdapter[Any]:
    """Return pydantic's checks of the value of a field."""
    return TypeAdapter(f.metadata["type"])


def _number(lo: float, hi: float, *, integer: bool = False) -> Any:
    """Return the type of a finite number within limits. A whole number may be written as 3.0."""
    least, most = (limit if math.isfinite(limit) else None for limit in (lo, hi))
    if not integer:
        return Annotated[float, Field(strict=True, allow_inf_nan=False, ge=least, le=most)]

    def whole(value: Any) -> Any:
        return int(value) if isinstance(value, float) and value.is_integer() else value

    return Annotated[int, Field(strict=True, ge=least, le=most), BeforeValidator(whole)]
