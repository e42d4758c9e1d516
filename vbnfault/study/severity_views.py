"""Measure on rendered views what fault models cost navigation, as a function of their severity.

Each view is a short sequence of images of one site. It is rendered once for all models; all severities of a model
use the same random numbers. A task of a worker process are the views of one site behind one lens.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import navigation
from ..core.errors import VbnfaultError
from ..core.process.interrupts import check
from ..dataset.progress import Progress
from ..dataset.work import Fatal, Job, Tick
from ..faults import Fault, Severity, from_dict, registry
from ..pipeline import Session
from ..pipeline.development import Development
from ..pipeline.injection import fault_context
from ..pipeline.spec import Draw, SampleSpec
from ..pipeline.stages import render_view, resolve
from ..scene import config
from . import navigation_metrics
from .views import CleanView, RenderedView, rendered_sequence

# Evaluations of a model on a view, spaced evenly in position. They are the same on all views, so that a quantile
# over views is one of evaluated errors. Interpolation of each view's curve would even out its steps.
_EVALUATIONS = 21
# Matches of a view's clean twins: of fewer, the fraction that is lost is too coarse.
_FEWEST_MATCHES = 50
# Samples that are tried for each view: some see no lit ground, or too little of it.
TRIES = 8


@dataclass(frozen=True, kw_only=True)
class ModelUnderTest:
    """Name a fault model with the keys that stay as they are.

    `values` are the values of its severity's key at which it is evaluated; empty: they are searched.
    """

    fault: str
    model: str
    keys: Mapping[str, Any]
    values: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Return class and model, as `vignetting/cos4`."""
        return f"{self.fault}/{self.model}"

    @property
    def type(self) -> type[Fault]:
        """Return the class of the model."""
        return registry()[self.fault][self.model]

    @property
    def severity(self) -> Severity:
        """Return the severity of the model."""
        severity = self.type.severity
        assert severity is not None
        return severity

    def at(self, value: float) -> tuple[Fault, float]:
        """Return the fault with a value of the severity's key, and the mean of what is then drawn.

        The value is clipped to the limits of the key, and a whole number is rounded.
        """
        declared = next(f.metadata for f in fields(self.type) if f.name == self.severity.key)
        setting = self.severity.setting(float(np.clip(value, *declared["limits"])), declared)
        table = {"model": self.model, **self.severity.keys, **self.keys, self.severity.key: setting}
        return from_dict(self.fault, table, source=f"severity of {self.name}"), float(np.mean(setting))


@dataclass(frozen=True, kw_only=True)
class ViewGroup:
    """Describe the views of one site behind one lens, `count` of them, and the models evaluated on them.

    Attributes
    ----------
    scene, overrides
        Path or packaged name of the scene, and the values that replace its own.
    lens
        Index of the lens.
    facing_sun
        Whether the whole Sun is before the camera; else the views look away from it.
    site
        Index of the site.
    first
        Number of the first view.
    """

    scene: str
    overrides: Mapping[str, Any]
    lens: int
    facing_sun: bool
    site: int
    first: int
    count: int
    models: tuple[ModelUnderTest, ...]


def faulted(view: CleanView, fault: Fault) -> navigation_metrics.NavigationFrame:
    """Return a view with a fault, drawn by the key of the sample, as the metrics need it."""
    context = fault_context(view.pose, view.rendering, view.exposure)
    development = Development(exposure=view.exposure, context=context, rng=view.spec.rng)
    params = fault.draw(development.context_of(fault, {}), view.spec.rng("fault", f"{fault.fault}/0"))
    image = development.image({fault.fault: Draw(fault=fault, attempt=0, params=params)}).array
    return replace(view.frame, image=image)


def sequences(group: ViewGroup, metric: str, session: Session) -> Iterator[tuple[CleanView, ...]]:
    """Render the views of a group one by one; fewer than its `count` where the scene has no more.

    A view counts if it has a value of the metric without faults, and enough matches where matches are compared.
    """
    needed = navigation_metrics.views_needed([metric])
    made = 0
    for index in np.flatnonzero(session.plan.site == group.site):
        if made == group.count:
            return
        try:
            views = tuple(_views(session.spec(int(index)), needed, group.facing_sun))
        except VbnfaultError:  # no pose, or no track, meets the conditions
            continue
        if views and _counts([view.frame for view in views], metric):
            made += 1
            yield views


def session_of(group: ViewGroup) -> Session:
    """Return the session that renders a group."""
    values = {
        **group.overrides,
        "faults": {},
        "dataset.layers": ["clean"],
        "plan.sun_facing_nominal_fraction": float(group.facing_sun),
        "plan.on_invisible": "drop",
    }
    return Session(config.load_scene(group.scene, values), source=group.scene)


def _views(spec: SampleSpec, count: int, facing_sun: bool) -> Iterator[CleanView]:
    """Render the views of a sequence; none where the Sun should be before the camera, but is not wholly visible."""
    pose = resolve(spec)
    spec = spec.at(pose)
    if facing_sun and not pose.sees_sun:
        return
    first = RenderedView(spec=spec, pose=pose, rendering=render_view(spec, pose))
    for view in rendered_sequence(first, count):
        yield CleanView.of(view, view.spec.camera)


