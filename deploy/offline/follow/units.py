"""Whether detections and a calibration are in the same pixels, units and axes: people are upright, about 1.7 m tall."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from deploy.offline.follow.lags import shifted_people, shifted_vehicles
from hub.calibration.people.feet import (
    BREADTH,
    FRAMES,
    MIN_LOOKED_AT,
    SAME_TIME_NS,
    WITHIN,
    distance_per_height,
    steepness,
    vertical,
)
from hub.calibration.people.turned_camera import turned_people
from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.target_models import PERSON
from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.geometry.pose import OUR_CONVENTION, POSE_CONVENTIONS
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration
from protocols.session.rig import METRES_PER_UNIT

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration
    from hub.tracking.offline import FollowedTrack

_FEET, _INCHES = 1.0 / 0.3048, 1.0 / 0.0254  # per metre, by definition
_LENGTHS = (1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3, _FEET, 1.0 / _FEET, _INCHES, 1.0 / _INCHES)
_PIXELS = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 1.5, 2.0, 3.0)
"""Ratios of the usual sizes of one film: 2160, 1440, 1080, 720, 540, 360 lines."""
_HALVES = ((0.0, 0.5), (0.25, 0.75))
"""Of a body that is in a box, from head (0) to foot (1): boxes of upper bodies, and those of half the size."""
_SMALLEST_M, _LARGEST_M = 0.1, 60.0  # a blackbird, a large aeroplane; in cm for m a car is 3 cm in size
_MIN_SHARE, _CLEARLY = 0.2, 4.0
"""Least share of people whom two cameras see at one place, and how many times the share in the stated units it must be.
In the crowd of seven cameras the share is 0.42 in metres, and at most 0.11, by chance, in any other of these units."""
_UPRIGHT = 0.7  # cosine of 45°: nobody upright leans as much
_MIN_MET = 0.1
"""Share of the people at places where another camera looks that it sees there, below which a warning is given: 0.42 in
that crowd and 0.78 in a simulated room, at most 0.06 with the pixels of pictures that were squeezed into squares."""
_SMALL, _MIN_MET_SMALL = (0.55, 0.6, 0.65, 0.7, 0.75, 0.8), 0.3
"""Heights over an adult's, and the share that meets at one of them: 0.68 and 0.36 of seated people and children of 1 m;
up to 0.1 of pictures that were squeezed across, but 0.5 of those squeezed along the bodies."""
_WIDE = 1.2  # width over height: boxes of people seated behind a table are about square
_MOST_CROSSED = 4000  # people, the first ones: at 60 frames a second they are a million pairs
_SCALE = 0.5  # log: a body's breadth shortens the distance by up to 40 %
_LENGTH_STD, _MAX_ERROR = 0.05, 1.4
"""Of a box's length, relative; and the error of a place, in people's heights, up to which they count: with cameras at
8 m it is about 1.8."""
_BREADTHS = BREADTH * np.arange(1, 4) / 3.0
"""Where few people meet, the one counts with which most do, if these are not few: 6 of 60 simulated rigs at 1 to 14 m
with right calibrations are warned of, otherwise 15."""


@dataclass(frozen=True, slots=True)
class _Mistake:
    """Detections and calibration as they may be wrong by factors: lengths of the calibration, pixels of the detections,
    and the part of a body that they show, from head (0) to foot (1); with ``up``, of another vertical, and with poses
    in another of `POSE_CONVENTIONS`."""

    lengths: float = 1.0
    pixels: float = 1.0
    body: tuple[float, float] = (0.0, 1.0)
    up: bool = False
    poses: str = ""


_MISTAKES = (
    _Mistake(),
    *(_Mistake(lengths=factor) for factor in _LENGTHS),
    *(_Mistake(pixels=factor) for factor in _PIXELS),
    *(_Mistake(body=half) for half in _HALVES),
    _Mistake(up=True),
    *(_Mistake(up=True, poses=convention) for convention in POSE_CONVENTIONS),  # `up` may be of one camera's axes
)


def check_units(
    messages: Sequence[pb.Observation], known: GivenCalibration, kind: str, session: Path
) -> tuple[str, ...]:
    """Refuse detections and a calibration in which people meet only in other units, pixels, axes, or as longer bodies.

    Units: 10, 100 or 1000 times the stated, feet, inches. Axes: another vertical, or another convention of the poses.
    Every camera alone gives a person's place in multiples of the person's height. In the right units, pixels and axes
    the places that several cameras give coincide. Returns a warning where they hardly do in any. Raises InputError. For
    an arbitrary scale nothing is checked.
    """
    if kind != "person":
        return shifted_vehicles(messages, known)
    _refuse_wide(messages, known, session)
    if known.calibration.scale != "metric":
        return ()
    height = PERSON.size_m / METRES_PER_UNIT[known.calibration.units]
    people = _people(messages, known)
    if not people:
        return ()
    bodies = [_bodies(people, known, wrong) for wrong in _MISTAKES]
    count = sum(len(rows) for rows in people.values())
    shares = [
        float(_met(one, wrong.lengths * height).sum()) / count for one, wrong in zip(bodies, _MISTAKES, strict=True)
    ]
    best, vertical = int(np.argmax(shares)), _MISTAKES.index(_Mistake(up=True))
    # Along a vertical far off, bodies are near 0 and many meet by chance.
    if bodies[0].up @ bodies[vertical].up < _UPRIGHT and shares[vertical] > max(_MIN_SHARE, shares[0]):
        best = vertical
    elif shares[best] < max(_MIN_SHARE, _CLEARLY * shares[0]) or (
        _crossed(bodies[best], _MISTAKES[best].lengths * height) <= _crossed(bodies[0], height)
    ):
        body, steep = bodies[0], np.abs(steepness(bodies[0].foot, bodies[0].up))[:, None]
        if shares[0] < _MIN_MET:
            farther = (replace(body, foot=body.foot * (1.0 + breadth * steep)) for breadth in _BREADTHS)
            likeliest = max(farther, key=lambda one: int(_met(one, height).sum()))
            body = likeliest if _met(likeliest, height).sum() >= _MIN_MET * count else body
        nowhere = _nowhere(body, [known.calibration.cameras[name] for name in people], height)
        ground = float(np.median((body.centre + height * body.foot) @ body.up))
        turned = turned_people(messages, known.calibration, body.up, (ground, ground))
        return turned or nowhere or shifted_people(messages, known, body.up, ground)
    raise _refusal(_MISTAKES[best], bodies[best].up, known, session)


def unlikely_size(
    tracks: Sequence[FollowedTrack], messages: Sequence[pb.Observation], known: GivenCalibration
) -> tuple[str, ...]:
    """A warning where followed vehicles are of a size that none has: by their boxes and distances from the cameras."""
    if known.calibration.scale != "metric":
        return ()
    boxes = {(one.camera, one.sequence): one.detections for one in messages}
    sizes = []
    for track in tracks:
        place = np.median(track.position, axis=0)  # a path is short beside the factor 10 to either limit
        for name, sequence, index in track.detections[:: 1 + len(track.detections) // FRAMES]:
            camera, box = known.calibration.cameras[name], boxes[name, sequence][index].box
            if len(box) == 4:
                distance = float(np.linalg.norm(place - camera.pose.position))
                sizes.append(np.sqrt(box[2] * box[3]) / camera.intrinsics.focal * distance)
    metres = METRES_PER_UNIT[known.calibration.units] * float(np.median(sizes)) if sizes else 1.0
    if _SMALLEST_M < metres < _LARGEST_M:
        return ()
    return (f"what is followed is about {metres:.2g} m in size: are the calibration's positions in its units?",)


def boxes_from_above(messages: Sequence[pb.Observation], known: GivenCalibration) -> str:
    """What may be wrong with boxes of cameras that look down steeply, as a clause; empty without such boxes."""
    steep = {
        name
        for name, camera in known.calibration.cameras.items()
        if known.up is not None and -(camera.pose.rotation @ known.up)[2] > _UPRIGHT
    }
    boxes = any(d.box for message in messages if message.camera in steep for d in message.detections)
    what = (
        f"boxes of cameras that look down steeply ({', '.join(sorted(steep))}) show neither heads nor feet: give these"
    )
    return f"; {what}" if boxes else ""


def _refuse_wide(messages: Sequence[pb.Observation], known: GivenCalibration, session: Path) -> None:
    """Refuse boxes that are wider than high, in cameras in whose pictures upright people stand upright."""
    standing = {
        name
        for name, camera in known.calibration.cameras.items()
        if known.up is not None and -(camera.pose.rotation @ known.up)[1] > _UPRIGHT
    }
    boxes = [d.box for message in messages if message.camera in standing for d in message.detections if d.box]
    if len(boxes) >= MIN_LOOKED_AT and np.median([box[2] / box[3] for box in boxes]) > _WIDE:
        remedy = "swap width and height, or give boxes of people who stand"
        raise InputError("most boxes are wider than high: they are of no upright people", file=session, remedy=remedy)


def _refusal(wrong: _Mistake, up: Floats, known: GivenCalibration, session: Path) -> InputError:
    if wrong.poses:
        return InputError(
            f"people meet at one place if in the calibration {wrong.poses}", file=known.file, remedy=OUR_CONVENTION
        )
    if wrong.up:
        direction = ", ".join(f"{value + 0.0:.2f}" for value in np.round(up, 2))
        return InputError(
            f"`up` is not the vertical of these people, who stand along [{direction}] in the world",
            file=known.file,
            line=_line_of(known, r"\s*up\s*=", r"\s*\[metadata\]"),
            remedy="correct up in [metadata], or leave it out",
        )
    if wrong.lengths != 1.0:
        return InputError(
            f"the cameras' positions are {_times(wrong.lengths)} for people of {PERSON.size_m:g} m: they are not in "
            f"{known.calibration.units}",
            file=known.file,
            line=_line_of(known, r"\s*units\s*=", r"\s*\[metadata\]", r"\s*translation\s*="),
            remedy="correct units in [metadata], or the translations, or up",
        )
    if wrong.pixels != 1.0:
        name, (width, height) = next(iter(known.sizes.items()))
        what = f"its pixels are {_times(wrong.pixels)} for the calibration's pictures ({name}: {width}x{height})"
        return InputError(what, file=session, remedy="scale them, or take the calibration of the pictures detected in")
    what = f"its people are {_times(wrong.body[1] - wrong.body[0])} for {PERSON.size_m:g} m from head to foot"
    return InputError(what, file=session, remedy="give boxes of whole bodies, with their full width and height")


def _times(factor: float) -> str:
    return f"about {factor:.4g} times too large" if factor > 1.0 else f"about {1.0 / factor:.4g} times too small"


@dataclass(frozen=True, slots=True, eq=False)
class _Bodies:
    """n people, each seen by one camera. time: (n,) [ns]. owner: (n,) index of the camera. centre: (n, 3) of
    that camera. foot: (n, 3) from there to the foot, in people's heights. up: (3,), along which they are upright."""

    time: Floats
    owner: Ints
    centre: Floats
    foot: Floats
    up: Floats


