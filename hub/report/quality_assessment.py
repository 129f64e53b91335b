"""The verdict on a calibration: what is good, what isn't, and what to do about it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from hub.report import measures
from hub.report.measures import Usage
from hub.report.remedies import remedy_for
from hub.report.svg import THIN, number, short
from protocols.core.errors import Refused
from protocols.session.calibration import Calibration, CameraCalibration, PairReport
from protocols.session.observations import Observations
from protocols.session.rig import Rig

Level = Literal["good", "note", "attention"]

INTERVAL_95 = 1.96
"""Standard deviations to either side that hold 95 % of a normal distribution."""

_EXACT_MS = 2.0  # half a 95 % interval that is good whatever the frame rate
_GOOD_SHARE_OF_FRAME, _POOR_SHARE_OF_FRAME = 0.05, 0.25
_SLOW_PPM, _WRONG_PPM = 300.0, 2000.0  # crystals drift by 50 ppm; nominal frame rates lie by 1000
_WRONG_RATE_PPM = 10_000.0  # and these are no clocks but frame numbers
_GOOD_PX_AT_1920 = 1.5
_LENS_SHARE = 0.4  # of the squared residuals that the place in the image explains
_FEW_ROWS, _VERY_FEW_ROWS = 0.7, 0.5
_LITTLE_COVERAGE = 0.25
UNIT_WORDS = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
_GOOD_PATH, _POOR_PATH = 0.97, 0.9


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was judged. todo: what to do about it, "" where nothing need be done."""

    level: Level
    text: str
    todo: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The headline, its level ("good", "attention" or "refused"), a sentence, and the findings in order."""

    level: Literal["good", "attention", "refused"]
    headline: str
    summary: str
    findings: tuple[Finding, ...]

    def of(self, level: Level) -> list[Finding]:
        """The findings of one level."""
        return [finding for finding in self.findings if finding.level == level]

    @property
    def todo(self) -> list[str]:
        """What to do, most urgent first, each once."""
        ordered = [*self.of("attention"), *self.of("note"), *self.of("good")]
        return list(dict.fromkeys(finding.todo for finding in ordered if finding.todo))


def judge(calibration: Calibration, rig: Rig, observations: Observations, used: dict[str, Usage]) -> Verdict:
    """The verdict on a solved session."""
    findings: list[Finding] = []
    findings += _cameras(calibration, rig)
    findings += _timing(calibration, rig, used)
    findings += _rates(calibration, rig)
    findings += _pixels(calibration, used)
    findings += _pairs(calibration)
    findings += _image(used)
    findings += _path(calibration, observations)
    findings += _scale(calibration)
    findings += [Finding("attention", _sentence(text), _warning_todo(text)) for text in calibration.warnings]
    findings += [Finding("note", _sentence(text)) for text in observations.warnings]
    count, total = len(calibration.cameras), len(calibration.cameras) + len(calibration.refused)
    troubled = any(finding.level == "attention" for finding in findings)
    solved = f"all {count} cameras" if count == total else f"{count} of {total} cameras"
    return Verdict(
        level="attention" if troubled else "good",
        headline=f"Usable with care: {solved} calibrated" if troubled else f"Good: {solved} calibrated",
        summary="Timing and poses were found, but look at the points marked “!” before you rely on them."
        if troubled
        else "Timing and poses are consistent with everything that the cameras saw.",
        findings=tuple(findings),
    )


def judge_refusal(refused: Refused, rig: Rig) -> Verdict:
    """The verdict where no two cameras could be tied together."""
    findings = [Finding("attention", _sentence(refused.reason), remedy_for(refused.reason))]
    for name in rig.cameras:
        if name in refused.cameras:
            reason = refused.cameras[name]
            findings.append(Finding("attention", f"{name}: {reason}.", remedy_for(reason)))
    findings += [Finding("attention", _sentence(text), _warning_todo(text)) for text in refused.warnings]
    return Verdict(
        "refused",
        "Refused: there is no trustworthy answer in this session",
        "No calibration was written: a wrong one would be worse than none. Here is why, and what to change.",
        tuple(findings),
    )


def half_interval_ms(camera: CameraCalibration) -> float:
    """Half the 95 % interval of a camera's time offset [ms]."""
    return 1e3 * INTERVAL_95 * camera.time_offset_std


def _ppm(camera: CameraCalibration) -> float:
    return 1e6 * (camera.time_map.clock_rate - 1.0)


