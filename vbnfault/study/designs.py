"""Make the points of a study's design in the unit hypercube, and the evaluations that they need.

Every design has a column for each factor and one more, the last, for the dummy factor. A design depends on the
study file alone, so that an interrupted study continues with the same points.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .distributions import Categorical
from .spec import Evaluation, StudySpec

_MOST_ROWS = 10_000_000
_ANALYSED_BY_SALIB = {"morris": "analyze.morris", "latin_hypercube": "analyze.delta"}


@dataclass(frozen=True)
class Design:
    """Hold the points of a design, and the order in which a study evaluates them.

    Attributes
    ----------
    spec
        The study.
    points
        float64[row, factor], in the unit interval; the last column is the dummy factor.
    roles
        Place of each row in the design, as in `Evaluation`.
    """

    spec: StudySpec
    points: NDArray[np.float64]
    roles: tuple[str, ...]

    @cached_property
    def values(self) -> tuple[NDArray[Any], ...]:
        """Return the values of each factor at all points, float64[row] or object[row], without the dummy factor."""
        return tuple(factor.values(self.points[:, i]) for i, factor in enumerate(self.spec.factors))

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Return the numbers of seeds, views, rows and models: the axes along which evaluations are counted."""
        scene = self.spec.scene
        return len(scene.seeds), len(scene.views), len(self.roles), len(self.spec.model_names)

    def __len__(self) -> int:
        """Return the number of evaluations."""
        seeds, views, rows, models = self.shape
        return seeds * views * rows * models

    def place(self, index: int) -> tuple[int, int, int, int]:
        """Return the positions of an evaluation along the axes of `shape`.

        A view of a seed is completed before the next one begins, since what it costs to render is then shared. The
        models of a row follow each other, since they share the optics.
        """
        seed, view, row, model = np.unravel_index(index, self.shape)
        return int(seed), int(view), int(row), int(model)

    def evaluation(self, index: int) -> Evaluation:
        """Return an evaluation by its index."""
        seed, view, row, model = self.place(index)
        return Evaluation(
            index=index,
            seed=self.spec.scene.seeds[seed],
            view=self.spec.scene.views[view],
            model=self.spec.model_names[model],
            role=self.roles[row],
            values={key: plain_value(column[row]) for key, column in zip(self.spec.keys, self.values, strict=True)},
        )


def plain_value(value: Any) -> float | str:
    """Return a value of a factor as a Python object."""
    return value if isinstance(value, str) else float(value)


def make_design(spec: StudySpec) -> Design:
    """Return the design of a study. Raises InputError if it is too large, or if its library is missing.

    That includes the library that computes the indices in the end.
    """
    if spec.design.method in _ANALYSED_BY_SALIB:
        salib(_ANALYSED_BY_SALIB[spec.design.method], f"design.method = {spec.design.method!r}")
    makers: dict[str, Callable[[StudySpec, int], tuple[NDArray[np.float64], Iterator[str]]]] = {
        "sobol": _sobol,
        "morris": _morris,
        "latin_hypercube": _latin_hypercube,
        "grid": _grid,
        "one_at_a_time": _one_at_a_time,
    }
    dimensions = len(spec.factors) + 1
    points, roles = makers[spec.design.method](spec, dimensions)
    design = Design(spec, points, tuple(roles))
    if len(design) > _MOST_ROWS:
        seeds, views, rows, models = design.shape
        raise InputError(
            f"design.n = {spec.design.n}: gives {len(design)} evaluations ({rows} points, {views} samples, {seeds} "
            f"seeds, {models} models); must be at most {_MOST_ROWS}"
        )
    return design


