"""Define the distributions of a study's factors: between the unit interval and a factor's values.

Every design is made in the unit hypercube, so that one design serves all distributions.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, model_validator

from ..core.tables import Table, each_once

_MOST_DEVIATIONS = 1e6
_NODES = 64  # of a quadrature
_TAIL = 8.0  # standard deviations beyond which a normal distribution has no probability in double precision
_Text = Annotated[str, Field(min_length=1)]


class _Factor(Table):
    """Hold what the factors of all distributions have in common."""

    key: str = Field(min_length=1, description="parameter that varies, such as lens.surface.3.radius")
    unit: str = Field("", description="unit of the values, such as nm, K or fraction")
    description: str = Field("", description="meaning of the factor, for figures and tables")


class _Bounded(_Factor):
    """Hold a factor with a lower and an upper bound.

    Expansions in polynomials need, of each distribution, a coordinate from -1 to 1 in which a metric is likely to
    be smooth, and the distribution of this coordinate as nodes and weights of a quadrature.
    """

    low: float = Field(description="lower bound")
    high: float = Field(description="upper bound")

    def coordinates(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the coordinates, from -1 to 1, of points of the unit interval."""
        return 2 * np.asarray(points, dtype=np.float64) - 1

    def quadrature(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return nodes in the coordinate, and weights that sum to 1."""
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        return nodes, weights / 2

    def nominal(self) -> float:
        """Return the point of the unit interval at which a one-at-a-time design holds the factor: the middle."""
        return 0.5

    @model_validator(mode="after")
    def _ordered(self) -> _Bounded:
        if not self.low < self.high:
            raise ValueError(
                f"low = {self.low:g}, high = {self.high:g}: bounds reversed or equal, low must be below high"
            )
        return self


class Uniform(_Bounded):
    """Distribute a factor evenly between two bounds."""

    distribution: Literal["uniform"] = Field(description="name of the distribution")

    def values(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the values at points of the unit interval."""
        u = np.asarray(points, dtype=np.float64)
        return self.low * (1 - u) + self.high * u


class LogUniform(_Bounded):
    """Distribute the logarithm of a factor evenly between two bounds above 0."""

    distribution: Literal["log_uniform"] = Field(description="name of the distribution")
    low: float = Field(gt=0, description="lower bound, above 0")

    def values(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the values at points of the unit interval."""
        u = np.asarray(points, dtype=np.float64)
        logarithm = np.log(self.low) * (1 - u) + np.log(self.high) * u
        return np.clip(np.exp(logarithm), self.low, self.high)  # the exponential may round past a bound


class TruncatedNormal(_Bounded):
    """Distribute a factor as a normal distribution, cut off at two bounds."""

    distribution: Literal["truncated_normal"] = Field(description="name of the distribution")
    mean: float = Field(description="mean of the normal distribution before it is cut off")
    deviation: float = Field(gt=0, description="standard deviation of the normal distribution before it is cut off")

    @model_validator(mode="after")
    def _within_reach(self) -> TruncatedNormal:
        if not self.low <= self.mean <= self.high:
            raise ValueError(f"mean = {self.mean:g}: must be from low = {self.low:g} to high = {self.high:g}")
        widest = _MOST_DEVIATIONS * (self.high - self.low)
        if self.deviation > widest:  # the probabilities within the bounds would cancel
            raise ValueError(
                f"deviation = {self.deviation:g}: must be at most {widest:g}, {_MOST_DEVIATIONS:g} times the "
                "distance of the bounds; a wider one is uniform"
            )
        return self

    def values(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the values at points of the unit interval."""
        from scipy import stats

        scaled = stats.truncnorm.ppf(points, *self._limits(), loc=self.mean, scale=self.deviation)
        return np.clip(np.asarray(scaled, dtype=np.float64), self.low, self.high)

    def nominal(self) -> float:
        """Return the point of the unit interval at which a one-at-a-time design holds the factor: the mean."""
        from scipy import stats

        return float(stats.truncnorm.cdf(self.mean, *self._limits(), loc=self.mean, scale=self.deviation))

    def coordinates(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the coordinates, from -1 to 1, of points of the unit interval: the values, scaled."""
        low, high = self._reach()
        return np.clip(2 * (self.values(points) - low) / (high - low) - 1, -1.0, 1.0)

    def quadrature(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return nodes in the coordinate, and weights that sum to 1."""
        low, high = self._reach()
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        scores = (low + (high - low) * (nodes + 1) / 2 - self.mean) / self.deviation
        weights = weights * np.exp(-(scores**2) / 2)
        return nodes, weights / weights.sum()

    def _reach(self) -> tuple[float, float]:
        """Return the bounds, or the ends of the normal distribution's tails where these are nearer to the mean."""
        tail = _TAIL * self.deviation
        return max(self.low, self.mean - tail), min(self.high, self.mean + tail)

    def _limits(self) -> tuple[float, float]:
        """Return the bounds in standard deviations from the mean."""
        return (self.low - self.mean) / self.deviation, (self.high - self.mean) / self.deviation


class Categorical(_Factor):
    """Choose a factor's value from a list, each with the same probability. The first one is the nominal value."""

    distribution: Literal["categorical"] = Field(description="name of the distribution")
    choices: Annotated[tuple[float | _Text, ...], Field(min_length=2), AfterValidator(each_once)] = Field(
        alias="values", description="the values, at least two"
    )

    def values(self, points: ArrayLike) -> NDArray[np.object_]:
        """Return the values at points of the unit interval, of which each value has an equal part."""
        index = np.floor(np.asarray(points, dtype=np.float64) * len(self.choices)).astype(int)
        chosen = np.array(self.choices, dtype=object)
        return np.asarray(chosen[np.clip(index, 0, len(self.choices) - 1)])

    def points(self) -> NDArray[np.float64]:
        """Return for each value the middle of the part of the unit interval in which it is taken."""
        return (np.arange(len(self.choices)) + 0.5) / len(self.choices)

    def nominal(self) -> float:
        """Return the point of the unit interval at which a one-at-a-time design holds the factor."""
        return 0.5 / len(self.choices)

    def coordinates(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the coordinates, from -1 to 1, of points of the unit interval: numbers of the values, scaled."""
        count = len(self.choices)
        index = np.clip(np.floor(np.asarray(points, dtype=np.float64) * count), 0, count - 1)
        return 2 * index / (count - 1) - 1

    def quadrature(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the coordinate of each value, and equal weights that sum to 1."""
        count = len(self.choices)
        return np.linspace(-1.0, 1.0, count), np.full(count, 1 / count)


Factor = Annotated[Uniform | LogUniform | TruncatedNormal | Categorical, Field(discriminator="distribution")]
