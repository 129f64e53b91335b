"""Atomic file writing: a temporary file beside the target, fsync, rename; several files together or none."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from protocols.core.errors import InputError


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
        for file, text in files.items():
            now = file
            file.parent.mkdir(parents=True, exist_ok=True)
            if file.is_dir():
                raise IsADirectoryError(errno.EISDIR, "this is a folder, but a file is needed")
            handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name[:40]}.")
            prepared.append((Path(name), file))
            with os.fdopen(handle, "w", encoding="utf-8", newline="") as out:
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
        for parent in folder.parents:
            if parent.exists():
                if not parent.is_dir():
                    raise InputError(f"{parent} is not a folder", file=folder, remedy="choose another --out")
                break
    except OSError as error:
        raise InputError(f"cannot be a folder: {error.strerror}", file=folder, remedy="choose another --out") from None
