"""`syncline bundle`: builds an offline wheelhouse."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from deploy.commands.common import Json, Role, answer


def bundle(
    *,
    platform: Literal["aarch64", "x86_64"] = "aarch64",
    python: Literal["3.11", "3.12", "3.13"] = "3.11",
    role: Role = "camera",
    extra: list[str] | None = None,
    out: Path | None = None,
    json: Json = False,
) -> int:
    """Collect the wheels that a board without a network needs, and a script that installs them there.

    Only packages that the role imports are included. Prints the installed size; more than 350 MB for a camera (without
    OAK) or 450 MB for a UAV is refused. On the board: sh install.sh

    Example: syncline bundle --platform aarch64 --python 3.11 --role camera --out camera-bundle

    Parameters
    ----------
    platform
        The board's architecture (`uname -m`).
    python
        The board's Python (`python3 --version`).
    role
        The agent that the board will run.
    extra
        Additional extras: oak, v4l2 (driver "usb"), video (driver "rtsp"), view; or a package, such as scipy for the
        detectors of people and vehicles. May be given several times.
    out
        Folder to write and copy to the board; by default named by version, role and platform.
    """
    from deploy.site.bundle import Target, default_folder, make_bundle

    target = Target(platform, python)
    made = make_bundle(role, target, out or default_folder(role, target), extra or ())
    document = {
        "role": role,
        "platform": platform,
        "python": python,
        "out": str(made.out),
        "carried_mb": round(made.carried_mb, 1),
        "installed_mb": round(made.installed_mb, 1),
        "wheels": {name: round(size / 1e6, 1) for name, size in sorted(made.sizes.items())},
    }
    largest = sorted(made.sizes.items(), key=lambda item: -item[1])[:5]
    largest_mb = ", ".join(f"{name.partition('-')[0]} {size / 1e6:.0f}" for name, size in largest)
    installed = f"{made.installed_mb:.0f} MB installed ({largest_mb}), {len(made.sizes)} wheels"
    lines = (
        f"{role}, {platform}, Python {python}: {installed}",
        f"{made.carried_mb:.0f} MB to carry over in {made.out}; there: sh install.sh",
    )
    return answer(document, lines, json)
