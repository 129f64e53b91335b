"""Figures of a live run against an offline answer, or the truth, on a common clock."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from hub.calibration.triangulation import triangulate
from protocols.core.clocks import NANOSECONDS, CameraTime, ReferenceTime, TimeMap
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose, fit_similarity
from protocols.geometry.types import Bools, Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration
from protocols.session.observations import Observations, Track
from protocols.session.rig import Rig
from tests.bench import scoring
from tests.bench.live_run import Heard

SETTLED_S = 40.0
"""Tracks are scored from this time after the first calibration [s]."""
BUMP_RIGHT_M, BUMP_RIGHT_RAD = 0.01, float(np.radians(0.3))
"""Error below which a bumped camera's pose is right again."""
_GRID_S = 0.02
_SAME_TIME_S = 1e-3
_ROUNDING = 1e-9
"""Of a camera's centre [rig units]: a move below it is none."""
_ERRORS = ("mean", "median", "rmse", "p95")


@dataclass(frozen=True, slots=True, eq=False)
class Bump:
    """A camera that is moved at a time of the common clock [s]. poses: all cameras' true ones afterwards."""

    camera: str
    at: float
    poses: dict[str, Pose]


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What a live run is compared with.

    cameras: their time maps lead to the common clock, with the std of that; of a simulated rig the truth, std 0.
    path_time, path: (n,) [s, common clock], (n, 3): the offline answer's path. truth_time, truth: (m,), (m, 3), on any
    clock, in metres. bump, late: changes of a simulated rig, and a camera that joins late.
    """

    rig: Rig
    seen: Observations
    cameras: dict[str, CameraCalibration]
    path_time: Floats
    path: Floats
    truth_time: Floats
    truth: Floats
    bump: Bump | None = None
    late: str = ""

    def common(self, camera: str, time: Floats) -> Floats:
        """Common time (n,) of times (n,) of a camera's clock [s]."""
        clock = self.cameras[camera].time_map
        return np.asarray(clock.clock_rate * time + clock.time_offset)


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """One published calibration with status "solved". at: its arrival [s]. message: as published."""

    at: float
    message: pb.Calibration

    @property
    def cameras(self) -> dict[str, pb.CameraCalibration]:
        """The cameras by name."""
        return {camera.camera: camera for camera in self.message.cameras}

    @property
    def poses(self) -> dict[str, Pose]:
        """Poses by camera."""
        return {
            name: Pose.from_rodrigues(np.array(camera.rotation), np.array(camera.translation))
            for name, camera in self.cameras.items()
        }

    def map_of(self, camera: str) -> TimeMap:
        """The reference clock from a camera's."""
        found = self.cameras[camera]
        return TimeMap(found.clock_rate, found.time_offset)

    def common(self, reference: Reference, time: Floats) -> Floats:
        """Common time (n,) of reference times (n,) of this answer [s], through its reference camera's clock."""
        name = self.message.reference_camera
        clock = self.map_of(name)
        return reference.common(name, (time - clock.time_offset) / clock.clock_rate)

    def calibrations(self, rig: Rig) -> dict[str, CameraCalibration]:
        """The same as read from a calibration.toml."""
        out = {}
        for name, pose in self.poses.items():
            found = self.cameras[name]
            matrix = np.array(found.matrix).reshape(3, 3)
            lens = Intrinsics(*rig.cameras[name].size, matrix, np.array(found.distortions), fisheye=found.fisheye)
            std = np.array(found.position_std)
            out[name] = CameraCalibration(name, lens, pose, self.map_of(name), found.time_offset_std, std, found.rms_px)
        return out


