"""What a user may call a session: a folder, or a log that Syncline recorded."""

from __future__ import annotations

from pathlib import Path

from protocols.core.errors import InputError
from protocols.session.observations import Observations
from protocols.session.rig import Rig


def load_session(path: Path, observations: Path | None = None) -> tuple[Rig, Observations, tuple[str, ...]]:
    """The rig, the observations and warnings. Raises InputError."""
    if is_log(path):
        if observations is not None:
            raise InputError("--observations goes with a session folder", file=path, remedy="leave it out for a log")
        from protocols.log.read.session import session_from_log

        return session_from_log(path)
    from protocols.session.folder import read_folder

    rig, found = read_folder(path, observations)
    return rig, found, found.warnings


def is_log(path: Path) -> bool:
    """Whether a path means a log: a .mcap file, or a folder that holds the parts of one and is no session folder."""
    if path.suffix == ".mcap" and not path.is_dir():
        return True
    return path.is_dir() and not (path / "rig.toml").exists() and any(path.glob("*.mcap"))
