"""Reference frames of Gallon et al., appendix A, and the way from a commanded Sun to attitudes.

J international celestial (ICRF axes) · T target body-fixed, origin at the shape's origin · L local-level at a
site: x north, y east, z down along effective gravity · B spacecraft body · C camera: x image right, y image
down, z boresight, coinciding with B · C0: z at the reference direction (the Sun), y along the projection of L's
down.

    L_from_C = L_from_C0 · Rx(ψ) · Ry(θ) · Rz(φ)        roll ψ, pitch θ, yaw φ

Matrices are named TargetFromSource and act on column vectors; float64 throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

J2000_JD = 2451545.0
GAUSS_DEG_DAY = np.degrees(0.01720209895)  # mean motion at 1 au: Gauss's constant
OBLIQUITY_DEG = 23.4392911  # ecliptic → ICRF, IAU 1976 at J2000


def rx(angle_rad: float) -> F64:
    """Active rotation about x, float64[3, 3]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def ry(angle_rad: float) -> F64:
    """Active rotation about y, float64[3, 3]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rz(angle_rad: float) -> F64:
    """Active rotation about z, float64[3, 3]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def unit(vector: F64) -> F64:
    """The vector at length 1."""
    return vector / np.linalg.norm(vector)


def direction_L(azimuth_deg: float, elevation_deg: float) -> F64:
    """Unit direction in L: azimuth from north (x) towards east (y), elevation upwards (-z)."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])


def azimuth_elevation_deg(direction: F64) -> tuple[float, float]:
    """Azimuth in [0, 360) and elevation of a direction in L: the inverse of `direction_L`."""
    x, y, z = direction
    return float(np.degrees(np.arctan2(y, x)) % 360), float(np.degrees(np.arctan2(-z, np.hypot(x, y))))


def L_from_C0(reference_L: F64) -> F64:
    """Axes of C0 in L: z at the reference direction, y along the projection of L's down (0, 0, 1).

    Where the reference is vertical the projection vanishes; y then points south for nadir and north for the
    zenith, which continues the case of a reference tilted slightly north.
    """
    z = unit(reference_L)
    for down in (np.array([0.0, 0.0, 1.0]), np.array([-z[2], 0.0, 0.0])):
        y = down - (down @ z) * z
        if np.linalg.norm(y) > 1e-9:
            break
    y = unit(y)
    return np.column_stack([np.cross(y, z), y, z])


def L_from_C(reference_L: F64, roll_deg: float, pitch_deg: float, yaw_deg: float) -> F64:
    """Camera axes in L from the reference direction and the three Euler angles (module docstring)."""
    roll, pitch, yaw = np.radians([roll_deg, pitch_deg, yaw_deg])
    return L_from_C0(reference_L) @ rx(roll) @ ry(pitch) @ rz(yaw)


def roll_pitch_yaw_deg(reference_L: F64, L_from_C_: F64) -> tuple[float, float, float]:
    """The Euler angles of camera axes in L: the inverse of `L_from_C`, pitch within ±90°."""
    m = L_from_C0(reference_L).T @ L_from_C_
    pitch = np.arcsin(np.clip(m[0, 2], -1, 1))
    roll, yaw = np.arctan2(-m[1, 2], m[2, 2]), np.arctan2(-m[0, 1], m[0, 0])
    return float(np.degrees(roll)), float(np.degrees(pitch)), float(np.degrees(yaw))


def boresight_angle_deg(roll_deg: F64 | float, pitch_deg: F64 | float) -> F64:
    """Angle between boresight and reference direction: Rx(ψ)Ry(θ)·z has the cosine cos ψ cos θ along z."""
    return np.degrees(np.arccos(np.clip(np.cos(np.radians(roll_deg)) * np.cos(np.radians(pitch_deg)), -1, 1)))


def quaternion(matrix: F64) -> F64:
    """Unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix, float64[4]."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(matrix).as_quat(canonical=True)
    return np.array([w, x, y, z])


def minimal_rotation(source: F64, target: F64) -> F64:
    """The rotation matrix by the smallest angle that takes unit vector `source` to `target`."""
    both = source + target
    if np.linalg.norm(both) < 1e-8:  # opposite: half a turn about any axis across
        axis = unit(np.cross(source, np.eye(3)[np.argmin(np.abs(source))]))
        return 2 * np.outer(axis, axis) - np.eye(3)
    # two half turns, about the source and about the bisector: orthonormal to rounding at any angle
    half = unit(both)
    return (2 * np.outer(half, half) - np.eye(3)) @ (2 * np.outer(source, source) - np.eye(3))


@dataclass(frozen=True, kw_only=True)
class Orbit:
    """Two-body heliocentric orbit, ecliptic and equinox J2000. Angles in degrees, times as TDB Julian dates."""

    eccentricity: float
    perihelion_au: float
    inclination_deg: float
    node_deg: float
    argument_deg: float
    perihelion_jd: float
    mean_motion_deg_day: float

    def position_J_au(self, julian_date: float) -> F64:
        """Heliocentric position in ICRF axes, au, float64[3]."""
        e = self.eccentricity
        mean = np.radians(self.mean_motion_deg_day * (julian_date - self.perihelion_jd))
        mean = (mean + np.pi) % (2 * np.pi) - np.pi
        anomaly = mean + e * np.sin(mean)
        for _ in range(50):  # Newton; quadratic, a handful of steps for e < 0.9
            step = (anomaly - e * np.sin(anomaly) - mean) / (1 - e * np.cos(anomaly))
            anomaly -= step
            if abs(step) < 1e-14:
                break
        a = self.perihelion_au / (1 - e)
        plane = np.array([a * (np.cos(anomaly) - e), a * np.sqrt(1 - e * e) * np.sin(anomaly), 0.0])
        node, inclination, argument = np.radians([self.node_deg, self.inclination_deg, self.argument_deg])
        return rx(np.radians(OBLIQUITY_DEG)) @ rz(node) @ rx(inclination) @ rz(argument) @ plane


# 67P/Churyumov-Gerasimenko, JPL K213/6, epoch JD 2457305.5 TDB; good for ±1.5 years around it.
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
    """Uniform rotation about a fixed pole (ICRF), prime meridian W at J2000, degrees and hours."""

    pole_ra_deg: float
    pole_dec_deg: float
    prime_meridian_deg: float
    period_h: float

    def J_from_T(self, julian_date: float) -> F64:
        """Rz(90° + α) · Rx(90° − δ) · Rz(W): body-fixed to ICRF."""
        w = self.prime_meridian_deg + 360.0 * 24.0 / self.period_h * (julian_date - J2000_JD)
        return (
            rz(np.radians(90 + self.pole_ra_deg)) @ rx(np.radians(90 - self.pole_dec_deg)) @ rz(np.radians(w % 360))
        )


def T_from_J_commanded(T_from_J: F64, sun_J: F64, sun_T: F64) -> F64:
    """The target's attitude that puts the Sun (unit `sun_J` in J) at `sun_T` in T.

    The Sun's place in J comes from the ephemeris, so a Sun commanded in L is an attitude of the target; of all
    attitudes that do it, the one nearest to the target's own (`T_from_J`) is taken.
    """
    return minimal_rotation(unit(T_from_J @ sun_J), unit(sun_T)) @ T_from_J
