"""The version, as it stands in every output and log."""

from __future__ import annotations

VERSION = "0.1.0"
