"""Compute levels of severity: for each fault model five values of one key that cost navigation the same.

The error is a quantile over views of one metric of navigation. It is measured at some values of the key that the
model's `Fault.severity` names, the same on every view, and joined to a curve that rises with the severity. A level
is the root of this curve minus the wanted error. The views may lie behind several lenses, so that the levels belong
to none of them. The interval of the error comes from a bootstrap over the views.
"""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from ..core.errors import InputError, VbnfaultError, shown
from ..core.files import toml_files
from ..core.files.whole_files import write_whole
from ..core.process.interrupts import interruptible
from ..core.tables import did_you_mean
from ..dataset import BuildOptions
from ..dataset.build import do_tasks
from ..dataset.progress import Progress
from ..faults import LEVELS, ModelLevels, SeverityTable, dataset_order, read_table, registry
from ..lens import load_lens
from ..scene import config
from ..scene.instrument import CameraTable
from ..world import cameras
from . import navigation_metrics
from .severity_views import TRIES, ModelUnderTest, SeverityJob, ViewGroup, ViewWorker

F64 = NDArray[np.float64]

_WITHIN = 0.1  # of the wanted error; a level exists if its error is as near as this
_GRID = 1001  # positions at which the quantile of the curves is computed
_RESAMPLES = 1000
_CONFIDENCE = 0.95
_MOSAIC = "generic_ccd"  # for models that the scene's camera cannot have
_ALL = "all"


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """State what a level means: `metric`, `quantile` over the views, and the errors of the levels, rising.

    `matches_lost` is the default: the fraction of the right feature matches of two views that a fault costs.
    """

    metric: str = "matches_lost"
    quantile: float = 0.5
    errors: tuple[float, ...] = (0.35, 0.45, 0.55, 0.65, 0.8)

    def __post_init__(self) -> None:
        known = [metric.name for metric in navigation_metrics.METRICS if metric.better == "low"]
        if self.metric not in known:
            raise InputError(f"metric = {shown(self.metric)}: must be one of {', '.join(known)}")
        if not 0 <= self.quantile <= 1:
            raise InputError(f"quantile = {self.quantile:g}: must be from 0 to 1")
        if len(self.errors) != LEVELS or not all(
            0 < a < b < np.inf for a, b in zip(self.errors, self.errors[1:], strict=False)
        ):
            raise InputError(f"errors = {list(self.errors)}: must be {LEVELS} rising, finite numbers above 0")


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """State on which views the models are evaluated.

    Attributes
    ----------
    scene
        Path or packaged name. Its faults are left out.
    overrides
        Values that replace those of the scene, by dotted key.
    lenses
        Packaged names or paths of lenses, "" for a thin lens; empty: that of the scene.
    views
        Number of views behind each lens.
    """

    scene: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    lenses: tuple[str, ...] = ()
    views: int = 64


# --- from evaluations to levels ----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class RisingCurve:
    """Hold a quantile over views of an error as a function of severity, which rises.

    It lies nearest to the quantiles at the evaluated values (isotonic regression), and is linear between them.

    Attributes
    ----------
    positions
        float64[value], rising: positions of the evaluated values.
    errors
        float64[view, value]: errors there; nan where a view has none.
    quantile
        The quantile.
    """

    positions: F64
    errors: F64
    quantile: float

    @staticmethod
    def over(by_view: Sequence[Mapping[float, float]], quantile: float) -> RisingCurve | None:
        """Return the curve of views with their errors by position; None where no error is finite."""
        known = sorted({position for view in by_view for position in view})
        positions = np.array(known)
        errors = np.array([[view.get(position, np.nan) for position in known] for view in by_view])
        errors[~np.isfinite(errors)] = np.nan
        has_value = np.isfinite(errors)
        if not has_value.any():
            return None
        errors = errors[np.ix_(has_value.any(axis=1), has_value.any(axis=0))]
        return RisingCurve(positions=positions[has_value.any(axis=0)], errors=errors, quantile=quantile)

    def at(self, positions: F64) -> F64:
        """Return the quantile at positions."""
        return np.asarray(np.interp(positions, self.positions, self._rising))

    @cached_property
    def _rising(self) -> F64:
        """Return the quantile at the evaluated values, made to rise, float64[value]."""
        return np.asarray(isotonic_regression(np.nanquantile(self.errors, self.quantile, axis=0)).x)

    def interval(self, position: float) -> tuple[float, float]:
        """Return the 95 % interval of the quantile at a position, by a bootstrap over the views."""
        after = int(np.clip(np.searchsorted(self.positions, position), 1, max(len(self.positions) - 1, 1)))
        columns = [after - 1, after] if len(self.positions) > 1 else [0]
        resampled = np.stack([_quantiles_of_resamples(self.errors[:, k], self.quantile) for k in columns])
        low, high = self.positions[columns[0]], self.positions[columns[-1]]
        weight = float(np.clip((position - low) / (high - low), 0, 1)) if high > low else 0.0
        return _middle((1 - weight) * resampled[0] + weight * resampled[-1])


