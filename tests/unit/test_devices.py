"""Devices: a simulated camera that keeps its world's time, and recordings read with their frame times."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge import scenes
from edge.devices.base import Frame
from edge.devices.live.opencv_capture import LiveCamera
from edge.devices.playback.open_video import open_video
from edge.devices.playback.playback_clock import AsFastAsPossible, RealTime
from edge.devices.playback.video_file import Recording
from edge.devices.simulated.camera import SimulatedDevice
from edge.scenes.common.base import Renderer
from edge.scenes.marker.scene import MarkerScene
from protocols.core.errors import InputError


class Blank(Renderer):
    """Draws nothing, and takes as long on the given clock as it is told to."""

    def __init__(self, pace: AsFastAsPossible, seconds: float) -> None:
        self.pace, self.seconds, self.drawn = pace, seconds, list[float]()

    def render(self, true_time: float) -> npt.NDArray[np.uint8]:
        self.drawn.append(true_time)
        self.pace.sleep(self.seconds)
        return np.zeros((4, 4, 3), np.uint8)


def simulated(
    pace: AsFastAsPossible, monkeypatch: pytest.MonkeyPatch, *, render_s: float = 0.0, duration_s: float = 20.0
) -> tuple[SimulatedDevice, Blank, MarkerScene]:
    blank = Blank(pace, render_s)
    monkeypatch.setattr(MarkerScene, "renderer", lambda *_: blank)
    scene = scenes.get("marker", 3)
    device = SimulatedDevice(scene, "cam1", 7, pace, duration_s=duration_s)
    device.open()
    return device, blank, scene


def read_all(device: SimulatedDevice | Recording) -> list[Frame]:
    frames = []
    while not device.ended:
        frame = device.read(0.5)
        if frame is not None:
            frames.append(frame)
    return frames


def test_a_simulated_camera_delivers_each_frame_when_its_time_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    pace = AsFastAsPossible(100.0)
    device, blank, scene = simulated(pace, monkeypatch)
    camera = scene.camera("cam1")
    while not device.ended:
        frame = device.read(0.5)
        if frame is None:
            continue
        delay = pace.now() - blank.drawn[-1]
        assert 0.5 * camera.exposure_s <= delay < 0.02
        assert camera.clock.true_time(frame.device_time_ns) == pytest.approx(blank.drawn[-1], abs=4e-4)
        assert frame.exposure_ns == 8_000_000
    assert blank.drawn[0] == pytest.approx(100.0, abs=0.05)
    assert blank.drawn[-1] == pytest.approx(120.0, abs=0.1)


def test_frame_numbers_tell_every_dropped_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    device, _, scene = simulated(AsFastAsPossible(), monkeypatch, duration_s=60.0)
    frames = read_all(device)
    numbers = np.array([frame.frame for frame in frames])
    assert (np.diff(numbers) > 0).all()
    missing = numbers[-1] + 1 - len(numbers)
    assert 0 <= device.dropped - missing <= 3  # it may have dropped after the last that we got
    assert missing / numbers[-1] == pytest.approx(scene.camera("cam1").drop_fraction, abs=0.012)
    assert device.late == 0
    # Evenly spaced by the frame number, but for the jitter.
    times = np.array([frame.device_time_ns for frame in frames]) / 1e9
    slope, _ = np.polyfit(numbers, times - times[0], 1)
    assert slope == pytest.approx(1 / 30, rel=1e-5)
    stray = times - np.polyval(np.polyfit(numbers, times - times[0], 1), numbers)
    assert np.std(stray) == pytest.approx(scene.camera("cam1").jitter_s, rel=0.15)


def test_a_slow_machine_loses_frames_but_stays_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    pace = AsFastAsPossible()
    device, blank, _ = simulated(pace, monkeypatch, render_s=0.1)
    frames = read_all(device)
    assert len(frames) == pytest.approx(20.0 / 0.1, rel=0.15)
    assert device.late > 300
    # Each was at most a render and a period old when it was begun, from first to last.
    assert pace.now() - blank.drawn[-1] < 0.3


def test_a_read_waits_no_longer_than_its_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    pace = AsFastAsPossible()
    device, _, _ = simulated(pace, monkeypatch)
    device.read(1.0)
    before = pace.now()
    assert device.read(0.001) is None
    assert pace.now() == pytest.approx(before + 0.001)


def test_the_same_seed_gives_the_same_frames_and_a_closed_device_none(monkeypatch: pytest.MonkeyPatch) -> None:
    stamps = []
    for _ in range(2):
        device, _, _ = simulated(AsFastAsPossible(), monkeypatch, duration_s=3.0)
        stamps.append([frame.device_time_ns for frame in read_all(device)])
        device.close()
        assert device.read(0.1) is None
    assert stamps[0] == stamps[1]


def test_a_rendered_frame_shows_the_scene() -> None:
    scene = scenes.get("marker", 0)
    device = SimulatedDevice(scene, "cam0", 0, AsFastAsPossible(), duration_s=0.2)
    assert (device.info.width, device.info.height, device.info.intrinsics) == (640, 480, scene.cameras[0].intrinsics)
    device.open()
    frames = read_all(device)
    assert frames
    assert frames[0].image.shape == (480, 640, 3)
    assert frames[0].image.std() > 20


def test_real_time_passes_and_counts_from_its_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: 1000.0)
    pace = RealTime(990.0)
    first = pace.now()
    pace.sleep(0.01)
    pace.sleep(-1.0)
    assert first == pytest.approx(10.0, abs=0.5)
    assert pace.now() - first >= 0.01


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
    assert isinstance(device, Recording)
    device.open()
    assert (device.info.width, device.info.height, device.info.fps) == (64, 48, 25.0)
    assert device.info.clock == "stream"
    frames = read_all(device)
    assert [frame.frame for frame in frames] == list(range(20))
    assert [frame.device_time_ns / 1e9 for frame in frames] == pytest.approx([k / 25 for k in range(20)], abs=1e-6)
    assert [frame.image.mean() for frame in frames] == pytest.approx([10.0 * k for k in range(20)], abs=4)
    assert device.repaired == 0
    assert device.read(0.0) is None


class OddStamps:
    """A capture whose container tells times that stand still, go back and are missing."""

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
        return 25.0 if what == cv2.CAP_PROP_FPS else self.stamps[min(self.index, len(self.stamps) - 1)]

    def release(self) -> None:
        pass


def test_times_that_do_not_increase_are_repaired_by_the_nominal_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "odd.mp4").touch()
    monkeypatch.setattr(cv2, "VideoCapture", OddStamps)
    device = Recording(tmp_path / "odd.mp4")
    device.open()
    times = [frame.device_time_ns / 1e9 for frame in read_all(device)]
    assert times == pytest.approx([0.0, 0.04, 0.08, 0.12, 0.16, 0.2])
    assert device.repaired == 3


def test_a_given_rate_overrides_the_files(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 5)
    device = Recording(tmp_path / "clip.avi", fps=50.0)
    device.open()
    assert [frame.device_time_ns for frame in read_all(device)] == [0, 20_000_000, 40_000_000, 60_000_000, 80_000_000]


def test_a_loop_runs_on_in_time(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 3)
    device = Recording(tmp_path / "clip.avi", loop=True)
    device.open()
    frames = [device.read(0.1) for _ in range(8)]
    assert [frame.frame for frame in frames if frame] == list(range(8))
    times = [frame.device_time_ns / 1e9 for frame in frames if frame]
    assert times == pytest.approx([k / 25 for k in range(8)])
    assert not device.ended


def test_playing_in_real_time_waits_for_each_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 10)
    pace = AsFastAsPossible(5.0)
    device = Recording(tmp_path / "clip.avi", pace=pace)
    device.open()
    assert device.read(0.0) is not None
    assert device.read(0.01) is None  # the second is due after 40 ms
    assert pace.now() == pytest.approx(5.01)
    read_all(device)
    assert pace.now() == pytest.approx(5.36)


def test_a_folder_of_pictures_is_read_in_order_of_names(tmp_path: Path) -> None:
    for name, level in (("b.png", 20), ("a.jpg", 10), ("c.png", 30)):
        cv2.imwrite(str(tmp_path / name), np.full((48, 64, 3), level, np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    device = open_video(tmp_path)
    device.open()
    assert isinstance(device, Recording)
    frames = read_all(device)
    assert [round(frame.image.mean()) for frame in frames] == [10, 20, 30]
    assert [frame.device_time_ns / 1e9 for frame in frames] == pytest.approx([0, 1 / 30, 2 / 30], abs=1e-9)


def test_what_cannot_be_read_is_told_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.mp4: this video does not exist; check the path"):
        Recording(tmp_path / "gone.mp4").open()
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match="no frame can be read"):
        Recording(tmp_path / "text.mp4").open()
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no pictures"):
        Recording(tmp_path / "empty").open()
    (tmp_path / "empty" / "a.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"a\.png: this picture cannot be read"):
        Recording(tmp_path / "empty").open()
    with pytest.raises(InputError, match=r"camera /dev/video97 does not answer.*plugged in"):
        open_video("/dev/video97").open()


def test_pictures_of_two_sizes_are_told(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((40, 64, 3), np.uint8))
    device = Recording(tmp_path)
    device.open()
    with pytest.raises(InputError, match=r"b\.png: this picture is 64x40"):
        read_all(device)


def test_intrinsics_of_another_size_are_told(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.avi", "MJPG", 25.0, 2)
    lens = dataclasses.replace(scenes.get("marker", 0).cameras[0].intrinsics)
    with pytest.raises(InputError, match="is 64x48, its intrinsics are for 640x480"):
        Recording(tmp_path / "clip.avi", intrinsics=lens).open()


@pytest.mark.parametrize("source", [0, "0", "/dev/video2", "rtsp://user:secret@10.0.0.1/stream"])
def test_live_sources_are_told_from_recordings(source: int | str) -> None:
    assert isinstance(open_video(source), LiveCamera)


class Plug:
    """A camera at 10 Hz, its plug, and the test's clock. Built by ``cv2.VideoCapture`` through this object."""

    def __init__(self) -> None:
        self.inside, self.size, self.now_ns = True, (4, 6, 3), 0
        self.since: list[float] = []  # of tries, while it is out

    def __call__(self, *_: object) -> Plug:
        if not self.inside:
            self.since.append(self.now_ns * 1e-9)
        return self

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)

    def isOpened(self) -> bool:
        return self.inside

    def set(self, *_: object) -> bool:
        return False

    def get(self, _: int) -> float:
        return 0.0

    def grab(self) -> bool:
        self.now_ns += 10**8 if self.inside else 10**3
        return self.inside

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros(self.size, np.uint8)

    def read(self) -> tuple[bool, np.ndarray]:
        return self.grab(), self.retrieve()[1]

    def release(self) -> None:
        pass


