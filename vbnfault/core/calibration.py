"""Map directions to pixels by a camera's calibration: OpenCV's models, and Brown and Conrady's in either sense.

Pixel positions count from the corner of the image's first pixel, so that pixel centres lie at +0.5. OpenCV, ROS and
Kalibr count from the centre of the first pixel: their principal points are 0.5 smaller (`of_centres`).

With slopes q = (x/z, y/z) of a direction in C, the model ``opencv`` is that of `cv2.projectPoints`,

    p = q (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
        + (2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴,  p1 (r² + 2 y²) + 2 p2 x y + s3 r² + s4 r⁴),

followed by the homography of a sensor that is tilted by τx and τy. The model ``undistorting`` has the same formula
with the roles exchanged: q is where the image lies, and p are the slopes (Brown 1966, Photogrammetric Engineering
32, 444, and most of photogrammetry). The model ``fisheye`` is that of `cv2.fisheye.projectPoints`, with the angle θ
from the boresight,

    |p| = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)        (Kannala & Brandt 2006, IEEE TPAMI 28, 1335).

Pixels are x = fx p_x + skew p_y + cx and y = fy p_y + cy.

Each polynomial holds up to a radius `end`, before which it neither folds nor has a pole. Beyond, it continues
linearly, so that nothing from far outside the frame is projected into it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, shown

F64 = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

# Names of the coefficients of each model, in OpenCV's order.
_PLANE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "opencv": _PLANE,
    "undistorting": _PLANE[:12],
    "fisheye": ("k1", "k2", "k3", "k4"),
}
# Numbers of coefficients that OpenCV takes, and that are stored.
_LENGTHS = {"opencv": (8, 12, 14), "undistorting": (12,), "fisheye": (4,)}

# Limits of the numbers, in px and rad. A telescope of 0.1° may have coefficients of 1e15.
_LARGEST = 1e30
LIMITS = {
    **dict.fromkeys(_PLANE, (-_LARGEST, _LARGEST)),
    **dict.fromkeys(("fx", "fy"), (1e-3, 1e9)),
    **dict.fromkeys(("cx", "cy", "skew"), (-1e9, 1e9)),
    **dict.fromkeys(("tau_x", "tau_y"), (-1.5, 1.5)),
    "circle_deg": (0.001, 360.0),
}
EXACT = 1e-10  # largest error of an inversion, in focal lengths
_STEPS = 60
_AT_ONCE = 1 << 14  # positions that are inverted together, so that their arrays stay in the processor's cache
_TABLE = 1025  # nodes of the first guess of an inversion
# The polynomial is used up to this part of its fold: at the fold itself the image has no size.
_BEFORE_FOLD = 0.9999
_FARTHEST_SLOPE = 1e3  # of the models on a plane
_AROUND = 64  # azimuths, and radii, at which a model with tangential terms is checked
_LEAST_SLOPE_Z = 1e-3
_BORDER = 65  # positions along each side of the frame


class SizeMissing(InputError):
    """Report that a file of OpenCV does not state the size of the calibrated image."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Hold the calibration of a camera, and map between unit directions in C and pixels.

    Attributes
    ----------
    model
        "opencv", "fisheye" or "undistorting".
    width_px, height_px
        Size of the calibrated image.
    fx, fy, cx, cy
        Focal lengths and principal point in px; pixel centres at +0.5.
    coefficients
        Those of `COEFFICIENTS`, in this order. Missing ones are 0.
    skew
        In px: by how much a step of one focal length down moves to the right.
    circle_deg
        Full angle of the image circle, beyond which the frame is dark; None: the whole frame has light.

    Raises
    ------
    InputError
        A value is not finite or out of its range, or the model is unknown.
    """

    model: str = "opencv"
    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()
    skew: float = 0.0
    circle_deg: float | None = None

    def __post_init__(self) -> None:
        names = COEFFICIENTS.get(self.model)
        if names is None:
            raise InputError(f"model = {shown(self.model)}: must be one of {', '.join(COEFFICIENTS)}")
        if len(self.coefficients) > len(names):
            raise InputError(f"coefficients: the model {self.model} has {len(names)}, not {len(self.coefficients)}")
        full = tuple(float(k) for k in self.coefficients) + (0.0,) * (len(names) - len(self.coefficients))
        object.__setattr__(self, "coefficients", full)
        for name in ("fx", "fy", "cx", "cy", "skew"):
            object.__setattr__(self, name, float(getattr(self, name)))
        for name, size in (("width_px", self.width_px), ("height_px", self.height_px)):
            if size < 1:
                raise InputError(f"{name} = {size}: must be at least 1")
        values = {"cx": self.cx, "cy": self.cy, "skew": self.skew, **dict(zip(names, full, strict=True))}
        values |= {} if self.circle_deg is None else {"circle_deg": float(self.circle_deg)}
        for name, value in {"fx": self.fx, "fy": self.fy, **values}.items():
            low, high = LIMITS[name]
            if not low <= value <= high:  # NaN is neither
                raise InputError(f"{name} = {value:g}: must be from {low:g} to {high:g}")

    @classmethod
    def of_centres(cls, *, cx: float, cy: float, **fields: Any) -> Calibration:
        """Return the calibration whose principal point counts from the centre of the first pixel, as OpenCV's."""
        return cls(cx=float(cx) + 0.5, cy=float(cy) + 0.5, **fields)

    @classmethod
    def read(
        cls, path: str | Path, *, camera: str = "", model: str = "", size_px: tuple[int, int] | None = None
    ) -> Calibration:
        """Return the calibration of a file of ROS, Kalibr, OpenCV or COLMAP.

        Parameters
        ----------
        path
            The file.
        camera
            Which camera of a file of several, such as "cam1".
        model
            The model of an OpenCV file that does not state it; default: "opencv".
        size_px
            Width and height of the calibrated image, for an OpenCV file that does not state them.

        Raises
        ------
        InputError
            The file is missing, of another kind, or incomplete; the message names file and key.
        """
        from .files.calibrations import read_calibration

        return read_calibration(path, camera=camera, model=model, size_px=size_px)

    # --- what it is

    @property
    def intrinsics(self) -> F64:
        """Return fx, fy, cx, cy in px, float64[4], pixel centres at +0.5."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def opencv_matrix(self) -> F64:
        """Return OpenCV's camera matrix, float64[3, 3], pixel centres at integers."""
        return np.array([[self.fx, self.skew, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1]])

    @property
    def focal_length_px(self) -> float:
        """Return the geometric mean of fx and fy."""
        return float(np.sqrt(self.fx * self.fy))

    @property
    def stored_coefficients(self) -> dict[str, float]:
        """Return the coefficients by name, as many as OpenCV needs to be told: 4 of a fisheye, else 8, 12 or 14."""
        last = max((i + 1 for i, k in enumerate(self.coefficients) if k), default=0)
        count = next(n for n in _LENGTHS[self.model] if n >= last)
        return dict(zip(COEFFICIENTS[self.model][:count], self.coefficients[:count], strict=True))

    @property
    def foreshortens(self) -> bool:
        """Return whether the pupil is a flat hole, and so admits cos θ of the light; that of a fisheye turns."""
        return self.model != "fisheye"

    @property
    def least_z(self) -> float:
        """Return the least z of a unit direction that has a pixel, behind the camera only in the image circle."""
        if self.foreshortens:
            return _LEAST_SLOPE_Z
        circle = np.pi if self.circle_deg is None else max(np.radians(self.circle_deg / 2), np.pi / 2)
        return float(np.cos(min(self._curve.end, np.pi - 1e-3, circle)))

    @cached_property
    def valid_to_deg(self) -> float:
        """Return the angle from the boresight up to which the polynomial holds, or that of the image circle."""
        return min(self._holds_to_deg, np.inf if self.circle_deg is None else self.circle_deg / 2)

    @cached_property
    def _holds_to_deg(self) -> float:
        """Return the angle from the boresight up to which the polynomial itself holds."""
        if self.model == "fisheye":
            return float(np.degrees(min(self._curve.end, np.pi)))
        turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
        rim = self._curve.end * np.column_stack([np.cos(turn), np.sin(turn)])
        slopes = self._curve.value(rim) if self.model == "undistorting" else rim
        return float(np.degrees(np.arctan(np.hypot(*slopes.T).min())))

    @cached_property
    def field_deg(self) -> float:
        """Return the largest angle from the boresight in the lit frame."""
        z = self.directions_of(self._border_px())[..., 2]
        angle_deg = float(np.degrees(np.arccos(np.clip(z.min(), -1, 1))))
        return angle_deg if self.circle_deg is None else min(angle_deg, self.circle_deg / 2)

    @cached_property
    def fov_deg(self) -> float:
        """Return the angle between the directions at the middles of the left and the right side of the frame.

        It is at most that of the image circle.
        """
        ends = self.directions_of([[0, self.height_px / 2], [self.width_px, self.height_px / 2]])
        left, right = np.degrees(np.arctan2(np.abs(ends[:, 0]), ends[:, 2])) * np.sign(ends[:, 0])
        return float(min(right - left, np.inf if self.circle_deg is None else self.circle_deg))

    # --- directions and pixels

    def pixel_of(self, directions: ArrayLike) -> F64:
        """Return pixel positions x, y, float64[..., 2], of vectors in C of any length, float64[..., 3].

        NaN where a model on a plane has no pixel, behind the camera. Beyond `valid_to_deg` the polynomial continues
        linearly.
        """
        d = np.asarray(directions, dtype=np.float64)
        if self.model == "fisheye":
            across = np.hypot(d[..., 0], d[..., 1])
            theta = np.arctan2(across, d[..., 2])
            p = d[..., :2] * _ratio(self._curve.value(theta), across)[..., None]
        else:
            ahead = d[..., 2:] > 0
            slopes = d[..., :2] / np.where(ahead, d[..., 2:], np.nan)
            p = self._curve.inverse(slopes) if self.model == "undistorting" else self._curve.value(slopes)
            p = _by(self._tilt, p)
        return np.stack(
            [self.fx * p[..., 0] + self.skew * p[..., 1] + self.cx, self.fy * p[..., 1] + self.cy], axis=-1
        )

    def directions_of(self, xy_px: ArrayLike) -> F64:
        """Return the unit directions in C, float64[..., 3], that pixel positions float64[..., 2] see.

        The pixel of each lies within 1e-10 focal lengths of the position; NaN where there is none.
        """
        xy = np.asarray(xy_px, dtype=np.float64)
        flat = xy.reshape(-1, 2)
        out = np.empty((len(flat), 3))
        for start in range(0, len(flat), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            out[part] = self._directions(self._on_plane(flat[part]))
        return out.reshape(*xy.shape[:-1], 3)

    def _on_plane(self, xy: F64) -> F64:
        """Return pixel positions in focal lengths from the principal point, float64[..., 2]."""
        down = (xy[..., 1] - self.cy) / self.fy
        return np.stack([(xy[..., 0] - self.cx - self.skew * down) / self.fx, down], axis=-1)

    def _directions(self, p: F64) -> F64:
        """Return the unit directions of positions on the plane, float64[n, 3]."""
        if self.model == "fisheye":
            height = np.hypot(p[..., 0], p[..., 1])
            theta = self._curve.inverse(height)
            # beyond an image circle, any direction does
            theta = np.where(theta <= np.pi, theta, np.nan if self.circle_deg is None else np.pi)
            across = p * _ratio(np.sin(theta), height)[..., None]
            return np.concatenate([across, np.cos(theta)[..., None]], axis=-1)
        p = _by(np.linalg.inv(self._tilt), p)
        slopes = self._curve.value(p) if self.model == "undistorting" else self._curve.inverse(p)
        if self.circle_deg is not None:  # beyond an image circle, any direction does
            slopes = np.where(np.isfinite(slopes), slopes, _FARTHEST_SLOPE)
        vectors = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)
        return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))

    def directions_at(self, x_px: Floats, y_px: Floats) -> F64:
        """Return unit directions, float64[y, x, 3], at the positions of a grid."""
        return self.directions_of(np.stack(np.meshgrid(x_px, y_px), axis=-1))

    def solid_angle_sr(self, directions: ArrayLike) -> F64:
        """Return the solid angle per pixel at directions, float64[...] in sr.

        Where the pupil foreshortens, it is the projected one, cos θ dω.
        """
        d = np.asarray(directions, dtype=np.float64)
        length = np.linalg.norm(d, axis=-1)
        area = self.fx * self.fy
        if self.model == "fisheye":
            theta = np.maximum(np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2]), 1e-9)
            return np.asarray(np.sin(theta) / (self._curve.value(theta) * self._curve.rise(theta) * area))
        cosine = d[..., 2] / length
        slopes = d[..., :2] / d[..., 2:]
        if self.model == "undistorting":
            stretch = 1 / _determinant(self._curve.jacobian(self._curve.inverse(slopes)))
        else:
            p = self._curve.value(slopes)
            w = p @ self._tilt[2, :2] + self._tilt[2, 2]
            stretch = _determinant(self._curve.jacobian(slopes)) * np.linalg.det(self._tilt) / w**3
        return np.asarray(cosine**4 / (area * stretch))

    # --- another frame

    def scaled_to(self, width_px: int, height_px: int) -> Calibration:
        """Return the calibration of the same field with other pixels. Raises InputError for another shape."""
        across, down = width_px / self.width_px, height_px / self.height_px
        # rounded numbers of columns and of rows may each be off by a half
        if abs(self.height_px * across - height_px) > 0.5 * (1 + self.height_px / self.width_px) + 1e-9:
            raise InputError(
                f"calibrates an image of {self.width_px} x {self.height_px} px, which cannot be scaled to the "
                f"camera's {width_px} x {height_px} px: they have different shapes"
            )
        return self.scaled_by(across, down)

    def scaled_by(self, across: float, down: float) -> Calibration:
        """Return the calibration with so many times the columns and rows, rounded up."""
        return replace(
            self,
            width_px=int(np.ceil(self.width_px * across - 1e-6)),
            height_px=int(np.ceil(self.height_px * down - 1e-6)),
            fx=self.fx * across,
            fy=self.fy * down,
            cx=self.cx * across,
            cy=self.cy * down,
            skew=self.skew * across,
        )

    def is_lit(self, directions: F64) -> NDArray[np.bool_]:
        """Return which unit directions, float64[..., 3], lie in the image circle."""
        if self.circle_deg is None:
            return np.ones(directions.shape[:-1], dtype=bool)
        return np.asarray(directions[..., 2] >= np.cos(np.radians(self.circle_deg / 2)))

    def checked(self) -> Calibration:
        """Return the calibration itself. Raises InputError if its polynomial folds back inside the lit frame."""
        border, reached = self._border_px(), self._reached
        edge, end = border, "its corner"
        if self.circle_deg is not None:
            turn = np.linspace(0, 2 * np.pi, 4 * _BORDER)
            angle = np.full(len(turn), np.radians(self.circle_deg / 2))
            rim = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)
            around = self.pixel_of(rim)
            if not np.isfinite(around).all():
                raise InputError(f"circle_deg = {self.circle_deg:g}: must be below 180 for the model {self.model}")
            if self._heights(around).max() < self._heights(border).max():
                inside = ((around >= 0) & (around <= (self.width_px, self.height_px))).all(axis=-1)
                border, edge, end = around[inside], around, "the rim of its image circle"
        if not self._holds_at(edge).all():
            turns = "reaches 180 deg from the boresight" if self._holds_to_deg >= 180 else "folds back"
            raise InputError(
                f"the {self.model} polynomial {turns} {reached * self.focal_length_px:.1f} px from the "
                f"principal point, which is inside the frame: {end} lies "
                f"{self._heights(edge).max() * self.focal_length_px:.1f} px away; give a calibration that holds "
                "up to there, or circle_deg, beyond which the frame is dark"
            )
        if not len(border):
            return self
        again = self.pixel_of(self.directions_of(border))
        off = np.abs(again - border)
        if not off.max() <= 1e-6:
            worst = self._heights(border)[np.argmax(np.where(np.isnan(off), np.inf, off).max(axis=-1))]
            raise InputError(
                f"the {self.model} polynomial has no inverse {worst * self.focal_length_px:.1f} px from the "
                "principal point, inside the frame; give a calibration that holds up to there"
            )
        return self

    def _border_px(self) -> F64:
        """Return positions along the frame's border, float64[n, 2]."""
        part = np.linspace(0, 1, _BORDER)
        sides = [np.column_stack(pair) for k in (0.0, 1.0) for pair in ((part, 0 * part + k), (0 * part + k, part))]
        return np.concatenate(sides) * (self.width_px, self.height_px)

    def _heights(self, xy: F64) -> F64:
        """Return distances from the principal point in focal lengths, float64[n], before the sensor's tilt."""
        p = self._on_plane(xy)
        p = p if self.model == "fisheye" else _by(np.linalg.inv(self._tilt), p)
        return np.hypot(p[..., 0], p[..., 1])

    def _holds_at(self, xy: F64) -> NDArray[np.bool_]:
        """Return whether the polynomial holds at positions float64[n, 2], bool[n].

        With tangential terms it folds at another distance on each side of the principal point.
        """
        near = np.asarray(self._heights(xy) < self._reached)
        if self.model != "opencv":
            return near
        q = self._curve.inverse(_by(np.linalg.inv(self._tilt), self._on_plane(xy)))
        radius = np.hypot(q[..., 0], q[..., 1])
        return np.where(np.isnan(radius), near, radius < self._curve.end)

    @cached_property
    def _reached(self) -> float:
        """Return the distance from the principal point, in focal lengths, up to which the polynomial holds."""
        curve = self._curve
        if isinstance(curve, _Angle):
            return float(curve.value(np.array(min(curve.end, np.pi))))
        return curve.end if self.model == "undistorting" else curve.reached

    @property
    def _curve(self) -> Any:
        """Return the polynomial: an `_Angle` of the fisheye, else a `_PlaneCurve`."""
        return _curve(self.model, self.coefficients)

    @cached_property
    def _tilt(self) -> F64:
        """Return the homography of a tilted sensor, float64[3, 3], as OpenCV defines τx and τy."""
        if self.model != "opencv" or not any(self.coefficients[12:]):
            return np.eye(3)
        (cos_x, cos_y), (sin_x, sin_y) = np.cos(self.coefficients[12:]), np.sin(self.coefficients[12:])
        about_x = np.array([[1, 0, 0], [0, cos_x, sin_x], [0, -sin_x, cos_x]])
        about_y = np.array([[cos_y, 0, -sin_y], [0, 1, 0], [sin_y, 0, cos_y]])
        turned = about_y @ about_x
        onto = np.array([[turned[2, 2], 0, -turned[0, 2]], [0, turned[2, 2], -turned[1, 2]], [0, 0, 1]])
        return np.asarray(onto @ turned)


