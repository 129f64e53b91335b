"""Steps and rate changes of a camera's clock, distinguished from dropped frames, stalls, restarts and duplicates."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from hub.clocks.change_detector import ClockChange, ClockChangeDetector
from hub.clocks.segments import ClockSegments
from protocols.core.clocks import TimeMap
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from tests.support.rigs import random_lens, random_poses

PERIOD_NS = 33_333_333


class Camera:
    """Feeds one camera's time stamps to the detector while time advances."""

    def __init__(self, epoch_ns: int = 1_700_000_000_000_000_000) -> None:
        self.detector, self.now_ns, self.number = ClockChangeDetector(), epoch_ns, 0
        self.arrival, self.events = 100.0, list[ClockChange]()

    def frames(self, count: int, *, skip: int = 0, wait_ns: int = 0, step_ns: int = 0) -> None:
        self.now_ns += wait_ns + step_ns
        self.arrival += wait_ns * 1e-9
        for _ in range(count):
            self.now_ns += PERIOD_NS * (1 + skip)
            self.arrival += PERIOD_NS * (1 + skip) * 1e-9
            self.number += 1 + skip
            self.feed()

    def feed(self) -> None:
        sequence = self.number
        _, event = self.detector.handle("cam0", "boot-1", sequence, self.number, self.now_ns, self.arrival)
        if event is not None:
            self.events.append(event)


@pytest.mark.parametrize("step_s", [10.0, -10.0, 0.5, -0.5])
def test_a_step_is_estimated_to_a_millisecond_also_on_unix_time_clocks(step_s: float) -> None:
    camera = Camera()
    camera.frames(100)
    camera.frames(100, step_ns=round(step_s * 1e9))
    (event,) = camera.events
    assert event.kind == "step"
    assert abs(event.step_s - step_s) < 1e-3
    assert camera.detector.changes_since("cam0", "boot-1") == [event]
    assert (event.previous_segment, event.segment) == ("boot-1", "boot-1-e1")


def test_dropped_frames_and_a_stall_are_not_steps() -> None:
    camera = Camera()
    camera.frames(100)
    camera.frames(5, skip=60)
    camera.frames(100, wait_ns=5_000_000_000)
    assert camera.events == []


@pytest.mark.parametrize("counts_frames", [False, True])
def test_a_machine_that_was_suspended_is_not_a_step(counts_frames: bool) -> None:
    """A frame from before the pause arrives with those after it, on a clock that went on; its device counts or not."""
    camera = Camera()
    camera.frames(100)
    camera.number, camera.now_ns, camera.arrival = camera.number + 1, camera.now_ns + PERIOD_NS, camera.arrival + 30.0
    camera.feed()
    camera.now_ns += 30_000_000_000 - PERIOD_NS
    camera.number += counts_frames * 890  # of 899: the rate of its last frames was not quite that of the pause
    camera.frames(100)
    assert camera.events == []
    camera.frames(60, step_ns=10_000_000_000)
    assert [event.step_s for event in camera.events] == pytest.approx([10.0], abs=1e-3)


@pytest.mark.parametrize(("step_ns", "steps"), [(0, 0), (500_000_000, 1)])
def test_a_late_frame_after_a_pause_is_no_step(step_ns: int, steps: int) -> None:
    """Over a link with 0.3 s of jitter; a clock that is set forward makes the frame seem earlier."""
    camera = Camera()
    camera.frames(100)
    camera.now_ns, camera.number = camera.now_ns + 500_000_000, camera.number + 1
    camera.arrival += (500_000_000 - step_ns) * 1e-9 + 0.25 * (not step_ns)
    camera.feed()
    camera.arrival -= 0.25 * (not step_ns)
    camera.frames(100)
    assert len(camera.events) == steps


@pytest.mark.parametrize(("step_s", "late_s"), [(0.45, 0.25), (1.0, 0.55), (5.0, 2.6)])
def test_a_step_whose_first_frame_is_late_is_found_by_those_after_it(step_s: float, late_s: float) -> None:
    """Late by half the step, it was taken for a pause, and the step missed for good."""
    camera = Camera()
    camera.frames(100)
    camera.arrival += late_s
    camera.frames(1, step_ns=round(step_s * 1e9))
    camera.arrival -= late_s
    camera.frames(100)
    (event,) = camera.events
    assert event.step_s == pytest.approx(step_s, abs=1e-3)


