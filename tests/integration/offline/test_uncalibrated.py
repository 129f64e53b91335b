"""Cameras with unknown intrinsics or frame rate: their timing is estimated, with the geometry of each pair."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.cli import run
from hub.calibration.pipeline import calibrate
from protocols.core.clocks import TimeMap
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from tests.support.rigs import Session, simulate


def with_time_ratios(session: Session, ratios: Mapping[str, float]) -> Session:
    """The session, and its truth, with the times of some cameras multiplied by the given ratios."""
    time, clocks, camera = session.time.copy(), dict(session.clocks), np.array(session.camera)
    for name, ratio in ratios.items():
        mine = camera == name
        first = float(time[mine].min())
        time[mine] = first + (time[mine] - first) * ratio
        then = clocks[name]
        rate = then.clock_rate / ratio
        clocks[name] = TimeMap(rate, then.time_offset + (then.clock_rate - rate) * first)
    return replace(session, time=time, clocks=clocks)


def solve(session: Session, folder: Path) -> tuple[int, dict[str, Any]]:
    """Exit status of the command and its result.json."""
    status = run(["calibrate", str(session.write(folder / "session")), "--out", str(folder / "out")])
    return status, json.loads((folder / "out" / "result.json").read_text())


def true_lag(session: Session, a: str, b: str) -> float:
    """``t_a - t_b`` [s] in the middle of the common recording time."""
    spans = []
    for name in (a, b):
        mine = session.time[session.of_camera(name)]
        spans.append([session.true_time(name, float(t)) for t in (mine.min(), mine.max())])
    middle = 0.5 * (max(spans[0][0], spans[1][0]) + min(spans[0][1], spans[1][1]))
    return session.shown(a, middle) - session.shown(b, middle)


def epipolar_px(full: Session, session: Session, pair: dict[str, Any]) -> float:
    """Median distance [px] of true points from their epipolar lines; raw pixels for cameras without intrinsics."""
    points = full.paths["marker"].at(np.linspace(3.0, 17.0, 80))
    seen: list[Floats] = []
    for name in pair["cameras"]:
        lens = full.lens(name)
        local = full.poses[name].camera_from_world(points)
        straight = (local / local[:, 2:] @ lens.matrix.T)[:, :2]
        pixels = lens.project(local) if session.rig.cameras[name].intrinsics is None else straight
        seen.append(np.column_stack([pixels, np.ones(len(pixels))]))
    lines = seen[0] @ np.array(pair["fundamental"]).reshape(3, 3)
    return float(np.nanmedian(np.abs((lines * seen[1]).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)))


def check_pairs(full: Session, session: Session, result: dict[str, Any], within: float = 1.5e-3) -> None:
    """Check that every pair is reported with the true values."""
    names = list(session.rig.cameras)
    assert len(result["pairs"]) == len(names) * (len(names) - 1) // 2
    for pair in result["pairs"]:
        a, b = pair["cameras"]
        assert pair["status"] == "ok"
        assert pair["lag_s"] == pytest.approx(true_lag(session, a, b), abs=within)
        truth = session.clocks[b].clock_rate / session.clocks[a].clock_rate
        assert pair["clock_rate"] == pytest.approx(truth, rel=1e-4)
        matrix = np.array(pair["fundamental"]).reshape(3, 3)
        assert np.linalg.norm(matrix) == pytest.approx(1.0)
        assert np.linalg.svd(matrix, compute_uv=False)[2] < 1e-9
        assert epipolar_px(full, session, pair) < 1.5
        # A pair whose camera resection has connected has no fit of its own.
        assert pair["inliers"] is None or 0.9 < pair["inliers"] <= 1.0
        assert pair["rms_px"] is None or 0.2 < pair["rms_px"] < 1.0


def test_a_camera_whose_lens_is_undetermined_is_timed_while_the_others_are_placed(tmp_path: Path) -> None:
    # The third camera sees too little, in the middle of its image, to determine its focal length.
    free = simulate(0, 3, 5).paths["marker"]
    small = replace(free, amplitude=0.35 * free.amplitude)
    full = simulate(0, 3, 20, path=small, windows=[(0.0, 20.0), (0.0, 20.0), (4.0, 11.0)])
    session = full.without_lenses("cam2")
    status, result = solve(session, tmp_path)
    assert status == 0
    assert list(result["cameras"]) == ["cam0", "cam1"]
    reason_text = result["metadata"]["refused"]["cam2"]
    assert "no intrinsics" in reason_text
    assert "syncline intrinsics" in reason_text
    assert f"{-result['pairs'][1]['lag_s']:.4f} s against cam0" in reason_text
    for pair in result["pairs"]:  # seven seconds of a small path: less precise than elsewhere
        assert pair["lag_s"] == pytest.approx(true_lag(session, *pair["cameras"]), abs=4e-3)
        assert epipolar_px(full, session, pair) < 1.5
    assert "cam2" not in tomllib.loads((tmp_path / "out" / "calibration.toml").read_text())


@pytest.mark.parametrize("uncalibrated", [("cam1",), ("cam0", "cam1")])
def test_two_cameras_that_cannot_be_placed_are_refused_with_their_timing(
    uncalibrated: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    full = simulate(1, 2, 20)
    session = full.without_lenses(*uncalibrated)
    status, result = solve(session, tmp_path)
    assert status == 3
    assert "intrinsics" in capsys.readouterr().err
    assert result["status"] == "refused"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["report.html", "result.json"]
    check_pairs(full, session, result)
    assert set(result["metadata"]["refused"]) == {"cam0", "cam1"}
    for reason in result["metadata"]["refused"].values():
        assert "only its timing is known" in reason
    page = (tmp_path / "out" / "report.html").read_text()
    assert "cam0–cam1" in page
    assert "<h2>Pairs</h2>" in page


@pytest.mark.parametrize(("cameras", "permanent"), [(2, True), (3, False)])
def test_a_refusal_lasts_only_where_more_rows_cannot_determine_the_lenses(cameras: int, permanent: bool) -> None:
    session = simulate(2, cameras, 4).without_lenses()
    with pytest.raises(Refused) as caught:
        calibrate(session.rig, session.observations())
    assert caught.value.permanent == permanent


def test_an_uncalibrated_camera_that_saw_another_object_is_not_timed(tmp_path: Path) -> None:
    session = simulate(2, 3, 20, unrelated=(1,)).without_lenses("cam1")
    status, result = solve(session, tmp_path)
    assert status == 0
    assert "only its timing" not in result["metadata"]["refused"]["cam1"]
    assert "no intrinsics" in result["metadata"]["refused"]["cam1"]
    for pair in result["pairs"]:
        assert (pair["status"] == "ok") == ("cam1" not in pair["cameras"])
        assert pair["lag_s"] is None or "cam1" not in pair["cameras"]


def test_a_refusal_of_the_rigs_control_points_reports_the_pairs(tmp_path: Path) -> None:
    session = simulate(3, 3, 15)
    folder = session.write(tmp_path / "session")
    distances = 'distances = [["cam0", "cam1", 1.0], ["cam0", "cam2", 1000.0]]'
    (folder / "rig.toml").write_text((folder / "rig.toml").read_text() + f"\n[metadata]\n{distances}\n")
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 3
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    check_pairs(session, session, result)


def test_unrelated_cameras_are_refused_with_the_status_of_each_pair(tmp_path: Path) -> None:
    status, result = solve(simulate(800, 2, 20, unrelated=(1,)), tmp_path)
    assert status == 3
    (pair,) = result["pairs"]
    assert pair["cameras"] == ["cam0", "cam1"]
    assert pair["status"] != "ok"
    assert pair["lag_s"] is None


WRONG_RATES = [
    (10, {"cam1": 1.2}, "cam1: its times run 1.2 times as fast as the others': were they made with 25 fps for 30?"),
    (11, {"cam0": 2.4}, "cam0: its times run 2.4 times as fast as the others'"),
    (12, {"cam2": 0.5}, "cam2: its times run 0.5 times as fast as the others'"),
    (13, {"cam0": 1 / 2.4}, "cam0: its times run 0.41"),
    (
        16,
        {"cam1": 4.0},
        "cam1: its times run 4 times as fast as the others': were they made with 25 fps for 100 (slow mo",
    ),
    (17, {"cam0": 8.0}, "cam0: its times run 8 times as fast as the others'"),
]


@pytest.mark.parametrize(("seed", "ratios", "warning"), WRONG_RATES)
def test_a_wrong_frame_rate_is_estimated_and_reported(
    seed: int, ratios: dict[str, float], warning: str, tmp_path: Path
) -> None:
    """Also for the reference camera: every other clock then differs from it, and still the wrong one is named."""
    session = with_time_ratios(simulate(seed, 3, 20), ratios)
    status, result = solve(session, tmp_path)
    assert status == 0
    assert not result["metadata"]["refused"]
    calibration = tomllib.loads((tmp_path / "out" / "calibration.toml").read_text())
    reference = session.clocks["cam0"].clock_rate
    for name, clock in session.clocks.items():
        found = calibration[name]
        assert found["clock_rate"] == pytest.approx(clock.clock_rate / reference, rel=1e-4)
        scale = reference  # true seconds in one of the reference clock's
        error = session.clock_error(name, "cam0", TimeMap(found["clock_rate"], found["time_offset"]))
        assert abs(error) * scale < 1e-3
        assert found["rms_px"] < 0.85
        if name != "cam0":
            assert abs(error) < 5 * found["time_offset_std"]
    assert sum(warning in text for text in result["warnings"]) == 1
    assert sum("its times run" in text for text in result["warnings"]) == 1
    check_pairs(session, session, result)
    seen = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    begin, end = (session.true_time("cam0", float(t)) for t in seen[[0, -1], 0])
    assert 15 < end - begin < 20.5


def test_of_two_cameras_either_may_be_the_wrong_one(tmp_path: Path) -> None:
    session = with_time_ratios(simulate(14, 2, 20), {"cam1": 1.25})
    status, result = solve(session, tmp_path)
    assert status == 0
    (warning,) = [text for text in result["warnings"] if "its times run" in text]
    assert warning == (
        "cam1: its times run 1.25 times as fast as cam0's: were they made with 24 fps for 30, or cam0's with 30 for 24?"
    )
    check_pairs(session, session, result)


def test_two_cameras_with_the_same_wrong_rate_are_connected_as_a_group() -> None:
    session = with_time_ratios(simulate(15, 5, 15, fps=(15.0, 12.5)), {"cam1": 1.2, "cam3": 1.2})
    found = calibrate(session.rig, session.observations(), thorough=True)
    assert not found.refused
    reason_text = [text for text in found.warnings if "its times run" in text]
    assert [text.split(":")[0] for text in reason_text] == ["cam1", "cam3"]
    for name, camera in found.cameras.items():
        assert abs(session.clock_error(name, "cam0", camera.time_map)) < 1e-3


def test_a_camera_without_lens_and_with_a_wrong_rate_is_timed(tmp_path: Path) -> None:
    full = with_time_ratios(simulate(16, 3, 20), {"cam0": 0.8})
    session = full.without_lenses("cam0")
    status, result = solve(session, tmp_path)
    assert status == 0
    check_pairs(full, session, result)
    assert any(text.startswith("cam0: its times run 0.8") for text in result["warnings"])


def test_a_wrong_rate_gives_a_warning_even_if_no_camera_can_be_placed(tmp_path: Path) -> None:
    full = with_time_ratios(simulate(17, 2, 20), {"cam1": 2.0})
    status, result = solve(full.without_lenses("cam0"), tmp_path)
    assert status == 3
    assert any("its times run 2 times as fast" in text for text in result["warnings"])
    assert "its times run 2 times as fast" in (tmp_path / "out" / "report.html").read_text()


def test_other_rates_are_tried_only_on_request() -> None:
    session = with_time_ratios(simulate(14, 2, 20), {"cam1": 1.25})
    with pytest.raises(Refused) as caught:
        calibrate(session.rig, session.observations())
    assert [pair.status != "ok" for pair in caught.value.pairs] == [True]


def test_a_wrong_rate_is_also_estimated_with_given_poses(tmp_path: Path) -> None:
    first = simulate(18, 2, 15)
    assert solve(first, tmp_path)[0] == 0
    second = with_time_ratios(first, {"cam1": 1.2})
    folder = second.write(tmp_path / "second")
    known = tmp_path / "out" / "calibration.toml"
    assert run(["calibrate", str(folder), "--from-known", str(known), "--out", str(tmp_path / "again")]) == 0
    found = tomllib.loads((tmp_path / "again" / "calibration.toml").read_text())["cam1"]
    assert abs(second.clock_error("cam1", "cam0", TimeMap(found["clock_rate"], found["time_offset"]))) < 1e-3


@pytest.mark.parametrize("solver", ["paper"])
def test_the_papers_solver_refuses_uncalibrated_cameras_by_name(solver: str, tmp_path: Path) -> None:
    session = simulate(19, 2, 10).without_lenses("cam1")
    folder = session.write(tmp_path / "session")
    assert run(["calibrate", str(folder), "--solver", solver, "--out", str(tmp_path / "out")]) == 3
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert "no intrinsics" in result["metadata"]["refused"]["cam1"]
