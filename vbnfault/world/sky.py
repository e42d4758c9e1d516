"""Provide a star catalogue to magnitude 7, and compute the radiance that the stars add to an image.

Positions and proper motions refer to ICRF axes (frame J). These effects are neglected:

- stellar aberration, up to 24″ for a camera that moves with 67P at perihelion (34 km/s; 24″ is one pixel of 1024
  across 7°)
- parallax, at most 3″ (α Centauri from 3.6 au)
- variability

Planets, the Moon and nebulae are absent. A double star that Hipparcos lists as one entry is one point with the
light of both.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from ..core import spectra
from ..core.files import file_contents, resources, user_files
from ..core.frames import J2000_JD
from ..core.quantities import Radiance
from ..core.sundisc import Pinhole, Projection
from ..lens.streaks import Streaks, drawn

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BOLTZMANN_J_K = 1.380649e-23  # SI, exact
DAYS_PER_YEAR = 365.25

# Spectral irradiance of a star of V = 0 outside the atmosphere, mean over the V passband: Bessell, Castelli & Plez
# 1998 (A&A 333, 231), table A2, 363.1e-11 erg cm⁻² s⁻¹ Å⁻¹.
ZERO_POINT_V_W_M2_NM = 3.631e-11

# V passband of Bessell 1990 (PASP 102, 1181), table 2: 470 to 700 nm in steps of 10 nm, peak 1. It is used as the
# response to energy. Used as the response per photon, it would change the light of a star by at most 2.5 %.
PASSBAND_V_NM = np.arange(470.0, 701.0, 10.0)
PASSBAND_V = np.array(
    [
        *(0.000, 0.030, 0.163, 0.458, 0.780, 0.967, 1.000, 0.973, 0.898, 0.792, 0.684, 0.574),
        *(0.461, 0.359, 0.270, 0.197, 0.135, 0.081, 0.045, 0.025, 0.017, 0.013, 0.009, 0.000),
    ]
)

# Outside this range Ballesteros' formula becomes steep (its pole is at -0.67) or is not supported by any star.
COLOUR_RANGE_BV = (-0.4, 4.0)

# The point spread is cut at this many σ, where 6e-7 of a star's light is left on either axis.
REACH_SIGMA = 5.0

_SHARP_PX = 0.05  # a smaller blur circle of defocus is ignored, as of the Sun

# Sirius, the brightest star, has V = -1.44. A limiting magnitude below this value shows no star.
BRIGHTEST_V = -1.5

# The star for which `limiting_magnitude` is computed has this colour, nearly that of the Sun, 0.65.
LIMIT_BV = 0.6


@dataclass(frozen=True, kw_only=True, eq=False)
class StarCatalogue:
    """Hold stars, ordered from the brightest to the faintest. Every field is float64[n], ICRF, epoch J2000.0.

    `proper_motion_ra_mas_year` is μα cos δ. `magnitude_V` and `colour_BV` are Johnson magnitudes.
    """

    right_ascension_deg: F64
    declination_deg: F64
    proper_motion_ra_mas_year: F64
    proper_motion_dec_mas_year: F64
    magnitude_V: F64
    colour_BV: F64

    def __len__(self) -> int:
        return len(self.magnitude_V)

    def brighter_than(self, magnitude_V: float) -> StarCatalogue:
        """Return the stars with V below `magnitude_V`."""
        count = int(np.searchsorted(self.magnitude_V, magnitude_V))
        return replace(self, **{name: values[:count] for name, values in vars(self).items()})

    def direction_J(self, julian_date: float = J2000_JD) -> F64:
        """Return unit vectors in J, float64[n, 3], moved along great circles from J2000.0 to a TDB Julian date."""
        ra, dec = np.radians(self.right_ascension_deg), np.radians(self.declination_deg)
        zero = np.zeros_like(ra)
        radial = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
        east = np.stack([-np.sin(ra), np.cos(ra), zero], axis=1)
        north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=1)
        rad_per_mas = np.radians(1 / 3.6e6)
        years = (julian_date - J2000_JD) / DAYS_PER_YEAR
        moved = (
            radial
            + (self.proper_motion_ra_mas_year * rad_per_mas * years)[:, None] * east
            + (self.proper_motion_dec_mas_year * rad_per_mas * years)[:, None] * north
        )
        return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


@file_contents.cached_with_contents(maxsize=1)
def load_catalogue() -> StarCatalogue:
    """Return the packaged catalogue: every star of Hipparcos (ESA 1997) with V ≤ 7.0, about 15 thousand.

    The steps of the table are 1 mas, 1 mas/year, 0.01 mag in V and 0.001 mag in B−V. Raises InputError if the
    installation lacks the file.
    """
    data = user_files.read_input(resources.data_dir("catalogues") / "stars.npz", "star catalogue")
    with np.load(io.BytesIO(data)) as table:
        columns = {name: table[name].astype(np.float64) for name in table.files}
    return StarCatalogue(
        right_ascension_deg=columns["right_ascension_mas"] / 3.6e6,
        declination_deg=columns["declination_mas"] / 3.6e6,
        proper_motion_ra_mas_year=columns["proper_motion_ra_mas_year"],
        proper_motion_dec_mas_year=columns["proper_motion_dec_mas_year"],
        magnitude_V=columns["magnitude_V_hundredths"] / 100,
        colour_BV=columns["colour_BV_thousandths"] / 1000,
    )


def colour_temperature_K(colour_BV: F64 | float) -> F64:
    """Return the temperature of the black body with a colour B−V, float64 in K.

    The formula is eq. 14 of Ballesteros 2012 (EPL 97, 34008). The colour is clipped to `COLOUR_RANGE_BV`.
    """
    colour = 0.92 * np.clip(np.asarray(colour_BV, dtype=np.float64), *COLOUR_RANGE_BV)
    return np.asarray(4600.0 * (1 / (colour + 1.7) + 1 / (colour + 0.62)))


def _planck(wavelength_nm: F64, temperature_K: F64) -> F64:
    """Return the shape of the black body's spectrum per nm, float64[n, wavelength], without a scale."""
    hc_k = spectra.PLANCK_J_S * spectra.LIGHT_SPEED_M_S / BOLTZMANN_J_K
    exponent = hc_k / (wavelength_nm[None] * 1e-9 * temperature_K[:, None])
    return np.asarray((550.0 / wavelength_nm[None]) ** 5 / np.expm1(exponent))


