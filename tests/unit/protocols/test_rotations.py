"""Rotations: one vector and many of them, which are computed in different ways."""

from __future__ import annotations

import numpy as np

from protocols.geometry import so3


def test_one_vector_gives_what_a_batch_gives() -> None:
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(8, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for angle in (0.0, 1e-9, 0.99e-4, 1.01e-4, 0.3, 3.1):
        vectors = angle * directions
        for vector, turned, crossed in zip(vectors, so3.exp(vectors), so3.hat(vectors), strict=True):
            np.testing.assert_allclose(so3.exp(vector), turned, atol=4e-16)
            np.testing.assert_array_equal(so3.hat(vector), crossed)
