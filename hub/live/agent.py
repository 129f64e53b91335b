"""The hub agent: a thin loop between the bus and the live estimator."""

from __future__ import annotations

import gc
import heapq
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing

from google.protobuf.message import Message

from hub.calibration.resection.unconnected import listed
from hub.distributed.network.host import ROLE as NODES
from hub.live.fair_share import FairShare, Shedding
from hub.live.live_hub import SILENT_S, LiveHub
from hub.live.messages import rig_message
from hub.live.shard import ROLE as SHARDS
from hub.live.shard import Shard
from protocols.bus.base import Bus, CommandSubscription, Publisher, Received, agent_status
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import Rig
from protocols.topics import (
    CALIBRATION,
    CAMERA_INFO,
    NODE_STATE,
    OBSERVATION,
    PART,
    PREDICTION,
    RIG_INFO,
    SHARD,
    SOLVER_EVENT,
    STATUS,
    TRACK,
    TRACK_SMOOTHED,
    Topic,
)

ROLE = "hub"
_TICK_S = 0.05  # s: of the hub's loop, below a frame at 15 Hz
_ROUND_S = 0.012
"""Least time between two rounds: observations that arrive closer together are processed together."""
_MESSAGES_S = 0.2
"""What the messages of a round may take together: tracks, and the status within 2 s, are published between rounds."""
_BACKLOG_S = 2.0
"""After its start a hub gets what cameras had published before, all at once."""
_FINISH_S, _FIRST_ANSWER_S = 5.0, 20.0
"""Longest wait for the last answer when the hub is stopped, and where it has none yet: the last one was kept."""
_PROGRESS_S = 2.0  # s: between two messages of progress
_STATUS_S = 1.0  # s: between two statuses
_RIG_S = 5.0  # s: between two looks at rig.toml
_MAX_TEXT = 2000  # characters of a status message
_NAMED_CAMERAS = 16  # that a status has counters of their own for
_MEASURED_CAMERAS = 64
"""That a status has gauges of their own for, the worst first: three each of the 256 numbers that one may have."""


def run_hub(
    hub: LiveHub,
    bus: Bus,
    agent: str,
    stop: threading.Event,
    *,
    rig: Rig | None = None,
    on_result: Callable[[LiveHub], None] | None = None,
    boot_id: str | None = None,
    beat: Callable[[], None] = lambda: None,
    export: Callable[[LiveHub], str] | None = None,
    shard: Shard | None = None,
) -> None:
    """Process messages, have them solved, and publish until ``stop`` is set; then once more with all data.

    on_result: called after every answer that was taken, a calibration or a refusal (to write files). beat: watchdog
    heartbeat, called after every round, so that a watchdog detects a hanging loop. export: writes the calibration on
    request of a view; returns a status text. shard: this hub's share of a site that several hubs calibrate together.
    """
    with ExitStack() as stack:
        running = _HubAgent(hub, bus, agent, boot_id or uuid.uuid4().hex, stack, shard)
        finish_by: float | None = None
        results, memory_frozen = hub.results, False
        freeze_garbage_collector()
        while True:
            if stop.is_set() and finish_by is None:
                finish_by = running.stop()
            running.receive()
            running.obey(export)
            now = time.monotonic()
            running.estimate(now, final=finish_by is not None and not hub.finished)
            if hub.results > results:
                results = hub.results
                if not memory_frozen:
                    memory_frozen = True
                    freeze_garbage_collector()
                if on_result is not None:
                    on_result(hub)
            last = finish_by is not None and (now >= finish_by or (hub.finished and not hub.solver.busy))
            running.report(now, rig, last=last)
            beat()
            if last:
                break
            if hub.calibration is None and finish_by is None:
                stop.wait(_TICK_S)  # nothing is published at the cameras' pace yet
            else:
                time.sleep(_ROUND_S)
                running.observations.wait(_TICK_S)


