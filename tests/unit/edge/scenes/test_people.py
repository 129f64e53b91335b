"""The scene `people`: people who avoid each other, rendered where the ground truth is."""

from __future__ import annotations

import numpy as np
import pytest

from edge import scenes
from edge.scenes.people.renderer import PeopleRenderer
from edge.scenes.people.scene import simulate_people_tracks, visible_points
from protocols.core.errors import InputError


def test_the_same_seed_gives_the_same_scene_and_another_seed_another_scene() -> None:
    times = np.array([0.0, 64_000.7])
    first, again, other = (scenes.get_people_scene(seed, 3, 3) for seed in (4, 4, 5))
    assert np.array_equal(first.joints(times), again.joints(times))
    assert first.people == again.people
    assert not np.allclose(first.joints(times), other.joints(times))


def test_people_walk_at_human_speed_inside_the_room_and_not_through_each_other() -> None:
    scene = scenes.get_people_scene(7, 2, 5)
    times = np.arange(0.0, 2.2 * scene.paths.length_s, 0.1)  # there, back, and there again
    feet = scene.feet(times)[..., :2]
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1) / 0.1
    assert speed.max() < 2.0
    assert 0.5 < speed.mean() < 1.5
    assert np.abs(feet).max() < scene.room[0] - 1.0
    gaps = np.linalg.norm(feet[:, :, None] - feet[:, None], axis=-1) + 9.0 * np.eye(5)
    assert gaps.min() > 0.2
    assert np.percentile(gaps.min(axis=(1, 2)), 5) > 0.35


def test_heads_are_as_high_as_people_are_tall_and_feet_are_on_the_floor() -> None:
    scene = scenes.get_people_scene(1, 2, 4)
    times = np.linspace(3.0, 40.0, 200)
    drop = scene.heights - scene.heads(times)[..., 2]
    assert (drop > -0.01).all()
    assert drop.max() < 0.15  # a stride lowers the head
    lowest = scene.joints(times)[..., 2].min(axis=-1)
    assert np.abs(lowest).max() < 0.08


def test_images_show_people_in_their_true_boxes_with_the_nearer_occluding_the_farther() -> None:
    scene = scenes.get_people_scene(2, 3, 5)
    hidden = 0
    for camera in scene.cameras:
        renderer = PeopleRenderer(scene, camera.name, np.random.default_rng(0))
        for moment in (4.0, 9.0, 14.0):
            image, owners = renderer.render_with_owners(moment)
            assert image.shape == (480, 640, 3)
            boxes = scene.boxes(camera.name, moment)
            for index, (x, y, w, h) in enumerate(boxes):
                rows, columns = np.nonzero(owners == index + 1)
                if not np.isfinite(x) or not len(rows):
                    hidden += 1
                    continue
                assert columns.min() >= x - 3
                assert columns.max() <= x + w + 3
                assert rows.min() >= y - 3
                assert rows.max() <= y + h + 3
    assert hidden < 20


def test_a_head_behind_a_nearer_person_is_not_detected() -> None:
    scene = scenes.get_people_scene(3, 3, 8)
    times = np.arange(5.0, 25.0, 0.5)
    pixels, visible = visible_points(scene, "cam0", times)
    inside = np.isfinite(pixels).all(axis=-1)
    assert visible[inside].mean() > 0.4
    assert (~visible[inside]).sum() > 20


def test_a_session_has_two_labels_a_person_and_noise_of_the_size_that_was_asked_for() -> None:
    scene = scenes.get_people_scene(3, 3, 2)
    tracks = simulate_people_tracks(scene, 20.0, 1, pixel_noise=2.0)
    assert {label for track in tracks.values() for label in track.label} == {
        "person0-head", "person0-foot", "person1-head", "person1-foot",
    }  # fmt: skip
    track = tracks["cam1"]
    heads = np.array([label == "person0-head" for label in track.label])
    truth = scene.seen_by("cam1", scene.heads(track.true_time[heads])[:, 0])
    assert (track.pixels[heads] - truth).std() == pytest.approx(2.0, rel=0.2)


def test_impossible_rooms_are_refused() -> None:
    with pytest.raises(InputError, match="cameras"):
        scenes.get_people_scene(0, 1)
    with pytest.raises(InputError, match="do not fit"):
        scenes.get_people_scene(0, 3, 50)
    with pytest.raises(InputError, match="no scene"):
        scenes.get_scene("ocean", 0)
