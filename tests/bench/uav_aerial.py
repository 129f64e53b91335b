"""How well the UAV tracker follows real cars that drive out of view, without telemetry and without knowing the lens.

    python -m tests.bench.uav_aerial [--data ../shared/data] [--models ground,plain,paper,csrt,kcf] [--json]

A drone's video of a crossroads (aerial-traffic in the data folder) is cropped to a window a frame, placed so that the
car itself leaves the picture; after a while the window moves after it. The video is no part of the project; where it is
absent this says so and leaves with status 0.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from edge.uav.tracker import Box, Estimate, Image, State, Tracker
from protocols.geometry.types import Floats
from tests.bench import uav_rivals
from tests.bench.real_rigs import DEFAULT_DATA

MODELS = ("ground", "plain", "paper", *uav_rivals.NAMES)
SIZE = (400, 225)
FPS = 30.0
FOLDER, VIDEO = "aerial-traffic", "traffic.mp4"
AFTER_S = 0.8
"""How long after the car has left its distance is taken [s]."""
_NEAR = 20.0
_RUN, _WITHIN = 5, 60  # frames running that make a re-acquisition; within so many of being half visible


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One car's window. corner: (n, 2) top left in the video [px]; box: (n, 4) of the car, x, y its top left, in the
    window; visible: (n,) share of the box in the window."""

    car: str
    corner: Floats
    box: Floats
    visible: Floats

    @property
    def centre(self) -> Floats:
        """Of the car (n, 2) in the window [px]."""
        return np.asarray(self.box[:, :2] + 0.5 * (self.box[:, 2:] - 1.0))

    @property
    def length(self) -> float:
        """Of the car: the longer side of its box before it leaves [px]."""
        return float(np.median(self.box[:10, 2:].max(axis=1)))


@dataclass(frozen=True, slots=True)
class Result:
    """One car and one tracker.

    reacquired: 20 px for 5 frames running within 60 of half visible, after ``delay`` frames. lengths_after: distance
    0.8 s after it has left [car lengths], nan where lost. claims: frames out that claim ``visible``, of out.
    in_near: share of the frames with the car's centre in the window that are within 20 px. ms: CPU a frame.
    crash: what it raised; from there on it counts as lost.
    """

    car: str
    model: str
    reacquired: bool
    delay: float
    lengths_after: float
    claims: int
    out: int
    in_near: float
    ms: float
    crash: str = ""


def read_windows(folder: Path) -> list[Window]:
    """All cars of the data folder."""
    windows = []
    for file in sorted(folder.glob("car*_driveout.csv")):
        with file.open(newline="") as lines:
            rows = list(csv.DictReader(lines))
        corner = np.array([[float(row["win_x"]), float(row["win_y"])] for row in rows])
        box = np.array([[float(row[key]) for key in ("gt_x", "gt_y", "gt_w", "gt_h")] for row in rows])
        visible = np.array([float(row["visible_fraction"]) for row in rows])
        windows.append(Window(file.name.partition("_")[0], corner, box, visible))
    return windows


def read_video(file: Path) -> list[Image]:
    """All frames."""
    capture = cv2.VideoCapture(str(file))
    frames: list[Image] = []
    while True:
        found, image = capture.read()
        if not found:
            return frames
        frames.append(np.asarray(image, np.uint8))


def cropped(image: Image, corner: Floats) -> Image:
    """The window of a frame; beyond the frame it is black."""
    width, height = SIZE
    out = np.zeros((height, width, 3), np.uint8)
    x, y = (round(float(value)) for value in corner)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + width, image.shape[1]), min(y + height, image.shape[0])
    out[top - y : bottom - y, left - x : right - x] = image[top:bottom, left:right]
    return out


