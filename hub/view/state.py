"""View state of a site: messages in, the state of every camera, trajectory, drone and agent out.

No sockets, no clock and no browser code: the same state is shown live and in replay.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from google.protobuf.message import Message

from hub.calibration.coverage import CoverageMonitor
from hub.view.uav_state import UavView
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb

SILENT_S = 2.0
"""A camera without a frame for longer than this is silent."""
_RATE_S = 3.0  # window of the frame rate [s]
_PATH_POINTS = 1200
_MAX_PATHS = 48  # tracked people get new labels: the track not updated for longest is dropped

CameraState = Literal["solved", "refused", "collecting", "silent", "gone"]


@dataclass(slots=True, eq=False)
class CameraView:
    """One camera. Times are the view's own [s]; calibration is None until a hub has published one.

    lost: missing frames by sequence number. detections: of the last frame: u, v, size [px]; by_frame: of the last
    frames. is_static: the camera is from a calibration file, so no frames are expected.
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
    by_frame: deque[tuple[int, list[tuple[float, float, float]]]] = field(default_factory=lambda: deque(maxlen=128))
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=256))
    calibration: pb.CameraCalibration | None = None
    refused: str = ""
    refusals: int = 0
    alive: bool = True
    picture: pb.Picture | None = None
    pictures: int = 0
    sequence: int = -1
    is_static: bool = False

    @property
    def pose(self) -> Pose | None:
        """The camera pose (world to camera), None until it is known."""
        found = self.calibration
        if found is None:
            return None
        rotation = so3.exp(np.array(found.rotation))
        return Pose(rotation, -rotation.T @ np.array(found.translation))

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
        if self.refused:
            return "refused"
        return "solved" if self.calibration is not None else "collecting"


@dataclass(slots=True, eq=False)
class PathView:
    """The trajectory of one point: reference time [s], x, y, z, std of one axis; newest last."""

    label: str
    points: deque[tuple[float, float, float, float, float]] = field(default_factory=lambda: deque(maxlen=_PATH_POINTS))
    state: str = ""
    count: int = 0

    def array(self) -> Floats:
        """(n, 5) in order of time."""
        return np.array(sorted(self.points), dtype=np.float64).reshape(-1, 5)


@dataclass(slots=True, eq=False)
class AgentView:
    """One hub or recorder: its last status and its arrival time [s]."""

    status: pb.AgentStatus
    at: float


class ViewState:
    """All data that a view shows. ``handle`` takes messages with the view's time [s, any monotonic clock]."""

    def __init__(self, is_static: bool = False) -> None:
        self._is_static = is_static
        self.cameras: dict[str, CameraView] = {}
        self.paths: dict[str, PathView] = {}
        self.agents: dict[str, AgentView] = {}
        self.uavs: dict[str, UavView] = {}
        self.calibration: pb.Calibration | None = None
        self.solved: pb.Calibration | None = None
        self.guidance = CoverageMonitor()
        self.revision = 0

    def handle(self, message: Message, now: float) -> None:
        """Process one message from the bus or a log."""
        if isinstance(message, pb.Observation):
            self._observe(message, now)
        elif isinstance(message, pb.Track):
            self._add_track(message)
        elif isinstance(message, pb.Picture):
            if message.camera in self.uavs:
                self.uavs[message.camera].show_thumbnail(message, now)
                return
            camera = self._camera(message.camera)
            camera.picture, camera.pictures = message, camera.pictures + 1
        elif isinstance(message, (pb.TargetState, pb.TargetCloud, pb.RoadMap, pb.UavInfo, pb.FlightImage)):
            self._uav(message.agent).handle(message, now)
        elif isinstance(message, pb.AgentStatus) and message.role == "uav":
            self._uav(message.agent).status = message
        elif isinstance(message, pb.CameraInfo):
            self._camera(message.camera).info = message
            self.guidance.handle(message)
        elif isinstance(message, pb.Calibration):
            self._calibrate(message)
        elif isinstance(message, pb.AgentStatus) and message.role != "camera":
            self.agents[message.agent] = AgentView(message, now)

    def presence(self, role: str, agent: str, alive: bool, boot: str) -> None:
        """An agent appeared or disappeared; of a restarted camera only the newest boot id counts."""
        if role == "camera":
            camera = self._camera(agent)
            if alive or camera.boot in ("", boot):
                camera.alive = alive
        elif role == "uav":
            if alive:
                self._uav(agent)
            elif agent in self.uavs and self.uavs[agent].boot in ("", boot):
                del self.uavs[agent]
        elif not alive and agent in self.agents and self.agents[agent].status.boot_id == boot:
            del self.agents[agent]

    def of_role(self, role: str) -> list[AgentView]:
        """The agents of a role, by name."""
        return [self.agents[name] for name in sorted(self.agents) if self.agents[name].status.role == role]

    def headline(self) -> str:
        """One line of status for the whole site."""
        found = self.calibration
        if not self.cameras and self.uavs:
            return f"{len(self.uavs)} drone{'s' if len(self.uavs) > 1 else ''}"
        if not self.cameras:
            return "waiting for cameras"
        if found is None:
            return f"{len(self.cameras)} cameras, no calibration received yet"
        if found.status == "solved":
            stds = [camera.time_offset_std for camera in found.cameras]
            refused = f", {len(found.refused)} refused" if found.refused else ""
            return f"{len(found.cameras)} cameras calibrated, offsets ± {1e3 * max(stds, default=0.0):.2f} ms{refused}"
        return f"{found.status}: {found.reason}"

    def _camera(self, name: str) -> CameraView:
        if name not in self.cameras:
            self.cameras[name] = CameraView(name, is_static=self._is_static)
            self.cameras = {key: self.cameras[key] for key in sorted(self.cameras)}
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

    def _add_track(self, message: pb.Track) -> None:
        path = self.paths.pop(message.label, None) or PathView(message.label)
        self.paths[message.label] = path  # most recently updated last
        while len(self.paths) > _MAX_PATHS:
            del self.paths[next(iter(self.paths))]
        variance = message.position_covariance[::4]
        std = float(np.sqrt(np.mean(variance))) if variance else 0.0
        x, y, z = message.position
        path.points.append((message.reference_time_ns / NANOSECONDS, x, y, z, std))
        path.state, path.count = message.state, path.count + 1

    def _calibrate(self, message: pb.Calibration) -> None:
        self.calibration = message
        self.revision += 1
        refused = {entry.camera: entry.reason for entry in message.refused}
        if message.status == "solved":
            self.solved = message
            solved = {entry.camera: entry for entry in message.cameras}
            for name in solved:
                self._camera(name)
            for name, camera in self.cameras.items():
                camera.calibration = solved.get(name)
        for name, camera in self.cameras.items():
            camera.refusals += name in refused and not camera.refused
            camera.refused = refused.get(name, "")
