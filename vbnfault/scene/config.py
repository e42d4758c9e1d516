"""Read and check the scene file: one TOML file that defines a whole dataset. Units are in the names of the keys.

Unknown keys, wrong types, reversed bounds and values out of range are refused. The error is one sentence that names
the file, the key, the value and the allowed range. `faults.from_dict` checks the tables under `[faults]`, since
every fault model has its own keys.
"""

from __future__ import annotations

import difflib
import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from ..core import photometry, resources, spectra
from ..core.errors import InputError, shown
from ..core.quantities import SOFT_KINDS

Architecture = Literal["full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos"]
Direction = Literal["up", "down", "left", "right"]
_LAYERS = (
    "clean|depth_m|normal|semantic|raw|defects|radiance|mask_effect|"
    "point_T_m|incidence_deg|emission_deg|phase_deg|albedo|without_[a-z0-9_]+|"
    + "|".join(f"[a-z0-9_]+_{kind}" for kind in SOFT_KINDS)
)
# Values of body.shape and of spacecraft.model that do not name a file.
_SHAPES = ("embedded", "ellipsoid")
_VEHICLES = ("none", "default")
Layer = Annotated[str, Field(pattern=f"^({_LAYERS})$")]


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    """Return a pair of bounds. Raises ValueError where they are reversed."""
    if pair[0] > pair[1]:
        raise ValueError("bounds reversed, the lower one comes first")
    return pair


def _pair(lo: float, hi: float) -> Any:
    """Return the type of a pair of bounds within `lo` and `hi`, the lower one first."""
    value = Annotated[float, Field(ge=lo, le=hi)]
    return Annotated[tuple[value, value], AfterValidator(_ordered)]


# The most radiances of a frame (pixels × bands), 4 bytes each. About ten such arrays are in memory at a time.
_MOST_RADIANCES = 2**28
# The most rows of a spectrum or of Hapke's parameters, and the most SPICE kernels.
_MOST_ROWS = 10_000
Wavelength = Annotated[float, Field(gt=0, le=1e5)]
SemiAxis = Annotated[float, Field(gt=0, le=1e9)]
Cosine = Annotated[float, Field(ge=-1, le=1)]
Offset = Annotated[float, Field(ge=-1e4, le=1e4)]


class Table(BaseModel):
    """Check a table of the scene file: it is frozen and strict, and refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)


class SplitTable(Table):
    """Set the fraction of the sites in each split."""

    train: float = Field(0.7, ge=0, le=1)
    val: float = Field(0.15, ge=0, le=1)
    test: float = Field(0.15, ge=0, le=1)

    @model_validator(mode="after")
    def _sum(self) -> SplitTable:
        if abs(self.train + self.val + self.test - 1) > 1e-6:
            raise ValueError(f"train = {self.train:g}, val = {self.val:g}, test = {self.test:g}: must add up to 1")
        return self


class DatasetTable(Table):
    """Set the size of the dataset and what it stores."""

    samples: int = Field(16, ge=1, le=10_000_000)
    seed: int = Field(1, ge=0, le=2**63 - 1)
    sites: int = Field(32, ge=1, le=100_000, description="sites on the body; samples are grouped by site")
    shard_samples: int = Field(
        8, ge=1, le=16, description="samples a shard, all of one site: what a kill can lose at most"
    )
    layers: tuple[Layer, ...] = (
        "clean",
        "without_straylight",
        "mask_effect",
        "depth_m",
        "normal",
        "semantic",
    )
    mask_any: tuple[str, ...] | None = Field(
        None,
        description="classes of the scene whose masks mask_any unites; []: none; default: the localised ones",
    )
    split: SplitTable = SplitTable()
    licence: str = "CC-BY-4.0"
    citation: str = ""


class SpectrumTable(Table):
    """Give values at wavelengths. They are interpolated linearly and are constant beyond the ends."""

    wavelength_nm: tuple[Wavelength, ...] = Field(min_length=1, max_length=_MOST_ROWS)
    value: tuple[Annotated[float, Field(ge=0, le=1)], ...] = Field(min_length=1, max_length=_MOST_ROWS)

    @model_validator(mode="after")
    def _paired(self) -> SpectrumTable:
        if len(self.wavelength_nm) != len(self.value):
            raise ValueError(f"{len(self.wavelength_nm)} wavelengths for {len(self.value)} values: must be as many")
        if any(a >= b for a, b in itertools.pairwise(self.wavelength_nm)):
            raise ValueError(f"wavelength_nm = {list(self.wavelength_nm)}: must increase")
        return self


class HapkeRow(Table):
    """Give Hapke's parameters at one wavelength (Hapke 2002, 2012)."""

    wavelength_nm: float = Field(gt=0, le=1e5)
    single_scattering_albedo: float = Field(ge=0, le=1, description="w")
    asymmetry: float = Field(gt=-1, lt=1, description="g of Henyey-Greenstein; negative scatters back")
    shadow_hiding_amplitude: float = Field(0.0, ge=0, le=100, description="B0")
    shadow_hiding_width: float = Field(1.0, gt=0, le=100, description="h_s, dimensionless: not an angle")
    coherent_amplitude: float = Field(0.0, ge=0, le=100, description="B_C0")
    coherent_width: float = Field(1.0, gt=0, le=100, description="h_c")
    roughness_deg: float = Field(0.0, ge=0, le=60, description="mean slope below a pixel")
    porosity_factor: float = Field(1.0, ge=1, le=10, description="K")


