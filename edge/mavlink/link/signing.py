"""MAVLink 2 signing: who has not the key is not heard, nor is a message twice, late or from the future.

Times are counts of 10 µs since 2015. The last ones are kept in a file, so that a restart accepts no old message
and sends none that the others would refuse.
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
"""A second, in counts of 10 µs."""
_AHEAD = 5 * TICKS
_BEHIND = 60 * TICKS  # a sender not heard before may be that late, as pymavlink and the autopilots have it
_SAVE_EVERY = 5 * TICKS
_STREAMS = 64


class Signing:
    """One link's signing. key: 32 bytes. state: file of the last times, None: not kept."""

    def __init__(self, key: bytes, state: Path | None = None, *, link: int = 0) -> None:
        if len(key) != 32:
            raise ValueError("a key has 32 bytes")
        self.key, self.link = key, link
        self._state = state
        self._sent = 0
        self._heard: dict[str, int] = {}
        self._saved = 0
        self._restarted = False
        if state is not None:
            self._read(state)

    def next_time(self, unix_s: float) -> int:
        """The time for the next message that is sent: never one again, whatever the clock does."""
        now = ticks(unix_s)
        if self._restarted and now <= self._sent:
            # A clock that was set back, or is not set yet: what was sent after the last save must not be sent again.
            self._sent += _SAVE_EVERY
        self._restarted = False
        self._sent = max(self._sent + 1, now)
        self._save_now_and_then()
        return self._sent

    def refused(self, frame: bytes, system: int, component: int, unix_s: float) -> str | None:
        """Why a whole frame is not to be believed: unsigned, future, replayed, wrong_key; None where it is."""
        if frame[0] != 0xFD or not frame[2] & 1:
            return "unsigned"
        digest = hashlib.sha256(self.key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, frame[-6:]):
            return "wrong_key"
        time = int.from_bytes(frame[-12:-6], "little")
        now = max(ticks(unix_s), self._sent)
        if time > now + _AHEAD:
            return "future"
        stream = f"{frame[-13]}.{system}.{component}"
        last = self._heard.get(stream)
        if time <= (now - _BEHIND if last is None else last):
            return "replayed"
        if last is None and len(self._heard) >= _STREAMS:
            return "replayed"  # without a place to remember it, it could come again
        self._heard[stream] = time
        self._sent = max(self._sent, time)
        self._save_now_and_then()
        return None

    def save(self) -> None:
        """Bring the last times to the disk. Raises InputError where that fails."""
        if self._state is not None:
            self._saved = self._sent
            write_atomically(self._state, json.dumps({"sent": self._sent, "heard": self._heard}))

    def _save_now_and_then(self) -> None:
        if self._sent - self._saved >= _SAVE_EVERY:
            self.save()

    def _read(self, file: Path) -> None:
        try:
            table = json.loads(file.read_text(encoding="utf-8"))
            sent, heard = int(table["sent"]), {str(name): int(time) for name, time in table["heard"].items()}
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise InputError(
                "cannot be read as the last times of signing", file=file, remedy="delete it, if you trust who is near"
            ) from None
        self._sent, self._heard, self._saved = sent, heard, sent
        self._restarted = True


def ticks(unix_s: float) -> int:
    """Counts of 10 µs since 2015; 0 for a clock that was never set."""
    return max(0, round((unix_s - EPOCH_UNIX_S) * TICKS))


def read_key(file: Path) -> bytes:
    """A key of 32 bytes, raw or as 64 hexadecimal digits. Raises InputError."""
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
