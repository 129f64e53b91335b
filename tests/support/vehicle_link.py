"""A simulated autopilot on UDP with a camera component behind it, in threads and real time, for ground stations."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from edge.devices.simulated.aircraft import SimulatedAircraft
from edge.mavlink.dialect import CAMERA
from edge.mavlink.link.connection import Link
from edge.mavlink.link.transport import Transport, Udp, Url, parse_url
from edge.mavlink.roles import camera, telemetry
from edge.mavlink.roles.autopilot import Autopilot
from edge.mavlink.roles.camera import CameraComponent, OperatorCommand, SelectTarget
from edge.mavlink.roles.camera_messages import VideoStream
from edge.mavlink.roles.vehicle import Vehicle
from protocols.geometry.camera import Intrinsics
from tests.support.threads import looping

LENS = Intrinsics(640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]))
URI = "rtsp://127.0.0.1:8554/overlay"


@contextmanager
def autopilot(**options: Any) -> Iterator[tuple[Autopilot, int]]:
    """A hovering aircraft's autopilot, and the UDP port where it waits for senders."""
    transport = Udp(Url("udpin", "127.0.0.1", 0), bound=True)
    simulated = Autopilot(SimulatedAircraft(start=np.array([0.0, 0.0, -60.0])), transport, **options)
    began = time.monotonic()
    with looping(lambda: simulated.step(time.monotonic() - began)):
        yield simulated, transport.port
    transport.close()


@dataclass
class CameraOnLink:
    """A camera component that follows whatever is selected. url: its link's address, or transport: an open one.

    commands: what was selected and stopped.
    """

    url: str = ""
    transport: Transport | None = None
    now_ns: Callable[[], int] = time.monotonic_ns
    commands: list[OperatorCommand] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.link = Link(
            parse_url(self.url) if self.url else None,
            system=None,
            component=CAMERA,
            allowed=(*telemetry.MESSAGE_TYPES, *camera.MESSAGE_TYPES),
            transport=self.transport,
            now_ns=self.now_ns,
        )
        self.component = CameraComponent(self.link, (640, 480), 30.0, LENS, VideoStream("rtsp", URI), self._execute)
        self.vehicle = Vehicle(self.link, gimbal=False)

    def step(self) -> None:
        """Receive, answer, and send what is due."""
        now_ns = self.now_ns()
        self.vehicle.tick(now_ns)
        for received in self.link.poll():
            if received.system == self.link.vehicle:
                self.vehicle.handle(received)
            self.component.handle(received, 1e-9 * now_ns)
        self.component.tick(1e-9 * now_ns, frame=True)

    def _execute(self, command: OperatorCommand) -> bool:
        self.commands.append(command)
        status = self.component.status
        status.state = "visible" if isinstance(command, SelectTarget) else "idle"
        if isinstance(command, SelectTarget):
            status.centre = (0.5 * (command.left + command.right), 0.5 * (command.top + command.bottom))
            status.half_size = (0.5 * (command.right - command.left), 0.5 * (command.bottom - command.top))
        return True


@contextmanager
def camera_on(url: str) -> Iterator[CameraOnLink]:
    """A running camera component at an address."""
    one = CameraOnLink(url)
    with looping(one.step):
        yield one
    one.link.close()
