"""Define the reference frames of Gallon et al. (appendix A), attitudes, the body's orbit and its rotation.

- J: international celestial frame (ICRF axes).
- T: target body-fixed frame; its origin is the shape's origin.
- L: local-level frame at a site; x north, y east, z down along effective gravity.
- B: spacecraft body frame.
- C: camera frame; x image right, y image down, z boresight. It coincides with B.
- C0: z points at the reference direction: the Sun, the nadir or the body's centre. Under the Sun, y is along the
  projection of L's down axis; under the nadir and the centre, along that of south.

    L_from_C = L_from_C0 · Rx(ψ) · Ry(θ) · Rz(φ)        roll ψ, pitch θ, yaw φ

A matrix named TargetFromSource takes column vectors from the source frame to the target frame. All arrays are
float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

J2000_JD = 2451545.0
GAUSS_DEG_DAY = np.degrees(0.01720209895)  # mean motion at 1 au: Gauss's constant
OBLIQUITY_DEG = 23.4392911  # ecliptic → ICRF, IAU 1976 at J2000

# Taylor coefficients of Stumpff's C and S in powers of -z: 1/(2k + 2)! and 1/(2k + 3)!.
_STUMPFF_C = np.array([1 / factorial(2 * k + 2) for k in range(11)])
_STUMPFF_S = np.array([1 / factorial(2 * k + 3) for k in range(11)])


def rx(angle_rad: float) -> F64:
    """Return the matrix of the active rotation about x, float64[3, 3]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def ry(angle_rad: float) -> F64:
    """Return the matrix of the active rotation about y, float64[3, 3]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rz(angle_rad: float) -> F64:
    """Return the matrix of the active rotation about z, float64[3, 3]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def unit(vector: F64) -> F64:
    """Return the vector scaled to length 1."""
    return vector / np.linalg.norm(vector)


def direction_L(azimuth_deg: float, elevation_deg: float) -> F64:
    """Return a unit direction in L. Azimuth counts from north (x) towards east (y), elevation upwards (-z)."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])


def azimuth_elevation_deg(direction: F64) -> tuple[float, float]:
    """Return azimuth, in [0, 360), and elevation of a direction in L. This inverts `direction_L`."""
    x, y, z = direction
    return float(np.degrees(np.arctan2(y, x)) % 360), float(np.degrees(np.arctan2(-z, np.hypot(x, y))))


def L_from_C0(reference_L: F64, *, north_up: bool = False) -> F64:
    """Return the axes of C0 in L as columns: z at the reference, y along the projection of L's down (0, 0, 1).

    Where the reference is vertical, the projection vanishes. Then y points south for the nadir and north for the
    zenith, which is the limit of a reference tilted slightly north.

    With `north_up`, y is along the projection of south, (-1, 0, 0). So y changes smoothly where the reference is
    near the nadir. Where the projection vanishes, y is along that of down.
    """
    z = unit(reference_L)
    down = np.array([0.0, 0.0, 1.0])
    candidates = (np.array([-1.0, 0.0, 0.0]), down) if north_up else (down, np.array([-z[2], 0.0, 0.0]))
    for axis in candidates:
        y = axis - (axis @ z) * z
        if np.linalg.norm(y) > 1e-9:
            break
    y = unit(y)
    return np.column_stack([np.cross(y, z), y, z])


def L_from_C(reference_L: F64, roll_deg: float, pitch_deg: float, yaw_deg: float, *, north_up: bool = False) -> F64:
    """Return the camera axes in L from the reference direction and the three Euler angles (module docstring)."""
    roll, pitch, yaw = np.radians([roll_deg, pitch_deg, yaw_deg])
    return L_from_C0(reference_L, north_up=north_up) @ rx(roll) @ ry(pitch) @ rz(yaw)


def roll_pitch_yaw_deg(reference_L: F64, L_from_C_: F64) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of camera axes in L, pitch within ±90°. This inverts `L_from_C`."""
    m = L_from_C0(reference_L).T @ L_from_C_
    pitch = np.arcsin(np.clip(m[0, 2], -1, 1))
    roll, yaw = np.arctan2(-m[1, 2], m[2, 2]), np.arctan2(-m[0, 1], m[0, 0])
    return float(np.degrees(roll)), float(np.degrees(pitch)), float(np.degrees(yaw))


