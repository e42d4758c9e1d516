"""Define the networks that find faults, and read a trained one as a detector.

Each network maps images, float32[image, 4, y, x] with R, G, B and I in 0 to 1, to `Outputs`. All convolutions know
the four channels; no network knows where in the image it is, so a crop trains it as well as a whole image.
"""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, shown
from ..core.files.user_files import sha256_of_input
from .prediction import Prediction

try:
    import torch
    from torch import Tensor, nn
    from torch.nn import functional
except ModuleNotFoundError as error:
    raise InputError("detectors need PyTorch, which is not installed: pip install 'vbnfault[torch]'") from error

UNET = "unet"
ARCHITECTURES = (UNET, "lraspp_mobilenet_v3_large", "deeplabv3_mobilenet_v3_large")
CHANNELS = 4
STRIDE_PX = 32  # sides of an image are padded to a multiple: the U-Net needs one of 16, a backbone takes every 32nd
LEVELS = 5
MODEL, WEIGHTS, CHECKPOINT = "model.json", "weights.pt", "checkpoint.pt"
FORMAT = 1
_OF_MODEL = {  # in `model.json`
    "architecture": str,
    "classes": list,
    "options": dict,
    "datasets": list,
    "epochs": list,
    "best_epoch": int,
    "weights_sha256": str,
}
_HIDDEN = 64
# Widths of the U-Net at full size, 1/2, … 1/16. Lines and defects of one pixel need the full size, where a channel
# costs most; flares and blur need the coarse maps. 0.5 million parameters; 120 ms of processor time train it with
# an image of 256 px (`benchmarks/detect_training.py`, with AMX).
_WIDTHS = (16, 24, 48, 64, 96)
_AROUND_PX, _GAIN = 5, 8.0  # of the contrast to the neighbourhood, in which a line of few DN is of order 1
_MOST_PIXELS = 1 << 21  # that are predicted at once


