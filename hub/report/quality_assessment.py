"""Quality assessment of a calibration for the report: findings by severity, and recommended actions."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from hub.report import measures
from hub.report.measures import RowUsage
from hub.report.svg import THIN, number, short
from hub.report.wording import remedy_for
from protocols.core.acceptance import PairReport
from protocols.core.errors import Refused
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

Level = Literal["good", "note", "attention"]

INTERVAL_95 = 1.96
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""

_GOOD_MS = 2.0  # half of a 95 % interval that is good at any frame rate
_GOOD_SHARE_OF_FRAME, _POOR_SHARE_OF_FRAME = 0.05, 0.25  # of a frame interval: half a 95 % interval
_SLOW_PPM, _WRONG_PPM = 300.0, 2000.0  # crystals drift by 50 ppm; nominal frame rates are off by up to 1000
_WRONG_RATE_PPM = 10_000.0  # beyond this the times are frame numbers, not a clock
_GOOD_PX_AT_1920 = 1.5  # of detectors' noise and measured lenses; more is an error
_LENS_SHARE = 0.4  # of the squared residuals that the image position explains
_FEW_ROWS, _VERY_FEW_ROWS = 0.7, 0.5  # shares of a camera's rows that fit
_LITTLE_COVERAGE = 0.25  # of the image's cells
UNIT_WORDS = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
_GOOD_PATH, _POOR_PATH = 0.97, 0.9  # shares of the time that two cameras saw


@dataclass(frozen=True, slots=True)
class QualityFinding:
    """One finding of the assessment. action: what to do about it, "" = nothing."""

    level: Level
    text: str
    action: str = ""


@dataclass(frozen=True, slots=True)
class QualityAssessment:
    """Overall level ("good", "attention" or "refused"), headline, one-sentence summary, and findings in order."""

    level: Literal["good", "attention", "refused"]
    headline: str
    summary: str
    findings: tuple[QualityFinding, ...]

    def of(self, level: Level) -> list[QualityFinding]:
        """The findings of one level."""
        return [finding for finding in self.findings if finding.level == level]

    @property
    def actions(self) -> list[str]:
        """Recommended actions, most urgent first, without duplicates."""
        ordered = [*self.of("attention"), *self.of("note"), *self.of("good")]
        return list(dict.fromkeys(finding.action for finding in ordered if finding.action))


def assess_quality(
    calibration: Calibration, rig: Rig, observations: Observations, used: dict[str, RowUsage]
) -> QualityAssessment:
    """Assess a solved session."""
    findings: list[QualityFinding] = []
    findings += _cameras(calibration)
    findings += _timing(calibration, rig, used)
    findings += _rates(calibration, rig)
    findings += _pixels(calibration, used)
    findings += _pairs(calibration)
    findings += _image(used)
    findings += _path(calibration, observations)
    findings += _scale(calibration)
    findings += [QualityFinding("attention", _sentence(text), _warning_action(text)) for text in calibration.warnings]
    findings += [QualityFinding("note", _sentence(text)) for text in observations.warnings]
    count, total = len(calibration.cameras), len(calibration.cameras) + len(calibration.refused)
    troubled = any(finding.level == "attention" for finding in findings)
    solved = f"all {count} cameras" if count == total else f"{count} of {total} cameras"
    return QualityAssessment(
        level="attention" if troubled else "good",
        headline=f"Usable with care: {solved} calibrated" if troubled else f"Good: {solved} calibrated",
        summary="Timing and poses were estimated, but check what is marked “!” before you rely on them."
        if troubled
        else "Timing and poses are consistent with all observations.",
        findings=tuple(findings),
    )


def assess_refusal(refused: Refused, rig: Rig) -> QualityAssessment:
    """Assess a session in which no two cameras could be connected."""
    findings = [QualityFinding("attention", _sentence(refused.reason), remedy_for(refused.reason))]
    for name in rig.cameras:
        if name in refused.cameras:
            reason = refused.cameras[name]
            findings.append(QualityFinding("attention", f"{name}: {reason}.", remedy_for(reason)))
    findings += [QualityFinding("attention", _sentence(text), _warning_action(text)) for text in refused.warnings]
    return QualityAssessment(
        "refused",
        "Refused: there is no trustworthy result in this session",
        "No calibration was written, because it would not be reliable. The reasons and remedies are listed below.",
        tuple(findings),
    )


def half_interval_ms(camera: CameraCalibration) -> float:
    """Half the 95 % interval of a camera's time offset [ms]."""
    return 1e3 * INTERVAL_95 * camera.lag_std


def _ppm(camera: CameraCalibration) -> float:
    return 1e6 * (camera.time_map.clock_rate - 1.0)


def is_contradicting(outcome: Calibration | Refused, pair: PairReport) -> bool:
    """Whether the pair was rejected as an outlier, because the others contradict it."""
    names = {f"{pair.cameras[0]}–{pair.cameras[1]}", f"{pair.cameras[1]}–{pair.cameras[0]}"}
    return any("contradicts" in text and any(name in text for name in names) for text in outcome.warnings)


