"""Array types of the numeric code: everything is float64, but for images."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float64]
"""float64 array; shapes are given in the docstrings."""
Ints: TypeAlias = npt.NDArray[np.int64]
Bools: TypeAlias = npt.NDArray[np.bool_]
Singles: TypeAlias = npt.NDArray[np.float32]
Image: TypeAlias = npt.NDArray[np.uint8]
"""(h, w) grey, or (h, w, 3) with channels in OpenCV's order: blue, green, red."""
