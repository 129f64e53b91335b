"""The ground tracker on short synthetic videos of a flat street: track states, exits, invalid input, determinism."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge.uav.base import Box, Estimate, Telemetry, TrackState
from edge.uav.ground_tracker import GroundTracker
from edge.uav.tracker_factory import make_tracker
from edge.uav.world import scenarios
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

SIZE = (320, 240)
FPS = 30.0
CAR = (36, 16)


@pytest.fixture(scope="module")
def background() -> Image:
    """A wide image of grass with a street along it, seen from straight above."""
    rng = np.random.default_rng(7)
    noise = cv2.GaussianBlur(rng.uniform(-1, 1, (360, 1400, 3)).astype(np.float32), (0, 0), 2.0)
    out = np.array([60.0, 120.0, 80.0], np.float32) + 160.0 * noise
    out[150:210] = np.array([95.0, 95.0, 95.0], np.float32) + 60.0 * noise[150:210]
    for x in range(0, 1400, 40):
        out[178:182, x : x + 18] = 210.0
    return np.clip(out, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Video:
    """A window of the background that may move, and a car that drives along the street."""

    background: Image
    window: npt.NDArray[np.int64]  # (n, 2) top left
    car: Floats  # (n, 2) centre in the scenery
    hidden: range = range(0)
    other_car: Floats | None = None

    def frame(self, i: int) -> Image:
        image = self.background.copy()
        for centre in (self.car[i], *(() if self.other_car is None else (self.other_car[i],))):
            x, y = round(float(centre[0] - CAR[0] / 2)), round(float(centre[1] - CAR[1] / 2))
            image[y : y + CAR[1], x : x + CAR[0]] = (40, 40, 210)
            image[y + 2 : y + CAR[1] - 2, x + 22 : x + 27] = (40, 30, 30)
        if i in self.hidden:  # a tree's crown over the car
            cv2.circle(image, (round(float(self.car[i][0])), round(float(self.car[i][1]))), 34, (30, 70, 35), -1)
        x, y = self.window[i]
        noise = np.random.default_rng(i).normal(0, 2, (SIZE[1], SIZE[0], 3))
        return np.clip(image[y : y + SIZE[1], x : x + SIZE[0]] + noise, 0, 255).astype(np.uint8)

    def truth(self, i: int) -> Floats:
        return np.asarray(self.car[i] - self.window[i])

    def box(self) -> Box:
        x, y = self.truth(0)
        return Box(x - CAR[0] / 2, y - CAR[1] / 2, *CAR)


def video_of(background: Image, frames: int, speed: float, window_speed: float, **more: object) -> Video:
    k = np.arange(frames)
    car = np.column_stack([120.0 + speed * k, np.full(frames, 196.0)])
    window = np.column_stack([40 + window_speed * k, np.full(frames, 70.0)]).astype(np.int64)
    return Video(background, window, car, **more)  # type: ignore[arg-type]


def track(video: Video, model: str = "ground", seed: int = 0, without: range = range(0)) -> list[Estimate]:
    tracker = make_tracker(model, SIZE, fps=FPS, seed=seed)
    out = [tracker.begin(video.frame(0), 0.0, video.box())]
    for i in range(1, len(video.car)):
        out.append(tracker.handle_frame(None if i in without else video.frame(i), i / FPS))
    return out


def errors(video: Video, found: list[Estimate]) -> Floats:
    return np.array([float(np.hypot(*(np.array([e.x, e.y]) - video.truth(i)))) for i, e in enumerate(found)])


def test_across_a_second_without_images_telemetry_says_where_the_camera_has_moved(background: Image) -> None:
    """The camera was taken to have gone on for three frames: it was 13 m off, and the car lost for good."""
    video = video_of(background, 80, 6.0, 5.0)
    lens = Intrinsics(*SIZE, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]))
    tracker = make_tracker("ground", SIZE, lens, BODY_FROM_DOWN_CAMERA, FPS)
    for i in range(-30, len(video.car)):
        tracker.handle_telemetry(Telemetry(i / FPS, np.eye(3), np.array([0.0, 0.1 * (40.0 + 5.0 * i), -30.0])))
    tracker.begin(video.frame(0), 0.0, video.box())
    for i in (*range(1, 30), *range(60, 80)):
        found = tracker.handle_frame(video.frame(i), i / FPS)
    assert found.state is TrackState.VISIBLE
    assert float(np.hypot(*(np.array([found.x, found.y]) - video.truth(79)))) < 6.0


def test_a_car_in_view_is_tracked_within_pixels(background: Image) -> None:
    video = video_of(background, 60, 4.0, 3.0)
    found = track(video)
    assert all(e.state is TrackState.VISIBLE for e in found)
    assert errors(video, found).max() < 4.0
    assert abs(found[-1].heading) < 0.1
    assert found[-1].width == pytest.approx(CAR[0], rel=0.2)
    assert np.isnan(found[-1].north)


@pytest.mark.parametrize(
    ("turn", "course", "colour", "contrast"),
    [(0.7, 2.2, (40, 40, 210), 22.0), (-0.4, -0.4, (60, 50, 190), 22.0), (0.7, 2.2, (220, 40, 40), 45.0)],
)
def test_a_plain_target_over_textured_ground_is_tracked_whichever_way_it_points(
    turn: float, course: float, colour: tuple[int, int, int], contrast: float
) -> None:
    """It was lost: corners of the box, its ring and a brightness as the ground's held the template to the ground."""
    rng = np.random.default_rng(4 if contrast > 22.0 else 5)
    cells = (rng.normal(0, contrast, (240 // n, 320 // n, 3)) for n in (4, 16))
    layers = (cv2.resize(one, SIZE, interpolation=cv2.INTER_CUBIC) for one in cells)
    ground = 100.0 + sum(layers)
    matrix = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
    tracker = GroundTracker(SIZE, Intrinsics(*SIZE, matrix), BODY_FROM_DOWN_CAMERA, FPS, 0)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    body = np.array([[22, 9], [22, -9], [-22, -9], [-22, 9]]) @ axes
    size = np.ptp(body, axis=0) + 4.0
    for i in range(60):
        centre = np.array([160.0, 120.0]) + (i - 30) * 2.0 * np.array([np.cos(course), np.sin(course)])
        image = np.clip(ground, 0, 255).astype(np.uint8)
        cv2.fillConvexPoly(image, np.round(16 * (centre + body)).astype(np.int32), colour, cv2.LINE_AA, 4)
        image = np.clip(image + np.random.default_rng(i).normal(0, 3, image.shape), 0, 255).astype(np.uint8)
        tracker.handle_telemetry(Telemetry(i / FPS, np.eye(3), np.array([0.0, 0.0, -30.0])))
        if i == 0:
            found = tracker.begin(image, 0.0, Box(*(centre - size / 2), *size))
        else:
            found = tracker.handle_frame(image, i / FPS)
        assert found.state is TrackState.VISIBLE, i
        assert np.hypot(found.x - centre[0], found.y - centre[1]) < 6.0, i


def test_a_car_that_leaves_the_image_coasts_and_is_reacquired_when_the_camera_follows(background: Image) -> None:
    video = video_of(background, 100, 5.0, 0.0)
    late = np.where(np.arange(100) > 75, (np.arange(100) - 75) * 16, 0)
    video = Video(background, video.window + np.column_stack([late, 0 * late]), video.car)
    found = track(video)
    share = np.array([(SIZE[0] - video.truth(i)[0]) / CAR[0] + 0.5 for i in range(100)])
    out = share <= 0
    assert out.sum() > 20
    assert errors(video, found)[out].max() < CAR[0]
    assert not any(found[i].state is TrackState.VISIBLE for i in np.flatnonzero(out))
    assert all(found[i].x > SIZE[0] for i in np.flatnonzero(out)[5:-2])
    assert all(e.state is TrackState.VISIBLE for e in found[-5:])
    assert errors(video, found)[-5:].max() < 4.0
    grown = [found[i].std for i in np.flatnonzero(out)]
    assert grown[-1] > grown[0]


def test_a_car_under_a_tree_is_not_reported_visible(background: Image) -> None:
    video = video_of(background, 70, 4.0, 3.0, hidden=range(35, 55))
    found = track(video)
    assert all(found[i].state is TrackState.COASTING for i in range(37, 54))
    assert errors(video, found)[35:55].max() < CAR[0]
    assert all(e.state is TrackState.VISIBLE for e in found[-10:])


def test_an_identical_oncoming_car_is_not_accepted_as_the_target(background: Image) -> None:
    video = video_of(background, 110, 4.0, 0.0)
    other_car = np.column_stack([900.0 - 6.0 * np.arange(110), np.full(110, 165.0)])
    found = track(Video(background, video.window, video.car, other_car=other_car))
    gone = [i for i in range(110) if video.truth(i)[0] > SIZE[0] + CAR[0] / 2]
    assert not any(found[i].state is TrackState.VISIBLE for i in gone)


def test_a_car_initially_cut_by_the_border_is_learnt_completely_later(background: Image) -> None:
    video = video_of(background, 45, 4.0, 0.0)
    slide = np.maximum(120 - 40 - 12 * np.maximum(np.arange(45) - 5, 0), -60)
    video = Video(background, np.column_stack([40 + slide + 4 * np.arange(45), video.window[:, 1]]), video.car)
    assert abs(video.truth(0)[0]) < 0.1 * CAR[0]
    found = track(video)
    assert all(e.state is TrackState.VISIBLE for e in found)
    assert errors(video, found)[25:].max() < 5.0


def test_undecodable_frames_are_coasting_and_do_not_lose_the_target(background: Image) -> None:
    video = video_of(background, 50, 4.0, 3.0)
    found = track(video, without=range(25, 31))
    assert all(found[i].state is not TrackState.VISIBLE for i in range(25, 31))
    assert all(e.state is TrackState.VISIBLE for e in found[34:])
    assert errors(video, found).max() < 12.0


def test_the_same_seed_gives_the_same_estimates(background: Image) -> None:
    video = video_of(background, 60, 5.5, 0.0)
    first, again = track(video, seed=3), track(video, seed=3)
    assert [(e.x, e.y, e.std, e.state) for e in first] == [(e.x, e.y, e.std, e.state) for e in again]


def test_the_target_is_finally_lost_and_then_has_no_position(background: Image) -> None:
    video = video_of(background, 40, 4.0, 0.0)
    tracker = make_tracker("ground", SIZE, fps=FPS)
    tracker.begin(video.frame(0), 0.0, video.box())
    for i in range(1, 40):
        tracker.handle_frame(video.frame(i), i / FPS)
    nothing = background[70:310, 40:360]
    last = [tracker.handle_frame(nothing, 40 / FPS + k / 5) for k in range(150)][-1]
    assert last.state is TrackState.LOST
    assert np.isnan(last.x)
    assert np.isnan(last.y)


@pytest.mark.parametrize(
    "box",
    [Box(400, 50, 30, 20), Box(-40, 50, 30, 20), Box(50, 50, 2, 2), Box(0, 0, 320, 240), Box(float("nan"), 5, 20, 20)],
)
def test_an_invalid_box_is_rejected_in_one_line(background: Image, box: Box) -> None:
    with pytest.raises(InputError) as raised:
        make_tracker("ground", SIZE).begin(background[:240, :320], 0.0, box)
    assert "\n" not in str(raised.value)


def test_telemetry_makes_the_estimate_metric(background: Image) -> None:
    """A camera at 30 m with pixels of 0.1 m, image top to the north, moving east at 9 m/s."""
    lens = Intrinsics(320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]))
    camera_up_is_north = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    video = video_of(background, 60, 4.0, 3.0)
    tracker = make_tracker("ground", SIZE, lens, camera_up_is_north, FPS)
    for i in range(60):
        tracker.handle_telemetry(Telemetry(i / FPS, np.eye(3), np.array([0.0, 9.0 * i / FPS, -30.0])))
        last = (
            tracker.begin(video.frame(0), 0.0, video.box()) if i == 0 else tracker.handle_frame(video.frame(i), i / FPS)
        )
    east = 9.0 * 59 / FPS + 0.1 * (video.truth(59)[0] - 159.5)
    assert last.east == pytest.approx(east, abs=1.0)
    assert last.north == pytest.approx(-0.1 * (video.truth(59)[1] - 119.5), abs=1.0)
    assert last.speed == pytest.approx(12.0, abs=1.0)
    assert last.course == pytest.approx(np.pi / 2, abs=0.1)


def test_later_telemetry_makes_the_estimate_metric_without_losing_the_target(background: Image) -> None:
    lens = Intrinsics(320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]))
    video = video_of(background, 60, 4.0, 3.0)
    tracker = make_tracker("ground", SIZE, lens, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), FPS)
    found = [tracker.begin(video.frame(0), 0.0, video.box())]
    for i in range(1, 60):
        if i > 30:
            tracker.handle_telemetry(Telemetry(i / FPS, np.eye(3), np.array([0.0, 9.0 * i / FPS, -30.0])))
        found.append(tracker.handle_frame(video.frame(i), i / FPS))
    assert np.isnan(found[25].speed)
    assert found[-1].speed == pytest.approx(12.0, abs=1.2)
    assert errors(video, found).max() < 5.0


