"""Puts the UAV agent together from its configuration: camera, link, controls, video, and the simulated aircraft."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from deploy.config.uav import FlightConfig, UavConfig
from edge.devices.base import Device
from protocols.bus.base import Bus
from protocols.core.errors import EXIT_DONE, InputError
from protocols.core.version import VERSION
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.session.rig import read_rig

if TYPE_CHECKING:
    from edge.devices.simulated.aircraft import SimulatedAircraft
    from edge.mavlink.link.connection import Link
    from edge.mavlink.roles.autopilot import Autopilot
    from edge.mavlink.roles.camera import CameraComponent, Select, Stop, Stream
    from edge.uav.tracker import Estimate, Image
    from edge.uav.world.world import World

_HOVER_M = 62.0
_GIMBAL_PITCH = math.radians(-62.0)


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """The world of a simulated agent, and what flies in it."""

    world: World
    aircraft: SimulatedAircraft
    autopilot: Autopilot | None = None


def start_uav(config: UavConfig, bus: Bus, stop: threading.Event, beat: Callable[[], None] | None = None) -> int:
    """Run a UAV agent until it is stopped or its recording ends. beat: called with every frame."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    import cv2

    from deploy.agents.systemd_notify import Watched
    from deploy.agents.uav_video import Shown, serve_video
    from edge.agents.uav import Looking, UavAgent

    cv2.setNumThreads(1)
    with ExitStack() as stack:
        device, lens, mounting = stack.enter_context(_camera(config))
        device.open()  # also tells its size; opening it again does nothing
        info = device.info
        lens = lens or info.intrinsics
        if config.model == "ground" and (lens is None or mounting is None):
            # It works without, but blind to telemetry: say so once, where somebody looks.
            print("syncline: without matrix and body_from_camera in rig the telemetry is not used", flush=True)
        size, fps = (info.width, info.height), info.fps or 30.0
        link = make_link(config)
        shown = Shown()
        stream: Stream | None = None
        if config.video_out is not None:
            stream = serve_video(config.video_out, size, fps, shown, stack)
        # With frames and not with every round: a camera that was unplugged must trip the watchdog.
        watched = device if beat is None else Watched(device, beat)
        agent = make_agent(
            config, watched, link, Looking(size, fps, lens, mounting, config.seed, config.model, _quality(config),
                                           config.pictures_hz, config.picture_width),
            stream=stream, shown=shown.take if stream is not None else None,
        )  # fmt: skip
        assert isinstance(agent, UavAgent)
        agent.run(bus, stop)
    return EXIT_DONE


def make_link(config: UavConfig) -> Link:
    """The link that the configuration names, not yet open."""
    from edge.mavlink.dialect import CAMERA
    from edge.mavlink.link.connection import Link
    from edge.mavlink.link.signing import Signing, read_key
    from edge.mavlink.link.transport import parse
    from edge.mavlink.roles import camera, telemetry

    settings = config.mavlink
    signing = None
    if settings.key is not None:
        state = settings.key_state or settings.key.with_name(f"{settings.key.name}.times.json")
        signing = Signing(read_key(settings.key), state)
    return Link(
        parse(settings.url),
        system=settings.system,
        component=CAMERA,
        allowed=(*telemetry.KINDS, *camera.KINDS),
        signing=signing,
        vehicle=settings.vehicle,
    )


def make_agent(
    config: UavConfig,
    device: Device,
    link: Link,
    looking: object,
    *,
    stream: Stream | None = None,
    shown: Callable[[Image, Estimate | None, str], None] | None = None,
    now_ns: Callable[[], int] = time.monotonic_ns,
    boot_id: str | None = None,
) -> object:
    """The agent around a device and a link. looking: a ``Looking``; now_ns: the host's monotonic clock."""
    from edge.agents.uav import Looking, UavAgent
    from edge.mavlink.roles.camera import CameraComponent
    from edge.mavlink.roles.guidance import Control, Limits
    from edge.mavlink.roles.vehicle import Vehicle

    assert isinstance(looking, Looking)
    numbers = tuple(int(part) for part in VERSION.split(".")[:3])
    bounds = config.control
    limits = Limits(
        gimbal=bounds.gimbal,
        follow=bounds.follow,
        pitch=(math.radians(bounds.pitch_deg[0]), math.radians(bounds.pitch_deg[1])),
        rate=math.radians(bounds.rate_deg_s),
        coast_s=bounds.coast_s,
        std_m=bounds.std_m,
        range_m=bounds.range_m,
        speed=bounds.speed,
    )

    def component(obey: Callable[[Select | Stop], bool]) -> CameraComponent:
        return CameraComponent(
            link,
            looking.size,
            looking.fps,
            looking.lens,
            stream,
            obey,
            stations=frozenset(config.mavlink.stations),
            version=(numbers[0], numbers[1], numbers[2]),
        )

    return UavAgent(
        device,
        link,
        Vehicle(link, gimbal=config.mount == "gimbal", rate_hz=config.mavlink.rate_hz),
        component,
        Control(link, limits),
        config.id,
        looking,
        shown=shown,
        now_ns=now_ns,
        boot_id=boot_id,
    )


