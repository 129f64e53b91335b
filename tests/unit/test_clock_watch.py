"""Steps and drifts of a camera's clock, told from dropped frames, stalls, restarts and duplicates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hub.clocks.change_detector import ClockEvent, ClockWatch
from hub.clocks.segments import ClockEpochs
from protocols.core.clocks import TimeMap
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from tests.rigs import random_lens, random_poses

PERIOD_NS = 33_333_333


class Camera:
    """Feeds one camera's stamps; time goes on by itself."""

    def __init__(self, epoch_ns: int = 1_700_000_000_000_000_000) -> None:
        self.watch, self.now_ns, self.number = ClockWatch(), epoch_ns, 0
        self.arrival, self.events = 100.0, list[ClockEvent]()

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
        _, event = self.watch.handle("cam0", "boot-1", sequence, self.number, self.now_ns, self.arrival)
        if event is not None:
            self.events.append(event)


@pytest.mark.parametrize("step_s", [10.0, -10.0, 0.5, -0.5])
def test_a_step_is_measured_to_a_millisecond_also_on_clocks_of_unix_time(step_s: float) -> None:
    camera = Camera()
    camera.frames(100)
    camera.frames(100, step_ns=round(step_s * 1e9))
    (event,) = camera.events
    assert event.kind == "step"
    assert abs(event.step_s - step_s) < 1e-3
    assert camera.watch.since("cam0", "boot-1") == [event]
    assert (event.before, event.boot) == ("boot-1", "boot-1-e1")


def test_dropped_frames_and_a_stall_are_no_steps() -> None:
    camera = Camera()
    camera.frames(100)
    camera.frames(5, skip=60)
    camera.frames(100, wait_ns=5_000_000_000)
    assert camera.events == []


def test_steps_follow_one_another() -> None:
    camera = Camera()
    camera.frames(60)
    camera.frames(60, step_ns=10_000_000_000)
    camera.frames(60, step_ns=-4_000_000_000)
    steps = [event.step_s for event in camera.watch.since("cam0", "boot-1")]
    assert steps == pytest.approx([10.0, -4.0], abs=1e-3)
    assert [event.step_s for event in camera.watch.since("cam0", "boot-1-e1")] == pytest.approx([-4.0], abs=1e-3)


def test_duplicates_belong_to_the_epoch_they_came_from() -> None:
    camera = Camera()
    camera.frames(60)
    old = camera.now_ns
    camera.frames(10, step_ns=10_000_000_000)
    name, event = camera.watch.handle("cam0", "boot-1", 30, 30, old - 30 * PERIOD_NS, None)
    assert (name, event) == ("boot-1", None)
    name, _ = camera.watch.handle("cam0", "boot-1", 65, 65, camera.now_ns, None)
    assert name == "boot-1-e1"


