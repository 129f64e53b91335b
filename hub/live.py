"""The hub's estimator while cameras stream: gather, solve again every few seconds, publish.

No sockets and no clock: ``handle`` takes messages, ``tick(now)`` returns messages. The same object runs
in the agent, in replay and in tests.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from google.protobuf.message import Message

from hub.calibrate import calibrate
from hub.distributed import node_calibration, with_node_poses
from hub.messages import calibration_message, refusal_message, track_messages
from hub.nodes.host import NodeHost
from protocols.errors import InputError, Refused
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import SessionBuilder
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """window_s: how much of the past is solved together. interval_s: how often.

    least_rows: detections a camera must have before solving is worth a try. solve: whether timing is sought here, or
    only pose nodes run, on a shared clock or on what another hub found.
    """

    window_s: float = 60.0
    interval_s: float = 2.0
    least_rows: int = 90
    solve: bool = True


class LiveHub:
    """Gathers what cameras see and calibrates them again and again.

    rig: what the hub knows of the rig from its own rig.toml: references, distances, up; the cameras'
    intrinsics come from the cameras unless it has them. nodes: this hub's pose nodes; then the published poses are
    the network's as soon as it has settled, and the solver's timing is theirs.
    """

    def __init__(
        self, settings: LiveSettings | None = None, rig: Rig | None = None, nodes: NodeHost | None = None
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

    def handle(self, message: Message) -> None:
        """Take one message from the bus or a log."""
        self._builder.handle(message)
        if self.nodes is not None:
            self.nodes.handle(message)
        if isinstance(message, pb.Observation):
            self._heard += 1
            self.counters["observations"] += 1

    def missing(self) -> str:
        """What is missing before solving is worth a try; "" if nothing."""
        cameras = self._builder.cameras
        if len(cameras) < 2:
            return f"{len(cameras)} of at least 2 cameras heard of"
        few = {name: self._builder.rows(name) for name in cameras}
        ready = [name for name, rows in few.items() if rows >= self.settings.least_rows]
        if len(ready) < 2:
            told = ", ".join(f"{name} {rows}" for name, rows in few.items())
            return f"too few detections yet ({told}; two cameras need {self.settings.least_rows}): move the marker"
        return ""

    def tick(self, now: float, final: bool = False) -> list[Message]:
        """What is to be published at time ``now`` [s, any monotonic clock]; solves when it is time.

        final: solve now, with all that was heard.
        """
        if not final and now < self._next:
            return []
        self._next = now + self.settings.interval_s
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
        self._revision += 1
        try:
            rig, observations = self._builder.build()
            rig = merged(rig, self._rig)
            self.session = (rig, observations)
            self.calibration = self._answer(rig, observations)
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
        boots = {name: self._builder.boot(name) for name in self.calibration.cameras}
        out: list[Message] = [calibration_message(self.calibration, self._revision, boots)]
        for table in self.calibration.trajectories:
            tracks = track_messages(table, self._published.get(table.label, -float("inf")), self._sequence)
            self._sequence += len(tracks)
            if len(table.time):
                self._published[table.label] = float(table.time[-1])
            out.extend(tracks)
        return out

    def _answer(self, rig: Rig, observations: Observations) -> Calibration:
        if not self.settings.solve:
            return node_calibration(rig, self.nodes)
        found = calibrate(rig, observations)
        if self.nodes is None:
            return found
        boots = {name: self._builder.boot(name) for name in found.cameras}
        self.nodes.handle(calibration_message(found, self._revision, boots))
        return with_node_poses(found, rig, self.nodes)


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
