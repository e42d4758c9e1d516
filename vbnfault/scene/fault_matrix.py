"""Draw the fault matrix of a block of samples, and distribute its rows over shards and splits.

The rows are balanced over the whole block, so that every site and every split holds every class where the counts
allow.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from . import aims, keyed_random
from .config import Scene
from .names import SUN_AVERTED, SUN_FACING

# Limits of the search for rows to exchange between splits: rows compared on each side, and exchanges.
_ROWS_COMPARED = 128
_MAX_EXCHANGES = 200


def draw_block(
    scene: Scene,
    classes: tuple[tuple[str, ...], frozenset[str]],
    block: tuple[int, int],
    shard: NDArray[np.int64],
    split: NDArray[np.uint8],
) -> tuple[NDArray[np.bool_], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the fault matrix bool[n, fault], the strata uint8[n] and, if the camera aims, the aims uint8[n].

    `classes` are the faults, and those of them that need the Sun. `block` is the number of the block and its first
    sample.
    """
    n = len(shard)
    faults, need_sun = classes
    number, start = block
    rng = keyed_random.rng(scene.dataset.seed, start, "plan", f"fault_matrix/{number}")
    make = fault_matrix_per_class if scene.plan.mode == "per_class" else fault_matrix_per_sample
    lo, hi = scene.plan.classes_per_sample
    spec = MatrixSpec(
        samples=n, faults=faults, fraction=scene.plan.faulty_fraction, sizes=(lo, hi), need_sun=need_sun
    )
    injected = make(spec, rng)
    towards_sun = int(_with_any(injected, faults, need_sun).sum())
    nominal = round(scene.plan.sun_facing_nominal_fraction * n)
    if scene.is_aimed:
        nominal = aims.samples_towards_sun(scene, n, towards_sun) - towards_sun
    if towards_sun + nominal > n:
        names = " or ".join(name for name in faults if name in need_sun)
        raise InputError(
            f"plan.sun_facing_nominal_fraction = {scene.plan.sun_facing_nominal_fraction:g}: with {names} in "
            f"{towards_sun} of {n} samples it must be at most {(n - towards_sun) / n:g}"
        )
    variants = scene.dataset.variants_per_view
    facing = variants * -(-(towards_sun + nominal) // variants)  # the samples of a view share its stratum
    stratum = np.full(n, SUN_AVERTED, dtype=np.uint8)
    stratum[:facing] = SUN_FACING
    views = np.arange(n)[:, None] if variants == 1 else _views_of_rows(injected, stratum, variants, rng)
    traits: NDArray[np.bool_] = np.any(_traits(injected, stratum)[views], axis=1)
    first = facing // variants if scene.plan.order == "sun_first" else 0
    places = [
        start + _dealt(traits[start:end], shard[::variants][start:end], split[::variants][start:end], rng)
        for start, end in ((0, first), (first, len(views)))
        if end > start
    ]
    views = views[np.concatenate(places)]
    order = views.ravel()
    stratum = stratum[order]
    aim = stratum[:0]
    if scene.is_aimed:
        aim = np.repeat(aims.deal(scene, stratum[::variants] == SUN_FACING, rng), variants)
    return injected[order], stratum, aim


def _traits(injected: NDArray[np.bool_], stratum: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return what every split should have of each row, bool[n, trait]: its stratum, its classes, or none."""
    return np.column_stack([stratum == SUN_FACING, injected, ~injected.any(axis=1)])


def _in_order_of_traits(traits: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the rows sorted by their traits, and at random among equal ones, int64[n]."""
    bits = np.uint64(1) << np.arange(traits.shape[1], dtype=np.uint64)[::-1]
    kind = (traits * bits).sum(axis=1, dtype=np.uint64)
    return np.lexsort((rng.random(len(traits)), kind))


def _views_of_rows(
    injected: NDArray[np.bool_], stratum: NDArray[np.uint8], variants: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return the rows of the fault matrix that share a view, int64[view, variant].

    The samples of a view have one stratum, and faults as different as possible.
    """
    line = _in_order_of_traits(_traits(injected, stratum), rng)
    views = [
        line[stratum[line] == which].reshape(variants, -1).T  # neighbours in the line come into different views
        for which in (SUN_FACING, SUN_AVERTED)
    ]
    return np.asarray(rng.permuted(np.concatenate(views), axis=1))


def _with_any(matrix: NDArray[np.bool_], faults: Sequence[str], wanted: Collection[str]) -> NDArray[np.bool_]:
    """Return which rows of a fault matrix bool[n, fault] hold one of the classes `wanted`, bool[n]."""
    return np.asarray(matrix[:, [name in wanted for name in faults]].any(axis=1))


@dataclass(frozen=True, kw_only=True)
class MatrixSpec:
    """Describe a fault matrix: how many samples have which faults.

    Attributes
    ----------
    samples
        Number of samples n.
    faults
        The classes, one for each column of the fault matrix.
    fraction
        Fraction p, in [0, 1], of the samples that have a class (`fault_matrix_per_class`), or that have at least
        one class (`fault_matrix_per_sample`).
    sizes
        Least and greatest number of classes in a faulty sample; only `fault_matrix_per_sample` uses it.
    need_sun
        Classes that need the Sun in view; their samples come first.
    """

    samples: int
    faults: tuple[str, ...]
    fraction: float
    sizes: tuple[int, int] = (1, 6)
    need_sun: Collection[str] = ()


def fault_matrix_per_class(spec: MatrixSpec, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return bool[n, fault] with every class in exactly round(p·n) rows."""
    n, count = spec.samples, round(spec.fraction * spec.samples)
    matrix = np.zeros((n, len(spec.faults)), dtype=bool)
    first = next((name for name in spec.faults if name in spec.need_sun), None)
    for f, name in enumerate(spec.faults):
        rows = np.arange(count) if name == first else rng.permutation(n)[:count]
        matrix[rows, f] = True
    return matrix[np.argsort(~_with_any(matrix, spec.faults, spec.need_sun), kind="stable")]


def fault_matrix_per_sample(spec: MatrixSpec, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return bool[n, fault] with exactly round(p·n) faulty rows, each with a non-empty subset of the classes.

    Subset sizes are uniform in `sizes` (at most the number of classes). All subsets of one size have the same
    probability, until some are changed so that the counts of any two classes differ by at most one.
    """
    n, classes = spec.samples, len(spec.faults)
    matrix = np.zeros((n, classes), dtype=bool)
    faulty = round(spec.fraction * n)
    if classes == 0 or faulty == 0:
        return matrix
    lo, hi = (min(s, classes) for s in spec.sizes)
    size = rng.integers(lo, hi, faulty, endpoint=True)
    # the classes with the `size` smallest random keys are a random subset of that size
    rank = np.argsort(np.argsort(rng.random((faulty, classes), dtype=np.float32), axis=1), axis=1)
    rows = rank < size[:, None]
    _level(rows, rng)
    first = _with_any(rows, spec.faults, spec.need_sun)
    towards_sun = int(first.sum())
    matrix[:towards_sun] = rows[first]
    others = towards_sun + rng.permutation(n - towards_sun)[: faulty - towards_sun]
    matrix[others] = rows[~first]
    return matrix


def _level(rows: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Exchange classes in random rows until the counts of any two classes differ by at most one; in place."""
    classes = rows.shape[1]
    count = rows.sum(axis=0)
    each, extra = divmod(int(count.sum()), classes)
    wanted = np.full(classes, each)
    wanted[rng.permutation(classes)[:extra]] += 1
    while (count != wanted).any():
        most, least = int(np.argmax(count - wanted)), int(np.argmin(count - wanted))
        number = min(count[most] - wanted[most], wanted[least] - count[least])
        # There are enough rows with `most` and without `least`: at least as many as the difference of the two
        # counts, which is at least excess + lack - 1, and so at least `number`.
        chosen = rng.permutation(np.flatnonzero(rows[:, most] & ~rows[:, least]))[:number]
        rows[chosen, most], rows[chosen, least] = False, True
        count[most] -= number
        count[least] += number


def _dealt(
    traits: NDArray[np.bool_],
    shard: NDArray[np.int64],
    split: NDArray[np.uint8],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Return which row of bool[n, trait] each place of a block takes, int64[n].

    A row is a row of the fault matrix, or those of a view together. The rows are sorted by their traits and
    distributed over the shards, one row per shard and round. Then rows are exchanged between splits where a split
    lacks a trait that the block has often enough.
    """
    n = len(shard)
    line = _in_order_of_traits(traits, rng)
    turn = np.arange(n) - np.searchsorted(shard, shard, side="left")
    order = np.empty(n, dtype=np.int64)
    order[np.lexsort((rng.random(n), turn))] = line
    present = np.unique(split)
    enough = traits.sum(axis=0) >= len(present)
    for _ in range(_MAX_EXCHANGES):
        pair = _exchange(traits[order], split, present, enough)
        if pair is None:
            break
        order[list(pair)] = order[list(pair[::-1])]
    return order


def _exchange(
    traits: NDArray[np.bool_], split: NDArray[np.uint8], present: NDArray[np.uint8], enough: NDArray[np.bool_]
) -> tuple[int, int] | None:
    """Return two samples whose exchange leaves fewer (split, trait) pairs empty, or None without such samples."""
    count = np.stack([traits[split == s].sum(axis=0) for s in present])
    for s, trait in np.argwhere((count == 0) & enough):
        mine = np.flatnonzero(split == present[s])[:_ROWS_COMPARED]
        theirs = np.flatnonzero((split != present[s]) & traits[:, trait])[:_ROWS_COMPARED]
        gain = traits[theirs][None].astype(int) - traits[mine][:, None]  # what split s would gain
        other = np.searchsorted(present, split[theirs])
        after = [count[s] + gain, count[other][None] - gain]
        before = [np.broadcast_to(count[s], gain.shape), np.broadcast_to(count[other][None], gain.shape)]
        change = sum(
            ((a[..., enough] == 0).sum(axis=-1) - (b[..., enough] == 0).sum(axis=-1))
            for a, b in zip(after, before, strict=True)
        )
        a, b = np.unravel_index(np.argmin(change), change.shape)
        if change[a, b] < 0:
            return int(mine[a]), int(theirs[b])
    return None
