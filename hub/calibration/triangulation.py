"""Triangulation of labelled points with a given calibration: poses, intrinsics and clocks are fixed.

It uses the trajectory model and adjustment of `calibrate` (a spline fitted to the raw rows, each at its own time), so
that cameras need not be synchronised and the std has the same meaning.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.adjustment import adjust
from hub.bundle.initialisation import Reconstruction, reconstruct_with_known_poses
from hub.bundle.preprocessing import PreparedSession, prepare
from hub.calibration.acceptance import larger_residuals, misfits
from hub.calibration.pairs.pair_network import Progress, coincide
from hub.calibration.result import trajectory_tables
from hub.clocks.clock_graph import ClockGraph, TimeMapEstimate
from protocols.core.clocks import CameraTime
from protocols.core.errors import Refused
from protocols.geometry.pose import OUR_CONVENTION, POSE_CONVENTIONS
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration, TrajectoryTable
from protocols.session.observations import Observations
from protocols.session.rig import METRES_PER_UNIT, Rig

_SOUND_M_S = 340.0  # at 1000 times its size, what walks, drives or flies is beyond it
_WAS_IT = "was it moved, or its clock set?"
_FEW, _ODD_GAIN, _ROWS_LEFT_OUT = 8, 1.3, 2000
"""Cameras, of which each is left out in turn: of more the path follows the many. Times by which the residuals of the
others become less, which of noisier detections are alike whichever is left out. And rows of a camera and label that
this is judged by, at about 0.2 ms each: more change no ratio of residuals."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangulation:
    """Trajectories on the reference clock, in the calibration's world and units.

    sigma_px: noise of one pixel coordinate by camera. unused: reasons by camera. unplaced: labels without trajectory.
    contradicted: cameras of which there are rows, and which do not fit.
    """

    tables: tuple[TrajectoryTable, ...]
    sigma_px: dict[str, float]
    unused: dict[str, str]
    unplaced: tuple[str, ...]
    warnings: tuple[str, ...]
    contradicted: tuple[str, ...] = ()


def triangulate(
    rig: Rig, known: Mapping[str, CameraCalibration], observations: Observations, progress: Progress | None = None
) -> Triangulation:
    """Trajectories of all labels that at least two cameras see.

    rig: of the calibration. known: its cameras. The std of a trajectory covers the noise of the observations, as
    estimated from the residuals, not the calibration's own errors. Raises Refused where there is no trajectory, or
    where the rows contradict the calibration; the reason names another convention of its poses in which they fit.
    """
    report = progress or (lambda text, share: None)
    try:
        return _triangulate(rig, known, observations, report)
    except Refused as refusal:
        meant = meant_convention(known, lambda others: len(_triangulate(rig, others, observations, report).sigma_px))
        refusal.reason = meant or refusal.reason
        raise


