"""Read and check the description of a sensor from a TOML file.

The table `[sources]` of the file must name the origin of every number in the file, or say "assumed".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, InstanceOf
from pydantic.json_schema import SkipJsonSchema

from ..core import spectra, tables
from ..core.errors import InputError, shown
from ..core.files import resources, toml_files
from ..core.quantities import Architecture
from ..core.tables import Fraction, table_class
from .charge import ChargeCloud, TrapSpecies
from .dark import CCD_GROWTH
from .demosaic import Method
from .effects import Effects
from .efficiency import Curve, QuantumEfficiency
from .individual import IndividualSpec
from .measured import DefectFiles, Measured, with_measured
from .mosaic import PATTERNS, Pattern
from .mosaic import pattern as pattern_of
from .readout import ReadoutSpec

# How to describe a sensor without colour filters; part of the errors of who looks for a response of that kind.
MONOCHROME = (
    'a monochrome sensor has pattern = "mono", and its efficiency is quantum_efficiency_peak or a '
    "[[quantum_efficiency]] of channel W"
)


def _named_pattern(value: Pattern | str) -> Pattern:
    """Return the colour filter array that a file names or describes. Raises ValueError for an unknown name."""
    if isinstance(value, Pattern):
        return value
    try:
        return pattern_of(value)
    except InputError as error:
        raise ValueError(f"{str(error).partition(': ')[2]}, or a table of name, channels and tile") from None


if TYPE_CHECKING:
    _PatternOrName = Pattern
else:
    _PATTERN_NAMES = {"enum": sorted({spelling for name in PATTERNS for spelling in (name, name.upper())})}
    _PatternOrName = Annotated[
        Pattern | Annotated[str, Field(json_schema_extra=_PATTERN_NAMES)], AfterValidator(_named_pattern)
    ]


@table_class()
class Transfer:
    """Describe how the sensor moves charge, and what happens to the charge meanwhile."""

    row_transfer_s: float = Field(
        default=0.0, ge=0, description="time to shift the charge by one row into the store or the register"
    )
    row_clear_s: float = Field(
        default=0.0,
        ge=0,
        description="time to shift charge by one row while the sensor is cleared before the exposure; 0 clears all "
        "rows at once",
    )
    pixel_transfer_s: float = Field(
        default=0.0, ge=0, description="time to shift the charge by one pixel in the serial register"
    )
    row_readout_s: float = Field(default=0.0, ge=0, description="time from the readout of one row to the next")
    column_reference: bool = Field(
        default=False,
        description="whether each column's dark current in the row that is read last, less the mean of these, is "
        "subtracted, as a reference of covered rows does",
    )
    leak: Fraction = Field(
        default=0.0,
        description="sensitivity to light of the covered register (interline) or of the store (global shutter), "
        "over that of the photodiode",
    )
    shutter_transmission: Fraction = Field(
        default=0.0, description="fraction of the light that a closed shutter lets through while a frame is read"
    )
    antiblooming: Fraction = Field(
        default=0.0, description="fraction of the excess charge that an antiblooming drain removes"
    )
    parallel_traps: tuple[TrapSpecies, ...] = Field(default=(), description="traps in the columns")
    serial_traps: tuple[TrapSpecies, ...] = Field(default=(), description="traps in the serial register")
    cloud: ChargeCloud | None = Field(
        default=None, description="charge cloud that meets the traps; default: one with the sensor's full well"
    )


@table_class(required=("architecture", "pixel_pitch_um", "readout"))
class Sensor:
    """Describe a type of sensor.

    Lengths are in µm, temperatures in K and signals in electrons (e). Values that contradict each other raise
    InputError.
    """

    name: str = Field(default="", description="name of the sensor; default: that of the file")
    source: str = Field(default="", description="what the file describes, and after which document")
    architecture: Architecture = Field(default="cmos", description="how the charge is moved and read")
    shutter: Literal["global", "rolling", "mechanical"] = Field(
        default="global",
        description="what ends the exposure; rolling: CMOS only, and all rows still see the scene at one time",
    )
    width_px: int = Field(default=1024, ge=16, le=16384, description="width of the whole sensor")
    height_px: int = Field(default=1024, ge=16, le=16384, description="height of the whole sensor")
    pixel_pitch_um: float = Field(default=5.5, ge=0.5, le=100, description="distance of neighbouring pixels")
    pattern: _PatternOrName = Field(
        default_factory=lambda: pattern_of("rggb"), description="colour filter array: a name, or a table"
    )
    response: str = Field(
        default="nikon_5100", description="relative colour curves of channels without a quantum_efficiency"
    )
    quantum_efficiency_peak: float = Field(
        default=0.5, ge=1e-3, le=1, description="largest efficiency of these curves, and that of the channel W"
    )
    quantum_efficiency: tuple[Curve, ...] = Field(default=(), description="efficiency of single channels")
    temperature_K: float = Field(default=293.0, ge=100, le=400, description="operating temperature")
    temperature_drift_K: float = Field(
        default=0.0,
        ge=0,
        le=20,
        description="standard deviation of the temperature from exposure to exposure; the dark current follows it",
    )
    demosaic: Method = Field(default="malvar", description="method for a Bayer pattern; others use bilinear")
    correct_defects: bool = Field(
        default=False, description="whether known defects are replaced before demosaicing"
    )
    stretch: float = Field(
        default=1.0,
        ge=0.3,
        le=1,
        description="exponent of the 8 bit levels: 255 times this power of the fraction of white; 0.5: square root",
    )
    black: Literal["dark", "bias"] = Field(
        default="dark", description="what the 8 bit image shows as 0: bias and mean dark signal, or the bias alone"
    )
    individual: IndividualSpec = Field(
        default_factory=IndividualSpec, description="how devices of this type differ"
    )
    readout: ReadoutSpec = Field(default_factory=ReadoutSpec, description="the chain from charge to DN")
    transfer: Transfer = Field(default_factory=Transfer, description="how charge is moved")
    effects: Effects = Field(default_factory=tuple, description="effects that not every sensor has, by their names")
    defects: DefectFiles | None = Field(default=None, description="files that show one device; default: none")
    measured: SkipJsonSchema[InstanceOf[Measured] | None] = Field(
        default=None, description="what these files show; no key of a sensor file"
    )
    sources: Annotated[
        Mapping[str, str], Field(description="where each number comes from, by its key, or 'assumed'")
    ] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        """Raise ValueError where values contradict each other."""
        if self.shutter == "rolling" and self.architecture != "cmos":
            raise ValueError("shutter = 'rolling': must be global or mechanical, as the architecture is a CCD")
        responses = (*spectra.RESPONSES, spectra.FLAT)
        if self.response not in responses:
            raise ValueError(
                f"response = {shown(self.response)}: must be one of {', '.join(responses)}; {MONOCHROME}"
            )
        self._check_channels()
        for effect in self.effects:
            effect.check(self)
        if self.architecture != "cmos":
            for traps, clock in (("parallel_traps", "row_readout_s"), ("serial_traps", "pixel_transfer_s")):
                if getattr(self.transfer, traps) and not getattr(self.transfer, clock) > 0:
                    raise ValueError(f"transfer.{clock} = 0: must be above 0 where there are {traps}")

    def _check_channels(self) -> None:
        """Raise ValueError unless every channel has an efficiency and the channels can make an image."""
        channels = self.pattern.channels
        own = {curve.channel for curve in self.quantum_efficiency}
        for name in sorted(own - set(channels)):
            raise ValueError(f"quantum_efficiency: channel = {name!r}: must be one of {', '.join(channels)}")
        for name in sorted(set(channels) - own - {*"RGBW", "NIR"}):
            raise ValueError(
                f"pattern.channels: {name!r} has no quantum_efficiency: must be one of R, G, B, W, NIR without it"
            )
        if channels != ("W",) and not set("RGB") <= set(channels):
            raise ValueError(f"pattern.channels = {list(channels)}: must be W alone, or R, G and B among them")

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
        return self.demosaic if self.pattern.is_bayer else "bilinear"


def load_sensor(name_or_path: str | Path) -> Sensor:
    """Read a sensor from a path or by the name of a packaged one.

    Raises InputError that names the file, the key, the value and the allowed range.
    """
    path = resources.find("scenes/detectors", name_or_path)
    return parse_sensor(toml_files.read_toml(path, "detector"), source=str(path))


def parse_sensor(table: Mapping[str, Any], *, source: str) -> Sensor:
    """Return the sensor that plain data, such as the contents of a TOML file, describe.

    For a CCD without `individual.hot_growth` the growth law of CCDs (`CCD_GROWTH`) is used. Raises InputError
    that names `source`, the key and the value.
    """
    own = {f.name for f in dataclasses.fields(IndividualSpec)}
    changed = {key: table[key] for key in ("individual", "sources") if isinstance(table.get(key), Mapping)}
    for key, prefix in (("individual", ""), ("sources", "individual.")):
        if key in changed:
            changed[key] = tables.with_new_names(changed[key], own, f"{source}: {key}", prefix)
    table = {**table, **changed}
    sensor = tables.parse(Sensor, {"name": Path(source).stem, "sources": {}, **table}, source=source)
    _check_sources(
        _numbers({key: value for key, value in table.items() if key != "sources"}), sensor.sources, source
    )
    if sensor.architecture != "cmos" and "hot_growth" not in table.get("individual", {}):
        grows = dataclasses.replace(sensor.individual, hot_growth=CCD_GROWTH)
        sensor = dataclasses.replace(sensor, individual=grows)
    return with_measured(sensor, source)


def _check_sources(numbers: list[str], sources: Mapping[str, str], source: str) -> None:
    """Raise InputError that names all numbers without a source, or all sources without a number."""
    without = [key for key in numbers if not sources.get(key, "").strip()]
    if without:
        raise InputError(
            f"{source}: sources: {', '.join(without)} {'has' if len(without) == 1 else 'have'} none; say where "
            'each number comes from, or "assumed"'
        )
    spare = [key for key in sources if key not in numbers]
    if spare:
        raise InputError(f"{source}: sources: {', '.join(spare)}: the file gives no such number")


def _numbers(table: Mapping[str, Any], before: str = "") -> list[str]:
    """Return the dotted keys of all numbers. A list gives its own key, unless it holds texts only."""
    keys = []
    for key, value in table.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            keys += _numbers(value, f"{name}.")
        elif (isinstance(value, int | float) and not isinstance(value, bool)) or (
            isinstance(value, list) and not all(isinstance(v, str) for v in value)
        ):
            keys.append(name)
    return keys
