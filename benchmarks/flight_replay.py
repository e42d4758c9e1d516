"""Replay flight images: render a table of poses and compare each image with the real frame of its row.

    python benchmarks/flight_replay.py --frames FOLDER --shape SHAPE --out replay
    python benchmarks/flight_replay.py --frames FOLDER --out replay --rows 0,5,18 --set render.bounces=1
    python benchmarks/flight_replay.py --frames FOLDER --poses other.csv --scene my_scene.toml --out replay

FOLDER holds `poses.csv` (the columns of `[trajectory]`) and for each row an 8-bit image NAME.png. The camera is
that of the scene, by default `navcam67p` with its detector; of faults it has `SPOTS` alone. It renders `BINNING`
times the size of the frames, which are half native size, and the raw image is developed as they were
(`developed`): the square root of the digital numbers over the bias, halved, in 8 bits.
The labels of flight images are some pixels off, so every image is aligned first, by a shift of whole native
pixels, which leaves its noise as it is.

`--mend-poses 1` mends more than the shift: the similarity that correlates image and frame best gives the camera's
attitude and distance, and the image is rendered again. In 11 of the frames the labels are off by up to 0.6° of turn
about the line of sight, and the frames ask for a nucleus some 0.5 % larger than `67p_18k.obj`, or as much nearer:
its volume is 18.41 km³, published are 18.56 (Preusker et al. 2017, A&A 607, L1) and 18.8 (Jorda et al. 2016,
Icarus 277, 257). The figures then tell the errors of scene and shape from those of the table.

The stretch of the frames is not documented. That it is the square root of the 12 bits shows in their noise: it
falls from 0.92 at a sky of 2.5 to 0.52 at 14, by the same curve in all frames. Of 255 (DN/4095)^g the exponent 0.5
fits it best, and the sunlit body, compared with the rendered one percentile by percentile, asks for 0.52 to 0.58.
Where a frame is overexposed, it reaches 255. The frames were halved before they were rounded to 8 bits: the
variance of their sky falls evenly, from 0.69 at 4.5 to 0.31 at 11, where rounding first would give a trough at 6.5
and a peak at 9.5. Three frames in a row have 1.9 times the noise of the others at the same brightness: the camera
has two gains, and a frame is rendered with the one that its noise asks for. The exposure is metered so that the
rendered body is as bright as the frame's. Brightness is compared as (image - background) / (bright - background):
`background` is the median of the sky, `bright` the 99th percentile of the body, all after the stretch. Printed are,
over all frames, the median and the worst 5 % of:

- `iou`: lit silhouettes, intersection over union. Lit is a brightness above 0.12.
- `limb_px`: median distance between the bright limbs, both ways.
- `rank`: Spearman's correlation of brightness where both are lit.
- `power_2_4` to `power_32_64`: rendered over real variance of brightness at wavelengths of that many pixels.
- `sky`, `glow_0.5` to `glow_3`: background level, and brightness of the sky at distances of so many nucleus radii,
  as fractions of `bright`; rendered and real. Frames whose sky is clipped to 0 are left out.
- `noise`, `column`: deviation of the sky from its local median, and of its columns' medians from a smooth curve, as
  fractions of `bright`.
- `tracks`: bright spots and streaks in the sky, of 2 px or more.

Of the spots in the sky of a real frame, 10 in the median, 2 of them of 2 px or more, stay where they are over at
least three frames: warm pixels. The others, 20 and 14 of 2 px or more, lie where hardly another frame has one.
Their number and sizes are those of tracks of protons in the exposure and the readout of 4.2 s, some of which are
long. Their charge spreads over three decades: at the 4.65 e/DN of the sensor a quarter fits protons that cross the
layer, the others are fainter, as of electrons from the housing that end there. The catalogue of stars has nine
brighter than magnitude 7 in such a field, of which about four show. `SPOTS` gives the rendered frames the same
tracks, and the grains of the coma at 3.6 au. Stars and warm pixels come from scene and sensor.

A shape file is sharpened as far as its own roughness asks for (`body.sharpen`). One of 67P is scaled to 18.7 km³,
and its ground has the relief of `GROUND`. Its dust has no contrast, since random dust lies elsewhere than on the
comet.

`rank` and the texture ask for different things. What the shape does not know, the renderer has to make up, and any
made-up texture lowers the correlation with the frame, also one with the right statistics: the frames' own texture
shorter than 2 pixels or so, turned by 180° and laid over images without random relief, raised the variance at 2 to
4 pixels from 0.29 to 1.15 of the real one and lowered `rank` from 0.804 to 0.757 (medians of 6 frames). `GROUND`
has a third of the real variance there; it is for figures that compare places. With `--texture`, the ground is
`TEXTURE`, for figures that compare statistics, as those of `flight_classifier.py`: facets of half a native pixel,
rougher at short wavelengths, with scarps, uneven, of planes that meet in edges, and with dust of another albedo.
What matters most is the size of the facets: relief shorter than two of them is not shown, so facets of a native
pixel blur what the camera resolves. Next come the edges, which rounded waves lack.

With `--texture`, an image is also taken a second time, with the black that the sky of its frame asks for: bias and
dark signal at a date are no more in the table than exposure and gain are. `sky` and `glow` then tell nothing of the
level. Without it the noise, which depends on the level after the stretch, tells skies apart, since biases and
temperatures that are drawn put the level up to 1.7 DN off. On the 33 frames:

| ground    | `rank` | variance at 2-4, 4-8, 8-16, 16-32, 32-64 px | body   | limb   | sky    |
|-----------|--------|---------------------------------------------|--------|--------|--------|
| `GROUND`  | 0.807  | 0.36, 0.51, 0.74, 0.93, 0.85 of the real    | 99.4 % | 94.9 % | 73.8 % |
| `TEXTURE` | 0.736  | 0.98, 0.92, 1.00, 1.12, 1.04 of the real    | 75.7 % | 72.4 % | 69.5 % |

The last three columns are the patches that the classifier tells, with `--splits 4` and for `TEXTURE` `--draws 4`;
50 % would be none. Single draws of `TEXTURE` are 75 to 77 % for the body. The settings were chosen by it on
the same frames, so others may be told more often. What had given the images away most were mottled plains and
a core of the point spread that was too wide: real ground is either smooth or rough, and boulders and shadows on it
are sharp. Obliquely lit ground is still too rough in its smoothest tenth, and real scarps throw thin dark lines
where ours throw spots.

The sky of 31 frames is the sum of six parts, fitted by least squares to means over 8 px: the halo of the limb;
light scattered farther, 0.5 % of that of the body (0.4 to 0.8 % in four fifths of the frames; the wings of the
point spread); smear of both directions, 1.15e-6 of a column's light; dark signal that rises along the columns by
2.0 DN (1.5 to 3.0); a bias that differs by 0.8 DN between the first twenty and the last eleven; and a coma (`HAZE`,
unless the scene has one). Coma and wings are told apart by little else than the side of the Sun: without a coma the
wings hold 0.9 % of the light, and the fit is worse by a tenth. With the Afρ here an aperture of 10,000 km would see
some 6 times the light of the nucleus; until June 2014 the comet exceeded it only somewhat (Tubiana et al. 2015, A&A
573, A62). `--afrho-cm 0` leaves it out.

`replay.json` holds all figures, `sheet.png` the pairs real | rendered at full size, with the same stretch, and
`pairs` the aligned images, which `flight_classifier.py` tries to tell apart.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault.body import load_body
from vbnfault.cli import options
from vbnfault.core import resources, user_files
from vbnfault.detector.sensor import load_sensor
from vbnfault.scene.trajectory import FlownPose, Trajectory, load_trajectory

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

LIT = 0.12
_BRIGHT_PERCENTILE = 99.0
_BODY_LEVEL = 0.3  # of the brightest pixels: surely the body, to begin with
_OCTAVES_PX = ((2, 4), (4, 8), (8, 16), (16, 32), (32, 64))
_GLOW_RADII = ((0.05, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 3.0))
_TRACK_SIGMAS = 6.0
# Lit parts belong to the body if they have this fraction of all lit pixels, or lie as near to the largest part as
# this, in radii of a disc of its area.
_LARGE_PART, _NEAR_BODY = 0.02, 0.4
_SMEAR = 0.1  # of the brightness: columns whose sky differs by more are smeared
_SEARCH_PX = 16  # largest shift, for frames of 512 px
_ALIGNED_SIGMA_PX = 1.5  # blur before the similarity is searched: finer texture is random
_MOST_TURN_RAD, _MOST_SCALE = 0.035, 0.02  # errors of pose that are mended
_CLIPPED = 0.5  # of the sky at 0: such a frame tells nothing of its background
BINNING = 2  # the frames have half the native size
# Weights of native pixels in each axis of the halving. Noise of neighbours in the sky of the frames correlates by
# 0.07, which asks for 0.035 at the ends; limb and ground are sharper and ask for less.
_HALVING = (0.0325, 0.4675, 0.4675, 0.0325)
_STRETCH = 255 / 4095**0.5  # of a root of DN
# Variance of the sky by its level s, both after stretch and halving: of the rounding, of photons, and dark / s²
_SKY_VARIANCE = (0.08, 0.16, 8.0)
_NOISY = 1.45  # times this variance: 28 frames have 0.88 to 1.17, three in a row 1.7 to 2.0
HIGH_GAIN = 1.4  # over the low one: what noise of 1.9 times the variance asks for; 1.7 in visnav
_MOST_BLACK_DN = 4.0  # more is light: of 32 frames the black differs by 1.7 DN at most
AFRHO_CM = 50.0  # chosen beside halo and wings of the point spread for the sky of 31 frames
# What leaves spots and tracks in the sky. Protons: flux, energies, depth and `ending_fraction` fitted to the peaks,
# sums and sizes of the spots of 28 frames, diffusion to those of 11; in quiet time CREME96 has 4.67 at the
# Sun-Earth point L2. Grains: the density at 100 km in August 2014, see `vbnfault.faults.particles`.
SPOTS: dict[str, dict[str, Any]] = {
    "cosmic_rays": {
        "model": "tracks",
        "flux_per_cm2_s": 17.0,
        "energy_MeV": [60.0, 5000.0],
        "ending_fraction": 0.9,
        "thickness_um": 9.0,
        "diffusion_um": 4.0,
    },
    "particles": {"model": "coma_grains", "density_per_m3": 6e-4},
}
# Random relief lowers the rank correlation: this is about the least with the texture within a factor of 2.
GROUND: dict[str, Any] = {
    "body.sharpen": "auto",
    "patch.relief": 0.2,
    # dust lies where random fields put it, and not where it lies on the comet: its contrast would only disagree
    "body.photometry.dust_contrast": 0.0,
}
# Of 67P: the frames ask for 0.5 % more length than that of 67p_18k.obj, 18.41 km³; published: 18.56 and 18.8
_VOLUME_KM3, _SAME_BODY = 18.7, 0.05
# In place of `GROUND`: relief with nearly the variance of the frames at 2 to 8 px. Shading alone makes features too
# long across the Sun's direction; the contrast of dust, chosen for the classifier, makes others that are not.
# Boulders stand for all that is sharp and small: of 13 m or more there are some 14 times as many as Pajola et al.
# (2015, A&A 583, A37) counted. Smaller ones, less than a pixel of the frames, are left out.
TEXTURE: dict[str, Any] = {
    **GROUND,
    "body.photometry.dust_contrast": 0.22,
    "patch.relief": 0.36,
    "patch.hurst": 0.42,
    "patch.scarps": 0.3,
    "patch.intermittency": 1.0,
    "patch.angularity": 1.0,
    "patch.boulders_per_km2": 600.0,
    "patch.boulder_index": 2.3,
    "patch.min_boulder_m": 13.0,
    "patch.facet_px": 0.5,
    "patch.max_triangles": 8_000_000,
}
HAZE = {"reference_au": 3.6, "sunlit_fraction": 0.4, "distance_exponent": 0.0}


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """Hold an image with its background and brightness, and what follows from them.

    `level` float32[y, x] is the brightness, 0 in the background and 1 at the 99th percentile of the lit body; `lit`
    bool[y, x] the lit silhouette, `sky` bool[y, x] what lies well outside it.
    """

    image: F32
    background: float
    bright: float
    level: F32
    lit: Mask
    sky: Mask

    @property
    def clipped(self) -> bool:
        """Return whether most of the sky is 0."""
        return bool((self.image[self.sky] == 0).mean() > _CLIPPED)


def look(image: NDArray[Any]) -> Look:
    """Return an image's brightness, lit silhouette and sky."""
    image = np.asarray(image, dtype=np.float32)
    body = image > _BODY_LEVEL * np.percentile(image, 99.5)
    far = ndimage.distance_transform_edt(~body) > 0.1 * np.sqrt(body.sum())
    background = float(np.median(image[far])) if far.any() else 0.0
    bright = float(np.percentile(image[body], _BRIGHT_PERCENTILE)) if body.any() else 1.0
    level = (image - _column_background(image, far, background, bright)) / max(bright - background, 1e-6)
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
    return Look(image=image, background=background, bright=bright, level=level, lit=lit, sky=sky)


