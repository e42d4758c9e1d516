"""Compute the image of a coma: the sunlight that its dust scatters into every pixel.

In each pixel the integral of 1 / r² along the line of sight is exact, for the distance of the ground that the pixel
shows. It is multiplied by what varies slowly: the mean density along the line, the fraction of it in sunlight, and
the phase function. These are computed on coarse grids and interpolated. Lines to the sky share a grid of directions
around the direction to the body's centre, with steps that grow with the angle from it; lines that end at the ground
share a grid of pixels. Neither grid crosses the body's limb. A pixel at the limb is the mean of its lines, some of
which end at the ground. There are no random numbers.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..core.frames import unit
from ..core.quantities import BODY, SKY, SUN
from ..render.description import View
from .coma import Coma, Shadow

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Directions to the sky: steps of the angle from the centre, and turns about it.
_SKY_STEPS, _SKY_TURNS = 56, 288
_WRAPPED = 4  # turns that are repeated at both ends for the interpolation
# The sky has this many nodes across the frame, to which these directions are interpolated. Around the body's
# centre, where details are finer, every pixel is a node.
_SKY_NODES = 256
_FINE_STRIDES = 24
# The most nodes on the ground.
_GROUND_NODES = 6000
_PAD = 2  # nodes beyond the frame
# Around a body of few pixels, cells of the sky have at most this fraction of their distance from its centre, up to
# so many pixels from its close-up. The mean of 1 / b over a cell then differs from its middle by 0.3 % at most.
_CELL_FRACTION, _AROUND_PX = 1 / 4, 4
# Most of tan(ψ/2), where ψ is the angle from the centre: all directions beyond look away from it.
_MOST_TANGENT = 1e4


@dataclass(frozen=True, kw_only=True, eq=False)
class _Frame:
    """Hold a camera beside a coma.

    `camera_m` float64[3] is its position from the centre of the coma in L, `distance_m` the length of that.
    """

    coma: Coma
    shadow: Shadow | None
    view: View

    @cached_property
    def camera_m(self) -> F64:
        return np.asarray(self.view.position_L_m - self.coma.centre_L_m)

    @cached_property
    def distance_m(self) -> float:
        return max(float(np.linalg.norm(self.camera_m)), 1e-3)

    @cached_property
    def axes_L(self) -> F64:
        """Return two unit vectors at right angles to the direction to the centre, and this one, as rows.

        The first one points to the side of the boresight, so that turns are counted from there.
        """
        centre, boresight = -self.camera_m / self.distance_m, self.view.L_from_C[:, 2]
        beside = boresight - (boresight @ centre) * centre
        if np.linalg.norm(beside) < 1e-6:
            beside = np.cross(centre, np.eye(3)[np.argmin(np.abs(centre))])
        first = unit(beside)
        return np.stack([first, np.cross(centre, first), centre])

    def components(self, x_px: F64, y_px: F64) -> list[F32]:
        """Return the components along `axes_L` of unit vectors to image positions, float32, one array each.

        `x_px` and `y_px` are float64 of shapes that fit together.
        """
        x, y, z = self.view.rays_C(x_px, y_px)
        length = np.sqrt(z**2 + x**2 + y**2)
        axes_C = self.axes_L @ self.view.L_from_C
        return [(a * x + (b * y + c * z)).astype(np.float32) / length.astype(np.float32) for a, b, c in axes_C]

    def directions(self, x_px: F64, y_px: F64) -> F64:
        """Return unit vectors in L to image positions float64[n] each, float64[n, 3]."""
        x, y, z = self.view.rays_C(x_px, y_px)
        rays = np.stack(np.broadcast_arrays(x, y, z), axis=-1) @ self.view.L_from_C.T
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def light(self, directions: F64, length_m: F64) -> tuple[F64, F64]:
        """Return what `Coma.relative` returns, the light times the phase function."""
        light, dust = self.coma.relative(self.camera_m, directions, length_m, self.shadow)
        return np.asarray(light * self.coma.phase(directions @ self.coma.outflow.sun)), dust


class Haze(NamedTuple):
    """Hold the light of the dust in front of the scene, and how much dust there is.

    Attributes
    ----------
    radiance
        float32[y, x]: radiance over the Sun's irradiance at 550 nm, in 1/sr.
    optical_depth
        float32[y, x]: optical depth between the camera and the ground; 0 where there is no ground.
    """

    radiance: F32
    optical_depth: F32


@dataclass(frozen=True, kw_only=True, eq=False)
class Edges:
    """Hold what is seen within pixels that show more than one thing, such as those at the body's limb.

    Attributes
    ----------
    row, column
        int64[n]: the pixels.
    depth_m, semantic
        float32[n, line] and uint8[n, line]: as in `Truth`, of lines through even points of each pixel, row by row.
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    depth_m: F32
    semantic: NDArray[np.uint8]