def _drifting(seconds: float, late: Callable[[float], float], ppm: float = 0.0, at_s: float = 30.0) -> list[ClockEvent]:
    """Events of a camera whose frames arrive ``late(true time)`` after they were taken."""
    watch, events = ClockWatch(), list[ClockEvent]()
    for number in range(round(seconds * 30)):
        true = number / 30.0
        shown = true + 1e-6 * ppm * max(0.0, true - at_s)
        _, event = watch.handle("cam0", "boot-1", number, number, round(shown * 1e9), 100.0 + true + late(true))
        events += [] if event is None else [event]
    return events


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_a_clock_that_begins_to_drift_is_told_within_seconds(ppm: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    events = _drifting(45.0, lambda true: 0.002 + float(rng.exponential(0.001)), ppm)
    assert [event.kind for event in events] == ["drift"]
    assert events[0].rate == pytest.approx(1e-6 * ppm, abs=1.2e-4)


def _told(ppm: float, seed: int, late_s: float, seconds: float) -> tuple[ClockWatch, float, float]:
    """The watch of a clock that begins to drift at 30 s, when it was told [s after], and the clock's time then."""
    watch, rng = ClockWatch(), np.random.default_rng([seed, 2])
    told = shown_then = None
    for number in range(round(seconds * 30)):
        true = number / 30.0
        shown = true + 1e-6 * ppm * max(0.0, true - 30.0)
        arrival = 100.0 + true + 0.002 + float(rng.exponential(late_s))
        _, event = watch.handle("cam0", "b", number, number, round(shown * 1e9), arrival)
        if event is not None and told is None:
            told, shown_then = true - 30.0, shown
    assert told is not None
    assert shown_then is not None
    return watch, told, shown_then


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_behind_a_wire_a_drift_is_told_before_the_clock_is_off_by_a_millisecond(ppm: float, seed: int) -> None:
    _, told, _ = _told(ppm, seed, 3e-4, 36.0)
    assert 0.0 < told < 3.5


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_the_seconds_after_tell_a_drift_better(ppm: float, seed: int) -> None:
    """Rate and bend are amended, so that a map carried on for 20 s is right to a quarter of a millisecond."""
    watch, told, shown_then = _told(ppm, seed, 3e-4, 50.0)
    (event,) = watch.since("cam0", "b")
    assert watch.event(event.boot) == event
    assert event.at_s == pytest.approx(shown_then, abs=1e-6)
    assert event.rate == pytest.approx(1e-6 * ppm, abs=8e-6)
    assert event.step_s + event.rate * 20.0 == pytest.approx(1e-6 * ppm * (told + 20.0), abs=2.5e-4)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("late_s", [0.005, 0.015, 0.03])
def test_a_link_that_holds_frames_up_by_chance_is_no_drift(late_s: float, seed: int) -> None:
    rng = np.random.default_rng([seed, 3])
    assert _drifting(600.0, lambda true: 0.002 + float(rng.exponential(late_s))) == []


@pytest.mark.parametrize("seed", range(6))
def test_a_route_that_becomes_longer_is_no_drift(seed: int) -> None:
    """Delays that jump by up to a millisecond, and stay."""
    rng = np.random.default_rng([seed, 4])
    at, level = np.sort(rng.uniform(20.0, 300.0, 14)), np.append(0.0, rng.uniform(0.0, 1e-3, 14))

    def late(true: float) -> float:
        return 2e-3 + float(level[np.searchsorted(at, true)]) + float(rng.exponential(3e-4))

    assert _drifting(300.0, late) == []


def test_rises_that_were_no_drift_are_usual_from_then_on() -> None:
    """A machine whose delays rise by 0.6 ms in 3 s once in a minute is told at most twice in ten."""
    rng = np.random.default_rng(5)

    def late(true: float) -> float:
        rise = float(np.interp(true % 61.7, [0.0, 3.0, 8.0, 11.0], [0.0, 6e-4, 6e-4, 0.0]))
        return 2e-3 + rise * (true > 40.0) + float(rng.exponential(1e-4))

    assert len(_drifting(640.0, late)) <= 2


@pytest.mark.parametrize("step_s", [30.0, -0.5])
def test_delays_tell_a_step_that_uneven_frames_tell_badly(step_s: float) -> None:
    """Frames that come 2 ms early or late: the step is known to 3 ms at once, to a tenth of one after 3 s."""
    rng, told, better = np.random.default_rng(6), list[float](), list[float]()
    for _ in range(20):
        watch, events = ClockWatch(), list[ClockEvent]()
        for number in range(600):
            true = number / 30.0 + float(np.clip(rng.normal(0.0, 2e-3), -0.01, 0.01))
            shown = 1.0001 * true + step_s * (number > 400)
            arrival = 100.0 + true + 0.002 + float(rng.exponential(3e-4))
            _, event = watch.handle("cam0", "b", number, number, round(shown * 1e9), arrival)
            events += [] if event is None else [event]
        (event,) = events
        (now,) = watch.since("cam0", "b")
        told.append(event.step_s - step_s)
        better.append(now.step_s - step_s)
        assert now.std_s < 5e-5
    assert np.std(told) > 1e-3
    assert np.std(better) < 1e-4


def test_delays_that_jump_with_the_clock_do_not_tell_its_step() -> None:
    """A camera that came back by another way, 50 ms longer: the two stamps are believed."""
    camera = Camera()
    camera.frames(300)
    camera.arrival += 0.05
    camera.frames(200, step_ns=10_000_000_000)
    (event,) = camera.watch.since("cam0", "boot-1")
    assert event.step_s == pytest.approx(10.0, abs=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_frames_that_are_held_up_more_and_more_are_no_drift(seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    wander = np.cumsum(rng.normal(0.0, 0.01, 200))  # a busy machine: 10 ms more or less each second
    swamped = 0.06 * rng.random()

    def late(true: float) -> float:
        return 1.0 + float(np.interp(true, np.arange(200), wander)) + swamped * max(0.0, true - 60.0)

    assert _drifting(120.0, late) == []


@pytest.mark.parametrize("ppm", [200.0, -200.0])
def test_a_map_follows_a_drift_from_when_it_is_told(ppm: float) -> None:
    """Until the new epoch is solved by itself the old map is bent as the clock was: within 1 ms 20 s later."""
    rng = np.random.default_rng(8)
    epochs, origin, changed = ClockEpochs(), 1.7e9, 30.0
    shown = lambda true: true + 1e-6 * ppm * max(0.0, true - changed)  # noqa: E731
    told = None
    for frame in range(30 * 40):
        true = frame / 30.0
        message = pb.Observation(
            camera="cam0", boot_id="b", sequence=frame, frame=frame, device_time_ns=round((origin + shown(true)) * 1e9)
        )
        _, event = epochs.sort(message, 5.0 + true + 2e-3 + float(rng.exponential(3e-4)))
        told = true if told is None and event is not None else told
    assert told is not None
    time_map, pose = TimeMap(time_offset=-origin, clock_rate=1.0), random_poses(rng, 1)[0]
    eye = CameraCalibration("cam0", random_lens(rng), pose, time_map, 1e-4, np.zeros(3), 0.5)
    known = Calibration({"cam0": eye}, "cam1", "metric", "m", "joint", "1")
    present, _ = epochs.present(known, {"cam0": "b"})
    now = present.cameras["cam0"]
    for true in (told, told + 10.0, told + 20.0):
        off = now.time_map.clock_rate * (origin + shown(true)) + now.time_map.time_offset - true
        assert abs(off) < 1e-3
    assert now.time_offset_std > 1e-4


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_was_taken_for_a_drift_is_not_carried_on(sign: float) -> None:
    """Delays that rise or fall by 1 ms in 3 s and stay: 20 s later the clock is not thought to have gone on so."""
    rng, watch, told = np.random.default_rng(9), ClockWatch(), list[ClockEvent]()
    for number in range(30 * 55):
        true = number / 30.0
        late = sign * float(np.interp(true, [30.0, 33.0], [0.0, 1e-3])) + 1e-5 * float(rng.random())
        _, event = watch.handle("cam0", "b", number, number, round(true * 1e9), 100.0 + true + late)
        told += [] if event is None else [event]
    (first,) = told
    assert abs(first.rate) > 2e-4
    (event,) = watch.since("cam0", "b")
    assert abs(event.rate) < 1.5e-4
    assert abs(event.step_s + event.rate * (55.0 - event.at_s)) < 2.5e-3
