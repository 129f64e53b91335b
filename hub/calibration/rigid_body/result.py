"""The published calibration of an adjusted rigid-body problem: world, clocks, stds, trajectories of the corners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hub.bundle.datum.gauge import fix_gauge
from hub.bundle.initialisation import SEEN_WITHIN_S, seen_by_two
from hub.bundle.problem import CAMERA_PARAMETERS, Column
from hub.calibration.notes import jitter_notes, readout_notes
from hub.calibration.rigid_body.adjustment import BodyCovariance, body_covariance, path_covariance, residuals
from hub.calibration.rigid_body.lag import BodyPair
from hub.calibration.rigid_body.problem import BodyProblem, BodyState, frame_interval
from hub.trajectory.discrete import INSTANT_TOLERANCE_S, PointBasis
from hub.two_view.relative_pose import fundamental_from, relative_pose_between
from protocols.core.acceptance import PairReport
from protocols.core.clocks import TimeMap
from protocols.core.version import VERSION
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, CameraCalibration, FixedCalibration, TrajectoryTable
from protocols.session.rig import Rig, longest_readout

_MAX_SAMPLES = 1_000_000  # of one path
_SCALE_CONFLICT = 0.02  # relative difference of the board's scale from the control points' that is reported


@dataclass(frozen=True, slots=True, eq=False)
class BodySolution:
    """An adjusted problem. names: its cameras, in order. estimated: stds of lenses that an earlier
    adjustment of the same views estimated, as ``lens_stds``."""

    labels: list[str]
    names: list[str]
    problem: BodyProblem
    state: BodyState
    pairs: Mapping[tuple[str, str], BodyPair]
    refused: dict[str, str]
    known: FixedCalibration | None = None
    warnings: tuple[str, ...] = ()
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)

    def lens_stds(self) -> dict[str, tuple[float, float]]:
        """Of each estimated lens, the relative std of the focal length and the std of the optical axis [rad]."""
        covariance, out = body_covariance(self.problem, self.state), dict(self.estimated)
        for i, name in enumerate(self.names):
            if self.problem.free_lens[i]:
                centre = max(covariance.std(i, Column.CENTRE), covariance.std(i, Column.CENTRE + 1))
                out[name] = covariance.std(i, Column.FOCAL), centre / self.state.cameras[i].intrinsics.focal
        return out


def publish(rig: Rig, solution: BodySolution) -> Calibration:
    """The calibration in the rig's world and units, on the reference camera's clock."""
    problem, state, names = solution.problem, solution.state, solution.names
    covariance = body_covariance(problem, state)
    world, scale, warnings = _world(rig, solution)
    requested = rig.metadata.get("reference")
    reference = names.index(requested) if requested in names else 0
    stds = solution.lens_stds()
    maps = [_time_map(problem, state, i, reference) for i in range(len(names))]
    longest = {name: longest_readout(rig.cameras[name].fps) for name in names}
    cameras = {
        name: CameraCalibration(
            name=name,
            intrinsics=state.cameras[i].intrinsics,
            pose=world.pose(state.cameras[i].pose),
            time_map=maps[i],
            time_offset_std=_relative_std(covariance, i, reference, Column.OFFSET),
            position_std=_position_std(covariance, i, world)
            if solution.known is None
            else solution.known.cameras[name].position_std,
            rms_px=_rms(problem, state, i),
            focal_std=stds[name][0] if name in stds else 0.0,
            readout=float(np.clip(state.cameras[i].readout, -longest[name], longest[name])),
            readout_std=covariance.std(i, Column.READOUT),
            lag_time=state.cameras[i].centre + problem.views[i].time_origin,
            lag_std=_relative_std(covariance, i, reference, Column.OFFSET),
            clock_rate_std=_relative_std(covariance, i, reference, Column.RATE),
        )
        for i, name in enumerate(names)
    }
    return Calibration(
        cameras=cameras,
        reference=names[reference],
        scale=scale,
        units=rig.units,
        solver="joint",
        version=VERSION,
        refused={name: solution.refused[name] for name in rig.cameras if name in solution.refused},
        trajectories=_trajectories(rig, solution, covariance, world, reference),
        pairs=tuple(_pair(solution, cameras, pair, found) for pair, found in solution.pairs.items()),
        warnings=(*solution.warnings, *warnings, *_notes(solution, cameras, stds)),
        residuals={name: _residual_rows(problem, state, i) for i, name in enumerate(names)},
        convergence=state.steps,
    )


def _world(rig: Rig, solution: BodySolution) -> tuple[Similarity, str, tuple[str, ...]]:
    """The similarity to the published world, its scale, and warnings.

    The bodies' size gives the scale, unless it is not known, or positions or distances in the rig do.
    """
    if solution.known is not None:
        return Similarity(1.0, np.eye(3), np.zeros(3)), solution.known.scale, ()
    poses = [camera.pose for camera in solution.state.cameras]
    gauge = fix_gauge(rig, solution.names, poses)
    s = gauge.similarity
    if gauge.scale == "metric":
        warnings = gauge.warnings
        if rig.bodies_metric and abs(s.scale - 1.0) > _SCALE_CONFLICT:
            off = f"{100 * abs(s.scale - 1.0):.1f} % {'larger' if s.scale > 1.0 else 'smaller'}"
            warnings += (f"the control points make the board {off} than board.toml: is square_size right?",)
        return s, "metric", warnings
    if not rig.bodies_metric:
        return s, "arbitrary", gauge.warnings
    # Only the size of the default world, whose first baseline is 1, is replaced.
    return (
        Similarity(1.0, s.rotation, s.shift / s.scale),
        "metric",
        tuple(text for text in gauge.warnings if "fix no scale" not in text),
    )


def _time_map(problem: BodyProblem, state: BodyState, camera: int, reference: int) -> TimeMap:
    if camera == reference or not problem.clock:
        return TimeMap(1.0, 0.0)
    now, base = state.cameras[camera], state.cameras[reference]
    rate = now.rate / base.rate
    at_centre = (now.offset - base.offset) / base.rate + base.centre + problem.views[reference].time_origin
    return TimeMap(rate, at_centre - rate * (now.centre + problem.views[camera].time_origin))


def _relative_std(covariance: BodyCovariance, camera: int, reference: int, column: int) -> float:
    """Std of a clock parameter against the reference camera's."""
    if camera == reference:
        return 0.0
    both = [camera * CAMERA_PARAMETERS + column, reference * CAMERA_PARAMETERS + column]
    block = covariance.cameras[np.ix_(both, both)]
    return float(np.sqrt(max(block[0, 0] + block[1, 1] - 2.0 * block[0, 1], 0.0)))


