"""Checks of the computer: Python, packages, processor, temperature, disk, USB, clock, last crash.

All inputs are files below ``root`` or arguments, so that tests can simulate every case.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from deploy.site.doctor.check_result import CheckResult, misconfigured, ok, skip, warn
from edge.agents.clock_quality import kernel_clock, run_command
from protocols.core.clocks import UNSET_CLOCK_UNIX_S, utc_text

PACKAGES: dict[str, tuple[str, ...]] = {
    "": ("numpy", "zenoh", "msgspec", "google.protobuf"),
    "camera": ("cv2",),
    "uav": ("cv2", "pymavlink", "scipy", "serial"),
    "hub": ("cv2", "scipy", "plotly", "mcap"),
    "recorder": ("mcap", "zstandard", "foxglove_schemas_protobuf"),
    "oak": ("depthai",),
    "rtsp": ("av",),
    "log": ("mcap",),
}
_RECOMMENDED = {"usb": (("linuxpy", "frames are stamped on arrival, and lost ones are not seen"),)}
"""Optional packages of a driver, and what is lost without them."""
_EXTRAS = {"pymavlink": "uav", "serial": "uav", "depthai": "oak", "linuxpy": "v4l2", "av": "video"}
_MAX_TEMPERATURE_C = 80.0  # boards throttle above about this
_LOW_DISK_MB = 2000.0  # about two hours of four cameras
Run = Callable[[Sequence[str]], tuple[int, str]]
_CRASHES = {
    "watchdog": "no data flowed: camera unplugged or hanging? `journalctl -u {unit}` shows when",
    "oom-kill": "the memory was full: fewer or smaller cameras on this board, or window_s of a hub shorter",
    "core-dump": "it crashed in a driver or library: update Syncline, and report `coredumpctl info {unit}`",
    "signal": "somebody or something killed it: `journalctl -u {unit}`",
    "exit-code": "it ended by itself: `journalctl -u {unit} -n 20` shows the reason",
    "timeout": "it did not start in time: is the router up? `journalctl -u {unit}`",
    "": "the journal does not say why (ask as root): `journalctl -u {unit} -n 50`",
}
_ENDS = {
    "98e322203f7a4ed290d09fe03c09fe15": ("EXIT_CODE", "EXIT_STATUS"),
    "d9b373ed55a64feb8242e02dbe79a49c": ("UNIT_RESULT", ""),
}
"""systemd's journal messages of a process that ended and of a unit that failed (sd-messages.h), and their fields."""


def python(
    version: Sequence[int] = tuple(sys.version_info[:3]), bits: int = 8 * ctypes.sizeof(ctypes.c_void_p)
) -> CheckResult:
    """Check for Python 3.11 or newer, 64 bits."""
    text = f"Python {'.'.join(map(str, version))}, {bits} bits"
    if tuple(version[:2]) < (3, 11):
        return misconfigured(
            "python", text, "install Python 3.11 or newer (Debian 12 and Raspberry Pi OS bookworm have it)"
        )
    if bits < 64:
        return misconfigured("python", text, "install a 64-bit system: there are no packages for 32 bits")
    return ok("python", text)


def packages(
    kinds: Sequence[str], there: Callable[[str], bool] = lambda name: find_spec(name) is not None
) -> CheckResult:
    """Check the packages that the role imports. kinds: keys of PACKAGES."""
    wanted = [name for kind in ("", *kinds) for name in PACKAGES.get(kind, ())]
    gone = [name for name in wanted if not _is_installed(name, there)]
    if not gone:
        worse = [one for kind in kinds for one in _RECOMMENDED.get(kind, ()) if not _is_installed(one[0], there)]
        for name, what in worse:
            return warn(
                "packages",
                f"{name} missing: {what}",
                f'pip install "syncline[{_EXTRAS[name]}]"; without a network: bundle --extra {_EXTRAS[name]}',
            )
        return ok("packages", f"{len(wanted)} of {len(wanted)} are installed")
    extras = sorted({_EXTRAS[name] for name in gone if name in _EXTRAS})
    how = f'pip install "syncline[{",".join(extras)}]"' if extras else "pip install --force-reinstall syncline"
    return misconfigured(
        "packages", f"{', '.join(gone)} missing", f"{how}, or make a bundle for this role (`syncline bundle`)"
    )


def _is_installed(name: str, there: Callable[[str], bool]) -> bool:
    try:
        return there(name)
    except ImportError:  # the parent of a dotted name
        return False


