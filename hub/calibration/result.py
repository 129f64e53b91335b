"""Assembly of the published calibration from the internal solution: datum, clocks, stds, trajectories, pair reports."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from hub.bundle import covariance as cov
from hub.bundle.datum.control_outliers import reject_outliers, reject_refuted
from hub.bundle.datum.control_point_adjustment import adjust_to_control_points
from hub.bundle.datum.gauge import (
    at_control_points,
    fix_gauge,
    identity_gauge,
    is_overdetermined,
    transform_state,
    with_exact_poses,
)
from hub.bundle.datum.held_gauge import similarity_to_published
from hub.bundle.initialisation import SEEN_WITHIN_S, Reconstruction, observation_times, seen_by_two, sigma_limit
from hub.bundle.model_comparison import REFUTED_SIGMA
from hub.bundle.noise.noise_scale import rescale_noise
from hub.bundle.noise.timestamp_jitter import weighted_by_jitter
from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import CRYSTAL_RATE_STD, FOCAL, LARGE_NETWORK, READOUT, AdjustmentState, Problem
from hub.bundle.residuals import predict, residual_norms
from hub.bundle.smoothness_prior import estimate_smoothness
from hub.calibration.given_values import refuted_lens_warnings, sensitivities
from hub.calibration.pairs.pair_network import RATE_TOLERANCE, coincide, pair_lag
from hub.calibration.scale_bar import measure_scale_bars, scaled_by_bars
from hub.calibration.solution import Solution
from hub.sync.hypothesis import PairSolution
from hub.trajectory.discrete import INSTANT_TOLERANCE_S, PointBasis
from hub.two_view.relative_pose import fundamental_from, relative_pose_between
from protocols.core.clocks import TimeMap
from protocols.core.pair_report import PairReport
from protocols.core.version import VERSION
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, CameraCalibration, TrajectoryTable
from protocols.session.rig import Rig, longest_readout

_SHORT_GAPS, _MAX_NOMINAL = 0.05, 4.0
"""Quantile of a camera's gaps between rows that stands for consecutive frames, and how much faster than those its
nominal rate may be: a target seen in every fourth frame at best."""
_MAX_Z = 2.0
"""Residuals over the detector's stds, or the reverse, from which these are reported as wrong."""
_MAX_REJECTED = 0.2
"""Share of a camera's rows that is left out without a warning: a detector is rarely wrong more often."""
_MAX_DEPTH_STD = 0.05
"""Largest std of a path over its distance that its errors follow. Depth is one over disparity: of an error e of 1.96
stds, e² is then a quarter of the depth's std, which alone is 1.36 of one std for three axes."""
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
    reference = _reference_index(rig, names)
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
    lens_stds, readout_stds = np.sqrt(np.maximum(covariance.variances[:, [FOCAL, READOUT]], 0.0)).T
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
        cov.clock_rate_std(covariance, state, i, reference) if problem.free_parameters.clock else 0.0
        for i in range(len(names))
    ]
    # Of the maps onto the reference camera's clock, in the middle of their common span.
    lag_stds = [
        float(
            np.hypot(
                _with_correction_errors(std / base.rate, problem, state, i, reference),
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
            time_offset_std=_time_map_std(problem, state, covariance, i, reference) / time_scales[reference],
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
            clock_rate_std=float(
                np.linalg.norm([rate_stds[i], *(one.rate_std for one in state.wanders if one.camera in (i, reference))])
            ),
            sensitivities=effects[i],
            clock_steps=tuple(
                (step.time / time_scales[i] + time_origins[i], step.size / time_scales[i], step.std / time_scales[i])
                for step in state.clock_steps
                if step.camera == i
            ),
        )
        for i, name in enumerate(names)
    }
    # The outline of a person is wrong in ways that depend on the place, as those of a lens do.
    outlines = rig.metadata.get("target") == "person"
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
        pairs=tuple(_pair_report(pair, cameras, middles, state, names, solution) for pair in solution.pairs),
        warnings=solution.prepared.warnings
        + solution.warnings
        + control_outliers
        + _unused_lengths(rig, names, reconstruction.labels)
        + gauge.warnings
        + _estimated_lenses(rig, cameras)
        + (refuted_lens_warnings(names, problem, state, refine_lenses) if tests_lenses else ())
        + _other_frame_rates(rig, cameras, names[reference])
        + _rejected_rows(names, problem, state)
        + readout_notes(cameras, "the trajectory")
        + (
            ()
            if state.jitter is None
            else jitter_notes(names, state.jitter / np.array(time_scales), "its observations")
        )
        + _wandering_clocks(names, state, time_scales)
        + _clock_step_warnings(cameras)
        + _wrong_detector_stds(cameras)
        + _uncertain_depths(tables, state)
        + _large_residuals(names, state),
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


def _reference_index(rig: Rig, names: list[str]) -> int:
    requested = rig.metadata.get("reference")
    return names.index(requested) if requested in names else 0


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


def _estimated_lenses(rig: Rig, cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each lens that was estimated: unknown, refined on request, or given with a std."""
    out = []
    for name, camera in cameras.items():
        given, lens, std = rig.cameras[name], camera.intrinsics, f"{100 * camera.focal_std:.2g} % (std)"
        if camera.focal_std > 0.0 and given.is_measured and given.intrinsics is not None:
            before = given.intrinsics.focal
            change = f"from {before:.1f} to {lens.focal:.1f} px ± {std}, by {100 * (lens.focal / before - 1):+.2g} %"
            weight = f"; given ± {100 * given.focal_std:.2g} %" if given.focal_std else ""
            if weight and abs(np.log(lens.focal / before)) > REFUTED_SIGMA * given.focal_std:
                weight += ", which the observations refute"
            out.append(f"{name}: its lens was refined: focal length {change}{weight}")
        elif camera.focal_std > 0.0:
            out.append(f"{name}: its lens was estimated from the trajectory: focal length {lens.focal:.1f} px ± {std}")
    return tuple(out)


def _unused_lengths(rig: Rig, names: list[str], labels: list[str]) -> tuple[str, ...]:
    """One sentence for each distance and scale bar of which an end was not solved."""
    out = []
    for what, given, known in (("distance", rig.distances, names), ("scale bar (wand)", rig.scale_bars, labels)):
        for a, b, _ in given:
            missing = " and ".join(one for one in (a, b) if one not in known)
            if missing:
                out.append(f"the {what} {a}–{b} was not used: no solution has {missing}")
    return tuple(out)


def _other_frame_rates(rig: Rig, cameras: dict[str, CameraCalibration], reference: str) -> tuple[str, ...]:
    """One sentence for each camera whose clock rate no crystal explains."""
    out = []
    common = float(np.median([camera.time_map.clock_rate for camera in cameras.values()])) if len(cameras) > 2 else 1.0
    std = float(np.median([camera.clock_rate_std for camera in cameras.values()]))
    # Where the others agree on another rate than the reference's, it is the reference that runs differently.
    common, whom, whose = (
        (common, "the others", "the others'") if _is_no_crystal(common, std) else (1.0, reference, f"{reference}'s")
    )
    for name, camera in cameras.items():
        rate, fps = camera.time_map.clock_rate / common, rig.cameras[name].fps
        own = std if name == reference else camera.clock_rate_std
        if _is_no_crystal(rate, own):
            out.append(
                f"{name}: its times run {1e6 * (rate - 1.0):+.0f} ± {1e6 * own:.0f} ppm against {whose}, more "
                f"than the 100 ppm of crystals: a different frame rate, {fps / rate:.5g} fps for {fps:.5g}, or that of "
                f"{whom}"
            )
    return tuple(out)


def _is_no_crystal(rate: float, std: float) -> bool:
    """Whether a relative clock rate, with its std, is one that no crystal explains."""
    return abs(rate - 1.0) < RATE_TOLERANCE and (rate - 1.0) ** 2 > REFUTED_SIGMA**2 * (CRYSTAL_RATE_STD**2 + std**2)


def _rejected_rows(names: list[str], problem: Problem, state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each camera many of whose rows were left out, though others saw the point then."""
    out = []
    for number, name in enumerate(names):
        parts = problem.of_camera(number)
        norms = [residual_norms(part, state.cameras[number], state.trajectories[part.label]) for part in parts]
        seen = sum(int(np.isfinite(norm).sum()) for norm in norms)
        left = sum(int((np.isfinite(norm) & ~part.use).sum()) for norm, part in zip(norms, parts, strict=True))
        if left > _MAX_REJECTED * seen:
            out.append(
                f"{name}: {left} of its {seen} rows ({100 * left / seen:.0f} %) do not fit the others' path at its lag "
                "and were left out: false detections, a moved camera, or a clock that is not even"
            )
    return tuple(out)


def _readout(rig: Rig, name: str, found: float) -> float:
    """Readout time [s] from the first row to the last: as given, else as estimated; 0 if neither."""
    given, longest = rig.cameras[name].readout, longest_readout(rig.cameras[name].fps)
    return float(np.clip(found, -longest, longest)) if given is None else given


def readout_notes(cameras: dict[str, CameraCalibration], by: str) -> tuple[str, ...]:
    """One sentence for each rolling-shutter readout that was estimated ``by`` something."""
    return tuple(
        f"{name}: its rolling-shutter readout was estimated from {by}: "
        f"{1e3 * camera.readout:.1f} ms from the first row to the last ± {1e3 * camera.readout_std:.1f} ms (std)"
        for name, camera in cameras.items()
        if camera.readout_std > 0.0
    )


def jitter_notes(names: list[str], stds: Floats, by: str) -> tuple[str, ...]:
    """One sentence for each camera with time-stamp jitter, of stds (cameras,) [s], estimated ``by`` something."""
    return tuple(
        f"{name}: its stamps jitter by {1e3 * std:.2g} ms (std): each frame's time was estimated from {by}"
        for name, std in zip(names, stds.tolist(), strict=True)
        if std > 0.0
    )


def _wandering_clocks(names: list[str], state: AdjustmentState, time_scales: list[float]) -> tuple[str, ...]:
    """One sentence for each clock that wanders."""
    return tuple(
        f"{names[one.camera]}: its clock's rate changes: beside an even clock it is off by up to "
        f"{1e3 * float(np.abs(one.values).max()) / time_scales[one.camera]:.2g} ms: each frame's time was corrected, "
        "and its time map holds at lag_time_s"
        for one in state.wanders
    )


def _clock_step_warnings(cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each clock step."""
    return tuple(
        f"{name}: its clock steps by {1e3 * size:+.1f} ± {1e3 * std:.1g} ms at its time {time:.2f} s; its map holds "
        f"{'before' if time > camera.lag_time else 'after'} the step, and the rows on the other side were corrected"
        for name, camera in cameras.items()
        for time, size, std in camera.clock_steps
    )


def _large_residuals(names: list[str], state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each camera whose residuals are no noise, though no test told what they are.

    They are larger than the others' as angles too: what blurs an image has more pixels in a larger one.
    """
    if len(names) < 3:
        return ()
    angles = replace(state, sigma=state.sigma / [camera.intrinsics.focal for camera in state.cameras])
    return tuple(
        f"{name}: its residuals ({state.sigma[i]:.2g} px a coordinate) are {3.0 * state.sigma[i] / limit:.1f} times "
        "the others': its lens, its detections or its times are not what they are said to be, and its pose may be "
        "further off than its std"
        for i, name in enumerate(names)
        if state.sigma[i] > (limit := sigma_limit(state, i)) and angles.sigma[i] > sigma_limit(angles, i)
    )


def _detector_z(prepared: PreparedSession, name: str, sigma: float) -> float:
    """Noise of a camera's residuals [px] over the median std that its detector states; 0 where it states none."""
    stated = prepared.camera(name).stated_std
    return sigma / stated if stated > 0.0 else 0.0


def _wrong_detector_stds(cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each camera whose residuals are not what its detector's covariances say."""
    return tuple(
        f"{name}: its residuals are {camera.detector_z:.2g} times the stds that its detector states (z-scores); only "
        "the ratios of its covariances were used, as weights"
        for name, camera in cameras.items()
        if camera.detector_z > 0.0 and not 1.0 / _MAX_Z < camera.detector_z < _MAX_Z
    )


def _uncertain_depths(tables: Iterable[TrajectoryTable], state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each path whose depth is known so badly that its errors are not as its stds say."""
    out = list[str]()
    for table in tables:
        some = slice(None, None, 1 + len(table.std) // 100)
        distances = [np.linalg.norm(table.position[some] - one.pose.position, axis=1) for one in state.cameras]
        share = float(np.median(table.std[some] / np.min(distances, axis=0))) if len(table.std) else 0.0
        if share > _MAX_DEPTH_STD:
            text = "of its distance (std), which errors exceed: move the cameras apart"
            out.append(f"{table.label}: its path is known to {share:.0%} {text}")
    return tuple(out)


def _time_map_std(
    problem: Problem, state: AdjustmentState, covariance: cov.Covariance, camera: int, reference: int
) -> float:
    if not problem.free_parameters.clock or camera == reference:
        return 0.0
    return _with_correction_errors(
        cov.time_map_std(covariance, state, camera, reference), problem, state, camera, reference
    )


def _with_correction_errors(std: float, problem: Problem, state: AdjustmentState, camera: int, reference: int) -> float:
    variance = std**2 + sum(one.std**2 for one in state.wanders if one.camera in (camera, reference))
    for step in state.clock_steps:
        if step.camera in (camera, reference):  # its size moves the map by the share of the rows beyond it
            rows = [rows.time[rows.use] for rows in problem.of_camera(step.camera)]
            after = float(np.mean(np.concatenate(rows) >= step.time))
            variance += (step.std * (after if step.time > state.cameras[step.camera].centre else 1.0 - after)) ** 2
    return float(np.sqrt(variance))


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


def _pair_report(
    pair: PairSolution,
    cameras: dict[str, CameraCalibration],
    middles: Floats,
    state: AdjustmentState,
    names: list[str],
    solution: Solution,
) -> PairReport:
    """Report of a pair: from the joint solution where both cameras are in it, else from the pair's own solution."""
    fit = pair.fit
    a, b = cameras.get(pair.a), cameras.get(pair.b)
    if pair.fundamental is None and a is not None and b is not None:
        middle = float(middles[names.index(pair.a), names.index(pair.b)])
        time_a, time_b = (_camera_clock(state, names, name, middle, solution) for name in (pair.a, pair.b))
        matrices = a.intrinsics.matrix, b.intrinsics.matrix
        in_one_place = coincide(a.pose.position, b.pose.position)  # then they have no epipolar geometry
        return PairReport(
            cameras=(pair.a, pair.b),
            status=pair.status,
            lag_s=time_a - time_b,
            clock_rate=b.time_map.clock_rate / a.time_map.clock_rate,
            fundamental=None if in_one_place else fundamental_from(relative_pose_between(a.pose, b.pose), *matrices),
            inliers=None if fit is None else fit.inliers,
            rms_px=None if fit is None or not np.isfinite(fit.residual_px) else fit.residual_px,
            acceptance=pair.acceptance,
        )
    return isolated_pair_report(pair, solution.prepared)


def isolated_pair_report(pair: PairSolution, prepared: PreparedSession) -> PairReport:
    """Report of a pair from its own solution, where no joint solution contains both cameras."""
    fit = pair.fit
    if fit is None or not pair.solved:
        return PairReport((pair.a, pair.b), pair.status, fundamental=pair.fundamental, acceptance=pair.acceptance)
    matrix = pair.fundamental
    if matrix is None:
        lenses = [prepared.camera(name).intrinsics.matrix for name in (pair.a, pair.b)]
        matrix = fundamental_from(fit.geometry, *lenses)
    return PairReport(
        (pair.a, pair.b),
        pair.status,
        pair_lag(prepared, pair, fit),
        fit.rate * prepared.time_scale(pair.b) / prepared.time_scale(pair.a),
        matrix,
        fit.inliers,
        fit.residual_px,
        pair.acceptance,
    )


def _camera_clock(state: AdjustmentState, names: list[str], name: str, internal: float, solution: Solution) -> float:
    """Time on a camera's own clock at an internal time."""
    prepared = solution.prepared
    observed = float(state.cameras[names.index(name)].camera_time(np.array([internal]))[0])
    return observed / prepared.time_scale(name) + prepared.time_origins[name]
