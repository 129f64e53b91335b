"""Pose update with four neighbours: five cameras, points that two of them see, beside gtsam's iSAM2 on that stream.

iSAM2: a pose a camera, a landmark a point, two projections and two ranges (the sizes), an update every 20 points as
ours has one; begun at the truth. Timed is the second half of the points: ours with everything that carries its messages
between the five nodes, each of which keeps its own pose; iSAM2 keeps every landmark and all cameras in one place.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from tests.bench import poses
from tests.bench.pose_runs import feed, network
from tests.bench.pose_worlds import TARGET, Sightings, SimulatedRig, cube, observe, section_4
from tests.bench.speed.rows import Limit, Row, Section

_SEED = 1016


def stream(points: int) -> tuple[SimulatedRig, Sightings]:
    """Section 4's world and what was seen."""
    rng = np.random.default_rng(_SEED)
    world = section_4(rng)
    return world, observe(world, rng, cube(rng, points))


def ours(world: SimulatedRig, sightings: Sightings) -> tuple[float, float]:
    """CPU seconds of the second half, and the mean position error [cm] of the three cameras without a given pose."""
    half = len(sightings.cameras) // 2
    net = network(world, None, _SEED)
    feed(net, sightings, poses.EVERY, 0, half)
    began = time.process_time()
    feed(net, sightings, poses.EVERY, half)
    spent = time.process_time() - began
    found = net.world_poses()
    off = [np.linalg.norm(a.position - b.position) if a else np.inf for a, b in zip(found, world.poses, strict=True)]
    return spent, float(np.mean(off[2:]))


def isam2(world: SimulatedRig, sightings: Sightings) -> tuple[float, float]:
    """The same of iSAM2. Raises ImportError where gtsam is not installed."""
    import gtsam
    from gtsam.symbol_shorthand import L, X

    lens = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0)
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, sightings.sigma)
    solver = gtsam.ISAM2(gtsam.ISAM2Params())
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def placed(camera: int) -> object:
        pose = world.poses[camera]
        return gtsam.Pose3(gtsam.Rot3(pose.rotation.T), pose.position)

    began = 0.0
    for camera in range(len(world.poses)):
        values.insert(X(camera), placed(camera))
    graph.add(gtsam.PriorFactorPose3(X(0), placed(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    held = gtsam.noiseModel.Diagonal.Sigmas(np.array([10.0, 10.0, 10.0, 1e-4, 1e-4, 1e-4]))
    graph.add(gtsam.PriorFactorPose3(X(1), placed(1), held))
    for i, (pair, seen) in enumerate(zip(sightings.cameras, sightings.seen, strict=True)):
        if i == len(sightings.cameras) // 2:
            began = time.process_time()
        for camera, row in zip(pair, seen, strict=True):
            graph.add(gtsam.GenericProjectionFactorCal3_S2(row[:2], pixel, X(int(camera)), L(i), lens))
            # The apparent size gives the depth, and with the direction the range.
            distance = TARGET * float(np.exp(-row[2])) * float(np.sqrt(1.0 + row[0] ** 2 + row[1] ** 2))
            noise = gtsam.noiseModel.Isotropic.Sigma(1, sightings.size_sigma * distance)
            graph.add(gtsam.RangeFactor3D(X(int(camera)), L(i), distance, noise))
        first = world.poses[int(pair[0])]
        depth = TARGET * float(np.exp(-seen[0, 2]))
        values.insert(L(i), first.position + first.rotation.T @ (depth * np.array([seen[0, 0], seen[0, 1], 1.0])))
        if (i + 1) % poses.EVERY == 0:
            solver.update(graph, values)
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            for camera in range(len(world.poses)):
                solver.calculateEstimatePose3(X(camera))
    spent = time.process_time() - began
    estimate = solver.calculateEstimate()
    found = [estimate.atPose3(X(k)).translation() for k in range(2, len(world.poses))]
    off = [np.linalg.norm(a - b.position) for a, b in zip(found, world.poses[2:], strict=True)]
    return spent, float(np.mean(off))


def measure(quick: bool, data: Path) -> Section:
    """One world; CPU an observation."""
    del data
    points = 2000 if quick else 8000
    world, sightings = stream(points)
    handled, update, _, _ = poses.cost(_SEED)
    found = Section(
        [
            Row("pose update, 4 neighbours: an observation taken in", handled, "µs", must=Limit("ours", 5.0),
                reach=Limit("ours", 3.0), note=f"and {update:.0f} µs an update of the pose, each 20 points")
        ]
    )  # fmt: skip
    seen = len(sightings.cameras)
    spent, off = ours(world, sightings)
    work = f"five poses, points {seen // 2:,} to {seen:,}, all of it, an observation"
    try:
        theirs, their_off = isam2(world, sightings)
    except ImportError:
        found.missing.append(f"{work}, beside iSAM2: gtsam is not installed (extra bench)")
        return found
    found.rows.append(
        Row(work, 1e6 * spent / seen, "µs", "gtsam iSAM2", 1e6 * theirs / seen,
            note=f"mean error of the three unknown poses: {off:.2f} cm, iSAM2 {their_off:.2f} cm")
    )  # fmt: skip
    return found
