"""The solver in a process of its own: answers as inline, ended when it hangs, replaced when it dies."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from hub.live import worker
from hub.live.live_hub import LiveHub, LiveSettings
from hub.live.solver import SolverAnswer, SolverJob, run_job
from hub.live.worker import WorkerSolver
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import Observations
from tests.integration.live.test_live_hub import messages
from tests.support.rigs import Session, simulate


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(71, 3, 20)


@pytest.fixture
def job(session: Session) -> SolverJob:
    hub = LiveHub(LiveSettings(interval_s=1e9))
    for message in messages(session):
        hub.handle(message)
    rig, observations, _ = hub._build_session()
    return SolverJob(1, rig, observations, None)


@pytest.fixture
def solver() -> Iterator[WorkerSolver]:
    made = WorkerSolver(budget_s=60.0)
    yield made
    made.close()


def answer_of(solver: WorkerSolver, budget_s: float = 60.0) -> SolverAnswer:
    until = time.monotonic() + budget_s
    while time.monotonic() < until:
        answer = solver.poll(time.monotonic())
        if answer is not None:
            return answer
        time.sleep(0.02)
    raise AssertionError("no answer")


def test_unlabelled_people_reach_the_worker(job: SolverJob, solver: WorkerSolver) -> None:
    """Protobuf's messages cannot be pickled: each job failed, and one camera after the other was left out."""
    people = (pb.Observation(schema_version=1, camera=next(iter(job.rig.cameras)), detections=[pb.Detection(u=1.0)]),)
    solver.submit(replace(job, observations=Observations({}), people=people), time.monotonic())
    answer = answer_of(solver)
    assert not answer.failed, answer.reason
    assert answer.reason.startswith("by colour: the colours of the people are ambiguous")


def hang(job: SolverJob) -> SolverAnswer:
    """A solver that takes a minute."""
    time.sleep(60.0)
    return SolverAnswer(job.number)


def spin(job: SolverJob) -> SolverAnswer:
    """A solver that computes for a minute."""
    until = time.process_time() + 60.0
    while time.process_time() < until:
        pass
    return SolverAnswer(job.number)


def starve(job: SolverJob) -> SolverAnswer:
    """A solver that is given little of a busy machine."""
    for _ in range(25):
        until = time.process_time() + 0.02
        while time.process_time() < until:
            pass
        time.sleep(0.2)
    return SolverAnswer(job.number, reason="starved")


def die(job: SolverJob) -> SolverAnswer:
    """A solver whose process is killed."""
    os.kill(os.getpid(), signal.SIGKILL)
    return SolverAnswer(job.number)


def test_its_answer_equals_an_inline_one(solver: WorkerSolver, job: SolverJob) -> None:
    solver.submit(job, time.monotonic())
    assert solver.busy
    found, inline = answer_of(solver).calibration, run_job(job).calibration
    assert found is not None
    assert inline is not None
    assert not solver.busy
    for name, camera in found.cameras.items():
        assert camera.time_map == inline.cameras[name].time_map
        np.testing.assert_array_equal(camera.pose.rotation, inline.cameras[name].pose.rotation)


@pytest.mark.parametrize("fault", [hang, spin, die])
def test_a_solver_that_hangs_or_dies_is_replaced(
    solver: WorkerSolver, job: SolverJob, fault: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    solver._budget_s = 4.0
    monkeypatch.setattr(worker, "run_job", fault)
    solver.submit(job, time.monotonic())
    answer = answer_of(solver)
    assert answer.failed
    assert not solver.busy
    assert answer.reason in ("no answer within 4 s", "the solver's process ended")
    monkeypatch.setattr(worker, "run_job", run_job)
    solver._budget_s = 60.0
    solver.submit(job, time.monotonic())
    assert answer_of(solver).calibration is not None
    assert solver.restarts == 1


def test_a_worker_that_was_killed_between_jobs_is_replaced(solver: WorkerSolver, job: SolverJob) -> None:
    solver.submit(job, time.monotonic())
    assert answer_of(solver).calibration is not None
    assert solver._pool is not None
    [process] = solver._pool._processes.values()
    process.kill()
    process.join()
    time.sleep(0.5)  # the pool's own thread notices
    solver.submit(job, time.monotonic())
    assert answer_of(solver).calibration is not None
    assert solver.restarts == 1


def test_a_solver_on_a_busy_machine_has_time_to_answer(
    solver: WorkerSolver, job: SolverJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    solver.submit(job, time.monotonic())
    assert answer_of(solver).calibration is not None
    solver._budget_s = 2.0
    monkeypatch.setattr(worker, "run_job", starve)
    solver.submit(job, time.monotonic())
    assert answer_of(solver).reason == "starved"
    assert solver.restarts == 0


@pytest.mark.parametrize("fault", [hang, die])
def test_the_hubs_rounds_never_wait_for_it(
    solver: WorkerSolver, session: Session, fault: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counted in calls, not timed: while the job is under way every tick returns, and the hub says what is wrong."""
    solver._budget_s = 3.0
    monkeypatch.setattr(worker, "run_job", fault)
    hub = LiveHub(LiveSettings(interval_s=0.1), solver=solver)
    for message in messages(session):
        hub.handle(message)
    rounds, until = 0, time.monotonic() + 60.0
    while hub.counters["solver_failures"] == 0 and time.monotonic() < until:
        hub.tick(time.monotonic())
        rounds += solver.busy
        time.sleep(0.01)
    assert hub.counters["solver_failures"] == 1
    assert rounds > 10
    assert hub.solver_failure
