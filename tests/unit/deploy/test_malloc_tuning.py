"""The C library's heap under an agent's kind of load."""

from __future__ import annotations

import subprocess
import sys

import pytest

GROWTH = """
import os, sys
from deploy.agents.malloc_tuning import limit_heap_growth
if sys.argv[1] == "steady" and not limit_heap_growth(release_large_blocks=True):
    print("cannot"); sys.exit()
import numpy as np
def mb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
del (large := [np.ones(2_000_000)])[:]  # from here on the C library thinks that 16 MB are an everyday size
before, kept = mb(), []
blocks = [(np.ones(40_000), np.ones(2_000)) for _ in range(100)]  # 320 kB each that go, and 16 kB behind that stay
kept = [small for _, small in blocks]
del blocks
print(mb() - before - 100 * 0.016)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_memory_freed_by_a_solver_returns_to_the_system() -> None:
    def grown(how: str) -> str:
        done = subprocess.run([sys.executable, "-c", GROWTH, how], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    if grown("steady") == "cannot":
        pytest.skip("no glibc")
    assert float(grown("steady")) < 2.0


FAULTS = """
import resource, sys
from deploy.agents.malloc_tuning import retain_freed_memory
if sys.argv[1] == "kept" and not retain_freed_memory():
    print("cannot"); sys.exit()
import numpy as np
def work():
    parts = [np.ones(60_000) for _ in range(20)]  # 480 kB each, as a solver's
    return sum(part.sum() for part in parts)
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_memory_freed_by_a_command_is_reused() -> None:
    done = subprocess.run([sys.executable, "-c", FAULTS, "kept"], capture_output=True, text=True, check=True)
    if done.stdout.strip() == "cannot":
        pytest.skip("no glibc")
    pages = 20 * 20 * 480_000 / 4096
    assert float(done.stdout) < 0.05 * pages
