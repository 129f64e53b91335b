"""A recorder whose disk fills up, or that is killed: the log can be read, and the others notice nothing."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from protocols.bus.router.zenoh_router import free_endpoint
from protocols.log.read.reader import LogReader
from tests.faults.matrix import measured
from tests.faults.processes import Process, publisher, receiver, router, wait_until


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


def test_a_disk_that_fills_up_ends_the_recording_with_a_whole_log(tmp_path: Path, small_disk: Path) -> None:
    endpoint, log = free_endpoint(), small_disk / "log.mcap"
    with ExitStack() as stack:
        stack.enter_context(router(tmp_path, endpoint))
        hub = stack.enter_context(receiver(endpoint))
        hub.ready()
        sending = stack.enter_context(publisher(endpoint))
        sending.ready()
        errors = tmp_path / "recorder.txt"
        words = ("-m", "deploy", "record", str(config(tmp_path, log, endpoint)))
        recording = stack.enter_context(Process(*words, stderr=errors))
        wait_until(log.exists)
        time.sleep(1.0)
        filler = small_disk / "others"
        with filler.open("wb") as out:
            out.write(bytes(int(shutil.disk_usage(small_disk).free - 0.045 * 20e6)))
        status = recording.child.wait(20.0)
        put = sending.ask("stop")["put"]
        time.sleep(1.0)
        (sequences,) = hub.ask()["sequences"].values()
    with LogReader(log) as reader:
        kept = sum(1 for _ in reader.messages())
    share = 100.0 * shutil.disk_usage(small_disk).free / shutil.disk_usage(small_disk).total
    text = errors.read_text(encoding="utf-8")
    assert status == 2
    assert "min_free_percent is 5; the log is complete" in text
    assert kept > 20
    assert sequences == list(range(put))
    measured(
        "recorder: disk full",
        "stops at 5 % free, log readable, hub undisturbed",
        f"stopped with {share:.1f} % free, {kept} messages readable, hub {len(sequences)} of {put}",
    )


def test_a_recorder_that_is_killed_leaves_a_log_that_can_be_read(tmp_path: Path) -> None:
    endpoint, log = free_endpoint(), tmp_path / "log.mcap"
    with ExitStack() as stack:
        stack.enter_context(router(tmp_path, endpoint))
        hub = stack.enter_context(receiver(endpoint))
        hub.ready()
        sending = stack.enter_context(publisher(endpoint))
        sending.ready()
        recording = stack.enter_context(Process("-m", "deploy", "record", str(config(tmp_path, log, endpoint))))
        wait_until(log.exists)
        time.sleep(3.0)
        os.kill(recording.child.pid, signal.SIGKILL)
        killed = time.monotonic()
        recording.child.wait()
        put = sending.ask("stop")["put"]
        time.sleep(1.0)
        (sequences,) = hub.ask()["sequences"].values()
    with LogReader(log) as reader:
        stamps = [one.message.device_time_ns * 1e-9 for one in reader.messages() if one.topic.name == "observation"]  # type: ignore[attr-defined]
    lost = killed - max(stamps)
    assert sequences == list(range(put))
    measured(
        "recorder killed -9",
        "log readable, hub undisturbed",
        f"{len(stamps)} observations readable, the last {lost:.2f} s missing, hub {len(sequences)} of {put}",
    )