def cpu(root: Path = Path("/"), machine: str | None = None) -> CheckResult:
    """Check the processor features that the wheels require, and the temperature."""
    kind = machine or platform.machine()
    needed = {"x86_64": ("sse4_2", "popcnt"), "aarch64": ("asimd",)}.get(kind)
    if needed is None:
        return misconfigured("cpu", f"{kind} is not supported", "use a 64-bit ARM or x86 board with a 64-bit system")
    try:
        words = (root / "proc/cpuinfo").read_text(encoding="utf-8", errors="replace").split()
    except OSError:
        return skip("cpu", f"{kind}; /proc/cpuinfo cannot be read")
    lacking = [name for name in needed if name not in words]
    if lacking:
        return misconfigured(
            "cpu",
            f"{kind} without {', '.join(lacking)}",
            "use a newer processor: NumPy and OpenCV end with SIGILL here",
        )
    hot = max((_number(file) / 1000.0 for file in root.glob("sys/class/thermal/thermal_zone*/temp")), default=0.0)
    cores = words.count("processor")
    if hot >= _MAX_TEMPERATURE_C:
        return warn(
            "cpu", f"{kind}, {cores} cores, {hot:.0f} °C", "cool it: it slows down when hot, and frames are lost"
        )
    return ok("cpu", f"{kind}, {cores} cores" + (f", {hot:.0f} °C" if hot else ""))


def disk(folder: Path, least_mb: float = 0.0, free: Callable[[Path], int] | None = None) -> CheckResult:
    """Check free space and permissions of an agent's output folder. least_mb: a recorder's min_free_mb."""
    place = next(parent for parent in (folder, *folder.absolute().parents) if os.path.isdir(parent))  # noqa: PTH112
    if not os.access(place, os.X_OK):  # Path.is_dir raises below such a folder
        return misconfigured("disk", f"{place} may not be entered by this user", "give rights there, or ask as root")
    left = (free(place) if free else shutil.disk_usage(place).free) / 1e6
    text = f"{left / 1000.0:.1f} GB free at {place}"
    if left < max(least_mb, 50.0):
        return misconfigured(
            "disk", text, f"make room or mount a larger disk there; recording ends below {max(least_mb, 50.0):.0f} MB"
        )
    if not os.access(place, os.W_OK):
        return misconfigured(
            "disk", f"{place} cannot be written", "give this user rights there, or set out to another folder"
        )
    if left < _LOW_DISK_MB:
        return warn(
            "disk",
            text,
            "make room: an hour of four cameras takes about 1 GB; part_s and part_mb split the log into movable parts",
        )
    return ok("disk", text)


def usb(source: str, root: Path = Path("/")) -> CheckResult:
    """Check the USB speed of a camera, and how many cameras share the bus. source: /dev/…, or a number."""
    name = Path(os.path.realpath(root / source.lstrip("/"))).name if source.startswith("/") else f"video{source}"
    device = (root / "sys/class/video4linux" / name / "device").resolve()
    speed = _speed_above(device)
    if speed is None:
        return skip("usb", f"{name} is not on USB, or is not there")
    controller = _bus_number(device)
    sharing = sum(
        _bus_number((node / "device").resolve()) == controller
        for node in root.glob("sys/class/video4linux/video*")
        if _number(node / "index") == 0
    )
    text = f"{name}: {speed:g} Mbit/s, {sharing} camera{'s' if sharing != 1 else ''} on bus {controller}"
    if speed < 480.0:
        return misconfigured(
            "usb", text, "use another cable or socket, without a hub: images need at least USB 2's 480 Mbit/s"
        )
    if speed < 5000.0 and sharing > 2:
        return warn("usb", text, "spread the cameras over other sockets or a second controller, or lower size and fps")
    return ok("usb", text)


def oak_usb(root: Path = Path("/")) -> CheckResult:
    """Check OAK boards on USB and their speed."""
    boards = []
    for file in root.glob("sys/bus/usb/devices/*/idVendor"):
        if _text(file) == "03e7":
            boards.append((file.parent.name, float(_text(file.parent / "speed") or 0.0)))
    if not boards:
        return misconfigured(
            "usb",
            "no OAK board (vendor 03e7) on USB",
            "check cable and power; a PoE board needs device = its address in [oak]",
        )
    slow = [name for name, speed in boards if speed < 5000.0]
    text = f"{len(boards)} OAK on USB: " + ", ".join(f"{name} {speed:g} Mbit/s" for name, speed in sorted(boards))
    if slow:
        return warn(
            "usb", text, "use a USB 3 cable in a blue socket: 480 Mbit/s allows only small images or low frame rates"
        )
    return ok("usb", text)


def _speed_above(device: Path) -> float | None:
    for place in (device, *device.parents):
        text = _text(place / "speed")
        if text:
            return float(text)
    return None


