"""What a board does for itself: makes its key and a signing request, installs what comes back, updates with rollback.

::

    /etc/syncline/site/ROLE-ID/    key.pem (made here, never copied away), certificate.pem, ca.pem, config.toml; a key
                                   of a renewal is key.new.pem until its certificate is there
    /opt/syncline/a, b             two versions of the software; the link `current` is the one that runs
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path

from deploy.config.file import load
from deploy.site import keys
from deploy.site.install.plan import CONFIG, apply, config_type, plan_install
from protocols.bus.security.access import certificate_name
from protocols.bus.security.tls import check_files, validity
from protocols.core.clocks import utc_text
from protocols.core.errors import InputError, Refused
from protocols.core.files import file_in

SLOTS, CURRENT = ("a", "b"), "current"
NEW_KEY = "key.new.pem"
CONFIG_FILE = "config.toml"
READY_S = 60.0  # in which a board has to have started its agent
_EPOCH = "usr/lib/clock-epoch"
"""systemd sets the clock at least to this file's time when it starts (systemd(1))."""
_TIMESYNC = "etc/systemd/timesyncd.conf.d/70-syncline.conf"


def folder_of(role: str, agent: str, root: Path = Path("/")) -> Path:
    """Where an agent's key and certificate are kept on its board."""
    name = certificate_name("record" if role == "recorder" else role, agent).partition(".")[2]
    return root / CONFIG.lstrip("/") / "site" / f"{role}-{name}"


def request(role: str, agent: str, root: Path = Path("/")) -> str:
    """A signing request for a new key, which stays here. The present key is in use until a certificate for it comes."""
    keys.need_cryptography()
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    folder = folder_of(role, agent, root)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        keys.write_key(folder / NEW_KEY, key)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=folder, remedy="run it as root (sudo)") from None
    name = certificate_name("record" if role == "recorder" else role, agent)
    made = x509.CertificateSigningRequestBuilder().subject_name(keys.subject_name(name)).sign(key, hashes.SHA256())
    return made.public_bytes(serialization.Encoding.PEM).decode("ascii")


def accept(
    role: str, agent: str, files: Mapping[str, bytes], root: Path = Path("/"), time_servers: tuple[str, ...] = ()
) -> list[str]:
    """Take what the site's authority sent, and install the agent with it; returns what was changed.

    Where the new certificate is not for the key that was made here, or the configuration would be refused, everything
    stays as it was. Raises InputError.
    """
    folder = folder_of(role, agent, root)
    staged = folder.with_name(f".{folder.name}.new")
    shutil.rmtree(staged, ignore_errors=True)
    if folder.is_dir():
        shutil.copytree(folder, staged)
    else:
        staged.mkdir(parents=True)
    staged.chmod(0o700)
    try:
        for name, content in files.items():
            if name in (keys.KEY_FILE, NEW_KEY):
                raise InputError(f"{name} is made on the board only", remedy="send what `syncline site enrol` makes")
            file_in(staged, name).write_bytes(content)
        if (staged / NEW_KEY).is_file() and keys.CERTIFICATE_FILE in files:
            (staged / NEW_KEY).replace(staged / keys.KEY_FILE)
        program = _program(root)
        plan_install(role, staged / CONFIG_FILE, program)
        notes = _take_time(staged / keys.CERTIFICATE_FILE, root)
        _check_pair(staged, role)
        _swap(staged, folder)
        if time_servers:
            _write_time_servers(root, time_servers)
        return [*notes, *apply(plan_install(role, folder / CONFIG_FILE, program), root)]
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def _check_pair(folder: Path, role: str) -> None:
    tls = load(folder / CONFIG_FILE, config_type(role)).bus.tls  # type: ignore[attr-defined]
    if tls is not None:
        check_files(tls)


def _swap(staged: Path, folder: Path) -> None:
    """Put a complete folder in the place of the present one, which is kept beside it for a rollback."""
    old = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    (folder / NEW_KEY).unlink(missing_ok=True)
    if (folder / CONFIG_FILE).is_file():
        folder.replace(old)
    else:
        shutil.rmtree(folder, ignore_errors=True)
    staged.replace(folder)


def restore(role: str, agent: str, root: Path = Path("/")) -> list[str]:
    """Return to what was there before the last ``accept``. Raises InputError if there is nothing."""
    folder = folder_of(role, agent, root)
    old = folder.with_name(f".{folder.name}.old")
    if not old.is_dir():
        raise InputError("there is nothing to return to", file=old, remedy="roll a working configuration out")
    shutil.rmtree(folder, ignore_errors=True)
    old.replace(folder)
    return apply(plan_install(role, folder / CONFIG_FILE, _program(root)), root)


def _program(root: Path) -> str | None:
    """Path of `syncline` in a system image; None = the one that runs."""
    if root == Path("/"):
        return None
    single = Path("opt/syncline/bin/syncline")
    return f"/{single}" if (root / single).exists() else f"/opt/syncline/{CURRENT}/bin/syncline"


