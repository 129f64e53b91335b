"""The ball detector on rendered images with ground truth."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from edge import scenes
from edge.detectors.marker.ball import MarkerDetector, MarkerModel, learn_marker_model
from edge.detectors.marker.colour import ColourModel, colour_indices
from edge.scenes import renderer_for
from edge.scenes.marker.scene import MarkerScene
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from tests.bench.marker_detector import Result, measure


@pytest.fixture(scope="module")
def room() -> Result:
    """Two scenes of three cameras, noise 4, motion blur of up to 9 px."""
    return measure("marker", seeds=range(2), frames=20, noise=4.0)


def without_marker(scene: MarkerScene) -> MarkerScene:
    """The same scene with the ball 500 m above it."""
    return dataclasses.replace(scene, path=dataclasses.replace(scene.path, centre=np.array([0.0, 0.0, 500.0])))


def test_finds_the_ball_in_every_frame_and_nothing_else(room: Result) -> None:
    assert room.frames > 100
    assert room.missed == 0
    assert room.false == 0


def test_the_centre_is_accurate_to_a_tenth_of_a_pixel(room: Result) -> None:
    distance = np.sort(np.hypot(*room.error.T))
    assert np.median(distance) < 0.07
    # In 1 frame of 100 an object of nearly the same colour touches the ball: a larger error, but no false detection.
    usual = distance[: round(0.98 * len(distance))]
    assert np.sqrt(np.mean(usual**2) / 2.0) < 0.08
    assert distance[-1] < 2.0
    assert np.abs(np.median(room.error, axis=0)).max() < 0.03  # no bias towards the light


def test_motion_blur_does_not_shift_the_centre(room: Result) -> None:
    smeared = room.smear > 2.0
    assert smeared.sum() > 25
    assert np.median(np.hypot(*room.error[smeared].T)) < 0.09
    assert np.abs(np.median(room.error[smeared], axis=0)).max() < 0.04


def test_covariance_agrees_with_the_errors(room: Result) -> None:
    assert 0.5 < room.nees.mean() < 2.0
    assert np.mean(room.nees < 3.0) > 0.9  # exp(-3) = 5 % of a Gaussian's are above


def test_covariance_agrees_with_the_errors_in_compressed_video() -> None:
    """Compression makes errors of neighbouring rays correlated; the scatter of the rim assumes independent ones."""
    video = measure("marker", seeds=range(2), frames=30, noise=4.0, crf=24)
    assert video.frames > 150
    assert video.missed <= 0.01 * video.frames
    assert video.false == 0
    assert 0.5 < video.nees.mean() < 2.0


def test_size_is_the_diameter_of_the_disc_of_equal_area(room: Result) -> None:
    assert room.size_ratio.mean() == pytest.approx(1.0, abs=0.01)
    assert room.size_ratio.std() < 0.02


@pytest.mark.parametrize("seed", range(2))
def test_distractors_are_not_the_marker(seed: int) -> None:
    scene = without_marker(scenes.get_marker_scene("marker", seed))
    for camera in scene.cameras:
        renderer = renderer_for(scene, camera.name, np.random.default_rng(seed))
        assert MarkerDetector().detect(renderer.render(0.0)) == []


def ball(width: int, height: int, u: float, v: float, radius: float, background: int = 120) -> np.ndarray:
    """A flat orange disc, rendered at 8 times the resolution and averaged down."""
    fine = np.full((height * 8, width * 8, 3), background, np.uint8)
    y, x = np.mgrid[: height * 8, : width * 8]
    fine[np.hypot((x + 0.5) / 8 - 0.5 - u, (y + 0.5) / 8 - 0.5 - v) <= radius] = (22, 112, 246)
    return np.rint(fine.reshape(height, 8, width, 8, 3).mean(axis=(1, 3))).astype(np.uint8)


@pytest.mark.parametrize(("u", "v", "radius"), [(40.0, 30.0, 4.0), (41.37, 28.81, 6.5), (60.5, 50.25, 12.0)])
def test_pixel_convention_is_that_of_pixel_centres(u: float, v: float, radius: float) -> None:
    (found,) = MarkerDetector().detect(ball(128, 96, u, v, radius))
    assert (found.u, found.v) == (pytest.approx(u, abs=0.03), pytest.approx(v, abs=0.03))
    assert found.size == pytest.approx(2 * radius, rel=0.02)
    assert found.colour == (pytest.approx(246, abs=30), pytest.approx(112, abs=20), pytest.approx(22, abs=30))


def test_the_covariance_grows_as_the_contrast_of_the_ball_falls() -> None:
    clear = ball(128, 96, 60.5, 50.25, 12.0)
    similar = clear.copy()
    similar[:50][np.all(clear[:50] == 120, axis=2)] = (50, 90, 140)  # above, a wall of its hue
    rng = np.random.default_rng(0)
    variances = np.zeros(3)
    for _ in range(5):
        for index, image in enumerate((clear, similar, np.round(0.4 * clear))):
            noisy = image + rng.normal(0.0, 4.0, image.shape)
            (found,) = MarkerDetector().detect(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
            assert found.covariance is not None
            variances[index] += found.covariance[0] + found.covariance[2]
    assert variances[1] > 1.4 * variances[0]
    assert variances[2] > 1.4 * variances[0]


def test_a_ball_truncated_by_the_border_is_not_detected() -> None:
    assert MarkerDetector().detect(ball(128, 96, 3.0, 40.0, 8.0)) == []
    assert MarkerDetector().detect(ball(128, 96, 60.0, 93.0, 8.0)) == []


@pytest.mark.parametrize("turn", [0.3, 1.7, 3.9])
def test_a_red_ball_behind_an_orange_one_does_not_bias_its_centre(turn: float) -> None:
    """The outline enclosed both, up to 4 px off with a std of 0.1 px; the pixels' colours distinguish them."""
    rng = np.random.default_rng(round(10 * turn))
    truth = np.array([60.4, 47.7])
    red = truth + 4.0 * np.array([np.cos(turn), np.sin(turn)])
    fine = np.full((96 * 8, 128 * 8, 3), (128, 135, 140), np.uint8)
    y, x = np.mgrid[: 96 * 8, : 128 * 8]
    for (u, v), radius, colour in ((red, 9.0, (40, 30, 170)), (truth, 9.0, (22, 112, 246))):
        away = np.hypot((x + 0.5) / 8 - 0.5 - u, (y + 0.5) / 8 - 0.5 - v) / radius
        shaded = np.array(colour) * (1.0 - 0.3 * np.minimum(away, 1.0)[..., None] ** 2)
        fine[away <= 1.0] = shaded[away <= 1.0].astype(np.uint8)
    image = fine.reshape(96, 8, 128, 8, 3).mean(axis=(1, 3)) + rng.normal(0.0, 4.0, (96, 128, 3))
    (found,) = MarkerDetector().detect(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert found.covariance is not None
    error = np.array([found.u, found.v]) - truth
    assert np.hypot(*error) < 1.0
    assert error @ error < 9.0 * (found.covariance[0] + found.covariance[2])
    assert found.size == pytest.approx(18.0, rel=0.12)


def test_a_ball_mostly_beyond_the_border_is_not_detected_as_a_smaller_ball() -> None:
    """A cap whose fitted outline ended a third of a pixel inside was reported, 8 px from the ball's centre."""
    scene = scenes.get_marker_scene("marker", 63)
    camera = scene.cameras[0]
    renderer = renderer_for(scene, camera.name, np.random.default_rng(0))
    detector = MarkerDetector(intrinsics=camera.intrinsics)
    cut = 0
    for moment in np.linspace(55.40, 55.52, 25):
        truth, size = scene.seen_by(camera.name, np.array([moment]))
        beyond = truth[0, 1] + 0.5 * size[0] > camera.intrinsics.height
        cut += beyond
        assert not beyond or detector.detect(renderer.render(float(moment))) == []
    assert cut >= 10


@pytest.mark.parametrize("level", [0, 90, 255])
def test_uniform_images_contain_no_marker(level: int) -> None:
    assert MarkerDetector().detect(np.full((48, 64, 3), level, np.uint8)) == []


def test_a_wall_in_the_markers_colour_is_no_marker() -> None:
    assert MarkerDetector().detect(np.full((96, 128, 3), (22, 112, 246), np.uint8)) == []


def test_odd_and_tiny_images_are_accepted() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (61, 83, 3), dtype=np.uint8)
    for height, width in ((61, 83), (1, 1), (2, 3), (5, 1)):
        assert isinstance(MarkerDetector().detect(noise[:height, :width]), list)