class PhotometryTable(Table):
    """Set how the ground reflects. All models except Hapke's scale `body.reflectance`."""

    model: Literal["lambert", "lommel_seeliger", "mcewen", "hapke"] = "lambert"
    phase_slope_mag_deg: float = Field(
        0.0, ge=0, le=1, description="fading with phase angle, not for 'hapke'; 67P: 0.047"
    )
    parameters: str = Field("67p_fornasier2015", description="a named set of Hapke's parameters")
    hapke: tuple[HapkeRow, ...] | None = Field(
        None,
        min_length=1,
        max_length=_MOST_ROWS,
        description="Hapke's parameters at wavelengths of one's own, in place of a named set",
    )
    dust_contrast: float = Field(
        0.0, ge=-0.9, le=4, description="how much brighter dust-covered ground is at 649 nm: 0.2 for 20 %"
    )
    dust_slope_per_100nm: float = Field(
        0.0, ge=-0.2, le=0.2, description="spectral slope of dust-covered over bare ground"
    )

    @model_validator(mode="after")
    def _known(self) -> PhotometryTable:
        if self.parameters not in photometry.HAPKE_TABLES:
            known = ", ".join(photometry.HAPKE_TABLES)
            raise ValueError(f"parameters = {self.parameters!r}: must be one of {known}")
        return self

    def rows(self) -> tuple[tuple[float, ...], ...]:
        """Return `hapke` as rows for `photometry.hapke_at`."""
        return tuple(
            (row.wavelength_nm, *(getattr(row, name) for name in photometry.COLUMNS)) for row in self.hapke or ()
        )


class BodyTable(Table):
    """Describe the target body in its body-fixed frame T."""

    name: str = "67P/Churyumov-Gerasimenko"
    shape: str = Field(
        "embedded",
        description="'embedded', 'ellipsoid', or a shape file: OBJ, PLY, STL, GLB, PDS TAB, ICQ, WRL, BDS",
    )
    unit: Literal["auto", "m", "km"] = "auto"
    semi_axes_m: tuple[SemiAxis, SemiAxis, SemiAxis] = Field(
        (1000.0, 1000.0, 1000.0), description="of an 'ellipsoid'"
    )
    density_kg_m3: float = Field(537.8, gt=0, le=30_000)
    rotation_period_h: float = Field(
        24 * 360 / 696.543884683, gt=0.01, le=1e5, description="67P before perihelion 2015: 12.4041 h"
    )
    pole_ra_deg: float = Field(69.54, ge=0, le=360)
    pole_dec_deg: float = Field(64.11, ge=-90, le=90)
    prime_meridian_deg: float = Field(114.69, ge=-360, le=360, description="W at J2000.0")
    reflectance: str | Annotated[float, Field(ge=0, le=1)] | SpectrumTable = Field(
        "67p", description="a named reflectance, a grey value, or a table of values at wavelengths"
    )
    photometry: PhotometryTable = PhotometryTable()

    @model_validator(mode="after")
    def _known(self) -> BodyTable:
        if isinstance(self.reflectance, str) and self.reflectance not in spectra.REFLECTANCES:
            known = ", ".join(spectra.REFLECTANCES)
            raise ValueError(f"reflectance = {self.reflectance!r}: must be a grey value 0 to 1 or one of {known}")
        return self


