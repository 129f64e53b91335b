"""State estimate from the particle set: track state, densest cluster, covariance, other clusters as hypotheses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.uav.base import LOST_AFTER_S, LOST_STD, Estimate, Hypothesis, TrackState
from edge.uav.ground.localisation import CameraLocaliser
from edge.uav.prediction import particle_filter as pf
from edge.uav.prediction.particle_set import ParticleSet
from edge.uav.target import footprint
from edge.uav.target.target import Target

_MIN_RADIUS, _MAX_RADIUS = 0.7, 2.0  # of a cluster, in target lengths
_RADIUS_PER_STD = 0.7  # of a cluster, over the particle set's std


def estimate_target(
    particles: ParticleSet, target: Target, localiser: CameraLocaliser, missed_frames: int, time: float, unseen_s: float
) -> Estimate:
    """The estimate of a frame, without layers. missed_frames: consecutive; unseen_s: since the last detection."""
    clusters: tuple[pf.Cluster, ...]
    if missed_frames:
        # In a widely spread sample, fine structure is sampling noise.
        covariance = pf.weighted_covariance(particles.position, particles.weights)
        radius = float(
            np.clip(_RADIUS_PER_STD * np.sqrt(0.5 * np.trace(covariance)) / target.length, _MIN_RADIUS, _MAX_RADIUS)
        )
        clusters = pf.clusters(particles.position, particles.weights, radius * target.length)
    else:
        clusters = (pf.Cluster(particles.weights @ particles.position, 1.0, np.ones(len(particles), dtype=np.bool_)),)
    weights = np.where(clusters[0].members, particles.weights, 0.0)
    weights = weights / weights.sum()
    position = weights @ particles.position
    heading = pf.circular_mean(particles.heading, weights)
    spread = pf.weighted_covariance(particles.position, particles.weights if missed_frames else weights)
    std_m = float(np.sqrt(0.5 * np.trace(spread)))
    ground = position + footprint.AROUND, position[None], target.outline(position, heading), particles.position
    pixels = localiser.target_pixels(np.concatenate(ground))
    axes, centre, corners = footprint.jacobian_of(pixels[:4]), pixels[4], pixels[5:9]
    std = float(np.sqrt(0.5 * np.trace(axes @ spread @ axes.T)))
    state = TrackState.COASTING if missed_frames else TrackState.VISIBLE
    uninformative = std_m > LOST_STD * target.length or unseen_s > LOST_AFTER_S
    if missed_frames and (uninformative or not np.isfinite([*centre, std]).all()):
        state = TrackState.LOST
    size = corners.max(axis=0) - corners.min(axis=0)
    direction = axes @ np.array([np.cos(heading), np.sin(heading)])
    heading_known = target.aligned and np.isfinite(direction).all()
    common = Estimate(
        time=time,
        state=state,
        x=float(centre[0]),
        y=float(centre[1]),
        width=float(size[0]),
        height=float(size[1]),
        heading=float(np.arctan2(direction[1], direction[0])) if heading_known else float("nan"),
        std=std,
        ground_frame=(localiser.switches,),
        hypotheses=_hypotheses(clusters, localiser),
        particles=pixels[9:],
    )
    if state is TrackState.LOST:
        return replace(common, x=float("nan"), y=float("nan"), heading=float("nan"), hypotheses=())
    if not localiser.metric:
        return common
    course = float(np.arctan2(np.sin(heading), np.cos(heading))) if target.aligned else float("nan")
    speed = float(weights @ particles.speed)
    return replace(common, north=float(position[0]), east=float(position[1]), speed=speed, course=course, std_m=std_m)


def _hypotheses(clusters: tuple[pf.Cluster, ...], localiser: CameraLocaliser) -> tuple[Hypothesis, ...]:
    if len(clusters) < 2:
        return ()
    total = sum(cluster.weight for cluster in clusters)
    positions = localiser.target_pixels(np.array([cluster.centre for cluster in clusters]))
    return tuple(
        Hypothesis(cluster.weight / total, float(x), float(y))
        for cluster, (x, y) in zip(clusters, positions, strict=True)
    )
