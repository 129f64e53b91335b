"""Section 3.2 of the asynchronous calibration paper on real tracks: a board corner, two webcams, one clock shifted.

The paper's own recording is not public; this one is `webcams/session` of the data folder: 9 s at 6 fps, about 0.17 s
between frames whose timestamps jitter, clocks that agree except for the cameras' own delays. Procedure:

* cameras and label: the pair of cameras and the corner that share most frames, the first of equals;
* the second camera's clock is set ahead by ``SHIFT``; both recordings begin at one reading of their clocks and are
  numbered from there, and only these numbers go into the method (section 2.2);
* pixels are undistorted, but not resampled or smoothed;
* the lag in time is the mean difference of the stamps of frames of one number plus f frame intervals, as the paper
  compares its result with the mean of the stamps.

The cameras' own delays are part of the error against the shift; with the F of the board's calibration the same
crossings measure them (``delay``).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hub.baselines.alternating_lag import (
    AlternatingLagResult,
    Iteration,
    corresponding_points,
    estimate_alternately,
    point_lags,
)
from hub.sync.pair_solver import solve_pair
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from hub.two_view.relative_pose import epipolar_lines, fundamental_from, line_distances, relative_pose_between
from protocols.core.errors import Refused
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.observations import Observations, Track, read_observations
from protocols.session.rig import Rig, RigCamera, read_rig
from tests.papers.timing_default import lag_of

SHIFT = 0.0686
"""Seconds by which the second camera's clock is set ahead: the lag of the paper's own recording by its stamps."""
SHIFTS = (0.0, SHIFT, 0.2, 0.4)
"""Shifts of the survey over all corners [s]."""
NEAR = 0.05
"""Seconds from the shift up to which the survey counts a corner as converged: the stamps jitter by as much."""
SHOWN = (0, 4, 9)
"""Iterations n whose f_i the paper shows (figure 17)."""


@dataclass(frozen=True, slots=True, eq=False)
class RealRun:
    """The paper's method on one corner and two cameras.

    a, b: (n, 2) undistorted pixels by frame number, NaN where the corner was not seen. period: [s] a frame.
    stamps: mean difference of the shifted stamps, b less a, of frames of one number [s].
    result: None where refused, with the reason.
    """

    cameras: tuple[str, str]
    label: str
    shift: float
    period: float
    stamps: float
    a: Floats
    b: Floats
    result: AlternatingLagResult | None
    refused: str = ""

    @property
    def found(self) -> float:
        """The shift that the method found [s]."""
        return float("nan") if self.result is None else self.stamps + self.period * self.result.lag

    @property
    def lag_by_stamps(self) -> float:
        """f that the shift and the stamps ask for [frames]."""
        return (self.shift - self.stamps) / self.period

    def iteration(self, n: int) -> tuple[int, Iteration] | None:
        """The iteration that holds the f_i seen through F⁽ⁿ⁾, or the last one where it ended before."""
        if self.result is None:
            return None
        index = min(n + 1, len(self.result.iterations) - 1)
        return index - 1, self.result.iterations[index]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The webcams' session with its calibration."""

    rig: Rig
    observations: Observations

    def camera(self, name: str) -> RigCamera:
        """A camera of the calibration."""
        return self.rig.cameras[name]


def read_recording(data: Path) -> Recording | None:
    """The session under the data folder; None where it is absent."""
    folder = data / "webcams" / "session"
    if not (folder / "observations.csv").is_file():
        return None
    rig = read_rig(folder / "truth_calibration.toml")
    return Recording(rig, read_observations(folder / "observations.csv", list(rig.cameras)))


def most_common(recording: Recording) -> tuple[str, str, str]:
    """The two cameras and the label that share most frames by their stamps; the first of equals."""
    best: tuple[int, tuple[str, str, str]] = (-1, ("", "", ""))
    for one, two in itertools.combinations(recording.observations.cameras, 2):
        tracks = recording.observations.by_label(one), recording.observations.by_label(two)
        for label in sorted(set(tracks[0]) & set(tracks[1]), key=lambda name: (len(name), name)):
            apart = np.abs(tracks[0][label].time[:, None] - tracks[1][label].time[None, :]).min(axis=1)
            together = int((apart < 0.5 / recording.camera(one).fps).sum())
            if together > best[0]:
                best = together, (one, two, label)
    return best[1]


