"""Count how often each fault class is planned, and how often it is in the pixels, by split."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .schema import SPLITS


class FaultCounts:
    """Count the samples for which each fault class is planned, and those in which it is injected, by split.

    `add` counts the samples one by one.
    """

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = tuple(faults)
        self.samples: Counter[str] = Counter()
        self._planned: Counter[tuple[str, str]] = Counter()
        self._realised: Counter[tuple[str, str]] = Counter()
        self._has_plan = True

    def add(self, split: str, planned: Iterable[bool] | None, injected: Iterable[bool]) -> None:
        """Count one sample.

        `planned`, `injected`: bool[fault], the commanded and the injected faults; `planned` is None if no plan is
        known.
        """
        self.samples[split] += 1
        self._has_plan &= planned is not None
        for counts, flags in ((self._planned, planned), (self._realised, injected)):
            for fault, is_in in zip(self.faults, flags if flags is not None else (), strict=False):
                counts[split, fault] += bool(is_in)

    def add_all(self, splits: NDArray[Any], planned: NDArray[np.bool_] | None, injected: NDArray[np.bool_]) -> None:
        """Count some samples at once, as `add` counts each: str[sample], bool[sample, fault]."""
        self._has_plan &= planned is not None
        for split in dict.fromkeys(splits.tolist()):
            chosen = splits == split
            self.samples[split] += int(chosen.sum())
            for counts, flags in ((self._planned, planned), (self._realised, injected)):
                if flags is not None:
                    totals = flags[chosen].sum(axis=0).tolist()
                    for fault, total in zip(self.faults, totals, strict=True):
                        counts[split, fault] += total

    def planned(self, fault: str, split: str | None = None) -> int:
        """Return the number of samples for which a fault is planned, in one split or in all."""
        return sum(n for (s, f), n in self._planned.items() if f == fault and split in (None, s))

    def realised(self, fault: str, split: str | None = None) -> int:
        """Return the number of samples in which a fault is injected, in one split or in all."""
        return sum(n for (s, f), n in self._realised.items() if f == fault and split in (None, s))

    @property
    def missing(self) -> dict[str, int]:
        """Return planned minus realised samples by fault class, only where the difference is not 0."""
        if not self._has_plan:
            return {}
        differences = {f: self.planned(f) - self.realised(f) for f in self.faults}
        return {fault: n for fault, n in differences.items() if n}

    def missing_text(self) -> str:
        """Return `missing` as a sentence."""
        few = ", ".join(f"{name} {count}" for name, count in self.missing.items())
        return f"planned, but without effect and not injected: {few}"

    def lines(self) -> list[str]:
        """Return a text table: for each fault class the planned and realised samples, in all and by split."""
        if not self.faults or not self.samples:
            return []
        known = [s for s in SPLITS if s in self.samples]
        splits = [*known, *sorted(set(self.samples) - set(known))]
        head = ["fault", "planned", "realised", *splits]
        if not self._has_plan:
            head.remove("planned")
        table = [head]
        for fault in self.faults:
            row = [fault, str(self.planned(fault)), str(self.realised(fault))]
            for split in splits:
                planned, realised = self.planned(fault, split), self.realised(fault, split)
                same = planned == realised or not self._has_plan
                row.append(str(realised) if same else f"{realised} of {planned}")
            table.append(row if self._has_plan else [row[0], *row[2:]])
        totals = ["samples", *[""] * (len(head) - len(splits) - 2), str(self.samples.total())]
        table.append([*totals, *(str(self.samples[s]) for s in splits)])
        widths = [max(len(row[k]) for row in table) for k in range(len(head))]
        lines = []
        for row in table:
            cells = [row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]
            lines.append("  ".join(cells).rstrip())
        return lines
