"""Offline wheelhouse for a board without a network, with an install script.

A board needs fewer packages than a workstation: a camera needs no SciPy, no plotly and no log writer. Each role has its
own subset of the project's requirements, which is installed without the other dependencies.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from email.message import Message
from email.parser import HeaderParser
from fnmatch import fnmatch
from importlib.metadata import PackageNotFoundError, metadata, requires
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from protocols.core.errors import InputError, Refused
from protocols.core.files import check_folder
from protocols.core.version import VERSION

if TYPE_CHECKING:
    from packaging.requirements import Requirement

_COMMON_PACKAGES = (
    "cryptography", "cyclopts", "eclipse-zenoh", "msgspec", "numpy", "prometheus-client", "protobuf", "rich",
    "structlog", "tomli-w",
)  # fmt: skip
_LOG_PACKAGES = ("mcap", "zstandard", "foxglove-schemas-protobuf")
ROLE_PACKAGES: dict[str, tuple[str, ...]] = {
    "camera": (*_COMMON_PACKAGES, "opencv-python-headless", "mcap"),
    "uav": (*_COMMON_PACKAGES, "opencv-python-headless", "pymavlink", "pyserial", "scipy"),
    "hub": (*_COMMON_PACKAGES, *_LOG_PACKAGES, "opencv-python-headless", "scipy", "plotly", "viser"),
    "recorder": (*_COMMON_PACKAGES, *_LOG_PACKAGES),
    "router": _COMMON_PACKAGES,
}
"""Packages that a role imports; ``tests/faults/test_bundle.py`` runs each role with only these."""
_UNUSED = ("lxml",)
"""Dependencies that no agent imports: pymavlink reads descriptions of parameters with lxml."""
_LEFT_OUT = ("*/tests/*", "*/dialects/v09/*", "*/dialects/v10/*")
"""Files of wheels that are not kept on a board: packages' own tests, and dialects of MAVLink before 2."""
BUDGET_MB = {"camera": 350.0, "uav": 450.0}
"""Largest installed size of a role [MB], without depthai for OAK boards."""
_PRECOMPILED_MODULES = {
    "camera": "deploy.agents.assembly, edge.offline.video, deploy.agents.systemd_notify, edge.agents.camera, "
    "edge.detectors.marker.bright, edge.detectors.marker.ball, edge.detectors.marker.tag, "
    "edge.devices.playback.log_playback, edge.devices.live.network, edge.devices.live.picamera, "
    "edge.devices.live.usb, edge.devices.playback.video_file, protocols.bus.transport.zenoh_bus",
    "uav": "deploy.agents.uav, deploy.agents.systemd_notify, edge.agents.uav, edge.mavlink.link.connection, "
    "edge.uav.adaptive_tracker, edge.uav.timing.clock_alignment, scipy.interpolate, edge.devices.playback.video_file, "
    "protocols.bus.transport.zenoh_bus",
    "hub": "deploy.agents.assembly, hub.live.agent, hub.calibration.pipeline, hub.distributed.network.host, "
    "hub.report, hub.view.server, protocols.bus.transport.zenoh_bus",
    "recorder": "deploy.agents.recorder, protocols.bus.transport.zenoh_bus",
    "router": "deploy.commands.agents.router, protocols.bus.router.zenoh_router",
}
_WHEELS = "wheels"
_MAX_GLIBC_MINOR = 28  # minor version of glibc 2 in Debian 10, the oldest that all our wheels support
_SOURCE = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, slots=True)
class Target:
    """The target board. platform: aarch64 or x86_64. python: version, such as "3.11"."""

    platform: str
    python: str

    def tags(self) -> tuple[str, ...]:
        """Compatible wheel platform tags, newest first."""
        return (
            *(f"manylinux_2_{minor}_{self.platform}" for minor in range(_MAX_GLIBC_MINOR, 16, -1)),
            f"manylinux2014_{self.platform}",
        )

    def markers(self) -> dict[str, str]:
        """The environment in which requirement markers are evaluated."""
        return {
            "implementation_name": "cpython",
            "implementation_version": f"{self.python}.0",
            "os_name": "posix",
            "platform_machine": self.platform,
            "platform_python_implementation": "CPython",
            "platform_release": "",
            "platform_system": "Linux",
            "platform_version": "",
            "python_full_version": f"{self.python}.0",
            "python_version": self.python,
            "sys_platform": "linux",
            "extra": "",
        }


@dataclass(slots=True)
class Bundle:
    """A finished bundle. sizes: installed size [bytes] by wheel."""

    role: str
    target: Target
    out: Path
    sizes: dict[str, int] = field(default_factory=dict)

    @property
    def installed_mb(self) -> float:
        """Size on the board, without Python itself and byte code."""
        return sum(self.sizes.values()) / 1e6

    @property
    def carried_mb(self) -> float:
        """Size of the wheels to copy to the board."""
        return sum(path.stat().st_size for path in (self.out / _WHEELS).glob("*.whl")) / 1e6