def _position_std(covariance: BodyCovariance, camera: int, world: Similarity) -> Floats:
    block = covariance.block(camera)[3:6, 3:6]
    return np.asarray(world.scale * np.sqrt(np.maximum(np.diag(world.rotation @ block @ world.rotation.T), 0.0)))


def _rms(problem: BodyProblem, state: BodyState, camera: int) -> float:
    values, good = residuals(problem, state, camera)
    return float(np.sqrt((values[good] ** 2).sum(axis=1).mean())) if good.any() else 0.0


def _residual_rows(problem: BodyProblem, state: BodyState, camera: int) -> Floats:
    values, good = residuals(problem, state, camera)
    views = problem.views[camera]
    stamps = views.time[views.view] + views.time_origin
    return np.column_stack([stamps, views.pixels, -values])[good]


def _notes(
    solution: BodySolution, cameras: Mapping[str, CameraCalibration], stds: Mapping[str, tuple[float, float]]
) -> tuple[str, ...]:
    lenses = tuple(
        f"{name}: its lens was estimated from the board: focal length {camera.intrinsics.focal:.1f} px ± "
        f"{100 * stds[name][0]:.2g} %, optical axis ± {np.degrees(stds[name][1]):.2g}° (stds)"
        for name, camera in cameras.items()
        if name in stds
    )
    rolling = {name: one for name, one in cameras.items() if abs(one.readout) > 3.0 * one.readout_std}
    return (
        lenses + jitter_notes(solution.names, solution.state.jitter, "the board") + readout_notes(rolling, "the board")
    )


