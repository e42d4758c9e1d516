"""Say what the keys of a study's factors mean, and turn their values into a changed scene, lens, sensor and Sun.

There are four kinds of keys:

`scene.<key>`
    Any key of the scene file. An interval of a fault, such as `scene.faults.straylight.roughness_nm`, is fixed to
    the value. A key that the renderer reads makes a render for every value. `scene.fault` chooses the fault that
    acts, a class or `class/model`, as the value of a categorical factor. The bounds of its draws are those of the
    scene's table `[faults.<class>]` where the scene has one with this model, otherwise the model's own. Each
    evaluation has this fault alone, so that it compares with the clean twin of the same view. A fault that cannot
    act in a view, such as straylight with the Sun behind the camera, gives no value there.
`lens.…`
    Changes of the prescription that the scene's faults trace, at its final size; a lens of the camera that has
    surfaces changes with it. Rows count from 0 at the front, as in the names of ghosts.
    `lens.surface.<row>.radius`, `.thickness`, `.index` and `.semi_diameter` are errors, and so are those of
    coatings: `lens.surface.<row>.coating.<layer>.thickness` and `.index` of one layer,
    `lens.surface.<row>.coating.thickness` and `.index` of all layers of a surface, and `lens.coating.thickness` and
    `.index` of all surfaces. The other keys take values: `lens.stop.blades`, `lens.stop.blade_rounding`,
    `lens.stop.rotation_deg`, `lens.sensor_reflectance` and `lens.f_number`.
`detector.<key>`
    Keys of the sensor's file, such as `detector.readout.full_well_e` or short `detector.full_well_e`; without a
    sensor's file, those of `[camera]` that describe the detector.
`sun.angle_deg`, `sun.azimuth_deg`, `sun.distance_au`
    Angle of the Sun from the axis, its azimuth in the image (0: right, 90: down), and its distance. The first two
    move the Sun that the optics see; the illumination of the ground stays that of the rendered view, and so does
    the visible fraction of the disc. The distance r scales the radiance of the scene and the Sun by r⁻², and the
    radius of the disc by 1/r. No render is needed for any of them.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from ..camera import Camera
from ..core import tables
from ..core.errors import InputError, shown
from ..core.tables import did_you_mean
from ..faults import Fault, from_dict, registry
from ..lens import Prescription
from ..lens.adapt import Change
from ..pipeline.spec import Pose, SampleSpec
from ..scene import plan
from ..scene.config import Scene, parse_scene, read_scene
from ..scene.instrument import OF_THE_DETECTOR
from .distributions import Categorical
from .spec import StudySpec

FAULT_KEY = "scene.fault"  # its values name the fault that acts
FAULT_SCENE_KEY = "fault"  # the same among the keys of a scene

_SPELLINGS = {"electrons": "e", "e-": "e", "°": "deg", "um": "µm", "AU": "au", "1": "", "fraction": "", "dn": "DN"}
_ENDINGS = {
    "_e_rms": "e",
    "_e_s": "e/s",
    "_TeV_g": "TeV/g",
    "_deg": "deg",
    "_nm": "nm",
    "_mm": "mm",
    "_um": "µm",
    "_au": "au",
    "_dn": "DN",
    "_px": "px",
    "_eV": "eV",
    "_K": "K",
    "_s": "s",
    "_h": "h",
    "_e": "e",
    "_m": "m",
}
# Keys of [camera] that describe the detector of a camera without a sensor's file.
_OF_THREE_COLOURS = tuple(key for key in OF_THE_DETECTOR if key not in ("pixel_pitch_um", "architectures"))
# Keys of a sensor's file that are no property of its electronics, or that the renderer reads.
_NOT_OF_A_DETECTOR = (
    *("name", "source", "sources", "effects", "architecture", "width_px", "height_px", "pixel_pitch_um"),
    *("pattern", "quantum_efficiency"),
)
# Keys of [camera] that act behind the lens or on the exposure, so that the renderer does not read them.
AFTER_RENDER = (
    *("exposure_s", "exposure_min_s", "exposure_max_s", "metering_level", "metering_percentile", "transmission"),
    *_OF_THREE_COLOURS,
    "detector_temperature_K",
)
_LENGTHS = ("fraction", "mm")
_SUN_LIMITS = {"angle_deg": (0.0, 89.0), "distance_au": (0.02, 1000.0)}


@dataclass(frozen=True)
class Key:
    """Describe a key of a factor.

    `units` are the units in which its values may be given, the first one by default; empty: any. `add` puts a value
    in a unit into a `Setting`.
    """

    name: str
    units: tuple[str, ...]
    add: Callable[[Setting, Any, str], None]


@dataclass
class Setting:
    """Collect what one evaluation changes; the keys of `scene` and `detector` are dotted."""

    scene: dict[str, Any] = field(default_factory=dict)
    lens: list[Change] = field(default_factory=list)
    detector: dict[str, Any] = field(default_factory=dict)
    sun: dict[str, float] = field(default_factory=dict)


class Factors:
    """Turn the values of a study's factors into what an evaluation changes.

    Parameters
    ----------
    spec
        The study.
    scene
        Its scene, without factors.
    camera
        Camera of the scene, without factors.
    lens
        Prescription that the faults of the scene trace.

    Raises
    ------
    InputError
        A factor's key is unknown, or its unit does not belong to it.
    """

    def __init__(self, spec: StudySpec, scene: Scene, camera: Camera, lens: Prescription) -> None:
        of_sun = [_table_key("sun", key) for key in ("angle_deg", "azimuth_deg", "distance_au")]
        keys = (*_scene_keys(spec, scene), *_lens_keys(lens), *_detector_keys(camera), *of_sun)
        self.known = {key.name: key for key in keys}  # all that a factor of the study may have
        self.keys: dict[str, Key] = {}
        self._units: dict[str, str] = {}
        for i, factor in enumerate(spec.factors):
            where = f"factor[{i}].key = {shown(factor.key)}"
            key = self.known.get(factor.key) or self.known.get(_long_name(factor.key, self.known))
            if key is None:
                raise InputError(
                    f"{where}: is no key of scene, lens, detector or sun{_suggestion(factor.key, self.known)}"
                )
            unit = _SPELLINGS.get(factor.unit, factor.unit)
            allowed = {_SPELLINGS.get(u, u): u for u in key.units}
            if factor.unit and key.units and unit not in allowed:
                raise InputError(f"{where}: unit = {shown(factor.unit)}: must be {' or '.join(key.units)}")
            self.keys[factor.key] = key
            default = key.units[0] if key.units else ""
            self._units[factor.key] = (allowed.get(unit) if factor.unit else "") or default

    def setting(self, values: Mapping[str, float | str]) -> Setting:
        """Return what the values of the factors change."""
        setting = Setting()
        for name, value in values.items():
            self.keys[name].add(setting, value, self._units[name])
        return setting


def _long_name(name: str, known: Mapping[str, Key]) -> str:
    """Return the only key of the sensor's file that ends like a short one; else the name itself."""
    kind, _, leaf = name.partition(".")
    same = [key for key in known if key.startswith("detector.") and key.rpartition(".")[2] == leaf]
    return same[0] if kind == "detector" and len(same) == 1 else name