def _people(messages: Sequence[pb.Observation], known: GivenCalibration) -> dict[str, Floats]:
    """Of each camera the people with head and foot in some frames, spread over the session.

    Rows (n, 5): reference time [ns] less the first, head and foot [px].
    """
    tracked = {name: TrackingCamera.from_calibration(camera) for name, camera in known.calibration.cameras.items()}
    stamps = np.array([tracked[message.camera].reference_ns(message.device_time_ns) for message in messages])
    moments = np.unique(stamps)
    chosen = moments[np.linspace(0, len(moments) - 1, min(FRAMES, len(moments))).astype(int)]
    wanted = np.abs(stamps[:, None] - chosen).min(axis=1) <= SAME_TIME_NS
    found: dict[str, list[tuple[float, ...]]] = {}
    for at in np.flatnonzero(wanted).tolist():
        found.setdefault(messages[at].camera, []).extend(
            (float(stamps[at] - moments[0]), *d.head, *d.foot)
            for d in messages[at].detections
            if len(d.head) == 2 and len(d.foot) == 2
        )
    return {name: np.array(rows) for name, rows in found.items() if rows}


def _bodies(people: Mapping[str, Floats], known: GivenCalibration, wrong: _Mistake) -> _Bodies:
    """The people with the mistake undone; upright along the given vertical, otherwise along their own."""
    rays: list[tuple[Floats | Ints, ...]] = []
    for name, rows in people.items():
        camera = known.calibration.cameras[name]
        pose = POSE_CONVENTIONS[wrong.poses](camera.pose) if wrong.poses else camera.pose
        top, bottom = wrong.body
        whole = (rows[:, 3:] - rows[:, 1:3]) / (bottom - top)
        pixels = np.vstack([rows[:, 1:3] - top * whole, rows[:, 3:] + (1.0 - bottom) * whole]) / wrong.pixels
        ends = np.hstack([camera.intrinsics.unproject(pixels), np.ones((len(pixels), 1))]) @ pose.rotation
        owner, centre = np.full(len(rows), len(rays)), np.tile(pose.position, (len(rows), 1))
        rays.append((owner, centre, rows[:, 0], *np.split(ends, 2)))
    owner, centre, time, head, foot = (np.concatenate(part) for part in zip(*rays, strict=True))
    up = None if wrong.up else known.up
    if up is None:
        up = vertical(head, foot)
    distance = distance_per_height(head, foot, up)
    good = np.isfinite(distance) & (distance > 0.0)
    return _Bodies(time[good], owner[good], centre[good], (distance[:, None] * foot)[good], up)


