"""Find the power of light that the levels of frames show: from smear, and from contrast beside rendered images.

    python benchmarks/frame_stretch.py passport/pairs/NAME_real.png passport/pairs/NAME_rendered.png
    python benchmarks/frame_stretch.py --pairs passport/pairs --stretch 0.5

Light that falls on a column while its rows move is proportional to the sum of the body's light in the column. Taken
from levels to the power 1 / stretch, the one is a straight line over the other only with the right stretch: the
curvature of a regression changes its sign there. It is sought above and below the body, where charge is cleared and
read. What the lens scatters bends the line, too, so compare a frame with an image of a known stretch.

With `--pairs`, the logarithm of the frames' brightness, smoothed over `SMOOTH` of the width, is compared with that
of images with the stretch `--stretch`: where the frames spread more, a larger one is likely.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy import ndimage

from vbnfault.fit.frames import Look, look, read_frame

STRETCHES = np.arange(0.3, 1.001, 0.01)
AWAY = 0.08  # of the image's height: rows nearer to the body than this show what the lens scatters

SMOOTH = 1 / 32  # of the width
EDGE = 6  # px of the body's border that are left out
LEAST = 2000  # px of a body that is compared


def contrast(real: Look, rendered: Look, stretch: float) -> tuple[float, float]:
    """Return the spread of smoothed brightness over that of the image, and the slope of its regression on it."""
    lit = ndimage.binary_erosion(real.lit & rendered.lit, iterations=EDGE)
    if lit.sum() < LEAST:
        return float("nan"), float("nan")
    sigma = SMOOTH * lit.shape[1]
    weight = ndimage.gaussian_filter(lit.astype(np.float64), sigma)[lit]
    light = ((one.image.astype(np.float64) / 255) ** (1 / stretch) for one in (real, rendered))
    a, b = (np.log(ndimage.gaussian_filter(part * lit, sigma)[lit] / weight + 1e-3) for part in light)
    return float(a.std() / b.std()), float(np.cov(a, b)[0, 1] / b.var())


def straight(one: Look, *, above: bool) -> float:
    """Return the stretch with which the smear goes with the body's light in a straight line; NaN without one."""
    height = len(one.lit)
    away, row = round(AWAY * height), np.arange(height)[:, None]
    first, last = one.lit.argmax(axis=0), height - 1 - one.lit[::-1].argmax(axis=0)
    part = row < first - away if above else row >= last + away
    columns = one.lit.any(axis=0) & (part.sum(axis=0) > away / 2)
    image, lit = one.image[:, columns] / 255, one.lit[:, columns]
    level = np.nanmedian(np.where(part[:, columns], image, np.nan), axis=0)
    bent = []  # quadratic over linear term of the columns' sky as a function of the body's light
    for stretch in STRETCHES:
        body, sky = (np.where(lit, image, 0) ** (1 / stretch)).sum(axis=0), level ** (1 / stretch)
        quadratic, linear, _ = np.polyfit(body / body.max(), sky / sky.mean(), 2)
        bent.append(quadratic / linear)
    turns = [k for k in range(len(bent) - 1) if bent[k] > 0 >= bent[k + 1]]
    if not turns:
        return float("nan")
    k = turns[0]
    return float(np.interp(0.0, [-bent[k], -bent[k + 1]], STRETCHES[k : k + 2]))


def main() -> int:
    """Print the stretch of each image and the contrast of pairs, and return 1 if an image is not smeared."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs="*", type=Path)
    parser.add_argument("--pairs", type=Path)
    parser.add_argument("--stretch", type=float, default=0.5)
    given, failed = parser.parse_args(), False
    if not (given.images or given.pairs):
        parser.error("needs images or --pairs")
    if given.pairs:
        names = sorted(path.stem.removesuffix("_real") for path in given.pairs.glob("*_real.png"))
        looks = [[look(read_frame(given.pairs, f"{n}_{which}")) for which in ("real", "rendered")] for n in names]
        figures = [contrast(*pair, given.stretch) for pair in looks if not pair[0].clipped]
        spread, slope = np.nanmedian(figures, axis=0)
        print(f"{given.pairs}: frames spread {spread:.3f} times as much; slope {slope:.3f}")
    for path in given.images:
        one = look(read_frame(path.parent, path.stem))
        if not one.smeared:
            print(f"{path}: no smear shows")
            failed = True
            continue
        print(f"{path}: {straight(one, above=True):.3f} above the body, {straight(one, above=False):.3f} below")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
