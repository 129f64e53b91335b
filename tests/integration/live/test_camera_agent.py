"""The camera agent on a bus: published messages, counters, and how it ends."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.agents.systemd_notify import HeartbeatDevice
from edge import scenes
from edge.agents.camera import CameraAgent
from edge.detectors.base import Detection
from edge.detectors.marker.ball import MarkerDetector
from edge.devices.base import DeviceInfo, Frame
from edge.devices.simulated.camera import SimulatedDevice
from protocols.bus.base import BusDead
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.errors import InputError
from protocols.geometry import so3
from protocols.session.rig import RigCamera
from protocols.topics import CAMERA_INFO, OBSERVATION, STATUS
from tests.support.clocks import AsFastAsPossible
from tests.support.samples import eventually
from tests.support.threads import running


class ListedDevice:
    """Delivers frames of the given numbers and ends."""

    def __init__(self, numbers: list[int], endless: bool = False) -> None:
        self.numbers, self.endless, self.opened, self.closed = list(numbers), endless, False, False
        self.info = DeviceInfo(64, 48, 30.0, "listed", "monotonic", readout_s=0.01)

    @property
    def ended(self) -> bool:
        return not self.numbers and not self.endless

    def open(self) -> None:
        self.opened = True

    def read(self, timeout_s: float) -> Frame | None:
        if not self.numbers:
            time.sleep(min(timeout_s, 0.005))
            return None
        number = self.numbers.pop(0)
        return Frame(np.zeros((48, 64, 3), np.uint8), number * 33_000_000 - 5, number, 4_000_000)

    def close(self) -> None:
        self.closed = True


class ScriptedDetector:
    """Returns the given detections, one list per frame."""

    def __init__(self, *answers: list[Detection]) -> None:
        self.answers = list(answers)

    def detect(self, image: np.ndarray, *_: object) -> list[Detection]:
        return self.answers.pop(0) if self.answers else []


def messages(subscription: Any) -> list[Any]:
    return [received.message for received in subscription.drain()]


def test_every_frame_is_published_even_without_detections() -> None:
    hub = MemoryHub()
    listener = MemoryBus(hub)
    observations, infos, statuses = (listener.subscribe(topic) for topic in (OBSERVATION, CAMERA_INFO, STATUS))
    device = ListedDevice([0, 1, 4, 5])
    seen = Detection(12.5, 7.25, 9.0, 0.9, "marker", (250, 110, 20), (0.01, 0.001, 0.02))
    CameraAgent(device, ScriptedDetector([], [seen], []), MemoryBus(hub), "cam0", boot_id="b1").run(threading.Event())
    got = messages(observations)
    assert [m.frame for m in got] == [0, 1, 4, 5]
    assert [m.sequence for m in got] == [0, 1, 2, 3]
    assert [m.device_time_ns for m in got] == [-5, 32_999_995, 131_999_995, 164_999_995]
    assert [len(m.detections) for m in got] == [0, 1, 0, 0]
    assert {(m.camera, m.boot_id, m.exposure_ns) for m in got} == {("cam0", "b1", 4_000_000)}
    detection = got[1].detections[0]
    assert (detection.u, detection.v, detection.size, detection.label) == (12.5, 7.25, 9.0, "marker")
    assert (detection.colour.red, detection.colour.green, detection.colour.blue) == (250, 110, 20)
    assert list(detection.covariance) == [0.01, 0.001, 0.02]
    (info,) = messages(infos)
    assert (info.width, info.height, info.fps, info.clock, info.readout_s) == (64, 48, 30.0, "monotonic", 0.01)
    assert not info.matrix  # its intrinsics are not known
    last = messages(statuses)[-1]
    assert (last.state, last.message, last.role) == ("stopping", "the recording has ended", "camera")
    assert (last.counters["frames"], last.counters["dropped"]) == (4, 2)
    assert (last.counters["detections"], last.counters["empty"]) == (1, 3)
    assert device.closed
    for subscription in (observations, infos, statuses):
        assert not any(count for name, count in subscription.counters.items() if name.startswith("rejected"))


def test_pose_and_intrinsics_of_the_rig_file_are_in_the_camera_info() -> None:
    hub = MemoryHub()
    infos = MemoryBus(hub).subscribe(CAMERA_INFO)
    rotation = so3.exp(np.array([0.1, -0.2, 0.3]))
    lens = scenes.get_marker_scene("marker", 0).cameras[0].intrinsics
    known = RigCamera(
        "cam0",
        (64, 48),
        intrinsics=lens,
        position=np.array([1.0, 2.0, 3.0]),
        rotation=rotation,
        position_std=np.full(3, 0.01),
        focal_std=0.1,
        readout=-0.012,
    )
    agent = CameraAgent(ListedDevice([0]), ScriptedDetector(), MemoryBus(hub), "cam0", known=known, target="light")
    agent.run(threading.Event())
    (info,) = messages(infos)
    assert info.target == "light"
    assert list(info.position) == [1.0, 2.0, 3.0]
    assert list(info.rotation) == pytest.approx([0.1, -0.2, 0.3])
    assert list(info.position_std) == [0.01, 0.01, 0.01]
    assert not info.rotation_std
    assert list(info.matrix) == lens.matrix.ravel().tolist()
    assert list(info.distortions) == lens.distortions.tolist()
    assert info.focal_std == 0.1
    assert info.readout_s == -0.012


def test_it_is_announced_while_it_runs_and_stops_on_request() -> None:
    hub = MemoryHub()
    watch = MemoryBus(hub).watch_agents()
    observations = MemoryBus(hub).subscribe(OBSERVATION)
    device = ListedDevice([0, 1], endless=True)
    agent = CameraAgent(device, ScriptedDetector(), MemoryBus(hub), "cam0")
    with running(agent.run):
        assert observations.wait(5.0)
        (event,) = watch.drain()
        assert (event.role, event.agent, event.boot_id, event.alive) == ("camera", "cam0", agent.boot_id, True)
    assert [event.alive for event in watch.drain()] == [False]
    assert device.closed


def test_status_is_published_every_second_and_reports_missing_frames() -> None:
    hub = MemoryHub()
    statuses = MemoryBus(hub).subscribe(STATUS)
    clock = iter(range(0, 10**14, 10**8))  # each look at the clock is 0.1 s later
    device = ListedDevice([0], endless=True)
    agent = CameraAgent(device, ScriptedDetector(), MemoryBus(hub), "cam0", now_ns=lambda: next(clock))
    collected: list[Any] = []
    with running(agent.run):
        assert eventually(
            lambda: bool(collected.extend(messages(statuses)) or any(m.state == "degraded" for m in collected))
        )
    assert collected[0].state == "running"
    silent = next(m for m in collected if m.state == "degraded")
    assert "no frame for" in silent.message
    assert [m.sequence for m in collected] == list(range(len(collected)))


def test_a_hanging_bus_never_delays_the_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    hub = MemoryHub()
    release = threading.Event()
    bus = MemoryBus(hub)
    publisher = bus.publisher

    def slow(*args: Any, **options: Any) -> Any:
        made = publisher(*args, **options)
        put = made.put
        made.put = lambda message: (release.wait(20.0), put(message))  # type: ignore[method-assign]
        return made

    monkeypatch.setattr(bus, "publisher", slow)
    device = ListedDevice(list(range(3000)), endless=True)
    agent = CameraAgent(device, ScriptedDetector(), bus, "cam0")
    with running(agent.run):
        assert eventually(lambda: agent.frames == 3000)  # although no message has been published
        observations = MemoryBus(hub).subscribe(OBSERVATION)
        release.set()
    sequences = [m.sequence for m in messages(observations)]
    assert sequences == list(range(len(sequences)))
    assert 900 < len(sequences) < 1100  # the queue's capacity; the rest was dropped


def test_a_dead_bus_ends_the_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = MemoryBus(MemoryHub())

    def panic(*_: object) -> None:
        raise BusDead("panic")

    monkeypatch.setattr(bus, "publisher", panic)
    clock = iter(range(0, 10**14, 10**8))  # a status is due every few looks at the clock
    device = ListedDevice([0], endless=True)
    with pytest.raises(BusDead, match="panic"):
        CameraAgent(device, ScriptedDetector(), bus, "cam0", now_ns=lambda: next(clock)).run(threading.Event())
    assert device.closed


def test_a_device_that_does_not_open_is_reported_before_the_agent_is_announced() -> None:
    hub = MemoryHub()
    watch = MemoryBus(hub).watch_agents()
    from edge.devices.playback.video_file import VideoPlayback

    with pytest.raises(InputError, match="does not exist"):
        CameraAgent(VideoPlayback(Path("gone.mp4")), ScriptedDetector(), MemoryBus(hub), "cam0").run(threading.Event())
    assert watch.drain() == []


def test_a_non_finite_detection_is_dropped_and_the_frame_is_published() -> None:
    hub = MemoryHub()
    observations = MemoryBus(hub).subscribe(OBSERVATION)
    bad = Detection(float("nan"), 1.0)
    CameraAgent(ListedDevice([0, 1]), ScriptedDetector([bad], [bad]), MemoryBus(hub), "cam0").run(threading.Event())
    assert [len(m.detections) for m in messages(observations)] == [0, 0]


def test_a_simulated_camera_from_pixels_to_messages() -> None:
    """Six seconds of rendered frames: published detections agree with the ground truth at the camera's own times."""
    hub = MemoryHub()
    observations = MemoryBus(hub).subscribe(OBSERVATION)
    scene = scenes.get_marker_scene("marker", 0)
    device = SimulatedDevice(scene, "cam0", 0, AsFastAsPossible(), duration_s=6.0)
    detector = MarkerDetector(intrinsics=device.info.intrinsics)
    agent = CameraAgent(device, detector, MemoryBus(hub), "cam0").run(threading.Event())
    got = messages(observations)
    assert len(got) == agent.frames > 150
    seen = [m for m in got if m.detections]
    assert len(seen) > 0.8 * len(got)
    clock = scene.camera("cam0").clock
    truth, _ = scene.seen_by("cam0", np.array([clock.true_time(m.device_time_ns) for m in seen]))
    found = np.array([(m.detections[0].u, m.detections[0].v) for m in seen])
    error = np.linalg.norm(found - truth, axis=1)
    assert np.median(error) < 0.15
    assert np.mean(error < 1.0) > 0.98


class WarmDevice(ListedDevice):
    """A live camera with a temperature sensor."""

    disconnected, reconnections = False, 0
    temperature: float | None = 61.5


@pytest.mark.parametrize("watched", [False, True], ids=["the device", "the device as the commands run it"])
def test_exposure_and_temperature_are_reported_where_the_device_provides_them(watched: bool) -> None:
    def last(device: ListedDevice) -> Any:
        hub = MemoryHub()
        statuses = MemoryBus(hub).subscribe(STATUS)
        used = HeartbeatDevice(device, lambda: None) if watched else device
        CameraAgent(used, ScriptedDetector(), MemoryBus(hub), "cam0").run(threading.Event())
        return messages(statuses)[-1]

    gauges = last(WarmDevice([0, 1])).gauges
    assert gauges["exposure_s"] == pytest.approx(0.004)
    assert gauges["temperature_c"] == 61.5
    silent = WarmDevice([0])
    silent.temperature = None
    assert "temperature_c" not in last(silent).gauges
    assert "temperature_c" not in last(ListedDevice([0])).gauges
    assert "exposure_s" not in last(ListedDevice([])).gauges, "no frame, no exposure"
