"""What the live hub has solved elsewhere: one snapshot in, one answer out.

A job is a pure function of its content, so that a worker process, a replay and a test give the same answer bit for bit.

And when the hub gives its next job, how much that searches, and which camera is left out of it.
"""

from __future__ import annotations

import copyreg
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np

from hub.calibration.incremental import Update, update_calibration
from hub.calibration.people.ways import first_complete
from hub.calibration.pipeline import heads_of_people
from hub.calibration.triangulation import triangulate
from hub.clocks.external_prior import ExternalClockPrior
from hub.clocks.observation_stream import AMBIGUOUS_COLOURS
from protocols.core.clocks import NANOSECONDS, CameraTime
from protocols.core.errors import InputError, Refused
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration, stated_up
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_SEARCH_LOAD, _UPDATE_LOAD = 0.6, 0.2
"""CPU seconds of the solver per second before the first answer, and after it: a longer job is followed by a longer
pause."""
_SEARCH_EVERY_S = 4.0
"""Between two searches for cameras that are not tied."""
_FULL_EVERY_S, _FULL_GROWTH = 30.0, 1.5
"""Between two searches over all lags, and the growth of rows from which lenses are decided again."""
_FIRST_FULL_S = 60.0
"""Until the first search over all lags where times of arrival bound them: it takes several seconds, and at a right
arrival it finds nothing more."""
_LEFT_OUT_S = 60.0
"""How long a camera is left out without which the solver does not fail."""
_NOBODY_MET = "none of the people in it was followed together with another camera"
_CAMERAS, _FRAMES = 240, 600
"""Of a job that is not large. Of people who are followed a frame costs 0.01 s of CPU, of a crowd of 25 0.05."""
_UNLIKE_OTHERS = 2.5
"""Times the median camera's residuals of people, as angles: of simulated rigs at most 1.2 as calibrated, and 2.3 to 3.2
where a camera was turned by a degree."""


def _observation(data: bytes) -> pb.Observation:
    return pb.Observation.FromString(data)


copyreg.pickle(pb.Observation, lambda one: (_observation, (one.SerializeToString(),)))  # protobuf's classes are not


@dataclass(frozen=True, slots=True, eq=False)
class SolverJob:
    """A snapshot of what a hub knows.

    last: the answer to start from, with the cameras whose clock and pose hold; None = from scratch. search, full: of
    cameras that are not tied, and refine_lenses: see `update_calibration`. verify: only test whether the rows agree
    with ``last``; given: which was not solved here. people: frames of several unlabelled people; the observations are
    then of those associated by colour. by_place: ``last`` is by where people stand: colours are not tried.
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
    people: tuple[pb.Observation, ...] = ()
    by_place: bool = False
    given: bool = False

    @property
    def compares_places(self) -> bool:
        """Whether where people stand is tried, if colours do not suffice."""
        return bool(self.people) and (self.by_place or self.last is None or self.full or self.verify)

    @property
    def load(self) -> float:
        """Times what a job may cost that is not large."""
        return max(1.0, len(self.rig.cameras) / _CAMERAS, len(self.people) / _FRAMES)


@dataclass(frozen=True, slots=True, eq=False)
class SolverAnswer:
    """What came of a job: a calibration, or why there is none.

    refused: reasons by camera. permanent: more of the same observations cannot help. failed: the solver did not finish
    (an error, its budget, or its process ended). moved: cameras that were moved, and camera times [s] since when.
    observations: of the people who were followed, where it is by where they stand.
    """

    number: int
    calibration: Calibration | None = None
    reason: str = ""
    refused: Mapping[str, str] = field(default_factory=dict)
    permanent: bool = False
    failed: bool = False
    moved: Mapping[str, float] = field(default_factory=dict)
    observations: Observations | None = None
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
        # To begin, whom colours place is enough; the others follow.
        update = first_complete(_ways(job), {one.camera for one in job.people} if job.last else ())
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
    return SolverAnswer(
        job.number, update.calibration, moved=update.moved, observations=update.observations, cpu_s=cpu_clock() - began
    )


def _ways(job: SolverJob) -> list[Callable[[], Update]]:
    """How a job's answer is looked for, in this order.

    An answer by colours goes on so; those whom these leave out are looked for by place with the searches over all lags.
    """
    if job.given and job.people:
        return [partial(_tested, job)]
    ways: list[Callable[[], Update]] = [] if job.by_place and job.people else [partial(_by_labels, job)]
    if job.compares_places:
        ways.append(partial(_by_place, job))
    return ways


def _by_labels(job: SolverJob) -> Update:
    """The answer by the job's observations."""
    if job.people and not len(job.observations):
        raise Refused(AMBIGUOUS_COLOURS)
    if job.verify:
        return Update(_verified(job))
    return update_calibration(
        job.rig,
        job.observations,
        job.last,
        search=job.search,
        full=job.full,
        clock_priors=job.clock_priors,
        arrivals=job.arrivals,
        refine_lenses=job.refine_lenses,
    )


