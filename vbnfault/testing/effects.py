"""Check that a detector effect keeps the contract, with random keys, sensors and signals."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import ValidationError

from ..detector import load_sensor
from ..detector.chain import Device, MosaicNoise
from ..detector.effects import Effect, Exposure, acts_always, order, registry
from .examples import naming, pickled

_MAX_DRAWS = 100
_SHAPE = (24, 40)
# A packaged sensor and the architecture that it is given.
_SENSORS = (
    ("generic_cmos", "cmos"),
    ("generic_ccd", "full_frame_ccd"),
    ("generic_ccd", "frame_transfer_ccd"),
    ("generic_ccd", "interline_ccd"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Recorded(Exposure):
    """Hold an exposure that remembers the random generators that an effect asked for."""

    @cached_property
    def generators(self) -> list[np.random.Generator]:
        """Return the generators in the order in which they were made."""
        return []

    def rng(self, name: str) -> np.random.Generator | None:
        """Return the generator of `Exposure.rng` and remember it."""
        generator = super().rng(name)
        if generator is not None:
            self.generators.append(generator)
        return generator

    def device_rng(self, name: str) -> np.random.Generator:
        """Return the generator of `Exposure.device_rng` and remember it."""
        generator = super().device_rng(name)
        self.generators.append(generator)
        return generator

    def again(self) -> _Recorded:
        """Return a copy of the exposure whose generators start anew, for a second call of the same effect."""
        return replace(self)

    @property
    def states(self) -> list[str]:
        """Return the state of each generator as text, which says how many variates were drawn."""
        return [repr(generator.bit_generator.state) for generator in self.generators]


def check_effect(
    effect: type[Effect], *, required: Mapping[str, Any] | None = None, examples: int = 12, seed: int = 0
) -> None:
    """Check that a detector effect keeps the contract of `Effect`, and print a line if it does.

    Each example draws the keys of the table `[effects.NAME]` within their limits, a small device, a signal as it is
    at the effect's place in the chain, and an exposure with or without noise. The effect

    - is registered, and each of its keys has a description; each number has a lower and an upper limit
    - survives the sensor file and another process, and can be hashed
    - keeps the shape and the dtype of the signal, and returns finite values: before the full well no negative
      electrons, behind the converter no code above the highest
    - changes the signal that it gets only if it returns the same array
    - returns the same for the same exposure, and draws a number of variates, of the exposure and of the device,
      that does not depend on the signal

    Parameters
    ----------
    effect
        The class of the effect.
    required
        Keys without which the sensor file is refused and that have no limits to draw between.
    examples, seed
        As in `check_fault`.

    Raises
    ------
    AssertionError
        If the effect breaks the contract. The message says how, and with which example.
    """
    title = f"detector effect {getattr(effect, 'name', effect.__name__)}"
    given = dict(required or {})
    try:
        _check_declaration(effect)
    except AssertionError as error:
        raise AssertionError(f"{title}: {error}") from None
    for k in range(examples):
        rng = np.random.default_rng([seed, k])
        made, table = _draw_effect(effect, given, rng)
        exposure = _draw_exposure(made, k, rng)
        noise = "without noise" if exposure.noise is None else "with noise"
        example = (
            f"example {k} of seed {seed}: keys {table}; {exposure.sensor.name}, {exposure.sensor.architecture}, "
            f"{exposure.exposure_s:.3g} s, {noise}"
        )
        with naming(title, example):
            _check_round_trips(made)
            _check_apply(made, exposure, rng)
    print(f"{title}: keeps the contract in {examples} examples")


# --- the class ------------------------------------------------------------------------------------------------


def _check_declaration(effect: type[Effect]) -> None:
    """Check the class attributes and the fields of an effect."""
    assert "name" in effect.__dict__, "is a base class without a name"
    known = registry().get(effect.name)
    assert known is not None, "is not registered"
    assert known.__qualname__ == effect.__qualname__, f"has the name of another class, {known.__qualname__}"
    assert effect.__dict__.get("__doc__"), "has no docstring"
    try:
        order()
    except TypeError as error:
        raise AssertionError(str(error)) from None
    for key, field in effect.model_fields.items():
        assert field.description, f"{key} has no description"
    for key, node in effect.model_json_schema().get("properties", {}).items():
        for kind in _alternatives(node):
            if kind.get("type") in ("number", "integer"):
                low, high = _limits(kind)
                assert low is not None, f"{key} has no lower limit; give Field(ge=…) or Field(gt=…)"
                assert high is not None, f"{key} has no upper limit; give Field(le=…) or Field(lt=…)"


def _alternatives(node: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the alternatives of one key of a JSON Schema."""
    return list(node.get("anyOf") or [node])


