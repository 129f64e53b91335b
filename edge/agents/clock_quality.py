"""Quality of the host clock as reported by chrony, PTP or the kernel.

A time service disciplines the Unix time. Cameras are stamped by other clocks, of which it affects only the rate. The
reported error bound of the host's Unix time is published so that a person can compare the time offsets estimated from
the images with those of the network. The hub uses it only to choose among lags that the images leave ambiguous.
"""

from __future__ import annotations

import ctypes
import math
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

CommandRunner = Callable[[Sequence[str]], tuple[int, str]]
_STA_UNSYNC = 0x0040  # adjtimex(2): the kernel's clock is not synchronised
_PERIOD_S = 30.0  # between two queries: time services poll every minute or so
_CHRONY_FIELDS = 14  # of `chronyc -c tracking`


@dataclass(frozen=True, slots=True)
class ClockQuality:
    """Synchronisation state of the host clock.

    source: "chrony", "ptp", "kernel" (disciplined by some other service) or "none". error_s: upper bound of the error
    of Unix time according to that source; inf = not known.
    """

    source: str
    error_s: float

    def gauges(self) -> dict[str, float]:
        """Gauges for the status message: whether the clock is disciplined, and its error bound [s]."""
        found = {"clock_synchronised": float(self.source != "none")}
        if math.isfinite(self.error_s):
            found["clock_error_s"] = self.error_s
        return found


def run_command(command: Sequence[str], timeout_s: float = 2.0) -> tuple[int, str]:
    """(exit status, output) of a command, which answers in milliseconds, or hangs; status 127 if it does not exist."""
    try:
        result = subprocess.run(list(command), capture_output=True, text=True, timeout=timeout_s, check=False)
    except (OSError, subprocess.TimeoutExpired, UnicodeDecodeError):
        return 127, ""
    return result.returncode, result.stdout


def query_clock_quality(
    run: CommandRunner | None = None,
    kernel: Callable[[], tuple[bool, float]] | None = None,
    root: Path = Path("/"),
) -> ClockQuality:
    """Query chrony, then PTP if the machine has a PTP clock, then the kernel; the first valid reply is returned.

    run: gives (exit status, output) of a command. kernel: gives (synchronised, error bound [s]). root: parent of /dev.
    """
    query = run or run_command
    status, text = query(("chronyc", "-c", "tracking"))
    if status == 0 and (error := chrony_error(text)) is not None:
        return ClockQuality("chrony", error)
    if any((root / "dev").glob("ptp*")):
        status, text = query(("pmc", "-u", "-b", "0", "GET TIME_STATUS_NP"))
        if status == 0 and (error := ptp_error(text)) is not None:
            return ClockQuality("ptp", error)
    synchronised, largest = (kernel or kernel_clock)()
    return ClockQuality("kernel", largest) if synchronised else ClockQuality("none", math.inf)


def chrony_error(text: str) -> float | None:
    """Error bound [s] from ``chronyc -c tracking``; None where chrony is not synchronised.

    |remaining correction| + root dispersion + half the root delay, which is the bound that chrony itself reports.
    """
    fields = text.strip().split(",")
    if len(fields) < _CHRONY_FIELDS or fields[13].lower().startswith("not"):
        return None
    try:
        correction, delay, dispersion = float(fields[4]), float(fields[10]), float(fields[11])
    except ValueError:
        return None
    error = abs(correction) + dispersion + 0.5 * delay
    return error if math.isfinite(error) else None


def ptp_error(text: str) -> float | None:
    """Offset [s] from the grandmaster as reported by linuxptp's ``pmc``; None where there is no grandmaster."""
    words = dict(line.split(None, 1) for line in text.splitlines() if len(line.split(None, 1)) == 2)
    if words.get("gmPresent", "").strip() != "true":
        return None
    try:
        return abs(float(words["master_offset"])) * 1e-9
    except (KeyError, ValueError):
        return None


class _Timex(ctypes.Structure):
    """The leading fields of the kernel's struct timex (adjtimex(2)); the rest is padding."""

    _fields_ = [
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("padding", ctypes.c_char * 512),
    ]


def kernel_clock() -> tuple[bool, float]:
    """(synchronised, error bound [s]) of the kernel clock, whichever service disciplines it."""
    timex = _Timex()
    try:
        ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    except (AttributeError, OSError):  # not Linux
        return False, math.inf
    return not timex.status & _STA_UNSYNC, timex.maxerror / 1e6


class ClockMonitor:
    """Queries the clock quality every 30 s in its own thread, so that a time service that hangs delays no status."""

    def __init__(self, query: Callable[[], ClockQuality] = query_clock_quality, period_s: float = _PERIOD_S) -> None:
        self._query, self._period_s = query, period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock quality", daemon=True)
        self.quality: ClockQuality | None = None

    def __enter__(self) -> ClockMonitor:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()

    def gauges(self, clock: str) -> dict[str, float]:
        """Gauges for the status of a camera that is stamped by ``clock``; empty until the first query has returned.

        unix_minus_camera_s: Unix time minus the host's monotonic clock [s], given where that clock stamps the camera.
        """
        quality = self.quality
        if quality is None:
            return {}
        found = quality.gauges()
        if clock == "monotonic":
            found["unix_minus_camera_s"] = time.time() - time.monotonic()
        return found

    def _run(self) -> None:
        while True:
            self.quality = self._query()
            if self._stop.wait(self._period_s):
                return
