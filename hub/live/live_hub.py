"""Live calibration: collects observations and has them solved elsewhere, every second or two.

No sockets, threads, files or wall clock: ``handle`` takes messages, ``tick(now)`` returns messages; jobs go to a
`Solver`, in a worker process for an agent, inline for replays and tests. ``tick`` never waits for it.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from google.protobuf.message import Message

from hub.bundle.problem import LARGE_NETWORK
from hub.calibration.coverage import CoverageMonitor
from hub.calibration.resection.unconnected import listed
from hub.clocks.observation_stream import AMBIGUOUS_COLOURS, LEAST_ROWS, ObservationStream
from hub.distributed.network.host import NodeHost
from hub.distributed.solver import node_calibration
from hub.live.budgets import CameraBudgets
from hub.live.camera_links import CameraLinks
from hub.live.messages import calibration_message, refusal_message, solver_event
from hub.live.reloaded import VERIFY_ROWS, ReloadedCalibration
from hub.live.solver import InlineSolver, JobSchedule, Solver, SolverAnswer, SolverJob
from hub.tracking.calibration.people import PeopleTracklets
from hub.tracking.live_tracking import LiveTracking
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError, Refused
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import LONG_FILM_S, SessionBuilder
from protocols.session.calibration import Calibration, CameraCalibration, stated_calibration, stated_up
from protocols.session.folder import pixel_faults, small_pictures
from protocols.session.observations import Observations
from protocols.session.rig import Rig, RigCamera

HubState = Literal["collecting", "searching", "calibrated", "degraded", "refused"]

_MIN_PEOPLE_S = 40.0
"""Total duration of people's tracklets [s] that two cameras need before people-based calibration is tried."""
_MIN_FILM_S, _COLOURS_FILM_S = 20.0, 40.0
"""Film of two cameras from which on where people stand says where cameras are (in less they meet by chance), and where
they have colours to tell them by, which take a tenth of the CPU, but longer where few people pass."""
_FRAME_CPU_S = 0.007
"""CPU of a frame of unlabelled people: where it is not measured, as in a replay, jobs pause for as long."""
_FILM_PER_CAMERA_S = 0.1
"""Film [s] that each camera adds to what the first job needs: its share of that job's CPU, 0.08 to 0.13 s."""
_BEHIND_S = 10.0
"""A job that takes longer than this degrades a calibrated hub: warm ones take about a second."""
SILENT_S = 3.0
"""A camera without a frame for longer than this degrades the hub."""
_VERIFY_EVERY_S = 0.5  # s: between two tests of a reloaded answer
_CHECK_EVERY_S, _CHECK_LOAD, _CHECKED_S = 20.0, 0.5, 60.0
"""Between two tests of a given calibration, less often where they take more than this share of a core; and the newest
rows that each is by: a camera that was moved is named once they are more than those before."""
_BUDGET_NOTICE_S = 10.0
"""How long the status names a camera that exceeded its budget."""
_MOVED_NOTICE_S = 600.0
"""How long the status names a camera that was moved [s]: until somebody who comes by has read it."""
_UNSEEN = "pose and clock are of an earlier answer, no detections since"
_OTHER_CLOCK = "restarted and not located since"
_RESTARTED = f"{_OTHER_CLOCK}: pose and clock are of an earlier answer, before the restart"
_MAX_STD_GROWTH = 1.5
"""An answer whose stds are larger than the present one's by this factor is not taken: its rows say less."""


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """window_s: total duration of the observations that are kept. interval_s: least time between two solves.

    least_rows: detections that two cameras need before solving is tried. solve: whether timing is estimated here; if
    not, only pose nodes run, on a shared clock or on another hub's timing. track: whether people, vehicles and
    markers are tracked as soon as there is a calibration. refine_lenses: whether measured lenses may change.
    """

    window_s: float = 180.0
    interval_s: float = 2.0
    least_rows: int = LEAST_ROWS
    solve: bool = True
    track: bool = True
    refine_lenses: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class KnownCalibration:
    """A given, fixed calibration: poses, intrinsics and clocks. rig: as read from calibration.toml."""

    rig: Rig
    cameras: dict[str, CameraCalibration]


