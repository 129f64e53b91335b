"""A session from what a user calls one: a session folder, or a recorded log."""

from __future__ import annotations

from pathlib import Path

from protocols.core.errors import InputError, Refused
from protocols.session.folder import read_folder
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from protocols.session.session import Session


def load_session(path: str | Path, observations: str | Path | None = None) -> Session:
    """The session of a folder (rig.toml, observations.csv) or of a recorded log (.mcap, or a folder of its parts).

    observations: another observations file in place of the folder's own. Raises InputError: file, line, what, remedy.
    """
    path = Path(path)
    if is_log(path):
        if observations is not None:
            raise InputError("--observations goes with a session folder", file=path, remedy="leave it out for a log")
        return Session(*session_from_log(path), path.stem)
    rig, found = read_folder(path, None if observations is None else Path(observations))
    return Session(rig, found, found.warnings, path.name)


def is_log(path: Path) -> bool:
    """Whether a path means a log: a .mcap file, or a folder that holds the parts of one and is no session folder."""
    if path.suffix == ".mcap" and not path.is_dir():
        return True
    return path.is_dir() and not (path / "rig.toml").exists() and any(path.glob("*.mcap"))


def session_from_log(file: Path) -> tuple[Rig, Observations, tuple[str, ...]]:
    """The rig and the observations of a log, and warnings (a damaged end). Raises InputError, Refused."""
    from protocols.log.read.reader import LogReader  # a session folder needs neither MCAP nor protobuf
    from protocols.session.builder import SessionBuilder
    from protocols.topics import CAMERA_INFO, OBSERVATION, RIG_INFO

    builder = SessionBuilder()
    reader = LogReader(file)
    for logged in reader.messages([OBSERVATION, CAMERA_INFO, RIG_INFO]):
        builder.handle(logged.message)
    try:
        rig, observations = builder.build()
    except Refused as refusal:
        raise no_session(file, refusal) from None
    damage = (f"the log is damaged: {reader.damage}",) if reader.damage else ()
    return rig, observations, damage + builder.warnings()


def no_session(file: Path, refusal: Refused) -> InputError:
    """The error of a log without a session, which names the command for a UAV agent's."""
    from protocols.log.read.reader import LogReader
    from protocols.topics import FLIGHT_IMAGE, UAV_INFO

    remedy = "record cameras that see what moves"
    if any(LogReader(file).messages([UAV_INFO])):
        pictured = any(LogReader(file).messages([FLIGHT_IMAGE]))
        follow = "follow its target by syncline track LOG --target x,y,w,h"
        remedy = follow if pictured else "it is a UAV agent's without images: for syncline track, record with [images]"
    return InputError(f"no session in this log: {refusal.reason}", file=file, remedy=remedy)
