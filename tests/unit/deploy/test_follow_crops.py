"""Pictures of heads, faces and torsos: each shows the region it is named after, in the right frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.cli import run
from deploy.offline.follow.calibration import read_given_calibration
from deploy.offline.follow.crops import check_pictures, write_crops
from deploy.offline.follow.source import FollowInput, read_follow_input
from edge.devices.playback.video_reader import VideoReader
from hub.tracking.offline import FollowResult
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from tests.support.crowds import HEIGHT, SIZE, ends, places, write_calibration
from tests.support.videos import write_video

UP = np.array([0.0, 0.0, 1.0])
CAMERA, FPS, FRAMES = "left", 5.0, 6
HEAD, TORSO, LEGS = (40, 40, 230), (60, 200, 60), (220, 90, 30)  # BGR


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    id: int
    times: Floats
    position: Floats
    height: Floats
    detections: list[tuple[str, int, int]]


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> FollowInput:
    """A video of one camera, in which each person is a red head, a green torso and blue legs."""
    folder = tmp_path_factory.mktemp("filmed")
    video = folder / f"{CAMERA}.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    observations = []
    for frame in range(FRAMES):
        image = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
        message = pb.Observation(camera=CAMERA, sequence=frame, device_time_ns=round(frame * NANOSECONDS / FPS))
        for head, foot in zip(*ends(CAMERA, frame / FPS), strict=True):
            for begin, end, colour in ((0.0, 0.17, HEAD), (0.17, 0.54, TORSO), (0.54, 1.0, LEGS)):
                half = 0.2 * np.linalg.norm(foot - head)
                low, high = head + begin * (foot - head), head + end * (foot - head)
                corners = np.rint([low[0] - half, low[1], high[0] + half, high[1]]).astype(int).tolist()
                cv2.rectangle(image, corners[:2], corners[2:], colour, -1)
            message.detections.add(kind="person", head=head.tolist(), foot=foot.tolist())
        writer.write(image)
        observations.append(message)
    writer.release()
    times_ns = [message.device_time_ns for message in observations]
    return FollowInput("filmed", observations, times_ns, (), {CAMERA: video})


def track(person: int, number: int = 4) -> Track:
    """The true track of one person, associated in every frame."""
    times = np.arange(FRAMES) / FPS
    place = np.array([[*places(float(time))[person], 0.0] for time in times])
    return Track(number, times, place, np.full(FRAMES, HEIGHT), [(CAMERA, frame, person) for frame in range(FRAMES)])


def test_regions_are_cut_out_by_track_camera_and_time(filmed: FollowInput, tmp_path: Path) -> None:
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    out = tmp_path / "crops"
    count, _ = write_crops(out, filmed, result(track(0), track(1, 5)), known)
    assert sorted(path.name for path in out.iterdir()) == ["4", "5"]
    files = sorted(path.name for path in (out / "4").iterdir())
    assert count == len(files) + len(list((out / "5").iterdir()))
    assert {"left_0.200_head.jpg", "left_0.200_torso.jpg", "left_1.000_head.jpg"} <= set(files)
    assert not any(name.startswith(".") for name in files)
    assert np.median(off(out, "head", HEAD)) < 25  # in a frame or two another person stands before this one
    assert np.median(off(out, "torso", TORSO)) < 25


def test_a_detection_with_its_head_elsewhere_is_cut_where_the_track_is(filmed: FollowInput, tmp_path: Path) -> None:
    """Somebody hidden in part has the head where the silhouette ends, or none."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    changed = []
    for number, message in enumerate(filmed.observations):
        copy = pb.Observation()
        copy.CopyFrom(message)
        one = copy.detections[2]
        one.head[:] = [] if number % 2 else [one.head[0] + 40.0, one.head[1] + 30.0]
        changed.append(copy)
    write_crops(tmp_path / "crops", replace(filmed, observations=changed), result(track(2)), known)
    heads = off(tmp_path / "crops", "head", HEAD)
    assert len(heads) == FRAMES
    assert np.median(heads) < 25


def test_detections_without_frame_numbers_are_cut_from_the_frames_of_their_times(
    filmed: FollowInput, tmp_path: Path
) -> None:
    """They count from the first frame with a detection."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    later = []
    for number, message in enumerate(filmed.observations[4:]):
        copy = pb.Observation()
        copy.CopyFrom(message)
        copy.sequence, copy.frame = number, 0
        later.append(copy)
    one = replace(track(2), detections=[(CAMERA, number, 2) for number in range(len(later))])
    shot = replace(filmed, observations=later, times_ns=filmed.times_ns[4:])
    write_crops(tmp_path / "crops", shot, result(one), known)
    heads = off(tmp_path / "crops", "head", HEAD)
    assert len(heads) == FRAMES - 4
    assert np.median(heads) < 25


@pytest.mark.parametrize("first", [0, 1])
def test_frames_are_counted_from_0_or_from_1_as_their_times_say(
    first: int, filmed: FollowInput, tmp_path: Path
) -> None:
    """MOT files count from 1: each picture was cut out of the frame after. Nobody is in the first frame."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    numbered = []
    for message in filmed.observations[1:]:
        copy = pb.Observation()
        copy.CopyFrom(message)
        copy.sequence = copy.frame = message.sequence + first
        numbered.append(copy)
    one = replace(track(2), detections=[(CAMERA, message.sequence, 2) for message in numbered])
    shown = replace(filmed, observations=numbered, times_ns=filmed.times_ns[1:])
    write_crops(tmp_path / "crops", shown, result(one), known)
    heads = off(tmp_path / "crops", "head", HEAD)
    assert len(heads) == FRAMES - 1
    assert np.median(heads) < 25


