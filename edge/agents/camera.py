"""The camera agent: reads frames from a device, detects in them, publishes observations and status on the bus.

Capture and detection run in the caller's thread. A separate thread publishes, so that a slow bus cannot delay them.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Self

from google.protobuf.message import Message

from edge.agents.clock_quality import ClockMonitor
from edge.agents.image_health import ImageHealth
from edge.agents.publish_queue import PublishQueue
from edge.agents.thumbnails import THUMBNAIL_WIDTH, thumbnail_message
from edge.detectors.base import Detection, Detector, Prediction
from edge.devices.base import Device, Frame, Reconnecting
from protocols.bus.base import Bus, Subscription, agent_status
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import RigCamera
from protocols.topics import CAMERA_INFO, OBSERVATION, PICTURE, PREDICTION, STATUS, Topic
from protocols.validation.rules import SCHEMA_VERSION

_MAX_AGE_S = 0.5  # a prediction farther away in time is not used for a frame
_VELOCITY_STD = 60.0  # px/s, std of a target's deviation from the predicted image velocity
ROLE = "camera"
_READ_TIMEOUT_S = 0.1  # upper bound of the stop latency while no frame comes
_INFO_PERIOD_S = 2.0  # for late joiners over a lossy link
_STATUS_PERIOD_S = 1.0  # as all agents: health counts 5 s without a status as dead
# Drivers of real cameras: such a source has no end of its own, so an end means that the camera was lost.
_LIVE_DRIVERS = frozenset({"video", "usb", "picamera2", "rtsp", "oak"})
_QUEUE_CAPACITY = 1024  # messages: half a minute of frames while the bus is blocked


class PredictionSubscriber:
    """Keeps the newest prediction of each hub for one camera in its current boot."""

    def __init__(self, subscription: Subscription, camera: str, boot_id: str) -> None:
        self._subscription = subscription
        self._camera = camera
        self._boot_id = boot_id
        self._newest: dict[str, pb.CameraPrediction] = {}

    def at(self, device_time_ns: int) -> list[Prediction]:
        """Predictions extrapolated to a frame at ``device_time_ns`` on the camera's clock."""
        for received in self._subscription.drain():
            message = received.message
            if isinstance(message, pb.Prediction):
                for one in message.cameras:
                    if one.camera == self._camera and one.boot_id in ("", self._boot_id):
                        self._newest[received.agent] = one
        expected = []
        for one in self._newest.values():
            ahead = (device_time_ns - one.device_time_ns) / NANOSECONDS
            if abs(ahead) <= _MAX_AGE_S:
                expected += [_prediction(target, ahead) for target in one.targets if target.target]
        return expected

    def close(self) -> None:
        """Close the subscription."""
        self._subscription.close()


def _prediction(target: pb.PredictedTarget, ahead: float) -> Prediction:
    uu, uv, vv = target.covariance or (400.0, 0.0, 400.0)
    more = (_VELOCITY_STD * ahead) ** 2
    colour = target.colour
    return Prediction(
        u=target.u + ahead * target.u_velocity,
        v=target.v + ahead * target.v_velocity,
        covariance=(uu + more, uv, vv + more),
        target=target.target,
        size=target.size,
        colour=(colour.red, colour.green, colour.blue) if target.HasField("colour") else None,
    )


