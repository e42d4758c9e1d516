"""OpenCV's model of radial distortion, fitted to the image heights of a lens.

With t the tangent of the field angle, the distance from the axis in focal lengths is

    d(t) = t (1 + k1 t² + k2 t⁴ + k3 t⁶) / (1 + k4 t² + k5 t⁴ + k6 t⁶),

the rational model of `cv2.projectPoints` (Claus and Fitzgibbon 2005, CVPR, 213) with its coefficients in the order
k1, k2, p1, p2, k3, k4, k5, k6. Lenses here have rotational symmetry: p1 = p2 = 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

# A denominator of lower degree is kept where it leaves no more than this: its coefficients are better determined.
_ENOUGH_PX = 0.005
# The denominator stays above this, up to that many times the widest slope: a pole near the field would throw points
# just outside the frame across it.
_LEAST_DENOMINATOR = 0.1
_BEYOND = 1.1
_STEPS = 12


def distances(coefficients: F64, slope: F64) -> F64:
    """Return distances from the axis in focal lengths, float64 like `slope`, of tangents of field angles.

    `coefficients` float64[8] as OpenCV orders them.
    """
    k1, k2, _, _, k3, *below = coefficients
    square = slope * slope
    return np.asarray(slope * _polynomial((k1, k2, k3), square) / _polynomial(below, square))


def fitted(slope: F64, distance: F64, focal_length_px: float) -> F64:
    """Return the coefficients, float64[8], that come nearest to the distances of the slopes given.

    `slope`, `distance` float64[n], n at least 8, rising, above 0: tangents of field angles, and distances from the
    axis in focal lengths.
    """
    found = []
    for degree in range(4):
        coefficients = _of_degree(slope, distance, degree)
        if coefficients is None:
            continue
        square = np.linspace(0, (_BEYOND * slope[-1]) ** 2, 257)
        if degree and not _polynomial(coefficients[5:], square).min() >= _LEAST_DENOMINATOR:
            continue
        left = float(np.abs(distances(coefficients, slope) - distance).max()) * focal_length_px
        if left <= _ENOUGH_PX:
            return coefficients
        found.append((left, degree, coefficients))
    return min(found, key=lambda entry: entry[:2])[2]


def _polynomial(coefficients: tuple[float, ...] | list[float] | F64, square: F64) -> F64:
    """1 + Σ c_k squareᵏ."""
    total = np.zeros_like(square)
    for c in coefficients[::-1]:
        total = (total + c) * square
    return np.asarray(1 + total)


def _of_degree(slope: F64, distance: F64, degree: int) -> F64 | None:
    """The least squares of the model with a denominator of that degree in t²; None where it is not determined.

    Linear in the coefficients once it is multiplied by the denominator; the weights take that back, step by step
    (Sanathanan and Koerner 1963, IEEE Trans. Automatic Control 8, 56).
    """
    most = slope[-1]
    powers = (slope[:, None] / most) ** [2, 4, 6]
    columns = np.concatenate([slope[:, None] * powers, -distance[:, None] * powers[:, :degree]], axis=1)
    below = np.ones_like(slope)
    solution = np.zeros(3 + degree)
    for _ in range(_STEPS if degree else 1):
        found = _least_squares(columns / below[:, None], (distance - slope) / below)
        if found is None:
            return None
        solution = found
        below = 1 + (powers[:, :degree] * solution[3:]).sum(axis=1)
        if not np.abs(below).min() > 0:
            return None
    k = np.zeros(6)
    k[: 3 + degree] = solution
    k /= most ** np.array([2, 4, 6, 2, 4, 6])
    return np.array([k[0], k[1], 0.0, 0.0, k[2], *k[3:]])


def _least_squares(columns: F64, right: F64) -> F64 | None:
    """Solve by Gram and Schmidt's factorisation; None where the columns depend on one another.

    Plain sums in one order: a threaded library would not give the same bits on every machine, and stores keep them.
    """
    count = columns.shape[1]
    scale = np.sqrt((columns**2).sum(axis=0))
    basis, upper = columns / scale, np.eye(count)
    for k in range(count):
        for j in [*range(k)] * 2:  # twice: nearly parallel columns lose orthogonality in one pass
            along = (basis[:, j] * basis[:, k]).sum()
            upper[j, k] += along
            basis[:, k] -= along * basis[:, j]
        upper[k, k] = np.sqrt((basis[:, k] ** 2).sum())
        if not upper[k, k] > 1e-12:
            return None
        basis[:, k] /= upper[k, k]
    solution = np.zeros(count)
    for k in reversed(range(count)):
        rest = (upper[k, k + 1 :] * solution[k + 1 :]).sum()
        solution[k] = ((basis[:, k] * right).sum() - rest) / upper[k, k]
    return np.asarray(solution / scale)
