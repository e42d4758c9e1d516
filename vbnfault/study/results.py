"""Write and read what a study has found: the table of its evaluations and the store of its indices.

Both open without vbnfault: `table.parquet` with any reader of Parquet, `indices.zarr` with `xarray.open_zarr`.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import InputError
from ..core.files.whole_files import replacing
from ..store import is_sealed, sealed
from .designs import Design
from .distributions import Categorical
from .spec import DUMMY, Metric

if TYPE_CHECKING:
    import pyarrow
    import xarray as xr

TABLE = "table.parquet"
INDICES = "indices.zarr"
_SECONDS = "seconds"  # in the file of a chunk, beside the numbers of its evaluations
# Columns of the table besides factors and metrics: name → meaning
COLUMNS = {
    "evaluation": "number of the evaluation",
    "seed": "seed of the block",
    "view": "sample of the scene",
    "model": "model of the fault; empty where none are compared",
    "role": "place in the design: A, B, AB:<factor>, morris:<trajectory>:<step> or point",
    "status": "ok or failed",
    "error": "why the evaluation failed; empty where it did not",
}


def write_table(
    path: Path, design: Design, metrics: Sequence[Metric], outcomes: Sequence[Mapping[str, Any]]
) -> pyarrow.Table:
    """Write the table of a study, one row for each evaluation in order, and return it.

    The metadata of a column are `kind` (factor or metric), `units`, `description` and `source`.

    Parameters
    ----------
    path
        The Parquet file.
    outcomes
        Of each evaluation `values` (by metric) and `error` (empty where it did not fail).
    """
    import pyarrow as pa
    from pyarrow import parquet

    spec = design.spec
    seeds, views, rows, models = np.unravel_index(np.arange(len(design)), design.shape)
    failed = [bool(outcome["error"]) for outcome in outcomes]
    plain: dict[str, Any] = {
        "evaluation": np.arange(len(design)),
        "seed": np.array(spec.scene.seeds)[seeds],
        "view": np.array(spec.scene.views)[views],
        "model": [spec.model_names[model] for model in models],
        "role": [design.roles[row] for row in rows],
        "status": ["failed" if wrong else "ok" for wrong in failed],
        "error": [outcome["error"] for outcome in outcomes],
    }
    columns, fields = [], []

    def add(name: str, values: Any, dtype: Any, **about: str) -> None:
        columns.append(pa.array(values, type=dtype))
        fields.append(pa.field(name, dtype, metadata={key: text for key, text in about.items() if text}))

    for name, values in plain.items():
        add(name, values, pa.int64() if isinstance(values, np.ndarray) else pa.string(), description=COLUMNS[name])
    for factor, values in zip(spec.factors, design.values, strict=True):
        words = isinstance(factor, Categorical) and not all(isinstance(c, float) for c in factor.choices)
        column = [str(value) for value in values[rows]] if words else values[rows].astype(np.float64)
        about = {"kind": "factor", "units": factor.unit, "description": factor.description}
        add(factor.key, column, pa.string() if words else pa.float64(), **about)
    add(DUMMY, design.points[rows, -1], pa.float64(), kind="factor", description="factor that acts on nothing")
    for metric in metrics:
        column = np.array([outcome["values"].get(metric.name, np.nan) for outcome in outcomes], dtype=np.float64)
        about = {"kind": "metric", "units": metric.unit, "description": metric.description, "source": metric.source}
        add(metric.name, column, pa.float64(), **about)
    table = pa.Table.from_arrays(columns, schema=pa.schema(fields, metadata={"title": spec.title}))
    with replacing(path) as temporary:
        parquet.write_table(table, temporary, write_page_checksum=True)
    return table


def read_table(folder: str | Path) -> pyarrow.Table:
    """Return the table of a study, as `write_table` describes it."""
    from pyarrow import parquet

    path = Path(folder) / TABLE
    if not path.is_file():
        raise InputError(f"{path}: no such file; a study writes it when it is complete")
    try:
        return parquet.read_table(path, page_checksum_verification=True)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged ({error}); the command of the study writes it again") from None


def holds_design(table: pyarrow.Table, design: Design) -> bool:
    """Return whether the rows of a table are the evaluations of a design, with the same values of all factors."""
    if table.num_rows != len(design):
        return False
    rows = np.unravel_index(np.arange(len(design)), design.shape)[2]
    return all(
        key in table.column_names
        and (
            np.allclose(table[key].to_numpy(), values[rows].astype(np.float64), rtol=1e-9, atol=0.0)
            if table.schema.field(key).type == "double"
            else table[key].to_pylist() == [str(value) for value in values[rows]]
        )
        for key, values in zip(design.spec.keys, design.values, strict=True)
    )


def metrics_of(indices: xr.Dataset) -> tuple[Metric, ...]:
    """Return the metrics of stored indices."""
    texts = ("unit", "description", "source")
    return tuple(
        Metric(
            name=str(metric["metric"].item()),
            **{key: str(metric[key].item()) for key in texts},
            better="high" if metric["better"].item() == "high" else "low",
        )
        for metric in (indices.sel(metric=name) for name in indices["metric"].values)
    )


def write_indices(path: Path, indices: xr.Dataset) -> None:
    """Write the indices of a study as a Zarr group, in place of an earlier one.

    Its metadata are consolidated, so that `xarray.open_zarr` opens it without a warning.
    """
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part in the Zarr format 3")
        indices.to_zarr(temporary, mode="w", consolidated=True, zarr_format=3)


def open_indices(folder: str | Path) -> xr.Dataset:
    """Return the indices of a study, in memory."""
    import xarray as xr

    path = Path(folder) / INDICES
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; a study writes it when it is complete")
    with xr.open_zarr(path, consolidated=False) as stored:
        return stored.load()


# --- finished rows, chunk by chunk ------------------------------------------------------------------------------


def chunk_path(folder: Path, chunk: int) -> Path:
    """Return the file of the finished evaluations of a chunk."""
    return folder / "rows" / f"{chunk:07d}.json"


def write_chunk(
    folder: Path, chunk: int, outcomes: Mapping[int, Mapping[str, Any]], seconds: Mapping[str, float]
) -> None:
    """Write the finished evaluations of a chunk so that a kill leaves the file of before or the whole new one.

    `seconds`: what they took, by stage.
    """
    record = {str(index): outcomes[index] for index in sorted(outcomes)} | {_SECONDS: dict(seconds)}
    with replacing(chunk_path(folder, chunk)) as temporary:  # a link of this name is replaced
        temporary.write_text(json.dumps(sealed(record)), encoding="utf-8")


def read_chunk(folder: Path, chunk: int) -> tuple[dict[int, dict[str, Any]], dict[str, float]]:
    """Return the finished evaluations of a chunk, and what they took, by stage; none where there is no file.

    Raises ValueError if the file is damaged: its evaluations must be made again.
    """
    try:
        record = json.loads(chunk_path(folder, chunk).read_text(encoding="utf-8"))
        intact = is_sealed(record)
    except FileNotFoundError:
        return {}, {}
    except (OSError, ValueError, AttributeError, RecursionError):
        intact = False
    if not intact:
        raise ValueError(f"{chunk_path(folder, chunk)}: damaged")
    return {int(index): record[index] for index in record if index.isdigit()}, record[_SECONDS]


def partial_files(folder: Path) -> Iterator[Path]:
    """Return the files that a killed process has left half written."""
    yield from folder.glob(".*.partial")
    yield from (folder / "rows").glob(".*.partial")
