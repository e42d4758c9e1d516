"""Define the commands that train and score detectors of faults, and build benchmarks for them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..core.errors import InputError
from .app import app
from .options import MOST_PROCESSES, MOST_SEED, advancing, grouped, local_path, number, whole

if TYPE_CHECKING:
    from ..detect.training import TrainOptions

_PANEL = "Detectors"


@dataclasses.dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Hold the options that say how a network is trained; the names are those of `training.TrainOptions`."""

    architecture: Annotated[
        Literal["unet", "lraspp_mobilenet_v3_large", "deeplabv3_mobilenet_v3_large"],
        typer.Option(help="Network: a small U-Net, or one of torchvision."),
    ] = "unet"
    classes: Annotated[
        list[str] | None,
        typer.Option(help="Class of fault to find; may be repeated.", show_default="all that every dataset has"),
    ] = None
    masks: Annotated[
        Literal["effect", "footprint"],
        typer.Option(help="What to mark: where a fault changes the image by 1 DN, or where it is."),
    ] = "effect"
    crop_px: Annotated[
        int | None, whole(32, 16384, "Side of the crops in px.", unset="256, or the shortest side of the images")
    ] = None
    epochs: Annotated[int, whole(1, 100_000, "Number of passes through the images.")] = 30
    batch_size: Annotated[int, whole(1, 4096, "Images of a step.")] = 8
    learning_rate: Annotated[float, number(1e-7, 1, "Largest rate of learning.")] = 6e-3
    patience: Annotated[
        int, whole(1, 100_000, "Epochs without a better validation after which the training ends.")
    ] = 10
    seed: Annotated[int, whole(0, MOST_SEED, "Seed of all random numbers.")] = 0
    weights: Annotated[
        Path | None,
        typer.Option(help="State dict of PyTorch to begin with; what fits by name and shape is used."),
    ] = None

    def options(self) -> TrainOptions:
        """Return these options for the library."""
        from ..detect.training import TrainOptions

        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return TrainOptions(**values | {"classes": self.classes and tuple(self.classes)})


@app.command(rich_help_panel=_PANEL)
@grouped
def train(
    datasets: Annotated[
        list[str],
        typer.Argument(help="Paths or URLs of Zarr stores, built or injected, to mix.", metavar="DATASET..."),
    ],
    out: Annotated[Path, local_path("Folder of the model, to make or to continue.")],
    network: NetworkOptions = NetworkOptions(),
    workers: Annotated[int, whole(0, MOST_PROCESSES, "Processes that read images; 0: none but this one.")] = 0,
    device: Annotated[
        str | None, typer.Option(help="Device of PyTorch, such as cpu or cuda:1.", show_default="a GPU, if any")
    ] = None,
    onnx: Annotated[bool, typer.Option(help="Write model.onnx, too, and compare it with PyTorch.")] = False,
) -> None:
    """Train a network to find faults: where, which, how severe, and how much of an image is left. It needs the
    extra torch. The same command continues an interrupted training.
    """
    from ..detect.networks import WEIGHTS  # first: it says in a sentence that PyTorch is missing
    from ..detect.training import train as run

    record = run(datasets, out, network.options(), workers=workers, device=device, onnx=onnx, progress=True)
    best = next(one for one in record["epochs"] if one["epoch"] == record["best_epoch"])
    if "val_mean_iou" in best:
        for name, value in best["val_iou"].items():
            typer.echo(f"{name:<24}IoU {'none' if value is None else f'{value:.3f}'}")
        typer.echo(f"{'mean':<24}IoU {best['val_mean_iou']:.3f}")
    if "onnx" in record:
        typer.echo(f"ONNX differs from PyTorch by at most {record['onnx']['largest_difference']:.1e}")
    typer.echo(f"model of epoch {record['best_epoch']} of {len(record['epochs'])}: {out / WEIGHTS}")


