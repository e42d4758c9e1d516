"""The schema: every array of a store, with its dims, dtype, unit and layout. Plain data; touches no file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.quantities import CHANNELS, DEFECTS, soft_kind
from ..scene.plan import SPLITS, STRATA

# 2: the spare and the checksum of the root, eight coefficients of `distortion`, further arrays. A store of another
# format is refused: nothing here could tell its arrays from damaged ones.
FORMAT_VERSION = 2
SEMANTIC = ("sky", "body", "sun", "spacecraft")

# Root attributes that say when or how a store was written, not what it holds: no part of the digest.
VOLATILE_ATTRIBUTES = ("created", "modified", "command")

MAX_SHARD_SAMPLES = 16
MAX_SHARD_BYTES = 2**30
MAX_HELD_BYTES = 2**31  # all layers of a shard, uncompressed: what a task may have to hold

_SCALARS = "scalars"  # the entry of the `layer` axis that stands for all scalars of a sample


@dataclass(frozen=True)
class Array:
    """One row of the schema. `ratio`: a typical compressed size over the uncompressed one."""

    dimensions: str
    dtype: str
    units: str
    long_name: str
    names: tuple[str, ...] = ()  # CF flag meanings …
    bits: bool = False  # … of values, or of bits
    ratio: float = 1.0

    @property
    def dims(self) -> tuple[str, ...]:
        return tuple(self.dimensions.split())

    @property
    def is_text(self) -> bool:
        return self.dtype == "str"

    @property
    def fill(self) -> Any:
        """What an unwritten sample reads as."""
        return "" if self.is_text else float("nan") if self.dtype == "float64" else 0


_IMAGE = "sample y x channel"

# The schema. Per-pixel layers: one chunk a sample, sharded.
LAYERS: dict[str, Array] = {
    "image": Array(_IMAGE, "uint8", "DN", "image with faults", ratio=0.45),
    "mask": Array("sample fault y x", "bool", "1", "where each fault is, by its kind", ratio=0.005),
    "mask_any": Array("sample y x", "bool", "1", "union of mask over the faults named here", ratio=0.005),
    "clean": Array(_IMAGE, "uint8", "DN", "same camera, exposure and noise, no fault", ratio=0.45),
    # optional from here on; `without_<fault>` follows the pattern of the straylight one
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
}
# What `mask_effect` is, and the mask of a class that is labelled by effect.
EFFECT_DN = 1
EFFECT_RULE = (
    f"a channel of the noise-free 8 bit image changes by {EFFECT_DN} DN or more when the fault is switched off "
    "and the others are kept"
)
MASK_ANY_RULE = "union of the masks of the classes in the attribute faults, which dataset.mask_any chose"
REQUIRED_LAYERS = ("image", "mask", "mask_any", "clean")

# Scalars and small vectors: a chunk is a shard, so that a task writes whole chunks.
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
    """One array of the group as it must be: `create`, `verify` and `recover` go by it.

    `values`: of a coordinate; None for what tasks write. `chunks`, `shards`: of zarr, 1 at least in every axis.
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
    """A row of `StoreSpec.members` for a coordinate of one axis."""
    dtype, fill = (values.dtype.name, 0) if isinstance(values, np.ndarray) else ("str", "")
    chunks = (65536 if dim == "sample" else max(1, len(values)),)
    return Member((len(values),), chunks, None, dtype, fill, (dim,), attributes, values)


