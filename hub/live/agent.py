"""The hub agent: a thin loop between the bus and the live estimator."""

from __future__ import annotations

import gc
import heapq
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext

from google.protobuf.message import Message

from hub.distributed.network.host import ROLE as NODES
from hub.distributed.network.host import NodeHost
from hub.live.fair_share import FairShare
from hub.live.live_hub import SILENT_S, LiveHub
from protocols.bus.base import Bus, Publisher, Received
from protocols.bus.commands import CommandSubscription
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import Rig
from protocols.topics import (
    CALIBRATION,
    CAMERA_INFO,
    NODE_STATE,
    OBSERVATION,
    PREDICTION,
    RIG_INFO,
    SOLVER_EVENT,
    STATUS,
    TRACK,
    TRACK_SMOOTHED,
)

ROLE = "hub"
_TICK_S = 0.05
_ROUND_S = 0.012
"""Least time between two rounds: observations that arrive closer together are processed together."""
_MESSAGES_S = 0.4
"""What the messages of a round may take together: tracks, and the status within 2 s, are published between rounds."""
_BACKLOG_S = 2.0
"""After its start a hub gets what cameras had published before, all at once."""
_FINISH_S = 20.0
"""Longest wait for the last answer when the hub is stopped."""
_PROGRESS_S = 2.0
_STATUS_S = 1.0
_RIG_S = 5.0
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
) -> None:
    """Process messages, have them solved, and publish until ``stop`` is set; then once more with all data.

    on_result: called after every answer that was taken, a calibration or a refusal (to write files). beat: watchdog
    heartbeat, called after every round, so that a watchdog detects a hanging loop. export: writes the calibration on
    request of a view; returns a status text.
    """
    boot = boot_id or uuid.uuid4().hex
    nodes = hub.nodes
    node_topics = () if nodes is None else (NODE_STATE, CALIBRATION)
    subscriptions = [bus.subscribe(topic) for topic in (CAMERA_INFO, OBSERVATION, STATUS, *node_topics)]
    publishers = {
        "Calibration": bus.publisher(CALIBRATION, agent),
        "Track": bus.publisher(TRACK, agent, rate_hz=200.0),
        "SolverEvent": bus.publisher(SOLVER_EVENT, agent),
        "Prediction": bus.publisher(PREDICTION, agent),
        "RigInfo": bus.publisher(RIG_INFO, agent),
        "AgentStatus": bus.publisher(STATUS, agent),
    }
    smoothed = bus.publisher(TRACK_SMOOTHED, agent)
    orders = CommandSubscription(bus, agent, boot, ("recalibrate", "export"))
    observations = subscriptions[1]
    sequence, next_status, next_rig, next_progress = 0, 0.0, 0.0, 0.0
    last_action = ""
    began = time.monotonic()
    finish_by: float | None = None

    def handle(received: Received) -> None:
        if received.agent != agent or not isinstance(received.message, pb.Calibration):
            backlog = time.monotonic() < began + _BACKLOG_S
            hub.handle(received.message, received.arrival_ns * 1e-9, backlog=backlog)

    shares = FairShare(handle, time.monotonic, _MESSAGES_S)

    def publish(messages: list[Message]) -> None:
        for message in messages:
            publishers[message.DESCRIPTOR.name].put(message)

    node_publishers: dict[str, Publisher] = {}

    def publish_nodes(host: NodeHost, now: float) -> None:
        for state in host.tick(now):
            if state.camera not in node_publishers:
                node_publishers[state.camera] = bus.publisher(NODE_STATE, state.camera)
            node_publishers[state.camera].put(state)

    watch = None if nodes is None else bus.watch_agents()
    freeze_garbage_collector()
    memory_frozen = False
    try:
        with bus.announce(ROLE, agent, boot), nullcontext() if nodes is None else bus.announce(NODES, agent, boot):
            while True:
                if stop.is_set() and finish_by is None:
                    finish_by = time.monotonic() + _FINISH_S
                finishing = finish_by is not None
                if nodes is not None and watch is not None:
                    for event in watch.drain():
                        nodes.on_liveliness(event.role, event.agent, event.boot_id, alive=event.alive)
                shares.take(received for subscription in subscriptions for received in subscription.drain())
                for action in orders.take():
                    hub.counters[f"asked.{action}"] += 1
                    if action == "recalibrate":
                        hub.reset()
                        last_action = "recalibrating, as requested"
                    elif action == "export":
                        last_action = "no folder to export to: set out" if export is None else export(hub)
                if nodes is not None:
                    publish_nodes(nodes, time.monotonic())
                now = time.monotonic()
                before = hub.results
                publish(hub.tick(now, final=finishing and not hub.finished))
                if hub.tracking is not None:
                    for track in hub.tracking.smoothed():
                        smoothed.put(track)
                has_result = hub.results > before
                last = finish_by is not None and (now >= finish_by or (hub.finished and not hub.solver.busy))
                if has_result and not memory_frozen:
                    memory_frozen = True
                    freeze_garbage_collector()
                if on_result is not None and has_result:
                    on_result(hub)
                if now >= next_progress and hub.calibration is None and hub.settings.solve:
                    next_progress = now + _PROGRESS_S
                    publish(hub.waiting(now))
                if rig is not None and now >= next_rig:
                    next_rig = now + _RIG_S
                    publish([rig_message(rig)])
                if now >= next_status or last:
                    next_status = now + _STATUS_S
                    status = status_message(hub, agent, boot, sequence, [s.counters for s in subscriptions], now)
                    needs_advice = hub.calibration is None or hub.refusal is not None or hub.calibration.refused
                    if shares.dropped:
                        status.counters["dropped_behind"] = shares.dropped.total()
                    if shares.behind:
                        status.message = f"{status.message}; messages wait of {', '.join(shares.behind[:8])}"
                    advice = [one.text for one in hub.guidance.advice()] if needs_advice else []
                    status.message = "; ".join(text for text in (status.message, *advice, last_action) if text)[
                        :_MAX_TEXT
                    ]
                    publish([status])
                    sequence += 1
                beat()
                if last:
                    break
                if hub.calibration is None:
                    stop.wait(_TICK_S)  # nothing is published at the cameras' pace yet
                else:
                    time.sleep(_ROUND_S)
                    observations.wait(_TICK_S)
    finally:
        hub.solver.close()
        for publisher in (*publishers.values(), smoothed, *node_publishers.values()):
            publisher.close()
        if watch is not None:
            watch.close()
        orders.close()
        for subscription in subscriptions:
            subscription.close()


