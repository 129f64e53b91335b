"""CLEAR MOT and identity scores on cases that can be counted by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deploy.demo.people import PeopleComparison
from deploy.evaluation.clear_mot import EvaluationFrame, clear_mot


def moment(truth: dict[str, float], found: dict[str, float]) -> EvaluationFrame:
    """One instant with people and tracks on a line."""
    return EvaluationFrame(
        tuple(truth),
        np.array([[x, 0.0] for x in truth.values()]).reshape(-1, 2),
        tuple(found),
        np.array([[x, 0.0] for x in found.values()]).reshape(-1, 2),
    )


def test_perfect_tracks_score_one() -> None:
    scores = clear_mot([moment({"a": 0.0, "b": 3.0}, {"1": 0.1, "2": 3.0})] * 10, 0.5)
    assert (scores.mota, scores.idf1, scores.switches, scores.labels) == (1.0, 1.0, 0, 2)
    assert scores.error == pytest.approx(0.05)


def test_misses_and_false_positives_are_counted() -> None:
    scores = clear_mot([moment({"a": 0.0, "b": 3.0}, {"1": 0.0, "2": 9.0})] * 4, 0.5)
    assert (scores.misses, scores.false, scores.matches) == (4, 4, 4)
    assert scores.mota == pytest.approx(1.0 - 8 / 8)


def test_exchanged_labels_are_two_switches() -> None:
    before, after = {"1": 0.0, "2": 3.0}, {"2": 0.0, "1": 3.0}
    truth = {"a": 0.0, "b": 3.0}
    scores = clear_mot([moment(truth, before)] * 5 + [moment(truth, after)] * 5, 0.5)
    assert scores.switches == 2
    assert scores.mota == pytest.approx(1.0 - 2 / 20)
    assert scores.idf1 == pytest.approx(0.5)


def test_a_match_is_kept_while_it_is_within_the_maximum_distance() -> None:
    """Another track that comes closer does not replace it, which would be counted as a switch."""
    scores = clear_mot([moment({"a": 0.0}, {"1": 0.1}), moment({"a": 0.0}, {"1": 0.4, "2": 0.0})], 0.5)
    assert (scores.switches, scores.false) == (0, 1)


def test_a_label_kept_through_a_gap_is_a_fragment_and_not_a_switch() -> None:
    truth = {"a": 0.0}
    scores = clear_mot([moment(truth, {"1": 0.0}), moment(truth, {}), moment(truth, {"1": 0.0})], 0.5)
    assert (scores.switches, scores.fragments, scores.misses) == (0, 1, 1)


def test_no_targets_and_no_estimates() -> None:
    scores = clear_mot([moment({}, {})], 0.5)
    assert scores.truths == 0
    assert np.isnan(scores.error)


@pytest.mark.parametrize(("frames", "said"), [(100, True), (295, False)])
def test_the_demo_says_that_the_machine_is_too_slow_for_it(
    frames: int, said: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """A busy machine searched 3 of 10 frames a second, and the demo said no more than "NOT within the limits"."""
    poor = clear_mot([EvaluationFrame(("a",), np.zeros((1, 2)), ("x",), np.ones((1, 2)))], 0.5)
    PeopleComparison(poor, poor, poor, 30.0, 1, {"cam0": 299, "cam1": frames}, 10.0).print(Path("out"))
    assert ("3.3 of 10 frames a second" in capsys.readouterr().out) == said
