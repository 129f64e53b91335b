"""Every shipped rig runs on one machine with simulated devices, as its README says."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from deploy.info import describe_log
from deploy.rig_folder import find_rig, read_rig_folder

SECONDS = {"webcams-room": 15, "drone-cage": 20, "oak-array": 25, "companion": 15}


@pytest.mark.parametrize("name", sorted(SECONDS))
def test_a_rig_runs_with_simulated_devices(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ended = subprocess.run(
        [sys.executable, "-m", "deploy", "fleet", "up", name, "--simulated", "--json"]
        + ["--seconds", str(SECONDS[name]), "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-2000:]
    told = json.loads(ended.stdout)
    assert told["failed"] == told["silent"] == []
    rig = read_rig_folder(find_rig(name))
    for agent in rig.agents:
        assert told["agents"][agent.name]["state"] == "stopped"
        assert told["agents"][agent.name]["restarts"] == 0, (out / "logs" / f"{agent.name}.txt").read_text()
    cameras = [agent.name for agent in rig.of("camera")]
    (log,) = (out / "recordings").glob("*.mcap")
    description = describe_log(log)
    assert not description.damage
    assert {camera.camera for camera in description.cameras} == set(cameras)
    if rig.of("uav"):
        assert {"uav_info", "telemetry"} <= {topic.topic for topic in description.topics}, "no autopilot was heard"
    if cameras:
        solver = next(agent for agent in rig.of("hub") if agent.config.solve)
        calibration = tomllib.loads((out / solver.name / "calibration.toml").read_text())
        assert set(cameras) <= calibration.keys(), told["calibrations"]
        assert calibration["metadata"]["scale"] == "metric"
