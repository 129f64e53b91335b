"""A small RTSP camera on loopback: motion JPEG in RTP over the RTSP connection, packetised by FFmpeg."""

from __future__ import annotations

import socket
import struct
import threading
import time
from contextlib import suppress
from fractions import Fraction

import av
import numpy as np

_SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\n"
    "m=video 0 RTP/AVP 26\r\na=framerate:25\r\na=control:track0\r\n"
)


class RtspCamera:
    """Serves any number of readers. late_s: delays of the frames [s], repeated cyclically.

    skip: numbers of frames that are never sent.
    """

    def __init__(self, port: int = 0, late_s: tuple[float, ...] = (0.0,), skip: tuple[int, ...] = ()) -> None:
        self._late, self._skip = late_s, skip
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self.url = f"rtsp://127.0.0.1:{self.port}/live"
        self._stop = threading.Event()
        self._readers: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Close the listener and all connections, as if unplugged."""
        self._stop.set()
        for end in (self._listener, *self._readers):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                reader, _ = self._listener.accept()
                self._readers.append(reader)
                threading.Thread(target=self._serve, args=(reader,), daemon=True).start()

    def _serve(self, reader: socket.socket) -> None:
        text = b""
        with suppress(OSError, ValueError):
            while not self._stop.is_set():
                part = reader.recv(4096)
                if not part:
                    return
                text += part
                while b"\r\n\r\n" in text:
                    request, text = text.split(b"\r\n\r\n", 1)
                    lines = request.decode().split("\r\n")
                    method = lines[0].split()[0]
                    number = next(line.split(":")[1].strip() for line in lines if line.lower().startswith("cseq"))
                    head, body = f"RTSP/1.0 200 OK\r\nCSeq: {number}\r\nSession: 1\r\n", ""
                    if method == "OPTIONS":
                        head += "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
                    elif method == "DESCRIBE":
                        head += f"Content-Type: application/sdp\r\nContent-Length: {len(_SDP)}\r\n"
                        body = _SDP
                    elif method == "SETUP":
                        head += "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n"
                    reader.sendall(f"{head}\r\n{body}".encode())
                    if method == "PLAY":
                        threading.Thread(target=self._film, args=(reader,), daemon=True).start()

    def _film(self, reader: socket.socket) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as packets:
            packets.bind(("127.0.0.1", 0))
            packets.settimeout(0.02)
            target = f"rtp://127.0.0.1:{packets.getsockname()[1]}?pkt_size=1400"
            with suppress(OSError), av.open(target, "w", format="rtp") as muxer:
                stream = muxer.add_stream("mjpeg", rate=25)
                stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
                stream.options = {"huffman": "default"}
                stream.codec_context.time_base = Fraction(1, 25)
                rng = np.random.default_rng(0)
                began = time.monotonic()
                for number in range(10_000):
                    late = self._late[number % len(self._late)]
                    if self._stop.wait(max(began + 0.04 * number + late - time.monotonic(), 0.0)):
                        return
                    if number in self._skip:
                        continue
                    frame = av.VideoFrame.from_ndarray(
                        rng.integers(0, 256, (48, 64, 3), dtype=np.uint8), format="bgr24"
                    )
                    frame.pts, frame.time_base = number, Fraction(1, 25)
                    for packet in stream.encode(frame):
                        muxer.mux(packet)
                    with suppress(TimeoutError):
                        while True:
                            data = packets.recv(2048)
                            if not 200 <= data[1] <= 204:  # not RTCP
                                reader.sendall(struct.pack(">BBH", 0x24, 0, len(data)) + data)
                            if data[1] & 0x80 and not 200 <= data[1] <= 204:
                                break  # the marker bit: the frame is complete
