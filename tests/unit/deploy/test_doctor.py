"""`syncline doctor`: every remedy is given for its problem only."""

from __future__ import annotations

import errno
import json
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from deploy.agents.health import Health, HealthServer
from deploy.cli import run
from deploy.config.agents import HealthConfig, HubConfig
from deploy.site.doctor import agent, autopilot, machine, selection
from deploy.site.doctor.check_result import CheckResult, exit_status, misconfigured, ok, unavailable, warn
from edge.agents.clock_quality import kernel_clock
from edge.devices.base import DeviceInfo, Frame
from protocols.bus.settings import BusConfig
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb

ONE_LINE = 400


def check(finding: CheckResult, verdict: str, remedy: str = "") -> None:
    """Check the status and a part of the remedy, and that text and remedy are one line each."""
    assert finding.verdict == verdict, finding
    assert remedy in finding.remedy, finding.remedy
    assert "\n" not in finding.text + finding.remedy
    assert (finding.verdict in ("warn", "fail")) == bool(finding.remedy)
    assert (finding.exit_status != 0) == (finding.verdict == "fail")
    assert len(finding.text) + len(finding.remedy) < ONE_LINE


def test_python() -> None:
    check(machine.python((3, 11, 2), 64), "ok")
    check(machine.python((3, 9, 18), 64), "fail", "install Python 3.11")
    check(machine.python((3, 12, 0), 32), "fail", "64-bit system")


def test_packages() -> None:
    check(machine.packages(("camera",), lambda name: True), "ok")
    check(machine.packages(("uav",), lambda name: name != "pymavlink"), "fail", 'pip install "syncline[uav]"')
    check(machine.packages(("camera", "oak"), lambda name: name != "depthai"), "fail", 'pip install "syncline[oak]"')
    check(machine.packages(("hub",), lambda name: name != "scipy"), "fail", "syncline bundle")
    check(machine.packages(("camera", "log"), lambda name: name != "mcap"), "fail", "force-reinstall")
    check(machine.packages(("camera", "simulated"), lambda name: name != "linuxpy"), "ok")


def test_a_usb_camera_without_linuxpy_gets_a_warning() -> None:
    without = machine.packages(("camera", "usb"), lambda name: name != "linuxpy")
    check(without, "warn", 'pip install "syncline[v4l2]"')
    assert "stamped on arrival" in without.text
    check(machine.packages(("camera", "usb"), lambda name: True), "ok")
    check(machine.packages(("camera", "usb"), lambda name: name not in ("linuxpy", "cv2")), "fail", "force-reinstall")


def cpu_root(tmp_path: Path, flags: str, heat: int | None = None) -> Path:
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/cpuinfo").write_text("".join(f"processor : {k}\nflags : {flags}\n" for k in range(4)))
    if heat is not None:
        zone = tmp_path / "sys/class/thermal/thermal_zone0"
        zone.mkdir(parents=True)
        (zone / "temp").write_text(f"{heat}\n")
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "flags", "heat", "verdict", "remedy"),
    [
        ("aarch64", "fp asimd crc32", 55_000, "ok", ""),
        ("x86_64", "sse4_2 popcnt avx", None, "ok", ""),
        ("x86_64", "sse2", None, "fail", "use a newer processor"),
        ("armv7l", "neon", None, "fail", "64-bit ARM or x86"),
        ("aarch64", "asimd", 84_000, "warn", "cool it"),
    ],
)
def test_cpu(tmp_path: Path, kind: str, flags: str, heat: int | None, verdict: str, remedy: str) -> None:
    check(machine.cpu(cpu_root(tmp_path, flags, heat), kind), verdict, remedy)


def test_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check(machine.disk(tmp_path / "not-yet" / "there", free=lambda place: 50 * 10**9), "ok")
    check(machine.disk(tmp_path, 200.0, lambda place: 150 * 10**6), "fail", "make room")
    check(machine.disk(tmp_path, 200.0, lambda place: 900 * 10**6), "warn", "part_s and part_mb")
    monkeypatch.setattr("os.access", lambda place, mode: False)
    check(machine.disk(tmp_path), "fail", "rights there")


