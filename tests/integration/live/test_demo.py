"""The demo's processes over real Zenoh: cameras, hub and recorder, ending with a comparison with the ground truth."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.cli import run
from deploy.logs.info import describe_log
from protocols.core.clocks import CameraTime, TimeMap
from protocols.session.calibration import read_calibration


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """The demo's folder and its printed table, three cameras for 12 s."""
    out = tmp_path_factory.mktemp("demo") / "demo-out"
    arguments = ["demo", "--seconds", "12", "--cameras", "3", "--json", "--out", str(out)]
    ended = subprocess.run([sys.executable, "-m", "deploy", *arguments], capture_output=True, text=True, timeout=180)
    assert ended.returncode == 0, ended.stderr + ended.stdout
    return out, json.loads(ended.stdout)


def test_the_demo_recovers_clock_offsets_and_poses(demo: tuple[Path, dict[str, object]]) -> None:
    _, table = demo
    cameras = table["cameras"]
    assert isinstance(cameras, list)
    assert [camera["camera"] for camera in cameras] == ["cam0", "cam1", "cam2"]
    _, reference = _time_maps(demo[0] / "calibration.toml")
    for camera in cameras:
        assert abs(camera["true_offset"]) > 1.0 or camera["camera"] == reference, "nothing to find"
        assert abs(camera["offset_error_ms"]) < 1.0
        assert camera["rotation_error_deg"] < 0.3
        assert camera["direction_error_deg"] < 0.5


def test_its_log_is_complete_and_gives_the_same_calibration(
    demo: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    out, table = demo
    description = describe_log(out / "demo.mcap")
    assert not description.damage
    assert {camera.camera for camera in description.cameras} == {"cam0", "cam1", "cam2"}
    assert all(camera.missing == 0 for camera in description.cameras)
    topics = {topic.topic for topic in description.topics}
    assert {"observation", "camera_info", "calibration", "status"} <= topics
    assert table["first_calibration_s"] is None or "track" in topics, "a loaded machine may answer at the end only"
    for name in ("one", "two"):
        assert run(["calibrate", str(out / "demo.mcap"), "--out", str(tmp_path / name)]) == 0
    first = (tmp_path / "one" / "calibration.toml").read_bytes()
    assert first == (tmp_path / "two" / "calibration.toml").read_bytes()
    (live, reference), (again, _) = _time_maps(out / "calibration.toml"), _time_maps(tmp_path / "one/calibration.toml")
    stated = json.loads((out / "result.json").read_text())["cameras"]
    assert live.keys() == again.keys() == {"cam0", "cam1", "cam2"}
    for name in live.keys() - {reference}:
        # Both speak of the same clocks: compare where they film, not at the epoch of the clock.
        own = CameraTime(stated[name]["lag_time_s"])
        then = again[reference].camera_from_reference(again[name].reference_from_camera(own))
        assert abs(then - live[name].reference_from_camera(own)) < 2.0 * stated[name]["lag_std_s"]


def _time_maps(calibration: Path) -> tuple[dict[str, TimeMap], str]:
    """The time map of each camera, and the reference: whichever camera the first answer had, not always cam0."""
    rig, solved = read_calibration(calibration)
    return {name: camera.time_map for name, camera in solved.items()}, str(rig.metadata["reference"])
