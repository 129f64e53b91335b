"""What one camera sends costs that camera: its time, its rows, its labels, its errors."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import Message

from hub.live.agent import status_message
from hub.live.budgets import CameraBudgets
from hub.live.fair_share import FairShare
from hub.live.live_hub import KnownCalibration, LiveHub, LiveSettings
from hub.live.messages import refusal_message
from hub.live.solver import InlineSolver, SolverAnswer, SolverJob
from hub.view.state import ViewState
from protocols.bus.base import Received
from protocols.bus.security.sender_identity import SenderCheckedBus
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.core.ranges import MAX_CAMERAS
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session import builder
from protocols.session.builder import SessionBuilder, rig_camera_from_info
from protocols.session.calibration import CameraCalibration
from protocols.session.rig import Rig, RigCamera
from protocols.topics import CALIBRATION, OBSERVATION, STATUS
from protocols.validation.codec import decode, encode
from tests.support.samples import camera_info


def frame(camera: str, number: int, points: int = 1, period_ns: int = 33_000_000, **fields: Any) -> pb.Observation:
    detections = [pb.Detection(u=float(index % 600), v=50.0, score=0.5, label=f"p{index}") for index in range(points)]
    values = {"boot_id": "b0", "sequence": number, "device_time_ns": number * period_ns} | fields
    return pb.Observation(schema_version=1, camera=camera, frame=number, detections=detections, **values)


def info(camera: str) -> pb.CameraInfo:
    return pb.CameraInfo(schema_version=1, camera=camera, boot_id="b0", width=640, height=480, fps=30.0)


@pytest.mark.parametrize(
    ("period_ns", "told"), [(33_000_000, ""), (33_000, "0.001 s a second"), (33, "1e-06"), (0, "by 0 s")]
)
def test_times_in_another_unit_than_nanoseconds_are_named(period_ns: int, told: str) -> None:
    """A camera of another maker whose times are microseconds waited for the next search of its lag for ever."""
    hub = LiveHub(LiveSettings(track=False))
    for camera in ("a", "b"):
        hub.handle(info(camera))
    for number in range(450):
        hub.handle(frame("a", number), number * 0.033)
        hub.handle(frame("b", number, period_ns=period_ns), number * 0.033)
        hub.tick(number * 0.033)
    text, reasons = hub.state(450 * 0.033)[1], {one.camera: one.reason for one in hub.progress()}
    assert ("nanoseconds" in text, "nanoseconds" in reasons["b"]) == (bool(told), bool(told))
    assert told in text
    assert "times of a" not in text
    for number in range(450, 900):  # its program is corrected
        hub.handle(frame("b", number, boot_id="b1"), number * 0.033)
    assert "nanoseconds" not in hub.state(900 * 0.033)[1]


def test_frames_that_are_not_counted_are_named() -> None:
    """All but one were left out as duplicates: "too few connected observations (1 rows)"."""
    hub = LiveHub(LiveSettings(track=False))
    for number in range(200):
        hub.handle(frame("a", number), number * 0.033)
        hub.handle(frame("b", number, sequence=0), number * 0.033)
    (text,) = hub.links.standing.values()
    assert text == "the frames of b all have sequence 0: it must count them, from 0"
    assert text in hub.state(200 * 0.033)[1]


@pytest.mark.parametrize(("goes_back", "text"), [(False, "b counts its frames anew ("), (True, "b is replayed again")])
def test_a_camera_that_counts_anew_under_one_boot_id_is_named(goes_back: bool, text: str) -> None:
    """Its frames were left out as duplicates, and the hub was calibrated: for half a minute, or for good."""
    hub = LiveHub(LiveSettings(track=False))
    for number in range(900):
        for camera, sent in (("a", number), ("b", number % 500)):
            time_ns = (sent if goes_back else number) * 33_000_000
            hub.handle(frame(camera, sent, device_time_ns=time_ns), number * 0.033)
        late = frame("a", max(number - 100, 0))  # a history that comes in parts, the newest first
        hub.handle(late, number * 0.033)
    (fault,) = hub.links.standing.values()
    assert fault.startswith(text)
    assert "so its markers are not used" in fault
    assert fault in hub.state(900 * 0.033)[1]
    for number in range(300):
        hub.handle(frame("b", number, boot_id="b1"), (900 + number) * 0.033)
    assert not hub.links.standing


@pytest.mark.parametrize("forgotten", [LiveHub.reset, lambda hub: hub.release(["b"])])
def test_after_a_reset_numbers_may_begin_anew(forgotten: Callable[[LiveHub], None]) -> None:
    """Its rows were used, but the hub was degraded: "so they are not used"."""
    hub = LiveHub(LiveSettings(track=False))
    for number in range(900):
        hub.handle(frame("b", number % 500, device_time_ns=number * 33_000_000), number * 0.033)
    assert hub.links.standing
    forgotten(hub)
    assert not hub.links.standing
    for number in range(900, 1300):
        hub.handle(frame("b", number - 900, device_time_ns=number * 33_000_000), number * 0.033)
    assert hub.stream.marker.rows("b") == 400
    assert not hub.links.standing


def test_people_are_used_whatever_the_numbers_are() -> None:
    hub = LiveHub(LiveSettings(track=False))
    for number in range(900):
        message = frame("b", number % 500, device_time_ns=number * 33_000_000)
        message.detections[0].kind, message.detections[0].label = "person", ""
        hub.handle(message, number * 0.033)
    assert not hub.links.standing


@pytest.mark.parametrize("time_ns", [50 * 33_000_000, 10**9 * 33_000_000])
def test_one_number_far_ahead_costs_no_frame(time_ns: int) -> None:
    """All frames after it were duplicates, for good, and steps of the clock were not found."""
    hub = LiveHub(LiveSettings(track=False))
    for number in range(400):
        now = number * 0.033
        hub.tick(now)
        stray = {"sequence": 10**9, "device_time_ns": time_ns} if number == 50 else {}
        set_back = {"device_time_ns": number * 33_000_000 - 3600 * NANOSECONDS} if number >= 300 else {}
        hub.handle(frame("b", number, **stray, **set_back), now)
    assert hub.stream.marker.counters["duplicates"] == 0
    assert hub.counters["clock_steps"] == 1
    assert not hub.links.standing


def test_of_moved_cameras_the_calibrated_ones_are_named() -> None:
    """One of two, moved for itself, and a third that was taken away were "one of them"."""
    hub, pair = LiveHub(LiveSettings(track=False)), ("cam0", "cam1")
    hub._moved = {"cam1": 50.0, "cam3": 50.0}
    assert hub._moved_lately(pair, 60.0) == ", moved: cam1 (10 s ago)"
    hub._moved = {"cam0": 10.0, "cam1": 50.0}
    assert hub._moved_lately(pair, 60.0) == ", moved: cam0 (50 s ago), cam1 (10 s ago)"
    hub._moved = {"cam0": 50.0, "cam1": 50.0}
    assert hub._moved_lately(pair, 60.0) == ", one of them moved 10 s ago"


def test_a_camera_that_has_not_introduced_itself_is_told_so() -> None:
    hub = LiveHub(LiveSettings(track=False))
    hub.handle(info("a"))
    for number in range(100):
        for camera in ("a", "b"):
            hub.handle(frame(camera, number), number * 0.033)
    assert ["CameraInfo" in one.reason for one in hub.progress()] == [False, True]


def test_a_burst_after_an_outage_is_no_wrong_unit() -> None:
    hub = LiveHub(LiveSettings(track=False))
    for number in range(2000):
        hub.handle(frame("a", number), max(number * 0.033, 40.0 * (number > 20)))
        assert not hub.links.standing


def test_a_clock_that_hardly_advances_fills_no_window() -> None:
    """4,096 labelled detections a frame on a clock that crawled by 1 ns took 2.5 GB: the window was on that clock."""
    budgets = CameraBudgets()
    admitted = sum(
        len(message.detections)
        for number in range(30)
        if (message := budgets.admit(frame("a", number, 4096, period_ns=1), number / 30.0)) is not None
    )
    assert admitted <= 256 * (32_000 // 4096)
    assert budgets.exceeded(1.0, 10.0) == ["a"]
    assert all(budgets.admit(frame("b", number), number / 30.0) is not None for number in range(600))


def test_a_backlog_of_a_minute_and_a_clock_set_back_are_no_flood() -> None:
    budgets = CameraBudgets()
    assert all(budgets.admit(frame("a", number, period_ns=10_000_000), 0.0) is not None for number in range(6_000))
    assert all(
        budgets.admit(frame("a", number, device_time_ns=number * 33_000_000 - 3600 * NANOSECONDS), number / 30.0)
        for number in range(6_000, 40_000)
    )


def test_of_a_crowded_frame_the_best_detections_are_kept() -> None:
    message = frame("a", 0, 1000)
    message.detections[999].score = 1.0
    kept = CameraBudgets().admit(message, 0.0)
    assert kept is not None
    assert len(kept.detections) == 256
    assert kept.detections[-1].label == "p999"


def test_there_are_so_many_cameras_and_no_more() -> None:
    hub = LiveHub()
    for number in range(MAX_CAMERAS + 10):
        hub.handle(info(f"cam{number}"))
    assert hub.counters["too_many_cameras"] == 10


def test_messages_of_many_senders_wait_within_one_bound() -> None:
    """Each of a thousand invented cameras had room for 40,000 rows of its own."""
    shares = FairShare(lambda one: None, itertools.count().__next__, 0.5)  # no time for any of them
    for number in range(20):
        shares.take(Received(OBSERVATION, f"cam{name}", frame(f"cam{name}", number, 1000), 0) for name in range(30))
    waiting = sum(len(one.message.detections) for queue in shares._waiting.values() for one in queue)  # type: ignore[attr-defined]
    assert 50_000 < waiting <= 100_000
    assert set(shares.dropped) == {f"cam{name}" for name in range(30)}


def test_a_hub_that_is_far_behind_still_processes_messages() -> None:
    """With a thousand senders each message that was too many took 60 µs to drop: the rounds had no time for others."""
    now, done = [0.0], [0]

    def handle(received: Received) -> None:
        now[0] += 1e-4
        done[0] += 1

    def arriving(rounds: int) -> Iterator[Received]:
        for number in range(rounds * 100):
            now[0] += 1e-3  # each takes longer to put aside than to process
            yield Received(OBSERVATION, f"cam{number % 100}", frame("cam0", number, 30), 0)

    shares = FairShare(handle, lambda: now[0], 0.2)
    for _ in range(5):
        before = done[0]
        shares.take(arriving(50))
        now[0] += 1.0
        assert done[0] - before >= 900
    assert shares.dropped.total() > 10_000


def test_reasons_of_a_thousand_cameras_fit_into_a_message() -> None:
    """Five megabytes of pairs that failed: the message could not be sent, and the hub ended."""
    reasons = {
        f"cam{number}": "with another camera: the recordings overlap too little; " * 200 for number in range(1000)
    }
    message = refusal_message("; ".join(reasons.values()), reasons, 1, "refused")
    assert decode(CALIBRATION, encode(message)) == message
    assert [one.camera for one in message.refused] == list(reasons)


def test_a_large_network_is_filmed_for_long_before_it_is_searched() -> None:
    hub = LiveHub(LiveSettings(least_rows=10, interval_s=1e9))
    for number in range(100):
        hub.handle(info(f"cam{number}"))
    for number in range(30 * 12):
        hub.tick(number / 30.0)
        for camera in range(100):
            hub.handle(frame(f"cam{camera}", number))
        if number % 30 == 0 and 30 < number < 30 * 8:
            assert "100 cameras need 10 s" in hub.missing()
    assert hub.missing() == ""


def test_frames_are_left_out_where_all_do_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand cameras filled the memory in 15 s, and few pairs have enough motion in common in so short a film."""
    monkeypatch.setattr("protocols.session.builder._MAX_ROWS", 3_000)
    builder, whole = SessionBuilder(180.0), SessionBuilder()
    for one in (builder, whole):
        for camera in ("a", "b"):
            one.handle(info(camera))
        for number in range(30 * 40):
            for camera in ("a", "b"):
                one.handle(frame(camera, number, 4), number / 30.0)
    held = builder.build()[1].tracks["a", "p0"].frame
    assert set(np.diff(held).tolist()) == {3}, "ten of thirty a second"
    assert len(held) * 8 <= 3_000 + 2 * 8 * 10 * 2, "and a chunk"
    assert held[-1] - held[0] > 30 * 30
    whole.select(builder.ranges())
    replayed = whole.build()[1].tracks
    assert all(np.array_equal(track.frame, replayed[key].frame) for key, track in builder.build()[1].tracks.items())


