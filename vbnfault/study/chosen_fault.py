"""Let a factor choose which fault acts: the key `scene.fault`, whose values name fault classes or their models.

    [[factor]]
    key = "scene.fault"
    distribution = "categorical"
    values = ["dust_on_optics", "broken_lines", "straylight/traced"]

A value is the name of a class, or `class/model`. The bounds of its draws are those of the scene's table
`[faults.<class>]` where the scene has one with this model, otherwise the model's own. Each evaluation has this
fault alone, so that it compares with the clean twin of the same view. A fault that cannot act in a view, such as
straylight with the Sun behind the camera, gives no value there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..core.errors import InputError
from ..core.tables import did_you_mean
from ..faults import Fault, registry
from ..pipeline.spec import Pose, SampleSpec
from ..scene import plan
from .distributions import Categorical
from .spec import StudySpec

KEY = "scene.fault"
SCENE_KEY = "fault"  # the same among the keys of a scene


def choices(spec: StudySpec) -> tuple[str, ...]:
    """Return the faults among which a factor of the study chooses; none where it has no such factor.

    Raises
    ------
    InputError
        The factor is no choice of names, or the study compares models, too.
    """
    for i, factor in enumerate(spec.factors):
        if factor.key != KEY:
            continue
        if not isinstance(factor, Categorical) or not all(isinstance(value, str) for value in factor.choices):
            raise InputError(
                f"factor[{i}].key = {KEY!r}: must have distribution = 'categorical', and names of faults as values"
            )
        if spec.models is not None:
            raise InputError(
                f"factor[{i}].key = {KEY!r}: cannot stand beside [models]; name the models as values, such as "
                f"'{spec.models.fault}/{spec.models.compare[0]}'"
            )
        return tuple(str(value) for value in factor.choices)
    return ()


def table_of(faults: Mapping[str, Mapping[str, Any]], choice: str) -> dict[str, dict[str, Any]]:
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


def acting(faults: Mapping[str, Fault], spec: SampleSpec, pose: Pose) -> Sequence[str]:
    """Return the faults that can act in a view.

    Those that need the Sun act as in a dataset: where the view is one of those that face the Sun, and the whole Sun
    is before the camera. A trajectory has no such views, so there the Sun alone decides.
    """
    ahead = pose.sun_visible_fraction == 1 and float(pose.L_from_C[:, 2] @ pose.sun_L) > 0
    faces = spec.scene.is_flown or spec.plan.stratum[spec.index] == plan.SUN_FACING
    return [name for name, fault in faults.items() if (ahead and faces) or not fault.needs_sun]
