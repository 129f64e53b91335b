"""The UAV agent: connects a camera, a MAVLink link, the target estimator and the bus in one loop."""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from google.protobuf.message import Message

from edge.agents.publish_queue import PublishQueue
from edge.agents.target_report import status_line, update_tracking_status
from edge.agents.thumbnails import thumbnail_message
from edge.agents.uav_guidance import FRAME_TIMEOUT_S, LINK_STALE_S, GuidanceControl
from edge.agents.uav_settings import UavSettings
from edge.detectors.base import Detector
from edge.devices.base import Device, Frame
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.link.receiver import Receiver
from edge.mavlink.roles.camera import ArmFollow, CameraComponent, OperatorCommand, SelectTarget
from edge.mavlink.roles.guidance import Guidance
from edge.mavlink.roles.vehicle import MountSample, Vehicle
from edge.uav.base import Box, Estimate, Telemetry
from edge.uav.estimator import TargetEstimator, decode_image
from edge.uav.timing.clock_alignment import CameraHostClock, ClockAligner
from protocols.bus.base import Bus, agent_status
from protocols.core.clocks import NANOSECONDS
from protocols.core.jpeg import encode_jpeg
from protocols.geometry import so3
from protocols.geometry.types import Image
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
from protocols.validation.rules import SCHEMA_VERSION

ROLE = "uav"
_READ_S = 0.02  # the MAVLink connection is served between two reads
_QUEUE_CAPACITY = 2048  # messages: half a minute of telemetry and estimates
_INFO_S, _STATUS_S = 2.0, 1.0  # as camera agents
_STEP_BACK_S = 0.2  # of an autopilot's clock: more is a reboot, less is jitter
_DELAY_STD_S = 0.03  # std of the unknown delays of frames and attitudes, until the offset is estimated from the images
TOPICS = {
    topic.message: topic
    for topic in (FLIGHT_IMAGE, TELEMETRY, TARGET_COMMAND, TARGET, TARGET_CLOUD, ROAD_MAP, UAV_INFO, STATUS, PICTURE)
}


