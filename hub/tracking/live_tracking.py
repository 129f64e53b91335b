"""Live tracking: observations and calibrations in, track and prediction messages out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from google.protobuf.message import Message

from hub.tracking.association.initiation import LengthScale
from hub.tracking.calibration.vertical import VerticalEstimator
from hub.tracking.detections import TrackingCamera, tracked_kind
from hub.tracking.filter.kalman import LOG_SIZE
from hub.tracking.filter.target_models import PERSON
from hub.tracking.filter.target_states import MultiTargetState, Targets
from hub.tracking.marker_tracks import MarkerTracks
from hub.tracking.messages import prediction_message, track_messages
from hub.tracking.tracker import Tracker
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity, fit_similarity
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration

_METRES = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_TYPICAL_SPACING_M = 5.0
"""Assumed distance of cameras if the scale is unknown, until it is estimated from the heights of people."""
_POSITION_TOLERANCE, _ANGLE_TOLERANCE = 1e-6, 1e-6  # m, rad: a calibration that differs by less is the same
_UP_EVERY_FRAMES = 20  # the vertical is estimated again
_WAIT = 0.25
"""Of a frame interval above ``_SLOW_S``: how long an instant's other cameras are awaited after the last arrival."""
_SLOW_S = 0.2  # s behind, from which tracking is reported as slow
_INTERVAL_S, _AHEAD_S = 0.05, 0.1  # between two publications; prediction horizon after the newest frame
_LAG_S = 0.5  # how much later than another camera's an observation may arrive