def _column_background(image: F32, sky: Mask, background: float, bright: float) -> F32:
    """Return the background of each column, float32[x]: the same for all, unless smear or lost columns show."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns without sky
        columns = np.nanmedian(np.where(sky, image, np.nan), axis=0)
    columns = np.where(np.isfinite(columns), columns, background)
    smeared = np.abs(columns - background).max() > _SMEAR * (bright - background)
    return np.asarray(columns if smeared else np.full_like(columns, background), dtype=np.float32)


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


def aligned_pose(pose: FlownPose, similarity: NDArray[np.float64], fov_deg: float, size: tuple[int, int]) -> Any:
    """Return the camera's position in m and the quaternion camera_from_T of a pose whose image a similarity moves.

    `size` is (height, width) of the image in px. A scale moves the camera along its line to the origin of T.
    """
    focal_px = 0.5 * size[1] / np.tan(np.radians(fov_deg) / 2)
    middle = 0.5 * np.array(size[::-1]) - 0.5
    off = similarity[:, :2] @ middle + similarity[:, 2] - middle
    scale = float(np.sqrt(np.linalg.det(similarity[:, :2])))
    turn = float(np.arctan2(similarity[1, 0], similarity[0, 0]))
    towards = np.array([off[0], off[1], focal_px]) / np.linalg.norm([*off, focal_px])
    # moves the boresight to where its image has moved; small angles, so that the axis is z x towards
    tilt = Rotation.from_rotvec(np.cross([0.0, 0.0, 1.0], towards))
    moved = tilt * Rotation.from_rotvec([0.0, 0.0, turn]) * Rotation.from_matrix(pose.T_from_C.T)
    return pose.camera_position_T_m / scale, moved.as_quat(scalar_first=True)


def shifted(image: NDArray[Any], shift_xy: tuple[int, int]) -> NDArray[Any]:
    """Return an image moved by whole pixels, continued beyond its edges by its mirror image."""
    x, y = shift_xy
    border = max(abs(x), abs(y))
    padded = np.pad(image, border, mode="symmetric")
    height, width = image.shape
    return np.asarray(padded[border - y : border - y + height, border - x : border - x + width])


def developed(raw_dn: NDArray[Any], bias_dn: float) -> NDArray[np.uint8]:
    """Return a raw image as the frames show it: stretched by a root in 8 bits, then halved, uint8[y, x]."""
    over_black = np.clip(np.asarray(raw_dn, dtype=np.float32) - np.float32(bias_dn), 0, None)
    shown = np.minimum(np.float32(_STRETCH) * np.sqrt(over_black), 255)
    for axis in (0, 1):
        size = shown.shape[axis]
        shown = np.pad(shown, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="symmetric")
        taken = [shown.take(np.arange(k, k + size, BINNING), axis=axis) for k in range(len(_HALVING))]
        shown = sum(np.float32(weight) * part for weight, part in zip(_HALVING, taken, strict=True))
    return np.asarray(np.floor(shown + np.float32(0.5)), dtype=np.uint8)


# --- figures --------------------------------------------------------------------------------------------------


def limb_px(a: Mask, b: Mask, sun_xy: NDArray[np.float64]) -> float:
    """Return the median distance between the bright limbs of two lit silhouettes, both ways, in px.

    The bright limb is the edge whose outward normal lies within 45° of the Sun's direction in the image.
    """
    edges = []
    for lit in (a, b):
        whole = ndimage.binary_fill_holes(lit)
        gradient = [
            -ndimage.gaussian_filter(whole.astype(np.float32), 3.0, order=order) for order in ((0, 1), (1, 0))
        ]
        length = np.hypot(*gradient)
        towards = (gradient[0] * sun_xy[0] + gradient[1] * sun_xy[1]) / np.maximum(length, 1e-9)
        edge = whole & ~ndimage.binary_erosion(whole, border_value=1)
        edges.append(edge & (towards > 0.5**0.5))
    if not edges[0].any() or not edges[1].any():
        return float("nan")
    far = [ndimage.distance_transform_edt(~edge) for edge in edges]
    return float(np.median(np.concatenate([far[1][edges[0]], far[0][edges[1]]])))


def octave_variances(level: F32, inside: Mask) -> dict[str, float]:
    """Return the variance of brightness over its mean, inside a mask, in octaves of wavelength.

    Octaves are differences of Gaussians that see the pixels of the mask only.
    """

    def smooth(sigma: float) -> NDArray[np.float64]:
        weight = ndimage.gaussian_filter(inside.astype(np.float64), sigma)
        return np.asarray(
            ndimage.gaussian_filter(np.where(inside, level, 0.0).astype(np.float64), sigma)
            / np.maximum(weight, 1e-9)
        )

    mean = float(level[inside].mean()) if inside.any() else 1.0
    out = {}
    for short, long in _OCTAVES_PX:
        # a Gaussian of deviation s passes half the amplitude at the wavelength 2 π s / sqrt(2 ln 2)
        low, high = (length * np.sqrt(2 * np.log(2)) / (2 * np.pi) for length in (short, long))
        band = (smooth(low) - smooth(high))[inside] / mean
        out[f"power_{short}_{long}"] = float(band.var()) if band.size else float("nan")
    return out


def sky_figures(one: Look, around: Mask) -> dict[str, float]:
    """Return background, glow, noise, column texture and tracks of the sky outside `around`, see the module."""
    scale = max(one.bright - one.background, 1e-6)
    radius_px = float(np.sqrt(around.sum() / np.pi))
    away = ndimage.distance_transform_edt(~around) / max(radius_px, 1.0)
    sky = one.sky & (away > 0.05)
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


def compare(real: Look, rendered: Look, sun_xy: NDArray[np.float64]) -> dict[str, float]:
    """Return all figures of one aligned pair; those of the sky as `NAME real` and `NAME rendered`."""
    both, either = real.lit & rendered.lit, real.lit | rendered.lit
    inside = ndimage.binary_erosion(both, iterations=3)
    out = {
        "iou": float(both.sum() / max(either.sum(), 1)),
        "limb_px": limb_px(real.lit, rendered.lit, sun_xy),
        "rank": float(stats.spearmanr(real.level[both], rendered.level[both]).statistic),
    }
    spectra = [octave_variances(one.level, inside) for one in (real, rendered)]
    out |= {name: spectra[1][name] / max(spectra[0][name], 1e-12) for name in spectra[0]}
    for which, one in (("real", real), ("rendered", rendered)):
        unusable = real.clipped
        out |= {
            f"{name} {which}": float("nan") if unusable and name != "tracks" else value
            for name, value in sky_figures(one, either).items()
        }
    return out


def summary(figures: Sequence[Mapping[str, float]]) -> dict[str, tuple[float, float]]:
    """Return median and worst 5 % of each figure: the 5th percentile, or the 95th where less is better."""
    out = {}
    for name in figures[0]:
        values = np.array([one[name] for one in figures])
        values = values[np.isfinite(values)]
        worst = 5 if name in ("iou", "rank") else 95
        out[name] = (
            (float(np.median(values)), float(np.percentile(values, worst))) if len(values) else (np.nan, np.nan)
        )
    return out


# --- rendering ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Hold a real frame, the image rendered for it and moved onto it, and their figures."""

    name: str
    real: Look
    rendered: Look
    figures: dict[str, float]
    shift_xy: tuple[float, float]
    seconds: float