def test_detections_outside_the_size_limits_are_dropped() -> None:
    image = ball(128, 96, 60.0, 48.0, 8.0)
    assert MarkerDetector(min_size=20.0).detect(image) == []
    assert MarkerDetector(max_size=10.0).detect(image) == []
    assert len(MarkerDetector(min_size=10.0, max_size=20.0).detect(image)) == 1


def test_a_model_learnt_from_one_image_detects_the_ball_in_other_cameras() -> None:
    scene = scenes.get_marker_scene("marker", 1)
    pixel, size = scene.seen_by("cam0", np.array([3.0]))
    side = 1.6 * size[0]  # a box that includes background
    image = renderer_for(scene, "cam0", np.random.default_rng(0)).render(3.0)
    model = learn_marker_model(image, (pixel[0, 0] - side / 2, pixel[0, 1] - side / 2, side, side))
    detector = MarkerDetector(model)
    errors = []
    for camera in ("cam0", "cam1", "cam2"):
        renderer = renderer_for(scene, camera, np.random.default_rng(5))
        for moment in np.linspace(1.0, 30.0, 10):
            truth = scene.seen_by(camera, np.array([moment]))[0][0]
            for found in detector.detect(renderer.render(moment)):
                errors.append(np.hypot(found.u - truth[0], found.v - truth[1]))
    assert len(errors) >= 25  # of 30; a few are out of the picture
    assert max(errors) < 1.0


