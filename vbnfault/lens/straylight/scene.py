"""Compute the straylight of an extended scene: ghosts, glare and veil of everything that a render shows.

Each part of the scene is a source like the Sun in `total`, with the irradiance L cos³θ dA / f² across its
direction, where dA / f² is the area of a pixel of the render in focal lengths. The sum over all sources is linear
in the radiance L, so that it is computed from responses that depend on the lens alone:

- ghosts by `ghost_response`, in polar cells;
- glare and the light that the stop diffracts (starburst) by `scene_convolution`, over direction cosines;
- the veil of mount, barrel and edges by its closed form (`total`), from the flux that enters the lens.

Sources out of the field are in coarse renders around the first one (`surrounding_grids`), each four times as wide
as the one before and without what that one shows, and far bodies beside the scene (`PointSources`).

The Sun's disc is not part of the scene; `total` computes its straylight.

Within a channel of the sensor, the reflectance of a source is taken as linear in wavelength (`in_channels`). So the
light of a channel is that of two spectra, which rise and fall linearly over it, and each is integrated with the
lens's coatings at every nanometre, as for the Sun.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import spectra, sundisc
from ...core.spectra import Bands
from ..imaging import Lens
from ..paraxial import paraxial_properties
from ..prescription import Prescription
from ..rays import axial_transmittance
from ..thin import cos4_map
from .ghost_response import GhostResponse, PolarCells, ghost_response
from .irradiance import disc_samples
from .scatter import glare_kernels, hood_transmission, scattered_fraction
from .scene_convolution import DirectionGrid, SeparatedKernel, separated, starburst_of_source, wing_spectra
from .settings import SensorGrid, StraylightSettings

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Sources = tuple["RenderGrid | PointSources", F32]

# Sizes of the cells of ghosts, in rings from the axis to the corner. Halving them changes the ghosts of
# `nikkor_28_f2p8_camera` by less than 1 % of their light.
SOURCE_RINGS, SENSOR_RINGS, AZIMUTHS = 64, 96, 512
_MOST_SOURCES = 512  # along each side of a render; the pixels of a larger one are added up in blocks
_ANGLES = 17  # field angles of the kernels of glare
_WIDER = 4.0  # half the width of a surrounding render over that of the render within it
_SURROUNDING_PX = 128
_WIDEST_DEG = 75.0
_WIDEST = float(np.tan(np.radians(_WIDEST_DEG)))
_DISC_RINGS = 2  # of points that stand for the disc of a far body
_STEPS_OF_SPIKES = 2  # of the grid of directions in a source, on which the stop has spikes as narrow as the source
_RING_RATIO = 1.15  # ratio of the slopes of neighbouring rings of sources out of the field


@dataclass(frozen=True, kw_only=True)
class RenderGrid:
    """Describe the pinhole render of a scene: (height, width) with its guard band, and focal length in pixels.

    `inner` are half the width and half the height, as tangents, of what another render shows; its light does not
    count here.
    """

    shape: tuple[int, int]
    focal_px: float
    inner: tuple[float, float] = (0.0, 0.0)

    @property
    def half(self) -> tuple[float, float]:
        """Return half the width and half the height as tangents."""
        height, width = self.shape
        return width / 2 / self.focal_px, height / 2 / self.focal_px

    @cached_property
    def outside(self) -> F32:
        """Return the fraction of each pixel that lies outside `inner`, float32[y, x]."""
        covered = []
        for size, half in zip(self.shape[::-1], self.inner, strict=True):
            edges = np.clip((np.arange(size + 1) - size / 2) / self.focal_px, -half, half)
            covered.append(np.diff(edges) * self.focal_px)
        return np.asarray(1 - covered[1][:, None] * covered[0], dtype=np.float32)

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
        if any(self.inner):
            solid = solid * self.outside
        out = np.empty((len(radiance), rows, columns), dtype=np.float32)
        padded = np.zeros((rows * side, columns * side), dtype=np.float32)
        for band, sources in zip(radiance, out, strict=True):
            np.multiply(band, solid, out=padded[:height, :width])
            sources[:] = padded.reshape(rows, side, columns, side).sum(axis=(1, 3))
        return out.reshape(len(radiance), -1)


@dataclass(frozen=True, kw_only=True)
class PointSources:
    """Describe far points as sources, by the tangents x/z and y/z of their directions.

    `focal_px` is the focal length of the scene's render in pixels; the glare of the points is as sharp as `block`
    of these pixels.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    focal_px: float
    block: int = 4

    @property
    def slopes(self) -> tuple[F64, F64]:
        """Return the tangents of the directions, float64[source] each."""
        return np.array(self.x), np.array(self.y)

    @classmethod
    def of_disc(
        cls, direction_C: F64, radius_rad: float, focal_px: float, reach: float
    ) -> tuple[PointSources, float]:
        """Return the points of a disc before the camera, and the fraction of the disc's light that each stands for.

        `reach` is the tangent of the largest field angle. A disc smaller than the sharpness of its glare is one
        point.
        """
        offsets = disc_samples(_DISC_RINGS) if radius_rad * focal_px > cls.block else np.zeros((1, 2))
        *across, axis = sundisc.axes(direction_C)
        points = axis + np.tan(radius_rad) * offsets @ np.stack(across)
        near = (points[:, 2] > 0) & (np.hypot(points[:, 0], points[:, 1]) < reach * np.abs(points[:, 2]))
        x, y = (points[near, k] / points[near, 2] for k in (0, 1))
        return cls(x=tuple(x.tolist()), y=tuple(y.tolist()), focal_px=focal_px), 1 / len(offsets)


