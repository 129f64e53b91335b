"""Jobs of unlabelled people: at which lags they are compared, and what is said of a camera that they do not place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.incremental import Update
from hub.calibration.people.ways import first_complete
from hub.clocks.external_prior import ExternalClockPrior
from hub.clocks.observation_stream import ObservationStream
from hub.live.live_hub import KnownCalibration, LiveHub
from hub.live.solver import InlineSolver, SolverJob, _at_its_lags, _ways, run_job
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig, RigCamera

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
    priors = _at_its_lags(last, [frame("a", 10.0), frame("b", 5.0), frame("c", 17.0)], [common])
    assert [priors[name].unix_minus_camera for name in "abc"] == pytest.approx([0.0, 5.0, -7.05], abs=1e-6)
    assert [priors[name].error_bound for name in "abc"] == [0.0, 0.0, 0.3]
    assert _at_its_lags(last, [frame("a", 10.0), frame("c", 17.0)], ()).keys() == {"a"}
    unix = {name: ExternalClockPrior("", 2e9 + lag, 0.01) for name, lag in (("a", 0.0), ("c", -7.01))}
    both = _at_its_lags(last, [frame("a", 10.0), frame("b", 5.0), frame("c", 17.0)], [common, unix])
    assert both["c"].unix_minus_camera == pytest.approx(-7.01), "NTP, and the hub's clock is another one"


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


def test_frames_of_who_left_long_ago_are_not_of_the_same_film() -> None:
    stream = ObservationStream(180.0)
    for moment in np.arange(0.0, 60.0, 0.1).tolist():
        stream.store(frame("a", moment), moment)
    for moment in np.arange(3600.0, 3660.0, 0.1).tolist():
        stream.store(frame("b", moment), moment)
        stream.store(frame("c", moment), moment)
    assert stream.several_people(3660.0).keys() == {"b", "c"}
    for number in range(30):
        stream.store(frame(f"cam{number}", 1.0), 3661.0)
    for moment in np.arange(4000.0, 4060.0, 0.1).tolist():
        stream.store(frame("late", moment), moment)
    assert stream.several_people(4060.0).keys() == {"late"}, "places of those that are silent are free again"


def test_frames_that_waited_or_follow_a_wrong_stamp_are_held() -> None:
    stream = ObservationStream(180.0)
    for moment in [*np.arange(30.0, 40.0, 0.1).tolist(), *np.arange(20.0, 30.0, 0.1).tolist()]:
        stream.store(frame("a", moment), 50.0)
    held = [one.device_time_ns for one in stream.several_people(50.0)["a"]]
    assert len(held) == 200
    assert held == sorted(held)
    for moment in [1e6, *np.arange(40.0, 60.0, 0.1).tolist()]:
        stream.store(frame("a", moment), 60.0)
    held = [one.device_time_ns for one in stream.several_people(60.0)["a"]]
    assert len(held) == 400, "all but the one of the future"


def test_what_is_held_of_a_frame_is_its_people() -> None:
    stream, message = ObservationStream(180.0), frame("a", 1.0)
    for one in message.detections:
        one.label = "x" * 2000
    message.detections.extend(pb.Detection(u=9.0, v=5.0, kind="car") for _ in range(200))
    stream.store(message)
    assert stream.several_people()["a"][0].ByteSize() < 200


@pytest.mark.parametrize("by_place", [False, True])
def test_a_job_without_people_is_by_labels_whatever_the_last_answer_was_by(by_place: bool) -> None:
    """A marker that is brought after people: every job failed, and one camera after another was left out."""
    job = SolverJob(1, Rig({}), Observations({}), answer(camera("a", 0.0)), by_place=by_place)
    assert len(_ways(job)) == 1
    assert not job.compares_places
    assert not run_job(job).failed


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


def test_a_given_calibration_is_published_while_it_is_tested() -> None:
    """By people a test takes half a minute of CPU, in which a listener that had just joined knew of no calibration."""

    class Busy(InlineSolver):
        @property
        def busy(self) -> bool:
            return True

    known = answer(camera("a", 0.0), camera("b", 5.0))
    rig = Rig({name: RigCamera(name, (640, 480), 30.0, LENS) for name in "ab"}, metadata={"reference": "a"})
    hub = LiveHub(solver=Busy(), known=KnownCalibration(rig, known.cameras))
    found = [one for now in range(8) for one in hub.tick(float(now)) if isinstance(one, pb.Calibration)]
    assert len(found) >= 3
