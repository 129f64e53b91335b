"""The operator's video of a UAV agent: the picture with the estimate on it, served as the configuration says."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from deploy.config.uav import VideoOutConfig

if TYPE_CHECKING:
    from edge.mavlink.roles.camera import Stream
    from edge.uav.tracker import Estimate, Image


class Shown:
    """The newest picture and estimate; drawn and compressed only if somebody watches. tell: called with every one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: tuple[Image, Estimate | None, str] | None = None
        self.tell: Callable[[], None] = lambda: None

    def take(self, image: Image, estimate: Estimate | None, line: str) -> None:
        """A picture has been looked at; line: of text that goes on it."""
        with self._lock:
            # Layers speak of the tracker's present frame only.
            self._newest = (image, None if estimate is None else replace(estimate, layers={}), line)
        self.tell()

    def picture(self) -> Image | None:
        """The newest (h, w, 3) BGR with the estimate on it; None while there is none."""
        from edge.uav.operator_view import draw

        with self._lock:
            newest = self._newest
        return None if newest is None else draw(*newest)

    def jpeg(self, quality: int) -> bytes | None:
        """The same as JPEG."""
        import cv2

        picture = self.picture()
        if picture is None:
            return None
        good, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        return data.tobytes() if good else None


def serve_video(out: VideoOutConfig, size: tuple[int, int], fps: float, shown: Shown, stack: ExitStack) -> Stream:
    """Serve what is shown until the stack is left; what ground stations are told of it.

    size: (width, height) [px]. Raises InputError where it cannot be served.
    """
    from edge.mavlink.roles.camera import Stream

    host, _, text = out.listen.rpartition(":")
    host, port = host.strip("[]"), int(text)
    if out.stream == "rtsp":
        from edge.video import rtsp_server

        server = stack.enter_context(rtsp_server.RtspServer(host, port, shown.picture, size, fps, out.kbps))
        shown.tell = server.changed
        scheme, path, port = "rtsp", rtsp_server.PATH, server.port
    else:
        from edge.video import mjpeg_server

        pages = stack.enter_context(mjpeg_server.VideoServer(host, port, lambda: shown.jpeg(out.quality)))
        shown.tell = pages.changed
        scheme, path, port = "http", mjpeg_server.PATH, pages.port
    shown_host = f"[{host}]" if ":" in host else host
    uri = out.uri or f"{scheme}://{shown_host}:{port}{path}"
    return Stream("rtsp" if uri.startswith("rtsp://") else "mjpeg", uri)
