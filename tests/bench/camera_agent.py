"""A camera agent at 1280x720 and 30 frames a second: from the picture to the message on the bus, on one core.

    python -m tests.bench.camera_agent [--seconds 20] [--seed 0]

Rendered pictures of the room, enlarged, are handed to the agent by a clock; its observations go over real Zenoh to a
router and are taken by this process. Wall: from the moment at which the picture is there until its observation has
come. CPU: of the capture thread for one frame (detection and message). The simulated driver's stamps are compared with
the world's own time of each picture.
"""

from __future__ import annotations

import argparse
import os
import threading
import time

import cv2
import numpy as np

from edge import scenes
from edge.agents.camera import CameraAgent
from edge.detectors.base import Detection, Prediction
from edge.detectors.marker.ball import MarkerDetector
from edge.devices.base import DeviceInfo, Frame
from edge.devices.simulated.camera import SimulatedDevice
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.geometry.types import Image
from protocols.topics import OBSERVATION
from tests.support.clocks import AsFastAsPossible

SIZE, FPS = (1280, 720), 30.0


class Played:
    """Pictures at a fixed rate of the host's clock, which stamps them."""

    def __init__(self, pictures: list[Image], seconds: float) -> None:
        self.info = DeviceInfo(*SIZE, FPS, "bench", "monotonic")
        self.pictures, self.count, self.number = pictures, round(seconds * FPS), -1
        self.began = 0

    @property
    def ended(self) -> bool:
        return self.number + 1 >= self.count

    def open(self) -> None:
        self.began = time.monotonic_ns() + 500_000_000

    def read(self, timeout_s: float) -> Frame | None:
        due = self.began + round((self.number + 1) * 1e9 / FPS)
        wait = (due - time.monotonic_ns()) * 1e-9
        if wait > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait, 0.0))
        self.number += 1
        return Frame(self.pictures[self.number % len(self.pictures)], time.monotonic_ns(), self.number)

    def close(self) -> None:
        self.number = self.count


class Timed:
    """A detector and the CPU seconds of each of its calls."""

    def __init__(self) -> None:
        self.inner, self.seconds = MarkerDetector(), list[float]()

    def detect(
        self, image: Image, time_s: float | None = None, predictions: tuple[Prediction, ...] = ()
    ) -> list[Detection]:
        began = time.thread_time()
        found = self.inner.detect(image)
        self.seconds.append(time.thread_time() - began)
        return found


def stamps(seed: int, count: int = 300) -> np.ndarray:
    """Error [s] of the simulated driver's stamps against the world's clock, by drawing what it was asked to draw."""
    errors = []
    for camera in ("cam0", "cam1"):
        scene = scenes.get_marker_scene("marker", seed)
        device = SimulatedDevice(scene, camera, seed, AsFastAsPossible(50.0), duration_s=count / 30.0)
        device.open()
        clock = scene.camera(camera).clock
        drawn: list[float] = []
        renderer = device._renderer
        assert renderer is not None
        renderer.render = lambda moment, into=drawn: (into.append(moment), np.zeros((4, 4, 3), np.uint8))[1]  # type: ignore[method-assign,misc]
        while not device.ended:
            frame = device.read(1.0)
            if frame is not None:
                errors.append(clock.true_time(frame.device_time_ns) - drawn[-1])
    return np.array(errors)


def main() -> None:
    """Print the figures."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=float, default=20.0)
    arguments.add_argument("--seed", type=int, default=0)
    options = arguments.parse_args()
    cv2.setNumThreads(1)
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[-1]})
    renderer = scenes.renderer_for(
        scenes.get_marker_scene("marker", options.seed), "cam0", np.random.default_rng(options.seed)
    )
    pictures = [
        np.asarray(cv2.resize(renderer.render(moment), SIZE), dtype=np.uint8) for moment in np.linspace(1.0, 20.0, 60)
    ]
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    detector, latencies = Timed(), list[float]()
    with Router(endpoint), open_bus("local", config) as sending, open_bus("local", config) as receiving:
        heard = receiving.subscribe(OBSERVATION)
        device = Played(pictures, options.seconds)
        cpu = time.process_time()
        agent = threading.Thread(
            target=CameraAgent(device, detector, sending, "cam0").run, args=(threading.Event(),), daemon=True
        )
        agent.start()
        while agent.is_alive() or heard.wait(0.5):
            if heard.wait(0.2):
                now = time.monotonic_ns()
                latencies += [(now - item.message.device_time_ns) * 1e-6 for item in heard.drain()]  # type: ignore[attr-defined]
        cpu = time.process_time() - cpu
    wall, busy = np.array(latencies), 1e3 * np.array(detector.seconds)
    print(f"{len(wall)} of {device.count} observations, {cpu / options.seconds:.2f} of a core for all of it")
    print(f"wall, picture to message: p50 {np.median(wall):.1f} ms, p99 {np.percentile(wall, 99):.1f} ms")
    print(f"CPU of a detection: p50 {np.median(busy):.1f} ms, p99 {np.percentile(busy, 99):.1f} ms")
    error = 1e3 * stamps(options.seed)
    print(
        f"simulated stamps: RMS {np.sqrt(np.mean(error**2)):.4f} ms, worst {np.abs(error).max():.4f} ms ({len(error)})"
    )


if __name__ == "__main__":
    main()
