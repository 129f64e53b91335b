"""Playback of a log's images as a camera: unchanged, by their capture times, and the intact part of a damaged log."""

from __future__ import annotations

import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.agents.assembly import start_camera
from deploy.config.agents import CameraConfig, LogConfig
from edge import scenes
from edge.agents.thumbnails import thumbnail_message
from edge.detectors.marker.ball import MarkerDetector
from edge.devices.base import Frame
from edge.devices.playback.log_playback import LogPlayback
from edge.scenes import renderer_for
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.errors import InputError
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, OBSERVATION, PICTURE
from tests.support.clocks import AsFastAsPossible

SCENE = scenes.get_marker_scene("marker", 0)
LENS = SCENE.camera("cam0").intrinsics
COUNT, FIRST_NS, STEP_NS = 24, -3_000_000_000, 500_000_000
WIDTH = 320  # half of the camera's


def write_log(log: Path, boots: tuple[str, ...] = ("b1",), views: bool = True) -> list[pb.Picture]:
    """Write a log as a recorder does: half-size thumbnails of every 15th frame of cam0, and its camera info."""
    renderer = renderer_for(SCENE, "cam0", np.random.default_rng(0))
    written = []
    with LogWriter(log, views=views) as writer:
        for boot in boots:
            info = pb.CameraInfo(schema_version=1, camera="cam0", boot_id=boot, width=640, height=480, fps=30.0)
            info.matrix.extend(LENS.matrix.ravel().tolist())
            info.distortions.extend(LENS.distortions.tolist())
            writer.write(CAMERA_INFO, "cam0", "local", info, 10**18)
            for index in range(COUNT if boot == "b1" else 3):
                frame = Frame(renderer.render(1.0 + 0.5 * index), FIRST_NS + index * STEP_NS, 15 * index)
                picture = thumbnail_message(frame, "cam0", boot, WIDTH)
                writer.write(PICTURE, "cam0", "local", picture, 10**18 + index * STEP_NS)
                written.append(picture)
            other = thumbnail_message(Frame(np.zeros((48, 64, 3), np.uint8), 5, 1), "cam7", "x", WIDTH)
            writer.write(PICTURE, "cam7", "local", other, 10**18)
    return written


def decode(picture: pb.Picture) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def play_all(camera: LogPlayback) -> list[Frame]:
    camera.open()
    frames = []
    while not camera.ended:
        frame = camera.read(10.0)
        if frame is not None:
            frames.append(frame)
    return frames


def test_images_are_played_with_their_recorded_pixels_times_and_numbers(tmp_path: Path) -> None:
    written = write_log(tmp_path / "a.mcap", boots=("b0", "b1"))
    pictures = [picture for picture in written if picture.boot_id == "b1"]  # the run with the most
    camera = LogPlayback(tmp_path / "a.mcap", "cam0")
    frames = play_all(camera)
    assert [(f.device_time_ns, f.frame) for f in frames] == [(p.device_time_ns, p.frame) for p in pictures]
    assert all((f.image == decode(p)).all() for f, p in zip(frames, pictures, strict=True))
    assert (camera.info.width, camera.info.height, camera.info.fps, camera.info.driver) == (320, 240, 2.0, "log")
    assert (camera.damage, camera.skipped) == ("", 0)
    camera.close()
    camera.close()


