"""Define what happens at the output: full well, analogue chain, converter and pixels that are stuck."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..individual import StuckPixels
from ..readout import ReadoutIndividual, analogue_dn, clip_full_well, convert
from .contract import F32, Effect, Exposure, FaultStep

Raw = NDArray[np.uint16]


class FullWell(Effect):
    """Limit the charge of each pixel to the full well."""

    name = "full_well"
    after = "serial_cti"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons, at most the full well."""
        return clip_full_well(signal, exposure.sensor.readout.full_well_e)


class Analogue(Effect):
    """Bring charge to the level at the converter: offsets, patterns, bias, noise, gain and non-linearity."""

    name = "analogue"
    after = "full_well"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the level in DN, neither rounded nor clipped to the converter's range."""
        noise = None if exposure.noise is None else exposure.noise.readout
        return analogue_dn(signal, exposure.sensor.readout, noise, _with_offsets(exposure))


class Conversion(Effect):
    """Convert the level to a code: rounding, clipping, uneven and missing codes, stuck bits."""

    name = "converter"
    after = "analogue"

    def apply(self, signal: F32, exposure: Exposure) -> Raw:
        """Return raw DN, uint16[y, x]."""
        return convert(signal, exposure.sensor.readout, exposure.device.readout_individual.transitions_dn)


class StuckPixelLevels(Effect):
    """Show the own level of each stuck pixel."""

    name = "stuck_pixels"
    after = "converter"

    def apply(self, signal: Raw, exposure: Exposure) -> Raw:
        """Return raw DN, uint16[y, x]; the input is changed."""
        show_stuck(signal, exposure.device.individual.stuck, exposure.sensor.readout.top_dn)
        return signal


class RawStep(FaultStep):
    """Let faults act on the raw DN."""

    name = "raw"
    after = "stuck_pixels"


def _with_offsets(exposure: Exposure) -> ReadoutIndividual:
    """Return the device's chain with the drift of its bias, and the offsets that faults have changed."""
    chain, readout = exposure.device.readout_individual, exposure.sensor.readout
    rng = exposure.rng("bias") if readout.bias_drift_dn_rms else None
    if rng is not None:
        drift_e = rng.standard_normal() * readout.bias_drift_dn_rms / readout.system_gain_dn_per_e
        rows = np.zeros(exposure.device.shape[0], dtype=np.float32) if chain.row_e is None else chain.row_e
        chain = replace(chain, row_e=rows + np.float32(drift_e))
    if not exposure.acts.get("offsets"):
        return chain
    return replace(chain, pixel_e=exposure.acted("offsets", chain.pixel_e))


def show_stuck(raw: Raw, stuck: StuckPixels, top_dn: int) -> None:
    """Set the stuck pixels of a raw mosaic, uint16[y, x], to their levels, in place.

    If two of them share a pixel, the later one counts.
    """
    raw[stuck.row, stuck.column] = np.rint(stuck.level * top_dn)
