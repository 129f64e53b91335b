"""Devices: a simulated camera in real time, playback by frame times, live cameras through OpenCV."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge import scenes
from edge.devices.base import Frame
from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.playback import video_reader
from edge.devices.playback.playback_clock import RealTime
from edge.devices.playback.video_file import VideoPlayback, open_video
from edge.devices.simulated.camera import SimulatedDevice
from edge.scenes.common.base import Renderer
from edge.scenes.marker.scene import MarkerScene
from protocols.core.errors import InputError
from tests.support.clocks import AsFastAsPossible
from tests.support.videos import numbered_image
from tests.support.videos import write_video as write_stamped_video


class BlankRenderer(Renderer):
    """Renders black images, each taking the given time on the clock."""

    def __init__(self, clock: AsFastAsPossible, seconds: float) -> None:
        self.clock, self.seconds, self.drawn = clock, seconds, list[float]()

    def render(self, true_time: float) -> npt.NDArray[np.uint8]:
        self.drawn.append(true_time)
        self.clock.sleep(self.seconds)
        return np.zeros((4, 4, 3), np.uint8)


def simulated(
    clock: AsFastAsPossible, monkeypatch: pytest.MonkeyPatch, *, render_s: float = 0.0, duration_s: float = 20.0
) -> tuple[SimulatedDevice, BlankRenderer, MarkerScene]:
    renderer = BlankRenderer(clock, render_s)
    monkeypatch.setattr("edge.devices.simulated.camera.renderer_for", lambda *_: renderer)
    scene = scenes.get_marker_scene("marker", 3)
    device = SimulatedDevice(scene, "cam1", 7, clock, duration_s=duration_s)
    device.open()
    return device, renderer, scene


def read_all(device: SimulatedDevice | VideoPlayback) -> list[Frame]:
    frames = []
    while not device.ended:
        frame = device.read(0.5)
        if frame is not None:
            frames.append(frame)
    return frames


def test_a_simulated_camera_delivers_each_frame_when_its_time_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = AsFastAsPossible(100.0)
    device, renderer, scene = simulated(clock, monkeypatch)
    camera = scene.camera("cam1")
    while not device.ended:
        frame = device.read(0.5)
        if frame is None:
            continue
        delay = clock.now() - renderer.drawn[-1]
        assert 0.5 * camera.exposure_s <= delay < 0.02
        assert camera.clock.true_time(frame.device_time_ns) == pytest.approx(renderer.drawn[-1], abs=4e-4)
        assert frame.exposure_ns == 8_000_000
    assert renderer.drawn[0] == pytest.approx(100.0, abs=0.05)
    assert renderer.drawn[-1] == pytest.approx(120.0, abs=0.1)


def test_frame_numbers_show_every_dropped_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    device, _, scene = simulated(AsFastAsPossible(), monkeypatch, duration_s=60.0)
    frames = read_all(device)
    numbers = np.array([frame.frame for frame in frames])
    assert (np.diff(numbers) > 0).all()
    missing = numbers[-1] + 1 - len(numbers)
    assert 0 <= device.dropped - missing <= 3  # it may have dropped frames after the last one delivered
    assert missing / numbers[-1] == pytest.approx(scene.camera("cam1").drop_fraction, abs=0.012)
    assert device.late == 0
    # Evenly spaced by the frame number, but for the jitter.
    times = np.array([frame.device_time_ns for frame in frames]) / 1e9
    slope, _ = np.polyfit(numbers, times - times[0], 1)
    assert slope == pytest.approx(1 / 30, rel=1e-5)
    stray = times - np.polyval(np.polyfit(numbers, times - times[0], 1), numbers)
    assert np.std(stray) == pytest.approx(scene.camera("cam1").jitter_s, rel=0.15)


def test_slow_rendering_skips_frames_but_stays_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = AsFastAsPossible()
    device, renderer, _ = simulated(clock, monkeypatch, render_s=0.1)
    frames = read_all(device)
    assert len(frames) == pytest.approx(20.0 / 0.1, rel=0.15)
    assert device.late > 300
    # When its rendering started, each frame was at most one rendering and one period late.
    assert clock.now() - renderer.drawn[-1] < 0.3


def test_a_read_waits_no_longer_than_its_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = AsFastAsPossible()
    device, _, _ = simulated(clock, monkeypatch)
    device.read(1.0)
    before = clock.now()
    assert device.read(0.001) is None
    assert clock.now() == pytest.approx(before + 0.001)


def test_the_same_seed_gives_the_same_frames_and_a_closed_device_none(monkeypatch: pytest.MonkeyPatch) -> None:
    stamps = []
    for _ in range(2):
        device, _, _ = simulated(AsFastAsPossible(), monkeypatch, duration_s=3.0)
        stamps.append([frame.device_time_ns for frame in read_all(device)])
        device.close()
        assert device.read(0.1) is None
    assert stamps[0] == stamps[1]


def test_a_rendered_frame_shows_the_scene() -> None:
    scene = scenes.get_marker_scene("marker", 0)
    device = SimulatedDevice(scene, "cam0", 0, AsFastAsPossible(), duration_s=0.2)
    assert (device.info.width, device.info.height, device.info.intrinsics) == (640, 480, scene.cameras[0].intrinsics)
    device.open()
    frames = read_all(device)
    assert frames
    assert frames[0].image.shape == (480, 640, 3)
    assert frames[0].image.std() > 20


def test_real_time_passes_and_counts_from_its_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: 1000.0)
    clock = RealTime(990.0)
    first = clock.now()
    clock.sleep(0.01)
    clock.sleep(-1.0)
    assert first == pytest.approx(10.0, abs=0.5)
    assert clock.now() - first >= 0.01


def write_video(path: Path, code: str, fps: float, count: int, levels: list[int] | None = None) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), fps, (64, 48))
    assert writer.isOpened()
    for index in range(count):
        writer.write(np.full((48, 64, 3), 10 * index if levels is None else levels[index], np.uint8))
    writer.release()


@pytest.mark.parametrize(("name", "code"), [("clip.avi", "MJPG"), ("clip.mp4", "mp4v")])
def test_a_file_is_read_with_its_own_frame_times(tmp_path: Path, name: str, code: str) -> None:
    write_video(tmp_path / name, code, 25.0, 20)
    device = open_video(tmp_path / name)
    assert isinstance(device, VideoPlayback)
    device.open()
    assert (device.info.width, device.info.height, device.info.fps) == (64, 48, 25.0)
    assert device.info.clock == "stream"
    frames = read_all(device)
    assert [frame.frame for frame in frames] == list(range(20))
    assert [frame.device_time_ns / 1e9 for frame in frames] == pytest.approx([k / 25 for k in range(20)], abs=1e-6)
    assert [frame.image.mean() for frame in frames] == pytest.approx([10.0 * k for k in range(20)], abs=4)
    assert device.warnings == ()
    assert device.read(0.0) is None


class BrokenTimestamps:
    """A capture with repeated, decreasing and missing time stamps."""

    stamps = (0.0, 40.0, 40.0, 20.0, float("nan"), 200.0)

    def __init__(self, _: str) -> None:
        self.index = -1

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.index += 1
        good = self.index < len(self.stamps)
        return good, np.zeros((4, 6, 3), np.uint8) if good else None

    def get(self, what: int) -> float:
        stated = {cv2.CAP_PROP_FPS: 25.0, cv2.CAP_PROP_FRAME_COUNT: len(self.stamps)}
        return stated[what] if what in stated else self.stamps[min(self.index, len(self.stamps) - 1)]

    def release(self) -> None:
        pass


def test_times_that_do_not_increase_are_repaired_by_the_nominal_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "odd.mp4").touch()
    monkeypatch.setattr(cv2, "VideoCapture", BrokenTimestamps)
    monkeypatch.setattr(video_reader, "has_pyav", lambda: False)
    device = VideoPlayback(tmp_path / "odd.mp4")
    device.open()
    times = [frame.device_time_ns / 1e9 for frame in read_all(device)]
    assert times == pytest.approx([0.0, 0.04, 0.08, 0.12, 0.16, 0.2])
    assert device.warnings == ("3 frames have no usable time stamp",)
    looped = VideoPlayback(tmp_path / "odd.mp4", loop=True)
    looped.open()
    for _ in range(13):
        assert looped.read(0.0) is not None


def test_a_given_rate_overrides_the_files(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 5)
    device = VideoPlayback(tmp_path / "clip.avi", fps=50.0)
    device.open()
    assert [frame.device_time_ns for frame in read_all(device)] == [0, 20_000_000, 40_000_000, 60_000_000, 80_000_000]


def test_a_loop_runs_on_in_time(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 3)
    device = VideoPlayback(tmp_path / "clip.avi", loop=True)
    device.open()
    frames = [device.read(0.1) for _ in range(8)]
    assert [frame.frame for frame in frames if frame] == list(range(8))
    times = [frame.device_time_ns / 1e9 for frame in frames if frame]
    assert times == pytest.approx([k / 25 for k in range(8)])
    assert not device.ended


@pytest.mark.parametrize("name", ["a.ts", "a.mts"])
def test_a_loop_begins_at_0_whatever_the_first_time_stamp_is(tmp_path: Path, name: str) -> None:
    write_stamped_video(tmp_path / name, [numbered_image(i) for i in range(6)], 3600.0 + np.arange(6) / 25)
    device = VideoPlayback(tmp_path / name, loop=True)
    device.open()
    frames = [device.read(0.1) for _ in range(15)]
    assert [frame.device_time_ns / 1e9 for frame in frames if frame] == pytest.approx(np.arange(15) / 25, abs=1e-3)


@pytest.mark.parametrize("pyav", [True, False])
def test_a_looped_file_that_is_removed_or_replaced_is_refused_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pyav: bool
) -> None:
    monkeypatch.setattr(video_reader, "has_pyav", lambda: pyav)
    file = tmp_path / "clip.avi"
    write_video(file, "MJPG", 25.0, 3)
    original = file.read_bytes()
    write_stamped_video(tmp_path / "other.avi", [numbered_image(1)], [0.0])
    for content, says in (
        (None, "this video does not exist; check the path"),
        (b"no video", r"no frame can be read from this .*; .+"),
        ((tmp_path / "other.avi").read_bytes(), "no frame can be read from this video; .+"),  # of another size
    ):
        file.write_bytes(original)
        device = VideoPlayback(file, loop=True)
        device.open()
        for _ in range(3):
            device.read(0.1)
        file.unlink()
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(InputError, match=rf"clip\.avi: {says}"):
            read_all(device)


def test_playing_in_real_time_waits_for_each_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 10)
    clock = AsFastAsPossible(5.0)
    device = VideoPlayback(tmp_path / "clip.avi", playback_clock=clock)
    device.open()
    assert device.read(0.0) is not None
    assert device.read(0.01) is None  # the second is due after 40 ms
    assert clock.now() == pytest.approx(5.01)
    read_all(device)
    assert clock.now() == pytest.approx(5.36)


def test_an_image_folder_is_read_in_the_order_of_names(tmp_path: Path) -> None:
    for name, level in (("b.png", 20), ("a.jpg", 10), ("c.png", 30)):
        cv2.imwrite(str(tmp_path / name), np.full((48, 64, 3), level, np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    device = open_video(tmp_path)
    device.open()
    assert isinstance(device, VideoPlayback)
    frames = read_all(device)
    assert [round(frame.image.mean()) for frame in frames] == [10, 20, 30]
    assert [frame.device_time_ns / 1e9 for frame in frames] == pytest.approx([0, 1 / 30, 2 / 30], abs=1e-9)


def test_unreadable_sources_are_refused_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.mp4: this video does not exist; check the path"):
        VideoPlayback(tmp_path / "gone.mp4").open()
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match="no frame can be read"):
        VideoPlayback(tmp_path / "text.mp4").open()
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no images"):
        VideoPlayback(tmp_path / "empty").open()
    (tmp_path / "empty" / "a.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="empty: none of its images can be read"):
        VideoPlayback(tmp_path / "empty").open()
    with pytest.raises(InputError, match=r"camera /dev/video97 does not answer.*plugged in"):
        open_video("/dev/video97").open()


def test_images_of_two_sizes_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((40, 64, 3), np.uint8))
    device = VideoPlayback(tmp_path)
    device.open()
    with pytest.raises(InputError, match=r"b\.png: this image is 64x40"):
        read_all(device)


def test_intrinsics_of_another_size_are_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 2)
    lens = dataclasses.replace(scenes.get_marker_scene("marker", 0).cameras[0].intrinsics)
    with pytest.raises(InputError, match="is 64x48, its intrinsics are for 640x480"):
        VideoPlayback(tmp_path / "clip.avi", intrinsics=lens).open()


@pytest.mark.parametrize("source", [0, "0", "/dev/video2", "rtsp://user:secret@10.0.0.1/stream"])
def test_live_sources_are_distinguished_from_recordings(source: int | str) -> None:
    assert isinstance(open_video(source), OpenCvCamera)


class UsbPort:
    """A camera at 10 Hz on a port that can be unplugged, with the test's clock. Built by ``cv2.VideoCapture``."""

    def __init__(self) -> None:
        self.connected, self.size, self.now_ns = True, (4, 6, 3), 0
        self.attempts: list[float] = []  # times of reconnection attempts while it is unplugged

    def __call__(self, *_: object) -> UsbPort:
        if not self.connected:
            self.attempts.append(self.now_ns * 1e-9)
        return self

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)

    def isOpened(self) -> bool:
        return self.connected

    def set(self, *_: object) -> bool:
        return False

    def get(self, _: int) -> float:
        return 0.0

    def grab(self) -> bool:
        self.now_ns += 10**8 if self.connected else 10**3
        return self.connected

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros(self.size, np.uint8)

    def read(self) -> tuple[bool, np.ndarray]:
        return self.grab(), self.retrieve()[1]

    def release(self) -> None:
        pass


