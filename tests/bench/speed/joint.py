"""The joint adjustment of ten cameras, beside scipy's and Ceres' least squares on the same cost from the same start.

One spline path, ten poses, nine time maps; noise and motion prior fixed, so that all minimise the same cost. The
start: true poses turned by 0.2° and shifted by 2 cm, clocks 2 ms off, the path triangulated from those. Each is
timed until it stops; a peer that stops above our cost by more than 1e-4 of it is marked. Ceres is called from Python
(pyceres, ``ceres.py``), so its residuals are made by our own vectorised code; what is compared is its CPU without any
evaluation of residuals and derivatives, ours with. A recorded flight stands beside: the rows that `calibrate` keeps of
it, from the poses and path with which it begins its final adjustment.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_array, csr_array

from deploy.agents.malloc_tuning import retain_freed_memory
from hub.bundle.adjustment import apply_step, minimise
from hub.bundle.bordered_system import THIRD_DIFFERENCE, third_differences
from hub.bundle.initialisation import _camera_state, triangulate_and_adjust
from hub.bundle.normal_equations import build_system
from hub.bundle.preprocessing import prepare
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, Column, FreeParameters, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from hub.calibration import final_adjustment, pipeline
from hub.clocks.clock_graph import ClockGraph, TimeMapEstimate
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats, Ints
from protocols.session.observations import read_observations
from protocols.session.rig import read_rig
from tests.bench.speed.rows import Limit, Row, Section
from tests.support import rigs
from tests.support.bundles import LinearisedResiduals, linearise

GIVEN_PARAMETERS = 11  # columns of a camera with given intrinsics
_CAMERAS = 10
SIGMA_PX = 0.5
_EDGE_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One problem and where it is begun."""

    problem: Problem
    start: AdjustmentState
    prior: SmoothnessPrior

    @property
    def rows(self) -> int:
        """Observations that count."""
        return sum(int(part.use.sum()) for part in self.problem.rows)

    def cost(self, state: AdjustmentState) -> float:
        """The sum that all minimise."""
        return build_system(self.problem, state, self.prior, False)[1]


def make(seed: int, seconds: float, cameras: int = _CAMERAS) -> Task:
    """A rig with ground truth, and a perturbed start."""
    rng = np.random.default_rng([seed, 16])
    session = rigs.simulate(seed, cameras, seconds, fps=(30.0,), drops=0.0, late=0.5, noise=SIGMA_PX)
    prepared = prepare(session.rig, session.observations())
    clocks, poses, names = {}, {}, list(prepared.cameras)
    for name, camera in prepared.cameras.items():
        (track,) = camera.tracks.values()
        true, clock_origin = session.clocks[name], prepared.time_origins[name]
        centre = float(np.mean(track.time[[0, -1]]))
        offset = true.clock_rate * (centre + clock_origin) + true.time_offset + rng.normal(0, 2e-3)
        clocks[name] = TimeMapEstimate(true.clock_rate, offset, centre)
        pose, turn = session.poses[name], so3.exp(np.radians(rng.normal(0, 0.2, 3)))
        poses[name] = Pose(turn @ pose.rotation, pose.position + rng.normal(0, 0.02, 3))
    apart = poses[names[1]].position - poses[names[0]].position
    turn = _onto_x(apart)
    poses = {name: Pose(pose.rotation @ turn.T, turn @ pose.position) for name, pose in poses.items()}
    graph = ClockGraph(clocks, (), ())
    placed = {name: _camera_state(prepared.cameras[name], graph, poses[name]) for name in poses}
    reconstruction = triangulate_and_adjust(
        prepared.cameras, placed, prepared.rows, prepared.labels, (names[0], names[1]), None
    )
    state = replace(reconstruction.state, sigma=np.full(len(names), SIGMA_PX))
    problem = replace(reconstruction.problem, free_parameters=FreeParameters())
    basis = state.trajectories[0].basis
    rows = []
    for part in problem.rows:
        at = state.cameras[part.camera].reference_time(part.time)
        rows.append(part.using((at > basis.begin + _EDGE_S) & (at < basis.end - _EDGE_S)))
    problem = replace(problem, rows=tuple(rows))
    return Task(problem, state, estimate_smoothness(problem, state))


