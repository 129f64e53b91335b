"""Whose clothes the person detector tells."""

from __future__ import annotations

import numpy as np

from edge.detectors.people.person import PersonDetector
from tests.unit.test_person_detector import learnt, noisy, put_person, street

RED, BLUE = (30, 30, 160), (160, 60, 30)


def test_colours_are_this_pictures() -> None:
    """A camera that takes one for another at a crossing tells the right clothes as soon as it sees them."""
    detector = learnt(PersonDetector(fps=10.0))
    rng = np.random.default_rng(1)
    told = []
    for index in range(25):
        picture = street()
        put_person(picture, 30.0 + 1.5 * index, 150.0, 50.0, RED if index < 24 else BLUE)
        told = [one.colour for one in detector.detect(noisy(picture, rng), index / 10.0)]
    assert len(told) == 1
    assert told[0] is not None
    assert told[0][2] > 100 > told[0][0], "red, green, blue"
