"""Read and check the study file, and define what the engine and the evaluators of a study exchange.

The engine makes `Evaluation`s from a `StudySpec` and gives them to an `Evaluator`, which returns one number for
each `Metric`. The engine knows nothing about cameras: an evaluator may be any function.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from ..core import tables
from ..core.errors import shown
from ..core.files import path_checks, resources, toml_files
from ..core.tables import Table, each_once
from .distributions import Factor

DUMMY = "dummy"  # the factor that acts on nothing; its index is the noise floor
_MOST_SAMPLES = 2**20
_Key = Annotated[str, Field(min_length=1)]
_Index = Annotated[int, Field(ge=0, le=2**63 - 1)]


@dataclass(frozen=True, kw_only=True)
class Metric:
    """Describe a number that an evaluation gives.

    Attributes
    ----------
    name
        Name of the metric, a column of the table.
    unit
        Unit, such as `electrons`, `px` or `1`.
    description
        What it measures, with its equation.
    source
        Publication that defines it; empty where it needs none.
    better
        Which values are the better ones, so that worst and best images can be told.
    """

    name: str
    unit: str
    description: str
    source: str = ""
    better: Literal["low", "high"] = "low"


def returned(function: Callable[..., float]) -> str:
    """Return what a function returns, by its docstring: the words between "Return the" and the full stop."""
    return " ".join((function.__doc__ or "").split()).removeprefix("Return the ").removesuffix(".")


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Describe one evaluation: a point of the design, at one view of the scene, with one seed and one model.

    Attributes
    ----------
    index
        Row of the table, from 0; the order is part of the study.
    seed
        Seed of the block. All evaluations of a block use the same random numbers.
    view
        Sample of the scene.
    model
        Model of the fault that the study compares; empty where it compares none.
    role
        Place in the design: `A`, `B`, `AB:<factor>`, `morris:<trajectory>:<step>` or `point`.
    values
        Value of each factor by its key, without the dummy factor.
    """

    index: int
    seed: int
    view: int
    model: str
    role: str
    values: Mapping[str, float | str]


class Evaluator(Protocol):
    """Evaluate the points of a study. Each worker process makes its own evaluator, which may keep costly data.

    What `evaluate` returns must depend on the evaluation only, not on those before it.
    """

    @property
    def metrics(self) -> Sequence[Metric]:
        """Return the metrics that `evaluate` gives, at least those that the study names."""
        ...

    def check(self) -> Sequence[str]:
        """Check the study before its design is evaluated, and return warnings, one sentence each.

        Raises InputError in one sentence where a factor is unknown (with the nearest known one), or where no
        evaluation reads it.
        """
        ...

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        """Return the value of each metric by its name; nan where it has no value."""
        ...

    def timings(self) -> Mapping[str, float]:
        """Return the seconds spent so far in each stage of `evaluate`, by the name of the stage."""
        ...


class DesignTable(Table):
    """Hold which points are evaluated, and how certain the indices shall be."""

    method: Literal["sobol", "morris", "latin_hypercube", "grid", "one_at_a_time"] = Field(
        "sobol", description="how the points are chosen, and so which indices the study gives"
    )
    n: int = Field(
        ge=1,
        le=_MOST_SAMPLES,
        description="number of base samples (sobol, a power of two), trajectories (morris), samples "
        "(latin_hypercube), or values of each factor (grid, one_at_a_time)",
    )
    seed: int = Field(1, ge=0, le=2**63 - 1, description="seed of the design and of the bootstrap")
    resamples: int = Field(1000, ge=100, le=100_000, description="number of bootstrap resamples")
    confidence: float = Field(0.95, ge=0.5, le=0.999, description="confidence level of all intervals")
    half_width: Annotated[float | None, AfterValidator(lambda asked: asked or None)] = Field(
        None,
        ge=0,
        lt=1,
        description="largest half-width that the intervals of the total indices shall have; 0 asks for none",
    )
    levels: int = Field(4, ge=2, le=64, multiple_of=2, description="levels of a Morris design, an even number")

    @model_validator(mode="after")
    def _fits(self) -> DesignTable:
        if self.method == "sobol" and self.n & (self.n - 1):
            below = 1 << (self.n.bit_length() - 1)
            raise ValueError(
                f"n = {self.n}: must be a power of two with method = 'sobol', such as {below} or {2 * below}"
            )
        if self.half_width is not None and self.method != "sobol":
            raise ValueError(f"half_width = {self.half_width:g}: needs method = 'sobol', not {self.method!r}")
        return self


