"""Georeferencing: the target's position in the vehicle's frame, from its pixel and telemetry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.mavlink.roles.telemetry import GlobalPosition, LocalFrame, LocalPosition
from edge.uav.base import Estimate, Telemetry, TrackState
from edge.uav.georeference import Georeference, ground_point
from edge.uav.navigation import Origin, interpolate_positions
from edge.uav.timing.telemetry_track import TelemetryTrack
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA, rotation
from protocols.geometry.camera import Intrinsics

LENS = Intrinsics(640, 480, np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]]))
CAR = np.array([7.0, -12.0, -0.7])


def attitude_at_pitch(pitch: float) -> np.ndarray:
    return rotation(np.array([0.05]), np.array([pitch]), np.array([0.8]))[0]


def pixel(attitude: np.ndarray, centre: np.ndarray) -> tuple[float, float]:
    x, y, z = BODY_FROM_DOWN_CAMERA.T @ attitude.T @ (CAR - centre)
    return 600.0 * x / z + 319.5, 600.0 * y / z + 239.5


def estimate_at(x: float, y: float, north: float, east: float) -> Estimate:
    return Estimate(0.0, TrackState.VISIBLE, x, y, 40.0, 20.0, 0.0, 1.0, north=north, east=east, std_m=0.1)


def simulate_flight(seconds: float, drift: np.ndarray, georeference: Georeference) -> Estimate:
    """The last corrected estimate of a flight with oscillating pitch; ``drift``: (2,) of the tracker's frame [m]."""
    out = None
    for k in range(round(seconds * 30)):
        time = k / 30.0
        attitude, centre = attitude_at_pitch(0.2 * np.sin(3.0 * time)), np.array([2.0 * time, -5.0, -60.0])
        georeference.add(Telemetry(time, attitude, centre))
        x, y = pixel(attitude, centre)
        north, east = CAR[:2] + drift
        estimate = estimate_at(x, y, north, east)
        out = georeference.corrected(estimate, time)
    assert out is not None
    return out


def test_drift_of_the_ground_frame_is_corrected() -> None:
    corrected = simulate_flight(1.0, np.array([6.0, -3.0]), Georeference(LENS, BODY_FROM_DOWN_CAMERA))
    assert np.hypot(corrected.north - CAR[0], corrected.east - CAR[1]) < 0.1
    assert 0.2 < corrected.std_m < 1.0  # an autopilot's roll and pitch are not exact


def test_outside_the_image_the_last_correction_is_kept() -> None:
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    corrected = simulate_flight(1.0, np.array([6.0, -3.0]), georeference)
    far = replace(corrected, north=100.0, east=50.0, x=9e4, y=9e4)
    extrapolated = georeference.corrected(far, 1.1)
    assert (extrapolated.north, extrapolated.east) == pytest.approx((94.0, 53.0), abs=0.1)
    georeference.reset()
    kept = georeference.corrected(far, 1.3)  # where no telemetry is near
    assert (kept.north, kept.east) == (100.0, 50.0)
    assert kept.std_m > 2.0


def test_without_positions_the_std_does_not_fall_but_grows() -> None:
    """Between rare attitudes, and while no positions came, it fell to the tracker's own: 0.2 m where 1.3 m were off."""
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    measured = simulate_flight(1.0, np.array([6.0, -3.0]), georeference)
    estimate = estimate_at(300.0, 200.0, *(CAR[:2] + [6.0, -3.0]))
    soon, later = (georeference.corrected(estimate, time).std_m for time in (1.5, 9.0))
    assert soon == pytest.approx(measured.std_m, rel=0.05)
    assert 0.7 < later < 1.5


