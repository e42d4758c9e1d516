"""Shapes, the embedded nucleus, sites and their frames."""

from __future__ import annotations

import contextlib
import itertools
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import recorded_calls

import vbnfault
from vbnfault.body import (
    Body,
    check_mesh,
    choose_sites,
    ellipsoid,
    embedded_nucleus,
    load_body,
    load_shape,
    local_level,
)
from vbnfault.body.geometry import face_normals_areas, mean_edge_m, signed_volume, vertex_normals
from vbnfault.body.noise import gradient_noise
from vbnfault.body.roughness import deviogram, sharpened
from vbnfault.core.errors import InputError
from vbnfault.dataset.identity import scene_identity

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import embedded_nucleus as embedded_nucleus_maker

CUBE = """v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 2 3 7\nf 2 7 6
f 3 4 8\nf 3 8 7\nf 4 1 5\nf 4 5 8\n"""


def write(tmp_path: Path, text: str, name: str = "shape.obj") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


# --- reading ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
def test_every_format_gives_the_same_solid(tmp_path: Path, suffix: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    path = tmp_path / f"ball.{suffix}"
    mesh.export(path)
    vertices, faces = load_shape(path)
    assert (vertices.dtype, faces.dtype) == (np.float64, np.int32)
    assert (len(vertices), len(faces)) == (162, 320)
    # Extent 4 < 150, so kilometres; STL and GLB keep float32, OBJ eight decimals: 1e-7 each way, times 3.
    assert signed_volume(vertices, faces) == pytest.approx(1e9 * mesh.volume, rel=1e-6)


@pytest.mark.parametrize(
    ("size", "unit", "side_m"),
    [(1, "auto", 1000), (149, "auto", 149_000), (151, "auto", 151), (1, "m", 1), (151, "km", 151_000)],
)
def test_units(tmp_path: Path, size: float, unit: str, side_m: float) -> None:
    mesh = trimesh.creation.box((size, size, size))
    mesh.export(tmp_path / "box.ply")
    vertices, _ = load_shape(tmp_path / "box.ply", unit)  # type: ignore[arg-type]
    np.testing.assert_allclose(np.ptp(vertices, axis=0), side_m, rtol=1e-6)  # PLY may hold float32


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"unit": "KM"}, "unit must be one of auto, m, km; got 'KM'"),
        ({"volume_m3": -1.0}, "volume_m3 must be positive"),
        ({"density_kg_m3": -1.0}, "density_kg_m3 must be positive"),
        ({"rotation_period_s": 0.0}, "rotation_period_s must be positive"),
    ],
)
def test_a_body_of_impossible_values_is_refused(tmp_path: Path, values: dict[str, Any], says: str) -> None:
    trimesh.creation.box((2, 2, 2)).export(tmp_path / "box.ply")
    with pytest.raises(InputError, match=says):
        load_body(tmp_path / "box.ply", **values)


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        ("", "empty.obj", "empty"),
        ("# nothing here\n", "comment.obj", "no vertices|0 faces|unreadable"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "points.obj", "0 faces"),
        ("ply\nformat ascii 1.0\nelement vertex 3\ngarbage", "broken.ply", "unreadable"),
        ("not a mesh at all", "noise.glb", "unreadable"),
        (CUBE.replace("v 1 1 1", "v 1e150 1 1"), "far.obj", r"coordinates such as 1e\+150; at most 1e\+12"),
        ("not a mesh at all", "noise.stl", "unreadable|no vertices|0 faces|open"),
        (CUBE, "cube.dxf", "unsupported"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
            "index.obj",
            "line 4: expected vertex numbers from 1 to 3, found 9",
        ),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, text: str, name: str, says: str) -> None:
    path = write(tmp_path, text, name)
    with pytest.raises(InputError, match=says) as caught:
        load_shape(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")


def test_open_mesh_is_refused_with_the_count_of_edges() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    # The cap above z = 0.5 cut off leaves a loop of more than eight edges, which is not filled.
    faces = ball.faces[ball.triangles_center[:, 2] < 0.5]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    boundary = int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())
    assert boundary > 8
    with pytest.raises(InputError, match=f"^ball: mesh is open, {boundary} boundary edges"):
        check_mesh(ball.vertices, faces, "ball")


