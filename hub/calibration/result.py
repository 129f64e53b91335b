"""From the internal solution to what users get: published gauge and clock, stds, trajectory, pair reports."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hub.bundle import covariance as cov
from hub.bundle.adjustment import predict, residual_norms
from hub.bundle.noise_scale import honest
from hub.bundle.problem import CAMERA_PARAMETERS, FOCAL, READOUT, Problem, State
from hub.calibration.pair_network import pair_lag
from hub.calibration.scale_bar import measured_wands, scaled_by_wands
from hub.datum.control_outliers import trusted
from hub.datum.control_points import adjust_to_references
from hub.datum.gauge import fix_gauge, given_world, transform_state, weighed
from hub.sync.pair_solver import PairSolution
from hub.trajectory.discrete import SAME_TIME, PointBasis
from hub.trajectory.smoothness_prior import motion_prior
from hub.two_view.relative_pose import fundamental_from, relative_pose
from protocols.core.clocks import TimeMap
from protocols.core.version import VERSION
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, CameraCalibration, PairReport, TrajectoryTable
from protocols.session.rig import Rig

if TYPE_CHECKING:
    from hub.calibration.initialisation import Scaffold
    from hub.calibration.pipeline import Solution
    from hub.calibration.preprocessing import Prepared

SEEN_WITHIN = 0.2
"""A time counts as seen by a camera if it saw the point this near [s]."""


def publish(rig: Rig, solution: Solution) -> Calibration:
    """Everything in the rig's world and units, on the reference camera's clock."""
    scaffold = solution.scaffold
    # The rig's order decides which camera is the reference and the first baseline.
    order = [scaffold.names.index(name) for name in rig.cameras if name in scaffold.names]
    names = [scaffold.names[i] for i in order]
    problem, state = _reordered(scaffold.problem, scaffold.state, order)
    aside: tuple[str, ...] = ()
    if solution.known is None:
        rig, aside = trusted(rig, names, [camera.pose for camera in state.cameras])
        gauge = fix_gauge(rig, names, [camera.pose for camera in state.cameras])
        gauge = scaled_by_wands(gauge, measured_wands(rig, scaffold.labels, problem, state))
        state = transform_state(state, gauge.similarity)
        if gauge.scale == "metric" and problem.freedom.pose and weighed(rig, names):
            prior = motion_prior(problem, state)
            fitted = adjust_to_references(rig, names, problem, honest(problem, state, prior), prior)
            state = replace(fitted, sigma=state.sigma)
    else:
        gauge = given_world(len(names), solution.known.scale)
    prior = motion_prior(problem, state)
    covariance = cov.covariance(problem, honest(problem, state, prior), prior, gauge.information)
    lens_stds = focal_stds(problem, state, covariance)
    readout_stds = np.sqrt(np.maximum(np.diag(covariance.cameras)[READOUT::CAMERA_PARAMETERS], 0.0))
    reference = _reference(rig, names)
    epochs = [solution.prepared.epochs[name] for name in names]
    paces = [solution.prepared.pace(name) for name in names]
    base = state.cameras[reference]
    maps = []
    for camera, epoch, pace in zip(state.cameras, epochs, paces, strict=True):
        rate = float(camera.rate / base.rate * (pace / paces[reference]))
        # reference clock = epoch + (centre + (internal - offset) / rate) / pace of the reference camera
        ahead = (camera.offset - base.offset) / base.rate + base.centre
        at_centre = float(ahead / paces[reference] + epochs[reference])
        maps.append(TimeMap(rate, at_centre - rate * (camera.centre / pace + epoch)))
    maps[reference] = TimeMap(1.0, 0.0)
    cameras = {
        name: CameraCalibration(
            name=name,
            intrinsics=state.cameras[i].intrinsics,
            pose=state.cameras[i].pose,
            time_map=maps[i],
            time_offset_std=_map_std(problem, state, covariance, i, reference) / paces[reference],
            position_std=cov.position_std(covariance, i)
            if solution.known is None
            else solution.known.cameras[name].position_std,
            rms_px=_rms(problem, state, i),
            focal_std=float(lens_stds[i]),
            readout=_readout(rig, name, state.cameras[i].readout / paces[i]),
            readout_std=float(readout_stds[i]) / paces[i],
        )
        for i, name in enumerate(names)
    }
    return Calibration(
        cameras=cameras,
        reference=names[reference],
        scale=gauge.scale,
        units=rig.units,
        solver=solution.solver,
        version=VERSION,
        refused=solution.refused,
        convergence=scaffold.state.steps,
        trajectories=tuple(
            _table(
                problem,
                state,
                covariance,
                label,
                name,
                reference,
                epochs[reference],
                paces[reference],
                _rate_hz(rig, problem, names, paces, paces[reference]),
            )
            for label, name in enumerate(scaffold.labels)
        ),
        pairs=tuple(_pair_report(pair, cameras, problem, state, names, solution) for pair in solution.pairs),
        warnings=solution.prepared.warnings
        + solution.warnings
        + aside
        + gauge.warnings
        + _lenses_told(cameras)
        + _lenses_loose(names, problem, state)
        + _readouts_told(cameras)
        + _jitter_told(names, state, paces),
        residuals={name: _residual_rows(problem, state, i, epochs[i], paces[i]) for i, name in enumerate(names)},
    )


def path_tables(rig: Rig, prepared: Prepared, scaffold: Scaffold, base: str) -> tuple[TrajectoryTable, ...]:
    """The paths of a solution whose cameras were given and stay, in their world, on the clock of camera ``base``."""
    problem, state, names = scaffold.problem, scaffold.state, scaffold.names
    prior = motion_prior(problem, state)
    covariance = cov.covariance(problem, honest(problem, state, prior), prior)
    reference = names.index(base)
    paces = [prepared.pace(name) for name in names]
    rate_hz = _rate_hz(rig, problem, names, paces, paces[reference])
    epoch, pace = prepared.epochs[base], paces[reference]
    return tuple(
        _table(problem, state, covariance, label, name, reference, epoch, pace, rate_hz)
        for label, name in enumerate(scaffold.labels)
    )


def _reference(rig: Rig, names: list[str]) -> int:
    wanted = rig.metadata.get("reference")
    return names.index(wanted) if wanted in names else 0


def _reordered(problem: Problem, state: State, order: list[int]) -> tuple[Problem, State]:
    place = {old: new for new, old in enumerate(order)}
    moved = replace(
        problem,
        rows=tuple(replace(rows, camera=place[rows.camera]) for rows in problem.rows),
        nominal=tuple(problem.nominal[i] for i in order),
        clock_reference=place[problem.clock_reference],
        anchors=(place[problem.anchors[0]], place[problem.anchors[1]]),
        guessed=tuple(problem.guessed[i] for i in order) if problem.guessed else (),
        timed=tuple(problem.timed[i] for i in order) if problem.timed else (),
        loose=tuple(problem.loose[i] for i in order) if problem.loose else (),
    )
    return moved, replace(
        state,
        cameras=tuple(state.cameras[i] for i in order),
        sigma=state.sigma[order],
        jitter=None if state.jitter is None else state.jitter[order],
        coloured=None if state.coloured is None else state.coloured.of(order),
    )


def focal_stds(problem: Problem, state: State, covariance: cov.Covariance | None = None) -> Floats:
    """(cameras,) relative stds of the focal lengths that the path told; 0 where the lens was given."""
    guessed = [bool(problem.guessed) and problem.guessed[i] is not None for i in range(len(state.cameras))]
    if not any(guessed):
        return np.zeros(len(guessed))
    found = covariance or cov.covariance(problem, state, motion_prior(problem, state))
    variance = np.diag(found.cameras)[FOCAL::CAMERA_PARAMETERS]
    return np.where(guessed, np.sqrt(np.maximum(variance, 0.0)), 0.0)


def _lenses_told(cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each lens that the path told."""
    return tuple(
        f"{name}: its lens was found from the path: focal length {camera.intrinsics.focal:.1f} px ± "
        f"{100 * camera.focal_std:.2g} % (std)"
        for name, camera in cameras.items()
        if camera.focal_std > 0.0
    )