def star_spectrum_W_m2_nm(magnitude_V: F64 | float, colour_BV: F64 | float, wavelength_nm: F64) -> F64:
    """Return the spectral irradiance at the aperture, W m⁻² nm⁻¹, float64[n, wavelength].

    The receiving area is perpendicular to the star's direction. The spectrum is a black body of the colour
    temperature, whose mean over the V passband has the star's magnitude. It is correct in B and V by construction.
    Lines and the Balmer jump are missing, which causes errors up to 20 % for white stars at 400 nm.
    """
    temperature = np.atleast_1d(colour_temperature_K(colour_BV))
    level = ZERO_POINT_V_W_M2_NM * 10 ** (-0.4 * np.atleast_1d(np.asarray(magnitude_V, dtype=np.float64)))
    mean_V = _planck(PASSBAND_V_NM, temperature) @ (PASSBAND_V / PASSBAND_V.sum())
    return np.asarray(_planck(wavelength_nm, temperature) * (level / mean_V)[:, None])


def star_irradiance_W_m2_nm(magnitude_V: F64 | float, colour_BV: F64 | float, wavelength_nm: F64) -> F64:
    """Return `star_spectrum_W_m2_nm` at band nodes, hat-weighted like the solar spectrum, float64[n, band].

    `wavelength_nm` float64[band] are the nodes of `spectra.band_nodes_nm`.
    """
    fine = spectra.fine_nodes_nm(wavelength_nm)
    hats = spectra.hat_weights(wavelength_nm, fine)
    spectrum = star_spectrum_W_m2_nm(magnitude_V, colour_BV, fine)
    rule = np.gradient(fine) * np.where((fine == fine[0]) | (fine == fine[-1]), 0.5, 1.0)  # trapezoidal rule
    return np.asarray(spectrum @ (hats * rule).T / (hats @ rule))


