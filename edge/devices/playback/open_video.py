"""Which device reads a source that OpenCV can open: a recording, or a live camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from edge.devices.live.opencv_capture import LiveCamera
from edge.devices.playback.playback_clock import Pace
from edge.devices.playback.video_file import Recording
from protocols.geometry.camera import Intrinsics


def open_video(
    source: str | int | Path,
    *,
    fps: float | None = None,
    loop: bool = False,
    pace: Pace | None = None,
    intrinsics: Intrinsics | None = None,
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> Recording | LiveCamera:
    """The device for a source; it still has to be opened.

    source: a file; a folder of pictures, sorted by name; an index or /dev/… of a USB camera (a stable name as udev
    gives it, too); or a URL.
    fps: of a recording, instead of its time stamps; of a live camera, asked for. loop: start a recording again at its
    end, its time running on. pace: a clock by which a recording is played in real time; None = as fast as it is read.
    intrinsics: of this camera. now_ns: the host's monotonic clock, which stamps live frames.
    """
    text = str(source)
    if isinstance(source, int) or text.isdecimal() or text.startswith("/dev/"):
        return LiveCamera(int(text) if text.isdecimal() else text, fps=fps, intrinsics=intrinsics, now_ns=now_ns)
    if "://" in text:
        return LiveCamera(text, fps=fps, intrinsics=intrinsics, now_ns=now_ns)
    return Recording(Path(source), fps=fps, loop=loop, pace=pace, intrinsics=intrinsics)
