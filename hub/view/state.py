"""View state of a site: messages in, the state of every camera, trajectory, drone and agent out.

No sockets, no clock and no browser code: the same state is shown live and in replay.
"""

from __future__ import annotations

import itertools
import re
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from google.protobuf.message import Message

from hub.calibration.coverage import CoverageMonitor
from hub.view.lag_history import LagHistory
from hub.view.uav_overlay import UavView
from protocols import topics
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb

SILENT_S = 2.0
"""A camera without a frame for longer than this is silent."""
STALE_S = 5.0
"""An agent without a status, or a track without a message, for longer than this is not to be trusted."""
_RATE_S = 3.0  # window of the frame rate [s]
_PATH_POINTS = 700  # 23 s at 30 a second, a little more than is drawn
_PATH_INTERVAL_S = 1 / 30  # between two kept points of a trajectory: tracks come at up to 120 Hz
_NEW_CLOCK_S = 5.0  # a track that goes back by more is on another clock
_MAX_PATHS = 48  # tracked people get new labels: the track not updated for longest is dropped
_MAX_PROBLEMS = 3  # in the headline
_MAX_ALARM = 300  # characters of the status of an agent that is still starting

_CALIBRATED = re.compile(r"(?:^|; )\d+ cameras calibrated")
CameraState = Literal["calibrated", "degraded", "searching", "collecting", "refused", "silent", "gone"]
"""The hub's word for a camera, or that no frames come."""
_WORDS: dict[str, CameraState] = {
    "calibrated": "calibrated",
    "degraded": "degraded",
    "searching": "searching",
    "refused": "refused",
}

LATCHED = (topics.CAMERA_INFO, topics.CALIBRATION, topics.STATUS, topics.UAV_INFO)
"""Topics of which the last message of each sender is valid until it is replaced."""
TOPICS = (*LATCHED, topics.OBSERVATION, topics.TRACK, topics.TARGET)
ON_IMAGES = (topics.TARGET_CLOUD, topics.ROAD_MAP)


@dataclass(slots=True, eq=False)
class CameraView:
    """One camera. Times are the view's own [s]; calibration is None until a hub has published one.

    verdict, reason: the hub's word for it, and why. refused: the reason if it is refused. lost: missing frames by
    sequence number. detections: of the last frame: u, v, size [px]; by_frame: of the last frames. is_static: the camera
    is from a calibration file, so no frames are expected.
    """

    name: str
    info: pb.CameraInfo | None = None
    boot: str = ""
    frames: int = 0
    seen: int = 0
    lost: int = 0
    restarts: int = 0
    last_frame: float | None = None
    last_seen: float | None = None
    detections: list[tuple[float, float, float]] = field(default_factory=list)
    by_frame: deque[tuple[int, list[tuple[float, float, float]]]] = field(default_factory=lambda: deque(maxlen=512))
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=256))
    calibration: pb.CameraCalibration | None = None
    progress: pb.CameraProgress | None = None
    lags: LagHistory = field(default_factory=LagHistory)
    verdict: CameraState = "collecting"
    reason: str = ""
    refused: str = ""
    refusals: int = 0
    alive: bool = True
    picture: pb.Picture | None = None
    pictures: int = 0
    last_picture: float | None = None
    sequence: int = -1
    is_static: bool = False

    @property
    def pose(self) -> Pose | None:
        """The camera pose (world to camera), None until it is known."""
        found = self.calibration
        if found is None:
            return None
        return Pose.from_rodrigues(np.array(found.rotation), np.array(found.translation))

    def detections_in_image(self) -> list[tuple[float, float, float]]:
        """Detections in the frame of the shown image, which is older than the last frame; u, v, size [px]."""
        if self.picture is None:
            return []
        return next((found for frame, found in reversed(self.by_frame) if frame == self.picture.frame), [])

    def fps(self, now: float) -> float:
        """Mean frame rate of the last seconds [1/s]."""
        recent = [moment for moment in self.arrivals if moment > now - _RATE_S]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 2 and recent[-1] > recent[0] else 0.0

    def state(self, now: float) -> CameraState:
        """The state of the camera at ``now``."""
        if not self.alive:
            return "gone"
        if not self.is_static and (self.last_frame is None or now - self.last_frame > SILENT_S):
            return "silent"
        return self.verdict


