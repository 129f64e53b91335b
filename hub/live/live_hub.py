"""Live calibration: collects observations in a sliding window and solves again every few seconds.

No sockets, threads, files or wall clock: ``handle`` takes messages, ``tick(now)`` returns messages. The same object
runs in the agent, in replay and in tests.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from google.protobuf.message import Message

from hub.calibration.coverage import CoverageMonitor
from hub.calibration.pipeline import calibrate
from hub.clocks.external_prior import ExternalClockPriors
from hub.clocks.rate_change import RateChanges
from hub.clocks.segments import SEGMENT_MIN_ROWS, ClockSegments
from hub.distributed.network.host import NodeHost
from hub.distributed.solver import node_calibration, with_node_poses
from hub.live.messages import calibration_message, refusal_message, track_messages
from hub.tracking.calibration.people import PeopleTracklets
from hub.tracking.detections import tracked_kind
from hub.tracking.live_tracking import LiveTracking
from protocols.core.errors import InputError, Refused
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import SessionBuilder, rig_camera_from_info
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_MIN_PEOPLE_S = 40.0
"""Total duration of people's tracklets [s] that two cameras need before people-based calibration is tried."""


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """window_s: length of the sliding window. interval_s: time between two solves.

    least_rows: detections that two cameras need before solving is tried. solve: whether timing is estimated here; if
    not, only pose nodes run, on a shared clock or on another hub's timing. track: whether people, vehicles and
    unlabelled markers are tracked as soon as there is a calibration.
    """

    window_s: float = 60.0
    interval_s: float = 2.0
    least_rows: int = 90
    solve: bool = True
    track: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class KnownCalibration:
    """A given, fixed calibration: poses, intrinsics and clocks. rig: as read from calibration.toml."""

    rig: Rig
    cameras: dict[str, CameraCalibration]