def test_the_recorded_intrinsics_are_scaled_to_the_images(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    for given in (None, LENS):
        camera = LogPlayback(tmp_path / "a.mcap", "cam0", intrinsics=given)
        camera.open()
        lens = camera.info.intrinsics
        assert lens is not None
        assert (lens.width, lens.height) == (320, 240)
        points = np.array([[0.3, -0.2, 2.0], [-0.4, 0.1, 3.0], [0.0, 0.0, 1.0]])
        assert np.allclose(lens.project(points), (LENS.project(points) + 0.5) / 2.0 - 0.5)
    with pytest.raises(InputError, match="its intrinsics are for 641x480"):
        LogPlayback(tmp_path / "a.mcap", "cam0", intrinsics=replace(LENS, width=641)).open()


def test_an_agents_detections_are_those_on_the_decoded_images(tmp_path: Path) -> None:
    pictures = write_log(tmp_path / "a.mcap")
    hub = MemoryHub()
    listener = MemoryBus(hub)
    observations, infos = listener.subscribe(OBSERVATION), listener.subscribe(CAMERA_INFO)
    config = CameraConfig(id="again", driver="log", log=LogConfig(file=tmp_path / "a.mcap", camera="cam0", fast=True))
    start_camera(config, MemoryBus(hub), threading.Event())
    got = [received.message for received in observations.drain()]
    matrix = np.diag([0.5, 0.5, 1.0]) @ LENS.matrix
    matrix[:2, 2] -= 0.25
    detector = MarkerDetector(intrinsics=replace(LENS, width=320, height=240, matrix=matrix))
    expected = [detector.detect(decode(picture)) for picture in pictures]
    assert [m.device_time_ns for m in got] == [p.device_time_ns for p in pictures]
    assert [len(m.detections) for m in got] == [len(found) for found in expected]
    assert sum(len(found) for found in expected) > COUNT // 4, "nothing would be compared"
    for message, found in zip(got, expected, strict=True):
        for reported, one in zip(message.detections, found, strict=True):
            assert (reported.u, reported.v, reported.size) == pytest.approx((one.u, one.v, one.size), rel=1e-9)
    info = infos.drain()[0].message
    assert (info.width, info.height) == (320, 240)
    assert info.matrix[0] == pytest.approx(0.5 * LENS.matrix[0, 0])


def test_real_time_playback_follows_the_capture_times(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    clock = AsFastAsPossible(start=50.0)
    camera = LogPlayback(tmp_path / "a.mcap", "cam0", playback_clock=clock)
    camera.open()
    moments = []
    while not camera.ended:
        before = clock.now()
        if camera.read(0.2) is not None:
            moments.append(clock.now())
        elif not camera.ended:
            assert clock.now() == pytest.approx(before + 0.2), "no longer than the timeout"
    assert np.allclose(moments, 50.0 + 0.5 * np.arange(COUNT))


def test_the_intact_part_of_a_damaged_log_is_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = tmp_path / "a.mcap"
    pictures = write_log(whole)
    data = bytearray(whole.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 3])
    for name in ("bad", "cut"):
        camera = LogPlayback(tmp_path / f"{name}.mcap", "cam0")
        frames = play_all(camera)
        known = {picture.device_time_ns: picture for picture in pictures}
        assert 0 < len(frames) < COUNT
        assert all((frame.image == decode(known[frame.device_time_ns])).all() for frame in frames)
        assert camera.damage
    config = CameraConfig(id="cam0", driver="log", log=LogConfig(file=tmp_path / "cut.mcap", fast=True))
    start_camera(config, MemoryBus(MemoryHub()), threading.Event())
    assert "cam0: the log is damaged, its good part is played:" in capsys.readouterr().err


def test_a_log_without_this_camera_is_refused_with_the_list_of_its_cameras(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    file = tmp_path / "cam5.toml"
    file.write_text('id = "cam5"\ndriver = "log"\n[log]\nfile = "a.mcap"\n[bus]\nlisten = ["tcp/127.0.0.1:0"]\n')
    ended = subprocess.run(
        [sys.executable, "-m", "deploy", "camera", str(file)], capture_output=True, text=True, timeout=120, check=False
    )
    assert ended.returncode == 2, ended.stderr
    assert "a.mcap: no images of cam5 in this log, only of cam0, cam7; choose one of these" in ended.stderr
    assert "Traceback" not in ended.stderr
    with LogWriter(tmp_path / "none.mcap"):
        pass
    for name, reported in (("none", "and of no other camera; record with pictures_hz"), ("gone", "does not exist")):
        with pytest.raises(InputError, match=reported):
            LogPlayback(tmp_path / f"{name}.mcap", "cam0").open()
    (tmp_path / "text.mcap").write_text("no log")
    with pytest.raises(InputError, match=r"text\.mcap"):
        LogPlayback(tmp_path / "text.mcap", "cam0").open()


def test_undecodable_and_out_of_order_images_are_skipped_and_counted(tmp_path: Path) -> None:
    good = np.full((48, 64, 3), 90, np.uint8)
    with LogWriter(tmp_path / "a.mcap") as writer:
        for number, (time_ns, image) in enumerate(
            [(10, good), (20, None), (5, good), (10, good), (30, good[:40]), (40, good)]
        ):
            picture = thumbnail_message(Frame(good if image is None else image, time_ns, number), "cam0", "b", WIDTH)
            if image is None:
                picture.jpeg = b"\xff\xd8 not one"
            writer.write(PICTURE, "cam0", "local", picture, 10**18 + number)
    camera = LogPlayback(tmp_path / "a.mcap", "cam0")
    assert [frame.frame for frame in play_all(camera)] == [0, 5]
    assert camera.skipped == 4