class CameraAgent:
    """Publishes the observations, the description and the status of one camera.

    device: opened by ``run`` and closed when it returns. camera: the camera's id. now_ns: a monotonic clock for rates
    and latencies; observations are never stamped with it. known: the camera's entry in the rig file (intrinsics, pose).
    boot_id: by default a new one for each process start. pictures_hz, picture_width: rate and width [px] of the
    thumbnails, which are published only while somebody subscribes; a rate of 0 disables them.
    predictions: whether the hub's predicted detections are passed to the detector. target: what it looks for, in one
    word, for advice to the user.
    """

    def __init__(
        self,
        device: Device,
        detector: Detector,
        bus: Bus,
        camera: str,
        *,
        now_ns: Callable[[], int] = time.monotonic_ns,
        known: RigCamera | None = None,
        boot_id: str | None = None,
        pictures_hz: float = 2.0,
        picture_width: int = THUMBNAIL_WIDTH,
        predictions: bool = False,
        target: str = "",
    ) -> None:
        self._target = target
        self._uses_predictions = predictions
        self._predictions: PredictionSubscriber | None = None
        self._device = device
        self._detector = detector
        self._bus = bus
        self._camera = camera
        self._now_ns = now_ns
        self._known = known
        self.boot_id = uuid.uuid4().hex if boot_id is None else boot_id
        self._sequence = 0
        self._picture_width = picture_width
        self._picture_ns = 0 if pictures_hz <= 0.0 else round(NANOSECONDS / pictures_hz)
        self._last_frame: int | None = None
        self._recent: deque[tuple[int, float]] = deque(maxlen=300)  # (arrival, latency) of the last frames
        self.frames = 0
        self.dropped = 0
        self.detections = 0
        self.empty = 0
        self._health = ImageHealth(live=False)
        self._status_lock = threading.Lock()
        self._status_sequence = 0
        self._next_status = 0
        self._reported_problem = ""
        self._stopping = False
        self._exposure_ns = 0
        self._clock = ClockMonitor()

    def run(self, stop: threading.Event) -> Self:
        """Read, detect and publish until ``stop`` is set or the device has ended; returns itself, with its counters.

        Raises InputError where the device cannot be opened, BusDead where the bus has died.
        """
        self._device.open()
        info = self._device.info
        self._health = ImageHealth(live=info.clock != "stream", period_s=1.0 / info.fps if info.fps > 0.0 else 0.0)
        topics = (OBSERVATION, CAMERA_INFO, STATUS, PICTURE)
        out_queue: PublishQueue = PublishQueue(
            self._bus, self._camera, topics, _QUEUE_CAPACITY, due_messages=lambda: self._due_status(out_queue)
        )
        if self._uses_predictions:
            self._predictions = PredictionSubscriber(self._bus.subscribe(PREDICTION), self._camera, self.boot_id)
        try:
            with self._clock, self._bus.announce(ROLE, self._camera, self.boot_id), out_queue:
                self._loop(stop, out_queue)
        finally:
            if self._predictions is not None:
                self._predictions.close()
            self._device.close()
        return self

    def _loop(self, stop: threading.Event, out_queue: PublishQueue) -> None:
        next_info = next_picture = self._now_ns()
        self._health.start(next_info / NANOSECONDS)
        while not (stop.is_set() or self._device.ended):
            frame = self._device.read(_READ_TIMEOUT_S)
            now = self._now_ns()
            if frame is not None and self._health.accept(frame, now / NANOSECONDS):
                out_queue.put(OBSERVATION, self._observe(frame))
                self._recent.append((now, (self._now_ns() - now) / NANOSECONDS))
                self._exposure_ns = frame.exposure_ns
                self._health.measure_sharpness(frame, now / NANOSECONDS)
                if self._picture_ns and now >= next_picture and out_queue.has_subscriber(PICTURE):
                    out_queue.put(PICTURE, thumbnail_message(frame, self._camera, self.boot_id, self._picture_width))
                    next_picture = now + self._picture_ns
            if now >= next_info:
                out_queue.put(CAMERA_INFO, self._info())
                next_info = now + round(_INFO_PERIOD_S * NANOSECONDS)
            out_queue.check()
        ended = self._device.ended and not stop.is_set()
        unplugged = ended and self._health.live and self._device.info.driver in _LIVE_DRIVERS
        text = "the camera is gone" if unplugged else "the recording has ended" if ended else "stopped"
        with self._status_lock:
            self._stopping = True
            out_queue.put(STATUS, self._status("stopping", text, self._status_sequence, out_queue))
        if unplugged:
            raise InputError(f"camera {self._camera} is gone", remedy="plug it in, and start its agent again")

    def _due_status(self, out_queue: PublishQueue) -> Iterator[tuple[Topic, Message]]:
        """Yield the status if it is due: every second, and at once when a fault begins or ends.

        Called by the publishing thread, because a device that hangs blocks the agent's own thread.
        """
        now = self._now_ns()
        problem = self._health.problem(now / NANOSECONDS)
        problem_kind = problem.partition(" for ")[0]
        if self._stopping or (now < self._next_status and problem_kind == self._reported_problem):
            return
        with self._status_lock:
            self._reported_problem, self._next_status = problem_kind, now + round(_STATUS_PERIOD_S * NANOSECONDS)
            status = self._status("degraded" if problem else "running", problem, self._status_sequence, out_queue)
            self._status_sequence += 1
        yield STATUS, status

    def _observe(self, frame: Frame) -> pb.Observation:
        """The observation message of one frame; it is published even without detections."""
        if self._last_frame is not None and frame.frame > self._last_frame + 1:
            self.dropped += frame.frame - self._last_frame - 1
        self._last_frame = frame.frame
        self.frames += 1
        expected = [] if self._predictions is None else self._predictions.at(frame.device_time_ns)
        seen: Sequence[Detection] | None = frame.detections
        if seen is None:
            seen = self._detector.detect(frame.image, frame.device_time_ns / NANOSECONDS, expected)
        # Validation on the bus would reject the whole frame otherwise.
        found = [one for one in seen if all(map(math.isfinite, (one.u, one.v, one.size)))]
        self.detections += len(found)
        self.empty += not found
        message = pb.Observation(
            schema_version=SCHEMA_VERSION,
            camera=self._camera,
            boot_id=self.boot_id,
            sequence=self._sequence,
            frame=frame.frame,
            device_time_ns=frame.device_time_ns,
            exposure_ns=frame.exposure_ns,
            detections=[detection_message(detection) for detection in found],
        )
        self._sequence += 1
        return message

    def _info(self) -> pb.CameraInfo:
        info = self._device.info
        message = pb.CameraInfo(
            schema_version=SCHEMA_VERSION,
            camera=self._camera,
            boot_id=self.boot_id,
            width=info.width,
            height=info.height,
            fps=info.fps,
            driver=info.driver,
            clock=info.clock,
            readout_s=info.readout_s,
            target=self._target,
        )
        known = self._known
        if known is not None and known.readout is not None:
            message.readout_s = known.readout
        lens = info.intrinsics if known is None or known.intrinsics is None else known.intrinsics
        if lens is not None and (lens.width, lens.height) != (info.width, info.height) and info.intrinsics is not None:
            lens = info.intrinsics  # the images are smaller than those the rig file was calibrated for
        if lens is not None:
            message.MergeFrom(pb.CameraInfo(**lens.message_fields()))
        if known is not None:
            message.focal_std = known.focal_std if lens is known.intrinsics else 0.0
            message.MergeFrom(pb.CameraInfo(**known.pose_table()))
        return message

    def _status(self, state: str, text: str, sequence: int, out_queue: PublishQueue) -> pb.AgentStatus:
        counters = {
            "frames": self.frames,
            "dropped": self.dropped,
            "published": out_queue.sent[OBSERVATION],
            "unpublished": out_queue.unsent[OBSERVATION],
            "detections": self.detections,
            "empty": self.empty,
            "repeated": self._health.repeated,
            "stale": self._health.stale,
        }
        gauges = {"fps": 0.0, "latency_s": 0.0, **self._clock.gauges(self._device.info.clock)}
        if self._exposure_ns > 0:
            gauges["exposure_s"] = self._exposure_ns / NANOSECONDS
        if isinstance(self._device, Reconnecting):
            counters["reconnections"] = self._device.reconnections
            if (temperature := self._device.temperature) is not None:
                gauges["temperature_c"] = temperature
        if out_queue.subscribed_topics is not None:
            gauges["heard"] = float(out_queue.has_subscriber(OBSERVATION))
        if gauges.get("heard") == 0.0 and not text:
            # A put that the router's access rules deny raises no error.
            text = (
                "no subscriber: no hub of this camera's site is running, or the router's access rules do not let this "
                "camera publish"
            )
        recent = self._recent.copy()
        if len(recent) > 1:
            span = (recent[-1][0] - recent[0][0]) / NANOSECONDS
            gauges["fps"] = (len(recent) - 1) / span if span > 0 else 0.0
            gauges["latency_s"] = sorted(latency for _, latency in recent)[len(recent) // 2]
        return agent_status(ROLE, self._camera, self.boot_id, sequence, state, text, counters, gauges)


def detection_message(detection: Detection) -> pb.Detection:
    """The detection as it stands in an observation message."""
    message = pb.Detection(
        u=detection.u,
        v=detection.v,
        size=detection.size,
        score=detection.score,
        label=detection.label,
        kind=detection.kind,
        head=detection.head or (),
        foot=detection.foot or (),
        box=detection.box or (),
        target=detection.target,
    )
    if detection.colour is not None:
        message.colour.red, message.colour.green, message.colour.blue = detection.colour
    if detection.covariance is not None:
        message.covariance.extend(detection.covariance)
    return message
