"""Define what a network is taught to make small, and the figures by which an epoch is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from .networks import LEVELS, Outputs

_THRESHOLD = 0.5  # of a probability, in the figures of an epoch
_OF_THE_IMAGE = 0.5  # weight of what is said of the whole image beside the masks


def loss_of(said: Outputs, batch: Mapping[str, Tensor], weights: Tensor) -> Tensor:
    """Return the loss of a batch.

    For each class c, with the pixels' labels y and probabilities p, the mean over all pixels of the batch, and the
    sums over the pixels of an image:

        L_c = −⟨w_c y ln p + (1 − y) ln(1 − p)⟩ + mean over images of (1 − 2 Σ y p / (Σ y + Σ p))

    The first term is cross entropy; w_c balances rare classes (`TrainingData.pixel_weights`). The second, the Dice
    loss (Milletari et al. 2016, doi 10.1109/3DV.2016.79), counts a thin line as much as a veil. As that of each
    image, it counts a line as much as half a sensor that is lost elsewhere; images without the class are left out.
    The loss is the mean of L_c, plus 0.5 times the sum of three cross entropies, each with a fraction as its label:
    presence, the level of severity over 5 of classes that are present and whose level is known, and the usable
    fraction.
    """
    masks = batch["masks"].to(said.masks.dtype)
    entropy = functional.binary_cross_entropy_with_logits(
        said.masks, masks, pos_weight=weights[:, None, None], reduction="none"
    ).mean((0, 2, 3))
    guess, over = said.masks.sigmoid(), (2, 3)
    size = masks.sum(over)
    dice, there = 1 - 2 * (guess * masks).sum(over) / (guess.sum(over) + size).clamp(min=1), size > 0
    loss = entropy.mean() + ((dice * there).sum(0) / there.sum(0).clamp(min=1)).mean()
    known = (batch["present"] > 0) & batch["severity"].isfinite()
    level = torch.nan_to_num(batch["severity"]) / LEVELS
    off = functional.binary_cross_entropy_with_logits(said.severity, level, reduction="none")
    loss_of_image = (
        functional.binary_cross_entropy_with_logits(said.present, batch["present"])
        + (off * known).sum() / known.sum().clamp(min=1)
        + functional.binary_cross_entropy_with_logits(said.usable, batch["usable"])
    )
    return loss + _OF_THE_IMAGE * loss_of_image


class Figures:
    """Add up what the figures of an epoch's validation are made of, over batches."""

    def __init__(self, classes: Sequence[str]) -> None:
        self.classes, self.images, self.loss = tuple(classes), 0, 0.0
        self.sums: dict[str, Any] = {}

    def add(self, said: Outputs, batch: Mapping[str, Tensor], loss: Tensor) -> None:
        """Add a batch."""
        masks, present, level, usable = said.probabilities()
        marked, there = masks > _THRESHOLD, batch["present"] > 0
        known = there & batch["severity"].isfinite()
        off = (level - torch.nan_to_num(batch["severity"])).abs() * known
        over = (0, 2, 3)
        counts = {
            "both": (marked & batch["masks"]).sum(over),
            "either": (marked | batch["masks"]).sum(over),
            "masked": batch["masks"].sum(over),
            "right": ((present > _THRESHOLD) == there).sum(0),
            "levels_off": off.sum(),
            "within": ((off <= 1) & known).sum(),
            "known": known.sum(),
            "usable_off": (usable - batch["usable"]).abs().sum(),
        }
        for name, value in counts.items():
            self.sums[name] = self.sums.get(name, 0) + value.double().cpu().numpy()
        self.images += len(present)
        self.loss += float(loss) * len(present)

    def values(self) -> dict[str, Any]:
        """Return the figures; nan, and null in a file, where nothing of a kind was seen."""
        sums = self.sums
        with np.errstate(invalid="ignore", divide="ignore"):
            iou = np.where(sums["masked"] > 0, sums["both"] / sums["either"], np.nan)
            levels_off, within = (float(sums[name] / sums["known"]) for name in ("levels_off", "within"))
        return {
            "val_loss": self.loss / self.images,
            "val_iou": dict(zip(self.classes, iou.tolist(), strict=True)),
            "val_mean_iou": float(np.nanmean(iou)) if np.isfinite(iou).any() else 0.0,
            "val_presence_accuracy": float(sums["right"].mean() / self.images),
            "val_severity_error_levels": levels_off,
            "val_severity_within_one_level": within,
            "val_usable_error": float(sums["usable_off"] / self.images),
        }
