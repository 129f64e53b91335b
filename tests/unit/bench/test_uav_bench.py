"""Scores of the UAV bench on constructed estimates, and the files that `simulate town` writes."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.cli import run
from edge.uav.base import Box, Estimate, Hypothesis, Telemetry, TrackState
from edge.uav.world import scenarios
from edge.uav.world.flight_world import FlightWorld, GroundTruth
from protocols.core.errors import EXIT_DONE
from protocols.geometry.types import Floats, Image
from protocols.session.rig import read_rig
from tests.bench import real_rigs, uav_aerial
from tests.bench.uav_scoring import Score, score
from tests.bench.uav_tracker import CASES, ROWS, fly, table

OUT = 20
SIZE = (640, 480)


@cache
def world() -> FlightWorld:
    return scenarios.get("exit-bend", 3, SIZE, OUT)


@cache
def truths() -> tuple[GroundTruth, ...]:
    return tuple(world().truth(i) for i in range(world().length))


def perfect() -> list[Estimate]:
    """The truth, reported visible wherever any of it is in the image."""
    out = []
    for t in truths():
        state = TrackState.VISIBLE if t.inside > 0 else TrackState.COASTING
        out.append(Estimate(t.time, state, t.x, t.y, t.width, t.height, t.heading, 5.0))
    return out


def scored(change: dict[int, dict[str, object]]) -> Score:
    """The score of perfect estimates with some frames changed."""
    estimates = perfect()
    for i, fields in change.items():
        estimates[i] = dataclasses.replace(estimates[i], **fields)  # type: ignore[arg-type]
    return score(truths(), estimates, SIZE)


def moved(dx: float, frames: range) -> dict[int, dict[str, object]]:
    return {i: {"x": truths()[i].x + dx} for i in frames}


def test_the_truth_scores_full() -> None:
    s = scored({})
    assert s.out_length == s.out_near == s.out_any == s.std_95 == (OUT, OUT)
    assert s.percent("in_near") == 100.0
    assert s.claims_out == (0, OUT - 2)
    assert s.percent("says_in") == 100.0
    assert (s.reacquired, s.delays, s.swaps) == ((1, 1), [0], 0)


def test_an_estimate_between_20_px_and_a_car_length_counts_as_such() -> None:
    begin, end = world().out_of_view
    s = scored(moved(30.0, range(begin, end)))
    assert s.out_length == (OUT, OUT)
    assert s.out_near == (0, OUT)
    assert s.std_95 == (0, OUT)
    assert scored(moved(60.0, range(begin, end))).out_length == (0, OUT)


def test_a_hypothesis_may_be_right_where_the_best_is_not() -> None:
    begin, end = world().out_of_view
    change = moved(200.0, range(begin, end))
    for i in change:
        change[i]["hypotheses"] = (Hypothesis(0.3, truths()[i].x, truths()[i].y),)
    s = scored(change)
    assert s.out_length == (0, OUT)
    assert s.out_any == (OUT, OUT)


def test_claims_count_from_the_third_frame_of_an_exit_on() -> None:
    begin, end = world().out_of_view
    assert scored({i: {"state": TrackState.VISIBLE} for i in (begin, begin + 1)}).claims_out == (0, OUT - 2)
    assert scored({i: {"state": TrackState.VISIBLE} for i in range(begin, end)}).claims_out == (OUT - 2, OUT - 2)


def test_lost_is_wrong_wherever_it_is_but_claims_nothing() -> None:
    begin, _ = world().out_of_view
    lost = {"state": TrackState.LOST, "x": math.nan, "y": math.nan}
    s = scored(dict.fromkeys(range(begin, len(truths())), lost))
    assert s.out_length == (0, OUT)
    assert s.claims_out == (0, OUT - 2)
    assert s.reacquired == (0, 1)
    assert s.percent("in_near") < 80.0


def test_a_late_reacquisition_has_its_delay_and_a_later_one_is_none() -> None:
    _, end = world().out_of_view
    half = next(i for i in range(end, len(truths())) if truths()[i].visible >= 0.5)
    late = scored(moved(100.0, range(end, half + 7)))
    assert (late.reacquired, late.delays) == ((1, 1), [7])
    flicker = moved(100.0, range(half, half + 7)) | moved(100.0, range(half + 10, half + 12))
    assert scored(flicker).delays == [12], "four frames running are not five"
    assert scored(moved(100.0, range(end, half + 62))).reacquired == (0, 1)


def test_following_another_car_is_a_swap() -> None:
    frames = [i for i, t in enumerate(truths()) if t.inside == 1.0 and len(t.others)]
    run = next(i for i in frames if all(k in frames and _distant_car(k) is not None for k in range(i, i + 6)))
    onto: dict[int, dict[str, object]] = {}
    for i in range(run, run + 6):
        other = _distant_car(i)
        assert other is not None
        onto[i] = {"x": float(other[0]), "y": float(other[1])}
    assert scored(onto).swaps == 1
    first = dict(list(onto.items())[:4])
    assert scored(first).swaps == 0, "four frames are a slip"


def _distant_car(i: int) -> Floats | None:
    """A car in frame ``i`` more than 45 px from the target."""
    t = truths()[i]
    for other in t.others:
        if np.hypot(*(other - [t.x, t.y])) > 45.0:
            return np.asarray(other)
    return None


class RecordingTracker:
    """A tracker that records the times of its inputs, and may fail at a frame."""

    def __init__(self, fails_at: int = -1) -> None:
        self.given: list[tuple[str, float]] = []
        self._fails_at = fails_at
        self._box = Box(0.0, 0.0, 1.0, 1.0)

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        self._box = target
        return self.handle_frame(image, time)

    def handle_telemetry(self, sample: Telemetry) -> None:
        self.given.append(("telemetry", sample.time))

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        self.given.append(("frame", time))
        if len([kind for kind, _ in self.given if kind == "frame"]) == self._fails_at:
            raise ValueError("no")
        x, y = self._box.x + 0.5 * self._box.width, self._box.y + 0.5 * self._box.height
        return Estimate(time, TrackState.VISIBLE, x, y, self._box.width, self._box.height, 0.0, 1.0)


def test_the_bench_gives_telemetry_as_it_arrives_and_counts_crashes() -> None:
    small = scenarios.get("exit-straight", 1, (320, 240), 5)
    samples = small.telemetry(10.0, time_offset=0.4)
    records, fails = RecordingTracker(), RecordingTracker(fails_at=10)
    scores = fly(small, {"records": records, "fails": fails}, samples, 0.4)
    assert [time for kind, time in records.given if kind == "telemetry"] == [s.time for s in samples]
    assert [time for kind, time in records.given if kind == "frame"] == [small.time(i) for i in range(small.length)]
    now = -math.inf
    for kind, time in records.given:
        if kind == "frame":
            now = time
        else:
            assert time - 0.4 > now, "it would have arrived before the last frame"
    assert scores["records"].claims_out == (3, 3)
    assert scores["records"].frames == small.length - 1
    assert not scores["records"].failures
    assert "ValueError" in scores["fails"].failures[0]
    printed = table({(CASES[0], name): part for name, part in scores.items()}, ["records", "fails"])
    assert ROWS[0][0] in printed
    assert "ValueError" in printed


def test_simulate_writes_a_flight_that_can_be_read_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "flight"
    arguments = ["simulate", "town:exit-bend", "--frames", "20", "--size", "320x240", "--seed", "7", "--out", str(out)]
    assert run([*arguments, "--telemetry-hz", "10", "--json"]) == EXIT_DONE
    summary = json.loads(capsys.readouterr().out)
    flown = scenarios.get("exit-bend", 7, (320, 240), 20)

    capture = cv2.VideoCapture(str(out / "video.mp4"))
    found, first = capture.read()
    assert found
    assert cv2.PSNR(np.asarray(first, np.uint8), flown.render(0, noise=False)) > 28.0
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == flown.length == summary["frames"]
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)

    camera = read_rig(out / "rig.toml").cameras["drone"]
    assert camera.size == (320, 240)
    assert camera.body_from_camera == pytest.approx(flown.body_from_camera)
    assert camera.intrinsics is not None
    assert camera.intrinsics.matrix == pytest.approx(flown.lens.matrix)

    with (out / "truth.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    away = [int(row["frame"]) for row in rows if float(row["inside"]) == 0.0]
    assert [away[0], away[-1] + 1] == summary["out_of_picture"]
    assert float(rows[40]["x"]) == flown.truth(40).x

    with (out / "telemetry.csv").open(newline="") as lines:
        samples = list(csv.DictReader(lines))
    expected = flown.telemetry(10.0, time_offset=None)
    assert len(samples) == len(expected)
    w, x, y, z = (float(samples[9][key]) for key in ("qw", "qx", "qy", "qz"))
    forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    assert forward == pytest.approx(expected[9].ned_from_body[:, 0], abs=1e-12)
    assert float(samples[9]["time"]) == expected[9].time


@pytest.mark.parametrize(
    "options", [["town:atlantis"], ["town", "--cameras", "3"], ["town", "--size", "big"], ["marker", "--frames", "9"]]
)
def test_simulate_refuses_options_that_a_scene_does_not_use(options: list[str], tmp_path: Path) -> None:
    assert run(["simulate", *options, "--out", str(tmp_path / "x")]) == 2
    assert not (tmp_path / "x").exists()


def test_windows_of_the_real_video_are_cropped_with_black_beyond_it() -> None:
    image = np.arange(300 * 500 * 3, dtype=np.uint32).reshape(300, 500, 3).astype(np.uint8)
    inner = uav_aerial.crop(image, np.array([50.0, 60.0]))
    assert np.array_equal(inner, image[60 : 60 + 225, 50 : 50 + 400])
    beyond = uav_aerial.crop(image, np.array([-10.0, 200.0]))
    assert np.array_equal(beyond[:100, 10:], image[200:300, :390])
    assert not beyond[:, :10].any()
    assert not beyond[100:].any()


def test_real_windows_make_the_car_leave_and_come_back() -> None:
    folder = real_rigs.DEFAULT_DATA / uav_aerial.FOLDER
    if not folder.exists():
        pytest.skip(f"{folder} is absent")
    windows = uav_aerial.read_windows(folder)
    assert [window.car for window in windows] == ["car07", "car13", "car17", "car19"]
    for window in windows:
        low = np.maximum(window.box[:, :2], 0.0)
        high = np.minimum(window.box[:, :2] + window.box[:, 2:], np.array(uav_aerial.SIZE))
        share = np.maximum(high - low, 0.0).prod(axis=1) / window.box[:, 2:].prod(axis=1)
        assert share == pytest.approx(window.visible, abs=2e-3)
        assert (window.visible == 0.0).sum() > 20
        assert window.visible[[0, -1]] == pytest.approx(1.0)