@dataclass(frozen=True, kw_only=True)
class StoreSpec:
    """What a store holds, as plain data.

    `faults`: the fault axis in dataset order. `mask_any_faults`: the union that `mask_any` is.
    `localised_faults`: those whose mask is not empty where they are injected (default: `mask_any_faults`).
    `mask_kinds`, `mask_rules`: what the mask of each of `faults` is, and by which rule. `soft_layers`: the soft
    layer of each of `faults`, "" where it has none. `layers`: the optional layers, of `LAYERS`, `soft_layers` or
    `without_<fault>`. `shard_samples` 0 chooses the most, up to
    16, that keeps the largest array of a shard within 1 GiB and all of them within 2 GiB; a larger one is
    lowered to its largest divisor that does. `attributes`: JSON-able root attributes. Raises InputError for
    names that do not exist. `distortion_residual_px`: root mean square and largest deviation of the
    coefficients of distortion from the lens's chief rays, over the lit frame. `attitude_references`: the
    direction that roll, pitch and yaw count from in each of `STRATA`, "sun" or "nadir".
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
    detector_names: tuple[str, ...] = ()
    radiance_dtype: str = "float16"
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
        # a divisor: what the plan groups by site in shards of the wished size is then in no shard with another
        size = next(n for n in range(min(wished, most), 0, -1) if wished % n == 0)
        object.__setattr__(self, "shard_samples", size)

    @cached_property
    def pixel_layers(self) -> dict[str, Array]:
        """Name → schema row of every per-pixel layer, in the order of the `layer` axis."""
        rows = {name: LAYERS[name] for name in REQUIRED_LAYERS}
        for name in self.layers:
            if name == "radiance":
                rows[name] = replace(LAYERS[name], dtype=self.radiance_dtype)
            elif name in LAYERS:
                rows[name] = LAYERS[name]
            elif name in self.soft_layers:
                kind, fault = soft_kind(name), self.faults[self.soft_layers.index(name)]
                rows[name] = Array("sample y x", kind.dtype, kind.units, f"{fault}: {kind.meaning}", ratio=0.4)
            else:
                without = name.removeprefix("without_")
                rows[name] = Array(_IMAGE, "uint8", "DN", f"the image without {without}", ratio=0.45)
        return rows

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Name → schema row of every array that tasks write."""
        crc32c = Array("sample layer", "uint32", "1", "CRC-32C of the decoded bytes")
        done = Array("sample", "uint8", "1", "1 where a sample is whole; written last")
        return {**self.pixel_layers, **SCALARS, "crc32c": crc32c, "done": done}

    @property
    def checked(self) -> tuple[str, ...]:
        """The `layer` axis of `crc32c`."""
        return (*self.pixel_layers, _SCALARS)

    def shape(self, row: Array) -> tuple[int, ...]:
        """Shape of one sample of an array: its dims without `sample`."""
        sizes = {
            "y": self.height,
            "x": self.width,
            "fault": len(self.faults),
            "band": len(self.wavelength_nm),
            "layer": len(self.checked),
            **{name: len(labels) for name, labels in _LABELS.items()},
        }
        return tuple(sizes[d] for d in row.dims if d != "sample")

    def empty(self, name: str) -> bool:
        """Has an array an axis of no length, as `mask` without fault classes? It has no data files then."""
        return 0 in self.shape(self.arrays[name])

    def members(self, samples: int) -> dict[str, Member]:
        """Name → what it must be, for every array of a group of `samples` samples, coordinates last."""
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
            **{
                name: {"reference": dict(zip(STRATA, self.attitude_references, strict=True))}
                for name in ("roll_deg", "pitch_deg", "yaw_deg")
            },
            "detector_individual": {"names": list(self.detector_names)},
            "split": {"names": list(SPLITS)},
            "radiance": {"coordinates": "wavelength_nm"},
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
        """Name → what it must be, for every coordinate of a group of `samples` samples."""
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
            "sample": _coordinate("sample", np.arange(samples, dtype=np.int64), long_name="sample"),
        }

    def layer_bytes(self, name: str) -> int:
        """Uncompressed bytes of one sample of a per-pixel layer."""
        row = self.pixel_layers[name]
        return int(np.prod(self.shape(row), dtype=np.int64)) * np.dtype(row.dtype).itemsize

    @property
    def estimated_sample_bytes(self) -> int:
        """About what a sample takes on disk."""
        pixels = sum(self.layer_bytes(name) * row.ratio for name, row in self.pixel_layers.items())
        return int(pixels) + 4096

    def plain(self) -> dict[str, Any]:
        """JSON-able fields without the root attributes; `spec_from_plain` reads them back."""
        # not asdict: it would copy the whole scene to leave it out
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "attributes"}


def spec_from_plain(plain: Mapping[str, Any], attributes: Mapping[str, Any]) -> StoreSpec:
    """What `StoreSpec.plain` gave, with the root attributes of a store."""
    known = {f.name for f in fields(StoreSpec)}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in plain.items() if k in known}
    return StoreSpec(**values, attributes=attributes)
