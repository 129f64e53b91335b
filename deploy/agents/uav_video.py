"""The operator's video stream of a UAV agent: frames with the estimate drawn on them, over RTSP or MJPEG."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from deploy.config.uav import VideoOutConfig
from protocols.core.jpeg import encode_jpeg

if TYPE_CHECKING:
    from edge.mavlink.roles.camera_messages import VideoStream
    from edge.uav.base import Estimate
    from protocols.geometry.types import Image


class OperatorVideo:
    """The latest frame and estimate, rendered and encoded only on request. notify: called for every new frame."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._latest: tuple[Image, Estimate | None, str] | None = None
        self.notify: Callable[[], None] = lambda: None

    def update(self, image: Image, estimate: Estimate | None, line: str) -> None:
        """Set the latest processed frame; line: text to draw on it."""
        with self._lock:
            # Layers refer to the tracker's current frame only.
            self._latest = (image, None if estimate is None else replace(estimate, layers={}), line)
        self.notify()

    def render(self) -> Image | None:
        """The latest frame (h, w, 3) BGR with the estimate drawn on it; None before the first one."""
        from edge.uav.operator_view import draw

        with self._lock:
            newest = self._latest
        return None if newest is None else draw(*newest)

    def jpeg(self, quality: int) -> bytes | None:
        """The rendered frame as JPEG."""
        image = self.render()
        return None if image is None else encode_jpeg(image, quality) or None


def serve_video(
    out: VideoOutConfig, size: tuple[int, int], fps: float, operator_video: OperatorVideo, stack: ExitStack
) -> VideoStream:
    """Serve the video until the stack is closed; returns the stream's address for ground stations.

    size: (width, height) [px]. Raises InputError if it cannot be served.
    """
    from edge.mavlink.roles.camera_messages import VideoStream

    host, _, text = out.listen.rpartition(":")
    host, port = host.strip("[]"), int(text)
    if out.stream == "rtsp":
        from edge.video import rtsp_server

        server = stack.enter_context(rtsp_server.RtspServer(host, port, operator_video.render, size, fps, out.kbps))
        operator_video.notify = server.notify_frame
        scheme, path, port = "rtsp", rtsp_server.PATH, server.port
    else:
        from edge.video import mjpeg_server

        pages = stack.enter_context(mjpeg_server.MjpegServer(host, port, lambda: operator_video.jpeg(out.quality)))
        operator_video.notify = pages.notify_frame
        scheme, path, port = "http", mjpeg_server.PATH, pages.port
    shown_host = f"[{host}]" if ":" in host else host
    uri = out.uri or f"{scheme}://{shown_host}:{port}{path}"
    return VideoStream("rtsp" if uri.startswith("rtsp://") else "mjpeg", uri)
