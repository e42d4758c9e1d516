"""Image a scene through a prescription with exact rays: distortion, relative illumination, colour, point spread.

The input is a render on the grid of a pinhole camera, with a guard band around the frame. Per band, in this order:

1. resample the radiance to where the lens images it (distortion, lateral colour);
2. multiply by transmission and solid angle, which gives irradiance;
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

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtr

from ..core.errors import InputError
from ..core.quantities import Irradiance, Radiance
from ..core.sundisc import Floats, add_mean, pixel_sums
from .aperture import axial_beam_diameter_mm
from .distortion import RadialModel
from .gaussian import first_order
from .glass import D_NM
from .mapping import ChiefHeights, FieldMap, camera_model, chief_heights, fan_heights_mm, field_map, inclined_rays
from .prescription import Prescription
from .straylight.paraxial import axial_transmittance

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# The point spread reaches this many pixels from its centre; light beyond is distributed within.
REACH_PX = 7
# A point spread with a smaller root-mean-square radius is not applied.
_SHARP_PX = 0.3

_ANGLES = 65  # field angles of the tables
_BEYOND = 1.6  # the tables reach this multiple of the corner's tangent
_HEIGHTS = 129  # rays of a narrower meridional fan
_RAYS_OF_BEAM = 4  # the axial beam must hold at least this many of them
_AZIMUTHS = 32  # over half a turn of a bundle
_RADII = 33  # samples along a radius that locate a bundle's rim, and
_FINE_RADII = 9  # samples within the interval that holds it
_RINGS = 10  # of a bundle's rays
_DENSE = 4097  # nodes of the tables over slope
_STEPS = 65536  # nodes of the tables over squared radius
_COLOUR_PX = 4  # extra guard band, since other colours may come from farther out than the d line
_TILE_PX = 128
_STRIP_PX = 64
_FINE = 5  # cells of a pixel in which rays of a spot are counted
_ROUNDS = 12  # iterations that correct a spot's width
_TRIM = 2e-3  # largest fraction of a point spread in the outermost pixels that are cut off
_AIRY_SIGMA = 0.42  # sigma of the Gaussian closest to an Airy pattern's core, in wavelengths × f-number
_MIDWAY: F32 = np.array([[-1 / 16, 9 / 16, 9 / 16, -1 / 16]], dtype=np.float32)
_INSIDE = (slice(REACH_PX, -REACH_PX), slice(REACH_PX, -REACH_PX))
_DIRECT_TAPS = 121  # with more taps OpenCV uses Fourier transforms, which spread the Sun's rounding errors


# --- rays ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class _Beams:
    """Hold, per field angle, the bundle of rays that passes all rims, in the plane of the first vertex.

    `centre_mm` float64[angle] is a point inside the bundle on the x axis. `rim_mm` float64[angle, azimuth] is the
    distance of the bundle's rim from there, for azimuths within half a turn; the other half is its mirror image.
    """

    slope: F64
    centre_mm: F64
    rim_mm: F64

    @property
    def azimuth_rad(self) -> F64:
        """Return the azimuths of `rim_mm`, float64[azimuth]."""
        return np.asarray((np.arange(_AZIMUTHS) + 0.5) * np.pi / _AZIMUTHS)

    @property
    def area_mm2(self) -> F64:
        """Return the area of each bundle, float64[angle].

        The midpoint rule converges fast over the whole turn of a smooth rim.
        """
        return np.asarray((self.rim_mm**2).sum(axis=1) * np.pi / _AZIMUTHS)


def _beams(lens: Prescription, slope: F64) -> _Beams:
    """Return the bundles at the d line; each rim is located between rays that pass and rays that do not."""
    sensor = first_order(lens).bfd_mm

    def beyond(x: F64, y: F64) -> F64:
        """Return the largest relative radius of rays through (x, y), inf for rays that do not arrive."""
        found, shape = inclined_rays(lens, slope.reshape(-1, *(1,) * (x.ndim - 1)), x, y, D_NM, sensor)
        lost = ~np.isfinite(found.points_mm[-1, :, 0])
        return np.where(lost, np.inf, found.relative_radius).reshape(shape)

    heights = fan_heights_mm(lens, slope)
    outside = beyond(heights, np.zeros(1))
    at = np.arange(len(slope))
    # the beam of a nearly closed stop fits between two rays: trace narrower fans around the ray nearest to passing
    beam_mm = axial_beam_diameter_mm(lens)
    while beam_mm > 0 and (step := float((heights[:, 1] - heights[:, 0]).max())) > beam_mm / _RAYS_OF_BEAM:
        middle = heights[at, np.argmin(outside, axis=1)][:, None]
        heights = middle + 2 * max(step, beam_mm) * np.linspace(-1, 1, _HEIGHTS)
        outside = beyond(heights, np.zeros(1))
    centre = heights[at, np.argmin(outside, axis=1)]
    passing = outside <= 1
    width = passing.sum(axis=1) * (heights[:, 1] - heights[:, 0])
    reach = 1.5 * np.maximum(width, width[0])
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * np.pi / _AZIMUTHS

    def rim(near: F64, far: F64, samples: int) -> tuple[F64, F64, F64]:
        """Return an interval of distances that holds the rim, and the rim by linear interpolation within it."""
        distance = near[..., None] + (far - near)[..., None] * np.linspace(0, 1, samples)
        x = centre[:, None, None] + distance * np.cos(azimuth)[:, None]
        over = beyond(x, distance * np.sin(azimuth)[:, None])
        k = np.maximum(np.argmax(over > 1, axis=2), 1)[..., None]
        (low, high), (a, b) = (
            (np.take_along_axis(v, k - 1, 2)[..., 0], np.take_along_axis(v, k, 2)[..., 0]) for v in (distance, over)
        )
        with np.errstate(invalid="ignore"):
            share = np.where(np.isfinite(b), (1 - a) / np.maximum(b - a, 1e-12), 0.0)
        return low, high, low + np.clip(share, 0, 1) * (high - low)

    nothing = np.zeros((len(slope), _AZIMUTHS))
    low, high, _ = rim(nothing, nothing + reach[:, None], _RADII)
    _, _, found = rim(low, high, _FINE_RADII)
    found[~passing.any(axis=1)] = 0
    return _Beams(slope=slope, centre_mm=centre, rim_mm=found)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Spots:
    """Hold the rays of each bundle at the sensor, half of them; the other half mirrors them in the x axis.

    `place_mm` and `slope`, float64[angle, ray, 2], are positions and slopes with x pointing outwards; `weight_mm2`
    float64[angle, ray] is the area that each ray came through.
    """

    place_mm: F64
    slope: F64
    weight_mm2: F64

    def centred(self, values: F64) -> F64:
        """Return the values without the weighted mean of x; the mean of y is 0 by symmetry."""
        total = np.maximum(self.weight_mm2.sum(axis=1), 1e-300)
        mean = (self.weight_mm2 * values[..., 0]).sum(axis=1) / total
        return np.asarray(values - np.stack([mean, np.zeros_like(mean)], axis=-1)[:, None])

    def mean(self, values: F64) -> F64:
        """Return the weighted mean over the rays, float64[angle]."""
        total = np.maximum(self.weight_mm2.sum(axis=1), 1e-300)
        return np.asarray((self.weight_mm2 * values).sum(axis=1) / total)


def _spots(lens: Prescription, beams: _Beams, wavelength_nm: float, sensor_mm: float) -> _Spots:
    """Trace rays on rings of equal area in each bundle, and return them at the sensor."""
    ring = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    azimuth = beams.azimuth_rad
    distance = (beams.rim_mm[:, :, None] * ring).reshape(len(beams.slope), -1)
    turn = np.repeat(azimuth, _RINGS)
    x, y = beams.centre_mm[:, None] + distance * np.cos(turn), distance * np.sin(turn)
    found, shape = inclined_rays(lens, beams.slope[:, None], x, y, wavelength_nm, sensor_mm)
    weight = np.repeat(beams.rim_mm**2, _RINGS, axis=1)
    lost = ~np.isfinite(found.points_mm[-1, :, 0]).reshape(shape)
    slope = found.directions[:, :2] / found.directions[:, 2:]
    return _Spots(
        place_mm=np.nan_to_num(found.points_mm[-1, :, :2]).reshape(*shape, 2),
        slope=np.nan_to_num(slope).reshape(*shape, 2),
        weight_mm2=np.where(lost, 0, weight),
    )


# --- the lens --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tables:
    """Tabulate, per band, what a pixel needs over its squared distance from the axis, float32[band, step].

    `stretch` is the tangent of the field angle over the image height in focal lengths; `solid_angle_sr` is
    irradiance over radiance.
    """

    stretch: F32
    solid_angle_sr: F32


@dataclass(frozen=True, kw_only=True)
class RealLens:
    """Image through a prescription at its final scale, with a sensor behind it.

    It has the interface `Lens`.

    Attributes
    ----------
    focus
        "paraxial": the sensor stands at the paraxial focus of a far object. "best": it stands where the mean square
        radius of the spots over the frame is smallest. Both hold for the d line.
    focus_distance_m
        Object distance by which the renderer defocuses the scene.
    """

    prescription: Prescription
    width_px: int
    height_px: int
    pixel_pitch_um: float
    focus: str = "paraxial"
    focus_distance_m: float = float("inf")

    resamples: ClassVar[bool] = True
    blurs: ClassVar[bool] = True
    falls_off: ClassVar[bool] = True

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
        paraxial = first_order(self._round).bfd_mm
        return paraxial if self.focus == "paraxial" else paraxial + self._best_shift_mm

    @cached_property
    def focal_length_mm(self) -> float:
        """Return image height over the tangent of the field angle near the axis, at the d line.

        It is the EFL where the sensor stands at the paraxial focus.
        """
        efl = first_order(self._round).efl_mm
        return efl if self.focus == "paraxial" else float(self._chief_rays.rise_mm(np.zeros(1))[0])

    @cached_property
    def f_number(self) -> float:
        """Return the EFL divided by the diameter of a disc that has the area of the axial beam."""
        area = float(self._beams.area_mm2[0])
        return float(first_order(self._round).efl_mm / (2 * np.sqrt(area / np.pi)))

    @property
    def figures(self) -> dict[str, str | float]:
        """Return the lens's properties after scaling and stopping down, and a sentence `summary` for people.

        The properties are name, scale relative to the prescription's file, EFL, f-number of the real beam, diameter
        of the stop, and transmission on the axis at the d line.
        """
        lens = self.prescription
        efl_mm = first_order(lens).efl_mm
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
        """Return the fraction of the axial light that coatings and glass transmit, float64[band]."""
        return axial_transmittance(self.prescription, wavelength_nm)

    def pupil_area_mm2(self, slope: ArrayLike) -> F64:
        """Return the area of the beam that passes all rims, in the plane of the first vertex.

        `slope`: tangents of field angles; the result is float64 of the same shape. Beyond the traced field it stays
        constant.
        """
        return np.asarray(np.interp(np.asarray(slope, dtype=np.float64), self._beams.slope, self._beams.area_mm2))

    def axial_solid_angle_sr(self, wavelength_nm: F64) -> F64:
        """Return irradiance over radiance on the axis, T A / f², float64[band].

        It is π T / (4 N²) at the paraxial focus.
        """
        return np.asarray(
            [
                share * self._beams.area_mm2[0] / self._map(wavelength).rise_mm[0] ** 2
                for share, wavelength in zip(self.transmittance(wavelength_nm), wavelength_nm.tolist(), strict=True)
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
        at = np.interp(mapped.slope_at(distance * self.focal_length_mm), mapped.slope, solid, right=0.0)
        return np.asarray(at / solid[0])

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
        mapped = self._map(D_NM)
        farthest = self._slopes[-1]
        if self._beams.area_mm2[-1] > 0 and mapped.height(farthest) < self._corner * self.focal_length_mm:
            angle = np.degrees(np.arctan(farthest))
            raise InputError(
                f"{self.name}: camera.fov_deg: barrel distortion brings light from beyond {angle:.0f} degrees into "
                "the corners, which the render has not; it must be smaller"
            )
        half = np.array([self.width_px, self.height_px]) / 2
        share, whole = np.linspace(0, 1, 129), np.ones(129)
        border = np.concatenate([np.column_stack([share, whole]), np.column_stack([whole, share])])
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
        half = np.hypot(self.width_px / 2 + REACH_PX, self.height_px / 2 + REACH_PX)
        return float(half * self.pixel_pitch_um * 1e-3 / first_order(self._round).efl_mm)

    @cached_property
    def _slopes(self) -> F64:
        """Return the tangents of the tables' field angles, float64[angle]; the first is nearly 0."""
        slope = np.tan(np.linspace(0, np.arctan(_BEYOND * self._corner), _ANGLES))
        slope[0] = 1e-3 * slope[1]
        return slope

    @cached_property
    def _beams(self) -> _Beams:
        """Return the bundles at the field angles of the tables."""
        return _beams(self._round, self._slopes)

    @cached_property
    def _zones(self) -> _Beams:
        """Return the bundles for point spreads: those with light, from the axis to the corner."""
        beams = self._beams
        lit = (beams.area_mm2 > 0) & (beams.slope <= 1.1 * self._corner)
        return _Beams(slope=beams.slope[lit], centre_mm=beams.centre_mm[lit], rim_mm=beams.rim_mm[lit])

    @cached_property
    def _best_shift_mm(self) -> float:
        """Return the distance from the paraxial focus to the smallest mean square radius of all spots.

        Each spot counts with the light that its zone of the frame receives.
        """
        beams, lens = self._zones, self._round
        order = first_order(lens)
        spots = _spots(lens, beams, D_NM, order.bfd_mm)
        place, slope = spots.centred(spots.place_mm), spots.centred(spots.slope)
        # count the pixels of the frame nearest to each zone's undistorted position
        x, y = (np.abs(np.arange(n) + 0.5 - n / 2) for n in (self.width_px, self.height_px))
        radius = np.hypot(x[None, ::8], y[::8, None]).ravel() * self.pixel_pitch_um * 1e-3 / order.efl_mm
        edges = (beams.slope[1:] + beams.slope[:-1]) / 2
        lit = radius[radius <= beams.slope[-1]]
        pixels = np.bincount(np.searchsorted(edges, lit), minlength=len(beams.slope))
        light = pixels * beams.area_mm2 / (1 + beams.slope**2) ** 2
        together, alone = (spots.mean((v * slope).sum(axis=-1)) for v in (place, slope))
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
            efl_mm=first_order(lens).efl_mm,
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
        return Irradiance(array=radiance.array * factor[:, None, None], wavelength_nm=radiance.wavelength_nm)

    def image(self, radiance: Radiance) -> Irradiance:
        """Return the irradiance on the sensor, float32[band, y, x], of a render with its guard band."""
        self._check(radiance)
        bands = _key(radiance.wavelength_nm)
        tables, spreads = _tables(self, bands), _spreads(self, bands)
        array = np.empty((len(radiance.array), self.height_px, self.width_px), dtype=np.float32)

        def one(band: int) -> None:
            light = self._resampled(radiance.array[band], tables.stretch[band], tables.solid_angle_sr[band])
            array[band] = spreads.applied(light, band)[_INSIDE]

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(one, range(len(array))))
        return Irradiance(array=array, wavelength_nm=radiance.wavelength_nm)

    def image_of_sun(self, radiance: Radiance, pixel_pitch_um: float) -> Irradiance:
        """Return the irradiance of the Sun's direct image, whose power is E☉ T A(θ) cos θ.

        A(θ) lies in a plane across the axis; the projected solid angle of a pixel contains the cos θ. Where the
        disc is known it is imaged itself: resampling the pixels of a render would not conserve the power of a disc
        that is hardly larger than a pixel. `pixel_pitch_um` belongs to the interface: the lens knows its pixels.
        """
        if radiance.disc is None:
            return self.image(radiance)
        bands, disc = _key(radiance.wavelength_nm), radiance.disc
        spreads = _spreads(self, bands)
        passes = self.transmittance(radiance.wavelength_nm)
        array = np.zeros((len(bands), self.height_px, self.width_px), dtype=np.float32)
        shape = self.height_px + 2 * REACH_PX, self.width_px + 2 * REACH_PX
        pixel_mm2 = (self.pixel_pitch_um * 1e-3) ** 2

        def one(band: int) -> None:
            rays = self.chief_rays(bands[band], REACH_PX)
            found = pixel_sums(disc, rays, shape, disc.profiles([band]), rays.beam_mm2)
            if found is not None:
                light = found.on(shape)[0] * (disc.radiance_W_m2_sr_nm[band] * passes[band] / pixel_mm2)
                array[band] = spreads.applied(light.astype(np.float32), band)[_INSIDE]

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(one, range(len(array))))
        return Irradiance(array=array, wavelength_nm=radiance.wavelength_nm)

    def on_frame(self, radiance: Radiance) -> Radiance:
        """Return a render, without its guard band, on the grid of the image.

        Only distortion and lateral colour act: no light is lost and nothing is blurred.
        """
        self._check(radiance)
        bands, disc = _key(radiance.wavelength_nm), radiance.disc
        tables = _tables(self, bands)
        source = radiance.array
        if disc is not None and radiance.sun is not None:
            source = np.maximum(source - radiance.sun, 0)

        def one(band: int) -> F32:
            out = self._resampled(source[band], tables.stretch[band], None)[_INSIDE]
            if disc is not None:
                add_mean(out[None], disc, self.chief_rays(bands[band]), [band])
            return out

        with ThreadPoolExecutor(2) as pool:
            array = np.stack(list(pool.map(one, range(len(radiance.array)))))
        return replace(radiance, array=array, sun=None, disc=None)

    def _check(self, radiance: Radiance) -> None:
        """Raise ValueError unless the radiance has the pixels of the frame and the guard band."""
        gx, gy = self.guard_px
        wanted = self.height_px + 2 * gy, self.width_px + 2 * gx
        if radiance.array.shape[1:] != wanted:
            raise ValueError(f"radiance of {radiance.array.shape[1:]} pixels: with its guard band it has {wanted}")

    @cached_property
    def _steps(self) -> NDArray[np.uint16]:
        """Return the step of `_Tables` for each pixel of the image and of its border for the point spread."""
        x, y = (np.arange(n + 2 * REACH_PX) + 0.5 - (n / 2 + REACH_PX) for n in (self.width_px, self.height_px))
        square = x[None, :] ** 2 + y[:, None] ** 2
        return np.asarray(np.rint(square * ((_STEPS - 1) / self._most_px**2)), dtype=np.uint16)

    @property
    def _most_px(self) -> float:
        """Return the distance of the corner from the axis in pixels, with the reach of the point spread."""
        return float(np.hypot(self.width_px / 2 + REACH_PX, self.height_px / 2 + REACH_PX))

    def _resampled(self, band: F32, stretch: F32, solid_angle_sr: F32 | None) -> F32:
        """Resample a band of a render to the pixels of the image and of its border for the point spread.

        Work goes strip by strip so that intermediate arrays stay in the processor's cache.
        """
        gx, gy = self.guard_px
        height, width = self._steps.shape
        out = np.empty((height, width), dtype=np.float32)
        # coordinates on the grid of half the pitch, where linear interpolation blurs little
        x = 2 * np.arange(width, dtype=np.float32) + np.float32(1 - width)
        y = 2 * np.arange(height, dtype=np.float32) + np.float32(1 - height)
        for start in range(0, height, _STRIP_PX):
            rows = slice(start, start + _STRIP_PX)
            steps = self._steps[rows]
            row = np.take(stretch, steps, mode="clip")
            column = row * x
            column += np.float32(self.width_px + 2 * gx - 1)
            row *= y[rows, None]
            row += np.float32(self.height_px + 2 * gy - 1)
            top = int(np.clip(row.min() // 2 - 1, 0, len(band) - 2))
            bottom = int(np.clip(row.max() // 2 + 3, top + 2, len(band)))
            row -= np.float32(2 * top)
            if not band[top:bottom].any():  # most strips of the Sun's image are dark
                out[rows] = 0
                continue
            source = finer(band[top:bottom])
            light = cv2.remap(source, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            if solid_angle_sr is not None:
                light *= np.take(solid_angle_sr, steps, mode="clip")
            out[rows] = light
        return out


@dataclass(frozen=True, kw_only=True, eq=False)
class ChiefRays:
    """Map between pixels and directions by the chief rays of one wavelength, with a margin around the frame."""

    lens: RealLens
    wavelength_nm: float
    margin_px: int

    @property
    def _centre_px(self) -> F64:
        """Return the pixel position of the axis, float64[2]."""
        return np.array([self.lens.width_px, self.lens.height_px]) / 2 + self.margin_px

    def pixel_of(self, slopes: F64) -> F64:
        """Return the pixel positions x, y, float64[..., 2], of tangents x/z and y/z in C."""
        slope = np.maximum(np.hypot(slopes[..., 0], slopes[..., 1]), 1e-12)
        stretch = self.lens.distorted(slope, self.wavelength_nm) / slope
        return np.asarray(slopes * stretch[..., None] * self.lens.focal_length_px + self._centre_px)

    def slopes_at(self, x_px: Floats, y_px: Floats) -> F64:
        """Return the tangents x/z and y/z in C, float64[y, x, 2], at the positions of a grid."""
        x, y = ((v - c) / self.lens.focal_length_px for v, c in zip((x_px, y_px), self._centre_px, strict=True))
        distance = np.maximum(np.hypot(x[None, :], y[:, None]), 1e-12)
        stretch = self.lens.undistorted(distance, self.wavelength_nm) / distance
        return np.stack([x * stretch, y[:, None] * stretch], axis=-1)

    def solid_angle_sr(self, slopes: F64) -> F64:
        """Return the projected solid angle of a pixel, cos⁴θ · t / (h dh/dt) times its area, float64[...]."""
        mapped = self.lens._map(self.wavelength_nm)
        slope = np.maximum(np.hypot(slopes[..., 0], slopes[..., 1]), 1e-12)
        rise = np.interp(slope, mapped.slope, mapped.rise_mm)
        pixel_mm2 = (self.lens.pixel_pitch_um * 1e-3) ** 2
        return np.asarray(pixel_mm2 * slope / (mapped.height(slope) * rise * (1 + slope**2) ** 2))

    def beam_mm2(self, slopes: F64) -> F64:
        """Return the area of the beam that passes all rims, float64[...]; 0 beyond the traced field."""
        mapped = self.lens._map(self.wavelength_nm)
        slope = np.hypot(slopes[..., 0], slopes[..., 1])
        return np.asarray(np.interp(slope, mapped.slope, self.lens._beam_mm2(mapped.slope), right=0.0))


def _key(wavelength_nm: F64) -> tuple[float, ...]:
    """Return the wavelengths in the hashable form that caches need."""
    return tuple(float(w) for w in wavelength_nm)


@lru_cache(maxsize=64)
def _map(lens: RealLens, wavelength_nm: float) -> FieldMap:
    """Return the map of one wavelength: the model at the d line, shifted by chief rays at the others."""
    main = lens._chief_rays
    if wavelength_nm != D_NM:
        return lens._map(D_NM).shifted(lens._chief_rays_at(wavelength_nm, within=main.end), main)
    slope = np.linspace(0, max(lens._slopes[-1], lens._model.end), _DENSE)
    return field_map(slope, main, lens._model, lens.focal_length_mm)


@lru_cache(maxsize=8)
def _tables(lens: RealLens, wavelength_nm: tuple[float, ...]) -> _Tables:
    """Return the tables of all bands."""
    # the first step lies on the axis: avoid a division by 0
    square = np.maximum(np.arange(_STEPS), 1e-3) / (_STEPS - 1)
    distance = np.sqrt(square) * lens._most_px / lens.focal_length_px
    stretch, solid = [], []
    for wavelength, share in zip(wavelength_nm, lens.transmittance(np.array(wavelength_nm)), strict=True):
        mapped = lens._map(wavelength)
        slope = mapped.slope_at(distance * lens.focal_length_mm)
        stretch.append(slope / distance)
        solid.append(share * np.interp(slope, mapped.slope, lens._solid_angle_sr(mapped), right=0.0))
    return _Tables(stretch=np.array(stretch, np.float32), solid_angle_sr=np.array(solid, np.float32))


def finer(band: F32) -> F32:
    """Return a band on a grid of half the pitch, float32[2 y - 1, 2 x - 1].

    The given pixels stay. Values between them are cubic (Keys 1981, IEEE ASSP 29, 1153), but limited to the range
    of the two neighbours, so that no ripples appear around the Sun.
    """
    height, width = band.shape
    out = np.empty((2 * height - 1, 2 * width - 1), dtype=np.float32)
    out[::2, ::2] = band
    out[::2, 1::2] = _between(band, _MIDWAY)
    out[1::2] = _between(np.ascontiguousarray(out[::2]), _MIDWAY.T)
    return out


def _between(band: F32, kernel: F32) -> F32:
    """Return the midpoints between neighbours along the axis of a four-tap kernel."""
    height, width = band.shape
    across = kernel.shape[0] == 1
    one, other = (band[:, :-1], band[:, 1:]) if across else (band[:-1], band[1:])
    middle = cv2.filter2D(
        band, cv2.CV_32F, kernel, anchor=(1, 0) if across else (0, 1), borderType=cv2.BORDER_REPLICATE
    )[: height - (not across), : width - across]
    return np.asarray(cv2.min(cv2.max(middle, cv2.min(one, other)), cv2.max(one, other)))


# --- point spread ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class _Spreads:
    """Hold the point spread functions of overlapping tiles of the image; neighbouring tiles blend linearly.

    `kernels[band][row][column]` is float32[n, n] with sum 1, or None where light stays in its pixel. `rows` and
    `columns` give start, stop and weights of each tile.
    """

    kernels: tuple[tuple[tuple[F32 | None, ...], ...], ...]
    rows: tuple[tuple[int, int, F32], ...]
    columns: tuple[tuple[int, int, F32], ...]

    def applied(self, light: F32, band: int) -> F32:
        """Return a band's light, float32[y, x], after each pixel's light is spread by the kernels of its tiles."""
        kernels = self.kernels[band]
        if all(kernel is None for row in kernels for kernel in row):
            return light
        r = REACH_PX
        out = np.zeros((light.shape[0] + 2 * r, light.shape[1] + 2 * r), dtype=np.float32)
        for (top, bottom, down), of_row in zip(self.rows, kernels, strict=True):
            for (left, right, across), kernel in zip(self.columns, of_row, strict=True):
                part = light[top:bottom, left:right]
                if not part.any():
                    continue
                part = part * (down[:, None] * across)
                reach = 0
                if kernel is not None:
                    part, reach = spread(part, kernel), len(kernel) // 2
                window = out[top + r - reach : bottom + r + reach, left + r - reach : right + r + reach]
                cv2.add(window, part, window)
        return out[r:-r, r:-r]


def spread(light: F32, kernel: F32) -> F32:
    """Return the full convolution of light with a square kernel of odd size n, float32[y + n - 1, x + n - 1]."""
    n, half = len(kernel), len(kernel) // 2
    taps = np.ascontiguousarray(kernel[::-1, ::-1])
    rows = n if n * n <= _DIRECT_TAPS else half + 1
    wide = cv2.copyMakeBorder(light, half, half + n - rows, half, half, cv2.BORDER_CONSTANT, value=0)
    out = cv2.filter2D(wide, cv2.CV_32F, taps[:rows], anchor=(half, half), borderType=cv2.BORDER_CONSTANT)
    if rows < n:  # the rows of taps below the middle
        below = cv2.filter2D(wide, cv2.CV_32F, taps[rows:], anchor=(half, 0), borderType=cv2.BORDER_CONSTANT)
        out[:-1] += below[1:]
        out = out[: half - n + 1 or None]
    return np.asarray(out)


def _tiles(size: int) -> tuple[F64, tuple[tuple[int, int, F32], ...]]:
    """Return the centres of the tiles along an axis, and start, stop and weights of each; all weights sum to 1."""
    count = max(1, round(size / _TILE_PX))
    edges = np.linspace(0, size, count + 1)
    ramp = size / count / 16
    found = []
    for k in range(count):
        low, high = (edges[k] - ramp if k else 0), (edges[k + 1] + ramp if k < count - 1 else size)
        start, stop = max(int(np.floor(low)), 0), min(int(np.ceil(high)), size)
        at = np.arange(start, stop) + 0.5
        weight = np.ones(len(at))
        if k:
            weight *= np.clip((at - low) / (2 * ramp), 0, 1)
        if k < count - 1:
            weight *= np.clip((high - at) / (2 * ramp), 0, 1)
        found.append((start, stop, weight.astype(np.float32)))
    return (edges[:-1] + edges[1:]) / 2, tuple(found)


@lru_cache(maxsize=8)
def _spreads(lens: RealLens, wavelength_nm: tuple[float, ...]) -> _Spreads:
    """Return the trimmed point spread functions of all tiles and bands."""
    centre_x, columns = _tiles(lens.width_px + 2 * REACH_PX)
    centre_y, rows = _tiles(lens.height_px + 2 * REACH_PX)
    x, y = centre_x - (lens.width_px / 2 + REACH_PX), centre_y - (lens.height_px / 2 + REACH_PX)
    distance = np.hypot(x[None, :], y[:, None]).ravel() / lens.focal_length_px
    azimuth = np.arctan2(y[:, None], x[None, :]).ravel()
    kernels = []
    for wavelength in wavelength_nm:
        stack = point_spreads(lens, distance, azimuth, wavelength)
        trimmed = [_trimmed(kernel) for kernel in stack]
        kernels.append(tuple(tuple(trimmed[k * len(x) : (k + 1) * len(x)]) for k in range(len(y))))
    return _Spreads(kernels=tuple(kernels), rows=rows, columns=columns)


def point_spreads(lens: RealLens, distance: F64, azimuth_rad: F64, wavelength_nm: float) -> F32:
    """Return point spread functions at positions of the image, float32[n, y, x], each with sum 1.

    `distance`: image heights in focal lengths; `azimuth_rad`: from +x towards +y. Each centroid is in the middle.
    """
    beams = lens._zones
    spots = _spots(lens._round, beams, wavelength_nm, lens.sensor_mm)
    place = spots.centred(spots.place_mm) * 1e3 / lens.pixel_pitch_um
    mapped = lens._map(wavelength_nm)
    slope = mapped.slope_at(distance * lens.focal_length_mm)
    # interpolate each ray of the bundle between the two nearest field angles
    k = np.clip(np.searchsorted(beams.slope, slope) - 1, 0, len(beams.slope) - 2)
    share = np.clip((slope - beams.slope[k]) / (beams.slope[k + 1] - beams.slope[k]), 0, 1)[:, None]
    place = place[k] * (1 - share[..., None]) + place[k + 1] * share[..., None]
    weight = spots.weight_mm2[k] * (1 - share) + spots.weight_mm2[k + 1] * share
    x, y = place[..., 0], place[..., 1]
    for _ in range(3):
        near = x * x + y * y <= REACH_PX**2
        weight = np.where(near | ~np.any(near & (weight > 0), axis=1, keepdims=True), weight, 0)
        x = x - ((weight * x).sum(axis=1) / weight.sum(axis=1))[:, None]
    x, y, weight = np.hstack([x, x]), np.hstack([y, -y]), np.hstack([weight, weight])
    solid = np.interp(slope, mapped.slope, lens._solid_angle_sr(mapped))
    f_number = np.sqrt(np.pi / np.maximum(solid, 1e-3 * solid.max())) / 2
    sigma = _AIRY_SIGMA * wavelength_nm * 1e-3 * f_number / lens.pixel_pitch_um
    return _rasterised(x, y, weight / weight.sum(axis=1)[:, None], azimuth_rad, sigma)


def _rasterised(x: F64, y: F64, weight: F64, azimuth_rad: F64, sigma: F64) -> F32:
    """Return the kernels of spots, given as rays, float64[n, ray] in pixels along and across the radius.

    Each spot is turned by its azimuth and blurred by a Gaussian of `sigma` pixels. A render's pixel is already a
    mean over its area. Distributing a ray over neighbouring pixels would add once more to the mean squares along
    both axes; the spot is shrunk beforehand by this amount, so that a kernel has the centroid and width of its
    spot.
    """
    cos, sin = np.cos(azimuth_rad)[:, None], np.sin(azimuth_rad)[:, None]
    squares = [np.maximum((weight * v * v).sum(axis=1), 1e-12) for v in (x, y)]
    scale = [np.ones(len(x)), np.ones(len(x))]
    for _ in range(_ROUNDS):
        turned = _turned(x * scale[0][:, None], y * scale[1][:, None], cos, sin)
        parts = [np.abs(v) % 1 for v in turned]
        added = [(weight * part * (1 - part)).sum(axis=1) for part in parts]
        share = cos[:, 0] ** 2
        more = share * added[0] + (1 - share) * added[1], share * added[1] + (1 - share) * added[0]
        scale = [
            (old + np.sqrt(np.maximum(1 - extra / square, 0))) / 2
            for old, extra, square in zip(scale, more, squares, strict=True)
        ]
    wanted = squares[0] + squares[1] + 2 * sigma**2
    x, y = _turned(x * scale[0][:, None], y * scale[1][:, None], cos, sin)
    n, side = len(x), 2 * REACH_PX + 1
    cells = side * _FINE
    total = np.zeros(n * cells * cells)
    u, v = ((p + side / 2) * _FINE - 0.5 for p in (x, y))
    column, row = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    for dy in (0, 1):
        for dx in (0, 1):
            share = weight * np.abs(1 - dx - (u - column)) * np.abs(1 - dy - (v - row))
            at = (np.arange(n)[:, None] * cells + np.clip(row + dy, 0, cells - 1)) * cells
            at += np.clip(column + dx, 0, cells - 1)
            total += np.bincount(at.ravel(), share.ravel(), minlength=len(total))
    edge = np.arange(cells + 1) / _FINE - side / 2
    middle = (edge[1:] + edge[:-1]) / 2
    pixel = np.arange(side) - REACH_PX
    linear = np.maximum(1 - np.abs(middle[None, :] - pixel[:, None]), 0)
    s = np.maximum(sigma, 1e-3)[:, None, None]
    gauss = np.diff(ndtr((edge[None, :, None] - middle[None, None, :]) / s), axis=1)
    gather = np.einsum("ki,nij->nkj", linear, gauss)
    along = np.einsum("nyi,nij->nyj", gather, total.reshape(n, cells, cells))
    kernels = np.einsum("nyj,nxj->nyx", along, gather)
    kernels /= np.maximum(kernels.sum(axis=(1, 2), keepdims=True), 1e-300)
    # the middle pixel takes light until the remaining excess of width is gone
    square = (kernels * (pixel[None, :] ** 2 + pixel[:, None] ** 2)).sum(axis=(1, 2))
    kernels *= np.minimum(wanted / np.maximum(square, 1e-300), 1)[:, None, None]
    kernels[:, REACH_PX, REACH_PX] += 1 - kernels.sum(axis=(1, 2))
    return np.asarray(kernels, dtype=np.float32)


def _turned(x: F64, y: F64, cos: F64, sin: F64) -> tuple[F64, F64]:
    """Return points turned about the origin."""
    return x * cos - y * sin, x * sin + y * cos


def _trimmed(kernel: F32) -> F32 | None:
    """Return the kernel without its nearly empty border, its sum still 1; None where it hardly blurs."""
    half = len(kernel) // 2
    at = np.arange(-half, half + 1)
    square = float((kernel * (at[None, :] ** 2 + at[:, None] ** 2)).sum())
    if np.sqrt(square) < _SHARP_PX:
        return None
    for reach in range(1, half + 1):
        inner = kernel[half - reach : half + reach + 1, half - reach : half + reach + 1]
        if inner.sum() >= 1 - _TRIM:
            break
    return np.ascontiguousarray(inner / inner.sum(dtype=np.float64), dtype=np.float32)
