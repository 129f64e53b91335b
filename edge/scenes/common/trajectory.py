"""Smooth random trajectories of the marker: three-dimensional, band-limited and aperiodic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocols.geometry.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class SmoothPath:
    """A trajectory (x, y, z) = centre + extent * tanh(sum of sinusoids), at a varying rate.

    centre, extent: (3,) [m]; the trajectory stays inside centre ± extent. amplitude (relative to extent), frequency
    [Hz], phase [rad]: (k, 3). pause_depth, pause_frequency [Hz], pause_phase [rad]: (p,); the path parameter runs at
    ``1 + Σ depth cos(…)`` of the true time, so that the target nearly hovers where the sum is near −1. The frequencies
    are random reals: no two share a period.
    """

    centre: Floats
    extent: Floats
    amplitude: Floats
    frequency: Floats
    phase: Floats
    pause_depth: Floats
    pause_frequency: Floats
    pause_phase: Floats

    def position(self, true_time: Floats) -> Floats:
        """Positions (n, 3) [m] at true times (n,) [s]."""
        t = np.asarray(true_time, dtype=np.float64)
        angular_frequency = 2.0 * np.pi * self.pause_frequency
        own = t + (
            np.sin(t[:, None] * angular_frequency + self.pause_phase) * self.pause_depth / angular_frequency
        ).sum(axis=1)
        angle = 2.0 * np.pi * self.frequency * own[:, None, None] + self.phase
        return np.asarray(self.centre + self.extent * np.tanh((self.amplitude * np.sin(angle)).sum(axis=1)))


def hand_waved_path(rng: np.random.Generator, centre: Floats, extent: Floats) -> SmoothPath:
    """A person walking in a room and waving a marker: walk below 0.2 Hz, arm up to 1.1 Hz.

    centre, extent: (3,) [m]. Speeds are around 1 to 3 m/s for an extent of about 1.2 m.
    """
    walk, arm = 5, 5
    frequency = np.concatenate([rng.uniform(0.04, 0.2, (walk, 3)), rng.uniform(0.35, 1.1, (arm, 3))])
    # The arm's amplitude falls with frequency, as a limb's power does: accelerations stay human.
    amplitude = np.concatenate([rng.uniform(0.25, 0.5, (walk, 3)), 0.11 / frequency[walk:]])
    phase = rng.uniform(0.0, 2.0 * np.pi, frequency.shape)
    none = np.zeros(1)
    return SmoothPath(centre, extent, amplitude, frequency, phase, none, np.ones(1), none)


def flown_path(rng: np.random.Generator, centre: Floats, extent: Floats) -> SmoothPath:
    """A small drone over a field: long sweeps at up to some 15 m/s, and phases in which it nearly hovers.

    centre, extent: (3,) [m].
    """
    sweep, turn = 4, 4
    frequency = np.concatenate([rng.uniform(0.008, 0.04, (sweep, 3)), rng.uniform(0.05, 0.16, (turn, 3))])
    amplitude = np.concatenate([rng.uniform(0.3, 0.6, (sweep, 3)), 0.012 / frequency[sweep:]])
    phase = rng.uniform(0.0, 2.0 * np.pi, frequency.shape)
    pause_phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    depth = np.array([0.52, 0.46])
    return SmoothPath(centre, extent, amplitude, frequency, phase, depth, rng.uniform(0.02, 0.06, 2), pause_phase)
