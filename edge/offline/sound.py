"""The sound track of a video, as its energy over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edge.devices.playback.video_reader import has_pyav
from protocols.geometry.types import Floats

ENERGY_RATE = 500.0
"""Samples of the energy a second: sound travels 0.7 m in one."""
_WINDOW = 16  # samples of one energy
_LONGEST_S = 3600.0  # s of sound: bounds what is decoded and held, 29 million samples


def sound_energy(path: Path) -> tuple[float, Floats] | None:
    """Time of the first sample [s, as of the video's frames] and energies (n,) at ``ENERGY_RATE``, an hour at most.

    None where the file has no sound, or it cannot be decoded.
    """
    if not has_pyav():
        return None
    import av

    start, parts, count = None, [], 0
    try:
        with av.open(str(path)) as container:
            if not container.streams.audio:
                return None
            mono = av.AudioResampler(format="flt", layout="mono", rate=round(_WINDOW * ENERGY_RATE))
            for decoded in container.decode(container.streams.audio[0]):
                start = decoded.time if start is None else start
                for frame in mono.resample(decoded):
                    parts.append(frame.to_ndarray()[0])
                    count += len(parts[-1])
                if count > _LONGEST_S * _WINDOW * ENERGY_RATE:
                    break
    except av.error.FFmpegError:
        pass  # what was decoded before counts
    samples = np.concatenate(parts) if parts else np.zeros(0, dtype=np.float32)
    samples = samples[: len(samples) // _WINDOW * _WINDOW]
    if start is None or not len(samples) or not np.isfinite(samples).all():
        return None
    return float(start), (samples.reshape(-1, _WINDOW).astype(np.float64) ** 2).mean(axis=1)
