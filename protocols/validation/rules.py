"""Validation rules of each message type: ranges, counts, lengths, names.

One function per message. Each raises Rejected at the first violation, so that no estimator ever receives a number
that is not plausible (``protocols.core.ranges``) or an array of the wrong length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Sized
from enum import Enum
from functools import lru_cache
from math import inf, isfinite
from typing import Any

from protocols.core.errors import InputError
from protocols.core.names import check_identifier, is_name
from protocols.core.ranges import (
    MAX_CAMERAS,
    MAX_CLOCK_RATE,
    MAX_COUNT,
    MAX_DISTORTION,
    MAX_EXPOSURE_NS,
    MAX_FOCAL,
    MAX_FPS,
    MAX_IMAGE_SIDE,
    MAX_LENGTH,
    MAX_PIXEL,
    MAX_TIME_NS,
    MAX_TIME_S,
    MAX_TURN,
    MIN_CLOCK_RATE,
    MIN_FOCAL,
    MIN_STD,
)
from protocols.messages import syncline_pb2 as pb

SCHEMA_VERSION = 1  # of the messages

MAX_DETECTIONS = 4096  # of one frame
MAX_OVERLAPS = 12 * MAX_CAMERAS  # of each camera as many as a calibration takes pairs
MAX_NUMBERS = 256  # of one list
MAX_LABEL = 64  # characters
MAX_TEXT = 4096  # characters


class RejectionReason(Enum):
    """Why a message was rejected; the value is the counter's name after ``rejected.``."""

    OVERSIZED = "oversized"
    GARBLED = "garbled"
    SCHEMA_VERSION = "schema_version"
    NOT_FINITE = "not_finite"
    OUT_OF_RANGE = "out_of_range"
    BAD_LENGTH = "bad_length"
    TOO_MANY = "too_many"
    BAD_ID = "bad_id"
    BAD_TEXT = "bad_text"
    WRONG_SENDER = "wrong_sender"
    UNKNOWN_KEY = "unknown_key"
    WRONG_SOURCE = "wrong_source"
    """Its boot id belongs to an agent that publishes over another connection."""
    SECOND_AGENT = "second_agent"
    """Two agents have one id; only the first of them is accepted."""


