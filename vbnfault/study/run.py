"""Evaluate the design of a study in parallel, compute its indices, and write what was found.

Tasks are chunks of consecutive evaluations of one seed and view, so that a worker keeps what a view costs. The
finished evaluations of a chunk are a file of their own, so an interrupted study continues where it stopped. The
results do not depend on the number of workers, on the order of work, or on interruptions.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__
from ..core import tables
from ..core.errors import InputError, VbnfaultError, shown
from ..core.files import file_contents, toml_files, whole_files
from ..core.files.path_checks import check_folder, path_of
from ..core.process.interrupts import interruptible
from ..dataset import BuildOptions
from ..dataset.build import do_tasks
from ..dataset.dask import check_scheduler
from ..dataset.identity import versions
from ..dataset.lock import locked
from ..dataset.progress import Progress, duration_text
from ..dataset.resume import differences
from . import indices as indices_module
from . import results
from .chunks import ChunkWorkers, StudyJob
from .designs import Design, make_design
from .indices import Results
from .spec import Evaluator, EvaluatorFactory, Metric, StudySpec, load_study

if TYPE_CHECKING:
    import pyarrow
    import xarray as xr

_MOST_DIFFERENCES = 5  # named in one message
_MOST_EVALUATIONS_OF_A_PROCESS = 4096  # then it is replaced, as `BuildOptions.recycle_shards` explains


@dataclass(frozen=True, kw_only=True)
class StudySummary:
    """Say what a study did.

    Attributes
    ----------
    indices
        The indices, as in `indices.zarr`.
    evaluations, finished
        Numbers of all evaluations, and of those that existed before.
    seconds
        Duration.
    seconds_by_stage
        Seconds that the evaluators spent in each of their stages, summed over the workers and over all runs of a
        study that was continued.
    warnings
        Sentences on factors that part of the samples do not read, and on half-widths that were missed.
    """

    path: Path
    indices: xr.Dataset
    evaluations: int
    finished: int
    seconds: float
    seconds_by_stage: Mapping[str, float]
    warnings: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return lines that say what was done."""
        made = self.evaluations - self.finished
        lines = [f"{self.path}: {self.evaluations} evaluations, {self.finished} of them finished before"]
        if made:
            lines.append(f"{made} evaluations in {duration_text(self.seconds)}")
        stages = sorted(self.seconds_by_stage.items(), key=lambda stage: -stage[1])
        if stages:
            listed = ", ".join(f"{name} {duration_text(seconds)}" for name, seconds in stages)
            lines.append(f"time by stage, summed over workers and runs: {listed}")
        if "ST_interval" in self.indices:
            widest = float(indices_module.half_widths(self.indices).max())
            if math.isfinite(widest):
                lines.append(f"half-widths of the total indices: at most {widest:.3g}")
        return lines


