"""Flip random bits of stores and cached terrain; each flip must be detected and repaired, or be harmless.

    python -m tests.tools.damage --count 2000 [--seed 0]
    python -m tests.tools.damage --operations [--count 500] [--seed 0]    make file operations fail instead

A flip is detected if `verify` reports a problem, or, in a cached patch, if the patch is built again. A flip is
harmless if a reader still gets the same data. After a detected flip the build command must restore the store
exactly. The exit code is 1 if a flip was missed or not repaired.

With `--operations`, each file operation of each command fails once with each of three errors. The seed gives the
order; `--count` limits the number of failing operations.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import errno
import functools
import io
import json
import os
import shutil
import sys
import tempfile
import threading
import time
import types
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import zarr

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from synthetic import fake_sample, make_spec

from vbnfault import store as st
from vbnfault.body import Body, choose_sites
from vbnfault.body import patch as cache
from vbnfault.body.patch import build_patch
from vbnfault.body.spec import PatchSpec
from vbnfault.core.errors import VbnfaultError
from vbnfault.core.files import whole_files
from vbnfault.core.quantities import Sample
from vbnfault.dataset import build as bd
from vbnfault.store import disk

SAMPLES = 4
COARSE = {"seed": 3, "facet_m": 20.0, "radius_m": 60.0, "min_boulder_m": 8.0, "max_triangles": 60_000}


def spec() -> st.StoreSpec:
    """Return the spec of a small store with two samples a shard."""
    return make_spec(16, layers=("depth_m",), shard_samples=2)


def sample(index: int) -> Sample:
    """Return a sample of that store; all samples belong to one site."""
    return fake_sample(spec(), index, site=0)


@dataclass(frozen=True)
class Session:
    """A session that makes the samples of the store without rendering."""

    def __call__(self) -> Session:
        return self

    def simulate(self, index: int) -> Sample:
        return sample(index)


def build(path: Path) -> None:
    """Build the store, or repair it."""
    plan = bd.BuildPlan(spec=spec(), site=np.zeros(SAMPLES, dtype=int))
    bd.build(Session(), plan, path, bd.BuildOptions(progress=False))


def mend(path: Path, samples: int = SAMPLES) -> None:
    """Repair or extend a store as the build command does, but without lock, progress and processes."""
    store = st.recover(path)
    if store.samples < samples:
        store = st.append_samples(store, samples - store.samples, {"blocks": [SAMPLES, samples - SAMPLES]})
    st.write_samples(store, [sample(i) for i in st.problem_samples(store)])


def seen(path: Path) -> dict[str, Any]:
    """Return all data that a reader gets from a store: metadata, coordinates, and the digest of the samples."""
    documents = {str(p.relative_to(path)): json.loads(p.read_bytes()) for p in sorted(path.rglob("zarr.json"))}
    spec = st.open_store(path).spec
    names = spec.coordinates(SAMPLES)
    coordinates = {name: zarr.open_array(path / name, mode="r")[:].tolist() for name in names}
    return {
        "documents": json.dumps(documents, sort_keys=True),
        "coordinates": coordinates,
        "digest": st.digest(path),
    }


@contextlib.contextmanager
def flipped(file: Path, place: int, bit: int) -> Iterator[None]:
    """Flip one bit of a file during a `with` block; undo it at the end unless the file was rewritten."""
    good = file.read_bytes()
    wrong = bytearray(good)
    wrong[place] ^= 1 << bit
    file.write_bytes(wrong)
    yield
    if file.is_file() and file.read_bytes() == wrong:
        file.write_bytes(good)


def flip_in_store(path: Path, before: dict[str, Any], rng: np.random.Generator) -> str:
    """Flip one bit of a random file of the store and return the outcome as text."""
    files = sorted(p for p in path.rglob("*") if p.is_file() and p.stat().st_size)
    size = np.array([p.stat().st_size for p in files], dtype=float)
    # in half of the cases all bytes are equally likely, otherwise all files: most files are small
    chance = size / size.sum() if rng.random() < 0.5 else np.full(len(files), 1 / len(files))
    file = files[int(rng.choice(len(files), p=chance))]
    place, bit = int(rng.integers(file.stat().st_size)), int(rng.integers(8))
    where = f"{file.relative_to(path)}: byte {place}, bit {bit}"
    with flipped(file, place, bit):
        if not st.examine(path).problems:
            return "harmless" if seen(path) == before else f"MISSED {where}"
        build(path)
        problems = st.examine(path).problems
        if problems or seen(path) != before:
            return f"NOT MENDED {where}: {problems}"
    return "found and mended"


def flip_in_cache(folder: Path, read: Callable[[], tuple[bool, bool]], rng: np.random.Generator) -> str:
    """Flip one bit of the cached patch and return the outcome as text."""
    (file,) = folder.glob("patch-*.patch")
    place, bit = int(rng.integers(file.stat().st_size)), int(rng.integers(8))
    with flipped(file, place, bit):
        same, was_built = read()
        if not same:
            return f"MISSED {file.name}: byte {place}, bit {bit}"
        if not was_built:
            return "harmless"
        if read() != (True, False):
            return f"NOT MENDED {file.name}: byte {place}, bit {bit}"
    return "found and mended"


def terrain(folder: Path) -> Callable[[], tuple[bool, bool]]:
    """Fill a cache with one patch.

    Return a function that reads the patch and returns whether it is unchanged and whether it was built again.
    """
    ball = trimesh.creation.icosphere(subdivisions=3, radius=900.0)
    body = Body(name="ball", vertices_m=np.array(ball.vertices), faces=np.array(ball.faces))
    site = choose_sites(body, 1, seed=0)[0]
    patch = build_patch(body, site, PatchSpec(**COARSE))
    key, arrays = cache.patch_key(body, site, PatchSpec(**COARSE)), cache.arrays_of(patch)
    file = folder / f"patch-{key}.patch"
    cache.PATCHES.write(file, key, arrays, 2**30)

    def read() -> tuple[bool, bool]:
        try:
            got, was_built = cache.PATCHES.read(file, key), False
        except (OSError, ValueError):
            got, was_built = arrays, True
            cache.PATCHES.write(file, key, arrays, 2**30)
        return all(np.array_equal(got[name], arrays[name]) for name in arrays), was_built

    return read


@dataclass
class Progress:
    """Count cases and failures; print them with their rate every 50 cases."""

    total: int
    ended: int = 0
    failures: int = 0
    began: float = dataclasses.field(default_factory=time.monotonic)

    def advance(self, failure: str) -> None:
        """Count one case; `failure` describes what went wrong, and is empty if nothing did."""
        self.ended += 1
        self.failures += bool(failure)
        if failure:
            print(failure, flush=True)
        if self.ended % 50 == 0:
            print(self, flush=True)

    def __str__(self) -> str:
        minutes = (time.monotonic() - self.began) / 60
        return f"{self.ended} of {self.total}, {self.ended / minutes:.0f} a minute: {self.failures} failures"


def is_failure(outcome: str) -> bool:
    """Return whether a flip was missed or not repaired."""
    return outcome.startswith(("MISSED", "NOT MENDED"))


def damage(
    count: int, seed: int, folder: Path, ended: Callable[[str], None] = lambda failure: None
) -> Counter[str]:
    """Flip `count` bits, nine of ten in a store, the others in a cached patch; return how often each outcome
    occurs.

    `ended` is called after each flip with a description of the failure, or "".
    """
    rng = np.random.default_rng(seed)
    path, caches = folder / "s.zarr", folder / "cache"
    caches.mkdir()
    outcomes: Counter[str] = Counter()
    with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore", UserWarning)  # the warning that the root was read from `spare`
        build(path)
        before = seen(path)
        read = terrain(caches)
        for k in range(count):
            outcome = flip_in_cache(caches, read, rng) if k % 10 == 9 else flip_in_store(path, before, rng)
            outcomes[outcome] += 1
            ended(outcome if is_failure(outcome) else "")
    return outcomes


# --- a disk whose n-th operation fails --------------------------------------------------------------------


class FailingSystem(types.ModuleType):
    """Replaces the module `os` in `store.disk`: operation number `fails_at` raises OSError with `code`.

    With `short`, no operation has to fail, but each `write` writes only half of its data.
    """

    OPERATIONS = (
        "open",
        "close",
        "read",
        "write",
        "fsync",
        "replace",
        "mkdir",
        "unlink",
        "rmdir",
        "scandir",
        "stat",
        "lstat",
        "fstat",
        "listdir",
    )

    def __init__(self, fails_at: int = -1, code: int = errno.EIO, short: bool = False) -> None:
        super().__init__("os")
        self.fails_at, self.code, self.short = fails_at, code, short
        self.count = 0
        self.failed = ""
        self._lock = threading.Lock()  # flushes run in threads

    def __getattr__(self, name: str) -> Any:
        real = getattr(os, name)
        if name not in self.OPERATIONS:
            return real

        def operation(*arguments: Any, **options: Any) -> Any:
            with self._lock:
                number, self.count = self.count, self.count + 1
            if self.short and name == "write":
                return real(arguments[0], arguments[1][: max(1, len(arguments[1]) // 2)])
            if number != self.fails_at:
                result = real(*arguments, **options)
                self.noted(name, arguments, result)
                return result
            self.failed = name
            if name == "close":
                real(*arguments)
            if name == "write":  # a failing write may have written a part
                real(arguments[0], arguments[1][: len(arguments[1]) // 2])
            raise OSError(self.code, os.strerror(self.code))

        return operation

    def noted(self, name: str, arguments: tuple[Any, ...], result: Any) -> None:
        """Handle an operation that succeeded; for subclasses."""


def create(path: Path) -> None:
    """Create the store."""
    st.create(path, spec(), SAMPLES)


def write(path: Path) -> None:
    """Write one sample of a shard whose other sample is finished and must be kept."""
    st.write_samples(path, [sample(2)])


def append(path: Path) -> None:
    """Append one sample."""
    st.append_samples(path, 1, {"blocks": [SAMPLES, 1]})


def recover(path: Path) -> None:
    """Recover the store."""
    st.recover(path)


def damaged(path: Path) -> None:
    """Damage a store so that `recover` has something to repair."""
    (path / "zarr.json").write_bytes(b"{")
    (path / "x" / "c" / "0").unlink()
    (path / "image" / "zarr.json").unlink()
    (path / "done" / "c" / f"0.1{disk.PARTIAL}").write_bytes(b"x")


COMMANDS = (create, write, append, recover)


@functools.cache
def _finished() -> tempfile.TemporaryDirectory[str]:
    """Return a folder with a finished store, which is made only once."""
    folder = tempfile.TemporaryDirectory(prefix="vbnfault-damage-")
    create(Path(folder.name, "s.zarr"))
    mend(Path(folder.name, "s.zarr"))
    return folder


def _prepare(command: Callable[[Path], None], folder: Path) -> Path:
    """Make the input of a command: a path without a store for `create`, otherwise a finished store."""
    folder.mkdir()
    path = folder / "s.zarr"
    if command is not create:
        shutil.copytree(Path(_finished().name, "s.zarr"), path)
    if command is recover:
        damaged(path)
    return path


def _with(system: FailingSystem, command: Callable[[Path], None], path: Path) -> None:
    """Run a command while `system` replaces `os` in what writes the files of stores."""
    with pytest.MonkeyPatch.context() as patch:
        replace_system(patch, system)
        command(path)


def replace_system(patch: pytest.MonkeyPatch, system: FailingSystem) -> None:
    """Have what writes the files of stores use a `FailingSystem`."""
    for module in (disk, whole_files):
        patch.setattr(module, "os", system)


def operations(command: Callable[[Path], None], folder: Path) -> int:
    """Return how many file operations a command does."""
    path, system = _prepare(command, folder), FailingSystem()
    _with(system, command, path)
    return system.count


def fails_at(number: int, code: int, command: Callable[[Path], None], folder: Path) -> str:
    """Make one operation of a command fail, then repair the store.

    Return what is wrong after that; empty if nothing is.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        path, system = _prepare(command, folder), FailingSystem(number, code)
        with contextlib.suppress(VbnfaultError):
            _with(system, command, path)
        lost = set()
        if command is not create:
            st.open_store(path)
            lost = set(st.problem_samples(path)) if command is write else set()
        if not path.exists():
            create(path)
        samples = SAMPLES + (command is append)
        mend(path, samples)
        wrong = [f"also lost: {sorted(lost - {2})}"] if lost - {2} else []
        wrong += st.examine(path).problems
        for i in range(samples):
            layers = st.open_store(path).read_sample(i).layers
            if any(layers[name].tobytes() != array.tobytes() for name, array in sample(i).layers.items()):
                wrong.append(f"sample {i} is another")
        wrong += [f"left over: {p}" for p in folder.rglob(f"*{disk.PARTIAL}")]
    return f"{command.__name__}, {system.failed} {number}: {'; '.join(wrong)}" if wrong else ""


