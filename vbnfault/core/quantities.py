"""Define the quantities that flow through the pipeline; each is a frozen array with its unit and its axes.

Radiance ─ lens ─▶ Irradiance ─ detector ─▶ Electrons ─▶ RGBI ─▶ Sample
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import NDArray

CHANNELS = ("R", "G", "B", "I")

# How a sensor moves and reads its charge. Every sample of a dataset has one of these.
Architecture = Literal["full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos"]
ARCHITECTURES: tuple[Architecture, ...] = get_args(Architecture)
# The side of the image towards which the rows, or columns, are read.
ReadoutDirection = Literal["up", "down", "left", "right"]
READOUT_DIRECTIONS: tuple[ReadoutDirection, ...] = get_args(ReadoutDirection)

# Rec. 709 luminance of linear RGB: the intensity channel of a camera without W pixels.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Quantity:
    """Hold an array with its unit and axes. The array becomes read-only: a step returns a new quantity."""

    array: NDArray[Any]

    unit: ClassVar[str] = "1"
    axes: ClassVar[tuple[str, ...]] = ()
    dtype: ClassVar[type] = np.float32

    def __post_init__(self) -> None:
        if self.array.ndim != len(self.axes):
            raise ValueError(f"{type(self).__name__} has axes {self.axes}, got shape {self.array.shape}")
        if self.array.dtype != self.dtype:
            raise TypeError(f"{type(self).__name__} is {self.dtype.__name__}, got {self.array.dtype}")
        self.array.flags.writeable = False

    def with_array(self, array: NDArray[Any]) -> Self:
        """Return the same quantity with another array of the same axes."""
        return replace(self, array=array)


@dataclass(frozen=True, kw_only=True, eq=False)
class SunInView:
    """Describe the Sun's disc as a camera sees it, independent of any pixels.

    - `direction_C` float64[3] points to its centre; `angular_radius_rad` is its radius.
    - `radiance_W_m2_sr_nm` float64[band] is the mean radiance of the disc.
    - `limb_darkening` float64[band, 6] is the disc's profile (`spectra.limb_darkening`); None: uniform.
    - `visible` float32[n, n] in [0, 1] is the fraction that body and spacecraft leave visible, for each cell of the
      square around the disc. Columns run along the first axis of `sundisc.axes`, rows along the second.
    - `blur_slope` is the radius of the blur circle that defocus makes of a point, as a tangent.
    """

    direction_C: NDArray[np.float64]
    angular_radius_rad: float
    radiance_W_m2_sr_nm: NDArray[np.float64]
    limb_darkening: NDArray[np.float64] | None = None
    visible: NDArray[np.float32] = field(default_factory=lambda: np.ones((1, 1), np.float32))
    blur_slope: float = 0.0

    def profiles(self, bands: Sequence[int]) -> NDArray[np.float64]:
        """Return the coefficients of polynomials in μ for the radiance over the disc's mean, float64[band, k]."""
        if self.limb_darkening is None:
            return np.ones((len(bands), 1))
        return self.limb_darkening[list(bands)]


