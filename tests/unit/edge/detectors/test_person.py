"""The person and vehicle detectors and their parts, on rendered rooms and on synthetic images."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from deploy.cli import run
from edge import scenes
from edge.detectors.base import Detection, Prediction
from edge.detectors.moving.foreground import (
    BackgroundSubtractor,
    background_mode,
)
from edge.detectors.moving.shadows import ShadowDetector, is_ghost, remove_ghosts, uncovered_background
from edge.detectors.moving.tracklets import match_predictions
from edge.detectors.moving.vehicle import VehicleDetector
from edge.detectors.people.height_model import HeightModel
from edge.detectors.people.person import PersonDetector, clean_silhouettes, silhouette_features
from edge.detectors.people.segmentation import segment_people
from edge.detectors.people.silhouettes import IsolatedPeople
from edge.scenes import renderer_for
from protocols.geometry.types import Image
from tests.support.people_boxes import overlap, score_boxes
from tests.unit.edge.detectors.test_person_templates import flat_ground

HEIGHT, WIDTH = 240, 320


def street(seed: int = 0) -> Image:
    """A textured background."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(60, 190, (30, 40, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def wall() -> Image:
    """A smooth background without edges of its own."""
    return np.asarray(cv2.GaussianBlur(street(), (0, 0), 12.0), dtype=np.uint8)


def silhouettes(*people: tuple[float, float, float]) -> npt.NDArray[np.uint8]:
    """Mask (H, W) of people at (u, foot, height) [px]."""
    drawn = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for u, foot, tall in people:
        draw_person(drawn, u, foot, tall, (255, 255, 255))
    return np.where(drawn.any(axis=2), np.uint8(255), np.uint8(0)).astype(np.uint8)


def noisy(picture: Image, rng: np.random.Generator, gain: float = 1.0) -> Image:
    return np.clip(picture * gain + rng.normal(0.0, 2.0, picture.shape), 0, 255).astype(np.uint8)


def draw_person(
    picture: Image, u: float, foot: float, tall: float, colour: tuple[int, int, int] = (30, 30, 160)
) -> None:
    """Head, trunk and legs, as flat shapes."""
    cv2.circle(picture, (round(u), round(foot - 0.93 * tall)), max(round(0.07 * tall), 1), (120, 150, 200), -1)
    top, hip = round(foot - 0.86 * tall), round(foot - 0.45 * tall)
    cv2.rectangle(picture, (round(u - 0.12 * tall), top), (round(u + 0.12 * tall), hip), colour, -1)
    cv2.rectangle(picture, (round(u - 0.09 * tall), hip), (round(u + 0.09 * tall), round(foot)), (40, 30, 30), -1)


def walk(
    detector: PersonDetector, frames: int, *, start: int = 0, people: int = 1, gain: float = 1.0
) -> list[Detection]:
    """Render people of 50 px who cross the street, 60 px apart; the detections in the last frame."""
    rng = np.random.default_rng(1)
    found: list[Detection] = []
    for index in range(start, start + frames):
        picture = street()
        for who in range(people):
            draw_person(picture, 30.0 + 60.0 * who + 1.5 * index, 150.0, 50.0)
        found = detector.detect(noisy(picture, rng, gain), index / 10.0)
    return found


def initialised(detector: PersonDetector) -> PersonDetector:
    rng = np.random.default_rng(0)
    detector.initialise([noisy(street(), rng) for _ in range(12)])
    return detector


@pytest.mark.parametrize("model", ["mog2", "knn"])
def test_a_small_person_is_detected_with_head_foot_and_clothing_colour(model: str) -> None:
    found = walk(initialised(PersonDetector(model, 10.0)), 25)  # type: ignore[arg-type]
    assert len(found) == 1
    one = found[0]
    u = 30.0 + 1.5 * 24
    assert one.kind == "person"
    assert one.head is not None
    assert one.foot is not None
    assert one.head == pytest.approx((u, 100.0), abs=3.0)
    assert one.foot == pytest.approx((u, 150.0), abs=3.0)
    assert (one.u, one.v) == pytest.approx((u, 120.0), abs=9.0)
    assert one.size == pytest.approx(50.0, abs=4.0)
    assert one.colour is not None
    assert one.colour[0] > 120 > one.colour[2]


