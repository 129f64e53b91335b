"""Assembly of the published calibration from the internal solution: datum, clocks, stds, trajectories, pair reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hub.bundle import covariance as cov
from hub.bundle.datum.control_outliers import adjust_to_control_points, reject_outliers, reject_refuted
from hub.bundle.datum.gauge import (
    at_control_points,
    fix_gauge,
    identity_gauge,
    is_overdetermined,
    transform_state,
    with_exact_poses,
)
from hub.bundle.datum.held_gauge import similarity_to_published
from hub.bundle.initialisation import SEEN_WITHIN_S, Reconstruction, observation_times, seen_by_two
from hub.bundle.noise.cluster_robust import cluster_robust
from hub.bundle.noise.noise_scale import rescale_noise
from hub.bundle.noise.timestamp_jitter import weighted_by_jitter
from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import LARGE_NETWORK, AdjustmentState, Column, Problem
from hub.bundle.residuals import predict, residual_norms
from hub.bundle.smoothness_prior import estimate_smoothness
from hub.calibration.given_values import measure_scale_bars, refuted_lens_warnings, scaled_by_bars, sensitivities
from hub.calibration.notes import (
    clock_step_warnings,
    estimated_lenses,
    jitter_notes,
    large_residuals,
    other_frame_rates,
    readout_notes,
    rejected_rows,
    uncertain_depths,
    unused_lengths,
    wandering_clocks,
    wrong_detector_stds,
)
from hub.calibration.pairs.pair_reports import pair_report
from hub.calibration.solvers import Solution
from hub.trajectory.discrete import INSTANT_TOLERANCE_S, PointBasis
from protocols.core.clocks import TimeMap
from protocols.core.version import VERSION
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, CameraCalibration, TrajectoryTable
from protocols.session.rig import Rig, longest_readout

_SHORT_GAPS, _MAX_NOMINAL = 0.05, 4.0
"""Quantile of a camera's gaps between rows that stands for consecutive frames, and how much faster than those its
nominal rate may be: a target seen in every fourth frame at best."""
_LEAST_ROUNDING_S, _ROUNDING_FRAMES = 5e-4, 30
"""Rounding [s] below which it moves a lag less than other errors do; frames over which its errors are compared: few
enough that the pattern of a clock 20 ppm beside a round rate stays."""
_MAX_SAMPLES = 4_000_000
"""Of one path: 4.6 hours at 240 Hz."""


def assemble_calibration(
    rig: Rig,
    solution: Solution,
    published: Calibration | None = None,
    refine_lenses: bool = False,
    online: bool = False,
) -> Calibration:
    """The calibration in the rig's world frame and units, on the reference camera's clock.

    published: an earlier calibration of the same cameras, whose world and scale are kept where the rig fixes none.
    refine_lenses: whether measured lenses were free to change. online: of a recording that goes on; a large network's
    lenses are not tested one by one then, as they are not in later answers, which have ``published`` ones.
    """
    reconstruction = solution.reconstruction
    # The rig's order decides which camera is the reference and the first baseline.
    order = [reconstruction.names.index(name) for name in rig.cameras if name in reconstruction.names]
    names = [reconstruction.names[i] for i in order]
    problem, state = _reordered(reconstruction.problem, reconstruction.state, order)
    reference = _reference_index(rig, names, published)
    control_outliers: tuple[str, ...] = ()
    datum_points: list[tuple[int, Floats]] = []
    if solution.known is None:
        rig, control_outliers = reject_outliers(rig, names, [camera.pose for camera in state.cameras])
        poses = [camera.pose for camera in state.cameras]
        if is_overdetermined(rig, names, poses) and problem.free_parameters.pose:
            prior = estimate_smoothness(problem, state)
            scaled = rescale_noise(problem, state, prior)
            network = cov.covariance(problem, scaled, prior, longest=True).of_each_camera(*range(6))
            rig, refuted = reject_refuted(rig, names, poses, network)
            control_outliers += refuted
        gauge = fix_gauge(rig, names, poses)
        gauge = scaled_by_bars(gauge, measure_scale_bars(rig, reconstruction.labels, problem, state))
        if published is not None and gauge.scale == "arbitrary":
            held, datum_points = similarity_to_published(
                published,
                names,
                reconstruction.labels,
                state,
                _internal_time(solution, names, state, reference, published),
            )
            gauge = replace(gauge, similarity=held)
        state = transform_state(state, gauge.similarity)
        adjustable = problem.free_parameters.pose and solution.solver != "paper"  # its method has no adjustment
        if gauge.scale == "metric" and adjustable and is_overdetermined(rig, names, poses):
            prior = estimate_smoothness(problem, state)
            fitted = adjust_to_control_points(rig, names, problem, rescale_noise(problem, state, prior), prior)
            state = replace(fitted, sigma=state.sigma)
            gauge = at_control_points(gauge, rig, names, [camera.pose for camera in state.cameras])
        if gauge.scale == "metric":
            state = with_exact_poses(rig, names, state)
    else:
        gauge = identity_gauge(len(names), solution.known.scale)
    prior = estimate_smoothness(problem, state)
    noisy, scaled = (problem, state) if state.jitter is None else weighted_by_jitter(problem, state)
    scaled = rescale_noise(noisy, scaled, prior)
    covariance = cov.covariance(noisy, scaled, prior, gauge.information, datum_points, gauge.exact)
    effects = sensitivities(rig, names, noisy, scaled, prior, covariance)
    # The outline of a person is wrong for a second at a time, and in ways that depend on the place, as a lens is.
    outlines = rig.metadata.get("target") == "person"
    if outlines:
        bodies = [label.removesuffix("-head").removesuffix("-foot") for label in reconstruction.labels]
        covariance = cluster_robust(noisy, scaled, covariance, bodies)
    lens_stds, readout_stds = np.sqrt(np.maximum(covariance.variances[:, [Column.FOCAL, Column.READOUT]], 0.0)).T
    time_origins = [solution.prepared.time_origins[name] for name in names]
    time_scales = [solution.prepared.time_scale(name) for name in names]
    base = state.cameras[reference]
    maps = []
    for camera, time_origin, time_scale in zip(state.cameras, time_origins, time_scales, strict=True):
        rate = float(camera.rate / base.rate * (time_scale / time_scales[reference]))
        # reference clock = time_origin + (centre + (internal - offset) / rate) / time_scale of the reference camera
        reference_at_centre = (camera.offset - base.offset) / base.rate + base.centre
        time_at_centre = float(reference_at_centre / time_scales[reference] + time_origins[reference])
        maps.append(TimeMap(rate, time_at_centre - rate * (camera.centre / time_scale + time_origin)))
    maps[reference] = TimeMap(1.0, 0.0)
    middles = cov.middles_of_overlap(problem, state)
    middle_times = [float(camera.camera_time(middles[i, [reference]])[0]) for i, camera in enumerate(state.cameras)]
    instants = {one.camera: one.instant for one in state.wanders}
    if reference in instants:  # its even clock, and with it every map, holds there
        there = state.cameras[reference].reference_time(np.array([instants[reference]]))
        instants = {i: float(camera.camera_time(there)[0]) for i, camera in enumerate(state.cameras)} | instants
    lag_times = [instants.get(i, middle) for i, middle in enumerate(middle_times)]
    rate_stds = [
        cov.clock_rate_std(covariance, state, i, reference) if problem.free_parameters.clock and i != reference else 0.0
        for i in range(len(names))
    ]
    roundings = [_rounding_std([rows.stamps for rows in problem.of_camera(i)]) for i in range(len(names))]
    # Of the maps onto the reference camera's clock, in the middle of their common span.
    lag_stds = [
        float(
            np.hypot(
                _with_correction_errors(std / base.rate, problem, state, roundings, i, reference),
                rate_stds[i] * (lag_times[i] - middle_times[i]),
            )
        )
        if problem.free_parameters.clock and i != reference
        else 0.0
        for i, std in enumerate(cov.relative_clock_stds(covariance, problem, state)[reference].tolist())
    ]
    cameras = {
        name: CameraCalibration(
            name=name,
            intrinsics=state.cameras[i].intrinsics,
            pose=state.cameras[i].pose,
            time_map=maps[i],
            time_offset_std=_time_map_std(problem, state, covariance, roundings, i, reference) / time_scales[reference],
            position_std=cov.position_std(covariance, i)
            if solution.known is None
            else solution.known.cameras[name].position_std,
            rms_px=_rms(problem, state, i),
            detector_z=_detector_z(solution.prepared, name, float(state.sigma[i])),
            focal_std=float(lens_stds[i]),
            readout=_readout(rig, name, state.cameras[i].readout / time_scales[i]),
            readout_std=float(readout_stds[i]) / time_scales[i],
            lag_time=float(lag_times[i]) / time_scales[i] + time_origins[i],
            lag_std=lag_stds[i] / time_scales[reference],
            clock_rate_std=_with_correction_errors(rate_stds[i], problem, state, roundings, i, reference, derivative=1),
            sensitivities=effects[i],
            clock_steps=tuple(
                (step.time / time_scales[i] + time_origins[i], step.size / time_scales[i], step.std / time_scales[i])
                for step in state.clock_steps
                if step.camera == i
            ),
        )
        for i, name in enumerate(names)
    }
    tests_lenses = published is None and not outlines and not (online and len(names) > LARGE_NETWORK)
    tables = _tables(rig, solution.prepared, names, reconstruction.labels, problem, state, covariance, reference)
    return Calibration(
        cameras=cameras,
        reference=names[reference],
        scale=gauge.scale,
        units=rig.units,
        solver=solution.solver,
        version=VERSION,
        refused=solution.refused,
        acceptance=solution.acceptance,
        convergence=reconstruction.state.steps,
        trajectories=tables,
        pairs=tuple(pair_report(pair, cameras, middles, state, names, solution) for pair in solution.pairs),
        warnings=solution.prepared.warnings
        + solution.warnings
        + control_outliers
        + unused_lengths(rig, names, reconstruction.labels)
        + gauge.warnings
        + estimated_lenses(rig, cameras)
        + (refuted_lens_warnings(names, problem, state, refine_lenses) if tests_lenses else ())
        + other_frame_rates(rig, cameras, names[reference])
        + rejected_rows(names, problem, state)
        + readout_notes(cameras, "the trajectory")
        + (
            ()
            if state.jitter is None
            else jitter_notes(names, state.jitter / np.array(time_scales), "its observations")
        )
        + wandering_clocks(names, state, time_scales)
        + clock_step_warnings(cameras)
        + wrong_detector_stds(cameras)
        + uncertain_depths(tables, state)
        + large_residuals(cameras, state),
        residuals={
            name: _residual_rows(problem, state, i, time_origins[i], time_scales[i]) for i, name in enumerate(names)
        },
    )


def trajectory_tables(
    rig: Rig, prepared: PreparedSession, reconstruction: Reconstruction, base: str
) -> tuple[TrajectoryTable, ...]:
    """Trajectories of a reconstruction with given cameras, in their world, on the clock of camera ``base``."""
    problem, state, names = reconstruction.problem, reconstruction.state, reconstruction.names
    prior = estimate_smoothness(problem, state)
    covariance = cov.covariance(problem, rescale_noise(problem, state, prior), prior)
    return _tables(rig, prepared, names, reconstruction.labels, problem, state, covariance, names.index(base))


def _internal_time(
    solution: Solution, names: list[str], state: AdjustmentState, reference: int, published: Calibration
) -> Callable[[Floats], Floats]:
    """Internal times (n,) from published reference times (n,), by the published map of camera ``reference``."""
    prepared, name, base = solution.prepared, names[reference], state.cameras[reference]
    known = published.cameras.get(name)
    clock = TimeMap(clock_rate=1.0, time_offset=0.0) if known is None else known.time_map

    def internal(time: Floats) -> Floats:
        camera_time = (time - clock.time_offset) / clock.clock_rate
        return base.reference_time((camera_time - prepared.time_origins[name]) * prepared.time_scale(name))

    return internal


def _reference_index(rig: Rig, names: list[str], published: Calibration | None) -> int:
    """The camera on whose clock the answer is: the requested one, or one that ``published`` has a map of.

    Only such a one leads to the published reference clock; that of a camera that was restarted began anew.
    """
    known = [name for name in names if published is None or name in published.cameras] or names
    requested = rig.metadata.get("reference")
    return names.index(requested if requested in known else known[0])


def _reordered(problem: Problem, state: AdjustmentState, order: list[int]) -> tuple[Problem, AdjustmentState]:
    new_index = {old: new for new, old in enumerate(order)}
    reordered = replace(
        problem,
        rows=tuple(replace(rows, camera=new_index[rows.camera]) for rows in problem.rows),
        nominal=tuple(problem.nominal[i] for i in order),
        clock_reference=new_index[problem.clock_reference],
        anchors=(new_index[problem.anchors[0]], new_index[problem.anchors[1]]),
        lens_priors=tuple(problem.lens_priors[i] for i in order) if problem.lens_priors else (),
        readout_given=tuple(problem.readout_given[i] for i in order) if problem.readout_given else (),
        lens_tolerances=tuple(problem.lens_tolerances[i] for i in order) if problem.lens_tolerances else (),
        crystal_rates=tuple(problem.crystal_rates[i] for i in order) if problem.crystal_rates else (),
    )
    return reordered, replace(
        state,
        cameras=tuple(state.cameras[i] for i in order),
        sigma=state.sigma[order],
        jitter=None if state.jitter is None else state.jitter[order],
        clock_steps=tuple(replace(step, camera=new_index[step.camera]) for step in state.clock_steps),
        wanders=tuple(replace(one, camera=new_index[one.camera]) for one in state.wanders),
        correlated_noise=None if state.correlated_noise is None else state.correlated_noise.select(order),
    )


def _readout(rig: Rig, name: str, found: float) -> float:
    """Readout time [s] from the first row to the last: as given, else as estimated; 0 if neither."""
    given, longest = rig.cameras[name].readout, longest_readout(rig.cameras[name].fps)
    return float(np.clip(found, -longest, longest)) if given is None else given


def _detector_z(prepared: PreparedSession, name: str, sigma: float) -> float:
    """Noise of a camera's residuals [px] over the typical std that its detector states; 0 where it states none."""
    stated = prepared.camera(name).stated_std
    return sigma / stated if stated > 0.0 else 0.0


