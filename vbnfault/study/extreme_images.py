"""Write the images with the best and the worst value of each metric of a study."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.images import write_png
from ..core.whole_files import own, own_folder
from .spec import Evaluation
from .summaries import StudyResults

if TYPE_CHECKING:
    import pyarrow as pa
    import xarray as xr

IMAGES = "images"  # folder

_WHITE = 0.998  # quantile of a pair of images that is shown as white
_MIDDLE = 0.3  # grey value of the median of a pair, of 1 for white
_FAINTEST = 1e-6  # of white: the tone curve is linear at least up to here


def write_images(
    folder: str | os.PathLike[str], dataset: xr.Dataset, table: pa.Table, spec: Mapping[str, Any], evaluator: Any
) -> list[Path]:
    """Write the images with the best and the worst value of each metric to `images`; return their paths.

    Images of 8 bits are written as they are. Otherwise the two images of a metric have one exposure and one tone
    curve, arcsinh (Lupton et al. 2004, doi 10.1086/382245), which shows ghosts and ground beside the Sun: the
    99.8 % quantile of both is white, and their median is at 30 % of white, or brighter where it is so on a linear
    scale. An evaluator without the method `picture`, and a metric whose values are all equal, give none.

    Parameters
    ----------
    folder, dataset, table, spec
        As for `report.write_report`. The images go to the folder `images`.
    evaluator
        Evaluator of the study; `picture(evaluation)` returns an image, [y, x] or [y, x, 3], in electrons, linear,
        or as stored, uint8.
    """
    picture = getattr(evaluator, "picture", None)
    if picture is None:
        return []
    results = StudyResults(dataset=dataset, table=table, spec=spec)
    paths: list[Path] = []
    kept: dict[int, NDArray[Any]] = {}

    def image(row: int) -> NDArray[Any]:
        if row not in kept:
            values = table.slice(row, 1).to_pylist()[0]
            evaluation = Evaluation(
                index=int(values["evaluation"]),
                seed=int(values["seed"]),
                view=int(values["view"]),
                model=str(values["model"]),
                role=str(values["role"]),
                values={factor: values[factor] for factor in results.factors},
            )
            kept[row] = np.asarray(picture(evaluation))
        return kept[row]

    for metric in results.metrics:
        extremes = results.extremes(metric)
        if extremes is None:
            continue
        names = ("best", "worst")
        pair = _shown([image(extremes.best_row), image(extremes.worst_row)])
        images = own_folder(Path(folder) / IMAGES)
        for name, each in zip(names, pair, strict=True):
            paths.append(write_png(own(images / f"{metric}_{name}.png"), each))
    return paths


def _shown(pair: Sequence[NDArray[Any]]) -> list[NDArray[np.uint8]]:
    """Return two images as they are shown: as they are with 8 bits, otherwise with one exposure and tone curve."""
    if all(image.dtype == np.uint8 for image in pair):
        return list(pair)
    linear = [np.nan_to_num(image).astype(np.float64) for image in pair]
    white, middle = np.quantile(np.concatenate([image.ravel() for image in linear]), [_WHITE, 0.5])
    white = white if white > 0 else 1.0
    # Below `knee`, grey values are proportional to electrons. The lower it is, the brighter is the median.
    knees = white * np.geomspace(1e3, _FAINTEST, 200)
    greys = np.arcsinh(middle / knees) / np.arcsinh(white / knees)
    knee = knees[min(int(np.searchsorted(greys, _MIDDLE)), len(knees) - 1)]
    tones = (np.arcsinh(image / knee) / np.arcsinh(white / knee) for image in linear)
    return [np.rint(255 * np.clip(tone, 0, 1)).astype(np.uint8) for tone in tones]
