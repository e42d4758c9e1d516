"""Measure how long a patch of terrain takes to build, to read from the cache and to load, and its memory.

python benchmarks/terrain_timing.py [--shape FILE] [--sites N]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from vbnfault import render
from vbnfault.body import EMBEDDED, PatchSpec, choose_sites, load_body
from vbnfault.body.patch import cached_patch
from vbnfault.core.files.array_files import FOLDER_VARIABLE


def peak_gib() -> float:
    """Return the largest resident set of this process so far, in GiB."""
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / 2**30
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def main() -> None:
    """Print durations and memory for each site."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shape", default=EMBEDDED)
    parser.add_argument("--sites", type=int, default=3)
    arguments = parser.parse_args()
    body = load_body(arguments.shape)
    with tempfile.TemporaryDirectory() as folder:
        os.environ[FOLDER_VARIABLE] = folder
        for site in choose_sites(body, arguments.sites, 7):
            times = [time.perf_counter()]
            cached_patch(body, site, PatchSpec(seed=7))
            times.append(time.perf_counter())
            patch = cached_patch(body, site, PatchSpec(seed=7))
            times.append(time.perf_counter())
            surface = render.TerrainMesh(patch.vertices_L_m, patch.faces, patch.face_is_flat, patch.dust)
            render.ground_height_m(surface, np.zeros(1), np.zeros(1), 400.0)
            times.append(time.perf_counter())
            built, read, surfaced = np.diff(times)
            size = sum(path.stat().st_size for path in Path(folder).iterdir()) / 2**20 / (site.index + 1)
            print(
                f"site {site.index}: built {built:.1f} s, read {read:.2f} s ({size:.0f} MiB), "
                f"surface {surfaced:.2f} s, {patch.triangles} triangles, peak {peak_gib():.2f} GiB"
            )


if __name__ == "__main__":
    main()
