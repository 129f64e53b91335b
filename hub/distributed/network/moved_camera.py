"""Moved-camera test: a likelihood-ratio test over the latest observations of all edges of a camera.

Distributed pose paper, step 8. Each edge keeps robust sums of its latest observations about the network's prediction.
The hypothesis "this camera moved by one step" must explain them significantly better than "nothing moved", and must
still do so without any single edge: evidence from one edge alone means that the neighbour moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.distributed.factors.factor import Edge, Window
from protocols.geometry.types import Floats

CHI2_ALARM = 55.0
"""Chi2 (6 dof) of the motion that raises an alarm; false-alarm probability below 1e-9 per test."""
CHI2_CONFIRM = 22.0
"""The same with any single edge left out."""
_SHORT_WINDOW, _LONG_WINDOW = 48, 400
"""Observations of all edges after which a window is restarted."""
_MIN_HISTORY_RATIO = 4.0
"""Smallest ratio of an edge's observations to those in its window."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeJacobian:
    """An edge and the Jacobian (6, 6) of its step by the camera's."""

    edge: Edge
    by_step: Floats


def detect_motion(edges: list[EdgeJacobian]) -> Floats | None:
    """The camera's step (6,), or None without a significant motion. Restarts full windows."""
    found = None
    for short in (True, False):
        windows = [(m, m.edge.short_window if short else m.edge.long_window) for m in edges]
        count = sum(window.count for _, window in windows)
        if count == 0:
            continue
        testable = [
            (m, w) for m, w in windows if m.edge.observation_count > _MIN_HISTORY_RATIO * w.count and w.count > 0
        ]
        step = _likelihood_ratio_test(testable)
        if step is not None:
            found = step
        if count > (_SHORT_WINDOW if short else _LONG_WINDOW):
            for m, _ in windows:
                if short:
                    m.edge.short_window = Window.empty()
                else:
                    m.edge.long_window = Window.empty()
    return found


def _likelihood_ratio_test(windows: list[tuple[EdgeJacobian, Window]]) -> Floats | None:
    if len(windows) < 2:
        return None
    by_step = np.array([motion.by_step for motion, _ in windows])
    turned = by_step.transpose(0, 2, 1)
    # The prediction is uncertain too: discount by the window's share of the observations.
    share = np.array(
        [1.0 / (1.0 + 2.0 * window.count / max(motion.edge.observation_count, 1)) for motion, window in windows]
    )
    hessians = turned @ np.array([window.hessian for _, window in windows]) @ by_step * share[:, None, None]
    gradients = (turned @ np.array([window.gradient for _, window in windows])[:, :, None])[:, :, 0] * share[:, None]
    gradient_sum, hessian_sum = gradients.sum(axis=0), hessians.sum(axis=0)
    if _chi2_upper_bound(hessian_sum, gradient_sum) < 0.99 * CHI2_ALARM:
        return None
    chi2, step = _chi2_and_step(hessian_sum, gradient_sum)
    if chi2 < CHI2_ALARM:
        return None
    for hessian, gradient in zip(hessians, gradients, strict=True):
        if _chi2_and_step(hessian_sum - hessian, gradient_sum - gradient)[0] < CHI2_CONFIRM:
            return None
    return step


def _chi2_upper_bound(hessian: Floats, gradient: Floats) -> float:
    """Upper bound on chi2 of the best step, within 1 % where all directions have information: a cheap first test."""
    scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-300))
    normalised = hessian * scale * scale[:, None]
    normalised.flat[::7] += 1e-9
    pull = scale * gradient
    return float(pull @ np.linalg.solve(normalised, pull))


def _chi2_and_step(hessian: Floats, gradient: Floats) -> tuple[float, Floats]:
    """Chi2 of the best step, and the step (6,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
    inverse = np.where(values > 1e-6, 1.0 / np.maximum(values, 1e-6), 0.0)
    step = -scale * (vectors @ (inverse * (vectors.T @ (scale * gradient))))
    return float(-gradient @ step), step