def test_a_pause_after_frames_that_came_all_at_once_is_no_step() -> None:
    """A hub was restarted: how late the backlog came says nothing of what came after it."""
    detector, events = ClockChangeDetector(), list[ClockChange]()
    for number in range(300):
        true = number / 30.0 + 5.0 * (number >= 100)
        _, event = detector.handle("cam0", "b", number, number, round(1e9 * true), 100.0 + max(true, 6.0))
        events += [] if event is None else [event]
    assert events == []


@pytest.mark.parametrize("knows", [True, False])
@pytest.mark.parametrize(("step_s", "steps"), [(0.45, 0), (30.0, 0), (-0.45, 1), (1.7e9, 1)])
def test_of_frames_that_waited_for_the_hub_a_pause_is_no_step(step_s: float, steps: int, knows: bool) -> None:
    """A hub was restarted just after a camera had stalled without counting its frames: its pose was not used again."""
    detector, events = ClockChangeDetector(), list[ClockChange]()
    for number in range(200):
        shown = round(1e9 * (number / 30.0 + step_s * (number >= 100)))
        waited = number < 150
        # Over a slow link it takes longer than the hub waits for a backlog.
        arrival = 50.0 + max(number, 150) / 30.0 if not waited or not knows else None
        _, event = detector.handle("cam0", "b", number, number, shown, arrival, waited=waited and knows)
        events += [] if event is None else [event]
    assert [event.kind for event in events] == ["step"] * steps


@pytest.mark.parametrize("seed", range(5))
def test_many_missing_frames_of_jittered_stamps_are_not_a_step(seed: int) -> None:
    """Without times of arrival, as of a log: what the period is known to must do for 30 s of it."""
    rng, detector, events = np.random.default_rng(seed), ClockChangeDetector(), list[ClockChange]()
    for number in [*range(150), *range(1050, 1200)]:
        shown = number / 30.0 + float(rng.normal(0.0, 5e-3))
        _, event = detector.handle("cam0", "b", number, number, round(shown * 1e9), None)
        events += [] if event is None else [event]
    assert events == []


def test_consecutive_steps_are_detected() -> None:
    camera = Camera()
    camera.frames(60)
    camera.frames(60, step_ns=10_000_000_000)
    camera.frames(60, step_ns=-4_000_000_000)
    steps = [event.step_s for event in camera.detector.changes_since("cam0", "boot-1")]
    assert steps == pytest.approx([10.0, -4.0], abs=1e-3)
    assert [event.step_s for event in camera.detector.changes_since("cam0", "boot-1-e1")] == pytest.approx(
        [-4.0], abs=1e-3
    )


def test_duplicates_belong_to_their_own_segment() -> None:
    camera = Camera()
    camera.frames(60)
    old = camera.now_ns
    camera.frames(10, step_ns=10_000_000_000)
    name, event = camera.detector.handle("cam0", "boot-1", 30, 30, old - 30 * PERIOD_NS, None)
    assert (name, event) == ("boot-1", None)
    name, _ = camera.detector.handle("cam0", "boot-1", 65, 65, camera.now_ns, None)
    assert name == "boot-1-e1"


