"""Collects what every fault test measured, and prints it as one table."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

VARIABLE = "SYNCLINE_FAULT_MATRIX"


def measured(fault: str, required: str, text: str, within: bool = True) -> None:
    """Note one row's figure; printed at once and, under `python -m tests.faults`, in the table at the end.

    within: whether it keeps what is required. Times depend on the load of the machine, so they are reported and do
    not decide; what decides is asserted.
    """
    text = text if within else f"OVER: {text}"
    print(f"\n{fault}: {text} (required: {required})")
    file = os.environ.get(VARIABLE)
    if file:
        with Path(file).open("a", encoding="utf-8") as out:
            out.write(json.dumps([fault, required, text]) + "\n")


def table(file: Path) -> str:
    """The matrix as Markdown."""
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []
    lines: Iterable[str] = (f"| {fault} | {required} | {text} |" for fault, required, text in rows)
    return "\n".join(["| fault | required | measured |", "|---|---|---|", *lines])
