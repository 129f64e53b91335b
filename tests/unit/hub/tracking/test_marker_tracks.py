"""Live tracks of labelled markers on simulated rigs: accuracy, honesty, order of arrival, faults, calibrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from hub.tracking.live_tracking import LiveTracking
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration
from protocols.session.observations import DEFAULT_LABEL
from tests.support.rigs import SIZE, Session, simulate

EPOCH_S = 1000.0
"""Of the reference clock at the true time 0."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Observations of a simulated session in the order of capture, with true times [s], and its true calibration."""

    session: Session
    calibration: dict[str, CameraCalibration]
    messages: list[tuple[float, pb.Observation]]

    def truth(self, track: pb.Track) -> Floats:
        """The true position (3,) at a message's time."""
        true = track.reference_time_ns / NANOSECONDS - EPOCH_S
        return np.asarray(self.session.paths[track.label].at(np.array([true]))[0])

    def error(self, track: pb.Track) -> Floats:
        """(3,) published minus true position."""
        return np.array(track.position) - self.truth(track)


def stream(session: Session, noise_px: float = 0.5) -> Stream:
    """The session as frames with one detection each."""
    calibration, messages = {}, []
    for name, camera in session.rig.cameras.items():
        assert camera.intrinsics is not None
        clock = replace(session.clocks[name], time_offset=session.clocks[name].time_offset + EPOCH_S)
        calibration[name] = CameraCalibration(
            name, camera.intrinsics, session.poses[name], clock, 0.0, np.zeros(3), noise_px * np.sqrt(2)
        )
    for i, (name, label) in enumerate(zip(session.camera, session.label, strict=True)):
        message = pb.Observation(
            schema_version=1, camera=name, boot_id="b", sequence=int(session.frame[i]), frame=int(session.frame[i]),
            device_time_ns=round(session.time[i] * NANOSECONDS),
        )  # fmt: skip
        u, v = session.pixels[i]
        message.detections.add(u=u, v=v, score=1.0, label="" if label == DEFAULT_LABEL else label)
        messages.append((session.true_time(name, session.time[i]), message))
    return Stream(session, calibration, sorted(messages, key=lambda one: one[0]))


def calibrated(calibration: dict[str, CameraCalibration], live: LiveTracking | None = None) -> LiveTracking:
    live = live or LiveTracking()
    live.calibrate(calibration, {}, reference="cam0", scale="arbitrary", units="m", up=None)
    return live


def follow(
    live: LiveTracking, messages: Sequence[tuple[float, pb.Observation]], every_s: float = 0.02
) -> tuple[list[pb.Track], list[pb.Track]]:
    """Track messages of a hub that ticks regularly: filtered and smoothed."""
    filtered, smoothed, due = [], [], messages[0][0] + every_s
    for arrival, message in messages:
        while arrival >= due:
            filtered += tracks_of(live.tick(due))
            smoothed += live.smoothed()
            due += every_s
        live.handle(message)
    return filtered + tracks_of(live.tick(due)), smoothed + live.smoothed()


def tracks_of(messages: Sequence[object]) -> list[pb.Track]:
    return [message for message in messages if isinstance(message, pb.Track)]


def confirmed(tracks: Sequence[pb.Track]) -> list[pb.Track]:
    return [track for track in tracks if track.state == "confirmed"]


def rms(stream: Stream, tracks: Sequence[pb.Track]) -> float:
    return float(np.sqrt(np.mean([np.sum(stream.error(track) ** 2) for track in tracks])))


@cache
def plain() -> Stream:
    """Ten seconds of one marker in three cameras."""
    return stream(simulate(7, 3, 10.0, late=0.2))


