"""Rays traced by optiland (Harrison, MIT licence): what the project's own lens code is judged by.

Only a prescription's numbers are taken from vbnfault: optiland finds the intersections, refracts and reflects, and
Fresnel's equations are written out here once more. A ghost is laid out as one sequence of surfaces in the order
that light meets them, each at its own place on the axis, the two reflecting ones as mirrors.

Axes as in vbnfault.lens.rays: z from the first vertex backwards, x and y across; mm.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from optiland.coatings import BaseCoating
from optiland.materials import IdealMaterial
from optiland.optic import Optic
from optiland.physical_apertures import RadialAperture
from optiland.rays import RealRays

from vbnfault.lens import Prescription, paraxial_properties
from vbnfault.lens.glass import D_NM

F64 = NDArray[np.float64]

# the search for the rays that pass: cells across, how often one looks closer, and a margin in cells
_COARSE, _LOOKS, _MARGIN = 48, 2, 1
_QUARTERS = np.array([[-0.25, -0.25], [-0.25, 0.25], [0.25, -0.25], [0.25, 0.25]])
# cells are quartered at most so often; while this share of the ghost's light is at stake, or light a tenth of the
# focal length off times that; across sharp edges down to a share of the box; rims are sharp from a rise per quarter
_DEPTH, _SHARE_AT_STAKE, _LENGTH_SHARE = 8, 3e-6, 0.1
_SHARP_AREA, _STEEP = 2e-6, 0.3


class Rays(RealRays):
    """Rays that remember how near they came to a rim and to total reflection; their intensity is the share of light
    that has come so far."""

    def __init__(self, origins_mm: F64, directions: F64, wavelength_nm: float) -> None:
        one = np.ones(len(origins_mm))
        places, ways = (np.ascontiguousarray(v.T) for v in (origins_mm, directions))
        super().__init__(*places, *ways, one, wavelength_nm / 1000 * one)
        self.relative_radius = np.zeros(len(origins_mm))
        self.sines = np.zeros((2, len(origins_mm)))


class _Medium(IdealMaterial):
    """A clear medium; optiland's own looks its index up for every ray, which takes a quarter of the time."""

    def n(self, wavelength: F64, **_: object) -> np.float64:
        return np.float64(self.index[0])

    def k(self, wavelength: F64, **_: object) -> np.float64:
        return np.float64(0)


class _Rim(RadialAperture):
    """A rim that notes where a ray meets the surface and lets it go on: rays just outside tell where the edge
    is."""

    def clip(self, rays: Rays) -> None:
        beyond = np.sqrt(rays.x * rays.x + rays.y * rays.y) / self.r_max
        rays.relative_radius = np.fmax(rays.relative_radius, beyond)


class _Bare(BaseCoating):
    """A surface without films, unpolarised light: the mean of Fresnel's two reflectances (Born & Wolf, 1.5.2)."""

    def __init__(self, before: float, behind: float) -> None:
        self.before, self.behind = before, behind

    def _reflectance(self, rays: Rays, normal: tuple[F64, F64, F64], mirror: bool) -> F64:
        cos1 = np.abs(normal[0] * rays.L0 + normal[1] * rays.M0 + normal[2] * rays.N0)
        sine2 = (self.before / self.behind) ** 2 * (1 - cos1 * cos1)
        rays.sines[int(mirror)] = np.fmax(rays.sines[int(mirror)], np.sqrt(np.maximum(sine2, 0)))
        # beyond the critical angle both shares become one
        cos2 = np.sqrt(np.maximum(1 - sine2, 0))
        across = (self.before * cos1 - self.behind * cos2) / (self.before * cos1 + self.behind * cos2)
        along = (self.behind * cos1 - self.before * cos2) / (self.behind * cos1 + self.before * cos2)
        return np.asarray((across * across + along * along) / 2)

    def reflect(self, rays: Rays, nx: F64, ny: F64, nz: F64) -> Rays:
        rays.i = rays.i * self._reflectance(rays, (nx, ny, nz), mirror=True)
        return rays

    def transmit(self, rays: Rays, nx: F64, ny: F64, nz: F64) -> Rays:
        rays.i = rays.i * (1 - self._reflectance(rays, (nx, ny, nz), mirror=False))
        return rays


