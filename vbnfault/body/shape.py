"""Read shape models and make sure that they bound a solid."""

from __future__ import annotations

import io
import logging
import warnings
from collections import deque
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import meshes, resources, user_files
from . import formats
from .geometry import Float64, Int32, face_normals_areas, signed_volume

Unit = Literal["auto", "m", "km"]

METRES_PER_KM = 1000.0
# Dimorphos, the smallest body with a shape model, is 177 m long. Lutetia, the largest body that is usually given in
# kilometres for this kind of work, is 121 km long. A threshold between the two numbers is unambiguous.
AUTO_KM_BELOW_EXTENT = 150.0
FILE_TYPES = (".obj", ".ply", ".stl", ".glb", ".gltf", *formats.SUFFIXES)
# These types store a vertex once per face or per seam (the latter in plate tables and DSKs made from the six faces
# of an ICQ). Merging such vertices is normal and deserves no warning.
_SPLIT_VERTEX_TYPES = (".stl", ".glb", ".gltf", *formats.SUFFIXES)
_LARGEST_HOLE_EDGES = 8
_MOST_FLIPS = 30  # of a sliver: several times what chains of tens of slivers take
# In the file's unit: larger than any body, and small enough that areas and volumes do not overflow.
_FARTHEST = 1e12
# Relative to the squared extent. The normal of a smaller facet is rounding noise in float64.
_DEGENERATE_AREA_FRACTION = 1e-16
# Volumes that differ by less are the same, to the rounding of a union.
_SAME_VOLUME = 1e-9


def load_shape(path: str | Path, unit: Unit = "auto") -> tuple[Float64, Int32]:
    """Read a closed triangle mesh in its own body-fixed axes.

    Parameters
    ----------
    path
        OBJ, PLY, STL, GLB or GLTF file; PDS plate table (TAB, PLT, VER, TXT), Gaskell's ICQ (ICQ, TAB, TXT), VRML
        (WRL); NAIF DSK (BDS), which needs spiceypy: `pip install 'vbnfault[spice]'`. The content decides which kind
        of table the file is. Polygons are triangulated, and several objects are joined.
    unit
        Unit of the file: "m", "km", or "auto". With "auto" it is kilometres if the format defines them (DSK) or if
        the longest side of the bounding box is below 150, else metres. No body with a shape model lies between
        Dimorphos (177 m) and the bodies modelled in kilometres (Lutetia 121 km). For larger bodies in kilometres
        (Vesta) or smaller ones in metres, give the unit, which always wins.

    Returns
    -------
    vertices_m, faces
        float64[n, 3] in metres and int32[m, 3], outward winding, checked and repaired by `check_mesh`.

    Raises
    ------
    InputError
        The file is missing, unreadable, of another type, or not a closed mesh.
    """
    path = Path(path)
    if unit not in ("auto", "m", "km"):  # another one would count as metres
        raise InputError(f"{path}: unit must be one of auto, m, km; got {unit!r}.")
    data = user_files.read_input(path, "shape", types=FILE_TYPES)
    suffix = path.suffix.lower()
    is_km = False
    if suffix in formats.SUFFIXES:
        vertices, faces, is_km = formats.read_shape(path, data)
    elif suffix == ".obj":
        vertices, faces = meshes.joined(meshes.read_obj(data, str(path)))
    elif suffix in (".glb", ".gltf"):
        vertices, faces = meshes.joined(meshes.read_gltf(data, str(path), folder=path.parent))
    else:
        vertices, faces = _read_with_trimesh(path, data)
    _check_arrays(vertices, faces, str(path))
    if unit == "auto":
        unit = "km" if is_km or np.ptp(vertices, axis=0).max() < AUTO_KM_BELOW_EXTENT else "m"
    if unit == "km":
        vertices = vertices * METRES_PER_KM
    if suffix in _SPLIT_VERTEX_TYPES:
        vertices, faces, _ = _weld(vertices, faces)
    return check_mesh(vertices, faces, str(path))


