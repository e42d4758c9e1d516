"""`vbnfault.testing` names what is wrong with a fault or an effect, and accepts those that keep the contract."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from pydantic import Field

from vbnfault import Effect, Fault, FaultContext, Interval, bounds
from vbnfault.core.registry import undoing_registrations
from vbnfault.detector import load_sensor
from vbnfault.detector.chain import Device, MosaicNoise
from vbnfault.detector.effects import Exposure, contract, registry
from vbnfault.faults.models import register
from vbnfault.testing import check_effect, check_fault

with undoing_registrations(always=True):  # other tests must not meet this fault

    @dataclass(frozen=True, kw_only=True)
    class Stripe(Fault):
        """Darken some rows."""

        fault = "stripe"
        model = "rows"
        default = True
        after = "straylight"
        step = "electrons"

        first: Interval = bounds(0, 20, limits=(0, 1000), integer=True, doc="first row")  # noqa: RUF009

        def draw(self, context: FaultContext, rng: np.random.Generator) -> dict[str, Any]:
            return {"first": self.first.integer(rng)}

        def apply(self, quantity: Any, params: dict[str, Any], context: FaultContext) -> Any:
            array = quantity.array.copy()
            array[params["first"] :][:4] *= 0.5
            return quantity.with_array(array)

        def footprint(self, params: dict[str, Any], context: FaultContext) -> Any:
            mask = np.zeros(context.shape, dtype=bool)
            mask[params["first"] :][:4] = True
            return mask


GOOD = {name: getattr(Stripe, name) for name in ("draw", "apply", "footprint")}


def good(hook: str, self: Any, *arguments: Any) -> Any:
    """What the hook of a fault that keeps the contract returns."""
    return GOOD[hook](self, *arguments)


def in_place(self: Any, quantity: Any, params: Any, context: Any) -> Any:
    quantity.array[:4] *= 0.5
    return quantity


def of_doubles(self: Any, quantity: Any, params: Any, context: Any) -> Any:
    return quantity.with_array(quantity.array * np.float64(1.0) + np.zeros(1))


def negative(self: Any, quantity: Any, params: Any, context: Any) -> Any:
    return quantity.with_array(quantity.array - quantity.white_e)


def elsewhere(self: Any, quantity: Any, params: Any, context: Any) -> Any:
    array = good("apply", self, quantity, params, context).array.copy()
    array[-1] *= 0.5
    return quantity.with_array(array)


counter = itertools.count()

BROKEN: dict[str, tuple[dict[str, Any], str]] = {
    "in place": ({"apply": in_place}, "raised ValueError: output array is read-only"),
    "dtype": ({"apply": of_doubles}, "raised TypeError: Electrons is float32, got float64"),
    "negative": ({"apply": negative}, "apply returned a negative value at electrons"),
    "elsewhere": ({"apply": elsewhere}, "apply changed pixels outside the footprint at electrons"),
    "draw": ({"draw": lambda *_: {"first": next(counter)}}, "draw gives other parameters for the same key"),
    "numpy": ({"draw": lambda *_: {"first": np.int64(3)}}, "the parameters of draw hold a int64; convert it"),
    "mask": ({"footprint": lambda *_: np.zeros((3, 3), bool)}, r"footprint must return bool\[y, x\]"),
    "mosaic": ({"step": "raw"}, r"acts at \['raw'\], so it must state needs_mosaic = True"),
    "order": ({"after": "adc"}, "acts on the light, but after broken_pixels|but after smear"),
    "camera": ({"alter": lambda self, camera, params: counter.__next__()}, "alter gives another camera each time"),
}


@pytest.fixture(autouse=True)
def registered_for_a_test() -> Iterator[None]:
    """The effects that a test defines are gone after it, too."""
    with undoing_registrations(always=True):
        register(Stripe)
        yield


def test_a_fault_that_keeps_the_contract_passes() -> None:
    check_fault(Stripe)


@pytest.mark.parametrize("kind", BROKEN)
def test_what_breaks_the_contract_of_faults_is_named(kind: str) -> None:
    attributes, sentence = BROKEN[kind]
    body = {
        "fault": "stripe",
        "model": f"broken_{kind.replace(' ', '_')}",
        "after": "straylight",
        "step": "electrons",
    }
    body |= {
        "fault": f"stripe_{kind.replace(' ', '_')}",
        "default": True,
        "__doc__": "Break.",
        "__module__": __name__,
    }
    broken = dataclass(frozen=True, kw_only=True)(type("Broken", (Stripe,), body | attributes))
    globals()["Broken"] = broken  # pickle looks it up there
    with pytest.raises(AssertionError, match=sentence) as caught:
        check_fault(broken)
    assert str(caught.value).startswith(f"fault model {broken.fault}/{broken.model}: ")


def test_a_class_within_a_function_cannot_be_pickled() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Inside(Stripe):
        """A class that no other process finds."""

        model = "inside"

    with pytest.raises(AssertionError, match=r"cannot be pickled: .*; define its class at the top of a module"):
        check_fault(Inside)


# --- effects of detectors -----------------------------------------------------------------------------------------


PACKAGED = [cls for cls in registry().values() if contract.is_packaged(cls)]


@pytest.mark.parametrize("effect", PACKAGED, ids=lambda cls: cls.name)
def test_packaged_effects_keep_the_contract(effect: type[Effect]) -> None:
    table = {"table": [[1e3, 990.0], [2e4, 1.7e4]]}
    check_effect(effect, required=table if effect.name == "nonlinearity" else None)


FRACTION = Field(0.1, ge=0, le=1, description="fraction")


def good_effect(self: Any, signal: Any, exposure: Any) -> Any:
    rng = exposure.rng(self.name)
    factor = 1.0 if rng is None else rng.uniform()
    return signal + np.float32(100 * self.fraction * factor)


def effect_in_place(self: Any, signal: Any, exposure: Any) -> Any:
    signal += 1
    return signal.copy()


def by_the_signal(self: Any, signal: Any, exposure: Any) -> Any:
    rng = exposure.rng(self.name)
    return signal if rng is None else signal + rng.poisson(signal).astype(np.float32)


def traps_by_the_signal(self: Any, signal: Any, exposure: Any) -> Any:
    return signal + np.float32(exposure.device_rng(self.name).random(5 if signal.any() else 0).sum())


BROKEN_EFFECTS: dict[str, tuple[dict[str, Any], str]] = {
    "in place": ({"apply": effect_in_place}, "apply modified its input and returned another array"),
    "dtype": ({"apply": lambda _, s, e: s.astype(np.float64)}, "apply changed the dtype from float32 to float64"),
    "shape": ({"apply": lambda _, s, e: s[1:]}, r"apply changed the shape from \(24, 40\) to \(23, 40\)"),
    "none": ({"apply": lambda _, s, e: None}, "apply returned NoneType, but must return an array"),
    "negative": ({"apply": lambda _, s, e: s - 1}, "apply returned negative electrons"),
    "infinite": ({"apply": lambda _, s, e: s + np.float32(np.inf)}, "apply returned a value that is not finite"),
    "code": (
        {"apply": lambda _, s, e: s | np.uint16(0x8000), "after": "converter"},
        r"apply returned a code above the highest, \d+",
    ),
    "draw": ({"apply": lambda _, s, e: s + np.float32(1 + next(counter))}, "another result for the same exposure"),
    "variates": ({"apply": by_the_signal}, "draws a number of variates that depends on the signal"),
    "variates of the device": (
        {"apply": traps_by_the_signal},
        "draws a number of variates that depends on the sig",
    ),
    "after": ({"after": "dark_curent"}, r"after = 'dark_curent': there is none of this name \(did you mean"),
    "description": ({"fraction": Field(0.1, ge=0, le=1)}, "fraction has no description"),
    "limit": ({"fraction": Field(0.1, ge=0, description="a")}, "fraction has no upper limit"),
    "raises": ({"apply": lambda _, s, e: s / e.nothing}, "raised AttributeError: .*nothing"),
    "document": ({"__doc__": None}, "has no docstring"),
}


def define(kind: str, body: dict[str, Any]) -> type[Effect]:
    """Return an effect that keeps the contract but for what `body` replaces."""
    kept = {"name": f"broken_{kind}", "after": "dark_current", "apply": good_effect, "fraction": FRACTION}
    kept |= {"__doc__": "Add.", "__module__": __name__, "__qualname__": "Broken"}
    made = type("Broken", (Effect,), kept | body | {"__annotations__": {"fraction": float}})
    globals()["Broken"] = made  # pickle looks it up there
    return made


def test_an_effect_that_keeps_the_contract_passes(capsys: pytest.CaptureFixture[str]) -> None:
    check_effect(define("good", {}))
    assert capsys.readouterr().out == "detector effect broken_good: keeps the contract in 12 examples\n"


@pytest.mark.parametrize("kind", BROKEN_EFFECTS)
def test_what_breaks_the_contract_of_effects_is_named(kind: str) -> None:
    body, sentence = BROKEN_EFFECTS[kind]
    effect = define(kind.replace(" ", "_"), body)
    with pytest.raises(AssertionError, match=sentence) as caught:
        check_effect(effect)
    assert str(caught.value).startswith(f"detector effect {effect.name}: ")


def test_keys_without_limits_to_draw_between_are_given() -> None:
    class Named(Effect):
        """Change nothing."""

        name = "named"
        after = "dark_current"
        label: str = Field(description="text without a default")

        def apply(self, signal: Any, exposure: Any) -> Any:
            return signal

    with pytest.raises(AssertionError, match=r"draws of its keys were refused, .* label: .*; name the keys"):
        check_effect(Named)
    Named.__qualname__ = "Named"
    globals()["Named"] = Named
    check_effect(Named, required={"label": "a"}, examples=2)


def test_an_effect_has_the_same_map_in_every_exposure_of_one_device() -> None:
    """The map differs between devices and between effects, and the noise-free image has it too."""
    sensor = load_sensor("generic_cmos")
    sensor = replace(sensor, readout=replace(sensor.readout, nodes=2))

    def drawn(seed: int, noise_seed: int | None, name: str = "traps") -> bytes:
        device = Device(sensor, seed, shape=(16, 20))
        noise = None
        if noise_seed is not None:
            noise = MosaicNoise.draw((16, 20), *np.random.default_rng(noise_seed).spawn(3))
        exposure = Exposure(device=device, exposure_s=0.1, noise=noise, acts={})
        np.testing.assert_array_equal(exposure.output_node[:, [0, 9, 10, 19]], [[0, 0, 1, 1]] * 16)
        return exposure.device_rng(name).random(8).tobytes()

    assert drawn(1, None) == drawn(1, 5) == drawn(1, 6)
    assert len({drawn(1, 5), drawn(2, 5), drawn(1, 5, "other")}) == 3
