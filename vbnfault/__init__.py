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
    from . import navigation
    from .core.errors import InputError, VbnfaultError
    from .dataset import BuildOptions, verify
    from .dataset import build_scene as build
    from .detector.effects import Effect, Exposure
    from .detector.sensor import Sensor, load_sensor
    from .faults import Fault, FaultContext, Interval, bounds, choice, flag, number, path, rows, text
    from .lens import Prescription, load_lens
    from .output.flare_images import Flare, trace_flare
    from .pipeline import Session, simulate
    from .reflectance import DiscReflectance, Reflectance
    from .scene.config import Scene, load_scene
    from .store import open_dataset
    from .study.run import study

# public name → the module that defines it, and its name there; "": the module itself
_HOME = {
    "DiscReflectance": ("reflectance", "DiscReflectance"),
    "Effect": ("detector.effects", "Effect"),
    "Exposure": ("detector.effects", "Exposure"),
    "BuildOptions": ("dataset", "BuildOptions"),
    "Fault": ("faults", "Fault"),
    "FaultContext": ("faults", "FaultContext"),
    "Flare": ("output.flare_images", "Flare"),
    "InputError": ("core.errors", "InputError"),
    "Interval": ("faults", "Interval"),
    "Reflectance": ("reflectance", "Reflectance"),
    "Prescription": ("lens", "Prescription"),
    "Scene": ("scene.config", "Scene"),
    "Sensor": ("detector.sensor", "Sensor"),
    "Session": ("pipeline", "Session"),
    "VbnfaultError": ("core.errors", "VbnfaultError"),
    "bounds": ("faults", "bounds"),
    "build": ("dataset", "build_scene"),
    "choice": ("faults", "choice"),
    "flag": ("faults", "flag"),
    "load_lens": ("lens", "load_lens"),
    "load_scene": ("scene.config", "load_scene"),
    "load_sensor": ("detector.sensor", "load_sensor"),
    "navigation": ("navigation", ""),
    "number": ("faults", "number"),
    "open_dataset": ("store", "open_dataset"),
    "path": ("faults", "path"),
    "rows": ("faults", "rows"),
    "simulate": ("pipeline", "simulate"),
    "study": ("study", ""),
    "text": ("faults", "text"),
    "trace_flare": ("output.flare_images", "trace_flare"),
    "verify": ("dataset", "verify"),
}

__all__ = [
    "BuildOptions",
    "DiscReflectance",
    "Effect",
    "Exposure",
    "Fault",
    "FaultContext",
    "Flare",
    "InputError",
    "Interval",
    "Prescription",
    "Reflectance",
    "Scene",
    "Sensor",
    "Session",
    "VbnfaultError",
    "__version__",
    "bounds",
    "build",
    "choice",
    "flag",
    "load_lens",
    "load_scene",
    "load_sensor",
    "navigation",
    "number",
    "open_dataset",
    "path",
    "rows",
    "simulate",
    "study",
    "text",
    "trace_flare",
    "verify",
]


def __getattr__(name: str) -> Any:
    """Return a public name from the module that defines it."""
    if name not in _HOME:
        raise AttributeError(f"module 'vbnfault' has no attribute {name!r}")
    import importlib

    module, defined = _HOME[name]
    loaded = importlib.import_module(f".{module}", __name__)
    value = getattr(loaded, defined) if defined else loaded
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
