"""Look at single frames of a nucleus, align two of them, and measure silhouette, texture, edges and sky.

Brightness is compared as (image - background) / (bright - background): `background` is the median of the sky,
`bright` the 99th percentile of the lit body. Lit is a brightness above 0.12. Lengths are pixels of the frame.

Figures of a pair of images of one pose:

- `iou`: intersection over union of the lit silhouettes; `limb_px`: median distance between the bright limbs;
- `rank`: Spearman's correlation of brightness where both are lit; `rank_smooth`: the same of both images smoothed
  to the plates of the shape, below which a renderer has to make its texture up.

Statistics of each image, whose distributions over many frames are compared:

- `sky`, `glow_0.5` to `glow_3`: background, and mean of the sky up to so many radii of the body, over `bright`;
- `noise`, `column`: deviation of the sky from its local median, and of the means of columns from a smooth curve;
- `tracks`: spots and streaks of 2 px or more in the sky;
- `ee50`, `ee80`: radii that hold 50 and 80 % of the light of the stars of the sky;
- `noise_lit`: deviation from the local mean in the smoothest tenth of the lit body;
- `floor`: fraction of the body's outline that is darker than 0.05; `stretch`: median brightness of the lit body;
- `spikes`: lit pixels in 10,000 that exceed their neighbourhood by 8 deviations;
- `limb_rise`: distance over which the mean brightness rises from 10 to 90 % across the bright limb;
- `edge_rise`: reciprocal of the steepest twentieth of the gradients in the body;
- `power_2_4` to `power_32_64`: variance of brightness over its mean at wavelengths of that many pixels.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

from ..core.errors import InputError
from ..core.files import user_files
from ..core.files.images import decoded_image
from .stars import encircled_radii

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

LIT = 0.12
_BRIGHT_PERCENTILE = 99.0
_BODY_LEVEL = 0.3  # of the brightest pixels: surely the body, to begin with
_SUFFIXES, _MOST_VALUES, _LEAST_PX = (".png", ".tif", ".tiff"), 400_000_000, 64
_OCTAVES_PX = ((2, 4), (4, 8), (8, 16), (16, 32), (32, 64))
_GLOW_RADII = ((0.05, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 3.0))
_TRACK_SIGMAS = 6.0
# Lit parts belong to the body if they have this fraction of all lit pixels, or lie as near to the largest part as
# this, in radii of a disc of its area.
_LARGE_PART, _NEAR_BODY = 0.02, 0.4
_SMEAR = 0.1  # of the brightness: columns whose sky differs by more are smeared
_ALIGNED_SIGMA_PX = 1.5  # blur before the similarity is searched: finer texture is random
_MOST_TURN_RAD, _MOST_SCALE = 0.035, 0.02  # errors of pose that are mended
# These limits hold for the statistics of the body. Half of Rosetta's frames have ten pixels or fewer below 0.03
_FEWEST_PX, _DARK, _CLOSED_PX, _PROFILE_PX = 200, 0.05, 12, 8
_PLATE_PX = 4.0
_CLIPPED = 0.5  # of the sky at 0: such a frame tells nothing of its background


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """Hold an image with its background and brightness, and what follows from them.

    `level` float32[y, x] is the brightness, 0 in the background and 1 at the 99th percentile of the lit body; `lit`
    bool[y, x] the lit silhouette, `sky` bool[y, x] what lies well outside it. `smeared` says whether columns have
    backgrounds of their own.
    """

    image: F32
    background: float
    smeared: bool
    bright: float
    level: F32
    lit: Mask
    sky: Mask

    @property
    def clipped(self) -> bool:
        """Return whether most of the sky is 0, or there is none."""
        return int((self.image[self.sky] == 0).sum()) >= _CLIPPED * self.sky.sum()


def look(image: NDArray[Any]) -> Look:
    """Return an image's brightness, lit silhouette and sky."""
    image = np.asarray(image, dtype=np.float32)
    background, bright, level, smeared = _levels(image, image > _BODY_LEVEL * np.percentile(image, 99.5))
    if smeared:  # what is surely the body may have been the smear
        background, bright, level, _ = _levels(image, level > _BODY_LEVEL)
    # spots of the sky are no body: keep what is large, or near the largest part
    labels, count = ndimage.label(ndimage.median_filter(level, 3) > LIT)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    away = ndimage.distance_transform_edt(labels != np.argmax(sizes))
    near = ndimage.minimum(away, labels, np.arange(count + 1)) < _NEAR_BODY * np.sqrt(sizes.max() / np.pi)
    kept = (sizes >= _LARGE_PART * sizes.sum()) | near
    kept[0] = False
    lit = (level > LIT) & ndimage.binary_dilation(kept[labels], iterations=2)
    sky = ndimage.distance_transform_edt(~lit) > max(3.0, 0.05 * np.sqrt(lit.sum() / np.pi))
    return Look(image=image, background=background, smeared=smeared, bright=bright, level=level, lit=lit, sky=sky)


