"""Builds the UAV agent from its configuration: camera, MAVLink connection, guidance, video, and simulated aircraft."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from deploy.config.uav import SimulatedFlightConfig, UavConfig, VideoOutConfig
from edge.devices.base import Device
from protocols.bus.base import Bus
from protocols.core.errors import EXIT_DONE, InputError
from protocols.core.jpeg import encode_jpeg
from protocols.core.version import VERSION
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

if TYPE_CHECKING:
    from edge.devices.simulated.aircraft import SimulatedAircraft
    from edge.mavlink.link.connection import Link
    from edge.mavlink.roles.camera import CameraComponent, OperatorCommand
    from edge.mavlink.roles.camera_messages import VideoStream
    from edge.uav.base import Estimate
    from edge.uav.world.flight_world import FlightWorld
    from protocols.geometry.types import Image

_HOVER_HEIGHT_M = 62.0  # m above the ground
_GIMBAL_PITCH_RAD = math.radians(-62.0)


class OperatorVideo:
    """The latest frame and estimate, rendered and encoded only on request. notify: called for every new frame."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._latest: tuple[Image, Estimate | None, str] | None = None
        self.notify: Callable[[], None] = lambda: None

    def update(self, image: Image, estimate: Estimate | None, line: str) -> None:
        """Set the latest processed frame; line: text to draw on it."""
        with self._lock:
            # Layers refer to the tracker's current frame only.
            self._latest = (image, None if estimate is None else replace(estimate, layers={}), line)
        self.notify()

    def render(self) -> Image | None:
        """The latest frame (h, w, 3) BGR with the estimate drawn on it; None before the first one."""
        from edge.uav.operator_view import draw

        with self._lock:
            newest = self._latest
        return None if newest is None else draw(*newest)

    def jpeg(self, quality: int) -> bytes | None:
        """The rendered frame as JPEG."""
        image = self.render()
        return None if image is None else encode_jpeg(image, quality) or None


def serve_video(
    out: VideoOutConfig, size: tuple[int, int], fps: float, operator_video: OperatorVideo, stack: ExitStack
) -> VideoStream:
    """Serve the video until the stack is closed; returns the stream's address for ground stations.

    size: (width, height) [px]. Raises InputError if it cannot be served.
    """
    from edge.mavlink.roles.camera_messages import VideoStream

    host, _, text = out.listen.rpartition(":")
    host, port = host.strip("[]"), int(text)
    if out.stream == "rtsp":
        from edge.video import rtsp_server

        server = stack.enter_context(rtsp_server.RtspServer(host, port, operator_video.render, size, fps, out.kbps))
        operator_video.notify = server.notify_frame
        scheme, path, port = "rtsp", rtsp_server.PATH, server.port
    else:
        from edge.video import mjpeg_server

        pages = stack.enter_context(mjpeg_server.MjpegServer(host, port, lambda: operator_video.jpeg(out.quality)))
        operator_video.notify = pages.notify_frame
        scheme, path, port = "http", mjpeg_server.PATH, pages.port
    shown_host = f"[{host}]" if ":" in host else host
    uri = out.uri or f"{scheme}://{shown_host}:{port}{path}"
    return VideoStream("rtsp" if uri.startswith("rtsp://") else "mjpeg", uri)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFlight:
    """The simulated world of a UAV agent, its aircraft and its autopilot."""

    world: FlightWorld
    aircraft: SimulatedAircraft