def test_after_a_gap_the_first_position_counts_in_full() -> None:
    """It corrected 6 % of the drift of 8 s, at a std that was as small as if it had corrected all."""
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    simulate_flight(1.0, np.array([6.0, -3.0]), georeference)
    drifted = estimate_at(300.0, 200.0, *(CAR[:2] + [7.0, -3.0]))
    for time in np.arange(1.0, 9.0, 1.0 / 30.0):
        georeference.corrected(drifted, float(time))
    attitude, centre = attitude_at_pitch(0.1), np.array([18.0, -5.0, -60.0])
    for time in (8.97, 9.0):
        georeference.add(Telemetry(time, attitude, centre))
    found = georeference.corrected(replace(drifted, x=pixel(attitude, centre)[0], y=pixel(attitude, centre)[1]), 9.0)
    assert np.hypot(found.north - CAR[0], found.east - CAR[1]) < 0.1


def test_no_correction_without_telemetry_metric_ground_or_a_steep_ray() -> None:
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    estimate = estimate_at(320.0, 240.0, 1.0, 2.0)
    kept = georeference.corrected(estimate, 0.0)
    assert (kept.north, kept.east, kept.std_m) == (1.0, 2.0, 0.1)
    simulate_flight(0.5, np.zeros(2), georeference)
    unknown = replace(estimate, north=float("nan"), east=float("nan"))
    assert georeference.corrected(unknown, 0.4) is unknown
    assert georeference.locate(320.0, 240.0, 0.4) is not None
    assert georeference.locate(float("nan"), 240.0, 0.4) is None
    assert georeference.locate(320.0, -1200.0, 0.4) is None
    assert georeference.locate(320.0, 240.0, 30.0) is None


def test_the_std_of_a_flat_ray_is_that_of_the_attitude_and_the_height_of_the_target() -> None:
    """It was the tracker's own, 0.5 m, where a boat seen from 15 m above and 73 m away was 11.7 m off."""
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    for time in (0.0, 0.1):
        georeference.add(Telemetry(time, attitude_at_pitch(1.3), np.array([0.0, 0.0, -15.0])))
    corrected = georeference.corrected(estimate_at(320.0, 240.0, 73.0, 0.0), 0.1)
    assert (corrected.north, corrected.east) == (73.0, 0.0)
    assert 2.0 < corrected.std_m < 5.0


def test_in_a_wide_gap_nothing_is_interpolated() -> None:
    """Attitudes 2 s apart made a correction of 7 m, at a std of 0.4 m."""
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    simulate_flight(1.0, np.array([6.0, -3.0]), georeference)
    georeference.add(Telemetry(3.0, attitude_at_pitch(0.3), np.array([6.0, -5.0, -60.0])))
    corrected = georeference.corrected(estimate_at(300.0, 200.0, *(CAR[:2] + [6.0, -3.0])), 2.5)
    assert np.hypot(corrected.north - CAR[0], corrected.east - CAR[1]) < 0.1


def test_the_correction_of_a_ground_frame_is_not_that_of_the_next() -> None:
    """A frame that was changed by 2 m was off by that for half a second, at a std of 0.3 m."""
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    simulate_flight(1.0, np.array([6.0, -3.0]), georeference)
    attitude, centre = attitude_at_pitch(0.1), np.array([2.0, -5.0, -60.0])
    georeference.add(Telemetry(1.0, attitude, centre))
    changed = replace(estimate_at(*pixel(attitude, centre), *CAR[:2]), ground_frame=(1,))
    found = georeference.corrected(changed, 1.0)
    assert np.hypot(found.north - CAR[0], found.east - CAR[1]) < 0.1


@pytest.mark.parametrize(("samples", "least"), [(30, 0.4), (1, 1.5)])
def test_an_unknown_clock_is_part_of_the_std(samples: int, least: float) -> None:
    """It was the tracker's own, 0.1 m, where a clock that was 0.25 s off put a car 2 m beside its place."""
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA, clock_std_s=0.3)
    for time in np.arange(samples) / 30.0:
        georeference.add(Telemetry(time, attitude_at_pitch(0.0), np.array([3.0 * time, -5.0, -60.0])))
    kept = georeference.corrected(estimate_at(320.0, 240.0, 9.0, -5.0), 0.4)
    assert (kept.north, kept.east) == (9.0, -5.0)
    assert least < kept.std_m < 4.0


