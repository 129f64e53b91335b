"""`syncline export` and `import`: there and back without a loss, and read by the other projects where they are here."""

from __future__ import annotations

import json
import os
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
import yaml

from deploy.cli import run
from protocols.core.names import key_segment
from protocols.geometry import so3
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.log.read.session import load_session
from protocols.session.calibration import read_calibration
from protocols.session.folder import read_folder
from tests.support.command_line import refusal
from tests.support.videos import numbered_image, write_video

Capture = pytest.CaptureFixture[str]

ANIPOSELIB = "SYNCLINE_ANIPOSELIB_PYTHON"
"""A Python that has aniposelib: it brings its own OpenCV, so it cannot live in this environment."""


def camera(name: str, turn: list[float], place: list[float], offset: float, rate: float) -> dict[str, Any]:
    return {
        "name": name,
        "size": [1920, 1080],
        "matrix": [[1400.123456789, 0.0, 955.25], [0.0, 1402.7, 541.5], [0.0, 0.0, 1.0]],
        "distortions": [-0.21, 0.043, 0.0011, -0.0007, 0.0],
        "rotation": turn,
        "translation": place,
        "time_offset": offset,
        "clock_rate": rate,
    }


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """Three cameras in centimetres, one of them a fisheye, on their own clocks."""
    tables: dict[str, Any] = {
        "metadata": {"units": "cm", "scale": "metric", "reference": "left", "solver": "joint"},
        "left": camera("left", [0.1, -0.2, 0.3], [10.0, 20.0, 30.0], 0.0, 1.0),
        "right": camera("right", [2.9, 0.4, -0.6], [-110.0, 0.5, 300.0], -12.345678901234567, 1.0),
        "wide": camera("wide", [-1.0, 1.1, 0.2], [40.0, -15.0, 120.0], 3.25, 1.0000125),
    }
    tables["wide"] |= {"fisheye": True, "distortions": [0.05, -0.01, 0.002, -0.0003]}
    file = tmp_path / "calibration.toml"
    file.write_text(tomli_w.dumps(tables))
    return file


def export(source: Path, to: str, out: Path) -> Path:
    assert run(["export", str(source), "--to", to, "--out", str(out)]) == 0
    return out


NAMES = {
    "aniposelib": "a.toml",
    "caliscope": "camera_array.toml",
    "pose2sim": "Calib.toml",
    "freemocap": "camera_calibration.toml",
    "opencv": "yml",
    "kalibr": "camchain.yaml",
    "colmap": "model",
    "opensfm": "reconstruction.json",
}
TIMELESS = ("colmap", "opensfm")


@pytest.mark.parametrize("to", NAMES)
def test_a_calibration_comes_back_as_it_went(to: str, calibration: Path, tmp_path: Path) -> None:
    out, again = tmp_path / NAMES[to], tmp_path / "again.toml"
    export(calibration, to, out)
    assert run(["import", str(out), "--out", str(again)]) == 0
    (rig, before), (rig_again, after) = read_calibration(calibration), read_calibration(again)
    assert list(after) == list(before)
    metres = {"m": 1.0, "cm": 0.01, "mm": 0.001}
    scale = metres[rig_again.units] / metres[rig.units]
    for name, was in before.items():
        now = after[name]
        np.testing.assert_allclose(now.intrinsics.matrix, was.intrinsics.matrix, rtol=1e-15, atol=2e-13)
        np.testing.assert_array_equal(now.intrinsics.distortions, was.intrinsics.distortions)
        assert (now.intrinsics.width, now.intrinsics.height) == (1920, 1080)
        assert now.intrinsics.fisheye == was.intrinsics.fisheye
        np.testing.assert_allclose(now.pose.rotation, was.pose.rotation, atol=4e-15)
        np.testing.assert_allclose(scale * now.pose.position, was.pose.position, rtol=1e-13, atol=1e-11)
        if to not in TIMELESS:
            assert now.time_map == was.time_map


@pytest.mark.parametrize("to", NAMES)
def test_what_was_exported_is_recognised_by_its_content(to: str, calibration: Path, tmp_path: Path) -> None:
    out = export(calibration, to, tmp_path / NAMES[to])
    renamed = out.with_name("x" + out.suffix) if out.is_file() else out
    if renamed != out:
        out.rename(renamed)
    assert run(["import", str(renamed), "--out", str(tmp_path / "b.toml"), "--json"]) == 0


def test_lengths_are_in_the_units_that_a_project_means(calibration: Path, tmp_path: Path) -> None:
    for to, factor in (("caliscope", 0.01), ("pose2sim", 0.01), ("freemocap", 10.0), ("aniposelib", 1.0)):
        values = tomllib.loads(export(calibration, to, tmp_path / f"{to}.toml").read_text())
        tables = values["cameras"] if to == "caliscope" else values
        left = next(table for table in tables.values() if table.get("name") == "left")
        np.testing.assert_allclose(left["translation"], factor * np.array([10.0, 20.0, 30.0]), rtol=1e-12)