@pytest.mark.parametrize(("offset", "bound"), [(1e308, 0.1), (0.0, -5.0), (0.0, 1e308)])
def test_a_clock_prior_that_cannot_be_is_not_used(offset: float, bound: float) -> None:
    """The hub's own message about it was refused by who received it, and its log could not be replayed."""
    status = pb.AgentStatus(agent="a", role="camera", boot_id="b0")
    for name, value in {"clock_synchronised": 1.0, "unix_minus_camera_s": offset, "clock_error_s": bound}.items():
        status.gauges[name] = value
    hub = LiveHub()
    hub.handle(status)
    assert hub.stream.clock_priors.for_boots({"a": "b0"}) == {}


def test_clock_priors_of_invented_agents_are_not_kept_without_end() -> None:
    hub = LiveHub()
    for number in range(MAX_CAMERAS + 50):
        status = pb.AgentStatus(agent=f"a{number}", role="camera", boot_id="b0")
        for name in ("clock_synchronised", "unix_minus_camera_s", "clock_error_s"):
            status.gauges[name] = 1.0
        hub.handle(status)
    assert len(hub.stream.clock_priors._priors) == MAX_CAMERAS


def test_labels_and_runs_without_end_are_not_kept() -> None:
    """Each boot id took 5.6 kB for ever, and each label too."""
    builder = SessionBuilder(window_s=20.0)
    builder.handle(info("a"))
    for number in range(300):
        message = frame("a", number, 2, boot_id=f"run{number}")
        message.detections[0].label = f"new{number}"
        builder.handle(message, number / 30.0)
    assert len(builder._boots["a"]) <= 8
    assert len(builder._labels) <= 256
    hub = LiveHub(LiveSettings(track=False))
    for number in range(300):
        hub.handle(frame("a", 0, boot_id=f"run{number}"), number / 30.0)
    assert len(hub.stream.clocks._detector._clocks) <= 8


