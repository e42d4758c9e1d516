"""Read a camera's frames for a fit of its sensor, and compute moments of groups of them in DN.

A frame is a PNG, TIFF or FITS file of whole digital numbers (DN), as the converter gave them. A folder may hold
`frames.csv`, a table with the column `name`, the file's, and any of `kind`, `exposure_s` and `temperature_K`. A
FITS file without a row says its exposure and temperature by EXPTIME and CCD-TEMP (degrees Celsius).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats
from scipy.special import ndtr, ndtri

from ..core.errors import InputError, shown, suggestion
from ..core.files import user_files
from ..core.files.path_checks import real, why_absent
from ..core.files.raw_frames import FRAME_TYPES, read_frame

Kind = Literal["dark", "flat", "star", "frame"]
TABLE = "frames.csv"
_COLUMNS = ("name", "kind", "exposure_s", "temperature_K")
_LEAST_PX = 64
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDING_DN2 = 1 / 12  # EMVA 1288 eq. 11; where noise is below `_DITHERED_DN`, see `noise_before_rounding`
OUTLIER = 6.0  # standard deviations beyond which a pixel was hit by a particle, or is defective
TWO_SIDED = float(ndtri(0.975))
LEAST_VARIANCE_DN2 = 0.02  # below, rounding hides the noise
_DITHERED_DN = 0.6
_PIXELS, _LINE = 11, 31  # widths over which pixels and lines are compared with their neighbours
_LIMITS = {"exposure_s": (0.0, 1e6), "temperature_K": (50.0, 400.0)}
_CARDS = {"exposure_s": ("EXPTIME", 0.0), "temperature_K": ("CCD-TEMP", 273.15)}  # of FITS, and what is added


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """Hold one frame: its kind, raw numbers [y, x] in DN, and exposure and temperature where they are known."""

    name: str
    kind: Kind
    image: NDArray[Any]
    exposure_s: float | None = None
    temperature_K: float | None = None


def read_exposures(paths: Mapping[Kind, Sequence[Path]]) -> list[Exposure]:
    """Return the frames of folders and files, by the kind that those have whose table does not say it.

    Numbers that are all multiples of a power of two, such as 12 bits at the top of 16, are divided by it. Raises
    InputError for a wrong file or table, without a frame, for frames of different sizes, and for copies.
    """
    rows: dict[Path, tuple[Path, dict[str, Any]]] = {}
    for kind, given in paths.items():
        for file, row in (one for path in given for one in _in_path(path)):
            row = {"kind": kind, **row}
            if rows.setdefault(real(file), (file, row))[1] != row:
                raise InputError(f"{file}: is given twice, with another kind or exposure; name it once")
    found = [_read(file, row) for file, row in rows.values()]
    if not found:
        raise InputError("there is no frame; name folders or files of PNG, TIFF or FITS images")
    first = found[0]
    for one in found:
        if one.image.shape != first.image.shape:
            size, other = (f"{image.shape[1]}x{image.shape[0]}" for image in (one.image, first.image))
            raise InputError(f"{one.name}: is {size} px, but {first.name} {other}; frames must have one size")
    _check_copies(found)
    # of frames of one number each, nothing tells the step
    if all(one.image.dtype.kind == "u" for one in found) and any(np.ptp(one.image) for one in found):
        step = int(np.gcd.reduce([np.gcd.reduce(np.unique(one.image)) for one in found]))
        step &= -step
        if step > 1:
            found = [replace(one, image=one.image // one.image.dtype.type(step)) for one in found]
    return found


def _check_copies(frames: Sequence[Exposure]) -> None:
    """Raise InputError for frames of equal pixels, which are not independent.

    Pixels that are all at an end of the range, as of saturated flats, are equal by nature.
    """
    ends = [min(one.image.min() for one in frames), max(one.image.max() for one in frames)]
    names: dict[str, str] = {}
    for one in frames:
        other = names.setdefault(user_files.sha256(one.image.astype(np.float32).tobytes()), one.name)
        if other != one.name and not np.isin(one.image, ends).all():
            raise InputError(f"{one.name}: has the pixels of {other}; a copy is no frame of its own, leave it out")


def _in_path(path: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Return files and rows of a folder's frames, in the order of their names, or of one. Raises InputError."""
    if not path.is_dir():
        if not path.exists():
            raise InputError(f"{path}: {why_absent(path)}; must be a folder of frames, or one frame")
        return [(path, {})]
    table = _read_table(path / TABLE) if (path / TABLE).is_file() else {}
    files = sorted(one for one in path.iterdir() if one.suffix.lower() in FRAME_TYPES)
    spare = sorted(set(table) - {key for file in files for key in (file.name, file.stem)})
    if spare:
        raise InputError(f"{path / TABLE}: name = {shown(spare[0])}: the folder has no such frame")
    return [(file, table.get(file.name) or table.get(file.stem) or {}) for file in files]


