"""Calibration of a session whose labelled points lie on rigid bodies of known geometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.preprocessing import nominal_intrinsics
from hub.bundle.problem import Column
from hub.calibration.rigid_body.adjustment import adjust_bodies, body_covariance
from hub.calibration.rigid_body.problem import BodyProblem, BodyState, frame_interval, initial_jitter, initial_shape
from hub.calibration.rigid_body.result import BodySolution, publish
from hub.calibration.rigid_body.start import initial_lens, largest_group, orient_views, solve_body_pairs, start_bodies
from hub.calibration.rigid_body.views import CameraViews, body_labels, gather_views, thinned, view_poses
from protocols.core.acceptance import PairReport
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.session.calibration import Calibration, FixedCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

Progress = Callable[[str, float], None]
MAX_BOARD_FOCAL_STD = 0.05
"""Largest relative std of a focal length that the board determines; above it the camera is refused."""
_MAX_ROTATION_STD, _MAX_CLOCK_FRAMES = 0.05, 0.5  # rad; frame intervals
_MIN_INLIERS, _MIN_VIEWS = 0.5, 3  # half of the views must agree; three views determine a pose and its check
_MIN_SHAPE_POINTS = 6  # of a board: fewer are taken as described
_SIGMA_START = 1.0  # px


@dataclass(frozen=True, slots=True, eq=False)
class _Input:
    """Usable cameras by name, and why the others are not."""

    rig: Rig
    labels: list[str]
    views: dict[str, CameraViews]
    lenses: dict[str, Intrinsics]
    free_lens: dict[str, bool]
    refused: dict[str, str]
    known: FixedCalibration | None


def calibrate_bodies(
    rig: Rig, observations: Observations, report: Progress, known: FixedCalibration | None = None
) -> Calibration:
    """Clocks, poses and unknown lenses of all cameras from the rigid bodies that they saw.

    known: given intrinsics and poses; only clocks and the bodies' motion are estimated then. Raises Refused, with a
    reason for every camera, where fewer than two cameras can be placed.
    """
    given = _prepare(rig, observations, known)
    if len(given.views) < 2:
        raise Refused(
            f"fewer than two cameras saw the board well enough ({_listed(given.refused) or 'one camera only'}); "
            "show the board to two cameras or more at the same time",
            given.refused,
        )
    solution = _solve(given, report, rig.shared_clock)
    if not rig.shared_clock and rig.metadata.get("in_step") is True and _is_in_step(solution):
        solution = _in_step(given, solution, report)
    report("covariances", 0.95)
    return publish(rig, solution)


def _prepare(rig: Rig, observations: Observations, known: FixedCalibration | None) -> _Input:
    labels = body_labels(observations, rig.bodies)
    refused: dict[str, str] = {}
    views: dict[str, CameraViews] = {}
    lenses: dict[str, Intrinsics] = {}
    free: dict[str, bool] = {}
    for name, camera in rig.cameras.items():
        tracks = observations.of_camera(name)
        start = min((float(track.time[0]) for track in observations.tracks.values() if len(track)), default=0.0)
        origin = start if rig.shared_clock else min((float(track.time[0]) for track in tracks), default=0.0)
        seen = gather_views(name, tracks, rig.bodies, labels, origin)
        if seen is None or len(seen.time) < _MIN_VIEWS:
            count = 0 if seen is None else len(seen.time)
            refused[name] = f"the board is found in {f'only {count}' if count else 'none'} of its frames"
            continue
        if known is not None and name not in known.cameras:
            refused[name] = "not in the known calibration"
            continue
        unknown = not camera.is_measured
        lens = camera.intrinsics
        if unknown:
            found = initial_lens(seen, camera.size)
            if found is None and lens is None:
                refused[name] = (
                    "no intrinsics, and the board is too rarely seen as a whole to estimate them: show more of it, "
                    "or run `syncline intrinsics`"
                )
                continue
            lens = found[0] if found is not None else lens
        views[name], lenses[name], free[name] = seen, lens or nominal_intrinsics(camera), unknown
    kept = dict(zip(views, thinned(list(views.values())), strict=True))
    return _Input(rig, labels, kept, lenses, free, refused, known)


def _solve(given: _Input, report: Progress, shared_clock: bool) -> BodySolution:
    """Pairs, cameras and the adjustment; cameras that do not fit are refused one by one."""
    report("the board's poses", 0.05)
    poses = {name: view_poses(one, given.lenses[name]) for name, one in given.views.items()}
    report("lags", 0.2)
    if given.rig.metadata.get("bodies_symmetric") is True:
        given = replace(given, views=orient_views(given.views, poses, given.lenses, shared_clock))
        poses = {name: view_poses(one, given.lenses[name]) for name, one in given.views.items()}
    pairs = solve_body_pairs(poses, shared_clock)
    refused = dict(given.refused)
    names = list(given.views)
    while True:
        group = largest_group(names, pairs)
        for name in names:
            if name not in group:
                refused[name] = "; ".join(
                    f"with {b if a == name else a}: {pair.reason}"
                    for (a, b), pair in pairs.items()
                    if name in (a, b) and pair.reason
                )
        if len(group) < 2:
            raise Refused(
                f"no two cameras could be connected by the board's motion ({_listed(refused)})",
                refused,
                pairs=tuple(PairReport(pair, found.reason or "ok") for pair, found in pairs.items()),
            )
        names = list(group)
        if given.known is not None:
            group = {name: (group[name][0], given.known.cameras[name].pose) for name in group}
        readouts = {name: given.rig.cameras[name].readout or 0.0 for name in names}
        start = start_bodies(group, given.views, given.lenses, poses, len(given.rig.bodies), shared_clock, readouts)
        views = tuple(given.views[name] for name in names)
        problem = BodyProblem(
            views,
            tuple(given.lenses[name] for name in names),
            tuple(given.free_lens[name] for name in names),
            tuple(given.known is not None for _ in names),
            0,
            not shared_clock,
            # Rolling shutters bend what is seen of a moving board, as unknown lenses do.
            tuple(given.rig.cameras[name].readout is None for name in names),
            tuple(np.ones(len(one.view), dtype=np.bool_) for one in views),
            len(given.rig.bodies) == 1 and len(given.labels) >= _MIN_SHAPE_POINTS,
        )
        shape, shape_std = initial_shape(problem, len(given.labels))
        state = BodyState(
            tuple(start.cameras[name] for name in names),
            start.bodies,
            tuple(np.zeros(len(one.time)) for one in views),
            np.full(len(names), _SIGMA_START),
            initial_jitter(problem),
            shape,
            shape_std,
        )
        report("adjusting", 0.5)
        problem, state = adjust_bodies(problem, state)
        solution = BodySolution(given.labels, names, problem, state, pairs, refused, given.known)
        worst, reason = _unacceptable(solution)
        if not reason:
            return solution
        refused[worst] = reason
        names = [name for name in names if name != worst]
        pairs = {pair: found for pair, found in pairs.items() if worst not in pair}
        if len(names) < 2:
            raise Refused(f"no two cameras can be placed ({worst}: {reason})", refused)


def _unacceptable(solution: BodySolution) -> tuple[str, str]:
    """A camera that does not fit, or is not determined well enough, and why; "" if there is none."""
    problem, state, names = solution.problem, solution.state, solution.names
    shares = [float(use.mean()) for use in problem.use]
    worst = int(np.argmin(shares))
    if shares[worst] < _MIN_INLIERS:
        return names[worst], f"only {100 * shares[worst]:.0f} % of its corners fit the board that the others saw"
    covariance = body_covariance(problem, state)
    for camera, name in enumerate(names):
        std = covariance.std(camera, Column.FOCAL)
        if problem.free_lens[camera] and not std <= MAX_BOARD_FOCAL_STD:
            return name, (
                f"the board determines its focal length only to {100 * std:.0f} % (std): tilt the board towards it, "
                "near and far"
            )
        turn = max(covariance.std(camera, column) for column in range(3))
        if not turn <= _MAX_ROTATION_STD:
            return name, f"the board determines its orientation only to {np.degrees(turn):.1f}° (std)"
        clock = covariance.std(camera, Column.OFFSET)
        limit = _MAX_CLOCK_FRAMES * frame_interval(problem.views[camera])
        if problem.clock and not clock <= limit:
            return name, f"the board's motion determines its clock only to {1e3 * clock:.0f} ms (std): move it faster"
    return "", ""


def _is_in_step(solution: BodySolution) -> bool:
    """Whether clips with the same stamps were written frame by frame by one recorder, as far as the motion can tell.

    A recorder takes the latest image of each camera: the image's age, and with it the frame's time error, is uniform
    over the camera's own frame interval, which is thus sqrt(12) times its std. Between cameras that were read together
    no lag is larger than the longer of their intervals, within three stds of the lag. Frames of free-running cameras
    come evenly: their time errors, and the lags that pass, are next to nothing.
    """
    problem, state = solution.problem, solution.state
    covariance = body_covariance(problem, state)
    interval = np.sqrt(12.0) * state.jitter
    lags = np.abs(np.array(list(_stamp_lags(solution).values())))
    stds = np.array([covariance.std(camera, Column.OFFSET) for camera in range(len(lags))])
    return bool((lags <= np.maximum(interval, interval[problem.reference]) + 3.0 * stds).all())


def _stamp_lags(solution: BodySolution) -> dict[str, float]:
    """By camera: exposure in the reference camera's time less the time stamp [s], in the middle of the span."""
    base = solution.problem.views[solution.problem.reference].time_origin
    return {
        name: camera.offset + base - (camera.centre + views.time_origin)
        for name, camera, views in zip(solution.names, solution.state.cameras, solution.problem.views, strict=True)
    }


