"""Polyhedron gravity against an independent code, closed forms and its own limits."""

from __future__ import annotations

import numpy as np
import polyhedral_gravity
import pytest
import trimesh
from conftest import REAL_SHAPE

from vbnfault.body import Body, load_body
from vbnfault.body.geometry import face_normals_areas
from vbnfault.body.gravity import GRAVITATIONAL_CONSTANT, PolyhedronGravity

DENSITY = 537.8


@pytest.fixture(scope="module")
def bodies() -> dict[str, Body]:
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    found = {
        "cube": Body(name="cube", vertices_m=box.vertices, faces=box.faces, density_kg_m3=DENSITY),
        "embedded": load_body(),
    }
    if REAL_SHAPE.exists():
        found["real"] = load_body(REAL_SHAPE)
    return found


def surface_points(body: Body, count: int) -> np.ndarray:
    """Facet centres, a hundredth of the edge length above the surface."""
    pick = np.random.default_rng(3).choice(len(body.faces), count, replace=len(body.faces) < count)
    normals, areas = face_normals_areas(body.vertices_m, body.faces)
    centres = body.vertices_m[body.faces[pick]].mean(axis=1)
    return centres + 0.01 * np.sqrt(areas[pick])[:, None] * normals[pick]


@pytest.mark.parametrize("name", ["cube", "embedded", "real"])
def test_agrees_with_polyhedral_gravity(bodies: dict[str, Body], name: str) -> None:
    if name not in bodies:
        pytest.skip(f"the real shape model is not at {REAL_SHAPE}")
    body = bodies[name]
    size = float(np.ptp(body.vertices_m, axis=0).max())
    far = size * np.array([[0.9, 0.2, -0.3], [0.1, -1.2, 0.4], [3.0, 2.0, -5.0]])
    inside = np.array([[0.05, 0.02, -0.03]]) * size * (name == "cube") + body.vertices_m.mean(axis=0)
    points = np.vstack([surface_points(body, 12), far, inside])
    mesh = polyhedral_gravity.Polyhedron(
        (body.vertices_m.tolist(), body.faces.tolist()),
        density=DENSITY,
        integrity_check=polyhedral_gravity.PolyhedronIntegrity.DISABLE,
    )
    reference = polyhedral_gravity.evaluate(mesh, points.tolist())
    potential = np.array([abs(r[0]) for r in reference])
    acceleration = np.array([r[1] for r in reference])
    field = body.gravity.evaluate(points)
    outside = slice(0, -1)
    # Sums of 1e5 terms up to 1e4 times their total: 1e-16 · 1e4 · sqrt(1e5) = 3e-10.
    np.testing.assert_allclose(field.potential_m2_s2, potential, rtol=1e-8)
    scale = np.linalg.norm(acceleration, axis=1)
    error = np.linalg.norm(field.acceleration_m_s2 - acceleration, axis=1)
    assert (error[outside] / scale[outside]).max() < 1e-6
    assert error[-1] < 1e-6 * scale[outside].max()
    up, up_reference = -field.acceleration_m_s2[outside], -acceleration[outside]
    sine = np.linalg.norm(np.cross(up, up_reference), axis=1) / np.linalg.norm(up, axis=1) / scale[outside]
    assert np.degrees(np.arcsin(sine)).max() < 0.01


def test_far_field_is_a_point_mass(bodies: dict[str, Body]) -> None:
    cube = bodies["cube"]
    point = np.array([[300.0, -400.0, 1200.0]])
    mu = GRAVITATIONAL_CONSTANT * DENSITY * 8.0
    # A cube has no quadrupole; its next term is of order (1/r)^4 = (1/1300)^4 = 4e-13.
    expected = -mu * point / np.linalg.norm(point) ** 3
    # A cube's 36 terms cancel to 1e-6 of themselves here, so rounding leaves about 1e-9.
    np.testing.assert_allclose(cube.gravity.evaluate(point).acceleration_m_s2, expected, rtol=1e-7)
    np.testing.assert_allclose(cube.gravity.evaluate(point).potential_m2_s2, mu / 1300.0, rtol=1e-7)


