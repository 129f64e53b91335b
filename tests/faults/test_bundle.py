"""Bundles on an offline board: made for this machine, carried over, installed without an index, and run.

Making one needs a package index, once; without one these tests are skipped with a message.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.site.bundle import BUDGET_MB, Bundle, Target, folder_size_mb, make_bundle
from protocols.core.errors import InputError

HERE = f"{sys.version_info.major}.{sys.version_info.minor}"
CONFIG = {
    "camera": ("camera", 'id = "cam0"\n[simulated]\nduration_s = 2.0\n'),
    "hub": ("hub", 'id = "hub"\n'),
    "recorder": ("record", 'id = "recorder"\nout = "log.mcap"\nmin_free_mb = 0.0\n'),
    "router": ("router", 'id = "router"\n[bus]\nlisten = ["tcp/127.0.0.1:0"]\n'),
    "uav": ("uav", ""),
}
OFFLINE = {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull, "PATH": os.environ["PATH"]}


def made(role: str, target: Target, out: Path) -> Bundle:
    try:
        return make_bundle(role, target, out)
    except InputError as error:
        if "connection" in error.remedy and ("No matching distribution" in error.what or "Could not" in error.what):
            pytest.skip(f"no package index here: BUNDLES ARE NOT TESTED ({error.what})")
        raise


@pytest.mark.parametrize("role", sorted(CONFIG))
def test_a_bundle_installs_without_an_index_and_its_agent_runs(role: str, tmp_path: Path) -> None:
    bundle = made(role, Target(platform.machine(), HERE), tmp_path / "bundle")
    board = tmp_path / "board"
    for _ in range(2):  # twice: a newer bundle is installed over an older one the same way
        ended = subprocess.run(
            ["sh", str(bundle.out / "install.sh"), str(board)],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
            env={**OFFLINE, "PYTHON": sys.executable},
        )
        assert ended.returncode == 0, ended.stderr
    if role in BUDGET_MB:
        assert folder_size_mb(board) <= BUDGET_MB[role], ended.stdout
    # What the role does not need is not there, and it starts without it.
    packages = {path.name for path in (board / "lib" / f"python{HERE}" / "site-packages").iterdir()}
    assert ("scipy" in packages) == ("plotly" in packages) == (role == "hub")
    command, text = CONFIG[role]
    if not text:
        assert subprocess.run([str(board / "bin/syncline"), command, "--help"], timeout=60, check=False).returncode == 0
        return
    (tmp_path / "agent.toml").write_text(text)
    alive = tmp_path / "alive"
    with (tmp_path / "log.txt").open("wb") as log:
        agent = subprocess.Popen(
            [str(board / "bin/syncline"), command, str(tmp_path / "agent.toml")],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**OFFLINE, "SYNCLINE_ALIVE_FILE": str(alive)},
        )
        try:
            for _ in range(600):
                if alive.exists() or agent.poll() not in (None, 0):
                    break
                try:
                    agent.wait(0.1)
                except subprocess.TimeoutExpired:
                    continue
            assert alive.exists(), (tmp_path / "log.txt").read_text()
            agent.terminate()
            assert agent.wait(60) == 0, (tmp_path / "log.txt").read_text()
        finally:
            if agent.poll() is None:
                agent.kill()
                agent.wait()


@pytest.mark.parametrize("role", sorted(BUDGET_MB))
def test_a_board_of_another_architecture_stays_within_its_budget(role: str, tmp_path: Path) -> None:
    bundle = made(role, Target("aarch64", "3.11"), tmp_path / "bundle")
    assert bundle.installed_mb <= BUDGET_MB[role]
    wheels = [path.name for path in (bundle.out / "wheels").glob("*.whl")]
    assert any("aarch64" in name for name in wheels)
    assert not any("x86_64" in name for name in wheels)
    assert len((bundle.out / "requirements.txt").read_text().splitlines()) == len(wheels) - 1, "all but pip"
