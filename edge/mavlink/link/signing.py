"""MAVLink 2 message signing: rejects messages without the key, replayed, late or from the future.

Timestamps are counts of 10 µs since 2015. The last ones are kept in a file, so that after a restart no old message is
accepted and none is sent that the receivers would reject.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from pathlib import Path

from protocols.core.errors import InputError
from protocols.core.files import write_atomically

EPOCH_UNIX_S = 1_420_070_400
TICKS = 100_000
"""Timestamp counts of 10 µs per second."""
_MAX_AHEAD = 5 * TICKS
_MAX_BEHIND = 60 * TICKS  # allowed delay of a new sender, as in pymavlink and the autopilots
_SAVE_EVERY = 5 * TICKS
_MAX_STREAMS = 64


class Signing:
    """Signs and verifies the messages of a link. key: 32 bytes. state: file of the last timestamps, None: not kept."""

    def __init__(self, key: bytes, state: Path | None = None, *, link: int = 0) -> None:
        if len(key) != 32:
            raise ValueError("a key has 32 bytes")
        self.key, self.link = key, link
        self._state = state
        self._sent = 0
        self._last_times: dict[str, int] = {}
        self._saved = 0
        self._restarted = False
        if state is not None:
            self._read(state)

    def next_time(self, unix_s: float) -> int:
        """Timestamp for the next outgoing message: strictly increasing, whatever the clock does."""
        now = ticks(unix_s)
        if self._restarted and now <= self._sent:
            # The clock was set back or is not set yet: timestamps used after the last save must not be reused.
            self._sent += _SAVE_EVERY
        self._restarted = False
        self._sent = max(self._sent + 1, now)
        self._save_now_and_then()
        return self._sent

    def rejection_reason(self, frame: bytes, system: int, component: int, unix_s: float) -> str | None:
        """Why a frame is rejected: "unsigned", "future", "replayed" or "wrong_key"; None where it is valid."""
        if frame[0] != 0xFD or not frame[2] & 1:
            return "unsigned"
        digest = hashlib.sha256(self.key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, frame[-6:]):
            return "wrong_key"
        time = int.from_bytes(frame[-12:-6], "little")
        now = max(ticks(unix_s), self._sent)
        if time > now + _MAX_AHEAD:
            return "future"
        stream = f"{frame[-13]}.{system}.{component}"
        last = self._last_times.get(stream)
        if time <= (now - _MAX_BEHIND if last is None else last):
            return "replayed"
        if last is None and len(self._last_times) >= _MAX_STREAMS:
            return "replayed"  # its timestamp cannot be stored, so a replay could not be detected
        self._last_times[stream] = time
        self._sent = max(self._sent, time)
        self._save_now_and_then()
        return None

    def save(self) -> None:
        """Write the last timestamps to the file. Raises InputError where that fails."""
        if self._state is not None:
            self._saved = self._sent
            write_atomically(self._state, json.dumps({"sent": self._sent, "heard": self._last_times}))

    def _save_now_and_then(self) -> None:
        if self._sent - self._saved >= _SAVE_EVERY:
            self.save()

    def _read(self, file: Path) -> None:
        try:
            table = json.loads(file.read_text(encoding="utf-8"))
            sent, received = int(table["sent"]), {str(name): int(time) for name, time in table["heard"].items()}
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise InputError(
                "cannot be read as signing timestamps",
                file=file,
                remedy="delete it, if replayed messages are no risk here",
            ) from None
        self._sent, self._last_times, self._saved = sent, received, sent
        self._restarted = True


def ticks(unix_s: float) -> int:
    """Unix time [s] as a timestamp (10 µs since 2015); 0 for a clock that was never set."""
    return max(0, round((unix_s - EPOCH_UNIX_S) * TICKS))


def read_key(file: Path) -> bytes:
    """Read a key of 32 bytes, raw or as 64 hexadecimal digits. Raises InputError."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=file, remedy="check the path of the key") from None
    if len(data) == 32:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != 32:
        remedy = "make one: printf %s PASSPHRASE | sha256sum | cut -c1-64 > FILE"
        raise InputError("is no signing key of 32 bytes or 64 hexadecimal digits", file=file, remedy=remedy)
    return key