def opened_camera(monkeypatch: pytest.MonkeyPatch) -> tuple[UsbPort, OpenCvCamera]:
    port = UsbPort()
    monkeypatch.setattr(cv2, "VideoCapture", port)
    device = OpenCvCamera("/dev/video0", now_ns=lambda: port.now_ns, sleep=port.sleep)
    device.open()
    return port, device


def test_a_live_camera_stamps_on_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    _, device = opened_camera(monkeypatch)
    assert device.info.fps == 0.0
    frames = [device.read(0.0) for _ in range(2)]
    assert [(frame.frame, frame.device_time_ns) for frame in frames if frame] == [(0, 2 * 10**8), (1, 3 * 10**8)]
    assert "time of capture: stamped on arrival" in device.info.unknown


def test_reconnection_backs_off_and_missed_frames_are_a_gap_in_the_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port, device = opened_camera(monkeypatch)
    before = [frame for frame in (device.read(0.1) for _ in range(20)) if frame]
    port.connected, pulled = False, port.now_ns * 1e-9
    while port.now_ns * 1e-9 < pulled + 30.0:
        assert device.read(0.1) is None
    assert device.disconnected
    assert not device.ended, "an agent would stop"
    assert port.attempts[0] - pulled < 2.0
    pauses = np.diff(port.attempts)
    assert pauses[0] < 1.0
    assert pauses.max() <= 5.1, "back-off above 5 s"
    assert 5 <= len(port.attempts) <= 12, "too many attempts, or none any more"
    port.connected, again = True, port.now_ns * 1e-9
    after: list[Frame] = []
    while len(after) < 5:
        frame = device.read(0.1)
        after += [frame] if frame else []
    assert after[0].device_time_ns * 1e-9 - again < 5.5
    assert device.reconnections == 1
    assert not device.disconnected
    passed = (after[0].device_time_ns - before[-1].device_time_ns) * 1e-9
    assert after[0].frame - before[-1].frame == round(passed * 10.0), "10 Hz: the missed frames are a gap"
    assert [frame.frame - after[0].frame for frame in after] == [0, 1, 2, 3, 4]


def test_a_camera_that_reconnects_with_another_size_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    port, device = opened_camera(monkeypatch)
    port.connected = False
    while not device.disconnected:
        device.read(0.1)
    port.connected, port.size = True, (8, 6, 3)
    port.sleep(5.0)
    device.read(0.1)  # reconnects
    with pytest.raises(InputError, match="came back as 6x8, it was 6x4; plug the same camera in"):
        device.read(0.1)  # gets its first frame


def test_a_password_does_not_reach_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    port = UsbPort()
    port.connected = False
    monkeypatch.setattr(cv2, "VideoCapture", port)
    with pytest.raises(InputError, match=r"rtsp://…@camera/stream does not answer; check address") as error:
        OpenCvCamera("rtsp://user:secret@camera/stream").open()
    assert "secret" not in str(error.value)
