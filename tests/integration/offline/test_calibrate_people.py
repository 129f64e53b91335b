"""`syncline calibrate` and `follow` of boxes of several people without labels, and of sessions that are none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tomli_w

from deploy.cli import run
from deploy.offline.people_session import people_session, read_people
from deploy.offline.single_target import rows_of_unlabelled_people
from protocols import load_session
from protocols.core.errors import InputError
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


def test_of_many_frames_only_those_that_are_used_become_messages(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "crowd", "boxes.csv", crowds.boxes_csv(4.0, 30.0, OFFSETS))
    _, people, _ = read_people(folder / "boxes.csv", folder / "rig.toml")
    assert len(people) == 3 * 40


def test_a_clock_that_was_set_back_is_used_on_the_longer_side(tmp_path: Path) -> None:
    lines = crowds.boxes_csv(12.0, 5.0, OFFSETS).splitlines()
    for row, line in enumerate(lines):
        camera, frame, time, rest = line.split(",", 3)
        if camera == "right" and int(frame) >= 40:
            lines[row] = f"{camera},{frame},{float(time) - 2.1},{rest}"
    folder = write_session(tmp_path / "crowd", "boxes.csv", "\n".join(lines))
    _, people, warnings = read_people(folder / "boxes.csv", folder / "rig.toml")
    assert "right: its clock steps by -1.9 s; 20 of 60 frames on the other side are left out" in warnings
    assert sum(one.camera == "right" for one in people) == 40


def test_what_needs_labels_says_what_boxes_are_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_session(tmp_path / "crowd", "boxes.csv", crowds.boxes_csv(4.0, 5.0))
    known = crowds.write_calibration(tmp_path / "calibration.toml")
    assert run(["triangulate", str(folder), "--calibration", str(known), "--out", str(tmp_path / "a.csv")]) == 2
    assert "syncline follow" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"no observations\.csv, but boxes\.csv"):
        load_session(folder)
    assert run(["info", str(folder), "--json"]) == 0
    cameras = json.loads(capsys.readouterr().out)["cameras"]
    assert {name: (one["rows"], one["labels"], one["end"]) for name, one in cameras.items()} == {
        name: (60, [], 3.8) for name in crowds.NAMES
    }
    session = people_session(folder, None)
    assert session is not None
    assert len(session.people) == 60


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