def replay_scene(
    name: str, size_px: tuple[int, int], overrides: Mapping[str, Any], ground: Mapping[str, Any] = GROUND
) -> vbnfault.Scene:
    """Return a scene whose only faults are `SPOTS`, for frames of (width, height) in px, that stores raw images.

    A shape file gets the keys of `ground`, and one of 67P the volume that the frames ask for.
    """
    values: dict[str, Any] = {"camera.width_px": BINNING * size_px[0], "camera.height_px": BINNING * size_px[1]}
    if "body.shape" in overrides:
        values |= ground
        volume_km3 = 1e-9 * load_body(overrides["body.shape"], unit=overrides.get("body.unit", "auto")).volume_m3
        if abs(volume_km3 / _VOLUME_KM3 - 1) < _SAME_BODY:
            values["body.volume_km3"] = _VOLUME_KM3
    scene = vbnfault.load_scene(name, {**values, "dataset.layers": ["raw"], **overrides})
    dataset = scene.dataset.model_copy(update={"layers": ("raw",), "mask_any": None})
    plan = scene.plan.model_copy(update={"mode": "per_sample", "faulty_fraction": 1.0, "on_invisible": "drop"})
    return scene.model_copy(update={"faults": dict(SPOTS), "plan": plan, "dataset": dataset})


