"""The vehicle's clock against the host's, and the telemetry's against the pictures'."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from edge.uav.navigation import Origin
from edge.uav.timing.telemetry_offset import Offset, Turning, find_offset
from edge.uav.timing.vehicle_clock import VehicleClock
from edge.uav.tracker import Telemetry
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA, Flight, grid_times, rotation
from edge.uav.world.noise import wander
from protocols.geometry import so3

SECOND = 1_000_000_000


def test_the_quickest_round_trip_tells_the_clock_to_half_its_duration() -> None:
    rng = np.random.default_rng(3)
    clock = VehicleClock()
    true = 123_456_789_012
    for k in range(30):
        sent = k * SECOND // 2
        there, back = rng.integers(1_000_000, 40_000_000, 2)
        clock.handle_trip(sent, sent + int(there) + true, sent + int(there) + int(back))
    error = clock.offset_ns - true
    assert abs(error) <= 1e9 * clock.std_s
    assert clock.std_s < 0.015
    assert clock.here(true + 5 * SECOND) == 5 * SECOND - error


def test_without_round_trips_the_quickest_message_counts() -> None:
    rng = np.random.default_rng(4)
    clock = VehicleClock()
    for k in range(200):
        stamped = k * SECOND // 20
        clock.handle_time(stamped, stamped + 7 * SECOND + int(rng.integers(2_000_000, 80_000_000)))
    assert -7 * SECOND - 5_000_000 < clock.offset_ns < -7 * SECOND
    assert clock.std_s == pytest.approx(0.02)


def test_a_vehicle_that_starts_anew_is_a_new_clock() -> None:
    clock = VehicleClock()
    clock.handle_trip(0, 500 * SECOND, 2_000_000)
    assert clock.handle_time(501 * SECOND, SECOND)
    assert not clock.handle_time(2 * SECOND, 10 * SECOND)
    clock.handle_trip(10 * SECOND, 2 * SECOND, 10 * SECOND + 2_000_000)
    assert clock.reboots == 1
    assert clock.here(3 * SECOND) == pytest.approx(11 * SECOND, abs=2e6)


def test_a_clock_that_jumps_is_noticed_and_followed() -> None:
    clock = VehicleClock()
    for k in range(10):
        assert clock.handle_trip(k * SECOND, k * SECOND + 5 * SECOND, k * SECOND + 1_000_000)
    assert not clock.handle_trip(10 * SECOND, 18 * SECOND, 10 * SECOND + 1_000_000)
    assert clock.steps == 1
    assert clock.offset_ns == pytest.approx(8 * SECOND, abs=1e6)


def test_answers_that_come_before_the_question_or_too_late_do_not_count() -> None:
    clock = VehicleClock()
    clock.handle_trip(10, 5, 0)
    clock.handle_trip(0, 5, 2 * SECOND)
    assert not clock.known
    assert clock.rejected == 2
    with pytest.raises(RuntimeError):
        clock.here(0)


def flight(seed: int, seconds: float) -> Flight:
    """A lively flight: some degrees within a second."""
    rng = np.random.default_rng(seed)
    times = grid_times(seconds)
    angles = np.column_stack([np.deg2rad(4.0) * wander(rng, len(times), 1 / 120.0, 1.0, 0.6) for _ in range(3)])
    return Flight(times, np.zeros((len(times), 3)), angles)


def seen_and_told(flown: Flight, offset: float, rate: float, noise: float = 0.002) -> tuple[Turning, list[Telemetry]]:
    """What a camera at 30 fps sees of it, and telemetry whose clock is ``offset`` ahead."""
    rng = np.random.default_rng(9)
    end = flown.times[-1] - 0.5
    frames = np.arange(0.0, end, 1 / 30.0)
    camera = BODY_FROM_DOWN_CAMERA.T @ np.swapaxes(flown.at(frames)[0], 1, 2)
    turns = [so3.log(b @ a.T) for a, b in itertools.pairwise(camera)]
    turns = np.array(turns) + 0.0001 * rng.standard_normal((len(turns), 3))
    times = np.arange(-1.0, end, 1.0 / rate)
    turned = flown.at(times)[0] @ so3.exp(noise * rng.standard_normal((len(times), 3)))
    told = [Telemetry(float(t) + offset, r) for t, r in zip(times, turned, strict=True)]
    return Turning(frames[:-1], frames[1:], turns), told


@pytest.mark.parametrize(("offset", "rate"), [(0.123, 30.0), (-0.31, 10.0), (7654.321, 30.0), (-1e5, 5.0)])
def test_the_offset_is_found_to_five_milliseconds_whatever_the_epochs(offset: float, rate: float) -> None:
    seen, told = seen_and_told(flight(1, 40.0), offset, rate)
    answer = find_offset(seen, told, BODY_FROM_DOWN_CAMERA)
    assert isinstance(answer, Offset), answer
    assert answer.offset == pytest.approx(offset, abs=0.005)
    assert answer.std < 0.005


def test_a_short_video_is_found_in_a_long_flight() -> None:
    flown = flight(2, 120.0)
    _, told = seen_and_told(flown, 500.0, 20.0)
    seen, _ = seen_and_told(flown, 0.0, 20.0)
    part = slice(1500, 2300)
    video = Turning(seen.begins[part] - 50.0, seen.ends[part] - 50.0, seen.turns[part])
    answer = find_offset(video, told, BODY_FROM_DOWN_CAMERA)
    assert isinstance(answer, Offset), answer
    assert answer.offset == pytest.approx(550.0, abs=3.0 * answer.std)
    assert answer.std < 0.02


def test_the_telemetry_of_another_flight_is_refused() -> None:
    seen, _ = seen_and_told(flight(3, 40.0), 0.0, 30.0)
    _, told = seen_and_told(flight(4, 200.0), 0.0, 30.0)
    answer = find_offset(seen, told, BODY_FROM_DOWN_CAMERA)
    assert isinstance(answer, str)


def test_a_camera_that_does_not_turn_tells_nothing() -> None:
    _, told = seen_and_told(flight(3, 20.0), 0.0, 30.0)
    frames = np.arange(0.0, 15.0, 1 / 30.0)
    still = Turning(frames[:-1], frames[1:], 1e-5 * np.random.default_rng(0).standard_normal((len(frames) - 1, 3)))
    assert isinstance(find_offset(still, told, BODY_FROM_DOWN_CAMERA), str)
    assert isinstance(find_offset(Turning(*np.zeros((2, 0)), np.zeros((0, 3))), told, BODY_FROM_DOWN_CAMERA), str)
    assert isinstance(find_offset(still, told[:3], BODY_FROM_DOWN_CAMERA), str)


def test_an_offset_outside_the_search_window_is_not_made_up() -> None:
    seen, told = seen_and_told(flight(1, 40.0), 3.0, 30.0)
    assert isinstance(find_offset(seen, told, BODY_FROM_DOWN_CAMERA, (-0.7, 0.7)), str)


def test_places_go_to_degrees_and_back() -> None:
    origin = Origin(-33.9, 179.9999, 12.0)
    place = np.array([1234.5, 2345.6, -78.9])
    back = origin.local(*origin.world(*place))
    np.testing.assert_allclose(back, place, atol=1e-6)
    north = Origin(0.0, 0.0, 0.0).local(1.0, 0.0, 0.0)[0]
    assert north == pytest.approx(110_574.0, abs=30.0)  # a degree of latitude at the equator, WGS 84


def test_rotations_are_those_of_a_flight() -> None:
    from edge.uav.navigation import from_angles, from_quaternion, to_quaternion

    turned = from_angles(0.1, -0.2, 2.5)
    np.testing.assert_allclose(turned, rotation(*(np.array([a]) for a in (0.1, -0.2, 2.5)))[0], atol=1e-12)
    np.testing.assert_allclose(from_quaternion(to_quaternion(turned)), turned, atol=1e-12)
    assert from_quaternion([0.0, 0.0, 0.0, 0.0]) is None
    assert from_quaternion([np.nan, 0.0, 0.0, 1.0]) is None
