"""`syncline triangulate`: trajectories in the calibration's world with realistic stds, and refusals."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from deploy.cli import run
from protocols.geometry import so3
from protocols.geometry.types import Floats

Capture = pytest.CaptureFixture[str]

UP = np.diag([1.0, -1.0, -1.0])  # axes of a camera with y up, looking along -z


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "session"
    arguments = ["simulate", "marker", "--cameras", "3", "--seconds", "12", "--seed", "4", "--outliers", "0.02"]
    assert run([*arguments, "--out", str(folder)]) == 0
    return folder


def errors(track: Path, session: Path) -> tuple[Floats, Floats]:
    """Errors (n, 3) [m] of a track against the truth, and its stds (n,)."""
    found = np.genfromtxt(track, delimiter=",", skip_header=1, usecols=range(5))
    truth = np.loadtxt(session / "truth_trajectory.csv", delimiter=",", skiprows=1)
    expected = np.column_stack([np.interp(found[:, 0], truth[:, 0], truth[:, axis]) for axis in (1, 2, 3)])
    return found[:, 1:4] - expected, found[:, 4]


def moved(session: Path, out: Path, camera: str, **changes: object) -> Path:
    """The true calibration with something of one camera changed."""
    tables = tomllib.loads((session / "truth_calibration.toml").read_text())
    tables[camera] |= changes
    out.write_text(tomli_w.dumps(tables))
    return out


def test_the_trajectory_matches_the_truth_within_its_std(session: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "track.csv"
    known = str(session / "truth_calibration.toml")
    assert run(["triangulate", str(session), "--calibration", known, "--out", str(out), "--json"]) == 0
    assert out.read_text().splitlines()[0] == "time,x,y,z,std,label"
    off, std = errors(out, session)
    assert len(std) > 0.8 * 12 * 30
    assert np.sqrt(np.mean(off**2)) < 5e-3
    assert 0.7 < np.sqrt(np.mean((off / std[:, None]) ** 2)) < 1.5
    document = json.loads(capsys.readouterr().out)
    assert (document["units"], document["reference"], document["labels"]) == ("m", "cam0", {"marker": len(std)})
    assert all(0.3 < sigma < 0.8 for sigma in document["sigma_px"].values())  # simulated with 0.5


def test_labels_of_other_trackers_are_triangulated_from_a_csv_file(session: Path, tmp_path: Path) -> None:
    header, *lines = (session / "observations.csv").read_text().splitlines()
    assert header == "camera,frame,time,u,v,size"
    labelled = [line + ",nose" for line in lines] + [line + ',"tail, tip"' for line in lines if line.startswith("cam0")]
    file = tmp_path / "labels.csv"
    file.write_text("\n".join([header + ",label", *labelled]) + "\n")
    out = tmp_path / "track.csv"
    known = str(session / "truth_calibration.toml")
    assert run(["triangulate", str(file), "--calibration", known, "--out", str(out)]) == 0
    assert {line.rsplit(",", 1)[1] for line in out.read_text().splitlines()[1:]} == {"nose"}
    off, _ = errors(out, session)
    assert np.sqrt(np.mean(off**2)) < 5e-3


def test_times_are_on_the_reference_clock_even_without_the_reference_camera(session: Path, tmp_path: Path) -> None:
    header, *lines = (session / "observations.csv").read_text().splitlines()
    file = tmp_path / "rows.csv"
    file.write_text("\n".join([header, *(line for line in lines if not line.startswith("cam0"))]) + "\n")
    out = tmp_path / "track.csv"
    known = str(session / "truth_calibration.toml")
    assert run(["triangulate", str(file), "--calibration", known, "--out", str(out)]) == 0
    off, _ = errors(out, session)
    assert np.sqrt(np.mean(off**2)) < 1e-2


def test_a_camera_that_was_moved_is_reported_and_left_out(session: Path, tmp_path: Path, capsys: Capture) -> None:
    known = moved(session, tmp_path / "known.toml", "cam2", rotation=[0.1, 0.9, -0.4])
    out = tmp_path / "track.csv"
    assert run(["triangulate", str(session), "--calibration", str(known), "--out", str(out), "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["unused"]) == ["cam2"]
    off, _ = errors(out, session)
    assert np.sqrt(np.mean(off**2)) < 1e-2


def test_a_calibration_of_other_cameras_is_named(session: Path, tmp_path: Path, capsys: Capture) -> None:
    """It ended with a traceback."""
    tables = tomllib.loads((session / "truth_calibration.toml").read_text())
    metadata = tables.pop("metadata") | {"reference": "gate0"}
    known = tmp_path / "known.toml"
    renamed = {f"gate{index}": table | {"name": f"gate{index}"} for index, table in enumerate(tables.values())}
    known.write_text(tomli_w.dumps({"metadata": metadata, **renamed}))
    assert run(["triangulate", str(session), "--calibration", str(known), "--out", str(tmp_path / "track.csv")]) == 2
    assert "none of its cameras (cam0, cam1, cam2) is in the calibration (gate0, " in capsys.readouterr().err


@pytest.mark.parametrize("cameras", [["cam2"], ["cam0", "cam1", "cam2"]])
def test_a_clock_that_was_set_by_years_is_named_at_once(
    session: Path, tmp_path: Path, capsys: Capture, cameras: list[str]
) -> None:
    """A grid over all times between the first and the last row would have 10¹¹ of them."""
    truth = tomllib.loads((session / "truth_calibration.toml").read_text())
    known, out = tmp_path / "known.toml", tmp_path / "track.csv"
    for index, name in enumerate(cameras, start=1):
        truth[name]["time_offset"] += 1.7e9 * index
    known.write_text(tomli_w.dumps(truth))
    status = run(["triangulate", str(session), "--calibration", str(known), "--out", str(out), "--json"])
    printed = capsys.readouterr()
    assert status == (0 if cameras == ["cam2"] else 3)
    assert "cam2: by the calibration's clocks it shares no time" in printed.err or "cam2" in printed.out


def test_two_halves_a_day_apart_are_both_triangulated(session: Path, tmp_path: Path) -> None:
    """Pairs of cameras whose clocks agree with each other, and with no other pair."""
    tables = tomllib.loads((session / "truth_calibration.toml").read_text())
    header, *lines = (session / "observations.csv").read_text().splitlines()
    for name in ("cam0", "cam1"):
        later = name + "-later"
        tables[later] = tables[name] | {"name": later, "time_offset": tables[name]["time_offset"] + 86_400.0}
        lines += [line.replace(name, later, 1) for line in lines if line.startswith(name + ",")]
    lines = [line for line in lines if not line.startswith("cam2")]
    (tmp_path / "known.toml").write_text(tomli_w.dumps(tables))
    (tmp_path / "rows.csv").write_text("\n".join([header, *lines]) + "\n")
    out = tmp_path / "track.csv"
    known = str(tmp_path / "known.toml")
    assert run(["triangulate", str(tmp_path / "rows.csv"), "--calibration", known, "--out", str(out)]) == 0
    time = np.genfromtxt(out, delimiter=",", skip_header=1, usecols=0)
    assert (np.diff(time) > 86_000).sum() == 1


def test_no_input_is_overwritten(session: Path, tmp_path: Path, capsys: Capture) -> None:
    """Neither the labels nor the calibration, whatever the file is called on the way to it."""
    copy = tmp_path / "copy"
    shutil.copytree(session, copy)
    (tmp_path / "link").symlink_to(copy)
    before = {file.name: file.read_bytes() for file in copy.iterdir()}
    known = copy / "truth_calibration.toml"
    for name in ("observations.csv", "rig.toml", "truth_calibration.toml"):
        arguments = ["triangulate", str(copy), "--calibration", str(known), "--out", str(tmp_path / "link" / name)]
        assert run(arguments) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert f"{name}: this file is read, and would be lost" in line
    for arguments in (["export", "--to", "kalibr"], ["import"]):
        assert run([*arguments, str(known), "--out", str(known)]) == 2
    assert {file.name: file.read_bytes() for file in copy.iterdir()} == before


@pytest.mark.parametrize("change", ["pose", "clock", "epoch"])
def test_a_calibration_that_contradicts_the_rows_is_refused(
    session: Path, tmp_path: Path, capsys: Capture, change: str
) -> None:
    two = tmp_path / "two"
    shutil.copytree(session, two)
    truth = tomllib.loads((session / "truth_calibration.toml").read_text())["cam1"]
    offsets = {"clock": 0.4, "epoch": 5000.0}
    turned = [truth["rotation"][0] + 0.15, *truth["rotation"][1:]]
    changes = {"rotation": turned} if change == "pose" else {"time_offset": truth["time_offset"] + offsets[change]}
    known = moved(session, tmp_path / "known.toml", "cam1", **changes)
    lines = (two / "observations.csv").read_text().splitlines()
    (two / "observations.csv").write_text("\n".join(line for line in lines if not line.startswith("cam2")) + "\n")
    out = tmp_path / "track.csv"
    assert run(["triangulate", str(two), "--calibration", str(known), "--out", str(out)]) == 3
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not out.exists()


def test_millimetres_where_metres_are_stated_are_warned_of(session: Path, tmp_path: Path, capsys: Capture) -> None:
    tables = tomllib.loads((session / "truth_calibration.toml").read_text())
    for factor in (1.0, 1000.0):
        for name, table in tables.items():
            if name != "metadata":
                table["translation"] = [factor * value for value in table["translation"]]
                table.pop("position", None)
        (tmp_path / "known.toml").write_text(tomli_w.dumps(tables))
        known, out = str(tmp_path / "known.toml"), tmp_path / "track.csv"
        assert run(["triangulate", str(session), "--calibration", known, "--out", str(out)]) == 0
        assert ("positions seem not to be in m" in capsys.readouterr().out) == (factor > 1.0)
        assert run(["calibrate", str(session), "--from-known", known, "--out", str(tmp_path / "out")]) == 0
        assert ("positions seem not to be in m" in capsys.readouterr().out) == (factor > 1.0)


@pytest.mark.parametrize(
    ("written", "report"),
    [
        (lambda r, t: (r, -r.T @ t), "translation is the camera's place in the world"),
        (lambda r, t: (r.T, -r.T @ t), "rotation and translation are world from camera"),
        (lambda r, t: (r.T, t), "rotation is world from camera"),
        (lambda r, t: (UP @ r, UP @ t), "cameras look along -z, with y up"),
        (
            lambda r, t: ((UP @ r).T, -r.T @ t),
            "rotation and translation are world from camera, and cameras look along -z, with y up",
        ),
    ],
)
def test_another_convention_of_poses_is_named(
    session: Path,
    tmp_path: Path,
    capsys: Capture,
    written: Callable[[Floats, Floats], tuple[Floats, Floats]],
    report: str,
) -> None:
    """It was said that a camera had been moved, or that nothing was seen by two."""
    tables = tomllib.loads((session / "truth_calibration.toml").read_text())
    tables["metadata"].pop("up", None)
    turn, shift = so3.exp(np.array([0.3, -0.8, 0.5])), np.array([1.0, 2.0, 3.0])  # so that no camera is the world
    for name, table in tables.items():
        if name != "metadata":
            rotation = so3.exp(np.array(table["rotation"]))
            matrix, place = written(rotation @ turn, np.array(table["translation"]) + rotation @ shift)
            table.update(rotation=so3.log(matrix).tolist(), translation=place.tolist())
            table.pop("position", None)
    (tmp_path / "known.toml").write_text(tomli_w.dumps(tables))
    known, out = str(tmp_path / "known.toml"), tmp_path / "track.csv"
    assert run(["triangulate", str(session), "--calibration", known, "--out", str(out)]) == 3
    assert f"if in the calibration {report};" in capsys.readouterr().err
    assert not out.exists()
    assert run(["calibrate", str(session), "--from-known", known, "--out", str(tmp_path / "out")]) == 3
    assert f"if in the calibration {report};" in capsys.readouterr().err
