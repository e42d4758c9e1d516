"""Sample cells of pixels, so that more rays go only where the light of a pixel varies.

A pixel is divided into square cells. Along an edge, of a shadow or of a stone, only the cells that the edge crosses
need many samples: their number grows as the side of the grid, not as its square.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .description import RenderInput
from .light import WAVEFRONT, Direct
from .runtime import dr, mi
from .sampling import Strata
from .surface import TerrainMesh

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Cells:
    """Select cells of a frame's pixels.

    Attributes
    ----------
    pixel
        uint32[n]: row-major numbers of pixels.
    cell
        uint32[n]: row-major numbers of the cells within their pixels.
    side
        Number of cells along each side of a pixel, a power of two.
    """

    pixel: NDArray[np.uint32]
    cell: NDArray[np.uint32]
    side: int

    def parts(self, most: int) -> Iterator[Cells]:
        """Yield the same cells in parts of at most `most`."""
        for start in range(0, len(self.pixel), most):
            part = slice(start, start + most)
            yield Cells(pixel=self.pixel[part], cell=self.cell[part], side=self.side)


def direct_in_cells(
    surface: TerrainMesh, scene: RenderInput, weights: NDArray[np.float64], cells: Cells, samples: int
) -> tuple[F32, F32, F32]:
    """Return the mean radiance of sunlight reflected once in each cell, its signal, and an estimate of its error.

    Parameters
    ----------
    weights
        float64[band]: weights of the bands in the signal.
    samples
        Number of samples of each cell, a power of two.

    Returns
    -------
    radiance
        float32[band, cell], without the Sun's disc itself.
    signal
        float32[cell].
    error
        float32[cell]: half the signed difference between the mean signals of two halves of the cell's samples; 0 if
        there is one sample.
    """
    return _InCells(surface, scene).means(cells, samples, weights)


class CellStrata(Strata):
    """Provide jittered strata of cells, each divided into `samples` of them."""

    def __init__(self, cells: Cells, samples: int, key: int, limb: tuple[float, ...] | None) -> None:
        bits = samples.bit_length() - 1
        # all numbers are opaque, so that one kernel serves any number of samples
        shift, last = dr.opaque(mi.UInt32, bits), dr.opaque(mi.UInt32, samples - 1)
        wavefront = dr.arange(mi.UInt32, len(cells.pixel) * samples)
        of = wavefront >> shift
        self.samples, self.limb = samples, limb
        self.pixel = dr.gather(mi.UInt32, mi.UInt32(cells.pixel), of)
        self._cell = dr.gather(mi.UInt32, mi.UInt32(cells.cell), of)
        self._number = self.pixel * (cells.side**2) + self._cell
        self.index = wavefront & last
        self._shift = shift
        self._key = dr.opaque(mi.UInt32, key & 0xFFFFFFFF)
        self._cells_side = cells.side
        across, down = (bits + 1) // 2, bits // 2
        self._across = dr.opaque(mi.UInt32, across)
        self._scale = [dr.opaque(mi.Float, 2.0**-n) for n in (across, down)]
        self._last_across = dr.opaque(mi.UInt32, (1 << across) - 1)

    def square(self, dimension: int = 0) -> tuple[Any, Any]:
        """Return a uniform point of each stratum of its cell in the unit square, x and y in [0, 1]."""
        u, v = self.jitter(dimension)
        x = (mi.Float(self.index & self._last_across) + u) * self._scale[0]
        y = (mi.Float(self.index >> self._across) + v) * self._scale[1]
        side = self._cells_side
        return (mi.Float(self._cell & (side - 1)) + x) / side, (
            mi.Float(self._cell >> (side.bit_length() - 1)) + y
        ) / side

    def jitter(self, dimension: int) -> tuple[Any, Any]:
        """Return two uniform numbers in [0, 1] per sample."""
        # a product with an odd number maps different indices to different numbers
        key = self._key ^ (0x9E3779B9 * dimension & 0xFFFFFFFF) ^ (self.index * 0x85EBCA77)
        u, v = mi.sample_tea_32(self._number, key, 4)
        return mi.Float(u) * 2.0**-32, mi.Float(v) * 2.0**-32

    def checkered(self) -> Any:
        """Return +1 and -1 as on a chessboard: two halves of the samples that each cover the cell."""
        parity = (self.index ^ (self.index >> self._across)) & 1
        return 1 - 2 * mi.Float(parity)


class _InCells(Direct):
    """Compute the light of cells."""

    def means(self, cells: Cells, samples: int, signal: NDArray[np.float64]) -> tuple[F32, F32, F32]:
        """Return the outputs of `direct_in_cells`."""
        weights = (self.weights / samples).astype(np.float32)
        limb = self.mean_limb(signal)
        count = len(cells.pixel)
        out = np.zeros((weights.shape[1], count), dtype=np.float32)
        seen, halves = np.zeros(count, dtype=np.float32), np.zeros(count, dtype=np.float32)
        factors = weights.astype(np.float64) @ signal
        done = 0
        for part in cells.parts(max(1, WAVEFRONT // (samples * len(weights)))):
            strata = CellStrata(part, samples, self.scene.key, limb)
            terms = self.terms(strata)
            total = self.signal(terms, factors)
            terms = [*terms, total, total * strata.checkered()]
            dr.eval(*terms)
            if samples > 1:
                terms = [dr.block_sum(term, samples) for term in terms]
                dr.eval(*terms)
            span = slice(done, done + len(part.pixel))
            done += len(part.pixel)
            for row, term in zip(weights, terms, strict=False):
                values = term.numpy()
                for band in np.flatnonzero(row):
                    out[band, span] += values * row[band]
            seen[span] = terms[-2].numpy()
            if samples > 1:
                halves[span] = terms[-1].numpy()
        return out, seen, halves