def run(recording: Recording, cameras: tuple[str, str], label: str, shift: float) -> RealRun:
    """The paper's method on one label of two cameras, the second camera's clock set ahead by ``shift`` [s]."""
    tracks = [recording.observations.by_label(name)[label] for name in cameras]
    stamps = [tracks[0].time, tracks[1].time + shift]
    begin = max(float(time[0]) for time in stamps)
    numbered = []
    for name, track, time in zip(cameras, tracks, stamps, strict=True):
        rows = np.flatnonzero(time >= begin - 1e-9)
        frame = track.frame[rows] - track.frame[rows[0]]
        numbered.append((frame, time[rows], _undistorted(recording.camera(name), track)[rows]))
    length = max(int(frame[-1]) for frame, _, _ in numbered) + 1
    points, clocks = [], []
    for frame, time, pixels in numbered:
        points.append(np.full((length, 2), np.nan))
        clocks.append(np.full(length, np.nan))
        points[-1][frame], clocks[-1][frame] = pixels, time
    period = float(np.mean([np.polyfit(frame.astype(np.float64), time, 1)[0] for frame, time, _ in numbered]))
    difference = float(np.nanmean(clocks[1] - clocks[0]))
    try:
        result, refused = estimate_alternately(points[0], points[1]), ""
    except Refused as refusal:
        result, refused = None, str(refusal)
    return RealRun(cameras, label, shift, period, difference, points[0], points[1], result, refused)


def delay(recording: Recording, cameras: tuple[str, str]) -> float:
    """What camera 2's stamps are late against camera 1's, by the calibrated poses, over all labels [s].

    Median of the f_i (eq. 14) from lag 0 through the F of the calibration, to the nearest frame and a half.
    """
    one, two = (recording.camera(name) for name in cameras)
    if one.intrinsics is None or two.intrinsics is None:
        return float("nan")
    pose = relative_pose_between(_pose(one), _pose(two))
    fundamental = fundamental_from(pose, one.intrinsics.matrix, two.intrinsics.matrix)
    labels = recording.observations.by_label(cameras[0]).keys() & recording.observations.by_label(cameras[1]).keys()
    found: list[float] = []
    for label in sorted(labels):
        filmed = run(recording, cameras, label, 0.0)
        lags = point_lags(fundamental, filmed.a, filmed.b, 0.0)
        found += list(filmed.stamps + filmed.period * lags[np.abs(lags) < 1.5])
    return float(np.median(found))


def survey(recording: Recording, cameras: tuple[str, str]) -> dict[float, list[RealRun]]:
    """Every label that both cameras saw, at every shift of ``SHIFTS``."""
    one, two = (recording.observations.by_label(name) for name in cameras)
    labels = sorted(set(one) & set(two), key=lambda name: (len(name), name))
    return {shift: [run(recording, cameras, label, shift) for label in labels] for shift in SHIFTS}


def default_shift(recording: Recording, cameras: tuple[str, str], shift: float) -> tuple[float, str]:
    """The shift [s] that the default method finds from all labels, and its status."""
    smooth: list[dict[str, SmoothTrack]] = []
    for name, ahead in zip(cameras, (0.0, shift), strict=True):
        camera, out = recording.camera(name), {}
        tracks = recording.observations.by_label(name)
        begin = min(float(track.time[0]) for track in tracks.values()) + ahead
        for label, track in tracks.items():
            if camera.intrinsics is not None:
                rays = camera.intrinsics.unproject(track.pixels)
                fit = smooth_track(track.time + ahead, rays, float(camera.intrinsics.matrix[0, 0]), begin)
                if fit is not None:
                    out[label] = fit
        smooth.append(out)
    solution = solve_pair(smooth[0], smooth[1], cameras)
    origins = [next(iter(tracks.values())).time_origin for tracks in smooth]
    return origins[1] - origins[0] - lag_of(solution), solution.status


def misfit(filmed: RealRun, iteration: Iteration) -> Floats:
    """Distances (n,) of b's points from their lines at an iteration [px]."""
    first, second, _ = corresponding_points(filmed.a, filmed.b, iteration.lag)
    return np.abs(line_distances(epipolar_lines(iteration.fundamental, first), second))


def _undistorted(camera: RigCamera, track: Track) -> Floats:
    lens = camera.intrinsics
    if lens is None:
        return track.pixels
    return np.asarray(lens.unproject(track.pixels) @ lens.matrix[:2, :2].T + lens.matrix[:2, 2])


def _pose(camera: RigCamera) -> Pose:
    if camera.rotation is None or camera.position is None:
        raise ValueError(f"{camera.name} has no pose in truth_calibration.toml")
    return Pose(camera.rotation, camera.position)
