"""Define what happens to charge on its way to the output of a CCD; a CMOS sensor has none of these effects."""

from __future__ import annotations

from functools import partial

from ..charge import ChargeCloud, bloom, capture, cti
from ..transfer import along_columns, along_registers
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
        sensor, move = exposure.sensor, exposure.sensor.transfer
        if sensor.architecture == "cmos" or not move.parallel_traps:
            return signal
        step = partial(cti, species=move.parallel_traps, cloud=_cloud(exposure), transfer_s=move.row_readout_s)
        return along_columns(sensor, exposure.device.direction, step, signal)


class SerialCti(Effect):
    """Let the traps of the serial registers delay charge."""

    name = "serial_cti"
    after = "parallel_cti"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons at the output nodes."""
        sensor, move = exposure.sensor, exposure.sensor.transfer
        if sensor.architecture == "cmos" or not move.serial_traps:
            return signal
        step = partial(cti, species=move.serial_traps, cloud=_cloud(exposure), transfer_s=move.pixel_transfer_s)
        return along_registers(sensor, step, signal)


def _cloud(exposure: Exposure) -> ChargeCloud:
    """Return the charge cloud that meets the traps."""
    sensor = exposure.sensor
    cloud = sensor.transfer.cloud
    return ChargeCloud(full_well_e=sensor.readout.full_well_e) if cloud is None else cloud
