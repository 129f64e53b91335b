"""Puts an agent together from its configuration: which device, which detector, which estimator."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

from deploy.config.agents import CameraConfig, HubConfig, SimulatedConfig, UsbConfig
from edge.detectors.base import Detector, Kind
from edge.devices.base import Device
from edge.devices.settings import OakSettings, PiSettings
from protocols.bus.base import Bus
from protocols.core.errors import EXIT_DONE, InputError
from protocols.geometry.camera import Intrinsics
from protocols.session.rig import RigCamera, read_rig


def start_camera(config: CameraConfig, bus: Bus, stop: threading.Event, beat: Callable[[], None] = lambda: None) -> int:
    """Run a camera agent until it is stopped or its recording ends. beat: called with every frame."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # a source that doesn't open is reported by us, in one line
    import cv2

    from deploy.agents.systemd_notify import HeartbeatDevice
    from edge.agents.camera import CameraAgent

    cv2.setNumThreads(1)  # one core a camera: several agents share a board
    known = known_camera(config.rig, config.id)
    device = make_device(config, None if known is None else known.intrinsics)
    if config.driver == "log":
        device.open()  # the lens and the rate are in the log
        if damage := getattr(device, "damage", ""):
            print(f"{config.id}: the log is damaged, its good part is played: {damage}", file=sys.stderr, flush=True)
    info = device.info if config.driver in ("simulated", "log") else None
    lens = info.intrinsics if info is not None else None if known is None else known.intrinsics
    detector = _detector(config, lens, _fps(config) if info is None or info.fps <= 0.0 else info.fps)
    CameraAgent(
        HeartbeatDevice(device, beat),
        detector,
        bus,
        config.id,
        known=known,
        pictures_hz=config.pictures_hz,
        picture_width=config.picture_width,
        predictions=config.detector != "marker",
        target=_target(config),
    ).run(stop)
    return EXIT_DONE


def _target(config: CameraConfig) -> str:
    """What the camera's detector looks for, in one word; "" for other packages' detectors."""
    if config.detector == "marker":
        return {"colour": "ball", "bright": "light", "tag": "tag"}[config.marker.mode]
    return config.detector if config.detector in get_args(Kind) else ""


def _detector(config: CameraConfig, lens: Intrinsics | None, fps: float) -> Detector:
    network = config.driver == "oak" and config.oak is not None and config.oak.nn is not None
    if (network or config.detector != "marker") and find_spec("scipy") is None:
        what = "oak.nn" if network else f'detector = "{config.detector}"'
        raise InputError(
            f"{what} needs SciPy, which a camera's bundle goes without",
            remedy="pip install scipy, or make the bundle with --extra scipy",
        )
    if config.detector == "marker":
        from edge.detectors.marker.ball import MarkerDetector, MarkerModel

        marker = config.marker
        if marker.mode != "colour":
            from edge.detectors.marker.factory import bright_or_tag_detector

            return bright_or_tag_detector(
                marker.mode, marker.threshold, marker.dictionary, marker.label, marker.min_size, marker.max_size
            )
        model = MarkerModel.default() if marker.colour is None else MarkerModel.of_colour(*marker.colour)
        return MarkerDetector(
            replace(model, label=marker.label),
            intrinsics=lens,
            min_size=marker.min_size or 0.0,
            max_size=marker.max_size or math.inf,
        )
    moving = config.moving
    if config.detector not in get_args(Kind):
        from edge.detectors.plugins import is_plugin, load_detector, unknown_detector

        if not is_plugin(config.detector):
            raise unknown_detector(config.detector, ("marker", *get_args(Kind)))
        return load_detector(config.detector, fps=fps, prefix=f"{config.id[:48]}-")
    if config.detector == "person":
        from edge.detectors.people.person import PersonDetector

        # Cameras do not know each other's people: their labels must not look like the same points.
        return PersonDetector(moving.background, fps, prefix=f"{config.id[:48]}-p")
    from edge.detectors.moving.vehicle import VehicleDetector

    camera = {"auto": None, "fixed": False, "moving": True}[moving.camera]
    return VehicleDetector(moving.background, fps, prefix=f"{config.id[:48]}-t", moving=camera)


def _fps(config: CameraConfig) -> float:
    """What the configuration says of the frame rate; 25 where it says nothing."""
    if config.driver == "video" and config.video is not None and config.video.fps is not None:
        return config.video.fps
    tables = {"oak": config.oak, "usb": config.usb, "picamera2": config.picamera2, "rtsp": config.rtsp}
    table = tables.get(config.driver)
    return 25.0 if table is None or table.fps is None else table.fps


