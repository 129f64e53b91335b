"""Configurations that cannot work are refused at the start, in one line with file, line and remedy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from deploy.cli import run
from tests.faults.matrix import measured
from tests.faults.processes import ROOT

CASES = {
    "unknown key": ("camera", 'id = "cam0"\nsiet = "yard"\n', ":2: unknown key siet; did you mean site?"),
    "bad endpoint": ("hub", '[bus]\nconnect = ["tcp:/127.0.0.1"]\n', "is not an endpoint; write it like"),
    "dangling file": (
        "camera",
        'id = "cam0"\nrig = "nowhere/rig.toml"\n[bus]\nmode = "peer"\n',
        "nowhere/rig.toml",
    ),
    "certificates without files": ("hub", '[bus]\nmode = "client"\nconnect = ["tls/127.0.0.1:7447"]\n', "[bus.tls]"),
    "access rules of a client": ("hub", '[bus]\nmode = "client"\naccess = "rules.json5"\n', "access is for a router"),
    "dangling access rules": ("router", '[bus]\naccess = "rules.json5"\n', "this file of access rules does not exist"),
    "health open to the network": (
        "record",
        '[health]\nlisten = "0.0.0.0:9100"\n',
        "health: listen '0.0.0.0:9100' is open to the network; take 127.0.0.1",
    ),
    "a peer without an address": ("hub", '[bus]\nconnect = ["tcp/192.0.2.1:7447"]\n', "set listen"),
}


@pytest.mark.parametrize("what", CASES)
def test_an_invalid_configuration_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    role, text, expected = CASES[what]
    file = tmp_path / "agent.toml"
    file.write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "deploy", role, str(file)],
        capture_output=True,
        text=True,
        timeout=30.0,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 2, done.stderr
    assert expected in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    measured(f"configuration: {what}", "refused at start with line and remedy", f"exit 2: …{expected}")


def test_a_valid_configuration_is_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "hub.toml"
    file.write_text('[bus]\noutage_s = 120.0\n[health]\nlisten = "127.0.0.1:9100"\n', encoding="utf-8")
    assert run(["hub", str(file), "--print-config"]) == 0
    assert "outage_s = 120.0" in capsys.readouterr().out
