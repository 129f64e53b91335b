"""Acceptance tests of alignment hypotheses: each rejection names its cause, and the FAQ lists every kind of refusal."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hub
from hub.sync.acceptance import LIMITS, accept_or_reject
from hub.sync.hypothesis import PairFit
from hub.sync.settings import PairSettings
from hub.two_view.relative_pose import RelativePose

ROOT = Path(hub.__file__).parent

GOOD = PairFit(
    rate=1.0,
    offset=2.0,
    geometry=RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0])),
    residual_px=0.5,
    inliers=0.99,
    in_front=1.0,
    support=15.0,
    moving_overlap=15.2,
    mid_time=10.0,
    parallax=0.8,
    planar_residual_px=20.0,
    misfit=0.3,
    track_noise_px=0.5,
    log10_false_alarm=-9.0,
    log10_gap=-6.0,
)

REJECTED = {
    "of motion agree (of": replace(GOOD, support=1.0),
    "the best alignment leaves": replace(GOOD, residual_px=9.0),
    "needs a clock that is": replace(GOOD, rate=1.02),
    "puts points behind a camera": replace(GOOD, in_front=0.5),
    "lies in one plane": replace(GOOD, planar_residual_px=0.4),
    "of the common motion agrees with one geometry": replace(GOOD, inliers=0.4),
    "overlap too little": replace(GOOD, support=6.0, log10_false_alarm=None),
    "other lags fit nearly as well": replace(GOOD, support=6.0, log10_false_alarm=-0.5, log10_gap=0.0),
}

REFUSAL_KINDS = (
    "hardly moves while both could have seen it",
    "no label that both cameras saw",
    "overlap too little",
    "of motion agree",
    "other lags fit nearly as well",
    "two alignments are about as good",
    "of the common motion agrees with one geometry",
    "no alignment of the two tracks agrees with any geometry",
    "the best alignment leaves",
    "puts points behind a camera",
    "lies in one plane",
    "needs a clock that is",
    "the motion determines the lag only to",
    "the motion determines the relative rotation only to",
    "apart fit the motion equally well",
    "determines its orientation only to",
    "determines its clock only to",
    "from the lag of the epipolar geometry",
    "determines its focal length only to",
    "the tracks are discontinuous",
    "fit the trajectory seen by the other cameras",
    "agrees with no position",
    "too few connected observations",
    "could not be connected to any camera",
    "connected only to",
    "no intrinsics",
    "no observations",
    "one camera only",
    "fewer than two cameras",
    "rows of the same time and label",
    "contradict each other",
    "contradict the calibration",
    "frame rates differ",
)
"""Texts of refusals: each stands in the code, and in the table of the FAQ."""


@pytest.mark.parametrize("cause", REJECTED)
def test_a_rejection_names_its_cause(cause: str) -> None:
    assert accept_or_reject(("a", "b"), [GOOD], 20.0, PairSettings()).solved
    answer = accept_or_reject(("a", "b"), [REJECTED[cause]], 20.0, PairSettings())
    assert not answer.solved
    assert cause in answer.status


def test_two_equally_good_alignments_are_refused() -> None:
    rival = replace(GOOD, offset=5.0, support=14.8)
    answer = accept_or_reject(("a", "b"), [GOOD, rival], 20.0, PairSettings())
    assert not answer.solved
    assert answer.status == "two alignments are about as good (2.00 s and 5.00 s)"


def test_an_alignment_with_longer_support_competes_at_any_false_alarm_probability() -> None:
    longer = replace(GOOD, offset=5.0, support=19.0, log10_false_alarm=-4.0)
    answer = accept_or_reject(("a", "b"), [GOOD, longer], 20.0, PairSettings())
    assert answer.status == "two alignments are about as good (2.00 s and 5.00 s)"
    assert accept_or_reject(("a", "b"), [GOOD, replace(longer, support=14.0)], 20.0, PairSettings()).solved


def test_an_alignment_expected_by_chance_does_not_compete() -> None:
    """Three seconds in common, and another alignment with half the support that most unrelated stretches beat."""
    best = replace(GOOD, support=2.9, moving_overlap=2.9, inliers=1.0, log10_false_alarm=-3.2)
    usual = replace(best, offset=8.0, support=1.6, moving_overlap=1.6, log10_false_alarm=-0.25)
    assert accept_or_reject(("a", "b"), [best, usual], 15.0, PairSettings()).solved
    refused = [
        accept_or_reject(
            ("a", "b"), [best, replace(usual, log10_false_alarm=-1.5)], 15.0, PairSettings()
        ),  # rare by chance
        accept_or_reject(("a", "b"), [best, usual], 1.5, PairSettings()),  # few lags were searched
        accept_or_reject(
            ("a", "b"),
            [replace(best, log10_false_alarm=-2.6), replace(usual, log10_false_alarm=-0.7)],
            15.0,
            PairSettings(),
        ),
        accept_or_reject(("a", "b"), [best, replace(usual, support=3.0, moving_overlap=3.0)], 15.0, PairSettings()),
    ]
    assert [answer.status[:14] for answer in refused] == 4 * ["two alignments"]


def test_every_kind_of_refusal_is_in_the_code_and_in_the_faq() -> None:
    code = "\n".join(path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py"))
    table = "\n".join(
        line
        for line in (ROOT.parent / "docs" / "guide" / "faq.md").read_text(encoding="utf-8").splitlines()
        if line.startswith("|")
    )
    for cause in REFUSAL_KINDS:
        assert cause in code, cause
        assert cause in table, cause


def test_the_table_contains_every_refusal_of_a_pair() -> None:
    files = [ROOT / "sync" / name for name in ("pair_solver.py", "final_refinement.py", "acceptance.py")]
    text = "".join(path.read_text(encoding="utf-8") for path in files)
    texts = re.findall(r'(?:PairSolution\(\*names, |\n {4,}\w+ = \(?\s*)f?"([a-z][^"]{20,})"', text)
    no_reasons = {*LIMITS, "measured: python -m tests.bench.pair_timing", "unique maximum with a precise lag"}
    no_reasons |= {"unique at the noise floor", "residual at the noise floor"}
    reasons = [text for text in texts if text not in no_reasons]
    assert len(reasons) > 12
    for reason in reasons:
        assert any(re.sub(r"\{[^}]*\}", "", cause)[:15] in reason or cause in reason for cause in REFUSAL_KINDS), reason
