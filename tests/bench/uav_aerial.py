"""UAV tracking of real cars that drive out of view, without telemetry and intrinsics.

    python -m tests.bench.uav_aerial [--data ../shared/data] [--models ground,plain,paper,csrt,kcf] [--json]

A drone video of a crossroads (aerial-traffic in the data folder) is cropped to one window per frame, placed so that the
car itself leaves the image; after a while the window follows it. The video is not part of the project; where it is
absent, the bench says so and exits with status 0.
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

from edge.uav.base import Box, Estimate, Tracker, TrackState
from protocols.geometry.types import Floats, Image
from tests.bench import uav_rivals
from tests.bench.real_rigs import DEFAULT_DATA

MODELS = ("ground", "plain", "paper", *uav_rivals.NAMES)
SIZE = (400, 225)
FPS = 30.0
FOLDER, VIDEO = "aerial-traffic", "traffic.mp4"
AFTER_S = 0.8
"""Time after the exit at which the error is evaluated [s]."""
_NEAR_PX = 20.0
_RUN, _WITHIN = 5, 60  # consecutive frames for a re-acquisition; within so many of half visible


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

    reacquired: 20 px for 5 consecutive frames within 60 of half visible, after ``delay`` frames. lengths_after: error
    0.8 s after it has left [car lengths], nan where lost. claims: frames out that are reported ``visible``, of out.
    in_near: share of the frames with the car's centre in the window that are within 20 px. ms: CPU per frame.
    crash: the exception raised; from there on the target counts as lost.
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


def crop(image: Image, corner: Floats) -> Image:
    """The window of a frame; black beyond the frame."""
    width, height = SIZE
    out = np.zeros((height, width, 3), np.uint8)
    x, y = (round(float(value)) for value in corner)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + width, image.shape[1]), min(y + height, image.shape[0])
    out[top - y : bottom - y, left - x : right - x] = image[top:bottom, left:right]
    return out


def track(window: Window, video: list[Image], tracker: Tracker, model: str) -> Result:
    """Run a tracker on one window and score it."""
    estimates: list[Estimate] = []
    seconds, crash = 0.0, ""
    for i in range(len(window.visible)):
        image = crop(video[i], window.corner[i])
        began = time.process_time()
        try:
            if i == 0:
                new = tracker.begin(image, 0.0, Box(*(float(value) for value in window.box[0])))
            else:
                new = tracker.handle_frame(image, i / FPS)
        except Exception as error:  # noqa: BLE001 - crashes are counted by the bench
            crash = f"frame {i}: {type(error).__name__}: {error}"
            nan = math.nan
            estimates += [Estimate(i / FPS, TrackState.LOST, nan, nan, nan, nan, nan, nan)] * (len(window.visible) - i)
            break
        seconds += time.process_time() - began
        estimates.append(new)
    return _score(window, estimates, model, 1e3 * seconds / len(estimates), crash)


def _score(window: Window, estimates: list[Estimate], model: str, ms: float, crash: str) -> Result:
    guess = np.array([(math.nan, math.nan) if e.state == TrackState.LOST else (e.x, e.y) for e in estimates])
    error = np.hypot(*(guess - window.centre).T)
    near = np.where(np.isnan(error), np.inf, error) < _NEAR_PX
    visible = np.array([e.state == TrackState.VISIBLE for e in estimates])
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
        claims=int((visible & out).sum()),
        out=int(out.sum()),
        in_near=float(near[within].mean()),
        ms=ms,
        crash=crash,
    )


def make(model: str) -> Tracker:
    """A tracker without any knowledge of the camera."""
    if model in uav_rivals.NAMES:
        return uav_rivals.OpenCvTracker(model)
    from edge.uav import tracker_factory

    return tracker_factory.make_tracker(model, SIZE, fps=FPS)


def main() -> None:
    """Run and print."""
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
    uav_rivals.restart_with_contrib("tests.bench.uav_aerial", wanted)
    absent = [name for name in wanted if name in uav_rivals.NAMES and not uav_rivals.available(name)]
    video = read_video(folder / VIDEO)
    results = [
        track(window, video, make(model), model)
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
