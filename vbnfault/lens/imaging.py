"""Image a scene through a prescription with exact rays: distortion, relative illumination, colour, point spread.

The input is a render on the grid of a pinhole camera, with a guard band around the frame. Per band, in this order:

1. resample the radiance to where the lens images it (distortion, lateral colour);
2. multiply by transmission and solid angle, which gives irradiance (the transmission is the mean over the band in
   sunlight; its spectrum goes with the irradiance, as a filter sees only a part of a band);
3. spread each pixel's light by the point spread function.

The geometry behind the steps:

- Chief rays pass through the middle of the real stop. They give the height of the image h(θ, λ); see `mapping`.
- The bundle that passes all rims carries the light. It covers the area A in the plane of the first vertex. A field
  of radiance L at the angle θ sends L A cos θ dΩ through A, and this flux lands on dA = h dh dφ. With t = tan θ,

      E = L T A cos⁴θ · t / (h dh/dt).

  This contains natural and mechanical vignetting and the stretch by distortion; no further cos⁴ applies.
- The point spread is the pattern of the bundle's rays on the sensor. Each ray is weighted with the area that it
  came through, and diffraction blurs the pattern.

Not modelled: the shift of a spot's centroid from its chief ray (coma), so that light lies where the labels are;
reflection losses off the axis; the distance of the object, since rays come from infinity. A stop with blades is
replaced by a round one of the same area.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import spectra
from ..core.errors import InputError
from ..core.quantities import Irradiance, Radiance, splat
from ..core.sundisc import LEAST_Z, Floats, add_mean, forward, pixel_sums
from .glass import D_NM, RANGE_NM
from .mapping import ChiefHeights, FieldMap, RadialModel, camera_model, chief_heights, field_map
from .paraxial import paraxial_properties
from .point_spread import (
    REACH_PX,
    FieldBundles,
    PointSpreads,
    field_bundles,
    kernels_of_spots,
    spot_diagrams,
    tiles,
)
from .prescription import Prescription
from .rays import axial_transmittance
from .resampling import RadialTables, Resampling, table_distances
from .thin import ThinLens

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_ANGLES = 65  # field angles of the tables
_BEYOND = 1.6  # the tables reach this multiple of the corner's tangent
_DENSE = 4097  # nodes of the tables over slope
_CELLS = 256  # cells of a quadrant, along each side, in which the lit part of the frame is counted
_COLOUR_PX = 4  # extra guard band, since other colours may come from farther out than the d line
_INSIDE = (slice(REACH_PX, -REACH_PX), slice(REACH_PX, -REACH_PX))


# --- the lens --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FrameCoverage:
    """Say how much of a frame a lens lights.

    `lit_fraction` is the part of the frame that light reaches. `field_deg` is the largest angle from the axis in
    this part, `corner_deg` that of the frame's corners.
    """

    lit_fraction: float
    field_deg: float
    corner_deg: float


@dataclass(frozen=True, kw_only=True)
class RealLens:
    """Image through a prescription at its final scale, with a sensor behind it.

    It answers the same questions as a `ThinLens`.

    Attributes
    ----------
    focus
        "paraxial": the sensor stands at the paraxial focus of a far object. "best": it stands where the mean square
        radius of the spots over the frame is smallest. Both hold for the d line.
    focus_distance_m
        Object distance by which the renderer defocuses the scene.
    guard
        Guard band of the renders that the lens images, for a lens that is changed after the render; default: the
        one that it needs.
    """

    prescription: Prescription
    width_px: int
    height_px: int
    pixel_pitch_um: float
    focus: str = "paraxial"
    focus_distance_m: float = float("inf")
    guard: tuple[int, int] | None = None

    resamples: ClassVar[bool] = True
    blurs: ClassVar[bool] = True
    falls_off: ClassVar[bool] = True
    border_px: ClassVar[int] = REACH_PX
    calibration: ClassVar[None] = None

    @property
    def real(self) -> RealLens:
        """Return the lens itself, which has surfaces."""
        return self

    @property
    def name(self) -> str:
        """Return the name of the prescription."""
        return self.prescription.name

    @cached_property
    def sensor_mm(self) -> float:
        """Return the distance of the sensor plane behind the last vertex."""
        bfd_mm = paraxial_properties(self._round).bfd_mm
        return bfd_mm if self.focus == "paraxial" else bfd_mm + self._best_shift_mm

    @cached_property
    def focal_length_mm(self) -> float:
        """Return image height over the tangent of the field angle near the axis, at the d line.

        It is the EFL where the sensor stands at the paraxial focus.
        """
        efl = paraxial_properties(self._round).efl_mm
        return efl if self.focus == "paraxial" else float(self._chief_rays.rise_mm(np.zeros(1))[0])

    @cached_property
    def f_number(self) -> float:
        """Return the EFL divided by the diameter of a disc that has the area of the axial beam."""
        area = float(self._beams.area_mm2[0])
        return float(paraxial_properties(self._round).efl_mm / (2 * np.sqrt(area / np.pi)))

    @property
    def figures(self) -> dict[str, str | float]:
        """Return the lens's properties after scaling and stopping down, and a sentence `summary` for people.

        The properties are name, scale relative to the prescription's file, EFL, f-number of the real beam, diameter
        of the stop, and transmission on the axis at the d line.
        """
        lens = self.prescription
        efl_mm = paraxial_properties(lens).efl_mm
        return {
            "name": lens.name,
            "scale": lens.scale,
            "efl_mm": efl_mm,
            "f_number": self.f_number,
            "stop_diameter_mm": 2 * lens.surfaces[lens.stop].semi_diameter_mm,
            "transmission": self.transmission,
            "summary": f"{lens.name}, scaled by {lens.scale:.4g} to {efl_mm:.4g} mm, f/{self.f_number:.3g}; "
            "coatings, roughness and grains keep their size",
        }

    @property
    def aperture_radius_m(self) -> float:
        """Return the radius of the axial beam, in metres."""
        return float(np.sqrt(self._beams.area_mm2[0] / np.pi)) * 1e-3

    @property
    def transmission(self) -> float:
        """Return the transmittance along the axis at the d line."""
        return float(self.transmittance(np.array([D_NM]))[0])

    def transmittance(self, wavelength_nm: F64) -> F64:
        """Return the fraction of the axial light that coatings and glass transmit, float64 like `wavelength_nm`."""
        return axial_transmittance(self.prescription, np.clip(wavelength_nm, *RANGE_NM))

    def _passed(self, nodes_nm: F64) -> F64:
        """Return the fraction of the axial sunlight in each band that the lens transmits, float64[band]."""
        return spectra.band_means(self._spectrum(nodes_nm), nodes_nm)

    def _spectrum(self, nodes_nm: F64) -> F64:
        """Return `Irradiance.transmittance` for bands."""
        return self.transmittance(spectra.fine_nodes_nm(nodes_nm))

    def pupil_area_mm2(self, slope: ArrayLike) -> F64:
        """Return the area of the beam that passes all rims, in the plane of the first vertex.

        `slope`: tangents of field angles; the result is float64 of the same shape. Beyond the traced field it stays
        constant.
        """
        return np.asarray(np.interp(np.asarray(slope, dtype=np.float64), self._beams.slope, self._beams.area_mm2))

    def axial_solid_angle_sr(self, wavelength_nm: F64) -> F64:
        """Return irradiance over radiance on the axis in bands of sunlight, T A / f², float64[band].

        It is π T / (4 N²) at the paraxial focus.
        """
        return np.asarray(
            [
                passed * self._beams.area_mm2[0] / self._map(wavelength).rise_mm[0] ** 2
                for passed, wavelength in zip(self._passed(wavelength_nm), wavelength_nm.tolist(), strict=True)
            ]
        )

    # --- geometry

    def distorted(self, slope: F64, wavelength_nm: float = D_NM) -> F64:
        """Return image heights in focal lengths for tangents of field angles, float64 like `slope`."""
        return self._map(wavelength_nm).height(slope) / self.focal_length_mm

    def undistorted(self, distance: F64, wavelength_nm: float = D_NM) -> F64:
        """Return the tangents of the field angles at image heights in focal lengths, float64 like `distance`."""
        return self._map(wavelength_nm).slope_at(distance * self.focal_length_mm)

    @property
    def distortion(self) -> F64:
        """Return OpenCV's k1, k2, p1, p2, k3, k4, k5, k6 at the d line, float64[8]; p1 = p2 = 0.

        They define the map between field angles and the frame, which `distorted` and `undistorted` follow.
        """
        return np.array(self._model.coefficients)

    @property
    def distortion_valid_to_deg(self) -> float:
        """Return the field angle up to which `distortion` takes one direction to one place."""
        return self._model.valid_to_deg

    @cached_property
    def distortion_residual_px(self) -> tuple[float, float]:
        """Return the rms and the largest difference between `distortion` and the chief rays, in pixels.

        They are taken over the part of the lit frame that has chief rays.
        """
        slope = self.undistorted(self._distances[self._lit])
        slope = slope[slope <= self._chief_rays.end]
        apart = self._model.distance(slope) - self._chief_rays.height_mm(slope) / self.focal_length_mm
        off_px = np.abs(apart) * self.focal_length_px
        return float(np.sqrt(np.mean(off_px**2))), float(off_px.max())

    @cached_property
    def _distances(self) -> F64:
        """Return image heights, in focal lengths, of positions all over the frame, float64[position]."""
        x, y = (np.linspace(0, size / 2 / self.focal_length_px, 65) for size in (self.width_px, self.height_px))
        return np.asarray(np.hypot(x[None, :], y[:, None]).ravel())

    @cached_property
    def _lit(self) -> NDArray[np.bool_]:
        """Return which of `_distances` receive light."""
        return np.asarray(self.relative_illumination(self._distances) > 0)

    def field_slopes(self, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
        """Return the tangents of the field angles, along x and y, of the d line's chief rays.

        `x` and `y` are float32 image heights in focal lengths, of one shape, which the results have too.
        """
        distance = np.maximum(np.hypot(x, y), np.float32(1e-6))
        stretch = (self.undistorted(distance) / distance).astype(np.float32)
        return x * stretch, y * stretch

    def projection(self, intrinsics: F64 | None = None) -> ChiefRays:
        """Return the map between directions and pixels by chief rays at the d line.

        `intrinsics` belong to the interface; the lens knows its own pixels.
        """
        return self.chief_rays()

    def chief_rays(self, wavelength_nm: float = D_NM, margin_px: int = 0) -> ChiefRays:
        """Return the map between pixels, of the frame and a margin around it, and directions at one wavelength."""
        return ChiefRays(lens=self, wavelength_nm=wavelength_nm, margin_px=margin_px)

    @property
    def focal_length_px(self) -> float:
        """Return the focal length in pixels."""
        return self.focal_length_mm * 1e3 / self.pixel_pitch_um

    def relative_illumination(self, distance: F64, wavelength_nm: float = D_NM) -> F64:
        """Return a uniform field's irradiance relative to that on the axis, at image heights in focal lengths."""
        mapped = self._map(wavelength_nm)
        solid = self._solid_angle_sr(mapped)
        seen = np.interp(mapped.slope_at(distance * self.focal_length_mm), mapped.slope, solid, right=0.0)
        return np.asarray(seen / solid[0])

    @cached_property
    def coverage(self) -> FrameCoverage:
        """Return how much of the frame the lens lights."""
        size = np.array([self.width_px, self.height_px]) / 2 / self.focal_length_px
        middles = (np.arange(_CELLS) + 0.5) / _CELLS
        distance = np.hypot(size[0] * middles[None, :], size[1] * middles[:, None]).ravel()
        lit = self.relative_illumination(distance) > 0
        ends = np.array([distance[lit].max(initial=0), np.hypot(*size)])
        field_deg, corner_deg = np.degrees(np.arctan(self.undistorted(ends)))
        return FrameCoverage(
            lit_fraction=float(lit.mean()), field_deg=float(field_deg), corner_deg=float(corner_deg)
        )

    @cached_property
    def guard_px(self) -> tuple[int, int]:
        """Return how many pixels a render needs beyond the frame: (left and right, top and bottom).

        They hold the light that distortion and point spread bring in from outside the frame, at the same focal
        length.

        Raises
        ------
        InputError
            The lens sees a much wider field than a pinhole render of its focal length can hold.
        """
        if self.guard is not None:
            return self.guard
        mapped = self._map(D_NM)
        farthest = self._slopes[-1]
        if self._beams.area_mm2[-1] > 0 and mapped.height(farthest) < self._corner * self.focal_length_mm:
            angle = np.degrees(np.arctan(farthest))
            raise InputError(
                f"{self.name}: camera.fov_deg: barrel distortion brings light from beyond {angle:.0f} degrees into "
                "the corners, which the render has not; it must be smaller"
            )
        half = np.array([self.width_px, self.height_px]) / 2
        part, whole = np.linspace(0, 1, 129), np.ones(129)
        border = np.concatenate([np.column_stack([part, whole]), np.column_stack([whole, part])])
        border *= half + REACH_PX
        distance = np.hypot(*border.T) / self.focal_length_px
        lit = self.relative_illumination(distance) > 0
        seen = border * (self.undistorted(distance) / distance * lit)[:, None]
        gx, gy = np.ceil(np.maximum(seen.max(axis=0) - half, 0)).astype(int) + _COLOUR_PX
        return int(gx), int(gy)

    # --- inputs of the tables

    @cached_property
    def _round(self) -> Prescription:
        """Return the prescription with a round stop."""
        return self.prescription.with_round_stop()

    @cached_property
    def _corner(self) -> float:
        """Return the image height of the frame's corner, with the reach of the point spread, in EFL."""
        return float(self._most_px * self.pixel_pitch_um * 1e-3 / paraxial_properties(self._round).efl_mm)

    @cached_property
    def _slopes(self) -> F64:
        """Return the tangents of the tables' field angles, float64[angle]; the first is nearly 0."""
        slope = np.tan(np.linspace(0, np.arctan(_BEYOND * self._corner), _ANGLES))
        slope[0] = 1e-3 * slope[1]
        return slope

    @cached_property
    def _beams(self) -> FieldBundles:
        """Return the bundles at the field angles of the tables."""
        return field_bundles(self._round, self._slopes)

    @cached_property
    def _lit_beams(self) -> FieldBundles:
        """Return the bundles of rays, by field angle, of which some pass the lens."""
        return self._beams.select(self._beams.area_mm2 > 0)

    @cached_property
    def _best_shift_mm(self) -> float:
        """Return the distance from the paraxial focus to the smallest mean square radius of all spots.

        Each spot, of the lit ones from the axis to the corner, counts with the light that its zone of the frame
        receives.
        """
        beams, lens = self._lit_beams.select(self._lit_beams.slope <= 1.1 * self._corner), self._round
        optics = paraxial_properties(lens)
        spots = spot_diagrams(lens, beams, D_NM, optics.bfd_mm)
        position, slope = spots.centred(spots.position_mm), spots.centred(spots.slope)
        # count the pixels of the frame nearest to each zone's undistorted position
        x, y = (np.abs(np.arange(n) + 0.5 - n / 2) for n in (self.width_px, self.height_px))
        radius = np.hypot(x[None, ::8], y[::8, None]).ravel() * self.pixel_pitch_um * 1e-3 / optics.efl_mm
        edges = (beams.slope[1:] + beams.slope[:-1]) / 2
        lit = radius[radius <= beams.slope[-1]]
        pixels = np.bincount(np.searchsorted(edges, lit), minlength=len(beams.slope))
        light = pixels * beams.area_mm2 / (1 + beams.slope**2) ** 2
        together, alone = (spots.mean((v * slope).sum(axis=-1)) for v in (position, slope))
        return float(-(light @ together) / (light @ alone))

    @cached_property
    def _chief_rays(self) -> ChiefHeights:
        """Return the chief rays of the d line."""
        return self._chief_rays_at(D_NM)

    def _chief_rays_at(self, wavelength_nm: float, within: float = np.inf) -> ChiefHeights:
        """Return the chief rays of a wavelength, up to the slope `within` at most."""
        lens = self._round
        return chief_heights(
            lens,
            self._slopes,
            wavelength_nm=wavelength_nm,
            sensor_mm=self.sensor_mm,
            efl_mm=paraxial_properties(lens).efl_mm,
            within=within,
        )

    @cached_property
    def _model(self) -> RadialModel:
        """Return the distortion model of the frame, with the reach of the point spread."""
        pixels = self.focal_length_px
        return camera_model(self._chief_rays, self.focal_length_mm, self._most_px / pixels, pixels, self.name)

    def _map(self, wavelength_nm: float) -> FieldMap:
        """Return the map from field angles to image heights at a wavelength."""
        return _map(self, float(wavelength_nm))

    def _solid_angle_sr(self, mapped: FieldMap) -> F64:
        """Return irradiance over radiance without losses, float64 like `mapped.slope`."""
        slope = mapped.slope
        area = self._beam_mm2(slope)
        stretch = np.empty_like(slope)
        stretch[1:] = slope[1:] / mapped.height_mm[1:]
        stretch[0] = 1 / mapped.rise_mm[0]
        return np.asarray(area / (1 + slope**2) ** 2 * stretch / mapped.rise_mm)

    def _beam_mm2(self, slope: F64) -> F64:
        """Return the area of the beam that passes all rims, float64 like `slope`, which must rise."""
        from scipy.interpolate import PchipInterpolator  # takes half a second to import

        beams = self._beams
        traced = np.clip(slope, beams.slope[0], beams.slope[-1])
        area = np.maximum(PchipInterpolator(beams.slope, beams.area_mm2)(traced), 0)
        dark = beams.area_mm2 == 0
        if dark.any():  # from the last lit field angle to the first dark one the area falls linearly
            first = int(np.argmax(dark))
            fades = slope > beams.slope[first - 1]
            area[fades] = np.interp(slope[fades], beams.slope, beams.area_mm2)
        return np.asarray(area)

    # --- images

    def on_axis(self, radiance: Radiance) -> Irradiance:
        """Return the irradiance that a radiance gives on the axis; the pixels' positions do not matter."""
        factor = self.axial_solid_angle_sr(radiance.wavelength_nm).astype(np.float32)
        return self._irradiance(radiance.array * factor[:, None, None], radiance.wavelength_nm)

    def _irradiance(self, array: F32, nodes_nm: F64) -> Irradiance:
        """Return irradiance behind the lens."""
        return Irradiance(array=array, wavelength_nm=nodes_nm, transmittance=self._spectrum(nodes_nm))

    def spread(self, light: F32, wavelength_nm: float) -> F32:
        """Return light on the pixels of the frame, float32[y, x], after the point spread of one wavelength.

        `light` lies on the grid of the image, with `border_px` more pixels beyond each side of the frame.
        """
        return _spreads(self, (float(wavelength_nm),)).applied(light, 0)[_INSIDE]

    def image(self, radiance: Radiance) -> Irradiance:
        """Return the irradiance on the sensor, float32[band, y, x], of a render with its guard band.

        Light whose position within pixels is known is imaged itself, as the Sun's disc is: resampling the pixels of
        a render changes the power of a point by up to 26 %.
        """
        self._check(radiance)
        bands = tuple(radiance.wavelength_nm.tolist())
        tables, spreads = _tables(self, bands), _spreads(self, bands)
        array = np.empty((len(radiance.array), self.height_px, self.width_px), dtype=np.float32)
        fine, passes = radiance.fine, self.transmittance(radiance.wavelength_nm)
        source = radiance.array if fine is None else fine.removed_from(radiance.array)
        pixel_mm2 = (self.pixel_pitch_um * 1e-3) ** 2

        def image_band(band: int) -> None:
            light = self._resampling.resampled(source[band], tables.stretch[band], tables.solid_angle_sr[band])
            if fine is not None:
                rays = self.chief_rays(bands[band], REACH_PX)
                power = fine.power[band] * rays.beam_mm2(fine.directions) * (passes[band] / pixel_mm2)
                light += splat(rays.pixel_of(fine.directions), power, (light.shape[0], light.shape[1]))
            array[band] = spreads.applied(light, band)[_INSIDE]

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(image_band, range(len(array))))
        return self._irradiance(array, radiance.wavelength_nm)

    def image_of_sun(self, radiance: Radiance, pixel_pitch_um: float) -> Irradiance:
        """Return the irradiance of the Sun's direct image, whose power is E☉ T A(θ) cos θ.

        A(θ) lies in a plane across the axis; the projected solid angle of a pixel contains the cos θ. Where the
        disc is known it is imaged itself: resampling the pixels of a render would not conserve the power of a disc
        that is hardly larger than a pixel. `pixel_pitch_um` belongs to the interface: the lens knows its pixels.
        """
        if radiance.disc is None:
            return self.image(radiance)
        bands, disc = tuple(radiance.wavelength_nm.tolist()), radiance.disc
        spreads = _spreads(self, bands)
        passes = self._passed(radiance.wavelength_nm)
        array = np.zeros((len(bands), self.height_px, self.width_px), dtype=np.float32)
        shape = self.height_px + 2 * REACH_PX, self.width_px + 2 * REACH_PX
        pixel_mm2 = (self.pixel_pitch_um * 1e-3) ** 2

        def image_band(band: int) -> None:
            rays = self.chief_rays(bands[band], REACH_PX)
            sums = pixel_sums(disc, rays, shape, disc.profiles([band]), rays.beam_mm2)
            if sums is not None:
                light = sums.on(shape)[0] * (disc.radiance_W_m2_sr_nm[band] * passes[band] / pixel_mm2)
                array[band] = spreads.applied(light.astype(np.float32), band)[_INSIDE]

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(image_band, range(len(array))))
        return self._irradiance(array, radiance.wavelength_nm)

    def on_frame(self, radiance: Radiance) -> Radiance:
        """Return a render, without its guard band, on the grid of the image.

        Only distortion and lateral colour act: no light is lost and nothing is blurred.
        """
        self._check(radiance)
        bands, disc = tuple(radiance.wavelength_nm.tolist()), radiance.disc
        tables = _tables(self, bands)
        source, fine = radiance.array, radiance.fine
        if disc is not None and radiance.sun is not None:
            source = np.maximum(source - radiance.sun, 0)
        if fine is not None:
            source = fine.removed_from(source)

        def frame_band(band: int) -> F32:
            out = self._resampling.resampled(source[band], tables.stretch[band], None)[_INSIDE]
            rays = self.chief_rays(bands[band])
            if disc is not None:
                add_mean(out[None], disc, rays, [band])
            if fine is not None:
                mean = fine.power[band] / rays.solid_angle_sr(fine.directions)
                out = out + splat(rays.pixel_of(fine.directions), mean, (self.height_px, self.width_px))
            return out

        with ThreadPoolExecutor(2) as pool:
            array = np.stack(list(pool.map(frame_band, range(len(radiance.array)))))
        return replace(radiance, array=array, sun=None, disc=None, fine=None)

    def _check(self, radiance: Radiance) -> None:
        """Raise ValueError unless the radiance has the pixels of the frame and the guard band."""
        gx, gy = self.guard_px
        wanted = self.height_px + 2 * gy, self.width_px + 2 * gx
        if radiance.array.shape[1:] != wanted:
            raise ValueError(f"radiance of {radiance.array.shape[1:]} pixels: with its guard band it has {wanted}")

    @property
    def _most_px(self) -> float:
        """Return the distance of the corner from the axis in pixels, with the reach of the point spread."""
        return float(np.hypot(self.width_px / 2 + REACH_PX, self.height_px / 2 + REACH_PX))

    @cached_property
    def _resampling(self) -> Resampling:
        """Return the map from the grid of a render to that of the image and of its border for the point spread."""
        gx, gy = self.guard_px
        return Resampling.of(
            (self.height_px + 2 * REACH_PX, self.width_px + 2 * REACH_PX),
            render_shape=(self.height_px + 2 * gy, self.width_px + 2 * gx),
            reach_px=self._most_px,
        )


