"""Fifty boards from one file: keys made on the boards, enrolment, renewal, revocation, staged rollout with rollback."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

pytest.importorskip("cryptography", reason="the extra `keys` is not installed: enrolment is not tested")
from deploy.cli import run
from deploy.config.agents import CameraConfig, HubConfig, RouterConfig
from deploy.config.file import load
from deploy.site import keys
from deploy.site.boards import board, operations
from deploy.site.boards.site_file import Site, SiteAgent, read_site_file
from deploy.site.boards.transport import board_of
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.security.tls import common_name, validity
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError, Refused
from protocols.topics import OBSERVATION
from tests.support.samples import eventually, observation

BOARDS = 50


def write_site(folder: Path, endpoint: str, hosts: str = "root:{boards}/{{00..49}}", more: str = "") -> Path:
    file = folder / "site.toml"
    boards = folder / "boards"
    file.write_text(
        f"""site = "yard"
{more}
[[agent]]
role = "router"
id = "r0"
host = "root:{boards}/main"
listen = ["{endpoint}"]
[[agent]]
role = "hub"
id = "hub"
host = "root:{boards}/main"
[[agent]]
role = "camera"
id = "cam{{00..49}}"
host = "{hosts.format(boards=boards)}"
[defaults.camera]
driver = "simulated"
""",
        encoding="utf-8",
    )
    return file


def installed(folder: Path, where: str, name: str) -> Path:
    """The configuration that the agent's service runs with."""
    return folder / "boards" / where / "etc/syncline" / name / "config.toml"


def heard(folder: Path, numbers: range) -> set[str]:
    """Cameras whose observations reach the hub through the router, all with what is installed on their boards."""
    router = load(installed(folder, "main", "router-r0"), RouterConfig)
    hub = load(installed(folder, "main", "hub-hub"), HubConfig)
    got: set[str] = set()
    with Router(config=router.bus), open_bus("yard", hub.bus, timeout_s=10.0) as receiving:
        subscription = receiving.subscribe(OBSERVATION)
        for number in numbers:
            camera = load(installed(folder, f"{number:02d}", f"camera-cam{number:02d}"), CameraConfig)
            with open_bus("yard", camera.bus, timeout_s=10.0) as bus:
                publisher = bus.publisher(OBSERVATION, camera.id)
                if publisher.wait_matched(1.0):
                    publisher.put(observation(camera.id))
                    eventually(lambda: got.update(one.agent for one in subscription.drain()) or camera.id in got)  # noqa: B023
    return got


def test_fifty_boards_are_enrolled_renewed_and_one_is_revoked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_site(tmp_path, free_endpoint().replace("tcp/", "tls/"))
    assert run(["site", "init", str(file)]) == 0
    assert run(["site", "enrol", str(file)]) == 0
    assert "52 of 52 enrolled" in capsys.readouterr().out
    # Every key was made on its board, and stayed there.
    assert [path.name for path in (tmp_path / "keys").rglob("*key*.pem")] == ["ca-key.pem"]
    private = {path.read_bytes() for path in (tmp_path / "boards").glob("*/etc/syncline/site/*/key.pem")}
    assert len(private) == 52
    assert heard(tmp_path, range(0, BOARDS, 10)) == {"cam00", "cam10", "cam20", "cam30", "cam40"}

    certificate = installed(tmp_path, "07", "camera-cam07").with_name("certificate.pem")
    before, key = validity(certificate)[1], certificate.with_name("key.pem").read_bytes()
    site = read_site_file(file)
    later = datetime.now(UTC) + timedelta(days=25)
    assert operations.renew(site, site.agents, lambda a: board_of(site, a), lambda line: None, every=False) == ([], [])
    done, failed = operations.renew(
        site, site.agents, lambda a: board_of(site, a), lambda line: None, every=False, now=later
    )
    assert (len(done), failed) == (52, [])
    assert validity(certificate)[1] >= before
    assert certificate.with_name("key.pem").read_bytes() != key, "a new key each time"

    assert run(["site", "revoke", str(file), "cam10"]) == 0
    assert heard(tmp_path, range(0, 30, 10)) == {"cam00", "cam20"}
    capsys.readouterr()
    assert run(["site", "status", str(file), "--json"]) == 0
    rows = {row["agent"]: row for row in json.loads(capsys.readouterr().out)}
    assert len(rows) == 52
    assert rows["camera-cam10"]["certificate"] == "revoked"
    assert 29.0 < rows["camera-cam11"]["days"] <= 30.0

    assert run(["site", "enrol", str(file), "cam10"]) == 0
    assert common_name(installed(tmp_path, "10", "camera-cam10").with_name("certificate.pem")) == "camera.cam10.2"
    assert heard(tmp_path, range(10, 20, 10)) == {"cam10"}


