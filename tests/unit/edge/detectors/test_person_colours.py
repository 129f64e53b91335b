"""Clothing colours reported by the person detector."""

from __future__ import annotations

import numpy as np

from edge.detectors.people.person import PersonDetector
from tests.unit.edge.detectors.test_person import draw_person, initialised, noisy, street

RED, BLUE = (30, 30, 160), (160, 60, 30)


def test_colours_are_those_of_the_current_image() -> None:
    """After an identity switch at a crossing the reported colour is that of the current image."""
    detector = initialised(PersonDetector(fps=10.0))
    rng = np.random.default_rng(1)
    colours = []
    for index in range(25):
        picture = street()
        draw_person(picture, 30.0 + 1.5 * index, 150.0, 50.0, RED if index < 24 else BLUE)
        colours = [one.colour for one in detector.detect(noisy(picture, rng), index / 10.0)]
    assert len(colours) == 1
    assert colours[0] is not None
    assert colours[0][2] > 100 > colours[0][0], "red, green, blue"