def noise_excess(real: Look) -> float:
    """Return the noise variance of a real frame's sky over what `_SKY_VARIANCE` expects; NaN without sky."""
    calm = real.sky & (np.abs(real.image - ndimage.median_filter(real.image, 9)) < 4)
    calm[1:] &= calm[:-1]  # along columns, whose pattern and smear are no noise
    calm[0] = False
    if real.clipped or calm.sum() < 1000:
        return float("nan")
    variance = np.diff(real.image, axis=0, prepend=0)[calm].var() / 2
    rounding, photons, dark = _SKY_VARIANCE
    return float((variance - rounding) / (photons + dark / real.image[calm].mean() ** 2))


def write_high_gain(detector: str, folder: Path) -> Path:
    """Write the sensor file `detector` with a gain `HIGH_GAIN` times as high, and return its path."""
    path = resources.find("scenes/detectors", detector)
    gain = load_sensor(path).readout.system_gain_dn_per_e * HIGH_GAIN
    text = path.read_text(encoding="utf-8").replace("[readout]\n", f"[readout]\ngain_dn_per_e = {gain:.6g}\n")
    text = text.replace("[sources]\n", '[sources]\n"readout.gain_dn_per_e" = "benchmarks/flight_replay.py"\n')
    folder.mkdir(parents=True, exist_ok=True)
    high = folder / f"{path.stem}_high_gain.toml"
    high.write_text(text, encoding="utf-8")
    return high


