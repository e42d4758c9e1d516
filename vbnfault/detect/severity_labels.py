"""Say how severe the faults of stored samples are, on the scale of the levels of severity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..faults import LEVELS, Levels, SeverityTable, registry
from ..faults.fields import REFERENCE_WIDTH_PX
from ..store import Store

F32 = NDArray[np.float32]


def severity_labels(
    store: Store, samples: Sequence[int] | NDArray[np.int64], classes: Sequence[str] | None = None
) -> F32:
    """Return the level of severity of each class in samples, float32[sample, class], 0 (absent) to 5.

    The level follows from the drawn value of the key by which the model becomes more severe (`Fault.severity`),
    scaled to the width of the frames: it is linear in the logarithm of the value between those of the packaged
    levels, and between 0 at the model's mildest value and its first level. Values beyond the last level count as
    that one. nan: their table has no levels of the model, or the parameters do not say the value. Other keys, such
    as a radius, may differ from those for which the table holds; the level does not change with them.

    Parameters
    ----------
    store
        An open store.
    samples
        Indices of finished samples.
    classes
        Fault classes; by default those of the store.

    Raises
    ------
    VbnfaultError
        The parameters of a sample cannot be read.
    """
    chosen, table = tuple(classes or store.spec.faults), Levels().table
    shape, focal_length_px = (store.spec.height, store.spec.width), store.read("intrinsics")[:, 0]
    levels = [
        [severity_level(name, drawn.get(name), shape, float(focal_length_px[i]), table) for name in chosen]
        for i, drawn in zip(samples, store.drawn(samples), strict=True)
    ]
    return np.array(levels, np.float32).reshape(len(levels), len(chosen))


def severity_level(
    fault: str,
    params: Mapping[str, Any] | None,
    shape: tuple[int, int],
    focal_length_px: float,
    table: SeverityTable,
) -> float:
    """Return the level of one fault, 0 to 5 or nan, as `severity_labels`.

    Parameters
    ----------
    fault, params
        The class, and what the store keeps of its draw, with the name of its model; None: it is not injected.
    shape, focal_length_px
        Height and width of the frame, and focal length, in px.
    table
        Levels of severity.
    """
    if params is None:
        return 0.0
    name = str(params.get("model"))
    model, levels = registry().get(fault, {}).get(name), table.levels.get(fault, {}).get(name)
    if model is None or levels is None or model.severity is None or model.severity.key != levels.key:
        return float("nan")
    severity, values = model.severity, np.array(levels.values)
    known = np.isfinite(values)
    value = severity.of_sample(params, shape, focal_length_px)
    if not np.isfinite(value) or not known.any():
        return float("nan")
    if severity.at_width(value, REFERENCE_WIDTH_PX, given_for_px=shape[1]) <= 0:  # positions are logarithms
        return 0.0 if severity.low < severity.high else float(LEVELS)
    positions = [severity.position(float(v), table.width_px) for v in values[known]]
    steps = np.arange(1, LEVELS + 1)[known]
    return float(np.interp(severity.position(value, shape[1]), [0.0, *positions], [0.0, *steps]))
