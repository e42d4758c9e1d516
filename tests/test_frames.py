"""Frames: axes and signs of Gallon et al., appendix A, scipy's rotations, and 67P's published geometry."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import small_scene
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation as Reference

from vbnfault.core import frames
from vbnfault.core.errors import InputError
from vbnfault.scene import config
from vbnfault.world import ephemeris

ROTATION_67P = frames.Rotation(
    pole_ra_deg=69.54, pole_dec_deg=64.11, prime_meridian_deg=114.69, period_h=24 * 360 / 696.543884683
)
ORBIT = frames.ORBIT_67P
angles = st.floats(-720, 720)


@st.composite
def unit_vectors(draw: st.DrawFn) -> np.ndarray:
    """Any direction, the poles and near-poles included."""
    z = draw(st.floats(-1, 1))
    a = draw(st.floats(0, 2 * np.pi))
    return frames.unit(np.array([np.sqrt(1 - z * z) * np.cos(a), np.sqrt(1 - z * z) * np.sin(a), z]))


def assert_proper_rotation(matrix: np.ndarray) -> None:
    # entries are sums of three products of numbers up to 1, each rounded at 1.1e-16, in chains of up to five
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-14)


def angle_between_rad(a: np.ndarray, b: np.ndarray) -> float:
    return float(2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b)))


# --------------------------------------------------------------------------------------- elementary rotations


@given(angles)
def test_elementary_rotations_agree_with_scipy(degrees: float) -> None:
    for name, make in (("x", frames.rx), ("y", frames.ry), ("z", frames.rz)):
        expected = Reference.from_euler(name, degrees, degrees=True).as_matrix()
        # radians(720) carries 9e-16 of rounding into the entries
        np.testing.assert_allclose(make(np.radians(degrees)), expected, atol=5e-15)


# -------------------------------------------------------------------------------------------- directions in L


@pytest.mark.parametrize(
    ("azimuth", "elevation", "expected"),
    [
        (0, 0, (1, 0, 0)),  # north
        (90, 0, (0, 1, 0)),  # east
        (180, 0, (-1, 0, 0)),
        (270, 0, (0, -1, 0)),
        (0, 90, (0, 0, -1)),  # up, L's z being down
        (0, -90, (0, 0, 1)),
        (90, 45, (0, np.sqrt(0.5), -np.sqrt(0.5))),
    ],
)
def test_azimuth_runs_from_north_to_east_and_elevation_upwards(
    azimuth: float, elevation: float, expected: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(frames.direction_L(azimuth, elevation), expected, atol=2e-16)


@given(unit_vectors())
def test_direction_round_trip_also_at_the_poles(direction: np.ndarray) -> None:
    azimuth, elevation = frames.azimuth_elevation_deg(direction)
    assert 0 <= azimuth < 360 or azimuth == pytest.approx(360)
    again = frames.direction_L(azimuth, elevation)
    np.testing.assert_allclose(again, direction, atol=1e-15)


# ------------------------------------------------------------------------------------------- camera attitudes


@given(unit_vectors())
def test_c0_has_the_axes_of_appendix_a(sun: np.ndarray) -> None:
    assume(np.hypot(sun[0], sun[1]) > 1e-6)
    x, y, z = frames.L_from_C0(sun).T
    np.testing.assert_allclose(z, sun, atol=1e-15)
    # y along the projection of down on the plane across the Sun: no part towards the Sun, none across both,
    # and a positive part downwards. Near the zenith the projection is a small difference: 1e-16 / 1e-6.
    down = np.array([0.0, 0.0, 1.0])
    assert y @ sun == pytest.approx(0, abs=1e-9)
    assert y @ np.cross(down, sun) == pytest.approx(0, abs=1e-9)
    assert y @ down > 0
    np.testing.assert_allclose(x, np.cross(y, z), atol=1e-15)
    assert np.linalg.det(np.column_stack([x, y, z])) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("vertical", [1.0, -1.0])
def test_c0_with_a_vertical_reference_continues_one_slightly_north(vertical: float) -> None:
    exact = frames.L_from_C0(np.array([0, 0, vertical]))
    assert_proper_rotation(exact)
    tilted = frames.L_from_C0(frames.unit(np.array([1e-7, 0, vertical])))
    # the two references are 1e-7 rad apart, and so are the attitudes
    np.testing.assert_allclose(exact, tilted, atol=2e-7)
    np.testing.assert_allclose(exact[:, 1], [-vertical, 0, 0])  # nadir: south; zenith: north


def test_c0_with_north_up_is_smooth_about_the_nadir() -> None:
    nadir = np.array([0.0, 0, 1])
    straight = frames.L_from_C0(nadir, north_up=True)
    np.testing.assert_array_equal(straight, frames.L_from_C0(nadir))
    for tilt in ([1e-6, 0, 0], [-1e-6, 0, 0], [0, 1e-6, 0], [0, -1e-6, 0]):
        np.testing.assert_allclose(frames.L_from_C0(nadir + tilt, north_up=True), straight, atol=2e-6)
    north = frames.L_from_C0(np.array([1.0, 0, 0]), north_up=True)  # south has no projection: y is down
    np.testing.assert_array_equal(north[:, 1], nadir)


@given(unit_vectors(), angles, angles, angles)
def test_l_from_c_is_the_product_of_the_conventions(sun: np.ndarray, roll: float, pitch: float, yaw: float) -> None:
    assume(np.hypot(sun[0], sun[1]) > 1e-3)
    got = frames.L_from_C(sun, roll, pitch, yaw)
    # intrinsic rotations about x, then y, then z, in scipy's notation
    expected = frames.L_from_C0(sun) @ Reference.from_euler("XYZ", [roll, pitch, yaw], degrees=True).as_matrix()
    np.testing.assert_allclose(got, expected, atol=2e-14)


def test_signs_of_roll_and_pitch_in_the_picture() -> None:
    # Roll turns y to z: the boresight rises (-y of C0), so the Sun sinks in the picture (towards +y).
    # Pitch turns z to x: the boresight goes right, so the Sun goes left.
    sun = frames.direction_L(40.0, 5.0)
    sun_C = frames.L_from_C(sun, 10.0, 0.0, 0.0).T @ sun
    np.testing.assert_allclose(sun_C, [0, np.sin(np.radians(10)), np.cos(np.radians(10))], atol=1e-15)
    sun_C = frames.L_from_C(sun, 0.0, 10.0, 0.0).T @ sun
    np.testing.assert_allclose(sun_C, [-np.sin(np.radians(10)), 0, np.cos(np.radians(10))], atol=1e-15)


@given(unit_vectors(), angles, angles, angles)
def test_boresight_angle_agrees_with_the_matrices(sun: np.ndarray, roll: float, pitch: float, yaw: float) -> None:
    assume(np.hypot(sun[0], sun[1]) > 1e-3)
    boresight = frames.L_from_C(sun, roll, pitch, yaw)[:, 2]
    expected = np.degrees(angle_between_rad(boresight, sun))
    # arccos near 1 magnifies 4e-16 to √(8e-16) = 3e-8 rad = 1.6e-6°
    assert float(frames.boresight_angle_deg(roll, pitch)) == pytest.approx(expected, abs=4e-6)


# ------------------------------------------------------------------------------------------------- quaternion


@given(angles, angles, angles)
def test_quaternion_is_unit_w_first_and_gives_back_the_matrix(a: float, b: float, c: float) -> None:
    matrix = frames.rz(np.radians(a)) @ frames.rx(np.radians(b)) @ frames.ry(np.radians(c))
    w, x, y, z = frames.quaternion(matrix)
    assert w >= 0
    assert w * w + x * x + y * y + z * z == pytest.approx(1, abs=1e-14)
    back = [  # the textbook form, active rotation
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    np.testing.assert_allclose(back, matrix, atol=1e-13)


# ------------------------------------------------------------------------------------------ smallest rotation


def assert_takes_by_the_smallest_angle(source: np.ndarray, target: np.ndarray) -> None:
    matrix = frames.minimal_rotation(source, target)
    assert_proper_rotation(matrix)
    np.testing.assert_allclose(matrix @ source, target, atol=1e-14)
    # no rotation that does it turns by less than the angle between the two: compare its own angle, from the
    # antisymmetric part and the trace (stable at both ends), with that
    k = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    own = np.arctan2(np.linalg.norm(k), (np.trace(matrix) - 1) / 2)
    assert own == pytest.approx(angle_between_rad(source, target), abs=1e-7)


@given(unit_vectors(), unit_vectors())
def test_minimal_rotation(source: np.ndarray, target: np.ndarray) -> None:
    assume(np.linalg.norm(source + target) > 0.5)  # the neighbourhood of opposite has its own test
    assert_takes_by_the_smallest_angle(source, target)


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3), frames.unit(np.array([0.3, -0.5, 0.2]))])
def test_minimal_rotation_of_equal_of_opposite_and_of_nearly_opposite_vectors(axis: np.ndarray) -> None:
    assert_takes_by_the_smallest_angle(axis, -axis)
    np.testing.assert_allclose(frames.minimal_rotation(axis, axis), np.eye(3), atol=1e-15)
    across = frames.unit(np.cross(axis, [0.3, 0.4, 0.8]))
    for short_of_half_a_turn_rad in (1e-3, 1e-5, 1.5e-6, 1e-9, 1e-12):
        target = frames.unit(-np.cos(short_of_half_a_turn_rad) * axis + np.sin(short_of_half_a_turn_rad) * across)
        matrix = frames.minimal_rotation(axis, target)
        assert_proper_rotation(matrix)
        # a bisector of length d is known to 1e-16 / d: 1e-8 is the best that both sides of any threshold can do
        np.testing.assert_allclose(matrix @ axis, target, atol=5e-8)


# --------------------------------------------------------------------------------------------- orbit and spin


@pytest.mark.parametrize(
    ("julian_date", "subsolar_latitude_deg"),
    [
        (2456875.5, 44.6),  # 2014-08-06 0 h
        (2457152.5, 0.3),  # 2015-05-10
        (2457247.5, -47.7),  # 2015-08-13, perihelion
        (2457269.5, -52.1),  # 2015-09-04
        (2457468.5, 0.0),  # 2016-03-21
    ],
)
def test_subsolar_latitudes_of_67p(julian_date: float, subsolar_latitude_deg: float) -> None:
    sun_J = -frames.unit(ORBIT.position_J_au(julian_date))
    sun_T = ROTATION_67P.J_from_T(julian_date).T @ sun_J
    # the reference values are rounded to 0.1°
    assert np.degrees(np.arcsin(sun_T[2])) == pytest.approx(subsolar_latitude_deg, abs=0.05)


def test_distance_of_67p() -> None:
    assert np.linalg.norm(ORBIT.position_J_au(2456875.5)) == pytest.approx(3.6007, abs=5e-5)
    assert np.linalg.norm(ORBIT.position_J_au(ORBIT.perihelion_jd)) == pytest.approx(ORBIT.perihelion_au, rel=1e-12)


@pytest.mark.parametrize("eccentricity", [0.0, 0.5, 0.9967, 1 - 1e-9, 1.0, 1 + 1e-9, 1.5, 100.0])
@pytest.mark.parametrize("perihelion_au", [0.02, 30.0])
def test_any_conic_is_solved_to_rounding(eccentricity: float, perihelion_au: float) -> None:
    """The time that a position stands for, by the textbook's three equations, is the date asked for."""
    e, q, k = eccentricity, perihelion_au, 0.01720209895
    orbit = frames.Orbit(
        eccentricity=e,
        perihelion_au=q,
        inclination_deg=0.0,
        node_deg=0.0,
        argument_deg=0.0,
        perihelion_jd=2457000.0,
    )
    ecliptic = frames.rx(np.radians(-frames.OBLIQUITY_DEG))
    limit = np.pi * (q / (1 - e)) ** 1.5 / k if e < 1 else np.inf

    def days_at(half: float) -> float:
        """Days since perihelion where tan(ν/2) is `half`: Kepler's equation, Barker's, and the hyperbolic one."""
        if e == 1:
            return np.sqrt(2 * q**3) / k * (half + half**3 / 3)
        scale = abs(q / (1 - e)) ** 1.5 / k
        anomaly = np.sqrt(abs(1 - e) / (1 + e)) * half
        if e < 1:
            eccentric = 2 * np.arctan(anomaly)
            return scale * (eccentric - e * np.sin(eccentric))
        hyperbolic = 2 * np.arctanh(anomaly)
        return scale * (e * np.sinh(hyperbolic) - hyperbolic)

    for days in (0.03125, 1.0, 32.0, 1024.0, 2.0**16, 2.0**21):
        if days > limit:
            break
        x, y, z = ecliptic @ orbit.position_J_au(2457000.0 + days)
        r = np.hypot(x, y)
        assert r + e * x == pytest.approx(q * (1 + e), rel=1e-9)  # the conic
        # an orbit is its own mirror image in time
        np.testing.assert_allclose(
            ecliptic @ orbit.position_J_au(2457000.0 - days), [x, -y, z], rtol=1e-9, atol=1e-12 * r
        )
        half = y / (r + x) if x > 0 else (r - x) / y
        # what rounding of the position and of the two frames means in time, and of the textbook's own difference
        # of nearly equal anomalies near perihelion
        slack = 1e-13 * half
        loss = abs(days_at(half - slack) - days_at(half + slack)) + 1e-15 * abs(q / (1 - e or np.inf)) ** 1.5 / k
        assert days_at(half) == pytest.approx(days, abs=loss + 1e-12 * days)


