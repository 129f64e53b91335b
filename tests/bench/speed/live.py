"""The live hub on streams at their own pace: silences, CPU, latency, and the track beside the offline path."""

from __future__ import annotations

from pathlib import Path

from protocols.topics import STATUS
from tests.bench import live
from tests.bench.speed.rows import Limit, Row, Section

_QUICK_S = 60.0
_SEED = 1


def measure(quick: bool, data: Path) -> Section:
    """Quick: the simulated rig alone."""
    found = Section()
    for name in ("simulated",) if quick else live.SCENARIOS:
        figures = live.run(name, data, _QUICK_S if quick else None, _SEED)
        work = f"live hub, {name}"
        if isinstance(figures, str):
            found.missing.append(f"{work}: {figures}")
            continue
        stale = Limit("ours", STATUS.stale_after_s)
        lines = (
            ("first calibration", "first_calibration_s", "s", None, ""),
            ("longest silence of its status", "status_silence_s", "s", stale, ""),
            ("longest silence of the track", "track_silence_s", "s", None, ""),
            ("CPU of a second before the first answer", "cpu_before", "s", None, ""),
            ("CPU of a second after it", "cpu_after", "s", None, ""),
            ("from a frame to its track, p99", "latency_p99_ms", "ms", None, ""),
            ("3-D error of the track", "track_mean_cm", "cm", None, "track_offline_mean_cm"),
            ("3-D error of the smoothed track", "smoothed_mean_cm", "cm", None, "smoothed_offline_mean_cm"),
        )
        for text, key, unit, must, other in lines:
            if figures.get(key) is None:
                found.missing.append(f"{work}: {text}: nothing was published in time")
                continue
            beside = ("the offline path over the same time", figures.get(other)) if other else ("", None)
            found.rows.append(Row(f"{work}: {text}", figures[key], unit, *beside, must=must))
    return found