@pytest.mark.parametrize(
    ("seed", "count", "fps", "fisheye"),
    [
        (1, 2, (30.0, 25.0), ()),
        (2, 4, (60.0, 29.97, 50.0, 15.0), (1, 2)),
        (3, 3, (20.0, 24.0), (0,)),
        (4, 6, (30.0,), ()),
    ],
)
def test_random_rigs_are_tracked_and_the_covariances_are_honest(
    seed: int, count: int, fps: Sequence[float], fisheye: Sequence[int]
) -> None:
    """Other lenses, rates, clocks: errors of a few stds of the noise, normalised ones near their degrees of freedom."""
    one = stream(simulate(seed, count, 15.0, fps=fps, fisheye=fisheye, late=0.5))
    filtered, smoothed = follow(calibrated(one.calibration), one.messages)
    known = confirmed(filtered)[20:]
    assert known[0].reference_time_ns / NANOSECONDS - EPOCH_S < 2.0
    assert len(known) > 0.9 * len(filtered) - 20
    per_pixel = 6.0 / 1100.0  # of the most distant camera [m]
    assert rms(one, known) < 3.0 * 0.5 * per_pixel
    assert rms(one, confirmed(smoothed)[10:]) < 0.8 * rms(one, known)
    for tracks, low, high in ((known, 1.5, 5.0), (confirmed(smoothed)[10:], 1.5, 6.0)):
        covariances = [np.array(track.position_covariance).reshape(3, 3) for track in tracks]
        nees = [e @ np.linalg.solve(c, e) for e, c in zip(map(one.error, tracks), covariances, strict=True)]
        assert low < np.mean(nees) < high
    speeds = [np.linalg.norm(track.velocity) for track in known]
    assert np.isfinite(speeds).all()
    assert all(track.kind == "marker" and 1 <= track.cameras <= count for track in known)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 40.0])
def test_the_scale_of_the_world_changes_nothing(scale: float) -> None:
    one = plain()
    scaled = {
        name: replace(camera, pose=Pose(camera.pose.rotation, scale * camera.pose.position))
        for name, camera in one.calibration.items()
    }
    filtered, smoothed = follow(calibrated(scaled), one.messages)
    usual, usual_smoothed = follow(calibrated(one.calibration), one.messages)
    for tracks, others in ((filtered, usual), (smoothed, usual_smoothed)):
        assert [track.state for track in tracks] == [track.state for track in others]
        places = np.array([track.position for track in tracks]) / scale
        np.testing.assert_allclose(places, [track.position for track in others], atol=1e-6)


def test_the_order_of_arrival_within_the_lag_changes_no_bit() -> None:
    one = plain()
    rng = np.random.default_rng(3)

    def state(messages: Sequence[tuple[float, pb.Observation]], every_s: float) -> tuple[bytes, ...]:
        live = calibrated(one.calibration)
        follow(live, messages, every_s)
        assert live.counters["marker.late"] == 0
        last = live.markers._labels[DEFAULT_LABEL].state
        return last.mean.tobytes(), last.covariance.tobytes(), repr((last.log_weight, last.psd, last.noise)).encode()

    expected = state(one.messages, 0.02)
    for late_s, every_s in ((0.05, 0.02), (0.2, 0.1), (0.45, 0.007)):
        late = [(arrival + rng.uniform(0, late_s), message) for arrival, message in one.messages]
        doubled = [pair for pair in late for _ in range(1 + int(rng.random() < 0.1))]
        assert state(sorted(doubled, key=lambda pair: pair[0]), every_s) == expected


def test_every_row_is_published_at_the_next_tick() -> None:
    live, heard = calibrated(plain().calibration), []
    for arrival, message in plain().messages:
        live.handle(message)
        tracks = tracks_of(live.tick(arrival))
        assert len(tracks) <= 1
        heard.append(len(tracks) == 1 and tracks[0].reference_time_ns / NANOSECONDS - EPOCH_S > arrival - 1e-6)
    assert np.mean(heard[40:]) > 0.98


def test_a_delayed_hub_publishes_the_missed_times_in_order() -> None:
    live = calibrated(plain().calibration)
    filtered, smoothed = follow(live, plain().messages, 0.4)
    for tracks in (filtered, smoothed):
        times = np.array([track.reference_time_ns for track in tracks]) / NANOSECONDS
        assert (np.diff(times) > 0.0).all()
        assert np.diff(times).max() < 0.1
        assert [track.sequence for track in tracks] == list(range(len(tracks)))


def test_smoothed_tracks_that_are_left_out_are_counted_and_change_nothing_else() -> None:
    filtered, smoothed = follow(calibrated(plain().calibration), plain().messages)
    live, half = calibrated(plain().calibration), len(plain().messages) // 2
    live.markers.smooths = False
    first = follow(live, plain().messages[:half])
    live.markers.smooths = True
    rest = follow(live, plain().messages[half:])
    assert len(first[0]) + len(rest[0]) == len(filtered)
    assert not first[1]
    assert [track.sequence for track in rest[1]] == list(range(len(rest[1])))
    assert live.counters["shed.smoothed"] + len(rest[1]) == pytest.approx(len(smoothed), abs=5)


