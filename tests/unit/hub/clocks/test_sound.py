"""Lags of sounds: the right one or none, whatever the microphones."""

from __future__ import annotations

import numpy as np
import pytest

from hub.clocks.sound import sound_lag
from protocols.geometry.types import Floats
from tests.support.sounds import RATE, heard, sound_events

WINDOW = 16


def energies(events: Floats, lag: float, seed: int, seconds: float = 30.0, noise: float = 0.3) -> Floats:
    samples = heard(events, lag, np.random.default_rng(seed), seconds, noise)
    return np.asarray((samples.reshape(-1, WINDOW) ** 2).mean(axis=1))


@pytest.mark.parametrize("seed", range(6))
def test_the_lag_of_the_same_sounds_is_found_to_milliseconds(seed: int) -> None:
    lag = np.random.default_rng(seed).uniform(-12.0, 12.0)
    events = sound_events(60.0, seed) - [15.0, 0.0]
    found = sound_lag(energies(events, 0.0, seed + 50), energies(events, lag, seed + 90), RATE / WINDOW)
    assert found == pytest.approx(lag, abs=0.004)


@pytest.mark.parametrize("seed", range(6))
def test_other_sounds_have_no_lag(seed: int) -> None:
    one, other = (energies(sound_events(30.0, seed + k), 0.0, seed + k) for k in (100, 200))
    assert sound_lag(one, other, RATE / WINDOW) is None


def test_a_beat_has_no_lag_because_several_fit() -> None:
    beat = np.column_stack([np.arange(0.0, 30.0, 0.5), np.ones(60)])
    assert sound_lag(energies(beat, 0.0, 1), energies(beat, 1.1, 2), RATE / WINDOW) is None


@pytest.mark.parametrize("energy", [np.zeros(20_000), np.ones(20_000), np.zeros(3)])
def test_silence_has_no_lag(energy: Floats) -> None:
    assert sound_lag(energy, energies(sound_events(30.0, 1), 0.0, 1), RATE / WINDOW) is None
    assert sound_lag(energy, energy, RATE / WINDOW) is None
