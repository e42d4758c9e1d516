"""A program that sends itself signals at its n-th file operation, import or process start: tests count no seconds.

    VICTIM_PLAN='{"main": [{"events": ["write"], "count": 7, "signal": "SIGKILL"}]}' python tests/victim.py cli …

`cli` runs the command line, `build` a build of made-up samples (`test_build.main`). The plan is a list of steps for
the program itself (`main`) and one for each of its worker processes (`worker`). A step waits until `count` events
of one of its kinds, with `text` in what they concern, have begun, sends its signal and gives way to the next step:

events      `write` (a file is opened to be written, renamed, removed, made durable; a folder is made), `open` (any
            file), `import` (a module), `start` (a worker process has been started), `kill` (a signal is sent)
to          `self`, `parent`, or `group`: every process of the command, as a terminal does on Ctrl-C
torn        a write leaves half a file of nonsense first
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
    """A step of a plan."""
    return {"events": events, "count": count, "signal": number, **more}


def start(
    arguments: Sequence[object], *, main: Sequence[dict] = (), worker: Sequence[dict] = (), **more: Any
) -> subprocess.Popen[str]:
    """Start the program with a plan, in a session of its own; its outputs are pipes."""
    path = os.pathsep.join([str(HERE.parent), str(HERE)])
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
    """Run the program to its end, and to that of every process that it started: they hold its outputs."""
    process = start(arguments, **more)
    try:
        out, err = process.communicate(timeout=600)  # no measure: it guards against a test that hangs
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        raise AssertionError(f"it hangs, after {out!r} and {err!r}") from None
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def follow(steps: Sequence[dict[str, Any]], count: Callable[[str, str], None] | None = None) -> None:
    """Follow a plan in this process, from now on; `count` is called with every event."""
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


def _send(number: int, to: str, parent: int) -> None:
    if to == "group":
        os.killpg(os.getpgid(0), number)
    elif to == "self":
        os.kill(os.getpid(), number)
    elif os.getppid() == parent:  # an orphan has another parent, which is none of a build's processes
        os.kill(parent, number)


def follow_the_environment(role: str) -> None:
    """Follow what VICTIM_PLAN says for this process."""
    steps = json.loads(os.environ.get("VICTIM_PLAN", "{}")).get(role)
    if steps:
        follow(steps)


def main() -> None:
    kind, *arguments = sys.argv[1:]
    if kind == "build":
        import test_build

        sys.exit(test_build.main(*arguments))
    from vbnfault import cli

    sys.argv = ["vbnfault", *arguments]
    cli.main()


if __name__ == "__mp_main__":  # a worker imports the main program anew
    follow_the_environment("worker")
if __name__ == "__main__":
    follow_the_environment("main")
    main()
