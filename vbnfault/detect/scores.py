"""Compute figures of detection from counts, each with the interval of a bootstrap over views.

A count is a sum over pixels or frames, so that a figure of any resample of the views follows from sums of counts,
and no pixel is looked at twice. Probabilities are counted in 256 bins: bin k holds those that round to k/255, as an
8 bit image stores them. A class is predicted in a pixel where the bin is at least the threshold's; the threshold
0.5 is bin 128, since 127.5 rounds to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import keyed_random

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BINS = 256
HALF = 128  # the first bin of probabilities of at least 0.5
RELIABILITY_BINS = 15
RESAMPLES = 1000
CONFIDENCE = 0.95


def binned(probability: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bin of each probability in [0, 1], uint8."""
    return np.rint(np.asarray(probability, dtype=np.float32) * (BINS - 1)).astype(np.uint8)


def histogram(truth: NDArray[np.bool_], bins: NDArray[np.uint8]) -> I64:
    """Return how many pixels without (row 0) and with the class (row 1) are in each bin, int64[2, 256]."""
    return np.bincount(bins.ravel() + BINS * truth.ravel().astype(np.int16), minlength=2 * BINS).reshape(2, BINS)


# --- figures of histograms [..., 2, bin] --------------------------------------------------------------------------


def counts_at(histograms: NDArray[Any], threshold: int) -> tuple[F64, F64, F64]:
    """Return true positives, false positives and false negatives at a threshold's bin, float64[...] each."""
    values = np.asarray(histograms, dtype=np.float64)
    predicted = values[..., threshold:].sum(axis=-1)
    return predicted[..., 1], predicted[..., 0], values[..., 1, :threshold].sum(axis=-1)


def pixel_figures(histograms: NDArray[Any], threshold: int) -> dict[str, F64]:
    """Return IoU, precision, recall and F1 at a threshold's bin, float64[...] each; nan for 0/0.

    IoU = TP/(TP + FP + FN), precision = TP/(TP + FP), recall = TP/(TP + FN), F1 = 2 TP/(2 TP + FP + FN), over all
    pixels of all frames together.
    """
    hit, wrong, missed = counts_at(histograms, threshold)
    return {
        "iou": ratio(hit, hit + wrong + missed),
        "precision": ratio(hit, hit + wrong),
        "recall": ratio(hit, hit + missed),
        "f1": ratio(2 * hit, 2 * hit + wrong + missed),
    }


def average_precision(histograms: NDArray[Any]) -> F64:
    """Return the average precision, float64[...]; nan without a positive.

    AP = Σ (R_k − R_{k+1}) P_k over the bins from the highest down, P and R being precision and recall of all that
    lies in bin k or above: the step-wise area of scikit-learn, exact for probabilities rounded to the bins.
    """
    precision, recall = precision_recall(histograms)
    steps = np.diff(recall[..., ::-1], prepend=0.0, axis=-1)
    area = (steps * np.nan_to_num(precision[..., ::-1])).sum(axis=-1)
    return np.where(np.isnan(recall[..., 0]), np.nan, area)


def precision_recall(histograms: NDArray[Any]) -> tuple[F64, F64]:
    """Return precision and recall of a threshold at each bin, float64[..., bin] each; nan for 0/0."""
    above = np.asarray(histograms, dtype=np.float64)[..., ::-1].cumsum(axis=-1)[..., ::-1]
    return ratio(above[..., 1, :], above.sum(axis=-2)), ratio(above[..., 1, :], above[..., 1, :1])


def roc_auc(histograms: NDArray[Any]) -> F64:
    """Return the area under the receiver operating characteristic, float64[...]; nan without both kinds.

    It is the probability that a positive has a higher bin than a negative; equal bins count half.
    """
    values = np.asarray(histograms, dtype=np.float64)
    below = values[..., 0, :].cumsum(axis=-1) - values[..., 0, :] / 2
    return ratio((values[..., 1, :] * below).sum(axis=-1), values.sum(axis=-1).prod(axis=-1))


def best_threshold(histograms: NDArray[Any]) -> int:
    """Return the lowest bin, from 1 on, with the best F1, and so the best IoU; 128 without a positive."""
    precision, recall = precision_recall(histograms)
    f1 = np.nan_to_num(ratio(2 * precision * recall, precision + recall))[1:]
    return int(np.argmax(f1)) + 1 if f1.max() > 0 else HALF


def reliability(histograms: NDArray[Any]) -> tuple[F64, F64, F64]:
    """Return number, sum of the probabilities and number of positives in 15 equal bins, float64[..., 15] each."""
    values = np.asarray(histograms, dtype=np.float64)
    probability = np.arange(BINS) / (BINS - 1)
    first = np.searchsorted(probability * RELIABILITY_BINS, np.arange(RELIABILITY_BINS) - 1e-9)
    sums = (values.sum(axis=-2), values.sum(axis=-2) * probability, values[..., 1, :])
    number, expected, positive = (np.add.reduceat(one, first, axis=-1) for one in sums)
    return number, expected, positive


def calibration_error(histograms: NDArray[Any]) -> F64:
    """Return the expected calibration error over 15 equal bins of probability, float64[...]; nan without a pixel.

    ECE = Σ n_b/N |f_b − p_b|, f_b being the frequency of the class and p_b the mean probability in bin b.

    References
    ----------
    Guo et al. (2017), On Calibration of Modern Neural Networks, ICML, equation 3.
    """
    number, expected, positive = reliability(histograms)
    return ratio(np.abs(positive - expected).sum(axis=-1), number.sum(axis=-1))