@pytest.mark.parametrize("acceleration", [10.0, 20.0, 40.0])
def test_the_std_contains_the_braking_since_the_last_position(acceleration: float) -> None:
    """With positions at 1 Hz, of an aircraft that brakes at 1, 2 and 4 g, errors were up to 6, 11 and 16 stds."""
    ratios = []
    for begin in np.linspace(2.0, 3.0, 6):
        georeference, frame = Georeference(LENS, BODY_FROM_DOWN_CAMERA), LocalFrame()
        attitude = attitude_at_pitch(0.0)
        for k in range(120):
            time = k / 30.0
            braked = min(max(time - begin, 0.0), 15.0 / acceleration)
            velocity = np.array([15.0 - acceleration * braked, 0.0, 0.0])
            way = 15.0 * min(time, begin + braked) - 0.5 * acceleration * braked**2
            centre = np.array([way - 30.0, -5.0, -60.0])
            if k % 30 == 0:
                frame.take_local(LocalPosition(time, centre, velocity), time)
            georeference.add(Telemetry(time, attitude, *frame.measured_at(time)))
            found = georeference.corrected(estimate_at(*pixel(attitude, centre), *CAR[:2]), time)
            if k > 10:
                ratios.append(np.hypot(found.north - CAR[0], found.east - CAR[1]) / found.std_m)
    assert max(ratios) < 3.0


def test_positions_between_and_after_reports() -> None:
    """After the last report they stood still: half a second later those of a vehicle at 10 m/s were 5 m off."""
    reports = [(float(t), np.array([10.0 * t, 0.0, -60.0])) for t in (0, 1, 2)]
    places, stds = interpolate_positions(reports, np.array([1.0, 1.5, 2.5, 3.0]))
    assert places[:3, 0] == pytest.approx([10.0, 15.0, 25.0])
    assert np.isnan(places[3]).all()
    assert stds[0] == 0.0 < 1.0 < stds[1] < stds[2]
    assert stds[3] == 0.0  # where there is no place


@pytest.mark.parametrize("rate_hz", [10, 50])
def test_positions_beyond_reports_whose_times_are_rough(rate_hz: int) -> None:
    """At the speed between two reports with errors of their times they were up to 29 m off, at a stated metre."""
    rng = np.random.default_rng(4)
    times = np.arange(3 * rate_hz) / rate_hz
    rough = times + rng.uniform(-0.45, 0.45, len(times)) / rate_hz
    reports = [(float(t), np.array([20.0 * k / rate_hz, 0.0, -60.0])) for k, t in enumerate(rough)]
    asked = np.array([rough[0] - 0.4, rough[-1] + 0.4])
    places, stds = interpolate_positions(reports, asked)
    assert np.abs(places[:, 0] - 20.0 * asked).max() < 2.0 * stds.min()
    twice = [(0.0, np.zeros(3)), (1.0, np.array([10.0, 0.0, 0.0])), (1.0, np.array([10.1, 0.0, 0.0]))]
    assert interpolate_positions(twice, np.array([1.4]))[0][0, 0] == pytest.approx(14.0, abs=0.3)
    late = [(0.0, np.zeros(3)), *((10.0 + 0.1 * k, np.array([k, 0.0, 0.0])) for k in range(3))]
    assert interpolate_positions(late, np.array([10.4]))[0][0, 0] == pytest.approx(4.0)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
@pytest.mark.parametrize("sent", [True, False])
def test_a_std_contains_that_the_speed_is_one_of_the_interval_before(rate_hz: float, sent: bool) -> None:
    """Betaflight sends no velocity: at the mean one of the last interval, errors were up to 6 stds."""
    frame, at, ratios = LocalFrame(), Origin(48.0, 11.0, 500.0), []
    for k in range(round(4.0 * rate_hz)):
        time = k / rate_hz
        latitude, longitude, altitude = at.to_geodetic(5.0 * time**2, 0.0, -50.0)
        velocity = np.array([10.0 * time * sent, 0.0, 0.0])
        frame.take_global(GlobalPosition(time, latitude, longitude, altitude, 50.0, velocity), time)
        for age in np.array([0.3, 0.6]) / rate_hz if k > 1 else ():
            place, std = frame.measured_at(time + age)
            if place is not None:
                ratios.append(abs(place[0] - 5.0 * (time + age) ** 2) / std)
    assert ratios
    assert max(ratios) < 1.5