def levels_of(
    model: ModelUnderTest,
    by_view: Sequence[Sequence[tuple[float, float]]],
    criterion: Criterion,
    width_px: int,
    detector: str = "",
) -> ModelLevels:
    """Return the levels of one model.

    Parameters
    ----------
    model
        The model.
    by_view
        Value of the severity's key and error of each evaluation, for each view.
    criterion
        What a level means.
    width_px
        Width of the frames.
    detector
        Packaged sensor of the views; "": the scene's.

    Raises
    ------
    VbnfaultError
        No view has a finite error.
    """
    severity = model.severity
    curve = RisingCurve.over(
        [{severity.position(value, width_px): error for value, error in view} for view in by_view],
        criterion.quantile,
    )
    if curve is None:
        raise VbnfaultError(f"{model.name}: {criterion.metric} has no value on any view")
    grid = np.linspace(0, 1, _GRID)
    quantiles = curve.at(grid)
    values = np.full(LEVELS, np.nan)
    reached = np.full((LEVELS, 3), np.nan)  # error, and its interval
    for k, wanted in enumerate(criterion.errors):
        root = severity.value(float(np.interp(wanted, quantiles, grid)), width_px)
        value = model.at(root)[1]  # a whole number is rounded
        position = severity.position(value, width_px)
        error = float(curve.at(np.array(position)))
        if abs(error - wanted) <= _WITHIN * wanted and value not in values:
            values[k], reached[k] = value, (error, *curve.interval(position))
    return ModelLevels(
        key=severity.key,
        values=tuple(float(f"{value:.4g}") for value in values),
        errors=tuple(round(float(error), 4) for error in reached[:, 0]),
        intervals=tuple((round(float(low), 4), round(float(high), 4)) for _, low, high in reached),
        reach=(round(float(quantiles[0]), 4), round(float(quantiles[-1]), 4)),
        views=len(curve.errors),
        detector=detector,
    )


def _quantiles_of_resamples(errors: F64, quantile: float) -> F64:
    """Return the quantile of each resample of the finite errors, float64[resample]; always the same resamples."""
    finite = errors[np.isfinite(errors)]
    rng = np.random.default_rng(0)
    return np.asarray(
        np.quantile(finite[rng.integers(len(finite), size=(_RESAMPLES, len(finite)))], quantile, axis=1)
    )


def _middle(resampled: F64) -> tuple[float, float]:
    """Return the middle 95 % of resampled values."""
    tail = (1 - _CONFIDENCE) / 2
    low, high = np.quantile(resampled, [tail, 1 - tail])
    return float(low), float(high)


# --- the whole table ---------------------------------------------------------------------------------------------


