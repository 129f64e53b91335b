"""Targets as messages: tracks, and what every camera should see of them."""

from __future__ import annotations

import numpy as np

from hub.tracking.camera_frame import TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY
from hub.tracking.filter.measurement import POINT, expect
from hub.tracking.filter.target_models import BODIES
from hub.tracking.filter.target_states import Gone, Targets
from hub.tracking.filter.update import World, label_of
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb

SCHEMA_VERSION = 1
_COASTS_S = 0.35
_LATELY_NS = 500_000_000
_WALKS_M_S = 0.25
"""Slower ones have no heading."""
_HEAD_HEIGHT, _HEAD_WIDTH = 0.16, 0.13
"""Of head and face, in shares of the height."""
_FARTHEST_PX = 1e5


def track_messages(
    targets: Targets, time_ns: int, gone: tuple[Gone, ...], world: World, sequence: int
) -> list[pb.Track]:
    """Confirmed and coasting targets at a reference time, then those that were lost (``gone``)."""
    out: list[pb.Track] = []
    angles = headings(targets.mean, world)
    for i in np.flatnonzero(targets.confirmed).tolist():
        mean, covariance, body = targets.mean[i], targets.covariance[i], BODIES[int(targets.kind[i])]
        unseen = max(time_ns - int(targets.seen_ns[i]), 0) / NANOSECONDS
        message = pb.Track(
            schema_version=SCHEMA_VERSION,
            sequence=sequence + len(out),
            label=label_of(int(targets.kind[i]), int(targets.number[i])),
            state="coasting" if unseen > _COASTS_S else "confirmed",
            reference_time_ns=time_ns,
            position=mean[POSITION].tolist(),
            velocity=mean[VELOCITY].tolist(),
            position_covariance=covariance[POSITION, POSITION].ravel().tolist(),
            velocity_covariance=covariance[VELOCITY, VELOCITY].ravel().tolist(),
            kind=body.kind,
            cameras=int((targets.seen_by[i] > time_ns - _LATELY_NS).sum()),
            unseen_s=unseen,
        )
        if np.isfinite(angles[i]):
            message.heading = float(angles[i])
        if body.upright:
            size = float(np.exp(mean[LOG_SIZE]))
            message.height = size
            message.height_std = size * float(np.sqrt(covariance[LOG_SIZE, LOG_SIZE]))
        _paint(message, targets.colour[i])
        out.append(message)
    for one in gone:
        out.append(
            pb.Track(
                schema_version=SCHEMA_VERSION,
                sequence=sequence + len(out),
                label=label_of(one.kind, one.number),
                state="lost",
                reference_time_ns=time_ns,
                position=one.mean[POSITION].tolist(),
                kind=BODIES[one.kind].kind,
                unseen_s=max(time_ns - one.seen_ns, 0) / NANOSECONDS,
            )
        )
    return out


def prediction_message(
    targets: Targets,
    time_ns: int,
    cameras: dict[str, TrackingCamera],
    boots: dict[str, str],
    world: World,
    sequence: int,
) -> pb.Prediction:
    """What every camera should see of the confirmed targets at a reference time."""
    message = pb.Prediction(schema_version=SCHEMA_VERSION, sequence=sequence, reference_time_ns=time_ns)
    known = targets.kept(targets.confirmed)
    ahead = _ahead(known.mean, world)
    for name, camera in cameras.items():
        part = message.cameras.add(camera=name, boot_id=boots.get(name, ""), device_time_ns=camera.device_ns(time_ns))
        if len(known):
            _predict(part, known, ahead, camera, world)
    return message


