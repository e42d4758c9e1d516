"""Measure how late a simple monitor sees faults, by frame rate, exposure and severity.

    python benchmarks/fault_delay.py --out docs/figures/fault_delay.png [--size 128] [--falls 2] [--json FILE]

The camera of `descent67p` falls from 60 m to 45 m, with noise of its attitude. For each number of grains or lines
and each exposure, falls get dust that grows over 5 s, or broken lines that are there at once; both begin at a time
from 50 to 55 s. Monitors with fewer frames see some of the same images of the same falls.

A monitor knows no class and no pose. It takes six numbers of each frame, their mean and standard deviation over
the 10 frames of its rate before 50 s, and raises an alarm while a number is more than 6 standard deviations from
its mean, and further than in any clean twin, so that no monitor is ever wrong. Its log is scored by
`vbnfault score`. The last column says how many clean falls would have an alarm by 6 standard deviations alone.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas
from numpy.typing import NDArray

import vbnfault
from vbnfault.detect.scored_samples import ALL, ScoreOptions
from vbnfault.detect.scoring import score
from vbnfault.scene.trajectory import COLUMNS, MOTION_COLUMNS

F64 = NDArray[np.float64]

RATES_HZ, STOPS = (0.2, 1.0, 5.0), (-2.0, 0.0, 2.0)
COUNTS = {"dust_on_optics": (1, 4, 16), "broken_lines": (1, 3, 9)}  # grains and lines
FAULTS: dict[str, dict[str, Any]] = {
    "dust_on_optics": {"model": "defocused"},
    "broken_lines": {"model": "readout"},
}
PROFILES: dict[str, dict[str, Any]] = {
    "dust_on_optics": {"profile": "growing", "rise_s": 5.0},
    "broken_lines": {"profile": "sudden"},
}
BEFORE_S, END_S, LEARNED, DEVIATIONS = 50.0, 61.0, 10, 6.0
_MISSED_S = 9.8  # where the figure writes of events that are never seen
MONITORS = {rate: np.arange(BEFORE_S - LEARNED / rate, END_S + 1e-9, 1 / rate) for rate in RATES_HZ}


def write_poses(path: Path, size: int, falls: int) -> None:
    """Write the frames of all rates of some flights as a table of poses."""
    flight = {
        "kind": "descent",
        "sequences": falls,
        "frames": int(5 * END_S) + 1,
        "period_s": 0.2,
        "height_m": 60.0,
        "end_height_m": 45.0,
        "sun_elevation_deg": [30.0, 60.0],
        "attitude_noise_deg": 1.0,
    }
    flown = vbnfault.Session(scene_of(flight, size, "broken_lines", 1, 0.0)).trajectory
    assert flown is not None
    wanted = np.isin(np.round(flown.time_s, 6), np.round(np.concatenate(list(MONITORS.values())), 6))
    sequence = np.repeat(flown.sequence_names, flown.frames)
    vectors = (
        flown.camera_position_T_m,
        flown.camera_from_T,
        flown.sun_direction_T,
        flown.sun_distance_au[:, None],
        flown.velocity_T_m_s,
        flown.rate_C_rad_s,
    )
    table = pandas.DataFrame(np.concatenate(vectors, axis=1), columns=[*COLUMNS[2:], *MOTION_COLUMNS])
    table = table.assign(name=flown.name, julian_date=flown.julian_date, sequence=sequence, time_s=flown.time_s)
    table[wanted].to_csv(path, index=False)


def scene_of(flight: Any, size: int, fault: str, count: int, stops: float) -> Any:
    """Return a scene of a flight, or of a table of poses, whose sequences all get a fault."""
    event = {"cause": "test", "faults": [fault], "onset_s": [BEFORE_S, BEFORE_S + 5], **PROFILES[fault]}
    flown = {"file": str(flight)} if isinstance(flight, Path) else {"flight": [flight]}
    changes = {
        "camera.width_px": size,
        "camera.height_px": size,
        "camera.exposure_stops": [stops, stops],
        "patch.max_triangles": 300_000,
        "render.samples_per_pixel": 4,
        "render.bands": 2,
        "trajectory": flown,
        "dataset.layers": ["clean"],
        "dataset.seed": 7,
        "plan.faulty_fraction": 1.0,
        "plan.classes_per_sample": [1, 1],
        "faults": {fault: {**FAULTS[fault], "count": count}},
        "event": [event],
    }
    return vbnfault.load_scene("descent67p", changes)


def numbers(images: NDArray[np.uint8]) -> F64:
    """Return mean, contrast, white and black pixels, fine detail and change since the frame before, [frame, 6]."""
    values = images[..., 3].astype(np.float32)
    low, high = np.percentile(values, (0.5, 99.5), axis=(1, 2))
    fine = [np.abs(one - cv2.GaussianBlur(one, (0, 0), 1.5)).mean() for one in values]
    change = np.abs(np.diff(values, axis=0, prepend=values[:1])).mean(axis=(1, 2))
    change[0] = change[1]
    of_pixels = [(values >= 255).mean(axis=(1, 2)), (values <= 0).mean(axis=(1, 2))]
    return np.stack([values.mean(axis=(1, 2)), high - low, *of_pixels, fine, change], axis=1)


def deviations(images: NDArray[np.uint8]) -> F64:
    """Return how far the numbers of frames of one rate are from their mean, in standard deviations, [frame, 6]."""
    found = numbers(images)
    mean, deviation = found[:LEARNED].mean(axis=0), found[:LEARNED].std(axis=0, ddof=1)
    least = 1 / images[0, ..., 3].size  # a pixel that is white or black, and a rounded mean
    return np.abs(found - mean) / np.maximum(deviation, least)


def scored(store: Path, folder: Path) -> dict[float, dict[str, Any]]:
    """Return for each rate the figures of the events, and the fraction of clean falls beyond 6 deviations."""
    out = {}
    with vbnfault.open_dataset(store) as data:
        names, time_s = np.array(data["sequence"].attrs["names"]), data["time_s"].values
        sequence, images = data["sequence"].values, {name: data[name].values for name in ("image", "clean")}
    for rate, times in MONITORS.items():
        of_rate = np.isin(np.round(time_s, 6), np.round(times, 6))
        falls = [np.flatnonzero((sequence == k) & of_rate) for k in range(len(names))]
        clean = np.stack([deviations(images["clean"][mine]) for mine in falls])
        limit, rows = np.maximum(clean.max(axis=(0, 1)), DEVIATIONS), ["sequence,time_s,class,present"]
        for name, mine in zip(names, falls, strict=True):
            held = (deviations(images["image"][mine]) > limit).any(axis=1)
            rows += [
                f"{name},{time_s[mine[at]]},any,{int(held[at])}"
                for at in np.flatnonzero(np.diff(held, prepend=False))
            ]
        log = folder / "log.csv"
        log.write_text("\n".join(rows) + "\n")
        figures = score(log, store, folder / "score", ScoreOptions(split=ALL))["time"]["all"]
        out[rate] = {**figures, "clean_falls_beyond_6": float((clean > DEVIATIONS).any(axis=(1, 2)).mean())}
    return out


def main() -> None:
    """Build the data sets, run the monitors, and print and draw their delays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--falls", type=int, default=2)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    print("fault           count stops rate/Hz  missed delay/s clean falls beyond 6 deviations")
    with tempfile.TemporaryDirectory() as name:
        poses, store = Path(name) / "poses.csv", Path(name) / "s.zarr"
        write_poses(poses, options.size, options.falls)
        for fault, stops, nth in itertools.product(FAULTS, STOPS, range(3)):
            count = COUNTS[fault][nth]
            begun = time.process_time()
            scene = scene_of(poses, options.size, fault, count, stops)
            vbnfault.build(scene, store, progress=False, overwrite=True)
            for rate, one in scored(store, Path(name)).items():
                found[f"{fault} {count} {stops:g} {rate:g}"] = one
                delay = one["delay_s_median"]["value"]
                print(
                    f"{fault:<16}{count:>5}{stops:>7g}{rate:>8g}{one['missed_fraction']['value']:>8.0%}"
                    f"{'–' if delay is None else f'{delay:.1f}':>8}{one['clean_falls_beyond_6']:>8.0%}"
                )
            print(f"  {time.process_time() - begun:.0f} s of CPU", flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))
    draw(found, options.out)