def simulation(flight: FlightConfig, size: tuple[int, int] = (640, 480)) -> Simulation:
    """The world of a [simulated] table and its aircraft, at the world's time 0. Raises InputError."""
    import numpy as np

    from edge.devices.simulated.aircraft import SimulatedAircraft
    from edge.uav.world.patrol import patrol

    world = patrol(flight.seed, flight.seconds, size)
    if flight.flies == "path" and not flight.gimbal:
        return Simulation(world, SimulatedAircraft(world.flight, seed=flight.seed))
    ground, yaw = world.target.ground[0], float(world.target.course[0])
    start = np.array([ground[0], ground[1], -_HOVER_M])
    gimbal = pilot = None
    if flight.flies == "follow":
        # As a pilot would, it flies above the car until it is told where that is.
        pilot = world.target_at
        if flight.gimbal:
            gimbal = (-0.5 * math.pi, yaw)
    else:
        # Beside the way, so that the car is looked at from aside.
        back = _HOVER_M / math.tan(-_GIMBAL_PITCH)
        start[:2] -= back * np.array([math.cos(yaw), math.sin(yaw)])
        gimbal = (_GIMBAL_PITCH, yaw)
    camera = None if flight.gimbal else np.asarray(world.body_from_camera)
    aircraft = SimulatedAircraft(start=start, yaw=yaw, pilot=pilot, camera=camera, gimbal=gimbal, seed=flight.seed)
    return Simulation(world, aircraft)


@contextmanager
def flying(flight: FlightConfig, site: Simulation, epoch_unix_s: float) -> Iterator[None]:
    """The autopilot of a simulation, on its UDP port, in a thread of its own."""
    from edge.devices.playback.playback_clock import RealTime
    from edge.mavlink.link.transport import Udp, Url
    from edge.mavlink.roles.autopilot import Autopilot, Faults

    host, _, port = flight.autopilot.rpartition(":")
    try:
        transport = Udp(Url("udpin", host, int(port)), bound=True)
    except OSError as error:
        raise InputError(
            f"the autopilot cannot wait at {flight.autopilot}: {error.strerror}", remedy="choose another port"
        ) from None
    faults = Faults(
        flight.drop, flight.duplicate, flight.garble, flight.delay_s, flight.jitter_s, tuple(flight.reboot_at)
    )
    autopilot = Autopilot(site.aircraft, transport, boot_s=flight.boot_s, faults=faults, seed=flight.seed)
    pace, stop = RealTime(epoch_unix_s), threading.Event()

    def run() -> None:
        while not stop.is_set():
            transport.wait(0.005)
            autopilot.step(pace.now())

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
    """The camera, its lens, and body_from_camera."""
    if config.driver == "simulated":
        import numpy as np

        from edge.devices.playback.playback_clock import RealTime
        from edge.devices.simulated.aircraft_camera import FlightCamera

        flight = config.simulated or FlightConfig()
        site = simulation(flight)
        epoch = time.time() if flight.start_unix_s is None else flight.start_unix_s
        fixed = np.asarray(site.world.body_from_camera)
        with flying(flight, site, epoch):
            camera = FlightCamera(site.world, site.aircraft, RealTime(epoch), ahead_s=flight.camera_ahead_s)
            yield camera, site.world.lens, gimbal_mounting() if config.mount == "gimbal" else fixed
        return
    from deploy.agents.assembly import make_device
    from deploy.config.agents import CameraConfig

    lens, mounting = _rig_camera(config)
    settings = CameraConfig(id=config.id, driver=config.driver, video=config.video, oak=config.oak)
    yield make_device(settings, lens), lens, mounting


def gimbal_mounting() -> Floats:
    """body_from_camera of a camera that looks along its gimbal's x axis."""
    from edge.devices.simulated.aircraft import GIMBAL_FROM_CAMERA

    return GIMBAL_FROM_CAMERA


def _rig_camera(config: UavConfig) -> tuple[Intrinsics | None, Floats | None]:
    if config.rig is None:
        return None, gimbal_mounting() if config.mount == "gimbal" else None
    rig = read_rig(config.rig)
    camera = rig.cameras.get(config.id)
    if camera is None:
        raise InputError(
            f"no camera {config.id!r} ({', '.join(rig.cameras)})", file=config.rig, remedy=f"add [{config.id}] to it"
        )
    mounting = camera.body_from_camera
    if mounting is None and config.mount == "gimbal":
        mounting = gimbal_mounting()
    return camera.intrinsics, mounting


def _quality(config: UavConfig) -> int | None:
    return None if config.images is None else config.images.quality
