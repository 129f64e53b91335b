"""The ground-plane tracker as a whole, on small films of a flat street: states, exits, bad input, determinism."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge.uav.models import get
from edge.uav.tracker import Box, Estimate, State, Telemetry
from edge.uav.world import scenarios
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]
SIZE = (320, 240)
FPS = 30.0
CAR = (36, 16)


@pytest.fixture(scope="module")
def scenery() -> Picture:
    """A wide picture of grass with a street along it, seen from straight above."""
    rng = np.random.default_rng(7)
    noise = cv2.GaussianBlur(rng.uniform(-1, 1, (360, 1400, 3)).astype(np.float32), (0, 0), 2.0)
    out = np.array([60.0, 120.0, 80.0], np.float32) + 160.0 * noise
    out[150:210] = np.array([95.0, 95.0, 95.0], np.float32) + 60.0 * noise[150:210]
    for x in range(0, 1400, 40):
        out[178:182, x : x + 18] = 210.0
    return np.clip(out, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Film:
    """A window of the scenery that may move, and a car that drives along the street."""

    scenery: Picture
    window: npt.NDArray[np.int64]  # (n, 2) top left
    car: Floats  # (n, 2) centre in the scenery
    hidden: range = range(0)
    twin: Floats | None = None

    def frame(self, i: int) -> Picture:
        picture = self.scenery.copy()
        for centre in (self.car[i], *(() if self.twin is None else (self.twin[i],))):
            x, y = round(float(centre[0] - CAR[0] / 2)), round(float(centre[1] - CAR[1] / 2))
            picture[y : y + CAR[1], x : x + CAR[0]] = (40, 40, 210)
            picture[y + 2 : y + CAR[1] - 2, x + 22 : x + 27] = (40, 30, 30)
        if i in self.hidden:  # a tree's crown over the place
            cv2.circle(picture, (round(float(self.car[i][0])), round(float(self.car[i][1]))), 34, (30, 70, 35), -1)
        x, y = self.window[i]
        noise = np.random.default_rng(i).normal(0, 2, (SIZE[1], SIZE[0], 3))
        return np.clip(picture[y : y + SIZE[1], x : x + SIZE[0]] + noise, 0, 255).astype(np.uint8)

    def truth(self, i: int) -> Floats:
        return np.asarray(self.car[i] - self.window[i])

    def box(self) -> Box:
        x, y = self.truth(0)
        return Box(x - CAR[0] / 2, y - CAR[1] / 2, *CAR)


def film(scenery: Picture, frames: int, speed: float, window_speed: float, **more: object) -> Film:
    k = np.arange(frames)
    car = np.column_stack([120.0 + speed * k, np.full(frames, 196.0)])
    window = np.column_stack([40 + window_speed * k, np.full(frames, 70.0)]).astype(np.int64)
    return Film(scenery, window, car, **more)  # type: ignore[arg-type]


def follow(shown: Film, model: str = "ground", seed: int = 0, without: range = range(0)) -> list[Estimate]:
    tracker = get(model, SIZE, fps=FPS, seed=seed)
    out = [tracker.begin(shown.frame(0), 0.0, shown.box())]
    for i in range(1, len(shown.car)):
        out.append(tracker.handle_frame(None if i in without else shown.frame(i), i / FPS))
    return out


def errors(shown: Film, found: list[Estimate]) -> Floats:
    return np.array([float(np.hypot(*(np.array([e.x, e.y]) - shown.truth(i)))) for i, e in enumerate(found)])


def test_a_car_in_the_picture_is_followed_to_the_pixel(scenery: Picture) -> None:
    shown = film(scenery, 60, 4.0, 3.0)
    found = follow(shown)
    assert all(e.state is State.VISIBLE for e in found)
    assert errors(shown, found).max() < 4.0
    assert abs(found[-1].heading) < 0.1
    assert found[-1].width == pytest.approx(CAR[0], rel=0.2)
    assert np.isnan(found[-1].north)


def test_a_car_that_drives_out_is_coasting_and_found_again_when_the_picture_follows(scenery: Picture) -> None:
    shown = film(scenery, 100, 5.0, 0.0)
    late = np.where(np.arange(100) > 75, (np.arange(100) - 75) * 16, 0)
    shown = Film(scenery, shown.window + np.column_stack([late, 0 * late]), shown.car)
    found = follow(shown)
    share = np.array([(SIZE[0] - shown.truth(i)[0]) / CAR[0] + 0.5 for i in range(100)])
    out = share <= 0
    assert out.sum() > 20
    assert errors(shown, found)[out].max() < CAR[0]
    assert not any(found[i].state is State.VISIBLE for i in np.flatnonzero(out))
    assert all(found[i].x > SIZE[0] for i in np.flatnonzero(out)[5:-2])
    assert all(e.state is State.VISIBLE for e in found[-5:])
    assert errors(shown, found)[-5:].max() < 4.0
    grown = [found[i].std for i in np.flatnonzero(out)]
    assert grown[-1] > grown[0]


def test_under_a_tree_it_is_not_called_visible(scenery: Picture) -> None:
    shown = film(scenery, 70, 4.0, 3.0, hidden=range(35, 55))
    found = follow(shown)
    assert all(found[i].state is State.COASTING for i in range(37, 54))
    assert errors(shown, found)[35:55].max() < CAR[0]
    assert all(e.state is State.VISIBLE for e in found[-10:])


def test_an_oncoming_twin_is_not_taken_for_the_car_that_left(scenery: Picture) -> None:
    shown = film(scenery, 110, 4.0, 0.0)
    twin = np.column_stack([900.0 - 6.0 * np.arange(110), np.full(110, 165.0)])
    found = follow(Film(scenery, shown.window, shown.car, twin=twin))
    gone = [i for i in range(110) if shown.truth(i)[0] > SIZE[0] + CAR[0] / 2]
    assert not any(found[i].state is State.VISIBLE for i in gone)


def test_a_car_cut_in_half_by_the_border_at_first_is_known_when_it_is_whole(scenery: Picture) -> None:
    shown = film(scenery, 45, 4.0, 0.0)
    slide = np.maximum(120 - 40 - 12 * np.maximum(np.arange(45) - 5, 0), -60)
    shown = Film(scenery, np.column_stack([40 + slide + 4 * np.arange(45), shown.window[:, 1]]), shown.car)
    assert abs(shown.truth(0)[0]) < 0.1 * CAR[0]
    found = follow(shown)
    assert all(e.state is State.VISIBLE for e in found)
    assert errors(shown, found)[25:].max() < 5.0


def test_frames_that_cannot_be_decoded_are_coasting_and_cost_nothing(scenery: Picture) -> None:
    shown = film(scenery, 50, 4.0, 3.0)
    found = follow(shown, without=range(25, 31))
    assert all(found[i].state is not State.VISIBLE for i in range(25, 31))
    assert all(e.state is State.VISIBLE for e in found[34:])
    assert errors(shown, found).max() < 12.0


def test_the_same_seed_gives_the_same_answer(scenery: Picture) -> None:
    shown = film(scenery, 60, 5.5, 0.0)
    first, again = follow(shown, seed=3), follow(shown, seed=3)
    assert [(e.x, e.y, e.std, e.state) for e in first] == [(e.x, e.y, e.std, e.state) for e in again]


def test_it_is_lost_in_the_end_and_then_has_no_place(scenery: Picture) -> None:
    shown = film(scenery, 40, 4.0, 0.0)
    tracker = get("ground", SIZE, fps=FPS)
    tracker.begin(shown.frame(0), 0.0, shown.box())
    for i in range(1, 40):
        tracker.handle_frame(shown.frame(i), i / FPS)
    nothing = scenery[70:310, 40:360]
    last = [tracker.handle_frame(nothing, 40 / FPS + k / 5) for k in range(150)][-1]
    assert last.state is State.LOST
    assert np.isnan(last.x)
    assert np.isnan(last.y)


@pytest.mark.parametrize(
    "box",
    [Box(400, 50, 30, 20), Box(-40, 50, 30, 20), Box(50, 50, 2, 2), Box(0, 0, 320, 240), Box(float("nan"), 5, 20, 20)],
)
def test_a_box_that_cannot_be_a_target_is_refused_in_one_line(scenery: Picture, box: Box) -> None:
    with pytest.raises(InputError) as raised:
        get("ground", SIZE).begin(scenery[:240, :320], 0.0, box)
    assert "\n" not in str(raised.value)


def test_telemetry_makes_the_answer_metric(scenery: Picture) -> None:
    """A camera 30 m up whose pixels are 0.1 m wide, its top to the north, drifting east at 9 m/s."""
    lens = Intrinsics(320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]))
    camera_up_is_north = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shown = film(scenery, 60, 4.0, 3.0)
    tracker = get("ground", SIZE, lens, camera_up_is_north, FPS)
    for i in range(60):
        tracker.handle_telemetry(Telemetry(i / FPS, np.eye(3), np.array([0.0, 9.0 * i / FPS, -30.0])))
        last = (
            tracker.begin(shown.frame(0), 0.0, shown.box()) if i == 0 else tracker.handle_frame(shown.frame(i), i / FPS)
        )
    east = 9.0 * 59 / FPS + 0.1 * (shown.truth(59)[0] - 159.5)
    assert last.east == pytest.approx(east, abs=1.0)
    assert last.north == pytest.approx(-0.1 * (shown.truth(59)[1] - 119.5), abs=1.0)
    assert last.speed == pytest.approx(12.0, abs=1.0)
    assert last.course == pytest.approx(np.pi / 2, abs=0.1)


def test_telemetry_that_comes_later_turns_the_answer_metric_without_losing_the_car(scenery: Picture) -> None:
    lens = Intrinsics(320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]))
    shown = film(scenery, 60, 4.0, 3.0)
    tracker = get("ground", SIZE, lens, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), FPS)
    found = [tracker.begin(shown.frame(0), 0.0, shown.box())]
    for i in range(1, 60):
        if i > 30:
            tracker.handle_telemetry(Telemetry(i / FPS, np.eye(3), np.array([0.0, 9.0 * i / FPS, -30.0])))
        found.append(tracker.handle_frame(shown.frame(i), i / FPS))
    assert np.isnan(found[25].speed)
    assert found[-1].speed == pytest.approx(12.0, abs=1.2)
    assert errors(shown, found).max() < 5.0


def test_unknown_models_are_named() -> None:
    with pytest.raises(InputError, match="ground, paper, plain"):
        get("best", SIZE)


def test_a_car_that_went_where_nobody_thought_is_found_by_a_look_over_the_whole_picture(scenery: Picture) -> None:
    """Behind trees it left the street; it comes out 90 px beside it, beyond what is searched about the particles."""
    shown = film(scenery, 100, 3.0, 3.0, hidden=range(30, 60))
    away = shown.car.copy()
    away[45:, 1] -= 90.0
    estimates = follow(replace(shown, car=away))
    assert estimates[55].state is State.COASTING
    last = estimates[-1]
    assert last.state is State.VISIBLE
    assert np.hypot(*(np.array([last.x, last.y]) - (away[-1] - shown.window[-1]))) < 5.0


def test_a_car_that_comes_back_turned_is_known_at_once() -> None:
    """It took a bend out of view, and the cloud heads 15° beside it: its shape does not fit unless it is turned."""
    world = scenarios.get("exit-bend", 0, frames=45)
    tracker = get("ground", world.size, lens=world.lens, body_from_camera=world.body_from_camera, fps=world.fps)
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
    assert sum(state is State.VISIBLE for state in back) > 0.85 * len(back)
