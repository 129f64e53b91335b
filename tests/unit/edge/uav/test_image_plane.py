"""Camera over the ground plane: projection outside the image, ego-motion with and without telemetry, clock offset."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge.uav.base import Telemetry
from edge.uav.ground.ego_motion import EgoMotion
from edge.uav.ground.image_plane import ImagePlane, apply_homography, inverse
from edge.uav.ground.plane_pose import PlaneHomography, PlanePose
from edge.uav.timing.telemetry_track import TelemetryTrack
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

SIZE = (320, 240)
LENS = Intrinsics(320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]))
METRES_PER_CELL = 0.1


@pytest.fixture(scope="module")
def texture() -> npt.NDArray[np.uint8]:
    """Ground texture, 0.1 m per cell."""
    rng = np.random.default_rng(5)
    fine = cv2.GaussianBlur(rng.uniform(0, 255, (900, 900)).astype(np.float32), (0, 0), 1.5)
    coarse = cv2.GaussianBlur(rng.uniform(0, 255, (900, 900)).astype(np.float32), (0, 0), 6.0)
    mixed = (fine - fine.mean()) * 3 + (coarse - coarse.mean()) * 9 + 128
    return np.clip(mixed, 0, 255).astype(np.uint8)


def render(texture: npt.NDArray[np.uint8], pose: PlanePose) -> npt.NDArray[np.uint8]:
    """The image of a camera over the texture, whose centre is the ground origin."""
    ground_from_cell = np.array([[METRES_PER_CELL, 0, -45.0], [0, METRES_PER_CELL, -45.0], [0, 0, 1.0]])
    image_from_cell = LENS.matrix @ pose.matrix @ ground_from_cell
    return np.asarray(cv2.warpPerspective(texture, image_from_cell, SIZE), np.uint8)


def pose_at_frame(frame: int) -> PlanePose:
    """A drone at 25 m that drifts, turns and shakes."""
    t = frame / 30.0
    wobble = so3.exp(np.array([0.05 * np.sin(5 * t), 0.04 * np.sin(4 * t + 1), 0.5 * t]))
    return PlanePose(wobble, np.array([4.0 * t, 2.0 * np.sin(t), -25.0 - 2.0 * t]))


CORNERS = np.array([[20.0, 20.0], [300.0, 20.0], [300.0, 220.0], [20.0, 220.0], [160.0, 120.0]])


def max_pixel_error(ego: EgoMotion, plane: ImagePlane, true: PlanePose, first_ground: Floats | None = None) -> float:
    """Largest projection error [px] of the ground points below the corners."""
    matrix = true.matrix if first_ground is None else true.matrix @ first_ground
    ground = apply_homography(inverse(matrix), (CORNERS - LENS.matrix[:2, 2]) / 300.0)
    return float(np.abs(plane.project(ego.pose.matrix, ground) - CORNERS).max())


def test_ego_motion_with_known_intrinsics_stays_within_two_pixels_over_two_seconds(
    texture: npt.NDArray[np.uint8],
) -> None:
    plane, ego = ImagePlane(SIZE, LENS), EgoMotion(ImagePlane(SIZE, LENS))
    ego.begin(render(texture, pose_at_frame(0)), pose_at_frame(0), None)
    for frame in range(1, 61):
        report = ego.update(render(texture, pose_at_frame(frame)), 1 / 30, excluded=None)
        assert report.trusted
    assert max_pixel_error(ego, plane, pose_at_frame(60)) < 2.0
    assert isinstance(ego.pose, PlanePose)
    np.testing.assert_allclose(ego.pose.centre, pose_at_frame(60).centre, atol=0.5)


def test_ego_motion_without_intrinsics_or_telemetry_drifts_less_than_ten_pixels(texture: npt.NDArray[np.uint8]) -> None:
    plane, ego = ImagePlane(SIZE, None), EgoMotion(ImagePlane(SIZE, None))
    start = np.diag([0.01, 0.01, 1.0])
    ego.begin(render(texture, pose_at_frame(0)), PlaneHomography(start), None)
    for frame in range(1, 61):
        ego.update(render(texture, pose_at_frame(frame)), 1 / 30, excluded=None)
    # Its ground frame is the first image: a homography from the true one.
    first_pixels = inverse(plane.matrix) @ LENS.matrix @ pose_at_frame(0).matrix
    assert max_pixel_error(ego, plane, pose_at_frame(60), inverse(first_pixels) @ start) < 10.0


def test_a_large_image_shift_is_recovered(texture: npt.NDArray[np.uint8]) -> None:
    plane, ego = ImagePlane(SIZE, None), EgoMotion(ImagePlane(SIZE, None))
    ego.begin(render(texture, pose_at_frame(0)), PlaneHomography(np.eye(3)), None)
    shifted_pose = PlanePose(
        pose_at_frame(0).rotation, pose_at_frame(0).centre + [4.5, -2.0, 0.0]
    )  # about 54 px aside, 24 px down
    report = ego.update(render(texture, shifted_pose), 1 / 30, excluded=None)
    assert report.trusted
    moved = plane.project(ego.pose.matrix, plane.normalise(CORNERS))
    true = apply_homography(LENS.matrix @ shifted_pose.matrix @ inverse(LENS.matrix @ pose_at_frame(0).matrix), CORNERS)
    assert np.abs(true - CORNERS).max() > 50.0
    np.testing.assert_allclose(moved, true, atol=1.5)


def test_an_image_without_texture_gives_no_trusted_pose(texture: npt.NDArray[np.uint8]) -> None:
    ego = EgoMotion(ImagePlane(SIZE, LENS))
    ego.begin(render(texture, pose_at_frame(0)), pose_at_frame(0), None)
    report = ego.update(np.full((240, 320), 90, np.uint8), 1 / 30, excluded=None)
    assert not report.trusted
    assert ego.frames_without_pose == 1


def test_analytic_jacobians_match_finite_differences() -> None:
    rng = np.random.default_rng(3)
    ground = rng.uniform(-8, 8, (12, 2))
    for pose in (
        pose_at_frame(20),
        PlaneHomography(pose_at_frame(20).matrix / np.cbrt(np.linalg.det(pose_at_frame(20).matrix))),
    ):
        p = ground @ pose.matrix[:, :2].T + pose.matrix[:, 2]
        seen = p[:, :2] / p[:, 2:]
        jacobian = pose.jacobian(ground, seen, p[:, 2])
        for k in range(jacobian.shape[2]):
            step = np.zeros(jacobian.shape[2])
            step[k] = 1e-6
            ahead = apply_homography(pose.retract(step).matrix, ground)
            behind = apply_homography(pose.retract(-step).matrix, ground)
            np.testing.assert_allclose(jacobian[:, :, k], (ahead - behind) / 2e-6, atol=1e-5)


def test_a_distorted_lens_gives_finite_pixels_far_outside_the_image() -> None:
    lens = Intrinsics(320, 240, LENS.matrix, np.array([-0.3, 0.08, 0.0, 0.0, 0.0]))
    plane = ImagePlane(SIZE, lens)
    inside = np.array([[10.0, 10.0], [300.0, 200.0]])
    np.testing.assert_allclose(plane.project(np.eye(3), plane.normalise(inside)), inside, atol=1e-6)
    line = np.column_stack([np.linspace(0.0, 6.0, 400), np.zeros(400)])
    out = plane.project(np.eye(3), line)
    assert np.isfinite(out).all()
    assert (np.diff(out[:, 0]) > 0).all()


def attitude(t: float) -> Floats:
    return so3.exp(np.array([0.06 * np.sin(1.7 * t), 0.05 * np.sin(2.3 * t + 1), 0.3 * np.sin(0.8 * t)]))


@pytest.mark.parametrize(("rate", "offset"), [(1, -0.4), (5, 0.45), (50, 0.13)])
def test_the_clock_offset_of_noisy_biased_telemetry_is_estimated(rate: int, offset: float) -> None:
    rng = np.random.default_rng(1)
    telemetry = TelemetryTrack(np.eye(3))
    bias = so3.exp(np.deg2rad([0.2, -0.3, 0.2]))
    sent = 0
    for frame in range(360):
        t = frame / 30
        while sent / rate <= t:
            moment = sent / rate
            noisy = so3.exp(np.deg2rad(rng.normal(0, 0.2, 3))) @ bias @ attitude(moment - offset)
            telemetry.add(Telemetry(moment, noisy))
            sent += 1
        telemetry.add_visual_attitude(t, attitude(t).T)
    assert telemetry.offset == pytest.approx(offset, abs=0.04)
    assert telemetry.offset_std < 0.05


def test_without_motion_the_clock_offset_is_not_observable() -> None:
    telemetry = TelemetryTrack(np.eye(3))
    for frame in range(200):
        telemetry.add(Telemetry(frame / 30, np.eye(3)))
        telemetry.add_visual_attitude(frame / 30, np.eye(3))
    assert telemetry.offset_std > 0.2


def test_invalid_samples_are_rejected_and_gaps_are_not_interpolated() -> None:
    telemetry = TelemetryTrack(np.eye(3))
    telemetry.add(Telemetry(0.0, np.eye(3), np.array([0.0, 0.0, -50.0])))
    telemetry.add(Telemetry(float("nan"), np.eye(3)))
    telemetry.add(Telemetry(0.1, np.full((3, 3), np.nan)))
    telemetry.add(Telemetry(0.1, 2 * np.eye(3)))
    telemetry.add(Telemetry(-5.0, np.eye(3)))
    assert telemetry.rejected == 4
    telemetry.add(Telemetry(0.2, np.eye(3), np.array([np.nan, 0.0, -50.0])))
    assert telemetry.rotation_at(0.1) is not None
    assert telemetry.position_at(0.1) is None
    telemetry.add(Telemetry(9.0, np.eye(3)))
    assert telemetry.rotation_at(5.0) is None