class SceneTable(Table):
    """Hold the views on which every point is evaluated.

    Further keys replace those of the scene file.
    """

    model_config = ConfigDict(extra="allow")

    base: str = Field("quickstart", min_length=1, description="path of a scene file, or name of a packaged scene")
    samples: Annotated[int, Field(ge=1, le=_MOST_SAMPLES)] | tuple[_Index, ...] = Field(
        1, description="the scene's samples on which every point is evaluated: a list of indices, or a number"
    )
    seeds: Annotated[tuple[_Index, ...], Field(min_length=1), AfterValidator(each_once)] = Field(
        (1,), description="blocks: each one replaces dataset.seed and repeats the whole design"
    )

    @model_validator(mode="after")
    def _differ(self) -> SceneTable:
        if not self.views:
            raise ValueError("samples = []: must name at least one sample")
        try:
            each_once(self.views)
        except ValueError as error:
            raise ValueError(f"samples = {shown(list(self.views))}: {error}") from None
        return self

    @property
    def views(self) -> tuple[int, ...]:
        """Return the indices of the scene's samples."""
        return tuple(range(self.samples)) if isinstance(self.samples, int) else self.samples

    @property
    def overrides(self) -> dict[str, Any]:
        """Return the values that replace those of the scene, by dotted key.

        An empty table, such as that of a fault without keys, adds to the scene what it lacks.
        """
        return tables.flat(self.model_extra or {})


class ModelsTable(Table):
    """Hold the models of one fault that are compared on the same samples."""

    fault: str = Field(min_length=1, description="fault class whose models are compared")
    compare: Annotated[tuple[_Key, ...], Field(min_length=2), AfterValidator(each_once)] = Field(
        description="names of the models, at least two"
    )


class MetricsTable(Table):
    """Hold the metrics of the study."""

    names: Annotated[tuple[_Key, ...], Field(min_length=1), AfterValidator(each_once)] = Field(
        description="metrics that every evaluation gives, at least one"
    )


class StudySpec(Table):
    """Hold a whole study file with all defaults filled in."""

    model_config = ConfigDict(populate_by_name=True)

    title: str = Field(description="title of the study")
    description: str = Field("", description="what the study asks, in a sentence")
    design: DesignTable
    scene: SceneTable = SceneTable()
    models: ModelsTable | None = None
    factors: tuple[Factor, ...] = Field(min_length=1, alias="factor", description="the factors, at least one")
    metrics: MetricsTable

    @model_validator(mode="after")
    def _keys(self) -> StudySpec:
        keys = [factor.key for factor in self.factors]
        for i, key in enumerate(keys):
            if key == DUMMY:
                raise ValueError(f"factor[{i}].key = {DUMMY!r}: this factor is always added; leave it out")
            if key in keys[:i]:
                raise ValueError(f"factor[{i}].key = {key!r}: the key is given twice, in factor[{keys.index(key)}]")
        return self

    @property
    def keys(self) -> tuple[str, ...]:
        """Return the keys of the factors, without the dummy factor."""
        return tuple(factor.key for factor in self.factors)

    @property
    def model_names(self) -> tuple[str, ...]:
        """Return the names of the compared models; one empty name where none are compared."""
        return self.models.compare if self.models is not None else ("",)

    def resolved(self) -> dict[str, Any]:
        """Return the whole study as plain data, from which a study file can be written."""
        plain: dict[str, Any] = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        return plain


EvaluatorFactory = Callable[[StudySpec], Evaluator]


def load_study(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> StudySpec:
    """Load a study by its path or packaged name. Raises InputError.

    `overrides` maps dotted keys, such as `design.n`, to values that replace those of the file. A path in the file
    that lies beside it starts from its folder, every other one from the working folder.
    """
    path = resources.find("scenes/studies", name_or_path)
    table = toml_files.read_toml(path, "study")
    scene = table.get("scene")
    if isinstance(scene, dict):
        _anchor(scene, path.parent)
    tables.replace(table, overrides or {}, source=str(path))
    return parse_study(table, source=str(path), overrides=tuple(overrides or ()))


def parse_study(table: Mapping[str, Any], *, source: str, overrides: Sequence[str] = ()) -> StudySpec:
    """Return plain data as a checked study. Raises InputError; its one sentence names `source`, key and value."""
    return tables.parse(StudySpec, table, source=source, overrides=overrides)


def _anchor(table: dict[str, Any], folder: Path) -> None:
    """Make the paths of files beside the study file absolute: texts with a suffix that name such a file."""
    for key, value in table.items():
        if isinstance(value, dict):
            _anchor(value, folder)
        elif isinstance(value, str) and Path(value).suffix and path_checks.file_status(folder / value):
            table[key] = path_checks.absolute(folder / value, f"scene.{key}")
