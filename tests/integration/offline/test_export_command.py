"""`syncline export`: read back by OpenCV, and parsed by hand where no reader is available."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w

from deploy.cli import run
from protocols.core.errors import InputError
from protocols.core.files import file_in
from protocols.geometry import so3
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import read_detections, read_observations
from protocols.topics import CAMERA_INFO, OBSERVATION
from tests.support.samples import camera_info, observation


@pytest.fixture
def calibration(tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    camera = {
        "name": "cam0",
        "size": [640, 480],
        "matrix": [[500.0, 0.0, 320.25], [0.0, 510.0, 240.5], [0.0, 0.0, 1.0]],
        "distortions": [0.1, -0.05, 0.001, 0.002, 0.01],
        "rotation": [0.3, -1.2, 2.1],
        "translation": [1.0, -2.0, 3.0],
        "time_offset": -12.5,
        "clock_rate": 1.00001,
    }
    wide = {**camera, "name": "cam1", "fisheye": True, "distortions": [0.1, 0.0, 0.0, 0.01]}
    file = tmp_path / "calibration.toml"
    file.write_text(tomli_w.dumps({"cam0": camera, "cam1": wide, "metadata": {"units": "cm"}}))
    return file, tomllib.loads(file.read_text())


def test_opencv_reads_its_yaml(tmp_path: Path, calibration: tuple[Path, dict[str, Any]]) -> None:
    file, tables = calibration
    assert run(["export", str(file), "--to", "opencv", "--out", str(tmp_path / "out")]) == 0
    storage = cv2.FileStorage(str(tmp_path / "out" / "cam0.yml"), cv2.FileStorage_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), tables["cam0"]["matrix"])
    np.testing.assert_array_equal(
        storage.getNode("distortion_coefficients").mat().ravel(), tables["cam0"]["distortions"]
    )
    rotation, _ = cv2.Rodrigues(np.array(tables["cam0"]["rotation"]))
    np.testing.assert_allclose(storage.getNode("R").mat(), rotation, atol=1e-12)
    np.testing.assert_allclose(storage.getNode("T").mat().ravel(), tables["cam0"]["translation"], atol=1e-12)
    assert storage.getNode("time_offset").real() == -12.5
    assert storage.getNode("units").string() == "cm"


def test_colmap_gets_its_models_pixels_and_quaternions(
    tmp_path: Path, calibration: tuple[Path, dict[str, Any]]
) -> None:
    file, tables = calibration
    assert run(["export", str(file), "--to", "colmap", "--out", str(tmp_path / "out")]) == 0
    cameras = [line.split() for line in (tmp_path / "out" / "cameras.txt").read_text().splitlines()[1:]]
    assert [words[1] for words in cameras] == ["FULL_OPENCV", "OPENCV_FISHEYE"]
    assert [float(word) for word in cameras[0][4:8]] == [500.0, 510.0, 320.75, 241.0]
    image = (tmp_path / "out" / "images.txt").read_text().splitlines()[1].split()
    w, *xyz = (float(word) for word in image[1:5])
    angle = 2 * np.arctan2(np.linalg.norm(xyz), w)
    turn = np.array(xyz) / np.linalg.norm(xyz) * angle
    np.testing.assert_allclose(so3.exp(turn), so3.exp(np.array(tables["cam0"]["rotation"])), atol=1e-12)
    metres = 0.01 * np.array(tables["cam0"]["translation"])
    np.testing.assert_allclose([float(word) for word in image[5:8]], metres, atol=1e-12)


def test_a_trajectory_becomes_trc_with_empty_gaps(tmp_path: Path) -> None:
    csv = tmp_path / "track.csv"
    rows = ["7.00,1,2,3,0.1,nose", "7.02,4,5,6,0.1,nose", "7.06,7,8,9,0.1,nose", "7.02,100,0,0,0.1,tail"]
    csv.write_text("\n".join(["time,x,y,z,std,label", *rows]) + "\n")
    out = tmp_path / "path.trc"
    assert run(["export", str(csv), "--to", "trc", "--out", str(out), "--units", "cm"]) == 0
    lines = [line.split("\t") for line in out.read_text().splitlines()]
    assert lines[0] == ["PathFileType", "4", "(X/Y/Z)", "path.trc"]
    assert lines[2][2:5] == ["4", "2", "m"]
    assert float(lines[2][0]) == pytest.approx(50)
    assert lines[3][2::3] == ["nose", "tail"]
    table = lines[6:]
    assert [row[0] for row in table] == ["1", "2", "3", "4"]
    assert [float(row[1]) for row in table] == pytest.approx([0, 0.02, 0.04, 0.06])
    assert table[1][2:] == ["0.04", "0.05", "0.06", "1", "0", "0"]
    assert table[2][2:] == [""] * 6


def test_followed_people_are_one_marker_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of people at the same time the last row was written, all as one marker."""
    csv, out = tmp_path / "tracks.csv", tmp_path / "people.trc"
    rows = ["7.5,1,person,confirmed,1,2,0,1.7,1", "7.5,2,person,confirmed,3,4,0,1.7,1", "8,1,person,coasting,5,6,0,2,1"]
    csv.write_text("\n".join(["time,id,kind,state,x,y,z,height,std", *rows]) + "\n")
    assert run(["export", str(csv), "--to", "trc", "--out", str(out)]) == 0
    lines = [line.split("\t") for line in out.read_text().splitlines()]
    assert lines[3][2::3] == ["person1", "person2"]
    assert [line[2:] for line in lines[6:]] == [["1", "2", "0", "3", "4", "0"], ["5", "6", "0", "", "", ""]]
    shown = capsys.readouterr()
    assert "7.500000 s of the reference clock" in shown.out + shown.err
    csv.write_text(csv.read_text().replace(",id,", ",number,").replace(",kind,", ",of,"))
    assert run(["export", str(csv), "--to", "trc", "--out", str(out)]) == 2
    assert "marker has several rows of one time" in capsys.readouterr().err


