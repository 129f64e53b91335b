"""Every shipped rig runs on one machine with simulated devices, as its README says."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from deploy.logs.info import describe_log
from deploy.site.fleet import read_state, stop_fleet
from deploy.site.rig_folder import find_rig, read_rig_folder

SECONDS = {"webcams-room": 15, "drone-cage": 20, "oak-array": 25, "companion": 15}
PATIENCE_S = 900.0
"""On a slow or busy machine cameras give fewer frames, and a calibration of all needs longer: 315 s were seen."""


@pytest.mark.parametrize("name", sorted(SECONDS))
def test_a_rig_runs_with_simulated_devices(name: str, tmp_path: Path) -> None:
    """Until it has run for its time and every camera is calibrated, however long that takes here."""
    out = tmp_path / "out"
    rig = read_rig_folder(find_rig(name))
    cameras = [agent.name for agent in rig.of("camera")]
    solvers = [agent.name for agent in rig.of("hub") if agent.config.solve] if cameras else []

    def enough() -> bool:
        state = read_state(out) or {"elapsed_s": 0.0, "calibrations": {}}
        status = [state["calibrations"].get(solver) for solver in solvers]
        return state["elapsed_s"] >= SECONDS[name] and all(
            (text or "").startswith(f"{len(cameras)} cameras calibrated") for text in status
        )

    with subprocess.Popen(
        [sys.executable, "-m", "deploy", "fleet", "up", name, "--simulated", "--json", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as fleet:
        began = time.monotonic()
        while not enough() and fleet.poll() is None and time.monotonic() - began < PATIENCE_S:
            time.sleep(0.2)
        if fleet.poll() is None:
            stop_fleet(out)
        stdout, stderr = fleet.communicate(timeout=60)
    assert fleet.returncode == 0, stdout[-2000:] + stderr[-2000:]
    status = json.loads(stdout)
    assert status["failed"] == status["silent"] == []
    for agent in rig.agents:
        assert status["agents"][agent.name]["state"] == "stopped"
        assert status["agents"][agent.name]["restarts"] == 0, (out / "logs" / f"{agent.name}.txt").read_text()
    (log,) = (out / "recordings").glob("*.mcap")
    description = describe_log(log)
    assert not description.damage
    assert {camera.camera for camera in description.cameras} == set(cameras)
    if rig.of("uav"):
        assert {"uav_info", "telemetry"} <= {topic.topic for topic in description.topics}, "no autopilot was received"
    for name_of_solver in solvers:
        calibration = tomllib.loads((out / name_of_solver / "calibration.toml").read_text())
        assert set(cameras) <= calibration.keys(), status["calibrations"]
        assert calibration["metadata"]["scale"] == "metric"
