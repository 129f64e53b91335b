"""H.264 encoding into RTP packets (RFC 6184) through libav; PyAV's wheels include x264 for x86-64 and arm64."""

from __future__ import annotations

import io
from fractions import Fraction
from typing import Any

import numpy as np

from protocols.core.errors import InputError
from protocols.geometry.types import Image

CLOCK_HZ = 90_000  # RTP's for video (RFC 6184)
_PACKET_BYTES = 1400  # with IP's and UDP's headers within 1500
_KEY_FRAME_S = 1.0  # a viewer that joins waits so long at most


class RtpEncoder:
    """Encoder of one stream. size: (width, height) [px] of the images; fps: nominal rate; kbps: maximum bit rate.

    parameter_sets: H.264's SPS and PPS for the session description. Raises InputError without PyAV.
    """

    def __init__(self, size: tuple[int, int], fps: float, kbps: int) -> None:
        try:
            import av
        except ImportError:
            raise InputError(
                "an RTSP stream needs PyAV, which is not installed",
                remedy='pip install "syncline[video]", or set stream = "mjpeg" in [video_out]',
            ) from None
        self._av = av
        # Chroma is subsampled by two: an odd last row or column is cropped.
        self._width, self._height = size[0] & ~1, size[1] & ~1
        self._sink = _PacketSink()
        self._settings = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "profile": "baseline",
            "maxrate": f"{kbps}k",
            "bufsize": f"{kbps // 2}k",
        }
        self._rate = Fraction(max(fps, 1.0)).limit_denominator(1001)
        self._bits = 1000 * kbps
        self.parameter_sets = self._header()
        self._container: Any = av.open(
            self._sink,
            "w",
            format="rtp",
            container_options={"packetsize": str(_PACKET_BYTES)},
            buffer_size=_PACKET_BYTES,
        )
        self._stream: Any = self._container.add_stream("libx264", rate=self._rate, options=self._settings)
        self._set_up(self._stream.codec_context)
        self._last_pts = -1

    def encode(self, image: Image, time_s: float, *, key_frame: bool = False) -> list[bytes]:
        """RTP and RTCP packets of an image (h, w, 3) BGR at a time [s] of any epoch. key_frame: force one."""
        frame = self._av.VideoFrame.from_ndarray(
            np.ascontiguousarray(image[: self._height, : self._width]), format="bgr24"
        )
        self._last_pts = max(round(CLOCK_HZ * time_s), self._last_pts + 1)
        frame.pts, frame.time_base = self._last_pts, Fraction(1, CLOCK_HZ)
        if key_frame:
            frame.pict_type = self._av.video.frame.PictureType.I
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
        return self._sink.take()

    def _set_up(self, codec: Any) -> None:
        codec.width, codec.height, codec.pix_fmt = self._width, self._height, "yuv420p"
        codec.time_base, codec.framerate = Fraction(1, CLOCK_HZ), self._rate
        codec.bit_rate, codec.thread_count = self._bits, 1
        codec.gop_size = max(1, round(_KEY_FRAME_S * float(self._rate)))

    def _header(self) -> tuple[bytes, bytes]:
        codec = self._av.CodecContext.create("libx264", "w")
        self._set_up(codec)
        codec.options = self._settings
        codec.flags |= self._av.codec.context.Flags.global_header
        codec.open()
        units = [unit.strip(b"\0") for unit in bytes(codec.extradata or b"").split(b"\0\0\1")]
        kinds = {unit[0] & 31: unit for unit in units if unit}
        return kinds.get(7, b""), kinds.get(8, b"")


def is_rtcp(packet: bytes) -> bool:
    """Whether a packet is RTCP rather than RTP (RFC 5761, section 4)."""
    return 64 <= packet[1] & 127 < 96


class _PacketSink(io.RawIOBase):
    """Output file of libav: one packet per write, as its buffer is one packet long."""

    def __init__(self) -> None:
        self._held: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._held.append(bytes(data))
        return len(self._held[-1])

    def take(self) -> list[bytes]:
        """The packets written since the last call."""
        out, self._held = self._held, []
        return out