def boresight_angle_deg(roll_deg: F64 | float, pitch_deg: F64 | float) -> F64:
    """Return the angle between boresight and reference direction.

    Rx(ψ)·Ry(θ)·z has the z component cos ψ cos θ.
    """
    return np.degrees(np.arccos(np.clip(np.cos(np.radians(roll_deg)) * np.cos(np.radians(pitch_deg)), -1, 1)))


def matrix_of(w: float, x: float, y: float, z: float) -> F64:
    """Return the rotation matrix of a unit quaternion, float64[3, 3]."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(matrix: F64) -> F64:
    """Return the unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix, float64[4]."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(matrix).as_quat(canonical=True)
    return np.array([w, x, y, z])


def minimal_rotation(source: F64, target: F64) -> F64:
    """Return the matrix of the smallest rotation that takes unit vector `source` to unit vector `target`."""
    both = source + target
    if np.linalg.norm(both) < 1e-8:  # opposite vectors: half a turn about any perpendicular axis
        axis = unit(np.cross(source, np.eye(3)[np.argmin(np.abs(source))]))
        return 2 * np.outer(axis, axis) - np.eye(3)
    # Two half turns, first about the source, then about the bisector, stay orthonormal to rounding at any angle.
    half = unit(both)
    return (2 * np.outer(half, half) - np.eye(3)) @ (2 * np.outer(source, source) - np.eye(3))


@dataclass(frozen=True, kw_only=True)
class Orbit:
    """Describe a two-body heliocentric orbit, referred to the ecliptic and equinox of J2000.

    Angles are in degrees, times are TDB Julian dates. An `eccentricity` below 1 is an ellipse, 1 a parabola, above
    1 a hyperbola. `mean_motion_deg_day` is the rate of the mean anomaly of an ellipse or a hyperbola; with None it
    follows from Kepler's third law, k |q / (1 - e)|^-3/2. A parabola has no mean anomaly, so it ignores the value.
    """

    eccentricity: float
    perihelion_au: float
    inclination_deg: float
    node_deg: float
    argument_deg: float
    perihelion_jd: float
    mean_motion_deg_day: float | None = None

    def position_J_au(self, julian_date: float) -> F64:
        """Return the heliocentric position in ICRF axes, au, float64[3]."""
        node, inclination, argument = np.radians([self.node_deg, self.inclination_deg, self.argument_deg])
        plane = np.array([*self._in_plane_au(julian_date - self.perihelion_jd), 0.0])
        return rx(np.radians(OBLIQUITY_DEG)) @ rz(node) @ rx(inclination) @ rz(argument) @ plane

    def _in_plane_au(self, days: float) -> tuple[float, float]:
        """Return the position in the orbital plane: x towards perihelion, y along the motion at perihelion, au.

        Kepler's equation is solved in universal variables (Bate, Mueller and White 1971, Fundamentals of
        Astrodynamics, chapter 4), with the time t counted from perihelion: k t = q χ + e χ³ S(α χ²), where
        α = (1 - e) / q. The equation has no singularity at e = 1. It loses no digits near e = 1, because all its
        terms are positive. Its right side rises and is convex up to half a period, so Newton's steps from above
        the root descend to the root and cannot leave the bracket.
        """
        e, q = self.eccentricity, self.perihelion_au
        alpha = (1 - e) / q
        gauss = float(np.radians(GAUSS_DEG_DAY))
        if self.mean_motion_deg_day is not None and alpha:
            gauss = float(np.radians(self.mean_motion_deg_day)) * abs(alpha) ** -1.5
        half = np.pi / (gauss * alpha**1.5) if alpha > 0 else np.inf
        if abs(days) > half:  # only then: added to 10¹⁵ days, a date would lose its hours
            days = float((days + half) % (2 * half) - half)
        kt = gauss * abs(days)
        # The first χ lies above the root, since S is at least 1/6 on open orbits and 1/π² within half a period, and
        # a hyperbola's e sinh H - H is at least (e - 1) sinh H.
        chi = min(kt / q, np.cbrt((np.pi**2 if alpha > 0 else 6.0) * kt / max(e, 1e-300)))
        if alpha > 0:
            chi = min(chi, np.pi * alpha**-0.5)
        elif alpha < 0:
            chi = min(chi, float(np.arcsinh(kt * (-alpha) ** 0.5 / q)) * (-alpha) ** -0.5)
        for _ in range(100):
            c, s = _stumpff(alpha * chi * chi)
            step = (chi * (q + e * chi * chi * s) - kt) / (q + e * chi * chi * c)
            chi -= step
            if step <= 1e-15 * chi:  # at the root, rounding makes steps of either sign
                break
        c, s = _stumpff(alpha * chi * chi)
        y = float(np.sqrt(q * (1 + e))) * chi * (1 - alpha * chi * chi * s)
        return q - chi * chi * c, float(np.copysign(y, days))


