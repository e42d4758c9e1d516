"""Define what happens at the output: full well, response by a table, analogue chain, converter, stuck pixels."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from ..individual import StuckPixels
from ..readout import ReadoutIndividual, analogue_dn, clip_full_well, convert
from .contract import F32, Effect, Exposure

Raw = NDArray[np.uint16]
_Electrons = Annotated[float, Field(gt=0, le=1e9)]


class FullWell(Effect):
    """Limit the charge of each pixel to the full well."""

    name = "full_well"
    after = "serial_cti"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons, at most the full well."""
        return clip_full_well(signal, exposure.sensor.readout.full_well_e)


class Nonlinearity(Effect):
    """Bend the response of the sense node and the amplifier by a table, as a linearity test measures it.

    Pairs as in EMVA 1288 (release 4.0, section 6.7): what light makes, and what it reads as. Straight lines join
    them, the first from (0, 0), and the last goes on. The image is not corrected for it, but a full well is white.
    """

    name = "nonlinearity"
    after = "interpixel_capacitance"

    table: tuple[tuple[_Electrons, _Electrons], ...] = Field(
        min_length=2,
        max_length=65536,
        description="pairs of the electrons in a well and of the electrons that they read as, both rising",
    )

    @field_validator("table")
    @classmethod
    def _rising(cls, table: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for k, (before, after) in enumerate(pairwise(table), 1):
            if not (after[0] > before[0] and after[1] > before[1]):
                raise ValueError(f"pair {k}, {list(after)}, must be above the pair before, {list(before)}")
        return table

    def binned(self, pixels: int, tile: tuple[int, ...]) -> Self:
        """Return the table of the sum of pixels that each respond by this one."""
        return self.model_copy(update={"table": tuple((a * pixels**2, b * pixels**2) for a, b in self.table)})

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons as which the charge reads."""
        return self.read(signal)

    def read(self, electrons: F32) -> F32:
        """Return the electrons as which a charge reads, float32 in the shape of `electrons`."""
        given, read = np.array([(0.0, 0.0), *self.table]).T
        slope = (read[-1] - read[-2]) / (given[-1] - given[-2])
        beyond = np.maximum(electrons - given[-1], 0) * slope
        return np.asarray(np.interp(electrons, given, read) + beyond, dtype=np.float32)


class Analogue(Effect):
    """Bring charge to the level at the converter: offsets, patterns, bias, noise, gain and non-linearity."""

    name = "analogue"
    after = "nonlinearity"

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
