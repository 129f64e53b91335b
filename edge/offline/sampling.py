"""Some frames of a video, spread evenly over it: for a first look at what is in it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from edge.devices.playback.video_reader import VideoReader, has_pyav, upright_image, upright_size
from protocols.geometry.types import Image

_READ_WHOLE = 600  # frames: a shorter video is decoded from its beginning


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
