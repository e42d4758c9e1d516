"""Shape formats: what is written is what is read, and malformed files are named with their line."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import calls_of
from hypothesis import given, settings
from hypothesis import strategies as st

from vbnfault.body import formats, load_shape
from vbnfault.body.geometry import signed_volume
from vbnfault.core.errors import InputError
from vbnfault.core.files import spice

Arrays = tuple[np.ndarray, np.ndarray]


def lumpy(subdivisions: int = 3) -> Arrays:
    """A closed body of 4 × 3 × 2 km with lumps, coordinates of six decimals."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    v = np.array(ball.vertices)
    v = v * (1 + 0.1 * np.sin(5 * v[:, :1]) * np.cos(4 * v[:, 1:2])) * [2.0, 1.5, 1.0]
    return np.round(v, 6), np.array(ball.faces)


def rows(array: np.ndarray, form: str, *, number_from: int | None = None, lead: str = "") -> str:
    lines = (" ".join(form % value for value in row) for row in array)
    if number_from is not None:
        lines = (f"{k:8d} {line}" for k, line in enumerate(lines, number_from))
    return "".join(f"{lead}{line}\n" for line in lines)


# --- writers: one per variant in use -------------------------------------------------------------------------


def both_counts(v: np.ndarray, f: np.ndarray) -> str:
    return f"{len(v):14d}{len(f):14d}\n" + rows(v, "%16.9f") + rows(f + 1, "%10d")


def counts_apart_numbered(v: np.ndarray, f: np.ndarray) -> str:
    return f"{len(v)}\n" + rows(v, "%.9f", number_from=1) + f"{len(f)}\n" + rows(f + 1, "%d", number_from=1)


def counts_apart(v: np.ndarray, f: np.ndarray) -> str:
    return f"  {len(v)}\n" + rows(v, "%.9f") + f"  {len(f)}\n" + rows(f + 1, "%d")


def from_zero(v: np.ndarray, f: np.ndarray) -> str:
    return f"{len(v)} {len(f)}\n" + rows(v, "%.9f", number_from=0) + rows(f, "%d", number_from=0)


def osiris_ver(v: np.ndarray, f: np.ndarray) -> str:
    return f"{len(v)} {len(f)}\n" + rows(v, "%.9f") + "".join(f"3\n {a} {b} {c}\n" for a, b, c in f + 1)


def fortran(v: np.ndarray, f: np.ndarray) -> str:
    body = rows(v, "%.9E").replace("E", "D")
    return f"{len(v)} {len(f)}\r\n" + (body + rows(f + 1, "%d")).replace("\n", "\r\n") + "\x1a"


def glued(v: np.ndarray, f: np.ndarray) -> str:
    """Fixed columns that leave no blank in front of a minus sign."""
    body = "".join("".join(f"{x:10.6f}"[1 if x < 0 else 0 :] for x in row) + "\n" for row in v)
    assert re.search(r"\d-\d", body)
    return f"{len(v)} {len(f)}\n" + re.sub(r"(?m)^", " ", body) + rows(f + 1, "%d")


def commas(v: np.ndarray, f: np.ndarray) -> str:
    return f"# a comment\n{len(v)}, {len(f)}\n" + (rows(v, "%.9f,") + rows(f + 1, "%d,")).replace(",\n", "\n")


def letters(v: np.ndarray, f: np.ndarray) -> str:
    return rows(v, "%14.6E", lead="v ") + rows(f + 1, "%10d", lead="f ")


def letters_from_zero(v: np.ndarray, f: np.ndarray) -> str:
    return "# Eros\n" + rows(v, "%.9f", lead=" v ") + rows(f, "%d", lead=" f ")


def letters_of_obj(v: np.ndarray, f: np.ndarray) -> str:
    faces = "".join(f"f {a}//{a} {b}//{b} {c}//{c}\n" for a, b, c in f + 1)
    return "o body\n" + rows(v, "%.9f", lead="v ") + rows(v, "%.3f", lead="vn ") + "s off\n" + faces