@dataclass(frozen=True, kw_only=True, eq=False)
class StarRadiance:
    """Hold the radiance that the stars add, in the pixels that have any.

    `radiance` float32[band, n] is in W m⁻² sr⁻¹ nm⁻¹. `rows` and `columns` int64[n] are the pixels, each once, row
    by row.
    """

    rows: I64
    columns: I64
    radiance: NDArray[np.float32]

    @classmethod
    def mean(cls, parts: Sequence[StarRadiance], width_px: int) -> StarRadiance:
        """Return the mean of what stars add at several times of an exposure, in a frame of this width."""
        if len(parts) == 1:
            return parts[0]
        pixel = np.concatenate([part.rows * width_px + part.columns for part in parts])
        pixels, index = np.unique(pixel, return_inverse=True)
        bands = np.concatenate([part.radiance for part in parts], axis=1) / len(parts)
        summed = np.stack([np.bincount(index.ravel(), band, len(pixels)) for band in bands])
        return cls(rows=pixels // width_px, columns=pixels % width_px, radiance=summed.astype(np.float32))

    def added_to(self, radiance: Radiance) -> Radiance:
        """Return `radiance` with the stars added."""
        array = radiance.array.copy()
        array[:, self.rows, self.columns] += self.radiance
        return radiance.with_array(array)


# Each round reduces the error by the speed of the stars in px a line, which is far below 1.
_ROLLING_ROUNDS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyFrame:
    """Describe the frame in which stars are drawn.

    Attributes
    ----------
    J_from_C
        Camera axes in J, float64[3, 3].
    intrinsics
        fx, fy, cx, cy in pixels, float64[4], pixel centres at +0.5.
    width_px, height_px
        Size of the frame.
    projection
        Map between directions and pixels; None: the pinhole of the intrinsics.
    turn_per_px
        Of a rolling shutter: by which rotation vector in C the camera has turned over the sky when it exposes the
        next column, and the next row, float64[2, 3]. `J_from_C` are the axes of the middle of the frame.
    """

    J_from_C: F64
    intrinsics: F64
    width_px: int
    height_px: int
    projection: Projection | None = None
    turn_per_px: F64 | None = None

    def positions_px(self, direction_J: F64) -> tuple[F64, F64, I64]:
        """Return the image positions float64[k, 2] and the cosines to the boresight of the directions ahead.

        The cosines are float64[n] of all n directions; int64[k] are the indices of the directions ahead.
        """
        direction = direction_J @ np.asarray(self.J_from_C, dtype=np.float64)
        projection = self.projection or Pinhole(self.intrinsics)
        ahead = np.flatnonzero(direction[:, 2] > (1e-6 if self.projection is None else projection.least_z))
        position = projection.pixel_of(direction[ahead])
        if self.turn_per_px is not None:
            middle = np.array([self.width_px, self.height_px]) / 2
            for _ in range(_ROLLING_ROUNDS):
                # stars far outside of the frame have no line of their own
                lines = np.clip(position - middle, -2 * middle, 2 * middle) @ self.turn_per_px
                position = projection.pixel_of(Rotation.from_rotvec(-lines).apply(direction[ahead]))
        return position, direction[:, 2], ahead


def star_radiance(
    catalogue: StarCatalogue,
    frame: SkyFrame,
    *,
    wavelength_nm: F64,
    sigma_px: float,
    blur_px: float = 0.0,
    julian_date: float = J2000_JD,
    sky: NDArray[np.bool_] | None = None,
    lens_falloff: bool = False,
) -> StarRadiance:
    """Return the radiance that the stars add to each pixel, averaged over the pixel and summed over the stars.

    A star gives the same electrons whether `lens_falloff` is set or not.

    Parameters
    ----------
    catalogue
        The stars.
    frame
        Attitude and geometry of the frame.
    wavelength_nm
        Band nodes, float64[band].
    sigma_px
        Standard deviation of the Gaussian point spread in pixels, at least 0. The Gaussian is integrated over the
        pixels and cut at 5 σ. With 0, a star lights the one pixel that contains it. Nothing else may blur the frame
        by it again.
    blur_px
        Radius of the disc that a lens out of focus makes of a star. The disc is then drawn so much wider that its
        variance holds that of the point spread.
    julian_date
        TDB Julian date, for proper motion.
    sky
        Pixels whose centre sees no body, bool[y, x]. A star is hidden if its position in the frame is not sky. The
        light of other stars spreads over sky and body alike. Default: no star is hidden, so add the result only
        where there is sky.
    lens_falloff
        Whether a lens or a later stage multiplies by cos⁴ θ.
    """
    position, cosines, ahead = frame.positions_px(catalogue.direction_J(julian_date))
    visible = _visible(position, frame, REACH_SIGMA * sigma_px + blur_px, sky)
    position, stars = position[visible], ahead[visible]

    irradiance = star_irradiance_W_m2_nm(catalogue.magnitude_V[stars], catalogue.colour_BV[stars], wavelength_nm)
    total = irradiance * _radiance_px_per_irradiance(frame, cosines[stars], lens_falloff)[:, None]
    if blur_px > _SHARP_PX:
        nothing = np.zeros(len(position))
        discs = Streaks(
            x_px=position[:, 0],
            y_px=position[:, 1],
            dx_px=nothing,
            dy_px=nothing,
            radius_px=nothing + np.hypot(blur_px, 2 * sigma_px),  # a disc has the variance (radius / 2)²
            depth_m=nothing,
        )
        light = drawn(discs, total.T, (frame.height_px, frame.width_px))
        rows, columns = np.nonzero(light.any(axis=0))
        return StarRadiance(rows=rows, columns=columns, radiance=light[:, rows, columns].astype(np.float32))
    pixels, spread = _spread_over_pixels(position, np.array([frame.width_px, frame.height_px]), sigma_px)
    return StarRadiance(
        rows=pixels // frame.width_px,
        columns=pixels % frame.width_px,
        radiance=np.ascontiguousarray((spread @ total).T, dtype=np.float32),
    )


def _visible(position: F64, frame: SkyFrame, reach_px: float, sky: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return which stars at positions float64[n, 2] are within reach of the frame and behind no body, bool[n]."""
    size = np.array([frame.width_px, frame.height_px])
    visible = np.asarray(((position >= -reach_px) & (position < size + reach_px)).all(axis=1))
    if sky is not None:
        column, row = np.clip(np.floor(position[visible]).astype(np.int64), 0, size - 1).T
        outside = ((position[visible] < 0) | (position[visible] >= size)).any(axis=1)
        visible[visible] = outside | sky[row, column]
    return visible


def _radiance_px_per_irradiance(frame: SkyFrame, cosine: F64, lens_falloff: bool) -> F64:
    """Return the sum over pixels of a star's radiance over its irradiance, float64[n] in sr⁻¹.

    A star of irradiance E at the angle θ from the boresight sends the flux T E A cos θ through an aperture of area
    A = π (f/2N)². A pixel of radiance L receives π T L / (4N²) times its own area from `lens.ThinLens`, which has
    no falloff. Equal flux requires that the radiances of a star sum to

        Σ L = E fx fy cos θ          (`lens_falloff` False: the lens adds no factor)
        Σ L = E fx fy / cos³ θ       (`lens_falloff` True: a lens or a later stage multiplies by cos⁴ θ)

    The second sum is E over the solid angle of the pixel.
    """
    fx, fy = (float(v) for v in frame.intrinsics[:2])
    if frame.projection is not None and not frame.projection.foreshortens:  # the pupil of a fisheye turns
        return np.full(len(cosine), fx * fy)
    return np.asarray(fx * fy * (cosine**-3 if lens_falloff else cosine))


def _spread_over_pixels(position: F64, size: I64, sigma_px: float) -> tuple[I64, csr_array]:
    """Return the pixels that stars light, and the fraction of each star's light in each of them.

    Parameters
    ----------
    position
        Image positions (x, y) of the stars in pixels, float64[star, 2].
    size
        Width and height of the frame, int64[2].
    sigma_px
        Standard deviation of the point spread.

    Returns
    -------
    pixels, fraction
        int64[n] flat indices, in order, and a sparse matrix float64[n, star].
    """
    window = max(1, int(np.ceil(REACH_SIGMA * sigma_px)))
    offset = np.arange(-window, window + 1)
    pixel = np.floor(position).astype(np.int64)[:, :, None] + offset  # [star, axis, window]
    edges = np.concatenate([pixel, pixel[:, :, -1:] + 1], axis=2) - position[:, :, None]
    # a point is a very narrow Gaussian: a star exactly on an edge gives half of its light to either side
    fraction = np.diff(ndtr(edges / max(sigma_px, 1e-9)), axis=2)
    fraction = np.where((pixel >= 0) & (pixel < size[:, None]), fraction, 0.0)

    weight = (fraction[:, 1, :, None] * fraction[:, 0, None, :]).ravel()
    index = (pixel[:, 1, :, None] * size[0] + pixel[:, 0, None, :]).ravel()
    star = np.repeat(np.arange(len(position)), len(offset) ** 2)
    lit = weight > 0
    pixels, target = np.unique(index[lit], return_inverse=True)
    return pixels, coo_array((weight[lit], (target, star[lit])), shape=(len(pixels), len(position))).tocsr()


def limiting_magnitude(
    *,
    electron_rate_weights: NDArray[np.floating],
    wavelength_nm: F64,
    irradiance_per_radiance: float,
    focal_length_px: float,
    exposure_s: float,
    sigma_px: float,
    threshold_e: float,
) -> float:
    """Return V of a star whose brightest pixel collects `threshold_e` in its brightest colour.

    The star is on the axis, centred on a pixel, and has the colour `LIMIT_BV`. If the result is below
    `BRIGHTEST_V`, the exposure shows no star. It is -inf if no light is collected.

    Parameters
    ----------
    electron_rate_weights
        Electrons per second for 1 W m⁻² nm⁻¹ on a pixel, float[colour, band], as of `Detector`.
    wavelength_nm
        Band nodes, float64[band].
    irradiance_per_radiance
        π T / (4N²) of the lens, in sr.
    focal_length_px, exposure_s, sigma_px
        As in the camera and in `star_radiance`.
    threshold_e
        Electrons, above 0.
    """
    half = 0.5 / max(sigma_px, 1e-9)
    fraction = float(ndtr(half) - ndtr(-half)) ** 2  # of the light, in the brightest pixel
    irradiance = star_irradiance_W_m2_nm(0.0, LIMIT_BV, wavelength_nm)[0] * focal_length_px**2
    rate = float((np.asarray(electron_rate_weights, dtype=np.float64) @ irradiance).max())
    collected = rate * irradiance_per_radiance * exposure_s * fraction
    return float(2.5 * np.log10(collected / threshold_e)) if collected > 0 else float("-inf")
