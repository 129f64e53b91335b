"""The report: correct quality assessment, offline page, deterministic output."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hub.report import build_report, measures
from hub.report.quality_assessment import assess_quality, assess_refusal, capital
from hub.report.svg import number, short, ticks
from hub.report.time_figures import adjustment_history
from hub.report.wording import remedy_for
from protocols.core.errors import Refused
from protocols.session.calibration import AdjustmentStep, Calibration
from protocols.session.observations import Observations
from tests.support.solved_session import REFUSED, solved_session

COMMAND = "syncline calibrate session --out out"


def without_library(page: str) -> str:
    """The page without plotly's own code."""
    return re.sub(r"<script>/\*\*\n\* plotly\.js.*?</script>", "", page, flags=re.DOTALL)


def findings(calibration: Calibration, level: str) -> str:
    """The findings of one level of a calibration."""
    _, rig, observations = solved_session()
    used = measures.row_usage(calibration, rig, observations)
    assessment = assess_quality(calibration, rig, observations, used)
    return "\n".join(finding.text for finding in assessment.findings if finding.level == level)


def test_the_quality_assessment_comes_first_and_names_the_problems() -> None:
    page = without_library(build_report(*solved_session(), COMMAND))
    first = page.index("<section")
    assert page[first:].startswith(
        '<section class="assessment attention"><h1>Usable with care: 3 of 4 cameras calibrated'
    )
    assessment = page[first : page.index("</section>")]
    assert "cam3 was refused" in assessment
    assert "distances = [[&quot;cam0&quot;, &quot;cam1&quot;, 3.42]]" in assessment


@pytest.mark.parametrize(("given", "shown"), [("cam0: it was moved", "cam0: it was moved"), ("no pair", "No pair")])
def test_names_of_cameras_are_not_capitalised(given: str, shown: str) -> None:
    assert capital(given) == shown


def test_the_report_contains_every_camera_pair_and_reason() -> None:
    page = build_report(*solved_session(), COMMAND)
    for text in ("cam0", "cam1", "cam2", "cam3", "cam0–cam1", "cam1–cam2", REFUSED, COMMAND):
        assert text in page, text


def test_the_report_loads_nothing_and_stays_small() -> None:
    page = build_report(*solved_session(), COMMAND)
    assert len(page.encode()) <= 6_000_000
    own = without_library(page)
    assert len(own.encode()) < 300_000
    assert "http" not in own.replace("http-equiv", "")
    assert not re.search(r"\b(src|href|action)\s*=|@import|url\(", own)
    assert "default-src 'none'" in own


def test_the_same_input_gives_the_same_bytes() -> None:
    assert build_report(*solved_session(), COMMAND) == build_report(*solved_session(), COMMAND)


def test_the_interval_is_196_standard_deviations() -> None:
    page = build_report(*solved_session(time_offset_std=0.0005), COMMAND)
    assert "± 0.98" in page
    assert "+3.250000" in page


def test_names_cannot_break_the_page() -> None:
    names = ("<b>&", "a'\"b", "</script><i>", "end")
    page = without_library(build_report(*solved_session(names=names), "syncline <&>"))
    for bad in ("<b>&<", "</script><i>", "<&>"):
        assert bad not in page
    assert page.count("</script>") == 1


def test_edges_are_distinguished_without_colour() -> None:
    calibration, rig, observations = solved_session()
    warning = "pair cam0–cam2 contradicts the other pairs and was rejected"
    page = build_report(replace(calibration, warnings=(warning,)), rig, observations)
    dashes = dict(re.findall(r"\.edge\.(\w+)\{[^}]*?stroke-dasharray:([\d ]+)", page))
    assert set(dashes) == {"contradicts", "refused"}
    assert dashes["contradicts"] != dashes["refused"]
    assert "≠ contradicts the others" in page
    graph = page[page.index('<div class="graph">') :]
    assert graph.index('class="edge contradicts"') > 0


def test_a_large_session_is_thinned() -> None:
    page = without_library(build_report(*solved_session(rows=60_000), COMMAND))
    assert len(page.encode()) < 600_000
    for polyline in re.findall(r'points="([^"]*)"', page):
        assert polyline.count(",") <= 3001


def test_a_refusal_says_why_and_what_to_do_for_every_camera() -> None:
    _, rig, observations = solved_session()
    reasons = {"cam0": "no observations", "cam1": "two alignments are about as good (0.01 s and -3.11 s)"}
    page = build_report(Refused("no pair of cameras could be synchronised", reasons), rig, observations, COMMAND)
    assert "<h1>Refused: there is no trustworthy result" in page
    assert "No pair of cameras could be synchronised." in page
    for name in rig.cameras:
        assert f"<b>{name}</b>" in page
    assert "whether its detector finds the point" in page
    assert len(page) < 300_000, "a refusal has no 3-D scene and needs no library"


def test_a_refusal_without_any_row_still_makes_a_page() -> None:
    _, rig, _ = solved_session()
    page = build_report(Refused("one camera only: a pair is needed"), rig, Observations({}))
    assert "add a second camera" in page.lower()