def vrml2(v: np.ndarray, f: np.ndarray) -> str:
    points = rows(v, "%.9f").replace("\n", ",\n")
    index = "".join(f"{a}, {b}, {c}, -1,\n" for a, b, c in f)
    return (
        '#VRML V2.0 utf8\n# counts 12 20 [ {\nWorldInfo { title "a } body" }\n'
        "Transform { translation 0 0 0 rotation 0 0 1 0 scale 1 1 1 children [\n"
        "Viewpoint { position 0 0 9 orientation 0 1 0 1.5 }\n"
        "Shape { appearance Appearance { material Material { diffuseColor 0.5 0.5 0.5 }"
        " textureTransform TextureTransform { scale 10 10 translation 0.5 0.5 } }\n"
        " geometry IndexedFaceSet { solid TRUE\n coord DEF P Coordinate { point [\n" + points + "] }\n"
        " coordIndex [\n" + index + "] } } ] }\n"
    )


def vrml1(v: np.ndarray, f: np.ndarray) -> str:
    index = "".join(f"{a} {b} {c} -1 " for a, b, c in f).rstrip("1- ")
    return (
        "#VRML V1.0 ascii\nSeparator { ShapeHints { vertexOrdering COUNTERCLOCKWISE }\n"
        "Coordinate3 { point [" + rows(v, "%.9f").replace("\n", ",\n") + "] }\n"
        "IndexedFaceSet { coordIndex [" + index + "] } }\n"
    )


def vrml_sbn(v: np.ndarray, f: np.ndarray) -> str:
    """As the Small Bodies Node wraps its tables: the counts in a comment, fixed records."""
    text = (
        "#VRML V2.0 utf8\nShape {\n geometry IndexedFaceSet {\n  coord Coordinate {\n   point [\n"
        f"# {len(v):9d} {len(f):9d}\n"
        + rows(v, "%16.12f")
        + "   ]\n  }\n  coordIndex [\n"
        + "".join(f"{a:9d}{b:9d}{c:9d} -1\n" for a, b, c in f)
        + "  ]\n }\n}\n"
    )
    return "".join(f"{line:78s}\r\n" for line in text.splitlines())


VARIANTS: list[tuple[Callable[[np.ndarray, np.ndarray], str], str]] = [
    (both_counts, "tab"),
    (both_counts, "PLT"),
    (counts_apart_numbered, "plt"),
    (counts_apart, "txt"),
    (from_zero, "tab"),
    (osiris_ver, "ver"),
    (fortran, "tab"),
    (glued, "tab"),
    (commas, "txt"),
    (letters, "tab"),
    (letters_from_zero, "tab"),
    (letters_of_obj, "txt"),
    (vrml2, "wrl"),
    (vrml1, "wrl"),
    (vrml_sbn, "wrl"),
]


def write(tmp_path: Path, text: str | bytes, name: str) -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode("latin-1") if isinstance(text, str) else text)
    return path


def silently(path: Path, unit: str = "auto") -> Arrays:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load_shape(path, unit)  # type: ignore[arg-type]


def write_dsk(path: Path, v: np.ndarray, f: np.ndarray, surfaces: tuple[int, ...] = (1,)) -> Path:
    spiceypy = pytest.importorskip("spiceypy", reason="spiceypy (the extra 'spice') is not installed")
    v, f = np.ascontiguousarray(v, dtype=float), np.ascontiguousarray(f + 1, dtype=np.int32)
    nothing = np.zeros(10)
    handle = spiceypy.dskopn(str(path), "test", 0)
    for surface in surfaces:
        low, high = spiceypy.dskrb2(v, f, 1, nothing)
        index_d, index_i = spiceypy.dskmi2(v, f, 2.0, 5, 1_000_000, 100_000, 1_000_000, True, 4_000_000)
        pi = np.pi
        spiceypy.dskw02(
            handle, 1000012, surface, 1, "J2000", 1, nothing, -pi, pi, -pi / 2, pi / 2, low, high, -1e9, 1e9,
            v, f, index_d, index_i,
        )  # fmt: skip
    spiceypy.dskcls(handle, False)
    return path


