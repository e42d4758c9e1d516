"""Run the program on many malformed inputs: `python -m tests.tools.fuzz --count 5000 --seed 7`.

Each case damages a valid input: a scene, study, lens or sensor file, a mesh of any format, a spacecraft, a texture,
a SPICE kernel or DSK, options and environment variables, or a store; or it makes the store of a stranger. The
program then runs as from the command line. It may succeed or refuse the input: exit code 0, 1 or 2, with a short
message if it is not 0. A case fails if it ends with a traceback or a signal, or uses more than 20 s of processor
time or 2 GiB of memory, and the store of a stranger also if anything outside the output is touched. A failure is
printed with the command that repeats it (`--only N`). `--kinds study lens` runs cases of these kinds only.

A few processes run all cases, so that the imports are paid once; a process that dies is replaced. A case depends
only on the seed and its number. The default seed is a hash of the package's sources.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import math
import os
import random
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools import fuzz_stores
from tools.fuzz_cases import CASES, dry, whole_scene
from tools.fuzz_inputs import ROOT, Seeds, toml

CPU_S = 60
MEMORY_BYTES = 2 << 30
# Limit for a case that waits without using the processor, for example for a pipe. It is far longer than any wait
# on a busy machine.
BLOCKED_S = 600
LONGEST_MESSAGE = 3000
KINDS = len(CASES)


# --- one case -------------------------------------------------------------------------------------------------


def run(arguments: list[str]) -> tuple[int, str, str]:
    """Run the program in this process.

    Return its exit code (-1 for a traceback), its standard error and its standard output.
    """
    from vbnfault import cli
    from vbnfault.core.errors import VbnfaultError

    output, errors = io.StringIO(), io.StringIO()
    before = sys.argv
    sys.argv = ["vbnfault", *arguments]
    action = {"read": fuzz_stores.read, "view": fuzz_stores.look}.get(arguments[0] if arguments else "")
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                action(arguments[1]) if action else cli.main()
                code = 0
            except VbnfaultError as error:
                print(error, file=sys.stderr)
                code = error.exit_code if action else -1
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) else 0
            except BaseException:
                traceback.print_exc()
                code = -1
    finally:
        sys.argv = before
    return code, errors.getvalue(), output.getvalue()


def build_store(seeds: Seeds) -> None:
    """Build the store that `case_store` damages; it has two small samples."""
    path = seeds.folder / "seed.toml"
    path.write_bytes(toml({**seeds.scene, "dataset": {**seeds.scene["dataset"], "samples": 2, "sites": 1}}))
    done = run(["build", str(path), "--out", str(seeds.store)])
    if done[0] != 0:
        raise SystemExit(f"the store to be damaged cannot be built: {done[1]}")


def attempt(seeds: Seeds, seed: str, number: int, keep: Path | None = None) -> dict[str, Any]:
    """Run case `number` and return its result; its files are kept in the folder `keep`, if given."""
    rng = random.Random(f"{seed}/{number}")
    kind = rng.choices(list(CASES), [weight for _, weight in CASES.values()])[0]
    here = Path(tempfile.mkdtemp(dir=seeds.folder)) if keep is None else keep
    cpu_before = sum(os.times()[:4])
    arguments, variables = CASES[kind][0](seeds, rng, here)
    untouched = fuzz_stores.state(here, arguments) if kind == "stranger" else {}
    before = dict(os.environ)
    os.environ.update(variables)
    folder = os.getcwd()
    os.chdir(here)  # commands may write to the working folder
    outside = ""
    try:
        code, errors, _ = run(arguments)
        if kind == "stranger":
            outside = fuzz_stores.escaped(here, arguments)
            if fuzz_stores.state(here, arguments) != untouched:
                outside = "files outside the output have changed"
    finally:
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(before)
        if keep is None:
            shutil.rmtree(here, ignore_errors=True)
    problem = ""
    if code not in (0, 1, 2) or "Traceback" in errors:
        problem = f"exit code {code}"
    elif code and not errors.strip():
        problem = f"exit code {code} without a word"
    elif kind != "options" and code and max(map(len, errors.splitlines())) > LONGEST_MESSAGE:
        problem = f"a message of {len(errors)} characters"
    elif outside:
        problem = outside
    elif "not enough memory" in errors:
        problem = "not enough memory"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if peak > MEMORY_BYTES:
        problem = problem or f"{peak / 2**30:.1f} GiB of memory"
    return {
        "number": number,
        "kind": kind,
        "code": code,
        "problem": problem,
        "text": errors[-1500:] if problem else errors[:200],
        "arguments": [a[:200] for a in arguments],
        "variables": {k: v[:100] for k, v in variables.items()},
        "cpu_s": sum(os.times()[:4]) - cpu_before,
        "recycle": peak > MEMORY_BYTES,
    }


def worker(folder: Path, seed: str) -> None:
    """Run the cases whose numbers arrive on standard input; answer each with one line of JSON."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    seeds = Seeds(Path(tempfile.mkdtemp(dir=folder)))
    seeds.store = folder / "seed.zarr"
    run(dry(whole_scene(seeds, seeds.folder)))  # imports everything before the time of a case is measured
    for limit, value in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_AS, _address_space() + 2 * MEMORY_BYTES)):
        resource.setrlimit(limit, (value, resource.getrlimit(limit)[1]))
    for line in sys.stdin:
        used = resource.getrusage(resource.RUSAGE_SELF)
        until = math.ceil(used.ru_utime + used.ru_stime) + CPU_S
        resource.setrlimit(resource.RLIMIT_CPU, (until, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        print(json.dumps(attempt(seeds, seed, int(line))), file=answers, flush=True)


def _address_space() -> int:
    """Return the size of this process's address space, in bytes; 0 if the system does not report it."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmSize:"):
            return int(line.split()[1]) * 1024
    return 0


# --- all cases ------------------------------------------------------------------------------------------------


class Process:
    """A worker process and the number of its current case."""

    def __init__(self, folder: Path, seed: str) -> None:
        self.number: int | None = None
        self.cpu_s, self.since = 0.0, time.monotonic()
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            "VBNFAULT_CACHE_DIR": str(folder / "cache"),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.tools.fuzz", "--worker", str(folder), "--seed", seed, "--kinds", *CASES],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=ROOT,
            env=environment,
            start_new_session=True,
        )

    def give(self, number: int | None) -> None:
        """Send it a case; None ends the process."""
        assert self.process.stdin is not None
        self.number, self.since = number, time.monotonic()
        if number is None:
            self.process.stdin.close()
        else:
            with contextlib.suppress(BrokenPipeError):
                self.process.stdin.write(f"{number}\n".encode())
                self.process.stdin.flush()

    def blocked(self) -> bool:
        """Return whether the case has used no processor time for `BLOCKED_S`."""
        import psutil

        with contextlib.suppress(psutil.Error):
            one = psutil.Process(self.process.pid)
            used = sum(sum(p.cpu_times()[:2]) for p in [one, *one.children(recursive=True)])
            if used > self.cpu_s + 0.2:
                self.cpu_s, self.since = used, time.monotonic()
        return time.monotonic() - self.since > BLOCKED_S


def fuzz(count: int, seed: str, processes: int, progress: bool = True) -> list[dict[str, Any]]:
    """Run cases 0 to `count` - 1; print and return the failures."""
    failures: list[dict[str, Any]] = []
    outcomes: Counter[tuple[str, Any]] = Counter()
    slowest, began = 0.0, time.monotonic()
    with tempfile.TemporaryDirectory(prefix="vbnfault-fuzz-") as temporary:
        folder = Path(temporary)
        os.environ["VBNFAULT_CACHE_DIR"] = str(folder / "cache")
        build_store(Seeds(folder))
        waiting = iter(range(count))
        workers = [Process(folder, seed) for _ in range(processes)]
        for one in workers:
            one.give(next(waiting, None))
        ended = 0
        while any(one.number is not None for one in workers):
            streams = {one.process.stdout: one for one in workers if one.number is not None}
            ready, _, _ = select.select(list(streams), [], [], 10.0)
            for one in [streams[stream] for stream in ready]:
                assert one.process.stdout is not None
                line = one.process.stdout.readline()
                if line:
                    result = json.loads(line)
                else:
                    code = one.process.wait()
                    result = {
                        "number": one.number,
                        "kind": "?",
                        "problem": f"the process died with {code}",
                        "code": code,
                    }
                outcomes[result["kind"], result["code"]] += 1
                slowest = max(slowest, result.get("cpu_s", 0.0))
                if result["problem"]:
                    failures.append(result)
                    report(result, seed)
                if not line or result["recycle"]:
                    one.process.kill()
                    workers[workers.index(one)] = one = Process(folder, seed)
                one.give(next(waiting, None))
                ended += 1
                if progress and ended % 100 == 0:
                    rate = ended / (time.monotonic() - began) * 60
                    print(f"{ended} of {count} cases, {rate:.0f} a minute, {len(failures)} failures", flush=True)
            for one in workers:
                if one.number is not None and one.blocked():
                    one.process.kill()  # the loop above then reports that the process died
        for one in workers:
            one.process.wait()
            assert one.process.stdout is not None
            one.process.stdout.close()
    for kind in sorted({kind for kind, _ in outcomes}):
        codes = {code: n for (of, code), n in sorted(outcomes.items(), key=str) if of == kind}
        print(f"{kind:<12}" + "  ".join(f"exit {code}: {n}" for code, n in codes.items()))
    minutes = (time.monotonic() - began) / 60
    print(
        f"{ended} cases of seed {seed} in {minutes:.1f} minutes: {len(failures)} failures; "
        f"the longest took {slowest:.1f} s of computing"
    )
    return failures


def report(result: dict[str, Any], seed: str) -> None:
    """Print a failure and the command that repeats it."""
    print(f"FAILED case {result['number']} ({result['kind']}): {result['problem']}")
    for key in ("arguments", "variables", "text"):
        if result.get(key):
            print(f"  {key}: {result[key]}")
    kinds = f" --kinds {' '.join(CASES)}" if len(CASES) < KINDS else ""
    print(f"  repeat: python -m tests.tools.fuzz --seed {seed} --only {result['number']}{kinds}", flush=True)


def source_hash() -> str:
    """Return a hash of the package's sources, so that each commit has its own cases."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "vbnfault").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def main() -> None:
    """Run all cases or one; the exit code is 1 if a case of a full run failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", default=None, help="default: a hash of the sources")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--kinds", nargs="+", choices=list(CASES), default=list(CASES), metavar="KIND")
    parser.add_argument("--only", type=int, help="one case, in this process, its files kept")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    seed = given.seed or source_hash()
    for kind in CASES.keys() - set(given.kinds):
        del CASES[kind]
    if given.worker:
        worker(given.worker, seed)
    elif given.only is not None:
        folder = Path(tempfile.mkdtemp(prefix="vbnfault-fuzz-"))
        seeds = Seeds(folder)
        build_store(seeds)
        keep = folder / "case"
        keep.mkdir()
        result = attempt(seeds, seed, given.only, keep)
        print(json.dumps(result, indent=1))
        print(result["text"])
        print(f"files: {keep}")
    else:
        sys.exit(bool(fuzz(given.count, seed, given.processes)))


if __name__ == "__main__":
    main()