def test_an_unknown_model_is_rejected_with_the_list_of_models() -> None:
    with pytest.raises(InputError, match="ground, paper, plain"):
        make_tracker("best", SIZE)


def test_a_car_on_an_unpredicted_path_is_redetected_over_the_full_frame(background: Image) -> None:
    """It leaves the street behind trees and appears 90 px beside it, outside the search area of the particles."""
    video = video_of(background, 100, 3.0, 3.0, hidden=range(30, 60))
    away = video.car.copy()
    away[45:, 1] -= 90.0
    estimates = track(replace(video, car=away))
    assert estimates[55].state is TrackState.COASTING
    last = estimates[-1]
    assert last.state is TrackState.VISIBLE
    assert np.hypot(*(np.array([last.x, last.y]) - (away[-1] - video.window[-1]))) < 5.0


def test_a_car_that_returns_with_another_heading_is_reacquired() -> None:
    """It took a bend out of view and the particles' heading is off: its shape matches only when rotated."""
    world = scenarios.get("exit-bend", 1, frames=45)
    tracker = make_tracker(
        "ground", world.size, lens=world.lens, body_from_camera=world.body_from_camera, fps=world.fps
    )
    samples = world.telemetry(30.0)
    states = []
    for i in range(175):
        for sample in samples:
            if world.time(i) - 1.0 / world.fps < sample.time <= world.time(i):
                tracker.handle_telemetry(sample)
        if i == 0:
            tracker.begin(world.frame(0), 0.0, world.truth(0).box)
            continue
        states.append((world.truth(i).visible, tracker.handle_frame(world.frame(i), world.time(i)).state))
    back = [state for visible, state in states[85:] if visible > 0.9]
    assert len(back) > 30
    assert sum(state is TrackState.VISIBLE for state in back) > 0.85 * len(back)
