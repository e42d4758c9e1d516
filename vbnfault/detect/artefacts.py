"""Count artefacts: single grains, defects, lines, flares and tracks that a predicted mask finds, misses or invents.

The follow-up of Gallon et al. (arXiv 2602.20709) reports a precision, a recall and a mean IoU per artefact (PaP,
PaR, PamIoU). Its definitions are known here at third hand only, so that those below are this package's own, under
the same names:

- A *true artefact* is a connected region of the true mask (8 neighbours), of flares all pixels of the mask that are
  nearest to one flare; a class that is not localised, such as a blur, has one, its whole mask.
- A *predicted artefact* is a connected region of the predicted mask.
- **PaR** = (true artefacts of which the predicted mask covers at least half of the pixels) / (true artefacts).
- **PaP** = (predicted artefacts of which at least half of the pixels are in the true mask) / (predicted artefacts).
- **PamIoU** = mean over the true artefacts T of |T ∩ P| / |T ∪ (R \\ M)|, P being the predicted mask, R the
  predicted artefacts that touch T, and M the true mask: pixels of another true artefact count neither for nor
  against T. A missed one counts 0.

Coverage, not a one-to-one assignment, decides, so that a region that joins two flares finds both, and a flare that
a prediction breaks into two counts once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..output.export.regions import class_discs, region_labels
from ..store import Store, StoreSpec
from .scores import F64, ratio

# The order of the counts of a sample.
COUNTS = ("true", "found", "iou_sum", "predicted", "right")


def artefact_counts(true_labels: NDArray[np.int32], predicted: NDArray[np.bool_]) -> F64:
    """Return `COUNTS` of one class in one image, float64[5].

    Parameters
    ----------
    true_labels
        int32[y, x]: the number of each true artefact, from 1 on; 0 outside of the mask.
    predicted
        bool[y, x]: the predicted mask.
    """
    out = np.zeros(len(COUNTS))
    true_mask = true_labels > 0
    number, labels = 0, np.zeros_like(true_labels)
    if predicted.any():
        count, labels = cv2.connectedComponents(predicted.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S)
        number = count - 1
        area = np.bincount(labels.ravel(), minlength=count)[1:]
        inside = np.bincount(labels[true_mask], minlength=count)[1:]
        out[3:] = number, np.count_nonzero(2 * inside >= area)
    if not true_mask.any():
        return out
    sizes = np.bincount(true_labels.ravel())
    sizes[0] = 0
    covered = np.bincount(true_labels[predicted], minlength=len(sizes))
    covered[0] = 0
    invented = np.zeros(len(sizes))  # pixels outside of the true mask of the regions that touch each artefact
    if number:
        both = true_mask & predicted
        pairs = np.unique(true_labels[both].astype(np.int64) * (number + 1) + labels[both])
        np.add.at(invented, pairs // (number + 1), (area - inside)[pairs % (number + 1) - 1])
    exists = sizes > 0
    iou = covered[exists] / (sizes + invented)[exists]
    out[:3] = exists.sum(), np.count_nonzero(2 * covered[exists] >= sizes[exists]), iou.sum()
    return out


def artefact_figures(sums: NDArray[np.float64]) -> dict[str, F64]:
    """Return PaR, PaP and PamIoU of sums of `COUNTS`, float64[..., 5]; nan for 0/0."""
    true, found, iou_sum, predicted, right = np.moveaxis(sums, -1, 0)
    return {"par": ratio(found, true), "pap": ratio(right, predicted), "pamiou": ratio(iou_sum, true)}


def artefact_labels(
    spec: StoreSpec, masks: NDArray[np.bool_], flares: Mapping[str, NDArray[np.float64]]
) -> Iterator[NDArray[np.int32]]:
    """Yield the true artefacts of each class of a sample, as `artefact_counts` wants them.

    Parameters
    ----------
    spec
        The store's spec, whose classes `masks` bool[class, y, x] holds.
    flares
        Centre and radius of the flares in px, float64[n, 3], of classes that have some.
    """
    for name, mask in zip(spec.faults, masks, strict=True):
        if name in (spec.localised_faults or ()) and mask.any():
            yield region_labels(mask, flares.get(name))
        else:
            yield mask.astype(np.int32)


def flares_of(store: Store, samples: Sequence[int] | NDArray[np.int64]) -> list[dict[str, NDArray[np.float64]]]:
    """Return the flares of each class of samples, as `artefact_labels` wants them.

    Raises InputError or VbnfaultError if the parameters of a sample are damaged, or not those of vbnfault.
    """
    sun, out = store.read("sun_xy_px"), []
    for i, drawn in zip(map(int, samples), store.drawn(samples), strict=True):
        discs = {
            name: class_discs(store.spec, i, drawn, name, sun[i]) for name in drawn if name in store.spec.faults
        }
        out.append({name: of_class for name, of_class in discs.items() if len(of_class)})
    return out