def start_uav(config: UavConfig, bus: Bus, stop: threading.Event, beat: Callable[[], None] | None = None) -> int:
    """Run a UAV agent until it is stopped or its recording ends. beat: called for every frame."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    import cv2

    from deploy.agents.systemd_notify import HeartbeatDevice
    from edge.agents.uav import UavAgent
    from edge.agents.uav_settings import UavSettings

    cv2.setNumThreads(1)
    with ExitStack() as stack:
        device, lens, mounting = stack.enter_context(_camera(config))
        device.open()  # its image size is known only then; opening it again has no effect
        info = device.info
        lens = lens or info.intrinsics
        if config.model == "ground" and (lens is None or mounting is None):
            # It works without them, but cannot use telemetry: reported once, at the start.
            print("syncline: without matrix and body_from_camera in rig the telemetry is not used", flush=True)
        size, fps = (info.width, info.height), info.fps or 30.0
        link = make_link(config)
        operator_video = OperatorVideo()
        stream: VideoStream | None = None
        if config.video_out is not None:
            stream = serve_video(config.video_out, size, fps, operator_video, stack)
        # One heartbeat per frame and not per cycle: a hanging camera must trip the watchdog.
        heartbeat_device = device if beat is None else HeartbeatDevice(device, beat)
        settings = UavSettings(
            size,
            fps,
            lens,
            mounting,
            config.seed,
            config.model,
            None if config.images is None else config.images.quality,
            config.pictures_hz,
            config.picture_width,
        )
        show = operator_video.update if stream is not None else None
        agent = make_agent(config, heartbeat_device, link, settings, stream=stream, shown=show)
        assert isinstance(agent, UavAgent)
        agent.run(bus, stop)
    return EXIT_DONE


def make_link(config: UavConfig) -> Link:
    """The configured MAVLink connection, not yet open."""
    from edge.mavlink.dialect import CAMERA
    from edge.mavlink.link.connection import Link
    from edge.mavlink.link.signing import Signing, read_key
    from edge.mavlink.link.transport import parse_url
    from edge.mavlink.roles import camera, telemetry

    settings = config.mavlink
    signing = None
    if settings.key is not None:
        state = settings.key_state or settings.key.with_name(f"{settings.key.name}.times.json")
        signing = Signing(read_key(settings.key), state)
    return Link(
        parse_url(settings.url),
        system=settings.system,
        component=CAMERA,
        allowed=(*telemetry.MESSAGE_TYPES, *camera.MESSAGE_TYPES),
        signing=signing,
        vehicle=settings.vehicle,
        beacon=config.control.beacon,
    )


def make_agent(
    config: UavConfig,
    device: Device,
    link: Link,
    settings: object,
    *,
    stream: VideoStream | None = None,
    shown: Callable[[Image, Estimate | None, str], None] | None = None,
    now_ns: Callable[[], int] = time.monotonic_ns,
    boot_id: str | None = None,
) -> object:
    """The agent for a device and a link. settings: a ``UavSettings``; now_ns: the host's monotonic clock."""
    from edge.agents.uav import UavAgent
    from edge.agents.uav_settings import UavSettings
    from edge.mavlink.roles.camera import CameraComponent
    from edge.mavlink.roles.guidance import Guidance
    from edge.mavlink.roles.vehicle import Vehicle

    assert isinstance(settings, UavSettings)
    detector = None
    if config.detector is not None:
        from edge.detectors.plugins import load_detector

        detector = load_detector(config.detector, fps=settings.fps, seed=config.seed)
    numbers = tuple(int(part) for part in VERSION.split(".")[:3])

    def component(on_command: Callable[[OperatorCommand], bool]) -> CameraComponent:
        return CameraComponent(
            link,
            settings.size,
            settings.fps,
            settings.lens,
            stream,
            on_command,
            stations=frozenset(config.mavlink.stations),
            version=(numbers[0], numbers[1], numbers[2]),
        )

    return UavAgent(
        device,
        link,
        Vehicle(link, gimbal=config.mount == "gimbal", rate_hz=config.mavlink.rate_hz),
        component,
        Guidance(link, config.control),
        config.id,
        settings,
        shown=shown,
        now_ns=now_ns,
        boot_id=boot_id,
        detector=detector,
    )


