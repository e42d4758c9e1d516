"""Fit noise, patterns and point spread to frames that were not taken for it: sky, smooth ground, and stars.

The noise of smooth blocks over their level gives gain and read noise, what blocks of different frames have in
common gives the fixed pattern of pixels, and what columns of their sky have in common that of columns. What
rounding, clipping, stretch and reduction do to these is simulated, with the same estimators on simulated sky.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats
from scipy.special import ndtr

from ..detector.noise import draw_normals, poisson
from ..detector.sensor import Sensor
from .exposures import F32, F64, OUTLIER, TWO_SIDED, Estimate, Exposure, Mask, Transfer, planes_of
from .replay import Display, reduced
from .stars import STAR_PX, stars

# Immerkær 1996, doi 10.1006/cviu.1996.0060: levels that change linearly, and those of rows and columns, cancel
_LAPLACE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32) / 6
_BLOCK_PX, _LEVELS, _FEWEST_BLOCKS, _SIMULATED_PX = 16, 8, 8, 256
_QUANTILES = 0.25, 0.5  # of the variances of blocks of one level: the lower one is free of texture for longer
# of a block's variance: the kernel makes neighbours correlate, Σρ² = (70/36)²
_BLOCK_DEGREES = (_BLOCK_PX**2 - 1) / (70 / 36) ** 2
_TEXTURED = 0.2  # relative difference of these quantiles above which blocks show more than noise
_SMOOTH = 2.0  # blocks of up to so many times the variance of their level count as smooth
_MODEL_ERROR = 0.01  # of a simulated variance: that of a quantile of its 256 blocks
_PROCESSING_ERROR = 0.25  # of a simulated shared pattern: processed frames may share more than offsets of pixels
_COLUMN_PX, _FEWEST_ROWS, _FEWEST_COLUMNS = 15, 32, 32
_UNLIKE = 1e6  # errors by which a simulation without sky counts as off
_FEWEST_STARS = 5
_CORE_PX = (0.3, 4.0)
_RESPONSE_ERROR = 0.005  # of the width of a star, for what a bent response and neighbours make of its shape


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks:
    """Hold the blocks of 16 px squared of an image: mean and noise, float64[block], and rough pixels.

    `rough` is float32[block, pixel]. Blocks of which a fifth lies at an end of the range have NaN.
    """

    level: F64
    variance: F64
    rough: F32

    @classmethod
    def of(cls, image: F32, top: float = math.inf) -> Blocks:
        """Return the blocks of an image whose largest number is `top`. Hits and stars count as no noise."""
        cut = _cut(cv2.filter2D(image, -1, _LAPLACE))
        limit = OUTLIER * np.maximum(1.4826 * np.median(np.abs(cut), axis=1, keepdims=True), 0.5)
        cut = np.where(np.abs(cut) > limit, 0, cut)
        cut[_cut((image <= 0) | (image >= top)).mean(axis=1) > 0.2] = np.nan
        level = _cut(image).mean(axis=1, dtype=np.float64)
        return cls(level=level, variance=np.square(cut, dtype=np.float64).mean(axis=1), rough=cut)

    def quantile(self, chosen: NDArray[Any], part: float) -> float:
        """Return the variance of noise for which a quantile of the variances of chosen blocks stands."""
        expected = float(stats.chi2.ppf(part, _BLOCK_DEGREES)) / _BLOCK_DEGREES
        return float(np.quantile(self.variance[chosen], part)) / expected


def _cut(image: NDArray[Any]) -> NDArray[Any]:
    """Return the pixels of each block of an image, [block, pixel]."""
    rows, columns = (length // _BLOCK_PX for length in image.shape)
    cut = image[: rows * _BLOCK_PX, : columns * _BLOCK_PX].reshape(rows, _BLOCK_PX, columns, _BLOCK_PX)
    return cut.swapaxes(1, 2).reshape(rows * columns, _BLOCK_PX**2)


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyNoise:
    """Hold noise and shared pattern of smooth blocks of frames by level, float64[bin], with their errors.

    `smooth` bool[block] are the smooth blocks of each frame.
    """

    level: F64
    variance: F64
    error: F64
    shared: F64
    shared_error: F64
    smooth: list[NDArray[np.bool_]]


def sky_noise(blocks: Sequence[Blocks], black: float) -> SkyNoise:
    """Return noise and shared pattern of frames of different scenes."""
    heights = [np.where(np.isfinite(b.variance), np.sqrt(np.maximum(b.level - black, 0)), np.nan) for b in blocks]
    # where most blocks are, and over all levels
    is_lit = np.isfinite(heights).any()
    dense = np.nanpercentile(heights, (0.2, 3, 10, 25, 50, 75, 90, 97, 99.5)) if is_lit else np.zeros(1)
    edges = np.unique(np.append(dense, np.linspace(float(dense[0]), float(dense[-1]), _LEVELS + 1)))
    place = [np.searchsorted(edges, one) - 1 for one in heights]  # NaN lies beyond the last
    smooth = [np.zeros(len(one), dtype=bool) for one in place]
    rows = []
    for k in range(len(edges) - 1):
        values = []
        for one, where, calm in zip(blocks, place, smooth, strict=True):
            chosen = np.flatnonzero(where == k)
            if len(chosen) >= _FEWEST_BLOCKS:
                values.append((one.level[chosen].mean(), *(one.quantile(chosen, q) for q in _QUANTILES)))
                calm[chosen] = one.variance[chosen] < _SMOOTH * values[-1][1]
        if len(values) < min(3, len(blocks)):
            continue
        level, low, high = np.median(values, axis=0)
        # texture raises the higher quantile first
        texture = max(float(high - low), 0.0)
        error = math.hypot(_error_of_median([v[1] for v in values]), texture, _MODEL_ERROR * low)
        products = []
        for a, b in _pairs(len(blocks)):
            both = smooth[a] & smooth[b] & (place[a] == k) & (place[b] == k)
            if both.sum() >= _FEWEST_BLOCKS:
                products.append(float((blocks[a].rough[both] * blocks[b].rough[both]).mean()))
        shared = (float(np.median(products)), _error_of_median(products)) if len(products) > 2 else (math.nan,) * 2
        if texture > _TEXTURED * low:  # frames may share the scene
            shared = math.nan, math.nan
            smooth = [calm & (where != k) for calm, where in zip(smooth, place, strict=True)]
        rows.append((level, low, error, *shared))
    columns = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    return SkyNoise(**dict(zip(SkyNoise.__annotations__, columns, strict=False)), smooth=smooth)


def _pairs(count: int) -> Iterator[tuple[int, int]]:
    """Give pairs of frames that lie a third and a half of their number apart, so that they share no scene."""
    steps = {max(count // part, 1) for part in (2, 3)}
    return ((a, a + step) for step in sorted(steps) for a in range(count - step))


def _error_of_median(values: Sequence[float]) -> float:
    """Return the standard error of a median, from the deviations of the values."""
    spread = 1.4826 * float(np.median(np.abs(np.array(values) - np.median(values))))
    return 1.2533 * max(spread, 1e-9) / math.sqrt(len(values))


def _as_it_is(raw: F32) -> F32:
    return raw


class SkyModel:
    """Simulate what frames show of even light at some signals in DN, by gain, read noise and DSNU.

    Parameters
    ----------
    show
        Function from raw numbers to what frames show, reduced by `factor`.
    sensor
        The sensor, for its range and the tails of its offsets.
    black_dn
        Level without light.
    """

    def __init__(self, show: Callable[[F32], F32], sensor: Sensor, black_dn: float, factor: int) -> None:
        self.show, self.black_dn, self.top_dn = show, black_dn, sensor.readout.top_dn
        self.is_raw = show is _as_it_is
        # noise of stretched numbers rises and falls with the level: a search must begin near the sensor's own
        own = sensor.readout.system_gain_dn_per_e, sensor.readout.read_noise_e_rms, sensor.individual.dsnu_e
        self.start = (self.top_dn / 5e4, 5.0, 3.0) if self.is_raw else np.maximum(own, (1e-4, 0.5, 0.5))
        rng, size = np.random.default_rng(0), (_SIMULATED_PX * factor,) * 2
        self.noise = [
            (draw_normals(size, rng), draw_normals(size, rng).values()) for _ in range(2)
        ]  # of two frames
        # levels of real sky have all fractions of a step
        self.ramp = np.tile(np.linspace(0.85, 1.15, size[1], dtype=np.float32), (size[0], 1))
        freedom = sensor.individual.dsnu_freedom
        self.fixed = rng.standard_normal(size, dtype=np.float32)
        if freedom is not None:
            self.fixed = (rng.standard_t(freedom, size) * math.sqrt(1 - 2 / freedom)).astype(np.float32)

    def __call__(self, signals_dn: F64, per_e: float, read_e: float, dsnu_e: float) -> tuple[F64, F64, F64]:
        """Return level, noise and shared pattern, float64[signal], in what frames show."""
        out = []
        for signal_dn in signals_dn:
            pair = []
            for shot, read in self.noise:
                electrons = poisson(self.ramp * np.float32(signal_dn / per_e), shot)
                electrons += read * np.float32(read_e) + self.fixed * np.float32(dsnu_e)
                raw = np.clip(np.rint(electrons * np.float32(per_e) + np.float32(self.black_dn)), 0, self.top_dn)
                pair.append(Blocks.of(self.show(raw)))
            chosen = np.flatnonzero(np.isfinite(pair[0].variance + pair[1].variance))
            if len(chosen) >= _FEWEST_BLOCKS:
                noise = np.mean([one.quantile(chosen, _QUANTILES[0]) for one in pair])
                common = (pair[0].rough[chosen] * pair[1].rough[chosen]).mean()
                out.append((np.mean([one.level.mean() for one in pair]), noise, common))
        level, variance, shared = np.array(out, dtype=np.float64).reshape(-1, 3).T
        return level, variance, shared


def tile_of(sensor: Sensor) -> tuple[int, int]:
    """Return the number of rows and columns of a mosaic's tile; of a monochrome sensor one each."""
    return sensor.pattern.shape if len(sensor.pattern.channels) > 1 else (1, 1)


