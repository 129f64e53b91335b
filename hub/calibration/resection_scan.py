"""Lag of one camera against a known trajectory: resection at every lag, where a common clock bounds the right one.

A trajectory in 3-D says more about a camera than its pairs do: also motion in one plane, or of which each other camera
saw a part, determines its pose. But resection has six free parameters at every lag, so a wrong one may fit a short or
smooth motion. Therefore the best of all lags must also be the one that the times of arrival (or NTP, PTP) imply: two
independent sources agree, and neither a wrong arrival nor a wrong fit alone gives a wrong lag.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hub.bundle.initialisation import CameraInput, Reconstruction
from hub.bundle.problem import CameraState
from hub.clocks.clock_graph import TimeMapEstimate
from hub.trajectory.image_tracks import ImageTrack, SmoothTrack
from protocols.geometry.types import Floats

_SAMPLES = 80
"""Points of a track, evenly along its path in the image: where the target rests, more of them tell nothing."""
_MIN_POINTS = 16
_STEP_S = 0.1
_FINE_STEPS = 5
_TRUNCATION_PX = 20.0
"""Residual from which a point counts as not explained; so does one outside the trajectory."""
_MIN_EXPLAINED = 0.3
_DISTINCT_S = 0.5
_MIN_COST_RATIO = 1.1
"""Cost of the next best lag over the best one's."""


def scan_resection(
    camera: CameraInput, reconstruction: Reconstruction, expected: TimeMapEstimate, window: float
) -> tuple[TimeMapEstimate | None, str]:
    """The camera's time map if one lag explains its track by far best and agrees with the expected one; else why not.

    expected: time map onto the reconstruction's internal time by a common clock, right within ``window`` [s].
    """
    tracks = [
        (number, track)
        for number, label in enumerate(reconstruction.labels)
        if isinstance(track := camera.tracks.get(label), SmoothTrack)
    ]
    samples = [(number, *_along_path(track)) for number, track in tracks]
    if not samples:
        return None, "no label that the others saw"
    state = CameraState(
        camera.intrinsics, reconstruction.state.cameras[0].pose, expected.rate, expected.offset, expected.centre
    )
    begin = min(path.basis.begin for path in reconstruction.state.trajectories)
    end = max(path.basis.end for path in reconstruction.state.trajectories)
    own = np.concatenate([state.reference_time(time) for _, time, _ in samples])
    lags = np.arange(np.ceil((begin - own.max()) / _STEP_S), np.floor((end - own.min()) / _STEP_S) + 1) * _STEP_S
    focal = camera.intrinsics.focal
    costs = np.array([_cost(samples, reconstruction, state, lag, focal) for lag in lags])
    if not len(costs) or not np.isfinite(costs).any():
        return None, "too little seen together with the other cameras"
    fine, best = float(lags[int(np.argmin(costs))]), float(costs.min())
    for step in (_STEP_S / _FINE_STEPS, _STEP_S / _FINE_STEPS**2):
        near = fine + step * np.arange(1 - _FINE_STEPS, _FINE_STEPS)
        near_costs = [_cost(samples, reconstruction, state, lag, focal) for lag in near]
        fine, best = float(near[int(np.argmin(near_costs))]), min(best, float(np.min(near_costs)))
    if best > (1.0 - _MIN_EXPLAINED) * _TRUNCATION_PX**2:
        return None, "its view of the trajectory agrees with no lag yet"
    other = float(costs[np.abs(lags - fine) > _DISTINCT_S].min(initial=np.inf))
    if abs(fine) > window:
        return None, "the lag that fits best is not the one of the arrival times"
    if other < _MIN_COST_RATIO * best:
        return None, f"another lag fits nearly as well (cost ratio {other / max(best, 1e-9):.1f})"
    return replace(expected, offset=expected.offset + fine), ""


def _along_path(track: ImageTrack) -> tuple[Floats, Floats]:
    """Times (m,) and normalised points (m, 2) evenly along the track's path in the image."""
    steps = np.linalg.norm(np.diff(track.points, axis=0), axis=1)
    steps = np.minimum(steps, 3.0 * float(np.median(steps)) + 1e-12)  # false detections are long jumps
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], _SAMPLES))
    index = np.unique(np.clip(at, 0, len(travelled) - 1))
    return track.time[index], track.points[index]


def _cost(
    samples: list[tuple[int, Floats, Floats]],
    reconstruction: Reconstruction,
    state: CameraState,
    lag: float,
    focal: float,
) -> float:
    """Mean truncated squared residual [px²] of the best pose at a lag; inf without enough points."""
    world, image, count = [], [], 0
    for number, time, points in samples:
        where = reconstruction.state.trajectories[number].at(state.reference_time(time) + lag)
        good = np.isfinite(where).all(axis=1)
        world.append(where[good])
        image.append(points[good])
        count += len(time)
    positions, seen = np.concatenate(world), np.concatenate(image)
    if len(positions) < _MIN_POINTS:
        return float("inf")
    try:
        found, rotation, shift = cv2.solvePnP(positions, seen, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # all points in one place
        found = False
    if not found:
        return float("inf")
    local = positions @ cv2.Rodrigues(rotation)[0].T + shift.ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = focal * np.linalg.norm(local[:, :2] / local[:, 2:] - seen, axis=1)
    residual = np.where((local[:, 2] > 0) & np.isfinite(residual), residual, np.inf)
    explained = np.minimum(residual, _TRUNCATION_PX) ** 2
    return float((explained.sum() + (count - len(positions)) * _TRUNCATION_PX**2) / count)
