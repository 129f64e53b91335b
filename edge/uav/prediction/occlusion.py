"""Prediction of a target during occlusion or outside the image: along road paths from its last known state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.uav.ground.road_map import RoadMap
from edge.uav.prediction import particle_filter as pf
from edge.uav.prediction import particle_set
from edge.uav.prediction.driver_model import DriverModel
from edge.uav.prediction.particle_set import NO_PATH, ParticleSet
from edge.uav.prediction.paths import RoadPath, road_edges, trace_paths
from edge.uav.target.motion_history import MotionFit
from protocols.geometry.types import Floats

_UNKNOWN_CURVATURE_STD = 0.008  # of road that was not observed [1/unit]
_RETRACE_EVERY = 8  # frames
_PARTICLE_COUNT = 400  # over all paths: more cost CPU, fewer leave an unlikely turn without any
_ON_PATH_SHARE = 0.92  # of the particles, where the target drove on the road
_TURN_PROBABILITY, _BRAKING_TURN_GAIN = 0.36, 0.4  # prior at a junction, and its increase for a braking driver
_MAX_ACCELERATION_STD = 1.5  # of an acceleration that is used
_BRAKING_ACCELERATION = -0.7  # longitudinal acceleration below which the driver is braking [units/s²]
_MIN_ROAD_SHARE = 0.5  # share of the trail on road for which paths are used


def assign_paths(particles: ParticleSet, paths: list[RoadPath], share: float, rng: np.random.Generator) -> ParticleSet:
    """Put a share of the particles on paths that start at their position, in proportion to the path weights."""
    n = len(particles)
    start, heading = paths[0].points[0], paths[0].headings[0]
    local = particles.position - start
    arc_length = local @ np.array([np.cos(heading), np.sin(heading)])
    lateral_offset = local @ np.array([-np.sin(heading), np.cos(heading)])
    edges = np.cumsum([path.weight for path in paths])
    drawn_path = np.minimum(np.searchsorted(edges, rng.random(n)), len(paths) - 1)
    free = rng.random(n) >= share
    curvature = np.where(free, particles.curvature, rng.normal(0.0, _UNKNOWN_CURVATURE_STD, n))
    path = np.where(free, NO_PATH, drawn_path)
    return replace(particles, path=path, arc_length=arc_length, lateral_offset=lateral_offset, curvature=curvature)


def reassign_paths(
    particles: ParticleSet, old: list[RoadPath], new: list[RoadPath], rng: np.random.Generator
) -> ParticleSet:
    """Change to retraced paths from the same start; a new path gets its share of the particles before its branch."""
    successor = np.full(len(old), 0, dtype=np.int64)
    claimed = np.zeros(len(new), bool)
    for k, path in enumerate(old):
        gaps = []
        for other in new:
            m = min(len(path.points), len(other.points))
            gaps.append(float(np.linalg.norm(path.points[:m] - other.points[:m], axis=1).mean()))
        successor[k] = int(np.argmin(gaps))
        claimed[successor[k]] = True
    assigned = np.where(particles.path == NO_PATH, NO_PATH, successor[np.maximum(particles.path, 0)])
    for k, other in enumerate(new):
        if claimed[k] or k == 0:
            continue
        base = new[0]
        m = min(len(base.points), len(other.points))
        diverged = np.linalg.norm(base.points[:m] - other.points[:m], axis=1) > 2.0
        branch_length = float(np.argmax(diverged)) * 1.5 if diverged.any() else 0.0
        eligible = (assigned == 0) & (particles.arc_length < branch_length)
        switches = eligible & (rng.random(len(particles)) < other.weight / (other.weight + base.weight))
        assigned = np.where(switches, k, assigned)
    return replace(particles, path=assigned)


class OcclusionPredictor:
    """Created at the first frame without a detection. Without ``paths`` the particles propagate freely."""

    def __init__(
        self, particles: ParticleSet, fit: MotionFit | None, time: float, road: RoadMap, trail: Floats
    ) -> None:
        """trail: (m, 2) recent ground positions of the target."""
        self._start_time = time
        self._frames = 0
        self.paths: list[RoadPath] = []
        self._position = particles.weights @ particles.position
        self._heading = pf.circular_mean(particles.heading, particles.weights)
        self._speed = fit.speed if fit is not None else 0.0
        curvature = fit.turn_rate / max(fit.speed, 2.0) if fit is not None else 0.0
        self._curvature = float(np.clip(curvature, -0.12, 0.12))
        # A driver who brakes before a junction mostly turns there.
        braking = (
            -fit.longitudinal_acceleration if fit is not None and fit.acceleration_std < _MAX_ACCELERATION_STD else 0.0
        )
        self._turn_probability = _TURN_PROBABILITY + _BRAKING_TURN_GAIN * float(
            np.clip((braking - 0.5) / 1.5, 0.0, 1.0)
        )
        self._edge_distances = (float("nan"), float("nan"))
        self.road_share = 0.0
        if len(trail) > 3 and self._speed > 1.0 and road.has_colour_model:
            road.smooth_around(self._position, 40.0)
            self.road_share = float(np.mean(road.smooth_log_odds(trail) > 0.2))
            steps = np.gradient(trail, axis=0)
            right, left = road_edges(road, trail, np.arctan2(steps[:, 1], steps[:, 0]))
            self._edge_distances = _median_distance(right), _median_distance(left)

    def begin(
        self,
        particles: ParticleSet,
        fit: MotionFit | None,
        time: float,
        road: RoadMap,
        driver: DriverModel,
        rng: np.random.Generator,
    ) -> ParticleSet:
        """Initialise the particle set for prediction."""
        self.paths = self._trace_paths(road, time)
        if fit is not None:
            particles = particle_set.initialise_prediction(
                particles, fit, time - fit.time, _PARTICLE_COUNT, rng, driver, paths_known=bool(self.paths)
            )
        if not self.paths:
            return particles
        particles = assign_paths(particles, self.paths, _ON_PATH_SHARE, rng)
        is_braking = fit is not None and fit.longitudinal_acceleration < _BRAKING_ACCELERATION
        return particles if is_braking else particle_set.raise_lateral_limits(particles, self.paths[:1])

    def update(self, particles: ParticleSet, time: float, road: RoadMap, rng: np.random.Generator) -> ParticleSet:
        """Retrace the paths, always from the same start, as more of the road becomes visible."""
        self._frames += 1
        if self._frames % _RETRACE_EVERY or not self.paths:
            return particles
        paths = self._trace_paths(road, time)
        particles = reassign_paths(particles, self.paths, paths, rng)
        self.paths = paths
        return particles

    def _trace_paths(self, road: RoadMap, time: float) -> list[RoadPath]:
        if self.road_share < _MIN_ROAD_SHARE:
            return []
        reach = float(np.clip(self._speed * (3.0 + time - self._start_time) + 15.0, 30.0, 160.0))
        return trace_paths(
            road, self._position, self._heading, self._curvature, reach, self._edge_distances, self._turn_probability
        )


def _median_distance(values: Floats) -> float:
    good = values[np.isfinite(values)]
    return float(np.median(good)) if len(good) >= 3 else float("nan")
