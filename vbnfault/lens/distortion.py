"""Fit OpenCV's model of radial distortion to the image heights of a lens.

With t the tangent of the field angle, the distance from the axis in focal lengths is

    d(t) = t (1 + k1 t² + k2 t⁴ + k3 t⁶) / (1 + k4 t² + k5 t⁴ + k6 t⁶),

the rational model of `cv2.projectPoints` (Claus and Fitzgibbon 2005, CVPR, 213). OpenCV orders the coefficients k1,
k2, p1, p2, k3, k4, k5, k6. Lenses here have rotational symmetry: p1 = p2 = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

# Residuals below this count as equal. The lowest degree then wins: its coefficients are better determined.
_ENOUGH_PX = 0.001
# A model that follows all heights of the lens may fold. Then the outermost heights get less weight, until a model
# that does not fold follows the others to this distance.
_FOLLOWED_PX = 0.01
_FOLLOWED = tuple(k / 16 for k in range(16, 7, -1))  # fractions of the angle of the last height
_WEIGHTS = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5)  # of the outermost heights
# Up to _BEYOND times the widest slope the denominator stays above this and distances rise, so that points just
# outside the frame are not projected into it.
_LEAST_DENOMINATOR = 0.1
_BEYOND = 1.1
# Allowed d ln d / d ln t. Below 0 the image folds; from 2 on the iteration t ← d0 / (d(t) / t), by which
# `cv2.undistortPoints` inverts the model, does not converge: its error grows by the factor 1 - d ln d / d ln t.
_EXPONENTS = (0.1, 1.9)
_CHECKED = 513
_STEPS = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class RadialModel:
    """Hold a distortion model that is valid from the axis to the slope `end`.

    `coefficients` is float64[8] in OpenCV's order.
    """

    coefficients: F64
    end: float

    @property
    def valid_to_deg(self) -> float:
        """Return the field angle up to which distances are known to rise; farther light may land in the frame."""
        return float(np.degrees(np.arctan(_BEYOND * self.end)))

    def distance(self, slope: F64) -> F64:
        """Return distances from the axis in focal lengths for tangents of field angles, float64 like `slope`."""
        above, below = self._parts
        square = slope * slope
        return np.asarray(slope * _polynomial(above, square) / _polynomial(below, square))

    def rise(self, slope: F64) -> F64:
        """Return the derivative of `distance`, float64 like `slope`."""
        square = slope * slope
        (n, dn), (d, dd) = ((_polynomial(c, square), _derivative(c, square)) for c in self._parts)
        return np.asarray(n / d + 2 * square * (dn * d - n * dd) / (d * d))

    def reaches(self, distance: float) -> bool:
        """Return whether the model reaches a distance from the axis, in focal lengths, without a pole or a fold.

        It must also be invertible by iteration up to there.
        """
        slope = np.linspace(0, _BEYOND * self.end, _CHECKED)[1:]
        if not _polynomial(self._parts[1], slope * slope).min() >= _LEAST_DENOMINATOR:
            return False
        distances, rise, inside = self.distance(slope), self.rise(slope), slope <= self.end
        exponent = slope[inside] * rise[inside] / distances[inside]
        return bool(
            distances.min() > 0
            and rise.min() > 0
            and _EXPONENTS[0] <= exponent.min() <= exponent.max() <= _EXPONENTS[1]
            and self.distance(np.array(self.end)) >= distance
        )

    @property
    def _parts(self) -> tuple[F64, F64]:
        """Return the coefficients of numerator and denominator."""
        k = self.coefficients
        return k[[0, 1, 4]], k[5:]


def fitted(slope: F64, distance: F64, focal_length_px: float, *, known: int, reach: float) -> RadialModel | None:
    """Return the invertible model that comes nearest to the given distances; None where there is none.

    Parameters
    ----------
    slope, distance
        float64[n], rising, above 0: tangents of field angles, and distances from the axis in focal lengths.
    known
        Number of points, at least 8, that rays through the lens give. The points behind them only suggest how the
        model may continue.
    reach
        Distance that the model must reach, in focal lengths; at most the last of `distance`.
    """
    angle, order = np.arctan(slope), np.arange(len(slope))
    spare = None
    for followed in _FOLLOWED:
        inner = (order < known) & (angle <= followed * angle[known - 1])
        entries = []
        for degree in range(4):
            for weight in _WEIGHTS[: 1 if inner.all() else None]:
                coefficients = _of_degree(slope, distance, degree, np.where(inner, 1.0, weight))
                if coefficients is None:
                    continue
                model = RadialModel(coefficients=coefficients, end=float(slope[-1]))
                if not model.reaches(reach):
                    continue
                off_px = np.abs(model.distance(slope) - distance)[:known] * focal_length_px
                entry = max(float(off_px.max()), _ENOUGH_PX), degree, -weight, model
                if off_px[inner[:known]].max() <= _FOLLOWED_PX:
                    entries.append(entry)
                spare = entry if spare is None else min(spare, entry, key=lambda e: e[:3])
        if entries:
            return min(entries, key=lambda e: e[:3])[3]
    return spare[3] if spare else None


def _polynomial(coefficients: F64, square: F64) -> F64:
    """Return 1 + Σ c_k squareᵏ."""
    total = np.zeros_like(square)
    for c in coefficients[::-1]:
        total = (total + c) * square
    return np.asarray(1 + total)


def _derivative(coefficients: F64, square: F64) -> F64:
    """Return Σ k c_k squareᵏ⁻¹."""
    total = np.zeros_like(square)
    for k, c in reversed(list(enumerate(coefficients, 1))):
        total = total * square + k * c
    return np.asarray(total)


def _of_degree(slope: F64, distance: F64, degree: int, weight: F64) -> F64 | None:
    """Return weighted least-squares coefficients with a denominator of this degree in t²; None if undetermined.

    Multiplied by its denominator, the model is linear in the coefficients. Each iteration divides the weights by
    the last denominator, which undoes the multiplication (Sanathanan and Koerner 1963, IEEE Trans. Automatic
    Control 8, 56).
    """
    most = slope[-1]
    powers = (slope[:, None] / most) ** [2, 4, 6]
    columns = np.concatenate([slope[:, None] * powers, -distance[:, None] * powers[:, :degree]], axis=1)
    below = np.ones_like(slope)
    solution = np.zeros(3 + degree)
    for _ in range(_STEPS if degree else 1):
        coefficients = _least_squares(columns * (weight / below)[:, None], (distance - slope) * weight / below)
        if coefficients is None:
            return None
        solution = coefficients
        below = 1 + (powers[:, :degree] * solution[3:]).sum(axis=1)
        if not np.abs(below).min() > 0:
            return None
    k = np.zeros(6)
    k[: 3 + degree] = solution
    k /= most ** np.array([2, 4, 6, 2, 4, 6])
    return np.array([k[0], k[1], 0.0, 0.0, k[2], *k[3:]])


def _least_squares(columns: F64, right: F64) -> F64 | None:
    """Solve a least-squares problem by Gram-Schmidt factorisation; None where columns depend on one another.

    Sums run in one fixed order, because stores keep the result, and a threaded library would not give the same bits
    on every machine.
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
