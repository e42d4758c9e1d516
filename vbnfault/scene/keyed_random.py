"""Make random numbers that are keyed by what they are for, and so do not depend on the order of execution."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from ..core import hashing


def rng(seed: int, sample: int, stage: str, name: str) -> np.random.Generator:
    """Return the generator keyed by (seed, sample, stage, name), independent of the order of execution.

    Without one of the faults, or with the samples in another order, every other draw stays the same.
    """
    key = hashlib.sha256(f"{seed}\0{sample}\0{stage}\0{name}".encode()).digest()
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(list(np.frombuffer(key, np.uint32)))))


def keyed_uniform(seed: int, samples: NDArray[np.int64], stage: str, name: str) -> NDArray[np.float64]:
    """Return uniform numbers in [0, 1), float64[n], each keyed by (seed, its sample, stage, name).

    This is the vectorised counterpart of `rng` for one number per sample. It mixes the sample's number twice,
    offset by a hash of the other keys.
    """
    start = int.from_bytes(hashlib.sha256(f"{seed}\0{stage}\0{name}".encode()).digest()[:8], "little")
    key = np.asarray(samples).astype(np.uint64) * hashing.STEP + np.uint64(start)
    return hashing.uniform(hashing.mixed(hashing.mixed(key)))