def make_bundle(role: str, target: Target, out: Path, extras: Sequence[str] = ()) -> Bundle:
    """Collect the wheels and write the bundle to ``out``.

    extras: optional dependency groups of the project, such as ``oak``, or packages of other roles, such as scipy.

    Raises InputError if wheels are not available, which leaves an earlier bundle as it is, Refused if the role exceeds
    its size limit.
    """
    check_folder(out)
    needed = [*_requirements(role, target, extras)]
    folder = out / _WHEELS
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out, prefix=".wheels.") as place:
        new = Path(place)
        wheel = _own_wheel(new)
        _download([str(requirement) for requirement in needed], new, target)
        _download_missing_dependencies(new, wheel, target)
        _download(["pip>=24"], new, target)
        for file in folder.glob("*.whl"):
            file.unlink()
        for file in new.glob("*.whl"):
            file.replace(folder / file.name)
    bundle = Bundle(role, target, out)
    pins = []
    for file in sorted(folder.glob("*.whl")):
        name, version = _identity(file)
        if name == "pip":
            continue
        if name in _UNUSED:
            file.unlink()
            continue
        bundle.sizes[file.name] = _installed_size(file)
        pins.append(f"{name}=={version} --hash=sha256:{hashlib.sha256(file.read_bytes()).hexdigest()}")
    (out / "requirements.txt").write_text("\n".join(pins) + "\n", encoding="utf-8")
    script = out / "install.sh"
    script.write_text(_script(role, target), encoding="utf-8")
    script.chmod(0o755)
    budget = BUDGET_MB.get(role)
    if budget is not None and "oak" not in extras and bundle.installed_mb > budget:
        raise Refused(
            f"{bundle.installed_mb:.0f} MB installed, a {role} may take {budget:.0f} MB: see the largest wheels"
        )
    return bundle


def _requirements(role: str, target: Target, extras: Iterable[str]) -> Iterable[Requirement]:
    """The project's requirements that this role needs, with their version bounds."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    try:
        declared = [Requirement(text) for text in requires("syncline") or ()]
    except PackageNotFoundError:
        raise InputError("Syncline is not installed as a package", remedy="pip install -e . in the checkout") from None
    groups = {
        str(name).lower() for name in (metadata("syncline").get_all("Provides-Extra") or ()) if str(name) != "dev"
    }
    packages = {canonicalize_name(one.name) for one in declared if one.marker is None}
    unknown = [extra for extra in extras if extra not in groups and canonicalize_name(extra) not in packages]
    if unknown:
        known = ", ".join(sorted(groups))
        raise InputError(f"no extra {', '.join(unknown)}", remedy=f"use {known}, or a package of the project's")
    wanted = {canonicalize_name(name) for name in (*ROLE_PACKAGES[role], *(one for one in extras if one not in groups))}
    found = set()
    for requirement in declared:
        name = canonicalize_name(requirement.name)
        marker = requirement.marker
        of_extra = marker is not None and any(
            marker.evaluate({**target.markers(), "extra": extra}) and not marker.evaluate(target.markers())
            for extra in extras
        )
        if (name in wanted or of_extra) and name not in found:
            found.add(name)
            requirement.marker = None
            yield requirement
    if wanted - found:
        raise InputError(
            f"the project does not declare {', '.join(sorted(wanted - found))}", remedy="add it to pyproject.toml"
        )


def _own_wheel(folder: Path) -> Path:
    if not (_SOURCE / "pyproject.toml").is_file():
        raise InputError("a bundle is made from a checkout of Syncline", remedy="run it from there: pip install -e .")
    isolation = ["--no-build-isolation"] if find_spec("hatchling") else []
    _pip(["wheel", "--quiet", "--no-deps", *isolation, "--wheel-dir", str(folder), str(_SOURCE)])
    return next(folder.glob("syncline-*.whl"))


def _download(requirements: Sequence[str], folder: Path, target: Target, deps: bool = True) -> None:
    compact = target.python.replace(".", "")
    lock = _lock(target, folder)
    arguments = [
        "download",
        "--quiet",
        "--only-binary=:all:",
        "--implementation",
        "cp",
        "--python-version",
        target.python,
    ]
    for abi in (f"cp{compact}", "abi3", "none"):
        arguments += ["--abi", abi]
    for tag in target.tags():
        arguments += ["--platform", tag]
    if lock is not None:
        arguments += ["--constraint", str(lock)]
    try:
        _pip([*arguments, *([] if deps else ["--no-deps"]), "--dest", str(folder), *requirements])
    finally:
        if lock is not None:
            lock.unlink()


def _lock(target: Target, folder: Path) -> Path | None:
    """The pinned requirements for the target: pip would evaluate their markers for this machine."""
    from packaging.requirements import InvalidRequirement, Requirement

    source = _SOURCE / "requirements.lock"
    if not source.is_file():
        return None
    lines = []
    for line in source.read_text(encoding="utf-8").splitlines():
        try:
            requirement = Requirement(line)
        except InvalidRequirement:
            continue
        if requirement.marker is None or requirement.marker.evaluate(target.markers()):
            requirement.marker = None
            lines.append(str(requirement))
    file = folder / ".constraints.txt"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def _download_missing_dependencies(folder: Path, own: Path, target: Target) -> None:
    """Download dependencies that apply only on the target, because pip evaluates markers for this machine."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    for _ in range(20):
        there = {_identity(file)[0] for file in folder.glob("*.whl")}
        missing: dict[str, str] = {}
        for file in folder.glob("*.whl"):
            if file == own:
                continue  # of its own requirements only those of the role are needed
            for text in _metadata(file).get_all("Requires-Dist") or ():
                requirement = Requirement(text)
                name = canonicalize_name(requirement.name)
                if name not in there and (requirement.marker is None or requirement.marker.evaluate(target.markers())):
                    requirement.marker = None
                    missing[name] = str(requirement)
        if not missing:
            return
        _download(list(missing.values()), folder, target, deps=False)
    raise Refused("the wheels' requirements do not come to an end")


