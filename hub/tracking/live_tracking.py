"""Tracking while cameras stream: takes observations and calibrations, gives tracks and predictions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from google.protobuf.message import Message

from hub.tracking.association.initiation import Scale
from hub.tracking.calibration.vertical import UpFinder
from hub.tracking.camera_frame import TrackingCamera, tracked_kind
from hub.tracking.filter.kalman import LOG_SIZE
from hub.tracking.filter.target_models import PERSON
from hub.tracking.filter.target_states import State
from hub.tracking.messages import prediction_message, track_messages
from hub.tracking.tracker import Tracker
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity, fit_similarity
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration

_METRES = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_ROOM_M = 5.0
"""How far apart cameras of unknown scale are taken to be, until people tell it by their height."""
_MOVED, _TURNED = 1e-6, 1e-6
_UP_EVERY = 20


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """interval_s: between two tellings. lag_s: how much later than another camera's an observation may come.

    ahead_s: how far ahead of the newest frame predictions are.
    """

    interval_s: float = 0.05
    lag_s: float = 0.5
    ahead_s: float = 0.1


class LiveTracking:
    """The tracker and what it needs of the world, live: which way up is, how large a metre is."""

    def __init__(self, settings: TrackingSettings | None = None) -> None:
        self.settings = settings or TrackingSettings()
        self.tracker = Tracker(lag_s=self.settings.lag_s)
        self._finder = UpFinder()
        self._known_up: Floats | None = None
        self._scale = Scale()
        self._boots: dict[str, str] = {}
        self._sequence = 0
        self._predictions = 0
        self._next = -float("inf")
        self._told_ns: int | None = None
        self._told: set[int] = set()
        self._heard = 0
        self._clock: tuple[str, str] | None = None
        self.heard_any = False

    @property
    def counters(self) -> Counter[str]:
        """Frames by what became of them."""
        return self.tracker.counters

    def calibrate(
        self,
        cameras: Mapping[str, CameraCalibration],
        boots: Mapping[str, str],
        *,
        reference: str,
        scale: str,
        units: str,
        up: Floats | None,
    ) -> None:
        """Take over a calibration. boots: whose clocks it speaks of, "" = any. reference: whose clock all times are on.

        up: of its world; None = not known.
        """
        clock = (reference, boots.get(reference, ""))
        if clock != self._clock and self._clock is not None:
            self.tracker.forget()  # all times mean something else now
        self._clock = clock
        new = {name: TrackingCamera.of(camera, boots.get(name, "")) for name, camera in cameras.items()}
        change = None
        if self.tracker.cameras:
            change = _change(self.tracker.cameras, new)
        metric = scale == "metric"
        metre = _METRES.get(units, 1.0) if metric else _guess(new)
        if not metric and not self._scale.metric and change is not None:
            metre = self._scale.metre * change.scale
        elif not metric and not self._scale.metric and self.tracker.cameras:
            metre = self._scale.metre
        self._scale = Scale(metre, metric)
        self._known_up = up
        self.tracker.calibrate(new, change)
        self._set_world(up if up is not None else self._found_up())

    def handle(self, message: Message) -> None:
        """Take one observation; other messages are ignored."""
        if not isinstance(message, pb.Observation):
            return
        if not self.heard_any:
            self.heard_any = any(tracked_kind(detection) for detection in message.detections)
            if not self.heard_any:
                return
        if not self.tracker.cameras:
            return
        camera = self.tracker.cameras.get(message.camera)
        self._boots[message.camera] = message.boot_id
        if self.tracker.handle(message) and camera is not None and self._known_up is None:
            frame = self.tracker.newest_taken
            assert frame is not None
            self._finder.handle(frame)
            self._heard += 1
            if self._heard % _UP_EVERY == 0 and self.tracker.world.up is None:
                up = self._found_up()
                if up is not None:
                    self._set_world(up)

    def tick(self, now: float) -> list[Message]:
        """Tracks and predictions, at most every ``interval_s``; now: any monotonic clock [s]."""
        if now < self._next or not self.tracker.cameras or not self.heard_any:
            return []
        self._next = now + self.settings.interval_s
        state = self.tracker.advance()
        if state.time_ns is None or state.time_ns == self._told_ns:
            return []
        told_ns, self._told_ns = self._told_ns, state.time_ns
        every_ns = round(self.settings.interval_s * NANOSECONDS)
        # Where a busy machine held the hub up, its tracks have no hole all the same.
        passed = [] if told_ns is None else self.tracker.passed(told_ns, every_ns)
        self._learn_scale()
        out: list[Message] = [track for each in (*passed, state) for track in self._tracks(each)]
        ahead = state.time_ns + round(self.settings.ahead_s * NANOSECONDS)
        cameras, world = self.tracker.cameras, self.tracker.world
        out.append(prediction_message(self.tracker.at(ahead), ahead, cameras, self._boots, world, self._predictions))
        self._predictions += 1
        return out

    def gauges(self) -> dict[str, float]:
        """Figures for the hub's status."""
        targets = self.tracker.targets
        return {"tracks": float(targets.confirmed.sum()), "tentative_tracks": float((~targets.confirmed).sum())}

    def _tracks(self, state: State) -> list[pb.Track]:
        """What is told of a state; who was told before and is no more, is told to be lost."""
        assert state.time_ns is not None
        lost = tuple(one for one in state.gone if one.number in self._told)
        out = track_messages(state.targets, state.time_ns, lost, self.tracker.world, self._sequence)
        self._sequence += len(out)
        self._told = set(state.targets.number[state.targets.confirmed].tolist())
        return out

    def _found_up(self) -> Floats | None:
        return self._finder.find({name: camera.pose for name, camera in self.tracker.cameras.items()})

    def _set_world(self, up: Floats | None) -> None:
        self.tracker.set_world(replace(self.tracker.world, up=up, scale=self._scale))

    def _learn_scale(self) -> None:
        """With arbitrary scale, people tell how large a metre is: as tall as people are."""
        if self._scale.metric or self.tracker.world.up is None:
            return
        targets = self.tracker.targets
        tall = np.exp(targets.mean[targets.confirmed & (targets.kind == 0), LOG_SIZE])
        if len(tall):
            metre = float(np.median(tall)) / PERSON.size_m
            if abs(np.log(metre / self._scale.metre)) > 0.1:
                self._scale = Scale(metre, False)
                self._set_world(self.tracker.world.up)


