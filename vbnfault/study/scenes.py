"""Read the scene of a study, and tell which of its renders are the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..core.errors import InputError, shown
from ..core.tables import did_you_mean
from ..faults import Fault, from_dict, registry
from ..scene.config import Scene, load_scene
from .factors import AFTER_RENDER
from .spec import StudySpec


@dataclass(frozen=True)
class StudyScene:
    """Hold a scene of a study, and what identifies its renders."""

    scene: Scene

    @cached_property
    def render_key(self) -> str:
        """Return a digest of all that plan and renderer read of the scene."""
        table = self.scene.resolved()
        for key in ("title", "description"):
            table.pop(key)
        table["camera"] = {key: value for key, value in table["camera"].items() if key not in AFTER_RENDER}
        table["faults"] = sorted(
            (name, fault.needs_sun, fault.lit_by_surroundings) for name, fault in faults_of(self.scene).items()
        )
        return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()


def scene_of(spec: StudySpec) -> Scene:
    """Return the scene of a study without factors."""
    values = {key: value for key, value in spec.scene.overrides.items() if value != {}}
    scene = load_scene(spec.scene.base, values)
    missing: dict[str, Any] = {
        key: {} for key in spec.scene.overrides.keys() - values.keys() if not _has_table(scene, key)
    }
    if missing:
        scene = load_scene(spec.scene.base, values | dict(sorted(missing.items())))
    largest = max(spec.scene.views)
    if largest >= scene.dataset.samples:
        raise InputError(
            f"study {shown(spec.title)}: scene.samples: sample {largest}: must be below dataset.samples = "
            f"{scene.dataset.samples} of the scene {shown(spec.scene.base)}"
        )
    return scene


def _has_table(scene: Scene, key: str) -> bool:
    """Return whether a scene has the table of a dotted key."""
    node: Any = scene.resolved()
    for part in key.split("."):
        node = node.get(part) if isinstance(node, dict) else None
    return isinstance(node, dict)


def check_models(spec: StudySpec, faults: Mapping[str, Any]) -> None:
    """Raise InputError if the fault or a model of the comparison is unknown."""
    assert spec.models is not None
    name, known = spec.models.fault, registry()
    if name not in known:
        raise InputError(f"models.fault = {shown(name)}: is unknown{did_you_mean(name, list(known))}")
    if name not in faults:
        raise InputError(f"models.fault = {shown(name)}: the scene {shown(spec.scene.base)} has no such fault")
    for model in spec.models.compare:
        if model not in known[name]:
            raise InputError(f"models.compare: {shown(model)} is unknown{did_you_mean(model, list(known[name]))}")


def faults_of(scene: Scene) -> dict[str, Fault]:
    """Return the faults of a scene."""
    return {name: from_dict(name, table, source="scene") for name, table in scene.faults.items()}
