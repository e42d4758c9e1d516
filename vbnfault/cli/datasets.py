"""Define the commands that plan, build, check, describe, show and export datasets."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import typer

from ..core.errors import InputError
from ..core.files.whole_files import writing
from .app import app
from .options import (
    MOST_PROCESSES,
    MOST_SAMPLES,
    OutStoreOption,
    SceneArgument,
    SceneOption,
    SceneOptions,
    SceneValues,
    StoreArgument,
    grouped,
    local_path,
    number,
    progress_bar,
    shard_range,
    whole,
)

_PANEL = "Datasets"


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """Hold the options that control how a build runs; the names are those of `dataset.BuildOptions`."""

    workers: Annotated[int, whole(1, MOST_PROCESSES, "Number of processes.")] = 1
    threads: Annotated[
        int | None,
        whole(1, MOST_PROCESSES, "Number of render threads of each process.", unset="all cores, divided equally"),
    ] = None
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler whose workers build, such as tcp://host:8786.")
    ] = None
    shard_range: Annotated[
        range | None,
        typer.Option(
            parser=shard_range,
            metavar="A:B",
            help="Make only the shards A to B - 1, counted from 0. Several commands with disjoint ranges may write "
            "into one store, or each into its own for the command merge.",
            show_default="all shards",
        ),
    ] = None
    overwrite: Annotated[bool, typer.Option(help="Delete an existing store first.")] = False
    dry_run: Annotated[bool, typer.Option(help="Plan and describe the dataset, but render nothing.")] = False
    accept_versions: Annotated[
        bool,
        typer.Option(
            help="Complete a store that was begun with other library versions, and record in it which samples "
            "have which versions."
        ),
    ] = False


@app.command(rich_help_panel=_PANEL)
@grouped
def build(
    scene: SceneArgument,
    out: OutStoreOption,
    options: SceneOptions,
    work: WorkOptions,
    append: Annotated[
        int | None,
        whole(1, MOST_SAMPLES, "Number of samples to add to a finished store as a new block."),
    ] = None,
) -> None:
    """Build a dataset, resume an interrupted build, or repair the damaged samples of a store."""
    from .. import dataset

    how = dataset.BuildOptions(**vars(work))
    source = dataclasses.replace(options, samples=None).load(scene)
    summary = dataset.build_scene(source, out, how, samples=options.samples, append=append, source=scene)
    for line in summary.lines():
        typer.echo(line)


@app.command(rich_help_panel=_PANEL)
def merge(
    stores: Annotated[list[str], typer.Argument(help="Stores of one dataset: paths or URLs.", metavar="STORE...")],
    out: Annotated[
        str, typer.Option(help="Path or URL of the store that gets all samples; one of STORE, or a new one.")
    ],
    move: Annotated[bool, typer.Option(help="Remove each shard from its store once it is merged.")] = False,
) -> None:
    """Join stores of one dataset, made with --shard-range, into one store."""
    from .. import dataset

    for line in dataset.merge_stores(stores, out, move=move).lines():
        typer.echo(line)


@app.command(rich_help_panel=_PANEL)
@grouped
def retake(
    store: StoreArgument,
    scene: SceneOption,
    out: OutStoreOption,
    options: SceneValues,
    work: WorkOptions,
) -> None:
    """Take a store's samples again with another scene's faults, lens or detector, on the stored radiance."""
    from ..dataset import retake as retaking

    how = retaking.build.BuildOptions(**vars(work))
    for line in retaking.retake(store, options.load(scene), out, how, source=scene).lines():
        typer.echo(line)


@app.command(rich_help_panel=_PANEL)
@grouped
def describe(scene: SceneArgument, options: SceneOptions) -> None:
    """Describe what a scene will photograph: samples by class and split, geometry, camera, size and time."""
    from .. import dataset

    source = options.load(scene)
    for line in dataset.describe_scene(source, source=scene):
        typer.echo(line)


@app.command(rich_help_panel=_PANEL)
@grouped
def render(
    scene: SceneArgument,
    out: Annotated[Path, local_path("Folder for the files.")],
    options: SceneOptions,
    sample: Annotated[int, whole(0, 100 * MOST_SAMPLES, "Index of the sample, counted from 0.")] = 0,
    append: Annotated[
        list[int] | None,
        whole(
            1,
            MOST_SAMPLES,
            "Number of samples of a block that was appended to the store; repeat it for each block, in order.",
        ),
    ] = None,
) -> None:
    """Render one sample of a scene as EXR, PNG and JSON, equal to the stored sample bit for bit."""
    from ..core.process import llvm

    source = options.load(scene)
    blocks = (source.dataset.samples, *(append or ()))
    if sample >= sum(blocks):
        raise InputError(f"--sample {sample}: {scene} plans samples 0 to {sum(blocks) - 1}; --samples plans more")
    llvm.find()
    from .. import pipeline
    from ..output import sample_files

    session = pipeline.Session(source, blocks=blocks, source=scene)
    session.warn_of_doubts()
    with writing(out):  # before the work
        out.mkdir(parents=True, exist_ok=True)
    for path in sample_files.write_frame(session.frame(sample), out):
        typer.echo(str(path))


@app.command(rich_help_panel=_PANEL)
@grouped
def event_camera(
    scene: SceneArgument,
    out: Annotated[Path, local_path("Folder for the files, to make or to continue.")],
    options: SceneValues,
    sequence: Annotated[
        list[str] | None,
        typer.Option(help="Name of a sequence; may be repeated.", show_default="all sequences of the scene"),
    ] = None,
) -> None:
    """Fly an event camera along the sequences of a scene, and write the events of its pixels as HDF5 and Parquet.
    The same command continues after an interruption.
    """
    from ..core.process import llvm

    source = options.load(scene)
    llvm.find()
    from ..output.event_files import write_events

    for line in write_events(source, out, sequence or (), source=scene):
        typer.echo(line)


@app.command(rich_help_panel=_PANEL)
def verify(store: StoreArgument) -> None:
    """Check a store: exit code 0 only if every sample is whole, labelled and as planned."""
    from .. import dataset
    from .. import store as stores

    opened = stores.open_store(store)
    with progress_bar(opened.samples, "samples") as bar:
        report = dataset.verify(opened, progress=bar.update)
    for problem in report.problems:
        typer.echo(f"{store}: {problem}", err=True)
    for sentence in dataset.missing_plugins(opened.attributes):
        typer.echo(f"note: {sentence}", err=True)
    for line in report.counts.lines():
        typer.echo(line)
    if report.problems:
        many = f"{len(report.problems)} problems" if len(report.problems) > 1 else "1 problem"
        typer.echo(f"vbnfault: {store}: {many}; run the build command again to repair the store", err=True)
        raise typer.Exit(1)
    if report.counts.missing:
        typer.echo(report.counts.missing_text())
    typer.echo(f"{store}: {opened.samples} samples, whole, labelled and as planned")
    typer.echo(f"digest {report.digest}")


@app.command(rich_help_panel=_PANEL)
def digest(store: StoreArgument) -> None:
    """Print the digest of a store's decoded arrays, which is equal for equal datasets, however they were built."""
    from .. import store as stores

    opened = stores.open_store(store)
    with progress_bar(opened.samples, "samples") as bar:
        typer.echo(stores.digest(opened, progress=bar.update))