def edge_positions_px(row: NDArray[np.int64], column: NDArray[np.int64], side: int) -> tuple[F64, F64]:
    """Return x and y of `side`² even points of pixels, float64[n, line] each."""
    down, right = np.divmod(np.arange(side * side), side)
    return column[:, None] + (right + 0.5) / side, row[:, None] + (down + 0.5) / side


def haze(
    coma: Coma,
    shadow: Shadow | None,
    view: View,
    depth_m: F32,
    semantic: NDArray[np.uint8],
    edges: Edges | None = None,
) -> Haze:
    """Return the light of the dust and its optical depth in every pixel.

    Parameters
    ----------
    coma
        The dust.
    shadow
        The body's shadow in it. None: there is none.
    view
        The camera.
    depth_m, semantic
        Depth along the boresight and class of what each pixel shows, as in `Truth`, on the grid of the view.
    edges
        Pixels that are the mean of several lines. None: each pixel has the line through its centre.
    """
    frame = _Frame(coma=coma, shadow=shadow, view=view)
    x_px, y_px = _positions_px(0, view.width_px), _positions_px(0, view.height_px)
    sky = _is_sky(semantic)
    first, second, cosine = frame.components(x_px[None, :], y_px[:, None])
    sine = np.maximum(np.sqrt(first * first + second * second), np.float32(1e-6))
    x, y, z = view.rays_C(x_px[None, :], y_px[:, None])
    length = np.where(sky, 0, depth_m) * (np.sqrt(z**2 + x**2 + y**2) / z).astype(np.float32)
    ground_near = ~sky
    if edges is not None:
        ground_near[edges.row, edges.column] = True
    rows, columns = (_bounds(np.any(ground_near, axis=axis)) for axis in (1, 0))
    part = (slice(*rows), slice(*columns))
    with ThreadPoolExecutor(2) as aside:  # numpy leaves the interpreter to others in the meantime
        towards_sky = aside.submit(_on_sky, frame, sky, sine, cosine)
        ground = aside.submit(_on_ground, frame, rows, columns, length[part], (semantic == BODY)[part])
        out = _columns(coma, frame.distance_m, sine, cosine, length, sky)
    light, dust = ground.result()
    optical_depth = np.zeros_like(out)
    optical_depth[part] = np.where(semantic[part] == BODY, out[part] * dust, 0) * np.float32(coma.cross_section_m)
    out *= np.where(sky, towards_sky.result(), 1)
    out[part] *= np.where(sky[part], 1, light)
    if edges is not None and len(edges.row):
        here, below = (edges.row, edges.column), (edges.row - rows[0], edges.column - columns[0])
        lines = _edge_columns(frame, edges)
        body = edges.semantic == BODY
        to_sky, to_ground = towards_sky.result()[here][:, None], light[below][:, None]
        out[here] = (lines * np.where(_is_sky(edges.semantic), to_sky, to_ground)).mean(axis=1)
        depth = (lines * body).sum(axis=1) / np.maximum(body.sum(axis=1), 1)
        optical_depth[here] = depth * dust[below] * np.float32(coma.cross_section_m)
    out *= np.float32(coma.afrho_m / (8 * np.pi**2))
    return Haze(radiance=out, optical_depth=optical_depth)


