"""Define the contract of a detector effect (`Effect`), the exposure that it sees, and the order of the chain.

An effect is a frozen class. Its class attribute `name` gives its name, and the definition of the class registers
it. `after` names the effect or the step behind which it acts. Its fields are the keys of the table `[effects.NAME]`
of a sensor file. An effect acts where the sensor has this table; one of vbnfault without keys acts in every sensor:

    class Persistence(Effect):
        \"\"\"Add a fraction of the light of a bright exposure before this one.\"\"\"

        name = "persistence"
        after = "dark_current"

        before_e: float = Field(ge=0, le=1e6, description="electrons per pixel of the exposure before")
        fraction: float = Field(0.001, ge=0, le=0.1, description="part of them that is left")

        def apply(self, signal, exposure):
            return signal + np.float32(self.fraction * self.before_e)

The chain has these effects and steps, in this order. `apply` receives `signal` in electrons, float32[y, x], up to
and including "analogue", which returns it in DN, float32[y, x]. "converter" receives that and returns whole DN,
uint16[y, x], which all later effects receive and return. An effect with `after = "full_well"` acts on the charge
that the wells hold, and what it adds is not clipped.

    response, light, crosstalk, smear, dark_current, telegraph, pixels, shot_noise, charge, blooming, deep_traps,
    parallel_cti, serial_cti, full_well, interpixel_capacitance, nonlinearity, analogue, converter, stuck_pixels,
    companding, compression, raw

"light", "pixels", "charge" and "raw" are the steps at which faults act; "offsets" belongs to "analogue".
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from ...core.registry import DeclarationError, Registry, chained, is_name
from ...core.tables import Table, did_you_mean
from ..individual import stream
from ..readout import node_of

if TYPE_CHECKING:
    from ..chain import Device, MosaicNoise
    from ..sensor import Sensor

F32 = NDArray[np.float32]

# Steps at which a fault may act on the signal:
#   light    photo-electrons after each pixel's response, before smear and dark current
#   pixels   all electrons expected in each pixel, before shot noise
#   charge   collected electrons, before blooming
#   offsets  electrons that the readout adds to each pixel
#   raw      raw DN
STEPS = ("light", "pixels", "charge", "offsets", "raw")
# The changes that faults make to the array of a step, by the names of `STEPS`.
Acts = Mapping[str, Sequence[Callable[[Any], Any]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """Describe one exposure of a device, as an effect sees it.

    Attributes
    ----------
    device
        The device, with its sensor and the maps of its pixels.
    exposure_s
        Exposure time in s.
    noise
        Variates of the exposure; None: the expected signal without noise.
    acts
        Changes that faults make at each step.
    """

    device: Device
    exposure_s: float
    noise: MosaicNoise | None
    acts: Acts

    @property
    def sensor(self) -> Sensor:
        """Return the type of the sensor."""
        return self.device.sensor

    def rng(self, name: str) -> np.random.Generator | None:
        """Return the random generator of this exposure for a name, such as that of an effect.

        None where the exposure is without noise; the effect then returns the expected signal. Draw a number of
        variates that does not depend on the signal, so that twins differ only where their signals differ.
        """
        if self.noise is None:
            return None
        return np.random.default_rng(np.random.SeedSequence([self.noise.seed, *name.encode()]))

    def device_rng(self, name: str) -> np.random.Generator:
        """Return the random generator of the device for a name, such as that of an effect.

        It is the same in every exposure of one device, with and without noise: draw from it what belongs to the
        device, such as a map of its pixels.
        """
        return stream(self.device.seed, f"effect {name}")

    @property
    def output_node(self) -> NDArray[np.uint8]:
        """Return the number of the output node that reads each pixel, uint8[y, x], as `readout.node_of`."""
        return node_of(self.device.shape, self.sensor.readout.nodes)

    def acted(self, step: str, array: Any) -> Any:
        """Return an array with the changes that faults make at a step."""
        for act in self.acts.get(step, ()):
            array = act(array)
        return array


class Effect(Table):
    """Change the signal at one place of a detector's chain.

    A subclass sets the class attributes, declares its fields with `pydantic.Field` (default, bounds, description;
    the unit is in the name) and writes `apply`. A common base of several effects has no name; it derives from
    `abc.ABC` too. Any other class without a name, `after` or `apply` raises DeclarationError.

    Attributes
    ----------
    name
        Name of the effect, and of its table in a sensor file.
    after
        Name of the effect or the step directly behind which it acts.
    spreads
        True if what happens to a pixel reaches others, so that faults may change pixels beyond their footprint.
    """

    name: ClassVar[str]
    after: ClassVar[str]
    spreads: ClassVar[bool] = False

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the effect, unless it is a base class of several."""
        name = cls.__dict__.get("name")
        if name is None and ABC in cls.__bases__:
            return
        where = f"detector effect class {cls.__qualname__}"
        fields = [key for key in ("name", "after") if key in cls.model_fields]
        if fields:
            key = fields[0]
            text = f"{where}: {key} is a key of the sensor file; write {key}: ClassVar[str] = ..."
            raise DeclarationError([], text)
        missing = [
            *(["states no name"] if name is None else []),
            *(["states no after"] if not isinstance(getattr(cls, "after", None), str) else []),
            *(["has no method apply"] if "apply" in cls.__abstractmethods__ else []),
        ]
        if missing:
            raise DeclarationError([], f"{where}: {', '.join(missing)}")
        if not is_name(name):
            text = f"{where}: name = {name!r}: must be lower-case letters, digits and underscores"
            raise DeclarationError([], text)
        _REGISTRY.add(cls.name, cls, module=cls.__module__, qualname=cls.__qualname__)

    def check(self, sensor: Sensor) -> None:
        """Raise ValueError with one sentence if the effect does not fit the sensor."""

    def binned(self, pixels: int, tile: tuple[int, ...]) -> Self:
        """Return the effect on pixels that each add a square of `pixels` neighbours a side, of one colour."""
        return self

    @abstractmethod
    def apply(self, signal: Any, exposure: Exposure) -> Any:
        """Return the signal [y, x] with this effect; the input may be changed in place only if it is returned."""


