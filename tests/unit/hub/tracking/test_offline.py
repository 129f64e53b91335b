"""People followed through a whole recording: crowds of walkers in boxes at two frames a second."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.evaluation.clear_mot import EvaluationFrame, MotScores, clear_mot
from edge.scenes.common.base import look_at_pose
from hub.tracking import offline
from hub.tracking.association.initiation import LengthScale
from hub.tracking.association.reidentification import EntryExitRates
from hub.tracking.association.scan import associate_jointly
from hub.tracking.detections import TrackingCamera, frame_detections
from hub.tracking.filter.detection_model import posterior_existence
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.prediction import predict_targets
from hub.tracking.filter.target_states import MultiTargetState
from hub.tracking.frame_update import process_frame
from hub.tracking.offline import FollowResult, follow
from hub.tracking.parameters import TrackerParameters
from hub.tracking.smoothing import BatchSmoother
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from tests.bench import hall

UP = np.array([0.0, 0.0, 1.0])
LENS = Intrinsics(1280, 720, np.array([[900.0, 0, 639.5], [0, 900.0, 359.5], [0, 0, 1.0]]))
FPS, FRAMES, PEOPLE, CAMERAS = 2.0, 24, 8, 5


def walk(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Places (p, 2) and velocities (p, 2) of people who walk straight across a square of 12 m."""
    angle = rng.uniform(0.0, 2.0 * np.pi, PEOPLE)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    middle = rng.uniform(-3.0, 3.0, (PEOPLE, 2))
    speed = rng.uniform(0.6, 1.4, (PEOPLE, 1))
    return middle - along * speed * 0.5 * FRAMES / FPS, along * speed


def crowd(
    seed: int, lag_s: float, turn: float, height: float = 1.72, first: int = 0, low: float = 1.0
) -> tuple[list[pb.Observation], Calibration, Floats]:
    """Boxes with 10 % misses, 3 % noise and false ones; the calibration, and the true places (frames, p, 2).

    lag_s: largest lag of a camera's frames. turn: error of the calibration's attitudes [rad].
    height: of every second person, on average; the others have 1.72 [m]. first: frame from which those are seen. low:
    where those stand, the share of their height that they have in the second third of the frames.
    """
    rng = np.random.default_rng(seed)
    begun, velocity = walk(rng)
    if low < 1.0:
        begun[::2] += velocity[::2] * 0.5 * FRAMES / FPS
        velocity[::2] = 0.0
    tall = rng.normal(1.72, 0.06, PEOPLE)
    tall[::2] *= height / 1.72
    messages, cameras = [], {}
    for index in range(CAMERAS):
        name, angle = f"cam{index}", 2.0 * np.pi * index / CAMERAS + 0.2
        pose = look_at_pose(np.array([11.0 * np.cos(angle), 11.0 * np.sin(angle), 2.2 + 0.5 * index]), 0.9 * UP)
        given_pose = Pose(so3.exp(rng.normal(0.0, turn, 3)) @ pose.rotation, pose.position)
        clock = 1000.0 * index
        lag = lag_s * index / CAMERAS
        cameras[name] = CameraCalibration(name, LENS, given_pose, TimeMap(1.0, -clock), 1e-3, np.zeros(3), 1.0)
        for frame in range(FRAMES):
            time = frame / FPS + lag
            foot = np.column_stack([begun + velocity * time, np.zeros(PEOPLE)])
            now = tall.copy()
            now[::2] *= low if FRAMES / 3 <= frame < 2 * FRAMES / 3 else 1.0
            ends = [LENS.project(pose.camera_from_world(foot + above)) for above in (0.0, now[:, None] * UP)]
            message = pb.Observation(
                schema_version=1, camera=name, boot_id="b", sequence=frame, frame=frame,
                device_time_ns=round((time + clock) * NANOSECONDS),
            )  # fmt: skip
            there = np.arange(PEOPLE)[(np.arange(PEOPLE) % 2 == 1) | (frame >= first)]
            middle = 0.5 * (ends[0] + ends[1])[:, 0]
            for u, bottom, top in zip(middle[there], ends[0][there, 1], ends[1][there, 1], strict=True):
                noise = 0.03 * (bottom - top) * rng.normal(size=3)
                if rng.random() < 0.1 or not (0.0 < u < LENS.width and top > 0.0 and bottom < LENS.height):
                    continue
                add(message, u + noise[0], top + noise[1], bottom + noise[2])
            for _ in range(int(rng.poisson(0.5))):
                high, size = rng.uniform(50.0, 500.0), rng.uniform(60.0, 200.0)
                add(message, rng.uniform(0.0, LENS.width), high, high + size)
            messages.append(message)
    calibration = Calibration(cameras=cameras, reference="cam0", scale="metric", units="m", solver="given", version="")
    at = np.arange(FRAMES) / FPS
    return messages, calibration, begun + velocity * at[:, None, None]