def test_caliscope_finds_the_keys_it_reads(calibration: Path, tmp_path: Path) -> None:
    """caliscope.persistence.load_camera_array: [cameras.ID], int(ID), size, matrix, distortions, Rodrigues, fisheye."""
    values = tomllib.loads(export(calibration, "caliscope", tmp_path / "a.toml").read_text())["cameras"]
    assert [int(key) for key in values] == [0, 1, 2]
    for key, table in values.items():
        assert table["cam_id"] == int(key)
        assert all(isinstance(value, int) for value in table["size"])
        assert np.shape(table["matrix"]) == (3, 3)
        assert np.shape(table["rotation"]) == np.shape(table["translation"]) == (3,)
        assert isinstance(table["fisheye"], bool)
    assert [len(table["distortions"]) for table in values.values()] == [5, 5, 4]


def test_pose2sim_and_freemocap_find_the_keys_they_read(calibration: Path, tmp_path: Path) -> None:
    """Pose2Sim.common.retrieve_calib_params takes every table but metadata; FreeMoCap has the camera in the world."""
    values = tomllib.loads(export(calibration, "pose2sim", tmp_path / "Calib.toml").read_text())
    assert set(values) == {"left", "right", "wide", "metadata"}
    for name in ("left", "right", "wide"):
        assert {"name", "size", "matrix", "distortions", "rotation", "translation", "fisheye"} <= set(values[name])
    values = tomllib.loads(export(calibration, "freemocap", tmp_path / "f.toml").read_text())
    assert set(values) == {"cam_0", "cam_1", "cam_2", "metadata"}
    table = values["cam_1"]
    turn = np.array(table["world_orientation"])
    np.testing.assert_allclose(turn, so3.exp(np.array(table["rotation"])).T, atol=1e-12)
    np.testing.assert_allclose(table["world_position"], -turn @ np.array(table["translation"]), atol=1e-9)


def project(folder: Path, points: Floats) -> dict[str, Floats]:
    """Pixels by camera, through this project's own model."""
    _, cameras = read_calibration(folder)
    return {name: camera.intrinsics.project(camera.pose.camera_from_world(points)) for name, camera in cameras.items()}


def in_front(calibration: Path, name: str) -> Floats:
    """Points (n, 3) of the world that a camera sees."""
    _, cameras = read_calibration(calibration)
    local = np.random.default_rng(0).uniform([-20, -10, 50], [20, 10, 90], (20, 3))
    return cameras[name].pose.world_from_camera(local)


def test_aniposelib_projects_as_we_do(calibration: Path, tmp_path: Path) -> None:
    python = os.environ.get(ANIPOSELIB)
    if not python:
        pytest.skip(f"NOT PROVEN HERE: set {ANIPOSELIB} to a Python that has aniposelib")
    for file in (export(calibration, "aniposelib", tmp_path / "a.toml"), calibration):
        for name in ("left", "right", "wide"):
            points = in_front(calibration, name)
            script = (
                "import sys, json, numpy as np; from aniposelib.cameras import CameraGroup;"
                "group = CameraGroup.load(sys.argv[1]);"
                "camera = next(c for c in group.cameras if c.get_name() == sys.argv[2]);"
                "print(json.dumps(np.array(camera.project(np.array(json.loads(sys.argv[3])))).reshape(-1, 2).tolist()))"
            )
            done = subprocess.run(
                [python, "-c", script, str(file), name, json.dumps(points.tolist())], capture_output=True, text=True
            )
            assert done.returncode == 0, done.stderr
            theirs = np.array(json.loads(done.stdout.splitlines()[-1]))
            np.testing.assert_allclose(theirs, project(calibration, points)[name], atol=1e-3)


def test_colmap_projects_as_we_do(calibration: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="NOT PROVEN HERE: pycolmap is not installed")
    model = pycolmap.Reconstruction(str(export(calibration, "colmap", tmp_path / "model")))
    assert len(model.images) == 3
    for image in model.images.values():
        name = image.name.removesuffix(".png")
        points = in_front(calibration, name)
        local = np.array([image.cam_from_world() * (0.01 * point) for point in points])  # metres
        theirs = np.array([image.camera.img_from_cam(point) for point in local]).reshape(-1, 2)
        np.testing.assert_allclose(theirs - 0.5, project(calibration, points)[name], atol=1e-6)


def test_colmap_writes_what_we_read(calibration: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="NOT PROVEN HERE: pycolmap is not installed")
    model = pycolmap.Reconstruction(str(export(calibration, "colmap", tmp_path / "model")))
    (tmp_path / "theirs").mkdir()
    model.write_text(str(tmp_path / "theirs"))
    assert run(["import", str(tmp_path / "theirs"), "--out", str(tmp_path / "b.toml")]) == 0
    (_, before), (_, after) = read_calibration(calibration), read_calibration(tmp_path / "b.toml")
    assert set(after) == set(before)
    for name, was in before.items():
        np.testing.assert_allclose(100.0 * after[name].pose.position, was.pose.position, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after[name].intrinsics.matrix, was.intrinsics.matrix, rtol=1e-12)


