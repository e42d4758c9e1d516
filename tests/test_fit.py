"""Fit of a sensor: estimators against closed forms and emva1288, hidden sensors, and what is refused."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from vbnfault import cli
from vbnfault.camera.characterise import Settings, VirtualCamera, characterise
from vbnfault.core.errors import InputError
from vbnfault.detector.chain import Device, MosaicNoise
from vbnfault.detector.measured import smooth_surface
from vbnfault.detector.sensor import load_sensor
from vbnfault.fit import ordinary
from vbnfault.fit.exposures import (
    Exposure,
    count_estimate,
    covariance_estimate,
    noise_before_rounding,
    read_exposures,
    rounded_moments,
    variance_estimate,
)
from vbnfault.fit.replay import Display
from vbnfault.fit.sensor_file import sensor_text
from vbnfault.fit.sensor_fit import HOT_POWER, Bend, Darks, fit_sensor

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import fit_sensors

SIZE = (128, 128)


def frame(kind: Any, image: np.ndarray, exposure_s: float | None = None, name: str = "one") -> Exposure:
    return Exposure(name=name, kind=kind, image=np.asarray(image), exposure_s=exposure_s)


# --- estimators -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.15, 0.3, 0.5, 1.5])
def test_rounding_is_undone(noise: float) -> None:
    """Moments of rounded normal levels, drawn: of 65,536 pixels in 8 frames; the variance in time is known to
    √(2 / (7 · 65536)) = 0.2 %, that of pixels to 0.6 %; five times that."""
    rng = np.random.default_rng(3)
    levels = 10.3 + 0.4 * rng.standard_normal(65_536)
    numbers = np.rint(levels + noise * rng.standard_normal((8, 65_536)))
    in_time = float(numbers.var(axis=0, ddof=1).mean())
    of_pixels = float(numbers.mean(axis=0).var() - in_time / 8)
    expected = rounded_moments(10.3, 0.4, noise)
    assert in_time == pytest.approx(expected[1], rel=0.01)
    offset, variance, fixed = noise_before_rounding(float(numbers.mean()), in_time, of_pixels)
    assert offset == pytest.approx(10.3, abs=0.02)
    assert variance == pytest.approx(noise**2, rel=0.05)
    assert fixed == pytest.approx(0.16, rel=0.05)
    # and the phase of the bias is why 1/12 does not do
    if noise == 0.15:
        assert abs(in_time - 1 / 12 - noise**2) > 0.1 * noise**2


def test_intervals_hold_as_often_as_they_say() -> None:
    """Of 400 intervals, 20 ± 4.4 miss at 95 %: at most 34, three deviations more."""
    rng = np.random.default_rng(4)
    shared = rng.standard_normal((400, 200)) * 0.7
    missed = 0
    for one in shared:
        pair = [one + rng.standard_normal(200) for _ in range(2)]
        estimate = covariance_estimate(pair, "")
        missed += not estimate.low <= 0.49 <= estimate.high
    assert missed <= 34
    counts = [count_estimate(int(n), 1000, "") for n in rng.poisson(4.0, 400)]
    assert sum(not one.low <= 4e-3 <= one.high for one in counts) <= 34
    variances = [variance_estimate(float(rng.standard_normal(12).var(ddof=1)), 11, 0.0, "") for _ in range(400)]
    assert sum(not one.low <= 1 <= one.high for one in variances) <= 34


def test_an_arc_is_straightened_and_a_surface_is_flat() -> None:
    bend = Bend(quadratic_dn=30.0, range_dn=4000.0)
    straight = np.array([0.0, 100.0, 2000.0, 3900.0, 4000.0])
    u = straight / 4000
    np.testing.assert_allclose(bend.straight(straight + 120 * u * (1 - u)), straight, atol=1e-3)
    assert bend.slope(0.0) == pytest.approx(1 + 4 * 30 / 4000)
    y, x = np.mgrid[:64, :80] / 64
    image = (3 + x**2 * y - 2 * y**4).astype(np.float32)
    np.testing.assert_allclose(smooth_surface(image), image, atol=1e-4)


def test_darks_tell_patterns_from_noise_in_spite_of_hits_and_hot_pixels() -> None:
    """Noise 3 DN, rows 0.5 in time; pixels 1.2, columns 0.8, rows 0.4 fixed; of 128 lines a deviation is known to
    1/√(2·97) = 7 %, of pixels to some 3 %: three times that."""
    rng = np.random.default_rng(5)
    fixed = (
        1.2 * rng.standard_normal(SIZE) + 0.8 * rng.standard_normal((1, 128)) + 0.4 * rng.standard_normal((128, 1))
    )
    fixed[rng.integers(0, 128, 30), rng.integers(0, 128, 30)] += 400
    darks = []
    for _ in range(4):
        noise = 3 * rng.standard_normal(SIZE) + 0.5 * rng.standard_normal((128, 1))
        noise[rng.integers(0, 128, 10), rng.integers(0, 128, 10)] += 900
        darks.append(frame("dark", np.clip(np.rint(100.3 + fixed + noise), 0, 4095).astype(np.uint16), 0.1))
    found = Darks.of(darks)
    (group,) = found.groups
    assert found.bias_dn == pytest.approx(100.3, abs=0.3)  # the mean of columns: 3 · 0.8/√128 is most of it
    assert math.sqrt(group.in_time - 1 / 12) == pytest.approx(math.hypot(3, 0.5), rel=0.02)
    assert group.row_noise is not None
    assert math.sqrt(group.row_noise.value) == pytest.approx(0.5, rel=0.2)
    for name, wanted, tolerance in (("pixel", 1.2, 0.1), ("column", 0.8, 0.21), ("row", 0.4, 0.3)):
        assert math.sqrt(group.patterns[name].value) == pytest.approx(wanted, rel=tolerance), name


# --- hidden sensors ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> tuple[fit_sensors.Hidden, list[Exposure], Path]:
    """Frames of a hidden sensor with filters, and the sensor file that its user has."""
    one = fit_sensors.hidden(24)
    base = tmp_path_factory.mktemp("base") / "base.toml"
    base.write_text(one.base())
    return one, list(fit_sensors.calibration(one)), base


def test_the_intervals_of_a_fit_hold_the_hidden_values(taken: Any) -> None:
    """18 intervals of 95 %: with a probability of 99 % at most three miss, and none by three errors more."""
    one, frames, base = taken
    fit = fit_sensor(frames, str(base))
    true = fit_sensors.truth(one, fit)
    assert fit.missing == {}
    missed = [key for key, value in fit.estimates.items() if not value.low <= true[key] <= value.high]
    assert len(missed) <= 3, missed
    for key, value in fit.estimates.items():
        assert abs(value.value - true[key]) < 5 * value.error, key
    gain = fit.estimates["readout.gain_dn_per_e"]
    assert gain.high - gain.low < 0.03 * gain.value


def test_the_gain_is_that_of_a_characterisation() -> None:
    """`characterise`, which agrees with the package emva1288 (test_detector_oracles.py), takes its own flats.

    Both know the gain to some 0.4 %.
    """
    made = load_sensor("cmv4000")
    device = Device(made, 1, shape=(256, 256))
    frames = []
    levels = [level for level in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 1.3) for _ in range(2)]
    for number, level in enumerate(levels):
        kind, light_e = ("flat" if level else "dark"), level * made.readout.white_e
        rngs = [np.random.default_rng([number, k]) for k in range(3)]
        raw = device.raw(np.full((256, 256), light_e, np.float32), 0.01, MosaicNoise.draw((256, 256), *rngs))
        frames.append(frame(kind, raw, level or 0.01))
    fit = fit_sensor(frames, "cmv4000")
    camera = VirtualCamera(device)
    found = characterise(
        camera,
        sites=camera.sites,
        photons_at_saturation=camera.photons_at_saturation,
        settings=Settings(points=16, stack=4, dark_exposures_s=(0.01, 0.1)),
    )
    gains = [one.result.gain_dn_per_e for one in found.values()]
    assert fit.estimates["readout.gain_dn_per_e"].value == pytest.approx(np.mean(gains), rel=0.015)
    assert fit.estimates["readout.full_well_e"].value == pytest.approx(made.readout.white_e, rel=0.02)


def test_frames_that_were_stretched_and_halved_tell_the_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six skies of other gradients by a sensor of 0.8 of the full well of its file, so 1.25 times its gain.

    Warm pixels and smear, which the simulated sky lacks, move the gain by some 5 %; twice that.
    """
    monkeypatch.setattr(ordinary, "_SIMULATED_PX", 128)  # a quarter of the time
    made = load_sensor("rosetta_navcam")
    hidden = replace(made, readout=replace(made.readout, full_well_e=0.8 * made.readout.full_well_e))
    device, readout = Device(hidden, 1), made.readout
    display = Display(bias_dn=readout.bias_dn, top_dn=readout.top_dn, stretch=0.5)
    y, x = np.indices(device.shape, dtype=np.float32) / device.shape[0]
    frames = []
    for number in range(6):
        sky_dn = 60 * (0.02 + np.abs(math.cos(number) * (x - 0.5) + math.sin(number) * (y - 0.5))) ** 2
        light_e = (sky_dn / hidden.readout.system_gain_dn_per_e).astype(np.float32)
        noise = MosaicNoise.draw(device.shape, *(np.random.default_rng([number, k]) for k in range(3)))
        frames.append(frame("frame", display.developed(device.raw(light_e, 0.43, noise), 2).astype(np.uint8)))
    gain = fit_sensor(frames, "rosetta_navcam", 0.5).estimates["readout.gain_dn_per_e"]
    assert gain.value == pytest.approx(hidden.readout.system_gain_dn_per_e, rel=0.1)


