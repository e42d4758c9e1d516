"""Define the contract of a fault (`Fault`), its fields, its context and the registry of all models.

A fault *class* (`dust_on_optics`) has one or more *models* (`gaussian`). A model is a frozen, keyword-only
dataclass derived from `Fault`. It states its class and its name, and the definition of the dataclass registers it.
Its fields are the keys of the scene file: a value is drawn from each `Interval` field, and all other fields are
fixed.

To add a fault, write one file beside this one and one test.
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

# The `fault` axis of the dataset begins with the six classes of Gallon et al., in this order.
FAULT_AXIS = (
    "dust_on_optics",
    "broken_pixels",
    "broken_lines",
    "straylight",
    "vignetting",
    "optics_degradation",
)

# The order of the effects belongs to the class, so it holds for every mixture of models. Optical effects act on the
# noise-free photo-electrons. Readout effects act later, on the mosaic or on the digital image. Hence no defect is
# blurred, and no flare covers a broken line. Classes not named here follow in alphabetical order.
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
    """Hold the closed bounds of a uniform draw. If `lo == hi`, the value is fixed."""

    lo: float
    hi: float

    def uniform(self, rng: np.random.Generator, size: int | None = None) -> Any:
        """Return one uniform float in [lo, hi], or float64[size] if `size` is given."""
        value = rng.uniform(self.lo, self.hi, size)
        return float(value) if size is None else value

    def power_law(self, uniform: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
        """Return values in [lo, hi] with density ∝ v^-(exponent + 1), one for each uniform number in [0, 1].

        Far below `hi`, the number of values above v therefore falls as v^-exponent. Exponent 0 gives a density that
        is uniform in log v. `lo` must be above 0.
        """
        if abs(exponent) < 1e-9:
            return np.asarray(self.lo * (self.hi / self.lo) ** uniform)
        a, b = self.lo**-exponent, self.hi**-exponent
        return np.asarray((a + (b - a) * uniform) ** (-1 / exponent))

    def integer(self, rng: np.random.Generator) -> int:
        """Return one uniform integer in [lo, hi], both bounds included."""
        return int(rng.integers(int(self.lo), int(self.hi), endpoint=True))


def bounds(
    lo: float, hi: float, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """Declare a field that is drawn uniformly from [lo, hi].

    A scene may set other bounds, or one fixed value, within `limits`.
    """
    return field(
        default=Interval(lo, hi),
        metadata={"kind": "bounds", "limits": limits, "doc": doc, "unit": unit, "integer": integer},
    )


def number(
    default: float | None, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """Declare a fixed number within `limits`. If its default is None, a scene may leave it out."""
    return field(
        default=default,
        metadata={"kind": "number", "limits": limits, "doc": doc, "unit": unit, "integer": integer},
    )


def flag(default: bool, *, doc: str) -> Any:
    """Declare a fixed true or false."""
    return field(default=default, metadata={"kind": "flag", "doc": doc})


def choice(default: str, options: tuple[str, ...], *, doc: str) -> Any:
    """Declare a string that must be one of `options`."""
    return field(default=default, metadata={"kind": "choice", "options": options, "doc": doc})


def text(default: str, *, doc: str) -> Any:
    """Declare a fixed string, such as a path."""
    return field(default=default, metadata={"kind": "text", "doc": doc})


def rows(columns: Mapping[str, tuple[float, float]], *, doc: str) -> Any:
    """Declare a list of tables with the given numeric columns and their limits.

    The list is empty by default; the model then draws these values.
    """
    return field(default=(), metadata={"kind": "rows", "columns": dict(columns), "doc": doc})


@dataclass(frozen=True, kw_only=True, eq=False)
class FaultContext:
    """Describe the sample that a fault acts on.

    The fields of the Sun are None where they are unknown, for example for a user's own image without a pose.

    Attributes
    ----------
    sun_xy_px
        float64[2]: pixel position of the Sun's centre. It may lie outside the frame. None if the Sun is behind the
        camera.
    sun_direction_C
        float64[3]: unit vector towards the Sun in the camera frame C (x right, y down, z along the boresight).
    sun_irradiance_W_m2_nm, wavelength_nm
        float64[band]: irradiance of the Sun at the camera, and the nodes of its bands.
    sun_visible_fraction
        Fraction of the Sun's disc that is not covered, in [0, 1].
    sun_angular_radius_rad
        Angular radius of the Sun's disc.
    coating_loss
        Fraction of the coatings' area that another fault of the sample has removed, in [0, 1].
    """

    camera: Camera
    sun_xy_px: NDArray[np.float64] | None = None
    sun_direction_C: NDArray[np.float64] | None = None
    sun_irradiance_W_m2_nm: NDArray[np.float64] | None = None
    wavelength_nm: NDArray[np.float64] | None = None
    sun_visible_fraction: float | None = None
    sun_angular_radius_rad: float | None = None
    coating_loss: float = 0.0
    # `init=False`, because `dataclasses.replace` must not copy results of one frame to another
    _memo: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Return (height, width) in pixels."""
        return self.camera.height_px, self.camera.width_px

    @property
    def sun_before_camera(self) -> NDArray[np.float64] | None:
        """Return a vector towards the Sun in the camera frame C with z > 0, float64[3]; not normalised.

        If no direction is known, the vector is computed from the Sun's pixel position by a pinhole model. Return
        None if the Sun is behind the camera or unknown.
        """
        direction = self.sun_direction_C
        if direction is None and self.sun_xy_px is not None:
            fx, fy, cx, cy = self.camera.intrinsics
            x, y = self.sun_xy_px
            direction = np.array([(x - cx) / fx, (y - cy) / fy, 1.0])
        return direction if direction is not None and direction[2] > 0 else None

    @property
    def scale(self) -> float:
        """Return the factor that converts pixels of a 1024 px wide image to pixels of this camera."""
        return self.camera.width_px / REFERENCE_WIDTH_PX

    @property
    def frame(self) -> ImageFrame:
        """Return the lens and the image size of the camera, as ray tracing needs them."""
        return ImageFrame(
            lens=self.camera.lens,
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            pixel_pitch_um=self.camera.detector.pixel_pitch_um,
        )

    def once(self, name: str, params: Params, make: Callable[[], T]) -> T:
        """Return `make()`, computed once for each name and params object of this context.

        `apply` and `footprint` share the result, so an expensive computation runs only once.
        """
        key = (name, id(params))
        if key not in self._memo:
            # the entry holds params, so that no other object can get the same id
            self._memo[key] = (params, make())
        result: T = self._memo[key][1]
        return result