def black_excess_dn(real: Look, rendered: Look) -> float:
    """Return by how many DN the sky of a real frame is brighter than that of an aligned rendered one.

    0 where the real sky is clipped, or so bright that its light is no black.
    """
    sky = real.sky & rendered.sky
    if real.clipped or not sky.any():
        return 0.0
    # the levels are whole numbers, so means first; tracks hardly move the median of these
    levels = [float(np.median(ndimage.uniform_filter(one.image, 9)[sky])) for one in (real, rendered)]
    excess_dn = (levels[0] ** 2 - levels[1] ** 2) / _STRETCH**2
    return excess_dn if abs(excess_dn) < _MOST_BLACK_DN else 0.0


def with_black(scene: vbnfault.Scene, excess_dn: float, folder: Path) -> vbnfault.Scene:
    """Return a scene whose black is higher by `excess_dn`; its sensor file is written into a folder."""
    path = resources.find("scenes/detectors", str(scene.camera.detector))
    offsets_dn = [offset_dn + excess_dn for offset_dn in load_sensor(path).readout.node_offsets_dn]
    lines = path.read_text(encoding="utf-8").splitlines()
    k = next(k for k, line in enumerate(lines) if line.startswith("node_offsets_dn = "))
    lines[k] = f"node_offsets_dn = [{', '.join(f'{offset_dn:.4f}' for offset_dn in offsets_dn)}]"
    folder.mkdir(parents=True, exist_ok=True)
    # a name of its own, since files that were read are kept
    black = folder / f"{path.stem}_{1000 * excess_dn:+.0f}_mdn.toml"
    black.write_text("\n".join(lines) + "\n", encoding="utf-8")
    camera = scene.camera.model_copy(update={"detector": str(black.resolve())})
    return scene.model_copy(update={"camera": camera})


