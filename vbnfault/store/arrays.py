"""Describe every array of a store: its dimensions, dtype, unit and meaning.

This module holds plain data; it reads and writes no file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import NDArray

from ..core.quantities import DEFECTS, soft_kind
from ..scene.names import STRATA
from .compressors import ZSTD

# Codecs of the layers, from `benchmarks/codecs.py`. Words of Blosc are values that change together: a float, the
# three floats of a normal. Those of an image have two bytes: Blosc sorts the bits of single bytes without vector
# instructions, so that an image would take 1.4 times as long to decode, for 1 % more to 5 % fewer bytes. Blocks of
# 1 MiB: in those of 32 KiB that Blosc would choose, Zstd builds its tables so often that an image takes 1.6 times
# as long to decode, and 5 % more bytes. Every reader of Zarr v3 has these codecs, zarrita.js included. Plain Zstd
# codes a mask in a thousandth of its size; packing its bits first would save 3 to 10 kB more, and decoding would
# take five times as long.
_IMAGE = "blosc zstd 1 bitshuffle 2 1048576"
_RAW = "blosc zstd 1 shuffle 2 1048576"
_NORMAL = "blosc zstd 3 shuffle 6 1048576"
_HALF = "blosc zstd 1 shuffle 2 1048576"
_SINGLE = "blosc zstd 3 shuffle 4 1048576"
_DOUBLE = "blosc zstd 3 shuffle 8 1048576"

SEMANTIC = ("sky", "body", "sun", "spacecraft")


@dataclass(frozen=True)
class Array:
    """Describe one array of the schema.

    `units` are words of UDUNITS, or "1". `description` says what the values mean and how they were made. `codec` is
    the name of the codec that new stores use (`compressors`), and `ratio` the typical compressed size over the
    uncompressed size; `benchmarks/codecs.py` measures both.
    """

    long_name: str
    description: str
    axes: str = "sample"
    dtype: str = "float64"
    units: str = "1"
    names: tuple[str, ...] = ()  # CF flag meanings, of the values 0, 1, … or of the bits 0, 1, …
    bits: bool = False  # whether `names` are of bits
    codec: str = ZSTD
    ratio: float = 1.0
    most_bytes: int = 0  # of a text, as UTF-8

    @property
    def dims(self) -> tuple[str, ...]:
        """Return the names of the dimensions, in order."""
        return tuple(self.axes.split())

    @property
    def is_text(self) -> bool:
        """Return whether the values are strings."""
        return self.dtype == "str"

    @property
    def fill(self) -> Any:
        """Return the value that an unwritten sample has."""
        return "" if self.is_text else float("nan") if self.dtype == "float64" else 0


class Member(NamedTuple):
    """Describe the required layout of one array of the group; `create`, `verify` and `recover` use it.

    `values`: the values of a coordinate; None for an array that tasks write. `chunks`, `shards`: shapes of zarr's
    chunks and shards, at least 1 in every axis. `codec`: the name of the codec of its chunks.
    """

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    shards: tuple[int, ...] | None
    dtype: str
    fill: Any
    dims: tuple[str, ...]
    attributes: dict[str, Any]
    values: NDArray[Any] | tuple[str, ...] | None = None
    codec: str = ZSTD


_PIXELS = "sample y x channel"

# Layers (per-pixel arrays): a chunk holds one sample, and chunks are sharded. Those behind `clean` are optional;
# `StoreSpec.pixel_layers` makes the rows of `without_<fault>`.
LAYERS: dict[str, Array] = {
    "image": Array(
        "image with faults",
        "8 bit image as the camera delivers it, linear in light, with noise and every injected fault.",
        axes=_PIXELS,
        dtype="uint8",
        units="count",
        codec=_IMAGE,
        ratio=0.35,
    ),
    "mask": Array(
        "where each fault is, by its kind",
        "True in the pixels of a fault. The attributes rules and kinds say how the mask of each class is made.",
        axes="sample fault y x",
        dtype="bool",
        ratio=0.002,
    ),
    "mask_any": Array(
        "union of mask over the faults named here",
        "True where at least one of the classes in the attribute faults has its mask.",
        axes="sample y x",
        dtype="bool",
        ratio=0.004,
    ),
    "clean": Array(
        "same camera, exposure and noise, no fault",
        "The image as it would be without any fault: same view, camera, exposure and noise.",
        axes=_PIXELS,
        dtype="uint8",
        units="count",
        codec=_IMAGE,
        ratio=0.28,
    ),
    "mask_effect": Array(
        "where each fault changes the image",
        "True where the noise-free 8 bit image changes if this fault alone is switched off.",
        axes="sample fault y x",
        dtype="bool",
        ratio=0.006,
    ),
    "raw": Array(
        "raw mosaic of the analogue-to-digital converter",
        "Numbers of the converter before demosaicing, one colour filter for each pixel, with offset and noise.",
        axes="sample y x",
        dtype="uint16",
        units="count",
        codec=_RAW,
        ratio=0.52,
    ),
    "defects": Array(
        "what is wrong with a pixel of the mosaic",
        "Bits that say which defects the detector's pixel has; 0 is a sound pixel.",
        axes="sample y x",
        dtype="uint8",
        names=DEFECTS,
        bits=True,
        ratio=0.001,
    ),
    "depth_m": Array(
        "depth along the boresight, inf on the sky",
        "Distance of what the pixel's centre shows from the camera's plane, along the boresight.",
        axes="sample y x",
        dtype="float32",
        units="m",
        codec=_SINGLE,
        ratio=0.3,
    ),
    "normal": Array(
        "surface normal in C, 0 on the sky",
        "Unit vector out of the surface at the pixel's centre, in the camera's frame: x right, y down, z forward.",
        axes="sample y x xyz",
        dtype="float16",
        codec=_NORMAL,
        ratio=0.35,
    ),
    "semantic": Array(
        "what a pixel shows",
        "Class of what the pixel's centre shows, without faults.",
        axes="sample y x",
        dtype="uint8",
        names=SEMANTIC,
        ratio=0.004,
    ),
    "point_T_m": Array(
        "surface point in T, NaN on the sky",
        "Position of the ground at the pixel's centre in T, the frame fixed to the body.",
        axes="sample y x xyz",
        units="m",
        codec=_DOUBLE,
        ratio=0.9,
    ),
    "flow": Array(
        "motion in px to the next frame of the sequence, NaN where it is hidden or outside there",
        "Where what the pixel's centre shows appears in the next frame, minus where it is: columns and rows.",
        axes="sample y x xy",
        dtype="float32",
        codec=_SINGLE,
        ratio=0.7,
    ),
    "incidence_deg": Array(
        "normal to Sun, NaN on the sky",
        "Angle between the surface normal and the direction to the Sun; above 90 the ground faces away from it.",
        axes="sample y x",
        dtype="float32",
        units="degree",
        codec=_SINGLE,
        ratio=0.8,
    ),
    "emission_deg": Array(
        "normal to camera, NaN on the sky",
        "Angle between the surface normal and the direction to the camera.",
        axes="sample y x",
        dtype="float32",
        units="degree",
        codec=_SINGLE,
        ratio=0.8,
    ),
    "phase_deg": Array(
        "Sun to camera at the surface, NaN on the sky",
        "Angle at the ground between the directions to the Sun and to the camera.",
        axes="sample y x",
        dtype="float32",
        units="degree",
        codec=_SINGLE,
        ratio=0.7,
    ),
    "albedo": Array(
        "I/F at i = e = phase = 0 near 649 nm, spacecraft included, NaN on the sky",
        "Normal albedo of the ground or of the spacecraft's material, in the band of the scene closest to 649 nm.",
        axes="sample y x",
        dtype="float32",
        codec=_SINGLE,
        ratio=0.4,
    ),
    "radiance": Array(
        "radiance at the camera",
        "Spectral radiance that reaches the lens, without faults and noise, at the wavelengths of wavelength_nm.",
        axes="sample band y x",
        dtype="float16",
        units="W m-2 sr-1 nm-1",
        codec=_HALF,
        ratio=0.7,
    ),
    "scene_radiance": Array(
        "radiance before the lens, on the pinhole grid of the render with its guard band, without stars",
        "Spectral radiance of the scene as rendered, from which vbnfault retake makes other images of the view.",
        axes="sample band y_rendered x_rendered",
        dtype="float16",
        units="W m-2 sr-1 nm-1",
        codec=_HALF,
        ratio=0.7,
    ),
}
RADIANCE_LAYERS = ("radiance", "scene_radiance")  # their data type is `StoreSpec.radiance_dtype`


def without_row(fault: str) -> Array:
    """Return the schema row of the layer `without_<fault>`."""
    return Array(
        f"the image without {fault}",
        f"The image with every fault but {fault}: same view, camera, exposure and noise.",
        axes=_PIXELS,
        dtype="uint8",
        units="count",
        codec=_IMAGE,
        ratio=0.33,
    )


def soft_row(name: str, fault: str) -> Array:
    """Return the schema row of the soft layer `name` of a fault class."""
    kind = soft_kind(name)
    return Array(
        f"{fault}: {kind.meaning}",
        f"Strength of {fault} in each pixel, without the other faults; {kind.neutral:g} where it is absent.",
        axes="sample y x",
        dtype=kind.dtype,
        units="count" if kind.units == "DN" else kind.units,
        codec=_HALF if kind.dtype == "float16" else _SINGLE,
        ratio=0.4,
    )


# The rule for `mask_effect`, and for the mask of a class that is labelled by effect.
EFFECT_DN = 1
EFFECT_RULE = (
    f"a channel of the noise-free 8 bit image changes by {EFFECT_DN} DN or more when the fault is switched off "
    "and the others are kept"
)
MASK_ANY_RULE = "union of the masks of the classes in the attribute faults, which dataset.mask_any chose"
# Description of `mask_any` in stores with `StoreSpec.mask_any_joint`, which those of version 0.2 lack.
JOINT_ATTRIBUTES = {
    "long_name": "pixels that the faults named here mark or change",
    "description": "True where at least one of the classes in the attribute faults has its mask, or where all of "
    "them together change the image.",
    "rule": f"{MASK_ANY_RULE}; and the pixels where a channel of the noise-free 8 bit image changes by {EFFECT_DN} "
    "DN or more when all of these faults are switched off together and the others are kept",
}
# The layer of each kind of mask that a reader may ask for.
MASK_RULES = {"footprint": "mask", "effect": "mask_effect"}
REQUIRED_LAYERS = ("image", "mask", "mask_any", "clean")

# Scalars and small vectors: one chunk holds a whole shard, so that a task writes whole chunks.
SCALARS: dict[str, Array] = {
    "injected": Array(
        "faults that are in the pixels",
        "True for the classes that change this image. A commanded fault without any effect is not injected.",
        axes="sample fault",
        dtype="bool",
    ),
    "camera_position_T_m": Array(
        "camera position in T",
        "Position of the camera in T, the frame fixed to the body.",
        axes="sample xyz",
        units="m",
    ),
    "position_L_m": Array(
        "camera position in L, from the site",
        "Position of the camera in the local level frame L: x north, y east, z down.",
        axes="sample xyz",
        units="m",
    ),
    "camera_from_T": Array(
        "attitude, unit quaternion",
        "Rotation that takes vectors from T to the camera's frame C; w comes first.",
        axes="sample quaternion",
    ),
    "T_from_L": Array(
        "rotation from the local level frame to T",
        "Matrix that takes vectors from the local level frame of the site to the body's frame T.",
        axes="sample axis_row axis_col",
    ),
    "T_from_J": Array(
        "rotation from the inertial frame J to T",
        "Matrix that takes vectors from the inertial frame J, which does not turn with the body, to T.",
        axes="sample axis_row axis_col",
    ),
    "site_T_m": Array(
        "site, the origin of L, in T",
        "Position of the site on the body's surface, around which the terrain is refined.",
        axes="sample xyz",
        units="m",
    ),
    "sun_direction_T": Array(
        "unit vector towards the Sun in T", "Direction from the site to the centre of the Sun.", axes="sample xyz"
    ),
    "sun_distance_au": Array(
        "distance to the Sun", "Distance from the body to the Sun; it sets the sunlight.", units="au"
    ),
    "julian_date": Array(
        "Julian date (TDB)", "Time of the exposure as a Julian date in dynamical time.", units="d"
    ),
    "intrinsics": Array(
        "pinhole camera, pixel centres at +0.5",
        "Focal lengths and principal point in pixels, from the top left corner, as in OpenCV's camera matrix.",
        axes="sample intrinsic",
    ),
    "distortion": Array(
        "of the lens at 587.6 nm, as OpenCV takes it, for the intrinsics",
        "Coefficients of OpenCV's rational model of distortion, fitted to the chief rays of the lens.",
        axes="sample coefficient",
    ),
    "sun_azimuth_deg": Array(
        "Sun azimuth in L, from north towards east", "Direction of the Sun over the site's horizon.", units="degree"
    ),
    "sun_elevation_deg": Array(
        "Sun elevation in L, up", "Height of the Sun above the site's horizon.", units="degree"
    ),
    "roll_deg": Array(
        "tilt of the boresight from its stratum's reference about x",
        "First angle of the attitude; the attribute reference names the direction of each stratum.",
        units="degree",
    ),
    "pitch_deg": Array(
        "tilt of the boresight from its stratum's reference about y",
        "Second angle of the attitude; the attribute reference names the direction of each stratum.",
        units="degree",
    ),
    "yaw_deg": Array(
        "turn about the boresight, from that reference",
        "Third angle of the attitude; the attribute reference names the direction of each stratum.",
        units="degree",
    ),
    "sun_xy_px": Array(
        "Sun centre in the image, NaN behind the camera",
        "Column and row of the Sun's centre in pixels, from the top left corner; it may lie outside the image.",
        axes="sample xy",
    ),
    "sun_visible_fraction": Array(
        "part of the solar disc that is not occluded",
        "Seen from the camera: 1 is the whole disc, 0 a Sun behind the ground or the spacecraft.",
    ),
    "exposure_s": Array(
        "exposure time",
        "Metered once on the image without noise and faults, and shared by every twin of the sample.",
        units="s",
    ),
    "samples_per_pixel": Array(
        "mean number of render samples a pixel",
        "Larger than the number of the scene where the render had to reduce its noise.",
    ),
    "noise_fraction_p99": Array(
        "noise of sampling over the sensor's, 99th percentile of lit pixels; NaN: not asked",
        "Standard deviation of the render in units of that of the sensor, over the lit pixels.",
    ),
    "tries": Array(
        "views drawn, of which the last was kept", "A view is drawn again if it is refused.", dtype="int32"
    ),
    "views": Array(
        "views rendered, of which the last shows every commanded fault",
        "More than 1 where a commanded fault did not show at first.",
        dtype="int32",
    ),
    "resolved": Array(
        "the pose meets every condition of the scene",
        "False if no view that met them was drawn; the sample then holds the last one.",
        dtype="bool",
    ),
    "stratum": Array(
        "stratum of the sampling", "Whether the view was drawn to face the Sun.", dtype="uint8", names=STRATA
    ),
    "site": Array(
        "index of the site", "Position in the attribute names; a site is in one split only.", dtype="int32"
    ),
    "lens": Array("index of the lens", "Position in the attribute names.", dtype="int32"),
    "detector_individual": Array(
        "index of the individual detector",
        "Position in the attribute names; each individual has its own defects.",
        dtype="int32",
    ),
    "split": Array(
        "split of the dataset, constant per site",
        "train, val or test; samples of one site or one view are never in two splits.",
        dtype="str",
        most_bytes=64,
    ),
    "parameters": Array(
        "drawn parameters of every injected fault, JSON",
        "By class, the model and the drawn values from which the fault can be injected again.",
        dtype="str",
        most_bytes=2 << 20,
    ),
    "proposal": Array(
        "proposed variables before redraws, JSON",
        "What the plan drew for the sample before any rendering: its view and its commanded faults.",
        dtype="str",
        most_bytes=1 << 18,
    ),
}
# Stores whose samples are frames of sequences have these scalars, too.
OF_SEQUENCES: dict[str, Array] = {
    "sequence": Array(
        "index of the sequence",
        "Position in the attribute names. Frames of a sequence share camera, device, dirt and wear.",
        dtype="int32",
    ),
    "frame": Array("number of the frame in its sequence", "From 0, in the order of time.", dtype="int32"),
    "time_s": Array(
        "time of the frame in its sequence",
        "As the table of poses counts it, or from the date of the sequence's first frame.",
        units="s",
    ),
    "velocity_T_m_s": Array(
        "velocity of the camera over the ground, in T",
        "As the table of poses has it, or from the frames before and after.",
        axes="sample xyz",
        units="m s-1",
    ),
    "rate_C_rad_s": Array(
        "rate at which the camera turns over the ground, in C",
        "Angular velocity; as the table of poses has it, or from the frames before and after.",
        axes="sample xyz",
        units="rad s-1",
    ),
}
# What says that the others are whole.
CRC32C = Array(
    "CRC-32C of the decoded bytes",
    "Checksum of every layer of a sample, and one of all its scalars; vbnfault verify compares them.",
    axes="sample layer",
    dtype="uint32",
)
DONE = Array(
    "1 where a sample is whole; written last",
    "0 where a sample is not built yet; its other values are then not valid.",
    dtype="uint8",
)
