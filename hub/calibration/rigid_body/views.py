"""Views of a rigid body: the points that a camera saw of it at one time, and the body's pose in the camera's axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.observations import Observations, Track

_MIN_POINTS = 4  # four coplanar points determine a pose
_FLAT = 1e-6  # relative: singular value of a planar body's points
_MAX_RMS_PX = 5.0  # of a view's pose: more is a wrong detection
_AMBIGUOUS = 3.0  # ratio of the rms of the two poses of a plane below which both are kept
_MAX_ROWS = 60_000  # of all cameras: of more, whole views are left out


@dataclass(frozen=True, slots=True, eq=False)
class CameraViews:
    """All views of one camera: V views, n rows.

    time: (V,) [s] since ``time_origin`` on the camera's clock, increasing within a body. body: (V,) index. view: (n,)
    view of each row. points: (n, 3) on the body. pixels: (n, 2). label: (n,) index into the session's labels.
    """

    name: str
    time_origin: float
    time: Floats
    body: Ints
    view: Ints
    points: Floats
    pixels: Floats
    label: Ints

    def take(self, views: Bools) -> CameraViews:
        """Only some views (V,)."""
        new = np.cumsum(views) - 1
        rows = views[self.view]
        return CameraViews(
            self.name,
            self.time_origin,
            self.time[views],
            self.body[views],
            new[self.view[rows]],
            self.points[rows],
            self.pixels[rows],
            self.label[rows],
        )

    def counts(self) -> Ints:
        """(V,) rows of each view."""
        return np.bincount(self.view, minlength=len(self.time))


@dataclass(frozen=True, slots=True, eq=False)
class ViewPoses:
    """Poses of the body in camera axes: ``x_camera = rotation x_body + translation``.

    time: (m,) [s]. body: (m,). rotation: (m, 2, 3, 3) and translation: (m, 2, 3) of the better pose and of the
    other one that fits a plane's image nearly as well; the same where there is none.
    """

    time: Floats
    body: Ints
    rotation: Floats
    translation: Floats


def gather_views(
    name: str, tracks: list[Track], bodies: Mapping[str, Mapping[str, Floats]], labels: list[str], origin: float
) -> CameraViews | None:
    """A camera's views of the bodies; None without rows on any. Views are sorted by body and time."""
    body_of = {label: (number, point) for number, body in enumerate(bodies.values()) for label, point in body.items()}
    used = [track for track in tracks if track.label in body_of and len(track)]
    if not used:
        return None
    time = np.concatenate([track.time for track in used]) - origin
    body = np.concatenate([np.full(len(track), body_of[track.label][0]) for track in used])
    points = np.concatenate([np.tile(body_of[track.label][1], (len(track), 1)) for track in used])
    pixels = np.concatenate([track.pixels for track in used])
    label = np.concatenate([np.full(len(track), labels.index(track.label)) for track in used])
    order = np.lexsort((label, time, body))
    time, body, points, pixels, label = time[order], body[order], points[order], pixels[order], label[order]
    new = np.r_[True, (np.diff(time) > 0) | (np.diff(body) > 0)]
    return CameraViews(name, origin, time[new], body[new], np.cumsum(new) - 1, points, pixels, label)


def thinned(views: list[CameraViews]) -> list[CameraViews]:
    """The views, fewer of them where there are very many rows."""
    every = int(np.ceil(sum(len(one.view) for one in views) / _MAX_ROWS))
    return views if every < 2 else [one.take(np.arange(len(one.time)) % every == 0) for one in views]


def body_labels(observations: Observations, bodies: Mapping[str, Mapping[str, Floats]]) -> list[str]:
    """The labels that were observed and belong to a body."""
    known = {label for body in bodies.values() for label in body}
    return [label for label in observations.labels if label in known]


def view_poses(views: CameraViews, lens: Intrinsics) -> ViewPoses:
    """The body's pose in every view that determines it; `ViewPoses` may be empty."""
    normalised = lens.unproject(views.pixels)
    order = np.argsort(views.view, kind="stable")
    ends = np.cumsum(views.counts())
    found: list[tuple[int, list[tuple[Floats, Floats]]]] = []
    for number, rows in enumerate(np.split(order, ends[:-1])):
        rows = rows[np.isfinite(normalised[rows]).all(axis=1)]
        poses = _poses(views.points[rows], normalised[rows], lens.focal)
        if poses:
            found.append((number, poses))
    index = np.array([number for number, _ in found], dtype=np.int64)
    both = [[poses[0], poses[-1]] for _, poses in found]
    return ViewPoses(
        views.time[index],
        views.body[index],
        np.array([[pose[0] for pose in pair] for pair in both]).reshape(-1, 2, 3, 3),
        np.array([[pose[1] for pose in pair] for pair in both]).reshape(-1, 2, 3),
    )


def _poses(points: Floats, normalised: Floats, focal: float) -> list[tuple[Floats, Floats]]:
    """The poses that fit the points, best first: none, one, or the two of a plane seen from afar."""
    if len(points) < _MIN_POINTS:
        return []
    centred = points - points.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[1] < 0.05 * spread[0]:
        return []  # nearly collinear
    flat = spread[2] < _FLAT * spread[0] and float(np.ptp(points[:, 2])) == 0.0
    seen = np.ascontiguousarray(normalised).reshape(-1, 1, 2)
    method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    eye = np.eye(3)
    # IPPE takes planes in z = 0: the offset returns with the translation.
    depth = points[0, 2] if flat else 0.0
    shifted = np.ascontiguousarray(points - [0.0, 0.0, depth])
    try:
        count, turns, places, _ = cv2.solvePnPGeneric(shifted, seen, eye, np.zeros(5), flags=method)
    except cv2.error:
        return []
    out = []
    for turn, place in zip(turns[:count], places[:count], strict=False):
        turn, place = cv2.solvePnPRefineLM(shifted, seen, eye, np.zeros(5), turn, place)
        rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
        at = shifted @ rotation.T + np.asarray(place, dtype=np.float64).ravel()
        if not (at[:, 2] > 0).all():
            continue
        residual = at[:, :2] / at[:, 2:] - normalised
        rms = focal * float(np.sqrt((residual**2).sum(axis=1).mean()))
        translation = np.asarray(place, dtype=np.float64).ravel() - rotation[:, 2] * depth
        out.append((rms, rotation, translation))
    out.sort(key=lambda item: item[0])
    if not out or not out[0][0] < _MAX_RMS_PX:
        return []
    limit = _AMBIGUOUS * max(out[0][0], 0.3)
    return [(rotation, translation) for rms, rotation, translation in out if rms <= limit]


def turned(views: CameraViews) -> CameraViews:
    """The views of a board of which all points were seen, with each taken for the one opposite its middle."""
    labels, first, place = np.unique(views.label, return_index=True, return_inverse=True)
    points = views.points[first]
    across = points.min(axis=0) + points.max(axis=0) - points
    opposite = np.linalg.norm(across[:, None] - points[None], axis=2).argmin(axis=1)
    return replace(views, label=labels[opposite][place], points=points[opposite][place])
