"""The recorder's disk: whether there is space, and which recordings are kept.

The oldest closed files are deleted, by age, size and free space. The order of recordings is that of their names, which
`unused_log_path` makes increase also where a clock was set back or never set: file times would be wrong there.
"""

from __future__ import annotations

import fcntl
import re
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from deploy.config.agents import RecorderConfig
from protocols.core.clocks import UNSET_CLOCK_UNIX_S

_DAY_S = 86_400.0  # s
RESUME_MARGIN = 1.1
"""Factor of the least free space from which a recorder that waits goes on, so that it does not begin to end at once."""
_NAME = re.compile(r"(?P<time>syncline-\d{8}T\d{6}Z)(-after(?P<number>\d{4}))?(-(?P<part>\d{3,6}))?\Z")


def unused_log_path(folder: Path, now: datetime) -> Path:
    """A name for the next recording in a folder that sorts after all that are there: the time, if the clock is right.

    Where a clock was set back or never set, it is the newest name with the number of recordings since.
    """
    stem = now.astimezone(UTC).strftime("syncline-%Y%m%dT%H%M%SZ")
    there = sorted(order for path in folder.glob("syncline-*.mcap") if (order := _order(path)))
    if there and stem <= there[-1][0]:
        stem = f"{there[-1][0]}-after{there[-1][1] + 1:04d}"
    return folder / f"{stem}.mcap"


def _order(path: Path) -> tuple[str, int, int] | None:
    """The key by which a recording's files sort in the order in which they were recorded; None for another file."""
    found = _NAME.match(path.stem)
    return None if found is None else (found["time"], int(found["number"] or 0), int(found["part"] or 0))


def free_bytes(folder: Path) -> int:
    """Free bytes on the disk of ``folder``, which need not exist yet."""
    return int(_usage(folder).free)


def _usage(folder: Path) -> Any:
    """shutil's total and free bytes on the disk of a folder, which need not exist yet."""
    return shutil.disk_usage(next(parent for parent in (folder, *folder.absolute().parents) if parent.is_dir()))


class Space:
    """The disk that a recorder writes to. free: free bytes on the disk of a folder. free_mb: at the last look."""

    def __init__(self, config: RecorderConfig, free: Callable[[Path], int] = free_bytes) -> None:
        self._config = config
        self._folder = config.out if config.out.suffix != ".mcap" else config.out.parent
        self._free = free
        self.free_mb = 0.0

    def lack(self, margin: float = 1.0) -> str:
        """Why there is too little space to record; "" where there is enough. margin: factor of what is needed."""
        left = self.free_mb = self._free(self._folder) / 1e6
        if left < margin * self._config.min_free_mb:
            return f"{left:.0f} MB are free on the disk, min_free_mb is {self._config.min_free_mb:g}"
        share = 100.0 if self._free is not free_bytes else 100.0 * left * 1e6 / _usage(self._folder).total
        if share < margin * self._config.min_free_percent:
            return f"{share:.1f} % of the disk are free, min_free_percent is {self._config.min_free_percent:g}"
        return ""

    def never_enough(self) -> bool:
        """Whether even the empty disk has too little: a configuration to correct, and nothing to wait for."""
        return self._free is free_bytes and _usage(self._folder).total < self._config.min_free_mb * 1e6


class Retention:
    """Deletes a recorder's oldest closed files where keep_days, keep_mb or keep_free_mb say so.

    space: the disk. now: Unix time [s].
    """

    def __init__(self, config: RecorderConfig, space: Space, now: Callable[[], float] = time.time) -> None:
        self._config, self._space, self._now = config, space, now
        self.deleted = 0

    def clean(self, current: Path | None) -> None:
        """Delete what is to go; ``current``, and what another process writes, stays."""
        config = self._config
        if config.keep_days is None and config.keep_mb is None and config.keep_free_mb is None:
            return
        files = self._closed(current)
        with suppress(OSError):  # somebody else has deleted one
            while files and self._too_much(files, current):
                files.pop(0).unlink()
                self.deleted += 1

    def _closed(self, current: Path | None) -> list[Path]:
        """The closed files of this recorder, the oldest first."""
        out = self._config.out
        if out.suffix != ".mcap":
            ordered = sorted((order, path) for path in out.glob("syncline-*.mcap") if (order := _order(path)))
            return [path for _, path in ordered if path != current and not _is_written(path)]
        parts = re.compile(rf"{re.escape(out.stem)}(-(?P<run>\d{{1,2}}))?(-(?P<part>\d{{3,6}}))?\Z")
        found = [(match, path) for path in out.parent.glob("*.mcap") if (match := parts.match(path.stem))]
        found.sort(key=lambda one: (int(one[0]["run"] or 1), int(one[0]["part"] or 0)))
        return [path for _, path in found if path != current and not _is_written(path)]

    def _too_much(self, files: list[Path], current: Path | None) -> bool:
        config = self._config
        # More than the recorder needs to go on: else it would wait beside files that may be deleted.
        if config.keep_free_mb is not None and (
            self._space.lack(RESUME_MARGIN) or self._space.free_mb < config.keep_free_mb
        ):
            return True
        if config.keep_mb is not None:
            every = [*files, *([] if current is None else [current])]
            if sum(path.stat().st_size for path in every) > config.keep_mb * 1e6:
                return True
        if config.keep_days is None:
            return False
        written = files[0].stat().st_mtime
        # A file or a machine whose clock was never set has no age.
        return written > UNSET_CLOCK_UNIX_S and self._now() - written > config.keep_days * _DAY_S


def _is_written(path: Path) -> bool:
    """Whether a process writes to the file: a writer holds a lock."""
    with suppress(OSError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
