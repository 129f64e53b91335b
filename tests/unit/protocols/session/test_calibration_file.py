"""calibration.toml: what is written is read again, to the last digit, here and in aniposelib."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from protocols.core.clocks import TimeMap
from protocols.core.errors import InputError
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.session.calibration import (
    Calibration,
    CameraCalibration,
    TrajectoryTable,
    read_calibration,
)
from protocols.session.rig import Rig, read_rig
from tests.support.command_line import assert_reported
from tests.support.written import write_calibration, write_trajectory

RIG = """
[cam0]
name = "cam0"
size = [1280, 720]
fps = 30
matrix = [[900.0, 0, 640.0], [0, 901.0, 360.0], [0, 0, 1]]
distortions = [0.1, 0.01, 0.001, 0.002, 0.0]
position = [0.0, 0.0, 1.0]
position_std = 0.05
serial = "A7"
[eye]
name = "eye"
size = [640, 480]
fisheye = true
matrix = [[400.0, 0, 320.0], [0, 401.0, 240.0], [0, 0, 1]]
distortions = [0.1, 0.01, 0.001, 0.002]
[lost]
size = [640, 480]
[metadata]
units = "cm"
site = "hall"
"""


def answer(rig: Rig) -> Calibration:
    rng = np.random.default_rng(5)
    cameras = {}
    for name in ("cam0", "eye"):
        lens = rig.cameras[name].intrinsics
        assert lens is not None
        cameras[name] = CameraCalibration(
            name,
            lens,
            Pose(so3.exp(rng.normal(size=3)), rng.normal(size=3) / 3),
            TimeMap(1.0 + 1e-5 / 3, -1.7e9 - 1 / 3) if name == "eye" else TimeMap(),
            1e-4 / 3,
            np.array([0.1, 0.2, 0.3]) / 3,
            0.7,
        )
    return Calibration(cameras, "cam0", "metric", "cm", "joint", "0.1.0", refused={"lost": 'no "lens": told\nso'})


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    (tmp_path / "rig.toml").write_text(RIG)
    return read_rig(tmp_path / "rig.toml")


@pytest.fixture
def written(tmp_path: Path, rig: Rig) -> Path:
    file = tmp_path / "out" / "calibration.toml"
    write_calibration(file, answer(rig), rig)
    return file


def test_what_is_written_is_read_again_to_the_last_digit(written: Path, rig: Rig) -> None:
    again, cameras = read_calibration(written)
    truth = answer(rig)
    assert list(cameras) == ["cam0", "eye"]
    assert again.units == "cm"
    for name, camera in cameras.items():
        other = truth.cameras[name]
        assert camera.time_map == other.time_map
        assert camera.time_offset_std == other.time_offset_std
        assert camera.rms_px == other.rms_px
        np.testing.assert_array_equal(camera.position_std, other.position_std)
        np.testing.assert_array_equal(camera.intrinsics.matrix, other.intrinsics.matrix)
        np.testing.assert_array_equal(camera.intrinsics.distortions, other.intrinsics.distortions)
        assert camera.intrinsics.fisheye == other.intrinsics.fisheye
        np.testing.assert_allclose(camera.pose.rotation, other.pose.rotation, atol=1e-14)
        np.testing.assert_allclose(camera.pose.position, other.pose.position, atol=1e-14)


def test_a_calibration_written_twice_is_the_same_file(written: Path, tmp_path: Path, rig: Rig) -> None:
    write_calibration(tmp_path / "again.toml", answer(rig), rig)
    assert (tmp_path / "again.toml").read_bytes() == written.read_bytes()


def test_tables_keep_what_the_rig_said_and_refused_cameras_have_none(written: Path) -> None:
    tables = tomllib.loads(written.read_text())
    assert set(tables) == {"cam0", "eye", "metadata"}
    assert tables["cam0"]["serial"] == "A7"
    assert tables["cam0"]["fps"] == 30
    meta = tables["metadata"]
    assert meta["site"] == "hall"
    assert (meta["reference"], meta["scale"], meta["units"], meta["solver"], meta["version"]) == (
        "cam0",
        "metric",
        "cm",
        "joint",
        "0.1.0",
    )
    assert meta["refused"]["lost"].startswith('no "lens"')


def test_it_is_a_rig_too(written: Path) -> None:
    """calibrate --from-known and the report read it as a rig; nothing in it may contradict itself."""
    rig = read_rig(written)
    assert rig.cameras["cam0"].position is not None


def aniposelib_loads(file: Path) -> dict[str, dict[str, Any]]:
    """What aniposelib's CameraGroup.load does: all tables but metadata, by these keys."""
    tables = tomllib.loads(file.read_text())
    cameras = {}
    for key in sorted(tables):
        if key == "metadata":
            continue
        table = tables[key]
        lens = {
            "name": table["name"],
            "size": table["size"],
            "matrix": np.array(table["matrix"], dtype="float64"),
            "distortions": np.array(table["distortions"], dtype="float64").ravel(),
            "rotation": np.array(table["rotation"], dtype="float64").ravel(),
            "translation": np.array(table["translation"], dtype="float64").ravel(),
            "fisheye": bool(table.get("fisheye")),
        }
        cameras[key] = lens
    return cameras