class LiveTracking:
    """Tracks of people, vehicles and markers, with online estimates of the vertical and of the scale of the world.

    Markers with a label are tracked by it (`MarkerTracks`), all else by association (`Tracker`).
    """

    def __init__(self) -> None:
        self.tracker = Tracker(lag_s=_LAG_S)
        self._vertical = VerticalEstimator()
        self._given_up: Floats | None = None
        self._scale = LengthScale()
        self._boot_ids: dict[str, str] = {}
        self._sequence = 0
        self.predicts = True
        """Whether predictions are made; those left out are counted as ``shed.predictions``."""
        self._shed: Counter[str] = Counter()
        self._predictions = 0
        self._next = -float("inf")
        self._published_ns: int | None = None
        self._published_steps = self._seen_steps = 0
        self._seen_at = 0.0
        self._published: set[int] = set()
        self._used_frames = 0
        self._clock: tuple[str, str] | None = None
        self.has_detections = False
        self.markers = MarkerTracks(_LAG_S, self.tracker.parameters.coast_s, _INTERVAL_S)
        self._smoothed = 0

    @property
    def counters(self) -> Counter[str]:
        """Frames, and rows of labelled markers, by how they were handled; predictions that were left out."""
        return self.tracker.counters + self.markers.counters + self._shed

    def calibrate(
        self,
        cameras: Mapping[str, CameraCalibration],
        boot_ids: Mapping[str, str],
        *,
        reference: str,
        scale: str,
        units: str,
        up: Floats | None,
        held: bool = False,
    ) -> None:
        """Use a new calibration.

        boot_ids: by camera, the boot id of the clock it refers to, "" = any. reference: the camera whose clock is the
        reference. up: (3,) unit vector in its world frame; None = unknown. held: world frame, scale and reference clock
        are those of the calibration before.
        """
        clock = (reference, "" if held else boot_ids.get(reference, ""))
        if clock != self._clock and self._clock is not None:
            # All times refer to another clock now.
            self.tracker.reset()
            self.markers.reset()
        self._clock = clock
        new = {
            name: TrackingCamera.from_calibration(camera, boot_ids.get(name, "")) for name, camera in cameras.items()
        }
        change = None
        if self.tracker.cameras and not held:
            change = _gauge_change(self.tracker.cameras, new)
        metric = scale == "metric"
        units_per_m = _METRES.get(units, 1.0) if metric else guessed_units_per_m(new)
        if not metric and not self._scale.metric and change is not None:
            units_per_m = self._scale.units_per_m * change.scale
        elif not metric and not self._scale.metric and self.tracker.cameras:
            units_per_m = self._scale.units_per_m
        self._scale = LengthScale(units_per_m, metric)
        self._given_up = up
        self.tracker.calibrate(new, change)
        self.markers.calibrate(new, change)
        self._set_parameters(up if up is not None else self._estimated_up())

    def handle(self, message: Message, tracked: bool | None = None) -> None:
        """Process one observation; other messages are ignored. tracked: whether some of it has no label of its own."""
        if not isinstance(message, pb.Observation):
            return
        self.markers.handle(message)
        if not self.has_detections:
            self.has_detections = any(map(tracked_kind, message.detections)) if tracked is None else tracked
            if not self.has_detections:
                return
        if not self.tracker.cameras:
            return
        camera = self.tracker.cameras.get(message.camera)
        self._boot_ids[message.camera] = message.boot_id
        if self.tracker.handle(message) and camera is not None and self._given_up is None:
            frame = self.tracker.newest_frame
            assert frame is not None
            self._vertical.handle(frame)
            self._used_frames += 1
            if self._used_frames % _UP_EVERY_FRAMES == 0 and self.tracker.parameters.up is None:
                up = self._estimated_up()
                if up is not None:
                    self._set_parameters(up)

    def tick(self, now: float) -> list[Message]:
        """Track and prediction messages; now: any monotonic clock [s].

        Of labelled markers as soon as there are new rows, of all else at most every ``interval_s``.
        """
        return [*self._tick_targets(now), *self._numbered(self.markers.tick(now))]

    def smoothed(self) -> list[pb.Track]:
        """The tracks of labelled markers, smoothed over ``lag_s`` behind the newest row, since the last call."""
        out = self.markers.smoothed()
        for message in out:
            message.sequence, self._smoothed = self._smoothed, self._smoothed + 1
        return out

    def _tick_targets(self, now: float) -> list[Message]:
        """Track and prediction messages of people, vehicles and unlabelled markers."""
        if now < self._next or not self.tracker.cameras or not self.has_detections:
            return []
        state = self.tracker.advance()
        steps = self.tracker.counters["track.steps"]
        if state.time_ns is None or steps == self._published_steps:
            return []
        if steps != self._seen_steps:
            self._seen_steps, self._seen_at = steps, now
        slow = state.interval_s > _SLOW_S
        # Of the first instant it is not known yet which cameras have frames: all may.
        unheard = (
            state.scan is not None and state.scan.prior_ns is None and len(state.cameras) < len(self.tracker.cameras)
        )
        if slow and (unheard or not state.scan_complete) and now - self._seen_at < _WAIT * state.interval_s:
            return []  # at few frames a second, the cameras of an instant are awaited
        self._next, self._published_steps = now + _INTERVAL_S, steps
        published_ns, self._published_ns = self._published_ns, state.time_ns
        every_ns = round(_INTERVAL_S * NANOSECONDS)
        # If a busy machine delayed the hub, the missed times are published now, so that tracks have no gaps.
        states_since = [] if published_ns is None else self.tracker.states_since(published_ns, every_ns)
        self._update_scale()
        out: list[Message] = [track for each in (*states_since, state) for track in self._tracks(each)]
        ahead = state.time_ns + round(_AHEAD_S * NANOSECONDS)
        cameras, parameters = self.tracker.cameras, self.tracker.parameters
        number, self._predictions = self._predictions, self._predictions + 1
        if self.predicts:
            targets = self.tracker.predicted_at(ahead)
            out.append(prediction_message(targets, ahead, cameras, self._boot_ids, parameters, number))
        else:
            self._shed["shed.predictions"] += 1
        return out

    def _numbered(self, tracks: list[pb.Track]) -> list[pb.Track]:
        """The messages with their sequence numbers."""
        for message in tracks:
            message.sequence, self._sequence = self._sequence, self._sequence + 1
        return tracks

    def gauges(self) -> dict[str, float]:
        """Gauges for the hub's status."""
        targets = self.tracker.targets
        return {"tracks": float(targets.confirmed.sum()), "tentative_tracks": float((~targets.confirmed).sum())}

    def _tracks(self, state: MultiTargetState) -> list[pb.Track]:
        """Track messages of a state, including state "lost" for published tracks that have ended."""
        assert state.time_ns is not None
        lost = np.isin(state.lost.number, list(self._published))
        ended = state.lost.select(lost), state.lost_ns[lost]
        out = track_messages(state.targets, state.time_ns, ended, self.tracker.parameters, self._sequence)
        self._sequence += len(out)
        self._published = set(state.targets.number[state.targets.confirmed].tolist())
        return out

    def _estimated_up(self) -> Floats | None:
        return self._vertical.estimate({name: camera.pose for name, camera in self.tracker.cameras.items()})

    def _set_parameters(self, up: Floats | None) -> None:
        self.tracker.set_parameters(replace(self.tracker.parameters, up=up, scale=self._scale))

    def _update_scale(self) -> None:
        """With arbitrary scale, estimate the world units per metre from the heights of tracked people."""
        if self._scale.metric or self.tracker.parameters.up is None:
            return
        found = scale_of_people(self.tracker.targets, self._scale)
        if found is not self._scale:
            self._scale = found
            self._set_parameters(self.tracker.parameters.up)


