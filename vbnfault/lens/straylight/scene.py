"""Compute the straylight of an extended scene: ghosts, glare and veil of everything that a render shows.

Each part of the scene is a source like the Sun in `total`, with the irradiance L cos³θ dA / f² across its
direction, where dA / f² is the area of a pixel of the render in focal lengths. The sum over all sources is linear
in the radiance L, so that it is computed from responses that depend on the lens alone:

- ghosts by `ghost_response`, in polar cells;
- glare by `scene_scatter`, as convolutions over direction cosines;
- the veil of mount, barrel and edges by its closed form (`total`), from the flux that enters the lens.

The Sun's disc is not part of the scene; `total` computes its straylight.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..interface import Lens
from ..paraxial import paraxial_properties
from ..prescription import Prescription
from ..thin import cos4_map
from .ghost_response import GhostResponse, PolarCells, ghost_response
from .paraxial import axial_transmittance
from .scatter import baffle_transmission, glare_kernels, scattered_fraction
from .scene_scatter import DirectionGrid, SeparatedKernel, separated
from .settings import Baffle, SensorGrid, StraylightSettings

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Sizes of the cells of ghosts, in rings from the axis to the corner. Halving them changes the ghosts of
# `nikkor_28_f2p8_camera` by less than 1 % of their light.
SOURCE_RINGS, SENSOR_RINGS, AZIMUTHS = 64, 96, 512
_MOST_SOURCES = 512  # along each side of a render; the pixels of a larger one are added up in blocks
_ANGLES = 17  # field angles of the kernels of glare


@dataclass(frozen=True, kw_only=True)
class RenderGrid:
    """Describe the pinhole render of a scene: (height, width) with its guard band, and focal length in pixels."""

    shape: tuple[int, int]
    focal_px: float

    @property
    def block(self) -> int:
        """Return the pixels along each side of a block, whose light counts as that of one source."""
        return -(-max(self.shape) // _MOST_SOURCES)

    @cached_property
    def slopes(self) -> tuple[F64, F64]:
        """Return the tangents x/z and y/z of the directions of all sources, row by row, float64[source] each."""
        height, width = self.shape
        side = self.block
        x, y = (((np.arange(-(-size // side)) + 0.5) * side - size / 2) / self.focal_px for size in (width, height))
        return np.tile(x, len(y)), np.repeat(y, len(x))

    def irradiance(self, radiance: F32) -> F32:
        """Return the irradiance of all sources across their directions, float32[band, source].

        `radiance` is float32[band, y, x]; the irradiance has its unit times sr.
        """
        height, width = self.shape
        side = self.block
        rows, columns = -(-height // side), -(-width // side)
        # cos³ over f²: the solid angle of a pixel
        solid = (cos4_map(self.shape, self.focal_px) ** np.float32(0.75)) / np.float32(self.focal_px**2)
        out = np.empty((len(radiance), rows, columns), dtype=np.float32)
        padded = np.zeros((rows * side, columns * side), dtype=np.float32)
        for band, sources in zip(radiance, out, strict=True):
            np.multiply(band, solid, out=padded[:height, :width])
            sources[:] = padded.reshape(rows, side, columns, side).sum(axis=(1, 3))
        return out.reshape(len(radiance), -1)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneStraylight:
    """Hold the straylight of a scene, float32[channel, y, x] each."""

    ghosts: F32
    glare: F32
    veil: F32

    @property
    def total(self) -> F32:
        """Return the sum of ghosts, glare and veil."""
        return np.asarray(self.ghosts + self.glare + self.veil)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneInLens:
    """Compute the straylight of a scene behind a lens.

    Attributes
    ----------
    lens
        The lens at its final size.
    nodes_nm
        float64[band].
    sensor
        The sensor.
    render
        Grid of the scene's radiance.
    image
        Lens of the camera, which says where a source is imaged.
    settings
        State of the lens.
    passed
        float64[band]: transmittance of the path that forms the image, as `DirectPath.transmittance`.
    rings
        Largest number of rings of sources and of the sensor, and of azimuths, of the cells of ghosts.
    """

    lens: Prescription
    nodes_nm: F64
    sensor: SensorGrid
    render: RenderGrid
    image: Lens
    settings: StraylightSettings
    passed: F64
    rings: tuple[int, int, int] = (SOURCE_RINGS, SENSOR_RINGS, AZIMUTHS)

    def straylight(self, radiance: F32, weights: F64) -> SceneStraylight:
        """Return the straylight of a scene.

        Parameters
        ----------
        radiance
            float32[band, y, x] on the grid of the render, without the Sun's disc.
        weights
            float64[channel, band], with which the bands are added.
        """
        irradiance = self.render.irradiance(radiance)
        return SceneStraylight(
            ghosts=self.ghosts(irradiance, weights),
            glare=self.glare(irradiance, weights),
            veil=self.veil(irradiance, weights),
        )

    def ghosts(self, irradiance: F32, weights: F64) -> F32:
        """Return the ghosts of sources with an irradiance float32[band, source], float32[channel, y, x]."""
        response = self.response
        cells = response.cells
        if not response.table.any():
            return np.zeros((len(weights), *self.sensor.shape), dtype=np.float32)
        light = self._places.polar @ irradiance.T
        light = light.reshape(len(cells.slopes), cells.azimuths, len(irradiance))
        light *= self._lit(np.array(cells.slopes)).astype(np.float32)[:, None, None]
        return response.image(light, weights, self.sensor)

    def glare(self, irradiance: F32, weights: F64) -> F32:
        """Return what the surfaces scatter; arguments and result as those of `ghosts`."""
        kernel, places = self._kernel, self._places
        zero = np.zeros((len(weights), *self.sensor.shape), dtype=np.float32)
        terms = []
        for of_source, of_offset in zip(kernel.of_source, kernel.of_offset, strict=True):
            light = np.zeros((len(weights), irradiance.shape[1]), dtype=np.float32)
            for band, own in enumerate(irradiance):
                gain = weights[:, band, None] * of_source[band] * self._lit(kernel.slope)
                for channel, one in zip(light, gain, strict=True):
                    channel += own * places.at_angle(one)
            terms.append((light, places.directions.spectrum(kernel.offset, of_offset)))
        if not terms:
            return zero
        scattered = places.directions.convolved(terms) * cos4_map(self.sensor.shape, self._efl_px)
        # the transform leaves rounding errors where there is no light
        return np.maximum(scattered, 0, out=zero)

    def veil(self, irradiance: F32, weights: F64) -> F32:
        """Return what mount, barrel and edges scatter; arguments and result as those of `ghosts`."""
        properties = paraxial_properties(self.lens)
        slope = self._places.slope
        cosine = (self._lit(slope) / np.hypot(1, slope)).astype(np.float32)
        pupil_mm2 = np.pi / 4 * properties.entrance_pupil_diameter_mm**2
        entering = np.einsum("bs,s->b", irradiance, cosine, dtype=np.float64) * pupil_mm2
        flux = np.einsum("cb,b->c", weights, entering * self.passed * self.settings.veil_fraction)
        per_mm2 = cos4_map(self.sensor.shape, self._efl_px) * np.float32(1 / (np.pi * properties.efl_mm**2))
        return np.asarray(per_mm2 * flux.astype(np.float32)[:, None, None])

    @property
    def response(self) -> GhostResponse:
        """Return the ghosts of every source; they are cached for lens, sensor and coating loss."""
        settings = self.settings
        return ghost_response(
            self.lens, tuple(self.nodes_nm.tolist()), self._cells, settings.ghosts, settings.coating_loss
        )

    @property
    def _cells(self) -> PolarCells:
        """Return the cells of ghosts."""
        x, y = self.render.slopes
        # cells are no finer than half a pixel
        corner_px = float(np.hypot(*self.sensor.shape)) / 2
        most = 2 * int(np.ceil(corner_px)), 2 * int(np.ceil(corner_px)), 2 << int(np.log2(2 * np.pi * corner_px))
        sources, rings, azimuths = (min(pair) for pair in zip(self.rings, most, strict=True))
        return PolarCells(
            slopes=tuple(np.linspace(0, float(np.hypot(x, y).max()), sources).tolist()),
            reach_mm=corner_px * self.sensor.pitch_mm,
            rings=rings,
            azimuths=azimuths,
        )

    @property
    def _efl_px(self) -> float:
        """Return the focal length of the lens in pixels of the sensor."""
        return paraxial_properties(self.lens).efl_mm / self.sensor.pitch_mm

    @property
    def _places(self) -> _Places:
        """Return where the sources lie."""
        return _places(self.render, self.sensor, self.image, self._cells, self._efl_px)

    @cached_property
    def _kernel(self) -> SeparatedKernel:
        """Return the glare of a source, with all losses but those at the baffle."""
        slope = np.tan(np.linspace(0, np.arctan(self._places.slope.max()), _ANGLES))
        cleanliness = self.settings.cleanliness
        offset, kernels = glare_kernels(self.lens, slope, wavelength_nm=self.nodes_nm, cleanliness=cleanliness)
        gain = self.passed / axial_transmittance(self.lens, self.nodes_nm) * self._kept_of_single
        return separated(kernels * gain[:, None, None], slope, offset)

    @property
    def _kept_of_single(self) -> F64:
        """Return the factor of `VeilingGlare.kept_of_single`, float64[band]."""
        fraction = scattered_fraction(self.lens, self.nodes_nm, cleanliness=self.settings.cleanliness)
        single = -np.log1p(-fraction)
        return np.where(single > 0, fraction / np.where(single > 0, single, 1), 1.0)

    def _lit(self, slope: F64) -> F64:
        """Return the fraction of the lens's entrance that sources at field angles light through the baffle."""
        return lit_fraction(self.lens, self.settings.baffle, slope)


