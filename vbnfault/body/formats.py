"""Read the shape formats of small-body science: plate tables, v/f lines, Gaskell's ICQ, VRML and NAIF's DSK.

Each reader here takes a file's bytes and the name for messages (`core.spice` reads DSKs). It returns the mesh as
stored: vertices float64[n, 3] in the file's unit, and faces int64[m, 3], counted from 0, with all indices in range.
`shape.check_mesh` then checks whether the mesh bounds a solid. A malformed file raises InputError with the line
number.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core import spice
from ..core.errors import InputError

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Mesh = tuple[Float64, Int64]
Lines = Callable[[int], int]

SUFFIXES = (".tab", ".plt", ".ver", ".txt", ".icq", ".wrl", ".bds")

_UNSIGNED = rb"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_NUMBER = rb"[+-]?" + _UNSIGNED
_NOT_A_NUMBER = re.compile(rb"(?<!\S)(?!" + _NUMBER + rb"(?:-" + _UNSIGNED + rb")*(?!\S))\S+")
_FORTRAN = bytes.maketrans(b"Dd,", b"Ee ")
_GLUED = re.compile(rb"(?<=[0-9.])-")
# An ICQ stores the common edges of its six faces twice, rounded alike. If the two copies differ by more than this
# fraction of the extent, the edges do not meet.
_ICQ_GAP_FRACTION = 1e-3


@dataclass(frozen=True, eq=False)
class RawShape:
    """Hold a mesh as its file stores it.

    Attributes
    ----------
    vertices, faces
        float64[n, 3] in the file's unit, int64[m, 3] from 0.
    unit
        "km" if the format defines it, else None.
    """

    vertices: Float64
    faces: Int64
    unit: Literal["km"] | None = None


def read_shape(path: Path, data: bytes) -> RawShape:
    """Return the mesh in a file; the content `data` and the suffix (one of `SUFFIXES`) select the reader.

    Raises
    ------
    InputError
        The file has none of these formats or is malformed, or it is a DSK and spiceypy is not installed.
    """
    source = str(path)
    head = data[:65536]
    if head.startswith((b"DAS/DSK", b"NAIF/DAS")):
        return RawShape(*spice.read_dsk(path), unit="km")
    if path.suffix.lower() == ".bds":
        raise InputError(f"{source}: line 1: expected the mark 'DAS/DSK' of a NAIF DSK, found {_shown(head)}.")
    if b"\0" in data:
        raise InputError(f"{source}: line {_line(data, data.index(0))}: expected text, found binary data.")
    if re.match(rb"\s*#VRML", data) or path.suffix.lower() == ".wrl":
        return RawShape(*read_vrml(data, source))
    data = _without_comments(data)
    if not data.translate(_FORTRAN).strip():
        raise InputError(f"{source}: line 1: expected vertices and facets, found nothing.")
    if re.match(rb"\s*[A-Za-z]", data):
        return RawShape(*read_vertex_facet_letters(data, source))
    if path.suffix.lower() == ".icq" or _is_icq(data):
        return RawShape(*read_icq(data, source))
    return RawShape(*read_plate_table(data, source))


def read_plate_table(data: bytes, source: str) -> Mesh:
    """Read a table of vertices and a table of triangular plates, as in the PDS Small Bodies Node's models.

    The numbers of vertices and plates stand at the start of the file, or each above its table. A vertex is `x y z`,
    a plate is three vertex numbers. Each may be preceded by its own number; a plate may instead be preceded by the
    count 3, as in OSIRIS's .ver files. Vertex numbers are counted from 1, or from 0 if a 0 occurs. Fixed and free
    format, commas and D exponents are accepted.

    Raises
    ------
    InputError
        With the line: a token is not a number, a table differs from its count, a vertex number is out of range, or
        the vertices are given as latitude, longitude and radius.
    """
    table = _numbers(data, source)
    first = table[0]
    if not (first == np.floor(first) and 4 <= first < 2**31):
        number = _token_line(data, 0)
        raise InputError(
            f"{source}: line {number}: expected the number of vertices, an integer of at least 4, found {first:g}."
        )
    layout = _layout(table)
    if layout is None:
        raise _table_error(data, table, source)
    vertex_at, vertex_width, face_at, face_width, faces_n = layout
    vertices_n = int(first)
    vertices = table[vertex_at : vertex_at + vertex_width * vertices_n].reshape(-1, vertex_width)[:, -3:]
    faces = table[face_at : face_at + face_width * faces_n].reshape(-1, face_width)[:, -3:]

    def line(row: int) -> int:
        """Return the line of a plate."""
        return _token_line(data, face_at + face_width * row + face_width - 3)

    mesh = _from_one(vertices, faces, source, line)
    x, y, z = mesh[0].T
    # A Cartesian model centred on the body has vertices on both sides of the equator, so z is not always positive.
    if z.min() > 0 and np.abs(x).max() <= 90 and np.ptp(x) > 150 and y.min() >= -180 and np.ptp(y) > 300:
        number = _token_line(data, vertex_at)
        raise InputError(
            f"{source}: line {number}: expected Cartesian coordinates, found what looks like latitude, longitude "
            "and radius."
        )
    return mesh


def read_vertex_facet_letters(data: bytes, source: str) -> Mesh:
    """Read lines `v x y z` and `f a b c`, as in the PDS's radar shapes and early models of Eros.

    Vertex numbers are counted from 1, or from 0 if a 0 occurs. Polygons are split into fans. The reader ignores
    anything after the coordinates or after a slash, and the other statements of an OBJ file.

    Raises
    ------
    InputError
        With the line: other text, too few numbers, numbers out of range.
    """
    vertex_rows = re.findall(rb"(?m)^[ \t]*v[ \t]+([^\r\n]*)", data)
    face_rows = re.findall(rb"(?m)^[ \t]*f[ \t]+([^\r\n]*)", data)
    other = re.search(rb"(?m)^[ \t]*(?!(?:v|f|vn|vt|g|o|s|usemtl|mtllib)(?:[ \t]|[\r\n]|\Z))[^\s]", data)
    if other:
        raise _not_a_statement(data, other.start(), source)
    end = _line(data, len(data.rstrip()))
    if not vertex_rows or not face_rows:
        missing = "f a b c" if vertex_rows else "v x y z"
        raise InputError(f"{source}: line {end}: expected lines {missing!r}, found none before the end.")
    if any(b"/" in row for row in face_rows[:1]):
        face_rows = [re.sub(rb"/\S*", b"", row) for row in face_rows]
    vertices = _rows(vertex_rows, "v x y z", source, lambda row: _letter_line(data, b"v", row))
    polygons = _rows(face_rows, "f a b c", source, lambda row: _letter_line(data, b"f", row))
    corners = polygons.shape[1]
    fan = np.array([(0, k, k + 1) for k in range(1, corners - 1)])
    return _from_one(
        vertices[:, :3],
        polygons[:, fan].reshape(-1, 3),
        source,
        lambda row: _letter_line(data, b"f", row // (corners - 2)),
    )


def read_icq(data: bytes, source: str) -> Mesh:
    """Read Gaskell's implicitly connected quadrilaterals: Q, then 6(Q + 1)² vertices on the faces of a cube.

    The six faces are joined at their edges. Each quadrilateral is split along its shorter diagonal and wound
    outwards. A fourth column (albedo) is ignored.

    Source: Gaskell, "The Implicitly Connected Quadrilateral Format", document icqmodel of the PDS data set
    HAY-A-AMICA-5-ITOKAWASHAPE-V1.0. It gives the order of the vertices and says which of them coincide.

    Raises
    ------
    InputError
        With the line: a token is not a number, the number of vertices does not fit Q, or edges do not meet.
    """
    table = _numbers(data, source)
    q, width = _icq_size(table, data, source)
    listed = table[1:].reshape(-1, width)[:, :3]
    _, first, vertex = np.unique(_icq_positions(q), return_index=True, return_inverse=True)
    vertex = vertex.ravel()
    vertices = listed[first]
    gap = np.abs(listed - vertices[vertex]).max(axis=1)
    worst = int(np.argmax(gap))
    if gap[worst] > _ICQ_GAP_FRACTION * np.ptp(listed, axis=0).max():
        line = _token_line(data, 1 + worst * width)
        raise InputError(f"{source}: line {line}: expected the vertex that the neighbouring face has there.")
    faces = _icq_triangles(vertices, vertex.reshape(6, q + 1, q + 1))
    corners = vertices[faces]
    if np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) < 0:  # six times the signed volume
        faces = faces[:, ::-1]
    return vertices, faces.astype(np.int64)


def read_vrml(data: bytes, source: str) -> Mesh:
    """Read all IndexedFaceSets of a VRML 1 or 2 file; polygons are split into fans.

    Named coordinates (DEF) may be used again (USE).

    Raises
    ------
    InputError
        With the line: a transform is not the identity or geometry is used again, which would change the shape
        silently; or a list is not closed, holds anything but numbers, or names points that do not exist.
    """
    if not re.match(rb"\s*#VRML", data):
        raise InputError(
            f"{source}: line 1: expected '#VRML V1.0 ascii' or '#VRML V2.0 utf8', found {_shown(data)}."
        )
    # Strings and comments are overwritten with blanks, not removed, so that line numbers stay correct.
    text = re.sub(rb'"(?:\\.|[^"\\])*(?:"|\Z)|#[^\r\n]*', lambda m: re.sub(rb"[^\r\n]", b" ", m[0]), data)
    vertices: list[Float64] = []
    faces: list[Int64] = []
    base = 0
    for points, index in _FaceSetScanner(text, source).face_sets():
        coordinates = _list_numbers(text, points, source)
        if len(coordinates) % 3 or len(coordinates) == 0:
            raise InputError(
                f"{source}: line {_line(text, points.start())}: expected points of three coordinates, "
                f"found {len(coordinates)} numbers."
            )
        triangles = _fans(_list_numbers(text, index, source), len(coordinates) // 3, text, index, source)
        vertices.append(coordinates.reshape(-1, 3))
        faces.append(triangles + base)
        base += len(coordinates) // 3
    if not faces:
        end = _line(data, len(data.rstrip()))
        raise InputError(f"{source}: line {end}: expected an IndexedFaceSet, found none before the end.")
    return np.concatenate(vertices), np.concatenate(faces)


# --- numbers and lines ---------------------------------------------------------------------------------------


def _line(data: bytes, offset: int) -> int:
    """Return the line number of a byte offset."""
    return data.count(b"\n", 0, offset) + 1


def _shown(data: bytes) -> str:
    """Return the first characters of some bytes, for a message."""
    return repr(data.strip()[:24].split(b"\n")[0].decode("ascii", "replace"))


def _token_line(data: bytes, token: int) -> int:
    """Return the line of a number, counted from 0. This is slow and serves messages only."""
    data = _clean(data)
    start = 0
    for count, match in enumerate(re.finditer(rb"\S+", data)):
        start = match.start()
        if count == token:
            break
    return _line(data, start)


def _without_comments(data: bytes) -> bytes:
    """Return the text without # comments and without blanks at its end."""
    data = data.rstrip(b"\x1a\r\n\t ")
    return re.sub(rb"#[^\r\n]*", b"", data) if b"#" in data else data


