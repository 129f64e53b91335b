"""Builds a target of a Containerfile without a container engine: each stage is a folder, each RUN a chroot into it.

A stage begins as the system's own /usr, mounted read-only, with a few files in /etc and nothing else; neither it nor
what runs in it has a network. Needs the right to mount (root).
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

_SYSTEM = ("usr", "bin", "sbin", "lib", "lib64")
_ETC = {
    "passwd": "root:x:0:0:root:/root:/bin/sh\n",
    "group": "root:x:0:\nvideo:x:44:\n",
    "hosts": "127.0.0.1 localhost router\n",
}


def permitted() -> bool:
    """Whether this process may mount and make namespaces."""
    ended = subprocess.run(
        ["unshare", "--mount", "--net", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False
    )
    return ended.returncode == 0


@dataclass
class Image:
    """A built stage. user: "uid:gid"; command: the words of ENTRYPOINT and CMD."""

    root: Path
    environment: dict[str, str] = field(default_factory=lambda: {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"})
    user: str = "0:0"
    folder: str = "/"
    entrypoint: tuple[str, ...] = ()
    command: tuple[str, ...] = ()

    def words(
        self,
        command: Sequence[str],
        *,
        network: bool = False,
        binds: Mapping[Path, str] | None = None,
        sealed: bool = False,
    ) -> list[str]:
        """The command line that runs ``command`` in this image; sealed: the root is read-only but for /tmp and /run."""
        root = shlex.quote(str(self.root))
        lines = [f"mount --bind {root} {root}"] if sealed else []
        lines.append(f"mkdir -p {root}/proc {root}/dev {root}/tmp && chmod 1777 {root}/tmp")
        for name in _SYSTEM:
            if Path("/", name).is_symlink():
                lines.append(f"ln -sfn {Path('/', name).readlink()} {root}/{name}")
            elif Path("/", name).is_dir():
                lines.append(f"mkdir -p {root}/{name} && mount --bind -o ro /{name} {root}/{name}")
        lines += [f"mount --rbind /proc {root}/proc", f"mount --rbind /dev {root}/dev"]
        for source, place in (binds or {}).items():
            target = f"{root}{place}"
            make = f"mkdir -p {target}" if source.is_dir() else f"mkdir -p $(dirname {target}) && touch {target}"
            lines.append(f"{make} && mount --bind {shlex.quote(str(source))} {target}")
        if sealed:
            lines.append(f"mount -o remount,bind,ro {root}")
            lines.append(f"mount -t tmpfs -o mode=1777 tmpfs {root}/tmp && mount -t tmpfs tmpfs {root}/run")
            lines.append(f"install -d -o {self.user.partition(':')[0]} {root}/run/syncline")
        environment = [f"{name}={value}" for name, value in self.environment.items()]
        inside = f"cd {shlex.quote(self.folder)} && exec {shlex.join(command)}"
        enter = f"exec chroot --userspec={self.user} {root} /usr/bin/env -i"
        lines.append(f"{enter} {shlex.join(environment)} /bin/sh -c {shlex.quote(inside)}")
        return ["unshare", "--mount", *([] if network else ["--net"]), "sh", "-ec", "\n".join(lines)]


def build(containerfile: Path, target: str, out: Path, arguments: Mapping[str, str] | None = None) -> Image:
    """Build a target from the folder of a Containerfile, as an engine would; its stages are folders in ``out``."""
    known: dict[str, Image] = {}
    given: dict[str, str] = {}
    stages = re.split(r"^(?=FROM )", _joined(containerfile.read_text(encoding="utf-8")), flags=re.MULTILINE)
    for line in stages[0].splitlines():
        if line.startswith("ARG "):
            name, _, default = line.removeprefix("ARG ").partition("=")
            given[name] = (arguments or {}).get(name, _filled(default, given))
    wanted = _needed(target, stages[1:])
    for stage in stages[1:]:
        first, *rest = stage.splitlines()
        source, _, name = first.removeprefix("FROM ").partition(" AS ")
        if name not in wanted:
            continue
        image = _begin(known.get(_filled(source, given)), out / name)
        for line in rest:
            _step(image, line, containerfile.parent, known)
        known[name] = image
    return known[target]


def _joined(text: str) -> str:
    text = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    return re.sub(r"\\\n\s*", " ", text)


def _needed(target: str, stages: Sequence[str]) -> set[str]:
    by_name = {stage.splitlines()[0].rpartition(" AS ")[2]: stage for stage in stages}
    todo, found = [target], set()
    while todo:
        name = todo.pop()
        if name in by_name and name not in found:
            found.add(name)
            text = by_name[name]
            todo += [text.removeprefix("FROM ").partition(" AS ")[0], *re.findall(r"--from=(\S+)", text)]
    return found


def _begin(source: Image | None, root: Path) -> Image:
    root.mkdir(parents=True)
    if source is not None:
        shutil.copytree(source.root, root, symlinks=True, dirs_exist_ok=True, ignore=lambda *_: ["proc", "dev"])
        return replace(source, root=root, environment=dict(source.environment))
    (root / "etc").mkdir()
    for name, text in _ETC.items():
        (root / "etc" / name).write_text(text, encoding="utf-8")
    for name in ("run", "var/lib", "opt"):
        (root / name).mkdir(parents=True)
    return Image(root)


def _filled(text: str, values: Mapping[str, str]) -> str:
    return re.sub(r"\$\{?(\w+)\}?", lambda found: values.get(found[1], ""), text)


def _step(image: Image, line: str, context: Path, known: Mapping[str, Image]) -> None:
    word, _, rest = line.strip().partition(" ")
    if word == "RUN":
        ended = subprocess.run(
            image.words(["/bin/sh", "-c", rest]), capture_output=True, text=True, timeout=300, check=False
        )
        assert ended.returncode == 0, f"{line}: {ended.stderr}"
    elif word == "COPY":
        stage = re.match(r"--from=(\S+) ", rest)
        source, place = rest.split()[-2:]
        origin = context / source if stage is None else known[stage[1]].root / source.lstrip("/")
        shutil.copytree(origin, image.root / place.lstrip("/"), symlinks=True)
    elif word in ("ENV", "ARG"):
        image.environment.update(pair.split("=", 1) for pair in shlex.split(rest))
    elif word == "USER":
        image.user = rest
    elif word == "WORKDIR":
        image.folder = rest
    elif word in ("ENTRYPOINT", "CMD"):
        setattr(image, "entrypoint" if word == "ENTRYPOINT" else "command", tuple(json.loads(rest)))
