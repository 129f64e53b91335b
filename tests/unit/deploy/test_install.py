"""`syncline install` into an image: what is written, that systemd accepts it, and that unchanged files are kept."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from deploy.cli import run
from deploy.site.install import units
from deploy.site.install.plan import _commands, _run, plan_install

NEEDS_SYSTEMD = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here: UNIT FILES ARE NOT CHECKED"
)
PROGRAM = ["--program", "/opt/syncline/bin/syncline"]
RIG = '[cam0]\nname = "cam0"\nsize = [640, 480]\nfps = 30.0\n'
CAMERA = 'id = "cam0"\nrig = "lens/rig.toml"\ndriver = "video"\n[video]\nsource = "/dev/syncline/usb-x"\n'


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """One configuration per role, and an empty image."""
    (tmp_path / "lens").mkdir()
    (tmp_path / "lens" / "rig.toml").write_text(RIG)
    (tmp_path / "cam0.toml").write_text(CAMERA)
    (tmp_path / "hub.toml").write_text('id = "main"\nout = "results"\n')
    (tmp_path / "recorder.toml").write_text('id = "recorder"\n')
    (tmp_path / "router.toml").write_text('id = "router"\n')
    (tmp_path / "image").mkdir()
    return tmp_path


def install(files: Path, role: str, *more: str) -> int:
    name = {"camera": "cam0"}.get(role, role)
    config = str(files / f"{name}.toml")
    return run(["install", role, "--config", config, "--root", str(files / "image"), *(more or PROGRAM)])


def everything(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): str(path.readlink()) if path.is_symlink() else path.read_text()
        for path in sorted(folder.rglob("*"))
        if not path.is_dir() or path.is_symlink()
    }


def test_everything_an_agent_needs_is_written(files: Path) -> None:
    assert install(files, "camera") == 0
    image = files / "image"
    assert set(everything(image)) == {
        "etc/syncline/camera-cam0/config.toml",
        "etc/syncline/camera-cam0/rig.toml",
        "etc/systemd/system/syncline-camera-cam0.service",
        "etc/systemd/system/multi-user.target.wants/syncline-camera-cam0.service",
        "etc/sysusers.d/syncline.conf",
        "etc/tmpfiles.d/syncline.conf",
        "etc/udev/rules.d/70-syncline.rules",
    }
    assert (image / "etc/syncline/camera-cam0/config.toml").stat().st_mode & 0o777 == 0o640
    written = tomllib.loads((image / "etc/syncline/camera-cam0/config.toml").read_text())
    assert written["rig"] == "rig.toml", "the unit gives both files as credentials in one folder"
    unit = (image / "etc/systemd/system/syncline-camera-cam0.service").read_text()
    for line in (
        "Type=notify",
        "WatchdogSec=10",
        "Restart=always",
        "RestartSec=1",
        "StartLimitIntervalSec=0",
        "DynamicUser=yes",
        "StateDirectory=syncline/camera-cam0",
        "LoadCredential=rig.toml:/etc/syncline/camera-cam0/rig.toml",
        "ExecStart=/opt/syncline/bin/syncline camera %d/config.toml",
    ):
        assert line in unit.splitlines(), line


def test_the_agent_accepts_the_installed_configuration(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert install(files, "camera") == 0
    capsys.readouterr()
    installed = files / "image/etc/syncline/camera-cam0/config.toml"
    assert run(["camera", str(installed), "--print-config"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["video"]["source"] == "/dev/syncline/usb-x"


def test_installation_is_idempotent_and_applies_a_changed_configuration(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert install(files, "hub") == 0
    before = everything(files / "image")
    capsys.readouterr()
    assert install(files, "hub") == 0
    assert capsys.readouterr().out == "nothing to change\n"
    assert everything(files / "image") == before
    (files / "hub.toml").write_text('id = "main"\nwindow_s = 30.0\n')
    assert install(files, "hub") == 0
    assert capsys.readouterr().out == "wrote /etc/syncline/hub-main/config.toml\n"


def test_state_is_below_var_lib_wherever_out_points(files: Path) -> None:
    assert install(files, "hub") == 0
    written = tomllib.loads((files / "image/etc/syncline/hub-main/config.toml").read_text())
    assert written["out"] == "/var/lib/syncline/hub-main/results"
    assert install(files, "recorder") == 0
    written = tomllib.loads((files / "image/etc/syncline/recorder-recorder/config.toml").read_text())
    assert written["out"] == "/var/lib/syncline/recorder-recorder"


def test_a_dry_run_prints_everything_and_changes_nothing(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert install(files, "camera", *PROGRAM, "--dry-run") == 0
    printed = capsys.readouterr().out
    assert everything(files / "image") == {}
    for word in ("syncline-camera-cam0.service", "70-syncline.rules", "run systemctl daemon-reload", "config.toml"):
        assert word in printed
    assert install(files, "camera", *PROGRAM, "--dry-run", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert install(files, "camera") == 0
    there = everything(files / "image")
    assert {place.lstrip("/"): text for place, text in plan["files"].items()}.items() <= there.items()


@pytest.mark.parametrize(
    ("role", "text", "expected_text"),
    [
        ("hub", 'id = "main"\nwindo_s = 3.0\n', "did you mean window_s"),
        ("hub", 'id = "main?"\n', "not allowed"),
        ("hub", 'id = "main"\nrig = "none.toml"\n', "cannot be read"),
        ("hub", 'id = "main"\nout = "/data"\n', "mount a larger disk at /var/lib/syncline"),
        ("hub", 'id = "main"\nout = "../../etc"\n', "below /var/lib/syncline/hub-main only"),
        ("hub", "id = ", "not valid TOML"),
        ("camera", 'id = "cam0"\ndriver = "video"\n', "needs a [video] table"),
        ("camera", 'id = "cam0"\ndriver = "video"\n[video]\nsource = "/home/me/a.mp4"\n', "may not read /home"),
    ],
)
def test_a_bad_configuration_is_refused_before_anything_is_changed(
    files: Path, capsys: pytest.CaptureFixture[str], role: str, text: str, expected_text: str
) -> None:
    (files / ("cam0.toml" if role == "camera" else "hub.toml")).write_text(text)
    assert install(files, role) == 2
    error = capsys.readouterr().err
    assert expected_text in error
    assert error.count("\n") == 1
    assert everything(files / "image") == {}


def test_a_program_that_no_service_can_read_is_refused(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert install(files, "hub", "--program", "/home/pi/.venv/bin/syncline") == 2
    assert "/opt/syncline" in capsys.readouterr().err
    assert install(files, "hub", "--program", "syncline") == 2
    assert everything(files / "image") == {}


def test_a_root_that_does_not_exist_is_refused(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["install", "hub", "--config", str(files / "hub.toml"), "--root", str(files / "nowhere")]) == 2
    assert "--root is not a folder" in capsys.readouterr().err


def test_uninstall_removes_the_service_and_keeps_user_data(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = files / "image"
    assert install(files, "camera") == install(files, "recorder") == 0
    recording = image / "var/lib/syncline/recorder-recorder/a.mcap"
    recording.parent.mkdir(parents=True)
    recording.write_text("dear")
    (image / "etc/systemd/system/other.service").write_text("not ours")
    assert run(["uninstall", "camera-cam0", "--root", str(image)]) == 0
    left = set(everything(image))
    assert "etc/systemd/system/syncline-camera-cam0.service" not in left
    assert "etc/systemd/system/multi-user.target.wants/syncline-camera-cam0.service" not in left
    assert "etc/systemd/system/syncline-recorder-recorder.service" in left
    assert "etc/udev/rules.d/70-syncline.rules" in left, "another agent still needs the rules"
    capsys.readouterr()
    assert run(["uninstall", "--root", str(image), "--purge"]) == 0
    # The first agent's configuration was kept when it went, and --purge of all takes the whole folder.
    assert set(everything(image)) == {
        "etc/systemd/system/other.service",
        "var/lib/syncline/recorder-recorder/a.mcap",
    }
    assert "kept: /var/lib/syncline" in capsys.readouterr().out
    assert run(["uninstall", "camera-cam0", "--root", str(image)]) == 2


def test_certificates_and_keys_are_installed_unreadable_by_others(files: Path) -> None:
    for name in ("ca.pem", "certificate.pem", "key.pem"):
        (files / name).write_text(f"-----BEGIN {name}-----\n")
    (files / "hub.toml").write_text(
        'id = "main"\n[bus]\nmode = "client"\nconnect = ["tls/192.168.1.5:7447"]\n'
        '[bus.tls]\nca = "ca.pem"\ncertificate = "certificate.pem"\nkey = "key.pem"\n'
    )
    assert install(files, "hub") == 0
    folder = files / "image/etc/syncline/hub-main"
    assert (folder / "key.pem").stat().st_mode & 0o777 == 0o600
    assert (folder / "key.pem").read_text() == "-----BEGIN key.pem-----\n"
    unit = (files / "image/etc/systemd/system/syncline-hub-main.service").read_text()
    assert "LoadCredential=key.pem:/etc/syncline/hub-main/key.pem" in unit.splitlines()
    assert tomllib.loads((folder / "config.toml").read_text())["bus"]["tls"]["key"] == "key.pem"


def test_an_unchanged_agent_is_not_restarted(files: Path) -> None:
    whole = plan_install("hub", files / "hub.toml", "/opt/syncline/bin/syncline")
    assert ["systemctl", "restart", "syncline-hub-main.service"] in _commands(whole, changed=True)
    assert _commands(whole, changed=False) == [["systemctl", "start", "syncline-hub-main.service"]]


@NEEDS_SYSTEMD
@pytest.mark.parametrize("role", sorted(units.ROLES))
def test_systemd_accepts_the_unit_with_a_good_security_score(role: str, tmp_path: Path) -> None:
    name = f"syncline-{role}-x.service"
    credentials = [
        ("config.toml", f"/etc/syncline/{role}-x/config.toml"),
        ("key.pem", f"/etc/syncline/{role}-x/key.pem"),
    ]
    text = units.service(f"{role}-x", role, "/usr/bin/env", credentials)
    (tmp_path / name).write_text(text)
    verified = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / name)], capture_output=True, text=True, timeout=60, check=False
    )
    assert verified.returncode == 0, verified.stderr
    assert verified.stderr.strip() == "", "verify only warns of unknown keys"
    scored = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", str(tmp_path / name)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", scored.stdout)
    assert found, scored.stderr
    assert float(found[1]) <= 2.0


HARDENED = (
    "NoNewPrivileges=yes",
    "CapabilityBoundingSet=",
    "AmbientCapabilities=",
    "ProtectSystem=strict",
    "ProtectHome=yes",
    "PrivateTmp=yes",
    "ProtectProc=invisible",
    "ProtectClock=yes",
    "ProtectHostname=yes",
    "ProtectKernelLogs=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelTunables=yes",
    "ProtectControlGroups=yes",
    "DynamicUser=yes",
    "DevicePolicy=closed",
    "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK",
    "RestrictNamespaces=yes",
    "RestrictRealtime=yes",
    "RestrictSUIDSGID=yes",
    "LockPersonality=yes",
    "MemoryDenyWriteExecute=yes",
    "RemoveIPC=yes",
    "SystemCallArchitectures=native",
    "SystemCallFilter=@system-service",
    "SystemCallFilter=~@resources @privileged",
    "UMask=0027",
)


@pytest.mark.parametrize("role", sorted(units.ROLES))
def test_every_hardening_option_is_present(role: str) -> None:
    """Without one of them the score changes by a few tenths and stays below its limit, so each is checked."""
    lines = units.service(f"{role}-x", role, "/usr/bin/syncline", []).splitlines()
    for line in HARDENED:
        assert lines.count(line) == 1, line
    # Twice is a list of both for systemd, and an empty one afterwards takes the first back.
    keys = [line.partition("=")[0] for line in lines if "=" in line and not line.startswith("#")]
    assert {key for key in keys if keys.count(key) > 1} <= {"SystemCallFilter", "DeviceAllow"}
    devices = {line for line in lines if line.startswith("DeviceAllow=")}
    if role in ("camera", "uav"):
        cameras = {"DeviceAllow=char-video4linux rw", "DeviceAllow=char-usb_device rw"}
        serial = {f"DeviceAllow=char-tty{kind} rw" for kind in ("ACM", "USB", "AMA", "S")}
        assert devices == (cameras | serial if role == "uav" else cameras)
        assert "PrivateDevices=yes" not in lines
    else:
        assert devices == set()
        assert {"PrivateDevices=yes", "PrivateUsers=yes"} <= set(lines)


@pytest.mark.parametrize("role", sorted(units.ROLES))
def test_a_watchdog_triggers_within_a_minute(role: str) -> None:
    lines = units.service(f"{role}-x", role, "/usr/bin/syncline", []).splitlines()
    (watchdog,) = (int(line.partition("=")[2]) for line in lines if line.startswith("WatchdogSec="))
    (stopping,) = (int(line.partition("=")[2]) for line in lines if line.startswith("TimeoutStopSec="))
    assert 0 < watchdog <= 60
    assert 0 < stopping <= 60


@NEEDS_SYSTEMD
def test_a_wrong_unit_is_detected(tmp_path: Path) -> None:
    text = units.service("hub-x", "hub", "/usr/bin/env", []).replace("Restart=always", "Restart=perhaps")
    (tmp_path / "syncline-hub-x.service").write_text(text)
    verified = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / "syncline-hub-x.service")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "perhaps" in verified.stderr


@pytest.mark.skipif(
    shutil.which("systemd-tmpfiles") is None or os.geteuid() != 0,
    reason="needs systemd-tmpfiles, systemd-sysusers and root: SYSUSERS AND TMPFILES ARE NOT CHECKED",
)
def test_sysusers_and_tmpfiles_have_the_intended_effect(files: Path) -> None:
    image = files / "image"
    assert install(files, "hub") == 0
    for command in (
        ["systemd-sysusers", f"--root={image}"],
        ["systemd-tmpfiles", f"--root={image}", "--create"],
    ):
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert ended.returncode == 0, ended.stderr
    assert re.search(r"^syncline:", (image / "etc/group").read_text(), re.M)
    assert (image / "etc/syncline").stat().st_mode & 0o777 == 0o750
    assert (image / "var/lib/syncline").is_dir()


def test_udev_rules_are_valid() -> None:
    """udevadm learnt to verify only in systemd 254: keys, operators and quotes by hand."""
    rules = [line for line in units.udev_rules().splitlines() if line and not line.startswith("#")]
    token = re.compile(
        r"(ACTION|SUBSYSTEM|KERNEL|MODE|GROUP|TAG|SYMLINK|GOTO|LABEL|ENV\{[A-Z_]+\}|ATTR\{[A-Za-z]+\})"
        r'(==|\+=|=)"[^"]*"\Z'
    )
    for rule in rules:
        for part in re.split(r',\s*(?=(?:[^"]*"[^"]*")*[^"]*\Z)', rule):
            assert token.match(part), part
    text = "\n".join(rules)
    assert '"03e7"' in text
    assert 'SYMLINK+="syncline/port-$env{ID_PATH}"' in text
    assert text.count('GOTO="syncline_end"') == text.count('LABEL="syncline_end"') == 1


def test_without_udev_the_installation_goes_on_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, script in (("udevadm", "echo no socket >&2; exit 1"), ("systemctl", f"echo $1 >> {tmp_path}/done")):
        (tools / name).write_text(f"#!/bin/sh\n{script}\n")
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tools), prepend=":")
    changes: list[str] = []
    _run([["udevadm", "control", "--reload"], ["systemctl", "daemon-reload"], ["systemctl", "restart", "x"]], changes)
    assert changes[0] == "left out: udevadm control --reload (no socket)"
    assert (tmp_path / "done").read_text().split() == ["daemon-reload", "restart"]


def test_a_hub_that_goes_on_from_its_last_answer_can_be_installed(files: Path) -> None:
    (files / "hub.toml").write_text('id = "main"\nknown = "last"\n')
    assert install(files, "hub") == 0
    written = tomllib.loads((files / "image/etc/syncline/hub-main/config.toml").read_text())
    assert written["known"] == "last"
