"""Find the values of a three-colour image that need to be developed, where the sky sends no light.

The dark current of a short exposure and the read noise stay below half a grey level in most unlit pixels, which are
then 0. A value of the image never decreases with its variates, so one limit for each variate tells where that is
certain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .noise import NormalField, variates_of

F32 = NDArray[np.float32]

# Of all values. If more are chosen, it takes longer to choose them than to develop all.
_MOST_CHOSEN = 0.4

_CODES = np.arange(63, 65472, 64, dtype=np.uint16)  # tried as limits
_MOST_COUNTS = 8  # of dark electrons, tried as limits


@dataclass(frozen=True, kw_only=True, eq=False)
class Limits:
    """Hold the largest codes of shot noise, and of read noise as uint16[channel], with which unlit values are 0."""

    shot: np.uint16
    read: NDArray[np.uint16]


def noise_limits(
    collect: Callable[[F32, F32], F32], rgb: Callable[[F32, F32], NDArray[np.uint8]], channels: int
) -> Limits | None:
    """Return the limits of a sensor that choose the fewest values; None if they are more than `_MOST_CHOSEN`.

    Parameters
    ----------
    collect
        Function that returns the electrons of signals and variates of the shot noise.
    rgb
        Function that returns the image, uint8[1, n, channel], of electrons and variates of the read noise.
    channels
        Number of channels.
    """
    variates = variates_of(_CODES)
    counts = collect(np.zeros_like(variates), variates)
    read = np.repeat(variates[None, :, None], channels, axis=2)
    best, fewest = None, _MOST_CHOSEN
    for count in np.unique(counts)[:_MOST_COUNTS]:
        # No variate up to the limit gives a greater count, if counts never decrease with the variate. That is sure
        # where `poisson_on_dark` counts steps, at means of a few electrons. At greater means, so few variates give
        # the eight lowest counts that there are no limits, except where the full well bounds the counts.
        shot = np.count_nonzero(counts <= count)
        # 0 up to its limit, since no value decreases with its variate
        zeros = np.count_nonzero(rgb(np.full_like(read, count), read)[0] == 0, axis=0)
        chosen = 1 - zeros.mean() / len(_CODES) * shot / len(_CODES)
        if zeros.min() > 0 and chosen < fewest:
            best, fewest = Limits(shot=_CODES[shot - 1], read=_CODES[zeros - 1]), chosen
    return best


def values_to_develop(
    signal: F32, shot: NormalField | None, read: NormalField | None, limits: Limits | None
) -> NDArray[np.intp] | None:
    """Return the flat indices of the values that must be developed, intp[n]; None for all values.

    Without variates these are the lit values. All are developed if those chosen are too many, or if there are
    variates but no limits for them.
    """
    height, width, _ = signal.shape
    chosen = signal.reshape(height, -1) != 0
    if np.count_nonzero(chosen) > _MOST_CHOSEN * chosen.size:
        return None
    if shot is not None and read is not None:
        if limits is None:
            return None
        chosen |= shot.codes.reshape(height, -1) > limits.shot
        chosen |= read.codes.reshape(height, -1) > np.tile(limits.read, width)  # flat rows need no broadcasting
        if np.count_nonzero(chosen) > _MOST_CHOSEN * chosen.size:
            return None
    return np.flatnonzero(chosen)
