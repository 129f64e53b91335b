"""Pictures of the tracker on each kind of rendered oblique scene, for the documentation.

python -m tests.figures.any_view_picture [--out docs/pictures/uav_any_view.jpg]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from deploy.offline.track import TrackedFrame, draw
from edge.uav import tracker_factory
from protocols.geometry.types import Image
from tests.support.oblique.world import ObliqueWorld

SCENES = (("car", "follow", 1, 24), ("bicycle", "orbit", 2, 24), ("boat", "zoom", 4, 24), ("person", "away", 3, 38))
"""Target, flight, seed, and the frame that is shown: the person is out of the image then."""
_WIDTH = 1400  # of the picture [px]


def picture(target: str, path: str, seed: int, frame: int) -> Image:
    """The overlay of one frame of a flight at 10 frames a second."""
    world = ObliqueWorld(target, path, seed, frames=60, fps=10.0, away_s=1.0)
    tracker = tracker_factory.make_tracker("ground", world.size, fps=world.fps)
    image, truth = world.rendered(0)
    estimate = tracker.begin(image, 0.0, truth.box)
    for i in range(1, frame + 1):
        image = world.frame(i)
        estimate = tracker.handle_frame(image, i / world.fps)
    return np.asarray(draw(image, TrackedFrame(frame, frame / world.fps, estimate)), np.uint8)


def main() -> None:
    """Draw them in two columns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/uav_any_view.jpg"))
    options = parser.parse_args()
    tiles = [picture(*scene) for scene in SCENES]
    rows = [np.hstack(tiles[k : k + 2]) for k in range(0, len(tiles), 2)]
    image = np.vstack(rows)
    size = (_WIDTH, round(image.shape[0] * _WIDTH / image.shape[1]))
    cv2.imwrite(str(options.out), cv2.resize(image, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(f"{options.out}: {', '.join(f'{target} {path}' for target, path, _, _ in SCENES)}")


if __name__ == "__main__":
    main()
