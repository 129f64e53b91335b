"""Multi-target tracker with out-of-sequence frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from hub.tracking.detections import FrameDetections, TrackingCamera, frame_detections
from hub.tracking.filter.prediction import predict_targets
from hub.tracking.filter.target_states import Encounters, MultiTargetState, Targets
from hub.tracking.frame_update import concluded, jointly, process_frame
from hub.tracking.lag_buffer import LagBuffer
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.pose import Similarity
from protocols.messages import syncline_pb2 as pb

_MAX_AHEAD_NS = 5 * NANOSECONDS
"""A frame further ahead than this of all others is accepted only when a second camera agrees."""


class Tracker:
    """Tracks targets through calibrated, asynchronous cameras.

    lag_s: how far behind the newest frame a frame may be and still be used (fixed-lag reprocessing). The state depends
    only on the frames that arrived within this lag, not on their order of arrival. Memory holds the frames of the lag,
    the targets, and recently lost tracks.
    """

    def __init__(self, parameters: TrackerParameters | None = None, lag_s: float = 0.5) -> None:
        self.parameters = parameters or TrackerParameters()
        self.cameras: dict[str, TrackingCamera] = {}
        self.counters: Counter[str] = Counter()
        lag_ns = round(lag_s * NANOSECONDS)
        self._frames: LagBuffer[FrameDetections, MultiTargetState] = LagBuffer(
            MultiTargetState.empty(),
            lambda state, frame: process_frame(state, frame, self.cameras, self.parameters),
            lag_ns,
            lag_ns,
        )
        self._joint: tuple[MultiTargetState, MultiTargetState] | None = None
        self._boot_ids: dict[str, str] = {}
        self._ahead_ns: dict[str, int] = {}
        self.newest_frame: FrameDetections | None = None

    def set_parameters(self, parameters: TrackerParameters) -> None:
        """Use other parameters from now on; processed frames are not reprocessed."""
        self.advance()
        self._frames.commit()
        self.parameters = parameters

    def calibrate(self, cameras: dict[str, TrackingCamera], change: Similarity | None = None) -> None:
        """Use a new calibration. change: similarity from the old to the new world frame, None = the same frame."""
        self.advance()
        self._frames.commit()
        if change is not None:
            self._frames.base = transform_state(self._frames.base, change)
        self.cameras = dict(cameras)

    def reset(self) -> None:
        """Forget all targets, tracks and frames."""
        self._frames.clear(MultiTargetState.empty())
        self._ahead_ns.clear()

    @property
    def state(self) -> MultiTargetState:
        """The state after all processed frames."""
        state = self._frames.state
        if self._joint is None or self._joint[0] is not state:
            known = concluded if state.scan_complete else jointly
            self._joint = state, known(state, self.parameters)
        return self._joint[1]

    @property
    def boot_ids(self) -> dict[str, str]:
        """By camera, the boot id of the clock that the calibration refers to."""
        return {name: camera.boot_id or self._boot_ids.get(name, "") for name, camera in self.cameras.items()}

    @property
    def targets(self) -> Targets:
        """The targets at `time_ns`."""
        return self.state.targets

    @property
    def time_ns(self) -> int | None:
        """Reference time of the newest processed frame."""
        return self.state.time_ns

    def handle(self, message: pb.Observation) -> bool:
        """Insert one camera's frame; True if it is used. `advance` processes it."""
        camera = self.cameras.get(message.camera)
        if camera is None:
            self.counters["track.uncalibrated"] += 1
            return False
        # After a restart a camera has another clock, to which the calibration does not apply.
        boot = camera.boot_id or self._boot_ids.setdefault(message.camera, message.boot_id)
        if message.boot_id != boot:
            self.counters["track.unknown_clock"] += 1
            return False
        return self.insert(frame_detections(camera, message))

    def insert(self, frame: FrameDetections) -> bool:
        """Insert a frame in order; False if it is late, a duplicate, or has an implausible time."""
        newest = self._frames.newest_ns
        if newest is not None and not self._is_plausible(frame, newest):
            self.counters["track.ahead"] += 1
            return False
        how = self._frames.insert(frame)
        if how in ("late", "duplicates"):
            self.counters[f"track.{how}"] += 1
            return False
        self.counters["track.frames"] += 1
        if how == "reordered":
            self.counters["track.reordered"] += 1
        self.newest_frame = frame
        return True

    def advance(self) -> MultiTargetState:
        """Process all pending frames in order; forget those older than the lag."""
        self.counters["track.steps"] += self._frames.advance()
        self._frames.forget()
        return self.state

    def states_since(self, after_ns: int, every_ns: int) -> list[MultiTargetState]:
        """The states between ``after_ns`` and the present one, at least ``every_ns`` apart; none older than the lag.

        A hub that was delayed publishes them afterwards.
        """
        out: list[MultiTargetState] = []
        for state in self._frames.states[:-1]:
            time_ns = state.time_ns or 0
            if time_ns >= after_ns + every_ns and (self.time_ns or 0) - time_ns >= every_ns:
                out.append(jointly(state, self.parameters))
                after_ns = time_ns
        return out

    def predicted_at(self, reference_ns: int) -> Targets:
        """The targets predicted to a reference time near that of the newest frame, without changing the tracker."""
        if self.time_ns is None:
            return self.targets
        return predict_targets(self.targets, (reference_ns - self.time_ns) / NANOSECONDS, self.parameters)

    def _is_plausible(self, frame: FrameDetections, newest: int) -> bool:
        """Whether a frame's time is plausible: one camera's wrong clock must not make all others late."""
        if frame.reference_ns <= newest + _MAX_AHEAD_NS:
            self._ahead_ns.pop(frame.camera.name, None)
            return True
        self._ahead_ns[frame.camera.name] = frame.reference_ns
        near = [t for t in self._ahead_ns.values() if abs(t - frame.reference_ns) < _MAX_AHEAD_NS]
        if len(near) < min(2, len(self.cameras)):
            return False
        self._ahead_ns.clear()
        return True


def transform_state(state: MultiTargetState, change: Similarity) -> MultiTargetState:
    """A state in another world frame. Unassociated detections are dropped, because their cameras have moved."""
    transform = np.eye(7)
    transform[:3, :3] = transform[3:6, 3:6] = change.scale * change.rotation
    offset = np.concatenate([change.shift, np.zeros(3), [np.log(change.scale)]])
    targets, lost = (
        replace(one, mean=one.mean @ transform.T + offset, covariance=transform @ one.covariance @ transform.T)
        for one in (state.targets, state.lost)
    )
    return replace(
        state, targets=targets, lost=lost, unassociated={}, last_frame_ns={}, floor=None, encounters=Encounters.empty()
    )
