r"""Fit surrogates of a metric, whose own Sobol' indices are known exactly, as control variates of its indices.

The bootstrap interval of a total index near 1 has a half-width of some 2.8/√n, since the squared differences of
which the index is the mean vary as much as they are large. Most of this is no ignorance about the metric: a smooth
function of a dozen factors is known well from a few thousand evaluations. A control variate uses that (Owen 2013,
*Monte Carlo theory, methods and examples*, section 8.9): if g is a surrogate of the metric, and T and H are a term
of an index for the metric and for g, then

    ⟨T⟩ − β (⟨H⟩ − E[H])

has the same expectation as ⟨T⟩ for any fixed β, because E[⟨H⟩ − E[H]] = 0. Where g is good, T and H vary together
and their difference is nearly constant. Where g is bad, the regression of T on H gives β near 0, which leaves ⟨T⟩.

- **The surrogate** is a polynomial chaos expansion, a sum of products of functions of single factors that are
  orthonormal under their distributions: its indices are sums of its squared coefficients (Sudret 2008, doi
  10.1016/j.ress.2007.04.002), so E[H] needs no sampling. The coefficients solve a ridge regression. Coefficients
  of factors with large total indices, of low degree and of few factors are allowed to be larger.
- **Cross-fitting**: base samples are divided into 8 folds of consecutive samples. H of a fold comes from a
  surrogate of the other folds alone, with their choice of terms and of the penalty, so that g is fixed as seen from
  the fold: an over-fitted g is a bad control variate, but biases nothing (Chernozhukov et al. 2018, doi
  10.1111/ectj.12097, use it for the same reason).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .distributions import Factor

_FOLDS = 8
LEAST_SAMPLES = 2 * _FOLDS  # base samples; with fewer there is no control variate
_DEGREES = range(1, 13)  # of terms of three factors: the largest that gives no more terms than _MOST_CANDIDATES
_MORE_DEGREES = {1: 4, 2: 1, 3: 0}  # of terms of one and two factors
_MOST_CANDIDATES = 4000
_MOST_TERMS = 500
_ROWS_PER_TERM = 3
_DECAY = 0.4  # of the variance expected of a coefficient, with each degree
_LEAST_INDEX = 1e-4  # below it, total indices do not change what is expected of coefficients
_PENALTIES = 10.0 ** np.arange(-9.0, 2.0)  # over the mean square of the metric
_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Basis:
    """Hold the functions of single factors at the points of a design, and their products.

    Attributes
    ----------
    columns
        float64[row, column], the functions; column 0 is 1.
    terms
        int64[term, 3], the columns whose product is a term; 0 stands for no function. The first term is 1.
    contains
        bool[term, factor], whether a term has a function of a factor.
    degrees
        int64[term], sum of the degrees.
    """

    columns: _Array
    terms: NDArray[np.int64]
    contains: NDArray[np.bool_]
    degrees: NDArray[np.int64]

    def products(self, rows: NDArray[np.bool_], terms: NDArray[np.int64]) -> _Array:
        """Return terms at rows, float64[row, term]."""
        columns = self.columns[rows]
        chosen = self.terms[terms]
        values: _Array = columns[:, chosen[:, 0]] * columns[:, chosen[:, 1]]
        triples = chosen[:, 2] > 0
        values[:, triples] *= columns[:, chosen[triples, 2]]
        return values


def make_basis(factors: Sequence[Factor], points: _Array) -> Basis:
    """Return the basis of a study's factors at points of the unit hypercube, float64[row, factor]."""
    columns = [np.ones((len(points), 1))]
    owner, degree = [-1], [0]
    for i, factor in enumerate(factors):
        nodes, weights = factor.quadrature()
        count = min(_DEGREES[-1] + _MORE_DEGREES[1], len(nodes) - 1)
        columns.append(_orthonormal(nodes, weights, factor.coordinates(points[:, i]), count))
        owner += [i] * count
        degree += [1] * count if factor.distribution == "categorical" else list(range(1, count + 1))
    owners, degrees = np.array(owner), np.array(degree)
    table = _terms(owners, degrees, _DEGREES[0])
    for most in _DEGREES[1:]:
        larger = _terms(owners, degrees, most)
        if len(larger) > _MOST_CANDIDATES:
            break
        table = larger
    contains = (owners[table][:, :, None] == np.arange(len(factors))).any(axis=1)
    return Basis(np.concatenate(columns, axis=1), table, contains, degrees[table].sum(axis=1))