def test_aniposelib_projects_as_we_do(written: Path, rig: Rig) -> None:
    truth = answer(rig)
    for name, table in aniposelib_loads(written).items():
        assert table["name"] == name
        camera = truth.cameras[name]
        point = camera.pose.world_from_camera(np.array([[0.3, -0.2, 2.0], [-0.1, 0.1, 3.0]]))
        project = cv2.fisheye.projectPoints if table["fisheye"] else cv2.projectPoints
        seen = project(point[:, None], table["rotation"], table["translation"], table["matrix"], table["distortions"])[
            0
        ]
        ours = camera.intrinsics.project(camera.pose.camera_from_world(point))
        np.testing.assert_allclose(ours, seen.reshape(-1, 2), atol=1e-6)


def test_aniposelibs_own_file_has_clock_zero(tmp_path: Path) -> None:
    file = tmp_path / "calibration.toml"
    file.write_text(
        '[cam_0]\nname = "A"\nsize = [640, 480]\nmatrix = [[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]\n'
        "distortions = [0.0, 0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.0, 0.0]\ntranslation = [0.0, 0.0, 1.0]\n"
        "[metadata]\nadjusted = false\nerror = 0.5\n"
    )
    _, cameras = read_calibration(file)
    (camera,) = cameras.values()
    assert camera.time_map == TimeMap(1.0, 0.0)
    np.testing.assert_array_equal(camera.pose.position, [0, 0, -1])


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("clock_rate", "0.0", "clock_rate"),
        ("clock_rate", "-1.0", "clock_rate"),
        ("clock_rate", "nan", "clock_rate"),
        ("clock_rate", '"1"', "clock_rate"),
        ("time_offset", "inf", "time_offset"),
        ("time_offset", "[1.0]", "time_offset"),
        ("time_offset_std", '"good"', "time_offset_std"),
        ("rms_px", '"low"', "rms_px"),
        ("position_std", "[0.1, 0.1]", "position_std"),
        ("rotation", "[0.0, 0.0]", "rotation"),
        ("rotation", None, "rotation"),
        ("translation", None, "translation"),
        ("matrix", None, "matrix"),
    ],
)
def test_a_broken_calibration_is_told(tmp_path: Path, key: str, value: str | None, word: str) -> None:
    values = {
        "size": "[640, 480]",
        "matrix": "[[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]",
        "rotation": "[0.0, 0.0, 0.0]",
        "translation": "[0.0, 0.0, 1.0]",
    }
    if value is None:
        del values[key]
    else:
        values[key] = value
    file = tmp_path / "calibration.toml"
    file.write_text("[cam0]\n" + "".join(f"{k} = {v}\n" for k, v in values.items()))
    assert_reported(lambda: read_calibration(file), file, None, word)


def test_a_missing_calibration_is_called_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_calibration(tmp_path / "calibration.toml")


def _table(label: str) -> TrajectoryTable:
    t = 1.7e9 + np.array([1 / 3, 2 / 3])
    return TrajectoryTable(label, t, np.array([[1, 2, 3], [4, 5, 6]]) / 7, np.array([0.1, 0.2]) / 7)


def test_the_trajectory_has_seventeen_digits(tmp_path: Path, rig: Rig) -> None:
    file = tmp_path / "trajectory.csv"
    write_trajectory(file, replace(answer(rig), trajectories=(_table("marker"),)))
    lines = file.read_text().splitlines()
    assert lines[0] == "time,x,y,z,std"
    t, x, _, _, std = map(float, lines[1].split(","))
    assert (t, x, std) == (1.7e9 + 1 / 3, 1 / 7, 0.1 / 7)


def test_labels_are_told_apart_in_the_trajectory(tmp_path: Path, rig: Rig) -> None:
    file = tmp_path / "trajectory.csv"
    write_trajectory(file, replace(answer(rig), trajectories=(_table("red"), _table("blue"))))
    lines = file.read_text().splitlines()
    assert lines[0] == "time,x,y,z,std,label"
    assert [line.rsplit(",", 1)[1] for line in lines[1:]] == ["red", "red", "blue", "blue"]


def test_a_label_with_a_comma_stays_one_column(tmp_path: Path, rig: Rig) -> None:
    """observations.csv may quote such a label."""
    import csv

    file = tmp_path / "trajectory.csv"
    write_trajectory(file, replace(answer(rig), trajectories=(_table("red, left"), _table("blue"))))
    with file.open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert rows[0]["label"] == "red, left"


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_calibration(tmp_path / "file" / "calibration.toml", answer(rig), rig)


def test_no_half_written_file_is_left_behind(tmp_path: Path, rig: Rig) -> None:
    write_calibration(tmp_path / "calibration.toml", answer(rig), rig)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["calibration.toml", "rig.toml"]


def test_a_float_of_an_intrinsics_field_is_toml(tmp_path: Path, rig: Rig) -> None:
    odd = answer(rig)
    lens = Intrinsics(640, 480, np.array([[400, 0, 320], [0, 400, 240], [0, 0, 1]]), np.array([-0.0, 0, 0, 0]))
    odd.cameras["eye"] = replace(odd.cameras["eye"], intrinsics=replace(lens, fisheye=True))
    write_calibration(tmp_path / "calibration.toml", odd, rig)
    assert tomllib.loads((tmp_path / "calibration.toml").read_text())["eye"]["fisheye"] is True


def test_a_missing_calibration_is_not_called_a_rig_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="calibration") as caught:
        read_calibration(tmp_path / "known.toml")
    assert "rig file" not in str(caught.value)