def camera_on_usb(root: Path, name: str, port: str, speed: str, bus: str = "1") -> None:
    device = root / "sys/devices/usb" / port
    (device / "interface").mkdir(parents=True)
    (device / "speed").write_text(f"{speed}\n")
    (device / "busnum").write_text(f"{bus}\n")
    node = root / "sys/class/video4linux" / name
    node.mkdir(parents=True)
    (node / "index").write_text("0\n")
    (node / "device").symlink_to(device / "interface")


def test_usb(tmp_path: Path) -> None:
    camera_on_usb(tmp_path, "video0", "1-1", "480")
    camera_on_usb(tmp_path, "video2", "1-2", "12")
    check(machine.usb("0", tmp_path), "ok")
    check(machine.usb("/dev/video2", tmp_path), "fail", "another cable or socket")
    check(machine.usb("/dev/video9", tmp_path), "skip")
    camera_on_usb(tmp_path, "video4", "1-3", "480")
    check(machine.usb("0", tmp_path), "warn", "spread the cameras")
    (tmp_path / "dev/syncline").mkdir(parents=True)
    (tmp_path / "dev/video2").touch()
    (tmp_path / "dev/syncline/port-x").symlink_to(tmp_path / "dev/video2")
    check(machine.usb("/dev/syncline/port-x", tmp_path), "fail", "another cable or socket")


def test_oak_on_usb(tmp_path: Path) -> None:
    check(machine.oak_usb(tmp_path), "fail", "check cable and power")
    board = tmp_path / "sys/bus/usb/devices/2-1"
    board.mkdir(parents=True)
    (board / "idVendor").write_text("03e7\n")
    (board / "speed").write_text("5000\n")
    check(machine.oak_usb(tmp_path), "ok")
    (board / "speed").write_text("480\n")
    check(machine.oak_usb(tmp_path), "warn", "USB 3 cable")


def test_clock() -> None:
    def good() -> tuple[bool, float]:
        return True, 0.01

    def loose() -> tuple[bool, float]:
        return False, 16.0

    check(machine.clock(True, good, lambda: 1.8e9), "ok")
    check(machine.clock(False, loose, lambda: 1.8e9), "warn", "install chrony")
    check(machine.clock(True, loose, lambda: 1000.0), "fail", "timedatectl set-ntp")
    check(machine.clock(False, loose, lambda: 1000.0), "warn", "timedatectl set-ntp")


def test_the_kernels_clock_state_can_be_read() -> None:
    synchronised, error = kernel_clock()
    assert isinstance(synchronised, bool)
    assert error >= 0.0


@pytest.mark.parametrize(
    ("result", "remedy"),
    [
        ("watchdog", "no data flowed"),
        ("oom-kill", "memory was full"),
        ("core-dump", "coredumpctl info syncline-camera-cam0.service"),
        ("signal", "killed it"),
        ("exit-code", "journalctl -u syncline-camera-cam0.service -n 20"),
        ("timeout", "is the router up"),
    ],
)
def test_last_crash(result: str, remedy: str) -> None:
    text = f"Id=syncline-camera-cam0.service\nResult={result}\nNRestarts=3\nActiveState=active\nExecMainStatus=1\n"
    check(machine.crash("syncline-camera-cam0.service", lambda command: (0, text)), "warn", remedy)


def test_no_crash_and_no_systemd() -> None:
    calm = "Id=syncline-hub-main.service\nResult=success\nNRestarts=0\nActiveState=active\nExecMainStatus=0\n"
    check(machine.crash("syncline-*", lambda command: (0, calm)), "ok")
    restarted = calm.replace("NRestarts=0", "NRestarts=7")
    check(machine.crash("syncline-*", lambda command: (0, restarted)), "warn", "journalctl")
    check(machine.crash("syncline-*", lambda command: (127, "")), "skip")
    check(machine.crash("x", lambda command: (0, calm.replace("=active", "=inactive"))), "skip")


