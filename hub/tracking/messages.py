"""Track and prediction messages: target states in 3-D, and their predicted image positions for every camera."""

from __future__ import annotations

import math

import numpy as np

from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY
from hub.tracking.filter.measurement import POINT, predict_measurement
from hub.tracking.filter.target_models import MARKER, TARGET_MODELS
from hub.tracking.filter.target_states import Targets
from hub.tracking.marker_filter import RECENT_NS, MarkerState
from hub.tracking.parameters import TrackerParameters, track_label
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.validation.rules import SCHEMA_VERSION

_COASTING_AFTER_S = 0.35  # three frames missed at 10 fps
MARKER_COASTING_AFTER_S = 0.2  # six frames missed at 30 fps
_MIN_HEADING_SPEED_M_S = 0.25
"""Targets slower than this have no heading."""
_HEAD_HEIGHT, _HEAD_WIDTH = 0.16, 0.13
"""Of head and face, as fractions of the height."""
_MAX_PIXEL = 1e5  # far outside every image


def track_messages(
    targets: Targets, time_ns: int, lost: tuple[Targets, Ints], parameters: TrackerParameters, sequence: int
) -> list[pb.Track]:
    """Messages of confirmed and coasting targets at a reference time, then of lost tracks, where last seen.

    lost: tracks as predicted to the times (k,) at which they were lost.
    """
    out: list[pb.Track] = []
    angles = headings(targets.mean, parameters)
    # A track that is as likely to have ended is not published, until it is seen again or lost.
    for i in np.flatnonzero(targets.confirmed & (targets.existence >= 0.5)).tolist():
        mean, covariance, model = targets.mean[i], targets.covariance[i], TARGET_MODELS[int(targets.kind[i])]
        unseen = max(time_ns - int(targets.seen_ns[i]), 0) / NANOSECONDS
        label = track_label(int(targets.kind[i]), int(targets.number[i]))
        state = "coasting" if unseen > _COASTING_AFTER_S else "confirmed"
        message = _message(label, state, time_ns, (mean, covariance), model.kind, unseen)
        message.sequence, message.cameras = sequence + len(out), int((targets.seen_by[i] > time_ns - RECENT_NS).sum())
        if np.isfinite(angles[i]):
            message.heading = float(angles[i])
        if model.upright:
            size = float(np.exp(mean[LOG_SIZE]))
            message.height = size
            message.height_std = size * float(np.sqrt(covariance[LOG_SIZE, LOG_SIZE]))
        _set_colour(message, targets.colour[i])
        out.append(message)
    ended, lost_ns = lost
    seen = ended.mean[:, POSITION] - ((lost_ns - ended.seen_ns) / NANOSECONDS)[:, None] * ended.mean[:, VELOCITY]
    for i, place in enumerate(seen.tolist()):
        out.append(
            pb.Track(
                schema_version=SCHEMA_VERSION,
                sequence=sequence + len(out),
                label=track_label(int(ended.kind[i]), int(ended.number[i])),
                state="lost",
                reference_time_ns=time_ns,
                position=place,
                kind=TARGET_MODELS[int(ended.kind[i])].kind,
                unseen_s=max(time_ns - int(ended.seen_ns[i]), 0) / NANOSECONDS,
            )
        )
    return out


def marker_message(
    label: str, state: MarkerState, time_ns: int, moments: tuple[Floats, Floats] | None = None
) -> pb.Track:
    """The message, without its sequence number, of a labelled marker at a reference time not before the state's.

    moments: mean (9,) and covariance (9, 9) at that time, if not those of the state.
    """
    mean, covariance = moments or state.predicted(time_ns)
    unseen = (time_ns - state.time_ns) / NANOSECONDS
    detected = "confirmed" if state.confirmed else "tentative"
    detected = "coasting" if unseen > MARKER_COASTING_AFTER_S or state.is_uncertain(covariance) else detected
    message = _message(label, detected, time_ns, (mean, covariance), MARKER.kind, unseen)
    message.cameras = state.cameras(time_ns)
    return message


def _message(
    label: str, state: str, time_ns: int, moments: tuple[Floats, Floats], kind: str, unseen_s: float
) -> pb.Track:
    mean, covariance = moments
    return pb.Track(
        schema_version=SCHEMA_VERSION,
        label=label,
        state=state,
        reference_time_ns=time_ns,
        position=mean[POSITION].tolist(),
        velocity=mean[VELOCITY].tolist(),
        position_covariance=covariance[POSITION, POSITION].ravel().tolist(),
        velocity_covariance=covariance[VELOCITY, VELOCITY].ravel().tolist(),
        kind=kind,
        unseen_s=unseen_s,
    )


def prediction_message(
    targets: Targets,
    time_ns: int,
    cameras: dict[str, TrackingCamera],
    boot_ids: dict[str, str],
    parameters: TrackerParameters,
    sequence: int,
) -> pb.Prediction:
    """The predicted image positions of the confirmed targets in every camera at a reference time."""
    message = pb.Prediction(schema_version=SCHEMA_VERSION, sequence=sequence, reference_time_ns=time_ns)
    known = targets.select(targets.confirmed)
    ahead = _motion_directions(known.mean, parameters)
    for name, camera in cameras.items():
        part = message.cameras.add(
            camera=name, boot_id=boot_ids.get(name, ""), device_time_ns=camera.device_ns(time_ns)
        )
        if len(known):
            _predict(part, known, ahead, camera, parameters)
    return message


