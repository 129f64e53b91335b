"""Simulated town: deterministic, ground truth consistent with the images, telemetry with the declared noise."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from edge.uav.world import cars, scenarios
from edge.uav.world.flight_world import FlightWorld
from protocols.core.errors import InputError
from protocols.geometry import so3
from protocols.geometry.types import Floats

SMALL = (320, 240)
IN_VIEW = ("trees", "bridge", "lighting", "off-road")


@cache
def world(name: str, seed: int = 1, frames: int | None = None, size: tuple[int, int] = (640, 480)) -> FlightWorld:
    return scenarios.get(name, seed, size, frames)


def target_difference(w: FlightWorld, i: int) -> Floats:
    """Change of each pixel of frame ``i`` when the target is removed."""
    with_it = w.render(i, noise=False).astype(np.float64)
    return np.asarray(np.abs(with_it - w.render(i, target=False, noise=False)).max(axis=2))


def ground_homography(w: FlightWorld, i: int) -> Floats:
    """Image from the ground plane (3, 3), by the true pose alone."""
    pose = w.truth(i).camera
    return np.asarray(w.lens.matrix @ np.column_stack([pose.rotation[:, :2], pose.translation]))


def test_the_same_arguments_give_the_same_world_in_any_order() -> None:
    one, other = (scenarios.get("exit-bend", 5, SMALL, 20) for _ in range(2))
    last, first = one.frame(one.length - 1), one.frame(0)
    assert np.array_equal(other.frame(0), first)
    assert np.array_equal(other.frame(other.length - 1), last)
    assert (one.truth(30).x, one.truth(30).visible) == (other.truth(30).x, other.truth(30).visible)
    for a, b in zip(one.telemetry(10.0), other.telemetry(10.0), strict=True):
        assert a.time == b.time
        assert np.array_equal(a.ned_from_body, b.ned_from_body)


@pytest.mark.parametrize("change", [{"seed": 6}, {"name": "exit-straight"}, {"frames": 21}])
def test_another_seed_name_or_length_is_another_world(change: dict[str, object]) -> None:
    usual: dict[str, object] = {"name": "exit-bend", "seed": 5, "frames": 20}
    one, other = (scenarios.get(size=SMALL, **arguments) for arguments in (usual, usual | change))  # type: ignore[arg-type]
    assert not np.array_equal(one.frame(0), other.frame(0))


def test_noise_differs_from_frame_to_frame_and_has_the_given_std() -> None:
    w = world("exit-straight", 2, 30)
    grain = [w.frame(i).astype(np.float64) - w.render(i, noise=False) for i in (3, 4)]
    assert np.std(grain[0]) == pytest.approx(w.noise_std, rel=0.05)
    assert abs(np.corrcoef(grain[0].ravel(), grain[1].ravel())[0, 1]) < 0.05


@pytest.mark.parametrize("name", ["exit-straight", "exit-bend", "yaw", "distractors"])
def test_the_target_is_rendered_at_its_true_position(name: str) -> None:
    w = world(name)
    for i in range(0, w.out_of_view[0] - 25, 14):
        t = w.truth(i)
        rows, columns = np.nonzero(target_difference(w, i) > 20)
        # Its shadow lies 0.85 m to the north-east.
        assert np.hypot(columns.mean() - t.x, rows.mean() - t.y) < 6.0
        assert t.box.x - 1.5 <= np.quantile(columns, 0.1) < np.quantile(columns, 0.9) <= t.box.x + t.box.width + 9.0
        assert min(t.width, t.height) > 15


def test_the_target_has_its_colour_on_the_bonnet_where_the_truth_says_forward() -> None:
    w = world("exit-straight", 3)
    gain = w.illumination.gain
    for i in (0, 20, 40):
        t = w.truth(i)
        ahead = 0.36 * t.length * np.array([np.cos(t.heading), np.sin(t.heading)])
        x, y = np.rint(np.array([t.x, t.y]) + ahead).astype(int)
        assert w.render(i, noise=False)[y, x] == pytest.approx(gain[i] * w.target.colour, abs=22)


@pytest.mark.parametrize("name", ["trees", "bridge", "partial", "exit-bend"])
def test_the_visible_share_agrees_with_the_image(name: str) -> None:
    w = world(name, 4)
    compared = 0
    for i in range(40, w.length, 9):
        t = w.truth(i)
        points = cars.body_points(w.target.ground[i], float(w.target.course[i]))
        pixels = np.rint(w.lens.project(t.camera.camera_from_world(points))).astype(int)
        inside = ((pixels >= 0) & (pixels < np.array(w.size))).all(axis=1)
        changed = target_difference(w, i) > 5
        seen = changed[pixels[inside, 1], pixels[inside, 0]].sum() / len(points)
        assert seen == pytest.approx(t.visible, abs=0.13), f"frame {i}"
        compared += 0.05 < t.visible < 0.95
    assert compared or name == "exit-bend"


def test_frames_with_full_occlusion_show_nothing_of_the_target() -> None:
    w = world("bridge", 4)
    hidden = [i for i in range(w.length) if w.truth(i).visible == 0.0]
    assert len(hidden) >= 5
    middle = hidden[len(hidden) // 2]
    assert (target_difference(w, middle) > 5).sum() == 0


def test_ground_truth_projected_with_the_true_pose_is_the_truth_in_pixels() -> None:
    w = world("turn-out-of-view")
    for i in range(0, w.length, 20):
        t = w.truth(i)
        point = np.array([[t.north, t.east, -cars.CENTRE_HEIGHT]])
        assert w.lens.project(t.camera.camera_from_world(point))[0] == pytest.approx([t.x, t.y], abs=1e-6)
        assert t.camera.rotation == pytest.approx((t.ned_from_body @ w.body_from_camera).T, abs=1e-12)


def test_the_true_poses_register_two_images_of_the_ground() -> None:
    w = world("exit-straight", 3)
    first, second = (cv2.cvtColor(w.render(i, noise=False), cv2.COLOR_BGR2GRAY) for i in (0, 25))
    between = ground_homography(w, 25) @ np.linalg.inv(ground_homography(w, 0))

    def agreement(shift: float) -> float:
        moved = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ between
        warped = cv2.warpPerspective(first, moved, w.size, flags=cv2.INTER_LINEAR)
        covered = cv2.warpPerspective(np.full_like(first, 255), moved, w.size) > 254
        return float(np.corrcoef(warped[covered], second[covered])[0, 1])

    assert agreement(0.0) > 0.8
    assert agreement(0.0) > max(agreement(2.0), agreement(-2.0)) + 0.01


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("exit-straight", 15),
        ("exit-straight", 45),
        ("exit-straight", 150),
        ("exit-bend", 15),
        ("exit-bend", 60),
        ("exit-bend", 90),
        ("yaw", 45),
        ("distractors", 60),
        ("distractors", 120),
        ("turn-out-of-view", 75),
        ("paper-4.4", 60),
    ],
)
def test_the_target_is_out_of_view_for_exactly_the_requested_frames(name: str, frames: int) -> None:
    w = world(name, 1, frames)
    begin, end = w.out_of_view
    assert end - begin == frames
    assert (w.share_in_image == 0.0).sum() == frames, "in one run"
    assert [w.truth(i).inside == 0.0 for i in (begin - 1, begin, end - 1, end)] == [False, True, True, False]
    assert begin > 60, "time to learn the target"
    assert min(w.truth(i).visible for i in range(0, 32, 4)) == 1.0
    back = next(i for i in range(end, w.length) if w.truth(i).visible >= 0.5)
    assert back - end < 25
    assert w.length - back > 45, "time to find it again"


def test_a_wide_image_loses_the_target_for_as_long_at_the_same_scale() -> None:
    w = world("exit-bend", 1, 45, (1280, 720))
    assert w.frame(0).shape == (720, 1280, 3)
    assert w.out_of_view[1] - w.out_of_view[0] == 45
    assert w.truth(0).length == pytest.approx(45.0, rel=0.08)
    assert world("exit-bend", 1, 45).truth(0).length == pytest.approx(45.0, rel=0.08)


@pytest.mark.parametrize("name", IN_VIEW)
def test_in_view_scenarios_keep_the_target_in_the_image(name: str) -> None:
    w = world(name)
    assert w.share_in_image.min() == 1.0


def test_trees_occlude_the_target_in_part_and_for_a_while() -> None:
    visible = np.array([world("trees").truth(i).visible for i in range(0, 240, 2)])
    assert (visible < 0.3).sum() >= 8
    assert (visible[-15:] > 0.9).all()


def test_partial_stays_on_the_border_for_the_requested_frames() -> None:
    w = world("partial", 1, 60)
    cut = (w.share_in_image > 0.15) & (w.share_in_image < 0.9)
    assert cut.sum() >= 50
    assert np.median(w.share_in_image[cut]) == pytest.approx(0.5, abs=0.25)
    assert (w.share_in_image[-20:] == 1.0).all()


def test_off_road_is_off_the_road_and_comes_back() -> None:
    w = world("off-road")
    start, end = w.target.ground[0], w.target.ground[-1]
    speed = np.array([w.truth(i).speed for i in range(w.length)])
    turns = np.ptp(np.unwrap(w.target.course))
    assert turns > np.deg2rad(25.0)
    assert speed.min() > 2.0
    assert np.linalg.norm(end - start) > 40.0


def test_lighting_changes_by_half_and_more() -> None:
    w = world("lighting")
    brightness = [float(w.frame(i).mean()) for i in range(0, w.length, 20)]
    assert max(brightness) / min(brightness) > 1.5


def test_distractors_have_the_targets_colour_and_are_near_while_it_is_out_of_view_of_view() -> None:
    for seed in (1, 2, 3):
        w = world("distractors", seed)
        same = [car for car in w.traffic if car.colour == w.target.colour]
        gaps = np.array([np.linalg.norm(car.ground - w.target.ground, axis=1) for car in same])
        assert len(same) >= 3
        assert (gaps[:, w.out_of_view[0] : w.out_of_view[1]].min(axis=0) < 30.0).all()


def test_elsewhere_no_other_car_has_the_targets_colour() -> None:
    w = world("exit-bend", 2)
    assert all(car.colour != w.target.colour for car in (*w.traffic, *w.town.parked))


@pytest.mark.parametrize("name", list(scenarios.SCENARIOS))
def test_no_car_drives_through_the_target(name: str) -> None:
    w = world(name)
    for car in w.traffic:
        assert np.linalg.norm(car.ground - w.target.ground, axis=1).min() > 2.2
    for car in w.town.parked:
        assert np.linalg.norm(car.ground[0] - w.target.ground, axis=1).min() > 2.0


def test_the_turn_is_taken_while_the_target_is_out_of_view_of_view() -> None:
    for seed in (1, 2, 3):
        w = world("turn-out-of-view", seed)
        course = np.unwrap(w.target.course)
        whole = abs(course[-1] - course[0])
        assert whole > np.deg2rad(70.0)
        assert abs(course[w.out_of_view[1]] - course[w.out_of_view[0]]) > 0.6 * whole


def test_the_simple_controller_of_the_paper_loses_the_car_in_a_bend() -> None:
    w = world("paper-3.3")
    begin, end = w.out_of_view
    course = np.unwrap(w.target.course)
    assert end - begin >= 20
    assert np.ptp(course[max(begin - 60, 0) : end]) > np.deg2rad(40.0)


def errors_of(w: FlightWorld, lag: float, **declared: float) -> tuple[Floats, Floats]:
    """Attitude errors (n, 3) [deg] and position errors (n, 3) [m] of telemetry against the truth ``lag`` before."""
    samples = w.telemetry(50.0, **declared)  # type: ignore[arg-type]
    attitude, position = w.flight.at(np.array([s.time for s in samples]) - lag)
    turned = [so3.log(attitude[k].T @ s.ned_from_body) for k, s in enumerate(samples)]
    moved = [s.position - position[k] for k, s in enumerate(samples) if s.position is not None]
    return np.rad2deg(np.array(turned)), np.array(moved)


def test_telemetry_has_the_declared_bias_noise_and_latency() -> None:
    w = world("exit-straight", 1, 150)
    angle, place = errors_of(w, 1.0 / w.fps)
    assert np.linalg.norm(angle.mean(axis=0)) == pytest.approx(0.4, abs=0.05)
    assert angle.std(axis=0) == pytest.approx([0.2] * 3, rel=0.15)
    spread = [
        np.sqrt((errors_of(world("lighting", seed, None, SMALL), 1.0 / w.fps)[1] ** 2).mean()) for seed in range(8)
    ]
    assert np.mean(spread) == pytest.approx(0.3, rel=0.3)
    assert np.abs(np.diff(place, axis=0)).max() < 0.03, "it is correlated, without steps"


def test_telemetry_is_late_by_a_frame() -> None:
    w = world("exit-straight", 1, 150)
    clean = {"attitude_noise_deg": 0.0, "attitude_bias_deg": 0.0, "position_std": 0.0}
    assert np.abs(errors_of(w, 1.0 / w.fps, **clean)[0]).max() < 1e-9
    assert np.abs(errors_of(w, 0.0, **clean)[0]).max() > 0.05
    assert np.abs(errors_of(w, 0.0, latency_s=0.0, **clean)[0]).max() < 1e-9


def test_telemetry_comes_at_its_rate_on_its_own_clock() -> None:
    w = world("exit-bend", 2)
    for rate in (1.0, 10.0, 50.0):
        times = np.array([s.time for s in w.telemetry(rate)])
        assert np.diff(times) == pytest.approx(1.0 / rate)
        assert times[0] < 0.0
        assert times[-1] > w.time(w.length - 1) - 1.0 / rate - 1e-9
        shifted = np.array([s.time for s in w.telemetry(rate, time_offset=0.3)])
        assert shifted - times == pytest.approx(0.3)
    own = np.array([s.time for s in w.telemetry(10.0, time_offset=None)])
    assert own - [s.time for s in w.telemetry(10.0)] == pytest.approx(w.time_offset)
    assert 0.0 < abs(w.time_offset) <= 0.5
    assert all(s.position is None for s in w.telemetry(10.0, with_position=False))


@pytest.mark.parametrize(
    "arguments",
    [
        ("atlantis", 0),
        ("exit-bend", -1),
        ("exit-bend", 0, (640, 480), 2),
        ("exit-bend", 0, (640, 480), 5000),
        ("trees", 0, (640, 480), 30),
        ("exit-bend", 0, (8, 8)),
    ],
)
def test_invalid_arguments_are_refused_with_a_remedy(arguments: tuple[object, ...]) -> None:
    with pytest.raises(InputError) as refused:
        scenarios.get(*arguments)  # type: ignore[arg-type]
    assert refused.value.remedy


def test_a_frame_beyond_the_end_raises_index_error() -> None:
    w = world("exit-bend", 2)
    with pytest.raises(IndexError):
        w.frame(w.length)
    with pytest.raises(IndexError):
        w.truth(-1)
