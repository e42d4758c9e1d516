"""Simulate vignetting by a prescription: the loss in the lens itself, and at a slipped ring or a moved hood.

A faulty lens passes the light of those rays of a beam, traced exactly, that clear both

- a ring as wide as the stop that has slipped sideways in the plane of the stop: the overlap of the two remains
  open,
- a round opening in front of the lens, a hood that was bent or moved.

Each ray is weighted by its area in the plane of the first vertex. The fraction that passes is at most 1.

If the camera has a prescription, its image contains the lens's own vignetting, and only this fraction is applied. A
thin lens has no vignetting. In that case the relative illumination E(θ) / E(0) of the named lens is applied too,
which contains natural and mechanical vignetting and distortion (`lens.imaging`). No further cos⁴ is applied. Both
factors are computed at the d line.

The Sun's direct image and its straylight have passed the lens's own rims, but neither the slipped ring nor the
moved hood. They therefore lose only the fraction that the Sun's beam loses at these two. The same fraction is used
for all ghosts, although they enter through different parts of the front, and for the veil of the scene, which is
some hundredths of the scene's light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lens.beams import Beams
from ..lens.image_frame import ImageFrame
from .context import FaultContext, Params
from .contract import LensFault, scaled
from .fields import Interval, Severity, bounds, number
from .planes import times

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_COARSEST_PX = 16  # largest distance between the positions at which the fraction of a beam is computed
_EVERY = 2  # every second line of rays of a beam is used
_ROUNDING = 1e-4  # relative accuracy of a beam's rim
_TOGETHER = 2048  # positions at a time; limits the memory


@dataclass(frozen=True, kw_only=True)
class LensVignetting(LensFault):
    """Remove light at a slipped ring and a moved hood, and with a thin lens also in the named lens itself."""

    fault = "vignetting"
    model = "lens"
    step = "electrons"
    severity = Severity(key="decentre", low=0.02, high=2.0)
    localised = False
    soft_layer = "vignetting_factor"

    decentre: Interval = bounds(
        0.0,
        0.3,
        limits=(0, 2),
        unit="stop radii",
        doc="how far a ring as wide as the stop has slipped in its plane",
    )
    hood_offset: Interval = bounds(
        0.0, 0.4, limits=(0, 10), unit="hood radii", doc="how far the hood's opening has moved sideways"
    )
    hood_radius_mm: float | None = number(
        None,
        limits=(1e-3, 1e4),
        unit="mm",
        doc="of the hood's opening; default: it just clears the frame's corners",
    )
    hood_distance_mm: float | None = number(
        None,
        limits=(0, 1e4),
        unit="mm",
        doc="of the hood's opening before the first vertex; default: a focal length",
    )
    mask_loss: float = number(0.1, limits=(0, 1), doc="the mask holds the pixels that lose at least this fraction")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return lens, decentre of the ring, distance, radius and offset of the hood, and the mask loss.

        Lengths are in mm; the decentre is also in stop radii. Decentre and offset have x to the right and y down.
        """
        frame = context.frame
        beams = frame.beams(self.lens)
        distance = frame.lens.focal_length_mm if self.hood_distance_mm is None else float(self.hood_distance_mm)
        radius = _clear_radius_mm(beams, distance) if self.hood_radius_mm is None else float(self.hood_radius_mm)
        stop_mm = beams.lens.surfaces[beams.lens.stop].semi_diameter_mm
        decentre, moved = self.decentre.uniform(rng), self.hood_offset.uniform(rng) * radius
        slip = decentre * stop_mm
        turn = rng.uniform(0, 2 * np.pi, 2)
        return {
            "lens": self.lens,
            "decentre": float(decentre),
            "decentre_mm": [float(slip * np.cos(turn[0])), float(slip * np.sin(turn[0]))],
            "hood_distance_mm": distance,
            "hood_radius_mm": radius,
            "hood_offset_mm": [float(moved * np.cos(turn[1])), float(moved * np.sin(turn[1]))],
            "mask_loss": float(self.mask_loss),
        }

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters with ring and hood nearer to their places."""
        return scaled(params, fraction, "decentre", "decentre_mm", "hood_offset_mm")

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons times the factor of each pixel."""
        return quantity.with_array(times(quantity.array, context.once(_factor, params)))

    def past_rims(self, light: Any, rest: Any, params: Params, context: FaultContext) -> Any:
        """Return the light past the rims times the fraction of the Sun's beam that clears ring and hood.

        Direct image and straylight of the Sun enter with that beam. The loss at the lens's own rims is already in
        this light.
        """
        sun = context.sun_before_camera
        left = 1.0 if sun is None else share_left(params, context.frame, np.asarray(sun[:2] / sun[2]))
        return light.past_rims * np.float32(left)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels where the loss reaches `mask_loss`, bool[y, x]."""
        return np.asarray(context.once(_factor, params) <= np.float32(1 - params["mask_loss"]))

    def soft(self, params: Params, context: FaultContext) -> F32:
        """Return the factor on the light, float32[y, x]."""
        return context.once(_factor, params)


def _factor(params: Params, context: FaultContext) -> F32:
    """Return the factor on the light of a sample, float32[y, x] in [0, 1]."""
    frame = context.frame
    left = _share_left(params, frame)
    return left if frame.lens.falls_off else left * _illumination(frame, params["lens"])


def share_left(params: Params, frame: ImageFrame, slope: F64) -> float:
    """Return the fraction of one direction's beam that clears ring and hood.

    `slope` float64[2] holds the direction's tangents to the right and down. The direction may lie outside the
    frame.
    """
    x, y = np.asarray(slope, dtype=np.float64)[:, None]
    return float(_left_of(params, frame.beams(params["lens"]), x, y)[0])


@lru_cache(maxsize=2)
def _illumination(frame: ImageFrame, name: str) -> F32:
    """Return E(θ) / E(0) of a lens at the field angles of a thin lens's pixels, float32[y, x]."""
    lens = frame.real_lens(name)
    slope = np.hypot(*frame.slopes(np.arange(frame.width_px) + 0.5, np.arange(frame.height_px) + 0.5))
    nodes = np.linspace(0, float(slope.max()) * 1.001, 2049)
    light = np.minimum(lens.relative_illumination(lens.distorted(nodes)), 1.0)
    out = np.interp(slope, nodes, light).astype(np.float32)
    out.flags.writeable = False
    return out