def test_a_parabola_has_no_mean_motion() -> None:
    table = {"eccentricity": 1.0, "perihelion_au": 1.0, "inclination_deg": 0.0, "node_deg": 0.0}
    table |= {"argument_deg": 0.0, "perihelion_jd": 2457000.0}
    scene = config.parse_scene(small_scene(orbit=table), source="test")
    assert np.isfinite(ephemeris.ephemeris(scene)[0]).all()
    with pytest.raises(InputError, match=r"orbit.mean_motion_deg_day = 0.1: a parabola .* has none"):
        config.parse_scene(small_scene(orbit={**table, "mean_motion_deg_day": 0.1}), source="test")


def test_pole_and_prime_meridian_of_67p() -> None:
    for date in (2451545.0, 2456974.25):
        J_from_T = ROTATION_67P.J_from_T(date)
        assert_proper_rotation(J_from_T)
        ra, dec = np.radians([69.54, 64.11])
        np.testing.assert_allclose(
            J_from_T[:, 2], [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], atol=1e-15
        )
    # at J2000 the prime meridian lies W from the node Q of the body's equator, Q = (−sin α, cos α, 0)
    J_from_T = ROTATION_67P.J_from_T(2451545.0)
    node = np.array([-np.sin(ra), np.cos(ra), 0])
    ahead = np.cross(J_from_T[:, 2], node)
    w = np.degrees(np.arctan2(J_from_T[:, 0] @ ahead, J_from_T[:, 0] @ node))
    assert w == pytest.approx(114.69, abs=1e-10)