def surrounding_grids(render: RenderGrid) -> tuple[RenderGrid, ...]:
    """Return the grids of coarse renders that show what lies around a render, up to 75 degrees from the axis."""
    grids: list[RenderGrid] = []
    inner = render.half
    while min(inner) < _WIDEST:
        half = min(_WIDER * max(inner), _WIDEST)
        grids.append(
            RenderGrid(shape=(_SURROUNDING_PX, _SURROUNDING_PX), focal_px=_SURROUNDING_PX / 2 / half, inner=inner)
        )
        if half == _WIDEST:
            break
        inner = half, half
    return tuple(grids)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneStraylight:
    """Hold the straylight of a scene, float32[channel, y, x] each."""

    ghosts: F32
    glare: F32
    veil: F32
    starburst: F32 | None = None

    @property
    def total(self) -> F32:
        """Return the sum of all parts."""
        total = self.ghosts + self.glare + self.veil
        return np.asarray(total if self.starburst is None else total + self.starburst)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneInLens:
    """Compute the straylight of a scene behind a lens.

    Attributes
    ----------
    lens
        The lens at its final size.
    bands
        Bands in which the light is computed.
    of_nodes
        float64[band, node]: converts the radiance at its nodes to these bands, as `in_channels` returns it.
    sensor
        The sensor.
    render
        Grid of the scene's radiance.
    image
        Lens of the camera, which says where a source is imaged.
    settings
        State of the lens.
    passed
        float64[n]: transmittance of the path that forms the image, as `DirectPath.transmittance`.
    around
        Grids of the renders around that of the scene.
    diffraction
        Whether the stop diffracts light of the scene beyond the point spread.
    """

    lens: Prescription
    bands: Bands
    of_nodes: F64
    sensor: SensorGrid
    render: RenderGrid
    image: Lens
    settings: StraylightSettings
    passed: F64
    around: tuple[RenderGrid, ...] = ()
    diffraction: bool = False

    def straylight(
        self, radiance: F32, weights: F64, around: Sequence[F32] = (), points: Sequence[Sources] = ()
    ) -> SceneStraylight:
        """Return the straylight of a scene.

        Parameters
        ----------
        radiance
            float32[node, y, x] on the grid of the render, without the Sun's disc.
        weights
            float64[channel, band], with which the bands are added.
        around
            The same of the renders around it, on the grids `around`.
        points
            `PointSources` and their irradiances, float32[node, source].
        """
        renders = zip((self.render, *self.around), (radiance, *around), strict=True)
        sources: list[Sources] = [(render, render.irradiance(array)) for render, array in renders]
        sources += points
        # einsum, because the bits of BLAS may depend on the number of threads
        of_nodes = self.of_nodes.astype(np.float32)
        sources = [(grid, np.einsum("bn,ns->bs", of_nodes, irradiance)) for grid, irradiance in sources]
        return SceneStraylight(
            ghosts=self.ghosts(sources, weights),
            glare=self.glare(sources, weights),
            veil=self.veil(sources, weights),
            starburst=self.starburst(sources, weights) if self.diffraction else None,
        )

    def ghosts(self, sources: Sequence[Sources], weights: F64) -> F32:
        """Return the ghosts of sources, float32[channel, y, x].

        `sources` are grids and irradiances float32[band, source] of the sources on them.
        """
        response = self.response
        cells = response.cells
        if not response.table.any():
            return np.zeros((len(weights), *self.sensor.shape), dtype=np.float32)
        light = sum(self._places(grid).polar @ irradiance.T for grid, irradiance in sources)
        light = light.reshape(len(cells.slopes), cells.azimuths, len(weights.T))
        # rays of ghosts meet the hood themselves
        past_baffle = self.settings.baffle.lit_fraction(self.lens, np.array(cells.slopes))
        light *= past_baffle.astype(np.float32)[:, None, None]
        return response.image(light, weights, self.sensor)

    def glare(self, sources: Sequence[Sources], weights: F64) -> F32:
        """Return what the surfaces scatter; arguments and result as those of `ghosts`."""
        scattered = np.zeros((len(weights), *self.sensor.shape), dtype=np.float32)
        for grid, irradiance in sources:
            places, kernel = self._places(grid), self._kernel(grid)
            lit, terms = self._lit(kernel.slope), []
            for of_source, of_offset in zip(kernel.of_source, kernel.of_offset, strict=True):
                light = np.zeros((len(weights), irradiance.shape[1]), dtype=np.float32)
                for gain, own, of_band in zip(of_source * lit, irradiance, weights.T, strict=True):
                    scattering = own * places.at_angle(gain)
                    for channel, weight in zip(light, of_band, strict=True):
                        channel += scattering * np.float32(weight)
                terms.append((light, places.directions.spectrum(kernel.offset, of_offset)))
            if terms and irradiance.any():
                scattered += places.directions.convolved(terms)
        # the transform leaves rounding errors where there is no light
        return np.maximum(scattered * cos4_map(self.sensor.shape, self._efl_px), 0, out=scattered)

    def starburst(self, sources: Sequence[Sources], weights: F64) -> F32:
        """Return what the stop diffracts beyond the point spread; arguments and result as those of `ghosts`."""
        diffracted = np.zeros((len(weights), *self.sensor.shape), dtype=np.float32)
        for grid, irradiance in sources:
            if not irradiance.any():
                continue
            places = self._places(grid)
            finer = _STEPS_OF_SPIKES if self.lens.surfaces[self.lens.stop].blades else 1
            field = float(np.hypot(*self.render.half))
            directions = _directions(grid, field, self.sensor, self.image, self._efl_px, finer)
            behind = self.bands.behind(self.passed)
            kernels, mix = _wings(self.lens, behind, grid.block / grid.focal_px, directions, self.sensor)
            # the Sun's starburst scales with the beam across its direction, too
            kept = (self._lit(places.slope) / np.hypot(1, places.slope)).astype(np.float32)
            gains = np.einsum("cb,b,bk->kcb", weights, self.bands.mean(self.passed), mix).astype(np.float32)
            terms = [
                (np.einsum("cb,bs->cs", gain, irradiance) * kept, kernel)
                for gain, kernel in zip(gains, kernels, strict=True)
            ]
            diffracted += directions.convolved(terms)
        return np.maximum(diffracted * cos4_map(self.sensor.shape, self._efl_px), 0, out=diffracted)

    def veil(self, sources: Sequence[Sources], weights: F64) -> F32:
        """Return what mount, barrel and edges scatter; arguments and result as those of `ghosts`."""
        properties = paraxial_properties(self.lens)
        entering = np.zeros(len(weights.T))
        for grid, irradiance in sources:
            slope = self._places(grid).slope
            cosine = (self._lit(slope) / np.hypot(1, slope)).astype(np.float32)
            entering += np.einsum("bs,s->b", irradiance, cosine, dtype=np.float64)
        entering *= np.pi / 4 * properties.entrance_pupil_diameter_mm**2
        flux = np.einsum("cb,b->c", weights, entering * self.bands.mean(self.passed) * self.settings.veil_fraction)
        per_mm2 = cos4_map(self.sensor.shape, self._efl_px) * np.float32(1 / (np.pi * properties.efl_mm**2))
        return np.asarray(per_mm2 * flux.astype(np.float32)[:, None, None])

    @property
    def response(self) -> GhostResponse:
        """Return the ghosts of every source; they are cached for lens, sensor and coating loss."""
        settings = self.settings
        return ghost_response(self.lens, self.bands, self._cells, settings.ghosts, settings.coating_loss)

    @property
    def reach(self) -> float:
        """Return the tangent of the field angle up to which sources count."""
        return self._cells.slopes[-1]

    @property
    def _cells(self) -> PolarCells:
        """Return the cells of ghosts."""
        x, y = self.render.slopes
        # cells are no finer than half a pixel
        corner_px = float(np.hypot(*self.sensor.shape)) / 2
        most = 2 * int(np.ceil(corner_px)), 2 * int(np.ceil(corner_px)), 2 << int(np.log2(2 * np.pi * corner_px))
        sources, rings, azimuths = map(min, (SOURCE_RINGS, SENSOR_RINGS, AZIMUTHS), most)
        slopes = np.linspace(0, float(np.hypot(x, y).max()), sources).tolist()
        farthest = max((float(np.hypot(*grid.slopes).max()) for grid in self.around), default=0.0)
        while slopes[-1] < farthest:
            slopes.append(min(max(_RING_RATIO * slopes[-1], slopes[-1] + slopes[1]), farthest))
        return PolarCells(
            slopes=tuple(slopes),
            reach_mm=corner_px * self.sensor.pitch_mm,
            rings=rings,
            azimuths=azimuths,
        )

    @property
    def _efl_px(self) -> float:
        """Return the focal length of the lens in pixels of the sensor."""
        return paraxial_properties(self.lens).efl_mm / self.sensor.pitch_mm

    def _places(self, grid: RenderGrid | PointSources) -> _Places:
        """Return where the sources on a grid lie."""
        field = float(np.hypot(*self.render.half))
        return _places(grid, field, self.sensor, self.image, self._cells, self._efl_px)

    def _kernel(self, grid: RenderGrid | PointSources) -> SeparatedKernel:
        """Return the glare of sources on a grid, with all losses but those at the baffle."""
        slope = np.tan(np.linspace(0, np.arctan(self._places(grid).slope.max()), _ANGLES))
        cleanliness, bands = self.settings.cleanliness, self.bands
        offset, kernels = glare_kernels(self.lens, bands, slope, cleanliness)
        own = bands.mean(axial_transmittance(self.lens, bands.wavelength_nm))
        gain = bands.mean(self.passed) / own * self._kept_of_single
        return separated(kernels * gain[:, None, None], slope, offset)

    @property
    def _kept_of_single(self) -> F64:
        """Return the factor of `VeilingGlare.kept_of_single`, float64[band]."""
        bands = self.bands.behind(self.passed)
        fraction = scattered_fraction(self.lens, bands, self.settings.cleanliness)
        single = -np.log1p(-fraction)
        return np.where(single > 0, fraction / np.where(single > 0, single, 1), 1.0)

    def _lit(self, slope: F64) -> F64:
        """Return the fraction of the lens's entrance that sources light through the baffle and past the hood."""
        past_baffle = self.settings.baffle.lit_fraction(self.lens, slope)
        return np.minimum(past_baffle, hood_transmission(self.lens, slope))


