"""The hub's estimator while cameras stream: gather, solve again every few seconds, publish.

No sockets and no clock: ``handle`` takes messages, ``tick(now)`` returns messages. The same object runs
in the agent, in replay and in tests.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from google.protobuf.message import Message

from hub.calibration.coverage import Guidance
from hub.calibration.pipeline import calibrate
from hub.clocks.external_prior import ClockClaims
from hub.clocks.rate_change import Bends
from hub.clocks.segments import EPOCH_ROWS, ClockEpochs
from hub.distributed.network.host import NodeHost
from hub.distributed.solver import node_calibration, with_node_poses
from hub.live.messages import calibration_message, refusal_message, track_messages
from hub.tracking.calibration.people import Walkers
from hub.tracking.camera_frame import tracked_kind
from hub.tracking.live_tracking import LiveTracking
from protocols.core.errors import InputError, Refused
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import SessionBuilder, rig_camera
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_WALKED_S = 40.0
"""Of tracklets: how much of people two cameras must have seen before calibrating by them is worth a try."""


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """window_s: how much of the past is solved together. interval_s: how often.

    least_rows: detections a camera must have before solving is worth a try. solve: whether timing is sought here, or
    only pose nodes run, on a shared clock or on what another hub found. track: whether people, vehicles and markers
    without a name are followed as soon as there is a calibration.
    """

    window_s: float = 60.0
    interval_s: float = 2.0
    least_rows: int = 90
    solve: bool = True
    track: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class KnownCalibration:
    """A calibration that is given and kept: poses, lenses and clocks. rig: as calibration.toml tells it."""

    rig: Rig
    cameras: dict[str, CameraCalibration]


class LiveHub:
    """Gathers what cameras see and calibrates them again and again.

    rig: what the hub knows of the rig from its own rig.toml: references, distances, up; the cameras'
    intrinsics come from the cameras unless it has them. nodes: this hub's pose nodes; then the published poses are
    the network's as soon as it has settled, and the solver's timing is theirs. known: a calibration that is given:
    then nothing is solved. working: called as a solve gets on, which takes minutes on a small machine.
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
            nodes.share_clock()
        self._builder = SessionBuilder(self.settings.window_s)
        self._next = 0.0
        self._revision = 0
        self._sequence = 0
        self._published: dict[str, float] = {}
        self._heard = 0
        self._solved_at = -1
        self.calibration: Calibration | None = None
        self.session: tuple[Rig, Observations] | None = None
        self.refusal: Refused | None = None
        self.counters: Counter[str] = Counter()
        self.clocks = ClockEpochs()
        self._bends = Bends()
        self.claims = ClockClaims()
        self._solved_boots: dict[str, str] = {}
        self._stepped = False
        self.guidance = Guidance()
        self.tracking = LiveTracking() if self.settings.track else None
        self._walkers = Walkers(self.settings.window_s)
        self._infos: dict[str, pb.CameraInfo] = {}
        self._walked = False
        self._known = known
        self.working: Callable[[], None] = lambda: None
        if known is not None:
            self._take_over(known)

    def handle(self, message: Message, arrival: float | None = None) -> None:
        """Take one message from the bus or a log. arrival: when it came [s, any one clock]; None = not known."""
        if isinstance(message, pb.AgentStatus):
            self.claims.handle(message)
            return
        if isinstance(message, pb.Observation):
            self.claims.handle(message)
            message, event = self.clocks.sort(message, arrival)
            if event is not None:
                self.counters[f"clock_{event.kind}s"] += 1
                self._builder.settle_after(event.boot, EPOCH_ROWS)
                self._bends.handle(event)
                self._stepped = True
        self.guidance.handle(message)
        if self.tracking is not None:
            self.tracking.handle(message)
        if isinstance(message, pb.CameraInfo):
            self._infos[message.camera] = message
        if isinstance(message, pb.Observation) and any(d.kind and tracked_kind(d) for d in message.detections):
            self._walkers.handle(message)
            message = without_tracked(message)
        self._builder.handle(message)
        if isinstance(message, pb.Observation):
            self._go_on_with_old_clock(message)
        if self.nodes is not None:
            self.nodes.handle(message)
        if isinstance(message, pb.Observation):
            self._heard += 1
            self.counters["observations"] += 1

    def start_anew(self) -> None:
        """Forget what was seen and answered, as after a rig was rebuilt; clocks and numbering of messages go on."""
        self._builder = SessionBuilder(self.settings.window_s)
        self.guidance.start_anew()
        self._next, self._solved_at = 0.0, -1
        self.calibration, self.session, self.refusal = None, None, None
        self._walkers, self._walked = Walkers(self.settings.window_s), False
        if self.tracking is not None:
            self.tracking = LiveTracking()
        if self._known is not None:
            self._take_over(self._known)

    def clock_contradictions(self) -> list[str]:
        """Cameras whose machines claim of their clocks what the calibration contradicts, one line each."""
        if self.calibration is None:
            return []
        return self.claims.contradictions(self.calibration, self._solved_boots)

    def missing(self) -> str:
        """What is missing before solving is worth a try; "" if nothing."""
        cameras = self._builder.cameras
        if len(cameras) < 2:
            return f"{len(cameras)} of at least 2 cameras heard of"
        few = {name: self._builder.rows(name) for name in cameras}
        ready = [name for name, rows in few.items() if rows >= self.settings.least_rows]
        if len(ready) < 2 and self._walkers.cameras:
            if self._walked:
                return ""
            walked = {name: self._walkers.seconds(name) for name in self._walkers.cameras}
            if sum(seconds >= _WALKED_S for seconds in walked.values()) < 2:
                told = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in walked.items())
                return f"people are seen too shortly yet ({told}; two cameras need {_WALKED_S:.0f} s): walk about"
            return ""
        if len(ready) < 2:
            told = ", ".join(f"{name} {rows}" for name, rows in few.items())
            return f"too few detections yet ({told}; two cameras need {self.settings.least_rows}): move the marker"
        return ""

    def tick(self, now: float, final: bool = False) -> list[Message]:
        """What is to be published at time ``now`` [s, any monotonic clock]; solves when it is time.

        final: solve now, with all that was heard.
        """
        tracked = [] if self.tracking is None else self.tracking.tick(now)
        return tracked + self._calibrate(now, final)

    def _calibrate(self, now: float, final: bool) -> list[Message]:
        if self._stepped and self.calibration is not None:
            # What is known of the new clock is told before it is solved for by itself.
            self._stepped = False
            return self._tell_known()
        if not final and now < self._next:
            return []
        self._next = now + self.settings.interval_s
        if self._known is not None:
            return self._tell_known()
        if not self.settings.solve:
            return self._solve()
        if self._solved_at == self._heard and not final:
            return []
        self._solved_at = self._heard
        missing = self.missing()
        if missing:
            self._revision += 1
            return [refusal_message(missing, {}, self._revision, "collecting")]
        return self._solve()

    def _solve(self) -> list[Message]:
        if self._walked and not self._marked():
            return []  # walkers are solved once: it is dear, and who they are does not get clearer
        self._revision += 1
        try:
            rig, observations = self._session()
            self.session = (rig, observations)
            self.calibration = self._answer(rig, observations)
            self._solved_boots = self._boots(self.calibration)
            self.refusal = None
        except Refused as refusal:
            self.counters["refused"] += 1
            self.refusal = refusal
            return [refusal_message(refusal.reason, refusal.cameras, self._revision, "refused")]
        except InputError as error:
            # Two frames of one stamp and the like: a camera's fault that must not stop the hub.
            self.counters["bad_sessions"] += 1
            self.refusal = Refused(str(error))
            return [refusal_message(str(error), {}, self._revision, "refused")]
        self.counters["solved"] += 1
        present, boots = self._present(self.calibration)
        self._track_with(present, rig, boots)
        out: list[Message] = [calibration_message(present, self._revision, boots)]
        for table in self.calibration.trajectories:
            tracks = track_messages(table, self._published.get(table.label, -float("inf")), self._sequence)
            self._sequence += len(tracks)
            if len(table.time):
                self._published[table.label] = float(table.time[-1])
            out.extend(tracks)
        return out

    def _marked(self) -> bool:
        """Whether there is a marker to calibrate with, or nobody who walks."""
        rows = [self._builder.rows(name) for name in self._builder.cameras]
        return not self._walkers.cameras or sum(count >= self.settings.least_rows for count in rows) >= 2

    def _session(self) -> tuple[Rig, Observations]:
        """The rig and what was seen: of the marker, or, where there is none, of people who walk."""
        if self._marked() or not self.settings.solve:
            rig, observations = self._builder.build()
            observations = self._straightened(observations)
        else:
            rig = Rig({name: rig_camera(self._infos[name]) for name in sorted(self._infos)})
            observations = self._walkers.observations()
            if not len(observations):
                raise Refused("nobody who walks can be told from the others by colour, or two cameras see nobody alike")
        return merged(rig, self._rig), observations

    def _go_on_with_old_clock(self, message: pb.Observation) -> None:
        """Keep the frame for the epoch before a bend of the clock too, as that would have stamped it."""
        old = self._bends.on_old_clock(message.camera, message.boot_id, message.device_time_ns)
        if old is None:
            return
        if self._bends.serving(message.camera, self._builder.boot(message.camera)) is None:
            return
        copy = pb.Observation()
        copy.CopyFrom(message)
        copy.boot_id, copy.device_time_ns = old
        self._builder.handle(copy)

    def _straightened(self, observations: Observations) -> Observations:
        """Observations with what a clock stamped between its bend and the alarm put right."""
        serving = {name: self._bends.serving(name, self._builder.boot(name)) for name in self._bends.cameras}
        bends = {name: bend.amended(self.clocks.event(bend.after)) for name, bend in serving.items() if bend}
        tracks = {
            key: track if (bend := bends.get(key[0])) is None else replace(track, time=bend.straightened(track.time))
            for key, track in observations.tracks.items()
        }
        return replace(observations, tracks=tracks)

    def _boots(self, calibration: Calibration) -> dict[str, str]:
        source = self._builder if self._marked() else self._walkers
        return {name: source.boot(name) for name in calibration.cameras}

    def _take_over(self, known: KnownCalibration) -> None:
        """The given calibration as this hub's own answer."""
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

    def _track_with(self, calibration: Calibration, rig: Rig, boots: dict[str, str]) -> None:
        """Let tracking see through a new calibration. With ``up`` in the rig, the world's z is up."""
        if self.tracking is not None:
            up = None if rig.up is None else np.array([0.0, 0.0, 1.0])
            self.tracking.calibrate(
                calibration.cameras,
                boots,
                reference=calibration.reference,
                scale=calibration.scale,
                units=calibration.units,
                up=up,
            )

    def _tell_known(self) -> list[Message]:
        assert self.calibration is not None
        self._revision += 1
        present, boots = self._present(self.calibration)
        return [calibration_message(present, self._revision, boots)]

    def _present(self, calibration: Calibration) -> tuple[Calibration, dict[str, str]]:
        """The calibration in the clocks' present epochs, and their names."""
        return self.clocks.present(calibration, {name: self._builder.boot(name) for name in calibration.cameras})

    def _answer(self, rig: Rig, observations: Observations) -> Calibration:
        if not self.settings.solve:
            return node_calibration(rig, self.nodes)
        source = self._builder if self._marked() else self._walkers
        claims = self.claims.of({name: source.boot(name) for name in rig.cameras})
        found = calibrate(rig, observations, lambda text, share: self.working(), claims=claims)
        if self.nodes is None:
            return found
        boots = self._boots(found)
        self.nodes.handle(calibration_message(found, self._revision, boots))
        return with_node_poses(found, rig, self.nodes)


def without_tracked(message: pb.Observation) -> pb.Observation:
    """The observation without people and vehicles: their labels are the camera's own, and no other camera's."""
    plain = pb.Observation()
    plain.CopyFrom(message)
    del plain.detections[:]
    plain.detections.extend(d for d in message.detections if not tracked_kind(d))
    return plain


def merged(heard: Rig, own: Rig | None) -> Rig:
    """The rig that cameras told, with what the hub's own rig.toml adds or corrects."""
    if own is None:
        return heard
    cameras = dict(heard.cameras)
    for name, camera in own.cameras.items():
        if name in cameras:
            cameras[name] = camera
    ordered = {name: cameras[name] for name in own.cameras if name in cameras}
    ordered |= {name: camera for name, camera in cameras.items() if name not in ordered}
    return Rig(ordered, own.units, own.clock, own.distances, own.up, own.metadata, own.file)