def _clean(data: bytes) -> bytes:
    """Return the text with E exponents, without commas, and with blanks between numbers.

    In Fortran's fixed columns, the blank before a minus sign may be missing.
    """
    return _GLUED.sub(b" -", data.translate(_FORTRAN))


def _parsed(data: bytes) -> Float64 | None:
    """Return all numbers of a text, or None if anything else is in it; "nan" and overflows are accepted."""
    text = data.translate(_FORTRAN)
    if not text.strip():
        return np.empty(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # some versions of numpy warn here, others raise
        for clean in (lambda: text, lambda: _clean(text)):  # few files need the search for glued numbers
            try:
                return np.fromstring(clean(), dtype=np.float64, sep=" ")  # type: ignore[call-overload]
            except (ValueError, DeprecationWarning):
                continue
    return None


def _numbers(data: bytes, source: str, lines: Lines = lambda line: line) -> Float64:
    """Return all numbers of a text, float64[n], finite. `lines` maps a line of the text to a line of the file."""
    values = _parsed(data)
    if values is not None and np.isfinite(values).all():
        return values
    wrong = _NOT_A_NUMBER.search(data.translate(_FORTRAN))  # both texts are equally long, so offsets agree
    if wrong is None:
        line = 1 if values is None else _token_line(data, int(np.argmin(np.isfinite(values))))
        raise InputError(f"{source}: line {lines(line)}: expected a number, found one that is too large.")
    line, shown = _line(data, wrong.start()), _shown(data[wrong.start() : wrong.end()])
    raise InputError(f"{source}: line {lines(line)}: expected a number, found {shown}.")


def _from_one(vertices: Float64, faces: Float64, source: str, line: Lines) -> Mesh:
    """Convert vertex numbers from 1 (or from 0 if a 0 occurs) to indices; `line` maps rows of `faces` to lines."""
    broken = (faces != np.floor(faces)).any(axis=1)
    if broken.any():
        row = int(np.argmax(broken))
        raise InputError(f"{source}: line {line(row)}: expected three vertex numbers, found {_listed(faces[row])}.")
    lowest = 0 if len(faces) and faces.min() == 0 else 1
    highest = len(vertices) - 1 + lowest
    outside = ((faces < lowest) | (faces > highest)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise InputError(
            f"{source}: line {line(row)}: expected vertex numbers from {lowest} to {highest}, "
            f"found {_listed(faces[row])}."
        )
    return np.ascontiguousarray(vertices), faces.astype(np.int64) - lowest


def _listed(values: Float64) -> str:
    """Return numbers as text, for a message."""
    return " ".join(f"{value:g}" for value in values)


# --- plate tables --------------------------------------------------------------------------------------------


def _is_icq(data: bytes) -> bool:
    """Return whether a lone number in the first line is the Q of an ICQ, not the vertex count of a plate table."""
    rows = re.finditer(rb"\S[^\n]*", data)
    header = next(rows)[0].strip()
    if not re.fullmatch(rb"[0-9]{1,9}", header):
        return False
    # A closed plate table of n vertices has at most 3n rows, an ICQ has 6(Q + 1)². The plate table also has the
    # number of facets on a separate line after its n vertices.
    if data.count(b"\n") <= 4 * int(header):
        return False
    after = next(islice(rows, int(header), None), None)
    return after is not None and len(after[0].split()) > 1


def _counted(column: Float64) -> bool:
    """Return whether a column counts rows from 0 or from 1."""
    return bool((column == np.arange(len(column)) + column[0]).all() and column[0] in (0, 1))


def _layout(table: Float64) -> tuple[int, int, int, int, int] | None:
    """Return the first layout that fits the whole table, or None.

    The layout is start and width of the vertices, then start, width and number of the facets.
    """
    vertices_n = int(table[0])
    for both_first in (True, False):
        for vertex_width in (4, 3):
            vertex_at = 2 if both_first else 1
            vertices_end = vertex_at + vertex_width * vertices_n
            count_at = 1 if both_first else vertices_end
            if count_at >= len(table) or vertices_end > len(table):
                continue
            faces_n = table[count_at]
            face_at = vertices_end + (0 if both_first else 1)
            for face_width in (4, 3):
                if not (
                    faces_n == np.floor(faces_n) and faces_n >= 1 and len(table) == face_at + face_width * faces_n
                ):
                    continue
                vertices = table[vertex_at:vertices_end].reshape(-1, vertex_width)
                faces = table[face_at:].reshape(-1, face_width)
                if vertex_width == 4 and not _counted(vertices[:, 0]):
                    continue
                if face_width == 4 and not (_counted(faces[:, 0]) or (faces[:, 0] == 3).all()):
                    continue
                return vertex_at, vertex_width, face_at, face_width, int(faces_n)
    return None


def _table_error(data: bytes, table: Float64, source: str) -> InputError:
    """Return the error for a table without a layout, with the first line that contradicts the counts."""

    def error(line: int, expected: str, given: str) -> InputError:
        return InputError(f"{source}: line {line}: expected {expected}, found {given}.")

    rows: Iterator[tuple[int, list[bytes]]] = (
        (number, row.split()) for number, row in enumerate(_clean(data).split(b"\n"), 1) if row.strip()
    )
    line, header = next(rows)
    vertices_n = int(table[0])
    if len(header) > 2:
        return error(line, "the number of vertices and of facets", f"{len(header)} numbers")
    faces_n = int(table[1]) if len(header) == 2 else 0
    for kind, length in (("vertex", vertices_n), ("facet", None)):
        if kind == "facet" and len(header) == 1:
            line, row = next(rows, (line, []))
            if len(row) != 1 or not row[0].isdigit():
                return error(
                    line, f"the number of facets after {vertices_n} vertices", b" ".join(row).decode() or "the end"
                )
            faces_n = int(row[0])
        total = faces_n if length is None else length
        width = 0
        for k in range(1, total + 1):
            line, row = next(rows, (line, []))
            if not row:
                return error(
                    line, f"{total} {'vertices' if kind == 'vertex' else 'facets'}", f"the end after {k - 1}"
                )
            width = width or len(row)
            if len(row) != width or width not in (3, 4):
                width_allowed = f"{width} numbers" if width in (3, 4) else "3 or 4 numbers"
                return error(line, f"{width_allowed} for {kind} {k} of {total}", str(len(row)))
            if width == 4 and float(row[0]) not in (k, k - 1, 3):
                return error(line, f"number {k} in front of a {kind}", row[0].decode())
    line, row = next(rows, (line, []))
    if row:
        return error(line, f"the end after {vertices_n} vertices and {faces_n} facets", f"{len(row)} more numbers")
    return error(
        1, "the number of vertices and of facets, then the two tables", f"{len(table)} numbers in no such order"
    )


# --- ICQ ----------------------------------------------------------------------------------------------------


def _icq_size(table: Float64, data: bytes, source: str) -> tuple[int, int]:
    """Return Q and the number of columns of an ICQ's table of vertices, 3 or 4. Raises InputError."""
    q = int(table[0]) if 1 <= table[0] < 2**15 and table[0] == np.floor(table[0]) else 0
    if q == 0:
        raise InputError(
            f"{source}: line {_token_line(data, 0)}: expected Q, a positive integer, found {table[0]:g}."
        )
    count = 6 * (q + 1) ** 2
    if len(table) - 1 not in (3 * count, 4 * count):
        raise InputError(
            f"{source}: line {_token_line(data, len(table) - 1)}: expected {count} vertices of three numbers "
            f"for Q = {q}, found {len(table) - 1} numbers."
        )
    return q, (len(table) - 1) // count


def _icq_positions(q: int) -> Int64:
    """Return a number for the position of each listed vertex on a cube of side Q, int64[6(Q + 1)²].

    Vertex (i, j) of each face is listed with i running fastest. Exactly those vertices get equal numbers that the
    format declares to be the same.
    """
    j, i = np.meshgrid(np.arange(q + 1), np.arange(q + 1), indexing="ij")
    zero, full = np.zeros_like(i), np.full_like(i, q)
    faces = (
        (i, j, full),
        (i, full, q - j),
        (zero, i, q - j),
        (q - i, zero, q - j),
        (full, q - i, q - j),
        (i, q - j, zero),
    )
    return np.concatenate([((x * (q + 1) + y) * (q + 1) + z).ravel() for x, y, z in faces])


def _icq_triangles(vertices: Float64, grid: Int64) -> Int64:
    """Split the quadrilaterals of the six faces, indices int64[6, Q + 1, Q + 1], along their shorter diagonals."""
    a, b, c, d = (part.ravel() for part in (grid[:, :-1, :-1], grid[:, :-1, 1:], grid[:, 1:, 1:], grid[:, 1:, :-1]))
    ac = np.linalg.norm(vertices[a] - vertices[c], axis=1)
    bd = np.linalg.norm(vertices[b] - vertices[d], axis=1)
    along_ac = (ac <= bd)[:, None]
    return np.concatenate(
        [
            np.where(along_ac, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1)),
            np.where(along_ac, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1)),
        ]
    )


