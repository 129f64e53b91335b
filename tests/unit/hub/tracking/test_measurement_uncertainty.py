"""Robustness of tracking: head and foot outliers, ambiguous associations, clutter, false matches."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from edge.scenes.common.base import look_at_pose
from hub.tracking.association.assignment import (
    COLOUR_STD,
    matching_colour_std,
    update_colour_variance,
)
from hub.tracking.association.scan import marginal_probabilities
from hub.tracking.detections import TrackingCamera, frame_detections
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.measurement import student_t_cost, student_t_inflation
from hub.tracking.filter.target_states import DetectionStatistics, MultiTargetState, Targets
from hub.tracking.frame_update import process_frame
from hub.tracking.parameters import TrackerParameters
from hub.tracking.tracker import Tracker
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb

UP = np.array([0.0, 0.0, 1.0])
TALL = 1.7
LENS = Intrinsics(640, 480, np.array([[450.0, 0, 319.5], [0, 450.0, 239.5], [0, 0, 1.0]]))


def ring(count: int) -> dict[str, TrackingCamera]:
    """Cameras around a room whose clocks are all the reference."""
    out = {}
    for i in range(count):
        angle = 2 * np.pi * i / count + 0.3
        place = np.array([4.5 * np.cos(angle), 4.5 * np.sin(angle), 2.3])
        out[f"cam{i}"] = TrackingCamera(f"cam{i}", LENS, look_at_pose(place, 0.9 * UP), TimeMap(), 1e-4)
    return out


def person(camera: TrackingCamera, middle: Floats, time_ns: int, number: int, missing: float = 0.0) -> pb.Observation:
    """A person standing at ``middle``; a fraction of the height is missing at the foot, as behind a table."""
    message = pb.Observation(
        schema_version=1, camera=camera.name, boot_id="b", sequence=number, device_time_ns=camera.device_ns(time_ns)
    )
    shares = np.array([0.12, 0.5, missing - 0.5])
    point, head, foot = LENS.project(camera.pose.camera_from_world(middle + shares[:, None] * TALL * UP))
    message.detections.add(
        u=point[0], v=point[1], head=head.tolist(), foot=foot.tolist(), size=float(np.linalg.norm(head - foot)),
        kind="person", covariance=[9.0, 0.0, 36.0], colour=pb.Colour(red=90, green=120, blue=60),
    )  # fmt: skip
    return message


def test_a_box_in_a_rolled_camera_gives_head_and_foot_where_the_body_has_them() -> None:
    """Also beside the picture's middle, and whatever the lens does to straight lines."""
    curved = replace(LENS, distortions=np.array([-0.2, 0.05, 0.0, 0.0, 0.0]))
    for roll, lens in itertools.product((0.0, 0.15, -0.6), (LENS, curved)):
        pose = look_at_pose(np.array([4.0, 1.0, 2.6]), 0.9 * UP)
        pose = replace(pose, rotation=so3.exp(roll * UP) @ pose.rotation, position=pose.position)
        camera = TrackingCamera("cam", lens, pose, TimeMap())
        message = pb.Observation(schema_version=1, camera="cam", boot_id="b")
        middles = np.array([[-1.0, -1.0, 0.85], [0.0, 0.0, 0.85], [-1.0, 1.2, 0.85]])
        for middle in middles:
            ends = lens.project(pose.camera_from_world(middle + 0.5 * np.outer([1.0, -1.0], TALL * UP)))
            u, (top, bottom) = float(ends[:, 0].mean()), ends[:, 1].tolist()
            message.detections.add(u=u, v=0.5 * (top + bottom), head=[u, top], foot=[u, bottom], kind="person")
        frame = frame_detections(camera, message)
        seen = [pose.camera_from_world(middles + share * TALL * UP) for share in (0.5, -0.5)]
        for found, true in zip((frame.slanted(UP).head, frame.slanted(UP).foot), seen, strict=True):
            np.testing.assert_allclose(found, true[:, :2] / true[:, 2:], atol=0.01)
        assert frame.slanted(None) is frame


def test_occluded_feet_do_not_prevent_initiation() -> None:
    """Three of four cameras see no legs: points and heads determine the position."""
    cameras = ring(4)
    tracker = Tracker(TrackerParameters(up=UP))
    tracker.calibrate(cameras)
    middle = np.array([0.4, -0.3, 0.5 * TALL])
    for number in range(10):
        for index, camera in enumerate(cameras.values()):
            time_ns = round((0.1 * number + 0.025 * index) * NANOSECONDS)
            tracker.handle(person(camera, middle, time_ns, number, 0.4 if index else 0.0))
    targets = tracker.advance().targets
    assert targets.confirmed.sum() == 1
    assert np.linalg.norm(targets.mean[targets.confirmed][0, :2] - middle[:2]) < 0.1