def _triangulate(
    rig: Rig, known: Mapping[str, CameraCalibration], observations: Observations, report: Progress
) -> Triangulation:
    report("smoothing the tracks", 0.1)
    lenses = {name: replace(rig.cameras[name], intrinsics=camera.intrinsics) for name, camera in known.items()}
    prepared = prepare(replace(rig, cameras=lenses), observations)
    apart = _unshared(prepared, known)
    # People walk from one camera's view to the next's, in which nobody was before.
    set_anew = {} if rig.metadata.get("target") == "person" else apart
    unused = dict(prepared.refused) | apart
    names = [name for name in prepared.cameras if name not in unused]
    while True:
        if len(names) < 2:
            refusal = Refused(_too_few_cameras(names, unused), unused)
            refusal.permanent = bool(set_anew)
            raise refusal
        if coincide(*(known[name].pose.position for name in names)):
            raise Refused(f"the cameras {', '.join(names)} are in one place: their rays meet nowhere else", unused)
        report("adjusting the trajectories", 0.4)
        reconstruction = _reconstruct(prepared, known, names)
        failures = misfits(reconstruction)
        if not failures:
            break
        if len(reconstruction.names) == 2:
            residuals = ", ".join(f"{name} {sigma:.1f} px" for name, sigma in _sigmas(reconstruction).items())
            what = f"the rows contradict the calibration (typical residual: {residuals})"
            refusal = Refused(f"{what}: a camera was moved, or its clock was set; calibrate this session", unused)
            refusal.permanent = True
            raise refusal
        # Of three and more, the camera that fits worst is removed, and the trajectories are estimated without it.
        odd = _odd_one(prepared, known, reconstruction) or {failures[0][0]: failures[0][1].reason}
        unused |= {name: f"{reason}: {_WAS_IT}" for name, reason in odd.items()}
        names = [name for name in names if name not in odd]
    report("covariances", 0.8)
    tables = _on_reference_clock(rig, prepared, known, reconstruction)
    if not any(len(table.time) for table in tables):
        raise Refused("no label is seen by two cameras within 0.2 s of each other", unused)
    sigmas = _sigmas(reconstruction)
    warnings = [*prepared.warnings, *unlikely_speed(rig.metadata.get("scale", "metric"), rig.units, tables)]
    larger = {
        name: f"residuals of {sigma:.1f} px, {calibrated_rms:.1f} px when it was calibrated"
        for name, (sigma, calibrated_rms) in larger_residuals(reconstruction, known).items()
    }
    odd = _odd_one(prepared, known, reconstruction) if larger else {}
    warnings += [f"{name}: {why}: {_WAS_IT}" for name, why in (odd or larger).items()]
    triangulated = {table.label for table in tables if len(table.time)}
    return Triangulation(
        tuple(table for table in tables if len(table.time)),
        sigmas,
        unused,
        tuple(label for label in observations.labels if label not in triangulated),
        tuple(warnings),
        tuple(name for name in unused if name in set_anew or name not in {**prepared.refused, **apart}),
    )


def meant_convention(
    known: Mapping[str, CameraCalibration], fitting: Callable[[dict[str, CameraCalibration]], int]
) -> str:
    """The convention of poses in which a calibration fits the rows that contradict it, as a reason; empty: in none.

    fitting: the number of cameras that fit with the given ones; it may raise Refused.
    """
    for convention, pose_of in POSE_CONVENTIONS.items():
        others = {name: replace(camera, pose=pose_of(camera.pose)) for name, camera in known.items()}
        with suppress(Refused):
            count = fitting(others)
            if 2 * count > len(known):  # two may fit by chance
                return f"the rows fit {count} cameras if in the calibration {convention}; {OUR_CONVENTION}"
    return ""


def unlikely_speed(scale: str, units: str, tables: tuple[TrajectoryTable, ...]) -> tuple[str, ...]:
    """A warning where what moves is faster than sound by a given calibration's scale and units."""
    if scale != "metric":
        return ()
    speeds = [np.linalg.norm(np.diff(one.position, axis=0), axis=1) / np.diff(one.time) for one in tables]
    typical = METRES_PER_UNIT[units] * float(np.median(np.concatenate([np.zeros(1), *speeds])))
    if typical < _SOUND_M_S:
        return ()
    return (f"it moves at {typical:.3g} m/s as a rule: the calibration's positions seem not to be in {units}",)


def _reconstruct(prepared: PreparedSession, known: Mapping[str, CameraCalibration], names: list[str]) -> Reconstruction:
    """All trajectories from the given cameras, adjusted. Raises Refused without any."""
    cameras = {name: prepared.cameras[name] for name in names}
    poses = {name: known[name].pose for name in names}
    graph = ClockGraph(_time_maps(prepared, known, names), (), ())
    reconstruction = reconstruct_with_known_poses(cameras, graph, prepared.rows, prepared.labels, poses, clock=False)
    problem, state, _ = adjust(reconstruction.problem, reconstruction.state)
    return Reconstruction(reconstruction.names, reconstruction.labels, problem, state)


