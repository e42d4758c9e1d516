"""Read what the page needs of every sample: state, split, stratum, faults; and how severe each fault is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...store import SPLITS, Store, drawn_table

NOT_KNOWN = 255  # a split without a name, or a severity of a fault that is not injected or draws no number
_BITS = 32


class Listing:
    """Read the columns of a listing, each once.

    The page gets them as arrays of numbers, because JSON of 100,000 samples would take seconds.
    """

    def __init__(self, store: Store) -> None:
        self.store = store

    @cached_property
    def columns(self) -> bytes:
        """Return the columns one behind the other.

        First uint32[word, sample]: the bits of the injected faults, 32 classes a word. Then uint8[3, sample]: the
        index of the split in `SPLITS` (255 for another name), the index of the stratum, and 1 where the sample is
        finished.
        """
        store, faults = self.store, len(self.store.spec.faults)
        words = np.zeros((-(-faults // _BITS), store.samples), dtype="<u4")
        bytes_ = np.zeros((3, store.samples), dtype=np.uint8)
        bytes_[0] = NOT_KNOWN
        begun = store.begun()
        bits = np.left_shift(np.uint32(1), np.arange(faults, dtype=np.uint32) % _BITS)
        for number, values in self._column("injected", begun):
            for word in range(len(words)):
                part = values[:, word * _BITS : (word + 1) * _BITS].astype(bool)
                of_word = bits[word * _BITS : (word + 1) * _BITS]
                words[word, _span(store, number)] = (part * of_word).sum(axis=1, dtype=np.uint32)
        index = {name: k for k, name in enumerate(SPLITS)}
        for number, values in self._column("split", begun):
            bytes_[0, _span(store, number)] = [index.get(str(name), NOT_KNOWN) for name in values]
        for number, values in self._column("stratum", begun):
            bytes_[1, _span(store, number)] = values
        for number, values in self._column("done", begun):
            bytes_[2, _span(store, number)] = values != 0
        return words.tobytes() + bytes_.tobytes()

    @cached_property
    def severities(self) -> bytes:
        """Return uint8[fault, sample]: how severe each fault is among those of its class, 0 to 254.

        The measure is the number by which the model of the class becomes more severe, as levels of severity name
        it, or else how many entries its longest list of drawn values has, such as grains or flares. Equal numbers
        get the same value; 255: the fault is not injected, or its model draws no number.
        """
        store, faults = self.store, self.store.spec.faults
        keys, begun = _keys(store), store.begun()
        # only what has files takes memory: a store may count more samples than it holds
        start = {number: k * store.spec.shard_samples for k, number in enumerate(begun)}
        index = np.concatenate([np.array(store.shard(n)) for n in begun]) if begun else np.zeros(0, dtype=np.int64)
        measured = np.full((len(faults), len(index)), np.nan)
        for number, texts in self._column("parameters", begun):
            first = start[number]
            for offset, text in enumerate(texts):
                try:
                    drawn = drawn_table(text)
                except ValueError:
                    continue
                for k, fault in enumerate(faults):
                    if isinstance(drawn.get(fault), dict):
                        measured[k, first + offset] = _measure(drawn[fault], *keys[k])
        ranked = np.full((len(faults), store.samples), NOT_KNOWN, dtype=np.uint8)
        for k, row in enumerate(measured):
            known = np.flatnonzero(np.isfinite(row))
            values, position = np.unique(row[known], return_inverse=True)
            if len(values) > 1:
                counts = np.bincount(position)
                middle = np.cumsum(counts) - (counts + 1) / 2
                ranked[k, index[known]] = np.round(254 * middle / (len(known) - 1)).astype(np.uint8)[position]
        return ranked.tobytes()

    def _column(self, name: str, numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield a scalar of each shard that can be read; equal files are decoded once."""
        store, decoded = self.store, dict[bytes, NDArray[Any]]()
        if store.spec.empty(name):
            return
        last = store.shards - 1
        most_bytes = store.most_bytes(name)
        contents = store.files.read_each([(store.file_name(name, number), most_bytes) for number in numbers])
        for number, content in zip(numbers, contents, strict=True):
            if isinstance(content, OSError):
                continue
            values = decoded.get(content)
            try:
                if values is None or number == last:  # the last shard may hold fewer samples
                    values = store.column(name, number)
                    decoded[content] = values
            except (OSError, ValueError):
                continue
            yield number, values


def _span(store: Store, number: int) -> slice:
    """Return the samples of a shard."""
    samples = store.shard(number)
    return slice(samples.start, samples.stop)


def _keys(store: Store) -> list[tuple[str, bool]]:
    """Return for each class the key by which its model becomes more severe, and whether less of it is worse."""
    from ...faults import registry  # not above: it loads every model, which the first image need not wait for

    models, keys = store.attributes.get("fault_models", {}), []
    for fault in store.spec.faults:
        model = registry().get(fault, {}).get(str(models.get(fault, "")))
        severity = getattr(model, "severity", None)
        keys.append(("", False) if severity is None else (severity.key, severity.low > severity.high))
    return keys


def _measure(drawn: Mapping[str, Any], key: str, less_is_worse: bool) -> float:
    """Return the number by which a drawn fault is more severe, NaN without one."""
    value = drawn.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return -float(value) if less_is_worse else float(value)
    lists = [len(entry) for entry in drawn.values() if isinstance(entry, list)]
    return float(max(lists)) if lists else float("nan")
