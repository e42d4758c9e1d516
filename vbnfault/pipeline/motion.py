"""Expose a view while the camera moves: spread its light along the paths of the ground over the image.

The view is rendered once, at the middle of each pixel's exposure, and its light is carried along: that of the cells
of pixels, so that no interpolation blurs it. New rays, spread over the exposure, go only where ground appears or
hides: at steps of the motion, and at the border of the frame.

The light of every piece of ground stays that of mid-exposure. A body of few pixels moves as its middle does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core.quantities import BODY, SPACECRAFT, FineLight, Radiance, Truth
from ..render.description import CameraMotion, RenderInput, View
from .noise_budget import green_per_second, sensor_noise_e
from .spec import Rendering, SampleSpec, SceneExposure, SceneLight

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_PX = 0.02  # of motion that is seen
_STEPS_PER_PX = 4.0  # of the light of cells; that of whole pixels, whose colours are taken, has one
_STEPS = (16, 1024)
_FINE_PX = 5.0  # a longer path needs half as many steps for each further pixel
_STRIP_PX = 128  # rows of pixels whose cells are carried at a time
_ROUNDS = 2  # in which the place is found from which light comes
_POINTS = 1 << 20  # of fine light that is spread along its paths, at most
_GOLDEN = 0.5 * (5**0.5 - 1)  # multiples of it, without their whole parts, spread evenly
# Pixels whose paths depart by more than this from those around, up to either end, may hide one another.
_APART_PX, _APART_OF_LENGTH = 0.12, 0.02
_FARTHEST_PX = 64  # from such a step, within which pixels get new rays
# New rays come to 0.6 of all samples of the view, or to 32 for each of its pixels if that is more. A noisy pixel
# gets from 16 to 1024 of them.
_NEW_RAYS, _LEAST_RAYS_PER_PX, _SAMPLES = 0.6, 32, (16, 1024)
_SURELY = 0.5  # of the noise allowed, below which a quarter of the rays will do: two halves of them tell little
# Where the first and the last line are: direction in which pixels are exposed one after the other, x and y.
_LATER = {"up": (0, 1), "down": (0, -1), "left": (1, 0), "right": (-1, 0)}


def motion_of(spec: SampleSpec) -> CameraMotion | None:
    """Return how the camera of a sample moves over its ground; None if it stands still."""
    table, flown = spec.scene.motion, spec.flown
    if table is None or flown is None or not (flown.velocity_T_m_s.any() or flown.rate_C_rad_s.any()):
        return None
    return CameraMotion(
        velocity_L_m_s=spec.terrain.site.T_from_L.T @ flown.velocity_T_m_s,
        rate_C_rad_s=flown.rate_C_rad_s,
        line_s=table.line_time_s * np.array(_LATER[spec.camera.readout_direction], float),
    )


def move(spec: SampleSpec, rendering: Rendering, exposure: SceneExposure) -> SceneExposure:
    """Return the exposure with the light of a camera that moves; without motion it is returned as it is."""
    view, light = rendering.scene.view, exposure.light.rendered
    if view.motion is None or rendering.cells is None or rendering.direct is None:
        return exposure
    seconds = exposure.camera.exposure_s
    truth = rendering.truth
    if exposure.light.lens.resamples:
        from .. import render

        truth = render.truth(spec.terrain.surface, view, rendering.scene.sun)
    paths = Paths.of(view, truth, seconds)
    if paths.length_px < _LEAST_PX:
        return exposure
    weights = green_per_second(spec)
    white = float(rendering.scene.sun.irradiance_W_m2_nm @ weights) / np.pi
    moved = _carried(light, rendering.cells, white, weights, paths)
    appearing = paths.appearing(truth)
    if appearing.any() and rendering.shows_ground:
        # light between surfaces, of a coma and of air is smooth: it is carried everywhere
        rest = _without_fine(light) - (rendering.direct if light.sun is None else rendering.direct - light.sun)
        moved[:, appearing] = _coloured(rest, paths)[:, appearing]
        wanted = max(_NEW_RAYS * rendering.samples_per_pixel, _LEAST_RAYS_PER_PX) / appearing.mean()
        _trace(spec, rendering.scene, appearing, moved, weights, seconds, wanted)
    if light.fine is not None:
        fine = _swept(light.fine, view, seconds)
        light, moved = replace(light, fine=fine), fine.added_to(moved)
    radiance = light.with_array(moved)
    if light.sun is not None:
        beyond = replace(truth, depth_m=np.full_like(truth.depth_m, np.inf), semantic=np.zeros_like(truth.semantic))
        sun = _coloured(light.sun, Paths.of(view, beyond, seconds), _STEPS_PER_PX)
        radiance = replace(light.with_array(moved + sun), sun=sun, disc=None)  # the disc is no longer round
    lit = SceneLight(lens=exposure.light.lens, rendered=radiance)
    return replace(exposure, light=lit, rate=exposure.camera.expose(radiance, 1.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Paths:
    """Hold the paths over the image of what each pixel sees at the middle of its exposure.

    Attributes
    ----------
    speed_px_s, bend_px_s2
        float32[y, x, 2]: after t seconds, it is at speed · t + bend · t² from its pixel's centre.
    exposure_s
        Time over which pixels are exposed, from half of it before to half of it after.
    line_s
        By how much later a pixel is exposed than its left and its upper neighbour.
    is_ground
        bool[y, x]: pixels that see ground.
    """

    speed_px_s: F32
    bend_px_s2: F32
    exposure_s: float
    line_s: F64
    is_ground: Mask

    @classmethod
    def of(cls, view: View, truth: Truth, exposure_s: float) -> Paths:
        """Return the paths of the ground and of the sky. What belongs to the camera, the spacecraft, stays."""
        assert view.motion is not None
        row, column = np.mgrid[0 : view.height_px, 0 : view.width_px] + 0.5
        x, y, z = np.broadcast_arrays(*view.rays_C(column, row))
        towards = np.stack([x, y, z], axis=-1)
        far = ~np.isfinite(truth.depth_m) | (np.abs(z) < 1e-6)
        range_m = np.where(far, 1.0, truth.depth_m / np.where(far, 1.0, z))
        velocity_C = view.L_from_C.T @ view.motion.velocity_L_m_s * ~far[..., None]

        def shift_px(time_s: float) -> F64:
            """Return how far everything is from its pixel at a time, float64[y, x, 2]."""
            turn = Rotation.from_rotvec(-view.motion.rate_C_rad_s * time_s).as_matrix()  # type: ignore[union-attr]
            now = (towards * range_m[..., None] - velocity_C * time_s) @ turn.T
            return view.pixel_map.pixel_of(now) - np.stack([column, row], axis=-1)

        half_s = exposure_s / 2
        before, after = shift_px(-half_s), shift_px(half_s)
        stays = (truth.semantic == SPACECRAFT)[..., None] | ~np.isfinite(before + after)
        speed, bend = (after - before) / exposure_s, (after + before) / (2 * half_s**2)
        return cls(
            speed_px_s=np.where(stays, 0, speed).astype(np.float32),
            bend_px_s2=np.where(stays, 0, bend).astype(np.float32),
            exposure_s=exposure_s,
            line_s=view.motion.line_s,
            is_ground=truth.semantic == BODY,
        )

    @cached_property
    def length_px(self) -> float:
        """Return the length of nearly the longest path over the exposure, of the frame or of the ground in it."""
        speed = np.hypot(*np.moveaxis(self.speed_px_s, -1, 0))
        ground = speed[self.is_ground]
        longest = np.percentile(speed, 99.9), np.percentile(ground, 90) if len(ground) else 0.0
        return float(max(longest)) * self.exposure_s

    def sources(self, time_s: float, rows: slice = slice(None)) -> F32:
        """Return the places from which the pixels of some rows get their light, float32[y, x, 2].

        It is that of `time_s` after the middle of the pixel's exposure, as if ground beyond the rows moved as that
        at their border. The last axis is column and row, counted from the middle of the first pixel of these rows.
        """
        speed, bend = self.speed_px_s[rows], self.bend_px_s2[rows]
        here = _places(*speed.shape[:2])
        at = shift = cv2.addWeighted(speed, time_s, bend, time_s**2, 0)
        for _ in range(_ROUNDS):
            if self.line_s.any():  # the source was seen at the time of its own line
                since_s = (time_s + at @ self.line_s).astype(np.float32)[..., None]
                shift = speed * since_s + bend * since_s**2
            at = _looked_up(shift, here - at)
        return here - at

    def reach(self, rows: slice) -> slice:
        """Return the rows that the light of some rows comes from, with a margin."""
        height, half_s = len(self.speed_px_s), self.exposure_s / 2
        speed, bend = np.abs(self.speed_px_s[rows, :, 1]).max(), np.abs(self.bend_px_s2[rows, :, 1]).max()
        most = int(1.2 * (speed * half_s + bend * half_s**2)) + 3
        return slice(max(rows.start - most, 0), min(rows.stop + most, height))

    def times_s(self, per_px: float) -> Sequence[float]:
        """Return times at the middles of equal parts of the exposure, so many for a pixel of motion."""
        length_px = min(self.length_px, _FINE_PX + (self.length_px - _FINE_PX) / 2)
        least, most = (int(np.ceil(n * per_px / _STEPS_PER_PX)) for n in _STEPS)
        count = int(np.clip(np.ceil(per_px * length_px) + 1, least, most))
        return (((np.arange(count) + 0.5) / count - 0.5) * self.exposure_s).tolist()

    def appearing(self, truth: Truth) -> Mask:
        """Return the pixels in whose exposure ground appears or hides, bool[y, x], not near a spacecraft."""
        half = self.speed_px_s * np.float32(self.exposure_s / 2)
        height, width = half.shape[:2]
        row, column = np.mgrid[0:height, 0:width] + 0.5
        outside = np.zeros((height, width), bool)
        for sign in (-1, 1):
            x, y = column + sign * half[..., 0], row + sign * half[..., 1]
            seen = 0.5 - _LEAST_PX  # from the border: a pixel nearer gets light from beyond it
            outside |= (x < seen) | (x > width - seen) | (y < seen) | (y > height - seen)
        # on a slope, paths change evenly; at a step, they depart from the mean of those around
        step = np.hypot(*np.moveaxis(half - cv2.blur(half, (3, 3)), -1, 0))
        reach = 2 * min(int(np.ceil(self.length_px / 2)) + 1, _FARTHEST_PX) + 1
        wide = np.ones((reach, reach), np.uint8)
        vehicle = cv2.dilate((truth.semantic == SPACECRAFT).astype(np.uint8), wide) > 0
        return (
            outside
            | (cv2.dilate((step > _APART_PX + _APART_OF_LENGTH * self.length_px).astype(np.uint8), wide) > 0)
        ) & ~vehicle


@lru_cache(maxsize=2)
def _places(height: int, width: int) -> F32:
    """Return column and row of each pixel, float32[y, x, 2]."""
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    return np.stack([column, row], axis=-1)


def _looked_up(array: F32, place: F32) -> F32:
    """Return values at columns and rows, float32[y, x, 2]; beyond the border they are those at the border."""
    return np.asarray(cv2.remap(array, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _carried(light: Radiance, cells: NDArray[np.float16], white: float, weights: F64, paths: Paths) -> F32:
    """Return the light of a view carried along its paths, float32[band, y, x], without Sun and fine light.

    `cells` float16[y·n, x·n] is the signal over `white` of n × n cells of each pixel, where `weights` are those of
    the bands. They say how light varies, and the bands of whole pixels which colour it has.
    """
    array = _without_fine(light)
    height, width = array.shape[1:]
    side = cells.shape[0] // height
    signal = np.einsum("b,byx->yx", weights, array).astype(np.float32)
    times = paths.times_s(_STEPS_PER_PX)
    moved = np.zeros((height, width), np.float32)
    for start in range(0, height, _STRIP_PX):
        rows = slice(start, start + _STRIP_PX)
        seen = paths.reach(rows)
        fine = _of_pixels_at(cells[seen.start * side : seen.stop * side], white, signal[seen], side)
        inner = slice(start - seen.start, start - seen.start + len(moved[rows]))
        for time_s in times:
            moved[rows] += _looked_up(fine, paths.sources(time_s, seen)[inner] * side)
    moved /= len(times)
    *bands, total = _coloured(np.concatenate([array, signal[None]]), paths)
    factor = np.where(total > 0, moved / np.maximum(total, 1e-30), 1)
    return np.stack(bands) * factor


def _of_pixels_at(cells: NDArray[np.float16], white: float, signal: F32, side: int) -> F32:
    """Return the mean signal over a pixel whose upper left corner is at each cell, float32[y·n, x·n].

    `signal` float32[y, x] is that of the pixels themselves. That samples count for all of their cell is a blur by a
    box of width h, which adds h²/24 times the second derivative.
    """
    direct = cells.astype(np.float32) * np.float32(white)
    between_surfaces = signal - cv2.resize(direct, signal.shape[::-1], interpolation=cv2.INTER_AREA)
    direct += np.repeat(np.repeat(between_surfaces, side, axis=0), side, axis=1)
    fine = cv2.boxFilter(direct, -1, (side, side), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    if side > 1:
        fine = np.maximum(fine - cv2.Laplacian(fine, -1, borderType=cv2.BORDER_REPLICATE) / 24, 0)
    return np.asarray(fine)


def _without_fine(light: Radiance) -> F32:
    """Return radiance float32[band, y, x] without the Sun and without fine light."""
    array = light.array if light.sun is None else light.array - light.sun
    return array if light.fine is None else light.fine.removed_from(array)


def _swept(fine: FineLight, view: View, exposure_s: float) -> FineLight:
    """Return fine light spread along its paths over the exposure; that of the spacecraft stays."""
    count, half_s = len(fine.slopes), np.full(len(fine.slopes), exposure_s / 2)
    if not count:
        return fine
    path = view.seen_later(fine.slopes, fine.depth_m, half_s) - view.seen_later(fine.slopes, fine.depth_m, -half_s)
    length_px = float(np.hypot(*(path * view.intrinsics[:2]).T).max())
    steps = int(np.clip(np.ceil(_STEPS_PER_PX * length_px) + 1, 1, max(_POINTS // count, 1)))
    # points that lie in one pixel are there at different times, so that their paths are even
    part = (np.arange(steps)[:, None] + np.arange(count) * _GOLDEN % 1) / steps - 0.5
    time_s = part * exposure_s * view.stretch(fine.slopes, fine.depth_m)
    before, depth_m = np.tile(fine.slopes, (steps, 1)), np.tile(fine.depth_m, steps)
    after = view.seen_later(before, depth_m, time_s.ravel())
    # irradiance across the line of sight is kept, and a pixel of a pinhole sees cos³θ / (fx fy)
    secant2, before2 = (1 + (slopes**2).sum(axis=1) for slopes in (after, before))
    return FineLight.of(
        slopes=after,
        area_px=view.intrinsics[:2].prod() * secant2**1.5 * np.sqrt(before2) / steps,
        radiance=np.tile(fine.power, steps),
        depth_m=depth_m,
        side_px=np.tile(fine.side_px, steps),
        intrinsics=view.intrinsics,
        shape=(view.height_px, view.width_px),
        projection=view.projection,
    )


def _coloured(planes: F32, paths: Paths, steps_per_px: float = 1.0) -> F32:
    """Return planes of whole pixels carried along their paths, float32[plane, y, x]."""
    out = np.zeros_like(planes)
    times = paths.times_s(steps_per_px)
    for time_s in times:
        place = paths.sources(time_s)
        for plane, moved in zip(planes, out, strict=True):
            moved += _looked_up(plane, place)
    return np.asarray(out / np.float32(len(times)))


def _trace(
    spec: SampleSpec, scene: RenderInput, where: Mask, moved: F32, weights: F64, exposure_s: float, wanted: float
) -> None:
    """Add to some pixels, bool[y, x], the sunlight on rays that are spread over the exposure, in place.

    A quarter of the rays shows which pixels need them all, or four times as many where the scene allows it.
    """
    from .. import render

    table, rest = spec.scene.render, moved[:, where]
    samples = 1 << int(np.log2(np.clip(wanted, *_SAMPLES)))
    more = max(samples, min(4 * samples, table.max_samples_per_pixel))
    for again, count in enumerate((samples,) if table.noise_fraction is None else (samples // 4, more)):
        pixels = np.flatnonzero(where).astype(np.uint32)
        light, signal, error = render.direct_in_cells(
            spec.terrain.surface,
            replace(scene, key=(scene.key ^ (0x2545F491 + again)) & 0xFFFFFFFF),
            weights * exposure_s,
            render.Cells(pixel=pixels, cell=np.zeros_like(pixels), side=1),
            count,
            exposure_s,
        )
        moved[:, where] = np.maximum(rest + light, 0)
        if table.noise_fraction is None:
            break
        variance = np.zeros(where.shape, np.float32)
        variance[where] = (error / sensor_noise_e(spec.camera, signal, exposure_s)) ** 2
        mean = cv2.blur(variance, (3, 3)) / np.maximum(cv2.blur(where.astype(np.float32), (3, 3)), 1e-6)
        noisy = where & (mean > (_SURELY * table.noise_fraction) ** 2)
        if not noisy.any():
            break
        rest, where = rest[:, noisy[where]], noisy
