"""Read the shape formats of small-body science: plate tables, v/f lines, Gaskell's ICQ, VRML and NAIF's DSK.

Each reader here takes a file's bytes and the name for messages (`core.files.spice` reads DSKs). It returns the mesh
as stored: vertices float64[n, 3] in the file's unit, and faces int64[m, 3], counted from 0, with all indices in
range. `shape.check_mesh` then checks whether the mesh bounds a solid. A malformed file raises InputError with the
line number.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import spice
from ..core.files.meshes import fans, joined, numbers_of, read_obj

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


def read_shape(path: Path, data: bytes) -> tuple[Float64, Int64, bool]:
    """Return vertices and faces in a file, and whether its format defines that they are in km.

    The content `data` and the suffix (one of `SUFFIXES`) select the reader.

    Raises
    ------
    InputError
        The file has none of these formats or is malformed, or it is a DSK and spiceypy is not installed.
    """
    source = str(path)
    head = data[:65536]
    if head.startswith((b"DAS/DSK", b"NAIF/DAS")):
        return *spice.read_dsk(path), True
    if path.suffix.lower() == ".bds":
        raise InputError(f"{source}: line 1: expected the mark 'DAS/DSK' of a NAIF DSK, found {_shown(head)}.")
    if b"\0" in data:
        raise InputError(f"{source}: line {_line(data, data.index(0))}: expected text, found binary data.")
    if re.match(rb"\s*#VRML", data) or path.suffix.lower() == ".wrl":
        return *read_vrml(data, source), False
    data = _without_comments(data)
    if not data.translate(_FORTRAN).strip():
        raise InputError(f"{source}: line 1: expected vertices and facets, found nothing.")
    if re.search(rb"(?m)^[ \t]*v[ \t]", data):  # lines `v x y z` and `f a b c`, as in the PDS's radar shapes
        if lost := re.search(rb"(?m)^[ \t]*[VF\d.+-].*$", data):
            line, given = _line(data, lost.start()), _shown(lost[0])
            raise InputError(f"{source}: line {line}: expected `v x y z` or `f a b c`, found {given}.")
        return *joined(read_obj(_clean(data), source, may_count_from_0=True)), False
    if path.suffix.lower() == ".icq" or _is_icq(data):
        return *read_icq(data, source), False
    return *read_plate_table(data, source), False


def read_plate_table(data: bytes, source: str) -> Mesh:
    """Read a table of vertices and a table of triangular plates, as in the PDS Small Bodies Node's models.

    The numbers of vertices and plates stand at the start of the file, or each above its table. A vertex is `x y z`,
    a plate is three vertex numbers; each has a line of its own. Each may be preceded by its own number; a plate may
    instead be preceded by the count 3, also on a line above it, as in OSIRIS's .ver files. Vertex numbers are
    counted from 1, or from 0 if a 0 occurs. Columns of any width, commas and D exponents are accepted.

    Raises
    ------
    InputError
        With the line: a token is not a number, a table differs from its count, a vertex number is out of range, or
        the vertices are given as latitude, longitude and radius.
    """
    table = _PlateTable(data, source)
    counts = table.row(0)
    first = counts[0]
    if not (first == np.floor(first) and 4 <= first < 2**31):
        raise table.error(0, "the number of vertices, an integer of at least 4", f"{first:g}")
    if len(counts) > 2:
        raise table.error(0, "the number of vertices and of facets", f"{len(counts)} numbers")
    start = 1
    if len(counts) == 1 and len(table.row(1)) == 1:
        counts, start = np.append(counts, table.row(1)), 2
    vertices, at = table.block(start, int(first), "vertex", "vertices")
    where = start - 1
    if len(counts) == 1:
        counts, where = np.append(counts, table.row(at)), at
        at += 1
    if len(counts) != 2 or counts[1] != np.floor(counts[1]) or not 0 <= counts[1] < 2**31:
        given = _listed(counts[1:]) or "the end"
        raise table.error(where, f"the number of facets after {len(vertices)} vertices", given)
    table.leave_out_corner_counts(at)
    faces, end = table.block(at, int(counts[1]), "facet", "facets")
    if end < len(table.lines):
        expected = f"the end after {len(vertices)} vertices and {len(faces)} facets"
        raise table.error(end, expected, f"{len(table.row(end))} more numbers")
    mesh = _from_one(vertices, faces, source, lambda row: int(table.lines[at + row]))
    x, y, z = mesh[0].T
    # A Cartesian model centred on the body has vertices on both sides of the equator, so z is not always positive.
    if z.min() > 0 and np.abs(x).max() <= 90 and np.ptp(x) > 150 and y.min() >= -180 and np.ptp(y) > 300:
        raise table.error(1, "Cartesian coordinates", "what looks like latitude, longitude and radius")
    return mesh


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
    values = numbers_of(text)
    return numbers_of(_clean(text)) if values is None else values  # few files need the search for glued numbers


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


class _PlateTable:
    """Hold the rows of a text that have numbers, and their lines."""

    def __init__(self, data: bytes, source: str) -> None:
        self.source = source
        # a NaN marks the end of every line
        marked = _parsed(b" nan\n".join([*data.split(b"\n"), b""]))
        ends = np.empty(0, np.int64) if marked is None else np.flatnonzero(~np.isfinite(marked))
        if marked is None or len(ends) != data.count(b"\n") + 1:
            _numbers(data, source)
            raise InputError(f"{source}: its numbers are unreadable.")
        self._values, self._widths = marked, np.diff(ends, prepend=-1) - 1
        self._starts, self.lines = ends - self._widths, np.arange(1, len(ends) + 1)
        self._keep(self._widths > 0)

    def _keep(self, chosen: NDArray[np.bool_]) -> None:
        """Leave out all other rows."""
        self._widths, self._starts, self.lines = (of[chosen] for of in (self._widths, self._starts, self.lines))

    def row(self, number: int) -> Float64:
        """Return the numbers of a row; none behind the last."""
        if number >= len(self.lines):
            return np.empty(0)
        return self._values[self._starts[number] :][: self._widths[number]]

    def leave_out_corner_counts(self, start: int) -> None:
        """Leave out rows from `start` on that only say how many corners the facet in the next row has."""
        if list(self.row(start)) == [3]:
            self._keep((np.arange(len(self.lines)) < start) | (self._widths > 1))

    def block(self, start: int, count: int, kind: str, kinds: str) -> tuple[Float64, int]:
        """Return the last three numbers of `count` rows, float64[count, 3], and the row behind them.

        Rows may have a number in front, which counts them from 0 or 1, or is 3 of each.
        """
        widths = self._widths[start : start + count]
        width = int(widths[0]) if len(widths) else 3
        other = np.flatnonzero(widths != width) if width in (3, 4) else np.zeros(1, np.int64)
        if len(other):
            k = int(other[0])
            allowed = f"{width} numbers" if width in (3, 4) else "3 or 4 numbers"
            raise self.error(start + k, f"{allowed} for {kind} {k + 1} of {count}", str(widths[k]))
        if len(widths) < count:
            raise self.error(start + len(widths), f"{count} {kinds}", f"the end after {len(widths)}")
        table = self._values[self._starts[start : start + count][:, None] + np.arange(width)]
        if width == 4:
            number, first = np.arange(count), table[0, 0] if count else 0
            wrong = table[:, 0] != (3 if first == 3 else number + (1 if first else 0))
            if wrong.any():
                k = int(np.argmax(wrong))
                raise self.error(start + k, f"number {k + 1} in front of a {kind}", f"{table[k, 0]:g}")
        return table[:, -3:], start + count

    def error(self, row: int, expected: str, given: str) -> InputError:
        """Return the error for a row, or for the end."""
        line = self.lines[min(row, len(self.lines) - 1)]
        return InputError(f"{self.source}: line {line}: expected {expected}, found {given}.")


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


# --- VRML ----------------------------------------------------------------------------------------------------

_NUMBERS = rb"\[([^\[\]{}]*)\]"
_OPEN_LIST = re.compile(rb"\b(point|coordIndex)\s*\[[^\[\]{}]*+(?!\])")
_STATEMENT = re.compile(
    rb"\bIndexed(?P<kind>Face|Line)Set\b"
    rb"|(?:\bDEF\s+(?P<name>[^\s{}]+)\s+)?\bCoordinate3?\s*\{\s*point\s*"
    + _NUMBERS.replace(b"(", b"(?P<points>")
    + rb"|\bcoordIndex\s*"
    + _NUMBERS.replace(b"(", b"(?P<index>")
    + rb"|(?P<before>\S*)\s+USE\s+(?P<used>[^\s{}\[\],]+)"
    rb"|\b(?P<field>translation|rotation|scale|scaleFactor|matrix)\s+(?P<values>"
    + _NUMBER
    + rb"(?:[\s,]+"
    + _NUMBER
    + rb"){2,15})(?![^\s,{}\[\]])"
)
_MAY_BE_USED = (b"appearance", b"material", b"texture", b"textureTransform", b"normal", b"color", b"texCoord")
_IDENTITY = {
    b"translation": (0, 0, 0),
    b"scale": (1, 1, 1),
    b"scaleFactor": (1, 1, 1),
    b"matrix": (*np.eye(4).ravel(),),
}
Match = re.Match[bytes]


def read_vrml(data: bytes, source: str) -> Mesh:
    """Read all IndexedFaceSets of a VRML 1 or 2 file; polygons are split into fans.

    Named coordinates (DEF) may be used again (USE).

    Raises
    ------
    InputError
        With the line: a transform is not the identity or geometry is used again, which would change the shape
        silently; or a list is not closed, holds anything but numbers, or names points that do not exist.
    """
    head = re.match(rb"\s*#VRML V?(\d?)", data)
    if head is None:
        raise InputError(
            f"{source}: line 1: expected '#VRML V1.0 ascii' or '#VRML V2.0 utf8', found {_shown(data)}."
        )
    # Strings and comments are overwritten with blanks, not removed, so that line numbers stay correct.
    text = re.sub(rb'"(?:\\.|[^"\\])*(?:"|\Z)|#[^\r\n]*', lambda m: re.sub(rb"[^\r\n]", b" ", m[0]), data)
    vertices: list[Float64] = [np.empty((0, 3))]
    faces: list[Int64] = []
    for points, index in _face_sets(text, source, keeps_points=head[1] == b"1"):
        coordinates = _list_numbers(text, points, "points", source)
        if len(coordinates) % 3 or len(coordinates) == 0:
            raise _vrml_error(
                text, points.start(), source, "points of three coordinates", f"{len(coordinates)} numbers"
            )
        triangles = _polygons(
            _list_numbers(text, index, "index", source), len(coordinates) // 3, text, index, source
        )
        faces.append(triangles + sum(map(len, vertices)))
        vertices.append(coordinates.reshape(-1, 3))
    if not faces:
        raise _vrml_error(text, len(data.rstrip()), source, "an IndexedFaceSet", "none before the end")
    return np.concatenate(vertices), np.concatenate(faces)


def _vrml_error(text: bytes, offset: int, source: str, expected: str, given: str) -> InputError:
    """Return the error that names the line of a byte offset in a VRML file, and what was expected there."""
    return InputError(f"{source}: line {_line(text, offset)}: expected {expected}, found {given}.")


def _face_sets(text: bytes, source: str, *, keeps_points: bool) -> Iterator[tuple[Match, Match]]:
    """Yield the statements with the points and with the indices of every IndexedFaceSet, in order.

    With `keeps_points`, as in VRML 1, points hold for all that follows.
    """
    if unclosed := _OPEN_LIST.search(text):
        expected = f"a list of numbers closed by ']' after {unclosed[1].decode()}"
        raise _vrml_error(text, unclosed.start(), source, expected, "no such end")
    if text.count(b"{") != text.count(b"}"):
        counts = f"{text.count(b'{')} and {text.count(b'}')}"
        raise _vrml_error(text, len(text.rstrip()), source, "as many '}' as '{' by the end", counts)
    kind, points, named = b"", None, {}
    for match in _STATEMENT.finditer(text):
        if match["kind"]:
            kind, points = match["kind"], points if keeps_points else None
        elif match["points"] is not None:
            points = named[match["name"]] = match
        elif match["used"]:
            if match["before"] == b"coord" and match["used"] in named:
                points = named[match["used"]]
            elif match["before"] not in _MAY_BE_USED:
                raise _vrml_error(
                    text,
                    match.end(),
                    source,
                    "geometry written out",
                    f"USE {match['used'].decode('ascii', 'replace')}",
                )
        elif match["field"]:
            _check_identity(match, text, source)
        elif kind == b"Face":
            if points is None:
                raise _vrml_error(
                    text, match.start(), source, "points before the coordIndex of an IndexedFaceSet", "none"
                )
            yield points, match
            points = points if keeps_points else None


def _check_identity(match: Match, text: bytes, source: str) -> None:
    """Raise InputError if a field of a transform changes coordinates."""
    name, values = match["field"], tuple(map(float, match["values"].replace(b",", b" ").split()))
    same = values[3:] == (0.0,) if name == b"rotation" else values == _IDENTITY[name]
    if not same:
        given = f"a transform with {name.decode()} {' '.join(f'{v:g}' for v in values)}"
        raise _vrml_error(text, match.start(), source, "coordinates of the body itself", given)


def _list_numbers(text: bytes, block: Match, group: str, source: str) -> Float64:
    """Return the numbers in a bracketed list."""
    start = _line(text, block.start(group))
    return _numbers(block[group], source, lambda line: start + line - 1)


def _polygons(values: Float64, points: int, text: bytes, block: Match, source: str) -> Int64:
    """Split polygons, each ended by -1 in `values` float64[n], into fans of triangles int64[m, 3]."""

    def error(index: int, expected: str) -> InputError:
        line = _line(text, block.start("index")) + _token_line(block["index"], index) - 1
        return InputError(f"{source}: line {line}: expected {expected}, found {values[index]:g}.")

    wrong = (values != np.floor(values)) | (values < -1) | (values >= points)
    if wrong.any():
        raise error(int(np.argmax(wrong)), f"point numbers from 0 to {points - 1} or -1")
    index = values.astype(np.int64)
    if len(index) == 0 or index[-1] != -1:
        index = np.append(index, -1)
    ends = np.flatnonzero(index == -1)
    corners = np.diff(ends, prepend=-1) - 1
    few = (corners == 1) | (corners == 2)
    if few.any():
        k = int(np.argmax(few))
        raise error(int(ends[k] - corners[k]), "polygons of at least three corners")
    return fans(np.delete(index, ends), corners[corners > 0])
