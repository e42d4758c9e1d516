"""Define the schema: every array of a store with its dimensions, dtype, unit and layout.

This module holds plain data; it reads and writes no file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.quantities import CHANNELS, DEFECTS, soft_kind
from ..scene.names import SPLITS, STRATA

# Format version → the first version of vbnfault that wrote it. A store of another format is refused in a sentence
# and left as it is: its arrays could not be distinguished from damaged ones, and the samples that are missing would
# come from other code. xarray reads the stores of every format. The way from one format to the next is:
#
# 1 → 2: build again. `spare` and the checksum of the root are new, `distortion` has eight coefficients instead of
#        five, `split` is a string instead of a number, and `resolved` and `views` are new. The samples of format 1
#        do not say what these two hold, and were made by other code, so no program can convert a store.
#
# A format whose arrays all follow from those of the one before needs no new build: then `recover`, which brings the
# metadata to the schema under the lock of a build, is the place to convert, before `_check_format` refuses.
FORMATS = {1: "0.1", 2: "0.2"}
FORMAT_VERSION = max(FORMATS)
SEMANTIC = ("sky", "body", "sun", "spacecraft")

# Root attributes that say when or how a store was written. The digest leaves them out.
VOLATILE_ATTRIBUTES = ("created", "modified", "command")

MAX_SHARD_SAMPLES = 16
MAX_SHARD_BYTES = 2**30
MAX_HELD_BYTES = 2**31  # all layers of a shard, uncompressed: a task may have to hold them in memory

_SCALARS = "scalars"  # the entry of the `layer` axis that stands for all scalars of a sample


@dataclass(frozen=True)
class Array:
    """Describe one array of the schema. `ratio` is its typical compressed size over the uncompressed size."""

    dimensions: str
    dtype: str
    units: str
    long_name: str
    names: tuple[str, ...] = ()  # CF flag meanings, of the values 0, 1, … or of the bits 0, 1, …
    bits: bool = False  # whether `names` are of bits
    ratio: float = 1.0

    @property
    def dims(self) -> tuple[str, ...]:
        """Return the names of the dimensions, in order."""
        return tuple(self.dimensions.split())

    @property
    def is_text(self) -> bool:
        """Return whether the values are strings."""
        return self.dtype == "str"

    @property
    def fill(self) -> Any:
        """Return the value that an unwritten sample has."""
        return "" if self.is_text else float("nan") if self.dtype == "float64" else 0


_IMAGE = "sample y x channel"

# Layers (per-pixel arrays): a chunk holds one sample, and chunks are sharded.
LAYERS: dict[str, Array] = {
    "image": Array(_IMAGE, "uint8", "DN", "image with faults", ratio=0.45),
    "mask": Array("sample fault y x", "bool", "1", "where each fault is, by its kind", ratio=0.005),
    "mask_any": Array("sample y x", "bool", "1", "union of mask over the faults named here", ratio=0.005),
    "clean": Array(_IMAGE, "uint8", "DN", "same camera, exposure and noise, no fault", ratio=0.45),
    # the layers from here on are optional; `StoreSpec.pixel_layers` makes the rows of `without_<fault>`
    "mask_effect": Array("sample fault y x", "bool", "1", "where each fault changes the image", ratio=0.02),
    "raw": Array("sample y x", "uint16", "DN", "raw mosaic of the analogue-to-digital converter", ratio=0.6),
    "defects": Array(
        "sample y x", "uint8", "1", "what is wrong with a pixel of the mosaic", DEFECTS, bits=True, ratio=0.01
    ),
    "depth_m": Array("sample y x", "float32", "m", "depth along the boresight, inf on the sky", ratio=0.5),
    "normal": Array("sample y x xyz", "float16", "1", "surface normal in C, 0 on the sky", ratio=0.55),
    "semantic": Array("sample y x", "uint8", "1", "what a pixel shows", SEMANTIC, ratio=0.01),
    "point_T_m": Array("sample y x xyz", "float64", "m", "surface point in T, NaN on the sky", ratio=0.9),
    "incidence_deg": Array("sample y x", "float32", "deg", "normal to Sun, NaN on the sky", ratio=0.8),
    "emission_deg": Array("sample y x", "float32", "deg", "normal to camera, NaN on the sky", ratio=0.8),
    "phase_deg": Array("sample y x", "float32", "deg", "Sun to camera at the surface, NaN on the sky", ratio=0.7),
    "albedo": Array(
        "sample y x",
        "float32",
        "1",
        "I/F at i = e = phase = 0 near 649 nm, spacecraft included, NaN on the sky",
        ratio=0.4,
    ),
    "radiance": Array("sample band y x", "float16", "W m-2 sr-1 nm-1", "radiance at the camera", ratio=0.7),
    "scene_radiance": Array(
        "sample band y_rendered x_rendered",
        "float16",
        "W m-2 sr-1 nm-1",
        "radiance before the lens, on the pinhole grid of the render with its guard band, without stars",
        ratio=0.7,
    ),
}
RADIANCE_LAYERS = ("radiance", "scene_radiance")  # their data type is `StoreSpec.radiance_dtype`
# The rule for `mask_effect`, and for the mask of a class that is labelled by effect.
EFFECT_DN = 1
EFFECT_RULE = (
    f"a channel of the noise-free 8 bit image changes by {EFFECT_DN} DN or more when the fault is switched off "
    "and the others are kept"
)
MASK_ANY_RULE = "union of the masks of the classes in the attribute faults, which dataset.mask_any chose"
REQUIRED_LAYERS = ("image", "mask", "mask_any", "clean")

# Scalars and small vectors: one chunk holds a whole shard, so that a task writes whole chunks.
SCALARS: dict[str, Array] = {
    "injected": Array("sample fault", "bool", "1", "faults that are in the pixels"),
    "camera_position_T_m": Array("sample xyz", "float64", "m", "camera position in T"),
    "position_L_m": Array("sample xyz", "float64", "m", "camera position in L, from the site"),
    "camera_from_T": Array("sample quaternion", "float64", "1", "attitude, unit quaternion"),
    "T_from_L": Array("sample axis_row axis_col", "float64", "1", "rotation from the local level frame to T"),
    "T_from_J": Array("sample axis_row axis_col", "float64", "1", "rotation from the inertial frame J to T"),
    "site_T_m": Array("sample xyz", "float64", "m", "site, the origin of L, in T"),
    "sun_direction_T": Array("sample xyz", "float64", "1", "unit vector towards the Sun in T"),
    "sun_distance_au": Array("sample", "float64", "au", "distance to the Sun"),
    "julian_date": Array("sample", "float64", "d", "Julian date (TDB)"),
    "intrinsics": Array("sample intrinsic", "float64", "px", "pinhole camera, pixel centres at +0.5"),
    "distortion": Array(
        "sample coefficient", "float64", "1", "of the lens at 587.6 nm, as OpenCV takes it, for the intrinsics"
    ),
    "sun_azimuth_deg": Array("sample", "float64", "deg", "Sun azimuth in L, from north towards east"),
    "sun_elevation_deg": Array("sample", "float64", "deg", "Sun elevation in L, up"),
    "roll_deg": Array("sample", "float64", "deg", "tilt of the boresight from its stratum's reference about x"),
    "pitch_deg": Array("sample", "float64", "deg", "tilt of the boresight from its stratum's reference about y"),
    "yaw_deg": Array("sample", "float64", "deg", "turn about the boresight, from that reference"),
    "sun_xy_px": Array("sample xy", "float64", "px", "Sun centre in the image, NaN behind the camera"),
    "sun_visible_fraction": Array("sample", "float64", "1", "part of the solar disc that is not occluded"),
    "exposure_s": Array("sample", "float64", "s", "exposure time"),
    "samples_per_pixel": Array("sample", "float64", "1", "mean number of render samples a pixel"),
    "noise_fraction_p99": Array(
        "sample",
        "float64",
        "1",
        "noise of sampling over the sensor's, 99th percentile of lit pixels; NaN: not asked",
    ),
    "tries": Array("sample", "int32", "1", "views drawn, of which the last was kept"),
    "views": Array("sample", "int32", "1", "views rendered, of which the last shows every commanded fault"),
    "resolved": Array("sample", "bool", "1", "the pose meets every condition of the scene"),
    "stratum": Array("sample", "uint8", "1", "stratum of the sampling", STRATA),
    "site": Array("sample", "int32", "1", "index of the site"),
    "lens": Array("sample", "int32", "1", "index of the lens"),
    "detector_individual": Array("sample", "int32", "1", "index of the individual detector"),
    "split": Array("sample", "str", "1", "split of the dataset, constant per site"),
    "parameters": Array("sample", "str", "1", "drawn parameters of every injected fault, JSON"),
    "proposal": Array("sample", "str", "1", "proposed variables before redraws, JSON"),
}

_LABELS = {  # coordinates of the short axes
    "channel": CHANNELS,
    "xyz": ("x", "y", "z"),
    "axis_row": ("x", "y", "z"),
    "axis_col": ("x", "y", "z"),
    "xy": ("x", "y"),
    "quaternion": ("w", "x", "y", "z"),
    "intrinsic": ("fx", "fy", "cx", "cy"),
    "coefficient": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}


class Member(NamedTuple):
    """Describe the required layout of one array of the group; `create`, `verify` and `recover` use it.

    `values`: the values of a coordinate; None for an array that tasks write. `chunks`, `shards`: shapes of zarr's
    chunks and shards, at least 1 in every axis.
    """

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    shards: tuple[int, ...] | None
    dtype: str
    fill: Any
    dims: tuple[str, ...]
    attributes: dict[str, Any]
    values: NDArray[Any] | tuple[str, ...] | None = None


def _coordinate(dim: str, values: NDArray[Any] | tuple[str, ...], **attributes: str) -> Member:
    """Return the entry of `StoreSpec.members` for the coordinate of one axis."""
    dtype, fill = (values.dtype.name, 0) if isinstance(values, np.ndarray) else ("str", "")
    chunks = (65536 if dim == "sample" else max(1, len(values)),)
    return Member((len(values),), chunks, None, dtype, fill, (dim,), attributes, values)


@dataclass(frozen=True, kw_only=True)
class StoreSpec:
    """Describe the arrays of a store, with their sizes, names and attributes, as plain data.

    Parameters
    ----------
    height, width
        Image size in pixels.
    faults
        The fault axis, in dataset order.
    mask_any_faults
        The classes whose masks `mask_any` unites.
    wavelength_nm
        Nodes of the bands of `radiance` and `scene_radiance`.
    layers
        Optional layers: names in `LAYERS` or `soft_layers`, or `without_<fault>`.
    localised_faults
        The classes whose mask is never empty if they are injected; `mask_any_faults` by default.
    mask_kinds, mask_rules
        For each of `faults`, the kind of its mask, and the rule as a sentence.
    soft_layers
        For each of `faults`, the name of its soft layer, or "".
    site_names, lens_names, detector_names
        Names that the integer arrays `site`, `lens` and `detector_individual` index.
    sample_names
        Names of the samples, at least as many as there are samples, if the rows of a trajectory name them; they
        become the coordinate `name`.
    distortion_residual_px
        Root mean square and maximum deviation of the stored distortion coefficients from the lens's chief rays,
        over the lit frame.
    attitude_references
        For each of `STRATA`, the direction from which roll, pitch and yaw are measured: "sun", "nadir" or "centre".
    centre_of_mass_T_m
        The body's centre of mass in T, which the reference "centre" names; stored only with this reference.
    radiance_dtype
        Data type of the layers `RADIANCE_LAYERS`: float16 or float32.
    rendered_shape
        Rows and columns of `scene_radiance`, which has a guard band around the image; () if it is not stored.
    shard_samples
        Samples a shard. 0 chooses the largest number up to 16 for which the largest array of a shard stays within
        1 GiB and all layers within 2 GiB. A number that is too large is lowered to its largest divisor within these
        limits.
    attributes
        JSON-able root attributes.

    Raises
    ------
    InputError
        For a layer or fault that does not exist.
    """

    height: int
    width: int
    faults: tuple[str, ...]
    mask_any_faults: tuple[str, ...]
    wavelength_nm: tuple[float, ...] = ()
    layers: tuple[str, ...] = ()
    localised_faults: tuple[str, ...] | None = None
    mask_kinds: tuple[str, ...] = ()
    mask_rules: tuple[str, ...] = ()
    soft_layers: tuple[str, ...] = ()
    site_names: tuple[str, ...] = ()
    lens_names: tuple[str, ...] = ()
    distortion_residual_px: tuple[float, float] = (0.0, 0.0)
    attitude_references: tuple[str, ...] = ("sun", "sun")
    centre_of_mass_T_m: tuple[float, float, float] | None = None
    detector_names: tuple[str, ...] = ()
    sample_names: tuple[str, ...] = ()
    radiance_dtype: str = "float16"
    rendered_shape: tuple[int, ...] = ()
    shard_samples: int = 0
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        allowed = {*LAYERS, *(f"without_{f}" for f in self.faults), *filter(None, self.soft_layers)}
        for name in self.layers:
            if name not in allowed:
                raise InputError(f"layers: {name!r} is no layer; known: {', '.join(sorted(allowed))}")
        for name in (*self.mask_any_faults, *(self.localised_faults or ())):
            if name not in self.faults:
                known = ", ".join(self.faults) or "no faults"
                raise InputError(f"mask_any_faults: {name!r} is not one of {known}")
        if self.localised_faults is None:
            object.__setattr__(self, "localised_faults", self.mask_any_faults)
        sizes = [self.layer_bytes(name) for name in self.pixel_layers]
        most = max(1, min(MAX_SHARD_SAMPLES, MAX_SHARD_BYTES // max(sizes), MAX_HELD_BYTES // sum(sizes)))
        wished = self.shard_samples if self.shard_samples > 0 else most
        # the plan assigns sites to groups of the wished size; a divisor keeps each shard within one group
        size = next(n for n in range(min(wished, most), 0, -1) if wished % n == 0)
        object.__setattr__(self, "shard_samples", size)

    @cached_property
    def pixel_layers(self) -> dict[str, Array]:
        """Return the schema row of every layer by name, in the order of the `layer` axis."""
        layers = {name: LAYERS[name] for name in REQUIRED_LAYERS}
        for name in self.layers:
            if name in RADIANCE_LAYERS:
                layers[name] = replace(LAYERS[name], dtype=self.radiance_dtype)
            elif name in LAYERS:
                layers[name] = LAYERS[name]
            elif name in self.soft_layers:
                kind, fault = soft_kind(name), self.faults[self.soft_layers.index(name)]
                layers[name] = Array("sample y x", kind.dtype, kind.units, f"{fault}: {kind.meaning}", ratio=0.4)
            else:
                without = name.removeprefix("without_")
                layers[name] = Array(_IMAGE, "uint8", "DN", f"the image without {without}", ratio=0.45)
        return layers

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Return the schema row by name of every array that tasks write."""
        crc32c = Array("sample layer", "uint32", "1", "CRC-32C of the decoded bytes")
        done = Array("sample", "uint8", "1", "1 where a sample is whole; written last")
        return {**self.pixel_layers, **SCALARS, "crc32c": crc32c, "done": done}

    @property
    def checked(self) -> tuple[str, ...]:
        """Return the labels of the `layer` axis of `crc32c`: every layer, then all scalars together."""
        return (*self.pixel_layers, _SCALARS)

    def shape(self, row: Array) -> tuple[int, ...]:
        """Return the shape of one sample of an array: its dimensions without `sample`."""
        sizes = {
            "y": self.height,
            "x": self.width,
            **dict(
                zip(("y_rendered", "x_rendered"), self.rendered_shape or (self.height, self.width), strict=True)
            ),
            "fault": len(self.faults),
            "band": len(self.wavelength_nm),
            "layer": len(self.checked),
            **{name: len(labels) for name, labels in _LABELS.items()},
        }
        return tuple(sizes[d] for d in row.dims if d != "sample")

    def empty(self, name: str) -> bool:
        """Return whether an axis of an array has length 0, as in `mask` without fault classes.

        Such an array has no data files.
        """
        return 0 in self.shape(self.arrays[name])

    def members(self, samples: int) -> dict[str, Member]:
        """Return the required layout by name of every array of a store of `samples` samples, coordinates last."""
        attitude: dict[str, Any] = {"reference": dict(zip(STRATA, self.attitude_references, strict=True))}
        if "centre" in self.attitude_references:
            attitude["centre_of_mass_T_m"] = self.centre_of_mass_T_m and list(self.centre_of_mass_T_m)
        extra: dict[str, dict[str, Any]] = {
            "mask": {"kinds": list(self.mask_kinds), "rules": list(self.mask_rules)} if self.mask_kinds else {},
            "mask_effect": {"threshold_dn": EFFECT_DN, "rule": EFFECT_RULE},
            "mask_any": {"faults": list(self.mask_any_faults), "rule": MASK_ANY_RULE},
            "site": {"names": list(self.site_names)},
            "lens": {"names": list(self.lens_names)},
            "distortion": {
                "residual_px_rms": self.distortion_residual_px[0],
                "residual_px_max": self.distortion_residual_px[1],
            },
            **dict.fromkeys(("roll_deg", "pitch_deg", "yaw_deg"), attitude),
            "detector_individual": {"names": list(self.detector_names)},
            "split": {"names": list(SPLITS)},
            **{name: {"coordinates": "wavelength_nm"} for name in RADIANCE_LAYERS},
        }
        size = self.shard_samples
        members = {}
        for name, row in self.arrays.items():
            shape = self.shape(row)
            chunk = tuple(max(1, n) for n in shape)
            sharded = name in self.pixel_layers
            attributes: dict[str, Any] = {"long_name": row.long_name, "units": row.units}
            if row.names:
                values = [1 << k if row.bits else k for k in range(len(row.names))]
                attributes["flag_masks" if row.bits else "flag_values"] = values
                attributes["flag_meanings"] = " ".join(row.names)
            members[name] = Member(
                shape=(samples, *shape),
                chunks=(1 if sharded else size, *chunk),
                shards=(size, *chunk) if sharded else None,
                dtype=row.dtype,
                fill=row.fill,
                dims=row.dims,
                attributes={**attributes, **extra.get(name, {})},
            )
        return {**members, **self.coordinates(samples)}

    def coordinates(self, samples: int) -> dict[str, Member]:
        """Return the required layout by name of every coordinate of a store of `samples` samples."""
        y, x = np.arange(self.height) + 0.5, np.arange(self.width) + 0.5
        nodes = np.array(self.wavelength_nm, dtype=np.float64)
        bands = {"wavelength_nm": _coordinate("band", nodes, units="nm", long_name="wavelength of the band")}
        return {
            "y": _coordinate("y", y, units="px", long_name="row, pixel centres at +0.5"),
            "x": _coordinate("x", x, units="px", long_name="column, pixel centres at +0.5"),
            "fault": _coordinate("fault", self.faults, long_name="fault class"),
            "layer": _coordinate("layer", self.checked, long_name="what a checksum covers"),
            **{name: _coordinate(name, tuple(labels), long_name=name) for name, labels in _LABELS.items()},
            **(bands if self.wavelength_nm else {}),
            **self._rendered_coordinates(),
            **(
                {"name": _coordinate("sample", self.sample_names[:samples], long_name="name of the sample")}
                if self.sample_names
                else {}
            ),
            "sample": _coordinate("sample", np.arange(samples, dtype=np.int64), long_name="sample"),
        }

    def _rendered_coordinates(self) -> dict[str, Member]:
        """Return the coordinates of the grid of `scene_radiance`: those of the image, continued beyond it."""
        if not self.rendered_shape:
            return {}
        out = {}
        for dim, size, of_image in zip("yx", self.rendered_shape, (self.height, self.width), strict=True):
            values = np.arange(size) + 0.5 - (size - of_image) / 2
            name = f"{dim}_rendered"
            out[name] = _coordinate(name, values, units="px", long_name="pixel centres, 0 at the image's border")
        return out

    def layer_bytes(self, name: str) -> int:
        """Return the uncompressed size of one sample of a layer, in bytes."""
        row = self.pixel_layers[name]
        return int(np.prod(self.shape(row), dtype=np.int64)) * np.dtype(row.dtype).itemsize

    @property
    def estimated_sample_bytes(self) -> int:
        """Approximate size of a sample on disk, in bytes."""
        pixels = sum(self.layer_bytes(name) * row.ratio for name, row in self.pixel_layers.items())
        return int(pixels) + 4096

    def plain(self) -> dict[str, Any]:
        """Return the fields as plain data, without the root attributes; `spec_from_plain` reads them back."""
        # asdict would copy the whole scene first
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "attributes"}
        if not self.sample_names:
            del plain["sample_names"]  # stores without names stay as they were
        if not self.rendered_shape:
            del plain["rendered_shape"]
        return plain


def spec_from_plain(plain: Mapping[str, Any], attributes: Mapping[str, Any]) -> StoreSpec:
    """Return the StoreSpec that the result of `StoreSpec.plain` and a store's root attributes describe."""
    known = {f.name for f in fields(StoreSpec)}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in plain.items() if k in known}
    return StoreSpec(**values, attributes=attributes)
