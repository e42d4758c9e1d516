"""Trace the bundle of rays that a lens passes at each field angle, from the first vertex to the sensor.

Each bundle is bounded by all rims together. Its area in the plane of the first vertex is the light that the lens
admits; its rays on the sensor are the spot diagram, from which the point spread is made (`point_spread`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .aperture import axial_beam_diameter_mm
from .mapping import fan_heights_mm, inclined_rays, relative_radii
from .paraxial import paraxial_properties
from .prescription import Prescription

F64 = NDArray[np.float64]

_HEIGHTS = 129  # rays of a narrower meridional fan
_RAYS_OF_BEAM = 4  # the axial beam must hold at least this many of them
_AZIMUTHS = 32  # over half a turn of a bundle
_RADII = 33  # samples along a radius that locate a bundle's rim, and
_FINE_RADII = 9  # samples within the interval that holds it
_RINGS = 10  # of a bundle's rays


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldBundles:
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


def field_bundles(lens: Prescription, slope: F64) -> FieldBundles:
    """Return the bundles at the d line; each rim is located between rays that pass and rays that do not."""
    sensor = paraxial_properties(lens).bfd_mm

    def beyond(x: F64, y: F64) -> F64:
        """Return the relative radii of rays through (x, y), whose first axis is the field angle."""
        return relative_radii(lens, slope.reshape(-1, *(1,) * (x.ndim - 1)), x, y, sensor)

    heights = fan_heights_mm(lens, slope)
    outside = beyond(heights, np.zeros(1))
    each = np.arange(len(slope))
    # the beam of a nearly closed stop fits between two rays: trace narrower fans around the ray nearest to passing
    beam_mm = axial_beam_diameter_mm(lens)
    while beam_mm > 0 and (step := float((heights[:, 1] - heights[:, 0]).max())) > beam_mm / _RAYS_OF_BEAM:
        middle = heights[each, np.argmin(outside, axis=1)][:, None]
        heights = middle + 2 * max(step, beam_mm) * np.linspace(-1, 1, _HEIGHTS)
        outside = beyond(heights, np.zeros(1))
    centre = heights[each, np.argmin(outside, axis=1)]
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
            fraction = np.where(np.isfinite(b), (1 - a) / np.maximum(b - a, 1e-12), 0.0)
        return low, high, low + np.clip(fraction, 0, 1) * (high - low)

    nothing = np.zeros((len(slope), _AZIMUTHS))
    low, high, _ = rim(nothing, nothing + reach[:, None], _RADII)
    _, _, rim_mm = rim(low, high, _FINE_RADII)
    rim_mm[~passing.any(axis=1)] = 0
    return FieldBundles(slope=slope, centre_mm=centre, rim_mm=rim_mm)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpotDiagrams:
    """Hold the rays of each bundle at the sensor, half of them; the other half mirrors them in the x axis.

    `position_mm` and `slope`, float64[angle, ray, 2], have x pointing outwards. `weight_mm2` float64[angle, ray] is
    the area that each ray came through.
    """

    position_mm: F64
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


def spot_diagrams(
    lens: Prescription, bundles: FieldBundles, wavelength_nm: float, sensor_mm: float
) -> SpotDiagrams:
    """Trace rays on rings of equal area in each bundle, and return them at the sensor."""
    ring = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    azimuth = bundles.azimuth_rad
    distance = (bundles.rim_mm[:, :, None] * ring).reshape(len(bundles.slope), -1)
    turn = np.repeat(azimuth, _RINGS)
    x, y = bundles.centre_mm[:, None] + distance * np.cos(turn), distance * np.sin(turn)
    path, shape = inclined_rays(lens, bundles.slope[:, None], x, y, wavelength_nm, sensor_mm)
    weight = np.repeat(bundles.rim_mm**2, _RINGS, axis=1)
    lost = ~np.isfinite(path.points_mm[-1, :, 0]).reshape(shape)
    slope = path.directions[:, :2] / path.directions[:, 2:]
    return SpotDiagrams(
        position_mm=np.nan_to_num(path.points_mm[-1, :, :2]).reshape(*shape, 2),
        slope=np.nan_to_num(slope).reshape(*shape, 2),
        weight_mm2=np.where(lost, 0, weight),
    )
