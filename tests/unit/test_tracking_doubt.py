"""What tracking does with what may be wrong: heads and feet that err far, other people's detections, ghosts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.tracking.association.assignment import COLOUR_STD, alikeness, ambiguity, colour_std
from hub.tracking.camera_frame import TrackingCamera, frame_of
from hub.tracking.filter.measurement import doubt, heavy
from hub.tracking.filter.target_states import State, Targets
from hub.tracking.filter.update import World, step
from hub.tracking.tracker import Tracker
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from tests.rigs import looking_at

UP = np.array([0.0, 0.0, 1.0])
TALL = 1.7
LENS = Intrinsics(640, 480, np.array([[450.0, 0, 319.5], [0, 450.0, 239.5], [0, 0, 1.0]]))


def ring(count: int) -> dict[str, TrackingCamera]:
    """Cameras round a room whose clocks are the reference."""
    out = {}
    for i in range(count):
        angle = 2 * np.pi * i / count + 0.3
        place = np.array([4.5 * np.cos(angle), 4.5 * np.sin(angle), 2.3])
        out[f"cam{i}"] = TrackingCamera(f"cam{i}", LENS, looking_at(place, 0.9 * UP), TimeMap(), 1e-4)
    return out


def person(camera: TrackingCamera, middle: Floats, time_ns: int, number: int, lacking: float = 0.0) -> pb.Observation:
    """One who stands at ``middle``; a share of the height is lacking at the foot, as where a table hides it."""
    message = pb.Observation(
        schema_version=1, camera=camera.name, boot_id="b", sequence=number, device_time_ns=camera.device_ns(time_ns)
    )
    shares = np.array([0.12, 0.5, lacking - 0.5])
    point, head, foot = LENS.project(camera.pose.camera_from_world(middle + shares[:, None] * TALL * UP))
    message.detections.add(
        u=point[0], v=point[1], head=head.tolist(), foot=foot.tolist(), size=float(np.linalg.norm(head - foot)),
        kind="person", covariance=[9.0, 0.0, 36.0], colour=pb.Colour(red=90, green=120, blue=60),
    )  # fmt: skip
    return message


def test_feet_that_are_hidden_do_not_keep_anybody_from_being_found() -> None:
    """Three of four cameras see no legs: where he is, points and heads tell."""
    cameras = ring(4)
    tracker = Tracker(World(up=UP))
    tracker.calibrate(cameras)
    middle = np.array([0.4, -0.3, 0.5 * TALL])
    for number in range(10):
        for index, camera in enumerate(cameras.values()):
            time_ns = round((0.1 * number + 0.025 * index) * NANOSECONDS)
            tracker.handle(person(camera, middle, time_ns, number, 0.4 if index else 0.0))
    targets = tracker.advance().targets
    assert targets.confirmed.sum() == 1
    assert np.linalg.norm(targets.mean[targets.confirmed][0, :2] - middle[:2]) < 0.1


def standing(cameras: dict[str, TrackingCamera], foot: float, seen_by: int) -> State:
    """Somebody whose foot is at a height, seen lately by some cameras, on a floor known to be at 0."""
    now = NANOSECONDS
    seen = np.full((1, len(cameras)), -(2**62), dtype=np.int64)
    seen[0, :seen_by] = now
    one = np.array([1])
    targets = Targets(
        identity=one, number=one, kind=np.array([0]),
        mean=np.array([[0.4, -0.3, foot + 0.5 * TALL, 0.0, 0.0, 0.0, np.log(TALL)]]),
        covariance=np.diag([0.01, 0.01, 0.01, 0.1, 0.1, 0.1, 0.002])[None],
        colour=np.array([[90.0, 120.0, 60.0]]), colour_count=np.array([9.0]), born_ns=np.array([0]),
        seen_ns=np.array([now]), hits=np.array([50]), chances=np.array([50]), support=np.ones(1), seen_by=seen,
        beside_s=np.zeros(1),
    )  # fmt: skip
    empty = State.empty()
    return replace(
        empty, time_ns=now, cameras=tuple(cameras), targets=targets, next_identity=2, next_number=2, floor_weight=1e3
    )


def test_who_leaves_the_floor_for_two_cameras_only_is_nobody() -> None:
    """Two cameras that see one person each can make a third one anywhere; what three cameras agree on stays."""
    cameras = ring(5)
    for foot, seen_by, kept in ((0.0, 2, 1), (-0.7, 2, 0), (0.7, 2, 0), (-0.7, 4, 1)):
        camera = cameras["cam4"]
        empty = pb.Observation(schema_version=1, camera="cam4", boot_id="b", device_time_ns=NANOSECONDS + 1)
        after = step(standing(cameras, foot, seen_by), frame_of(camera, empty), cameras, World(up=UP))
        assert len(after.targets) == kept, (foot, seen_by)
        assert len(after.gone) == 1 - kept, "he may come back under his name"


def test_a_pairing_is_as_doubtful_as_the_next_best_is_near() -> None:
    rows, columns = np.array([0, 1]), np.array([0, 1])
    nobody = np.full(2, np.inf)
    clear = ambiguity(np.array([[4.0, 200.0], [200.0, 4.0]]), rows, columns, nobody)
    assert clear.max() < 1e-6
    even = ambiguity(np.array([[4.0, 5.0], [6.0, 7.0]]), rows, columns, nobody)
    assert np.allclose(even, 0.5)
    alone = ambiguity(np.array([[4.0], [np.inf]]), rows[:1], columns[:1], nobody[:1])
    assert alone.max() < 1e-6
    either = ambiguity(np.array([[4.0], [4.0]]), rows[:1], columns[:1], nobody[:1])
    assert np.allclose(either, 0.5), "who has no detection may own this one"
    strange = ambiguity(np.array([[4.0, np.inf], [np.inf, 40.0]]), rows, columns, np.full(2, 40.0))
    assert strange[0] < 1e-3
    assert np.allclose(strange[1], 0.5), "what fits ill may be somebody's who is not followed"


def test_a_stranger_does_not_lead_anybody_away() -> None:
    """Who passes half a metre aside in other clothes, and is not followed yet, draws no target along."""
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
        after = step(before, frame_of(camera, message), cameras, World(up=UP)).targets
        moved.append(float(np.linalg.norm(after.mean[0, :2] - mean[:2])))
    assert moved[0] > 0.1, "his own detection does"
    assert moved[1] < 0.15


def test_what_may_be_anothers_moves_nobody() -> None:
    """One detection between two targets: alone, the first would go half of the way to it."""
    cameras = ring(3)
    camera = cameras["cam0"]
    side = camera.pose.rotation[0]
    alone = standing(cameras, 0.0, 3)
    alone = replace(alone, targets=replace(alone.targets, kind=np.array([2]), covariance=0.02 * np.eye(7)[None]))
    first = alone.targets
    twin = replace(first, identity=np.array([2]), number=np.array([2]))
    shift = np.zeros((1, 7))
    shift[0, :3] = 0.5 * side
    twin = replace(twin, mean=first.mean + shift)
    both = replace(alone, targets=first.joined(twin))
    (pixel,) = LENS.project(camera.pose.camera_from_world(first.mean[:, :3] + 0.25 * side))
    message = pb.Observation(schema_version=1, camera="cam0", boot_id="b", device_time_ns=NANOSECONDS + 1)
    message.detections.add(u=pixel[0], v=pixel[1], kind="marker", covariance=[4.0, 0.0, 4.0])
    moved = []
    for state in (alone, both):
        after = step(state, frame_of(camera, message), cameras, World(up=UP)).targets
        moved.append(float(np.linalg.norm(after.mean[:, :3] - state.targets.mean[:, :3], axis=1).max()))
    assert moved[0] > 0.2
    assert moved[1] < 0.2 * moved[0]


def test_the_weight_of_a_far_head_is_the_slope_of_what_it_costs() -> None:
    squared = np.array([0.5, 1.9, 2.1, 10.0, 300.0])
    slope = (heavy(squared + 1e-6) - heavy(squared - 1e-6)) / 2e-6
    assert np.allclose(slope, 1.0 / doubt(squared), rtol=1e-6)
    assert doubt(np.array([np.nan])) == 1.0


def learnt_colour_std(off: float, doubtful: float) -> float:
    """After 3000 pairings of which each channel is told ``off`` too high or too low."""
    rng = np.random.default_rng(7)
    variance = State.empty().colour_variance
    for _ in range(1000):
        known = rng.uniform(20.0, 230.0, (3, 3))
        told = known + off * rng.choice([-1.0, 1.0], (3, 3))
        told[rng.integers(3)] = np.nan
        variance = alikeness(variance, told, known, np.full(3, doubtful))
    return colour_std(variance)


def test_how_alike_cameras_see_colours_is_learnt() -> None:
    """Where they agree, a small difference tells people apart; where light differs, it does not."""
    strict, usual, loose = (learnt_colour_std(off, 0.0) for off in (3.0, 10.0, 40.0))
    assert strict == 14.0
    assert 18.0 < usual < 22.0
    assert loose == COLOUR_STD
    assert learnt_colour_std(3.0, 0.4) == COLOUR_STD, "pairings that may be wrong teach nothing"
