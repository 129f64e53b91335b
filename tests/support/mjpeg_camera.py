"""An IP camera on loopback: noisy images as motion JPEG over HTTP, until it is unplugged."""

from __future__ import annotations

import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np


class MjpegCamera:
    """Serves on a port, 0 = any; the address is ``url``. period_s: from image to image."""

    def __init__(self, port: int = 0, period_s: float = 0.04) -> None:
        unplugged = self._unplugged = threading.Event()

        class Stream(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                rng = np.random.default_rng(0)
                with suppress(OSError):
                    while not unplugged.wait(period_s):
                        picture = cv2.imencode(".jpg", rng.integers(40, 200, (48, 64, 3), dtype=np.uint8))[1].tobytes()
                        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
                        self.wfile.write(head.encode() + picture + b"\r\n")

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Stream)
        self._server.daemon_threads = True
        self.port = self._server.server_port
        self.url = f"http://127.0.0.1:{self.port}/video"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def unplug(self) -> None:
        """End every stream and refuse new ones."""
        self._unplugged.set()
        self._server.shutdown()
        self._server.server_close()