def test_the_std_of_a_place_far_aside_has_the_heading() -> None:
    """With a heading 5 degrees wrong, a car 60 m beside a vehicle was 5.2 m off, 4.9 stds."""
    centre, car = np.array([0.0, 0.0, -60.0]), np.array([60.0, 0.0, -0.7])
    georeference = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    true, wrong = (rotation(np.zeros(1), np.array([0.78]), np.radians([yaw]))[0] for yaw in (0.0, 5.0))
    x, y, z = BODY_FROM_DOWN_CAMERA.T @ true.T @ (car - centre)
    seen = estimate_at(600.0 * x / z + 319.5, 600.0 * y / z + 239.5, 50.0, 0.0)
    for time in (0.0, 0.1):
        georeference.add(Telemetry(time, wrong, centre))
    found = georeference.corrected(seen, 0.1)
    error = np.hypot(found.north - car[0], found.east - car[1])
    assert 1.0 < error / np.sqrt(2.0) / found.std_m < 3.0


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0])
def test_a_ground_frame_that_begins_beyond_the_last_attitude_has_it_in_its_std(phase: float) -> None:
    """Of attitudes at 2 Hz, of a vehicle that hovers and sways by 3 degrees, errors were up to 3.2 stds."""
    georeference, before = Georeference(LENS, BODY_FROM_DOWN_CAMERA), TelemetryTrack(BODY_FROM_DOWN_CAMERA)
    centre, begin = np.array([-5.0, -5.0, -60.0]), 1.95
    for time in (0.0, 0.5, 1.0, 1.5):
        sample = Telemetry(time, attitude_at_pitch(0.05 * np.sin(2.5 * time + phase)), centre)
        georeference.add(sample)
        before.add(sample)
    taken = before.rotation_at(begin, extrapolation=0.6)
    assert taken is not None
    x, y = pixel(attitude_at_pitch(0.05 * np.sin(2.5 * begin + phase)), centre)
    place = ground_point(taken.T @ np.array([(x - 319.5) / 600.0, (y - 239.5) / 600.0, 1.0]), centre, 0.1, 0.7)
    assert place is not None
    found = georeference.corrected(estimate_at(x, y, *place), begin)
    error = np.hypot(found.north - CAR[0], found.east - CAR[1]) / np.sqrt(2.0)
    assert 1.0 < error < 1.5 * found.std_m < 8.0


@pytest.mark.parametrize("begin", [0.5, 1.5, 1.7])
def test_a_ground_frame_that_begins_between_attitudes_has_their_swaying_in_its_std(begin: float) -> None:
    """Of attitudes and positions at 1 Hz, of a vehicle that sways by 3 degrees, errors were up to 20 stds."""
    georeference, between = Georeference(LENS, BODY_FROM_DOWN_CAMERA), TelemetryTrack(BODY_FROM_DOWN_CAMERA)
    for time in range(4):
        sample = Telemetry(
            time, attitude_at_pitch(0.05 * np.sin(2.5 * time)), np.array([8.0 * time - 10.0, -5.0, -60.0])
        )
        georeference.add(sample)
        between.add(sample)
    true, centre = attitude_at_pitch(0.05 * np.sin(2.5 * begin)), np.array([8.0 * begin - 10.0, -5.0, -60.0])
    taken, camera = between.rotation_at(begin), between.position_at(begin)
    assert taken is not None
    assert camera is not None
    x, y = pixel(true, centre)
    ray = taken.T @ np.array([(x - 319.5) / 600.0, (y - 239.5) / 600.0, 1.0])
    place = ground_point(ray, camera, 0.1, 0.7)
    assert place is not None
    found = georeference.corrected(estimate_at(x, y, *place), begin)
    error = np.hypot(found.north - CAR[0], found.east - CAR[1]) / np.sqrt(2.0)
    assert 0.3 < error < 2.0 * found.std_m < 8.0
