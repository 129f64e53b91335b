"""Whether a calibration's lengths are in the units that it states: people are about 1.7 m tall in all of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.target_models import PERSON
from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.geometry.types import Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import METRES_PER_UNIT

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration

_FEET, _INCHES = 1.0 / 0.3048, 1.0 / 0.0254  # per metre, by definition
_FACTORS = (1.0, 1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3, _FEET, 1.0 / _FEET, _INCHES, 1.0 / _INCHES)
_FRAMES = 60
"""Frames that are looked at, spread over the session: some hundred people."""
_WITHIN = 0.35
"""Distance, as a share of a person's height, within which the feet that two cameras see are one person's: 0.6 m, which
somebody walks between two frames 0.4 s apart."""
_SAME_TIME_NS = 250_000_000  # a camera at 2 Hz has a frame as near as this to every chosen moment
_MIN_SHARE, _CLEARLY = 0.2, 4.0
"""Least share of people whom two cameras see at one place, and how many times the share in the stated units it must be.
In the crowd of seven cameras the share is 0.42 in metres, and at most 0.11, by chance, in any other of these units."""


def check_units(messages: Sequence[pb.Observation], known: GivenCalibration, kind: str) -> None:
    """Refuse a calibration in which people meet only in other units: 10, 100 or 1000 times the stated, feet, inches.

    Every camera alone gives a person's place in multiples of the person's height. In the right units the places that
    several cameras give coincide. Raises InputError. Without a vertical, or for an arbitrary scale, nothing is checked.
    """
    if kind != "person" or known.up is None or known.calibration.scale != "metric":
        return
    bodies = _bodies(messages, known, known.up)
    height = PERSON.size_m / METRES_PER_UNIT[known.calibration.units]
    shares = [_meeting_share(bodies, factor * height) for factor in _FACTORS]
    best = int(np.argmax(shares))
    if shares[best] < max(_MIN_SHARE, _CLEARLY * shares[0]):
        return
    factor = _FACTORS[best]
    wrong = f"{factor:.4g} times too large" if factor > 1.0 else f"{1.0 / factor:.4g} times too small"
    units = known.calibration.units
    raise InputError(
        f"the cameras' positions are about {wrong} for people of {PERSON.size_m:g} m: they are not in {units}",
        file=known.file,
        line=_line_of_units(known),
        remedy="correct units in [metadata], or the translations, or up",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Bodies:
    """n people, each seen by one camera. time: (n,) reference [ns]. owner: (n,) index of the camera. centre: (n, 3) of
    that camera. foot: (n, 3) from there to the foot, in people's heights."""

    time: Ints
    owner: Ints
    centre: Floats
    foot: Floats


def _bodies(messages: Sequence[pb.Observation], known: GivenCalibration, up: Floats) -> _Bodies:
    """The people with head and foot in some frames, spread over the session."""
    cameras = list(known.calibration.cameras.values())
    tracked = {camera.name: TrackingCamera.from_calibration(camera) for camera in cameras}
    stamps = np.array([tracked[message.camera].reference_ns(message.device_time_ns) for message in messages])
    moments = np.unique(stamps)
    chosen = moments[np.linspace(0, len(moments) - 1, min(_FRAMES, len(moments))).astype(int)]
    wanted = np.abs(stamps[:, None] - chosen).min(axis=1) <= _SAME_TIME_NS
    parts: list[_Bodies] = []
    for index, camera in enumerate(cameras):
        found = [
            (int(stamps[at]), (*d.head, *d.foot))
            for at in np.flatnonzero(wanted).tolist()
            if messages[at].camera == camera.name
            for d in messages[at].detections
            if len(d.head) == 2 and len(d.foot) == 2
        ]
        if not found:
            continue
        pixels = np.array([ends for _, ends in found])
        one = np.ones((len(found), 1))
        head, foot = (
            np.hstack([camera.intrinsics.unproject(part), one]) @ camera.pose.rotation
            for part in (pixels[:, :2], pixels[:, 2:])
        )
        distance = _distance_per_height(head, foot, up)
        good = np.isfinite(distance) & (distance > 0.0)
        time = np.array([stamp for stamp, _ in found])[good]
        centre = np.tile(camera.pose.position, (len(time), 1))
        parts.append(_Bodies(time, np.full(len(time), index), centre, (distance[:, None] * foot)[good]))
    empty = _Bodies(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))
    every = parts or [empty]
    return _Bodies(
        *(np.concatenate([getattr(one, key) for one in every]) for key in ("time", "owner", "centre", "foot"))
    )


def _meeting_share(bodies: _Bodies, height: float) -> float:
    """Share of people at whose place another camera sees somebody, if people are of this height."""
    if len(np.unique(bodies.owner)) < 2:
        return 0.0
    # Frames of other times are put far away.
    apart = (bodies.time - bodies.time.min())[:, None] / _SAME_TIME_NS * _WITHIN * height
    place = np.hstack([bodies.centre + height * bodies.foot, apart])
    pairs = cKDTree(place).query_pairs(_WITHIN * height, output_type="ndarray")
    met = np.zeros(len(place), dtype=np.bool_)
    met[pairs[bodies.owner[pairs[:, 0]] != bodies.owner[pairs[:, 1]]].ravel()] = True
    return float(met.mean())


def _distance_per_height(head: Floats, foot: Floats, up: Floats) -> Floats:
    """Distances (n,) along rays (n, 3) to the feet at which upright bodies of height 1 fit the rays to their heads."""
    # s·foot + up = t·head: without the part along ``head``, least squares for s.
    head = head / np.linalg.norm(head, axis=1, keepdims=True)
    across = foot - (foot * head).sum(axis=1, keepdims=True) * head
    wanted = up - (head @ up)[:, None] * head
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-(across * wanted).sum(axis=1) / (across**2).sum(axis=1))


def _line_of_units(known: GivenCalibration) -> int:
    lines = read_text(known.file).splitlines()
    patterns = (r"\s*units\s*=", r"\s*\[metadata\]", r"\s*translation\s*=")
    return next((n for p in patterns for n, line in enumerate(lines, 1) if re.match(p, line)), 1)
