"""Check that a fault model keeps the contract, with random keys, cameras and images."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.quantities import ARCHITECTURES, Electrons
from ..faults import (
    MOSAIC_STEPS,
    STEPS,
    Fault,
    FaultContext,
    Params,
    from_dict,
    models,
    physical_order,
    registry,
)
from .examples import CCDS, draw_context, naming, pickled, random_quantity, with_mosaic

_PLAIN = (dict, list, str, int, float, bool, type(None))
_MAX_DRAWS = 100


class _NotInformed:
    """Stand for what other faults say to a model that does not state `informed = True`: any use of it fails."""


def check_fault(
    model: type[Fault], *, required: Mapping[str, Any] | None = None, examples: int = 12, seed: int = 0
) -> None:
    """Check that a fault model keeps the contract of `Fault`, and print a line if it does.

    Each example draws the keys of the scene file within their declared bounds, a small camera and a random image.

    Parameters
    ----------
    model
        The class of the model.
    required
        Keys without which the scene file is refused, such as the path of a file.
    examples
        Number of random examples.
    seed
        Seed of the examples.

    Raises
    ------
    AssertionError
        If the model breaks the contract. The message says how, and with which example.
    """
    title = f"fault model {model.fault}/{model.model}"
    given = dict(required or {})
    try:
        _check_declaration(model, given)
    except AssertionError as error:
        raise AssertionError(f"{title}: {error}") from None
    for k in range(examples):
        rng = np.random.default_rng([seed, k])
        fault, table = _draw_fault(model, given, rng)
        context = draw_context(rng, architectures=CCDS if model.needs_ccd else ARCHITECTURES)
        if model.needs_mosaic:
            context = with_mosaic(context)
        if not model.informed:
            not_informed: Any = _NotInformed()
            context = replace(context, coating_loss=not_informed)
        camera = context.camera
        example = (
            f"example {k} of seed {seed}: keys {table}; {camera.width_px} x {camera.height_px} px, "
            f"{camera.architecture}, read out {camera.readout_direction}, Sun at {context.sun_xy_px}"
        )
        with naming(title, example):
            _check_round_trips(fault)
            _check_instrument(fault, context, k)
            for step in fault.steps:
                _check_step(step, fault, context, k)
    print(f"{title}: keeps the contract in {examples} examples")


def draw_table(model: type[Fault], rng: np.random.Generator) -> dict[str, Any]:
    """Return a table of the scene file with random keys, each within its declared bounds."""
    table: dict[str, Any] = {"model": model.model}
    for f in dataclasses.fields(model):
        kind = f.metadata["kind"]
        if rng.random() < 0.5:
            continue
        if kind == "bounds":
            lo, hi = getattr(model, f.name)  # the default of a dataclass field
            integer = f.metadata["integer"]
            pair = sorted((rng.integers(lo, hi + 1, 2) if integer else rng.uniform(lo, hi, 2)).tolist())
            table[f.name] = pair if rng.random() < 0.5 else pair[0]
        elif kind == "flag":
            table[f.name] = bool(rng.integers(2))
        elif kind == "choice":
            table[f.name] = f.metadata["options"][rng.integers(len(f.metadata["options"]))]
    return table


def _draw_fault(
    model: type[Fault], required: Mapping[str, Any], rng: np.random.Generator
) -> tuple[Fault, dict[str, Any]]:
    """Return a random fault and its table; keys that contradict each other are drawn again."""
    for _ in range(_MAX_DRAWS):
        table = dict(required) | draw_table(model, rng)
        try:
            return from_dict(model.fault, table, source="check_fault"), table
        except InputError as error:
            refusal = error
    raise AssertionError(
        f"fault model {model.fault}/{model.model}: {_MAX_DRAWS} draws of its keys were refused, the last one with: "
        f"{refusal}; name the keys that it needs by `required`"
    )


def _check_declaration(model: type[Fault], required: Mapping[str, Any]) -> None:
    """Check the class attributes and the fields of a model."""
    models.register(model)  # the same file may have been loaded again, as a scene's plug-in
    assert model.fault in physical_order([model.fault])
    assert model.__doc__, "has no docstring"
    assert set(model.steps) <= set(STEPS), f"acts at {model.steps}; must be among {STEPS}"
    inside = sorted(set(model.steps) & set(MOSAIC_STEPS))
    assert model.needs_mosaic or not inside, f"acts at {inside}, so it must state needs_mosaic = True"
    if model.step == "electrons":
        order = physical_order(registry())
        for name in order[: order.index(model.fault)]:
            optical = any(cls.step == "electrons" for cls in registry()[name].values())
            assert optical, f"acts on the light, but after {name}, which acts on the detector; change `after`"
    for f in dataclasses.fields(model):
        assert f.metadata["doc"], f"{f.name} has no doc"
    fault = from_dict(model.fault, dict(required) | {"model": model.model}, source="check_fault")
    assert type(fault) is model


def _check_round_trips(fault: Fault) -> None:
    """Check that a fault survives the scene file and another process."""
    plain = json.loads(json.dumps(fault.to_dict()))
    assert from_dict(fault.fault, plain, source="check_fault") == fault, "to_dict and from_dict give another fault"
    assert pickled(fault) == fault, "pickle gives another fault"


def _check_instrument(fault: Fault, context: FaultContext, key: int) -> None:
    """Check the hooks that say what changes in the camera, and how strongly the fault acts."""
    params = fault.draw(context, np.random.default_rng(key))
    before = repr(context.camera)
    camera, informed = fault.alter(context.camera, params), fault.inform(context, params)
    assert repr(context.camera) == before, "alter modified the camera"
    assert repr(camera) == repr(fault.alter(context.camera, params)), "alter gives another camera each time"
    assert (camera.height_px, camera.width_px) == context.shape, "alter changed the size of the image"
    assert isinstance(informed, FaultContext), "inform returned no FaultContext"
    if fault.soft_layer:
        layer = fault.soft(params, context)
        assert (layer.shape, layer.dtype) == (context.shape, np.float32), "soft must return float32[y, x]"
        assert np.isfinite(layer).all(), "soft returned a value that is not finite"
    defects = fault.defects(params, context)
    if defects is not None:
        assert (defects.shape, defects.dtype) == (context.shape, np.uint8), "defects must return uint8[y, x]"


def _check_step(step: str, fault: Fault, context: FaultContext, key: int) -> None:
    """Check what a fault does at one of its steps."""
    params = fault.draw(context, np.random.default_rng(key))
    quantity: Any = random_quantity(step, context)
    before = quantity.array.tobytes()
    result = fault.apply_at(step, quantity, params, context)
    mask = fault.footprint(params, context)

    assert quantity.array.tobytes() == before, f"apply modified its input at {step}"
    assert type(result) is type(quantity), f"apply must return {type(quantity).__name__} at {step}"
    for what in ("unit", "shape", "dtype"):
        old, new = (getattr(q if what == "unit" else q.array, what) for q in (quantity, result))
        assert new == old, f"apply changed the {what} from {old} to {new} at {step}"
    if step in ("electrons", "light", "pixels", "charge", "offsets"):
        assert np.isfinite(result.array).all(), f"apply returned a value that is not finite at {step}"
        assert step == "offsets" or (result.array >= 0).all(), f"apply returned a negative value at {step}"

    def same(params: Params) -> bool:
        repeated = fault.apply_at(step, quantity, params, replace(context))  # with an empty memo
        return repeated.array.tobytes() == result.array.tobytes()

    again = fault.draw(replace(context), np.random.default_rng(key))
    assert again == params, "draw gives other parameters for the same key"
    assert same(again), f"apply gives another result for the same parameters at {step}"
    _check_plain(params)
    stored = json.loads(json.dumps(params, allow_nan=False))
    assert stored == params, "the parameters of draw change when they are stored as JSON"
    assert same(stored), f"apply gives another result for the stored parameters at {step}"
    if mask is not None:
        _check_footprint(fault, params, context, mask)
        if fault.localised and not fault.effect_mask:
            outside = result.array[~mask].tobytes() == quantity.array[~mask].tobytes()
            assert outside, f"apply changed pixels outside the footprint at {step}"
    if step == "electrons":
        _check_planes_of_light(fault, params, context, quantity)


def _check_plain(value: Any) -> None:
    """Check that a value consists of plain Python data."""
    assert type(value) in _PLAIN, f"the parameters of draw hold a {type(value).__name__}; convert it to plain data"
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_plain(item)


def _check_footprint(fault: Fault, params: Params, context: FaultContext, mask: Any) -> None:
    """Check a footprint's shape, and that it is the same each time."""
    assert (mask.shape, mask.dtype) == (context.shape, np.bool_), "footprint must return bool[y, x]"
    other = fault.footprint(params, replace(context))
    assert other is not None, "footprint returns None at times"
    assert np.array_equal(other, mask), "footprint gives another mask for the same parameters"


def _check_planes_of_light(fault: Fault, params: Params, context: FaultContext, light: Electrons) -> None:
    """Check that light past the lens's rims stays in a plane of its own, finite and not negative."""
    both = replace(light, past_rims=light.array[::-1].copy())
    result = fault.on_light(both, params, context)
    assert result.past_rims is not None
    for plane in (result.array, result.past_rims):
        assert plane.shape == light.array.shape, "apply changed the shape of the light past the rims"
        assert np.isfinite(plane).all(), "apply returned light past the rims that is not finite"
        assert (plane >= 0).all(), "apply returned negative light past the rims"
    if fault.needs_light:
        dark = fault.apply(light.with_array(np.zeros_like(light.array)), params, context)
        assert not dark.array.any(), "apply added light to a dark frame, although the model states needs_light"
