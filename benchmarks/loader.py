"""Compare the rate of `vbnfault.torch` with naive reading of the same store, and with a folder of PNG files.

    vbnfault build paper67p --out paper67p.zarr --samples 32
    python benchmarks/loader.py paper67p.zarr

It needs PyTorch. Every arm reads image and masks of all samples in shuffled order, in batches, for some epochs,
with the files in the system's cache. The arms take turns, round by round. The table gives for each arm the median
of wall time and of processor time (of all processes) a sample, and how many times as long that is as for
`vbnfault.torch`. A line says how much of the machine's processor time other programs took meanwhile: wall times
count only where that is little. Before that, the arrays of all arms but PNG are compared: they are equal.

- `naive xarray`: what its documentation suggests, in this process: `data = xarray.open_zarr(store)`, and for each
  sample `data.image[i].values` and `data.mask[i].values`. Where Dask is installed, `open_zarr` makes Dask arrays.
- `naive xarray without Dask`: the same with `chunks=None`, which is what `open_zarr` does where Dask is missing.
- `naive xarray, mask by mask`: the first, but with `data.mask[i].sel(fault=name).values` for each fault class.
- `xarray, workers`: the second in a `DataLoader`.
- `PNG, workers`: what `vbnfault export --format png` wrote (R, G, B without I), read with OpenCV, in a
  `DataLoader`.
- `vbnfault.torch`: `Loader`, with workers, and with threads instead.

Then it measures how long a spawned worker takes from its start to its first sample, without the import of PyTorch.
"""

from __future__ import annotations

import argparse
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import xarray
from torch.utils.data import DataLoader
from turns import of_machine_s, processor_s

import vbnfault
from vbnfault.torch import BatchDataset, Loader, SampleDataset


