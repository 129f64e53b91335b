"""People in clips of a second or two: one walker is one person, whatever else changes in the street."""

from __future__ import annotations

import numpy as np
import pytest

from edge.detectors.moving.camera_motion import CameraTravel
from edge.detectors.people.silhouettes import segment_by_shape
from tests.bench.people_clips import people_of
from tests.support.people_boxes import score_boxes
from tests.support.street import KINDS, street_clip


@pytest.mark.parametrize(
    ("kind", "seed"),
    [("wind in trees", 7), ("hand-held", 4), ("nobody, wind and light", 3)],
)
def test_people_are_counted_once_in_a_short_clip(kind: str, seed: int) -> None:
    clip = street_clip(KINDS[kind], seed, (320, 240), 15.0, 1.7)
    found = people_of(clip, twice=True)
    assert found is not None
    assert len({one.label for shown in found for one in shown}) == KINDS[kind].people
    scores = [
        score_boxes(*true, [np.array(one.box) for one in shown]) for true, shown in zip(clip.boxes, found, strict=True)
    ]
    right, wrong, missed = (sum(one[part] for one in scores) for part in range(3))
    assert right >= 0.8 * (right + wrong)
    assert right >= 0.8 * (right + missed)


def test_a_clip_of_a_panning_camera_is_refused() -> None:
    clip = street_clip(KINDS["panning"], 1, (320, 240), 15.0, 1.7)
    assert people_of(clip, twice=True) is None


@pytest.mark.parametrize(("kind", "moves"), [("panning", True), ("hand-held", False), ("changing light", False)])
def test_a_shaking_camera_is_not_a_moving_one(kind: str, moves: bool) -> None:
    clip, travel = street_clip(KINDS[kind], 5, (320, 240), 12.0, 2.0), CameraTravel()
    assert (True in [travel.moves(image, index / clip.fps) for index, image in enumerate(clip.images)]) is moves


def test_fragments_that_one_template_explains_are_one_person() -> None:
    """A person without the belt; two people side by side stay two."""
    foreground = np.zeros((240, 320), np.uint8)
    for left in (60, 200, 240):
        foreground[50:62, left + 8 : left + 16] = foreground[64:100, left : left + 24] = 255
        foreground[108:150, left + 2 : left + 22] = 255
    foreground[170:176, 100:104] = 255
    boxes = sorted(body.box for body in segment_by_shape(foreground, []))
    assert boxes == [(60, 50, 24, 100), (200, 50, 24, 100), (240, 50, 24, 100)]
