"""What the machine says of its own clock: chrony, the kernel, PTP. Told beside the estimate, and never trusted.

A time service keeps the Unix time; cameras are stamped by other clocks, which it does not touch but in their rate. What
is told here is how well the host's Unix time is known, so that a person can see whether the estimate found from the
pictures and the network's agree. The hub asks it only to choose among lags that the pictures leave open.
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

Run = Callable[[Sequence[str]], tuple[int, str]]
_STA_UNSYNC = 0x0040
_PATIENCE_S = 2.0
_PERIOD_S = 30.0
_CHRONY_FIELDS = 14


@dataclass(frozen=True, slots=True)
class ClockQuality:
    """source: "chrony", "ptp", "kernel" (somebody disciplines it) or "none". error_s: largest error of Unix time as
    that source sees it; inf = not known."""

    source: str
    error_s: float

    def gauges(self) -> dict[str, float]:
        """For a status: whether the clock is disciplined, and within what."""
        found = {"clock_synchronised": float(self.source != "none")}
        if math.isfinite(self.error_s):
            found["clock_error_s"] = self.error_s
        return found


def clock_quality(
    run: Run | None = None,
    kernel: Callable[[], tuple[bool, float]] | None = None,
    root: Path = Path("/"),
) -> ClockQuality:
    """Ask chrony, PTP where the machine has such a clock, and the kernel; the first that knows is believed.

    run: (exit status, output) of a command. kernel: (synchronised, largest error [s]). root: where /dev is.
    """
    ask = run or _run
    status, text = ask(("chronyc", "-c", "tracking"))
    if status == 0 and (error := chrony_error(text)) is not None:
        return ClockQuality("chrony", error)
    if any((root / "dev").glob("ptp*")):
        status, text = ask(("pmc", "-u", "-b", "0", "GET TIME_STATUS_NP"))
        if status == 0 and (error := ptp_error(text)) is not None:
            return ClockQuality("ptp", error)
    synchronised, largest = (kernel or kernel_clock)()
    return ClockQuality("kernel", largest) if synchronised else ClockQuality("none", math.inf)


def chrony_error(text: str) -> float | None:
    """Largest error [s] by ``chronyc -c tracking``; None where chrony follows nobody.

    |correction still to come| + root dispersion + half the root delay, as chrony's own bound is.
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
    """Offset [s] from the grandmaster by linuxptp's ``pmc``; None where there is none."""
    words = dict(line.split(None, 1) for line in text.splitlines() if len(line.split(None, 1)) == 2)
    if words.get("gmPresent", "").strip() != "true":
        return None
    try:
        return abs(float(words["master_offset"])) * 1e-9
    except (KeyError, ValueError):
        return None


class _Timex(ctypes.Structure):
    """The beginning of the kernel's struct timex (adjtimex(2)); the rest is room."""

    _fields_ = [
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("room", ctypes.c_char * 512),
    ]


def kernel_clock() -> tuple[bool, float]:
    """(synchronised, largest error [s]) as the kernel sees its clock, whoever disciplines it."""
    timex = _Timex()
    try:
        ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    except (AttributeError, OSError):  # no Linux
        return False, math.inf
    return not timex.status & _STA_UNSYNC, timex.maxerror / 1e6


class ClockWatcher:
    """Asks every 30 s, in a thread of its own: a time service that hangs must not hold up a status."""

    def __init__(self, ask: Callable[[], ClockQuality] = clock_quality, period_s: float = _PERIOD_S) -> None:
        self._ask, self._period_s = ask, period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock quality", daemon=True)
        self.quality: ClockQuality | None = None

    def __enter__(self) -> ClockWatcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()

    def gauges(self, clock: str) -> dict[str, float]:
        """For the status of a camera whose times are of this clock; empty until it is known.

        unix_minus_camera_s: what to add to the host's monotonic clock, where that stamps the camera, for Unix time.
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
            self.quality = self._ask()
            if self._stop.wait(self._period_s):
                return


def _run(command: Sequence[str]) -> tuple[int, str]:
    try:
        ended = subprocess.run(list(command), capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    except (OSError, subprocess.TimeoutExpired, UnicodeDecodeError):
        return 127, ""
    return ended.returncode, ended.stdout
