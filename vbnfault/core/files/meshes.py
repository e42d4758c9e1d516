"""Read Wavefront OBJ and glTF 2.0 meshes, which give the shapes of bodies and spacecraft.

The readers use names, positions, faces and transforms only. They never decode images, colours or normals, so no
image can fill the memory. They check every size that a file states before they allocate memory for it.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, shown
from ..frames import matrix_of
from . import path_checks, user_files

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MAX_FACES = 20_000_000
MAX_NODES = 100_000
MAX_PARTS = 10_000
MAX_NODE_DEPTH = 64
_LONGEST_NAME = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPart:
    """Hold the faces that a file lists under one name and one material; `material` is empty without one.

    `vertices` is float64[n, 3] in the file's unit and axes, `faces` is int64[m, 3] with indices into `vertices`.
    """

    name: str
    material: str
    vertices: F64
    faces: I64


def joined(parts: list[MeshPart]) -> tuple[F64, I64]:
    """Return the vertices and faces of all parts as one mesh."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, first, strict=False)]
    return vertices, np.concatenate([np.empty((0, 3), dtype=np.int64), *faces])


# --- Wavefront OBJ -----------------------------------------------------------------------------------------

_CONTINUED = re.compile(rb"(?:\\\r?\n[^\n\\]*)+")
_CORNER = re.compile(rb"[+-]?[0-9]+(?:/[+-]?[0-9]*){0,2}")
_TEXTURE_AND_NORMAL = re.compile(rb"/[-+0-9/]*")
# numbers of a vertex: x y z, with a weight, with a colour, with both
_VERTEX_WIDTHS = (3, 4, 6, 7)


def read_obj(data: bytes, source: str, *, name: str = "", may_count_from_0: bool = False) -> list[MeshPart]:
    """Return the faces of an OBJ file, one part for every object, group and material.

    trimesh is not used: it counts negative numbers from the end of the file, and it has no names of materials
    without their .mtl file.

    Parameters
    ----------
    data, source
        The file's bytes, and its name in error messages.
    name
        Name of the part that holds the faces outside every object and group.
    may_count_from_0
        Whether vertices are counted from 0 if a 0 occurs, as in shapes of the PDS.

    Returns
    -------
    parts
        Each part is named `object/group`. Polygons are split into triangle fans. A part holds only the vertices
        that its faces use.

    Raises
    ------
    InputError
        A vertex has no three finite numbers, a face has fewer than three corners, or a corner is no vertex number
        (numbers count from 1, or backwards from -1); the message gives the line. Or the file has more than 20
        million triangles or 10,000 parts.
    """
    file = _ObjFile(data, source, name)
    if len(file.parts) > MAX_PARTS:
        raise InputError(f"{source}: has {len(file.parts)} objects and groups; at most {MAX_PARTS} are read.")
    if not file.parts:
        return []
    vertices = file.vertices()
    corners, lengths = file.corners(len(vertices), may_count_from_0)
    triangles_n = int(lengths.sum()) - 2 * len(lengths)
    if triangles_n > MAX_FACES:
        raise InputError(f"{source}: has {triangles_n} triangles; at most {MAX_FACES} are read.")
    part_of_triangle = np.repeat(file.part_of_face, lengths - 2)
    triangles = fans(corners, lengths)[np.argsort(part_of_triangle, kind="stable")]
    ends = np.cumsum(np.bincount(part_of_triangle))
    parts = []
    for (part, material), faces in zip(file.parts, np.split(triangles, ends[:-1]), strict=True):
        used, compact = np.unique(faces, return_inverse=True)
        compact = compact.reshape(-1, 3).astype(np.int64)
        parts.append(MeshPart(name=part, material=material, vertices=vertices[used], faces=compact))
    return parts