# --- round trips ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("writer", "suffix"), VARIANTS, ids=[f"{w.__name__}.{s}" for w, s in VARIANTS])
def test_every_variant_reads_back(tmp_path: Path, writer: Callable[..., str], suffix: str) -> None:
    v, f = lumpy()
    vertices, faces = silently(write(tmp_path, writer(v, f), f"body.{suffix}"))
    assert (vertices.dtype, faces.dtype) == (np.float64, np.int32)
    np.testing.assert_array_equal(faces, f)
    # At least six decimals are written of coordinates of six: kilometres to the last bit but the product's.
    np.testing.assert_allclose(vertices, 1000 * v, rtol=1e-6 if writer is letters else 1e-14, atol=1e-9)
    assert signed_volume(vertices, faces) == pytest.approx(1e9 * signed_volume(v, f), rel=1e-5)


def test_dsk_reads_back_in_kilometres_by_definition(tmp_path: Path) -> None:
    v, f = lumpy()
    vertices, faces = silently(write_dsk(tmp_path / "body.bds", v, f))
    np.testing.assert_array_equal(vertices, 1000 * v)
    np.testing.assert_array_equal(faces, f)
    # 400 km long: only the format can know that these are kilometres. The user's word still wins.
    large = write_dsk(tmp_path / "large.bds", 100 * v, f)
    np.testing.assert_array_equal(silently(large)[0], 1000 * (100 * v))
    np.testing.assert_array_equal(silently(large, "m")[0], 100 * v)


def test_dsk_of_two_surfaces_and_without_any(tmp_path: Path) -> None:
    v, f = lumpy(1)
    with pytest.raises(InputError, match="body 1000012 surface 1, body 1000012 surface 2"):
        load_shape(write_dsk(tmp_path / "two.bds", v, f, (1, 2)))
    with pytest.raises(InputError, match=r"not found|none|SPICE"):
        load_shape(write(tmp_path, b"DAS/DSK " + bytes(2000), "broken.bds"))


def test_dsk_without_spiceypy_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "spiceypy", None)
    with pytest.raises(InputError, match=r"pip install 'vbnfault\[spice\]'"):
        load_shape(write(tmp_path, b"DAS/DSK " + bytes(2000), "body.bds"))
    with pytest.raises(InputError, match=r"pip install 'vbnfault\[spice\]'"):
        spice.J_from_T("IAU_EROS", 0.0)


def test_content_decides_among_the_table_suffixes(tmp_path: Path) -> None:
    v, f = lumpy(2)
    for writer in (both_counts, letters, vrml2):
        np.testing.assert_array_equal(silently(write(tmp_path, writer(v, f), "body.tab"))[1], f)
    dsk = write_dsk(tmp_path / "body.bds", v, f)
    np.testing.assert_array_equal(silently(dsk.rename(tmp_path / "body.txt"))[1], f)


def test_vertices_repeated_along_seams_are_joined(tmp_path: Path) -> None:
    # Plate tables made from an ICQ hold the edges of its six faces twice.
    box = trimesh.creation.box((4.0, 3.0, 2.0))
    soup = np.array(box.vertices)[box.faces].reshape(-1, 3)
    vertices, faces = silently(write(tmp_path, both_counts(soup, np.arange(36).reshape(-1, 3)), "seam.tab"))
    assert len(vertices) == 8
    assert signed_volume(vertices, faces) == pytest.approx(24e9)