def test_spin_is_the_published_rate_eastwards() -> None:
    # W grows by 696.543884683° a day: in a thousandth of a day by 0.6965°
    before, after = (ROTATION_67P.J_from_T(2456974.0 + t) for t in (0.0, 1e-3))
    turn = Reference.from_matrix(after @ before.T).as_rotvec(degrees=True)
    # 3.9e6° of W are known to 1e-9°, and the Julian date to 4e-10 d: 3e-7°
    np.testing.assert_allclose(turn, 0.696543884683 * before[:, 2], atol=1e-6)
    assert ROTATION_67P.period_h == pytest.approx(12.4041, abs=5e-5)


# ----------------------------------------------------------------------------------------- commanded attitude


@given(unit_vectors(), unit_vectors(), angles, angles, angles)
def test_commanded_attitude_puts_the_sun_where_commanded(
    sun_J: np.ndarray, sun_T: np.ndarray, a: float, b: float, c: float
) -> None:
    own = Reference.from_euler("XYZ", [a, b, c], degrees=True).as_matrix()
    assume(np.linalg.norm(own @ sun_J + sun_T) > 0.5)
    commanded = frames.T_from_J_commanded(own, sun_J, sun_T)
    assert_proper_rotation(commanded)
    np.testing.assert_allclose(commanded @ sun_J, sun_T, atol=1e-14)


