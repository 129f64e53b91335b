"""Replay of a hub on the schedule that its log holds: the same snapshots, and each answer when it took effect."""

from __future__ import annotations

import re
from collections.abc import Iterable

from google.protobuf.message import Message

from hub.clocks.external_prior import ExternalClockPrior
from hub.clocks.observation_stream import without_tracked
from hub.live.live_hub import LiveHub, merge_rigs
from hub.live.reloaded import ReloadedCalibration
from hub.live.solver import SolverJob
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import SessionBuilder

_SEGMENT = re.compile(r"-e\d+$")
"""What `hub.clocks.segments` appends to a boot id after a clock step."""


class ScheduledHub(LiveHub):
    """A hub that solves what its log says, when it says so, instead of when it is due.

    The answers are those of the recorded hub bit for bit where the recorder lost nothing that the hub had, except after
    a change of a clock's rate, whose correction the log does not hold, and of jobs by people: these are given at the
    recorded times, of the people who are known then and without times of arrival.
    """

    def __init__(self) -> None:
        super().__init__()
        self._whole = SessionBuilder()
        self._events: list[pb.SolverEvent] = []

    def handle(self, message: Message, arrival: float | None = None, *, backlog: bool = False) -> None:
        """Process one message of the log, solver events included."""
        if isinstance(message, pb.SolverEvent):
            self._events.append(message)
            return
        self._whole.handle(without_tracked(message) if isinstance(message, pb.Observation) else message)
        super().handle(message, arrival, backlog=backlog)

    def _calibrate(self, now: float, final: bool) -> list[Message]:
        out: list[Message] = []
        events, self._events = self._events, []
        for event in events:
            if event.kind == "submitted" and event.rows:
                out += self._submit_recorded(event, now)
            elif event.kind == "submitted":  # by people, as they are known now
                self.solver.poll(now)
                out += self._submit(now, final=False)
            elif event.kind == "applied" and self._submitted is not None:
                answer = self.solver.poll(now)
                out += [] if answer is None else self._take(answer, now)
            elif event.kind == "failed":
                self.solver.poll(now)
        return out

    def _poll(self, now: float) -> list[Message]:
        return []

    def _submit_recorded(self, event: pb.SolverEvent, now: float) -> list[Message]:
        self.solver.poll(now)
        boots = {rows.camera: rows.boot_id for rows in event.rows}
        self._whole.select(
            (rows.camera, _SEGMENT.sub("", rows.boot_id), rows.first_sequence, rows.last_sequence, rows.count)
            for rows in event.rows
        )
        rig, observations = self._whole.build()
        last = self._start_from(boots)
        if not event.verify or last is None:
            self._reloaded = None
        elif self._reloaded is None:  # what the hub reloaded after a restart is this one's own last answer
            self._reloaded = ReloadedCalibration(last, boots, {}, None, since=now)
        job = SolverJob(
            event.job,
            merge_rigs(rig, self._rig),
            observations,
            last,
            event.search,
            event.full,
            self._reloaded is not None,
            _priors(event.clock_priors, boots),
            _priors(event.arrivals, boots),
            event.refine_lenses,
        )
        ranges = [(r.camera, r.boot_id, r.first_sequence, r.last_sequence, r.count) for r in event.rows]
        return self._hand_over(job, boots, ranges, now)


def _priors(given: Iterable[pb.SolverEvent.ClockPrior], boots: dict[str, str]) -> dict[str, ExternalClockPrior]:
    return {
        prior.camera: ExternalClockPrior(boots.get(prior.camera, ""), prior.unix_minus_camera, prior.error_bound)
        for prior in given
    }