def _levels(image: F32, body: Mask) -> tuple[float, float, F32, bool]:
    """Return background, brightness and `Look.level` of an image, and whether it is smeared.

    `body` holds pixels that are surely the body. Where smear or lost columns show, the background is that of each
    column, above and below the body's middle: one smears as charge is cleared, the other as it is read.
    """
    far = ndimage.distance_transform_edt(~body) > 0.1 * np.sqrt(body.sum())
    background = float(np.median(image[far])) if far.any() else 0.0
    bright = float(np.percentile(image[body], _BRIGHT_PERCENTILE)) if body.any() else 1.0
    middle = round(ndimage.center_of_mass(body)[0]) if body.any() else 0
    halves = slice(None, middle), slice(middle, None)
    columns = [_column_levels(image[part], far[part], background) for part in halves]
    smeared = bool(max(np.abs(of - background).max() for of in columns) > _SMEAR * (bright - background))
    level = image - np.float32(background)
    for part, of in zip(halves if smeared else (), columns, strict=False):
        level[part] = image[part] - of
    return background, bright, level / np.float32(max(bright - background, 1e-6)), smeared


def _column_levels(image: F32, sky: Mask, background: float) -> F32:
    """Return the median of each column's sky, float32[x], and `background` where a column has none."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns without sky
        columns = np.nanmedian(np.where(sky, image, np.nan), axis=0)
    return np.where(np.isfinite(columns), columns, background).astype(np.float32)


def shift_between(real: Look, rendered: Look, *, search_px: int) -> tuple[float, float]:
    """Return the shift (x, y) in px that moves the rendered image onto the real one, to a tenth of a pixel.

    It maximises the correlation of brightness, which is 0 outside the lit silhouettes. The silhouettes alone give
    a shift up to a pixel off: in them the terminator, which depends on relief, counts as much as the limb.
    """
    a, b = (ndimage.gaussian_filter(np.clip(one.level, 0, 1) * one.lit, 1.0) for one in (real, rendered))
    product = np.fft.rfft2(a) * np.conj(np.fft.rfft2(b))
    correlation = np.fft.irfft2(product, a.shape)
    correlation = np.roll(correlation, (search_px, search_px), (0, 1))[: 2 * search_px + 1, : 2 * search_px + 1]
    y, x = np.unravel_index(np.argmax(correlation), correlation.shape)
    fine = [0.0, 0.0]
    for axis, (k, line) in enumerate(((x, correlation[y]), (y, correlation[:, x]))):
        if 0 < k < len(line) - 1:
            low, middle, high = (float(line[k + d]) for d in (-1, 0, 1))
            fine[axis] = 0.5 * (low - high) / min(low - 2 * middle + high, -1e-12)
    return float(x - search_px + fine[0]), float(y - search_px + fine[1])


def similarity_between(real: Look, rendered: Look, shift_xy: tuple[float, float]) -> NDArray[np.float64]:
    """Return the similarity float64[2, 3] that moves points (x, y) of the rendered image onto the real one.

    The affine map that correlates their brightness best (Evangelidis & Psarakis 2008, IEEE TPAMI 30, 1858) is
    searched near a shift; the similarity has its centre, its angle and its scale. Without convergence, and beyond
    `_MOST_TURN_RAD` and `_MOST_SCALE`, the shift alone is returned.
    """
    a, b = (cv2.GaussianBlur(np.clip(one.level, 0, 1.2), (0, 0), _ALIGNED_SIGMA_PX) for one in (real, rendered))
    start = np.array([[1, 0, -shift_xy[0]], [0, 1, -shift_xy[1]]], dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
    plain = np.array([[1, 0, shift_xy[0]], [0, 1, shift_xy[1]]], dtype=np.float64)
    try:
        _, back = cv2.findTransformECC(a, b, start, cv2.MOTION_AFFINE, stop, None, 5)
    except cv2.error:  # no convergence
        return plain
    affine = cv2.invertAffineTransform(back.astype(np.float64))
    scale = float(np.sqrt(max(np.linalg.det(affine[:, :2]), 1e-9)))
    turn = float(np.arctan2(affine[1, 0] - affine[0, 1], affine[0, 0] + affine[1, 1]))
    if abs(turn) > _MOST_TURN_RAD or abs(scale - 1) > _MOST_SCALE:
        return plain
    middle = 0.5 * np.array(real.level.shape[::-1]) - 0.5
    turned = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    onto = affine[:, :2] @ middle + affine[:, 2]
    return np.column_stack([turned, onto - turned @ middle])


def shifted(image: NDArray[Any], shift_xy: tuple[int, int]) -> NDArray[Any]:
    """Return an image moved by whole pixels, continued beyond its edges by its mirror image."""
    x, y = shift_xy
    border = max(abs(x), abs(y))
    padded = np.pad(image, border, mode="symmetric")
    height, width = image.shape
    return np.asarray(padded[border - y : border - y + height, border - x : border - x + width])


def limb_px(a: Mask, b: Mask, sun_xy: NDArray[np.float64]) -> float:
    """Return the median distance between the bright limbs of two lit silhouettes, both ways, in px."""
    edges = [_bright_limb(ndimage.binary_fill_holes(lit), sun_xy) for lit in (a, b)]
    if not edges[0].any() or not edges[1].any():
        return float("nan")
    far = [ndimage.distance_transform_edt(~edge) for edge in edges]
    return float(np.median(np.concatenate([far[1][edges[0]], far[0][edges[1]]])))


def _bright_limb(whole: Mask, sun_xy: NDArray[np.float64]) -> Mask:
    """Return the edge of a silhouette whose outward normal lies within 45° of the Sun's direction in the image."""
    gradient = [-ndimage.gaussian_filter(whole.astype(np.float32), 3.0, order=order) for order in ((0, 1), (1, 0))]
    length = np.hypot(*gradient)
    towards = (gradient[0] * sun_xy[0] + gradient[1] * sun_xy[1]) / np.maximum(length, 1e-9)
    edge = whole & ~ndimage.binary_erosion(whole, border_value=1)
    return np.asarray(edge & (towards > 0.5**0.5))


