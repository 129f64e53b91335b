"""The joint adjustment's sum in Ceres' hands, through pyceres (extra ``bench``).

Ceres asks Python for every residual block. So that this costs little, all blocks are made at once, vectorised, when the
first one of a pass is asked for. Ceres' values lie in one array; where each block's are in it is learnt in the first
pass, which is made at the start.
"""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyceres

from hub.bundle.bordered_system import THIRD_DIFFERENCE
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, FreeParameters
from protocols.geometry.types import Floats, Ints
from tests.bench.speed.joint import Stacked

_OF_A_CAMERA = 8


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Ceres' CPU without evaluations, with them, and where it ended."""

    alone_s: float
    whole_s: float
    state: AdjustmentState


class _Pass:
    """What all blocks of one pass share. names of parameter blocks: path points first, then cameras."""

    def __init__(self, whole: Stacked, blocks: int, seen: set[int], index: list[Ints]) -> None:
        self.whole, self.blocks, self.index = whole, blocks, index
        self.asked = 0
        self.points = whole.path // 3
        self.begin = whole.task.start.trajectories[0].control
        self.address: dict[int, int] = {}
        self.place: Ints | None = None
        self.seen = np.zeros(0, dtype=np.int64)
        self.free = [
            whole.place[k * CAMERA_PARAMETERS + np.arange(_OF_A_CAMERA)] for k in range(len(whole.task.start.cameras))
        ]
        # A block of which all is held is no part of Ceres' array.
        self.moving = [k for k, mine in enumerate(self.free) if (mine >= 0).any()]
        self.known = {*seen, *(self.points + k for k in self.moving)}
        self.lines: list[tuple[Floats, Floats, Floats]] = []

    def ask(self, names: list[int], parameters: Any) -> None:
        """One block is about to be evaluated."""
        if self.asked == self.blocks:
            self.asked = 0
        if not self.lines:
            self._make(np.zeros(self.whole.size))
        if len(self.address) < len(self.known):
            for name, values in zip(names, parameters, strict=True):
                if name in self.known:
                    self.address[name] = values.__array_interface__["data"][0]
        elif self.asked == 0:
            here = parameters[0].__array_interface__["data"][0] - self.address[names[0]]
            self._make(self._vector(here))
        self.asked += 1

    def _vector(self, shift: int) -> Floats:
        lowest, last = min(self.address.values()), max(self.address, key=self.address.__getitem__)
        doubles = (self.address[last] - lowest) // 8 + (3 if last < self.points else _OF_A_CAMERA)
        raw = np.ctypeslib.as_array((ctypes.c_double * doubles).from_address(lowest + shift))
        at = {name: (address - lowest) // 8 for name, address in self.address.items()}
        if self.place is None:
            self.seen = np.array([k for k in range(self.points) if k in self.known])
            self.place = np.array([at[int(k)] for k in self.seen])[:, None] + np.arange(3)
        control = self.begin.copy()
        control[self.seen] = raw[self.place]
        cameras = [np.zeros(_OF_A_CAMERA) for _ in self.free]
        for k in self.moving:
            cameras[k] = raw[at[self.points + k] :][:_OF_A_CAMERA]
        return self.stacked(control, cameras)

    def stacked(self, control: Floats, cameras: list[Floats]) -> Floats:
        """The vector of steps."""
        x = np.zeros(self.whole.size)
        x[: self.whole.path] = (control - self.begin).ravel()
        for mine, step in zip(self.free, cameras, strict=True):
            x[mine[mine >= 0]] = step[mine >= 0]
        return x

    def _make(self, x: Floats) -> None:
        self.lines = []
        for index, line, sigma in zip(self.index, self.whole.lines(x), self.whole.sigma, strict=True):
            # A row that crossed a knot keeps the control points of the start; the one it has lost hardly weighs.
            weights = line.weights.copy()
            later, earlier = line.index > index, line.index < index
            weights[later] = np.pad(line.weights[later, :3], ((0, 0), (1, 0)))
            weights[earlier] = np.pad(line.weights[earlier, 1:], ((0, 0), (0, 1)))
            by_path = line.point_jacobian[:, :, None, :] * weights[:, None, :, None] / sigma
            self.lines.append((line.residual / sigma, by_path, line.camera_jacobian[:, :, :_OF_A_CAMERA] / sigma))


class _Rows(pyceres.CostFunction):
    """One camera's rows in one knot interval."""

    def __init__(self, shared: _Pass, number: int, rows: slice, names: list[int]) -> None:
        pyceres.CostFunction.__init__(self)
        self.shared, self.number, self.rows, self.names = shared, number, rows, names
        self.set_num_residuals(2 * (rows.stop - rows.start))
        self.set_parameter_block_sizes([3, 3, 3, 3, _OF_A_CAMERA])

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        self.shared.ask(self.names, parameters)
        residual, by_path, camera_jacobian = self.shared.lines[self.number]
        residuals[:] = residual[self.rows].ravel()
        if jacobians is not None:
            for k in range(4):
                if jacobians[k] is not None:
                    jacobians[k][:] = by_path[self.rows, :, k].ravel()
            if jacobians[4] is not None:
                jacobians[4][:] = camera_jacobian[self.rows].ravel()
        return True


class _Smooth(pyceres.CostFunction):
    """The motion prior on one knot interval."""

    def __init__(self, root: float) -> None:
        pyceres.CostFunction.__init__(self)
        self.row = root * THIRD_DIFFERENCE
        self.flat = [(value * np.eye(3)).ravel() for value in self.row]
        self.set_num_residuals(3)
        self.set_parameter_block_sizes([3, 3, 3, 3])

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        residuals[:] = self.row @ np.array(parameters)
        if jacobians is not None:
            for k in range(4):
                if jacobians[k] is not None:
                    jacobians[k][:] = self.flat[k]
        return True


class _Rate(pyceres.CostFunction):
    """The prior on one clock's rate."""

    def __init__(self, begin: float) -> None:
        pyceres.CostFunction.__init__(self)
        self.begin, self.std = begin, FreeParameters().rate_std
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([_OF_A_CAMERA])

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        residuals[0] = (self.begin + parameters[0][7] - 1.0) / self.std
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = 0.0
            jacobians[0][7] = 1.0 / self.std
        return True


def solve(whole: Stacked) -> Solved:
    """Levenberg-Marquardt with a sparse Cholesky factorisation, one thread."""
    task = whole.task
    path = task.start.trajectories[0]
    points = list(path.control.copy())
    steps = [np.zeros(_OF_A_CAMERA) for _ in task.start.cameras]
    groups: list[tuple[int, int, slice]] = []
    first = whole.lines(np.zeros(whole.size))
    for number, line in enumerate(first):
        cuts = np.flatnonzero(np.diff(line.index)) + 1
        for begin, end in zip(np.r_[0, cuts], np.r_[cuts, len(line.index)], strict=True):
            groups.append((number, int(line.index[begin]), slice(int(begin), int(end))))
    seen = {index + k for _, index, _ in groups for k in range(4)}
    shared = _Pass(whole, len(groups), seen, [line.index for line in first])
    problem = pyceres.Problem()
    kept: list[Any] = []

    def add(block: Any, blocks: list[Floats]) -> None:
        kept.append(block)
        problem.add_residual_block(block, None, blocks)

    for number, index, rows in groups:
        camera = task.problem.rows[number].camera
        names = [*range(index, index + 4), len(points) + camera]
        add(_Rows(shared, number, rows, names), [*points[index : index + 4], steps[camera]])
    for index, root in zip(path.basis.interval_starts(), whole.root, strict=True):
        add(_Smooth(float(root)), points[index : index + 4])
    for camera, mine in enumerate(shared.free):
        if (mine < 0).all():
            problem.set_parameter_block_constant(steps[camera])
        elif (mine < 0).any():
            problem.set_manifold(steps[camera], pyceres.SubsetManifold(_OF_A_CAMERA, np.flatnonzero(mine < 0).tolist()))
        else:
            add(_Rate(task.start.cameras[camera].rate), [steps[camera]])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.max_num_iterations = 50
    options.function_tolerance = 1e-7
    options.num_threads = 1
    summary = pyceres.SolverSummary()
    began = time.process_time()
    pyceres.solve(options, problem, summary)
    cpu = time.process_time() - began
    total = summary.total_time_in_seconds
    evaluating = summary.residual_evaluation_time_in_seconds + summary.jacobian_evaluation_time_in_seconds
    state = whole.state(shared.stacked(np.array(points), steps))
    return Solved(cpu * max(total - evaluating, 0.0) / total, cpu, state)