def models_of(
    scene: str, names: Sequence[str] = (), overrides: Mapping[str, Any] | None = None
) -> list[ModelUnderTest]:
    """Return models that have a severity, in the order of the dataset.

    Parameters
    ----------
    scene
        Path or packaged name of a scene, whose keys of a model are kept.
    names
        Names as `vignetting/cos4`, or of classes, of which then all models count, or "all"; empty: the models of
        the scene.
    overrides
        Values that replace those of the scene, by dotted key.

    Raises
    ------
    InputError
        A name is unknown or has no severity, or the scene has no such model.
    """
    tables = config.read_scene(scene, overrides).faults
    known: dict[str, ModelUnderTest] = {}
    of_scene = []
    for fault, models in registry().items():
        for name, cls in models.items():
            table = dict(tables.get(fault, {}))
            is_of_scene = fault in tables and table.pop("model", next(iter(models))) == name
            if cls.severity is None:
                continue
            keys = {k: v for k, v in table.items() if k != cls.severity.key} if is_of_scene else {}
            known[f"{fault}/{name}"] = ModelUnderTest(fault=fault, model=name, keys=keys)
            if is_of_scene:
                of_scene.append(f"{fault}/{name}")
    if not names and not of_scene:
        raise InputError(f"{scene}: none of its faults has a severity; name models, such as vignetting/cos4")
    chosen: set[str] = set(of_scene if not names else ())
    for name in names:
        fits = [key for key in known if name in (_ALL, key, key.partition("/")[0])]
        if not fits:
            raise InputError(f"model {shown(name)}: no such model with a severity{did_you_mean(name, list(known))}")
        chosen.update(fits)
    return [model for key, model in known.items() if key in chosen]


def evaluate_models(
    models: Sequence[ModelUnderTest],
    views: ViewOptions,
    metric: str,
    options: BuildOptions,
    path: Path | None = None,
) -> tuple[SeverityJob, dict[str, str]]:
    """Render the views and evaluate models on them.

    Parameters
    ----------
    models
        The models.
    views
        On which views.
    metric
        Metric of navigation.
    options
        Number of processes and threads, and whether progress is shown.
    path
        File that is made, for messages.

    Returns
    -------
    SeverityJob
        The errors of each model on each view.
    dict
        The packaged sensor by model; "": the scene's own.

    Raises
    ------
    InputError
        The scene cannot be used.
    Interrupted
        After Ctrl-C, SIGTERM or SIGHUP.
    VbnfaultError
        Fewer than half of the views exist.
    """
    camera = config.read_scene(views.scene, views.overrides).camera
    detectors = {model.name: _detector(model, camera) for model in models}
    groups = _groups(models, views, detectors)
    planned = sum(group.count for group in groups)
    job = SeverityJob(path or Path(views.scene), groups, Progress(planned, shown=options.progress, noun="views"))
    workers = partial(ViewWorker, metric)
    with interruptible(lambda: f"{job.path}: interrupted; nothing was written"), job.progress:
        do_tasks(workers, job, replace(options, scheduler=None))
    if 2 * len(job.errors) < planned:
        raise VbnfaultError(
            f"{views.scene}: only {len(job.errors)} of {planned} views have {metric} without faults; take another "
            "scene, or more pixels"
        )
    return job, detectors


def compute_levels(
    models: Sequence[ModelUnderTest],
    views: ViewOptions,
    criterion: Criterion,
    options: BuildOptions | None = None,
    path: Path | None = None,
) -> SeverityTable:
    """Return the levels of models as a table that scenes read. If the file `path` exists, its other models stay.

    Parameters and errors: as `evaluate_models`. Raises InputError, too, if the file was made in another manner.
    """
    camera = config.read_scene(views.scene, views.overrides).camera
    lenses = views.lenses or (camera.lens,)
    table = SeverityTable(
        description="values that cost navigation the same, by fault class and model",
        commands=(_command(models, views, criterion),),
        metric=criterion.metric,
        quantile=criterion.quantile,
        errors=criterion.errors,
        scene=views.scene,
        lenses=lenses,
        width_px=camera.width_px,
        levels={},
    )
    if path is not None:
        merged(path, table)  # refuses another table before the work
    job, detectors = evaluate_models(models, views, criterion.metric, options or BuildOptions(), path)
    levels: dict[str, dict[str, ModelLevels]] = {}
    without: list[VbnfaultError] = []
    for model in models:
        by_view = [view for lens in range(len(lenses)) for view in job.of_lens(lens, model.name)]
        try:
            found = levels_of(model, by_view, criterion, camera.width_px, detectors[model.name])
        except VbnfaultError as error:  # the levels of the other models are not lost
            without.append(error)
            continue
        levels.setdefault(model.fault, {})[model.model] = found
    if not levels:
        raise without[0]
    for reason in without:
        warnings.warn(f"{reason}; it gets no levels", stacklevel=2)
    table = table.model_copy(update={"levels": levels})
    return table if path is None else merged(path, table)