def _met(bodies: _Bodies, height: float) -> Bools:
    """Whether another camera sees somebody at a person's place (n,), if people are of this height."""
    # Frames of other times are put far away.
    apart = bodies.time[:, None] / SAME_TIME_NS * WITHIN * height
    place = np.hstack([bodies.centre + height * bodies.foot, apart])
    met = np.zeros(len(place), dtype=np.bool_)
    pairs = cKDTree(place).query_pairs(WITHIN * height, output_type="ndarray")
    met[pairs[bodies.owner[pairs[:, 0]] != bodies.owner[pairs[:, 1]]].ravel()] = True
    return met


def _crossed(bodies: _Bodies, height: float) -> float:
    """The share of people at whose feet the ray of another camera's person passes, at the distance that both people's
    heights give within a factor: where cameras are high or far, no camera alone gives a place."""
    first = np.sort(bodies.time)[:_MOST_CROSSED]
    pairs = cKDTree(first[:, None]).query_pairs(0.5 * SAME_TIME_NS, output_type="ndarray")
    pairs = np.argsort(bodies.time, kind="stable")[pairs]
    one, other = pairs[bodies.owner[pairs[:, 0]] != bodies.owner[pairs[:, 1]]].T
    u, v, between = bodies.foot[one], bodies.foot[other], bodies.centre[one] - bodies.centre[other]
    uu, uv, vv, ub, vb = (np.einsum("ni,ni->n", *two) for two in ((u, u), (u, v), (v, v), (u, between), (v, between)))
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = np.stack([uv * vb - vv * ub, uu * vb - uv * ub]) / (uu * vv - uv**2)
        missed = np.linalg.norm(between + scales[0, :, None] * u - scales[1, :, None] * v, axis=1)
    near = (missed < WITHIN * height) & (np.abs(np.log(np.maximum(scales, 1e-9) / height)) < _SCALE).all(axis=0)
    return len(np.union1d(one[near], other[near])) / max(len(first), 1)


