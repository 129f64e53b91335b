"""The drone flights from scratch, the whole command, beside mvus' CPU on the same labels (published, not run here)."""

from __future__ import annotations

from pathlib import Path

from tests.bench.real_rigs import MVUS, CommandFailed, run_calibrate
from tests.bench.speed.rows import Limit, Row, Section


def measure(quick: bool, data: Path) -> Section:
    """CPU seconds of the whole command: the interpreter's start and the writing of files too."""
    found = Section()
    for name in ("drone1", "drone2"):
        session = data / name
        if not (session / "observations.csv").is_file():
            found.missing.append(f"{name} from scratch: no recording in the data folder")
            continue
        try:
            cpu = min(run_calibrate(session, "observations.csv").cpu for _ in range(2 if quick else 3))
        except CommandFailed as error:
            found.missing.append(f"{name} from scratch: {error}")
            continue
        theirs = MVUS[name, "observations.csv"][0]
        found.rows.append(
            Row(f"{name} from scratch, whole command", cpu, "s", "mvus' CPU, as given", float(theirs),
                must=Limit("ratio", 15.0), reach=Limit("ratio", 50.0))
        )  # fmt: skip
    return found
