"""Simulate degraded optics by physics: a hazy film, scratches, glass browned by radiation, worn coatings.

    I' = T_c · [(1 - h - Σ s) · I + h · (I ∗ H) + Σ s · (I ∗ S)]     for each channel c

- Film: molecules or fine dust that settled on the lens scatter the fraction h of the light. The BSDF is Harvey's,
  b0 [1 + (β/L)²]^(S/2), with unit integral over all angles. On the sensor, the distance over the focal length is
  the tangent of the scattering angle, and β is the sine of that angle.
- Scratch: a scratch of width w scatters the fraction s of the light, which is its area over that of the beam on the
  front. It scatters across its own direction, as a slit of width w diffracts: sinc²(π w β/λ). The code uses a
  Lorentz curve with half width λ/(2π w), whose tail equals that of sinc² averaged over its fringes. Scratches are
  bent, so a streak fans out.
- Glass darkens with dose by exp(-a0 D (λ0/λ)^p) per mm of its thickness on the axis (form of Appourchaux et al.
  1994, Opt. Eng. 33, 1659, without saturation). The coefficients are assumed. They have the size that crown glasses
  show (half of the light lost in 10 mm at 400 nm after 100 krad). Silica and glasses stabilised with cerium, whose
  names have a G and a number after their type as in BK7G18, have a hundredth of these coefficients. Recovery is
  left out.
- Coatings: where a fraction of their area is gone, a surface reflects the mean of coated and bare glass, weighted
  by area. The image loses this light, and the ghosts of straylight gain.

T_c is the transmittance averaged over wavelength, weighted by sunlight and by the response of the channel. The
light is not clipped: the Sun in the frame, 10⁵ times white, floods it at a haze of a few per cent, as it would in
reality. The surroundings of the frame are its mirror image, clipped to white. Light scattered by more than the
width of a frame is lost.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..core import spectra
from ..core.spectra import Bands
from ..lens import Prescription
from ..lens.coating import reflect_transmit
from ..lens.image_frame import ImageFrame
from ..lens.straylight.scatter import Harvey
from .context import FaultContext, Params
from .contract import LensFault, first_of, scaled
from .fields import Interval, Severity, bounds, choice, number
from .planes import cell_px, strewn, times

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_REFERENCE_NM = 400.0  # λ0 of browning
_STREAK_NM = 550.0  # wavelength that sets the width of streaks
_STABILISED = 0.01  # browning of stabilised glass over that of ordinary glass
_SOFT_CELLS = 0.7  # least standard deviation of a streak's width, in cells
_FINE = 8  # samples of a cell along each axis, near the middle of a kernel


@dataclass(frozen=True, kw_only=True)
class Contamination(LensFault):
    """Add haze, scratches, browning and coating loss to a lens."""

    fault = "optics_degradation"
    model = "contamination"
    step = "electrons"
    severity = Severity(key="haze", low=1e-3, high=0.9)
    localised = False

    coating: str = choice(
        "mgf2", ("as_prescribed", "none", "mgf2", "v", "bbar"), doc="of surfaces between glass and air, when whole"
    )
    haze: Interval = bounds(0.01, 0.1, limits=(0, 0.9), doc="fraction of the light that a film scatters")
    haze_knee: Interval = bounds(
        0.01, 0.05, limits=(1e-3, 1), unit="rad", doc="L of the film's BSDF: where its fall begins"
    )
    haze_slope: Interval = bounds(-2.5, -1.8, limits=(-4, 0), doc="S of the film's BSDF in double logarithms")
    scratches: Interval = bounds(0, 5, limits=(0, 50), integer=True, doc="number of scratches on the front")
    scratch_width_um: Interval = bounds(2, 15, limits=(0.1, 1e3), unit="µm", doc="of a scratch")
    scratch_length: Interval = bounds(
        0.3, 1.0, limits=(0, 1), unit="beam diameters", doc="of a scratch, as far as it lies in the beam"
    )
    scratch_bend_deg: float = number(
        1.5, limits=(0.1, 45), unit="deg", doc="standard deviation of a scratch's direction along it"
    )
    dose_krad: Interval = bounds(0, 100, limits=(0, 1e5), unit="krad", doc="of radiation in the glass")
    browning_per_mm_krad: float = number(
        7e-4, limits=(0, 1), unit="1/(mm krad)", doc="a0, absorption of ordinary glass at 400 nm; assumed"
    )
    browning_exponent: float = number(
        4.0, limits=(0, 12), doc="p of the fall of that absorption with wavelength; assumed"
    )
    coating_loss: Interval = bounds(0.0, 0.3, limits=(0, 1), doc="fraction of the coatings' area that is gone")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return lens, coating, haze, scratches, dose, browning coefficients and coating loss.

        Each scratch has its direction in degrees (0: +x, 90: +y), its width, and the fraction `share` of the light
        that it scatters. These fractions are scaled down if their sum is more than half of the light that the film
        leaves.
        """
        frame = context.frame
        beam_mm = frame.lens.focal_length_mm / frame.lens.f_number
        params: Params = {"lens": self.lens, "coating": self.coating}
        for name in ("haze", "haze_knee", "haze_slope", "dose_krad", "coating_loss"):
            params[name] = getattr(self, name).uniform(rng)
        scratches = []
        for _ in range(self.scratches.integer(rng)):
            width, length = self.scratch_width_um.uniform(rng), self.scratch_length.uniform(rng)
            fraction = width * 1e-3 * length * beam_mm / (np.pi / 4 * beam_mm**2)
            angle = rng.uniform(0, 180)
            scratches.append({"angle_deg": float(angle), "width_um": width, "share": float(fraction)})
        most = (1 - params["haze"]) / 2
        too_much = max(1.0, sum(s["share"] for s in scratches) / most)
        params["scratches"] = [s | {"share": s["share"] / too_much} for s in scratches]
        for name in ("scratch_bend_deg", "browning_per_mm_krad", "browning_exponent"):
            params[name] = float(getattr(self, name))
        return params

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters with less haze, dose and loss of the coating, and the first of the scratches."""
        return first_of(scaled(params, fraction, "haze", "dose_krad", "coating_loss"), fraction, "scratches")

    def inform(self, context: FaultContext, params: Params) -> FaultContext:
        """Return the context with the coating loss, which makes ghosts brighter."""
        return replace(context, coating_loss=float(params["coating_loss"]))

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons, scattered and darkened."""
        passes = colours(params, context)
        lost = params["haze"] + sum(s["share"] for s in params["scratches"])
        out = times(quantity.array, passes * (1 - lost))
        if lost:
            # all twins share the transform of the kernel
            waves = partial(context.once, _kernel_waves, params)
            scattered = passes.astype(np.float32)
            out += strewn(quantity.array, quantity.white_e, waves, cell_px(context.frame), scattered)
        return quantity.with_array(out)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the whole image as bool[y, x]."""
        return np.ones(context.shape, dtype=bool)


# --- transmittance ---------------------------------------------------------------------------------------------


def stabilised(glass: str) -> bool:
    """Return whether radiation hardly browns the glass of that name: silica, and glasses like BK7G18."""
    return glass == "silica" or re.search(r"\dG\d+$", glass) is not None


def browned(
    lens: Prescription, wavelength_nm: F64, *, dose_krad: float, per_mm_krad: float, exponent: float
) -> F64:
    """Return the transmittance of browned glass along the axis, over that of new glass, float64[band]."""
    depth = 0.0
    for surface in lens.surfaces[:-1]:
        if surface.medium.nd > 1.0:
            depth += surface.thickness_mm * (_STABILISED if stabilised(surface.medium.name) else 1.0)
    return np.asarray(np.exp(-depth * per_mm_krad * dose_krad * (_REFERENCE_NM / wavelength_nm) ** exponent))


@lru_cache(maxsize=8)
def _transmittances(lens: Prescription, wavelength_nm: tuple[float, ...]) -> tuple[F64, F64]:
    """Return the transmittances of every surface at normal incidence, coated and bare, float64[row, band] each."""
    nodes = np.array(wavelength_nm)
    media = [np.ones_like(nodes), *(surface.medium.index(nodes) for surface in lens.surfaces)]
    coated, bare = (
        np.stack(
            [
                reflect_transmit(surface.coating if whole else (), front, back, 1.0, nodes)[2]
                for surface, front, back in zip(lens.surfaces, media[:-1], media[1:], strict=True)
            ]
        )
        for whole in (True, False)
    )
    return coated, bare


def worn(lens: Prescription, wavelength_nm: F64, coating_loss: float) -> F64:
    """Return the transmittance of the surfaces with worn coatings, over that with whole coatings, float64[band].

    `coating_loss` is the fraction of the coatings' area that is gone, in [0, 1].
    """
    coated, bare = _transmittances(lens, tuple(wavelength_nm.tolist()))
    return np.asarray(np.prod(1 + coating_loss * (bare / coated - 1), axis=0))


def colours(params: Params, context: FaultContext) -> F64:
    """Return the fraction of sunlight that passes in each of the detector's channels, float64[channel]."""
    nodes, sun = context.sunlight
    lens = context.frame.prescription(params["lens"], params["coating"])
    nm = spectra.fine_nodes_nm(nodes)
    passes = worn(lens, nm, params["coating_loss"]) * browned(
        lens,
        nm,
        dose_krad=params["dose_krad"],
        per_mm_krad=params["browning_per_mm_krad"],
        exponent=params["browning_exponent"],
    )
    sunlight = Bands.of(nm, context.camera.electron_rates(nm) * spectra.sunlike(sun, nodes))
    return sunlight.mean(passes)