@dataclass(frozen=True, kw_only=True)
class Arrival:
    """What n rays did on their way.

    Attributes
    ----------
    sensor_mm
        float64[n, 2]: x and y on the sensor's plane; nan after a surface that was missed or reflected all light.
    relative_radius
        float64[n]: the largest distance from the axis at any crossing, in semi-diameters; inf after a miss.
    sines
        float64[2, n]: the largest of an angle of refraction, and of what it would be at a mirror; above 1 all light
        is reflected.
    transmittance
        float64[n]: share of the ray's light that takes this path, rims left out; 0 after a miss.
    """

    sensor_mm: F64
    relative_radius: F64
    sines: F64
    transmittance: F64

    @property
    def passes(self) -> NDArray[np.bool_]:
        """bool[n]: within every rim at every crossing, and at the sensor."""
        return self.relative_radius <= 1


def forward(lens: Prescription) -> tuple[tuple[int, str], ...]:
    """(row, what happens) of the image: every row from the front."""
    return tuple((row, "onward") for row in range(len(lens.surfaces)))


def unfolded(lens: Prescription, a: int, b: int) -> tuple[tuple[int, str], ...]:
    """(row, what happens) of the ghost of rows a < b: to b, back to a, and on to the sensor."""
    sequence = [(row, "onward") for row in range(b)]
    sequence += [(b, "turns back")]
    sequence += [(row, "back") for row in range(b - 1, a, -1)]
    sequence += [(a, "turns on")]
    return (*sequence, *((row, "onward") for row in range(a + 1, len(lens.surfaces))))


def system(
    lens: Prescription, sequence: Sequence[tuple[int, str]] | None = None, *, wavelength_nm: float = D_NM
) -> Optic:
    """A lens as an optiland system with its stop, its object at infinity and its sensor at the d line's focus;
    `sequence`: what is met, in order (default: `forward`)."""
    for k, surface in enumerate(lens.surfaces):
        absorbs = surface.medium.nd > 1 and surface.absorption_per_mm(wavelength_nm) > 0
        if surface.coating or surface.blades or absorbs:
            raise ValueError(f"{lens.name}: surface {k}: the oracle knows bare surfaces, clear glass, round stops")
    index, vertex = lens.indices(wavelength_nm), lens.vertices_mm
    optic = Optic(lens.name)
    optic.surfaces.add(index=0, radius=np.inf, z=-np.inf)
    steps = forward(lens) if sequence is None else sequence
    for place, (row, happens) in enumerate(steps, start=1):
        surface = lens.surfaces[row]
        before, behind = index[row], index[row + 1]
        if happens in ("back", "turns on"):
            before, behind = behind, before
        shape = {"radius": surface.radius_mm, "conic": surface.conic}
        if surface.aspheric_mm:  # optiland's list begins with r²
            shape |= {"surface_type": "even_asphere", "coefficients": [0.0, *surface.aspheric_mm], "tol": 1e-14}
        optic.surfaces.add(
            index=place,
            z=float(vertex[row]),
            material="mirror" if happens.startswith("turns") else _Medium(float(behind)),
            coating=_Bare(float(before), float(behind)),
            aperture=_Rim(surface.semi_diameter_mm),
            is_stop=surface.stop and happens == "onward",
            **shape,
        )
    optic.surfaces.add(index=len(steps) + 1, radius=np.inf, z=float(vertex[-1] + paraxial_properties(lens).bfd_mm))
    optic.set_aperture("float_by_stop_size", 2 * lens.surfaces[lens.stop].semi_diameter_mm)
    optic.fields.set_type("angle")
    optic.fields.add(y=0.0)
    optic.wavelengths.add(value=wavelength_nm / 1000, is_primary=True)
    return optic


