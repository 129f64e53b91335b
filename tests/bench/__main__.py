"""Speed and scale beside what a user would pick for the same work: one table, all in one run.

    python -m tests.bench [--quick] [--data FOLDER] [--only timing,joint] [--keep] [--json FILE]

`make bench`, `make bench QUICK=1`, `make bench KEEP=1`. Each section runs in a process of its own, one after the other.
Ratio: how many times better ours is, above 1 we are ahead; CPU seconds wherever a process computes, wall where
processes talk or start. Every run is written to bench-out/ with the machine's facts; --keep makes it the one that later
runs are compared with (tests/bench/kept/): what fell by more than a fifth is shown. Sections that were
not run are listed with the reason. Exit status 1 if a section could not be run at all, not for a missed figure.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from tests.bench.peers import CONTRIB  # noqa: E402
from tests.bench.real_rigs import DEFAULT_DATA, REPOSITORY  # noqa: E402
from tests.bench.speed.rows import Section, fallen, machine, table  # noqa: E402

SECTIONS = {
    "timing": "two cameras that share no clock",
    "drones": "two recorded flights, the whole command",
    "joint": "ten cameras adjusted together",
    "nodes": "pose nodes",
    "uav": "UAV tracker",
    "detectors": "marker and person detectors",
    "bus": "edge to hub",
    "live": "the live hub on streams at their own pace",
    "hubs": "a hub with up to 1,000 cameras",
    "recorder": "recorder",
    "processes": "memory and starts of real processes",
}
KEPT = Path(__file__).parent / "kept"
_LONGEST_S = {True: 240.0, False: 3600.0}


def run(name: str, quick: bool, data: Path, file: Path) -> Section | str:
    """One section; the reason where it could not be run."""
    command = [sys.executable, "-m", "tests.bench.speed", name, "--data", str(data), "--rows", str(file)]
    path = [str(CONTRIB)] if name == "uav" and CONTRIB.is_dir() else []
    path += [os.environ["PYTHONPATH"]] if os.environ.get("PYTHONPATH") else []
    environment = {**os.environ, **({"PYTHONPATH": os.pathsep.join(path)} if path else {})}
    try:
        done = subprocess.run(
            [*command, "--quick"] if quick else command,
            cwd=REPOSITORY,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=_LONGEST_S[quick],
        )
    except subprocess.TimeoutExpired:
        return f"not done after {_LONGEST_S[quick]:.0f} s"
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        return f"status {done.returncode}: {lines[-1] if lines else ''}"
    return Section.from_json(json.loads(file.read_text(encoding="utf-8")))


def main() -> int:
    """Run the sections, print the table, keep it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small work: within 5 minutes on an idle machine")
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder of the recordings")
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, by comma")
    parser.add_argument("--keep", action="store_true", help="compare later runs with this one")
    parser.add_argument("--json", type=Path, help="where to write the run; default bench-out/quick.json or full.json")
    options = parser.parse_args()
    wanted = [name for name in options.only.split(",") if name]
    unknown = [name for name in wanted if name not in SECTIONS]
    if unknown:
        parser.error(f"no section named {', '.join(unknown)}; there are {', '.join(SECTIONS)}")
    facts = machine()
    print(", ".join(f"{name} {value}" for name, value in facts.items()), flush=True)
    whole, failed, began = Section(), [], time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        for name in wanted:
            start = time.perf_counter()
            found = run(name, options.quick, options.data.resolve(), Path(folder) / f"{name}.json")
            print(f"{name}: {SECTIONS[name]}, {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
            if isinstance(found, str):
                failed.append(name)
                whole.missing.append(f"{SECTIONS[name]} ({name}): {found}")
            else:
                whole.rows += found.rows
                whole.missing += found.missing
    for name in SECTIONS:
        if name not in wanted:
            whole.missing.append(f"{SECTIONS[name]} ({name}): not asked for")
    facts["load_at_end"] = round(os.getloadavg()[0], 2)
    print(f"\n{table(whole.rows)}\n")
    for line in whole.missing:
        print(f"not run: {line}")
    missed = [row.key for row in whole.rows if row.holds(row.must) is False]
    asked = sum(row.holds(row.must) is not None for row in whole.rows)
    print(f"{asked - len(missed)} of {asked} musts met{': missed ' + '; '.join(missed) if missed else ''}")
    load = facts["load_at_begin"]
    print(f"{time.perf_counter() - began:.0f} s; load {load} at the begin, {facts['load_at_end']} at the end")
    if load > 0.5 * (facts["cores"] or 1):
        print("machine busy: ratios of one run can be compared, absolute times cannot")
    _compare_and_keep(whole, facts, options)
    return 1 if failed else 0


def _compare_and_keep(whole: Section, facts: dict[str, Any], options: argparse.Namespace) -> None:
    kind = "quick" if options.quick else "full"
    kept_file = KEPT / f"{kind}.json"
    kept = json.loads(kept_file.read_text(encoding="utf-8")) if kept_file.is_file() else None
    if kept is not None:
        worse = fallen(whole.rows, kept["rows"])
        where = f"the kept {kind} run ({kept['machine']['processor'] or kept['machine']['machine']})"
        print(f"fell by more than a fifth against {where}:" if worse else f"nothing fell against {where}")
        for line in worse:
            print(f"  {line}")
    rows = {row.key: row.kept() for row in whole.rows}
    run_file = options.json or REPOSITORY / "bench-out" / f"{kind}.json"
    run_file.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"machine": facts, "rows": rows, "not_run": whole.missing}, indent=1, ensure_ascii=False) + "\n"
    run_file.write_text(text, encoding="utf-8")
    print(f"written to {run_file}")
    if options.keep:
        # What was not run this time stays as it was kept.
        merged = {**(kept["rows"] if kept else {}), **rows}
        text = json.dumps({"machine": facts, "rows": merged, "not_run": whole.missing}, indent=1, ensure_ascii=False)
        KEPT.mkdir(exist_ok=True)
        kept_file.write_text(text + "\n", encoding="utf-8")
        print(f"kept as {kept_file.relative_to(REPOSITORY)}")


if __name__ == "__main__":
    sys.exit(main())
