"""Files that are whole or not there: written beside, fsynced, renamed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from protocols.errors import InputError


def write_atomically(file: Path, text: str) -> None:
    """Write ``text`` (UTF-8) to ``file``: a reader sees the old file or the new one, never a part.

    Raises InputError where the folder cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror}", file=file, remedy="choose another folder or its rights"
        ) from None
    temporary = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as out:
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        temporary.chmod(0o644)
        temporary.replace(file)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(f"cannot be written: {error.strerror}", file=file, remedy="free some space") from None
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