class PatchTable(Table):
    """Set how far and how finely the terrain around a site is refined."""

    facet_m: float = Field(0.12, ge=0.05, le=1e6, description="edge length aimed at within radius_m of the site")
    radius_m: float = Field(40.0, ge=1, le=1e8, description="beyond, facets grow with the distance")
    max_triangles: int = Field(
        1_600_000, ge=10_000, le=20_000_000, description="facets are coarsened to keep to it"
    )
    relief: float = Field(1.0, ge=0, le=10, description="amplitude of relief below the model's facets; 0: none")
    hurst: float | None = Field(
        None, ge=0.3, le=1.2, description="exponent of the relief's roughness; default: as the model's own"
    )
    craters_per_km2: float = Field(60.0, ge=0, le=600, description="of 10 m or more")
    boulders: bool = True
    min_boulder_m: float = Field(0.25, ge=0.05, le=1000, description="diameter of the smallest near the site")
    boulder_index: float = Field(3.6, ge=0.5, le=6, description="of the cumulative size law; Pajola et al. 2015")
    boulders_per_km2: float = Field(98.0, ge=0, le=1e5, description="of 7 m or more; Pajola et al. 2015")


class SunTable(Table):
    """Set the date of the ephemeris, the Sun's distance (default: from the ephemeris) and its limb darkening."""

    julian_date: float = Field(2456974.0, ge=1_000_000, le=5_000_000, description="TDB; sets the body's attitude")
    distance_au: float | None = Field(None, gt=0.01, le=1000)
    limb_darkening: bool = Field(True, description="after Neckel & Labs 1994; else a uniform disc")


class OrbitTable(Table):
    """Describe the body's two-body orbit about the Sun (ecliptic, equinox J2000); default: 67P's orbit of 2015."""

    eccentricity: float = Field(ge=0, le=100, description="1: a parabola, above: a hyperbola")
    perihelion_au: float = Field(gt=0.01, le=1000)
    inclination_deg: float = Field(ge=0, le=180)
    node_deg: float = Field(ge=-360, le=360)
    argument_deg: float = Field(ge=-360, le=360, description="of perihelion")
    perihelion_jd: float = Field(ge=1_000_000, le=5_000_000, description="TDB")
    mean_motion_deg_day: float | None = Field(
        None, gt=0, le=1000, description="of the mean anomaly; default: Kepler's third law; a parabola has none"
    )

    @model_validator(mode="after")
    def _parabola(self) -> OrbitTable:
        if self.eccentricity == 1 and self.mean_motion_deg_day is not None:
            raise ValueError(
                f"mean_motion_deg_day = {self.mean_motion_deg_day:g}: a parabola (eccentricity = 1) has "
                "none; leave it out"
            )
        return self


class SpiceTable(Table):
    """Name SPICE kernels for the Sun's position, the target's attitude and a spacecraft's pose.

    Without kernels, `[orbit]` and `[body]` give the Sun's position and the attitude. With a spacecraft, samples lie
    on its trajectory from `sun.julian_date` to `until_julian_date`. This time is divided equally among the sites;
    `[geometry]`, with its bounds of the Sun, does not apply.
    """

    kernels: tuple[str, ...] = Field(
        (), max_length=_MOST_ROWS, description="kernels or meta-kernels; needs the extra 'spice'"
    )
    target: str = Field("CHURYUMOV-GERASIMENKO", description="SPICE name or number")
    frame: str = Field("", description="body-fixed frame; default: pole and period of [body]")
    spacecraft: str = Field("", description="SPICE name or number of what carries the camera")
    camera_frame: str = Field("", description="the camera's frame, such as ROS_NAVCAM-A")
    camera_axes: tuple[Cosine, Cosine, Cosine, Cosine, Cosine, Cosine, Cosine, Cosine, Cosine] | None = Field(
        None, description="rows of the rotation from image axes (x right, y down, z boresight) to camera_frame"
    )
    until_julian_date: float | None = Field(
        None, ge=1_000_000, le=5_000_000, description="TDB; default: all samples at sun.julian_date"
    )

    @model_validator(mode="after")
    def _served(self) -> SpiceTable:
        if self.frame and not self.kernels:
            raise ValueError(f"frame = {self.frame!r}: needs kernels")
        if self.spacecraft:
            for key in ("kernels", "frame", "camera_frame"):
                if not getattr(self, key):
                    raise ValueError(f"spacecraft = {self.spacecraft!r}: needs {key}")
        elif self.camera_frame or self.camera_axes:
            raise ValueError("camera_frame and camera_axes need spacecraft")
        return self


class SkyTable(Table):
    """Set which stars the sky shows. An exposure for a sunlit comet hides stars, so the default is none."""

    stars: Literal["off", "auto", "on"] = Field("off", description="auto: those that the exposure can show")
    limiting_magnitude: float = Field(7.0, ge=-2, le=7)
    sigma_px: float = Field(0.6, ge=0, le=16, description="Gaussian point spread of a thin lens")


class PoseTable(Table):
    """Turn a part about its hinge, in the camera's axes B."""

    hinge_m: tuple[Offset, Offset, Offset] | None = None
    axis: tuple[Offset, Offset, Offset] | None = None
    angle_deg: float = Field(0.0, ge=-360, le=360)