def _by_place(job: SolverJob) -> Update:
    """The answer by where people stand; from the last one on those are followed who meet at its lags."""
    from hub.calibration.people.unlabelled import calibrate_people, follow_people

    if job.last is None:
        common = {**({} if job.full else job.arrivals), **job.clock_priors}
        found, observations = calibrate_people(job.rig, job.people, priors=common)
        return Update(found, observations=observations)
    people = [one for one in job.people if job.search or one.camera in job.last.cameras]
    try:
        clocks = () if job.full else (job.arrivals, job.clock_priors)
        followed = follow_people(job.rig, people, priors=_at_its_lags(job.last, people, clocks))
    except Refused as refusal:  # that nobody is seen by two cameras contradicts no camera
        raise Refused(refusal.reason) from refusal
    update = _by_labels(replace(job, observations=followed.observations))
    found, met = update.calibration, set(followed.observations.cameras)
    refused = {name: why if name in met else _NOBODY_MET for name, why in found.refused.items()} | followed.refused
    found = replace(found, refused={name: refused[name] for name in found.refused})
    return replace(update, calibration=found, observations=followed.observations)


def _tested(job: SolverJob) -> Update:
    """A given calibration without the cameras that labelled points contradict, and warnings, also by people's feet."""
    found, refusals = list[Calibration](), list[Refused]()
    for way in (_by_labels, _by_feet):
        try:
            found.append(way(job).calibration)
        except Refused as refused:
            if refused.permanent:
                raise
            refusals.append(refused)
    if not found:
        raise refusals[0]
    return Update(replace(found[0], warnings=tuple(text for one in found for text in one.warnings)))


def _by_feet(job: SolverJob) -> Update:
    """The given calibration, with a warning of a camera that was turned. Raises Refused where people say too little."""
    from hub.calibration.people.feet import level_ground
    from hub.calibration.people.turned_camera import turned_people

    given = job.last
    assert given is not None
    if given.scale != "metric":
        raise Refused("the places of people test only a metric calibration")
    warnings = turned_people(job.people, given, *level_ground(job.people, given, stated_up(job.rig, given.cameras)))
    if warnings is None:
        raise Refused("too few people are where two cameras look")
    return Update(replace(given, refused={}, warnings=warnings))


def _at_its_lags(
    last: Calibration, people: Sequence[pb.Observation], clocks: Iterable[Mapping[str, ExternalClockPrior]]
) -> dict[str, ExternalClockPrior]:
    """Priors of all clocks on the reference clock of an answer: its own lags, and others' by each of some clocks.

    clocks: priors on the hub's clock, by arrival, and on Unix time; the later count.
    """
    newest = {one.camera: CameraTime(one.device_time_ns / NANOSECONDS) for one in people}
    lags = {
        name: float(one.time_map.reference_from_camera(newest[name])) - newest[name]
        for name, one in last.cameras.items()
        if name in newest
    }
    found = {name: ExternalClockPrior("", lag, 0.0) for name, lag in lags.items()}
    for common in clocks:
        shifts = [common[name].unix_minus_camera - lag for name, lag in lags.items() if name in common]
        shift = float(np.median(shifts)) if shifts else 0.0
        found |= {
            name: replace(one, unix_minus_camera=one.unix_minus_camera - shift, error_bound=2.0 * one.error_bound)
            for name, one in common.items()
            if shifts and name not in lags
        }
    return found


