"""What the tracker says of a frame: state, densest cluster of the cloud, its spread, and the other clusters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.uav.ground.localisation import Placing
from edge.uav.prediction import particles as pf
from edge.uav.prediction.particle_set import Cloud
from edge.uav.target import footprint
from edge.uav.target.target import Target
from edge.uav.tracker import Estimate, Hypothesis, State

_LOST_STD = 8.0  # in target lengths
_LOST_AFTER_S = 15.0
_CLUSTER, _WIDEST = 0.7, 2.0  # radius of what counts as one place, in target lengths
_SMOOTH = 0.7  # the same over the cloud's std


def answer(cloud: Cloud, target: Target, placing: Placing, missed: int, time: float, unseen: float) -> Estimate:
    """The estimate of a frame, without layers. missed: frames in a row without the target; unseen: seconds."""
    groups: tuple[pf.Cluster, ...]
    if missed:
        # What is spread wide has no fine structure but the sample's own.
        wide = pf.weighted_covariance(cloud.place, cloud.weights)
        radius = float(np.clip(_SMOOTH * np.sqrt(0.5 * np.trace(wide)) / target.length, _CLUSTER, _WIDEST))
        groups = pf.clusters(cloud.place, cloud.weights, radius * target.length)
    else:
        groups = (pf.Cluster(cloud.weights @ cloud.place, 1.0, np.ones(len(cloud), dtype=np.bool_)),)
    weights = np.where(groups[0].members, cloud.weights, 0.0)
    weights = weights / weights.sum()
    place = weights @ cloud.place
    heading = pf.circular_mean(cloud.heading, weights)
    spread = pf.weighted_covariance(cloud.place, cloud.weights if missed else weights)
    std_m = float(np.sqrt(0.5 * np.trace(spread)))
    axes = footprint.local_axes(placing.plane, placing.body_matrix, place)
    std = float(np.sqrt(0.5 * np.trace(axes @ spread @ axes.T)))
    centre = placing.body_pixels(place[None])[0]
    state = State.COASTING if missed else State.VISIBLE
    useless = std_m > _LOST_STD * target.length or unseen > _LOST_AFTER_S
    if missed and (useless or not np.isfinite([*centre, std]).all()):
        state = State.LOST
    corners = placing.body_pixels(target.outline(place, heading))
    size = corners.max(axis=0) - corners.min(axis=0)
    ahead = axes @ np.array([np.cos(heading), np.sin(heading)])
    moving = target.aligned and np.isfinite(ahead).all()
    common = Estimate(
        time=time,
        state=state,
        x=float(centre[0]),
        y=float(centre[1]),
        width=float(size[0]),
        height=float(size[1]),
        heading=float(np.arctan2(ahead[1], ahead[0])) if moving else float("nan"),
        std=std,
        hypotheses=_hypotheses(groups, placing),
        particles=placing.body_pixels(cloud.place),
    )
    if state is State.LOST:
        return replace(common, x=float("nan"), y=float("nan"), heading=float("nan"), hypotheses=())
    if not placing.metric:
        return common
    course = float(np.arctan2(np.sin(heading), np.cos(heading))) if target.aligned else float("nan")
    speed = float(weights @ cloud.speed)
    return replace(common, north=float(place[0]), east=float(place[1]), speed=speed, course=course, std_m=std_m)


def _hypotheses(groups: tuple[pf.Cluster, ...], placing: Placing) -> tuple[Hypothesis, ...]:
    if len(groups) < 2:
        return ()
    total = sum(group.weight for group in groups)
    places = placing.body_pixels(np.array([group.centre for group in groups]))
    return tuple(
        Hypothesis(group.weight / total, float(x), float(y)) for group, (x, y) in zip(groups, places, strict=True)
    )
