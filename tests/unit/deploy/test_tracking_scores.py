"""Scores of tracks by TrackEval: the same as the project's own where it has them; the truth's file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from deploy.evaluation.clear_mot import EvaluationFrame, clear_mot
from deploy.evaluation.track_scores import score
from deploy.evaluation.tracking_scores import (
    GroundTruth,
    check_area,
    check_level,
    other_frame,
    parse_area,
    read_ground_truth,
    score_tracks,
)
from deploy.offline.track import TrackedFrame
from edge.uav.base import Estimate, TrackState
from protocols.core.errors import InputError
from protocols.geometry.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    id: int
    times: Floats
    position: Floats


def walk(seed: int) -> tuple[GroundTruth, list[Track], Floats]:
    """Six people in a small square, and tracks with noise, gaps, exchanged identities and a ghost."""
    rng = np.random.default_rng(seed)
    times = np.arange(40) * 0.5
    paths = np.cumsum(rng.normal(0.0, 0.15, (6, 40, 2)), axis=1) + rng.uniform(0.0, 3.0, (6, 1, 2))
    person = np.repeat(np.arange(6), 40)
    truth = GroundTruth(np.tile(times, 6), person, paths.reshape(-1, 2))
    found = paths + rng.normal(0.0, 0.15, paths.shape)
    found[0, 20:], found[1, 20:] = found[1, 20:].copy(), found[0, 20:].copy()
    tracks = []
    for index in range(6):
        kept = rng.random(40) > 0.15
        tracks.append(Track(index + 1, times[kept], np.column_stack([found[index][kept], np.zeros(kept.sum())])))
    tracks.append(Track(9, times[5:25], np.column_stack([rng.uniform(0.0, 3.0, (20, 2)), np.zeros(20)])))
    return truth, tracks, times


@pytest.mark.parametrize("seed", range(4))
def test_the_projects_own_scores_agree_with_trackeval(seed: int) -> None:
    truth, tracks, times = walk(seed)
    frames = []
    for time in times:
        here = truth.select(truth.time == time)
        there = [(track, track.position[track.times == time, :2]) for track in tracks if (track.times == time).any()]
        frames.append(
            EvaluationFrame(
                tuple(map(str, here.person)),
                here.place,
                tuple(str(track.id) for track, _ in there),
                np.concatenate([place for _, place in there]),
            )
        )
    own = clear_mot(frames, 0.5)
    scores = score_tracks(truth, tracks, times.tolist(), 1.0)
    assert scores["idf1"] == pytest.approx(own.idf1)
    assert scores["mota"] == pytest.approx(own.mota)
    for key in ("truths", "matches", "misses", "false", "switches"):
        assert scores[key] == getattr(own, key), key
    assert scores["error"] == pytest.approx(own.error)
    assert own.switches > 1


def test_perfect_tracks_score_one_in_any_unit() -> None:
    truth, _, times = walk(0)
    tracks = [
        Track(int(p), times, np.column_stack([truth.place[truth.person == p], np.zeros(len(times))])) for p in range(6)
    ]
    scores = score_tracks(truth, tracks, times.tolist(), 100.0)
    assert [scores[name] for name in ("moda", "mota", "idf1", "hota")] == pytest.approx([1.0] * 4)


def test_tracks_are_interpolated_to_the_truth_and_not_across_gaps() -> None:
    times = np.arange(0.0, 10.0, 0.5)
    track = Track(1, np.r_[times[:5], times[12:]], np.column_stack([np.r_[times[:5], times[12:]], *np.zeros((2, 13))]))
    moments = np.arange(0.25, 9.5, 0.5)
    truth = GroundTruth(moments, np.zeros(len(moments), np.int64), np.column_stack([moments, np.zeros(len(moments))]))
    scores = score_tracks(truth, [track], times.tolist(), 1.0)
    assert scores["misses"] == 6  # 2.75 to 5.25 s: farther than half a step from both ends of the gap
    assert scores["false"] == 0


@pytest.mark.parametrize(
    ("time", "x", "y", "words"),
    [
        (0.0, (1000.0, 0.0, 0.0), (0.0, 1000.0, 0.0), "times 0.001;"),
        (0.0, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), "with the sign of y changed, turned by 90 degrees;"),
        (0.0, (0.0, -1.0, 3.0), (1.0, 0.0, 0.0), "turned by -90 degrees, shifted by "),
        (2.0, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), "2.0 s earlier;"),
    ],
)
def test_a_truth_in_another_world_unit_or_time_is_named(
    time: float, x: tuple[float, ...], y: tuple[float, ...], words: str
) -> None:
    """All of them were scored, down to a MODA of -1."""
    _, _, times = walk(0)
    when = times / times[-1]
    paths = [np.column_stack([4.0 * np.sin(5.0 * when + k), (k - 1.5) * 4.0 * when + k * when**2]) for k in range(4)]
    tracks = [Track(k, times, np.column_stack([paths[k], np.zeros(len(times))])) for k in range(4)]
    rows = np.column_stack([np.concatenate(paths), np.ones(4 * len(times))])
    truth = GroundTruth(np.tile(times + time, 4), np.repeat(np.arange(4), len(times)), rows @ np.array([x, y]).T)
    with pytest.raises(InputError) as caught:
        score_tracks(truth, tracks, times.tolist(), 1.0)
    assert words in str(caught.value)


def test_poor_tracks_are_no_other_frame() -> None:
    truth, _, times = walk(1)
    others, tracks, _ = walk(2)
    assert score_tracks(truth, tracks, times.tolist(), 1.0)["misses"]
    assert other_frame(others, tracks[:2], times.tolist(), 1.0) == ""


@pytest.mark.parametrize(
    ("written", "words"),
    [
        (lambda x, y: (x - 30.0, y - 20.0), "x, y are the top left corner;"),
        (lambda x, y: (y, x), "x and y are swapped;"),
        (lambda x, y: (x / 640.0, y / 480.0), "x, y are fractions of width and height;"),
        (lambda x, y: (x, 479.0 - y), "y counts from the bottom;"),
        (lambda x, y: (3.0 * x, 3.0 * y), "pixels are of pictures 3 times as large;"),
    ],
)
def test_the_truth_of_an_image_track_in_another_convention_is_named(
    written: Callable[[float, float], tuple[float, float]], words: str
) -> None:
    """All of them were scored as a track that is never near its target."""
    places = [(100.0 + 8.0 * k, 300.0 - 4.0 * k + 0.1 * k * k) for k in range(40)]
    rows = [
        TrackedFrame(k, k / 30.0, Estimate(k / 30.0, TrackState.VISIBLE, x, y, 60.0, 40.0, 0.0, 1.0))
        for k, (x, y) in enumerate(places)
    ]
    absent = dict.fromkeys(("width", "height", "inside", "visible"), np.nan)
    truth = {k: absent | dict(zip("xy", places[k], strict=True)) for k in range(40)}
    assert score(rows, truth, (640, 480))["in_frame_20px"] == 1.0
    truth = {k: absent | dict(zip("xy", written(*places[k]), strict=True)) for k in range(40)}
    with pytest.raises(InputError) as caught:
        score(rows, truth, (640, 480))
    assert words in str(caught.value)
    lost = {k: absent | {"x": x + 100.0, "y": y} for k, (x, y) in enumerate(places)}
    assert score(rows, lost, (640, 480))["in_frame_20px"] == 0.0


@pytest.mark.parametrize(("up", "level"), [((0, 0, 1), True), ((0, 0.2, -0.98), True), ((0, 1, 0), False)])
def test_a_world_whose_z_is_not_vertical_has_no_ground_in_x_and_y(up: tuple[float, ...], level: bool) -> None:
    """With y up, tracks matched whoever was at their x, at any distance."""
    if level:
        check_level(np.array(up), Path("calibration.toml"))
        return
    with pytest.raises(InputError, match=r"vertical is \[0.00, 1.00, 0.00\].*whose z is up"):
        check_level(np.array(up, dtype=float), Path("calibration.toml"))


def test_nothing_counts_outside_the_area() -> None:
    truth = GroundTruth(np.zeros(2), np.arange(2), np.array([[0.0, 0.0], [50.0, 0.0]]))
    tracks = [Track(1, np.zeros(1), np.zeros((1, 3))), Track(2, np.zeros(1), np.array([[0.0, 30.0, 0.0]]))]
    scores = score_tracks(truth, tracks, [0.0], 1.0, parse_area("-3,9,-9,27"))
    assert (scores["truths"], scores["matches"], scores["false"]) == (1, 1, 0)
    with pytest.raises(InputError, match="--area"):
        parse_area("1,0,0,1")
    with pytest.raises(InputError, match="no person of the truth is in the area -300,-200,0,100"):
        check_area(truth, parse_area("-300,-200,0,100"))


def test_no_track_at_all_scores_nothing() -> None:
    truth, _, times = walk(0)
    scores = score_tracks(truth, [], times.tolist(), 1.0)
    assert (scores["mota"], scores["misses"]) == (0.0, 240)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "empty"),
        ("time,person,x\n0,a,1\n", "truth.csv:1: column y is missing"),
        ("time,person,x,y\n0,a,1,2\n1,a,nan,2\n", "truth.csv:3: x 'nan' is not a number"),
        ("time,person,x,y\n0,a,1,2\n0,a,1,3\n", "truth.csv:3: person 'a' is at two places at one time"),
        ("frame,person,x,y\n9,a,1,2\n", "truth.csv:2: frame 9 is none of the followed frames (0 to 1)"),
    ],
)
def test_a_bad_truth_is_named_with_its_line(text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_ground_truth(tmp_path / "truth.csv", {0: 0.0, 1: 0.5})
    assert what in str(caught.value)


def test_frames_become_times(tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text("frame,person,x,y,z\n1,a,1,2,0\n7,a,1,2,0\n", encoding="utf-8")
    truth = read_ground_truth(tmp_path / "truth.csv", {0: 10.0, 1: 10.5})
    assert truth.time.tolist() == [10.5]


def test_times_since_1970_are_times(tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text("time,person,x,y\n1755500000.1234567,a,1,2\n", encoding="utf-8")
    assert read_ground_truth(tmp_path / "truth.csv", None).time.tolist() == [1755500000.1234567]


def test_without_trackeval_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trackeval.metrics", None)
    truth, tracks, times = walk(0)
    with pytest.raises(InputError, match="pip install --no-deps trackeval"):
        score_tracks(truth, tracks, times.tolist(), 1.0)
