"""Choose the samples of a store that a trainer reads: by split, by faults, by any value of a sample."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, shown
from ..store import SPLITS, ShardReader, Store

Where = Callable[["Columns"], NDArray[np.bool_]]


class Columns(Mapping[str, NDArray]):
    """Hold the scalars of all finished samples; each is read when it is first asked for.

    `columns["sun_elevation_deg"]` is float64[n], `columns["split"]` an array of strings. The reference of the store
    lists the names.
    """

    def __init__(self, store: Store) -> None:
        self._reader = ShardReader(store, ())
        self._columns: dict[str, NDArray] = {}
        done = [flag for number in range(store.shards) for flag in store.done(number).values()]
        self.samples: NDArray[np.int64] = np.flatnonzero(done)
        self._shards = np.unique(self.samples // store.spec.shard_samples).tolist()

    def __getitem__(self, name: str) -> NDArray:
        scalars = self._reader.store.spec.scalars
        if name not in scalars:
            raise KeyError(f"{name!r}: a store has no such value of a sample; known: {', '.join(scalars)}")
        if name not in self._columns:
            store = self._reader.store
            parts = []
            for number in self._shards:
                column, own = self._reader.column(name, number), np.asarray(store.shard(number))
                parts.append(column[np.isin(own, self.samples)])
            values = np.concatenate(parts) if parts else np.empty(0)
            self._columns[name] = values.astype(str) if scalars[name].is_text else values
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._reader.store.spec.scalars)

    def __len__(self) -> int:
        return len(self._reader.store.spec.scalars)


def select(
    store: Store,
    split: str | None = None,
    containing: Sequence[str] | None = None,
    where: Where | None = None,
) -> NDArray[np.int64]:
    """Return the indices of the chosen samples, int64[n], ascending.

    Samples that are not finished are left out, with a warning.

    Parameters
    ----------
    store
        An open store.
    split
        `train`, `val` or `test`; None: all.
    containing
        Fault classes: only samples with at least one of them in their pixels. An empty sequence: only samples
        without any fault. None: all.
    where
        Called with `Columns`; returns bool[n], True for the samples to keep.

    Raises
    ------
    InputError
        For a split or a class that the store lacks, or if no sample is left.
    """
    if where is not None and not callable(where):
        raise InputError(f"where = {shown(where)}: must be a function of the scalars of all samples, or None")
    columns = Columns(store)
    if len(columns.samples) < store.samples:
        logging.getLogger("vbnfault").warning(
            f"{store.path}: {len(columns.samples)} of {store.samples} samples are finished; the others are left "
            "out until the build command has made them"
        )
    keep = np.ones(len(columns.samples), dtype=bool)
    if split is not None:
        if split not in SPLITS:
            raise InputError(f"split = {shown(split)}: must be one of {', '.join(SPLITS)}, or None")
        keep &= columns["split"] == split
    if containing is not None:
        chosen = [store.spec.faults.index(name) for name in known_classes(store, containing, "containing")]
        injected = columns["injected"]
        keep &= injected[:, chosen].any(axis=1) if chosen else ~injected.any(axis=1)
    if where is not None:
        kept = np.asarray(where(columns))
        if kept.shape != keep.shape or kept.dtype != bool:
            raise InputError(
                f"where: it returned {kept.dtype}{list(kept.shape)}; must be bool[{len(keep)}], one for each sample"
            )
        keep &= kept
    if not keep.any():
        asked = {"split": split, "containing": containing, "where": where and "…"}
        given = ", ".join(f"{name} = {value}" for name, value in asked.items() if value is not None)
        raise InputError(f"{store.path}: no finished sample fits {given or 'in it'}")
    return columns.samples[keep]


def known_classes(store: Store, names: Sequence[str], key: str) -> tuple[str, ...]:
    """Return the names of fault classes. Raises InputError if the store lacks one or a name is there twice."""
    if not isinstance(names, Collection):
        raise InputError(f"{key} = {shown(names)}: must be a list of names")
    chosen = (names,) if isinstance(names, str) else tuple(names)
    for name in chosen:
        if name not in store.spec.faults:
            known = ", ".join(store.spec.faults) or "none"
            raise InputError(f"{key}: {shown(name)} is no fault class of {store.path}; known: {known}")
    if len(set(chosen)) < len(chosen):
        raise InputError(f"{key} = {shown(list(chosen))}: a class is named twice")
    return chosen