class FaultStep(Effect, ABC):
    """Let faults act on the signal at one of `STEPS`; a subclass gives its name and place."""

    def apply(self, signal: Any, exposure: Exposure) -> Any:
        """Return the signal with the faults of this step."""
        return exposure.acted(self.name, signal)


_REGISTRY: Registry[type[Effect]] = Registry("detector effect", __package__ or "")


def registry() -> dict[str, type[Effect]]:
    """Return the name and the class of every detector effect."""
    return dict(_REGISTRY)


def is_packaged(cls: type[Effect]) -> bool:
    """Return whether an effect belongs to vbnfault."""
    return _REGISTRY.is_packaged(cls)


def acts_always(cls: type[Effect]) -> bool:
    """Return whether an effect acts in every sensor, and not only where the sensor file has its table."""
    return is_packaged(cls) and not cls.model_fields


def order() -> tuple[str, ...]:
    """Return the names of all effects in the order in which they act.

    An effect from outside acts directly behind the one that it names, before the next one of vbnfault. Raise
    DeclarationError if an effect names none that exists, or effects name each other in a circle.
    """
    classes = registry()
    return chained(
        {name: cls.after for name, cls in classes.items()},
        [name for name, cls in classes.items() if is_packaged(cls)],
        "detector effect",
    )


def chain_of(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the whole chain of a sensor with the given effects of its own, in order."""
    own = {effect.name: effect for effect in effects}
    classes = registry()
    return tuple(
        own[name] if name in own else classes[name]()
        for name in order()
        if name in own or acts_always(classes[name])
    )


# --- the tables of the sensor file ------------------------------------------------------------------------------


def parse(tables: Any) -> tuple[Effect, ...]:
    """Return the effects of the tables `[effects.NAME]` of a sensor, in the order of the chain.

    Raises ValueError, or pydantic's ValidationError that names the key.
    """
    if isinstance(tables, tuple) and all(isinstance(effect, Effect) for effect in tables):
        own = {effect.name: effect for effect in tables}
    elif isinstance(tables, Mapping):
        own = {name: _parse_effect(name, table) for name, table in tables.items()}
    else:
        raise ValueError("must be a table")
    return tuple(own[name] for name in order() if name in own)


def _parse_effect(name: str, table: Any) -> Effect:
    """Return the effect of one table."""
    known = {key: cls for key, cls in registry().items() if not acts_always(cls)}
    cls = known.get(name)
    if cls is None:
        reason = (
            f"no such effect{did_you_mean(name, list(known))}; name the plug-in that defines another one in the "
            "scene's key plugins, or by --plugin"
        )
        error = PydanticCustomError("value_error", "{reason}", {"reason": reason})
        raise ValidationError.from_exception_data("effects", [{"type": error, "loc": (name,), "input": {}}])
    try:
        if isinstance(table, Effect):
            return cls.model_validate(table)
        return cls.model_validate_json(json.dumps(table), strict=True)  # in which arrays may stand for tuples
    except ValidationError as error:
        details: list[Any] = [
            {**detail, "loc": (name, *detail["loc"]), "type": _reason(detail)}
            for detail in error.errors(include_url=False)
        ]
        raise ValidationError.from_exception_data("effects", details) from None


def _reason(detail: Any) -> Any:
    """Return the type of an error of pydantic from which the same error can be made again."""
    if detail["type"] == "value_error":
        return PydanticCustomError("value_error", "{reason}", {"reason": str(detail["ctx"]["error"])})
    return detail["type"]


class _EffectTables:
    """Give pydantic the validation and the JSON Schema of a field that holds effects by their names."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            parse,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda effects: {effect.name: effect.model_dump() for effect in effects}
            ),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        properties = {
            name: handler(cls.__pydantic_core_schema__) for name, cls in registry().items() if not acts_always(cls)
        }
        return {"type": "object", "properties": properties, "additionalProperties": False}


# The type of a field of a model that holds the effects of a sensor by their names.
Effects = Annotated[tuple[Effect, ...], _EffectTables()]