def test_the_command_writes_a_sensor_that_loads_and_says_what_it_could_not_fit(taken: Any, tmp_path: Path) -> None:
    one, frames, base = taken
    rows = ["name,kind,exposure_s,temperature_K"]
    for k, exposure in enumerate(frames):
        if exposure.kind == "star":
            continue
        cv2.imwrite(str(tmp_path / f"f{k:02}.png"), exposure.image)
        rows.append(f"f{k:02}.png,{exposure.kind},{exposure.exposure_s},293")
    (tmp_path / "frames.csv").write_text("\n".join(rows))
    out, plot = tmp_path / "fitted.toml", tmp_path / "transfer.png"
    command = ["fit", str(tmp_path), "--sensor", str(base), "--out", str(out), "--plot", str(plot)]
    result = CliRunner().invoke(cli.app, command, catch_exceptions=False)
    assert result.exit_code == 0
    assert "not fitted: point spread needs star fields" in result.output
    assert "# Not fitted: point spread needs star fields" in out.read_text()
    assert plot.read_bytes().startswith(b"\x89PNG")
    made, hidden = load_sensor(str(out)), one.sensor
    assert made.readout.gain_dn_per_e == pytest.approx(hidden.readout.gain_dn_per_e, rel=0.02)
    assert made.readout.read_noise_e_rms == pytest.approx(hidden.readout.read_noise_e_rms, rel=0.1)
    assert "95 % interval" in made.sources["readout.gain_dn_per_e"]
    # the device that it makes has as many hot pixels, within the deviation of both counts
    counts = [len(Device(sensor, 3, shape=(256, 256)).individual.hot) for sensor in (made, hidden)]
    assert abs(counts[0] - counts[1]) < 5 * math.sqrt(sum(counts)) + 0.15 * counts[1]


