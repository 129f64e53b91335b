"""Cameras that no pair connects to the others: found by resection against the path that the others have solved.

One scan over lags and clock rates per camera (`scan.find_time_map`) takes the place of searches of it
against every other one. It also finds a camera that recorded at another time than the pair from which the
reconstruction began, and times made with a wrong frame rate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from hub.bundle.initialisation import CameraInput, Reconstruction, place_cameras
from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import FreeParameters
from hub.calibration.resection.scan import find_time_map
from hub.clocks.clock_graph import ClockGraph, TimeMapEstimate
from hub.sync.hypothesis import PairSolution
from hub.sync.null_distribution import bandwidth
from hub.sync.pair_solver import FRAME_RATE_RATIOS, slow_motion_ratios
from hub.trajectory.image_tracks import SmoothTrack

RATES = (1.0, *FRAME_RATE_RATIOS)


def connect_by_resection(
    prepared: PreparedSession,
    reconstruction: Reconstruction,
    names: list[str],
    free_parameters: FreeParameters,
    adjust: Callable[[Reconstruction], Reconstruction],
    misfit: Callable[[Reconstruction, str], str],
) -> tuple[PreparedSession, Reconstruction, list[PairSolution], dict[str, str]]:
    """The session and reconstruction with those of the cameras ``names`` that the solved path places.

    adjust: the final adjustment. misfit: why a placed camera does not fit the others, "" if it does; then it is left
    out again. Returns also the pairs of the connected cameras with the placed ones, and the reasons of the others.
    """
    pairs: list[PairSolution] = []
    reasons: dict[str, str] = {}
    for name in names:
        motion = float(np.median([_bandwidth(prepared.camera(one)) for one in reconstruction.names]))
        rates = (*RATES, *slow_motion_ratios(_bandwidth(prepared.cameras[name]), motion))
        found, step = find_time_map(prepared.cameras[name], reconstruction, rates)
        reasons[name] = step
        if found is None:
            continue
        scaled = prepared
        if found.rate not in (1.0, *(camera.rate for camera in reconstruction.state.cameras)):
            scaled = prepared.with_time_scale([name], found.rate)
            found = TimeMapEstimate(1.0, found.offset, found.rate * found.centre)
        placed = dict(zip(reconstruction.names, reconstruction.state.cameras, strict=True))
        clocks = {one: TimeMapEstimate(state.rate, state.offset, state.centre) for one, state in placed.items()}
        anchors = tuple(reconstruction.names[i] for i in reconstruction.problem.anchors)
        trial, unplaced = place_cameras(
            scaled.cameras,
            ClockGraph(clocks | {name: found}, (), ()),
            scaled.rows,
            scaled.labels,
            placed,
            free_parameters,
            (anchors[0], anchors[1]),
        )
        if name in unplaced:
            reasons[name] = unplaced[name]
            continue
        trial = adjust(trial)
        reasons[name] = misfit(trial, name)
        if step and trial.names.index(name) not in (one.camera for one in trial.state.clock_steps):
            reasons[name] = f"{step}, but no step explains its rows ({reasons[name] or 'it fits without one'})"
        if not reasons[name]:
            del reasons[name]
            prepared, reconstruction = scaled, trial
            both = (sorted((other, name), key=prepared.names.index) for other in placed)
            pairs += [PairSolution(a, b, "ok") for a, b in both]
    return prepared, reconstruction, pairs, reasons


def listed(names: Iterable[str], most: int = 16) -> str:
    """The first of very many, as a message has room for."""
    every = list(names)
    return ", ".join(every[:most]) + (f" and {len(every) - most} more" if len(every) > most else "")


def _bandwidth(camera: CameraInput) -> float:
    """Of the fastest motion in a camera's tracks [Hz]."""
    return max((bandwidth(one) for one in camera.tracks.values() if isinstance(one, SmoothTrack)), default=0.0)