def exposed_as(scene: vbnfault.Scene, real: Look, detectors: Sequence[str]) -> vbnfault.Scene:
    """Return a scene whose exposure is metered so that the body is as bright as in a real frame.

    Its sensor is the first of `detectors`, or the second, of a higher gain, where the frame's noise asks for it.
    """
    level = min((real.bright / 255) ** 2, 1.0)
    detector = detectors[noise_excess(real) > _NOISY]
    camera = scene.camera.model_copy(update={"metering_level": level, "detector": detector})
    return scene.model_copy(update={"camera": camera})


def replay(
    session: vbnfault.Session,
    trajectory: Trajectory,
    row: int,
    frame: NDArray[np.uint8],
    detectors: Sequence[str],
    mendings: int = 0,
    black_in: Path | None = None,
) -> Pair:
    """Render a row with one of the sensor files, align it with its real frame by a shift, and compare the two.

    Before, the pose is mended `mendings` times by the similarity between the images. With a folder `black_in`, the
    image is taken again with the frame's own black, by a sensor file written there.
    """
    start = time.perf_counter()
    real = look(frame)
    session.scene = exposed_as(session.scene, real, detectors)
    bias_dn = float(session.base_camera.detector.description["bias_dn"])
    search_px = max(4, round(_SEARCH_PX * frame.shape[1] / 512))
    session.trajectory = trajectory
    for step in range(mendings + 1):
        raw_dn = session.simulate(row).layers["raw"]
        before = look(developed(raw_dn, bias_dn))
        shift = shift_between(real, before, search_px=search_px)
        if step < mendings:
            similarity = similarity_between(real, before, shift)
            trajectory = with_pose(
                trajectory,
                row,
                *aligned_pose(trajectory.pose(row), similarity, session.scene.camera.fov_deg, frame.shape),
            )
            session.trajectory = trajectory
    native = round(BINNING * shift[0]), round(BINNING * shift[1])
    rendered = look(developed(shifted(raw_dn, native), bias_dn))
    excess_dn = 0.0 if black_in is None else black_excess_dn(real, rendered)
    if black_in is not None and excess_dn:
        session.scene = with_black(session.scene, excess_dn, black_in)
        raw_dn = session.simulate(row).layers["raw"]
        rendered = look(developed(shifted(raw_dn, native), bias_dn))
    seconds = time.perf_counter() - start
    pose = trajectory.pose(row)
    sun_C = pose.T_from_C.T @ pose.sun_direction_T
    sun_xy = sun_C[:2] / max(float(np.linalg.norm(sun_C[:2])), 1e-9)
    return Pair(
        name=trajectory.name[row],
        real=real,
        rendered=rendered,
        figures=compare(real, rendered, sun_xy),
        shift_xy=(native[0] / BINNING, native[1] / BINNING),
        seconds=seconds,
    )


