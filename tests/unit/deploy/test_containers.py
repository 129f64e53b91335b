"""The Containerfile and the compose file: linter result, contents, and the health check."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig, RouterConfig
from deploy.config.file import load
from deploy.site.bundle import ROLE_PACKAGES

FOLDER = Path(__file__).resolve().parents[3] / "deploy" / "site" / "containers"
TEXT = (FOLDER / "Containerfile").read_text(encoding="utf-8")
HADOLINT = shutil.which("hadolint") or shutil.which(str(Path(sys.executable).parent / "hadolint"))


@pytest.mark.skipif(HADOLINT is None, reason="hadolint is not here: THE CONTAINERFILE IS NOT LINTED")
def test_the_linter_reports_no_problem() -> None:
    ended = subprocess.run(
        [str(HADOLINT), str(FOLDER / "Containerfile")], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stdout) == (0, "")


def stages() -> dict[str, str]:
    """The text of each stage by its name."""
    parts = re.split(r"^FROM ", TEXT, flags=re.M)[1:]
    return {part.splitlines()[0].rpartition(" AS ")[2]: part for part in parts}


def test_every_role_is_a_target_with_a_health_check_on_the_data_path() -> None:
    made = stages()
    assert set(ROLE_PACKAGES) <= made.keys()
    # The environment of every RUN: PYTHON=3.11 once was the interpreter that the installer called.
    assert not re.search(r"^(ARG|ENV) .*\bPYTHON=", TEXT, re.M)
    assert "USER 10001:10001" in made["base"]
    for role in ROLE_PACKAGES:
        stage = made[role]
        assert stage.startswith("base AS "), "another base might run as root"
        assert "USER" not in stage
        assert "HEALTHCHECK" in stage
        assert "/run/syncline/alive" in stage
        assert f"COPY bundles/{role} " in made[f"made-{role}"], "nothing is fetched: the bundle is all there is"
        assert f"--from=made-{role} " in stage


def test_the_health_check_detects_whether_data_flows(tmp_path: Path) -> None:
    found = re.search(r"CMD (\[\"/bin/sh\", \"-c\", .*\])$", stages()["camera"], re.M)
    assert found
    command = json.loads(found[1])
    alive = tmp_path / "alive"
    command[2] = command[2].replace("/run/syncline/alive", str(alive))

    def healthy() -> bool:
        return subprocess.run(command, capture_output=True, timeout=30, check=False).returncode == 0

    assert not healthy(), "no data has ever flowed"
    alive.touch()
    assert healthy()
    old = time.time() - 60.0
    os.utime(alive, (old, old))
    assert not healthy(), "the data stopped a minute ago"


def compose() -> dict[str, Any]:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not here: COMPOSE.YAML IS NOT CHECKED")
    return dict(yaml.safe_load((FOLDER / "compose.yaml").read_text(encoding="utf-8")))


def test_services_are_read_only_without_rights_and_use_targets_that_exist() -> None:
    site = compose()
    targets = stages()
    for name, service in site["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"]
        assert service["user"] == "10001:10001"
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert any(mount.startswith("/run/syncline") for mount in service["tmpfs"])
        if "build" in service:
            assert service["build"]["target"] in targets
            assert (FOLDER / service["build"]["context"] / service["build"]["dockerfile"]).is_file()
        assert "privileged" not in service
        assert "ports" not in service


def test_the_agents_accept_the_sites_configurations() -> None:
    kinds = {"hub": HubConfig, "recorder": RecorderConfig, "router": RouterConfig}
    for name, service in compose()["services"].items():
        mounts = [mount.split(":") for mount in service["volumes"] if mount.startswith("./")]
        assert [mount[1:] for mount in mounts] == [["/etc/syncline/config.toml", "ro"]]
        config = load(FOLDER / mounts[0][0], kinds.get(name, CameraConfig))
        assert config.site == "room"
        if name != "router":
            assert config.bus.connect == ("tcp/router:7447",)
