"""Fit a sensor to a camera's frames: each parameter with an interval of 95 % and its method, or why it has none.

Raw darks and flats give closed forms, after EMVA 1288 release 4.0 and Janesick (2001, Scientific Charge-Coupled
Devices): variances in time over signals (photon transfer), from which fixed patterns cancel, and covariances of
frames, from which noise cancels. Ordinary frames give the noise of their smooth parts over its level, and the
patterns that they share; what stretch, reduction and rounding of published frames do to these is simulated.

Intervals hold the errors of sampling one device, those of gain and bias, the drift of the bias, and the scatter of
points about the model where it exceeds their own errors.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from scipy import optimize, stats

from ..core.errors import InputError
from ..core.files import resources, toml_files
from ..detector.measured import smooth_surface
from ..detector.sensor import Sensor, parse_sensor
from .exposures import (
    F32,
    F64,
    LEAST_VARIANCE_DN2,
    OUTLIER,
    ROUNDING_DN2,
    TWO_SIDED,
    Estimate,
    Exposure,
    Group,
    Mask,
    Transfer,
    count_estimate,
    covariance_estimate,
    group_of,
    inside,
    noise_before_rounding,
    ordinary_pixels,
    planes_of,
    smoothed_pixels,
    variance_estimate,
)
from .ordinary import fit_ordinary, fit_point_spread, tile_of

# Fractions of saturation: for lines (EMVA 1288 section 6.6), for the response, and from which patterns count. A
# flat is saturated where its variance is below this fraction of the line's.
_LINEAR, _UNSATURATED, _BRIGHT, _COLLAPSED = 0.7, 0.9, 0.1, 0.3
_SAME_LEVEL = 0.05  # largest relative difference of the means of two flats that make a pair
# Relative scatter of light that is called constant, and the least variance over it: a few levels may scatter less
_LAMP, _STEADIEST = 1e-3, 0.25
_CLIPPED = 1e-4  # fraction of pixels at the largest number
# A well counts as full where so many hot pixels lie within so many deviations of the brightest one
_PILED, _PILE = 4, 4.0
_DEAD, _HOT = 0.5, 8.0  # response below which a pixel is dead; deviations above which one is hot
# The bias is taken to drift by so much from frame to frame where darks show none, and where no exposure is repeated
_LEAST_DRIFT_DN, _UNSEEN_DRIFT_DN = 0.02, 0.5
_ONE_TEMPERATURE_K = 1.0  # largest range of what counts as one temperature
HOT_POWER = "individual.hot_growth.iso_power"
NEEDS = {
    "readout.gain_dn_per_e": "needs pairs of flats at two levels, darks of two exposures, or frames with light",
    "readout.read_noise_e_rms": "needs two darks of one exposure, or frames with a dark sky, whose noise rounding "
    "does not hide",
    "readout.bias_dn": "needs darks; without them the file's bias holds",
    "readout.full_well_e": "needs flats that saturate",
    "readout.inl_quadratic_dn": "needs pairs of flats below saturation, of constant light, at four exposures",
    "readout.column_pattern_e_rms": "needs two darks of one exposure, or frames with sky",
    "individual.dsnu_e": "needs two darks of one exposure, or frames with sky",
    "individual.dark_current_e_s": "needs darks of two exposures, which frames.csv or FITS headers say",
    "individual.dark_nonuniformity": "needs two darks at each of two exposures, with more dark signal",
    "individual.prnu": "needs pairs of flats below saturation, and darks",
    "individual.dead_fraction": "needs pairs of flats below saturation, and darks",
    "individual.hot_fraction": "needs darks of two exposures, which frames.csv or FITS headers say",
    "point spread": "needs star fields with five stars or more, given by --stars",
}


@dataclass(frozen=True, kw_only=True)
class Bend:
    """Hold the arc of the integral non-linearity, `inl_quadratic_dn`, over the range above black, and its error."""

    quadratic_dn: float = 0.0
    error_dn: float = 0.0
    range_dn: float = 1.0

    def straight(self, signal_dn: Any) -> F64:
        """Return signals without the arc."""
        out = given = np.asarray(signal_dn, dtype=np.float64)
        for _ in range(4):
            u = np.clip(out / self.range_dn, 0, 1)
            out = given - 4 * self.quadratic_dn * u * (1 - u)
        return out

    def slope(self, straight_dn: Any) -> F64:
        """Return by how much the observed signal rises with the straight one, at straight signals."""
        u = np.clip(np.asarray(straight_dn, dtype=np.float64) / self.range_dn, 0, 1)
        return 1 + 4 * self.quadratic_dn * (1 - 2 * u) / self.range_dn


@dataclass(kw_only=True, eq=False)
class SensorFit:
    """Collect what is fitted, by the keys of the sensor file.

    `individual.hot_fraction` stands for the keys of hot pixels above `hot_rate_e_s`, and `point spread` for the
    standard deviation of its core in px, which belongs to a scene's camera. `base` is the table of the sensor file
    that says what frames do not, `sensor` the sensor that it describes.
    """

    base: dict[str, Any]
    sensor: Sensor
    is_assumed: bool  # nobody gave the base
    estimates: dict[str, Estimate] = field(default_factory=dict)
    hot_rate_e_s: tuple[float, float] = (0.0, 0.0)
    dark_temperature_K: float | None = None  # that the darks say
    bend: Bend = Bend()
    transfer: Transfer | None = None

    def add(self, key: str, estimate: Estimate) -> None:
        """Keep an estimate, unless a better method gave one before."""
        self.estimates.setdefault(key, estimate)

    @property
    def missing(self) -> dict[str, str]:
        """Return what is not fitted, and what it needs."""
        return {key: why for key, why in NEEDS.items() if key not in self.estimates}

    @property
    def top_dn(self) -> int:
        """Return the highest code."""
        return self.sensor.readout.top_dn

    @property
    def tile(self) -> tuple[int, int]:
        """Return the number of rows and columns of the mosaic's tile."""
        return tile_of(self.sensor)

    def known(self, key: str) -> tuple[float, float] | None:
        """Return a value and its error, from the fit or else from a base that somebody gave; else None."""
        if key in self.estimates:
            one = self.estimates[key]
            return one.value, (one.high - one.low) / (2 * TWO_SIDED)
        table, name = key.split(".")
        if self.is_assumed or name not in self.base.get(table, {}):
            return None
        return float(self.base[table][name]), 0.0


