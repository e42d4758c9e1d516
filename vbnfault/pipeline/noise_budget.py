"""Render with as many samples as the sensor's noise asks for.

The first samples of all pixels show where light varies within a pixel, cell by cell. Pixels whose error would show
above the sensor's own noise are rendered again: one sample in each cell in which light hardly varies, and many in
those that an edge crosses. New samples are drawn each time, because the earlier ones chose the pixels and the
cells, so keeping them would be a bias.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.quantities import FineLight, Radiance, Truth
from ..render.description import RenderInput
from ..world import ephemeris
from .exposure import foreseen_exposure_s, limited, rate_on_axis
from .spec import SampleSpec

if TYPE_CHECKING:
    from ..render import Cells, Sampled

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fraction of the full well above which a pixel counts as lit when sampling noise is measured.
_LIT_FRACTION = 0.01
# Fraction of the lit pixels that may keep more sampling noise than the scene allows.
_NOISY_FRACTION = 0.01
# Most rounds of samples in cells. A third changes few pixels.
_ROUNDS = 3
# Variance aimed at, over that allowed: few pixels then need another round.
_AIM = 0.65
# Noise over that allowed at which the range of its samples alone is a reason to render a pixel again.
_SURELY = 1.5
# A pixel is rendered again if it gets this many times its samples.
_WORTH = 1.2
# Octaves by which the number of samples of a cell may be rounded down to a power of two.
_DOWN = 0.25
# Cells whose light is held at once; all of a frame would take 200 MB.
_CELLS_AT_ONCE = 1 << 20
# Least number of cells across a frame that OpenCV takes no more.
_MOST_CELLS = 1 << 15
# Rows of pixels whose samples are compared with their neighbours at a time, to bound memory.
_STRIP = 64
_ROWS = 1 << 15  # pixels whose squared ranges are summed at a time
_THREADS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledRadiance:
    """Hold a rendered radiance with its number of samples, its noise, cells and direct light, as in `Rendering`."""

    radiance: Radiance
    samples_per_pixel: float
    noise_fraction_p99: float = float("nan")
    cells: NDArray[np.float16] | None = None
    direct: F32 | None = None


def sample_to_noise(
    spec: SampleSpec,
    scene: RenderInput,
    truth: Truth,
    guide: Truth | None,
    fraction: float,
    body: tuple[FineLight, F32] | None = None,
) -> SampledRadiance:
    """Render with more samples where sampling noise would show: above `fraction` of the sensor's own noise.

    The error of a pixel comes at first from two halves of its samples, averaged over 3×3 pixels. Where it is too
    large, the cells of the pixel get as many samples as the variation of light in each of them asks for. This is
    done again for pixels that need still more, at most `_ROUNDS` times, until at most 1 % of the lit pixels are
    left. All of it follows from scene and sample, so the result does not depend on how a build runs.

    `body` is the light of a body of few pixels, which is added, with its error float32[y, x] as in `Sampled`.
    """
    from .. import render

    camera, electron_rate = spec.camera, green_per_second(spec)
    sampled = render.direct_by_sample(spec.terrain.surface, scene, electron_rate)
    indirect = None
    if guide is not None and scene.bounces:
        indirect = render.indirect(spec.terrain.surface, scene, guide)
    fine = render.thin_parts(spec.terrain.surface, scene)
    if body is not None:
        fine = body[0].joined(fine)
        sampled = replace(sampled, error=sampled.error + body[1])
    if fine is not None:
        indirect = fine.added_to(np.zeros_like(sampled.radiance.array) if indirect is None else indirect)
    light = sampled.radiance.array.copy() if indirect is None else sampled.radiance.array + indirect
    whole = replace(sampled.radiance, array=light.view(), fine=fine)
    sampled = replace(sampled, radiance=whole)  # a copy in all bands takes 37 MB for a frame of 1024 pixels
    exposure = foreseen_exposure_s(limited(spec.scene, scene), camera, truth, scene.view, whole)
    exposure *= 2 ** max(spec.scene.camera.exposure_stops[1], 0.0)  # the longest of the samples of the view
    signal_e = np.einsum("b,byx->yx", electron_rate * exposure, whole.array)
    detector = camera.detector
    sensor_e = sensor_noise_e(camera, signal_e, exposure)
    # dark pixels and saturated pixels do not show this noise; saturated pixels still count as lit
    lit = signal_e > _LIT_FRACTION * detector.full_well_e
    shows = lit & (signal_e - 4 * np.abs(sampled.error) * exposure < detector.full_well_e)
    near = cv2.dilate(shows.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    refined = _Refined(
        spec=spec,
        scene=scene,
        signal=electron_rate * exposure,
        sensor_e=sensor_e.astype(np.float32),
        sampled=sampled,
        array=light,
        indirect=indirect,
        exposure_s=exposure,
    )

    def is_over(now: F32) -> bool:
        """Return whether too many lit pixels have too much noise."""
        over = np.count_nonzero((now > fraction) & shows)
        return bool(over > _NOISY_FRACTION * np.count_nonzero(lit))

    now = refined.noise(near)
    for k in range(_ROUNDS):
        if not is_over(now):
            break
        refined.refine(now > fraction, near, fraction, is_last=k == _ROUNDS - 1)
        now = refined.noise(near)
    return SampledRadiance(
        radiance=whole,  # its array is that which `refine` has changed
        samples_per_pixel=float(refined.used.mean()),
        noise_fraction_p99=float(np.percentile(np.where(shows, now, 0)[lit], 99)) if lit.any() else 0.0,
        cells=None if scene.view.motion is None else refined.cells(),
        direct=None if scene.view.motion is None else light if indirect is None else light - indirect,
    )


class _Refined:
    """Hold the light of a view while pixels are rendered again with more samples, which change it in place.

    Attributes
    ----------
    variance
        float32[y, x]: an estimate of the variance of each pixel, in units of the sensor's.
    used
        float32[y, x]: number of samples of each pixel.
    by_cells
        bool[y, x]: pixels that were rendered again, cell by cell.
    """

    def __init__(
        self,
        *,
        spec: SampleSpec,
        scene: RenderInput,
        signal: F64,
        sensor_e: F32,
        sampled: Sampled,
        array: F32,
        indirect: F32 | None,
        exposure_s: float,
    ) -> None:
        self._scene, self._surface, self._signal = scene, spec.terrain.surface, signal
        self._sensor_e, self._sun = sensor_e, sampled.radiance.sun
        self._most = spec.scene.render.max_samples_per_pixel
        self._samples = samples = sampled.samples
        self._of_cells = None if scene.view.motion is None else samples[..., None]
        self._white_e = float(scene.sun.irradiance_W_m2_nm @ signal) / np.pi
        self._array, self._indirect = array, indirect
        self.variance = (sampled.error * (exposure_s / sensor_e)) ** 2
        height, width = self._array.shape[1:]
        cells = samples.shape[1]
        self.used = np.full((height, width), float(cells), dtype=np.float32)
        self.by_cells = np.zeros((height, width), dtype=bool)
        self._rounds = 0
        self._range = _ranges(samples, (height, width))
        # Variance of a pixel with one sample in each cell. The square of the range is proportional to it; `refine`
        # finds the factor.
        square = _square_sums(self._range) / cells**2
        self._single = square.reshape(height, width) * (self._white_e / sensor_e) ** 2
        # what the later samples of a pixel leave of it
        self._left = np.ones_like(self._single)

    def cells(self) -> NDArray[np.float16]:
        """Return the signal of each cell of the pixels, as in `Rendering`, with quarters of the first cells."""
        assert self._of_cells is not None
        height, width = self.used.shape
        side, parts = (round(n**0.5) for n in self._of_cells.shape[1:])
        of_pixels = self._of_cells.reshape(height, width, side, side, parts, parts)
        cells = of_pixels.transpose(0, 2, 4, 1, 3, 5).reshape(height * side * parts, width * side * parts)
        while cells.shape[1] >= _MOST_CELLS:
            cells = cells.reshape(len(cells) // 2, 2, -1, 2).mean(axis=(1, 3), dtype=np.float32).astype(np.float16)
        return cells

    def _next(self, samples: int, use: int = 0) -> RenderInput:
        """Return the scene with a number of samples, and with random numbers that no earlier render had."""
        key = (self._scene.key + 0x9E3779B9 * (16 * self._rounds + use + 1)) & 0xFFFFFFFF
        return replace(self._scene, samples_per_pixel=samples, key=key)

    def noise(self, near: Mask) -> F32:
        """Return the noise of sampling over the sensor's, float32[y, x]; `near`: pixels that may be averaged."""
        # two halves tell little of a single pixel, so neighbours are averaged; cells tell enough
        by_halves = near & ~self.by_cells
        count = cv2.blur(by_halves.astype(np.float32), (3, 3))
        mean = cv2.blur(np.where(by_halves, self.variance, 0), (3, 3)) / np.maximum(count, 1e-6)
        return np.sqrt(np.where(self.by_cells, self.variance, np.maximum(mean, 0)))

    def refine(self, noisy: Mask, near: Mask, fraction: float, *, is_last: bool = False) -> None:
        """Render those of the noisy pixels again whose own variance is too large, if their noise shows (`near`).

        The last round takes up to twice the limit in a pixel: where most lit pixels lie at hard edges of shadows,
        the limit would otherwise leave more than `_NOISY_FRACTION` of them with too much noise. A cell takes no
        more than in the earlier rounds.
        """
        if not self._rounds:
            # the error over 3×3 pixels corrects what the ranges let expect
            measured, foreseen = (cv2.blur(v, (3, 3)) for v in (self.variance, self._single))
            self._single *= np.clip(measured / np.maximum(foreseen, 1e-12), 0.05, 20)
        self._single = np.where(self.by_cells, self.variance / self._left, self._single)
        goal = _AIM * fraction**2 / np.maximum(self._single, 1e-12)
        # halves may agree by chance where the range of the samples is large
        noisy = noisy | (self._single > (_SURELY * fraction) ** 2)
        pixels = np.flatnonzero(noisy & near & (goal < 1))
        squares = self._range[pixels].astype(np.float32) ** 2
        most, most_in_cell = self._most, self._most
        if is_last and squares.shape[1] > 1:
            most, most_in_cell = 2 * most, most // 2  # in earlier rounds no cell has more than half
        numbers = np.minimum(_allocated(squares, goal.ravel()[pixels], most), most_in_cell)
        more = numbers.sum(axis=1) > _WORTH * self.used.ravel()[pixels]
        pixels, squares, numbers = pixels[more], squares[more], numbers[more]
        self._rounds += 1
        light, variance = self._sampled(pixels.astype(np.uint32), numbers)
        if self._sun is not None:
            light += self._sun.reshape(len(light), -1)[:, pixels]
        if self._indirect is not None:
            light += self._indirect.reshape(len(light), -1)[:, pixels]
        self._array.reshape(len(light), -1)[:, pixels] = light
        self.variance.ravel()[pixels] = variance / self._sensor_e.ravel()[pixels] ** 2
        self.used.ravel()[pixels] = numbers.sum(axis=1)
        left = (squares * numbers**-1.5).sum(axis=1) / np.maximum(squares.sum(axis=1), 1e-30)
        self._left.ravel()[pixels] = left
        self.by_cells.ravel()[pixels] = True

    def _sampled(self, pixels: NDArray[np.uint32], numbers: NDArray[np.int32]) -> tuple[F32, F64]:
        """Return the radiance float32[band, pixel] with these numbers of samples in the cells, and its variance."""
        from .. import render

        count, cells = numbers.shape
        side = round(cells**0.5)
        if self._of_cells is not None and self._rounds == 1:  # now with the quarters of each cell
            self._of_cells = np.repeat(self._of_cells, 4, axis=2)
        total = np.zeros((len(self._array), count), dtype=np.float32)
        variance = np.zeros(count)
        for samples in np.unique(numbers).tolist():
            scene = self._next(cells * samples, samples.bit_length())
            for span in _spans(numbers == samples):
                owner, cell = np.nonzero(numbers[span] == samples)
                listed = render.Cells(pixel=pixels[span][owner], cell=cell.astype(np.uint32), side=side)
                light, signal, error = render.direct_in_cells(
                    self._surface, scene, self._signal, listed, samples, quarters=self._of_cells is not None
                )
                for band, values in zip(total[:, span], light, strict=True):
                    band += np.bincount(owner, values, len(band))
                if self._of_cells is not None:
                    self._of_cells[listed.pixel, listed.cell] = (signal / self._white_e).astype(np.float16)
                    signal = signal.mean(axis=1)
                variance[span] += self._variance(owner, listed, samples, signal, error, len(variance[span]))
        return total / cells, variance / cells**2

    def _variance(
        self, owner: NDArray[np.intp], listed: Cells, samples: int, signal: F32, error: F32, count: int
    ) -> F64:
        """Return the summed variances of cells, float64[pixel]; `owner` is the index of each cell's pixel."""
        cell, side = listed.cell, listed.side
        if samples == 1:
            # half the squared difference of two single samples is the variance of one
            before = self._samples[listed.pixel, cell].astype(np.float32)
            apart = np.abs(signal / self._white_e - before)
            known = self._range[listed.pixel, cell]
            self._range[listed.pixel, cell] = np.maximum(known, apart.astype(np.float16))
            return np.asarray(np.bincount(owner, (apart * self._white_e) ** 2 / 2, count), np.float64)
        if samples == 2:
            # the two halves of a cell lie side by side: alternating signs cancel what changes evenly
            sign = 1 - 2 * ((cell % side + cell // side) % 2).astype(np.int64)
            return np.asarray(np.bincount(owner, sign * error, count), np.float64) ** 2
        return np.asarray(np.bincount(owner, error.astype(np.float64) ** 2, count), np.float64)


def _spans(chosen: Mask) -> Iterator[slice]:
    """Yield ranges of pixels of which about `_CELLS_AT_ONCE` cells are chosen, given bool[pixel, cell].

    A pixel's cells stay together, so their sums do not depend on the ranges.
    """
    before = np.cumsum(chosen.sum(axis=1))
    start = 0
    while start < len(before):
        taken = int(before[start - 1]) if start else 0
        stop = max(start + 1, int(np.searchsorted(before, taken + _CELLS_AT_ONCE, side="right")))
        yield slice(start, stop)
        start = stop


def _ranges(samples: NDArray[np.float16], shape: tuple[int, int]) -> NDArray[np.float16]:
    """Return the range of each sample and its neighbours, also those of adjacent pixels, float16[pixel, cell]."""
    (height, width), side = shape, round(samples.shape[1] ** 0.5)
    out = np.empty((height, width, side, side), dtype=np.float16)
    by_row = samples.reshape(height, width, side, side)
    kernel = np.ones((3, 3), np.uint8)

    def of_strip(start: int) -> None:
        stop = min(start + _STRIP, height)
        low, high = max(start - 1, 0), min(stop + 1, height)
        grid = np.ascontiguousarray(by_row[low:high].transpose(0, 2, 1, 3), np.float32)
        grid = grid.reshape((high - low) * side, width * side)
        spread = cv2.dilate(grid, kernel) - cv2.erode(grid, kernel)
        spread = spread[(start - low) * side : (stop - low) * side].reshape(stop - start, side, width, side)
        out[start:stop] = spread.transpose(0, 2, 1, 3)

    with ThreadPoolExecutor(_THREADS) as pool:  # numpy and OpenCV use one core here
        list(pool.map(of_strip, range(0, height, _STRIP)))
    return out.reshape(height * width, side * side)


def _square_sums(values: NDArray[np.float16]) -> F32:
    """Return the sum of the squares of each row, float32[row]."""
    out = np.empty(len(values), np.float32)
    for start in range(0, len(values), _ROWS):  # as float32 the rows stay in the cache
        part = values[start : start + _ROWS].astype(np.float32)
        out[start : start + _ROWS] = np.einsum("pc,pc->p", part, part)
    return out


def _allocated(squares: F32, goal: F32, most: int) -> NDArray[np.int32]:
    """Return the number of samples of each cell, a power of two, int32[pixel, cell].

    Along an edge, the variance of a cell falls as its number of samples to the power of -3/2. The numbers with the
    least sum that bring the variance of the pixel to `goal` times that with one sample in each cell are then
    proportional to the power 2/5 of the cells' variances.

    Parameters
    ----------
    squares
        float32[pixel, cell]: variance of a single sample, in any unit.
    goal
        float32[pixel].
    most
        Greatest number of samples of a pixel with more than one sample in a cell, a power of two.
    """
    power = squares**0.4
    total = np.maximum(squares.sum(axis=1) * goal, 1e-30)
    wanted = power * ((power.sum(axis=1) / total) ** (2 / 3))[:, None]
    highest = most.bit_length() - 1

    def rounded(numbers: F32, down: float) -> NDArray[np.int32]:
        """Return powers of two from 1 to `most`, rounded down by at most `down` octaves."""
        level = np.clip(np.ceil(np.log2(np.maximum(numbers, 1)) - down), 0, highest)
        return np.left_shift(1, level.astype(np.int32)).astype(np.int32)

    numbers = rounded(wanted, _DOWN)
    sums = numbers.sum(axis=1)
    over = np.flatnonzero(sums > max(most, squares.shape[1]))
    # a cell of a pixel at its limit gets the part of the limit that it would have of the sum; rounding down leaves
    # up to half of the limit, which half an octave more often fills
    parts = numbers[over] * np.float32(most) / sums[over, None]
    numbers[over] = rounded(parts, 1.0)
    fuller = rounded(parts * np.float32(2**0.5), 1.0)
    fits = fuller.sum(axis=1) <= most
    numbers[over[fits]] = fuller[fits]
    return numbers


def sensor_noise_e(camera: Camera, signal_e: NDArray[Any], exposure_s: float) -> NDArray[Any]:
    """Return the noise of the sensor at a signal: that of light, of dark current and of the readout."""
    detector = camera.detector
    dark_e = detector.dark_current_e_s * exposure_s
    return np.asarray(np.sqrt(np.maximum(signal_e, 0) + dark_e + detector.read_noise_e_rms**2))


def green_per_second(spec: SampleSpec) -> F64:
    """Return electrons per second of green or of grey pixels for unit radiance in each band, float64[band]."""
    nodes = ephemeris.wavelengths_nm(spec.scene)
    unit = Radiance(array=np.eye(len(nodes), dtype=np.float32)[:, :, None], wavelength_nm=nodes)
    rates = rate_on_axis(spec.camera, unit).array[:, 0]
    return np.asarray(rates[:, min(1, rates.shape[1] - 1)], dtype=np.float64)