def test_good_data_is_assessed_as_good() -> None:
    calibration, rig, observations = solved_session(scale="metric")
    calibration = replace(calibration, refused={}, pairs=calibration.pairs[:-1])
    assessment = assess_quality(calibration, rig, observations, measures.row_usage(calibration, rig, observations))
    assert assessment.level == "good"
    assert assessment.headline == "Good: all 3 cameras calibrated"
    assert assessment.actions == []


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        ({"lag_std": 0.02}, "attention", "that is imprecise"),
        ({"lag_std": 0.0025}, "note", "that is imprecise"),
        ({"lag_std": 0.0004}, "good", "Clocks are known to"),
        ({"rms_px": 9.0}, "attention", "leaves 9.00"),
        ({"rms_px": 1.4}, "note", "leaves 1.40"),
        ({"rms_px": 0.4}, "good", "within about a pixel"),
    ],
)
def test_each_level_follows_from_the_figures(change: dict[str, Any], level: str, words: str) -> None:
    calibration, _, _ = solved_session()
    cameras = {name: replace(camera, **change) for name, camera in calibration.cameras.items()}
    assert words in findings(replace(calibration, cameras=cameras), level)


def test_an_impossible_clock_rate_needs_attention() -> None:
    calibration, _, _ = solved_session()
    wild = calibration.cameras["cam1"]
    wild = replace(wild, time_map=replace(wild.time_map, clock_rate=1.008))
    changed = replace(calibration, cameras={**calibration.cameras, "cam1": wild})
    assert "cam1’s clock runs +8000" in findings(changed, "attention")


def test_a_camera_connected_by_one_pair_only_is_reported() -> None:
    calibration, _, _ = solved_session()
    fewer = [pair for pair in calibration.pairs if set(pair.cameras) != {"cam1", "cam2"}]
    assert "cam1 and cam2 are connected through one pair each only" in findings(
        replace(calibration, pairs=tuple(fewer)), "note"
    )


def test_a_wrong_lens_shows_as_systematic_residuals_and_noise_does_not() -> None:
    random = np.random.default_rng(2)
    pixels = random.uniform(0, 720, (3000, 2))
    noise = random.normal(0, 0.4, (3000, 2))
    bent = 4e-3 * (pixels - 360)
    rows = np.column_stack([np.arange(3000.0), pixels, noise])
    assert measures.residual_bins(rows, (720, 720)).systematic < 0.02
    rows[:, 3:] += bent
    assert measures.residual_bins(rows, (720, 720)).systematic > 0.5


def test_shared_spans_need_two_cameras_at_once() -> None:
    seen = [[(0.0, 10.0)], [(5.0, 7.0), (12.0, 15.0)]]
    assert measures.shared_spans(seen, reach=0.0) == [(5.0, 7.0)]
    assert measures.shared_spans(seen, reach=0.2) == [(4.8, 7.2)]
    assert measures.shared_spans([[(0.0, 1.0)], [(1.3, 2.0)]], reach=0.2) == [(0.8 + 0.3, 1.2)]


def test_trajectory_coverage_refers_to_the_time_two_cameras_saw() -> None:
    calibration, _, observations = solved_session()
    whole, seconds = measures.trajectory_coverage(calibration, observations)
    assert seconds == pytest.approx(30.4, abs=0.1)
    assert whole > 0.97
    path = calibration.trajectories[0]
    half = replace(path, time=path.time[:200], position=path.position[:200], std=path.std[:200])
    assert measures.trajectory_coverage(replace(calibration, trajectories=(half,)), observations)[0] == pytest.approx(
        0.5, abs=0.02
    )


def test_up_is_estimated_from_level_cameras() -> None:
    calibration, rig, _ = solved_session()
    np.testing.assert_allclose(measures.estimate_up(calibration, rig), [0, 0, 1], atol=0.06)
    given = replace(rig, up="cam1")
    tilted = calibration.cameras["cam1"].pose.rotation.T @ [0, -1, 0]
    np.testing.assert_allclose(measures.estimate_up(calibration, given), tilted)


def test_each_reason_has_its_remedy() -> None:
    assert "syncline intrinsics" in remedy_for("no intrinsics (matrix and distortions in rig.toml)")
    assert "detector" in remedy_for("no observations")
    assert "record longer" in remedy_for("something new")
    assessment = assess_refusal(Refused("nothing moves", {"cam0": "no observations"}), solved_session()[1])
    assert len(assessment.actions) == 2


def test_numbers_are_formatted_for_reading() -> None:
    assert number(-1.5, 1) == "\u22121.5"
    assert number(-0.0001, 2, sign=True) == "0.00"
    assert number(float("nan")) == "–"
    assert [short(value) for value in (0.00123, 0.5, 12.3456, 12345.6)] == ["0.00123", "0.500", "12.3", "12346"]
    assert ticks(-0.9, 0.9, 4) == [-0.5, 0.0, 0.5]


def test_each_adjustment_step_has_a_marker_of_its_stage() -> None:
    stages = [("first poses", (8.0, 2.0, 0.7)), ("robust", (0.6, 0.5)), ("fitting rows", (0.55, 0.5, 0.5))]
    steps = tuple(AdjustmentStep(stage, residual) for stage, values in stages for residual in values)
    figure = adjustment_history(steps)
    assert figure.count("<circle") == 3
    assert figure.count("<rect") == 5
    assert figure.count("rotate(45") == 3, "diamonds are distinguished from squares"
    for name in ("cameras added", "all rows, robust", "inlier rows"):
        assert name in figure
    heights = [float(y) for y in re.findall(r'<circle[^>]* cy="([\d.]+)"', figure)]
    assert heights == sorted(heights), "a smaller residual is lower"
    assert adjustment_history(steps[:1]) == ""
    assert adjustment_history((AdjustmentStep("robust", float("nan")), AdjustmentStep("robust", 0.0))) == ""
