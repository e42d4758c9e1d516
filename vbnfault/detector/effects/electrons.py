"""Define what adds electrons in the pixels: dark current, telegraph signals and shot noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..dark import Telegraph
from ..noise import poisson_quantile
from ..transfer import passing_dark_e
from .contract import F32, Effect, Exposure, FaultStep


class DarkCurrent(Effect):
    """Add the dark current of each pixel, also that which its charge collects while it is transferred."""

    name = "dark_current"
    after = "smear"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons with dark current, without telegraph signals."""
        device = exposure.device
        out = np.asarray(cv2.scaleAdd(device.dark_rate_e_s, exposure.exposure_s, signal))
        return out if device.transfer_dark_e is None else cv2.add(out, device.transfer_dark_e)


class TelegraphSignals(Effect):
    """Add the electrons of pixels whose dark current switches between two levels."""

    name = "telegraph"
    after = "dark_current"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons with telegraph signals; without noise, with the expected ones."""
        device, pixels = exposure.device, exposure.device.individual.rts
        if not len(pixels):
            return signal
        signals, noise = device.telegraph, exposure.noise
        upper = signals.duty if noise is None else upper_fraction(signals, exposure.exposure_s, noise.seed)
        high_e_s = signals.amplitude_e_s * upper
        np.add.at(signal, (pixels.row, pixels.column), high_e_s * exposure.exposure_s)
        if device.transfer_dark_e is not None:  # charge that passes these pixels collects this signal, too
            rate = np.zeros_like(signal)
            np.add.at(rate, (pixels.row, pixels.column), high_e_s)
            signal += passing_dark_e(device.sensor, rate, device.direction)
        return signal


class PixelsStep(FaultStep):
    """Let faults act on all electrons that are expected in each pixel."""

    name = "pixels"
    after = "telegraph"


class ShotNoise(Effect):
    """Draw the electrons that are collected from those that are expected."""

    name = "shot_noise"
    after = "pixels"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the collected electrons; without noise, the expected ones."""
        return signal if exposure.noise is None else poisson_quantile(signal, exposure.noise.shot)


class ChargeStep(FaultStep):
    """Let faults act on the collected electrons."""

    name = "charge"
    after = "shot_noise"


def upper_fraction(signals: Telegraph, exposure_s: float, seed: int) -> NDArray[np.float64]:
    """Return the fraction of an exposure that each telegraph signal spends in its upper level, float64[n]."""
    rng = np.random.default_rng(seed)
    return signals.expose(signals.start(rng), exposure_s, rng)[0]