class LiveHub:
    """Collects observations and calibrates the cameras repeatedly.

    rig: from the hub's own rig.toml: control points, distances, up; intrinsics come from the cameras unless it has
    them. nodes: this hub's pose nodes; then the published poses are the network's as soon as it has converged, and the
    nodes use the solver's timing. known: a given calibration: then nothing is solved. on_progress: called during a
    solve, which takes minutes on a small machine.
    """

    def __init__(
        self,
        settings: LiveSettings | None = None,
        rig: Rig | None = None,
        nodes: NodeHost | None = None,
        known: KnownCalibration | None = None,
    ) -> None:
        self.settings = settings or LiveSettings()
        self._rig = rig
        self.nodes = nodes
        if nodes is not None and rig is not None and rig.shared_clock:
            nodes.use_shared_clock()
        self._builder = SessionBuilder(self.settings.window_s)
        self._next = 0.0
        self._revision = 0
        self._sequence = 0
        self._published: dict[str, float] = {}
        self._received = 0
        self._solved_at = -1
        self.calibration: Calibration | None = None
        self.session: tuple[Rig, Observations] | None = None
        self.refusal: Refused | None = None
        self.counters: Counter[str] = Counter()
        self.clocks = ClockSegments()
        self._rate_changes = RateChanges()
        self.clock_priors = ExternalClockPriors()
        self._solved_boot_ids: dict[str, str] = {}
        self._clock_stepped = False
        self.guidance = CoverageMonitor()
        self.tracking = LiveTracking() if self.settings.track else None
        self._people = PeopleTracklets(self.settings.window_s)
        self._infos: dict[str, pb.CameraInfo] = {}
        self._people_used = False
        self._known = known
        self.on_progress: Callable[[], None] = lambda: None
        if known is not None:
            self._use_known(known)

    def handle(self, message: Message, arrival: float | None = None) -> None:
        """Process one message from the bus or a log. arrival: its arrival time [s, any fixed clock]; None = unknown."""
        if isinstance(message, pb.AgentStatus):
            self.clock_priors.handle(message)
            return
        if isinstance(message, pb.Observation):
            self.clock_priors.handle(message)
            message, event = self.clocks.assign(message, arrival)
            if event is not None:
                self.counters[f"clock_{event.kind}s"] += 1
                self._builder.require_rows(event.segment, SEGMENT_MIN_ROWS)
                self._rate_changes.handle(event)
                self._clock_stepped = True
        self.guidance.handle(message)
        if self.tracking is not None:
            self.tracking.handle(message)
        if isinstance(message, pb.CameraInfo):
            self._infos[message.camera] = message
        if isinstance(message, pb.Observation) and any(d.kind and tracked_kind(d) for d in message.detections):
            self._people.handle(message)
            message = without_tracked(message)
        self._builder.handle(message)
        if isinstance(message, pb.Observation):
            self._extend_old_segment(message)
        if self.nodes is not None:
            self.nodes.handle(message)
        if isinstance(message, pb.Observation):
            self._received += 1
            self.counters["observations"] += 1

    def reset(self) -> None:
        """Forget observations and results, as after the rig was rebuilt; clock state and message numbering are kept."""
        self._builder = SessionBuilder(self.settings.window_s)
        self.guidance.reset()
        self._next, self._solved_at = 0.0, -1
        self.calibration, self.session, self.refusal = None, None, None
        self._people, self._people_used = PeopleTracklets(self.settings.window_s), False
        if self.tracking is not None:
            self.tracking = LiveTracking()
        if self._known is not None:
            self._use_known(self._known)

    def clock_contradictions(self) -> list[str]:
        """Cameras whose external clock prior (NTP/PTP) the calibration contradicts, one line each."""
        if self.calibration is None:
            return []
        return self.clock_priors.contradictions(self.calibration, self._solved_boot_ids)

    def missing(self) -> str:
        """What is missing before solving is tried; "" if nothing."""
        cameras = self._builder.cameras
        if len(cameras) < 2:
            return f"{len(cameras)} of at least 2 cameras heard of"
        rows_by_camera = {name: self._builder.rows(name) for name in cameras}
        ready = [name for name, rows in rows_by_camera.items() if rows >= self.settings.least_rows]
        if len(ready) < 2 and self._people.cameras:
            if self._people_used:
                return ""
            durations = {name: self._people.seconds(name) for name in self._people.cameras}
            if sum(seconds >= _MIN_PEOPLE_S for seconds in durations.values()) < 2:
                counts = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in durations.items())
                return f"people observed too briefly yet ({counts}; two cameras need {_MIN_PEOPLE_S:.0f} s): walk about"
            return ""
        if len(ready) < 2:
            counts = ", ".join(f"{name} {rows}" for name, rows in rows_by_camera.items())
            return f"too few detections yet ({counts}; two cameras need {self.settings.least_rows}): move the marker"
        return ""

    def tick(self, now: float, final: bool = False) -> list[Message]:
        """The messages to publish at time ``now`` [s, any monotonic clock]; solves when due.

        final: solve now, with all observations.
        """
        tracked = [] if self.tracking is None else self.tracking.tick(now)
        return tracked + self._calibrate(now, final)

    def _calibrate(self, now: float, final: bool) -> list[Message]:
        if self._clock_stepped and self.calibration is not None:
            # After a clock step, the transformed calibration is published at once, before the new segment is solved.
            self._clock_stepped = False
            return self._publish_known()
        if not final and now < self._next:
            return []
        self._next = now + self.settings.interval_s
        if self._known is not None:
            return self._publish_known()
        if not self.settings.solve:
            return self._solve()
        if self._solved_at == self._received and not final:
            return []
        self._solved_at = self._received
        missing = self.missing()
        if missing:
            self._revision += 1
            return [refusal_message(missing, {}, self._revision, "collecting")]
        return self._solve()

    def _solve(self) -> list[Message]:
        if self._people_used and not self._has_marker():
            return []  # people-based calibration is solved once: it is costly, and the identities do not improve
        self._revision += 1
        try:
            rig, observations = self._build_session()
            self.session = (rig, observations)
            self.calibration = self._estimate(rig, observations)
            self._solved_boot_ids = self._boot_ids(self.calibration)
            self.refusal = None
        except Refused as refusal:
            self.counters["refused"] += 1
            self.refusal = refusal
            return [refusal_message(refusal.reason, refusal.cameras, self._revision, "refused")]
        except InputError as error:
            # Invalid input such as two frames with one time stamp: a camera's fault that must not stop the hub.
            self.counters["bad_sessions"] += 1
            self.refusal = Refused(str(error))
            return [refusal_message(str(error), {}, self._revision, "refused")]
        self.counters["solved"] += 1
        present, boot_ids = self._in_present_segments(self.calibration)
        self._track_with(present, rig, boot_ids)
        out: list[Message] = [calibration_message(present, self._revision, boot_ids)]
        for table in self.calibration.trajectories:
            tracks = track_messages(table, self._published.get(table.label, -float("inf")), self._sequence)
            self._sequence += len(tracks)
            if len(table.time):
                self._published[table.label] = float(table.time[-1])
            out.extend(tracks)
        return out

    def _has_marker(self) -> bool:
        """Whether to calibrate from markers: there are enough marker detections, or no people."""
        rows = [self._builder.rows(name) for name in self._builder.cameras]
        return not self._people.cameras or sum(count >= self.settings.least_rows for count in rows) >= 2

    def _build_session(self) -> tuple[Rig, Observations]:
        """The rig and the observations: of the marker or, if there is none, of people."""
        if self._has_marker() or not self.settings.solve:
            rig, observations = self._builder.build()
            observations = self._with_rate_changes_corrected(observations)
        else:
            rig = Rig({name: rig_camera_from_info(self._infos[name]) for name in sorted(self._infos)})
            observations = self._people.observations()
            if not len(observations):
                raise Refused("the colours of the people are ambiguous, or no two cameras observed the same person")
        return merge_rigs(rig, self._rig), observations

    def _extend_old_segment(self, message: pb.Observation) -> None:
        """Also add the frame to the clock segment before a rate change, with the time stamp of the old clock."""
        old = self._rate_changes.to_previous_clock(message.camera, message.boot_id, message.device_time_ns)
        if old is None:
            return
        if self._rate_changes.active(message.camera, self._builder.boot(message.camera)) is None:
            return
        copy = pb.Observation()
        copy.CopyFrom(message)
        copy.boot_id, copy.device_time_ns = old
        self._builder.handle(copy)

    def _with_rate_changes_corrected(self, observations: Observations) -> Observations:
        """The observations with corrected time stamps between a rate change of a clock and its detection."""
        active = {
            name: self._rate_changes.active(name, self._builder.boot(name)) for name in self._rate_changes.cameras
        }
        rate_changes = {
            name: change.refined(self.clocks.change_into(change.segment)) for name, change in active.items() if change
        }
        tracks = {
            key: track
            if (change := rate_changes.get(key[0])) is None
            else replace(track, time=change.corrected(track.time))
            for key, track in observations.tracks.items()
        }
        return replace(observations, tracks=tracks)

    def _boot_ids(self, calibration: Calibration) -> dict[str, str]:
        source = self._builder if self._has_marker() else self._people
        return {name: source.boot(name) for name in calibration.cameras}

    def _use_known(self, known: KnownCalibration) -> None:
        """Use the given calibration as this hub's result."""
        rig = known.rig
        self.calibration = Calibration(
            known.cameras,
            str(rig.metadata.get("reference", next(iter(known.cameras), ""))),
            str(rig.metadata.get("scale", "metric")),
            rig.units,
            "known",
            VERSION,
        )
        self._track_with(self.calibration, rig, {})

    def _track_with(self, calibration: Calibration, rig: Rig, boot_ids: dict[str, str]) -> None:
        """Pass a new calibration to tracking. With ``up`` in the rig, the world's z axis is up."""
        if self.tracking is not None:
            up = None if rig.up is None else np.array([0.0, 0.0, 1.0])
            self.tracking.calibrate(
                calibration.cameras,
                boot_ids,
                reference=calibration.reference,
                scale=calibration.scale,
                units=calibration.units,
                up=up,
            )

    def _publish_known(self) -> list[Message]:
        assert self.calibration is not None
        self._revision += 1
        present, boot_ids = self._in_present_segments(self.calibration)
        return [calibration_message(present, self._revision, boot_ids)]

    def _in_present_segments(self, calibration: Calibration) -> tuple[Calibration, dict[str, str]]:
        """The calibration in the clocks' present segments, and the boot ids of those."""
        return self.clocks.to_present(calibration, {name: self._builder.boot(name) for name in calibration.cameras})

    def _estimate(self, rig: Rig, observations: Observations) -> Calibration:
        if not self.settings.solve:
            return node_calibration(rig, self.nodes)
        source = self._builder if self._has_marker() else self._people
        clock_priors = self.clock_priors.for_boots({name: source.boot(name) for name in rig.cameras})
        found = calibrate(rig, observations, lambda text, share: self.on_progress(), clock_priors=clock_priors)
        if self.nodes is None:
            return found
        boot_ids = self._boot_ids(found)
        self.nodes.handle(calibration_message(found, self._revision, boot_ids))
        return with_node_poses(found, rig, self.nodes)


def without_tracked(message: pb.Observation) -> pb.Observation:
    """The observation without people, vehicles and unlabelled markers: they have no common label across cameras."""
    plain = pb.Observation()
    plain.CopyFrom(message)
    del plain.detections[:]
    plain.detections.extend(d for d in message.detections if not tracked_kind(d))
    return plain


def merge_rigs(observed: Rig, own: Rig | None) -> Rig:
    """The rig reported by the cameras, with additions and corrections from the hub's own rig.toml."""
    if own is None:
        return observed
    cameras = dict(observed.cameras)
    for name, camera in own.cameras.items():
        if name in cameras:
            cameras[name] = camera
    ordered = {name: cameras[name] for name in own.cameras if name in cameras}
    ordered |= {name: camera for name, camera in cameras.items() if name not in ordered}
    return Rig(ordered, own.units, own.clock, own.distances, own.up, own.metadata, own.file)
