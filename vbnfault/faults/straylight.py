"""Simulate straylight as in the paper (Gallon et al.): flare and glare textures on the line through Sun and centre.

On that line the Sun is at position 0 and the centre of the image at 1 (King 2001). The centre of a flare is at

    sun + position · (centre - sun).

Its outline has the radius `radius` · image width, and its texture is turned so that its own axis follows the line.
The texture is added to the image:

    signal += brightness · visible fraction of the Sun · texture · white

for each channel. The texture is linear in [0, 1], where 1 is white, and white is the signal shown as 255. Nothing
is clipped here.

As in the paper, flares are drawn without replacement from ten. Positions and radii are sorted together, so flares
grow with the distance from the Sun. Textures of the group *close* (1-5) get the nearer positions, those of the
group *far* (6-10) the farther ones.

Choices where the paper says nothing:

- Position, radius and brightness are drawn uniformly within the bounds of the paper's table. (The paper's remark on
  positions beyond (0, 1) explains why the table ends at 2: farther flares leave the frame.) The radius refers to
  the width of the image. A draw without a flare in the frame is repeated, up to 256 times.
- A user's own textures (`close_textures`, `far_textures`, `glare_textures`) take the place of the packaged ones.
  They are numbered in the order given, close ones first, and `radius` is then that of half their longer side.
- One of two glares, or none, with equal probability, is at the Sun, if the Sun is in the frame or so near that the
  glare reaches into it. Its bounds, radius 0.2-0.45 and brightness 0.8-1.6, are ours.
- The mask holds the pixels of the image that change. The footprint holds the pixels to which the textures add at
  least `mask_level_dn`, 1 DN of 255 by default.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, VbnfaultError
from ..core.files.file_contents import cached_with_contents
from ..core.files.images import decoded_image
from ..core.files.resources import data_dir
from ..core.files.user_files import read_input
from ..core.quantities import LUMINANCE
from .context import FaultContext, Params
from .contract import Fault, mask_level
from .fields import Interval, Severity, bounds, paths, rows
from .planes import intensity_dn, reaches

# Radius of a flare's outline over half the side of its texture, as `benchmarks/flare_textures.py` draws it.
FILL = 0.9
CLOSE = (1, 2, 3, 4, 5)
FAR = (6, 7, 8, 9, 10)
GLARES = (1, 2)
TYPES = (".png", ".tif", ".tiff")
_SIDES = 64  # an own texture gets a border up to a multiple of this, so that it can be halved
MAX_DRAWS = 256
LARGEST_VALUES = 2**26  # of a texture, 256 MiB while it is decoded

Window = tuple[slice, slice]

# Weights of a texture's R, G, B in each channel. Textures have no near infrared, so red replaces it (assumed).
_COLOURS = dict(zip("RGB", np.eye(3, dtype=np.float32), strict=True))
_COLOURS |= {"W": LUMINANCE, "NIR": _COLOURS["R"]}


@dataclass(frozen=True, kw_only=True)
class TextureStraylight(Fault):
    """Add flares and glare from textures (Gallon et al., table of straylight parameters)."""

    fault = "straylight"
    model = "texture"
    default = True
    after = "particles"
    axis = 3
    step = "electrons"
    # small flares leave parts of the frame free, however bright they are
    severity = Severity(
        key="brightness",
        low=0.01,
        high=100.0,
        keys={"radius": [0.3, 0.6]},
        drawn=lambda params, *_: float(np.mean([r["brightness"] for r in params["flares"] or [params["glare"]]])),
    )
    needs_sun = True
    packaged_images = "textures"
    effect_mask = True
    soft_layer = "straylight_added"

    count: Interval = bounds(1, 10, limits=(0, 10), integer=True, doc="number of flares, at most one per texture")
    index: Interval = bounds(
        1,
        10,
        limits=(1, 10),
        integer=True,
        doc="textures to choose from: 1-5 close to the Sun, 6-10 far from it",
    )
    position: Interval = bounds(
        0.5, 2, limits=(-20, 20), doc="place on the line: 0 the Sun, 1 the centre of the image"
    )
    radius: Interval = bounds(0.05, 0.3, limits=(1e-3, 5), unit="image widths", doc="radius of a flare")
    brightness: Interval = bounds(1.5, 2.5, limits=(0, 1000), doc="factor on a flare's texture")
    glare: Interval = bounds(0, 2, limits=(0, 2), integer=True, doc="glare at the Sun: 0 none, or texture 1 or 2")
    glare_radius: Interval = bounds(0.2, 0.45, limits=(1e-3, 5), unit="image widths", doc="radius of the glare")
    glare_brightness: Interval = bounds(0.8, 1.6, limits=(0, 1000), doc="factor on the glare's texture")
    mask_level_dn: float = mask_level()
    close_textures: tuple[str, ...] = paths(
        content="texture",
        doc="your own flares near the Sun, up to ten with the far ones, in place of the packaged ones: PNG or TIFF "
        "files, linear, black where nothing is added, their right side away from the Sun",
    )
    far_textures: tuple[str, ...] = paths(content="texture", doc="your own flares far from the Sun")
    glare_textures: tuple[str, ...] = paths(content="texture", doc="your own glares at the Sun, up to two")
    flares: tuple[Mapping[str, float], ...] = rows(
        {"index": (1, 10), "position": (-20, 20), "radius": (1e-3, 5), "brightness": (0, 1000)},
        doc="the flares themselves, in place of a draw of count, index, position, radius and brightness",
    )

    def validate(self) -> None:
        """Raise ValueError if there are fewer textures than flares or an index is not a whole number."""
        names, glares, _ = self._textures()
        for key, most, all_of_them in (
            ("far_textures" if self.far_textures else "close_textures", FAR[-1], names),
            ("glare_textures", GLARES[-1], glares),
        ):
            if len(all_of_them) > most:
                raise ValueError(f"{key}: there are {len(all_of_them)} textures; must be at most {most}")
        for key in ("close_textures", "far_textures", "glare_textures"):
            for path in getattr(self, key):
                try:
                    texture(path)
                except InputError as error:
                    raise ValueError(f"{key}: {error}") from None
        choices = max(min(int(self.index.hi), len(names)) - int(self.index.lo) + 1, 0)
        if self.count.lo > choices:
            raise ValueError(f"count = {list(self.count)}: index leaves {choices} textures, each used once")
        for i, row in enumerate(self.flares):
            if not float(row["index"]).is_integer() or row["index"] > len(names):
                raise ValueError(
                    f"flares[{i}].index = {row['index']}: must be a whole number from 1 to {len(names)}"
                )

    def _textures(self) -> tuple[tuple[str, ...], tuple[str, ...], int]:
        """Return names or paths of all flares and of all glares, and how many flares are close to the Sun."""
        flares, close = self.close_textures + self.far_textures, len(self.close_textures)
        if not flares:
            flares, close = tuple(f"flare_{k:02d}" for k in (*CLOSE, *FAR)), len(CLOSE)
        return flares, self.glare_textures or tuple(f"glare_{k}" for k in GLARES), close

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return `flares`, `glare`, the principal point (the centre of most images), and `mask_level_dn`.

        `flares` is a list of tables with index, position, radius and brightness. `glare` is such a table without a
        position, or None.
        """
        params: Params = {
            "flares": [],
            "glare": self._draw_glare(context, rng),
            "centre_xy_px": context.camera.intrinsics[2:].tolist(),
            "mask_level_dn": float(self.mask_level_dn),
        }
        if self.flares:
            params["flares"] = [
                {"index": int(r["index"])} | {k: float(r[k]) for k in ("position", "radius", "brightness")}
                for r in self.flares
            ]
            return params
        for _ in range(MAX_DRAWS):
            params["flares"] = self._draw_flares(rng)
            if not params["flares"] or context.sun_xy_px is None or _any_in_frame(params, context):
                break
        return params

    def _draw_flares(self, rng: np.random.Generator) -> list[dict[str, Any]]:
        """Return the tables of drawn flares, sorted by position and radius."""
        names, _, close = self._textures()
        textures = np.arange(int(self.index.lo), min(int(self.index.hi), len(names)) + 1)
        count = min(self.count.integer(rng), len(textures))
        chosen = rng.permutation(textures)[:count]
        chosen = np.concatenate([chosen[chosen <= close], chosen[chosen > close]])
        position = np.sort(self.position.uniform(rng, count))
        radius = np.sort(self.radius.uniform(rng, count))
        brightness = self.brightness.uniform(rng, count)
        return [
            {"index": int(i), "position": float(p), "radius": float(r), "brightness": float(b)}
            for i, p, r, b in zip(chosen, position, radius, brightness, strict=True)
        ]

    def _draw_glare(self, context: FaultContext, rng: np.random.Generator) -> dict[str, Any] | None:
        """Return the table of the drawn glare, or None if there is none in the frame."""
        index = min(self.glare.integer(rng), len(self._textures()[1]))
        radius = self.glare_radius.uniform(rng)
        brightness = self.glare_brightness.uniform(rng)
        if index == 0 or context.sun_xy_px is None:
            return None
        if not _reaches_frame(context.sun_xy_px, radius * context.shape[1], context.shape):
            return None
        return {"index": index, "radius": radius, "brightness": brightness}

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons plus flares and glare."""
        layer = context.once(self._layer, params, quantity.white_e)
        return quantity if layer is None else quantity.with_array(quantity.array + layer)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels where any channel gains at least `mask_level_dn`, bool[y, x]."""
        white = context.camera.detector.white_e
        layer = context.once(self._layer, params, white)
        if layer is None:
            return np.zeros(context.shape, dtype=bool)
        return reaches(layer, white * np.float32(params["mask_level_dn"] / 255))

    def soft(self, params: Params, context: FaultContext) -> NDArray[np.float32]:
        """Return the intensity of flares and glare, float32[y, x] in DN of 255."""
        layer = context.once(self._layer, params, context.camera.detector.white_e)
        return np.zeros(context.shape, np.float32) if layer is None else intensity_dn(layer, context.camera)

    def _layer(
        self, params: Params, context: FaultContext, white_e: NDArray[np.float32]
    ) -> NDArray[np.float32] | None:
        """Return all flares and the glare for a white level, electrons float32[y, x, channel]."""
        return _layer(params, context, np.asarray(white_e, dtype=np.float32), *self._textures()[:2])


