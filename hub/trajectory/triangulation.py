"""3-D of labelled points with a calibration that is given: poses, lenses and clocks stay, only paths are sought.

The same paths and the same adjustment as `calibrate` (a spline through the raw rows, every row at its own time), so
that cameras need not fire together and std means the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.adjustment import adjust
from hub.calibration.clock_graph import ClockGraph, ClockGuess
from hub.calibration.initialisation import Scaffold, agreement, place_known
from hub.calibration.pair_network import Progress
from hub.calibration.preprocessing import Prepared, prepare
from hub.calibration.result import path_tables
from protocols.core.clocks import CameraTime
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration, TrajectoryTable
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_LEAST_AGREEMENT = 0.5  # share of a camera's rows that must fit the paths
_COARSE = 0.015  # of the image's width: rows that miss by more were not filmed with this calibration
_WORSE, _LEAST_PX = 4.0, 2.0  # times the calibration's rms; px: from here on it is told


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """Paths on the reference clock, in the calibration's world and units.

    sigma_px: noise of one pixel coordinate by camera. unused: reasons by camera. unplaced: labels without any path.
    """

    tables: tuple[TrajectoryTable, ...]
    sigma_px: dict[str, float]
    unused: dict[str, str]
    unplaced: tuple[str, ...]
    warnings: tuple[str, ...]


def triangulate(
    rig: Rig, known: Mapping[str, CameraCalibration], observations: Observations, progress: Progress | None = None
) -> Triangulated:
    """Paths of all labels that two cameras see.

    rig: of the calibration. known: its cameras. The std of a path counts the noise of the observations, as the
    residuals show it, not the calibration's own errors. Raises Refused where there is no path, or where
    the rows contradict the calibration.
    """
    tell = progress or (lambda text, share: None)
    tell("smoothing the tracks", 0.1)
    lenses = {name: replace(rig.cameras[name], intrinsics=camera.intrinsics) for name, camera in known.items()}
    prepared = prepare(replace(rig, cameras=lenses), observations)
    unused = dict(prepared.refused)
    names = list(prepared.cameras)
    while True:
        if len(names) < 2:
            raise Refused(_why_nothing(names, unused), unused)
        tell("adjusting the paths", 0.4)
        scaffold = _paths(prepared, known, names)
        worst = min(scaffold.names, key=lambda name: agreement(scaffold, name)[0])
        share, count = agreement(scaffold, worst)
        coarse = [name for name, sigma in _sigmas(scaffold).items() if sigma > _COARSE * known[name].intrinsics.width]
        if share >= _LEAST_AGREEMENT and not coarse:
            break
        if len(scaffold.names) == 2:
            told = ", ".join(f"{name} {sigma:.1f} px" for name, sigma in _sigmas(scaffold).items())
            what = f"the rows contradict the calibration (typical residual: {told})"
            raise Refused(f"{what}: a camera was moved, or its clock set anew; calibrate this session", unused)
        # Of three and more, the one that fits worst goes, and what it may have spoilt is made again without it.
        unused[worst] = f"only {100 * share:.0f} % of its {count} rows fit the paths of the others: was it moved?"
        names = [name for name in names if name != worst]
    tell("covariances", 0.8)
    tables = _on_reference_clock(rig, prepared, known, scaffold)
    if not any(len(table.time) for table in tables):
        raise Refused("no label is seen by two cameras within 0.2 s of each other", unused)
    sigmas = _sigmas(scaffold)
    warnings = list(prepared.warnings)
    for name, sigma in sigmas.items():
        before = known[name].rms_px
        if before > 0 and sigma > max(_WORSE * before, _LEAST_PX):
            warnings.append(f"{name}: residuals of {sigma:.1f} px, {before:.1f} px when it was calibrated")
    have = {table.label for table in tables if len(table.time)}
    return Triangulated(
        tuple(table for table in tables if len(table.time)),
        sigmas,
        unused,
        tuple(label for label in observations.labels if label not in have),
        tuple(warnings),
    )


def _paths(prepared: Prepared, known: Mapping[str, CameraCalibration], names: list[str]) -> Scaffold:
    """All paths from the given cameras, adjusted. Raises Refused without any."""
    cameras = {name: prepared.cameras[name] for name in names}
    poses = {name: known[name].pose for name in names}
    graph = ClockGraph(_clocks(prepared, known, names), (), ())
    scaffold = place_known(cameras, graph, prepared.rows, prepared.labels, poses, clock=False)
    problem, state, _ = adjust(scaffold.problem, scaffold.state)
    return Scaffold(scaffold.names, scaffold.labels, problem, state)


def _clocks(prepared: Prepared, known: Mapping[str, CameraCalibration], names: list[str]) -> dict[str, ClockGuess]:
    """The given time maps, from each camera's time less its epoch to the reference time less that of the first row.

    Reference times may be Unix times: less a common start, floats tell them to far below a microsecond.
    """
    if prepared.shared_clock:
        return {name: ClockGuess(1.0, 0.0, 0.0) for name in names}
    starts = {name: known[name].time_map.reference_from_camera(CameraTime(prepared.epochs[name])) for name in names}
    begin = min(starts.values())
    clocks = {}
    for name in names:
        times = np.concatenate([part.time for part in prepared.rows[name]])
        centre = float(0.5 * (times.min() + times.max()))
        rate = known[name].time_map.clock_rate
        clocks[name] = ClockGuess(rate, starts[name] - begin + rate * centre, centre)
    return clocks


def _on_reference_clock(
    rig: Rig, prepared: Prepared, known: Mapping[str, CameraCalibration], scaffold: Scaffold
) -> tuple[TrajectoryTable, ...]:
    """Paths as `calibrate` publishes them, sampled on the reference camera's clock or, without it, another's."""
    wanted = rig.metadata.get("reference")
    base = wanted if wanted in scaffold.names else scaffold.names[0]
    tables = path_tables(rig, prepared, scaffold, base)
    if prepared.shared_clock:
        return tables
    time_map = known[base].time_map
    return tuple(
        replace(table, time=np.asarray(time_map.clock_rate * table.time + time_map.time_offset)) for table in tables
    )


def _sigmas(scaffold: Scaffold) -> dict[str, float]:
    sigma: Floats = scaffold.state.sigma
    return {name: float(value) for name, value in zip(scaffold.names, sigma, strict=True)}


def _why_nothing(names: list[str], unused: dict[str, str]) -> str:
    told = "; ".join(f"{name}: {reason}" for name, reason in unused.items())
    return (
        f"fewer than two cameras can be used ({told})" if told else f"only {', '.join(names) or 'no camera'} has rows"
    )
