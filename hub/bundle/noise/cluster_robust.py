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
from hub.bundle.problem import CAMERA_PARAMETERS, LARGE_NETWORK, AdjustmentState, Problem, UsedRows
from hub.bundle.residuals import StackedTrajectories, evaluate_labels, jacobians
from protocols.geometry.types import Floats


def cluster_robust(problem: Problem, state: AdjustmentState, found: Covariance, bodies: Sequence[str]) -> Covariance:
    """``found`` with the delete-one-block jackknife's covariance of the cameras' parameters.

    bodies: by label, whose point it is; errors of one body's points are together. A block is one body's rows within
    `MAX_LAG_S`. What is known beside the rows, as of priors and control points, counts as in ``found``; with no more
    blocks than parameters, or in a large network, of which no dense covariance is made, nothing changes.
    """
    number = {
        (rows.camera, rows.label): np.floor(state.cameras[rows.camera].reference_time(rows.time[rows.use]) / MAX_LAG_S)
        for rows in problem.rows
    }
    count = len({(bodies[label], block) for (_, label), blocks in number.items() for block in blocks.tolist()})
    if count <= len(found.columns) or len(state.cameras) > LARGE_NETWORK:
        return found
    values, axes = np.linalg.eigh(found.free.submatrix(np.arange(len(found.columns))))
    root = axes * np.sqrt(np.maximum(values, 0.0))
    spread, paths = np.eye(len(root)), StackedTrajectories.of(state.by_label)
    for body in dict.fromkeys(bodies):
        blocks: dict[float, Floats] = {}
        for rows in (one for one in problem.rows if bodies[one.label] == body and one.use.any()):
            seen = evaluate_labels(UsedRows.of([rows]), state.cameras[rows.camera], paths)
            weight = np.where(seen.valid, np.sqrt(seen.relative_information), 0.0) / float(state.sigma[rows.camera])
            jacobian = weight * seen.whitened(jacobians(seen, state.cameras[rows.camera], range(CAMERA_PARAMETERS)))
            moves = profiled_jacobian(problem, found, rows, seen, jacobian.transpose(2, 0, 1))
            moves = moves @ root[found.a_inv_b.parts[rows.label][1]]  # by parameters in stds
            left = (weight * seen.whitened(seen.residual)).T
            for block in np.unique(number[rows.camera, rows.label]).tolist():
                here = number[rows.camera, rows.label] == block
                parts = np.column_stack([moves[here].reshape(-1, len(root)), left[here].ravel()])
                parts = np.concatenate([blocks[block], parts]) if block in blocks else parts
                # Orthogonal to these are no moves: an hour of a body needs no more memory than its blocks.
                blocks[block] = np.linalg.qr(parts).R if len(parts) > 2 * parts.shape[1] else parts
        for parts in blocks.values():
            move, residual = parts[:, :-1], parts[:, -1]
            spread -= move.T @ move
            along, size, across = np.linalg.svd(move, full_matrices=False)
            # How far the estimate moves without the block, in stds; none has more of the information than all of it.
            moved = (size / np.maximum(1.0 - size**2, 1.0 / count) * (residual @ along)) @ across
            spread += (1.0 - 1.0 / count) * np.outer(moved, moved)
    return replace(found, free=DenseCovariance(np.asarray(root @ spread @ root.T)))