def scale_of_people(targets: Targets, scale: LengthScale) -> LengthScale:
    """The scale of a world without units, by the heights of its confirmed people; ``scale`` within a tenth of it."""
    sizes = np.exp(targets.mean[targets.confirmed & (targets.kind == 0), LOG_SIZE])
    units_per_m = float(np.median(sizes)) / PERSON.size_m if len(sizes) else scale.units_per_m
    return scale if abs(np.log(units_per_m / scale.units_per_m)) <= 0.1 else LengthScale(units_per_m, False)


def guessed_units_per_m(cameras: Mapping[str, TrackingCamera]) -> float:
    """Guess of the world units per metre, for cameras spaced as in a room."""
    places = np.array([camera.pose.position for camera in cameras.values()])
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    distances = distances[distances > 0.0]
    return float(np.median(distances)) / _TYPICAL_SPACING_M if len(distances) else 1.0


def _gauge_change(old: Mapping[str, TrackingCamera], new: Mapping[str, TrackingCamera]) -> Similarity | None:
    """Similarity between the world frames of two calibrations; None if they are the same."""
    common = [name for name in new if name in old]
    if not common:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    before, after = [old[name].pose for name in common], [new[name].pose for name in common]
    if all(_is_same_pose(a, b) for a, b in zip(before, after, strict=True)):
        return None
    span = max(float(np.ptp(np.array([pose.position for pose in before]), axis=0).max()), 1e-9)
    # Points on the cameras' axes, at the scale of the rig, fix the rotation that few camera positions leave free.
    source = np.concatenate([np.vstack([p.position, p.position + 0.5 * span * p.rotation]) for p in before])
    ends = np.array([p.position for p in after])
    scale_ratio = 1.0
    if len(common) > 1:
        centres = np.array([p.position for p in before])
        scale_ratio = float(np.ptp(ends, axis=0).max() and np.linalg.norm(ends - ends.mean(axis=0)))
        scale_ratio /= max(float(np.linalg.norm(centres - centres.mean(axis=0))), 1e-12)
    target = np.concatenate(
        [np.vstack([p.position, p.position + 0.5 * span * scale_ratio * p.rotation]) for p in after]
    )
    return fit_similarity(source, target)


def _is_same_pose(one: Pose, other: Pose) -> bool:
    angle = so3.angle_between(one.rotation, other.rotation)
    return bool(np.abs(one.position - other.position).max() < _POSITION_TOLERANCE and angle < _ANGLE_TOLERANCE)