def test_the_dark_current_is_that_at_the_temperature_of_the_darks(taken: Any, tmp_path: Path) -> None:
    _, frames, base = taken
    for temperature_K, reference_K in ((223.0, 223.0), (None, load_sensor(base).temperature_K)):
        cold = [replace(one, temperature_K=temperature_K) for one in frames]
        fit = fit_sensor(cold, str(base))
        (tmp_path / "fitted.toml").write_text(sensor_text(fit))
        made = load_sensor(str(tmp_path / "fitted.toml")).individual
        assert made.reference_K == reference_K
        rate = fit.estimates["individual.dark_current_e_s"].value
        assert made.dark_current_e_s * made.dark_factor(reference_K) == pytest.approx(rate, rel=1e-4)
    mixed = [replace(one, temperature_K=280.0 + k) for k, one in enumerate(frames) if one.kind == "dark"]
    with pytest.raises(InputError, match=r"temperature_K = .*: must be within 1 K"):
        fit_sensor(mixed, str(base))


def test_darks_without_repeats_assume_a_drift_of_the_bias() -> None:
    """Of 20 means with a drift of 0.3 DN, one interval of 1 DN to either side misses with a chance of 2 %."""
    rng = np.random.default_rng(6)
    held = 0
    for _ in range(20):
        one = Darks.of(
            [frame("dark", np.rint(50 + 0.3 * rng.standard_normal() + 3 * rng.standard_normal(SIZE)), 1.0)]
        )
        held += abs(one.bias_dn - 50) < 1.96 * one.bias_error_dn
    assert held >= 19