@dataclass(frozen=True, kw_only=True, eq=False)
class FarSource:
    """Describe the light of a far body at the camera.

    Attributes
    ----------
    direction_C
        float64[3]: unit vector towards it in the camera frame C.
    angular_radius_rad
        Angular radius of its disc.
    irradiance_W_m2_nm
        float64[band]: irradiance of its visible part.
    """

    direction_C: NDArray[np.float64]
    angular_radius_rad: float
    irradiance_W_m2_nm: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class FineLight:
    """Hold points of light, and what they add to the pixels of a render.

    Attributes
    ----------
    slopes
        float64[point, 2]: tangents x/z and y/z in C.
    power
        float32[band, point]: radiance times projected solid angle, the irradiance on a plane across the boresight.
    depth_m
        float64[point]: depth in C of what sends the light, NaN of parts of the camera's own spacecraft.
    side_px
        float64[point]: side of the square that a point stands for, in pixels of a pinhole; 0: it is a point.
    rows, columns
        Window of the render's pixels that holds all of the light.
    mean
        float32[band, y, x]: radiance of the points averaged over each pixel of the window.
    """

    slopes: F64
    power: F32
    depth_m: F64
    side_px: F64
    rows: slice
    columns: slice
    mean: F32

    @classmethod
    def of(
        cls,
        *,
        slopes: F64,
        area_px: F64,
        radiance: F32,
        depth_m: F64,
        side_px: F64,
        intrinsics: F64,
        shape: tuple[int, int],
        projection: Any = None,
    ) -> FineLight:
        """Return the light of points in a frame of (height, width) pixels.

        Parameters
        ----------
        slopes
            float64[point, 2]: tangents in C. Points beyond the frame are kept for the lens.
        area_px
            float64[point]: area of each point in pixels of a pinhole with these intrinsics.
        radiance
            float32[band, point].
        depth_m, side_px
            As in the class.
        intrinsics
            fx, fy, cx and cy in pixels.
        projection
            The `sundisc.Projection` of the frame; default: that pinhole.
        """
        light = radiance * area_px.astype(np.float32)
        # cos⁴θ / (fx fy) is the projected solid angle of a pixel
        solid_sr = 1 / (intrinsics[0] * intrinsics[1] * (1 + (slopes**2).sum(axis=1)) ** 2)
        power = light * solid_sr.astype(np.float32)
        pixels, side = slopes * intrinsics[:2] + intrinsics[2:], side_px
        if projection is not None:
            towards = _forward(slopes)
            pixels = projection.pixel_of(towards)
            facing = 1 if projection.foreshortens else 1 / np.sqrt(1 + (slopes**2).sum(axis=1))
            stretch = solid_sr / (facing * projection.solid_angle_sr(towards))
            light, side = (light * stretch).astype(np.float32), side_px * np.sqrt(stretch)
        low, high = (np.floor(pixels + sign * side[:, None] / 2).astype(np.int64) for sign in (-1, 1))
        inside = ((high >= 0) & (low < shape[::-1])).all(axis=1)
        columns, rows = (
            (max(int(a.min()), 0), min(int(b.max()) + 1, size)) if len(a) else (0, 1)
            for a, b, size in zip(low[inside].T, high[inside].T, shape[::-1], strict=True)
        )
        window, corner = (rows[1] - rows[0], columns[1] - columns[0]), np.array([columns[0], rows[0]])
        mean = [splat(pixels[inside] - corner, band, window, side[inside]) for band in light[:, inside]]
        return cls(
            slopes=slopes,
            power=power,
            depth_m=depth_m,
            side_px=side_px,
            rows=slice(*rows),
            columns=slice(*columns),
            mean=np.stack(mean),
        )

    @property
    def directions(self) -> F64:
        """Return the directions of the points in C, float64[point, 3], with z = 1."""
        return _forward(self.slopes)

    def joined(self, other: FineLight | None) -> FineLight:
        """Return the light of both."""
        if other is None:
            return self
        rows, columns = (
            slice(min(a.start, b.start), max(a.stop, b.stop))
            for a, b in ((self.rows, other.rows), (self.columns, other.columns))
        )
        mean = np.zeros((len(self.mean), rows.stop - rows.start, columns.stop - columns.start), np.float32)
        for part in (self, other):
            top, left = part.rows.start - rows.start, part.columns.start - columns.start
            mean[:, top : top + part.mean.shape[1], left : left + part.mean.shape[2]] += part.mean
        return FineLight(
            slopes=np.concatenate([self.slopes, other.slopes]),
            power=np.concatenate([self.power, other.power], axis=1),
            depth_m=np.concatenate([self.depth_m, other.depth_m]),
            side_px=np.concatenate([self.side_px, other.side_px]),
            rows=rows,
            columns=columns,
            mean=mean,
        )

    def scaled(self, factor: float) -> FineLight:
        """Return the light multiplied by a factor."""
        return replace(self, power=self.power * np.float32(factor), mean=self.mean * np.float32(factor))

    def added_to(self, array: F32) -> F32:
        """Return a render, float32[band, y, x], with this light."""
        out = array.copy()
        out[:, self.rows, self.columns] += self.mean
        return out

    def removed_from(self, array: F32) -> F32:
        """Return a render, float32[band, y, x], without this light, which it contains."""
        out = array.copy()
        window = out[:, self.rows, self.columns]
        np.maximum(window - self.mean, 0, out=window)
        return out


