"""Advance rays from surface to surface on the device.

`meet` computes where a ray meets the next surface, refracts or reflects the ray, and clips it at the surface's rim.

All values are drjit arrays with one lane for each ray, in single precision. Positions are relative to the vertex of
the surface that a ray has just met.

Rims. A ray is lost (clipped) outside the rim of a surface. The code still follows a lost ray and only records the
rim values; `ghosts` and `raster` then leave out the light of lost rays, see `bundles.Spots`. Code that applies rims
to ghosts:

- `meet` (for exact rays) and `irradiance.ParaxialTracer.trace` (for paraxial rays). Round rims have the radii
  `bundles.Tracer.rims_mm`. For a stop with blades, `StopBlades.relative_radius` gives the rim.
- `bundles.Tracer._hood_rim`, for both: the edge of a hood before the lens.

Code that uses the rims without clipping a ghost, and that a rim of another shape also concerns:
`ghosts._paraxial_boxes` (first boxes of rays), `irradiance.FlareModel._soften` (widths of soft edges), and
`scatter._lit` (lit parts of the surfaces).

The tracers of exact and of paraxial rays do not share more than `StopBlades`: one works with squares of relative
radii and margins of lost rays, the other with radii, and a common form would change the last bits of either.

The image of the scene and the Sun's direct image do not use these two modules. Their rays are clipped in
`lens.rays.trace`, and `lens.mapping.relative_radii` passes the result to `lens.point_spread` (image) and to
`lens.beams` (dust).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.process.llvm import backend
from ..prescription import Surface

_LOST, _FAR = -1e6, -1e4  # margin of rays that do not reach the sensor, and the smallest margin of other rays
_BEYOND_EDGE = -1.0  # margin at which a soft edge ends in the dark
_LIMIT_SHARPNESS = 100.0  # sharpness of an edge where rays miss a surface or are totally reflected
_LEAST_SLOPE = 1e-3  # smallest |dz| of a lost ray
# Margin beyond which margins may be stretched. It exceeds `raster.EDGE_HIGH`, where the profile of an edge ends, so
# that stretching does not change the profile between two rays.
FRINGES_END = 7.0


@dataclass(eq=False)
class Step:
    """Hold the data of one step, which is the next surface of a path.

    The values are device arrays with one value for each lane, or a number that is the same for all.

    Attributes
    ----------
    gap
        Distance of the vertex of the last surface behind the vertex of this surface.
    curvature, conic, aspheric
        Shape of the surface; `conic` is 1 + the conic constant.
    eta
        Index before the surface over the index behind it.
    per_rim, sharpness
        1 / (radius of the rim), and 1 / (width of its soft edge, as a fraction of the radius).
    stretch
        By which fraction the part of the margin beyond `FRINGES_END` is lengthened.
    mirror, stop
        Whether the ray is reflected, and whether the surface is the stop.
    absorption
        Absorption coefficient per mm before the surface; None if no medium absorbs.
    passed
        Function of the cosine of incidence that returns the reflected or transmitted fraction.
    """

    gap: Any
    curvature: Any
    eta: Any
    per_rim: Any
    sharpness: Any
    stretch: Any
    mirror: Any
    stop: Any
    conic: Any
    aspheric: list[Any]
    absorption: Any
    passed: Callable[[Any], Any]


@dataclass(eq=False)
class _Hit:
    """Hold the position at which rays meet a surface, the normal there, and the `length` of the path to it.

    `normal` is None on a sphere. `cosine` is the cosine of the angle of incidence. `facing` is the factor that
    scales the normal to length 1 and turns it towards the incoming ray. `under` is negative for rays that miss the
    surface.
    """

    x: Any
    y: Any
    z: Any
    length: Any
    cosine: Any
    facing: Any
    under: Any
    normal: tuple[Any, Any, Any] | None = None


@dataclass(frozen=True)
class StopBlades:
    """Describe the shape of a stop with blades; `turn_rad` is the direction of its first corner from +x.

    A ray is lost (clipped) outside this rim. The stop's `semi_diameter_mm` is the distance of the corners from the
    axis. For round rims see `bundles.Tracer`.
    """

    rim: Surface
    turn_rad: float

    def relative_radius(self, x: Any, y: Any) -> Any:
        """Return the distance from the axis over that of the rim (`Surface.rim_mm`) in the same direction."""
        be, rim = backend(), self.rim
        dr = be.dr
        half = float(np.pi / rim.blades)

        def given(value: float) -> Any:
            """Return a number as an argument of the kernel; as a constant it would make every lens compile one."""
            return dr.opaque(be.Float, value)

        angle = (dr.atan2(y, x) - given(self.turn_rad)) * given(0.5 / half)
        beside = (angle - dr.floor(angle)) * given(2 * half) - given(half)
        edge = given(float(np.cos(half))) / dr.cos(beside)
        return dr.sqrt(x * x + y * y) / (
            given(rim.semi_diameter_mm) * (edge + (1 - edge) * given(rim.blade_rounding))
        )


def meet(
    step: Step, ray: Sequence[Any], *, soft: bool, special: bool, blades: StopBlades | None
) -> tuple[Any, ...]:
    """Advance rays to the next surface of their path, refract or reflect them there, and clip them at its rim.

    A ray is a tuple of position, direction, fraction and rim values. The rim values are `radius`, the square of the
    largest relative radius so far, and, if edges are soft, `margin`. A stop with blades may give the mirrored ray
    other rim values than the ray; the rim values of the mirrored ray then follow.

    Parameters
    ----------
    soft
        Whether rims have soft edges.
    special
        Whether any surface is a conic or an asphere.
    blades
        Shape of the stop; None if the stop is round.
    """
    dr = backend().dr
    *_, dx, dy, dz, fraction = ray[:7]
    c, eta, mirror = step.curvature, step.eta, step.mirror
    sense = dr.copysign(1, dz)

    def real(square: Any) -> Any:
        """Return the root of a square that is negative for lost rays."""
        # With soft edges, a lost ray continues as the last ray that still meets the surface. With sharp edges, its
        # values become nan.
        return dr.sqrt(dr.maximum(square, 0) if soft else square)

    hit = (_on_conic if special else _on_sphere)(step, ray, sense, real)
    if step.absorption is not None:
        fraction = fraction * dr.exp(-step.absorption * dr.abs(hit.length))
    # square of the cosine of refraction; negative for total reflection
    left = dr.fma(eta * eta, hit.cosine * hit.cosine, 1 - eta * eta)
    out_cosine = real(left)
    passed = step.passed(dr.clip(dr.select(eta > 1, out_cosine, hit.cosine), 0, 1))
    fraction = fraction * dr.select((left < 0) & mirror, 1, passed)
    turn = hit.facing * dr.select(mirror, 2 * hit.cosine, dr.fma(eta, hit.cosine, -out_cosine))
    keep = dr.select(mirror, 1, eta)
    onward = dr.select(mirror, -sense, sense)
    if hit.normal is not None:
        nx, ny, nz = hit.normal
        dx, dy, dz = dr.fma(turn, nx, keep * dx), dr.fma(turn, ny, keep * dy), dr.fma(turn, nz, keep * dz)
    else:
        bend = turn * c
        dx, dy, dz = dr.fma(bend, hit.x, keep * dx), dr.fma(bend, hit.y, keep * dy), dr.fma(keep, dz, -turn)
        dz = dr.fma(bend, hit.z, dz)
    # A ray is also lost if it misses a surface, is totally reflected or turns back. With soft edges `room` measures
    # by how much, so that the edge between lost and other rays can be interpolated.
    room = ahead = dz * onward
    if soft:
        room = dr.minimum(dr.minimum(hit.under, dr.select(mirror, 1, left)), 4 * ahead)
        dz = onward * dr.maximum(ahead, _LEAST_SLOPE)
    return hit.x, hit.y, hit.z, dx, dy, dz, fraction, *_rims_after(step, soft, hit, room, ray[7:], blades)


def _on_sphere(step: Step, ray: Sequence[Any], sense: Any, real: Callable[[Any], Any]) -> _Hit:
    """Return where rays meet a sphere.

    On a sphere, the normal has length 1, and the root of the quadratic equation is the cosine of incidence.
    """
    dr = backend().dr
    x, y, z, dx, dy, dz = ray[:6]
    c = step.curvature
    z = z + step.gap
    b = dr.fma(-c, dr.fma(x, dx, dr.fma(y, dy, z * dz)), dz)
    e = dr.fma(c, dr.fma(x, x, dr.fma(y, y, z * z)), -2 * z)
    under = dr.fma(b, b, -c * e)
    cosine = real(under)
    length = e / dr.fma(sense, cosine, b)
    x, y, z = dr.fma(length, dx, x), dr.fma(length, dy, y), dr.fma(length, dz, z)
    return _Hit(x, y, z, length, cosine, sense, under)


def _on_conic(step: Step, ray: Sequence[Any], sense: Any, real: Callable[[Any], Any]) -> _Hit:
    """Return where rays meet a conic or an asphere; the rays advance to the vertex plane first."""
    dr = backend().dr
    x, y, z, dx, dy, dz = ray[:6]
    c = step.curvature
    z = z + step.gap
    to_plane = -z / dz
    x, y = dr.fma(to_plane, dx, x), dr.fma(to_plane, dy, y)
    a = c * (dx * dx + dy * dy + step.conic * dz * dz)
    b = c * (x * dx + y * dy) - dz
    e = c * (x * x + y * y)
    under = b * b - a * e
    t_hit = e / (sense * real(under) - b)
    x, y, z = dr.fma(t_hit, dx, x), dr.fma(t_hit, dy, y), t_hit * dz
    length = t_hit + to_plane
    nx, ny, nz = c * x, c * y, c * step.conic * z - 1
    if step.aspheric:
        x, y, z, nx, ny, nz, more = _to_asphere(step, x, y, z, dx, dy, dz)
        length = length + more
    norm = dr.rsqrt(nx * nx + ny * ny + nz * nz)
    along_normal = (nx * dx + ny * dy + nz * dz) * norm
    # turn the normal towards the incoming ray
    facing = dr.select(along_normal > 0, -norm, norm)
    cosine = dr.minimum(dr.abs(along_normal), 1)
    return _Hit(x, y, z, length, cosine, facing, under, (nx, ny, nz))


def _to_asphere(step: Step, x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any) -> tuple[Any, ...]:
    """Move rays from a conic to the asphere near it by Newton's method; return position, normal and length."""
    be = backend()
    dr = be.dr
    c, conic, terms = step.curvature, step.conic, step.aspheric
    length = 0 * x
    for k in range(5):
        r2 = x * x + y * y
        root = dr.sqrt(dr.maximum(1 - conic * c * c * r2, 1e-6))
        sag, slope, power = c * r2 / (1 + root), c / root, r2
        for n, term in enumerate(terms):
            slope = slope + (2 * n + 4) * term * power
            sag = sag + term * power * r2
            power = power * r2
        nx, ny = slope * x, slope * y
        if k == 4:
            return x, y, z, nx, ny, 0 * x - 1, length
        advance = (z - sag) / (nx * dx + ny * dy - dz)
        x, y, z = dr.fma(advance, dx, x), dr.fma(advance, dy, y), dr.fma(advance, dz, z)
        length = length + advance
    raise AssertionError("unreachable")