def test_polygons_and_several_sets_of_vrml(tmp_path: Path) -> None:
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = "0 1 3 2 -1 4 6 7 5 -1 0 4 5 1 -1 2 3 7 6 -1 0 2 6 4 -1 1 5 7 3"
    sets = "".join(
        f"Shape {{ geometry IndexedFaceSet {{ coord Coordinate {{ point [ {rows(corner + shift, '%g')} ] }} "
        f"coordIndex [ {quads} ] }} }}\n"
        for shift in (0.0, 3.0)
    )
    vertices, faces = silently(write(tmp_path, "#VRML V2.0 utf8\n" + sets, "two.wrl"))
    assert (len(vertices), len(faces)) == (16, 24)
    assert signed_volume(vertices, faces) == pytest.approx(2e9)
    named = (
        f"Shape {{ geometry IndexedFaceSet {{ coord DEF P Coordinate {{ point [ {rows(corner, '%g')} ] }} "
        "coordIndex [ 0 1 3 2 -1 4 6 7 5 -1 0 4 5 1 -1 ] } }\n"
        "Shape { geometry IndexedFaceSet { coord USE P coordIndex [ 2 3 7 6 -1 0 2 6 4 -1 1 5 7 3 -1 ] } }"
    )
    vertices, faces = silently(write(tmp_path, "#VRML V2.0 utf8\n" + named, "named.wrl"))
    assert (len(vertices), len(faces)) == (8, 12)
    assert signed_volume(vertices, faces) == pytest.approx(1e9)


# --- ICQ -----------------------------------------------------------------------------------------------------


def icq_rows(q: int, semi_axes: tuple[float, float, float], *, mirrored: bool = False) -> np.ndarray:
    """Vertices on an ellipsoid in the order of the format, float64[6(Q+1)², 3], from its own table of edges.

    The faces of the unfolded cube (1 on top, 2 to 5 around, 6 below) are written down as corner, step in I and step
    in J, so that the edges the format lists as common come out common.
    """
    top, bottom = 1, -1
    faces = [  # corner (I = J = 0), direction of I, direction of J, on the cube [-1, 1]³
        ((-1, -1, top), (1, 0, 0), (0, 1, 0)),
        ((-1, 1, top), (1, 0, 0), (0, 0, -1)),
        ((-1, -1, top), (0, 1, 0), (0, 0, -1)),
        ((1, -1, top), (-1, 0, 0), (0, 0, -1)),
        ((1, 1, top), (0, -1, 0), (0, 0, -1)),
        ((-1, 1, bottom), (1, 0, 0), (0, -1, 0)),
    ]
    points = [
        np.array(corner) + 2 * i / q * np.array(along) + 2 * j / q * np.array(down)
        for corner, along, down in faces
        for j in range(q + 1)
        for i in range(q + 1)
    ]
    unit = np.array(points) / np.linalg.norm(points, axis=1)[:, None]
    return unit * semi_axes * ([1, 1, 1] if mirrored else [1, -1, 1])


def icq_text(q: int, table: np.ndarray) -> str:
    return f"{q:12d}\n" + rows(table, "%12.5f")


#: The common vertices as the format's document lists them, for I = 0..Q: (i, j, face) on both sides.
COMMON: list[tuple[Callable[[int, int], tuple[int, int, int]], Callable[[int, int], tuple[int, int, int]]]] = [
    (lambda i, q: (i, q, 6), lambda i, q: (q - i, q, 4)),
    (lambda i, q: (i, 0, 6), lambda i, q: (i, q, 2)),
    (lambda i, q: (i, 0, 5), lambda i, q: (q, q - i, 1)),
    (lambda i, q: (i, 0, 4), lambda i, q: (q - i, 0, 1)),
    (lambda i, q: (i, 0, 3), lambda i, q: (0, i, 1)),
    (lambda i, q: (i, 0, 2), lambda i, q: (i, q, 1)),
    (lambda i, q: (q, i, 6), lambda i, q: (i, q, 5)),
    (lambda i, q: (q, i, 5), lambda i, q: (0, i, 4)),
    (lambda i, q: (q, i, 4), lambda i, q: (0, i, 3)),
    (lambda i, q: (q, i, 3), lambda i, q: (0, i, 2)),
    (lambda i, q: (0, i, 6), lambda i, q: (q - i, q, 3)),
    (lambda i, q: (0, i, 5), lambda i, q: (q, i, 2)),
]


def test_icq_tests_have_the_edges_of_the_format() -> None:
    q = 4
    table = icq_rows(q, (3.0, 2.0, 1.0)).reshape(6, q + 1, q + 1, 3)
    for ours, theirs in COMMON:
        for k in range(q + 1):
            (i, j, face), (i2, j2, face2) = ours(k, q), theirs(k, q)
            np.testing.assert_allclose(table[face - 1, j, i], table[face2 - 1, j2, i2], atol=1e-12)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("suffix", ["tab", "txt", "icq"])
