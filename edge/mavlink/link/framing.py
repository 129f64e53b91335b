"""MAVLink framing: finds whole messages in a corrupted byte stream.

pymavlink's own parser discards as many bytes as a false start marker claims, and valid messages with them. This one
continues one byte after a marker that did not start a message.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from edge.mavlink.dialect import mavlink

V1, V2 = 0xFE, 0xFD  # first byte of a frame of each version (MAVLink serialization)
SIGNED = 0x01  # incompatibility flag of a signed frame
_SIGNATURE = 13  # bytes: link id, time stamp, signature


class Framer:
    """Parser of one byte stream. unreadable: bytes that belong to no message; unknown: messages of other dialects."""

    def __init__(self) -> None:
        self._codec: Any = mavlink.MAVLink(None)
        self._buffer = bytearray()
        self.unreadable = 0
        self.unknown = 0

    def feed(self, data: bytes, *, whole: bool = False) -> Iterator[tuple[Any, bytes]]:
        """Messages with a valid checksum, each with its bytes.

        whole: no message continues in the next piece, as in datagrams: an incomplete frame at the end is then
        discarded instead of waited for.
        """
        self._buffer += data
        at = 0
        while (found := self._marker(at)) is not None:
            self.unreadable += found - at
            at = found
            length = frame_length(self._buffer[at : at + 3])
            if length is None or at + length > len(self._buffer):
                if not whole:
                    break
                self.unreadable += 1
                at += 1
                continue
            frame = bytes(self._buffer[at : at + length])
            message = self._decode(frame)
            if message is None:
                self.unreadable += 1
                at += 1
            elif message.get_msgId() < 0 or isinstance(message, mavlink.MAVLink_unknown):
                # Its checksum cannot be verified. Accept its length only if another frame starts where it ends.
                end = at + length
                if end < len(self._buffer) and self._buffer[end] not in (V1, V2):
                    self.unreadable += 1
                    at += 1
                else:
                    self.unknown += 1
                    at = end
            else:
                at += length
                yield message, frame
        else:
            self.unreadable += len(self._buffer) - at
            at = len(self._buffer)
        del self._buffer[:at]

    def _marker(self, at: int) -> int | None:
        first = [place for mark in (V1, V2) if (place := self._buffer.find(mark, at)) >= 0]
        return min(first, default=None)

    def _decode(self, frame: bytes) -> Any:
        if frame[0] == V2 and frame[2] & ~SIGNED:
            return None
        try:
            return self._codec.decode(bytearray(frame))
        except mavlink.MAVError:
            return None


def frame_length(head: bytes | bytearray) -> int | None:
    """Length of the message whose first three bytes these are; None while they are fewer."""
    if len(head) < 3:
        return None
    return 8 + head[1] if head[0] == V1 else 12 + head[1] + (_SIGNATURE if head[2] & SIGNED else 0)