def test_a_stick_carries_requests_and_certificates_but_no_key(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_site(tmp_path, "tls/127.0.0.1:7447", hosts="stick")
    stick, root = tmp_path / "stick", tmp_path / "board"
    root.mkdir()
    who = ["--role", "camera", "--id", "cam03"]
    assert run(["site", "init", str(file)]) == 0
    assert run(["site", "request", *who, "--out", str(stick / "requests"), "--root", str(root)]) == 0
    assert run(["site", "enrol", str(file), "--stick", str(stick)]) == 0
    assert "1 of 1 enrolled" in capsys.readouterr().out
    assert run(["site", "accept", str(stick / "boards/camera-cam03.tar"), "--root", str(root)]) == 0
    assert b"PRIVATE" not in b"".join(path.read_bytes() for path in stick.rglob("*") if path.is_file())
    config = load(root / "etc/syncline/camera-cam03/config.toml", CameraConfig)
    assert config.bus.tls is not None
    assert common_name(config.bus.tls.certificate) == "camera.cam03"
    # What is for another board does not fit this one's key.
    with pytest.raises(InputError, match="do not match"):
        board.accept("camera", "cam03", {"certificate.pem": (tmp_path / "keys/ca.pem").read_bytes()}, root)
    assert load(root / "etc/syncline/camera-cam03/config.toml", CameraConfig) == config


def test_a_board_is_reached_by_ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With an ssh that runs what it is given here, below a folder of the board's."""
    root, tools = tmp_path / "board", tmp_path / "tools"
    root.mkdir()
    tools.mkdir()
    program = tools / "syncline"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m deploy "$@" --root {root}\n')
    (tools / "ssh").write_text('#!/bin/sh\nfor last; do :; done\n[ "$6" = pi@board ] || exit 255\nexec sh -c "$last"\n')
    for tool in tools.iterdir():
        tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tools), prepend=":")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[3]))
    more = f'program = "{program}"\ntime_servers = ["192.168.1.5"]'
    file = write_site(tmp_path, "tls/127.0.0.1:7447", hosts="pi@board", more=more)
    assert run(["site", "init", str(file)]) == 0
    site = read_site_file(file)
    (camera,) = operations.selected(site, ["cam05"])
    said: list[str] = []
    assert operations.enrol(site, [camera], lambda a: board_of(site, a), said.append) == [], said
    assert load(root / "etc/syncline/camera-cam05/config.toml", CameraConfig).bus.tls is not None
    assert "NTP=192.168.1.5" in (root / "etc/systemd/timesyncd.conf.d/70-syncline.conf").read_text()
    good, text = board_of(site, camera).ready(0.0)
    assert (good, "no answer at 127.0.0.1:9100" in text) == (False, True), text
    away = SiteAgent("camera", "cam06", "pi@elsewhere", (), {})
    with pytest.raises(Refused, match="pi@elsewhere is not reached"):
        board_of(site, away).request()


def test_a_board_without_a_clock_takes_it_from_the_authority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys.make_site(tmp_path / "keys", "yard")
    certificate = keys.issue(tmp_path / "keys", "camera", "cam00").folder / "certificate.pem"
    begin = validity(certificate)[0]
    board._take_time(certificate, tmp_path / "image")
    assert (tmp_path / "image/usr/lib/clock-epoch").stat().st_mtime == begin, "systemd begins no earlier"

    clock = [1000.0]
    monkeypatch.setattr("deploy.site.boards.board._EPOCH", str(tmp_path / "epoch"))
    monkeypatch.setattr("deploy.site.boards.board.time.time", lambda: clock[0])
    monkeypatch.setattr(
        "deploy.site.boards.board.time.clock_settime", lambda which, moment: clock.__setitem__(0, moment)
    )
    assert "set the clock" in board._take_time(certificate, Path("/"))[0]
    assert clock[0] >= begin
    assert board._take_time(certificate, Path("/")) == []


def test_an_image_installs_its_bundle_at_the_first_start(tmp_path: Path) -> None:
    root, bundle = tmp_path / "image", tmp_path / "bundle"
    (root / "etc").mkdir(parents=True)
    bundle.mkdir()
    assert run(["site", "image", str(root), "--bundle", str(bundle)]) == 2, "there is no bundle"
    (bundle / "install.sh").write_text('mkdir -p "$1/bin"; touch "$1/bin/syncline"')
    assert run(["site", "image", str(root), "--bundle", str(bundle)]) == 0
    unit = root / "etc/systemd/system/multi-user.target.wants/syncline-first-start.service"
    script = re.findall("ExecStart=/bin/sh (.*)", unit.read_text())[0]
    subprocess.run(["sh", str(root / script.lstrip("/"))], env={**os.environ, "ROOT": str(root)}, check=True)
    assert (root / "opt/syncline/current/bin/syncline").exists()
    assert not (root / "var/lib/syncline-bundle").exists()


