"""Simulate broken pixels as in the paper (Gallon et al.): hot and dead pixels, their halo, and their lines.

All steps act on the digital image. They change I, and R, G and B by the same ratio (where I is 0, R, G and B become
I). A later step overrides an earlier one, so the result does not depend on the order of the defects:

1. CCD only: the pixels between a defect and the edge of the frame in the readout direction gain an offset, I +=
   offset. Each defect has its own offset. Where lines overlap, the offsets add. A defect with offset 0 ("hot pixel
   without offset") has no line, neither in the image nor in the mask.
2. Demosaicing makes a halo. A von Neumann neighbour of a defect becomes (defect + far) / 2. The far pixel lies on
   the other side of the neighbour, two pixels from the defect. Its value is the one read out: with the offset of
   its line, or its own brightness if it is a defect too. A neighbour of several defects becomes the mean of these
   values. At the edge of the frame, the neighbour's own value replaces the missing far pixel.
3. The I of a defect is exactly its brightness.

The paper's table bounds the offset of a line by 65. Its text bounds it by 0.4 times the brightness of the defect
(0.4 · 255 = 102). Here both bounds hold: offset = U(0, min(65, 0.4 · brightness)), in whole DN. The table asks for
10-150 defects, but the paper's own example has 9, so a scene may set `count = 9`.

The paper's figures show that a hot pixel's output is linear in the exposure and grows with ISO (Chapman et al.
2013, 2022); the paper has a random brightness stand for both. With `reference_exposure_s` the brightness follows
them, except that of salt-and-pepper defects.

The camera's architecture decides whether the sensor is a CCD or CMOS. Its readout direction is that of all lines.
Chapman et al. (2022, 2023) see more pairs of defects within 3×3 pixels than chance explains. OSIRIS-REx saw that
more than three defects close together matter to navigation. These are the reasons for `cluster_fraction` and
`dense_cluster_probability`. Salt-and-pepper defects are thought to be rare (Leung et al. 2007). The defaults of
these three values are ours: 10 %, 10 %, 5 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .context import FaultContext, Params
from .contract import Fault, first_of
from .fields import Interval, Severity, bounds, number
from .planes import scale_by_intensity

# Unit steps (dy, dx) of the four readout directions. They also lead to the four von Neumann neighbours.
STEPS = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}

# Number of defects in a dense cluster: more than three within 3×3 pixels.
DENSE_CLUSTER = 4

Index = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class TextureBrokenPixels(Fault):
    """Set hot and dead pixels (Gallon et al., table of broken pixels and lines)."""

    fault = "broken_pixels"
    model = "texture"
    default = True
    after = "vignetting"
    axis = 1
    remark = "each defect shows as a plus of five pixels, itself and four neighbours"
    step = "rgbi"
    severity = Severity(key="count", low=1, high=10_000, width_power=1, drawn=lambda params, *_: len(params["x"]))

    count: Interval = bounds(10, 150, limits=(0, 10_000), integer=True, doc="number of broken pixels")
    brightness_dn: Interval = bounds(
        0, 255, limits=(0, 255), integer=True, unit="DN", doc="intensity of a broken pixel"
    )
    reference_exposure_s: float | None = number(
        None,
        limits=(1e-9, 1e6),
        unit="s",
        doc="exposure at which broken pixels have brightness_dn, with a gain of 1; it then grows with exposure "
        "and camera.gain, up to white; default: it is the same in every image",
    )
    line_offset_dn: Interval = bounds(
        0,
        65,
        limits=(0, 255),
        integer=True,
        unit="DN",
        doc="offset of the line a broken pixel subtends in a CCD",
    )
    line_offset_fraction: float = number(
        0.4, limits=(0, 1), doc="a line's offset is at most this fraction of its broken pixel's brightness"
    )
    salt_and_pepper_fraction: float = number(
        0.05, limits=(0, 1), doc="fraction of broken pixels that are fully dead (0) or fully hot (255)"
    )
    cluster_fraction: float = number(
        0.1, limits=(0, 1), doc="fraction of broken pixels placed within 3×3 pixels of another one"
    )
    dense_cluster_probability: float = number(
        0.1, limits=(0, 1), doc="chance that an image has four broken pixels within 3×3 pixels"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return lists of the defects' x, y, brightness and line offset in DN, and the direction of the lines."""
        height, width = context.shape
        count = min(self.count.integer(rng), height * width // 4)
        x, y = self._positions(count, height, width, rng)
        brightness = rng.integers(int(self.brightness_dn.lo), int(self.brightness_dn.hi), count, endpoint=True)
        extreme = np.where(rng.random(count) < 0.5, 0, 255)
        is_extreme = rng.random(count) < self.salt_and_pepper_fraction
        if self.reference_exposure_s is not None:
            grown = context.camera.gain * context.camera.exposure_s / self.reference_exposure_s
            brightness = np.rint(np.minimum(brightness * grown, 255)).astype(np.int64)
        brightness = np.where(is_extreme, extreme, brightness)
        fraction = rng.random(count)
        params: Params = {
            "sensor": "ccd" if context.camera.is_ccd else "cmos",
            "x": x,
            "y": y,
            "brightness_dn": brightness.tolist(),
        }
        if context.camera.is_ccd:
            # U draws the whole numbers lo … hi, both included. If the fraction allows less than lo, the offset is
            # that limit.
            hi = np.minimum(self.line_offset_dn.hi, np.floor(self.line_offset_fraction * brightness + 1e-9))
            lo = np.minimum(self.line_offset_dn.lo, hi)
            params["line_offset_dn"] = (lo + np.floor(fraction * (hi - lo + 1))).astype(int).tolist()
            params["line_direction"] = context.camera.readout_direction
        return params

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters with only the first `fraction` of the defects."""
        return first_of(params, fraction, "x", "y", "brightness_dn", "line_offset_dn")

    def _positions(
        self, count: int, height: int, width: int, rng: np.random.Generator
    ) -> tuple[list[int], list[int]]:
        """Return x and y of `count` distinct pixels: some alone and uniform, the others next to an earlier one."""
        dense = count >= DENSE_CLUSTER and rng.random() < self.dense_cluster_probability
        beside = min(round(self.cluster_fraction * count), count - 1) if count else 0
        beside = max(beside, DENSE_CLUSTER - 1) if dense else beside
        flat = rng.choice(height * width, count, replace=False, shuffle=True)
        placed = [(int(i) // width, int(i) % width) for i in flat[: count - beside]]
        spare = [(int(i) // width, int(i) % width) for i in flat[count - beside :]]
        taken = set(placed)
        for k in range(beside):
            spot = spare[k]  # used if no free neighbour is drawn
            for _ in range(64):
                parent = placed[0] if dense and k < DENSE_CLUSTER - 1 else placed[int(rng.integers(len(placed)))]
                dy, dx = rng.integers(-1, 1, 2, endpoint=True)
                near = (parent[0] + int(dy), parent[1] + int(dx))
                if 0 <= near[0] < height and 0 <= near[1] < width and near not in taken:
                    spot = near
                    break
            while spot in taken:  # an earlier one took it; at most a quarter of the frame is taken
                spot = (int(rng.integers(height)), int(rng.integers(width)))
            placed.append(spot)
            taken.add(spot)
        return [p[1] for p in placed], [p[0] for p in placed]

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the image with lines, neighbours and defects. All other pixels stay bit for bit the same."""
        layout = context.once(_layout, params)
        out = quantity.array.copy()
        grey = context.camera.is_monochrome
        pixels = out.reshape(-1, 4)
        if len(layout.line):
            touched = pixels.view(np.uint32)[layout.line].view(np.uint8)  # whole pixels, as they are faster to take
            intensity = touched[:, 3] + layout.line_offset
            pixels[layout.line] = scale_by_intensity(touched, intensity, monochrome=grey)
        as_read = pixels[:, 3]
        defect = np.asarray(params["brightness_dn"], dtype=np.float32)
        far = as_read[layout.far].astype(np.float32)
        far_is_defect = layout.far_defect >= 0
        far[far_is_defect] = defect[layout.far_defect[far_is_defect]]
        demand = (defect[layout.source] + far) / 2
        sums = np.bincount(layout.neighbour_of, demand, minlength=len(layout.neighbour))
        counts = np.bincount(layout.neighbour_of, minlength=len(layout.neighbour))
        halo = (sums / np.maximum(counts, 1)).astype(np.float32)
        index = np.concatenate([layout.neighbour, layout.defect])
        intensity = np.concatenate([halo, defect])
        pixels[index] = scale_by_intensity(pixels[index], intensity, monochrome=grey)
        return quantity.with_array(out)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels of the defects, of their neighbours and of lines with an offset, bool[y, x]."""
        layout = context.once(_layout, params)
        out = np.zeros(context.shape, dtype=bool)
        flat = out.reshape(-1)
        for index in (layout.line, layout.neighbour, layout.defect):
            flat[index] = True
        return out


@dataclass(frozen=True)
class _Layout:
    """Hold the flat pixel indices that the defects change.

    Attributes
    ----------
    line, line_offset
        Pixels of the lines, and the sum of all offsets at each.
    defect, neighbour
        Pixels of the defects and of their neighbours.
    neighbour_of, source, far, far_defect
        One entry for each pair of a neighbour and one of its defects: position in `neighbour`, position in
        `defect`, flat index of the far pixel, and position in `defect` of the defect at the far pixel (-1: none).
    """

    line: Index
    line_offset: NDArray[np.float32]
    defect: Index
    neighbour: Index
    neighbour_of: Index
    source: Index
    far: Index
    far_defect: Index


def _layout(params: Params, context: FaultContext) -> _Layout:
    """Return the layout of the defects."""
    height, width = context.shape
    x, y = (np.asarray(params[k], dtype=np.int64) for k in ("x", "y"))
    defect = y * width + x
    which = np.full(height * width, -1, dtype=np.int16)
    which[defect] = np.arange(len(defect))

    line, line_offset = _lines(params, context.shape)

    dy, dx = (np.array(v)[:, None] for v in zip(*STEPS.values(), strict=True))
    near_y, near_x = y + dy, x + dx
    inside = (near_y >= 0) & (near_y < height) & (near_x >= 0) & (near_x < width)
    far_y, far_x = y + 2 * dy, x + 2 * dx
    has_far = (far_y >= 0) & (far_y < height) & (far_x >= 0) & (far_x < width)
    near = near_y * width + near_x
    far = np.where(has_far, far_y * width + far_x, near)
    use = inside & (which[np.where(inside, near, 0)] < 0)  # a defect is never a neighbour
    source = np.broadcast_to(np.arange(len(defect)), near.shape)
    neighbour, neighbour_of = np.unique(near[use], return_inverse=True)
    return _Layout(
        line=line,
        line_offset=line_offset,
        defect=defect,
        neighbour=neighbour,
        neighbour_of=neighbour_of.reshape(-1),
        source=source[use],
        far=far[use],
        far_defect=which[far[use]].astype(np.int64),
    )


def _lines(params: Params, shape: tuple[int, int]) -> tuple[Index, NDArray[np.float32]]:
    """Return the flat indices of the lines, without the defects' own pixels, and the summed offset at each."""
    total = np.zeros(shape, dtype=np.int32)
    dy, dx = STEPS[params.get("line_direction", "right")]
    along = total if dx else total.T
    across, start = (params["y"], params["x"]) if dx else (params["x"], params["y"])
    for row, first, offset in zip(across, start, params.get("line_offset_dn", ()), strict=False):
        if dx + dy > 0:
            along[row, first + 1 :] += offset
        else:
            along[row, :first] += offset
    line = np.flatnonzero(total != 0)
    return line, total.reshape(-1)[line].astype(np.float32)