def test_patterns_below_the_steps_of_the_converter_are_not_fitted() -> None:
    rng = np.random.default_rng(7)
    darks = [np.rint(10.3 + 0.03 * rng.standard_normal(SIZE) + shift) for shift in (0.0, 0.1, 0.3, 0.0)]
    frames = [frame("dark", one, 1.0, f"dark {k}") for k, one in enumerate(darks)]
    flats = [frame("flat", rng.poisson(level, SIZE) + 10, level) for level in (400, 400, 600, 600, 1000, 1000)]
    found = fit_sensor([*frames, *flats]).estimates
    assert "readout.gain_dn_per_e" in found
    assert not {"individual.dsnu_e", "readout.column_pattern_e_rms", "readout.bias_drift_dn_rms"} & found.keys()


def test_hot_pixels_that_fill_the_well_count_by_a_shorter_exposure() -> None:
    """Rates of a power law of 1 from 40 e/s, a well of 3,000 e far below the top: the likelihood of 400 is known to
    5 %, three times that."""
    rng = np.random.default_rng(8)
    rates = np.zeros(SIZE)
    rates.flat[rng.choice(rates.size, 400, replace=False)] = 40 / rng.random(400)
    frames = [
        frame(
            "dark", np.rint(np.minimum(rng.poisson((2 + rates) * t), 3000) + 100 + 2 * rng.standard_normal(SIZE)), t
        )
        for t in (0.01, 0.01, 1.0, 1.0, 40.0, 40.0)
    ]
    found = fit_sensor([replace(one, name=f"dark {k}") for k, one in enumerate(frames)]).estimates
    assert found[HOT_POWER].value == pytest.approx(1.0, rel=0.15)


def test_options_name_the_kinds_of_frames(taken: Any, tmp_path: Path) -> None:
    _, frames, base = taken
    command = ["fit", "--sensor", str(base), "--out", str(tmp_path / "fitted.toml")]
    for kind, option in (("dark", "--darks"), ("flat", "--flats"), ("star", "--stars")):
        folder = tmp_path / kind
        folder.mkdir()
        chosen = [one for one in frames if one.kind == kind]
        for k, one in enumerate(chosen):
            cv2.imwrite(str(folder / f"f{k:02}.png"), one.image)
        rows = [f"f{k:02}.png,{one.exposure_s}" for k, one in enumerate(chosen) if one.exposure_s is not None]
        if rows:
            (folder / "frames.csv").write_text("\n".join(["name,exposure_s", *rows]))
        command += [option, str(folder)]
    result = CliRunner().invoke(cli.app, command, catch_exceptions=False)
    assert result.exit_code == 0
    assert "point spread" in result.output.split("not fitted")[0]
    refused = CliRunner().invoke(cli.app, [*command, "--stretch", "2"])
    assert refused.exit_code == 2


def test_what_is_read_is_not_replaced(taken: Any, tmp_path: Path) -> None:
    _, frames, base = taken
    folder, sensor, link = tmp_path / "frames", tmp_path / "base.toml", tmp_path / "link.png"
    folder.mkdir()
    sensor.write_bytes(base.read_bytes())
    for number, one in enumerate([one for one in frames if one.kind == "dark"]):
        cv2.imwrite(str(folder / f"{number}.png"), one.image)
    (folder / "frames.csv").write_text("name,kind\n0,dark\n")
    link.symlink_to(folder / "0.png")
    inputs = [*folder.iterdir(), sensor]
    before = [path.read_bytes() for path in inputs]
    command = ["fit", "--darks", str(folder), "--sensor", str(sensor)]
    for path in (*inputs, link):
        for more in (["--out", str(path)], ["--out", str(tmp_path / "out.toml"), "--plot", str(path)]):
            result = CliRunner().invoke(cli.app, [*command, *more])
            assert result.exit_code != 0
            assert f"{more[-2]} {path}: is a file that the fit reads" in str(result.exception)
    assert [path.read_bytes() for path in inputs] == before


def test_without_flats_the_dark_current_gives_the_gain(taken: Any) -> None:
    one, frames, base = taken
    fit = fit_sensor([x for x in frames if x.kind == "dark"], str(base))
    gain = fit.estimates["readout.gain_dn_per_e"]
    assert gain.low < one.sensor.readout.system_gain_dn_per_e < gain.high
    assert fit.missing["readout.full_well_e"] == "needs flats that saturate"
    assert "needs pairs of flats" in fit.missing["individual.prnu"]