# --- scattered light -------------------------------------------------------------------------------------------


def haze_kernel(distance: NDArray, knee: float, slope: float) -> F64:
    """Return the film's point spread function near the axis, float64 of the shape of `distance`.

    `distance` is the distance from the image point on the sensor, in focal lengths, which is the tangent of the
    scattering angle; β is the sine of that angle. The integral over the plane is 1.
    """
    square = np.asarray(distance, dtype=np.float64) ** 2 + 1
    whole = Harvey(b0=1 / Harvey(b0=1.0, L=knee, S=slope).tis, L=knee, S=slope)
    return whole.bsdf(np.sqrt(1 - 1 / square)) / square**2


def scratch_kernel(
    along: NDArray, across: NDArray, *, width_um: float, bend_rad: float, soft: float, cell: float
) -> NDArray:
    """Return the point spread function of a scratch, in 1/sr, at positions along and across its streak.

    The streak is perpendicular to the scratch. The integral over the plane is 1.

    Parameters
    ----------
    along, across
        Positions in focal lengths, of shapes that broadcast.
    width_um
        Width of the scratch.
    bend_rad
        Standard deviation of the direction of the scratch.
    soft
        Standard deviation of the streak's width at its source, in focal lengths.
    cell
        Length along the streak over which the mean is taken, in focal lengths.
    """
    half = _STREAK_NM * 1e-3 / (2 * np.pi * width_um)
    square = along * along
    variance = square * bend_rad**2 + soft**2
    fan = np.exp(across * across / (-2 * variance))
    fan /= np.sqrt(variance * (2 * np.pi))
    # difference of the arctangents of both ends of the cell
    fan *= np.arctan2(cell * half, square + (half**2 - cell**2 / 4))
    fan *= 1 / (np.pi * cell)
    return fan