def _stumpff(z: float) -> tuple[float, float]:
    """Return Stumpff's C(z) = (1 - cos √z) / z and S(z) = (√z - sin √z) / √z³, continued to z <= 0."""
    root = np.sqrt(abs(z))
    if abs(z) < 1:  # the closed forms lose digits here, the series do not
        terms = (-z) ** np.arange(11)
        return float(terms @ _STUMPFF_C), float(terms @ _STUMPFF_S)
    if z > 0:
        return float(2 * np.sin(root / 2) ** 2 / z), float((root - np.sin(root)) / root**3)
    return float(-2 * np.sinh(root / 2) ** 2 / z), float((np.sinh(root) - root) / root**3)


# 67P/Churyumov-Gerasimenko, JPL K213/6, epoch JD 2457305.5 TDB; valid for ±1.5 years around it.
ORBIT_67P = Orbit(
    eccentricity=0.6409081306555051,
    perihelion_au=1.243265641416762,
    inclination_deg=7.040294906760007,
    node_deg=50.13557380441372,
    argument_deg=12.79824973415729,
    perihelion_jd=2457247.5886578634,
    mean_motion_deg_day=0.152991229,
)


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """Describe a rotation about a fixed pole (ICRF).

    The angle of the prime meridian d days after J2000 is W0 + W1 d + W2 d², as in a SPICE PCK: `prime_meridian_deg`
    is W0, `period_h` gives W1 = 24 · 360 / period, and `prime_meridian_deg_day2` is W2, half the acceleration.
    """

    pole_ra_deg: float
    pole_dec_deg: float
    prime_meridian_deg: float
    period_h: float
    prime_meridian_deg_day2: float = 0.0

    def J_from_T(self, julian_date: float) -> F64:
        """Return Rz(90° + α) · Rx(90° − δ) · Rz(W), which takes body-fixed vectors to ICRF axes."""
        days = julian_date - J2000_JD
        w = self.prime_meridian_deg + 360.0 * 24.0 / self.period_h * days + self.prime_meridian_deg_day2 * days**2
        return (
            rz(np.radians(90 + self.pole_ra_deg)) @ rx(np.radians(90 - self.pole_dec_deg)) @ rz(np.radians(w % 360))
        )


def T_from_J_commanded(T_from_J: F64, sun_J: F64, sun_T: F64) -> F64:
    """Return the target's attitude that puts the Sun (unit `sun_J` in J) at `sun_T` in T.

    The ephemeris fixes the Sun's direction in J, so the target is turned to put the Sun at a direction commanded
    in L. Of all such attitudes, the function returns the nearest to the target's own (`T_from_J`).
    """
    return minimal_rotation(unit(T_from_J @ sun_J), unit(sun_T)) @ T_from_J
