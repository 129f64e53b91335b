"""Targets as messages: tracks, and what every camera should see of them."""

from __future__ import annotations

import numpy as np

from hub.tracking.body import BODIES
from hub.tracking.camera import TrackingCamera
from hub.tracking.kalman import LOG_SIZE, POSITION, VELOCITY
from hub.tracking.measure import FOOT, HEAD, POINT, expect
from hub.tracking.step import World, label_of
from hub.tracking.targets import Gone, Targets
from protocols.clocks import NANOSECONDS
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
        angle = heading(mean, world)
        if angle is not None:
            message.heading = angle
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
    for name, camera in cameras.items():
        part = message.cameras.add(camera=name, boot_id=boots.get(name, ""), device_time_ns=camera.device_ns(time_ns))
        if len(known):
            _predict(part, known, camera, world)
    return message


def _predict(part: pb.CameraPrediction, targets: Targets, camera: TrackingCamera, world: World) -> None:
    expected = expect(camera, targets.mean, targets.kind, world.up)
    point = expected.value[:, POINT]
    seen = camera.sees(point, expected.depth)
    if not seen.any():
        return
    lens = camera.intrinsics
    pixels, bend = lens.project_normalised(point), lens.pixel_jacobian(point)
    slope = expected.slope[:, POINT]
    spread = slope @ targets.covariance @ slope.transpose(0, 2, 1) + expected.body_noise[:, POINT, POINT]
    spread = bend @ spread @ bend.transpose(0, 2, 1) + camera.noise_px**2 * np.eye(2)
    # Per second of the reference clock; a camera's own differs by parts in ten thousand.
    speed = (bend @ slope[:, :, POSITION] @ targets.mean[:, VELOCITY, None])[:, :, 0]
    heads, feet = lens.project_normalised(expected.value[:, HEAD]), lens.project_normalised(expected.value[:, FOOT])
    for i in np.flatnonzero(seen & np.isfinite(pixels).all(axis=1)).tolist():
        if np.abs(pixels[i]).max() > _FARTHEST_PX:
            continue
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
        ends = np.concatenate([heads[i], feet[i]])
        if np.isfinite(ends).all() and np.abs(ends).max() < _FARTHEST_PX:
            target.head.extend(heads[i].tolist())
            target.foot.extend(feet[i].tolist())
            target.size = float(np.linalg.norm(heads[i] - feet[i]))
            target.face.extend(face_region(heads[i], feet[i]))
            target.view = facing(targets.mean[i], camera, world)


def face_region(head: Floats, foot: Floats) -> list[float]:
    """The box x, y, w, h [px] of head and face of somebody whose head's top and foot are at these pixels."""
    tall = float(np.linalg.norm(head - foot))
    middle = head + (foot - head) * (0.5 * _HEAD_HEIGHT)
    # Of a head that leans in the image, the upright box around it.
    lean = np.abs(head - foot) / max(tall, 1e-9)
    width = tall * float(_HEAD_WIDTH * lean[1] + _HEAD_HEIGHT * lean[0])
    height = tall * float(_HEAD_HEIGHT * lean[1] + _HEAD_WIDTH * lean[0])
    return [float(middle[0]) - 0.5 * width, float(middle[1]) - 0.5 * height, width, height]


def facing(mean: Floats, camera: TrackingCamera, world: World) -> str:
    """What a camera sees of the head of somebody who looks where he goes: front, back, his left or right side.

    "" where he stands still, or nobody knows up.
    """
    if world.up is None or heading(mean, world) is None:
        return ""
    ahead = mean[VELOCITY] - world.up * (world.up @ mean[VELOCITY])
    ahead = ahead / np.linalg.norm(ahead)
    to_camera = camera.pose.position - mean[POSITION]
    forward, left = float(to_camera @ ahead), float(to_camera @ np.cross(world.up, ahead))
    if abs(forward) >= abs(left):
        return "front" if forward > 0.0 else "back"
    return "left" if left > 0.0 else "right"


def heading(mean: Floats, world: World) -> float | None:
    """Direction of the motion [rad] about up, from the world's first axis; None where it stands or up is not known.

    Where the first axis is up, from the second.
    """
    if world.up is None:
        return None
    first = np.array([1.0, 0.0, 0.0])
    if abs(world.up[0]) > 0.9:
        first = np.array([0.0, 1.0, 0.0])
    first = first - world.up * (world.up @ first)
    first /= np.linalg.norm(first)
    second = np.cross(world.up, first)
    x, y = float(mean[VELOCITY] @ first), float(mean[VELOCITY] @ second)
    if np.hypot(x, y) < _WALKS_M_S * world.scale.metre:
        return None
    return float(np.arctan2(y, x))


def _paint(message: pb.Track | pb.PredictedTarget, colour: Floats) -> None:
    if np.isfinite(colour).all():
        red, green, blue = (round(float(np.clip(value, 0, 255))) for value in colour)
        message.colour.red, message.colour.green, message.colour.blue = red, green, blue
