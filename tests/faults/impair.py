"""Network impairment between two namespaces, in user space: every packet goes through a TUN device and this process.

    python -m tests.faults.impair NS_A NS_B CONTROL

CONTROL is a JSON file that is read again whenever it changes: partition, loss, delay_s, jitter_s, duplicate. Jitter
reorders packets, because each has its own delay. Addresses: 10.99.0.1 in NS_A, 10.99.0.2 in NS_B.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import struct
import subprocess
import sys
import time
from pathlib import Path

_TUNSETIFF = 0x400454CA
_IFF_TUN_NO_PI = 0x1001
_CLONE_NEWNET = 0x40000000


def open_tun(namespace: str, address: str) -> int:
    """A TUN device inside a namespace, held from outside."""
    libc = ctypes.CDLL(None, use_errno=True)
    home = os.open("/proc/self/ns/net", os.O_RDONLY)
    there = os.open(f"/var/run/netns/{namespace}", os.O_RDONLY)
    if libc.setns(there, _CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "setns")
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", b"bad0", _IFF_TUN_NO_PI))
    libc.setns(home, _CLONE_NEWNET)
    os.close(home)
    os.close(there)
    for words in (["addr", "replace", address, "dev", "bad0"], ["link", "set", "bad0", "up", "txqueuelen", "2000"]):
        subprocess.run(["ip", "-n", namespace, *words], check=True)
    return tun


def main(first: str, second: str, control: Path) -> None:
    """Forward until killed."""
    ends = [open_tun(first, "10.99.0.1/24"), open_tun(second, "10.99.0.2/24")]
    print("ready", flush=True)
    rng = random.Random(1)
    waiting: list[tuple[float, int, int, bytes]] = []
    number, read, rules = 0, 0, {}
    while True:
        written = control.stat().st_mtime_ns
        if written != read:
            rules, read = json.loads(control.read_text(encoding="utf-8")), written
        patience = min(0.02, max(0.0, waiting[0][0] - time.monotonic())) if waiting else 0.02
        for end in select.select(ends, [], [], patience)[0]:
            other = ends[1 - ends.index(end)]
            for _ in range(64):
                try:
                    packet = os.read(end, 65_536)
                except BlockingIOError:
                    break
                if rules.get("partition") or rng.random() < rules.get("loss", 0.0):
                    continue
                for _copy in range(1 + (rng.random() < rules.get("duplicate", 0.0))):
                    due = time.monotonic() + rules.get("delay_s", 0.0) + rng.uniform(0.0, rules.get("jitter_s", 0.0))
                    number += 1
                    heapq.heappush(waiting, (due, number, other, packet))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, other, packet = heapq.heappop(waiting)
            try:
                os.write(other, packet)
            except OSError:
                continue


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
