"""A street of cameras, each of which overlaps some ten others: ``python -m tests.bench.street [--cameras 60]``.

Prints the pairs that are chosen and solved, the cameras that are placed, and CPU seconds on one core: of the pairs, of
all until the final adjustment is done, and of the whole calibration.
"""

from __future__ import annotations

import argparse
import sys
import time

from hub.calibration.pipeline import calibrate
from tests.support.long_street import street


def main() -> int:
    """Simulate, calibrate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    rig, observations, arrivals, _ = street(options.seed, cameras=options.cameras, seconds=options.seconds)
    began, marks = time.process_time(), {}

    def report(text: str, share: float) -> None:
        marks[text.split()[0]] = time.process_time() - began

    found = calibrate(rig, observations, report, arrivals=arrivals)
    print(
        f"{options.cameras} cameras, {options.seconds:g} s: {len(found.pairs)} pairs; "
        f"{len(found.cameras)} placed, {len(found.refused)} refused; CPU {marks['placing']:.1f} s until placed, "
        f"{marks['covariances']:.1f} s adjusted, {time.process_time() - began:.1f} s in all"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
