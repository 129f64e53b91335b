"""People counted in rendered clips of 1 to 3 s: one walker in a street, by kind of difficulty.

    python -m tests.bench.people_clips [--seeds 8] [--first-seed 1] [--only TEXT]

Size (320 to 1280 px), rate (12 to 60 Hz), duration, view, clothes and street are drawn from the seed. file: two passes,
as in `syncline detect person`; live: one pass from the first frame on. counted: different people reported in a clip,
mean and most; precision and recall as in ``people_detector``; refused: clips in which the camera moves for so long that
the command refuses them, which count no people. CPU milliseconds per frame, of both passes.
"""

from __future__ import annotations

import time

import cv2
import numpy as np

from edge.detectors.base import Detection
from edge.detectors.people.person import PersonDetector
from edge.offline.moving import MAX_MOVING_SHARE
from tests.bench.options import bench_parser
from tests.support.people_boxes import score_boxes
from tests.support.street import KINDS, StreetClip, street_clip


def people_of(clip: StreetClip, *, twice: bool) -> list[list[Detection]] | None:
    """People in each frame; None where the command refuses the clip. twice: learn from the clip before."""
    detector = PersonDetector("mog2", clip.fps, confirmed_only=not twice)
    if twice:
        detector.initialise(clip.images[:: max(len(clip.images) // 48, 1)])
        for index, image in enumerate(clip.images[:400]):
            detector.detect(image, index / clip.fps)
        if detector.moving_share > MAX_MOVING_SHARE:
            return None
        detector.rewind()
    seen = [detector.detect(image, index / clip.fps) for index, image in enumerate(clip.images)]
    return [[one for one in shown if detector.is_confirmed(one.label)] for shown in seen] if twice else seen


def main() -> int:
    options = bench_parser(__doc__, seeds=8, first_seed=1, only=("", "kinds whose name contains this")).parse_args()
    cv2.setNumThreads(1)
    print("| clip | people | | counted, mean (most) | precision | recall | refused | CPU ms a frame |")
    print("|---|---|---|---|---|---|---|---|")
    for number, (name, kind) in enumerate(KINDS.items()):
        if options.only not in name:
            continue
        seeds = range(options.first_seed, options.first_seed + options.seeds)
        clips = [street_clip(kind, 100 * number + seed) for seed in seeds]
        for twice in (True, False):
            counted, total, refused, spent = [], np.zeros(4), 0, 0.0
            for clip in clips:
                begun = time.process_time()
                found = people_of(clip, twice=twice)
                spent += 1e3 * (time.process_time() - begun) / len(clip.images) / len(clips)
                if found is None:
                    refused += 1
                    continue
                counted.append(len({one.label for shown in found for one in shown}))
                for true, shown in zip(clip.boxes, found, strict=True):
                    total += score_boxes(*true, [np.array(one.box) for one in shown])
            right, wrong, missed, _ = total
            numbers = f"{np.mean(counted):.1f} ({max(counted)})" if counted else "–"
            shares = [f"{right / (right + other):.3f}" if right + other else "–" for other in (wrong, missed)]
            print(
                f"| {name} | {kind.people} | {'file' if twice else 'live'} | {numbers} | {shares[0]} | {shares[1]} | "
                f"{refused} of {len(clips)} | {spent:.1f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
