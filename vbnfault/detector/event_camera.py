"""Turn the light of a moving scene into the events of an event camera: pixels that tell when their light changed.

Each pixel of such a camera (a dynamic vision sensor) remembers the logarithm of its light. Where the logarithm has
risen by one threshold above what is remembered, the pixel sends an ON event; where it has fallen by one threshold
below, an OFF event; and what is remembered moves by the threshold (Gallego et al. 2020, IEEE TPAMI 44, 154;
Rebecq et al. 2018, CoRL, "ESIM"). Shot noise falls with the light as in Hu, Liu & Delbruck 2021, CVPRW ("v2e"), and
the leak is as in Nozaki & Delbruck 2017, IEEE TED 64, 3239.

Between two images the logarithm is interpolated linearly. So events do not depend on where time is cut into steps
as long as the logarithm is linear there: leak, refractory period and noise are kept in absolute time. Only the low
pass of `cutoff_hz` is exact at the images alone, and is interpolated between them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core.tables import Fraction, Table

F64 = NDArray[np.float64]

# One event, as in the HDF5 files of Prophesee: column, row, polarity (1: ON, 0: OFF), and time in microseconds.
EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])

_LEAST_THRESHOLD = 0.01  # of a pixel whose threshold is drawn; v2e has the same
_DIMMED_BY = 0.75  # how much less shot noise bright pixels have (v2e)
_NOISE_AT_ONCE = 100_000  # noise events that are drawn together, before dim and bright pixels are told apart


class EventCamera(Table):
    """Describe an event camera, for `vbnfault event-camera`: its pixels tell when the logarithm of light changes.

    Lens, number of pixels and spectral response are those of `[camera]`.
    """

    threshold_on: float = Field(
        0.2, ge=0.01, le=5, description="rise of the natural logarithm of light per ON event"
    )
    threshold_off: float = Field(0.2, ge=0.01, le=5, description="its fall per OFF event")
    threshold_sigma: float = Field(
        0.03, ge=0, le=1, description="standard deviation of both thresholds from pixel to pixel"
    )
    refractory_s: float = Field(
        0.0005, ge=0, le=10, description="time after an event in which its pixel sends none"
    )
    dark_e_s: float = Field(
        1000.0, ge=1e-6, le=1e12, description="dark signal, which is added to the light before the logarithm"
    )
    cutoff_hz: float | None = Field(
        None, ge=0.01, le=1e7, description="cutoff of the first-order low pass of the photoreceptor; default: none"
    )
    leak_rate_hz: float = Field(0.1, ge=0, le=1000, description="ON events of each pixel without any change")
    shot_noise_rate_hz: float = Field(
        0.1,
        ge=0,
        le=1e5,
        description="noise events of a dark pixel, ON and OFF alike; they fall linearly to a quarter at bright_e_s",
    )
    bright_e_s: float = Field(1e6, ge=1e-3, le=1e15, description="signal from which noise events stay few")
    hot_pixel_fraction: Fraction = Field(0.0, description="fraction of pixels that send ON events all the time")
    hot_pixel_rate_hz: float = Field(100.0, ge=0, le=1e6, description="how many they send")
    step_px: float = Field(
        1.0, ge=0.05, le=16, description="how far the ground in view moves at most from one render to the next"
    )


class EventPixels:
    """Send the events of an event camera while its light changes.

    Parameters
    ----------
    camera
        The camera.
    shape
        Rows and columns.
    device_rng, rng
        Give the generator of a name: for what belongs to the device, and for its noise. Each name has its own.
    """

    def __init__(
        self,
        camera: EventCamera,
        shape: tuple[int, int],
        device_rng: Callable[[str], np.random.Generator],
        rng: Callable[[str], np.random.Generator],
    ) -> None:
        self._camera, self._columns, self._rng = camera, shape[1], rng
        count = shape[0] * shape[1]

        def thresholds(name: str, mean: float) -> F64:
            """Return the thresholds of all pixels, float64[pixel]."""
            drawn = mean + camera.threshold_sigma * device_rng(f"threshold_{name}").standard_normal(count)
            return np.maximum(drawn, _LEAST_THRESHOLD)

        self.threshold_on = thresholds("on", camera.threshold_on)
        self.threshold_off = thresholds("off", camera.threshold_off)
        self.hot = np.flatnonzero(device_rng("hot").random(count) < camera.hot_pixel_fraction)
        # a leak has no common beginning: each pixel is somewhere on its way to the next event
        phase = rng("leak").random(count) if camera.leak_rate_hz else np.zeros(count)
        self._above = phase * self.threshold_on  # the logarithm above what is remembered
        self._last_s = np.full(count, -np.inf)  # time of the last event of each pixel
        self._time_s: float | None = None
        self._log = self._passed = np.zeros(count)  # the logarithm before and behind the low pass
        self._shot_hz, self._hot_hz = camera.shot_noise_rate_hz * count, camera.hot_pixel_rate_hz * len(self.hot)
        self._drawn: tuple[int, tuple[NDArray[Any], ...]] | None = None

    def advance(self, electrons_s: NDArray[np.floating[Any]], time_s: float) -> NDArray[Any]:
        """Return the events since the image before, EVENT[n], by time; none at the first image.

        Parameters
        ----------
        electrons_s
            [y, x]: expected electrons per second of each pixel at `time_s`, without noise and dark signal.
        time_s
            Time of the image, later than that of the one before. Events have the times of the same clock.
        """
        log = np.log(np.maximum(electrons_s.ravel().astype(np.float64), 0) + self._camera.dark_e_s)
        begin_s, before, self._time_s, self._log = self._time_s, self._log, time_s, log
        if begin_s is None:
            self._passed = log
            return np.zeros(0, EVENT)
        passed = self._low_passed(before, log, time_s - begin_s)
        leaked = self._camera.leak_rate_hz * (time_s - begin_s) * self.threshold_on
        rise = passed - self._passed + leaked
        self._passed = passed
        changes = self._crossings(rise, begin_s, time_s)
        noise = self._noise(before, begin_s, time_s)
        seconds, pixel, is_on = (np.concatenate(parts) for parts in zip(changes, noise, strict=True))
        order = np.lexsort((pixel, seconds))
        out = np.zeros(len(order), EVENT)
        out["y"], out["x"] = np.divmod(pixel[order], self._columns)
        out["p"] = is_on[order]
        out["t"] = np.rint(seconds[order] * 1e6)
        return out

    def _low_passed(self, before: F64, log: F64, step_s: float) -> F64:
        """Return the logarithm behind the low pass at the end of a step in which it changes linearly before it."""
        if self._camera.cutoff_hz is None:
            return log
        tau_s = 1 / (2 * np.pi * self._camera.cutoff_hz)
        lag = (log - before) * (tau_s / step_s)  # of the output behind a ramp that lasts
        return log - lag + (self._passed - before + lag) * np.exp(-step_s / tau_s)

    def _crossings(
        self, rise: F64, begin_s: float, end_s: float
    ) -> tuple[F64, NDArray[np.intp], NDArray[np.bool_]]:
        """Return time in s, pixel and polarity of the events of a step, and move what is remembered.

        An event that comes within the refractory period of the one before is not sent, but moves what is
        remembered.
        """
        start, end = self._above, self._above + rise
        self._above = end
        found: list[tuple[F64, NDArray[np.intp], NDArray[np.bool_]]] = [
            (np.zeros(0), np.zeros(0, np.intp), np.zeros(0, bool))
        ]
        for sign, threshold in ((1, self.threshold_on), (-1, self.threshold_off)):
            pixel = np.flatnonzero(sign * end >= threshold)
            count = np.floor(sign * end[pixel] / threshold[pixel])
            self._above[pixel] -= sign * count * threshold[pixel]
            for k in range(1, int(count.max(initial=0)) + 1):
                here = pixel[count >= k]
                level = sign * k * threshold[here]
                part = (level - start[here]) / rise[here]
                seconds = begin_s + np.clip(part, 0, 1) * (end_s - begin_s)
                sent = seconds - self._last_s[here] >= self._camera.refractory_s
                here, seconds = here[sent], seconds[sent]
                self._last_s[here] = seconds
                found.append((seconds, here, np.full(len(here), sign > 0)))
        seconds, pixel, is_on = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return seconds, pixel, is_on

    def _noise(self, before: F64, begin_s: float, end_s: float) -> tuple[F64, NDArray[np.intp], NDArray[np.bool_]]:
        """Return time in s, pixel and polarity of noise events, which leave what is remembered as it is.

        They are Poisson processes in absolute time, drawn for spans that do not depend on the steps.
        """
        rate_hz, parts = self._shot_hz + self._hot_hz, []
        if rate_hz:
            span_s = _NOISE_AT_ONCE / rate_hz
            for k in range(int(begin_s // span_s), int(end_s // span_s) + 1):
                if self._drawn is None or self._drawn[0] != k:
                    self._drawn = k, self._drawn_noise(k, span_s)
                seconds = self._drawn[1][0]
                parts.append([v[(seconds >= begin_s) & (seconds < end_s)] for v in self._drawn[1]])
        if not parts:
            return np.zeros(0), np.zeros(0, np.intp), np.zeros(0, bool)
        seconds, pixel, is_on, chance = (np.concatenate(values) for values in zip(*parts, strict=True))
        part = (seconds - begin_s) / (end_s - begin_s)
        log = before[pixel] + part * (self._log[pixel] - before[pixel])
        bright = np.minimum((np.exp(log) - self._camera.dark_e_s) / self._camera.bright_e_s, 1)
        kept = chance < 1 - _DIMMED_BY * bright
        return seconds[kept], pixel[kept], is_on[kept]

    def _drawn_noise(self, k: int, span_s: float) -> tuple[NDArray[Any], ...]:
        """Return time in s, pixel, polarity and chance of the noise events of a span, as if all pixels were dark.

        A pixel keeps an event whose chance is below its own; those of hot pixels have none to fail.
        """
        rng = self._rng(f"noise {k}")
        shot, hot = rng.poisson(self._shot_hz * span_s), rng.poisson(self._hot_hz * span_s)
        seconds = (k + rng.random(shot + hot)) * span_s
        pixel = rng.integers(len(self._log), size=shot)
        is_on = np.concatenate([rng.random(shot) < 0.5, np.ones(hot, bool)])
        chance = np.concatenate([rng.random(shot), np.full(hot, -1.0)])
        return (
            seconds,
            np.concatenate([pixel, self.hot[rng.integers(max(len(self.hot), 1), size=hot)]]),
            is_on,
            chance,
        )