def test_sphere_inside_and_outside() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=1000.0)
    field = PolyhedronGravity(sphere.vertices, sphere.faces, 1000.0)
    mu = GRAVITATIONAL_CONSTANT * 1000.0 * sphere.volume
    # The chords' missing shell is even to a fraction of itself, and itself 1 - V/V_sphere = 0.2 %.
    outside = field.evaluate([0.0, 600.0, 1500.0]).acceleration_m_s2[0]
    r = np.hypot(600.0, 1500.0)
    assert np.linalg.norm(outside) == pytest.approx(mu / r**2, rel=1e-4)
    inside = field.evaluate([300.0, 0.0, 0.0]).acceleration_m_s2[0]
    assert inside[0] == pytest.approx(-4 / 3 * np.pi * GRAVITATIONAL_CONSTANT * 1000.0 * 300.0, rel=1e-3)
    # Symmetry of the icosphere under z -> -z leaves no pull towards the sides.
    assert abs(inside[2]) < 1e-9 * abs(inside[0])


def test_acceleration_is_the_potentials_gradient(bodies: dict[str, Body]) -> None:
    gravity = bodies["embedded"].gravity
    point, step = np.array([900.0, -1900.0, 1400.0]), 1.0
    offsets = step * np.eye(3)
    plus = gravity.evaluate(point + offsets).potential_m2_s2
    minus = gravity.evaluate(point - offsets).potential_m2_s2
    # Central differences err by step²/6 · U'''/U' ~ 1/6 / 1000² = 2e-7.
    np.testing.assert_allclose((plus - minus) / (2 * step), gravity.evaluate(point).acceleration_m_s2[0], rtol=1e-5)


def test_points_on_the_surface_and_on_edges_are_finite(bodies: dict[str, Body]) -> None:
    cube = bodies["cube"]
    points = [[1.0, 0.3, 0.2], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]]  # on a face, an edge, a corner
    field = cube.gravity.evaluate(points)
    assert np.isfinite(field.acceleration_m_s2).all()
    # Continuous through the surface: a micrometre above, the pull differs by about G·rho·1e-6·ln.
    above = cube.gravity.evaluate([1.0 + 1e-6, 0.3, 0.2]).acceleration_m_s2[0]
    np.testing.assert_allclose(field.acceleration_m_s2[0], above, rtol=1e-4, atol=1e-12)


def test_a_point_does_not_depend_on_its_company(bodies: dict[str, Body]) -> None:
    gravity = bodies["embedded"].gravity
    points = surface_points(bodies["embedded"], 5)
    together = gravity.evaluate(points).acceleration_m_s2
    alone = np.concatenate([gravity.evaluate(p).acceleration_m_s2 for p in points])
    np.testing.assert_array_equal(together, alone)


def test_centrifugal_term(bodies: dict[str, Body]) -> None:
    cube = bodies["cube"]
    point, omega = np.array([[3.0, -4.0, 5.0]]), 0.01
    field = cube.gravity.evaluate(point)
    effective = cube.gravity.effective(point, omega)
    # omega² times the distance from the axis, outwards: (3, -4, 0)e-4; rounding of 1e-4 is 1e-20.
    np.testing.assert_allclose(effective - field.acceleration_m_s2, [[3e-4, -4e-4, 0.0]], rtol=0, atol=1e-18)
    assert field.potential_m2_s2[0] > 0


def test_gravity_that_is_kept_of_a_shape_is_that_of_density_and_rotation() -> None:
    """Twice the density attracts twice as much; without a rotation nothing else acts."""
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=100.0)
    shape = {"name": "ball", "vertices_m": sphere.vertices, "faces": sphere.faces}
    still, dense, turning = (
        Body(**shape, density_kg_m3=density, rotation_period_s=period)
        for density, period in ((1000.0, 1e12), (2000.0, 1e12), (1000.0, 3e4))
    )
    np.testing.assert_allclose(dense.places[1], 2 * still.places[1], rtol=1e-12)
    outward = turning.places[1] - still.places[1]
    wanted = (2 * np.pi / 3e4) ** 2 * still.places[0] * [1, 1, 0]
    np.testing.assert_allclose(outward, wanted, atol=1e-12)  # of 3e-5 m/s² of gravity, to 1e-7 of it
    assert Body(**shape, density_kg_m3=1000.0, rotation_period_s=1e12).places is still.places
