"""Let classifiers tell rendered flight frames from real ones, see `vbnfault.fit.two_samples`.

    python benchmarks/flight_replay.py --frames FOLDER --shape SHAPE --out replay
    python benchmarks/flight_classifier.py --pairs replay/pairs --out classifier

`pairs` holds NAME_real.png and NAME_rendered.png, aligned and both in 8 bits.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import cv2

from vbnfault.fit.frames import read_frame
from vbnfault.fit.two_samples import two_sample_test


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the test on a folder of pairs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=Path, required=True, help="folder of NAME_real.png and NAME_rendered.png")
    parser.add_argument("--out", type=Path, required=True, help="folder for classifier.json and the figures")
    parser.add_argument("--size", type=int, default=32, choices=(16, 24, 32, 48, 64), help="of the patches, px")
    parser.add_argument("--patches", type=int, default=12, help="of a place in a frame (default %(default)s)")
    parser.add_argument("--splits", type=int, default=4, help="random halves of the frames (default %(default)s)")
    parser.add_argument("--draws", type=int, default=4, help="of positions and halves (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of positions and halves (default %(default)s)")
    given = parser.parse_args(arguments)

    names = sorted(path.name.removesuffix("_real.png") for path in given.pairs.glob("*_real.png"))
    images = {
        which: [read_frame(given.pairs, f"{name}_{which}").astype("uint8") for name in names]
        for which in ("real", "rendered")
    }
    pairs = list(zip(images["real"], images["rendered"], strict=True))
    result, pictures = two_sample_test(
        pairs, size=given.size, count=given.patches, splits=given.splits, draws=given.draws, seed=given.seed
    )
    given.out.mkdir(parents=True, exist_ok=True)
    for place, figures in result.items():
        cv2.imwrite(str(given.out / f"confident_{place}.png"), pictures[place])
        print(f"{place}: patches of {given.size} px")
        for name, values in figures.items():
            mean, low, high = (100 * value for value in values)
            print(f"  {name:<22} {mean:5.1f} %  ({low:.1f} to {high:.1f})", flush=True)
    (given.out / "classifier.json").write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
