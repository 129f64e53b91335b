"""The UAV agent: one thin loop between a camera, a MAVLink link, the estimator and the bus."""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from google.protobuf.message import Message

from edge.agents.publish_queue import Outbox
from edge.agents.target_report import line, show
from edge.agents.thumbnails import WIDTH, picture_message
from edge.devices.base import Device, Frame, Image
from edge.mavlink.link.connection import Heard, Link
from edge.mavlink.link.receiver import Ear
from edge.mavlink.roles.camera import CameraComponent, Select, Stop
from edge.mavlink.roles.guidance import Aim, Control
from edge.mavlink.roles.vehicle import Sample, Vehicle
from edge.uav.estimator import Follower, decoded
from edge.uav.navigation import to_quaternion
from edge.uav.timing.clock_alignment import Aligner, CameraHostClock
from edge.uav.tracker import Box, Estimate, State, Telemetry
from protocols.bus.base import Bus
from protocols.core.clocks import NANOSECONDS
from protocols.core.version import VERSION
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.topics import (
    FLIGHT_IMAGE,
    PICTURE,
    ROAD_MAP,
    STATUS,
    TARGET,
    TARGET_CLOUD,
    TARGET_COMMAND,
    TELEMETRY,
    UAV_INFO,
)
from protocols.validation.codec import SCHEMA_VERSION

ROLE = "uav"
_READ_S = 0.02
_OUTBOX = 2048
_INFO_S, _STATUS_S = 2.0, 1.0
_SILENT_S = 2.0  # without a frame the agent is degraded
_LINK_STALE_S = 1.5  # without the vehicle nothing is commanded
_STEP_BACK_S = 0.2
_UNTOLD_DELAY_S = 0.03  # std of what a frame and an attitude are late by, until the pictures have told
TOPICS = {
    topic.message: topic
    for topic in (FLIGHT_IMAGE, TELEMETRY, TARGET_COMMAND, TARGET, TARGET_CLOUD, ROAD_MAP, UAV_INFO, STATUS, PICTURE)
}


@dataclass(frozen=True, slots=True, eq=False)
class Looking:
    """The camera and how it works. lens, body_from_camera: None where not known.

    jpeg_quality: of the pictures on the bus, which are then also what the tracker sees; None: none are sent.
    pictures_hz, picture_width: small pictures a second while somebody wants them, and their width [px]; 0 = never.
    """

    size: tuple[int, int]
    fps: float
    lens: Intrinsics | None
    body_from_camera: Floats | None
    seed: int = 0
    model: str = "ground"
    jpeg_quality: int | None = None
    pictures_hz: float = 2.0
    picture_width: int = WIDTH


