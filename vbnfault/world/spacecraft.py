"""Describe the spacecraft around the camera: parts with one material each, some of which can be posed.

All coordinates are in B, in metres. The origin is the camera's entrance pupil; x is image right, y image down and z
along the boresight. A part's name is its path, such as `solar_array_left/panel`. A key of a user's table (a pose, a
material) is such a path, the beginning of one, or any single name in it. It applies to all parts below.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core.errors import InputError
from ..core.files import meshes, resources, user_files
from ..core.files.meshes import MeshPart

F64 = NDArray[np.float64]
Unit = Literal["m", "cm", "mm"]

METRES_PER: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
FILE_TYPES = (".obj", ".glb", ".gltf")
# No spacecraft near a comet is larger (Rosetta: 32 m from tip to tip), but a file in millimetres read as metres is.
LARGEST_EXTENT_M = 200.0
# Largest coordinate in the file's unit: a spacecraft of 200 m in millimetres, far from its origin, is below it.
_FARTHEST = 1e9
# Smallest area relative to the squared extent. Below it the normal of a face is rounding noise in float64.
_DEGENERATE_AREA_FRACTION = 1e-16

_NM = (350.0, 400.0, 450.0, 500.0, 550.0, 600.0, 650.0, 700.0, 800.0, 900.0)

# Hemispherical reflectance, used for a Lambert surface. The level of each is 1 − α within 0.03, with the solar
# absorptance α of Fortescue, Swinerd & Stark 2011, Spacecraft Systems Engineering, 4th ed., table 11.3. The
# dependence on wavelength is assumed.
_FORTESCUE = "1 - α of Fortescue, Swinerd & Stark 2011, table 11.3 (α = {}, {}); spectral course assumed"
NAMED_REFLECTANCES: dict[str, tuple[tuple[float, ...], tuple[float, ...], str]] = {
    "white_paint": (
        _NM,
        (0.45, 0.80, 0.87, 0.89, 0.90, 0.90, 0.90, 0.90, 0.90, 0.90),
        _FORTESCUE.format(0.12, "white silicate paint"),
    ),
    "black_paint": ((350.0, 900.0), (0.05, 0.05), _FORTESCUE.format(0.95, "black epoxy paint")),
    "gold_mli": (
        _NM,  # the absorption edge of Kapton near 480 nm
        (0.04, 0.06, 0.12, 0.34, 0.54, 0.65, 0.72, 0.75, 0.78, 0.79),
        _FORTESCUE.format(0.40, "aluminised Kapton, Kapton outside"),
    ),
    "silver_mli": ((350.0, 900.0), (0.86, 0.86), _FORTESCUE.format(0.14, "aluminised Kapton, aluminium outside")),
    "black_mli": ((350.0, 900.0), (0.07, 0.07), "assumed: carbon-loaded Kapton, α = 0.93"),
    "aluminium": (
        _NM,  # the dip of aluminium near 825 nm
        (0.77, 0.785, 0.80, 0.80, 0.80, 0.79, 0.785, 0.78, 0.755, 0.80),
        _FORTESCUE.format(0.21, "aluminium tape"),
    ),
    "solar_cell": (
        _NM,  # blue under its antireflection coating, bright again beyond the band gap
        (0.20, 0.14, 0.09, 0.06, 0.05, 0.05, 0.05, 0.05, 0.07, 0.20),
        _FORTESCUE.format(0.88, "GaAs solar cells"),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Material:
    """Describe a Lambert surface.

    `reflectance` in [0, 1] is given at `wavelength_nm` (increasing); it is linear between these nodes and constant
    outside. `source` names the origin of the numbers.
    """

    name: str
    wavelength_nm: tuple[float, ...]
    reflectance: tuple[float, ...]
    source: str = ""

    def at(self, wavelength_nm: F64) -> F64:
        """Return the reflectance at `wavelength_nm`, float64[band]."""
        return np.interp(wavelength_nm, self.wavelength_nm, self.reflectance)


def make_material(setting: str | float | Mapping[str, Any], name: str = "default") -> Material:
    """Return the material for a value of a scene file.

    `setting` is a name of `NAMED_REFLECTANCES`, a grey number in [0, 1], or a table with `wavelength_nm` and
    `value`, as `scene.surroundings` checks them. `name` identifies the setting. Raises InputError for an unknown
    name.
    """
    where = f"spacecraft material {name!r}"
    if isinstance(setting, str):
        if setting not in NAMED_REFLECTANCES:
            known = ", ".join(NAMED_REFLECTANCES)
            raise InputError(f"{where} = {setting!r}: must be a grey value 0 to 1, a table, or one of {known}")
        wavelength, value, source = NAMED_REFLECTANCES[setting]
        return Material(name=setting, wavelength_nm=wavelength, reflectance=value, source=source)
    if isinstance(setting, Mapping):
        nm, values = (tuple(map(float, setting[key])) for key in ("wavelength_nm", "value"))
        return Material(name=name, wavelength_nm=nm, reflectance=values, source="the user's table")
    grey = float(setting)
    return Material(name=f"grey_{grey:g}", wavelength_nm=(550.0,), reflectance=(grey,), source="the user's grey")


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Hold the faces of one material.

    `vertices_B_m` is float64[n, 3], `faces` int64[m, 3]. The winding is outward if it is so in the file. The mesh
    need not be closed.
    """

    name: str
    vertices_B_m: F64
    faces: NDArray[np.int64]
    material: Material


