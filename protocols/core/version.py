"""The program's version, as it is written to every output and log."""

from __future__ import annotations

VERSION = "0.1.0"