Paint = str | Annotated[float, Field(ge=0, le=1)] | SpectrumTable


class SpacecraftTable(Table):
    """Describe the spacecraft that carries the camera, in the camera's axes B (x right, y down, z boresight)."""

    model: str = Field("none", description="'none', 'default' (a lander), or an OBJ or GLB file")
    unit: Literal["m", "cm", "mm"] = "m"
    roll_deg: float = Field(0.0, ge=-360, le=360)
    pitch_deg: float = Field(0.0, ge=-360, le=360)
    yaw_deg: float = Field(0.0, ge=-360, le=360)
    translation_m: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    default_material: Paint = Field(0.3, description="a named material, a grey value, or a table")
    materials: dict[str, Paint] = Field(default_factory=dict, description="by part or material of the file")
    pose: dict[str, PoseTable] = Field(default_factory=dict, description="by part")


# Values of a camera without a prescription, where the scene gives none.
THIN_LENS = {"f_number": 4.0, "transmission": 0.9}
# Keys that a named detector sets itself.
OF_THE_DETECTOR = (
    "pixel_pitch_um",
    "full_well_e",
    "read_noise_e_rms",
    "dark_current_e_s",
    "adc_bits",
    "bias_dn",
    "response",
    "quantum_efficiency_peak",
    "architectures",
)


class CameraTable(Table):
    """Describe the camera and its exposure."""

    fov_deg: float = Field(65.0, ge=0.01, le=140, description="full field of view across the width")
    width_px: int = Field(1024, ge=16, le=16384)
    height_px: int = Field(1024, ge=16, le=16384)
    lens: str = Field(
        "",
        description="a packaged lens or a prescription's TOML, scaled to the field of view; default: a thin lens",
    )
    lens_coating: str = Field(
        "", description="put on all its surfaces between glass and air: none, mgf2, v or bbar; default: its own"
    )
    focus: Literal["paraxial", "best"] = Field(
        "paraxial", description="where its sensor stands: best has the smallest spots over the frame"
    )
    f_number: float | None = Field(
        None,
        ge=0.5,
        le=200,
        description="default: 4 of a thin lens, a prescription's own; a larger one than that closes its stop",
    )
    transmission: float | None = Field(
        None,
        gt=0,
        le=1,
        description="of a thin lens, default 0.9; a prescription's follows from glass and coatings",
    )
    focus_distance_m: float | None = Field(None, gt=0, le=1e12, description="default: infinity")
    detector: str = Field(
        "",
        description="a packaged detector or a sensor's TOML, with a mosaic; its numbers are those of the keys from "
        "pixel_pitch_um to quantum_efficiency_peak; default: three colours in every pixel, from these keys",
    )
    individuals: int = Field(
        1,
        ge=1,
        le=10_000,
        description="devices of the detector that the samples are taken with; each is in one split only, if there "
        "are as many as splits",
    )
    detector_temperature_K: float | None = Field(None, ge=100, le=400, description="default: the detector's own")
    pixel_pitch_um: float = Field(5.5, ge=0.5, le=100)
    full_well_e: float = Field(13_500.0, ge=10, le=1e8)
    read_noise_e_rms: float = Field(13.0, ge=0, le=1e5)
    dark_current_e_s: float = Field(
        15.0,
        ge=0,
        le=1e9,
        description="default: a CMV4000's 125 e/s at 25 °C brought to 0 °C, halving every 8 K",
    )
    adc_bits: int = Field(12, ge=8, le=16)
    bias_dn: int = Field(64, ge=0, le=1000)
    response: str = "nikon_5100"
    quantum_efficiency_peak: float = Field(0.5, gt=0, le=1)
    exposure_s: float | Literal["auto"] = Field("auto", description="seconds, or metered on each clean frame")
    exposure_min_s: float = Field(1e-5, gt=0, le=1e4)
    exposure_max_s: float = Field(5.0, gt=0, le=1e4)
    metering_level: float = Field(
        0.75, gt=0, le=1, description="fraction of white given to metering_percentile of the sunlit pixels"
    )
    metering_percentile: float = Field(99.0, gt=0, le=100)
    architectures: tuple[Architecture, ...] = Field(
        ("full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos"), min_length=1
    )
    readout_directions: tuple[Direction, ...] = Field(("up", "down", "left", "right"), min_length=1)

    @model_validator(mode="after")
    def _of_the_lens(self) -> CameraTable:
        if self.lens and self.transmission is not None:
            raise ValueError(
                f"transmission = {self.transmission:g}: the lens has its own, of glass and coatings; leave one out"
            )
        if not self.lens:  # with a prescription, None stays and means the prescription's own f-number
            for key, value in THIN_LENS.items():
                if getattr(self, key) is None:
                    object.__setattr__(self, key, value)
        return self

    @model_validator(mode="after")
    def _known(self) -> CameraTable:
        if self.response not in spectra.RESPONSES:
            raise ValueError(f"response = {self.response!r}: must be one of {', '.join(spectra.RESPONSES)}")
        if isinstance(self.exposure_s, float | int) and not 0 < self.exposure_s <= 1e4:
            raise ValueError(f"exposure_s = {self.exposure_s!r}: must be 'auto' or above 0 and at most 1e4 s")
        for key in ("lens_coating", "focus"):
            value = getattr(self, key)
            if not self.lens and value not in ("", "paraxial"):
                raise ValueError(f"{key} = {value!r}: needs lens")
        for key in OF_THE_DETECTOR if self.detector else ("individuals", "detector_temperature_K"):
            if getattr(self, key) != CameraTable.model_fields[key].default:
                why = "the detector has its own; leave one out" if self.detector else "needs detector"
                raise ValueError(f"{key} = {getattr(self, key)!r}: {why}")
        if self.exposure_min_s > self.exposure_max_s:
            raise ValueError(
                f"exposure_min_s = {self.exposure_min_s:g}, "
                f"exposure_max_s = {self.exposure_max_s:g}: bounds reversed"
            )
        return self