def _smoothed(level: F32, inside: Mask, sigma: float) -> NDArray[np.float64]:
    """Return brightness smoothed by a Gaussian that sees the pixels of a mask only, float64[y, x]."""
    weight = ndimage.gaussian_filter(inside.astype(np.float64), sigma)
    values = ndimage.gaussian_filter(np.where(inside, level, 0.0).astype(np.float64), sigma)
    return np.asarray(values / np.maximum(weight, 1e-9))


def octave_variances(level: F32, inside: Mask) -> dict[str, float]:
    """Return the variance of brightness over its mean, inside a mask, in octaves of wavelength.

    Octaves are differences of Gaussians that see the pixels of the mask only.
    """
    mean = float(level[inside].mean()) if inside.any() else 1.0
    out = {}
    for short, long in _OCTAVES_PX:
        # a Gaussian of deviation s passes half the amplitude at the wavelength 2 π s / sqrt(2 ln 2)
        low, high = (length * np.sqrt(2 * np.log(2)) / (2 * np.pi) for length in (short, long))
        band = (_smoothed(level, inside, low) - _smoothed(level, inside, high))[inside] / mean
        out[f"power_{short}_{long}"] = float(band.var()) if band.size else float("nan")
    return out


def sky_figures(one: Look, around: Mask) -> dict[str, float]:
    """Return background, glow, noise, column texture and tracks of the sky outside `around`, see the module."""
    scale = max(one.bright - one.background, 1e-6)
    radius_px = float(np.sqrt(around.sum() / np.pi))
    away = ndimage.distance_transform_edt(~around) / max(radius_px, 1.0)
    sky = one.sky & (away > 0.05)
    if not sky.any():
        glows = (f"glow_{high:g}" for _, high in _GLOW_RADII)
        return dict.fromkeys(("sky", *glows, "noise", "column", "tracks"), float("nan"))
    image = one.image
    residual = image - ndimage.median_filter(image, 5)
    ordinary = np.abs(residual[sky]) < 4 * max(float(np.std(residual[sky])), 1e-6)
    noise = float(np.std(residual[sky][ordinary]))
    out = {"sky": one.background / max(one.bright, 1e-6)}
    for low, high in _GLOW_RADII:
        ring = sky & (away > low) & (away <= high)
        out[f"glow_{high:g}"] = (
            float(image[ring].mean()) / max(one.bright, 1e-6) if ring.sum() > 100 else float("nan")
        )
    out["noise"] = noise / scale
    with np.errstate(all="ignore"):
        columns = np.array(
            [image[sky[:, k], k].mean() if sky[:, k].sum() > 20 else np.nan for k in range(image.shape[1])]
        )
    known = np.isfinite(columns)
    texture = columns[known] - ndimage.median_filter(columns[known], 31)
    deviation = texture - np.median(texture)
    out["column"] = float(1.4826 * np.median(np.abs(deviation))) / scale if known.any() else float("nan")
    spots, _ = ndimage.label((residual > _TRACK_SIGMAS * max(noise, 0.5)) & sky, np.ones((3, 3)))
    out["tracks"] = float((np.bincount(spots.ravel())[1:] >= 2).sum())
    return out