BOX = trimesh.creation.box((1.0, 2.0, 3.0))
VERTICES, BOX_FACES = np.array(BOX.vertices), np.array(BOX.faces)
FIN = [[2.0, 0, 0], [2, 1, 0]]  # hangs on the box by a corner


@pytest.mark.parametrize(
    ("vertices", "faces", "says"),
    [
        (VERTICES, BOX_FACES[:, ::-1], "turned the winding outwards"),
        (VERTICES, np.vstack([BOX_FACES[:1, ::-1], BOX_FACES[1:]]), "made the winding consistent"),
        (VERTICES, BOX_FACES[~(VERTICES[BOX_FACES][:, :, 0] > 0).all(1)], "filled holes with 2 faces"),
        (VERTICES[BOX_FACES].reshape(-1, 3), np.arange(36).reshape(-1, 3), "merged 28 duplicate vertices"),
        (VERTICES, np.vstack([BOX_FACES, [[0, 0, 1]]]), "dropped 1 degenerate faces"),
        (np.vstack([VERTICES, FIN]), np.vstack([BOX_FACES, [[0, 8, 9]]]), "dropped 1 loose faces"),
        (VERTICES, np.vstack([BOX_FACES, BOX_FACES[:1]]), "dropped 1 double faces"),
        (VERTICES, np.vstack([BOX_FACES, BOX_FACES]), "dropped 12 double faces"),
        (VERTICES, np.vstack([BOX_FACES, BOX_FACES[:, ::-1]]), "dropped 12 double faces"),
        (VERTICES, np.vstack([BOX_FACES, [[0, 3, 7], [7, 3, 0]]]), "dropped 2 double faces"),  # a sheet within
    ],
)
def test_what_can_be_mended_is_mended_with_a_warning(vertices: np.ndarray, faces: np.ndarray, says: str) -> None:
    with pytest.warns(UserWarning, match=f"box.obj: mended the mesh: {says}"):
        mended_vertices, mended = check_mesh(vertices, faces, "box.obj")
    assert signed_volume(mended_vertices, mended) == pytest.approx(6.0, rel=1e-12)
    assert (len(mended_vertices), len(mended)) == (8, 12)


def test_sound_mesh_passes_in_silence_and_input_is_untouched() -> None:
    vertices, faces = VERTICES, BOX_FACES
    before = vertices.copy(), faces.copy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_mesh(vertices, faces, "box")
    np.testing.assert_array_equal(vertices, before[0])
    np.testing.assert_array_equal(faces, before[1])


def test_flat_and_branching_meshes_are_refused() -> None:
    vertices, faces = VERTICES, BOX_FACES
    fin = np.vstack([vertices, [[9.0, 9, 9], [9, 0, 9]]])  # a tetrahedron on an edge
    with pytest.raises(InputError, match="branching: mesh has 1 edges shared by more than two faces"):
        check_mesh(fin, np.vstack([faces, [[0, 1, 8], [1, 0, 9], [0, 8, 9], [1, 9, 8]]]), "branching")
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(InputError, match="no volume"):
        check_mesh(triangle, np.array([[0, 1, 2], [0, 2, 1]]), "sheet")
    with pytest.raises(InputError, match=r"outside 0\.\.7"):
        check_mesh(vertices, faces + 1, "shifted")


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return meshes as one, each with vertices of its own."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return np.vstack([v for v, _ in parts]), np.vstack([f + n for (_, f), n in zip(parts, first, strict=False)])


def ball(radius: float, x: float = 0.0, *, inwards: bool = False) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return mesh.vertices + np.array([x, 0, 0]), mesh.faces[:, ::-1] if inwards else mesh.faces