def study(
    study: StudySpec | str | Path,
    out: str | os.PathLike[str] | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    evaluator: EvaluatorFactory | None = None,
    workers: int = 1,
    threads: int | None = None,
    scheduler: str | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Run a sensitivity study and return its indices; an interrupted study with the same `out` is continued.

    Parameters
    ----------
    study : StudySpec, str or Path
        A study, the path of a study file, or the name of a packaged study.
    out : str or Path, optional
        Folder for the table, the indices, the report and its figures; by default nothing is kept.
    overrides : mapping, optional
        Values that replace those of the file, by dotted key, such as `{"design.n": 8}`.
    evaluator : callable, optional
        Makes, from the study, the object that evaluates its points (`vbnfault.study.spec.Evaluator`). It must be
        picklable with several workers. By default the points are images of the study's scene.
    workers : int
        Number of processes on this machine, 1 to 1024. With 1, this process does the work.
    threads : int, optional
        Render threads of each worker process; by default the processor's cores are divided equally.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers do the work instead. They must have access to `out`.
    progress : bool
        Show the progress on standard error.

    Returns
    -------
    xarray.Dataset
        Indices by metric, model and factor, with intervals; see `vbnfault.study.indices`.

    Raises
    ------
    InputError
        If the study file is wrong, `out` is no path, or it holds another study.
    StudyFailed
        If evaluations failed; its attribute `indices` has the indices without them.
    Interrupted
        After Ctrl-C, SIGTERM or SIGHUP; the same call continues.
    VbnfaultError
        If the files cannot be written, or the cluster fails.
    """
    options = BuildOptions(workers=workers, threads=threads, scheduler=scheduler, progress=progress)
    if out is not None:
        return run_study(study, path_of(out, "out"), options, overrides=overrides, evaluator=evaluator).indices
    with tempfile.TemporaryDirectory(prefix="vbnfault-study-") as folder:
        path = Path(folder) / "study"
        return run_study(study, path, options, overrides=overrides, evaluator=evaluator, report=False).indices


def run_study(
    study: StudySpec | str | Path,
    path: Path,
    options: BuildOptions,
    *,
    overrides: Mapping[str, Any] | None = None,
    evaluator: EvaluatorFactory | None = None,
    report: bool = True,
) -> StudySummary:
    """Run or continue the study in the folder `path`, as `study` describes, and say what was done.

    `report`: whether to draw the figures and write the page, too.
    """
    plan = _plan(study, overrides, evaluator)
    spec, design, metrics, contents, made = plan.spec, plan.design, plan.metrics, plan.contents, plan.evaluator
    if options.scheduler is not None:
        check_scheduler(options.scheduler)
    began = time.monotonic()
    with interruptible(lambda: _interrupted(path, design)), locked(path):
        _prepare_folder(path, spec, plan.identity)
        job = StudyJob(path, design, Progress(len(design), shown=options.progress, noun="evaluations"))
        names = tuple(metric.name for metric in metrics)
        workers = ChunkWorkers(plan.factory, spec, path.absolute(), names, contents)
        checked = _evaluate(workers, made, job, options)
        outcomes, seconds = job.outcomes(), job.seconds_by_stage()
        data = _indices(Results(design, metrics, _values(design, metrics, outcomes)))
        data.attrs["timings"] = json.dumps(seconds)
        with whole_files.writing(path, within=True):
            table = results.write_table(path / results.TABLE, design, metrics, outcomes)
            results.write_indices(path / results.INDICES, data)
            if report:
                with contents.in_use():
                    _write_report(path, data, table, spec, made)
        missed = _missed_half_widths(spec, data)
        _warn(missed)
        job.raise_failures(
            of=f" of {len(design)}",
            kept="all others are in the table, and the indices leave out incomplete base samples",
            indices=data,
        )
    return StudySummary(
        path=path,
        indices=data,
        evaluations=len(design),
        finished=job.finished,
        seconds=time.monotonic() - began,
        seconds_by_stage=seconds,
        warnings=(*checked, *missed),
    )


def describe_study(study: StudySpec | str | Path, *, overrides: Mapping[str, Any] | None = None) -> list[str]:
    """Return lines that say what a study of a scene would do. Nothing is evaluated or written.

    Raises InputError where the study, its scene, a factor or a metric is wrong. Whether the images of the scene
    read every factor is found only when the study runs.
    """
    plan = _plan(study, overrides, None)
    spec = plan.spec
    seeds, views, points, models = plan.design.shape
    counts = [(points, "point"), (views, "view"), (seeds, "seed"), (models, "model")]
    product = " × ".join(f"{count} {noun}{'s' if count > 1 else ''}" for count, noun in counts)
    factors = [_with_unit(factor.key, factor.unit) for factor in spec.factors]
    metrics = [_with_unit(metric.name, metric.unit) for metric in plan.metrics]
    return [
        f"{spec.title}: {spec.description}" if spec.description else spec.title,
        f"{spec.design.method}, n = {spec.design.n}: {product} = {len(plan.design)} evaluations",
        f"factors: {', '.join(factors)}",
        f"metrics: {', '.join(metrics)}",
        *(f"warning: {sentence}" for sentence in _too_few(spec)),
    ]


def _with_unit(name: str, unit: str) -> str:
    """Return a name, and its unit where it has one."""
    return name if unit in ("", "1") else f"{name} ({unit})"


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """Hold what is known of a study before its first evaluation; `evaluator` is that of this process."""

    spec: StudySpec
    factory: EvaluatorFactory
    design: Design
    evaluator: Evaluator
    metrics: tuple[Metric, ...]
    contents: file_contents.Contents
    identity: Mapping[str, Any]


def _plan(
    study: StudySpec | str | Path, overrides: Mapping[str, Any] | None, evaluator: EvaluatorFactory | None
) -> _Plan:
    """Return the checked study with its design and the evaluator of this process. Raises InputError."""
    spec = study if isinstance(study, StudySpec) else load_study(study, overrides)
    source = spec.title if isinstance(study, StudySpec) else str(study)
    factory = evaluator or _scene_evaluator()
    _check_half_width(spec, source)
    design = make_design(spec)
    contents = file_contents.Contents()
    with contents.in_use(), file_contents.noting() as digests:
        made = factory(spec)
    metrics = _chosen_metrics(made, spec, source)
    return _Plan(
        spec=spec,
        factory=factory,
        design=design,
        evaluator=made,
        metrics=metrics,
        contents=contents,
        identity=_identity(spec, factory, metrics, digests),
    )


def recompute(folder: str | Path) -> xr.Dataset:
    """Compute the indices and the report of a finished study again from its table, without any evaluation.

    This brings the estimators of another version of vbnfault to a study. The images of `folder` stay.

    Parameters
    ----------
    folder : str or Path
        Folder of a study that was run to its end.

    Returns
    -------
    xarray.Dataset
        The indices, as `study` returns them.

    Raises
    ------
    InputError
        If the folder holds no finished study, or one with the points of another version of vbnfault.
    """
    path = Path(folder)
    spec = load_study(path / "study.toml")
    table, before = results.read_table(path), results.open_indices(path)
    design = make_design(spec)
    if not results.holds_design(table, design):
        raise InputError(f"{path / results.TABLE}: its points are not those of {path / 'study.toml'}")
    metrics = results.metrics_of(before)
    values = np.stack([table[metric.name].to_numpy() for metric in metrics], axis=-1)
    data = _indices(Results(design, metrics, values.reshape(*design.shape, len(metrics))))
    data.attrs["timings"] = before.attrs["timings"]
    with locked(path), whole_files.writing(path, within=True):
        results.write_indices(path / results.INDICES, data)
        _write_report(path, data, table, spec)
    return data


def _scene_evaluator() -> EvaluatorFactory:
    """Return the evaluator of images."""
    from .evaluate import SceneEvaluator

    return SceneEvaluator


# --- before the evaluations -----------------------------------------------------------------------------------


def _chosen_metrics(evaluator: Evaluator, spec: StudySpec, source: str) -> tuple[Metric, ...]:
    """Return the metrics that the study names. Raises InputError if the evaluator lacks one."""
    known = {metric.name: metric for metric in evaluator.metrics}
    for name in spec.metrics.names:
        if name not in known:
            raise InputError(
                f"{source}: metrics.names: unknown metric {shown(name)}{tables.did_you_mean(name, list(known))}"
            )
    for name in (*spec.keys, *spec.metrics.names):
        if name in results.COLUMNS or (name in spec.keys and name in spec.metrics.names):
            raise InputError(f"{source}: {shown(name)}: the table of the study has another column of this name")
    return tuple(known[name] for name in spec.metrics.names)


def _check_half_width(spec: StudySpec, source: str) -> None:
    """Raise InputError if the study asks for a half-width that no study of this size has."""
    n, asked, least = spec.design.n, spec.design.half_width, indices_module.LEAST_SAMPLES_OF_INTERVALS
    if asked is not None and n < least and asked < 0.5:
        raise InputError(
            f"{source}: design.n = {n}: too few samples for half_width = {asked:g}, which needs at least "
            f"n = {least}, and more where the metric is no smooth function of the factors; design.half_width = 0 "
            "asks for none"
        )


def _identity(
    spec: StudySpec, factory: EvaluatorFactory, metrics: Sequence[Metric], digests: Sequence[str]
) -> dict[str, Any]:
    """Return what a folder must have in common with a study that continues it, as plain data."""
    function: Any = factory.func if isinstance(factory, partial) else factory
    name = getattr(function, "__qualname__", type(function).__qualname__)
    return {
        "study": spec.resolved(),
        "evaluator": f"{function.__module__}.{name}",
        "metrics": {metric.name: metric.unit for metric in metrics},
        "input_files": sorted(set(digests)),
        "versions": versions(),
    }


def _prepare_folder(path: Path, spec: StudySpec, identity: Mapping[str, Any]) -> None:
    """Make the folder of a study, or check that it holds this study. Raises InputError."""
    record = path / "identity.json"
    with whole_files.writing(path, within=True):
        check_folder(path)
        if path.is_dir() and not record.exists():
            own = {"rows", "study.toml", *(file.name for file in results.partial_files(path))}  # of a begun study
            if any(entry.name not in own for entry in path.iterdir()):
                raise InputError(
                    f"{path}: holds something else than a study of vbnfault, so it is left alone; choose another "
                    "--out"
                )
        path.mkdir(parents=True, exist_ok=True)
        whole_files.own_folder(path / "rows")
        if record.exists():
            try:
                stored = json.loads(record.read_text(encoding="utf-8"))
            except ValueError:
                raise InputError(f"{record}: not the record of a study; choose another --out") from None
            different = list(differences(stored, json.loads(json.dumps(identity))))
            if different:
                named = [
                    one._replace(key=one.key.removeprefix("study.")).text("there", "here")
                    for one in different[:_MOST_DIFFERENCES]
                ]
                more = [f"and {len(different) - len(named)} more"] if len(different) > len(named) else []
                raise InputError(f"{path}: holds another study: {', '.join(named + more)}; choose another --out")
        for partial_file in results.partial_files(path):
            whole_files.remove(partial_file)
        if not record.exists():
            whole_files.write_whole(whole_files.own(path / "study.toml"), toml_files.toml_text(spec.resolved()))
            whole_files.write_whole(whole_files.own(record), json.dumps(identity, indent=1))


# --- evaluations ----------------------------------------------------------------------------------------------


def _evaluate(source: ChunkWorkers, evaluator: Evaluator, job: StudyJob, options: BuildOptions) -> tuple[str, ...]:
    """Do all chunks on a cluster, here, or in worker processes, and return the warnings of the evaluator."""
    warnings = tuple(_too_few(source.spec))
    if job.finished < len(job.design):
        with source.contents.in_use():
            warnings += tuple(evaluator.check() or ())
    _warn(warnings)
    with job.progress:
        here = partial(source.with_evaluator, evaluator)
        do_tasks(source, job, options, here, recycle=_MOST_EVALUATIONS_OF_A_PROCESS // job.chunk_size)
    return warnings


def _interrupted(path: Path, design: Design) -> str:
    """Return the sentence that says how many evaluations are finished after an interruption."""
    done = StudyJob(path, design, Progress(len(design), shown=False)).finished
    return f"{path}: interrupted; {done} of {len(design)} evaluations are finished, and the same command continues"


def _warn(sentences: Sequence[str]) -> None:
    """Print warnings to standard error."""
    for sentence in sentences:
        print(f"warning: {sentence}", file=sys.stderr)


# --- after the evaluations ------------------------------------------------------------------------------------


def _values(design: Design, metrics: Sequence[Metric], outcomes: Sequence[Mapping[str, Any]]) -> Any:
    """Return the values of all evaluations, float64[seed, view, row, model, metric]."""
    values = [[outcome["values"].get(metric.name, np.nan) for metric in metrics] for outcome in outcomes]
    return np.array(values, dtype=np.float64).reshape(*design.shape, len(metrics))


def _indices(found: Results) -> xr.Dataset:
    """Return the indices with the attributes of the study."""
    data = indices_module.compute(found)
    spec = found.design.spec
    return data.assign_attrs(
        title=spec.title,
        description=spec.description,
        **{f"design_{key}": value for key, value in spec.resolved()["design"].items()},
        evaluations=len(found.design),
        formulae=(indices_module.__doc__ or "").strip(),
        versions=json.dumps(versions()),
        source=f"vbnfault {__version__}",
    )


def _write_report(
    path: Path, data: xr.Dataset, table: pyarrow.Table, spec: StudySpec, evaluator: Evaluator | None = None
) -> None:
    """Write the figures and the page of a study; its extreme images, too, with an evaluator, unless one fails."""
    from .report import write_images, write_report  # loads matplotlib
    from .summaries import StudyResults

    found = StudyResults(dataset=data, table=table, spec=spec.resolved())
    try:
        write_images(path, found, evaluator)
    except VbnfaultError as error:
        print(f"warning: {path}: no images of best and worst values: {error}", file=sys.stderr)
    write_report(path, found)


def _too_few(spec: StudySpec) -> Iterator[str]:
    """Yield sentences on what a design with few points cannot tell."""
    n, method, least = spec.design.n, spec.design.method, indices_module.LEAST_SAMPLES_OF_INTERVALS
    if method in ("sobol", "latin_hypercube") and n < least:
        yield f"design.n = {n}: below n = {least} intervals of indices are 0 to 1: so few points tell nothing"
    if method == "latin_hypercube" and n < (of_delta := indices_module.LEAST_SAMPLES_OF_DELTA):
        yield f"design.n = {n}: delta needs n = {of_delta}, so this study gives none"


def _missed_half_widths(spec: StudySpec, data: xr.Dataset) -> list[str]:
    """Return one sentence on each metric and model whose total indices are less certain than the study asks."""
    asked = spec.design.half_width
    if asked is None:
        return []
    sentences = []
    for metric in data["metric"].values:
        for model in data["model"].values:
            widths = indices_module.half_widths(data.sel(metric=[metric], model=[model])).squeeze(
                ("metric", "model")
            )
            if not (widths > asked).any():
                continue
            factor, reached = str(widths.idxmax().item()), float(widths.max())
            needed = indices_module.needed_samples(spec.design.n, reached, asked)
            of_model = f" with model {model}" if model else ""
            sentences.append(
                f"{metric}{of_model}: the total index of {factor} has a half-width of {reached:.3g}, more than "
                f"half_width = {asked:g}; at most about design.n = {needed} would be needed"
            )
    return sentences
