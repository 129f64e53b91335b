"""Writes one log as several files, so that a long recording can be moved, cleaned up and lost in parts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from google.protobuf.message import Message

from protocols.core.clocks import NANOSECONDS
from protocols.core.closing import Closing
from protocols.core.errors import InputError
from protocols.log.layout import part_path
from protocols.log.write.writer import LogWriter
from protocols.topics import Topic


class RotatingWriter(Closing):
    """A LogWriter that begins a new file when the present one is large or old enough. For use by one thread.

    path: name.mcap gives name-000.mcap, name-001.mcap, …; session: an id that all parts carry.
    max_bytes, max_s: None = no bound. Age is measured by log times, so that equal input gives equal files.
    Raises InputError as LogWriter does; no existing part is overwritten.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]],
        session: str,
        *,
        max_bytes: int | None = None,
        max_s: float | None = None,
        views: bool = False,
    ) -> None:
        self._base = path
        self._metadata = metadata
        self._session = session
        self._max_bytes = max_bytes
        self._max_ns = None if max_s is None else round(max_s * NANOSECONDS)
        self._views = views
        self._attachments: list[tuple[str, str, bytes, int]] = []
        self._first_ns: int | None = None
        self._closed_bytes = 0
        self._number = 0
        old = part_path(path, 0)
        if path.exists() and not path.is_dir():
            raise InputError("exists already", file=path, remedy="choose another name, or move it away")
        self._writer = self._open()
        self.first = old

    @property
    def size(self) -> int:
        """Bytes in all parts so far."""
        return self._closed_bytes + self._writer.size

    @property
    def parts(self) -> int:
        """How many files there are."""
        return self._number + 1

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._writer.path

    def write(self, topic: Topic, agent: str, site: str, message: Message, log_time_ns: int) -> bool:
        """As LogWriter.write; begins a new part first where one is due."""
        if self._first_ns is None:
            self._first_ns = log_time_ns
        elif self._due(log_time_ns):
            self._closed_bytes += self._finish()
            self._number += 1
            self._writer = self._open()
            for name, media_type, data, time_ns in self._attachments:
                self._writer.attach(name, media_type, data, time_ns)
            self._first_ns = log_time_ns
        return self._writer.write(topic, agent, site, message, log_time_ns)

    def attach(self, name: str, media_type: str, data: bytes, log_time_ns: int = 0) -> None:
        """Store a whole file in this part and all that follow."""
        self._attachments.append((name, media_type, data, log_time_ns))
        self._writer.attach(name, media_type, data, log_time_ns)

    def sync(self) -> None:
        """As LogWriter.sync."""
        self._writer.sync()

    def close(self) -> None:
        self._writer.close()

    def _due(self, log_time_ns: int) -> bool:
        assert self._first_ns is not None
        if self._max_bytes is not None and self._writer.size >= self._max_bytes:
            return True
        return self._max_ns is not None and log_time_ns - self._first_ns >= self._max_ns

    def _finish(self) -> int:
        self._writer.close()
        return self._writer.size

    def _open(self) -> LogWriter:
        return LogWriter(
            part_path(self._base, self._number),
            self._metadata,
            part=(self._session, self._number),
            views=self._views,
        )
