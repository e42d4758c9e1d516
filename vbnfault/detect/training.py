"""Train a network to find faults, so that a training that is killed at any step goes on to the same weights.

A step depends on what the checkpoint holds, on the batch, which is keyed by seed, epoch and number, and on random
numbers that are keyed by seed and step. Nothing else is random, so a training that is resumed and one that never
stopped have the same weights bit for bit, on one machine with as many threads of PyTorch.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..core.errors import InputError, VbnfaultError, shown
from ..core.files.user_files import sha256_of_input
from ..core.files.whole_files import remove, write_whole, writing
from ..core.process.interrupts import Stopped, finishing, interruptible
from ..dataset.progress import Progress
from ..store import digest
from . import networks
from .losses import Figures, loss_of
from .model_files import check_same, checkpoint_of, finish
from .networks import (
    ARCHITECTURES,
    CHECKPOINT,
    MODEL,
    UNET,
    Outputs,
    as_input,
    chosen_device,
    first_sentence,
    new_network,
    read_model,
)
from .training_data import TrainingData

_CHECKPOINT_EVERY_S = 60.0  # what a kill loses at most; an end of an epoch and an interrupt write one, too
_WARM_UP = 0.05  # fraction of all steps in which the rate of learning rises to its full value
_WEIGHT_DECAY = 1e-2  # the default of AdamW
_LARGEST_GRADIENT = 5.0


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Hold how a network is trained.

    Attributes
    ----------
    architecture
        One of `ARCHITECTURES`.
    classes
        Classes to find; None: those that all datasets have.
    masks
        "effect" or "footprint": what the network learns to mark. The effect is the default, because the rest of a
        footprint looks as if there were no fault: of the footprints of `quickstart` at 256 px, 45 % of the dust's
        changes the image by 1 DN or more (the rest lies before the black sky), 78 % of the broken lines', 50 % of
        the vignetting's and 33 % of the blur's. A network that is taught such pixels can only guess; whoever marks
        exactly what shows has an IoU of 0.44 for dust. For straylight both are the same.
    crop_px
        Side of the crops; None: 256, or the shortest side of the images if this is less.
    epochs
        Number of passes through the images.
    batch_size
        Images of a step.
    learning_rate
        The largest one: it rises over the first steps, then falls along a cosine to 0.
    patience
        Epochs without a better validation after which the training ends.
    seed
        Of everything that is random.
    weights
        File of weights to begin with.
    """

    architecture: str = UNET
    classes: tuple[str, ...] | None = None
    masks: str = "effect"
    crop_px: int | None = None
    epochs: int = 30
    batch_size: int = 8
    learning_rate: float = 6e-3
    patience: int = 10
    seed: int = 0
    weights: Path | None = None

    def __post_init__(self) -> None:
        if self.architecture not in ARCHITECTURES:
            raise InputError(
                f"architecture = {shown(self.architecture)}: must be one of {', '.join(ARCHITECTURES)}"
            )
        for name in ("epochs", "batch_size", "patience"):
            if type(value := getattr(self, name)) is not int or value < 1:
                raise InputError(f"{name} = {shown(value)}: must be a whole number of at least 1")
        if not 0 < self.learning_rate <= 1:
            raise InputError(f"learning_rate = {self.learning_rate:g}: must be above 0 and at most 1")
        if self.batch_size < 2 and self.architecture != UNET:
            raise InputError(f"batch_size = 1: {self.architecture} normalises over a batch; must be at least 2")


def train(
    stores: Sequence[str],
    out: Path,
    options: TrainOptions | None = None,
    *,
    workers: int = 0,
    device: str | None = None,
    onnx: bool = False,
    progress: bool = False,
) -> dict[str, Any]:
    """Train a network on datasets, write it to a folder, and return what `model.json` then holds.

    The same call continues a training that was stopped, and returns at once where it is finished.

    Parameters
    ----------
    stores
        Paths or URLs of one or several datasets, whose images are mixed.
    out
        Folder to make, or that holds this training.
    options
        How the network is trained.
    workers
        Processes that read; 0 reads in this process, which takes 2 to 4 % of the time on a CPU.
    device
        Device of PyTorch; by default a GPU where there is one.
    onnx
        Whether to write `model.onnx`, too.
    progress
        Whether to show steps, rate and time left.

    Raises
    ------
    InputError
        If options and datasets do not fit, or the folder holds something else.
    Interrupted
        After Ctrl-C, SIGTERM or SIGHUP, with the state of the last step written.
    VbnfaultError
        If the loss is no number any more, memory is short, or a dataset is damaged.
    """
    options = options or TrainOptions()
    data = TrainingData(
        stores, options.classes, options.masks, options.crop_px, options.batch_size, options.seed, workers
    )
    what = _identity(options, data)
    if (out / MODEL).is_file():
        record = read_model(out)
        check_same(out, record, what)
        if not onnx or "onnx" in record:
            return record
        return finish(out, networks.load_detector(out, "cpu").network, record, onnx=True)
    saved = checkpoint_of(out, what)
    run = _Run(out, options, data, what, chosen_device(device), saved)
    with interruptible(lambda: f"{out}: interrupted; the same command continues the training"):
        run.go(progress)
    run.network.load_state_dict(run.best)
    record = {
        **run.what,
        "epochs": run.history,
        "best_epoch": run.best_epoch,
        "pixel_weights": run.weights.tolist(),
    }
    record = finish(out, run.network, record, onnx=onnx)
    remove(out / CHECKPOINT)
    return record


