"""How long two cameras saw one target at the same time, by times of arrival."""

from __future__ import annotations

from typing import Any

import numpy as np

from protocols.geometry.types import Ints

MOST_PARTNERS = 12
"""Of one camera, those with most overlap: the clock graph needs two, and a third to check them."""
BIN_S = 0.5
"""Length of a bin; priors by times of arrival are at most as far apart (``_MAX_PRIOR_WINDOW``), so neighbours count."""


def common_seconds(camera: Ints, key: Ints, targets: int, cameras: int) -> Any:
    """Sparse (cameras, cameras) seconds in which both saw one target, to within a bin.

    camera, key: (n,) who saw, and bin times ``targets`` plus target.
    """
    from scipy.sparse import csr_array  # slow to import, and needed by large networks only

    if not len(camera):
        return csr_array((cameras, cameras))
    # A bin and its neighbours, which are as many keys away as there are targets.
    near = np.concatenate([key, key - targets, key + targets])
    columns, column = np.unique(near, return_inverse=True)
    shape = (cameras, len(columns))
    exact = csr_array((np.ones(len(key)), (camera, column[: len(key)])), shape)
    around = csr_array((np.ones(len(near)), (np.tile(camera, 3), column)), shape)
    around.data[:] = 1.0  # several neighbours of one bin were added up
    counts: Any = exact @ around.T
    return csr_array(BIN_S * counts.maximum(counts.T))