@lru_cache(maxsize=1)
def embedded_nucleus() -> tuple[Float64, Int32]:
    """Return the packaged nucleus: float64[n, 3] in metres and int32[m, 3], closed, wound outwards, read-only.

    It has two lobes, the published dimensions of 67P and the axes of 67P/C-G_FIXED. So everything works without a
    download. `benchmarks/embedded_nucleus.py` has made the file and says how.
    """
    with np.load(resources.data_dir("scenes") / "bodies" / "embedded.npz") as file:
        vertices, faces = file["vertices_m"], file["faces"]
    vertices.setflags(write=False)
    faces.setflags(write=False)
    return vertices, faces


def _read_with_trimesh(path: Path, data: bytes) -> tuple[Float64, NDArray[np.int64]]:
    """Read a PLY or STL file."""
    import trimesh  # takes a third of a second to import: for shapes of files only

    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)  # trimesh would log parser errors with their tracebacks
    try:
        # numpy warns about NaN while trimesh normalises vectors; `_check_arrays` reports it as an error later.
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            mesh = trimesh.load(io.BytesIO(data), file_type=path.suffix[1:].lower(), process=False, force="mesh")
            vertices = np.array(getattr(mesh, "vertices", np.empty((0, 3))), dtype=np.float64)
            faces = np.array(getattr(mesh, "faces", np.empty((0, 3))), dtype=np.int64)
    except Exception as error:  # the readers raise whatever their parsers raise
        kind, what = path.suffix[1:].upper(), type(error).__name__
        raise InputError(f"{path}: is unreadable as {kind} ({what} while parsing).") from None
    finally:
        logger.setLevel(level)
    return vertices, faces


def check_mesh(vertices: NDArray, faces: NDArray, source: str) -> tuple[Float64, Int32]:
    """Check that a mesh bounds a solid, and repair what can be repaired without guessing.

    Coincident vertices are merged, degenerate, double and loose faces dropped, holes of up to eight edges or
    without area filled, and the winding is made consistent and turned outwards. Closed shells that overlap, or that
    lie within one another and are wound outwards, become their union, so that no part counts twice in volume and
    gravity; a shell within another one and wound inwards is a cavity and stays. One `UserWarning` reports these
    repairs. Unreferenced vertices are dropped silently.

    Parameters
    ----------
    vertices, faces
        float[n, 3] (any unit) and int[m, 3]; not modified.
    source
        Name of the mesh in messages, usually the file's path.

    Returns
    -------
    vertices, faces
        float64[n, 3], int32[m, 3]: every edge is shared by two faces in opposite directions, and the volume is
        positive.

    Raises
    ------
    InputError
        The mesh is empty or has no faces, coordinates are NaN, infinite or beyond 1e12, indices are out of range,
        edges are open or non-manifold, the winding cannot be made consistent, or the volume is zero.
    """
    vertices = np.array(vertices, dtype=np.float64)
    faces = np.array(faces, dtype=np.int64)
    _check_arrays(vertices, faces, source)
    welded, welded_faces, merged = _weld(vertices, faces)
    if (_undirected_counts(welded_faces) > 2).any() and (_undirected_counts(faces) == 2).all():
        merged = 0  # closed shells that touch along an edge stay apart
    else:
        vertices, faces = welded, welded_faces
    repairs = [f"merged {merged} duplicate vertices"] if merged else []
    faces, dropped = _without_useless_faces(vertices, faces, source)
    faces, filled = _closed(vertices, faces, source)
    faces, turned = _wound_outwards(vertices, faces, source)
    vertices, faces, united = _united(vertices, faces, source)
    repairs += dropped + filled + turned + united
    if repairs:
        warnings.warn(f"{source}: mended the mesh: {', '.join(repairs)}.", UserWarning, stacklevel=2)

    used, index = np.unique(faces, return_inverse=True)
    return np.ascontiguousarray(vertices[used]), np.ascontiguousarray(index.reshape(-1, 3).astype(np.int32))


