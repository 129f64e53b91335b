"""A site with scripted messages: three cameras around a moving marker, a hub and a recorder, on a bus."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import cv2
import numpy as np

from hub.view.server import ViewServer, run_view
from protocols.bus.base import Publisher
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, PICTURE, STATUS, TRACK
from tests.support.samples import MATRIX, camera_info, observation, picture, track
from tests.support.threads import running

NAMES = ("cam0", "cam1", "cam2")
_TRACK_HZ, _CAMERA_EVERY, _SLOW_EVERY = 60, 3, 30
_PLACES = {"cam0": (3.0, -2.0, 1.6), "cam1": (-3.0, -2.0, 1.8), "cam2": (0.0, 3.5, 1.4)}
_LAGS = {"cam0": 0.0, "cam1": -1_758_248_739.777, "cam2": 150_025.272}


class ScriptedSite:
    """Attributes may be changed at any time; what is published follows them.

    state: the hub's; reasons: of cameras that are not calibrated. track: the marker's state, "" = none is published.
    filming, detecting, picturing: cameras that send frames, that see the marker, that send pictures. recording,
    recorder_state, recorder_message: of the recorder. tracks: number of published ones.
    """

    def __init__(self, bus: MemoryBus) -> None:
        self.state = "collecting"
        self.reasons: dict[str, str] = dict.fromkeys(NAMES, "too little motion yet")
        self.track = ""
        self.filming: tuple[str, ...] = NAMES
        self.detecting: tuple[str, ...] = NAMES
        self.picturing: tuple[str, ...] = NAMES[:2]
        self.recording, self.recorder_state, self.recorder_message = True, "running", ""
        self.tracks = self.revision = 0
        self._bus = bus
        self._publishers: dict[tuple[str, str], Publisher] = {}
        self._noise = np.random.default_rng(7)

    def publish(self, tick: int) -> None:
        """Publish one sixtieth of a second."""
        now = tick / _TRACK_HZ
        if tick % _CAMERA_EVERY == 0:
            for number, name in enumerate(self.filming):
                self._film(name, tick // _CAMERA_EVERY, now, number)
        if self.track:
            self._publish_track(now)
        if tick % _SLOW_EVERY == 0:
            self._report(tick)

    def _film(self, name: str, index: int, now: float, number: int) -> None:
        if index % 10 == 0:
            info = camera_info(name)
            info.distortions[:] = [0.0] * 5
            self._put(CAMERA_INFO.name, name, info)
        frame = observation(name, index)
        del frame.detections[0].head[:], frame.detections[0].foot[:]
        u, v = pixel(name, place(now))
        frame.detections[0].u, frame.detections[0].v = u, v
        if name not in self.detecting:
            del frame.detections[:]
        self._put(OBSERVATION.name, name, frame)
        if name in self.picturing and index % 10 == number:
            image = np.full((240, 320, 3), 90 + 40 * number, np.uint8)
            cv2.rectangle(image, (0, 150), (319, 239), (70, 90, 60), -1)
            cv2.circle(image, (round(u / 2), round(v / 2)), 5, (30, 140, 255), -1)
            shown = picture(name)
            shown.frame, shown.width, shown.height = frame.frame, 640, 480
            shown.jpeg = cv2.imencode(".jpg", image)[1].tobytes()
            self._put(PICTURE.name, name, shown)

    def _publish_track(self, now: float) -> None:
        self.tracks += 1
        found = track(self.tracks)
        found.kind, found.state, found.reference_time_ns = "marker", self.track, round(1e9 * now)
        found.position[:] = place(now).tolist()
        std = 0.03 if self.track == "coasting" else 0.004
        found.position_covariance[:] = (std**2 * np.eye(3)).ravel().tolist()
        found.unseen_s = 0.8 if self.track == "coasting" else 0.0
        self._put(TRACK.name, "hub", found)

    def _report(self, tick: int) -> None:
        recorder = pb.AgentStatus(schema_version=1, agent="recorder", role="record", boot_id="r", sequence=tick)
        recorder.state, recorder.gauges["recording"] = self.recorder_state, float(self.recording)
        recorder.message = self.recorder_message or (
            f"{40 * tick} messages" if self.recording else "paused after a.mcap"
        )
        recorder.gauges["log_bytes"] = 4_000.0 * tick
        hub = pb.AgentStatus(schema_version=1, agent="hub", role="hub", boot_id="h", sequence=tick, state="running")
        for status in (recorder, hub):
            self._put(STATUS.name, status.agent, status)
        self._put(CALIBRATION.name, "hub", self.calibration(tick))

    def calibration(self, tick: int) -> pb.Calibration:
        """The hub's next revision."""
        self.revision += 1
        solved = self.state in ("calibrated", "degraded")
        message = pb.Calibration(schema_version=1, revision=self.revision, state=self.state)
        message.status, message.reason = (
            ("solved", "") if solved else ("refused", "the cameras share too little motion")
        )
        message.reference_camera, message.scale, message.units = "cam0", "metric", "m"
        std = 2e-3 / math.sqrt(1 + tick)
        for name in NAMES:
            shared, reason = 0.05 * tick, self.reasons.get(name, "")
            state = self.state if reason or not solved else "calibrated"
            message.progress.append(
                pb.CameraProgress(camera=name, state=state, shared_motion_s=shared, coverage=0.3, reason=reason)
            )
            if solved:
                message.cameras.append(self._solved(name, std))
        return message

    def _solved(self, name: str, std: float) -> pb.CameraCalibration:
        pose, first = pose_of(name), name == NAMES[0]
        return pb.CameraCalibration(
            camera=name,
            rotation=pose.rodrigues.tolist(),
            translation=pose.translation.tolist(),
            clock_rate=1.0 if first else 1.0 + 2e-5,
            time_offset=_LAGS[name] + (0.0 if first else self._noise.normal(0.0, std)),
            time_offset_std=0.0 if first else std,
            position_std=[0.01, 0.01, 0.02],
            rms_px=0.4 + self._noise.normal(0.0, 0.03),
            matrix=MATRIX,
            distortions=[0.0] * 5,
            boot_id="boot-1",
        )

    def _put(self, topic: str, agent: str, message: object) -> None:
        key = (topic, agent)
        if key not in self._publishers:
            from protocols.topics import TOPICS_BY_NAME

            self._publishers[key] = self._bus.publisher(TOPICS_BY_NAME[topic], agent)
        self._publishers[key].put(message)  # type: ignore[arg-type]


