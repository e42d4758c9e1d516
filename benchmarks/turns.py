"""Time functions that take turns, round by round, so that a machine that grows busy slows all of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import psutil

Times = dict[str, list[float]]  # of each round in ms, by name


@dataclass(frozen=True)
class Turns:
    """Hold times of each round by name, and the fraction of the machine that other programs took."""

    wall: Times
    processor: Times
    others: float

    @property
    def wall_ms(self) -> dict[str, float]:
        """Return the median wall times by name."""
        return {name: statistics.median(times) for name, times in self.wall.items()}

    @property
    def processor_ms(self) -> dict[str, float]:
        """Return the median processor times by name."""
        return {name: statistics.median(times) for name, times in self.processor.items()}

    def rate(self, name: str, of: str) -> tuple[float, float]:
        """Return how many times as fast `name` is as `of`, by wall and processor time: medians over the rounds."""
        pairs = [zip(times[of], times[name], strict=True) for times in (self.wall, self.processor)]
        wall, processor = (statistics.median(other / own for other, own in pair) for pair in pairs)
        return wall, processor

    def __str__(self) -> str:
        return f"other programs took {self.others:.0%} of the machine's processor time"


def in_turns(arms: Mapping[str, Callable[[int], Any]], rounds: int, *, warm_up: int = 1, calls: int = 1) -> Turns:
    """Call each function with the number of the round, `calls` times a round, after rounds that do not count.

    The times are those of one call; processor time is that of all threads and child processes.
    """
    wall: Times = {name: [] for name in arms}
    processor: Times = {name: [] for name in arms}
    for number in range(warm_up):
        for function in arms.values():
            function(number)
    own_before, before = processor_s(), of_machine_s()
    for number in range(warm_up, warm_up + rounds):
        for name, function in arms.items():
            start, used = time.perf_counter(), processor_s()
            for call in range(calls):
                function(number * calls + call)
            wall[name].append(1e3 * (time.perf_counter() - start) / calls)
            processor[name].append(1e3 * (processor_s() - used) / calls)
    own, after = processor_s() - own_before, of_machine_s()
    busy, whole = after[0] - before[0], after[1] - before[1]
    return Turns(wall, processor, others=max(0.0, busy - own) / max(whole, 1e-9))


def processor_s() -> float:
    """Return the processor time that this process and its children have used, in s."""
    own = psutil.Process()
    total = time.process_time()
    for process in own.children(recursive=True):
        times = process.cpu_times()
        total += times.user + times.system
    return total


def of_machine_s() -> tuple[float, float]:
    """Return the processor time that all programs have used, and all that there was, in s."""
    times = psutil.cpu_times()
    whole = sum(times) - getattr(times, "guest", 0.0) - getattr(times, "guest_nice", 0.0)
    return whole - times.idle - getattr(times, "iowait", 0.0), whole