def _lenses_loose(names: list[str], problem: Problem, state: State) -> tuple[str, ...]:
    """One sentence for all lenses that were told and came out a little different."""
    if not problem.loose:
        return ()
    told = ", ".join(
        f"{name} {100 * (camera.intrinsics.focal / lens.focal - 1):+.1f} %"
        for name, camera, lens in zip(names, state.cameras, problem.nominal, strict=True)
    )
    return (f"lenses are about as told, not exactly: focal lengths by what was seen {told} (tolerance 1 %)",)


def _readout(rig: Rig, name: str, found: float) -> float:
    """Seconds from the first row to the last: as it was told, else as the path told it; 0 where neither did."""
    told = rig.cameras[name].readout
    return found if told is None else told


def _readouts_told(cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each rolling shutter that the path told."""
    return tuple(
        f"{name}: its rolling shutter was found from the path: {1e3 * camera.readout:.1f} ms from the first row to the "
        f"last ± {1e3 * camera.readout_std:.1f} ms (std)"
        for name, camera in cameras.items()
        if camera.readout_std > 0.0
    )


def _jitter_told(names: list[str], state: State, paces: list[float]) -> tuple[str, ...]:
    """One sentence for each camera whose stamps jitter."""
    stds = np.zeros(len(names)) if state.jitter is None else state.jitter / np.array(paces)
    return tuple(
        f"{name}: its stamps jitter by {1e3 * std:.2g} ms (std): each frame's own time was found from what it shows"
        for name, std in zip(names, stds, strict=True)
        if std > 0.0
    )


def _map_std(problem: Problem, state: State, covariance: cov.Covariance, camera: int, reference: int) -> float:
    if not problem.freedom.clock or camera == reference:
        return 0.0
    variance = cov.time_map_std(covariance, state, camera, reference) ** 2
    if state.jitter is not None:
        # The map is that of the mean stamp: as well known as the mean of so many that jitter.
        for one in (camera, reference):
            stamps = [rows.stamps[rows.use] for rows in problem.rows if rows.camera == one]
            variance += float(state.jitter[one]) ** 2 / max(len(np.unique(np.concatenate(stamps))), 1)
    return float(np.sqrt(variance))


def _rms(problem: Problem, state: State, camera: int) -> float:
    parts = [
        residual_norms(rows, state.cameras[camera], state.trajectories[rows.label])[rows.use]
        for rows in problem.rows
        if rows.camera == camera
    ]
    norms = np.concatenate(parts) if parts else np.zeros(0)
    norms = norms[np.isfinite(norms)]
    return float(np.sqrt(np.mean(norms**2))) if len(norms) else 0.0


def _residual_rows(problem: Problem, state: State, camera: int, epoch: float, pace: float) -> Floats:
    parts = []
    for rows in problem.rows:
        if rows.camera == camera:
            predicted = predict(rows, state.cameras[camera], state.trajectories[rows.label])
            good = rows.use & np.isfinite(predicted).all(axis=1)
            shown = rows.stamps[good] / pace + epoch
            parts.append(np.column_stack([shown, rows.pixels[good], (rows.pixels - predicted)[good]]))
    return np.concatenate(parts) if parts else np.zeros((0, 5))


def _rate_hz(rig: Rig, problem: Problem, names: list[str], paces: list[float], reference: float) -> float:
    """The fastest camera's frames in a second of a clock of pace ``reference``: nominal, or as its rows come."""
    rates = [rig.cameras[name].fps * reference / pace for name, pace in zip(names, paces, strict=True)]
    for rows in problem.rows:
        if rates[rows.camera] <= 0 and len(rows.time) > 2:
            rates[rows.camera] = reference / float(np.median(np.diff(rows.time)))
    return max([rate for rate in rates if np.isfinite(rate)], default=30.0) or 30.0


def supported(problem: Problem, state: State, label: int, time: Floats) -> Floats:
    """How many cameras saw the point within SEEN_WITHIN of internal reference times (n,)."""
    # A point of a shared clock is seen at its instant or not at all.
    within = SAME_TIME if isinstance(state.trajectories[label].basis, PointBasis) else SEEN_WITHIN
    count = np.zeros(len(time))
    for number, camera in enumerate(state.cameras):
        mine = [r.time[r.use] for r in problem.rows if r.camera == number and r.label == label]
        joined = np.concatenate(mine) if mine else np.zeros(0)
        if len(joined) < 2:
            continue
        seen = np.sort(camera.reference_time(joined))
        after = np.clip(np.searchsorted(seen, time), 1, len(seen) - 1)
        count += np.minimum(np.abs(seen[after] - time), np.abs(time - seen[after - 1])) <= within
    return count


def _table(
    problem: Problem,
    state: State,
    covariance: cov.Covariance,
    label: int,
    name: str,
    reference: int,
    epoch: float,
    pace: float,
    rate_hz: float,
) -> TrajectoryTable:
    """The path of one label at ``rate_hz`` on the reference camera's clock, where two cameras saw it."""
    base = state.cameras[reference]
    path = state.trajectories[label]
    if isinstance(path.basis, PointBasis):
        ticks = base.camera_time(path.basis.instants) / pace + epoch
    else:
        # A grid on the reference camera's clock, so that two runs on one log sample the same instants.
        first, last = base.camera_time(np.array([path.basis.begin, path.basis.end])) / pace
        ticks = np.arange(np.ceil((first + epoch) * rate_hz), np.floor((last + epoch) * rate_hz) + 1) / rate_hz
    internal = base.reference_time((ticks - epoch) * pace)
    position = path.at(internal)
    good = np.isfinite(position).all(axis=1) & (supported(problem, state, label, internal) >= 2)
    return TrajectoryTable(name, ticks[good], position[good], cov.path_std(covariance, state, label, internal[good]))


def _pair_report(
    pair: PairSolution,
    cameras: dict[str, CameraCalibration],
    problem: Problem,
    state: State,
    names: list[str],
    solution: Solution,
) -> PairReport:
    """What is known of a pair: from the joint solution where both cameras are in it, else from the pair."""
    fit = pair.fit
    a, b = cameras.get(pair.a), cameras.get(pair.b)
    middle = _middle_of_overlap(problem, state, names, pair)
    if pair.fundamental is None and a is not None and b is not None and middle is not None:
        time_a, time_b = (_shown(state, names, name, middle, solution) for name in (pair.a, pair.b))
        relative = relative_pose(a.pose, b.pose)
        return PairReport(
            cameras=(pair.a, pair.b),
            status=pair.status,
            lag_s=time_a - time_b,
            clock_rate=b.time_map.clock_rate / a.time_map.clock_rate,
            fundamental=fundamental_from(relative, a.intrinsics.matrix, b.intrinsics.matrix),
            inliers=None if fit is None else fit.inliers,
            rms_px=None if fit is None or not np.isfinite(fit.sigma_px) else fit.sigma_px,
        )
    return lone_pair_report(pair, solution.prepared)


def lone_pair_report(pair: PairSolution, prepared: Prepared) -> PairReport:
    """What a pair says by itself, where no joint solution holds both its cameras."""
    fit = pair.fit
    if fit is None or not pair.solved:
        return PairReport((pair.a, pair.b), pair.status, fundamental=pair.fundamental)
    matrix = pair.fundamental
    if matrix is None:
        lenses = [prepared.camera(name).intrinsics.matrix for name in (pair.a, pair.b)]
        matrix = fundamental_from(fit.geometry, *lenses)
    return PairReport(
        (pair.a, pair.b),
        pair.status,
        pair_lag(prepared, pair, fit),
        fit.rate * prepared.pace(pair.b) / prepared.pace(pair.a),
        matrix,
        fit.inliers,
        fit.sigma_px,
    )


def _shown(state: State, names: list[str], name: str, internal: float, solution: Solution) -> float:
    """What a camera's clock shows at an internal time."""
    prepared = solution.prepared
    mine = float(state.cameras[names.index(name)].camera_time(np.array([internal]))[0])
    return mine / prepared.pace(name) + prepared.epochs[name]


def _middle_of_overlap(problem: Problem, state: State, names: list[str], pair: PairSolution) -> float | None:
    spans = []
    for name in (pair.a, pair.b):
        if name not in names:
            return None
        number = names.index(name)
        times = [r.time[r.use] for r in problem.rows if r.camera == number]
        joined = np.concatenate(times) if times else np.zeros(0)
        if not len(joined):
            return None
        spans.append(state.cameras[number].reference_time(np.array([joined.min(), joined.max()])))
    begin, end = max(spans[0][0], spans[1][0]), min(spans[0][1], spans[1][1])
    return float(0.5 * (begin + end))