def test_no_person_is_detected_in_an_empty_street_under_changing_light() -> None:
    detector = initialised(PersonDetector("mog2", 10.0))
    rng = np.random.default_rng(2)
    for index in range(60):
        assert not detector.detect(noisy(street(), rng, 1.0 - 0.006 * index), index / 10.0)
    assert detector.resets == 0


def test_two_people_in_one_silhouette_are_segmented() -> None:
    height_model = flat_ground()
    mask = silhouettes((100.0, 150.0, 60.0), (114.0, 152.0, 60.0))
    shadow = np.zeros_like(mask)
    bodies = segment_people(mask, shadow, height_model, [])
    assert sorted(round(body.box[0] + 0.5 * body.box[2]) for body in bodies) == pytest.approx([100, 114], abs=4)
    alone = np.zeros_like(mask)
    alone[:, :107] = mask[:, :107]
    assert len(segment_people(alone, shadow, height_model, [])) == 1


def test_a_person_split_by_the_colour_of_the_wall_is_one() -> None:
    rng = np.random.default_rng(3)
    detector = initialised(PersonDetector("mog2", 10.0))
    found: list[Detection] = []
    for index in range(25):
        picture, behind = street(), street()
        draw_person(picture, 30.0 + 2.0 * index, 170.0, 80.0)
        picture[132:136] = behind[132:136]
        found = detector.detect(noisy(picture, rng), index / 10.0)
    assert len(found) == 1
    assert found[0].size == pytest.approx(80.0, abs=6.0)


def test_a_person_in_the_first_image_is_detected_within_seconds_and_leaves_no_ghost() -> None:
    detector = PersonDetector("mog2", 10.0)
    assert not walk(detector, 1)
    found = walk(detector, 59, start=1, people=2)
    assert len(found) == 2
    rng = np.random.default_rng(5)
    for index in range(60, 120):
        left = detector.detect(noisy(street(), rng), index / 10.0)
    assert not left


def test_a_person_who_stops_is_not_absorbed_into_the_background() -> None:
    detector = initialised(PersonDetector("mog2", 10.0))
    walk(detector, 30)
    rng = np.random.default_rng(6)
    picture = street()
    draw_person(picture, 75.0, 150.0, 50.0)
    for index in range(30, 330):
        found = detector.detect(noisy(picture, rng), index / 10.0)
    assert len(found) == 1


def test_a_camera_that_is_moved_resets_the_background_instead_of_reporting_the_whole_image() -> None:
    detector = initialised(PersonDetector("mog2", 10.0))
    walk(detector, 20)
    rng = np.random.default_rng(7)
    other = street(9)
    for index in range(20, 60):
        found = detector.detect(noisy(other, rng), index / 10.0)
        assert not any(one.size > 120 for one in found)
    assert detector.resets == 1
    assert not found


def test_a_shadow_is_not_part_of_a_body() -> None:
    rng = np.random.default_rng(8)
    model = BackgroundSubtractor("mog2", 10.0)
    model.initialise([noisy(street(), rng) for _ in range(12)])
    picture = street()
    picture[150:165, 100:180] = (picture[150:165, 100:180] * 0.65).astype(np.uint8)
    draw_person(picture, 100.0, 150.0, 60.0)
    masks = model.segment(noisy(picture, rng))
    cast = masks.foreground[153:163, 115:175]
    assert (cast > 0).mean() < 0.1
    assert (masks.shadow[153:163, 115:175] > 0).mean() > 0.7
    assert (masks.foreground[105:145, 95:105] > 0).mean() > 0.9


