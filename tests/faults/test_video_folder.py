"""A folder with a video that does not belong: whose marker moved on another day, before the same lenses.

Here and not among the commands' tests because a camera that nothing ties is sought dearly, at every rate.
"""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path

import tomli_w

from deploy.cli import run
from tests.films import film_scene


def test_a_video_of_another_day_is_refused_by_name_and_the_rest_goes_on(tmp_path: Path) -> None:
    videos, before, out = tmp_path / "videos", tmp_path / "before", tmp_path / "out"
    film_scene(videos, 6.0, 2, 4)
    film_scene(before, 6.0, 2, 9)
    (before / "cam0.mp4").rename(videos / "yesterday.mp4")
    tables = tomllib.loads((videos / "rig.toml").read_text())
    tables["yesterday"] = tomllib.loads((before / "rig.toml").read_text())["cam0"] | {"name": "yesterday"}
    (videos / "rig.toml").write_text(tomli_w.dumps(tables))
    assert run(["calibrate", str(videos), "--out", str(out)]) == 0
    found = tomllib.loads((out / "calibration.toml").read_text())
    assert set(found) == {"cam0", "cam1", "metadata"}
    assert "could not be tied to any camera (with cam0:" in found["metadata"]["refused"]["yesterday"]
    with (out / "session" / "observations.csv").open(newline="") as file:
        seen = [row for row in csv.DictReader(file) if row["camera"] == "yesterday"]
    assert len(seen) > 50  # the ball is in it: only the motion is another