def plugged(monkeypatch: pytest.MonkeyPatch) -> tuple[Plug, LiveCamera]:
    plug = Plug()
    monkeypatch.setattr(cv2, "VideoCapture", plug)
    device = LiveCamera("/dev/video0", now_ns=lambda: plug.now_ns, sleep=plug.sleep)
    device.open()
    return plug, device


def test_a_live_camera_stamps_on_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    _, device = plugged(monkeypatch)
    assert device.info.fps == 0.0
    frames = [device.read(0.0) for _ in range(2)]
    assert [(frame.frame, frame.device_time_ns) for frame in frames if frame] == [(0, 2 * 10**8), (1, 3 * 10**8)]
    assert "time of capture: stamped on arrival" in device.info.unknown


def test_an_unplugged_camera_is_sought_ever_more_slowly_and_counts_what_it_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plug, device = plugged(monkeypatch)
    before = [frame for frame in (device.read(0.1) for _ in range(20)) if frame]
    plug.inside, pulled = False, plug.now_ns * 1e-9
    while plug.now_ns * 1e-9 < pulled + 30.0:
        assert device.read(0.1) is None
    assert device.away
    assert not device.ended, "an agent would end"
    assert plug.since[0] - pulled < 2.0
    pauses = np.diff(plug.since)
    assert pauses[0] < 1.0
    assert pauses.max() <= 5.1, "back-off above 5 s"
    assert 5 <= len(plug.since) <= 12, "it hammers at a plug that is empty, or has given up"
    plug.inside, again = True, plug.now_ns * 1e-9
    after: list[Frame] = []
    while len(after) < 5:
        frame = device.read(0.1)
        after += [frame] if frame else []
    assert after[0].device_time_ns * 1e-9 - again < 5.5
    assert device.reconnections == 1
    assert not device.away
    passed = (after[0].device_time_ns - before[-1].device_time_ns) * 1e-9
    assert after[0].frame - before[-1].frame == round(passed * 10.0), "10 Hz: the missed frames are a gap"
    assert [frame.frame - after[0].frame for frame in after] == [0, 1, 2, 3, 4]


def test_a_camera_that_comes_back_as_another_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    plug, device = plugged(monkeypatch)
    plug.inside = False
    while not device.away:
        device.read(0.1)
    plug.inside, plug.size = True, (8, 6, 3)
    plug.sleep(5.0)
    device.read(0.1)  # finds it
    with pytest.raises(InputError, match="came back as 6x8, it was 6x4; plug the same camera in"):
        device.read(0.1)  # sees its picture


def test_a_password_does_not_reach_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    plug = Plug()
    plug.inside = False
    monkeypatch.setattr(cv2, "VideoCapture", plug)
    with pytest.raises(InputError, match=r"rtsp://…@camera/stream does not answer; check address") as told:
        LiveCamera("rtsp://user:secret@camera/stream").open()
    assert "secret" not in str(told.value)
