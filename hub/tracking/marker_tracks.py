"""Live tracks of labelled markers: one Kalman filter and one fixed-lag smoother a label, over asynchronous cameras."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from functools import partial
from itertools import groupby, pairwise

from hub.tracking.detections import TrackingCamera, tracked_kind
from hub.tracking.filter.marker_rows import MarkerRow, marker_row
from hub.tracking.lag_buffer import LagBuffer
from hub.tracking.marker_filter import MarkerState, misfit, process_row, smooth_states
from hub.tracking.messages import MARKER_COASTING_AFTER_S, marker_message
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.pose import Similarity
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import DEFAULT_LABEL

_MAX_AHEAD_NS = 5 * NANOSECONDS
"""Cameras whose times differ by more do not agree; a row further ahead of the others is not used."""
_SAMPLE_NS = NANOSECONDS // 30
"""Between two smoothed samples, and between those that a delayed hub publishes afterwards."""
_BATCH_NS = NANOSECONDS // 10
"""One backward pass of the smoother serves the samples of this time."""
_MAX_ROWS_PER_S = 500
"""Of one camera and label; more are a fault, and would cost the others their time."""
_MAX_LABELS_PER_CAMERA = 64
"""Labels that one camera may have introduced and that have no track yet."""
_NEVER_NS = -(2**62)  # before every time stamp, and differences do not overflow
_MAX_SMOOTHED = 4096
"""Smoothed messages that are kept for a caller who does not take them."""


class MarkerTracks:
    """Tracks every label of labelled markers.

    lag_s: how far behind the newest row of its label a row may be and still be used; also the smoother's lag. coast_s:
    how long a track is kept without rows. interval_s: between two messages of a marker that no camera sees.
    """

    def __init__(self, lag_s: float, coast_s: float, interval_s: float) -> None:
        self.cameras: dict[str, TrackingCamera] = {}
        self.counters: Counter[str] = Counter()
        self.smooths = True
        """Whether tracks are smoothed; messages left out are counted as ``shed.smoothed``."""
        self._times_ns = tuple(round(seconds * NANOSECONDS) for seconds in (lag_s, coast_s, interval_s))
        self._coast_s = coast_s
        self._early: dict[str, deque[pb.Observation]] = {}
        self._boot_ids: dict[str, str] = {}
        self._newest_ns: dict[str, int] = {}
        self._labels: dict[str, _LabelTrack] = {}
        self._smoothed: deque[pb.Track] = deque(maxlen=_MAX_SMOOTHED)
        self._heard: dict[str, float] = {}
        self._fresh: set[str] = set()
        self._last = ""  # the camera of the last frame

    def calibrate(self, cameras: Mapping[str, TrackingCamera], change: Similarity | None) -> None:
        """Use a new calibration; the kept rows are processed again with it.

        change: similarity from the old to the new world frame that the poses suggest, None = the same frame.
        """
        self.cameras = dict(cameras)
        for track in self._labels.values():
            track.calibrate(self.cameras, change)
        self._newest_ns = {name: time for name, time in self._newest_ns.items() if name in self.cameras}
        for name in [name for name in self._early if name in self.cameras]:
            for message in self._early.pop(name):
                self.handle(message)

    def reset(self) -> None:
        """Forget all tracks and rows, as after a change of the reference clock."""
        self._labels.clear()
        self._newest_ns.clear()

    def handle(self, message: pb.Observation) -> None:
        """Insert the labelled detections of one frame; `tick` processes them."""
        camera = self.cameras.get(message.camera)
        if camera is None:
            self._keep(message)
            return
        # After a restart a camera has another clock, to which the calibration does not apply.
        boot = camera.boot_id or self._boot_ids.setdefault(message.camera, message.boot_id)
        if message.boot_id != boot:
            self.counters["marker.unknown_clock"] += 1
            return
        if not self._is_plausible(message.camera, camera.reference_ns(message.device_time_ns)):
            self.counters["marker.ahead"] += 1
            return
        best: dict[str, pb.Detection] = {}
        for detection in message.detections:
            label = detection.label or DEFAULT_LABEL
            if not tracked_kind(detection) and not (label in best and best[label].score >= detection.score):
                best[label] = detection
        for label, detection in best.items():
            row = marker_row(camera, message.device_time_ns, message.boot_id, message.sequence, detection)
            track = self._labels.get(label) or self._introduced(label, message.camera)
            self.counters["marker.unusable" if row is None or track is None else f"marker.{track.insert(row)}"] += 1

    def tick(self, now: float) -> list[pb.Track]:
        """Messages, without sequence numbers, of all labels with news; now: any monotonic clock [s]."""
        self._heard |= dict.fromkeys(self._fresh, now)
        self._fresh.clear()
        alive = {name: time for name, time in self._newest_ns.items() if now - self._heard[name] <= self._coast_s}
        # A camera that fell silent must not hold the others' time.
        self._newest_ns = alive or self._newest_ns
        newest = self._consensus_ns()
        if newest is None:
            return []
        out = []
        for label, track in list(self._labels.items()):
            self.counters["marker.steps"] += track.advance(newest)
            if self.smooths:
                self._smoothed.extend(track.smoothed(newest))
            else:
                self.counters["shed.smoothed"] += track.skip_smoothed(newest)
            out += track.messages(newest, not alive)
            if track.is_over(newest):
                del self._labels[label]
        return out

    def smoothed(self) -> list[pb.Track]:
        """The smoothed messages, without sequence numbers, since the last call."""
        out = list(self._smoothed)
        self._smoothed.clear()
        return out

    def _keep(self, message: pb.Observation) -> None:
        """Keep the last frames of a camera that is not calibrated yet, so that tracks begin with the calibration."""
        lag_ns, early = self._times_ns[0], self._early.get(message.camera)
        if early is None:
            early = self._early[message.camera] = deque(maxlen=_MAX_ROWS_PER_S * lag_ns // NANOSECONDS)
        early.append(message)
        now_ns = message.device_time_ns
        while abs(now_ns - early[0].device_time_ns) > lag_ns:
            early.popleft()

    def _is_plausible(self, name: str, reference_ns: int) -> bool:
        """Whether a frame's time is plausible: one camera's wrong clock must not make all others late."""
        self._newest_ns[name] = reference_ns
        self._fresh.add(name)
        witness, self._last = self._last, name
        # With a camera that agrees the consensus is no earlier; to sort the times of a thousand takes 50 µs.
        if witness != name and abs(self._newest_ns.get(witness, _NEVER_NS) - reference_ns) <= _MAX_AHEAD_NS:
            return True
        newest = self._consensus_ns()
        return newest is not None and reference_ns <= newest + _MAX_AHEAD_NS

    def _consensus_ns(self) -> int | None:
        """The newest reference time on which two cameras agree; without such a pair the oldest."""
        times = sorted(self._newest_ns.values(), reverse=True)
        agreed = (earlier for later, earlier in pairwise(times) if later - earlier <= _MAX_AHEAD_NS)
        return next(agreed, times[-1] if times else None)

    def _introduced(self, label: str, camera: str) -> _LabelTrack | None:
        """A track for a new label, unless its camera floods the tracker with labels."""
        waiting = sum(track.camera == camera and not track.state.serial for track in self._labels.values())
        if waiting >= _MAX_LABELS_PER_CAMERA:
            return None
        self._labels[label] = _LabelTrack(label, camera, *self._times_ns)
        return self._labels[label]


class _LabelTrack:
    """The rows and states of one label, and what was published of it. camera: the first that saw it."""

    def __init__(self, label: str, camera: str, lag_ns: int, coast_ns: int, interval_ns: int) -> None:
        self.camera = camera
        self._label, self._lag_ns, self._coast_ns, self._interval_ns = label, lag_ns, coast_ns, interval_ns
        process = partial(process_row, coast_ns=coast_ns)
        self._keep_ns = lag_ns + 2 * _BATCH_NS
        self._rows: LagBuffer[MarkerRow, MarkerState] = LagBuffer(MarkerState(), process, lag_ns, self._keep_ns)
        self._published_ns = self._smoothed_ns = _NEVER_NS
        self._shown: MarkerState | None = None

    @property
    def state(self) -> MarkerState:
        """The state after all processed rows."""
        return self._rows.state

    def calibrate(self, cameras: Mapping[str, TrackingCamera], change: Similarity | None) -> None:
        """Process the kept rows again with another calibration."""
        rows, pairs = [], []
        for number, old in enumerate(self._rows.rows):
            row = old.seen_by(cameras[old.camera.name]) if old.camera.name in cameras else None
            if row is not None:
                rows.append(row)
                state = self._rows.states[number] if number < len(self._rows.states) else MarkerState()
                if len(state.mean) and state.time_ns == old.reference_ns:
                    pairs.append((row, state))
        base = self._rows.base
        # Refined poses in a held gauge look like a small change of gauge: the rows decide.
        if change is not None and (not pairs or misfit(pairs, change) < misfit(pairs, None)):
            base = base.transformed(change)
        self._rows.restart(base, rows)

    def insert(self, row: MarkerRow) -> str:
        """Insert a row; how it was handled."""
        if self._rows.counts[row.camera.name] >= _MAX_ROWS_PER_S * self._keep_ns // NANOSECONDS:
            return "flood"
        return self._rows.insert(row)

    def advance(self, newest_ns: int) -> int:
        """Process the pending rows; newest_ns: reference time that frames have reached. The number of rows."""
        own = self._rows.newest_ns
        if own is not None and own > newest_ns + _MAX_AHEAD_NS:
            # The first camera's clock was wrong, as the second one shows.
            self._rows.clear(MarkerState())
        return self._rows.advance()

    def messages(self, newest_ns: int, silent: bool) -> list[pb.Track]:
        """The messages since the last call. silent: no frame has arrived for longer than tracks coast."""
        state = self.state
        if not len(state.mean) or silent or newest_ns - state.time_ns > self._coast_ns:
            shown, self._shown = self._shown, None
            if shown is None:
                return []
            lost = marker_message(self._label, shown, max(newest_ns, self._published_ns))
            lost.state = "lost"
            return [lost]
        due, coasting_ns = [], round(MARKER_COASTING_AFTER_S * NANOSECONDS)
        if state.time_ns > self._published_ns:
            missed: list[MarkerState] = []
            if self._shown is not None and state.time_ns - self._published_ns > self._interval_ns:
                # A busy machine delayed the hub: the missed times are published now, so that tracks have no gaps.
                missed = self._accepted(self._published_ns, state.time_ns - _SAMPLE_NS)
            due = [(one, one.time_ns) for one in (*missed, state)]
        elif newest_ns > max(state.time_ns + coasting_ns, self._published_ns + self._interval_ns):
            due = [(state, newest_ns)]
        if due:
            self._shown, self._published_ns = due[-1]
        return [marker_message(self._label, one, time_ns) for one, time_ns in due]

    def smoothed(self, newest_ns: int) -> list[pb.Track]:
        """The smoothed messages at least the lag before ``newest_ns``, in batches; forgets the rows behind them."""
        until = max(newest_ns, self._rows.newest_ns or newest_ns) - self._lag_ns
        out: list[pb.Track] = []
        if until > self._smoothed_ns + _BATCH_NS:
            due = {id(state) for state in self._accepted(self._smoothed_ns, until)}
            chain = self._accepted(self._smoothed_ns, None) if due else []
            for _, states in groupby(chain, lambda state: state.serial):
                track = list(states)
                wanted = max((number + 1 for number, state in enumerate(track) if id(state) in due), default=0)
                for state, mean, covariance in zip(track, *smooth_states(track, wanted), strict=False):
                    if id(state) in due:
                        self._smoothed_ns = state.time_ns
                        out.append(marker_message(self._label, state, state.time_ns, (mean, covariance)))
        self._rows.forget()
        return out

    def skip_smoothed(self, newest_ns: int) -> int:
        """Leave the smoothed messages out that are due, and forget the rows behind them; their number."""
        due = self._accepted(self._smoothed_ns, max(newest_ns, self._rows.newest_ns or newest_ns) - self._lag_ns)
        self._smoothed_ns = due[-1].time_ns if due else self._smoothed_ns
        self._rows.forget()
        return len(due)

    def is_over(self, newest_ns: int) -> bool:
        """Whether nothing is left to publish or to track."""
        return self._shown is None and newest_ns - (self._rows.newest_ns or newest_ns) > self._coast_ns

    def _accepted(self, after_ns: int, until_ns: int | None) -> list[MarkerState]:
        """The states after accepted rows in a span of time; with an end, at least a sample's time apart."""
        states = self._rows.states
        begin = min(self._rows.count_until(after_ns), len(states))  # a state is no newer than its row
        out, last = [], states[begin - 1] if begin else self._rows.base
        for state in states[begin:]:
            is_new = len(state.mean) > 0 and (state.hits, state.serial) != (last.hits, last.serial)
            last = state
            if is_new and state.time_ns > after_ns:
                if until_ns is None:
                    out.append(state)
                elif state.time_ns <= until_ns and state.time_ns >= after_ns + _SAMPLE_NS:
                    out.append(state)
                    after_ns = state.time_ns
        return out
