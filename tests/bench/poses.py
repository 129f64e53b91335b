"""Accuracy of the pose nodes relative to the joint optimum over the same observations: table of distributed poses.

    python -m tests.bench.poses [--seeds N] [--first SEED] [--quick] [--rows section4,bearings,...]

Ratio: mean position error of all cameras over that of the joint optimum (all observations in one Gauss-Newton, started
from the truth); with outliers, the joint optimum excludes them. 1 px and 2 % size unless stated otherwise. Seeds from
1000 on are held out from parameter selection. "obs." counts a camera's own shared observations.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from protocols.geometry import so3
from protocols.geometry.pose import Pose
from tests.bench.pose_runs import Network, Traffic, feed, network
from tests.bench.pose_worlds import SimulatedRig, cube, errors, floor, hall, joint_optimum, observe, section_4

EVERY = 20
"""Points between two updates."""
FINAL_UPDATES = 60
"""Updates after the last point, for convergence."""
POINTS = 10_000


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    name: str
    must: str
    reach: str
    measured: str


def ratio(
    seed: int,
    *,
    points: int = POINTS,
    size: float = 0.02,
    outliers: float = 0.0,
    traffic: Traffic | None = None,
    arrived: bool = False,
) -> float:
    """One run of the paper's section 4. arrived: joint optimum of the points whose messages were delivered."""
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    sightings = observe(world, rng, cube(rng, points), size=size, outliers=outliers)
    net = network(world, traffic, seed)
    feed(net, sightings, EVERY)
    for _ in range(FINAL_UPDATES):
        net.tick()
    left_out = sightings.wrong.astype(bool)
    if arrived:
        left_out = left_out | ~np.isin(np.arange(1, points + 1)[: len(left_out)], list(net.arrived))
    best = errors(world, joint_optimum(world, sightings.without(left_out)).poses)[0]
    # The joint optimum is started at the truth: one that took no step (a point behind a camera) is invalid.
    return errors(world, net.world_poses())[0] / best if best > 0.0 else float("nan")


def _summary(values: list[float]) -> str:
    good = [v for v in values if np.isfinite(v)]
    unmeasured = sum(np.isnan(v) for v in values)
    failed = len(values) - len(good) - unmeasured + sum(v > 3.0 for v in good)
    if not good:
        return f"all {len(values)} failed"
    without = f", {unmeasured} without a joint optimum" if unmeasured else ""
    return f"{np.mean(good):.3f} / {np.max(good):.2f}, failed {failed} of {len(values)}{without}"


def ratios_by_points(seed: int) -> list[float]:
    """Ratios at 200, 500, 1000, 2000 and 5000 points; an update at each of the first 500 points, as in the paper.

    After that every 5, from 1000 on every ``EVERY``: 200 points at every fifth are 40 updates, too few to converge.
    """
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    sightings = observe(world, rng, cube(rng, 5000))
    net = network(world, None, seed)
    out, last = [], 0
    for n in (200, 500, 1000, 2000, 5000):
        feed(net, sightings, 1 if n <= 500 else 5 if n <= 1000 else EVERY, last, n)
        last = n
        best = joint_optimum(world, sightings.first(n))
        out.append(errors(world, net.world_poses())[0] / errors(world, best.poses)[0])
    return out


def moved_camera(seed: int, shift: float, turn: float, after: int = 2500) -> tuple[int | None, int | None, bool]:
    """A camera moved by ``shift`` [cm] and ``turn`` [deg] after 5,000 points.

    Returns its observations until detection, and until its position stays within 1.5 cm; and whether there was a false
    alarm before the motion, or of another camera after it.
    """
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    net = network(world, None, seed)
    feed(net, observe(world, rng, cube(rng, 5000)), EVERY)
    camera = int(rng.integers(2, 5))
    way, axis = rng.standard_normal(3), rng.standard_normal(3)
    way, axis = way * shift / np.linalg.norm(way), axis * np.radians(turn) / np.linalg.norm(axis)
    poses = list(world.poses)
    poses[camera] = Pose(so3.exp(axis) @ poses[camera].rotation, poses[camera].position + way)
    moved = SimulatedRig(poses)
    sightings = observe(moved, rng, cube(rng, after))
    mine = np.cumsum((sightings.cameras == camera).any(axis=1))
    begun, seen, back = len(net.notices), None, None
    for i in range(0, after - 4, 5):
        feed(net, sightings, EVERY, i, i + 5)
        if seen is None:
            found = [now for now, notice in net.notices[begun:] if notice.kind == "bumped" and notice.camera == camera]
            seen = int(mine[min(found[0] - 5001, after - 1)]) if found else None
        if seen is not None:
            pose = net.nodes[camera].world_pose()
            near = pose is not None and float(np.linalg.norm(pose.position - poses[camera].position)) < 1.5
            back = (back if back is not None else int(mine[i + 4])) if near else None
    wrong = [n for _, n in net.notices if n.kind == "bumped" and n.camera != camera]
    early = [n for _, n in net.notices[:begun] if n.kind in ("bumped", "edge begun again")]
    return seen, back, bool(wrong or early)


