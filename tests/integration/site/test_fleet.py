"""`syncline fleet` with real processes: orphans of a killed fleet. More in tests/faults/test_fleet_kill.py."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deploy.cli import run
from deploy.site.fleet import STATE, Fleet, is_running
from tests.support.command_line import refusal

HUB = 'id = "hub"\nsite = "mini"\nrig = "rig.toml"\ninterval_s = 1.0\n'
RIG = '[{0}]\nname = "{0}"\nsize = [640, 480]\n'


def mini(folder: Path) -> Path:
    """Two cameras, a hub and a recorder."""
    folder.mkdir()
    for name in ("cam0", "cam1"):
        (folder / f"{name}.toml").write_text(f'id = "{name}"\nsite = "mini"\nrig = "rig.toml"\n')
    (folder / "rig.toml").write_text(RIG.format("cam0") + RIG.format("cam1"))
    (folder / "hub.toml").write_text(HUB)
    (folder / "recorder.toml").write_text('id = "recorder"\nsite = "mini"\nmin_free_mb = 0.0\n')
    (folder / "fleet.toml").write_text('[simulated]\nscene = "marker"\nseed = 3\nwidth = 320\nfps = 15.0\n')
    return folder


def start(arguments: list[str], log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "deploy", "fleet", *arguments], stdout=out, stderr=subprocess.STDOUT
        )


def until(what: Callable[[], Any], timeout_s: float = 90.0) -> Any:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        found = what()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError("it never came")


def state(out: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((out / STATE).read_text()))
    except FileNotFoundError:
        return {}


def frames(out: Path, name: str) -> int:
    return int(state(out).get("agents", {}).get(name, {}).get("counters", {}).get("frames", 0))


def fleet(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "deploy", "fleet", *arguments], capture_output=True, text=True, timeout=120, check=False
    )


def test_a_fleets_world_has_the_seed_that_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, seeds = mini(tmp_path / "rig"), list[int]()
    monkeypatch.setattr(Fleet, "run", lambda self, *_: seeds.append(self.rig.world.seed))
    for given in ([], ["--seed", "9"]):
        run(["fleet", "up", str(rig), "--simulated", "--seconds", "1", "--out", str(tmp_path / "out"), *given])
    assert seeds == [3, 9]
    assert run(["fleet", "up", str(rig), "--seed", "9"]) == 2


def test_a_router_whose_address_is_taken_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = mini(tmp_path / "rig")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f'["tcp/127.0.0.1:{taken.getsockname()[1]}"]'
        (rig / "router.toml").write_text(f'id = "r"\nsite = "mini"\n[bus]\nlisten = {endpoint}\n')
        for name in ("cam0", "cam1", "hub", "recorder"):
            with (rig / f"{name}.toml").open("a") as file:
                file.write(f'[bus]\nmode = "client"\nconnect = {endpoint}\n')
        said = refusal(capsys, ["fleet", "up", str(rig), "--out", str(tmp_path / "out"), "--json"])
    assert "syncline: r ended: bus: " in said
    assert "Address already in use" in said


def test_the_next_fleet_stops_agents_of_a_killed_one(tmp_path: Path) -> None:
    rig, out = mini(tmp_path / "rig"), tmp_path / "out"
    (rig / "recorder.toml").unlink()
    up = start(["up", str(rig), "--simulated", "--out", str(out)], tmp_path / "log.txt")
    try:
        until(lambda: all(seen["pid"] for seen in state(out).get("agents", {"x": {"pid": 0}}).values()))
        left = {name: (seen["pid"], seen["started"]) for name, seen in state(out)["agents"].items()}
    finally:
        up.kill()
        up.wait()
    assert all(is_running(*one) for one in left.values())
    down = fleet("down", "--out", str(out))
    assert down.returncode == 0
    assert "cam0" in down.stdout
    assert not any(is_running(*one) for one in left.values())
