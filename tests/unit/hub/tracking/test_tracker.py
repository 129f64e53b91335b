"""The tracker on simulated detections: initiation, identity, rejected frames, bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from deploy.evaluation.tracking_scores import score_tracks
from edge import scenes
from edge.scenes.common.base import look_at_pose
from hub.tracking.association.initiation import LengthScale
from hub.tracking.calibration.vertical import VerticalEstimator
from hub.tracking.detections import TrackingCamera, frame_detections
from hub.tracking.frame_update import process_frame
from hub.tracking.live_tracking import LiveTracking
from hub.tracking.parameters import TrackerParameters
from hub.tracking.tracker import Tracker
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration
from tests.bench import hall
from tests.support.people_traffic import Faults, Traffic, cameras_of, film

UP = np.array([0.0, 0.0, 1.0])
LENS = Intrinsics(640, 480, np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1.0]]))


def ring(count: int, scale: float = 1.0) -> dict[str, TrackingCamera]:
    """Cameras around a room, with clocks offset by seconds."""
    out = {}
    for i in range(count):
        angle = 2 * np.pi * i / count + 0.3
        place = np.array([4.0 * np.cos(angle), 4.0 * np.sin(angle), 2.0])
        pose = look_at_pose(place, np.array([0.0, 0.0, 1.0]))
        name = f"cam{i}"
        out[name] = TrackingCamera(name, LENS, Pose(pose.rotation, scale * pose.position), TimeMap(1.0, -3.0 * i), 1e-4)
    return out


def points(
    cameras: dict[str, TrackingCamera],
    paths: list[Callable[[float], Floats]],
    seconds: float,
    *,
    noise_px: float = 0.5,
    kind: str = "marker",
    fps: float = 20.0,
) -> list[pb.Observation]:
    """Frames of unlabelled points from asynchronous cameras, in the order of capture."""
    rng = np.random.default_rng(5)
    out = []
    for index, (name, camera) in enumerate(cameras.items()):
        for number in range(int(seconds * fps)):
            true = (number + index / len(cameras)) / fps
            message = pb.Observation(
                schema_version=1, camera=name, boot_id="b", sequence=number, frame=number,
                device_time_ns=camera.device_ns(round(true * NANOSECONDS)),
            )  # fmt: skip
            for path in paths:
                (pixel,) = camera.intrinsics.project(camera.pose.camera_from_world(path(true)[None]))
                u, v = pixel + rng.normal(0, noise_px, 2)
                message.detections.add(u=u, v=v, score=1.0, kind=kind, covariance=[noise_px**2, 0.0, noise_px**2])
            out.append((true, message))
    return [message for _, message in sorted(out, key=lambda one: one[0])]


def follow(tracker: Tracker, messages: list[pb.Observation]) -> Tracker:
    for message in messages:
        tracker.handle(message)
        tracker.advance()
    return tracker


def tracker_of(cameras: dict[str, TrackingCamera], world: TrackerParameters | None = None) -> Tracker:
    tracker = Tracker(world or TrackerParameters(up=UP))
    tracker.calibrate(cameras)
    return tracker


def circle(
    radius: float, height: float, phase: float, speed: float = 1.0, scale: float = 1.0
) -> Callable[[float], Floats]:
    def at(t: float) -> Floats:
        angle = phase + speed * t / radius
        return scale * np.array([radius * np.cos(angle), radius * np.sin(angle), height])

    return at


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    """Seven seconds of three people in four cameras."""
    return film(scenes.get_people_scene(11, 4, 3), 7.0, 11)


def people_found(traffic: Traffic, tracker: Tracker) -> Floats:
    """Distance of every person's nearest track on the floor."""
    assert tracker.time_ns is not None
    truth = traffic.scene.centres(np.array([traffic.true_time_ns(tracker.time_ns)]))[0]
    known = tracker.targets.select(tracker.targets.confirmed)
    assert len(known) == len(truth), "as many tracks as people"
    return np.asarray(np.linalg.norm(truth[:, None, :2] - known.mean[None, :, :2], axis=2).min(axis=1))


def test_all_people_are_tracked_without_false_tracks(traffic: Traffic) -> None:
    """With false detections, missed detections and asynchronous cameras."""
    tracker = follow(tracker_of(cameras_of(traffic.scene, "cam0")), list(traffic.messages()))
    assert people_found(traffic, tracker).max() < 0.3
    heights = np.exp(tracker.targets.mean[tracker.targets.confirmed, 6])
    # Walking people are about 4 cm less tall than standing ones.
    walking = traffic.scene.heads(np.linspace(0.0, 7.0, 70))[:, :, 2].mean(axis=0)
    assert np.abs(np.sort(heights) - np.sort(walking)).max() < 0.06


