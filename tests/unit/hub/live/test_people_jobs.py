"""Jobs of unlabelled people: at which lags they are compared, and what is said of a camera that they do not place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.incremental import Update
from hub.calibration.people.ways import first_complete
from hub.clocks.external_prior import ExternalClockPrior
from hub.clocks.observation_stream import ObservationStream
from hub.live.solver import _at_its_lags
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration

LENS = Intrinsics(640, 480, np.array([[450.0, 0, 319.5], [0, 450.0, 239.5], [0, 0, 1.0]]))


def camera(name: str, offset: float) -> CameraCalibration:
    pose = Pose(np.eye(3), np.zeros(3))
    return CameraCalibration(name, LENS, pose, TimeMap(1.0, offset), 1e-3, np.zeros(3), 1.0)


def answer(*cameras: CameraCalibration) -> Calibration:
    return Calibration({one.name: one for one in cameras}, cameras[0].name, "metric", "m", "joint", "1")


def frame(name: str, at: float, people: int = 2, boot: str = "b") -> pb.Observation:
    detections = [pb.Detection(u=9.0 * i, v=5.0, kind="person") for i in range(people)]
    stamp = round(at * NANOSECONDS)
    return pb.Observation(schema_version=1, camera=name, boot_id=boot, device_time_ns=stamp, detections=detections)


def test_a_new_camera_is_compared_at_the_lag_of_the_times_of_arrival() -> None:
    """On the reference clock of the answer, while the arrivals are on the hub's."""
    last = answer(camera("a", 0.0), camera("b", 5.0))
    common = {name: ExternalClockPrior("", lag, 0.15) for name, lag in (("a", 1e9), ("b", 1e9 + 5.1), ("c", 1e9 - 7.0))}
    priors = _at_its_lags(last, [frame("a", 10.0), frame("b", 5.0), frame("c", 17.0)], common)
    assert [priors[name].unix_minus_camera for name in "abc"] == pytest.approx([0.0, 5.0, -7.05], abs=1e-6)
    assert [priors[name].error_bound for name in "abc"] == [0.0, 0.0, 0.3]
    assert _at_its_lags(last, [frame("a", 10.0), frame("c", 17.0)], {}).keys() == {"a"}


def test_frames_are_held_of_the_present_clock_within_a_window_and_of_some_cameras() -> None:
    stream = ObservationStream(180.0)
    for moment in np.arange(0.0, 100.0, 0.05).tolist():
        stream.store(frame("a", moment))
    held = stream.several_people()["a"]
    assert 600 < len(held) <= 670
    assert held[0].device_time_ns >= 39.0 * NANOSECONDS
    stream.store(frame("a", 5.0, boot="next"))
    assert [one.boot_id for one in stream.several_people()["a"]] == ["next"]
    for number in range(40):
        stream.store(frame(f"cam{number}", 5.0))
    assert len(stream.several_people()) == 24
    stream.release("a")
    assert "a" not in stream.several_people()
    stream.forget()
    for moment in range(20):
        stream.store(frame("a", float(moment), people=1))
    assert stream.several_people() == {}, "one walker has labels of his own"


def test_the_second_way_is_tried_where_the_first_leaves_a_camera_out() -> None:
    two, three = Update(answer(camera("a", 0.0), camera("b", 0.0))), Update(answer(*(camera(n, 0.0) for n in "abc")))

    def refuse(reason: str) -> Update:
        raise Refused(reason)

    assert first_complete([lambda: two, lambda: three], "ab") is two
    assert first_complete([lambda: two, lambda: three], "abc") is three
    assert first_complete([lambda: two, lambda: refuse("no")], "abc") is two
    assert first_complete([lambda: replace(two), lambda: refuse("no")], "abcd").calibration is two.calibration
    with pytest.raises(Refused, match="by colour: alike; by where people stand: nobody"):
        first_complete([lambda: refuse("alike"), lambda: refuse("nobody")], "abc")
