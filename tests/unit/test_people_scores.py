"""CLEAR MOT and identity scores on cases that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from deploy.evaluation.clear_mot import Moment, clear_mot


def moment(truth: dict[str, float], found: dict[str, float]) -> Moment:
    """People and tracks on a line."""
    return Moment(
        tuple(truth),
        np.array([[x, 0.0] for x in truth.values()]).reshape(-1, 2),
        tuple(found),
        np.array([[x, 0.0] for x in found.values()]).reshape(-1, 2),
    )


def test_all_right_is_one() -> None:
    scores = clear_mot([moment({"a": 0.0, "b": 3.0}, {"1": 0.1, "2": 3.0})] * 10, 0.5)
    assert (scores.mota, scores.idf1, scores.switches, scores.labels) == (1.0, 1.0, 0, 2)
    assert scores.error == pytest.approx(0.05)


def test_misses_and_false_ones_are_counted() -> None:
    scores = clear_mot([moment({"a": 0.0, "b": 3.0}, {"1": 0.0, "2": 9.0})] * 4, 0.5)
    assert (scores.misses, scores.false, scores.matches) == (4, 4, 4)
    assert scores.mota == pytest.approx(1.0 - 8 / 8)


def test_exchanged_names_are_two_switches_once() -> None:
    before, after = {"1": 0.0, "2": 3.0}, {"2": 0.0, "1": 3.0}
    truth = {"a": 0.0, "b": 3.0}
    scores = clear_mot([moment(truth, before)] * 5 + [moment(truth, after)] * 5, 0.5)
    assert scores.switches == 2
    assert scores.mota == pytest.approx(1.0 - 2 / 20)
    assert scores.idf1 == pytest.approx(0.5)


def test_a_pair_stays_while_it_is_within_reach() -> None:
    """Another track that comes nearer does not take over: that would be counted as a switch."""
    scores = clear_mot([moment({"a": 0.0}, {"1": 0.1}), moment({"a": 0.0}, {"1": 0.4, "2": 0.0})], 0.5)
    assert (scores.switches, scores.false) == (0, 1)


def test_a_name_kept_through_a_gap_is_no_switch_but_a_fragment() -> None:
    truth = {"a": 0.0}
    scores = clear_mot([moment(truth, {"1": 0.0}), moment(truth, {}), moment(truth, {"1": 0.0})], 0.5)
    assert (scores.switches, scores.fragments, scores.misses) == (0, 1, 1)


def test_nobody_there_and_nothing_told() -> None:
    scores = clear_mot([moment({}, {})], 0.5)
    assert scores.truths == 0
    assert np.isnan(scores.error)