def _sobol(spec: StudySpec, dimensions: int) -> tuple[NDArray[np.float64], Iterator[str]]:
    """Return A, B and AB of a scrambled Sobol' sequence (Saltelli et al. 2010, doi 10.1016/j.cpc.2009.09.018).

    The rows of one base sample follow each other: A, B, then for each factor A with this factor from B. The row of
    the dummy factor is left out: nothing reads this factor, so the evaluation would repeat that of A.
    """
    from scipy.stats import qmc

    both = qmc.Sobol(2 * dimensions, scramble=True, rng=spec.design.seed).random(spec.design.n)
    a, b = both[:, :dimensions], both[:, dimensions:]
    mixed = np.repeat(a[:, None, :], len(spec.keys), axis=1)
    for i in range(len(spec.keys)):
        mixed[:, i, i] = b[:, i]
    points = np.concatenate([a[:, None], b[:, None], mixed], axis=1)
    roles = ["A", "B", *(f"AB:{key}" for key in spec.keys)]
    return points.reshape(-1, dimensions), itertools.chain.from_iterable(itertools.repeat(roles, spec.design.n))


def _morris(spec: StudySpec, dimensions: int) -> tuple[NDArray[np.float64], Iterator[str]]:
    """Return the trajectories of a Morris design (Morris 1991, doi 10.1080/00401706.1991.10484804)."""
    sampler = salib("sample.morris", "design.method = 'morris'")
    design = spec.design
    points = sampler.sample(unit_problem(spec), design.n, num_levels=design.levels, seed=design.seed % 2**32)
    roles = (f"morris:{i}:{step}" for i in range(design.n) for step in range(dimensions + 1))
    return np.asarray(points, dtype=np.float64), roles


def _latin_hypercube(spec: StudySpec, dimensions: int) -> tuple[NDArray[np.float64], Iterator[str]]:
    """Return a Latin hypercube (McKay et al. 1979, doi 10.1080/00401706.1979.10489755)."""
    from scipy.stats import qmc

    points = qmc.LatinHypercube(dimensions, rng=spec.design.seed).random(spec.design.n)
    return points, itertools.repeat("point", len(points))


def levels(spec: StudySpec) -> list[NDArray[np.float64]]:
    """Return the points of each factor in a grid or one-at-a-time design, both bounds among them.

    A categorical factor has one for each of its values, every other one `design.n`.
    """
    n = spec.design.n
    return [
        factor.points()
        if isinstance(factor, Categorical)
        else np.linspace(0.0, 1.0, n)
        if n > 1
        else np.array([factor.nominal()])
        for factor in spec.factors
    ]


def _grid(spec: StudySpec, dimensions: int) -> tuple[NDArray[np.float64], Iterator[str]]:
    """Return all combinations of the levels; the dummy factor stays in the middle."""
    axes = levels(spec)
    rows = int(np.prod([float(len(axis)) for axis in axes]))
    if rows > _MOST_ROWS:
        raise InputError(
            f"design.n = {spec.design.n}: a grid over {len(axes)} factors has {rows} points; must be at most "
            f"{_MOST_ROWS}"
        )
    grid = np.stack(np.meshgrid(*axes, [0.5], indexing="ij"), axis=-1).reshape(-1, dimensions)
    return grid, itertools.repeat("point", len(grid))


def _one_at_a_time(spec: StudySpec, dimensions: int) -> tuple[NDArray[np.float64], Iterator[str]]:
    """Return the nominal point, then for each factor its levels with all others nominal."""
    nominal = np.array([*(factor.nominal() for factor in spec.factors), 0.5])
    rows = [nominal]
    for i, axis in enumerate(levels(spec)):
        for point in axis:
            rows.append(nominal.copy())
            rows[-1][i] = point
    return np.array(rows), itertools.repeat("point", len(rows))


def unit_problem(spec: StudySpec) -> dict[str, Any]:
    """Return the factors and the dummy factor as a problem of SALib, in the unit hypercube.

    Their names are x0, x1, …, since SALib does not take every name.
    """
    count = len(spec.keys) + 1
    names = [f"x{i}" for i in range(count)]
    return {"num_vars": count, "names": names, "bounds": [[0.0, 1.0]] * count}


def salib(module: str, needed_by: str) -> Any:
    """Return a module of SALib. Raises InputError, which begins with `needed_by`, if SALib is not installed."""
    import importlib

    try:
        return importlib.import_module(f"SALib.{module}")
    except ImportError as error:
        raise InputError(f"{needed_by}: needs SALib; pip install 'vbnfault[study]'") from error