def test_opencv_reads_and_projects_as_we_do(calibration: Path, tmp_path: Path) -> None:
    folder = export(calibration, "opencv", tmp_path / "yml")
    for name in ("left", "wide"):
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FileStorage_READ)
        matrix, bent, turn, shift = (
            np.array(storage.getNode(key).mat()) for key in ("camera_matrix", "distortion_coefficients", "R", "T")
        )
        points = in_front(calibration, name)
        model: Any = cv2.fisheye if storage.getNode("distortion_model").string() == "fisheye" else cv2
        theirs, _ = model.projectPoints(points[:, None], cv2.Rodrigues(turn)[0], shift, matrix, bent)
        np.testing.assert_allclose(theirs.reshape(-1, 2), project(calibration, points)[name], atol=1e-6)


CAMCHAIN = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.04, 1e-3, -7.0e-4]
  distortion_model: radtan
  intrinsics: [461.6, 460.3, 362.7, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.010
cam1:
  T_cn_cnm1:
  - [0.0, -1.0, 0.0, -0.11]
  - [1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.02, 0.03, 0.04]
  distortion_model: equidistant
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
  timeshift_cam_imu: 0.035
"""


def test_kalibrs_timeshift_is_what_is_added_to_a_cameras_time(tmp_path: Path) -> None:
    """t_imu = t_cam + timeshift: an instant that the IMU stamps 5 s is 4.990 s on cam0 and 4.965 s on cam1."""
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    assert run(["import", str(tmp_path / "camchain.yaml"), "--out", str(tmp_path / "rig.toml")]) == 0
    rig, cameras = read_calibration(tmp_path / "rig.toml")
    assert rig.metadata["reference"] == "cam0"
    own = {"cam0": 4.990, "cam1": 4.965}
    for name, time in own.items():
        time_map = cameras[name].time_map
        assert time_map.clock_rate * time + time_map.time_offset == pytest.approx(own["cam0"], abs=1e-12)


def test_kalibrs_chain_takes_the_camera_before_into_this_one(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    assert run(["import", str(tmp_path / "camchain.yaml"), "--out", str(tmp_path / "rig.toml")]) == 0
    _, cameras = read_calibration(tmp_path / "rig.toml")
    point = np.array([[0.3, 0.2, 2.0]])  # in cam0's axes
    np.testing.assert_allclose(cameras["cam0"].pose.camera_from_world(point), point)
    np.testing.assert_allclose(cameras["cam1"].pose.camera_from_world(point), [[-0.2 - 0.11, 0.3 + 0.02, 2.03]])
    assert cameras["cam1"].intrinsics.fisheye
    np.testing.assert_array_equal(cameras["cam0"].intrinsics.distortions, [-0.2, 0.04, 1e-3, -7e-4, 0.0])


def test_kalibrs_chain_goes_by_the_cameras_numbers(tmp_path: Path) -> None:
    step = [[1.0, 0.0, 0.0, -1.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    cam = yaml.safe_load(CAMCHAIN)["cam0"]
    chain = {f"cam{i}": {**cam, "T_cn_cnm1": step, "timeshift_cam_imu": 0.1 * i} for i in range(12)}
    del chain["cam0"]["T_cn_cnm1"]
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain, sort_keys=True))  # cam10 before cam2, as Kalibr
    assert run(["import", str(tmp_path / "camchain.yaml"), "--out", str(tmp_path / "rig.toml")]) == 0
    for name, camera in read_calibration(tmp_path / "rig.toml")[1].items():
        assert camera.pose.position[0] == pytest.approx(int(name[3:]))


def test_kalibr_gets_its_keys_and_a_chain_that_agrees_with_the_poses(calibration: Path, tmp_path: Path) -> None:
    values = yaml.safe_load(export(calibration, "kalibr", tmp_path / "c.yaml").read_text())
    assert list(values) == ["cam0", "cam1", "cam2"]
    assert "T_cn_cnm1" not in values["cam0"]
    assert [table["distortion_model"] for table in values.values()] == ["radtan", "radtan", "equidistant"]
    assert [len(table["distortion_coeffs"]) for table in values.values()] == [4, 4, 4]
    assert values["cam0"]["intrinsics"] == [1400.123456789, 1402.7, 955.25, 541.5]
    assert values["cam1"]["timeshift_cam_imu"] == -12.345678901234567
    chained = np.array(values["cam1"]["T_cn_cnm1"]) @ np.array(values["cam0"]["T_cam_imu"])
    np.testing.assert_allclose(chained, values["cam1"]["T_cam_imu"], atol=1e-12)
    assert np.array(values["cam1"]["T_cam_imu"])[0, 3] == pytest.approx(-1.1)  # metres


def test_kalibrs_timeshift_is_that_of_the_recording(calibration: Path, tmp_path: Path, capsys: Capture) -> None:
    """At camera time 0, of a clock that has counted 20 days at 12.5 ppm, it was 22 s off."""
    tables = tomllib.loads(calibration.read_text())
    tables["wide"]["lag_time"] = 1.75e6
    calibration.write_text(tomli_w.dumps(tables))
    values = yaml.safe_load(export(calibration, "kalibr", tmp_path / "c.yaml").read_text())
    assert values["cam2"]["timeshift_cam_imu"] == pytest.approx(3.25 + 1.75e6 * 12.5e-6)
    assert values["cam2"]["time_offset"] == 3.25
    assert "wide's timeshift is that at its time 1750000.000 s (+12.5 ppm)" in capsys.readouterr().out


@pytest.mark.parametrize("to", ["kalibr", "ros", "aniposelib"])
def test_a_trajectory_does_not_become_a_calibration(to: str, tmp_path: Path, capsys: Capture) -> None:
    table = tmp_path / "trajectory.csv"
    table.write_text("time,x,y,z,std\n0.0,1.0,2.0,3.0,0.1\n")
    assert run(["export", str(table), "--to", to, "--out", str(tmp_path / "out")]) == 2
    assert (
        f"{table}: {to} is of calibrations, and this is a table; give the calibration.toml" in capsys.readouterr().err
    )
    assert run(["triangulate", str(tmp_path), "--calibration", str(table), "--out", str(tmp_path / "t.csv")]) == 2
    assert "this is a table, not TOML" in capsys.readouterr().err


def test_kalibr_gets_the_nearest_lens_where_it_cannot_hold_k3(
    calibration: Path, tmp_path: Path, capsys: Capture
) -> None:
    text = calibration.read_text()
    tables = tomllib.loads(text)
    tables["left"]["distortions"][4] = 0.01
    calibration.write_text(tomli_w.dumps(tables))
    export(calibration, "kalibr", tmp_path / "c.yaml")
    assert "Kalibr holds no k3: left's" in capsys.readouterr().out
    assert run(["import", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "b.toml")]) == 0
    _, before = read_calibration(calibration)
    _, after = read_calibration(tmp_path / "b.toml")
    corners = np.array([[0.0, 0.0], [1919.0, 0.0], [1919.0, 1079.0], [960.0, 540.0]])
    seen = after["left"].intrinsics.project_normalised(before["left"].intrinsics.unproject(corners))
    assert 1e-6 < np.abs(seen - corners).max() < 0.8
    tables["left"]["distortions"][4] = 2.0
    calibration.write_text(tomli_w.dumps(tables))
    assert run(["export", str(calibration), "--to", "kalibr", "--out", str(tmp_path / "d.yaml")]) == 3
    assert not (tmp_path / "d.yaml").exists()


CALISCOPE = """\
sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y
3,0,3,10.10,1,100.5,200.25,,
3,0,3,10.10,2,110.5,210.25,,
3,2,4,77.13,1,50.0,60.0,,
4,0,4,10.13,1,101.5,201.25,,
"""


def test_caliscopes_points_keep_their_times(tmp_path: Path) -> None:
    (tmp_path / "xy_CHARUCO.csv").write_text(CALISCOPE)
    assert run(["import", str(tmp_path / "xy_CHARUCO.csv"), "--out", str(tmp_path / "o.csv")]) == 0
    lines = (tmp_path / "o.csv").read_text().splitlines()
    assert lines[0] == "camera,frame,time,u,v,label"
    rows = sorted(tuple(line.split(",")) for line in lines[1:])
    assert [(r[0], r[1], r[5]) for r in rows] == [
        ("cam_0", "3", "1"),
        ("cam_0", "3", "2"),
        ("cam_0", "4", "1"),
        ("cam_2", "4", "1"),
    ]
    assert float(rows[3][2]) == 77.13
    assert [float(value) for value in rows[0][3:5]] == [100.5, 200.25]


DEEPLABCUT = """\
scorer,DLC_resnet50,DLC_resnet50,DLC_resnet50,DLC_resnet50,DLC_resnet50,DLC_resnet50
bodyparts,nose,nose,nose,tail,tail,tail
coords,x,y,likelihood,x,y,likelihood
0,10.5,20.5,0.99,30.0,40.0,0.2
1,11.5,21.5,0.98,31.0,41.0,0.95
"""


@pytest.mark.parametrize("cells", ["NaN,NaN,NaN", "10.5,20.5,nan"])
def test_points_that_are_not_a_number_are_missing(tmp_path: Path, cells: str) -> None:
    file, out = tmp_path / "left.csv", tmp_path / "o.csv"
    file.write_text(DEEPLABCUT.replace("10.5,20.5,0.99", cells))
    assert run(["import", str(file), "--fps", "50", "--out", str(out)]) == 0
    assert [line.split(",")[1] for line in out.read_text().splitlines()[1:]] == ["1", "1"]


def test_points_below_the_least_likelihood_are_refused_with_the_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "left.csv"
    file.write_text(DEEPLABCUT)
    arguments = ["import", str(file), "--fps", "50", "--likelihood", "0.995", "--out", str(tmp_path / "o.csv")]
    assert "reaches 0.995, the best is 0.99; import with a smaller --likelihood" in refusal(capsys, arguments)


def test_deeplabcuts_likely_points_become_labels_at_the_frames_times(tmp_path: Path) -> None:
    file = tmp_path / "leftDLC_resnet50_shuffle1.csv"
    file.write_text(DEEPLABCUT)
    assert run(["import", str(file), "--fps", "50", "--out", str(tmp_path / "o.csv")]) == 0
    assert (tmp_path / "o.csv").read_text().splitlines() == [
        "camera,frame,time,u,v,label",
        "left,0,0,10.5,20.5,nose",
        "left,1,0.02,11.5,21.5,nose",
        "left,1,0.02,31,41,tail",
    ]


def test_deeplabcuts_tables_with_semicolons_decimal_commas_and_negative_frames_are_read_alike(tmp_path: Path) -> None:
    written = []
    for name, text in (("a", DEEPLABCUT), ("b", DEEPLABCUT.replace(",", ";").replace(".", ","))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "left.csv").write_text(text.replace("\n0", "\n-2"))
        out = tmp_path / f"{name}.csv"
        assert run(["import", str(tmp_path / name / "left.csv"), "--fps", "50", "--out", str(out)]) == 0
        written.append(out.read_text())
    assert written[0] == written[1]
    assert written[0].splitlines()[1].startswith("left,-2,-0.04")


def test_mvus_files_hold_x_y_frame_one_a_camera(tmp_path: Path) -> None:
    folder = tmp_path / "detections"
    folder.mkdir()
    (folder / "a.txt").write_text("10.5 20.5 3\n0 0 4\n11.5 21.5 5\n")
    (folder / "b.txt").write_text("1 2 7 0.5\n")
    assert run(["import", str(folder), "--fps", "25", "--out", str(tmp_path / "o.csv")]) == 0
    lines = (tmp_path / "o.csv").read_text().splitlines()
    assert lines[1:] == ["a,3,0.12,10.5,20.5", "a,5,0.20000000000000001,11.5,21.5", "b,7,0.28000000000000003,1,2"]


def test_frames_get_the_videos_own_times(tmp_path: Path) -> None:
    from tests.support.videos import numbered_image, write_video

    (tmp_path / "videos").mkdir()
    times = np.array([0.0, 0.04, 0.13, 0.15])
    write_video(tmp_path / "videos" / "a.mp4", [numbered_image(i) for i in range(4)], times)
    (tmp_path / "a.txt").write_text("1 2 0\n3 4 2\n")
    arguments = ["import", str(tmp_path / "a.txt"), "--videos", str(tmp_path / "videos"), "--out"]
    assert run([*arguments, str(tmp_path / "o.csv")]) == 0
    rows = [line.split(",") for line in (tmp_path / "o.csv").read_text().splitlines()[1:]]
    np.testing.assert_allclose([float(row[2]) for row in rows], [0.0, 0.13], atol=2e-5)
    (tmp_path / "a.txt").write_text("1 2 9\n")
    assert run([*arguments, str(tmp_path / "p.csv")]) == 2
    assert not (tmp_path / "p.csv").exists()


def test_a_session_becomes_a_log_and_a_session_again(tmp_path: Path) -> None:
    assert run(["simulate", "marker", "--seconds", "2", "--cameras", "2", "--out", str(tmp_path / "s")]) == 0
    text = (
        (tmp_path / "s" / "rig.toml").read_text().replace("fps = 30.0", "fps = 30.0\nreadout = -0.012\nfocal_std = 0.1")
    )
    (tmp_path / "s" / "rig.toml").write_text(text + "\n[metadata.more]\nx = 1\n" if "[metadata]" not in text else text)
    log, again = tmp_path / "s.mcap", tmp_path / "again"
    assert run(["import", str(tmp_path / "s"), "--out", str(log)]) == 0
    assert run(["export", str(log), "--out", str(again)]) == 0
    (rig, seen), (rig_again, seen_again) = read_folder(tmp_path / "s"), read_folder(again)
    assert list(rig_again.cameras) == list(rig.cameras)
    for name, was in rig.cameras.items():
        now = rig_again.cameras[name]
        assert (now.size, now.fps, now.readout, now.focal_std) == (was.size, was.fps, -0.012, 0.1)
        assert was.intrinsics is not None and now.intrinsics is not None  # noqa: PT018
        np.testing.assert_array_equal(now.intrinsics.matrix, was.intrinsics.matrix)
        np.testing.assert_array_equal(now.intrinsics.distortions, was.intrinsics.distortions)
    assert set(seen_again.tracks) == set(seen.tracks)
    for key, track in seen.tracks.items():
        np.testing.assert_array_equal(seen_again.tracks[key].pixels, track.pixels)
        np.testing.assert_array_equal(seen_again.tracks[key].frame, track.frame)
        np.testing.assert_allclose(seen_again.tracks[key].time, track.time, rtol=0, atol=1e-9 + 1e-15 * track.time[0])
    assert run(["import", str(tmp_path / "s"), "--out", str(log)]) == 2  # a log is not replaced
    assert run(["export", str(log), "--out", str(again)]) == 2


def test_the_corners_of_a_board_pass_through_a_log(tmp_path: Path, capsys: Capture) -> None:
    session, log = tmp_path / "session", tmp_path / "log.mcap"
    session.mkdir()
    bodies = {"board": {str(k): [0.1 * (k % 3), 0.1 * (k // 3), 0.0] for k in range(6)}}
    cameras = {name: {"name": name, "size": [640, 480], "fps": 10.0} for name in ("CVLab1", "GoPro 2")}
    rig = {"metadata": {"units": "m", "target": "board", "bodies": bodies}, **cameras}
    (session / "rig.toml").write_text(tomli_w.dumps(rig))
    lines = [f"{c},{i},{i / 10},{9 * k + i},{7 * k},{k},corner" for c in cameras for i in range(4) for k in range(6)]
    (session / "observations.csv").write_text("\n".join(["camera,frame,time,u,v,label,kind", *lines]) + "\n")
    assert run(["import", str(session), "--out", str(log)]) == 0
    assert "a log does not store the board" in capsys.readouterr().out
    read = load_session(log)
    assert len(read.observations) == len(lines)
    assert read.rig.metadata["target"] == "board"
    assert read.observations.cameras == list(cameras)


def test_a_log_by_a_calibration_has_the_frames_as_they_happened(tmp_path: Path, capsys: Capture) -> None:
    """left's clock is the reference; right's shows 100 s more and wide's runs twice as fast."""
    rows = {"left": [1.0, 2.0, 3.0], "right": [102.5, 103.5], "wide": [1.0, 9.0]}
    tables = {
        "metadata": {"reference": "left"},
        "left": camera("left", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0, 1.0),
        "right": camera("right", [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], -100.0, 1.0),
        "wide": camera("wide", [0.0, 0.0, 0.0], [2.0, 0.0, 0.0], 0.0, 0.5),
    }
    session = tmp_path / "s"
    session.mkdir()
    (session / "rig.toml").write_text(tomli_w.dumps(tables))
    lines = [f"{name},{k},{time},5,5" for name, times in rows.items() for k, time in enumerate(times)]
    (session / "observations.csv").write_text("\n".join(["camera,frame,time,u,v", *lines]) + "\n")
    (tmp_path / "c.toml").write_text(tomli_w.dumps(tables))

    def arrivals(out: str, *options: str) -> list[tuple[str, float]]:
        command = ["import", str(session), "--calibration", str(tmp_path / "c.toml"), "--out", str(tmp_path / out)]
        assert run([*command, *options]) == 0
        messages = LogReader(tmp_path / out).messages(["observation"])
        return [(message.agent, message.log_time_ns * 1e-9) for message in messages]

    expected = [("wide", 0.0), ("left", 0.5), ("left", 1.5), ("right", 2.0), ("left", 2.5), ("right", 3.0)]
    assert arrivals("a.mcap") == [(name, pytest.approx(at)) for name, at in [*expected, ("wide", 4.0)]]
    introduced = {m.agent: m.log_time_ns * 1e-9 for m in LogReader(tmp_path / "a.mcap").messages(["camera_info"])}
    assert introduced == pytest.approx({"left": 0.5, "right": 2.0, "wide": 0.0})
    delayed = arrivals("b.mcap", "--arrival-delay-ms", "50", "--arrival-jitter-ms", "20", "--seed", "3")
    late = np.array([at for _, at in sorted(delayed)]) - [at for _, at in sorted([*expected, ("wide", 4.0)])]
    assert (late >= 0.05 - 1e-9).all() and 0.05 < late.mean() < 0.12  # noqa: PT018
    again = arrivals("c.mcap", "--arrival-delay-ms", "50", "--arrival-jitter-ms", "20", "--seed", "3")
    assert again == delayed
    assert arrivals("d.mcap", "--arrival-jitter-ms", "20", "--seed", "4") != arrivals("e.mcap")

    capsys.readouterr()
    del tables["wide"]
    (tmp_path / "c.toml").write_text(tomli_w.dumps(tables))
    command = ["import", str(session), "--out", str(tmp_path / "f.mcap")]
    assert run([*command, "--calibration", str(tmp_path / "c.toml")]) == 2
    assert "c.toml: no clock of wide" in capsys.readouterr().err
    assert run([*command, "--arrival-delay-ms", "50"]) == 2
    assert "give --calibration" in capsys.readouterr().err
    assert not (tmp_path / "f.mcap").exists()


BAD = [
    ("a.yaml", "cam0:\n  intrinsics: [1, 2, 3]\n  resolution: [4, 4]\n", "a.yaml:2: cam0 intrinsics has 3 numbers"),
    ("a.yaml", CAMCHAIN.replace("radtan", "fov"), "a.yaml:5: cam0 has distortion_model 'fov'"),
    ("a.yaml", CAMCHAIN.replace("[0.0, -1.0,", "[0.0, -2.0,"), "a.yaml:11: cam1 T_cn_cnm1 is no rotation"),
    ("a.yaml", "cam0: [1\n  b: :", "not YAML"),
    ("a.yaml", "cam0: {intrinsics: [.nan, 1, 1, 1], resolution: [4, 4]}", "not finite"),
    ("a.yml", "%YAML:1.0\n---\ncamera_matrix: [1, 2]\n", "a.yml:3: camera_matrix has 2 numbers"),
    ("a.yml", "camera_matrix: [[9, 0, 1], [0, 9, 1], [0, 0, 1]]\n", "no image size"),
    (
        "unknown_model.yml",
        "distortion_model: thin\nimage_width: 4\nimage_height: 4\ncamera_matrix: [[9, 0, 1], [0, 9, 1], [0, 0, 1]]\n",
        "unknown_model.yml:1: distortion_model 'thin' is not known here",
    ),
    ("one_name.yaml", CAMCHAIN.replace("cam_overlaps", "name: a\n  cam_overlaps"), "a second camera 'a'"),
    ("malformed.json", '[{"cameras": {}, "shots": {"a.png": {"camera": "a"}}}]', "not a list of reconstructions"),
    ("malformed.json", '[{"cameras": [], "shots": {}}]', "not a list of reconstructions"),
    ("malformed.json", '[{"cameras": {}, "shots": {}}, 1]', "not a list of reconstructions"),
    (
        "one_name.json",
        '[{"cameras": {"c": {"width": 4, "height": 4, "focal": 1}}, "shots": {'
        '"a/x.png": {"camera": "c", "rotation": [0, 0, 0], "translation": [0, 0, 0]},'
        '"b/x.png": {"camera": "c", "rotation": [0, 0, 0], "translation": [1, 0, 0]}}}]',
        "a second shot 'x'",
    ),
    ("a.toml", "[cam_0]\nname = 'a'\nmatrix = [[1, 0, 1], [0, 1, 1], [0, 0, 1]]\n", "size is missing"),
    ("a.toml", "[cameras.0]\nsize = [4, 4]\nmatrix = [[1, 0], [0, 1]]\n", "a.toml:3"),
    ("a.toml", "x = 1\n", "unknown format"),
    ("a.csv", CALISCOPE.replace("50.0", "fifty"), "a.csv:4: img_loc_x 'fifty' is not a number"),
    ("a.csv", DEEPLABCUT.replace("21.5", "x1"), "a.csv:5: y 'x1' is not a number"),
    ("a.csv", DEEPLABCUT, "have no times"),
    ("a.csv", DEEPLABCUT + "2,1\n", "a.csv:6: 2 columns of 7"),
    ("a.txt", "1 2 3\n1 2\n", "a.txt:2: 2 numbers"),
    ("a.txt", "1 2 3\n4 5 3\n", "two rows of camera a"),
    ("a.csv", "", "unknown format"),
]


@pytest.mark.parametrize(("name", "text", "message"), BAD)
def test_a_bad_file_is_one_line_and_nothing_is_written(
    tmp_path: Path, capsys: Capture, name: str, text: str, message: str
) -> None:
    file = tmp_path / name
    file.write_text(text)
    out = tmp_path / ("o.csv" if name.endswith((".csv", ".txt")) else "o.toml")
    rate = ["--fps", "25"] if name.endswith(".txt") or "x1" in text or "2,1\n" in text else []
    assert run(["import", str(file), "--out", str(out), *rate]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert ";" in line
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


def test_a_broken_colmap_model_is_told_by_line(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "cameras.txt").write_text("# c\n1 THIN_PRISM_FISHEYE 4 4 1 1 1 1\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    assert run(["import", str(tmp_path), "--out", str(tmp_path / "o.toml")]) == 2
    assert "cameras.txt:2: the model THIN_PRISM_FISHEYE" in capsys.readouterr().err
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 4 4 1 1 1 1\n")
    (tmp_path / "images.txt").write_text("1 0 0 0 0 0 0 0 1 a.png\n\n")
    assert run(["import", str(tmp_path), "--out", str(tmp_path / "o.toml")]) == 2
    assert "images.txt:1: the quaternion" in capsys.readouterr().err
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 7 a.png\n\n")
    assert run(["import", str(tmp_path), "--out", str(tmp_path / "o.toml")]) == 2
    assert "camera 7 is not in cameras.txt" in capsys.readouterr().err


NAMED = ("CVLab1", "GoPro 2", "Front-left", "Kamera.Süd")


@pytest.fixture(scope="module")
def named_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated session; its cameras' names have upper case, a space, a hyphen, a full stop and an umlaut."""
    session = tmp_path_factory.mktemp("named") / "session"
    assert run(["simulate", "marker", "--cameras", "4", "--seconds", "15", "--out", str(session)]) == 0
    return rename_cameras(session)


def rename_cameras(session: Path) -> Path:
    """Give the cameras of a simulated session the names of ``NAMED``."""
    for file in (session / "rig.toml", session / "truth_calibration.toml", session / "observations.csv"):
        text = file.read_text(encoding="utf-8")
        for number, name in enumerate(NAMED):
            text = text.replace(f"[cam{number}]", f'["{name}"]').replace(f'"cam{number}"', f'"{name}"')
            text = text.replace(f"\ncam{number},", f"\n{name},")
        file.write_text(text, encoding="utf-8")
    return session


def test_cameras_keep_their_names_through_calibrate_log_and_every_export(named_session: Path, tmp_path: Path) -> None:
    solved, log, solved_log = tmp_path / "solved", tmp_path / "session.mcap", tmp_path / "solved_log"
    assert run(["calibrate", str(named_session), "--out", str(solved)]) == 0
    assert run(["import", str(named_session), "--out", str(log)]) == 0
    assert run(["calibrate", str(log), "--out", str(solved_log)]) == 0
    for folder in (solved, solved_log):
        assert set(read_calibration(folder / "calibration.toml")[1]) == set(NAMED)
    for to, name in NAMES.items():
        out, again = tmp_path / to / name, tmp_path / to / "again.toml"
        export(solved / "calibration.toml", to, out)
        assert run(["import", str(out), "--out", str(again), "--units", "m"]) == 0
        assert set(read_calibration(again)[1]) == set(NAMED)
    assert {file.name for file in (tmp_path / "opencv" / "yml").iterdir()} == {f"{name}.yml" for name in NAMED}
    assert "GoPro%202.png" in (tmp_path / "colmap" / "model" / "images.txt").read_text()
    back = tmp_path / "back"
    assert run(["export", str(log), "--to", "session", "--out", str(back)]) == 0
    assert set(read_folder(back)[1].cameras) == set(NAMED)


@pytest.fixture(scope="module")
def named_results(named_session: Path) -> Path:
    """The folder of the session, its result, its log, a tiny video a camera, and a session of people."""
    folder = named_session.parent
    assert run(["calibrate", str(named_session), "--out", str(folder / "solved")]) == 0
    log = ["import", str(named_session), "--calibration", str(folder / "solved" / "calibration.toml")]
    assert run([*log, "--out", str(folder / "log.mcap")]) == 0
    people = ["simulate", "people", "--cameras", str(len(NAMED)), "--people", "1", "--seconds", "4"]
    assert run([*people, "--out", str(folder / "people")]) == 0
    rename_cameras(folder / "people")
    (folder / "videos").mkdir()
    for k, name in enumerate(NAMED):
        write_video(folder / "videos" / f"{name}.mp4", [numbered_image(n + k) for n in range(8)], np.arange(8) / 30.0)
    # The simulated clocks are decades apart, these videos all begin at 0.
    solved = (folder / "solved" / "calibration.toml").read_text(encoding="utf-8")
    aligned = re.sub(r"time_offset = \S+", "time_offset = 0.0", solved)
    (folder / "aligned.toml").write_text(aligned, encoding="utf-8")
    pairs = [{"cameras": [NAMED[0], name], "lag_s": 0.05} for name in NAMED[1:]]
    (folder / "lags.json").write_text(json.dumps({"pairs": pairs}), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("command", "named_in"),
    [
        ("triangulate session --calibration solved/calibration.toml --out OUT.csv", None),
        ("triangulate log.mcap --calibration solved/calibration.toml --out OUT.csv", None),
        ("sync videos --calibration aligned.toml --out OUT", "OUT/synchronised.csv"),
        ("sync videos --calibration lags.json --videos none --out OUT", "OUT/synchronised.csv"),
        ("follow people --calibration people/truth_calibration.toml --out OUT", "OUT/result.json"),
        ("replay log.mcap --through hub --calibration solved/calibration.toml --out OUT.mcap", None),
        ("replay log.mcap --compare log.mcap", None),
        ("info log.mcap", "printed"),
        ("recover log.mcap --out OUT.mcap", None),
        ("export solved/calibration.toml --to caliscope --session session --out OUT", "printed"),
        ("intrinsics videos/Front-left.mp4 --field-of-view 70 --out OUT.toml", None),
        ("report solved --out OUT.html", "OUT.html"),
    ],
)
def test_every_other_command_takes_cameras_as_users_name_them(
    named_results: Path, tmp_path: Path, capsys: Capture, command: str, named_in: str | None
) -> None:
    def place(word: str) -> str:
        if word.startswith("OUT"):
            return str(tmp_path / word)
        return str(named_results / word) if (named_results / word).exists() else word

    assert run([place(word) for word in command.split()]) == 0
    printed = capsys.readouterr().out
    if named_in is not None:
        text = printed if named_in == "printed" else (tmp_path / named_in).read_text(encoding="utf-8")
        assert [name for name in NAMED if name not in text] == []


@pytest.mark.parametrize("name", NAMED)
def test_agents_are_configured_and_installed_by_the_names_of_users(name: str, tmp_path: Path, capsys: Capture) -> None:
    file = tmp_path / "agent.toml"
    file.write_text(f'id = "{name}"\nsite = "yard"\n', encoding="utf-8")
    assert run(["camera", str(file), "--print-config"]) == 0
    assert f'id = "{name}"' in capsys.readouterr().out
    hub = f'id = "hub of {name}"\nnodes = ["{name}"]\n'
    file.write_text(hub, encoding="utf-8")
    assert run(["hub", str(file), "--print-config"]) == 0
    assert f'nodes = ["{name}"]' in capsys.readouterr().out.replace("\n", "").replace("    ", "").replace(",]", "]")
    file.write_text(f'id = "{name}"\nsite = "yard"\n', encoding="utf-8")
    program = ["--program", "/opt/syncline/bin/syncline"]
    assert run(["install", "camera", "--config", str(file), "--root", str(tmp_path), "--dry-run", *program]) == 0
    service = f"camera-{key_segment(name).replace('%', '.')}"
    assert f"/etc/systemd/system/syncline-{service}.service" in capsys.readouterr().out


@pytest.mark.parametrize("bad", ["../up", "a/b", "cam?", ".hidden", "x" * 64])
def test_a_bad_camera_name_is_refused_everywhere_with_its_place(
    bad: str, calibration: Path, tmp_path: Path, capsys: Capture
) -> None:
    calibration.write_text(calibration.read_text().replace("[left]", f'["{bad}"]').replace('"left"', f'"{bad}"'))
    message = refusal(capsys, ["export", str(calibration), "--to", "opencv", "--out", str(tmp_path / "out")])
    assert f"{calibration}:" in message
    assert "is not usable" in message
    assert "use at most 63 letters" in message
    assert not (tmp_path / "out").exists()
