"""The `Fault` contract and its registry. A new fault is one file beside this one, plus one test.

A fault *class* (`dust_on_optics`) has one or more *models* (`gaussian`). A model is a frozen, keyword-only
dataclass derived from `Fault` that names its class and model; being defined registers it. Its fields are the
keys of the scene file: an `Interval` is drawn from, anything else is fixed.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.errors import InputError, shown
from ..core.quantities import LUMINANCE, RGBI, Charge, Electrons, Offset, Quantity, RawMosaic, soft_kind
from ..detector.chain import STEPS as MOSAIC_STEPS
from ..lens import load_lens
from ..lens.footprint import DEFAULT_LENS, ImageFrame

Params = dict[str, Any]
T = TypeVar("T")

# The `fault` axis of the dataset begins with the six classes of the paper, in this order.
FAULT_AXIS = (
    "dust_on_optics",
    "broken_pixels",
    "broken_lines",
    "straylight",
    "vignetting",
    "optics_degradation",
)

# Order of effects: it belongs to the class, so mixed models cannot change it. Optical effects act on the
# noise-free photo-electrons, readout effects on the digital image; hence a defect is never blurred and a
# flare never covers a broken line. Classes not named here follow, in the order of their names.
PHYSICAL_ORDER = (
    "straylight",
    "dust_on_optics",
    "optics_degradation",
    "vignetting",
    "broken_pixels",
    "smear",
    "cosmic_rays",
    "blooming",
    "cti",
    "banding",
    "adc",
    "broken_lines",
    "transmission",
)

REFERENCE_WIDTH_PX = 1024


class Interval(NamedTuple):
    """Closed bounds of a uniform draw. `lo == hi` is a fixed value."""

    lo: float
    hi: float

    def uniform(self, rng: np.random.Generator, size: int | None = None) -> Any:
        """Uniform float(s) in [lo, hi]."""
        value = rng.uniform(self.lo, self.hi, size)
        return float(value) if size is None else value

    def power_law(self, uniform: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
        """Values in [lo, hi], of uniform numbers in [0, 1], of which the number above v falls as v^-exponent."""
        if abs(exponent) < 1e-9:
            return np.asarray(self.lo * (self.hi / self.lo) ** uniform)
        a, b = self.lo**-exponent, self.hi**-exponent
        return np.asarray((a + (b - a) * uniform) ** (-1 / exponent))

    def integer(self, rng: np.random.Generator) -> int:
        """A uniform integer in lo … hi, both included."""
        return int(rng.integers(int(self.lo), int(self.hi), endpoint=True))


def bounds(
    lo: float, hi: float, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """A field drawn uniformly from [lo, hi]; a scene may set other bounds, or one value, within `limits`."""
    return field(
        default=Interval(lo, hi),
        metadata={"kind": "bounds", "limits": limits, "doc": doc, "unit": unit, "integer": integer},
    )


def number(
    default: float | None, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """A fixed number within `limits`; with default None it may be left out."""
    return field(
        default=default,
        metadata={"kind": "number", "limits": limits, "doc": doc, "unit": unit, "integer": integer},
    )


def flag(default: bool, *, doc: str) -> Any:
    """A fixed true or false."""
    return field(default=default, metadata={"kind": "flag", "doc": doc})


def choice(default: str, options: tuple[str, ...], *, doc: str) -> Any:
    """One of `options`."""
    return field(default=default, metadata={"kind": "choice", "options": options, "doc": doc})


def text(default: str, *, doc: str) -> Any:
    """A fixed string, such as a path."""
    return field(default=default, metadata={"kind": "text", "doc": doc})


def rows(columns: Mapping[str, tuple[float, float]], *, doc: str) -> Any:
    """A list of tables with the given numeric columns and their limits; empty by default (then drawn)."""
    return field(default=(), metadata={"kind": "rows", "columns": dict(columns), "doc": doc})


@dataclass(frozen=True, kw_only=True, eq=False)
class FaultContext:
    """What a fault may know of the sample it acts on.

    `sun_xy_px` float64[2], the pixel position of the Sun's centre (it may lie outside the frame; None behind
    the camera), `sun_direction_C` unit float64[3], `sun_irradiance_W_m2_nm` float64[band] at the camera,
    with `wavelength_nm` its nodes, `sun_visible_fraction` in [0, 1], `sun_angular_radius_rad` of its disc. All None
    where a user's own image is injected. `coating_loss` is the share of the coatings' area that is gone, if another
    fault of the sample has worn them.
    """

    camera: Camera
    sun_xy_px: NDArray[np.float64] | None = None
    sun_direction_C: NDArray[np.float64] | None = None
    sun_irradiance_W_m2_nm: NDArray[np.float64] | None = None
    wavelength_nm: NDArray[np.float64] | None = None
    sun_visible_fraction: float | None = None
    sun_angular_radius_rad: float | None = None
    coating_loss: float = 0.0
    # not an init field: `dataclasses.replace` must not hand results for one frame to another
    _memo: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.camera.height_px, self.camera.width_px

    @property
    def sun_before_camera(self) -> NDArray[np.float64] | None:
        """Return a vector towards the Sun in C with z > 0, float64[3]; of a picture without a pose, by the Sun's
        pixel. None where the Sun is behind the camera or unknown."""
        direction = self.sun_direction_C
        if direction is None and self.sun_xy_px is not None:
            fx, fy, cx, cy = self.camera.intrinsics
            x, y = self.sun_xy_px
            direction = np.array([(x - cx) / fx, (y - cy) / fy, 1.0])
        return direction if direction is not None and direction[2] > 0 else None

    @property
    def scale(self) -> float:
        """Factor from the pixels of a 1024 px wide image to this camera's."""
        return self.camera.width_px / REFERENCE_WIDTH_PX

    @property
    def frame(self) -> ImageFrame:
        """The camera as beams through its lens know it."""
        return ImageFrame(
            lens=self.camera.lens,
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            pixel_pitch_um=self.camera.detector.pixel_pitch_um,
        )

    def once(self, name: str, params: Params, make: Callable[[], T]) -> T:
        """`make()` once per (name, params object) and sample: apply and footprint share what it costs."""
        key = (name, id(params))
        if key not in self._memo:
            # params is kept too, so that its id cannot be taken over by another object
            self._memo[key] = (params, make())
        result: T = self._memo[key][1]
        return result


