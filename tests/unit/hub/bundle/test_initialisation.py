"""Initial poses from a fraction of the rows where there are very many."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle import initialisation
from hub.bundle.initialisation import _subsampled
from tests.unit.hub.bundle.test_adjustment import simulated_problem


def test_all_of_few_rows_are_used() -> None:
    problem, state, _ = simulated_problem(1)
    assert _subsampled(problem, state) is problem


def test_a_fraction_of_many_rows_is_used_with_enough_per_knot(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state, _ = simulated_problem(1)
    rows = []
    for part in problem.rows:
        time = np.arange(0.8, 5.2, 0.01)
        pixels = np.column_stack([time, time])
        rows.append(replace(part, time=time, pixels=pixels, use=np.ones(len(time), dtype=bool), stamp=time + 7.0))
    problem = replace(problem, rows=tuple(rows))
    total = sum(len(part.time) for part in rows)
    for many, every in ((total / 4.0, 4), (total / 1e4, 20)):  # knots are 0.4 s apart: 40 rows
        monkeypatch.setattr(initialisation, "_MAX_INITIAL_ROWS", many * 0.999)
        for before, after in zip(rows, _subsampled(problem, state).rows, strict=True):
            assert len(after.time) == pytest.approx(len(before.time) / every, rel=0.15)
            assert np.isin(after.time, before.time).all()
            np.testing.assert_array_equal(after.pixels[:, 0], after.time)
            np.testing.assert_allclose(after.stamps, after.time + 7.0)