def _rims_after(
    step: Step, soft: bool, hit: _Hit, room: Any, rims: Sequence[Any], blades: StopBlades | None
) -> list[Any]:
    """Return the rim values of the rays after a surface.

    `room` is negative for rays that miss the surface, are totally reflected there, or turn back. `radius` and
    `beyond` are squares of relative radii, before and at this surface; a ray with `beyond` above 1 is clipped.
    """
    dr = backend().dr
    x, y = hit.x, hit.y
    sides = 2 if len(rims) > 1 + soft else 1
    out: list[Any] = []
    for k in range(sides):
        radius, *margin = rims[k * len(rims) // sides : (k + 1) * len(rims) // sides]
        # near a rim 1 - r² is twice 1 - r; the factor 0.5 below corrects for this
        beyond = dr.fma(x, x, y * y) * (step.per_rim * step.per_rim)
        if blades is not None and step.stop is not False:
            blade = blades.relative_radius(x, -y if k else y)
            beyond = dr.select(step.stop, blade * blade, beyond)
        out.append(dr.maximum(radius, dr.select(room < 0, 1e6, beyond)))
        if soft:
            inside = stretched((1 - beyond) * (0.5 * step.sharpness), step.stretch)
            here = dr.minimum(inside, room * _LIMIT_SHARPNESS)
            # keep the margin of the surface at which a ray was lost: later margins say nothing about this edge
            out.append(dr.select(margin[0] < _BEYOND_EDGE, margin[0], dr.minimum(margin[0], here)))
    return out


def stretched(margin: Any, stretch: Any) -> Any:
    """Return margins with the part beyond `FRINGES_END` lengthened by the fraction `stretch`.

    Margins count widths of edges, and these widths differ between the rims of a path. Without the stretch, all rays
    of a ghost far inside a rim with a wide edge would count as near this edge.
    """
    dr = backend().dr
    return dr.fma(dr.maximum(margin - FRINGES_END, 0), stretch, margin)


def arrived(ray: Sequence[Any], last: Any, soft: bool) -> list[tuple[Any, Any]]:
    """Return x, y, fraction, radius and, with soft edges, margin on the sensor, as `bundles.Spots` describes them.

    Each value is a pair: the first for the rays, the second for their mirror images. The radius is not squared
    here. `last` is the distance of the vertex of the last surface behind the sensor.
    """
    dr = backend().dr
    x, y, z, dx, dy, dz, fraction, *rims = ray
    away = -(z + last) / dz
    x, y = dr.fma(away, dx, x), dr.fma(away, dy, y)
    arrives = dr.isfinite(x + y + rims[0]) & (dr.abs(x) + dr.abs(y) < 1e9)
    x, y, fraction = (dr.select(arrives, v, 0) for v in (x, y, fraction))
    radius = [dr.select(arrives, dr.sqrt(r), -_LOST) for r in (rims[::2] if soft else rims)]
    margin = [dr.select(arrives, dr.maximum(m, _FAR), _LOST) for m in (rims[1::2] if soft else ())]
    out = [(x, x), (y, -y), (fraction, fraction), (radius[0], radius[-1])]
    return [*out, (margin[0], margin[-1])] if soft else out