def trace(optic: Optic, origins_mm: ArrayLike, directions: ArrayLike) -> Arrival:
    """Trace rays through a system of `system`.

    Parameters
    ----------
    origins_mm, directions
        float64[n, 3] and float64[n, 3] or float64[3]: points on the rays, and where they go, of any length.
    """
    points = np.asarray(origins_mm, dtype=np.float64).reshape(-1, 3)
    ways = np.broadcast_to(np.asarray(directions, dtype=np.float64), points.shape)
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    # optiland looks for surfaces ahead of a ray first, and the first one may stand out in front of its vertex
    ahead = optic.surfaces[1].aperture.r_max
    rays = Rays(points - ahead / ways[:, 2:] * ways, ways, optic.primary_wavelength * 1000)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numba warns of its own workings when it first compiles
        optic.surfaces.trace(rays, skip=1, record=False)
    # a ray that leaves the lens sideways or forwards never comes to the sensor
    lands = np.isfinite(rays.x) & np.isfinite(rays.y) & (rays.N > 0)
    return Arrival(
        sensor_mm=np.where(lands[:, None], np.column_stack([rays.x, rays.y]), np.nan),
        relative_radius=np.where(lands, rays.relative_radius, np.inf),
        sines=rays.sines,
        transmittance=np.where(lands, np.nan_to_num(rays.i), 0.0),
    )


def trace_ghost(
    lens: Prescription,
    a: int,
    b: int,
    origins_mm: ArrayLike,
    directions: ArrayLike,
    *,
    wavelength_nm: float = D_NM,
) -> Arrival:
    """Trace rays along the path of the ghost of rows a < b."""
    return trace(system(lens, unfolded(lens, a, b), wavelength_nm=wavelength_nm), origins_mm, directions)


def sunlight(sun_deg: float, azimuth_deg: float = 0.0) -> F64:
    """Unit direction, float64[3], in which rays of a far source travel whose image lies towards an azimuth."""
    theta, turn = np.radians(sun_deg), np.radians(azimuth_deg)
    return np.array([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)])


def ghost_truth(
    lens: Prescription,
    a: int,
    b: int,
    sun_deg: float,
    azimuth_deg: float = 0.0,
    wavelength_nm: float = D_NM,
    grid: int = 32,
) -> tuple[float, tuple[float, float], float]:
    """Flux fraction, centroid (x, y) in mm and r.m.s. radius in mm of a ghost, as in
    `vbnfault.lens.straylight.ghosts.Ghost`.

    `grid`² cells fill the smallest box that holds the rays that pass, rays run through the middles of their
    quarters, and a quarter becomes a cell as long as that changes what it adds: edges, and rays near a critical
    angle, which carry light far off, are met by fine cells. A mean place does not exist where rays come to the
    sensor at all angles down to 0: on an unbounded plane their light falls too slowly with distance.
    """
    optic = system(lens, unfolded(lens, a, b), wavelength_nm=wavelength_nm)
    direction = sunlight(sun_deg, azimuth_deg)
    corners = entrance(optic, direction)
    if corners is None:
        return 0.0, (float("nan"), float("nan")), float("nan")
    low, high = corners
    scale = _LENGTH_SHARE * paraxial_properties(lens).efl_mm
    cell = (high - low) / grid
    middles = low + (np.stack(np.indices((grid, grid)), axis=-1).reshape(-1, 2) + 0.5) * cell
    parts, _ = _quarters(optic, direction, middles, cell, scale)
    total = parts.sum(axis=(0, 1))
    for _ in range(_DEPTH):
        middles = (middles[:, None] + _QUARTERS * cell).reshape(-1, 2)
        coarse, cell = parts.reshape(-1, 4), cell / 2
        parts, sharp = _quarters(optic, direction, middles, cell, scale)
        change = parts.sum(axis=1) - coarse
        split = (np.abs(change[:, :3]) > _SHARE_AT_STAKE * total[0]).any(axis=1)
        # a sharp edge may lie between rays that agree
        split |= sharp & bool((cell / (high - low)).prod() > _SHARP_AREA)
        # a further step would change a smooth cell by a quarter of this one, and so on: a third in all
        total = total + change.sum(axis=0) + change[~split].sum(axis=0) / 3
        if not split.any():
            break
        middles, parts = middles[split], parts[split]
    flux = total[0]
    centroid = total[1:3] / flux
    spread = max(total[3] / flux - centroid @ centroid, 0.0)
    pupil = np.pi / 4 * paraxial_properties(lens).entrance_pupil_diameter_mm ** 2
    x, y = (float(v) for v in centroid * scale)
    return float(flux / pupil), (x, y), float(np.sqrt(spread)) * scale


