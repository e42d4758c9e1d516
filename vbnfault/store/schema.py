"""Define the schema: every array of a store with its dimensions, dtype, unit and layout.

This module holds plain data; it reads and writes no file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.calibration import COEFFICIENTS
from ..core.errors import InputError
from ..core.quantities import CHANNELS
from ..scene.names import SPLITS, STRATA
from .arrays import (
    CRC32C,
    DONE,
    EFFECT_DN,
    EFFECT_RULE,
    JOINT_ATTRIBUTES,
    LAYERS,
    MASK_ANY_RULE,
    OF_SEQUENCES,
    RADIANCE_LAYERS,
    REQUIRED_LAYERS,
    SCALARS,
    Array,
    Member,
    soft_row,
    without_row,
)
from .attributes import check_plain_spec
from .compressors import ZSTD, fitting

# Number of the format of stores. Version 0.1 of vbnfault wrote format 1, and every version since writes format 3.
# Digests count formats from DIGEST_VERSION on as one, because their values are the same.
FORMAT_VERSION = 3
DIGEST_VERSION = 2
# Root attributes that say when or how a store was written. The digest leaves them out.
VOLATILE_ATTRIBUTES = ("created", "modified", "command")

MAX_SHARD_SAMPLES = 16
MAX_SHARD_BYTES = 2**30
MAX_HELD_BYTES = 2**31  # all layers of a shard, uncompressed: a task may have to hold them in memory

MAX_SAMPLE_BYTES = 2**34  # all layers of a sample, uncompressed

_SCALARS = "scalars"  # the entry of the `layer` axis that stands for all scalars of a sample


RATIONAL = COEFFICIENTS["opencv"][:8]  # of the distortion of cameras without a calibration
# Fields that older stores lack, with their defaults, which are not written: such stores stay as they were.
_LATER = {
    "sample_names": (),
    "sequence_names": (),
    "rendered_shape": (),
    "mask_any_joint": False,
    "distortion_valid_to_deg": None,
    "distortion_model": "",
    "coefficients": RATIONAL,
    "skew_px": 0.0,
}
# Fields that alter no decoded value: neither digests nor comparisons know them.
_NO_DATA = ("shard_samples", "codecs", "distortion_valid_to_deg")
_LABELS = {  # coordinates of the short axes
    "channel": CHANNELS,
    "xyz": ("x", "y", "z"),
    "axis_row": ("x", "y", "z"),
    "axis_col": ("x", "y", "z"),
    "xy": ("x", "y"),
    "quaternion": ("w", "x", "y", "z"),
    "intrinsic": ("fx", "fy", "cx", "cy"),
}
_CALIBRATED = {  # attributes of the distortion of a calibrated camera
    "long_name": "of the calibration, for the intrinsics",
    "description": "Coefficients of the camera's calibration: of cv2.projectPoints for the model opencv, of "
    "cv2.fisheye.projectPoints for fisheye; undistorting takes image positions to tangents.",
}
_DESCRIPTIONS = {  # of the coordinates
    "y": "Minus the coordinate row: it falls from the top of an image to its bottom, so that plots stand upright.",
    "row": "Distance of a pixel's centre from the upper edge of the image in pixels, downwards; the first is 0.5.",
    "x": "Distance of a pixel's centre from the left edge of the image in pixels; the first is 0.5.",
    "y_rendered": "The coordinate y, continued beyond the image onto the guard band of the render.",
    "x_rendered": "The coordinate x, continued beyond the image onto the guard band of the render.",
    "fault": "Name of the fault class.",
    "layer": "Name of the layer that a checksum covers; scalars stands for all values that are not layers.",
    "channel": "Colour of the channel; I is the intensity.",
    "xyz": "Axis of a vector.",
    "axis_row": "Axis of a matrix's row.",
    "axis_col": "Axis of a matrix's column.",
    "xy": "Axis of a position in the image.",
    "quaternion": "Component of a unit quaternion.",
    "intrinsic": "Focal lengths along x and y, and principal point.",
    "coefficient": "Coefficient of OpenCV's rational model of distortion.",
    "wavelength_nm": "Wavelength that stands for a band of the radiance.",
    "name": "Name of the sample in the table of poses.",
    "sample": "Index of the sample, from 0.",
}


def _coordinate(name: str, dim: str, values: NDArray[Any] | tuple[str, ...], long_name: str, **more: str) -> Member:
    """Return the entry of `StoreSpec.members` for the coordinate `name` along one axis."""
    dtype, fill = (values.dtype.name, 0) if isinstance(values, np.ndarray) else ("str", "")
    chunks = (65536 if dim == "sample" else max(1, len(values)),)
    attributes = {"long_name": long_name, "units": "1", "description": _DESCRIPTIONS[name], **more}
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
    mask_any_joint
        Whether `mask_any` also holds the pixels that these classes change together.
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
    sequence_names
        Names that the integer array `sequence` indexes; () for a store without sequences, which lacks the arrays
        `OF_SEQUENCES`.
    distortion_residual_px
        Root mean square and maximum deviation of the stored distortion coefficients from the lens's chief rays,
        over the lit frame.
    distortion_valid_to_deg
        Angle from the boresight up to which the stored distortion coefficients hold; None in older stores.
    distortion_model
        Model of a calibrated camera's distortion, a key of `core.calibration.COEFFICIENTS`; "" for the rational
        model of other cameras.
    coefficients
        Names of the coefficients of the distortion, in order.
    skew_px
        Skew of a calibrated camera in px.
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
    codecs
        Names of the codecs of the layers, by layer; those of `Array.codec` by default.
    attributes
        JSON-able root attributes.

    Raises
    ------
    InputError
        For a layer, a fault or a codec that does not exist.
    """

    height: int
    width: int
    faults: tuple[str, ...]
    mask_any_faults: tuple[str, ...]
    wavelength_nm: tuple[float, ...] = ()
    layers: tuple[str, ...] = ()
    mask_any_joint: bool = False
    localised_faults: tuple[str, ...] | None = None
    mask_kinds: tuple[str, ...] = ()
    mask_rules: tuple[str, ...] = ()
    soft_layers: tuple[str, ...] = ()
    site_names: tuple[str, ...] = ()
    lens_names: tuple[str, ...] = ()
    distortion_residual_px: tuple[float, float] = (0.0, 0.0)
    distortion_valid_to_deg: float | None = None
    distortion_model: str = ""
    coefficients: tuple[str, ...] = RATIONAL
    skew_px: float = 0.0
    attitude_references: tuple[str, ...] = ("sun", "sun")
    centre_of_mass_T_m: tuple[float, float, float] | None = None
    detector_names: tuple[str, ...] = ()
    sample_names: tuple[str, ...] = ()
    sequence_names: tuple[str, ...] = ()
    radiance_dtype: str = "float16"
    rendered_shape: tuple[int, ...] = ()
    shard_samples: int = 0
    codecs: Mapping[str, str] = field(default_factory=dict)
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
        if sum(sizes) > MAX_SAMPLE_BYTES:
            raise InputError(
                f"the layers of one sample take {sum(sizes) / 2**30:.1f} GiB: at most {MAX_SAMPLE_BYTES >> 30}; "
                "store fewer layers or smaller images"
            )
        most = max(1, min(MAX_SHARD_SAMPLES, MAX_SHARD_BYTES // max(sizes), MAX_HELD_BYTES // sum(sizes)))
        wished = self.shard_samples if self.shard_samples > 0 else most
        # the plan assigns sites to groups of the wished size; a divisor keeps each shard within one group
        size = next(n for n in range(min(wished, most), 0, -1) if wished % n == 0)
        object.__setattr__(self, "shard_samples", size)
        codecs = {name: self.codecs.get(name, row.codec) for name, row in self.pixel_layers.items()}
        codecs = {name: fitting(codec, self.layer_bytes(name)) for name, codec in codecs.items()}
        object.__setattr__(self, "codecs", codecs)

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
                layers[name] = soft_row(name, self.faults[self.soft_layers.index(name)])
            else:
                layers[name] = without_row(name.removeprefix("without_"))
        return layers

    @cached_property
    def scalars(self) -> dict[str, Array]:
        """Return the schema row by name of every scalar: the values of a sample that are no layers."""
        return {**SCALARS, **(OF_SEQUENCES if self.sequence_names else {})}

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Return the schema row by name of every array that tasks write."""
        return {**self.pixel_layers, **self.scalars, "crc32c": CRC32C, "done": DONE}

    @property
    def _labels(self) -> dict[str, tuple[str, ...]]:
        """Return the labels of the short axes."""
        return {**_LABELS, "coefficient": self.coefficients}

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
            **{name: len(labels) for name, labels in self._labels.items()},
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
        valid_to_deg = self.distortion_valid_to_deg
        extra: dict[str, dict[str, Any]] = {
            "mask": {"kinds": list(self.mask_kinds), "rules": list(self.mask_rules)} if self.mask_kinds else {},
            "mask_effect": {"threshold_dn": EFFECT_DN, "rule": EFFECT_RULE},
            "mask_any": {
                "faults": list(self.mask_any_faults),
                "rule": MASK_ANY_RULE,
                **(JOINT_ATTRIBUTES if self.mask_any_joint else {}),
            },
            "site": {"names": list(self.site_names)},
            "sequence": {"names": list(self.sequence_names)},
            "lens": {"names": list(self.lens_names)},
            "distortion": {
                "residual_px_rms": self.distortion_residual_px[0],
                "residual_px_max": self.distortion_residual_px[1],
                **({} if valid_to_deg is None else {"valid_to_deg": valid_to_deg}),
                **({"model": self.distortion_model, **_CALIBRATED} if self.distortion_model else {}),
            },
            "intrinsics": {"skew_px": self.skew_px} if self.distortion_model else {},
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
            attributes: dict[str, Any] = {
                "long_name": row.long_name,
                "units": row.units,
                "description": row.description,
            }
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
                codec=self.codecs.get(name, ZSTD),
            )
        return members | self.coordinates(samples)

    def coordinates(self, samples: int) -> dict[str, Member]:
        """Return the required layout by name of every coordinate of a store of `samples` samples."""
        rows, columns = np.arange(self.height) + 0.5, np.arange(self.width) + 0.5
        nodes = np.array(self.wavelength_nm, dtype=np.float64)
        numbers = np.arange(samples, dtype=np.int64)
        coordinates = {
            "y": _coordinate("y", "y", -rows, "minus the row", axis="Y"),
            "row": _coordinate("row", "y", rows, "row, pixel centres at +0.5"),
            "x": _coordinate("x", "x", columns, "column, pixel centres at +0.5", axis="X"),
            "fault": _coordinate("fault", "fault", self.faults, "fault class"),
            "layer": _coordinate("layer", "layer", self.checked, "what a checksum covers"),
            **{name: _coordinate(name, name, tuple(labels), name) for name, labels in self._labels.items()},
            **self._rendered_coordinates(),
        }
        if self.wavelength_nm:
            coordinates["wavelength_nm"] = _coordinate(
                "wavelength_nm", "band", nodes, "wavelength of the band", units="nm"
            )
        if self.sample_names:
            names = self.sample_names[:samples]
            coordinates["name"] = _coordinate("name", "sample", names, "name of the sample")
        if self.distortion_model:
            coordinates["coefficient"].attributes["description"] = "Coefficient of the camera's calibration."
        return {**coordinates, "sample": _coordinate("sample", "sample", numbers, "sample")}

    def _rendered_coordinates(self) -> dict[str, Member]:
        """Return the coordinates of the grid of `scene_radiance`: those of the image, continued beyond it."""
        if not self.rendered_shape:
            return {}
        out = {}
        for dim, size, of_image in zip("yx", self.rendered_shape, (self.height, self.width), strict=True):
            values = np.arange(size) + 0.5 - (size - of_image) / 2
            name = f"{dim}_rendered"
            sign = -1 if dim == "y" else 1
            out[name] = _coordinate(name, name, sign * values, "pixel centres, 0 at the image's border")
        return out

    def layer_bytes(self, name: str) -> int:
        """Return the uncompressed size of one sample of a layer, in bytes."""
        row = self.pixel_layers[name]
        return math.prod(self.shape(row)) * np.dtype(row.dtype).itemsize

    @property
    def estimated_sample_bytes(self) -> int:
        """Approximate size of a sample on disk, in bytes."""
        pixels = sum(self.layer_bytes(name) * row.ratio for name, row in self.pixel_layers.items())
        return int(pixels) + 4096

    def plain(self) -> dict[str, Any]:
        """Return the fields as plain data, without the root attributes; `spec_from_plain` reads them back."""
        # asdict would copy the whole scene first
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "attributes"}
        return {key: value for key, value in plain.items() if key not in _LATER or value != _LATER[key]}

    @property
    def data(self) -> dict[str, Any]:
        """Return `plain` without what does not alter a decoded value, for digests and comparisons."""
        return {key: value for key, value in self.plain().items() if key not in _NO_DATA}

    @property
    def extra_coordinates(self) -> str:
        """Return the root attribute by which xarray shows arrays as coordinates that are no axis."""
        return "wavelength_nm row name" if self.sample_names else "wavelength_nm row"


def spec_from_plain(plain: Mapping[str, Any], attributes: Mapping[str, Any]) -> StoreSpec:
    """Return the StoreSpec that the result of `StoreSpec.plain` and a store's root attributes describe."""
    check_plain_spec(plain, StoreSpec)
    known = {f.name for f in fields(StoreSpec)}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in plain.items() if k in known}
    return StoreSpec(**{**values, "attributes": attributes})
