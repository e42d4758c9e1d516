"""Run the program so that it sends itself signals at its n-th file operation, import or process start.

    VICTIM_PLAN='{"main": [{"events": ["write"], "count": 7, "signal": "SIGKILL"}]}' \
        python tests/tools/victim.py cli …

So a test interrupts the program at an exact point and does not depend on time. `cli` runs the command line; `build`
builds synthetic samples (`synthetic.main`). The plan has one list of steps for the program itself (`main`) and one
for each of its worker processes (`worker`). A step counts the events of its kinds that concern a name containing
`text`. When event number `count` begins, the step sends its signal, and the next step follows.

events      `write` (a file is opened for writing, renamed, removed or flushed, or a folder is made or removed),
            `open` (of any file), `import` (of a module), `start` (a worker process has been started), `kill` (a
            signal is sent)
to          `self`, `parent`, or `group`: every process of the command, as a terminal does on Ctrl-C
once        a path: of several processes that follow the step, only the one that makes this file sends the signal
torn        if the event opens a file for writing, nonsense is written to that file before the signal
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
_WRITES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.utime", "shutil.rmtree"}


def step(*events: str, count: int = 1, number: str = "SIGKILL", **more: Any) -> dict[str, Any]:
    """Return a step of a plan; `number` is the name of the signal."""
    return {"events": events, "count": count, "signal": number, **more}


def start(
    arguments: Sequence[object], *, main: Sequence[dict] = (), worker: Sequence[dict] = (), **more: Any
) -> subprocess.Popen[str]:
    """Start the program with a plan, in its own session (process group); its outputs are pipes."""
    path = os.pathsep.join([str(HERE.parents[1]), str(HERE.parent)])
    plan = json.dumps({"main": main, "worker": worker})
    return subprocess.Popen(
        [sys.executable, str(HERE / "victim.py"), *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": path, "VICTIM_PLAN": plan, **more.pop("env", {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **more,
    )


def run(arguments: Sequence[object], **more: Any) -> subprocess.CompletedProcess[str]:
    """Run the program until it and every process that it started have ended: they share its outputs."""
    process = start(arguments, **more)
    try:
        out, err = process.communicate(timeout=600)  # only against a test that hangs
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        raise AssertionError(f"it hangs, after {out!r} and {err!r}") from None
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def follow(
    steps: Sequence[dict[str, Any]], count: Callable[[str, str], None] | None = None
) -> list[dict[str, Any]]:
    """Follow a plan in this process from now on; `count` is called with the kind and text of every event.

    Returns the steps that are left, a list that may be filled again.
    """
    left = [dict(one) for one in steps]
    inside = [False]
    parent = os.getppid()

    def seen(kind: str, text: str, write_to: str = "") -> None:
        if inside[0]:
            return
        if count:
            count(kind, text)
        if left and kind in left[0]["events"] and left[0].get("text", "") in text:
            left[0]["count"] -= 1
            if left[0]["count"] <= 0:
                inside[0] = True
                now = left.pop(0)
                if _is_first(now.get("once")):
                    if now.get("torn") and write_to:
                        Path(write_to).write_bytes(b"half a file of nonsense")
                    _send(getattr(signal, now["signal"]), now.get("to", "self"), parent)
                inside[0] = False

    def hook(event: str, args: tuple[Any, ...]) -> None:
        if event == "import":
            seen("import", str(args[0]))
        elif event == "open" and isinstance(args[0], str | bytes | os.PathLike):
            name = os.fsdecode(args[0])
            mode, flags = args[1] or "", args[2] or 0
            writes = any(c in mode for c in "wax+") or bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            seen("open", name)
            if writes and not name.startswith(("/dev", "/proc")) and "__pycache__" not in name:
                seen("write", name, name)
        elif event == "os.kill":
            seen("kill", str(args[1]))
        elif event in _WRITES and "__pycache__" not in str(args[0]):
            seen("write", str(args[0]))

    sys.addaudithook(hook)
    fsync, begin = os.fsync, multiprocessing.process.BaseProcess.start

    def counted_fsync(file: Any) -> None:
        seen("write", "fsync")
        fsync(file)

    def counted_start(self: Any) -> None:
        begin(self)
        seen("start", self.name)

    os.fsync = counted_fsync
    multiprocessing.process.BaseProcess.start = counted_start  # type: ignore[method-assign]
    return left


def _is_first(path: str | None) -> bool:
    """Return whether this process makes the file `path`; True if there is no path."""
    if path is None:
        return True
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def _send(number: int, to: str, parent: int) -> None:
    """Send a signal to this process, its parent or its group."""
    if to == "group":
        os.killpg(os.getpgid(0), number)
    elif to == "self":
        os.kill(os.getpid(), number)
    elif os.getppid() == parent:  # an orphan has another parent, which is not a process of the build
        os.kill(parent, number)


def follow_the_environment(role: str) -> None:
    """Follow the steps in VICTIM_PLAN for this process; `role`: `main` or `worker`."""
    steps = json.loads(os.environ.get("VICTIM_PLAN", "{}")).get(role)
    if steps:
        follow(steps)


def main() -> None:
    """Run `build` or `cli` with the other arguments."""
    kind, *arguments = sys.argv[1:]
    if kind == "build":
        import synthetic

        sys.exit(synthetic.main(*arguments))
    from vbnfault import cli

    sys.argv = ["vbnfault", *arguments]
    cli.main()


if __name__ == "__mp_main__":  # a worker process imports the main program again
    follow_the_environment("worker")
if __name__ == "__main__":
    follow_the_environment("main")
    main()