def body_figures(one: Look, sun_xy: NDArray[np.float64]) -> dict[str, float]:
    """Return the statistics of an image that are of the lit body, see the module."""
    lit, level = one.lit, one.level
    inside = ndimage.binary_erosion(lit, iterations=3)
    if inside.sum() < _FEWEST_PX:
        names = ("noise_lit", "floor", "stretch", "spikes", "limb_rise", "edge_rise")
        return dict.fromkeys(names, float("nan"))
    fine = level - ndimage.uniform_filter(level, 3)
    local = np.sqrt(np.maximum(ndimage.uniform_filter(fine**2, 7), 0))[inside]
    outline = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(lit, _CLOSED_PX), iterations=_CLOSED_PX))
    outline = outline[_CLOSED_PX:-_CLOSED_PX, _CLOSED_PX:-_CLOSED_PX]
    residual = (level - ndimage.median_filter(level, 5))[inside]
    deviation = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
    steepest = np.percentile(np.hypot(*np.gradient(level))[inside], 95)
    return {
        "noise_lit": float(np.percentile(local, 10)),
        "floor": float((level[outline] < _DARK).mean()),
        "stretch": float(np.median(level[lit])),
        "spikes": 1e4 * float((residual > 8 * deviation).mean()),
        "limb_rise": _limb_rise_px(one, sun_xy),
        "edge_rise": 1 / max(float(steepest), 1e-6),
    }


