"""What a first look at a video needs: some frames, spread evenly over it, and its sound track as energy over time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edge.devices.playback.video_reader import VideoReader, has_pyav, upright_image, upright_size
from protocols.geometry.types import Floats, Image

_READ_WHOLE = 600  # frames: a shorter video is decoded from its beginning
ENERGY_RATE = 500.0
"""Samples of the energy a second: sound travels 0.7 m in one."""
_WINDOW = 16  # samples of one energy
_LONGEST_S = 3600.0  # s of sound: bounds what is decoded and held, 29 million samples


def sample_images(video: VideoReader, count: int) -> Iterator[Image]:
    """About ``count`` images of a video (H, W, 3) BGR, in order; fewer where it has fewer frames."""
    total = max(video.info.frames, 1)
    if total > _READ_WHOLE and has_pyav() and video.path.is_file():
        yield from _seek(video, count)
        return
    wanted = set(np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int)).tolist())
    for frame in video:
        if frame.frame in wanted:
            yield frame.image()
        if frame.frame >= total - 1:
            return


def _seek(video: VideoReader, count: int) -> Iterator[Image]:
    """The frames at the key frames nearest before evenly spread times."""
    import av

    with av.open(str(video.path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        length = video.info.frames / video.info.fps
        last = None
        for at in np.linspace(0.0, length, count, endpoint=False):
            try:
                container.seek(round(at / float(stream.time_base or 1)), stream=stream)
                frame = next(container.decode(stream), None)
            except (av.error.FFmpegError, StopIteration):
                continue
            if frame is not None and frame.pts != last and upright_size(frame) == video.info.size:
                last = frame.pts
                yield upright_image(frame)


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