def test_two_people_who_are_hidden_together_keep_their_numbers() -> None:
    """A metre apart, of one height and without colours: where each was says who is who."""
    cameras = ring(5)
    tracker = Tracker(TrackerParameters(up=UP))
    tracker.calibrate(cameras)
    places = np.array([[0.5, 0.0, 0.5 * TALL], [-0.5, 0.0, 0.5 * TALL]])
    before: dict[int, Floats] = {}
    for number in range(30):
        for index, camera in enumerate(cameras.values()):
            time_ns = round((0.5 * number + 0.02 * index) * NANOSECONDS)
            both = pb.Observation(
                schema_version=1, camera=camera.name, boot_id="b", sequence=number,
                device_time_ns=camera.device_ns(time_ns),
            )  # fmt: skip
            for place in places if not 16 <= number < 19 else ():
                both.MergeFrom(pb.Observation(detections=person(camera, place, time_ns, number).detections))
            for detection in both.detections:
                detection.ClearField("colour")
            tracker.handle(both)
        targets = tracker.advance().targets
        if number == 15:
            places[:, 1] += 0.1
            before = {int(i): mean[:2] for i, mean in zip(targets.number, targets.mean, strict=True)}
    assert len(before) == 2
    for number, mean in zip(targets.number.tolist(), targets.mean, strict=True):
        assert np.linalg.norm(mean[:2] - before[number]) < 0.3


def standing(cameras: dict[str, TrackingCamera], foot: float, seen_by: int) -> MultiTargetState:
    """State with one person whose foot is at a given height, recently seen by some cameras; the floor is at 0."""
    now = NANOSECONDS
    seen = np.full((1, len(cameras)), -(2**62), dtype=np.int64)
    seen[0, :seen_by] = now
    one = np.array([1])
    targets = Targets(
        initiation_number=one, number=one, kind=np.array([0]),
        mean=np.array([[0.4, -0.3, foot + 0.5 * TALL, 0.0, 0.0, 0.0, np.log(TALL)]]),
        covariance=np.diag([0.01, 0.01, 0.01, 0.1, 0.1, 0.1, 0.002])[None],
        colour=np.array([[90.0, 120.0, 60.0]]), colour_count=np.array([9.0]), born_ns=np.array([0]),
        seen_ns=np.array([now]), hits=np.array([50]), existence=np.array([0.99]),
        seen_by=seen, overlap=np.zeros(1),
    )  # fmt: skip
    empty = MultiTargetState.empty()
    return replace(
        empty,
        time_ns=now,
        cameras=tuple(cameras),
        targets=targets,
        next_initiation_number=2,
        next_number=2,
        floor=replace(Floor.unknown(UP, 1.0), covariance=np.diag([1e-4, 1e-6, 1e-6])),
    )


def test_a_target_off_the_floor_seen_by_two_cameras_is_deleted() -> None:
    """Two cameras that see different people can create a false match; a target that three cameras agree on is kept."""
    cameras = ring(5)
    for foot, seen_by, kept in ((0.0, 2, 1), (-0.7, 2, 0), (0.7, 2, 0), (-0.7, 4, 1)):
        camera = cameras["cam4"]
        empty = pb.Observation(schema_version=1, camera="cam4", boot_id="b", device_time_ns=NANOSECONDS + 1)
        after = process_frame(
            standing(cameras, foot, seen_by), frame_detections(camera, empty), cameras, TrackerParameters(up=UP)
        )
        assert len(after.targets) == kept, (foot, seen_by)
        assert len(after.lost) == 1 - kept, "it is kept for re-identification"


def exact_marginals(ratio: Floats) -> tuple[Floats, Floats]:
    """By enumeration of all assignments."""
    n, m = ratio.shape
    pairs, free, total = np.zeros((n, m)), np.zeros(m), 0.0
    for choice in itertools.product(range(-1, m), repeat=n):
        taken = [j for j in choice if j >= 0]
        if len(taken) != len(set(taken)):
            continue
        weight = float(np.prod([ratio[i, j] for i, j in enumerate(choice) if j >= 0]))
        total += weight
        for i, j in enumerate(choice):
            if j >= 0:
                pairs[i, j] += weight
        free += [weight * (j not in taken) for j in range(m)]
    return pairs / total, free / total