def lit_fraction(lens: Prescription, baffle: Baffle, slope: F64) -> F64:
    """Return the fraction of a lens's entrance that sources light through a baffle, float64 like their `slope`."""
    if baffle.length_mm <= 0:
        return np.ones(slope.shape)
    return baffle_transmission(
        np.degrees(np.arctan(slope)),
        length_mm=baffle.length_mm,
        radius_mm=baffle.radius_mm,
        entrance_radius_mm=min(lens.surfaces[0].semi_diameter_mm, baffle.radius_mm),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Places:
    """Hold where the sources of a render lie.

    Attributes
    ----------
    slope
        float64[source]: tangents of the field angles.
    polar
        Sparse float32[ring × azimuth, source]: cells of ghosts.
    directions
        Grid of direction cosines, for glare.
    angle, rest
        int64[source] and float32[source]: position of each source on the grid of `_ANGLES` field angles.
    """

    slope: F64
    polar: Any
    directions: DirectionGrid
    angle: NDArray[np.int64]
    rest: F32

    def at_angle(self, values: F64) -> F32:
        """Return values at the grid of field angles for every source, float32[source]."""
        table = values.astype(np.float32)
        return table[self.angle] + self.rest * np.diff(table)[self.angle]


@lru_cache(maxsize=2)
def _places(render: RenderGrid, sensor: SensorGrid, image: Lens, cells: PolarCells, efl_px: float) -> _Places:
    """Return where the sources of a render lie; it is cached for the camera."""
    x, y = render.slopes
    slope = np.hypot(x, y)
    stretch = np.ones(len(slope))
    off_axis = slope > 1e-9
    stretch[off_axis] = image.distorted(slope[off_axis]) / slope[off_axis]
    stretch *= image.focal_length_mm / sensor.pitch_mm / efl_px
    position = np.arctan(slope) / np.arctan(slope.max()) * (_ANGLES - 1)
    angle = np.minimum(position.astype(np.int64), _ANGLES - 2)
    return _Places(
        slope=slope,
        polar=cells.source_weights(x, y),
        directions=DirectionGrid.of(
            x * stretch, y * stretch, render.block / render.focal_px, sensor, efl_px * sensor.pitch_mm
        ),
        angle=angle,
        rest=(position - angle).astype(np.float32),
    )
