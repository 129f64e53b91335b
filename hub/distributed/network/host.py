"""Hosts the pose nodes of some cameras: this hub's share of a network that any number of hubs carry together.

Estimator without bus, threads or clocks: ``handle`` messages, ``agents`` who is alive, ``tick``. Every host hears every
node's state; when a host dies, the others agree without asking who goes on with each of its cameras (the same hash
over the same names), and that one begins where the last published state ended.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from google.protobuf.message import Message

from hub.distributed.factors.factor import Summary
from hub.distributed.network.association import GAP
from hub.distributed.network.messages import Notice, Reference, SharedObservation, StateMessage
from hub.distributed.network.node import PoseNode
from hub.distributed.network.serialisation import (
    edges_from_wire,
    edges_to_wire,
    name_of,
    number_of,
    state_from_wire,
    state_to_wire,
)
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import rig_camera
from protocols.session.observations import DEFAULT_LABEL

ROLE = "nodes"
"""Role under which a hub that hosts pose nodes is announced."""
_PERIOD_S = 0.1
_ROWS = 40
"""Observations after which the nodes are updated even if no time has passed: a busy hub has some to catch up."""
_CHECKPOINT = 5
"""Updates between two messages that carry the edges."""
_LISTEN_S = 1.0
"""Time after the start in which cameras that another host may have are left alone."""
_SILENT_S = 20.0
"""Silence after which a host counts as dead even if its token stands."""
_SETTLED = 30
_PIXEL_STD = 1.0
_LEAST_PIXEL_STD = 0.3
_SIZE_STD = 0.05
_CLOCK_JUMP_S = 0.02
_SAME_LENS = 1e-3
"""Relative change of a focal length from which a lens is another one."""


@dataclass(slots=True, eq=False)
class _Clock:
    """t_reference = rate * t_camera + offset, for one boot ("" = any). std: of the map [s]; pixel: noise [px]."""

    boot: str
    rate: float
    offset: float
    std: float
    pixel: float


@dataclass(slots=True, eq=False)
class _Hosted:
    node: PoseNode
    takeover: int
    updates: int = 0
    labels: set[int] = field(default_factory=set)


class NodeHost:
    """This hub's pose nodes.

    hub: its id. pinned: cameras that it hosts whoever else is there. leave_after_s: time after a camera's agent has
    gone until the network forgets it.
    """

    def __init__(self, hub: str, pinned: Iterable[str] = (), *, seed: int = 0, leave_after_s: float = 30.0) -> None:
        self.hub = hub
        self.counters: Counter[str] = Counter()
        self.notices: list[Notice] = []
        self.refused: dict[str, str] = {}
        self._pinned = frozenset(pinned)
        self._seed, self._leave_after = seed, leave_after_s
        self._hosted: dict[str, _Hosted] = {}
        self._lenses: dict[str, Intrinsics] = {}
        self._references: dict[str, Reference] = {}
        self._clocks: dict[str, _Clock] = {}
        self._shared = False
        self._states: dict[str, pb.NodeState] = {}
        self._edges: dict[str, pb.NodeState] = {}
        self._heard: dict[str, float] = {}
        self._alive: dict[str, set[str]] = {}
        self._gone: set[str] = set()
        self._departed: dict[str, float] = {}
        self._boots: dict[str, list[str]] = {}
        self._sequences: Counter[str] = Counter()
        self._last: dict[tuple[str, str], int] = {}
        self._labels: dict[str, int] = {}
        self._latest: dict[str, float] = {}
        self._now = 0.0
        self._began: float | None = None
        self._due = 0.0
        self._rows = 0
        self._out: list[pb.NodeState] = []

    # what is heard

    def handle(self, message: Message) -> None:
        """Take one message from the bus or a log; kinds that mean nothing here are ignored."""
        if isinstance(message, pb.Observation):
            self._observation(message)
        elif isinstance(message, pb.NodeState):
            self._state(message)
        elif isinstance(message, pb.CameraInfo):
            self._camera(message)
        elif isinstance(message, pb.RigInfo):
            self._shared = message.clock == "shared"
        elif isinstance(message, pb.Calibration) and message.status == "solved":
            self._calibration(message)

    def share_clock(self) -> None:
        """All cameras tell one clock's time: nothing need be known of their offsets."""
        self._shared = True

    def agents(self, role: str, agent: str, boot: str, *, alive: bool) -> None:
        """Somebody came or went, as liveliness tells it."""
        if role == "camera":
            if alive:
                self._departed.pop(agent, None)
            else:
                self._departed[agent] = self._now
        elif role == ROLE:
            boots = self._alive.setdefault(agent, set())
            (boots.add if alive else boots.discard)(boot)
            (self._gone.discard if boots else self._gone.add)(agent)

    # what is told

    def tick(self, now: float) -> list[pb.NodeState]:
        """Updates every node when it is time, and returns their states. now: any monotonic clock [s]."""
        self._now = now
        if self._began is None:
            self._began = now
        if now >= self._due:
            self._due = now + _PERIOD_S
            self._out += self._let_go()
            self._take_over()
            self._update()
        out, self._out = self._out, []
        return out

    def _update(self) -> None:
        """One update of every node here; their neighbours here hear of it at once, the others by the next tick."""
        self._rows = 0
        out = []
        for camera, hosted in self._hosted.items():
            states = [item for item in self._noted(hosted.node.tick(self._now)) if isinstance(item, StateMessage)]
            hosted.updates += 1
            message = state_to_wire(states[-1], self.hub, hosted.takeover)
            if hosted.updates % _CHECKPOINT == 0:
                message.edges.extend(edges_to_wire(hosted.node.summaries()))
            self._states[camera] = message
            out.append(message)
        for message in out:
            self._to_neighbours(message)
        self._out += out

    def cameras(self) -> list[str]:
        """Cameras whose nodes run here."""
        return sorted(self._hosted)

    def host_of(self, camera: str) -> str:
        """The hub that runs a camera's node, as far as heard; "" if none."""
        state = self._states.get(camera)
        return "" if state is None else state.host

    def poses(self) -> dict[str, Pose]:
        """Poses of all settled cameras of the network, wherever they are hosted, in the frame that most share."""
        states = {c: state_from_wire(m) for c, m in sorted(self._states.items()) if not m.leaving}
        frames = Counter(state.frame for state in states.values() if state.pose is not None)
        if not frames:
            return {}
        frame = max(frames, key=lambda f: (frames[f], -f))
        return {
            camera: state.pose
            for camera, state in states.items()
            if state.pose is not None and state.frame == frame and state.settled >= _SETTLED
            if camera not in self.refused
        }

    def learnt(self) -> dict[str, dict[str, Summary]]:
        """What every node of the network has learnt of its neighbours, as far as heard, by name."""
        out: dict[str, dict[str, Summary]] = {}
        for camera in sorted({*self._edges, *self._hosted}):
            hosted, told = self._hosted.get(camera), self._edges.get(camera)
            if hosted is not None:
                edges = hosted.node.neighbours().items()
                known = {other: edge.summary for other, edge in edges if edge.summary is not None}
            elif told is not None and told.epoch == self._states[camera].epoch:
                known = edges_from_wire(list(told.edges))
            else:
                continue
            out[camera] = {name_of(other): summary for other, summary in known.items()}
        return out

    def clock(self, camera: str) -> tuple[float, float, float]:
        """(rate, offset, std) of the camera's time map as the nodes use it."""
        clock = self._clocks.get(camera)
        return (1.0, 0.0, 0.0) if clock is None or self._shared else (clock.rate, clock.offset, clock.std)

    # observations

    def _observation(self, message: pb.Observation) -> None:
        camera = message.camera
        lens, clock = self._lenses.get(camera), self._clocks.get(camera)
        if lens is None or camera in self.refused:
            return
        if not self._shared and (clock is None or clock.boot not in ("", message.boot_id)):
            self.counters["before_the_clock_is_known"] += 1
            return
        who = (camera, message.boot_id)
        if message.sequence <= self._last.get(who, -1):
            self.counters["repeated"] += 1
            return
        self._last[who] = message.sequence
        boots = self._boots.setdefault(camera, [])
        if message.boot_id not in boots:
            boots.append(message.boot_id)
        best: dict[str, pb.Detection] = {}
        for found in sorted(message.detections, key=lambda found: -found.score):
            best.setdefault(found.label or DEFAULT_LABEL, found)
        if not best:
            return
        rate, offset, std = self.clock(camera)
        self._latest[camera] = message.device_time_ns / NANOSECONDS
        time = rate * self._latest[camera] + offset
        pixels = np.array([[found.u, found.v] for found in best.values()])
        noise = (_PIXEL_STD if clock is None else clock.pixel) / lens.focal
        for (label, found), (x, y) in zip(best.items(), lens.unproject(pixels).tolist(), strict=True):
            if not (np.isfinite(x) and np.isfinite(y)):
                continue
            sequence = self._sequences[camera]
            self._sequences[camera] += 1
            size = found.size / lens.focal
            number = self._labels.setdefault(label, len(self._labels))
            seen = SharedObservation(
                number_of(camera), len(boots), sequence, time, x, y, noise, size, _SIZE_STD if size > 0 else 0.0,
                number, std,
            )  # fmt: skip
            self._share(camera, seen)
        self._rows += len(best)
        if self._rows >= _ROWS:
            self._update()

    def _share(self, camera: str, seen: SharedObservation) -> None:
        for name, hosted in self._hosted.items():
            if name == camera:
                hosted.labels.add(seen.label)
            elif seen.label not in hosted.labels:
                continue
            self._noted(hosted.node.handle(seen))

    # other messages

    def _camera(self, message: pb.CameraInfo) -> None:
        camera = rig_camera(message)
        lens, reference = camera.intrinsics, Reference.of(camera)
        if lens is None:
            return
        if reference is not None:
            self._references.setdefault(message.camera, reference)
        known = self._lenses.setdefault(message.camera, lens)
        if same_lens(known, lens):
            if self.refused.pop(message.camera, None) is not None:
                self.counters["lens_back"] += 1
        elif message.camera not in self.refused:
            told = f"its lens changed (focal length {known.focal:.1f} to {lens.focal:.1f} px)"
            self.refused[message.camera] = f"{told}: zoom back, or restart the hub"
            self.notices.append(Notice(number_of(message.camera), "lens changed", self.refused[message.camera]))

    def _calibration(self, message: pb.Calibration) -> None:
        for camera in message.cameras:
            # A calibration by nodes alone tells no noise.
            told = camera.rms_px / np.sqrt(2.0)
            pixel = max(told, _LEAST_PIXEL_STD) if told > 0.0 else _PIXEL_STD
            fresh = _Clock(camera.boot_id, camera.clock_rate, camera.time_offset, camera.time_offset_std, pixel)
            last = self._clocks.get(camera.camera)
            self._clocks[camera.camera] = fresh
            # What waits to be paired was stamped by the old map.
            at = self._latest.get(camera.camera)
            if last is not None and at is not None and _jumped(last, fresh, at):
                self.counters["clock_jumps"] += 1
                for hosted in self._hosted.values():
                    hosted.node.forget_tracks()

    def _state(self, message: pb.NodeState) -> None:
        if message.host == self.hub:
            return
        camera, mine = message.camera, self._hosted.get(message.camera)
        if mine is not None:
            if (message.takeover, _claim(message.host, camera)) < (mine.takeover, _claim(self.hub, camera)):
                return  # its host will hear of us, and let go
            del self._hosted[camera]
            self.counters["handed_over"] += 1
        last = self._states.get(camera)
        if last is not None and (message.takeover, message.sequence) <= (last.takeover, last.sequence):
            if last.host == message.host:
                return
            if (message.takeover, _claim(message.host, camera)) < (last.takeover, _claim(last.host, camera)):
                return
        self._states[camera] = message
        self._heard[camera] = self._now
        if message.edges:
            self._edges[camera] = message
        self._to_neighbours(message)

    def _to_neighbours(self, message: pb.NodeState) -> None:
        state = state_from_wire(message)
        for name, hosted in self._hosted.items():
            if name != message.camera and state.camera in hosted.node.neighbours():
                self._noted(hosted.node.handle(state))

    def _noted(self, out: list[StateMessage | Notice]) -> list[StateMessage | Notice]:
        for item in out:
            if isinstance(item, Notice):
                self.notices.append(item)
                self.counters[item.kind.replace(" ", "_")] += 1
        return out

    # who hosts what

    def _let_go(self) -> list[pb.NodeState]:
        """Cameras that have gone, or are refused, leave the network; the last message of each."""
        out: list[pb.NodeState] = []
        for camera in list(self._hosted):
            gone = self._now - self._departed.get(camera, self._now) > self._leave_after
            if gone or camera in self.refused:
                hosted = self._hosted.pop(camera)
                out.append(state_to_wire(hosted.node.leave(), self.hub, hosted.takeover))
                self._states[camera] = out[-1]
                self._to_neighbours(out[-1])
        return out

    def _take_over(self) -> None:
        assert self._began is not None
        for camera in self._lenses:
            if camera in self._hosted or camera in self.refused or camera in self._departed:
                continue
            last = self._states.get(camera)
            free = last is None or last.leaving or self._is_dead(last.host, camera)
            if camera in self._pinned:
                free = free or (last is not None and last.host != self.hub)
            elif not free or self._rightful(camera) != self.hub:
                continue
            if not free or (last is None and self._now - self._began < _LISTEN_S):
                continue
            self._host(camera, last)

    def _host(self, camera: str, last: pb.NodeState | None) -> None:
        reference = self._references.get(camera)
        node = PoseNode(number_of(camera), reference=reference, seed=self._seed, gap=0.0 if self._shared else GAP)
        takeover = 0
        if last is not None:
            takeover = last.takeover + 1
            if not last.leaving:
                edges = self._edges.get(camera)
                known = {} if edges is None or edges.epoch != last.epoch else edges_from_wire(list(edges.edges))
                node.resume(state_from_wire(last), known)
                for other in self._states.values():
                    if other.camera != camera and number_of(other.camera) in known:
                        node.handle(state_from_wire(other))
                self.counters["taken_over"] += 1
        self._hosted[camera] = _Hosted(node, takeover)

    def _is_dead(self, host: str, camera: str) -> bool:
        if host == self.hub:
            return True  # an earlier life of this hub
        return host in self._gone or self._now - self._heard.get(camera, self._now) > _SILENT_S

    def _rightful(self, camera: str) -> str:
        alive = [hub for hub, boots in self._alive.items() if boots and hub not in self._gone]
        return max({*alive, self.hub}, key=lambda hub: _claim(hub, camera))


def same_lens(a: Intrinsics, b: Intrinsics) -> bool:
    """Whether two lenses are one: focal lengths, centre and distortion."""
    off: Floats = np.abs(a.matrix - b.matrix)
    return bool((off < _SAME_LENS * a.focal).all()) and (
        a.distortions.shape == b.distortions.shape and bool(np.allclose(a.distortions, b.distortions, atol=1e-3))
    )


def _claim(hub: str, camera: str) -> bytes:
    """Highest random weight: of the hubs alive, the one with the greatest claim hosts a camera."""
    return hashlib.blake2b(f"{hub}/{camera}".encode(), digest_size=8).digest()


def _jumped(last: _Clock, fresh: _Clock, at: float) -> bool:
    """Whether two maps of one camera differ by more than a track may bend, at camera time ``at`` [s]."""
    return last.boot != fresh.boot or abs((fresh.rate - last.rate) * at + fresh.offset - last.offset) > _CLOCK_JUMP_S
