"""Start-up times and view load: help, first calibration, first paint, CPU of the view.

`python -m tests.bench.view [--quick]` prints the figures that deploy/README.md and hub/README.md state. The browser is
Chromium with software rendering, so that its own work is on the same cores; what is charged to the view is its process.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, PICTURE, TRACK
from tests.support.samples import MATRIX

_SYNCLINE = (sys.executable, "-m", "deploy")


def help_s(runs: int) -> tuple[float, float]:
    """Wall and CPU seconds of `syncline --help`, the best of some runs (what the machine does beside it costs too)."""
    wall = cpu = float("inf")
    for _ in range(runs):
        began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*_SYNCLINE, "--help"], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        wall = min(wall, time.perf_counter() - began)
        cpu = min(cpu, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return wall, cpu


def first_calibration_s(folder: Path) -> float:
    """Seconds from a demo's first frames to its first calibration."""
    words = [*_SYNCLINE, "demo", "--seconds", "25", "--json", "--out", str(folder / "demo")]
    result = subprocess.run(words, check=False, capture_output=True, text=True)
    return float(json.loads(result.stdout)["first_calibration_s"])


class Cameras:
    """Simulated cameras that observe a point at 30 fps, with images, and a hub that has calibrated them."""

    def __init__(self, endpoint: str, count: int) -> None:
        self._endpoint, self._count = endpoint, count
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Cameras:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        import cv2
        import numpy as np

        noise = np.random.default_rng(0).integers(0, 255, (18, 32, 3), dtype=np.uint8)
        jpeg = cv2.imencode(".jpg", cv2.resize(noise, (320, 180)), [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
        names = [f"cam{index}" for index in range(self._count)]
        with open_bus("bench", BusConfig(mode="client", connect=(self._endpoint,)), timeout_s=20.0) as bus:
            seen = {name: bus.publisher(OBSERVATION, name) for name in names}
            infos = {name: bus.publisher(CAMERA_INFO, name) for name in names}
            pictures = {name: bus.publisher(PICTURE, name) for name in names}
            hub, tracks = bus.publisher(CALIBRATION, "hub"), bus.publisher(TRACK, "hub")
            frame = 0
            began = time.monotonic()
            while not self._stop.is_set():
                for index, name in enumerate(names):
                    if frame % 60 == 0:
                        infos[name].put(_info(name))
                    seen[name].put(_observation(name, frame))
                    if frame % 15 == index % 15:
                        pictures[name].put(_picture(name, frame, jpeg))
                if frame % 60 == 0:
                    hub.put(_calibration(names, frame))
                tracks.put(_track(frame))
                frame += 1
                self._stop.wait(max(0.0, began + frame / 30.0 - time.monotonic()))


def watching(count: int, seconds: float, browser: Any) -> dict[str, float]:
    """First paint, and the view's own CPU in percent of a core while a browser watches ``count`` cameras."""
    endpoint = free_endpoint()
    with Router(endpoint), Cameras(endpoint, count):
        words = [*_SYNCLINE, "view", "--connect", endpoint, "--site", "bench", "--port", "0", "--json"]
        began = time.perf_counter()
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            address = json.loads(process.stdout.readline())["address"]
            served = time.perf_counter() - began
            time.sleep(3.0)  # cameras are known: the page has something to show
            figures = {"served_s": served, "alone_percent": _share(process.pid, seconds / 2)}
            if browser is not None:
                context = browser.new_context(viewport={"width": 1000, "height": 640})
                page = context.new_page()
                began = time.perf_counter()
                page.goto(address)
                page.wait_for_function(
                    f"document.querySelectorAll('[data-camera]').length === {count} && document.querySelector('canvas')"
                )
                figures["first_paint_s"] = time.perf_counter() - began
                time.sleep(3.0)
                figures["watched_percent"] = _share(process.pid, seconds)
                context.close()
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(20)
    return figures


def _share(process: int, seconds: float) -> float:
    """CPU of a process in percent of a core."""
    ticks = os.sysconf("SC_CLK_TCK")

    def spent() -> float:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / ticks

    before, began = spent(), time.monotonic()
    time.sleep(seconds)
    return 100.0 * (spent() - before) / (time.monotonic() - began)


def _info(name: str) -> pb.CameraInfo:
    return pb.CameraInfo(
        schema_version=1, camera=name, boot_id="b", width=640, height=480, fps=30.0, driver="bench", matrix=MATRIX
    )


def _observation(name: str, frame: int) -> pb.Observation:
    place = 40.0 + frame % 500
    detection = pb.Detection(u=place, v=0.7 * place, size=12.0, score=0.9, label="marker")
    return pb.Observation(
        schema_version=1,
        camera=name,
        boot_id="b",
        sequence=frame,
        frame=frame,
        device_time_ns=frame * 33_333_333,
        detections=[detection],
    )


def _picture(name: str, frame: int, jpeg: bytes) -> pb.Picture:
    return pb.Picture(schema_version=1, camera=name, boot_id="b", frame=frame, width=640, height=480, jpeg=jpeg)


def _calibration(names: list[str], frame: int) -> pb.Calibration:
    message = pb.Calibration(
        schema_version=1,
        revision=frame,
        status="solved",
        reference_camera=names[0],
        scale="metric",
        units="m",
        solver="joint",
    )
    for index, name in enumerate(names):
        message.cameras.append(
            pb.CameraCalibration(
                camera=name,
                rotation=[0.0, 0.001 * index, 0.0],
                translation=[-0.5 * index, 1e-5 * frame, 0.0],
                clock_rate=1.0,
                time_offset=float(index),
                time_offset_std=1e-5 * (index + 1),
                position_std=[0.001, 0.001, 0.002],
                rms_px=0.3,
                matrix=MATRIX,
                distortions=[0.0] * 5,
            )
        )
    return message


def _track(frame: int) -> pb.Track:
    import math

    return pb.Track(
        schema_version=1,
        sequence=frame,
        label="marker",
        state="confirmed",
        reference_time_ns=frame * 33_333_333,
        position=[math.sin(frame / 30), math.cos(frame / 23), 3.0 + math.sin(frame / 37)],
        position_covariance=[1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-4],
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs")
    quick = parser.parse_args().quick
    wall, cpu = help_s(3 if quick else 10)
    rows = [("`syncline --help`", f"{wall:.2f} s ({cpu:.2f} s of CPU)", "0.3 s")]
    with tempfile.TemporaryDirectory() as folder:
        if not quick:
            first = first_calibration_s(Path(folder))
            rows.append(("`demo` to first calibration", f"{first:.1f} s", "20 s"))
    browser = playwright = None
    try:
        from playwright.sync_api import sync_playwright

        from tests.browser.conftest import FLAGS, chromium_path

        if chromium_path():
            playwright = sync_playwright().start()
            browser = playwright.chromium.launch(executable_path=chromium_path(), args=list(FLAGS))
    except ImportError:
        print("no Playwright: first paint is not measured")
    for count, asked in ((6, "10 %"), (50, "")):
        found = watching(count, 6.0 if quick else 15.0, browser)
        rows.append((f"{count} cameras: the view's CPU, no browser", f"{found['alone_percent']:.1f} %", asked))
        if "first_paint_s" in found:
            paint = "3 s" if count == 6 else ""
            rows.append(
                (f"{count} cameras: first paint of figures and scene", f"{found['first_paint_s']:.1f} s", paint)
            )
            rows.append((f"{count} cameras: the view's CPU, one browser", f"{found['watched_percent']:.1f} %", asked))
    if browser is not None and playwright is not None:
        browser.close()
        playwright.stop()
    print("| | measured | asked |\n|---|---|---|")
    for what, measured, asked in rows:
        print(f"| {what} | {measured} | {asked} |")


if __name__ == "__main__":
    main()