def test_learning_refuses_a_box_without_a_colour_of_its_own() -> None:
    with pytest.raises(InputError, match="colour of its own"):
        learn_marker_model(np.full((60, 80, 3), 128, np.uint8), (20, 20, 10, 10))
    with pytest.raises(InputError, match="does not lie in"):
        learn_marker_model(np.full((60, 80, 3), 128, np.uint8), (75, 20, 10, 10))


def test_a_model_round_trips_through_its_table() -> None:
    model = MarkerModel.of_colour(40, 90, 220, label="blue")
    again = MarkerModel.from_table(model.to_table())
    assert again.label == "blue"
    agree = model.colours.table() == again.colours.table()
    assert agree.mean() > 0.999  # colours are rounded to whole numbers
    assert model.colours.table().any()


def test_invalid_models_are_refused() -> None:
    with pytest.raises(InputError, match="no colour model"):
        ColourModel.from_table({"target": "orange"})
    with pytest.raises(InputError, match="hardly a hue"):
        MarkerModel.of_colour(200, 200, 200)


def test_pixels_are_classified_by_the_nearest_example() -> None:
    model = ColourModel(np.array([[20.0, 110.0, 240.0]]), np.array([[20.0, 110.0, 200.0]]))
    table = model.table()
    pixels = np.array([[[20, 110, 236], [20, 110, 206], [200, 110, 20]]], np.uint8)
    assert table[colour_indices(pixels)].tolist() == [[1, 0, 0]]  # nearest target, nearest other, far from both


@pytest.mark.parametrize(
    ("distortions", "fisheye"),
    [([0.0] * 5, False), ([-0.2, 0.04, 0.0, 0.0, 0.0], False), ([0.01, -0.004, 0.0, 0.0], True)],
    ids=["pinhole", "barrel", "fisheye"],
)
def test_the_outlines_centre_is_corrected_to_the_balls(distortions: list[float], fisheye: bool) -> None:
    """A large ball far off the axis: its outline's centre differs from its centre's projection by perspective and
    distortion.
    """
    scene = dataclasses.replace(scenes.get_marker_scene("marker", 3), marker_radius=0.1)
    first = scene.cameras[0]
    lens = Intrinsics(640, 480, first.intrinsics.matrix, np.array(distortions), fisheye)
    scene = dataclasses.replace(scene, cameras=(dataclasses.replace(first, intrinsics=lens), *scene.cameras[1:]))
    with_lens, without = MarkerDetector(intrinsics=lens), MarkerDetector()
    renderer = renderer_for(scene, "cam0", np.random.default_rng(0))
    before, after = [], []
    for moment in np.linspace(0.5, 60.0, 60):
        truth, _ = scene.seen_by("cam0", np.array([moment]))
        off_axis = truth[0] - lens.matrix[:2, 2]
        if not np.hypot(*off_axis) >= 150:
            continue
        image = renderer.render(moment)
        outward = off_axis / np.hypot(*off_axis)
        for found, corrected in zip(without.detect(image), with_lens.detect(image), strict=True):
            before.append(outward @ (np.array([found.u, found.v]) - truth[0]))
            after.append(outward @ (np.array([corrected.u, corrected.v]) - truth[0]))
    assert len(before) > 5
    assert abs(np.median(after)) < 0.03
    if not fisheye:  # an equidistant fisheye images a ball as a disc about its centre, wherever it is
        assert np.median(before) > np.median(after) + 0.05


def test_detection_does_not_write_to_the_image() -> None:
    image = ball(128, 96, 60.0, 48.0, 8.0)
    copy = image.copy()
    image.flags.writeable = False
    MarkerDetector().detect(image)
    assert (image == copy).all()
    assert cv2.countNonZero(image[..., 0]) > 0