def fit_ordinary(
    frames: Sequence[Exposure], sensor: Sensor, black_dn: float | None, stretch: float | None
) -> tuple[dict[str, Estimate], Transfer | None]:
    """Return what ordinary frames tell of a sensor, by the keys of its file, and their photon transfer.

    Parameters
    ----------
    frames
        Frames of different scenes, raw or, with `stretch`, as `fit_sensor` says.
    black_dn
        Level without light; None: that of the darkest sky, whose light then counts as black.
    """
    images = [one.image.astype(np.float32) for one in frames]
    tile = tile_of(sensor)
    factor = 1 if stretch is None else sensor.width_px // images[0].shape[1]
    top = float(max(one.max() for one in images))
    blocks = [
        [Blocks.of(plane, top) for plane in planes]
        for planes in zip(*(planes_of(image, tile) for image in images), strict=True)
    ]
    out: dict[str, Estimate] = {}
    if black_dn is None:
        levels = [np.where(np.isfinite(b.variance), b.level, np.nan) for plane in blocks for b in plane]
        darkest = [float(np.nanpercentile(one, 1)) for one in levels if np.isfinite(one).any()]
        if not darkest:  # all is black or saturated
            return {}, None
        black_dn = float(np.min(darkest))
        method = f"darkest sky of {len(frames)} frames; its light counts as black"
        spread = _error_of_median(darkest)
        out["readout.bias_dn"] = Estimate.normal(black_dn, spread, method)
    offset_dn = float(np.mean(sensor.readout.node_offsets_dn or (0.0,)))
    display = Display(bias_dn=sensor.readout.bias_dn, top_dn=sensor.readout.top_dn, stretch=stretch or 1.0)
    show = _as_it_is if stretch is None else (lambda raw: display.developed(raw, factor))
    planes = [sky_noise(one, 0.0 if stretch else black_dn) for one in blocks]
    model = SkyModel(show, sensor, black_dn + offset_dn * (stretch is not None), factor)
    highest = max((float(one.level.max()) for one in planes if len(one.level)), default=0.0)
    most_dn = highest - black_dn if stretch is None else display.fraction(highest) * (display.top_dn - black_dn)
    count = 12 if stretch is None else 30
    signals = np.concatenate([[0.0], np.geomspace(0.3, max(1.5 * most_dn, 3.0), count)])
    found, transfer = _fitted_noise(planes, model, signals, len(frames))
    out |= found
    if transfer is not None and len(planes) == 1:
        gain = out["readout.gain_dn_per_e"]
        power, range_dn = stretch or 1.0, display.top_dn - display.bias_dn

        def rise(level: Any) -> Any:
            """Return by how much a level of the frames, (signal / range)^power, rises with the signal in DN."""
            if stretch is None:
                return np.ones_like(level)
            return 255 * power / range_dn * (np.maximum(level, 1) / 255) ** (1 - 1 / power)

        pattern = _column_pattern(images, planes[0].smooth, rise, factor)
        if pattern is not None:
            out["readout.column_pattern_e_rms"] = pattern.root().over(gain.value, gain.error / gain.value)
    return out, transfer


