"""The covariance that people's and vehicles' detectors tell is that of their errors, on rendered truth."""

from __future__ import annotations

import numpy as np

from edge.detectors.moving.vehicle import VehicleDetector
from edge.uav.world import scenarios
from tests.bench import people_detector


def test_a_persons_covariance_is_that_of_its_representative_points_error() -> None:
    pictures, boxes, middles, fps = people_detector.film(611, 5, 9.0)
    shown, _ = people_detector.from_file(pictures, fps)
    found = [people_detector.errors(*frame) for frame in zip(boxes, middles, shown, strict=True)]
    across, down = np.array([one[1:] for frame in found for one in frame]).T
    assert len(across) > 80
    # Errors last for many frames and nine seconds are few: the bench tells it to a fifth, this a wrong order of size.
    assert 0.25 < across.mean() < 2.5
    assert 0.25 < down.mean() < 2.5


def test_a_vehicles_covariance_is_that_of_its_centres_error() -> None:
    """The town from a camera that stands still; a car's truth is the middle of its body."""
    world = scenarios.get("paper-4.4", 2)
    camera = world.truth(world.length // 3).camera
    detector = VehicleDetector("mog2", world.fps, moving=False)
    ratios = []
    for index in range(110):
        picture = world.draw_from(index, camera.rotation, camera.position)
        found = detector.detect(picture, index / world.fps)
        truth = world.truth_from(index, camera.rotation, camera.position)
        middles = [*truth.others, *([(truth.x, truth.y)] if truth.visible > 0.9 else [])]
        for one in found if index > 30 else ():
            away = min((float(np.hypot(one.u - u, one.v - v)) for u, v in middles), default=np.inf)
            inside = 45.0 < one.u < world.size[0] - 45.0 and 45.0 < one.v < world.size[1] - 45.0
            if inside and away < one.size and one.covariance is not None:
                ratios.append(0.5 * away**2 / one.covariance[0])
    assert len(ratios) > 50
    assert 0.25 < np.mean(ratios) < 2.5