def test_a_clock_that_is_set_again_and_again_is_no_longer_watched() -> None:
    """Every step of the clock began a segment that was remembered for ever."""
    hub = LiveHub(LiveSettings(track=False))
    for number in range(2_000):
        time_ns = number * 33_000_000 + 3600 * NANOSECONDS * (number // 10 % 2)
        hub.handle(frame("a", number, device_time_ns=time_ns), number / 30.0)
    assert 60 <= hub.counters["clock_steps"] <= 64
    assert len(hub.stream.marker._boots["a"]) <= 8


def test_who_has_most_rows_gives_them_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocols.session.builder._MAX_ROWS", 2_000)
    builder = SessionBuilder(window_s=60.0)
    for number in range(300):
        for camera, points in (("a", 1), ("b", 20)):
            builder.handle(frame(camera, number, points), number / 30.0)
    assert builder.rows("a") == 300
    assert builder.rows("b") <= 2_000 + 20 * 60


def test_an_error_in_a_camera_s_messages_ends_that_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    hub = LiveHub()
    handle = hub.guidance.handle

    def fails(message: Message) -> None:
        if getattr(message, "camera", "") == "bad":
            raise ZeroDivisionError("a flaw that nobody knows yet")
        handle(message)

    monkeypatch.setattr(hub.guidance, "handle", fails)
    for number in range(10):
        hub.handle(frame("bad", number))
        hub.handle(frame("good", number))
    assert hub.counters["observations"] == 10
    assert hub.links.faults == {"bad": 3}
    assert "bad is left out until it is restarted: ZeroDivisionError" in hub.links.notices["bad"]
    hub.handle(frame("bad", 0, boot_id="b1"))
    assert hub.links.faults == {"bad": 4}


class FailsWith(InlineSolver):
    """Ends without an answer as long as a camera is in the job."""

    def __init__(self, camera: str) -> None:
        super().__init__()
        self.camera, self.jobs = camera, list[list[str]]()

    def submit(self, job: SolverJob, now: float) -> None:
        self.jobs.append(sorted(job.rig.cameras))
        answer = SolverAnswer(job.number, reason="none yet", failed=self.camera in job.rig.cameras)
        self._answer = replace(answer)


def test_a_camera_with_which_the_solver_fails_is_left_out() -> None:
    solver = FailsWith("c")
    hub = LiveHub(LiveSettings(interval_s=1.0), solver=solver)
    for camera in "abc":
        hub.handle(info(camera))
    for number in range(300):
        for camera in "abc":
            hub.handle(frame(camera, number))
        hub.tick(number / 30.0)
    assert solver.jobs[-1] == ["a", "b"]
    assert "c is left out: the solver failed with its rows" in hub.degradations(10.0)
    assert hub.counters["solver_failures"] <= 3


def test_who_takes_more_than_its_share_waits_and_the_others_do_not() -> None:
    now, order = [0.0], []

    def handle(received: Received) -> None:
        order.append(received.agent)
        now[0] += 0.05 if received.agent == "slow" else 0.0001

    def message(camera: str, number: int) -> Received:
        return Received(OBSERVATION, camera, frame(camera, number), 0)

    shares = FairShare(handle, lambda: now[0], 0.4)
    stream = [message(camera, number) for number in range(100) for camera in ("slow", "good")]
    shares.take(stream)
    assert order.count("good") == 100
    assert order.count("slow") < 15
    assert now[0] < 1.0
    assert shares.behind == ["slow"]
    for _ in range(20):
        shares.take([])
    assert order.count("slow") == 100
    assert shares.behind == []
    shares.take([message("slow", number) for number in range(50_000)])
    assert shares.dropped["slow"] > 25_000


def test_a_thousand_cameras_do_not_make_the_status_inadmissible() -> None:
    """Three gauges a camera were 1,002 numbers with 334 of them: every listener refused it, and the page had no hub."""
    names = [f"cam{number}" for number in range(1000)]
    lens, pose = Intrinsics(640, 480, np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])), Pose.identity()
    solved = {name: CameraCalibration(name, lens, pose, TimeMap(1.0, 0.0), 1e-4, np.zeros(3), 0.5) for name in names}
    hub = LiveHub(known=KnownCalibration(Rig({name: RigCamera(name, (640, 480), 30.0) for name in names}), solved))
    for now, heard in ((7.0, ["cam900"]), (10.0, [name for name in names if name != "cam900"])):
        hub.tick(now)
        for name in heard:
            hub.handle(info(name))
            for sequence in range(20):
                hub.handle(frame(name, sequence, 0), now + sequence / 30.0)
    view = ViewState()
    with MemoryBus(MemoryHub()) as bus:
        guarded = SenderCheckedBus(bus, lambda: 0.0)
        subscriptions = [guarded.subscribe(topic) for topic in (STATUS, CALIBRATION)]
        guarded.publisher(CALIBRATION, "hub").put(hub.tick(13.0)[0])
        guarded.publisher(STATUS, "hub").put(status_message(hub, "hub", "b0", 0, [{"received": 20_000}], 11.0))
        for subscription in subscriptions:
            for received in subscription.drain():
                view.handle(received.message, 11.0)
    (agent,) = view.of_role("hub")
    gauges = agent.status.gauges
    assert (gauges["cameras"], gauges["silent_cameras"], gauges["calibrated_cameras"]) == (1000, 1, 1000)
    assert gauges["frame_age_s.cam900"] == 4.0, "of so many cameras the worst are named"
    assert view.headline().startswith("degraded: 1000 cameras")
    assert not any("no hub" in step for step in view.next_steps())


def test_the_cameras_of_a_job_are_made_when_they_introduce_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand of them made at once, with each job, took a round of the loop that serves the bus."""
    sessions, made = SessionBuilder(window_s=60.0), []
    monkeypatch.setattr(builder, "rig_camera_from_info", lambda info: made.append(info) or rig_camera_from_info(info))
    for name in ("a", "b"):
        sessions.handle(camera_info(name))
        sessions.handle(frame(name, 1))
    sessions.handle(camera_info("a"))
    assert sessions.build()[0].cameras.keys() == sessions.build()[0].cameras.keys() == {"a", "b"}
    assert len(made) == 2
    sessions.handle(pb.CameraInfo(schema_version=1, camera="a", width=320, height=240, fps=10.0))
    assert sessions.build()[0].cameras["a"].size == (320, 240)