def times(array: NDArray[np.float32], factor: NDArray[Any]) -> NDArray[np.float32]:
    """Planes float32[y, x, channel] times a factor for each channel [channel], or for each pixel [y, x]."""
    if factor.ndim == 1:
        # OpenCV wants a number for each of four
        out = cv2.multiply(array, (*factor.tolist(), 0.0, 0.0, 0.0)[:4])
    else:
        out = cv2.multiply(array, cv2.merge([factor] * array.shape[2]))
    return np.asarray(out).reshape(array.shape)


def plus(array: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.float32]:
    """The sum of planes float32[y, x, channel] of one shape."""
    return np.asarray(cv2.add(array, other)).reshape(array.shape)


Q = TypeVar("Q", Electrons, Charge, Offset, RawMosaic, RGBI)

# Where a fault may act. The steps between the first and the last are those of a detector with a mosaic.
STEPS = ("electrons", *MOSAIC_STEPS, "rgbi")
QUANTITIES: dict[str, type[Quantity]] = {
    "electrons": Electrons,
    "light": Charge,
    "pixels": Charge,
    "charge": Charge,
    "offsets": Offset,
    "raw": RawMosaic,
    "rgbi": RGBI,
}


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Base of all fault models; every hook is the identity by default.

    Class attributes of a model: `fault` (its class), `model`, `step` (what `apply` receives: `electrons`, the
    expected photo-electrons on the sensor; of a mosaic `light`, the photo-electrons to which each pixel responds,
    `pixels`, all electrons expected in it, `charge`, those collected, `offsets`, what is added to them, or `raw`;
    or `rgbi`), `later_steps` (of a mosaic: others at which it acts too, in order, by `apply_at`), `needs_mosaic`
    (also True where `alter` changes such a detector), `needs_ccd` (True: no effect on CMOS), `localised` (False
    where the footprint is about the whole frame), `needs_sun`, `effect_mask` (True: the mask is the effect rule,
    not the footprint), `soft_layer` (the name of the optional layer that `soft` gives, which ends as one of
    `quantities.SOFT_KINDS`; "": none), `lens_of_thin_camera` (the packaged lens that it follows light through
    where the camera has a thin lens and no other is named: its contents belong to the scene's identity; "": none).

    Which light has met the lens's rims is told by two more, for models of the step `electrons`. `adds_past_rims`
    (True: the light it adds has met them; `apply` puts it into `Electrons.past_rims` where the quantity has that
    plane, and into `array` where it has not). `at_rims` (True: it acts at the rims, so that light past them loses
    only what `passed_to_sun` says). All other models act on all light alike (`act`).
    """

    fault: ClassVar[str]
    model: ClassVar[str]
    step: ClassVar[str]
    later_steps: ClassVar[tuple[str, ...]] = ()
    steps: ClassVar[tuple[str, ...]]
    localised: ClassVar[bool] = True
    needs_sun: ClassVar[bool] = False
    needs_mosaic: ClassVar[bool] = False
    needs_ccd: ClassVar[bool] = False
    effect_mask: ClassVar[bool] = False
    soft_layer: ClassVar[str] = ""
    adds_past_rims: ClassVar[bool] = False
    at_rims: ClassVar[bool] = False
    lens_of_thin_camera: ClassVar[str] = ""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "model" not in cls.__dict__:
            return  # an intermediate base
        cls.steps = (cls.step, *cls.later_steps)
        if cls.steps != tuple(step for step in STEPS if step in cls.steps):
            raise TypeError(f"fault model {cls.fault}/{cls.model} acts at {cls.steps}, not in the order of {STEPS}")
        # light and finished pictures have paths of their own, which know of one step of a fault
        if cls.later_steps and not set(MOSAIC_STEPS).issuperset(cls.steps):
            raise TypeError(f"fault model {cls.fault}/{cls.model}: only steps of a mosaic may be several")
        if cls.soft_layer:
            soft_kind(cls.soft_layer)
        known = _REGISTRY.setdefault(cls.fault, {})
        if cls.model in known and known[cls.model].__qualname__ != cls.__qualname__:
            raise TypeError(f"fault model {cls.fault}/{cls.model} is defined twice")
        known[cls.model] = cls

    def __post_init__(self) -> None:
        # a fault made in Python is checked like one from a scene file, and may give plain numbers and pairs
        for f in dataclasses.fields(self):
            where = f"{self.fault}.{f.name}"
            object.__setattr__(self, f.name, _parse(getattr(self, f.name), f, where))

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Plain, JSON-able parameters, complete enough to draw the fault again."""
        return {}

    def alter(self, camera: Camera, params: Params) -> Camera:
        """The camera with this fault, where the fault is an instrument parameter."""
        return camera

    def inform(self, context: FaultContext, params: Params) -> FaultContext:
        """What other faults of the sample know of it, where this one changes what they meet."""
        return context

    def apply(self, quantity: Q, params: Params, context: FaultContext) -> Q:
        """The quantity of `step` with this fault; the input is not modified."""
        return quantity

    def apply_at(self, step: str, quantity: Q, params: Params, context: FaultContext) -> Q:
        """Return the quantity of one of `steps` with this fault; a model with `later_steps` overrides it."""
        return self.apply(quantity, params, context)

    def act_at(self, step: str, params: Params, context: FaultContext) -> Callable[[Any], Any]:
        """Return a function of the array of a step inside a detector with a mosaic: what the fault makes of it."""
        kind: Any = QUANTITIES[step]

        def act(array: Any) -> Any:
            return self.apply_at(step, kind(array=array), params, context).array

        return act

    def passed_to_sun(self, params: Params, context: FaultContext) -> float:
        """Return the fraction of the light past the rims that a fault `at_rims` lets pass: of the Sun's beam, what
        clears the openings that the fault has moved. The rims have had their part of that light before."""
        return 1.0

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_] | None:
        """bool[y, x], where the fault sits; None where the class has no footprint."""
        return None

    def soft(self, params: Params, context: FaultContext) -> NDArray[np.float32]:
        """Return how strongly the fault acts, float32[y, x], in the unit of its `soft_layer`."""
        raise NotImplementedError(f"{self.fault}/{self.model} has no soft layer")

    def defects(self, params: Params, context: FaultContext) -> NDArray[np.uint8] | None:
        """Kinds of defects in a mosaic's pixels, uint8[y, x]: bits of `quantities.DEFECTS`; None where it makes
        none."""
        return None

    def validate(self) -> None:
        """Raise ValueError with one sentence where fields contradict each other."""

    @property
    def effect_level_dn(self) -> float:
        """The change of the noise-free 8 bit image, in DN, from which a pixel counts for a mask by effect."""
        return 1.0

    def to_dict(self) -> dict[str, Any]:
        """Plain data that `from_dict` turns back into an equal fault."""
        plain: dict[str, Any] = {"model": self.model}
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, Interval):
                value = [value.lo, value.hi]
            elif f.metadata.get("kind") == "rows":
                value = [dict(row) for row in value]
            if value is not None:  # TOML has no null: a number left out stays out
                plain[f.name] = value
        return plain