def _take_time(certificate: Path, root: Path) -> list[str]:
    """Of a board without a clock: it is no earlier than the begin of a certificate that its site's authority made.

    Sets the clock where it is behind, and leaves the time for systemd, which begins no earlier at each start.
    """
    if not certificate.is_file():
        return []
    begin = validity(certificate)[0]
    epoch = root / _EPOCH
    if not epoch.exists() or epoch.stat().st_mtime < begin:
        epoch.parent.mkdir(parents=True, exist_ok=True)
        epoch.touch()
        os.utime(epoch, (begin, begin))
    if root != Path("/") or time.time() >= begin:
        return []
    try:
        time.clock_settime(time.CLOCK_REALTIME, begin + 1.0)
    except OSError as error:
        raise InputError(
            f"this machine's clock says {utc_text(time.time())}, before the certificate's begin, and cannot be set: "
            f"{error.strerror}",
            remedy="run it as root, or set the clock (`date -s`)",
        ) from None
    return [f"set the clock, which was behind, to {utc_text(begin)}, the certificate's begin"]


def _write_time_servers(root: Path, servers: tuple[str, ...]) -> None:
    """The board's time source: systemd-timesyncd asks these; without one the clock begins at its last known time."""
    file = root / _TIMESYNC
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"# Written by `syncline site`.\n[Time]\nNTP={' '.join(servers)}\n", encoding="ascii")


def ready(
    role: str,
    agent: str,
    patience_s: float = READY_S,
    root: Path = Path("/"),
    now: Callable[[], float] = time.monotonic,
) -> tuple[bool, str]:
    """Whether the agent is ready within ``patience_s``, by its own /status, and what it says of itself."""
    config = load(folder_of(role, agent, root) / CONFIG_FILE, config_type(role))
    health = getattr(config, "health", None)
    if health is None:
        return False, "it has no [health] to ask"
    began, said = now(), "no answer"
    while True:
        try:
            with urllib.request.urlopen(f"http://{health.listen}/status", timeout=2.0) as answer:
                report = json.loads(answer.read(1_000_000))
            if report["agent"] != agent:
                said = f"{report['agent']} answers at {health.listen}"
            else:
                said = f"{report['version']} {report['state']}: {report['message']}".rstrip(": ")
                if report["ready"]:
                    return True, said
        except (OSError, ValueError, KeyError, TypeError) as error:
            said = f"no answer at {health.listen}: {error}"
        if now() - began >= patience_s:
            return False, said
        time.sleep(min(0.5, max(patience_s, 0.0)))


def update(
    bundle: Path,
    home: Path,
    restart: Callable[[], None],
    is_ready: Callable[[], tuple[bool, str]],
) -> str:
    """Install a bundle beside the version that runs, switch to it, and back where the agents do not become ready.

    home: /opt/syncline. restart: of the services. Returns what the agents say. Raises Refused after a rollback: the old
    version runs again then.
    """
    link = home / CURRENT
    old = link.readlink().name if link.is_symlink() else ""
    slot = home / (SLOTS[1] if old == SLOTS[0] else SLOTS[0])
    shutil.rmtree(slot, ignore_errors=True)
    home.mkdir(parents=True, exist_ok=True)
    ended = subprocess.run(
        ["sh", str(bundle / "install.sh"), str(slot)], capture_output=True, text=True, check=False, timeout=900
    )
    if ended.returncode:
        shutil.rmtree(slot, ignore_errors=True)
        lines = (ended.stderr or ended.stdout).strip().splitlines()
        raise Refused(f"not updated: {lines[-1] if lines else f'install.sh ended with {ended.returncode}'}")
    _point(link, slot.name)
    restart()
    good, said = is_ready()
    if good:
        return said
    if old:
        _point(link, old)
        restart()
        again, text = is_ready()
        state = "which is ready again" if again else f"which is not ready either ({text})"
        raise Refused(f"the new version is not ready ({said}): returned to the old one, {state}")
    raise Refused(f"the new version is not ready ({said}), and there is no old one")


def _point(link: Path, slot: str) -> None:
    beside = link.with_name(f".{link.name}.new")
    beside.unlink(missing_ok=True)
    beside.symlink_to(slot)
    os.replace(beside, link)  # noqa: PTH105 - Path.replace follows nothing either; named for what it is


def units() -> list[str]:
    """The installed units of this machine."""
    return sorted(path.name for path in Path("/etc/systemd/system").glob("syncline-*.service"))


def restart_units() -> None:
    """Restart every installed agent of this machine. Raises Refused."""
    names = units()
    if not names or shutil.which("systemctl") is None:
        return
    ended = subprocess.run(["systemctl", "restart", *names], capture_output=True, text=True, check=False, timeout=300)
    if ended.returncode:
        lines = ended.stderr.strip().splitlines()
        raise Refused(f"services do not restart: {lines[-1] if lines else ended.returncode}")
