"""What the live hub has solved elsewhere: one snapshot in, one answer out.

A job is a pure function of its content, so that a worker process, a replay and a test give the same answer bit for bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hub.calibration.incremental import update_calibration
from hub.calibration.triangulation import triangulate
from hub.clocks.external_prior import ExternalClockPrior
from protocols.core.errors import InputError, Refused
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class SolverJob:
    """A snapshot of what a hub knows.

    last: the answer to start from, with the cameras whose clock and pose hold; None = from scratch. search, full: of
    cameras that are not tied, and refine_lenses: see `update_calibration`. verify: only test whether the
    rows agree with ``last``.
    """

    number: int
    rig: Rig
    observations: Observations
    last: Calibration | None
    search: bool = True
    full: bool = True
    verify: bool = False
    clock_priors: Mapping[str, ExternalClockPrior] = field(default_factory=dict)
    arrivals: Mapping[str, ExternalClockPrior] = field(default_factory=dict)
    refine_lenses: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class SolverAnswer:
    """What came of a job: a calibration, or why there is none.

    refused: reasons by camera. permanent: more of the same observations cannot help. failed: the solver did not finish
    (an error, its budget, or its process ended). moved: cameras that were moved, and camera times [s] since when.
    """

    number: int
    calibration: Calibration | None = None
    reason: str = ""
    refused: Mapping[str, str] = field(default_factory=dict)
    permanent: bool = False
    failed: bool = False
    moved: Mapping[str, float] = field(default_factory=dict)
    cpu_s: float = 0.0


class Solver(Protocol):
    """Solves one job at a time. ``submit`` and ``poll`` return at once; now: any monotonic clock [s]."""

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""

    def submit(self, job: SolverJob, now: float) -> None:
        """Take a job; only while not ``busy``."""

    def poll(self, now: float) -> SolverAnswer | None:
        """The answer to the job, once."""

    def close(self) -> None:
        """End; a job under way is given up."""


class InlineSolver:
    """Solves where it is called, for replays and tests; its answers do not depend on time."""

    def __init__(self) -> None:
        self._answer: SolverAnswer | None = None

    @property
    def busy(self) -> bool:
        """Whether an answer was not fetched yet."""
        return self._answer is not None

    def submit(self, job: SolverJob, now: float) -> None:
        """Solve the job."""
        self._answer = run_job(job, cpu_clock=lambda: 0.0)

    def poll(self, now: float) -> SolverAnswer | None:
        """The answer, once."""
        answer, self._answer = self._answer, None
        return answer

    def close(self) -> None:
        """Nothing is open."""


def run_job(job: SolverJob, cpu_clock: Callable[[], float] = time.process_time) -> SolverAnswer:
    """The answer to a job. No error escapes: a camera's strange rows must not end the hub."""
    began = cpu_clock()
    try:
        if job.verify:
            return SolverAnswer(job.number, _verified(job), cpu_s=cpu_clock() - began)
        update = update_calibration(
            job.rig,
            job.observations,
            job.last,
            search=job.search,
            full=job.full,
            clock_priors=job.clock_priors,
            arrivals=job.arrivals,
            refine_lenses=job.refine_lenses,
        )
    except Refused as refusal:
        return SolverAnswer(
            job.number,
            reason=refusal.reason,
            refused=refusal.cameras,
            permanent=refusal.permanent,
            cpu_s=cpu_clock() - began,
        )
    except InputError as error:
        return SolverAnswer(job.number, reason=str(error), permanent=True, cpu_s=cpu_clock() - began)
    except (ValueError, ArithmeticError, IndexError, KeyError, np.linalg.LinAlgError, MemoryError) as error:
        reason = f"the solver failed: {type(error).__name__}: {error}"
        return SolverAnswer(job.number, reason=reason, failed=True, cpu_s=cpu_clock() - began)
    return SolverAnswer(job.number, update.calibration, moved=update.moved, cpu_s=cpu_clock() - began)


def _verified(job: SolverJob) -> Calibration:
    """The last answer without the cameras that the rows contradict. Raises Refused where they contradict all of it."""
    assert job.last is not None
    found = triangulate(job.rig, job.last.cameras, job.observations)
    kept = {name: camera for name, camera in job.last.cameras.items() if name in found.sigma_px}
    return Calibration(
        kept,
        job.last.reference,
        job.last.scale,
        job.last.units,
        job.last.solver,
        job.last.version,
        refused=dict(found.unused),
        warnings=found.warnings,
    )