_Roundings = list[tuple[float, float]]


def _time_map_std(
    problem: Problem,
    state: AdjustmentState,
    covariance: cov.Covariance,
    roundings: _Roundings,
    camera: int,
    reference: int,
) -> float:
    if not problem.free_parameters.clock:
        return 0.0
    return _with_correction_errors(
        cov.time_map_std(covariance, state, camera, reference), problem, state, roundings, camera, reference
    )


def _with_correction_errors(
    std: float,
    problem: Problem,
    state: AdjustmentState,
    roundings: _Roundings,
    camera: int,
    reference: int,
    derivative: int = 0,
) -> float:
    """The std of a map, or of its rate (derivative 1), with that of both clocks' roundings, steps and wander.

    Of the reference, and of clocks that are shared: 0.
    """
    if camera == reference or not problem.free_parameters.clock:
        return 0.0
    variance = std**2 + sum(
        (one.rate_std if derivative else one.std) ** 2 for one in state.wanders if one.camera in (camera, reference)
    )
    variance += sum(roundings[one][derivative] ** 2 for one in (camera, reference))
    for step in state.clock_steps:
        if step.camera in (camera, reference):  # its size moves the line through all rows as it moves those beyond it
            times = np.concatenate([rows.time[rows.use] for rows in problem.of_camera(step.camera)])
            beyond = (times >= step.time) == (step.time > state.cameras[step.camera].centre)
            variance += (step.std * np.polynomial.polynomial.polyfit(times - times.mean(), beyond, 1)[derivative]) ** 2
    return float(np.sqrt(variance))


