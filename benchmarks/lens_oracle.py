"""Compare the speed of ray tracing through a lens, in ray-surface intersections per second, with optiland's.

    python benchmarks/lens_oracle.py [--lens NAME]

The rays pass the lens without reflection.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from optiland.physical_apertures import RadialAperture
from optiland.rays import RealRays

from vbnfault.lens import Prescription, load_lens, paraxial_properties
from vbnfault.lens.glass import D_NM
from vbnfault.lens.straylight.bundles import Rays, Tracer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import sequential_oracle as oracle

ROUNDS = 3


def ours(lens: Prescription, count: int) -> float:
    """Return the ray-surface intersections per second of the tracer of ghosts, which also computes the light."""
    made, across = Tracer(lens, np.array([D_NM]), routes_=[()]), int(np.ceil(np.sqrt(count)))
    half = paraxial_properties(lens).entrance_pupil_diameter_mm / 2 / np.sqrt(2)
    bundle = Rays(
        route=np.zeros(1, dtype=np.int64),
        wavelength=np.zeros(1, dtype=np.int64),
        box_mm=np.array([[0.0, 0.0, half, half]]),
        direction=np.array([[0.0, 0.0, 1.0]]),
    )

    def straight_through() -> int:
        return made.trace(bundle, across, halved=False).radius.numpy().size

    return rate(lens, straight_through)


def optilands(lens: Prescription, count: int) -> tuple[float, float]:
    """Return optiland's ray-surface intersections per second, twice: medians of the rounds after a warm-up.

    The first figure is that of `Optic.trace`, as users call it. The second is that of its surfaces only, for rays
    that exist already and without recording their paths.
    """
    optic = oracle.system(lens)
    for surface in optic.surfaces.surfaces[1:-1]:
        surface.interaction_model.coating = None  # to time intersections and refractions only
        surface.aperture = RadialAperture(surface.aperture.r_max)
    across = int(np.ceil(np.sqrt(count)))
    over_disc = int(np.ceil(np.sqrt(count * 4 / np.pi)))  # optiland's uniform grid leaves out the pupil's corners
    half = paraxial_properties(lens).entrance_pupil_diameter_mm / 2 / np.sqrt(2)
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-half, half, across)] * 2))
    one, none = np.ones_like(x), np.zeros_like(x)

    def whole() -> int:
        return optic.trace(Hx=0, Hy=0, wavelength=D_NM / 1000, num_rays=over_disc, distribution="uniform").x.size

    def bare() -> int:
        rays = RealRays(x, y, none - half, none, none, one, one, one * D_NM / 1000)
        optic.surfaces.trace(rays, skip=1, record=False)
        return x.size

    return rate(lens, whole), rate(lens, bare)


def rate(lens: Prescription, trace: Callable[[], int]) -> float:
    """Return the ray-surface intersections per second of a call that returns the number of traced rays."""
    seconds, rays = [], 0
    for _ in range(ROUNDS + 1):
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba's warnings about itself
            rays = trace()
        seconds.append(time.perf_counter() - start)
    return rays * len(lens.surfaces) / statistics.median(seconds[1:])


def main() -> None:
    """Print the speeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lens", default="nikkor_28_f2p8")
    lens = load_lens(parser.parse_args().lens)
    print(f"{lens.name}, {len(lens.surfaces)} surfaces, millions of surfaces per second")
    for count in (100_000, 1_000_000):
        own = ours(lens, count)
        whole, bare = optilands(lens, count)
        print(
            f"{count:9,d} rays: vbnfault {own / 1e6:.0f}; optiland {whole / 1e6:.2f} by Optic.trace "
            f"({own / whole:.0f} times), {bare / 1e6:.2f} by its surfaces alone ({own / bare:.0f} times)"
        )


if __name__ == "__main__":
    main()
