"""Median and quantiles are numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from protocols.geometry.order_statistics import median, quantile


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101, 600])
def test_median_and_quantiles_are_numpys(count: int) -> None:
    values = np.random.default_rng(count).normal(0.0, 1.0, count)
    assert median(values) == np.median(values)
    for share in (0.0, 0.1, 0.37, 0.5, 0.9, 1.0):
        assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-14, abs=1e-15)