def ratio(above: Any, below: Any) -> F64:
    """Return a quotient, nan where its divisor is 0."""
    above, below = np.broadcast_arrays(np.asarray(above, np.float64), np.asarray(below, np.float64))
    return np.divide(above, below, out=np.full(above.shape, np.nan), where=below != 0)


# --- intervals ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Estimate:
    """Hold a figure and its values in the resamples, float64[resample]; nan: it has none."""

    value: float
    resampled: F64

    @property
    def interval(self) -> tuple[float, float]:
        """Return the middle 95 % of the resampled values; nan where fewer than half of the resamples have one."""
        finite = self.resampled[np.isfinite(self.resampled)]
        if not np.isfinite(self.value) or 2 * len(finite) < len(self.resampled):
            return float("nan"), float("nan")
        low, high = np.quantile(finite, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
        return float(low), float(high)

    def plain(self) -> dict[str, float | None]:
        """Return value, low and high for JSON, None in place of nan."""
        names = ("value", "low", "high")
        values = (self.value, *self.interval)
        return {name: float(v) if np.isfinite(v) else None for name, v in zip(names, values, strict=True)}

    @staticmethod
    def mean(estimates: list[Estimate]) -> Estimate:
        """Return the mean of those that have a value, in each resample too."""
        known = [one for one in estimates if np.isfinite(one.value)]
        if not known:
            return Estimate(float("nan"), np.full(RESAMPLES, np.nan))
        resampled = np.stack([one.resampled for one in known])
        number = np.isfinite(resampled).sum(axis=0)
        return Estimate(float(np.mean([one.value for one in known])), ratio(np.nansum(resampled, axis=0), number))


class Bootstrap:
    """Resample views with replacement. All figures get the same resamples, which follow from the seed alone.

    Parameters
    ----------
    view
        Number of the view of each sample, int64[sample].
    """

    def __init__(self, view: I64, seed: int = 0) -> None:
        self.views, self.view = len(np.unique(view)), np.unique(view, return_inverse=True)[1]
        self._seed = seed

    @cached_property
    def _drawn(self) -> F64:
        """Return how often each view is drawn in each resample, float64[resample, view]."""
        rng = keyed_random.rng(self._seed, 0, "score", "bootstrap")
        drawn = rng.integers(self.views, size=(RESAMPLES, self.views)) + self.views * np.arange(RESAMPLES)[:, None]
        return np.bincount(drawn.ravel(), minlength=drawn.size).reshape(drawn.shape).astype(np.float64)

    def figures(
        self, of_sample: NDArray[Any], statistic: Callable[[F64], Mapping[str, F64]]
    ) -> dict[str, Estimate]:
        """Return figures by name.

        Parameters
        ----------
        of_sample
            Counts of each sample, [sample, ...].
        statistic
            Gets sums of counts, float64[n, ...], and returns a figure of each, float64[n], by name.
        """
        values = np.asarray(of_sample, dtype=np.float64)
        of_view = np.zeros((self.views, int(np.prod(values.shape[1:]))))
        np.add.at(of_view, self.view, values.reshape(len(values), -1))
        sums = np.concatenate([of_view.sum(axis=0)[None], self._drawn @ of_view])
        found = statistic(sums.reshape(-1, *values.shape[1:]))
        return {name: Estimate(float(v[0]), np.asarray(v[1:])) for name, v in found.items()}

    def fraction(self, above: Any, below: Any) -> Estimate:
        """Return Σ above / Σ below of counts of each sample, [sample] each."""
        both = np.stack([np.asarray(above, np.float64), np.asarray(below, np.float64)], axis=1)
        return self.figures(both, lambda sums: {"": ratio(sums[:, 0], sums[:, 1])})[""]

    def ranked(self, truth: NDArray[np.bool_], score: NDArray[Any], statistic: Callable[[F64], F64]) -> Estimate:
        """Return a figure of a histogram [2, bin] of frames with a bin for each score that occurs.

        Parameters
        ----------
        truth, score
            bool[sample] and float[sample].
        statistic
            Gets histograms float64[n, 2, bin] and returns float64[n].
        """
        order = np.argsort(score, kind="stable")
        ranked = np.asarray(score, dtype=np.float64)[order]
        first = np.flatnonzero(np.diff(ranked, prepend=-np.inf))  # of each score that occurs
        weight = np.concatenate([np.ones((1, len(truth))), self._drawn[:, self.view]])[:, order]
        parts = [weight * ~truth[order], weight * truth[order]]
        out = statistic(np.stack([np.add.reduceat(part, first, axis=1) for part in parts], axis=1))
        return Estimate(float(out[0]), np.asarray(out[1:]))

    def median(self, values: NDArray[Any]) -> Estimate:
        """Return the median of the finite values, float[sample, ...], where nan stands for no value."""
        known = np.isfinite(values)
        if not known.any():
            return Estimate(float("nan"), np.full(RESAMPLES, np.nan))
        order = np.argsort(values[known], kind="stable")
        sorted_values = np.asarray(values[known][order], dtype=np.float64)
        view = self.view[np.nonzero(known)[0][order]]
        weight = np.concatenate([np.ones((1, len(order))), self._drawn[:, view]])
        total = weight.cumsum(axis=1)
        # the mean of the lower and the upper median, which are one for an odd number
        low = np.argmax(total >= total[:, -1:] / 2, axis=1)
        high = np.argmax(total > total[:, -1:] / 2, axis=1)
        medians = (sorted_values[low] + sorted_values[high]) / 2
        medians[total[:, -1] == 0] = np.nan
        return Estimate(float(medians[0]), medians[1:])
