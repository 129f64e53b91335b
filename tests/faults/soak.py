"""Runs a rig for a while and prints how the memory of each of its processes grows; `make soak`.

    python -m tests.faults.soak [--seconds 900] [--cameras 3]

Router, hub, recorder and cameras as separate processes on simulated devices. Growth: a straight line through the
resident sizes after a third of the time, which is the warm-up: windows and caches fill in the first minutes.
"""

from __future__ import annotations

import argparse
import signal
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from protocols.bus.router.zenoh_router import free_endpoint
from tests.bench.load import resident_mb
from tests.faults.processes import Process, router


def configurations(folder: Path, endpoint: str, cameras: int) -> dict[str, tuple[str, Path]]:
    """name -> (command, file) of a rig's agents."""
    bus = f'[bus]\nmode = "client"\nconnect = ["{endpoint}"]\noutage_s = 20.0\n'
    texts = {
        "hub": ("hub", f'id = "hub"\nwindow_s = 20.0\ninterval_s = 5.0\n{bus}'),
        "recorder": ("record", f'out = "{folder}"\npart_mb = 50.0\npart_s = 60.0\n{bus}'),
    }
    began = time.time()
    for index in range(cameras):
        world = f"[simulated]\ncameras = {max(2, cameras)}\nstart_unix_s = {began}\n"
        texts[f"cam{index}"] = ("camera", f'id = "cam{index}"\n{bus}{world}')
    out = {}
    for name, (command, text) in texts.items():
        file = folder / f"{name}.toml"
        file.write_text(text, encoding="utf-8")
        out[name] = (command, file)
    return out


def main() -> None:
    """Run the rig and print a table."""
    parser = argparse.ArgumentParser(description="Memory of a rig's processes over time.")
    parser.add_argument("--seconds", type=float, default=900.0)
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--csv", type=Path, help="write every size there")
    words = parser.parse_args()
    sizes: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        endpoint = free_endpoint()
        processes = {"router": stack.enter_context(router(folder, endpoint))}
        for agent, (command, file) in configurations(folder, endpoint, words.cameras).items():
            log = folder / f"{agent}.txt"
            processes[agent] = stack.enter_context(Process("-m", "deploy", command, str(file), stderr=log))
        began = time.monotonic()
        while time.monotonic() - began < words.seconds:
            time.sleep(min(2.0, words.seconds / 60.0))
            for agent, process in processes.items():
                status = process.child.poll()
                assert status is None, f"{agent} ended with {status}: {(folder / f'{agent}.txt').read_text()[-500:]}"
                sizes.setdefault(agent, []).append((time.monotonic() - began, resident_mb(process.child.pid)))
        for process in reversed(processes.values()):
            process.child.send_signal(signal.SIGTERM)
    print(f"{words.seconds:.0f} s, growth after the first {words.seconds / 3:.0f} s")
    marks = [words.seconds * share for share in (1 / 3, 2 / 3, 1.0)]
    print(f"| process | MB at {', '.join(f'{mark:.0f}' for mark in marks)} s | MB/h |\n|---|---|---|")
    for agent, rows in sizes.items():
        warm = np.array([row for row in rows if row[0] > words.seconds / 3.0])
        slope = float(np.polyfit(warm[:, 0] / 3600.0, warm[:, 1], 1)[0])
        at_marks = ", ".join(f"{min(rows, key=lambda row: abs(row[0] - mark))[1]:.1f}" for mark in marks)
        print(f"| {agent} | {at_marks} | {slope:+.1f} |")
    if words.csv:
        with words.csv.open("w", encoding="utf-8") as file:
            file.write("process,seconds,megabytes\n")
            file.writelines(f"{agent},{at:.1f},{size:.3f}\n" for agent, rows in sizes.items() for at, size in rows)


if __name__ == "__main__":
    main()