def _counts(frames: Sequence[navigation_metrics.NavigationFrame], metric: str) -> bool:
    """Return whether a sequence without faults has a value of the metric, and enough matches."""
    if not np.isfinite(navigation_metrics.navigation_values(frames, [metric])[metric]):
        return False
    if navigation_metrics.views_needed([metric]) != 2:
        return True
    first, second = frames
    matches = navigation.match(first.clean, second.clean)
    return int(navigation.right_matches(matches, first.view, second.view).sum()) >= _FEWEST_MATCHES


# --- the error as a function of severity -------------------------------------------------------------------------


def error_of(
    fault: Fault, views: Sequence[CleanView], metric: str, clean: navigation_metrics.ViewedImages
) -> float:
    """Return the metric of a sequence of views with a fault; `clean` are their twins without any."""
    frames = [faulted(view, fault) for view in views]
    return navigation_metrics.navigation_values(frames, [metric], clean)[metric]


def measure(model: ModelUnderTest, width_px: int, error: Callable[[Fault], float]) -> list[tuple[float, float]]:
    """Return (value of the severity's key, error) of a model on one view, in the order of evaluation.

    Where the model names no values, they are spaced evenly in position. Whole numbers that come twice are evaluated
    once.
    """
    severity, evaluated = model.severity, dict[float, float]()
    positions = np.linspace(0, 1, _EVALUATIONS)
    for value in model.values or [severity.value(float(position), width_px) for position in positions]:
        fault, mean = model.at(value)
        if mean not in evaluated:
            check()
            evaluated[mean] = error(fault)
    return list(evaluated.items())


# --- work --------------------------------------------------------------------------------------------------------


class ViewWorker:
    """Render the views of groups and evaluate models on them."""

    def __init__(self, metric: str) -> None:
        self._metric = metric
        self._session: tuple[Any, Session] | None = None

    def do(self, task: tuple[ViewGroup, frozenset[int]], tick: Tick) -> None:
        """Evaluate the models on each view of a group but those to skip, and report values and errors as JSON.

        The text is empty for a view that the scene does not have.
        """
        group, skip = task
        try:
            session = self._session_of(group)
        except VbnfaultError as error:  # all views would fail
            raise Fatal(error) from error
        views = sequences(group, self._metric, session)
        for number in range(group.first, group.first + group.count):
            if number in skip:
                continue
            if any(skipped < number for skipped in skip):  # the views of a site are found one after the other
                tick(number, "failed", "left out: an earlier view of its site ended its process")
                continue
            tick(number, "begun", "")
            sequence = next(views, None)
            tick(number, "built", "" if sequence is None else json.dumps(self._errors(group, sequence)))

    def _session_of(self, group: ViewGroup) -> Session:
        """Return the session of a group, which is kept for the next group of its camera."""
        key = group.scene, tuple(sorted(group.overrides.items())), group.facing_sun
        if self._session is None or self._session[0] != key:
            self._session = key, session_of(group)
        return self._session[1]

    def _errors(self, group: ViewGroup, views: Sequence[CleanView]) -> dict[str, list[tuple[float, float]]]:
        """Return the values and errors of each model, by its name."""
        width_px = views[0].spec.scene.camera.width_px
        clean = navigation_metrics.clean_twins([view.frame for view in views])
        return {
            model.name: measure(model, width_px, lambda fault: error_of(fault, views, self._metric, clean))
            for model in group.models
        }


class SeverityJob(Job):
    """Hand out groups of views, and collect the errors of each model on each view."""

    noun, task_noun, item_noun = "command", "group of views", "view"
    most_failures = None  # the views of other groups may still be enough

    def __init__(self, path: Path, groups: Sequence[ViewGroup], progress: Progress) -> None:
        super().__init__(path, progress, dict.fromkeys(range(len(groups)), 0))
        self._groups = groups
        self.errors: dict[int, dict[str, list[tuple[float, float]]]] = {}

    def items(self, number: int) -> Sequence[int]:
        """Return the views of a group."""
        group = self._groups[number]
        return range(group.first, group.first + group.count)

    def task(
        self, number: int, skip: frozenset[int] = frozenset(), *, careful: bool = False
    ) -> tuple[ViewGroup, frozenset[int]]:
        """Return the task that evaluates a group."""
        return self._groups[number], skip

    def keep(self, item: int, text: str) -> None:
        """Record the errors on a view."""
        if text:
            self.errors[item] = json.loads(text)

    def of_lens(self, lens: int, name: str) -> list[list[tuple[float, float]]]:
        """Return the values and errors of a model on each view behind a lens, in the order of the views."""
        return [
            [(value, error) for value, error in self.errors[item][name]]
            for group in self._groups
            if group.lens == lens and name in {model.name for model in group.models}
            for item in range(group.first, group.first + group.count)
            if item in self.errors
        ]