class RenderTable(Table):
    """Set the spectral bands and the sampling."""

    band_min_nm: float = Field(400.0, ge=280, le=3900)
    band_max_nm: float = Field(700.0, ge=290, le=4000)
    bands: int = Field(8, ge=1, le=64)
    samples_per_pixel: int = Field(16, ge=1, le=4096, description="a power of four: strata of each pixel")
    noise_fraction: float | None = Field(
        None,
        gt=0.01,
        le=10,
        description="most noise of sampling, over the sensor's own, in 99 % of lit pixels: more samples where it "
        "takes them; default: no more anywhere",
    )
    max_samples_per_pixel: int = Field(256, ge=1, le=4096, description="a power of four; for noise_fraction")
    bounces: int = Field(0, ge=0, le=4, description="reflections between sunlit ground and the ground that is seen")

    @model_validator(mode="after")
    def _valid(self) -> RenderTable:
        if self.band_min_nm >= self.band_max_nm:
            raise ValueError(
                f"band_min_nm = {self.band_min_nm:g}, band_max_nm = {self.band_max_nm:g}: bounds reversed"
            )
        for key in ("samples_per_pixel", "max_samples_per_pixel"):
            n = getattr(self, key)
            if n & (n - 1) or (n.bit_length() - 1) % 2:
                raise ValueError(f"{key} = {n}: must be 1, 4, 16, 64, 256, 1024 or 4096")
        return self


class StratumTable(Table):
    """Set the bounds of one stratum of the sampling (Gallon et al., Table of bounds). Angles are in degrees.

    Roll and pitch tilt the boresight away from the reference direction; yaw turns the camera about the boresight.
    At the site, the Sun's elevation counts from the horizon upwards and its azimuth from north towards east.
    """

    sun_azimuth_deg: _pair(-360, 720) | None = None  # type: ignore[valid-type]
    sun_elevation_deg: _pair(-90, 90) | None = None  # type: ignore[valid-type]
    roll_deg: _pair(-360, 720) | None = None  # type: ignore[valid-type]
    pitch_deg: _pair(-360, 720) | None = None  # type: ignore[valid-type]
    yaw_deg: _pair(-360, 720) | None = None  # type: ignore[valid-type]
    reference: Literal["sun", "nadir"] = Field("sun", description="where the boresight points at zero angles")
    min_lit_fraction: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None, description="default: that of [geometry]"
    )


class GeometryTable(Table):
    """Set where the camera is and looks. Unset bounds follow the paper's table for the camera's field of view."""

    x_m: _pair(-1e9, 1e9) = (-150.0, 150.0)  # type: ignore[valid-type]
    y_m: _pair(-1e9, 1e9) = (-150.0, 150.0)  # type: ignore[valid-type]
    height_m: _pair(0, 1e12) = (0.0, 100.0)  # type: ignore[valid-type]
    height_reference: Literal["local_ground", "site"] = Field(
        "local_ground", description="height_m counts from the ground below the camera, or from the site's level"
    )
    clearance_m: float = Field(0.5, ge=0, le=1e9, description="least distance to any surface, else drawn again")
    sun_visibility: Literal["required", "as_drawn"] = Field(
        "required",
        description="of the Sun in samples with straylight: required whole and before the camera, else the view is "
        "drawn again; or left as drawn, and straylight is not injected where the Sun is hidden",
    )
    min_lit_fraction: float = Field(
        0.0,
        ge=0,
        le=1,
        description="least fraction of the frame that shows sunlit ground, by a grid of rays, else drawn again; "
        "not for cameras that SPICE places",
    )
    max_tries: int = Field(
        256, ge=1, le=100_000, description="views drawn until one meets all conditions; the sample fails after them"
    )
    sun_facing: StratumTable | None = None
    sun_averted: StratumTable | None = None


