"""Define the contract of a ground reflectance (`Reflectance`), its registry and the type of its scene table.

A reflectance is a frozen class. Its field `model` gives its name, its other fields are the keys of the scene's
table `[body.photometry]`, and the definition of the class registers it. Everything else follows: the check of the
scene file, its JSON Schema and its identity, and the renderer.

    class Minnaert(DiscReflectance):
        \"\"\"Reflect after Minnaert (1941): D = cos(i)^k cos(e)^(k - 1).\"\"\"

        model: Literal["minnaert"] = "minnaert"
        exponent: float = Field(0.7, ge=0.5, le=1, description="k; 1: as Lambert")

        def disc(self, m, cos_i, cos_e, phase_deg):
            log_i = m.log(m.maximum(cos_i, 1e-9))
            return m.select(cos_i > 0, m.exp(self.exponent * log_i + (self.exponent - 1) * m.log(cos_e)), 0)

Every model gives the bidirectional reflectance r in sr⁻¹, so that I/F = πr. r is the radiance over the irradiance
of the beam on a plane normal to the beam (r = BRDF · cos i). Each formula is written once, over an array namespace
`m`: numpy (`NUMPY`, float64) is the reference, drjit (float32) runs in the renderer. `m` has exp, log, sqrt, cos,
atan, maximum, minimum and select(condition, then, else). Constants must be plain Python numbers, because a numpy
scalar times a drjit array is a numpy array.

Directions are unit vectors in the local frame of the surface, with z along its normal. `light` points towards the
Sun and `view` towards the camera; each is a triple of arrays. No angle is computed by arccos: in float32 this gives
the opposition surge an error of 0.4 % at small phase angles. Hapke's model of 2012 needs only tan(α/2).
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, PydanticUndefined, core_schema

from ..core.registry import DeclarationError, Registry, is_name
from ..core.tables import Table, did_you_mean

F64 = NDArray[np.float64]
Triple = tuple[Any, Any, Any]

NUMPY = SimpleNamespace(
    exp=np.exp,
    log=np.log,
    sqrt=np.sqrt,
    cos=np.cos,
    atan=np.arctan,
    maximum=np.maximum,
    minimum=np.minimum,
    select=np.where,
)

# Below this cosine a direction counts as grazing. An interpolated normal may put the camera slightly below the
# horizon of a facet that the camera does see.
LEAST_COSINE = 1e-4
# Contrasts between terrains refer to this wavelength, the reference of Fornasier et al. 2015.
REFERENCE_NM = 649.0

_REGISTRY: Registry[type[Reflectance]] = Registry("ground reflectance", __package__ or "")

DECAY_PER_MAG = float(0.4 * np.log(10))
DEG_PER_HALF = float(np.degrees(2.0))  # degrees of an angle per radian of its half


class BandReflectance(Protocol):
    """Describe how the ground reflects in the bands of a scene.

    A model gives *terms* and the weight of each term in each band. Bands are linear in the terms, so the renderer
    sums only the terms over the samples of a pixel.
    """

    @property
    def terms(self) -> int:
        """Return the number of terms: 1 where all bands have one shape, else one per band."""

    @property
    def weights(self) -> F64:
        """Return the weight of each term in each band, float64[term, band]."""

    def evaluate(self, m: Any, light: Triple, view: Triple) -> list[Any]:
        """Return the terms, whose weighted sum is r in sr⁻¹; they are 0 where the light comes from below."""


class Reflectance(Table):
    """Describe how the ground reflects; the fields are the keys of the table `[body.photometry]`.

    A subclass declares `model: Literal["name"] = "name"`, its own fields with `pydantic.Field` (default, bounds,
    description; the unit is in the name) and the hook `at`. A common base of several models has no name; it derives
    from `abc.ABC` too. Any other class without a name or a hook raises DeclarationError.

    Attributes
    ----------
    dust_contrast, dust_slope_per_100nm
        Reflectance of dust-covered over bare ground: the contrast minus 1 at `REFERENCE_NM`, and its spectral
        slope. Every model has them.
    scales_reflectance
        Whether the model scales `body.reflectance`. False if it has a spectrum of its own.
    """

    model: str
    dust_contrast: float = Field(
        0.0, ge=-0.9, le=4, description="how much brighter dust-covered ground is at 649 nm: 0.2 for 20 %"
    )
    dust_slope_per_100nm: float = Field(
        0.0, ge=-0.2, le=0.2, description="spectral slope of dust-covered over bare ground"
    )

    scales_reflectance: ClassVar[bool] = True

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the model, unless it is a base class of several."""
        name = cls.model_fields["model"].default
        if name is PydanticUndefined and ABC in cls.__bases__:
            return
        where = f"ground reflectance class {cls.__qualname__}"
        hooks = sorted(cls.__abstractmethods__)
        missing = ["states no model"] if name is PydanticUndefined else []
        if hooks:
            missing.append(f"has no method {' and no '.join(hooks)}")
        if missing:
            raise DeclarationError([], f"{where}: {', '.join(missing)}")
        if not is_name(name):
            text = f"{where}: model = {name!r}: must be lower-case letters, digits and underscores"
            raise DeclarationError([], text)
        _REGISTRY.add(name, cls, module=cls.__module__, qualname=cls.__qualname__)

    @abstractmethod
    def at(self, wavelength_nm: F64, reflectance: F64) -> BandReflectance:
        """Return the model at the wavelengths float64[band] of the bands.

        `reflectance` float64[band] in [0, 1] is `body.reflectance` there: the normal reflectance at zero phase.
        """

    def contrast_of_dust(self, wavelength_nm: F64) -> F64:
        """Return the reflectance of dust-covered over bare ground minus 1, float64 like `wavelength_nm`."""
        slope = self.dust_slope_per_100nm * (wavelength_nm - REFERENCE_NM) / 100
        return (1 + self.dust_contrast) * (1 + slope) - 1

    @property
    def keys_of_67p(self) -> tuple[str, ...]:
        """Return the keys whose values were measured at 67P, for a warning where the body is another one."""
        return ()


