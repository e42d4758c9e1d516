"""Make random numbers that are keyed by what they are for, and so do not depend on the order of execution."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


def rng(seed: int, sample: int, stage: str, name: str) -> np.random.Generator:
    """Return the generator keyed by (seed, sample, stage, name), independent of the order of execution.

    Without one of the faults, or with the samples in another order, every other draw stays the same.
    """
    key = hashlib.sha256(f"{seed}\0{sample}\0{stage}\0{name}".encode()).digest()
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(list(np.frombuffer(key, np.uint32)))))


def keyed_uniform(seed: int, samples: NDArray[np.int64], stage: str, name: str) -> NDArray[np.float64]:
    """Return uniform numbers in [0, 1), float64[n], each keyed by (seed, its sample, stage, name).

    This is the vectorised counterpart of `rng` for one number per sample. It applies the splitmix64 finaliser
    (Steele et al. 2014, doi 10.1145/2660193.2660195) twice to the sample's number, offset by a hash of the other
    keys.
    """
    start = int.from_bytes(hashlib.sha256(f"{seed}\0{stage}\0{name}".encode()).digest()[:8], "little")
    x = np.asarray(samples).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(start)
    for _ in range(2):
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x ^= x >> np.uint64(31)
    return (x >> np.uint64(11)).astype(np.float64) * 2.0**-53
