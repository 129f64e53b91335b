"""The command line from outside: exit status, one line on bad input, complete outputs, reproducible bytes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.cli import run
from edge.uav.world.scenarios import SCENARIOS


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of three cameras over 15 s, written by `simulate`."""
    folder = tmp_path_factory.mktemp("sessions") / "session"
    arguments = ["simulate", "marker", "--cameras", "3", "--seconds", "15", "--seed", "4", "--out", str(folder)]
    assert run(arguments) == 0
    return folder


def copy_of(recording: Path, target: Path) -> Path:
    shutil.copytree(recording, target)
    return target


def clock_error(found: dict[str, Any], truth: dict[str, Any], name: str, reference_time: float) -> float:
    """Error [s] of a time map during the recording; at the clock's epoch the rate error would dominate."""
    own = (reference_time - truth[name]["time_offset"]) / truth[name]["clock_rate"]
    return float(found[name]["clock_rate"] * own + found[name]["time_offset"] - reference_time)


def test_a_session_is_calibrated_and_all_four_outputs_are_there(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(["calibrate", str(recording), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "calibration.toml",
        "report.html",
        "result.json",
        "trajectory.csv",
    ]
    found = tomllib.loads((out / "calibration.toml").read_text())
    truth = tomllib.loads((recording / "truth_calibration.toml").read_text())
    seen = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    middle = float(np.median(seen[:, 0]))
    for name in ("cam0", "cam1", "cam2"):
        assert abs(clock_error(found, truth, name, middle)) < 1e-3
    result = json.loads((out / "result.json").read_text())
    assert result["status"] == "solved"
    assert [pair["cameras"] for pair in result["pairs"]] == [["cam0", "cam1"], ["cam0", "cam2"], ["cam1", "cam2"]]
    for pair in result["pairs"]:
        assert np.linalg.norm(pair["fundamental"]) == pytest.approx(1.0)


def test_the_same_session_gives_the_same_bytes(recording: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        assert run(["calibrate", str(recording), "--out", str(tmp_path / name)]) == 0
    for name in ("calibration.toml", "trajectory.csv"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_known_poses_are_kept_and_only_clocks_are_estimated(recording: Path, tmp_path: Path) -> None:
    known = recording / "truth_calibration.toml"
    assert run(["calibrate", str(recording), "--from-known", str(known), "--out", str(tmp_path)]) == 0
    found, truth = tomllib.loads((tmp_path / "calibration.toml").read_text()), tomllib.loads(known.read_text())
    path = np.loadtxt(tmp_path / "trajectory.csv", delimiter=",", skiprows=1)
    for name in ("cam0", "cam1", "cam2"):
        np.testing.assert_allclose(found[name]["translation"], truth[name]["translation"], atol=1e-9)
        assert abs(clock_error(found, truth, name, float(np.median(path[:, 0])))) < 1e-3
    true_path = np.loadtxt(recording / "truth_trajectory.csv", delimiter=",", skiprows=1)
    for axis in (1, 2, 3):
        expected = np.interp(path[:, 0], true_path[:, 0], true_path[:, axis])
        assert np.median(np.abs(path[:, axis] - expected)) < 5e-3


def test_json_is_one_document_on_standard_output(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(recording), "--out", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "solved"


@pytest.mark.parametrize(
    ("name", "change", "expected_text"),
    [
        ("rig.toml", lambda text: text.replace("size", "sise", 1), "size"),
        ("rig.toml", lambda text: text + "[", "TOML"),
        ("observations.csv", lambda text: text.replace("time", "when", 1), "time"),
        ("observations.csv", lambda text: text.replace("cam1", "cam9", 1), "cam9"),
        ("observations.csv", lambda text: text + text.splitlines()[-1] + "\n", "two rows"),
        ("observations.csv", lambda text: text.splitlines()[0] + "\n", "no rows"),
        ("observations.csv", lambda text: text + "cam0,9999,nan,1,2,3\n", "nan"),
    ],
)
def test_bad_input_is_one_line_with_a_file_and_status_2(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, change: object, expected_text: str
) -> None:
    assert callable(change)
    broken = copy_of(recording, tmp_path / "broken")
    (broken / name).write_text(change((broken / name).read_text()))
    assert run(["calibrate", str(broken), "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert name in lines[0]
    assert expected_text in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["rig.toml", "observations.csv"])
def test_a_missing_file_is_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    broken = copy_of(recording, tmp_path / "broken")
    (broken / name).unlink()
    assert run(["calibrate", str(broken), "--out", str(tmp_path / "out")]) == 2
    assert name in capsys.readouterr().err


def test_one_camera_is_refused_with_a_report_and_no_calibration(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = copy_of(recording, tmp_path / "alone")
    rows = (alone / "observations.csv").read_text().splitlines()
    (alone / "observations.csv").write_text("\n".join(row for row in rows if "cam1" not in row and "cam2" not in row))
    out = tmp_path / "out"
    out.mkdir()
    (out / "calibration.toml").write_text("an earlier answer")
    assert run(["calibrate", str(alone), "--out", str(out)]) == 3
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "result.json"]
    document = json.loads((out / "result.json").read_text())
    assert document["status"] == "refused"
    assert set(document["metadata"]["refused"]) == {"cam0", "cam1", "cam2"}
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["calibrate"],
        ["calibrate", "x", "--out", "y", "--solver", "guess"],
        ["calibrate", "x", "--out", "y", "--solver", "distributed"],
        ["nonsense"],
        ["simulate", "atlantis", "--out", "x"],
        ["simulate", "marker", "--out", "x", "--cameras", "1"],
        ["demo", "--cameras", "1"],
        ["demo", "--view", "--view-port", "99999"],
        ["camera", "missing.toml"],
        ["info", "missing.mcap"],
        ["replay", "missing.mcap", "--rate", "fast"],
    ],
)
def test_bad_use_is_one_line_and_status_2(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["demo", "simulate", "calibrate", "camera", "hub", "record", "replay", "info"])
def test_every_help_shows_an_example(command: str) -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "deploy", command, "--help"], capture_output=True, text=True, check=True
    ).stdout
    assert f"syncline {command} " in shown.split("Example:")[1]


def test_the_help_of_simulate_names_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["simulate", "--help"]) == 0
    assert set(SCENARIOS) <= {word.strip(",.") for word in capsys.readouterr().out.split()}
