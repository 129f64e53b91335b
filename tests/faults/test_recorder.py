"""A recorder whose disk fills up, or that is killed: the log can be read, and the others notice nothing."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from protocols.log.read.reader import LogReader
from tests.faults.matrix import measured
from tests.faults.processes import Process, flow, wait_until


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 20 MB, in memory; skips, loudly, where mounting is not permitted."""
    place = tmp_path / "disk"
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(place)], capture_output=True, check=False
    )
    if done.returncode != 0:
        pytest.skip("NOT TRIED: mounting a small disk is not permitted here")
    yield place
    subprocess.run(["umount", str(place)], check=False)


def config(folder: Path, out: Path, endpoint: str) -> Path:
    file = folder / "recorder.toml"
    file.write_text(
        f'out = "{out}"\nmin_free_mb = 0.0\n[bus]\nmode = "client"\nconnect = ["{endpoint}"]\n', encoding="utf-8"
    )
    return file


def test_a_recorder_on_a_full_disk_waits_and_goes_on_when_there_is_space(tmp_path: Path, small_disk: Path) -> None:
    logs = small_disk / "logs"
    with ExitStack() as stack:
        endpoint, _, hub, sending = stack.enter_context(flow(tmp_path))
        errors = tmp_path / "recorder.txt"
        words = ("-m", "deploy", "record", str(config(tmp_path, logs, endpoint)))
        recording = stack.enter_context(Process(*words, stderr=errors))
        wait_until(lambda: list(logs.glob("*.mcap")))
        time.sleep(1.0)
        filler = small_disk / "others"
        with filler.open("wb") as out:
            out.write(bytes(int(shutil.disk_usage(small_disk).free - 0.045 * 20e6)))
        assert "not recording" in recording.line()
        share = 100.0 * shutil.disk_usage(small_disk).free / shutil.disk_usage(small_disk).total
        # All space at once, as another program may take it: also then it waits.
        with suppress(OSError), filler.open("ab", buffering=0) as out:
            while True:
                out.write(bytes(4096))
        time.sleep(2.0)
        assert recording.child.poll() is None
        filler.unlink()
        resumed = wait_until(lambda: len(list(logs.glob("*.mcap"))) > 1)
        time.sleep(2.0)
        recording.child.terminate()
        assert recording.child.wait(20.0) == 0
        put = sending.ask("stop")["put"]
        time.sleep(1.0)
        (sequences,) = hub.ask()["sequences"].values()
    kept = []
    for log in sorted(logs.glob("*.mcap")):
        reader = LogReader(log)
        kept.append(sum(1 for _ in reader.messages()))
        assert reader.damage == ""
    assert min(kept) > 20
    assert sequences == list(range(put))
    measured(
        "recorder: disk full",
        "waits at 5 % free, goes on within 5 s of space, logs readable, hub undisturbed",
        f"stopped with {share:.1f} % free, again after {resumed:.1f} s, {kept} messages readable, "
        f"hub {len(sequences)} of {put}",
        resumed <= 5.0,
    )


def test_a_recorder_that_is_killed_leaves_a_log_that_can_be_read(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    with ExitStack() as stack:
        endpoint, _, hub, sending = stack.enter_context(flow(tmp_path))
        recording = stack.enter_context(Process("-m", "deploy", "record", str(config(tmp_path, log, endpoint))))
        wait_until(log.exists)
        time.sleep(3.0)
        os.kill(recording.child.pid, signal.SIGKILL)
        killed = time.monotonic()
        recording.child.wait()
        put = sending.ask("stop")["put"]
        time.sleep(1.0)
        (sequences,) = hub.ask()["sequences"].values()
    observations = LogReader(log).messages(["observation"])
    stamps = [one.message.device_time_ns * 1e-9 for one in observations]  # type: ignore[attr-defined]
    lost = killed - max(stamps)
    assert sequences == list(range(put))
    measured(
        "recorder killed -9",
        "log readable, hub undisturbed",
        f"{len(stamps)} observations readable, the last {lost:.2f} s missing, hub {len(sequences)} of {put}",
    )
