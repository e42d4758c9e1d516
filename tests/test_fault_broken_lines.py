"""Broken lines: counts, values, and which way they may run."""

from __future__ import annotations

import numpy as np
import pytest
from test_faults_kit import flat_rgbi, make, make_context, rng

from vbnfault.core.errors import InputError
from vbnfault.core.quantities import ARCHITECTURES
from vbnfault.faults.broken_lines import TextureBrokenLines


def test_the_papers_example_three_white_two_black() -> None:
    context = make_context(96, 64, architecture="frame_transfer_ccd", readout_direction="right")
    for table in ({"count": 5, "white_count": 3}, {"white_count": 3, "black_count": 2}):
        fault = make("broken_lines", **table)
        params = fault.draw(context, rng(4))
        out = fault.apply(flat_rgbi(context, 90), params, context).array
        assert (out == 255).all(axis=(1, 2)).sum() == 3
        assert (out == 0).all(axis=(1, 2)).sum() == 2
        assert (out == 90).all(axis=(1, 2)).sum() == 64 - 5
        mask = fault.footprint(params, context)
        assert np.array_equal(mask, (out != 90).any(axis=2))


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_rows_or_columns_by_architecture(architecture: str) -> None:
    both = 0
    for seed in range(60):
        for direction in ("up", "left"):
            context = make_context(64, architecture=architecture, readout_direction=direction)
            params = make("broken_lines").draw(context, rng(seed))
            rows, columns = params["rows"], params["columns"]
            assert 1 <= len(rows) + len(columns) <= 5
            assert len(set(rows)) == len(rows)
            assert len(set(columns)) == len(columns)
            assert set(params["row_values"]) | set(params["column_values"]) <= {0, 255}
            if architecture in ("full_frame_ccd", "frame_transfer_ccd"):
                assert not (rows if direction == "up" else columns)
            both += bool(rows) and bool(columns)
    assert (both > 20) == (architecture in ("interline_ccd", "cmos"))


def test_direction_can_be_set() -> None:
    context = make_context(64, architecture="cmos")
    assert not make("broken_lines", direction="rows", count=5).draw(context, rng())["columns"]
    assert not make("broken_lines", direction="columns", count=5).draw(context, rng())["rows"]


def test_saturated_wins_where_lines_cross() -> None:
    context = make_context(32)
    params = {"rows": [3, 9], "row_values": [0, 255], "columns": [5, 7], "column_values": [255, 0]}
    out = TextureBrokenLines().apply(flat_rgbi(context, 90), params, context).array
    assert (out[3, 5] == 255).all()
    assert (out[9, 7] == 255).all()
    assert (out[3, 7] == 0).all()
    assert (out[9, 5] == 255).all()
    assert (out[4, 6] == 90).all()


def test_contradicting_counts_are_refused() -> None:
    with pytest.raises(InputError, match="white_count = 6"):
        make("broken_lines", count=5, white_count=6)
    with pytest.raises(InputError, match=r"faults\.broken_lines\.white_count = 1\.5: must be a whole number"):
        make("broken_lines", white_count=1.5)


def test_values_are_a_fair_coin() -> None:
    context = make_context(64)
    values = [v for s in range(300) for v in make("broken_lines", count=5).draw(context, rng(s))["row_values"]]
    # 1500 tosses: standard deviation 19.4; four of them
    assert abs(values.count(255) - 750) < 78
