"""Any target in any view: cars, boats, bicycles and people in oblique video, also while the camera looks away.

    python -m tests.bench.uav_any_view [--models ground,csrt,kcf,mosse] [--seeds 1] [--kinds oblique]
        [--first-seed 0] [--ranges 1,2.5,4] [--screens 0] [--covered] [--group] [--first-start 0] [--mirrored 0.6]
        [--varied all] [--light dusk] [--changed bars] [--every 1] [--copies 1] [--stabilisation] [--json]

Rendered oblique flights with truth, and where the data folder has them real ones: whole sequences, and windows that pan
away from the target for 0.5 to 4 s and come back. No lens, no telemetry.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from edge.uav import tracker_factory
from edge.uav.base import Box, Estimate, Tracker, TrackState
from edge.uav.image_motion.scene_motion import SceneMotion
from protocols.geometry.types import Floats, Image
from tests.bench import uav_rivals
from tests.bench.real_rigs import DEFAULT_DATA
from tests.bench.uav_sequences import (
    AWAY_S,
    Sequence,
    aerial,
    barred,
    beneath_reticle,
    mirrored,
    oblique,
    pan_away,
    share_inside,
    varied,
    zoomed,
)
from tests.support.oblique.world import FLIGHTS, TARGETS, ObliqueWorld

MODELS = ("ground", *uav_rivals.NAMES)
CHANGES = {"none": lambda sequence: sequence, "bars": barred, "zoom": zoomed, "reticle": beneath_reticle}
NEAR_PX, HELD_FRAMES = 20.0, 20
_RATES = (10.0, 15.0, 30.0)
_COVERED = (0.4, 0.85)  # share of a target that is seen in a first box that shows a screen before it
_LEAST_PX = 4.0  # side of a target that the trackers take


@dataclass(slots=True)
class Score:
    """Counts of one sequence and one tracker.

    near, frames: frames in view (at least half) within max(20 px, half a box), of all. overlap: mean intersection over
    union in view; success: area under the success plot, the share of these frames above each of 21 overlaps from 0 to
    1. away_near, claimed, away: frames without any part of the target: within two box lengths, reported visible, all.
    held: visible and near in all of the last 20 frames, 10 of nadir windows at 15 fps. ms: CPU per frame.
    """

    kind: str
    name: str
    model: str
    near: int
    frames: int
    overlap: float
    success: float
    away_near: int
    claimed: int
    away: int
    held: bool
    ms: float


def score(sequence: Sequence, estimates: list[Estimate], model: str, ms: float) -> Score:
    """Compare the estimates with the boxes of all frames."""
    box = sequence.box
    centre = box[:, :2] + 0.5 * (box[:, 2:] - 1.0)
    nan = float("nan")
    guess = np.array([(nan, nan) if e.state is TrackState.LOST else (e.x, e.y) for e in estimates])
    error = np.nan_to_num(np.hypot(*(guess - centre).T), nan=np.inf)
    length = box[:, 2:].max(axis=1)
    near = error < np.maximum(NEAR_PX, 0.5 * length)
    visible = np.array([e.state is TrackState.VISIBLE for e in estimates])
    seen, away = sequence.visible >= 0.5, sequence.visible == 0.0
    overlap = _overlap(box, estimates)
    last = round(HELD_FRAMES * (sequence.fps / 30.0 if sequence.kind == "nadir away" else 1.0))
    return Score(
        sequence.kind,
        sequence.name,
        model,
        int((near & seen).sum()),
        int(seen.sum()),
        float(overlap[seen].mean()),
        float((overlap[seen][:, None] > np.linspace(0.0, 1.0, 21)).mean()),
        int((away & (error < 2.0 * length)).sum()),
        int((away & visible).sum()),
        int(away.sum()),
        bool((visible & near)[-last:].all()),
        ms,
    )


def _overlap(box: Floats, estimates: list[Estimate]) -> Floats:
    """Intersection over union (n,)."""
    own = np.array([(e.x - 0.5 * (e.width - 1), e.y - 0.5 * (e.height - 1), e.width, e.height) for e in estimates])
    low = np.maximum(box[:, :2], own[:, :2])
    high = np.minimum(box[:, :2] + box[:, 2:], own[:, :2] + own[:, 2:])
    both = np.prod(np.clip(high - low, 0.0, None), axis=1)
    return np.nan_to_num(both / (np.prod(box[:, 2:], axis=1) + np.prod(own[:, 2:], axis=1) - both))


def run(sequence: Sequence, model: str) -> Score:
    """Track one sequence."""
    tracker: Tracker
    if model in uav_rivals.NAMES:
        tracker = uav_rivals.OpenCvTracker(model)
    else:
        tracker = tracker_factory.make_tracker(model, sequence.size, fps=sequence.fps)
    estimates: list[Estimate] = []
    began = time.process_time()
    for k, image in enumerate(sequence.images):
        if k == 0:
            estimates.append(tracker.begin(image, 0.0, Box(*(float(value) for value in sequence.box[0]))))
        else:
            estimates.append(tracker.handle_frame(image, k / sequence.fps))
    return score(sequence, estimates, model, 1e3 * (time.process_time() - began) / len(estimates))


def flight(
    target: str,
    path: str,
    seed: int,
    rate: float,
    away_s: float,
    frames: int | None = None,
    range_factor: float = 1.0,
    screens: int = 0,
    covered: bool = False,
    group: bool = False,
) -> Sequence:
    """One rendered flight as a sequence; see ``ObliqueWorld``. covered: marked as it goes behind a screen."""
    seconds = 2.5 + 1.2 + away_s + 2.5 if path == "away" else 8.0
    count = round(seconds * rate) if frames is None else frames
    far = range_factor
    world = ObliqueWorld(
        target, path, seed, (640, 360), rate, count, away_s, range_factor=far, screens=screens, group=group
    )
    pairs = [world.rendered(i) for i in range(count)]
    box = np.array([(t.box.x, t.box.y, t.box.width, t.box.height) for _, t in pairs])
    visible = np.array([t.visible for _, t in pairs])
    first = int(np.argmax(visible >= 0.99))  # nobody can mark a target that is behind a house
    if covered:
        whole, goes = share_inside(box, (640, 360)) > 0.99, np.append(visible[1:], 1.0) <= visible
        first = int(np.argmax((visible > _COVERED[0]) & (visible < _COVERED[1]) & whole & goes))
    kind = "rendered away" if path == "away" else "rendered"
    images = [image for image, _ in pairs[first:]]
    return Sequence(f"{target} {path} {seed}", kind, images, box[first:], rate, visible[first:])


def rendered(
    seeds: range, ranges: list[float], kinds: list[str], screens: int = 0, covered: bool = False, group: bool = False
) -> Iterator[Sequence]:
    """Rendered flights: every target, every flight, at 10 to 30 frames a second, the factors of the range in turn."""
    paths = [path for path in FLIGHTS if not kinds or ("rendered away" if path == "away" else "rendered") in kinds]
    for seed in seeds:
        for k, target in enumerate(TARGETS):
            for path in paths if not group or target in ("bicycle", "person") else ():
                rate, away_s, factor = (of[(seed + k) % len(of)] for of in (_RATES, AWAY_S, ranges))
                sequence = flight(target, path, 10 * seed + k, rate, away_s, None, factor, screens, covered, group)
                least, most = _COVERED if covered else (0.99, 2.0)
                # One that is behind a house all the time cannot be marked: its first box shows the house.
                if sequence.box[0, 2:].min() >= _LEAST_PX and least <= sequence.visible[0] < most:
                    yield sequence


def real(data: Path, windows: bool = True, first: int = 0, factor: float | None = None) -> Iterator[Sequence]:
    """Sequences of the data folder, and windows in them that pan away.

    first: start of the first window in each oblique one [frames]. factor: by which these are reduced, and mirrored.
    """
    if (data / "oblique").is_dir():
        yield from oblique(data / "oblique")
    if (data / "oblique").is_dir() and windows:
        size = (640, 360) if factor is None else (round(640 * factor), round(360 * factor))
        for whole in oblique(data / "oblique", None, 10**6):
            whole = whole if factor is None else mirrored(whole, factor)
            for k, away in enumerate(AWAY_S):
                for start in range(first, len(whole.images), 60):
                    window = pan_away(whole, away, size, 2.0, k + start, start)
                    if window is not None and window.box[0, 2:].min() >= _LEAST_PX:
                        yield window
    if (data / "aerial-traffic").is_dir() and windows:
        for whole in aerial(data / "aerial-traffic"):
            window = pan_away(whole, 0.5, (480, 270), 0.6, 0)
            if window is not None:
                yield window


def stabilised(sequence: Sequence) -> Floats:
    """Distances (n,) [px] of corners off the target from where the chained image motion has them after a second.

    The corners are tracked on their own at full resolution; those that move with traffic are among them.
    """
    motion = SceneMotion(sequence.size)
    grays = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in sequence.images]
    steps = []
    for k, image in enumerate(sequence.images):
        x, y, width, height = sequence.box[max(k - 1, 0)]
        steps.append(motion.update(image, np.array([x, y, x + width, y + height])))
    found, second = [], round(sequence.fps)
    for start in range(0, len(grays) - second, second):
        mask = np.full(grays[start].shape, 255, np.uint8)
        x0, y0, width, height = sequence.box[start].astype(int)
        mask[max(y0 - 5, 0) : max(y0 + height + 5, 0), max(x0 - 5, 0) : max(x0 + width + 5, 0)] = 0
        corners = cv2.goodFeaturesToTrack(grays[start], 60, 0.01, 15, mask=mask)
        if corners is None:
            continue
        tracked, kept = corners, np.ones(len(corners), bool)
        chained = corners.reshape(-1, 2).astype(np.float64)
        for k in range(start + 1, start + second + 1):
            moved, ok, _ = cv2.calcOpticalFlowPyrLK(grays[k - 1], grays[k], tracked, None)
            back, _, _ = cv2.calcOpticalFlowPyrLK(grays[k], grays[k - 1], moved, None)
            kept &= (ok.ravel() == 1) & (np.abs(back - tracked).reshape(-1, 2).max(axis=1) < 0.5)
            tracked, chained = moved, np.array([steps[k].at(point, motion.reach) for point in chained])
        found.append(np.hypot(*(tracked.reshape(-1, 2) - chained)[kept].T))
    return np.concatenate(found)


def in_light(image: Image, light: str, k: int) -> Image:
    """Image ``k`` at dusk, in haze (both with noise) or in light that flickers by a quarter."""
    gain, level, noise = {"dusk": (0.25, 0.0, 3.0), "haze": (0.3, 140.0, 2.0), "flicker": (1.0, 0.0, 0.0)}[light]
    gain *= 1.0 + 0.25 * np.sin(1.3 * k) if light == "flicker" else 1.0
    grain = noise * np.random.default_rng(k).normal(size=image.shape)
    return np.asarray(np.clip(gain * image + level + grain, 0, 255), np.uint8)


def grained(sequence: Sequence, copy: int) -> Sequence:
    """A copy with up to a grey level of noise, 0 = none: what rests on chance comes out otherwise."""
    if not copy:
        return sequence
    rng = np.random.default_rng(copy)
    grain = (rng.integers(-1, 2, image.shape) for image in sequence.images)
    images = [np.asarray(np.clip(i + g, 0, 255), np.uint8) for i, g in zip(sequence.images, grain, strict=True)]
    return replace(sequence, images=images)


def table(scores: list[Score]) -> str:
    """One line for each kind and model."""
    titles = ("in view", "overlap", "success", "away", "claimed", "held", "ms/frame")
    lines = [f"{'kind':16s}{'model':8s}" + "".join(f"{title:>9s}" for title in titles)]
    for kind, model in dict.fromkeys((s.kind, s.model) for s in scores):
        part = [s for s in scores if (s.kind, s.model) == (kind, model)]
        away = sum(s.away for s in part)
        share = f"{100 * sum(s.away_near for s in part) / away:6.1f} %" if away else "-"
        claimed = f"{100 * sum(s.claimed for s in part) / away:7.1f} %" if away else "-"
        lines.append(
            f"{kind:16s}{model:8s}{100 * sum(s.near for s in part) / sum(s.frames for s in part):7.1f} %"
            f"{np.mean([s.overlap for s in part]):9.2f}{np.mean([s.success for s in part]):9.2f}"
            f"{share:>9s}{claimed:>9s}"
            f"{f'{sum(s.held for s in part)}/{len(part)}':>9s}{np.mean([s.ms for s in part]):9.1f}"
        )
    return "\n".join(lines)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA)
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--seeds", type=int, default=1, help="rendered flights of each kind")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--ranges", default="1", help="of rendered flights, over the usual range: 4 makes a car 12 px")
    parser.add_argument("--screens", type=int, default=0, help="trees and poles before the target, rendered flights")
    parser.add_argument("--covered", action="store_true", help="mark the target as it goes behind one of them")
    parser.add_argument("--group", action="store_true", help="bicycles and people in a group with other paint")
    parser.add_argument("--first-start", type=int, default=0, help="first frame of the first window of oblique clips")
    parser.add_argument("--mirrored", type=float, help="windows of the mirrored clips, reduced to this share: 0.6")
    parser.add_argument("--varied", choices=("even", "odd", "all"), help="only: nadir windows turned, of these cars …")
    parser.add_argument("--kinds", default="", help="only these kinds, by comma: rendered, oblique, 'oblique away' …")
    parser.add_argument("--light", default="", help="change the images: dusk, haze, flicker")
    parser.add_argument("--every", type=int, default=1, help="only every so many sequences")
    parser.add_argument(
        "--changed", choices=CHANGES, default="none", help="black bars; a zoom by 2 in one frame; a reticle"
    )
    parser.add_argument(
        "--copies", type=int, default=1, help="of each sequence, all but one with a grey level of noise"
    )
    parser.add_argument("--stabilisation", action="store_true", help="only: how well the real videos are stabilised")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.stabilisation:
        for sequence in oblique(options.data / "oblique"):
            half, most = np.percentile(stabilised(sequence), (50, 90))
            print(f"{sequence.name:10s} after 1 s: half of the corners within {half:.2f} px, 90 % within {most:.2f} px")
        return
    uav_rivals.restart_with_contrib("tests.bench.uav_any_view", options.models.split(","))
    models = [m for m in options.models.split(",") if m not in uav_rivals.NAMES or uav_rivals.available(m)]
    left_out = [m for m in options.models.split(",") if m not in models]
    kinds = [kind for kind in options.kinds.split(",") if kind]
    sources: list[Iterator[Sequence]] = []
    if options.varied:
        sources.append(varied(options.data / "aerial-traffic", options.varied))
    elif not kinds or any(kind.startswith("rendered") for kind in kinds):
        seeds = range(options.first_seed, options.first_seed + options.seeds)
        ranges = [float(factor) for factor in options.ranges.split(",")]
        sources.append(rendered(seeds, ranges, kinds, options.screens, options.covered, options.group))
    if not options.varied and (not kinds or any(not kind.startswith("rendered") for kind in kinds)):
        windows = not kinds or any("away" in kind for kind in kinds)
        sources.append(real(options.data, windows, options.first_start, options.mirrored))
    light = options.light
    scores = [
        run(replace(s, images=[in_light(i, light, k) for k, i in enumerate(s.images)]) if light else s, model)
        for source in sources
        for original in islice((one for one in source if not kinds or one.kind in kinds), 0, None, options.every)
        for copy in range(options.copies)
        for s in (CHANGES[options.changed](grained(original, copy)),)
        for model in models
    ]
    if options.json:
        print(json.dumps([asdict(s) for s in scores], indent=1))
        return
    if left_out:
        print(f"{', '.join(left_out)} left out: uav_rivals.py says how to get them")
    print(table(scores))


if __name__ == "__main__":
    main()