def test_commanded_where_it_already_is_changes_nothing() -> None:
    own = Reference.from_euler("XYZ", [10, 20, 30], degrees=True).as_matrix()
    sun_J = frames.unit(np.array([1.0, 2.0, -0.5]))
    np.testing.assert_allclose(frames.T_from_J_commanded(own, 3 * sun_J, 2 * (own @ sun_J)), own, atol=1e-15)


def test_a_bodys_own_orbit() -> None:
    """Elements of 67P written down give the built-in Sun; Kepler's third law gives the mean motion."""
    from dataclasses import asdict

    elements = asdict(frames.ORBIT_67P)
    built_in = ephemeris.ephemeris(config.parse_scene(small_scene(), source="test"))[0]
    written = config.parse_scene(small_scene(orbit=elements), source="test")
    np.testing.assert_array_equal(ephemeris.ephemeris(written)[0], built_in)
    del elements["mean_motion_deg_day"]
    derived = config.parse_scene(small_scene(orbit=elements), source="test")
    # Gauss's constant and the published mean motion agree to 1e-7, over 273 days from perihelion
    np.testing.assert_allclose(ephemeris.ephemeris(derived)[0], built_in, rtol=1e-5)
    circle = {"eccentricity": 0.0, "perihelion_au": 1.0, "perihelion_jd": 2456974.0 - 365.2568984 / 4}
    circle |= {"inclination_deg": 0.0, "node_deg": 0.0, "argument_deg": 0.0}
    sun = ephemeris.ephemeris(config.parse_scene(small_scene(orbit=circle), source="test"))[0]
    # a quarter of a Gaussian year after perihelion on +x: on +y of the ecliptic
    tilt = np.radians(frames.OBLIQUITY_DEG)
    np.testing.assert_allclose(-sun, [0, np.cos(tilt), np.sin(tilt)], atol=1e-8)


def test_roll_pitch_and_yaw_come_back() -> None:
    reference = frames.direction_L(40, 12)
    angles = (20.0, -35.0, 170.0)
    np.testing.assert_allclose(
        frames.roll_pitch_yaw_deg(reference, frames.L_from_C(reference, *angles)), angles, atol=1e-9
    )