def test_smoothed_tracks_lag_by_the_lag() -> None:
    live = calibrated(plain().calibration)
    for arrival, message in plain().messages:
        live.handle(message)
        live.tick(arrival)
        for track in live.smoothed():
            assert 0.49 < arrival - (track.reference_time_ns / NANOSECONDS - EPOCH_S) < 0.75


def changed(
    messages: Sequence[tuple[float, pb.Observation]], change: Callable[[float, pb.Observation], bool]
) -> list[tuple[float, pb.Observation]]:
    """Copies of the messages, changed by a function that returns whether each is kept."""
    out = []
    for arrival, message in messages:
        copy = pb.Observation()
        copy.CopyFrom(message)
        if change(arrival, copy):
            out.append((arrival, copy))
    return out


def test_false_detections_and_lost_frames_cost_little() -> None:
    one = stream(simulate(9, 4, 15.0, outliers=0.15, drops=0.2, late=0.5))
    filtered, smoothed = follow(calibrated(one.calibration), one.messages)
    assert len(confirmed(filtered)) > 0.95 * len(filtered)
    for tracks in (filtered, smoothed):
        errors = [np.linalg.norm(one.error(track)) for track in confirmed(tracks)[20:]]
        assert np.mean(errors) < 0.008
        assert np.max(errors) < 0.06


def test_one_camera_that_sees_something_else_does_not_take_the_track() -> None:
    def elsewhere(arrival: float, message: pb.Observation) -> bool:
        if message.camera == "cam1" and arrival > 3.0:
            message.detections[0].u, message.detections[0].v = 100.0, 600.0
        return True

    one = plain()
    filtered, _ = follow(calibrated(one.calibration), changed(one.messages, elsewhere))
    late = [track for track in filtered if track.reference_time_ns / NANOSECONDS - EPOCH_S > 3.0]
    assert len(confirmed(late)) > 0.95 * len(late)
    without = [pair for pair in one.messages if pair[1].camera != "cam1" or pair[0] <= 3.0]
    others, _ = follow(calibrated(one.calibration), without)
    assert rms(one, confirmed(late)) < 1.2 * rms(one, confirmed(others)[-len(late) :])


def test_a_marker_that_jumps_is_found_again_within_a_fraction_of_a_second() -> None:
    one = plain()
    shift = np.array([0.4, -0.3, 0.2])

    def jump(arrival: float, message: pb.Observation) -> bool:
        if arrival > 5.0:
            camera = one.calibration[message.camera]
            place = one.session.paths[DEFAULT_LABEL].at(np.array([arrival])) + shift
            (pixel,) = camera.intrinsics.project(camera.pose.camera_from_world(place))
            message.detections[0].u, message.detections[0].v = pixel
        return bool(np.isfinite(message.detections[0].u))

    filtered, _ = follow(calibrated(one.calibration), changed(one.messages, jump))
    late = [track for track in filtered if track.reference_time_ns / NANOSECONDS - EPOCH_S > 5.4]
    assert len(late) > 100
    assert max(np.linalg.norm(one.error(track) - shift) for track in late) < 0.05


def test_a_marker_that_no_camera_sees_coasts_is_lost_once_and_returns() -> None:
    """The cameras still send frames, without detections."""

    def hide(arrival: float, message: pb.Observation) -> bool:
        if 3.0 < arrival < 6.5:
            del message.detections[:]
        return True

    one = plain()
    filtered, _ = follow(calibrated(one.calibration), changed(one.messages, hide))
    by_state: dict[str, list[float]] = {}
    for track in filtered:
        by_state.setdefault(track.state, []).append(track.reference_time_ns / NANOSECONDS - EPOCH_S)
    assert len(by_state["lost"]) == 1
    assert 5.4 < by_state["lost"][0] < 5.7
    assert min(by_state["coasting"]) < 3.3
    assert max(np.diff(by_state["coasting"])) < 0.15
    assert max(by_state["confirmed"]) > 9.8
    assert min(time for time in by_state["confirmed"] if time > 6.0) < 6.9
    unseen = [track.unseen_s for track in filtered if track.state == "coasting"]
    assert min(unseen) > 0.2
    assert max(unseen) <= 2.5