def times(array: NDArray[np.float32], factor: NDArray[Any]) -> NDArray[np.float32]:
    """Return planes float32[y, x, channel] times a factor for each channel [channel] or for each pixel [y, x]."""
    if factor.ndim == 1:
        # OpenCV needs a scalar of four numbers
        out = cv2.multiply(array, (*factor.tolist(), 0.0, 0.0, 0.0)[:4])
    else:
        out = cv2.multiply(array, cv2.merge([factor] * array.shape[2]))
    return np.asarray(out).reshape(array.shape)


def plus(array: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the sum of two arrays float32[y, x, channel] of the same shape."""
    return np.asarray(cv2.add(array, other)).reshape(array.shape)


Q = TypeVar("Q", Electrons, Charge, Offset, RawMosaic, RGBI)

# The steps at which a fault may act, in order. All but the first and the last need a detector with a mosaic.
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
    """Define the hooks of all fault models. By default every hook leaves its input unchanged.

    A model sets these class attributes:

    fault, model
        The names of its class and of the model.
    step
        The quantity that `apply` receives. `electrons`: the expected photo-electrons on the sensor. `rgbi`: the
        digital image. For a detector with a mosaic also: `light`, the photo-electrons to which each pixel responds;
        `pixels`, all electrons expected in it; `charge`, the electrons collected; `offsets`, the values added to
        them; `raw`, the raw digital numbers.
    later_steps
        Further steps of a mosaic at which the model acts by `apply_at`, in order. `steps` holds `step` and these.
    needs_mosaic
        True if the model needs a detector with a mosaic, also if only `alter` changes that detector.
    needs_ccd
        True if the model has no effect on CMOS.
    localised
        False if the footprint covers about the whole frame.
    needs_sun
        True if the model needs the Sun's position.
    effect_mask
        True if the mask holds the pixels that change (see `effect_level_dn`) instead of the footprint.
    soft_layer
        Name of the optional layer that `soft` returns. It ends like one of `quantities.SOFT_KINDS`. "": no layer.
    lens_of_thin_camera
        Packaged lens that the model traces if the camera has a thin lens and the scene names no lens. Its contents
        belong to the scene's identity. "": none.

    Two more attributes, for the step `electrons`, say which light has already passed the lens's rims. A model with
    neither acts in the same manner on all light (see `act`).

    adds_past_rims
        True if the light that the model adds has passed the rims. `apply` adds it to `Electrons.past_rims` if the
        quantity has that plane, else to `array`.
    at_rims
        True if the model acts at the rims. Light past the rims is then only multiplied by `passed_to_sun`.
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
        """Register the model. Raise TypeError if its steps are out of order or its name is in use."""
        super().__init_subclass__(**kwargs)
        if "model" not in cls.__dict__:
            return  # a base class without a model name is not registered
        cls.steps = (cls.step, *cls.later_steps)
        if cls.steps != tuple(step for step in STEPS if step in cls.steps):
            raise TypeError(f"fault model {cls.fault}/{cls.model} acts at {cls.steps}, not in the order of {STEPS}")
        # the code for the steps electrons and rgbi handles only one step of each fault
        if cls.later_steps and not set(MOSAIC_STEPS).issuperset(cls.steps):
            raise TypeError(f"fault model {cls.fault}/{cls.model}: only steps of a mosaic may be several")
        if cls.soft_layer:
            soft_kind(cls.soft_layer)
        known = _REGISTRY.setdefault(cls.fault, {})
        if cls.model in known and known[cls.model].__qualname__ != cls.__qualname__:
            raise TypeError(f"fault model {cls.fault}/{cls.model} is defined twice")
        known[cls.model] = cls

    def __post_init__(self) -> None:
        """Check and convert every field."""
        # this checks a fault made in Python like one from a scene file, and accepts plain numbers and pairs
        for f in dataclasses.fields(self):
            where = f"{self.fault}.{f.name}"
            object.__setattr__(self, f.name, _parse(getattr(self, f.name), f, where))

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the drawn parameters: plain, JSON-able data, sufficient to inject the same fault again."""
        return {}

    def alter(self, camera: Camera, params: Params) -> Camera:
        """Return the camera with this fault, if the fault changes a parameter of the instrument."""
        return camera

    def inform(self, context: FaultContext, params: Params) -> FaultContext:
        """Return the context for the other faults of the sample, if this fault changes what they act on."""
        return context

    def apply(self, quantity: Q, params: Params, context: FaultContext) -> Q:
        """Return the quantity of `step` with this fault. The input is not modified."""
        return quantity

    def apply_at(self, step: str, quantity: Q, params: Params, context: FaultContext) -> Q:
        """Return the quantity of one of `steps` with this fault. A model with `later_steps` overrides this hook."""
        return self.apply(quantity, params, context)

    def act_at(self, step: str, params: Params, context: FaultContext) -> Callable[[Any], Any]:
        """Return a function that applies the fault to the array of one step in a detector with a mosaic."""
        kind: Any = QUANTITIES[step]

        def act(array: Any) -> Any:
            return self.apply_at(step, kind(array=array), params, context).array

        return act

    def passed_to_sun(self, params: Params, context: FaultContext) -> float:
        """Return the fraction of the light past the rims that a fault with `at_rims` lets pass.

        This is the fraction of the Sun's beam that clears the openings which the fault has moved. The loss at the
        lens's own rims is already in that light, so it does not count here.
        """
        return 1.0

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_] | None:
        """Return the pixels at which the fault acts, bool[y, x]; None if the class has no footprint."""
        return None

    def soft(self, params: Params, context: FaultContext) -> NDArray[np.float32]:
        """Return how strongly the fault acts on each pixel, float32[y, x], in the unit of its `soft_layer`."""
        raise NotImplementedError(f"{self.fault}/{self.model} has no soft layer")

    def defects(self, params: Params, context: FaultContext) -> NDArray[np.uint8] | None:
        """Return the kinds of defects that the fault makes in the mosaic, uint8[y, x]; None if it makes none.

        The values are bits of `quantities.DEFECTS`.
        """
        return None

    def validate(self) -> None:
        """Raise ValueError with one sentence if fields contradict each other."""

    @property
    def effect_level_dn(self) -> float:
        """Return the least change of the noise-free 8 bit image, in DN, that counts for a mask by effect."""
        return 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return plain data from which `from_dict` makes an equal fault."""
        plain: dict[str, Any] = {"model": self.model}
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, Interval):
                value = [value.lo, value.hi]
            elif f.metadata.get("kind") == "rows":
                value = [dict(row) for row in value]
            if value is not None:  # TOML has no null, so a missing number stays out
                plain[f.name] = value
        return plain


