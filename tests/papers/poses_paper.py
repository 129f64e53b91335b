"""Reproduction of section 4 of the distributed pose paper: figure 7, and how often to update.

``python -m tests.papers.poses_paper [--seeds N] [--out DIR]`` prints the error against the number of points for the
paper's method (corrected) and for the pose nodes beside the joint optimum and the paper's figures, then the result for
the paper's open question (section 3.3), how often to update; it writes figure 7 as PNG. About a minute on one core.

Deviations: the paper prints neither its noise, its cameras nor its constants. Here: 1 px; size with 5 % and u = 1.1,
or 2 % and u = 1; cameras 250 to 350 cm from the middle of the cube; initial poses 50 cm and 0.3 rad off (std). u counts
updates.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np

from hub.baselines.recursive_poses import RecursivePoseNode, RecursivePoseSettings
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from tests.bench.pose_runs import feed, network
from tests.bench.pose_worlds import Sightings, SimulatedRig, cube, errors, joint_optimum, observe, section_4

REPOSITORY = Path(__file__).resolve().parents[2]
DEFAULT_OUT = REPOSITORY / "out" / "poses_paper"
PRINTED = (7.35, 0.85)
"""The paper's final errors: position [cm], attitude [deg]."""
MARKS = (100, 200, 500, 1000, 2000, 5000, 10_000)
CASES = {"2 %, u = 1": (0.02, 1.0), "5 %, u = 1.1": (0.05, 1.1)}
EVERY = {"each event": 1, "every 10": 10, "every second (30 Hz)": 30}


def made(seed: int, size: float, points: int = MARKS[-1]) -> tuple[SimulatedRig, Sightings, np.random.Generator]:
    """The world of section 4 and its observations."""
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    return world, observe(world, rng, cube(rng, points), size=size), rng


def paper_run(
    seed: int, size: float, forget: float, every: int, marks: tuple[int, ...] = MARKS
) -> list[tuple[float, float]]:
    """Errors [cm], [deg] of the paper's method at each mark, updating after every ``every`` points."""
    world, sightings, rng = made(seed, size, marks[-1])
    settings = RecursivePoseSettings(forget=forget)
    nodes = []
    for k, pose in enumerate(world.poses):
        turn = so3.exp(0.3 * rng.standard_normal(3)) if k else np.eye(3)
        shift = 50.0 * rng.standard_normal(3) if k > 1 else np.zeros(3)
        start = Pose(turn @ pose.rotation, pose.position + shift)
        nodes.append(RecursivePoseNode(start, position_known=k < 2, attitude_known=k == 0, settings=settings))
    out: list[tuple[float, float]] = []
    fresh: dict[int, set[int]] = {}
    for i, (a, b) in enumerate(sightings.cameras.tolist()):
        nodes[a].observe(b, sightings.seen[i, 0], sightings.seen[i, 1])
        nodes[b].observe(a, sightings.seen[i, 1], sightings.seen[i, 0])
        fresh.setdefault(a, set()).add(b)
        fresh.setdefault(b, set()).add(a)
        if (i + 1) % every == 0:
            poses = {k: (node.pose, node.covariance) for k, node in enumerate(nodes)}
            for k, others in fresh.items():
                nodes[k].update(poses, sorted(others))
            fresh.clear()
        if i + 1 in marks:
            out.append(errors(world, [node.pose for node in nodes]))
    return out


def node_run(seed: int, size: float, every: int, marks: tuple[int, ...] = MARKS) -> list[tuple[float, float]]:
    """Errors of the pose nodes at each mark; nan before every camera has joined."""
    world, sightings, _ = made(seed, size, marks[-1])
    net = network(world, None, seed)
    out, last = [], 0
    for mark in marks:
        feed(net, sightings, every, last, mark)
        last = mark
        out.append(errors(world, net.world_poses()))
    return out


def joint_run(seed: int, size: float, marks: tuple[int, ...] = MARKS) -> list[tuple[float, float]]:
    """Errors of the joint optimum at each mark."""
    world, sightings, _ = made(seed, size, marks[-1])
    return [errors(world, joint_optimum(world, sightings.first(mark)).poses) for mark in marks]


def table(seeds: range) -> dict[str, np.ndarray]:
    """Mean errors (marks, 2) over the seeds by method."""
    out = {}
    for case, (size, forget) in CASES.items():
        out[f"paper's, {case}"] = np.mean([paper_run(s, size, forget, 10) for s in seeds], axis=0)
        out[f"nodes, {case[:3]}"] = np.mean([node_run(s, size, 10) for s in seeds], axis=0)
        out[f"joint, {case[:3]}"] = np.mean([joint_run(s, size) for s in seeds], axis=0)
    return out


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Figure 7."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, column, unit in zip(axes, (0, 1), ("position error [cm]", "attitude error [deg]"), strict=True):
        for name, values in results.items():
            style = {"p": "o-", "n": "s-", "j": "k:"}[name[0]]
            axis.loglog(MARKS, values[:, column], style, markersize=4, linewidth=1.2, label=name)
        axis.axhline(PRINTED[column], color="grey", linestyle="--", linewidth=1, label="paper, 10,000 points")
        axis.set_xlabel("points")
        axis.set_ylabel(unit)
        axis.grid(alpha=0.3, which="both")
    axes[0].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Prints both tables and writes the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT)
    chosen = parser.parse_args()
    seeds = range(1000, 1000 + chosen.seeds)
    results = table(seeds)
    print(f"Section 4, mean of {len(seeds)} seeds, position cm / attitude deg, an update every 10 points")
    print(f"{'points':24}" + "".join(f"{mark:>16}" for mark in MARKS))
    for name, values in results.items():
        print(f"{name:24}" + "".join(f"{cm:>9.3f} / {deg:5.3f}" for cm, deg in values))
    print(f"{'the paper':24}{'':>96}{PRINTED[0]:>9} / {PRINTED[1]}")
    print("\nHow often to update, after 10,000 points")
    print(f"{'':24}" + "".join(f"{name:>24}" for name in EVERY))
    last = (MARKS[-1],)
    for case, (size, forget) in CASES.items():
        means = [np.mean([paper_run(s, size, forget, n, last)[0] for s in seeds], axis=0) for n in EVERY.values()]
        print(f"paper's, {case:15}" + "".join(f"{cm:>16.3f} / {deg:5.3f}" for cm, deg in means))
    means = [np.mean([node_run(s, 0.02, n, last)[0] for s in seeds[:1]], axis=0) for n in EVERY.values()]
    print(f"{'nodes, 2 %, one seed':24}" + "".join(f"{cm:>16.3f} / {deg:5.3f}" for cm, deg in means))
    draw(results, chosen.out / "figure_7.png")
    print(f"\nwrote {chosen.out / 'figure_7.png'}")


if __name__ == "__main__":
    main()
