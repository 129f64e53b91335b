"""The person detector on rendered rooms and on pictures made for one question each."""

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
from edge.detectors.moving.foreground import Foreground, is_ghost, places_left, usual, without_like
from edge.detectors.moving.gating import match_predictions
from edge.detectors.moving.shadows import Shadows
from edge.detectors.moving.vehicle import VehicleDetector
from edge.detectors.people.height_model import Stature
from edge.detectors.people.person import PersonDetector, clean, silhouette_features
from edge.detectors.people.segmentation import explain
from edge.detectors.people.silhouettes import LonePeople
from tests.people_boxes import judge

Image = npt.NDArray[np.uint8]
HEIGHT, WIDTH = 240, 320


def street(seed: int = 0) -> Image:
    """A textured background."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(60, 190, (30, 40, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def wall() -> Image:
    """A background without edges of its own."""
    return np.asarray(cv2.GaussianBlur(street(), (0, 0), 12.0), dtype=np.uint8)


def noisy(picture: Image, rng: np.random.Generator, gain: float = 1.0) -> Image:
    return np.clip(picture * gain + rng.normal(0.0, 2.0, picture.shape), 0, 255).astype(np.uint8)


def put_person(
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
    """Let people of 50 px cross the street, 60 px apart; what is seen in the last frame."""
    rng = np.random.default_rng(1)
    found: list[Detection] = []
    for index in range(start, start + frames):
        picture = street()
        for who in range(people):
            put_person(picture, 30.0 + 60.0 * who + 1.5 * index, 150.0, 50.0)
        found = detector.detect(noisy(picture, rng, gain), index / 10.0)
    return found


def learnt(detector: PersonDetector) -> PersonDetector:
    rng = np.random.default_rng(0)
    detector.prime([noisy(street(), rng) for _ in range(12)])
    return detector


@pytest.mark.parametrize("model", ["mog2", "knn"])
def test_a_small_walker_is_found_with_head_foot_and_clothes(model: str) -> None:
    found = walk(learnt(PersonDetector(model, 10.0)), 25)  # type: ignore[arg-type]
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


def test_nobody_is_reported_in_an_empty_street_under_changing_light() -> None:
    detector = learnt(PersonDetector("mog2", 10.0))
    rng = np.random.default_rng(2)
    for index in range(60):
        assert not detector.detect(noisy(street(), rng, 1.0 - 0.006 * index), index / 10.0)
    assert detector.jolts == 0


def test_two_in_one_silhouette_are_two() -> None:
    stature = Stature(WIDTH, HEIGHT)
    for index in range(60):
        stature.learn(20.0 + 4 * index, 100.0 + index, 60.0)
    figure = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    put_person(figure, 100.0, 150.0, 60.0, (255, 255, 255))
    put_person(figure, 114.0, 152.0, 60.0, (255, 255, 255))
    mask = np.where(figure.any(axis=2), np.uint8(255), np.uint8(0)).astype(np.uint8)
    shadow = np.zeros_like(mask)
    bodies = explain(mask, shadow, stature, [])
    assert sorted(round(body.box[0] + 0.5 * body.box[2]) for body in bodies) == pytest.approx([100, 114], abs=4)
    alone = np.zeros_like(mask)
    alone[:, :107] = mask[:, :107]
    assert len(explain(alone, shadow, stature, [])) == 1


def test_somebody_cut_in_two_by_the_colour_of_the_wall_is_one() -> None:
    rng = np.random.default_rng(3)
    detector = learnt(PersonDetector("mog2", 10.0))
    found: list[Detection] = []
    for index in range(25):
        picture, behind = street(), street()
        put_person(picture, 30.0 + 2.0 * index, 170.0, 80.0)
        picture[132:136] = behind[132:136]
        found = detector.detect(noisy(picture, rng), index / 10.0)
    assert len(found) == 1
    assert found[0].size == pytest.approx(80.0, abs=6.0)


def test_who_is_there_when_the_camera_starts_is_found_within_seconds_and_leaves_no_ghost() -> None:
    detector = PersonDetector("mog2", 10.0)
    assert not walk(detector, 1)
    found = walk(detector, 59, start=1, people=2)
    assert len(found) == 2
    rng = np.random.default_rng(5)
    for index in range(60, 120):
        left = detector.detect(noisy(street(), rng), index / 10.0)
    assert not left


def test_who_stops_does_not_sink_into_the_background() -> None:
    detector = learnt(PersonDetector("mog2", 10.0))
    walk(detector, 30)
    rng = np.random.default_rng(6)
    picture = street()
    put_person(picture, 75.0, 150.0, 50.0)
    for index in range(30, 330):
        found = detector.detect(noisy(picture, rng), index / 10.0)
    assert len(found) == 1


def test_a_camera_that_is_pushed_begins_anew_instead_of_reporting_the_picture() -> None:
    detector = learnt(PersonDetector("mog2", 10.0))
    walk(detector, 20)
    rng = np.random.default_rng(7)
    other = street(9)
    for index in range(20, 60):
        found = detector.detect(noisy(other, rng), index / 10.0)
        assert not any(one.size > 120 for one in found)
    assert detector.jolts == 1
    assert not found


def test_a_shadow_is_not_part_of_a_body() -> None:
    rng = np.random.default_rng(8)
    model = Foreground("mog2", 10.0)
    model.prime([noisy(street(), rng) for _ in range(12)])
    picture = street()
    picture[150:165, 100:180] = (picture[150:165, 100:180] * 0.65).astype(np.uint8)
    put_person(picture, 100.0, 150.0, 60.0)
    layers = model.look(noisy(picture, rng))
    cast = layers.figure[153:163, 115:175]
    assert (cast > 0).mean() < 0.1
    assert (layers.shadow[153:163, 115:175] > 0).mean() > 0.7
    assert (layers.figure[105:145, 95:105] > 0).mean() > 0.9


def test_features_are_the_papers() -> None:
    """A disc's distance transform peaks in its middle; head and foot are its ends."""
    figure = np.zeros((100, 100), np.uint8)
    cv2.circle(figure, (50, 40), 15, 255, -1)
    cv2.rectangle(figure, (48, 40), (52, 80), 255, -1)
    features = silhouette_features(figure, (35.0, 25.0, 31.0, 56.0))
    assert features.middle == pytest.approx((50.0, 40.0), abs=1.0)
    assert features.head == pytest.approx((50.0, 24.5), abs=1.0)
    assert features.foot == pytest.approx((50.0, 80.5), abs=1.0)