class Outputs(NamedTuple):
    """Hold what a network says about images, as logits.

    Attributes
    ----------
    masks
        [image, class, y, x]: the class is in the pixel.
    present
        [image, class]: the image has the class.
    severity
        [image, class]: logit of the level divided by 5.
    usable
        [image]: logit of the fraction of pixels outside `mask_any`.
    """

    masks: Tensor
    present: Tensor
    severity: Tensor
    usable: Tensor

    def probabilities(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return masks and presence as probabilities, severity as levels 0 to 5, and the usable fraction."""
        return self.masks.sigmoid(), self.present.sigmoid(), LEVELS * self.severity.sigmoid(), self.usable.sigmoid()


class _Heads(nn.Module):
    """Say which classes are in the whole image, and how severe they are, and lower the masks of the others.

    A class that the image seems not to have, whose presence p is below one half, has its mask lowered by the logit
    of p: a pixel is marked if it and its image look like the fault. Masks and presence are each taught by their own
    loss alone; if that of the masks reaches presence through this sum, it draws presence down without end.
    """

    def __init__(self, width: int, classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.features = nn.Sequential(nn.LayerNorm(2 * width), nn.Linear(2 * width, _HIDDEN), nn.GELU())
        self.seen = nn.Sequential(nn.Linear(4 * classes, _HIDDEN), nn.GELU())
        self.said = nn.Linear(2 * _HIDDEN + 4 * classes, 2 * classes + 1)

    def forward(self, features: Tensor, masks: Tensor) -> Outputs:
        # how much of the image a class takes, from a pixel to all, and how much of its fullest row and column, says
        # whether it is there and how severe it is
        logits = masks.detach()
        marked = logits.sigmoid()
        rows, columns = (marked.mean(along).amax(2) for along in (3, 2))
        area = marked.mean((2, 3)).clamp(min=1e-6).log() / 3 + 1.5
        seen = torch.cat([area, logits.amax((2, 3)) / 3, rows, columns], 1)
        pooled = torch.cat([features.mean((2, 3)), features.amax((2, 3))], 1)
        said = self.said(torch.cat([self.features(pooled), self.seen(seen), seen], 1))
        present = said[:, : self.classes]
        masks = masks + present.detach().clamp(max=0)[:, :, None, None]
        return Outputs(masks, present, said[:, self.classes : -1], said[:, -1])


def _block(given: int, width: int) -> nn.Sequential:
    """Return two convolutions of 3 px, each with its normalisation."""
    layers: list[nn.Module] = []
    for before in (given, width):
        layers += [nn.Conv2d(before, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Segment with a small U-Net (Ronneberger et al. 2015), whose coarsest features know their mean.

    It sees the square root of the image, in which shot noise is the same at any brightness (Anscombe 1948), and its
    contrast to the mean of 5 × 5 px: beside glare of 255 DN, normalisation would make a line of 20 DN vanish.
    Mean and maximum over the image tell each pixel of veils, blur and falloff, which no window of an image shows.
    Maps grow by repetition: its gradient is the same in every run on a GPU, unlike that of an interpolation.
    """

    def __init__(self, classes: int, widths: Sequence[int] = _WIDTHS) -> None:
        super().__init__()
        self.down = nn.ModuleList(map(_block, (2 * CHANNELS, *widths), widths))
        self.context = nn.Linear(2 * widths[-1], widths[-1])
        coarse, fine = widths[:0:-1], widths[-2::-1]
        self.up = nn.ModuleList(_block(below + beside, beside) for below, beside in zip(coarse, fine, strict=True))
        self.masks = nn.Conv2d(widths[0], classes, 1)
        self.heads = _Heads(widths[-1], classes)

    def forward(self, images: Tensor) -> Outputs:
        """Return what the network says about images whose sides are multiples of 16 px."""
        beside: list[Tensor] = []
        root = images.sqrt()
        mean = functional.avg_pool2d(root, _AROUND_PX, 1, _AROUND_PX // 2, count_include_pad=False)
        maps = torch.cat([root, (_GAIN * (root - mean)).clamp(-2, 2)], 1)
        for k, block in enumerate(self.down):
            maps = block(functional.max_pool2d(maps, 2) if k else maps)
            beside.append(maps)
        overall = self.context(torch.cat([maps.mean((2, 3)), maps.amax((2, 3))], 1))
        coarse = maps = functional.relu(maps + overall[:, :, None, None])
        for block, finer in zip(self.up, beside[-2::-1], strict=True):
            maps = block(torch.cat([functional.interpolate(maps, scale_factor=2.0, mode="nearest"), finer], 1))
        return self.heads(coarse, self.masks(maps))


class Segmentation(nn.Module):
    """Segment with a network of torchvision, whose names of weights stay."""

    def __init__(self, made: Any, classes: int) -> None:
        super().__init__()
        backbone: Any = made.backbone
        first = backbone["0"][0]
        options = {name: getattr(first, name) for name in ("kernel_size", "stride", "padding")}
        backbone["0"][0] = nn.Conv2d(CHANNELS, first.out_channels, bias=False, **options)
        with torch.no_grad():
            features = backbone(torch.zeros(1, CHANNELS, STRIDE_PX, STRIDE_PX))
        self.backbone, self.classifier = backbone, made.classifier
        self._several = "high" in features  # LR-ASPP reads two maps
        self._last = "high" if self._several else "out"
        self.heads = _Heads(features[self._last].shape[1], classes)

    def forward(self, images: Tensor) -> Outputs:
        """Return what the network says about images of any size."""
        features = self.backbone(images)
        maps = self.classifier(features if self._several else features["out"])
        masks = functional.interpolate(maps, size=images.shape[-2:], mode="bilinear", align_corners=False)
        return self.heads(features[self._last], masks)  # type: ignore[no-any-return]


def new_network(architecture: str, classes: int) -> nn.Module:
    """Return a network with random weights. Raises InputError if it is unknown, or torchvision is missing."""
    if architecture not in ARCHITECTURES:
        raise InputError(f"architecture = {shown(architecture)}: must be one of {', '.join(ARCHITECTURES)}")
    if architecture == UNET:
        return UNet(classes)
    make = getattr(_torchvision().models.segmentation, architecture)
    return Segmentation(make(weights=None, weights_backbone=None, num_classes=classes), classes)


_declared: list[Any] = []  # a declaration lasts as long as its library


def _torchvision() -> Any:
    """Return torchvision. Raises InputError if it is not installed.

    A torchvision that was compiled for another PyTorch, such as the plain wheel beside one for the CPU, cannot load
    its compiled operators, and its import fails at the first of two that it describes to PyTorch. No network
    here needs an operator, so these two are declared, without a definition.
    """
    for attempt in range(2):
        try:
            import torchvision

            return torchvision
        except ModuleNotFoundError as error:
            raise InputError("this architecture needs torchvision: pip install 'vbnfault[torch]'") from error
        except RuntimeError as error:
            if attempt or "torchvision::nms" not in str(error):
                raise InputError(f"torchvision does not fit this PyTorch {torch.__version__}: {error}") from None
            library = torch.library.Library("torchvision", "DEF")
            for name in ("nms", "qnms"):
                library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
            _declared.append(library)
    raise AssertionError("unreachable")


def read_weights(path: Path, what: str = "weights") -> Any:
    """Return the content of a file of PyTorch, in which nothing but tensors and plain data is read.

    Raises InputError if the file cannot be read, is damaged or holds anything else.
    """
    try:
        if zipfile.is_zipfile(path) and zipfile.ZipFile(path).testzip():  # PyTorch checks no sums
            raise ValueError("the check sum of its numbers is wrong")
        return torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # the safe unpickler meets whatever bytes make of it
        why = first_sentence(error) or "it ends too early"
        raise InputError(f"{path}: is no file of {what} that PyTorch reads safely: {why}") from None


def start_from(network: nn.Module, path: Path) -> int:
    """Set those weights of a network that a file has under their names and in their shapes; return their number.

    Weights for R, G and B alone get the mean of these as those for I, and all are scaled so that the sum stays. A
    classifier of torchvision for ImageNet names its backbone `features`.

    Raises InputError if the file is no state dict, or nothing in it fits.
    """
    given = read_weights(path, "weights")
    given = given.get("model", given) if isinstance(given, Mapping) else given
    if not isinstance(given, Mapping) or not all(isinstance(value, Tensor) for value in given.values()):
        raise InputError(f"{path}: must hold a state dict, a mapping of names to tensors")
    own, fitting = network.state_dict(), {}
    for name, value in given.items():
        name = name.replace("features.", "backbone.", 1) if name.startswith("features.") else name
        if name in own and value.ndim == 4 and value.shape[1] == 3 and own[name].shape[1] == CHANNELS:
            value = torch.cat([value, value.mean(1, keepdim=True)], 1) * (3 / CHANNELS)
        if name in own and own[name].shape == value.shape:
            fitting[name] = value
    if not fitting:
        raise InputError(f"{path}: none of its {len(given)} weights has name and shape of one of this network's")
    network.load_state_dict(fitting, strict=False)
    return len(fitting)


def chosen_device(asked: str | None) -> torch.device:
    """Return the device to compute on: by default a GPU if PyTorch has one. Raises InputError if it has no such."""
    try:
        device = torch.device(asked or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.zeros(1, device=device).item()
        return device
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device = {shown(asked)}: PyTorch has no such device: {first_sentence(error)}") from None


def first_sentence(error: BaseException) -> str:
    """Return the first sentence of an error's message: PyTorch lists devices and advice behind it."""
    return str(error).strip().partition("\n")[0].partition(". ")[0]


def padded(planes: Tensor) -> Tensor:
    """Return images or masks [image, plane, y, x] grown to multiples of the stride; they go on as they end."""
    height, width = planes.shape[-2:]
    rim = (0, -width % STRIDE_PX, 0, -height % STRIDE_PX)
    if not any(rim):
        return planes
    return functional.pad(planes.float(), rim, mode="replicate").to(planes.dtype)


def reduced_precision(device: torch.device, architecture: str) -> torch.autocast:
    """Return a block in which a training computes in bfloat16 where this is faster, and in float32 elsewhere.

    GPUs have bfloat16; so have processors with AMX, Intel's matrix extensions, on which a step of the U-Net takes
    0.4 of its time. Backbones of torchvision convolve each channel by itself, which gains nothing there.
    """
    if device.type == "cuda":
        faster = torch.cuda.is_bf16_supported()
    else:
        asked: Any = getattr(torch.cpu, "get_capabilities", dict)  # older PyTorch does not tell
        faster = device.type == "cpu" and architecture == UNET and bool(asked().get("amx_bf16", False))
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=faster)


def as_input(images: Tensor, device: torch.device) -> Tensor:
    """Return images uint8[image, 4, y, x] as a network takes them, on its device."""
    moved = images.to(device, non_blocking=True)
    return moved.to(torch.float32, memory_format=torch.channels_last).div_(255)


class TrainedDetector:
    """Find faults with a trained network, on a GPU where there is one.

    Parameters
    ----------
    network
        The network.
    classes
        Fault classes on the axes of its outputs.
    device
        Where it computes; by default on a GPU if PyTorch has one.
    masks
        "effect" or "footprint": what it learned to mark.
    """

    def __init__(
        self, network: nn.Module, classes: Sequence[str], device: str | None = None, masks: str = "effect"
    ) -> None:
        self.device = chosen_device(device)
        self.network = network.to(self.device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        self._classes, self.masks = tuple(classes), masks

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the classes of fault on the first axis of a prediction's arrays."""
        return self._classes

    def predict(self, images: NDArray[np.uint8]) -> list[Prediction]:
        """Return a prediction for each image, uint8[sample, y, x, channel] with R, G, B and I, of any size.

        Raises InputError for images of another shape or data type.
        """
        if images.ndim != 4 or images.shape[-1] != CHANNELS or images.dtype != np.uint8:
            raise InputError(
                f"images: {images.dtype}{list(images.shape)}: must be uint8[sample, y, x, 4]: R, G, B and I"
            )
        height, width = images.shape[1:3]
        step = max(1, _MOST_PIXELS // max(1, height * width))
        out: list[Prediction] = []
        for first in range(0, len(images), step):
            part = torch.from_numpy(np.ascontiguousarray(images[first : first + step])).permute(0, 3, 1, 2)
            with torch.inference_mode():
                said = self.network(as_input(padded(part), self.device)).probabilities()
            masks, present, severity, usable = (value.float().cpu().numpy() for value in said)
            out += [
                Prediction(
                    masks=np.ascontiguousarray(masks[k, :, :height, :width]),
                    present=present[k],
                    severity=severity[k],
                    usable_fraction=float(usable[k]),
                )
                for k in range(len(part))
            ]
        return out


def load_detector(path: str | Path, device: str | None = None) -> TrainedDetector:
    """Return the detector that `vbnfault train` wrote to a folder.

    Raises InputError if the folder holds no finished training, or another version's.
    """
    record = read_model(Path(path))
    network, file = new_network(record["architecture"], len(record["classes"])), Path(path) / WEIGHTS
    try:
        network.load_state_dict(read_weights(file))
    except (RuntimeError, TypeError, AttributeError):
        raise InputError(f"{file}: its weights are not those of {record['architecture']}") from None
    if sha256_of_input(file, "weights") != record["weights_sha256"]:
        raise InputError(f"{file}: was exchanged: its SHA-256 is not the weights_sha256 of {MODEL}")
    return TrainedDetector(network, record["classes"], device, record["options"]["masks"])


def read_model(path: Path) -> dict[str, Any]:
    """Return what `model.json` of a trained model holds. Raises InputError as `load_detector`."""
    file = path / MODEL
    if not file.is_file():
        why = "is no trained model: it has no model.json, which vbnfault train writes"
        if (path / CHECKPOINT).is_file():
            why = "its training is not finished; the command that began it continues it"
        raise InputError(f"{path}: {why if path.exists() else 'no such model'}")
    with contextlib.suppress(ValueError, OSError):
        record = json.loads(file.read_text(encoding="utf-8"))
        is_ours = isinstance(record, dict) and record.get("format") == FORMAT
        if is_ours and all(record.get(key) and type(record[key]) is kind for key, kind in _OF_MODEL.items()):
            return record  # type: ignore[no-any-return]
    raise InputError(
        f"{file}: is no model.json of this vbnfault; its format must be {FORMAT}, with {', '.join(_OF_MODEL)}"
    )