def with_pose(trajectory: Trajectory, row: int, position_T_m: Any, camera_from_T: Any) -> Trajectory:
    """Return a table with another position in m and quaternion camera_from_T in one row."""
    positions, turns = trajectory.camera_position_T_m.copy(), trajectory.camera_from_T.copy()
    positions[row], turns[row] = position_T_m, camera_from_T
    return replace(trajectory, camera_position_T_m=positions, camera_from_T=turns)


def reduced(frame: NDArray[np.uint8], width_px: int) -> NDArray[np.uint8]:
    """Return a frame at another width, by the means of areas."""
    height_px = round(frame.shape[0] * width_px / frame.shape[1])
    return np.asarray(cv2.resize(frame, (width_px, height_px), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def read_frame(folder: Path, name: str) -> NDArray[np.uint8]:
    """Return a real frame, uint8[y, x]. Raises InputError."""
    path = folder / f"{name}.png"
    data = user_files.read_input(path, "texture", types=(".png",))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise vbnfault.InputError(f"{path}: is no PNG image")
    return np.asarray(image, dtype=np.uint8)


def sheet(pairs: Sequence[Pair], across: int = 3) -> NDArray[np.uint8]:
    """Return the pairs real | rendered at full size, uint8[y, x], with the same stretch and their names."""
    cells = []
    for pair in pairs:
        halves = [
            np.clip(0.85 * one.image / max(one.bright, 1e-6), 0, 1) * 255 for one in (pair.real, pair.rendered)
        ]
        cell = np.hstack(halves).astype(np.uint8)
        f = pair.figures
        text = f"{pair.name}  IoU {f['iou']:.3f}  rank {f['rank']:.2f}  limb {f['limb_px']:.1f} px"
        cv2.putText(cell, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255, 1, cv2.LINE_AA)
        cells.append(cv2.copyMakeBorder(cell, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(90,)))
    cells += [np.zeros_like(cells[0])] * (-len(cells) % across)
    rows = [np.hstack(cells[k : k + across]) for k in range(0, len(cells), across)]
    return np.asarray(np.vstack(rows), dtype=np.uint8)


def write_pair(folder: Path, pair: Pair) -> None:
    """Write NAME_real.png and NAME_rendered.png, aligned, in 8 bits."""
    folder.mkdir(parents=True, exist_ok=True)
    for which, one in (("real", pair.real), ("rendered", pair.rendered)):
        cv2.imwrite(str(folder / f"{pair.name}_{which}.png"), one.image.astype(np.uint8))


def table(figures: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the summary as lines of text."""
    lines = [f"{'figure':<16}{'median':>10}{'worst 5 %':>11}"]
    lines += [
        f"{name:<16}{median:>10.4g}{worst:>11.4g}"
        for name, (median, worst) in figures.items()
        if not name.endswith((" real", " rendered"))
    ]
    lines.append(f"{'of the sky':<16}{'real':>10}{'rendered':>11}")
    for name in figures:
        if name.endswith(" real"):
            plain = name.removesuffix(" real")
            lines.append(f"{plain:<16}{figures[name][0]:>10.4g}{figures[f'{plain} rendered'][0]:>11.4g}")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Replay the frames of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=Path, required=True, help="folder of NAME.png and poses.csv")
    parser.add_argument("--poses", type=Path, help="table of poses; default: poses.csv in the folder")
    parser.add_argument("--shape", help="shape model of the body; default: that of the scene")
    parser.add_argument("--scene", default="navcam67p", help="scene with camera and ground")
    parser.add_argument(
        "--texture", action="store_true", help="ground as rough as the real one, which lowers the rank correlation"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a key of the scene")
    parser.add_argument(
        "--afrho-cm", type=float, default=AFRHO_CM, help="of the haze; 0: none (default %(default)s)"
    )
    parser.add_argument("--rows", help="rows to replay, such as 0,5,18; default: all")
    parser.add_argument("--width", type=int, help="width in px; default: that of the frames")
    parser.add_argument(
        "--mend-poses", type=int, default=0, metavar="N", help="mend each pose N times by a similarity (default: 0)"
    )
    parser.add_argument("--threads", type=int, help="render threads; default: every core")
    parser.add_argument("--out", type=Path, required=True, help="folder for replay.json and sheet.png")
    given = parser.parse_args(arguments)

    trajectory = load_trajectory(str((given.poses or given.frames / "poses.csv").resolve()))
    rows = [int(k) for k in given.rows.split(",")] if given.rows else list(range(len(trajectory)))
    overrides = options.overrides(given.set)
    if given.shape:
        overrides["body.shape"] = given.shape
    frames = {row: read_frame(given.frames, trajectory.name[row]) for row in rows}
    if given.width:
        frames = {row: reduced(frame, given.width) for row, frame in frames.items()}
    height, width = frames[rows[0]].shape
    if given.afrho_cm and vbnfault.load_scene(given.scene).coma is None:
        overrides = {"coma": {**HAZE, "afrho_cm": given.afrho_cm}, **overrides}
    scene = replay_scene(given.scene, (width, height), overrides, TEXTURE if given.texture else GROUND)
    session = vbnfault.Session(scene, threads=given.threads, poses=trajectory)
    detectors = [scene.camera.detector, str(write_high_gain(scene.camera.detector, given.out).resolve())]
    black_in = given.out / "sensors" if given.texture else None
    pairs = []
    for row in rows:
        pair = replay(session, trajectory, row, frames[row], detectors, given.mend_poses, black_in)
        f = pair.figures
        print(
            f"{pair.name}: IoU {f['iou']:.4f}, rank {f['rank']:.3f}, limb {f['limb_px']:.2f} px, shift "
            f"{pair.shift_xy[0]:+.1f} {pair.shift_xy[1]:+.1f} px, {pair.seconds:.1f} s",
            file=sys.stderr,
            flush=True,
        )
        pairs.append(pair)
        write_pair(given.out / "pairs", pair)
    figures = summary([pair.figures for pair in pairs])
    result = {
        "summary": {name: list(pair) for name, pair in figures.items()},
        "frames": {pair.name: {**pair.figures, "shift_xy_px": pair.shift_xy} for pair in pairs},
    }
    (given.out / "replay.json").write_text(json.dumps(result, indent=1))
    cv2.imwrite(str(given.out / "sheet.png"), sheet(pairs))
    print("\n".join(table(figures)))


if __name__ == "__main__":
    main()
