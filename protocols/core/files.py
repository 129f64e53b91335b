"""Bounded reading of text and TOML, and atomic writing: several files together or none.

Writing: a temporary file beside the target, fsync, rename.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from protocols.core.errors import InputError

MAX_TEXT = 1 << 30
"""Bytes of a table: 20 million rows, as ten cameras at 60 Hz have in nine hours."""
MAX_TOML = 4 << 20
"""Bytes: eight times a calibration of 1,024 cameras. The parser takes some seconds for it."""
_PART = r"(?:\"(?:[^\"\\\n]|\\.)*+\"?|'[^'\n]*+'?|[\w-]++)"
_KEY = re.compile(rf"(?:{_PART}[ \t]*+\.[ \t]*+){{2,}}|{_PART}")
_MAX_PARTS = 32
"""Of a dotted key: more than any table has. The parser takes time with the square of their number."""


def read_bytes(file: Path, what: str = "file", most: int = MAX_TEXT) -> bytes:
    """The bytes of a regular file, at most ``most``. Raises InputError.

    Pipes and devices are refused without waiting for them: they may have no end. what: names the file in messages.
    """
    try:
        with os.fdopen(os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as stream:
            about = os.fstat(stream.fileno())
            if not stat.S_ISREG(about.st_mode):
                raise InputError("is not a regular file", file=file, remedy="save what it gives to a file first")
            data = stream.read() if about.st_size <= most else None
    except FileNotFoundError:
        raise InputError(f"this {what} does not exist", file=file, remedy="check the path") from None
    except (OSError, ValueError) as error:  # a ValueError: a name with a zero byte
        what = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read: {what}", file=file, remedy="check the file and its permissions") from None
    if data is None:
        raise InputError(f"has more than {most} bytes", file=file, remedy=f"check that it is a {what}")
    return data


def read_text(file: Path, what: str = "file", most: int = MAX_TEXT) -> str:
    """The text of a regular UTF-8 file, lines ended by a line feed. Raises InputError as ``read_bytes``."""
    data = read_bytes(file, what, most)
    try:
        if b"\0" in data[:65_536]:
            raise ValueError
        return re.sub("\r\n?", "\n", data.decode("utf-8-sig"))
    except ValueError:
        if data.startswith(b"\x89MCAP"):
            remedy = f"give a text file; `syncline export {file} --out FOLDER` writes what the log holds as such"
            raise InputError("this is an MCAP log, not text", file=file, remedy=remedy) from None
        raise InputError("cannot be read: it is not UTF-8 text", file=file, remedy="save it as UTF-8 text") from None


_LONG_INTEGER = re.compile(r"[=,\[]\s*[-+]?(?:0[xob])?[0-9a-fA-F_]{19,}")  # as 2**63 in decimal digits


def read_toml(file: Path, what: str = "file") -> tuple[dict[str, Any], str]:
    """The parsed TOML file and its text. Raises InputError with file, line and remedy."""
    text = read_text(file, what, MAX_TOML)
    return parse_toml(text, file), text


def parse_toml(text: str, file: Path) -> dict[str, Any]:
    """A TOML text, parsed; file: what errors name."""
    for key in _KEY.finditer(text):
        if key[0].count(".") > _MAX_PARTS and len(re.findall(_PART, key[0])) > _MAX_PARTS:
            line = text.count("\n", 0, key.start()) + 1
            what = f"a key of more than {_MAX_PARTS} parts"
            raise InputError(what, file=file, line=line, remedy="write a plain TOML file")
    try:
        values = tomllib.loads(text)
        _check_integers(values)
        return values
    except (RecursionError, OverflowError):
        number = _LONG_INTEGER.search(text)
        at = text.count("\n", 0, number.end()) + 1 if number else None
        what = "a number too large" if number else "nested too deeply or a number too large"
        raise InputError(what, file=file, line=at, remedy="write a plain TOML file") from None
    except ValueError as error:
        if file.suffix.lower() == ".csv":
            raise InputError("this is a table, not TOML", file=file, remedy="give a .toml file") from None
        message = str(error)
        place = re.search(r"at line (\d+)", message)
        line = int(place.group(1)) if place else len(text.splitlines()) or 1
        short = re.sub(r"\s*\(at .*\)", "", message)
        raise InputError(f"not valid TOML: {short}", file=file, line=line, remedy="correct this line") from None


def toml_line(text: str, table: str, key: str | None = None) -> int | None:
    """The line of a key in a table of a TOML text, as far as a plain scan finds it; otherwise that of the header.

    table: dotted name, "" = before the first header.
    """
    found, inside, depth = None, not table, 0
    header = re.compile(r"\s*\[+\s*[\"']?" + re.escape(table) + r"[\"']?\s*\]+")
    for number, row in enumerate(text.splitlines(), 1):
        within_list, depth = depth > 0, max(0, depth + row.count("[") - row.count("]"))
        if within_list:
            continue
        if header.match(row):
            inside, found = True, number
        elif inside and row.lstrip().startswith("[") and "=" not in row:
            return found
        elif inside and key is not None and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*[=.]", row):
            return number
    return found


def _check_integers(values: object) -> None:
    """Raise OverflowError for an integer of more than 64 bits, which no TOML file has and Python may not print."""
    rest = [values]
    while rest:
        one = rest.pop()
        if isinstance(one, dict | list):
            rest += one.values() if isinstance(one, dict) else one
        elif isinstance(one, int) and not -(2**63) <= one < 2**63:
            raise OverflowError


def destination(file: Path) -> Path:
    """The file that an output ``file`` leads to, through symbolic links. Raises InputError for a pipe or a device.

    A renamed file would take the place of a link, and, for root, that of /dev/null or /dev/stdout.
    """
    try:
        special = not (stat.S_ISREG(mode := file.stat().st_mode) or stat.S_ISDIR(mode))
    except OSError:  # not there, or not to be looked at, which writing will say
        special = False
    if special:
        raise InputError("is a device or a pipe, no file", file=file, remedy="give the name of a file")
    return file.resolve() if file.is_symlink() else file


def write_atomically(file: Path, text: str) -> None:
    """Write ``text`` (UTF-8) to ``file``: a reader sees the old file or the new one, never a part.

    Raises InputError where the folder cannot be written.
    """
    write_together({file: text})


def write_together(files: Mapping[Path, str]) -> None:
    """Write several files: all are prepared before the first one takes its place.

    A full disk or missing permissions therefore leave none of them written. Raises InputError.
    """
    prepared: list[tuple[Path, Path]] = []
    now = Path()
    try:
        for given, text in files.items():
            now = given
            file = destination(given)
            file.parent.mkdir(parents=True, exist_ok=True)
            if file.is_dir():
                raise IsADirectoryError(errno.EISDIR, "this is a folder, but a file is needed")
            handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name[:40]}.")
            prepared.append((Path(name), file))
            with os.fdopen(handle, "w", encoding="utf-8", errors="replace", newline="") as out:
                out.write(text)
                out.flush()
                os.fsync(out.fileno())
            Path(name).chmod(0o644)
        for temporary, file in prepared:
            now = file
            temporary.replace(file)
    except OSError as error:
        remedy = "free some space" if error.errno == errno.ENOSPC else "choose another folder, or correct its rights"
        raise InputError(f"cannot be written: {error.strerror}", file=now, remedy=remedy) from None
    finally:
        for temporary, _ in prepared:
            temporary.unlink(missing_ok=True)


def remove_files(files: Iterable[Path]) -> None:
    """Remove files of an earlier result, where there are any. Raises InputError."""
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            what = f"cannot be removed: {error.strerror}"
            raise InputError(what, file=file, remedy="choose another --out") from None


def write_private(file: Path, content: bytes, mode: int = 0o600) -> None:
    """Write ``file`` atomically, at no time readable by others than its ``mode`` names."""
    with completed_file(file) as part:
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
            out.write(content)
            out.flush()
            os.fsync(out.fileno())
        part.chmod(mode)


@contextmanager
def completed_file(file: Path, *, new: bool = False) -> Iterator[Path]:
    """A path beside ``file`` to write to, of the same suffix; it replaces ``file`` at the end, unless that failed.

    new: whether to raise InputError where ``file`` exists.
    """
    if new and file.exists():
        raise InputError("exists already", file=file, remedy="choose another --out, or move it away")
    file = destination(file)
    temporary = file.with_name(f".{file.stem}.{os.getpid()}{file.suffix}")
    temporary.unlink(missing_ok=True)
    try:
        yield temporary
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)


def file_in(folder: Path, name: str) -> Path:
    """The file ``name`` directly in ``folder``; raises InputError for a name that leads anywhere else.

    Names of cameras cannot (``protocols.core.names``); this is the writers' own check.
    """
    if name in ("", ".", "..") or any(separator in name for separator in "/\\\0"):
        raise InputError(f"{name[:80]!a} is no file name", file=folder, remedy="rename the camera")
    return folder / name


def check_folder(folder: Path) -> None:
    """Raise InputError if ``folder`` cannot be created or used as an output folder; creates nothing."""
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError("not a folder", file=folder, remedy="choose another --out")
        place = next(place for place in (folder, *folder.absolute().parents) if place.exists())
        if not place.is_dir():
            raise InputError(f"{place} is not a folder", file=folder, remedy="choose another --out")
        if not os.access(place, os.W_OK | os.X_OK):
            raise InputError("may not be written to", file=place, remedy="choose another folder, or correct its rights")
    except OSError as error:
        raise InputError(f"cannot be a folder: {error.strerror}", file=folder, remedy="choose another --out") from None
