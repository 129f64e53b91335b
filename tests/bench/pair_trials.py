"""Random pairs of unsynchronised cameras with ground truth, and the Cramér-Rao bound of their lag.

Two pinhole cameras stand 30° to 150° apart around a cube of ±120 (the paper's size) in which one marker moves; each has
its own clock. Rig, path and clocks differ in every trial.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from edge.scenes.common.base import look_at_pose
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from hub.two_view.relative_pose import RelativePose, fundamental_from, orthogonal_axes, relative_pose_between
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats

FOCAL = 700.0
SIZE = (800, 600)
MATRIX = np.array([[FOCAL, 0.0, SIZE[0] / 2], [0.0, FOCAL, SIZE[1] / 2], [0.0, 0.0, 1.0]])
CUBE = 120.0
PathOf = Callable[[Floats], Floats]
"""Positions (n, 3) at true times (n,) [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Observations of one camera. time: (n,) on its clock [s]. pixels: (n, 2). good: (n,) rows of the marker itself."""

    time: Floats
    pixels: Floats
    good: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Two views and the ground truth. Clocks: ``true = (shown - clock_offset) / clock_rate``. noise: std [px]."""

    views: tuple[View, View]
    poses: tuple[Pose, Pose]
    clock_rate: tuple[float, float]
    clock_offset: tuple[float, float]
    path: PathOf
    noise: float

    def shown(self, camera: int, true: Floats) -> Floats:
        """What a camera's clock shows at true times (n,)."""
        return self.clock_offset[camera] + self.clock_rate[camera] * true

    def true(self, camera: int, shown: Floats) -> Floats:
        """True times (n,) at which a camera's clock shows ``shown``."""
        return (shown - self.clock_offset[camera]) / self.clock_rate[camera]

    def smoothed(self) -> list[SmoothTrack]:
        """The tracks of both cameras; fewer where one of them is none."""
        found = [smooth_track(view.time, (view.pixels - MATRIX[:2, 2]) / FOCAL, FOCAL) for view in self.views]
        return [track for track in found if track is not None]

    @property
    def overlap(self) -> tuple[float, float]:
        """True times [s] of the begin and end of the common recording."""
        spans = [self.true(k, view.time[[0, -1]]) for k, view in enumerate(self.views)]
        return max(float(s[0]) for s in spans), min(float(s[1]) for s in spans)

    @property
    def pose(self) -> RelativePose:
        """The true relative pose, b from a."""
        return relative_pose_between(*self.poses)

    @property
    def fundamental(self) -> Floats:
        """The true matrix (3, 3), ``m_aᵀ F m_b = 0``, norm 1."""
        return fundamental_from(self.pose, MATRIX, MATRIX)


@dataclass(frozen=True, slots=True)
class Regime:
    """Conditions of a trial; times in seconds, fractions of all rows.

    span: of each recording. late: camera b begins within ±late of a, or, with ``overlap``, so that exactly that many
    seconds are common. ppm: largest clock-rate error. dropped, outliers: fractions. gaps: number. slowest, fastest:
    frequencies of the motion [Hz]. assumed_fps: frame rates from which the timestamps were made, if wrong ones.
    readout: of the rolling shutter [s]. second_object: fraction of a view in which the detector follows another
    object. paper_path: the paper's trajectory (a) in front of the paper's cameras.
    """

    span: float = 20.0
    late: float = 5.0
    overlap: float | None = None
    fps: tuple[float, float] = (30.0, 30.0)
    ppm: float = 0.0
    noise: float = 0.5
    dropped: float = 0.0
    outliers: float = 0.0
    gaps: int = 0
    second_object: float = 0.0
    slowest: float = 0.05
    fastest: float = 1.2
    readout: float = 0.0
    assumed_fps: tuple[float, float] | None = None
    paper_path: bool = False


def make_trial(regime: Regime, seed: int) -> Trial:
    """One trial, a pure function of its arguments."""
    rng = np.random.default_rng([20_240, seed])
    r = regime
    if r.paper_path:
        poses, path = _paper_rig(), _paper_trajectory_a
    else:
        poses, path = _random_rig(rng), _random_path(rng, r.slowest, r.fastest)
    other = _random_path(rng, r.slowest, r.fastest)
    clock_rate = tuple(1.0 + 1e-6 * float(d) for d in rng.uniform(-r.ppm, r.ppm, 2))
    if r.assumed_fps is not None:
        clock_rate = tuple(
            d * actual / assumed for d, actual, assumed in zip(clock_rate, r.fps, r.assumed_fps, strict=True)
        )
    clock_offset = tuple(float(e) for e in rng.choice([0.0, 1.7e9, 86_400.5, -250.0, 3.2e6], 2))
    late = (
        float(rng.uniform(-r.late, r.late)) if r.overlap is None else float(rng.choice([-1, 1])) * (r.span - r.overlap)
    )
    style = int(rng.integers(3))  # of the second object: separate episodes per view, common episodes, single frames
    episodes = [_episodes(rng, r.span + 2 * abs(late), -abs(late), r.second_object) for _ in range(2)]
    views = []
    for k in range(2):
        begin = (0.0, late)[k] + float(rng.uniform(0, 1.0 / r.fps[k]))
        true = begin + np.arange(int(r.span * r.fps[k])) / r.fps[k]
        places = path(true)
        switched = np.zeros(len(true), dtype=np.bool_)
        if r.second_object:
            if style == 2:
                switched = rng.random(len(true)) < r.second_object
            else:
                for a, b in episodes[k if style == 0 else 0]:
                    switched |= (true >= a) & (true < b)
            places[switched] = other(true[switched])
        pixels = _project(poses[k], places)
        if r.readout:
            # The frame's time is that of the middle row; the marker's row is exposed before or after it.
            pixels = _project(poses[k], path(true + r.readout * (pixels[:, 1] / SIZE[1] - 0.5)))
        pixels = pixels + rng.normal(0, r.noise, pixels.shape)
        wrong = rng.random(len(true)) < r.outliers
        pixels[wrong] = rng.uniform((0, 0), SIZE, (int(wrong.sum()), 2))
        keep = rng.random(len(true)) >= r.dropped
        for _ in range(r.gaps):
            at = float(rng.uniform(true[0], true[-1]))
            keep &= ~((true > at) & (true < at + rng.uniform(0.3, 1.5)))
        views.append(View(clock_offset[k] + clock_rate[k] * true[keep], pixels[keep], ~(wrong | switched)[keep]))
    return Trial(
        (views[0], views[1]), poses, (clock_rate[0], clock_rate[1]), (clock_offset[0], clock_offset[1]), path, r.noise
    )


def unrelated_trial(trial: Trial, regime: Regime, seed: int) -> Trial:
    """The same trial, but camera b saw an unrelated motion: it must be refused."""
    other = make_trial(replace(regime, paper_path=False), seed + 500_000)
    swapped = replace(trial, poses=(trial.poses[0], other.poses[1]))
    return replace(swapped, views=(trial.views[0], other.views[1]))


def lag_bound(trial: Trial, calibrated: bool) -> float:
    """Cramér-Rao bound: least std [s] of the lag at mid-overlap for points that are not smoothed.

    Each good frame of the camera with fewer of them gives one epipolar equation with the noise of both points, as if
    the other camera had exposed at the same instant, if that one saw the marker within 0.2 s before and after. Unknown
    beside the lag: the clock rate and 5 (calibrated) or 7 parameters of the geometry.
    """
    begin, end = trial.overlap
    times = []
    for k, view in enumerate(trial.views):
        true = trial.true(k, view.time)
        times.append(true[view.good & (true >= begin) & (true <= end)])
    true, other = sorted(times, key=len)
    where = np.searchsorted(other, true)
    inside = (where > 0) & (where < len(other))
    true, where = true[inside], where[inside]
    true = true[(other[where] - true < 0.2) & (true - other[where - 1] < 0.2)]
    a, b = (_project(pose, trial.path(true)) for pose in trial.poses)
    h = 1e-4
    speed = (_project(trial.poses[1], trial.path(true + h)) - _project(trial.poses[1], trial.path(true - h))) / (2 * h)
    f = trial.fundamental
    ha, hb = np.column_stack([a, np.ones(len(a))]), np.column_stack([b, np.ones(len(b))])
    line_b, line_a = ha @ f, hb @ f.T
    inverse_noise = 1.0 / (trial.noise * np.sqrt((line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)))
    along = (line_b[:, :2] * speed).sum(1) * inverse_noise
    columns = [along, along * (true - 0.5 * (begin + end))]
    inverse = np.linalg.inv(MATRIX)
    pose = trial.pose
    if calibrated:
        basis = orthogonal_axes(pose.direction).T
        changes = [so3.hat(pose.direction) @ so3.hat(axis) @ pose.rotation for axis in np.eye(3)]
        changes += [so3.hat(basis[:, k]) @ pose.rotation for k in range(2)]
        changes = [inverse.T @ change.T @ inverse for change in changes]
    else:
        u, d, vt = np.linalg.svd(f)
        changes = [so3.hat(axis) @ f for axis in np.eye(3)] + [f @ so3.hat(axis) for axis in np.eye(3)]
        changes.append((u * np.array([-d[1], d[0], 0.0])) @ vt)
    for change in changes:
        column = ((ha @ change) * hb).sum(1) * inverse_noise
        columns.append(column / max(float(np.abs(column).max()), 1e-300))
    jacobian = np.column_stack(columns)
    return float(np.sqrt(np.linalg.pinv(jacobian.T @ jacobian, hermitian=True, rcond=1e-14)[0, 0]))


def geometry_error(trial: Trial, fundamental: Floats) -> float:
    """Mean distance [px] of 281 points of the cube from their epipolar lines, both images (paper, figure 13)."""
    points = np.random.default_rng(281).uniform(-CUBE, CUBE, (281, 3))
    a, b = (_project(pose, points) for pose in trial.poses)
    ha, hb = np.column_stack([a, np.ones(len(a))]), np.column_stack([b, np.ones(len(b))])
    line_b, line_a = ha @ fundamental, hb @ fundamental.T
    value = np.abs((line_b * hb).sum(1))
    return float(
        0.5 * (value / np.linalg.norm(line_b[:, :2], axis=1) + value / np.linalg.norm(line_a[:, :2], axis=1)).mean()
    )


def time_map_error(trial: Trial, rate: float, offset: float) -> tuple[float, float]:
    """Errors of an estimated ``t_a = rate * t_b + offset``: at mid-overlap, and RMS over the overlap [s]."""
    true = np.linspace(*trial.overlap, 51)
    error = rate * trial.shown(1, true) + offset - trial.shown(0, true)
    return float(error[25]), float(np.sqrt((error**2).mean()))


def _project(pose: Pose, points: Floats) -> Floats:
    local = pose.camera_from_world(points)
    return np.asarray(FOCAL * local[:, :2] / local[:, 2:] + np.array(SIZE) / 2)


def _random_rig(rng: np.random.Generator) -> tuple[Pose, Pose]:
    """Two cameras that see the cube, their directions 30° to 150° apart."""
    while True:
        directions = rng.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        directions[:, 2] = np.clip(directions[:, 2], -0.3, 0.85)  # not from below, nor straight from above
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        if 30.0 <= np.rad2deg(np.arccos(directions[0] @ directions[1])) <= 150.0:
            break
    return tuple(  # type: ignore[return-value]
        look_at_pose(direction * rng.uniform(500, 900), rng.normal(0, 15, 3), rng.normal(0, 0.15))
        for direction in directions
    )


def _random_path(rng: np.random.Generator, slowest: float, fastest: float) -> PathOf:
    """Six sinusoids a coordinate, each slower than ``fastest`` [Hz], within the cube."""
    frequency, phase = rng.uniform(slowest, fastest, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
    amplitude = rng.uniform(0.4, 1.0, (6, 3)) / np.maximum(1.0, frequency / 0.4)
    amplitude *= 1.4 * CUBE / amplitude.sum(axis=0)

    def path(time: Floats) -> Floats:
        return np.asarray((amplitude * np.sin(2 * np.pi * frequency * time[:, None, None] + phase)).sum(axis=1))

    return path


def _episodes(rng: np.random.Generator, length: float, begin: float, share: float) -> list[tuple[float, float]]:
    """Intervals of 0.3 to 2 s that fill ``share`` of the time."""
    out: list[tuple[float, float]] = []
    if share <= 0:
        return out
    at = begin
    while at < begin + length:
        on = float(rng.uniform(0.3, 2.0))
        off = on * (1 - share) / share * float(rng.uniform(0.6, 1.4))
        out.append((at + off * 0.5, at + off * 0.5 + on))
        at += on + off
    return out


def _paper_rig() -> tuple[Pose, Pose]:
    """The paper's cameras of eq. (23): (φ, θ, d) = (30°, 40°, 600) and (60°, 20°, 700)."""
    poses = []
    for phi, theta, distance in ((30, 40, 600), (60, 20, 700)):
        p, t = np.deg2rad(phi), np.deg2rad(theta)
        turn = so3.exp(np.array([0, 0, p])) @ so3.exp(np.array([0, t, 0]))
        axes = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=np.float64)  # u = y/x, v = z/x
        rotation = axes @ turn
        poses.append(Pose(rotation, -turn.T @ np.array([distance, 0.0, 0.0])))
    return poses[0], poses[1]


def _paper_trajectory_a(time: Floats) -> Floats:
    """The paper's trajectory (a)."""
    envelope = np.sin(np.pi / 11 * time)
    return np.column_stack(
        [18 * (time - 5.5), 140 * np.sin(np.pi * time) * envelope, 100 * np.cos(np.pi * time) * envelope]
    )
