"""`vbnfault.testing.check_fault` names what is wrong with a fault, and accepts one that keeps the contract."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from vbnfault import Fault, FaultContext, Interval, bounds
from vbnfault.core.registry import undoing_registrations
from vbnfault.faults.models import register
from vbnfault.testing import check_fault

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


counter = iter(range(10**9))

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
    with undoing_registrations(always=True):
        register(Stripe)
        yield


def test_a_fault_that_keeps_the_contract_passes() -> None:
    check_fault(Stripe)


@pytest.mark.parametrize("kind", BROKEN)
def test_what_breaks_the_contract_is_named(kind: str) -> None:
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


def test_it_needs_no_test_dependency() -> None:
    script = (
        "import sys, vbnfault.testing; assert not {'pytest', 'hypothesis', 'mitsuba', 'zarr'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
