"""Replay the flight frames of a folder with a packaged scene, and print figures of all pairs.

    python benchmarks/flight_replay.py --frames FOLDER --shape SHAPE --out replay
    python benchmarks/flight_replay.py --frames FOLDER --out replay --rows 0,5,18 --set render.bounces=1

FOLDER holds `poses.csv` (the columns of `[trajectory]`) and for each row an image NAME.png of 8 or 16 bits.
`flight_eros.toml` and `flight_bennu.toml` are scenes for frames of other cameras. `vbnfault.fit` says how the
images come about and what each figure means; `vbnfault passport` makes a page of them and keeps a part back.
`replay.json` holds all figures, `sheet.png` the pairs real | rendered at full size, and `pairs` the aligned
images, which `flight_classifier.py` tries to tell apart.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import vbnfault
from vbnfault.cli import options
from vbnfault.fit.frames import read_frame
from vbnfault.fit.passport import OF_PAIRS, STATISTICS
from vbnfault.fit.replay import Pair, Replay, step_of
from vbnfault.scene.trajectory import load_trajectory

# Rosetta's camera has two gains: at one level, the sky of three frames in a row has 1.4 times the others' variance
HIGH_GAIN = 1.4


def sheet(pairs: Sequence[Pair], across: int = 3) -> NDArray[np.uint8]:
    """Return the pairs real | rendered at full size, uint8[y, x], with the same stretch and their names."""
    cells = []
    for pair in pairs:
        halves = [
            np.clip(0.85 * one.image / max(one.bright, 1e-6), 0, 1) * 255 for one in (pair.real, pair.rendered)
        ]
        cell = np.hstack(halves).astype(np.uint8)
        f = pair.figures
        text = f"{pair.name}  IoU {f['iou']:.3f}  rank {f['rank']:.2f}  limb {f['limb_px']:.1f} px"
        cv2.putText(cell, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255, 1, cv2.LINE_AA)
        cells.append(cv2.copyMakeBorder(cell, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(90,)))
    cells += [np.zeros_like(cells[0])] * (-len(cells) % across)
    rows = [np.hstack(cells[k : k + across]) for k in range(0, len(cells), across)]
    return np.asarray(np.vstack(rows), dtype=np.uint8)


def write_pair(folder: Path, pair: Pair) -> None:
    """Write NAME_real.png and NAME_rendered.png, aligned, in as many bits as the frame has, 8 or 16."""
    folder.mkdir(parents=True, exist_ok=True)
    for which, one in (("real", pair.real), ("rendered", pair.rendered)):
        step = step_of(pair.real.image)
        image = np.round(one.image / step).astype(np.uint8 if step == 1 else np.uint16)
        cv2.imwrite(str(folder / f"{pair.name}_{which}.png"), image)


def table(figures: Sequence[Mapping[str, float]]) -> list[str]:
    """Return medians over the frames as lines of text; of powers also that of the ratio."""
    lines = [f"{'figure':<16}{'median':>10}{'least':>10}{'greatest':>10}"]
    for name in OF_PAIRS:
        values = [one[name] for one in figures]
        lines.append(f"{name:<16}{np.nanmedian(values):>10.4g}{np.nanmin(values):>10.4g}{np.nanmax(values):>10.4g}")
    lines.append(f"{'statistic':<16}{'real':>10}{'rendered':>10}{'ratio':>10}")
    for name in STATISTICS:
        real, rendered = (np.array([one[f"{name} {which}"] for one in figures]) for which in ("real", "rendered"))
        ratio = np.nanmedian(rendered / np.maximum(real, 1e-12))
        lines.append(f"{name:<16}{np.nanmedian(real):>10.4g}{np.nanmedian(rendered):>10.4g}{ratio:>10.4g}")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Replay the frames of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=Path, required=True, help="folder of NAME.png and poses.csv")
    parser.add_argument("--poses", type=Path, help="table of poses; default: poses.csv in the folder")
    parser.add_argument("--shape", help="shape model of the body; default: that of the scene")
    parser.add_argument("--scene", default="rosetta67p", help="scene with camera and ground")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a key of the scene")
    parser.add_argument("--rows", help="rows to replay, such as 0,5,18; default: all")
    parser.add_argument(
        "--mend-poses", type=int, default=0, metavar="N", help="mend each pose N times by a similarity (default: 0)"
    )
    parser.add_argument("--threads", type=int, help="render threads; default: every core")
    parser.add_argument("--out", type=Path, required=True, help="folder for replay.json and sheet.png")
    given = parser.parse_args(arguments)

    trajectory = load_trajectory(str((given.poses or given.frames / "poses.csv").resolve()))
    rows = [int(k) for k in given.rows.split(",")] if given.rows else list(range(len(trajectory)))
    overrides = options.overrides(given.set) | ({"body.shape": given.shape} if given.shape else {})
    frames = {row: read_frame(given.frames, trajectory.name[row]) for row in rows}
    replay = Replay(
        vbnfault.load_scene(given.scene, overrides),
        trajectory,
        gains=(1.0, HIGH_GAIN),
        mendings=given.mend_poses,
        threads=given.threads,
    )
    pairs = []
    for row in rows:
        start = time.perf_counter()
        pair = replay.pair(row, frames[row])
        f, shift = pair.figures, pair.settings["shift_px"]
        print(
            f"{pair.name}: IoU {f['iou']:.4f}, rank {f['rank']:.3f} ({f['rank_smooth']:.3f} smooth), limb "
            f"{f['limb_px']:.2f} px, shift {shift[0]:+.1f} {shift[1]:+.1f} px, gain {pair.settings['gain']:g}, "
            f"black {pair.settings['black_dn']:+.2f} DN, {time.perf_counter() - start:.1f} s",
            file=sys.stderr,
            flush=True,
        )
        pairs.append(pair)
        write_pair(given.out / "pairs", pair)
    figures = [pair.figures for pair in pairs]
    result = {pair.name: {**pair.figures, **pair.settings} for pair in pairs}
    (given.out / "replay.json").write_text(json.dumps(result, indent=1))
    cv2.imwrite(str(given.out / "sheet.png"), sheet(pairs))
    print("\n".join(table(figures)))


if __name__ == "__main__":
    main()
