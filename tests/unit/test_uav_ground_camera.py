"""The camera over the ground: projection outside the picture, ego-motion by itself and with telemetry, the clocks."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge.uav.ground.ego_motion import EgoMotion
from edge.uav.ground.image_plane import ImagePlane, inverse, transfer
from edge.uav.ground.plane_motion import ChainPlane, PosePlane
from edge.uav.timing.telemetry_track import TelemetryClock
from edge.uav.tracker import Telemetry
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

SIZE = (320, 240)
LENS = Intrinsics(320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]))
METRES_PER_CELL = 0.1


@pytest.fixture(scope="module")
def floor() -> npt.NDArray[np.uint8]:
    """Ground texture, 0.1 m a cell."""
    rng = np.random.default_rng(5)
    fine = cv2.GaussianBlur(rng.uniform(0, 255, (900, 900)).astype(np.float32), (0, 0), 1.5)
    coarse = cv2.GaussianBlur(rng.uniform(0, 255, (900, 900)).astype(np.float32), (0, 0), 6.0)
    mixed = (fine - fine.mean()) * 3 + (coarse - coarse.mean()) * 9 + 128
    return np.clip(mixed, 0, 255).astype(np.uint8)


def picture(floor: npt.NDArray[np.uint8], pose: PosePlane) -> npt.NDArray[np.uint8]:
    """What a camera sees of the floor whose middle is the ground's origin."""
    ground_from_cell = np.array([[METRES_PER_CELL, 0, -45.0], [0, METRES_PER_CELL, -45.0], [0, 0, 1.0]])
    image_from_cell = LENS.matrix @ pose.matrix @ ground_from_cell
    return np.asarray(cv2.warpPerspective(floor, image_from_cell, SIZE), np.uint8)


def flight(frame: int) -> PosePlane:
    """A drone 25 m up that drifts, turns and shakes."""
    t = frame / 30.0
    wobble = so3.exp(np.array([0.05 * np.sin(5 * t), 0.04 * np.sin(4 * t + 1), 0.5 * t]))
    return PosePlane(wobble, np.array([4.0 * t, 2.0 * np.sin(t), -25.0 - 2.0 * t]))


CORNERS = np.array([[20.0, 20.0], [300.0, 20.0], [300.0, 220.0], [20.0, 220.0], [160.0, 120.0]])


def drift(ego: EgoMotion, plane: ImagePlane, true: PosePlane, first_ground: Floats | None = None) -> float:
    """Largest error [px] at which the ground points under the corners are shown."""
    matrix = true.matrix if first_ground is None else true.matrix @ first_ground
    ground = transfer(inverse(matrix), (CORNERS - LENS.matrix[:2, 2]) / 300.0)
    return float(np.abs(plane.pixels(transfer(ego.motion.matrix, ground)) - CORNERS).max())


def test_ego_motion_with_a_known_lens_stays_within_pixels_over_two_seconds(floor: npt.NDArray[np.uint8]) -> None:
    plane, ego = ImagePlane(SIZE, LENS), EgoMotion(ImagePlane(SIZE, LENS))
    ego.begin(picture(floor, flight(0)), flight(0), None)
    for frame in range(1, 61):
        report = ego.update(picture(floor, flight(frame)), 1 / 30, keep_out=None)
        assert report.trusted
    assert drift(ego, plane, flight(60)) < 2.0
    assert isinstance(ego.motion, PosePlane)
    np.testing.assert_allclose(ego.motion.centre, flight(60).centre, atol=0.5)


def test_ego_motion_without_lens_or_telemetry_drifts_less_than_ten_pixels(floor: npt.NDArray[np.uint8]) -> None:
    plane, ego = ImagePlane(SIZE, None), EgoMotion(ImagePlane(SIZE, None))
    start = np.diag([0.01, 0.01, 1.0])
    ego.begin(picture(floor, flight(0)), ChainPlane(start), None)
    for frame in range(1, 61):
        ego.update(picture(floor, flight(frame)), 1 / 30, keep_out=None)
    # Its ground is the first picture: a homography away from the true one.
    first_pixels = inverse(plane.matrix) @ LENS.matrix @ flight(0).matrix
    assert drift(ego, plane, flight(60), inverse(first_pixels) @ start) < 10.0


def test_a_jump_of_the_picture_is_found_again(floor: npt.NDArray[np.uint8]) -> None:
    plane, ego = ImagePlane(SIZE, None), EgoMotion(ImagePlane(SIZE, None))
    ego.begin(picture(floor, flight(0)), ChainPlane(np.eye(3)), None)
    jump = PosePlane(flight(0).rotation, flight(0).centre + [4.5, -2.0, 0.0])  # about 54 px aside, 24 px down
    report = ego.update(picture(floor, jump), 1 / 30, keep_out=None)
    assert report.trusted
    moved = plane.pixels(transfer(ego.motion.matrix, plane.normalise(CORNERS)))
    true = transfer(LENS.matrix @ jump.matrix @ inverse(LENS.matrix @ flight(0).matrix), CORNERS)
    assert np.abs(true - CORNERS).max() > 50.0
    np.testing.assert_allclose(moved, true, atol=1.5)


