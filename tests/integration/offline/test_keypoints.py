"""Keypoints of other trackers: each format is read, a person calibrates cameras in metres, C3D and TRC mark gaps."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from protocols.core.errors import InputError
from protocols.formats import keypoints
from protocols.geometry.types import Floats
from protocols.session.calibration import read_calibration
from protocols.session.observations import read_observations
from tests.support.board_session import BoardWorld, board_world
from tests.support.rigs import write_session

Capture = pytest.CaptureFixture[str]
JOINTS = [
    "nose",
    "left_eye",
    "right_eye",
    "left_ear",
    "right_ear",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
]
FRAMES = 6


def places() -> Floats:
    """(frames, 17, 3) u, v, score; joint 3 of frame 2 is not seen."""
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(10, 600, (FRAMES, 17, 2)), rng.uniform(0.7, 1.0, (FRAMES, 17, 1))], axis=2)
    points[2, 3] = 0.0
    return points


def openpose(folder: Path) -> Path:
    target = folder / "pose" / "cam1_json"
    target.mkdir(parents=True)
    for frame, points in enumerate(places()):
        person = {"person_id": [-1], "pose_keypoints_2d": points.ravel().tolist()}
        (target / f"cam1_{frame:012d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": [person]}))
    return folder


def mmpose(folder: Path) -> Path:
    frames = [
        {"frame_id": k + 1, "instances": [{"keypoints": p[:, :2].tolist(), "keypoint_scores": p[:, 2].tolist()}]}
        for k, p in enumerate(places())
    ]
    return written(folder / "cam1.json", frames)


def coco(folder: Path) -> Path:
    images = [{"id": 100 + k, "file_name": f"{k:05d}.png"} for k in range(FRAMES)]
    found = [
        {"image_id": 100 + k, "category_id": 1, "keypoints": np.c_[p[:, :2], 2.0 * (p[:, 2] > 0)].ravel().tolist()}
        for k, p in enumerate(places())
    ]
    document = {"images": images, "annotations": found, "categories": [{"id": 1, "keypoints": JOINTS}]}
    return written(folder / "cam1.json", document)


def sleap(folder: Path) -> Path:
    import h5py

    points = places()
    points[2, 3] = np.nan
    file = folder / "cam1.analysis.h5"
    with h5py.File(file, "w") as data:
        data["tracks"] = points[None, :, :, :2].transpose(0, 3, 2, 1)
        data["node_names"] = [name.encode() for name in JOINTS]
        data["point_scores"] = points[None, :, :, 2].transpose(0, 2, 1)
    return file


def freemocap(folder: Path) -> Path:
    points = places()[None]
    points[0, 2, 3] = np.nan
    file = folder / "mediapipe2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy"
    np.save(file, points)
    return file


def written(file: Path, document: object) -> Path:
    file.write_text(json.dumps(document))
    return file


@pytest.mark.parametrize(
    ("make", "kind"),
    [(openpose, "openpose"), (mmpose, "mmpose"), (coco, "coco"), (sleap, "sleap"), (freemocap, "freemocap-points")],
)
def test_every_format_is_recognised_and_gives_the_same_points(
    tmp_path: Path, capsys: Capture, make: Callable[[Path], Path], kind: str
) -> None:
    source = make(tmp_path)
    out = tmp_path / "session" / "observations.csv"
    out.parent.mkdir()
    arguments = ["import", str(source), "--fps", "20", "--size", "640x480", "--out", str(out), "--json"]
    assert run(arguments) == 0
    assert json.loads(capsys.readouterr().out)["format"] == kind
    camera = "cam_0" if make is freemocap else "cam1"
    seen = read_observations(out, [camera])
    assert len(seen) == 17 * FRAMES - 1
    truth = places()
    label = "point5" if make is freemocap else "left_shoulder"
    track = seen.tracks[camera, label]
    assert track.time == pytest.approx(np.arange(FRAMES) / 20)
    assert track.pixels == pytest.approx(truth[:, 5, :2])
    assert 2 not in seen.tracks[camera, "point3" if make is freemocap else "left_ear"].frame
    assert "size = [\n    640,\n    480,\n]" in (out.parent / "rig.toml").read_text()


def test_sleap_ios_axes_in_another_order_are_read_by_their_names(tmp_path: Path) -> None:
    import h5py

    file = sleap(tmp_path)
    (before,) = keypoints.read("sleap", [file], None)
    with h5py.File(file, "a") as data:
        for name, axes, order in (
            ("tracks", ["frame", "track", "node", "xy"], (3, 0, 2, 1)),
            ("point_scores", ["frame", "track", "node"], (2, 0, 1)),
        ):
            values = np.asarray(data[name]).transpose(order)
            del data[name]
            data[name] = values
            data[name].attrs["dims"] = json.dumps(axes)
    (after,) = keypoints.read("sleap", [file], None)
    assert sorted(after.rows) == sorted(before.rows)


def test_the_videos_of_a_sleap_project_are_cameras(tmp_path: Path) -> None:
    import h5py

    file = tmp_path / "project.slp"
    frames = [("frame_id", "u8"), ("video", "u4"), ("frame_idx", "u8")]
    frames += [("instance_id_start", "u8"), ("instance_id_end", "u8")]
    instances = [("instance_type", "u1"), ("track", "i4"), ("point_id_start", "u8"), ("point_id_end", "u8")]
    skeleton = {"nodes": [{"name": "tail"}], "skeletons": [{"nodes": [{"id": 0}]}]}
    with h5py.File(file, "w") as data:
        data.create_group("metadata").attrs["json"] = json.dumps(skeleton)
        data["videos_json"] = [
            json.dumps(one) for one in ({"filename": "left.mp4"}, {"backend": {"filename": "D:\\a\\right.mp4"}})
        ]
        data["frames"] = np.array([(0, 0, 7, 0, 1), (1, 1, 7, 1, 2)], dtype=frames)
        data["instances"] = np.array([(0, -1, 0, 1), (0, -1, 1, 2)], dtype=instances)
        data["points"] = np.array([(10, 20, True), (30, 40, True)], dtype=[("x", "f8"), ("y", "f8"), ("visible", "?")])
    found = {
        one.camera: [(row.frame, row.u, row.v) for row in one.rows] for one in keypoints.read("sleap", [file], None)
    }
    assert found == {"left": [(7, 10.0, 20.0)], "right": [(7, 30.0, 40.0)]}


def coco_of(folder: Path, files: list[str], joints: list[str]) -> Path:
    """A file whose annotation of image k is at (10 k + 1 + joint, 5)."""
    images = [{"id": 100 + k, "file_name": name} for k, name in enumerate(files)]
    found = [
        {
            "image_id": 100 + k,
            "category_id": 3,
            "keypoints": [v for j in range(len(joints)) for v in (10 * k + 1 + j, 5, 2)],
        }
        for k in range(len(files))
    ]
    categories = [{"id": 1, "name": "ball"}, {"id": 3, "keypoints": joints}]
    return written(folder / "cam1.json", {"images": images, "annotations": found, "categories": categories})


@pytest.mark.parametrize(
    ("files", "frames"),
    [
        ([f"frame_{k}.jpg" for k in range(12)], range(12)),  # 10 comes after 2
        ([f"frame_{k}.jpg" for k in range(1, 13)], range(12)),
        ([f"{5 * k}.jpg" for k in range(12)], range(0, 60, 5)),
        ([f"shot {chr(97 + k)}.jpg" for k in range(12)], range(12)),
    ],
)
def test_coco_images_are_frames_by_the_numbers_in_their_names(tmp_path: Path, files: list[str], frames: range) -> None:
    joints = [f"own{k}" for k in range(25)]  # as many as OpenPose's
    (found,) = keypoints.read("coco", [coco_of(tmp_path, files, joints)], None)
    assert [row.frame for row in found.rows if row.joint == "own0"] == list(frames)
    assert [row.u for row in found.rows if row.joint == "own0"] == [10.0 * k + 1 for k in range(12)]
    assert [row.joint for row in found.rows[:25]] == joints


def test_coco_images_of_several_cameras_are_not_mixed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"several folders \(cam1, cam2\)"):
        keypoints.read("coco", [coco_of(tmp_path, ["cam1/1.png", "cam2/1.png"], ["nose"])], None)


def test_results_of_mmposes_demo_are_named_after_the_video_and_may_lack_points(tmp_path: Path) -> None:
    person = {"keypoints": [[float("nan")] * 2, [3.0, 4.0]], "keypoint_scores": [0.9, 0.9]}
    about = {"keypoint_id2name": {"0": "nose", "1": "tail"}}
    document = {"meta_info": about, "instance_info": [{"frame_id": 1, "instances": [person]}]}
    (found,) = keypoints.read("mmpose", [written(tmp_path / "results_cam1.json", document)], None)
    assert found.camera == "cam1"
    assert [(row.joint, row.u) for row in found.rows] == [("tail", 3.0)]


def test_sleaps_csv_is_known_by_name(tmp_path: Path, capsys: Capture) -> None:
    file = tmp_path / "cam1.analysis.csv"
    file.write_text("track,frame_idx,instance.score,nose.x,nose.y,nose.score\n,0,0.9,1,2,0.9\n")
    assert run(["import", str(file), "--fps", "25", "--out", str(tmp_path / "observations.csv")]) == 2
    assert "looks like SLEAP's CSV, of which the .h5 or .slp file is read" in capsys.readouterr().err


def test_deeplabcuts_labelled_images_are_read(tmp_path: Path) -> None:
    file = tmp_path / "cam1.csv"
    file.write_text(
        "scorer,,,me,me\nbodyparts,,,nose,nose\ncoords,,,x,y\nlabeled-data,cam1,img0003.png,1,2\n"
        "labeled-data,cam1,img0012.png,,\nlabeled-data,cam1,img0014.png,3,4\n"
    )
    out = tmp_path / "observations.csv"
    assert run(["import", str(file), "--fps", "25", "--size", "640x480", "--out", str(out)]) == 0
    (track,) = read_observations(out, ["cam1"]).tracks.values()
    assert track.frame.tolist() == [3, 14]


def test_deeplabcuts_hdf5_is_read_as_pandas_wrote_it(tmp_path: Path) -> None:
    import h5py

    columns = [("DLC", joint, axis) for joint in ("nose", "tail") for axis in ("x", "y", "likelihood")]
    values = np.random.default_rng(0).uniform(1, 100, (4, 6))
    values[:, [2, 5]] = 0.9
    file = tmp_path / "cam1DLC_resnet50.h5"
    with h5py.File(file, "w") as data:
        group = data.create_group("df_with_missing")
        for level in range(3):
            names = list(dict.fromkeys(column[level] for column in columns))
            group[f"axis0_level{level}"] = [name.encode() for name in names]
            group[f"axis0_label{level}"] = [names.index(column[level]) for column in columns]
        group["axis1"] = np.arange(4)
        group["block0_values"] = values
    assert keypoints.detect_format(file) == "deeplabcut-h5"
    (found,) = keypoints.read("deeplabcut-h5", [file], None)
    assert found.camera == "cam1"
    assert [row.joint for row in found.rows[::4]] == ["nose", "tail"]
    assert found.rows[5].u == pytest.approx(values[1, 3])


def test_mediapipes_shares_of_the_image_become_pixels(tmp_path: Path) -> None:
    frames = [{"frame": k, "landmarks": [{"x": 0.5, "y": 0.25, "visibility": 0.9}] * 33} for k in range(3)]
    file = written(tmp_path / "cam1.json", frames)
    out = tmp_path / "observations.csv"
    assert run(["import", str(file), "--fps", "30", "--out", str(out)]) == 2  # without a size
    assert run(["import", str(file), "--fps", "30", "--size", "640x480", "--out", str(out)]) == 0
    assert read_observations(out, ["cam1"]).tracks["cam1", "nose"].pixels[0] == pytest.approx([319.5, 119.5])


def test_of_keypoints_that_are_all_unlikely_the_best_is_given(tmp_path: Path, capsys: Capture) -> None:
    frames = [{"frame": k, "landmarks": [{"x": 0.5, "y": 0.25, "visibility": 0.1 * k}] * 33} for k in range(4)]
    file = written(tmp_path / "cam1.json", frames)
    arguments = ["import", str(file), "--fps", "30", "--size", "640x480", "--out", str(tmp_path / "o.csv")]
    assert run(arguments) == 2
    assert "no keypoint's likelihood reaches 0.6, the best is 0.3" in capsys.readouterr().err


def test_unknown_json_and_pickles_in_foreign_files_are_bad_input(tmp_path: Path, capsys: Capture) -> None:
    import pickle

    file = written(tmp_path / "cam1.json", {"what": 1})
    assert run(["import", str(file), "--out", str(tmp_path / "observations.csv")]) == 2
    assert "unknown format" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"posix\.system|builtins|os"):
        keypoints._plain_pickle(pickle.dumps(print))


def skeleton_world() -> tuple[BoardWorld, dict[str, Floats]]:
    """A world whose moving body is a person of 1.75 m, by joints."""
    world = board_world(21, (25.0, 30.0, 25.0))
    height = 1.75
    joints = {
        "left_hip": [-0.1, 0.0, 0.0],
        "right_hip": [0.1, 0.0, 0.0],
        "left_knee": [-0.1, 0.245 * height, 0.0],
        "right_knee": [0.1, 0.245 * height, 0.0],
        "left_ankle": [-0.1, (0.245 + 0.246) * height, 0.02],
        "right_ankle": [0.1, (0.245 + 0.246) * height, -0.02],
        "nose": [0.0, -0.3 * height, 0.1],
    }
    return world, {name: 0.4 * np.array(place) for name, place in joints.items()}


def test_a_person_calibrates_the_cameras_in_metres_by_the_given_height(tmp_path: Path, capsys: Capture) -> None:
    world, joints = skeleton_world()
    world = replace(world, points=joints)
    seen = world.observations(12.0, noise=1.0)
    session = write_session(tmp_path / "session", world.rig(), seen)
    out = tmp_path / "out"
    assert run(["calibrate", str(session), "--limb", "left_hip-tail=1", "--out", str(out)]) == 2
    assert "labels are left_ankle" in capsys.readouterr().err
    assert run(["calibrate", str(session), "--height", "0.7", "--out", str(out)]) == 0  # 0.4 of 1.75 m
    capsys.readouterr()
    rig, cameras = read_calibration(out / "calibration.toml")
    assert rig.metadata["scale"] == "metric"
    length = float(np.linalg.norm(cameras["cam0"].pose.position - cameras["cam1"].pose.position))
    true = float(np.linalg.norm(world.cameras["cam0"].pose.position - world.cameras["cam1"].pose.position))
    assert length == pytest.approx(true, rel=0.02)
    for suffix in ("trc", "c3d"):
        target = tmp_path / f"track.{suffix}"
        calibration = str(out / "calibration.toml")
        assert run(["triangulate", str(session), "--calibration", calibration, "--out", str(target)]) == 0
    import ezc3d

    file = ezc3d.c3d(str(tmp_path / "track.c3d"))
    assert set(file["parameters"]["POINT"]["LABELS"]["value"]) == set(joints)
    assert file["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    missing = np.isnan(file["data"]["points"][0])
    assert (file["data"]["meta_points"]["residuals"][0] < 0).tolist() == missing.tolist()


def test_a_keypoint_counts_by_its_score(tmp_path: Path) -> None:
    out = tmp_path / "observations.csv"
    source = mmpose(tmp_path)
    frames = json.loads(source.read_text())
    for frame in frames:
        frame["instances"][0]["keypoint_scores"] = [0.9, 0.6] + [0.9] * (len(JOINTS) - 2)
    source.write_text(json.dumps(frames))
    assert run(["import", str(source), "--fps", "25", "--size", "1280x720", "--out", str(out)]) == 0
    seen = read_observations(out, ["cam1"])
    sure, unsure = seen.tracks["cam1", "nose"].std, seen.tracks["cam1", "left_eye"].std
    assert sure is not None
    assert unsure is not None
    assert unsure == pytest.approx(1.5 * sure)