def test_a_video_of_another_size_than_the_detections_is_cut_at_the_same_places(
    filmed: FollowInput, tmp_path: Path
) -> None:
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    small = tmp_path / "left.avi"
    writer = cv2.VideoWriter(str(small), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (SIZE[0] // 2, SIZE[1] // 2))
    for frame in VideoReader(filmed.videos[CAMERA]):
        writer.write(cv2.resize(frame.image(), (SIZE[0] // 2, SIZE[1] // 2)))
    writer.release()
    write_crops(tmp_path / "crops", replace(filmed, videos={CAMERA: small}), result(track(2)), known)
    assert np.median(off(tmp_path / "crops", "head", HEAD)) < 25


def result(*tracks: Track, up: Floats | None = UP) -> FollowResult:
    return FollowResult(tracks, {}, (), up)  # type: ignore[arg-type]


def off(folder: Path, region: str, colour: tuple[int, int, int]) -> list[float]:
    """How far the middle of each picture of a region is from a colour (BGR)."""
    out = []
    for path in folder.glob(f"*/*_{region}.jpg"):
        image = cv2.imread(str(path))
        assert image is not None
        middle = image[image.shape[0] // 3 : -image.shape[0] // 3, image.shape[1] // 3 : -image.shape[1] // 3]
        out.append(float(np.abs(middle.reshape(-1, 3).mean(axis=0) - colour).max()))
    return out


def test_a_face_is_shown_where_somebody_walks_towards_the_camera(filmed: FollowInput, tmp_path: Path) -> None:
    """Also where the calibration has no vertical, and people have shown it."""
    known = replace(read_given_calibration(write_calibration(tmp_path / "calibration.toml")), up=None)
    towards = known.calibration.cameras[CAMERA].pose.position[:2]
    times = np.arange(FRAMES) / FPS
    for sign, faces in ((1.0, FRAMES), (-1.0, 0)):
        step = sign * towards / np.linalg.norm(towards)
        one = track(0, 1)
        one.position[:, :2] = one.position[0, :2] + np.outer(times, step)
        out = tmp_path / f"crops{sign:g}"
        write_crops(out, filmed, result(one), known)
        assert len(list(out.glob("1/*_face.jpg"))) == faces
        assert len(list(out.glob("1/*_head.jpg"))) == FRAMES


def test_at_most_one_picture_between_two_wanted_times(filmed: FollowInput, tmp_path: Path) -> None:
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    few = FollowInput(filmed.name, filmed.observations, filmed.times_ns[::3], (), filmed.videos)
    write_crops(tmp_path / "crops", few, result(track(0)), known)
    assert len(list((tmp_path / "crops").glob("4/*_head.jpg"))) == 3


def test_pictures_of_an_earlier_run_are_replaced(filmed: FollowInput, tmp_path: Path) -> None:
    """Its track 4 may be somebody else."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    (tmp_path / "crops" / "4").mkdir(parents=True)
    for name in ("left_0.123_head.jpg", "mine.jpg"):
        (tmp_path / "crops" / "4" / name).write_bytes(b"")
    count, warnings = write_crops(tmp_path / "crops", filmed, result(track(0)), known)
    assert len(list((tmp_path / "crops" / "4").iterdir())) == count + 1
    assert (tmp_path / "crops" / "4" / "mine.jpg").exists()
    assert not warnings


def test_frames_that_a_video_lacks_are_counted(filmed: FollowInput, tmp_path: Path) -> None:
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    writer = cv2.VideoWriter(str(tmp_path / "left.avi"), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    for frame in list(VideoReader(filmed.videos[CAMERA]))[:4]:
        writer.write(frame.image())
    writer.release()
    cut = replace(filmed, videos={CAMERA: tmp_path / "left.avi"})
    count, (warning,) = write_crops(tmp_path / "crops", cut, result(track(0)), known)
    assert count > 0
    assert warning.startswith("left: 2 of 6 frames with people are in no video")


def test_the_videos_beside_a_sessions_observations_are_its_pictures(tmp_path: Path) -> None:
    assert run(["simulate", "people", "--out", str(tmp_path), "--cameras", "2", "--people", "1", "--seconds", "3"]) == 0
    write_video(tmp_path / "cam0.mp4", [np.full((480, 640, 3), 90, np.uint8)] * 3, [0.0, 0.1, 0.2])
    known = read_given_calibration(tmp_path / "truth_calibration.toml")
    source = read_follow_input(tmp_path, known, "person", tmp_path / "out")
    assert source.videos == {"cam0": tmp_path / "cam0.mp4"}
    check_pictures(source, tmp_path)


def test_a_session_without_pictures_is_named(filmed: FollowInput, tmp_path: Path) -> None:
    bare = FollowInput(filmed.name, filmed.observations, filmed.times_ns, (), {})
    with pytest.raises(InputError, match="this session has none"):
        check_pictures(bare, tmp_path)