# --- rays ------------------------------------------------------------------------------------------------------


def _clear_radius_mm(beams: Beams, distance_mm: float) -> float:
    """Return the radius of an opening about the axis that clears all beams of the frame.

    `distance_mm` is the distance of the opening from the first vertex.
    """
    rim = beams.bundle.points_mm[0, :, :2].reshape(len(beams.slope), -1, 2)
    lit = beams.rim_mm.min(axis=1) > 0
    return float(np.hypot(rim[lit, :, 0] - distance_mm * beams.slope[lit, None], rim[lit, :, 1]).max())


@lru_cache(maxsize=4)
def _lines(beams: Beams) -> tuple[F64, F64]:
    """Return straight lines of rays from the middle of each beam to its rim.

    They are computed in two planes, that of the first vertex and that of the stop.

    Returns
    -------
    begin
        float64[plane, angle]: start of the lines on the x axis.
    to_rim
        float64[plane, 2, angle, turn]: x and y from the start to the rim, for turns all around.
    """
    shape = (len(beams.slope), beams.rim_mm.shape[1], -1, 2)
    planes = np.stack([beams.bundle.points_mm[k, :, :2].reshape(shape) for k in (0, 1 + beams.lens.stop)])
    planes = np.nan_to_num(planes)
    begin = planes[:, :, 0, 0, 0]
    to_rim = np.moveaxis(planes[:, :, ::_EVERY, -1] - planes[:, :, ::_EVERY, 0], -1, 1)
    # the half below the axis mirrors the half above it
    below = to_rim[:, :, :, -2:0:-1] * np.array([1, -1])[None, :, None, None]
    return begin, np.concatenate([to_rim, below], axis=3)