def intensity_dn(electrons: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Return the intensity of electrons float32[y, x, channel], as float32[y, x] in DN of 255.

    The scale is linear, 255 is white, and nothing is clipped. If the camera has pixels without a colour filter (W),
    the intensity is their signal. Otherwise it is the luminance of R, G and B.
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
    """Return the light after an optical fault; light that has passed the lens's rims stays in its own plane.

    A fault that acts on all light may clip it, so the two planes cannot be treated one by one. The plane past the
    rims becomes the result for all light minus the result for the light before the rims, at least 0.
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
    """Add the key `lens` to the models that trace light through a prescription.

    All such faults of a frame use the same lens, unless the scene names another one.
    """

    lens_of_thin_camera: ClassVar[str] = DEFAULT_LENS

    lens: str = text(
        "",
        doc="path of a prescription or name of a packaged lens, scaled to the camera's focal length and closed to "
        f"its f-number; default: the camera's own, or {DEFAULT_LENS} where that is a thin lens",
    )

    def validate(self) -> None:
        """Raise an error if the named lens cannot be loaded."""
        if self.lens:
            load_lens(self.lens)


_REGISTRY: dict[str, dict[str, type[Fault]]] = {}


def registry() -> dict[str, dict[str, type[Fault]]]:
    """Return fault class → model → type, with the classes in the order of the dataset.

    The models of a class are sorted by module, those of this package first, whatever the order of imports. The
    first model is the default of its class.
    """
    _import_all()
    package = __package__ or ""

    def place(model: tuple[str, type[Fault]]) -> tuple[bool, str]:
        module = model[1].__module__
        return not module.startswith(package), module

    return {name: dict(sorted(_REGISTRY[name].items(), key=place)) for name in dataset_order(_REGISTRY)}


@lru_cache(maxsize=1)
def _import_all() -> None:
    """Import every module of this package, so that all its models are registered."""
    import importlib
    import pkgutil

    package = __package__ or ""
    for info in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{info.name}")


def _ordered(names: Any, order: tuple[str, ...]) -> list[str]:
    """Return the names without duplicates: first those in `order`, then the others in alphabetical order."""
    present = set(names)
    return [n for n in order if n in present] + sorted(present - set(order))


def dataset_order(names: Any) -> list[str]:
    """Return the names in the order of the dataset's `fault` axis."""
    return _ordered(names, FAULT_AXIS)


def physical_order(names: Any) -> list[str]:
    """Return the names in the order in which the effects act."""
    return _ordered(names, PHYSICAL_ORDER)


def from_dict(fault_class: str, table: Mapping[str, Any], *, source: str) -> Fault:
    """Build one fault from its table `[faults.<fault_class>]` in the scene file.

    If the table has no key `model`, the first model of the class in `registry` is used.

    Raises
    ------
    InputError
        Names `source`, the key, its value and the allowed range.
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
    """Return the most similar known word as a suggestion, or the list of all known words."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]}?)" if close else f"; known: {', '.join(known)}"


def _is_number(value: Any) -> bool:
    """Return whether the value is a finite number; booleans do not count."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond the range of floats
        return False


def _parse(value: Any, f: dataclasses.Field[Any], where: str) -> Any:
    """Return the value of one field after its check; `where` names the key in an InputError."""
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
    """Return a list of tables after its check, as a tuple of dicts."""
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
    """Return the JSON Schema of the `faults` table, made from the fields of every registered model."""
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
    """Return the JSON Schema of one field."""
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
    """Return RGBI uint8[..., 4] with I set to `intensity` (0-255) and RGB scaled by the same ratio.

    Where I was 0, R, G and B become the new I. Values that overflow are clipped in each channel.
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
    """Return the camera with changed sensor fields, for faults that are parameters of a detector with a mosaic."""
    detector = camera.mosaic
    return dataclasses.replace(
        camera, detector=dataclasses.replace(detector, sensor=dataclasses.replace(detector.sensor, **changes))
    )
