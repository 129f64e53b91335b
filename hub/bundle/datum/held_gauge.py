"""The published gauge is held: each new answer is mapped onto the world and scale of the one before.

Observations alone determine neither world frame nor scale (seven gauge freedoms). Were they fixed anew by each answer's
first baseline, the whole published world would move with that baseline's error, 1 to 5 % early in a recording. The
similarity onto the trajectory that was published before moves least of what is used.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hub.bundle.problem import AdjustmentState
from hub.trajectory.discrete import PointBasis
from protocols.geometry.pose import Pose, Similarity, fit_similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration

_MOST_POINTS = 300
"""Datum points of one label; more do not change the similarity."""
_FEWEST_POINTS = 30  # ten times what a similarity needs
_CAMERA_WEIGHT = 0.1
"""Weight of all cameras together against the trajectories: enough where a path is straight, which leaves a rotation
about it free."""
_OUTLIER = 4.0
"""Points farther off than this many times the median distance do not count: a camera that was moved."""


def similarity_to_published(
    published: Calibration,
    names: list[str],
    labels: list[str],
    state: AdjustmentState,
    internal_time: Callable[[Floats], Floats],
) -> tuple[Similarity, list[tuple[int, Floats]]]:
    """The similarity from the state's world to the published one, and the datum points: label index, internal times.

    names, labels: of the state's cameras and trajectories. internal_time: internal from published reference time.
    """
    datum, sources, targets = [], [], []
    for table in published.trajectories:
        if table.label not in labels or len(table.time) < _FEWEST_POINTS:
            continue
        label = labels.index(table.label)
        path = state.trajectories[label]
        if isinstance(path.basis, PointBasis):
            continue
        time = internal_time(table.time)
        here = path.at(time)
        good = np.flatnonzero(np.isfinite(here).all(axis=1))
        if len(good) < _FEWEST_POINTS:
            continue
        good = good[np.linspace(0, len(good) - 1, min(len(good), _MOST_POINTS)).astype(np.int64)]
        datum.append((label, time[good]))
        sources.append(here[good])
        targets.append(table.position[good])
    common = [name for name in names if name in published.cameras]
    poses = [state.cameras[names.index(name)].pose for name in common]
    ratio = 1.0
    if sources:
        one, other = np.concatenate(sources), np.concatenate(targets)
        ratio = _extent(other) / max(_extent(one), 1e-12)
    elif len(common) > 1:
        ratio = _extent(_centres([published.cameras[name].pose for name in common])) / _extent(_centres(poses))
    reach = _extent(_centres(poses))
    count = sum(len(part) for part in sources)
    weights = [np.ones(count)]
    for name, pose in zip(common, poses, strict=True):
        sources.append(camera_markers(pose, reach))
        targets.append(camera_markers(published.cameras[name].pose, reach * ratio))
        weights.append(np.full(4, max(_CAMERA_WEIGHT * count, 1.0) / (4 * len(common))))
    source, target, weight = np.concatenate(sources), np.concatenate(targets), np.concatenate(weights)
    return fit_robustly(source, target, weight), datum


def fit_robustly(source: Floats, target: Floats, weight: Floats) -> Similarity:
    """The similarity from points (n, 3) to others, by weights (n,), of which far outliers hardly count."""
    found = fit_similarity(source, target, weights=weight)
    for _ in range(3):
        distance = np.linalg.norm(found.points(source) - target, axis=1)
        limit = _OUTLIER * float(np.median(distance)) + 1e-12
        found = fit_similarity(source, target, weights=weight / np.maximum(1.0, distance / limit) ** 2)
    return found


def camera_markers(pose: Pose, reach: float) -> Floats:
    """A camera's centre and a point on each of its axes (4, 3)."""
    return np.vstack([pose.position, pose.position + reach * pose.rotation])


def _centres(poses: list[Pose]) -> Floats:
    return np.array([pose.position for pose in poses])


def _extent(points: Floats) -> float:
    return max(float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean()), 1e-12)