def registry() -> dict[str, type[Reflectance]]:
    """Return the name and the class of every ground reflectance."""
    return dict(_REGISTRY)


def is_packaged(cls: type[Reflectance]) -> bool:
    """Return whether a reflectance belongs to vbnfault, so that every process knows it."""
    return _REGISTRY.is_packaged(cls)


class ScaledReflectance(Reflectance, ABC):
    """Model a reflectance of one shape at all wavelengths: r = (A/π) `term`, where A is `body.reflectance`."""

    @abstractmethod
    def term(self, m: Any, light: Triple, view: Triple) -> Any:
        """Return π r / A; it is 0 where the light comes from below the surface."""

    def at(self, wavelength_nm: F64, reflectance: F64) -> BandReflectance:
        """Return the model at the wavelengths of the bands."""
        return SingleTerm(model=self, reflectance=reflectance)


@dataclass(frozen=True, kw_only=True, eq=False)
class SingleTerm:
    """Evaluate a `ScaledReflectance` in the bands of a scene; `reflectance` float64[band] in [0, 1] is A."""

    model: ScaledReflectance
    reflectance: F64

    terms: ClassVar[int] = 1

    @property
    def weights(self) -> F64:
        """Return the reflectance r of each band per unit of the term, float64[1, band]."""
        return self.reflectance[None, :] / np.pi

    def evaluate(self, m: Any, light: Triple, view: Triple) -> list[Any]:
        """Return the single term."""
        return [self.model.term(m, light, view)]


