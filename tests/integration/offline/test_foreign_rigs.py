"""Calibrations of motion capture systems, OpenSfM and ROS; caliscope's tables of today; unknown tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.session.calibration import read_calibration
from protocols.session.observations import read_observations
from protocols.session.rig import read_rig
from tests.support.command_line import refusal
from tests.support.foreign_calibration import calibration_file

Capture = pytest.CaptureFixture[str]
ROTATION, CENTRE = so3.exp(np.array([0.3, -0.8, 1.1])), np.array([1200.0, -300.0, 950.0])


def test_a_qualisys_calibration_looks_along_minus_z_in_64ths_of_pixels(tmp_path: Path) -> None:
    cells = " ".join(f'r{i + 1}{j + 1}="{float(ROTATION[i, j])!r}"' for i in range(3) for j in range(3))
    file = tmp_path / "calibration.qca.txt"
    file.write_text(
        f"""<calibration><cameras><camera serial="17" model="Miqus Video">
        <fov_video left="0" top="0" right="1919" bottom="1079"/>
        <transform x="{CENTRE[0]}" y="{CENTRE[1]}" z="{CENTRE[2]}" {cells}/>
        <intrinsic focalLengthU="96000" focalLengthV="96064" centerPointU="61440" centerPointV="34560"
         radialDistortion1="-6.4" radialDistortion2="1.28" tangentalDistortion1="0" tangentalDistortion2="0"/>
        </camera></cameras></calibration>"""
    )
    out = tmp_path / "rig.toml"
    assert run(["import", str(file), "--out", str(out)]) == 0
    rig, cameras = read_calibration(out)
    camera = cameras["17"]
    assert rig.units == "mm"
    assert camera.intrinsics.matrix == pytest.approx(np.array([[1500, 0, 960], [0, 1501, 540], [0, 0, 1]]))
    assert camera.intrinsics.distortions[:2] == pytest.approx([-0.1, 0.02])
    assert camera.pose.rotation == pytest.approx(np.diag([1, -1, -1]) @ ROTATION)
    assert camera.pose.position == pytest.approx(CENTRE)


def test_a_vicon_calibration_has_quaternions_with_the_scalar_last(tmp_path: Path) -> None:
    turn = so3.log(ROTATION)
    angle = float(np.linalg.norm(turn))
    x, y, z = np.sin(angle / 2) * turn / angle
    file = tmp_path / "rig.xcp"
    file.write_text(
        f"""<Cameras><Camera DEVICEID="2107" TYPE="VideoInputDevice" SENSOR_SIZE="1280 720" PIXEL_ASPECT_RATIO="1">
        <KeyFrames><KeyFrame FOCAL_LENGTH="1100" PRINCIPAL_POINT="640 360"
        POSITION="{CENTRE[0]} {CENTRE[1]} {CENTRE[2]}"
        ORIENTATION="{x} {y} {z} {np.cos(angle / 2)}" VICON_RADIAL2="ViconRadial2 640 360 -0.1 0.02 0"/></KeyFrames>
        </Camera></Cameras>"""
    )
    out = tmp_path / "rig.toml"
    assert run(["import", str(file), "--out", str(out)]) == 0
    camera = read_calibration(out)[1]["2107"]
    assert camera.pose.rotation == pytest.approx(ROTATION)
    assert camera.pose.position == pytest.approx(CENTRE)
    assert camera.intrinsics.distortions[:2] == pytest.approx([-0.1, 0.02])


def test_an_optitrack_calibration_has_world_from_camera_rotations_in_utf16(tmp_path: Path) -> None:
    # A level camera in Motive's frame (y up) that sees the origin at its image's centre.
    centre = np.array([2.0, 2.5, -3.0])
    backward = centre / np.linalg.norm(centre)
    right = np.array([-3.0, 0.0, -2.0]) / np.hypot(3.0, 2.0)
    axes = np.column_stack([right, np.cross(backward, right), backward])
    turn = " ".join(f'OrientMatrix{i}="{value}"' for i, value in enumerate(axes.ravel().tolist()))
    lens = 'LensCenterX="960" LensCenterY="538" HorizontalFocalLength="1248" VerticalFocalLength="1247"'
    file = tmp_path / "calibration.mcal"
    file.write_text(
        f"""<?xml version="1.0" encoding="UTF-16"?><calibrationProfile version="1"><Calibration><Cameras Count="1">
        <Camera Serial="C11764"><Attributes ImagerPixelWidth="1920" ImagerPixelHeight="1080"/>
        <Intrinsic {lens} k1="9" k2="9" k3="9" TangentialX="9" TangentialY="9"/>
        <IntrinsicStandardCameraModel {lens} k1="-0.1" k2="0.02" k3="0.003" TangentialX="1e-4" TangentialY="2e-4"/>
        <Extrinsic X="2" Y="2.5" Z="-3" {turn}/></Camera></Cameras></Calibration></calibrationProfile>""",
        encoding="utf-16",
    )
    out = tmp_path / "rig.toml"
    assert run(["import", str(file), "--out", str(out)]) == 0
    rig, cameras = read_calibration(out)
    camera = cameras["C11764"]
    assert rig.units == "m"
    assert camera.intrinsics.distortions == pytest.approx([-0.1, 0.02, 1e-4, 2e-4, 0.003])
    seen = camera.pose.camera_from_world(np.array([[0.0, 0.0, 0.0], 0.1 * right, [0.0, 0.1, 0.0]]))
    assert camera.intrinsics.project(seen[:1])[0] == pytest.approx([960, 538])
    across, down = (camera.intrinsics.project(seen)[1:] - [960, 538]).tolist()
    assert across == pytest.approx([0.1 * 1248 / np.linalg.norm(centre), 0.0], abs=0.1)
    assert down[1] < -20, "what is higher is higher in the image"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("text", ["<a><b></a>", '<!DOCTYPE x [<!ENTITY y "z">]><Cameras/>', "<Cameras/>"])
def test_other_xml_is_bad_input_in_one_line(tmp_path: Path, capsys: Capture, text: str, encoding: str) -> None:
    file = tmp_path / "rig.xcp"
    file.write_text(text, encoding=encoding)
    printed = refusal(capsys, ["import", str(file), "--out", str(tmp_path / "rig.toml")])
    assert ("document type" in printed) == ("DOCTYPE" in text)


@pytest.mark.parametrize(("to", "target", "posed"), [("opensfm", "reconstruction.json", True), ("ros", "ros", False)])
def test_an_export_comes_back_as_it_was(tmp_path: Path, to: str, target: str, posed: bool) -> None:
    lens = Intrinsics(
        1280, 720, np.array([[900.0, 0, 630], [0, 905.0, 350], [0, 0, 1]]), np.array([-0.2, 0.1, 1e-3, 0, 0.02])
    )
    source = calibration_file(tmp_path / "calibration.toml", {"GoPro 2": (lens, Pose(ROTATION, CENTRE / 1000))})
    assert run(["export", str(source), "--to", to, "--out", str(tmp_path / target)]) == 0
    out = tmp_path / "again.toml"
    assert run(["import", str(tmp_path / target), "--out", str(out)]) == 0
    camera = read_rig(out).cameras["GoPro 2"]
    assert camera.intrinsics is not None
    assert camera.intrinsics.matrix == pytest.approx(lens.matrix)
    assert camera.intrinsics.distortions == pytest.approx(lens.distortions)
    if posed:
        assert camera.position == pytest.approx(CENTRE / 1000)


@pytest.mark.parametrize(
    ("to", "target", "held"),
    [("qualisys", "rig.qca.txt", 4), ("vicon", "rig.xcp", 2), ("optitrack", "calibration.mcal", 5)],
)
def test_an_xml_calibration_comes_back_as_it_was(tmp_path: Path, to: str, target: str, held: int) -> None:
    values = np.array([-0.2, 0.1, 1e-3, -5e-4, 0.02])
    matrix = np.array([[900.0, 0, 630], [0, 905.0, 350], [0, 0, 1]])
    lens = Intrinsics(1280, 720, matrix, np.where(np.arange(5) < held, values, 0.0))
    pose = Pose(ROTATION, CENTRE / 1000)
    source = calibration_file(tmp_path / "calibration.toml", {"GoPro 2": (lens, pose)})
    assert run(["export", str(source), "--to", to, "--out", str(tmp_path / target)]) == 0
    # Pose2Sim's readers of both need a residual. (Its 0.10.49 reads lens and pose of these files to rounding.)
    needed = {"qualisys": "avg-residual=", "vicon": "WORLD_ERROR="}.get(to, "")
    assert needed in (tmp_path / target).read_text()
    out = tmp_path / "again.toml"
    assert run(["import", str(tmp_path / target), "--out", str(out)]) == 0
    rig, cameras = read_calibration(out)
    camera = cameras["GoPro 2"]
    assert camera.intrinsics.matrix == pytest.approx(lens.matrix)
    assert camera.intrinsics.distortions == pytest.approx(lens.distortions)
    assert camera.pose.rotation == pytest.approx(pose.rotation)
    assert camera.pose.position * (0.001 if rig.units == "mm" else 1.0) == pytest.approx(pose.position)


def test_vicon_refuses_a_lens_that_it_cannot_hold(tmp_path: Path, capsys: Capture) -> None:
    matrix = np.array([[900.0, 0, 630], [0, 905.0, 350], [0, 0, 1]])
    lens = Intrinsics(1280, 720, matrix, np.array([-0.2, 0.1, 0.01, 0.0, 0.0]))
    source = calibration_file(tmp_path / "calibration.toml", {"a": (lens, Pose(ROTATION, CENTRE / 1000))})
    assert run(["export", str(source), "--to", "vicon", "--out", str(tmp_path / "rig.xcp")]) == 3
    assert "tangential" in capsys.readouterr().err
    assert not (tmp_path / "rig.xcp").exists()


def test_caliscopes_table_of_today_is_read(tmp_path: Path) -> None:
    file = tmp_path / "xy.csv"
    file.write_text(
        "sync_index,cam_id,frame_index,frame_time,object_id,keypoint_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y,obj_loc_z\n"
        "0,1,5,0.25,0,7,100.5,50.25,0.1,0.2,0\n1,1,6,0.3,0,7,101.5,50.25,0.1,0.2,0\n"
        "1,1,6,0.3,0,8,121.5,50.25,0.2,0.2,0\n"
    )
    out = tmp_path / "observations.csv"
    assert run(["import", str(file), "--out", str(out)]) == 0
    track = read_observations(out, ["cam_1"]).tracks["cam_1", "7"]
    assert track.frame.tolist() == [5, 6]
    assert track.time.tolist() == [0.25, 0.3]


ROS = """image_width: 640
image_height: 480
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 4, data: [0.1, 0, 0, 0]}
projection_matrix: {rows: 3, cols: 4, data: [500, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]}
"""
FRAME = '{"people": [{"pose_keypoints_2d": [1, 2, 0.9]}]}'
JSON = (
    '{"image_id": 0, "instances": [{"bbox": 1, "keypoints": [[1, 2]]}]}',
    '{"images": [{"id": 0}], "frames": [{"image_id": 0, "keypoints": [1, 2, 1]}]}',
    '[{"frame": 0, "points": [{"x": 0.1, "y": 0.2, "z": 0, "visibility": 1}]}]',
    '[{"cameras": {"a": {"projection_type": "perspective"}}, "views": {"b": {"rotation": [0], "translation": [0]}}}]',
)
LENS = "size = [640, 480]\nmatrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\n"
DAMAGED = {
    "caliscope's xy.csv of 2025, but column keypoint_id is missing": {
        "xy.csv": "sync_index,cam_id,frame_index,frame_time,object_id,img_loc_x,img_loc_y\n0,1,5,0.2,0,1,2\n"
    },
    "DeepLabCut's CSV, but row coords is missing": {"cam0DLC_x.csv": "scorer,a,a,a\nbodyparts,x,x,x\n0,1,2,0.9\n"},
    "a COLMAP model, but images.txt is missing": {"cameras.txt": "1 PINHOLE 4 4 1 1 1 1\n"},
    "a COLMAP model, but cameras.txt is missing": {"cameras.bin": "", "images.bin": ""},
    "a frame of OpenPose, but key people is missing": {"cam1_000.json": FRAME, "cam1_001.json": "[]"},
    "caliscope's older xy.csv, but column point_id is missing": {
        "xy.csv": "sync_index,port,frame_index,frame_time,img_loc_x,img_loc_y\n0,1,5,0.2,1,2\n"
    },
    "caliscope's xy.csv of 2025, but column sync_index, img_loc_y is missing": {
        "xy.csv": "cam_id,frame_index,frame_time,object_id,keypoint_id,img_loc_x\n1,5,0.2,0,1,2\n"
    },
    "Syncline's observations.csv, but column time is missing": {"observations.csv": "camera,frame,u,v\ncam0,1,2,3\n"},
    "MMPose's JSON, but key keypoint_scores is missing": {"cam1.json": JSON[0]},
    "COCO keypoints, but key annotations is missing": {"cam1.json": JSON[1]},
    "MediaPipe's export, but key landmarks is missing": {"cam1.json": JSON[2]},
    "OpenSfM's reconstruction.json, but key shots is missing": {"reconstruction.json": JSON[3]},
    "aniposelib's calibration, but key matrix is missing": {
        "calibration.toml": '[cam_0]\nname = "a"\nsize = [4, 3]\ndistortions = [0]\nrotation = [0]\ntranslation = [0]\n'
    },
    "caliscope's camera_array.toml, but key cameras is missing": {
        "camera_array.toml": "cam_id = 1\ndistortions = []\n" + LENS
    },
    "Kalibr's camchain, but key intrinsics is missing": {
        "chain.yaml": "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [0]\n"
        "  resolution: [4, 3]\n"
    },
    "OpenCV's calibration, but key camera_matrix is missing": {
        "left.yml": "%YAML:1.0\nimage_width: 4\nimage_height: 3\ndistortion_coefficients: [0, 0, 0, 0]\n"
    },
    "ROS' camera_info, but key distortion_model is missing": {"left.yaml": ROS},
    "ROS' camera_info, but key camera_matrix is missing": {
        "left.yaml": ROS.replace("camera_matrix", "other") + "distortion_model: plumb_bob\n"
    },
}


@pytest.mark.parametrize("line", DAMAGED)
def test_a_damaged_layout_is_named_with_what_is_missing(line: str, tmp_path: Path, capsys: Capture) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for name, text in DAMAGED[line].items():
        (source / name).write_text(text)
    is_table = any(name.endswith((".csv", ".json")) for name in DAMAGED[line])
    out = tmp_path / ("o.csv" if is_table else "o.toml")
    assert f"looks like {line}" in refusal(capsys, ["import", str(source), "--fps", "30", "--out", str(out)])
    assert not out.exists()


def test_deeplabcuts_table_without_its_first_row_is_read(tmp_path: Path) -> None:
    file, out = tmp_path / "cam0DLC_x.csv", tmp_path / "o.csv"
    file.write_text("bodyparts,nose,nose,nose\ncoords,x,y,likelihood\n0,1,2,0.9\n1,2,3,0.9\n")
    assert run(["import", str(file), "--fps", "30", "--out", str(out)]) == 0
    assert read_observations(out, ["cam0"]).tracks["cam0", "marker"].frame.tolist() == [0, 1]
