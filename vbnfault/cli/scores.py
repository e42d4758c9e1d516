"""Define the command that scores detectors."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from .app import app
from .options import MOST_SEED, local_path, progress_bar, whole

_PANEL = "Detectors"


@app.command(rich_help_panel=_PANEL)
def score(
    model: Annotated[
        Path, typer.Argument(help="Folder of a detector, or of masks CLASS/SAMPLE.png of any other program.")
    ],
    dataset: Annotated[str, typer.Argument(help="Path or URL (s3://, gs://, az://, file://) of a Zarr store.")],
    out: Annotated[
        Path | None, local_path("Folder for the score.", unset="MODEL_on_DATASET, beside the model")
    ] = None,
    split: Annotated[Literal["train", "val", "test", "all"], typer.Option(help="Samples to score.")] = "test",
    masks: Annotated[
        Literal["footprint", "effect"] | None,
        typer.Option(
            help="Which masks of the dataset are the truth.",
            show_default="what the detector learned; footprint for a folder of masks",
        ),
    ] = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Take each class's threshold with the best F1 on val, not 0.5.")
    ] = False,
    navigation: Annotated[
        bool, typer.Option(help="Measure the errors of navigation with and without the masks, too.")
    ] = True,
    name: Annotated[str, typer.Option(help="Name in the score.", show_default="the model's")] = "",
    batch: Annotated[int, whole(1, 1024, "Samples that are held at once.")] = 4,
    seed: Annotated[int, whole(0, MOST_SEED, "Seed of the bootstrap.")] = 0,
) -> None:
    """Compare a detector, or the masks of any other program, with the labels of a dataset: by pixel, artefact and
    frame, and by what navigation gains. Writes score.json, score.md and score.html.
    """
    from ..detect.scoring import PAGE, ScoreOptions
    from ..detect.scoring import score as compare

    options = ScoreOptions(
        split=split,
        masks=masks or "",
        calibrate=calibrate,
        navigation=navigation,
        name=name,
        batch=batch,
        seed=seed,
    )
    folder = out or model.absolute().parent / f"{model.absolute().name}_on_{Path(dataset.rstrip('/')).stem}"
    with contextlib.ExitStack() as stack:
        bars: list[Any] = []

        def advance(done: int, count: int) -> None:
            if not bars:
                bars.append(stack.enter_context(progress_bar(count, "samples")))
            bars[0].update(done - bars[0].pos)

        result = compare(model, dataset, folder, options, advance=advance)
    for key, text in (("iou", "mean IoU"), ("f1", "mean F1"), ("par", "mean PaR"), ("pap", "mean PaP")):
        figure = result["mean"][key]
        if figure["value"] is not None:
            typer.echo(f"{text}: {figure['value']:.3f} ({figure['low']:.3f} to {figure['high']:.3f})")
    typer.echo(f"page: {folder / PAGE}")