def _drifting(
    seconds: float, late: Callable[[float], float], ppm: float = 0.0, at_s: float = 30.0
) -> list[ClockChange]:
    """Changes detected on a camera whose frames arrive ``late(true time)`` seconds after exposure."""
    detector, events = ClockChangeDetector(), list[ClockChange]()
    for number in range(round(seconds * 30)):
        true = number / 30.0
        shown = true + 1e-6 * ppm * max(0.0, true - at_s)
        _, event = detector.handle("cam0", "boot-1", number, number, round(shown * 1e9), 100.0 + true + late(true))
        events += [] if event is None else [event]
    return events


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_a_rate_change_is_detected_within_seconds(ppm: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    events = _drifting(45.0, lambda true: 0.002 + float(rng.exponential(0.001)), ppm)
    assert [event.kind for event in events] == ["drift"]
    assert events[0].rate_change == pytest.approx(1e-6 * ppm, abs=1.2e-4)


def _detected(ppm: float, seed: int, late_s: float, seconds: float) -> tuple[ClockChangeDetector, float, float]:
    """Detector of a clock whose rate changes at 30 s, the delay of detection [s], and the clock's time then [s]."""
    detector, rng = ClockChangeDetector(), np.random.default_rng([seed, 2])
    detected = shown_then = None
    for number in range(round(seconds * 30)):
        true = number / 30.0
        shown = true + 1e-6 * ppm * max(0.0, true - 30.0)
        arrival = 100.0 + true + 0.002 + float(rng.exponential(late_s))
        _, event = detector.handle("cam0", "b", number, number, round(shown * 1e9), arrival)
        if event is not None and detected is None:
            detected, shown_then = true - 30.0, shown
    assert detected is not None
    assert shown_then is not None
    return detector, detected, shown_then


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_on_a_wired_link_a_rate_change_is_detected_before_the_error_is_a_millisecond(ppm: float, seed: int) -> None:
    _, detected, _ = _detected(ppm, seed, 3e-4, 36.0)
    assert 0.0 < detected < 3.5


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_a_rate_change_is_refined_by_the_seconds_after(ppm: float, seed: int) -> None:
    """Rate and onset are refined, so that a map extrapolated by 20 s is accurate to a quarter of a millisecond."""
    detector, detected, shown_then = _detected(ppm, seed, 3e-4, 50.0)
    (event,) = detector.changes_since("cam0", "b")
    assert detector.change_into(event.segment) == event
    assert event.detected_at_s == pytest.approx(shown_then, abs=1e-6)
    assert event.rate_change == pytest.approx(1e-6 * ppm, abs=8e-6)
    assert event.step_s + event.rate_change * 20.0 == pytest.approx(1e-6 * ppm * (detected + 20.0), abs=2.5e-4)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("late_s", [0.005, 0.015, 0.03])
def test_random_delays_of_a_link_are_no_rate_change(late_s: float, seed: int) -> None:
    rng = np.random.default_rng([seed, 3])
    assert _drifting(600.0, lambda true: 0.002 + float(rng.exponential(late_s))) == []


@pytest.mark.parametrize("seed", range(6))
def test_a_longer_route_is_no_rate_change(seed: int) -> None:
    """Delays step by up to a millisecond and stay."""
    rng = np.random.default_rng([seed, 4])
    at, level = np.sort(rng.uniform(20.0, 300.0, 14)), np.append(0.0, rng.uniform(0.0, 1e-3, 14))

    def late(true: float) -> float:
        return 2e-3 + float(level[np.searchsorted(at, true)]) + float(rng.exponential(3e-4))

    assert _drifting(300.0, late) == []


def test_slopes_of_false_alarms_raise_the_threshold() -> None:
    """Delays that rise by 0.6 ms in 3 s once a minute cause at most two false alarms in ten minutes."""
    rng = np.random.default_rng(5)

    def late(true: float) -> float:
        rise = float(np.interp(true % 61.7, [0.0, 3.0, 8.0, 11.0], [0.0, 6e-4, 6e-4, 0.0]))
        return 2e-3 + rise * (true > 40.0) + float(rng.exponential(1e-4))

    assert len(_drifting(640.0, late)) <= 2


@pytest.mark.parametrize("step_s", [30.0, -0.5])
def test_delays_refine_a_step_that_jittered_frames_give_badly(step_s: float) -> None:
    """With 2 ms of frame jitter a step is known to 3 ms at once and to 0.1 ms after 3 s."""
    rng, detected, refined = np.random.default_rng(6), list[float](), list[float]()
    for _ in range(20):
        detector, events = ClockChangeDetector(), list[ClockChange]()
        for number in range(600):
            true = number / 30.0 + float(np.clip(rng.normal(0.0, 2e-3), -0.01, 0.01))
            shown = 1.0001 * true + step_s * (number > 400)
            arrival = 100.0 + true + 0.002 + float(rng.exponential(3e-4))
            _, event = detector.handle("cam0", "b", number, number, round(shown * 1e9), arrival)
            events += [] if event is None else [event]
        (event,) = events
        (now,) = detector.changes_since("cam0", "b")
        detected.append(event.step_s - step_s)
        refined.append(now.step_s - step_s)
        assert now.step_std_s < 5e-5
    assert np.std(detected) > 1e-3
    assert np.std(refined) < 1e-4


def test_delays_that_step_with_the_clock_do_not_refine_its_step() -> None:
    """A camera that returns over a route 50 ms longer: the estimate from the two time stamps is kept."""
    camera = Camera()
    camera.frames(300)
    camera.arrival += 0.05
    camera.frames(200, step_ns=10_000_000_000)
    (event,) = camera.detector.changes_since("cam0", "boot-1")
    assert event.step_s == pytest.approx(10.0, abs=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_growing_delays_are_no_rate_change(seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    wander = np.cumsum(rng.normal(0.0, 0.01, 200))  # a busy machine: 10 ms more or less each second
    swamped = 0.06 * rng.random()

    def late(true: float) -> float:
        return 1.0 + float(np.interp(true, np.arange(200), wander)) + swamped * max(0.0, true - 60.0)

    assert _drifting(120.0, late) == []


@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_a_time_map_follows_a_rate_change_from_its_detection(ppm: float) -> None:
    """Until the new segment is calibrated the moved map is used: within 1 ms 20 s later."""
    rng = np.random.default_rng(8)
    segments, origin, changed = ClockSegments(), 1.7e9, 30.0
    shown = lambda true: true + 1e-6 * ppm * max(0.0, true - changed)  # noqa: E731
    detected = None
    for frame in range(30 * 40):
        true = frame / 30.0
        message = pb.Observation(
            camera="cam0", boot_id="b", sequence=frame, frame=frame, device_time_ns=round((origin + shown(true)) * 1e9)
        )
        _, event = segments.assign(message, 5.0 + true + 2e-3 + float(rng.exponential(3e-4)))
        detected = true if detected is None and event is not None else detected
    assert detected is not None
    time_map, pose = TimeMap(time_offset=-origin, clock_rate=1.0), random_poses(rng, 1)[0]
    eye = CameraCalibration("cam0", random_lens(rng), pose, time_map, 1e-4, np.zeros(3), 0.5)
    known = Calibration({"cam0": eye}, "cam1", "metric", "m", "joint", "1")
    present, _ = segments.to_present(known, {"cam0": "b"})
    now = present.cameras["cam0"]
    for true in (detected, detected + 10.0, detected + 20.0):
        off = now.time_map.clock_rate * (origin + shown(true)) + now.time_map.time_offset - true
        assert abs(off) < 1e-3
    assert now.time_offset_std > 1e-4
    assert now.lag_std > 1e-4  # the one that is published


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_false_alarm_is_not_extrapolated(sign: float) -> None:
    """Delays that rise or fall by 1 ms in 3 s and stay: 20 s later hardly any rate change remains."""
    rng, detector, detected = np.random.default_rng(9), ClockChangeDetector(), list[ClockChange]()
    for number in range(30 * 55):
        true = number / 30.0
        late = sign * float(np.interp(true, [30.0, 33.0], [0.0, 1e-3])) + 1e-5 * float(rng.random())
        _, event = detector.handle("cam0", "b", number, number, round(true * 1e9), 100.0 + true + late)
        detected += [] if event is None else [event]
    (first,) = detected
    assert abs(first.rate_change) > 2e-4
    (event,) = detector.changes_since("cam0", "b")
    assert abs(event.rate_change) < 1.5e-4
    assert abs(event.step_s + event.rate_change * (55.0 - event.detected_at_s)) < 2.5e-3


@pytest.mark.parametrize(("late_s", "ppm", "remains"), [(3e-3, 0.0, False), (0.0, -300.0, True)])
def test_an_alarm_that_the_seconds_after_do_not_confirm_is_withdrawn(late_s: float, ppm: float, remains: bool) -> None:
    """A hub that has just begun is busy for seconds, and frames are late by less and less."""
    segments, rng, seen = ClockSegments(), np.random.default_rng(8), set[str]()
    for number in range(30 * 60):
        true = number / 30.0
        shown = true + 1e-6 * ppm * max(0.0, true - 25.0)
        late = 2e-3 + late_s / (1.0 + math.exp(true - 25.0)) + float(rng.exponential(3e-4))
        message = pb.Observation(camera="cam0", boot_id="b", sequence=number, frame=number)
        message.device_time_ns = round(shown * 1e9)
        segments.assign(message, 100.0 + true + late)
        seen |= segments.alarms.keys()
    assert seen == {"cam0"}
    assert [text.split()[4] for text in segments.alarms.values()] == (["drifts"] if remains else [])
    (change,) = segments._detector.changes_since("cam0", "b")
    assert change.rate_change == pytest.approx(1e-6 * ppm, abs=5e-6)
    assert change.step_s == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize("ppm", [500.0, -500.0])
@pytest.mark.parametrize("seconds", [4.0, 8.0, 15.0])
def test_the_std_of_a_withdrawn_alarm_covers_a_slew_that_has_ended(ppm: float, seconds: float) -> None:
    """NTP had moved the clock by 2 to 7.5 ms, and its stated std was 0.3 ms."""
    rng, detector = np.random.default_rng(8), ClockChangeDetector()
    for number in range(30 * 60):
        true = number / 30.0
        shown = true + 1e-6 * ppm * min(max(0.0, true - 25.0), seconds)
        detector.handle("cam0", "b", number, number, round(shown * 1e9), 100.0 + true + float(rng.exponential(3e-4)))
    (change,) = detector.changes_since("cam0", "b")
    shift = 1e-6 * ppm * seconds
    assert change.rate_change == 0.0
    assert abs(shift - change.step_s) < 1.2 * change.step_std_s < 1.5 * abs(shift)