def test_silhouette_features_are_those_of_the_paper() -> None:
    """The distance transform of a disc has its maximum at the centre; head and foot are its ends."""
    foreground = np.zeros((100, 100), np.uint8)
    cv2.circle(foreground, (50, 40), 15, 255, -1)
    cv2.rectangle(foreground, (48, 40), (52, 80), 255, -1)
    features = silhouette_features(foreground, (35.0, 25.0, 31.0, 56.0))
    assert features.middle == pytest.approx((50.0, 40.0), abs=1.0)
    assert features.head == pytest.approx((50.0, 24.5), abs=1.0)
    assert features.foot == pytest.approx((50.0, 80.5), abs=1.0)


def test_each_prediction_is_matched_at_most_once_and_far_ones_are_gated() -> None:
    spread = (16.0, 0.0, 16.0)
    seen = [Detection(10.0, 10.0, covariance=spread), Detection(20.0, 10.0, covariance=spread), Detection(200.0, 9.0)]
    predictions = [
        Prediction(12.0, 10.0, spread, "a"),
        Prediction(21.0, 11.0, spread, "b"),
        Prediction(90.0, 90.0, spread, "c"),
    ]
    assert [one.target for one in match_predictions(seen, predictions)] == ["a", "b", ""]
    broken = [Prediction(float("nan"), 10.0, spread, "x"), Prediction(10.0, 10.0, (0.0, 0.0, 0.0), "y")]
    assert [one.target for one in match_predictions([Detection(10.0, 10.0)], broken)] == [""]
    far_too_small = [Prediction(10.0, 10.0, spread, "z", size=1.0)]
    assert match_predictions([Detection(10.0, 10.0, size=200.0)], far_too_small)[0].target == ""


def test_two_people_in_a_rendered_room_are_localised_five_seconds_after_the_start() -> None:
    """One pass from the first image on; the first five seconds, in which the background is learnt, do not count.

    Two people who are entirely visible most of the time; five occlude each other, and then it takes longer
    (edge/README.md).
    """
    scene = scenes.get_people_scene(11, None, 2)
    camera = scene.cameras[0]
    renderer = renderer_for(scene, camera.name, np.random.default_rng(0))
    detector = PersonDetector("mog2", camera.fps)
    right = wrong = missed = 0
    for index in range(130):
        moment = 5.0 + index / camera.fps
        found = detector.detect(renderer.render(moment), moment)
        if index < 50:
            continue
        boxes = [box for box in scene.boxes(camera.name, moment) if np.isfinite(box).all() and box[3] > 40]
        hits = sum(any(overlap(one.box, box) >= 0.5 for box in boxes) for one in found if one.box is not None)
        right, wrong, missed = right + hits, wrong + len(found) - hits, missed + max(len(boxes) - hits, 0)
    assert right / (right + wrong) > 0.9
    assert right / (right + missed) > 0.9


@pytest.mark.parametrize("shown", [1.0, 0.5])
def test_clothes_of_the_floors_colour_are_distinguished_from_shadows(shown: float) -> None:
    """Both are darker than the floor; only the shadow shows its texture, also where compression removed half of it."""
    rng = np.random.default_rng(3)
    floor = 130.0 + cv2.GaussianBlur(rng.normal(0.0, 60.0, (240, 320)), (0, 0), 1.5)
    coarse = floor.mean() + shown * (floor - floor.mean())

    def picture(grey: npt.NDArray[np.float64]) -> Image:
        noise = rng.normal(0.0, 3.0, (*grey.shape, 3))
        return np.clip(grey[..., None] + noise, 0, 255).astype(np.uint8)

    subtractor = BackgroundSubtractor("mog2", 10.0)
    subtractor.initialise([picture(floor) for _ in range(12)])
    now = floor.copy()
    now[60:180, 40:120] = 0.7 * coarse[60:180, 40:120]
    now[60:180, 200:280] = 0.7 * floor.mean()
    masks = subtractor.segment(picture(now))
    shadow, cloth = (slice(70, 170), slice(50, 110)), (slice(70, 170), slice(210, 270))
    assert (masks.shadow[shadow] > 0).mean() > 0.9
    assert (masks.foreground[cloth] > 0).mean() > 0.9