def _odd_one(
    prepared: PreparedSession, known: Mapping[str, CameraCalibration], found: Reconstruction
) -> dict[str, str]:
    """Of a few cameras, the one without which the others fit far better than with it, and this as the reason.

    found: of all of them. Its own misfit may be less than theirs: the path follows whichever has most rows. Residuals
    are in units of those when it was calibrated, as some are noisier than others. Empty where no one stands out.
    """
    step = 1 + max(len(one.time) for rows in prepared.rows.values() for one in rows) // _ROWS_LEFT_OUT
    thinned = replace(prepared, rows={name: [one.every(step) for one in rows] for name, rows in prepared.rows.items()})
    without = {}
    for name in found.names if 2 < len(found.names) <= _FEW else ():
        with suppress(Refused):
            without[name] = _sigmas(_reconstruct(thinned, known, [other for other in found.names if other != name]))
    if len(without) < len(found.names):
        return {}
    before = {name: known[name].rms_px for name in found.names}
    units = before if min(before.values()) > 0.0 else dict.fromkeys(before, 1.0)
    excess = {name: float(np.mean([rest[one] / units[one] for one in rest])) for name, rest in without.items()}
    odd, other, *_ = sorted(excess, key=excess.__getitem__)
    less, more = (float(np.mean([one[name] for name in without[odd]])) for one in (without[odd], _sigmas(found)))
    reason = f"the others fit to {less:.1f} px without it, to {more:.1f} px with it"
    return {odd: reason} if excess[other] > _ODD_GAIN * excess[odd] else {}


def _time_maps(
    prepared: PreparedSession, known: Mapping[str, CameraCalibration], names: list[str]
) -> dict[str, TimeMapEstimate]:
    """The given time maps, from each camera's time since its origin to the reference time since the first row.

    Reference times may be Unix times: relative to a common start, floats resolve far less than a microsecond.
    """
    if prepared.shared_clock:
        return {name: TimeMapEstimate(1.0, 0.0, 0.0) for name in names}
    starts = {
        name: known[name].time_map.reference_from_camera(CameraTime(prepared.time_origins[name])) for name in names
    }
    common_start = min(starts.values(), default=0.0)
    clocks = {}
    for name in names:
        times = np.concatenate([part.time for part in prepared.rows[name]])
        centre = float(0.5 * (times.min() + times.max()))
        rate = known[name].time_map.clock_rate
        clocks[name] = TimeMapEstimate(rate, starts[name] - common_start + rate * centre, centre)
    return clocks


def _unshared(prepared: PreparedSession, known: Mapping[str, CameraCalibration]) -> dict[str, str]:
    """Cameras that, by the given clocks, share no time with any other, and this as the reason."""
    spans = {}
    for name, clock in _time_maps(prepared, known, list(prepared.cameras)).items():
        times = [time for part in prepared.rows[name] for time in (part.time.min(), part.time.max())]
        spans[name] = [clock.rate * (time - clock.centre) + clock.offset for time in (min(times), max(times))]
    reason = "by the calibration's clocks it shares no time with another camera: was its clock set anew?"
    return {
        name: reason
        for name, (first, last) in spans.items()
        if not any(first <= end and begin <= last for other, (begin, end) in spans.items() if other != name)
    }


def _on_reference_clock(
    rig: Rig, prepared: PreparedSession, known: Mapping[str, CameraCalibration], reconstruction: Reconstruction
) -> tuple[TrajectoryTable, ...]:
    """Trajectory tables as of `calibrate`, sampled on the reference camera's clock or, without it, another camera's."""
    requested = rig.metadata.get("reference")
    clock_camera = requested if requested in reconstruction.names else reconstruction.names[0]
    tables = trajectory_tables(rig, prepared, reconstruction, clock_camera)
    if prepared.shared_clock:
        return tables
    time_map = known[clock_camera].time_map
    return tuple(
        replace(table, time=np.asarray(time_map.clock_rate * table.time + time_map.time_offset)) for table in tables
    )


def _sigmas(reconstruction: Reconstruction) -> dict[str, float]:
    sigma: Floats = reconstruction.state.sigma
    return {name: float(value) for name, value in zip(reconstruction.names, sigma, strict=True)}


def _too_few_cameras(names: list[str], unused: dict[str, str]) -> str:
    residuals = "; ".join(f"{name}: {reason}" for name, reason in unused.items())
    return (
        f"fewer than two cameras can be used ({residuals})"
        if residuals
        else f"only {', '.join(names) or 'no camera'} has rows"
    )