class _ObjFile:
    """Hold the statements of an OBJ file: rows of vertices and faces, their lines, and the part of each face."""

    def __init__(self, data: bytes, source: str, name: str) -> None:
        self.source = source
        self.rows: dict[bytes, list[bytes]] = {b"v": [], b"f": []}
        self.lines: dict[bytes, list[int]] = {b"v": [], b"f": []}
        self.parts: dict[tuple[str, str], int] = {}  # name and material of each part that has faces
        self.part_of_face: list[int] = []
        self.vertices_above_face: list[int] = []
        naming, key = {b"o": "", b"g": "", b"usemtl": ""}, (name, "")
        # a continued line is joined, and followed by as many empty ones
        text = _CONTINUED.sub(lambda m: re.sub(rb"\\\r?\n", b" ", m[0]) + b"\n" * m[0].count(b"\n"), data)
        for number, line in enumerate(text.replace(b"\t", b" ").split(b"\n"), 1):
            word, _, rest = line.strip().partition(b" ")
            if word in self.rows:
                self.rows[word].append(rest.partition(b"#")[0] if b"#" in rest else rest)
                self.lines[word].append(number)
                if word == b"f":
                    self.part_of_face.append(self.parts.setdefault(key, len(self.parts)))
                    self.vertices_above_face.append(len(self.rows[b"v"]))
            elif word in naming:
                naming |= {b"g": ""} if word == b"o" else {}
                naming[word] = rest.decode("utf-8", "replace").strip()
                key = "/".join(filter(None, (naming[b"o"], naming[b"g"]))) or name, naming[b"usemtl"]

    def vertices(self) -> F64:
        """Return the positions of all vertices, float64[n, 3]. Raises InputError with the line of a wrong one."""
        rows = self.rows[b"v"]
        values, ends = _values(rows)
        width = np.diff(ends, prepend=-1) - 1
        if len(ends) == len(rows) and np.isin(width, _VERTEX_WIDTHS).all():
            vertices = values[(ends - width)[:, None] + np.arange(3)]
            if np.isfinite(vertices).all():
                return vertices
        for k, row in enumerate(rows):
            numbers, end = _values([row])
            if len(end) != 1 or end[0] not in _VERTEX_WIDTHS or not np.isfinite(numbers[:3]).all():
                raise self._error(b"v", k, "'v x y z', finite numbers")
        raise InputError(f"{self.source}: its vertices are unreadable.")

    def corners(self, vertices_n: int, may_count_from_0: bool) -> tuple[I64, I64]:
        """Return the vertices of all faces from 0, int64[corner], and how many each face has, int64[face].

        Raises InputError with the line of a wrong face.
        """
        rows = self.rows[b"f"]
        written, ends = _values([_TEXTURE_AND_NORMAL.sub(b"", row) if b"/" in row else row for row in rows])
        lengths = np.diff(ends, prepend=-1) - 1
        if len(ends) != len(rows) or (lengths < 3).any() or (written % 1 > 0).any():
            for k, row in enumerate(rows):
                words = row.split()
                if len(words) < 3 or not all(map(_CORNER.fullmatch, words)):
                    raise self._error(b"f", k, "'f a b c', three vertex numbers or more")
        written = np.delete(written, ends)
        face = np.repeat(np.arange(len(rows)), lengths)
        first = 0 if may_count_from_0 and (written == 0).any() else 1
        index = written - first
        if (written < 0).any():  # counted back from the last vertex above the face
            index = np.where(written < 0, np.array(self.vertices_above_face)[face] + written, index)
        outside = ~((index >= 0) & (index < vertices_n) & ((written < 0) | (written >= first)))
        if outside.any():
            k = int(np.argmax(outside))
            allowed = f"vertex numbers from {first} to {vertices_n - 1 + first}"
            raise self._error(b"f", int(face[k]), allowed, f"{written[k]:g}")
        return index.astype(np.int64), lengths

    def _error(self, kind: bytes, k: int, expected: str, given: str = "") -> InputError:
        """Return the error for statement `k` of a kind, with its line."""
        given = given or shown(self.rows[kind][k].decode("utf-8", "replace").strip())
        return InputError(f"{self.source}: line {self.lines[kind][k]}: expected {expected}, found {given}.")


def _values(lines: list[bytes]) -> tuple[F64, I64]:
    """Return all numbers of text rows, float64[n], with a NaN after each row, and the indices of these NaNs.

    Both are empty where the text holds anything but numbers. A "nan" in the text shows as an additional index.
    """
    values = numbers_of(b" nan\n".join([*lines, b""])) if lines else None
    values = np.empty(0) if values is None else values
    return values, np.flatnonzero(np.isnan(values))