def recorded(session: Path) -> Task:
    """The final adjustment of a recording: inliers, noise and motion prior of its end, begun where it began."""
    rig, calls = read_rig(session / "rig.toml"), list[tuple[AdjustmentState, Any]]()

    def kept(problem: Problem, state: AdjustmentState, **options: Any) -> Any:
        ended = pipeline_adjust(problem, state, **options)
        calls.append((state, ended))
        return ended

    pipeline_adjust = final_adjustment.adjust
    with patch.object(final_adjustment, "adjust", kept):
        pipeline.calibrate(rig, read_observations(session / "observations.csv", rig.cameras))
    start, (problem, end, prior) = calls[0]
    first, second = (start.cameras[camera].pose for camera in problem.anchors)
    turn = _onto_x(second.position - first.position)
    cameras = [
        replace(camera, pose=Pose(camera.pose.rotation @ turn.T, turn @ camera.pose.position))
        for camera in start.cameras
    ]
    paths = [replace(path, control=path.control @ turn.T) for path in start.trajectories]
    start = replace(start, cameras=tuple(cameras), trajectories=tuple(paths), sigma=end.sigma)
    return Task(problem, start, SmoothnessPrior(prior.weights, (None,) * len(paths)))


def _onto_x(direction: Floats) -> Floats:
    """A rotation (3, 3) that brings a direction onto the x axis."""
    x = direction / np.linalg.norm(direction)
    y = np.cross(x, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def ours(task: Task) -> AdjustmentState:
    """The same loop as `adjust` runs, to its fine end."""
    return minimise(task.problem, task.start, task.prior, False, 40, 1e-7, [], False)


class Stacked:
    """The same sum as a vector of residuals over one vector of steps from the start: path first, then cameras."""

    def __init__(self, task: Task) -> None:
        self.task = task
        columns = task.problem.free_columns
        # What holds the gauge: the first camera, and the second one's place along the baseline, which is the x axis.
        first, second = (camera * CAMERA_PARAMETERS for camera in task.problem.anchors)
        held = np.r_[first : first + 6, second + 3]
        self.moves = ~np.isin(columns, held)
        self.columns = columns[self.moves]
        self.path = 3 * task.start.trajectories[0].basis.size
        self.size = self.path + len(self.columns)
        self.place = np.full(len(task.start.cameras) * CAMERA_PARAMETERS, -1)
        self.place[self.columns] = self.path + np.arange(len(self.columns))
        self.root = np.sqrt(task.prior.weights[0])
        self.sigma = [float(task.start.sigma[part.camera]) for part in task.problem.rows]

    def state(self, x: Floats) -> AdjustmentState:
        """The state that a vector means."""
        cameras = np.zeros(len(self.moves))
        cameras[self.moves] = x[self.path :]
        return apply_step(self.task.problem, self.task.start, x[: self.path], cameras)

    def lines(self, x: Floats) -> list[LinearisedResiduals]:
        """Residuals and derivatives by camera."""
        state = self.state(x)
        path = state.trajectories[0]
        return [linearise(part, state.cameras[part.camera], path, GIVEN_PARAMETERS) for part in self.task.problem.rows]

    def residual(self, x: Floats) -> Floats:
        """(rows,) all residuals in units of their noise, the priors' behind them."""
        state = self.state(x)
        parts = [line.residual.ravel() / sigma for line, sigma in zip(self.lines(x), self.sigma, strict=True)]
        path = state.trajectories[0]
        parts.append((self.root[:, None] * third_differences(path.basis, path.control)).ravel())
        parts.append(np.array([(camera.rate - 1.0) / FreeParameters().rate_std for camera in state.cameras]))
        return np.concatenate(parts)

    def jacobian(self, x: Floats) -> csr_array:
        """Derivatives (rows, size)."""
        rows: list[Ints] = []
        columns: list[Ints] = []
        values: list[Floats] = []
        top = 0
        for part, line, sigma in zip(self.task.problem.rows, self.lines(x), self.sigma, strict=True):
            count = len(line.index)
            number = top + np.arange(2 * count).reshape(count, 2)
            at = 3 * (line.index[:, None] + np.arange(4))[:, :, None] + np.arange(3)
            block = line.point_jacobian[:, :, None, :] * line.weights[:, None, :, None] / sigma
            shape = (count, 2, 4, 3)
            rows.append(np.broadcast_to(number[:, :, None, None], shape).ravel())
            columns.append(np.broadcast_to(at[:, None], shape).ravel())
            values.append(block.ravel())
            mine = self.place[part.camera * CAMERA_PARAMETERS : part.camera * CAMERA_PARAMETERS + GIVEN_PARAMETERS]
            free = np.flatnonzero(mine >= 0)
            rows.append(np.repeat(number.ravel(), len(free)))
            columns.append(np.tile(mine[free], 2 * count))
            values.append((line.camera_jacobian[:, :, free] / sigma).ravel())
            top += 2 * count
        starts = self.task.start.trajectories[0].basis.interval_starts()
        number = top + np.arange(3 * len(starts)).reshape(-1, 3)
        for k, coefficient in enumerate(THIRD_DIFFERENCE):
            rows.append(number.ravel())
            columns.append((3 * (starts + k)[:, None] + np.arange(3)).ravel())
            values.append(np.repeat(coefficient * self.root, 3))
        top += 3 * len(starts)
        for camera in range(len(self.task.start.cameras)):
            column = self.place[camera * CAMERA_PARAMETERS + Column.RATE]
            if column >= 0:
                rows.append(np.array([top + camera]))
                columns.append(np.array([column]))
                values.append(np.array([1.0 / FreeParameters().rate_std]))
        top += len(self.task.start.cameras)
        shape2 = (top, self.size)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return csr_array(coo_array(entries, shape=shape2))

    def pattern(self, x: Floats) -> csr_array:
        """Where derivatives may stand: the control points on either side too, for rows that cross a knot."""
        filled = self.jacobian(x).tocoo()
        rows, columns = [filled.coords[0]], [filled.coords[1]]
        path = filled.coords[1] < self.path
        for shift in (-3, 3):
            other = filled.coords[1][path] + shift
            inside = (other >= 0) & (other < self.path)
            rows.append(filled.coords[0][path][inside])
            columns.append(other[inside])
        at = (np.concatenate(rows), np.concatenate(columns))
        return csr_array(coo_array((np.ones(len(at[0])), at), shape=filled.shape))


def scipy_sparse(task: Task, limit_s: float, given: bool) -> tuple[float, AdjustmentState, bool]:
    """CPU, where it ended, and whether it ended by itself. given: our derivatives; else differences by its sparsity."""
    whole = Stacked(task)
    start = np.zeros(whole.size)
    last = [start]

    class Late(Exception):
        """Out of time."""

    began = time.process_time()

    def residual(x: Floats) -> Floats:
        if time.process_time() - began > limit_s:
            raise Late
        last[0] = x
        return whole.residual(x)

    how: dict[str, Any] = {"jac": whole.jacobian} if given else {"jac_sparsity": whole.pattern(start)}
    ended = True
    try:
        how |= {"x_scale": "jac", "tr_solver": "lsmr", "ftol": 1e-7, "xtol": 1e-12, "gtol": 1e-12}
        found = least_squares(residual, start, **how)
        last[0] = found.x
    except Late:
        ended = False
    return time.process_time() - began, whole.state(last[0]), ended


def measure(quick: bool, data: Path) -> Section:
    """A simulated rig and a recorded flight; the peers' limits of time are many times ours."""
    retain_freed_memory()  # as `calibrate` does
    seconds = 30.0 if quick else 600.0
    length = f"{seconds / 60:g} min" if seconds >= 60 else f"{seconds:g} s"
    found = Section()
    _compare(found, f"joint adjustment, {_CAMERAS} cameras × {length} at 30 fps", make(16, seconds), quick, True)
    if (data / "drone2").is_dir():
        _compare(found, "joint adjustment, drone2", recorded(data / "drone2"), quick, False)
    else:
        found.missing.append(f"joint adjustment, drone2: not in {data}")
    return found


def _compare(found: Section, work: str, task: Task, quick: bool, with_scipy: bool) -> None:
    """Ours and Ceres in turn, the median of each; scipy's least squares once."""
    times, peers, state, solved = list[float](), list[float](), task.start, None
    for _ in range(5 if quick or not with_scipy else 3):
        began = time.process_time()
        state = ours(task)
        times.append(time.process_time() - began)
        try:
            from tests.bench.speed import ceres
        except ImportError:
            continue
        solved = ceres.solve(Stacked(task))
        peers.append(solved.alone_s)
    mine, reached = float(np.median(times)), task.cost(state)
    size = f"{task.rows} rows, {Stacked(task).size} unknowns"

    def comparison(other: AdjustmentState, ended: bool = True) -> str:
        above = task.cost(other) / reached - 1.0
        late = "" if ended else ", out of time"
        return "" if ended and above < 1e-4 else f"stopped {100 * above:.2g} % above our cost{late}"

    limit = (20.0 if quick else 30.0) * max(mine, 0.5)
    if with_scipy:
        cpu, other, ended = scipy_sparse(task, limit, given=False)
        found.rows.append(
            Row(work, mine, "s", "scipy least_squares, its sparsity", cpu, must=Limit("ratio", 5.0),
                note="; ".join(part for part in (size, comparison(other, ended)) if part))
        )  # fmt: skip
        cpu, other, ended = scipy_sparse(task, limit, given=True)
        found.rows.append(Row(work, mine, "s", "scipy, given our derivatives", cpu, note=comparison(other, ended)))
    if solved is None:
        found.missing.append(f"{work} beside Ceres: pyceres is not installed (extra bench)")
        return
    note = f"its own CPU without evaluations; {solved.whole_s:.2g} s with its residuals made in Python"
    note = "; ".join(part for part in (size, note, comparison(solved.state)) if part)
    must, beside = None if with_scipy else Limit("ratio", 0.6), float(np.median(peers))
    found.rows.append(
        Row(work, mine, "s", "Ceres alone (pyceres)", beside, must=must, reach=Limit("ratio", 1.0), note=note)
    )