# The lenses of a camera. Code above this package asks a lens what it does and never which class it has, so that
# another kind of lens answers the same questions and joins this union. Lenses are immutable and hashable.
Lens = ThinLens | RealLens


@dataclass(frozen=True, kw_only=True, eq=False)
class ChiefRays:
    """Map between pixels and directions by the chief rays of one wavelength, with a margin around the frame."""

    lens: RealLens
    wavelength_nm: float
    margin_px: int

    least_z: ClassVar[float] = LEAST_Z
    foreshortens: ClassVar[bool] = True

    @property
    def _centre_px(self) -> F64:
        """Return the pixel position of the axis, float64[2]."""
        return np.array([self.lens.width_px, self.lens.height_px]) / 2 + self.margin_px

    def pixel_of(self, directions: F64) -> F64:
        """Return the pixel positions x, y, float64[..., 2], of directions in C, float64[..., 3]."""
        slopes = directions[..., :2] / directions[..., 2:]
        slope = np.maximum(np.hypot(slopes[..., 0], slopes[..., 1]), 1e-12)
        stretch = self.lens.distorted(slope, self.wavelength_nm) / slope
        return np.asarray(slopes * stretch[..., None] * self.lens.focal_length_px + self._centre_px)

    def directions_at(self, x_px: Floats, y_px: Floats) -> F64:
        """Return the directions in C, float64[y, x, 3], at the positions of a grid."""
        x, y = ((v - c) / self.lens.focal_length_px for v, c in zip((x_px, y_px), self._centre_px, strict=True))
        distance = np.maximum(np.hypot(x[None, :], y[:, None]), 1e-12)
        stretch = self.lens.undistorted(distance, self.wavelength_nm) / distance
        return forward(np.stack([x * stretch, y[:, None] * stretch], axis=-1))

    def solid_angle_sr(self, directions: F64) -> F64:
        """Return the projected solid angle of a pixel, cos⁴θ · t / (h dh/dt) times its area, float64[...]."""
        mapped = self.lens._map(self.wavelength_nm)
        slope = np.maximum(np.hypot(directions[..., 0], directions[..., 1]) / directions[..., 2], 1e-12)
        rise = np.interp(slope, mapped.slope, mapped.rise_mm)
        pixel_mm2 = (self.lens.pixel_pitch_um * 1e-3) ** 2
        return np.asarray(pixel_mm2 * slope / (mapped.height(slope) * rise * (1 + slope**2) ** 2))

    def beam_mm2(self, directions: F64) -> F64:
        """Return the area of the beam that passes all rims, float64[...]; 0 beyond the traced field."""
        mapped = self.lens._map(self.wavelength_nm)
        slope = np.hypot(directions[..., 0], directions[..., 1]) / directions[..., 2]
        return np.asarray(np.interp(slope, mapped.slope, self.lens._beam_mm2(mapped.slope), right=0.0))