@app.command(rich_help_panel=_PANEL)
def score(
    model: Annotated[
        Path,
        typer.Argument(
            help="Folder of a detector, or of masks CLASS/SAMPLE.png of any other program; or a fault monitor's "
            "log, a CSV or Parquet file."
        ),
    ],
    dataset: Annotated[
        str,
        typer.Argument(
            help="Path or URL (s3://, gs://, az://, file://) of a Zarr store; or the folder of a benchmark, whose "
            "tests are all scored and added to its leaderboard.json."
        ),
    ],
    out: Annotated[
        Path | None, local_path("Folder for the score.", unset="MODEL_on_DATASET, beside the model")
    ] = None,
    split: Annotated[
        Literal["train", "val", "test", "all"] | None,
        typer.Option(help="Samples to score.", show_default="test; of a benchmark, always all"),
    ] = None,
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
    frame, and by what navigation gains; or a fault monitor's log by what it says when. Writes score.json, score.md
    and score.html.
    """
    from ..detect.leaderboard import is_benchmark, score_benchmark
    from ..detect.scored_samples import ALL
    from ..detect.scoring import PAGE, ScoreOptions
    from ..detect.scoring import score as compare

    whole_tests = is_benchmark(dataset)
    if whole_tests and split not in (None, ALL):
        raise InputError(f"--split {split}: of the tests of a benchmark, all samples are scored; leave it out")
    options = ScoreOptions(
        split=split or (ALL if whole_tests else "test"),
        masks=masks or "",
        calibrate=calibrate,
        navigation=navigation,
        name=name,
        batch=batch,
        seed=seed,
    )
    folder = out or model.absolute().parent / f"{model.absolute().name}_on_{Path(dataset.rstrip('/')).stem}"
    if not whole_tests:
        with advancing("samples") as advance:
            result = compare(model, dataset, folder, options, advance=advance)
        _say_means(result)
        typer.echo(f"page: {folder / PAGE}")
        return
    with advancing("samples") as advance:
        for part, result in score_benchmark(model, Path(dataset), folder, options, advance):
            _say_means(result, f"{part}: ")
            typer.echo(f"page: {folder / part / PAGE}")


def _say_means(result: Mapping[str, Any], where: str = "") -> None:
    """Print the means of a score."""
    if "mean" not in result:
        of_all, right = result["time"]["all"], result["time"]["reactions"]["right_fraction"]["value"]
        for text, value in (
            ("events missed", of_all["missed_fraction"]["value"]),
            ("median delay in s", of_all["delay_s_median"]["value"]),
            ("false alarms an hour", of_all["false_alarms_per_hour"]["value"]),
            ("right reactions", right),
        ):
            typer.echo(f"{text}: {'none' if value is None else f'{value:.4g}'}")
        return
    for key, text in (("iou", "mean IoU"), ("f1", "mean F1"), ("par", "mean PaR"), ("pap", "mean PaP")):
        figure = result["mean"][key]
        if figure["value"] is not None:
            typer.echo(f"{where}{text}: {figure['value']:.3f} ({figure['low']:.3f} to {figure['high']:.3f})")
    alarms = result["false_alarms"]["all"]
    if alarms["frames"]:
        fraction = alarms["frames_with_alarm"]["value"]
        typer.echo(f"{where}false alarms: in {fraction:.1%} of {alarms['frames']} nominal frames")


@app.command(rich_help_panel=_PANEL)
def bench(
    out: Annotated[Path, local_path("Folder for the datasets and benchmark.json, to make or to continue.")],
    benchmark: Annotated[
        str, typer.Option(help="Path of a benchmark's file, or name of a packaged one.", metavar="BENCHMARK")
    ] = "unseen",
    fraction: Annotated[
        float, number(1e-6, 1.0, "Fraction of the samples of each dataset to make, for a trial.")
    ] = 1.0,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="PART", help="Dataset to make; may be repeated.", show_default="all of the benchmark"),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER",
            help="Images of your own for the parts that put faults into such.",
            show_default="those parts are left out",
        ),
    ] = None,
    workers: Annotated[int, whole(1, MOST_PROCESSES, "Number of processes.")] = 1,
    dry_run: Annotated[bool, typer.Option(help="Plan and describe the datasets, but render nothing.")] = False,
) -> None:
    """Build the datasets of a benchmark: some to train on, and tests that differ from them in one thing each."""
    from .. import dataset
    from ..detect.benchmark import make_benchmark

    how = dataset.BuildOptions(workers=workers, dry_run=dry_run)
    for name, part, lines in make_benchmark(
        benchmark, out, how, fraction=fraction, only=only or (), frames=frames or ""
    ):
        if dry_run:
            typer.echo("\n".join([f"{name}: {part.description}", *lines]))
        else:
            typer.echo(f"{name}: {part.samples} samples, {part.size_bytes / 1e6:.0f} MB, digest {part.digest}")