def follow(window: Window, video: list[Image], tracker: Tracker, model: str) -> Result:
    """Feed one window to a tracker and score it."""
    estimates: list[Estimate] = []
    seconds, crash = 0.0, ""
    for i in range(len(window.visible)):
        image = cropped(video[i], window.corner[i])
        began = time.process_time()
        try:
            if i == 0:
                new = tracker.begin(image, 0.0, Box(*(float(value) for value in window.box[0])))
            else:
                new = tracker.handle_frame(image, i / FPS)
        except Exception as error:  # noqa: BLE001 - a crash is a figure of the bench
            crash = f"frame {i}: {type(error).__name__}: {error}"
            nan = math.nan
            estimates += [Estimate(i / FPS, State.LOST, nan, nan, nan, nan, nan, nan)] * (len(window.visible) - i)
            break
        seconds += time.process_time() - began
        estimates.append(new)
    return _scored(window, estimates, model, 1e3 * seconds / len(estimates), crash)


def _scored(window: Window, estimates: list[Estimate], model: str, ms: float, crash: str) -> Result:
    guess = np.array([(math.nan, math.nan) if e.state == State.LOST else (e.x, e.y) for e in estimates])
    error = np.hypot(*(guess - window.centre).T)
    near = np.where(np.isnan(error), np.inf, error) < _NEAR
    says = np.array([e.state == State.VISIBLE for e in estimates])
    out = window.visible == 0.0
    gone = np.flatnonzero(out)
    first_out, last_out = int(gone[0]), int(gone[-1])
    half = last_out + 1 + int(np.argmax(window.visible[last_out + 1 :] >= 0.5))
    found = next((k for k in range(half, half + _WITHIN) if near[k : k + _RUN].sum() == _RUN), None)
    after = min(first_out + round(AFTER_S * FPS), last_out)
    within = ((window.centre > -0.5) & (window.centre < np.array(SIZE) - 0.5)).all(axis=1)
    return Result(
        car=window.car,
        model=model,
        reacquired=found is not None,
        delay=math.nan if found is None else float(found - half),
        lengths_after=float(error[after] / window.length),
        claims=int((says & out).sum()),
        out=int(out.sum()),
        in_near=float(near[within].mean()),
        ms=ms,
        crash=crash,
    )


def make(model: str) -> Tracker:
    """A tracker that knows nothing of the camera."""
    if model in uav_rivals.NAMES:
        return uav_rivals.Rival(model)
    from edge.uav import models

    return models.get(model, SIZE, fps=FPS)


def main() -> None:
    """Follow and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA)
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    folder = arguments.data / FOLDER
    if not (folder / VIDEO).exists():
        print(f"skipped: {folder / VIDEO} is absent")
        return
    cv2.setNumThreads(1)
    wanted = [name for name in arguments.models.split(",") if name]
    absent = [name for name in wanted if name in uav_rivals.NAMES and not uav_rivals.available(name)]
    video = read_video(folder / VIDEO)
    results = [
        follow(window, video, make(model), model)
        for model in wanted
        if model not in absent
        for window in read_windows(folder)
    ]
    if arguments.json:
        print(json.dumps([asdict(result) for result in results], indent=1))
        return
    if absent:
        print(f"{', '.join(absent)} left out: uav_rivals.py says how to get them")
    print(
        f"car    model   back  delay  lengths off at {AFTER_S} s  claims visible while out  in frame < 20 px  ms/frame"
    )
    for r in results:
        print(
            f"{r.car:6s} {r.model:7s} {'yes' if r.reacquired else 'no':4s} {r.delay:6.0f}  {r.lengths_after:20.2f}  "
            f"{f'{r.claims} of {r.out}':>24s}  {100 * r.in_near:14.1f} %  {r.ms:8.1f}  {r.crash}"
        )
    for model in dict.fromkeys(r.model for r in results):
        mine = [r for r in results if r.model == model]
        print(
            f"{model}: re-acquired {sum(r.reacquired for r in mine)} of {len(mine)}; "
            f"claims visible {sum(r.claims for r in mine)} of {sum(r.out for r in mine)} frames out"
        )


if __name__ == "__main__":
    main()
