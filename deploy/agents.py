"""Puts an agent together from its configuration: which device, which detector, which estimator."""

from __future__ import annotations

import math
import os
import threading
import time
from dataclasses import replace
from pathlib import Path

from deploy.config import CameraConfig, HubConfig, SimulatedConfig
from deploy.outputs import write_outputs, write_refusal
from edge.devices.base import Device
from protocols.bus.base import Bus
from protocols.errors import EXIT_DONE, InputError
from protocols.geometry.camera import Intrinsics
from protocols.session.rig import Rig, RigCamera, read_rig

_DAY_S = 86_400.0


def start_camera(config: CameraConfig, bus: Bus, stop: threading.Event) -> int:
    """Run a camera agent until it is stopped or its recording ends."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # a source that doesn't open is told by us, in one line
    import cv2

    from edge.camera_agent import run_camera_agent
    from edge.detectors.marker import MarkerDetector, MarkerModel

    cv2.setNumThreads(1)  # one core a camera: several agents share a board
    known = _known_camera(config)
    device = make_device(config, None if known is None else known.intrinsics)
    lens = device.info.intrinsics if config.driver == "simulated" else None if known is None else known.intrinsics
    marker = config.marker
    model = MarkerModel.default() if marker.colour is None else MarkerModel.of_colour(*marker.colour)
    detector = MarkerDetector(
        replace(model, label=marker.label),
        intrinsics=lens,
        min_size=marker.min_size or 0.0,
        max_size=marker.max_size or math.inf,
    )
    run_camera_agent(device, detector, bus, config.id, stop, known=known)
    return EXIT_DONE


def start_hub(config: HubConfig, bus: Bus, stop: threading.Event) -> int:
    """Run the hub until it is stopped; its answers are also files where `out` is given."""
    from hub.agent import run_hub
    from hub.live import LiveHub, LiveSettings
    from hub.nodes.host import NodeHost

    rig = None if config.rig is None else read_rig(config.rig)
    nodes = NodeHost(config.id, config.nodes, leave_after_s=config.leave_after_s) if config.pose_nodes else None
    hub = LiveHub(LiveSettings(config.window_s, config.interval_s, solve=config.solve), rig, nodes)
    run_hub(hub, bus, config.id, stop, rig=rig)
    if config.out is not None:
        write_last(hub, config.out)
    return EXIT_DONE


def write_last(hub: object, out: Path) -> None:
    """The hub's last answer, or its last refusal, as the files that `calibrate` writes."""
    from hub.live import LiveHub

    assert isinstance(hub, LiveHub)
    if hub.session is None:
        return
    rig, observations = hub.session
    if hub.refusal is not None:
        write_refusal(out, hub.refusal, rig, observations, "syncline hub")
    elif hub.calibration is not None:
        write_outputs(out, hub.calibration, rig, observations, "syncline hub")


def make_device(config: CameraConfig, intrinsics: Intrinsics | None) -> Device:
    """The device that the configuration names, not yet open."""
    if config.driver == "simulated":
        return _simulated(config)
    from edge.devices.pacing import RealTime
    from edge.devices.video import open_video

    assert config.video is not None  # the configuration has seen to that
    return open_video(
        str(config.video.source),
        fps=config.video.fps,
        loop=config.video.loop,
        pace=RealTime(time.time()),
        intrinsics=intrinsics,
    )


def _simulated(config: CameraConfig) -> Device:
    from edge import scenes
    from edge.devices.pacing import RealTime
    from edge.devices.simulated import SimulatedDevice

    world = config.simulated or SimulatedConfig()
    epoch = world.start_unix_s
    if epoch is None:
        epoch = time.time() // _DAY_S * _DAY_S
    scene = scenes.get(world.scene, world.seed, world.cameras)
    return SimulatedDevice(scene, config.id, world.seed, RealTime(epoch), duration_s=world.duration_s)


def _known_camera(config: CameraConfig) -> RigCamera | None:
    if config.rig is None:
        return None
    rig: Rig = read_rig(config.rig)
    camera = rig.cameras.get(config.id)
    if camera is None:
        raise InputError(
            f"no camera {config.id!r} ({', '.join(rig.cameras)})", file=config.rig, remedy=f"add [{config.id}] to it"
        )
    return camera
