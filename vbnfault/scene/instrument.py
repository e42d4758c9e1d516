"""Define the tables of a scene file that describe the camera and the rendering: `[camera]` and `[render]`."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ..core import spectra
from ..core.calibration import Calibration, SizeMissing
from ..core.errors import InputError, under_key
from ..core.quantities import ARCHITECTURES, READOUT_DIRECTIONS, Architecture, ReadoutDirection
from ..core.tables import Table, pair_within
from .calibration import CalibrationTable, of_frame

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

# The widest field of a rectilinear image. That of a calibration counts as at most this wide where poses are drawn.
_WIDEST_DEG = 140.0
_MOST_PX = 16384  # columns or rows of an image
_SIZE = {"width_px", "height_px"}
# Keys that only a camera with a named detector has.
OF_A_DETECTOR = ("individuals", "detector_temperature_K", "stretch", "black")
# Keys of a sensor file that users expect under [camera].
OF_A_SENSOR_FILE = (
    "architecture",
    "bits",
    "correct_defects",
    "demosaic",
    "effects",
    "individual",
    "pattern",
    "quantum_efficiency",
    "readout",
    "shutter",
    "temperature_K",
    "transfer",
)


class PointSpreadTable(Table):
    """Give a thin lens a point spread: a Gaussian core, a halo that falls as a power of the angle, and wide wings.

    Halo and wings are light that lens, window and sensor scatter. Angles are as seen from the camera, whatever the
    number of pixels; a pixel of a field of 5° over 1024 px subtends 85 µrad.
    """

    core_urad: float = Field(gt=0, le=1e5, description="standard deviation of the core")
    core_y_urad: float | None = Field(
        None, gt=0, le=1e5, description="standard deviation of the core along columns; default: core_urad"
    )
    halo_fraction: float = Field(0.0, ge=0, lt=1, description="fraction of the light that goes into the halo")
    halo_urad: float = Field(
        100.0, gt=0, le=1e6, description="angle beyond which the halo falls as a power: θ₀ of (1 + θ²/θ₀²)^(-p/2)"
    )
    halo_index: float = Field(3.0, gt=2, le=10, description="the power p")
    wing_fraction: float = Field(
        0.0, ge=0, lt=1, description="fraction of the light that goes into the wings, a second and wider halo"
    )
    wing_urad: float = Field(1e4, gt=0, le=1e6, description="angle beyond which the wings fall, as halo_urad")
    wing_index: float = Field(3.0, gt=2, le=10, description="their power, as halo_index")

    @model_validator(mode="after")
    def _light_left(self) -> PointSpreadTable:
        if self.halo_fraction + self.wing_fraction >= 1:
            raise ValueError(
                f"halo_fraction = {self.halo_fraction:g}, wing_fraction = {self.wing_fraction:g}: must be below 1 "
                "together"
            )
        return self


class CameraTable(Table):
    """Describe the camera and its exposure."""

    fov_deg: float = Field(
        65.0,
        ge=0.01,
        le=_WIDEST_DEG,
        description="full field of view across the width; default: that of focal_length_mm, lens or calibration, "
        "if given",
    )
    focal_length_mm: float | None = Field(
        None, ge=0.1, le=1e5, description="in place of fov_deg; default: that of fov_deg, or the lens's own"
    )
    width_px: int = Field(1024, ge=16, le=_MOST_PX, description="width of the image; default: a calibration's")
    height_px: int = Field(1024, ge=16, le=_MOST_PX, description="height of the image; default: a calibration's")
    lens: str = Field(
        "",
        description="a packaged lens or a prescription's TOML, as it is, or scaled to fov_deg or focal_length_mm; "
        "default: a thin lens",
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
    point_spread: PointSpreadTable | None = Field(
        None, description="of a thin lens; a prescription has its own; default: points stay points"
    )
    calibration: CalibrationTable | None = Field(
        None, description="of a thin lens: distortion and focal length as measured; default: rectilinear"
    )
    detector: str = Field(
        "",
        description="a packaged detector or a sensor's TOML, with a colour mosaic or monochrome; its numbers are "
        "those of the keys from pixel_pitch_um to quantum_efficiency_peak; default: three colours in every pixel, "
        "from these keys",
    )
    individuals: int = Field(
        1,
        ge=1,
        le=10_000,
        description="devices of the detector that the samples are taken with; each is in one split only, if there "
        "are as many as splits",
    )
    detector_temperature_K: float | None = Field(None, ge=100, le=400, description="default: the detector's own")
    stretch: float | None = Field(
        None,
        ge=0.3,
        le=1,
        description="of the detector's 8 bit image: exponent of the fraction of white, 0.5 for the square root "
        "that published flight images often have; default: the detector's own, 1 of the packaged ones",
    )
    black: Literal["dark", "bias"] | None = Field(
        None,
        description="what the detector's 8 bit image shows as 0: bias and mean dark signal, or the bias alone, so "
        "that the noise of the dark sky is not cut; default: the detector's own, dark of the packaged ones",
    )
    binning: int = Field(
        1,
        ge=1,
        le=16,
        description="pixels of the detector in each direction, of one colour, that are added to one of the image",
    )
    gain: float = Field(
        1.0,
        ge=1,
        le=1000,
        description="digital number per electron over the detector's own, as a higher ISO setting has it: white is "
        "reached by fewer electrons",
    )
    pixel_pitch_um: float = Field(5.5, ge=0.5, le=100, description="distance of neighbouring pixels")
    full_well_e: float = Field(13_500.0, ge=10, le=1e8, description="most electrons that a pixel holds")
    read_noise_e_rms: float = Field(13.0, ge=0, le=1e5, description="noise of one readout of a pixel")
    dark_current_e_s: float = Field(
        15.0,
        ge=0,
        le=1e9,
        description="default: a CMV4000's 125 e/s at 25 °C brought to 0 °C, halving every 8 K",
    )
    adc_bits: int = Field(12, ge=8, le=16, description="bits of the converter")
    bias_dn: int = Field(64, ge=0, le=1000, description="digital number without light")
    response: str = Field("nikon_5100", description="relative spectral response of the three colours")
    quantum_efficiency_peak: float = Field(
        0.5, gt=0, le=1, description="electrons per photon at the best wavelength"
    )
    exposure_s: Annotated[float, Field(gt=0, le=1e4)] | Literal["auto"] = Field(
        "auto", description="seconds, or metered on each clean frame"
    )
    exposure_min_s: float = Field(1e-5, gt=0, le=1e4, description="shortest exposure that 'auto' takes")
    exposure_max_s: float = Field(5.0, gt=0, le=1e4, description="longest exposure that 'auto' takes")
    exposure_max_towards_sun_s: float | None = Field(
        None,
        gt=0,
        le=1e4,
        description="longest exposure that 'auto' takes where the Sun is in the frame or within 10° of it, so that "
        "its veil does not cover the frame; default: exposure_max_s",
    )
    exposure_stops: pair_within(-10, 10) = Field(  # type: ignore[valid-type]
        (0.0, 0.0),
        description="the exposure of each sample is longer by 2 to a power drawn from this range, within "
        "exposure_min_s and exposure_max_s if it is metered",
    )
    metering_level: float = Field(
        0.75, gt=0, le=1, description="fraction of white given to metering_percentile of the sunlit pixels"
    )
    metering_percentile: float = Field(
        99.0, gt=0, le=100, description="percentile of the sunlit pixels that is brought to metering_level"
    )
    metering_delay_frames: int = Field(
        0,
        ge=0,
        le=10,
        description="by how many frames of its sequence an exposure lags behind the frame that is metered for it; "
        "0: each frame has its own",
    )
    architectures: tuple[Architecture, ...] = Field(
        ARCHITECTURES,
        min_length=1,
        description="architectures between which each sample draws",
    )
    readout_directions: tuple[ReadoutDirection, ...] = Field(
        READOUT_DIRECTIONS,
        min_length=1,
        description="directions of the readout between which each sample draws",
    )

    @model_validator(mode="after")
    def _of_the_lens(self) -> CameraTable:
        if self.lens and self.transmission is not None:
            raise ValueError(
                f"transmission = {self.transmission:g}: the lens has its own, of glass and coatings; leave one out"
            )
        if self.lens and self.point_spread is not None:
            raise ValueError("point_spread: the lens has its own, of rays and diffraction; leave one out")
        if not self.lens:  # with a prescription, None stays and means the prescription's own f-number
            for key, value in THIN_LENS.items():
                if getattr(self, key) is None:
                    object.__setattr__(self, key, value)
        return self

    @model_validator(mode="after")
    def _field(self) -> CameraTable:
        """Set the field of view: as given, or that of the focal length, or of the lens as it is."""
        if self.calibration is not None:
            return self._calibrated(self.calibration)
        given = self.model_fields_set
        focal_length_mm = self.focal_length_mm
        if focal_length_mm is None and (not self.lens or "fov_deg" in given):
            return self
        if "fov_deg" in given and self.detector.startswith("sha256:"):
            return self  # the scene of a store, which names files by their contents
        try:
            if focal_length_mm is None:
                from ..lens import load_lens, paraxial_properties

                focal_length_mm = paraxial_properties(load_lens(self.lens)).efl_mm
            pitch_um = self.pixel_pitch_um
            if self.detector:
                from ..detector import load_sensor

                pitch_um = load_sensor(self.detector).pixel_pitch_um
        except InputError as error:
            raise ValueError(f"{'lens' if focal_length_mm is None else 'detector'}: {error}") from None
        width_mm = self.width_px * self.binning * pitch_um * 1e-3
        fov_deg = math.degrees(2 * math.atan(width_mm / 2 / focal_length_mm))
        key = "lens" if self.focal_length_mm is None else "focal_length_mm"
        if not 0.01 <= fov_deg <= _WIDEST_DEG:
            raise ValueError(
                f"{key} = {getattr(self, key)!r}: {focal_length_mm:g} mm give {width_mm:g} mm of the detector a "
                f"field of {fov_deg:.3g} deg; must be from 0.01 to 140 deg"
            )
        if "fov_deg" in given and not math.isclose(fov_deg, self.fov_deg, rel_tol=1e-9):
            raise ValueError(
                f"focal_length_mm = {focal_length_mm:g}: gives a field of {fov_deg:.4g} deg, and fov_deg = "
                f"{self.fov_deg:g} another; leave one out"
            )
        object.__setattr__(self, "fov_deg", fov_deg)
        object.__setattr__(self, "focal_length_mm", focal_length_mm)
        return self

    def _calibrated(self, table: CalibrationTable) -> CameraTable:
        """Set the field of view to that of the calibration, and the numbers of its file in place of the file."""
        if self.lens:
            raise ValueError(
                f"calibration: camera.lens = {self.lens!r} has its own distortion, that of its rays; leave one out "
                "(vbnfault lens LENS --fit-opencv prints that distortion as OpenCV's coefficients)"
            )
        if self.focal_length_mm is not None:
            raise ValueError(
                f"focal_length_mm = {self.focal_length_mm:g}: the calibration has its own; leave one out"
            )
        named = _SIZE & self.model_fields_set
        unsized = set() if table.file else _SIZE - table.model_fields_set - named
        try:
            table = table.in_numbers(self.width_px, self.height_px)
            table.model_fields_set.difference_update(unsized)
            if not named and not table.scale_to_frame:
                for key in ("width_px", "height_px"):
                    if not 16 <= getattr(table, key) <= _MOST_PX:
                        raise InputError(f"{key} = {getattr(table, key)}: must be from 16 to {_MOST_PX}")
                    object.__setattr__(self, key, getattr(table, key))
            fov_deg = min(of_frame(table, self.width_px, self.height_px).fov_deg, _WIDEST_DEG)
        except InputError as error:
            if unsized or (isinstance(error, SizeMissing) and not named):
                return self  # it may hold in an image of one's own; a camera with the default size refuses it
            raise ValueError(f"calibration: {error}") from None
        if "fov_deg" in self.model_fields_set and not math.isclose(fov_deg, self.fov_deg, rel_tol=1e-9):
            raise ValueError(
                f"fov_deg = {self.fov_deg:g}: the calibration has a field of {fov_deg:.4g} deg; leave fov_deg out"
            )
        object.__setattr__(self, "calibration", table)
        object.__setattr__(self, "fov_deg", fov_deg)
        return self

    def of_image(self, width_px: int, height_px: int) -> CameraTable:
        """Return the camera with images of another size: a focal length stays, and so does a calibration.

        A calibration whose size was not given is of an image of this size. Raises InputError if one of another size
        must not be scaled.
        """
        size: dict[str, Any] = {"width_px": width_px, "height_px": height_px}
        if self.calibration is not None:
            of_it = {key: size[key] for key in self.unsized_calibration}
            size["calibration"] = self.calibration.model_copy(update=of_it)
        camera = self.model_copy(update=size)
        if self.calibration is not None or self.focal_length_mm is not None:
            camera.model_fields_set.discard("fov_deg")
        try:
            return camera._field()  # type: ignore[operator]
        except ValueError as error:
            raise InputError(f"camera.{error}") from None

    @property
    def unsized_calibration(self) -> set[str]:
        """Return the keys of a calibration's size that neither it nor the camera gives; empty without one."""
        return set() if self.calibration is None else _SIZE - self.calibration.model_fields_set

    @property
    def frame_calibration(self) -> Calibration | None:
        """Return the calibration of the frame; None for a camera without one."""
        if self.calibration is None:
            return None
        with under_key("camera.calibration"):
            return of_frame(self.calibration, self.width_px, self.height_px)

    @property
    def pixel_rad(self) -> float:
        """Return the angle that a pixel in the middle of the frame subtends."""
        if (calibration := self.frame_calibration) is not None:
            return 1 / calibration.focal_length_px
        return float(2 * np.tan(np.radians(self.fov_deg) / 2) / self.width_px)

    @model_validator(mode="after")
    def _known(self) -> CameraTable:
        if self.response not in spectra.RESPONSES:
            raise ValueError(
                f"response = {self.response!r}: must be one of {', '.join(spectra.RESPONSES)}; for a monochrome "
                'camera let detector name a sensor file with pattern = "mono"'
            )
        for key in ("lens_coating", "focus"):
            value = getattr(self, key)
            if not self.lens and value not in ("", "paraxial"):
                raise ValueError(f"{key} = {value!r}: needs lens")
        for key in OF_THE_DETECTOR if self.detector else OF_A_DETECTOR:
            if getattr(self, key) != CameraTable.model_fields[key].default:
                why = "the detector has its own; leave one out" if self.detector else "needs detector"
                raise ValueError(f"{key} = {getattr(self, key)!r}: {why}")
        if self.bias_dn >= 2**self.adc_bits - 1:
            most = 2**self.adc_bits - 2
            raise ValueError(f"bias_dn = {self.bias_dn}: must be from 0 to {most} with adc_bits = {self.adc_bits}")
        if self.exposure_min_s > self.exposure_max_s:
            raise ValueError(
                f"exposure_min_s = {self.exposure_min_s:g}, "
                f"exposure_max_s = {self.exposure_max_s:g}: bounds reversed"
            )
        return self


