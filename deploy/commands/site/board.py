"""Commands of `syncline site` that a board, or whoever makes its image, runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from deploy.commands.common import Json, Role, UnusedSeed, answer
from protocols.core.errors import EXIT_DONE, EXIT_REFUSED, InputError

OfRole = Annotated[Role, Parameter(help="The agent's role.")]
OfId = Annotated[str, Parameter(help="The agent's id.")]
Root = Annotated[Path, Parameter(help="Root folder of a system image.")]


def image(root: Path, /, *, bundle: Path, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Put a bundle into a mounted system image; the board installs it when it first starts, without a network.

    Example: sudo syncline site image /mnt/pi --bundle camera-bundle

    Parameters
    ----------
    root
        Folder in which the image's root is mounted.
    bundle
        Folder that `syncline bundle` has made for the board.
    """
    from deploy.site.boards.image import prepare_image

    written = [str(line) for line in prepare_image(root, bundle)]
    return answer({"written": written}, [f"wrote {line}" for line in written], json)


def request(
    *,
    role: OfRole,
    id: OfId,
    out: Path | None = None,
    root: Root = Path("/"),
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """On a board: make a new key, which stays here, and print a signing request for it.

    Example: syncline site request --role camera --id cam07 --out /media/stick/requests

    Parameters
    ----------
    out
        Folder, as on a USB stick, for ROLE-ID.csr instead of printing.
    """
    from deploy.site.boards import board
    from protocols.core.files import write_atomically

    text = board.request(role, id, root)
    if out is None:
        return answer({"request": text}, [text.removesuffix("\n")], json)
    file = out / f"{role}-{id}.csr"
    write_atomically(file, text)
    return answer({"file": str(file)}, [f"{file}; sign it with: syncline site enrol site.toml --stick FOLDER"], json)


def accept(
    source: Path | None = None,
    /,
    *,
    role: Role | None = None,
    id: str = "",
    time_server: tuple[str, ...] = (),
    root: Root = Path("/"),
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """On a board: take the certificate and configuration that `site enrol` made, and install the agent.

    Example: sudo syncline site accept /media/stick/boards/camera-cam07.tar

    Parameters
    ----------
    source
        The .tar file; default: standard input.
    role
        The agent's role; default: by the file's name.
    id
        The agent's id; default: by the file's name.
    time_server
        NTP servers that this board is to ask.
    """
    from deploy.site.boards import board
    from deploy.site.boards.transport import unpack
    from deploy.site.install.units import ROLES

    named = ("", "", "") if source is None else source.stem.partition("-")
    try:
        content = sys.stdin.buffer.read() if source is None else source.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=source, remedy="check the path") from None
    if not (role or named[0] in ROLES) or not (id or named[2]):
        raise InputError("whose files these are is not known", remedy="give --role and --id")
    done = board.accept(role or named[0], id or named[2], unpack(content), root, time_server)
    return answer({"done": done}, done, json)


def restore(*, role: OfRole, id: OfId, root: Root = Path("/"), json: Json = False, seed: UnusedSeed = 0) -> int:
    """On a board: return to certificate and configuration before the last `accept`.

    Example: sudo syncline site restore --role camera --id cam07
    """
    from deploy.site.boards import board

    done = board.restore(role, id, root)
    return answer({"done": done}, done, json)


def update(
    bundle: Path,
    /,
    *,
    role: Role,
    id: str,
    patience: float = 60.0,
    home: Path = Path("/opt/syncline"),
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """On a board: install a bundle beside the present version, switch to it, and back if the agent is not ready.

    The versions are in HOME/a and HOME/b; the link HOME/current is the one that runs. Exit status 3 after a return.

    Example: sudo syncline site update camera-bundle --role camera --id cam07

    Parameters
    ----------
    bundle
        Folder that `syncline bundle` has made.
    role
        The agent that has to become ready.
    id
        Its id.
    patience
        Seconds that it may take.
    home
        Folder of the versions.
    """
    from deploy.site.boards import board

    def is_ready() -> tuple[bool, str]:
        if not board.folder_of(role, id).is_dir():
            return True, "not enrolled yet"
        return board.ready(role, id, patience)

    version = board.update(bundle, home, board.restart_units, is_ready)
    return answer({"updated": version}, [f"updated: {version}"], json)


def ready(
    *, role: OfRole, id: OfId, patience: float = 0.0, root: Path = Path("/"), json: Json = False, seed: UnusedSeed = 0
) -> int:
    """On a board: wait until the agent is ready, and print what it says. Exit status 3 if it is not.

    Example: syncline site ready --role camera --id cam07 --patience 60

    Parameters
    ----------
    patience
        Seconds to wait.
    root
        Root folder of the agent's configuration.
    """
    from deploy.site.boards import board

    good, text = board.ready(role, id, patience, root)
    answer({"ready": good, "text": text}, [text], json)
    return EXIT_DONE if good else EXIT_REFUSED
