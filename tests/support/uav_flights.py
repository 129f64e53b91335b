"""The UAV agent and its simulated aircraft in one process, in steps of 10 ms of simulated time.

Real MAVLink bytes are exchanged; the ground station is pymavlink's own codec, not ours.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

os.environ["MAVLINK20"] = "1"
from google.protobuf.message import Message
from pymavlink.dialects.v20 import common as mavlink

from deploy.agents.uav import gimbal_from_camera, make_agent
from deploy.config.uav import SimulatedFlightConfig, UavConfig
from edge.agents.uav import UavAgent
from edge.agents.uav_settings import UavSettings
from edge.devices.base import Frame
from edge.devices.simulated.aircraft import Disturbance, FlightCamera, SimulatedAircraft
from edge.mavlink.dialect import CAMERA
from edge.mavlink.link.connection import Link
from edge.mavlink.link.signing import Signing
from edge.mavlink.link.transport import Address
from edge.mavlink.roles import camera, telemetry
from edge.mavlink.roles.autopilot import Autopilot, LinkFaults
from edge.mavlink.roles.camera_messages import VideoStream
from edge.mavlink.settings import GuidanceLimits
from edge.uav.world.flight_world import FlightWorld, GroundTruth
from tests.support.clocks import AsFastAsPossible
from tests.support.pipe import Pipe

STEP_S = 0.01
TRANSFER_S = 0.02
"""From a frame's exposure until the agent receives it."""
HOST_AHEAD_S = 5000.0
UNIX_S = 1_700_000_000.0


class Air:
    """Several pipes as one datagram socket."""

    def __init__(self) -> None:
        self.pipes: list[Pipe] = []

    def join(self) -> Pipe:
        """The remote end of a new pipe."""
        near, far = Pipe.pair()
        self.pipes.append(near)
        return far

    def wait(self, timeout_s: float) -> bool:
        return True

    def receive(self) -> list[tuple[bytes, Address]]:
        return [(data, ("pipe", k)) for k, pipe in enumerate(self.pipes) for data, _ in pipe.receive()]

    def send(self, data: bytes, address: Address | None) -> bool:
        return address is None or self.pipes[address[1]].send(data, None)

    def close(self) -> None:
        pass


class GroundStation:
    """pymavlink's codec on a pipe. received: all messages by kind."""

    def __init__(self, pipe: Pipe, key: bytes | None = None) -> None:
        self._pipe = pipe
        self.codec = mavlink.MAVLink(None, 255, 190)
        self.codec.robust_parsing = True
        if key is not None:
            self.codec.signing.secret_key, self.codec.signing.sign_outgoing = key, True
            self.codec.signing.timestamp = round((UNIX_S - 1_420_070_400) * 1e5)
        self.received: dict[str, list[Any]] = {}

    def poll(self) -> None:
        """Process the received bytes."""
        for data, _ in self._pipe.receive():
            for message in self.codec.parse_buffer(data) or []:
                self.received.setdefault(message.get_type(), []).append(message)

    def send(self, message: Any) -> bytes:
        """Send a message; returns its bytes."""
        data = bytes(message.pack(self.codec))
        self.codec.seq = (self.codec.seq + 1) % 256
        self._pipe.send(data, None)
        return data

    def command(self, command: int, *parameters: float) -> None:
        """Send a COMMAND_LONG to the camera."""
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self.send(mavlink.MAVLink_command_long_message(1, CAMERA, command, 0, *filled))

    def last(self, kind: str) -> Any:
        """The newest message of a kind; None if none was received."""
        return self.received.get(kind, [None])[-1]


