"""The camera agent: frames in, observations out.

A thin loop around a device and a detector. Frames are taken and looked at in the caller's thread; messages go out by
a thread of their own, so that nothing the bus does can hold up a capture.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from google.protobuf.message import Message

from edge.agents.clock_quality import ClockWatcher
from edge.agents.image_health import PictureWatch
from edge.agents.predictions import Predictions
from edge.agents.publish_queue import Outbox
from edge.agents.thumbnails import WIDTH, picture_message
from edge.detectors.base import Detection, Detector
from edge.devices.base import Device, Frame, Returning, Warm
from protocols.bus.base import Bus
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import RigCamera
from protocols.topics import CAMERA_INFO, OBSERVATION, PICTURE, PREDICTION, STATUS, Topic
from protocols.validation.codec import SCHEMA_VERSION

ROLE = "camera"
_READ_TIMEOUT_S = 0.1  # how long a stop may wait for a silent camera
_INFO_PERIOD_S = 2.0
_STATUS_PERIOD_S = 1.0
# Drivers of real devices, which do not end of themselves.
_UNPLUGGABLE = frozenset({"video", "usb", "picamera2", "rtsp", "oak"})
_OUTBOX = 1024


class CameraAgent:
    """One camera on the bus.

    device: is opened by ``run`` and closed after it. camera: its id. now_ns: a monotonic clock for rates and latencies;
    it never stamps an observation. known: what the rig file knows of this camera beforehand. boot_id: a new one
    each time the process starts, by default. pictures_hz, picture_width: small pictures a second while somebody wants
    them, and their width [px]; 0 = never.
    predictions: whether the detector is told what the hub's tracking expects.
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
        picture_width: int = WIDTH,
        predictions: bool = False,
    ) -> None:
        self._follows = predictions
        self._predictions: Predictions | None = None
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
        self._watch = PictureWatch(live=False)
        self._status_lock = threading.Lock()
        self._status_sequence = 0
        self._next_status = 0
        self._told = ""
        self._stopping = False
        self._exposure_ns = 0
        self._clock = ClockWatcher()

    def run(self, stop: threading.Event) -> None:
        """Publish until ``stop`` is set or the device has ended.

        Raises InputError where the device cannot be opened, BusDead where the bus has died.
        """
        self._device.open()
        info = self._device.info
        self._watch = PictureWatch(live=info.clock != "stream", period_s=1.0 / info.fps if info.fps > 0.0 else 0.0)
        topics = (OBSERVATION, CAMERA_INFO, STATUS, PICTURE)
        outbox: Outbox = Outbox(self._bus, self._camera, topics, _OUTBOX, beat=lambda: self._due_status(outbox))
        if self._follows:
            self._predictions = Predictions(self._bus.subscribe(PREDICTION), self._camera, self.boot_id)
        try:
            with self._clock, self._bus.announce(ROLE, self._camera, self.boot_id), outbox:
                self._loop(stop, outbox)
        finally:
            if self._predictions is not None:
                self._predictions.close()
            self._device.close()

    def _loop(self, stop: threading.Event, outbox: Outbox) -> None:
        next_info = next_picture = self._now_ns()
        self._watch.start(next_info / NANOSECONDS)
        while not (stop.is_set() or self._device.ended):
            frame = self._device.read(_READ_TIMEOUT_S)
            now = self._now_ns()
            if frame is not None and self._watch.fresh(frame, now / NANOSECONDS):
                outbox.put(OBSERVATION, self._observe(frame))
                self._recent.append((now, (self._now_ns() - now) / NANOSECONDS))
                self._exposure_ns = frame.exposure_ns
                self._watch.look(frame, now / NANOSECONDS)
                if self._picture_ns and now >= next_picture and outbox.wants(PICTURE):
                    outbox.put(PICTURE, picture_message(frame, self._camera, self.boot_id, self._picture_width))
                    next_picture = now + self._picture_ns
            if now >= next_info:
                outbox.put(CAMERA_INFO, self._info())
                next_info = now + round(_INFO_PERIOD_S * NANOSECONDS)
            outbox.check()
        gone = self._device.ended and not stop.is_set()
        unplugged = gone and self._watch.live and self._device.info.driver in _UNPLUGGABLE
        text = "the camera is gone" if unplugged else "the recording has ended" if gone else "stopped"
        with self._status_lock:
            self._stopping = True
            outbox.put(STATUS, self._status("stopping", text, self._status_sequence, outbox))
        if unplugged:
            raise InputError(f"camera {self._camera} is gone", remedy="plug it in, and start its agent again")

    def _due_status(self, outbox: Outbox) -> Iterator[tuple[Topic, Message]]:
        """The status where one is due: each second, and at once when a complaint begins or ends.

        Called by the outbox's thread, because a device that hangs holds up the agent's own.
        """
        now = self._now_ns()
        complaint = self._watch.complaint(now / NANOSECONDS)
        told = complaint.partition(" for ")[0]
        if self._stopping or (now < self._next_status and told == self._told):
            return
        with self._status_lock:
            self._told, self._next_status = told, now + round(_STATUS_PERIOD_S * NANOSECONDS)
            status = self._status("degraded" if complaint else "running", complaint, self._status_sequence, outbox)
            self._status_sequence += 1
        yield STATUS, status

    def _observe(self, frame: Frame) -> pb.Observation:
        """The message of one frame, also when nothing is seen in it."""
        if self._last_frame is not None and frame.frame > self._last_frame + 1:
            self.dropped += frame.frame - self._last_frame - 1
        self._last_frame = frame.frame
        self.frames += 1
        expected = [] if self._predictions is None else self._predictions.at(frame.device_time_ns)
        seen: Sequence[Detection] | None = frame.found
        if seen is None:
            seen = self._detector.detect(frame.image, frame.device_time_ns / NANOSECONDS, expected)
        found = [detection for detection in seen if _usable(detection)]
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
            detections=[_detection(detection) for detection in found],
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
        )
        known = self._known
        lens = info.intrinsics if known is None or known.intrinsics is None else known.intrinsics
        if lens is not None and (lens.width, lens.height) != (info.width, info.height) and info.intrinsics is not None:
            lens = info.intrinsics  # of smaller pictures than the rig file is about
        if lens is not None:
            message.matrix.extend(lens.matrix.ravel().tolist())
            message.distortions.extend(lens.distortions.tolist())
            message.fisheye = lens.fisheye
        if known is not None:
            add_known(message, known)
        return message

    def _status(self, state: str, text: str, sequence: int, outbox: Outbox) -> pb.AgentStatus:
        counters = {
            "frames": self.frames,
            "dropped": self.dropped,
            "published": outbox.sent[OBSERVATION],
            "unpublished": outbox.lost[OBSERVATION],
            "detections": self.detections,
            "empty": self.empty,
            "repeated": self._watch.repeated,
            "stale": self._watch.late,
        }
        if isinstance(self._device, Returning):
            counters["reconnections"] = self._device.reconnections
        gauges = {"fps": 0.0, "latency_s": 0.0, **self._clock.gauges(self._device.info.clock)}
        if self._exposure_ns > 0:
            gauges["exposure_s"] = self._exposure_ns / NANOSECONDS
        if isinstance(self._device, Warm) and (temperature := self._device.temperature) is not None:
            gauges["temperature_c"] = temperature
        if outbox.wanted is not None:
            gauges["heard"] = float(outbox.wants(OBSERVATION))
        if gauges.get("heard") == 0.0 and not text:
            # A put that the router's rules deny returns as if all were well.
            text = "nobody hears this camera: no hub is there, or the router's access rules do not let it speak"
        recent = self._recent.copy()
        if len(recent) > 1:
            span = (recent[-1][0] - recent[0][0]) / NANOSECONDS
            gauges["fps"] = (len(recent) - 1) / span if span > 0 else 0.0
            gauges["latency_s"] = sorted(latency for _, latency in recent)[len(recent) // 2]
        return pb.AgentStatus(
            schema_version=SCHEMA_VERSION,
            agent=self._camera,
            role=ROLE,
            boot_id=self.boot_id,
            sequence=sequence,
            state=state,
            message=text,
            counters=counters,
            gauges=gauges,
            version=VERSION,
        )


def run_camera_agent(
    device: Device,
    detector: Detector,
    bus: Bus,
    camera: str,
    stop: threading.Event,
    now_ns: Callable[[], int] = time.monotonic_ns,
    *,
    known: RigCamera | None = None,
    boot_id: str | None = None,
    pictures_hz: float = 2.0,
    picture_width: int = WIDTH,
    predictions: bool = False,
) -> CameraAgent:
    """Run an agent to its end and return it with its counts; see ``CameraAgent`` for the arguments."""
    agent = CameraAgent(
        device,
        detector,
        bus,
        camera,
        now_ns=now_ns,
        known=known,
        boot_id=boot_id,
        pictures_hz=pictures_hz,
        picture_width=picture_width,
        predictions=predictions,
    )
    agent.run(stop)
    return agent


def add_known(message: pb.CameraInfo, known: RigCamera) -> None:
    """Enter what a rig file knows of a camera's pose; lengths are in the rig's units."""
    for field, values in (
        (message.position, known.position),
        (message.position_std, known.position_std),
        (message.rotation_std, known.rotation_std),
    ):
        if values is not None:
            field.extend(values.tolist())
    if known.rotation is not None:
        from protocols.geometry import so3

        message.rotation.extend(so3.log(known.rotation).tolist())


def _usable(detection: Detection) -> bool:
    """A detector's slip must not reach the bus, where it would cost the whole frame."""
    return math.isfinite(detection.u) and math.isfinite(detection.v) and math.isfinite(detection.size)


def _detection(detection: Detection) -> pb.Detection:
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