JOURNAL_EXIT, JOURNAL_FAILED = "98e322203f7a4ed290d09fe03c09fe15", "d9b373ed55a64feb8242e02dbe79a49c"


@pytest.mark.parametrize(
    ("exit_code", "exit_status", "unit_result", "text", "remedy"),
    [
        ("killed", "ABRT", "watchdog", "watchdog (by SIGABRT), restarted 3 times", "no data flowed"),
        ("killed", "KILL", "signal", "signal (by SIGKILL)", "killed it"),
        ("killed", "9", "oom-kill", "oom-kill (by SIGKILL)", "memory was full"),
        ("exited", "2", "exit-code", "exit-code (with status 2)", "shows the reason"),
        ("", "", "", "ended, restarted 3 times", "ask as root"),
    ],
)
def test_what_ended_a_service_that_runs_again_is_in_the_journal(
    exit_code: str, exit_status: str, unit_result: str, text: str, remedy: str
) -> None:
    entries = [
        {"MESSAGE_ID": JOURNAL_FAILED, "UNIT_RESULT": unit_result},
        {"MESSAGE_ID": JOURNAL_EXIT, "EXIT_CODE": exit_code, "EXIT_STATUS": exit_status},
        {"MESSAGE_ID": JOURNAL_FAILED, "UNIT_RESULT": "an older one"},
    ]
    journal = "\n".join(json.dumps(entry) for entry in entries) if unit_result else "No entries"

    def ask(command: Sequence[str]) -> tuple[int, str]:
        shown = "Id=syncline-hub-a.service\nResult=success\nNRestarts=3\nActiveState=active\nExecMainStatus=0\n"
        return 0, journal if command[0] == "journalctl" else shown

    found = machine.crash("syncline-hub-a.service", ask)
    check(found, "warn", remedy)
    assert text in found.text
    assert "refused" not in found.text + found.remedy


@pytest.mark.parametrize(
    ("answers", "source"),
    [
        ({"chronyc": "C0A80105,192.168.1.5,4,1.0,0,0,0,0,0,0,0,0,0,Normal"}, "192.168.1.5, by chrony"),
        ({"chronyc": "00000000,,0,0,0,0,0,0,0,0,0,0,0,Not synchronised"}, "chrony, without a source yet"),
        (
            {"timedatectl": "ServerName=hub.local\nServerAddress=192.168.1.5"},
            "hub.local (192.168.1.5), by systemd-timesyncd",
        ),
        ({}, "none known"),
    ],
)
def test_the_clocks_source_is_named(answers: dict[str, str], source: str) -> None:
    def ask(command: Sequence[str]) -> tuple[int, str]:
        return (0, answers[command[0]]) if command[0] in answers else (127, "")

    found = machine.clock(False, lambda: (True, 0.01), lambda: 1.8e9, ask)
    assert found.text == f"synchronised, within 10 ms; time source: {source}"


