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
    (n, m), (row, column) = ratio.shape, np.nonzero(ratio)
    pair = ratio[row, column]
    weighted = pair  # few pairs are inside the gate: sums over the pairs of each target, of each detection
    for _ in range(_ITERATIONS if min(n, m) > 1 else 1):
        to_detection = pair / (1.0 + (np.bincount(row, weighted, n)[row] - weighted))
        weighted = pair / (1.0 + (np.bincount(column, to_detection, m)[column] - to_detection))
    to_detection = pair / (1.0 + (np.bincount(row, weighted, n)[row] - weighted))
    probability = np.zeros((n, m))
    probability[row, column] = weighted / (1.0 + np.bincount(row, weighted, n)[row])
    return probability, np.asarray(1.0 / (1.0 + np.bincount(column, to_detection, m)))