def intensity_dn(electrons: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Return the intensity of electrons float32[y, x, channel], float32[y, x]: linear, 255 is white, nothing clips.

    It is that of the pixels without a colour filter where the camera has such, else the luminance of R, G and B.
    """
    channels, white_e = camera.detector.channels, np.asarray(camera.detector.white_e, dtype=np.float32)
    if "W" in channels:
        weights = np.array([channel == "W" for channel in channels], dtype=np.float32)
    else:
        luminance = dict(zip("RGB", LUMINANCE, strict=True))
        weights = np.array([luminance.get(channel, 0) for channel in channels], dtype=np.float32)
        weights /= weights.sum()
    return np.asarray(electrons @ (weights * 255 / white_e), dtype=np.float32)


def act(fault: Fault, light: Electrons, params: Params, context: FaultContext) -> Electrons:
    """Return the light after an optical fault, with what has met the lens's rims kept apart.

    A fault that acts on all light alike, which may clip or blur it, gives the plane past the rims what it makes of
    all light less what it makes of the rest.
    """
    if fault.adds_past_rims:
        past = np.zeros_like(light.array) if light.past_rims is None else light.past_rims
        return fault.apply(replace(light, past_rims=past), params, context)
    if light.past_rims is None:
        return fault.apply(light, params, context)
    rest = fault.apply(replace(light, past_rims=None), params, context)
    if fault.at_rims:
        return replace(rest, past_rims=light.past_rims * np.float32(fault.passed_to_sun(params, context)))
    whole = fault.apply(light.merged, params, context)
    return replace(rest, past_rims=np.maximum(whole.array - rest.array, 0))


@dataclass(frozen=True, kw_only=True)
class LensFault(Fault):
    """Base of the models that follow light through a prescription: the faults of a frame share its lens."""

    lens_of_thin_camera: ClassVar[str] = DEFAULT_LENS

    lens: str = text(
        "",
        doc="path of a prescription or name of a packaged lens, scaled to the camera's focal length and closed to "
        f"its f-number; default: the camera's own, or {DEFAULT_LENS} where that is a thin lens",
    )

    def validate(self) -> None:
        if self.lens:
            load_lens(self.lens)


_REGISTRY: dict[str, dict[str, type[Fault]]] = {}


def registry() -> dict[str, dict[str, type[Fault]]]:
    """Fault class → model → type, classes in dataset order; models in the order of their modules, this package's
    first, whichever was imported before: the first one is a class's default."""
    _import_all()
    package = __package__ or ""

    def place(model: tuple[str, type[Fault]]) -> tuple[bool, str]:
        module = model[1].__module__
        return not module.startswith(package), module

    return {name: dict(sorted(_REGISTRY[name].items(), key=place)) for name in dataset_order(_REGISTRY)}


@lru_cache(maxsize=1)
def _import_all() -> None:
    import importlib
    import pkgutil

    package = __package__ or ""
    for info in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{info.name}")


def _ordered(names: Any, order: tuple[str, ...]) -> list[str]:
    present = set(names)
    return [n for n in order if n in present] + sorted(present - set(order))


def dataset_order(names: Any) -> list[str]:
    """Names in the order of the dataset's `fault` axis."""
    return _ordered(names, FAULT_AXIS)


def physical_order(names: Any) -> list[str]:
    """Names in the order in which the effects act."""
    return _ordered(names, PHYSICAL_ORDER)


def from_dict(fault_class: str, table: Mapping[str, Any], *, source: str) -> Fault:
    """Build one fault from its scene-file table `[faults.<fault_class>]`.

    `model` may be left out where the class has one model only (or one called `texture`/the first defined).
    Raises `InputError` naming `source`, the key, the value and the allowed range.
    """
    models = registry().get(fault_class)
    where = f"{source}: faults.{fault_class}"
    if models is None:
        raise InputError(f"{where}: no such fault class{_hint(fault_class, registry())}")
    name = table.get("model", next(iter(models)))
    if not isinstance(name, str) or name not in models:
        raise InputError(f"{where}.model = {shown(name)}: must be one of {', '.join(models)}")
    cls = models[name]
    fields = {f.name: f for f in dataclasses.fields(cls)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "model":
            continue
        if key not in fields:
            raise InputError(f"{where}.{key}: unknown key{_hint(key, fields)}")
        values[key] = _parse(value, fields[key], f"{where}.{key}")
    fault = cls(**values)
    try:
        fault.validate()
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
    return fault


def _hint(word: str, known: Any) -> str:
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]}?)" if close else f"; known: {', '.join(known)}"


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond the range of floats
        return False


