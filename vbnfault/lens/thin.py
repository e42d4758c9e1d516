"""Image a scene with an ideal thin lens: rectilinear, without distortion or ghosts, with finite depth of field.

It images points as points, unless it is given a point spread (`halo`).

The paper's nominal camera has no cos⁴ falloff: an extended scene gives the irradiance π T L / (4 N²) at every field
angle, and natural vignetting is a fault of its own. The Sun, however, is a source of known flux, and a pupil of
area A admits E☉ A cos θ of it. The Sun's direct image therefore follows the pupil,

    ∫ E dA = E☉ · T · A · cos θ        at every angle θ,

which is cos⁴θ times what the scene's rule would give, because the image of a disc far off the axis covers 1 / cos³θ
of its area on the axis. Ghosts, starburst and veiling glare are fractions of the same flux. All this light has
already passed the pupil. Vignetting, which adds the cos⁴ to the scene, must not dim it a second time
(`quantities.Electrons.past_rims`).

The point spread (`Halo`) blurs by a core and by the light that optics and sensor scatter, in a halo and in wings.
Measured point spreads of cameras consist of a narrow core and of light that falls as a power of the angle. Here

    PSF(θ) = (1 - Σ hᵢ) · exp(-θ² / 2σ²) / (2π σ²) + Σ hᵢ · (pᵢ - 2) / (2π θᵢ²) · (1 + θ² / θᵢ²)^(-pᵢ/2),

a Gaussian and two profiles of Moffat (1969, A&A 3, 455). It is the same over the frame and in all bands, and
conserves the light of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from ..core.calibration import Calibration
from ..core.quantities import Irradiance, Radiance
from ..core.sundisc import Pinhole, Projection, slopes_of

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ThinLens:
    """Describe a thin lens; `focus_distance_m` is the object distance in focus (inf: focused at infinity).

    `halo` is its point spread, None for an ideal image; pixels then subtend `pixel_rad`. The `calibration` of the
    frame distorts the image; None: it is rectilinear. The class answers the same questions as a `RealLens`.
    """

    focal_length_mm: float
    f_number: float
    transmission: float = 1.0
    focus_distance_m: float = float("inf")
    halo: Halo | None = None
    pixel_rad: float = 0.0
    calibration: Calibration | None = None

    name: ClassVar[str] = "thin lens"
    resamples: ClassVar[bool] = False
    falls_off: ClassVar[bool] = False
    guard_px: ClassVar[tuple[int, int]] = (0, 0)
    border_px: ClassVar[int] = 0
    distortion_residual_px: ClassVar[tuple[float, float]] = (0.0, 0.0)

    @property
    def blurs(self) -> bool:
        """Return whether the lens has a point spread."""
        return self.halo is not None

    @property
    def real(self) -> None:
        """Return None: the lens has no surfaces."""

    @property
    def figures(self) -> dict[str, str | float]:
        """Return name, focal length, f-number, transmission, and a sentence `summary` for people."""
        calibrated = "" if self.calibration is None else f", calibrated by the model {self.calibration.model}"
        return {
            "name": self.name,
            "efl_mm": self.focal_length_mm,
            "f_number": self.f_number,
            "transmission": self.transmission,
            "summary": f"{self.name} of {self.focal_length_mm:.4g} mm, f/{self.f_number:.3g}{calibrated}",
        }

    @property
    def aperture_radius_m(self) -> float:
        """Return the radius of the entrance pupil, f / 2N, in metres."""
        return self.focal_length_mm * 1e-3 / (2 * self.f_number)

    def transmittance(self, wavelength_nm: F64) -> F64:
        """Return the fraction of the light that the lens transmits, float64[band], the same at every wavelength."""
        return np.full(len(wavelength_nm), float(self.transmission))

    def pupil_area_mm2(self, slope: ArrayLike) -> F64:
        """Return the area of the beam that passes the pupil, π (f / 2N)², for any tangent of the field angle.

        It lies across the axis. The pupil of a fisheye turns towards the light, which widens it by 1 / cos θ.
        """
        area = np.full(np.shape(slope), np.pi * (self.focal_length_mm / (2 * self.f_number)) ** 2)
        if self.calibration is None or self.calibration.foreshortens:
            return area
        return np.asarray(area * np.sqrt(1 + np.square(slope)))

    @property
    def distortion(self) -> F64:
        """Return OpenCV's coefficients: eight that are 0, or those of the calibration."""
        if self.calibration is None:
            return np.zeros(8)
        return np.array(list(self.calibration.stored_coefficients.values()))

    @property
    def distortion_valid_to_deg(self) -> float:
        """Return the angle from the boresight up to which `distortion` holds."""
        return 90.0 if self.calibration is None else self.calibration.valid_to_deg

    def distorted(self, slope: F64) -> F64:
        """Return the tangents of the field angles: they are the image heights in focal lengths."""
        return slope

    def field_slopes(self, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
        """Return the tangents of the field angles of image heights in focal lengths from the middle of the frame.

        Without a calibration they are the heights.
        """
        if self.calibration is None:
            return x, y
        f, size = self.calibration.focal_length_px, (self.calibration.width_px, self.calibration.height_px)
        d = self.calibration.directions_of(np.stack([x * f + size[0] / 2, y * f + size[1] / 2], axis=-1))
        slopes = slopes_of(d)
        return slopes[..., 0].astype(np.float32), slopes[..., 1].astype(np.float32)

    def projection(self, intrinsics: F64) -> Projection:
        """Return the map between directions and pixels; `intrinsics` are fx, fy, cx, cy of a rectilinear one."""
        return self.calibration or Pinhole(intrinsics)

    def on_axis(self, radiance: Radiance) -> Irradiance:
        """Return the irradiance of radiance of any shape, which does not depend on the position in the image."""
        solid_angle_sr = np.float32(np.pi * self.transmission / (4 * self.f_number**2))
        return Irradiance(array=radiance.array * solid_angle_sr, wavelength_nm=radiance.wavelength_nm)

    def on_frame(self, radiance: Radiance) -> Radiance:
        """Return the radiance itself: the image has the grid of the render."""
        return radiance

    def spread(self, light: F32, wavelength_nm: float) -> F32:
        """Return light on the frame, float32[y, x], after the point spread, which is the same in all bands."""
        return light if self.halo is None else np.asarray(self.halo.applied(light, self.pixel_rad))

    def image(self, radiance: Radiance) -> Irradiance:
        """Return the irradiance on the sensor plane, E = π T L / (4 N²), per band.

        It contains no cos⁴: the paper's nominal camera renders without it, and vignetting is a fault of its own
        (physics.md, section 6, warns of counting it twice).
        """
        sharp = self.on_axis(radiance)
        if self.calibration is not None and self.calibration.circle_deg is not None:
            sharp = replace(sharp, array=sharp.array * image_circle(self.calibration))
        if self.halo is None:
            return sharp
        return replace(sharp, array=np.asarray(self.halo.applied(sharp.array, self.pixel_rad)))

    def image_of_sun(self, radiance: Radiance, pixel_pitch_um: float) -> Irradiance:
        """Return the irradiance of the Sun's direct image, π T L cos⁴θ / (4 N²), per band.

        Its power is E☉ T A cos θ at every field angle, the flux that the pupil admits; that of a fisheye turns
        towards the light and admits E☉ T A.
        """
        as_scene = self.on_axis(radiance).array
        shape = as_scene.shape[1:]
        size, focal_length_px = (int(shape[0]), int(shape[1])), self.focal_length_mm * 1e3 / pixel_pitch_um
        array = as_scene * natural_falloff(self.calibration, size, focal_length_px)
        if self.halo is not None:
            # in float64: the rounding errors of the Sun's disc may be as bright as the scene
            array = np.asarray(self.halo.applied(array.astype(np.float64), self.pixel_rad), dtype=np.float32)
        return Irradiance(array=array, wavelength_nm=radiance.wavelength_nm)


# --- a rectilinear frame -----------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def cos4_map(shape: tuple[int, int], focal_length_px: float) -> F32:
    """Return cos⁴ of the off-axis angle of every pixel's centre, float32[y, x] in (0, 1], read-only."""
    height, width = shape
    x2 = ((np.arange(width) + 0.5 - width / 2) / focal_length_px) ** 2
    y2 = ((np.arange(height) + 0.5 - height / 2) / focal_length_px) ** 2
    cos2 = 1 / (1 + x2[None, :] + y2[:, None])
    out = (cos2 * cos2).astype(np.float32)
    out.flags.writeable = False
    return out


@lru_cache(maxsize=2)
def natural_falloff(calibration: Calibration | None, shape: tuple[int, int], focal_length_px: float) -> F32:
    """Return the light of a uniform scene through a pupil of one size, float32[y, x], read-only; 1 on the axis.

    It is cos⁴θ in a rectilinear frame. In a calibrated one it is the solid angle of every pixel, over that of a
    pinhole's pixel on the axis.
    """
    if calibration is None:
        return cos4_map(shape, focal_length_px)
    seen = calibration.directions_at(*(np.arange(size) + 0.5 for size in shape[::-1]))
    out = (calibration.solid_angle_sr(seen) * calibration.fx * calibration.fy).astype(np.float32)
    out *= image_circle(calibration)
    out.flags.writeable = False
    return out


@lru_cache(maxsize=2)
def image_circle(calibration: Calibration) -> NDArray[np.bool_]:
    """Return the pixels of a calibration's frame whose centres lie in its image circle, bool[y, x], read-only."""
    size = calibration.width_px, calibration.height_px
    out = calibration.is_lit(calibration.directions_at(*(np.arange(n) + 0.5 for n in size)))
    out.flags.writeable = False
    return out


def beyond_frame(
    sun_slope: ArrayLike, sine: F64, angle_rad: F64, half_slope: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return which directions around the Sun lie in front of the lens but outside the frame.

    Parameters
    ----------
    sun_slope
        float64[2], tangents of the Sun's direction along x and y.
    sine, angle_rad
        float64[radius] and float64[angle]: polar coordinates of directions about the Sun, in direction cosines.
    half_slope
        Tangents at the frame's right and lower edges.

    Returns
    -------
    bool[radius, angle]
    """
    sun = np.asarray(sun_slope, dtype=np.float64)
    sun = sun / np.sqrt(1 + sun @ sun)
    u = sun[0] + sine[:, None] * np.cos(angle_rad)
    v = sun[1] + sine[:, None] * np.sin(angle_rad)
    cos2 = 1 - u * u - v * v
    forward = cos2 > 0
    inside = (u * u <= half_slope[0] ** 2 * cos2) & (v * v <= half_slope[1] ** 2 * cos2)
    return np.asarray(forward & ~inside)


# --- a point spread with a halo ---------------------------------------------------------------------------------


_FINE_PX = 8  # up to this distance from the centre, the halo is averaged over pixels
_FINE = 9  # points along each side of a pixel for that


@dataclass(frozen=True, kw_only=True)
class Halo:
    """Describe a point spread with a halo.

    `core_rad` is σ, and `core_y_rad` that along columns; None: the same. `halo_fraction`, `halo_rad` and
    `halo_index` are h, θ and p of the halo, the fields `wing_…` those of the wings; p is above 2. Angles are in
    radians.
    """

    core_rad: float
    halo_fraction: float
    halo_rad: float
    halo_index: float
    wing_fraction: float = 0.0
    wing_rad: float = 1.0
    wing_index: float = 3.0
    core_y_rad: float | None = None

    def applied(self, light: NDArray[np.floating], pixel_rad: float) -> NDArray[np.floating]:
        """Return light, float[..., y, x], after the point spread, at least 0.

        Beyond its edges the frame continues as its mirror image. So the sum is kept, and a body that fills the
        frame is not darker at its edges.

        Parameters
        ----------
        light
            Light on the pixels of the frame. float64 keeps the rounding errors of the Sun's disc small.
        pixel_rad
            Angle that a pixel subtends.
        """
        response = _response(self, pixel_rad, (int(light.shape[-2]), int(light.shape[-1])))
        out = np.empty_like(light)
        for index in np.ndindex(light.shape[:-2]):
            waves = scipy.fft.dctn(light[index], type=2)
            waves *= response.astype(light.dtype)
            out[index] = scipy.fft.idctn(waves, type=2, overwrite_x=True)
        return np.maximum(out, 0, out=out)

    def on_pixels(self, pixel_rad: float, shape: tuple[int, int]) -> F64:
        """Return the fractions of a pixel's light at offsets (y, x) of 0 to `shape` pixels, float64[y + 1, x + 1].

        The sum over offsets of either sign is 1; at the largest offsets, both signs are the same pixel.
        """
        sigmas_rad = (self.core_y_rad or self.core_rad, self.core_rad)
        core = [_gaussian(rad / pixel_rad, size) for rad, size in zip(sigmas_rad, shape, strict=True)]
        out = (1 - self.halo_fraction - self.wing_fraction) * core[0][:, None] * core[1]
        out += self.halo_fraction * _moffat(self.halo_rad / pixel_rad, self.halo_index, shape)
        if self.wing_fraction:
            out += self.wing_fraction * _moffat(self.wing_rad / pixel_rad, self.wing_index, shape)
        return np.asarray(out)


def _moffat(scale_px: float, index: float, shape: tuple[int, int]) -> F64:
    """Return Moffat's profile, averaged over each pixel around the centre of an image; its sum is 1."""

    def profile(down: F64, across: F64) -> F64:
        return np.asarray((1 + (down[:, None] ** 2 + across**2) / scale_px**2) ** (-index / 2))

    y, x = (np.arange(size + 1, dtype=np.float64) for size in shape)
    out = profile(y, x)
    near = tuple(min(_FINE_PX, size) for size in shape)
    inside = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    fine = profile(*((np.arange(size)[:, None] + inside).ravel() for size in near))
    out[: near[0], : near[1]] = fine.reshape(near[0], _FINE, near[1], _FINE).mean(axis=(1, 3))
    # how many pixels have each of the offsets
    weights = [np.where((np.arange(n) == 0) | (np.arange(n) == n - 1), 1.0, 2.0) for n in out.shape]
    return out / (out * weights[0][:, None] * weights[1]).sum()


def _gaussian(sigma_px: float, size: int) -> F64:
    """Return a Gaussian averaged over pixels at offsets of 0 to `size`, whose sum over both signs is 1."""
    edges = np.arange(size + 2) - 0.5
    values = np.diff(ndtr(edges / max(sigma_px, 1e-6)))
    return np.asarray(values / (values[0] + values[-1] + 2 * values[1:-1].sum()))


@lru_cache(maxsize=2)
def _response(halo: Halo, pixel_rad: float, shape: tuple[int, int]) -> F64:
    """Return by how much each cosine wave of a frame is damped, float64[y, x], read-only."""
    waves = scipy.fft.dctn(halo.on_pixels(pixel_rad, shape), type=1)[: shape[0], : shape[1]]
    waves.flags.writeable = False
    return np.asarray(waves)
