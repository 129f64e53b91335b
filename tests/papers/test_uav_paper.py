"""Background-aware tracking paper: the content of its figures, each on a short part of the town scenario."""

from __future__ import annotations

import numpy as np
import pytest

from edge.uav.world import scenarios
from edge.uav.world.flight_world import FlightWorld
from tests.papers import uav_paper as figures


@pytest.fixture(scope="module")
def town() -> FlightWorld:
    return scenarios.get("exit-bend", 1)


def test_figures_2_to_5_the_road_is_found_and_corrects_the_regions(town: FlightWorld) -> None:
    tracker = figures.background_aware(town, 0)
    figures.run(town, tracker, 12)
    diagnostics = tracker.diagnostics
    before, after = (figures.road_share(town, 11, labels) for labels in (diagnostics.labels, diagnostics.corrected))
    assert after > 0.95
    assert after >= before
    assert figures.lane_scatter(town, 11, tracker) < 5.0


def test_figure_7_the_car_is_tracked_while_visible(town: FlightWorld) -> None:
    errors = figures.run(town, figures.background_aware(town, 0), 40).errors
    assert np.median(errors) < figures.NEAR


def test_the_canvas_shows_the_frame_in_its_middle(town: FlightWorld) -> None:
    image, origin = figures.canvas(town, 3)
    x, y = origin.astype(int)
    inside = image[y + 1 : y + town.size[1], x + 1 : x + town.size[0]]
    np.testing.assert_array_equal(inside[5:-5, 5:-5], town.frame(3)[6:-5, 6:-5])


def test_a_score_separates_visible_and_invisible_frames(town: FlightWorld) -> None:
    first, end = town.out_of_view
    estimates = figures.run(town, figures.plain(town, 0), 2).estimates[:1] * town.length
    errors = np.zeros(town.length)
    errors[first:end] = 25.0
    score = figures.Run(town, estimates, errors).score()
    assert (score.seen_near, score.out_near, score.out_car, score.back) == (1.0, 0.0, 1.0, 1.0)
    assert score.false_visible == 1.0