def _columns(coma: Coma, distance_m: float, sine: F32, cosine: F32, length_m: F32, endless: Mask) -> F32:
    """Return the integral of 1 / r² along each line of sight, in 1/m, float32[y, x].

    `sine` and `cosine` are those of the angle between the line and the direction to the centre.
    """
    # in units of the camera's distance from the centre: the line begins at -cosine and passes at the sine
    along = length_m * np.float32(1 / distance_m)
    height = np.where(endless, sine, sine * along)
    width = np.where(endless, -cosine, sine * sine - cosine * (along - cosine))
    out = np.arctan2(height, width) / (sine * np.float32(distance_m))
    inner = (sine * distance_m < coma.core_m) & (cosine > 0)
    inner &= endless | (length_m > cosine * distance_m - coma.core_m)
    if inner.any():
        start, ends = -cosine[inner].astype(np.float64) * distance_m, length_m[inner].astype(np.float64)
        ends[endless[inner]] = np.inf
        out[inner] = coma.column(start, sine[inner].astype(np.float64) * distance_m, ends)
    return np.asarray(out, dtype=np.float32)


def _bounds(any_of: Mask) -> tuple[int, int]:
    """Return the first index that is set, and the one behind the last; 0 and 0 if none is."""
    found = np.flatnonzero(any_of)
    return (int(found[0]), int(found[-1]) + 1) if len(found) else (0, 0)


def _is_sky(semantic: NDArray[np.uint8]) -> Mask:
    """Return where lines have no end."""
    return np.asarray((semantic == SKY) | (semantic == SUN))


def _edge_columns(frame: _Frame, edges: Edges) -> F32:
    """Return `_columns` of the lines of pixels at edges, float32[n, line]."""
    x_px, y_px = edge_positions_px(edges.row, edges.column, round(edges.depth_m.shape[1] ** 0.5))
    first, second, cosine = frame.components(x_px, y_px)
    sine = np.maximum(np.hypot(first, second), np.float32(1e-6))
    x, y, z = frame.view.rays_C(x_px, y_px)
    sky = _is_sky(edges.semantic)
    length = np.where(sky, 0, edges.depth_m) * (np.sqrt(z**2 + x**2 + y**2) / z).astype(np.float32)
    return _columns(frame.coma, frame.distance_m, sine, cosine, length, sky)


def sky_around(
    coma: Coma, shadow: Shadow | None, view: View, first_px: F64, last_px: F64, cell_px: float
) -> tuple[slice, slice, F32]:
    """Return the light of the dust around a rectangle of the frame, averaged over each pixel's whole area.

    The rectangle holds the close-up of a body of few pixels. What lies in it counts as dark.

    Parameters
    ----------
    first_px, last_px
        float64[2] each: x and y of its corners, multiples of `cell_px`.
    cell_px
        Width of a pixel of the close-up, a power of two.

    Returns
    -------
    slice, slice, float32[y, x]
        Rows and columns, and the radiance over the Sun's irradiance at 550 nm, in 1/sr.
    """
    frame = _Frame(coma=coma, shadow=shadow, view=view)
    size = np.array([view.width_px, view.height_px])
    low = np.clip(np.floor(first_px) - _AROUND_PX, 0, size).astype(int)
    high = np.clip(np.ceil(last_px) + _AROUND_PX, 0, size).astype(int)
    width, height = high - low
    towards = view.L_from_C.T @ frame.axes_L[2]
    centre = view.pixel_map.pixel_of(towards)
    corner = np.stack(np.meshgrid(*(np.arange(a, b, dtype=float) for a, b in zip(low, high, strict=True))), axis=-1)
    corner, step, total = corner.reshape(-1, 2), 1.0, np.zeros(width * height)
    while len(corner):
        inside = ((corner >= first_px) & (corner + step <= last_px)).all(axis=1)
        across = ((corner < last_px) & (corner + step > first_px)).all(axis=1) & ~inside
        away = np.linalg.norm(corner + step / 2 - centre, axis=1)
        divided = (across | (away * _CELL_FRACTION < step)) & (step > cell_px) & ~inside
        middle = corner[~divided & ~inside] + step / 2
        rays = frame.directions(*middle.T)
        endless = np.full(len(rays), np.inf)
        start = rays @ frame.camera_m
        passed = np.linalg.norm(frame.camera_m - start[:, None] * rays, axis=1)
        light = frame.light(rays, endless)[0] * coma.column(start, np.maximum(passed, 1e-3), endless)
        column, row = (np.floor(middle) - low).astype(int).T
        total += np.bincount(row * width + column, light * step**2, len(total))
        step /= 2
        corner = (corner[divided][:, None] + step * np.array([[0, 0], [0, 1], [1, 0], [1, 1]])).reshape(-1, 2)
    radiance = (total * coma.afrho_m / (8 * np.pi**2)).astype(np.float32).reshape(height, width)
    return slice(low[1], high[1]), slice(low[0], high[0]), radiance