# --- v and f lines -------------------------------------------------------------------------------------------


def _not_a_statement(data: bytes, offset: int, source: str) -> InputError:
    """Return the error for a line that is neither a vertex nor a facet."""
    given = _shown(data[offset : offset + 80])
    return InputError(f"{source}: line {_line(data, offset)}: expected 'v x y z' or 'f a b c', found {given}.")


def _letter_line(data: bytes, letter: bytes, row: int) -> int:
    """Return the line of the statement with this letter and row number."""
    for count, match in enumerate(re.finditer(rb"(?m)^[ \t]*" + letter + rb"[ \t]+", data)):
        if count == row:
            return _line(data, match.end())
    return _line(data, len(data))


def _rows(rows: list[bytes], form: str, source: str, line: Lines) -> Float64:
    """Return rows of numbers, float64[n, width]; all are as wide as the first (at least 3 numbers)."""
    # A NaN marks the end of every row. Without it, a short row followed by a long one would pass.
    marked = _parsed(b" nan\n".join([*rows, b""]))
    width = len(_clean(rows[0]).split())
    if (
        marked is not None
        and width >= 3
        and len(marked) == len(rows) * (width + 1)
        and np.isnan(marked.reshape(-1, width + 1)[:, width]).all()
        and np.isfinite(values := marked.reshape(-1, width + 1)[:, :width]).all()
    ):
        return np.ascontiguousarray(values)
    _numbers(b"\n".join(rows), source, lambda at: line(at - 1))
    for row, text in enumerate(rows):
        numbers = len(_clean(text).split())
        if numbers < 3 or numbers != width:
            raise InputError(
                f"{source}: line {line(row)}: expected {form!r} with {max(width, 3)} numbers, found {numbers}."
            )
    raise InputError(f"{source}: line {line(0)}: expected {form!r}, found {_shown(rows[0])}.")


