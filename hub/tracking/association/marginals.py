"""Marginal association probabilities by belief propagation."""

from __future__ import annotations

import numpy as np

from protocols.geometry.types import Floats

_ITERATIONS = 12
"""Messages contract by a constant factor each time; after twelve, no probability of a crowd of 20 changed by 0.01."""


def marginal_probabilities(ratio: Floats) -> tuple[Floats, Floats]:
    """Probabilities (n, m) that target i generated detection j, and (m,) that no target generated detection j.

    ratio: (n, m), the likelihood of the pair over that of a missed target and a false detection; 0 outside the gate.
    Each target generates at most one detection and each detection has at most one target. Williams and Lau,
    "Approximate evaluation of marginal association probabilities with belief propagation" (2014).
    """
    to_target = np.ones_like(ratio)
    for _ in range(_ITERATIONS if min(ratio.shape) > 1 else 1):
        weighted = ratio * to_target
        to_detection = ratio / (1.0 + weighted.sum(axis=1, keepdims=True) - weighted)
        to_target = 1.0 / (1.0 + to_detection.sum(axis=0) - to_detection)
    weighted = ratio * to_target
    to_detection = ratio / (1.0 + weighted.sum(axis=1, keepdims=True) - weighted)
    return weighted / (1.0 + weighted.sum(axis=1, keepdims=True)), 1.0 / (1.0 + to_detection.sum(axis=0))
