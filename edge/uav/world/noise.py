"""Random textures (value noise) and smooth random processes; the only state is the given generator."""

from __future__ import annotations

import cv2
import numpy as np

from protocols.geometry.types import Floats, Singles


def value_noise(
    rng: np.random.Generator, rows: int, columns: int, cell: float, octaves: int = 1, gain: float = 0.5
) -> Singles:
    """Value noise (rows, columns), std about 1; ``cell`` is the coarsest cell size [px], halved with each octave."""
    total = np.zeros((rows, columns), np.float32)
    power = 0.0
    for octave in range(octaves):
        grain = max(cell / 2.0**octave, 1.0)
        small = rng.standard_normal((int(rows / grain) + 4, int(columns / grain) + 4), dtype=np.float32)
        wanted = (round(small.shape[1] * grain), round(small.shape[0] * grain))
        large = cv2.resize(small, wanted, interpolation=cv2.INTER_LINEAR) if grain > 1.0 else small
        total += np.float32(gain**octave) * np.asarray(large, np.float32)[:rows, :columns]
        power += gain ** (2 * octave) * (0.45 if grain > 1.0 else 1.0)  # interpolation takes half of the variance
    return np.asarray(total / np.float32(np.sqrt(power)), np.float32)


def smoothed_noise(rng: np.random.Generator, count: int, step_s: float, std: float, time_constant_s: float) -> Floats:
    """A stationary coloured noise (count,) of the given std: white noise through a Gaussian window.

    step_s: sampling interval. time_constant_s: std of the window; the rate of change is about std / time_constant.
    """
    sigma = time_constant_s / step_s
    reach = int(4.0 * sigma) + 1
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    window /= np.sqrt((window**2).sum())
    return np.asarray(std * np.convolve(rng.standard_normal(count + 2 * reach), window, mode="valid"))