def start_hub(config: HubConfig, bus: Bus, stop: threading.Event, beat: Callable[[], None] = lambda: None) -> int:
    """Run the hub until it is stopped; every answer is kept on disk. beat: called every round."""
    from deploy.agents.answer_store import AnswerStore, default_folder
    from hub.distributed.network.host import NodeHost
    from hub.live.agent import run_hub
    from hub.live.live_hub import KnownCalibration, LiveHub, LiveSettings
    from hub.live.shard import Shard
    from hub.live.worker import WorkerSolver
    from protocols.session.calibration import read_calibration

    rig = None if config.rig is None else read_rig(config.rig)
    # A hub that solves publishes its own poses: nodes beside it cost more than all else, and only serve other hubs.
    runs_nodes = config.pose_nodes if config.pose_nodes is not None else bool(config.nodes) or not config.solve
    nodes = NodeHost(config.id, config.nodes, leave_after_s=config.leave_after_s) if runs_nodes else None
    goes_on = config.known == "last"
    known = None if config.known is None or goes_on else KnownCalibration(*read_calibration(Path(config.known)))
    settings = LiveSettings(
        config.window_s,
        config.interval_s,
        solve=config.solve,
        track=config.track,
        refine_lenses=config.refine_lenses,
    )
    hub = LiveHub(settings, rig, None if known is not None else nodes, known, WorkerSolver())
    shard = Shard(config.id, hub, rig) if config.sharded else None
    export = None if config.out is None else partial(_export, out=config.out)
    state = config.state or default_folder(config.out, config.site, config.id)
    store = AnswerStore(state, config.history, None if config.out is None else config.out / "calibration.toml")
    last = store.load(of_any_age=goes_on) if config.solve else None
    if last is not None:
        hub.reload(*last, arrival=store.kept_unix_s if goes_on else None)

    def keep(hub: LiveHub) -> None:
        if config.solve and known is None and (found := hub.for_files()) is not None:
            store.keep(found[0], found[1], hub.boot_ids, hub.delays)
        note(hub)

    def note(hub: LiveHub) -> None:
        hub.notice = f"answers cannot be kept: {store.problem}" if store.problem else ""

    note(hub)
    try:
        run_hub(hub, bus, config.id, stop, rig=rig, beat=beat, export=export, on_result=keep, shard=shard)
    finally:
        store.close()
    if config.out is not None:
        write_last(hub, config.out)
    return EXIT_DONE


def _export(hub: object, out: Path) -> str:
    """Write the files because a view asked for them; one line on what came of it, and never an end of the hub."""
    try:
        write_last(hub, out)
    except InputError as error:
        return f"not exported: {error}"
    return f"exported to {out}"


def write_last(hub: object, out: Path) -> None:
    """Write the hub's last calibration or refusal as the files that `calibrate` writes.

    A refusal does not replace a calibration of before, as of a hub that was restarted while nothing moved.
    """
    # Only here: with it comes the report, which costs a camera agent a fifth of a second of its start.
    from deploy.offline.outputs import report_refusal, report_result
    from hub.api import CalibrationResult
    from hub.live.live_hub import LiveHub
    from protocols.session.calibration import on_present_clock
    from protocols.session.session import Session

    assert isinstance(hub, LiveHub)
    if hub.session is None:
        return
    if (found := hub.for_files()) is not None:
        calibration, rig, observations = found
        report_result(CalibrationResult(on_present_clock(calibration), Session(rig, observations)), out, "syncline hub")
    elif hub.refusal is not None and (earlier := out / "calibration.toml").exists():
        print(f"no answer: {hub.refusal.reason}; kept: {earlier}, of before")
    elif hub.refusal is not None:
        report_refusal(hub.refusal, Session(*hub.session), out, "syncline hub")


def make_device(config: CameraConfig, intrinsics: Intrinsics | None) -> Device:
    """The device that the configuration names, not yet open."""
    if config.driver == "simulated":
        return _simulated(config)
    if config.driver == "oak":
        from edge.devices.live.oak import OakCamera

        return OakCamera(config.oak or OakSettings(), intrinsics=intrinsics, prefix=config.id[:48])
    if config.driver == "usb":
        from edge.devices.live.usb import open_usb

        return open_usb(config.usb or UsbConfig(), intrinsics=intrinsics)
    if config.driver == "picamera2":
        from edge.devices.live.picamera import PiCamera

        return PiCamera(config.picamera2 or PiSettings(), intrinsics=intrinsics)
    if config.driver == "rtsp":
        from edge.devices.live.network import open_network

        assert config.rtsp is not None  # the configuration has seen to that
        url, transport = config.rtsp.url, config.rtsp.transport
        return open_network(url, transport=transport, fps=config.rtsp.fps, intrinsics=intrinsics)
    from edge.devices.playback.playback_clock import RealTime

    if config.driver == "log":
        from edge.devices.playback.log_playback import LogPlayback

        assert config.log is not None  # the configuration has seen to that
        playback_clock = None if config.log.fast else RealTime(time.time())
        return LogPlayback(
            config.log.file, config.log.camera or config.id, playback_clock=playback_clock, intrinsics=intrinsics
        )
    from edge.devices.playback.video_file import open_video

    assert config.video is not None  # the configuration has seen to that
    return open_video(
        str(config.video.source),
        fps=config.video.fps,
        loop=config.video.loop,
        playback_clock=RealTime(time.time()),
        intrinsics=intrinsics,
    )


def _simulated(config: CameraConfig) -> Device:
    from edge.devices.simulated.camera import open_simulated

    simulated = config.simulated or SimulatedConfig()
    return open_simulated(
        simulated.scene,
        simulated.camera or config.id,
        seed=simulated.seed,
        cameras=simulated.cameras,
        width=simulated.width,
        fps=simulated.fps,
        epoch_unix_s=simulated.start_unix_s,
        duration_s=simulated.duration_s,
    )


def known_camera(rig_file: Path | None, name: str) -> RigCamera | None:
    """An agent's own camera in its rig file; None without a file. Raises InputError where it is not in it."""
    if rig_file is None:
        return None
    cameras = read_rig(rig_file).cameras
    if name not in cameras:
        raise InputError(f"no camera {name!r} ({', '.join(cameras)})", file=rig_file, remedy=f"add [{name}] to it")
    return cameras[name]
