"""Agents as systemd starts them: real processes that say READY and WATCHDOG from their data loops."""

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
    # Nobody listens at that port: it must wait, and say so, and never be ready.
    "waiting": ("hub", 'id = "lonely"\n[bus]\nmode = "client"\nconnect = ["tcp/127.0.0.1:1"]\n'),
}


_PR_SET_MDWE, _REFUSE_EXEC_GAIN = 65, 1


def _as_in_the_unit() -> None:
    """MemoryDenyWriteExecute=yes, by the kernel's own word for it; kernels before 6.3 do not know it."""
    ctypes.CDLL(None).prctl(_PR_SET_MDWE, _REFUSE_EXEC_GAIN, 0, 0, 0)


def test_agents_tell_systemd_that_data_flows(tmp_path: Path) -> None:
    ears: dict[str, socket.socket] = {}
    processes: dict[str, subprocess.Popen[bytes]] = {}
    heard: dict[str, str] = dict.fromkeys(CONFIGS, "")
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
            for name, ear in ears.items():
                while True:
                    try:
                        heard[name] += ear.recv(4096).decode() + "\n"
                    except BlockingIOError:
                        break

        def until(done: object, timeout_s: float = 60.0) -> None:
            deadline = time.monotonic() + timeout_s
            while time.monotonic() < deadline and not done():  # type: ignore[operator]
                listen()
                time.sleep(0.05)

        until(lambda: all(heard[name].count("WATCHDOG=1") > 1 for name in ("camera", "hub", "recorder")))
        until(lambda: "waiting for a router" in heard["waiting"])
        for name in ("camera", "hub", "recorder"):
            assert heard[name].count("READY=1") == 1, (name, heard[name])
            assert heard[name].count("WATCHDOG=1") > 1
        assert "READY=1" not in heard["waiting"]
        assert "EXTEND_TIMEOUT_USEC=" in heard["waiting"]
        for process in processes.values():
            process.send_signal(signal.SIGTERM)
        for name, process in processes.items():
            assert process.wait(60) == 0, name
        listen()
        assert all("STOPPING=1" in heard[name] for name in ("camera", "hub", "recorder"))
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        for ear in ears.values():
            ear.close()