def _parse(value: Any, f: dataclasses.Field[Any], where: str) -> Any:
    meta = f.metadata
    kind = meta["kind"]
    if kind == "number" and value is None and f.default is None:
        return None
    if kind == "flag":
        if not isinstance(value, bool):
            raise InputError(f"{where} = {shown(value)}: must be true or false")
        return value
    if kind == "choice":
        if not isinstance(value, str) or value not in meta["options"]:
            raise InputError(f"{where} = {shown(value)}: must be one of {', '.join(meta['options'])}")
        return value
    if kind == "text":
        if not isinstance(value, str):
            raise InputError(f"{where} = {shown(value)}: must be a string")
        return value
    if kind == "rows":
        return _parse_rows(value, meta["columns"], where)
    lo, hi = meta["limits"]
    whole = " whole" if meta["integer"] else ""
    if kind == "number":
        fits = _is_number(value) and lo <= value <= hi and (not whole or float(value).is_integer())
        if not fits:
            raise InputError(f"{where} = {shown(value)}: must be a{whole} number from {lo:g} to {hi:g}")
        return value
    pair = value if isinstance(value, list | tuple) else [value, value]
    ok = len(pair) == 2 and all(_is_number(v) and (not whole or float(v).is_integer()) for v in pair)
    if not ok or not (lo <= pair[0] and pair[1] <= hi):
        raise InputError(
            f"{where} = {shown(value)}: must be one{whole} number, or [lower, upper]{whole} bounds, "
            f"from {lo:g} to {hi:g}"
        )
    if pair[0] > pair[1]:
        raise InputError(f"{where} = {shown(value)}: bounds reversed, the lower one comes first")
    return Interval(*pair)


