"""Selection of the device for a source that OpenCV can open: a recording or a live camera."""

from __future__ import annotations

from pathlib import Path

from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.playback.playback_clock import PlaybackClock
from edge.devices.playback.video_file import VideoPlayback
from protocols.geometry.camera import Intrinsics


def open_video(
    source: str | int | Path,
    *,
    fps: float | None = None,
    loop: bool = False,
    playback_clock: PlaybackClock | None = None,
    intrinsics: Intrinsics | None = None,
) -> VideoPlayback | OpenCvCamera:
    """The device for a source, not yet open.

    source: a file; a folder of images, sorted by name; an index or /dev/… of a USB camera (also a stable name made by
    udev); or a URL.
    fps: of a recording, replaces its time stamps; of a live camera, the requested rate. loop: repeat a recording, with
    continuing time stamps. playback_clock: the clock for playback in real time; None = as fast as possible.
    intrinsics: of this camera.
    """
    text = str(source)
    if isinstance(source, int) or text.isdecimal() or text.startswith("/dev/") or "://" in text:
        return OpenCvCamera(int(text) if text.isdecimal() else text, fps=fps, intrinsics=intrinsics)
    return VideoPlayback(Path(source), fps=fps, loop=loop, playback_clock=playback_clock, intrinsics=intrinsics)