@dataclass
class Flight:
    """One flight. published: all messages that the agent published on the bus. turned: the camera, about its axis."""

    world: FlightWorld
    control: GuidanceLimits = field(default_factory=GuidanceLimits)
    flies: str = "path"
    gimbal: tuple[float, float] | None = None
    gimbal_ahead_s: float = 0.0
    start: np.ndarray | None = None
    yaw: float = 0.0
    disturbances: tuple[Disturbance, ...] = ()
    faults: LinkFaults = field(default_factory=LinkFaults)
    boot_s: float = 321.0
    camera_ahead_s: float = 77.7
    key: bytes | None = None
    jpeg_quality: int | None = None
    noise_rad: float = 0.001
    piloted: bool = False
    turned: np.ndarray = field(default_factory=lambda: np.eye(3))
    seed: int = 0

    def __post_init__(self) -> None:
        path = self.world.flight if self.flies == "path" else None
        self.aircraft = SimulatedAircraft(
            path,
            start=self.start,
            yaw=self.yaw,
            pilot=self.world.target_at if self.flies == "follow" and self.piloted else None,
            camera=np.asarray(self.world.body_from_camera) if self.gimbal is None else None,
            gimbal=self.gimbal,
            disturbances=self.disturbances,
            noise_rad=self.noise_rad,
            seed=self.seed,
        )
        self.air = Air()
        agent_end, station_end = self.air.join(), self.air.join()
        self.agent_pipe = agent_end
        self.autopilot = Autopilot(
            self.aircraft,
            self.air,
            boot_s=self.boot_s,
            faults=self.faults,
            seed=self.seed,
            signing=None if self.key is None else Signing(self.key),
            gimbal_ahead_s=self.gimbal_ahead_s,
        )
        self.station = GroundStation(station_end, self.key)
        self.time = 0.0
        self.pace = AsFastAsPossible()
        self.device = FlightCamera(self.world, self.aircraft, self.pace, clock_offset_s=self.camera_ahead_s)
        self.device.open()
        self.link = Link(
            None,
            system=None,
            component=CAMERA,
            allowed=(*telemetry.MESSAGE_TYPES, *camera.MESSAGE_TYPES),
            signing=None if self.key is None else Signing(self.key),
            transport=agent_end,
            now_ns=self.now_ns,
            unix_s=lambda: UNIX_S + self.time,
        )
        mounting = gimbal_from_camera() if self.gimbal is not None else np.asarray(self.world.body_from_camera)
        mounting = mounting @ self.turned
        config = UavConfig(
            id="drone",
            mount="fixed" if self.gimbal is None else "gimbal",
            simulated=SimulatedFlightConfig(gimbal=self.gimbal is not None),
            control=self.control,
        )
        looking = UavSettings(
            self.world.size, self.world.fps, self.world.lens, mounting, jpeg_quality=self.jpeg_quality, seed=self.seed
        )
        agent = make_agent(
            config, self.device, self.link, looking, now_ns=self.now_ns, boot_id="boot",
            stream=VideoStream("mjpeg", "http://127.0.0.1:8560/stream.mjpg"),
        )  # fmt: skip
        assert isinstance(agent, UavAgent)
        self.agent = agent
        self.published: list[Message] = [agent.info()]
        agent._publish = self._take
        self.frame = -1
        self.frames_lost: Callable[[int], bool] = lambda frame: False
        self.on_frame: Callable[[int], None] = lambda frame: None
        self._beat = 0.0

    def now_ns(self) -> int:
        """The host's monotonic clock."""
        return round((self.time + HOST_AHEAD_S) * 1e9)

    def run(self, until: float) -> None:
        """Simulate up to the world time ``until`` [s]."""
        while self.time < until - 1e-9:
            self.time = round(self.time + STEP_S, 6)
            self.autopilot.step(self.time)
            if self.time >= self._beat:
                self._beat = self.time + 1.0
                self.station.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
            index = int(np.floor((self.time - TRANSFER_S) * self.world.fps + 1e-6))
            frame = None
            if self.frame < index < self.world.length:
                self.frame = index
                if not self.frames_lost(index):
                    frame = Frame(self.device.render_frame(index), self.device.device_time_ns(index), index)
            self.agent.step(self.link.poll(), frame)
            self.station.poll()
            if frame is not None:
                self.on_frame(index)

    def select(self, wait_s: float = 0.1) -> bool:
        """Select the car in the newest frame by a MAVLink rectangle; returns whether that was accepted."""
        width, height = self.world.size
        box = self.truth(self.frame).box
        left, top = (box.x + 0.5) / width, (box.y + 0.5) / height
        self.station.command(
            mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, left, top, left + box.width / width, top + box.height / height
        )
        self.station.received.pop("COMMAND_ACK", None)
        self.run(self.time + wait_s)
        answers = [m for m in self.station.received.get("COMMAND_ACK", []) if m.get_srcComponent() == CAMERA]
        return bool(answers) and answers[-1].result == mavlink.MAV_RESULT_ACCEPTED

    def arm_follow(self, follow: bool = True) -> bool:
        """Let the vehicle follow the target, as a station does; returns whether that was accepted."""
        self.station.command(mavlink.MAV_CMD_DO_FOLLOW, 1.0 if follow else 0.0)
        self.station.received.pop("COMMAND_ACK", None)
        self.run(self.time + 0.1)
        answer = self.station.last("COMMAND_ACK")
        return answer is not None and answer.result == mavlink.MAV_RESULT_ACCEPTED

    def truth(self, frame: int) -> GroundTruth:
        """Ground truth of a frame for the camera pose of that time; at most 3 s ago."""
        rotation, centre = self.aircraft.camera_from_ned(self.world.time(frame), self.world.body_from_camera)
        return self.world.truth_from(frame, rotation, centre)

    def messages(self, kind: type[Message]) -> list[Any]:
        """The published messages of one type."""
        return [message for message in self.published if isinstance(message, kind)]

    def _take(self, message: Message) -> None:
        self.published.append(message)