class Rejected(Exception):
    """A message that must not be used. The caller counts ``reason``; ``detail`` is for the user."""

    sequence: int | None = None
    """The message's sequence number, if it could be parsed."""

    def __init__(self, reason: RejectionReason, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(f"{reason.value}: {detail}")


def check(message: Any) -> None:
    """Raise Rejected unless every field of a catalogue message is valid."""
    if message.schema_version != SCHEMA_VERSION:
        raise Rejected(
            RejectionReason.SCHEMA_VERSION,
            f"schema version {message.schema_version}, this build reads {SCHEMA_VERSION}",
        )
    _RULES[message.DESCRIPTOR.name](message)


def _number(value: float, name: str, low: float = -inf, high: float = inf) -> None:
    if not isfinite(value):
        raise Rejected(RejectionReason.NOT_FINITE, f"{name} is {value}")
    if not low <= value <= high:
        raise Rejected(RejectionReason.OUT_OF_RANGE, f"{name} is {value:g}, allowed: {low:g} to {high:g}")


def _vector(values: Sequence[float], name: str, lengths: tuple[int, ...], low: float = -inf, high: float = inf) -> None:
    if len(values) not in lengths:
        raise Rejected(RejectionReason.BAD_LENGTH, f"{name} has {len(values)} numbers")
    for value in values:
        _number(value, name, low, high)


def _bounded(values: Sequence[float], name: str, lengths: tuple[int, ...], most: float) -> None:
    _vector(values, name, lengths, -most, most)


def _count(things: Sized, name: str, most: int) -> None:
    if len(things) > most:
        raise Rejected(RejectionReason.TOO_MANY, f"{len(things)} {name}, at most {most}")


def _name(text: str, field: str, *, optional: bool = False) -> None:
    """The name of a camera or another agent."""
    if not (is_name(text) or (optional and not text)):
        raise Rejected(RejectionReason.BAD_ID, f"{field} {text[:80]!r} is not a valid name")


def _id(text: str, field: str, *, optional: bool = False) -> None:
    """The id of a boot or a role."""
    if optional and not text:
        return
    try:
        check_identifier(text, field)
    except InputError as error:
        raise Rejected(RejectionReason.BAD_ID, f"{error.what}: {error.remedy}") from None


def _text(text: str, name: str, most: int = MAX_TEXT) -> None:
    # Labels are written to CSV files and terminals, so control characters are rejected.
    if len(text) > most or not _printable(text):
        raise Rejected(RejectionReason.BAD_TEXT, f"{name} is longer than {most} or has control characters")


def _printable(text: str) -> bool:
    return text.isprintable() or all(letter >= " " and not "\x7f" <= letter <= "\x9f" for letter in text)


def _one_of(text: str, name: str, allowed: frozenset[str]) -> None:
    if text not in allowed:
        raise Rejected(RejectionReason.BAD_TEXT, f"{name} is {text[:40]!r}")


def _distinct(names: Iterable[str], what: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise Rejected(RejectionReason.BAD_ID, f"{what} {name!r} twice")
        seen.add(name)


def _times(message: Any, *names: str) -> None:
    """Times [ns]: differences of two must not overflow."""
    for name in names:
        time = getattr(message, name)
        if not -MAX_TIME_NS <= time <= MAX_TIME_NS:
            raise Rejected(RejectionReason.OUT_OF_RANGE, f"{name} is {time}")


def _counts(message: Any, *names: str) -> None:
    """Numbers of frames and messages."""
    for name in names:
        if getattr(message, name) > MAX_COUNT:
            raise Rejected(RejectionReason.OUT_OF_RANGE, f"{name} is {getattr(message, name)}")


def _stds(values: Sequence[float], name: str, lengths: tuple[int, ...], most: float) -> None:
    """Standard deviations of what an estimator weights by them: 0 (exact), or not so small that 1/std² overflows."""
    _vector(values, name, lengths, 0.0, most)
    if any(0.0 < value < MIN_STD for value in values):
        raise Rejected(RejectionReason.OUT_OF_RANGE, f"{name} is below {MIN_STD:g}, but not 0")


def _covariance_2d(covariance: Sequence[float]) -> None:
    _vector(covariance, "covariance", (0, 3), -(MAX_PIXEL**2), MAX_PIXEL**2)
    if covariance:
        uu, uv, vv = covariance
        # The tolerance lets a rank-one covariance pass after rounding.
        if uu < 0.0 or vv < 0.0 or uv * uv > uu * vv * (1.0 + 1e-9) + 1e-12:
            raise Rejected(RejectionReason.OUT_OF_RANGE, "covariance is not a covariance")


def _intrinsics(message: Any) -> None:
    matrix = message.matrix
    _bounded(matrix, "matrix", (0, 9), MAX_FOCAL)
    if matrix and not (matrix[0] >= MIN_FOCAL and matrix[4] >= MIN_FOCAL):
        raise Rejected(RejectionReason.OUT_OF_RANGE, f"a focal length is below {MIN_FOCAL:g} px")
    if matrix and (matrix[3], *matrix[6:]) != (0.0, 0.0, 0.0, 1.0):
        raise Rejected(RejectionReason.OUT_OF_RANGE, "matrix is no camera matrix")
    lengths = (0, 4) if message.fisheye else (0, 4, 5)
    _bounded(message.distortions, "distortions", lengths, MAX_DISTORTION)


_KINDS = frozenset({"marker", "person", "vehicle"})


def _colour(colour: pb.Colour) -> None:
    if max(colour.red, colour.green, colour.blue) > 255:
        raise Rejected(RejectionReason.OUT_OF_RANGE, "a colour is above 255")


def _detection(detection: pb.Detection) -> None:
    # The most frequent message: one comparison for all four numbers; details only on failure.
    # Non-finite numbers fail the comparison.
    if not (
        -MAX_PIXEL <= detection.u <= MAX_PIXEL
        and -MAX_PIXEL <= detection.v <= MAX_PIXEL
        and 0.0 <= detection.size <= MAX_PIXEL
        and 0.0 <= detection.score <= 1.0
    ):
        _number(detection.u, "u", -MAX_PIXEL, MAX_PIXEL)
        _number(detection.v, "v", -MAX_PIXEL, MAX_PIXEL)
        _number(detection.size, "size", 0.0, MAX_PIXEL)
        _number(detection.score, "score", 0.0, 1.0)
    if detection.label:
        _text(detection.label, "label", MAX_LABEL)
    if detection.HasField("colour"):
        _colour(detection.colour)
    if detection.covariance:
        _covariance_2d(detection.covariance)
    if detection.kind:
        _one_of(detection.kind, "kind", _KINDS | {"corner"})
    if detection.head:
        _bounded(detection.head, "head", (2,), MAX_PIXEL)
    if detection.foot:
        _bounded(detection.foot, "foot", (2,), MAX_PIXEL)
    if detection.box:
        _bounded(detection.box, "box", (4,), MAX_PIXEL)
        if min(detection.box[2:]) < 0.0:
            raise Rejected(RejectionReason.OUT_OF_RANGE, "a box has a negative side")
    if detection.target:
        _text(detection.target, "target", MAX_LABEL)


@lru_cache(maxsize=8192)
def check_names(camera: str, boot_id: str, field: str = "camera") -> None:
    """Raise Rejected unless the name of a camera, or of another sender, and its boot id are valid."""
    _name(camera, field)
    _id(boot_id, "boot id")


def _size(message: Any) -> None:
    _number(message.width, "width", 1, MAX_IMAGE_SIDE)
    _number(message.height, "height", 1, MAX_IMAGE_SIDE)


def _lens(message: Any) -> None:
    """What is known of a camera's images."""
    _size(message)
    _number(message.fps, "fps", 0.0, MAX_FPS)  # 0: not reported by the device
    _intrinsics(message)


def _observation(message: pb.Observation) -> None:
    check_names(message.camera, message.boot_id)
    _times(message, "device_time_ns")
    _counts(message, "sequence", "frame")
    if not 0 <= message.exposure_ns <= MAX_EXPOSURE_NS:
        raise Rejected(RejectionReason.OUT_OF_RANGE, f"exposure is {message.exposure_ns} ns")
    _count(message.detections, "detections", MAX_DETECTIONS)
    for detection in message.detections:
        _detection(detection)


def _camera_info(message: pb.CameraInfo) -> None:
    check_names(message.camera, message.boot_id)
    _lens(message)
    _text(message.driver, "driver", MAX_LABEL)
    _text(message.clock, "clock", MAX_LABEL)
    _text(message.target, "target", MAX_LABEL)
    _bounded(message.position, "position", (0, 3), MAX_LENGTH)
    _bounded(message.rotation, "rotation", (0, 3), MAX_TURN)
    _stds(message.position_std, "position_std", (0, 3), MAX_LENGTH)
    _stds(message.rotation_std, "rotation_std", (0, 3), MAX_TURN)
    _number(message.readout_s, "readout_s", -10.0, 10.0)
    _number(message.focal_std, "focal_std", 0.0, 2.0)


_UNITS = frozenset({"m", "cm", "mm"})
_CLOCKS = frozenset({"independent", "shared"})


def _rig_info(message: pb.RigInfo) -> None:
    _one_of(message.units, "units", _UNITS)
    _one_of(message.clock, "clock", _CLOCKS)
    _count(message.distances, "distances", MAX_CAMERAS)
    for distance in message.distances:
        _name(distance.camera_a, "camera")
        _name(distance.camera_b, "camera")
        _distinct((distance.camera_a, distance.camera_b), "distance names")
        _number(distance.distance, "distance", MIN_STD, MAX_LENGTH)
    _bounded(message.up, "up", (0, 3), MAX_LENGTH)
    if message.up and max(map(abs, message.up)) < MIN_STD:
        raise Rejected(RejectionReason.OUT_OF_RANGE, "up has no direction")
    _name(message.up_camera, "up camera", optional=True)
    _name(message.reference_camera, "reference camera", optional=True)


def _camera_calibration(camera: pb.CameraCalibration) -> None:
    _name(camera.camera, "camera")
    _bounded(camera.rotation, "rotation", (3,), MAX_TURN)
    _bounded(camera.translation, "translation", (3,), MAX_LENGTH)
    _number(camera.time_offset, "time_offset", -MAX_TIME_S, MAX_TIME_S)
    _number(camera.clock_rate, "clock_rate", MIN_CLOCK_RATE, MAX_CLOCK_RATE)
    _number(camera.time_offset_std, "time_offset_std", 0.0, MAX_TIME_S)
    _vector(camera.position_std, "position_std", (0, 3), 0.0, MAX_LENGTH)
    _number(camera.rms_px, "rms_px", 0.0, MAX_PIXEL)
    _number(camera.lag_time_s, "lag_time_s", -MAX_TIME_S, MAX_TIME_S)
    _number(camera.clock_rate_std, "clock_rate_std", 0.0, MAX_CLOCK_RATE)
    _intrinsics(camera)
    _id(camera.boot_id, "boot id", optional=True)


_STATUS = frozenset({"solved", "refused", "collecting", "searching"})
_HUB_STATES = frozenset({"", "collecting", "searching", "calibrated", "degraded", "refused"})
MAX_RUNS = 65_536  # of rows of one solver event
_SCALES = frozenset({"metric", "arbitrary"})


def _calibration(message: pb.Calibration) -> None:
    _one_of(message.status, "status", _STATUS)
    _text(message.reason, "reason")
    solved = message.status == "solved"
    if solved or message.scale:
        _one_of(message.scale, "scale", _SCALES)
    if solved or message.units:
        _one_of(message.units, "units", _UNITS)
    _name(message.reference_camera, "reference camera", optional=not solved)
    _text(message.solver, "solver", MAX_LABEL)
    _count(message.cameras, "cameras", MAX_CAMERAS)
    _count(message.refused, "refused cameras", MAX_CAMERAS)
    for camera in message.cameras:
        _camera_calibration(camera)
    for refusal in message.refused:
        _name(refusal.camera, "camera")
        _text(refusal.reason, "reason")
    _distinct([c.camera for c in message.cameras] + [r.camera for r in message.refused], "camera")
    _one_of(message.state, "state", _HUB_STATES)
    _count(message.progress, "progress", MAX_CAMERAS)
    for progress in message.progress:
        _name(progress.camera, "camera")
        _one_of(progress.state, "state", _HUB_STATES)
        _number(progress.shared_motion_s, "shared_motion_s", 0.0)
        _number(progress.coverage, "coverage", 0.0, 1.0)
        _number(progress.margin, "margin", 0.0)
        _text(progress.reason, "reason")
    _distinct([progress.camera for progress in message.progress], "camera")


def _solver_event(message: pb.SolverEvent) -> None:
    _one_of(message.kind, "kind", frozenset({"submitted", "applied", "failed"}))
    _text(message.reason, "reason")
    _number(message.cpu_s, "cpu_s", 0.0)
    _count(message.rows, "runs of rows", MAX_RUNS)
    for rows in message.rows:
        check_names(rows.camera, rows.boot_id)
        if rows.last_sequence < rows.first_sequence:
            raise Rejected(RejectionReason.OUT_OF_RANGE, "a run of rows ends before it begins")
    for priors in (message.clock_priors, message.arrivals):
        _count(priors, "clock priors", MAX_CAMERAS)
        for prior in priors:
            _name(prior.camera, "camera")
            _number(prior.unix_minus_camera, "unix_minus_camera", -MAX_TIME_S, MAX_TIME_S)
            _number(prior.error_bound, "error_bound", 0.0, MAX_TIME_S)


_TRACK_STATES = frozenset({"tentative", "confirmed", "coasting", "lost"})


def _track(message: pb.Track) -> None:
    _text(message.label, "label", MAX_LABEL)
    _one_of(message.state, "state", _TRACK_STATES)
    _times(message, "reference_time_ns")
    _bounded(message.position, "position", (3,), MAX_LENGTH)
    _bounded(message.velocity, "velocity", (0, 3), MAX_LENGTH)
    for covariance, name in ((message.position_covariance, "position"), (message.velocity_covariance, "velocity")):
        _bounded(covariance, f"{name}_covariance", (0, 9), MAX_LENGTH**2)
        if covariance and min(covariance[::4]) < 0.0:
            raise Rejected(RejectionReason.OUT_OF_RANGE, f"a variance of the {name} is negative")
    if message.kind:
        _one_of(message.kind, "kind", _KINDS)
    if message.HasField("heading"):
        _number(message.heading, "heading", -7.0, 7.0)
    _number(message.height, "height", 0.0, MAX_LENGTH)
    _number(message.height_std, "height_std", 0.0, MAX_LENGTH)
    _number(message.unseen_s, "unseen_s", 0.0, MAX_TIME_S)
    _count(range(message.cameras), "cameras", MAX_CAMERAS)
    if message.HasField("colour"):
        _colour(message.colour)


_VIEWS = frozenset({"", "front", "back", "left", "right"})


def _predicted_target(target: pb.PredictedTarget) -> None:
    _text(target.target, "target", MAX_LABEL)
    if target.kind:
        _one_of(target.kind, "kind", _KINDS)
    _number(target.u, "u", -MAX_PIXEL, MAX_PIXEL)
    _number(target.v, "v", -MAX_PIXEL, MAX_PIXEL)
    _number(target.u_velocity, "u_velocity")
    _number(target.v_velocity, "v_velocity")
    _covariance_2d(target.covariance)
    _number(target.size, "size", 0.0, MAX_PIXEL)
    _bounded(target.head, "head", (0, 2), MAX_PIXEL)
    _bounded(target.foot, "foot", (0, 2), MAX_PIXEL)
    _bounded(target.face, "face", (0, 4), MAX_PIXEL)
    if target.face and min(target.face[2:]) < 0.0:
        raise Rejected(RejectionReason.OUT_OF_RANGE, "a face has a negative side")
    _one_of(target.view, "view", _VIEWS)
    if target.HasField("colour"):
        _colour(target.colour)


def _prediction(message: pb.Prediction) -> None:
    _times(message, "reference_time_ns")
    _count(message.cameras, "cameras", MAX_CAMERAS)
    for camera in message.cameras:
        _times(camera, "device_time_ns")
        _name(camera.camera, "camera")
        _id(camera.boot_id, "boot id", optional=True)
        _count(camera.targets, "targets", MAX_DETECTIONS)
        for target in camera.targets:
            _predicted_target(target)
    _distinct((camera.camera for camera in message.cameras), "camera")


_AGENT_STATES = frozenset({"starting", "running", "degraded", "stopping"})


def _agent_status(message: pb.AgentStatus) -> None:
    _name(message.agent, "agent")
    _id(message.role, "role")
    _id(message.boot_id, "boot id")
    _one_of(message.state, "state", _AGENT_STATES)
    _text(message.message, "message")
    _text(message.version, "version", MAX_LABEL)
    for numbers in (message.counters, message.gauges):
        _count(numbers, "numbers", MAX_NUMBERS)
        for name, value in numbers.items():
            _text(name, "a number's name", MAX_LABEL)
            _number(value, "a counter or gauge")


MAX_INFORMATION = 1e30
"""1/unit². Observations of a pose, 1e9 of them, with a std of 1e-9 each stay below it, and its products are finite."""


def _node_edge(edge: pb.NodeEdge) -> None:
    _name(edge.neighbour, "neighbour")
    _bounded(edge.rotation, "rotation", (3,), MAX_TURN)
    _bounded(edge.centre, "centre", (3,), MAX_LENGTH)
    _bounded(edge.hessian, "hessian", (21,), MAX_INFORMATION)
    _bounded(edge.gradient, "gradient", (6,), MAX_INFORMATION)
    _number(edge.count, "count", 0.0, MAX_COUNT)
    _number(edge.chi2, "chi2", 0.0, MAX_INFORMATION)


def _node_anchor(anchor: pb.NodeAnchor) -> None:
    _name(anchor.camera, "anchor")
    _bounded(anchor.rotation, "rotation", (3,), MAX_TURN)
    _bounded(anchor.position, "position", (3,), MAX_LENGTH)
    _bounded(anchor.world_rotation, "world_rotation", (0, 3), MAX_TURN)
    _bounded(anchor.world_position, "world_position", (0, 3), MAX_LENGTH)
    _stds([anchor.rotation_std], "rotation_std", (1,), MAX_TURN)
    _stds([anchor.position_std], "position_std", (1,), MAX_LENGTH)


def _node_state(message: pb.NodeState) -> None:
    _name(message.camera, "camera")
    _name(message.host, "host")
    _name(message.frame, "frame")
    _name(message.partner, "partner", optional=True)
    _bounded(message.rotation, "rotation", (0, 3), MAX_TURN)
    _bounded(message.position, "position", (len(message.rotation),), MAX_LENGTH)
    _count(message.edges, "edges", MAX_CAMERAS)
    for edge in message.edges:
        _node_edge(edge)
    _distinct((edge.neighbour for edge in message.edges), "neighbour")
    _count(message.anchors, "anchors", MAX_CAMERAS)
    for anchor in message.anchors:
        _node_anchor(anchor)
    _distinct((anchor.camera for anchor in message.anchors), "anchor")


def _shard(message: pb.Shard) -> None:
    _name(message.hub, "hub")
    _count(message.groups, "groups", MAX_CAMERAS)
    cameras = [camera for group in message.groups for camera in group.cameras]
    _count(cameras, "cameras", MAX_CAMERAS)
    for name in (*(group.hub for group in message.groups), *cameras):
        _name(name, "hub or camera")
    _distinct((group.hub for group in message.groups), "hub")
    _distinct(cameras, "camera")
    _count(message.overlaps, "overlaps", MAX_OVERLAPS)
    for overlap in message.overlaps:
        _name(overlap.camera_a, "camera")
        _name(overlap.camera_b, "camera")
        _number(overlap.seconds, "seconds", 0.0, MAX_TIME_S)


ACTIONS = frozenset({"start_recording", "stop_recording", "recalibrate", "forget", "export"})
MAX_PICTURE = 512 * 1024  # bytes of a thumbnail


def _command(message: pb.Command) -> None:
    check_names(message.sender, message.boot_id, "sender")
    _one_of(message.action, "action", ACTIONS)
    _name(message.agent, "agent")
    _id(message.agent_boot, "agent boot")


def _picture(message: pb.Picture) -> None:
    check_names(message.camera, message.boot_id)
    _image(message, MAX_PICTURE)


def _image(message: Any, most_bytes: int) -> None:
    _times(message, "device_time_ns")
    _size(message)
    _count(message.jpeg, "bytes of picture", most_bytes)


MAX_IMAGE = 1_000_000
"""Bytes of a compressed image; with the rest of its message it stays below MAX_PAYLOAD."""
MAX_POINTS = 4096  # of one polyline
MAX_FAR_PIXEL = 1e7  # far outside every image
MAX_METRES = 1e7  # beyond any scene on the ground
_TARGET_STATES = frozenset({"visible", "coasting", "lost"})


def _points(values: Sequence[float], name: str, most: float) -> None:
    """Pairs of coordinates, each within ±``most``."""
    if len(values) % 2:
        raise Rejected(RejectionReason.BAD_LENGTH, f"{name} has {len(values)} numbers")
    if len(values) > 2 * MAX_POINTS:
        raise Rejected(RejectionReason.TOO_MANY, f"{len(values) // 2} {name}, at most {MAX_POINTS}")
    for value in values:
        _number(value, name, -most, most)


def _geodetic(geo: Sequence[float], name: str) -> None:
    """Latitude, longitude, altitude, or nothing."""
    _vector(geo, name, (0, 3))
    if geo and not (abs(geo[0]) <= 90.0 and abs(geo[1]) <= 180.0 and abs(geo[2]) <= 1e5):
        raise Rejected(RejectionReason.OUT_OF_RANGE, f"{name} is not a geographic position")


def _flight_image(message: pb.FlightImage) -> None:
    check_names(message.agent, message.boot_id, "agent")
    _image(message, MAX_IMAGE)


def _vehicle_telemetry(message: pb.VehicleTelemetry) -> None:
    check_names(message.agent, message.boot_id, "agent")
    _times(message, "device_time_ns", "vehicle_time_ns")
    _number(message.time_std_s, "time_std_s", 0.0, MAX_TIME_S)
    _vector(message.ned_from_body, "ned_from_body", (4,))
    if abs(sum(part * part for part in message.ned_from_body) - 1.0) > 1e-6:
        raise Rejected(RejectionReason.OUT_OF_RANGE, "ned_from_body is no rotation")
    _bounded(message.position, "position", (0, 3), MAX_METRES)
    _number(message.position_std, "position_std", 0.0, MAX_METRES)
    _geodetic(message.origin, "origin")


def _target_command(message: pb.TargetCommand) -> None:
    check_names(message.agent, message.boot_id, "agent")
    _one_of(message.kind, "kind", frozenset({"select", "stop"}))
    _bounded(message.box, "box", (4,) if message.kind == "select" else (0,), MAX_PIXEL)
    if message.box and not (message.box[2] > 0.0 and message.box[3] > 0.0):
        raise Rejected(RejectionReason.OUT_OF_RANGE, "the box has no width or height")
    _number(message.by, "by", 0, 255)


def _target_state(message: pb.TargetState) -> None:
    check_names(message.agent, message.boot_id, "agent")
    _times(message, "device_time_ns")
    _one_of(message.state, "state", _TARGET_STATES)
    _bounded(message.centre, "centre", (0,) if message.state == "lost" else (2,), MAX_FAR_PIXEL)
    _bounded(message.size, "size", (0, 2), MAX_FAR_PIXEL)
    _bounded(message.heading, "heading", (0, 1), 7.0)
    _number(message.std_px, "std_px", 0.0)
    _bounded(message.ground, "ground", (0, 2), MAX_METRES)
    _bounded(message.velocity, "velocity", (0, 2), 1e4)
    _number(message.std_m, "std_m", 0.0)
    _geodetic(message.geo, "geo")
    _count(message.hypotheses, "hypotheses", MAX_NUMBERS)
    for hypothesis in message.hypotheses:
        _number(hypothesis.weight, "weight", 0.0, 1.0)
        _bounded((hypothesis.x, hypothesis.y), "hypothesis", (2,), MAX_FAR_PIXEL)


def _target_cloud(message: pb.TargetCloud) -> None:
    check_names(message.agent, message.boot_id, "agent")
    _points(message.pixels, "pixels", MAX_FAR_PIXEL)


def _road_map(message: pb.RoadMap) -> None:
    check_names(message.agent, message.boot_id, "agent")
    _points(message.pixels, "pixels", MAX_FAR_PIXEL)
    _points(message.ground, "ground", MAX_METRES)
    if message.ground and len(message.ground) != len(message.pixels):
        raise Rejected(RejectionReason.BAD_LENGTH, "ground and pixels are not the same points")


def _uav_info(message: pb.UavInfo) -> None:
    check_names(message.agent, message.boot_id, "agent")
    _lens(message)
    _bounded(message.body_from_camera, "body_from_camera", (0, 9), 1.001)
    _text(message.model, "model", MAX_LABEL)


_RULES: dict[str, Callable[[Any], None]] = {
    "Observation": _observation,
    "CameraInfo": _camera_info,
    "RigInfo": _rig_info,
    "Calibration": _calibration,
    "Track": _track,
    "SolverEvent": _solver_event,
    "AgentStatus": _agent_status,
    "NodeState": _node_state,
    "Command": _command,
    "Picture": _picture,
    "Prediction": _prediction,
    "FlightImage": _flight_image,
    "VehicleTelemetry": _vehicle_telemetry,
    "TargetCommand": _target_command,
    "TargetState": _target_state,
    "TargetCloud": _target_cloud,
    "RoadMap": _road_map,
    "UavInfo": _uav_info,
    "Shard": _shard,
}
