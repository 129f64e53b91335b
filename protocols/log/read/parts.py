"""Logs in several files: name-000.mcap, name-001.mcap, …; each part is a complete MCAP file."""

from __future__ import annotations

import re
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Metadata

from protocols.core.errors import InputError
from protocols.log.layout import FORMAT_RECORD, part_path, with_checksum
from protocols.log.read.mcap_records import MALFORMED, Damage, open_log, read_records

_PART = re.compile(r"(?P<stem>.+)-(?P<number>\d{3,6})\Z")


class Parts(NamedTuple):
    """The files of one log in order, and a description of missing parts ("" if none)."""

    paths: tuple[Path, ...]
    missing: str


def find_parts(path: Path) -> Parts:
    """The files of the log ``path``: a folder with one log, its first part, or a single file. Raises InputError."""
    if path.is_dir():
        return _in_folder(path)
    open_log(path).close()
    found = _PART.match(path.stem)
    if found is None or int(found["number"]) != 0:
        return Parts((path,), "")
    session = log_format(path).get("session")
    if not session:
        return Parts((path,), "")
    numbered: dict[int, Path] = {}
    for other in path.parent.glob("*.mcap"):
        match = _PART.match(other.stem)
        if match is not None and match["stem"] == found["stem"] and _belongs(other, session):
            numbered[int(match["number"])] = other
    absent = sorted(set(range(max(numbered) + 1)) - set(numbered))
    names = ", ".join(part_path(path.with_name(f"{found['stem']}.mcap"), number).name for number in absent[:5])
    missing = f"{len(absent)} of its parts are missing ({names})" if absent else ""
    return Parts(tuple(numbered[number] for number in sorted(numbered)), missing)


def log_format(path: Path) -> dict[str, str]:
    """The format record at a log's beginning; {} if there is none."""
    with open_log(path) as stream:
        for frame in read_records(stream, Damage()):
            if frame.opcode == Opcode.CHUNK:
                break
            if frame.opcode == Opcode.METADATA:
                try:
                    record = Metadata.read(ReadDataStream(BytesIO(frame.content)))
                except MALFORMED:
                    continue
                if record.name == FORMAT_RECORD and record.metadata == with_checksum(record.metadata):
                    return dict(record.metadata)
    return {}


def _belongs(path: Path, session: str) -> bool:
    """Whether a file with a matching name belongs to the session; assumed if its beginning is damaged."""
    try:
        return log_format(path).get("session", session) == session
    except InputError:
        return False


def _in_folder(folder: Path) -> Parts:
    files = sorted(folder.glob("*.mcap"))
    if not files:
        raise InputError("no .mcap log in this folder", file=folder, remedy="give the log itself")
    stems = {found["stem"] if (found := _PART.match(file.stem)) else file.stem for file in files}
    if len(stems) > 1:
        names = ", ".join(sorted(stems)[:5])
        raise InputError(f"{len(stems)} logs in this folder ({names})", file=folder, remedy="give one of them")
    first = find_parts(files[0])
    if len(first.paths) == len(files):
        return first
    if first.paths == (files[0],) and log_format(files[0]).get("part") not in (None, "0"):
        lost = f"its first parts are missing (it begins with {files[0].name})"
        return Parts(tuple(files), lost)
    raise InputError(f"{len(files)} logs in this folder", file=folder, remedy="give one of them")