def kernel(params: Params, frame: ImageFrame, shape: tuple[int, int]) -> F32:
    """Return the fractions of a cell's light that scatter to all cells of a periodic grid, float32[y, x].

    Entry [0, 0] is the cell itself.
    """
    cell = cell_px(frame) * frame.pixel_pitch_um * 1e-3 / frame.lens.focal_length_mm
    y, x = (fft.fftfreq(n, 1 / n).astype(np.float32) * np.float32(cell) for n in shape)
    out = (
        params["haze"]
        * cell**2
        * haze_kernel(np.hypot(x[None, :], y[:, None]), params["haze_knee"], params["haze_slope"])
    )
    # near the middle, the mean over a cell differs from the value at its centre
    reach = min(4, (min(shape) - 1) // 2)
    fine = (np.arange((2 * reach + 1) * _FINE) + 0.5) / _FINE - reach - 0.5
    near = haze_kernel(cell * np.hypot(fine[None, :], fine[:, None]), params["haze_knee"], params["haze_slope"])
    near = near.reshape(2 * reach + 1, _FINE, 2 * reach + 1, _FINE).mean(axis=(1, 3))
    at = np.arange(-reach, reach + 1)
    out[at[:, None], at[None, :]] = params["haze"] * cell**2 * near
    for scratch in params["scratches"]:
        turn = np.radians(scratch["angle_deg"] + 90)
        cos, sin = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        out += np.float32(scratch["share"] * cell**2) * scratch_kernel(
            x[None, :] * cos + y[:, None] * sin,
            y[:, None] * cos - x[None, :] * sin,
            width_um=scratch["width_um"],
            bend_rad=float(np.radians(params["scratch_bend_deg"])),
            soft=_SOFT_CELLS * cell,
            cell=cell,
        )
    return out.astype(np.float32)


def _kernel_waves(params: Params, context: FaultContext, shape: tuple[int, int]) -> NDArray[np.complex64]:
    """Return the Fourier transform of `kernel`."""
    return np.asarray(fft.rfft2(kernel(params, context.frame, shape)))
