"""Texts of the systemd unit, udev, sysusers and tmpfiles files; pure functions of names and paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

HEADER = "# Written by `syncline install`: the next one writes it anew; a drop-in (systemctl edit) stays.\n"
_CAMERA_NODES = ("char-video4linux", "char-usb_device")
_HARDENING = """\
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=yes
PrivateTmp=yes
ProtectProc=invisible
ProtectClock=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectControlGroups=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
RemoveIPC=yes
LockPersonality=yes
MemoryDenyWriteExecute=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@resources @privileged
SystemCallErrorNumber=EPERM
UMask=0027
"""


@dataclass(frozen=True, slots=True)
class Role:
    """System requirements of a role.

    command: subcommand of `syncline`. watchdog_s: time without data flow after which systemd restarts the agent; a hub
    sends heartbeats at every solver step. stop_s: time for a clean stop; a hub that is still solving extends it by a
    minute at a time. devices: classes of device nodes that it may open. groups: groups that own those nodes.
    """

    command: str
    watchdog_s: int
    stop_s: int
    devices: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()


ROLES: dict[str, Role] = {
    "camera": Role("camera", 10, 10, _CAMERA_NODES, ("video", "syncline")),
    "uav": Role(
        "uav", 10, 10, (*_CAMERA_NODES, "char-ttyACM", "char-ttyUSB", "char-ttyAMA", "char-ttyS"),
        ("video", "dialout", "syncline"),
    ),
    "hub": Role("hub", 60, 60),
    "recorder": Role("record", 15, 30),
    "router": Role("router", 10, 10),
}  # fmt: skip


def service(name: str, role: str, program: str, credentials: Sequence[tuple[str, str]]) -> str:
    """Text of a unit. name: ``camera-cam0``. program: path of `syncline`. credentials: (name, file) that it may read.

    The configuration is the credential ``config.toml``, so that /etc/syncline can be readable by root only; files
    that it refers to by a relative path are credentials too.
    """
    kind = ROLES[role]
    load = "".join(f"LoadCredential={credential}:{file}\n" for credential, file in credentials)
    return (
        f"{HEADER}[Unit]\n"
        f"Description=Syncline {role} {name.removeprefix(role + '-')}\n"
        "Wants=network-online.target\n"
        "After=network-online.target time-sync.target\n"
        # Always restarted: a camera that is reconnected after a week works again.
        "StartLimitIntervalSec=0\n"
        "\n[Service]\n"
        "Type=notify\n"
        "NotifyAccess=main\n"
        f"ExecStart={_quoted(program)} {kind.command} %d/config.toml\n"
        "Restart=always\n"
        "RestartSec=1\n"
        f"WatchdogSec={kind.watchdog_s}\n"
        "TimeoutStartSec=30\n"
        f"TimeoutStopSec={kind.stop_s}\n"
        "DynamicUser=yes\n"
        f"StateDirectory=syncline/{name}\n"
        "StateDirectoryMode=0750\n"
        f"WorkingDirectory=%S/syncline/{name}\n"
        f"{load}"
        "Environment=PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1\n"
        f"\n{_devices(kind)}{_HARDENING}"
        "\n[Install]\n"
        "WantedBy=multi-user.target\n"
    )


def _devices(kind: Role) -> str:
    if not kind.devices:
        return "PrivateDevices=yes\nPrivateUsers=yes\nDevicePolicy=closed\n"
    allowed = "".join(f"DeviceAllow={device} rw\n" for device in kind.devices)
    return f"SupplementaryGroups={' '.join(kind.groups)}\nDevicePolicy=closed\n{allowed}"


def _quoted(path: str) -> str:
    """A path quoted for a unit file, in which % is an escape character."""
    text = path.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{text}"' if any(c.isspace() or c in "\"'\\" for c in path) else text


def sysusers() -> str:
    """sysusers file: the group that owns OAK boards' device nodes; the agents' users are dynamic."""
    return f"{HEADER}g syncline -\n"


def tmpfiles() -> str:
    """tmpfiles file: the folders of configurations (readable by root only: they contain keys) and of state."""
    return f"{HEADER}d /etc/syncline 0750 root syncline -\nd /var/lib/syncline 0755 root root -\n"


def udev_rules() -> str:
    """udev rules: stable device names below /dev/syncline, and the group of OAK boards.

    usb-SERIAL names a camera independently of its port; cheap cameras share one serial number, and for these port-PATH
    names the port. 60-persistent-v4l.rules has set both properties before. 03e7 is the vendor Movidius, the maker of
    OAK's chip.
    """
    camera = 'SUBSYSTEM=="video4linux", KERNEL=="video[0-9]*", ATTR{index}=="0"'
    oak = 'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", ATTR{idVendor}=="03e7"'
    return (
        f"{HEADER}"
        f'ACTION=="remove", GOTO="syncline_end"\n'
        f'{oak}, MODE="0660", GROUP="syncline", TAG+="uaccess"\n'
        f'{oak}, ATTR{{serial}}=="?*", SYMLINK+="syncline/oak-$attr{{serial}}"\n'
        f'{camera}, ENV{{ID_BUS}}=="usb", ENV{{ID_SERIAL}}=="?*", SYMLINK+="syncline/usb-$env{{ID_SERIAL}}"\n'
        f'{camera}, ENV{{ID_PATH}}=="?*", SYMLINK+="syncline/port-$env{{ID_PATH}}"\n'
        'LABEL="syncline_end"\n'
    )