def _positions_px(first: int, last: int, stride: int = 1) -> F64:
    """Return the middles of the pixels from `first` to before `last`, or of groups of `stride` pixels."""
    return np.asarray((np.arange(first, last) + 0.5) * stride, dtype=np.float64)


# --- coarse grids -------------------------------------------------------------------------------------------


def _on_sky(frame: _Frame, sky: Mask, sine: F32, cosine: F32) -> F32:
    """Return the light of lines without end, over that of a line with G = 1, float32[y, x]."""
    if not sky.any():
        return np.ones(sky.shape, dtype=np.float32)
    # the tangent of half the angle from the centre, by a formula without cancellation
    tangent = sine[sky] / np.maximum(1 + cosine[sky], np.float32(1 / _MOST_TANGENT))
    bounds = np.log(float(tangent.min())), np.log(float(tangent.max()))
    height, width = sky.shape
    stride = max(1, max(height, width) // _SKY_NODES)
    x_px, y_px = (_positions_px(-_PAD, -(-size // stride) + _PAD, stride) for size in (width, height))
    first, second, _ = frame.components(x_px[None, :], y_px[:, None])
    table = _SkyTable.of(frame, bounds, float(np.abs(np.arctan2(second, first)).max()))
    nodes = table.at(x_px, y_px)
    full = cv2.resize(nodes, (len(x_px) * stride, len(y_px) * stride), interpolation=cv2.INTER_CUBIC)
    out = np.ascontiguousarray(full[_PAD * stride :, _PAD * stride :][:height, :width])
    centre = frame.view.L_from_C.T @ frame.axes_L[2]
    if stride > 1 and centre[2] > 0:  # near the centre every pixel counts
        middle_x, middle_y = frame.view.pixel_map.pixel_of(centre)
        reach = _FINE_STRIDES * stride
        rows, columns = (
            (max(round(middle - reach), 0), min(round(middle + reach), size))
            for middle, size in ((middle_y, height), (middle_x, width))
        )
        if rows[0] < rows[1] and columns[0] < columns[1]:
            out[slice(*rows), slice(*columns)] = table.at(_positions_px(*columns), _positions_px(*rows))
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class _SkyTable:
    """Hold the light of lines without end for directions around that to the centre.

    Rows are steps of the logarithm of tan(ψ/2), where ψ is the angle from the centre, from `low` on; columns are
    turns about the centre in steps of 2 π / `_SKY_TURNS`, from `first_turn` on. `coefficients` float64[row, column]
    are those of a cubic spline.
    """

    frame: _Frame
    low: float
    step: float
    first_turn: float
    coefficients: F64

    @classmethod
    def of(cls, frame: _Frame, bounds: tuple[float, float], turn_rad: float) -> _SkyTable:
        """Return the table between two logarithms and for turns up to an angle in both directions."""
        margin = 0.05 + 0.02 * (bounds[1] - bounds[0])
        angles = np.linspace(bounds[0] - margin, bounds[1] + margin, _SKY_STEPS)
        step = 2 * np.pi / _SKY_TURNS
        half = int(np.ceil(turn_rad / step)) + 2 * _WRAPPED
        whole = 2 * half >= _SKY_TURNS
        half = _SKY_TURNS // 2 if whole else half
        turns = step * np.arange(-half, half if whole else half + 1)
        tangent = np.exp(angles)
        sine, cosine = (v / (1 + tangent**2) for v in (2 * tangent, 1 - tangent**2))
        across = [sine[:, None] * v for v in (np.cos(turns), np.sin(turns))]
        local = np.stack([*across, np.broadcast_to(cosine[:, None], across[0].shape)], axis=-1)
        directions = local.reshape(-1, 3) @ frame.axes_L
        light = frame.coma.relative(frame.camera_m, directions, np.full(len(directions), np.inf), frame.shadow)[
            0
        ].reshape(across[0].shape)
        table = ndimage.spline_filter1d(light, order=3, axis=0, mode="mirror")
        table = ndimage.spline_filter1d(table, order=3, axis=1, mode="grid-wrap" if whole else "mirror")
        first = -half * step
        if whole:
            table = np.concatenate([table[:, -_WRAPPED:], table, table[:, :_WRAPPED]], axis=1)
            first -= _WRAPPED * step
        return cls(
            frame=frame,
            low=float(angles[0]),
            step=float(angles[1] - angles[0]),
            first_turn=first,
            coefficients=table,
        )

    def at(self, x_px: F64, y_px: F64) -> F32:
        """Return the light, with the phase function, in a grid of image positions, float32[y, x]."""
        first, second, along = self.frame.components(x_px[None, :], y_px[:, None])
        across = np.sqrt(first * first + second * second)
        angle = np.log(np.maximum(across, 1e-9) / np.maximum(1 + along, 1 / _MOST_TANGENT))
        turn = (np.arctan2(second, first) - self.first_turn) * (_SKY_TURNS / (2 * np.pi))
        where = np.stack([(angle - self.low) / self.step, turn])
        light = ndimage.map_coordinates(self.coefficients, where, order=3, mode="nearest", prefilter=False)
        sun = self.frame.axes_L @ self.frame.coma.outflow.sun
        phase = self.frame.coma.phase(first * sun[0] + second * sun[1] + along * sun[2])
        return np.asarray(np.maximum(light, 0) * phase, dtype=np.float32)


def _on_ground(
    frame: _Frame, rows: tuple[int, int], columns: tuple[int, int], length_m: F32, body: Mask
) -> tuple[F32, F32]:
    """Return light and dust of lines that end at the ground over those with G = 1, float32[y, x] of a part each.

    The nodes take the mean length of the lines around them. What is not the body has the values of its neighbours.
    """
    height, width = length_m.shape
    if not body.any():
        return np.ones((height, width), dtype=np.float32), np.ones((height, width), dtype=np.float32)
    count = int(np.count_nonzero(body))
    stride = max(1, int(np.ceil(np.sqrt(count / _GROUND_NODES))))
    below, right = -height % stride, -width % stride
    size = ((width + right) // stride, (height + below) // stride)

    def means(image: NDArray[np.generic]) -> F32:
        padded = cv2.copyMakeBorder(image.astype(np.float32), 0, below, 0, right, cv2.BORDER_CONSTANT, value=0)
        return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA))

    share = means(body)
    seen = share > 0
    lengths = (means(np.where(body, length_m, 0)) / np.maximum(share, 1e-9))[seen]
    x_px, y_px = (first + _positions_px(0, n, stride) for first, n in zip((columns[0], rows[0]), size, strict=True))
    row, column = np.nonzero(seen)
    directions = frame.directions(x_px[column], y_px[row])
    nearest = tuple(ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True))

    def interpolated(values: F64) -> F32:
        nodes = np.zeros(seen.shape, dtype=np.float32)
        nodes[seen] = values
        wide = cv2.resize(nodes[nearest], (size[0] * stride, size[1] * stride), interpolation=cv2.INTER_LINEAR)
        return np.asarray(wide[:height, :width])

    light, dust = frame.light(directions, lengths.astype(np.float64))
    return interpolated(light), interpolated(dust)
