"""Feet of people on level ground, as one camera sees them at the times of another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.target_models import PERSON
from protocols.core.errors import Refused
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.rig import METRES_PER_UNIT

FRAMES = 60
"""Frames that are looked at, spread over the session: some hundred people."""
WITHIN = 0.35
"""Distance, as a share of a person's height, within which the feet that two cameras see are one person's: 0.6 m, which
somebody walks between two frames 0.4 s apart."""
SAME_TIME_NS = 250_000_000  # a camera at 2 Hz has a frame as near as this to every chosen moment
_MOST_AT_ONCE = 20  # or three times as many as usual: frames with more false boxes than people would fill gigabytes
MIN_LOOKED_AT = 30  # of what one camera sees where another one looks: a share of fewer says nothing
BREADTH = 0.25  # of a body over its height, which adds to the length of a box seen from above
GROUND_STEPS, GROUND_STEP = 4, 0.1
"""Heights of the ground that are tried on either side of where it is for people of 1.7 m, and their distance in
people's heights. Of the crowd it is 0.1, by which places at 20 m are 1 m off: there all 21 pairs of cameras see the
same people, elsewhere one to five."""


def seen_feet(camera: CameraCalibration, messages: Sequence[pb.Observation]) -> tuple[Floats, Floats]:
    """Reference times (n,) [s] of a camera's frames with people, and unit vectors to their feet (n, k, 3) in its axes;
    NaN where a frame has fewer."""
    tracked = TrackingCamera.from_calibration(camera)
    frames = sorted(
        (tracked.reference_ns(one.device_time_ns) * 1e-9, feet)
        for one in messages
        if one.camera == camera.name and (feet := [(*d.foot,) for d in one.detections if d.head and d.foot])
    )
    most = max(_MOST_AT_ONCE, 3 * float(np.median([len(feet) for _, feet in frames] or [0])))
    frames = [(time, feet) for time, feet in frames if len(feet) <= most]
    counts = np.array([len(feet) for _, feet in frames], dtype=np.int64)
    rays = np.full((len(frames), max(counts, default=0), 3), np.nan)
    if frames:
        found = camera.intrinsics.unproject(np.concatenate([feet for _, feet in frames]))
        found = np.hstack([found, np.ones((len(found), 1))])
        rays[np.arange(rays.shape[1]) < counts[:, None]] = found / np.linalg.norm(found, axis=1, keepdims=True)
    return np.array([time for time, _ in frames]), rays


def on_ground(pose: Pose, rays: Floats, up: Floats, ground: float) -> Floats:
    """Where rays (…, 3) in a camera's axes meet level ground that lies so far along ``up``; NaN for those that never
    do."""
    directions = rays @ pose.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (ground - pose.position @ up) / (directions @ up)
    away = np.where(away > 0.0, away, np.nan)
    return np.asarray(pose.position + away[..., None] * directions)


def at_same_time(wanted: Floats, others: Floats) -> tuple[Ints, Bools]:
    """The frames (n,) nearest to wanted times (n,) [s] among others, ascending, and whether they are near enough."""
    after = np.clip(np.searchsorted(others, wanted), 1, len(others) - 1)
    nearest = after - (wanted - others[after - 1] < others[after] - wanted)
    return nearest, np.asarray(np.abs(others[nearest] - wanted) * 1e9 <= SAME_TIME_NS)


def vertical(head: Floats, foot: Floats) -> Floats:
    """Unit vector (3,) along which people are upright, from directions in the world to their heads and feet (n, 3)."""
    normal = np.nan_to_num(np.cross(head, foot))
    up = np.linalg.eigh(normal.T @ normal)[1][:, 0]
    return np.asarray(up * np.sign(np.nan_to_num(head - foot).sum(axis=0) @ up))


def distance_per_height(head: Floats, foot: Floats, up: Floats) -> Floats:
    """Distances (n,) along rays (n, 3) to the feet at which upright bodies of height 1 fit the rays to their heads."""
    # s·foot + up = t·head: without the part along ``head``, least squares for s.
    head = head / np.linalg.norm(head, axis=1, keepdims=True)
    across = foot - (foot * head).sum(axis=1, keepdims=True) * head
    wanted = up - (head @ up)[:, None] * head
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-(across * wanted).sum(axis=1) / (across**2).sum(axis=1))


def steepness(foot: Floats, up: Floats) -> Floats:
    """Tangents (n,) of the angles below the horizontal at which feet are seen, by directions to them (n, 3)."""
    below = -(foot @ up)
    return np.asarray(below / np.sqrt(np.maximum((foot**2).sum(axis=1) - below**2, 1e-9)))


def level_ground(
    messages: Sequence[pb.Observation], known: Calibration, up: Floats | None
) -> tuple[Floats, tuple[float, float]]:
    """The vertical (3,), as given or of these people, and how far along it the ground is if all have `PERSON`'s size
    [units of the calibration]: with the breadth of bodies, which lengthens boxes seen from above, and without it.
    Raises Refused.
    """
    bodies = []
    for name, camera in known.cameras.items():
        mine = [d for one in messages if one.camera == name for d in one.detections if d.head and d.foot]
        pixels = camera.intrinsics.unproject(np.array([(*d.head, *d.foot) for d in mine]).reshape(-1, 2))
        rays = np.hstack([pixels, np.ones((len(pixels), 1))]) @ camera.pose.rotation
        bodies.append(np.hstack([np.tile(camera.pose.position, (len(mine), 1)), rays.reshape(-1, 6)]))
    centre, head, foot = np.split(np.concatenate(bodies), 3, axis=1)
    up = vertical(head, foot) if up is None else up
    distance = PERSON.size_m / METRES_PER_UNIT[known.units] * distance_per_height(head, foot, up)
    broad = distance * (1.0 + BREADTH * np.abs(steepness(foot, up)))
    if not (distance > 0.0).any():
        raise Refused("nobody stands upright on ground that a camera sees, with head and foot")
    grounds = [((centre + far[:, None] * foot) @ up)[distance > 0.0] for far in (broad, distance)]
    return up, (float(np.median(grounds[0])), float(np.median(grounds[1])))
