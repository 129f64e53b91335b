"""A target's place in the vehicle's frame, from its pixel and telemetry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.uav.georeference import Georeference
from edge.uav.tracker import Estimate, State, Telemetry
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA, rotation
from protocols.geometry.camera import Intrinsics

LENS = Intrinsics(640, 480, np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]]))
CAR = np.array([7.0, -12.0, -0.7])


def leaning(pitch: float) -> np.ndarray:
    return rotation(np.array([0.05]), np.array([pitch]), np.array([0.8]))[0]


def pixel(turned: np.ndarray, centre: np.ndarray) -> tuple[float, float]:
    x, y, z = BODY_FROM_DOWN_CAMERA.T @ turned.T @ (CAR - centre)
    return 600.0 * x / z + 319.5, 600.0 * y / z + 239.5


def seen(x: float, y: float, north: float, east: float) -> Estimate:
    return Estimate(0.0, State.VISIBLE, x, y, 40.0, 20.0, 0.0, 1.0, north=north, east=east, std_m=0.1)


def flown(seconds: float, wandered: np.ndarray, given: Georeference) -> Estimate:
    """A second of flight that leans to and fro; the tracker's frame has wandered off by ``wandered`` (2,) [m]."""
    out = None
    for k in range(round(seconds * 30)):
        time = k / 30.0
        turned, centre = leaning(0.2 * np.sin(3.0 * time)), np.array([2.0 * time, -5.0, -60.0])
        given.add(Telemetry(time, turned, centre))
        x, y = pixel(turned, centre)
        north, east = CAR[:2] + wandered
        estimate = seen(x, y, north, east)
        out = given.corrected(estimate, time)
    assert out is not None
    return out


def test_a_ground_frame_that_has_wandered_is_brought_back() -> None:
    told = flown(1.0, np.array([6.0, -3.0]), Georeference(LENS, BODY_FROM_DOWN_CAMERA))
    assert np.hypot(told.north - CAR[0], told.east - CAR[1]) < 0.1
    assert 0.2 < told.std_m < 1.0  # an autopilot's roll and pitch are not exact


def test_out_of_the_picture_the_last_correction_holds() -> None:
    given = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    told = flown(1.0, np.array([6.0, -3.0]), given)
    far = replace(told, north=100.0, east=50.0, x=9e4, y=9e4)
    away = given.corrected(far, 1.1)
    assert (away.north, away.east) == pytest.approx((94.0, 53.0), abs=0.1)
    given.clear()
    assert given.corrected(far, 1.2) == far


def test_nothing_is_corrected_without_telemetry_metres_or_a_steep_ray() -> None:
    given = Georeference(LENS, BODY_FROM_DOWN_CAMERA)
    estimate = seen(320.0, 240.0, 1.0, 2.0)
    assert given.corrected(estimate, 0.0) is estimate
    flown(0.5, np.zeros(2), given)
    unknown = replace(estimate, north=float("nan"), east=float("nan"))
    assert given.corrected(unknown, 0.4) is unknown
    assert given.place(320.0, 240.0, 0.4) is not None
    assert given.place(float("nan"), 240.0, 0.4) is None
    assert given.place(320.0, -1200.0, 0.4) is None
    assert given.place(320.0, 240.0, 30.0) is None