def _guess(cameras: Mapping[str, TrackingCamera]) -> float:
    """World units in a metre, if cameras stand about a room."""
    places = np.array([camera.pose.position for camera in cameras.values()])
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    apart = apart[apart > 0.0]
    return float(np.median(apart)) / _ROOM_M if len(apart) else 1.0


def _change(old: Mapping[str, TrackingCamera], new: Mapping[str, TrackingCamera]) -> Similarity | None:
    """How the world has moved between two calibrations; None where it has not."""
    common = [name for name in new if name in old]
    if not common:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    before, after = [old[name].pose for name in common], [new[name].pose for name in common]
    if all(_same(a, b) for a, b in zip(before, after, strict=True)):
        return None
    span = max(float(np.ptp(np.array([pose.position for pose in before]), axis=0).max()), 1e-9)
    # A camera's axes, as long as the rig, fix what few cameras' places leave open.
    source = np.concatenate([np.vstack([p.position, p.position + 0.5 * span * p.rotation]) for p in before])
    ends = np.array([p.position for p in after])
    stretch = 1.0
    if len(common) > 1:
        centres = np.array([p.position for p in before])
        stretch = float(np.ptp(ends, axis=0).max() and np.linalg.norm(ends - ends.mean(axis=0)))
        stretch /= max(float(np.linalg.norm(centres - centres.mean(axis=0))), 1e-12)
    target = np.concatenate([np.vstack([p.position, p.position + 0.5 * span * stretch * p.rotation]) for p in after])
    return fit_similarity(source, target)


def _same(one: Pose, other: Pose) -> bool:
    turned = so3.angle_between(one.rotation, other.rotation)
    return bool(np.abs(one.position - other.position).max() < _MOVED and turned < _TURNED)