def _by(homography: Floats, p: F64) -> F64:
    """Return points float64[..., 2] mapped by a homography."""
    if (homography == np.eye(3)).all():
        return p
    q = p @ homography[:, :2].T + homography[:, 2]
    return np.asarray(q[..., :2] / q[..., 2:])


def _ratio(value: F64, over: F64) -> F64:
    """Return value / over, and 1 where `over` is 0: near the axis both are equal."""
    return np.where(over > 0, value / np.where(over > 0, over, 1), 1.0)


def _determinant(jacobian: F64) -> F64:
    """Return the determinants of matrices float64[..., 2, 2]."""
    return np.asarray(jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0])


def _first_root(polynomial: ArrayLike) -> float:
    """Return the square root of the least positive root of a polynomial of squares, ascending; inf without one."""
    kept = np.trim_zeros(np.asarray(polynomial, dtype=np.float64), "b")
    roots = np.roots(kept[::-1]) if len(kept) > 1 else np.zeros(0)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots.real), 1e-300)) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else np.inf


@dataclass(frozen=True, eq=False)
class _Angle:
    """Map the angle θ to the distance θ (1 + Σ k_i θ²ⁱ), and back."""

    k: tuple[float, ...]

    @cached_property
    def end(self) -> float:
        """Return the angle up to which the polynomial is used."""
        fold = _first_root(np.array([1.0, *((2 * i + 1) * k for i, k in enumerate(self.k, 1))]))
        return min(_BEFORE_FOLD * fold, np.pi)

    def value(self, theta: F64) -> F64:
        """Return distances in focal lengths."""
        within = np.minimum(theta, self.end)
        return np.asarray(within * self._sum(within, [1.0] * 5) + (theta - within) * self.rise(within))

    def rise(self, theta: F64) -> F64:
        """Return the derivative of `value`."""
        return self._sum(np.minimum(theta, self.end), [1.0, 3, 5, 7, 9])

    def _sum(self, theta: F64, factors: list[float]) -> F64:
        """Return Σ factor_i k_i θ²ⁱ with k_0 = 1."""
        square, total = np.asarray(theta) ** 2, np.zeros_like(theta)
        for factor, k in reversed(list(zip(factors, (1.0, *self.k), strict=True))):
            total = total * square + factor * k
        return np.asarray(total)

    def inverse(self, height: F64) -> F64:
        """Return angles, by Newton's method from a table."""
        nodes = np.linspace(0, self.end, _TABLE)
        theta = np.interp(height, self.value(nodes), nodes)
        for _ in range(_STEPS):
            step = (self.value(theta) - height) / self.rise(theta)
            theta = np.maximum(theta - step, 0)
            if not (np.abs(step) > EXACT / 100).any():
                break
        return np.where(np.abs(self.value(theta) - height) <= EXACT, theta, np.nan)