def _command(models: Sequence[ModelUnderTest], views: ViewOptions, criterion: Criterion) -> str:
    """Return the command line that computes levels, without the name of its file."""
    words = ["vbnfault", "severity", views.scene, "--views", str(views.views)]
    words += ["--metric", criterion.metric, "--quantile", f"{criterion.quantile:g}"]
    for model in models:
        words += ["--model", model.name]
    for lens in views.lenses:
        words += ["--lens", lens or "thin"]
    for key, value in views.overrides.items():
        words += ["--set", f"{key}={toml_files.toml_text({'value': value}).partition(' = ')[2].strip()}"]
    return shlex.join(words)


def merged(path: Path, table: SeverityTable) -> SeverityTable:
    """Return a table with the levels of further models from the file `path`, if it exists.

    Raises InputError where the file has levels of another metric, quantile, scene, lens or width.
    """
    if not path.exists():
        return table
    before = read_table(path)
    for name in ("metric", "quantile", "errors", "scene", "lenses", "width_px"):
        old, new = getattr(before, name), getattr(table, name)
        if old != new:
            raise InputError(
                f"{path}: has levels with {name} = {shown(old)}, not {shown(new)}; choose another file"
            )
    levels = {fault: dict(models) for fault, models in before.levels.items()}
    for fault, models in table.levels.items():
        levels.setdefault(fault, {}).update(models)
    ordered = {fault: levels[fault] for fault in dataset_order(levels)}
    return table.model_copy(update={"levels": ordered, "commands": (*before.commands, *table.commands)})


def write_table(path: Path, table: SeverityTable) -> None:
    """Write a table of levels, with `nan` for levels that do not exist."""
    write_whole(path, toml_files.toml_text(table.model_dump(mode="python")))


def lines_of(table: SeverityTable) -> list[str]:
    """Return lines that show a table of levels."""
    lines = [f"{table.metric}, quantile {table.quantile:g} over views: {', '.join(f'{e:g}' for e in table.errors)}"]
    for fault, models in table.levels.items():
        for model, levels in models.items():
            values = ", ".join("none" if np.isnan(value) else f"{value:g}" for value in levels.values)
            lines.append(f"{fault}/{model}: {levels.key} = {values} ({levels.views} views)")
    return lines


def _detector(model: ModelUnderTest, camera: CameraTable) -> str:
    """Return the packaged sensor of a model that the scene's camera cannot have, else ""."""
    cls = model.type
    if cls.needs_mosaic and not camera.detector:
        return _MOSAIC
    if cls.needs_ccd and camera.detector and cameras.mosaic_sensor(camera).architecture == "cmos":
        return _MOSAIC
    return ""


def _groups(models: Sequence[ModelUnderTest], views: ViewOptions, detectors: Mapping[str, str]) -> list[ViewGroup]:
    """Return the groups of views: for each lens, sensor and side of the sky one for each site."""
    scene = config.read_scene(views.scene, views.overrides)
    groups: list[ViewGroup] = []
    first = 0
    for lens, name in enumerate(views.lenses or (scene.camera.lens,)):
        if name:
            load_lens(name)  # a misspelt lens is named before what does not fit to a lens
        fitting = [model for model in models if not (name and model.type.thin_lens_only)]
        kinds = dict.fromkeys((detectors[model.name], model.type.needs_sun) for model in fitting)
        for detector, facing_sun in kinds:
            values = {**views.overrides, "dataset.samples": TRIES * views.views, "camera.lens": name}
            if detector:
                values["camera.detector"] = detector
            chosen = tuple(
                model
                for model in fitting
                if (detectors[model.name], model.type.needs_sun) == (detector, facing_sun)
            )
            sites = min(scene.dataset.sites, views.views)
            for site in range(sites):
                count = views.views // sites + (site < views.views % sites)
                groups.append(
                    ViewGroup(
                        scene=views.scene,
                        overrides=values,
                        lens=lens,
                        facing_sun=facing_sun,
                        site=site,
                        first=first,
                        count=count,
                        models=chosen,
                    )
                )
                first += count
    for model in models:
        if not any(model in group.models for group in groups):
            raise InputError(f"{views.scene}: {model.name} needs a thin lens; add one with --lens thin")
    return groups