def _rounding_std(stamps: list[Floats]) -> tuple[float, float]:
    """Stds of an even clock's offset [s] and rate by how its stamps [s] are rounded: 0 where they are not.

    At 30 frames a second and 10 ms each third error is the same, and their mean is anything up to a sixth of 10 ms.
    """
    times = np.unique(np.concatenate([np.zeros(0), *stamps]))
    gaps = np.diff(times)
    if len(gaps) < 2:
        return 0.0, 0.0
    consecutive = gaps[gaps < 1.5 * np.quantile(gaps, _SHORT_GAPS)]
    unit = 1e-6 * float(np.gcd.reduce(np.rint(1e6 * consecutive).astype(np.int64)))
    if unit < _LEAST_ROUNDING_S:
        return 0.0, 0.0
    frame = np.r_[0.0, np.cumsum(np.rint(gaps / np.mean(consecutive)))]
    # The usual interval of a frame, over a quarter of them, and spread of a part: a step or a pause is in few of them.
    far = len(times) // 4 + 1
    error = times - frame * float(np.median((times[far:] - times[:-far]) / (frame[far:] - frame[:-far])))
    parts = np.array_split(error, max(1, len(error) // _ROUNDING_FRAMES))
    spread = float(np.median([np.ptp(part) for part in parts]))
    if not 0.01 * unit < spread < unit:  # even stamps, or those of an uneven clock
        return 0.0, 0.0
    room = unit - spread  # by which an even clock can be shifted while all stamps are its roundings
    return room / 12.0**0.5, room / float(np.ptp(times)) / 3.0**0.5


def _rms(problem: Problem, state: AdjustmentState, camera: int) -> float:
    parts = [
        residual_norms(rows, state.cameras[camera], state.trajectories[rows.label])[rows.use]
        for rows in problem.of_camera(camera)
    ]
    norms = np.concatenate(parts) if parts else np.zeros(0)
    norms = norms[np.isfinite(norms)]
    return float(np.sqrt(np.mean(norms**2))) if len(norms) else 0.0


def _residual_rows(
    problem: Problem, state: AdjustmentState, camera: int, time_origin: float, time_scale: float
) -> Floats:
    parts = []
    for rows in problem.of_camera(camera):
        predicted = predict(rows, state.cameras[camera], state.trajectories[rows.label])
        good = rows.use & np.isfinite(predicted).all(axis=1)
        stamps = rows.stamps[good] / time_scale + time_origin
        parts.append(np.column_stack([stamps, rows.pixels[good], (rows.pixels - predicted)[good]]))
    return np.concatenate(parts) if parts else np.zeros((0, 5))


def _sampling_rate(rig: Rig, problem: Problem, names: list[str], time_scales: list[float], reference: float) -> float:
    """Frame rate of the fastest camera on a clock of time scale ``reference``: nominal, or from its rows.

    Where no gap between a camera's rows comes near its nominal rate, that one is wrong, and its rows say the rate.
    """
    rates = [
        rig.cameras[name].fps * reference / time_scale for name, time_scale in zip(names, time_scales, strict=True)
    ]
    for rows in problem.rows:
        if len(rows.time) > 2:
            gaps = np.diff(rows.time)
            shortest = reference / max(float(np.quantile(gaps, _SHORT_GAPS)), 1e-9)
            if not 0.0 < rates[rows.camera] < _MAX_NOMINAL * shortest:
                rates[rows.camera] = reference / float(np.median(gaps))
    return max([rate for rate in rates if np.isfinite(rate)], default=30.0) or 30.0


def _tables(
    rig: Rig,
    prepared: PreparedSession,
    names: list[str],
    labels: list[str],
    problem: Problem,
    state: AdjustmentState,
    covariance: cov.Covariance,
    reference: int,
) -> tuple[TrajectoryTable, ...]:
    """Trajectories at the frame rate of the fastest camera, on a reference camera's clock, where two cameras saw it."""
    base, time_origin = state.cameras[reference], prepared.time_origins[names[reference]]
    time_scales = [prepared.time_scale(name) for name in names]
    time_scale, out = time_scales[reference], []
    rate_hz = _sampling_rate(rig, problem, names, time_scales, time_scale)
    for label, path in enumerate(state.trajectories):
        within = SEEN_WITHIN_S
        if isinstance(path.basis, PointBasis):
            within = INSTANT_TOLERANCE_S  # a point is observed at its own instant or not at all
            ticks = base.camera_time(path.basis.instants) / time_scale + time_origin
        else:
            # A grid on the reference camera's clock, so that two runs on one log sample the same instants.
            first, last = base.camera_time(np.array([path.basis.begin, path.basis.end])) / time_scale
            rate = min(rate_hz, _MAX_SAMPLES / max(last - first, 1.0 / rate_hz))
            ticks = np.arange(np.ceil((first + time_origin) * rate), np.floor((last + time_origin) * rate) + 1) / rate
        internal = base.reference_time((ticks - time_origin) * time_scale)
        position = path.at(internal)
        seen = seen_by_two(observation_times(problem, state, label), internal, within, INSTANT_TOLERANCE_S)
        good = np.isfinite(position).all(axis=1) & seen
        std = cov.path_std(covariance, state, label, internal[good])
        out.append(TrajectoryTable(labels[label], ticks[good], position[good], std))
    return tuple(out)