def draw_car(picture: Image, u: float, v: float) -> None:
    cv2.rectangle(picture, (round(u - 25), round(v - 12)), (round(u + 25), round(v + 12)), (200, 210, 215), -1)
    cv2.rectangle(picture, (round(u - 8), round(v - 9)), (round(u + 10), round(v + 9)), (60, 50, 40), -1)


def test_each_car_before_a_fixed_camera_has_one_label() -> None:
    rng = np.random.default_rng(10)
    detector = VehicleDetector("mog2", 10.0)
    detector.initialise([noisy(street(), rng) for _ in range(12)])
    labels: dict[str, int] = {}
    for index in range(110):
        picture = street()
        draw_car(picture, -30.0 + 5.0 * index, 80.0)
        draw_car(picture, 380.0 - 5.0 * (index - 30), 180.0)
        for one in detector.detect(noisy(picture, rng), index / 10.0):
            labels[one.label] = labels.get(one.label, 0) + 1
    assert len(labels) == 2
    assert min(labels.values()) > 40


@pytest.mark.parametrize("speed", [7.0, 3.0, 1.5])
def test_a_moving_camera_detects_a_car_and_not_the_ground(speed: float) -> None:
    rng = np.random.default_rng(11)
    coarse = rng.integers(40, 210, (90, 160, 3), dtype=np.uint8)
    ground = np.asarray(cv2.resize(coarse, (1280, 720), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    detector = VehicleDetector("mog2", 10.0)
    near = far = 0
    for index in range(60):
        whole = ground.copy()
        u, v = 200.0 + speed * index, 260.0
        draw_car(whole, u, v)
        left, top = 60 + 3 * index, 120 + index
        view = noisy(whole[top : top + HEIGHT, left : left + WIDTH], rng)
        for one in detector.detect(view, index / 10.0):
            if u + 30.0 - left > WIDTH:
                continue  # truncated by the border, its centre is elsewhere
            if np.hypot(one.u + left - u, one.v + top - v) < 20.0:
                near += 1
            else:
                far += 1
    assert detector.moving
    assert near >= 20
    assert far <= 0.1 * near


CARS = Path(__file__).parents[5] / "shared/data/street-cars/cars.mp4"


@pytest.mark.skipif(not CARS.is_file(), reason="no recording of a street here")
def test_the_four_cars_of_a_street_have_four_labels_and_road_markings_none(tmp_path: Path) -> None:
    out = tmp_path / "cars.csv"
    assert run(["detect", "vehicle", str(CARS), "--out", str(out), "--json"]) == 0
    with out.open() as lines:
        assert {row["label"] for row in csv.DictReader(lines)} == {"t0", "t1", "t2", "t3"}


def test_two_people_never_isolated_are_segmented_where_predictions_give_the_heights() -> None:
    """Two people cross the street as one silhouette; another person is tracked by other cameras."""

    def crossing(*, with_predictions: bool) -> int:
        detector, rng = initialised(PersonDetector("mog2", 10.0)), np.random.default_rng(1)
        found: list[Detection] = []
        for index in range(25):
            picture = street()
            for apart, colour in ((0.0, (30, 30, 160)), (17.0, (160, 60, 30))):
                draw_person(picture, 40.0 + apart + 1.5 * index, 170.0, 70.0, colour)
            expected = [Prediction(200.0, 130.0 - 26.0 + 2 * index, (4.0, 0.0, 4.0), "person-1", size=52.0 + index)]
            found = detector.detect(noisy(picture, rng), index / 10.0, expected if with_predictions else [])
        return len(found)

    assert crossing(with_predictions=False) < 2
    assert crossing(with_predictions=True) == 2


def test_a_ghost_and_its_person_are_distinguished_within_one_silhouette() -> None:
    """The person stood at the left when the background was learnt, and now half occludes that place."""
    rng = np.random.default_rng(12)
    before, now = wall(), wall()
    draw_person(before, 100.0, 200.0, 120.0)
    draw_person(now, 122.0, 200.0, 120.0)
    before, now = noisy(before, rng), noisy(now, rng)
    differ = np.where(cv2.absdiff(before, now).max(axis=2) > 25, np.uint8(255), np.uint8(0)).astype(np.uint8)
    foreground = np.asarray(cv2.morphologyEx(cv2.medianBlur(differ, 3), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    left = uncovered_background(now, before, foreground) > 0
    ghost, body = foreground.copy(), foreground.copy()
    ghost[:, 107:], body[:, :114] = 0, 0
    assert left[ghost > 0].mean() > 0.5
    assert left[body > 0].mean() < 0.1
    assert is_ghost(now, before, (80.0, 80.0, 26.0, 120.0), ghost)
    assert not is_ghost(now, before, (114.0, 80.0, 26.0, 120.0), body)


def test_a_person_who_leaves_the_initial_place_leaves_no_ghost() -> None:
    """A person stands for 3 s before a camera that was just switched on, then walks away."""
    detector, rng = PersonDetector("mog2", 10.0), np.random.default_rng(13)
    for index in range(100):
        gone = max(index - 30, 0)
        picture = wall()
        draw_person(picture, 120.0 + 2.0 * gone, 200.0 - 0.6 * gone, 110.0 - 0.5 * gone)
        found = detector.detect(noisy(picture, rng), index / 10.0)
        if index >= 55:
            assert len(found) == 1
            assert found[0].size == pytest.approx(110.0 - 0.5 * gone, rel=0.15)


def test_fragments_of_a_person_do_not_update_the_height_model() -> None:
    found = IsolatedPeople(silhouettes((100.0, 150.0, 90.0), (104.0, 176.0, 20.0), (220.0, 176.0, 80.0))).find()
    assert sorted(round(tall) for _, _, tall in found) == pytest.approx([80, 90], abs=2)
    height_model = HeightModel(WIDTH, HEIGHT)
    for index in range(30):
        height_model.add(20.0 + 4 * index, 100.0 + index, 12.0)
    for index in range(15):
        height_model.add(20.0 + 4 * index, 100.0 + 2 * index, 60.0 + index)
    assert height_model.heights_at(np.array([100.0]), np.array([110.0]))[0] == pytest.approx(65.0, abs=6.0)


def test_the_frame_rate_is_estimated_from_the_images_times() -> None:
    """Learning times are in seconds whatever the nominal rate: images come at 10 Hz, the nominal rate is 25 Hz."""
    model, rng = BackgroundSubtractor("mog2", 25.0), np.random.default_rng(4)
    initialising = [model.segment(noisy(street(), rng), (), 7.0 + index / 10.0).initialising for index in range(30)]
    assert initialising.index(False) == pytest.approx(8, abs=1)
    assert not any(initialising[12:])


@pytest.mark.parametrize("count", [1, 2, 3, 7, 24])
def test_the_background_mode_equals_its_definition(count: int) -> None:
    pictures = list(np.random.default_rng(count).integers(0, 256, (count, 20, 30, 3), dtype=np.uint8))
    ordered, share = np.sort(np.stack(pictures), axis=0), max(round(0.34 * count), 1)
    start = (ordered[share - 1 :] - ordered[: count - share + 1]).argmin(axis=0)
    assert np.array_equal(background_mode(pictures), np.take_along_axis(ordered, (start + share // 2)[None], axis=0)[0])


def test_removal_of_ghosts_equals_its_definition() -> None:
    rng = np.random.default_rng(3)
    now = rng.integers(0, 256, (61, 83, 3), dtype=np.uint8)
    then = np.clip(now.astype(int) + rng.integers(-24, 25, now.shape), 0, 255).astype(np.uint8)
    foreground, where = (255 * rng.integers(0, 2, (61, 83)).astype(np.uint8) for _ in range(2))
    expected = foreground.copy()
    expected[(np.abs(now.astype(int) - then).max(axis=2) < 22) & (where > 0)] = 0
    found = remove_ghosts(foreground, now, then, where)
    assert np.array_equal(found, expected)
    assert 0 < np.count_nonzero(expected) < np.count_nonzero(foreground)


def test_detections_are_evaluated_as_in_pedestrian_benchmarks() -> None:
    """One detected, one missed, one false; hidden people are ignored, whether detected or not."""
    boxes = np.array([[0, 0, 10, 30], [50, 0, 10, 30], [100, 0, 10, 30], [150, 0, 10, 30]], dtype=np.float64)
    counts = np.array([True, True, False, False])
    found = [np.array([1.0, 1, 10, 30]), np.array([100.0, 2, 10, 30]), np.array([200.0, 0, 10, 30])]
    assert score_boxes(boxes, counts, found)[:3] == (1, 1, 1)


def test_pixels_darker_than_the_learnt_shadows_are_no_shadow() -> None:
    """Grey trousers before a plain floor are darker than the learnt shadows; pixels as dark as these are shadow."""
    rng = np.random.default_rng(2)
    floor = np.full((240, 320), 140.0)
    floor[:, :200] += cv2.GaussianBlur(rng.normal(0.0, 60.0, (240, 200)), (0, 0), 1.5)

    def seen(light: float, left: int) -> tuple[Image, Image]:
        picture, foreground = floor.copy(), np.zeros((240, 320), np.uint8)
        picture[60:200, left : left + 80] *= light
        foreground[60:200, left : left + 80] = 255
        noise = rng.normal(0.0, 2.0, (240, 320, 3))
        return np.clip(picture[..., None] + noise, 0, 255).astype(np.uint8), foreground

    background, shadows = seen(1.0, 0)[0], ShadowDetector()

    def share(light: float, left: int) -> float:
        picture, foreground = seen(light, left)
        return float((shadows.detect(picture, background, foreground)[70:190, left + 10 : left + 70] > 0).mean())

    assert share(0.5, 230) > 0.9
    for index in range(6):
        assert share(0.7, 10 + 15 * index) > 0.8
    assert shadows.darkest == pytest.approx(0.67, abs=0.03)
    assert share(0.5, 230) < 0.1
    assert share(0.72, 230) > 0.9


def test_shadow_pixels_within_a_body_belong_to_it_and_those_beside_it_do_not() -> None:
    whole = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    draw_person(whole, 100.0, 200.0, 120.0, (255, 255, 255))
    foreground = np.where(whole.any(axis=2), np.uint8(255), np.uint8(0)).astype(np.uint8)
    shadow = np.zeros_like(foreground)
    shadow[110:140, 95:105] = foreground[110:140, 95:105]
    foreground[110:140, 95:105] = 0
    shadow[185:200, 115:180] = 255
    joined = clean_silhouettes(foreground, shadow, 120.0)
    assert (joined[112:138, 95:105] > 0).all()
    assert not (joined[185:200, 120:180] > 0).any()
    assert not (clean_silhouettes(foreground, np.zeros_like(foreground), 120.0)[122:128, 98:102] > 0).any()


def projected_height(
    v: npt.ArrayLike, tilt: float = 0.35, focal: float = 420.0, ratio: float = 0.7
) -> npt.NDArray[np.float64]:
    """Heights [px] of people with feet in rows v at the centre column of a 640 x 480 image, from the pinhole model's
    angles.
    """
    below = np.arctan((np.asarray(v, dtype=np.float64) - 240.0) / focal) + tilt
    head = np.arctan((1.0 - ratio) * np.tan(below))
    return np.asarray(focal * (np.tan(below - tilt) - np.tan(head - tilt)), dtype=np.float64)


def test_heights_are_extrapolated_to_other_places() -> None:
    rng = np.random.default_rng(0)
    height_model = HeightModel(640, 480)
    for v in rng.uniform(280.0, 380.0, 60):
        height_model.add(rng.uniform(250.0, 390.0), v, float(projected_height(v)) * rng.normal(1.0, 0.02))
    v = np.array([230.0, 250.0, 300.0, 350.0, 420.0])
    assert height_model.heights_at(np.full(5, 320.0), v) == pytest.approx(projected_height(v), rel=0.1)


def test_named_people_reduce_the_bias_of_their_own_heights() -> None:
    """A tall person walks in the near half, a short one in the far half: with names they bias the model less."""

    def bias(*, named: bool) -> float:
        rng, height_model = np.random.default_rng(1), HeightModel(640, 480)
        for low, high, factor, who in ((330.0, 440.0, 1.12, "p0"), (240.0, 350.0, 0.88, "p1")):
            for v in rng.uniform(low, high, 60):
                height_model.add(
                    320.0, v, factor * float(projected_height(v)) * rng.normal(1.0, 0.02), who if named else ""
                )
        v = np.array([240.0, 440.0])
        far, near = np.log(height_model.heights_at(np.full(2, 320.0), v) / projected_height(v))
        return float(near - far)

    assert bias(named=True) < 0.6 * bias(named=False)


def test_tentative_heights_count_until_there_are_enough_observations() -> None:
    rng, height_model = np.random.default_rng(2), HeightModel(640, 480)
    for index, v in enumerate(rng.uniform(280.0, 420.0, 40)):
        assert height_model.is_fitted == (index >= 16)
        height_model.add_tentative(320.0, v, 0.9 * float(projected_height(v)))
    v = np.array([300.0, 400.0])
    assert height_model.heights_at(np.full(2, 320.0), v) == pytest.approx(0.9 * projected_height(v), rel=0.04)
    for v in rng.uniform(280.0, 420.0, 48):
        height_model.add(320.0, v, float(projected_height(v)))
    v = np.array([300.0, 400.0])
    assert height_model.heights_at(np.full(2, 320.0), v) == pytest.approx(projected_height(v), rel=0.01)


def test_a_short_person_beside_a_tall_one_has_a_short_box() -> None:
    """Both are one silhouette; neither is predicted, or both are, with heights measured when they were isolated."""
    height_model = flat_ground()
    foreground = silhouettes((100.0, 150.0, 66.0), (116.0, 150.0, 48.0))
    nothing = np.zeros_like(foreground)
    usual = float(height_model.heights_at(np.array([108.0]), np.array([150.0]))[0])
    expected = [(89.0, 85.0, 22.0, 60.0), (105.0, 85.0, 22.0, 60.0)]
    for bodies in (
        segment_people(foreground, nothing, height_model, []),
        segment_people(foreground, nothing, height_model, expected, relative_heights=[66.0 / usual, 48.0 / usual]),
    ):
        tall, short = (body.box[3] for body in sorted(bodies, key=lambda body: body.box[0]))
        assert tall == pytest.approx(66.0, abs=4.0)
        assert short == pytest.approx(48.0, abs=3.0)


def test_the_vehicle_detectors_background_is_learnt_by_the_images_times() -> None:
    """Images come at 5 Hz, the nominal rate is 25 Hz: cars are reported after the first second, that is 5 images."""
    rng, detector = np.random.default_rng(5), VehicleDetector("mog2", 25.0, moving=False)
    first = None
    for index in range(40):
        picture = street()
        if index >= 3:
            draw_car(picture, 20.0 + 6.0 * index, 120.0)
        if detector.detect(noisy(picture, rng), index / 5.0) and first is None:
            first = index
    assert first is not None
    assert first < 20
