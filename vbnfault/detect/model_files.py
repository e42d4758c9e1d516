"""Write what a training made: weights, `model.json`, a card for people, a figure of the losses, and ONNX.

And say whether a folder holds the training that is asked for.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import io
import logging
import math
import os
import platform
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .. import __version__
from ..core.errors import InputError, VbnfaultError, shown
from ..core.files.whole_files import own, plain, write_json, write_whole, writing
from ..core.html_page import rendered
from .networks import CHANNELS, CHECKPOINT, FORMAT, MODEL, STRIDE_PX, WEIGHTS, read_weights

CARD, FIGURE, ONNX = "card.md", "training.png", "model.onnx"
ONNX_WITHIN = 1e-4  # of probabilities, levels and fractions, between ONNX Runtime and PyTorch
_LIBRARIES = ("torch", "torchvision", "onnx", "onnxruntime", "numpy")


def finish(out: Path, network: nn.Module, record: Mapping[str, Any], *, onnx: bool) -> dict[str, Any]:
    """Write the files of a trained model, `model.json` last, and return what it holds.

    Raises InputError without the packages that ONNX needs, and VbnfaultError if its network gives something else.
    """
    network = network.to("cpu").eval()
    file = io.BytesIO()
    # the order of axes in memory is no part of weights
    torch.save({name: value.contiguous() for name, value in network.state_dict().items()}, file)
    made = {
        "format": FORMAT,
        **record,
        "parameters": sum(p.numel() for p in network.parameters()),
        "weights_sha256": hashlib.sha256(file.getvalue()).hexdigest(),
        "versions": _versions(),
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads of PyTorch, {os.cpu_count()} cores",
    }
    with writing(out, within=True):
        if onnx:
            made["onnx"] = {"file": ONNX, "largest_difference": export_onnx(network, own(out / ONNX))}
        write_whole(own(out / WEIGHTS), file.getvalue())
        draw_training(made, own(out / FIGURE))
        write_whole(own(out / CARD), card(made))
        write_json(own(out / MODEL), made)
    return plain(made)  # type: ignore[no-any-return]


def _versions() -> dict[str, str]:
    """Return the versions of vbnfault, Python and the libraries that compute with a network."""
    numbers = {"vbnfault": __version__, "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            numbers[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return numbers


# --- which training a folder holds -------------------------------------------------------------------------------


def check_same(out: Path, held_there: Mapping[str, Any], what: Mapping[str, Any]) -> None:
    """Raise InputError, which says what differs, unless a folder holds the training that is asked for."""
    is_ours = isinstance(held_there, dict) and all(type(held_there.get(key)) is type(what[key]) for key in what)
    if not is_ours or not all(isinstance(one, dict) for one in held_there["datasets"]):
        raise InputError(f"{out}: holds no training of this vbnfault; choose another --out")
    there, here = dict(held_there["options"]), dict(what["options"])
    for key in ("architecture", "classes"):
        there[key], here[key] = held_there[key], what[key]
    for key, value in here.items():
        if there.get(key) != value:
            raise InputError(
                f"{out}: holds a training with {key} = {shown(there.get(key))}, not {shown(value)}; choose another "
                "--out, or the options with which it began"
            )
    kept = ("name", "checksums_sha256", "train", "val", "mirrored")
    of = [[{key: one.get(key) for key in kept} for one in held["datasets"]] for held in (held_there, what)]
    if of[0] != of[1]:
        names = ["{name} ({train} images, {checksums_sha256!s:.8})".format(**one) for one in (*of[0], *of[1])]
        then, now = ", ".join(names[: len(of[0])]), ", ".join(names[len(of[0]) :])
        raise InputError(f"{out}: holds a training on {then}, not on {now}; choose another --out")


def checkpoint_of(out: Path, what: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the checkpoint in a folder; None without one. Raises InputError if the folder holds something else."""
    if (file := out / CHECKPOINT).is_file():
        saved = read_weights(file, "a checkpoint")
        if not isinstance(saved, dict) or "what" not in saved:
            raise InputError(f"{file}: is no checkpoint of vbnfault train; choose another --out")
        check_same(out, saved["what"], what)
        return saved
    if (out / MODEL).is_file():
        return None
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: exists and holds no training; choose another --out")
    return None


# --- ONNX --------------------------------------------------------------------------------------------------------