def test_no_place_counts_twice() -> None:
    """Shells in one another, overlapping and touching: the volume is that of the place that they bound.

    The overlap of two boxes is known; that of balls of the same facets from the shells alone.
    """
    unit = signed_volume(*ball(1.0))
    with pytest.warns(UserWarning, match=r"united 2 closed shells, which bound 12\.50% of the volume twice"):
        nested = check_mesh(*joined(ball(2.0), ball(1.0)), "nested")
    assert signed_volume(*nested) == pytest.approx(8 * unit, rel=1e-12)
    one, whole = (Body(name="", vertices_m=v, faces=f) for v, f in (nested, ball(2.0)))
    assert one.area_m2 == pytest.approx(whole.area_m2, rel=1e-12)
    for point in ([5.0, 1, 2], [0, 0, 1.9]):
        np.testing.assert_allclose(
            one.gravity.evaluate(point)[1], whole.gravity.evaluate(point)[1], rtol=1e-9, atol=1e-16
        )
    vertices, faces = VERTICES, BOX_FACES
    with pytest.warns(UserWarning, match="united 2 closed shells"):
        lobes = check_mesh(
            *joined((vertices, faces), (vertices * [1, 0.5, 0.5] + [0.25, 0.1, 0.1], faces)), "lobes"
        )
    size = np.ptp(vertices, axis=0)
    assert signed_volume(*lobes) == pytest.approx(6.0 + 0.25 * size[1] / 2 * size[2] / 2, rel=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # these are as they shall be, bit for bit
        for parts, volume in (
            ((ball(2.0), ball(1.0, inwards=True)), 7 * unit),  # a cavity
            ((ball(3.0), ball(2.0, inwards=True), ball(1.0)), (27 - 8 + 1) * unit),  # and a body in it
            ((ball(2.0), ball(1.0, 4.0)), 9 * unit),  # apart
            (((vertices, faces), (vertices + size * [1, 0, 0], faces)), 12.0),  # with a common side
        ):
            given = joined(*parts)
            np.testing.assert_array_equal(check_mesh(*given, "sound")[0], given[0])
            assert signed_volume(*check_mesh(*given, "sound")) == pytest.approx(volume, rel=1e-12)
    with pytest.warns(UserWarning, match="turned a shell outwards"):
        apart = check_mesh(*joined(ball(2.0), ball(1.0, 4.0, inwards=True)), "one inside out")
    assert signed_volume(*apart) == pytest.approx(9 * unit, rel=1e-12)


def test_a_shell_that_crosses_itself_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    import manifold3d

    monkeypatch.setattr(manifold3d.Manifold, "status", lambda self: manifold3d.Error.NotManifold)
    with pytest.warns(
        UserWarning, match=r"nested: its 2 closed shells, [\d.]+ in volume, cannot be united \(NotMan"
    ):
        vertices, _ = check_mesh(*joined(ball(2.0), ball(1.0)), "nested")
    assert len(vertices) == 2 * 162


@pytest.mark.parametrize("filled", [False, True])
@pytest.mark.parametrize("points", [1, 3, 12])
@pytest.mark.parametrize("suffix", ["obj", "ply", "stl"])
def test_points_on_an_edge_with_and_without_slivers(tmp_path: Path, points: int, filled: bool, suffix: str) -> None:
    """Faces end at points on edges of their neighbours (T-junctions), with slivers of no area between, or without.

    The points are whole multiples of 2⁻¹⁰ on edges of a box, so they lie on it exactly in every kind of file, in
    single precision, too.
    """
    box_mesh = trimesh.creation.box(extents=(1024, 2048, 4096))
    vertices, faces = [tuple(v) for v in box_mesh.vertices], [tuple(map(int, f)) for f in box_mesh.faces]
    rng = np.random.default_rng(points)
    for a, b, c in (faces[0], faces[1], faces[5], faces[8]):
        faces.remove((a, b, c))
        start, end = (np.array(vertices[k]) for k in (a, b))
        way = np.sort(rng.choice(np.arange(1, 1024), points, replace=False)) / 1024
        chain = [a, *range(len(vertices), len(vertices) + points), b]
        vertices += [tuple(start + (end - start) * t) for t in way]
        faces += [(u, v, c) for u, v in itertools.pairwise(chain)]
        if filled:
            faces += [(a, v, u) for u, v in itertools.pairwise(chain[1:])]
    path = tmp_path / f"split.{suffix}"
    trimesh.Trimesh(np.array(vertices), np.array(faces), process=False).export(path)
    with pytest.warns(UserWarning, match=r"split\.\w+: mended the mesh: .*filled holes with "):
        mended_vertices, mended = load_shape(path)
    assert signed_volume(mended_vertices, mended) == pytest.approx(1024 * 2048 * 4096, rel=1e-12)
    assert trimesh.Trimesh(mended_vertices, mended, process=False).is_watertight
    assert len(mended_vertices) == 8 + 4 * points


def test_a_corner_of_one_face_beside_its_vertex_is_closed_or_refused() -> None:
    """The hole between both is filled with slivers, which may share their three corners with faces beyond them."""
    vertices, faces = ball(2.0)
    for face, corner in itertools.product(range(len(faces)), range(3)):
        for away in ([1e-9, 0, 0], [1e-37, 0, 0]):
            moved = np.vstack([vertices, vertices[faces[face, corner]] + away])
            apart = faces.copy()
            apart[face, corner] = len(vertices)
            with warnings.catch_warnings(), contextlib.suppress(InputError):
                warnings.simplefilter("ignore", UserWarning)  # what was mended
                assert signed_volume(*check_mesh(moved, apart, "ball")) > 0


# --- the embedded nucleus -----------------------------------------------------------------------------------


def test_nucleus_is_a_closed_bilobed_body_of_the_published_size() -> None:
    vertices, faces = embedded_nucleus()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert 15_000 <= len(faces) <= 40_000
    # 18.56 km³ (Preusker 2017) to 18.8 ± 0.3 km³ (Jorda 2016); the procedural stand-in is tuned to 2 %.
    assert mesh.volume == pytest.approx(18.6e9, rel=0.02)
    # 5.0 × 3.7 × 3.2 km, which lobe ellipsoids alone miss by up to 10 %.
    np.testing.assert_allclose(mesh.extents, [5000, 3700, 3200], rtol=0.10)


def test_nucleus_is_what_its_maker_makes() -> None:
    vertices, faces = embedded_nucleus()
    made_vertices, made_faces = embedded_nucleus_maker.made_nucleus()
    np.testing.assert_allclose(made_vertices, vertices, atol=1e-6)  # other processors round otherwise
    np.testing.assert_array_equal(made_faces, faces)


def test_noise_is_a_function_of_place() -> None:
    points = np.random.default_rng(1).uniform(-3000, 3000, (40_000, 3))
    value = gradient_noise(points, 5)
    # Shuffling or slicing the points must not matter, nor where the chunks of 32768 fall.
    np.testing.assert_array_equal(value[35_000:], gradient_noise(points[35_000:], 5))
    assert abs(value.mean()) < 4 * value.std() / np.sqrt(40_000)  # independent cells: 4 sigma of the mean
    assert 0.15 < value.std() < 0.35
    assert np.abs(np.corrcoef(value, gradient_noise(points, 6))[0, 1]) < 4 / np.sqrt(40_000)
    # Continuous: slopes of unit gradients stay below 4 per unit.
    near = gradient_noise(points + np.array([1e-3, 0, 0]), 5)
    assert np.abs(near - value).max() < 4e-3


# --- body and sites -----------------------------------------------------------------------------------------


def test_body_defaults_hash_and_bounds() -> None:
    body = load_body()
    assert body.density_kg_m3 == 537.8
    # GM from the published mass, 9.982e12 kg (Preusker 2017), within the nucleus's volume tolerance.
    assert body.gravity.mass_kg == pytest.approx(9.982e12, rel=0.02)
    assert body.omega_rad_s == pytest.approx(2 * np.pi / (12.4041 * 3600), rel=1e-6)
    assert len(body.content_hash) == 64
    moved = Body(name="moved", vertices_m=body.vertices_m + 1e-9, faces=body.faces)
    assert moved.content_hash != body.content_hash


def test_centre_of_mass_of_a_moved_wedge() -> None:
    # a tetrahedron's centre of mass is the mean of its corners; 1e6 m away, coordinates keep 1e-10 m
    moved = np.array([1e6, -2e6, 3e5])
    corners = np.array([[0.0, 0, 0], [400, 0, 0], [0, 200, 0], [0, 0, 100]]) + moved
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], dtype=np.int32)
    body = Body(name="wedge", vertices_m=corners, faces=faces)
    np.testing.assert_allclose(body.centre_of_mass_T_m, corners.mean(axis=0), rtol=0, atol=1e-8)