def _verified(job: SolverJob) -> Calibration:
    """The last answer without the cameras that the rows contradict. Raises Refused where they contradict all of it."""
    assert job.last is not None
    of_people = job.rig.metadata.get("target") == "person"
    # Residuals of people are compared with each other: those of the marker it was calibrated with say nothing of them.
    heard = {
        name: replace(camera, rms_px=0.0) if of_people else camera
        for name, camera in job.last.cameras.items()
        if name in job.rig.cameras
    }
    found = triangulate(job.rig, heard, heads_of_people(job.rig, job.observations))
    kept = {name: camera for name, camera in job.last.cameras.items() if name not in found.contradicted}
    return Calibration(
        kept,
        job.last.reference,
        job.last.scale,
        job.last.units,
        job.last.solver,
        job.last.version,
        refused={name: found.unused[name] for name in found.contradicted},
        warnings=(*found.warnings, *(_unlike_others(found.sigma_px, heard) if of_people else ())),
    )


def _unlike_others(sigma_px: Mapping[str, float], cameras: Mapping[str, CameraCalibration]) -> tuple[str, ...]:
    """Warnings of cameras whose people fit far worse, as angles, than the others'; it takes three cameras."""
    sigmas = {name: sigma / float(cameras[name].intrinsics.matrix[0, 0]) for name, sigma in sigma_px.items()}
    typical = float(np.median(list(sigmas.values())))
    return tuple(
        f"{name}: residuals of {1e3 * sigma:.1f} mrad, {1e3 * typical:.1f} mrad of the median camera: was it moved?"
        for name, sigma in sigmas.items()
        if sigma > _UNLIKE_OTHERS * typical
    )


@dataclass(slots=True)
class JobSchedule:
    """next: hub time [s] of the next job. solved_at: messages received at the last one. left_out: a camera without
    which the solver does not fail, or ""."""

    next: float = 0.0
    solved_at: int = -1
    left_out: str = ""
    _next_search: float = 0.0
    _next_full: float = 0.0
    _full_rows: int = 0
    _left_out_until: float = 0.0
    _suspects: list[str] = field(default_factory=list)

    def plan(
        self, now: float, *, final: bool, first: bool, untied: bool, rows: int, has_arrivals: bool
    ) -> tuple[bool, bool]:
        """Whether the job searches for cameras, and over all lags.

        final: the last job. first: no camera is tied yet; untied: some are not. rows: of the job. has_arrivals: times
        of arrival bound the lags.
        """
        search = untied and (final or now >= self._next_search)
        if first and has_arrivals and not self._next_full:
            self._next_full = now + _FIRST_FULL_S
        full = (search and (final or now >= self._next_full)) or (not first and rows > _FULL_GROWTH * self._full_rows)
        if search:
            self._next_search = now + _SEARCH_EVERY_S
        if full:
            self._next_full, self._full_rows = now + _FULL_EVERY_S, rows
        return search or first, full or (first and not has_arrivals)

    def pause(self, submitted_at: float, cpu_s: float, *, calibrated: bool) -> None:
        """Put the next job off after one that took so much CPU [s]."""
        self.next = max(self.next, submitted_at + cpu_s / (_UPDATE_LOAD if calibrated else _SEARCH_LOAD))

    def suspect(self, job: SolverJob, tied: Collection[str], now: float) -> None:
        """Leave one camera of a job that failed out, first those that are not tied, each in turn."""
        if not self._suspects:
            self._suspects = (
                sorted(job.rig.cameras, key=lambda name: name in tied) if len(job.rig.cameras) > 2 else [""]
            )
        self.left_out, self._left_out_until = self._suspects.pop(0), now + _LEFT_OUT_S

    def clear_suspects(self) -> None:
        """After a job that did not fail."""
        self._suspects = []

    def readmit(self, now: float) -> None:
        """Give a camera that was left out long enough another try."""
        if self.left_out and now >= self._left_out_until:
            self.left_out = ""