@given(arrays(np.float64, (3, 4), elements=st.floats(-3.0, 3.0)))
def test_marginal_probabilities_are_near_those_of_all_assignments(log_ratio: Floats) -> None:
    """Belief propagation is exact without loops, and near with them."""
    pairs, free = marginal_probabilities(np.exp(log_ratio))
    exact, exact_free = exact_marginals(np.exp(log_ratio))
    assert np.abs(pairs - exact).max() < 0.2
    assert np.abs(free - exact_free).max() < 0.2
    alone = marginal_probabilities(np.exp(log_ratio[:1]))
    assert np.allclose(alone[0], exact_marginals(np.exp(log_ratio[:1]))[0])


def test_clutter_does_not_pull_a_track_away() -> None:
    """An untracked person in other clothes half a metre aside does not move the target."""
    cameras = ring(3)
    camera = cameras["cam0"]
    before = standing(cameras, 0.0, 3)
    loose = np.diag([0.04, 0.04, 0.01, 0.1, 0.1, 0.1, 0.002])[None]
    before = replace(before, targets=replace(before.targets, covariance=loose))
    mean = before.targets.mean[0, :3]
    moved = []
    for aside, colour in ((0.15, (90, 120, 60)), (0.5, (160, 60, 140))):
        message = person(camera, mean + aside * camera.pose.rotation[0], NANOSECONDS + 1, 1)
        red, green, blue = colour
        message.detections[0].colour.CopyFrom(pb.Colour(red=red, green=green, blue=blue))
        after = process_frame(before, frame_detections(camera, message), cameras, TrackerParameters(up=UP)).targets
        moved.append(float(np.linalg.norm(after.mean[0, :2] - mean[:2])))
    assert moved[0] > 0.1, "its own detection does"
    assert moved[1] < 0.15


def test_an_ambiguous_detection_moves_no_target() -> None:
    """One detection between two targets: without the second, the first would move half of the way to it."""
    cameras = ring(3)
    camera = cameras["cam0"]
    side = camera.pose.rotation[0]
    alone = standing(cameras, 0.0, 3)
    alone = replace(alone, targets=replace(alone.targets, kind=np.array([2]), covariance=0.02 * np.eye(7)[None]))
    first = alone.targets
    twin = replace(first, initiation_number=np.array([2]), number=np.array([2]))
    shift = np.zeros((1, 7))
    shift[0, :3] = 0.5 * side
    twin = replace(twin, mean=first.mean + shift)
    # One is behind the other for the camera, and is expected to be detected all the same.
    alike = {"cam0": DetectionStatistics(clear=0.85, occluded=0.85)}
    both = replace(alone, targets=first.concatenate(twin), statistics=alike)
    (pixel,) = LENS.project(camera.pose.camera_from_world(first.mean[:, :3] + 0.25 * side))
    message = pb.Observation(schema_version=1, camera="cam0", boot_id="b", device_time_ns=NANOSECONDS + 1)
    message.detections.add(u=pixel[0], v=pixel[1], kind="marker", covariance=[4.0, 0.0, 4.0])
    moved = []
    for state in (alone, both):
        after = process_frame(state, frame_detections(camera, message), cameras, TrackerParameters(up=UP)).targets
        moved.append(float(np.linalg.norm(after.mean[:, :3] - state.targets.mean[:, :3], axis=1).max()))
    assert moved[0] > 0.2
    assert moved[1] < 0.4 * moved[0]


def test_the_student_t_weight_is_the_derivative_of_its_cost() -> None:
    squared = np.array([0.5, 1.9, 2.1, 10.0, 300.0])
    derivative = (student_t_cost(squared + 1e-6) - student_t_cost(squared - 1e-6)) / 2e-6
    assert np.allclose(derivative, 1.0 / student_t_inflation(squared), rtol=1e-6)
    assert student_t_inflation(np.array([np.nan])) == 1.0


def adapted_colour_std(off: float, doubtful: float) -> float:
    """After 3000 pairs whose channels are wrong by ``off``, up or down."""
    rng = np.random.default_rng(7)
    variance = MultiTargetState.empty().colour_variance
    for _ in range(1000):
        known = rng.uniform(20.0, 230.0, (3, 3))
        observed = known + off * rng.choice([-1.0, 1.0], (3, 3))
        observed[rng.integers(3)] = np.nan
        variance = update_colour_variance(variance, observed, known, np.full(3, doubtful))
    return matching_colour_std(variance)


def test_the_colour_variance_between_cameras_is_adapted() -> None:
    """If cameras agree, a small colour difference is significant; under different light it is not."""
    strict, usual, loose = (adapted_colour_std(off, 0.0) for off in (3.0, 10.0, 40.0))
    assert strict == 14.0
    assert 18.0 < usual < 22.0
    assert loose == COLOUR_STD
    assert adapted_colour_std(3.0, 0.4) == COLOUR_STD, "ambiguous pairs are not used"