def draw(found: dict[str, Any], path: Path) -> None:
    """Draw median delays over the number of grains or lines, a panel for each exposure, a line for each rate."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(8.4, 4.6), layout="constrained")
    panels = drawn.subplots(len(FAULTS), len(STOPS), sharey=True)
    for row, (fault, unit) in zip(
        panels, {"dust_on_optics": "grains", "broken_lines": "lines"}.items(), strict=True
    ):
        for axes, stops in zip(row, STOPS, strict=True):
            for rate in RATES_HZ:
                figures = [found[f"{fault} {count} {stops:g} {rate:g}"] for count in COUNTS[fault]]
                delays = [one["delay_s_median"]["value"] for one in figures]
                at = [np.nan if delay is None else delay for delay in delays]
                (line,) = axes.plot(COUNTS[fault], at, "o-", label=f"{rate:g} Hz", clip_on=False)
                for count, one, delay in zip(COUNTS[fault], figures, delays, strict=True):
                    if missed := one["missed_fraction"]["value"]:
                        place = (count, _MISSED_S if delay is None else delay)
                        note = {"textcoords": "offset points", "xytext": (3, 3), "color": line.get_color()}
                        axes.annotate(f"{missed:.0%} missed", place, fontsize=7, **note)
            axes.set_title(f"{fault.replace('_', ' ')}, {stops:+g} stops", fontsize=9)
            axes.set_xscale("log")
            axes.set_xticks(COUNTS[fault], map(str, COUNTS[fault]))
            axes.minorticks_off()
            axes.set_xlabel(unit)
            axes.set_ylim(-0.3, 11)
        row[0].set_ylabel("median delay / s")
    panels[0, -1].legend(fontsize=7)
    drawn.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