PathPoint = tuple[float, float, float, float, float, float]
"""Reference time [s], x, y, z, std of one axis, 1 if coasting."""


@dataclass(slots=True, eq=False)
class PathView:
    """The trajectory of one point, newest last. last: its last message; at: when it came [s]; count: of messages."""

    label: str
    last: pb.Track
    points: deque[PathPoint] = field(default_factory=lambda: deque(maxlen=_PATH_POINTS))
    at: float = 0.0
    count: int = 0

    def add(self, message: pb.Track, now: float) -> None:
        """Add a message; of points closer together than 1/30 s only the newest is kept."""
        variance = message.position_covariance[::4]
        std = float(np.sqrt(np.mean(variance))) if variance else 0.0
        x, y, z = message.position
        time = message.reference_time_ns / NANOSECONDS
        points = self.points
        if points and time < points[-1][0] - _NEW_CLOCK_S:
            points.clear()
        if len(points) > 1 and 0.0 <= points[-1][0] - points[-2][0] < _PATH_INTERVAL_S:
            points.pop()
        points.append((time, x, y, z, std, float(message.state == "coasting")))
        self.last, self.at, self.count = message, now, self.count + 1

    def state(self, now: float) -> str:
        """The hub's word for the track, "stale" if none has come for long."""
        return "stale" if now - self.at > STALE_S else self.last.state

    def array(self, after: float = -np.inf) -> Floats:
        """(n, 6) in order of time: the columns of `PathPoint`. after: a reference time [s]; only points not before."""
        found = list(itertools.takewhile(lambda point: point[0] >= after, reversed(self.points)))
        return np.array(sorted(found), dtype=np.float64).reshape(-1, 6)


@dataclass(slots=True, eq=False)
class AgentView:
    """One agent: its last status and its arrival time [s].

    since: when a recorder began, or ceased, to record [s]; at the latest, unless the change was seen.
    """

    status: pb.AgentStatus
    at: float
    since: float = 0.0
    change_seen: bool = False
    alive: bool = True

    @property
    def recording(self) -> bool:
        """Whether a recorder writes a log now."""
        return self.alive and self.status.state != "stopping" and bool(self.status.gauges.get("recording", 1.0))