def flare_centres_px(params: Params, sun_xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pixel x, y of the drawn flares' centres, float64[flare, 2]."""
    sun, centre = np.asarray(sun_xy_px, dtype=float), np.asarray(params["centre_xy_px"], dtype=float)
    position = np.array([f["position"] for f in params["flares"]], dtype=float)
    return sun + position[:, None] * (centre - sun)


def _any_in_frame(params: Params, context: FaultContext) -> bool:
    """Return whether a flare, taken at 0.8 of its radius, overlaps the frame."""
    assert context.sun_xy_px is not None
    centres = flare_centres_px(params, context.sun_xy_px)
    width = context.shape[1]
    return any(
        _reaches_frame(c, 0.8 * f["radius"] * width, context.shape)
        for c, f in zip(centres, params["flares"], strict=True)
    )


def _reaches_frame(xy: NDArray[np.float64], radius_px: float, shape: tuple[int, int]) -> bool:
    """Return whether a disc overlaps the frame."""
    nearest = np.clip(xy, 0, shape[::-1])
    return bool(np.hypot(*(nearest - xy)) < radius_px)


def _layer(
    params: Params,
    context: FaultContext,
    white_e: NDArray[np.float32],
    flares: Sequence[str],
    glares: Sequence[str],
) -> NDArray[np.float32] | None:
    """Return all flares and the glare, electrons float32[y, x, channel]; None if there is nothing to add."""
    if context.sun_xy_px is None or context.sun_visible <= 0:
        return None
    sun = np.asarray(context.sun_xy_px, dtype=float)
    height, width = context.shape
    along = np.asarray(params["centre_xy_px"]) - sun
    angle = float(np.arctan2(along[1], along[0])) if along.any() else 0.0

    stamps = [
        (flares[f["index"] - 1], centre, f)
        for f, centre in zip(params["flares"], flare_centres_px(params, sun), strict=True)
    ]
    if params["glare"]:
        stamps.append((glares[params["glare"]["index"] - 1], sun, params["glare"]))
    colours = np.stack([_COLOURS[channel] for channel in context.camera.detector.channels])
    layer = None
    for name, centre, f in stamps:
        gain = white_e * np.float32(context.sun_visible * f["brightness"])
        placed = _stamp(name, centre, f["radius"] * width, angle, colours * gain[:, None], context.shape)
        if placed is None:
            continue
        if layer is None:
            layer = np.zeros((height, width, len(white_e)), np.float32)
        window, stamp = placed
        layer[window] += stamp
    return layer


def _stamp(
    name: str,
    centre: NDArray[np.float64],
    radius_px: float,
    angle: float,
    weights: NDArray[np.float32],
    shape: tuple[int, int],
) -> tuple[Window, NDArray[np.float32]] | None:
    """Return the pixels that a texture covers, as a window, and its light there, float32[y, x, channel].

    Return None if the texture is outside the frame.

    Parameters
    ----------
    centre, radius_px
        Centre x, y and radius of the flare's outline in px.
    angle
        Rotation of the texture's +x axis towards image +y, in radians.
    weights
        float32[channel, 3]: weights of the texture's R, G, B in each channel.
    shape
        (height, width) of the frame.

    Notes
    -----
    Pixel centres are at +0.5 in the image and in the texture. The pixel of index i shows the texel of index S/2 -
    0.5 + Rᵀ(i + 0.5 - centre) / s, where S is the size of the texture and s the width of a texel in px.
    """
    levels, fill = texture(name)
    half = radius_px / fill
    x0, y0 = (max(0, int(np.floor(v - half))) for v in centre)
    x1, y1 = (min(size, int(np.ceil(v + half))) for v, size in zip(centre, shape[::-1], strict=True))
    if x0 >= x1 or y0 >= y1:
        return None
    # use a level whose texels are about as wide as a pixel, so that thin rings do not alias
    texels_per_px = len(levels[0]) / (2 * half)
    level = levels[int(np.clip(round(np.log2(texels_per_px)), 0, len(levels) - 1))]
    size = len(level)
    zoom = size / (2 * half)
    cos, sin = zoom * np.cos(angle), zoom * np.sin(angle)
    dx, dy = x0 + 0.5 - centre[0], y0 + 0.5 - centre[1]
    origin = size / 2 - 0.5
    matrix = np.array(
        [[cos, sin, origin + cos * dx + sin * dy], [-sin, cos, origin - sin * dx + cos * dy]],
        dtype=np.float64,
    )
    stamp = cv2.warpAffine(
        cv2.transform(level, weights),
        matrix,
        (x1 - x0, y1 - y0),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return (slice(y0, y1), slice(x0, x1)), np.asarray(stamp, dtype=np.float32).reshape(*stamp.shape[:2], -1)


class Texture(NamedTuple):
    """Hold a texture, RGB float32[y, x, 3] in [0, 1], and smaller copies made by 2×2 means; read-only.

    `fill` is the radius of its outline over half its side.
    """

    levels: tuple[NDArray[np.float32], ...]
    fill: float


@cached_with_contents(maxsize=16)
def texture(name: str) -> Texture:
    """Return a packaged texture, or a user's own by its path.

    Raises
    ------
    InputError
        A user's texture is missing, is no PNG or TIFF image, or has values that are not from 0 to 1 of white.
    VbnfaultError
        A packaged texture is damaged.
    """
    is_own = Path(name).suffix != ""
    path = Path(name) if is_own else data_dir("textures") / f"{name}.png"
    data, fill = read_input(path, "texture", types=TYPES), FILL
    try:
        colours, alpha = decoded_image(data, LARGEST_VALUES)
        if not (colours.min() >= 0 and colours.max() <= 1):  # NaN is neither
            raise InputError("has values that are negative or above white")
    except InputError as error:
        if is_own:
            raise InputError(f"{path}: {error}") from None
        raise VbnfaultError(f"{path}: {error}; install vbnfault again") from None
    if is_own:
        light = np.broadcast_to(colours, (*colours.shape[:2], 3)) * (1 if alpha is None else alpha[..., None])
        longer = max(light.shape[:2])
        side = -(-longer // _SIDES) * _SIDES
        border = [(n // 2, n - n // 2) for n in (side - light.shape[0], side - light.shape[1])]
        colours, fill = np.pad(light, (*border, (0, 0))), longer / side
    levels = [np.ascontiguousarray(colours)]
    while levels[-1].shape[0] % 2 == 0 and levels[-1].shape[0] > 6:
        half = levels[-1].shape[0] // 2
        levels.append(levels[-1].reshape(half, 2, half, 2, 3).mean(axis=(1, 3), dtype=np.float32))
    for level in levels:
        level.flags.writeable = False
    return Texture(tuple(levels), fill)
