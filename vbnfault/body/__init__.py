"""The body: its shape, gravity, sites and terrain. The T frame is the shape file's own body-fixed axes."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import InputError
from .cache import cached_patch
from .gravity import PolyhedronGravity
from .nucleus import embedded_nucleus
from .patch import Patch, build_patch
from .roughness import Roughness, model_roughness
from .shape import Float64, Int32, Unit, check_mesh, load_shape, signed_volume
from .sites import Site, Sites, choose_sites, local_level, site_at

__all__ = [
    "Body",
    "Patch",
    "PolyhedronGravity",
    "Site",
    "Sites",
    "build_patch",
    "cached_patch",
    "check_mesh",
    "choose_sites",
    "embedded_nucleus",
    "load_body",
    "load_shape",
    "local_level",
    "site_at",
]

DENSITY_67P_KG_M3 = 537.8  # Preusker et al. 2017, A&A 607, L1
ROTATION_PERIOD_67P_S = 44654.8  # 12.4041 h, before perihelion: Scholten, Cheops frame document
EMBEDDED = "embedded"


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """A homogeneous, uniformly turning body.

    Attributes
    ----------
    name
        Free text.
    vertices_m
        float64[n, 3], metres, frame T: the file's own body-fixed axes, +z the pole, about which it turns.
    faces
        int32[m, 3], closed, outward winding.
    density_kg_m3, rotation_period_s
        Bulk density and sidereal period; the defaults are 67P's.
    """

    name: str
    vertices_m: Float64
    faces: Int32
    density_kg_m3: float = DENSITY_67P_KG_M3
    rotation_period_s: float = ROTATION_PERIOD_67P_S

    def __post_init__(self) -> None:
        for key in ("density_kg_m3", "rotation_period_s"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{self.name}: {key} must be positive and finite; got {value}.")
        for key, dtype in (("vertices_m", "<f8"), ("faces", "<i4")):
            array = np.array(getattr(self, key), dtype=dtype)
            array.setflags(write=False)
            object.__setattr__(self, key, array)

    @cached_property
    def content_hash(self) -> str:
        """sha256 (hex) of the vertices' little-endian float64 bytes and the faces' int32 bytes."""
        return hashlib.sha256(self.vertices_m.tobytes() + self.faces.tobytes()).hexdigest()

    @cached_property
    def volume_m3(self) -> float:
        return signed_volume(self.vertices_m, self.faces)

    @cached_property
    def gravity(self) -> PolyhedronGravity:
        return PolyhedronGravity(self.vertices_m, self.faces, self.density_kg_m3)

    @cached_property
    def roughness(self) -> Roughness:
        """The law that continues the shape's own roughness below its facets."""
        return model_roughness(self)

    @property
    def omega_rad_s(self) -> float:
        """Spin about T's +z."""
        return 2.0 * math.pi / self.rotation_period_s

    def effective_gravity(self, points_T_m: ArrayLike) -> Float64:
        """Attraction and centrifugal term, float64[k, 3] m/s², at float64[k, 3] or [3] metres in T."""
        return self.gravity.effective(points_T_m, self.omega_rad_s)


def load_body(
    shape: str | Path = EMBEDDED,
    *,
    unit: Unit = "auto",
    name: str | None = None,
    density_kg_m3: float = DENSITY_67P_KG_M3,
    rotation_period_s: float = ROTATION_PERIOD_67P_S,
) -> Body:
    """The packaged procedural nucleus ("embedded") or a shape file (see `load_shape`).

    Frame T is the file's own: its origin, its axes, +z the pole. For 67P models in the Cheops frame (SHAP5,
    SHAP7) that is 67P/C-G_FIXED; the embedded nucleus is laid out in the same axes.

    Raises
    ------
    InputError
        The shape cannot be used, or density or period is not positive.
    """
    if str(shape) == EMBEDDED:
        vertices_m, faces = embedded_nucleus()
    else:
        vertices_m, faces = load_shape(shape, unit)
    return Body(
        name=name or (EMBEDDED if str(shape) == EMBEDDED else Path(shape).stem),
        vertices_m=vertices_m,
        faces=faces,
        density_kg_m3=density_kg_m3,
        rotation_period_s=rotation_period_s,
    )