def _in_step(given: _Input, free: BodySolution, report: Progress) -> BodySolution:
    """The solution with one instant a frame, at the lenses that the free one found."""
    views = {}
    start = min(one.time_origin for one in given.views.values())
    lenses = {name: camera.intrinsics for name, camera in zip(free.names, free.state.cameras, strict=True)}
    for name, one in given.views.items():
        if name in lenses:
            views[name] = replace(one, time=one.time + (one.time_origin - start), time_origin=start)
    still = dict.fromkeys(views, False)
    fixed = replace(given, views=views, lenses=lenses, free_lens=still, refused=free.refused)
    solution = _solve(fixed, report, True)
    lags = _stamp_lags(free)
    covariance = body_covariance(free.problem, free.state)
    stds = {name: covariance.std(camera, Column.OFFSET) for camera, name in enumerate(free.names)}
    late = ", ".join(f"{name} {1e3 * lag:+.0f} ms" for name, lag in lags.items() if abs(lag) > 3.0 * stds[name])
    warning = (
        "the clips have the same time stamps, and lags as of a recorder that takes each camera's latest image: "
        'they are taken as recorded in step, frame by frame; clock = "independent" in rig.toml estimates a lag of each'
    )
    warnings = (warning, *((f"by the board's motion, exposures differ from the stamps: {late}",) if late else ()))
    estimated = {name: std for name, std in free.lens_stds().items() if name in solution.names}
    return replace(solution, warnings=warnings, estimated=estimated)


def _listed(reasons: Mapping[str, str]) -> str:
    return "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
