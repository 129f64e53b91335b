"""How an operator's machine reaches a board: by ssh, as a mounted system image, or by a USB stick."""

from __future__ import annotations

import io
import json
import shlex
import subprocess
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from deploy.site.boards import board
from deploy.site.boards.site_file import Site, SiteAgent
from protocols.core.errors import InputError, Refused

_SSH = ("ssh", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10")
_MOST_BYTES = 8 << 20  # of one file: certificates and configurations have kilobytes
_BUNDLE = "/var/tmp/syncline-bundle"


class Board(Protocol):
    """One agent on its board. All methods raise InputError or Refused with one line."""

    def request(self) -> str:
        """A signing request for a new key that the board has made."""

    def accept(self, files: Mapping[str, bytes]) -> list[str]:
        """Install the agent with these files; returns what was changed."""

    def restore(self) -> None:
        """Return to the files before the last ``accept``."""

    def update(self, bundle: Path) -> str:
        """Install a bundle beside the present version and switch to it; the board goes back if it is not ready."""

    def ready(self, patience_s: float) -> tuple[bool, str]:
        """Whether the agent is ready, and what it says."""


def board_of(site: Site, agent: SiteAgent, stick: Path | None = None) -> Board:
    """How to reach an agent's board. stick: where a USB stick is mounted here."""
    if agent.host == "stick" or stick is not None:
        if stick is None:
            raise InputError(f"{agent.name} is reached by a stick only", file=site.file, remedy="give --stick FOLDER")
        return StickBoard(agent, stick)
    if agent.host.startswith("root:"):
        return ImageBoard(agent, Path(agent.host.removeprefix("root:")), site.settings.time_servers)
    return SshBoard(site, agent)


class ImageBoard:
    """A system image that is mounted here: nothing runs in it yet."""

    def __init__(self, agent: SiteAgent, root: Path, time_servers: tuple[str, ...] = ()) -> None:
        self._agent, self._root, self._servers = agent, root, time_servers

    def request(self) -> str:
        return board.request(self._agent.role, self._agent.id, self._root)

    def accept(self, files: Mapping[str, bytes]) -> list[str]:
        return board.accept(self._agent.role, self._agent.id, files, self._root, self._servers)

    def restore(self) -> None:
        board.restore(self._agent.role, self._agent.id, self._root)

    def update(self, bundle: Path) -> str:
        """See Board; an image is updated by making a new one."""
        raise Refused(f"{self._agent.name} is a system image: make it again with the new bundle")

    def ready(self, patience_s: float) -> tuple[bool, str]:
        return True, "a system image: it starts with the board"


class StickBoard:
    """A USB stick between here and a board: the board's requests are in requests/, what is for it in boards/."""

    def __init__(self, agent: SiteAgent, stick: Path) -> None:
        self._agent, self._stick = agent, stick

    def request(self) -> str:
        file = self._stick / "requests" / f"{self._agent.name}.csr"
        try:
            return file.read_text(encoding="ascii")
        except (OSError, UnicodeDecodeError):
            who = f"--role {self._agent.role} --id {self._agent.id}"
            raise InputError(
                f"no request of {self._agent.name} is on the stick",
                file=file,
                remedy=f"on the board: syncline site request {who} --out STICK/requests",
            ) from None

    def accept(self, files: Mapping[str, bytes]) -> list[str]:
        file = self._stick / "boards" / f"{self._agent.name}.tar"
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(pack(files))
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", file=file, remedy="is the stick there?") from None
        return [f"wrote {file}; on the board: syncline site accept STICK/boards/{file.name}"]

    def restore(self) -> None:
        pass

    def update(self, bundle: Path) -> str:
        raise Refused(f"{self._agent.name}: copy the bundle to the stick; on the board: syncline site update BUNDLE")

    def ready(self, patience_s: float) -> tuple[bool, str]:
        return True, "reached by a stick only"


class SshBoard:
    """A board that runs `syncline site …` for itself, by ssh."""

    def __init__(self, site: Site, agent: SiteAgent) -> None:
        self._agent = agent
        self._who = ["--role", agent.role, "--id", agent.id]
        self._syncline = [*(["sudo", "-n"] if site.settings.sudo else []), site.settings.program]
        self._servers = [word for server in site.settings.time_servers for word in ("--time-server", server)]
        self._sudo = "sudo -n " if site.settings.sudo else ""
        self._program = site.settings.program

    def request(self) -> str:
        return self._run([*self._syncline, "site", "request", *self._who]).decode("ascii", "replace")

    def accept(self, files: Mapping[str, bytes]) -> list[str]:
        words = [*self._syncline, "site", "accept", *self._who, *self._servers]
        return self._run(words, pack(files)).decode(errors="replace").splitlines()

    def restore(self) -> None:
        self._run([*self._syncline, "site", "restore", *self._who])

    def update(self, bundle: Path) -> str:
        """See Board. A board without any version gets this one."""
        files = {path.relative_to(bundle).as_posix(): path.read_bytes() for path in bundle.rglob("*") if path.is_file()}
        self._run(["sh", "-c", f"rm -rf {_BUNDLE} && mkdir -p {_BUNDLE} && tar -x -C {_BUNDLE}"], pack(files))
        home = Path(self._program).parents[2]
        first = f"{self._sudo}sh {_BUNDLE}/install.sh {home}/a && {self._sudo}ln -sfn a {home}/current"
        update = shlex.join([*self._syncline, "site", "update", _BUNDLE, *self._who])
        command = f"if [ -x {shlex.quote(self._program)} ]; then {update}; else {first}; fi"
        lines = self._run(["sh", "-c", command], patience_s=1800.0).decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def ready(self, patience_s: float) -> tuple[bool, str]:
        words = [*self._syncline, "site", "ready", *self._who, "--patience", f"{patience_s:g}", "--json"]
        try:
            found = json.loads(self._run(words, patience_s=patience_s + 30.0))
            return bool(found["ready"]), str(found["text"])
        except (ValueError, KeyError, TypeError):
            return False, "what the board answers is not understood: is its version older?"

    def _run(self, words: list[str], given: bytes = b"", patience_s: float = 120.0) -> bytes:
        try:
            ended = subprocess.run(
                [*_SSH, "--", self._agent.host, shlex.join(words)],
                input=given,
                capture_output=True,
                timeout=patience_s,
                check=False,
            )
        except FileNotFoundError:
            raise InputError("ssh is not here", remedy="install it (Debian: openssh-client), or use a stick") from None
        except subprocess.TimeoutExpired:
            raise Refused(f"{self._agent.name}: {self._agent.host} did not end within {patience_s:.0f} s") from None
        lines = ended.stderr.decode(errors="replace").strip().splitlines()
        said = (lines[-1] if lines else f"status {ended.returncode}").removeprefix("syncline: ")
        if ended.returncode == 255:
            raise Refused(f"{self._agent.name}: {self._agent.host} is not reached: {said}")
        if ended.returncode not in (0, 3) or (ended.returncode == 3 and "ready" not in words):
            raise Refused(f"{self._agent.name}: {said}")
        return ended.stdout


def pack(files: Mapping[str, bytes]) -> bytes:
    """A tar archive."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for name, content in sorted(files.items()):
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o755 if name.endswith(".sh") else 0o600
            archive.addfile(entry, io.BytesIO(content))
    return out.getvalue()


def unpack(content: bytes) -> dict[str, bytes]:
    """The files of an archive that ``pack`` made. Raises InputError."""
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as archive:
            for entry in archive:
                data = archive.extractfile(entry) if entry.isreg() and entry.size <= _MOST_BYTES else None
                if data is None or len(files) > 64:
                    raise ValueError(entry.name)
                files[entry.name] = data.read()
    except (tarfile.TarError, ValueError, EOFError) as error:
        raise InputError(f"not what `syncline site enrol` sends: {error}", remedy="send it again") from None
    return files