class LiveHub:
    """Collects observations and calibrates the cameras repeatedly.

    rig: from the hub's own rig.toml: control points, distances, up; intrinsics come from the cameras unless it has
    them. nodes: this hub's pose nodes; where this hub does not solve, the published calibration is theirs. known: a
    given calibration: then nothing is solved. solver: of the jobs. agent: name of this hub in its messages.
    """

    def __init__(
        self,
        settings: LiveSettings | None = None,
        rig: Rig | None = None,
        nodes: NodeHost | None = None,
        known: KnownCalibration | None = None,
        solver: Solver | None = None,
    ) -> None:
        self.settings = settings or LiveSettings()
        self._rig = rig
        self.nodes = nodes
        if nodes is not None and rig is not None and rig.shared_clock:
            nodes.use_shared_clock()
        self.solver = solver or InlineSolver()
        self._revision = 0
        self._jobs = self._superseded = 0
        self._now = 0.0
        self.counters: Counter[str] = Counter()
        self.stream = ObservationStream(self.settings.window_s)
        self.links = CameraLinks()
        self._earlier_delays: dict[str, float] = {}
        self._clock_stepped = False
        self.guidance = CoverageMonitor()
        self._known = known
        self.notice = ""
        """What the agent around has to say of its own health."""
        self.finished = False
        """Whether the last job was handed over, or there is none."""
        self.is_shard = False
        """Whether this hub is one of several (`Shard`): tracks are in the world of all of them."""
        self.budgets = CameraBudgets()
        self._begin()

    def _begin(self) -> None:
        """No observations and no result."""
        self.stream.forget()
        self.links.compare_anew()
        self.tracking = LiveTracking() if self.settings.track else None
        self._schedule, self._received = JobSchedule(), 0
        self._submitted: SolverJob | None = None
        self._submitted_at = 0.0
        self._submitted_boots: dict[str, str] = {}
        self._answer_rows = 0.0
        self._by_place, self._followed = False, dict[str, int]()
        """Whether the present answer is by where unlabelled people stand; their newest frames in the last job [ns]."""
        self.calibration: Calibration | None = None
        self.session: tuple[Rig, Observations] | None = None
        self.refusal: Refused | None = None
        self.solver_failure = ""
        self._next_check, self._known_faults = 0.0, list[str]()
        self._pixel_faults: dict[str, str] = {}
        """By camera, why its rows are not used; by "", what is to be checked of all of them."""
        self.calibrated_at = self._now
        """When the present calibration was estimated or, of a given one, began to be used."""
        self._solved_boot_ids: dict[str, str] = {}
        self._restarted: dict[str, CameraCalibration] = {}
        """By camera whose clock is another one since, until it is located again: as it was before."""
        self._moved = dict[str, float]()
        """Cameras that were moved since they were first located, and when that was last found [s]."""
        self._rig_cameras: dict[str, RigCamera] = {}
        """Of all answers so far, the reloaded one included."""
        self._reloaded: ReloadedCalibration | None = None
        if self._known is not None:
            self._use_known(self._known)

    def handle(self, message: Message, arrival: float | None = None, *, backlog: bool = False) -> None:
        """Process one message from the bus or a log.

        arrival: its arrival time [s, any fixed clock]; None = unknown. backlog: it may have waited for this hub, so its
        arrival says little about its camera's clock. Whatever a camera sends costs that camera: an error in it is
        counted, and after some of them its messages are left out until its agent is restarted.
        """
        if isinstance(message, pb.Observation | pb.CameraInfo) and self.links.is_left_out(message):
            return
        if isinstance(message, pb.Observation):
            if not backlog and self.budgets.admits_camera(message.camera):
                repeated = self.stream.marker.repeated.get(message.camera, (0, 0, 0))
                self.links.compare_rates(message, arrival, repeated)
            admitted = self.budgets.admit(message, self._now)
            if admitted is None:
                room = self.budgets.admits_camera(message.camera)
                self.counters["over_budget" if room else "too_many_cameras"] += 1
                return
            message = admitted
        elif isinstance(message, pb.CameraInfo) and not self.budgets.admits_camera(message.camera):
            self.counters["too_many_cameras"] += 1
            return
        try:
            self._handle(message, arrival, backlog)
        except Exception as error:  # noqa: BLE001 - of whatever kind it is, it must not cost the other cameras
            self.counters["faults"] += 1
            self.links.record_fault(message, error)

    def _handle(self, message: Message, arrival: float | None, backlog: bool) -> None:
        if isinstance(message, pb.AgentStatus):
            self.stream.clock_priors.handle(message)
            return
        if isinstance(message, pb.Observation):
            message, event = self.stream.assign(message, arrival, backlog=backlog)
            if event is not None:
                self.counters[f"clock_{event.kind}s"] += 1
                self._clock_stepped = True
            self.links.receive(message, self._now, arrival, backlog=backlog)
        self.guidance.handle(message)
        stored = self.stream.store(message, self._now, self._admits_people)
        if self.tracking is not None:
            self.tracking.handle(message, stored is not message)
        if self.nodes is not None:
            self.nodes.handle(stored)
        if isinstance(message, pb.Observation):
            self._received += 1
            self.counters["observations"] += 1

    def _admits_people(self, message: pb.Observation) -> bool:
        admitted = self.budgets.admits_people(message)
        if not admitted:
            self.counters["people_over_budget"] += 1
        return admitted

    def reset(self) -> None:
        """Forget observations and results, as after the rig was rebuilt; clock state and message numbering are kept."""
        self._superseded = self._jobs
        self.guidance.reset()
        self._begin()

    def release(self, cameras: Collection[str]) -> None:
        """Forget cameras that another hub has now."""
        for name in cameras:
            self.stream.release(name)
            self.links.forget(name)
            self._restarted.pop(name, None)
            self._moved.pop(name, None)
            self._rig_cameras.pop(name, None)
        if self.calibration is not None:
            kept = {name: one for name, one in self.calibration.cameras.items() if name not in cameras}
            self.calibration = replace(self.calibration, cameras=kept) if len(kept) > 1 else None

    def forget_silent(self, now: float) -> list[str]:
        """Forget the cameras that send no frames, as those that were taken away or renamed; their names, in order.

        A given calibration is kept as it is, and so are the cameras that hubs share.
        """
        silent = [name for name, age in self.frame_ages(now).items() if age > SILENT_S]
        heard = {*self.stream.marker.cameras, *(() if self.calibration is None else self.calibration.cameras)}
        names = sorted({*silent, *(heard - self.links.last_frame.keys())})
        if self._known is not None or self.is_shard or not names:
            return []
        self._superseded, self._answer_rows, self._reloaded = self._jobs, 0.0, None  # they may be in a job under way
        self.release(names)
        for name in names:
            self.guidance.forget(name)
            self._pixel_faults.pop(name, None)
        if self.calibration is not None:
            left = {name: why for name, why in self.calibration.refused.items() if name not in names}
            warnings = tuple(one for one in self.calibration.warnings if not one.endswith(_UNSEEN))
            self.calibration = replace(self.calibration, refused=left, warnings=warnings)
            self._clock_stepped = True  # published with the next tick
        return names

    def adopt(self, calibration: Calibration, boot_ids: Mapping[str, str]) -> None:
        """Go on from another hub's answer, about other cameras than before. boot_ids: of the clocks of its maps."""
        self._superseded, self._answer_rows, self._reloaded, self.refusal = self._jobs, 0.0, None, None
        self.calibration = calibration if len(calibration.cameras) > 1 else None
        self._solved_boot_ids, self._restarted = dict(boot_ids), {}
        self._clock_stepped = self.calibration is not None  # published with the next tick

    def reload(
        self,
        calibration: Calibration,
        boot_ids: dict[str, str],
        delays: dict[str, float],
        rig: Rig | None = None,
        *,
        arrival: float | None = None,
    ) -> None:
        """Go on with an earlier answer, unverified until the first consistent second.

        boot_ids, delays, rig: of its cameras then; those that were restarted since, or whose clock was set, are left
        out. arrival: the hub's clock at those delays [s]; where it is given, such cameras come to their new clocks by
        the delays then and now. A hub that was killed tracks again at once.
        """
        if self._known is None and self.calibration is None:
            self._reloaded = ReloadedCalibration(calibration, dict(boot_ids), dict(delays), arrival)
            self._earlier_delays = dict(delays)
            if rig is not None:
                self._rig_cameras = {name: unplaced(camera) for name, camera in rig.cameras.items()}

    def clock_contradictions(self) -> list[str]:
        """Cameras whose external clock prior (NTP/PTP) the calibration contradicts, one line each."""
        if self.calibration is None:
            return []
        return self.stream.clock_priors.contradictions(self.calibration, self._solved_boot_ids)

    def missing(self) -> str:
        """What is missing before solving is tried; "" if nothing."""
        cameras = self.stream.marker.cameras
        if self.unverified:
            assert self._reloaded is not None
            enough = self._can_verify(self._reloaded.calibration)
            return "" if enough else "verifying the reloaded calibration"
        if len(cameras) < 2:
            return f"{len(cameras)} of at least 2 cameras heard of"
        rows_by_camera = {name: self.stream.marker.rows(name) for name in cameras}
        ready = [name for name, rows in rows_by_camera.items() if rows >= self.settings.least_rows]
        film, least = self.stream.marker.film_s, min(_FILM_PER_CAMERA_S * len(cameras), LONG_FILM_S)
        if self.calibration is None and film < least:
            return f"filmed for {film:.3g} s yet: {len(cameras)} cameras need {least:.3g} s"
        if len(ready) < 2 and self.stream.people.cameras:
            durations = {name: self.stream.people.seconds(name) for name in self.stream.people.cameras}
            if sum(seconds >= _MIN_PEOPLE_S for seconds in durations.values()) < 2:
                counts = listed(f"{name} {seconds:.0f} s" for name, seconds in durations.items())
                return f"people observed too briefly yet ({counts}; two cameras need {_MIN_PEOPLE_S:.0f} s): walk about"
            return ""
        if len(ready) < 2:
            counts = listed(f"{name} {rows}" for name, rows in rows_by_camera.items())
            what = self.guidance.instruction()
            return f"too few detections yet ({counts}; two cameras need {self.settings.least_rows}): {what}"
        return ""

    def tick(self, now: float, final: bool = False) -> list[Message]:
        """The messages to publish at time ``now`` [s, any monotonic clock]; hands a job over when due.

        final: hand a last job over, with all observations; tick again until ``solver`` is not busy.
        """
        self._now = max(self._now, now)
        out: list[Message] = []
        if final and not self.solver.busy:
            self.finished = True
        out += self._calibrate(now, final)
        out += self._poll(now)
        return out + self._track(now)

    def _track(self, now: float) -> list[Message]:
        if self.tracking is None:
            return []
        try:
            return self.tracking.tick(now)
        except Exception as error:  # noqa: BLE001 - tracks begin anew; calibration and status go on
            self.counters["tracking_faults"] += 1
            self.tracking = LiveTracking()
            if self.calibration is not None:
                self.track_with(*self._tracked_with)
            self.links.notices["tracking"] = f"tracking began anew: {type(error).__name__}: {error}"[:200]
            return []

    def _poll(self, now: float) -> list[Message]:
        answer = self.solver.poll(now)
        return [] if answer is None else self._take(answer, now)

    @property
    def results(self) -> int:
        """Answers so far that gave a calibration or a refusal."""
        return self.counters["solved"] + self.counters["refused"]

    def waiting(self, now: float) -> list[Message]:
        """While there is no calibration: what the hub does, and how far each camera is."""
        if self.calibration is not None:
            return []
        self._revision += 1
        state, reason = self.state(now)
        return [self._waiting(reason, state)]

    @property
    def boot_ids(self) -> dict[str, str]:
        """By calibrated camera, the boot whose clock the calibration refers to."""
        return dict(self._solved_boot_ids)

    @property
    def delays(self) -> dict[str, float]:
        """By camera, the last known delay [s] (`CameraLinks`), also of those not heard since this hub was started.

        Not of those in another run than the one that `boot_ids` says.
        """
        delays = self._earlier_delays | self.links.delays
        return {name: delay for name, delay in delays.items() if name not in self._restarted}

    def for_files(self) -> tuple[Calibration, Rig, Observations] | None:
        """The present answer and the session that it is of; None without one.

        With the last poses of the cameras that were restarted and are not located again: whoever copies the file in
        that moment does not lose them.
        """
        if self.calibration is None or self.session is None:
            return None
        found, (rig, observations) = self.calibration, self.session
        if self._restarted:
            found = replace(
                found,
                cameras=found.cameras | self._restarted,
                refused={name: why for name, why in found.refused.items() if name not in self._restarted},
                warnings=(*found.warnings, f"{listed(sorted(self._restarted))}: {_RESTARTED}"),
            )
        cameras = {name: one for name, one in self._rig_cameras.items() if name in found.cameras} | rig.cameras
        return found, replace(rig, cameras=cameras), observations

    @property
    def unverified(self) -> bool:
        """Whether the present calibration was reloaded and not verified yet."""
        return self._reloaded is not None and self.calibration is not None

    def state(self, now: float) -> tuple[HubState, str]:
        """What the hub does at ``now``, and one line for a person."""
        reasons = self.degradations(now)
        if self.calibration is not None:
            cameras = self.calibration.cameras
            count = f"{len(cameras)} cameras calibrated{self._moved_lately(cameras, now)}"
            return ("degraded", "; ".join([*reasons, count])) if reasons else ("calibrated", count)
        if missing := self.missing():
            return "collecting", "; ".join([*reasons, missing])
        text = "comparing all lags" if self.refusal is None else self.refusal.reason
        permanent = self.refusal is not None and self.refusal.permanent
        return "refused" if permanent else "searching", "; ".join([*reasons, text])

    def frame_ages(self, now: float) -> dict[str, float]:
        """Seconds since the last frame of each camera that is calibrated or was heard of lately."""
        return self.links.ages(now, () if self.calibration is None else self.calibration.cameras)

    def unmatched(self, now: float) -> str:
        """Cameras of the hub's rig.toml that are not heard while others are, as with a wrong name; "" if none."""
        given = {} if self._rig is None or self._known is not None else self._rig.cameras
        heard = self.frame_ages(now)
        absent, others = [name for name in given if name not in heard], [name for name in heard if name not in given]
        return f"not heard of rig's {listed(absent)}; not in it: {listed(others)}" if absent and others else ""

    def _on_other_clocks(self) -> list[str]:
        """Calibrated cameras whose present run is not the one that the answer's clocks are of."""
        if self.calibration is None or not self._solved_boot_ids:
            return []
        present, boots = self._in_present_segments(self.calibration)[1], self.links.boots
        return sorted(name for name, boot in present.items() if boots.get(name, boot) != boot)

    def _moved_lately(self, cameras: Collection[str], now: float) -> str:
        """Which of the calibrated cameras were found to have been moved in the last minutes, for the status; or ""."""
        found = {name: now - self._moved[name] for name in sorted(self._moved.keys() & cameras)}
        ages = {name: age for name, age in found.items() if age < _MOVED_NOTICE_S}
        if len(ages) == len(cameras) == 2 and len(set(ages.values())) == 1:  # it does not show which one
            return f", one of them moved {min(ages.values()):.0f} s ago"
        return f", moved: {listed(f'{name} ({age:.0f} s ago)' for name, age in ages.items())}" if ages else ""

    def _moved_from_references(self) -> list[str]:
        """Cameras that were moved, with a position, a rotation or a distance that was measured before."""
        if self.session is None:
            return []
        rig = self.session[0]
        ends = {name for one in rig.distances for name in one[:2]}
        return sorted(
            one for one in self._moved.keys() & rig.cameras.keys() if one in ends or rig.cameras[one].pose_table()
        )

    def offset_stds(self) -> dict[str, float]:
        """Standard deviation [s] of each calibrated camera's time offset."""
        cameras = {} if self.calibration is None else self.calibration.cameras
        return {name: camera.time_offset_std for name, camera in cameras.items()}

    def degradations(self, now: float) -> list[str]:
        """What impairs a calibrated hub at ``now``, one line each."""
        out = []
        if self.unverified:
            out.append("the calibration was reloaded and is not verified yet")
        ages = self.frame_ages(now)
        never = [] if self.calibration is None else [name for name in self.calibration.cameras if name not in ages]
        silent = [f"{name} ({age:.0f} s)" for name, age in ages.items() if age > SILENT_S]
        silent += [f"{name} (none since this hub was started)" for name in never]
        out += [f"no frames from {listed(silent)}"] if silent else []
        if restarted := sorted({*self._on_other_clocks(), *self._restarted}):
            out.append(f"{listed(restarted)}: {_OTHER_CLOCK}")
        if outdated := self._moved_from_references():
            out.append(f"{listed(outdated)}: moved from where the rig's references say; measure again, restart the hub")
        exceeding = self.budgets.exceeded(now, _BUDGET_NOTICE_S)
        if exceeding:
            out.append(f"frames left out of {listed(exceeding)}: more than a camera may send")
        if self._schedule.left_out:
            out.append(f"{self._schedule.left_out} is left out: the solver failed with its rows")
        out += [*self.links.notices.values(), *self.links.standing.values(), *self._pixel_faults.values()][:8]
        if self._known is not None:
            out += list(self._other_sizes().values())[:8]
        if self._known_faults:
            out.append(f"the given calibration: {'; '.join(self._known_faults[:4])}")
        load = 1.0 if self._submitted is None else self._submitted.load
        if self.solver.busy and now - self._submitted_at > load * _BEHIND_S:
            out.append(f"the solver is behind: {now - self._submitted_at:.0f} s for one job")
        return out + [text for text in (self.solver_failure, self.notice) if text]

    def progress(self) -> list[pb.CameraProgress]:
        """How far each camera is."""
        refused = {} if self.refusal is None else self.refusal.cameras
        tied = {} if self.calibration is None else self.calibration.cameras
        waiting = {} if self.calibration is None else self.calibration.refused
        out = []
        shared, of_people = self.stream.marker.shared_motions_s(), not self._has_marker()
        restarted = self._on_other_clocks()
        for name in self.stream.marker.cameras:
            fault = self.links.standing.get(name) or self._pixel_faults.get(name)
            reason = fault or waiting.get(name, refused.get(name, ""))
            rows, least, what = float(self.stream.marker.rows(name)), float(self.settings.least_rows), "detections"
            if of_people:
                rows, least, what = self.stream.people.seconds(name), _MIN_PEOPLE_S, "s of people"
            state = "searching" if rows >= least else "collecting"
            if not self.stream.has_info(name):
                reason = "no CameraInfo yet: it holds the image size and the lens"
            elif state == "collecting" and not reason:
                reason = f"{rows:.0f} of {least:.0f} {what}"
            if name in tied:
                silent = self._now - self.links.last_frame.get(name, self._now) > SILENT_S
                state, reason = ("degraded", "no frames") if silent else ("calibrated", "")
                if name in restarted and not silent:
                    state, reason = "searching", _OTHER_CLOCK
            out.append(
                pb.CameraProgress(
                    camera=name,
                    state=state,
                    shared_motion_s=shared.get(name, 0.0),
                    coverage=self.guidance.coverage(name),
                    reason=reason[:300],
                )
            )
        return out

    def _calibrate(self, now: float, final: bool) -> list[Message]:
        if self._clock_stepped and self.calibration is not None:
            # After a clock step, the transformed calibration is published at once, before the new segment is solved.
            self._clock_stepped = False
            return self._publish_present()
        if self._reloaded is not None and self.calibration is None:
            reloaded = self._publish_reloaded(self._reloaded)
            if reloaded:
                return reloaded
        busy = self.solver.busy
        if (busy and self._known is None) or (not final and now < self._schedule.next):
            return []
        self._schedule.next = now + (_VERIFY_EVERY_S if self.unverified else self.settings.interval_s)
        if self._known is not None:
            if not (final or busy):
                self._check_known(now)
            return self._publish_present(changed=False)
        if not self.settings.solve:
            return self._use_nodes()
        if self._schedule.solved_at == self._received and not final:
            return []
        missing = self.missing()
        if missing:
            self._revision += 1
            return [self._waiting(missing, "collecting")]
        return self._submit(now, final)

    def _submit(self, now: float, final: bool) -> list[Message]:
        """Hand the present observations to the solver; a final job searches for every camera that is not tied."""
        try:
            heard, observations, people = self._build_session()
            newest = {one.camera: one.device_time_ns for one in people}
            if people and newest.items() <= self._followed.items() and not final:
                return []  # nobody was in view since
            rig, observations = self._without_other_pixels(heard, observations, people)
        except Refused as refusal:
            self.refusal = refusal
            return []
        except Exception as error:  # noqa: BLE001 - whatever is wrong with the rows must not stop the hub
            self.refusal = self._bad_session(error)
            return []
        self._schedule.readmit(now)
        left_out = self._schedule.left_out
        if left_out in rig.cameras and len(rig.cameras) > 2:
            rig, observations = without_camera(rig, observations, left_out)
        self._followed, people = newest, tuple(one for one in people if one.camera in rig.cameras)
        source = self._source()
        boots = {name: source.boot(name) for name in rig.cameras}
        last = self._start_from(boots)
        self._schedule.solved_at = self._received
        arrivals = self.stream.arrivals(boots)
        search, full = self._schedule.plan(
            now,
            final=final,
            first=last is None,
            untied=last is None or not last.cameras.keys() >= {*observations.cameras, *(one.camera for one in people)},
            rows=max(len(observations), len(people)),
            has_arrivals=bool(arrivals),
        )
        if not self.unverified:
            self._reloaded = None  # there are enough rows for an answer of their own
        start = last if self._reloaded is None else self._reloaded.on_clocks(boots)
        if start is not None:  # what is left out may have been moved: only what is not heard stays as it was
            kept = {
                name: one for name, one in start.cameras.items() if name in rig.cameras or name not in heard.cameras
            }
            # A walker's number is its job's: under it another one's path would be taken for the one published before.
            start = replace(start, cameras=kept, trajectories=start.trajectories if self._has_marker() else ())
        job = SolverJob(
            self._jobs + 1,
            rig,
            observations,
            start,
            search,
            full,
            self._reloaded is not None,
            self.stream.clock_priors.for_boots(boots),
            arrivals,
            self.settings.refine_lenses,
            people,
            self._by_place,
        )
        ranges = [one for one in self.stream.marker.ranges() if one[0] in rig.cameras] if self._has_marker() else []
        return self._hand_over(job, boots, ranges, now)

    def _bad_session(self, error: Exception) -> Refused:
        """Count an error in the rows; as a refusal."""
        self.counters["bad_sessions"] += 1
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        refusal = Refused(f"{kind}{error}")
        if self.calibration is not None:
            self.solver_failure = refusal.reason
        return refusal

    def _check_known(self, now: float) -> None:
        """Have the given calibration tested by the newest rows; the answer is for the status."""
        assert self.calibration is not None
        if now < self._next_check or not self._can_verify(self.calibration):
            return
        self._next_check = now + _CHECK_EVERY_S
        try:
            # Rows from before a camera was moved would speak for it, those with much motion for half an hour.
            rig, observations, people = self._build_session(_CHECKED_S)
        except Refused:
            return
        except Exception as error:  # noqa: BLE001 - whatever is wrong with the rows must not stop the hub
            self._bad_session(error)
            return
        self.solver_failure = ""
        assert self._rig is not None
        source = self._source()
        present, _ = self._in_present_segments(self.calibration, {name: source.boot(name) for name in rig.cameras})
        tracks = {key: one for key, one in observations.tracks.items() if key[0] in present.cameras}
        observations = replace(observations, tracks=tracks)
        self._jobs += 1
        rig = replace(self._rig, metadata=rig.metadata)
        since = {one.camera: one.device_time_ns - _CHECKED_S * NANOSECONDS for one in people}
        people = tuple(
            one for one in people if one.camera in present.cameras and one.device_time_ns > since[one.camera]
        )
        job = SolverJob(self._jobs, rig, observations, present, verify=True, given=True, people=people)
        self._submitted, self._submitted_at, self._submitted_boots = job, now, {}
        self.solver.submit(job, now)

    def _take_check(self, answer: SolverAnswer, now: float) -> None:
        """What the present rows say of the given calibration; that they say too little is no news."""
        self._next_check = max(self._next_check, now + answer.cpu_s / _CHECK_LOAD)
        self.solver_failure = answer.reason if answer.failed else ""
        found = answer.calibration
        if found is None:
            self._known_faults = [answer.reason] if answer.permanent else self._known_faults
            return
        self._known_faults = [*(f"{name}: {why}" for name, why in found.refused.items()), *found.warnings]

    def _hand_over(
        self, job: SolverJob, boots: dict[str, str], ranges: list[tuple[str, str, int, int, int]], now: float
    ) -> list[Message]:
        self._jobs = job.number
        if self._reloaded is not None and self._reloaded.since is None:
            self._reloaded.since = now
        if self.calibration is None:
            self.session = job.rig, job.observations
        self._submitted, self._submitted_at, self._submitted_boots = job, now, boots
        self.solver.submit(job, now)
        return [solver_event(job, "submitted", ranges)]

    def _start_from(self, boots: Mapping[str, str]) -> Calibration | None:
        """The present answer with the cameras whose clock is still the one that the observations are on."""
        if self.calibration is None:
            return None
        then, found = self._in_present_segments(self.calibration, until=boots)
        # One that is not heard since this hub was started stays as it was reloaded.
        kept = {
            name: camera
            for name, camera in then.cameras.items()
            if found[name] == boots.get(name, self._solved_boot_ids.get(name))
        }
        heard = sum(name in boots for name in kept)
        # Most of a large network in one search cost less than a search for each of them.
        begins_anew = len(boots) > LARGE_NETWORK and 2 * heard < len(boots)
        return replace(then, cameras=kept) if heard > 1 and not begins_anew else None

    def _take(self, answer: SolverAnswer, now: float) -> list[Message]:
        """Use an answer: the calibration that it gives, or why there is none."""
        job, boots = self._submitted, self._submitted_boots
        self._submitted = None
        if self._known is not None:
            self._take_check(answer, now)
            return []
        tied, cameras = (len(one.cameras) if one else 0 for one in (self.calibration, job and job.rig))
        cpu_s = answer.cpu_s
        if job is not None and job.compares_places and (answer.observations is not None or answer.calibration is None):
            cpu_s = max(cpu_s, _FRAME_CPU_S * len(job.people))
        self._schedule.pause(self._submitted_at, cpu_s, calibrated=2 * tied > cameras)
        if job is None or answer.number <= self._superseded:
            return []
        self.solver_failure = answer.reason if answer.failed else ""
        if answer.failed:
            self.counters["solver_failures"] += 1
            if job.verify and (self._reloaded is None or self._reloaded.has_failed(now)):
                self._reloaded, self.calibration = None, None  # searched from scratch, whatever the solver stumbles at
            self._schedule.suspect(job, () if self.calibration is None else self.calibration.cameras, now)
            return [solver_event(job, "failed", [], answer)]
        self._schedule.clear_suspects()
        event = solver_event(job, "applied", [], answer)
        if answer.calibration is None:
            self.counters["refused"] += 1
            # Of people too little may be seen for hours: only rows that contradict it end it.
            too_late = self._reloaded is None or (self._has_marker() and self._reloaded.has_failed(now))
            if job.verify and (answer.permanent or too_late):
                self._reloaded, self.calibration = None, None  # what was reloaded does not hold any more
            if self.calibration is not None:
                # An answer that holds is not given up because new rows say little, but that they contradict it is told.
                self.solver_failure = answer.reason if answer.refused.keys() & self.calibration.cameras.keys() else ""
                return [event]
            self.refusal = Refused(answer.reason, dict(answer.refused))
            self.refusal.permanent = answer.permanent
            self._revision += 1
            return [event, self._waiting(answer.reason, "refused" if answer.permanent else "searching")]
        self.refusal = None
        found = answer.calibration
        for name, since in answer.moved.items():
            self.counters["moved"] += 1
            self._moved[name] = now
            self.stream.marker.forget_before(name, since)
        observations = job.observations if answer.observations is None else answer.observations
        rows = len(observations)
        # As many rows may have larger stds, once the noise is known better: only fewer must not replace more.
        fewer = rows < self._answer_rows and not job.verify and self.calibration is not None
        again = [name for name in self._on_other_clocks() if boots.get(name) == self.links.boots.get(name)]
        if fewer and not again and not self._says_more(found, answer.moved):
            self.counters["not_better"] += 1
            return [event]
        self.counters["verified" if job.verify else "solved"] += 1
        then = self._keep_restarted(job, found)
        self._reloaded = None
        self._answer_rows = np.inf if job.verify else rows  # of a reloaded answer the rows are not known
        self._by_place, self.session = answer.observations is not None, (job.rig, observations)
        self._rig_cameras |= job.rig.cameras
        if unseen := found.cameras.keys() - set(observations.cameras):
            found = replace(found, warnings=(*found.warnings, f"{listed(sorted(unseen))}: {_UNSEEN}"))
        if job.last is None and self.calibration is not None and self.tracking is not None and not self.is_shard:
            self.tracking = LiveTracking()  # in another world frame
        self._report_steps(found)
        self.calibration, self.calibrated_at = found, now
        known = self._solved_boot_ids | boots
        self._solved_boot_ids = then | {name: known[name] for name in found.cameras if name in known}
        return [event, *self._publish_present()]

    def _keep_restarted(self, job: SolverJob, found: Calibration) -> dict[str, str]:
        """Keep the poses of cameras with which the job did not begin because their clocks are others; their boots then.

        In a new world they mean nothing.
        """
        before = {} if self.calibration is None else self.calibration.cameras
        boots = self._solved_boot_ids
        if self._reloaded is not None:
            before, boots = self._reloaded.calibration.cameras | before, {**self._reloaded.boots, **boots}
        last = None if job.last is None else job.last.cameras
        self._restarted = {
            name: camera
            for name, camera in (before | self._restarted).items()
            if last is not None and name in job.rig.cameras and name not in last and name not in found.cameras
        }
        return {name: boots[name] for name in self._restarted if name in boots}

    def _report_steps(self, found: Calibration) -> None:
        """Count the clock steps that the images show and raise an alarm for each, once."""
        known = {} if self.calibration is None else self.calibration.cameras
        for name, camera in found.cameras.items():
            before = [at for at, *_ in known[name].clock_steps] if name in known else []
            for at, size, _ in camera.clock_steps:
                if at not in before:
                    self.counters["clock_steps"] += 1
                    self.stream.clocks.report_step(name, size)

    def _says_more(self, found: Calibration, moved: Mapping[str, float]) -> bool:
        """Whether a new answer has stds like the present one's or smaller, or is about other cameras or poses."""
        assert self.calibration is not None
        before = self.calibration.cameras
        if moved or set(found.cameras) != set(before):
            return True
        growth = []
        for name, camera in found.cameras.items():
            for new, old in (
                (camera.time_offset_std, before[name].time_offset_std),
                *zip(camera.position_std, before[name].position_std, strict=True),
            ):
                if old > 0.0:
                    growth.append(new / old)
        return not growth or float(np.median(growth)) < _MAX_STD_GROWTH

    def _waiting(self, reason: str, status: str) -> pb.Calibration:
        refused = {} if self.refusal is None else self.refusal.cameras
        message = refusal_message(reason, refused if status == "refused" else {}, self._revision, status)
        message.progress.extend(self.progress())
        message.state = status
        return message

    def _use_nodes(self) -> list[Message]:
        """The pose nodes' calibration, where this hub does not solve."""
        self._revision += 1
        try:
            rig, observations, _ = self._build_session()
            self.session = rig, observations
            self.calibration = node_calibration(rig, self.nodes)
        except Refused as refusal:
            self.counters["refused"] += 1
            self.refusal = refusal
            return [refusal_message(refusal.reason, refusal.cameras, self._revision, "refused")]
        self.counters["solved"] += 1
        self.refusal = None
        source = self._source()
        self._solved_boot_ids = {name: source.boot(name) for name in self.calibration.cameras}
        return self._publish_present()

    def _publish_reloaded(self, reloaded: ReloadedCalibration) -> list[Message]:
        """Publish a reloaded answer as soon as two of its cameras are heard of on the clocks that it knows."""
        boots = {name: boot for name in self.stream.marker.cameras if (boot := self.stream.marker.boot(name))}
        found = reloaded.on_present_clocks(boots, self.links, self._now)
        if found is None:
            return []
        self.calibration = found
        known = dict(reloaded.boots) | boots
        self._solved_boot_ids = {name: known[name] for name in found.cameras}
        return self._publish_present()

    def _has_marker(self) -> bool:
        """Whether to calibrate from markers: there are enough marker detections, or no people."""
        return self.stream.has_marker(self.settings.least_rows)

    def _can_verify(self, calibration: Calibration) -> bool:
        """Whether two cameras of a calibration have enough to test it by."""
        if self._has_marker():
            return sum(self.stream.marker.rows(name) >= VERIFY_ROWS for name in calibration.cameras) >= 2
        # People who walk from one camera's view to the next's say nothing of where the cameras are.
        clocks = {name: one.time_map for name, one in calibration.cameras.items()}
        return sum(held >= _MIN_PEOPLE_S for held in self.stream.people.shared_seconds(clocks).values()) >= 2

    def _build_session(self, newest_s: float = np.inf) -> tuple[Rig, Observations, tuple[pb.Observation, ...]]:
        """The rig and the observations: of the marker or, if there is none, of people, whose colours may tell nobody.

        And the frames of several unlabelled people, as soon as two cameras have filmed them for long enough.
        """
        of_marker = self._has_marker() or not self.settings.solve
        try:
            rig, observations = self.stream.build(of_marker, refusing=False, newest_s=newest_s)
        except Refused:
            if not (of_marker and self.stream.people.cameras):
                raise
            of_marker = False  # nobody has waved a marker since, but people have walked
            rig, observations = self.stream.build(of_marker, refusing=False, newest_s=newest_s)
        held = {} if of_marker else self.stream.several_people(self._now)
        spans = [(one[-1].device_time_ns - one[0].device_time_ns) / NANOSECONDS for one in held.values()]
        least = min(_COLOURS_FILM_S if len(observations) else _MIN_FILM_S, 0.8 * self.stream.people_window_s)
        people = tuple(itertools.chain(*held.values())) if sum(span >= least for span in spans) >= 2 else ()
        if not of_marker and not people and not len(observations):
            said = ", ".join(f"{name} {span:.0f} s" for name, span in list(zip(held, spans, strict=True))[:8])
            later = f"; where they stand is compared once two cameras have filmed them for {least:.0f} s ({said})"
            raise Refused(f"{AMBIGUOUS_COLOURS}{later if held else ''}")
        return merge_rigs(rig, self._rig), observations, people

    def _without_other_pixels(
        self, rig: Rig, observations: Observations, people: Collection[pb.Observation] = ()
    ) -> tuple[Rig, Observations]:
        """The session without the cameras whose rows are no pixels of their images. Raises Refused without two others.

        Their rows would make the answer wrong, or the camera be waited for without end.
        """
        faults = {name: str(one) for name, one in pixel_faults(rig, observations).items()} | self._other_sizes()
        faults = self._pixel_faults = {name: why for name, why in faults.items() if name in rig.cameras}
        for name in faults:
            rig, observations = without_camera(rig, observations, name)
        if faults and len({*observations.cameras, *(one.camera for one in people)} - faults.keys()) < 2:
            raise Refused("fewer than two cameras have pixels of their images", dict(faults))
        if small := small_pictures(rig, observations):
            self._pixel_faults = {**faults, "": small}
        return rig, observations

    def _other_sizes(self) -> dict[str, str]:
        """By camera whose images are of another size than the hub's own file is for, both sizes in words."""
        out = {}
        for name, camera in ({} if self._rig is None else self._rig.cameras).items():
            size = self.stream.image_size(name)
            if size not in (None, camera.size):
                sent, given = ("{}x{}".format(*one) for one in (size, camera.size))
                out[name] = f"{name} sends images of {sent}, and the hub's file is for {given}"
        return out

    def _source(self) -> SessionBuilder | PeopleTracklets:
        return self.stream.marker if self._has_marker() else self.stream.people

    def _use_known(self, known: KnownCalibration) -> None:
        """Use the given calibration as this hub's result."""
        rig = known.rig
        self.calibration = replace(stated_calibration(rig, known.cameras), solver="known", version=VERSION, refused={})
        self._rig = rig
        self.track_with(self.calibration, rig, {})

    def track_with(self, calibration: Calibration, rig: Rig | None, boot_ids: dict[str, str]) -> None:
        """Pass a new calibration to tracking. With ``up`` in the rig, a solved world's z axis is up."""
        self._tracked_with = calibration, rig, boot_ids
        if self.tracking is not None:
            up = None if rig is None or rig.up is None else np.array([0.0, 0.0, 1.0])
            if self._known is not None:
                up = stated_up(self._known.rig, self._known.cameras)
            self.tracking.calibrate(
                calibration.cameras,
                boot_ids,
                reference=calibration.reference,
                scale=calibration.scale,
                units=calibration.units,
                up=up,
                held=self.settings.solve,
            )

    def _publish_present(self, changed: bool = True) -> list[Message]:
        """The present calibration, in the clocks' present segments, for the bus and, where it changed, for tracking."""
        assert self.calibration is not None
        self._revision += 1
        present, boot_ids = self._in_present_segments(self.calibration)
        if changed and not self.is_shard:
            self.track_with(present, self._rig, boot_ids)
        message = calibration_message(present, self._revision, boot_ids)
        message.progress.extend(self.progress())
        message.state = self.state(self._now)[0]
        if self.nodes is not None and self.settings.solve:
            self.nodes.handle(message)
        return [message]

    def _in_present_segments(
        self, calibration: Calibration, until: Mapping[str, str] | None = None
    ) -> tuple[Calibration, dict[str, str]]:
        """The calibration in the clocks' present segments, or in those of ``until``, and the boot ids of them."""
        source = self._source()
        boots = {name: self._solved_boot_ids.get(name) or source.boot(name) for name in calibration.cameras}
        if self._known is not None:  # its clocks are those of a run's begin, whatever segment is in use now
            boots = {name: self.stream.clocks.first_segment(boot) for name, boot in boots.items()}
        return self.stream.clocks.to_present(calibration, boots, until)


