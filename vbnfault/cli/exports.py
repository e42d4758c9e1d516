"""Define the commands that describe a store and write it in the formats of other tools."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from .app import app
from .options import StoreArgument, local_path, whole

_PANEL = "Datasets"


@app.command(rich_help_panel=_PANEL)
def export(
    store: StoreArgument,
    format: Annotated[
        str,
        typer.Option(metavar="FORMAT", help="One of coco, exr, huggingface, png, webdataset and yolo."),
    ],
    out: Annotated[Path, local_path("Folder for the files; an interrupted export in it is resumed.")],
    masks: Annotated[
        str,
        typer.Option(metavar="RULE", help="Which mask the files hold: footprint or effect; exr and png hold both."),
    ] = "footprint",
    min_area: Annotated[int, whole(1, 10_000_000, "Fewest pixels of an instance that coco and yolo write.")] = 1,
    workers: Annotated[int, whole(1, 64, "Number of threads; the files do not depend on it.")] = 2,
) -> None:
    """Write a finished store in the format of other tools, with its splits, classes and a card."""
    from ..output.export import export_store

    for line in export_store(store, out, format, masks=masks, min_area_px=min_area, workers=workers).lines():
        typer.echo(line)


@app.command(rich_help_panel=_PANEL)
def stats(
    store: StoreArgument,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Print planned and realised statistics: classes by split, co-occurrence, exposure, ranges of parameters. No
    checksums are compared; `vbnfault verify` does so."""
    from ..dataset.statistics import statistics

    numbers = statistics(store)
    if as_json:
        typer.echo(json.dumps(numbers.plain(), indent=2, allow_nan=False))
        return
    for line in numbers.lines():
        typer.echo(line)


@app.command(rich_help_panel=_PANEL)
def card(store: StoreArgument) -> None:
    """Write the card (README.md) and the Croissant description of a store into it, as a build does at its end."""
    from ..dataset.card import write_card

    for path in write_card(store):
        typer.echo(str(path))


@app.command(rich_help_panel=_PANEL)
def report(
    store: StoreArgument,
    out: Annotated[Path, local_path("Page to write; its name ends in .html.")],
    samples: Annotated[int, whole(1, 200, "Largest number of samples in the gallery.")] = 36,
    pixels: Annotated[int, whole(1, 1_000_000, "Largest number of samples whose pixels are read.")] = 400,
) -> None:
    """Write a report of a store as one page: a gallery, and what was planned, drawn and realised, by split."""
    from ..output.report import write_report

    typer.echo(str(write_report(store, out, samples=samples, pixels=pixels)))


@app.command(rich_help_panel=_PANEL)
def view(
    store: StoreArgument,
    port: Annotated[int, whole(0, 65535, "Port of the server on this machine; 0 takes a free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
) -> None:
    """Show a store in a browser: every sample with its masks, layers and parameters. Ctrl-C ends it."""
    import signal
    import webbrowser

    from ..core.interrupts import interruptible
    from ..output.viewer import Viewer
    from ..store import open_store

    viewer = Viewer(open_store(store), port)
    typer.echo(f"{viewer.url}  (Ctrl-C ends it)")
    if browser:
        webbrowser.open(viewer.url)
    before = signal.signal(signal.SIGINT, lambda *_: viewer.stop())  # this is how a viewer ends: no error
    try:
        with interruptible(lambda: f"the view of {viewer.store.path} was ended"):  # SIGTERM or SIGHUP
            viewer.serve()
    finally:
        signal.signal(signal.SIGINT, before)
