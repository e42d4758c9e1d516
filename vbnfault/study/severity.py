"""Compute levels of severity: for each fault model five values of one key that cost navigation the same.

The error is a quantile over views of one metric of navigation. Each model's error rises with the key that its
`Fault.severity` names; the value with the wanted error is searched by bisection. All values of a model are
evaluated on the same views with the same random numbers, so the error changes by the key alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.optimize import isotonic_regression

from ..core.errors import InputError, VbnfaultError
from ..faults import LEVELS, Fault, registry
from ..pipeline import Session
from ..pipeline.development import Development
from ..pipeline.injection import fault_context
from ..pipeline.spec import Draw, Pose, Rendering, SampleSpec, SceneExposure
from ..pipeline.stages import add_stars, meter, render_view, resolve
from ..scene import config
from . import navigation_metrics

# Severities at which a model is evaluated first, and halvings of the interval around a level.
_COARSE = 7
_WITHIN = 0.2  # of the wanted error; a level is reached if its error is as near as this
_BISECTIONS = 6
_NEAR = 0.05  # of the wanted error; nearer than this, the search ends


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """State what a level means: `metric`, `quantile` over the views, and the errors of the levels, rising.

    `matches_lost` is the default: the fraction of the right feature matches of two views that a fault costs.
    """

    metric: str = "matches_lost"
    quantile: float = 0.5
    errors: tuple[float, ...] = (0.15, 0.3, 0.45, 0.6, 0.75)

    def __post_init__(self) -> None:
        known = [metric.name for metric in navigation_metrics.METRICS if metric.better == "low"]
        if self.metric not in known:
            raise InputError(f"metric = {self.metric!r}: must be one of {', '.join(known)}")
        if not 0 <= self.quantile <= 1:
            raise InputError(f"quantile = {self.quantile:g}: must be from 0 to 1")
        if len(self.errors) != LEVELS or not all(
            0 < a < b for a, b in zip(self.errors, self.errors[1:], strict=False)
        ):
            raise InputError(f"errors = {list(self.errors)}: must be {LEVELS} rising numbers above 0")


@dataclass(frozen=True, kw_only=True)
class Levels:
    """Hold the levels of one model: the values of `key`, mildest first, and the error of each.

    Both are NaN where no value has an error within 20 % of the level's: where the model reaches no such error, or
    where the steps of a whole number are too coarse.
    """

    fault: str
    model: str
    key: str
    values: tuple[float, ...]
    errors: tuple[float, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """Hold one view of a sequence as far as no fault changes it."""

    spec: SampleSpec
    pose: Pose
    rendering: Rendering
    exposure: SceneExposure
    clean: np.ndarray[Any, np.dtype[np.uint8]]

    def frame(self, fault: Fault | None) -> navigation_metrics.NavigationFrame:
        """Return the view with a fault, drawn by the key of the sample; None: without any."""
        image = self.clean
        if fault is not None:
            development = self.development()
            context = development.context_of(fault, {})
            params = fault.draw(context, self.spec.rng("fault", f"{fault.fault}/0"))
            image = development.image({fault.fault: Draw(fault=fault, attempt=0, params=params)}).array
        return navigation_metrics.navigation_frame(
            self.pose, self.rendering.truth, self.spec.camera, self.clean, image
        )

    def development(self) -> Development:
        """Return what develops images of this view."""
        context = fault_context(self.pose, self.rendering, self.exposure)
        return Development(exposure=self.exposure, context=context, rng=self.spec.rng)


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewSet:
    """Hold short sequences of views, rendered once, on which models are evaluated."""

    sequences: tuple[tuple[_View, ...], ...]
    criterion: Criterion = field(default_factory=Criterion)

    def error(self, fault: Fault) -> float:
        """Return the criterion's quantile over the views of its metric with a fault; NaN where no view has one."""
        values = [_value([view.frame(fault) for view in views], self.criterion.metric) for views in self.sequences]
        finite = [value for value in values if np.isfinite(value)]
        return float(np.quantile(finite, self.criterion.quantile)) if finite else float("nan")


