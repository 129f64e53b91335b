"""Separate points on a shared clock: the solvers of `calibrate` against a bundle adjustment with the same unknowns.

    python -m tests.bench.shared_clock [--seeds N] [--first SEED] [--points N] [--solvers joint,distributed,paper]

Section 4 of the distributed pose paper: five cameras about a cube of 150 cm, random points, each seen by two cameras,
1 px; sizes with 5 % noise, which the solver "paper" needs. The first camera's pose and the second one's position are
given without std. The optimum is `pose_worlds.joint_optimum` over the same pixels, started from the truth.
"""

from __future__ import annotations

import numpy as np

from hub.calibration.pipeline import calibrate
from protocols.geometry.camera import Intrinsics
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera
from tests.bench.options import bench_parser
from tests.bench.pose_worlds import (
    FOCAL,
    Sightings,
    SimulatedRig,
    cube,
    errors,
    joint_optimum,
    observe,
    section_4,
)

_CENTRE = np.array([639.5, 479.5])


def section_4_session(
    seed: int, points: int, size: float = np.inf
) -> tuple[SimulatedRig, Sightings, Rig, Observations]:
    """World, sightings, and the same as a session. size: relative noise of the sizes; inf = none."""
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    seen = observe(world, rng, cube(rng, points), 1.0, size)
    matrix = np.array([[FOCAL, 0.0, _CENTRE[0]], [0.0, FOCAL, _CENTRE[1]], [0.0, 0.0, 1.0]])
    lens = Intrinsics(1280, 960, matrix)
    first, second = world.poses[:2]
    cameras = {
        f"cam{i}": RigCamera(
            f"cam{i}",
            (1280, 960),
            30.0,
            lens,
            position=(first.position, second.position)[i] if i < 2 else None,
            rotation=first.rotation if i == 0 else None,
        )
        for i in range(len(world.poses))
    }
    frame = np.repeat(np.arange(len(seen.cameras)), 2)
    rows = gather_tracks(
        [f"cam{i}" for i in seen.cameras.ravel()],
        ["point"] * len(frame),
        frame,
        frame / 30.0,
        seen.seen[:, :, :2].reshape(-1, 2) * FOCAL + _CENTRE,
        np.exp(seen.seen[:, :, 2].ravel()) * FOCAL,
        order=cameras,
    )
    return world, seen, Rig(cameras, clock="shared", metadata={"units": "cm"}), rows


def main() -> None:
    """Print a line a seed and the means."""
    options = bench_parser(__doc__, seeds=100, first=0, points=2000, solvers="joint,distributed").parse_args()
    solvers = options.solvers.split(",")
    table = []
    for seed in range(options.first, options.first + options.seeds):
        size = 0.05 if "paper" in solvers else np.inf
        world, seen, rig, rows = section_4_session(seed, options.points, size)
        without_sizes = Sightings(seen.cameras, seen.seen, seen.sigma, np.inf, seen.wrong)
        line = [*errors(world, joint_optimum(world, without_sizes).poses)]
        for solver in solvers:
            found = calibrate(rig, rows, solver=solver).cameras
            line += errors(world, [found[name].pose if name in found else None for name in rig.cameras])
        table.append(line)
        print(seed, np.round(line, 3), flush=True)
    mean = np.nanmean(table, axis=0)
    print(f"mean of {len(table)} seeds, cm and degrees: optimum {mean[0]:.3f} {mean[1]:.3f}")
    for i, solver in enumerate(solvers):
        position = np.array(table)[:, 2 + 2 * i] / np.array(table)[:, 0]
        print(
            f"  {solver}: {mean[2 + 2 * i]:.3f} {mean[3 + 2 * i]:.3f}; ratio {mean[2 + 2 * i] / mean[0]:.4f}, "
            f"worst seed {np.nanmax(position):.4f}, refused {int(np.isnan(position).sum())}"
        )


if __name__ == "__main__":
    main()
