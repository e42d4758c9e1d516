"""Describe a homogeneous, rotating body, load one from a shape file, or make an ellipsoid."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import InputError
from .geometry import Float64, Int32, centre_of_mass, face_normals_areas, signed_volume, vertex_normals
from .gravity import GRAVITATIONAL_CONSTANT, PolyhedronGravity
from .noise import fractal_noise
from .roughness import Roughness, model_roughness, sharpened
from .shape import Unit, embedded_nucleus, load_shape

DENSITY_67P_KG_M3 = 537.8  # Preusker et al. 2017, A&A 607, L1
ROTATION_PERIOD_67P_S = 44654.8  # 12.4041 h, before perihelion (Scholten, Cheops frame document)
EMBEDDED = "embedded"

# Wavelengths of the relief in mean radii. The shortest is four edges of the mesh; below its facets, a patch
# continues the roughness that it measures on the mesh.
_WAVELENGTHS = np.array([1.2, 0.6, 0.3, 0.15, 0.075])
# Exponent of the amplitude with the wavelength; assumed, within the 0.3 to 1 of natural surfaces (`roughness`).
_HURST = 0.9
_RELIEF_SEED = 20_260
_GRADIENT_NOISE_STD = 0.22  # `noise.gradient_noise`

_PLACES = 400  # at which a body's gravity is sampled; one takes 5 ms on 20,000 facets

Places = tuple[Float64, Float64, Float64]

# what this process has measured of shapes, by their content, and by density and period
_laws: dict[str, Roughness] = {}
_places: dict[tuple[str, float, float], Places] = {}


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """Describe a homogeneous body that rotates at a constant rate.

    Attributes
    ----------
    name
        Free text; it names the body in messages.
    vertices_m
        float64[n, 3] in metres, frame T. The pole, about which the body rotates, is +z.
    faces
        int32[m, 3], closed, outward winding.
    density_kg_m3, rotation_period_s
        Bulk density and sidereal rotation period, both > 0. The defaults are those of 67P.
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
        """Return the sha256 (hex) of the vertices' little-endian float64 bytes and the faces' int32 bytes."""
        return hashlib.sha256(self.vertices_m.tobytes() + self.faces.tobytes()).hexdigest()

    @cached_property
    def volume_m3(self) -> float:
        """Return the volume that the mesh encloses."""
        return signed_volume(self.vertices_m, self.faces)

    @property
    def mean_radius_m(self) -> float:
        """Return the radius of a sphere of the body's volume."""
        return float((3 * self.volume_m3 / (4 * np.pi)) ** (1 / 3))

    @cached_property
    def centre_of_mass_T_m(self) -> Float64:
        """Return the centre of mass of the homogeneous body in T, float64[3] in m."""
        return centre_of_mass(self.vertices_m, self.faces)

    @cached_property
    def area_m2(self) -> float:
        """Return the area of the surface."""
        return float(face_normals_areas(self.vertices_m, self.faces)[1].sum())

    @cached_property
    def vertex_normals(self) -> Float64:
        """Return the outward unit normals at the vertices, float64[n, 3]."""
        return vertex_normals(self.vertices_m, self.faces)

    @cached_property
    def gravity(self) -> PolyhedronGravity:
        """Return the gravity field of the body's polyhedron."""
        return PolyhedronGravity(self.vertices_m, self.faces, self.density_kg_m3)

    @cached_property
    def roughness(self) -> Roughness:
        """Return the law that continues the roughness of the shape below its facets."""
        if self.content_hash not in _laws:
            _laws[self.content_hash] = model_roughness(self.vertices_m, self.faces)
        return _laws[self.content_hash]

    @cached_property
    def mean_gravity_m_s2(self) -> float:
        """Return the attraction at the surface of a sphere of the same volume."""
        return 4 / 3 * np.pi * GRAVITATIONAL_CONSTANT * self.density_kg_m3 * self.mean_radius_m

    @cached_property
    def places(self) -> Places:
        """Return some vertices spread over the body: positions float64[k, 3] in m, effective gravity float64[k, 3].

        The third array is their elevation, float64[k] in m: minus the effective potential over the mean gravity.
        """
        key = self.content_hash, self.density_kg_m3, self.rotation_period_s
        if key not in _places:
            chosen = np.unique(np.linspace(0, len(self.vertices_m) - 1, _PLACES).astype(int))
            _places[key] = self.sampled(self.vertices_m[chosen])
        return _places[key]

    def sampled(self, position: Float64) -> Places:
        """Return what `places` holds, of the given positions; 400 of them take a second or two."""
        field = self.gravity.evaluate(position)
        centrifugal = self.omega_rad_s**2 * position * np.array([1.0, 1.0, 0.0])
        potential = field.potential_m2_s2 + 0.5 * np.einsum("ni,ni->n", centrifugal, position)
        return position, field.acceleration_m_s2 + centrifugal, -potential / self.mean_gravity_m_s2

    @property
    def omega_rad_s(self) -> float:
        """Return the rotation rate about T's +z axis."""
        return 2.0 * math.pi / self.rotation_period_s

    def effective_gravity(self, points_T_m: ArrayLike) -> Float64:
        """Return attraction plus centrifugal term, float64[k, 3] in m/s², at float64[k, 3] or [3] metres in T."""
        return self.gravity.effective(points_T_m, self.omega_rad_s)


