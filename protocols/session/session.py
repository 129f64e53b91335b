"""A session in memory: the rig and what its cameras observed, as `load_session` reads it or a notebook makes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from protocols.core.errors import InputError
from protocols.session.csv_table import dataframe
from protocols.session.folder import column_warnings
from protocols.session.observations import DEFAULT_LABEL, Observations, gather_tracks
from protocols.session.rig import Rig, misspelt_keys, parse_rig

if TYPE_CHECKING:
    import pandas

_COLUMNS = ("camera", "time", "u", "v")


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """The input of a calibration.

    rig: the cameras and everything that is known of them. observations: tracks by camera and label. warnings: what was
    noticed while reading. name: of the folder or log, for progress and reports.
    """

    rig: Rig
    observations: Observations
    warnings: tuple[str, ...] = ()
    name: str = "session"

    @classmethod
    def from_table(
        cls, rig: Rig | Mapping[str, Any], table: Mapping[str, Sequence[Any]], name: str = "session"
    ) -> Session:
        """A session from detections in columns: a mapping of lists or arrays, or a pandas DataFrame.

        rig: a ``Rig``, or the tables of rig.toml as a dict: ``{"cam0": {"size": [1920, 1080], "fps": 30.0, …}}``.
        table: columns ``camera, time, u, v`` and optionally ``frame, size, label``, of equal length: seconds on each
        camera's own clock, distorted pixels in OpenCV's convention, size in pixels (NaN = not measured).
        Raises InputError where a column is missing, not finite, or names a camera that the rig does not have.
        """
        if not isinstance(rig, Rig):
            if not isinstance(rig, Mapping) or not all(isinstance(one, Mapping) for one in rig.values()):
                remedy = 'give {"cam0": {"size": [1920, 1080], "matrix": …, "distortions": …}, …}'
                raise InputError("the rig is not a dict with a dict for each camera", remedy=remedy)
            tables = {str(key): {str(k): _plain(value) for k, value in table.items()} for key, table in rig.items()}
            rig = parse_rig(tables, Path("rig"), tomli_w.dumps(tables))
        missing = [column for column in _COLUMNS if column not in table]
        if missing:
            raise InputError(f"column {', '.join(missing)} is missing", remedy=f"give {', '.join(_COLUMNS)}")
        cameras = [str(value) for value in table["camera"]]
        count = len(cameras)
        given = {name: _numbers(table[name], name) for name in ("time", "u", "v", "size", "frame") if name in table}
        uneven = [name for name, values in given.items() if values.shape != (count,)]
        if uneven:
            raise InputError(
                f"column {uneven[0]} is not as long as camera ({count} rows)", remedy="give one value a row"
            )
        bad = [name for name in ("time", "u", "v", "frame") if name in given and not np.isfinite(given[name]).all()]
        if bad:
            raise InputError(f"{bad[0]} is not finite everywhere", remedy="remove the rows: a point not seen has none")
        unknown = sorted(set(cameras) - set(rig.cameras))
        if unknown:
            raise InputError(
                f"camera {unknown[0]!r} is not in the rig ({', '.join(rig.cameras)})", remedy="add it to the rig"
            )
        labels = [str(value) for value in table["label"]] if "label" in table else [DEFAULT_LABEL] * count
        frame = given["frame"].astype(np.int64) if "frame" in given else _frames(cameras, labels, given["time"])
        size = given.get("size", np.full(count, np.nan))
        found = gather_tracks(
            cameras, labels, frame, given["time"], np.column_stack([given["u"], given["v"]]), size, order=rig.cameras
        )
        found = replace(found, warnings=found.warnings + column_warnings(rig, found) + misspelt_keys(rig))
        return cls(rig, found, found.warnings, name)

    def to_dataframe(self) -> pandas.DataFrame:
        """One row per observation: camera, label, frame, time [s, camera clock], u, v [px], size [px]. Needs pandas."""
        tracks = list(self.observations.tracks.values())
        return dataframe(
            {
                "camera": [track.camera for track in tracks for _ in range(len(track))],
                "label": [track.label for track in tracks for _ in range(len(track))],
                "frame": _joined([track.frame for track in tracks]),
                "time": _joined([track.time for track in tracks]),
                "u": _joined([track.pixels[:, 0] for track in tracks]),
                "v": _joined([track.pixels[:, 1] for track in tracks]),
                "size": _joined([track.size for track in tracks]),
            }
        )


def _numbers(values: Any, name: str) -> Any:
    """A column as float64. Raises InputError."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"column {name} holds something that is not a number", remedy="give numbers") from None


def _plain(value: Any) -> Any:
    """Lists in place of arrays, as TOML has them."""
    return np.asarray(value).tolist() if isinstance(value, np.ndarray | np.generic) else value


def _joined(parts: list[Any]) -> Any:
    return np.concatenate(parts) if parts else np.zeros(0)


def _frames(cameras: list[str], labels: list[str], time: Any) -> Any:
    """Consecutive frame numbers in order of time, for each camera and label."""
    names = np.array([f"{camera}\0{label}" for camera, label in zip(cameras, labels, strict=True)])
    order = np.lexsort((time, names))
    frame = np.zeros(len(names), dtype=np.int64)
    starts = np.r_[True, names[order][1:] != names[order][:-1]] if len(names) else np.zeros(0, dtype=bool)
    position = np.arange(len(names))
    frame[order] = position - np.maximum.accumulate(np.where(starts, position, 0)) if len(names) else frame
    return frame
