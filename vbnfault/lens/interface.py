"""Define what every lens of a camera answers, whether it is ideal or made of surfaces.

`thin.ThinLens` and `imaging.RealLens` are the two kinds. Code above this package asks a lens what it does and never
which class it has, so that another kind of lens only has to answer the same questions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.quantities import Irradiance, Radiance
from ..core.sundisc import Projection

if TYPE_CHECKING:
    from .imaging import RealLens

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class Lens(Protocol):
    """Map a scene's radiance to irradiance on the sensor. Lenses are immutable and hashable."""

    def __hash__(self) -> int:
        """Return a hash, which caches need; equal lenses have equal hashes."""

    @property
    def name(self) -> str:
        """Return the name that the dataset stores."""

    @property
    def figures(self) -> dict[str, str | float]:
        """Return name, focal length, f-number and transmission, and a sentence `summary` for people."""

    @property
    def real(self) -> RealLens | None:
        """Return the lens itself if it has surfaces through which rays can be traced; None for an ideal lens."""

    # --- what kind of image it makes

    @property
    def resamples(self) -> bool:
        """Return whether the image lies on another grid than the pinhole render from which it is made."""

    @property
    def blurs(self) -> bool:
        """Return whether `image` contains the lens's point spread."""

    @property
    def falls_off(self) -> bool:
        """Return whether `image` contains the lens's vignetting, natural (cos⁴) and mechanical."""

    # --- paraxial properties

    @property
    def focal_length_mm(self) -> float:
        """Return image height over the tangent of the field angle near the axis, in mm."""

    @property
    def f_number(self) -> float:
        """Return the focal length over the diameter of the axial beam."""

    @property
    def transmission(self) -> float:
        """Return the transmittance along the axis at the d line, in (0, 1]."""

    @property
    def aperture_radius_m(self) -> float:
        """Return the radius of the axial beam at the entrance, in m."""

    @property
    def focus_distance_m(self) -> float:
        """Return the object distance in focus, in m; inf: focused at infinity."""

    def transmittance(self, wavelength_nm: F64) -> F64:
        """Return the fraction of the axial light that the lens transmits, float64 like `wavelength_nm`."""

    def pupil_area_mm2(self, slope: ArrayLike) -> F64:
        """Return the area of the beam that passes, float64 like `slope`, the tangents of its field angles."""

    # --- geometry

    def distorted(self, slope: F64) -> F64:
        """Return image heights in focal lengths for tangents of field angles, float64 like `slope`."""

    def field_slopes(self, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
        """Return the tangents of the field angles, along x and y, that are imaged at (x, y) in focal lengths."""

    def projection(self, intrinsics: F64) -> Projection:
        """Return the map between directions and pixels at the d line.

        `intrinsics` are the camera's fx, fy, cx, cy. A lens that knows its own pixels does not use them.
        """

    @property
    def distortion(self) -> F64:
        """Return OpenCV's k1, k2, p1, p2, k3, k4, k5, k6, float64[8]."""

    @property
    def distortion_valid_to_deg(self) -> float:
        """Return the angle from the axis up to which `distortion` holds; farther directions may fold back."""

    @property
    def distortion_residual_px(self) -> tuple[float, float]:
        """Return the RMS and the largest distance of `distortion` from the lens's chief rays, in pixels."""

    @property
    def guard_px(self) -> tuple[int, int]:
        """Return how many pixels beyond each side of the frame, in x and in y, the lens needs from a render."""

    # --- images

    @property
    def border_px(self) -> int:
        """Return how many pixels beyond each side of the frame `spread` needs."""

    def spread(self, light: F32, wavelength_nm: float) -> F32:
        """Return light on the pixels of the frame, float32[y, x], after the point spread of one wavelength.

        `light` lies on the grid of the image, with `border_px` more pixels beyond each side of the frame.
        """

    def image(self, radiance: Radiance) -> Irradiance:
        """Return the irradiance on the sensor, float32[band, y, x], of a render with its guard band."""

    def image_of_sun(self, radiance: Radiance, pixel_pitch_um: float) -> Irradiance:
        """Return the irradiance of the Sun's direct image, whose power is what the pupil admits, E☉ T A cos θ."""

    def on_axis(self, radiance: Radiance) -> Irradiance:
        """Return the irradiance of radiance of any shape, as if all of it lay on the axis."""

    def on_frame(self, radiance: Radiance) -> Radiance:
        """Return a render, without its guard band, on the grid of the image: no light is lost, nothing blurred."""