def _parse_rows(value: Any, columns: Mapping[str, tuple[float, float]], where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise InputError(f"{where} = {shown(value)}: must be a list of tables with keys {', '.join(columns)}")
    for i, row in enumerate(value):
        if not isinstance(row, Mapping) or set(row) != set(columns):
            raise InputError(f"{where}[{i}] = {shown(row)}: must be a table with the keys {', '.join(columns)}")
        for key, (lo, hi) in columns.items():
            if not _is_number(row[key]) or not lo <= row[key] <= hi:
                raise InputError(f"{where}[{i}].{key} = {shown(row[key])}: must be a number from {lo:g} to {hi:g}")
    return tuple(dict(row) for row in value)


def json_schema() -> dict[str, Any]:
    """JSON Schema of the `faults` table, from the fields of every registered model."""
    classes: dict[str, Any] = {}
    for fault_class, models in registry().items():
        options = []
        for name, cls in models.items():
            properties: dict[str, Any] = {"model": {"const": name}}
            for f in dataclasses.fields(cls):
                properties[f.name] = _field_schema(f)
            options.append({"type": "object", "properties": properties, "additionalProperties": False})
        classes[fault_class] = options[0] if len(options) == 1 else {"anyOf": options}
    return {"type": "object", "properties": classes, "additionalProperties": False}


def _field_schema(f: dataclasses.Field[Any]) -> dict[str, Any]:
    meta = f.metadata
    unit = f" [{meta['unit']}]" if meta.get("unit") else ""
    schema: dict[str, Any] = {"description": meta["doc"] + unit}
    kind = meta["kind"]
    if kind in ("bounds", "number"):
        lo, hi = meta["limits"]
        value = {"type": "integer" if meta.get("integer") else "number"}
        value |= {k: v for k, v in (("minimum", lo), ("maximum", hi)) if np.isfinite(v)}
        if kind == "number":
            return schema | value | ({} if f.default is None else {"default": f.default})
        pair = {"type": "array", "items": value, "minItems": 2, "maxItems": 2}
        return schema | {"anyOf": [value, pair], "default": list(f.default)}  # type: ignore
    if kind == "rows":
        columns = {k: {"type": "number", "minimum": v[0], "maximum": v[1]} for k, v in meta["columns"].items()}
        item = {"type": "object", "properties": columns, "required": list(columns)}
        return schema | {"type": "array", "items": item | {"additionalProperties": False}, "default": []}
    if kind == "choice":
        return schema | {"enum": list(meta["options"]), "default": f.default}
    return schema | {"type": "boolean" if kind == "flag" else "string", "default": f.default}


def scale_by_intensity(rgbi: NDArray[np.uint8], intensity: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RGBI uint8[..., 4] with I set to `intensity` (0-255) and RGB scaled by the same ratio.

    Where I was 0 RGB becomes I; overflow clips per channel (design.md, conventions).
    """
    before = rgbi[..., 3]
    dark = before == 0
    ratio = intensity / np.maximum(before, np.float32(1))
    out = np.empty_like(rgbi)
    for channel in range(4):
        value = intensity.copy() if channel == 3 else rgbi[..., channel] * ratio
        np.copyto(value, intensity, where=dark)
        np.rint(value, out=value)
        out[..., channel] = np.clip(value, 0, 255, out=value)
    return out


def with_sensor(camera: Camera, **changes: Any) -> Camera:
    """The camera with a sensor that differs, for faults that are numbers of a detector with a mosaic."""
    detector: Any = camera.detector
    return dataclasses.replace(
        camera, detector=dataclasses.replace(detector, sensor=dataclasses.replace(detector.sensor, **changes))
    )