def test_icq_is_a_closed_ellipsoid(tmp_path: Path, suffix: str, mirrored: bool) -> None:
    q, axes = 32, (2.5, 1.8, 1.2)
    vertices, faces = silently(write(tmp_path, icq_text(q, icq_rows(q, axes, mirrored=mirrored)), f"b.{suffix}"))
    assert (len(vertices), len(faces)) == (6 * q**2 + 2, 12 * q**2)
    np.testing.assert_allclose(np.linalg.norm(vertices / np.multiply(axes, 1000), axis=1), 1.0, atol=1e-5)
    # A chord of angle a misses a fraction of about a²/4 of the volume; the longest step is (π/2) / 32 · √2 / 1.
    exact = 4 / 3 * np.pi * np.prod(axes) * 1e9
    assert exact * (1 - ((np.pi / 2) / q) ** 2) < signed_volume(vertices, faces) < exact


def test_icq_splits_along_the_shorter_diagonal() -> None:
    q = 6
    vertices, faces = formats.read_icq(icq_text(q, icq_rows(q, (3.0, 2.0, 1.0))).encode(), "body")
    first, second = faces[: 6 * q * q], faces[6 * q * q :]
    for one, two in zip(first.tolist(), second.tolist(), strict=True):
        diagonal = set(one) & set(two)
        other = (set(one) | set(two)) - diagonal
        assert len(diagonal) == len(other) == 2
        lengths = [np.linalg.norm(np.subtract(*vertices[list(pair)])) for pair in (diagonal, other)]
        assert lengths[0] <= lengths[1] + 1e-12


def test_icq_leaves_out_the_albedo_and_joins_rounded_edges(tmp_path: Path) -> None:
    q = 8
    table = np.column_stack([icq_rows(q, (2.0, 1.5, 1.0)), np.full(6 * (q + 1) ** 2, 0.97)])
    plain = silently(write(tmp_path, icq_text(q, table[:, :3]), "plain.tab"))
    albedo = silently(write(tmp_path, icq_text(q, table), "albedo.tab"))
    np.testing.assert_array_equal(albedo[0], plain[0])
    table[:, :3] += np.random.default_rng(3).uniform(-2e-5, 2e-5, (len(table), 3))
    assert len(silently(write(tmp_path, icq_text(q, table), "rounded.tab"))[0]) == 6 * q**2 + 2


def test_icq_errors_name_the_line(tmp_path: Path) -> None:
    q = 4
    text = icq_text(q, icq_rows(q, (2.0, 1.5, 1.0)))
    lines = text.splitlines(keepends=True)
    with pytest.raises(InputError, match="line 150: expected 150 vertices of three numbers for Q = 4, found 447"):
        load_shape(write(tmp_path, "".join(lines[:-1]), "short.tab"))
    with pytest.raises(InputError, match="line 40: expected a number, found 'x'"):
        load_shape(write(tmp_path, "".join([*lines[:39], "1 x 2\n", *lines[40:]]), "letter.tab"))
    moved = [*lines[:26], "9 9 9\n", *lines[27:]]  # the first vertex of face 2
    with pytest.raises(InputError, match="line 27: expected the vertex that the neighbouring face has there"):
        load_shape(write(tmp_path, "".join(moved), "apart.tab"))
    with pytest.raises(InputError, match="line 1: expected Q"):
        load_shape(write(tmp_path, "1.5\n1 2 3\n", "q.icq"))


# --- malformed files -----------------------------------------------------------------------------------------

V, F = lumpy(0)  # 12 vertices, 20 facets
TABLE = both_counts(V, F).splitlines(keepends=True)
NUMBERED = counts_apart_numbered(V, F).splitlines(keepends=True)
VRML = vrml2(V, F)


