"""What decides whether a target is visible, where it can be, and whether a place found shows it again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.uav import adaptive_tracker
from edge.uav.base import Box, TrackState
from edge.uav.correlation import redetection
from edge.uav.correlation.appearance_tracker import AppearanceTracker
from edge.uav.correlation.belief import Belief
from edge.uav.correlation.candidate import Candidate, Kinematics
from edge.uav.correlation.colour import ColourModel
from edge.uav.correlation.filter import CorrelationFilter, Response
from edge.uav.correlation.memory import TemplateMemory
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.correlation.template import Whitening
from edge.uav.correlation.velocity import VelocityFilter
from tests.bench import uav_any_view, uav_rivals
from tests.support.oblique.world import ObliqueWorld
from tests.unit.edge.uav.test_any_view import FPS, SIZE, TARGET, paint, scene

__all__ = ["scene"]


def test_the_predicted_place_is_as_uncertain_as_it_says() -> None:
    """Targets whose acceleration is white noise: their true distance from the prediction has the stated std."""
    rng = np.random.default_rng(3)
    length, dt, squared = 30.0, 0.1, []
    for _ in range(300):
        place, velocity = np.zeros(2), rng.normal(0.0, 1.5 * length, 2)
        kalman, measured = VelocityFilter(length), np.zeros(2)
        for k in range(40):
            power = 0.1 * length**2 + 0.1 * np.square(velocity).sum()  # what moves turns and brakes more
            velocity = velocity + rng.normal(0.0, np.sqrt(power * dt), 2)
            place = place + velocity * dt
            predicted = measured + kalman.predict(dt, length)
            if k < 25:
                seen = place + rng.normal(0.0, 0.03 * length + 0.3, 2)
                kalman.correct(seen - predicted, length, 0.0)
                predicted = seen
            measured = predicted
        squared.append(float(np.square(measured - place).mean()) / kalman.std**2)
    assert 0.8 < np.mean(squared) < 1.2


def test_a_box_that_the_border_cuts_hardly_changes_the_velocity() -> None:
    change = {}
    for cut in (0.0, 0.4):
        kalman = VelocityFilter(40.0)
        for _ in range(10):
            kalman.predict(0.1, 40.0)
            kalman.correct(np.zeros(2), 40.0, 0.0)
        kalman.predict(0.1, 40.0)
        kalman.correct(np.array([8.0, 0.0]), 40.0, cut)
        change[cut] = float(np.abs(kalman.velocity).max())
    assert change[0.4] < 0.1 * change[0.0]


def test_a_scene_that_was_not_seen_to_move_widens_where_the_target_can_be() -> None:
    kalman = VelocityFilter(40.0)
    kalman.lose_scene(64.0)
    assert kalman.std > 64.0


def test_belief_is_lost_at_once_to_a_clear_frame_and_slowly_to_weak_ones() -> None:
    clear, weak = Belief(), Belief()
    clear.add(-8.0, 0.1)
    assert not clear.visible
    clear.add(6.0, 0.1)
    assert clear.visible  # one frame is not the end of it
    weak.add(-1.5, 0.1)
    assert weak.visible
    for _ in range(14):
        weak.add(-1.5, 0.1)
    assert not weak.visible
    assert weak.gone


def test_belief_does_not_depend_on_the_frame_rate() -> None:
    ends = []
    for fps in (10.0, 60.0):
        belief = Belief(0.0)
        for _ in range(round(fps)):
            belief.add(0.6, 1.0 / fps)
        ends.append(belief.log_odds)
    assert ends[0] == pytest.approx(ends[1], abs=0.2)


def test_a_look_alike_that_stands_is_not_what_drove_away_yet_may_have_stopped() -> None:
    expected = Kinematics(np.array([60.0, 0.0]), 15.0, 30.0)
    moving = expected.log_ratio(np.array([58.0, 3.0]), 4.0)
    turned = expected.log_ratio(np.array([0.0, 55.0]), 4.0)
    standing = expected.log_ratio(np.zeros(2), 4.0)
    assert moving > 1.0
    assert turned < 0.0
    assert -2.0 < standing < -1.0


def test_a_further_cue_cannot_make_a_look_alike_surer_than_look_alikes_are_rare() -> None:
    memory = TemplateMemory()
    assert memory.log_ratio(0.95, other=30.0) < memory.log_ratio(0.95, other=6.0) + 0.1
    assert memory.log_ratio(0.95, other=-1.6) < memory.log_ratio(0.95) - 0.5


def test_the_filter_of_the_past_speaks_against_what_it_never_saw(scene: np.ndarray) -> None:
    image = scene.copy()
    paint(image, 400, 300)
    box = OrientedBox(400.0, 300.0, *map(float, TARGET))
    correlation = CorrelationFilter(box.width, box.height)
    for _ in range(4):
        correlation.learn(image, box)
    other = box.at(np.array([700.0, 420.0]))
    for _ in range(40):
        correlation.learn(image, other, lasting=False)  # it has slipped on to the background, and learns that
    assert correlation.respond(image, other).log_ratio < 0.0
    assert correlation.respond(image, box).log_ratio > 1.0
    assert Response(0.0, 0.0, 0.2, 9.0).log_ratio <= 3.0


def test_a_template_is_kept_only_where_the_first_view_still_agrees(scene: np.ndarray) -> None:
    image = scene.copy()
    paint(image, 400, 300)
    box = OrientedBox(400.0, 300.0, *map(float, TARGET))
    memory = TemplateMemory()
    memory.add(image, box)
    background = box.at(np.array([700.0, 420.0]))
    memory.observe_rival(memory.score(image, background))
    before = memory.score(image, background)
    memory.add(image, background)
    assert memory.score(image, background) == pytest.approx(before)


def test_a_target_that_never_looks_the_same_is_not_doubted_for_it() -> None:
    """A person who walks scores no more than what is beside, from the first frames on."""
    memory, sure = TemplateMemory(), 0.9
    for score in (0.45, 0.5, 0.4):
        memory.observe_rival(score)
    assert memory.tracking_ratio(0.45) < -1.5
    memory.confirm(0.45, 1e-3)  # this was hardly the target
    assert memory.tracking_ratio(0.45) < -1.5
    for _ in range(6):
        memory.confirm(0.45, sure)
    assert memory.tracking_ratio(0.45) > -1.0
    weak = Response(0.0, 0.0, 0.2, 1.6)
    correlation = CorrelationFilter(8.0, 24.0)
    image = np.random.default_rng(1).integers(0, 256, (60, 60, 3), np.uint8)
    correlation.learn(image, OrientedBox(30.0, 30.0, 8.0, 24.0))
    for _ in range(6):
        correlation.confirm(weak, sure)
    on = correlation.respond(image, OrientedBox(30.0, 30.0, 8.0, 24.0)).on
    assert weak.log_ratio < -0.3
    assert Response(0.0, 0.0, 0.2, 1.6, on).log_ratio > 0.0


def test_what_is_less_like_the_target_than_its_rivals_is_not_one_of_them() -> None:
    memory = TemplateMemory()
    for _ in range(20):
        memory.observe_rival(0.85)
    assert memory.tracking_ratio(0.5) > memory.tracking_ratio(0.85)
    assert memory.tracking_ratio(0.1) < -1.0, "nor is it the target: background scores that"


def track(images: list[np.ndarray], x: float, y: float) -> list[TrackState]:
    tracker = AppearanceTracker(SIZE, FPS)
    box = Box(x - TARGET[0] / 2, y - TARGET[1] / 2, float(TARGET[0]), float(TARGET[1]))
    states = [tracker.begin(images[0], 0.0, box).state]
    return states + [tracker.handle_frame(image, k / FPS).state for k, image in enumerate(images[1:], 1)]


def test_a_target_that_vanishes_in_view_is_not_reported(scene: np.ndarray) -> None:
    """It sinks slowly behind its own background, so that no frame differs much from the last one."""
    images = []
    for k in range(70):
        world = scene.copy()
        paint(world, 310, 320)
        hidden = float(np.clip((k - 20) / 15, 0.0, 1.0))
        image = cv2.addWeighted(world, 1.0 - hidden, scene, hidden, 0.0)[200:440, 150:470]
        noise = np.random.default_rng(k).integers(0, 6, (SIZE[1], SIZE[0], 3), np.uint8)
        images.append(cv2.add(np.ascontiguousarray(image), noise))
    states = track(images, 160.0, 120.0)
    assert all(state is TrackState.VISIBLE for state in states[:24])
    assert not any(state is TrackState.VISIBLE for state in states[38:])


def test_of_two_places_that_look_alike_none_is_claimed(scene: np.ndarray) -> None:
    """A standing target is covered; then two like it stand at the same distance from where it was."""
    images = []
    for k in range(60):
        world = scene.copy()
        if k < 20:
            paint(world, 310, 320)
        if k >= 32:
            for side in (-1, 1):
                paint(world, 310 + 60 * side, 320)
        noise = np.random.default_rng(k).integers(0, 6, (SIZE[1], SIZE[0], 3), np.uint8)
        images.append(cv2.add(np.ascontiguousarray(world[200:440, 150:470]), noise))
    states = track(images, 160.0, 120.0)
    assert states[15] is TrackState.VISIBLE
    assert not any(state is TrackState.VISIBLE for state in states[24:])


def test_a_place_found_elsewhere_is_compared_with_the_predicted_one(
    scene: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[tuple[float, float]] = []

    def search(image: np.ndarray, memory: TemplateMemory, box: OrientedBox, reach: np.ndarray) -> list[object]:
        searched.append((float(box.centre[0]), float(box.centre[1])))
        return []

    monkeypatch.setattr(redetection, "search", search)
    monkeypatch.setattr(redetection.Redetection, "_test", lambda *_: True)
    box, answer = OrientedBox(400.0, 300.0, *map(float, TARGET)), Response(0.0, 0.0, 0.2, 1.0)
    colour = ColourModel(scene, box)
    away = redetection.Redetection(SIZE, TemplateMemory(), TemplateMemory(), lambda image, box: (box, answer), colour)
    still = Kinematics(np.zeros(2), 1.0, float(TARGET[0]))
    promising = Candidate(box.at(np.array([100.0, 100.0])), 4.0, still, hits=1)
    away._tested = [promising]
    for frames in (10, 11):
        away.look(scene, redetection.Prediction(box, 20.0, still, frames, frames / FPS), 1.0 / FPS)
    assert (400.0, 300.0) in searched


def test_a_distant_car_is_small() -> None:
    near = ObliqueWorld("car", "follow", seed=1, frames=3).truth(0).box.width
    far = ObliqueWorld("car", "follow", seed=1, frames=3, range_factor=5.0).truth(0).box.width
    assert far == pytest.approx(near / 5.0, rel=0.25)
    assert far < 25.0


def test_success_is_the_area_under_the_overlaps_that_are_exceeded() -> None:
    sequence = uav_any_view.flight("boat", "follow", 2, 10.0, 0.0, frames=3)
    whole = uav_any_view.run(sequence, "ground")
    assert abs(whole.success - whole.overlap) < 0.05


def test_rivals_are_started_again_only_where_they_can_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[object] = []
    monkeypatch.setattr(uav_rivals.os, "execve", lambda *words: started.append(words))
    monkeypatch.setattr(uav_rivals, "available", lambda name: False)
    monkeypatch.setattr(uav_rivals, "CONTRIB", uav_rivals.CONTRIB / "absent")
    uav_rivals.restart_with_contrib("tests.bench.uav_any_view", ["ground", "csrt"])
    assert not started


def test_a_box_that_is_hardly_in_the_image_is_not_learnt_as_the_whole_target() -> None:
    tracker = adaptive_tracker.AdaptiveTracker(SIZE, fps=FPS)
    assert tracker._is_complete(Box(-2.0, 50.0, 40.0, 30.0))
    assert not tracker._is_complete(Box(-8.0, 50.0, 40.0, 30.0))


def test_colour_tells_things_of_one_shape_apart_at_any_angle() -> None:
    image = np.full((120, 200, 3), (70, 110, 120), np.uint8)
    for x, colour in ((40, (130, 40, 130)), (100, (40, 130, 110)), (160, (130, 40, 130))):
        cv2.rectangle(image, (x - 12, 54), (x + 12, 66), colour, -1)
    own, other, like = (OrientedBox(x, 60.0, 25.0, 13.0) for x in (40.0, 100.0, 160.0))
    model = ColourModel(image, own)
    model.observe(image, [OrientedBox(x, 20.0, 25.0, 13.0) for x in (40.0, 100.0, 160.0)])
    assert model.log_ratio(image, like) > 1.0
    assert model.log_ratio(image, like.turned(0.4)) > 1.0
    assert model.log_ratio(image, other) < -3.0
    model.learn(image, own)
    assert model.log_ratio(image, own) > 1.0


def test_whitened_places_have_less_in_common_and_the_target_stays_itself() -> None:
    """What every place of a scene shows, here stripes, made places look alike that are not the target."""
    rng = np.random.default_rng(4)
    stripes = np.where(np.arange(SIZE[0]) % 24 < 12, 60.0, 180.0)[None, :, None]
    image = np.clip(stripes + rng.normal(0.0, 20.0, (SIZE[1], SIZE[0], 3)), 0, 255).astype(np.uint8)
    box = OrientedBox(300.0, 200.0, 48.0, 48.0)
    cv2.circle(image, (300, 200), 18, (40, 200, 240), -1)
    places = [box.at(np.array([float(x), float(y)])) for x in (60, 156, 540) for y in (60, 320, 420)]
    again = np.clip(image.astype(float) + rng.normal(0.0, 10.0, image.shape), 0, 255).astype(np.uint8)
    means = []
    for memory in (TemplateMemory(), TemplateMemory(Whitening(image, box))):
        memory.add(image, box)
        assert memory.score(again, box) > 0.7
        means.append(float(np.abs(memory.scores(again, places)).max()))
    assert means[1] < 0.8 * means[0]


@pytest.mark.parametrize("sides", [(600.0, 440.0), (300.0, 300.0), (4.0, 4.0)])
@pytest.mark.parametrize("noise", [0.0, 30.0])
def test_a_target_of_any_size_before_any_scene_is_itself_when_whitened(
    sides: tuple[float, float], noise: float
) -> None:
    """Beside one that fills the image there is no place, and a plain scene has no covariance."""
    rng = np.random.default_rng(6)
    image = np.clip(rng.normal(120.0, noise, (SIZE[1], SIZE[0], 3)), 0, 255).astype(np.uint8)
    box = OrientedBox(0.5 * SIZE[0], 0.5 * SIZE[1], *sides)
    cv2.ellipse(
        image, (SIZE[0] // 2, SIZE[1] // 2), (int(sides[0] / 3), int(sides[1] / 4)), 0, 0, 360, (30, 60, 220), -1
    )
    memory = TemplateMemory(Whitening(image, box))
    memory.add(image, box)
    assert memory.score(image, box) == pytest.approx(1.0, abs=1e-3)
