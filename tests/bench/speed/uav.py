"""The UAV tracker beside OpenCV's CSRT, KCF, MOSSE and MIL on the same flights: CPU per frame with the target in view.

Run with a folder that holds opencv-contrib first on the path (``make bench`` makes it): ours then runs on it too.
"""

from __future__ import annotations

import time
from pathlib import Path

import cv2

from edge.uav.base import Tracker
from edge.uav.world import scenarios
from tests.bench import uav_any_view, uav_rivals
from tests.bench.speed.rows import Limit, Row, Section
from tests.bench.uav_tracker import Options, make

_OPENCV_TRACKERS = ("csrt", "kcf", "mil")
_LIMITS = {(640, 480): (4.0, 3.0), (1280, 720): (6.0, 5.0)}  # ms a frame: must, reach


def flight(size: tuple[int, int], frames: int, opencv_names: tuple[str, ...]) -> dict[str, float]:
    """CPU ms a frame of each tracker over one flight; the car takes a bend and leaves the image."""
    world = scenarios.get("exit-bend", 16, size=size, frames=30)
    samples = world.telemetry(30.0, time_offset=0.0)
    trackers: dict[str, Tracker] = {"ground": make("ground", world, True, Options(("ground",)))}
    trackers |= {name: uav_rivals.OpenCvTracker(name) for name in opencv_names}
    spent = dict.fromkeys(trackers, 0.0)
    count = dict.fromkeys(trackers, 0)
    arrived = 0
    for i in range(min(frames, world.length)):
        image, truth = world.frame(i), world.truth(i)
        fresh = []
        while arrived < len(samples) and samples[arrived].time <= world.time(i):
            fresh.append(samples[arrived])
            arrived += 1
        for name, tracker in trackers.items():
            if name != "ground" and truth.inside < 0.5:
                continue
            began = time.process_time()
            for sample in fresh:
                tracker.handle_telemetry(sample)
            if i == 0:
                tracker.begin(image, world.time(0), truth.box)
            else:
                tracker.handle_frame(image, world.time(i))
                spent[name] += time.process_time() - began
                count[name] += 1
    return {name: 1e3 * spent[name] / max(count[name], 1) for name in trackers}


def _oblique(quick: bool, opencv_names: tuple[str, ...]) -> list[Row]:
    """A rendered oblique flight without lens and telemetry: CPU a frame, and overlap with the true box."""
    sequence = uav_any_view.flight("car", "orbit", 5, 15.0, 0.0, 30 if quick else 90)
    scores = {name: uav_any_view.run(sequence, name) for name in ("ground", *opencv_names)}
    ours = scores["ground"]
    rows = []
    for name in opencv_names:
        theirs, beside = scores[name], name.upper()
        rows.append(
            Row("any target 640×360, oblique, a frame", ours.ms, "ms", beside, theirs.ms, must=Limit("ours", 15.0))
        )
        overlap = "any target, oblique: overlap with the truth"
        rows.append(Row(overlap, ours.overlap, "IoU", beside, theirs.overlap, less=False))
    return rows


def measure(quick: bool, data: Path) -> Section:
    """Both sizes, with the OpenCV trackers that are available."""
    del data
    cv2.setNumThreads(1)
    opencv_names = tuple(name for name in _OPENCV_TRACKERS if uav_rivals.available(name))
    found = Section()
    for name in _OPENCV_TRACKERS:
        if name not in opencv_names:
            found.missing.append(f"UAV tracker beside {name.upper()}: needs opencv-contrib (`make bench` fetches it)")
    for size, (must, reach) in _LIMITS.items():
        ms = flight(size, 60 if quick else 150, opencv_names)
        limits = {"must": Limit("ours", must), "reach": Limit("ours", reach)}
        work = f"UAV tracker {size[0]}×{size[1]}, a frame"
        if not opencv_names:
            found.rows.append(Row(work, ms["ground"], "ms", **limits))
        for number, name in enumerate(opencv_names):
            found.rows.append(Row(work, ms["ground"], "ms", name.upper(), ms[name], **(limits if number == 0 else {})))
    found.rows += _oblique(quick, tuple(name for name in uav_rivals.NAMES if uav_rivals.available(name)))
    return found