def test_predictions_are_matched_once_each_and_far_ones_not_at_all() -> None:
    spread = (16.0, 0.0, 16.0)
    seen = [Detection(10.0, 10.0, covariance=spread), Detection(20.0, 10.0, covariance=spread), Detection(200.0, 9.0)]
    told = [
        Prediction(12.0, 10.0, spread, "a"),
        Prediction(21.0, 11.0, spread, "b"),
        Prediction(90.0, 90.0, spread, "c"),
    ]
    assert [one.target for one in match_predictions(seen, told)] == ["a", "b", ""]
    broken = [Prediction(float("nan"), 10.0, spread, "x"), Prediction(10.0, 10.0, (0.0, 0.0, 0.0), "y")]
    assert [one.target for one in match_predictions([Detection(10.0, 10.0)], broken)] == [""]
    far_too_small = [Prediction(10.0, 10.0, spread, "z", size=1.0)]
    assert match_predictions([Detection(10.0, 10.0, size=200.0)], far_too_small)[0].target == ""


def test_two_people_of_a_rendered_room_are_found_where_they_are_five_seconds_after_the_start() -> None:
    """Live, from the first picture on: the first five seconds, in which the place is learnt, do not count.

    Two people who are whole in view most of the time; five hide each other, and then it takes longer (edge/README.md).
    """
    scene = scenes.get_people(11, None, 2)
    camera = scene.cameras[0]
    renderer = scene.renderer(camera.name, np.random.default_rng(0))
    detector = PersonDetector("mog2", camera.fps)
    right = wrong = missed = 0
    for index in range(130):
        moment = 5.0 + index / camera.fps
        found = detector.detect(renderer.render(moment), moment)
        if index < 50:
            continue
        boxes = [box for box in scene.boxes(camera.name, moment) if np.isfinite(box).all() and box[3] > 40]
        hits = sum(any(_overlap(one.box, box) >= 0.5 for box in boxes) for one in found if one.box is not None)
        right, wrong, missed = right + hits, wrong + len(found) - hits, missed + max(len(boxes) - hits, 0)
    assert right / (right + wrong) > 0.9
    assert right / (right + missed) > 0.9


