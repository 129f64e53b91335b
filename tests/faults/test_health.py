"""What a whole site says of its health while parts of it are lost: the reason within 5 s, and within 5 s its end."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocols.bus.router.zenoh_router import free_endpoint
from protocols.session.calibration import read_calibration
from tests.faults.matrix import measured
from tests.faults.processes import Process, wait_until
from tests.support.receiving import http_get

CAMERAS = ("cam0", "cam1", "cam2")
LIMIT_S = 5.0


class Site:
    """Router, recorder, hub and three simulated cameras as processes, asked over HTTP."""

    def __init__(self, folder: Path, disk: Path) -> None:
        self.folder, self.endpoint = folder, free_endpoint()
        self.ports = {name: int(free_endpoint().rpartition(":")[2]) for name in ("router", "recorder", "hub", *CAMERAS)}
        self.processes: dict[str, Process] = {}
        self._own = {
            "router": "",
            "recorder": f'out = "{disk / "recordings"}"\nmin_free_mb = 5.0\nmin_free_percent = 0.0\n',
            "hub": f'out = "{folder / "hub"}"\nknown = "last"\n',
            **{
                name: f"[simulated]\nscene = 'marker'\nwidth = 320\nstart_unix_s = {time.time():.0f}\n"
                for name in CAMERAS
            },
        }

    def start(self, *names: str) -> None:
        for name in names:
            command = {"router": "router", "recorder": "record", "hub": "hub"}.get(name, "camera")
            bus = (
                f'listen = ["{self.endpoint}"]'
                if name == "router"
                else f'mode = "client"\nconnect = ["{self.endpoint}"]'
            )
            file = self.folder / f"{name}.toml"
            health = f'[health]\nlisten = "127.0.0.1:{self.ports[name]}"\n'
            head, _, tables = self._own[name].partition("[")
            file.write_text(
                f'id = "{name}"\n{head}{"[" + tables if tables else ""}[bus]\n{bus}\n{health}', encoding="utf-8"
            )
            self.processes[name] = Process("-m", "deploy", command, str(file), stderr=self.folder / f"{name}.txt")

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        os.kill(self.processes[name].child.pid, number)

    def ready(self, name: str) -> tuple[int, str]:
        return http_get(f"127.0.0.1:{self.ports[name]}", "readyz")

    def all_ready(self, *names: str) -> bool:
        return all(self.ready(name)[0] == 200 for name in names or self.ports)

    def reported(self, reasons: dict[str, str]) -> bool:
        answers = {name: self.ready(name) for name in reasons}
        return all(answers[name][0] == 503 and re.search(text, answers[name][1]) for name, text in reasons.items())


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    disk = tmp_path / "disk"
    disk.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=40m", "tmpfs", str(disk)], capture_output=True, check=False
    )
    made = Site(tmp_path, disk)
    try:
        made.start(*made.ports)
        wait_until(made.all_ready, 90.0)
        yield made
    finally:
        for process in made.processes.values():
            process.__exit__()
        if done.returncode == 0:
            subprocess.run(["umount", str(disk)], check=False)


def _drill(name: str, told_s: float, cleared_s: float) -> None:
    measured(
        f"health: {name}",
        f"reported and cleared within {LIMIT_S:g} s",
        f"reported {told_s:.1f} s after, cleared {cleared_s:.1f} s after its return",
        max(told_s, cleared_s) <= LIMIT_S,
    )


def test_each_loss_is_reported_with_its_reason_and_cleared_when_it_is_over(site: Site) -> None:
    everyone = ("recorder", "hub", *CAMERAS)

    site.kill("cam1")
    site.kill("cam2")
    reported_s = wait_until(lambda: site.reported({"hub": r"no frames from cam1 \(\d s\), cam2 \(\d s\)"}), 15.0)
    assert site.all_ready("recorder", "cam0"), "they do their job"
    site.start("cam1", "cam2")
    wait_until(lambda: site.all_ready("cam1", "cam2"), 30.0)
    _drill("two of three cameras killed", reported_s, wait_until(lambda: site.all_ready("hub"), 30.0))

    site.kill("router")
    site.processes["router"].child.wait()
    reported_s = wait_until(lambda: site.reported(dict.fromkeys(everyone, f"no router at {site.endpoint} for")), 15.0)
    time.sleep(2.0)
    site.start("router")
    wait_until(lambda: site.all_ready("router"), 30.0)
    _drill("router killed", reported_s, wait_until(lambda: site.all_ready(*everyone), 30.0))

    site.kill("cam0", signal.SIGSTOP)
    reported_s = wait_until(lambda: site.reported({"hub": "no frames from cam0"}), 15.0)
    site.kill("cam0", signal.SIGCONT)
    _drill("a camera frozen", reported_s, wait_until(lambda: site.all_ready("hub", "cam0"), 30.0))

    disk = site.folder / "disk"
    filler = disk / "filler"
    if os.path.ismount(disk):
        filler.write_bytes(bytes(max(shutil.disk_usage(disk).free - 4_000_000, 0)))
        reported_s = wait_until(lambda: site.reported({"recorder": "MB are free"}), 15.0)
        filler.unlink()
        _drill("the recorder's disk full", reported_s, wait_until(lambda: site.all_ready("recorder"), 30.0))
    # A power cut of the hub and of all cameras: nobody stops in order, and all clocks begin anew.
    for name in ("hub", *CAMERAS):
        site.kill(name)
        site.processes[name].child.wait()
    state = site.folder / "hub" / "state"
    for file in (state / "current.toml", site.folder / "hub" / "calibration.toml"):
        assert set(read_calibration(file)[1]) <= set(CAMERAS)
    assert (state / "current.toml").resolve().parent == (state / "history").resolve()
    site.start("hub", *CAMERAS)
    reported_s = wait_until(lambda: site.reported({"hub": "reloaded and is not verified yet"}), 60.0)
    verified = wait_until(lambda: site.all_ready("hub"), 60.0)
    measured(
        "power cut of hub and cameras, known = last",
        "the last calibration again, not verified, then verified",
        f"published {reported_s:.1f} s after the start of all processes, verified {verified:.1f} s later",
    )
    # A line for each state, not for each second of it.
    for name in everyone:
        lines = (site.folder / f"{name}.txt").read_text(encoding="utf-8").splitlines()
        assert any("no router" in json.loads(line)["message"] for line in lines if line.startswith("{")), name
        assert len(lines) < 40, lines
