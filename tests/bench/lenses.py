"""Lens self-calibration from the common path: accuracy over random rigs.

    python -m tests.bench.lenses [--sessions 12] [--cameras 4] [--start 50]

Sessions of 30 s, 0.5 px, no lens known (``tests/support/rigs.py``: 53° to 67°, principal points 8 px (std) from the
middle, k1, k2, p1, p2, fy 0.2 % off fx). ``z``: the error over its std, 1 (rms) if the stds are right.
"""

from __future__ import annotations

import sys

import numpy as np

from hub.calibration.pipeline import calibrate
from protocols.core.errors import Refused
from tests.bench.options import bench_parser
from tests.support.rigs import simulate


def main() -> int:
    given = bench_parser(__doc__, sessions=12, cameras=4, start=50).parse_args()
    errors: list[float] = []
    ratios: list[float] = []
    refused = 0
    for seed in range(given.start, given.start + given.sessions):
        session = simulate(seed, given.cameras, 30.0)
        lenses = {name: camera.intrinsics for name, camera in session.rig.cameras.items()}
        try:
            found = calibrate(session.without_lenses().rig, session.observations())
        except Refused as refusal:
            print(f"{seed}: refused: {refusal.reason}")
            refused += given.cameras
            continue
        refused += len(found.refused)
        for name, camera in found.cameras.items():
            lens = lenses[name]
            if lens is not None:
                errors.append(camera.intrinsics.focal / lens.focal - 1.0)
                ratios.append(errors[-1] / camera.focal_std)
    if not errors:
        return 1
    relative, z = 100 * np.abs(errors), np.abs(ratios)
    print(
        f"{len(errors)} focal lengths: rms error {np.sqrt(np.mean(relative**2)):.2f} %, worst {relative.max():.2f} %; "
        f"z {np.sqrt(np.mean(z**2)):.2f} (rms), worst {z.max():.1f}; refused {refused}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
