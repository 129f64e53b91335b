"""``VideoReader``: frames of files and image folders with their times, upright, damaged frames counted."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.devices.playback import video_reader
from edge.devices.playback.video_reader import VideoReader
from protocols.core.errors import InputError
from tests.support.videos import numbered_image, read_number, write_video

TIMES = np.cumsum(np.r_[0.0, np.random.default_rng(5).uniform(0.01, 0.08, 39)])


@pytest.mark.parametrize(("pyav", "within"), [(True, 1e-5), (False, 1.1e-3)])
def test_a_variable_frame_rate_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pyav: bool, within: float
) -> None:
    write_video(tmp_path / "a.mp4", [numbered_image(i) for i in range(40)], TIMES)
    monkeypatch.setattr(video_reader, "has_pyav", lambda: pyav)
    frames = list(VideoReader(tmp_path / "a.mp4"))
    assert [frame.frame for frame in frames] == list(range(40))
    assert [read_number(frame.image()) for frame in frames] == list(range(40))
    np.testing.assert_allclose([frame.time for frame in frames], TIMES, atol=within)


def test_a_damaged_frame_is_skipped_and_counted_and_the_others_keep_their_times(tmp_path: Path) -> None:
    file = tmp_path / "a.mkv"
    write_video(file, [numbered_image(i) for i in range(40)], TIMES, codec="mjpeg")
    bytes_ = bytearray(file.read_bytes())
    starts = [i for i in range(len(bytes_) - 2) if bytes_[i : i + 3] == b"\xff\xd8\xff"]
    bytes_[starts[17] : starts[18] - 12] = bytes(starts[18] - 12 - starts[17])
    file.write_bytes(bytes_)
    video = VideoReader(file)
    frames = list(video)
    assert video.corrupt == 1
    left = [i for i in range(40) if i != 17]
    assert [read_number(frame.image()) for frame in frames] == left
    np.testing.assert_allclose([frame.time for frame in frames], TIMES[left], atol=1.1e-3)


def test_a_truncated_file_gives_its_readable_frames(tmp_path: Path) -> None:
    file = tmp_path / "a.ts"
    write_video(file, [numbered_image(i) for i in range(40)], TIMES)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    frames = list(VideoReader(file))
    assert 10 < len(frames) < 40
    assert [read_number(frame.image()) for frame in frames[:10]] == list(range(10))


@pytest.mark.parametrize("start", [0.0, 1000.0])
def test_a_file_that_ends_before_its_container_says_is_reported(tmp_path: Path, start: float) -> None:
    whole, cut = tmp_path / "whole.mkv", tmp_path / "cut.mkv"
    write_video(whole, [numbered_image(i) for i in range(100)], start + np.arange(100) / 10)
    cut.write_bytes(whole.read_bytes()[: int(0.6 * whole.stat().st_size)])
    warnings = {}
    for file in (whole, cut):
        video = VideoReader(file)
        last = list(video)[-1].time
        warnings[file] = video.warnings
    assert warnings[whole] == ()
    says = f"it ends at {last:.1f} s, its container says {start + 9.9:.1f} s: the file seems to be cut off"
    assert warnings[cut] == (says,)


def test_frames_of_another_size_than_the_first_are_left_out_and_counted(tmp_path: Path) -> None:
    """Detections in both would be pixels of two scales."""
    write_video(tmp_path / "a.ts", [numbered_image(i) for i in range(20)], np.arange(20) / 10)
    small = [np.ascontiguousarray(numbered_image(i)[::2, ::2]) for i in range(20, 30)]
    write_video(tmp_path / "b.ts", small, np.arange(20, 30) / 10)
    with (tmp_path / "a.ts").open("ab") as file:
        file.write((tmp_path / "b.ts").read_bytes())
    video = VideoReader(tmp_path / "a.ts")
    assert [read_number(frame.image()) for frame in video] == list(range(20))
    assert video.warnings == ("10 frames are not of the first one's size, 160x32, and left out",)


def test_portrait_videos_are_rotated_upright_as_opencv_does(tmp_path: Path) -> None:
    """A phone held upright stores landscape images and a rotation matrix in the track header."""
    write_video(tmp_path / "a.mp4", [numbered_image(5)] * 3, [0.0, 0.1, 0.2])
    content = (tmp_path / "a.mp4").read_bytes()
    lying = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    turned = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    at = content.index(lying, content.index(b"tkhd"))
    (tmp_path / "b.mp4").write_bytes(content[:at] + turned + content[at + len(turned) :])
    video = VideoReader(tmp_path / "b.mp4")
    assert video.info.size == (32, 160)
    good, expected = cv2.VideoCapture(str(tmp_path / "b.mp4")).read()
    assert good
    picture = next(iter(video)).image()
    assert picture.shape == (160, 32, 3)
    assert np.abs(picture.astype(int) - expected).mean() < 1.0


def test_an_unreadable_image_of_a_folder_is_skipped_but_advances_the_time(tmp_path: Path) -> None:
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"{i}.png"), numbered_image(i))
    (tmp_path / "2.png").write_bytes(b"no picture")
    video = VideoReader(tmp_path, fps=10.0)
    assert [(frame.frame, round(frame.time, 6), read_number(frame.image())) for frame in video] == [
        (0, 0.0, 0),
        (1, 0.1, 1),
        (2, 0.3, 3),
        (3, 0.4, 4),
    ]
    assert video.corrupt == 1


@pytest.mark.parametrize("name", ["nothing.mp4", "text.mp4", "empty"])
def test_unreadable_videos_are_refused_with_their_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "text.mp4").write_text("not a video")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=name):
        VideoReader(tmp_path / name)


def test_photographs_are_all_turned_as_the_first_is(tmp_path: Path) -> None:
    """Each was turned by its own EXIF orientation: upside down the lens was another one, upright the size."""
    scene = np.zeros((48, 64, 3), dtype=np.uint8)
    scene[:24, :32] = 255
    jpeg = cv2.imencode(".jpg", scene)[1].tobytes()
    for name, orientation in (("1.jpg", 6), ("2.jpg", 1), ("3.jpg", 3)):
        tag = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
        exif = b"Exif\0\0MM\0*" + struct.pack(">IH", 8, 1) + tag + bytes(4)
        (tmp_path / name).write_bytes(jpeg[:2] + struct.pack(">HH", 0xFFE1, len(exif) + 2) + exif + jpeg[2:])
    reader = VideoReader(tmp_path)
    images = [frame.image() for frame in reader]
    assert reader.info.size == (48, 64)
    assert len(images) == 3
    assert images[0][10, 40].min() > 200, "a quarter turn to the right"
    assert all(np.array_equal(image, images[0]) for image in images)