@pytest.mark.parametrize("shown", [1.0, 0.5])
def test_cloth_of_the_floors_colour_is_no_shadow_and_a_shadow_is(shown: float) -> None:
    """Both are darker floor; only the shadow shows its texture, also where a film's compression took half of it."""
    rng = np.random.default_rng(3)
    floor = 130.0 + cv2.GaussianBlur(rng.normal(0.0, 60.0, (240, 320)), (0, 0), 1.5)
    coarse = floor.mean() + shown * (floor - floor.mean())

    def picture(grey: npt.NDArray[np.float64]) -> Image:
        noise = rng.normal(0.0, 3.0, (*grey.shape, 3))
        return np.clip(grey[..., None] + noise, 0, 255).astype(np.uint8)

    foreground = Foreground("mog2", 10.0)
    foreground.prime([picture(floor) for _ in range(12)])
    now = floor.copy()
    now[60:180, 40:120] = 0.7 * coarse[60:180, 40:120]
    now[60:180, 200:280] = 0.7 * floor.mean()
    layers = foreground.look(picture(now))
    shadow, cloth = (slice(70, 170), slice(50, 110)), (slice(70, 170), slice(210, 270))
    assert (layers.shadow[shadow] > 0).mean() > 0.9
    assert (layers.figure[cloth] > 0).mean() > 0.9


