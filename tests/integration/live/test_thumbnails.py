"""Thumbnails for the live view: content, size, and published only while there is a subscriber."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from edge.agents.camera import CameraAgent
from edge.agents.thumbnails import thumbnail_message
from edge.devices.base import DeviceInfo, Frame
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.topics import OBSERVATION, PICTURE
from protocols.validation.codec import encode
from tests.integration.live.test_camera_agent import ScriptedDetector
from tests.support.samples import eventually
from tests.support.threads import running


def square_image(width: int, height: int) -> np.ndarray:
    """Grey, with a white square at three quarters of the width and a quarter of the height."""
    image = np.full((height, width, 3), 60, np.uint8)
    x, y, half = 3 * width // 4, height // 4, width // 20
    image[y - half : y + half, x - half : x + half] = 255
    return image


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (641, 479), (320, 240), (100, 80)])
def test_a_thumbnail_shows_the_same_content_at_the_same_position(width: int, height: int) -> None:
    message = thumbnail_message(Frame(square_image(width, height), 5, 7), "cam0", "boot-1")
    assert (message.width, message.height, message.frame) == (width, height, 7)
    image = cv2.imdecode(np.frombuffer(message.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert image.shape[1] == min(width, 320)
    place = np.argwhere(image > 160).mean(axis=0) / image.shape
    assert place == pytest.approx([0.25, 0.75], abs=0.01)
    assert len(encode(message)) < 20_000


class EndlessDevice:
    """A frame every 5 ms."""

    info = DeviceInfo(640, 480, 200.0, "endless", "monotonic")
    ended = False

    def __init__(self) -> None:
        self._number = 0
        self._image = square_image(640, 480)

    def open(self) -> None: ...

    def close(self) -> None: ...

    def read(self, timeout_s: float) -> Frame | None:
        time.sleep(0.005)
        self._number += 1
        image = self._image.copy()
        image[::4, ::4] = self._number % 250  # an identical image would count as a frozen camera
        return Frame(image, self._number * 5_000_000, self._number)


@pytest.mark.parametrize("rate", [20.0, 0.0])
def test_thumbnails_are_published_to_subscribers_unless_disabled(rate: float) -> None:
    network = MemoryHub()
    with MemoryBus(network) as agents, MemoryBus(network) as bus:
        observations = bus.subscribe(OBSERVATION)
        agent = CameraAgent(EndlessDevice(), ScriptedDetector(), agents, "cam0", pictures_hz=rate)  # type: ignore[arg-type]
        with running(agent.run):
            assert eventually(lambda: bool(observations.drain()))
            sent = [publisher for publisher in network.publishers if publisher.key.endswith("/picture")]
            assert [len(publisher.cache) for publisher in sent] == [0], "no subscriber yet"
            pictures = bus.subscribe(PICTURE)
            came = eventually(lambda: bool(pictures.drain()), 10.0 if rate else 1.5)
            assert came == (rate > 0.0)
