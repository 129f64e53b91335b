"""Writes images as a video, complete or absent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from protocols.core.errors import InputError
from protocols.core.files import completed_file
from protocols.geometry.types import Image

_MIN_WRITTEN = 0.9
"""Share of the frames that a whole file has; containers without a count round it."""


@contextmanager
def video_writer(file: Path, fps: float, remedy: str) -> Iterator[Callable[[Image], object]]:
    """A function that adds an image, of the size of the first, to the video ``file``. It raises InputError."""
    with completed_file(file) as part:
        film = cv2.VideoWriter()

        def write(image: Image) -> None:
            size = (image.shape[1], image.shape[0])
            if not film.isOpened():
                file.parent.mkdir(parents=True, exist_ok=True)
                # MPEG-4 part 2 is in every build of OpenCV with FFmpeg.
                if not film.open(str(part), cv2.VideoWriter.fourcc(*"mp4v"), fps, size):
                    raise InputError("this video cannot be written", file=file, remedy=remedy)
            film.write(image)
            counted[0] += 1

        counted = [0]
        try:
            yield write
        finally:
            film.release()
        # OpenCV says nothing of a write that fails; a film without its index has no frames.
        if cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT) < _MIN_WRITTEN * counted[0]:
            raise InputError("this video could not be written whole", file=file, remedy="free some space on the disk")
