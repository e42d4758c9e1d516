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

# public name → the module that defines it, and the name there if it is another; without one: the module itself. It
# is loaded when the name is first used. `tests/test_api.py` compares this table with the imports above.
_HOMES = {
    "BuildOptions": "dataset",
    "Calibration": "core.calibration",
    "DiscReflectance": "reflectance",
    "Effect": "detector.effects",
    "Exposure": "detector.effects",
    "Fault": "faults",
    "FaultContext": "faults",
    "Flare": "output.flare_images",
    "Injected": "inject",
    "Injector": "inject",
    "InputError": "core.errors",
    "Interval": "faults",
    "Prescription": "lens",
    "Reflectance": "reflectance",
    "Scene": "scene.config",
    "Sensor": "detector.sensor",
    "Session": "pipeline",
    "VbnfaultError": "core.errors",
    "bounds": "faults",
    "build": "dataset:build_scene",
    "choice": "faults",
    "events": "dataset.events",
    "flag": "faults",
    "export": "output.export:export_store",
    "inject": "inject:",
    "load_lens": "lens",
    "load_scene": "scene.config",
    "load_sensor": "detector.sensor",
    "merge": "dataset:merge_stores",
    "navigation": "navigation:",
    "number": "faults",
    "open_dataset": "store",
    "path": "faults",
    "report": "output.report:write_report",
    "retake": "dataset.retake",
    "rows": "faults",
    "simulate": "pipeline",
    "statistics": "dataset.statistics",
    "study": "study:",
    "text": "faults",
    "torch": "torch:",
    "trace_flare": "output.flare_images",
    "verify": "dataset",
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