@lru_cache(maxsize=64)
def _map(lens: RealLens, wavelength_nm: float) -> FieldMap:
    """Return the map of one wavelength: the model at the d line, shifted by chief rays at the others."""
    main = lens._chief_rays
    if wavelength_nm != D_NM:
        return lens._map(D_NM).shifted(lens._chief_rays_at(wavelength_nm, within=main.end), main)
    slope = np.linspace(0, max(lens._slopes[-1], lens._model.end), _DENSE)
    return field_map(slope, main, lens._model, lens.focal_length_mm)


@lru_cache(maxsize=8)
def _tables(lens: RealLens, wavelength_nm: tuple[float, ...]) -> RadialTables:
    """Return the tables of all bands."""
    distance = table_distances(lens._most_px) / lens.focal_length_px
    stretch, solid = [], []
    for wavelength, passed in zip(wavelength_nm, lens._passed(np.array(wavelength_nm)), strict=True):
        mapped = lens._map(wavelength)
        slope = mapped.slope_at(distance * lens.focal_length_mm)
        stretch.append(slope / distance)
        solid.append(passed * np.interp(slope, mapped.slope, lens._solid_angle_sr(mapped), right=0.0))
    return RadialTables(stretch=np.array(stretch, np.float32), solid_angle_sr=np.array(solid, np.float32))


