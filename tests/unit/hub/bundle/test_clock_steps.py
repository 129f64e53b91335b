"""Clock steps in residuals: their sizes are those that stamps may hide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hub.bundle import clock_steps
from hub.bundle.problem import AdjustmentState, ClockStep, Problem


@pytest.mark.parametrize(("size", "is_step"), [(0.1, True), (0.002, False), (160_938.0, False)])
def test_a_step_that_the_stamps_would_show_is_none(monkeypatch: pytest.MonkeyPatch, size: float, is_step: bool) -> None:
    """Of a camera turned while nothing moved, the linear model made one of two days, at a std of 0.2 ms."""
    step = ClockStep(0, 1.0, size, 1e-4, 1e6)
    given: dict[str, Any] = {
        "likely_clock_steps": lambda *_: (step,),
        "needed_for_a_step": lambda _: 20.0,
        "_step_of_rejected_rows": lambda *_: None,
    }
    for name, function in given.items():
        monkeypatch.setattr(clock_steps, name, function)
    problem, state = Problem((), (), 0, (0, 1)), AdjustmentState((), (), np.zeros(0))
    assert clock_steps.find_clock_step(problem, state) == (step if is_step else None)


def test_what_the_stamps_would_show_hides_no_step_of_another_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one of two days and one of 50 ms none was found."""
    large, small = ClockStep(0, 1.0, 160_938.0, 1e-4, 1e6), ClockStep(1, 1.0, 0.05, 1e-4, 1e4)
    monkeypatch.setattr(clock_steps, "likely_clock_steps", lambda *_: (large, small))
    monkeypatch.setattr(clock_steps, "needed_for_a_step", lambda _: 20.0)  # with no row it is not defined
    state = AdjustmentState((), (), np.zeros(0))
    assert clock_steps.find_clock_step(Problem((), (), 0, (0, 1)), state) == small