# --- VRML ----------------------------------------------------------------------------------------------------

_TOKEN = re.compile(rb"\[[^\[\]{}]*\]|[\[\]{}]|[^\s,\[\]{}]+")
_IDENTITY = {
    b"translation": (0.0, 0.0, 0.0),
    b"center": None,  # without effect, since rotation and scale must be the identity
    b"scale": (1.0, 1.0, 1.0),
    b"scaleFactor": (1.0, 1.0, 1.0),
    b"scaleOrientation": None,
    b"matrix": tuple(np.eye(4).ravel()),
}
_TRANSFORMS = (b"Transform", b"Translation", b"Rotation", b"Scale", b"MatrixTransform")
Match = re.Match[bytes]


@dataclass
class _Node:
    """Hold a VRML node while its braces are open."""

    kind: bytes
    name: bytes | None
    start: int
    points: Match | None = None
    index: Match | None = None
    has_faces: bool = False
    values: dict[bytes, list[float]] = field(default_factory=dict)


class _FaceSetScanner:
    """Read a VRML text token by token and find its IndexedFaceSets."""

    def __init__(self, text: bytes, source: str) -> None:
        self.text, self.source = text, source
        self.open_nodes = [_Node(b"", None, 0)]  # the outermost one is the file
        self.points_of_name: dict[bytes, Match | None] = {}
        self.names_with_faces: set[bytes] = set()
        self.last_points: Match | None = None  # in VRML 1, the last Coordinate3 applies to what follows
        self.before = [b"", b"", b""]  # the last three tokens
        self.field = b""

    def face_sets(self) -> Iterator[tuple[Match, Match]]:
        """Yield the lists of points and of indices of every IndexedFaceSet, in order."""
        for match in _TOKEN.finditer(self.text):
            token = match[0]
            if token == b"{":
                name = self.before[-2] if self.before[-3] == b"DEF" else None
                self.open_nodes.append(_Node(self.before[-1], name, match.start()))
                self.field = b""
            elif token == b"}":
                node = self._closed_node(match)
                if node.points is not None and node.index is not None and node.kind == b"IndexedFaceSet":
                    yield node.points, node.index
            elif token.startswith(b"["):
                self._read_list(match)
            else:
                self._read_word(match)
            self.before = [*self.before[1:], token]
        if len(self.open_nodes) > 1:
            node = self.open_nodes[-1]
            kind, line = node.kind.decode("ascii", "replace"), _line(self.text, node.start)
            raise self._error(len(self.text.rstrip()), f"'}}' for {kind!r} of line {line}", "the end")

    def _error(self, offset: int, expected: str, given: str) -> InputError:
        """Return the error at a byte offset."""
        return InputError(f"{self.source}: line {_line(self.text, offset)}: expected {expected}, found {given}.")

    def _closed_node(self, match: Match) -> _Node:
        """Close the innermost node and return it; note what its parent and later references need of it."""
        if len(self.open_nodes) == 1:
            raise self._error(match.start(), "a node", "'}' that closes none")
        node, parent = self.open_nodes.pop(), self.open_nodes[-1]
        if node.kind in (b"Coordinate", b"Coordinate3"):
            self.last_points = parent.points = node.points
            if node.name is not None:
                self.points_of_name[node.name] = node.points
        elif node.kind in _TRANSFORMS:
            _check_identity(node, self.text, self.source)
        elif node.kind == b"IndexedFaceSet" and node.index is not None:
            node.points = node.points or self.last_points
            if node.points is None:
                raise self._error(node.start, "points for the IndexedFaceSet", "none")
            node.has_faces = True
        if node.has_faces and node.name is not None:
            self.names_with_faces.add(node.name)
        parent.has_faces |= node.has_faces
        self.field = b""
        return node

    def _read_list(self, match: Match) -> None:
        """Note a list of points or indices in its node, and refuse a list that is not closed."""
        token, name, node = match[0], self.before[-1], self.open_nodes[-1]
        if token == b"[":
            if name in (b"point", b"coordIndex"):
                raise self._error(
                    match.start(), f"a list of numbers closed by ']' after {name.decode()}", "no such end"
                )
        elif name == b"point":
            node.points = match
        elif name == b"coordIndex":
            node.index = match
        elif name == b"children" and b"USE" in token.split():
            raise self._error(match.start(), "geometry written out", "geometry used again by USE")

    def _read_word(self, match: Match) -> None:
        """Read a word: a reference to a named node, a number of a transform, or the name of a field."""
        token, node = match[0], self.open_nodes[-1]
        if self.before[-1] == b"USE":
            for_points = self.before[-2] == b"coord"
            if for_points and token in self.points_of_name:
                node.points = self.points_of_name[token]
            elif for_points or token in self.names_with_faces:
                raise self._error(match.start(), "geometry written out", f"USE {token.decode('ascii', 'replace')}")
        elif node.kind in _TRANSFORMS and re.fullmatch(_NUMBER, token):
            node.values.setdefault(self.field, []).append(float(token))
        else:
            self.field = token


