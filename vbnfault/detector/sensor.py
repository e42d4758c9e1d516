"""Read and check the description of a sensor from a TOML file.

The table `[sources]` of the file must name the origin of every number in the file, or say "assumed".
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast, get_args, get_origin, get_type_hints

from ..core import resources, spectra
from ..core.errors import InputError, shown
from .charge import ChargeCloud, TrapSpecies
from .dark import CCD_GROWTH
from .demosaic import Method
from .efficiency import Curve, QuantumEfficiency
from .individual import IndividualSpec
from .mosaic import Pattern
from .mosaic import pattern as pattern_of
from .readout import ReadoutSpec

ARCHITECTURES = ("full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos")
DEMOSAICS = ("bilinear", "malvar", "menon")
SHUTTERS = ("global", "rolling", "mechanical")
# Keys that every file must have, because no default would be meaningful.
_REQUIRED = ("architecture", "pixel_pitch_um", "readout.bits", "readout.full_well_e")
_KINDS = ((bool, "true or false"), (int, "a whole number"), (float, "a number"), (str, "a text"))


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """Describe how the sensor moves charge, and what happens to the charge meanwhile.

    Attributes
    ----------
    row_transfer_s
        Time in s to shift the charge by one row into the store or the register.
    row_clear_s
        Time in s to shift charge by one row while the sensor is cleared before the exposure; 0 clears all at once.
    pixel_transfer_s
        Time in s to shift the charge by one pixel in the serial register.
    row_readout_s
        Time in s from the readout of one row to the next.
    leak
        Sensitivity to light of the covered register (interline) or of the store (global shutter), over that of the
        photodiode. 0 to 1.
    shutter_transmission
        Fraction of the light that a closed shutter lets through while a full frame is read. 0 to 1.
    antiblooming
        Fraction of the excess charge that an antiblooming drain removes. 0 to 1.
    parallel_traps, serial_traps
        Traps in the columns and in the serial register.
    cloud
        Charge cloud that meets the traps; None takes the default `ChargeCloud` with the sensor's full well.
    """

    row_transfer_s: float = 0.0
    row_clear_s: float = 0.0
    pixel_transfer_s: float = 0.0
    row_readout_s: float = 0.0
    leak: float = 0.0
    shutter_transmission: float = 0.0
    antiblooming: float = 0.0
    parallel_traps: tuple[TrapSpecies, ...] = ()
    serial_traps: tuple[TrapSpecies, ...] = ()
    cloud: ChargeCloud | None = None

    def __post_init__(self) -> None:
        for key in ("row_transfer_s", "row_clear_s", "pixel_transfer_s", "row_readout_s"):
            _in_range(key, getattr(self, key), 0.0, math.inf)
        for key in ("leak", "shutter_transmission", "antiblooming"):
            _in_range(key, getattr(self, key), 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Describe a type of sensor.

    Lengths are in µm, temperatures in K and signals in electrons (e). `individual` says how devices of this type
    differ. `readout` describes the chain from charge to DN. `quantum_efficiency` gives the QE of single channels.
    Other channels use the relative colour curves named by `response` (`spectra.RESPONSES`), scaled by
    `quantum_efficiency_peak`. Raises InputError if a value is out of range or two values contradict each other.
    """

    name: str
    source: str = ""
    architecture: str = "cmos"
    shutter: str = "global"
    width_px: int = 1024
    height_px: int = 1024
    pixel_pitch_um: float = 5.5
    pattern: Pattern = field(default_factory=lambda: pattern_of("rggb"))
    response: str = "nikon_5100"
    quantum_efficiency_peak: float = 0.5
    quantum_efficiency: tuple[Curve, ...] = ()
    temperature_K: float = 293.0
    demosaic: str = "malvar"
    correct_defects: bool = False
    individual: IndividualSpec = field(default_factory=IndividualSpec)
    readout: ReadoutSpec = field(default_factory=ReadoutSpec)
    transfer: Transfer = field(default_factory=Transfer)
    sources: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        _one_of("architecture", self.architecture, ARCHITECTURES)
        _one_of("shutter", self.shutter, SHUTTERS)
        if self.shutter == "rolling" and self.architecture != "cmos":
            raise InputError("shutter = 'rolling': must be global or mechanical, as the architecture is a CCD")
        _one_of("response", self.response, (*spectra.RESPONSES, spectra.FLAT))
        _one_of("demosaic", self.demosaic, DEMOSAICS)
        for key, low, high in (
            ("width_px", 16, 16384),
            ("height_px", 16, 16384),
            ("pixel_pitch_um", 0.5, 100.0),
            ("quantum_efficiency_peak", 1e-3, 1.0),
            ("temperature_K", 100.0, 400.0),
        ):
            _in_range(key, getattr(self, key), low, high)
        for curve in self.quantum_efficiency:
            _one_of("quantum_efficiency: channel", curve.channel, self.pattern.channels)
        own = {curve.channel for curve in self.quantum_efficiency}
        for channel in set(self.pattern.channels) - own:
            _one_of("pattern: without a quantum_efficiency of its own, channel", channel, (*"RGBW", "NIR"))
        if self.pattern.channels != ("W",) and not set("RGB") <= set(self.pattern.channels):
            raise InputError(
                f"pattern: channels = {self.pattern.channels}: must be W alone, or R, G and B among them"
            )
        if self.architecture != "cmos":
            for traps, clock in (("parallel_traps", "row_readout_s"), ("serial_traps", "pixel_transfer_s")):
                if getattr(self.transfer, traps) and not getattr(self.transfer, clock) > 0:
                    raise InputError(f"transfer.{clock} = 0: must be above 0 where there are {traps}")

    @property
    def efficiency(self) -> QuantumEfficiency:
        """Return the QE (electrons per photon) behind each filter."""
        return QuantumEfficiency(
            channels=self.pattern.channels,
            response=self.response,
            peak=self.quantum_efficiency_peak,
            curves=self.quantum_efficiency,
        )

    @property
    def method(self) -> Method:
        """Return the demosaicing method. Patterns other than Bayer always use "bilinear"."""
        return cast(Method, self.demosaic) if self.pattern.is_bayer else "bilinear"