def test_a_track_is_told_lost_when_all_cameras_fall_silent() -> None:
    one = plain()
    live = calibrated(one.calibration)
    filtered, _ = follow(live, one.messages)
    assert filtered[-1].state == "confirmed"
    end = one.messages[-1][0]
    after = [track for step in range(1, 60) for track in tracks_of(live.tick(end + 0.1 * step))]
    assert [track.state for track in after] == ["lost"]


@pytest.mark.parametrize("sees", [False, True])
def test_one_camera_goes_on_alone_after_the_others_died(sees: bool) -> None:
    """A marker that it does not see is lost in time; one that it sees goes on, as coasting, beyond that."""

    def alone(arrival: float, message: pb.Observation) -> bool:
        if arrival > 1.5 and not sees:
            del message.detections[:]
        return arrival <= 1.5 or message.camera == "cam0"

    one = plain()
    filtered, _ = follow(calibrated(one.calibration), changed(one.messages, alone))
    end = filtered[-1].reference_time_ns / NANOSECONDS - EPOCH_S
    assert filtered[-1].state == ("coasting" if sees else "lost")
    assert (9.8 if sees else 3.9) < end < (10.1 if sees else 4.3)


def test_the_covariance_and_the_state_tell_when_one_camera_alone_sees_the_marker() -> None:
    one = plain()
    only = [(t, m) for t, m in one.messages if t < 4.0 or m.camera == "cam0" or t > 7.0]
    filtered, smoothed = follow(calibrated(one.calibration), only)
    alone = [track for track in filtered if 5.0 < track.reference_time_ns / NANOSECONDS - EPOCH_S < 7.0]
    assert len(alone) > 40
    assert {track.state for track in alone} == {"coasting"}
    assert {track.cameras for track in alone} == {1}
    for track in alone[::10]:
        error, covariance = one.error(track), np.array(track.position_covariance).reshape(3, 3)
        assert error @ np.linalg.solve(covariance, error) < 30.0
    for tracks in (filtered, smoothed):
        assert max(np.linalg.norm(one.error(track)) for track in confirmed(tracks)[30:]) < 0.08
        assert tracks[-1].state == "confirmed"


def test_a_tracks_first_rows_may_arrive_before_the_calibration() -> None:
    live, one = LiveTracking(), plain()
    early = [pair for pair in one.messages if pair[0] < 3.0]
    for _, message in early:
        live.handle(message)
    calibrated(one.calibration, live)
    (track,) = tracks_of(live.tick(3.0))
    assert track.state == "confirmed"
    assert np.linalg.norm(one.error(track)) < 0.03


def test_refined_calibrations_in_one_gauge_do_not_disturb_a_track() -> None:
    one, rng = plain(), np.random.default_rng(2)
    live, filtered, smoothed = LiveTracking(), [], []
    for second in range(10):
        refined = {}
        for name, camera in one.calibration.items():
            turn, shift, later = so3.exp(rng.normal(0, 2e-4, 3)), rng.normal(0, 1e-3, 3), rng.normal(0, 5e-4)
            clock = replace(camera.time_map, time_offset=camera.time_map.time_offset + later)
            pose = Pose(turn @ camera.pose.rotation, camera.pose.position + shift)
            refined[name] = replace(camera, pose=pose, time_map=clock)
        calibrated(refined, live)
        part = follow(live, [pair for pair in one.messages if second <= pair[0] < second + 1])
        filtered += part[0]
        smoothed += part[1]
    known = filtered[30:]
    assert {track.state for track in known} == {"confirmed"}
    assert live.markers._labels[DEFAULT_LABEL].state.serial == 1, "never begun again"
    assert rms(one, known) < 0.01
    for tracks in (known, smoothed[10:]):
        assert np.diff([track.reference_time_ns for track in tracks]).max() < 0.12 * NANOSECONDS


