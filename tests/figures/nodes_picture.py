"""Figure of the convergence of the pose nodes.

``python -m tests.figures.nodes_picture [FILE]``: section 4's world. After 3,000 points a sixth camera joins, after
6,000 one is bumped by 5 cm and 2°; 1 px, 2 % size, an update every 20 points.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

from protocols.geometry import so3
from protocols.geometry.pose import Pose
from tests.bench.pose_runs import feed, network
from tests.bench.pose_worlds import SimulatedRig, cube, errors, joint_optimum, observe, section_4

SEED = 1000
STEP = 100
DEFAULT = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "nodes_convergence.png"


def run() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points so far (n,), error of each camera (n, 6) [cm] and the joint optimum's mean error (m, 2) by points."""
    rng = np.random.default_rng(SEED)
    world = section_4(rng, 6)
    net = network(world, None, SEED)
    late = net.nodes.pop(5)
    poses = list(world.poses)
    turn, shift = so3.exp(np.radians(2.0) * np.array([0.6, 0.8, 0.0])), np.array([3.0, 0.0, 4.0])
    poses[3] = Pose(turn @ poses[3].rotation, poses[3].position + shift)
    at, rows, joint = [], [], []
    parts = ((SimulatedRig(world.poses[:5]), world), (world, world), (SimulatedRig(poses), SimulatedRig(poses)))
    for part, (seen_by, truth) in enumerate(parts):
        if part == 1:
            net.nodes[5] = late
        sightings = observe(seen_by, rng, cube(rng, 3000))
        for i in range(0, 3000, STEP):
            feed(net, sightings, 20, i, i + STEP)
            found = {k: node.world_pose() for k, node in net.nodes.items()}
            known = [found.get(k) for k in range(6)]
            at.append(3000 * part + i + STEP)
            rows.append(
                [
                    np.nan if pose is None else float(np.linalg.norm(pose.position - true.position))
                    for pose, true in zip(known, truth.poses, strict=True)
                ]
            )
        if part == 0:
            for n in (200, 500, 1000, 2000, 3000):
                joint.append((n, errors(seen_by, list(joint_optimum(seen_by, sightings.first(n)).poses))[0]))
    return np.array(at), np.array(rows), np.array(joint)


def main() -> None:
    """Draws it."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    at, rows, joint = run()
    figure, axis = plt.subplots(figsize=(9, 4), layout="constrained")
    for camera in range(2, 6):
        axis.semilogy(at, rows[:, camera], linewidth=1.3, label=f"camera {camera + 1}")
    axis.semilogy(joint[:, 0], joint[:, 1], "k:", marker="o", markersize=4, label="joint optimum, mean")
    for when, text in ((3000, "camera 6 joins"), (6000, "camera 4 bumped by 5 cm, 2°")):
        axis.axvline(when, color="grey", linewidth=0.8)
        axis.annotate(text, (when, 20.0), xytext=(4, 0), textcoords="offset points", fontsize=8)
    axis.set_xlabel("points, each seen by two cameras")
    axis.set_ylabel("position error [cm]")
    axis.set_ylim(0.05, 50.0)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
    figure.savefig(out, dpi=110)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
