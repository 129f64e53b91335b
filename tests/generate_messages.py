"""Generates the protobuf code from protocols/schema/syncline.proto (``make proto``)."""

from __future__ import annotations

import sys
from pathlib import Path

SCHEMA = Path(__file__).parents[1] / "protocols" / "schema" / "syncline.proto"
MESSAGES = Path(__file__).parents[1] / "protocols" / "messages"


def generate(out: Path) -> None:
    """Write syncline_pb2.py and its type stub to ``out``."""
    from grpc_tools import protoc

    arguments = [f"-I{SCHEMA.parent}", f"--python_out={out}", f"--pyi_out={out}", str(SCHEMA)]
    if protoc.main(["protoc", *arguments]) != 0:
        raise SystemExit("protoc failed")


if __name__ == "__main__":
    generate(MESSAGES)
    sys.exit(0)
