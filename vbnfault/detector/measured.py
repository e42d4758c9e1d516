"""Make one device of a sensor type from what was measured of it: dark frames, a flat and a list of bad pixels.

What a frame shows replaces what would be drawn: the dark frame dark currents and hot pixels, the bias frame offsets
with the patterns of rows and columns, the flat responses and dead pixels. All else is drawn as of any device, also
more defects with age and dose. The pixels of a list are added.

Frames hold raw numbers of the whole sensor. A camera with fewer pixels uses a window of it; binned pixels add their
electrons. Means of many frames serve best: noise of a single frame becomes part of the device.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core.errors import InputError, in_file, shown, suggestion
from ..core.files import file_contents, user_files
from ..core.files.path_checks import absolute
from ..core.files.raw_frames import FRAME_TYPES, read_frame
from ..core.quantities import DEAD, HOT, RTS, STUCK
from ..core.tables import is_number, table_class
from .dark import arrhenius_factor
from .individual import (
    DeadPixels,
    Defects,
    HotPixelTable,
    Individual,
    StuckPixels,
    hot_rates_e_s,
    rts_pixels,
    stream,
)
from .readout import node_of

if TYPE_CHECKING:
    from .sensor import Sensor

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
D = TypeVar("D", bound=Defects)
Kind = Literal["dead", "hot", "stuck", "rts"]
_BITS = {"dead": DEAD, "hot": HOT, "stuck": STUCK, "rts": RTS}
_FRAMES = ("dark", "bias", "flat")
_FILES = (*_FRAMES, "bad_pixels")

_AROUND_PX = 5  # width of the square whose median stands for the neighbours of a pixel
_OUTLIER = 6.0  # robust standard deviations above its neighbours from which a dark current is a hot pixel's
_DEAD_BELOW = 0.5  # response over that of the neighbours of its colour, as `vbnfault fit` counts dead pixels
_LEAST_FLAT_DN = 10.0
_SATURATED = 0.95


@table_class()
class DefectFiles:
    """Name the files that were measured of one device, by paths from the sensor file's folder.

    Frames are PNG, TIFF or FITS files of raw numbers, of the sensor's width and height.
    """

    dark: str = Field(default="", description="dark frame, the mean of several: dark currents and hot pixels")
    dark_exposure_s: float | None = Field(
        default=None, gt=0, le=1e6, description="its exposure; default: EXPTIME of a FITS file"
    )
    dark_temperature_K: float | None = Field(
        default=None,
        ge=100,
        le=400,
        description="its temperature; default: CCD-TEMP of a FITS file, or else the sensor's",
    )
    bias: str = Field(
        default="", description="dark frame of the shortest exposure: offsets of pixels, rows and columns"
    )
    flat: str = Field(default="", description="frame of even light below saturation: responses and dead pixels")
    flat_exposure_s: float = Field(
        default=0.0, ge=0, le=1e6, description="its exposure, for the dark signal in it; 0: none to speak of"
    )
    flat_surface: Literal["removed", "kept"] = Field(
        default="removed",
        description="whether the polynomial of fourth degree in x and y that fits the flat is of lamp and lens",
    )
    bad_pixels: str = Field(
        default="",
        description="table (.csv) with the columns x, y from 0 at the top left and, if any, kind; or a mask, PNG, "
        "TIFF or FITS, that is not 0 in bad pixels",
    )
    bad_kind: Kind = Field(default="dead", description="kind of bad pixels of which the file does not say it")
    gain_dn_per_e: float | None = Field(
        default=None, gt=0, le=1e6, description="gain at which the frames were taken; default: the sensor's"
    )
    origin_px: tuple[int, int] | None = Field(
        default=None,
        description="column and row of the sensor at which the window of a camera with fewer pixels begins, "
        "multiples of the mosaic's tile; default: in the middle",
    )

    def __post_init__(self) -> None:
        """Raise ValueError where there is no file, or a key of one that is not named."""
        if not any(getattr(self, name) for name in _FILES):
            raise ValueError(f"defects: names no file; must name one of {', '.join(_FILES)}")
        for key, of in (("dark_exposure_s", "dark"), ("dark_temperature_K", "dark"), ("flat_exposure_s", "flat")):
            if getattr(self, key) and not getattr(self, of):
                raise ValueError(f"{key} = {getattr(self, key):g}: needs {of}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """Hold what the files of one device show of each pixel; None where no file shows it.

    Attributes
    ----------
    gain
        Response over the mean response, float32[y, x].
    offset_e
        Offset in electrons, float32[y, x].
    dark_e_s, damage_e_s
        Dark currents of undamaged silicon and of damage at the reference temperature, float32[y, x].
    level
        Number in the dark over the top code, float32[y, x].
    kinds
        Bits of `quantities.DEFECTS`, uint8[y, x].
    origin_px
        Column and row at which a window begins; None: it lies in the middle.
    description
        Keys of the files' table, with names and digests in place of paths, and what was assumed.
    """

    gain: F32 | None
    offset_e: F32 | None
    dark_e_s: F32 | None
    damage_e_s: F32 | None
    level: F32 | None
    kinds: U8
    origin_px: tuple[int, int] | None
    description: Mapping[str, Any]

    def __eq__(self, other: object) -> bool:
        """Return whether another one is made of the same files in the same way."""
        return isinstance(other, Measured) and self.description == other.description

    def __hash__(self) -> int:
        return hash(repr(self.description))

    @property
    def digests(self) -> list[str]:
        """Return the SHA-256 of each file."""
        return [self.description[name]["sha256"] for name in _FILES if name in self.description]

    def changed(self, change: Callable[[str, Any], Any], **others: Any) -> Measured:
        """Return it with each map put through a function of its name and array."""
        maps = {name: array for name, array in vars(self).items() if isinstance(array, np.ndarray)}
        return replace(self, **{name: change(name, array) for name, array in maps.items()}, **others)

    def binned(self, n: int, tile: tuple[int, ...]) -> Measured:
        """Return what pixels show of which n × n neighbours of one colour are added."""

        def blocks(name: str, array: Any) -> Any:
            rows, columns = (size // (n * t) for size, t in zip(array.shape, tile, strict=True))
            used = array[: rows * n * tile[0], : columns * n * tile[1]]
            split = used.reshape(rows, n, tile[0], columns, n, tile[1])
            if name == "kinds":
                added = np.bitwise_or.reduce(np.bitwise_or.reduce(split, axis=4), axis=1)
            else:
                added = split.mean(axis=(1, 4)) * np.float32(1 if name in ("gain", "level") else n**2)
            return added.reshape(rows * tile[0], columns * tile[1])

        at = self.origin_px and tuple(k // (n * t) * t for k, t in zip(self.origin_px, tile[::-1], strict=True))
        return self.changed(blocks, origin_px=at, description={**self.description, "binning": n})

    def corner(self, shape: tuple[int, int], sensor: Sensor) -> tuple[int, int]:
        """Return the column and row at which a window begins.

        Raises InputError where it is not on the sensor, or other output nodes would read its pixels.
        """
        tile, nodes = np.shape(sensor.pattern.tile), sensor.readout.nodes
        height, width = self.kinds.shape
        x, y = self.origin_px or (
            (width - shape[1]) // 2 // tile[1] * tile[1],
            (height - shape[0]) // 2 // tile[0] * tile[0],
        )
        if y + shape[0] > height or x + shape[1] > width:
            raise InputError(
                f"defects.origin_px = {[x, y]}: a window of {shape[1]}x{shape[0]} px from there reaches beyond the "
                f"{width}x{height} px that were measured"
            )
        part = slice(y, y + shape[0]), slice(x, x + shape[1])
        if (node_of((height, width), nodes)[part] != node_of(shape, nodes)).any():
            raise InputError(
                f"defects.origin_px = {[x, y]}: readout.nodes = {nodes} halve a window of {shape[1]}x{shape[0]} px "
                f"from there at other pixels than the sensor of {width}x{height} px; it must lie in the middle "
                f"and be less wide by a multiple of {2 * tile[1]} px and less high by one of {2 * tile[0]} px"
            )
        return x, y

    def window(self, shape: tuple[int, int], sensor: Sensor) -> Measured:
        """Return what the pixels of a window show. Raises InputError as `corner` does."""
        x, y = self.corner(shape, sensor)
        part = slice(y, y + shape[0]), slice(x, x + shape[1])
        return self.changed(lambda _, array: np.ascontiguousarray(array[part]))


def with_measured(sensor: Sensor, source: str) -> Sensor:
    """Return a sensor with what its files `defects`, named from the folder of `source`, show.

    Raises InputError that names source, key and value.
    """
    files = sensor.defects
    if files is None:
        return sensor
    with in_file(source):
        paths: dict[str, Any] = {
            name: absolute(Path(source).parent / getattr(files, name), f"defects.{name}")
            for name in _FILES
            if getattr(files, name)
        }
        return replace(sensor, measured=_measured(replace(sensor, defects=replace(files, **paths))))


# --- from files to maps -----------------------------------------------------------------------------------------


@file_contents.cached_with_contents(maxsize=4)
def _measured(sensor: Sensor) -> Measured:
    """Return what the files of a sensor show. Raises InputError."""
    files = sensor.defects
    assert files is not None
    readout, spec, shape = sensor.readout, sensor.individual, (sensor.height_px, sensor.width_px)
    frames, header = {}, {}
    for name in _FRAMES:
        if path := getattr(files, name):
            frames[name], header[name] = _frame(path, name, sensor)
    files = _completed(files, header.get("dark", {}), sensor)
    node = node_of(shape, readout.nodes)
    gains = np.array(readout.node_gains or (1.0,) * readout.nodes, dtype=np.float32) * np.float32(
        files.gain_dn_per_e
    )
    black = np.array(readout.node_offsets_dn or (0.0,) * readout.nodes, dtype=np.float32) + readout.bias_dn
    signal = {name: (frame - black[node]) / gains[node] for name, frame in frames.items()}
    maps: dict[str, Any] = dict.fromkeys(("gain", "offset_e", "dark_e_s", "damage_e_s", "level"))
    kinds = np.zeros(shape, dtype=np.uint8)
    offset: Any = signal.get("bias")
    rate: Any = np.float32(0)
    if "dark" in signal:
        rate, usual, offset = _dark(signal["dark"], offset, files, 0.5 / float(gains.max()))
        kelvin: Any = files.dark_temperature_K
        maps["dark_e_s"] = usual / np.float32(spec.dark_factor(kelvin))
        maps["damage_e_s"] = (rate - usual) / np.float32(arrhenius_factor(kelvin, spec.reference_K))
        kinds[rate > usual] |= HOT
    maps["offset_e"] = offset
    for name in ("bias", "dark"):  # of the dark frame, where there are both
        if name in frames:
            maps["level"] = frames[name] / np.float32(readout.top_dn)
    if "flat" in signal:
        dark_e = (0 if offset is None else offset) + rate * np.float32(files.flat_exposure_s)
        maps["gain"], dead = _responses(signal["flat"] - dark_e, files, sensor)
        kinds[dead] |= DEAD
    if files.bad_pixels:
        kinds |= _listed(files.bad_pixels, files.bad_kind, shape)
    return Measured(**maps, kinds=kinds, origin_px=files.origin_px, description=_description(files))


def _completed(files: DefectFiles, header: Mapping[str, float], sensor: Sensor) -> DefectFiles:
    """Return the table with the gain and the dark frame's exposure and temperature. Raises InputError."""
    changes: dict[str, Any] = {"gain_dn_per_e": files.gain_dn_per_e or sensor.readout.system_gain_dn_per_e}
    if files.dark:
        changes["dark_exposure_s"] = files.dark_exposure_s or header.get("exposure_s", 0.0)
        changes["dark_temperature_K"] = (
            files.dark_temperature_K or header.get("temperature_K") or sensor.temperature_K
        )
        if not changes["dark_exposure_s"] > 0:
            raise InputError(
                "defects.dark_exposure_s: is missing, and the dark frame is no FITS file with EXPTIME above 0; "
                "must be above 0 s (a frame without exposure is bias)"
            )
    tile = np.shape(sensor.pattern.tile)[::-1]
    if files.origin_px and any(k < 0 or k % t for k, t in zip(files.origin_px, tile, strict=True)):
        raise InputError(
            f"defects.origin_px = {list(files.origin_px)}: must be multiples of {tile[0]} and {tile[1]}, from 0"
        )
    return replace(files, **changes)