def _predict(
    part: pb.CameraPrediction, targets: Targets, ahead: Floats, camera: TrackingCamera, parameters: TrackerParameters
) -> None:
    predicted = predict_measurement(camera, targets.mean, targets.kind, parameters.up)
    seen = camera.sees(predicted.value[:, POINT], predicted.depth)
    if not seen.any():
        return
    point, jacobian = predicted.value[:, POINT], predicted.jacobian[:, POINT]
    lens = camera.intrinsics
    pixels, heads, feet = (
        lens.project_normalised(predicted.value[:, :6].reshape(-1, 2)).reshape(-1, 3, 2).swapaxes(0, 1)
    )
    lens_jacobian = lens.pixel_jacobian(point)
    covariance = jacobian @ targets.covariance @ jacobian.transpose(0, 2, 1) + predicted.model_noise[:, POINT, POINT]
    covariance = lens_jacobian @ covariance @ lens_jacobian.transpose(0, 2, 1) + camera.noise_px**2 * np.eye(2)
    # Per second of the reference clock; a camera's own clock rate differs by parts in ten thousand.
    speed = (lens_jacobian @ jacobian[:, :, POSITION] @ targets.mean[:, VELOCITY, None])[:, :, 0]
    ends = np.hstack([heads, feet])
    with np.errstate(invalid="ignore"):
        whole = np.asarray((np.abs(ends) < _MAX_PIXEL).all(axis=1))
        seen &= (np.abs(pixels) <= _MAX_PIXEL).all(axis=1)
    size, face = np.linalg.norm(heads - feet, axis=1), face_regions(heads, feet)
    views = head_views(targets.mean, ahead, camera, parameters)
    spread = (0.5 * (covariance + covariance.swapaxes(1, 2))).reshape(-1, 4)[:, [0, 1, 3]]
    numbers = np.hstack([pixels, speed, spread, heads, feet, size[:, None], face])[seen].tolist()
    for i, row in zip(np.flatnonzero(seen).tolist(), numbers, strict=True):
        kind = int(targets.kind[i])
        target = part.targets.add(
            target=track_label(kind, int(targets.number[i])), kind=TARGET_MODELS[kind].kind, u=row[0], v=row[1],
            u_velocity=row[2], v_velocity=row[3], covariance=row[4:7],
        )  # fmt: skip
        _set_colour(target, targets.colour[i])
        if whole[i]:
            target.head.extend(row[7:9])
            target.foot.extend(row[9:11])
            target.size = row[11]
            target.face.extend(row[12:])
            target.view = views[i]


def face_regions(head: Floats, foot: Floats) -> Floats:
    """Boxes (n, 4) x, y, w, h [px] of the heads of people whose head tops and feet are at pixels (n, 2)."""
    tall = np.linalg.norm(head - foot, axis=1, keepdims=True)
    middle = head + (foot - head) * (0.5 * _HEAD_HEIGHT)
    # The axis-aligned box around a head that is tilted in the image.
    axis = np.abs(head - foot) / np.maximum(tall, 1e-9)
    size = tall * (_HEAD_WIDTH * axis[:, ::-1] + _HEAD_HEIGHT * axis)
    return np.hstack([middle - 0.5 * size, size])


def head_views(mean: Floats, ahead: Floats, camera: TrackingCamera, parameters: TrackerParameters) -> list[str]:
    """The side of each head that a camera sees if people look where they walk: front, back, left or right.

    mean: (n, 7). ahead: (n, 3) from `_motion_directions`; "" where it is NaN.
    """
    if parameters.up is None:
        return [""] * len(mean)
    to_camera = camera.pose.position - mean[:, POSITION]
    forward, left = (to_camera * ahead).sum(axis=1), (np.cross(parameters.up, ahead) * to_camera).sum(axis=1)
    with np.errstate(invalid="ignore"):
        side = np.where(left > 0.0, "left", "right")
        view = np.where(np.abs(forward) >= np.abs(left), np.where(forward > 0.0, "front", "back"), side)
    return [str(side) for side in np.where(np.isfinite(forward), view, "")]


def _motion_directions(mean: Floats, parameters: TrackerParameters) -> Floats:
    """Unit vectors (n, 3) of the horizontal motion; NaN for targets at rest or if up is unknown."""
    if parameters.up is None:
        return np.full((len(mean), 3), np.nan)
    along = mean[:, VELOCITY] - np.outer(mean[:, VELOCITY] @ parameters.up, parameters.up)
    speed = np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(along / np.where(speed < _MIN_HEADING_SPEED_M_S * parameters.scale.units_per_m, np.nan, speed))


def headings(mean: Floats, parameters: TrackerParameters) -> Floats:
    """Directions of motion (n,) [rad] about up, from the world's x axis; NaN as in `_motion_directions`.

    If the x axis is vertical, from the y axis.
    """
    if parameters.up is None:
        return np.full(len(mean), np.nan)
    first = np.array([0.0, 1.0, 0.0] if abs(parameters.up[0]) > 0.9 else [1.0, 0.0, 0.0])
    first = first - parameters.up * (parameters.up @ first)
    first /= np.linalg.norm(first)
    ahead = _motion_directions(mean, parameters)
    return np.asarray(np.arctan2(ahead @ np.cross(parameters.up, first), ahead @ first))


def _set_colour(message: pb.Track | pb.PredictedTarget, colour: Floats) -> None:
    values = colour.tolist()
    if all(map(math.isfinite, values)):
        red, green, blue = (round(min(max(value, 0.0), 255.0)) for value in values)
        message.colour.red, message.colour.green, message.colour.blue = red, green, blue