def _read_table(path: Path) -> dict[str, dict[str, Any]]:
    """Return the rows of a table of frames by name. Raises InputError that names row, column and value."""
    text = user_files.read_input(path, "trajectory").decode("utf-8-sig", "replace")
    rows = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    names = rows.fieldnames or ()
    for name in names:
        if name not in _COLUMNS:
            raise InputError(
                f"{path}: column {shown(name)}: must be one of {', '.join(_COLUMNS)}{suggestion(name, _COLUMNS)}"
            )
    if "name" not in names:
        raise InputError(f"{path}: has no column name, which holds the files' names")
    out: dict[str, dict[str, Any]] = {}
    for number, row in enumerate(rows, 1):
        values = {key: value.strip() for key, value in row.items() if key in _COLUMNS and (value or "").strip()}
        where = f"{path}: row {number}"
        kind = values.get("kind")
        if kind is not None and kind not in get_args(Kind):
            raise InputError(f"{where}: kind = {shown(kind)}: must be one of {', '.join(get_args(Kind))}")
        numbers = {
            key: _number(values[key], *limits, f"{where}: {key}")
            for key, limits in _LIMITS.items()
            if key in values
        }
        if "name" not in values or values["name"] in out:
            raise InputError(f"{where}: name = {shown(values.get('name', ''))}: must be a file's, once")
        name = values.pop("name")
        out[name] = values | numbers
    return out


