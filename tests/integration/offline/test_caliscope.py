"""caliscope and Pose2Sim: capture volumes there and back, and what their own readers make of our files."""

from __future__ import annotations

import csv
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.cli import run
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration, read_calibration
from protocols.session.observations import read_observations
from tests.support.foreign_calibration import calibration_file

Capture = pytest.CaptureFixture[str]
TABLES = ("camera_array.toml", "image_points.csv", "world_points.csv")
LENS = Intrinsics(
    1280, 720, np.array([[900.0, 0, 630], [0, 905.0, 350], [0, 0, 1]]), np.array([-0.2, 0.1, 1e-3, -5e-4, 0.0])
)
FISHEYE = Intrinsics(1280, 720, LENS.matrix, np.array([0.05, -0.01, 0.002, -0.0003]), True)
POSES = [
    Pose(so3.exp(np.array([0.3, -0.8, 1.1])), np.array([1.2, -0.3, 0.95])),
    Pose(so3.exp(np.array([2.9, 0.4, -0.6])), np.array([-3.0, 0.5, 2.0])),
]


def python_with(package: str) -> str:
    """A Python that has another tool, which brings its own OpenCV and cannot live in this environment; else skips."""
    variable = f"SYNCLINE_{package.upper()}_PYTHON"
    found = os.environ.get(variable)
    if not found:
        pytest.skip(f"NOT PROVEN HERE: set {variable} to a Python that has {package}")
    return found


