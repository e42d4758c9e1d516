"""Define the tables of a scene file that describe the body and its ground: `[body]` and `[patch]`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..body.spec import Fractured, Regolith
from ..core import spectra
from ..core.tables import Table, check_spectrum
from ..reflectance import AnyReflectance
from ..reflectance.disc import Lambert
from .bodies import named_body, packaged_bodies

# The most rows of a spectrum or of Hapke's parameters.
_MOST_ROWS = 10_000
# Relief that is higher than this fraction of the shortest semi-axis would fold the surface over itself.
_MOST_RELIEF = 0.1
Wavelength = Annotated[float, Field(gt=0, le=1e5)]
# Pits of comets lie on cells of four sizes alone, which are then full.
_MOST_PITS = 600
SemiAxis = Annotated[float, Field(gt=0, le=1e9)]


class SpectrumTable(Table):
    """Give values at wavelengths. They are interpolated linearly and are constant beyond the ends."""

    wavelength_nm: tuple[Wavelength, ...] = Field(
        min_length=1, max_length=_MOST_ROWS, description="increasing wavelengths"
    )
    value: tuple[Annotated[float, Field(ge=0, le=1)], ...] = Field(
        min_length=1, max_length=_MOST_ROWS, description="value at each wavelength"
    )

    @model_validator(mode="after")
    def _paired(self) -> SpectrumTable:
        check_spectrum(self.wavelength_nm, self.value)
        return self


# Value of body.albedo_map.file that names no file: a procedural Earth.
EARTH = "earth"


class AlbedoMapTable(Table):
    """Give a map whose values multiply the albedo of the body: an image of the whole body in a stated projection.

    Columns are longitudes, which increase to the east (right); rows are planetocentric latitudes from 90° north
    (top) to 90° south, or their sines. Both are those of the body-fixed frame T: longitude 0 on +x, the north pole
    on +z.
    """

    file: str = Field(
        min_length=1,
        description="PNG or TIFF file, grey or RGB, 8, 16 or 32 bits, twice as wide as high if it is "
        "equirectangular; or 'earth': a "
        "procedural Earth with oceans, continents, ice and clouds, sharp at any distance, whose mean albedo is "
        "that of [body]",
    )
    projection: Literal["equirectangular", "cylindrical_equal_area"] = Field(
        "equirectangular",
        description="of the image: rows at equal steps of the latitude (simple cylindrical, plate carrée), or of "
        "its sine (Lambert's cylindrical equal-area projection, of any height)",
    )
    left_longitude_deg: float = Field(
        -180.0, ge=-360, le=360, description="east longitude of the left edge; 0 for a map from 0 to 360°"
    )
    encoding: Literal["linear", "srgb"] = Field(
        "linear", description="of the values: proportional to the albedo, or sRGB as in pictures"
    )
    neutral: Literal["mean"] | Annotated[float, Field(gt=0, le=1e6)] = Field(
        "mean",
        description="value of the map, after decoding, at which the albedo is that of [body]; whole numbers count "
        "as fractions of the largest one. 'mean': the mean over the body",
    )

    @model_validator(mode="after")
    def _one_earth(self) -> AlbedoMapTable:
        given = (self.projection, self.left_longitude_deg, self.encoding, self.neutral)
        if self.file == EARTH and given != ("equirectangular", -180, "linear", "mean"):
            raise ValueError(
                "file = 'earth': takes no left_longitude_deg, projection, encoding or neutral, which are for "
                "files; leave them out"
            )
        return self


class AtmosphereTable(Table):
    """Put air above an 'ellipsoid': single scattering after Rayleigh, with the density exp(-h / H) at height h.

    The optical depth goes with the wavelength as that of air (Hansen & Travis 1974).
    """

    optical_depth: float = Field(
        0.0973, gt=0, le=1, description="of the whole atmosphere at 550 nm, straight up; default: Earth's"
    )
    scale_height_m: float = Field(
        8430.0, gt=0, le=1e6, description="H; default: of air at 288 K, as in the US Standard Atmosphere 1976"
    )


class BodyTable(Table):
    """Describe the target body in its body-fixed frame T."""

    name: str = Field(
        "67P/Churyumov-Gerasimenko",
        description="name of the body. The short name of a packaged one (`vbnfault list bodies`), such as 'Bennu' "
        "or '67P', gives the values of its table to all keys of [body], [orbit] and [spice] that are left out",
    )
    shape: str = Field(
        "embedded",
        min_length=1,
        description="'embedded', 'ellipsoid', or a shape file: OBJ, PLY, STL, GLB, PDS TAB, ICQ, WRL, BDS",
    )
    unit: Literal["auto", "m", "km"] = Field("auto", description="of the shape file; auto: from its size")
    sharpen: Literal["auto"] | Annotated[float, Field(ge=0, le=4)] = Field(
        0.0,
        description="restores the relief that a smoothed shape file has lost near its facets: the gain of its "
        "shortest wavelengths; 'auto': as far as its roughness at longer ones asks for, and other shapes as they "
        "are; 0: the file as it is",
    )
    volume_km3: float | None = Field(
        None,
        ge=1e-12,
        le=1e13,
        description="the shape is scaled about its origin to this volume; default: as it is",
    )
    semi_axes_m: tuple[SemiAxis, SemiAxis, SemiAxis] = Field(
        (1000.0, 1000.0, 1000.0), description="of an 'ellipsoid'"
    )
    relief_m: float = Field(
        0.0, ge=0, le=1e8, description="root mean square height of random relief on an 'ellipsoid'; 0: smooth"
    )
    density_kg_m3: float = Field(537.8, gt=0, le=30_000, description="of the homogeneous body, for its gravity")
    rotation_period_h: float = Field(
        24 * 360 / 696.543884683, gt=0.01, le=1e5, description="67P before perihelion 2015: 12.4041 h"
    )
    pole_ra_deg: float = Field(69.54, ge=0, le=360, description="right ascension of the north pole, ICRF")
    pole_dec_deg: float = Field(64.11, ge=-90, le=90, description="declination of the north pole, ICRF")
    prime_meridian_deg: float = Field(114.69, ge=-360, le=360, description="W at J2000.0")
    prime_meridian_deg_day2: float = Field(
        0.0, ge=-0.01, le=0.01, description="coefficient of d² in W, d in days from J2000.0: half the acceleration"
    )
    reflectance: str | Annotated[float, Field(ge=0, le=1)] | SpectrumTable = Field(
        "67p", description="a named reflectance, a grey value, or a table of values at wavelengths"
    )
    photometry: AnyReflectance = Field(Lambert(), description="how the ground reflects")
    albedo_map: AlbedoMapTable | None = Field(None, description="a map that multiplies the albedo; default: none")

    atmosphere: AtmosphereTable | None = Field(None, description="light that air scatters; default: no air")

    @model_validator(mode="after")
    def _round(self) -> BodyTable:
        if self.atmosphere is not None and (self.shape != "ellipsoid" or self.relief_m):
            raise ValueError("atmosphere: needs shape = 'ellipsoid' without relief_m")
        return self

    @model_validator(mode="after")
    def _of_a_mesh(self) -> BodyTable:
        if self.sharpen not in (0, "auto") and self.shape in ("embedded", "ellipsoid"):
            raise ValueError(f"sharpen = {self.sharpen!r}: needs a shape file, not shape = {self.shape!r}")
        if self.volume_km3 is not None and self.shape == "ellipsoid":
            raise ValueError(
                f"volume_km3 = {self.volume_km3:g}: semi_axes_m sets the volume of shape = 'ellipsoid'"
            )
        return self

    @model_validator(mode="after")
    def _gentle(self) -> BodyTable:
        if self.shape == "ellipsoid" and self.relief_m > _MOST_RELIEF * min(self.semi_axes_m):
            raise ValueError(
                f"relief_m = {self.relief_m:g}: must be at most {_MOST_RELIEF:g} of the shortest of semi_axes_m, "
                f"{min(self.semi_axes_m):g}"
            )
        return self

    @model_validator(mode="after")
    def _known(self) -> BodyTable:
        if isinstance(self.reflectance, str) and self.reflectance not in spectra.REFLECTANCES:
            known = ", ".join(spectra.REFLECTANCES)
            raise ValueError(f"reflectance = {self.reflectance!r}: must be a grey value 0 to 1 or one of {known}")
        return self


class PatchTable(Table):
    """Set how far and how finely the terrain around a site is refined."""

    preset: str = Field(
        "",
        description="a packaged body (`vbnfault list bodies`), whose ground gives the keys of [patch] that are "
        "left out; default: that of the short name in body.name; 'none': no body's",
    )
    facet_m: float = Field(0.12, ge=0.05, le=1e6, description="edge length aimed at within radius_m of the site")
    facet_px: float = Field(
        1.0, ge=0.25, le=8, description="for poses of a table: edge length in pixels of the nearest ground in view"
    )
    radius_m: float = Field(40.0, ge=1, le=1e8, description="beyond, facets grow with the distance")
    max_triangles: int = Field(
        1_600_000, ge=10_000, le=20_000_000, description="facets are coarsened to keep to it"
    )
    relief: float = Field(1.0, ge=0, le=10, description="amplitude of relief below the model's facets; 0: none")
    roughness: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="least RMS difference in height over distance, below the facets of a model that is smoother",
    )
    hurst: float | None = Field(
        None, ge=0.3, le=1.2, description="exponent of the relief's roughness; default: as the model's own"
    )
    scarps: float = Field(
        0.0, ge=0, le=1, description="fraction of the way in which slopes of the model are gathered into scarps"
    )
    contour_scarps: float = Field(
        0.0, ge=0, le=3, description="factor on scarps along contours of the ground, where layers crop out; 0: none"
    )
    intermittency: float = Field(
        0.0,
        ge=0,
        le=1,
        description="how much more relief lies on rough and steep ground than on smooth plains; 0: evenly",
    )
    angularity: float = Field(
        0.0,
        ge=0,
        le=1,
        description="part of the variance of relief over 20 m that is of planes which meet in edges; 0: none",
    )
    airfall: float = Field(
        0.0, ge=0, le=3, description="how much more dust covers low and level ground than high and steep ground"
    )
    craters_per_km2: float = Field(60.0, ge=0, le=1e5, description="of 10 m or more; 600 at most without regolith")
    boulders: bool = Field(True, description="whether boulders lie on the ground")
    min_boulder_m: float = Field(0.25, ge=0.05, le=1000, description="diameter of the smallest near the site")
    boulder_index: float = Field(3.6, ge=0.5, le=6, description="of the cumulative size law; Pajola et al. 2015")
    boulders_per_km2: float = Field(98.0, ge=0, le=1e5, description="of 7 m or more; Pajola et al. 2015")
    largest_boulder_m: float = Field(45.0, ge=0.1, le=1000, description="diameter of the largest")
    fractured: Fractured | None = Field(None, description="layered and jointed rock in place of rounded relief")
    regolith: Regolith | None = Field(
        None,
        description="ground of asteroids and moons in place of a comet's; fractured, scarps, contour_scarps and "
        "intermittency do not count then",
    )

    @model_validator(mode="after")
    def _known(self) -> PatchTable:
        if self.preset not in ("", "none") and named_body(self.preset) is None:
            known = ", ".join(packaged_bodies())
            raise ValueError(f"preset = {self.preset!r}: must be 'none' or one of {known}")
        if self.regolith is None and self.craters_per_km2 > _MOST_PITS:
            raise ValueError(
                f"craters_per_km2 = {self.craters_per_km2:g}: must be at most {_MOST_PITS} without [patch.regolith]"
            )
        return self
