"""Targets that are lost and found again by their appearance: where they are looked for, and what is believed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edge.uav.adaptive_tracker import AdaptiveTracker
from edge.uav.base import Basis, Box, Estimate, TrackState
from edge.uav.correlation.appearance_tracker import AppearanceTracker
from edge.uav.correlation.belief import Belief
from edge.uav.correlation.candidate import Candidate, Kinematics
from edge.uav.correlation.colour import ColourModel
from edge.uav.correlation.filter import Response
from edge.uav.correlation.memory import TemplateMemory
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.correlation.redetection import Prediction, Redetection
from edge.uav.correlation.velocity import VelocityFilter
from edge.uav.image_motion.first_motion import FirstMotion
from edge.uav.image_motion.median_background import MedianBackground
from edge.uav.image_motion.residual import UNKNOWN, MovingParts, Residual
from edge.uav.image_motion.scene_motion import Motion, SceneMotion
from protocols.geometry.types import Image

SIZE = (320, 240)
FPS = 15.0
TARGET = np.array([30, 20])


@pytest.fixture(scope="module")
def scene() -> Image:
    """A textured scene (480, 900, 3)."""
    rng = np.random.default_rng(5)
    coarse = rng.uniform(60, 190, (24, 45, 3)).astype(np.float32)
    fine = cv2.GaussianBlur(rng.normal(0, 60, (480, 900, 3)).astype(np.float32), (0, 0), 1.5)
    return np.asarray(np.clip(cv2.resize(coarse, (900, 480), interpolation=cv2.INTER_CUBIC) + fine, 0, 255), np.uint8)


def painted(scene: Image, place: np.ndarray, opacity: float = 1.0) -> Image:
    """A window of the scene with a red and white target about ``place``."""
    image = np.ascontiguousarray(scene[100 : 100 + SIZE[1], 200 : 200 + SIZE[0]])
    shown = image.copy()
    low, high = np.rint(place - 0.5 * TARGET).astype(int), np.rint(place + 0.5 * TARGET).astype(int) - 1
    cv2.rectangle(shown, low.tolist(), high.tolist(), (30, 40, 220), -1)
    cv2.rectangle(shown, (low + 5).tolist(), (high - 9).tolist(), (240, 240, 240), -1)
    return np.asarray(cv2.addWeighted(shown, opacity, image, 1.0 - opacity, 0.0), np.uint8)


def test_what_the_target_was_lost_to_does_not_move_it(scene: Image) -> None:
    """Behind something that stands and looks a little like it, it must be predicted to go on at its own speed."""
    tracker = AppearanceTracker(SIZE, FPS)
    start, step = np.array([60.0, 120.0]), np.array([3.0, 0.0])
    box = Box(*(start - 0.5 * TARGET), *map(float, TARGET))
    tracker.begin(painted(scene, start), 0.0, box)
    for k in range(1, 18):
        tracker.handle_frame(painted(scene, start + k * step), k / FPS)
    for k in range(18, 34):
        found = tracker.handle_frame(painted(scene, start + 17 * step, 0.25 if k < 24 else 0.0), k / FPS)
    assert found.state is TrackState.COASTING
    assert abs(found.x - (start + 33 * step)[0]) < 12.0


def test_a_fast_turn_of_the_camera_is_measured(scene: Image) -> None:
    """A turn bends the image: few tracks agree with one similarity to a pixel, though it says where the scene went."""
    focal, angle = 260.0, np.deg2rad(14.0)
    camera = np.array([[focal, 0.0, 450.0], [0.0, focal, 240.0], [0.0, 0.0, 1.0]])
    c, s = np.cos(angle), np.sin(angle)
    turn = camera @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ np.linalg.inv(camera)
    later = np.asarray(cv2.warpPerspective(scene, turn, (900, 480)), np.uint8)
    motion = SceneMotion(SIZE)
    motion.update(np.ascontiguousarray(scene[120:360, 290:610]), None)
    found = motion.update(np.ascontiguousarray(later[120:360, 290:610]), None)
    assert found.trusted
    middle = np.array([159.5, 119.5])
    assert found.matrix @ [*middle, 1.0] - middle == pytest.approx([focal * np.tan(angle), 0.0], abs=10.0)


def prediction(x: float, seconds: float = 1.0, std: float = 10.0) -> Prediction:
    return Prediction(OrientedBox(x, 120.0, 30.0, 20.0), std, Kinematics(np.zeros(2), 5.0, 30.0), 10, seconds)


def redetection() -> Redetection:
    def localise(image: Image, box: OrientedBox) -> tuple[OrientedBox, Response]:
        return box, Response(0.0, 0.0, 0.0, 1.0)

    black = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    return Redetection(
        SIZE, TemplateMemory(), TemplateMemory(), localise, ColourModel(black, OrientedBox(120.0, 120.0, 30.0, 20.0))
    )


def test_a_target_beyond_the_border_is_not_ruled_out_by_what_the_image_shows() -> None:
    """A look-alike far off was taken for a car that was just about to come back into the picture."""
    outside, inside = redetection(), redetection()
    for _ in range(20):
        outside._find_nothing(prediction(-40.0))
        inside._find_nothing(prediction(160.0))
    assert outside._near > 0.95
    assert inside._near < 0.2
    outside._find_nothing(prediction(30.0))  # it comes in, and was not looked for there before
    assert outside._near > 0.6


def test_a_place_far_off_waits_until_the_prediction_was_in_view() -> None:
    """Another person was taken in the frame in which the target came back into the picture where it was expected."""
    search = redetection()
    search._find_nothing(prediction(-40.0))
    far, near = (Candidate(OrientedBox(x, 120.0, 30.0, 20.0), 0.0, prediction(60.0).motion) for x in (250.0, 62.0))
    assert search._unsearched(far, prediction(60.0)) > 0.9
    assert search._unsearched(near, prediction(60.0)) < 0.05
    for _ in range(20):
        search._find_nothing(prediction(60.0))
    assert search._unsearched(far, prediction(60.0)) < 0.2


def test_a_target_that_sets_off_while_away_is_likelier_near_than_anywhere() -> None:
    """Cars that wait at a light were searched for where they had stood only."""
    search = redetection()
    near, far = (search._log_prior(np.array([160.0 + d, 120.0]), prediction(160.0, 0.8, 4.0)) for d in (45.0, 150.0))
    assert near > far + 2.0


def test_what_moves_is_predicted_less_surely_than_what_stands() -> None:
    stds = []
    for speed in (0.0, 60.0):
        kept = VelocityFilter(20.0)
        kept.restart(np.array([speed, 0.0]), 0.5, 20.0)
        for _ in range(30):
            kept.predict(1.0 / FPS, 20.0)
        stds.append(kept.std)
    assert stds[1] > 1.8 * stds[0]


def test_a_place_out_of_the_filters_window_is_not_believed() -> None:
    """In a pan that could not be measured a box that stayed where it was had been reported visible."""
    near, far = Belief(), Belief()
    near.doubt(1.0)
    far.doubt(0.3)
    for belief in (near, far):
        belief.add(-1.6, 0.1)
    assert near.visible
    assert not far.visible


def test_a_place_that_the_ground_has_from_the_box_is_as_uncertain_as_the_box(scene: Image) -> None:
    """In an orbit the box of a car of 65 px came to lie 8 px beside its middle, 4.1 stds of the ground."""
    tracker = AdaptiveTracker(SIZE, fps=FPS)
    place = np.array([120.0, 120.0])
    tracker.begin(painted(scene, place), 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
    tracker._trust = 1.0
    ground = tracker._ground
    assert ground is not None
    visible = Estimate(1 / FPS, TrackState.VISIBLE, 118.0, 120.0, 30.0, 20.0, float("nan"), 0.1)
    ground.handle_frame = lambda image, time: replace(visible, time=time)  # type: ignore[method-assign]
    for k in range(1, 9):
        lighter = cv2.add(painted(scene, place), (k % 3, k % 3, k % 3, 0))  # else the image is a repeated one
        found = tracker.handle_frame(np.asarray(lighter, np.uint8), k / FPS)
    assert found.basis is Basis.PLANE
    assert found.x == pytest.approx(119.5, abs=1.0)
    assert found.std == pytest.approx(0.04 * 30.0, rel=0.1)


def test_where_the_ground_has_lost_the_target_the_appearance_answers(
    scene: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lost ground's prediction had been the answer for as long as the appearance was not certain."""
    monkeypatch.setattr(AppearanceTracker, "certain", property(lambda tracker: False))
    tracker = AdaptiveTracker(SIZE, fps=FPS)
    place = np.array([120.0, 120.0])
    tracker.begin(painted(scene, place), 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
    tracker._trust = 1.0
    ground = tracker._ground
    assert ground is not None
    lost = Estimate(1 / FPS, TrackState.COASTING, 160.0, 120.0, 30.0, 20.0, float("nan"), 5.0)
    ground.handle_frame = lambda image, time: replace(lost, time=time)  # type: ignore[method-assign]
    found = tracker.handle_frame(painted(scene, place), 1 / FPS)
    assert found.state is TrackState.VISIBLE
    assert found.basis in (Basis.STABILISED, Basis.IMAGE)
    assert abs(found.x - place[0]) < 3.0


def watched(
    scene: Image, step: float, follows: bool = True, off: float = 0.0
) -> tuple[MovingParts, Residual, np.ndarray]:
    """A second in which the camera travels 4 px a frame and the target ``step`` over the scene: what moves, and where.

    follows: whether the tracker's box stays on the target; else on the scene where it was at first. off: error of the
    scene's motion into the last image [px].
    """
    camera, start, side = np.array([4.0, 0.0]), np.array([120.0, 120.0]), 0.5 * TARGET
    motion = Motion(np.array([[1.0, 0.0, -4.0], [0.0, 1.0, 0.0]]), np.zeros((0, 2)), np.zeros((0, 2)), True, 1.0)

    def image(k: int) -> Image:
        shown = np.ascontiguousarray(scene[100 : 100 + SIZE[1], 200 + 4 * k : 200 + 4 * k + SIZE[0]])
        place = start + k * (np.array([step, 0.0]) - camera)
        low, high = np.rint(place - side).astype(int).tolist(), np.rint(place + side).astype(int).tolist()
        cv2.rectangle(shown, low, high, (30, 40, 220), -1)
        return shown

    box = OrientedBox(*start, *map(float, TARGET))
    parts = MovingParts(image(0), 0.0, box)
    for k in range(1, 15):
        origin = box.centre - camera
        parts.update(image(k), k / FPS, box, motion, box.centre, origin + [off * (k == 14), 0.0])
        box = box.at(origin + ([step, 0.0] if follows else [0.0, 0.0]))
        residual = parts.residual(k / FPS, box, 60.0)
        if follows:
            parts.confirm(residual, box.centre)
    return parts, residual, start + 14 * (np.array([step, 0.0]) - camera)


def test_what_moves_over_the_stabilised_scene_is_evidence_for_a_target_that_moves(scene: Image) -> None:
    _, residual, place = watched(scene, 3.0)
    assert residual.log_ratio(place) > 1.0
    assert residual.log_ratio(place + [0.0, 40.0]) < -1.0  # the scene beside it, though the camera travels
    assert min(np.hypot(*(peak - place)) for peak in residual.peaks(TARGET, 2)) < 15.0


def test_what_stands_does_not_move_where_the_scene_is_stabilised_a_pixel_wrong(scene: Image) -> None:
    """Bright lines on a calm road seemed to move with each error of the stabilisation."""
    calm = np.asarray(cv2.GaussianBlur(scene, (0, 0), 6.0), np.uint8)
    cv2.rectangle(calm, (360, 250), (364, 270), (255, 255, 255), -1)
    for off in (-1.0, 1.0):
        _, residual, place = watched(calm, 3.0, off=off)
        assert residual.log_ratio(place) > 1.0
        assert residual.log_ratio(np.array([106.0, 160.0])) < -1.0  # the line


def everywhere(ratio: float) -> Residual:
    """Of a target that moves: the same ratio in the whole image."""
    return Residual(np.full((SIZE[1], SIZE[0]), ratio, np.float32), 1.0, np.zeros(2), 0.9, 0.05)


def test_what_moves_is_evidence_while_it_looks_like_the_target(scene: Image, monkeypatch: pytest.MonkeyPatch) -> None:
    evidence = []
    monkeypatch.setattr(Belief, "add", lambda belief, log_ratio, dt: evidence.append(log_ratio))
    place = np.array([120.0, 120.0])
    for residual in (UNKNOWN, everywhere(20.0), everywhere(1.0)):
        monkeypatch.setattr(MovingParts, "residual", lambda *of, found=residual: found)
        tracker = AppearanceTracker(SIZE, FPS)
        tracker.begin(painted(scene, place), 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
        tracker.handle_frame(painted(scene, place), 1 / FPS)
    unknown, moves, stands = evidence
    assert 1.0 < moves - unknown < 3.5
    assert stands - unknown < -1.5


def test_a_place_that_another_tracker_found_is_as_probable_as_it_is_near(scene: Image) -> None:
    """At even odds wherever it was, a pier 250 px off became a boat that was out of the picture."""
    image, box = painted(scene, np.array([120.0, 120.0])), OrientedBox(120.0, 120.0, *map(float, TARGET))
    search = Redetection(
        SIZE,
        TemplateMemory(),
        TemplateMemory(),
        lambda image, box: (box, Response(0.0, 0.0, 0.0, 1.0)),
        ColourModel(image, box),
    )
    for x in (122.0, 300.0):
        search.propose(box.at(np.array([x, 120.0])), prediction(120.0))
    near, far = (candidate.prior for candidate in search._tested)
    assert near > 0.0 > far


def remembered(scene: Image) -> tuple[Image, OrientedBox, Redetection]:
    """An image of the target, its box, and a search that knows it by this view."""
    place = np.array([120.0, 120.0])
    image, box = painted(scene, place), OrientedBox(*place, *map(float, TARGET))
    memory, answer = TemplateMemory(), Response(0.0, 0.0, 0.0, 1.0)
    memory.add(image, box)
    return image, box, Redetection(SIZE, memory, memory, lambda image, box: (box, answer), ColourModel(image, box))


def test_a_place_that_moves_under_test_looks_like_others_that_move(scene: Image) -> None:
    image, box, search = remembered(scene)
    evidence = []
    for residual in (UNKNOWN, everywhere(20.0), everywhere(1.0)):
        search._moving = residual
        candidate = Candidate(box, 0.0, prediction(120.0).motion)
        search._test(image, candidate, prediction(120.0), 1.0 / FPS)
        evidence.append(candidate.evidence)
    unknown, moves, stands = evidence
    assert 0.3 < moves - unknown < 2.3
    assert stands - unknown < -1.0


def test_a_place_of_half_the_predicted_size_is_less_probable(scene: Image) -> None:
    """Under test a look-alike shrank from frame to frame: the foot of a tree, 7 px wide, became a boat of 14 px."""
    image, box, search = remembered(scene)
    evidence = []
    for factor in (1.0, 1.25, 2.0):
        expected = replace(prediction(120.0), box=box.sized(factor * box.sides))
        candidate = Candidate(box, 0.0, expected.motion, hits=1)
        search._test(image, candidate, expected, 1.0 / FPS)
        evidence.append(candidate.evidence)
    same, larger, twice = evidence
    assert 0.0 < same - larger < 0.5
    assert same - twice > 0.8


@pytest.mark.parametrize(("offset", "goes"), [(15.0, True), (60.0, False)])
def test_a_box_that_stands_goes_to_what_moves_no_further_than_it_can_have_slipped(
    scene: Image, monkeypatch: pytest.MonkeyPatch, offset: float, goes: bool
) -> None:
    """The box of a truck had gone 28 px to another one."""
    ratio = np.full((SIZE[1], SIZE[0]), 1.0, np.float32)
    ratio[120, round(120 + offset)] = 20.0
    residual = Residual(ratio, 1.0, np.zeros(2), 0.9, 0.05)
    monkeypatch.setattr(MovingParts, "residual", lambda *of: residual)
    answer = Response(0.0, 0.0, 0.2, 1.0)
    found = lambda of, image, box: (box, 0.7, 4.0 * (box.x > 125.0), answer)  # noqa: E731
    monkeypatch.setattr(AppearanceTracker, "_measured", found)
    tracker, place = AppearanceTracker(SIZE, FPS), np.array([120.0, 120.0])
    tracker.begin(painted(scene, place), 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
    tracker.handle_frame(painted(scene, place), 1 / FPS)
    assert tracker.box.x == pytest.approx(place[0] + offset * goes, abs=3.0)


@pytest.mark.parametrize(("ratio", "beside", "learns"), [(2.0, False, True), (2.0, True, False), (4.0, True, True)])
def test_a_box_that_stands_beside_something_that_moves_learns_from_clear_evidence_only(
    scene: Image, monkeypatch: pytest.MonkeyPatch, ratio: float, beside: bool, learns: bool
) -> None:
    """The filter of a truck had learnt the palms it had slipped off to, and claimed them while the truck was away."""
    moving = np.full((SIZE[1], SIZE[0]), 1.0, np.float32)
    moving[120, 160] = 20.0 if beside else 1.0
    residual, answer = Residual(moving, 1.0, np.zeros(2), 0.1, 0.05), Response(0.0, 0.0, 0.2, 1.0)
    monkeypatch.setattr(MovingParts, "residual", lambda *of: residual)
    monkeypatch.setattr(AppearanceTracker, "_measured", lambda of, image, box: (box, 0.7, ratio, answer))
    tracker, place = AppearanceTracker(SIZE, FPS), np.array([120.0, 120.0])
    tracker.begin(painted(scene, place), 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
    known = tracker._filter._filter
    for k in range(1, 4):
        assert tracker.handle_frame(painted(scene, place), k / FPS).state is TrackState.VISIBLE
    assert (tracker._filter._filter is not known) is learns


@pytest.mark.parametrize(("ratio", "learns"), [(2.0, True), (-40.0, False)])
def test_what_scores_the_target_is_learnt_from_frames_that_show_it(
    scene: Image, monkeypatch: pytest.MonkeyPatch, ratio: float, learns: bool
) -> None:
    answer = Response(0.0, 0.0, 0.2, 1.6)
    monkeypatch.setattr(AppearanceTracker, "_measured", lambda of, image, box: (box, 0.4, ratio, answer))
    tracker, place = AppearanceTracker(SIZE, FPS), np.array([120.0, 120.0])
    tracker.begin(painted(scene, place), 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
    first = tracker._memory.tracking_ratio(0.4), tracker._filter._on.mean
    tracker.handle_frame(painted(scene, place), 1 / FPS)
    assert (tracker._memory.tracking_ratio(0.4) > first[0] + 0.1) is learns
    assert (tracker._filter._on.mean < first[1] - 0.05) is learns


def test_for_a_target_that_stands_what_moves_is_no_evidence(scene: Image) -> None:
    _, residual, place = watched(scene, 0.0)
    assert residual.moves < 0.3
    assert abs(residual.log_ratio(place)) < 0.5
    assert residual.peaks(TARGET, 2) == []


def test_that_the_target_moves_is_learnt_where_it_was_at_first(scene: Image) -> None:
    """A box that slips off at once on to what stands would else teach that the target stands."""
    _, residual, _ = watched(scene, 5.0, follows=False)
    assert residual.moves > 0.6
    assert residual.log_ratio(np.array([120.0 - 56.0, 120.0])) < 0.0  # where the box is


def behind_a_tree(scene: Image, place: np.ndarray) -> Image:
    """The target about ``place`` with a green tree before it, that stands where half of the first box shows it."""
    image = painted(scene, place)
    cv2.circle(image, (82, 128), 14, (30, 90, 40), -1)
    cv2.circle(image, (88, 120), 9, (40, 120, 60), -1)
    return image


def test_the_first_motion_is_of_what_moves_also_where_a_tree_fills_half_of_the_box(scene: Image) -> None:
    start = np.array([70.0, 120.0])
    place = OrientedBox(*start, *map(float, TARGET))
    first = FirstMotion(behind_a_tree(scene, start), place)
    looks = []
    for k in range(1, 16):
        looks.append(first.look(behind_a_tree(scene, start - [2.0 * k, 0.0]), k / FPS, place))
    place, velocity = next(look for look in looks if look is not None)
    k = next(k for k, look in enumerate(looks, 1) if look is not None)
    assert np.hypot(*(place.centre - start + [2.0 * k, 0.0])) < 0.25 * TARGET[0]
    assert np.abs(velocity - [-30.0, 0.0]).max() < 0.35 * TARGET[0]


def test_of_what_stands_there_is_no_first_motion(scene: Image) -> None:
    place = OrientedBox(70.0, 120.0, *map(float, TARGET))
    first = FirstMotion(behind_a_tree(scene, place.centre), place)
    for k in range(1, 20):
        assert first.look(behind_a_tree(scene, place.centre), k / FPS, place) is None


def test_a_place_is_not_followed_where_the_motion_of_the_scene_is_lost() -> None:
    place = OrientedBox(70.0, 120.0, *map(float, TARGET))
    shift = np.array([[1.0, 0.0, 3.0], [0.0, 1.0, 0.0]])
    for known in (True, False):
        moved = Motion(shift, np.zeros((0, 2)), np.zeros((0, 2)), known, 1.0).followed(place, 100.0)
        assert moved == (place.at(np.array([73.0, 120.0])) if known else None)


def begun(image: Image, centre: np.ndarray) -> AppearanceTracker:
    tracker = AppearanceTracker(SIZE, FPS)
    tracker.begin(image, 0.0, Box(*(centre - 0.5 * TARGET), *map(float, TARGET)))
    return tracker


def test_a_box_that_stays_with_the_tree_before_it_goes_to_where_its_target_has_moved(
    scene: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = np.array([70.0, 120.0])
    tracker = begun(behind_a_tree(scene, start), start)
    gone = OrientedBox(*(start - [12.0, 0.0]), *map(float, TARGET))
    monkeypatch.setattr(tracker._first_motion, "look", lambda image, seconds, scene: (gone, np.array([-30.0, 0.0])))
    found = tracker.handle_frame(behind_a_tree(scene, gone.centre), 0.4)
    assert abs(found.x - gone.x) < 4.0
    assert tracker._motion_filter.velocity[0] < -20.0


def test_a_box_that_went_with_its_target_is_not_moved_to_a_place_that_it_passed(
    scene: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fast cars: a mark on the road, near where they were at first, was taken for them."""
    start = np.array([70.0, 120.0])
    tracker = begun(painted(scene, start), start)
    tracker.box = tracker.box.at(start + [24.0, 0.0])
    tracker.motion = Motion(np.eye(2, 3), np.zeros((0, 2)), np.zeros((0, 2)), True, 1.0)
    mark = tracker.box.at(start + [0.0, 12.0])
    monkeypatch.setattr(tracker._first_motion, "look", lambda image, seconds, scene: (mark, np.zeros(2)))
    tracker._follow_first_motion(painted(scene, tracker.box.centre))
    assert tracker.box.centre == pytest.approx(start + [24.0, 0.0])


@pytest.mark.parametrize(("speed", "tracked", "found"), [(0.5, 0.0, True), (0.5, 0.5, False), (0.0, 0.0, False)])
def test_a_box_on_the_ground_that_its_target_crept_out_of_goes_after_it(
    scene: Image, speed: float, tracked: float, found: bool
) -> None:
    """Something else passes; speeds of the target and of its box over the scene are in lengths a second."""
    start, step = np.array([160.0, 120.0]), np.array([TARGET[0] / FPS, 0.0])
    background = MedianBackground(painted(scene, start), OrientedBox(*start, *map(float, TARGET)))
    first, looks = OrientedBox(*start, *map(float, TARGET)), []
    for k in range(1, 31):
        image = painted(scene, start + speed * k * step)
        cv2.circle(image, (20 + 6 * k, 85), 8, (240, 60, 60), -1)
        box = first.at(start + tracked * k * step)
        if look := background.look(image, k / FPS, first, box):
            looks.append(np.append(look[0].centre - start - speed * k * step, look[1] - speed * FPS * step))
    assert bool(looks) == found
    assert np.abs(np.array(looks)).max(initial=0.0) < 0.25 * TARGET[0]


def test_what_a_target_that_crept_away_looks_like_is_learnt_anew(scene: Image, monkeypatch: pytest.MonkeyPatch) -> None:
    start = np.array([160.0, 120.0])
    tracker = AppearanceTracker(SIZE, FPS)
    tracker.begin(painted(scene, start + [60.0, 0.0]), 0.0, Box(*(start - 0.5 * TARGET), *map(float, TARGET)))
    gone = OrientedBox(*(start + [60.0, 0.0]), *map(float, TARGET))
    found = lambda image, seconds, scene, box: (gone, np.array([15.0, 0.0]))  # noqa: E731
    monkeypatch.setattr(tracker._median_background, "look", found)
    tracker.handle_frame(painted(scene, gone.centre), 1.2)
    still_like_the_first_view = tracker._memory.score(painted(scene, gone.centre), gone)
    tracker._memory._templates[0] = -tracker._memory._templates[0]
    tracker.handle_frame(painted(scene, gone.centre), 1.4)
    assert still_like_the_first_view < 0.6
    assert tracker.sees
    assert tracker._memory.score(painted(scene, gone.centre), gone) > 0.95


def test_while_the_target_is_beyond_the_border_a_place_needs_higher_odds() -> None:
    """Each search of an image that does not show it is another chance for what only looks like it."""
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    found = []
    for x, odds in ((160.0, 3.0), (-60.0, 4.5)):
        search, expected = redetection(), prediction(x)
        candidate = Candidate(OrientedBox(160.0, 120.0, 30.0, 20.0), 0.0, expected.motion, 5, odds, odds)
        search._tested = [candidate]
        search._test = lambda *of: True  # type: ignore[method-assign]
        search._search = lambda *of: None  # type: ignore[method-assign]
        found.append(search.look(image, expected, 1.0 / FPS))
    assert found[0] is not None
    assert found[1] is None


@pytest.mark.parametrize(("x", "gain"), [(160.0, 2.3), (-60.0, 0.0)])
def test_an_undecided_place_becomes_likelier_as_a_search_in_view_finds_nothing_else(x: float, gain: float) -> None:
    """A car that had braked was seen where nothing else was, for two seconds, and dropped after every eight frames."""
    image, search, expected = np.zeros((SIZE[1], SIZE[0], 3), np.uint8), redetection(), prediction(x)
    place = Candidate(OrientedBox(160.0, 120.0, 30.0, 20.0), -3.0, expected.motion, 9, 5.0, 5.0)
    search._tested = [place]
    search._test = lambda *of: True  # type: ignore[method-assign]
    search._search = lambda image, expected, dt: search._find_nothing(expected)  # type: ignore[method-assign]
    for _ in range(20):
        search.look(image, expected, 1.0 / FPS)
    assert search._tested == [place]
    assert place.prior == pytest.approx(-3.0 + gain, abs=0.3)


@pytest.mark.parametrize(("hits", "searched"), [(2, 4), (9, 8)])
def test_all_of_the_image_is_searched_beside_a_place_that_stays_undecided(hits: int, searched: int) -> None:
    image, search, count = np.zeros((SIZE[1], SIZE[0], 3), np.uint8), redetection(), [0]
    search._tested = [Candidate(OrientedBox(160.0, 120.0, 30.0, 20.0), -3.0, prediction(160.0).motion, hits, 5.0, 5.0)]
    search._test = lambda *of: True  # type: ignore[method-assign]

    def one(*of: object) -> None:
        count[0] += 1

    search._search = one  # type: ignore[method-assign]
    for frame in range(8):
        search.look(image, replace(prediction(160.0), frames=frame), 1.0 / FPS)
    assert count[0] == searched


def test_two_places_under_test_that_come_to_one_are_no_rivals() -> None:
    """Both had settled on the target: neither had a margin over the other for a second and a half."""
    search, expected = redetection(), prediction(160.0)
    search._tested = [
        Candidate(OrientedBox(x, 120.0, 30.0, 20.0), prior, expected.motion, 5, 6.0, 6.0)
        for x, prior in ((160.0, -0.2), (161.0, -0.5))
    ]
    search._test = lambda *of: True  # type: ignore[method-assign]
    search._search = lambda *of: None  # type: ignore[method-assign]
    assert search.look(np.zeros((SIZE[1], SIZE[0], 3), np.uint8), expected, 1.0 / FPS) is not None


@pytest.mark.parametrize("seconds", [0.6, 2.0])
def test_images_repeated_while_a_link_stalls_do_not_stop_the_target(scene: Image, seconds: float) -> None:
    """The view and the target, which stood in them, jumped after them, and it was looked for where it had stood.

    The repeated images differ by what an encoder changes in them. After a second, the target is not seen any more.
    """
    tracker, rng = AdaptiveTracker(SIZE, None, None, FPS), np.random.default_rng(3)

    def view(k: int) -> tuple[Image, np.ndarray]:
        place = np.array([60.0 + 1.5 * k, 110.0 + 0.5 * k])
        return painted(scene[:, 3 * k :], place), place

    image, place = view(0)
    tracker.begin(image, 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
    stalled = range(30, 30 + round(seconds * FPS))
    for k in range(1, 75):
        if k not in stalled:
            image, place = view(k)
        change = rng.choice([-1, 0, 1], image.shape, p=[0.05, 0.9, 0.05])
        coded = np.asarray(np.clip(image + change, 0, 255), np.uint8)
        found = tracker.handle_frame(coded, k / FPS)
        late = k in stalled and k > 29 + FPS + 1e-6
        assert found.state is (TrackState.COASTING if late else TrackState.VISIBLE), k
        assert np.hypot(found.x - place[0], found.y - place[1]) < 6.0, k


def flat(b: int, g: int, r: int) -> Image:
    return np.full((SIZE[1], SIZE[0], 3), (b, g, r), np.uint8)


def test_one_look_at_another_paint_does_not_make_it_the_targets_and_a_shadow_is_no_other_paint() -> None:
    box = OrientedBox(160.0, 120.0, *map(float, TARGET))
    model = ColourModel(flat(60, 120, 200), box)
    for _ in range(20):
        model.learn(flat(60, 120, 200), box)
    for _ in range(3):  # one passes before it
        model.learn(flat(200, 120, 60), box)
    assert model.log_ratio(flat(200, 120, 60), box) == -4.0
    assert model.log_ratio(flat(200, 120, 60), box, in_any_light=True) == -4.0
    assert model.log_ratio(flat(30, 60, 100), box) < 0.0 < model.log_ratio(flat(30, 60, 100), box, in_any_light=True)


def test_one_of_its_kind_that_passes_before_the_target_does_not_take_it_along(scene: Image) -> None:
    """Both are as large and alike but for their paint: the box went on with the one in front, as visible."""
    tracker = AppearanceTracker(SIZE, FPS)

    def shown(k: int) -> Image:
        image = painted(scene, np.array([100.0 + k, 120.0]))
        if k >= 12:
            low = np.rint(np.array([60.0 + 3.0 * (k - 12), 122.0]) - 0.5 * TARGET).astype(int)
            cv2.rectangle(image, low.tolist(), (low + TARGET - 1).tolist(), (40, 200, 60), -1)
            cv2.rectangle(image, (low + 5).tolist(), (low + TARGET - 10).tolist(), (240, 240, 240), -1)
        return image

    tracker.begin(shown(0), 0.0, Box(*(np.array([100.0, 120.0]) - 0.5 * TARGET), *map(float, TARGET)))
    for k in range(1, 70):
        found = tracker.handle_frame(shown(k), k / FPS)
        if found.state is TrackState.VISIBLE:
            assert abs(found.x - 100.0 - k) < 18.0, k
    assert found.state is TrackState.VISIBLE


def test_a_ground_that_begins_again_has_a_frame_of_its_own(scene: Image) -> None:
    """A correction of metres between two frames was kept where the second one had the first one's number."""
    place, tracker = np.array([160.0, 120.0]), AdaptiveTracker(SIZE)
    image = painted(scene, place)
    first = tracker.begin(image, 0.0, Box(*(place - 0.5 * TARGET), *map(float, TARGET)))
    before = tracker._on_ground(first).ground_frame
    tracker._restart_ground(image, 0.1, first)
    assert tracker._on_ground(first).ground_frame != before
