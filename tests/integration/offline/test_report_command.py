"""`syncline report`: from a folder of results, a session, a log; solved and refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from deploy.offline.report_input import load_report_input
from protocols.core.errors import InputError, Refused
from protocols.session.calibration import Calibration
from tests.support.command_line import refusal

SIZE_LIMIT = 6 * 1024 * 1024


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of 12 s and its results, beside it."""
    folder = tmp_path_factory.mktemp("report")
    session = str(folder / "session")
    assert run(["simulate", "marker", "--out", session, "--cameras", "2", "--seconds", "12", "--seed", "5"]) == 0
    assert run(["calibrate", session, "--out", str(folder / "out")]) == 0
    return folder


def test_a_report_made_again_has_the_same_content(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "again.html"
    capsys.readouterr()
    words = ["report", str(solved / "out"), "--session", str(solved / "session"), "--out", str(file)]
    assert run(words) == 0
    assert "all 2 cameras calibrated" in capsys.readouterr().out
    text, original = file.read_text(encoding="utf-8"), (solved / "out" / "report.html").read_text(encoding="utf-8")
    assert file.stat().st_size < SIZE_LIMIT
    for heading in ("Cameras", "Clock offsets", "Pairs", "Scene", "Residuals in the image", "Provenance"):
        assert (f"<h2>{heading}" in text) == (f"<h2>{heading}" in original)
        assert f"<h2>{heading}" in text
    assert text.split("<h1>")[1].split("</h1>")[0] == original.split("<h1>")[1].split("</h1>")[0]


def test_the_result_contains_its_convergence(solved: Path) -> None:
    answer = load_report_input(solved / "out", solved / "session", lambda text, share: None)
    assert isinstance(answer.outcome, Calibration)
    steps = answer.outcome.convergence
    assert {step.stage for step in steps} >= {"first poses", "robust", "fitting rows"}
    assert steps[-1].residual_px == pytest.approx(steps[-2].residual_px, rel=1e-3), "it has converged"
    rms = float(np.sqrt(np.mean([camera.rms_px**2 for camera in answer.outcome.cameras.values()])))
    assert steps[-1].residual_px == pytest.approx(rms / np.sqrt(2), rel=0.1), "of one coordinate"
    assert f"{len(steps)} steps of the adjustment" in (solved / "out" / "report.html").read_text(encoding="utf-8")


def test_recomputed_residuals_agree_with_the_rms_of_the_result(solved: Path) -> None:
    answer = load_report_input(solved / "out", solved / "session", lambda text, share: None)
    assert isinstance(answer.outcome, Calibration)
    document = json.loads((solved / "out" / "result.json").read_text(encoding="utf-8"))
    for name, camera in answer.outcome.cameras.items():
        residuals = answer.outcome.residuals[name]
        rms = float(np.sqrt((residuals[:, 3:] ** 2).sum(axis=1).mean()))
        assert rms == pytest.approx(camera.rms_px, rel=0.15)
        assert len(residuals) > 0.95 * document["cameras"][name]["rows_used"]


def test_without_the_session_the_rest_is_still_reported(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(solved / "out", tmp_path / "out")
    file = tmp_path / "out" / "result.json"
    file.write_text(file.read_text(encoding="utf-8").replace(str(solved / "session"), "gone"), encoding="utf-8")
    assert run(["report", str(tmp_path / "out"), "--json"]) == 0
    expected = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert expected["report"] == str(tmp_path / "out" / "report.html")
    assert (expected["level"], expected["attention"]) == ("good", []), "it says nothing about the result"
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "its session is not found" in text.lower()
    assert "passed through" not in text
    assert "<h2>Clock offsets" in text


def test_a_full_disk_costs_the_files_and_not_the_table(
    solved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(result: object, out: Path, command: str) -> None:
        raise InputError("cannot be written: No space left on device", file=out, remedy="free some space")

    monkeypatch.setattr("hub.api.CalibrationResult.save", full)
    capsys.readouterr()
    assert run(["calibrate", str(solved / "session"), "--out", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr()
    assert "cam1" in shown.out
    assert "written" not in shown.out
    assert "No space left" in shown.err


def test_what_to_check_is_printed(solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Results that are usable with care were, without a word of why."""
    shutil.copytree(solved / "out", tmp_path / "out")
    result = tmp_path / "out" / "result.json"
    document = json.loads(result.read_text(encoding="utf-8"))
    result.write_text(json.dumps(document | {"warnings": ["cam0: its measured lens is refuted"]}), encoding="utf-8")
    capsys.readouterr()
    assert run(["report", str(tmp_path / "out"), "--session", str(solved / "session")]) == 0
    output = capsys.readouterr().out
    assert "Usable with care" in output
    assert "check: cam0: its measured lens is refuted" in output


def test_a_refused_session_has_a_report_of_the_reasons(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = tmp_path / "short"
    session.mkdir()
    shutil.copy(solved / "session" / "rig.toml", session)
    lines = (solved / "session" / "observations.csv").read_text(encoding="utf-8").splitlines()
    (session / "observations.csv").write_text("\n".join(lines[:30]) + "\n", encoding="utf-8")
    file = tmp_path / "why.html"
    assert run(["report", str(session), "--out", str(file)]) == 0
    assert "Refused: there is no trustworthy result" in capsys.readouterr().out
    assert run(["calibrate", str(session), "--out", str(tmp_path / "out")]) == 3
    answer = load_report_input(tmp_path / "out", session, lambda text, share: None)
    assert isinstance(answer.outcome, Refused)


@pytest.mark.parametrize(
    ("content", "expected"),
    [("{", "is not JSON"), ('{"status": "ok"}', "is not a result of"), ("[" * 5000, "is not JSON")],
)
def test_invalid_results_are_named(
    content: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "result.json").write_text(content, encoding="utf-8")
    assert expected in refusal(capsys, ["report", str(tmp_path)])


def test_bad_arguments_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["report", str(tmp_path / "nowhere")]) == 2
    assert "there is no such file or folder" in capsys.readouterr().err
    assert run(["report", str(tmp_path)]) == 2
    assert "neither results nor a session" in capsys.readouterr().err
    assert run(["report", str(tmp_path), "--out", str(tmp_path / "a.pdf")]) == 2
    assert "a report is an .html file" in capsys.readouterr().err