def test_a_picture_of_nothing_is_said_to_be_blind(floor: npt.NDArray[np.uint8]) -> None:
    ego = EgoMotion(ImagePlane(SIZE, LENS))
    ego.begin(picture(floor, flight(0)), flight(0), None)
    report = ego.update(np.full((240, 320), 90, np.uint8), 1 / 30, keep_out=None)
    assert not report.trusted
    assert ego.blind == 1


def test_jacobians_are_the_derivatives() -> None:
    rng = np.random.default_rng(3)
    ground = rng.uniform(-8, 8, (12, 2))
    for motion in (flight(20), ChainPlane(flight(20).matrix / np.cbrt(np.linalg.det(flight(20).matrix)))):
        p = ground @ motion.matrix[:, :2].T + motion.matrix[:, 2]
        seen = p[:, :2] / p[:, 2:]
        jacobian = motion.jacobian(ground, seen, p[:, 2])
        for k in range(jacobian.shape[2]):
            step = np.zeros(jacobian.shape[2])
            step[k] = 1e-6
            ahead = transfer(motion.moved(step).matrix, ground)
            behind = transfer(motion.moved(-step).matrix, ground)
            np.testing.assert_allclose(jacobian[:, :, k], (ahead - behind) / 2e-6, atol=1e-5)


def test_a_bent_lens_gives_finite_pixels_far_outside_the_picture() -> None:
    lens = Intrinsics(320, 240, LENS.matrix, np.array([-0.3, 0.08, 0.0, 0.0, 0.0]))
    plane = ImagePlane(SIZE, lens)
    inside = np.array([[10.0, 10.0], [300.0, 200.0]])
    np.testing.assert_allclose(plane.pixels(plane.normalise(inside)), inside, atol=1e-6)
    line = np.column_stack([np.linspace(0.0, 6.0, 400), np.zeros(400)])
    out = plane.pixels(line)
    assert np.isfinite(out).all()
    assert (np.diff(out[:, 0]) > 0).all()


def attitude(t: float) -> Floats:
    return so3.exp(np.array([0.06 * np.sin(1.7 * t), 0.05 * np.sin(2.3 * t + 1), 0.3 * np.sin(0.8 * t)]))


@pytest.mark.parametrize(("rate", "offset"), [(1, -0.4), (5, 0.45), (50, 0.13)])
def test_the_offset_of_noisy_biased_telemetry_is_found(rate: int, offset: float) -> None:
    rng = np.random.default_rng(1)
    clock = TelemetryClock(np.eye(3))
    bias = so3.exp(np.deg2rad([0.2, -0.3, 0.2]))
    sent = 0
    for frame in range(360):
        t = frame / 30
        while sent / rate <= t:
            moment = sent / rate
            noisy = so3.exp(np.deg2rad(rng.normal(0, 0.2, 3))) @ bias @ attitude(moment - offset)
            clock.add(Telemetry(moment, noisy))
            sent += 1
        clock.saw(t, attitude(t).T)
    assert clock.offset == pytest.approx(offset, abs=0.04)
    assert clock.offset_std < 0.05


def test_without_motion_the_offset_stays_unknown() -> None:
    clock = TelemetryClock(np.eye(3))
    for frame in range(200):
        clock.add(Telemetry(frame / 30, np.eye(3)))
        clock.saw(frame / 30, np.eye(3))
    assert clock.offset_std > 0.2


def test_bad_samples_are_left_out_and_gaps_are_not_interpolated() -> None:
    clock = TelemetryClock(np.eye(3))
    clock.add(Telemetry(0.0, np.eye(3), np.array([0.0, 0.0, -50.0])))
    clock.add(Telemetry(float("nan"), np.eye(3)))
    clock.add(Telemetry(0.1, np.full((3, 3), np.nan)))
    clock.add(Telemetry(0.1, 2 * np.eye(3)))
    clock.add(Telemetry(-5.0, np.eye(3)))
    assert clock.rejected == 4
    clock.add(Telemetry(0.2, np.eye(3), np.array([np.nan, 0.0, -50.0])))
    assert clock.rotation_at(0.1) is not None
    assert clock.position_at(0.1) is None
    clock.add(Telemetry(9.0, np.eye(3)))
    assert clock.rotation_at(5.0) is None