def _value(frames: Sequence[navigation_metrics.NavigationFrame], metric: str) -> float:
    """Return one metric of a sequence."""
    return navigation_metrics.navigation_values(frames, [metric])[metric]


def view_set(
    scene: str,
    count: int,
    *,
    criterion: Criterion | None = None,
    facing_sun: bool = False,
    overrides: Mapping[str, Any] | None = None,
) -> ViewSet:
    """Render views of a scene, each with as many further views of its site as the metric needs.

    Parameters
    ----------
    scene
        Path or packaged name. Its faults are left out.
    count
        Number of views.
    criterion
        The metric.
    facing_sun
        True: views with the whole Sun before the camera; False: views that look away from it.
    overrides
        Values that replace those of the scene, by dotted key.

    Raises
    ------
    VbnfaultError
        Fewer than half of the samples have a view and a value of the metric.
    """
    criterion = criterion or Criterion()
    values = {
        **(overrides or {}),
        "faults": {},
        "dataset.samples": 4 * count,
        "dataset.layers": ["clean"],
        "plan.sun_facing_nominal_fraction": float(facing_sun),
        "plan.on_invisible": "drop",
    }
    session = Session(config.load_scene(scene, values), source=scene)
    needed = navigation_metrics.views_needed([criterion.metric])
    sequences: list[tuple[_View, ...]] = []
    for index in range(4 * count):
        try:
            views = tuple(_views(session.spec(index), needed, facing_sun))
        except VbnfaultError:  # no pose, or no track, meets the conditions
            continue
        frames = [view.frame(None) for view in views]
        if frames and np.isfinite(
            navigation_metrics.navigation_values(frames, [criterion.metric])[criterion.metric]
        ):
            sequences.append(views)
        if len(sequences) == count:
            return ViewSet(sequences=tuple(sequences), criterion=criterion)
    if 2 * len(sequences) < count:
        raise VbnfaultError(
            f"{scene}: only {len(sequences)} of {4 * count} samples have a value of {criterion.metric} without "
            "faults; take another scene, or more pixels"
        )
    return ViewSet(sequences=tuple(sequences), criterion=criterion)


def _views(spec: SampleSpec, count: int, facing_sun: bool) -> Iterator[_View]:
    """Render the views of a sequence; none where the Sun should be before the camera, but is not wholly visible."""
    pose = resolve(spec)
    if facing_sun and not (pose.sun_visible_fraction == 1 and pose.L_from_C[:, 2] @ pose.sun_L > 0):
        return
    rendering = render_view(spec, pose)
    for k, at in enumerate(navigation_metrics.sequence(spec, pose, rendering, count)):
        here = navigation_metrics.spec_of_view(spec, k)
        seen = rendering if k == 0 else render_view(here, at)
        exposure = add_stars(here, at, seen, meter(here, seen))
        development = Development(exposure=exposure, context=fault_context(at, seen, exposure), rng=here.rng)
        yield _View(spec=here, pose=at, rendering=seen, exposure=exposure, clean=development.image({}).array)


@dataclass(frozen=True, kw_only=True, eq=False)
class RisingCurve:
    """Hold the rising curve nearest to some evaluations of an error, float64[n] each, both rising."""

    positions: np.ndarray[Any, np.dtype[np.float64]]
    errors: np.ndarray[Any, np.dtype[np.float64]]

    @staticmethod
    def through(evaluated: Mapping[float, float]) -> RisingCurve:
        """Return the curve by isotonic regression of position → error; each block lies at its mean position."""
        order = sorted(position for position, error in evaluated.items() if np.isfinite(error))
        if not order:
            return RisingCurve(positions=np.zeros(1), errors=np.zeros(1))
        fit = isotonic_regression([evaluated[position] for position in order])
        ends = fit.blocks
        middle = [float(np.mean(order[start:end])) for start, end in itertools.pairwise(ends)]
        return RisingCurve(positions=np.array(middle), errors=np.asarray(fit.x)[ends[:-1]])

    def position(self, error: float) -> float:
        """Return the position with an error, the first or the last one where the curve does not reach it."""
        return float(np.interp(error, self.errors, self.positions))

    def error(self, position: float) -> float:
        """Return the error at a position."""
        return float(np.interp(position, self.positions, self.errors))