class Naive:
    """Read samples with xarray, one by one; `by_mask`: each fault class by itself."""

    def __init__(self, path: str, *, dask: bool = True, by_mask: bool = False) -> None:
        self.path, self.by_mask, self.data = path, by_mask, None
        self.options: dict[str, Any] = {} if dask else {"chunks": None}
        with xarray.open_zarr(path) as data:
            self.samples = data.sizes["sample"]

    def __len__(self) -> int:
        return self.samples

    def __getitem__(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        if self.data is None:
            self.data = xarray.open_zarr(self.path, **self.options)
        data = self.data
        if not self.by_mask:
            return data.image[i].values, data.mask[i].values
        masks = [data.mask[i].sel(fault=name).values for name in data.fault.values]
        return data.image[i].values, np.stack(masks)


class Folder:
    """Read samples from the PNG files of an export."""

    def __init__(self, path: Path, faults: int) -> None:
        self.images = sorted(path.glob("*/image/*.png"))
        self.masks = [sorted(image.parents[1].glob(f"mask/*/{image.name}")) for image in self.images]
        self.faults = faults
        assert self.images

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        image = cv2.imread(str(self.images[i]), cv2.IMREAD_UNCHANGED)
        masks = np.zeros((self.faults, *image.shape[:2]), dtype=bool)
        for k, mask in enumerate(self.masks[i]):
            masks[k] = cv2.imread(str(mask), cv2.IMREAD_UNCHANGED) > 0
        return image, masks


def one_by_one(data: Naive) -> Iterator[Any]:
    """Yield all samples in a shuffled order."""
    for i in np.random.default_rng(0).permutation(len(data)).tolist():
        yield data[i]


def compare(ours: SampleDataset, naive: Naive) -> None:
    """Check that some samples are the same in both."""
    for i in range(0, len(ours), max(1, len(ours) // 5)):
        image, masks = naive[i]
        sample = ours[i]
        assert np.array_equal(np.moveaxis(sample["image"].numpy(), 0, -1), image)
        assert np.array_equal(sample["masks"].numpy(), masks)


def timed(epoch: Callable[[], Any], epochs: int, samples: int) -> tuple[float, float]:
    """Return wall and processor time a sample of some epochs, in ms."""
    wall, processor = time.perf_counter(), processor_s()
    for _ in range(epochs):
        for batch in epoch():
            del batch
    scale = 1e3 / (epochs * samples)
    return (time.perf_counter() - wall) * scale, (processor_s() - processor) * scale


def start_of_a_worker(path: str) -> tuple[float, float]:
    """Return how long a new process needs to import PyTorch, and then to read a first sample, in s."""
    code = """
import pickle, sys, time
begin = time.perf_counter()
import torch, torch.utils.data
imported = time.perf_counter()
data = pickle.loads(sys.stdin.buffer.read())
data[0]
print(imported - begin, time.perf_counter() - imported)
"""
    given = pickle.dumps(SampleDataset(path, targets=["masks"]))
    times = []
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", code], input=given, capture_output=True, check=True)
        times.append([float(word) for word in done.stdout.split()])
    return min(t[0] for t in times), min(t[1] for t in times)


def arms(path: str, folder: Path, options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """Return by name the functions that begin an epoch."""
    with vbnfault.open_dataset(path) as data:
        faults = data.sizes["fault"]
    vbnfault.export(path, folder, "png", progress=False)
    how: dict[str, Any] = {"num_workers": options.workers, "multiprocessing_context": options.start}

    def plain(data: Any) -> Any:
        return DataLoader(data, batch_size=options.batch, shuffle=True, persistent_workers=True, **how)

    ours = SampleDataset(path, targets=["masks"])
    batches = [BatchDataset(ours, batch_size=options.batch) for _ in range(2)]
    loaders = {
        "vbnfault.torch, workers": Loader(batches[0], **how),
        "vbnfault.torch, threads": Loader(batches[1]),
        "xarray, workers": plain(Naive(path, dask=False)),
        "PNG, workers": plain(Folder(folder, faults)),
    }
    naive = {
        "naive xarray": Naive(path),
        "naive xarray without Dask": Naive(path, dask=False),
        "naive xarray, mask by mask": Naive(path, by_mask=True),
    }
    for data in naive.values():
        compare(ours, data)
    return {
        **{name: (lambda data=data: one_by_one(data)) for name, data in naive.items()},
        **{name: (lambda loader=loader: iter(loader)) for name, loader in loaders.items()},
    }


def main() -> None:
    """Measure all arms in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", help="a finished store")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--start", choices=["fork", "spawn"], default="fork", help="how workers are started")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--epochs", type=int, default=4, help="epochs of each arm in a round")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        begin = arms(options.store, Path(folder) / "png", options)
        samples = len(Naive(options.store))
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in begin}
        own_before, before = processor_s(), of_machine_s()
        for k in range(options.rounds + 1):  # the first round starts the workers and fills the cache
            for name, epoch in begin.items():
                times = timed(epoch, options.epochs, samples)
                if k:
                    taken[name].append(times)
        (busy, whole), own_s = np.subtract(of_machine_s(), before), processor_s() - own_before
    median = {name: [statistics.median(t[c] for t in times) for c in (0, 1)] for name, times in taken.items()}
    own = median["vbnfault.torch, workers"]
    print(
        f"{options.workers} workers ({options.start}), batches of {options.batch}, {samples} samples: ms a sample"
    )
    print(f"{'':<30}{'wall':>8}{'ratio':>8}{'CPU':>8}{'ratio':>8}")
    for name, (wall, processor) in median.items():
        print(f"{name:<30}{wall:8.1f}{wall / own[0]:8.2f}{processor:8.1f}{processor / own[1]:8.2f}")
    print(f"other programs took {max(0.0, busy - own_s) / whole:.0%} of the machine's processor time")
    imported, started = start_of_a_worker(options.store)
    print(
        f"a spawned worker: {started:.2f} s to its first sample, after {imported:.2f} s for the import of PyTorch"
    )


if __name__ == "__main__":
    main()