def contradicts(outcome: Calibration | Refused, pair: PairReport) -> bool:
    """Whether the pair was set aside because the others contradict it."""
    names = {f"{pair.cameras[0]}–{pair.cameras[1]}", f"{pair.cameras[1]}–{pair.cameras[0]}"}
    return any("contradicts" in text and any(name in text for name in names) for text in outcome.warnings)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:].rstrip(".") + ("" if text.endswith("?") else ".")


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def _cameras(calibration: Calibration, rig: Rig) -> list[Finding]:
    if not calibration.refused:
        return [Finding("good", f"Every camera could be tied in: {_listed(list(calibration.cameras))}.")]
    return [
        Finding("attention", f"{name} was refused: {reason.rstrip('.')}.", f"{name}: {remedy_for(reason)}")
        for name, reason in calibration.refused.items()
    ]


def _timing(calibration: Calibration, rig: Rig, used: dict[str, Usage]) -> list[Finding]:
    if rig.shared_clock:
        return [Finding("good", "The cameras share one clock, as the rig says: no offsets were sought.")]
    others = [camera for name, camera in calibration.cameras.items() if name != calibration.reference]
    # A clock at an impossible rate is told of below; its interval means nothing.
    sane = [camera for camera in others if abs(_ppm(camera)) <= _WRONG_PPM]
    out: list[Finding] = []
    worst = 0.0
    for camera in sane:
        half, interval = half_interval_ms(camera), 1e3 * used[camera.name].interval
        if half <= max(_EXACT_MS, _GOOD_SHARE_OF_FRAME * interval):
            worst = max(worst, half)
            continue
        poor = interval <= 0 or half > _POOR_SHARE_OF_FRAME * interval
        of_frame = f", {100 * half / interval:.0f} % of a frame" if interval > 0 else ""
        out.append(
            Finding(
                "attention" if poor else "note",
                f"{camera.name} fires within ±{THIN}{short(half, figures=2)}{THIN}ms of what is told "
                f"(95{THIN}%){of_frame}: that is not sharp.",
                f"{camera.name}: record longer while the point moves fast and changes direction in its view.",
            )
        )
    if not out and sane:
        who = "Clocks are" if len(sane) == len(others) else "The other clocks are"
        told = f"{who} known to ±{THIN}{short(worst, figures=2)}{THIN}ms or better (95{THIN}%)."
        out.append(Finding("good", told))
    return out


def _rates(calibration: Calibration, rig: Rig) -> list[Finding]:
    if rig.shared_clock:
        return []
    out = []
    for name, camera in calibration.cameras.items():
        ppm = _ppm(camera)
        if abs(ppm) > _WRONG_RATE_PPM:
            continue  # a warning of the solver tells it
        if abs(ppm) > _WRONG_PPM:
            out.append(
                Finding(
                    "attention",
                    f"{name}’s clock runs {number(ppm, 0, sign=True)}{THIN}ppm against {calibration.reference}’s: "
                    "hardly a clock does that.",
                    f"{name}: check its fps and that its times are those of capture; if they are, record longer.",
                )
            )
        elif abs(ppm) > _SLOW_PPM:
            out.append(
                Finding(
                    "note",
                    f"{name}’s clock runs {number(ppm, 0, sign=True)}{THIN}ppm against {calibration.reference}’s "
                    f"({short(abs(ppm) * 0.06, figures=2)}{THIN}ms a minute): its nominal frame rate is a little off. "
                    "The answer allows for it.",
                )
            )
    return out


def _pixels(calibration: Calibration, used: dict[str, Usage]) -> list[Finding]:
    out: list[Finding] = []
    fine = []
    for name, camera in calibration.cameras.items():
        lens = camera.intrinsics
        limit = max(1.0, _GOOD_PX_AT_1920 * max(lens.width, lens.height) / 1920)
        rms = f"{number(camera.rms_px, 2)}{THIN}px"
        if camera.rms_px > limit:
            level: Level = "attention" if camera.rms_px > 2 * limit else "note"
            out.append(
                Finding(
                    level,
                    f"{name} leaves {rms} (up to {short(limit)} is usual): "
                    "detections, lens or frame times are less exact.",
                    f"{name}: see its residual map; where arrows agree, renew its lens with `syncline intrinsics`; "
                    "where they don’t, the detections scatter.",
                )
            )
        else:
            fine.append(camera.rms_px)
        residuals = calibration.residuals.get(name)
        if residuals is not None and len(residuals) > 100 and camera.rms_px > 0.5 * limit:
            share = measures.residual_bins(residuals, (lens.width, lens.height)).systematic
            if share > _LENS_SHARE:
                out.append(
                    Finding(
                        "note",
                        f"In {name}, {100 * share:.0f} % of the squared residuals depend on the place in the image: "
                        "the lens model is not quite right.",
                        f"{name}: measure its lens with `syncline intrinsics`.",
                    )
                )
        rows = used[name]
        if rows.total and rows.share < _FEW_ROWS:
            out.append(
                Finding(
                    "attention" if rows.share < _VERY_FEW_ROWS else "note",
                    f"{name}: only {100 * rows.share:.0f} % of its rows fit one path; "
                    "the rest are false detections or other points.",
                    f"{name}: teach or mask the detector so that it sees the one point only.",
                )
            )
    if fine:
        texts = f"{number(min(fine), 2)} to {number(max(fine), 2)}" if len(fine) > 1 else number(fine[0], 2)
        who = "All cameras fit" if len(fine) == len(calibration.cameras) else "The other cameras fit"
        out.insert(0, Finding("good", f"{who} within a pixel or so: {texts}{THIN}px (root mean square)."))
    return out