def _limb_rise_px(one: Look, sun_xy: NDArray[np.float64]) -> float:
    """Return over how many pixels the mean profile across the bright limb rises from 10 to 90 % of its plateau."""
    whole = ndimage.binary_fill_holes(one.lit)
    edge = _bright_limb(whole, sun_xy)
    if edge.sum() < _FEWEST_PX / 4:
        return float("nan")
    # pixels by their distance from the outline, negative outside, whose nearest outline is bright limb
    outer, nearest = ndimage.distance_transform_edt(
        ~(whole & ~ndimage.binary_erosion(whole, border_value=1)), return_indices=True
    )
    distance = np.where(whole, outer, -outer)
    near = edge[nearest[0], nearest[1]] & (np.abs(distance) < _PROFILE_PX)
    bins = np.round(distance[near]).astype(int) + _PROFILE_PX
    count = np.bincount(bins, minlength=2 * _PROFILE_PX)
    profile = np.bincount(bins, one.level[near], minlength=2 * _PROFILE_PX)[1:-1] / np.maximum(count, 1)[1:-1]
    profile = np.maximum.accumulate((profile - profile[:2].mean()) / max(profile[-3:].mean(), 1e-6))
    low, high = np.interp((0.1, 0.9), profile + 1e-9 * np.arange(len(profile)), np.arange(len(profile)))
    return float(high - low)


def compare(
    real: Look,
    rendered: Look,
    sun_xy: NDArray[np.float64],
    plate_px: float = _PLATE_PX,
    stretch: float = 1.0,
) -> dict[str, float]:
    """Return all figures of one aligned pair; the statistics as `NAME real` and `NAME rendered`.

    `plate_px` is the mean width of the shape's plates in the frame; levels are light to the power `stretch`.
    """
    both, either = real.lit & rendered.lit, real.lit | rendered.lit
    inside = ndimage.binary_erosion(both, iterations=3)
    smooth = [_smoothed(one.level, both, plate_px / 2)[both] for one in (real, rendered)]
    out = {
        "iou": float(both.sum() / max(either.sum(), 1)),
        "limb_px": limb_px(real.lit, rendered.lit, sun_xy),
        "rank": _rank(real.level[both], rendered.level[both]),
        "rank_smooth": _rank(*smooth),
    }
    for which, one in (("real", real), ("rendered", rendered)):
        of_sky = sky_figures(one, either)
        if real.clipped:
            of_sky |= dict.fromkeys(set(of_sky) - {"tracks"}, float("nan"))
        radii = encircled_radii(one.image, (one.image / np.float32(255)) ** np.float32(1 / stretch), one.sky)
        of_sky |= dict(zip(("ee50", "ee80"), radii, strict=True))
        values = of_sky | body_figures(one, sun_xy) | octave_variances(one.level, inside)
        out |= {f"{name} {which}": value for name, value in values.items()}
    return out


def _rank(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return Spearman's correlation, or NaN of too few pixels."""
    return float(stats.spearmanr(a, b).statistic) if len(a) >= _FEWEST_PX else float("nan")


def read_frame(folder: Path, name: str) -> F32:
    """Return the frame NAME.png or NAME.tif of a folder, grey, float32[y, x] from 0 to 255. Raises InputError."""
    found = [path for suffix in _SUFFIXES if (path := folder / f"{name}{suffix}").is_file()]
    if not found:
        raise InputError(f"{folder}: has no {name}.png or {name}.tif, which the table of poses names")
    data = user_files.read_input(found[0], "texture", types=_SUFFIXES)
    try:
        colours, _ = decoded_image(data, _MOST_VALUES)
    except InputError as error:
        raise InputError(f"{found[0]}: {error}") from None
    image = 255 * colours.mean(axis=2)
    if min(image.shape) < _LEAST_PX or not np.isfinite(image).all():
        raise InputError(
            f"{found[0]}: is {image.shape[1]}x{image.shape[0]} px; must be at least {_LEAST_PX} px, finite"
        )
    return np.asarray(image, dtype=np.float32)