class UavAgent:
    """Tracks a target with the camera of one vehicle. ``step`` does the work; ``run`` adds threads and the bus.

    component: makes the camera component from the handler of operator commands. shown: called with every image, the
    estimate and a line of text. now_ns: the host's monotonic clock. detector: where given, a point that is selected
    selects the box detected there.
    """

    def __init__(
        self,
        device: Device,
        link: Link,
        vehicle: Vehicle,
        component: Callable[[Callable[[OperatorCommand], bool]], CameraComponent],
        guidance: Guidance,
        agent: str,
        settings: UavSettings,
        *,
        shown: Callable[[Image, Estimate | None, str], None] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        boot_id: str | None = None,
        detector: Detector | None = None,
    ) -> None:
        self._detector = detector
        self._last_image: Image | None = None
        self._device, self._link, self._vehicle, self._guidance = device, link, vehicle, guidance
        self._agent, self._settings, self._show, self._now_ns = agent, settings, shown, now_ns
        self.boot_id = uuid.uuid4().hex if boot_id is None else boot_id
        self.camera = component(self._execute)
        self._control = GuidanceControl(guidance, link, vehicle, self.camera)
        self.estimator = TargetEstimator(
            agent,
            self.boot_id,
            settings.size,
            settings.lens,
            settings.body_from_camera,
            fps=settings.fps,
            seed=settings.seed,
            model=settings.model,
        )
        usable = settings.lens is not None and settings.body_from_camera is not None
        self.aligner = (
            ClockAligner(settings.size, settings.lens, settings.body_from_camera)  # type: ignore[arg-type]
            if usable
            else None
        )
        self.camera_clock = CameraHostClock()
        self._publish: Callable[[Message], None] = lambda message: None
        self._order = 0
        self._last_sample_s = -math.inf
        self._telemetry_ns = 0
        self._last_frame_s = -math.inf
        self._last_frame: int | None = None
        self._resets = (0, 0)
        self.counters: Counter[str] = Counter()
        self.latencies: deque[float] = deque(maxlen=900)
        """Latencies from a frame's arrival until its status was sent on the link [s]."""

    def run(self, bus: Bus, stop: threading.Event) -> None:
        """Run until ``stop`` is set or the device has ended.

        Raises InputError where the device cannot be opened, BusDead where the bus has died.
        """
        self._device.open()
        try:
            with (
                bus.announce(ROLE, self._agent, self.boot_id),
                PublishQueue(bus, self._agent, TOPICS.values(), _QUEUE_CAPACITY) as out_queue,
                Receiver(self._link) as receiver,
            ):
                self._publish = lambda message: out_queue.put(TOPICS[message.DESCRIPTOR.name], message)
                self._loop(stop, receiver, out_queue)
        finally:
            self._device.close()
            self._link.close()

    def step(self, received: list[ReceivedMessage], frame: Frame | None) -> None:
        """Process received messages, then a frame if there is one, and send what is due."""
        now = self._now_ns()
        self._vehicle.tick(now)
        for message in received:
            if message.system == self._link.vehicle and message.kind == "GIMBAL_MANAGER_STATUS":
                self._control.handle(message, now / NANOSECONDS)
            elif message.system == self._link.vehicle:
                for sample in self._vehicle.handle(message):
                    self._take_sample(sample)
            self.camera.handle(message, now / NANOSECONDS)
        self._check_clock_resets()
        if frame is not None:
            frame = replace(frame, device_time_ns=self.camera_clock.handle_frame(frame.device_time_ns, now))
            self._take_frame(frame, now)
        now = self._now_ns()
        self.camera.tick(now / NANOSECONDS, frame=frame is not None)
        if frame is not None and self.estimator.has_target:
            self.latencies.append((self._now_ns() - earliest_arrival_ns(frame, self.camera_clock, now)) / NANOSECONDS)
        self._control.update(now, self.estimate, self._last_frame_s, self._last_sample_s)

    @property
    def estimate(self) -> Estimate | None:
        """The target's estimate; without a place on the ground where the images contradict the attitudes."""
        estimate = self.estimator.estimate
        if estimate is None or not self._contradicted:
            return estimate
        nan = math.nan
        return replace(estimate, north=nan, east=nan, speed=nan, course=nan, std_m=nan)

    @property
    def _contradicted(self) -> bool:
        return self.aligner is not None and self.aligner.contradicted

    def info(self) -> pb.UavInfo:
        """The message with the settings that a replay of the estimator needs."""
        settings = self._settings
        message = pb.UavInfo(
            schema_version=SCHEMA_VERSION,
            agent=self._agent,
            boot_id=self.boot_id,
            width=settings.size[0],
            height=settings.size[1],
            fps=settings.fps,
            seed=settings.seed,
            model=settings.model,
        )
        if settings.lens is not None:
            message.MergeFrom(pb.UavInfo(**settings.lens.message_fields()))
        if settings.body_from_camera is not None:
            message.body_from_camera.extend(np.asarray(settings.body_from_camera).ravel().tolist())
        return message

    def status(self, sequence: int, ended: str = "", unpublished: int = 0) -> pb.AgentStatus:
        """The agent's status. ended: the reason if it is stopping. unpublished: messages dropped by the queue."""
        now_s = self._now_ns() / NANOSECONDS
        link, vehicle = self._link, self._vehicle
        message = ended
        state = "stopping" if ended else "running"
        frame_silent_s = now_s - self._last_frame_s
        link_silent_s = (self._now_ns() - link.last_received_ns) / NANOSECONDS
        reason = link.problem or link.report(self._now_ns())
        if not ended and frame_silent_s > FRAME_TIMEOUT_S:
            state, message = (
                "degraded",
                "no frame yet" if math.isinf(frame_silent_s) else f"no frame for {frame_silent_s:.0f} s",
            )
        elif not ended and link.vehicle is None:
            state = "degraded"
            message = f"no heartbeat received: {link.problem}" if link.problem else "no heartbeat received yet"
        elif not ended and link_silent_s > LINK_STALE_S:
            state, message = "degraded", f"the vehicle is silent for {link_silent_s:.0f} s"
            message += f": {reason}" if reason else ""
        elif not ended:
            contradiction = self.aligner.reason if self.aligner is not None and self._contradicted else ""
            motion = "" if self.aligner is None else self.aligner.wrong_motion
            problem = vehicle.problem(self._now_ns()) or contradiction or reason or motion
            problem = problem or vehicle.without_position(self._now_ns())
            state = "degraded" if contradiction or problem.startswith("no attitude") else state
            message = problem or self._guidance.hold_reason or "commands are sent"
            second = link.second_sender(self._now_ns())
            message += f"; {second}" if second else ""
        counters: Counter[str] = Counter(self.counters)
        for prefix, part in (
            ("link", link.counters),
            ("camera", self.camera.counters),
            ("sent", self._guidance.counters),
            ("telemetry.refused", vehicle.counters),
        ):
            counters.update({f"{prefix}.{name}": count for name, count in part.items()})
        counters.update(
            {
                "vehicle.reboots": vehicle.clock_resets[0],
                "vehicle.clock_steps": vehicle.clock_resets[1],
                "camera.clock_steps": self.camera_clock.steps,
                "target.refused": self.estimator.refused,
                "undecodable": self.estimator.undecodable,
                "unpublished": unpublished,
            }
        )
        gauges = {"time_std_s": min(vehicle.clock.std_s, 1e6)}
        if self.aligner is not None and self.aligner.estimate is not None:
            gauges["time_offset_s"] = self.aligner.estimate.offset
            gauges["time_offset_std_s"] = self.aligner.estimate.std
        if self.latencies:
            gauges["latency_s"] = float(np.median(self.latencies))
            gauges["latency_p99_s"] = float(np.quantile(self.latencies, 0.99))
        text = "".join(letter if letter.isprintable() else " " for letter in message)[:200]
        return agent_status(ROLE, self._agent, self.boot_id, sequence, state, text, counters, gauges)

    def _loop(self, stop: threading.Event, receiver: Receiver, out_queue: PublishQueue) -> None:
        sequence, settings = 0, self._settings
        next_info = next_status = next_picture = -math.inf
        while not (stop.is_set() or self._device.ended):
            frame = self._device.read(_READ_S)
            self.step(receiver.drain(), frame)
            now = self._now_ns() / NANOSECONDS
            if (
                frame is not None
                and now >= next_picture
                and out_queue.has_subscriber(PICTURE)
                and settings.pictures_hz > 0.0
            ):
                next_picture = now + 1.0 / settings.pictures_hz
                self._publish(thumbnail_message(frame, self._agent, self.boot_id, settings.picture_width))
            if now >= next_info:
                next_info = now + _INFO_S
                self._publish(self.info())
            if now >= next_status:
                next_status = now + _STATUS_S
                self._publish(self.status(sequence, unpublished=out_queue.unsent.total()))
                sequence += 1
        ended = "the recording has ended" if self._device.ended and not stop.is_set() else "stopped"
        self._publish(self.status(sequence, ended, out_queue.unsent.total()))

    def _take_sample(self, sample: MountSample) -> None:
        camera_ns = self.camera_clock.camera_ns(sample.host_ns)
        self.counters["telemetry"] += 1
        if camera_ns is None:
            return  # before the first frame there is no camera clock to map to
        time_s = camera_ns / NANOSECONDS
        offset = 0.0
        if self.aligner is not None:
            self.aligner.handle_sample(Telemetry(time_s, sample.ned_from_mount, sample.position))
            offset = self.aligner.offset_s
        # A sample received at camera time t was measured at t - offset.
        mapped = camera_ns - round(offset * NANOSECONDS)
        if mapped <= self._telemetry_ns and self._telemetry_ns - mapped < _STEP_BACK_S * NANOSECONDS:
            self.counters["telemetry.out_of_order"] += 1
            return
        self._telemetry_ns = mapped
        self._last_sample_s = self._now_ns() / NANOSECONDS
        std = math.hypot(sample.std_s, _DELAY_STD_S)
        if self.aligner is not None and self.aligner.estimate is not None:
            std = self.aligner.estimate.std
        message = pb.VehicleTelemetry(
            **self._message_header(),
            device_time_ns=mapped,
            vehicle_time_ns=sample.vehicle_ns,
            time_std_s=std if math.isfinite(std) else 1e3,
            ned_from_body=so3.quaternion(sample.ned_from_mount).tolist(),
        )
        if sample.position is not None:
            message.position.extend(sample.position.tolist())
            message.position_std = sample.position_std
        origin = self._vehicle.origin
        if origin is not None:
            message.origin.extend((origin.latitude, origin.longitude, float(np.clip(origin.altitude, -1e4, 1e5))))
        self._publish(message)
        self.estimator.handle(message)

    def _take_frame(self, frame: Frame, now: int) -> None:
        self.counters["frames"] += 1
        if self._last_frame is not None and frame.frame > self._last_frame + 1:
            self.counters["dropped"] += frame.frame - self._last_frame - 1
        self._last_frame = frame.frame
        self._last_frame_s = now / NANOSECONDS
        image: Image | None = frame.image
        quality = self._settings.jpeg_quality
        if quality is not None:
            height, width = frame.image.shape[:2]
            message = pb.FlightImage(
                **self._message_header(),
                frame=frame.frame,
                device_time_ns=frame.device_time_ns,
                width=width,
                height=height,
                jpeg=encode_jpeg(frame.image, quality),
            )
            self._publish(message)
            image = decode_image(message)
        self._last_image = image
        for out in self.estimator.handle_frame(image, frame.frame, frame.device_time_ns):
            self._publish(out)
        self._update_tracking_status()
        if self.aligner is not None:
            before = self._contradicted
            self.aligner.handle_frame(image, frame.device_time_ns / NANOSECONDS, self.estimator.has_target)
            if self._contradicted and not before:
                self.camera.say("Syncline: attitude unlike the images, no position")
        if self._show is not None:
            self._show(frame.image, self.estimate, status_line(self.estimate))

    def _execute(self, command: OperatorCommand) -> bool:
        """Execute an operator's command; whether it was accepted."""
        if isinstance(command, ArmFollow):
            return self._control.arm(command, has_target=self.estimator.has_target)
        width, height = self._settings.size
        message = pb.TargetCommand(**self._message_header(), kind="stop", by=command.by)
        if isinstance(command, SelectTarget):
            message.kind = "select"
            x, y = command.left * width - 0.5, command.top * height - 0.5
            box = Box(x, y, (command.right - command.left) * width, (command.bottom - command.top) * height)
            if command.is_point:
                box = self._detected_at(x, y) or self.estimator.box_around(x, y, command.radius * width)
            message.box.extend((box.x, box.y, box.width, box.height))
        refused = self.estimator.refused
        self._publish(message)
        for out in self.estimator.handle(message):
            self._publish(out)
        accepted = self.estimator.refused == refused
        if not isinstance(command, SelectTarget):
            self._control.stop()
        elif accepted:
            self._control.begin(self._now_ns() / NANOSECONDS)
        else:
            self.camera.say("Syncline: nothing to track there, select again")
        self._update_tracking_status()
        return accepted

    def _detected_at(self, x: float, y: float) -> Box | None:
        """The smallest box detected around a point (x, y) [px] of the last image; None without one."""
        if self._detector is None or self._last_image is None:
            return None
        found = [one.box for one in self._detector.detect(self._last_image) if one.box is not None]
        boxes = [Box(u - 0.5, v - 0.5, width, height) for u, v, width, height in found]  # from corners to pixel centres
        around = [box for box in boxes if 0.0 <= x - box.x <= box.width and 0.0 <= y - box.y <= box.height]
        return min(around, key=lambda box: box.width * box.height, default=None)

    def _check_clock_resets(self) -> None:
        """Reset the time alignment when the vehicle's clock was reset or stepped."""
        resets = self._vehicle.clock_resets
        if resets != self._resets:
            self._resets = resets
            self._telemetry_ns = 0
            if self.aligner is not None:
                self.aligner.reset()

    def _update_tracking_status(self) -> None:
        """Update the status that the camera component reports."""
        vehicle = self._vehicle
        boot_ns = self._now_ns() + vehicle.clock.offset_ns if vehicle.clock.known else 0
        self.camera.status.boot_ms = (boot_ns // 1_000_000) & 0xFFFFFFFF
        settings = self._settings
        update_tracking_status(
            self.camera.status,
            self.estimate,
            vehicle,
            settings.size,
            settings.lens,
            settings.body_from_camera,
            self._now_ns(),
        )

    def _message_header(self) -> dict[str, Any]:
        """The common fields of all input messages; ``order`` numbers the inputs for replay."""
        order, self._order = self._order, self._order + 1
        return {"schema_version": SCHEMA_VERSION, "agent": self._agent, "boot_id": self.boot_id, "order": order}


def earliest_arrival_ns(frame: Frame, clock: CameraHostClock, fallback: int) -> int:
    """Host time [ns] at which a frame could have arrived at the earliest: its stamp plus the minimum delay."""
    camera = clock.camera_ns(0)
    return fallback if camera is None else frame.device_time_ns - camera