def load_sensor(name_or_path: str | Path) -> Sensor:
    """Read a sensor from a path or by the name of a packaged one.

    Raises InputError that names the file, the key, the value and the allowed range.
    """
    path = resources.find("scenes/detectors", name_or_path)
    table = resources.read_toml(path, "detector")
    for key in _REQUIRED:
        *parents, leaf = key.split(".")
        node: Any = table
        for parent in parents:
            node = node.get(parent, {})
        if isinstance(node, dict) and leaf not in node:
            raise InputError(f"{path}: {key}: is missing")
    return parse_sensor(table, source=str(path))


def parse_sensor(table: Mapping[str, Any], *, source: str) -> Sensor:
    """Build a sensor from plain data, such as a parsed TOML file.

    For a CCD without `individual.hot_growth` the growth law of CCDs (`CCD_GROWTH`) is used. Raises InputError
    that names `source`, the key and the value.
    """
    plain = dict(table)
    sources = plain.pop("sources", {})
    if not isinstance(sources, dict) or not all(isinstance(v, str) for v in sources.values()):
        raise InputError(f"{source}: sources: must be a table of texts")
    numbers = _numbers(plain)
    plain.setdefault("name", Path(source).stem)
    if isinstance(plain.get("pattern"), str):
        try:
            plain["pattern"] = pattern_of(plain["pattern"])
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
    # built before the sources are checked, so that a misspelt key is reported as such
    sensor: Sensor = _build(Sensor, plain, source)
    for key in numbers:
        if not sources.get(key, "").strip():
            raise InputError(f'{source}: sources: {key} has none; name one, or say "assumed"')
    for key in sources:
        if key not in numbers:
            raise InputError(f"{source}: sources: {key}: the file gives no such number")
    own = plain.get("individual")
    if sensor.architecture != "cmos" and not (isinstance(own, Mapping) and "hot_growth" in own):
        grows = dataclasses.replace(sensor.individual, hot_growth=CCD_GROWTH)
        sensor = dataclasses.replace(sensor, individual=grows)
    return dataclasses.replace(sensor, sources=dict(sources))


def _numbers(table: Mapping[str, Any], before: str = "") -> list[str]:
    """Return the keys of all numbers, `table.key` in tables.

    A list gives its own key, unless it holds texts only.
    """
    out = []
    for key, value in table.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            out += _numbers(value, f"{name}.")
        elif (isinstance(value, int | float) and not isinstance(value, bool)) or (
            isinstance(value, list) and not all(isinstance(v, str) for v in value)
        ):
            out.append(name)
    return out


def _build(cls: Any, table: Mapping[str, Any], where: str) -> Any:
    """Build a dataclass, and the dataclasses nested in it, from a table."""
    kinds = get_type_hints(cls)
    known = [f.name for f in dataclasses.fields(cls) if f.name != "sources"]
    found = {}
    for key, value in table.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            told = f" (did you mean {near[0]}?)" if near else f"; known: {', '.join(known)}"
            raise InputError(f"{where}: {key}: unknown key{told}")
        found[key] = _value(kinds[key], value, f"{where}: {key}")
    try:
        return cls(**found)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except TypeError as error:
        raise InputError(f"{where}: {error}") from None


def _value(kind: Any, value: Any, where: str) -> Any:
    """Convert a value to the type of its field: a number, a text, a table or a list, recursively."""
    kinds = get_args(kind)
    if get_origin(kind) is tuple:
        if isinstance(value, list):
            each = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
            if len(each) == len(value):
                return tuple(_value(k, v, f"{where} {n}") for n, (k, v) in enumerate(zip(each, value, strict=True)))
    elif kinds:  # an optional type: a file cannot give None, so only the first type counts
        return _value(kinds[0], value, where)
    elif dataclasses.is_dataclass(kind):
        if isinstance(value, dict):
            return _build(kind, value, where)
        if isinstance(value, cast(type, kind)):
            return value
    elif kind is float and type(value) in (int, float):
        # an integer can be too large for a float, too
        if abs(value) <= sys.float_info.max:
            return float(value)
        raise InputError(f"{where} = {shown(value)}: must be finite")
    elif type(value) is kind:  # not isinstance: true and false are whole numbers to Python
        return value
    other = "a table" if dataclasses.is_dataclass(kind) else "a list of the right length"
    wanted = next((word for plain, word in _KINDS if kind is plain), other)
    raise InputError(f"{where} = {shown(value)}: must be {wanted}")


def _in_range(key: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high or math.isinf(value):
        allowed = f"finite and at least {low:g}" if math.isinf(high) else f"from {low:g} to {high:g}"
        raise InputError(f"{key} = {value:g}: must be {allowed}")


def _one_of(key: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(f"{key} = {shown(value)}: must be one of {', '.join(allowed)}")