def test_real_shape_loads_as_it_is(real_shape: Path) -> None:
    body = load_body(real_shape)
    # Metres, not kilometres: 5.0 km long, 18.406 km³ as stated with the file.
    assert body.volume_m3 == pytest.approx(18.406e9, rel=1e-4)
    assert body.name == "67p_18k"
    assert len(body.faces) == 18_294


def test_local_level_axes() -> None:
    # On the equator at +x, gravity towards -x: down is -x, north is +z, east is +y (the way the body turns).
    frame = local_level([-2.0, 0.0, 0.0])
    np.testing.assert_allclose(frame, [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-15)
    # At the pole north has no meaning: +x of T stands in.
    pole = local_level([0.0, 0.0, -1.0])
    np.testing.assert_allclose(pole[:, 0], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(pole[:, 2], [0, 0, -1], atol=1e-15)


@pytest.mark.parametrize("tilt", [1.0, 1e-3, 1e-5, 1e-7, 0.0])
def test_local_level_is_a_rotation_up_to_the_pole(tilt: float) -> None:
    frame = local_level([tilt, 0.3 * tilt, 1.0])
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-15)
    assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-14)


def test_sites_lie_on_gentle_ground_and_keep_when_the_list_grows() -> None:
    body = load_body()
    sites = choose_sites(body, 12, seed=0)
    for longer, shorter in zip(sites, choose_sites(body, 4, seed=0), strict=False):
        np.testing.assert_array_equal(longer.position_T_m, shorter.position_T_m)
        np.testing.assert_array_equal(longer.T_from_L, shorter.T_from_L)
    other = choose_sites(body, 1, seed=1)[0]
    assert np.linalg.norm(other.position_T_m - sites[0].position_T_m) > 1.0
    normals, _ = face_normals_areas(body.vertices_m, body.faces)
    corners = body.vertices_m[body.faces]
    for site in sites:
        # The facet that holds the point: smallest distance to the plane among the nearest centres.
        near = np.argsort(np.linalg.norm(corners.mean(axis=1) - site.position_T_m, axis=1))[:40]
        _, distance, index = trimesh.proximity.closest_point_naive(
            trimesh.Trimesh(body.vertices_m, body.faces[near], process=False), site.position_T_m[None]
        )
        assert distance[0] < 1e-6  # rounding of metres in kilometres
        up = -site.T_from_L[:, 2]
        slope = np.degrees(np.arccos(np.clip(normals[near[index[0]]] @ up, -1, 1)))
        assert slope < 35.0 + 1e-6
        np.testing.assert_allclose(site.T_from_L.T @ site.T_from_L, np.eye(3), atol=1e-14)
        assert site.T_from_L[2, 0] >= 0  # north leans towards the pole


