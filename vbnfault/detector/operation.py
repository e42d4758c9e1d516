"""Describe a sensor that is operated with binned pixels, or with a higher gain, as a sensor of its own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from .charge import TrapSpecies
from .individual import IndividualSpec
from .readout import ReadoutSpec
from .sensor import Sensor, Transfer


def amplified(sensor: Sensor, gain: float) -> Sensor:
    """Return the sensor with a system gain in DN/e that is `gain` times, at least 1, its own.

    Fewer electrons reach the top code, as with a higher ISO setting. The full well, the dark signal of each pixel
    and the noise in electrons stay, so a hot pixel is `gain` times as bright in DN (Chapman et al. 2013).
    """
    if gain == 1:
        return sensor
    readout = replace(sensor.readout, gain_dn_per_e=gain * sensor.readout.system_gain_dn_per_e)
    return replace(sensor, readout=readout)


def binned(sensor: Sensor, pixels: int) -> Sensor:
    """Return the sensor whose pixels are `pixels` × `pixels` of the given one, neighbours of one colour added.

    The sum holds n² times the electrons, where n is `pixels`. A CCD adds charge before the output node, so read
    noise is that of one readout; a CMOS sensor adds numbers, so it is n times as large. Offsets that pixels have
    for themselves add in quadrature, and their relative gains average. A binned pixel is defective if one of its n²
    pixels is. Where numbers are added, patterns and noise of rows and columns are averaged over n of them. The
    whole sensor has 1/n of the columns and rows. The converter's range is that of the sum; a gain that the file
    gives is divided by n². Effects act on binned pixels as they say (`Effect.binned`).
    """
    if pixels == 1:
        return sensor
    n, tile = pixels, np.shape(sensor.pattern.tile)
    adds_numbers = sensor.architecture == "cmos"
    return replace(
        sensor,
        name=f"{sensor.name}, {n} × {n} binned",
        width_px=sensor.width_px // n,
        height_px=sensor.height_px // n,
        pixel_pitch_um=sensor.pixel_pitch_um * n,
        individual=_individual(sensor.individual, n),
        readout=_readout(sensor.readout, n, adds_numbers),
        transfer=_transfer(sensor.transfer, n, adds_numbers),
        effects=tuple(effect.binned(n, tile) for effect in sensor.effects),
        measured=sensor.measured and sensor.measured.binned(n, tile),
    )


def _individual(spec: IndividualSpec, n: int) -> IndividualSpec:
    """Return how devices with binned pixels differ."""
    shares = (
        "dead_fraction",
        "dead_fraction_yr",
        "stuck_fraction",
        "stuck_fraction_yr",
        "trap_fraction",
        "trap_fraction_TeV_g",
    )
    growth = spec.hot_growth
    if growth is not None:  # the law is one of the single pixel's pitch
        growth = replace(growth, log10_scale=growth.log10_scale - growth.size_power * math.log10(n))
    line = n**1.5  # n² offsets, of which n are the same
    return replace(
        spec,
        prnu=spec.prnu / n,
        prnu_row=spec.prnu_row / math.sqrt(n),
        prnu_column=spec.prnu_column / math.sqrt(n),
        dsnu_e=spec.dsnu_e * n,
        dsnu_row_e=spec.dsnu_row_e * line,
        dsnu_column_e=spec.dsnu_column_e * line,
        dark_current_e_s=spec.dark_current_e_s * n**2,
        dark_nonuniformity=spec.dark_nonuniformity / n,
        hot_growth=growth,
        rts_fraction=1 - (1 - spec.rts_fraction) ** n**2,
        rts_amplitude_nA_cm2=spec.rts_amplitude_nA_cm2 / n**2,  # one of the n² pixels has the signal
        **{key: min(getattr(spec, key) * n**2, 0.1) for key in shares},
    )


def _readout(spec: ReadoutSpec, n: int, adds_numbers: bool) -> ReadoutSpec:
    """Return the signal chain of the sum of n² pixels, read once or, where numbers are added, each for itself."""
    factors = {
        "read_noise_e_rms": n,
        "reset_noise_e_rms": n,
        # a block has n lines, and each counts n times
        "row_pattern_e_rms": n**1.5,
        "column_pattern_e_rms": n**1.5,
        "row_noise_e_rms": n**1.5,
        "banding_amplitude_e": n**2,
    }
    return replace(
        spec,
        full_well_e=spec.full_well_e * n**2,
        gain_dn_per_e=None if spec.gain_dn_per_e is None else spec.gain_dn_per_e / n**2,
        **{key: getattr(spec, key) * factor for key, factor in factors.items() if adds_numbers},
    )


def _transfer(transfer: Transfer, n: int, adds_numbers: bool) -> Transfer:
    """Return the transfer of binned charge: n shifts, and n times the traps, for each binned pixel."""

    def traps(species: tuple[TrapSpecies, ...]) -> tuple[TrapSpecies, ...]:
        return tuple(replace(trap, density_per_px=trap.density_per_px * n) for trap in species)

    cloud = transfer.cloud and replace(
        transfer.cloud, full_well_e=transfer.cloud.full_well_e * n**2, notch_e=transfer.cloud.notch_e * n**2
    )
    return replace(
        transfer,
        row_transfer_s=transfer.row_transfer_s * n,
        row_clear_s=transfer.row_clear_s * n,
        pixel_transfer_s=transfer.pixel_transfer_s * n,
        row_readout_s=transfer.row_readout_s * (n if adds_numbers else 1),
        parallel_traps=traps(transfer.parallel_traps),
        serial_traps=traps(transfer.serial_traps),
        cloud=cloud,
    )