def test_one_camera_alone_initiates_no_track(traffic: Traffic) -> None:
    messages = [m for m in traffic.messages() if m.camera == "cam1"]
    assert len(follow(tracker_of(cameras_of(traffic.scene, "cam0")), messages).targets) == 0


def test_tracks_survive_added_and_removed_cameras(traffic: Traffic) -> None:
    """cam3 is added after 3 s, cam0 is removed after 5 s: all tracks keep their numbers."""
    cameras = cameras_of(traffic.scene, "cam0")
    tracker = tracker_of({name: c for name, c in cameras.items() if name != "cam3"})
    arrivals = traffic.arrivals
    begin = arrivals[0][0]
    follow(tracker, [m for t, m in arrivals if t - begin < 3.0])
    before = set(tracker.targets.number[tracker.targets.confirmed].tolist())
    assert len(before) == 3
    tracker.calibrate(cameras)
    follow(tracker, [m for t, m in arrivals if 3.0 <= t - begin < 5.0])
    assert (tracker.targets.seen_by[:, tracker.state.cameras.index("cam3")] > 0).any()
    tracker.calibrate({name: c for name, c in cameras.items() if name != "cam0"})
    follow(tracker, [m for t, m in arrivals if t - begin >= 5.0])
    assert set(tracker.targets.number[tracker.targets.confirmed].tolist()) == before
    assert people_found(traffic, tracker).max() < 0.3
    assert tracker.counters["track.uncalibrated"] > 0


def test_false_matches_initiate_no_tracks() -> None:
    """Two cameras, two points at one height: their rays intersect in four places, of which only two are real."""
    cameras = ring(5)
    paths = [circle(1.0, 1.0, 0.0), circle(1.0, 1.0, np.pi)]
    tracker = follow(tracker_of(cameras), points(cameras, paths, 4.0))
    known = tracker.targets.select(tracker.targets.confirmed)
    assert len(known) == 2
    assert tracker.time_ns is not None
    truth = np.array([path(tracker.time_ns / NANOSECONDS) for path in paths])
    assert np.linalg.norm(truth[:, None] - known.mean[None, :, :3], axis=2).min(axis=1).max() < 0.02


@pytest.mark.parametrize("scale", [1e-3, 0.2, 1.0, 50.0])
def test_tracking_does_not_depend_on_the_scale_of_the_world(scale: float) -> None:
    """A calibration without known lengths: the scale is guessed from the rig, wrong by a factor of three."""
    cameras = ring(4, scale)
    paths = [circle(1.0, 1.0, 0.0, scale=scale), circle(1.5, 1.2, 2.0, scale=scale)]
    world = TrackerParameters(None, LengthScale(3.0 * scale, metric=False))
    tracker = follow(tracker_of(cameras, world), points(cameras, paths, 3.0))
    known = tracker.targets.select(tracker.targets.confirmed)
    assert len(known) == 2
    assert tracker.time_ns is not None
    truth = np.array([path(tracker.time_ns / NANOSECONDS) for path in paths])
    assert np.linalg.norm(truth[:, None] - known.mean[None, :, :3], axis=2).min(axis=1).max() < 0.03 * scale


def test_identities_survive_two_seconds_without_detections(traffic: Traffic) -> None:
    """All cameras are covered for 2 s; the identities are the same afterwards."""
    tracker = tracker_of(cameras_of(traffic.scene, "cam0"))
    begin = traffic.arrivals[0][0]
    shown: dict[bool, dict[str, int]] = {}
    for t, message in traffic.arrivals:
        if 3.5 < t - begin < 5.5:
            blind = pb.Observation()
            blind.CopyFrom(message)
            del blind.detections[:]
            message = blind
        tracker.handle(message)
        tracker.advance()
        if abs(t - begin - 3.4) < 0.02 or abs(t - begin - 6.9) < 0.05:
            assert tracker.time_ns is not None
            truth = traffic.scene.centres(np.array([traffic.true_time_ns(tracker.time_ns)]))[0]
            known = tracker.targets.select(tracker.targets.confirmed)
            nearest = np.linalg.norm(truth[:, None, :2] - known.mean[None, :, :2], axis=2).argmin(axis=1)
            names = known.number[nearest].tolist()
            shown[t - begin > 5.0] = dict(zip([p.name for p in traffic.scene.people], names, strict=True))
    assert len(set(shown[False].values())) == 3
    assert shown[True] == shown[False]


def test_people_who_were_exchanged_in_a_meeting_are_exchanged_back() -> None:
    """At 3 frames a second, who walks towards another and stops is where the other was expected.

    Without the second hypothesis IDF1 is 0.956 here.
    """
    known = hall.simulated(723, people=28, fps=3.0, seconds=10.0)
    scores = score_tracks(known.truth, hall.live(known), known.times, 1.0)
    assert float(scores["idf1"] or 0.0) > 0.97
    assert scores["switches"] == 0