def _without_useless_faces(vertices: Float64, faces: NDArray, source: str) -> tuple[NDArray, list[str]]:
    """Drop degenerate, double and loose faces, and return also the list of repairs.

    Of faces with the same corners one stays, or none where it would branch off the others, as a sheet within a body
    with both its sides. Raises InputError if no face remains.
    """
    repairs = []
    sound = _sound_faces(vertices, faces)
    if not sound.all():
        repairs.append(f"dropped {int((~sound).sum())} degenerate faces")
        faces = faces[sound]
    if len(faces) == 0:
        raise InputError(f"{source}: mesh has only degenerate faces.")
    if (_undirected_counts(faces) > 2).any():
        _, first, inverse, copies = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
        )
        once, alone = faces[np.sort(first)], faces[copies[inverse.ravel()] == 1]
        if len(alone) and (_undirected_counts(once) > 2).any():
            once = alone
        if len(once) < len(faces):
            repairs.append(f"dropped {len(faces) - len(once)} double faces")
            faces = once
    loose = _loose_faces(faces)
    if loose.any() and not loose.all():
        repairs.append(f"dropped {int(loose.sum())} loose faces")
        faces = faces[~loose]
    return faces, repairs


def _closed(vertices: Float64, faces: NDArray, source: str) -> tuple[NDArray, list[str]]:
    """Fill small holes, and return also the list of repairs. Raises InputError for open or non-manifold edges."""
    repairs = []
    counts = _undirected_counts(faces)
    if (counts == 1).any():
        filled = _without_slivers(vertices, _fill_holes(vertices, faces))
        if len(filled) > len(faces) and _sound_faces(vertices, filled).all():
            repairs.append(f"filled holes with {len(filled) - len(faces)} faces")
            faces = filled
            counts = _undirected_counts(faces)
    if (counts == 1).any():
        raise InputError(f"{source}: mesh is open, {int((counts == 1).sum())} boundary edges.")
    if (counts > 2).any():
        raise InputError(f"{source}: mesh has {int((counts > 2).sum())} edges shared by more than two faces.")
    return faces, repairs


def _wound_outwards(vertices: Float64, faces: NDArray, source: str) -> tuple[NDArray, list[str]]:
    """Wind all faces outwards, and return also the list of repairs. Raises InputError if that is impossible."""
    repairs = []
    if not _consistent(faces):
        import trimesh

        mesh = trimesh.Trimesh(vertices, faces, process=False)
        trimesh.repair.fix_winding(mesh)
        faces = np.array(mesh.faces, dtype=np.int64)
        if not _consistent(faces):
            raise InputError(f"{source}: mesh cannot be wound consistently (it is not orientable).")
        repairs.append("made the winding consistent")
    volume = signed_volume(vertices, faces)
    if volume < 0:
        faces = faces[:, ::-1]
        repairs.append("turned the winding outwards")
    if abs(volume) <= 1e-12 * float(np.ptp(vertices, axis=0).max()) ** 3:
        raise InputError(f"{source}: mesh encloses no volume.")
    return faces, repairs


