"""Measure a simulated sensor as EMVA 1288 defines, and write the results as JSON, figure and text."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.characterise import Characterisation, Result, Settings, VirtualCamera, characterise
from ..core.files.whole_files import own, write_json, write_whole
from ..detector.chain import Device
from ..detector.sensor import load_sensor

F64 = NDArray[np.float64]

_COLOURS = {"R": "tab:red", "G": "tab:green", "B": "tab:blue", "N": "tab:brown", "W": "0.4", "M": "0.2"}
_MOST_BINS = 200
# Variances below this fraction of the largest one are not drawn. They belong to saturated pixels, whose noise is
# clipped.
_LEAST_NOISE = 1e-4
# title, x axis and y axis of each panel
_PANELS = (
    ("photon transfer", "signal / DN", "temporal variance / DN²"),
    ("response", "photons per pixel", "signal / DN"),
    ("dark signal", "exposure / s", "mean / DN"),
    ("spectra of the mean dark image", "spatial frequency / cycles per pixel", "amplitude / DN rms"),
    ("dark signal of each pixel (DSNU)", "difference from the mean / e", "number of pixels"),
    ("response of each pixel (PRNU)", "difference from the mean / %", "number of pixels"),
)


def device_of(
    sensor: str | Path, individual: int = 1, *, pixels: int = 512, temperature_K: float | None = None
) -> Device:
    """Return the device to measure: one of a sensor, of at most `pixels` rows and columns.

    Devices of one sensor differ by their seed `individual`, in defects and fixed patterns; the temperature is by
    default that of the sensor's file. Raises InputError if the sensor file is refused.
    """
    kind = load_sensor(sensor)
    shape = min(pixels, kind.height_px), min(pixels, kind.width_px)
    return Device(kind, individual, shape=shape, temperature_K=temperature_K)


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorReport:
    """Hold the results of a measurement, one for each channel; `wavelength_nm` is None for the best one of each."""

    device: Device
    wavelength_nm: float | None
    channels: Mapping[str, Characterisation]

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """Return the effects of plug-ins that act in the sensor, each with its keys."""
        return {effect.name: effect.model_dump(mode="json") for effect in self.device.sensor.effects}

    @property
    def title(self) -> str:
        """Return a line that names the sensor and the conditions."""
        title = f"{self.device.sensor.name}, individual {self.device.seed}, {self.device.temperature_K:g} K"
        if self.effects:
            title += f", with {' and '.join(self.effects)}"
        return title if self.wavelength_nm is None else f"{title}, {self.wavelength_nm:g} nm"

    def write(self, folder: Path) -> list[Path]:
        """Write `emva1288.json` and `emva1288.png` to a folder and return their paths.

        The JSON has null where a value is undefined, such as a logarithm of 0.
        """
        paths = [folder / "emva1288.json", folder / "emva1288.png"]
        table = {
            "detector": self.device.sensor.name,
            "effects": self.effects,
            "individual": self.device.seed,
            "temperature_K": self.device.temperature_K,
            "wavelength_nm": self.wavelength_nm,
            "channels": [channel.to_dict() for channel in self.channels.values()],
        }
        write_json(own(paths[0]), table, indent=1)
        draw(self.channels, self.title, paths[1])
        return paths

    def lines(self) -> list[str]:
        """Return lines of text with a row per parameter and a column per channel."""
        lines = [f"{'':<30}" + "".join(f"{name:>12}" for name in self.channels)]
        for field in fields(Result):
            values = (getattr(channel.result, field.name) for channel in self.channels.values())
            lines.append(f"{field.name:<30}" + "".join(f"{value:>12.5g}" for value in values))
        return lines


def measure(
    device: Device,
    settings: Settings,
    wavelength_nm: float | None = None,
    progress: Callable[[int], None] | None = None,
) -> SensorReport:
    """Characterise a device with light of a wavelength, by default the best one of each channel.

    `progress` is called with 1 after each image. Raises InputError.
    """
    camera = VirtualCamera(device, wavelength_nm=wavelength_nm)
    channels = characterise(
        camera,
        sites=camera.sites,
        photons_at_saturation=camera.photons_at_saturation,
        settings=settings,
        progress=progress,
    )
    return SensorReport(device=device, wavelength_nm=wavelength_nm, channels=channels)


def draw(channels: Mapping[str, Characterisation], title: str, path: Path) -> None:
    """Write a PNG figure of photon transfer, response, dark signal, spectra and histograms."""
    from ..core.figures import panels, png_bytes, set_linear, set_log

    with panels(f"{title}: EMVA 1288", (2, 3), (270.0, 205.0)) as (figure, axes):
        for name, channel in channels.items():
            colour = _COLOURS.get(name[0], "0.3")
            _draw_signals(axes[:3], name, channel, colour)
            _draw_spatial(axes[3:], name, channel, colour)
        low, high = axes[3].get_ylim()
        axes[3].set_ylim(low, high * (high / low) ** 0.2)  # room for the legend, as the spectra fill the panel
        for axis in (axes[0].xaxis, axes[3].yaxis):
            set_log(axis, *axis.get_view_interval())
        for axis in (axes[1].xaxis, axes[2].yaxis):
            set_linear(axis, 6)
        for k, (panel, (head, x, y)) in enumerate(zip(axes, _PANELS, strict=True)):
            panel.set(title=head, xlabel=x, ylabel=y)
            panel.grid()
            panel.legend(loc="upper center" if k == 3 else "best", ncols=len(channels) if k == 3 else 1)
    write_whole(path, png_bytes(figure))


def _draw_signals(panels: Any, name: str, channel: Characterisation, colour: str) -> None:
    """Draw photon transfer, response and dark signal of one channel."""
    transfer, result = channel.transfer, channel.result
    signal = transfer.mean_dn - transfer.dark_mean_dn
    noise = transfer.variance_dn2 - transfer.dark_variance_dn2
    noise = np.where(noise > _LEAST_NOISE * noise.max(), noise, np.nan)  # not for saturated pixels
    panels[0].loglog(signal, noise, ".", color=colour, label=f"{name}: K = {result.gain_dn_per_e:.4g} DN/e")
    panels[0].loglog(signal, result.gain_dn_per_e * signal, "-", lw=0.8, color=colour)
    panels[1].plot(
        transfer.photons, signal, ".-", lw=0.6, color=colour, label=f"{name}: η = {result.quantum_efficiency:.3f}"
    )
    panels[2].plot(
        channel.dark_exposure_s,
        channel.dark_mean_dn,
        ".-",
        color=colour,
        label=f"{name}: {result.dark_current_mean_e_s:.3g} e/s",
    )


def _draw_spatial(panels: Any, name: str, channel: Characterisation, colour: str) -> None:
    """Draw the spectra and the histograms of DSNU and PRNU of one channel."""
    result, spectrum = channel.result, channel.spectrum
    for kind, style in (("rows", "-"), ("columns", ":")):
        panels[0].semilogy(
            spectrum.frequency[kind],
            spectrum.dark_dn[kind],
            style,
            lw=0.7,
            color=colour,
            label=f"{name}, along {kind}",
        )
    for panel, values, label in (
        (panels[1], channel.dsnu_map_dn / result.gain_dn_per_e, f"DSNU {result.dsnu_e:.3g} e"),
        (panels[2], 100 * channel.prnu_map, f"PRNU {result.prnu_percent:.3g} %"),
    ):
        count, edge = np.histogram(values, bins=_bins(values))
        middle = (edge[1:] + edge[:-1]) / 2
        panel.semilogy(middle, np.maximum(count, 0.5), color=colour, lw=0.8, label=f"{name}: {label}")


def _bins(values: F64) -> F64:
    """Return the edges of at most about 200 bins for a histogram.

    Averages of integers are multiples of a step. Each bin is a whole number of these steps wide.
    """
    levels = np.unique(values)
    extent = float(levels[-1] - levels[0])
    if extent == 0:
        return np.asarray([levels[0] - 0.5, levels[0] + 0.5])
    apart = np.diff(levels)
    step = float(apart[apart > 1e-5 * extent].min())
    width = step * math.ceil(extent / step / _MOST_BINS)
    return np.asarray(levels[0] - step / 2 + width * np.arange(math.ceil((extent + step) / width) + 1))
