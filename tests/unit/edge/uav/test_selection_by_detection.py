"""A point that the operator selects becomes the box of the object detected there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from edge.agents.uav import UavAgent
from edge.agents.uav_settings import UavSettings
from edge.detectors.base import Detection, Detector
from edge.devices.base import Frame
from edge.mavlink.link.connection import Link
from edge.mavlink.roles.camera import SelectTarget
from edge.mavlink.roles.camera_messages import TrackingStatus
from edge.mavlink.roles.vehicle import Vehicle

BOXES = [(100.0, 100.0, 80.0, 60.0), (120.0, 110.0, 30.0, 20.0), (400.0, 300.0, 50.0, 40.0)]


class Boxes:
    def detect(self, image: Any, time_s: float | None = None, predictions: Any = ()) -> list[Detection]:
        return [Detection(0.0, 0.0, kind="vehicle", box=box) for box in BOXES] + [Detection(1.0, 1.0)]


def agent_with(detector: Detector | None, said: list[str] | None = None) -> UavAgent:
    """An agent without connections; what it sends the stations is appended to ``said``."""
    say = [].append if said is None else said.append
    anything = cast(Any, SimpleNamespace(begin=lambda position: None, say=say, status=TrackingStatus(), info=None))
    vehicle = Vehicle(cast(Link, anything), gimbal=False)
    settings = UavSettings((640, 480), 30.0, None, None, model="plain")
    return UavAgent(anything, anything, vehicle, lambda execute: anything, anything, "uav", settings, detector=detector)


def selected(detector: Detector | None, u: float, v: float, radius: float = 0.0) -> list[float]:
    """The box [px] that is tracked after the point (u, v) of a 640x480 image was selected."""
    agent = agent_with(detector)
    boxes: list[list[float]] = []
    agent._publish = lambda message: boxes.append(list(getattr(message, "box", ())))
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    agent._take_frame(Frame(image, 0, 10**9), 10**9)
    assert agent._execute(SelectTarget(u / 640, v / 480, u / 640, v / 480, 255, radius))
    return next(box for box in boxes if len(box) == 4)


def test_the_smallest_box_around_the_point_is_selected() -> None:
    assert selected(Boxes(), 130.0, 120.0) == pytest.approx([119.5, 109.5, 30.0, 20.0])
    assert selected(Boxes(), 105.0, 150.0) == pytest.approx([99.5, 99.5, 80.0, 60.0])


def test_where_nothing_is_detected_the_box_is_around_the_point() -> None:
    for detector in (Boxes(), None):
        x, y, width, height = selected(detector, 300.0, 50.0)
        assert (x + 0.5 * width, y + 0.5 * height) == pytest.approx((299.5, 49.5))


def test_a_point_with_a_radius_selects_what_is_within_it() -> None:
    assert selected(None, 300.0, 150.0, radius=0.1) == pytest.approx([235.5, 85.5, 128.0, 128.0])  # of 640 px
    assert selected(Boxes(), 130.0, 120.0, radius=0.1)[2:] == pytest.approx([30.0, 20.0])  # what is there is known


def test_a_selection_on_a_black_image_is_refused_and_stations_get_a_text() -> None:
    said: list[str] = []
    agent = agent_with(None, said)
    agent._take_frame(Frame(np.zeros((480, 640, 3), np.uint8), 0, 10**9), 10**9)
    assert not agent._execute(SelectTarget(0.5, 0.5, 0.5, 0.5, 255))
    assert said == ["Syncline: nothing to track there, select again"]
    assert len(said[0]) <= 50
