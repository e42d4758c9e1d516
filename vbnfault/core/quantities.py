"""The quantities that flow through the pipeline: an array, its unit and its axes, frozen.

Radiance ─ lens ─▶ Irradiance ─ detector ─▶ Electrons ─▶ RawDN ─▶ RGBI ─▶ Sample
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

CHANNELS = ("R", "G", "B", "I")

# Rec. 709 luminance of linear RGB; the intensity channel of a camera without a W pixel.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Quantity:
    """Base of all quantities. Arrays are made read-only: a step returns a new quantity, never edits one."""

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
        """The same quantity with another array of the same axes."""
        return replace(self, array=array)


@dataclass(frozen=True, kw_only=True, eq=False)
class SunInView:
    """The Sun's disc as a camera sees it, before any pixels.

    `direction_C` float64[3] and `angular_radius_rad` say where it is, `radiance_W_m2_sr_nm` float64[band] is the
    mean of the disc, `limb_darkening` float64[band, 6] its profile (`spectra.limb_darkening`; None: uniform).
    `visible` float32[n, n] in [0, 1] is the fraction that body and spacecraft leave of cells of the square about
    the disc: columns along the first of the disc's axes (`sundisc.axes`), rows along the second. `blur_slope`:
    radius of the circle that defocus makes of a point, as a tangent.
    """

    direction_C: NDArray[np.float64]
    angular_radius_rad: float
    radiance_W_m2_sr_nm: NDArray[np.float64]
    limb_darkening: NDArray[np.float64] | None = None
    visible: NDArray[np.float32] = field(default_factory=lambda: np.ones((1, 1), np.float32))
    blur_slope: float = 0.0

    def profiles(self, bands: Sequence[int]) -> NDArray[np.float64]:
        """Return the polynomials of the radiance over the disc's mean in μ, float64[band, k]."""
        if self.limb_darkening is None:
            return np.ones((len(bands), 1))
        return self.limb_darkening[list(bands)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Radiance(Quantity):
    """Spectral radiance at the camera, per band node; `wavelength_nm` float64[band].

    `sun` is the part of `array` that is the Sun's own disc, float32[band, y, x]; None where it is not in view.
    `disc` is the disc that it shows, for a lens with a grid of its own; None where it is not known.
    """

    wavelength_nm: NDArray[np.float64]
    sun: NDArray[np.float32] | None = None
    disc: SunInView | None = None
    unit = "W m-2 sr-1 nm-1"
    axes = ("band", "y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class Irradiance(Quantity):
    """Spectral irradiance on the sensor plane, per band node; `wavelength_nm` float64[band]."""

    wavelength_nm: NDArray[np.float64]
    unit = "W m-2 nm-1"
    axes = ("band", "y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class Electrons(Quantity):
    """Electrons per pixel and channel: R, G, B, or those of the detector's mosaic, each at every pixel.

    `white_e` float32[channel]: the signal of each channel that the 8 bit image shows as 255. Expected (noise-free)
    photo-electrons may lie above it; saturation belongs to the detector.

    `past_rims` float32[y, x, channel] is light beside that of `array` which has met the lens's pupil and rims
    already: the Sun's direct image and its traced straylight. Vignetting leaves it as it is. None: there is none.
    """

    white_e: NDArray[np.float32]
    past_rims: NDArray[np.float32] | None = None
    unit = "e-"
    axes = ("y", "x", "channel")

    @cached_property
    def merged(self) -> Electrons:
        """All light in one array, as the detector takes it."""
        if self.past_rims is None:
            return self
        return replace(self, array=self.array + self.past_rims, past_rims=None)

    def scaled(self, factor: float) -> Electrons:
        """All light times a factor."""
        past = None if self.past_rims is None else self.past_rims * np.float32(factor)
        return replace(self, array=self.array * np.float32(factor), past_rims=past)


@dataclass(frozen=True, kw_only=True, eq=False)
class RawDN(Quantity):
    """Digital numbers of the analogue-to-digital converter, bias included, per colour R, G, B."""

    unit = "DN"
    axes = ("y", "x", "channel")
    dtype = np.uint16


@dataclass(frozen=True, kw_only=True, eq=False)
class Charge(Quantity):
    """Electrons in each pixel of a mosaic: expected, or collected."""

    unit = "e-"
    axes = ("y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class Offset(Quantity):
    """What each pixel of a mosaic reads above its charge, electrons of either sign: no charge, so without noise."""

    unit = "e-"
    axes = ("y", "x")


@dataclass(frozen=True, kw_only=True, eq=False)
class RawMosaic(Quantity):
    """Digital numbers of a mosaic, bias included."""

    unit = "DN"
    axes = ("y", "x")
    dtype = np.uint16


@dataclass(frozen=True, kw_only=True, eq=False)
class RGBI(Quantity):
    """The 8 bit image: R, G, B and intensity."""

    unit = "DN"
    axes = ("y", "x", "channel")
    dtype = np.uint8


# Values of `Truth.semantic`.
SKY, BODY, SUN, SPACECRAFT = 0, 1, 2, 3


# What may be wrong with a pixel of a mosaic, as bits. `rts`: it has a telegraph signal; `rts_high`: one that was in
# its upper level for more than half of the exposure.
HOT, DEAD, STUCK, RTS, RTS_HIGH, TRAP = (np.uint8(1 << k) for k in range(6))
DEFECTS = ("hot", "dead", "stuck", "rts", "rts_high", "trap")


class SoftKind(NamedTuple):
    """A kind of layer that says how strongly a fault acts on each pixel: its `units`, the value `neutral` where the
    fault is not injected, its `dtype`, and what it holds."""

    units: str
    neutral: float
    dtype: str
    meaning: str


# By the ending of a layer's name, as in dust_opacity.
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
    """Return the kind of a soft layer. Raises KeyError where its name does not end as one of `SOFT_KINDS`."""
    return SOFT_KINDS[layer.rpartition("_")[2]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """Noise-free truth of the pixel centres.

    `depth_m` float32[y, x], along the boresight, inf on the sky; `normal` float16[y, x, 3] in C, 0 on the sky: the
    surface's own, interpolated over its facet, at the limb no further from the camera than at right angles to it;
    `semantic` uint8[y, x]: 0 sky, 1 body, 2 Sun, 3 spacecraft. Where asked for, float32[y, x], NaN on the sky:
    `incidence_deg` and `emission_deg` from the normal to the Sun and to the camera, `phase_deg` between the two,
    and `dust`, how far the ground is covered, in [0, 1]; with a spacecraft also `material` int32[y, x], which
    of its materials a pixel shows, -1 where none.
    """

    depth_m: NDArray[np.float32]
    normal: NDArray[np.float16]
    semantic: NDArray[np.uint8]
    incidence_deg: NDArray[np.float32] | None = None
    emission_deg: NDArray[np.float32] | None = None
    phase_deg: NDArray[np.float32] | None = None
    dust: NDArray[np.float32] | None = None
    material: NDArray[np.int32] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One finished sample: the layers and scalars that the store holds, by the names of its arrays.

    `layers` maps array name to ndarray; `scalars` maps array name to number, small vector or string.
    """

    index: int
    layers: Mapping[str, NDArray[Any]]
    scalars: Mapping[str, Any] = field(default_factory=dict)
