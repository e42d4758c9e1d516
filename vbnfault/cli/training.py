"""Define the command that trains a detector of faults."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .app import app
from .options import MOST_PROCESSES, MOST_SEED, grouped, local_path, number, whole

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
    learning_rate: Annotated[float, number(1e-7, 1, "Largest rate of learning.")] = 3e-3
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
