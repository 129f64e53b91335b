"""The messages that live tracking publishes, and when."""

from __future__ import annotations

from functools import cache

import numpy as np
from google.protobuf.message import Message

from edge import scenes
from hub.tracking.live_tracking import LiveTracking
from protocols.core.clocks import NANOSECONDS
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration
from tests.support.people_traffic import film


@cache
def published(every_s: float, live: LiveTracking | None = None) -> list[Message]:
    """Messages of a hub that ticks every ``every_s``, for three seconds of two people in three cameras."""
    scene = scenes.get_people_scene(3, 3, 2)
    traffic = film(scene, 3.0, 3)
    cameras = {}
    for camera in scene.cameras:
        time_map = scene.true_time_map(camera.name, traffic.reference)
        cameras[camera.name] = CameraCalibration(
            camera.name, camera.intrinsics, camera.pose, time_map, 1e-4, np.zeros(3), 0.5
        )
    live, due, out = live or LiveTracking(), 0.0, []
    live.calibrate(cameras, {}, reference=traffic.reference, scale="metric", units="m", up=np.array([0.0, 0.0, 1.0]))
    for arrival, message in traffic.arrivals:
        live.handle(message)
        if arrival >= due:
            due = arrival + every_s
            out += live.tick(arrival)
    return out


def tracks(every_s: float) -> list[pb.Track]:
    return [message for message in published(every_s) if isinstance(message, pb.Track)]


def test_a_delayed_hub_publishes_the_missed_times() -> None:
    """Its tracks have no gaps, are in order of time, and have the labels of a punctual hub."""
    late, punctual = tracks(0.4), tracks(0.0)
    times = [track.reference_time_ns for track in late]
    assert times == sorted(times)
    assert np.diff(times).max() < 0.15 * NANOSECONDS
    assert [track.sequence for track in late] == list(range(len(late)))
    assert {track.label for track in late} == {track.label for track in punctual}
    assert len({track.label for track in late}) == 2


def test_no_predictions_are_published_for_past_times() -> None:
    predictions = [message for message in published(0.4) if isinstance(message, pb.Prediction)]
    assert 5 <= len(predictions) <= 9


def test_without_predictions_the_tracks_are_the_same_and_each_prediction_left_out_is_counted() -> None:
    live = LiveTracking()
    live.predicts = False
    assert published(0.4, live) == tracks(0.4)
    left_out = sum(isinstance(message, pb.Prediction) for message in published(0.4))
    assert live.counters["shed.predictions"] == left_out