class DiscReflectance(ScaledReflectance, ABC):
    """Model reflectance, disc function and phase function as a product: r = (A/π) D(i, e, α) 10^(-0.4 β α).

    A is the normal reflectance of `body.reflectance`. A subclass gives the disc function D by the hook `disc`.
    β is `phase_slope_mag_deg`; 67P has 0.047 mag/° at phase angles of 1.3-54° (Fornasier et al. 2015).
    """

    phase_slope_mag_deg: float = Field(0.0, ge=0, le=1, description="fading with phase angle; 67P: 0.047")

    @abstractmethod
    def disc(self, m: Any, cos_i: Any, cos_e: Any, phase_deg: Any) -> Any:
        """Return the disc function D, which is 1 at i = e = α = 0 and 0 where `cos_i` is 0.

        Parameters
        ----------
        m
            Array namespace, numpy or drjit.
        cos_i
            Cosine of the angle of incidence, from 0 (also where the light comes from below) to 1.
        cos_e
            Cosine of the angle of emission, above 0.
        phase_deg
            Phase angle α in degrees.
        """

    def term(self, m: Any, light: Triple, view: Triple) -> Any:
        """Return D 10^(-0.4 β α)."""
        phase_deg = DEG_PER_HALF * m.atan(tan_half_phase(m, light, view))
        value = self.disc(m, m.maximum(light[2], 0), m.maximum(view[2], LEAST_COSINE), phase_deg)
        if self.phase_slope_mag_deg:
            value = value * m.exp(-DECAY_PER_MAG * self.phase_slope_mag_deg * phase_deg)
        return value


def tan_half_phase(m: Any, light: Triple, view: Triple) -> Any:
    """Return tan(α/2) = |l - v| / |l + v| of the phase angle α."""
    apart = sum((a - b) * (a - b) for a, b in zip(light, view, strict=True))
    together = sum((a + b) * (a + b) for a, b in zip(light, view, strict=True))
    return m.sqrt(apart / m.maximum(together, 1e-12))


def radiance_factor(model: BandReflectance, light: ArrayLike, view: ArrayLike) -> F64:
    """Return I/F = πr, float64[band, n], for unit directions float64[n, 3] in the surface's frame (z: normal)."""
    triples = [tuple(np.atleast_2d(np.asarray(d, dtype=np.float64)).T) for d in (light, view)]
    with np.errstate(under="ignore"):
        terms = np.stack(np.broadcast_arrays(*model.evaluate(NUMPY, *triples)))
    return np.pi * np.einsum("tb,tn->bn", model.weights, terms)


# --- the table of the scene file ------------------------------------------------------------------------------


def parse(table: Any) -> Any:
    """Return the reflectance of a scene's table; by default the model is "lambert".

    Keys of other models are refused, unless they hold the default: a store of an earlier version lists the keys of
    all models. Raises ValueError, or pydantic's ValidationError that names the key.
    """
    if isinstance(table, Reflectance):
        return table
    if not isinstance(table, Mapping):
        raise ValueError("must be a table")
    name, models = table.get("model", "lambert"), registry()
    if not isinstance(name, str) or name not in models:
        raise _refused("model", name, f"must be one of {', '.join(models)}")
    own = models[name].model_fields
    values = {"model": name}
    for key, value in table.items():
        owners = [other for other, cls in models.items() if key in cls.model_fields]
        if key in own:
            values[key] = value
        elif not owners:
            raise _refused(key, {}, f"unknown key{did_you_mean(key, list(own))}")
        elif value != models[owners[0]].model_fields[key].default:
            raise _refused(key, value, f"is a key of {', '.join(owners)}, not of model = {name!r}; leave it out")
    # JSON mode is strict about types, but accepts arrays as tuples
    plain = json.dumps(values, default=lambda other: other.model_dump())
    return models[name].model_validate_json(plain, strict=True)


def _refused(key: str, value: Any, sentence: str) -> ValidationError:
    """Return the error of one key of a table."""
    reason = PydanticCustomError("value_error", "{reason}", {"reason": sentence})
    return ValidationError.from_exception_data("table", [{"type": reason, "loc": (key,), "input": value}])


class _ReflectanceTable:
    """Give pydantic the validation and the JSON Schema of a field that holds any registered reflectance."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            parse, serialization=core_schema.plain_serializer_function_ser_schema(lambda value: value.model_dump())
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return handler(core_schema.union_schema([cls.__pydantic_core_schema__ for cls in registry().values()]))


# The type of a field of a pydantic model that holds any registered reflectance.
AnyReflectance = Annotated[Reflectance, _ReflectanceTable()]