def _share_left(params: Params, frame: ImageFrame) -> F32:
    """Return the fraction of each beam's light that clears ring and hood, float32[y, x] in [0, 1]."""
    beams = frame.beams(params["lens"])
    focal_px = frame.lens.focal_length_mm * 1e3 / frame.pixel_pitch_um
    # the edge of a far hood is as wide as the beam projected through it
    soft_px = focal_px * beams.rim_mm[0].mean() / max(params["hood_distance_mm"], 1e-3)
    finest = 2 ** int(np.clip(np.log2(frame.width_px * frame.height_px) / 2 - 7, 0, 6))
    step = int(np.clip(2 ** np.floor(np.log2(max(soft_px / 6, 1))), finest, max(_COARSEST_PX, finest)))
    slopes = frame.slopes(*frame.nodes_px(step))
    x, y = (v.ravel() for v in slopes)
    left = np.empty(x.size, dtype=np.float32)
    for start in range(0, len(left), _TOGETHER):
        some = slice(start, start + _TOGETHER)
        left[some] = _left_of(params, beams, x[some].astype(np.float64), y[some].astype(np.float64))
    return frame.between_nodes(left.reshape(slopes[0].shape), step)


def _left_of(params: Params, beams: Beams, slope_x: F64, slope_y: F64) -> F64:
    """Return the fraction left of the beams of the directions, float64[n].

    Along a line of rays, the light within a distance of the beam's middle is proportional to the square of that
    distance.
    """
    begin, to_rim = _lines(beams)
    slope = np.hypot(slope_x, slope_y)
    # beyond the last direction that passes the lens, use that direction
    known = np.minimum(slope, beams.slope[np.flatnonzero(beams.rim_mm.min(axis=1) > 0).max()])
    low = np.clip(np.searchsorted(beams.slope, known, side="right") - 1, 0, len(beams.slope) - 2)
    part = (known - beams.slope[low]) / (beams.slope[low + 1] - beams.slope[low])
    begin = begin[:, low] * (1 - part) + begin[:, low + 1] * part
    to_rim = to_rim[:, :, low] * (1 - part[:, None]) + to_rim[:, :, low + 1] * part[:, None]
    cos, sin = (v / np.maximum(slope, 1e-12) for v in (slope_x, slope_y))
    before = begin[0] - params["hood_distance_mm"] * slope
    first, last = np.zeros(to_rim.shape[2:]), np.ones(to_rim.shape[2:])
    openings = (
        (before, to_rim[0], params["hood_offset_mm"], params["hood_radius_mm"]),
        (begin[1], to_rim[1], params["decentre_mm"], beams.lens.surfaces[beams.lens.stop].semi_diameter_mm),
    )
    for start, onwards, (x, y), radius in openings:
        # middle of the opening in the axes of the beam, outwards and across
        along, across = x * cos + y * sin, y * cos - x * sin
        enters, leaves = _crossings(start - along, -across, onwards, radius)
        first, last = np.maximum(first, enters), np.minimum(last, leaves)
    light = to_rim[0, 0] ** 2 + to_rim[0, 1] ** 2
    kept = (light * np.maximum(last**2 - first**2, 0) * (last > first)).sum(axis=1)
    return np.asarray(kept / light.sum(axis=1))


def _crossings(x: F64, y: F64, onwards: F64, radius: float) -> tuple[F64, F64]:
    """Return the parameters at which lines enter and leave a disc; 0 is the start of a line, 1 its end.

    The lines start at (x, y), measured from the middle of the disc, and run along `onwards`. A line that misses the
    disc gets 2 and -1.
    """
    a = np.maximum(onwards[0] ** 2 + onwards[1] ** 2, 1e-300)
    b = (x[:, None] * onwards[0] + y[:, None] * onwards[1]) / a
    c = (x**2 + y**2 - radius**2)[:, None] / a
    under = b * b - c
    root = np.sqrt(np.maximum(under, 0))
    # if the rim is that of the opening itself, rounding must not cut it
    leaves = np.where(under > 0, -b + root, -1.0)
    return np.where(under > 0, -b - root, 2.0), np.where(leaves > 1 - _ROUNDING, 1.0, leaves)