def load_body(
    shape: str | Path = EMBEDDED,
    *,
    unit: Unit = "auto",
    name: str | None = None,
    sharpen: float | Literal["auto"] = 0.0,
    volume_m3: float | None = None,
    density_kg_m3: float = DENSITY_67P_KG_M3,
    rotation_period_s: float = ROTATION_PERIOD_67P_S,
) -> Body:
    """Load the packaged procedural nucleus ("embedded") or a shape file.

    Frame T takes its origin and axes from the file; +z is the pole. For 67P models in the Cheops frame (SHAP5,
    SHAP7), T is 67P/C-G_FIXED. The embedded nucleus uses the same axes.

    Parameters
    ----------
    shape
        "embedded" or the path of a shape file.
    unit
        Unit of the file, see `load_shape`; not used for the embedded nucleus.
    name
        Default: "embedded" or the file's name without its suffix.
    sharpen
        Gain with which relief lost by smoothing is restored, see `sharpened`; not used for the embedded nucleus.
    volume_m3
        Volume to which the shape is scaled about its origin; default: as it is.

    Raises
    ------
    InputError
        The shape cannot be used.
    """
    if str(shape) == EMBEDDED:
        vertices_m, faces = embedded_nucleus()
    else:
        vertices_m, faces = load_shape(shape, unit)
        vertices_m = sharpened(vertices_m, faces, sharpen)
    if volume_m3 is not None:
        if not (math.isfinite(volume_m3) and volume_m3 > 0):
            raise InputError(f"volume_m3 must be positive and finite; got {volume_m3}.")
        vertices_m = vertices_m * (volume_m3 / signed_volume(vertices_m, faces)) ** (1 / 3)
    return Body(
        name=name or (EMBEDDED if str(shape) == EMBEDDED else Path(shape).stem),
        vertices_m=vertices_m,
        faces=faces,
        density_kg_m3=density_kg_m3,
        rotation_period_s=rotation_period_s,
    )


def ellipsoid(semi_axes_m: tuple[float, float, float], relief_m: float = 0.0) -> tuple[Float64, Int32]:
    """Return a triaxial ellipsoid as a closed mesh of 82,000 triangles: vertices float64[n, 3], m; faces int32.

    Parameters
    ----------
    semi_axes_m
        Semi-axes along x, y and z.
    relief_m
        Root mean square height of random relief, normal to the ellipsoid. It is the same for the same axes. With 0,
        the ellipsoid is smooth.
    """
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=6)
    axes = np.array(semi_axes_m)
    points, faces = np.asarray(sphere.vertices) * axes, np.asarray(sphere.faces, dtype=np.int32)
    if not relief_m:
        return points, faces
    wavelengths = _WAVELENGTHS * float(np.prod(axes)) ** (1 / 3)
    amplitudes = _WAVELENGTHS**_HURST
    amplitudes *= relief_m / (_GRADIENT_NOISE_STD * float(np.linalg.norm(amplitudes)))
    normals = points / axes**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    height = fractal_noise(points + wavelengths[0] / 3, _RELIEF_SEED, wavelengths, amplitudes)
    return points + height[:, None] * normals, faces