# --- a run -------------------------------------------------------------------------------------------------------


def _identity(options: TrainOptions, data: TrainingData) -> dict[str, Any]:
    """Return on what the weights depend, but for the machine, as plain data."""
    given = asdict(options) | {"crop_px": data.crop_px}
    del given["classes"], given["architecture"]
    if options.weights is not None:
        content = sha256_of_input(options.weights, "weights")
        given["weights"] = {"name": options.weights.name, "sha256": content}
    return {
        "architecture": options.architecture,
        "classes": list(data.classes),
        "options": given,
        "datasets": data.identity(),
    }


class _Run:
    """Hold the state of a training: network, optimiser, place in the epochs, the best weights so far."""

    def __init__(
        self,
        out: Path,
        options: TrainOptions,
        data: TrainingData,
        what: dict[str, Any],
        device: torch.device,
        saved: Mapping[str, Any] | None,
    ) -> None:
        self.out, self.options, self.data, self.what, self.device = out, options, data, what, device
        self.epoch = self.step = self.best_epoch = 0
        self.loss_sum = self.waited_s = self.trained_s = 0.0
        self.history: list[dict[str, Any]] = []
        self.best: dict[str, Tensor] = {}
        with _keyed(options.seed, "weights"):
            network = new_network(options.architecture, len(data.classes))
        if saved is None and options.weights is not None:
            networks.start_from(network, options.weights)
        self.network: nn.Module = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=options.learning_rate, weight_decay=_WEIGHT_DECAY
        )
        if saved is None:
            for one, store in zip(what["datasets"], data.stores, strict=True):
                one["digest"] = digest(store)
            self.weights = data.pixel_weights().to(device)
        else:
            self.weights = torch.ones(len(data.classes), device=device)
            self._restore(saved)
        self.saved_at = time.monotonic()

    @property
    def is_over(self) -> bool:
        """Return whether the training has ended: all epochs are done, or none was better for long enough."""
        late = bool(self.data.val) and self.epoch - self.best_epoch >= self.options.patience
        return self.epoch >= self.options.epochs or late

    def go(self, progress: bool) -> None:
        """Train until the end, and write checkpoints."""
        data, options = self.data, self.options
        if not self.epoch and not self.step:
            with writing(self.out):
                self.out.mkdir(parents=True, exist_ok=True)
            self._save()
        bar = Progress(options.epochs * data.steps, shown=progress, noun="steps")
        with bar, _deterministic(self.device):
            for _ in range(self.epoch * data.steps + self.step):
                bar.advance(built=False)
            try:
                while not self.is_over:
                    self._train_epoch(bar)
                    self._end_epoch(bar)
            except (Stopped, KeyboardInterrupt):  # of any other error the state may be one within a step
                self._save()
                raise
            except RuntimeError as error:
                if "memory" not in str(error):
                    raise
                raise VbnfaultError(
                    f"batch_size = {options.batch_size}: memory is short for crops of {data.crop_px} px; choose "
                    f"less, or a smaller crop: {first_sentence(error)}"
                ) from None

    def _train_epoch(self, bar: Progress) -> None:
        """Do the rest of the steps of an epoch; an interrupt arrives between two of them."""
        batches = self.data.batches(self.epoch, self.step)
        for _ in range(self.step, self.data.steps):
            began = time.perf_counter()
            batch = next(batches)
            self.waited_s += time.perf_counter() - began
            with finishing():
                self._update(batch)
            self.trained_s += time.perf_counter() - began
            bar.advance(built=True)
            if time.monotonic() - self.saved_at >= _CHECKPOINT_EVERY_S:
                self._save()

    def _update(self, batch: Mapping[str, Tensor]) -> None:
        """Do one step. Raises VbnfaultError if its loss is no number."""
        options, data = self.options, self.data
        at = self.epoch * data.steps + self.step
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * rate_at(at, options.epochs * data.steps)
        self.network.train()
        with _keyed(options.seed, f"step {at}", self.device):
            _, loss = self._judged(batch)
            value = float(loss.detach())
            if not math.isfinite(value):
                raise VbnfaultError(
                    f"{self.out}: the loss of step {self.step} of epoch {self.epoch + 1} is no number; begin again "
                    f"in another folder with a learning_rate below {options.learning_rate:g}"
                )
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), _LARGEST_GRADIENT)
        self.optimizer.step()
        self.step += 1
        self.loss_sum += value

    def _judged(self, batch: Mapping[str, Tensor]) -> tuple[Outputs, Tensor]:
        """Return what the network says about a batch, and its loss."""
        batch = dict(batch) | {name: networks.padded(batch[name]) for name in ("image", "masks")}
        on_device = {name: value.to(self.device, non_blocking=True) for name, value in batch.items()}
        with networks.reduced_precision(self.device, self.options.architecture):
            said = self.network(as_input(on_device["image"], self.device))
        said = Outputs(*(value.float() for value in said))
        return said, loss_of(said, on_device, self.weights)

    def _end_epoch(self, bar: Progress) -> None:
        """Validate, keep the weights if they are the best, and write the checkpoint."""
        data = self.data
        figures: dict[str, Any] = {
            "epoch": self.epoch + 1,
            "train_loss": self.loss_sum / data.steps,
            "images_per_s": round(data.steps * data.batch_size / max(self.trained_s, 1e-9), 3),
            "waiting_fraction": round(self.waited_s / max(self.trained_s, 1e-9), 5),
        }
        if data.val:
            bar.stage("validation")
            figures |= self._validated()
        with finishing():
            self.epoch, self.step = self.epoch + 1, 0
            self.loss_sum = self.waited_s = self.trained_s = 0.0
            best = max((one["val_mean_iou"] for one in self.history if "val_mean_iou" in one), default=-1.0)
            if figures.get("val_mean_iou", math.inf) > best:
                self.best_epoch, now = self.epoch, self.network.state_dict()
                self.best = {name: value.detach().cpu().clone() for name, value in now.items()}
            self.history.append(figures)
            self._save()
        judged = f", mean IoU {figures['val_mean_iou']:.3f}" if data.val else ""
        bar.say(f"epoch {self.epoch}: loss {figures['train_loss']:.4f}{judged}")

    def _validated(self) -> dict[str, Any]:
        """Return the figures of the validation images."""
        figures = Figures(self.data.classes)
        self.network.eval()
        with torch.inference_mode():
            for batch in self.data.validation():
                said, loss = self._judged(batch)
                batch["masks"] = networks.padded(batch["masks"])
                figures.add(said, {name: value.to(self.device) for name, value in batch.items()}, loss)
        return figures.values()

    def _state(self) -> dict[str, Any]:
        """Return what a checkpoint holds."""
        return {
            "what": self.what,
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "best": self.best,
            "history": self.history,
            "weights": self.weights,
            **{name: getattr(self, name) for name in _NUMBERS},
        }

    def _save(self) -> None:
        """Write the checkpoint."""
        file = io.BytesIO()
        torch.save(self._state(), file)
        with writing(self.out / CHECKPOINT):
            write_whole(self.out / CHECKPOINT, file.getvalue())
        self.saved_at = time.monotonic()

    def _restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from a checkpoint. Raises InputError if it is of another version or was made by hand."""
        try:
            for name, value in self._state().items():
                if type(saved[name]) is not type(value):
                    raise TypeError(f"{name} is no {type(value).__name__}")
            if [one["epoch"] for one in saved["history"]] != list(range(1, saved["epoch"] + 1)):
                raise ValueError("history has not the epochs that are done")
            if not 0 <= saved["step"] <= self.data.steps or saved["weights"].shape != self.weights.shape:
                raise ValueError("step or weights do not fit the datasets")
            if saved["best"] or saved["epoch"]:
                self.network.load_state_dict(saved["best"])  # refuses other weights
            self.network.load_state_dict(saved["network"])
            self.optimizer.load_state_dict(saved["optimizer"])
            self.what, self.best, self.history = saved["what"], saved["best"], saved["history"]
            self.weights = saved["weights"].to(self.device)
            for name in _NUMBERS:
                setattr(self, name, saved[name])
        except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            file = self.out / CHECKPOINT
            raise InputError(f"{file}: is a checkpoint of another version: {first_sentence(error)}") from None


_NUMBERS = ("epoch", "step", "best_epoch", "loss_sum", "waited_s", "trained_s")


def rate_at(step: int, steps: int) -> float:
    """Return the rate of learning of a step over the largest one: a linear rise, then a cosine down to 0."""
    rise = max(1, round(_WARM_UP * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


@contextlib.contextmanager
def _keyed(seed: int, name: str, device: torch.device | None = None) -> Iterator[None]:
    """Key the random numbers of PyTorch within a block; those of the program go on behind it."""
    number = int.from_bytes(hashlib.sha256(f"{seed}\0train\0{name}".encode()).digest()[:7], "little")
    with torch.random.fork_rng(devices=[device] if device is not None and device.type == "cuda" else []):
        torch.manual_seed(number)
        yield


@contextlib.contextmanager
def _deterministic(device: torch.device) -> Iterator[None]:
    """Let a GPU choose algorithms that give the same in every run, as far as it has such; a CPU has no others."""
    if device.type != "cuda":
        yield
        return
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
