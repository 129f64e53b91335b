"""Whether a camera was bumped: a likelihood-ratio test over the latest observations of all its edges (step 8).

Each edge keeps robust sums of its latest observations about where the network predicted them. "This camera moved by
one step" must explain them far better than "nothing moved", and must do so without the edge that speaks loudest: what
one edge says alone is that neighbour's affair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.distributed.factors.factor import Edge, Window
from protocols.geometry.types import Floats

RAISED = 55.0
"""Chi2 (6 dof) of the motion that is an alarm; by chance less than once in 1e9 tests."""
CONFIRMED = 22.0
"""The same without the loudest edge."""
_SHORT, _LONG = 48, 400
"""Observations of all edges after which a window begins anew."""
_ARMED = 4.0
"""Times that an edge's past must outweigh its window."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """An edge and the derivative (6, 6) of its step by the camera's."""

    edge: Edge
    by_step: Floats


def camera_moved(motions: list[Motion]) -> Floats | None:
    """The camera's step (6,), or None while nothing says that it moved. Renews windows that are full."""
    found = None
    for short in (True, False):
        windows = [(m, m.edge.short if short else m.edge.long) for m in motions]
        count = sum(window.count for _, window in windows)
        if count == 0:
            continue
        armed = [(m, w) for m, w in windows if m.edge.seen > _ARMED * w.count and w.count > 0]
        step = _test(armed)
        if step is not None:
            found = step
        if count > (_SHORT if short else _LONG):
            for m, _ in windows:
                if short:
                    m.edge.short = Window.empty()
                else:
                    m.edge.long = Window.empty()
    return found


def _test(windows: list[tuple[Motion, Window]]) -> Floats | None:
    if len(windows) < 2:
        return None
    by_step = np.array([motion.by_step for motion, _ in windows])
    turned = by_step.transpose(0, 2, 1)
    # The past is uncertain too, by its share.
    share = np.array([1.0 / (1.0 + 2.0 * window.count / max(motion.edge.seen, 1)) for motion, window in windows])
    hessians = turned @ np.array([window.hessian for _, window in windows]) @ by_step * share[:, None, None]
    gradients = (turned @ np.array([window.gradient for _, window in windows])[:, :, None])[:, :, 0] * share[:, None]
    whole, together = gradients.sum(axis=0), hessians.sum(axis=0)
    if _most(together, whole) < 0.99 * RAISED:
        return None
    chi2, step = _evidence(together, whole)
    if chi2 < RAISED:
        return None
    for hessian, gradient in zip(hessians, gradients, strict=True):
        if _evidence(together - hessian, whole - gradient)[0] < CONFIRMED:
            return None
    return step


def _most(hessian: Floats, gradient: Floats) -> float:
    """Chi2 of the best step to 1 %, or more where a direction has no information. Cheap, for calm times."""
    scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-300))
    normalised = hessian * scale * scale[:, None]
    normalised.flat[::7] += 1e-9
    pull = scale * gradient
    return float(pull @ np.linalg.solve(normalised, pull))


def _evidence(hessian: Floats, gradient: Floats) -> tuple[float, Floats]:
    """Chi2 of the best step, and the step (6,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
    inverse = np.where(values > 1e-6, 1.0 / np.maximum(values, 1e-6), 0.0)
    step = -scale * (vectors @ (inverse * (vectors.T @ (scale * gradient))))
    return float(-gradient @ step), step