@dataclass(frozen=True, kw_only=True)
class HingePose:
    """Describe a right-handed turn of a part by `angle_deg` about an axis through `hinge_B_m`.

    `axis_B` may have any length above 0. Hinge and axis refer to the vehicle at rest, before any pose. If a parent
    turns, its children's hinges turn with it. Raises InputError for an axis of length 0.
    """

    hinge_B_m: tuple[float, float, float]
    axis_B: tuple[float, float, float]
    angle_deg: float = 0.0

    def __post_init__(self) -> None:
        if np.linalg.norm(self.axis_B) == 0:
            raise InputError("pose: axis = [0, 0, 0]: must have a length")

    def moved(self, points_B_m: F64) -> F64:
        """Return the points, float64[n, 3], after the turn."""
        hinge, axis = np.array(self.hinge_B_m, dtype=float), np.array(self.axis_B, dtype=float)
        turn = Rotation.from_rotvec(np.radians(self.angle_deg) * axis / np.linalg.norm(axis))
        return np.asarray(turn.apply(points_B_m - hinge) + hinge)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpacecraftMesh:
    """Hold all parts as one mesh for the renderer.

    `vertices_B_m` is float32[n, 3], `faces` int32[m, 3]. `face_material` int32[m] is an index into `materials`.
    """

    vertices_B_m: NDArray[np.float32]
    faces: NDArray[np.int32]
    face_material: NDArray[np.int32]
    materials: tuple[Material, ...]

    def reflectance(self, wavelength_nm: F64) -> F64:
        """Return the Lambert reflectance, float64[material, band]."""
        return np.stack([material.at(wavelength_nm) for material in self.materials])

    @cached_property
    def outline_B_m(self) -> F64:
        """Return 256 vertices that show how far the vehicle reaches, float64[256, 3].

        They are evenly spaced in the list of vertices; a small mesh repeats some.
        """
        n = len(self.vertices_B_m)
        return self.vertices_B_m[np.linspace(0, n - 1, 256).astype(int)].astype(np.float64)

    def blocked(self, directions_B: F64) -> NDArray[np.bool_]:
        """Return which rays from the pupil's centre along `directions_B`, float64[n, 3], meet the vehicle."""
        corner = self.vertices_B_m.astype(np.float64)[self.faces]
        a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
        normal = np.cross(b - a, c - a)
        height = np.einsum("ij,ij->i", a, normal)
        sides = np.stack([np.cross(a, b), np.cross(b, c), np.cross(c, a)])
        hit = np.zeros(len(directions_B), dtype=bool)
        step = max(1, 4_000_000 // max(1, len(self.faces)))  # number of rays at once, which limits memory to 100 MB
        for start in range(0, len(directions_B), step):
            part = directions_B[start : start + step]
            # the ray must lie inside the cone of a triangle from the origin, and on the triangle's side
            turn = part @ sides.transpose(0, 2, 1)
            within = (turn >= 0).all(axis=0) | (turn <= 0).all(axis=0)
            hit[start : start + step] = (within & ((part @ normal.T) * height > 0)).any(axis=1)
        return hit

    def blocked_fraction(self, fov_deg: float, side: int = 64, height_over_width: float = 1.0) -> float:
        """Return the fraction of an image that the vehicle covers, from `side`² rays.

        `fov_deg` is the full field of view across the image, in whose centre the boresight is.
        """
        across = (np.arange(side) + 0.5) / side * 2 - 1
        slope = np.tan(np.radians(fov_deg) / 2) * across
        x, y = np.meshgrid(slope, height_over_width * slope)
        return float(self.blocked(np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)).mean())


