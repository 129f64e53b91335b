"""A fleet whose agents are killed: each is restarted and reported, and no process is left behind."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

from deploy.logs.info import describe_log
from deploy.site.fleet import is_running
from tests.integration.site.test_fleet import fleet, frames, mini, start, state, until


def test_a_killed_agent_is_started_again(tmp_path: Path) -> None:
    rig, out = mini(tmp_path / "rig"), tmp_path / "out"
    up = start(["up", str(rig), "--simulated", "--out", str(out)], tmp_path / "log.txt")
    try:
        until(lambda: frames(out, "cam0") > 5 and frames(out, "cam1") > 5)
        asked = fleet("status", "--out", str(out), "--json")
        status = json.loads(asked.stdout)
        assert status["up"]
        assert all(agent["runs"] for agent in status["agents"].values())
        again = fleet("up", str(rig), "--simulated", "--out", str(out))
        assert (again.returncode, "is up in" in again.stderr) == (3, True)
        victim = status["agents"]["cam1"]
        os.kill(victim["pid"], signal.SIGKILL)
        until(lambda: state(out)["agents"]["cam1"]["restarts"] == 1)
        until(lambda: state(out)["agents"]["cam1"]["pid"] not in (0, victim["pid"]))
        until(lambda: state(out)["agents"]["cam1"]["state"] == "running")
        assert state(out)["agents"]["cam0"]["restarts"] == 0
        pids = {name: (seen["pid"], seen["started"]) for name, seen in state(out)["agents"].items()}
        down = fleet("down", "--out", str(out))
        assert (down.returncode, down.stdout) == (0, "stopped 4 agents\n")
        assert up.wait(60) == 0
        assert not any(is_running(*one) for one in pids.values())
        printed = (tmp_path / "log.txt").read_text()
        assert re.search(r"cam1 ended \(SIGKILL\): .*; again in 1 s", printed)
        assert not fleet("status", "--out", str(out), "--json").stdout.count('"runs": true')
        # In order: the recorder, stopped after the cameras, has received the last message of each of them.
        (log,) = (out / "recordings").glob("*.mcap")
        description = describe_log(log)
        assert not description.damage
        assert {camera.camera for camera in description.cameras} == {"cam0", "cam1"}
    finally:
        if up.poll() is None:
            up.send_signal(signal.SIGTERM)
            up.wait(60)
