"""`syncline quick`: two webcams, no configuration."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from deploy.commands.common import Flag, Json, NumberList, answer, check_range, check_seed, command_line, parse_box
from protocols.core.errors import EXIT_DONE, InputError, Refused

if TYPE_CHECKING:
    from edge.devices.base import Device
    from hub.view.server import ViewServer


def quick(
    *,
    cameras: str = "0,1",
    source: tuple[Path, ...] = (),
    simulated: Flag = False,
    out: Path = Path("quick-out"),
    target: NumberList | None = None,
    rig: Path | None = None,
    field_of_view: float = 65.0,
    seconds: float = 300.0,
    port: int = 8080,
    headless: Flag = False,
    seed: int = 1,
    json: Json = False,
) -> int:
    """Calibrate the cameras connected to this machine by waving a ball. No configuration file is needed.

    Prints the address of a page that shows the cameras' images, with a ring around the ball. Click on the ball if it
    has no ring, and wave it where the page advises. It ends by itself once the clock offset of every camera is known
    to half a millisecond, or with the button Finish. Writes the same files as `syncline calibrate` to --out and opens
    the report.

    Webcams without measured intrinsics are assumed to have a field of view of --field-of-view degrees: clock offsets
    are still accurate, poses only approximate. `syncline intrinsics` calibrates a lens; pass its rig.toml with --rig
    (cameras cam0, cam1, …).

    Example: syncline quick --cameras 0,1 --out quick-out

    Example: syncline quick --source left.mp4 --source right.mp4 --target 310,220,40,40

    Parameters
    ----------
    cameras
        Numbers of the webcams, or /dev/video…, separated by commas.
    source
        Video files instead of webcams, one option per file; they must show the same scene at the same time.
    simulated
        Use two simulated cameras.
    out
        Folder for the results.
    target
        Bounding box x,y,w,h of the ball in pixels in the first camera's first frame, instead of a click.
    rig
        rig.toml with intrinsics or known positions.
    field_of_view
        Horizontal field of view of a webcam in degrees, where no intrinsics are known.
    seconds
        Longest duration.
    port
        Port of the page; 0 = any free port.
    headless
        Serve no page, for use in scripts.
    seed
        Seed of the simulated scene.
    """
    check_range("--field-of-view", field_of_view, 5.0, 170.0, "give 5 to 170 degrees")
    check_range("--seconds", seconds, 1.0, 86_400.0, "give 1 to 86400")
    if simulated and source:
        raise InputError("--simulated and --source exclude each other", remedy="leave one of the two out")
    check_seed(seed)
    box = None if target is None else parse_box(target)
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    import cv2

    from deploy.agents.processes import stop_on_signals
    from deploy.agents.quick import QuickCalibration, QuickSettings, show_report
    from deploy.offline.outputs import report_refusal, report_result
    from hub.api import CalibrationResult
    from protocols.core.files import check_folder
    from protocols.session.rig import read_rig
    from protocols.session.session import Session

    cv2.setNumThreads(1)
    check_folder(out)
    devices = _simulated(seed) if simulated else _video_files(source) if source else _webcams(cameras)
    known = None if rig is None else read_rig(rig)
    if known is not None and known.cameras.keys().isdisjoint(devices):
        what = f"knows cameras {', '.join(known.cameras)}, none of {', '.join(devices)}"
        raise InputError(what, file=rig, remedy="name its tables like these")
    view = None if headless else _make_view_server(port)
    report = (lambda text: None) if json else lambda text: print(text, flush=True)
    settings = QuickSettings(
        devices, out, field_of_view, live=not source, seconds=seconds, rig=known, target=box, report=report
    )
    run = QuickCalibration(settings, view)
    if view is not None:
        answer({"address": view.address}, [f"open {view.address}"], json)
    began = time.process_time()
    hub = run.run(stop_on_signals())
    if hub.session is None:
        raise Refused(hub.missing() or "nothing was seen")
    session = Session(*hub.session)
    assumed = ", ".join(run.lens_assumed)
    text = f"a field of view of {field_of_view:g} degrees is assumed for {assumed}: poses are approximate"
    warnings = (text,) if assumed else ()
    command = command_line()
    cpu = time.process_time() - began
    if hub.refusal is not None or hub.calibration is None:
        refusal = hub.refusal or Refused(hub.missing() or "nothing was seen")
        refusal.cpu_seconds, refusal.warnings = cpu, (*warnings, *refusal.warnings)
        report_refusal(refusal, session, out, command, echo_json=json)
    else:
        found = replace(hub.calibration, warnings=(*warnings, *hub.calibration.warnings), cpu_seconds=cpu)
        report_result(CalibrationResult(found, session), out, command, echo_json=json)
    page = out / "report.html"
    if view is not None and not show_report(page) and not json:
        print(f"the report is {page}")
    if hub.refusal is not None:
        raise hub.refusal
    return EXIT_DONE


def _webcams(cameras: str) -> dict[str, Device]:
    from edge.devices.playback.video_file import open_video

    names = [place.strip() for place in cameras.split(",") if place.strip()]
    _check_cameras(names, "--cameras")
    for place in names:
        if not (place.isdecimal() or place.startswith("/dev/") or "://" in place):
            raise InputError(f"--cameras {place!r} is no camera", remedy="give numbers, as in 0,1, or /dev/video0")
    return {f"cam{index}": open_video(place) for index, place in enumerate(names)}


def _video_files(files: tuple[Path, ...]) -> dict[str, Device]:
    from edge.devices.playback.video_file import open_video

    _check_cameras([str(file) for file in files], "--source")
    for file in files:
        if not file.exists():
            raise InputError("this video does not exist", file=file, remedy="check the path")
    # Files are read as fast as possible, not in real time.
    return {f"cam{index}": open_video(file) for index, file in enumerate(files)}


def _simulated(seed: int) -> dict[str, Device]:
    from edge import scenes
    from edge.devices.playback.playback_clock import RealTime
    from edge.devices.simulated.camera import SimulatedDevice

    clock = RealTime(time.time())
    scene = scenes.get_marker_scene("marker", seed, 2)
    return {name: SimulatedDevice(scene, name, seed, clock) for name in ("cam0", "cam1")}


def _check_cameras(names: list[str], option: str) -> None:
    if len(names) < 2:
        raise InputError(f"{option} names {len(names)} of at least 2 cameras", remedy="give two or more")
    if len(set(names)) < len(names):
        raise InputError(f"{option} names a camera twice", remedy="give each once")


def _make_view_server(port: int) -> ViewServer:
    try:
        from hub.view.server import ViewServer
    except ImportError:
        remedy = 'pip install "syncline[view]" (without a network: the bundle of a hub), or give --headless'
        raise InputError("the page needs viser", remedy=remedy) from None
    return ViewServer(port=port, actions=("recalibrate",))