class _HubAgent:
    """The steps of a round, and what the hub has open on the bus; stack: closes it."""

    def __init__(
        self, hub: LiveHub, bus: Bus, agent: str, boot: str, stack: ExitStack, shard: Shard | None = None
    ) -> None:
        self._shard = shard
        self._hub, self._bus, self._agent, self._boot, self._stack = hub, bus, agent, boot, stack
        stack.callback(hub.solver.close)
        node_topics = () if hub.nodes is None else (NODE_STATE, CALIBRATION)
        shared = () if shard is None else (SHARD, PART, TRACK, *(() if node_topics else (CALIBRATION,)))
        topics = (CAMERA_INFO, OBSERVATION, STATUS, *node_topics, *shared)
        self._subscriptions = [stack.enter_context(closing(bus.subscribe(topic))) for topic in topics]
        self.observations = self._subscriptions[1]
        if shard is not None:
            self._subscriptions[topics.index(TRACK)].ignore({agent})
        self._prompt = [one for one, topic in zip(self._subscriptions, topics, strict=True) if topic in (SHARD, PART)]
        """Read before all else: few messages, which must not wait behind their hubs' tracks."""
        self._publishers = {
            "Calibration": self._publisher(CALIBRATION),
            "Track": self._publisher(TRACK, rate_hz=200.0),
            "SolverEvent": self._publisher(SOLVER_EVENT),
            "Prediction": self._publisher(PREDICTION),
            "RigInfo": self._publisher(RIG_INFO),
            "AgentStatus": self._publisher(STATUS),
        }
        if shard is not None:
            self._publishers |= {"part": self._publisher(PART), "shard": self._publisher(SHARD)}
            self._publishers |= {"calibration": self._publishers["Calibration"], "track": self._publishers["Track"]}
        self._smoothed = self._publisher(TRACK_SMOOTHED)
        self._node_publishers: dict[str, Publisher] = {}
        self._orders = stack.enter_context(
            closing(CommandSubscription(bus, agent, boot, ("recalibrate", "forget", "export")))
        )
        self._watch = None if hub.nodes is None and shard is None else stack.enter_context(closing(bus.watch_agents()))
        stack.enter_context(bus.announce(ROLE, agent, boot))
        if hub.nodes is not None:
            stack.enter_context(bus.announce(NODES, agent, boot))
        if shard is not None:
            stack.enter_context(bus.announce(SHARDS, agent, boot))
        self._shares = FairShare(self._handle, time.monotonic, _MESSAGES_S)
        self._shedding = Shedding()
        self._began = self._now = time.monotonic()
        self._sequence, self._next_status, self._next_rig, self._next_progress = 0, 0.0, 0.0, 0.0
        self._last_action = self._stopping = ""
        self._publish(hub.tick(self._began))  # what comes now has not waited since the machine began

    def _publisher(self, topic: Topic, rate_hz: float | None = None) -> Publisher:
        return self._stack.enter_context(closing(self._bus.publisher(topic, self._agent, rate_hz=rate_hz)))

    def _handle(self, received: Received) -> None:
        if self._shard is not None and not self._shard.admits(received.topic.name, received.agent, received.message):
            return
        if received.agent != self._agent or not isinstance(received.message, pb.Calibration):
            backlog = time.monotonic() < self._began + _BACKLOG_S
            self._hub.handle(received.message, received.arrival_ns * 1e-9, backlog=backlog)

    def _publish(self, messages: Iterable[Message]) -> None:
        shard = self._shard
        for topic, message in [("", one) for one in messages] if shard is None else shard.outgoing(messages):
            self._publishers[topic or message.DESCRIPTOR.name].put(message)

    def stop(self) -> float:
        """Wait for missing messages no longer, and say so; returns until when the last answer is awaited."""
        for subscription in self._subscriptions:
            subscription.flush()
        wait_s = _FIRST_ANSWER_S if self._hub.calibration is None else _FINISH_S
        self._stopping, self._next_status = f"waits {wait_s:.0f} s at most for a last answer", 0.0
        return time.monotonic() + wait_s

    def receive(self) -> None:
        """Take what has arrived."""
        for event in () if self._watch is None else self._watch.drain():
            for one in (self._hub.nodes, self._shard):
                if one is not None:
                    one.on_liveliness(event.role, event.agent, event.boot_id, alive=event.alive)
        for received in (one for subscription in self._prompt for one in subscription.drain()):
            self._handle(received)
        self._shares.take(one for subscription in self._subscriptions for one in subscription.drain())
        now = time.monotonic()
        if now >= self._began + _BACKLOG_S:
            self._shedding.see(self._shares.age_s(time.time_ns()), now)

    def obey(self, export: Callable[[LiveHub], str] | None) -> None:
        """Do what a view has asked for."""
        for action in self._orders.take():
            self._hub.counters[f"asked.{action}"] += 1
            if action == "recalibrate":
                self._hub.reset()
                self._last_action = "recalibrating, as requested"
            elif action == "forget":
                names = self._hub.forget_silent(time.monotonic())
                self._last_action = f"forgot {listed(names)}" if names else "no silent camera to forget"
            elif action == "export":
                self._last_action = "no folder to export to: set out" if export is None else export(self._hub)

    def estimate(self, now: float, *, final: bool) -> None:
        """Publish what nodes, calibration and tracking have to say."""
        hub, self._now = self._hub, now
        if hub.nodes is not None:
            for state in hub.nodes.tick(time.monotonic()):
                if state.camera not in self._node_publishers:
                    publisher = self._bus.publisher(NODE_STATE, state.camera)
                    self._node_publishers[state.camera] = self._stack.enter_context(closing(publisher))
                self._node_publishers[state.camera].put(state)
        if hub.tracking is not None:
            hub.tracking.predicts = not self._shedding.sheds_predictions
            hub.tracking.markers.smooths = not self._shedding.sheds_smoothed
        self._publish(hub.tick(now, final=final))
        if self._shard is not None:
            for topic, message in self._shard.tick(now):
                self._publishers[topic].put(message)
            self.observations.ignore(self._shard.ignored)
        if hub.tracking is not None:
            for track in hub.tracking.smoothed():
                shown = track if self._shard is None else self._shard.own_track(track)
                if shown is not None:
                    self._smoothed.put(shown)

    def report(self, now: float, rig: Rig | None, *, last: bool) -> None:
        """Publish progress, the rig and the status, each when it is due."""
        hub = self._hub
        if now >= self._next_progress and hub.calibration is None and hub.settings.solve:
            self._next_progress = now + _PROGRESS_S
            self._publish(hub.waiting(now))
        if rig is not None and now >= self._next_rig:
            self._next_rig = now + _RIG_S
            self._publish([rig_message(rig)])
        if now >= self._next_status or last:
            self._next_status = now + _STATUS_S
            status = self._status(now)
            if self._stopping:
                status.state, status.message = "stopping", "it was stopped" if last else self._stopping
            self._publish([status])
            self._sequence += 1

    def _status(self, now: float) -> pb.AgentStatus:
        hub, shares = self._hub, self._shares
        counters = [subscription.counters for subscription in self._subscriptions]
        status = status_message(hub, self._agent, self._boot, self._sequence, counters, now)
        if shares.dropped:
            status.counters["dropped_behind"] = shares.dropped.total()
        if hub.tracking is not None and (left_out := hub.tracking.markers.counters["shed.smoothed"]):
            status.counters["shed.smoothed"] = left_out
        shed = self._shedding.text(now)
        if shed and status.state == "running":
            status.state = "degraded"  # a page shows what such a status says
        needs_advice = hub.calibration is None or hub.refusal is not None or hub.calibration.refused
        behind = f"messages wait of {', '.join(shares.behind[:8])}" if shares.behind else ""
        heard_for = now - self._began  # before that a camera that runs may not have sent a frame
        advice = [one.text for one in hub.guidance.advice() if one.kind != "silent" or heard_for > SILENT_S]
        shared = "" if self._shard is None else self._shard.text()
        texts = (shed, behind, status.message, shared, *(advice if needs_advice else ()), self._last_action)
        status.message = "; ".join(text for text in texts if text)[:_MAX_TEXT]
        return status