def _fitted_noise(
    planes: Sequence[SkyNoise], model: SkyModel, signals_dn: F64, frames: int
) -> tuple[dict[str, Estimate], Transfer | None]:
    """Return gain, read noise and DSNU that make simulated sky as noisy as that of frames."""
    level, variance, error, shared, shared_error = (
        np.concatenate([getattr(one, name) for one in planes])
        for name in ("level", "variance", "error", "shared", "shared_error")
    )
    if len(level) < 4:
        return {}, None
    paired = np.isfinite(shared)
    shared_error = np.hypot(shared_error, (_MODEL_ERROR if model.is_raw else _PROCESSING_ERROR) * shared)

    def expected(logs: F64) -> tuple[F64, F64]:
        x, noise, fixed = model(signals_dn, *np.exp(logs))
        if not len(x):  # all that it simulates is black or saturated
            return np.full_like(level, np.nan), np.full_like(level, np.nan)
        return np.interp(level, x, noise), np.interp(level, x, fixed)

    def off(logs: F64) -> F64:
        noise, fixed = expected(logs)
        out = np.concatenate([(noise - variance) / error, ((fixed - shared) / shared_error)[paired]])
        return np.nan_to_num(out, nan=_UNLIKE)

    start = np.log(model.start)
    best = optimize.least_squares(off, start, diff_step=0.05, x_scale=0.3, loss="soft_l1", ftol=1e-3, xtol=1e-3)
    simulated = expected(best.x)[0]
    if np.isnan(simulated).any():
        return {}, None
    degrees = max(len(best.fun) - 3, 1)
    scatter = max(2 * best.cost / degrees, 1.0)
    errors = np.sqrt(np.diag(np.linalg.pinv(best.jac.T @ best.jac)) * scatter)
    method = f"noise of smooth blocks of {frames} frames at {len(level)} levels, simulated"
    out = {}
    keys = ("readout.gain_dn_per_e", "readout.read_noise_e_rms", "individual.dsnu_e")
    for key, log, wide in zip(keys, best.x, errors, strict=True):
        if key == keys[0] and wide > 0.5:  # no light whose noise could be told
            return {}, None
        low, high = (math.exp(log + sign * min(TWO_SIDED * wide, 5.0)) for sign in (-1, 1))
        out[key] = Estimate(value=math.exp(log), low=low if wide < 0.5 else 0.0, high=high, method=method)
    order = np.argsort(level)
    points = {"level_dn": level, "variance_dn2": variance, "error_dn2": error, "fitted_dn2": simulated}
    return out, Transfer(**{name: values[order] for name, values in points.items()})


