"""Each verdict on an alignment is reached by what it names, and every kind of refusal stands in the FAQ."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hub
from hub.sync.acceptance import judge
from hub.sync.alignment import PairFit, PairSettings
from hub.two_view.relative_pose import RelativePose

ROOT = Path(hub.__file__).parent

GOOD = PairFit(
    rate=1.0,
    offset=2.0,
    geometry=RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0])),
    cost=0.3,
    sigma_px=0.5,
    inliers=0.99,
    front=1.0,
    support=15.0,
    moving_overlap=15.2,
    middle=10.0,
    parallax=0.8,
    flat_px=20.0,
    misfit=0.3,
    own_px=0.5,
    log10_chance=-9.0,
    log10_gap=-6.0,
)

VERDICTS = {
    "of motion agree (of": replace(GOOD, support=1.0),
    "the best alignment leaves": replace(GOOD, sigma_px=9.0),
    "needs a clock that is": replace(GOOD, rate=1.02),
    "puts points behind a camera": replace(GOOD, front=0.5),
    "lies in one plane": replace(GOOD, flat_px=0.4),
    "of the common motion agrees with one geometry": replace(GOOD, inliers=0.4),
    "overlap too little": replace(GOOD, support=6.0, log10_chance=None),
    "other lags fit nearly as well": replace(GOOD, support=6.0, log10_chance=-0.5, log10_gap=0.0),
}

# What is told in the code → the words by which the FAQ's table names it.
TOLD = {
    "hardly moves while both could have seen it": "hardly moves",
    "no label that both cameras saw": "no label that both cameras saw",
    "overlap too little": "overlap too little",
    "of motion agree": "s of motion agree",
    "other lags fit nearly as well": "other lags fit nearly as well",
    "two alignments are about as good": "two alignments are about as good",
    "of the common motion agrees with one geometry": "agrees with one geometry",
    "no alignment of the two tracks agrees with any geometry": "agrees with any geometry",
    "the best alignment leaves": "the best alignment leaves",
    "puts points behind a camera": "points behind a camera",
    "lies in one plane": "lies in one plane",
    "needs a clock that is": "needs a clock that is",
    "the motion tells the lag only to": "tells the lag only to",
    "the motion tells the relative rotation only to": "rotation only to",
    "apart fit the motion alike": "rotations fit the motion alike",
    "tells its orientation only to": "orientation",
    "tells its clock only to": "clock only to",
    "apart from what epipolar lines tell": "apart from what epipolar lines tell",
    "tells its focal length only to": "focal length only to",
    "the tracks jump": "the tracks jump",
    "fit the path that the others see": "fit the path that the others see",
    "agrees with no position": "agrees with no position",
    "too few connected observations": "too few connected observations",
    "could not be tied to any camera": "could not be tied to any camera",
    "tied only to": "tied only to",
    "no intrinsics": "no intrinsics",
    "no observations": "no observations",
    "one camera only": "one camera only",
    "fewer than two cameras": "fewer than two cameras",
    "rows of the same time and label": "rows of the same time and label",
    "contradict each other": "contradict each other",
    "contradict the calibration": "contradict the calibration",
    "frame rates differ": "frame rates differ",
}


@pytest.mark.parametrize("told", VERDICTS)
def test_a_verdict_names_what_is_wrong(told: str) -> None:
    assert judge(("a", "b"), [GOOD], 20.0, PairSettings()).solved
    answer = judge(("a", "b"), [VERDICTS[told]], 20.0, PairSettings())
    assert not answer.solved
    assert told in answer.status


def test_two_alignments_alike_are_refused() -> None:
    rival = replace(GOOD, offset=5.0, support=14.8)
    answer = judge(("a", "b"), [GOOD, rival], 20.0, PairSettings())
    assert not answer.solved
    assert answer.status == "two alignments are about as good (2.00 s and 5.00 s)"


def test_what_fits_as_well_for_longer_is_a_rival_whatever_chance_says() -> None:
    longer = replace(GOOD, offset=5.0, support=19.0, log10_chance=-4.0)
    answer = judge(("a", "b"), [GOOD, longer], 20.0, PairSettings())
    assert answer.status == "two alignments are about as good (2.00 s and 5.00 s)"
    assert judge(("a", "b"), [GOOD, replace(longer, support=14.0)], 20.0, PairSettings()).solved


def test_what_chance_makes_in_every_search_is_no_rival() -> None:
    """Three seconds in common, and an alignment of half as much that most unrelated stretches beat."""
    best = replace(GOOD, support=2.9, moving_overlap=2.9, inliers=1.0, log10_chance=-3.2)
    usual = replace(best, offset=8.0, support=1.6, moving_overlap=1.6, log10_chance=-0.25)
    assert judge(("a", "b"), [best, usual], 15.0, PairSettings()).solved
    refused = [
        judge(("a", "b"), [best, replace(usual, log10_chance=-1.5)], 15.0, PairSettings()),  # chance makes few like it
        judge(("a", "b"), [best, usual], 1.5, PairSettings()),  # and few were looked at
        judge(("a", "b"), [replace(best, log10_chance=-2.6), replace(usual, log10_chance=-0.7)], 15.0, PairSettings()),
        judge(("a", "b"), [best, replace(usual, support=3.0, moving_overlap=3.0)], 15.0, PairSettings()),
    ]
    assert [answer.status[:14] for answer in refused] == 4 * ["two alignments"]


def test_every_kind_of_refusal_stands_in_the_code_and_in_the_faq() -> None:
    code = "\n".join(path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py"))
    table = "\n".join(
        line for line in (ROOT / "FAQ.md").read_text(encoding="utf-8").splitlines() if line.startswith("|")
    )
    for told, named in TOLD.items():
        assert told in code, told
        assert named in table, named


def test_no_verdict_of_a_pair_is_left_out() -> None:
    """Every sentence with which a pair is refused is one of the kinds above."""
    files = [ROOT / "timing" / name for name in ("pair.py", "finish.py", "verdict.py")]
    text = "".join(path.read_text(encoding="utf-8") for path in files)
    reasons = re.findall(r'(?:PairSolution\(\*names, |reason = \(?\s*|status=|return )f?"([a-z][^"]{20,})"', text)
    assert len(reasons) > 12
    for reason in reasons:
        assert any(re.sub(r"\{[^}]*\}", "", told)[:15] in reason or told in reason for told in TOLD), reason