@dataclass(frozen=True, eq=False)
class _PlaneCurve:
    """Map points q of a plane to p by OpenCV's polynomial without tilt, and back."""

    k: tuple[float, ...]

    @cached_property
    def end(self) -> float:
        """Return the radius up to which the polynomial is used."""
        k1, k2, _, _, k3, k4, k5, k6 = self.k[:8]
        above, below = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
        square = np.polynomial.Polynomial([0, 2])
        folds = above * below + square * (above.deriv() * below - above * below.deriv())
        end = min(_BEFORE_FOLD * min(_first_root(folds.coef), _first_root(below.coef)), _FARTHEST_SLOPE)
        if not (any(self.k[2:4]) or any(self.k[8:12])):
            return end
        # tangential terms may fold earlier, on one side
        turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
        around = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        radius = end * np.linspace(0, 1, _AROUND + 1)[1:] ** 3  # cubic, since 1000 focal lengths are a far end
        points = radius[:, None, None] * around
        jacobian = self._jacobian(points)
        outward = np.einsum("rai,raij,raj->ra", around[None].repeat(len(radius), 0), jacobian, points) > 0
        good = ((_determinant(jacobian) > 0) & outward).all(axis=1)
        return float(end if good.all() else (radius[np.argmin(good) - 1] if good[0] else radius[0] / 2))

    @cached_property
    def reached(self) -> float:
        """Return the least distance of the image of the circle of radius `end`."""
        turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
        rim = self._polynomial(self.end * np.column_stack([np.cos(turn), np.sin(turn)]))
        return float(np.hypot(*rim.T).min())

    def value(self, q: F64) -> F64:
        """Return p, float64[..., 2]."""
        radius = np.hypot(q[..., 0], q[..., 1])
        if not (radius > self.end).any():
            return self._polynomial(q)
        inner = q * np.minimum(1, self.end / np.maximum(radius, 1e-300))[..., None]
        return self._polynomial(inner) + (self._jacobian(inner) @ (q - inner)[..., None])[..., 0]

    def jacobian(self, q: F64) -> F64:
        """Return dp/dq, float64[..., 2, 2]; beyond `end` that at `end`."""
        radius = np.hypot(q[..., 0], q[..., 1])
        return self._jacobian(q * np.minimum(1, self.end / np.maximum(radius, 1e-300))[..., None])

    def inverse(self, p: F64) -> F64:
        """Return q, float64[..., 2], by Newton's method from a table of the radial part."""
        if not any(self.k):
            return p
        height = np.hypot(p[..., 0], p[..., 1])
        most = float(np.max(height, initial=0, where=np.isfinite(height)))
        last = min(self.end, 3 * most) if most > 0 else self.end
        nodes = np.linspace(0, last, _TABLE)
        radial = nodes * self._over(nodes * nodes)[0]
        beyond = np.maximum(height - radial[-1], 0)
        q = p * _ratio(np.interp(height, radial, nodes) + beyond, height)[..., None]
        for _ in range(_STEPS):
            off = self.value(q) - p
            if not (np.abs(off) > EXACT / 100).any():
                break
            j = self.jacobian(q)
            det = _determinant(j)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = np.stack(
                    [
                        (off[..., 0] * j[..., 1, 1] - off[..., 1] * j[..., 0, 1]) / det,
                        (off[..., 1] * j[..., 0, 0] - off[..., 0] * j[..., 1, 0]) / det,
                    ],
                    axis=-1,
                )
            q = q - step
        exact = (np.abs(self.value(q) - p) <= EXACT).all(axis=-1, keepdims=True)
        return np.where(exact, q, np.nan)

    def _over(self, square: F64) -> tuple[F64, F64]:
        """Return the radial factor and its derivative by r²."""
        k1, k2, _, _, k3, k4, k5, k6 = self.k[:8]
        above = 1 + square * (k1 + square * (k2 + square * k3))
        below = 1 + square * (k4 + square * (k5 + square * k6))
        above_rise = k1 + square * (2 * k2 + 3 * square * k3)
        below_rise = k4 + square * (2 * k5 + 3 * square * k6)
        return above / below, (above_rise * below - above * below_rise) / below**2

    def _polynomial(self, q: F64) -> F64:
        """Return p within `end`."""
        x, y = q[..., 0], q[..., 1]
        p1, p2 = self.k[2:4]
        s1, s2, s3, s4 = self.k[8:12]
        square = x * x + y * y
        radial = self._over(square)[0]
        across = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
        down = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square)
        return np.stack([across, down], axis=-1)

    def _jacobian(self, q: F64) -> F64:
        """Return dp/dq within `end`."""
        x, y = q[..., 0], q[..., 1]
        p1, p2 = self.k[2:4]
        s1, s2, s3, s4 = self.k[8:12]
        square = x * x + y * y
        radial, rise = self._over(square)
        prism_x, prism_y = s1 + 2 * s2 * square, s3 + 2 * s4 * square  # derivatives by r²
        both = 2 * x * y * rise + 2 * p1 * x + 2 * p2 * y
        rows = [
            [radial + 2 * x * x * rise + 2 * p1 * y + 6 * p2 * x + 2 * x * prism_x, both + 2 * y * prism_x],
            [both + 2 * x * prism_y, radial + 2 * y * y * rise + 6 * p1 * y + 2 * p2 * x + 2 * y * prism_y],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@lru_cache(maxsize=16)
def _curve(model: str, coefficients: tuple[float, ...]) -> _Angle | _PlaneCurve:
    """Return the polynomial of a model; calibrations of equal coefficients share it."""
    return _Angle(coefficients) if model == "fisheye" else _PlaneCurve(coefficients[:12])
