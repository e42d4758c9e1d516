"""Make labelled, fault-injected camera images for vision-based navigation near comets and other small bodies.

    import vbnfault

    scene = vbnfault.load_scene("quickstart")
    sample = vbnfault.simulate(scene, 3)
    vbnfault.build(scene, "quickstart.zarr", workers=2)
    data = vbnfault.open_dataset("quickstart.zarr")

Importing the package loads nothing heavy: each name loads its module when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from . import navigation, torch
    from .core.calibration import Calibration
    from .core.errors import InputError, VbnfaultError
    from .dataset import BuildOptions, verify
    from .dataset import build_scene as build
    from .dataset import merge_stores as merge
    from .dataset.events import events
    from .dataset.retake import retake
    from .dataset.statistics import statistics
    from .detector.effects import Effect, Exposure
    from .detector.sensor import Sensor, load_sensor
    from .faults import Fault, FaultContext, Interval, bounds, choice, flag, number, path, rows, text
    from .inject import Injected, Injector, inject
    from .lens import Prescription, load_lens
    from .output.export import export_store as export
    from .output.flare_images import Flare, trace_flare
    from .output.report import write_report as report
    from .pipeline import Session, simulate
    from .reflectance import DiscReflectance, Reflectance
    from .scene.config import Scene, load_scene
    from .store import open_dataset
    from .study.run import study

# This table lists by module the public names that it defines; it is loaded when one of them is first used.
_DEFINED = {
    "core.calibration": ("Calibration",),
    "core.errors": ("InputError", "VbnfaultError"),
    "dataset": ("BuildOptions", "verify"),
    "dataset.events": ("events",),
    "dataset.retake": ("retake",),
    "dataset.statistics": ("statistics",),
    "detector.effects": ("Effect", "Exposure"),
    "detector.sensor": ("Sensor", "load_sensor"),
    "faults": ("Fault", "FaultContext", "Interval", "bounds", "choice", "flag", "number", "path", "rows", "text"),
    "inject": ("Injected", "Injector"),
    "lens": ("Prescription", "load_lens"),
    "output.flare_images": ("Flare", "trace_flare"),
    "pipeline": ("Session", "simulate"),
    "reflectance": ("DiscReflectance", "Reflectance"),
    "scene.config": ("Scene", "load_scene"),
    "store": ("open_dataset",),
}
# This table gives the module of each public name. Behind a colon stands the name there, if it is another; nothing
# behind it means the module itself. `tests/test_api.py` compares the table with the imports above.
_HOMES = {name: module for module, names in _DEFINED.items() for name in names} | {
    "build": "dataset:build_scene",
    "export": "output.export:export_store",
    "inject": "inject:",
    "merge": "dataset:merge_stores",
    "navigation": "navigation:",
    "report": "output.report:write_report",
    "study": "study:",
    "torch": "torch:",
}

__all__ = sorted([*_HOMES, "__version__"])


if not TYPE_CHECKING:  # a type checker that saw the function would accept every misspelled name

    def __getattr__(name: str) -> Any:
        """Return a public name from the module that defines it, and keep it (PEP 562)."""
        from importlib import import_module  # not above: the import of the package loads no other module

        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, renamed, defined = _HOMES[name].partition(":")
        value: Any = import_module(f".{module}", __name__)
        if defined or not renamed:
            value = getattr(value, defined or name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
