"""Expensive tests of video folders: an unrelated video among them, and lens self-calibration from outlines.

Here and not among the commands' tests because the lag of an unconnected camera is searched exhaustively at every rate,
and unknown lenses are estimated twice.
"""

from __future__ import annotations

import csv
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import tomli_w

from deploy.cli import run
from hub.calibration.pipeline import calibrate
from tests.support.videos import record_scene_videos
from tests.unit.protocols.test_sphere_projection import ball_session


def test_a_video_of_another_day_is_refused_by_name_and_the_rest_goes_on(tmp_path: Path) -> None:
    videos, before, out = tmp_path / "videos", tmp_path / "before", tmp_path / "out"
    record_scene_videos(videos, 6.0, 2, 4)
    record_scene_videos(before, 6.0, 2, 9)
    (before / "cam0.mp4").rename(videos / "yesterday.mp4")
    tables = tomllib.loads((videos / "rig.toml").read_text())
    tables["yesterday"] = tomllib.loads((before / "rig.toml").read_text())["cam0"] | {"name": "yesterday"}
    (videos / "rig.toml").write_text(tomli_w.dumps(tables))
    assert run(["calibrate", str(videos), "--out", str(out)]) == 0
    found = tomllib.loads((out / "calibration.toml").read_text())
    assert set(found) == {"cam0", "cam1", "metadata"}
    assert "could not be connected to any camera (with cam0:" in found["metadata"]["refused"]["yesterday"]
    with (out / "session" / "observations.csv").open(newline="") as file:
        seen = [row for row in csv.DictReader(file) if row["camera"] == "yesterday"]
    assert len(seen) > 50  # the ball is in it: only the motion is another


def test_without_intrinsics_outlines_give_the_same_lenses_as_centres() -> None:
    full, seen = ball_session(0.25)
    focal: list[list[float]] = []
    for outline, observations in ((True, seen), (False, full.observations())):
        cameras = {n: replace(c, intrinsics=None, ball_outline=outline) for n, c in full.rig.cameras.items()}
        found = calibrate(replace(full.rig, cameras=cameras), observations)
        focal.append([found.cameras[name].intrinsics.focal for name in full.rig.cameras])
    assert np.abs(np.log(focal[0]) - np.log(focal[1])).max() < 3e-4  # taken as centres, they are 1e-3 apart