def place(now: float) -> Floats:
    """Where the marker is."""
    return np.array([math.cos(1.3 * now), math.sin(1.7 * now), 1.0 + 0.5 * math.sin(0.9 * now)])


def pose_of(name: str) -> Pose:
    """A camera that looks at the middle of the scene, upright."""
    centre = np.array(_PLACES[name])
    ahead = np.array([0.0, 0.0, 1.0]) - centre
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    return Pose(np.stack([right, np.cross(ahead, right), ahead]), centre)


def pixel(name: str, point: Floats) -> tuple[float, float]:
    """Where a camera sees a point."""
    pose = pose_of(name)
    x, y, z = pose.rotation @ (point - pose.position)
    return MATRIX[0] * x / z + MATRIX[2], MATRIX[4] * y / z + MATRIX[5]


@contextmanager
def scripted_site(*, publishing: bool = True) -> Iterator[tuple[ScriptedSite, ViewServer]]:
    """A running site and its view. publishing: False = nothing is on the bus."""
    network, view = MemoryHub(), ViewServer(port=0)
    with MemoryBus(network) as agents, MemoryBus(network) as bus:
        site = ScriptedSite(agents)

        def run(stop: threading.Event) -> None:
            start = time.monotonic()
            tick = 0
            while not stop.wait(max(0.0, start + tick / _TRACK_HZ - time.monotonic())):
                site.publish(tick)
                tick += 1

        works = [lambda stop: run_view(bus, view, stop), run]
        with closing(view), running(*works[: 1 + publishing]):
            yield site, view
