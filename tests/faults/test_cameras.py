"""Cameras that stall, freeze, go black, are unplugged: told in time, and nothing stale is published."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from edge.camera_agent import run_camera_agent
from edge.detectors.base import Detection
from edge.devices.base import DeviceInfo, Frame
from protocols.bus.memory import MemoryBus, MemoryHub
from protocols.catalogue import OBSERVATION, STATUS
from protocols.errors import InputError
from protocols.messages import syncline_pb2 as pb
from tests.faults.matrix import measured

PERIOD_S = 1 / 30


class Flawed:
    """A live camera at 30 Hz with noise in its pictures, until ``flaw`` is set."""

    def __init__(self, flaw: str) -> None:
        self.info = DeviceInfo(64, 48, 30.0, "video", "monotonic")
        self.kind, self.flaw, self.gone = flaw, threading.Event(), False
        self._rng, self._number = np.random.default_rng(0), 0
        self._frozen: np.ndarray | None = None

    @property
    def ended(self) -> bool:
        return self.gone

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def read(self, timeout_s: float) -> Frame | None:
        if self.flaw.is_set() and self.kind == "stalled":
            time.sleep(3.0)  # as OpenCV does with a network stream that has fallen silent
            return None
        if self.flaw.is_set() and self.kind == "unplugged":
            time.sleep(min(timeout_s, 0.05))
            return None
        time.sleep(PERIOD_S)
        image = self._rng.integers(40, 200, (48, 64, 3), dtype=np.uint8)
        if self.flaw.is_set() and self.kind == "black":
            image = self._rng.integers(0, 6, (48, 64, 3), dtype=np.uint8)
        if self.flaw.is_set() and self.kind == "frozen":
            self._frozen = image if self._frozen is None else self._frozen
            image = self._frozen.copy()
        self._number += 1
        return Frame(image, time.monotonic_ns(), self._number)


class Bright:
    """Sees a marker in every picture that is not black."""

    def detect(self, image: np.ndarray, *_: object) -> list[Detection]:
        return [Detection(1.0, 2.0)] if image.max() > 20 else []


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("stalled", "no frame for"),
        ("frozen", "frozen: the same picture"),
        ("black", "black picture"),
        ("unplugged", "no frame for"),
    ],
)
def test_a_camera_that_does_not_see_is_told_and_publishes_nothing_stale(kind: str, words: str) -> None:
    hub = MemoryHub()
    device, stop = Flawed(kind), threading.Event()
    observations, statuses = MemoryBus(hub).subscribe(OBSERVATION), MemoryBus(hub).subscribe(STATUS)
    agent = threading.Thread(target=_run, args=(device, MemoryBus(hub), stop), daemon=True)
    agent.start()
    told: list[pb.AgentStatus] = []

    def hears(condition: Callable[[pb.AgentStatus], bool]) -> Callable[[], bool]:
        def heard() -> bool:
            told.extend(item.message for item in statuses.drain())  # type: ignore[misc]
            return any(condition(status) for status in told)

        return heard

    _until(hears(lambda status: status.state == "running"))
    time.sleep(0.5)
    assert len(observations.drain()) > 5
    device.flaw.set()
    began = time.monotonic()
    seconds = _until(hears(lambda status: status.state == "degraded" and words in status.message))
    time.sleep(1.0)
    stale = [
        item.message
        for item in observations.drain()
        if item.message.device_time_ns * 1e-9 > began + 2 * PERIOD_S and len(item.message.detections)  # type: ignore[attr-defined]
    ]
    if kind not in ("stalled", "unplugged"):
        told.clear()
        device.flaw.clear()
        _until(hears(lambda status: status.state == "running"))
        assert len(observations.drain()) >= 0
    stop.set()
    agent.join(10.0)
    measured(
        f"camera {kind}", "told ≤ 2 s, nothing stale published", f"{seconds:.2f} s, {len(stale)} stale", seconds <= 2.0
    )
    assert stale == []


def test_a_camera_that_is_gone_for_good_ends_its_agent_with_the_reason() -> None:
    device = Flawed("unplugged")
    device.gone = True
    with pytest.raises(InputError, match="camera cam0 is gone; plug it in"):
        run_camera_agent(device, Bright(), MemoryBus(MemoryHub()), "cam0", threading.Event())


def _run(device: Flawed, bus: MemoryBus, stop: threading.Event) -> None:
    run_camera_agent(device, Bright(), bus, "cam0", stop)


def _until(condition: Callable[[], bool], timeout_s: float = 10.0) -> float:
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < timeout_s
        time.sleep(0.01)
    return time.monotonic() - began