def _check_identity(node: _Node, text: bytes, source: str) -> None:
    """Raise InputError if a transform node changes coordinates."""
    for key, values in node.values.items():
        if key == b"rotation":
            same = len(values) == 4 and values[3] == 0
        else:
            identity = _IDENTITY.get(key)
            same = identity is None or tuple(values) == identity
        if not same:
            raise InputError(
                f"{source}: line {_line(text, node.start)}: expected coordinates of the body itself, "
                f"found a {node.kind.decode()} with {key.decode()} {' '.join(f'{v:g}' for v in values)}."
            )


def _list_numbers(text: bytes, block: Match, source: str) -> Float64:
    """Return the numbers in a bracketed list."""
    start = _line(text, block.start())
    return _numbers(block[0][1:-1], source, lambda line: start + line - 1)


def _fans(values: Float64, points: int, text: bytes, block: Match, source: str) -> Int64:
    """Split polygons, each ended by -1 in `values` float64[n], into fans of triangles int64[m, 3]."""

    def error(index: int, expected: str) -> InputError:
        line = _line(text, block.start()) + _token_line(block[0][1:-1], index) - 1
        return InputError(f"{source}: line {line}: expected {expected}, found {values[index]:g}.")

    wrong = (values != np.floor(values)) | (values < -1) | (values >= points)
    if wrong.any():
        raise error(int(np.argmax(wrong)), f"point numbers from 0 to {points - 1} or -1")
    index = values.astype(np.int64)
    if len(index) == 0 or index[-1] != -1:
        index = np.append(index, -1)
    ends = np.flatnonzero(index == -1)
    starts = np.concatenate([[0], ends[:-1] + 1])
    corners = ends - starts
    few = (corners == 1) | (corners == 2)
    if few.any():
        raise error(int(starts[np.argmax(few)]), "polygons of at least three corners")
    triangles = np.maximum(corners - 2, 0)
    first = np.repeat(starts, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles) + 1
    return np.stack([index[first], index[first + step], index[first + step + 1]], axis=1)
