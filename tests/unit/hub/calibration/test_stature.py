"""People whose height varies along the path give away a wrong geometry."""

from __future__ import annotations

import numpy as np
import pytest

from hub.calibration.acceptance import check_stature
from protocols.core.errors import Refused
from protocols.session.calibration import TrajectoryTable


def paths(variation: float) -> list[TrajectoryTable]:
    """Head and foot of somebody 1.7 tall, at other times, whose height varies by this share (std)."""
    rng, times = np.random.default_rng(3), np.arange(0.0, 20.0, 0.1)
    foot = np.column_stack([np.sin(times), np.cos(0.7 * times), np.zeros_like(times)])
    tall = 1.7 * (1.0 + variation * rng.normal(size=len(times)))
    head = foot + tall[:, None] * [0.0, 0.0, 1.0]
    foot[5] = np.nan
    tables = {"ann-head": (times, head), "ann-foot": (times + 0.01, foot), "lamp": (times, foot), "foot": (times, foot)}
    return [TrajectoryTable(label, *path, np.zeros(len(times))) for label, path in tables.items()]


def test_somebody_who_keeps_the_height_passes() -> None:
    check_stature(paths(0.02))
    check_stature(paths(0.5)[:1])


def test_somebody_who_grows_and_shrinks_is_a_refusal() -> None:
    with pytest.raises(
        Refused, match=r"ann would be [78] % taller and smaller along the path \(std\): the geometry is wr"
    ):
        check_stature(paths(0.08))
