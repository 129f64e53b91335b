"""Fetches what `make bench` measures beside: the extra `bench`, one package at a time, and opencv-contrib in a folder.

    python -m tests.bench.peers

A package that cannot be installed is reported and left out: its rows then state that they were not run. opencv-contrib
and opencv-python-headless are both ``cv2``, so the former goes into a folder of its own in the environment.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

from tests.bench.real_rigs import REPOSITORY

CONTRIB = Path(sys.prefix) / "opencv-contrib"
"""First on the path of the one section that needs it."""


def _pip(*words: str) -> bool:
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *words]
    return subprocess.run(command, cwd=REPOSITORY).returncode == 0


def main() -> None:
    """Install what can be had."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    missing = [package for package in project["optional-dependencies"]["bench"] if not _pip(package)]
    contrib = f"opencv-contrib-python-headless=={version('opencv-python-headless')}"
    if not CONTRIB.is_dir() and not _pip("--no-deps", "--target", str(CONTRIB), contrib):
        missing.append(contrib)
    for package in missing:
        print(f"left out of the bench: {package} could not be installed")


if __name__ == "__main__":
    main()
