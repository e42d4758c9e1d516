"""Make one dataset in every way, kill each way at random events, resume it, and compare the digests.

    python -m tests.tools.kills --count 200 --samples 64

The ways are in `kill_ways.py`: builds in one process, in two, on Dask, in ranges of shards and in a bucket of S3,
of frames of sequences, merges, retakes and exports. First each way runs undisturbed; all that make the dataset must
have one digest. Then each round ends one command early, `--steps` times or until it ends well, and completes it
undisturbed. An event is drawn with `--seed`: an operation on files of the command or of one of its workers, or a
request that writes to the bucket. The signal is SIGKILL; in one of five cases it is SIGTERM where the command
itself follows the plan, and half of the SIGKILLs leave a half-written file. Requests may be answered with 503 from
one on, instead of a signal.

A round passes if the output is that of the undisturbed command, if `verify` reports no problem and no temporary
file is left, and if no kill lost what was finished. The exit code is 1 if a round fails. `--count` counts SIGKILLs,
`--each` sets the number of rounds of each way instead.

Every command runs in a process forked from this one. This process imports what the commands need, except the
renderer, opens no store and starts no thread.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from tools import victim

# The worker processes of a build import this file again, as `__mp_main__`.
if __name__ == "__mp_main__":
    victim.follow_the_environment("worker")

# --- processes ---------------------------------------------------------------------------------------------


class Running:
    """An action that runs in a forked process."""

    def __init__(self, action: Callable[[], Any], silent: bool = False) -> None:
        reader, writer = os.pipe()
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(reader)
            _end_with(action, writer, silent)
        os.close(writer)
        self._reader = reader

    def wait(self) -> tuple[int, Any]:
        """Return the exit code, negative for a signal, and what the action returned or raised."""
        with os.fdopen(self._reader) as pipe:
            text = pipe.read()
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1]), json.loads(text or "null")


def _end_with(action: Callable[[], Any], writer: int, silent: bool) -> None:
    """End this process with an action, whose result, or the error it raised, is written to a pipe."""
    os.set_inheritable(writer, False)
    if silent:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
    code = 0
    try:
        answer = action()
    except BaseException as error:
        code, answer = getattr(error, "exit_code", 1), f"{type(error).__name__}: {error}"
    with os.fdopen(writer, "w") as pipe:
        json.dump(answer, pipe)
    os._exit(code)


def forked(action: Callable[[], Any], silent: bool = False) -> tuple[int, Any]:
    """Run an action in a forked process; return its exit code, negative for a signal, and its result."""
    return Running(action, silent).wait()


def result(action: Callable[[], Any]) -> Any:
    """Return what an action returns in a forked process, which must end well."""
    code, answer = forked(action, silent=True)
    if code:
        raise AssertionError(f"ended with {code}: {answer}")
    return answer


# --- what a way is -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """Where a command works: its output, a folder that all rounds share, and what the ways need to know."""

    out: Any  # a path, or the URL of a store
    shared: Path
    samples: int
    variant: str = ""
    server: str = ""  # URL of the S3 server
    scheduler: str = ""  # address of the Dask scheduler


class Way:
    """A command that is killed and resumed; subclasses say what it does. An object has no state."""

    variants: Sequence[str] = ("",)  # of which the rounds take turns
    makes_dataset = True  # that has the one digest
    needs: Sequence[str] = ()  # "server", "scheduler"

    def __init__(self, name: str = "") -> None:
        self.name = name

    def prepare(self, place: Place) -> None:
        """Make what the rounds share, once."""

    def begin(self, place: Place) -> None:
        """Make what one round needs besides its output."""

    def run(self, place: Place) -> None:
        """Run the command; again, it resumes."""
        raise NotImplementedError

    def beside(self, place: Place) -> Callable[[], None] | None:
        """Return a command that runs undisturbed beside the first one of a round, if any."""
        return None

    def complete(self, place: Place) -> None:
        """Run the undisturbed commands that complete the output."""
        self.run(place)

    def disturb(self, place: Place, step: Step) -> None:
        """Run the command, which a step ends early; the signal comes from an event of this process."""
        victim.follow([step.plan()])
        self.run(place)

    def count(self, place: Place) -> int:
        """Run the command undisturbed; return the number of events at which a step may end it."""
        counted = [0]

        def count(kind: str, _text: str) -> None:
            counted[0] += kind == "write"

        victim.follow([], count)
        self.run(place)
        return counted[0]

    def held(self, place: Place) -> int:
        """Return how much is finished, which no kill may lessen."""
        from vbnfault import store

        return store.open_store(place.out).finished() if store.is_store(place.out) else 0

    def report(self, place: Place) -> dict[str, Any]:
        """Return the digest of the output, and what is wrong with it."""
        from vbnfault import store

        return {
            "digest": store.digest(place.out),
            "problems": [*store.examine(place.out).problems, *self.left(place)],
        }

    def left(self, place: Place) -> list[str]:
        """Return the names of temporary files that are left."""
        out = Path(place.out)
        return [*(p.name for p in out.parent.glob(f".{out.name}*")), *(p.name for p in out.rglob("*.partial"))]

    def remove(self, place: Place) -> None:
        """Remove what a round made."""
        for path in (Path(place.out), _died(place)):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def _died(place: Place) -> Path:
    """Return the file that a worker makes before it is killed, so that no other one is."""
    return place.shared / f"died-{str(place.out).rpartition('/')[2]}"


class Step(NamedTuple):
    """What ends a command: a signal at an event, maybe after nonsense was written to the file that it opens."""

    at: int
    number: str
    torn: bool
    once: str  # a file that a killed worker leaves

    def plan(self, **more: Any) -> dict[str, Any]:
        """Return a step for `victim`."""
        return victim.step("write", count=self.at, number=self.number, torn=self.torn, **more)


# --- rounds ------------------------------------------------------------------------------------------------


@dataclass
class Score:
    """Count what happened to one way."""

    rounds: int = 0
    kills: int = 0
    others: int = 0  # commands that ended early otherwise: SIGTERM, or a bucket that fails
    resumes: int = 0
    failures: int = 0
    digests: Counter[str] = field(default_factory=Counter)


def play(
    way: Way, place: Place, events: int, wanted: Any, dice: np.random.Generator, score: Score, steps: int
) -> list[str]:
    """Kill a command up to `steps` times and complete it; return what is wrong."""
    wrong, before = [], 0
    code, said = forked(lambda: way.begin(place), silent=True)
    if code:
        return [f"the round cannot begin: {said}"]
    for k in range(steps):
        term = type(way).disturb is Way.disturb and dice.random() < 0.2
        step = Step(
            at=int(dice.integers(1, max(2, events // (k + 1)))),  # earlier steps left less to do
            number="SIGTERM" if term else "SIGKILL",
            torn=bool(dice.random() < 0.5) and not term,
            once=str(_died(place)),
        )
        ended, problems = _disturbed(way, place, step, score, way.beside(place) if k == 0 else None)
        wrong += problems
        code, after = forked(lambda: way.held(place), silent=True)
        if code or after < before:
            wrong.append(f"{before} were finished, then {after}")
        else:
            before = after
        if ended == 0:
            break
    code, said = forked(lambda: way.complete(place), silent=True)
    if code:
        wrong.append(f"resuming ends with {code}: {said}")
    code, state = forked(lambda: way.report(place), silent=True)
    score.digests[state["digest"] if code == 0 else f"none: {state}"] += 1
    if state != wanted:
        wrong.append(f"{state} in place of {wanted}")
    forked(lambda: way.remove(place), silent=True)
    return wrong


def _disturbed(
    way: Way, place: Place, step: Step, score: Score, beside: Callable[[], None] | None
) -> tuple[int, list[str]]:
    """Run a command that a step may end, count what happened, and return its exit code and what is wrong."""
    other = Running(beside, silent=True) if beside else None
    code, said = forked(lambda: way.disturb(place, step), silent=True)
    wrong = []
    if other and (ended := other.wait())[0]:
        wrong.append(f"the command beside it ends with {ended}")
    killed = code == -signal.SIGKILL or _died(place).exists()
    _died(place).unlink(missing_ok=True)
    score.kills += killed
    score.others += not killed and code != 0
    score.resumes += code != 0
    # a server that fails as a store is created counts as bad input
    if code not in (0, 143, -signal.SIGKILL) and not (code in (1, 2) and "503" in str(said)):
        wrong.append(f"exit code {code}: {said}")
    return code, wrong


@dataclass
class Rounds:
    """Run the ways, first undisturbed, then with kills."""

    ways: Sequence[Way]
    seed: int
    place: Callable[[str, Way], Place]
    most: int | None = None  # rounds of each way, if that is limited
    steps: int = 3  # of each round
    events: dict[tuple[Way, str], int] = field(default_factory=dict)
    wanted: dict[tuple[Way, str], Any] = field(default_factory=dict)
    scores: dict[Way, Score] = field(default_factory=dict)

    def undisturbed(self) -> bool:
        """Run each way undisturbed; return whether those that make the dataset have one digest."""
        for way in self.ways:
            result(lambda way=way: way.prepare(self.place("", way)))
            for variant in way.variants[: self.most]:
                place = self._place(way, f"whole{variant}", variant)
                result(lambda way=way, place=place: way.begin(place))
                beside = way.beside(place)
                other = Running(beside, silent=True) if beside else None
                self.events[way, variant] = result(lambda way=way, place=place: way.count(place))
                if other:
                    assert other.wait()[0] == 0
                result(lambda way=way, place=place: way.complete(place))
                report = self.wanted[way, variant] = result(lambda way=way, place=place: way.report(place))
                result(lambda way=way, place=place: way.remove(place))
                label = f"{way.name} {variant}".strip()
                print(f"{label:<34}{report['digest'][:16]}  {self.events[way, variant]} events", flush=True)
                if report["problems"]:
                    raise AssertionError(f"{label}: {report}")
            self.scores[way] = Score()
        return len({self.wanted[way, way.variants[0]]["digest"] for way in self.ways if way.makes_dataset}) <= 1

    def _place(self, way: Way, name: str, variant: str) -> Place:
        place = self.place(name, way)
        return Place(**{**vars(place), "variant": variant})

    def round(self, way: Way) -> None:
        """Run one round of a way."""
        score = self.scores[way]
        number = score.rounds
        score.rounds += 1
        variant = way.variants[number % len(way.variants)]
        position = self.ways.index(way)
        dice = np.random.default_rng([self.seed, number, position])
        place = self._place(way, f"r{number}", variant)
        wrong = play(way, place, self.events[way, variant], self.wanted[way, variant], dice, score, self.steps)
        if wrong:
            score.failures += 1
            print(f"FAILED {way.name} {variant}, round {number}: {'; '.join(wrong)}", flush=True)

    def total(self, name: str) -> int:
        """Return the sum of a count over the ways."""
        return sum(getattr(score, name) for score in self.scores.values())

    def table(self) -> str:
        """Return a line for each way."""
        lines = [f"{'way':<34}{'kills':>6}{'other':>6}{'resumes':>8}{'rounds':>7}{'failed':>7}  digests"]
        for way, s in self.scores.items():
            digests = ", ".join(f"{digest[:16]} x {n}" for digest, n in s.digests.items())
            lines.append(
                f"{way.name:<34}{s.kills:>6}{s.others:>6}{s.resumes:>8}{s.rounds:>7}{s.failures:>7}  {digests}"
            )
        return "\n".join(lines)


def main() -> int:
    """Run the rounds; the exit code is 1 if one failed or if digests differ."""
    from tools import kill_ways

    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=200, help="SIGKILLs in all")
    options.add_argument("--each", type=int, help="rounds of each way, instead of --count")
    options.add_argument("--steps", type=int, default=3, help="how often a command is ended early in a round")
    options.add_argument("--samples", type=int, default=64)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--ways", nargs="+", default=[*kill_ways.WAYS], choices=[*kill_ways.WAYS], metavar="WAY")
    given = options.parse_args()
    os.environ.pop("VICTIM_PLAN", None)
    folder = Path(tempfile.mkdtemp(prefix="kills-"))
    os.environ.setdefault("VBNFAULT_CACHE_DIR", str(folder / "cache"))
    began = time.monotonic()
    with kill_ways.services(given.ways, folder) as found:

        def place(name: str, way: Way) -> Place:
            name = f"{[*kill_ways.WAYS.values()].index(way)}-{name}"
            out = f"s3://{kill_ways.BUCKET}/{name}" if "server" in way.needs else folder / name
            return Place(out, shared=folder, samples=given.samples, **found)

        rounds = Rounds([kill_ways.WAYS[name] for name in given.ways], given.seed, place, given.each, given.steps)
        same = rounds.undisturbed()
        print("one digest" if same else "DIGESTS DIFFER", flush=True)
        for turn in itertools.count():
            if turn == given.each or (given.each is None and rounds.total("kills") >= given.count):
                break
            for way in rounds.ways:
                rounds.round(way)
            minutes = (time.monotonic() - began) / 60
            print(
                f"{rounds.total('kills')} kills in {rounds.total('rounds')} rounds, {minutes:.1f} minutes, "
                f"{rounds.total('failures')} failures so far",
                flush=True,
            )
    print(rounds.table())
    failures, minutes = rounds.total("failures"), (time.monotonic() - began) / 60
    print(
        f"{rounds.total('kills')} kills in {rounds.total('rounds')} rounds of {len(rounds.ways)} ways, "
        f"seed {given.seed}, {minutes:.1f} minutes: {failures} failures"
    )
    shutil.rmtree(folder, ignore_errors=True)
    return int(failures > 0 or not same)


if __name__ == "__main__":
    sys.exit(main())
