"""Cluster-robust covariance of the cameras: how estimates vary as blocks of the recording are left out (Künsch 1989).

Where errors last, as those of silhouettes do for a second, paths follow them, and autocorrelations of what is left show
a fraction: true errors of heads in rendered rooms are correlated by 0.75 after 0.1 s and 0.4 after 0.5 s, residuals
as if there were 1.5 rows to an effective one. The score of the cameras' parameters does not depend on what a path
follows: blocks longer than errors last are independent, and the covariance is that of their scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hub.bundle.block_matrix import DenseCovariance
from hub.bundle.covariance import Covariance
from hub.bundle.noise.noise_scale import MAX_LAG_S, profiled_jacobian
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, Problem, TrackObservations, UsedRows
from hub.bundle.residuals import StackedTrajectories, evaluate_labels, jacobians
from protocols.geometry.types import Floats, Ints


def cluster_robust(problem: Problem, state: AdjustmentState, found: Covariance, bodies: Sequence[str]) -> Covariance:
    """``found`` with the delete-one-block jackknife's covariance of the cameras' parameters.

    bodies: by label, whose point it is; errors of one body's points are together. A block is one body's rows within
    `MAX_LAG_S`. What is known beside the rows, as of priors and control points, counts as in ``found``; with no more
    blocks than parameters nothing changes.
    """
    values, axes = np.linalg.eigh(found.free.submatrix(np.arange(len(found.columns))))
    root = axes * np.sqrt(np.maximum(values, 0.0))
    paths = StackedTrajectories.of(state.by_label)
    blocks = list[tuple[Floats, Floats]]()
    for body in dict.fromkeys(bodies):
        parts = [rows for rows in problem.rows if bodies[rows.label] == body and rows.use.any()]
        if parts:
            of_rows = (_of_rows(problem, state, found, paths, root, rows) for rows in parts)
            numbers, moves, residuals = map(np.concatenate, zip(*of_rows, strict=True))
            order = np.argsort(numbers, kind="stable")
            cuts = np.flatnonzero(np.diff(numbers[order])) + 1
            pieces = (np.split(one[order], cuts) for one in (moves, residuals))
            blocks += [(move.reshape(-1, len(root)), left.ravel()) for move, left in zip(*pieces, strict=True)]
    if len(blocks) <= len(root):
        return found
    spread = np.eye(len(root))
    for move, left in blocks:
        spread -= move.T @ move
        along, size, across = np.linalg.svd(move, full_matrices=False)
        # How far the estimate moves without the block, in stds; none has more of the information than all of it.
        moved = (size / np.maximum(1.0 - size**2, 1.0 / len(blocks)) * (left @ along)) @ across
        spread += (1.0 - 1.0 / len(blocks)) * np.outer(moved, moved)
    return replace(found, free=DenseCovariance(np.asarray(root @ spread @ root.T)))


def _of_rows(
    problem: Problem,
    state: AdjustmentState,
    found: Covariance,
    paths: StackedTrajectories,
    root: Floats,
    rows: TrackObservations,
) -> tuple[Ints, Floats, Floats]:
    """Of a camera's rows of a label: numbers (n,) of their blocks, derivatives (n, 2, p) of residuals by parameters in
    stds (``root`` of their covariance), and residuals (n, 2), both over the noise."""
    camera, used = state.cameras[rows.camera], UsedRows.of([rows])
    seen = evaluate_labels(used, camera, paths)
    weight = np.where(seen.valid, np.sqrt(seen.relative_information), 0.0) / float(state.sigma[rows.camera])
    jacobian = weight * seen.whitened(jacobians(seen, camera, range(CAMERA_PARAMETERS)))
    shift = profiled_jacobian(problem, found, rows, seen, jacobian.transpose(2, 0, 1))
    blocks = np.floor(camera.reference_time(used.time) / MAX_LAG_S).astype(np.int64)
    return blocks, shift @ root[found.a_inv_b.parts[rows.label][1]], (weight * seen.whitened(seen.residual)).T