class LiveScores:
    """The figures of one run. Times are those of ``heard``; what could not be measured is None."""

    def __init__(self, heard: Heard, reference: Reference) -> None:
        self.heard, self.reference = heard, reference
        self.answers = [
            Answer(at, message)
            for at, message in heard.calibrations
            if message.status == "solved" and at <= heard.ended and message.reference_camera in reference.cameras
        ]
        names = np.array(heard.rows.camera)
        self._rows = {
            name: (heard.rows.time[names == name], heard.rows.arrival[names == name]) for name in reference.rig.cameras
        }
        self._seen = {name: np.sort(reference.common(name, self._rows[name][0])) for name in reference.cameras}

    def figures(self) -> dict[str, Any]:
        """All figures by name, which ends with the unit."""
        first = self.answers[0].at if self.answers else None
        found: dict[str, Any] = {
            "stream_s": float(self.heard.rows.arrival[-1]),
            "answers": len(self.answers),
            "cameras": len(self.answers[-1].cameras) if self.answers else 0,
            "first_calibration_s": first,
            "all_calibrated_s": self._calibrated_since(set(self.reference.cameras)),
            "status_silence_s": _longest_gap(np.array(self.heard.statuses), self.heard.ended),
            **self._cpu(first),
        }
        if first is None:
            return found
        found |= {"track_silence_s": self._track_silence(first), **self._latency(), **self._paths(first)}
        found |= {**self._lags(), **self._moves(), **self._changes()}
        return found

    def _calibrated_since(self, names: set[str]) -> float | None:
        return next((answer.at for answer in self.answers if names <= set(answer.cameras)), None)

    def _cpu(self, first: float | None) -> dict[str, Any]:
        """CPU seconds a second of stream, before and after the first answer."""
        time, spent = np.array(self.heard.cpu).T
        end = float(self.heard.rows.arrival[-1])

        def share(begin: float, until: float) -> float | None:
            at = np.interp([begin, until], time, spent)
            return float(at[1] - at[0]) / (until - begin) if until > begin else None

        return {
            "cpu_before": share(0.0, end if first is None else first),
            "cpu_after": None if first is None else share(first, end),
        }

    def _track_silence(self, first: float) -> float | None:
        """Longest time [s] without a track while two cameras that are calibrated see the marker."""
        grid = np.arange(first, float(self.heard.rows.arrival[-1]), _GRID_S)
        count = np.zeros(len(grid), dtype=np.int64)
        for name in self.reference.cameras:
            since = self._calibrated_since({name})
            arrival = np.sort(self._rows[name][1])
            if since is not None and len(arrival):
                last = np.searchsorted(arrival, grid, side="right") - 1
                fresh = (last >= 0) & (grid - arrival[last] <= scoring.SEEN_WITHIN)
                count += fresh & (grid >= since)
        on = count >= 2
        if not on.any():
            return None
        begins = np.maximum.accumulate(np.where(on & ~np.r_[False, on[:-1]], grid, first))
        tracks = np.array([first, *(at for at, _ in self.heard.tracks if at > first)])
        before = tracks[np.searchsorted(tracks, grid, side="right") - 1]
        return float((grid - np.maximum(before, begins))[on].max())

    def _published(self, messages: list[tuple[float, pb.Track]]) -> tuple[Floats, Floats, Floats]:
        """Arrival (n,), common time (n,) and position (n, 3) of tracks that are no prediction, as they came."""
        kept = [
            (at, track)
            for at, track in messages
            if track.state in ("tentative", "confirmed") and at >= self.answers[0].at
        ]
        arrival = np.array([at for at, _ in kept])
        time = np.array([track.reference_time_ns / NANOSECONDS for _, track in kept])
        position = np.array([track.position for _, track in kept]).reshape(-1, 3)
        for answer, until in self._spans():
            during = (arrival >= answer.at) & (arrival < until)
            time[during] = answer.common(self.reference, time[during])
        return arrival, time, position

    def _spans(self) -> list[tuple[Answer, float]]:
        """Each answer, and until when it is the last one."""
        ends = [*(answer.at for answer in self.answers[1:]), np.inf]
        return list(zip(self.answers, ends, strict=True))

    def _latency(self) -> dict[str, Any]:
        """From a row's arrival to the first track of its time or a later one, of rows while two cameras see."""
        arrival, time, _ = self._published(self.heard.tracks)
        newest = np.maximum.accumulate(time) if len(time) else time
        waits = []
        for answer, until in self._spans():
            known = [name for name in answer.cameras if name in self.reference.cameras]
            for name in known:
                own, arrived = self._rows[name]
                during = (arrived >= answer.at) & (arrived < until)
                clock = answer.map_of(name)
                moment = answer.common(self.reference, clock.clock_rate * own[during] + clock.time_offset)
                two = self._seen_by(known, moment) >= 2
                index = np.searchsorted(newest, moment[two] - _SAME_TIME_S)
                heard = np.r_[arrival, np.inf][index]
                waits.append(np.maximum(heard - arrived[during][two], 0.0))
        every = np.concatenate([np.zeros(0), *waits])
        # The last rows have not had the time for an answer.
        answered = every[np.isfinite(every)]
        return {
            "latency_median_ms": _quantile(1e3 * answered, 0.5),
            "latency_p99_ms": _quantile(1e3 * answered, 0.99),
            "rows_without_track_percent": 100.0 * float(np.mean(~np.isfinite(every))) if len(every) else None,
        }

    def _seen_by(self, names: list[str], moment: Floats) -> Floats:
        """How many of some cameras see the marker within 0.2 s of common times (n,)."""
        count = np.zeros(len(moment))
        for name in names:
            if len(self._seen[name]):
                count += scoring.nearest(self._seen[name], moment) <= scoring.SEEN_WITHIN
        return count

    def _paths(self, first: float) -> dict[str, Any]:
        """3-D errors [cm] and coverage of the tracks as they came, of the last answer and of the offline path."""
        live = {"track": self.heard.tracks, "smoothed": self.heard.smoothed}
        found: dict[str, Any] = {}
        for name, messages in live.items():
            arrival, time, position = self._published(messages)
            settled = np.flatnonzero(arrival >= first + SETTLED_S)
            # In order of time, and of several positions at one moment the first.
            kept = settled[np.argsort(time[settled], kind="stable")]
            kept = kept[np.r_[True, np.diff(time[kept]) > _SAME_TIME_S]] if len(kept) else kept
            found |= self._errors(name, time[kept], position[kept])
            if len(kept) > 1:
                found |= self._beside(name, float(time[kept][0]), float(time[kept][-1]))
        return found

    def _beside(self, name: str, begin: float, end: float) -> dict[str, Any]:
        """What the offline path and the last answer reach over a span of the common clock."""
        reference = self.reference
        during = (reference.path_time >= begin) & (reference.path_time <= end)
        found = self._errors(f"{name}_offline", reference.path_time[during], reference.path[during])
        if name == "track":
            begin = begin if reference.bump is None else max(begin, reference.bump.at)
            found |= self._errors("last_answer", *self._last_path(begin, end))
        return found

    def _errors(self, name: str, time: Floats, position: Floats) -> dict[str, Any]:
        reference = self.reference
        if len(time) < 2:
            return {}
        within = [part[(part >= time[0]) & (part <= time[-1])] for part in self._seen.values()]
        found: dict[str, Any] = {f"{name}_coverage_percent": 100.0 * scoring.coverage(time, within)}
        try:
            fit = scoring.align(time, position, reference.truth_time, reference.truth)
        except ValueError:
            return found
        figures = dict(zip(_ERRORS, fit.figures(), strict=True))
        return found | {f"{name}_{which}_cm": 100.0 * value for which, value in figures.items()}

    def _last_path(self, begin: float, end: float) -> tuple[Floats, Floats]:
        """The path that the last answer's clocks and poses give between two common times."""
        last, reference = self.answers[-1], self.reference
        known = {name: one for name, one in last.calibrations(reference.rig).items() if name in reference.cameras}
        tracks: dict[tuple[str, str], Track] = {}
        for key, track in reference.seen.tracks.items():
            if key[0] in known:
                moment = reference.common(key[0], track.time)
                during = (moment >= begin) & (moment <= end)
                if during.any():
                    tracks[key] = _rows_of(track, during)
        rig = Rig({name: reference.rig.cameras[name] for name in known}, reference.rig.units)
        try:
            tables = triangulate(rig, known, Observations(tracks)).tables
        except Refused:
            return np.zeros(0), np.zeros((0, 3))
        return last.common(reference, tables[0].time), tables[0].position

    def lag_errors(self) -> list[dict[str, Any]]:
        """By answer: arrival, and by camera the lag's error [ms] and z-score where the answer states its std."""
        out = []
        for answer in self.answers:
            base = answer.message.reference_camera
            errors: dict[str, float] = {}
            scores: dict[str, float] = {}
            for name, found in answer.cameras.items():
                if name == base or name not in self.reference.cameras:
                    continue
                time = CameraTime(found.lag_time_s or self._middle(name, answer.at))
                live = answer.map_of(base).camera_from_reference(answer.map_of(name).reference_from_camera(time))
                ours, theirs = self.reference.cameras[name], self.reference.cameras[base]
                known = theirs.time_map.camera_from_reference(ReferenceTime(ours.time_map.reference_from_camera(time)))
                stds = [found.time_offset_std, answer.cameras[base].time_offset_std]
                std = float(np.linalg.norm([*stds, ours.time_offset_std, theirs.time_offset_std]))
                errors[name] = 1e3 * (live - known)
                if std > 0.0:
                    scores[name] = (live - known) / std
            out.append({"at_s": answer.at, "lag_error_ms": errors, "z": scores})
        return out

    def _middle(self, camera: str, until: float) -> float:
        """The middle of what has arrived of a camera [s, its clock]."""
        time, arrival = self._rows[camera]
        arrived = time[arrival <= until]
        return float(0.5 * (arrived[0] + arrived[-1])) if len(arrived) else 0.0

    def _lags(self) -> dict[str, Any]:
        by_answer = self.lag_errors()
        scores = np.abs([value for one in by_answer for value in one["z"].values()])
        errors = np.abs([value for one in by_answer for value in one["lag_error_ms"].values()])
        last = np.abs(list(by_answer[-1]["lag_error_ms"].values()))
        return {
            "lag_z_max": _largest(scores),
            "lag_z_within_3_percent": 100.0 * float(np.mean(scores <= 3.0)) if len(scores) else None,
            "lag_error_max_ms": _largest(errors),
            "lag_error_last_ms": _largest(last),
        }

    def _moves(self) -> dict[str, Any]:
        """How far camera centres move between answers, in their stds; without a bumped one after its bump."""
        moves = []
        bump = self.reference.bump
        for one, other in itertools.pairwise(self.answers):
            for name in set(one.cameras) & set(other.cameras):
                moved = float(np.linalg.norm(other.poses[name].position - one.poses[name].position))
                std = float(np.linalg.norm(other.cameras[name].position_std))
                is_bumped = bump is not None and name == bump.camera and other.at >= self._arrival(bump)
                if moved > _ROUNDING and not is_bumped:
                    moves.append(moved / std if std > 0.0 else np.inf)
        values = np.array(moves)
        return {
            "centre_moves_max_std": _largest(values),
            "centre_moves_within_3_percent": 100.0 * float(np.mean(values <= 3.0)) if len(values) else None,
        }

    def _arrival(self, bump: Bump) -> float:
        """When the first frame after the bump arrived [s]."""
        time, arrival = self._rows[bump.camera]
        after = self.reference.common(bump.camera, time) >= bump.at
        return float(arrival[after].min()) if after.any() else np.inf

    def _changes(self) -> dict[str, Any]:
        """Seconds until a bumped camera is right again and stays so, and until a late one is calibrated."""
        found: dict[str, Any] = {}
        bump, late = self.reference.bump, self.reference.late
        if bump is not None:
            begin = self._arrival(bump)
            errors = [(one.at, *_pose_error(one, bump)) for one in self.answers if one.at >= begin]
            wrong = [at for at, metres, angle in errors if not (metres <= BUMP_RIGHT_M and angle <= BUMP_RIGHT_RAD)]
            right = [at for at, _, _ in errors if not wrong or at > wrong[-1]]
            found["bump_right_after_s"] = right[0] - begin if right else None
            if errors:
                found["bump_error_last_cm"] = 100.0 * errors[-1][1]
                found["bump_error_last_degrees"] = float(np.degrees(errors[-1][2]))
        if late and len(self._rows[late][1]):
            since = self._calibrated_since({late})
            found["late_calibrated_after_s"] = None if since is None else since - float(self._rows[late][1].min())
        return found


def _pose_error(answer: Answer, bump: Bump) -> tuple[float, float]:
    """Distance [m] and angle [rad] of the bumped camera from the truth; the others give the similarity."""
    poses = answer.poses
    others = [name for name in bump.poses if name in poses and name != bump.camera]
    if bump.camera not in poses or len(others) < 3:
        return np.inf, np.inf
    fitted = fit_similarity(
        np.array([poses[name].position for name in others]), np.array([bump.poses[name].position for name in others])
    )
    moved, true = fitted.pose(poses[bump.camera]), bump.poses[bump.camera]
    apart = float(np.linalg.norm(moved.position - true.position))
    return apart, so3.angle_between(moved.rotation, true.rotation)


def _rows_of(track: Track, keep: Bools) -> Track:
    rows = (track.frame[keep], track.time[keep], track.pixels[keep], track.size[keep])
    return Track(track.camera, track.label, *rows)


def _longest_gap(times: Floats, ended: float) -> float | None:
    """Longest time between two neighbours, and from the last one to the end [s]."""
    return float(np.diff(np.r_[times, ended]).max()) if len(times) else None


def _largest(values: Floats) -> float | None:
    return float(values.max()) if len(values) else None


def _quantile(values: Floats, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None
