"""A system image for boards: the bundle is carried in it, and the board installs it when it first starts."""

from __future__ import annotations

import shutil
from pathlib import Path

from protocols.core.errors import InputError

CARRIED = "var/lib/syncline-bundle"
SCRIPT = "usr/lib/syncline/first-start"
UNIT = "syncline-first-start.service"
_SCRIPT_TEXT = f"""\
#!/bin/sh
# Written by `syncline site image`: installs the carried bundle once. ROOT is empty on a board, and a folder in tests.
set -eu
home=${{ROOT-}}/opt/syncline
sh "${{ROOT-}}/{CARRIED}/install.sh" "$home/a"
ln -sfn a "$home/current"
rm -rf "${{ROOT-}}/{CARRIED}"
"""
_UNIT_TEXT = f"""\
# Written by `syncline site image`.
[Unit]
Description=Syncline is installed from the bundle in this image
ConditionPathExists=/{CARRIED}/install.sh
After=local-fs.target

[Service]
Type=oneshot
ExecStart=/bin/sh /{SCRIPT}
TimeoutStartSec=900

[Install]
WantedBy=multi-user.target
"""


def prepare_image(root: Path, bundle: Path) -> list[str]:
    """Put a bundle and its installation at the first start into a mounted image; returns what was written.

    Agents that `site enrol` installs in the same image are started again by systemd until their program is there.
    Raises InputError where either is not what it has to be.
    """
    if not (bundle / "install.sh").is_file():
        raise InputError("is no bundle", file=bundle, remedy="make one with `syncline bundle`")
    if not (root / "etc").is_dir():
        raise InputError("is no system image", file=root, remedy="give the folder in which its root is mounted")
    try:
        shutil.copytree(bundle, root / CARRIED, dirs_exist_ok=True)
        units = root / "etc/systemd/system"
        for place, text in ((root / SCRIPT, _SCRIPT_TEXT), (units / UNIT, _UNIT_TEXT)):
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text, encoding="ascii")
        link = units / "multi-user.target.wants" / UNIT
        link.parent.mkdir(exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(f"../{UNIT}")
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=root, remedy="run it as root (sudo)") from None
    return [f"/{CARRIED}", f"/{SCRIPT}", f"/etc/systemd/system/{UNIT}"]
