"""MAVLink 2 message signing: rejects messages without the key, replayed, late or from the future.

Timestamps are counts of 10 µs since 2015. The last ones are kept in a file, so that after a restart no old message is
accepted and none is sent that the receivers would reject.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import time
from collections.abc import Callable
from pathlib import Path

from protocols.core.errors import InputError
from protocols.core.files import write_atomically

EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01, from which signing times count (MAVLink signing)
TICKS = 100_000
"""Timestamp counts of 10 µs per second."""
_MAX_AHEAD = 5 * TICKS
_MAX_BEHIND = 60 * TICKS  # allowed delay of a new sender, as in pymavlink and the autopilots
_SAVE_EVERY = 5 * TICKS
_MAX_STREAMS = 64  # senders whose last time is remembered


class Signing:
    """Signs and verifies the messages of a link. key: 32 bytes. state: file of the last timestamps, None: not kept.

    The timestamps are kept in memory first: a disk that is full or gone is reported in ``problem`` and tried again.
    monotonic_s: advances the time of the last run while the machine's clock is not set. behind_s: how far the last
    message that was rejected for its time was behind.
    """

    def __init__(
        self,
        key: bytes,
        state: Path | None = None,
        *,
        link: int = 0,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        if len(key) != 32:
            raise ValueError("a key has 32 bytes")
        self.key, self.link = key, link
        self._state, self._monotonic_s = state, monotonic_s
        self._sent = self._clock = 0
        self._last_times: dict[str, int] = {}
        self._saved = self._tried = 0
        self._restarted = False
        self.problem = ""
        self.behind_s = 0.0
        if state is not None:
            self._read(state)
        self._restored, self._began_s = self._clock, monotonic_s()

    def next_time(self, unix_s: float) -> int:
        """Timestamp for the next outgoing message: strictly increasing, whatever the clock does."""
        now = self._now(unix_s)
        if self._restarted and now <= self._sent:
            # The clock was set back or is not set yet: timestamps used after the last save must not be reused.
            self._sent += _SAVE_EVERY
        self._restarted = False
        self._sent = max(self._sent + 1, now)
        return self._sent

    def rejection_reason(self, frame: bytes, system: int, component: int, unix_s: float) -> str | None:
        """Why a frame is rejected: "unsigned", "wrong_key", "future", "late" or "replayed"; None where it is valid.

        late: signed with the key, but the first of its sender and more than a minute old.
        """
        if frame[0] != 0xFD or not frame[2] & 1:
            return "unsigned"
        digest = hashlib.sha256(self.key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, frame[-6:]):
            return "wrong_key"
        stamp = int.from_bytes(frame[-12:-6], "little")
        # This machine's time alone: measured by what others send, it could be pushed ahead message by message.
        now = self._now(unix_s)
        last = self._last_times.get(stream := f"{frame[-13]}.{system}.{component}")
        reason = None
        if stamp > now + _MAX_AHEAD:
            reason = "future"
        elif last is None and stamp <= now - _MAX_BEHIND:
            reason = "late"
        elif last is not None and stamp <= last:
            reason = "replayed"
        if reason is not None:
            self.behind_s = (now - stamp) / TICKS
            return reason
        if last is None and len(self._last_times) >= _MAX_STREAMS:
            # All that an old one has sent is late by now, and may be forgotten.
            oldest = min(self._last_times, key=lambda one: self._last_times[one])
            if self._last_times[oldest] > now - _MAX_BEHIND:
                return "replayed"  # its timestamp cannot be stored, so a replay could not be detected
            del self._last_times[oldest]
        self._last_times[stream] = stamp
        self._sent = max(self._sent, stamp)
        return None

    def unsaved(self) -> str | None:
        """The timestamps to write if that is due. To be passed to ``write``, for which no lock needs to be held."""
        if self._state is None or self._sent - max(self._saved, self._tried) < _SAVE_EVERY:
            return None
        self._tried = self._sent
        return self._table()

    def write(self, table: str) -> None:
        """Write the timestamps to the file. A failure is reported in ``problem``; it is tried again 5 s later."""
        if self._state is None:
            return
        try:
            write_atomically(self._state, table)
        except (InputError, OSError) as error:
            self.problem = f"signing times are not on disk: {getattr(error, 'what', error)}"
            return
        self._saved, self.problem = self._tried, ""

    def save(self) -> None:
        """Write the last timestamps to the file now."""
        self._tried = self._sent
        self.write(self._table())

    def _table(self) -> str:
        return json.dumps({"sent": self._sent, "clock": self._clock, "heard": self._last_times})

    def _now(self, unix_s: float) -> int:
        """The machine's time, or that of the last run plus what has passed since, if it is later."""
        elapsed = round((self._monotonic_s() - self._began_s) * TICKS) if self._restored else 0
        self._clock = max(ticks(unix_s), self._restored + elapsed)
        return self._clock

    def _read(self, file: Path) -> None:
        try:
            table = json.loads(file.read_text(encoding="utf-8"))
            sent, received = int(table["sent"]), {str(name): int(stamp) for name, stamp in table["heard"].items()}
            clock = int(table.get("clock", sent))
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise InputError(
                "cannot be read as signing timestamps",
                file=file,
                remedy="delete it, if replayed messages are no risk here",
            ) from None
        self._sent, self._last_times, self._saved, self._clock = sent, received, sent, clock
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
