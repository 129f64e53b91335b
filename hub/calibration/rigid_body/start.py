"""Initial values of the adjustment: lenses from the views, cameras from pairs, the bodies' motion from both."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from hub.bundle.problem import CameraState
from hub.calibration.rigid_body.lag import BodyPair, aligned, quaternions, solve_body_pair
from hub.calibration.rigid_body.problem import BodyMotion, fit_motion, frame_interval
from hub.calibration.rigid_body.views import CameraViews, ViewPoses, turned, view_poses
from hub.trajectory.discrete import PointBasis, merged_instants
from hub.trajectory.splines import SplineBasis, split_at_gaps
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_LENS_VIEWS, _LENS_POINTS = 30, 4  # most views, least points of one
_MIN_KNOT, _MAX_GAP = 0.05, 3.2  # s; knot intervals without any view, over which no path is defined
_FIELDS_OF_VIEW = (90.0, 65.0, 40.0, 25.0)  # degrees: starts of a lens


@dataclass(frozen=True, slots=True, eq=False)
class BodyStart:
    """Cameras of the largest connected group, and the bodies' motion in the first one's axes."""

    cameras: dict[str, CameraState]
    bodies: tuple[BodyMotion, ...]


def initial_lens(views: CameraViews, size: tuple[int, int]) -> tuple[Intrinsics, float] | None:
    """A pinhole lens from some views of a planar body, and its rms [px]; None where too few show enough points.

    The focal length is the best of some starts; distortion k1 only: the adjustment estimates the rest.
    """
    counts = views.counts()
    rich = np.flatnonzero(counts >= _LENS_POINTS)
    if len(rich) < 2:
        return None
    chosen = set(rich[np.unique(np.linspace(0, len(rich) - 1, _LENS_VIEWS).round().astype(int))].tolist())
    points, pixels = [], []
    for number in sorted(chosen):
        rows = views.view == number
        flat = views.points[rows] - [0.0, 0.0, views.points[rows][0, 2]]
        if np.linalg.matrix_rank(flat[:, :2] - flat[0, :2], tol=1e-6) < 2 or np.ptp(flat[:, 2]) > 0.0:
            continue
        points.append(flat.astype(np.float32))
        pixels.append(views.pixels[rows].astype(np.float32))
    if len(points) < 2:
        return None
    best: tuple[Intrinsics, float] | None = None
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS
        | cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K2
        | cv2.CALIB_FIX_K3
    )
    for degrees in _FIELDS_OF_VIEW:
        focal = 0.5 * max(size) / np.tan(0.5 * np.deg2rad(degrees))
        start = np.array([[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
        try:
            rms, matrix, distortions, _, _ = cv2.calibrateCamera(points, pixels, size, start, np.zeros(5), flags=flags)
        except cv2.error:
            continue
        lens = Intrinsics(size[0], size[1], np.array(matrix, dtype=np.float64), np.ravel(distortions)[:5].astype(float))
        plausible = 0.2 * max(size) < lens.focal < 20.0 * max(size) and abs(lens.distortions[0]) < 2.0
        if plausible and np.isfinite(rms) and (best is None or rms < best[1]):
            best = lens, float(rms)
    return best


def solve_body_pairs(poses: Mapping[str, ViewPoses], shared_clock: bool) -> dict[tuple[str, str], BodyPair]:
    """All pairs of cameras."""
    lags = np.zeros(1) if shared_clock else None
    return {(a, b): solve_body_pair(poses[a], poses[b], lags) for a, b in itertools.combinations(poses, 2)}


def orient_views(
    views: Mapping[str, CameraViews],
    poses: Mapping[str, ViewPoses],
    lenses: Mapping[str, Intrinsics],
    shared_clock: bool,
) -> dict[str, CameraViews]:
    """The views of a board that looks the same turned by 180°, with corners numbered as the first camera's are.

    Each camera's views are turned, all or none, as they agree better with those of the cameras before.
    """
    lags = np.zeros(1) if shared_clock else None
    out: dict[str, CameraViews] = {}
    seen: dict[str, ViewPoses] = {}
    for name, one in views.items():
        other = turned(one)
        both = [(one, poses[name]), (other, view_poses(other, lenses[name]))]
        agreements = [sum(solve_body_pair(seen[before], pose, lags).agreement for before in seen) for _, pose in both]
        out[name], seen[name] = both[int(agreements[1] > agreements[0])]
    return out


def largest_group(names: list[str], pairs: Mapping[tuple[str, str], BodyPair]) -> dict[str, tuple[float, Pose]]:
    """Time offset [s] and pose of each camera of the largest group that solved pairs connect.

    Pairs with the most views that agree are taken first (a maximum spanning tree). A camera's time plus its offset is
    the first one's; poses are camera from the first camera's axes.
    """
    solved = sorted((pair for pair in pairs if not pairs[pair].reason), key=lambda pair: -pairs[pair].agreement)
    group: dict[str, dict[str, tuple[float, Floats, Floats]]] = {
        name: {name: (0.0, np.eye(3), np.zeros(3))} for name in names
    }
    for a, b in solved:
        if group[a] is group[b]:
            continue
        pair = pairs[a, b]
        offset_a, turn_a, place_a = group[a][a]
        offset_b, turn_b, place_b = group[b][b]
        # x_b = R x_a + t joins both groups' roots: root_b from root_a.
        turn = turn_b.T @ pair.rotation @ turn_a
        place = turn_b.T @ (pair.rotation @ place_a + pair.translation - place_b)
        shift = offset_a - pair.lag - offset_b
        joined = group[a]
        for name, (offset, rotation, translation) in list(group[b].items()):
            joined[name] = offset + shift, rotation @ turn, rotation @ place + translation
            group[name] = joined
    largest = max(group.values(), key=len)
    root = next(name for name in names if name in largest)
    offset0, turn0, place0 = largest[root]
    out = {}
    for name in names:
        if name in largest:
            offset, turn, place = largest[name]
            rotation = turn @ turn0.T
            translation = place - rotation @ place0
            out[name] = offset - offset0, Pose(rotation, -rotation.T @ translation)
    return out


def start_bodies(
    group: Mapping[str, tuple[float, Pose]],
    views: Mapping[str, CameraViews],
    lenses: Mapping[str, Intrinsics],
    poses: Mapping[str, ViewPoses],
    bodies: int,
    shared_clock: bool,
    readouts: Mapping[str, float],
) -> BodyStart:
    """The cameras' states, and each body's motion fitted to its poses in all views."""
    cameras = {}
    for name, (offset, pose) in group.items():
        time = views[name].time
        centre = 0.5 * float(time.min() + time.max())
        cameras[name] = CameraState(lenses[name], pose, 1.0, centre + offset, centre, readouts.get(name, 0.0))
    motions = tuple(
        motion
        for body in range(bodies)
        if (motion := _body_motion(cameras, views, poses, body, shared_clock)) is not None
    )
    return BodyStart(cameras, motions)


def _body_motion(
    cameras: Mapping[str, CameraState],
    views: Mapping[str, CameraViews],
    poses: Mapping[str, ViewPoses],
    body: int,
    shared_clock: bool,
) -> BodyMotion | None:
    parts = []
    for name, camera in cameras.items():
        mine = poses[name].body == body
        if mine.any():
            world = camera.pose.rotation.T
            turn = world @ poses[name].rotation[mine]
            place = poses[name].translation[mine] @ camera.pose.rotation + camera.pose.position
            parts.append((camera.reference_time(poses[name].time[mine]), turn, place))
    if not parts:
        return None
    time, turn, place = (np.concatenate([part[i] for part in parts]) for i in range(3))
    order = np.argsort(time, kind="stable")
    time, turn, place = time[order], turn[order], place[order]
    basis: SplineBasis | PointBasis
    if shared_clock:
        basis = PointBasis(merged_instants([time]))
    else:
        spacing = max(min(frame_interval(views[name]) for name in cameras), _MIN_KNOT)
        begins, ends = split_at_gaps(time, max(_MAX_GAP * spacing, 0.5))
        basis = SplineBasis.covering(begins - 0.5 * spacing, ends + 0.5 * spacing, spacing)
    chosen = np.zeros(len(time), dtype=np.int64)
    motion: BodyMotion | None = None
    for _ in range(3):
        rows = np.arange(len(time))
        unit = aligned(quaternions(turn[rows, chosen]), rows)
        motion = fit_motion(basis, time, unit, place[rows, chosen])
        smooth = motion.at(time)[0]
        angles = np.array([[so3.angle_between(smooth[i], turn[i, k]) for k in (0, 1)] for i in rows], dtype=np.float64)
        better = np.where(np.isfinite(angles).all(axis=1), angles.argmin(axis=1), 0)
        if (better == chosen).all():
            break
        chosen = better
    return motion