def simulate_flight(flight: SimulatedFlightConfig, size: tuple[int, int] = (640, 480)) -> SimulatedFlight:
    """The world and the aircraft of a [simulated] table, at world time 0. Raises InputError."""
    import numpy as np

    from edge.devices.simulated.aircraft import SimulatedAircraft
    from edge.uav.world.patrol import patrol_world

    world = patrol_world(flight.seed, flight.seconds, size)
    if flight.flies == "path" and not flight.gimbal:
        return SimulatedFlight(world, SimulatedAircraft(world.flight, seed=flight.seed))
    ground, yaw = world.target.ground[0], float(world.target.course[0])
    start = np.array([ground[0], ground[1], -_HOVER_HEIGHT_M])
    gimbal = pilot = None
    if flight.flies == "follow":
        # It flies above the car, as a pilot would, until the car's position is estimated.
        pilot = world.target_at
        if flight.gimbal:
            gimbal = (-0.5 * math.pi, yaw)
    else:
        # Beside the path, so that the car is seen from the side.
        back = _HOVER_HEIGHT_M / math.tan(-_GIMBAL_PITCH_RAD)
        start[:2] -= back * np.array([math.cos(yaw), math.sin(yaw)])
        gimbal = (_GIMBAL_PITCH_RAD, yaw)
    camera = None if flight.gimbal else np.asarray(world.body_from_camera)
    aircraft = SimulatedAircraft(start=start, yaw=yaw, pilot=pilot, camera=camera, gimbal=gimbal, seed=flight.seed)
    return SimulatedFlight(world, aircraft)


@contextmanager
def running_autopilot(
    flight: SimulatedFlightConfig, simulated_flight: SimulatedFlight, epoch_unix_s: float
) -> Iterator[None]:
    """Run the autopilot of a simulation on its UDP port in a separate thread."""
    from edge.devices.playback.playback_clock import RealTime
    from edge.mavlink.link.transport import Udp, Url
    from edge.mavlink.roles.autopilot import Autopilot, LinkFaults

    host, _, port = flight.autopilot.rpartition(":")
    try:
        transport = Udp(Url("udpin", host, int(port)), bound=True)
    except OSError as error:
        raise InputError(
            f"the autopilot cannot listen at {flight.autopilot}: {error.strerror}", remedy="choose another port"
        ) from None
    faults = LinkFaults(
        flight.drop, flight.duplicate, flight.garble, flight.delay_s, flight.jitter_s, tuple(flight.reboot_at)
    )
    autopilot = Autopilot(simulated_flight.aircraft, transport, boot_s=flight.boot_s, faults=faults, seed=flight.seed)
    clock, stop = RealTime(epoch_unix_s), threading.Event()

    def run() -> None:
        while not stop.is_set():
            transport.wait(0.005)
            autopilot.step(clock.now())

    thread = threading.Thread(target=run, name="autopilot", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(2.0)
        transport.close()


@contextmanager
def _camera(config: UavConfig) -> Iterator[tuple[Device, Intrinsics | None, Floats | None]]:
    """The camera, its intrinsics, and the rotation body_from_camera (3, 3)."""
    if config.driver == "simulated":
        import numpy as np

        from edge.devices.playback.playback_clock import RealTime
        from edge.devices.simulated.aircraft import FlightCamera

        flight = config.simulated or SimulatedFlightConfig()
        simulated_flight = simulate_flight(flight)
        epoch = time.time() if flight.start_unix_s is None else flight.start_unix_s
        fixed = np.asarray(simulated_flight.world.body_from_camera)
        with running_autopilot(flight, simulated_flight, epoch):
            camera = FlightCamera(
                simulated_flight.world, simulated_flight.aircraft, RealTime(epoch), clock_offset_s=flight.camera_ahead_s
            )
            yield camera, simulated_flight.world.lens, gimbal_from_camera() if config.mount == "gimbal" else fixed
        return
    from deploy.agents.assembly import known_camera, make_device
    from deploy.config.agents import CameraConfig

    known = known_camera(config.rig, config.id)
    lens, mounting = (None, None) if known is None else (known.intrinsics, known.body_from_camera)
    if mounting is None and config.mount == "gimbal":
        mounting = gimbal_from_camera()
    settings = CameraConfig(id=config.id, driver=config.driver, video=config.video, oak=config.oak)
    yield make_device(settings, lens), lens, mounting


def gimbal_from_camera() -> Floats:
    """The rotation gimbal_from_camera (3, 3) of a camera that looks along its gimbal's x axis."""
    from edge.devices.simulated.aircraft import GIMBAL_FROM_CAMERA

    return GIMBAL_FROM_CAMERA
