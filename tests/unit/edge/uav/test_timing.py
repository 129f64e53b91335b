"""Clock alignment: the vehicle's clock to the host's, and the telemetry's to the camera's; navigation conversions."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from edge.uav.base import Telemetry
from edge.uav.navigation import Origin
from edge.uav.timing import clock_alignment
from edge.uav.timing.clock_alignment import CameraHostClock, ClockAligner
from edge.uav.timing.ground_motion import GroundMotion, RelativeRotations, compare_ways
from edge.uav.timing.telemetry_offset import CONTRADICTION, OffsetEstimate, find_offset
from edge.uav.timing.telemetry_track import TelemetryTrack
from edge.uav.timing.vehicle_clock import VehicleClock
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA, Flight, grid_times, rotation
from edge.uav.world.noise import smoothed_noise
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

SECOND = 1_000_000_000


def test_the_shortest_round_trip_bounds_the_offset_to_half_its_duration() -> None:
    rng = np.random.default_rng(3)
    clock = VehicleClock()
    true = 123_456_789_012
    for k in range(30):
        sent = k * SECOND // 2
        there, back = rng.integers(1_000_000, 40_000_000, 2)
        clock.handle_round_trip(sent, sent + int(there) + true, sent + int(there) + int(back))
    error = clock.offset_ns - true
    assert abs(error) <= 1e9 * clock.std_s
    assert clock.std_s < 0.015
    assert clock.host_time(true + 5 * SECOND) == 5 * SECOND - error


def test_without_round_trips_the_least_delayed_message_gives_the_offset() -> None:
    rng = np.random.default_rng(4)
    clock = VehicleClock()
    for k in range(200):
        stamped = k * SECOND // 20
        clock.handle_message(stamped, stamped + 7 * SECOND + int(rng.integers(2_000_000, 80_000_000)))
    assert -7 * SECOND - 5_000_000 < clock.offset_ns < -7 * SECOND
    assert clock.std_s == pytest.approx(0.02)


def test_a_vehicle_restart_is_detected_as_a_new_clock() -> None:
    clock = VehicleClock()
    clock.handle_round_trip(0, 500 * SECOND, 2_000_000)
    assert clock.handle_message(501 * SECOND, SECOND)
    after = [clock.handle_message((2 + k) * SECOND, (10 + k) * SECOND) for k in range(4)]
    assert after == [False, False, True, True]  # one message alone may be another sender's
    clock.handle_round_trip(14 * SECOND, 6 * SECOND, 14 * SECOND + 2_000_000)
    assert (clock.reboots, clock.steps) == (1, 0)
    assert clock.host_time(7 * SECOND) == pytest.approx(15 * SECOND, abs=2e6)


def test_a_clock_step_is_detected_and_the_new_offset_is_used() -> None:
    clock = VehicleClock()
    for k in range(10):
        assert clock.handle_round_trip(k * SECOND, k * SECOND + 5 * SECOND, k * SECOND + 1_000_000)
    after = [clock.handle_round_trip(k * SECOND, k * SECOND + 8 * SECOND, k * SECOND + 1_000_000) for k in (10, 11, 12)]
    assert after == [False, False, True]
    assert clock.steps == 1
    assert clock.offset_ns == pytest.approx(8 * SECOND, abs=1e6)


@pytest.mark.parametrize("error_s", [86_400, 40, -40, -3])
def test_stamps_of_another_clock_between_the_vehicles_own_never_move_its_clock(error_s: int) -> None:
    clock = VehicleClock()
    good, wrong = [], []
    for k in range(100):
        now = k * SECOND // 10
        good.append(clock.handle_message(now + 500 * SECOND, now + 5_000_000))
        # Three at once, agreeing with each other, between two of the vehicle's.
        wrong += [
            clock.handle_message(now + j + (500 + error_s) * SECOND, now + 6_000_000) for j in (0, 1_000_000, 2_000_000)
        ]
    assert all(good)
    assert not any(wrong[3:])
    assert (clock.reboots, clock.steps) == (0, 0)
    assert clock.offset_ns == 500 * SECOND - 5_000_000


def test_messages_that_come_late_and_out_of_order_set_no_clock_back() -> None:
    clock, rng = VehicleClock(), np.random.default_rng(2)
    stamps = np.arange(600) / 30
    arrivals = stamps + 0.8 + 0.2 * np.abs(rng.standard_normal(600))
    trips = 0.0
    for k in np.argsort(arrivals):
        while trips < arrivals[k]:  # answered at once
            clock.handle_round_trip(int(1e9 * trips), int(1e9 * (trips + 100.0)), int(1e9 * trips) + 2_000_000)
            trips += 0.5
        assert clock.handle_message(int(1e9 * (stamps[k] + 100.0)), int(1e9 * arrivals[k]))
    assert (clock.reboots, clock.steps) == (0, 0)
    assert abs(clock.offset_ns - 100 * SECOND) < 2_000_000


def test_an_answer_of_another_clock_to_timesync_is_not_used() -> None:
    clock = VehicleClock()
    clock.handle_message(500 * SECOND, 5_000_000)
    assert not clock.handle_round_trip(SECOND, 1_700_000_000 * SECOND, SECOND + 2_000_000)
    assert clock.offset_ns == 500 * SECOND - 5_000_000
    assert "another clock" in clock.reason


def test_round_trips_of_negative_or_excessive_duration_are_rejected() -> None:
    clock = VehicleClock()
    clock.handle_round_trip(10, 5, 0)
    clock.handle_round_trip(0, 5, 2 * SECOND)
    assert not clock.known
    assert clock.rejected == 2
    with pytest.raises(RuntimeError):
        clock.host_time(0)


FRAME = SECOND // 30


@pytest.mark.parametrize("error_s", [86_400, 1, -3, -86_400])
def test_one_frame_with_a_wrong_stamp_does_not_move_the_cameras_clock(error_s: int) -> None:
    clock = CameraHostClock()
    for k in range(100):
        wrong = k % 10 == 9
        time = clock.handle_frame(k * FRAME + wrong * error_s * SECOND, k * FRAME + 7 * SECOND + 20_000_000)
        assert time == k * FRAME
        assert clock.camera_ns(7 * SECOND + 20_000_000) == 0
    assert clock.steps == 0


@pytest.mark.parametrize("step_s", [10.0, 0.5, -0.3, -1.0, -10.0])
def test_where_the_cameras_clock_is_set_its_time_goes_on(step_s: float) -> None:
    clock, rng = CameraHostClock(), np.random.default_rng(1)
    last = -1
    for k in range(200):
        stepped = round((k >= 100) * step_s * SECOND)
        jitter = int(rng.integers(0, 20_000_000))
        time = clock.handle_frame(k * FRAME + stepped, k * FRAME + 20_000_000 + jitter)
        assert abs(time - k * FRAME) <= 20_000_000
        assert time > last
        last = time
    assert clock.steps == 1
    camera_ns = clock.camera_ns(20_000_000)
    assert camera_ns is not None
    assert abs(camera_ns) < 2_000_000


def test_frames_that_queued_up_are_no_clock_step() -> None:
    clock = CameraHostClock()
    for k in range(200):
        held_back = max(0, (190 - k) * FRAME) if k >= 100 else 0  # three seconds of them arrive at once
        assert clock.handle_frame(k * FRAME, k * FRAME + 20_000_000 + held_back) == k * FRAME
    assert clock.steps == 0


def test_a_camera_that_begins_with_old_frames_has_the_clock_of_its_new_ones() -> None:
    clock = CameraHostClock()
    for k in range(100):
        arrival = max(k * FRAME, 60 * FRAME) + 20_000_000  # two seconds of them arrive at once
        assert clock.handle_frame(k * FRAME, arrival) == k * FRAME
    assert clock.camera_ns(20_000_000) == 0


def test_telemetry_goes_on_after_a_clock_was_set_back() -> None:
    track = TelemetryTrack(np.eye(3))
    for time in (100.0, 100.1, 99.9, 100.2, 49.9, 50.0, 50.1, 50.2):
        track.add(Telemetry(time, np.eye(3)))
    assert track.rejected == 3
    assert track.rotation_at(50.15) is not None
    assert track.rotation_at(100.1) is None


def flight(seed: int, seconds: float) -> Flight:
    """A flight with rotations of some degrees within a second."""
    rng = np.random.default_rng(seed)
    times = grid_times(seconds)
    angles = np.column_stack([np.deg2rad(4.0) * smoothed_noise(rng, len(times), 1 / 120.0, 1.0, 0.6) for _ in range(3)])
    return Flight(times, np.zeros((len(times), 3)), angles)


def simulated_rotations_and_telemetry(
    path: Flight, offset: float, rate: float, noise: float = 0.002
) -> tuple[RelativeRotations, list[Telemetry]]:
    """Rotations observed by a camera at 30 fps, and telemetry whose clock is ``offset`` ahead."""
    rng = np.random.default_rng(9)
    end = path.times[-1] - 0.5
    frames = np.arange(0.0, end, 1 / 30.0)
    camera = BODY_FROM_DOWN_CAMERA.T @ np.swapaxes(path.at(frames)[0], 1, 2)
    turns = [so3.log(b @ a.T) for a, b in itertools.pairwise(camera)]
    turns = np.array(turns) + 0.0001 * rng.standard_normal((len(turns), 3))
    times = np.arange(-1.0, end, 1.0 / rate)
    attitude = path.at(times)[0] @ so3.exp(noise * rng.standard_normal((len(times), 3)))
    telemetry = [Telemetry(float(t) + offset, r) for t, r in zip(times, attitude, strict=True)]
    return RelativeRotations(frames[:-1], frames[1:], turns), telemetry


@pytest.mark.parametrize(("offset", "rate"), [(0.123, 30.0), (-0.31, 10.0), (7654.321, 30.0), (-1e5, 5.0)])
def test_the_offset_is_accurate_to_five_milliseconds_for_any_clock_origin(offset: float, rate: float) -> None:
    rotations, telemetry = simulated_rotations_and_telemetry(flight(1, 40.0), offset, rate)
    result = find_offset(rotations, telemetry, BODY_FROM_DOWN_CAMERA)
    assert isinstance(result, OffsetEstimate), result
    assert result.offset == pytest.approx(offset, abs=0.005)
    assert result.std < 0.005


def test_a_short_video_is_located_within_a_long_flight() -> None:
    path = flight(2, 120.0)
    _, telemetry = simulated_rotations_and_telemetry(path, 500.0, 20.0)
    rotations, _ = simulated_rotations_and_telemetry(path, 0.0, 20.0)
    part = slice(1500, 2300)
    video = RelativeRotations(rotations.starts[part] - 50.0, rotations.ends[part] - 50.0, rotations.vectors[part])
    result = find_offset(video, telemetry, BODY_FROM_DOWN_CAMERA)
    assert isinstance(result, OffsetEstimate), result
    assert result.offset == pytest.approx(550.0, abs=3.0 * result.std)
    assert result.std < 0.02


def test_time_stamps_that_span_more_than_a_flight_size_no_array() -> None:
    rotations, telemetry = simulated_rotations_and_telemetry(flight(1, 10.0), 0.0, 10.0)
    ahead = [*telemetry, Telemetry(telemetry[-1].time + 1e12, telemetry[-1].ned_from_body)]
    reason = find_offset(rotations, ahead, BODY_FROM_DOWN_CAMERA, (-0.7, 0.7))
    assert isinstance(reason, str)
    assert "a clock jumped" in reason


def test_telemetry_of_another_flight_is_rejected() -> None:
    rotations, _ = simulated_rotations_and_telemetry(flight(3, 40.0), 0.0, 30.0)
    _, telemetry = simulated_rotations_and_telemetry(flight(4, 200.0), 0.0, 30.0)
    result = find_offset(rotations, telemetry, BODY_FROM_DOWN_CAMERA)
    assert isinstance(result, str)


def test_without_camera_rotation_the_offset_is_not_observable() -> None:
    _, telemetry = simulated_rotations_and_telemetry(flight(3, 20.0), 0.0, 30.0)
    frames = np.arange(0.0, 15.0, 1 / 30.0)
    stationary = RelativeRotations(
        frames[:-1], frames[1:], 1e-5 * np.random.default_rng(0).standard_normal((len(frames) - 1, 3))
    )
    assert isinstance(find_offset(stationary, telemetry, BODY_FROM_DOWN_CAMERA), str)
    assert isinstance(
        find_offset(RelativeRotations(*np.zeros((2, 0)), np.zeros((0, 3))), telemetry, BODY_FROM_DOWN_CAMERA), str
    )
    assert isinstance(find_offset(stationary, telemetry[:3], BODY_FROM_DOWN_CAMERA), str)


def test_an_offset_outside_the_search_window_is_rejected() -> None:
    rotations, telemetry = simulated_rotations_and_telemetry(flight(1, 40.0), 3.0, 30.0)
    assert isinstance(find_offset(rotations, telemetry, BODY_FROM_DOWN_CAMERA, (-0.7, 0.7)), str)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        (lambda r, m: (r, m), ""),
        (lambda r, m: (r.T, m), "check body_from_camera"),
        (lambda r, m: (r, m @ np.diag([-1.0, -1.0, 1.0])), "as of a camera turned by 180 degrees"),
    ],
)
@pytest.mark.parametrize("hz", [30.0, 3.0])
def test_attitudes_of_another_convention_or_mounting_contradict_the_images(
    changed: Callable[[Floats, Floats], tuple[Floats, Floats]], named: str, hz: float
) -> None:
    rotations, telemetry = simulated_rotations_and_telemetry(flight(1, 40.0), 0.1, hz)
    other = [replace(one, ned_from_body=changed(one.ned_from_body, np.eye(3))[0]) for one in telemetry]
    found = find_offset(rotations, other, changed(np.eye(3), BODY_FROM_DOWN_CAMERA)[1], (-0.7, 0.7))
    assert (isinstance(found, str) and found.startswith(CONTRADICTION)) == bool(named)
    assert named in str(found)


def yawing_flight(height: float = 50.0) -> tuple[RelativeRotations, list[Telemetry]]:
    """Of a camera that looks straight down, and whose vehicle flies about at this height, yaws and never tilts."""
    rng, times = np.random.default_rng(2), grid_times(20.0)
    yaw = np.deg2rad(8.0) * smoothed_noise(rng, len(times), 1 / 120.0, 1.0, 0.6)
    position = np.column_stack([4.0 * times, 10.0 * np.sin(0.4 * times), np.full(len(times), -height)])
    path = Flight(times, position, np.column_stack([np.zeros((len(times), 2)), yaw]))
    visual, telemetry = simulated_rotations_and_telemetry(path, 0.1, 30.0, noise=0.0)
    camera = path.at(visual.starts)[0] @ BODY_FROM_DOWN_CAMERA
    ways = path.at(visual.ends)[1] - path.at(visual.starts)[1]
    moved = np.einsum("nji,nj->ni", camera, ways) / height + 0.0002 * rng.standard_normal(ways.shape)
    placed = [replace(one, position=path.at(np.array([one.time - 0.1]))[1][0]) for one in telemetry]
    return replace(visual, moved=moved), placed


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 90.0, 180.0, 270.0])
def test_a_turned_camera_is_found_by_its_way_where_it_looks_down_and_the_vehicle_only_yaws(turn_deg: float) -> None:
    """Its rotation is the same however it is turned; targets were on the other side, tens of metres off."""
    visual, telemetry = yawing_flight()
    turned = BODY_FROM_DOWN_CAMERA @ so3.exp(np.radians([0.0, 0.0, turn_deg]))
    found = find_offset(visual, telemetry, turned, (-0.7, 0.7))
    if turn_deg > 45.0:
        assert found == (
            f"positions move otherwise than the images, but as of a camera turned by {360.0 - turn_deg:.0f} degrees: "
            "check body_from_camera, and the heading"
        )
    else:
        assert isinstance(found, OffsetEstimate)
        assert found.motion is not None
        assert found.motion.wrong_height == ""
        wrong = f"the images move as with a heading that is wrong by {turn_deg:.0f} degrees"
        assert found.motion.wrong_heading == (wrong if turn_deg else "")


@pytest.mark.parametrize(("changed", "height_m"), [([1, 1, 1], None), ([1, 1, 1.4], 50), ([1, 1, 0.8], 50)])
def test_the_way_shows_the_height_above_the_ground(changed: list[float], height_m: int | None) -> None:
    visual, telemetry = yawing_flight()
    telemetry = [replace(one, position=one.position * changed) for one in telemetry if one.position is not None]
    motion = compare_ways(visual, telemetry, BODY_FROM_DOWN_CAMERA, 0.1)
    assert motion is not None
    assert not motion.stands_still
    shown = f"the images move as from {height_m} m above the ground, not {50.0 * changed[2]:.0f} m"
    assert motion.wrong_height == ("" if height_m is None else shown)


def test_positions_of_another_time_differ_in_shape_and_a_gap_says_nothing() -> None:
    """3 s late, or with north and east swapped, targets were metres off; a gap was a wrong height."""
    visual, telemetry = yawing_flight()

    def way(samples: list[Telemetry]) -> GroundMotion:
        motion = compare_ways(visual, samples, BODY_FROM_DOWN_CAMERA, 0.1)
        assert motion is not None
        return motion

    swapped = [replace(one, position=one.position[[1, 0, 2]]) for one in telemetry if one.position is not None]
    assert way(swapped).differs_in_shape
    gap = way([one for one in telemetry if not 4.0 < one.time < 12.0])
    for motion in (way(telemetry), gap):
        assert not motion.differs_in_shape
        assert motion.wrong_height == ""
        assert motion.coherence > 0.99


def test_a_contradicted_mounting_is_trusted_again_only_by_a_way_that_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a hover the images show nothing, and positions of the wrong mounting were given again."""
    visual, telemetry = yawing_flight()
    way = compare_ways(visual, telemetry, BODY_FROM_DOWN_CAMERA, 0.1)
    turned = compare_ways(visual, telemetry, BODY_FROM_DOWN_CAMERA @ np.diag([-1.0, -1.0, 1.0]), 0.1)
    assert isinstance(turned, GroundMotion)
    lens = Intrinsics(320, 240, np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]]))
    aligner = ClockAligner((320, 240), lens, BODY_FROM_DOWN_CAMERA)
    aligner.handle_sample(telemetry[0])
    results: list[OffsetEstimate | str] = [
        turned.contradiction,
        "the camera rotated too little",
        OffsetEstimate(0.1, 0.01, 0.9),
        OffsetEstimate(0.1, 0.01, 0.9, way),
    ]
    monkeypatch.setattr(clock_alignment, "find_offset", lambda *arguments: results.pop(0))
    seen = []
    for time in (0.0, 7.0, 10.0, 13.0, 16.0):
        aligner.handle_frame(None, time, tracking=False)
        seen.append(aligner.contradicted)
    assert seen == [False, True, True, True, False]


def test_geodetic_conversion_round_trips() -> None:
    origin = Origin(-33.9, 179.9999, 12.0)
    position = np.array([1234.5, 2345.6, -78.9])
    back = origin.to_ned(*origin.to_geodetic(*position))
    np.testing.assert_allclose(back, position, atol=1e-6)
    north = Origin(0.0, 0.0, 0.0).to_ned(1.0, 0.0, 0.0)[0]
    assert north == pytest.approx(110_574.0, abs=30.0)  # a degree of latitude at the equator, WGS 84


def test_rotation_conversions_agree_with_the_simulated_flight() -> None:
    from edge.uav.navigation import rotation_from_euler, rotation_from_quaternion

    attitude = rotation_from_euler(0.1, -0.2, 2.5)
    np.testing.assert_allclose(attitude, rotation(*(np.array([a]) for a in (0.1, -0.2, 2.5)))[0], atol=1e-12)
    np.testing.assert_allclose(rotation_from_quaternion(so3.quaternion(attitude)), attitude, atol=1e-12)
    assert rotation_from_quaternion([0.0, 0.0, 0.0, 0.0]) is None
    assert rotation_from_quaternion([np.nan, 0.0, 0.0, 1.0]) is None