def false_alarms(seed: int, points: int) -> tuple[int, int]:
    """False alarms of static cameras, and their number of observations."""
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    net = network(world, None, seed)
    for _ in range(max(1, points // 10_000)):
        feed(net, observe(world, rng, cube(rng, 10_000)), EVERY)
    return sum(n.kind in ("bumped", "edge begun again") for _, n in net.notices), 2 * points


def large(seed: int, cameras: int, points: int, updates: int) -> tuple[float, float]:
    """A hall of cameras; ratio after ``updates`` of each camera, half of them while points come; seconds of CPU."""
    rng = np.random.default_rng(seed)
    world = hall(rng, cameras)
    sightings = observe(world, rng, floor(rng, world, points))
    begin = time.process_time()
    net = network(world, None, seed)
    feed(net, sightings, -(-2 * len(sightings.cameras) // updates))
    while net.nodes[0].updates < updates:
        net.tick()
    spent = time.process_time() - begin
    return errors(world, net.world_poses())[0] / errors(world, joint_optimum(world, sightings).poses)[0], spent


def cost(seed: int) -> tuple[float, float, int, int]:
    """CPU [µs] of one observation and of one update with 4 neighbours, and bytes per neighbour, final and maximal."""
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    net = network(world, None, seed)
    most = 0
    sightings = observe(world, rng, cube(rng, 6000))
    for at in range(0, 4000, 200):
        feed(net, sightings, EVERY, at, at + 200)
        most = max(most, _bytes(net))
    net.record = []
    twin = network(world, None, seed)
    feed(twin, sightings, EVERY, 0, 4000)
    feed(net, sightings, 10**9, 4000, 6000)
    begin = time.process_time()
    for to, message in net.record:
        twin.nodes[to].handle(message)
    handled = 1e6 * (time.process_time() - begin) / len(net.record)
    begin = time.process_time()
    for _ in range(20):
        net.tick()
    update = 1e6 * (time.process_time() - begin) / (20 * len(net.nodes))
    return handled, update, _bytes(net), most


def _bytes(net: Network) -> int:
    return max(edge.state_bytes for node in net.nodes.values() for edge in node.neighbours().values())


def _row_section_4(seeds: range, quick: bool) -> list[Row]:
    del quick
    return [Row("section 4, mean / worst", "≤ 1.10 / 1.5", "≤ 1.02 / 1.2", _summary([ratio(s) for s in seeds]))]


def _row_growing(seeds: range, quick: bool) -> list[Row]:
    del quick
    means = np.mean([ratios_by_points(s) for s in seeds[: max(3, len(seeds) // 2)]], axis=0)
    text = ", ".join(f"{m:.3f}" for m in means)
    return [Row("mean at 200, 500, 1,000, 2,000, 5,000 points", "≤ 1.2", "≤ 1.05", text)]


def _row_bearings(seeds: range, quick: bool) -> list[Row]:
    del quick
    return [Row("bearings only", "≤ 1.15", "≤ 1.02", _summary([ratio(s, size=np.inf) for s in seeds[:20]]))]


def _row_losses(seeds: range, quick: bool) -> list[Row]:
    del quick
    seeds = seeds[:20]
    again = _summary([ratio(s, traffic=Traffic(0.2, 0.2, 50, 3)) for s in seeds])
    bare = _summary([ratio(s, traffic=Traffic(0.2, 0.2, 50)) for s in seeds])
    same = _summary([ratio(s, traffic=Traffic(0.2, 0.2, 50), arrived=True) for s in seeds])
    name = "20 % lost + 20 % duplicated + ≤ 50 events late"
    return [
        Row(name + ", last 4 a message", "≤ 1.15", "≤ 1.03", again),
        Row(name + ", one a message", "", "", bare),
        Row(name + ", one a message, optimum of the points that anybody paired", "", "", same),
    ]


def _row_outliers(seeds: range, quick: bool) -> list[Row]:
    del quick
    return [
        Row("5 % outliers", "no failure, ≤ 1.5", "", _summary([ratio(s, outliers=0.05) for s in seeds])),
        Row("20 % outliers", "", "≤ 1.1", _summary([ratio(s, outliers=0.2) for s in seeds[:20]])),
    ]


def _row_moved_camera(seeds: range, quick: bool) -> list[Row]:
    rows = []
    for name, shift, turn, must, reach in (
        ("moved 5 cm, 2°: detected / recovered, obs., worst", 5.0, 2.0, "≤ 60 / 500", "≤ 15 / 250"),
        ("moved 0.3°: detected, obs., worst", 0.0, 0.3, "≤ 1000", "≤ 150"),
    ):
        runs = [moved_camera(s, shift, turn) for s in seeds]
        seen = [r[0] if r[0] is not None else 10**6 for r in runs]
        back = [r[1] if r[1] is not None else 10**6 for r in runs]
        wrong = sum(r[2] for r in runs)
        text = f"{max(seen)} / {max(back)} (median {np.median(seen):.0f} / {np.median(back):.0f}), false alarms {wrong}"
        rows.append(Row(name, must, reach, text + f" of {len(runs)}"))
    alarms, seen_in_all = false_alarms(seeds[0], 10_000 if quick else 50_000)
    rows.append(Row("false alarms", "0 in 1e5 obs.", "", f"{alarms} in {seen_in_all:.0e} obs."))
    return rows


def _row_50(seeds: range, quick: bool) -> list[Row]:
    runs = [large(s, 50, 20_000, 600) for s in seeds[: 1 if quick else 5]]
    return [
        Row("50 cameras, 600 updates", "≤ 1.15", "≤ 1.03", _summary([r[0] for r in runs]) + f", {runs[0][1]:.0f} s CPU")
    ]


def _row_500(seeds: range, quick: bool) -> list[Row]:
    if quick:
        return []
    r, spent = large(seeds[0], 500, 60_000, 600)
    return [Row("500 cameras, 600 updates", "≤ 2", "≤ 1.1", f"{r:.3f}, one seed, {spent:.0f} s CPU")]


def _row_cost(seeds: range, quick: bool) -> list[Row]:
    del quick
    handled, update, converged, most = cost(seeds[0])
    return [
        Row(
            "CPU an observation at 4 neighbours",
            "≤ 20 µs",
            "≤ 3 µs",
            f"{handled:.1f} µs, and {update:.0f} µs an update",
        ),
        Row("state a neighbour", "≤ 4 kB", "≤ 0.5 kB", f"{converged} B converged, {most} B at most"),
    ]


ROWS: dict[str, Callable[[range, bool], list[Row]]] = {
    "section4": _row_section_4,
    "growing": _row_growing,
    "bearings": _row_bearings,
    "losses": _row_losses,
    "outliers": _row_outliers,
    "bump": _row_moved_camera,
    "50": _row_50,
    "500": _row_500,
    "cost": _row_cost,
}


def main() -> None:
    """Prints the table, row by row as they are ready."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--rows", default=",".join(ROWS))
    chosen = parser.parse_args()
    seeds = range(chosen.first, chosen.first + (3 if chosen.quick else chosen.seeds))
    print(f"seeds {seeds[0]} to {seeds[-1]}\n\n| | must | reach for | measured |\n|---|---|---|---|")
    for name in chosen.rows.split(","):
        for row in ROWS[name](seeds, chosen.quick):
            print(f"| {row.name} | {row.must} | {row.reach} | {row.measured} |", flush=True)


if __name__ == "__main__":
    main()