def _suggestion(name: str, known: Mapping[str, Key]) -> str:
    """Return the nearest known key as a suggestion, first among those of its own kind."""
    kind = name.partition(".")[0]
    same = [key for key in known if key.startswith(f"{kind}.")]
    if not same:
        return "; keys begin with scene., lens., detector. or sun."
    close = did_you_mean(name, same)
    return close if close.startswith(" (") else f"; known: {', '.join(same[:12])}, …"


def _fields(fault: str, model: str) -> dict[str, str]:
    """Return the keys of a model of a fault, each with its unit; an empty name stands for the default model."""
    models = registry().get(fault, {})
    cls = models.get(model) or next((c for c in models.values() if c.default), None)
    if cls is None:
        return {}
    return {f.name: f.metadata.get("unit", "") for f in dataclasses.fields(cls)}


# --- a factor that chooses the fault ---------------------------------------------------------------------------


def fault_choices(spec: StudySpec) -> tuple[str, ...]:
    """Return the faults among which a factor of the study chooses; none where it has no such factor.

    Raises
    ------
    InputError
        The factor is no choice of names, or the study compares models, too.
    """
    for i, factor in enumerate(spec.factors):
        if factor.key != FAULT_KEY:
            continue
        if not isinstance(factor, Categorical) or not all(isinstance(value, str) for value in factor.choices):
            raise InputError(
                f"factor[{i}].key = {FAULT_KEY!r}: must have distribution = 'categorical', and names of faults as "
                "values"
            )
        if spec.models is not None:
            raise InputError(
                f"factor[{i}].key = {FAULT_KEY!r}: cannot stand beside [models]; name the models as values, such "
                f"as '{spec.models.fault}/{spec.models.compare[0]}'"
            )
        return tuple(str(value) for value in factor.choices)
    return ()