def _forward(slopes: F64) -> F64:
    return np.column_stack([slopes, np.ones(len(slopes))])


_LEAST_SIDE_PX = 1e-9
_ROUNDED = 1e-9


def splat(pixels: F64, weights: F64, shape: tuple[int, int], side_px: F64 | None = None) -> F32:
    """Return weights, float64[point], on the four pixels around each position x, y, float32[height, width].

    Each is spread over a square of the side `side_px` float64[point], from 0 to 1; default: 1, which keeps the
    centroid of the weights, also from one pixel to the next. The sum is kept.
    """
    side = np.ones((len(pixels), 1)) if side_px is None else np.clip(side_px, _LEAST_SIDE_PX, 1)[:, None]
    first = np.floor(pixels - side / 2).astype(np.int64)
    part = np.clip((pixels + side / 2 - first - 1) / side, 0, 1)
    if side_px is not None:  # squares that meet the border of a pixel do not cross it by rounding
        part[part < _ROUNDED] = 0
        part[part > 1 - _ROUNDED] = 1
    x, y = part.T
    out = np.zeros(shape[0] * shape[1])
    for right, across in ((0, 1 - x), (1, x)):
        for down, along in ((0, 1 - y), (1, y)):
            column, row = first[:, 0] + right, first[:, 1] + down
            inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
            index = (row * shape[1] + column)[inside]
            out += np.bincount(index, (weights * across * along)[inside], len(out))
    return out.reshape(shape).astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Radiance(Quantity):
    """Hold the spectral radiance at the camera at the band nodes `wavelength_nm` float64[band].

    `sun` float32[band, y, x] is the part of `array` that comes from the Sun's disc; None where the Sun is not in
    view. `disc` describes this disc, for a lens that images it on its own grid; None where it is not known.
    `fine` is the part of `array` that comes from a body of few pixels, with positions within pixels; None without.
    """

    wavelength_nm: NDArray[np.float64]
    sun: NDArray[np.float32] | None = None
    disc: SunInView | None = None
    fine: FineLight | None = None
    unit = "W m-2 sr-1 nm-1"
    axes = ("band", "y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class Irradiance(Quantity):
    """Hold the spectral irradiance on the sensor plane at the band nodes `wavelength_nm` float64[band].

    `transmittance` float64[n] at `spectra.fine_nodes_nm` is that of the lens: in every band, the light has the
    spectrum of sunlight behind it. None: that of sunlight.
    """

    wavelength_nm: NDArray[np.float64]
    transmittance: NDArray[np.float64] | None = None
    unit = "W m-2 nm-1"
    axes = ("band", "y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class Electrons(Quantity):
    """Hold electrons per pixel and channel; every pixel has all channels, R, G, B or those of the mosaic.

    `white_e` float32[channel] is the signal of each channel that the 8-bit image shows as 255. Expected
    (noise-free) photo-electrons may lie above it, since the detector applies saturation later.

    `past_rims` float32[y, x, channel] is additional light, not contained in `array`, whose losses at the lens's
    pupil and rims are included already: the Sun's direct image and its traced straylight. The lens's own vignetting
    does not reduce it again. A fault at the rims, such as a slipped ring or a moved hood, multiplies all of it by
    one fraction, that of the Sun's beam which clears the fault (`Fault.past_rims`). None: there is no
    such light.
    """

    white_e: NDArray[np.float32]
    past_rims: NDArray[np.float32] | None = None
    unit = "e-"
    axes = ("y", "x", "channel")

    @property
    def merged(self) -> Electrons:
        """Return all light in one array, as the detector needs it. It is added anew, so that no copy is kept."""
        if self.past_rims is None:
            return self
        return replace(self, array=self.array + self.past_rims, past_rims=None)

    def scaled(self, factor: float) -> Electrons:
        """Return all light multiplied by a factor; a plane of no light past the rims becomes None."""
        times, past = np.float32(factor), self.past_rims
        return replace(
            self, array=self.array * times, past_rims=past * times if past is not None and past.any() else None
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Charge(Quantity):
    """Hold the electrons in each pixel of a mosaic, either expected or collected."""

    unit = "e-"
    axes = ("y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class Offset(Quantity):
    """Hold the readout offset of each mosaic pixel in electrons, of either sign, which has no shot noise."""

    unit = "e-"
    axes = ("y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class RawMosaic(Quantity):
    """Hold the digital numbers of a mosaic, bias included."""

    unit = "DN"
    axes = ("y", "x")
    dtype = np.uint16


@dataclass(frozen=True, kw_only=True, eq=False)
class RGBI(Quantity):
    """Hold the 8-bit image: R, G, B and intensity."""

    unit = "DN"
    axes = ("y", "x", "channel")
    dtype = np.uint8


# Values of `Truth.semantic`.
SKY, BODY, SUN, SPACECRAFT = 0, 1, 2, 3


# Defects of a mosaic pixel, as bits. `rts`: the pixel has a random telegraph signal; `rts_high`: this signal was at
# its upper level for more than half of the exposure.
HOT, DEAD, STUCK, RTS, RTS_HIGH, TRAP = (np.uint8(1 << k) for k in range(6))
DEFECTS = ("hot", "dead", "stuck", "rts", "rts_high", "trap")


class SoftKind(NamedTuple):
    """Describe a kind of soft layer, which gives the strength of a fault in each pixel.

    `neutral` is the layer's value where the fault is not injected; `meaning` says what the layer holds.
    """

    units: str
    neutral: float
    dtype: str
    meaning: str


# The keys are the endings of the layers' names, as in dust_opacity.
SOFT_KINDS = {
    "opacity": SoftKind("1", 0.0, "float16", "fraction of the light that is lost"),
    "factor": SoftKind("1", 1.0, "float16", "factor on the light, 1 where nothing is lost"),
    "added": SoftKind(
        "DN",
        0.0,
        "float32",
        "light added before any other fault, as intensity, linear and not clipped: 255 is white",
    ),
}


def soft_kind(layer: str) -> SoftKind:
    """Return the kind of a soft layer. Raises KeyError where its name has no ending of `SOFT_KINDS`."""
    return SOFT_KINDS[layer.rpartition("_")[2]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """Hold the noise-free truth at the pixel centres.

    - `depth_m` float32[y, x]: depth along the boresight, inf on the sky.
    - `normal` float16[y, x, 3]: surface normal in C, interpolated over the facet, 0 on the sky. At the limb it is
      turned where needed, so that it makes at most a right angle with the direction to the camera.
    - `semantic` uint8[y, x]: 0 sky, 1 body, 2 Sun, 3 spacecraft.
    - `incidence_deg`, `emission_deg` float32[y, x]: angles from the normal to the Sun and to the camera.
    - `phase_deg` float32[y, x]: angle between the directions to the Sun and to the camera.
    - `dust` float32[y, x]: fraction in [0, 1] of the ground that dust covers.
    - `albedo_factor` float32[y, x]: factor of the map of the albedo, None without a map.
    - `material` int32[y, x]: index of the spacecraft's material that a pixel shows, -1 where there is none.

    The angles and `dust` are NaN on the sky and None unless asked for; `material` is None without a spacecraft.
    """

    depth_m: NDArray[np.float32]
    normal: NDArray[np.float16]
    semantic: NDArray[np.uint8]
    incidence_deg: NDArray[np.float32] | None = None
    emission_deg: NDArray[np.float32] | None = None
    phase_deg: NDArray[np.float32] | None = None
    dust: NDArray[np.float32] | None = None
    material: NDArray[np.int32] | None = None
    albedo_factor: NDArray[np.float32] | None = None

    def frozen(self) -> Self:
        """Return the same truth, whose arrays have become read-only: several samples share them."""
        for array in vars(self).values():
            if array is not None:
                array.flags.writeable = False
        return self


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """Hold one finished sample: the layers and scalars that the store holds, under the names of its arrays.

    `layers` maps an array's name to an ndarray; `scalars` maps it to a number, a small vector or a string.
    """

    index: int
    layers: Mapping[str, NDArray[Any]]
    scalars: Mapping[str, Any] = field(default_factory=dict)


F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