def test_a_site_is_drawn_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A session of 10,000 sites starts at once: gravity is evaluated for the sites that are visited alone."""
    body = load_body()
    evaluated = recorded_calls(monkeypatch, body.gravity, "evaluate")
    sites = choose_sites(body, 10_000, seed=0)
    assert (len(sites), evaluated) == (10_000, [])
    site = sites[9_876]
    drawn = len(evaluated)
    assert drawn > 0
    assert sites[9_876] is site
    assert len(evaluated) == drawn  # kept
    alone = choose_sites(load_body(), 9_877, seed=0)[-1]
    np.testing.assert_array_equal(alone.position_T_m, site.position_T_m)
    np.testing.assert_array_equal(alone.T_from_L, site.T_from_L)
    assert [s.index for s in choose_sites(body, 3, seed=0)] == [0, 1, 2]
    with pytest.raises(IndexError):
        sites[10_000]


@pytest.mark.parametrize(
    ("period_s", "slope_deg", "must_say"),
    [
        (60.0, 35.0, ["spin is faster than gravity holds", "rotation_period_h = 0.0166667", "density_kg_m3 = 500"]),
        (1e6, 0.01, ["slope by more than 0.01 degrees; smooth the shape"]),
    ],
)
def test_ground_that_is_nowhere_level_is_refused_with_its_reason(
    period_s: float, slope_deg: float, must_say: list[str]
) -> None:
    """A fast body lifts its ground off; on a slow one the facets themselves are too steep."""
    vertices, faces = VERTICES, BOX_FACES
    body = Body(name="brick", vertices_m=vertices, faces=faces, density_kg_m3=500.0, rotation_period_s=period_s)
    with pytest.raises(InputError) as caught:
        choose_sites(body, 4, seed=1, max_slope_deg=slope_deg)[2]
    assert [words for words in ["brick: none of 1000", "site 2", *must_say] if words not in str(caught.value)] == []


# --- relief that a smoothed shape model has lost: how much is restored, where, and by which rule ------------------


SPHERE, FACES = ellipsoid((1000.0, 1000.0, 1000.0), 0.0)


def wavy(wavelength_m: float, height_m: float) -> np.ndarray:
    """Return the sphere with waves along z."""
    wave = np.cos(2 * np.pi * SPHERE[:, 2] / wavelength_m)
    return SPHERE * (1 + height_m * wave / 1000.0)[:, None]


def test_waves_are_amplified_by_the_stated_gain() -> None:
    """In a band around the equator, where the waves run along the surface and the sphere is level along them."""
    edge = mean_edge_m(SPHERE, FACES)
    band = np.abs(SPHERE[:, 2]) < 250
    for edges in (6.0, 12.0):
        wavelength = edges * edge
        before = wavy(wavelength, 2.0)
        after = sharpened(before, FACES, 1.0)
        flat = sharpened(SPHERE, FACES, 1.0)
        wave = np.cos(2 * np.pi * SPHERE[band, 2] / wavelength)
        heights = np.linalg.norm(after[band], axis=1) - np.linalg.norm(flat[band], axis=1)
        seen = (heights @ wave) / (wave @ wave) / 2.0
        square = (0.7 * 2 * np.pi / edges) ** 2
        assert seen == pytest.approx(1 + (square / (1 + square)) ** 2, rel=0.08)


def test_no_gain_changes_nothing() -> None:
    assert sharpened(SPHERE, FACES, 0.0) is SPHERE


def test_auto_continues_the_roughness_of_a_smoothed_model(real_shape: Path) -> None:
    """67p_18k.obj is smoothed. Its volume, 18.41 km³, hardly changes, towards the published ones (18.56, 18.8)."""
    body = load_body(real_shape)
    sharp = load_body(real_shape, sharpen="auto")
    edge = mean_edge_m(body.vertices_m, body.faces)
    short = deviogram(body.vertices_m, body.vertex_normals, edge * np.array([1.3]))[0]
    normals = vertex_normals(sharp.vertices_m, sharp.faces)
    restored, long = deviogram(sharp.vertices_m, normals, edge * np.array([1.3, 3.8]))
    assert restored == pytest.approx(long * 1.3 / 3.8, rel=0.1)
    assert restored > 1.3 * short
    assert body.volume_m3 < sharp.volume_m3 < 18.6e9


def test_a_shape_is_scaled_about_its_origin_to_the_volume_that_is_asked_for() -> None:
    body, larger = load_body(), load_body(volume_m3=8 * load_body().volume_m3)
    np.testing.assert_allclose(larger.vertices_m, 2 * body.vertices_m, rtol=1e-12)
    scene = vbnfault.load_scene("paper67p", {"body.volume_km3": 18.8})
    session = vbnfault.Session(scene)
    assert session.body.volume_m3 == pytest.approx(18.8e9, rel=1e-9)
    assert scene_identity(session)["body"]["volume_km3"] == 18.8
    assert "volume_km3" not in scene_identity(vbnfault.Session(vbnfault.load_scene("paper67p")))["body"]
    with pytest.raises(vbnfault.InputError, match=r"volume_km3 = 5: semi_axes_m sets the volume"):
        vbnfault.load_scene("paper67p", {"body.volume_km3": 5.0, "body.shape": "ellipsoid"})


def test_a_shape_file_is_needed() -> None:
    with pytest.raises(vbnfault.InputError, match=r"sharpen = 1.5: needs a shape file"):
        vbnfault.load_scene("paper67p", {"body.sharpen": 1.5})
    plain = vbnfault.Session(vbnfault.load_scene("paper67p")).body
    auto = vbnfault.Session(vbnfault.load_scene("paper67p", {"body.sharpen": "auto"})).body
    assert auto.content_hash == plain.content_hash
    with pytest.raises(vbnfault.InputError, match=r"sharpen"):
        vbnfault.load_scene("paper67p", {"body.sharpen": 5.0, "body.shape": "x.obj"})
