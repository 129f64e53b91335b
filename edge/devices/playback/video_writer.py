"""Writes images as a video, complete or absent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from protocols.core.errors import InputError
from protocols.core.files import completed_file
from protocols.geometry.types import Image


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

        try:
            yield write
        finally:
            film.release()
