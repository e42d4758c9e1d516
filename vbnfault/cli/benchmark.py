"""Define the command that makes the datasets of a benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .app import app
from .datasets import WorkOptions
from .options import grouped, local_path, number

_PANEL = "Detectors"


@app.command(rich_help_panel=_PANEL)
@grouped
def bench(
    out: Annotated[Path, local_path("Folder for the datasets and benchmark.json, to make or to continue.")],
    work: WorkOptions,
    benchmark: Annotated[
        str, typer.Option(help="Path of a benchmark's file, or name of a packaged one.", metavar="BENCHMARK")
    ] = "unseen",
    fraction: Annotated[
        float, number(0.0, 1.0, "Fraction of the samples of each dataset to make, for a trial.")
    ] = 1.0,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="PART", help="Dataset to make; may be repeated.", show_default="all of the benchmark"),
    ] = None,
) -> None:
    """Build the datasets of a benchmark: some to train on, and tests that differ from them in one thing each."""
    from .. import dataset
    from ..detect.benchmark import make_benchmark

    how = dataset.BuildOptions(**vars(work))
    for name, part in make_benchmark(benchmark, out, how, fraction=fraction, only=only or ()):
        typer.echo(f"{name}: {part.samples} samples, {part.size_bytes / 1e6:.0f} MB, digest {part.digest}")