def test_tracks_are_transformed_with_the_world_frame() -> None:
    one = plain()
    change = Similarity(2.5, so3.exp(np.array([0.3, -0.2, 0.8])), np.array([5.0, -2.0, 1.0]))
    live = calibrated(one.calibration)
    follow(live, [pair for pair in one.messages if pair[0] < 5.0])
    calibrated({n: replace(c, pose=change.pose(c.pose)) for n, c in one.calibration.items()}, live)
    filtered, _ = follow(live, [pair for pair in one.messages if pair[0] >= 5.0])
    assert live.markers._labels[DEFAULT_LABEL].state.serial == 1
    assert {track.state for track in filtered} == {"confirmed"}
    truth = change.points(np.array([one.truth(track) for track in filtered]))
    assert np.linalg.norm(truth - [track.position for track in filtered], axis=1).max() < 2.5 * 0.03


def test_another_reference_clock_begins_anew() -> None:
    one = plain()
    live = calibrated(one.calibration)
    follow(live, [pair for pair in one.messages if pair[0] < 5.0])
    shifted = {
        name: replace(camera, time_map=replace(camera.time_map, time_offset=camera.time_map.time_offset - 1e6))
        for name, camera in one.calibration.items()
    }
    live.calibrate(shifted, {}, reference="cam1", scale="arbitrary", units="m", up=None)
    filtered, _ = follow(live, [pair for pair in one.messages if pair[0] >= 5.0])
    assert len(confirmed(filtered)) > 100


@pytest.mark.parametrize(
    "fault",
    ["hours ahead", "two ahead", "hours back", "nan", "covariance", "flood of rows", "flood of labels", "first wild"],
)
def test_a_faulty_camera_costs_only_itself(fault: str) -> None:
    one = stream(simulate(11, 4, 8.0, late=0.2, fps=(30.0, 25.0, 30.0)))
    rng = np.random.default_rng(1)

    def spoil(arrival: float, message: pb.Observation) -> bool:
        if fault == "two ahead" and message.camera == "cam2" and arrival > 3.0:
            message.device_time_ns += 86_400 * NANOSECONDS
        if message.camera != "cam3" or (arrival < 3.0 and fault != "first wild"):
            return True
        found = message.detections[0]
        if fault in ("hours ahead", "two ahead", "first wild"):
            message.device_time_ns += 7200 * NANOSECONDS
        elif fault == "hours back":
            message.device_time_ns -= 7200 * NANOSECONDS
        elif fault == "nan":
            found.u = float(rng.choice([np.nan, np.inf, 1e300]))
        elif fault == "covariance":
            found.covariance.extend(rng.choice([np.nan, -1.0, 0.0, 1e300], 3).tolist())
        elif fault == "flood of labels":
            for number in range(100):
                message.detections.add(u=rng.uniform(0, SIZE[0]), v=10.0, label=f"{arrival}-{number}")
        return True

    messages = changed(one.messages, spoil)
    if fault == "flood of rows":
        rows = [pair for pair in messages if pair[1].camera == "cam3" and 3.0 < pair[0] < 4.0]
        for copy in range(1, 60):
            for arrival, message in changed(rows, lambda *_: True):
                message.device_time_ns += 500_000 * copy
                message.sequence += 10_000 * copy
                messages.append((arrival, message))
        messages.sort(key=lambda pair: pair[0])
    live = calibrated(one.calibration)
    if fault == "first wild":
        live.handle(next(message for _, message in messages if message.camera == "cam3"))
    filtered, _ = follow(live, messages)
    marker = [track for track in filtered if track.label == DEFAULT_LABEL]
    assert len(live.markers._labels) <= 65
    assert len(live.markers._labels[DEFAULT_LABEL]._rows.rows) < 500
    last = [track for track in confirmed(marker) if track.reference_time_ns / NANOSECONDS - EPOCH_S > 7.0]
    assert len(last) > 30
    assert max(np.linalg.norm(one.error(track)) for track in last) < 0.04


def test_labels_are_tracked_apart_and_targets_without_label_elsewhere() -> None:
    one = stream(simulate(5, 3, 6.0, labels={"red": range(3), "blue": range(3)}, late=0.2))
    live = calibrated(one.calibration)
    filtered, _ = follow(live, one.messages)
    assert not live.has_detections
    assert {track.label for track in filtered} == {"red", "blue"}
    assert [track.sequence for track in filtered] == list(range(len(filtered)))
    for label in ("red", "blue"):
        assert rms(one, [track for track in confirmed(filtered) if track.label == label][20:]) < 0.02