def test_a_trajectory_has_the_units_of_its_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One in centimetres was exported as metres, a hundred times too large, and one without scale as millimetres."""
    csv, out, result = tmp_path / "trajectory.csv", tmp_path / "path.trc", tmp_path / "result.json"
    csv.write_text("time,x,y,z,std\n0,100,200,300,1\n1,100,200,300,1\n")
    result.write_text(json.dumps({"metadata": {"units": "cm", "scale": "metric"}}))
    assert run(["export", str(csv), "--to", "trc", "--out", str(out)]) == 0
    assert out.read_text().splitlines()[6].split("\t")[2:] == ["1", "2", "3"]
    assert not capsys.readouterr().err
    assert run(["export", str(csv), "--to", "trc", "--out", str(out), "--units", "mm"]) == 2
    assert "the trajectory is in cm, not mm" in capsys.readouterr().err
    result.write_text(json.dumps({"metadata": {"units": "m", "scale": "arbitrary"}}))
    assert run(["export", str(csv), "--to", "trc", "--out", str(out)]) == 0
    shown = capsys.readouterr()
    assert "its lengths are baselines, not m" in shown.out + shown.err
    result.write_text("{}")
    assert run(["export", str(csv), "--to", "trc", "--out", str(out)]) == 2


def test_a_file_of_another_kind_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.csv").write_text("time,x\n1,2\n")
    assert run(["export", str(tmp_path / "a.csv"), "--to", "trc", "--out", str(tmp_path / "b.trc")]) == 2
    assert "a.csv:1: column y, z is missing" in capsys.readouterr().err
    assert not (tmp_path / "b.trc").exists()


@pytest.mark.parametrize("to", ["opencv", "colmap", "kalibr", "aniposelib"])
@pytest.mark.parametrize("name", ["../../evil", "/tmp/evil", "..", "a\\b", "evil\x1b[2J"])
def test_a_camera_s_name_does_not_lead_out_of_the_folder(
    tmp_path: Path, calibration: tuple[Path, dict[str, Any]], name: str, to: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names from aniposelib's files reached the file system: `../../evil` was written beside --out."""
    file, tables = calibration
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    file.write_text(tomli_w.dumps({"cam_0": {**tables["cam0"], "name": name}}))
    before = set(tmp_path.rglob("*"))
    assert run(["export", str(file), "--to", to, "--out", str(inner / "out")]) == 2
    assert set(tmp_path.rglob("*")) == before
    assert "\x1b" not in capsys.readouterr().err


def test_a_writer_checks_that_it_stays_in_its_folder(tmp_path: Path) -> None:
    assert file_in(tmp_path, "GoPro 2.yml") == tmp_path / "GoPro 2.yml"
    for name in ("../x.yml", "/x.yml", "a/b.yml", "a\\b.yml", "..", "", "a\0b"):
        with pytest.raises(InputError):
            file_in(tmp_path, name)


def test_a_full_disk_leaves_no_half_session_that_refuses_the_next_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: Path, observations: object) -> None:
        raise InputError("cannot be written: No space left on device", file=file, remedy="free some space")

    log = Path(__file__).parents[2] / "replay" / "logs" / "v1.mcap"
    with monkeypatch.context() as patch:
        patch.setattr("protocols.session.folder.write_observations", full)
        assert run(["export", str(log), "--out", str(tmp_path / "out")]) == 2
    assert run(["export", str(log), "--out", str(tmp_path / "out")]) == 0


def test_a_log_of_people_and_tags_keeps_everybody(tmp_path: Path) -> None:
    """The table had one of the people of each frame, without head, foot, box and kind, under the label of a point."""
    with LogWriter(tmp_path / "log.mcap") as log:
        log.write(CAMERA_INFO, "cam0", "local", camera_info(), 0)
        for sequence in range(3):
            message = observation("cam0", sequence, points=1)
            tag = pb.Detection(u=1.0, v=2.0, score=1.0, label="tag7", kind="marker")
            other = pb.Detection(u=50.0, v=60.0, score=0.5, kind="person", head=[50.0, 40.0], foot=[50.0, 80.0])
            message.detections.extend([other, tag])
            log.write(OBSERVATION, "cam0", "local", message, sequence)
    assert run(["export", str(tmp_path / "log.mcap"), "--out", str(tmp_path / "out")]) == 0
    table = tmp_path / "out" / "observations.csv"
    rows = read_detections(table, {"cam0": (640, 480)})
    assert rows.label == ["person", "person", "tag7"] * 3
    assert rows.kind == ["person", "person", "marker"] * 3
    np.testing.assert_array_equal(rows.foot[:2], [[320.0, 290.25], [50.0, 80.0]])
    np.testing.assert_array_equal(rows.box[0], [300.5, 210.5, 40.0, 80.0])
    assert read_observations(table, ["cam0"]).labels == ["tag7"]
