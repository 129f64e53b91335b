"""What `sync` reads of a result.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deploy.offline.sync import read_time_maps
from edge.devices.playback.video_reader import VideoReader
from protocols.core.errors import InputError
from tests.support.videos import write_video


@pytest.mark.parametrize(
    ("std", "expected"),
    [(0.25, 0.25), (None, None), (float("nan"), None), (-1.0, None), ("x", InputError), ([1], InputError)],
)
def test_a_std_that_is_none_is_not_known(std: object, expected: object, tmp_path: Path) -> None:
    """A word ended `sync` with a traceback, and -1 was stated as 1 s."""
    films = {}
    for name in ("a", "b"):
        write_video(tmp_path / f"{name}.mkv", [np.zeros((32, 32, 3), np.uint8)] * 3, [0.0, 0.1, 0.2])
        films[name] = VideoReader(tmp_path / f"{name}.mkv")
    file = tmp_path / "result.json"
    file.write_text(json.dumps({"pairs": [{"cameras": ["a", "b"], "lag_s": 0.1, "lag_std_s": std}]}), encoding="utf-8")
    if expected is InputError:
        with pytest.raises(InputError, match="no result of"):
            read_time_maps(file, films)
    else:
        assert read_time_maps(file, films)[2] == {"a": 0.0, "b": expected}