def in_channels(rates: F64, nodes_nm: F64) -> tuple[Bands, F64, F64]:
    """Return two bands for each channel, and the matrices that convert to them and from them.

    The matrices are float64[band, node] and float64[channel, band].

    In the first band of a channel the weight of its sunlight falls linearly over the wavelengths that it senses, in
    the second it rises. The ratio of a source to sunlight, linear between the nodes, is fitted by a line with the
    weights of the channel. The values include the `rates`, float64[channel, n].
    """
    nm = spectra.fine_nodes_nm(nodes_nm)
    ratio = spectra.hat_weights(nodes_nm, nm) / spectra.solar_band_irradiance_W_m2_nm(nodes_nm, 1.0)[:, None]
    lines, values = [], []
    for spectrum in rates * spectra.solar_irradiance_W_m2_nm(nm):
        seen = nm[spectrum > 0] if spectrum.any() else nm
        ends = np.array([seen[0], max(seen[-1], seen[0] + 1)])
        line = spectra.hat_weights(ends, nm) * spectrum
        hats = spectra.hat_weights(ends, nm)
        at_ends = np.linalg.lstsq((hats * np.sqrt(spectrum)).T, (ratio * np.sqrt(spectrum)).T)[0]
        lines.append(line)
        values.append(np.trapezoid(line, nm, axis=1)[:, None] * at_ends)
    return Bands.of(nm, np.concatenate(lines)), np.concatenate(values), np.repeat(np.eye(len(rates)), 2, axis=1)


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
        # the indices lie in the table, so that clipping changes none and is quicker than the check
        found, steps = (np.take(of, self.angle, mode="clip") for of in (table, np.diff(table)))
        steps *= self.rest
        return np.add(found, steps, out=found)