def _check_arrays(vertices: NDArray, faces: NDArray, source: str) -> None:
    """Raise InputError unless both arrays have usable shapes, coordinates and indices."""
    # Faces are checked first, because without faces the readers return no vertices either.
    if faces.ndim != 2 or faces.shape[-1] != 3 or len(faces) == 0:
        raise InputError(f"{source}: mesh has 0 faces.")
    if vertices.ndim != 2 or vertices.shape[-1] != 3 or len(vertices) == 0:
        raise InputError(f"{source}: mesh has no vertices.")
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise InputError(f"{source}: mesh has {bad} vertices with NaN or infinite coordinates.")
    far = np.abs(vertices).max(axis=1)
    if far.max() > _FARTHEST:
        n = int((far > _FARTHEST).sum())
        raise InputError(
            f"{source}: mesh has {n} vertices with coordinates such as {far.max():g}; at most {_FARTHEST:g}."
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{source}: mesh has faces that name vertices outside 0..{len(vertices) - 1}.")


def _weld(vertices: Float64, faces: NDArray) -> tuple[Float64, NDArray, int]:
    """Merge vertices at the same position in order of first appearance; return also the number removed."""
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(vertices):
        return vertices, faces, 0
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return vertices[first[order]], rank[inverse.ravel()][faces], len(vertices) - len(first)


def _sound_faces(vertices: Float64, faces: NDArray) -> NDArray[np.bool_]:
    """Return which faces have three distinct corners and an area above rounding noise."""
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    extent = float(np.ptp(vertices, axis=0).max())
    return distinct & (face_normals_areas(vertices, faces)[1] > _DEGENERATE_AREA_FRACTION * extent**2)


def _directed_edges(faces: NDArray) -> NDArray[np.int64]:
    """Return the edges of all faces in their direction, int64[3 m, 2]."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)


def _edge_keys(faces: NDArray) -> NDArray[np.int64]:
    """Return a number for each of `_directed_edges`, int64[3 m]: the same for both directions of an edge."""
    edges = np.sort(_directed_edges(faces), axis=1)
    return np.asarray(edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1])


def _loose_faces(faces: NDArray) -> NDArray[np.bool_]:
    """Return which faces share no edge with another face; filling their outline would only double them."""
    _, inverse, counts = np.unique(_edge_keys(faces), return_inverse=True, return_counts=True)
    return np.asarray((counts[inverse.ravel()].reshape(3, -1) == 1).all(axis=0))


def _undirected_counts(faces: NDArray) -> NDArray[np.int64]:
    """Return the number of faces at each edge."""
    return np.unique(_edge_keys(faces), return_counts=True)[1]


def _consistent(faces: NDArray) -> bool:
    """Return whether every edge occurs once in each direction."""
    edges = _directed_edges(faces)
    count = int(faces.max()) + 1
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return bool((forward[1:] != forward[:-1]).all() and (forward == backward).all())


def _fill_holes(vertices: Float64, faces: NDArray) -> NDArray:
    """Close simple boundary loops with a fan: those of up to eight edges, and those without area."""
    _, inverse, counts = np.unique(_edge_keys(faces), return_inverse=True, return_counts=True)
    follow: dict[int, list[int]] = {}
    for a, b in _directed_edges(faces)[counts[inverse.ravel()] == 1]:
        follow.setdefault(int(b), []).append(int(a))  # reversed, as a filling face needs
    fans = [np.empty((0, 3), dtype=faces.dtype)]
    while follow:
        path = [next(iter(follow))]
        while follow.get(path[-1]):
            step = follow[path[-1]].pop()
            if step in path:  # a loop; the path goes on from where it began, since loops may touch in a vertex
                loop = path[path.index(step) :]
                del path[path.index(step) + 1 :]
                fan = np.array([(loop[0], *side) for side in pairwise(loop[1:])], dtype=faces.dtype)
                if len(fan) and (len(loop) <= _LARGEST_HOLE_EDGES or not _sound_faces(vertices, fan).any()):
                    fans.append(fan)
            else:
                path.append(step)
        follow.pop(path[-1], None)
    return np.vstack([faces, *fans])


def _without_slivers(vertices: Float64, faces: NDArray) -> NDArray:
    """Return the faces with those without area removed: each flips its longest edge with the face beyond it.

    A sliver (a, b, c), whose corner c lies on the edge ab, and its neighbour (b, a, d) become (c, a, d) and
    (d, b, c): the same surface, with the same outline. Of two slivers side by side, the one with the longer edge
    comes first, so every flip makes the edges shorter. The faces must be closed.
    """
    slivers = deque(map(int, np.flatnonzero(~_sound_faces(vertices, faces))))
    if not slivers:
        return faces
    least_area = _DEGENERATE_AREA_FRACTION * float(np.ptp(vertices, axis=0).max()) ** 2
    table = [tuple(face) for face in faces.tolist()]
    owner = {edge: k for k, face in enumerate(table) for edge in pairwise((*face, face[0]))}

    def longest(k: int) -> tuple[float, int, int, int]:
        """Return the length of a face's longest edge, its two corners, and the third corner."""
        a, b, c = table[k]
        turns = ((a, b, c), (b, c, a), (c, a, b))
        return max((float(np.linalg.norm(vertices[u] - vertices[v])), u, v, w) for u, v, w in turns)

    for _ in range(_MOST_FLIPS * len(slivers)):
        if not slivers:
            break
        k = slivers.popleft()
        length, a, b, c = longest(k)
        beyond = owner.get((b, a))
        if beyond is None or c in table[beyond] or (beyond in slivers and longest(beyond)[0] > length):
            slivers.append(k)
            continue
        (d,) = set(table[beyond]) - {a, b}
        del owner[a, b], owner[b, a]
        table[k], table[beyond] = (c, a, d), (d, b, c)
        slivers = deque(face for face in slivers if face != beyond)
        for face in (k, beyond):
            owner.update(dict.fromkeys(pairwise((*table[face], table[face][0])), face))
            u, v, w = (vertices[corner] for corner in table[face])
            if 0.5 * np.linalg.norm(np.cross(v - u, w - u)) <= least_area:
                slivers.append(face)
    return np.array(table, dtype=faces.dtype)


def _united(vertices: Float64, faces: NDArray, source: str) -> tuple[Float64, NDArray, list[str]]:
    """Return closed shells as one surface that bounds no place twice, and also the list of repairs.

    The shells come by falling volume, so that an outer one comes before what lies within: one wound outwards is
    added, one wound inwards is cut out. One wound inwards that cuts nothing lies outside of all others, so it is
    turned. Shells that neither overlap nor contain one another stay as they are, bit for bit.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    order = np.argsort(_edge_keys(faces), kind="stable") % len(faces)
    one, other = order.reshape(-1, 2).T  # the two faces of each edge
    graph = coo_array((np.ones(len(one), dtype=bool), (one, other)), shape=(len(faces), len(faces)))
    shells_n, label = connected_components(graph, directed=False)
    if shells_n == 1:
        return vertices, faces, []
    import manifold3d

    volumes = [signed_volume(vertices, faces[label == k]) for k in range(shells_n)]
    solid, total, faces = manifold3d.Manifold(), 0.0, faces.copy()
    for k in sorted(range(shells_n), key=lambda k: -abs(volumes[k])):
        outwards = faces[label == k][:, :: 1 if volumes[k] > 0 else -1]
        used, index = np.unique(outwards, return_inverse=True)
        shell = manifold3d.Manifold(manifold3d.Mesh64(vertices[used], index.reshape(-1, 3).astype(np.uint64)))
        if shell.status() != manifold3d.Error.NoError:
            warnings.warn(
                f"{source}: its {shells_n} closed shells, {sum(volumes):.6g} in volume, cannot be united "
                f"({shell.status().name} in one of them), so what lies in several counts as often.",
                UserWarning,
                stacklevel=3,
            )
            return vertices, faces, []
        if volumes[k] < 0 and (cut := solid - shell).volume() < solid.volume() * (1 - _SAME_VOLUME):
            solid, total = cut, total + volumes[k]
        else:
            solid, total = solid + shell, total + abs(volumes[k])
            faces[label == k] = outwards
    turned = sum(volumes) < total * (1 - _SAME_VOLUME)
    said = ["turned a shell outwards"] if turned else []
    if abs(solid.volume() / total - 1) <= _SAME_VOLUME:
        return vertices, faces, said
    mesh = solid.to_mesh64()
    said.append(
        f"united {shells_n} closed shells, which bound {total / solid.volume() - 1:.2%} of the volume twice"
    )
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64), said
