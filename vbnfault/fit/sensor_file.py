"""Write what was fitted to frames: the sensor file, and a figure of the photon transfer."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.files import toml_files
from ..core.files.whole_files import write_whole, writing
from ..detector.sensor import parse_sensor
from .exposures import TWO_SIDED, Estimate
from .sensor_fit import HOT_POWER, NEEDS, SensorFit


def sensor_text(fit: SensorFit) -> str:
    """Return a sensor file: the base with what is fitted, whose sources hold intervals and methods.

    What is not fitted, and the point spread, stand in comments above it. Raises InputError where a value is beyond
    what a sensor file may hold.
    """
    table = copy.deepcopy(fit.base)
    table.setdefault("sources", {})

    def put(key: str, value: Any, source: str) -> None:
        where = table
        *tables, name = key.split(".")
        for one in tables:
            where = where.setdefault(one, {})
        where[name] = value
        table["sources"][key] = source

    for key, one in fit.estimates.items():
        if key == "readout.bias_dn":
            put(key, round(one.value), one.text)
            if fit.sensor.readout.nodes == 1:
                put("readout.node_offsets_dn", [round(one.value - round(one.value), 3)], f"of bias_dn, {one.text}")
        elif key == "individual.hot_fraction":
            _put_hot_pixels(fit, put, one)
        elif key not in ("point spread", HOT_POWER):
            put(key, float(f"{one.value:.5g}"), one.text)
    if "individual.dark_current_e_s" in fit.estimates:
        stated, own_K = fit.dark_temperature_K, fit.sensor.temperature_K
        text = f"assumed: temperature_K, {own_K:g}, as no dark says its own" if stated is None else "of the darks"
        put("individual.reference_K", own_K if stated is None else stated, text)
        if stated is not None and fit.is_assumed:
            put("temperature_K", stated, text)
    parse_sensor(table, source="the fitted sensor")
    head = ["Fitted to frames by `vbnfault fit`; the table [sources] holds intervals of 95 % and methods."]
    if (spread := fit.estimates.get("point spread")) is not None:
        head.append(f"Core of the point spread: {spread.value:.4g} px, {spread.text}; in a scene,")
        head.append("camera.point_spread.core_urad is this times the angle of a pixel in µrad.")
    head += [f"Not fitted: {key} {why}." for key, why in fit.missing.items()]
    return "\n".join(f"# {line}" for line in head) + "\n" + toml_files.toml_text(table)


def _put_hot_pixels(fit: SensorFit, put: Callable[[str, Any, str], None], fraction: Estimate) -> None:
    """Write the law of hot pixels as one whose defects are born in one year, at any pitch."""
    put("individual.years", 1.0 if fraction.value else 0.0, "a unit: all hot pixels of the fit are of one year")
    put("individual.dose_TeV_g", 0.0, "its damage counts among hot pixels")
    if not fraction.value:
        return
    unknown = Estimate(value=1.0, low=0.01, high=5.0, method="assumed, as there are fewer than 3")
    power = fit.estimates.get(HOT_POWER, unknown)
    area_mm2 = (fit.sensor.pixel_pitch_um * 1e-3) ** 2
    iso = fit.sensor.individual.iso
    put(
        "individual.hot_rate_e_s",
        list(fit.hot_rate_e_s),
        f"limits of the rates that were counted: {fraction.method}",
    )
    scale = math.log10(fraction.value / area_mm2 / iso**power.value)
    put("individual.hot_growth.log10_scale", scale, f"fraction of pixels {fraction.value:.4g}, {fraction.text}")
    put("individual.hot_growth.size_power", 0.0, "not of one sensor")
    put(HOT_POWER, power.value, power.text)
    put("individual.hot_offset_fraction", 0.0, "offsets count as DSNU")


def draw_transfer(fit: SensorFit, path: Path) -> None:
    """Write a PNG figure of the photon transfer and of its residuals over their errors. Raises InputError."""
    from ..core.figures import BLUE, VERMILLION, panels, png_bytes

    transfer = fit.transfer
    if transfer is None:
        raise InputError(f"--plot {path}: there is no photon transfer to draw: {NEEDS['readout.gain_dn_per_e']}")
    order = np.argsort(transfer.level_dn)
    level, variance, error, fitted = (one[order] for one in vars(transfer).values())
    with panels("Photon transfer", (1, 2), (290.0, 215.0)) as (figure, axes):
        axes[0].errorbar(level, variance, TWO_SIDED * error, fmt="o", ms=3, color=BLUE, label="frames")
        axes[0].plot(level, fitted, color=VERMILLION, lw=1, label="fit")
        axes[0].set(title="variance in time", xlabel="level / DN", ylabel="variance / DN²")
        axes[0].set(xscale="symlog", yscale="log")
        axes[0].legend(loc="upper left")
        axes[1].plot(level, (variance - fitted) / error, "o", ms=3, color=BLUE)
        axes[1].axhspan(-TWO_SIDED, TWO_SIDED, color=BLUE, alpha=0.12, lw=0)
        axes[1].set(title="residual over its error", xlabel="level / DN", xscale="symlog")
        for one in axes:
            one.grid()
    with writing(path):
        write_whole(path, png_bytes(figure))
