"""The tracker: frames in any order in, targets out. What comes late is put in its place and the rest done again."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import replace

import numpy as np

from hub.tracking.camera_frame import Frame, TrackingCamera, frame_of
from hub.tracking.filter.target_states import State, Targets
from hub.tracking.filter.update import World, moved, step
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.pose import Similarity
from protocols.messages import syncline_pb2 as pb

_AHEAD_NS = 5 * NANOSECONDS
"""A frame so far ahead of all others' is believed only when a second camera says so too."""


class Tracker:
    """Follows what moves through calibrated cameras.

    lag_s: how far behind the newest frame another may come and still count. The answer is a function of the frames of
    which none came later than that, not of the order in which they came. Memory: the frames of the lag, the
    targets, and what was lost lately.
    """

    def __init__(self, world: World | None = None, lag_s: float = 0.5) -> None:
        self.world = world or World()
        self.cameras: dict[str, TrackingCamera] = {}
        self.counters: Counter[str] = Counter()
        self._lag_ns = round(lag_s * NANOSECONDS)
        self._base = State.empty()
        self._base_key: tuple[int, str, str, int] | None = None
        self._keys: list[tuple[int, str, str, int]] = []
        self._frames: list[Frame] = []
        self._states: list[State] = []
        self._done = 0
        self._boots: dict[str, str] = {}
        self._ahead: dict[str, int] = {}
        self.newest_taken: Frame | None = None

    def set_world(self, world: World) -> None:
        """Know more of the world from here on: what is done stays done."""
        self.advance()
        self._settle()
        self.world = world

    def calibrate(self, cameras: dict[str, TrackingCamera], change: Similarity | None = None) -> None:
        """Take over a new calibration. change: from the old world to the new, where the gauge has moved."""
        self.advance()
        self._settle()
        if change is not None:
            self._base = carried(self._base, change)
        self.cameras = dict(cameras)

    def forget(self) -> None:
        """Begin anew: no target, no name."""
        self._base, self._base_key = State.empty(), None
        self._keys, self._frames, self._states, self._done = [], [], [], 0
        self._ahead.clear()

    @property
    def state(self) -> State:
        """After all frames that were done."""
        return self._states[self._done - 1] if self._done else self._base

    @property
    def boots(self) -> dict[str, str]:
        """By camera, the boot whose clock the calibration is taken to speak of."""
        return {name: camera.boot_id or self._boots.get(name, "") for name, camera in self.cameras.items()}

    @property
    def targets(self) -> Targets:
        """At `time_ns`."""
        return self.state.targets

    @property
    def time_ns(self) -> int | None:
        """Reference time of the newest frame that was done."""
        return self.state.time_ns

    def handle(self, message: pb.Observation) -> bool:
        """Take one camera's frame; True if it counts. `advance` does the work."""
        camera = self.cameras.get(message.camera)
        if camera is None:
            self.counters["track.uncalibrated"] += 1
            return False
        # A camera that was restarted has another clock, which the calibration does not know.
        boot = camera.boot_id or self._boots.setdefault(message.camera, message.boot_id)
        if message.boot_id != boot:
            self.counters["track.unknown_clock"] += 1
            return False
        return self.take(frame_of(camera, message))

    def take(self, frame: Frame) -> bool:
        """Put a frame in its place; False if it is late, a duplicate, or in no believable time."""
        key = frame.key
        newest = self._keys[-1][0] if self._keys else None if self._base_key is None else self._base_key[0]
        if newest is not None and not self._believed(frame, newest):
            self.counters["track.ahead"] += 1
            return False
        if self._base_key is not None and key <= self._base_key:
            self.counters["track.late"] += 1
            return False
        place = bisect_left(self._keys, key)
        if place < len(self._keys) and self._keys[place] == key:
            self.counters["track.duplicates"] += 1
            return False
        if newest is not None and key[0] < newest - self._lag_ns:
            self.counters["track.late"] += 1
            return False
        self.counters["track.frames"] += 1
        if place < len(self._keys):
            self.counters["track.reordered"] += 1
        self._keys.insert(place, key)
        self._frames.insert(place, frame)
        self.newest_taken = frame
        if self._done > place:
            del self._states[place:]
            self._done = place
        return True

    def advance(self) -> State:
        """Do all frames that are not done yet, in order; forget what is older than the lag."""
        while self._done < len(self._frames):
            before = self._states[self._done - 1] if self._done else self._base
            self._states.append(step(before, self._frames[self._done], self.cameras, self.world))
            self._done += 1
            self.counters["track.steps"] += 1
        if self._keys:
            old = bisect_right(self._keys, (self._keys[-1][0] - self._lag_ns, "", "", 0))
            if old:
                self._base, self._base_key = self._states[old - 1], self._keys[old - 1]
                del self._keys[:old], self._frames[:old], self._states[:old]
                self._done -= old
        return self.state

    def passed(self, after_ns: int, every_ns: int) -> list[State]:
        """The states between ``after_ns`` and the present one, at least ``every_ns`` apart; none older than the lag.

        A hub that was held up can tell them afterwards.
        """
        out: list[State] = []
        for state in self._states[: max(self._done - 1, 0)]:
            time_ns = state.time_ns or 0
            if time_ns >= after_ns + every_ns and (self.time_ns or 0) - time_ns >= every_ns:
                out.append(state)
                after_ns = time_ns
        return out

    def at(self, reference_ns: int) -> Targets:
        """The targets at another time, about that of the newest frame; nothing is learnt or forgotten by it."""
        if self.time_ns is None:
            return self.targets
        return moved(self.targets, (reference_ns - self.time_ns) / NANOSECONDS, self.world)

    def _settle(self) -> None:
        """Nothing before this moment will be done again: it was done with what was known then."""
        self._base = self.state
        self._base_key = self._keys[-1] if self._keys else self._base_key
        self._keys, self._frames, self._states, self._done = [], [], [], 0

    def _believed(self, frame: Frame, newest: int) -> bool:
        """Whether a frame's time can be: one camera's clock gone wrong must not make all others late."""
        if frame.reference_ns <= newest + _AHEAD_NS:
            self._ahead.pop(frame.camera.name, None)
            return True
        self._ahead[frame.camera.name] = frame.reference_ns
        near = [t for t in self._ahead.values() if abs(t - frame.reference_ns) < _AHEAD_NS]
        if len(near) < min(2, len(self.cameras)):
            return False
        self._ahead.clear()
        return True


def carried(state: State, change: Similarity) -> State:
    """A state in another world. What waits to found a target is dropped: its camera has moved."""
    targets = state.targets
    turn = np.eye(7)
    turn[:3, :3] = turn[3:6, 3:6] = change.scale * change.rotation
    mean = targets.mean @ turn.T
    mean[:, :3] += change.shift
    mean[:, 6] += np.log(change.scale)
    gone = []
    for one in state.gone:
        moved_mean = turn @ one.mean
        moved_mean[:3] += change.shift
        moved_mean[6] += np.log(change.scale)
        gone.append(replace(one, mean=moved_mean))
    new = replace(targets, mean=mean, covariance=turn @ targets.covariance @ turn.T)
    return replace(state, targets=new, pool={}, fresh={}, gone=tuple(gone), floor=0.0, floor_weight=0.0)
