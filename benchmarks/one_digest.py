"""Build one dataset in many ways and compare the digests; kill commands, resume them, compare again.

    python benchmarks/one_digest.py --samples 64 --count 200

The ways: one process, two workers, two commands with ranges of shards in one store, two stores that are merged, a
bucket of S3 on this machine and, with `--dask`, a Dask cluster of which a worker dies. The samples are made up
(`tests/synthetic.py`), so that the events of files and requests count, not the renderer.

Each kill is a SIGKILL at an event drawn with `--seed`: the n-th operation on files, or the n-th request that writes
to the bucket. Every command runs in a process of its own. A round passes if the resumed command has the digest of
an undisturbed build. The exit code is 1 if a digest differs.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from s3_server import BUCKET, S3Server

TESTS = Path(__file__).resolve().parent.parent / "tests"

PROGRAM = """
import sys
import synthetic, victim
from vbnfault import store
from vbnfault.dataset.merge import join_stores

kind, out, samples, count, *rest = sys.argv[1:]
if int(count):
    victim.follow([victim.step("write", count=int(count), torn=True)])
if kind == "merge":
    join_stores(rest, out, move=True, progress=False)
else:
    part = range(*map(int, rest[1:])) if len(rest) > 1 else None
    synthetic.run(out, samples=int(samples), workers=int(rest[0]), shard_range=part)
opened = store.open_store(out)
print(store.digest(opened) if opened.finished() == opened.samples else "")
"""


class Commands:
    """Starts commands, each in a process of its own, and counts those that were killed."""

    def __init__(self, folder: Path, samples: int, server: S3Server) -> None:
        self.folder, self.samples, self.server = folder, samples, server
        self.kills: Counter[str] = Counter()
        path = os.pathsep.join([str(TESTS.parent), str(TESTS)])
        self._environment = {**os.environ, **server.environment, "PYTHONPATH": path}

    def start(self, kind: str, out: object, *rest: object, count: int = 0) -> subprocess.Popen[str]:
        words = map(str, (kind, out, self.samples, count, *rest))
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *words],
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, kind: str, out: object, *rest: object, count: int = 0, request: int = 0) -> str:
        """Run a command and return its digest; kill it at a file operation or a request, if one is given."""
        process = self.start(kind, out, *rest, count=count)
        seen = [0]

        def before(method: str, path: str) -> None:
            seen[0] += method in ("PUT", "POST", "DELETE")
            if seen[0] == request:
                process.kill()

        self.server.before = before if request else lambda method, path: None
        text, said = process.communicate(timeout=600)
        self.server.before = lambda method, path: None
        if process.returncode == -signal.SIGKILL:
            self.kills[kind if "://" not in str(out) else f"{kind} in a bucket"] += 1
            return ""
        if process.returncode:
            raise AssertionError(f"{kind} {out} {rest} ended with {process.returncode}: {said}")
        return text.strip()


def ways(commands: Commands, with_dask: bool) -> dict[str, str]:
    """Return the digest of each way by its name."""
    folder, shards = commands.folder, -(-commands.samples // 4)
    half = shards // 2
    digests = {
        "one process": commands.run("build", folder / "one.zarr", 1),
        "two workers": commands.run("build", folder / "two.zarr", 2),
        "a bucket of S3": commands.run("build", f"s3://{BUCKET}/whole.zarr", 1),
    }
    parts = [(0, half), (half, shards)]
    running = [commands.start("build", folder / "shared.zarr", 1, *part) for part in parts]
    for process in running:
        _, said = process.communicate(timeout=600)
        assert process.returncode == 0, said
    digests["two commands in one store"] = commands.run("build", folder / "shared.zarr", 1)
    running = [commands.start("build", folder / f"p{k}.zarr", 1, *part) for k, part in enumerate(parts)]
    for process in running:
        process.communicate(timeout=600)
    stores = [folder / f"p{k}.zarr" for k in range(2)]
    digests["two stores, merged"] = commands.run("merge", folder / "merged.zarr", *stores)
    if with_dask:
        digests["Dask, a worker killed"] = on_dask(commands)
    return digests


def on_dask(commands: Commands) -> str:
    """Build on a Dask cluster of two processes, one of which dies at a sample, and return the digest."""
    import synthetic
    from distributed import LocalCluster

    from vbnfault import store

    out, once = commands.folder / "dask.zarr", commands.folder / "died"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        session = synthetic.Session(dies=frozenset({commands.samples // 2}), dies_once=str(once))
        synthetic.run(out, session, samples=commands.samples, scheduler=cluster.scheduler_address)
    assert once.exists()
    return store.digest(out)


def disturbed(commands: Commands, round_: int, dice: np.random.Generator) -> str:
    """Kill a command, resume it, and return the digest; the rounds go through the kinds of commands."""
    folder, shards = commands.folder, -(-commands.samples // 4)
    kind, half = ("build", "range", "merge", "bucket")[round_ % 4], shards // 2
    out: object = folder / f"r{round_}.zarr"
    if kind == "bucket":
        out = f"s3://{BUCKET}/r{round_}.zarr"
        commands.run("build", out, 1, request=int(dice.integers(1, 100 + 60 * shards)))
        return commands.run("build", out, 1)
    if kind == "merge":
        stores = [folder / f"r{round_}-{k}.zarr" for k in range(2)]
        for store, part in zip(stores, ((0, half), (half, shards)), strict=True):
            commands.run("build", store, 1, *part)
        commands.run("merge", out, *stores, count=int(dice.integers(1, 400 * shards)))
        return commands.run("merge", out, *stores)
    part = (0, half) if kind == "range" else ()
    commands.run("build", out, 1, *part, count=int(dice.integers(1, 250 * (half if part else shards))))
    if part:
        commands.run("build", out, 1, *part)
    return commands.run("build", out, 1)


def main() -> int:
    """Run the ways and the rounds."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--samples", type=int, default=64)
    options.add_argument("--count", type=int, default=0, help="kills in all")
    options.add_argument("--kill-samples", type=int, default=18, help="samples of the builds that are killed")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--dask", action="store_true")
    given = options.parse_args()
    server, failures = S3Server(), 0
    with tempfile.TemporaryDirectory(prefix="one-digest-") as folder:
        digests = ways(Commands(Path(folder), given.samples, server), given.dask)
        for name, digest in digests.items():
            print(f"{name:<28}{digest}", flush=True)
        failures += len(set(digests.values())) != 1
    with tempfile.TemporaryDirectory(prefix="one-digest-") as folder:
        commands = Commands(Path(folder), given.kill_samples, server)
        wanted = commands.run("build", Path(folder) / "whole.zarr", 1)
        for round_ in range(100 * given.count):
            if commands.kills.total() >= given.count:
                break
            digest = disturbed(commands, round_, np.random.default_rng([given.seed, round_]))
            if digest != wanted:
                failures += 1
                print(f"FAILED round {round_}: {digest}", flush=True)
        print(f"{commands.kills.total()} kills {dict(commands.kills)}, {failures} failures", flush=True)
    server.close()
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
