"""Define what happens to charge on its way to the output of a CCD; a CMOS sensor has none of these effects."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..charge import ChargeCloud, TrapSpecies, along_columns, along_registers, bloom, capture, cti
from .contract import F32, Effect, Exposure


class Blooming(Effect):
    """Let wells above the full well overflow along their columns."""

    name = "blooming"
    after = "charge"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons after the overflow."""
        sensor = exposure.sensor
        if sensor.architecture == "cmos":
            return signal
        return bloom(
            signal,
            full_well_e=sensor.readout.full_well_e,
            antiblooming=sensor.transfer.antiblooming,
            direction=exposure.device.direction,
        )


class DeepTraps(Effect):
    """Let the deep traps of the device capture charge."""

    name = "deep_traps"
    after = "blooming"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons that pass the traps."""
        device, traps = exposure.device, exposure.device.individual.traps
        if device.sensor.architecture == "cmos" or not len(traps):
            return signal
        height = len(signal)

        def captured(charge: F32, *, direction: str) -> F32:
            # where the sensor is read in two halves, select the traps of this half
            first = height - len(charge) if direction == "down" else 0
            here = (traps.row >= first) & (traps.row < first + len(charge))
            row, column, depth_e = traps.row[here] - first, traps.column[here], traps.depth_e[here]
            return capture(charge, row, column, depth_e, direction=direction)

        return along_columns(device.sensor, device.direction, captured, signal)


class ParallelCti(Effect):
    """Let the traps of the columns delay charge."""

    name = "parallel_cti"
    after = "deep_traps"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons at the ends of the columns."""
        move = exposure.sensor.transfer
        delay = _delay(exposure, move.parallel_traps, move.row_readout_s)
        return along_columns(exposure.sensor, exposure.device.direction, delay, signal) if delay else signal


class SerialCti(Effect):
    """Let the traps of the serial registers delay charge."""

    name = "serial_cti"
    after = "parallel_cti"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons at the output nodes."""
        move = exposure.sensor.transfer
        delay = _delay(exposure, move.serial_traps, move.pixel_transfer_s)
        return along_registers(exposure.sensor, delay, signal) if delay else signal


def _delay(exposure: Exposure, species: tuple[TrapSpecies, ...], transfer_s: float) -> Callable[..., F32] | None:
    """Return the function that lets traps delay charge on its way through a register; None without traps."""
    sensor = exposure.sensor
    if sensor.architecture == "cmos" or not species:
        return None
    cloud = sensor.transfer.cloud
    if cloud is None:
        cloud = ChargeCloud(full_well_e=sensor.readout.full_well_e)
    return partial(cti, species=species, cloud=cloud, transfer_s=transfer_s)
