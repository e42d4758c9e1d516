"""Fit hidden sensors from 20 simulated frames each, and count how often the intervals hold the truth.

    python benchmarks/fit_sensors.py --sensors 50
    python benchmarks/fit_sensors.py --sensors 10 --ordinary
    python benchmarks/fit_sensors.py --frames navcam --sensor rosetta_navcam --stretch 0.5

Each sensor is drawn from wide ranges. It takes six darks of three exposures, twelve flats of six levels up to
saturation under a lamp that varies by 0.1 %, and two star fields, with hits of particles; or, with `--ordinary`, 20
frames of a lit body with a glow. With `--frames`, real ones are fitted, and signals as theirs are shown by the
fitted and by the given sensor, to compare noise and columns.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr

from vbnfault.core.files.toml_files import parse_toml
from vbnfault.detector.chain import Device, MosaicNoise, by_channel
from vbnfault.detector.dark import HotPixelGrowth
from vbnfault.detector.individual import IndividualSpec
from vbnfault.detector.mosaic import pattern
from vbnfault.detector.readout import ReadoutSpec
from vbnfault.detector.sensor import Sensor, load_sensor, parse_sensor
from vbnfault.fit.exposures import Exposure, Kind, read_exposures
from vbnfault.fit.frames import body_figures, look, sky_figures
from vbnfault.fit.replay import Display
from vbnfault.fit.sensor_file import sensor_text
from vbnfault.fit.sensor_fit import SensorFit, fit_sensor

F32 = NDArray[np.float32]
PIXELS, STARS, HITS, LAMP = 256, 60, 12, 1e-3
LEVELS = (0.04, 0.12, 0.25, 0.42, 0.6, 1.4)  # of flats, in fractions of white


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """Hold a device of a hidden sensor, and the width of the point spread before it."""

    device: Device
    core_px: float
    seed: int

    @property
    def sensor(self) -> Sensor:
        """Return the sensor."""
        return self.device.sensor

    def base(self) -> str:
        """Return the sensor file that its user has: filters and bits, all else at the defaults."""
        readout = self.sensor.readout
        return (
            f'name = "hidden {self.seed}"\narchitecture = "{self.sensor.architecture}"\npixel_pitch_um = 5.5\n'
            f'pattern = "{self.sensor.pattern.name}"\nwidth_px = {PIXELS}\nheight_px = {PIXELS}\n[readout]\n'
            f'bits = {readout.bits}\nfull_well_e = 1.0\n[sources]\nwidth_px = "known"\n'
            'height_px = "known"\npixel_pitch_um = "known"\n"readout.bits" = "known"\n'
            '"readout.full_well_e" = "to fit"\n'
        )


def hidden(seed: int) -> Hidden:
    """Draw a sensor and one device of it."""
    rng = np.random.default_rng([seed, 51])

    def log(low: float, high: float) -> float:
        return float(low * (high / low) ** rng.random())

    bits = int(rng.choice([10, 12, 14, 16]))
    read_e, full_e = log(1.5, 20), log(6e3, 9e4)
    top = 2**bits - 1
    # an engineer chooses no converter whose steps hide the read noise, nor one that only resolves it further
    gain = float(np.clip(rng.uniform(0.75, 1.4) * 0.95 * top / full_e, 0.3 / read_e, 10 / read_e))
    bias = math.ceil(8 * gain * math.hypot(read_e, 12) + rng.uniform(5, 30))
    dark, dsnu = log(5, 500), log(1.0, 10)
    power = rng.uniform(0.5, 1.5)
    growth = HotPixelGrowth(
        log10_scale=math.log10(log(2e-4, 3e-3) / 5.5e-3**2 / 400**power), size_power=0, iso_power=power
    )
    spec = IndividualSpec(
        prnu=log(0.004, 0.03),
        dsnu_e=dsnu,
        dark_current_e_s=dark,
        dark_nonuniformity=rng.uniform(0.05, 0.3),
        reference_K=293.0,
        hot_growth=growth,
        years=1.0,
        hot_rate_e_s=(5 * dark, 500 * dark),
        hot_offset_fraction=0.0,
        dead_fraction=log(5e-5, 1e-3),
    )
    readout = ReadoutSpec(
        bits=bits,
        full_well_e=full_e,
        bias_dn=bias,
        node_offsets_dn=(rng.uniform(-0.5, 0.5),),
        gain_dn_per_e=gain,
        bias_drift_dn_rms=float(rng.choice([0.0, log(0.05, 0.5)])),
        read_noise_e_rms=read_e,
        row_noise_e_rms=float(rng.choice([0.0, log(0.2, 2)])),
        column_pattern_e_rms=log(0.5, 5),
        row_pattern_e_rms=log(0.2, 2),
        inl_quadratic_dn=rng.uniform(-3e-3, 3e-3) * top,
    )
    sensor = Sensor(
        name=f"hidden {seed}",
        architecture=str(rng.choice(["cmos", "full_frame_ccd"])),  # type: ignore[arg-type]
        pattern=pattern(str(rng.choice(["mono", "rggb", "rgbw"]))),
        width_px=PIXELS,
        height_px=PIXELS,
        temperature_K=293.0,
        individual=spec,
        readout=readout,
    )
    return Hidden(device=Device(sensor, seed), core_px=rng.uniform(0.5, 1.6), seed=seed)


def taken(one: Hidden, light_e: F32, exposure_s: float, number: int) -> NDArray[np.uint16]:
    """Return a raw frame of a light, with hits of particles."""
    rngs = [np.random.default_rng([one.seed, number, k]) for k in range(4)]
    raw = one.device.raw(light_e.copy(), exposure_s, MosaicNoise.draw(light_e.shape, *rngs[:3]))
    row, column = rngs[3].integers(0, PIXELS, (2, HITS))
    raw[row, column] = np.minimum(
        raw[row, column] + rngs[3].exponential(0.1, HITS) * 2**one.sensor.readout.bits, one.sensor.readout.top_dn
    )
    return raw


def channels(one: Hidden) -> F32:
    """Return the relative response of each pixel's filter, 0.5 to 1."""
    rng = np.random.default_rng([one.seed, 7])
    values = np.append(rng.uniform(0.5, 1.0, len(one.sensor.pattern.channels) - 1), 1.0)
    return by_channel(one.sensor, (PIXELS, PIXELS), list(rng.permutation(values)))