def _bus_number(device: Path) -> str:
    return next((_text(place / "busnum") for place in (device, *device.parents) if (place / "busnum").is_file()), "")


def _number(file: Path) -> int:
    text = _text(file)
    return int(text) if text.removeprefix("-").isdecimal() else 0


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""


def clock(
    certificates: bool,
    state: Callable[[], tuple[bool, float]] = kernel_clock,
    now: Callable[[], float] = time.time,
    ask: Run | None = None,
) -> CheckResult:
    """Check the machine's Unix time and name its source. Certificates and log names need it; camera timing does not."""
    source = time_source(ask or run)
    if now() < UNSET_CLOCK_UNIX_S:
        remedy = "set it: `sudo timedatectl set-ntp true` with a network, `sudo date -s …` without one"
        text = f"the clock is at {utc_text(now())}: it was never set; time source: {source}"
        return misconfigured("clock", text, remedy) if certificates else warn("clock", text, remedy)
    synchronised, error = state()
    if not synchronised:
        return warn(
            "clock",
            f"not synchronised; time source: {source}",
            "install chrony (or `sudo timedatectl set-ntp true`): names of logs need it, timing of cameras does not",
        )
    return ok("clock", f"synchronised, within {1e3 * error:.0f} ms; time source: {source}")


def time_source(ask: Run) -> str:
    """Where this machine takes its time from, as chrony or systemd-timesyncd says."""
    status, text = ask(("chronyc", "-c", "tracking"))
    fields = text.strip().split(",")
    if status == 0 and len(fields) > 3:
        name = fields[1] or fields[0]
        return "chrony, without a source yet" if name in ("", "0.0.0.0", "00000000") else f"{name}, by chrony"
    status, text = ask(("timedatectl", "show-timesync", "--property=ServerName", "--property=ServerAddress"))
    values = dict(line.partition("=")[::2] for line in text.splitlines())
    if status == 0 and values.get("ServerName"):
        return f"{values['ServerName']} ({values.get('ServerAddress') or 'no answer yet'}), by systemd-timesyncd"
    return "none known"


run = partial(run_command, timeout_s=10.0)


def crash(unit: str, run: Run = run) -> CheckResult:
    """Check how a service last ended, and how often it was restarted. unit: its name; patterns are allowed.

    A service that was restarted is well again, and systemd has forgotten why: the journal has not.
    """
    status, text = run(["systemctl", "show", unit, "--property=Id,Result,NRestarts,ActiveState,ExecMainStatus"])
    if status == 127:
        return skip("last crash", "no systemd here")
    worst: CheckResult | None = None
    count = 0
    for block in text.strip().split("\n\n"):
        fields = dict(line.partition("=")[::2] for line in block.splitlines())
        name, result = fields.get("Id", ""), fields.get("Result", "success")
        restarts = fields.get("NRestarts", "0")
        if not name or (fields.get("ActiveState") == "inactive" and result == "success" and restarts == "0"):
            continue
        count += 1
        if result != "success" or restarts not in ("0", ""):
            why, how = _last_end(name, run)
            why = result if result != "success" else why
            remedy = _CRASHES.get(why, "`journalctl -u {unit}`").format(unit=name)
            said = f"{why or 'ended'}{how}, restarted {restarts or 0} times"
            worst = warn("last crash", f"{name}: {said}", remedy)
    return worst or (
        ok("last crash", f"none of {count} service(s)") if count else skip("last crash", "not installed as a service")
    )


def _last_end(unit: str, run: Run) -> tuple[str, str]:
    """(systemd's result, how the process ended) of a unit's last failure, by the journal; "" for what it lacks."""
    command = ["journalctl", f"--unit={unit}", "--output=json", "--reverse", "--lines=20", "--no-pager"]
    status, text = run([*command, *(f"MESSAGE_ID={number}" for number in _ENDS)])
    result = how = ""
    for line in text.splitlines() if status == 0 else ():
        try:
            entry = json.loads(line)
            first, second = (str(entry.get(field, "")) for field in _ENDS[entry["MESSAGE_ID"]])
        except (ValueError, KeyError, AttributeError, TypeError):
            continue
        if second and not how:
            how = f" by {signal_name(second)}" if first != "exited" else f" with status {second}"
            result = result or {"exited": "exit-code", "dumped": "core-dump"}.get(first, "signal")
        elif not second and not how:
            result = first
        if how:
            break
    return result, f" ({how.strip()})" if how else ""


def signal_name(text: str) -> str:
    """SIGKILL for KILL and 9."""
    try:
        return signal.Signals(int(text)).name
    except ValueError:
        return text if text.startswith("SIG") else f"SIG{text}"