def add(message: pb.Observation, u: float, top: float, bottom: float) -> None:
    message.detections.add(
        u=u, v=0.62 * top + 0.38 * bottom, head=[u, top], foot=[u, bottom], size=bottom - top, kind="person", score=1.0
    )


def scores(result: FollowResult, truth: Floats) -> MotScores:
    frames = []
    for index, true in enumerate(truth):
        inside = np.abs(true).max(axis=1) < 6.0
        here = [(t, int(np.flatnonzero(np.abs(t.times - index / FPS) < 1e-6)[0])) for t in result.tracks
                if (np.abs(t.times - index / FPS) < 1e-6).any()]  # fmt: skip
        found = np.array([t.position[i, :2] for t, i in here]).reshape(-1, 2)
        kept = [k for k in range(len(here)) if np.abs(found[k]).max() < 6.0]
        names = tuple(str(i) for i in np.flatnonzero(inside))
        frames.append(EvaluationFrame(names, true[inside], tuple(str(here[k][0].id) for k in kept), found[kept]))
    return clear_mot(frames, 0.5)


@pytest.mark.parametrize(("lag_s", "turn"), [(0.0, np.radians(0.2)), (0.25, 0.0)])
def test_a_crowd_at_two_frames_a_second(lag_s: float, turn: float) -> None:
    """With an imperfect calibration, and with cameras that are up to a quarter of a second apart."""
    messages, calibration, truth = crowd(3, lag_s, turn)
    times = [round(frame / FPS * NANOSECONDS) for frame in range(FRAMES)]
    result = follow(messages, calibration, times)
    found = scores(result, truth)
    assert found.mota > 0.93
    assert found.idf1 > 0.93
    assert found.error < 0.15
    assert all(0.5 < track.std.max() / 0.05 < 40.0 for track in result.tracks)
    assert result.cameras["cam0"].used > 0.8
    assert 1.55 < np.median([np.median(track.height) for track in result.tracks]) < 1.9


@pytest.mark.parametrize(("count", "most"), [(FRAMES, 3_000_000), (20_000, 20_000_000)])
def test_memory_for_frames_and_for_wanted_times(count: int, most: int) -> None:
    """2 kB a person and frame, where states and evidence took 4; and no table of all times by all detections, which
    took 16 GB for who is seen for an hour."""
    messages, calibration, _ = crowd(3, 0.0, 0.0)
    times = np.linspace(0.0, FRAMES / FPS * NANOSECONDS, count).astype(np.int64).tolist()
    tracemalloc.start()
    try:
        follow(messages, calibration, times, up=UP, iterations=2)
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def test_who_sits_down_and_stands_up_keeps_the_number() -> None:
    """People who sat down were no longer what their track predicted, and began another one; so they did on rising."""
    messages, calibration, truth = crowd(3, 0.0, 0.0, low=0.72)
    result = follow(messages, calibration, [round(frame / FPS * NANOSECONDS) for frame in range(FRAMES)])
    found = scores(result, truth)
    assert found.idf1 > 0.93
    assert found.mota > 0.93
    lowered = [float(np.ptp(track.height)) for track in result.tracks]
    assert sum(0.3 < one < 0.7 for one in lowered) >= PEOPLE // 2


def test_small_children_are_followed_beside_adults() -> None:
    """No height of 9 stds of adults' was believed: whom fewer than seven cameras saw was nobody."""
    messages, calibration, truth = crowd(3, 0.0, 0.0, height=0.9)
    result = follow(messages, calibration, [round(frame / FPS * NANOSECONDS) for frame in range(FRAMES)], up=UP)
    assert scores(result, truth).mota > 0.9
    assert sum(np.median(track.height) < 1.0 for track in result.tracks) == PEOPLE // 2