def round_ghost_truth(
    lens: Prescription, a: int, b: int, wavelength_nm: float = D_NM, count: int = 20_000
) -> tuple[float, tuple[float, float], float]:
    """As `ghost_truth` of a source on the axis, from rays along one radius, which place an edge to a step."""
    step = lens.surfaces[0].semi_diameter_mm / count
    radius = (np.arange(count) + 0.5) * step
    places = np.column_stack([radius, np.zeros((count, 2))])
    found = trace_ghost(lens, a, b, places, [0.0, 0.0, 1.0], wavelength_nm=wavelength_nm)
    light = np.where(found.passes, found.transmittance, 0.0) * 2 * radius * step
    spread = light @ np.nan_to_num(found.sensor_mm[:, 0]) ** 2 / light.sum()
    pupil_radius = paraxial_properties(lens).entrance_pupil_diameter_mm / 2
    return float(light.sum() / pupil_radius**2), (0.0, 0.0), float(np.sqrt(spread))


def _quarters(
    optic: Optic, direction: F64, middles_mm: F64, cell_mm: F64, scale: float
) -> tuple[F64, NDArray[np.bool_]]:
    """Of cells of the plane z = 0, float64[n, 4, 4]: for each quarter, by a ray through its middle, its light times
    1, x, y, x² + y² at the sensor in units of `scale`; and bool[n], whether a sharp edge lies within."""
    places = (middles_mm[:, None] + _QUARTERS * cell_mm).reshape(-1, 2)
    found = trace(optic, np.column_stack([places, np.zeros(len(places))]), direction)
    # a rim's edge as a straight line through a quarter, from how the relative radius rises over the four, unless it
    # rises so steeply that rays just outside tell nothing of those inside
    radius, sines = found.relative_radius.reshape(-1, 2, 2), found.sines.reshape(-1, 2, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        # light sets out or ends steeply at a critical angle
        rise = _rise(radius)
        inside = np.where(rise < _STEEP, np.clip(0.5 + (1 - radius) / rise, 0, 1), radius <= 1).ravel()
        sharp = (rise >= _STEEP) & (radius.min(axis=(1, 2), keepdims=True) <= 1)
        grazed = np.abs(1 - sines.mean(axis=(1, 2), keepdims=True)) < _rise(sines)
    sharp = sharp.ravel() | grazed.reshape(2, -1).any(axis=0)
    light = inside * found.transmittance * cell_mm.prod() / 4
    x, y = np.where(light > 0, found.sensor_mm.T / scale, 0.0)
    moments = np.stack([light, light * x, light * y, light * (x * x + y * y)], axis=1)
    return moments.reshape(-1, 4, 4), sharp


def _rise(values: F64) -> F64:
    """Sum of a value's rises from quarter to quarter along x and y, float64[n, 1, 1]."""
    along_y, along_x = np.abs(np.diff(values.mean(axis=1))), np.abs(np.diff(values.mean(axis=2)))
    return np.asarray((along_x + along_y)[:, :, None])


def entrance(optic: Optic, direction: F64) -> tuple[F64, F64] | None:
    """Corners of a box in the plane z = 0 that holds all rays that pass; None where there seem to be none."""
    front = optic.surfaces[1]
    sag = abs(float(front.geometry.sag(front.aperture.r_max, 0.0)))
    half = front.aperture.r_max + sag * np.hypot(*direction[:2]) / direction[2]
    low, high = np.full(2, -half), np.full(2, half)
    cells = np.stack(np.indices((_COARSE, _COARSE)), axis=-1).reshape(-1, 2)
    passes = np.zeros(1, bool)
    for _ in range(_LOOKS):
        cell = (high - low) / _COARSE
        places = low + (cells + 0.5) * cell
        found = trace(optic, np.column_stack([places, np.zeros(len(places))]), direction)
        passes, radius = found.passes, found.relative_radius
        if not np.isfinite(radius).any():
            return None
        # where no ray passes yet, look closer at the one that comes nearest
        chosen = cells[passes if passes.any() else radius == radius.min()]
        low, high = low + (chosen.min(axis=0) - _MARGIN) * cell, low + (chosen.max(axis=0) + 1 + _MARGIN) * cell
    return (low, high) if passes.any() else None