def _predict(part: pb.CameraPrediction, targets: Targets, ahead: Floats, camera: TrackingCamera, world: World) -> None:
    expected = expect(camera, targets.mean, targets.kind, world.up)
    seen = camera.sees(expected.value[:, POINT], expected.depth)
    if not seen.any():
        return
    point, slope = expected.value[:, POINT], expected.slope[:, POINT]
    lens = camera.intrinsics
    pixels, heads, feet = lens.project_normalised(expected.value[:, :6].reshape(-1, 2)).reshape(-1, 3, 2).swapaxes(0, 1)
    bend = lens.pixel_jacobian(point)
    spread = slope @ targets.covariance @ slope.transpose(0, 2, 1) + expected.body_noise[:, POINT, POINT]
    spread = bend @ spread @ bend.transpose(0, 2, 1) + camera.noise_px**2 * np.eye(2)
    # Per second of the reference clock; a camera's own differs by parts in ten thousand.
    speed = (bend @ slope[:, :, POSITION] @ targets.mean[:, VELOCITY, None])[:, :, 0]
    ends = np.hstack([heads, feet])
    with np.errstate(invalid="ignore"):
        whole = np.asarray((np.abs(ends) < _FARTHEST_PX).all(axis=1))
        seen &= (np.abs(pixels) <= _FARTHEST_PX).all(axis=1)
    size, face = np.linalg.norm(heads - feet, axis=1), face_regions(heads, feet)
    views = facing(targets.mean, ahead, camera, world)
    for i in np.flatnonzero(seen).tolist():
        target = part.targets.add(
            target=label_of(int(targets.kind[i]), int(targets.number[i])),
            kind=BODIES[int(targets.kind[i])].kind,
            u=pixels[i, 0],
            v=pixels[i, 1],
            u_velocity=speed[i, 0],
            v_velocity=speed[i, 1],
            covariance=[spread[i, 0, 0], 0.5 * (spread[i, 0, 1] + spread[i, 1, 0]), spread[i, 1, 1]],
        )
        _paint(target, targets.colour[i])
        if whole[i]:
            target.head.extend(heads[i].tolist())
            target.foot.extend(feet[i].tolist())
            target.size = float(size[i])
            target.face.extend(face[i].tolist())
            target.view = views[i]


def face_regions(head: Floats, foot: Floats) -> Floats:
    """Boxes (n, 4) x, y, w, h [px] of head and face of people whose heads' tops and feet are at pixels (n, 2)."""
    tall = np.linalg.norm(head - foot, axis=1, keepdims=True)
    middle = head + (foot - head) * (0.5 * _HEAD_HEIGHT)
    # Of a head that leans in the image, the upright box around it.
    lean = np.abs(head - foot) / np.maximum(tall, 1e-9)
    size = tall * (_HEAD_WIDTH * lean[:, ::-1] + _HEAD_HEIGHT * lean)
    return np.hstack([middle - 0.5 * size, size])


def facing(mean: Floats, ahead: Floats, camera: TrackingCamera, world: World) -> list[str]:
    """What a camera sees of the heads of people who look where they go: front, back, their left or right side.

    mean: (n, 7). ahead: (n, 3) as `_ahead` says; "" where it is NaN.
    """
    if world.up is None:
        return [""] * len(mean)
    to_camera = camera.pose.position - mean[:, POSITION]
    forward, left = (to_camera * ahead).sum(axis=1), (np.cross(world.up, ahead) * to_camera).sum(axis=1)
    with np.errstate(invalid="ignore"):
        side = np.where(left > 0.0, "left", "right")
        view = np.where(np.abs(forward) >= np.abs(left), np.where(forward > 0.0, "front", "back"), side)
    return [str(one) for one in np.where(np.isfinite(forward), view, "")]


def _ahead(mean: Floats, world: World) -> Floats:
    """Unit vectors (n, 3) across up along the motion; NaN where somebody stands or up is not known."""
    if world.up is None:
        return np.full((len(mean), 3), np.nan)
    along = mean[:, VELOCITY] - np.outer(mean[:, VELOCITY] @ world.up, world.up)
    speed = np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(along / np.where(speed < _WALKS_M_S * world.scale.metre, np.nan, speed))


def headings(mean: Floats, world: World) -> Floats:
    """Directions of the motion (n,) [rad] about up, from the world's first axis; NaN as in `_ahead`.

    Where the first axis is up, from the second.
    """
    if world.up is None:
        return np.full(len(mean), np.nan)
    first = np.array([0.0, 1.0, 0.0] if abs(world.up[0]) > 0.9 else [1.0, 0.0, 0.0])
    first = first - world.up * (world.up @ first)
    first /= np.linalg.norm(first)
    ahead = _ahead(mean, world)
    return np.asarray(np.arctan2(ahead @ np.cross(world.up, first), ahead @ first))


def _paint(message: pb.Track | pb.PredictedTarget, colour: Floats) -> None:
    if np.isfinite(colour).all():
        red, green, blue = (round(min(max(value, 0.0), 255.0)) for value in colour.tolist())
        message.colour.red, message.colour.green, message.colour.blue = red, green, blue