def _limits(node: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the lower and the upper limit of a number of a JSON Schema; None where there is none."""
    return (
        node.get("minimum", node.get("exclusiveMinimum")),
        node.get("maximum", node.get("exclusiveMaximum")),
    )


# --- examples -------------------------------------------------------------------------------------------------


def _draw_effect(
    effect: type[Effect], required: Mapping[str, Any], rng: np.random.Generator
) -> tuple[Effect, dict[str, Any]]:
    """Return a random effect and its table; keys that contradict each other are drawn again."""
    for _ in range(_MAX_DRAWS):
        table = _draw_table(effect, rng) | dict(required)
        try:
            return effect.model_validate_json(json.dumps(table), strict=True), table
        except ValidationError as error:
            refusal = error.errors(include_url=False)[0]
    key = ".".join(map(str, refusal["loc"]))
    raise AssertionError(
        f"detector effect {effect.name}: {_MAX_DRAWS} draws of its keys were refused, the last one with: "
        f"{key}: {refusal['msg']}; name the keys that it needs by `required`"
    )


def _draw_table(effect: type[Effect], rng: np.random.Generator) -> dict[str, Any]:
    """Return a table of a sensor file with random keys, each within its limits."""
    schema = effect.model_json_schema()
    table: dict[str, Any] = {}
    for key, node in schema.get("properties", {}).items():
        kind = _alternatives(node)[0]
        if key not in schema.get("required", ()) and rng.random() < 0.3:
            continue
        if "enum" in kind:
            table[key] = kind["enum"][rng.integers(len(kind["enum"]))]
        elif kind.get("type") == "boolean":
            table[key] = bool(rng.integers(2))
        elif kind.get("type") == "integer":
            low, high = _limits(kind)
            # an exclusive limit itself is refused, and the table drawn again
            table[key] = int(rng.integers(low, high + 1))
        elif kind.get("type") == "number":
            table[key] = _draw_number(kind, rng)
    return table


def _draw_number(node: Mapping[str, Any], rng: np.random.Generator) -> float:
    """Return a number within the limits of a key, which may be one of them."""
    low, high = _limits(node)
    edges = [node[end] for end in ("minimum", "maximum") if end in node]
    if edges and rng.random() < 0.3:
        return float(edges[rng.integers(len(edges))])
    # 1 - random() is in (0, 1]; the product stays off the lower limit, which may be exclusive
    return float(low + (1 - rng.random()) * (high - low) * (1 - 1e-9))


def _draw_exposure(effect: Effect, example: int, rng: np.random.Generator) -> _Recorded:
    """Return a random exposure of a small device that has the effect; every fourth one is without noise."""
    name, architecture = _SENSORS[example % len(_SENSORS)]
    changes: dict[str, Any] = {"architecture": architecture}
    if not acts_always(type(effect)):
        changes["effects"] = (effect,)
    sensor = replace(load_sensor(name), **changes)
    device = Device(sensor, example, shape=_SHAPE, direction=("up", "down")[rng.integers(2)])
    noise = MosaicNoise.draw(_SHAPE, *rng.spawn(3)) if rng.random() < 0.75 else None
    exposure_s = (0.0, 1e-4, 0.1, 100.0)[rng.integers(4)]
    return _Recorded(device=device, exposure_s=exposure_s, noise=noise, acts={})


def _draw_signal(effect: Effect, exposure: Exposure, rng: np.random.Generator) -> Any:
    """Return a signal [y, x] as the effect gets it: electrons, from 0 on; DN; or codes."""
    readout, place = exposure.sensor.readout, _place(effect)
    if place == "codes":
        return rng.integers(0, readout.top_dn + 1, _SHAPE, dtype=np.uint16)
    if place == "level":
        return rng.uniform(-10, 1.2 * readout.top_dn, _SHAPE).astype(np.float32)
    most_e = readout.full_well_e * (1 if place == "held" else 2)
    signal = rng.uniform(0, most_e, _SHAPE).astype(np.float32)
    signal[::5, ::3] = 0
    signal[::7, ::4] = most_e
    return signal


def _place(effect: Effect) -> str:
    """Return what the signal is that an effect gets: electrons, held (by the wells), level (in DN) or codes."""
    names = order()
    place = names.index(effect.name)
    for step, signal in (("converter", "codes"), ("analogue", "level"), ("full_well", "held")):
        if place > names.index(step):
            return signal
    return "electrons"


# --- the checks of one example --------------------------------------------------------------------------------


def _check_round_trips(effect: Effect) -> None:
    """Check that an effect survives the sensor file and another process, and that caches can tell it apart."""
    plain = json.dumps(effect.model_dump(mode="json"))
    again = type(effect).model_validate_json(plain, strict=True)
    assert again == effect, "the keys of the sensor file give another effect"
    assert pickled(effect) == effect, "pickle gives another effect"
    try:
        assert hash(again) == hash(effect), "equal effects have different hashes"
    except TypeError as error:
        raise AssertionError(f"cannot be hashed: {error}; use tuples for keys with several values") from None


def _check_apply(effect: Effect, exposure: _Recorded, rng: np.random.Generator) -> None:
    """Check what an effect does to a signal, and that it also runs in a device."""
    signal = _draw_signal(effect, exposure, rng)
    given = signal.copy()
    result = effect.apply(given, exposure)
    returned_same = result is given
    assert isinstance(result, np.ndarray), f"apply returned {type(result).__name__}, but must return an array"
    dtype = np.dtype(np.uint16) if effect.name == "converter" else signal.dtype
    for what, old, new in (("shape", signal.shape, result.shape), ("dtype", dtype, result.dtype)):
        assert new == old, f"apply changed the {what} from {old} to {new}"
    unchanged = np.array_equal(given, signal)
    assert returned_same or unchanged, "apply modified its input and returned another array"
    assert np.isfinite(result).all(), "apply returned a value that is not finite"
    if _place(effect) == "electrons":
        assert (result >= 0).all(), "apply returned negative electrons"
    elif dtype == np.uint16:
        top = exposure.sensor.readout.top_dn
        assert (result <= top).all(), f"apply returned a code above the highest, {top}"

    first = result.tobytes()
    again = exposure.again()
    assert effect.apply(signal.copy(), again).tobytes() == first, "apply gives another result for the same exposure"
    darker = exposure.again()
    effect.apply(np.zeros_like(signal), darker)
    assert again.states == darker.states, "apply draws a number of variates that depends on the signal"
    if not acts_always(type(effect)):
        light = rng.uniform(0, 2 * exposure.sensor.readout.full_well_e, _SHAPE).astype(np.float32)
        exposure.device.raw(light, exposure.exposure_s, exposure.noise)