def test_two_network_troubles_read_differently(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails_with(error: OSError) -> Callable[..., None]:
        def connect(place: tuple[str, int], timeout: float) -> None:
            raise error

        return connect

    texts = []
    for error, remedy in (
        (ConnectionRefusedError(errno.ECONNREFUSED, "refused"), "start one there"),
        (TimeoutError(), "firewall"),
        (OSError(errno.EHOSTUNREACH, "no route"), "cable in"),
        (OSError(errno.ENETUNREACH, "no network"), "DHCP"),
        (socket.gaierror(-2, "Name or service not known"), "/etc/hosts"),
    ):
        monkeypatch.setattr("deploy.site.doctor.agent.socket.create_connection", fails_with(error))
        found = agent.reach("tcp/router.site:7447")
        assert found is not None
        check(found, "fail", remedy)
        texts.append(found.text)
    assert len(set(texts)) == len(texts)


def test_a_check_that_cannot_be_made_does_not_end_the_table(
    quiet_machine: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unreadable(*_: object) -> CheckResult:
        raise PermissionError(errno.EACCES, "Permission denied", "/srv/recordings")

    monkeypatch.setattr(machine, "disk", unreadable)
    (tmp_path / "router.toml").write_text('id = "router"\n')
    assert run(["doctor", str(tmp_path / "router.toml")]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert "fail disk: /srv/recordings may not be read by this user; run doctor as root (sudo), or give rights" in lines
    assert any(line.startswith("ok   crash") for line in lines), "the last check is made too"


def test_a_running_agent_is_asked_for_its_health() -> None:
    health = Health(site="local", role="hub", agent="hub")
    with HealthServer(HealthConfig(listen="127.0.0.1:0"), health) as server:
        config = HubConfig(health=HealthConfig(listen=server.address))
        health.seen(pb.AgentStatus(agent="hub", role="hub", state="degraded", message="no router at x for 3 s"))
        found = agent.running_agent(config)
        check(found, "warn", "names")
        assert found.text == "degraded: no router at x for 3 s"
        health.seen(pb.AgentStatus(agent="hub", role="hub", state="running", message="3 cameras calibrated"))
        check(agent.running_agent(config), "ok")
        check(agent.running_agent(msgspec.structs.replace(config, id="hub2")), "fail", "port of its own")
    check(agent.running_agent(config), "fail", "start it")
    check(agent.running_agent(HubConfig()), "skip")


class Device:
    """A camera that opens or fails, and gives frames of one grey level every 33 ms of the test's clock."""

    def __init__(self, level: int | None, period_s: float = 1 / 30, error: InputError | None = None) -> None:
        self.info = DeviceInfo(64, 48, 30.0, "test", "monotonic")
        self.ended = False
        self.time = 0.0
        self.closed = False
        self._level, self._period_s, self._error = level, period_s, error

    def open(self) -> None:
        if self._error is not None:
            raise self._error

    def read(self, timeout_s: float) -> Frame | None:
        self.time += timeout_s if self._level is None else self._period_s
        return None if self._level is None else Frame(np.full((48, 64, 3), self._level, np.uint8), 0, 0)

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("device", "verdict", "remedy"),
    [
        (Device(90), "ok", ""),
        (Device(None), "fail", "unplug it and plug it in again"),
        (Device(2), "warn", "lens cap"),
        (Device(253), "warn", "shorten the exposure"),
        (Device(90, 0.1), "warn", "more light"),
        (Device(90, error=InputError("camera 0 does not answer", remedy="plug it in")), "fail", "plug it in"),
    ],
)
def test_camera(device: Device, verdict: str, remedy: str) -> None:
    check(agent.camera(device, now=lambda: device.time), verdict, remedy)


class Vehicle:
    """A MAVLink connection that receives messages of these kinds, with counters."""

    def __init__(self, kinds: tuple[str, ...] = (), problem: str = "", counters: Counter[str] | None = None) -> None:
        self._kinds, self.problem, self.counters = list(kinds), problem, counters or Counter()
        self.time = 0.0

    def wait(self, timeout_s: float) -> None:
        self.time += timeout_s

    def send(self, message: Any) -> bool:
        raise AssertionError("it must only receive")

    def poll(self) -> list[Any]:
        return [SimpleNamespace(kind=self._kinds.pop(0), system=1)] if self._kinds else []


@pytest.mark.parametrize(
    ("link", "verdict", "remedy"),
    [
        (Vehicle(("ATTITUDE", "HEARTBEAT")), "ok", ""),
        (Vehicle(), "fail", "TX to RX"),
        (Vehicle(problem="/dev/ttyAMA0: Permission denied"), "fail", "group dialout"),
        (Vehicle(problem="Address already in use"), "fail", "stop the agent"),
        (Vehicle(problem="the autopilot signs with another key"), "fail", "the same key in both"),
        (Vehicle(counters=Counter(garbage=40)), "fail", "baud rate, MAVLink 2"),
    ],
)
def test_mavlink(link: Vehicle, verdict: str, remedy: str) -> None:
    check(autopilot.wait_for_heartbeat(link, now=lambda: link.time), verdict, remedy)


ATTITUDES = [0.02 * k for k in range(100)]
FLYING = {"samples": ATTITUDES, "synchronised": True}


@pytest.mark.parametrize(
    ("heard", "verdict", "remedy"),
    [
        (FLYING, "ok", ""),
        ({"samples": ATTITUDES}, "warn", "both directions"),
        ({**FLYING, "samples": ATTITUDES[::5]}, "warn", "a faster port"),
        ({}, "fail", "SERIALx_PROTOCOL = 2"),
        ({"gimbal": True}, "fail", "MNT1_TYPE"),
        ({"samples": ATTITUDES, "ignores_unsigned": True}, "fail", "set key"),
    ],
)
def test_vehicle_telemetry(heard: dict[str, Any], verdict: str, remedy: str) -> None:
    found = autopilot.Heard(**{name: value for name, value in heard.items() if name != "gimbal"})
    check(autopilot.telemetry(found, gimbal=heard.get("gimbal", False), rate_hz=50.0), verdict, remedy)


def test_another_vehicle_and_a_gimbal_that_is_not_used_are_named() -> None:
    heard = autopilot.Heard(second="system 2 is on this link too", gimbal=True)
    vehicle, gimbal = autopilot.unused(heard, 1, gimbal=False)
    check(vehicle, "warn", "set vehicle")
    check(gimbal, "warn", 'mount = "gimbal"')
    assert list(autopilot.unused(autopilot.Heard(gimbal=True), 1, gimbal=True)) == []
    reports = {"report": lambda _: "10.0.0.9:5000 sends as well", "second_sender": lambda _: ""}
    link = SimpleNamespace(counters=Counter(), **reports)
    heard = autopilot.listen(link, None, gimbal=False, rate_hz=30.0, seconds=0.0)
    assert list(autopilot.unused(heard, 1, gimbal=False)) == []


@pytest.mark.parametrize(
    ("firmware", "parameters", "text", "remedy"),
    [
        ("PX4", {"MAV_0_FORWARD": 1e-45, "MAV_1_FORWARD": 0.0}, "MAV_1_FORWARD = 0", "set MAV_x_FORWARD = 1"),
        ("PX4", {"MAV_1_FORWARD": 1e-45}, "none is heard", "two --out do not meet"),
        ("PX4", {"MAV_2_FORWARD": 0.0, "MAV_2_CONFIG": 0.0}, "none is heard", "two --out do not meet"),  # unused
        ("PX4", {"MAV_2_FORWARD": 0.0, "MAV_2_CONFIG": 1.4e-43}, "MAV_2_FORWARD = 0", "set MAV_x_FORWARD = 1"),
        ("PX4", {"MAV_HB_FORW_EN": 0.0}, "MAV_HB_FORW_EN = 0", "MAV_HB_FORW_EN = 1"),
        ("ArduPilot", {"MAV2_OPTIONS": 2.0, "SERIAL2_OPTIONS": 0.0}, "MAV2_OPTIONS has bit 1", "bit 1 of MAVx_OPTIONS"),
        ("ArduPilot", {"SERIAL2_OPTIONS": 1024.0}, "SERIAL2_OPTIONS has bit 10", "clear bit 10"),
        ("ArduPilot", {"SERIAL2_OPTIONS": 8.0}, "none is heard", "two --out do not meet"),
    ],
)
def test_what_keeps_camera_and_ground_station_apart_is_named(
    firmware: str, parameters: dict[str, float], text: str, remedy: str
) -> None:
    found = autopilot.ground_station(autopilot.Heard(firmware=firmware, parameters=parameters))
    check(found, "warn", remedy)
    assert text in found.text
    check(autopilot.ground_station(autopilot.Heard(stations={255})), "ok")


def test_no_certificates() -> None:
    check(agent.certificates(BusConfig(mode="client"), "camera", "cam0"), "skip")
    beyond = BusConfig(mode="client", connect=("tcp/192.168.1.5:7447",))
    check(agent.certificates(beyond, "camera", "cam0"), "warn", "syncline keys")


def test_configuration(tmp_path: Path) -> None:
    file = tmp_path / "cam0.toml"
    file.write_text('id = "cam0"\ndrivr = "video"\n')
    found, config = agent.configuration(file, "camera")
    check(found, "fail", "did you mean driver")
    assert ":2" in found.text
    assert config is None
    file.write_text('id = "cam0"\n')
    found, config = agent.configuration(file, "camera")
    check(found, "ok")
    assert config.id == "cam0"


WITHOUT = """\
import sys
for name in sys.argv[2:]:
    sys.modules[name] = None
from deploy.cli import run
from edge.agents.clock_quality import kernel_clock
sys.exit(run(["doctor", sys.argv[1], "--json"]))
"""


@pytest.mark.parametrize(
    ("role", "text", "gone", "remedy"),
    [
        ("cam0", 'driver = "video"\n[video]\nsource = "/dev/video97"\n', ["cv2"], "syncline bundle"),
        ("cam0", 'driver = "oak"\n[oak]\ndevice = "127.0.0.1"\n', ["depthai"], 'pip install "syncline[oak]"'),
        ("uav", "", ["pymavlink"], 'pip install "syncline[uav]"'),
    ],
)
def test_missing_packages_of_a_camera_are_listed(
    tmp_path: Path, role: str, text: str, gone: list[str], remedy: str
) -> None:
    """In a process of its own, where these modules cannot be imported: doctor itself must not need them."""
    file = tmp_path / f"{role}.toml"
    file.write_text(f'id = "{role}"\n' + text + '[bus]\nmode = "peer"\nlisten = ["tcp/127.0.0.1:0"]\n')
    ended = subprocess.run(
        [sys.executable, "-c", WITHOUT, str(file), *gone], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 2, ended.stderr
    found = {one["check"]: one for one in json.loads(ended.stdout)}
    assert found["packages"]["verdict"] == "fail"
    assert gone[0] in found["packages"]["text"]
    assert remedy in found["packages"]["remedy"]
    assert "Traceback" not in ended.stderr
    for one in found.values():
        assert one["verdict"] != "fail" or one["remedy"]


def test_the_role_follows_from_the_name_of_file_or_folder() -> None:
    assert selection.role_from_path(Path("hub-a.toml")) == "hub"
    assert selection.role_from_path(Path("/etc/syncline/recorder-x/config.toml")) == "recorder"
    assert selection.role_from_path(Path("north.toml")) == "camera"


def test_a_wrong_configuration_precedes_a_missing_response() -> None:
    assert exit_status([ok("a", ""), warn("b", "x", "y")]) == 0
    assert exit_status([unavailable("a", "x", "y")]) == 3
    assert exit_status([unavailable("a", "x", "y"), misconfigured("b", "x", "y")]) == 2


@pytest.fixture
def quiet_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("cpu", "disk", "clock", "crash"):
        replacement: Callable[..., CheckResult] = lambda *a, _name=name, **k: ok(_name, "")  # noqa: E731
        monkeypatch.setattr(machine, name, replacement)


def test_the_command(quiet_machine: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(line[:5].strip() in ("ok", "warn", "fail", "skip") for line in lines)
    assert run(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [sorted(one) for one in found] == [["check", "exit_status", "remedy", "text", "verdict"]] * len(found)
    (tmp_path / "cam0.toml").write_text("id = 3\n")
    assert run(["doctor", str(tmp_path / "cam0.toml")]) == 2
    assert "fail configuration" in capsys.readouterr().out
    assert run(["doctor", str(tmp_path / "none.toml")]) == 2
    assert "Traceback" not in capsys.readouterr().err
