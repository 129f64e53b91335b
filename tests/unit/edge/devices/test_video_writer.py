"""Videos that are written are whole or absent."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from deploy.offline.sync import _Writer
from edge.devices.playback.video_writer import video_writer
from protocols.core.errors import InputError


class _FullDisk:
    """OpenCV's writer on a full disk: it says nothing."""

    fourcc = cv2.VideoWriter.fourcc

    def open(self, file: str, *_: object) -> bool:
        """A file without a frame."""
        Path(file).write_bytes(b"")
        return True

    def isOpened(self) -> bool:
        """As if it could be written."""
        return True

    def write(self, image: object) -> None:
        """Nothing is written."""

    def release(self) -> None:
        """Nothing is finished."""


def _film(file: Path) -> None:
    with video_writer(file, 25.0, "") as write:
        for _ in range(30):
            write(np.zeros((64, 96, 3), np.uint8))


@pytest.mark.parametrize("suffix", ["mp4", "avi", "mkv"])
def test_a_film_on_a_full_disk_is_an_error_and_leaves_nothing(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command said that it was written."""
    _film(tmp_path / f"good.{suffix}")
    monkeypatch.setattr(cv2, "VideoWriter", _FullDisk)
    with pytest.raises(InputError, match="could not be written whole; free some space on the disk"):
        _film(tmp_path / f"bad.{suffix}")
    assert [file.name for file in tmp_path.iterdir()] == [f"good.{suffix}"]


def test_a_copy_that_cannot_be_closed_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk the part of `syncline sync` stayed, as a hidden file."""
    writer = _Writer(tmp_path / "a.mp4", 25.0, (96, 64))
    (tmp_path / ".a.part.mp4").write_bytes(b"begun")
    monkeypatch.setattr(writer, "_container", SimpleNamespace(close=_no_space))
    with pytest.raises(OSError, match="No space"):
        writer.__exit__(None, None, None)
    assert not list(tmp_path.iterdir())


def _no_space() -> None:
    raise OSError("No space left on device")