def _only_fault(faults: Mapping[str, Mapping[str, Any]], choice: str) -> dict[str, dict[str, Any]]:
    """Return the table `[faults]` of a scene that has the chosen fault alone.

    Parameters
    ----------
    faults
        The table `[faults]` of the scene.
    choice
        A fault class, or `class/model`.

    Raises
    ------
    InputError
        The class or the model is unknown.
    """
    name, _, model = choice.partition("/")
    known = registry()
    if name not in known:
        raise InputError(f"{choice!r} is no fault{did_you_mean(name, list(known))}")
    if model and model not in known[name]:
        raise InputError(f"{choice!r} is no model of {name}{did_you_mean(model, list(known[name]))}")
    default = next(key for key, cls in known[name].items() if cls.default)
    own = {"model": default, **faults.get(name, {})}
    return {name: own if model in ("", own["model"]) else {"model": model}}


def acting_faults(faults: Mapping[str, Fault], spec: SampleSpec, pose: Pose) -> Sequence[str]:
    """Return the faults that can act in a view.

    Those that need the Sun act as in a dataset: where the view is one of those that face the Sun, and the whole Sun
    is before the camera. A trajectory has no such views, so there the Sun alone decides.
    """
    faces = spec.scene.is_flown or spec.plan.stratum[spec.index] == plan.SUN_FACING
    return [name for name, fault in faults.items() if (pose.sees_sun and faces) or not fault.needs_sun]


# --- scenes ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StudyScene:
    """Hold a scene of a study with its faults, and what identifies its renders."""

    scene: Scene

    @cached_property
    def faults(self) -> dict[str, Fault]:
        """Return the faults of the scene."""
        return {name: from_dict(name, table, source="scene") for name, table in self.scene.faults.items()}

    @cached_property
    def render_key(self) -> str:
        """Return a digest of all that plan and renderer read of the scene."""
        table = self.scene.resolved()
        for key in ("title", "description"):
            table.pop(key)
        table["camera"] = {key: value for key, value in table["camera"].items() if key not in AFTER_RENDER}
        table["faults"] = sorted((name, f.needs_sun, f.lit_by_surroundings) for name, f in self.faults.items())
        return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()


def base_scene(spec: StudySpec) -> Scene:
    """Return the scene of a study without factors. Raises InputError, also for a wrong fault or model."""
    values = {key: value for key, value in spec.scene.overrides.items() if value != {}}
    scene = read_scene(spec.scene.base, values)
    # an empty table, such as that of a fault without keys, adds to the scene what it lacks
    lacking = [key for key in spec.scene.overrides if key not in values and not _table(scene.resolved(), key)]
    if lacking:
        scene = read_scene(spec.scene.base, values | {key: {} for key in lacking})
    largest = max(spec.scene.views)
    if largest >= scene.dataset.samples:
        raise InputError(
            f"scene.samples: sample {largest}: must be below dataset.samples = {scene.dataset.samples} of the "
            f"scene {shown(spec.scene.base)}"
        )
    if spec.models is not None:
        name, known = spec.models.fault, registry()
        if name not in known:
            raise InputError(f"models.fault = {shown(name)}: is unknown{did_you_mean(name, list(known))}")
        if name not in scene.faults:
            raise InputError(f"models.fault = {shown(name)}: the scene {shown(spec.scene.base)} has no such fault")
        for model in spec.models.compare:
            if model not in known[name]:
                raise InputError(
                    f"models.compare: {shown(model)} is unknown{did_you_mean(model, list(known[name]))}"
                )
    return scene


def _table(node: Any, key: str) -> bool:
    """Return whether plain data have a table of a dotted key."""
    for part in key.split("."):
        node = node.get(part) if isinstance(node, dict) else None
    return isinstance(node, dict)


def changed_scene(
    spec: StudySpec, base: Scene, seed: int, model: str = "", changes: Sequence[tuple[str, Any]] = ()
) -> StudyScene:
    """Return the scene of a study with a seed, with a model of the compared fault, and with changed keys."""
    table, own_changes = copy.deepcopy(base.resolved()), dict(changes)
    table["dataset"]["seed"] = seed
    choice = own_changes.pop(FAULT_SCENE_KEY, None)
    if FAULT_KEY in spec.keys:
        table["faults"] = _only_fault(table["faults"], choice) if choice else {}
        table["dataset"] |= {"layers": ["clean"], "mask_any": None}  # other layers may need other faults
    faults = table["faults"]
    if spec.models is not None and model:
        name = spec.models.fault
        own = _fields(name, model)
        faults[name] = {key: v for key, v in faults.get(name, {}).items() if key in own} | {"model": model}
    for key, value in own_changes.items():
        if key.startswith("faults."):
            _, name, own_key = key.split(".", 2)
            if name not in faults or own_key not in _fields(name, faults[name].get("model", "")):
                continue  # another fault or model of the comparison has this key
        tables.replace(table, {key: value}, source=spec.title)
    return StudyScene(parse_scene(table, source=f"study {shown(spec.title)}", overrides=list(own_changes)))


