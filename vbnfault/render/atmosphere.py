"""Compute the sunlight that the molecules of an atmosphere scatter once on the way to a camera.

The atmosphere has the density exp(-h / H) at the height h above an ellipsoid. In axes scaled so that the ellipsoid
is a sphere, straight lines stay straight; lengths are those of the unscaled axes. A line of sight adds

    L = F P(Θ) / 4π ∫ β(s) exp(-τ_sun(s) - τ_view(s)) ds,    P = 3/4 (1 + cos² Θ)

and leaves exp(-(τ_sun + τ_view) / 2) of the light of the ground: the phase function is symmetric, so half of what
is scattered still arrives, from the sky or from the ground around. τ_sun is Chapman's function of the Sun's zenith
angle times the vertical optical depth above the point; the ground hides the Sun from points in its shadow. Light
that is scattered twice on its way to the camera is left out.

References
----------
Chapman 1931, Proc. Phys. Soc. 43, 483. Smith & Smith 1972, J. Geophys. Res. 77, 3592 (his function, large bodies).
Hansen & Travis 1974, Space Sci. Rev. 16, 527 (optical depth of air with the wavelength).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .description import View
from .runtime import dr, mi, packets

F64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

_STEPS = 96
TOP_SCALE_HEIGHTS = 12.0  # above, 6e-6 of the air is left
_REFERENCE_NM = 550.0
# exp(y²) erfc(y) is t exp(Σ a_k t^k) with t = 1 / (1 + y / 2), to 1.2e-7 (Press et al. 1992, Numerical Recipes,
# section 6.2).
_ERFC = (
    *(-1.26551223, 1.00002368, 0.37409196, 0.09678418, -0.18628806),
    *(0.27886807, -1.13520398, 1.48851587, -0.82215223, 0.17087277),
)
# Lines may pass so many scale heights below the ellipsoid, between the facets of its mesh (160 m on Earth).
_FACET_SAG = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Air:
    """Describe an atmosphere.

    Attributes
    ----------
    semi_axes_m, centre_L_m
        float64[3] each: the ellipsoid, and its centre in L.
    T_from_L
        float64[3, 3].
    optical_depth
        float64[band], straight up from the ground.
    scale_height_m
        H.
    """

    semi_axes_m: F64
    centre_L_m: F64
    T_from_L: F64
    optical_depth: F64
    scale_height_m: float


def rayleigh_depth(wavelength_nm: F64, at_550_nm: float) -> F64:
    """Return the optical depth of air at wavelengths, float64[band], from that at 550 nm."""

    def law(nm: Any) -> Any:
        inverse2 = (1000.0 / nm) ** 2
        return inverse2**2 * (1 + 0.0113 * inverse2 + 0.00013 * inverse2**2)

    return np.asarray(at_550_nm * law(np.asarray(wavelength_nm, dtype=np.float64)) / law(_REFERENCE_NM))


def chapman(x: Any, cosine: Any, m: Any) -> Any:
    """Return Chapman's function: the air towards a zenith angle in units of the air straight up.

    Parameters
    ----------
    x
        Distance from the centre in scale heights.
    cosine
        Cosine of the zenith angle. Below the horizon it is continued along the line past its lowest point.
    m
        The module of the arrays, numpy or drjit.
    """

    def above(x: Any, cosine: Any) -> Any:
        """Return √(π x / 2) exp(y²) erfc(y) with y = √(x / 2) cos χ."""
        t = 1 / (1 + 0.5 * m.sqrt(0.5 * x) * cosine)
        series = _ERFC[-1]
        for term in _ERFC[-2::-1]:
            series = series * t + term
        return m.sqrt(0.5 * np.pi * x) * t * m.exp(series)

    sine = m.sqrt(m.maximum(1 - cosine * cosine, 1e-12))
    lowest = x * sine
    size = abs(cosine)
    # twice the line from its lowest point, less the part behind the point
    below = 2 * m.sqrt(0.5 * np.pi * lowest) * m.exp(m.minimum(x - lowest, 60.0)) - above(x, size)
    choose = m.where if m is np else m.select
    return choose(cosine >= 0, above(x, size), below)


def air_light(
    air: Air, view: View, sun_L: F64, depth_m: Float32, is_ground: NDArray[np.bool_]
) -> tuple[Float32, Float32]:
    """Return what air adds to the light of pixels and what it leaves of the ground's.

    Parameters
    ----------
    air, view
        The atmosphere and the camera.
    sun_L
        float64[3]: unit vector towards the Sun.
    depth_m
        float32[y, x]: depth of the surface along the boresight, infinite where there is none.
    is_ground
        bool[y, x].

    Returns
    -------
    tuple
        float32[band, y, x] each: the radiance over the Sun's irradiance, in 1/sr, and the fraction of the ground's
        radiance that is left; 1 where no ground is seen.
    """
    height, width = depth_m.shape
    rays = view.pixel_map.directions_at(np.arange(width) + 0.5, np.arange(height) + 0.5).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    towards_L = rays / length[:, None] @ view.L_from_C.T
    radius_m = float(np.cbrt(np.prod(air.semi_axes_m)))
    scaled = np.diag(radius_m / air.semi_axes_m) @ air.T_from_L
    unit = radius_m / air.scale_height_m  # all lengths below are in scale heights
    start = scaled @ (view.position_L_m - air.centre_L_m) / air.scale_height_m
    direction = towards_L @ scaled.T
    stretch = np.linalg.norm(direction, axis=1)
    direction /= stretch[:, None]
    sun = scaled @ sun_L
    sun /= np.linalg.norm(sun)
    # the part of each line within the atmosphere, in float64
    along = -(direction @ start)
    miss2 = np.maximum(start @ start - along**2, 0)
    half = np.sqrt(np.maximum((unit + TOP_SCALE_HEIGHTS) ** 2 - miss2, 0))
    begin = np.maximum(along - half, 0)
    reach = (
        np.where(is_ground.ravel(), depth_m.ravel().astype(np.float64) / rays[:, 2] * length, np.inf)
        / air.scale_height_m
    )
    end = np.minimum(along + half, reach * stretch)
    # A line that dips into the sphere ends there; one without known ground that passes between facets does not.
    # Facets may lie below the sphere, and a ray between two of them may even see the far side.
    for deepest, on in ((unit - _FACET_SAG, is_ground.ravel()), (unit, ~is_ground.ravel())):
        dips = on & (miss2 < (unit - _FACET_SAG) ** 2) & (along > 0)
        end = np.where(dips, np.minimum(end, along - np.sqrt(np.maximum(deepest**2 - miss2, 0))), end)
    step = np.maximum(end - begin, 0) / _STEPS
    phase = 0.75 * (1 + (towards_L @ sun_L) ** 2) / (4 * np.pi)
    line = (along, np.sqrt(miss2), direction @ sun, float(start @ sun))
    added, left = _integrated(air, unit, line, begin, step, stretch)
    shape = (len(air.optical_depth), height, width)
    ground = is_ground.ravel()
    added = added * phase.astype(np.float32)
    left = np.where(ground, left, np.float32(1))
    return added.reshape(shape), left.reshape(shape)


def _integrated(
    air: Air, unit: float, line: tuple[F64, F64, F64, float], begin: F64, step: F64, stretch: F64
) -> tuple[Float32, Float32]:
    """Return ∫ β exp(-τ) ds without the phase function, and what is left of the ground, float32[band, pixel] each.

    `line` has the distance to the point nearest to the centre, its distance from the centre, the cosine between
    line and Sun, and the component of the camera's position towards the Sun, in scale heights.
    """
    nearest, miss, towards_sun, camera_sun = line

    def column(values: F64) -> Any:
        return packets(mi.Float, np.asarray(values, dtype=np.float32))

    # t counts from the point nearest to the centre, where float32 resolves heights best
    first, width, lateral = column(begin - nearest), column(step), column(miss - unit)
    per_length = column(1 / stretch)
    sun_along, sun_start = column(towards_sun), column(camera_sun + nearest * towards_sun)
    depths = [float(d) for d in air.optical_depth]
    radius = dr.opaque(mi.Float, unit)
    added = [mi.Float(0) for _ in depths]

    def sunward(t: Any) -> tuple[Any, Any, Any]:
        """Return height, Sun's column in vertical depths of the ground, and whether the Sun is up."""
        b = lateral + radius
        distance = dr.sqrt(b * b + t * t)
        height = lateral + t * t / (distance + b)
        cosine = (sun_start + t * sun_along) / distance
        up = (cosine >= 0) | (distance * dr.sqrt(dr.maximum(1 - cosine * cosine, 0)) > radius)
        return height, dr.exp(-height) * chapman(distance, cosine, dr), up

    def more(k: Any, *_: Any) -> Any:
        return k < _STEPS

    def add(k: Any, air_before: Any, *sums: Any) -> Any:
        t = first + (mi.Float(k) + 0.5) * width
        height, sun_air, up = sunward(t)
        density = dr.exp(-height) * width * per_length
        air_to_point = air_before + 0.5 * density
        out = []
        for total, depth in zip(sums, depths, strict=True):
            light = dr.select(up, dr.exp(-depth * (sun_air + air_to_point)), 0)
            out.append(total + depth * density * light)
        return k + 1, air_before + density, *out

    state = (mi.UInt32(0), mi.Float(0) * first, *(value * first for value in added))
    _, view_air, *sums = dr.while_loop(state, more, add)
    _, ground_air, _ = sunward(first + _STEPS * width)
    left = [dr.exp(-0.5 * depth * (dr.minimum(ground_air, 1e3) + view_air)) for depth in depths]
    dr.eval(*sums, *left)
    return np.stack([s.numpy() for s in sums]), np.stack([part.numpy() for part in left])
