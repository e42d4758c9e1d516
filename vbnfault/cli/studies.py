"""Define the commands of sensitivity studies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .app import app
from .options import MOST_PROCESSES, overrides

_PANEL = "Studies"


@app.command(rich_help_panel=_PANEL)
def study(
    name: Annotated[
        str, typer.Argument(help="Path of a study file, or name of a packaged study.", metavar="STUDY")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results, to make or to continue.")],
    workers: Annotated[int, typer.Option(min=1, max=MOST_PROCESSES, help="Number of processes.")] = 1,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_PROCESSES,
            help="Number of render threads of each process.",
            show_default="all cores, divided equally",
        ),
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
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Replace a value of the study, such as design.n=8 or scene.camera.width_px=128; may be repeated.",
        ),
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
