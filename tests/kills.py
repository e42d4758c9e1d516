"""Kill builds at random file operations, resume them, and compare with an undisturbed build.

    python -m tests.kills --count 500 --rendering off

Each round ends one build early, up to three times, at operations drawn with `--seed`. The signal is SIGKILL, or in
one of four cases SIGTERM; half of the SIGKILLs leave a half-written file. The build has one worker, in every eighth
round two. A last build then completes the store without disturbance. A round passes if the digest equals that of a
build that was never disturbed, `verify` reports no problem, no temporary file is left, and no kill lost a finished
sample.

Every build runs in a process forked from this one. This process imports what a build needs, except the renderer,
and opens no store.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
import victim
from conftest import small_scene

# The worker processes of a build import this file again, as `__mp_main__`.
if __name__ == "__mp_main__":
    victim.follow_the_environment("worker")


def import_all() -> None:
    """Import what builds and reports need, except the renderer: a forked process would lack its threads."""
    import synthetic  # noqa: F401

    from vbnfault import dataset, store  # noqa: F401


def build_synthetic(out: Path, workers: int) -> None:
    """Build 18 synthetic samples."""
    import synthetic

    synthetic.run(out, workers=workers)


def build_rendered(out: Path, workers: int) -> None:
    """Build 6 rendered samples."""
    from vbnfault import dataset
    from vbnfault.scene import config

    table = small_scene(dataset={"samples": 6, "shard_samples": 2, "sites": 2}, camera={"width_px": 48})
    dataset.build_scene(config.parse_scene(table, source="kills"), out, source="kills", workers=workers)


def build_retaken(out: Path, workers: int) -> None:
    """Take 6 rendered samples again; the store beside `out` that has them is built by the first call."""
    import vbnfault
    from vbnfault import store
    from vbnfault.scene import config

    views, layers = out.parent / "views.store", {"layers": ["scene_radiance", "depth_m", "normal", "semantic"]}
    sampling = {"samples": 6, "shard_samples": 2, "sites": 2}
    tables = {"camera": {"width_px": 48}, "faults": {"vignetting": {}, "broken_lines": {}}}
    if not store.is_store(views):
        vbnfault.build(config.parse_scene(small_scene(dataset=sampling | layers, **tables), source="kills"), views)
    scene = config.parse_scene(small_scene(dataset={**sampling, "seed": 2}, **tables), source="kills")
    vbnfault.retake(views, scene, out, workers=workers)


def finished(out: Path) -> int:
    """Return how many samples of a store are finished; 0 if there is no store."""
    from vbnfault import store

    return store.open_store(out).finished() if store.is_store(out) else 0


def report(out: Path) -> dict[str, Any]:
    """Return the number of finished samples, the digest (empty if there are problems) and the problems."""
    from vbnfault import store

    problems = store.verify(out)
    return {"finished": finished(out), "digest": "" if problems else store.digest(out), "problems": problems}


def forked(action: Callable[[], Any]) -> tuple[int, Any]:
    """Run an action in a forked process; return its exit code, negative for a signal, and its result."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = 0
        try:
            answer = action()
        except BaseException as error:
            code, answer = getattr(error, "exit_code", 1), str(error)
        with os.fdopen(writer, "w") as pipe:
            json.dump(answer, pipe)
        os._exit(code)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        text = pipe.read()
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), json.loads(text or "null")


def main() -> int:
    """Run the rounds; the exit code is 1 if one failed."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=500, help="kills in all")
    options.add_argument("--rendering", choices=("on", "off", "retake"), default="off")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    build = {"on": build_rendered, "off": build_synthetic, "retake": build_retaken}[given.rendering]
    os.environ.pop("VICTIM_PLAN", None)
    folder = Path(tempfile.mkdtemp(prefix="kills-"))
    os.environ.setdefault("VBNFAULT_CACHE_DIR", str(folder / "cache"))

    def whole() -> list[int]:
        counted = [0]

        def count(kind: str, _text: str) -> None:
            counted[0] += kind == "write"

        build(folder / "warm.zarr", 1)
        victim.follow([], count)
        build(folder / "whole.zarr", 1)
        return counted

    import_all()
    code, answer = forked(whole)
    assert code == 0, answer
    operations = answer[0]
    wanted = forked(lambda: report(folder / "whole.zarr"))[1]
    kills, failures, round_ = 0, 0, 0
    began = time.monotonic()
    while kills < given.count:
        dice = np.random.default_rng([given.seed, round_])
        workers = 2 if round_ % 8 == 7 else 1
        out = folder / f"{round_}.zarr"
        wrong, before, ended = [], 0, []
        for _ in range(int(dice.integers(1, 4))):
            term = dice.random() < 0.25
            step = victim.step(
                "write",
                count=int(dice.integers(1, operations // workers)),
                number="SIGTERM" if term else "SIGKILL",
                torn=bool(dice.random() < 0.5) and not term,
                to="self" if workers == 1 else "parent",
            )

            def disturbed(step: dict = step, out: Path = out, workers: int = workers) -> None:
                if workers == 1:
                    victim.follow([step])
                else:
                    os.environ["VICTIM_PLAN"] = json.dumps({"worker": [step]})
                build(out, workers)

            code, said = forked(disturbed)
            ended.append(code)
            if code not in (0, 143, -signal.SIGKILL):
                wrong.append(f"exit code {code}: {said}")
            kills += code != 0
            after = forked(lambda out=out: finished(out))[1]
            if type(after) is not int or after < before:
                wrong.append(f"{before} samples were finished, then {after}")
            else:
                before = after
        code, said = forked(lambda out=out, workers=workers: build(out, workers))
        if code:
            wrong.append(f"resuming ends with {code}: {said}")
        state = forked(lambda out=out: report(out))[1]
        if state != wanted:
            wrong.append(f"{state} in place of {wanted}")
        left = [p.name for p in folder.glob(f".{out.name}*")] + [p.name for p in out.rglob("*.partial")]
        if left:
            wrong.append(f"left behind: {left}")
        if wrong:
            failures += 1
            print(f"round {round_}, {workers} workers, ended with {ended}: {'; '.join(wrong)}", flush=True)
        shutil.rmtree(out, ignore_errors=True)
        round_ += 1
        if round_ % 10 == 0:
            rate = kills / (time.monotonic() - began) * 60
            print(f"{kills} kills in {round_} rounds, {rate:.0f} a minute, {failures} failures so far", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    minutes = (time.monotonic() - began) / 60
    print(
        f"{kills} kills in {round_} rounds, rendering {given.rendering}, seed {given.seed}, {minutes:.1f} minutes: "
        f"{failures} failures",
        flush=True,
    )
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