def fit_sensor(exposures: Sequence[Exposure], sensor: str | None = None, stretch: float | None = None) -> SensorFit:
    """Fit a sensor to frames.

    Parameters
    ----------
    exposures
        Frames of one size, raw unless `stretch` is given.
    sensor
        Packaged sensor or path of a sensor file, which says what frames cannot: pitch, filters, efficiency.
        Default: a monochrome CMOS sensor of assumed numbers, with as many bits as the largest number needs.
    stretch
        The frames are 8 bit images whose black is the bias, with 255 times this power of the fraction of white,
        maybe reduced by a whole factor. Default: the frames are raw.

    Raises
    ------
    InputError
        The sensor is refused or does not fit the frames, or nothing can be fitted.
    """
    fit = _begin(exposures, sensor, stretch)
    kinds: dict[str, list[Exposure]] = {kind: [] for kind in ("dark", "flat", "star", "frame")}
    for one in exposures:
        kinds[one.kind].append(one)
    darks = Darks.of(kinds["dark"]) if kinds["dark"] else None
    if darks is not None:
        method = f"means of {len(kinds['dark'])} darks"
        # patterns of another device have another mean
        error = math.hypot(darks.bias_error_dn, darks.pattern_error_dn)
        fit.add("readout.bias_dn", Estimate.normal(darks.bias_dn, error, method))
    flats = None
    if kinds["flat"]:
        black = fit.known("readout.bias_dn")
        error_dn = math.hypot(darks.drift_dn, darks.bias_error_dn) if darks else _LEAST_DRIFT_DN
        flats = Flats.of(kinds["flat"], black[0] if black else 0.0, error_dn, fit.tile)
    _fit_gain(fit, darks, flats)
    if kinds["frame"] and stretch is None and "readout.gain_dn_per_e" in fit.estimates:
        kinds["frame"] = []  # darks and flats tell more
    if kinds["frame"]:
        black = fit.known("readout.bias_dn")
        found, fit.transfer = fit_ordinary(kinds["frame"], fit.sensor, black[0] if black else None, stretch)
        for key, estimate in found.items():
            fit.add(key, estimate)
    if darks is not None:
        _fit_dark_patterns(fit, darks)
    if kinds["star"] and (spread := fit_point_spread(kinds["star"], fit.sensor, darks.good if darks else None)):
        fit.add("point spread", spread)
    if not fit.estimates:
        raise InputError(f"{exposures[0].name}: nothing can be fitted; a sensor {NEEDS['readout.gain_dn_per_e']}")
    return fit