def test_ordinary_frames_give_noise_and_patterns() -> None:
    """A monochrome sensor's own frames, without a sensor file: the darkest sky counts as black."""
    one = fit_sensors.hidden(14)
    fit = fit_sensor(list(fit_sensors.ordinary(one))[:10])
    true = fit_sensors.truth(one, fit)
    for key in ("readout.gain_dn_per_e", "readout.column_pattern_e_rms"):
        value = fit.estimates[key]
        assert abs(value.value - true[key]) < 3 * value.error, key
    assert "needs darks" in fit.missing["individual.dark_current_e_s"]


def test_frames_without_sky_are_no_error() -> None:
    """Frames of one number are wholly at the end of the range; trial values for a single dark saturate too."""
    for number in (0, 100):
        with pytest.raises(InputError, match="nothing can be fitted"):
            fit_sensor([frame("frame", np.full(SIZE, number, np.uint16))] * 4)
        both = [frame("dark", np.full(SIZE, number, np.uint16), 0.1)] * 2
        both += [frame("frame", np.full(SIZE, number, np.uint16))] * 4
        assert set(fit_sensor(both).estimates) <= {"readout.bias_dn", "readout.bias_drift_dn_rms"}
    dark = np.rint(100.3 + 3 * np.random.default_rng(10).standard_normal((256, 256))).astype(np.uint16)
    fit = fit_sensor([frame("frame", dark)])
    assert "readout.gain_dn_per_e" in fit.missing
    assert fit.estimates["readout.bias_dn"].value == pytest.approx(100.3, abs=0.5)


# --- files ------------------------------------------------------------------------------------------------------


def fits(image: np.ndarray, **more: float | str) -> bytes:
    """Return a FITS file as the standard asks: cards of 80 characters, blocks of 2880 bytes, unsigned by BZERO."""
    cards = {"BITPIX": 16, "NAXIS": 2, "NAXIS1": image.shape[1], "NAXIS2": image.shape[0], "BZERO": 32768, **more}
    text = "SIMPLE  =                    T".ljust(80) + "".join(
        f"{k:8}= {v:>20}".ljust(80) for k, v in cards.items()
    )
    head = (text + "END".ljust(80)).encode()
    data = (image.astype(np.int32) - 32768).astype(">i2").tobytes()
    return head.ljust(-(-len(head) // 2880) * 2880) + data.ljust(-(-len(data) // 2880) * 2880, b"\0")


def test_formats_hold_the_same_numbers(tmp_path: Path) -> None:
    image = np.random.default_rng(6).integers(0, 4096, (70, 90)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), image * 16)  # twelve bits at the top of sixteen
    cv2.imwrite(str(tmp_path / "b.tif"), np.roll(image, 1, 0) * 16)
    (tmp_path / "c.fits").write_bytes(fits(np.roll(image, 2, 0) * 16, EXPTIME="2.5D-01", **{"CCD-TEMP": -10.0}))
    (tmp_path / "frames.csv").write_text("name,exposure_s\na,2.5\n")
    frames = read_exposures({"dark": [tmp_path]})
    for one, rows in zip(frames, range(3), strict=True):
        np.testing.assert_array_equal(one.image, np.roll(image, rows, 0))
    assert [one.exposure_s for one in frames] == [2.5, None, 0.25]
    assert frames[2].temperature_K == pytest.approx(263.15)


def test_a_frame_is_read_once_and_copies_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    images = [rng.integers(0, 4096, (70, 90)).astype(np.uint16) for _ in range(2)] + [np.full((70, 90), 4095)] * 2
    for number, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image.astype(np.uint16))
    (tmp_path / "frames.csv").write_text("name,kind\n0,dark\n1,flat\n2,flat\n3,flat\n")
    frames = read_exposures({"dark": [tmp_path], "flat": [tmp_path, tmp_path / "1.png"]})
    assert [one.kind for one in frames] == ["dark", "flat", "flat", "flat"]
    with pytest.raises(InputError, match=r"0\.png: is given twice, with another kind or exposure"):
        read_exposures({"dark": [tmp_path], "flat": [tmp_path / "0.png"]})
    (tmp_path / "frames.csv").unlink()
    (tmp_path / "4.png").write_bytes((tmp_path / "1.png").read_bytes())
    with pytest.raises(InputError, match=r"4\.png: has the pixels of .*1\.png; a copy is no frame"):
        read_exposures({"flat": [tmp_path]})