def _trajectories(
    rig: Rig, solution: BodySolution, covariance: BodyCovariance, world: Similarity, reference: int
) -> tuple[TrajectoryTable, ...]:
    problem, state = solution.problem, solution.state
    base, origin = state.cameras[reference], problem.views[reference].time_origin
    fastest = min(frame_interval(views) for views in problem.views)
    rate = max([1.0 / fastest, *(rig.cameras[name].fps for name in solution.names)])
    out = []
    owner = {label: (number, point) for number, body in enumerate(rig.bodies.values()) for label, point in body.items()}
    seen = sorted({int(number) for views in solution.problem.views for number in np.unique(views.body)})
    order = {number: i for i, number in enumerate(seen)}
    for number, place in order.items():
        motion = state.bodies[place]
        within = SEEN_WITHIN_S
        if isinstance(motion.basis, PointBasis):
            within = INSTANT_TOLERANCE_S
            ticks = base.camera_time(motion.basis.instants) + origin
        else:
            first, last = base.camera_time(np.array([motion.basis.begin, motion.basis.end])) + origin
            step = max(1.0 / rate, (last - first) / _MAX_SAMPLES)
            ticks = np.arange(np.ceil(first / step), np.floor(last / step) + 1) * step
        internal = base.reference_time(ticks - origin)
        path = path_covariance(state, covariance, place, internal)
        for index, label in enumerate(solution.labels):
            if owner[label][0] != number:
                continue
            good = seen_by_two(_observed(problem, state, index), internal, within, within)
            point = owner[label][1] + state.shape[index]
            position = motion.points(internal[good], point)
            finite = np.isfinite(position).all(axis=1)
            time, inside = ticks[good][finite], internal[good][finite]
            if len(time):
                std = world.scale * path.point_stds(point, inside)
                out.append(TrajectoryTable(label, time, world.points(position[finite]), std))
    return tuple(out)


def _observed(problem: BodyProblem, state: BodyState, label: int) -> list[Floats]:
    """Sorted internal times at which a label was observed, by camera that observed it."""
    every = zip(problem.views, problem.use, state.cameras, strict=True)
    seen = ((views.time[np.unique(views.view[use & (views.label == label)])], camera) for views, use, camera in every)
    return [np.sort(camera.reference_time(times)) for times, camera in seen if len(times)]


def _pair(
    solution: BodySolution, cameras: Mapping[str, CameraCalibration], pair: tuple[str, str], found: BodyPair
) -> PairReport:
    """A pair's report, from the joint solution where both cameras are in it."""
    if not all(name in cameras for name in pair):
        return PairReport(pair, found.reason or "ok", None if found.reason else -found.lag)
    a, b = (cameras[name] for name in pair)
    views = [solution.problem.views[solution.names.index(name)] for name in pair]
    spans = [
        [
            camera.time_map.clock_rate * (t + v.time_origin) + camera.time_map.time_offset
            for t in (v.time.min(), v.time.max())
        ]
        for camera, v in zip((a, b), views, strict=True)
    ]
    middle = 0.5 * (max(spans[0][0], spans[1][0]) + min(spans[0][1], spans[1][1]))
    on_a, on_b = ((middle - camera.time_map.time_offset) / camera.time_map.clock_rate for camera in (a, b))
    try:
        matrix = fundamental_from(relative_pose_between(a.pose, b.pose), a.intrinsics.matrix, b.intrinsics.matrix)
    except ValueError:  # coincident centres
        matrix = None
    return PairReport(
        pair,
        found.reason or "ok",
        on_a - on_b,
        b.time_map.clock_rate / a.time_map.clock_rate,
        matrix,
        found.share or None,
    )