def _pip(arguments: Sequence[str]) -> None:
    if not find_spec("pip"):
        raise InputError("pip is not in this environment", remedy=f"{sys.executable} -m ensurepip")
    ended = subprocess.run(
        [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", *arguments],
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
        # What is compiled here might not run on the board.
        env={**os.environ, "SYNCLINE_PURE": "1"},
    )
    if ended.returncode:
        if "Retry(total=0" in ended.stderr:
            remedy = "make the bundle where there is a network, and carry its folder over"
            raise InputError("the package index cannot be reached", remedy=remedy)
        lines = [line for line in ended.stderr.splitlines() if line.startswith("ERROR")]
        what = lines[0].removeprefix("ERROR: ") if lines else f"pip ended with status {ended.returncode}"
        raise InputError(what[:300], remedy="check --platform, --python and the connection to the package index")


def _metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if re.fullmatch(r"[^/]+\.dist-info/METADATA", name))
        return HeaderParser().parsestr(archive.read(name).decode())


def _identity(wheel: Path) -> tuple[str, str]:
    from packaging.utils import parse_wheel_filename

    name, version, _, _ = parse_wheel_filename(wheel.name)
    return str(name), str(version)


def _installed_size(wheel: Path) -> int:
    with zipfile.ZipFile(wheel) as archive:
        kept = (one for one in archive.infolist() if not any(fnmatch(one.filename, rule) for rule in _LEFT_OUT))
        return sum(item.file_size for item in kept)


def _script(role: str, target: Target) -> str:
    left_out = " -o ".join(f"-path '{rule}'" for rule in _LEFT_OUT)
    return f"""\
#!/bin/sh
# Installs Syncline {VERSION} for the role {role} from this folder, without a network.
# Usage: sh install.sh [TARGET]      default /opt/syncline; SYNCLINE_PYTHON=python3 chooses the interpreter.
# Once more with a newer bundle updates it; then restart the agents.
set -eu
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd)
target=${{1:-/opt/syncline}}
python=${{SYNCLINE_PYTHON:-python3}}
"$python" - <<'CHECK'
import platform, sys
found = (platform.machine(), "%d.%d" % sys.version_info[:2])
if found != ({target.platform!r}, {target.python!r}):
    sys.exit("install.sh: this bundle is for {target.platform}, Python {target.python}; here are %s, Python %s" % found)
CHECK
# Without pip: Debian keeps it in a package of its own. The bundle's runs out of its wheel.
[ -x "$target/bin/python" ] || "$python" -m venv --without-pip "$target"
for pip in "$here"/{_WHEELS}/pip-*.whl; do :; done
"$target/bin/python" "$pip/pip" install --quiet --disable-pip-version-check --no-index --no-compile --no-deps \\
    --upgrade --require-hashes --find-links "$here/{_WHEELS}" --requirement "$here/requirements.txt"
(cd "$target/lib" && find . \\( {left_out} \\) -delete)
# Byte code of what the agent imports, and of nothing else: services may not write here.
"$target/bin/python" -c "import {_PRECOMPILED_MODULES[role]}"
echo "Syncline {VERSION} ({role}) is in $target: $(du -sm "$target" | cut -f1) MB"
"$target/bin/syncline" --version
"""


def default_folder(role: str, target: Target) -> Path:
    """The default output folder of a bundle."""
    return Path(f"syncline-{VERSION}-{role}-{target.platform}-py{target.python}")
