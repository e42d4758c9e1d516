"""Compare the CPU time of two checkouts, stage by stage.

    git worktree add --detach ../before COMMIT
    python benchmarks/cpu_pair.py ../before
    python benchmarks/cpu_pair.py ../before --scene physical67p --sample 1 --size 256

Each checkout runs in its own process, which uses its own `workload.py` and `profile_sample.py`. The two processes
take turns, one round each, so that other load on the machine affects both equally. The table holds the medians of
the CPU time of all threads in ms, which depends on other load far less than the duration does. Every library uses
one thread, so no thread spins while it waits. With --durations the table holds the least duration instead, and the
libraries use every core; this shows work that no longer runs on two cores at once.

Without --scene the work is that of `test_speed.py`. With --scene it is one sample of a packaged scene. With
--renders-once the first round's renders serve all later rounds, which makes many rounds of the other stages cheap.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def cpu_clock(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return the CPU time of a call in s, of all threads, and its result."""
    from vbnfault.render.runtime import dr

    dr.sync_thread()
    start = time.process_time()
    result = function()
    dr.sync_thread()
    return time.process_time() - start, result


def render_once() -> Callable[[], None]:
    """Let every render of a later round return the result of the same call of the first round.

    Return a function that begins a round.
    """
    from vbnfault import render

    results: list[Any] = []
    calls = 0

    def kept(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*inputs: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls > len(results):
                results.append(function(*inputs, **options))
            return results[calls - 1]

        return call

    for name in ("radiance", "truth", "direct", "indirect"):
        setattr(render, name, kept(getattr(render, name)))

    def begin() -> None:
        nonlocal calls
        calls = 0

    return begin


def make_round(options: argparse.Namespace, folder: Path) -> Callable[[], Mapping[str, float]]:
    """Return the function that runs one round of the work and returns the CPU time of each stage in s."""
    import profile_sample
    import workload

    from vbnfault import pipeline
    from vbnfault.scene import config

    clock = workload.clock if options.durations else cpu_clock
    workload.clock = profile_sample.clock = clock
    if not options.scene:
        work = workload.Workload.load(options.size, facet_m=options.facet_m)
        store = work.empty_store(folder / "store.zarr")
        return lambda: {
            "bound": 0.0 if options.renders_once else clock(work.bound)[0],
            **work.labelled_sample(store)[0],
        }
    overrides = {"camera.width_px": options.size, "camera.height_px": options.size}
    if options.facet_m is not None:
        overrides |= {"patch.facet_m": options.facet_m, "patch.min_boulder_m": 4 * options.facet_m}
    spec = pipeline.Session(config.load_scene(options.scene, overrides)).spec(options.sample)
    return lambda: profile_sample.stages(spec)


def work(options: argparse.Namespace) -> None:
    """Run one round for every line of standard input, and print its CPU times as a line of JSON."""
    import cv2

    from vbnfault import render

    if not options.durations:
        cv2.setNumThreads(1)
        render.set_threads(1)
    begin = render_once() if options.renders_once else lambda: None
    with tempfile.TemporaryDirectory() as folder:
        one_round = make_round(options, Path(folder))
        for _ in sys.stdin:
            begin()
            print(json.dumps(one_round()), flush=True)


def start(checkout: Path, threads: int | None) -> subprocess.Popen[str]:
    """Start the process that does the work of one checkout; `threads` limits the threads of its libraries."""
    paths = [str(checkout / "benchmarks"), str(checkout)]
    # the folder of this script must not come before the benchmarks of the other checkout
    code = f"import runpy, sys; sys.path[:0] = {paths!r}; runpy.run_path({__file__!r}, run_name='__main__')"
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "BLOSC_NTHREADS")
    limits = {} if threads is None else dict.fromkeys(names, str(threads))
    return subprocess.Popen(
        [sys.executable, "-P", "-c", code, *sys.argv[1:], "--work"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **limits, "PYTHONPATH": os.pathsep.join(paths)},
    )


def next_round(process: subprocess.Popen[str]) -> dict[str, float]:
    """Let a process run one round and return its CPU times in s."""
    assert process.stdin is not None
    assert process.stdout is not None
    print(file=process.stdin, flush=True)
    line = process.stdout.readline()
    if not line:
        raise SystemExit(f"a worker ended with exit code {process.wait()}")
    return json.loads(line)


def table(before: list[dict[str, float]], now: list[dict[str, float]], *, durations: bool) -> str:
    """Return the CPU times or the durations of both checkouts in ms, as a text table.

    CPU times are medians; their change is the median over the rounds, with its standard error. Durations are
    minima, since other load only adds to them.
    """
    import numpy as np

    what = "ms, least of the rounds" if durations else "ms of CPU, medians"
    lines = [f"{'':<28}{'before':>9}{'now':>9}{'change':>9}{'error':>7}   {what}"]

    def row(title: str, names: list[str]) -> None:
        a, b = (np.array([sum(r.get(n, 0.0) for n in names) for r in rounds]) * 1e3 for rounds in (before, now))
        if durations:
            lines.append(f"{title:<28}{a.min():9.1f}{b.min():9.1f}{b.min() - a.min():+9.1f}")
            return
        # 1.25 σ/√n is the standard error of a median; 1.48 × the median deviation stands for σ
        spread = 1.48 * np.median(np.abs((b - a) - np.median(b - a)))
        error = 1.25 * spread / np.sqrt(len(a))
        lines.append(f"{title:<28}{np.median(a):9.1f}{np.median(b):9.1f}{np.median(b - a):+9.1f}{error:7.1f}")

    for name in now[0]:
        if name in before[0]:
            row(name, [name])
    if added := [name for name in now[0] if name not in before[0]]:
        row(f"new: {' + '.join(added)}", added)
    return "\n".join(lines)


def main() -> None:
    """Run both checkouts in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="folder of the other checkout")
    parser.add_argument("--scene", help="a packaged scene [default: the work of test_speed.py]")
    parser.add_argument("--sample", type=int, default=0)
    parser.add_argument("--size", type=int, default=1024, help="pixels along either side of the frame")
    parser.add_argument("--facet-m", type=float, help="coarser terrain")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--renders-once", action="store_true")
    parser.add_argument("--durations", action="store_true", help="the least durations instead of CPU times")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options)
        return
    here = Path(__file__).resolve().parent.parent
    processes = [start(checkout.resolve(), None if options.durations else 1) for checkout in (options.before, here)]
    rounds: tuple[list[dict[str, float]], ...] = ([], [])
    for k in range(1 + options.rounds):
        turns = list(zip(processes, rounds, strict=True))
        for process, taken in turns if k % 2 else turns[::-1]:
            taken.append(next_round(process))
    for process in processes:
        process.communicate()
    print(
        table(*(taken[1:] for taken in rounds), durations=options.durations)
    )  # the first round compiles and warms up


if __name__ == "__main__":
    main()