def freeze_garbage_collector() -> None:
    """Exclude all present objects, above all modules, from garbage collection.

    Otherwise each full collection stops the process for 70 ms and delays messages. Reference counting still frees them.
    """
    gc.collect()
    gc.freeze()


def rig_message(rig: Rig) -> pb.RigInfo:
    """The message with the rig's gauge and scale information, for the log."""
    message = pb.RigInfo(schema_version=1, units=rig.units, clock=rig.clock)
    for a, b, distance in rig.distances:
        message.distances.append(pb.RigInfo.Distance(camera_a=a, camera_b=b, distance=distance))
    if isinstance(rig.up, str):
        message.up_camera = rig.up
    elif rig.up is not None:
        message.up.extend(rig.up.tolist())
    reference = rig.metadata.get("reference")
    if isinstance(reference, str):
        message.reference_camera = reference
    return message


def status_message(
    hub: LiveHub, agent: str, boot: str, sequence: int, counters: Sequence[Mapping[str, int]], now: float = 0.0
) -> pb.AgentStatus:
    """The hub's status at ``now``: counters, gauges, and one line of text."""
    state, text = hub.state(now)
    message = pb.AgentStatus(
        schema_version=1,
        agent=agent,
        role=ROLE,
        boot_id=boot,
        sequence=sequence,
        state="running" if state == "calibrated" else "degraded" if state == "degraded" else "starting",
        message=text,
        version=VERSION,
    )
    for name, count in hub.counters.items():
        message.counters[name] = count
    for kind, of_cameras in (("over_budget", hub.budgets.counts), ("fault", hub.faults)):
        for camera, count in of_cameras.most_common(_NAMED_CAMERAS):
            message.counters[f"{kind}.{camera}"[:64]] = count
    ages = hub.frame_ages(now)
    rates = {camera: ppm for camera, ppm in hub.clocks.rates_ppm().items() if ages.get(camera, SILENT_S) < SILENT_S}
    for kind, values in (("ppm", rates), ("frame_age_s", ages), ("offset_std_s", hub.offset_stds())):
        for camera in heapq.nlargest(_MEASURED_CAMERAS, values, key=lambda name, of=values: abs(of[name])):  # type: ignore[misc]
            message.gauges[f"{kind}.{camera}"[:64]] = values[camera]
    message.gauges["cameras"] = len(ages)
    message.gauges["silent_cameras"] = sum(age > SILENT_S for age in ages.values())
    if state in ("collecting", "searching"):
        # What is waited for, per camera: the search needs motion that two cameras see at the same time.
        shared = [f"{one.camera} {one.shared_motion_s:.0f} s" for one in hub.progress()[:_NAMED_CAMERAS]]
        message.message += f"; motion shared with another camera: {', '.join(shared)}" if shared else ""
    if hub.calibration is not None:
        message.gauges["calibrated_cameras"] = len(hub.calibration.cameras)
        message.gauges["calibration_age_s"] = max(now - hub.calibrated_at, 0.0)
        message.gauges["calibration_verified"] = float(not hub.unverified)
    alarms = [*hub.clocks.alarms.values(), *hub.clock_contradictions()]
    if alarms:
        message.message = "; ".join([*alarms, message.message])[:1000]
    if hub.tracking is not None and hub.tracking.has_detections:
        for name, value in hub.tracking.gauges().items():
            message.gauges[name] = value
        for name, count in hub.tracking.counters.items():
            message.counters[name] = count
    if hub.nodes is not None:
        message.gauges["nodes"] = len(hub.nodes.cameras())
        for name, count in hub.nodes.counters.items():
            message.counters[f"nodes.{name}"] = count
    for counts in counters:
        for name, count in counts.items():
            message.counters[name] = message.counters[name] + count
    return message
