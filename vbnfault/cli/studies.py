"""Define the commands of sensitivity studies."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from ..core.files.whole_files import writing
from .app import app
from .options import (
    MOST_PROCESSES,
    SceneArgument,
    check_image_path,
    grouped,
    local_path,
    number,
    overrides,
    replaced,
    whole,
)

_PANEL = "Studies"


@app.command(rich_help_panel=_PANEL)
def study(
    name: Annotated[
        str, typer.Argument(help="Path of a study file, or name of a packaged study.", metavar="STUDY")
    ],
    out: Annotated[Path, local_path("Folder for the results, to make or to continue.")],
    workers: Annotated[int, whole(1, MOST_PROCESSES, "Number of processes.")] = 1,
    threads: Annotated[
        int | None,
        whole(1, MOST_PROCESSES, "Number of render threads of each process.", unset="all cores, divided equally"),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Address of a Dask scheduler whose workers evaluate, such as tcp://host:8786."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option(help="Check the study and say how much it would evaluate, but evaluate nothing.")
    ] = False,
    settings: Annotated[
        list[str] | None,
        replaced("study", "design.n=8 or scene.camera.width_px=128"),
    ] = None,
) -> None:
    """Run a sensitivity study: which parameters drive each metric, with confidence intervals, and how much the
    choice of the model matters. The same command continues an interrupted study.
    """
    from ..dataset import BuildOptions
    from ..study.run import describe_study, run_study

    if dry_run:
        for line in describe_study(name, overrides=overrides(settings)):
            typer.echo(line)
        return
    options = BuildOptions(workers=workers, threads=threads, scheduler=scheduler)
    for line in run_study(name, out, options, overrides=overrides(settings)).lines():
        typer.echo(line)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _SeverityOptions:
    """Hold the options of `severity` on what is tested on which views."""

    models: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            metavar="NAME",
            help="Fault class, model as vignetting/cos4, or all; may be repeated.",
            show_default="the scene's",
        ),
    ] = None
    lenses: Annotated[
        list[str] | None,
        typer.Option(
            "--lens",
            metavar="LENS",
            help="Lens of the views: a prescription's path or packaged name, or thin; may be repeated.",
            show_default="the scene's",
        ),
    ] = None
    views: Annotated[int, whole(1, 100_000, "Number of views behind each lens.")] = 64
    settings: Annotated[
        list[str] | None,
        replaced("scene", "camera.width_px=256"),
    ] = None


@app.command(rich_help_panel=_PANEL)
@grouped
def severity(
    scene: SceneArgument,
    out: Annotated[Path, local_path("TOML file to write.")],
    tested: _SeverityOptions,
    metric: Annotated[str, typer.Option(help="Metric of navigation that is the error.")] = "matches_lost",
    quantile: Annotated[float, number(0, 1, "Quantile of the error over the views.")] = 0.5,
    workers: Annotated[int, whole(1, MOST_PROCESSES, "Number of processes.")] = 1,
) -> None:
    """Compute levels of severity: for each fault model five values that cost navigation the same. A scene reads
    them by `severity.file`, and `severity = 3` in the table of a fault. Models that the file has
    already stay in it.
    """
    from ..dataset import BuildOptions
    from ..study import severity as study

    check_image_path(out, ".toml")
    values = overrides(tested.settings)
    lenses = tuple("" if lens == "thin" else lens for lens in tested.lenses or ())
    criterion = study.Criterion(metric=metric, quantile=quantile)
    models = study.models_of(scene, tested.models or (), values)
    views = study.ViewOptions(scene=scene, overrides=values, lenses=lenses, views=tested.views)
    table = study.compute_levels(models, views, criterion, BuildOptions(workers=workers), out)
    with writing(out):
        study.write_table(out, table)
    for line in study.lines_of(table):
        typer.echo(line)
