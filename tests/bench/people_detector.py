"""The person detector on rendered rooms with ground truth, compared with the plain background model.

    python -m tests.bench.people_detector [--seeds 3] [--first-seed 700] [--seconds 30] [--people 5] [--network N]
    python -m tests.bench.people_detector --labels LABELS.csv --detections PEOPLE.csv

Precision and recall at an overlap (intersection over union) of 0.5, as in pedestrian benchmarks: people less than half
visible and people truncated by the image border are ignored. file: two passes, as in `syncline detect person`; live:
one pass from the first frame on; MOG2 alone: its silhouettes without further processing; with --network that one alone,
image by image. Noise 4, shadows on. CPU milliseconds per frame. Also the squared error of the representative point over
its covariance, across and down, of isolated people and of people in groups, against that point of the visible part of
the true silhouette; of a network the distances of head and foot point from the truth.

The second form evaluates the output of `syncline detect person VIDEO --out PEOPLE.csv` on a video of your own, in the
frames that have boxes in LABELS.csv: frame,x,y,w,h,ignore (1 = ignored).
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edge import scenes
from edge.detectors.base import Detection
from edge.detectors.people.person import PersonDetector, silhouette_features
from edge.detectors.plugins import load_detector
from edge.scenes.people.renderer import PeopleRenderer
from edge.scenes.people.scene import PeopleScene
from protocols.geometry.types import Bools, Floats, Image
from tests.support.people_boxes import overlap, score_boxes, truth

_BAR = 0.9
_NOISE = 4.0


def render_video(
    seed: int, people: int, seconds: float
) -> tuple[list[Image], list[tuple[Floats, Bools]], list[Floats], float]:
    """Rendered frames, their ground truth, the representative points (n, 2) of evaluated people, and the frame rate;
    camera 0 of a room.
    """
    scene: PeopleScene = scenes.get_people_scene(seed, None, people)
    camera = scene.cameras[0]
    renderer = PeopleRenderer(scene, camera.name, np.random.default_rng([seed, 1]), _NOISE)
    images, boxes, middles = [], [], []
    for index in range(int(seconds * camera.fps)):
        image, owners = renderer.render_with_owners(index / camera.fps)
        images.append(image)
        boxes.append(truth(scene, camera.name, index / camera.fps, owners))
        who = np.flatnonzero(np.isfinite(scene.boxes(camera.name, index / camera.fps)).all(axis=1))
        points = np.full((len(who), 2), np.nan)
        for row, (one, box) in enumerate(zip(who, boxes[-1][0], strict=True)):
            if boxes[-1][1][row]:
                mask = np.where(owners == one + 1, 255, 0).astype(np.uint8)
                points[row] = silhouette_features(mask, tuple(box)).middle
        middles.append(points)
    return images, boxes, middles, camera.fps


def from_file(images: list[Image], fps: float) -> tuple[list[list[Detection]], float]:
    """People in each frame of a video by the two-pass detector, and CPU ms per frame of the second pass."""
    detector = PersonDetector("mog2", fps, confirmed_only=False)
    detector.initialise(images[:: max(len(images) // 48, 1)])
    for index, image in enumerate(images[:400]):
        detector.detect(image, index / fps)
    detector.rewind()
    begun = time.process_time()
    seen = [detector.detect(image, index / fps) for index, image in enumerate(images)]
    spent = 1e3 * (time.process_time() - begun) / len(images)
    return [[one for one in shown if detector.is_confirmed(one.label)] for shown in seen], spent


def errors(boxes: tuple[Floats, Bools], middles: Floats, shown: list[Detection]) -> list[tuple[bool, float, float]]:
    """Of each evaluated and detected person: whether it was isolated, squared errors over variances, u and v."""
    found = []
    for box, counts, middle in zip(*boxes, middles, strict=True):
        near = [one for one in shown if one.box is not None and overlap(box, one.box) >= 0.5]
        if not counts or not near:
            continue
        one = max(near, key=lambda each: overlap(box, each.box or (0.0, 0.0, 0.0, 0.0)))
        assert one.covariance is not None
        u, v = (one.u - middle[0]) ** 2 / one.covariance[0], (one.v - middle[1]) ** 2 / one.covariance[2]
        found.append((one.score > 0.9, float(u), float(v)))
    return found


def live(images: list[Image], fps: float) -> tuple[list[list[Detection]], float]:
    """The same of a camera that has just been switched on."""
    detector = PersonDetector("mog2", fps)
    begun = time.process_time()
    seen = [detector.detect(image, index / fps) for index, image in enumerate(images)]
    spent = 1e3 * (time.process_time() - begun) / len(images)
    return seen, spent


def by_network(file: Path, images: list[Image], fps: float) -> tuple[list[list[Detection]], float]:
    """People by a network, and CPU ms per frame."""
    detector = load_detector(file, kind="person", fps=fps)
    begun = time.process_time()
    seen = [detector.detect(image, index / fps) for index, image in enumerate(images)]
    return seen, 1e3 * (time.process_time() - begun) / len(images)


def end_errors(
    seed: int, people: int, fps: float, boxes: list[tuple[Floats, Bools]], found: list[list[Detection]]
) -> list[list[float]]:
    """Of each evaluated person whose head and foot were detected: their distances from the truth over the size."""
    scene: PeopleScene = scenes.get_people_scene(seed, None, people)
    camera, times = scene.cameras[0].name, np.arange(len(boxes)) / fps
    heads, feet = (scene.seen_by(camera, points) for points in (scene.heads(times), scene.feet(times)))
    errors = []
    for index, ((true, counts), shown) in enumerate(zip(boxes, found, strict=True)):
        who = np.flatnonzero(np.isfinite(scene.boxes(camera, float(times[index]))).all(axis=1))
        for person, box in zip(who[counts], true[counts], strict=True):
            near = max(shown, key=lambda one: overlap(box, one.box or (0.0, 0.0, 0.0, 0.0)), default=None)
            if (
                near is None
                or near.box is None
                or near.head is None
                or near.foot is None
                or overlap(box, near.box) < 0.5
            ):
                continue
            ends = (near.head - heads[index, person], near.foot - feet[index, person])
            errors.append([float(np.hypot(*end)) / near.size for end in ends])
    return errors


def plain(images: list[Image], fps: float) -> tuple[list[list[Floats]], float]:
    """MOG2 with its own shadow test, initialised from the same images; every silhouette of some size is a person."""
    model = cv2.createBackgroundSubtractorMOG2(500, 16.0, True)
    for image in images[:: max(len(images) // 48, 1)]:
        model.apply(image, learningRate=0.03)
    begun, found = time.process_time(), []
    for image in images:
        foreground = cv2.medianBlur((model.apply(image) == 255).astype(np.uint8), 5)
        _, _, stats, _ = cv2.connectedComponentsWithStats(foreground)
        found.append([row[:4].astype(np.float64) for row in stats[1:] if row[4] > 400])
    return found, 1e3 * (time.process_time() - begun) / len(images)


def read_boxes(file: Path, prefix: str = "") -> dict[int, tuple[Floats, Bools]]:
    """By frame, boxes (n, 4) x, y, w, h of a table, and which are evaluated (n,)."""
    rows: dict[int, list[list[float]]] = {}
    with file.open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            box = [float(row[prefix + side]) for side in "xywh"]
            rows.setdefault(int(row["frame"]), []).append([*box, float(row.get("ignore") or 0)])
    out = {}
    for frame, boxes in rows.items():
        table = np.array(boxes)
        out[frame] = (table[:, :4], table[:, 4] == 0.0)
    return out


def evaluate_video(labels: Path, detections: Path) -> int:
    """Compare detections in a video with its labels; prints the result, and returns the exit status."""
    true, found = read_boxes(labels), read_boxes(detections, "box_")
    total: list[tuple[int, int, int, float]] = []
    for frame, (boxes, counts) in true.items():
        shown = list(found[frame][0]) if frame in found else []
        total.append(score_boxes(boxes, counts, shown))
    right, wrong, missed = (sum(int(one[part]) for one in total) for part in range(3))
    precision, recall = right / max(right + wrong, 1), right / max(right + missed, 1)
    print(f"{len(true)} frames, {right + missed} people: precision {precision:.3f}, recall {recall:.3f}")
    return int(min(precision, recall) < _BAR)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=700)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--people", type=int, default=5)
    parser.add_argument("--network", type=Path, help="the .toml file of an ONNX network to measure in their place")
    parser.add_argument("--labels", type=Path, help="boxes of people in some frames of a video")
    parser.add_argument("--detections", type=Path, help="output of `syncline detect person` for it")
    options = parser.parse_args()
    if (options.labels is None) != (options.detections is None):
        parser.error("--labels and --detections belong together")
    if options.labels is not None:
        return evaluate_video(options.labels, options.detections)
    cv2.setNumThreads(1)
    methods: dict[str, Callable[..., Any]] = {"file": from_file, "live": live, "MOG2 alone": plain}
    if options.network is not None:
        methods = {"network": partial(by_network, options.network)}
    rows: dict[str, list[tuple[int, int, int, float, float]]] = {name: [] for name in methods}
    spread: list[tuple[bool, float, float]] = []
    ends: list[list[float]] = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        images, boxes, middles, fps = render_video(seed, options.people, options.seconds)
        for name, method in methods.items():
            found, spent = method(images, fps)
            if name == "file":
                for true, points, shown in zip(boxes, middles, found, strict=True):
                    spread += errors(true, points, shown)
            if name == "network":
                ends += end_errors(seed, options.people, fps, boxes, found)
            boxes_found = [[np.array(getattr(one, "box", one)) for one in shown] for shown in found]
            total = [score_boxes(*true, shown) for true, shown in zip(boxes, boxes_found, strict=True)]
            right, wrong, missed = (sum(int(one[part]) for one in total) for part in range(3))
            rows[name].append((right, wrong, missed, sum(one[3] for one in total), spent))
    print(f"seeds {options.first_seed} to {options.first_seed + options.seeds - 1}, {options.people} people")
    print("| | precision | recall | mean overlap | CPU ms a frame |\n|---|---|---|---|---|")
    short = False
    for name, all_seeds in rows.items():
        right, wrong, missed = (sum(int(one[part]) for one in all_seeds) for part in range(3))
        precision, recall = right / max(right + wrong, 1), right / max(right + missed, 1)
        overlap = sum(one[3] for one in all_seeds) / max(right, 1)
        spent = float(np.mean([one[4] for one in all_seeds]))
        print(f"| {name} | {precision:.3f} | {recall:.3f} | {overlap:.3f} | {spent:.1f} |")
        short |= name in ("file", "network") and min(precision, recall) < _BAR
    for alone in () if options.network is not None else (True, False):
        u, v = np.array([one[1:] for one in spread if one[0] is alone]).reshape(-1, 2).mean(axis=0)
        print(f"error²/covariance in files, {'alone' if alone else 'among others'}: {u:.2f} across, {v:.2f} down")
    if options.network is not None:
        head, foot = np.median(np.array(ends), axis=0)
        print(f"median error of the network over the size: head {head:.3f}, foot point {foot:.3f} ({len(ends)} people)")
    if short:
        print(f"missed: precision and recall of {_BAR}")
    return int(short)


if __name__ == "__main__":
    raise SystemExit(main())
