"""Simulated sound tracks: bursts with an echo, heard by microphones that are not alike."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from protocols.geometry.types import Floats

RATE = 8000  # Hz
_BURST = 2000  # samples


def sound_events(seconds: float, seed: int) -> Floats:
    """Times [s] and loudness (n, 2) of sounds, some two a second."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.exponential(0.45, size=int(4.0 * seconds)))
    events = np.column_stack([times, rng.lognormal(-1.0, 0.7, size=len(times))])
    return np.asarray(events[times < seconds])


def heard(events: Floats, lag: float, rng: np.random.Generator, seconds: float, noise: float) -> Floats:
    """What a microphone records (n,) whose clock is ``lag`` behind. noise: std of the background."""
    samples = noise * rng.normal(size=int(seconds * RATE))
    decay = np.arange(_BURST) / RATE
    for time, loudness in events:
        first = round((time - lag) * RATE)
        if 0 <= first < len(samples) - _BURST:
            burst = rng.normal(size=_BURST) * np.exp(-decay / rng.uniform(0.02, 0.08))
            samples[first : first + _BURST] += loudness * burst
    return samples


def add_sound(video: Path, samples: Floats, out: Path) -> None:
    """Copy a video and add a sound track (n,) at ``RATE`` that begins with it."""
    with av.open(str(video)) as source, av.open(str(out), "w") as container:
        picture = source.streams.video[0]
        copied = container.add_stream_from_template(picture)
        sound = container.add_stream("aac", rate=RATE, layout="mono")
        for packet in source.demux(picture):
            if packet.dts is not None:
                packet.stream = copied
                container.mux(packet)
        pcm = np.clip(samples / np.abs(samples).max() * 30_000, -32_000, 32_000).astype(np.int16)
        for first in range(0, len(pcm), 1024):
            frame = av.AudioFrame.from_ndarray(pcm[None, first : first + 1024], format="s16", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = RATE, first, Fraction(1, RATE)
            container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