class ViewState:
    """All data that a view shows. ``handle`` takes messages with the view's time [s, any monotonic clock]."""

    def __init__(self, is_static: bool = False, *, is_live: bool = True) -> None:
        self._is_static, self._is_live = is_static, is_live
        self.cameras: dict[str, CameraView] = {}
        self.paths: dict[str, PathView] = {}
        self.agents: dict[str, AgentView] = {}
        self.uavs: dict[str, UavView] = {}
        self.calibration: pb.Calibration | None = None
        self.solved: pb.Calibration | None = None
        self.guidance = CoverageMonitor()
        self.revision = 0
        self.lost_at: float | None = None
        """Since when this view reaches nobody, as when its router has ended."""

    def handle(self, message: Message, now: float) -> None:
        """Process one message from the bus or a log."""
        if isinstance(message, pb.Observation):
            self._observe(message, now)
        elif isinstance(message, pb.Track):
            self._add_track(message, now)
        elif isinstance(message, pb.Picture):
            if message.camera in self.uavs:
                self.uavs[message.camera].show_thumbnail(message, now)
                return
            camera = self._camera(message.camera)
            camera.picture, camera.pictures, camera.last_picture = message, camera.pictures + 1, now
        elif isinstance(message, (pb.TargetState, pb.TargetCloud, pb.RoadMap, pb.UavInfo, pb.FlightImage)):
            self._uav(message.agent).handle(message, now)
        elif isinstance(message, pb.AgentStatus) and message.role == "uav":
            self._uav(message.agent).status = message
        elif isinstance(message, pb.CameraInfo):
            self._camera(message.camera).info = message
            self.guidance.handle(message)
        elif isinstance(message, pb.Calibration):
            self._calibrate(message, now)
        elif isinstance(message, pb.AgentStatus):
            self._hear(message, now)

    def presence(self, role: str, agent: str, alive: bool, boot: str) -> None:
        """An agent appeared or disappeared; of a restarted camera only the newest boot id counts."""
        if role == "camera":
            camera = self._camera(agent)
            if alive or camera.boot in ("", boot):
                camera.alive = alive
                if not alive:
                    self.agents.pop(agent, None)
        elif role == "uav":
            if alive:
                self._uav(agent)
            elif agent in self.uavs and self.uavs[agent].boot in ("", boot):
                del self.uavs[agent]
        elif agent in self.agents and self.agents[agent].status.boot_id == boot:
            self.agents[agent].alive = alive

    def of_role(self, role: str) -> list[AgentView]:
        """The running agents of a role, by name."""
        agents = (self.agents[name] for name in sorted(self.agents))
        return [agent for agent in agents if agent.alive and agent.status.role == role]

    @property
    def hub_state(self) -> str:
        """The hub's own word for the site: its state, or the status of an older hub; "" if none was heard."""
        return "" if self.calibration is None else _word(self.calibration)

    def headline(self) -> str:
        """One line of status for the whole site; its first word is the hub's state."""
        found, word = self.calibration, self.hub_state
        if not self.cameras and self.uavs:
            return f"{len(self.uavs)} drone{'s' if len(self.uavs) > 1 else ''}"
        if not self.cameras:
            return "waiting for cameras"
        if found is None:
            return f"waiting for a hub: {_counted(len(self.cameras))}, no calibration received yet"
        if word not in ("calibrated", "degraded"):
            return f"{word}: {found.reason}"
        shown = self.solved or found
        stds = [camera.time_offset_std for camera in shown.cameras]
        refused = sum(camera.verdict == "refused" for camera in self.cameras.values())
        parts = [
            f"{word}: {_counted(len(shown.cameras))}",
            f"lags ± {1e3 * max(stds):.2g} ms" if any(stds) else "",  # not known, as of other tools' calibrations
            f"{refused} refused" if refused else "",
            found.reason if word == "degraded" else "",
        ]
        return ", ".join(part for part in parts if part)

    def problems(self, now: float) -> list[str]:
        """What is wrong with the agents of the site, by name; empty while all are well."""
        out = [] if self.lost_at is None else [f"this view reaches no router for {now - self.lost_at:.0f} s"]
        out += [] if self._is_static else [text for camera in self.cameras.values() if (text := _absence(camera, now))]
        for name, agent in sorted(self.agents.items()):
            role, status = agent.status.role, agent.status
            if not agent.alive:
                if not self.of_role(role):
                    out.append(f"{name} has ended" + (f": {status.message}" if status.state == "stopping" else ""))
            elif status.state == "stopping" and role == "hub":
                out.append(f"{name} is being stopped: {status.message}")
            elif status.state == "degraded" or (status.state == "stopping" and role == "record"):
                # What comes after a hub's number of cameras is in their rows and in the advice.
                text = _CALIBRATED.split(status.message)[0] if role == "hub" else status.message
                out.append(f"{name}: {text or status.message or status.state}")
            elif status.counters.get("alarms"):  # they come first; a hub that waits says much else
                out.append(f"{name}: {status.message[:_MAX_ALARM]}")
            elif role != "camera" and now - agent.at > STALE_S:
                out.append(f"{name} has sent no status for {now - agent.at:.0f} s")
        more = len(out) - _MAX_PROBLEMS
        return [*out[:_MAX_PROBLEMS], f"{more} more"] if more > 0 else out

    def next_steps(self) -> list[str]:
        """What to do next, the most urgent first; empty if nothing is missing."""
        if self._is_static or (self.uavs and not self.cameras):
            return []
        steps = []
        if self._is_live and not self.cameras:
            steps.append("no camera yet: start one on each camera's machine: syncline camera camera.toml")
        if self._is_live and self.calibration is None and not self.of_role("hub"):
            steps.append("no hub yet: start one: syncline hub hub.toml")
        return [*steps, *(advice.text for advice in self.guidance.advice())]

    def _camera(self, name: str) -> CameraView:
        if name not in self.cameras:
            self.cameras[name] = CameraView(name, is_static=self._is_static)
            self.cameras = {key: self.cameras[key] for key in sorted(self.cameras, key=_natural_order)}
        return self.cameras[name]

    def _uav(self, name: str) -> UavView:
        if name not in self.uavs:
            self.uavs[name] = UavView(name)
            # An image may arrive before it is known that its sender is a drone.
            camera = self.cameras.get(name)
            if camera is not None and not camera.frames and camera.info is None:
                self.uavs[name].picture = camera.picture
                del self.cameras[name]
        return self.uavs[name]

    def _observe(self, message: pb.Observation, now: float) -> None:
        camera = self._camera(message.camera)
        if message.boot_id != camera.boot:
            camera.restarts += bool(camera.boot)
            camera.boot, camera.sequence, camera.alive = message.boot_id, message.sequence - 1, True
            camera.by_frame.clear()
        if message.sequence <= camera.sequence:
            return  # a duplicate, or recovered out of order
        camera.lost += message.sequence - camera.sequence - 1
        camera.sequence = message.sequence
        camera.frames += 1
        camera.last_frame = now
        camera.arrivals.append(now)
        camera.detections = [(one.u, one.v, one.size) for one in message.detections]
        camera.by_frame.append((message.frame, camera.detections))
        if message.detections:
            camera.seen += 1
            camera.last_seen = now
        self.guidance.handle(message)

    def _hear(self, message: pb.AgentStatus, now: float) -> None:
        """Process the status of a camera, hub or recorder."""
        before, agent = self.agents.get(message.agent), AgentView(message, now, since=now)
        if before is not None:
            # Its last status may be read after it was seen to end.
            agent.alive = before.alive or before.status.boot_id != message.boot_id
            agent.change_seen = before.recording != agent.recording
            if not agent.change_seen:
                agent.since, agent.change_seen = before.since, before.change_seen
        self.agents[message.agent] = agent

    def _add_track(self, message: pb.Track, now: float) -> None:
        path = self.paths.pop(message.label, None)
        if message.state == "lost":
            return
        self.paths[message.label] = path = path or PathView(message.label, message)  # most recently updated last
        while len(self.paths) > _MAX_PATHS:
            del self.paths[next(iter(self.paths))]
        path.add(message, now)

    def _calibrate(self, message: pb.Calibration, now: float) -> None:
        is_new = self.solved is None or message.revision != self.solved.revision
        self.calibration = message
        self.revision += 1
        refused = {entry.camera: entry.reason for entry in message.refused}
        progress = {entry.camera: entry for entry in message.progress}
        if message.status == "solved":
            self.solved = message
            solved = {entry.camera: entry for entry in message.cameras}
            reference = solved.get(message.reference_camera)
            for name, found in solved.items():
                camera = self._camera(name)
                if is_new:
                    clocks = (found.boot_id, message.reference_camera, "" if reference is None else reference.boot_id)
                    camera.lags.add(found, clocks, now)
            for name, camera in self.cameras.items():
                camera.calibration = solved.get(name)
            self._forget({*solved, *refused, *progress}, now)
        word = _word(message)
        for name in progress:
            self._camera(name)
        for name, camera in self.cameras.items():
            camera.progress, was = progress.get(name), camera.verdict
            camera.reason = refused.get(name, "")
            if camera.progress is not None:
                camera.verdict = _WORDS.get(camera.progress.state, "collecting")
                camera.reason = camera.progress.reason or camera.reason
            elif name in refused and word not in ("collecting", "searching"):
                camera.verdict = "refused"
            else:
                waiting: CameraState = "searching" if word == "searching" else "collecting"
                camera.verdict = waiting if camera.calibration is None else "calibrated"
            camera.refused = camera.reason if camera.verdict == "refused" else ""
            camera.refusals += camera.verdict == "refused" != was

    def _forget(self, known: set[str], now: float) -> None:
        """Drop the cameras that send nothing and that the hub no longer speaks of, as it was asked to forget them."""
        for name, camera in list(self.cameras.items()):
            if camera.progress is not None and name not in known and camera.state(now) in ("silent", "gone"):
                del self.cameras[name]
                self.agents.pop(name, None)
                self.guidance.forget(name)


def _word(message: pb.Calibration) -> str:
    return message.state or {"solved": "calibrated"}.get(message.status, message.status)


def _natural_order(name: str) -> list[str | int]:
    """What sorts cam2 before cam10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _counted(cameras: int) -> str:
    return f"{cameras} camera{'' if cameras == 1 else 's'}"


def _absence(camera: CameraView, now: float) -> str:
    """What a camera that sends no frames is said to be; "" for the others."""
    status = camera.state(now)
    if status == "gone":
        return f"{camera.name} is gone"
    if status != "silent":
        return ""
    since = "" if camera.last_frame is None else f" for {now - camera.last_frame:.0f} s"
    return f"{camera.name} has sent no frames{since}"