@app.command(rich_help_panel=_PANEL)
def migrate(
    store: StoreArgument,
    out: Annotated[
        str | None,
        typer.Option(help="Path or URL of a copy, which takes fewer bytes; without it the store stays as it is."),
    ] = None,
) -> None:
    """Bring a store to the format of this vbnfault, and a copy to its codecs; values and digest stay the same."""
    from .. import store as stores
    from ..dataset import migrate_store

    migrated = migrate_store(store, out)
    finished = migrated.finished()
    samples = f"{migrated.samples} samples" + ("" if finished == migrated.samples else f", {finished} finished")
    typer.echo(f"{migrated.path}: {samples}, format {stores.FORMAT_VERSION}")


@app.command(rich_help_panel=_PANEL)
def preview(
    store: StoreArgument,
    out: Annotated[Path, local_path("PNG file to write.")],
    samples: Annotated[int, whole(1, 400, "Largest number of samples to show.")] = 16,
    masks: Annotated[bool, typer.Option(help="Draw the masks of the faults over the images.")] = True,
) -> None:
    """Draw a contact sheet of a store, with the masks over the images."""
    from ..output import contact_sheet

    contact_sheet.preview(store, out, max_samples=samples, masks=masks)
    typer.echo(str(out))


@app.command(rich_help_panel=_PANEL)
def export(
    store: StoreArgument,
    format: Annotated[
        str,
        typer.Option(metavar="FORMAT", help="One of coco, exr, huggingface, png, video, webdataset and yolo."),
    ],
    out: Annotated[Path, local_path("Folder for the files; an interrupted export in it is resumed.")],
    masks: Annotated[
        str,
        typer.Option(metavar="RULE", help="Which mask the files hold: footprint or effect; exr and png hold both."),
    ] = "footprint",
    min_area: Annotated[int, whole(1, 10_000_000, "Fewest pixels of an instance that coco and yolo write.")] = 1,
    fps: Annotated[
        float | None, number(0.1, 1000, "Frames a second of the films of video.", unset="those of time_s")
    ] = None,
    workers: Annotated[int, whole(1, 64, "Number of threads; the files do not depend on it.")] = 2,
) -> None:
    """Write a finished store in the format of other tools, with its splits, classes and a card."""
    from ..output.export import export_store

    written = export_store(store, out, format, masks=masks, min_area_px=min_area, fps=fps, workers=workers)
    for line in written.lines():
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
def events(
    store: StoreArgument,
    out: Annotated[Path | None, local_path("CSV file to write in place of the lines.")] = None,
) -> None:
    """List what happened in the sequences of a store: which fault was in which frames, since when, and why."""
    from ..dataset import events as listing

    listed = listing.events(store)
    if out is not None:
        with writing(out):
            out.write_text(listing.as_csv(listed), encoding="utf-8")
        typer.echo(f"{out}: {len(listed)} events")
        return
    for event in listed:
        typer.echo(event.line)


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

    from ..core.process.interrupts import interruptible
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
