"""tracks.csv and result.json of `syncline follow`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from protocols.core.version import VERSION

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration
    from hub.tracking.offline import FollowedTrack, FollowResult

TRACKS, RESULT, REPORT = "tracks.csv", "result.json", "report.html"
HEADER = "time,id,kind,state,x,y,z,height,std"


def tracks_text(tracks: Sequence[FollowedTrack]) -> str:
    """tracks.csv: one row a track a time, by time and id; an empty height = not known."""
    rows = []
    for track in tracks:
        columns = (track.times, track.position, track.std, track.height, track.confirmed)
        for time, (x, y, z), std, height, confirmed in zip(*columns, strict=True):
            state = "confirmed" if confirmed else "coasting"
            tall = f"{height:.17g}" if np.isfinite(height) and height > 0.0 else ""
            place = f"{x:.17g},{y:.17g},{z:.17g}"
            row = f"{time:.17g},{track.id},{track.kind},{state},{place},{tall},{std:.17g}"
            rows.append((float(time), track.id, row))
    return "\n".join([HEADER, *(row for _, _, row in sorted(rows))]) + "\n"


def result_document(
    result: FollowResult,
    known: GivenCalibration,
    *,
    kind: str,
    command: str,
    times: Sequence[float],
    cpu_seconds: float,
    warnings: Sequence[str],
    scores: dict[str, float | int | None] | None,
    seed: int,
) -> dict[str, Any]:
    """The content of result.json. times: the wanted reference times [s]."""
    calibration = known.calibration
    return {
        "status": "done",
        "command": command,
        "version": VERSION,
        "kind": kind,
        "units": calibration.units if calibration.scale == "metric" else "baselines",
        "reference": calibration.reference,
        "times": len(times),
        "first_time": times[0],
        "last_time": times[-1],
        "count": len(result.tracks),
        "rows": sum(len(track.times) for track in result.tracks),
        "tracks": [
            {
                "id": track.id,
                "kind": track.kind,
                "rows": len(track.times),
                "confirmed_rows": int(track.confirmed.sum()),
                "first_time": float(track.times[0]),
                "last_time": float(track.times[-1]),
                "height": _finite(float(np.median(track.height))),
                "median_std": _finite(float(np.median(track.std))),
                "path_length": float(np.linalg.norm(np.diff(track.position, axis=0), axis=1).sum()),
                "cameras": sorted({camera for camera, _, _ in track.detections}),
                "detections": len(track.detections),
            }
            for track in result.tracks
        ],
        "cameras": {
            name: {
                "frames": camera.frames,
                "detections": camera.detections,
                "used": _finite(camera.used),
                "clutter": _finite(camera.clutter),
                "detection_probability": _finite(camera.detection_probability),
            }
            for name, camera in result.cameras.items()
        },
        "warnings": list(warnings),
        "cpu_seconds": cpu_seconds,
        "scores": scores,
        "seed": seed,
    }


def result_text(document: dict[str, Any]) -> str:
    """Strict JSON."""
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