def _terms(owners: NDArray[np.int64], degrees: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return the terms of up to three factors with a limited sum of degrees, int64[term, 3]."""
    terms = [(0, 0, 0)]
    for order, more in _MORE_DEGREES.items():
        usable = np.flatnonzero(degrees <= most + more - order + 1)[1:]
        terms += [
            (*combination, *(0,) * (3 - order))
            for combination in itertools.combinations(usable.tolist(), order)
            if sum(degrees[c] for c in combination) <= most + more
            and len({owners[c] for c in combination}) == order
        ]
    return np.array(terms)


def _orthonormal(nodes: _Array, weights: _Array, coordinates: _Array, count: int) -> _Array:
    """Return polynomials of degrees 1 to `count` at coordinates, float64[row, degree].

    They are orthonormal, and orthogonal to 1, in the distribution with these nodes and weights.
    """
    legendre = np.polynomial.legendre.legvander
    _, triangle = np.linalg.qr(legendre(nodes, count) * np.sqrt(weights)[:, None])
    values: _Array = np.linalg.solve(triangle.T, legendre(coordinates, count).T).T
    return values[:, 1:]


@dataclass(frozen=True)
class Surrogates:
    """Hold what the surrogates of one metric say about the samples that they were not fitted to.

    Attributes
    ----------
    values
        float64[row], at each row the value of the surrogate of the other folds; 0 at rows that were not chosen.
    fold
        int64[base], fold of each base sample; -1 for those that were not chosen.
    mean, variance
        float64[fold], of each surrogate.
    first, total
        float64[fold, factor], variance due to the factor alone, and with its interactions.
    pairs
        float64[fold, factor, factor], variance of the terms that contain both factors.
    """

    values: _Array
    fold: NDArray[np.int64]
    mean: _Array
    variance: _Array
    first: _Array
    total: _Array
    pairs: _Array


def fit(basis: Basis, y: _Array, complete: NDArray[np.bool_]) -> Surrogates:
    """Fit a surrogate to the values outside each fold.

    Parameters
    ----------
    basis
        The basis at all rows of a Sobol' design: for each base sample A, B, and AB of each factor.
    y
        float64[row], values of the metric.
    complete
        bool[base], the base samples to use; at least LEAST_SAMPLES.
    """
    count, factors = int(complete.sum()), basis.contains.shape[1]
    of_base = np.full(len(complete), -1)
    # consecutive samples: those of every eighth number would have a common interval of the first coordinate
    of_base[complete] = np.arange(count) * _FOLDS // count
    fold = np.repeat(of_base, factors + 2)
    values = np.zeros(len(y))
    mean, variance = np.zeros(_FOLDS), np.zeros(_FOLDS)
    first, total = np.zeros((_FOLDS, factors)), np.zeros((_FOLDS, factors))
    pairs = np.zeros((_FOLDS, factors, factors))
    for k in range(_FOLDS):
        held_out, validation = fold == k, fold == (k + 1) % _FOLDS
        terms, coefficients = _fit_one(basis, y, (fold >= 0) & ~held_out & ~validation, validation)
        values[held_out] = basis.products(held_out, terms) @ coefficients
        contains = basis.contains[terms].astype(np.float64)
        squares = np.where(contains.any(axis=1), coefficients**2, 0.0)
        mean[k], variance[k] = coefficients[0], squares.sum()
        first[k] = (squares * (contains.sum(axis=1) == 1)) @ contains
        total[k] = squares @ contains
        pairs[k] = (contains * squares[:, None]).T @ contains
    return Surrogates(values, of_base, mean, variance, first, total, pairs)


def _fit_one(
    basis: Basis, y: _Array, training: NDArray[np.bool_], validation: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], _Array]:
    """Return the terms of a surrogate, the first of them 1, and their coefficients.

    The penalty is the one with the smallest error at the validation rows; then these are fitted, too.
    """
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    both = training | validation
    centre, spread = y[both].mean(), y[both].std()
    if spread <= 1e-12 * abs(centre):
        return np.zeros(1, dtype=np.int64), np.array([centre])
    expected = _expected_variances(basis, (y[both] - centre) / spread)
    most = min(_MOST_TERMS, int(both.sum()) // _ROWS_PER_TERM)
    terms = np.sort(np.argsort(-expected, kind="stable")[:most])
    root = np.sqrt(expected[terms])
    matrices, sides = [], []
    for rows in (training, validation):
        weighted = basis.products(rows, terms) * root
        matrices.append(weighted.T @ weighted)
        sides.append(weighted.T @ ((y[rows] - centre) / spread))

    def solve(matrix: _Array, side: _Array, penalty: float, rows: int) -> _Array:
        ridge = np.full(len(side), penalty * rows)
        return np.asarray(cho_solve(cho_factor(matrix + np.diag(ridge)), side))

    errors = []
    for penalty in _PENALTIES:
        try:
            c = solve(matrices[0], sides[0], penalty, int(training.sum()))
        except LinAlgError:
            errors.append(np.inf)
            continue
        errors.append(c @ matrices[1] @ c - 2 * c @ sides[1])
    best = float(_PENALTIES[int(np.argmin(errors))])
    coefficients = spread * root * solve(matrices[0] + matrices[1], sides[0] + sides[1], best, int(both.sum()))
    coefficients[0] += centre
    return terms, coefficients


def _expected_variances(basis: Basis, y: _Array) -> _Array:
    """Return how large the square of each term's coefficient may be, from Jansen's total indices."""
    by_base = y.reshape(-1, basis.contains.shape[1] + 2)
    index = ((by_base[:, :1] - by_base[:, 2:]) ** 2).mean(axis=0) / 2
    index = np.clip(index, _LEAST_INDEX, 1.0)
    logarithm = basis.contains @ np.log(index) + (basis.degrees - 1) * np.log(_DECAY)
    expected = np.exp(logarithm)
    expected[0] = 100.0  # the constant is hardly penalised
    return np.asarray(expected)