class PlanTable(Table):
    """Set the fault matrix and the choice of views."""

    mode: Literal["per_class", "per_sample"] = "per_sample"
    faulty_fraction: float = Field(0.5, ge=0, le=1, description="the paper's percentage p")
    classes_per_sample: Annotated[
        tuple[Annotated[int, Field(ge=1, le=64)], Annotated[int, Field(ge=1, le=64)]],
        AfterValidator(_ordered),
    ] = (1, 6)
    sun_facing_nominal_fraction: float = Field(
        0.0, ge=0, le=1, description="share of all samples that face the Sun without straylight"
    )
    on_invisible: Literal["redraw_view", "drop"] = Field(
        "redraw_view",
        description="where a commanded fault cannot show in a view: another view is drawn and rendered, or the "
        "fault is recorded as not injected; where SPICE places the camera there is no other view",
    )
    max_views: int = Field(16, ge=1, le=1000, description="views rendered for a sample; it fails after them")
    pair_strata: bool = Field(
        False,
        description="Sun-facing and Sun-averted samples share a target attitude in pairs, as in the paper; needs "
        "geometry.sun_visibility = 'as_drawn', since the Sun of a pair is not drawn again",
    )


class Scene(Table):
    """Hold a whole scene file with all defaults filled in."""

    title: str
    description: str = ""
    dataset: DatasetTable = DatasetTable()
    body: BodyTable = BodyTable()
    patch: PatchTable = PatchTable()
    sun: SunTable = SunTable()
    orbit: OrbitTable | None = None
    spice: SpiceTable = SpiceTable()
    spacecraft: SpacecraftTable = SpacecraftTable()
    sky: SkyTable = SkyTable()
    camera: CameraTable = CameraTable()
    render: RenderTable = RenderTable()
    geometry: GeometryTable = GeometryTable()
    plan: PlanTable = PlanTable()
    faults: dict[str, dict[str, Any]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _fits(self) -> Scene:
        width_px, height_px, bands = self.camera.width_px, self.camera.height_px, self.render.bands
        if width_px * height_px * bands > _MOST_RADIANCES:
            raise ValueError(
                f"camera.width_px = {width_px}, camera.height_px = {height_px}, render.bands = {bands}: a frame "
                f"has {width_px * height_px * bands} radiances; must be at most {_MOST_RADIANCES}, 1 GiB"
            )
        return self

    @model_validator(mode="after")
    def _strata(self) -> Scene:
        half, full = self.camera.fov_deg / 2, 360.0
        near, far, turn = (-half, half), (half, full - half), (0.0, full)
        paper: dict[str, dict[str, Any]] = {
            "sun_facing": {"sun_elevation_deg": (-30.0, 30.0), "roll_deg": near, "pitch_deg": near},
            "sun_averted": {"sun_elevation_deg": (-30.0, 90.0), "roll_deg": far, "pitch_deg": far},
        }
        strata = {}
        for name, bounds in paper.items():
            given = getattr(self.geometry, name) or StratumTable()
            bounds |= {"sun_azimuth_deg": turn, "yaw_deg": turn}
            bounds["min_lit_fraction"] = self.geometry.min_lit_fraction
            unset = {key: value for key, value in bounds.items() if getattr(given, key) is None}
            strata[name] = given.model_copy(update=unset)
        object.__setattr__(self, "geometry", self.geometry.model_copy(update=strata))
        if self.plan.pair_strata and self.geometry.sun_visibility != "as_drawn":
            raise ValueError(
                f"plan.pair_strata = true: needs geometry.sun_visibility = 'as_drawn', not "
                f"{self.geometry.sun_visibility!r}: the Sun of a pair is not drawn again"
            )
        return self

    def resolved(self) -> dict[str, Any]:
        """Return the whole scene as plain JSON-able data."""
        plain: dict[str, Any] = json.loads(self.model_dump_json())
        return plain


def load_scene(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Load a scene by its path or packaged name. Raises InputError.

    `overrides` maps dotted keys to values that replace those of the file. A relative path in the file (such as a
    mesh or a texture) starts from the file's folder, or from the working folder where nothing lies there. A path in
    `overrides` starts from the working folder.
    """
    path = resources.find("scenes", name_or_path)
    table = resources.read_toml(path)
    for key, value in (overrides or {}).items():
        *parents, leaf = key.split(".")
        node = table
        if isinstance(value, str) and (
            key.endswith(".texture_file")
            or (key.endswith((".lens", ".detector")) and Path(value).suffix)
            or (key == "body.shape" and value not in _SHAPES)
            or (key == "spacecraft.model" and value not in _VEHICLES)
        ):
            value = resources.absolute(value, key)  # a path on the command line starts from the working folder
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise InputError(f"{path}: {key} = {shown(value)}: {parent} is a value, not a table")
        node[leaf] = value
    try:
        _anchor_paths(table, path.parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return parse_scene(table, source=str(path), overrides=tuple(overrides or ()))


def parse_scene(table: Mapping[str, Any], *, source: str, overrides: Sequence[str] = ()) -> Scene:
    """Return plain data as a checked scene. Raises InputError; its one sentence names `source`, key and value.

    `overrides` are the dotted keys that replaced values of `source`; the message marks them.
    """
    resources.check_plain(table, source)
    try:
        # JSON mode is strict about types, but accepts arrays as tuples. No key takes a TOML date: a list fails.
        return Scene.model_validate_json(json.dumps(table, default=lambda date: [str(date)]), strict=True)
    except ValidationError as error:
        at = ".".join(map(str, error.errors()[0]["loc"]))
        given = (
            " (set in place of the file)"
            if any(at.startswith(key) or key.startswith(at + ".") for key in overrides)
            else ""
        )
        raise InputError(f"{source}: {_sentence(error)}{given}") from None


def _anchor_paths(table: dict[str, Any], folder: Path) -> None:
    """Make relative paths absolute, from the scene file's folder, else from the working folder."""

    def anchored(path: str, where: str) -> str:
        resources.check_path(path, where)
        beside = folder / path
        return resources.absolute(path if resources.file_status(beside) is None else beside, where)

    def anchor(node: Any, where: str, built_in: tuple[str, ...] = ()) -> None:
        key = where.rsplit(".", 1)[-1]
        if isinstance(node, dict) and isinstance(node.get(key), str) and node[key] not in ("", *built_in):
            node[key] = anchored(node[key], where)

    def anchor_file(node: Any, where: str) -> None:
        key = where.rsplit(".", 1)[-1]
        if isinstance(node, dict) and isinstance(node.get(key), str) and Path(node[key]).suffix:
            anchor(node, where)  # without a suffix it is a packaged name

    anchor(table.get("body"), "body.shape", _SHAPES)
    anchor(table.get("spacecraft"), "spacecraft.model", _VEHICLES)
    anchor_file(table.get("camera"), "camera.lens")
    anchor_file(table.get("camera"), "camera.detector")
    kernels = table.get("spice")
    if isinstance(kernels, dict) and isinstance(kernels.get("kernels"), list):
        kernels["kernels"] = [
            anchored(k, "spice.kernels") if isinstance(k, str) and k else k for k in kernels["kernels"]
        ]
    faults = table.get("faults")
    for name, fault in faults.items() if isinstance(faults, dict) else ():
        anchor(fault, f"faults.{name}.texture_file")
        anchor_file(fault, f"faults.{name}.lens")


def _sentence(error: ValidationError) -> str:
    """Return the first error as a clause that names the key, the value and what is allowed."""
    first = error.errors()[0]
    keys, schema = _locate(first["loc"])
    value, message = first.get("input"), str(first.get("ctx", {}).get("error", first["msg"]))
    if first["type"] == "extra_forbidden":
        known = list(schema.get("properties", {}))
        close = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
        hint = f" (did you mean {close[0]}?)" if close else f"; known: {', '.join(known)}"
        return f"{_dotted(first['loc'])}: unknown key{hint}"
    if first["type"] == "missing" and not isinstance(value, list):
        return f"{_dotted(first['loc'])}: missing"
    if first["type"] == "missing":  # a pair with one end
        keys, schema = _locate(first["loc"][:-1])
    elif first["type"] == "value_error":
        return f"{_dotted(keys)}{_shown(value)}: {message}" if keys else message
    return f"{_dotted(keys)}{_shown(value)}: must be {_wanted(schema, message)}"


def _dotted(keys: Sequence[int | str]) -> str:
    """Return keys as one dotted key for an error message."""
    return ".".join(map(resources.shown_path, map(str, keys)))


def _shown(value: Any) -> str:
    """Return " = value" for an error message, empty for a table."""
    return "" if isinstance(value, dict | BaseModel) else f" = {shown(value)}"


def _wanted(schema: Mapping[str, Any], message: str) -> str:
    """Return in words which values a key takes, from its JSON schema, or else from pydantic's message."""
    items = schema.get("prefixItems")
    if items:
        each = _wanted(items[0], "a value").removeprefix("a ")
        count = {2: "two", 3: "three"}.get(len(items), str(len(items)))
        return f"a list of {count} values, each a {each}"
    if schema.get("type") == "array" and schema.get("minItems") and "at least" in message:
        return f"a list of at least {schema['minItems']}"
    if schema.get("pattern", "").startswith("^("):
        options = schema["pattern"].removeprefix("^(").removesuffix(")$").replace("[a-z_]+", "<fault>")
        return f"one of {', '.join(options.split('|'))}"
    lo = schema.get("minimum", schema.get("exclusiveMinimum"))
    hi = schema.get("maximum", schema.get("exclusiveMaximum"))
    word = f"{schema['const']!r} or " if "const" in schema else ""
    if lo is None and hi is None:
        if word:
            return f"{word}a number"
        plain = message.replace("Input should be ", "")
        return {"a valid string": "a string", "an object": "a table", "a valid boolean": "true or false"}.get(
            plain, plain
        )
    kind = "a whole number" if schema.get("type") == "integer" else "a number"
    above = "" if lo is None else f" {'above' if 'exclusiveMinimum' in schema else 'from'} {lo:g}"
    joint = (
        ""
        if hi is None
        else f" {'to' if above.startswith(' from') else 'and at most' if above else 'up to'} {hi:g}"
    )
    return f"{word}{kind}{above}{joint}"


def _locate(loc: tuple[int | str, ...]) -> tuple[list[str], dict[str, Any]]:
    """Return the keys of an error's location without pydantic's union tags, and the schema at that location."""
    root = Scene.model_json_schema()

    def plain(node: dict[str, Any]) -> dict[str, Any]:
        while "$ref" in node or "allOf" in node:
            node = root["$defs"][node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node["allOf"][0]
        options = [plain(o) for o in node.get("anyOf", ()) if o.get("type") != "null"]
        numeric = [o for o in options if o.get("type") in ("number", "integer")]
        constant = next(({"const": o["const"]} for o in options if "const" in o), {})
        return options[0] if len(options) == 1 else {**node, **(numeric[0] if numeric else {}), **constant}

    keys: list[str] = []
    node = plain(root)
    for part in loc:
        if part in node.get("properties", {}):
            node = plain(node["properties"][part])
        elif isinstance(part, int) and ("prefixItems" in node or "items" in node):
            node = plain(node["prefixItems"][part] if "prefixItems" in node else node["items"])
        elif isinstance(part, str) and part not in ("str", "float") and not part.startswith("constrained"):
            if part.startswith(("literal", "function", "tuple")):
                continue
        else:
            continue
        keys.append(str(part))
    return keys, node


def json_schema(faults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of the scene file; `faults` is the schema of the fault registry."""
    schema = Scene.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["properties"]["faults"] = dict(faults)
    return schema


def content_hash(*parts: Any) -> str:
    """Return the SHA-256 (hex) over JSON-able parts and bytes in order; the keys of a dictionary are sorted."""
    digest = hashlib.sha256()
    for part in parts:
        data = part if isinstance(part, bytes) else json.dumps(part, sort_keys=True).encode()
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()


def rng(seed: int, sample: int, stage: str, name: str) -> np.random.Generator:
    """Return the generator keyed by (seed, sample, stage, name), independent of the order of execution.

    Without one of the faults, or with the samples in another order, every other draw stays the same.
    """
    key = hashlib.sha256(f"{seed}\0{sample}\0{stage}\0{name}".encode()).digest()
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(list(np.frombuffer(key, np.uint32)))))


def keyed_uniform(seed: int, samples: NDArray[np.int64], stage: str, name: str) -> NDArray[np.float64]:
    """Return uniform numbers in [0, 1), float64[n], each keyed by (seed, its sample, stage, name).

    This is the vectorised counterpart of `rng` for one number per sample. It applies the splitmix64 finaliser
    (Steele et al. 2014, doi 10.1145/2660193.2660195) twice to the sample's number, offset by a hash of the other
    keys.
    """
    start = int.from_bytes(hashlib.sha256(f"{seed}\0{stage}\0{name}".encode()).digest()[:8], "little")
    x = np.asarray(samples).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(start)
    for _ in range(2):
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x ^= x >> np.uint64(31)
    return (x >> np.uint64(11)).astype(np.float64) * 2.0**-53