def test_children_who_come_after_the_floor_is_known_are_followed() -> None:
    """Tracks then began from one camera and a typical height alone: who came later and was small was nobody."""
    messages, calibration, _ = crowd(3, 0.0, 0.0, height=1.0, first=8)
    result = follow(messages, calibration, [round(frame / FPS * NANOSECONDS) for frame in range(FRAMES)], up=UP)
    assert sum(np.median(track.height) < 1.2 for track in result.tracks) == PEOPLE // 2
    assert len(result.tracks) == PEOPLE


def test_second_boxes_of_legs_are_no_children() -> None:
    """As of a detector that boxes one person in five twice, from the hip down too."""
    messages, calibration, truth = crowd(3, 0.0, 0.0)
    rng = np.random.default_rng(1)
    for message in messages:
        for one in list(message.detections):
            if rng.random() < 0.2:
                add(message, one.u, 0.45 * one.foot[1] + 0.55 * one.head[1], one.foot[1])
    result = follow(messages, calibration, [round(frame / FPS * NANOSECONDS) for frame in range(FRAMES)], up=UP)
    assert scores(result, truth).mota > 0.9


def test_a_camera_whose_picture_is_mirrored_is_a_warning() -> None:
    """It followed nobody, or others than the other cameras, without a word."""
    messages, calibration, _ = crowd(3, 0.0, 0.0)
    times = [round(frame / FPS * NANOSECONDS) for frame in range(FRAMES)]
    assert follow(messages, calibration, times, up=UP).warnings == ()
    for message in messages:
        for one in message.detections if message.camera == "cam2" else ():
            one.u = LENS.width - one.u
            one.head[0], one.foot[0] = one.u, one.u
    (warning,) = follow(messages, calibration, times, up=UP).warnings
    assert warning.startswith("cam2: ")
    assert "are its pixels, pose and time offset right?" in warning


def test_who_vanishes_from_all_cameras_is_the_same_person_afterwards_and_has_no_rows_between() -> None:
    """Nobody is detected for 1.5 s, as where people walk off the part of the ground that is looked at."""
    messages, calibration, truth = crowd(3, 0.0, 0.0)
    for message in messages:
        if 10 <= message.sequence < 13:
            del message.detections[:]
    result = follow(messages, calibration, [round(frame / FPS * NANOSECONDS) for frame in range(FRAMES)])
    hidden = np.array([5.0, 5.5, 6.0])
    assert not any(np.isin(np.round(track.times, 6), hidden).any() for track in result.tracks)
    truth[10:13] = np.inf
    assert scores(result, truth).idf1 > 0.93


@pytest.mark.parametrize("seed", [1, 3])
def test_who_walks_up_to_somebody_and_stops_is_not_exchanged_with_him(seed: int) -> None:
    """0.55 m apart before three low cameras at 2 Hz: a scan's detections of both may be mixed where one stops."""
    rng = np.random.default_rng(seed)
    time, count = np.arange(36) / FPS, 36
    paths = []
    for stand, angle, arrival in (
        (-np.ones(2), rng.uniform(0.0, 6.28), 4.0),
        (np.array([1.5, 1.0]), rng.uniform(0.0, 6.28), 7.0),
    ):
        away = np.clip(0.55 + 1.4 * (arrival - time), 0.55, 5.0)
        paths += [np.tile(stand, (count, 1)), stand + away[:, None] * [np.cos(angle), np.sin(angle)]]
    place = np.stack(paths, axis=1) + rng.normal(0.0, 0.02, (count, 4, 2))
    messages, calibration = boxes(rng, place, cameras=3, height=2.2)
    result = follow(messages, calibration, [round(at * NANOSECONDS) for at in time])
    assert scores(result, place).idf1 > 0.95


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_who_stands_beside_somebody_and_sets_off_keeps_his_identity(seed: int) -> None:
    """Three pairs, 0.6 m apart, at 2 Hz: one of each walks off at 1.4 m/s from one frame to the next."""
    rng = np.random.default_rng(seed)
    time, paths = np.arange(24) / FPS, []
    for index, middle in enumerate(([-2.0, -2.0], [2.0, -1.5], [0.0, 2.0])):
        angle = rng.uniform(0.0, 2.0 * np.pi, 2)
        beside, along = (np.array([np.cos(a), np.sin(a)]) for a in angle)
        away = 1.4 * np.clip(time - 5.0 - index, 0.0, 2.5)
        paths += [np.tile(middle, (24, 1)), middle + 0.6 * beside + away[:, None] * along]
    place = np.stack(paths, axis=1) + rng.normal(0.0, 0.02, (24, 6, 2))
    messages, calibration = boxes(rng, place, cameras=4, height=3.0)
    result = follow(messages, calibration, [round(at * NANOSECONDS) for at in time])
    assert scores(result, place).idf1 > 0.97


