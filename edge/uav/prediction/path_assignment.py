"""Which road path each particle follows: at first, and when the paths were traced again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.uav.prediction.particle_set import NO_PATH, ParticleSet
from edge.uav.prediction.paths import RoadPath

_UNKNOWN_CURVATURE_STD = 0.008  # of road that was not observed [1/unit]


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
