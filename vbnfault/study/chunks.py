"""Evaluate the chunks of a study, in any process, and collect what became of their evaluations.

A chunk is a range of consecutive evaluations of one seed and view, and the task of a worker. Its finished
evaluations are a file of their own, which is replaced every few seconds.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.files import file_contents
from ..core.files.whole_files import writing
from ..core.process.interrupts import finishing
from ..dataset.progress import Progress
from ..dataset.work import ItemsFailed, Job, Lazy, Tick, attempt
from . import results
from .designs import Design
from .spec import Evaluation, Evaluator, EvaluatorFactory, StudySpec

_LARGEST_CHUNK = 32  # evaluations in a task, and in a file of finished rows
_SECONDS_BETWEEN_WRITES = 5.0  # a kill loses no more work of a worker than this


class StudyFailed(ItemsFailed):
    """Report that some evaluations failed. All others are in the table; the indices leave out what is incomplete.

    `indices`: the indices; None if the study was stopped before it was complete.
    """

    def __init__(self, sentence: str, failures: Mapping[int, str] | None = None, indices: Any = None) -> None:
        super().__init__(sentence, failures)
        self.indices = indices


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Describe the task to complete one chunk; for `skip` and `careful` see `Job.task`."""

    number: int
    evaluations: tuple[Evaluation, ...]
    skip: frozenset[int]
    careful: bool


@dataclass(frozen=True)
class ChunkWorkers:
    """Make a worker of a study; the object is a function that can be pickled.

    `contents`: the input files as they were when the study was planned.
    """

    factory: EvaluatorFactory
    spec: StudySpec
    path: Path
    metrics: tuple[str, ...]
    contents: file_contents.Contents

    def __call__(self) -> ChunkWorker:
        return ChunkWorker(self, Lazy(self._make))

    def with_evaluator(self, evaluator: Evaluator) -> ChunkWorker:
        """Return a worker with an evaluator that exists already."""
        return ChunkWorker(self, Lazy(lambda: evaluator), evaluator.timings())

    def _make(self) -> Evaluator:
        with self.contents.in_use():
            return self.factory(self.spec)


class ChunkWorker:
    """Evaluate chunks; the evaluator is made when the first evaluation needs it."""

    def __init__(
        self, source: ChunkWorkers, evaluator: Callable[[], Evaluator], seconds: Mapping[str, float] | None = None
    ) -> None:
        self._source, self._evaluator = source, evaluator
        self._seconds = Counter[str](seconds)  # by stage, spent before this worker or written already

    def do(self, task: Chunk, tick: Tick) -> None:
        """Complete a chunk. If an interrupt ends it early, the finished evaluations are still written.

        If `tick` raises OSError, they are not: the study that started this worker has ended.
        """
        folder = self._source.path
        outcomes, seconds_before = _finished(folder, task.number)
        unwritten, written = 0, time.monotonic()
        by_index = {evaluation.index: evaluation for evaluation in task.evaluations}

        def write() -> None:
            now = Counter(self._evaluator().timings())
            spent = Counter(seconds_before)
            spent.update({stage: seconds - self._seconds[stage] for stage, seconds in now.items()})
            with writing(folder, then="; the same command continues"):
                results.write_chunk(folder, task.number, outcomes, spent)
            seconds_before.update(spent)
            self._seconds = now

        try:
            for i in by_index:
                if i in outcomes:
                    tick(i, "kept", "")
                    continue
                if i in task.skip:
                    continue
                values = attempt(i, lambda index: self._values(by_index[index]), tick)
                if values is None:
                    continue
                outcomes[i] = {"values": values, "error": ""}
                unwritten += 1
                if task.careful or time.monotonic() - written > _SECONDS_BETWEEN_WRITES:
                    write()
                    unwritten, written = 0, time.monotonic()
                tick(i, "built", "")
        except OSError:
            unwritten = 0
            raise
        finally:
            with finishing():
                if unwritten:
                    write()

    def _values(self, evaluation: Evaluation) -> dict[str, float]:
        """Return the metrics of an evaluation. Raises Fatal if no evaluator can be made."""
        evaluator = self._evaluator()
        with self._source.contents.in_use():
            values = evaluator.evaluate(evaluation)
        missing = [name for name in self._source.metrics if name not in values]
        if missing:
            raise InputError(f"the evaluator gives no value for {', '.join(missing)}, of metrics.names")
        return {name: float(values[name]) for name in self._source.metrics}


def _finished(folder: Path, chunk: int) -> tuple[dict[int, dict[str, Any]], dict[str, float]]:
    """Return the finished evaluations of a chunk and what they took; none where its file is damaged."""
    with contextlib.suppress(ValueError):
        return results.read_chunk(folder, chunk)
    return {}, {}


class StudyJob(Job):
    """Hand out the chunks of a study, and collect what became of their evaluations."""

    noun, task_noun, item_noun = "study", "chunk", "evaluation"
    error, successes = StudyFailed, ("built", "kept")

    def __init__(self, path: Path, design: Design, progress: Progress) -> None:
        self.design = design
        seeds, views, rows, models = design.shape
        in_block = rows * models
        self.chunk_size = size = min(_LARGEST_CHUNK, max(1, in_block // 64))
        self._chunks = [
            range(block * in_block + first, block * in_block + min(first + size, in_block))
            for block in range(seeds * views)
            for first in range(0, in_block, size)
        ]
        super().__init__(path, progress, {n: chunk.start // in_block for n, chunk in enumerate(self._chunks)})
        self.finished = 0
        for number, chunk in enumerate(self._chunks):
            try:
                self.finished += len(results.read_chunk(path, number)[0].keys() & set(chunk))
            except ValueError as damaged:
                progress.say(f"note: {damaged}; its evaluations are made again")

    def items(self, number: int) -> Sequence[int]:
        """Return the evaluations of a chunk."""
        return self._chunks[number]

    def task(self, number: int, skip: frozenset[int] = frozenset(), *, careful: bool = False) -> Chunk:
        """Return the task that completes a chunk."""
        evaluations = tuple(self.design.evaluation(i) for i in self._chunks[number])
        return Chunk(number=number, evaluations=evaluations, skip=skip, careful=careful)

    def outcomes(self) -> list[dict[str, Any]]:
        """Return values and error of each evaluation, in order."""
        outcomes: list[dict[str, Any]] = []
        for number, chunk in enumerate(self._chunks):
            finished, _ = _finished(self.path, number)
            for i in chunk:
                error = self.failures.get(i, "not evaluated").splitlines()[0]
                outcomes.append(finished.get(i, {"values": {}, "error": error}))
        return outcomes

    def seconds_by_stage(self) -> dict[str, float]:
        """Return the seconds that all finished evaluations took, by stage, in this run and in those before."""
        seconds: Counter[str] = Counter()
        for number in range(self.tasks):
            seconds.update(_finished(self.path, number)[1])
        return dict(seconds)