def _description(files: DefectFiles) -> dict[str, Any]:
    """Return the keys of the table, with each file's name and digest in place of its path."""
    plain = {key: value for key, value in dataclasses.asdict(files).items() if value not in ("", None)}
    for name in [name for name in _FILES if name in plain]:
        digest = user_files.sha256_of_input(plain[name], "data")
        plain[name] = {"file": Path(plain[name]).name, "sha256": digest}
    return plain


def _frame(path: str, name: str, sensor: Sensor) -> tuple[F32, dict[str, float]]:
    """Return a frame in DN and what its header says. Raises InputError for a wrong size and numbers too high."""
    where = f"defects.{name} = {shown(path)}"
    try:
        image, header = read_frame(Path(path))
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(f'{path}: ')}") from None
    _check_size(image, where, (sensor.height_px, sensor.width_px))
    top_dn = sensor.readout.top_dn
    if image.dtype.kind == "u" and image.max() > top_dn:
        # such as 12 bits at the top of 16: a common factor of a few numbers is more than their step
        factor = int(np.gcd.reduce(np.unique(image)))
        image = image // min(factor & -factor, 2**16 // (top_dn + 1))
    if not 0 <= image.min() <= image.max() <= top_dn:
        raise InputError(
            f"{where}: holds numbers from {image.min():g} to {image.max():g}; must be from 0 to {top_dn}, the top "
            f"code of readout.bits = {sensor.readout.bits}"
        )
    return image.astype(np.float32), header


