"""Targets predicted in time: white acceleration, and white velocity for steps and sway."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.tracking.filter import kalman
from hub.tracking.filter.detection_model import CORRELATION_S
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import VELOCITY
from hub.tracking.filter.manoeuvre import units_of
from hub.tracking.filter.target_models import TARGET_MODELS, UPRIGHT
from hub.tracking.filter.target_states import Targets
from hub.tracking.parameters import TrackerParameters
from protocols.geometry.types import Floats

_LOG_SIZE_PSD = 1e-4  # 1/s: the size may drift by 1 % in a second, 8 % in a minute
_WALKING_M_S, _STANDING_SHARE = 0.4, 0.05
"""Turning and swaying grow with speed: somebody who stands has this share of a walker's acceleration (variance)."""
_RUNNING_M_S, _SPRINT_M_S = 2.0, 7.0  # from walking becoming running (Hreljac 1993: 2.07 m/s) to sprints they grow on
_ACCELERATION_PSD, _VELOCITY_PSD = np.array([(model.acceleration_psd, model.velocity_psd) for model in TARGET_MODELS]).T


def predict_targets(targets: Targets, elapsed: Floats | float, parameters: TrackerParameters) -> Targets:
    """The targets predicted by ``elapsed`` seconds, each (n,) or all."""
    if not len(targets) or not np.any(elapsed):
        return targets
    units_per_m = units_of(targets, parameters.scale.units_per_m)
    speed = np.linalg.norm(targets.mean[:, VELOCITY], axis=1) / units_per_m
    most = np.clip(speed / _RUNNING_M_S, 1.0, _SPRINT_M_S / _RUNNING_M_S) ** 2
    share = np.clip((speed / _WALKING_M_S) ** 2, _STANDING_SHARE, most)
    share = np.where(UPRIGHT[targets.kind], share, 1.0)
    acceleration_psd, velocity_psd = (
        psd[targets.kind] * units_per_m**2 * share for psd in (_ACCELERATION_PSD, _VELOCITY_PSD)
    )
    mean, covariance = kalman.predict(
        targets.mean, targets.covariance, elapsed, acceleration_psd, _LOG_SIZE_PSD, velocity_psd
    )
    existence = targets.existence * np.exp(-np.maximum(elapsed, 0.0) / parameters.lifetime_s)
    return replace(targets, mean=mean, covariance=covariance, existence=existence)


def on_floor(targets: Targets, floor: Floor | None, elapsed: Floats | float) -> Targets:
    """Upright targets with their feet on the floor, where it is known; ``elapsed`` (n,) or all, since the last time."""
    elapsed = np.broadcast_to(elapsed, (len(targets),))
    standing = np.flatnonzero(UPRIGHT[targets.kind] & (elapsed > 0.0))
    if floor is None or not floor.known or not len(standing):
        return targets
    mean, covariance = targets.mean.copy(), targets.covariance.copy()
    innovation, jacobian, variance = floor.constraint(mean[standing])
    # What is uneven under somebody's foot now is so a moment later: half a second is one observation.
    noise = variance * np.maximum(CORRELATION_S / elapsed[standing], 1.0)
    cross = (covariance[standing] @ jacobian[:, :, None])[:, :, 0]
    gain = cross / ((jacobian * cross).sum(axis=1) + noise)[:, None]
    mean[standing] += gain * innovation[:, None]
    covariance[standing] -= gain[:, :, None] * cross[:, None]
    return replace(targets, mean=mean, covariance=covariance)