def capital(text: str) -> str:
    """The text with a capital first letter, unless it begins with the name of a camera."""
    return text if ":" in text.split(" ")[0] else text[:1].upper() + text[1:]


def _sentence(text: str) -> str:
    return capital(text).rstrip(".") + ("" if text.endswith("?") else ".")


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def _cameras(calibration: Calibration) -> list[QualityFinding]:
    if not calibration.refused:
        return [QualityFinding("good", f"Every camera is connected: {_listed(list(calibration.cameras))}.")]
    return [
        QualityFinding("attention", f"{name} was refused: {reason.rstrip('.')}.", f"{name}: {remedy_for(reason)}")
        for name, reason in calibration.refused.items()
    ]


def _timing(calibration: Calibration, rig: Rig, used: dict[str, RowUsage]) -> list[QualityFinding]:
    if rig.shared_clock:
        return [
            QualityFinding("good", "The cameras share one clock according to the rig: no time offsets were estimated.")
        ]
    others = [camera for name, camera in calibration.cameras.items() if name != calibration.reference]
    # A clock with an implausible rate is reported in `_rates`; its interval is meaningless.
    plausible = [camera for camera in others if abs(_ppm(camera)) <= _WRONG_PPM]
    out: list[QualityFinding] = []
    worst = 0.0
    for camera in plausible:
        half, interval = half_interval_ms(camera), 1e3 * used[camera.name].interval
        if half <= max(_GOOD_MS, _GOOD_SHARE_OF_FRAME * interval):
            worst = max(worst, half)
            continue
        poor = interval <= 0 or half > _POOR_SHARE_OF_FRAME * interval
        of_frame = f", {100 * half / interval:.0f} % of a frame" if interval > 0 else ""
        out.append(
            QualityFinding(
                "attention" if poor else "note",
                f"{camera.name}: the time offset is known to ±{THIN}{short(half, figures=2)}{THIN}ms only "
                f"(95{THIN}%){of_frame}: that is imprecise.",
                f"{camera.name}: record longer while the point moves fast and changes direction in its view.",
            )
        )
    if not out and plausible:
        subject = "Clocks are" if len(plausible) == len(others) else "The other clocks are"
        text = f"{subject} known to ±{THIN}{short(worst, figures=2)}{THIN}ms or better (95{THIN}%)."
        out.append(QualityFinding("good", text))
    return out


def _rates(calibration: Calibration, rig: Rig) -> list[QualityFinding]:
    if rig.shared_clock:
        return []
    out = []
    for name, camera in calibration.cameras.items():
        ppm = _ppm(camera)
        if abs(ppm) > _WRONG_RATE_PPM:
            continue  # reported by a warning of the solver
        if abs(ppm) > _WRONG_PPM:
            out.append(
                QualityFinding(
                    "attention",
                    f"{name}’s clock runs {number(ppm, 0, sign=True)}{THIN}ppm against {calibration.reference}’s: "
                    "implausible for a clock.",
                    f"{name}: check its fps and that its times are those of capture; if they are, record longer.",
                )
            )
        elif abs(ppm) > _SLOW_PPM:
            out.append(
                QualityFinding(
                    "note",
                    f"{name}’s clock runs {number(ppm, 0, sign=True)}{THIN}ppm against {calibration.reference}’s "
                    f"({short(abs(ppm) * 0.06, figures=2)}{THIN}ms a minute): its nominal frame rate is a little off. "
                    "The calibration accounts for it.",
                )
            )
    return out


def _pixels(calibration: Calibration, used: dict[str, RowUsage]) -> list[QualityFinding]:
    out: list[QualityFinding] = []
    fine = []
    for name, camera in calibration.cameras.items():
        lens = camera.intrinsics
        limit = max(1.0, _GOOD_PX_AT_1920 * max(lens.width, lens.height) / 1920)
        rms = f"{number(camera.rms_px, 2)}{THIN}px"
        if camera.rms_px > limit:
            level: Level = "attention" if camera.rms_px > 2 * limit else "note"
            out.append(
                QualityFinding(
                    level,
                    f"{name} leaves {rms} (up to {short(limit)} is usual): "
                    "detections, intrinsics or time stamps are inaccurate.",
                    f"{name}: see its residual map; where neighbouring arrows agree, calibrate its lens with "
                    "`syncline intrinsics`; where they do not, the detections are noisy.",
                )
            )
        else:
            fine.append(camera.rms_px)
        residuals = calibration.residuals.get(name)
        if residuals is not None and len(residuals) > 100 and camera.rms_px > 0.5 * limit:
            share = measures.residual_bins(residuals, (lens.width, lens.height)).systematic
            if share > _LENS_SHARE:
                out.append(
                    QualityFinding(
                        "note",
                        f"In {name}, {100 * share:.0f} % of the squared residuals depend on the position in the image: "
                        "the lens model is inaccurate.",
                        f"{name}: calibrate its lens with `syncline intrinsics`.",
                    )
                )
        rows = used[name]
        if rows.total and rows.share < _FEW_ROWS:
            out.append(
                QualityFinding(
                    "attention" if rows.share < _VERY_FEW_ROWS else "note",
                    f"{name}: only {100 * rows.share:.0f} % of its rows fit one trajectory; "
                    "the rest are false detections, other points, or from before or after it was moved.",
                    f"{name}: unless it was moved, train or mask the detector so that it detects only this point.",
                )
            )
    if fine:
        texts = f"{number(min(fine), 2)} to {number(max(fine), 2)}" if len(fine) > 1 else number(fine[0], 2)
        subject = "All cameras fit" if len(fine) == len(calibration.cameras) else "The other cameras fit"
        out.insert(0, QualityFinding("good", f"{subject} within about a pixel: {texts}{THIN}px (root mean square)."))
    return out