def unplaced(camera: RigCamera) -> RigCamera:
    """A camera of a calibration.toml as the rig has it: its pose there is an estimate, and no reference."""
    return replace(camera, position=None, rotation=None, position_std=None, rotation_std=None)


def without_camera(rig: Rig, observations: Observations, camera: str) -> tuple[Rig, Observations]:
    """A session without one of its cameras."""
    cameras = {name: one for name, one in rig.cameras.items() if name != camera}
    distances = tuple(one for one in rig.distances if camera not in one[:2])
    tracks = {key: track for key, track in observations.tracks.items() if key[0] != camera}
    up = None if isinstance(rig.up, str) and rig.up == camera else rig.up
    return replace(rig, cameras=cameras, distances=distances, up=up), replace(observations, tracks=tracks)


def merge_rigs(observed: Rig, own: Rig | None) -> Rig:
    """The rig reported by the cameras, with additions and corrections from the hub's own rig.toml."""
    if own is None:
        return observed
    cameras = dict(observed.cameras)
    for name, camera in own.cameras.items():
        if name in cameras:
            cameras[name] = _completed(camera, cameras[name])
    ordered = {name: cameras[name] for name in own.cameras if name in cameras}
    ordered |= {name: camera for name, camera in cameras.items() if name not in ordered}
    metadata = observed.metadata | own.metadata
    if "target" in observed.metadata:  # what is seen is what the rows are of
        metadata["target"] = observed.metadata["target"]
    return Rig(ordered, own.units, own.clock, own.distances, own.up, metadata, own.file)


def _completed(own: RigCamera, heard: RigCamera) -> RigCamera:
    """A camera of the hub's own rig.toml, completed by the camera's messages: lens, readout, rate and pose."""
    absent = [key for key in ("intrinsics", "readout") if getattr(own, key) is None]
    absent += ["focal_std"] if own.intrinsics is None else []
    if not own.pose_table():  # half a pose of each would be in two worlds
        absent += ["position", "position_std", "rotation", "rotation_std"]
    return replace(own, fps=own.fps or heard.fps, **{key: getattr(heard, key) for key in absent})