def _begin(exposures: Sequence[Exposure], sensor: str | None, stretch: float | None) -> SensorFit:
    """Return a fit without estimates, whose sensor agrees with the frames. Raises InputError."""
    height, width = exposures[0].image.shape
    most = max(float(one.image.max()) for one in exposures)
    if sensor is None:
        bits = max(8, math.ceil(math.log2(most + 1))) if most < 65536 else 16
        keys = ("width_px", "height_px", "pixel_pitch_um", "readout.bits", "readout.full_well_e", "readout.bias_dn")
        base: dict[str, Any] = {"architecture": "cmos", "pattern": "mono", "pixel_pitch_um": 5.5}
        base |= {"width_px": max(width, 16), "height_px": max(height, 16)}
        base["readout"] = {"bits": bits, "full_well_e": 2.0**bits, "bias_dn": 0}
        base["sources"] = dict.fromkeys(keys, "assumed") | dict.fromkeys(keys[:2], "size of the frames")
        base["sources"]["readout.bits"] = f"assumed: as many as the largest number of the frames, {most:g}, needs"
        source = "the fit"
    else:
        path = resources.find("scenes/detectors", sensor)
        base, source = toml_files.read_toml(path, "detector"), str(path)
    made = replace(parse_sensor(base, source=source), defects=None, measured=None)
    if base.pop("defects", None):  # of one device; the fit is of the type
        base["sources"] = {key: text for key, text in base["sources"].items() if not key.startswith("defects.")}
    if stretch is None:
        if most > made.readout.top_dn:
            raise InputError(
                f"{exposures[0].name}: frames hold {most:g}, but the {made.readout.bits} bits of {source} end at "
                f"{made.readout.top_dn}"
            )
        return SensorFit(base=base, sensor=made, is_assumed=sensor is None)
    wrong = next((one for one in exposures if one.kind in ("dark", "flat")), None)
    if wrong is not None:
        raise InputError(f"{wrong.name}: is a {wrong.kind}, and must be raw; stretched images are ordinary frames")
    if sensor is None or len(made.pattern.channels) > 1:
        raise InputError(
            "--stretch: needs a sensor file of a monochrome sensor, which says bits and bias: --sensor"
        )
    factor = made.width_px // width
    if most > 255 or (factor * height, factor * width) != (made.height_px, made.width_px):
        raise InputError(
            f"{exposures[0].name}: is {width}x{height} px with numbers up to {most:g}; with --stretch, it must "
            f"have 8 bits and as many px as the sensor's {made.width_px}x{made.height_px}, or a whole fraction"
        )
    return SensorFit(base=base, sensor=made, is_assumed=False)


