"""`syncline calibrate` and `follow` of boxes of several people without labels, and of sessions that are none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tomli_w

from deploy.cli import run
from deploy.offline.people_session import people_session
from deploy.offline.single_target import rows_of_unlabelled_people
from tests.support import crowds

OFFSETS = {"left": 0.0, "right": -37.3, "back": 1200.85}


def write_session(folder: Path, table: str, text: str) -> Path:
    folder.mkdir()
    cameras = {
        name: {"name": name, "size": list(crowds.SIZE), "matrix": crowds.lens().matrix.tolist(), "fps": 5.0}
        | {"distortions": [0.0] * 5}
        for name in crowds.NAMES
    }
    (folder / "rig.toml").write_text(tomli_w.dumps(cameras), encoding="utf-8")
    (folder / table).write_text(text, encoding="utf-8")
    return folder


def test_boxes_without_labels_calibrate_and_are_then_followed(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "crowd", "boxes.csv", crowds.boxes_csv(40.0, 5.0, OFFSETS, noise=2.0))
    out = tmp_path / "out"
    assert run(["calibrate", str(folder), "--height", str(crowds.HEIGHT), "--out", str(out), "--json"]) == 0
    document = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert document["metadata"]["scale"] == "metric"
    for name, camera in document["cameras"].items():
        assert camera["lag_s"] == pytest.approx(OFFSETS[name], abs=0.02)
    followed = ["follow", str(folder), "--calibration", str(out / "calibration.toml"), "--out", str(tmp_path / "f")]
    assert run([*followed, "--json"]) == 0
    tracks = json.loads((tmp_path / "f" / "result.json").read_text(encoding="utf-8"))["tracks"]
    assert len(tracks) == 3


@pytest.mark.parametrize(
    "text",
    [
        "camera,frame,time,u,v\nleft,0,0.0,5,5\n",
        "camera,frame,time,u,v,score,kind\nleft,0,0.0,5,5,95,marker\nleft,0,0.0,6,5,95,marker\n",
        "camera,frame,time,u,v,kind,head_u\nleft,0,0.0,5,5,person,\nleft,1,0.2,6,5,person,7\n",
    ],
)
def test_other_sessions_are_not_taken_for_people(tmp_path: Path, text: str) -> None:
    assert people_session(write_session(tmp_path / "s", "observations.csv", text), None) is None


def test_one_video_with_a_bystander_is_no_crowd() -> None:
    def row(frame: int, label: str) -> str:
        return f"cam0,{frame},{frame / 10},5,5,50,{label},0.9,person" + "," * 11

    one = [row(frame, "p0") for frame in range(20)]
    two = [row(frame, label) for frame in range(20) for label in ("p0", "p1")]
    assert rows_of_unlabelled_people([one, two]) == []
    found = rows_of_unlabelled_people([two, two])
    assert len(found) == 80
    assert all(line.split(",")[6] == "" for line in found)