def changed(lines: list[str], line: int, text: str) -> str:
    return "".join([*lines[: line - 1], text + "\n", *lines[line:]])


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        ("", "empty.tab", "empty"),
        (TABLE[0], "body.dat", r"unsupported shape type '\.dat'; allowed are .*\.obj.*\.tab.*\.wrl, \.bds"),
        (TABLE[0], "table.bds", "expected the mark 'DAS/DSK'"),
        (" \n\n", "blank.tab", "line 1: .*found nothing"),
        ("# only\n# comments\n", "comment.tab", "line 1: .*found nothing"),
        ("12 20\n1 2\0 3\n", "binary.tab", "line 2: expected text, found binary"),
        (changed(TABLE, 4, "1.0 abc 2.0"), "letters.tab", "line 4: expected a number, found 'abc'"),
        (changed(TABLE, 4, "1.0 nan 2.0"), "nan.tab", "line 4: expected a number, found 'nan'"),
        (changed(TABLE, 4, "1.0 1e999 2.0"), "huge.tab", "line 4: expected a number, found one that is too large"),
        (changed(TABLE, 1, "12.5 20"), "count.tab", "line 1: expected the number of vertices.*found 12.5"),
        (changed(TABLE, 1, "12 20 30"), "three.tab", "line 1: expected the number of vertices and of facets"),
        (changed(TABLE, 1, "12 21"), "more.tab", "line 33: expected 21 facets, found the end after 20"),
        (changed(TABLE, 1, "11 20"), "lies.tab", "line 33: expected the end after 11 vertices"),
        (changed(TABLE, 5, "1.0 2.0"), "short.tab", "line 5: expected 3 numbers for vertex 4 of 12, found 2"),
        (changed(TABLE, 20, "1 2"), "facet.tab", "line 20: expected 3 numbers for facet 7 of 20, found 2"),
        (changed(TABLE, 20, "1 2 13"), "range.tab", "line 20: expected vertex numbers from 1 to 12, found 1 2 13"),
        (changed(TABLE, 20, "1 0 12"), "range0.tab", "line .*: expected vertex numbers from 0 to 11, found"),
        ("".join(TABLE[:20]), "cut.tab", "line 20: expected 20 facets, found the end after 7"),
        (changed(NUMBERED, 6, "9 1.0 2.0 3.0"), "order.tab", "line 6: expected number 5 in front of a vertex"),
        (changed(NUMBERED, 14, "1 2 3 4"), "nocount.tab", "line 14: expected the number of facets after 12"),
        ("".join(NUMBERED[:13]), "nofacets.tab", "line 13: expected the number of facets .*found the end"),
        (letters(V, F).replace("v ", "q ", 1), "q.tab", "line .*: expected vertex numbers from 1 to 11, found 12"),
        (letters(V, F).replace("v ", "v x", 1), "vx.tab", "line 1: expected 'v x y z', finite numbers"),
        (rows(V, "%g", lead="v "), "points.tab", "mesh has 0 faces"),
        (letters(V, F) + "f 1 2\n", "two.tab", "line 33: expected 'f a b c', three vertex numbers"),
        ("hello\n", "words.txt", "line 1: expected a number, found 'hello'"),
        ("solid\n", "solid.wrl", "line 1: expected '#VRML"),
        ("#VRML V2.0 utf8\nShape { }\n", "none.wrl", "line 2: expected an IndexedFaceSet"),
        (VRML[: VRML.index("coordIndex") - 30], "list.wrl", "line 6: .*'point'|line .*closed by '\\]' after point"),
        (VRML.rstrip("\n }]"), "open.wrl", "closed by '\\]' after coordIndex"),
        (VRML.rstrip("\n }"), "brace.wrl", "expected as many '}' as '{' by the end"),
        (
            VRML.replace("Shape {", "Shape { geometry PointSet { coord Coordinate { point [ 9 9 9 ] } } } Shape {")
            .replace("coord DEF P Coordinate {", "coordIndex [ 0 0 0 -1 ] coord DEF P Coordinate {", 1),
            "order.wrl",
            "points before the coordIndex",
        ),
        (VRML.replace("scale 1 1 1", "scale 1 2 1"), "scale.wrl", "line 4: .*found a transform with scale 1 2 1"),
        (VRML.replace("0 0 1 0 scale", "0 0 1 0.5 scale"), "turn.wrl", "line 4: .*transform with rotation"),
        (VRML.replace("0, 11,", "0, 12,", 1), "index.wrl", "line 23: expected point numbers from 0 to 11 or -1"),
        (VRML.replace("0, 11,", "0, x,", 1), "word.wrl", "line 23: expected a number, found 'x'"),
        (VRML.replace("0, 11, 5, -1", "0, 11, -1", 1), "edge.wrl", "line 23: expected polygons of at least three"),
        (letters(V, F).replace("f ", "F ", 1), "face.tab", "line 13: expected `v x y z` or `f a b c`, found 'F"),
        (VRML + "Shape { geometry USE Q }", "use.wrl", "expected geometry written out, found USE Q"),
    ],
)  # fmt: skip
def test_malformed_files_name_file_line_and_what_was_expected(
    tmp_path: Path, text: str, name: str, says: str
) -> None:
    path = write(tmp_path, text, name)
    with pytest.raises(InputError, match=says) as caught:
        load_shape(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")


def test_latitude_longitude_radius_is_not_taken_for_coordinates(tmp_path: Path) -> None:
    v, f = lumpy(2)
    radius = np.linalg.norm(v, axis=1)
    sphere = np.column_stack(
        [np.degrees(np.arcsin(v[:, 2] / radius)), np.degrees(np.arctan2(v[:, 1], v[:, 0])) % 360, radius]
    )
    with pytest.raises(InputError, match=r"line 2: expected Cartesian coordinates, found .* latitude"):
        load_shape(write(tmp_path, both_counts(sphere, f), "plan.tab"))


SOURCES = [both_counts, counts_apart_numbered, osiris_ver, letters, vrml2, vrml1]


@settings(max_examples=150)
@given(data=st.data())
def test_damaged_files_raise_input_errors_only(tmp_path: Path, data: st.DataObject) -> None:
    """Cut, spliced and overwritten files either still make a mesh or are refused in a sentence."""
    text = data.draw(st.sampled_from([*(w(V, F) for w in SOURCES), icq_text(2, icq_rows(2, (2.0, 1.5, 1.0)))]))
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(len(text), start + 60)))
    piece = data.draw(
        st.one_of(
            st.text(alphabet="0123456789.-+eED \n\tvf#{}[],x\0", max_size=20),
            st.sampled_from(["-1", "1e400", "nan", "99999999999999999999", "0x10", "--5", "[", "}", "12 20\n"]),
        )
    )
    path = write(
        tmp_path, text[:start] + piece + text[end:], data.draw(st.sampled_from(["a.tab", "a.icq", "a.wrl"]))
    )
    refused = ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what was mended
            vertices, faces = load_shape(path)
    except InputError as error:
        refused = str(error)
    if refused:
        assert refused.startswith(f"{path}: ")
        assert "\n" not in refused
    else:
        assert np.isfinite(vertices).all()
        assert faces.max() < len(vertices)


@settings(max_examples=100)
@given(content=st.binary(min_size=1, max_size=300), suffix=st.sampled_from(formats.SUFFIXES))
def test_rubbish_raises_input_errors_only(tmp_path: Path, content: bytes, suffix: str) -> None:
    with pytest.raises(InputError):
        load_shape(write(tmp_path, content, f"rubbish{suffix}"))


# --- speed --------------------------------------------------------------------------------


@pytest.mark.parametrize("source", [source for source in SOURCES if source is not letters])
def test_tables_are_read_without_a_loop_over_their_rows(
    tmp_path: Path, source: Callable[[np.ndarray, np.ndarray], str]
) -> None:
    calls = []
    for subdivisions in (1, 1, 3):  # 80 and 1280 facets; what is made once is made by the first
        path = write(tmp_path, source(*lumpy(subdivisions)), f"a.{'wrl' if source in (vrml1, vrml2) else 'tab'}")
        data = path.read_bytes()
        calls.append(calls_of(lambda path=path, data=data: formats.read_shape(path, data)))
    assert calls[2] == calls[1]