def _number(text: str, low: float, high: float, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise InputError(f"{where} = {shown(text)}: must be a number from {low:g} to {high:g}")
    return value


def _read(path: Path, row: Mapping[str, Any]) -> Exposure:
    """Return the frame of a file and of its row. Raises InputError."""
    image, header = read_frame(path)
    if min(image.shape) < _LEAST_PX:
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(f"{path}: is {size} px; must be at least {_LEAST_PX} px each way")
    for key, value in header.items():
        card, zero = _CARDS[key]
        low, high = _LIMITS[key]
        if key not in row and not low <= value <= high:
            raise InputError(
                f"{path}: {card} = {value - zero:g}: must be from {low - zero:g} to {high - zero:g}; "
                f"correct it, or say {key} in {TABLE}"
            )
    known = {key: row.get(key, header.get(key)) for key in _LIMITS}
    return Exposure(name=str(path), kind=row["kind"], image=image, **known)


# --- estimates and moments ----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Hold a fitted value, its interval of 95 % and how it was fitted, with the frames."""

    value: float
    low: float
    high: float
    method: str

    @classmethod
    def normal(cls, value: float, error: float, method: str, least: float = 0.0) -> Estimate:
        """Return an estimate with a normal error, whose value and interval begin at `least`."""
        low, high = value - TWO_SIDED * error, value + TWO_SIDED * error
        return cls(value=max(value, least), low=max(low, least), high=max(high, least), method=method)

    def root(self) -> Estimate:
        """Return the estimate of the square root."""
        return self.changed(lambda end: math.sqrt(max(end, 0.0)))

    def over(self, divisor: float, relative_error: float) -> Estimate:
        """Return the estimate divided by a quantity that has an error of its own."""
        value = self.value / divisor
        more = TWO_SIDED * relative_error * value
        below, above = (math.hypot((end - self.value) / divisor, more) for end in (self.low, self.high))
        return replace(self, value=value, low=max(value - below, 0.0), high=value + above)

    def changed(self, change: Callable[[float], float]) -> Estimate:
        """Return the estimate whose value and ends go through a rising function."""
        return replace(self, value=change(self.value), low=change(self.low), high=change(self.high))

    def scaled(self, factor: float, less: float = 0.0) -> Estimate:
        """Return a factor times the estimate, less a number, and at least 0."""
        return self.changed(lambda end: max(factor * end - less, 0.0))

    @property
    def error(self) -> float:
        """Return the standard error that the interval stands for."""
        return (self.high - self.low) / (2 * TWO_SIDED)

    @property
    def text(self) -> str:
        """Return the interval and the method, as the sensor file says them."""
        return f"fitted, 95 % interval {self.low:.4g} to {self.high:.4g}: {self.method}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Transfer:
    """Hold the photon transfer, float64[n]: levels, variances in time, their errors, and what the fit expects."""

    level_dn: F64
    variance_dn2: F64
    error_dn2: F64
    fitted_dn2: F64


def variance_estimate(total: float, degrees: float, less: float, method: str) -> Estimate:
    """Return a variance that is what `less` leaves of a sample variance with so many degrees of freedom."""
    low, high = (degrees * total / stats.chi2.ppf(p, degrees) for p in (0.975, 0.025))
    return Estimate(
        value=max(total - less, 0.0), low=max(low - less, 0.0), high=max(high - less, 0.0), method=method
    )


def covariance_estimate(pair: Sequence[NDArray[Any]], method: str = "") -> Estimate:
    """Return the covariance of two samples of mean 0, at least 0.

    The interval holds every covariance from which that of the samples is at most 1.96 of *its* standard errors away
    (a score interval): √(((A + c)(B + c) + c²) / n), with the variances A and B of what the samples do not share.
    """
    a, b = (one.astype(np.float64) for one in pair)
    shared, count = float((a * b).mean()), len(a)
    own = [max(float((one**2).mean()) - shared, 0.0) for one in (a, b)]
    z2 = TWO_SIDED**2
    square, linear = count - 2 * z2, 2 * count * shared + z2 * sum(own)
    root = math.sqrt(max(linear**2 - 4 * square * (count * shared**2 - z2 * math.prod(own)), 0.0))
    low, high = (max((linear + sign * root) / (2 * square), 0.0) for sign in (-1, 1))
    return Estimate(value=max(shared, 0.0), low=low, high=high, method=method)


def count_estimate(count: int, of: float, method: str) -> Estimate:
    """Return a fraction of pixels that were counted, with the interval of a Poisson count (Garwood 1936)."""
    low = stats.chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    high = stats.chi2.ppf(0.975, 2 * count + 2) / 2
    return Estimate(value=count / of, low=float(low) / of, high=float(high) / of, method=method)


def rounded_moments(offset_dn: float, spread_dn: float, noise_dn: float) -> tuple[float, float, float]:
    """Return mean, variance in time and variance from pixel to pixel, in DN, of numbers that are rounded and >= 0.

    Levels of pixels are normal about `offset_dn`, with `spread_dn`; each has normal noise of `noise_dn`.
    """
    levels = offset_dn + spread_dn * ndtri((np.arange(201) + 0.5) / 201)
    codes = np.arange(max(math.floor(levels[0] - 6 * noise_dn), 0), math.ceil(levels[-1] + 6 * noise_dn) + 2)
    below = ndtr((codes + 0.5 - levels[:, None]) / noise_dn)
    chance = np.diff(below, prepend=0.0)
    mean = chance @ codes
    in_time = chance @ codes.astype(np.float64) ** 2 - mean**2
    return float(mean.mean()), float(in_time.mean()), float(mean.var())


def noise_before_rounding(mean_dn: float, in_time: float, of_pixels: float) -> tuple[float, float, float]:
    """Return bias, noise variance and pattern variance in DN and DN² that rounding made into those observed.

    Above 0.6 DN of noise, and far from the code 0, rounding adds 1/12 DN² in time and nothing else (Sheppard).
    """
    noise = math.sqrt(max(in_time - ROUNDING_DN2, LEAST_VARIANCE_DN2))
    if noise > _DITHERED_DN and mean_dn > OUTLIER * math.hypot(noise, math.sqrt(max(of_pixels, 0.0))):
        return mean_dn, in_time - ROUNDING_DN2, of_pixels
    spread, offset = math.sqrt(max(of_pixels, 1e-6)), mean_dn
    for _ in range(40):
        mean, time, pixels = rounded_moments(offset, spread, noise)
        offset += mean_dn - mean
        noise = max(noise * math.sqrt(max(in_time, 1e-9) / max(time, 1e-9)), 0.02)
        spread = max(spread * math.sqrt(max(of_pixels, 1e-9) / max(pixels, 1e-9)), 1e-3)
    return offset, noise**2, spread**2


def smoothed_line(values: F64) -> F64:
    """Return values along a line less their running mean over at most 31, without the ends, to unit white noise."""
    width = min(_LINE, len(values) // 4 * 2 + 1)
    half = width // 2
    return (values - ndimage.uniform_filter1d(values, width))[half:-half] / math.sqrt(1 - 1 / width)


def smoothed_pixels(image: F32) -> F32:
    """Return an image less its running mean over 11 px squared, to unit white noise, and 0 near the edges."""
    out = (image - cv2.blur(image, (_PIXELS, _PIXELS))) / np.float32(math.sqrt(1 - 1 / _PIXELS**2))
    edge = _PIXELS // 2
    out[:edge] = out[-edge:] = 0
    out[:, :edge] = out[:, -edge:] = 0
    return np.asarray(out, dtype=np.float32)


def planes_of(image: NDArray[Any], tile: tuple[int, int]) -> list[F32]:
    """Return the image of each place in the tile of a mosaic, float32[y, x] of one size."""
    height, width = (size // step for size, step in zip(image.shape, tile, strict=True))
    return [
        np.ascontiguousarray(image[y :: tile[0], x :: tile[1]][:height, :width], dtype=np.float32)
        for y in range(tile[0])
        for x in range(tile[1])
    ]


def inside(mask: Mask) -> Mask:
    """Return a mask without the edges that `smoothed_pixels` leaves out."""
    edge = _PIXELS // 2
    out = np.zeros_like(mask)
    out[edge:-edge, edge:-edge] = mask[edge:-edge, edge:-edge]
    return out


def ordinary_pixels(image: F32, least: float = 0.3) -> Mask:
    """Return the pixels within 6 deviations, at least `least` each, of the median around them, bool[y, x]."""
    off = np.abs(image - cv2.medianBlur(np.ascontiguousarray(image, dtype=np.float32), 5))
    scale = max(1.4826 * float(np.median(off)), float(np.percentile(off, 68.27)), least)
    return np.asarray(off <= OUTLIER * scale)


@dataclass(frozen=True, kw_only=True, eq=False)
class Group:
    """Hold the moments in DN of dark frames of one exposure.

    Means float64[frame]; variances in DN² in time, of rows in time, and of the fixed patterns with their degrees of
    freedom; a map float32[y, x] of the mean, and of two halves of the frames for covariances.
    """

    exposure_s: float
    means_dn: F64
    in_time: float
    row_noise: Estimate | None
    patterns: dict[str, Estimate]
    map_dn: F32
    halves_dn: tuple[F32, F32] | None
    quiet: Mask

    @property
    def fixed_dn2(self) -> float:
        """Return the variance of all fixed patterns."""
        return sum(one.value for one in self.patterns.values())


def group_of(frames: Sequence[Exposure], good: Mask) -> Group:
    """Return the moments of frames of one exposure; `good` bool[y, x] are pixels without defects."""
    stack = np.array([one.image for one in frames], dtype=np.float32)
    count, exposure_s = len(stack), frames[0].exposure_s or 0.0
    # without hits of particles
    means = np.array([frame[good & ordinary_pixels(frame)].mean(dtype=np.float64) for frame in stack])
    stack -= means[:, None, None].astype(np.float32)
    mean = stack.mean(axis=0)
    if count < 2:
        return Group(
            exposure_s=exposure_s,
            means_dn=means,
            in_time=math.nan,
            row_noise=None,
            patterns={},
            map_dn=mean,
            halves_dn=None,
            quiet=good,
        )
    rest = stack - mean
    unbiased = math.sqrt(count / (count - 1))
    limit = max(OUTLIER * float(np.percentile(np.abs(rest[:, good]), 68.27)) * unbiased, 1.5) / unbiased
    quiet = good & (np.abs(rest).max(axis=0) <= limit)
    in_time = float((rest[:, quiet].astype(np.float64) ** 2).sum() / ((count - 1) * quiet.sum()))
    of_lines = [np.maximum(quiet.sum(axis=axis), 1) for axis in (0, 1)]
    of_rows = (rest * quiet).sum(axis=2, dtype=np.float64) / of_lines[1]
    degrees = (count - 1) * quiet.shape[0]
    row_noise = variance_estimate(
        float((of_rows**2).sum() / degrees), degrees, in_time / quiet.shape[1], f"means of rows, {count} darks"
    )
    halves = stack[::2].mean(axis=0), stack[1::2].mean(axis=0)
    patterns = _patterns(halves, quiet, of_lines, f"covariance of {count} darks")
    return Group(
        exposure_s=exposure_s,
        means_dn=means,
        in_time=in_time,
        row_noise=row_noise,
        patterns=patterns,
        map_dn=np.where(quiet | ~good, mean, stack.min(axis=0)),
        halves_dn=halves,
        quiet=quiet,
    )


def _patterns(halves: Sequence[F32], quiet: Mask, of_lines: list[Any], method: str) -> dict[str, Estimate]:
    """Return the variances in DN² of pixels, columns and rows that two images have in common."""
    lines = [[(one * quiet).sum(axis=axis, dtype=np.float64) / of_lines[axis] for one in halves] for axis in (0, 1)]
    flat = [one - columns - rows[:, None] for one, columns, rows in zip(halves, *lines, strict=True)]
    counted = inside(quiet)
    rough = [smoothed_pixels(np.where(quiet, one, 0).astype(np.float32))[counted] for one in flat]
    # means of lines were taken away, so that there are fewer degrees of freedom than pixels
    pixels = covariance_estimate(rough, method).scaled(1 / math.prod(1 - 1 / length for length in quiet.shape))
    out = {"pixel": pixels}
    for name, both, length in (("column", lines[0], quiet.shape[0]), ("row", lines[1], quiet.shape[1])):
        out[name] = covariance_estimate([smoothed_line(one) for one in both], method).scaled(
            1.0, pixels.value / length
        )
    return out
