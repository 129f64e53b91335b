"""`syncline follow` on made-up boxes: outputs, scores, lags, logs, refusals and bad input."""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION, TRACK
from tests.support.crowds import HEIGHT, NAMES, SIZE, boxes_csv, truth_csv, write_calibration
from tests.support.videos import write_video

SECONDS, FPS = 5.0, 5.0
OFFSETS = {"left": 0.0, "right": 12.5, "back": -3.25}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with boxes of three people by three cameras that are 50 ms apart and share no clock."""
    folder = tmp_path_factory.mktemp("crowd")
    (folder / "boxes.csv").write_text(boxes_csv(SECONDS, FPS, OFFSETS), encoding="utf-8")
    (folder / "truth.csv").write_text(truth_csv(SECONDS, FPS), encoding="utf-8")
    write_calibration(folder / "calibration.toml", offsets=OFFSETS)
    return folder


@pytest.fixture(scope="module")
def followed(session: Path) -> Path:
    """The same, followed and scored."""
    arguments = ["follow", str(session), "--calibration", str(session / "calibration.toml")]
    assert run([*arguments, "--out", str(session / "out"), "--truth", str(session / "truth.csv")]) == 0
    return session / "out"


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8") as text:
        return list(csv.DictReader(text))


def test_three_people_are_three_tracks_with_their_heights(followed: Path) -> None:
    table = rows(followed / "tracks.csv")
    assert list(table[0]) == ["time", "id", "kind", "state", "x", "y", "z", "height", "std"]
    assert {row["id"] for row in table} == {"1", "2", "3"}
    assert {row["kind"] for row in table} == {"person"}
    assert {row["state"] for row in table} <= {"confirmed", "coasting"}
    assert sorted({float(row["time"]) for row in table})[-1] == pytest.approx(SECONDS - 1.0 / FPS)
    late = [row for row in table if float(row["time"]) > 2.0]
    assert all(abs(float(row["height"]) - HEIGHT) < 0.08 for row in late)
    assert all(abs(float(row["z"])) < 0.15 and 0.0 < float(row["std"]) < 0.3 for row in late)


def test_the_scores_say_that_nobody_is_lost_or_exchanged(followed: Path) -> None:
    document = json.loads((followed / "result.json").read_text(encoding="utf-8"))
    scores = document["scores"]
    assert scores["mota"] > 0.95
    assert scores["idf1"] > 0.95
    assert scores["hota"] > 0.8
    assert scores["switches"] == 0
    assert document["count"] == 3
    assert set(document["cameras"]) == set(NAMES)
    assert all(camera["used"] > 0.9 and camera["frames"] == SECONDS * FPS for camera in document["cameras"].values())
    assert [track["cameras"] for track in document["tracks"]] == [sorted(NAMES)] * 3


def test_the_report_is_one_file_that_loads_nothing(followed: Path) -> None:
    page = (followed / "report.html").read_text(encoding="utf-8")
    assert "3 people followed through 3 cameras" in page
    for title in ("Paths over the ground", "Identities over time", "Coverage of each camera", "Scores"):
        assert f"<h2>{title}</h2>" in page
    assert "http" not in page.replace("http-equiv", "")


def test_the_plan_is_seen_along_the_vertical_that_people_show_where_none_is_given(
    session: Path, tmp_path: Path
) -> None:
    """It was drawn along the world's z, which of a calibration without metadata is a camera's optical axis."""
    calibration, count = re.subn(r"up = \[[^]]*\]", "", (session / "calibration.toml").read_text(encoding="utf-8"))
    assert count == 1
    (tmp_path / "calibration.toml").write_text(calibration, encoding="utf-8")
    given = ["--calibration", str(tmp_path / "calibration.toml"), "--out", str(tmp_path / "out")]
    assert run(["follow", str(session), *given]) == 0
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "ahead" in page  # not y, which is horizontal by a fraction of a degree only


def test_rows_at_another_rate_and_json(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--calibration", str(session / "calibration.toml"), "--out", str(tmp_path / "out"), "--fps", "20"]
    assert run(["follow", str(session / "boxes.csv"), *arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["times"] == 99  # 0 s to the last camera's last frame at 4.9 s
    times = sorted({float(row["time"]) for row in rows(tmp_path / "out" / "tracks.csv")})
    assert times[1] - times[0] == pytest.approx(0.05)


def test_a_log_of_the_boxes_is_followed_and_replayed(
    session: Path, followed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = ["--calibration", str(session / "calibration.toml")]
    log = tmp_path / "boxes.mcap"
    assert run(["import", str(session), *calibration, "--out", str(log)]) == 0
    assert run(["follow", str(log), *calibration, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "tracks.csv").read_bytes() == (followed / "tracks.csv").read_bytes()
    assert run(["replay", str(log), "--through", "hub", *calibration, "--out", str(tmp_path / "hub.mcap")]) == 0
    last: dict[str, pb.Track] = {}
    for logged in LogReader(tmp_path / "hub.mcap").messages([TRACK]):
        assert isinstance(logged.message, pb.Track)
        last[logged.message.label] = logged.message
    assert len([track for track in last.values() if track.state == "confirmed"]) == 3
    wrong = write_calibration(tmp_path / "mm.toml", scale=1000.0, offsets=OFFSETS)
    other = tmp_path / "other.mcap"
    assert run(["replay", str(log), "--through", "hub", "--calibration", str(wrong), "--out", str(other)]) == 2
    wrong.write_text(re.sub("left|right|back", r"other_\g<0>", (session / "calibration.toml").read_text()))
    assert run(["replay", str(log), "--through", "hub", "--calibration", str(wrong), "--out", str(other)]) == 2
    assert "none of its cameras is in the log, which has back, left, right" in capsys.readouterr().err
    assert not other.exists()


def test_observations_of_people_need_no_rig_beside_a_calibration(session: Path, followed: Path, tmp_path: Path) -> None:
    """`import` said that their format was unknown, and looked like observations.csv."""
    lines = ["camera,frame,time,u,v,kind,box_x,box_y,box_w,box_h"]
    for line in (session / "boxes.csv").read_text(encoding="utf-8").splitlines()[1:]:
        head, (x, y, w, h) = line.split(",")[:3], (float(cell) for cell in line.split(",")[3:])
        lines.append(",".join([*head, f"{x + w / 2!r},{y + h / 2!r},person,{x!r},{y!r},{w!r},{h!r}"]))
    folder, log = tmp_path / "rows", tmp_path / "rows.mcap"
    folder.mkdir()
    (folder / "observations.csv").write_text("\n".join(lines), encoding="utf-8")
    calibration = ["--calibration", str(session / "calibration.toml")]
    assert run(["import", str(folder), *calibration, "--out", str(log)]) == 0
    assert run(["follow", str(log), *calibration, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "tracks.csv").read_bytes() == (followed / "tracks.csv").read_bytes()


def test_videos_of_nobody_are_a_refusal_and_unknown_videos_bad_input(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # without processes, whose start takes longer than these videos
    grey = [np.full((SIZE[1], SIZE[0], 3), 90 + index, np.uint8) for index in range(3)]
    (tmp_path / "right.mp4").write_bytes(b"no video")
    known = ["--calibration", str(session / "calibration.toml"), "--out", str(tmp_path / "out")]
    assert "right.mp4: " in refused(["follow", str(tmp_path), *known], 2, capsys)
    write_video(tmp_path / "left.mp4", grey, [0.0, 0.2, 0.4])  # the other is left out
    assert "no person in any frame" in refused(["follow", str(tmp_path), *known], 3, capsys)
    (tmp_path / "right.mp4").unlink()
    (seen,) = {
        message.topic.name for message in LogReader(tmp_path / "out" / "detections.mcap").messages([OBSERVATION])
    }
    assert seen == OBSERVATION.name
    write_video(tmp_path / "door.mp4", grey[:2], [0.0, 0.2])
    assert "door.mp4: camera 'door' is not in the calibration" in refused(["follow", str(tmp_path), *known], 2, capsys)
    (tmp_path / "door.mp4").unlink()
    write_video(tmp_path / "left.mp4", [picture[:480, :640] for picture in grey], [0.0, 0.2, 0.4])
    assert "this video is 640x480" in refused(["follow", str(tmp_path), *known], 2, capsys)
    write_video(tmp_path / "left.mp4", [np.ascontiguousarray(np.rot90(picture)) for picture in grey], [0.0, 0.2, 0.4])
    assert "a copy may have lost its rotation" in refused(["follow", str(tmp_path), *known], 2, capsys)


def refused(arguments: list[str], status: int, capsys: pytest.CaptureFixture[str]) -> str:
    assert run(arguments) == status
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_bad_input_is_one_line_and_status_2(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (session / "boxes.csv").read_text(encoding="utf-8")
    bad = tmp_path / "boxes.csv"
    bad.write_text(text + "left,40,5.0,90000,10,40,160\n", encoding="utf-8")
    known = ["--calibration", str(session / "calibration.toml"), "--out", str(tmp_path / "out")]
    line = refused(["follow", str(bad), *known], 2, capsys)
    assert f"boxes.csv:{len(text.splitlines()) + 1}: the box lies outside the 960x720 picture" in line
    wrong = write_calibration(tmp_path / "wrong.toml", scale=1000.0, offsets=OFFSETS)
    arguments = ["follow", str(session), "--calibration", str(wrong), "--out", str(tmp_path / "out")]
    assert "wrong.toml:2: the cameras' positions are about 1000 times too large" in refused(arguments, 2, capsys)
    (tmp_path / "truth.csv").write_bytes(b"time,person,x,y\n0,a,1,\xff\n")
    line = refused(["follow", str(session), *known, "--truth", str(tmp_path / "truth.csv")], 2, capsys)
    assert "truth.csv:" in line
    assert "cannot be read" in line
    (tmp_path / "truth.csv").write_text("time,person,x,y\n0,a,1,1\n", encoding="utf-8")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "trackeval.metrics", None)
        patch.setattr("hub.tracking.offline.follow", None)  # said before the work
        line = refused(["follow", str(session), *known, "--truth", str(tmp_path / "truth.csv")], 2, capsys)
    assert "TrackEval, which scores tracks, is not installed" in line
    assert "--crops needs pictures" in refused(["follow", str(session), *known, "--crops", str(tmp_path)], 2, capsys)
    assert "--area goes with --truth" in refused(["follow", str(session), *known, "--area", "-1,1,-1,1"], 2, capsys)
    assert "does not exist" in refused(["follow", str(tmp_path / "nothing"), *known], 2, capsys)
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n\0")
    given = ["--observations", str(tmp_path / "a.mcap")]
    assert "this is an MCAP log, not text" in refused(["follow", str(session), *known, *given], 2, capsys)
    assert not (tmp_path / "out").exists()