@dataclass(frozen=True, kw_only=True, eq=False)
class Spacecraft:
    """Hold a vehicle: its parts, at rest or posed, and by name the `hinges` that its maker defines, at angle 0."""

    parts: tuple[Part, ...]
    hinges: Mapping[str, HingePose] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Return all names that a table may use: paths of parts, their leading pieces, and single names in them."""
        keys = dict.fromkeys(key for part in self.parts for key in _keys(part.name))
        return tuple(keys)

    def posed(self, poses: Mapping[str, HingePose]) -> Spacecraft:
        """Return the vehicle with the named parts turned, together with their sub-parts.

        Of nested poses the inner one acts first. Raises InputError for a name that no part has.
        """
        _refuse_unknown(poses, self.names, "pose")

        def turned(part: Part) -> Part:
            vertices = part.vertices_B_m
            done: set[str] = set()
            for key in _keys(part.name):
                if key in poses and key not in done:
                    vertices = poses[key].moved(vertices)
                    done.add(key)
            return replace(part, vertices_B_m=vertices) if done else part

        return replace(self, parts=tuple(turned(part) for part in self.parts))

    def merged(self) -> SpacecraftMesh:
        """Return all parts as one mesh. Equal materials are merged, in the order of their first use."""
        materials = tuple(dict.fromkeys(part.material for part in self.parts))
        first = np.cumsum([0, *(len(part.vertices_B_m) for part in self.parts)])
        return SpacecraftMesh(
            vertices_B_m=np.concatenate([part.vertices_B_m for part in self.parts]).astype(np.float32),
            faces=np.concatenate([p.faces + i for p, i in zip(self.parts, first, strict=False)]).astype(np.int32),
            face_material=np.repeat(
                [materials.index(part.material) for part in self.parts], [len(part.faces) for part in self.parts]
            ).astype(np.int32),
            materials=materials,
        )


def _keys(name: str) -> list[str]:
    """Return the names of a part with this path, the innermost first: `a/b` has `a/b`, `b`, `a`."""
    pieces = name.split("/")
    keys: list[str] = []
    for depth in range(len(pieces), 0, -1):
        keys += ["/".join(pieces[:depth]), pieces[depth - 1]]
    return list(dict.fromkeys(keys))


def _refuse_unknown(table: Iterable[str], known: Iterable[str], kind: str) -> None:
    """Raise InputError for the first key of a table that is not a known name."""
    names = sorted(set(known))
    for key in table:
        if key not in names:
            raise InputError(f"spacecraft {kind} {key!r}: no such name; the vehicle has {', '.join(names)}")


# ------------------------------------------------------------------------------------ files


def load_spacecraft(
    path: str | Path,
    *,
    unit: Unit = "m",
    B_from_V: F64 | None = None,
    translation_B_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    materials: Mapping[str, str | float | Mapping[str, Any]] | None = None,
    poses: Mapping[str, HingePose] | None = None,
    default_material: str | float | Mapping[str, Any] = 0.3,
) -> Spacecraft:
    """Read a vehicle from a file, place it in B, assign its materials and turn its parts.

    Parameters
    ----------
    path
        OBJ, GLB or GLTF file. In an OBJ file, parts are the objects (`o`) and the groups in them (`g`), named
        `object/group`. In a GLB file, parts are the nodes, named by their path. Each part is split by material
        (`usemtl`). Polygons are triangulated. Textures, colours and .mtl files are not read.
    unit
        Unit of the file: "m", "cm" or "mm". The GLB standard uses metres.
    B_from_V, translation_B_m
        Rotation float64[3, 3] from the file's axes V, and position of its origin, in B; default: those of B. By
        convention GLB files have y up, z forward and x left; half a turn about z makes these the axes of B.
    materials
        Settings for `make_material` by part or by the file's material. The first match applies: the part's path,
        its name, its parents' names from the nearest on, the file's material. Next follows a material of the file
        whose name is in `NAMED_REFLECTANCES`, then `default_material`.
    poses
        Poses by part, in B after the placement: see `Spacecraft.posed`.
    default_material
        Setting for all other parts.

    Raises
    ------
    InputError
        The file is missing, unreadable, of another type, empty or larger than 200 m, or has a NaN; or a table names
        no part of it. Faces without area are dropped without a message.
    """
    path = Path(path)
    pieces = _read(path)
    extent_m = METRES_PER[unit] * float(np.ptp(np.concatenate([p.vertices for p in pieces]), axis=0).max())
    if extent_m > LARGEST_EXTENT_M:
        raise InputError(
            f"{path}: the vehicle measures {extent_m:g} m in the unit {unit!r}; it must be at most"
            f" {LARGEST_EXTENT_M:g} m, so give the file's own unit: {', '.join(METRES_PER)}"
        )
    rotation, translation = np.eye(3) if B_from_V is None else B_from_V, np.array(translation_B_m, dtype=np.float64)
    parts = tuple(
        Part(
            name=piece.name,
            vertices_B_m=METRES_PER[unit] * piece.vertices @ rotation.T + translation,
            faces=piece.faces,
            material=material,
        )
        for piece, material in zip(pieces, _materials(pieces, materials or {}, default_material), strict=True)
    )
    return Spacecraft(parts=parts).posed(poses or {})


def _materials(
    pieces: list[MeshPart],
    table: Mapping[str, str | float | Mapping[str, Any]],
    default: str | float | Mapping[str, Any],
) -> list[Material]:
    """Return the material of each piece, as `load_spacecraft` describes. Raises InputError for an unknown key."""
    settings = {key: make_material(value, key) for key, value in table.items()}
    known = [key for piece in pieces for key in (*_keys(piece.name), piece.material) if key]
    _refuse_unknown(settings, known, "material")
    otherwise = make_material(default)

    def material_of(piece: MeshPart) -> Material:
        for key in (*_keys(piece.name), piece.material):
            if key in settings:
                return settings[key]
        return make_material(piece.material) if piece.material in NAMED_REFLECTANCES else otherwise

    return [material_of(piece) for piece in pieces]


def _read(path: Path) -> list[MeshPart]:
    """Read the parts of a file, without faces of zero area.

    Raises InputError if no face is left, or for coordinates out of range.
    """
    data = user_files.read_input(path, "spacecraft", types=FILE_TYPES)
    if path.suffix.lower() == ".obj":
        pieces = meshes.read_obj(data, str(path), name=path.stem)
    else:
        pieces = meshes.read_gltf(data, str(path), folder=path.parent)
    pieces = [piece for piece in pieces if len(piece.faces)]
    if not pieces:
        raise InputError(f"{path}: spacecraft has no faces")
    for piece in pieces:
        if not np.isfinite(piece.vertices[piece.faces]).all():
            raise InputError(f"{path}: part {piece.name!r} has vertices with NaN or infinite coordinates")
        if (far := np.abs(piece.vertices).max()) > _FARTHEST:
            raise InputError(
                f"{path}: part {piece.name!r} has vertices with coordinates such as {far:g}; at most {_FARTHEST:g}"
            )
    pieces = [piece for piece in map(_without_degenerate_faces, pieces) if len(piece.faces)]
    if not pieces:
        raise InputError(f"{path}: no face has an area")
    return pieces


def _without_degenerate_faces(piece: MeshPart) -> MeshPart:
    """Return the part without faces of zero area, and without vertices that no face uses."""
    a, b, c = (piece.vertices[piece.faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners = piece.vertices[np.unique(piece.faces)]
    sound = area > _DEGENERATE_AREA_FRACTION * float(np.ptp(corners, axis=0).max()) ** 2
    used, index = np.unique(piece.faces[sound], return_inverse=True)
    return replace(piece, vertices=piece.vertices[used], faces=index.reshape(-1, 3).astype(np.int64))


# ------------------------------------------------------------------------------------ the default vehicle

# hinges of the joints, all of which turn about +x
_HINGES_B_M = {
    "solar_array_left": (-0.6, 0.0, -0.7),
    "solar_array_right": (0.6, 0.0, -0.7),
    "leg_front_left": (-0.58, 0.46, -0.12),
    "leg_front_right": (0.58, 0.46, -0.12),
    "leg_back_left": (-0.58, 0.46, -1.2),
    "leg_back_right": (0.58, 0.46, -1.2),
    "antenna": (0.0, -0.75, -0.95),
}


@lru_cache(maxsize=1)
def default_spacecraft() -> Spacecraft:
    """Return a lander in B whose camera looks out of its front panel. Every part is a closed mesh.

    A box of 1.2 × 1.0 × 1.2 m in gold foil lies behind the pupil (z from -1.26 to -0.06 m). Two solar arrays of
    2.0 × 0.9 m extend to the sides; their cells face up (-y), ahead (+z) after a turn by -90°. An antenna dish of
    0.9 m is on top (-y), an engine and four legs are below (+y). The camera sees only the two front footpads, 1.5 m
    ahead. They are in the lower corners of a field of 65° and cover 1.7 % of a square image; nothing is within 35°
    of the boresight. `benchmarks/lander.py` has made the file.

    Notes
    -----
    Joints are posed with `default_spacecraft().posed({name: replace(hinges[name], angle_deg=…)})`.
    """
    vehicle = load_spacecraft(resources.data_dir("scenes") / "spacecraft" / "lander.obj")
    hinges = {name: HingePose(hinge_B_m=at, axis_B=(1.0, 0.0, 0.0)) for name, at in _HINGES_B_M.items()}
    return replace(vehicle, hinges=hinges)