class UavAgent:
    """One camera on one vehicle. Parts come in ready; ``run`` puts threads and the bus around ``step``.

    component: makes the camera component once there is somebody to obey. shown: is told of every picture and estimate.
    now_ns: the host's monotonic clock.
    """

    def __init__(
        self,
        device: Device,
        link: Link,
        vehicle: Vehicle,
        component: Callable[[Callable[[Select | Stop], bool]], CameraComponent],
        control: Control,
        agent: str,
        looking: Looking,
        *,
        shown: Callable[[Image, Estimate | None, str], None] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        boot_id: str | None = None,
    ) -> None:
        self._device, self._link, self._vehicle, self._control = device, link, vehicle, control
        self._agent, self._looking, self._shown, self._now_ns = agent, looking, shown, now_ns
        self.boot_id = uuid.uuid4().hex if boot_id is None else boot_id
        self.camera = component(self._obey)
        self.follower = Follower(
            agent,
            self.boot_id,
            looking.size,
            looking.lens,
            looking.body_from_camera,
            fps=looking.fps,
            seed=looking.seed,
            model=looking.model,
        )
        usable = looking.lens is not None and looking.body_from_camera is not None
        self.aligner = (
            Aligner(looking.size, looking.lens, looking.body_from_camera)  # type: ignore[arg-type]
            if usable
            else None
        )
        self.camera_clock = CameraHostClock()
        self._publish: Callable[[Message], None] = lambda message: None
        self._order = 0
        self._last_sample_s = -math.inf
        self._telemetry_ns = 0
        self._seen_s = -math.inf
        self._frame_s = -math.inf
        self._last_frame: int | None = None
        self._reboots = self._steps = 0
        self.counters: Counter[str] = Counter()
        self.latencies: deque[float] = deque(maxlen=900)
        """From a frame's arrival to its status on the link [s]."""

    def run(self, bus: Bus, stop: threading.Event) -> None:
        """Work until ``stop`` is set or the device has ended.

        Raises InputError where the device cannot be opened, BusDead where the bus has died.
        """
        self._device.open()
        try:
            with (
                bus.announce(ROLE, self._agent, self.boot_id),
                Outbox(bus, self._agent, TOPICS.values(), _OUTBOX) as outbox,
                Ear(self._link) as ear,
            ):
                self._publish = lambda message: outbox.put(TOPICS[message.DESCRIPTOR.name], message)
                self._loop(stop, ear, outbox)
        finally:
            self._device.close()
            self._link.close()

    def step(self, heard: list[Heard], frame: Frame | None) -> None:
        """Take what came over the link, then a frame if there is one, and say what is due."""
        now = self._now_ns()
        self._vehicle.tick(now)
        for message in heard:
            if message.system == self._link.vehicle:
                for sample in self._vehicle.handle(message):
                    self._take_sample(sample)
            self.camera.handle(message, now / NANOSECONDS)
        self._watch_clocks()
        if frame is not None:
            self._take_frame(frame, now)
        now = self._now_ns()
        self.camera.tick(now / NANOSECONDS, frame=frame is not None)
        if frame is not None and self.follower.following:
            self.latencies.append((self._now_ns() - now_of(frame, self.camera_clock, now)) / NANOSECONDS)
        self._steer(now)

    def info(self) -> pb.UavInfo:
        """What a replay has to know."""
        looking = self._looking
        message = pb.UavInfo(
            schema_version=SCHEMA_VERSION,
            agent=self._agent,
            boot_id=self.boot_id,
            width=looking.size[0],
            height=looking.size[1],
            fps=looking.fps,
            seed=looking.seed,
            model=looking.model,
        )
        if looking.lens is not None:
            message.matrix.extend(looking.lens.matrix.ravel().tolist())
            message.distortions.extend(looking.lens.distortions.tolist())
            message.fisheye = looking.lens.fisheye
        if looking.body_from_camera is not None:
            message.body_from_camera.extend(np.asarray(looking.body_from_camera).ravel().tolist())
        return message

    def status(self, sequence: int, ended: str = "", unpublished: int = 0) -> pb.AgentStatus:
        """How it is."""
        now_s = self._now_ns() / NANOSECONDS
        link, clock = self._link, self._vehicle.clock
        message = ended
        state = "stopping" if ended else "running"
        silent, unheard = now_s - self._frame_s, (self._now_ns() - link.heard_ns) / NANOSECONDS
        if not ended and silent > _SILENT_S:
            state, message = "degraded", "no frame yet" if math.isinf(silent) else f"no frame for {silent:.0f} s"
        elif not ended and link.vehicle is None:
            state = "degraded"
            message = f"no vehicle heard: {link.problem}" if link.problem else "no vehicle heard yet"
        elif not ended and unheard > _LINK_STALE_S:
            state, message = "degraded", f"the vehicle is silent for {unheard:.0f} s {link.problem}".rstrip()
        elif not ended:
            message = self._control.why or "commands are sent"
        counters: Counter[str] = Counter(self.counters)
        for prefix, part in (
            ("link", link.counters),
            ("camera", self.camera.counters),
            ("sent", self._control.counters),
        ):
            counters.update({f"{prefix}.{name}": count for name, count in part.items()})
        counters.update(
            {
                "vehicle.reboots": clock.reboots,
                "vehicle.clock_steps": clock.steps,
                "target.refused": self.follower.refused,
                "undecodable": self.follower.undecodable,
                "unpublished": unpublished,
            }
        )
        gauges = {"time_std_s": min(clock.std_s, 1e6)}
        if self.aligner is not None and self.aligner.found is not None:
            gauges["time_offset_s"] = self.aligner.found.offset
            gauges["time_offset_std_s"] = self.aligner.found.std
        if self.latencies:
            gauges["latency_s"] = float(np.median(self.latencies))
            gauges["latency_p99_s"] = float(np.quantile(self.latencies, 0.99))
        return pb.AgentStatus(
            schema_version=SCHEMA_VERSION,
            agent=self._agent,
            role=ROLE,
            boot_id=self.boot_id,
            sequence=sequence,
            state=state,
            message="".join(letter if letter.isprintable() else " " for letter in message)[:200],
            counters=counters,
            gauges=gauges,
            version=VERSION,
        )

    def _loop(self, stop: threading.Event, ear: Ear, outbox: Outbox) -> None:
        sequence, looking = 0, self._looking
        next_info = next_status = next_picture = -math.inf
        while not (stop.is_set() or self._device.ended):
            frame = self._device.read(_READ_S)
            self.step(ear.drain(), frame)
            now = self._now_ns() / NANOSECONDS
            if frame is not None and now >= next_picture and outbox.wants(PICTURE) and looking.pictures_hz > 0.0:
                next_picture = now + 1.0 / looking.pictures_hz
                self._publish(picture_message(frame, self._agent, self.boot_id, looking.picture_width))
            if now >= next_info:
                next_info = now + _INFO_S
                self._publish(self.info())
            if now >= next_status:
                next_status = now + _STATUS_S
                self._publish(self.status(sequence, unpublished=outbox.lost.total()))
                sequence += 1
        ended = "the recording has ended" if self._device.ended and not stop.is_set() else "stopped"
        self._publish(self.status(sequence, ended, outbox.lost.total()))

    def _take_sample(self, sample: Sample) -> None:
        camera_ns = self.camera_clock.camera_ns(sample.host_ns)
        self.counters["telemetry"] += 1
        if camera_ns is None:
            return  # without a picture yet there is no clock to put it on
        time_s = camera_ns / NANOSECONDS
        offset = 0.0
        if self.aligner is not None:
            self.aligner.handle_sample(Telemetry(time_s, sample.ned_from_mount, sample.position))
            offset = self.aligner.offset_s
        # Said by the vehicle at t is true of the camera's t - offset.
        mapped = camera_ns - round(offset * NANOSECONDS)
        if mapped <= self._telemetry_ns and self._telemetry_ns - mapped < _STEP_BACK_S * NANOSECONDS:
            self.counters["telemetry.out_of_order"] += 1
            return
        self._telemetry_ns = mapped
        self._last_sample_s = self._now_ns() / NANOSECONDS
        std = math.hypot(sample.std_s, _UNTOLD_DELAY_S)
        if self.aligner is not None and self.aligner.found is not None:
            std = self.aligner.found.std
        message = pb.VehicleTelemetry(
            **self._head(),
            device_time_ns=mapped,
            vehicle_time_ns=sample.vehicle_ns,
            time_std_s=std if math.isfinite(std) else 1e3,
            ned_from_body=to_quaternion(sample.ned_from_mount),
        )
        if sample.position is not None:
            message.position.extend(sample.position.tolist())
        origin = self._vehicle.origin
        if origin is not None:
            message.origin.extend((origin.latitude, origin.longitude, float(np.clip(origin.altitude, -1e4, 1e5))))
        self._publish(message)
        self.follower.handle(message)

    def _take_frame(self, frame: Frame, now: int) -> None:
        self.camera_clock.handle_frame(frame.device_time_ns, now)
        self.counters["frames"] += 1
        if self._last_frame is not None and frame.frame > self._last_frame + 1:
            self.counters["dropped"] += frame.frame - self._last_frame - 1
        self._last_frame = frame.frame
        self._frame_s = now / NANOSECONDS
        image: Image | None = frame.image
        quality = self._looking.jpeg_quality
        if quality is not None:
            _, data = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, quality])
            height, width = frame.image.shape[:2]
            message = pb.FlightImage(
                **self._head(),
                frame=frame.frame,
                device_time_ns=frame.device_time_ns,
                width=width,
                height=height,
                jpeg=data.tobytes(),
            )
            self._publish(message)
            image = decoded(message)
        for out in self.follower.handle_frame(image, frame.frame, frame.device_time_ns):
            self._publish(out)
        self._update_shown()
        if self.aligner is not None:
            self.aligner.handle_frame(image, frame.device_time_ns / NANOSECONDS, self.follower.following)
        if self._shown is not None:
            self._shown(frame.image, self.follower.estimate, line(self.follower.estimate))

    def _obey(self, order: Select | Stop) -> bool:
        """What the operator asks for; whether it could be done."""
        width, height = self._looking.size
        message = pb.TargetCommand(**self._head(), kind="stop", by=order.by)
        if isinstance(order, Select):
            message.kind = "select"
            x, y = order.left * width - 0.5, order.top * height - 0.5
            box = Box(x, y, (order.right - order.left) * width, (order.bottom - order.top) * height)
            if order.is_point:
                box = self.follower.box_about(x, y)
            message.box.extend((box.x, box.y, box.width, box.height))
        refused = self.follower.refused
        self._publish(message)
        for out in self.follower.handle(message):
            self._publish(out)
        good = self.follower.refused == refused
        if isinstance(order, Stop):
            self._control.hold("stopped by the operator")
        elif good:
            self._control.begin(self._vehicle.position)
            self._seen_s = self._now_ns() / NANOSECONDS
        self._update_shown()
        return good

    def _watch_clocks(self) -> None:
        """A clock that began anew makes what was compared worthless."""
        clock = self._vehicle.clock
        if (clock.reboots, clock.steps + self.camera_clock.steps) != (self._reboots, self._steps):
            self._reboots, self._steps = clock.reboots, clock.steps + self.camera_clock.steps
            self._telemetry_ns = 0
            if self.aligner is not None:
                self.aligner.clear()

    def _steer(self, now: int) -> None:
        """Send what may be sent; see ``Control``."""
        now_s = now / NANOSECONDS
        estimate, vehicle = self.follower.estimate, self._vehicle
        if estimate is None:
            if self._control.why != "stopped by the operator":
                self._control.hold("no target")
            return
        if estimate.state is State.VISIBLE:
            self._seen_s = now_s
        place, velocity = vehicle.position, vehicle.velocity
        if estimate.state is State.LOST:
            self._control.hold("the target is lost")
        elif now - self._link.heard_ns > _LINK_STALE_S * NANOSECONDS or now_s - self._last_sample_s > _LINK_STALE_S:
            self._control.hold("the link is stale")
        elif now_s - self._frame_s > _SILENT_S:
            self._control.hold("no frames")
        elif place is None or velocity is None or not (math.isfinite(estimate.north) and math.isfinite(estimate.std_m)):
            self._control.hold("no metric ground")
        else:
            speed = estimate.speed if math.isfinite(estimate.speed) and math.isfinite(estimate.course) else 0.0
            course = estimate.course if math.isfinite(estimate.course) else 0.0
            aim = Aim(
                self._frame_s,
                np.array([estimate.north, estimate.east]),
                speed * np.array([math.cos(course), math.sin(course)]),
                estimate.std_m,
                now_s - self._seen_s,
            )
            self._control.tick(now_s, aim, place, velocity, vehicle.origin)

    def _update_shown(self) -> None:
        """What the camera component tells."""
        vehicle = self._vehicle
        boot_ns = self._now_ns() + vehicle.clock.offset_ns if vehicle.clock.known else 0
        self.camera.shown.boot_ms = (boot_ns // 1_000_000) & 0xFFFFFFFF
        show(self.camera.shown, self.follower.estimate, vehicle, self._looking.size)

    def _head(self) -> dict[str, Any]:
        """What every input message begins with; counts the inputs."""
        order, self._order = self._order, self._order + 1
        return {"schema_version": SCHEMA_VERSION, "agent": self._agent, "boot_id": self.boot_id, "order": order}


def now_of(frame: Frame, clock: CameraHostClock, fallback: int) -> int:
    """The host's time at which a frame could first have been had [ns]: its stamp and the least delay."""
    camera = clock.camera_ns(0)
    return fallback if camera is None else frame.device_time_ns - camera