def levels_of(
    model: type[Fault],
    views: ViewSet,
    *,
    table: Mapping[str, Any] | None = None,
    said: Callable[[str], None] = print,
) -> Levels:
    """Return the levels of one model, by bisection of its severity on the same views and random numbers.

    The values of the levels are read from the rising curve that comes nearest to all evaluations, since the error
    of a few views is noisy. The error is evaluated at seven severities, evenly spaced in the logarithm of the key.
    Noise of the metric may make it fall a little; the search takes its running maximum as the rising curve, and
    bisects the interval in which that passes the error of a level.

    Parameters
    ----------
    model
        A fault model with `severity`.
    views
        Where it is evaluated.
    table
        Further keys of the fault.
    said
        Gets a sentence on each evaluation.

    Raises
    ------
    InputError
        The model has no severity, or the table is wrong.
    """
    severity = model.severity
    if severity is None:
        raise InputError(f"{model.fault}/{model.model}: has no severity; declare its key in the class")
    declared = next(f.metadata for f in fields(model) if f.name == severity.key)
    known: dict[float, float] = {}

    def value(position: float) -> float | int:
        return severity.value(position, integer=bool(declared.get("integer")))

    def error(position: float) -> float:
        at = value(position)
        if at not in known:
            fault = model(**{**(table or {}), severity.key: at})
            fault.validate()
            known[at] = views.error(fault)
            said(f"{model.fault}/{model.model}: {severity.key} = {at:g}: {known[at]:.4f}")
        return known[at]

    positions = np.linspace(0, 1, _COARSE)
    rising = np.fmax.accumulate([error(position) for position in positions])
    for wanted in views.criterion.errors:
        above = np.flatnonzero(rising >= wanted)
        low, high = (positions[max(above[0] - 1, 0)], positions[above[0]]) if len(above) else (1.0, 1.0)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            if abs(error(middle) - wanted) <= _NEAR * wanted:
                break
            low, high = (low, middle) if error(middle) >= wanted else (middle, high)
    curve = RisingCurve.through({severity.position(at): found for at, found in known.items()})
    values: list[float] = []
    errors: list[float] = []
    for wanted in views.criterion.errors:
        at = value(curve.position(wanted))
        reached = curve.error(severity.position(at))
        missed = abs(reached - wanted) > _WITHIN * wanted or at in values
        values.append(float("nan") if missed else at)
        errors.append(float("nan") if missed else reached)
    return Levels(
        fault=model.fault, model=model.model, key=severity.key, values=tuple(values), errors=tuple(errors)
    )


def write_levels(path: str | Path, levels: Sequence[Levels], criterion: Criterion, scene: str, views: int) -> None:
    """Write levels as the table that scenes read by the key `severity` of a fault."""
    table: dict[str, Any] = {
        "description": "values that cost navigation the same, by fault class and model; made by "
        "benchmarks/severity_levels.py",
        "metric": criterion.metric,
        "quantile": criterion.quantile,
        "errors": list(criterion.errors),
        "scene": scene,
        "views": views,
        "levels": {},
    }
    for entry in levels:
        table["levels"].setdefault(entry.fault, {})[entry.model] = {
            "key": entry.key,
            "values": list(entry.values),
            "errors": [round(error, 4) for error in entry.errors],
        }
    Path(path).write_text(tomli_w.dumps(table), encoding="utf-8")


def models_with_severity() -> list[type[Fault]]:
    """Return the registered models that have a severity, in the order of the dataset."""
    return [model for models in registry().values() for model in models.values() if model.severity is not None]