class FakeBoard:
    """A board whose agent is ready or not; what was done to it."""

    def __init__(self, good: bool = True) -> None:
        self.good, self.done = good, list[str]()

    def request(self) -> str:
        raise AssertionError("a rollout asks for no certificate")

    def accept(self, files: Mapping[str, bytes]) -> list[str]:
        self.done.append("accept")
        return []

    def restore(self) -> None:
        self.done.append("restore")

    def update(self, bundle: Path) -> str:
        self.done.append("update")
        if not self.good:
            raise Refused("the new version is not ready: returned to the old one")
        return "ready"

    def ready(self, patience_s: float) -> tuple[bool, str]:
        return self.good, "a reason"


@pytest.mark.parametrize("bundle", [None, Path("bundle")])
def test_a_rollout_goes_in_stages_and_stops_at_a_board_that_is_not_ready(tmp_path: Path, bundle: Path | None) -> None:
    site = enrolled(tmp_path)
    boards = {agent.name: FakeBoard(good=agent.id != "cam15") for agent in site.agents}
    done, problem = operations.rollout(
        site, site.agents, lambda a: boards[a.name], lambda line: None, bundle=bundle, batch=10
    )
    assert "cam15" in problem
    touched = {name for name, one in boards.items() if one.done}
    first = {"router-r0", "hub-hub", "camera-cam00"}
    assert touched == first | {f"camera-cam{number:02d}" for number in range(1, 21)}, "no board after that stage"
    assert set(done) == touched - {"camera-cam15"}
    assert ("restore" in boards["camera-cam15"].done) == (bundle is None), "a version goes back by itself, on the board"


def enrolled(tmp_path: Path) -> Site:
    file = write_site(tmp_path, "tls/127.0.0.1:7447")
    assert run(["site", "init", str(file)]) == 0
    assert run(["site", "enrol", str(file)]) == 0
    return read_site_file(file)


def test_a_version_that_is_not_ready_makes_way_for_the_old_one(tmp_path: Path) -> None:
    """A and B: the bundle's own script installs, the link says which one runs."""
    home, restarts = tmp_path / "opt", list[str]()

    def bundle(version: str) -> Path:
        folder = tmp_path / version
        folder.mkdir()
        (folder / "install.sh").write_text(f'mkdir -p "$1"; echo {version} > "$1/version"; [ {version} != broken ]')
        return folder

    def running() -> str:
        return (home / "current" / "version").read_text().strip()

    def update(version: str) -> str:
        return board.update(
            bundle(version), home, lambda: restarts.append(running()), lambda: (running() != "bad", running())
        )

    assert update("one") == "one"
    assert update("two") == "two"
    assert (home / "current").readlink().name == "b"
    with pytest.raises(Refused, match=r"not ready \(bad\): returned to the old one, which is ready again"):
        update("bad")
    assert running() == "two"
    with pytest.raises(Refused, match="not updated"):
        update("broken")
    assert (running(), restarts) == ("two", ["one", "two", "bad", "two"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('id = "cam{00..49}"', "are 50 agents"),
        ('driver = "simulated"', "drivr"),
        ('role = "hub"', "role"),
    ],
)
def test_a_wrong_site_file_is_refused_with_what_is_wrong(tmp_path: Path, change: str, message: str) -> None:
    file = write_site(tmp_path, "tls/127.0.0.1:7447")
    wrong = {
        'id = "cam{00..49}"': ('host = "root:' + str(tmp_path / "boards") + '/{00..49}"', 'host = "root:/x/{00..47}"'),
        'driver = "simulated"': ('driver = "simulated"', 'drivr = "simulated"'),
        'role = "hub"': ('role = "hub"', 'role = "boss"'),
    }[change]
    file.write_text(file.read_text().replace(*wrong))
    keys.make_site(tmp_path / "keys", "yard")

    def enrol_all() -> None:
        site = read_site_file(file)
        operations.enrol(site, site.agents, lambda a: board_of(site, a), lambda line: None)

    with pytest.raises(InputError, match=message):
        enrol_all()
    assert not (tmp_path / "boards").exists(), "nothing was made"
