"""Several people, whom every camera numbers in its own way: calibration and triangulation from their keypoints."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from hub.calibration.people.association import associate_people
from protocols.geometry.pose import fit_similarity
from protocols.session.calibration import read_calibration
from protocols.session.observations import Observations
from tests.bench.several_people import named
from tests.support.rigs import write_session
from tests.support.walking_people import THIGH, people_world

Capture = pytest.CaptureFixture[str]
SECONDS = 12.0
FEW = {"nose", "left_hip", "right_hip", "left_knee", "right_knee", "left_wrist", "right_wrist"}


def test_people_get_one_name_in_all_cameras_whatever_each_camera_called_them() -> None:
    world = people_world(12, 3, (12.0, 15.0, 12.0))
    given = world.observations(SECONDS, seed=12)
    mixed = named(world, given)
    assert all(max(who.values()) < 0.8 * who.total() for who in mixed.values())  # by the cameras' own numbers
    _, seen, note = associate_people(world.rig(), given)
    found = named(world, seen)
    assert "people were associated" in note
    assert sum(max(who.values()) for who in found.values()) > 0.98 * sum(who.total() for who in found.values())
    assert len(seen) > 0.9 * len(given)


def test_names_that_agree_are_kept() -> None:
    world = people_world(13, 2, (12.0, 15.0))
    _, first, _ = associate_people(world.rig(), world.observations(SECONDS, seed=13))
    rig, again, note = associate_people(world.rig(), first)
    assert again is first
    assert (rig.scale_bars, note) == ((), "")


def test_several_people_calibrate_the_cameras_in_metres_and_get_their_joints(tmp_path: Path, capsys: Capture) -> None:
    world = people_world(14, 2, (12.0, 15.0, 12.0))
    out = tmp_path / "out"
    seen = world.observations(SECONDS, seed=14)
    few = {key: track for key, track in seen.tracks.items() if key[1].partition(".")[2] in FEW}
    session = write_session(tmp_path / "session", world.rig(), Observations(few))
    height = f"{world.heights.mean():.3f}"
    assert run(["calibrate", str(session), "--height", height, "--out", str(out), "--json"]) == 0
    assert "people were associated" in "".join(json.loads(capsys.readouterr().out)["warnings"])
    rig, cameras = read_calibration(out / "calibration.toml")
    assert rig.metadata["scale"] == "metric"
    places, true = (np.array([one[name].pose.position for name in cameras]) for one in (cameras, world.cameras))
    fit = fit_similarity(places, true)
    assert len(cameras) == 3
    assert np.linalg.norm(fit.points(places) - true, axis=1).max() < 0.05
    assert fit.scale == pytest.approx(1.0, rel=0.03)
    table = tmp_path / "joints.csv"
    arguments = ["triangulate", str(session), "--calibration", str(out / "calibration.toml"), "--out", str(table)]
    assert run([*arguments, "--json"]) == 0
    labels = json.loads(capsys.readouterr().out)["labels"]
    assert {label.partition(".")[2] for label in labels} == FEW
    rows = np.genfromtxt(table, delimiter=",", names=True, dtype=None, encoding="utf-8")
    for person in {label.partition(".")[0] for label in labels}:
        hip, knee = (rows[rows["label"] == f"{person}.left_{joint}"] for joint in ("hip", "knee"))
        if len(hip) > 50 and len(hip) == len(knee):
            thigh = np.median(np.linalg.norm([hip[axis] - knee[axis] for axis in "xyz"], axis=0))
            assert thigh / THIGH == pytest.approx(world.heights.mean(), rel=0.15)
