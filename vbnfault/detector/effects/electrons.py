"""Define what adds electrons in the pixels: dark current, telegraph signals and shot noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..charge import passing_dark_e
from ..dark import Telegraph
from ..noise import poisson
from .contract import F32, Effect, Exposure, FaultStep


class DarkCurrent(Effect):
    """Add the dark current of each pixel, also that which its charge collects while it is transferred."""

    name = "dark_current"
    after = "smear"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons with dark current, without telegraph signals."""
        device, factor = exposure.device, dark_factor(exposure)
        dark_s = exposure.exposure_s * factor
        out = np.asarray(cv2.scaleAdd(device.dark_rate_e_s, dark_s, signal))
        moved = device.transfer_dark_e
        if moved is None:
            return out
        return cv2.add(out, moved) if factor == 1 else np.asarray(cv2.scaleAdd(moved, factor, out))


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
        upper = signals.duty if noise is None else upper_fraction(signals, exposure.exposure_s, *noise.telegraph)
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
        return signal if exposure.noise is None else poisson(signal, exposure.noise.shot)


class ChargeStep(FaultStep):
    """Let faults act on the collected electrons."""

    name = "charge"
    after = "shot_noise"


def dark_factor(exposure: Exposure) -> float:
    """Return the dark current of an exposure over that at the sensor's mean temperature; 1 without noise.

    Damaged pixels follow the temperature by nearly the law of silicon, so the factor of undamaged ones serves both.
    """
    mean_K, drift_K = exposure.device.temperature_K, exposure.sensor.temperature_drift_K
    rng = exposure.rng("temperature") if drift_K else None
    if rng is None:
        return 1.0
    spec = replace(exposure.sensor.individual, reference_K=mean_K)
    return spec.dark_factor(mean_K + drift_K * float(np.clip(rng.standard_normal(), -3, 3)))


def upper_fraction(
    signals: Telegraph, exposure_s: float, seed: int, time_s: float | None = None
) -> NDArray[np.float64]:
    """Return the fraction of an exposure that each telegraph signal spends in its upper level, float64[n].

    With `time_s`, at which the exposure begins, all exposures of a seed see one course of the signals.
    """
    if time_s is not None:
        return signals.expose_at(time_s, exposure_s, seed)
    rng = np.random.default_rng(seed)
    return signals.expose(signals.start(rng), exposure_s, rng)[0]