def _nowhere(bodies: _Bodies, cameras: Sequence[CameraCalibration], height: float) -> tuple[str, ...]:
    """A warning where other cameras see hardly any of the people at whose place they look."""
    looked_at = np.zeros(len(bodies.time), dtype=np.bool_)
    place = bodies.centre + height * bodies.foot
    distance = np.linalg.norm(bodies.foot, axis=1)
    known = distance * (_LENGTH_STD + BREADTH * np.abs(steepness(bodies.foot, bodies.up))) < _MAX_ERROR
    for index, camera in enumerate(cameras):
        mine = bodies.owner == index
        off, _ = cKDTree(np.unique(bodies.time[mine])[:, None]).query(bodies.time[:, None], p=1)
        pixel = camera.intrinsics.project(camera.pose.camera_from_world(place))
        inside = ((pixel > 0.0) & (pixel < [camera.intrinsics.width, camera.intrinsics.height])).all(axis=1)
        looked_at |= inside & (off <= SAME_TIME_NS) & ~mine
    everybody = int((looked_at & (distance * _LENGTH_STD < _MAX_ERROR)).sum())
    looked_at &= known
    count, met = int(looked_at.sum()), int((_met(bodies, height) & looked_at).sum())
    # Where hardly anybody can be placed for the steep view, as below cameras at 12 m, the few are false boxes.
    if count < max(MIN_LOOKED_AT, _MIN_SHARE * everybody) or met >= _MIN_MET * count:
        return ()
    small = {share: int((_met(bodies, share * height) & looked_at).sum()) for share in _SMALL}
    share = max(small, key=lambda one: small[one])
    if small[share] >= _MIN_MET_SMALL * count:
        tall = share * PERSON.size_m
        return (
            f"the people seem to be about {tall:.1f} m tall: of children, or people seated or partly hidden, that is "
            "right; otherwise check the calibration's picture sizes and units",
        )
    return (
        f"of {count} people whom one camera sees where others look, others see {met} there: are the calibration's "
        "picture sizes, poses, time offsets and units those of these detections?",
    )


def _line_of(known: GivenCalibration, *patterns: str) -> int:
    lines = read_text(known.file).splitlines()
    return next((n for p in patterns for n, line in enumerate(lines, 1) if re.match(p, line)), 1)