def _check_size(image: NDArray[Any], where: str, shape: tuple[int, int]) -> None:
    if image.shape != shape:
        raise InputError(
            f"{where}: is {image.shape[1]}x{image.shape[0]} px; must be {shape[1]}x{shape[0]}, the sensor's "
            "width_px and height_px"
        )


def _dark(signal_e: F32, offset_e: F32 | None, files: DefectFiles, least_e: float) -> tuple[F32, F32, F32]:
    """Return dark currents at the frame's temperature, those without the excess of hot pixels, and offsets.

    A pixel is hot if it is far above its neighbours, as a glow is not. Without a bias frame, all that a pixel shows
    above black is dark current, and what it lacks is its offset. With one, noise makes differences below 0, which
    are no currents; the others are scaled to the mean of all. `least_e` is the least standard deviation, that of
    rounding.
    """
    assert files.dark_exposure_s is not None
    rate = (signal_e if offset_e is None else signal_e - offset_e) / np.float32(files.dark_exposure_s)
    around = cv2.medianBlur(rate, _AROUND_PX)
    spread = max(1.4826 * float(np.median(np.abs(rate - around))), least_e / files.dark_exposure_s)
    hot = rate - around > _OUTLIER * spread
    usual = np.where(hot, around, rate)
    above = np.maximum(usual, 0)
    if offset_e is None:
        offset_e = np.minimum(signal_e, 0)
    elif above.any():
        above *= max(usual.mean(dtype=np.float64) / above.mean(dtype=np.float64), 0)
    return np.where(hot, rate, above), above, offset_e


