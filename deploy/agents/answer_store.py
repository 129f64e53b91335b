"""Every answer of a hub on disk at once, with its history; the last one is reloaded after a crash."""

from __future__ import annotations

import os
import re
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from protocols.core.errors import InputError
from protocols.core.files import check_folder, write_together
from protocols.core.version import VERSION
from protocols.session.calibration import Calibration, calibration_text, read_calibration
from protocols.session.rig import Rig

LAST = "current.toml"
"""A link to the newest answer in the history."""
HISTORY = "history"
_MAX_AGE_S = 900.0
"""An answer older than this is not reloaded: the cameras' clocks have drifted, and who knows where they stand now."""
_NUMBER = re.compile(r"(\d+)-")


def default_folder(out: Path | None, site: str, agent: str) -> Path:
    """Where a hub's answers are kept: beside what it writes, else in the user's state folder."""
    if out is not None:
        return out / "state"
    home = os.environ.get("XDG_STATE_HOME") or str(Path("~/.local/state").expanduser())
    return Path(home) / "syncline" / site / agent


class AnswerStore:
    """Writes answers in a thread of its own, atomically; the hub's loop never waits for a disk.

    history: how many answers are kept. copy: the calibration.toml that is always the newest. problem: why the last
    answer could not be kept, or none can; "" if it was. kept_unix_s: when the loaded answer was kept.
    """

    def __init__(self, folder: Path, history: int = 200, copy: Path | None = None) -> None:
        self.folder = folder
        self.problem = _problem(folder) or ("" if copy is None else _problem(copy.parent))
        self.kept_unix_s = 0.0
        self._history, self._copy = history, copy
        self._writer = ThreadPoolExecutor(1, "answers")
        self._pending: Future[None] | None = None

    def keep(self, calibration: Calibration, rig: Rig, boot_ids: dict[str, str], delays: dict[str, float]) -> None:
        """Write an answer. boot_ids, delays: by camera, see `LiveHub.reload`."""
        if self._pending is not None and not self._pending.done():
            self._pending.cancel()  # a slow disk: only the newest counts
        clocks = {"boot_ids": dict(boot_ids), "delays": dict(delays), "kept_unix_s": time.time()}
        self._pending = self._writer.submit(self._write, calibration, rig, clocks)

    def load(self, of_any_age: bool = False) -> tuple[Calibration, dict[str, str], dict[str, float], Rig] | None:
        """The last answer with its boot ids, delays and rig, if it is recent, or of any age, and readable."""
        file = self.folder / LAST
        try:
            if not file.is_file() or not (of_any_age or abs(time.time() - file.stat().st_mtime) <= _MAX_AGE_S):
                return None
            rig, cameras = read_calibration(file)
        except (InputError, OSError):
            return None
        boots, delays = rig.metadata.get("boot_ids"), rig.metadata.get("delays")
        if not isinstance(boots, dict) or not isinstance(delays, dict) or len(cameras) < 2:
            return None
        metadata = {key: str(rig.metadata.get(key, "")) for key in ("reference", "scale")}
        kept = rig.metadata.get("kept_unix_s")
        self.kept_unix_s = float(kept) if isinstance(kept, int | float) else file.stat().st_mtime
        calibration = Calibration(cameras, metadata["reference"], metadata["scale"], rig.units, "joint", VERSION)
        seconds = {name: float(delay) for name, delay in delays.items() if isinstance(delay, int | float)}
        return calibration, {name: str(boot) for name, boot in boots.items()}, seconds, rig

    def close(self) -> None:
        """Wait for the last answer to be written."""
        self._writer.shutdown(wait=True)

    def _write(self, calibration: Calibration, rig: Rig, clocks: dict[str, object]) -> None:
        text = calibration_text(calibration, replace(rig, metadata={**rig.metadata, **clocks}))
        history = self.folder / HISTORY
        try:
            there = sorted(history.glob("*.toml"), key=_number)
            # By number, and not by the time alone: a clock may be set back.
            number = _number(there[-1]) + 1 if there else 1
            newest = history / f"{number:06d}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}.toml"
            plain = {} if self._copy is None else {self._copy: calibration_text(calibration, rig)}
            write_together({newest: text, **plain})
            link = self.folder / f".{LAST}.new"
            link.unlink(missing_ok=True)
            link.symlink_to(newest.relative_to(self.folder))
            link.replace(self.folder / LAST)
            for old in there[: max(len(there) + 1 - self._history, 0)]:
                old.unlink(missing_ok=True)
        except (InputError, OSError) as error:
            self.problem = str(error)
        else:
            self.problem = ""


def _problem(folder: Path) -> str:
    try:
        check_folder(folder)
    except InputError as error:
        return str(error)
    return ""


def _number(file: Path) -> int:
    found = _NUMBER.match(file.name)
    return 0 if found is None else int(found[1])