def freeze_garbage_collector() -> None:
    """Exclude all present objects, above all modules, from garbage collection.

    Otherwise each full collection stops the process for 70 ms and delays messages. Reference counting still frees them.
    """
    gc.collect()
    gc.freeze()


def status_message(
    hub: LiveHub, agent: str, boot: str, sequence: int, counters: Sequence[Mapping[str, int]], now: float = 0.0
) -> pb.AgentStatus:
    """The hub's status at ``now``: counters, gauges, and one line of text."""
    state, text = hub.state(now)
    word = "running" if state == "calibrated" else "degraded" if state == "degraded" else "starting"
    message = agent_status(ROLE, agent, boot, sequence, word, text)
    for name, count in hub.counters.items():
        message.counters[name] = count
    for kind, of_cameras in (("over_budget", hub.budgets.counts), ("fault", hub.links.faults)):
        for camera, count in of_cameras.most_common(_NAMED_CAMERAS):
            message.counters[f"{kind}.{camera}"[:64]] = count
    ages = hub.frame_ages(now)
    rates = {
        camera: ppm for camera, ppm in hub.stream.clocks.rates_ppm().items() if ages.get(camera, SILENT_S) < SILENT_S
    }
    for kind, values in (("ppm", rates), ("frame_age_s", ages), ("offset_std_s", hub.offset_stds())):
        for camera in heapq.nlargest(_MEASURED_CAMERAS, values, key=lambda name, of=values: abs(of[name])):  # type: ignore[misc]
            message.gauges[f"{kind}.{camera}"[:64]] = values[camera]
    message.gauges["cameras"] = len(ages)
    message.gauges["silent_cameras"] = sum(age > SILENT_S for age in ages.values())
    if state in ("collecting", "searching"):
        # What is waited for, per camera: the search needs motion that two cameras see at the same time.
        progress = [one for one in hub.progress() if one.shared_motion_s > 0.0 or not hub.stream.people.cameras]
        shared = [f"{one.camera} {one.shared_motion_s:.0f} s" for one in progress[:_NAMED_CAMERAS]]
        message.message += f"; motion shared with another camera: {', '.join(shared)}" if shared else ""
    elif hub.calibration is not None and (left := set(hub.stream.marker.cameras) - hub.calibration.cameras.keys()):
        reasons = {one.camera: f" ({one.reason})" if one.reason else "" for one in hub.progress()}
        # Not the reason again that degrades the hub.
        reasons = {name: "" if why[2:-1] in message.message else why for name, why in reasons.items()}
        named = ", ".join(f"{name}{reasons.get(name, '')}" for name in sorted(left)[:_NAMED_CAMERAS])
        message.message += f"; heard but not calibrated: {named}"
    alarms = [*hub.stream.clocks.alarms.values(), *hub.clock_contradictions()]
    message.message = "; ".join(filter(None, [*alarms, hub.unmatched(now), message.message]))[:1000]
    _add_parts(message, hub, now)
    for counts in counters:
        for name, count in counts.items():
            message.counters[name] = message.counters[name] + count
    return message


def _add_parts(message: pb.AgentStatus, hub: LiveHub, now: float) -> None:
    """What calibration, tracking and nodes count."""
    if hub.calibration is not None:
        message.gauges["calibrated_cameras"] = len(hub.calibration.cameras)
        message.gauges["calibration_age_s"] = max(now - hub.calibrated_at, 0.0)
        message.gauges["calibration_verified"] = float(not hub.unverified)
    if hub.tracking is not None and hub.tracking.has_detections:
        for name, value in hub.tracking.gauges().items():
            message.gauges[name] = value
        for name, count in hub.tracking.counters.items():
            message.counters[name] = count
    if hub.nodes is not None:
        message.gauges["nodes"] = len(hub.nodes.cameras())
        for name, count in hub.nodes.counters.items():
            message.counters[f"nodes.{name}"] = count
