"""One section of the table: `python -m tests.bench.speed SECTION [--quick] [--data FOLDER] [--rows FILE]`."""

from __future__ import annotations

import argparse
import importlib
import json
import os
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from tests.bench.real_rigs import DEFAULT_DATA  # noqa: E402
from tests.bench.speed.rows import Section, table  # noqa: E402


def main() -> None:
    """Run it; print its rows, or leave them in a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("section")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA)
    parser.add_argument("--rows", type=Path)
    options = parser.parse_args()
    module = importlib.import_module(f"tests.bench.speed.{options.section}")
    found: Section = module.measure(options.quick, options.data)
    if options.rows:
        options.rows.write_text(json.dumps(found.as_json()), encoding="utf-8")
        return
    print(table(found.rows))
    for line in found.missing:
        print(f"not run: {line}")


if __name__ == "__main__":
    main()