@pytest.mark.parametrize("seed", [0, 1])
def test_a_track_that_takes_over_somebody_else_is_cut_once(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where one leaves and another enters, a head taller, the tracker has given both one track."""
    rng = np.random.default_rng(seed)
    time, paths = np.arange(24) / FPS, []
    for index, corner in enumerate(([-4.0, -3.0], [-4.0, 0.0], [-4.0, 3.0])):
        change = 4.0 + index
        leaving = corner + np.array([1.3, 0.0]) * time[:, None]
        entering = corner + np.array([1.3 * change + 0.3, 0.0]) - np.array([1.3, 0.0]) * (time[:, None] - change)
        paths += [np.where(time[:, None] < change, leaving, np.nan), np.where(time[:, None] < change, np.nan, entering)]
    place = np.stack(paths, axis=1) + rng.normal(0.0, 0.02, (24, 6, 2))
    messages, calibration = boxes(rng, place, cameras=4, height=3.0, tall=np.tile([1.55, 1.95], 3))
    smoother_of = offline._smoother

    def taken_over(*given: Any) -> BatchSmoother | None:
        smoother = smoother_of(*given)
        assert smoother is not None
        first, last = smoother._extents()
        names = np.arange(len(first))
        for row in np.flatnonzero(first > 5).tolist():
            names[row] = np.flatnonzero(np.abs(last - first[row]) < 2)[0]
        assert (names != np.arange(len(first))).any()
        for index in range(len(smoother.scans)):
            smoother._rename(index, names)
        smoother.run(1)
        first, last = smoother._extents()
        assert (first <= last).sum() <= 6
        return smoother

    monkeypatch.setattr(offline, "_smoother", taken_over)
    assert len(follow(messages, calibration, [round(at * NANOSECONDS) for at in time], up=UP).tracks) == 6


def test_what_lies_between_two_exchanged_tracks_is_associated_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two stand together, and over three scans their tracks may have glided from one to the other."""
    rng = np.random.default_rng(0)
    place = np.array([[-0.4, 0.0], [0.4, 0.0]]) + rng.normal(0.0, 0.02, (14, 2, 2))
    messages, calibration = boxes(rng, place, cameras=4, height=3.0)
    made: list[BatchSmoother] = []
    monkeypatch.setattr(BatchSmoother, "run", lambda self, **_: made.append(self) or [])
    follow(messages, calibration, [0])
    (smoother,) = made
    forward, backward = smoother._filter(1), smoother._filter(-1)
    own = np.eye(2, dtype=np.bool_)

    def scored(*given: Any) -> Floats:
        return np.where(own, 0.0, 9.0) if given[5] == 6 else np.where(own, 9.0, 0.0)

    monkeypatch.setattr(smoother, "_link_scores", scored)
    before = [[one.ids.tolist() for one in scan.frames] for scan in smoother.scans]
    smoother._exchange(forward, backward, 3)
    after = [[one.ids.tolist() for one in scan.frames] for scan in smoother.scans]
    assert after[:4] == before[:4]
    assert after[4:7] == [[[]] * 4] * 3
    assert after[7:] == [[[1 - row for row in ids] for ids in scan] for scan in before[7:]]
    assert smoother._changed[4:7].all()


@pytest.mark.parametrize("exchanged_at", [5, None])
def test_two_neighbours_get_the_futures_that_their_detections_support(
    exchanged_at: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two walk side by side at 2 Hz; their tracks are exchanged at one scan, or at none."""
    rng = np.random.default_rng(0)
    place = np.array([[-0.4, 0.0], [0.4, 0.0]]) + 0.5 * np.arange(12)[:, None, None] * np.array([0.0, 1.0])
    messages, calibration = boxes(rng, place - [0.0, 2.75], cameras=4, height=3.0)
    made: list[BatchSmoother] = []
    monkeypatch.setattr(BatchSmoother, "run", lambda self, **_: made.append(self) or [])
    follow(messages, calibration, [0], up=UP)
    (smoother,) = made
    for index in range(len(smoother.scans) if exchanged_at is None else exchanged_at, len(smoother.scans)):
        smoother._rename(index, np.array([1, 0]))
    forward, backward = smoother._filter(1), smoother._filter(-1)
    for index in range(3, 9):
        follows = smoother._more_probable_futures(forward, backward, np.arange(2), index)
        # Before the exchange too: the detections of that scan are divided anew between the two.
        near = exchanged_at is not None and index in (exchanged_at - 1, exchanged_at)
        assert follows.tolist() == ([1, 0] if near else [0, 1])


def test_an_exchange_on_which_all_cameras_of_a_scan_agree_is_undone_as_a_whole() -> None:
    """Two walk side by side at 2 Hz; in the last scan every camera has taken each for the other."""
    rng = np.random.default_rng(0)
    place = np.array([[-0.4, 0.0], [0.4, 0.0]]) + 0.5 * np.arange(8)[:, None, None] * np.array([0.0, 1.0])
    messages, calibration = boxes(rng, place - [0.0, 1.75], cameras=4, height=3.0)
    cameras = {name: TrackingCamera.from_calibration(camera) for name, camera in calibration.cameras.items()}
    parameters = TrackerParameters(up=UP, scale=LengthScale(1.0, True))
    state = MultiTargetState.empty()
    for frame in sorted((frame_detections(cameras[one.camera], one) for one in messages), key=lambda one: one.key):
        state = process_frame(state, frame, cameras, parameters)
    scan, now, targets = state.scan, state.time_ns, state.targets
    assert scan is not None
    assert now is not None
    first, second = targets.initiation_number.tolist()
    wrong = tuple(replace(one, ids=first + second - one.ids) for one in scan.frames)
    there = replace(targets, mean=targets.mean[::-1], covariance=targets.covariance[::-1])
    prior = predict_targets(scan.prior, 0.5, parameters)
    found = associate_jointly(wrong, there, now, prior, UP, 28.0)
    for one, other in zip(found.frames, scan.frames, strict=True):
        assert dict(zip(one.ids, one.column, strict=True)) == dict(zip(other.ids, other.column, strict=True))


def test_people_come_and_go_at_doors() -> None:
    """Thirty walk from one wall of a hall of 10 m to the other; their own beginning and end are no evidence."""
    side = np.linspace(-3.0, 3.0, 30)
    starts, ends = (np.column_stack([np.full(30, x), side, np.zeros(30)]) for x in (0.0, 10.0))
    along = np.linspace(0.0, 10.0, 16)
    visits = np.stack([np.broadcast_to(along, (30, 16)), np.repeat(side[:, None], 16, axis=1), np.zeros((30, 16))], -1)
    rates = EntryExitRates.of(starts, ends, visits.reshape(-1, 3), 200, 1.0)
    here = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    entry, leaving = (
        rates.log_entry(np.zeros(3, dtype=np.int64), here),
        rates.log_exit(np.zeros(3, dtype=np.int64), here),
    )
    assert entry[0] - entry[1] > 3.0
    assert leaving[2] - leaving[1] > 3.0
    alone = EntryExitRates.of(starts[:1], ends[:1], visits[0], 200, 1.0)
    assert alone.log_entry(np.zeros(1, dtype=np.int64), starts[:1]) == alone.log_entry(
        np.zeros(1, dtype=np.int64), here[1:2]
    )


def test_a_hall_that_is_full_at_the_first_frame() -> None:
    """Eighty people at once are not taken for eighty false detections."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.linspace(-5.0, 5.0, 8), np.linspace(-5.0, 5.0, 10)), axis=-1).reshape(-1, 2)
    place = np.tile(grid, (4, 1, 1)) + rng.normal(0.0, 0.02, (4, 80, 2))
    messages, calibration = boxes(rng, place, cameras=5, height=7.0)
    result = follow(messages, calibration, [round(frame / FPS * NANOSECONDS) for frame in range(4)])
    assert scores(result, place).mota > 0.8


def boxes(
    rng: np.random.Generator, place: Floats, cameras: int, height: float, tall: float | Floats = 1.72
) -> tuple[list[pb.Observation], Calibration]:
    """Boxes of people at places (frames, p, 2), NaN = absent, with 10 % misses and 3 % noise, by cameras on a ring."""
    messages, known = [], {}
    for index in range(cameras):
        name, angle = f"cam{index}", 2.0 * np.pi * index / cameras + 0.2
        pose = look_at_pose(np.array([11.0 * np.cos(angle), 11.0 * np.sin(angle), height]), 0.9 * UP)
        known[name] = CameraCalibration(name, LENS, pose, TimeMap(1.0, 0.0), 1e-3, np.zeros(3), 1.0)
        for frame, here in enumerate(place):
            foot = np.column_stack([here, np.zeros(len(here))])
            feet, heads = (
                LENS.project(pose.camera_from_world(foot + up)) for up in (0.0 * UP, np.multiply.outer(tall, UP))
            )
            message = pb.Observation(
                schema_version=1, camera=name, boot_id="b", sequence=frame, frame=frame,
                device_time_ns=round(frame / FPS * NANOSECONDS),
            )  # fmt: skip
            for u, bottom, top in zip(0.5 * (feet + heads)[:, 0], feet[:, 1], heads[:, 1], strict=True):
                noise = 0.03 * (bottom - top) * rng.normal(size=3)
                if rng.random() > 0.1 and np.isfinite(u):
                    add(message, u + noise[0], top + noise[1], bottom + noise[2])
            messages.append(message)
    return messages, Calibration(cameras=known, reference="cam0", scale="metric", units="m", solver="given", version="")


def test_nothing_to_follow_is_refused() -> None:
    _, calibration, _ = crowd(3, 0.0, 0.0)
    with pytest.raises(Refused, match="no calibrated camera"):
        follow([pb.Observation(camera="cam0", device_time_ns=1)], calibration, [0])


@given(st.floats(0.01, 0.99), st.floats(0.02, 0.98))
def test_existence_after_a_miss_and_a_certain_detection(existence: float, probability: float) -> None:
    """Bayes' rule in closed form; a frame that is not independent changes the odds less."""
    before, detection = np.array([existence]), np.array([probability])
    missed = posterior_existence(before, detection, np.zeros(1), 1.0)
    assert missed[0] == pytest.approx(existence * (1 - probability) / (1 - existence * probability))
    assert posterior_existence(before, detection, np.ones(1), 1.0)[0] > 0.999
    part = posterior_existence(before, detection, np.zeros(1), 0.3)
    assert missed[0] <= part[0] <= existence


def test_cameras_at_different_heights_tell_level_and_typical_height() -> None:
    """People of 1.85 m on a floor at -0.4: the prior height of 1.7 m would put the floor 9 % nearer."""
    rng = np.random.default_rng(0)
    views = np.array(
        [
            (camera, high, (high + 0.4) / rng.normal(1.85, 0.05))
            for camera, high in enumerate((1.6, 2.4, 3.5, 6.0))
            for _ in range(40)
        ]
    )
    floor = Floor.unknown(UP, 1.0)
    assert not floor.known
    floor = floor.with_views(views, 2)
    assert floor.known
    assert floor.mean[0] == pytest.approx(-0.4, abs=0.08)
    assert floor.height == pytest.approx(1.85, abs=0.06)
    standing = rng.uniform(-3.0, 3.0, (200, 3))
    standing[:, 2] = -0.4 + 0.01 * standing[:, 0]
    for foot in standing:
        floor = floor.with_feet(foot[None])
    assert np.abs(floor.heights(standing)[0] - standing[:, 2]).max() < 0.04


def test_vehicles_where_different_ones_are_seen_in_one_place() -> None:
    """On a street rays of different cars cross above it: the tracks of these crossings, and of one camera alone."""
    rng = np.random.default_rng(5)
    lane, begin = np.array([-5.0, -2.0, 2.0, 5.0] * 2), np.array([-60.0, -52.0, 60.0, 66.0, -88.0, -80.0, 90.0, 97.0])
    velocity = np.where(lane < 0.0, 1.0, -1.0) * rng.uniform(11.0, 15.0, len(lane))

    def cars(time: float) -> Floats:
        return np.column_stack([begin + velocity * time, lane, np.full(len(lane), 0.75)])

    messages, cameras = [], {}
    for index in range(4):
        name, angle = f"cam{index}", 0.5 * np.pi * index + 0.4
        pose = look_at_pose(np.array([35.0 * np.cos(angle), 21.0 * np.sin(angle), 7.0 + 2.0 * (index % 2)]), 0.5 * UP)
        cameras[name] = CameraCalibration(name, LENS, pose, TimeMap(1.0, 0.0), 1e-3, np.zeros(3), 1.0)
        for frame in range(100):
            time = frame / 12.5
            message = pb.Observation(
                schema_version=1, camera=name, boot_id="b", sequence=frame, frame=frame,
                device_time_ns=round(time * NANOSECONDS),
            )  # fmt: skip
            seen = pose.camera_from_world(cars(time) + rng.normal(0.0, 0.1, (len(lane), 3)))
            pixels = LENS.project(seen) + rng.normal(0.0, 1.5, (len(lane), 2))
            inside = (seen[:, 2] > 1.0) & (pixels > 0.0).all(axis=1) & (pixels < [LENS.width, LENS.height]).all(axis=1)
            inside &= rng.random(len(lane)) > 0.1
            places = [*pixels[inside].tolist()]
            places += [(rng.uniform(0.0, 1280.0), rng.uniform(200.0, 700.0)) for _ in range(int(rng.poisson(0.3)))]
            for u, v in places:
                message.detections.add(u=u, v=v, kind="vehicle", score=1.0)
            messages.append(message)
    calibration = Calibration(cameras=cameras, reference="cam0", scale="metric", units="m", solver="given", version="")
    times = [round(frame / 12.5 * NANOSECONDS) for frame in range(100)]
    result = follow(messages, calibration, times, up=UP)
    rows = [(time, place) for track in result.tracks for time, place in zip(track.times, track.position, strict=True)]
    off = np.array([np.linalg.norm(cars(time) - place, axis=1).min() for time, place in rows])
    assert len(rows) > 300
    assert (off > 3.0).mean() < 0.1
    assert len(result.tracks) <= len(lane)
    assert all(track.std.max() < 1.8 for track in result.tracks)


def test_a_vehicle_before_cameras_of_different_rates() -> None:
    """Half a second of each camera counts, not half a second of the fastest one's frames."""
    messages, cameras = [], {}
    for index, fps in enumerate((30, 5)):
        pose = look_at_pose(np.array([-8.0 + 16.0 * index, -20.0, 6.0]), 0.5 * UP)
        cameras[f"cam{index}"] = CameraCalibration(f"cam{index}", LENS, pose, TimeMap(1.0, 0.0), 1e-3, np.zeros(3), 1.0)
        for frame in range(round(2.5 * fps)):
            message = pb.Observation(
                schema_version=1, camera=f"cam{index}", boot_id="b", sequence=frame, frame=frame,
                device_time_ns=round(frame / fps * NANOSECONDS),
            )  # fmt: skip
            at = np.array([[-5.0 + 4.0 * frame / fps, 0.0, 0.75]])
            u, v = LENS.project(pose.camera_from_world(at))[0].tolist()
            message.detections.add(u=u, v=v, kind="vehicle", score=1.0)
            messages.append(message)
    calibration = Calibration(cameras=cameras, reference="cam0", scale="metric", units="m", solver="given", version="")
    result = follow(messages, calibration, [round(frame / 30 * NANOSECONDS) for frame in range(75)], up=UP)
    assert [len(track.times) > 50 for track in result.tracks] == [True]


@pytest.mark.parametrize("units_per_m", [0.12, 30.0])
def test_a_world_without_units_has_the_scale_of_its_people(units_per_m: float) -> None:
    """Calibrated without a length, a baseline of 8 m was taken for 1 m, and of six people two were followed."""
    seen = hall.simulated(4, cameras=4, people=6, fps=5.0, seconds=10.0, half=2.5)
    cameras = {
        name: replace(one, pose=replace(one.pose, position=units_per_m * one.pose.position))
        for name, one in seen.calibration.cameras.items()
    }
    world = replace(seen.calibration, cameras=cameras, scale="arbitrary", units="baselines")
    messages, times = [message for _, message in seen.messages], [round(t * NANOSECONDS) for t in seen.times]
    found = follow(messages, world, times, up=hall.UP)
    assert len(found.tracks) == 6
    assert min(one.used for one in found.cameras.values()) > 0.8
