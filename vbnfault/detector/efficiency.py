"""Compute the quantum efficiency (QE) of a sensor's channels: electrons per photon behind each colour filter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core import spectra
from ..core.errors import InputError
from ..core.tables import Fraction, check_spectrum, table_class

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Edge of the long-pass filter over NIR pixels (assumed), for sensors whose file gives no NIR curve.
# The transmission rises linearly between these wavelengths.
_NIR_EDGE_NM = (700.0, 750.0)


@table_class()
class Curve:
    """Hold the QE of one channel as a sampled curve: linear between the wavelengths and 0 outside their range."""

    channel: str = Field(description='name of the channel, such as "R"')
    wavelength_nm: tuple[Annotated[float, Field(gt=0, le=1e5)], ...] = Field(
        min_length=2, description="wavelengths, in increasing order"
    )
    value: tuple[Fraction, ...] = Field(min_length=2, description="QE at these wavelengths")

    def __post_init__(self) -> None:
        """Raise ValueError unless there are as many wavelengths as values, and the wavelengths increase."""
        check_spectrum(self.wavelength_nm, self.value)


@dataclass(frozen=True, kw_only=True)
class QuantumEfficiency:
    """Hold the QE of all channels of a sensor.

    A channel without a curve of its own gets a default. R, G and B take the relative curve named by `response`
    (`spectra.RESPONSES`) times `peak`. W has no filter and takes `peak` at all wavelengths (assumed). NIR takes
    `peak` behind a long-pass filter (assumed).
    """

    channels: tuple[str, ...] = ("R", "G", "B")
    response: str = "nikon_5100"
    peak: float = 0.5
    curves: tuple[Curve, ...] = ()

    def at(self, wavelength_nm: F64) -> F64:
        """Return the QE at the given wavelengths, float64[channel, n], in [0, 1]."""
        own = {curve.channel: curve for curve in self.curves}
        known: dict[str, F64] = {}
        if (set(self.channels) - set(own)) & set("RGB"):
            colours = spectra.response(self.response, wavelength_nm, self.peak)
            known = dict(zip("RGB", colours, strict=True))
        known["W"] = np.full(len(wavelength_nm), self.peak)
        known["NIR"] = self.peak * np.interp(wavelength_nm, _NIR_EDGE_NM, (0.0, 1.0))
        for name, curve in own.items():
            known[name] = np.interp(wavelength_nm, curve.wavelength_nm, curve.value, left=0.0, right=0.0)
        return np.stack([known[name] for name in self.channels])

    def electron_weights(self, nodes_nm: F64, transmittance: F64 | None = None) -> F64:
        """Return `spectra.electron_weights` of the channels, float64[channel, band], in electrons nm / J."""
        return spectra.electron_weights(self.at, nodes_nm, transmittance)


@lru_cache(maxsize=16)
def white_balance(efficiency: QuantumEfficiency) -> F32:
    """Return the gain of each channel that makes a grey surface in sunlight appear grey, float32[channel].

    The smallest gain of a visible channel is 1. NIR is not visible and has the gain 1. Raises InputError if a
    visible channel receives no sunlight between 400 and 700 nm.
    """
    nodes = spectra.band_nodes_nm(400.0, 700.0, 31)
    grey = efficiency.electron_weights(nodes) @ spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0)
    out = np.ones(len(grey))
    seen = np.array([name != "NIR" for name in efficiency.channels])
    if (grey[seen] <= 0).any():
        raise InputError(f"no sunlight of 400 to 700 nm reaches one of the channels {efficiency.channels}")
    out[seen] = grey[seen].max() / grey[seen]
    gains: F32 = out.astype(np.float32)
    gains.flags.writeable = False
    return gains