def _pairs(calibration: Calibration) -> list[Finding]:
    names = list(calibration.cameras)
    good = [p for p in calibration.pairs if p.status == "ok" and not contradicts(calibration, p)]
    good = [p for p in good if p.cameras[0] in names and p.cameras[1] in names]
    if not good:
        return []
    tried = len([p for p in calibration.pairs if p.cameras[0] in names and p.cameras[1] in names])
    out = []
    alone = [name for name in names if sum(name in p.cameras for p in good) == 1] if len(names) > 2 else []
    if alone:
        is_tied, it, ties = ("is", "it", "that tie") if len(alone) == 1 else ("are", "each", "those ties")
        out.append(
            Finding(
                "note",
                f"{_listed(alone)} {is_tied} tied in through one pair{' each' if it == 'each' else ''} only "
                f"({len(good)} of {tried} pairs agree): no other pair checks {ties}.",
                f"Move the point where {_listed(alone)} see{'s' if it == 'it' else ''} it "
                "together with more of the others.",
            )
        )
    if len(names) == 2:
        out.append(Finding("note", "Two cameras make one pair: no third camera checks it."))
    elif not out:
        out.append(Finding("good", f"{len(good)} of {tried} pairs agree, and every camera is in two or more of them."))
    return out


def _image(used: dict[str, Usage]) -> list[Finding]:
    little = {name: rows for name, rows in used.items() if rows.used and rows.coverage < _LITTLE_COVERAGE}
    out = []
    for name, rows in little.items():
        where = measures.empty_regions(rows.covered)
        aim = f": nothing at the {_listed(where[:4])}" if where else ""
        out.append(
            Finding(
                "note",
                f"{name} saw the point in {100 * rows.coverage:.0f} % of its image only{aim}.",
                "Move the point through more of the image of " + _listed(list(little)) + ".",
            )
        )
    if not out and used:
        least = min(rows.coverage for rows in used.values())
        out.append(Finding("good", f"The point passed through {100 * least:.0f} % or more of every image."))
    return out


def _path(calibration: Calibration, observations: Observations) -> list[Finding]:
    share, seconds = measures.path_share(calibration, observations)
    if seconds <= 0:
        return []
    time = f"the {short(seconds)}{THIN}s" if len(observations.labels) < 2 else "the time"
    text = f"The 3-D path covers {100 * share:.0f} % of {time} in which two cameras saw a point."
    level: Level = "good" if share >= _GOOD_PATH else "note" if share >= _POOR_PATH else "attention"
    todo = (
        ""
        if level == "good"
        else "Look at the time line: where two cameras see the point without a path, one of them errs."
    )
    return [Finding(level, text, todo)]


def _scale(calibration: Calibration) -> list[Finding]:
    if calibration.scale == "metric":
        return [Finding("good", f"Lengths are real: the rig’s references fix the scale, in {calibration.units}.")]
    names = list(calibration.cameras)
    return [
        Finding(
            "note",
            f"The scale is arbitrary: the distance from {names[0]} to {names[1]} counts as 1. "
            "Timing does not depend on it.",
            f"For lengths in {UNIT_WORDS.get(calibration.units, calibration.units)}: measure one distance between "
            "two lenses and add "
            f'`distances = [["{names[0]}", "{names[1]}", 3.42]]` under `[metadata]` in rig.toml (or give positions).',
        )
    ]


def _warning_todo(text: str) -> str:
    if "were they made with" in text:
        name = text.split(":")[0]
        return (
            f"{name}: make its times again with the true frame rate, or use them with the clock_rate of "
            "calibration.toml: the answer allows for it."
        )
    match = re.search(r"pair (\S+)–(\S+) contradicts", text)
    if match is None:
        return ""
    return f"Check that {match[1]} and {match[2]} followed the same point, and record longer while both see it."