class _Exported(nn.Module):
    """Map images in DN to probabilities, levels and fractions: what a program without vbnfault needs."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        said: tuple[Tensor, Tensor, Tensor, Tensor] = self.network(image / 255).probabilities()
        return said


def export_onnx(network: nn.Module, path: Path) -> float:
    """Write a network as ONNX, compare it with PyTorch on images of two sizes, and return the largest difference.

    Input `image`: float32[image, 4, y, x] with R, G, B and I in DN, 0 to 255; sides are multiples of 32 px.
    Outputs: `masks`[image, class, y, x] and `present`[image, class] as probabilities, `severity`[image, class] from
    0 to 5, `usable_fraction`[image].

    Raises
    ------
    InputError
        If onnx, onnxscript or onnxruntime is not installed.
    VbnfaultError
        If the outputs differ by more than 1e-4.
    """
    try:
        import onnxruntime
        import onnxscript  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(f"ONNX needs {error.name}: pip install 'vbnfault[onnx]'") from error
    exported = _Exported(network).eval()
    names = ["masks", "present", "severity", "usable_fraction"]
    sizes = {0: torch.export.Dim("images"), 2: _multiple("rows"), 3: _multiple("columns")}
    images = _test_images(2, 64, 96)
    with warnings.catch_warnings(), _quiet():
        warnings.simplefilter("ignore")  # of the exporter, on its own workings
        program = torch.onnx.export(
            exported,
            (images,),
            input_names=["image"],
            output_names=names,
            dynamic_shapes={"image": sizes},
            dynamo=True,
            verbose=False,
        )
        assert program is not None
        program.save(path, external_data=False)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    largest = 0.0
    for given in (images, _test_images(1, 128, 64)):
        with torch.inference_mode():
            wanted = exported(given)
        for ours, theirs in zip(wanted, session.run(names, {"image": given.numpy()}), strict=True):
            largest = max(largest, float(np.abs(ours.numpy() - theirs).max()))
    if not largest <= ONNX_WITHIN:
        raise VbnfaultError(f"{path}: differs from PyTorch by {largest:.2g}; must be at most {ONNX_WITHIN:g}")
    return largest


def _multiple(name: str) -> Any:
    """Return a side of images that is a multiple of the stride."""
    return STRIDE_PX * torch.export.Dim(name)


def _test_images(count: int, height: int, width: int) -> Tensor:
    """Return made-up images in DN, the same in every run."""
    generator = torch.Generator().manual_seed(0)
    return 255 * torch.rand((count, CHANNELS, height, width), generator=generator)


class _quiet:
    """Keep the exporter from printing its progress within a block."""

    def __enter__(self) -> None:
        self._loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
        self._levels = [logger.level for logger in self._loggers]
        for logger in self._loggers:
            logger.setLevel(logging.ERROR)

    def __exit__(self, *_: object) -> None:
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.setLevel(level)


# --- for people --------------------------------------------------------------------------------------------------


def draw_training(record: Mapping[str, Any], path: Path) -> None:
    """Draw the losses and the agreement of the masks by epoch, and write the figure as PNG."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator

    from ..core import figures

    epochs = record["epochs"]
    number = [one["epoch"] for one in epochs]
    validated = "val_loss" in epochs[-1]
    curves = {name: figures.SERIES_COLOURS[k % 6] for k, name in enumerate(record["classes"])}
    legend = [Line2D([], [], color=colour, label=name) for name, colour in curves.items()]
    heads = ("loss", "IoU of the validation images")
    kept = f"weights of epoch {record['best_epoch']} are kept"
    with figures.panels(
        f"{record['architecture']}, {kept}", (1, 2), (230, 150), legend=legend if validated else (), heads=heads
    ) as (
        figure,
        (left, right),
    ):
        for name, colour, text in (
            ("train_loss", figures.INK, "training"),
            ("val_loss", figures.VERMILLION, "validation"),
        ):
            if name in epochs[-1]:
                values = [one[name] for one in epochs]
                left.plot(number, values, color=colour, marker="o", ms=2.5)
                above = values[-1] >= max(epochs[-1]["train_loss"], epochs[-1].get("val_loss", 0.0))
                place = (4, 2 if above else -9)  # points; the curves may end at one place
                left.annotate(text, (number[-1], values[-1]), place, textcoords="offset points", color=colour)
        if validated:
            for name, colour in curves.items():
                values = [np.nan if (v := one["val_iou"][name]) is None else v for one in epochs]
                right.plot(number, values, color=colour, marker="o", ms=2.5)
            mean = [one["val_mean_iou"] for one in epochs]
            right.plot(number, mean, color=figures.INK, ls="--")
            right.annotate("mean", (number[-1], mean[-1]), (4, -3), textcoords="offset points", color=figures.INK)
            right.axvline(record["best_epoch"], color=figures.MUTED, lw=0.6, ls=(0, (1, 2)))
        else:
            figures.write_message(right, "no dataset has a validation split")
        right.set_ylim(0, 1)
        left.set_ylim(bottom=0)
        for one in (left, right):
            one.set_xlabel("epoch")
            one.xaxis.set_major_locator(MaxNLocator(5, integer=True))
            one.grid(axis="y")
    write_whole(path, figures.png_bytes(figure))


def card(record: Mapping[str, Any]) -> str:
    """Return the card of a model as Markdown: what it is, what it was trained with, and what it is not for."""
    best = next((one for one in record["epochs"] if one["epoch"] == record["best_epoch"]), record["epochs"][-1])

    def text(value: float | None) -> str:
        return "none in these images" if value is None or not math.isfinite(value) else f"{value:.3f}"

    return rendered("detect/card.md", record=record, best=best, text=text, stride=STRIDE_PX, within=ONNX_WITHIN)