def _pairs(calibration: Calibration) -> list[QualityFinding]:
    names = list(calibration.cameras)
    good = [p for p in calibration.pairs if p.status == "ok" and not is_contradicting(calibration, p)]
    good = [p for p in good if p.cameras[0] in names and p.cameras[1] in names]
    if not good:
        return []
    tried = len([p for p in calibration.pairs if p.cameras[0] in names and p.cameras[1] in names])
    out = []
    single = [name for name in names if sum(name in p.cameras for p in good) == 1] if len(names) > 2 else []
    if single:
        verb, it, edges = ("is", "it", "this edge") if len(single) == 1 else ("are", "each", "these edges")
        out.append(
            QualityFinding(
                "note",
                f"{_listed(single)} {verb} connected through one pair{' each' if it == 'each' else ''} only "
                f"({len(good)} of {tried} pairs agree): no other pair checks {edges}.",
                f"Move the point where {_listed(single)} see{'s' if it == 'it' else ''} it "
                "together with more of the others.",
            )
        )
    if len(names) == 2:
        out.append(QualityFinding("note", "Two cameras make one pair: no third camera checks it."))
    elif not out:
        out.append(
            QualityFinding("good", f"{len(good)} of {tried} pairs agree, and every camera is in two or more of them.")
        )
    return out


def _image(used: dict[str, RowUsage]) -> list[QualityFinding]:
    little = {name: rows for name, rows in used.items() if rows.used and rows.coverage < _LITTLE_COVERAGE}
    out = []
    for name, rows in little.items():
        where = measures.empty_regions(rows.covered)
        aim = f": nothing at the {_listed(where[:4])}" if where else ""
        out.append(
            QualityFinding(
                "note",
                f"{name} saw the point in {100 * rows.coverage:.0f} % of its image only{aim}.",
                "Move the point through more of the image of " + _listed(list(little)) + ".",
            )
        )
    seen = [rows.coverage for rows in used.values() if rows.used]
    if not out and seen:
        out.append(QualityFinding("good", f"The point passed through {100 * min(seen):.0f} % or more of every image."))
    return out


def _path(calibration: Calibration, observations: Observations) -> list[QualityFinding]:
    share, seconds = measures.trajectory_coverage(calibration, observations)
    if seconds <= 0:
        return []
    time = f"the {short(seconds)}{THIN}s" if len(observations.labels) < 2 else "the time"
    text = f"The 3-D trajectory covers {100 * share:.0f} % of {time} in which two cameras saw a point."
    level: Level = "good" if share >= _GOOD_PATH else "note" if share >= _POOR_PATH else "attention"
    action = (
        ""
        if level == "good"
        else "Check the visibility: where two cameras see the point without a trajectory, one of them is wrong."
    )
    return [QualityFinding(level, text, action)]


def _scale(calibration: Calibration) -> list[QualityFinding]:
    if calibration.scale == "metric":
        return [
            QualityFinding(
                "good", f"The scale is metric: the rig’s control points or distances fix it, in {calibration.units}."
            )
        ]
    names = list(calibration.cameras)
    return [
        QualityFinding(
            "note",
            f"The scale is arbitrary: the distance from {names[0]} to {names[1]} counts as 1. "
            "Timing does not depend on it.",
            f"For lengths in {UNIT_WORDS.get(calibration.units, calibration.units)}: measure one distance between "
            "two lenses and add "
            f'`distances = [["{names[0]}", "{names[1]}", 3.42]]` under `[metadata]` in rig.toml (or give positions).',
        )
    ]


def _warning_action(text: str) -> str:
    if "were they made with" in text:
        name = text.split(":")[0]
        return (
            f"{name}: create its time stamps again with the true frame rate, or use them with the clock_rate of "
            "calibration.toml: the calibration accounts for it."
        )
    match = re.search(r"pair (\S+)–(\S+) contradicts", text)
    if match is None:
        return ""
    return f"Check that {match[1]} and {match[2]} detected the same point, and record longer while both see it."
