"""A start from a share of very many rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration import initialisation
from hub.calibration.initialisation import _thinned
from tests.unit.test_adjust import world


def test_few_rows_are_all_taken() -> None:
    problem, state, _ = world(1)
    assert _thinned(problem, state) is problem


def test_of_many_rows_a_share_is_taken_but_some_to_every_knot(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state, _ = world(1)
    rows = []
    for part in problem.rows:
        time = np.arange(0.8, 5.2, 0.01)
        pixels = np.column_stack([time, time])
        rows.append(replace(part, time=time, pixels=pixels, use=np.ones(len(time), dtype=bool), stamp=time + 7.0))
    problem = replace(problem, rows=tuple(rows))
    total = sum(len(part.time) for part in rows)
    for many, every in ((total / 4.0, 4), (total / 1e4, 20)):  # knots are 0.4 s apart: 40 rows
        monkeypatch.setattr(initialisation, "_MANY_ROWS", many * 0.999)
        for before, after in zip(rows, _thinned(problem, state).rows, strict=True):
            assert len(after.time) == pytest.approx(len(before.time) / every, rel=0.15)
            assert np.isin(after.time, before.time).all()
            np.testing.assert_array_equal(after.pixels[:, 0], after.time)
            np.testing.assert_allclose(after.stamps, after.time + 7.0)
