"""Agents as systemd starts them: real processes that send READY and WATCHDOG from their data loops."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

CONFIGS = {
    "camera": ("camera", 'id = "cam0"\n'),
    "hub": ("hub", 'id = "hub"\n'),
    "recorder": ("record", 'id = "recorder"\nout = "log.mcap"\nmin_free_mb = 0.0\n'),
    # Nothing listens at that port: it must wait, report that, and never be ready.
    "waiting": ("hub", 'id = "lonely"\n[bus]\nmode = "client"\nconnect = ["tcp/127.0.0.1:1"]\n'),
}


_PR_SET_MDWE, _REFUSE_EXEC_GAIN = 65, 1


def _as_in_the_unit() -> None:
    """MemoryDenyWriteExecute=yes, set by prctl; kernels before 6.3 do not have it."""
    ctypes.CDLL(None).prctl(_PR_SET_MDWE, _REFUSE_EXEC_GAIN, 0, 0, 0)


def test_agents_notify_systemd_that_data_flows(tmp_path: Path) -> None:
    ears: dict[str, socket.socket] = {}
    processes: dict[str, subprocess.Popen[bytes]] = {}
    received: dict[str, str] = dict.fromkeys(CONFIGS, "")
    try:
        for name, (command, text) in CONFIGS.items():
            (tmp_path / f"{name}.toml").write_text(text)
            ears[name] = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            ears[name].bind(str(tmp_path / name))
            ears[name].setblocking(False)
            environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / name), "WATCHDOG_USEC": "1000000"}
            environment.pop("WATCHDOG_PID", None)
            processes[name] = subprocess.Popen(
                [sys.executable, "-m", "deploy", command, str(tmp_path / f"{name}.toml")],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                preexec_fn=_as_in_the_unit,
            )

        def listen() -> None:
            for name, receiver in ears.items():
                while True:
                    try:
                        received[name] += receiver.recv(4096).decode() + "\n"
                    except BlockingIOError:
                        break

        def until(done: object, timeout_s: float = 60.0) -> None:
            deadline = time.monotonic() + timeout_s
            while time.monotonic() < deadline and not done():  # type: ignore[operator]
                listen()
                time.sleep(0.05)

        until(lambda: all(received[name].count("WATCHDOG=1") > 1 for name in ("camera", "hub", "recorder")))
        until(lambda: "waiting for a router" in received["waiting"])
        for name in ("camera", "hub", "recorder"):
            assert received[name].count("READY=1") == 1, (name, received[name])
            assert received[name].count("WATCHDOG=1") > 1
        assert "READY=1" not in received["waiting"]
        assert "EXTEND_TIMEOUT_USEC=" in received["waiting"]
        for process in processes.values():
            process.send_signal(signal.SIGTERM)
        for name, process in processes.items():
            assert process.wait(60) == 0, name
        listen()
        assert all("STOPPING=1" in received[name] for name in ("camera", "hub", "recorder"))
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        for receiver in ears.values():
            receiver.close()
