"""A small synthetic solved session: three cameras around a marker's path, a fourth refused."""

from __future__ import annotations

import numpy as np

from edge.scenes.common.base import look_at_pose
from protocols.core.acceptance import PairReport
from protocols.core.clocks import TimeMap
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, CameraCalibration, TrajectoryTable
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera

REFUSED = "could not be connected to any camera (with cam0: the point hardly moves)"


def solved_session(
    *,
    time_offset_std: float = 0.0004,
    noise_px: float = 0.4,
    scale: str = "arbitrary",
    rows: int = 400,
    names: tuple[str, ...] = ("cam0", "cam1", "cam2", "cam3"),
) -> tuple[Calibration, Rig, Observations]:
    """A calibration with its rig and observations; the last camera is refused, seed fixed."""
    random = np.random.default_rng(5)
    lens = Intrinsics(1280, 720, np.array([[900.0, 0, 639.5], [0, 900.0, 359.5], [0, 0, 1]]))
    azimuth = np.linspace(0.0, 2 * np.pi, len(names), endpoint=False)
    time = np.linspace(10.0, 40.0, rows)
    path = np.column_stack([1.5 * np.sin(0.9 * time), 1.2 * np.cos(0.7 * time), 1.0 + 0.6 * np.sin(1.3 * time)])
    rig_cameras, cameras, residuals = {}, {}, {}
    observed_rows: list[tuple[str, int, float, Floats]] = []
    for number, name in enumerate(names):
        place = np.array([5 * np.cos(azimuth[number]), 5 * np.sin(azimuth[number]), 1.8])
        pose = look_at_pose(place, np.array([0.0, 0.0, 1.0]))
        clock = TimeMap(1.0 + 1e-5 * number, 3.25 * number)
        seen = clock_times(clock, time)
        error = random.normal(0.0, noise_px, (rows, 2))
        pixels = lens.project(pose.camera_from_world(path)) + error
        inside = ((pixels >= 0) & (pixels < [1280, 720])).all(axis=1)
        observed_rows += [(name, int(i), float(seen[i]), pixels[i]) for i in np.flatnonzero(inside)]
        rig_cameras[name] = RigCamera(name, (1280, 720), 30.0, lens, table={"name": name, "fps": 30.0, "model": "test"})
        if name != names[-1]:
            std = 0.0 if number == 0 else time_offset_std
            rms = float(np.sqrt(np.mean(np.sum(error[inside] ** 2, axis=1))))
            position_std = np.full(3, 0.002 * (number > 0))
            cameras[name] = CameraCalibration(name, lens, pose, clock, std, position_std, rms, lag_std=std)
            residuals[name] = np.column_stack([seen, pixels, error])[inside]
    ok = names[:-1]
    matrix = np.array([[0.0, -1e-6, 1e-3], [2e-6, 0.0, -2e-3], [-1e-3, 2e-3, 1.0]])
    pairs = [
        PairReport((a, b), "ok", 3.25 * (i - j), 1.0, matrix / np.linalg.norm(matrix), 0.97, 0.45)
        for i, a in enumerate(ok)
        for j, b in enumerate(ok)
        if i < j
    ]
    pairs.append(PairReport((names[0], names[-1]), "the point hardly moves while both could have seen it"))
    calibration = Calibration(
        cameras=cameras,
        reference=names[0],
        scale=scale,
        units="m",
        solver="joint",
        version="0.1.0",
        refused={names[-1]: REFUSED},
        trajectories=(TrajectoryTable("marker", time, path, np.full(rows, 0.003)),),
        pairs=tuple(pairs),
        cpu_seconds=1.25,
        residuals=residuals,
    )
    observations = gather_tracks(
        [row[0] for row in observed_rows],
        ["marker"] * len(observed_rows),
        np.array([row[1] for row in observed_rows]),
        np.array([row[2] for row in observed_rows]),
        np.array([row[3] for row in observed_rows]),
        np.full(len(observed_rows), np.nan),
        order=names,
    )
    return calibration, Rig(rig_cameras, metadata={"name": "test"}), observations


def clock_times(clock: TimeMap, time: Floats) -> Floats:
    """Camera times of reference times (n,)."""
    return np.asarray((time - clock.time_offset) / clock.clock_rate)