# --- known keys --------------------------------------------------------------------------------------------------


def _scene_keys(spec: StudySpec, scene: Scene) -> list[Key]:
    """Return the keys of the scene; those of faults are the keys of every model in the study."""
    table = scene.resolved()
    found = dict.fromkeys(tables.flat({key: value for key, value in table.items() if key != "faults"}), "")
    for name, fault in table["faults"].items():
        models = [fault.get("model", "")]
        if spec.models is not None and spec.models.fault == name:
            models = list(spec.models.compare)
        for model in models:
            found |= {f"faults.{name}.{key}": unit for key, unit in _fields(name, model).items()}
    keys = [Key(FAULT_KEY, (), _adder("scene", FAULT_SCENE_KEY))]
    return keys + [_table_key("scene", key, unit) for key, unit in found.items()]


def _lens_keys(lens: Prescription) -> list[Key]:
    """Return the keys of a prescription."""
    keys = []
    for row, surface in enumerate(lens.surfaces):
        name = f"lens.surface.{row}"
        if surface.curvature_per_mm:
            keys.append(_change(f"{name}.radius", *_LENGTHS, quantity="radius", row=row))
        if row < len(lens.surfaces) - 1:
            keys.append(_change(f"{name}.thickness", *_LENGTHS, quantity="thickness", row=row))
        if surface.medium.nd != 1.0:
            keys.append(_change(f"{name}.index", "1", quantity="index", row=row))
        keys.append(_change(f"{name}.semi_diameter", *_LENGTHS, quantity="semi_diameter", row=row))
        if surface.coating:
            keys += _coating_keys(f"{name}.coating", row=row)
            for layer in range(len(surface.coating)):
                keys += _coating_keys(f"{name}.coating.{layer}", row=row, layer=layer)
    return [
        *keys,
        *_coating_keys("lens.coating"),
        _change("lens.stop.blades", quantity="blades"),
        _change("lens.stop.blade_rounding", quantity="blade_rounding"),
        _change("lens.stop.rotation_deg", "deg", quantity="rotation_deg"),
        _change("lens.sensor_reflectance", "fraction", quantity="sensor_reflectance"),
        _change("lens.f_number", quantity="f_number"),
    ]


def _coating_keys(name: str, **where: int) -> list[Key]:
    """Return the keys of the layers of a coating."""
    return [
        _change(f"{name}.thickness", "fraction", "nm", quantity="coating_thickness", **where),
        _change(f"{name}.index", "1", quantity="coating_index", **where),
    ]


def _change(name: str, *units: str, **what: Any) -> Key:
    """Return a key that changes the prescription."""

    def add(setting: Setting, value: Any, unit: str) -> None:
        if not isinstance(value, int | float):
            raise InputError(f"{name} = {shown(value)}: must be a number")
        setting.lens.append(Change(value=float(value), relative=unit == "fraction", **what))

    return Key(name, units, add)


def _detector_keys(camera: Camera) -> list[Key]:
    """Return the keys of the detector."""
    if camera.detector.mosaic is None:
        names = list(_OF_THREE_COLOURS)
    else:
        plain = dataclasses.asdict(camera.detector.mosaic.sensor)
        names = list(tables.flat({key: v for key, v in plain.items() if key not in _NOT_OF_A_DETECTOR}))
    return [_table_key("detector", name) for name in names]


def _table_key(kind: str, key: str, unit: str = "") -> Key:
    """Return a key of one of the tables of a setting; by default its ending tells its unit."""
    own = unit or next((u for ending, u in _ENDINGS.items() if key.endswith(ending)), "")
    return Key(f"{kind}.{key}", (own,) if own else (), _adder(kind, key))


def _adder(kind: str, key: str) -> Callable[[Setting, Any, str], None]:
    """Return a function that puts a value into one of the tables of a setting."""
    limits = _SUN_LIMITS.get(key) if kind == "sun" else None

    def add(setting: Setting, value: Any, unit: str) -> None:
        if limits is not None and not limits[0] <= value <= limits[1]:
            raise InputError(f"sun.{key} = {shown(value)}: must be from {limits[0]:g} to {limits[1]:g}")
        getattr(setting, kind)[key] = value

    return add