def calibration(one: Hidden) -> Iterator[Exposure]:
    """Give 20 frames: darks, flats and star fields."""
    rng = np.random.default_rng([one.seed, 8])
    filters, number = channels(one), 0
    white_e = one.sensor.readout.white_e
    longest = 400 / one.sensor.individual.dark_current_e_s

    def frame(kind: Kind, light_e: F32, exposure_s: float) -> Exposure:
        nonlocal number
        number += 1
        raw = taken(one, light_e, exposure_s, number)
        return Exposure(name=f"{kind} {number}", kind=kind, image=raw, exposure_s=exposure_s, temperature_K=293.0)

    for exposure_s in (0.001, longest / 10, longest):
        for _ in range(2):
            yield frame("dark", 0 * filters, exposure_s)
    y, x = np.mgrid[:PIXELS, :PIXELS] / PIXELS - 0.5
    shade = (1 - 0.2 * (x**2 + y**2)).astype(np.float32)
    for level in LEVELS:
        for _ in range(2):
            light = filters * shade * np.float32(level * white_e * (1 + LAMP * rng.standard_normal()))
            yield frame("flat", light, 0.1 * level)
    for _ in range(2):
        yield frame("star", filters * stars(one.core_px, white_e, rng), 0.1)


def stars(core_px: float, white_e: float, rng: np.random.Generator) -> F32:
    """Return the electrons of a field of stars whose images are Gaussians."""
    out = np.full((PIXELS, PIXELS), 2e-3 * white_e)
    edges = np.arange(PIXELS + 1)
    for x, y in rng.uniform(8, PIXELS - 8, (STARS, 2)):
        peak = white_e * 10 ** rng.uniform(-1.8, -0.3)
        across, down = (np.diff(ndtr((edges - place) / core_px)) for place in (x, y))
        out += peak * 2 * math.pi * max(core_px, 0.4) ** 2 * np.outer(down, across)
    return out.astype(np.float32)


def ordinary(one: Hidden) -> Iterator[Exposure]:
    """Give 20 frames of a textured body with a glow around it, in different places."""
    rng = np.random.default_rng([one.seed, 9])
    filters, white_e = channels(one), one.sensor.readout.white_e
    y, x = np.mgrid[:PIXELS, :PIXELS]
    for number in range(20):
        middle, radius = rng.uniform(0.25 * PIXELS, 0.75 * PIXELS, 2), rng.uniform(0.12, 0.2) * PIXELS
        away = np.hypot(x - middle[0], y - middle[1]) / radius
        texture = np.exp(0.3 * ndimage.gaussian_filter(rng.standard_normal((PIXELS, PIXELS)), 1.5) * 5)
        glow = 0.06 / np.maximum(away, 1) ** 2
        light = white_e * np.where(away < 1, 0.5 * texture, glow)
        raw = taken(one, (filters * light).astype(np.float32), 0.01, 100 + number)
        yield Exposure(name=f"frame {number}", kind="frame", image=raw)


def truth(one: Hidden, fit: SensorFit) -> dict[str, float]:
    """Return the true value of each key of a fit."""
    sensor = one.sensor
    out = {"point spread": one.core_px}
    for table, spec in (("individual", sensor.individual), ("readout", sensor.readout)):
        out |= {f"{table}.{name}": value for name, value in vars(spec).items() if isinstance(value, int | float)}
    out["readout.bias_dn"] += sensor.readout.node_offsets_dn[0]
    out["readout.full_well_e"] = sensor.readout.white_e
    growth = sensor.individual.hot_growth
    assert growth is not None
    p, (low, high) = growth.iso_power, sensor.individual.hot_rate_e_s
    whole = 10**growth.log10_scale * 5.5e-3**2 * 400**p
    above = max(fit.hot_rate_e_s[0], low)
    out["individual.hot_fraction"] = whole * (above**-p - high**-p) / (low**-p - high**-p)
    out["individual.hot_growth.iso_power"] = p
    return out


