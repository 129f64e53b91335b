"""Stds of cameras where errors last: leaving out blocks of the recording, against the errors of many draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.adjustment import adjust
from hub.bundle.covariance import covariance, position_std, relative_clock_stds
from hub.bundle.noise.cluster_robust import cluster_robust
from hub.bundle.noise.noise_scale import rescale_noise
from hub.bundle.preprocessing import prepare
from protocols.geometry.types import Floats
from tests.support.bundles import pixels_of
from tests.support.rigs import simulate
from tests.unit.hub.bundle.test_adjustment import simulated_problem

BODIES = 12


def squares(time_constant: float) -> tuple[Floats, Floats]:
    """Mean squares of clocks' and positions' errors over their stds: of `rescale_noise` alone, and of blocks.

    time_constant: of the errors of 2 px [s]; 0 = independent ones.
    """
    clocks, places = list[tuple[float, float]](), list[Floats]()
    for seed in range(6):
        problem, truth, _ = simulated_problem(5, labels=BODIES, lens=False)
        rng, rows = np.random.default_rng(seed), []
        for part in problem.rows:
            error = rng.normal(0.0, 2.0, (len(part.time), 2))
            for row, step in enumerate(np.diff(part.time), 1):
                kept = np.exp(-step / time_constant) if time_constant else 0.0
                error[row] = kept * error[row - 1] + np.sqrt(1.0 - kept**2) * error[row]
            seen = pixels_of(truth.cameras[part.camera], truth.trajectories[part.label], part.time)
            rows.append(replace(part, pixels=seen + error))
        problem, state, prior = adjust(replace(problem, rows=tuple(rows)), truth, rounds=2)
        state = rescale_noise(problem, state, prior)
        plain = covariance(problem, state, prior)
        robust = cluster_robust(problem, state, plain, [f"person{label}" for label in range(BODIES)])
        both = (plain, robust)
        for camera in (1, 2):
            lag = state.cameras[camera].offset - truth.cameras[camera].offset
            lag -= state.cameras[0].offset - truth.cameras[0].offset
            stds = [relative_clock_stds(one, problem, state)[0, camera] for one in both]
            clocks.append((lag / stds[0], lag / stds[1]))
        # The gauge: the first camera's pose and the first baseline are the truth's, as in the adjustment.
        off = state.cameras[2].pose.position - truth.cameras[2].pose.position
        places.append(np.array([off / position_std(one, 2) for one in both]))
    return np.mean(np.square(clocks), axis=0), np.mean(np.square(places), axis=(0, 2))


def test_errors_that_last_widen_the_stds_of_clocks_and_positions() -> None:
    clocks, places = squares(0.6)
    assert clocks[0] > 2.0 or places[0] > 2.0
    assert clocks[1] < 1.6
    assert places[1] < 1.6


def test_independent_errors_leave_the_stds_as_they_are() -> None:
    clocks, places = squares(0.0)
    assert clocks[1] == pytest.approx(clocks[0], rel=0.4)
    assert places[1] == pytest.approx(places[0], rel=0.4)


def test_no_more_blocks_than_parameters_change_nothing() -> None:
    problem, state, prior = simulated_problem(3)
    found = covariance(problem, state, prior)
    assert cluster_robust(problem, state, found, ["a", "b"]) is found


@pytest.mark.parametrize(("target", "least"), [("person", 0.15), ("ball", 0.05)])
def test_knots_of_people_are_no_denser_than_their_errors_last(target: str, least: float) -> None:
    session = simulate(3, 2, 5.0)
    rig = replace(session.rig, metadata=session.rig.metadata | {"target": target})
    assert {camera.least_spacing for camera in prepare(rig, session.observations()).cameras.values()} == {least}