def _column_pattern(
    images: Sequence[F32], smooth: Sequence[NDArray[np.bool_]], rise: Callable[[Any], Any], factor: int
) -> Estimate | None:
    """Return the variance in DN² of the columns of the sensor, from what columns of smooth sky have in common.

    `rise` gives by how much a level of the frames rises with the signal.
    """
    profiles = []
    for image, calm in zip(images, smooth, strict=True):
        rows, columns = (length // _BLOCK_PX for length in image.shape)
        mask = np.kron(calm.reshape(rows, columns), np.ones((_BLOCK_PX, _BLOCK_PX))).astype(np.float32)
        part = image[: mask.shape[0], : mask.shape[1]]
        part = np.where(np.abs(part - cv2.medianBlur(part, 5)) < OUTLIER * 2, part, cv2.medianBlur(part, 5))
        sums = [cv2.blur(one, (_COLUMN_PX, 1)) for one in (part * mask, mask)]
        level = sums[0] / np.maximum(sums[1], 1e-6)
        weight = rise(level) * mask  # levels that rise steeply tell most
        count, sums = mask.sum(axis=0), [(one * weight).sum(axis=0) for one in (part - level, rise(level))]
        profile = np.where(count >= _FEWEST_ROWS, sums[0] / np.maximum(sums[1], 1e-9), np.nan)
        # few columns that are lost or lie beside the body must not decide
        limit = 3 * 1.4826 * float(np.nanmedian(np.abs(profile))) if np.isfinite(profile).any() else 0.0
        profiles.append(np.clip(profile, -limit, limit))
    products = []
    for a, b in _pairs(len(profiles)):
        both = np.isfinite(profiles[a] + profiles[b])
        if both.sum() >= _FEWEST_COLUMNS:
            products.append(float(np.mean(profiles[a][both] * profiles[b][both])))
    if len(products) < 3:
        return None
    # what the running mean takes, and the reduction of columns that are random
    lines = np.random.default_rng(0).standard_normal(4096 * factor, dtype=np.float32)
    left = float(reduced(np.tile(lines, (4 * factor, 1)), factor).var()) * (1 - 1 / _COLUMN_PX)
    shared = float(np.median(products)) / left
    error = math.hypot(_error_of_median(products) / left, shared * math.sqrt(2 / len(profiles[0])))
    return Estimate.normal(shared, error, f"columns of smooth sky that {len(images)} frames share")


# --- stars --------------------------------------------------------------------------------------------------------


def fit_point_spread(frames: Sequence[Exposure], sensor: Sensor, good: Mask | None) -> Estimate | None:
    """Return the standard deviation in px of the core of stars' images, from isolated ones that do not saturate.

    Gaussians integrated over pixels are fitted. `good` bool[y, x] are pixels without defects.
    """
    tile = np.array(sensor.pattern.tile)
    channel = np.tile(tile, [-(-n // m) for n, m in zip(frames[0].image.shape, tile.shape, strict=True)])
    widths = []
    for one in frames:
        image = one.image.astype(np.float32)
        top = 0.9 * min(float(image.max()), sensor.readout.top_dn)
        for row, column in stars(image, top, good):
            part = slice(row - STAR_PX, row + STAR_PX + 1), slice(column - STAR_PX, column + STAR_PX + 1)
            if (width := _width_px(image[part], channel[part])) is not None:
                widths.append(width)
    if len(widths) < _FEWEST_STARS:
        return None
    value = float(np.median(widths))
    drawn = np.median(np.random.default_rng(0).choice(widths, (2000, len(widths))), axis=1)
    error = math.hypot(float(drawn.std()), _RESPONSE_ERROR * value)
    return Estimate.normal(value, error, f"images of {len(widths)} stars")


def _width_px(part: F32, channel: NDArray[Any]) -> float | None:
    """Return the standard deviation of a star's image, or None if none fits.

    Each channel has a flux and a background of its own.
    """
    axis = np.arange(len(part)) - STAR_PX
    kinds = [channel == k for k in np.unique(channel)]

    def columns(x: F64) -> NDArray[Any]:
        sides = [np.diff(ndtr((np.append(axis, axis[-1] + 1) - 0.5 - middle) / x[2])) for middle in x[:2]]
        shape = np.outer(*sides)
        return np.column_stack([(one * kind).ravel() for kind in kinds for one in (shape, np.ones_like(shape))])

    def rest(x: F64) -> F64:
        design = columns(x)
        best, *_ = np.linalg.lstsq(design, part.ravel(), rcond=None)
        return np.asarray(part.ravel() - design @ best, dtype=np.float64)

    low, high = [-1.0, -1.0, _CORE_PX[0]], [1.0, 1.0, _CORE_PX[1]]
    found = optimize.least_squares(rest, [0.0, 0.0, 1.0], bounds=(low, high))
    width = float(found.x[2])
    spread = float(part.std())
    fits = _CORE_PX[0] * 1.05 < width < _CORE_PX[1] * 0.95 and math.sqrt(2 * found.cost / part.size) < 0.3 * spread
    return width if fits else None