def coverage(count: int, first: int, takes: str) -> str:
    """Return a table: how often the interval of each key holds the truth, and its median width."""
    held, widths, off = defaultdict(list), defaultdict(list), defaultdict(list)
    missing = defaultdict(int)
    for seed in range(first, first + count):
        one = hidden(seed)
        frames = list(ordinary(one) if takes == "ordinary" else calibration(one))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "base.toml"
            path.write_text(one.base())
            fit = fit_sensor(frames, str(path))
        parse_sensor(parse_toml(sensor_text(fit), "fitted"), source="fitted")
        true = truth(one, fit)
        for key, value in fit.estimates.items():
            held[key].append(value.low <= true[key] <= value.high)
            widths[key].append((value.high - value.low) / abs(true[key] or math.nan))
            off[key].append((value.value - true[key]) / max((value.high - value.low) / 3.92, 1e-12))
            if not held[key][-1]:
                fitted = f"{value.value:.5g} ({value.low:.5g} to {value.high:.5g})"
                print(f"  {seed}: {key}: true {true[key]:.5g}, fitted {fitted}", flush=True)
        for key in fit.missing:
            missing[key] += 1
    lines = [f"{'key':<34}{'held':>10}{'width / value':>15}{'median of errors':>18}{'not fitted':>12}"]
    for key, values in sorted(held.items()):
        lines.append(
            f"{key:<34}{f'{sum(values)} of {len(values)}':>10}{np.nanmedian(widths[key]):>15.3f}"
            f"{np.median(off[key]):>18.2f}{missing[key]:>12}"
        )
    return "\n".join(lines)


def compared(folder: Path, name: str, stretch: float) -> str:
    """Return how noisy every second frame is as a given and as the fitted sensor show its smoothed signal."""
    frames = read_exposures({"frame": [folder]})
    fit = fit_sensor(frames, name, stretch)
    fitted = parse_sensor(parse_toml(sensor_text(fit), "fitted"), source="fitted")
    lines = [f"{key:<34}{one.value:>10.4g}  {one.low:.4g} to {one.high:.4g}" for key, one in fit.estimates.items()]
    ratios = {"fitted": defaultdict(list), name: defaultdict(list)}
    for which, sensor in (("fitted", fitted), (name, load_sensor(name))):
        device, readout = Device(sensor, 1), sensor.readout
        display = Display(bias_dn=readout.bias_dn, top_dn=readout.top_dn, stretch=stretch)
        dark_dn = device.raw(np.zeros(device.shape, np.float32), 0.43).mean(axis=1, keepdims=True) - readout.bias_dn
        for number, frame in enumerate(frames[::2]):
            real = look(frame.image)
            if real.clipped:
                continue
            smooth = ndimage.gaussian_filter(np.asarray(frame.image, np.float32), 2.0)
            factor = device.shape[0] // smooth.shape[0]
            signal = (smooth / 255) ** (1 / stretch) * (display.top_dn - display.bias_dn)
            light = np.maximum(np.kron(signal, np.ones((factor, factor))) - dark_dn, 0)
            rngs = [np.random.default_rng([number, k]) for k in range(3)]
            noise = MosaicNoise.draw(device.shape, *rngs)
            raw = device.raw((light / readout.system_gain_dn_per_e).astype(np.float32), 0.43, noise)
            shown = look(display.developed(raw, factor))
            values = [sky_figures(one, real.lit) | body_figures(one, np.array([1.0, 0.0])) for one in (real, shown)]
            for key in ("noise", "column", "noise_lit"):
                # columns of a frame whose levels are coarse may show nothing
                ratios[which][key].append(values[1][key] / (values[0][key] or math.nan))
            away = ndimage.distance_transform_edt(~real.lit)
            for low, high in ((4, 6), (6, 8), (8, 10), (10, 14)):
                part = (away > 5) & (smooth >= low) & (smooth < high)
                if part.sum() > 2000:
                    rough = [one.image - ndimage.median_filter(one.image, 5) for one in (real, shown)]
                    spread = [np.std(one[part & (np.abs(one) < 4)]) for one in rough]
                    ratios[which][f"noise at {low} to {high}"].append(spread[1] / spread[0])
    lines.append(f"{'simulated over real, median':<34}{'fitted':>10}{name:>18}")
    for key in ratios["fitted"]:
        medians = [f"{np.nanmedian(ratios[which][key]):.3f}" for which in ("fitted", name)]
        lines.append(f"{key:<34}{medians[0]:>10}{medians[1]:>18}")
    return "\n".join(lines)


def main() -> None:
    """Print the table, or the comparison of real frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--ordinary", action="store_true")
    parser.add_argument("--frames", type=Path)
    parser.add_argument("--sensor", default="rosetta_navcam")
    parser.add_argument("--stretch", type=float, default=0.5)
    options = parser.parse_args()
    if options.frames is not None:
        print(compared(options.frames, options.sensor, options.stretch))
        return
    print(coverage(options.sensors, options.first, "ordinary" if options.ordinary else "calibration"))


if __name__ == "__main__":
    main()