def answer(python: str, script: str, *arguments: object) -> Any:
    """The JSON that a script prints in another Python."""
    done = subprocess.run([python, "-c", script, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as text:
        return list(csv.DictReader(text))


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture volume of a simulated session, beside it; clocks are unlike, and no two cameras fire together."""
    folder = tmp_path_factory.mktemp("caliscope")
    session = folder / "session"
    assert run(["simulate", "marker", "--cameras", "3", "--seconds", "8", "--seed", "3", "--out", str(session)]) == 0
    given = ["--session", str(session), "--out", str(folder / "volume")]
    assert run(["export", str(session / "truth_calibration.toml"), "--to", "caliscope", *given]) == 0
    return folder / "volume"


def residuals(volume: Path, cameras: dict[str, CameraCalibration]) -> Floats:
    """Pixels (n, 2) of the image points against the world points of the same sync_index."""
    at = {row["sync_index"]: [float(row[f"{axis}_coord"]) for axis in "xyz"] for row in rows(volume / TABLES[2])}
    names, out = list(cameras), []
    for row in rows(volume / TABLES[1]):
        camera = cameras[names[int(row["cam_id"])]]
        if row["sync_index"] in at:
            place = camera.pose.camera_from_world(np.array([at[row["sync_index"]]]))
            out.append(camera.intrinsics.project(place)[0] - [float(row["img_loc_x"]), float(row["img_loc_y"])])
    return np.array(out)


def test_the_points_of_one_sync_index_are_of_one_instant(volume: Path) -> None:
    assert sorted(file.name for file in volume.iterdir()) == sorted(TABLES)
    _, cameras = read_calibration(volume.parent / "session" / "truth_calibration.toml")
    off = residuals(volume, cameras)
    assert len(off) > 400
    # Detectors are 0.5 px off; the frame nearest to each instant would be several pixels off.
    assert np.sqrt((off**2).mean()) < 0.6
    assert {row["keypoint_id"] for row in rows(volume / TABLES[1])} == {"0"}


def test_a_capture_volume_comes_back(volume: Path, tmp_path: Path) -> None:
    assert run(["import", str(volume), "--out", str(tmp_path / "rig.toml")]) == 0
    assert len(read_calibration(tmp_path / "rig.toml")[1]) == 3
    out = tmp_path / "observations.csv"
    assert run(["import", str(volume), "--format", "caliscope-points", "--out", str(out)]) == 0
    seen = read_observations(out, ["cam_0", "cam_1", "cam_2"])
    assert len(seen) == len(rows(volume / TABLES[1]))


def test_points_without_times_need_the_videos_or_a_rate(volume: Path, tmp_path: Path, capsys: Capture) -> None:
    """caliscope writes an empty frame_time where it knows none."""
    lines = [line.split(",") for line in (volume / TABLES[1]).read_text().splitlines()]
    timeless = [lines[0], *([*line[:3], "", *line[4:]] for line in lines[1:])]
    file, out = tmp_path / "xy_POSE.csv", tmp_path / "o.csv"
    file.write_text("\n".join(",".join(line) for line in timeless) + "\n")
    assert run(["import", str(file), "--out", str(out)]) == 2
    assert "give --videos FOLDER (best) or --fps RATE" in capsys.readouterr().err
    assert run(["import", str(file), "--fps", "30", "--out", str(out)]) == 0


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["cam_7", "cam_2"], [7, 2]),
        (["cam3", "cam0"], [3, 0]),
        (["GoPro 2", "cam_0"], [0, 1]),
        (["cam1", "cam_1"], [0, 1]),
    ],
)
def test_cameras_keep_caliscopes_numbers(names: list[str], numbers: list[int], tmp_path: Path, capsys: Capture) -> None:
    """Its videos are named cam_7.mp4: a calibration that numbers anew would belong to other videos."""
    source = calibration_file(
        tmp_path / "c.toml", {name: (LENS, pose) for name, pose in zip(names, POSES, strict=True)}
    )
    out, back = tmp_path / "camera_array.toml", tmp_path / "back.toml"
    assert run(["export", str(source), "--to", "caliscope", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert [f"[cameras.{number}]" in out.read_text() for number in numbers] == [True, True]
    assert ("caliscope numbers its cameras" in printed) == (numbers == [0, 1])
    assert run(["import", str(out), "--out", str(back)]) == 0
    assert list(read_calibration(back)[1]) == names


def test_session_goes_with_caliscope_only(volume: Path, tmp_path: Path, capsys: Capture) -> None:
    source = str(volume.parent / "session" / "truth_calibration.toml")
    given = ["--session", str(volume.parent / "session"), "--out", str(tmp_path / "x")]
    assert run(["export", source, "--to", "kalibr", *given]) == 2
    assert "--session goes with --to caliscope" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_older_arrays_say_null_for_what_is_not_known(tmp_path: Path) -> None:
    source = calibration_file(tmp_path / "c.toml", {"cam_4": (LENS, POSES[0])})
    out = tmp_path / "camera_array.toml"
    assert run(["export", str(source), "--to", "caliscope", "--out", str(out)]) == 0
    unknown = '[cameras.9]\ncam_id = 9\nsize = [4, 3]\nmatrix = "null"\ndistortions = "null"\nrotation = "null"\n'
    out.write_text(out.read_text() + "\n" + unknown)
    assert run(["import", str(out), "--out", str(tmp_path / "back.toml")]) == 0
    assert list(read_calibration(tmp_path / "back.toml")[1]) == ["cam_4"]


def in_front(pose: Pose) -> Floats:
    """World points (n, 3) that a camera sees."""
    return pose.world_from_camera(np.random.default_rng(0).uniform([-1, -0.5, 2], [1, 0.5, 4], (20, 3)))


def test_caliscope_reads_the_volume_and_reprojects_it(volume: Path, tmp_path: Path) -> None:
    script = (
        "import sys, json; from caliscope.core.capture_volume import CaptureVolume as V;"
        "v = V.load(sys.argv[1]); r = v.reprojection_report; v.save(sys.argv[2]);"
        "print(json.dumps([r.overall_rmse, r.n_observations_matched, r.n_observations_total, r.n_cameras]))"
    )
    rmse, matched, total, cameras = answer(python_with("caliscope"), script, volume, tmp_path / "again")
    assert total == len(rows(volume / TABLES[1]))
    assert matched > 0.9 * total
    assert cameras == 3
    assert rmse < 0.6 * np.sqrt(2)
    for kind, out in (("caliscope", "again.toml"), ("caliscope-points", "again.csv")):
        assert run(["import", str(tmp_path / "again"), "--format", kind, "--out", str(tmp_path / out)]) == 0
    assert len(read_observations(tmp_path / "again.csv", ["cam_0", "cam_1", "cam_2"])) == total
    before = read_calibration(volume.parent / "session" / "truth_calibration.toml")[1]
    after = read_calibration(tmp_path / "again.toml")[1]
    for one, other in zip(before.values(), after.values(), strict=True):
        assert one.pose.position == pytest.approx(other.pose.position, abs=1e-9)
        assert one.intrinsics.matrix == pytest.approx(other.intrinsics.matrix)


def test_caliscope_projects_as_we_do(tmp_path: Path) -> None:
    python = python_with("caliscope")
    source = calibration_file(tmp_path / "c.toml", {"cam_1": (LENS, POSES[0]), "cam_5": (FISHEYE, POSES[1])})
    assert run(["export", str(source), "--to", "caliscope", "--out", str(tmp_path / "a.toml")]) == 0
    script = (
        "import sys, json, cv2, numpy as np; from caliscope.cameras.camera_array import CameraArray;"
        "c = CameraArray.from_toml(sys.argv[1]).cameras[int(sys.argv[2])]; x = np.array(json.loads(sys.argv[3]));"
        "n = c.undistort_points(x, output='normalized'); y = (c.rotation @ np.array(json.loads(sys.argv[4])).T).T"
        " + c.translation.ravel(); print(json.dumps([n.tolist(), (y[:, :2] / y[:, 2:]).tolist()]))"
    )
    for (number, lens), pose in zip(((1, LENS), (5, FISHEYE)), POSES, strict=True):
        points = in_front(pose)
        pixels = lens.project(pose.camera_from_world(points))
        theirs, flat = answer(python, script, tmp_path / "a.toml", number, pixels.tolist(), points.tolist())
        assert np.array(theirs) == pytest.approx(np.array(flat), abs=1e-4)


def test_pose2sim_reads_its_calibration_and_those_of_motion_capture(tmp_path: Path) -> None:
    python = python_with("pose2sim")
    source = calibration_file(tmp_path / "c.toml", {"GoPro 2": (LENS, POSES[0]), "CVLab1": (LENS, POSES[1])})
    plain = Intrinsics(1280, 720, LENS.matrix, np.array([-0.2, 0.1, 0.0, 0.0, 0.0]))
    radial = calibration_file(tmp_path / "r.toml", {"GoPro 2": (plain, POSES[0]), "CVLab1": (plain, POSES[1])})
    for given, to, name in (
        (source, "pose2sim", "c2.toml"),
        (source, "qualisys", "q.qca.txt"),
        (radial, "vicon", "v.xcp"),
    ):
        assert run(["export", str(given), "--to", to, "--out", str(tmp_path / name)]) == 0
    script = (
        "import sys, json, numpy as np; from pathlib import Path; d = sys.argv[1];"
        "from Pose2Sim import calibration as c, common as m;"
        "p = m.retrieve_calib_params(Path(d, 'c2.toml')); q = c.calib_qca_fun(d + '/q.qca.txt');"
        "v = c.calib_vicon_fun(d + '/v.xcp');"
        "l = lambda *a: [np.array(x, dtype=float).tolist() for x in a];"
        "print(json.dumps([l(p['S'], p['dist'], p['K'], p['R'], p['T']), l(q[2], q[3], q[4], q[5], q[6]), q[1],"
        " l(v[2], v[3], v[4], v[5], v[6]), v[1]]))"
    )
    toml, qualisys, q_names, vicon, v_names = answer(python, script, tmp_path)
    assert sorted(q_names) == sorted(v_names) == ["CVLab1", "GoPro 2"]
    for read, names, lens in ((toml, ["GoPro 2", "CVLab1"], LENS), (qualisys, q_names, LENS), (vicon, v_names, plain)):
        for k, name in enumerate(names):
            pose = POSES[["GoPro 2", "CVLab1"].index(name)]
            assert read[0][k] == pytest.approx([1280, 720])
            assert read[1][k][:4] == pytest.approx(lens.distortions[:4], abs=1e-9)
            assert np.array(read[2][k]) == pytest.approx(lens.matrix)
            assert read[3][k] == pytest.approx(pose.rodrigues, abs=1e-6)
            assert read[4][k] == pytest.approx(pose.translation, abs=1e-6)