@lru_cache(maxsize=8)
def _spreads(lens: RealLens, wavelength_nm: tuple[float, ...]) -> PointSpreads:
    """Return the trimmed point spread functions of all tiles and bands."""
    x, columns = tiles(lens.width_px + 2 * REACH_PX)
    y, rows = tiles(lens.height_px + 2 * REACH_PX)
    x, y = x - (lens.width_px / 2 + REACH_PX), y - (lens.height_px / 2 + REACH_PX)
    distance = np.hypot(x[None, :], y[:, None]).ravel() / lens.focal_length_px
    azimuth = np.arctan2(y[:, None], x[None, :]).ravel()
    kernels = [point_spreads(lens, distance, azimuth, wavelength) for wavelength in wavelength_nm]
    return PointSpreads.of(kernels, rows, columns)


def point_spreads(lens: RealLens, distance: F64, azimuth_rad: F64, wavelength_nm: float) -> F32:
    """Return point spread functions at positions of the image, float32[n, y, x], each with sum 1.

    `distance`: image heights in focal lengths; `azimuth_rad`: from +x towards +y. Each centroid is in the middle.
    """
    mapped = lens._map(wavelength_nm)
    slope = mapped.slope_at(distance * lens.focal_length_mm)
    solid = np.interp(slope, mapped.slope, lens._solid_angle_sr(mapped))
    return kernels_of_spots(
        spot_diagrams(lens._round, lens._lit_beams, wavelength_nm, lens.sensor_mm),
        lens._lit_beams.slope,
        slope,
        azimuth_rad,
        f_number=np.sqrt(np.pi / np.maximum(solid, 1e-3 * solid.max())) / 2,
        wavelength_nm=wavelength_nm,
        pixel_pitch_um=lens.pixel_pitch_um,
    )