class RenderTable(Table):
    """Set the spectral bands and the sampling."""

    band_min_nm: float = Field(400.0, ge=280, le=3900, description="lower end of the spectral range")
    band_max_nm: float = Field(700.0, ge=290, le=4000, description="upper end of the spectral range")
    bands: int = Field(8, ge=1, le=64, description="number of spectral bands")
    samples_per_pixel: int = Field(16, ge=1, le=4096, description="a power of four: strata of each pixel")
    noise_fraction: float | None = Field(
        None,
        gt=0.01,
        le=10,
        description="most noise of sampling, over the sensor's own, in 99 % of lit pixels: more samples where it "
        "takes them; default: no more anywhere",
    )
    max_samples_per_pixel: int = Field(
        256,
        ge=1,
        le=4096,
        description="a power of four; for noise_fraction; the last of three rounds takes up to twice as many",
    )
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


_Place = Annotated[float, Field(ge=-1e6, le=1e6)]
ResponseCurve = Literal["linear", "srgb", "gamma", "table"]


class ImageTable(Table):
    """Describe images of one's own, into which `vbnfault inject` puts faults."""

    black_dn: float | None = Field(
        None, ge=-1e9, le=1e9, description="number without light; default: 0, of a raw mosaic the bias"
    )
    white_dn: float | None = Field(
        None,
        ge=-1e9,
        le=1e9,
        description="number at white; default: the largest of the data type, 1 of floats, of a raw mosaic that "
        "of the detector",
    )
    response: ResponseCurve = Field(
        "linear",
        description="how the numbers rise with the light: linear, srgb, gamma (to the power 1 / gamma), or table",
    )
    gamma: float = Field(2.2, ge=0.2, le=10, description="exponent of response = 'gamma'")
    response_file: str = Field(
        "",
        description="CSV of two rising columns, light and number, for response = 'table', from the file's folder",
    )
    sun: Literal["none", "auto"] | tuple[_Place, _Place] | tuple[_Place, _Place, _Place] = Field(
        "none",
        description="position of the Sun: 'auto' finds it as the saturated disc, two numbers are x and y in "
        "pixels, also beyond the frame, three a direction in the camera's axes",
    )
    raw: bool = Field(False, description="whether grey images are the raw mosaic of camera.detector")
    noise_free: bool = Field(
        False,
        description="whether the images are renders without noise: the camera adds the noise of the light and of "
        "its readout before the faults, and light above white saturates",
    )
    frames: tuple[Annotated[int, Field(ge=1, le=10_000_000)], ...] = Field(
        (), description="Number of images of each film or sequence, which vbnfault fills in"
    )