@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_the_depth_is_that_of_the_file_and_steps_are_powers_of_two(ending: str, tmp_path: Path) -> None:
    """A saturated flat holds only multiples of 257, darks of 100 DN only of 100, and these of 3."""
    threes = 3 * np.random.default_rng(8).integers(0, 99, (70, 90))
    for number, image in enumerate((np.full((70, 90), 65535), np.full((70, 90), 100), threes)):
        path = tmp_path / f"{number}{ending}"
        cv2.imwrite(str(path), image.astype(np.uint16))
        np.testing.assert_array_equal(read_exposures({"flat": [path]})[0].image, image)


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ({}, "there is no frame"),
        ({"a.png": np.zeros((8, 8), np.uint8)}, r"a\.png: is 8x8 px; must be at least 64 px"),
        ({"a.png": b"no image"}, r"a\.png: is not a PNG"),
        ({"a.fits": b"SIMPLE  = T".ljust(2880)}, r"a\.fits: is no FITS file with an image"),
        ({"a.fits": fits(np.zeros((70, 70)), EXPTIME="'2'")}, r"a\.fits: EXPTIME = '2': must be a number"),
        ({"a.fits": fits(np.zeros((70, 70)), EXPTIME="nan")}, r"a\.fits: EXPTIME = nan: must be from 0 to 1e\+06"),
        ({"a.fits": fits(np.zeros((70, 70)), EXPTIME="-5.0D+00")}, r"a\.fits: EXPTIME = -5: must be from 0 to"),
        (
            {"a.fits": fits(np.zeros((70, 70)), **{"CCD-TEMP": -400})},
            r"a\.fits: CCD-TEMP = -400: must be from -223\.15 to 126\.85; correct it, or say temperature_K in",
        ),
        ({"a.fits": fits(np.zeros((70, 70)), BITPIX=24)}, r"a\.fits: BITPIX = 24: must be one of 8, 16, 32, 64"),
        (
            {"a.png": (70, 70), "b.png": (70, 80)},
            r"b\.png: is 80x70 px, but .*a\.png 70x70; frames must have one size",
        ),
        ({"a.png": (70, 70), "frames.csv": b"name,kind\nb,dark"}, r"name = 'b': the folder has no such frame"),
        (
            {"a.png": (70, 70), "frames.csv": b"name,kind\na,drak"},
            r"row 1: kind = 'drak': must be one of dark, flat",
        ),
        (
            {"a.png": (70, 70), "frames.csv": b"name,exposure\na,1"},
            r"column 'exposure': .*did you mean exposure_s",
        ),
        (
            {"a.png": (70, 70), "frames.csv": b"name,exposure_s\na,-1"},
            r"exposure_s = '-1': must be a number from 0",
        ),
        ({"a.png": (70, 70, 3)}, r"a\.png: has colours"),
    ],
)
def test_wrong_frames_are_refused_in_a_sentence(files: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    for name, content in files.items():
        if isinstance(content, tuple):
            content = np.random.default_rng(7).integers(0, 200, content).astype(np.uint8)
        if isinstance(content, np.ndarray):
            cv2.imwrite(str(tmp_path / name), content)
        else:
            (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=sentence):
        fit_sensor(read_exposures({"dark": [tmp_path]}))


def test_a_sensor_that_does_not_fit_the_frames_is_refused() -> None:
    image = np.full(SIZE, 5000, np.uint16)
    with pytest.raises(InputError, match="nothing can be fitted; a sensor needs pairs of flats"):
        fit_sensor([frame("star", image)])
    with pytest.raises(InputError, match=r"frames hold 5000, but the 12 bits of .*cmv4000.* end at 4095"):
        fit_sensor([frame("dark", image)] * 2, "cmv4000")
    with pytest.raises(InputError, match="is a dark, and must be raw"):
        fit_sensor([frame("dark", image // 40)] * 2, "rosetta_navcam", 0.5)
    with pytest.raises(InputError, match="needs a sensor file of a monochrome sensor"):
        fit_sensor([frame("frame", image // 40)] * 2, None, 0.5)
    with pytest.raises(InputError, match="must have 8 bits and as many px as the sensor's 1024x1024"):
        fit_sensor([frame("frame", (image // 40)[:100])] * 2, "rosetta_navcam", 0.5)