# --- darks --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Point:
    """Hold a point of the photon transfer: signal above black, variance without rounding, its relative error."""

    signal_dn: float
    variance_dn2: float
    relative: float
    signal_error_dn: float
    is_dark: bool = False
    plane: int = 0
    exposure_s: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Darks:
    """Hold the groups of darks by exposure, the line of their means over it, and the pixels without defects."""

    groups: tuple[Group, ...]
    bias_dn: float
    bias_error_dn: float
    rate_dn_s: float
    rate_error_dn_s: float
    drift: Estimate | None
    good: Mask
    temperature_K: float | None

    @classmethod
    def of(cls, frames: Sequence[Exposure]) -> Darks:
        """Return what darks show. Frames without a known exposure count as having none.

        Raises InputError if they were not taken at one temperature.
        """
        known = sorted((one.temperature_K, one.name) for one in frames if one.temperature_K is not None)
        if known and known[-1][0] - known[0][0] > _ONE_TEMPERATURE_K:
            raise InputError(
                f"{known[-1][1]}: temperature_K = {known[-1][0]:g}, but {known[0][1]} has {known[0][0]:g}: must be "
                f"within {_ONE_TEMPERATURE_K:g} K; fit the darks of each temperature alone"
            )
        exposures = sorted({one.exposure_s or 0.0 for one in frames})
        by_exposure = [[one for one in frames if (one.exposure_s or 0.0) == s] for s in exposures]
        good = ordinary_pixels(np.mean([one.image for one in by_exposure[-1]], axis=0, dtype=np.float32))
        groups = tuple(group_of(some, good) for some in by_exposure)
        t = np.concatenate([np.full(len(one.means_dn), one.exposure_s) for one in groups])
        y = np.concatenate([one.means_dn for one in groups])
        design = np.column_stack([np.ones_like(t), t])[:, : len(groups[:2])]
        best, *_ = np.linalg.lstsq(design, y, rcond=None)
        degrees = len(y) - design.shape[1]
        # what noise alone makes of the means
        formal = max((one.in_time / good.sum() for one in groups if one.row_noise), default=1e-6)
        formal += max((one.row_noise.value / len(good) for one in groups if one.row_noise), default=0.0)
        scatter = float(((y - design @ best) ** 2).sum()) / degrees if degrees else _UNSEEN_DRIFT_DN**2
        # where rounding hides the noise, it moves the means, too
        rounded = all(one.in_time < LEAST_VARIANCE_DN2 for one in groups if one.row_noise)
        drifts = degrees > 0 and not rounded and scatter * degrees > formal * stats.chi2.ppf(0.95, degrees)
        # the interval of few degrees of freedom, as that of a normal error
        wider = float(stats.t.ppf(0.975, degrees)) / TWO_SIDED if drifts else 1.0
        errors = wider * np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * max(scatter, formal))
        drift = variance_estimate(scatter, degrees, formal, f"means of {len(y)} darks") if drifts else None
        return cls(
            groups=groups,
            bias_dn=float(best[0]),
            bias_error_dn=float(errors[0]),
            rate_dn_s=float(best[1]) if len(groups) > 1 else 0.0,
            rate_error_dn_s=float(errors[1]) if len(groups) > 1 else math.nan,
            drift=drift.root() if drift else None,
            good=good,
            temperature_K=known[len(known) // 2][0] if known else None,
        )

    @property
    def drift_dn(self) -> float:
        """Return the drift of the bias, or what is assumed of it."""
        return self.drift.value if self.drift else _LEAST_DRIFT_DN

    @property
    def pattern_error_dn(self) -> float:
        """Return by how much the mean of the patterns of rows and columns varies from device to device."""
        patterns = next((one.patterns for one in self.groups if one.patterns), {})
        lines = zip(("row", "column"), self.good.shape, strict=True)
        return math.sqrt(sum(patterns[name].value / count for name, count in lines if patterns))

    def points(self) -> Iterator[Point]:
        """Give a point of the photon transfer for each exposure with two darks or more."""
        for one in self.groups:
            if one.row_noise is None or one.in_time < LEAST_VARIANCE_DN2:
                continue
            mean, fixed = float(one.means_dn.mean()), one.fixed_dn2
            _, noise, _ = noise_before_rounding(mean, one.in_time, fixed)
            # where noise is small, rounding makes much of little
            _, more, _ = noise_before_rounding(mean, 1.01 * one.in_time, fixed)
            steepness = max((more - noise) / (0.01 * one.in_time), 1.0)
            repeats = len(one.means_dn) - 1
            error = steepness * one.in_time * math.sqrt(2 / (repeats * one.quiet.sum()))
            rows = one.row_noise.value * math.sqrt(2 / (repeats * len(one.quiet)))
            rounding = (one.in_time - ROUNDING_DN2 - noise) / 2  # the correction is of one bias, which drifts
            yield Point(
                signal_dn=self.rate_dn_s * one.exposure_s,
                signal_error_dn=0.0 if math.isnan(self.rate_error_dn_s) else self.rate_error_dn_s * one.exposure_s,
                variance_dn2=noise,
                relative=math.hypot(error, rows, rounding) / noise,
                is_dark=True,
            )


def _fit_dark_patterns(fit: SensorFit, darks: Darks) -> None:
    """Add what darks tell of patterns, dark current and hot pixels."""
    if darks.drift:
        fit.add("readout.bias_drift_dn_rms", darks.drift)
    gain = fit.known("readout.gain_dn_per_e")
    if gain is None:
        return
    # near black the response has the slope of its arc
    slope, range_dn = float(fit.bend.slope(0.0)), fit.bend.range_dn
    per_e, relative = gain[0] * slope, math.hypot(gain[1] / gain[0], 4 * fit.bend.error_dn / range_dn)
    if len(darks.groups) > 1:
        _fit_dark_current(fit, darks, per_e, relative)
    # patterns below the steps of the converter show in nothing
    seen = (one for one in darks.groups if one.row_noise and one.in_time >= LEAST_VARIANCE_DN2)
    one = next(seen, None)
    if one is None or one.row_noise is None:
        return
    uneven = fit.estimates.get("individual.dark_nonuniformity")
    of_dark = (uneven.value * darks.rate_dn_s * one.exposure_s) ** 2 if uneven else 0.0
    _, _, fixed = noise_before_rounding(float(one.means_dn.mean()), one.in_time, one.fixed_dn2)
    unrounded = fixed / max(one.fixed_dn2, 1e-9)
    relative = math.hypot(relative, (unrounded - 1) / 4)  # the correction is of one bias, which drifts
    for key, name, less in (
        ("individual.dsnu_e", "pixel", of_dark),
        ("readout.column_pattern_e_rms", "column", 0.0),
        ("readout.row_pattern_e_rms", "row", 0.0),
    ):
        fit.add(key, one.patterns[name].scaled(unrounded, less).root().over(per_e, relative))
    fit.add("readout.row_noise_e_rms", one.row_noise.root().over(per_e, relative))


def _fit_dark_current(fit: SensorFit, darks: Darks, per_e: float, relative: float) -> None:
    """Add dark current, its spread and hot pixels, from darks of two exposures or more."""
    first, last = darks.groups[0], darks.groups[-1]
    means = f"darks of {first.exposure_s:g} to {last.exposure_s:g} s"
    rate = Estimate.normal(darks.rate_dn_s, darks.rate_error_dn_s, f"means of {means}")
    fit.add("individual.dark_current_e_s", rate.over(per_e, relative))
    fit.dark_temperature_K = darks.temperature_K
    rises = rise_dn(first, last)
    if first.halves_dn and last.halves_dn and rate.low > 0:
        quiet = first.quiet & last.quiet
        counted, rough = inside(quiet), [smoothed_pixels(one * quiet) for one in rises]
        shared = covariance_estimate([one[counted] for one in rough], f"covariance of {means}")
        span_dn = darks.rate_dn_s * (last.exposure_s - first.exposure_s)
        spread = shared.root().over(span_dn, darks.rate_error_dn_s / darks.rate_dn_s)
        if spread.high < 1:
            fit.add("individual.dark_nonuniformity", spread)
    _fit_hot_pixels(fit, darks, per_e, means)


def rise_dn(first: Group, last: Group) -> list[F32]:
    """Return by how much pixels are brighter after a longer exposure, twice, from different frames if there are."""
    if first.halves_dn is None or last.halves_dn is None:
        return [last.map_dn - first.map_dn] * 2
    return [long - short for long, short in zip(last.halves_dn, first.halves_dn, strict=True)]


def _fit_hot_pixels(fit: SensorFit, darks: Darks, per_e: float, means: str) -> None:
    """Add the number of hot pixels above a rate, and the power law of their rates."""
    first, *later = darks.groups
    saturated_dn = _UNSATURATED * (fit.top_dn - darks.bias_dn)
    if "readout.full_well_e" in fit.estimates:
        saturated_dn = min(saturated_dn, _UNSATURATED * fit.estimates["readout.full_well_e"].value * per_e)
    hot = full = np.zeros(0, dtype=bool)
    rates_e_s = np.zeros(0)
    for group in reversed(later):
        dn_per_e_s = per_e * (group.exposure_s - first.exposure_s)
        a, b = (one - cv2.medianBlur(np.ascontiguousarray(one), 5) for one in rise_dn(first, group))
        off = (a + b) / 2
        least = max(1.4826 * float(np.median(np.abs(off))), float(np.percentile(np.abs(off), 68.27)), 0.05)
        bright = off > _HOT * least
        # where several pixels are as bright as the brightest but for shot noise, the well has filled before the top
        brightest = float(off.max())
        near_dn = brightest - _PILE * (least + math.sqrt(per_e * max(brightest, 0.0)))
        if (off >= near_dn).sum() >= _PILED and (off[bright] < near_dn).any():
            saturated_dn = min(saturated_dn, near_dn)
        # pixels that saturate, and those beside, into which their charge may flow, count by a shorter exposure
        filled = cv2.dilate((off >= saturated_dn).astype(np.uint8), np.ones((3, 3))) > 0
        if group is later[-1]:
            # a pixel that a particle hit is bright in one of two measurements, by more than shot noise allows
            noise_dn = least + np.sqrt(2 * per_e * np.maximum(np.minimum(a, b), 0))
            hot, full, rates_e_s = bright & (np.abs(a - b) < OUTLIER * noise_dn), filled, off / dn_per_e_s
        else:
            hot &= ~full | bright
            rates_e_s, full = np.where(full, off / dn_per_e_s, rates_e_s), full & filled
    rates, beyond = rates_e_s[hot & ~full].astype(np.float64), int((hot & full).sum())
    if not len(rates) + beyond:
        fit.add("individual.hot_fraction", count_estimate(0, hot.size, f"none of {hot.size} pixels, {means}"))
        return
    least_e_s, most_e_s = float(rates_e_s[hot].min()), float(rates_e_s[hot].max())
    count = len(rates) + beyond
    method = f"{count} of {hot.size} pixels are brighter by {least_e_s:.4g} e/s, {means}"
    fit.add("individual.hot_fraction", count_estimate(count, hot.size, method))
    fit.hot_rate_e_s = least_e_s, 10 * most_e_s
    if len(rates) < 3 or most_e_s < 1.01 * least_e_s:
        return
    logs = float(np.log(rates_e_s[hot] / least_e_s).sum()) / (len(rates) - 1)

    def beyond_end(power: float) -> float:
        """Return (end / least rate)^-power of a law of which the largest of a sample has the rank 1 / (n + 1)."""
        return 0.0 if beyond else max((count + 1) * (most_e_s / least_e_s) ** -power - 1, 1e-12 * count) / count

    def steepness(power: float) -> float:
        """Return the derivative of the likelihood of a power law from the least rate to its end.

        Pixels that saturate in all exposures exceed a rate, and the law then has no end.
        """
        end = beyond_end(power)
        return (1 - (math.log(1 / end) * end / (1 - end) if end else 0.0)) / power - logs

    low, high = 0.02, 5.0
    power = high if steepness(high) > 0 else low if steepness(low) < 0 else optimize.brentq(steepness, low, high)
    end = beyond_end(power)
    information = (1 - (math.log(1 / end) ** 2 * end / (1 - end) ** 2 if end else 0.0)) / power**2  # Fisher's
    error = 1 / math.sqrt(len(rates) * max(information, 1e-6))
    fit.add(HOT_POWER, Estimate.normal(power, error, f"likelihood of rates, {method}", 0.01))
    if end:
        fit.hot_rate_e_s = least_e_s, min(least_e_s * end ** (-1 / power), 10 * most_e_s)


# --- flats --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Flats:
    """Hold pairs of flats, one for each plane of the mosaic: points, images above black, fractions at the top."""

    points: tuple[Point, ...]
    images: tuple[tuple[F32, F32], ...]
    clipped: tuple[float, ...]
    bias_dn: float

    @classmethod
    def of(cls, frames: Sequence[Exposure], bias_dn: float, error_dn: float, tile: tuple[int, int]) -> Flats:
        """Return pairs of frames of one exposure whose means differ by at most 5 %; bias has an error."""
        means = {id(one): float(one.image.mean(dtype=np.float64)) for one in frames}
        ordered = sorted(frames, key=lambda one: (one.exposure_s or 0.0, means[id(one)]))
        top = max(float(one.image.max()) for one in frames)
        points, images, clipped = [], [], []
        while len(ordered) > 1:
            a, b = ordered[:2]
            near = means[id(b)] - means[id(a)] <= _SAME_LEVEL * max(means[id(b)] - bias_dn, 1.0)
            ordered = ordered[2 if near and a.exposure_s == b.exposure_s else 1 :]
            if not (near and a.exposure_s == b.exposure_s):
                continue
            for plane, pair in enumerate(zip(planes_of(a.image, tile), planes_of(b.image, tile), strict=True)):
                clipped.append(max(float((one >= top).mean()) for one in pair))
                images.append((pair[0] - np.float32(bias_dn), pair[1] - np.float32(bias_dn)))
                points.append(_pair_point(images[-1], error_dn, plane, a.exposure_s))
        return cls(points=tuple(points), images=tuple(images), clipped=tuple(clipped), bias_dn=bias_dn)

    def below(self, fraction: float) -> list[int]:
        """Return the indices of unclipped pairs below a fraction of saturation, or else of the largest signal."""
        brightest = max(self.points, key=lambda one: one.signal_dn)
        return [
            k
            for k, one in enumerate(self.points)
            if 0 < one.signal_dn <= fraction * brightest.signal_dn and self.clipped[k] < _CLIPPED
        ]


def _pair_point(pair: tuple[F32, F32], error_dn: float, plane: int, exposure_s: float | None) -> Point:
    """Return signal and variance in time of two flats; where they differ by 6 deviations, a particle hit."""
    a, b = (one.astype(np.float64) for one in pair)
    ratio = float(a.mean() / b.mean()) if min(a.mean(), b.mean()) > 0 else 1.0
    rest = a - ratio * b
    rest -= np.median(rest)
    quiet = np.abs(rest) <= max(OUTLIER * float(np.percentile(np.abs(rest), 68.27)), 1.5)
    return Point(
        signal_dn=float((a[quiet].mean() + b[quiet].mean()) / 2),
        variance_dn2=float(rest[quiet].var(ddof=1)) / (1 + ratio**2) - ROUNDING_DN2,
        relative=math.sqrt(2 / quiet.sum()),
        signal_error_dn=error_dn,
        plane=plane,
        exposure_s=exposure_s,
    )


def _fit_gain(fit: SensorFit, darks: Darks | None, flats: Flats | None) -> None:
    """Add gain and read noise by photon transfer of darks and flats, and what else flats tell."""
    bend, points = Bend(), list(darks.points()) if darks else []
    black = fit.known("readout.bias_dn")
    if flats is not None:
        if black is not None:
            bend = _fit_bend(fit, flats, fit.top_dn - black[0])
        points += [flats.points[k] for k in flats.below(_LINEAR)]
    if len({(one.is_dark, one.plane, round(one.signal_dn, 1)) for one in points}) < 2:
        return
    best, covariance, transfer = photon_transfer(points, bend)
    # what an error of the arc makes of the gain
    bent = replace(bend, quadratic_dn=bend.quadratic_dn + bend.error_dn)
    by_bend = photon_transfer(points, bent)[0] - best if bend.error_dn else np.zeros(2)
    covariance = covariance + np.outer(by_bend, by_bend)
    offset, gain = (float(one) for one in best)
    errors = np.sqrt(np.diag(covariance))
    if gain < 2 * errors[1]:
        return
    lit = sum(not one.is_dark for one in points)
    method = f"photon transfer of {lit} pairs of flats and {len(points) - lit} exposures of darks"
    fit.add("readout.gain_dn_per_e", Estimate.normal(gain, float(errors[1]), method))
    fit.transfer, fit.bend = transfer, bend
    if darks is not None and len(points) > lit:
        rows = next((one.row_noise.value for one in darks.groups if one.row_noise), 0.0)
        # of (offset - rows) / gain², whose errors are correlated
        gradient = np.array([1 / gain**2, -2 * (offset - rows) / gain**3])
        error = math.sqrt(float(gradient @ covariance @ gradient))
        noise = Estimate.normal((offset - rows) / gain**2, error, f"variance without signal, {method}")
        fit.add("readout.read_noise_e_rms", noise.root())
    if flats is not None and black is not None:
        _fit_saturation(fit, flats, bend, offset, float(errors[1]) / gain)
    if flats is not None and darks is not None:
        _fit_flat_patterns(fit, flats, bend, darks)


def _fit_bend(fit: SensorFit, flats: Flats, range_dn: float) -> Bend:
    """Add the arc of the response, from flats of constant light at several exposures, and return it."""
    used = [flats.points[k] for k in flats.below(_UNSATURATED) if flats.points[k].exposure_s]
    planes, times = sorted({one.plane for one in used}), {one.exposure_s for one in used}
    if len(times) < 4:
        return Bend(range_dn=range_dn)
    y = np.array([one.signal_dn for one in used])
    u = np.clip(y / range_dn, 0, 1)
    light = np.array([[one.exposure_s if one.plane == plane else 0.0 for plane in planes] for one in used])
    design = np.column_stack([light, 4 * u * (1 - u)]).astype(np.float64)
    errors = np.hypot(_LAMP * y, [one.signal_error_dn for one in used])
    weighted = design / errors[:, None]
    best, *_ = np.linalg.lstsq(weighted, y / errors, rcond=None)
    # planes of one pair share the scatter of the lamp and the drift
    degrees = max(len(used) // len(planes) - 2, 1)
    scatter = max(float((((y - design @ best) / errors) ** 2).sum()) / degrees, _STEADIEST)
    error = math.sqrt(float(np.linalg.inv(weighted.T @ weighted)[-1, -1]) * scatter)
    error *= float(stats.t.ppf(0.975, degrees)) / TWO_SIDED
    method = f"signals of {len(used)} pairs of flats over their exposures"
    fit.add("readout.inl_quadratic_dn", Estimate.normal(float(best[-1]), error, method, -math.inf))
    return Bend(quadratic_dn=float(best[-1]), error_dn=error, range_dn=range_dn)


def photon_transfer(points: Sequence[Point], bend: Bend) -> tuple[F64, F64, Transfer]:
    """Return offset in DN² and gain in DN/e of the line of variances over signals, their covariance, the points."""
    signal = bend.straight([one.signal_dn for one in points])
    variance = np.array([one.variance_dn2 for one in points]) / bend.slope(signal) ** 2
    relative, signal_error = np.array([(one.relative, one.signal_error_dn) for one in points]).T
    design = np.column_stack([np.ones_like(signal), signal])
    expected, best = np.maximum(variance, LEAST_VARIANCE_DN2), np.zeros(2)
    for _ in range(4):
        # errors from the line and not from the variances, whose weights would favour low ones
        errors = np.hypot(relative * expected, signal_error * best[1])
        weighted = design / errors[:, None]
        best, *_ = np.linalg.lstsq(weighted, variance / errors, rcond=None)
        expected = np.maximum(design @ best, LEAST_VARIANCE_DN2)
    covariance = np.linalg.inv(weighted.T @ weighted)
    if len(points) > 2:
        scatter = float((((variance - design @ best) / errors) ** 2).sum()) / (len(points) - 2)
        covariance = covariance * max(scatter, 1.0)
    transfer = Transfer(level_dn=signal, variance_dn2=variance, error_dn2=errors, fitted_dn2=design @ best)
    return best, covariance, transfer


def _fit_saturation(fit: SensorFit, flats: Flats, bend: Bend, offset_dn2: float, gain_error: float) -> None:
    """Add the full well from flats whose variance in time has collapsed, or else what fills the converter."""
    gain = fit.estimates["readout.gain_dn_per_e"].value
    levels = [
        float(np.median(pair))
        for point, pair in zip(flats.points, flats.images, strict=True)
        if point.variance_dn2 < _COLLAPSED * (gain * point.signal_dn + offset_dn2)
    ]
    if not levels:
        return
    signal = max(levels)
    method = f"{len(levels)} pairs of flats saturate at {signal + flats.bias_dn:.0f} DN"
    if signal + flats.bias_dn > fit.top_dn - 1:
        method += ", where the converter ends: the well holds at least this"
    full = Estimate.normal(float(bend.straight(signal)), 0.5, method)
    fit.add("readout.full_well_e", full.over(gain, gain_error))


def _fit_flat_patterns(fit: SensorFit, flats: Flats, bend: Bend, darks: Darks) -> None:
    """Add PRNU and dead pixels from what two flats have in common, relative to their signal."""
    used = flats.below(_LINEAR)
    brightest = max((flats.points[k].signal_dn for k in used), default=0.0)
    used = [k for k in used if flats.points[k].signal_dn > _BRIGHT * brightest]
    dark = next((one for one in darks.groups if one.row_noise), None)
    if not used or dark is None:
        return
    offsets = planes_of(dark.map_dn, fit.tile)  # their noise is in both flats of a pair
    cool = [one > 0 for one in planes_of(darks.good, fit.tile)]  # light of hot pixels is no response
    last = {flats.points[k].plane: k for k in sorted(used, key=lambda k: flats.points[k].signal_dn)}
    bent = replace(bend, quadratic_dn=bend.quadratic_dn + bend.error_dn)
    shared, by_bend, dead, pixels = [], [], 0, 0
    for k in used:
        point = flats.points[k]
        pair = [one - offsets[point.plane] for one in flats.images[k]]
        mean = (pair[0] + pair[1]) / 2
        local = np.maximum(cv2.medianBlur(mean, 5), 1)
        response = mean / local
        if last[point.plane] == k:
            dead, pixels = dead + int((response < _DEAD).sum()), pixels + response.size
        quiet = ordinary_pixels(response, 1e-4) & cool[point.plane]
        shade = smooth_surface(local)  # of the light, which is no property of the pixels
        filled = [np.where(quiet, one, local).astype(np.float32) for one in pair]
        rough = [smoothed_pixels(one / shade)[inside(quiet)] for one in filled]
        steeper, other = _steeper(bend, point.signal_dn), _steeper(bent, point.signal_dn)
        by_bend.append((steeper / other) ** 2 - 1)
        noise = dark.in_time / len(dark.means_dn) / point.signal_dn**2
        shared.append(covariance_estimate(rough).scaled(steeper**-2, noise / steeper**2))
    weights = np.array([one.error for one in shared]) ** -2.0
    value = float(np.average([one.value for one in shared], weights=weights))
    # all pairs show the same pixels; other devices have others
    of_bend = value * float(np.average(by_bend, weights=weights))
    error = math.hypot(float(weights.sum()) ** -0.5, value * math.sqrt(2 / pixels), of_bend)
    method = f"covariance of {len(used)} pairs of flats over their signals"
    fit.add("individual.prnu", Estimate.normal(value, error, method).root())
    # responses of dead pixels are uniform from 0 to 1
    method = f"{dead} of {pixels} pixels respond by less than {_DEAD:g} in the brightest pairs"
    fit.add("individual.dead_fraction", count_estimate(dead, pixels * _DEAD, method))


def _steeper(bend: Bend, signal_dn: float) -> float:
    """Return what the arc makes of a relative pattern at a signal."""
    straight = float(bend.straight(signal_dn))
    return straight * float(bend.slope(straight)) / signal_dn