def failing_operations(count: int | None, seed: int) -> Progress:
    """Make operations of each command fail, with each of three errors; return the counts.

    Parameters
    ----------
    count
        How many cases (command, operation, error) are drawn, without repetition; all if None.
    seed
        Seed of the order.
    """
    cases: list[tuple[Callable[[Path], None], int, int]] = []
    with tempfile.TemporaryDirectory(prefix="vbnfault-damage-") as above:
        for command in COMMANDS:
            numbers = operations(command, Path(above, command.__name__))
            print(f"{command.__name__}: {numbers} operations")
            cases += [
                (command, k, code) for k in range(numbers) for code in (errno.EIO, errno.ENOSPC, errno.EACCES)
            ]
    order = np.random.default_rng(seed).permutation(len(cases))[:count].tolist()
    progress = Progress(len(order))
    for k in order:
        command, number, code = cases[k]
        with tempfile.TemporaryDirectory(prefix="vbnfault-damage-") as above:
            wrong = fails_at(number, code, command, Path(above, "s"))
        progress.advance(f"{errno.errorcode[code]}: {wrong}" if wrong else "")
    print(f"operations that failed, of {len(cases)}, seed {seed}: {progress}")
    return progress


def main() -> int:
    """Flip bits, or make operations fail; the exit code is 1 if there was a failure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, help="flips [default: 2000], or operations that fail [default: all]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--operations", action="store_true", help="let operations of the disk fail instead")
    arguments = parser.parse_args()
    if arguments.operations:
        return int(failing_operations(arguments.count, arguments.seed).failures > 0)
    progress = Progress(2000 if arguments.count is None else arguments.count)
    with tempfile.TemporaryDirectory(prefix="vbnfault-damage-") as folder:
        outcomes = damage(progress.total, arguments.seed, Path(folder), progress.advance)
    counts = ", ".join(f"{many} {outcome}" for outcome, many in outcomes.most_common())
    print(f"flips, seed {arguments.seed}: {progress}; {counts}")
    return int(progress.failures > 0)


if __name__ == "__main__":
    sys.exit(main())