def test_the_first_instant_is_published_with_all_its_cameras() -> None:
    """With its first camera's frame alone nobody was tracked at it, and its other frames were never published."""
    known = hall.simulated(1, cameras=5, people=4, fps=2.0, seconds=0.5)
    tracking = LiveTracking()
    tracking.calibrate(known.calibration.cameras, {}, reference="cam0", scale="metric", units="m", up=UP)
    published = []
    for _, message in known.messages:
        tracking.handle(message)
        published.append(bool(tracking.tick(0.0)))
    assert published == [False, False, False, False, True]


def test_two_tracks_at_one_position_become_the_older_one(traffic: Traffic) -> None:
    """They share the detections, so each keeps about half of them: the overlap test removes the younger one."""
    cameras, world = cameras_of(traffic.scene, "cam0"), TrackerParameters(up=UP)
    messages = list(traffic.messages())
    state = follow(tracker_of(cameras, world), messages[: len(messages) // 2]).state
    assert state.time_ns is not None
    begun = state.time_ns
    known = np.flatnonzero(state.targets.confirmed)
    one = state.targets.select(np.arange(len(state.targets)) == known[0])
    twin = replace(one, initiation_number=np.array([1000]), number=np.array([state.next_number]))
    twin = replace(twin, mean=one.mean + 0.08 * np.eye(7)[:1])
    state = replace(state, targets=state.targets.concatenate(twin), next_number=state.next_number + 1, scan=None)
    frames = [frame_detections(cameras[message.camera], message) for message in messages]
    later = sorted((frame for frame in frames if frame.reference_ns > begun), key=lambda each: each.key)
    numbers = []
    for frame in later:
        state = process_frame(state, frame, cameras, world)
        numbers.append((frame.reference_ns - begun, set(state.targets.number[state.targets.confirmed].tolist())))
    names = {int(number) for number in one.number} | {int(number) for number in twin.number}
    assert all(
        names & confirmed == set(one.number.tolist()) for after, confirmed in numbers if after > 1.5 * NANOSECONDS
    )


def test_frames_of_a_restarted_camera_are_rejected(traffic: Traffic) -> None:
    """Its clock has restarted, and the calibration refers to the old one."""
    tracker = tracker_of(cameras_of(traffic.scene, "cam0"))
    messages = list(traffic.messages())
    follow(tracker, messages[:100])
    fresh = pb.Observation()
    fresh.CopyFrom(messages[100])
    fresh.boot_id = "boot1"
    assert not tracker.handle(fresh)
    assert tracker.counters["track.unknown_clock"] == 1


def test_one_wrong_clock_does_not_make_all_others_late(traffic: Traffic) -> None:
    tracker = tracker_of(cameras_of(traffic.scene, "cam0"))
    messages = list(traffic.messages())
    follow(tracker, messages[:100])
    wild = pb.Observation()
    wild.CopyFrom(messages[100])
    wild.device_time_ns += 3600 * NANOSECONDS
    assert not tracker.handle(wild)
    assert tracker.counters["track.ahead"] == 1
    follow(tracker, messages[101:])
    assert tracker.counters["track.late"] == 0
    assert people_found(traffic, tracker).max() < 0.3


def test_frames_later_than_the_lag_are_counted_and_ignored(traffic: Traffic) -> None:
    tracker = tracker_of(cameras_of(traffic.scene, "cam0"))
    messages = list(traffic.messages())
    follow(tracker, messages[:120])
    before = tracker.targets.mean.tobytes()
    assert not tracker.handle(messages[3])
    tracker.advance()
    assert tracker.counters["track.late"] == 1
    assert tracker.targets.mean.tobytes() == before


def test_memory_stays_bounded() -> None:
    """Points that keep appearing and vanishing: only the lag's frames and a bounded number of lost targets are kept."""
    cameras = ring(3)
    tracker = tracker_of(cameras, TrackerParameters(up=UP, coast_s=0.3, remember_s=1.0, max_lost_tracks=3))
    path = circle(1.0, 1.0, 0.0)
    for number, message in enumerate(points(cameras, [path], 12.0)):
        if number // 60 % 2:
            del message.detections[:]
        tracker.handle(message)
        tracker.advance()
        assert len(tracker._frames.rows) <= 0.5 * 60 + 3
    assert tracker.state.next_initiation_number > 5
    assert len(tracker.state.lost) <= 3
    assert len(tracker.targets) <= 2


def test_the_vertical_is_estimated_from_people(traffic: Traffic) -> None:
    """In an arbitrarily rotated world, from asynchronous cameras and unidentified people."""
    turn = so3.exp(np.array([0.7, -0.4, 1.1]))
    cameras = cameras_of(traffic.scene, "cam0")
    live, vertical = Tracker(TrackerParameters(up=UP)), VerticalEstimator()
    live.calibrate(cameras)
    assert vertical.estimate({}) is None
    for message in traffic.messages():
        if live.handle(message) and live.newest_frame is not None:
            vertical.handle(live.newest_frame)
    poses = {n: Pose(c.pose.rotation @ turn.T, turn @ c.pose.position) for n, c in cameras.items()}
    up = vertical.estimate(poses)
    assert up is not None
    assert np.degrees(np.arccos(up @ turn @ UP)) < 3.0  # the lower foot is not below the head


def test_tracks_are_transformed_with_the_world_frame(traffic: Traffic) -> None:
    """After a calibration in another gauge the same tracks continue in the new frame."""
    cameras = cameras_of(traffic.scene, "cam0")
    tracker = tracker_of(cameras)
    messages = list(traffic.messages())
    follow(tracker, messages[:200])
    names = tracker.targets.number[tracker.targets.confirmed].tolist()
    change = Similarity(1.0, so3.exp(np.array([0.0, 0.0, 0.8])), np.array([5.0, -2.0, 0.0]))
    moved = {
        n: TrackingCamera(n, c.intrinsics, change.pose(c.pose), c.time_map, c.time_std) for n, c in cameras.items()
    }
    tracker.calibrate(moved, change)
    follow(tracker, messages[200:])
    known = tracker.targets.select(tracker.targets.confirmed)
    assert known.number.tolist() == names
    assert tracker.time_ns is not None
    truth = change.points(traffic.scene.centres(np.array([traffic.true_time_ns(tracker.time_ns)]))[0])
    assert np.linalg.norm(truth[:, None, :2] - known.mean[None, :, :2], axis=2).min(axis=1).max() < 0.3


def calibrations(traffic: Traffic) -> dict[str, CameraCalibration]:
    return {
        c.name: CameraCalibration(
            c.name, c.intrinsics, c.pose, traffic.scene.true_time_map(c.name, "cam0"), 1e-4, np.zeros(3), 0.5
        )
        for c in traffic.scene.cameras
    }


def live_tracks(traffic: Traffic, up: Floats | None) -> list[pb.Track | pb.Prediction]:
    live = LiveTracking()
    live.calibrate(calibrations(traffic), {}, reference="cam0", scale="metric", units="m", up=up)
    out = []
    for t, message in traffic.arrivals:
        live.handle(message)
        out += live.tick(t)
    return out  # type: ignore[return-value]


def test_predictions_match_the_true_image_positions(traffic: Traffic) -> None:
    """Head points and face boxes, in every camera, at the predicted time."""
    published = live_tracks(traffic, UP)
    predictions = [m for m in published if isinstance(m, pb.Prediction)][-20:]
    off, inside = [], []
    for prediction in predictions:
        for part in prediction.cameras:
            clock = traffic.scene.camera(part.camera).clock
            moment = clock.true_time(part.device_time_ns)
            heads = traffic.scene.seen_by(part.camera, traffic.scene.heads(np.array([moment])))[0]
            for target in part.targets:
                if not target.head:
                    continue
                distance = np.linalg.norm(heads - np.array(target.head), axis=1)
                nearest = int(np.nanargmin(distance))
                off.append(distance[nearest] / target.size)
                middle = traffic.scene.joints(np.array([moment]))[0][nearest, 1]
                u, v = traffic.scene.seen_by(part.camera, middle[None])[0]
                x, y, w, h = target.face
                inside.append(x < u < x + w and y < v < y + h)
                assert target.view in ("front", "back", "left", "right", "")
    assert len(off) > 100
    assert np.median(off) < 0.06
    assert np.mean(inside) > 0.85


def test_without_a_given_vertical_heights_are_still_estimated(traffic: Traffic) -> None:
    tracks = [m for m in live_tracks(traffic, None) if isinstance(m, pb.Track)]
    last = {track.label: track for track in tracks}
    assert len(last) == 3
    heights = sorted(track.height for track in last.values())
    assert np.abs(np.array(heights) - np.sort(traffic.scene.heights)).max() < 0.1


def test_equal_messages_give_equal_bytes(traffic: Traffic) -> None:
    one, two = ([m.SerializeToString(deterministic=True) for m in live_tracks(traffic, UP)] for _ in range(2))
    assert one == two


def test_noise_free_detections_are_tracked() -> None:
    clean = film(scenes.get_people_scene(5, 3, 1), 4.0, 5, Faults(0.0, 0.0, 0.0, 0.0, 0.0))
    tracker = follow(tracker_of(cameras_of(clean.scene, "cam0")), list(clean.messages()))
    assert people_found(clean, tracker).max() < 0.25
