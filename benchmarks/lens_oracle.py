"""Surfaces met per second by rays sent straight through a lens: optiland's trace, and the project's own.

python benchmarks/lens_oracle.py [--lens NAME]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from optiland.physical_apertures import RadialAperture
from optiland.rays import RealRays

from vbnfault.lens import Prescription, first_order, load_lens
from vbnfault.lens.glass import D_NM

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import sequential_oracle as oracle

ROUNDS = 3


def optilands(lens: Prescription, count: int) -> float:
    """Surfaces met per second, those of the lens; median of rounds after one that compiles."""
    optic = oracle.system(lens)
    for surface in optic.surfaces.surfaces[1:-1]:
        surface.interaction_model.coating = None  # its intersections and refractions alone
        surface.aperture = RadialAperture(surface.aperture.r_max)
    across = int(np.ceil(np.sqrt(count)))
    half = first_order(lens).entrance_pupil_diameter_mm / 2 / np.sqrt(2)
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-half, half, across)] * 2))
    one, none = np.ones_like(x), np.zeros_like(x)
    seconds = []
    for _ in range(ROUNDS + 1):
        rays = RealRays(x, y, none - half, none, none, one, one, one * D_NM / 1000)
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba's, of its own workings
            optic.surfaces.trace(rays, skip=1, record=False)
        seconds.append(time.perf_counter() - start)
    return len(x) * len(lens.surfaces) / statistics.median(seconds[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lens", default="nikkor_28_f2p8")
    lens = load_lens(parser.parse_args().lens)
    print(f"{lens.name}, {len(lens.surfaces)} surfaces")
    rates = {}
    for count in (100_000, 1_000_000):
        rates[count] = optilands(lens, count)
        print(f"optiland, {count:9,d} rays: {rates[count] / 1e6:7.2f} million surfaces per second")
    try:
        from vbnfault.lens.ghosts import surface_interactions_per_second
    except ImportError:
        return
    ours = surface_interactions_per_second(lens)
    best = max(rates.values())
    print(f"vbnfault:                 {ours / 1e6:7.2f} million, {ours / best:.1f} times optiland's best")


if __name__ == "__main__":
    main()
