"""Define the contract that every fault model follows.

A fault *class* (`dust_on_optics`) has one or more *models* (`gaussian`). A model is a frozen, keyword-only
dataclass derived from `Fault`. It states its class and its name, and the definition of the dataclass registers it.
Its fields are the keys of the scene file: a value is drawn from each `Interval` field, and all other fields are
fixed.

To add a fault, write one file beside this one and one test, or a plug-in outside the package (`plugins`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.errors import under_key
from ..core.quantities import RGBI, Charge, Electrons, Offset, Quantity, RawMosaic, soft_kind
from ..core.registry import DeclarationError
from ..detector.effects import STEPS as MOSAIC_STEPS
from ..lens import Prescription, load_lens
from ..lens.image_frame import DEFAULT_LENS, ImageFrame
from .context import FaultContext, Params
from .fields import Interval, Severity, number, parse_field, path
from .models import register

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
        The names of its class and of the model: lower-case letters, digits and underscores.
    default
        True for the one model of the class that a scene uses if it names none. A subclass does not inherit it.
    after
        Stated by the default model: the class behind which this class acts, "" if it acts first. A class of a
        plug-in acts directly behind the class that it names.
    axis
        Stated by the default models of the six classes of Gallon et al.: the position on the dataset's `fault`
        axis. All other classes follow in alphabetical order.
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
    needs_light
        True if the model only takes light of the image away or moves it: a frame without light stays as it is,
        whatever is drawn.
    lit_by_surroundings
        True if light from out of the field acts on the image, so that it is rendered too.
    informed
        True if the model reads a field of the context that another fault of the sample changes by `inform`. The
        other models get the context without such changes.
    thin_lens_only
        Why the model does not act behind a prescription (`camera.lens`), as the second half of a sentence. "": it
        does.
    severity
        The key that makes the model milder or more severe, with its range: what `severity = 3` of a scene sets.
        None: the model has no levels of severity.
    per_exposure
        True if the fault happens during one exposure, as a cosmic ray does, so that each image of a sequence has
        its own draw. False: it is a state of the instrument, which lasts.
    uses_before
        True if the model reads the frame before in a sequence, which is then made without such faults.
    effect_mask
        True if the mask holds the pixels that change (see `effect_level_dn`) instead of the footprint.
    soft_layer
        Name of the optional layer that `soft` returns. It ends like one of `quantities.SOFT_KINDS`. "": no layer.
    lens_of_thin_camera
        Packaged lens that the model traces if the camera has a thin lens and the scene names no lens. Its contents
        belong to the scene's identity. "": none.

    remark
        What `vbnfault describe` says of the model, as a clause behind the name of its class. "": nothing.
    packaged_images
        Folder of packaged images that the model may read. Their contents belong to the scene's identity. "": none.
    """

    fault: ClassVar[str]
    model: ClassVar[str]
    default: ClassVar[bool] = False
    after: ClassVar[str | None] = None
    axis: ClassVar[int | None] = None
    step: ClassVar[str]
    later_steps: ClassVar[tuple[str, ...]] = ()
    steps: ClassVar[tuple[str, ...]]
    localised: ClassVar[bool] = True
    needs_sun: ClassVar[bool] = False
    needs_light: ClassVar[bool] = False
    lit_by_surroundings: ClassVar[bool] = False
    informed: ClassVar[bool] = False
    thin_lens_only: ClassVar[str] = ""
    needs_mosaic: ClassVar[bool] = False
    needs_ccd: ClassVar[bool] = False
    severity: ClassVar[Severity | None] = None
    per_exposure: ClassVar[bool] = False
    uses_before: ClassVar[bool] = False
    effect_mask: ClassVar[bool] = False
    soft_layer: ClassVar[str] = ""
    lens_of_thin_camera: ClassVar[str] = ""
    remark: ClassVar[str] = ""
    packaged_images: ClassVar[str] = ""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Register the model. Raise DeclarationError if its steps are out of order or its name is in use."""
        super().__init_subclass__(**kwargs)
        if "model" not in cls.__dict__:
            return  # a base class without a model name is not registered
        cls.default = cls.__dict__.get("default", False)
        where = f"fault model {getattr(cls, 'fault', '?')}/{cls.model}"
        missing = [name for name in ("fault", "step") if not isinstance(getattr(cls, name, None), str)]
        if missing:
            raise DeclarationError([], f"{where}: states no {' and no '.join(missing)}")
        cls.steps = (cls.step, *cls.later_steps)
        if cls.steps != tuple(step for step in STEPS if step in cls.steps):
            raise DeclarationError([cls.fault], f"{where} acts at {cls.steps}, not in the order of {STEPS}")
        # the code for the steps electrons and rgbi handles only one step of each fault
        if cls.later_steps and not set(MOSAIC_STEPS).issuperset(cls.steps):
            raise DeclarationError([cls.fault], f"{where}: only steps of a mosaic may be several")
        if cls.soft_layer:
            soft_kind(cls.soft_layer)
        register(cls)

    def __post_init__(self) -> None:
        """Check and convert every field."""
        # this checks a fault made in Python like one from a scene file, and accepts plain numbers and pairs
        for f in dataclasses.fields(self):
            where = f"{self.fault}.{f.name}"
            object.__setattr__(self, f.name, parse_field(getattr(self, f.name), f, where))
        needs_sun = self.needs_sun_with({f.name: getattr(self, f.name) for f in dataclasses.fields(self)})
        if needs_sun != self.needs_sun:
            object.__setattr__(self, "needs_sun", needs_sun)

    @classmethod
    def needs_sun_with(cls, table: Mapping[str, Any]) -> bool:
        """Return whether the model needs the Sun with the keys of a table; a fault has this as its `needs_sun`."""
        return cls.needs_sun

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the drawn parameters: plain, JSON-able data, sufficient to inject the same fault again."""
        return {}

    def draw_state(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the parameters of `draw` on which the image depends; the others only describe the fault."""
        return self.draw(context, rng)

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters of the fault when `fraction` of it, in (0, 1], is there.

        A fault that grows overrides this hook, with `first_of` or `scaled`; of the others, all is there at once.
        """
        return params

    def added_light(self, params: Params, context: FaultContext, once: Any, *, spikes: Any = None) -> Any:
        """Return what the fault adds by its parts, for studies (`straylight_lens.AddedLight`); None: unknown.

        `once` remembers results by function and arguments (`lens.straylight.total.Once`).
        """
        return None

    def alter(self, camera: Camera, params: Params) -> Camera:
        """Return the camera with this fault, if the fault changes a parameter of the instrument."""
        return camera

    def prescription(self, frame: ImageFrame) -> Prescription | None:
        """Return the prescription that the model traces behind a camera; None if it traces none."""
        return None

    def inform(self, context: FaultContext, params: Params) -> FaultContext:
        """Return the context for the models with `informed`, if this fault changes what they act on."""
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

    def on_light(self, light: Electrons, params: Params, context: FaultContext) -> Electrons:
        """Return the light after an optical fault; light that has passed the lens's rims stays in its own plane."""
        if light.past_rims is None:
            return self.apply(light, params, context)
        rest = self.apply(replace(light, past_rims=None), params, context)
        return replace(rest, past_rims=self.past_rims(light, rest, params, context))

    def past_rims(self, light: Electrons, rest: Electrons, params: Params, context: FaultContext) -> Any:
        """Return the light past the rims after the fault, float32[y, x, channel]; `rest` is the other after it.

        A fault that acts on all light may clip it, so the two planes cannot be treated one by one. This plane
        becomes the result for all light minus the result for the light before the rims, at least 0.
        """
        return np.maximum(self.apply(light.merged, params, context).array - rest.array, 0)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_] | None:
        """Return the pixels at which the fault acts, bool[y, x]; None if the class has no footprint."""
        return None

    def moved(self, layer: NDArray[Any], params: Params) -> NDArray[Any]:
        """Return a layer of the mosaic, [y, x], whose pixels the fault moves, as it does those of the image."""
        return layer

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
        """Return the least change of the noise-free 8 bit image, in DN, that counts for a mask by effect.

        It is the key `mask_level_dn` of a model whose mask is one by effect (`mask_level`), or 1.
        """
        return float(getattr(self, "mask_level_dn", 1.0)) if self.effect_mask else 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return plain data from which `from_dict` makes an equal fault."""
        plain: dict[str, Any] = {"model": self.model}
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, Interval):
                value = [value.lo, value.hi]
            elif f.metadata.get("kind") == "rows":
                value = [dict(row) for row in value]
            elif f.metadata.get("kind") == "paths":
                value = list(value) or None
            if value is not None:  # TOML has no null, so a missing number stays out
                plain[f.name] = value
        return plain


@dataclass(frozen=True, kw_only=True)
class LensFault(Fault):
    """Add the key `lens` to the models that trace light through a prescription.

    All such faults of a frame use the same lens, unless the scene names another one.
    """

    lens_of_thin_camera: ClassVar[str] = DEFAULT_LENS

    lens: str = path(
        content="lens",
        packaged="scenes/lenses",
        doc="path of a prescription or name of a packaged lens, scaled to the camera's focal length and closed to "
        f"its f-number; default: the camera's own, or {DEFAULT_LENS} where that is a thin lens",
    )

    def validate(self) -> None:
        """Raise an error if the named lens cannot be loaded."""
        if self.lens:
            with under_key("lens"):
                load_lens(self.lens)

    def prescription(self, frame: ImageFrame) -> Prescription:
        """Return the named lens or the camera's own."""
        return frame.real_lens(self.lens).prescription


def mask_level() -> Any:
    """Declare the key `mask_level_dn` of a model whose mask holds the pixels that change."""
    return number(
        1.0,
        limits=(0.01, 255),
        unit="DN of 255",
        doc="the mask holds the pixels that the noise-free image changes in by at least this much",
    )


def with_sensor(camera: Camera, **changes: Any) -> Camera:
    """Return the camera with changed sensor fields, for faults that are parameters of a detector with a mosaic."""
    detector = camera.mosaic
    return dataclasses.replace(
        camera, detector=dataclasses.replace(detector, sensor=dataclasses.replace(detector.sensor, **changes))
    )


def first_of(params: Params, fraction: float, *keys: str) -> Params:
    """Return parameters with the first `fraction`, in (0, 1], of each list of things; at least one of them."""
    return params | {
        key: params[key][: max(1, round(fraction * len(params[key])))] for key in keys if params.get(key)
    }


def scaled(params: Params, fraction: float, *keys: str) -> Params:
    """Return parameters of which some, numbers or lists of numbers, are multiplied by `fraction`."""
    return params | {
        key: [fraction * x for x in params[key]] if isinstance(params[key], list) else fraction * params[key]
        for key in keys
    }
