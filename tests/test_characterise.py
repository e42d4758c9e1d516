"""A device's chain, and what a characterisation by EMVA 1288 tells of it, against what it was made from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sensor_file import completed
from typer.testing import CliRunner

from vbnfault.camera.characterise import Settings, VirtualCamera, characterise
from vbnfault.cli import app
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.quantities import TRAP
from vbnfault.detector import MosaicDetector
from vbnfault.detector.chain import Device, MosaicNoise, by_channel
from vbnfault.detector.charge import ChargeCloud, TrapSpecies, bloom, cti
from vbnfault.detector.individual import IndividualSpec
from vbnfault.detector.mosaic import pattern
from vbnfault.detector.readout import ReadoutSpec
from vbnfault.detector.sensor import Sensor, Transfer, load_sensor, parse_sensor

SHAPE = (256, 256)


def sensor(**more: Any) -> Sensor:
    settings: dict[str, Any] = {
        "name": "test",
        "pattern": pattern("mono"),
        "temperature_K": 293.0,
        "individual": IndividualSpec(
            prnu=0.012,
            dsnu_e=9.0,
            dark_current_e_s=40.0,
            dark_nonuniformity=0.0,
            reference_K=293.0,
            hot_growth=None,
            dead_fraction=0.0,
        ),
        "readout": ReadoutSpec(bits=12, full_well_e=15_000.0, bias_dn=80, read_noise_e_rms=11.0),
    }
    return Sensor(**(settings | more))


def noise(seed: int, shape: tuple[int, int] = SHAPE) -> MosaicNoise:
    return MosaicNoise.draw(shape, *(np.random.default_rng([seed, k]) for k in range(3)))


def test_characterisation_finds_what_the_sensor_was_made_from() -> None:
    """65 536 pixels: variances from pairs are known to √(2/65536) = 0.55 %, gain from 14 of them to 0.2 %, noise to
    half of that; spatial variances to 0.55 %, and PRNU to what 24 pictures leave of shot noise at half the well."""
    made = sensor()
    camera = VirtualCamera(Device(made, 3, shape=SHAPE))
    found = characterise(
        camera,
        sites=camera.sites,
        photons_at_saturation=camera.photons_at_saturation,
        settings=Settings(points=20, stack=24, dark_exposures_s=(1.0, 4.0, 8.0)),
    )
    (result,) = (one.result for one in found.values())
    spec = made.readout
    assert result.gain_dn_per_e == pytest.approx(spec.system_gain_dn_per_e, rel=0.01)
    assert result.quantum_efficiency == pytest.approx(made.quantum_efficiency_peak, rel=0.01)
    assert result.dark_noise_e == pytest.approx(spec.read_noise_e_rms, rel=0.01)
    assert result.full_well_e == pytest.approx(spec.full_well_e, rel=0.01)
    assert result.dark_current_mean_e_s == pytest.approx(40.0, rel=0.01)
    assert result.dark_current_variance_e_s == pytest.approx(40.0, rel=0.05)
    assert result.prnu_percent == pytest.approx(1.2, rel=0.03)
    assert result.dsnu_e == pytest.approx(9.0, rel=0.03)
    assert result.linearity_error_percent < 0.2
    assert result.black_level_dn == pytest.approx(80 + 40 * 0.01 * spec.system_gain_dn_per_e, abs=0.1)


@pytest.mark.parametrize(
    ("mean_dn", "noise_dn"),
    [
        (lambda photons: 100.0, lambda photons: 3.0),  # no light arrives, as behind traps without end
        (lambda photons: 4095.0, lambda photons: 0.0),  # every point saturates
        (lambda photons: 100 + min(10 * photons, 2000), lambda photons: 1.0 if photons < 300 else 0.0),
        (lambda photons: 3000 - photons, lambda photons: photons**0.5),  # the signal falls
        (lambda photons: 100 + photons, lambda photons: 0.0),  # no noise: there is no gain
        (lambda photons: 100 + photons, lambda photons: 50.0 if photons < 900 else 49.0),  # noise without a gain
        (lambda photons: 100 + (photons > 900) * 1000, lambda photons: photons**0.5),  # a step: no line
    ],
)
def test_a_signal_without_a_line_is_one_sentence(mean_dn: Any, noise_dn: Any) -> None:
    class Camera:
        def take(self, photons: float, exposure_s: float, number: int) -> Any:
            drawn = np.random.default_rng([1, number]).standard_normal((32, 32))
            return np.clip(np.rint(mean_dn(photons) + noise_dn(photons) * drawn), 0, 4095).astype(np.uint16)

    sites = {"mono": (slice(None), slice(None))}
    use = Settings(points=8, stack=2, dark_exposures_s=(0.1, 1.0))
    with pytest.raises(InputError, match=r"^channel mono: it(s| saturates) .*, so that ") as error:
        characterise(Camera(), sites=sites, photons_at_saturation=800.0, settings=use)
    assert "\n" not in str(error.value)


def test_zero_light_gives_the_black_level_and_saturation_the_top_code() -> None:
    dark = replace(sensor().individual, dsnu_e=0.0, dark_current_e_s=0.0)
    device = Device(sensor(individual=dark), 1, shape=SHAPE)
    none = np.zeros(SHAPE, dtype=np.float32)
    assert (device.raw(none, 0.01) == 80).all()
    assert device.raw(none, 0.01, noise(1)).mean() == pytest.approx(80, abs=0.1)
    full = device.raw(none + 1e6, 0.01, noise(1))
    assert full.max() == 4095
    # the well clips before the read noise: saturated pixels still have it, below the top
    assert full.std() > 0.3 * 11 * device.sensor.readout.system_gain_dn_per_e


def test_a_seed_is_a_device_and_noise_is_not() -> None:
    made = sensor()
    light = np.full(SHAPE, 4000.0, dtype=np.float32)
    one, same, other = (Device(made, seed, shape=SHAPE) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.raw(light, 0.01, noise(1)), same.raw(light, 0.01, noise(1)))
    assert (one.raw(light, 0.01, noise(1)) != other.raw(light, 0.01, noise(1))).mean() > 0.5
    # twins share noise: a brighter patch changes no pixel elsewhere
    brighter = light.copy()
    brighter[40:60, 100:120] *= 1.5
    changed = one.raw(light, 0.01, noise(2)) != one.raw(brighter, 0.01, noise(2))
    assert changed[40:60, 100:120].all()
    assert changed.sum() == 400


def test_a_ccds_bright_spot_blooms_smears_and_trails() -> None:
    move = Transfer(row_transfer_s=1e-5, row_readout_s=1e-3)
    made = sensor(architecture="frame_transfer_ccd", transfer=move)
    clean = replace(made, individual=replace(made.individual, prnu=0.0, dsnu_e=0.0, dark_current_e_s=0.0))
    light = np.zeros(SHAPE, dtype=np.float32)
    light[100, 50] = 60_000
    charge = Device(clean, 1, shape=SHAPE, direction="up").collected_e(light, 0.01)
    # rows behind the spot pass under it: τ · rate
    np.testing.assert_allclose(charge[140:, 50], 1e-5 * 6e6, rtol=1e-4)
    assert charge[:90, 50].max() == 0
    assert (charge[99:102, 50] == 15_000).all()
    assert np.delete(charge, 50, axis=1).max() == 0
    assert charge.sum() == pytest.approx(60_000 + 60 * (255 - 100), rel=1e-4)


def test_colours_come_back_from_the_mosaic() -> None:
    made = sensor(pattern=pattern("rggb"), demosaic="bilinear")
    device = Device(made, 2, shape=SHAPE)
    grey = by_channel(made, SHAPE, [4000.0 / g for g in device.white_balance])
    picture = device.rgbi(device.raw(grey, 0.01), 0.01).array
    assert picture.shape == (*SHAPE, 4)
    level = picture[8:-8, 8:-8].reshape(-1, 4).mean(axis=0)
    np.testing.assert_allclose(level, 255 * 4000 / 15_000, atol=1.0)


def test_a_sensor_that_corrects_its_defects_hides_them() -> None:
    stuck = replace(sensor().individual, stuck_fraction=2e-3)
    light = np.full(SHAPE, 3000.0, dtype=np.float32)
    worst = []
    for corrects in (False, True):
        device = Device(sensor(individual=stuck, correct_defects=corrects), 1, shape=SHAPE)
        assert device.bad.sum() > 50
        picture = device.rgbi(device.raw(light, 0.01), 0.01).array[..., 3].astype(int)
        worst.append(np.abs(picture - np.median(picture)).max())
    # what is left is the pixels' own response: 1.2 % of 51 DN, five times
    assert worst[0] > 50
    assert worst[1] < 6


# --- charge of a CCD under way ---------------------------------------------------------------------------------


def ccd(architecture: str, nodes: int = 1, **transfer: Any) -> Sensor:
    spec = replace(sensor().individual, dark_current_e_s=1000.0, dsnu_e=0.0, prnu=0.0)
    return sensor(
        architecture=architecture,
        individual=spec,
        readout=replace(sensor().readout, nodes=nodes),
        transfer=Transfer(row_readout_s=1e-3, **transfer),
    )


@pytest.mark.parametrize("architecture", ["full_frame_ccd", "frame_transfer_ccd", "interline_ccd"])
def test_charge_gathers_dark_current_until_its_row_is_read(architecture: str) -> None:
    """1000 e/s for a ms a row on top of the exposure's; and the picture's black level follows it."""
    device = Device(ccd(architecture), 1, shape=(64, 64))
    got = device.expected_e(np.zeros((64, 64), np.float32), 0.01)
    np.testing.assert_allclose(got, np.repeat(10.0 + np.arange(64)[:, None], 64, axis=1), rtol=1e-5)
    assert not device.rgbi(device.raw(np.zeros((64, 64), np.float32), 0.01), 0.01).array.any()
    full = device.rgbi(np.full((64, 64), device.sensor.readout.top_dn, np.uint16), 0.01).array
    assert (full == 255).all()


@pytest.mark.parametrize("architecture", ["frame_transfer_ccd", "interline_ccd"])
@pytest.mark.parametrize("direction", ["up", "down"])
def test_the_store_has_pixels_of_its_own(architecture: str, direction: str) -> None:
    """After i of its rows, columns differ by the root of i times the deviation of a pixel's dark current; with a
    reference at the end, by that of the rows that are left."""
    made = ccd(architecture)
    uneven = replace(made.individual, dark_nonuniformity=0.2)
    shape, light = (64, 1024), np.zeros((64, 1024), np.float32)
    rows = np.arange(64) if direction == "up" else np.arange(64)[::-1]
    for reference, passed in ((False, rows), (True, 63 - rows)):
        move = replace(made.transfer, column_reference=reference)
        device = Device(replace(made, individual=uneven, transfer=move), 1, shape=shape, direction=direction)
        gathered = device.expected_e(light, 0.0) + device.offset_e
        # pixels vary by 0.2 of 1 e a row: the mean of 1024 columns has an error of 0.6 % in the first row, their
        # deviation one of 2.2 %
        assert gathered.mean(axis=1) == pytest.approx(rows, rel=0.03, abs=1e-3)
        assert gathered.std(axis=1) == pytest.approx(0.2 * np.sqrt(passed), rel=0.1, abs=1e-3)


def test_four_nodes_read_each_half_to_its_own_side() -> None:
    made = ccd("full_frame_ccd", nodes=4)
    device = Device(made, 1, shape=(64, 64))
    got = device.expected_e(np.zeros((64, 64), np.float32), 0.01)[:, 5]
    np.testing.assert_allclose(got, 10.0 + np.minimum(np.arange(64), 63 - np.arange(64)), rtol=1e-5)
    traps = (TrapSpecies(density_per_px=20.0, release_time_s=1e-3),)
    move = replace(made.transfer, parallel_traps=traps, serial_traps=traps, pixel_transfer_s=1e-3)
    cold = replace(made, transfer=move, individual=replace(made.individual, dark_current_e_s=0.0))
    light = np.zeros((64, 64), np.float32)
    light[[20, 43], [20, 43]] = 9000.0
    charge = Device(cold, 1, shape=(64, 64)).collected_e(light, 0.01)
    # trails lead to the middle, from where charge comes
    assert charge[21, 20] > 10 < charge[42, 43]
    assert charge[20, 21] > 10 < charge[43, 42]
    assert charge[19, 20] == charge[44, 43] == charge[20, 19] == charge[43, 44] == 0


def test_a_shutter_that_lets_light_through_smears() -> None:
    light = np.zeros((64, 64), np.float32)
    light[20, 30] = 5000.0
    device = Device(ccd("full_frame_ccd", shutter_transmission=0.02), 1, shape=(64, 64))
    dark = device.expected_e(0 * light, 0.01)
    got = device.expected_e(light, 0.01) - dark
    np.testing.assert_allclose(got[21:, 30], 5000 / 0.01 * 1e-3 * 0.02, rtol=1e-3)
    np.testing.assert_allclose(got[:20, 30], 0, atol=1e-3)


def test_a_global_shutter_lets_light_onto_charge_that_waits() -> None:
    """leak × rate × i row times, from the first row read on; none of it with a rolling shutter."""
    light = np.full((64, 64), 5000.0, np.float32)
    still = replace(sensor().individual, prnu=0.0)
    move = Transfer(leak=1e-2, row_readout_s=1e-3)
    for shutter, leak in (("global", 1e-2), ("rolling", 0.0)):
        device = Device(sensor(individual=still, shutter=shutter, transfer=move), 1, shape=(64, 64))
        gained = device.expected_e(light, 0.05) - light - 40.0 * 0.05
        wanted = 5000 / 0.05 * leak * 1e-3 * np.arange(64)[:, None]
        np.testing.assert_allclose(gained, np.repeat(wanted, 64, axis=1), atol=1e-2)


def test_a_devices_lines_have_their_pattern() -> None:
    readout = replace(sensor().readout, column_pattern_e_rms=50.0, row_pattern_e_rms=20.0, full_well_e=4000.0)
    device = Device(sensor(readout=readout), 1, shape=SHAPE)
    raw = device.raw(np.full(SHAPE, 2000.0, np.float32), 0.01) / readout.system_gain_dn_per_e
    assert raw.mean(axis=0).std() == pytest.approx(50.0, rel=0.2)
    assert raw.mean(axis=1).std() == pytest.approx(20.0, rel=0.2)


def test_the_chain_is_in_physical_order() -> None:
    """What a fault adds to expected electrons has shot noise, what it adds to charge has none; offsets have none;
    wells overflow before traps take charge, so that trails lie beside full wells."""
    dark = replace(sensor().individual, dark_current_e_s=0.0, dsnu_e=0.0)
    device = Device(sensor(individual=dark), 1, shape=SHAPE)
    none, more = np.zeros(SHAPE, np.float32), lambda charge: charge + np.float32(400)
    noisy = device.collected_e(none, 0.01, noise(4), {"pixels": [more]})
    assert noisy.mean() == pytest.approx(400, abs=0.5)
    assert noisy.std() == pytest.approx(20, rel=0.02)
    assert (device.collected_e(none, 0.01, noise(4), {"charge": [more]}) == 400).all()
    uneven = Device(sensor(individual=replace(dark, dsnu_e=400.0)), 1, shape=SHAPE)
    assert (uneven.collected_e(none, 0.01, noise(4)) == 0).all()
    assert uneven.raw(none + 4000, 0.01).std() == pytest.approx(400 * 4015 / 15_000, rel=0.05)
    # no well limits them: full ones keep their spread, as far as the converter goes
    low = Device(
        sensor(individual=replace(dark, dsnu_e=400.0), readout=replace(uneven.sensor.readout, gain_dn_per_e=0.2)),
        1,
        shape=SHAPE,
    )
    assert low.raw(none + 5e4, 0.01).std() == pytest.approx(400 * 0.2, rel=0.05)

    traps = (TrapSpecies(density_per_px=20.0, release_time_s=1e-3),)
    made = replace(ccd("full_frame_ccd", parallel_traps=traps), individual=replace(dark, prnu=0.0))
    spot = np.zeros((64, 64), np.float32)
    spot[30, 20] = 6e4
    got = Device(made, 1, shape=(64, 64)).collected_e(spot, 0.01)
    full = made.readout.full_well_e
    spilt = bloom(spot, full_well_e=full)
    np.testing.assert_allclose(
        got, cti(spilt, traps, cloud=ChargeCloud(full_well_e=full), transfer_s=1e-3), rtol=1e-5
    )


def test_telegraph_signals_of_a_device_are_in_its_charge() -> None:
    spec = replace(sensor().individual, rts_fraction=0.05, dark_current_e_s=0.0)
    device = Device(sensor(individual=spec), 1, shape=(64, 64))
    signals = device.individual.rts.at(293.0)
    dark = device.collected_e(np.zeros((64, 64), np.float32), 10.0)
    assert dark.sum() == pytest.approx(10 * (signals.amplitude_e_s * signals.duty).sum(), rel=1e-4)


def test_smear_follows_the_direction_of_readout() -> None:
    light = np.zeros((64, 64), np.float32)
    light[20, 30] = 5000.0
    made = sensor(architecture="frame_transfer_ccd", transfer=Transfer(row_transfer_s=1e-5))
    for direction, behind in (("up", slice(21, None)), ("down", slice(0, 20))):
        got = Device(made, 1, shape=(64, 64), direction=direction).expected_e(light, 0.01)[:, 30] - 0.4
        assert got[behind].min() > 4
        assert np.delete(got, np.r_[np.arange(64)[behind], 20]).max() < 0.1


def test_intensity_is_what_pixels_without_a_filter_see() -> None:
    made = sensor(pattern=pattern("rgbw"), demosaic="bilinear")
    device = Device(made, 2, shape=(64, 64))
    red = by_channel(made, (64, 64), [4000.0, 0.0, 0.0, 7500.0])
    picture = device.rgbi(device.raw(red, 0.01), 0.01).array
    scale = float(device.white_balance[made.pattern.index("W")])
    assert picture[8:-8, 8:-8, 3].mean() == pytest.approx(min(255 * 7500 * scale / 15_000, 255), abs=1.5)


def test_a_device_has_traps_for_life() -> None:
    made = ccd("full_frame_ccd")
    spec = replace(made.individual, trap_fraction=3e-3, trap_depth_e=400.0, dark_current_e_s=0.0)
    device = Device(replace(made, individual=spec), 5, shape=(64, 64))
    traps = device.individual.traps
    assert 4 < len(traps) < 25
    light = np.full((64, 64), 100.0, np.float32)
    lost = light - device.collected_e(light, 0.01)
    # what they hold, but for what the last row saves
    assert lost.sum() == pytest.approx(traps.depth_e.sum(), rel=0.3)
    assert set(np.flatnonzero(lost.any(axis=0))) <= set(traps.column.tolist())
    drawn = noise(2, (64, 64))
    kinds = device.defects(0.01, drawn)
    assert set(zip(*np.nonzero(kinds & TRAP), strict=True)) == set(zip(traps.row, traps.column, strict=True))


# --- files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(resources.packaged("scenes/detectors")))
def test_every_packaged_detector_takes_a_picture(name: str) -> None:
    made = load_sensor(name)
    assert made.sources
    device = Device(made, 1, shape=(64, 64))
    raw = device.raw(np.full((64, 64), 500.0, dtype=np.float32), 0.01, noise(1, (64, 64)))
    assert raw.mean() > made.readout.bias_dn
    assert device.rgbi(raw, 0.01).array.shape == (64, 64, 4)


def _one(table: str, key: str, value: Any) -> dict[str, Any]:
    return {table: {key: value}, "sources": {f"{table}.{key}": "x"}}


def test_lists_of_a_file_become_parts_of_a_device() -> None:
    """Nested ones too: a sensor is a key of what is made once."""
    pattern_table = {"name": "own", "channels": ["R", "G", "B"], "tile": [[1, 0], [2, 1]]}
    table = {
        "pattern": pattern_table,
        "readout": {"stuck_bits": [[2, 0], [0, 1]]},
        "sources": {"pattern.tile": "x", "readout.stuck_bits": "x"},
    }
    made = parse_sensor(completed(table), source="d.toml")
    assert made.pattern.is_bayer
    device = MosaicDetector(sensor=made, width_px=32, height_px=32).device
    raw = device.raw(np.full((32, 32), 3000.0, np.float32), 0.01, noise(1, (32, 32)))
    assert (raw & 5 == 1).all()


@pytest.mark.parametrize("gain", [0.05, None, 4.0])
def test_a_saturated_pixel_is_white_whatever_the_gain(gain: float | None) -> None:
    """Also where the full well misses the top code, or the top code comes before the full well."""
    made = sensor(readout=replace(sensor().readout, gain_dn_per_e=gain, full_well_e=15_000.0))
    detector = MosaicDetector(sensor=made, width_px=64, height_px=64)
    white = float(detector.white_e[0])
    assert white == pytest.approx(min(15_000.0, np.inf if gain is None else 4015 / gain))
    device = Device(replace(made, individual=replace(made.individual, prnu=0.0, dsnu_e=0.0)), 1, shape=(64, 64))
    for light, shown in ((2e4, 255), (0.99 * white, 252), (white / 2, 127)):
        picture = device.rgbi(device.raw(np.full((64, 64), light, np.float32), 0.01), 0.01).array
        np.testing.assert_allclose(picture.astype(int), shown, atol=1)


def test_a_dark_signal_that_fills_the_well_gives_white_and_not_black() -> None:
    made = sensor(readout=replace(sensor().readout, full_well_e=15_000.0))
    device = MosaicDetector(sensor=made, width_px=32, height_px=32).device
    exposure_s = 100 * 15_000.0 / float(device.dark_rate_e_s.mean())
    raw = device.raw(np.zeros((32, 32), np.float32), exposure_s)
    # 1 % of the range is left above black, 40 DN; the read noise of 3 DN stays visible: 4.5 standard deviations
    assert device.rgbi(raw, exposure_s).array.min() >= 255 - round(4.5 * 3 / 40 * 255)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"readout": {"bits": 12}}, ["d.toml: sources", "readout.bits"]),
        ({"sources": {"readout.nodes": "x"}}, ["d.toml: sources: readout.nodes", "no such number"]),
        ({"architecture": "cathode_ray"}, ["d.toml: architecture = 'cathode_ray'", "cmos"]),
        ({"colour": "red"}, ["d.toml: colour: unknown key", "pattern"]),
        ({"pattern": "plaid"}, ["d.toml", "plaid", "rggb"]),
        (
            {"readout": {"bits": 20}, "sources": {"readout.bits": "x"}},
            ["d.toml: readout.bits = 20", "1 to 16"],
        ),
        ({"readout": {"bits": "12"}}, ["d.toml: readout.bits = '12'", "whole number"]),
        ({"individual": {"prnuu": 0.1}}, ["d.toml: individual.prnuu: unknown key", "did you mean prnu?"]),
        ({"readout": {"bits": 12}, "sources": {"readout.bits": " "}}, ["d.toml: sources", "readout.bits"]),
        ({"pixel_pitch_um": 0.0, "sources": {"pixel_pitch_um": "x"}}, ["d.toml: pixel_pitch_um = 0", "0.5 to 100"]),
        ({"individual": []}, ["d.toml: individual = []", "must be"]),
        ({"pattern": []}, ["d.toml: pattern = []", "must be"]),
        ({"correct_defects": ["yes"]}, ["d.toml: correct_defects = ['yes']", "must be"]),
        (_one("individual", "years", [1.0, 2.0]), ["d.toml: individual.years = [1.0, 2.0]", "must be"]),
        (_one("individual", "rts_time_s", 3.0), ["d.toml: individual.rts_time_s = 3.0", "must be"]),
        (_one("readout", "stuck_bits", [["x"]]), ["d.toml: readout.stuck_bits[0]", "must be"]),
        (
            _one("readout", "node_offsets_dn", [float("nan")]),
            ["readout.node_offsets_dn[0] = nan", "finite"],
        ),
        (_one("transfer", "leak", 3.5), ["d.toml: transfer.leak = 3.5", "from 0 to 1"]),
        (_one("transfer", "row_transfer_s", -1.0), ["d.toml: transfer.row_transfer_s = -1", "at least 0"]),
        (_one("transfer", "parallel_traps", [3]), ["d.toml: transfer.parallel_traps[0] = 3", "must be"]),
        (
            {"architecture": "full_frame_ccd"}
            | _one("transfer", "serial_traps", [{"density_per_px": 1.0, "release_time_s": 1.0}]),
            ["d.toml: transfer.pixel_transfer_s = 0", "above 0", "serial_traps"],
        ),
        (
            {"pattern": {"name": "p", "channels": ["R", "X"], "tile": [[0, 1]]}, "sources": {"pattern.tile": "x"}},
            ["d.toml: pattern.channels: 'X'", "NIR"],
        ),
    ],
)
def test_bad_files_are_refused_in_a_sentence(table: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        parse_sensor(completed(table), source="d.toml")
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("key", ["architecture", "pixel_pitch_um", "bits", "full_well_e"])
def test_files_must_say_what_no_default_can(key: str, tmp_path: Path) -> None:
    text = resources.find("scenes/detectors", "generic_cmos").read_text()
    kept = [line for line in text.splitlines() if not line.startswith((f"{key} =", f'"readout.{key}"'))]
    path = tmp_path / "own.toml"
    path.write_text("\n".join(kept))
    with pytest.raises(InputError, match=rf"own\.toml: (readout\.)?{key}: is missing"):
        load_sensor(path)
    with pytest.raises(InputError, match="shutter = 'rolling': must be global or mechanical"):
        sensor(architecture="full_frame_ccd", shutter="rolling")


def test_the_command_writes_report_and_plots(tmp_path: Path) -> None:
    out = tmp_path / "report"
    size = ["--pixels", "64", "--points", "12", "--stack", "4"]
    run = CliRunner().invoke(app, ["detector", "generic_cmos", "--out", str(out), "--temperature-k", "280", *size])
    assert run.exit_code == 0, run.output
    report = json.loads((out / "emva1288.json").read_text())
    assert report["temperature_K"] == 280
    assert [one["channel"] for one in report["channels"]] == ["R", "G", "B"]
    assert report["channels"][0]["gain_dn_per_e"] == pytest.approx(0.2986, rel=0.1)
    assert (out / "emva1288.png").read_bytes()[:4] == b"\x89PNG"
    assert "quantum_efficiency" in run.output
