"""Measure `vbnfault view` in a headless Chromium on a made-up store of many samples.

    python benchmarks/view.py --samples 100000 --pixels 1024 --folder DIR

The files of a few shards are linked under the names of all others, so the store takes little space and every sample
has its pixels. Printed: time from the start of the command to the listing and to the first image, time to open a
sample at full size, time of a mask toggle until the next frame, and whether a jump to the last sample shows it.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from browser import WHY_NOT, Page, found, opened
from synthetic import fake_sample, make_spec

from vbnfault import store as st

LAYERS = ("mask_effect", "depth_m", "normal", "semantic", "raw")


def make_store(path: Path, samples: int, size_px: int, made: int) -> st.Store:
    """Return a store of `samples` samples, of which `made` shards are made and linked under the other names."""
    spec = make_spec(size=size_px, shard_samples=16, layers=LAYERS)
    store = st.create(path, spec, samples)
    made = min(made, store.shards)
    for number in range(made):
        st.write_samples(store, [fake_sample(spec, i) for i in store.shard(number)])
    for name in spec.arrays:
        for number in range(made, store.shards):
            file = store.file(name, number)
            file.parent.mkdir(parents=True, exist_ok=True)
            os.link(store.file(name, number % made), file)
    return store


def mark(page: Page, name: str) -> float:
    """Return when the page reached a mark, in ms since 1970."""
    return float(page.evaluate(f"performance.timeOrigin + performance.getEntriesByName('{name}')[0].startTime"))


def measure(store: Path, samples: int) -> None:
    """Print the times of the page for a store."""
    begun = time.time()
    command = [sys.executable, "-m", "vbnfault", "view", str(store), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, opened() as page:
        try:
            assert server.stdout is not None
            url = server.stdout.readline().split()[0]
            ready = time.time()
            page.look(1366, 768)
            asked = time.time()
            page.goto(url)
            page.wait("performance.getEntriesByName('first-image').length")
            page.wait("performance.getEntriesByName('listing').length")
            print(f"server ready after      {ready - begun:7.2f} s of the command's start")
            print(
                f"first image after       {mark(page, 'first-image') / 1000 - asked:7.2f} s of the page's request"
            )
            print(f"whole listing after     {mark(page, 'listing') / 1000 - asked:7.2f} s of the page's request")
            page.press("End")
            page.wait(f"document.querySelector('.tile[data-index=\"{samples - 1}\"] img')?.complete")
            pressed = time.time()
            page.press("Enter")
            page.wait("performance.getEntriesByName('sample').length")
            print(f"sample at full size     {mark(page, 'sample') / 1000 - pressed:7.2f} s after Enter")
            times = []
            for _ in range(20):
                page.evaluate("window.vbnfault.toggled = null")
                page.press("1")
                page.wait("window.vbnfault.toggled !== null")
                times.append(page.evaluate("window.vbnfault.toggled"))
            print(f"mask toggle             {statistics.median(times):7.1f} ms median, {max(times):.1f} ms largest")
            page.press("Escape")
            filtered = "(() => { const t = performance.now(); document.querySelector('#classes .filter').click(); "
            print(
                f"filter by class         {page.evaluate(filtered + 'return performance.now() - t; })()'):7.1f} ms"
            )
            print("layers read by", page.evaluate("JSON.stringify(window.vbnfault.sources)"), page.errors or "")
        finally:
            server.terminate()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--pixels", type=int, default=1024, help="height of the images; they are 8 px wider")
    parser.add_argument(
        "--made", type=int, default=2, help="shards of 16 samples that are made; the rest are links"
    )
    parser.add_argument("--folder", type=Path, help="folder for the store, which is kept; default: a temporary one")
    given = parser.parse_args()
    if found() is None:
        sys.exit(WHY_NOT)
    with tempfile.TemporaryDirectory() as temporary:
        path = (given.folder or Path(temporary)) / f"view_{given.samples}_{given.pixels}.zarr"
        if not path.exists():
            make_store(path, given.samples, given.pixels, given.made)
        measure(path, given.samples)


if __name__ == "__main__":
    main()