def _overlap(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    x, y, w, h = np.asarray(a)
    x2, y2, w2, h2 = np.asarray(b)
    across = min(x + w, x2 + w2) - max(x, x2)
    down = min(y + h, y2 + h2) - max(y, y2)
    if across <= 0 or down <= 0:
        return 0.0
    return float(across * down / (w * h + w2 * h2 - across * down))


def car(picture: Image, u: float, v: float) -> None:
    cv2.rectangle(picture, (round(u - 25), round(v - 12)), (round(u + 25), round(v + 12)), (200, 210, 215), -1)
    cv2.rectangle(picture, (round(u - 8), round(v - 9)), (round(u + 10), round(v + 9)), (60, 50, 40), -1)


def test_cars_before_a_fixed_camera_are_counted_one_label_each() -> None:
    rng = np.random.default_rng(10)
    detector = VehicleDetector("mog2", 10.0)
    detector.prime([noisy(street(), rng) for _ in range(12)])
    labels: dict[str, int] = {}
    for index in range(110):
        picture = street()
        car(picture, -30.0 + 5.0 * index, 80.0)
        car(picture, 380.0 - 5.0 * (index - 30), 180.0)
        for one in detector.detect(noisy(picture, rng), index / 10.0):
            labels[one.label] = labels.get(one.label, 0) + 1
    assert len(labels) == 2
    assert min(labels.values()) > 40


@pytest.mark.parametrize("speed", [7.0, 3.0, 1.5])
def test_a_car_is_found_from_a_moving_camera_and_the_ground_is_not(speed: float) -> None:
    rng = np.random.default_rng(11)
    coarse = rng.integers(40, 210, (90, 160, 3), dtype=np.uint8)
    ground = np.asarray(cv2.resize(coarse, (1280, 720), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    detector = VehicleDetector("mog2", 10.0)
    near = far = 0
    for index in range(60):
        whole = ground.copy()
        u, v = 200.0 + speed * index, 260.0
        car(whole, u, v)
        left, top = 60 + 3 * index, 120 + index
        view = noisy(whole[top : top + HEIGHT, left : left + WIDTH], rng)
        for one in detector.detect(view, index / 10.0):
            if u + 30.0 - left > WIDTH:
                continue  # cut by the border, its middle is elsewhere
            if np.hypot(one.u + left - u, one.v + top - v) < 20.0:
                near += 1
            else:
                far += 1
    assert detector.moving
    assert near >= 20
    assert far <= 0.1 * near


CARS = Path(__file__).parents[3] / "shared/data/street-cars/cars.mp4"


@pytest.mark.skipif(not CARS.is_file(), reason="no recording of a street here")
def test_the_four_cars_of_a_street_are_four_labels_and_its_paint_is_none(tmp_path: Path) -> None:
    out = tmp_path / "cars.csv"
    assert run(["detect", "vehicle", str(CARS), "--out", str(out), "--json"]) == 0
    with out.open() as lines:
        assert {row["label"] for row in csv.DictReader(lines)} == {"t0", "t1", "t2", "t3"}


def test_two_who_were_never_seen_alone_are_two_where_the_tracking_says_how_tall_people_are() -> None:
    """Two who cross the street as one silhouette; somebody else is followed by other cameras."""

    def crossing(*, told: bool) -> int:
        detector, rng = learnt(PersonDetector("mog2", 10.0)), np.random.default_rng(1)
        found: list[Detection] = []
        for index in range(25):
            picture = street()
            for apart, colour in ((0.0, (30, 30, 160)), (17.0, (160, 60, 30))):
                put_person(picture, 40.0 + apart + 1.5 * index, 170.0, 70.0, colour)
            expected = [Prediction(200.0, 130.0 - 26.0 + 2 * index, (4.0, 0.0, 4.0), "person-1", size=52.0 + index)]
            found = detector.detect(noisy(picture, rng), index / 10.0, expected if told else [])
        return len(found)

    assert crossing(told=False) < 2
    assert crossing(told=True) == 2


def test_the_place_that_somebody_left_is_told_from_him_where_both_are_one_silhouette() -> None:
    """He stood at the left when the background was learnt, and now stands where he half hides that place."""
    rng = np.random.default_rng(12)
    before, now = wall(), wall()
    put_person(before, 100.0, 200.0, 120.0)
    put_person(now, 122.0, 200.0, 120.0)
    before, now = noisy(before, rng), noisy(now, rng)
    differ = np.where(cv2.absdiff(before, now).max(axis=2) > 25, np.uint8(255), np.uint8(0)).astype(np.uint8)
    figure = np.asarray(cv2.morphologyEx(cv2.medianBlur(differ, 3), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    left = places_left(now, before, figure) > 0
    ghost, body = figure.copy(), figure.copy()
    ghost[:, 107:], body[:, :114] = 0, 0
    assert left[ghost > 0].mean() > 0.5
    assert left[body > 0].mean() < 0.1
    assert is_ghost(now, before, (80.0, 80.0, 26.0, 120.0), ghost)
    assert not is_ghost(now, before, (114.0, 80.0, 26.0, 120.0), body)


def test_who_leaves_the_place_where_he_stood_at_first_leaves_no_one_behind() -> None:
    """He stands for 3 s before a camera that was just switched on, then walks away from it: no second one stays."""
    detector, rng = PersonDetector("mog2", 10.0), np.random.default_rng(13)
    for index in range(100):
        gone = max(index - 30, 0)
        picture = wall()
        put_person(picture, 120.0 + 2.0 * gone, 200.0 - 0.6 * gone, 110.0 - 0.5 * gone)
        found = detector.detect(noisy(picture, rng), index / 10.0)
        if index >= 55:
            assert len(found) == 1
            assert found[0].size == pytest.approx(110.0 - 0.5 * gone, rel=0.15)


def test_pieces_of_somebody_tell_no_height() -> None:
    figure = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    put_person(figure, 100.0, 150.0, 90.0, (255, 255, 255))
    put_person(figure, 104.0, 176.0, 20.0, (255, 255, 255))
    put_person(figure, 220.0, 176.0, 80.0, (255, 255, 255))
    found = LonePeople(np.where(figure.any(axis=2), np.uint8(255), np.uint8(0)).astype(np.uint8)).find()
    assert sorted(round(tall) for _, _, tall in found) == pytest.approx([80, 90], abs=2)
    stature = Stature(WIDTH, HEIGHT)
    for index in range(30):
        stature.learn(20.0 + 4 * index, 100.0 + index, 12.0)
    for index in range(15):
        stature.learn(20.0 + 4 * index, 100.0 + 2 * index, 60.0 + index)
    assert stature.at(np.array([100.0]), np.array([110.0]))[0] == pytest.approx(65.0, abs=6.0)


def test_a_camera_s_rate_is_told_by_its_pictures() -> None:
    """A second is a second, whatever rate was told beforehand: 10 pictures of 25 that were told."""
    model, rng = Foreground("mog2", 25.0), np.random.default_rng(4)
    fresh = [model.look(noisy(street(), rng), (), 7.0 + index / 10.0).fresh for index in range(30)]
    assert fresh.index(False) == pytest.approx(8, abs=1)
    assert not any(fresh[12:])


@pytest.mark.parametrize("count", [1, 2, 3, 7, 24])
def test_what_is_usual_is_as_the_plain_expression_says(count: int) -> None:
    pictures = list(np.random.default_rng(count).integers(0, 256, (count, 20, 30, 3), dtype=np.uint8))
    ordered, share = np.sort(np.stack(pictures), axis=0), max(round(0.34 * count), 1)
    start = (ordered[share - 1 :] - ordered[: count - share + 1]).argmin(axis=0)
    assert np.array_equal(usual(pictures), np.take_along_axis(ordered, (start + share // 2)[None], axis=0)[0])


def test_ghosts_are_taken_off_as_the_plain_expression_does() -> None:
    rng = np.random.default_rng(3)
    now = rng.integers(0, 256, (61, 83, 3), dtype=np.uint8)
    then = np.clip(now.astype(int) + rng.integers(-24, 25, now.shape), 0, 255).astype(np.uint8)
    figure, where = (255 * rng.integers(0, 2, (61, 83)).astype(np.uint8) for _ in range(2))
    expected = figure.copy()
    expected[(np.abs(now.astype(int) - then).max(axis=2) < 22) & (where > 0)] = 0
    found = without_like(figure, now, then, where)
    assert np.array_equal(found, expected)
    assert 0 < np.count_nonzero(expected) < np.count_nonzero(figure)


def test_who_counts_is_judged_as_pedestrian_benchmarks_do() -> None:
    """One found, one missed, one wrong; a hidden one that is found, and a hidden one that is not, change nothing."""
    boxes = np.array([[0, 0, 10, 30], [50, 0, 10, 30], [100, 0, 10, 30], [150, 0, 10, 30]], dtype=np.float64)
    counts = np.array([True, True, False, False])
    found = [np.array([1.0, 1, 10, 30]), np.array([100.0, 2, 10, 30]), np.array([200.0, 0, 10, 30])]
    assert judge(boxes, counts, found)[:3] == (1, 1, 1)


def test_nothing_darker_than_the_places_shadows_is_a_shadow_once_they_are_known() -> None:
    """Grey trousers before a plain floor are darker than shadows are here; what is as dark as they still is one."""
    rng = np.random.default_rng(2)
    floor = np.full((240, 320), 140.0)
    floor[:, :200] += cv2.GaussianBlur(rng.normal(0.0, 60.0, (240, 200)), (0, 0), 1.5)

    def seen(light: float, left: int) -> tuple[Image, Image]:
        picture, figure = floor.copy(), np.zeros((240, 320), np.uint8)
        picture[60:200, left : left + 80] *= light
        figure[60:200, left : left + 80] = 255
        noise = rng.normal(0.0, 2.0, (240, 320, 3))
        return np.clip(picture[..., None] + noise, 0, 255).astype(np.uint8), figure

    background, shadows = seen(1.0, 0)[0], Shadows()

    def share(light: float, left: int) -> float:
        picture, figure = seen(light, left)
        return float((shadows.find(picture, background, figure)[70:190, left + 10 : left + 70] > 0).mean())

    assert share(0.5, 230) > 0.9
    for index in range(6):
        assert share(0.7, 10 + 15 * index) > 0.8
    assert shadows.darkest == pytest.approx(0.67, abs=0.03)
    assert share(0.5, 230) < 0.1
    assert share(0.72, 230) > 0.9


def test_what_seems_a_shadow_within_a_body_is_of_the_body_and_beside_it_is_not() -> None:
    whole = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    put_person(whole, 100.0, 200.0, 120.0, (255, 255, 255))
    figure = np.where(whole.any(axis=2), np.uint8(255), np.uint8(0)).astype(np.uint8)
    shadow = np.zeros_like(figure)
    shadow[110:140, 95:105] = figure[110:140, 95:105]
    figure[110:140, 95:105] = 0
    shadow[185:200, 115:180] = 255
    joined = clean(figure, shadow, 120.0)
    assert (joined[112:138, 95:105] > 0).all()
    assert not (joined[185:200, 120:180] > 0).any()
    assert not (clean(figure, np.zeros_like(figure), 120.0)[122:128, 98:102] > 0).any()


def pole(v: npt.ArrayLike, tilt: float = 0.35, focal: float = 420.0, ratio: float = 0.7) -> npt.NDArray[np.float64]:
    """Heights [px] of people whose feet are in rows v of the middle of a 640 x 480 picture, by the pinhole's angles."""
    below = np.arctan((np.asarray(v, dtype=np.float64) - 240.0) / focal) + tilt
    head = np.arctan((1.0 - ratio) * np.tan(below))
    return np.asarray(focal * (np.tan(below - tilt) - np.tan(head - tilt)), dtype=np.float64)


def test_heights_of_a_place_follow_from_those_of_another() -> None:
    rng = np.random.default_rng(0)
    stature = Stature(640, 480)
    for v in rng.uniform(280.0, 380.0, 60):
        stature.learn(rng.uniform(250.0, 390.0), v, float(pole(v)) * rng.normal(1.0, 0.02))
    v = np.array([230.0, 250.0, 300.0, 350.0, 420.0])
    assert stature.at(np.full(5, 320.0), v) == pytest.approx(pole(v), rel=0.1)


def test_it_does_not_matter_to_heights_who_was_seen_where() -> None:
    """Somebody tall walks about the near half, somebody short about the far one: named, they tilt the place less."""

    def astray(*, named: bool) -> float:
        rng, stature = np.random.default_rng(1), Stature(640, 480)
        for low, high, taller, who in ((330.0, 440.0, 1.12, "p0"), (240.0, 350.0, 0.88, "p1")):
            for v in rng.uniform(low, high, 60):
                stature.learn(320.0, v, taller * float(pole(v)) * rng.normal(1.0, 0.02), who if named else "")
        v = np.array([240.0, 440.0])
        far, near = np.log(stature.at(np.full(2, 320.0), v) / pole(v))
        return float(near - far)

    assert astray(named=True) < 0.6 * astray(named=False)


def test_guesses_of_heights_count_until_enough_have_been_seen() -> None:
    rng, stature = np.random.default_rng(2), Stature(640, 480)
    for index, v in enumerate(rng.uniform(280.0, 420.0, 40)):
        assert stature.known == (index >= 16)
        stature.guess(320.0, v, 0.9 * float(pole(v)))
    v = np.array([300.0, 400.0])
    assert stature.at(np.full(2, 320.0), v) == pytest.approx(0.9 * pole(v), rel=0.04)
    for v in rng.uniform(280.0, 420.0, 48):
        stature.learn(320.0, v, float(pole(v)))
    v = np.array([300.0, 400.0])
    assert stature.at(np.full(2, 320.0), v) == pytest.approx(pole(v), rel=0.01)


def test_a_short_one_beside_a_tall_one_has_a_short_ones_box() -> None:
    """Both are one silhouette; nobody is expected, or both are, whose heights were measured when they were alone."""
    stature = Stature(WIDTH, HEIGHT)
    for index in range(60):
        stature.learn(20.0 + 4 * index, 100.0 + index, 60.0)
    drawn = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    put_person(drawn, 100.0, 150.0, 66.0, (255, 255, 255))
    put_person(drawn, 116.0, 150.0, 48.0, (255, 255, 255))
    figure = np.where(drawn.any(axis=2), np.uint8(255), np.uint8(0)).astype(np.uint8)
    nothing = np.zeros_like(figure)
    usual = float(stature.at(np.array([108.0]), np.array([150.0]))[0])
    expected = [(89.0, 85.0, 22.0, 60.0), (105.0, 85.0, 22.0, 60.0)]
    for bodies in (
        explain(figure, nothing, stature, []),
        explain(figure, nothing, stature, expected, statures=[66.0 / usual, 48.0 / usual]),
    ):
        tall, short = (body.box[3] for body in sorted(bodies, key=lambda body: body.box[0]))
        assert tall == pytest.approx(66.0, abs=4.0)
        assert short == pytest.approx(48.0, abs=3.0)


def test_a_vehicle_s_background_is_learnt_by_the_pictures_times() -> None:
    """25 pictures a second were told, 5 come: after the first second, that is 5 of them, cars are told."""
    rng, detector = np.random.default_rng(5), VehicleDetector("mog2", 25.0, moving=False)
    first = None
    for index in range(40):
        picture = street()
        if index >= 3:
            car(picture, 20.0 + 6.0 * index, 120.0)
        if detector.detect(noisy(picture, rng), index / 5.0) and first is None:
            first = index
    assert first is not None
    assert first < 20
