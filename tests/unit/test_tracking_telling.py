"""What a live hub tells of its tracks, and when."""

from __future__ import annotations

from functools import cache

import numpy as np
from google.protobuf.message import Message

from edge import scenes
from hub.tracking.live_tracking import LiveTracking
from protocols.core.clocks import NANOSECONDS
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration
from tests.people_traffic import film


@cache
def told(every_s: float) -> list[Message]:
    """What a hub that comes to look every so often tells of three seconds of two people in three cameras."""
    scene = scenes.get_people(3, 3, 2)
    traffic = film(scene, 3.0, 3)
    cameras = {}
    for camera in scene.cameras:
        time_map = scene.true_time_map(camera.name, traffic.reference)
        cameras[camera.name] = CameraCalibration(
            camera.name, camera.intrinsics, camera.pose, time_map, 1e-4, np.zeros(3), 0.5
        )
    live, due, out = LiveTracking(), 0.0, []
    live.calibrate(cameras, {}, reference=traffic.reference, scale="metric", units="m", up=np.array([0.0, 0.0, 1.0]))
    for arrival, message in traffic.arrivals:
        live.handle(message)
        if arrival >= due:
            due = arrival + every_s
            out += live.tick(arrival)
    return out


def tracks(every_s: float) -> list[pb.Track]:
    return [message for message in told(every_s) if isinstance(message, pb.Track)]


def test_a_hub_that_was_held_up_tells_what_happened_meanwhile() -> None:
    """Its tracks have no holes, come in the order of time, and are those of a punctual hub."""
    late, punctual = tracks(0.4), tracks(0.0)
    times = [track.reference_time_ns for track in late]
    assert times == sorted(times)
    assert np.diff(times).max() < 0.15 * NANOSECONDS
    assert [track.sequence for track in late] == list(range(len(late)))
    assert {track.label for track in late} == {track.label for track in punctual}
    assert len({track.label for track in late}) == 2


def test_of_what_is_past_nothing_is_foretold() -> None:
    predictions = [message for message in told(0.4) if isinstance(message, pb.Prediction)]
    assert 5 <= len(predictions) <= 9