def numbers_of(text: bytes) -> F64 | None:
    """Return all numbers of a text, or None if anything else is in it; "nan" and overflows are accepted."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # some versions of numpy warn here, others raise
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")  # type: ignore[call-overload]
        except (ValueError, DeprecationWarning):
            return None


def fans(index: I64, corners: I64) -> I64:
    """Return polygons with the given numbers of corners as triangles int64[m, 3], fans about each first corner."""
    starts = np.cumsum(corners) - corners
    triangles = corners - 2
    first = np.repeat(starts, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles) + 1
    return np.stack([index[first], index[first + step], index[first + step + 1]], axis=1)


# --- glTF 2.0 ----------------------------------------------------------------------------------------------

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# These extensions store the geometry in another form; all others concern data that is not read.
_NOT_READ = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "EXT_mesh_gpu_instancing")


def read_gltf(data: bytes, source: str, *, folder: Path | None = None) -> list[MeshPart]:
    """Return the triangles of the scene in a glTF 2.0 file (GLB or JSON), in the axes of that scene.

    Parameters
    ----------
    data, source
        The file's bytes, and its name in error messages.
    folder
        Folder of the files that hold the buffers of a .gltf.

    Returns
    -------
    parts
        One part per primitive of a mesh, with one material, named by the path of its node.

    Raises
    ------
    InputError
        The file is not glTF 2.0, needs an extension that is not read, holds a number outside its allowed range (the
        message names the node, mesh or accessor), has a node below two nodes or below itself, or has more than 20
        million triangles or vertices or 10,000 parts.
    """
    file = _Gltf(source, *_chunks(data, source), folder)
    extensions = file.table.get("extensionsRequired", [])
    for name in extensions if isinstance(extensions, list) else ():
        if name in _NOT_READ:
            raise InputError(f"{source}: extensionsRequired = {shown(name)}: is not read; export without it.")
    parts: list[MeshPart] = []
    triangles_n = vertices_n = 0
    for path, mesh, V_from_node in file.instances():
        for vertices, faces, material in file.primitives(mesh):
            triangles_n += len(faces)
            vertices_n += len(vertices)
            if max(triangles_n, vertices_n) > MAX_FACES or len(parts) >= MAX_PARTS:
                raise InputError(
                    f"{source}: has more than {MAX_FACES} triangles or vertices, or {MAX_PARTS} parts, in all."
                )
            mirrored = np.linalg.det(V_from_node[:3, :3]) < 0
            with np.errstate(over="ignore", invalid="ignore"):  # the check of the mesh reports it
                placed = vertices @ V_from_node[:3, :3].T + V_from_node[:3, 3]
            parts.append(
                MeshPart(name=path, material=material, vertices=placed, faces=faces[:, ::-1] if mirrored else faces)
            )
    return parts


def _chunks(data: bytes, source: str) -> tuple[Any, bytes]:
    """Return the JSON of a glTF file as plain data, and the binary chunk of a GLB, empty without one."""
    text, binary = data, b""
    if data[:4] == b"glTF":
        if len(data) < 20 or struct.unpack_from("<I", data, 4)[0] != 2:
            raise InputError(f"{source}: must be a GLB of version 2.")
        offset = 12
        chunks: dict[bytes, bytes] = {}
        while offset + 8 <= len(data):
            (length,), kind = struct.unpack_from("<I", data, offset), data[offset + 4 : offset + 8]
            if offset + 8 + length > len(data):
                raise InputError(f"{source}: is cut short: a chunk of {length} bytes begins at byte {offset}.")
            chunks.setdefault(kind, data[offset + 8 : offset + 8 + length])
            offset += 8 + length + -length % 4
        text, binary = chunks.get(b"JSON", b""), chunks.get(b"BIN\0", b"")
    try:
        table = json.loads(text)
    except RecursionError:
        raise InputError(f"{source}: its JSON is nested too deep.") from None
    except ValueError as error:  # text that is not UTF-8, too
        raise InputError(f"{source}: its JSON is unreadable: {error}.") from None
    if not isinstance(table, dict):
        raise InputError(f"{source}: its JSON must be a table; found {shown(table)}.")
    return table, binary


class _Gltf:
    """Look up items of a glTF file, and check each item that is looked up."""

    def __init__(self, source: str, table: Mapping[str, Any], binary: bytes, folder: Path | None) -> None:
        self.source, self.table, self.binary, self.folder = source, table, binary, folder
        self.meshes: dict[int, list[tuple[F64, I64, str]]] = {}
        self.buffers: dict[int, bytes] = {}

    def error(self, where: str, value: object, allowed: str) -> InputError:
        """Return the error that names a key, its value and what is allowed."""
        return InputError(f"{self.source}: {where} = {shown(value)}: must be {allowed}.")

    def item(self, kind: str, index: Any, where: str) -> Mapping[str, Any]:
        """Return table `index` of the list `kind`; `where` is the key that refers to it."""
        items = self.table.get(kind, [])
        if not isinstance(items, list):
            raise self.error(kind, items, "a list")
        if type(index) is not int or not 0 <= index < len(items):
            raise self.error(where, index, f"a number of {kind}, from 0 to {len(items) - 1}")
        if not isinstance(items[index], dict):
            raise self.error(f"{kind}[{index}]", items[index], "a table")
        return items[index]

    def whole(self, table: Mapping[str, Any], key: str, where: str, high: int, default: int | None = None) -> int:
        """Return the whole number of a key, from 0 to `high`."""
        value = table.get(key, default)
        if type(value) is not int or not 0 <= value <= high:
            raise self.error(f"{where}.{key}", value, f"a whole number from 0 to {high}")
        return value

    def reals(self, value: Any, count: int, where: str) -> F64:
        """Return a list of `count` finite numbers as float64[count]."""
        if not isinstance(value, list) or len(value) != count or not all(type(v) in (int, float) for v in value):
            raise self.error(where, value, f"a list of {count} numbers")
        if not all(abs(v) < 1e30 for v in value):  # nan fails too
            raise self.error(where, value, f"{count} finite numbers below 1e30")
        return np.array(value, dtype=np.float64)

    def instances(self) -> Iterator[tuple[str, int, F64]]:
        """Yield path, mesh index and V_from_node float64[4, 4] of each node with a mesh; V has the scene's axes."""
        nodes = self.table.get("nodes", [])
        if not isinstance(nodes, list) or len(nodes) > MAX_NODES:
            given = f"{len(nodes)} nodes" if isinstance(nodes, list) else nodes
            raise self.error("nodes", given, f"a list of at most {MAX_NODES}")
        if self.table.get("scenes"):
            roots = self.item("scenes", self.table.get("scene", 0), "scene").get("nodes", [])
        else:
            below = {
                c for node in nodes if isinstance(node, dict) for c in _list(node.get("children")) if type(c) is int
            }
            roots = [k for k in range(len(nodes)) if k not in below]
        roots, seen = _list(roots), set[int]()
        for k in roots:
            yield from self._below(k, "", np.eye(4), 0, seen, alone=len(roots) == 1)

    def _below(
        self, k: Any, path: str, V_from_above: F64, depth: int, seen: set[int], *, alone: bool = False
    ) -> Iterator[tuple[str, int, F64]]:
        """Yield what `instances` yields of a node and of the nodes below it."""
        node = self.item("nodes", k, "node")
        where = f"nodes[{k}]"
        if k in seen:
            raise InputError(f"{self.source}: {where}: is below two nodes, or below itself.")
        if depth > MAX_NODE_DEPTH:
            raise InputError(f"{self.source}: {where}: lies below more than {MAX_NODE_DEPTH} nodes.")
        seen.add(k)
        name = str(node.get("name", f"node_{k}"))[:_LONGEST_NAME].replace("/", "_")
        children = node.get("children", [])
        if not isinstance(children, list):
            raise self.error(f"{where}.children", children, "a list")
        if not (alone and name == "world" and "mesh" not in node):  # a root that some writers add without need
            path = f"{path}/{name}" if path else name
        with np.errstate(over="ignore", invalid="ignore"):
            V_from_node = V_from_above @ self.transform(node, where)
        if "mesh" in node:
            yield path, node["mesh"], V_from_node
        for child in children:
            yield from self._below(child, path, V_from_node, depth + 1, seen)

    def transform(self, node: Mapping[str, Any], where: str) -> F64:
        """Return the matrix float64[4, 4] from a node's axes to those of the node above."""
        if "matrix" in node:
            return self.reals(node["matrix"], 16, f"{where}.matrix").reshape(4, 4).T  # stored by columns
        x, y, z, w = self.reals(node.get("rotation", [0, 0, 0, 1]), 4, f"{where}.rotation")
        scale = self.reals(node.get("scale", [1, 1, 1]), 3, f"{where}.scale")
        matrix = np.eye(4)
        matrix[:3, :3] = matrix_of(w, x, y, z) * scale
        matrix[:3, 3] = self.reals(node.get("translation", [0, 0, 0]), 3, f"{where}.translation")
        return matrix

    def primitives(self, mesh: Any) -> list[tuple[F64, I64, str]]:
        """Return vertices, triangles and material name of each of a mesh's primitives that has triangles."""
        table = self.item("meshes", mesh, "mesh")
        if mesh in self.meshes:
            return self.meshes[mesh]
        parts = []
        for k, primitive in enumerate(_list(table.get("primitives"))):
            where = f"meshes[{mesh}].primitives[{k}]"
            if not isinstance(primitive, dict):
                raise self.error(where, primitive, "a table")
            mode = self.whole(primitive, "mode", where, _FAN, _TRIANGLES)
            attributes = primitive.get("attributes", {})
            if mode < _TRIANGLES or not isinstance(attributes, dict) or "POSITION" not in attributes:
                continue  # points and lines
            vertices = self.accessor(attributes["POSITION"], "VEC3", f"{where}.attributes.POSITION")
            if "indices" in primitive:
                index = self.accessor(primitive["indices"], "SCALAR", f"{where}.indices")[:, 0].astype(np.int64)
            else:
                index = np.arange(len(vertices))
            if len(index) and index.max() >= len(vertices):
                raise self.error(f"{where}.indices", int(index.max()), f"from 0 to {len(vertices) - 1}")
            material = ""
            if "material" in primitive:
                material = str(self.item("materials", primitive["material"], f"{where}.material").get("name") or "")
            faces = _triangles(index, mode)
            parts.append((np.asarray(vertices, dtype=np.float64), faces, material[:_LONGEST_NAME]))
        self.meshes[mesh] = parts
        return parts

    def accessor(self, index: Any, kind: str, where: str) -> NDArray[Any]:
        """Return the numbers of an accessor, [count, 1] for SCALAR or [count, 3] for VEC3."""
        table = self.item("accessors", index, where)
        key = f"accessors[{index}]"
        width = {"SCALAR": 1, "VEC3": 3}[kind]
        component = table.get("componentType")
        if table.get("type") != kind:
            raise self.error(f"{key}.type", table.get("type"), kind)
        if type(component) is not int or component not in _COMPONENTS:
            raise self.error(f"{key}.componentType", component, f"one of {', '.join(map(str, _COMPONENTS))}")
        dtype = np.dtype(_COMPONENTS[component])
        count = self.whole(table, "count", key, 3 * MAX_FACES)
        if "bufferView" not in table or "sparse" in table:
            raise self.error(key, table, "values in a bufferView, none of them sparse")
        values = self.view(table, key, dtype, count, width)
        if table.get("normalized") is True and dtype.kind != "f":
            return np.maximum(values / float(np.iinfo(dtype).max), -1.0)
        return values

    def view(self, table: Mapping[str, Any], where: str, dtype: np.dtype, count: int, width: int) -> NDArray[Any]:
        """Return the numbers [count, width] of the buffer view that a table names."""
        number = table.get("bufferView")
        view = self.item("bufferViews", number, f"{where}.bufferView")
        key = f"bufferViews[{number}]"
        buffer = self.buffer(view.get("buffer"), f"{key}.buffer")
        start = self.whole(view, "byteOffset", key, len(buffer), 0)
        length = self.whole(view, "byteLength", key, len(buffer) - start)
        offset = self.whole(table, "byteOffset", where, length, 0)
        element = dtype.itemsize * width
        stride = self.whole(view, "byteStride", key, 252, element) or element
        end = offset + stride * (count - 1) + element if count else offset
        if end > length:
            raise self.error(f"{where}.count", count, f"at most what the {length} bytes of {key} hold")
        return np.ndarray((count, width), dtype, buffer, offset=start + offset, strides=(stride, dtype.itemsize))

    def buffer(self, index: Any, where: str) -> bytes:
        """Return the bytes of a buffer, from the GLB, a data URI or a file in the folder of the .gltf."""
        table = self.item("buffers", index, where)
        if index in self.buffers:
            return self.buffers[index]
        uri = table.get("uri")
        key = f"buffers[{index}].uri"
        if uri is None:
            data = self.binary
        elif not isinstance(uri, str):
            raise self.error(key, uri, "a text")
        elif uri.startswith("data:"):
            try:
                data = base64.b64decode(uri.partition(",")[2], validate=True)
            except (binascii.Error, ValueError):
                raise self.error(key, uri, "base64 after its comma") from None
        else:
            name = Path(unquote(uri))
            if self.folder is None or name.is_absolute() or ".." in name.parts:
                raise self.error(key, uri, "a file in the folder of the .gltf")
            path_checks.check_path(str(name), f"{self.source}: {key}")
            data = user_files.read_input(self.folder / name, "spacecraft")
        self.buffers[index] = data
        return data


def _list(value: Any) -> list[Any]:
    """Return the value where it is a list, else an empty list."""
    return value if isinstance(value, list) else []


def _triangles(index: I64, mode: int) -> I64:
    """Return the triangles int64[m, 3] of a list, strip or fan of corners."""
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if mode == _FAN:
        return fans(index, np.array([max(len(index), 2)]))
    k = np.arange(max(len(index) - 2, 0))
    turned = k % 2  # every second triangle of a strip has its corners in reverse order
    return np.stack([index[k], index[k + 1 + turned], index[k + 2 - turned]], axis=1)