@lru_cache(maxsize=8)
def _places(
    render: RenderGrid | PointSources,
    field: float,
    sensor: SensorGrid,
    image: Lens,
    cells: PolarCells,
    efl_px: float,
) -> _Places:
    """Return where the sources of a render lie; it is cached for the camera.

    The lens's distortion is known up to the slope `field`.
    """
    x, y = render.slopes
    slope = np.hypot(x, y)
    position = np.arctan(slope) / np.arctan(max(float(slope.max()), 1e-9)) * (_ANGLES - 1)
    angle = np.minimum(position.astype(np.int64), _ANGLES - 2)
    return _Places(
        slope=slope,
        polar=cells.source_weights(x, y),
        directions=_directions(render, field, sensor, image, efl_px, 1),
        angle=angle,
        rest=(position - angle).astype(np.float32),
    )


@lru_cache(maxsize=4)
def _wings(
    lens: Prescription, bands: Bands, width_rad: float, directions: DirectionGrid, sensor: SensorGrid
) -> tuple[tuple[F32, ...], F64]:
    """Return `wing_spectra` of sources of this width; they are cached for the camera."""
    return wing_spectra(starburst_of_source(lens, bands, width_rad), bands, directions, sensor)


@lru_cache(maxsize=8)
def _directions(
    render: RenderGrid | PointSources, field: float, sensor: SensorGrid, image: Lens, efl_px: float, finer: int
) -> DirectionGrid:
    """Return the grid of direction cosines for the sources of a render, with `finer` steps in each source."""
    x, y = render.slopes
    known = np.clip(np.hypot(x, y), 1e-9, field)
    stretch = image.distorted(known) / known
    stretch *= image.focal_length_mm / sensor.pitch_mm / efl_px
    step = render.block / render.focal_px / finer
    return DirectionGrid.of(x * stretch, y * stretch, step, sensor, efl_px * sensor.pitch_mm)