def _responses(signal_e: F32, files: DefectFiles, sensor: Sensor) -> tuple[F32, NDArray[np.bool_]]:
    """Return the response of each pixel over the mean of its colour, at least 0, and which pixels are dead.

    Raises InputError for a flat that is dark or saturated.
    """
    readout, gain = sensor.readout, files.gain_dn_per_e or 1.0
    least, full = _LEAST_FLAT_DN / gain, min((readout.top_dn - readout.bias_dn) / gain, readout.full_well_e)
    middle = float(np.median(signal_e))
    if not least <= middle <= _SATURATED * full:
        raise InputError(
            f"defects.flat = {shown(files.flat)}: has a median of {middle:.4g} e above black; must be from "
            f"{least:.4g} to {_SATURATED * full:.4g}, below saturation"
        )
    out, dead = np.empty_like(signal_e), np.empty(signal_e.shape, dtype=np.bool_)
    rows, columns = np.shape(sensor.pattern.tile)
    for y in range(rows):
        for x in range(columns):
            plane: Any = np.ascontiguousarray(signal_e[y::rows, x::columns])
            around = cv2.medianBlur(plane, _AROUND_PX)
            usual = np.abs(plane - around) < _DEAD_BELOW * around
            dead[y::rows, x::columns] = plane <= _DEAD_BELOW * around
            if files.flat_surface == "removed":
                plane = plane / np.maximum(smooth_surface(np.where(usual, plane, around)), 1e-6)
            out[y::rows, x::columns] = np.maximum(plane / plane[usual].mean(dtype=np.float64), 0)
    return out, dead


def smooth_surface(image: F32) -> F32:
    """Return the polynomial of fourth degree in x and y that fits an image best, float32[y, x]."""
    y, x = (np.linspace(-1, 1, size) for size in image.shape)
    step = max(min(image.shape) // 64, 1)
    powers = [(i, j) for i in range(5) for j in range(5 - i)]

    def terms(y: NDArray[Any], x: NDArray[Any]) -> NDArray[np.float64]:
        return np.array([np.outer(y**i, x**j) for i, j in powers])

    design = terms(y[::step], x[::step]).reshape(len(powers), -1).T
    best, *_ = np.linalg.lstsq(design, image[::step, ::step].ravel(), rcond=None)
    return np.asarray(np.tensordot(best, terms(y, x), 1), dtype=np.float32)


def _listed(path: str, kind: str, shape: tuple[int, int]) -> U8:
    """Return the kinds of the bad pixels of a table or a mask, uint8[y, x] of bits. Raises InputError."""
    where = f"defects.bad_pixels = {shown(path)}"
    out = np.zeros(shape, dtype=np.uint8)
    try:
        if Path(path).suffix.lower() in FRAME_TYPES:
            mask, _ = read_frame(Path(path))
            _check_size(mask, where, shape)
            out[mask != 0] = _BITS[kind]
        else:
            for x, y, own in _rows(path, shape):
                out[y, x] |= _BITS[own or kind]
    except InputError as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(text if text.startswith(where) else f"{where}: {text}") from None
    if not out.any():
        raise InputError(f"{where}: lists no pixel; must list one or more")
    return out


def _rows(path: str, shape: tuple[int, int]) -> list[tuple[int, int, str]]:
    """Return x, y and kind ("": none is given) of each row of a table of bad pixels. Raises InputError."""
    text = user_files.read_input(path, "data", types=(".csv", ".txt", *FRAME_TYPES)).decode("utf-8-sig", "replace")
    table = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    names, known = table.fieldnames or (), ("x", "y", "kind")
    if not {"x", "y"} <= set(names) or set(names) - set(known):
        raise InputError(f"has the columns {shown(list(names))}; must be x, y and, if any, kind")
    out = []
    for number, row in enumerate(table, 1):
        if None in row:
            raise InputError(f"row {number}: has more values than the columns {', '.join(names)}")
        at = [_pixel(row, number, key, size) for key, size in (("x", shape[1]), ("y", shape[0]))]
        kind = (row.get("kind") or "").strip()
        if kind not in ("", *_BITS):
            raise InputError(
                f"row {number}: kind = {shown(kind)}: must be one of {', '.join(_BITS)}{suggestion(kind, _BITS)}"
            )
        out.append((at[0], at[1], kind))
    return out


def _pixel(row: Mapping[str, Any], number: int, key: str, size: int) -> int:
    """Return the column or row of a pixel. Raises InputError unless it is whole and on the sensor."""
    text = (row[key] or "").strip()
    value = float(text) if is_number(text) else -1.0
    if not (0 <= value < size and value == int(value)):
        raise InputError(f"row {number}: {key} = {shown(text)}: must be a whole number from 0 to {size - 1}")
    return int(value)


# --- the device -------------------------------------------------------------------------------------------------


def as_measured(drawn: Individual, sensor: Sensor) -> Individual:
    """Return a drawn device with what was measured in place of what was drawn, and with the listed bad pixels."""
    if sensor.measured is None:
        return drawn
    maps = sensor.measured.window(drawn.shape, sensor)
    at: dict[str, dict[str, Any]] = {}
    for kind, bit in _BITS.items():
        row, column = (k.astype(np.int32) for k in np.nonzero(maps.kinds & bit))
        at[kind] = {"row": row, "column": column}
    changes = _light(drawn, maps, at["dead"]) | _currents(drawn, maps, at["hot"])
    drawn_levels = stream(drawn.seed, "listed stuck").random(len(at["stuck"]["row"]))
    level = _of(maps.level, at["stuck"]) if maps.level is not None else drawn_levels
    changes["stuck"] = _joined(drawn.stuck, StuckPixels(**at["stuck"], level=level))
    changes["rts"] = _joined(
        drawn.rts, rts_pixels(drawn.spec, drawn.pixel_pitch_um, drawn.seed, "listed rts", **at["rts"])
    )
    return replace(drawn, **changes)


def _light(drawn: Individual, maps: Measured, at: Mapping[str, Any]) -> dict[str, Any]:
    """Return responses and dead pixels, which respond as the flat shows them, or else to nothing."""
    if maps.gain is None:
        return {"dead": _joined(drawn.dead, DeadPixels(**at, response=np.zeros(len(at["row"]))))}
    gain = maps.gain.copy()
    gain[at["row"], at["column"]] = 1
    response = np.minimum(_of(maps.gain, at), np.nextafter(1.0, 0.0))
    return {"gain": gain, "dead": DeadPixels(**at, response=response)}


def _currents(drawn: Individual, maps: Measured, at: Mapping[str, Any]) -> dict[str, Any]:
    """Return offsets, dark currents and hot pixels; listed ones without a dark frame have drawn rates."""
    changes: dict[str, Any] = {}
    hot, none = drawn.hot, np.zeros(len(at["row"]))
    if maps.offset_e is not None:
        changes["dsnu_e"] = maps.offset_e
        hot = replace(hot, offset_e=np.zeros(len(hot)))
    if maps.damage_e_s is not None:
        changes |= {"dark_e_s": maps.dark_e_s, "damage_e_s": maps.damage_e_s}
        rates = _of(maps.damage_e_s, at)
        return changes | {"hot": HotPixelTable(**at, rate_e_s=rates, offset_e=none, born_yr=none)}
    rates = hot_rates_e_s(drawn.spec, stream(drawn.seed, "listed hot").random(len(none)))
    damage = drawn.damage_e_s.copy()
    np.add.at(damage, (at["row"], at["column"]), rates.astype(np.float32))
    listed = HotPixelTable(**at, rate_e_s=rates, offset_e=none, born_yr=none)
    return changes | {"damage_e_s": damage, "hot": _joined(hot, listed)}


def _of(image: F32, at: Mapping[str, Any]) -> NDArray[np.float64]:
    return image[at["row"], at["column"]].astype(np.float64)


def _joined(first: D, second: D) -> D:
    """Return the defects of two tables of one kind."""
    columns = {name: column for name, column in vars(first).items() if isinstance(column, np.ndarray)}
    return replace(first, **{name: np.concatenate([a, getattr(second, name)]) for name, a in columns.items()})
