"""A pose node: keeps one camera's pose true, from what it and its neighbours saw (METHODS C, steps 1 to 8).

No sockets, threads, files or clocks: ``handle`` takes a message, ``tick`` does one update; both return what to publish.
Lengths inside are in the network's unit (with sizes: the target's size; with bearings only: one baseline).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hub.distributed.factors.factor import RAW, Edge, Summary, Window, stream
from hub.distributed.factors.linearise import Relative
from hub.distributed.network.association import GAP, Pairing
from hub.distributed.network.block_solver import (
    Term,
    moved,
    normal_equations,
    one_term,
    relative,
    step_between,
)
from hub.distributed.network.datum import contradicted, reference_edge, usable, world_from_network
from hub.distributed.network.localisation import placed, placed_by_many
from hub.distributed.network.messages import Anchor, Message, Notice, Out, Reference, SharedObservation, StateMessage
from hub.distributed.network.moved_camera import Motion, camera_moved
from hub.distributed.network.neighbour import Neighbour
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats

_BATCH = 32
"""Observations that are taken in together: the cost of a batch hardly depends on its size."""
_PATIENCE = 4
"""Updates that an observation waits at the longest."""
_RESECT_EVERY = 20
"""Updates between two tries to join by several neighbours."""
_YOUNG = 100
"""Updates after joining during which nothing waits."""
_MOST_ANCHORS = 8
_JUDGED_AT = 80
"""Updates after joining, then again at each doubling, at which the references are judged; only then they pull."""
_LONGEST_TURN = 0.3
"""Longest turn [rad] of one update, and longest shift as a share of the distance to the neighbours."""
_TRUST_AFTER = 3
"""Updates after joining before a camera's pose is offered as the place to linearise."""
_ROUTED = 20
"""Updates after which the hops to the frame's owner are the shortest."""
_DAMPING = 0.5
"""Share of the block's step: with it, neighbours that move at once cannot overshoot, with or without momentum."""
_SILENT = 20
"""Updates after which a neighbour that is not heard of holds nobody up."""
_CALM, _CALM_UPDATES = 9.0, 5
"""Chi2 that a step may gain, and for how many updates in a row, while bumps are looked for."""
_CONTRADICTED = 60.0
_CONTRADICTIONS = 30


class PoseNode:
    """One camera. camera: its number; lower numbers own the network's frame. seed: of its random choices.

    raw: observations that it keeps of each neighbour to linearise again; more is more exact, and dearer. gap: longest
    time [s] across which a target is interpolated; 0 where one clock stamps all, and nothing need move smoothly.
    """

    def __init__(
        self,
        camera: int,
        *,
        boot: int = 0,
        reference: Reference | None = None,
        seed: int = 0,
        depth: int = 0,
        raw: int = RAW,
        gap: float = GAP,
    ) -> None:
        self.camera = camera
        self.boot = boot
        self.epoch = 0
        self.frame, self.hops = camera, 0
        self.pose: Pose | None = Pose.identity()
        self.reference = reference
        self.reference_aside = False
        self.refused: Counter[str] = Counter()
        self.updates = 0
        self.settled = 0
        self._depth = depth
        self._raw = raw
        self._ahead: Pose | None = self.pose
        self._momentum = 0
        self._sequence = 0
        self._partner = -1
        self._rng = np.random.default_rng([seed, camera])
        self._pairing = Pairing(gap)
        self._neighbours: dict[int, Neighbour] = {}
        self._anchors: dict[int, Anchor] = {}
        self._recovering = 0
        self._waiting = 0
        self._lost = 0
        self._calm = 0

    # messages

    def handle(self, message: Message) -> list[Out]:
        """Takes a message in. Duplicates, old and senseless ones are counted in ``refused`` and dropped."""
        if isinstance(message, SharedObservation):
            return self._observation(message)
        return self._state(message)

    def tick(self, now: float) -> list[Out]:
        """One update, and the state to publish. now: reference clock [s]; only for the order of events."""
        del now
        self.updates += 1
        out: list[Out] = []
        if self._waiting and (self.settled < _YOUNG or self.updates % _PATIENCE == 0):
            out += self._take_in()
        if self.frame == self.camera:
            self._choose_partner()
        out += self._join()
        self._update()
        out += self._watch_edges()
        out += self._judge_reference()
        out.append(self.state())
        return out

    def leave(self) -> StateMessage:
        """The last message of a camera that goes."""
        return replace(self.state(), leaving=True)

    def state(self) -> StateMessage:
        """What the neighbours need to know."""
        self._sequence += 1
        if self.reference is not None and self.pose is not None:
            mine = Anchor(
                self.camera, self.epoch, self._sequence, self.frame, self.pose, self.reference, self.reference_aside
            )
            self._anchors[self.camera] = mine
        anchors = tuple(anchor for anchor in self._anchors.values() if anchor.frame == self.frame)
        return StateMessage(
            camera=self.camera,
            boot=self.boot,
            epoch=self.epoch,
            sequence=self._sequence,
            frame=self.frame,
            hops=self.hops,
            pose=self._ahead,
            settled=self.settled,
            partner=self._partner,
            depth=self._depth,
            anchors=anchors,
        )

    def revise(self) -> None:
        """Takes in all that waits, and linearises what is kept raw about where the cameras stand now."""
        self._take_in()
        for neighbour in self._neighbours.values():
            neighbour.edge.linearise_again(self._predicted(neighbour))

    def summaries(self) -> dict[int, Summary]:
        """What has been learnt with each neighbour, for another host to go on with, as the edges write it."""
        edges = self.neighbours().items()
        return {camera: edge.summary for camera, edge in edges if edge.summary is not None and edge.began}

    def resume(self, state: StateMessage, edges: Mapping[int, Summary]) -> None:
        """Goes on where another host of this camera's node ended."""
        self.epoch, self.frame, self.hops = state.epoch, state.frame, state.hops
        self.pose = self._ahead = state.pose
        self.settled, self._depth, self._partner = state.settled, state.depth, state.partner
        self._anchors = {anchor.camera: anchor for anchor in state.anchors}
        self.reference_aside = self.camera in self._anchors and self._anchors[self.camera].aside
        for camera, summary in edges.items():
            self._neighbour(camera).edge.resume(summary)

    def forget_tracks(self) -> None:
        """What waits to be paired is void: a clock's map has changed."""
        self._pairing = Pairing(self._pairing.gap)

    # read-out

    def world(self) -> Similarity | None:
        """World from network; None while the references heard of fix no gauge."""
        return world_from_network([a for a in usable(self._anchors) if a.frame == self.frame])

    def published(self) -> Pose | None:
        """The camera's pose in the world, in the references' unit; None while unknown."""
        world = self.world()
        return None if world is None or self.pose is None else world.pose(self.pose)

    def neighbours(self) -> dict[int, Edge]:
        """The edges, by neighbour."""
        return {camera: neighbour.edge for camera, neighbour in self._neighbours.items()}

    def information(self) -> Floats:
        """Information (6, 6) of the pose with the neighbours as they stand."""
        if self.pose is None:
            return np.zeros((6, 6))
        return normal_equations(self.pose, self._terms(ahead=False))[0]

    # observations

    def _observation(self, seen: SharedObservation) -> list[Out]:
        if not (
            math.isfinite(seen.x)
            and math.isfinite(seen.y)
            and math.isfinite(seen.time)
            and 0.0 < seen.std < 1.0
            and 0.0 <= seen.size < 1e3
            and 0.0 <= seen.size_std < 10.0
            and 0.0 <= seen.time_std < 1e3
        ):
            self.refused["senseless"] += 1
            return []
        if seen.camera == self.camera:
            out: list[Out] = []
            for camera, row in self._pairing.own(seen):
                out += self._pair(self._neighbour(camera), row)
            return out
        neighbour = self._neighbour(seen.camera)
        reason = neighbour.refuses(seen)
        if reason:
            self.refused[reason] += 1
            return []
        met = self._pairing.other(seen)
        return [] if met is None else self._pair(neighbour, met[1])

    def _neighbour(self, camera: int) -> Neighbour:
        found = self._neighbours.get(camera)
        if found is None:
            found = self._neighbours[camera] = Neighbour(
                Edge(camera, self._rng, self._raw, seen_by=camera < self.camera)
            )
        return found

    def _pair(self, neighbour: Neighbour, row: tuple[float, ...]) -> list[Out]:
        neighbour.edge.add(row)
        self._waiting += 1
        return self._take_in() if self._waiting >= _BATCH else []

    def _take_in(self) -> list[Out]:
        """All waiting observations into their edges' summaries."""
        self._waiting = 0
        streaming = []
        for neighbour in self._neighbours.values():
            if neighbour.edge.streaming:
                streaming.append((neighbour.edge, self._predicted(neighbour)))
            elif neighbour.edge.waiting:
                neighbour.edge.flush_raw(self._predicted(neighbour))
        out: list[Out] = []
        for edge in stream(streaming):
            edge.reset(badly=True)
            told = f"most of what {edge.neighbour} shares contradicts the edge"
            out.append(Notice(self.camera, "edge begun again", told))
        return self._find_bump() + out

    def _predicted(self, neighbour: Neighbour) -> Relative | None:
        other = self._standing(neighbour)
        if other is None or self.pose is None or self.settled < _TRUST_AFTER or neighbour.state is None:
            return None
        return _between(neighbour.edge, self.pose, other) if neighbour.state.settled >= _TRUST_AFTER else None

    def _standing(self, neighbour: Neighbour) -> Pose | None:
        """The neighbour's pose if it is in this camera's frame."""
        state = neighbour.state
        return state.pose if state is not None and state.frame == self.frame else None

    # neighbours' states

    def _state(self, state: StateMessage) -> list[Out]:
        if state.camera == self.camera or not state.sound:
            self.refused["senseless"] += 1
            return []
        if state.leaving:
            self._neighbours.pop(state.camera, None)
            self._anchors.pop(state.camera, None)
            return []
        neighbour = self._neighbour(state.camera)
        last = neighbour.state
        if last is not None and (state.boot, state.sequence) <= (last.boot, last.sequence):
            self.refused["old state"] += 1
            return []
        if last is not None and (state.boot, state.epoch) != (last.boot, last.epoch):
            neighbour.edge.reset()
        neighbour.state, neighbour.stale = state, 0
        if state.frame == self.frame:
            self.hops = min(self.hops, state.hops + 1)
        if state.frame == self.frame and self.settled > _ROUTED:
            self._depth = max(self._depth, state.depth, self.hops)
        for anchor in state.anchors:
            mine = self._anchors.get(anchor.camera)
            if anchor.camera == self.camera:
                continue
            newer = mine is not None and (anchor.epoch, anchor.sequence) > (mine.epoch, mine.sequence)
            if newer or (mine is None and len(self._anchors) < _MOST_ANCHORS):
                self._anchors[anchor.camera] = anchor
        return []

    # joining

    def _choose_partner(self) -> None:
        """The frame's owner names the camera whose distance is the unit, with bearings only."""
        if self._partner in self._neighbours:
            return
        begun = [n.edge for n in self._neighbours.values() if n.edge.began and n.edge.summary is not None]
        best = max(begun, key=lambda edge: edge.seen, default=None)
        self._partner = -1 if best is None else best.neighbour

    def _join(self) -> list[Out]:
        """Takes over the frame of a neighbour with a lower number, by the best edge that has begun (step 4)."""
        offers = [
            (n.state, n.edge)
            for n in self._neighbours.values()
            if n.state is not None
            and n.state.pose is not None
            and n.state.frame < self.frame
            and n.edge.began
            and n.edge.summary is not None
        ]
        if not offers:
            return self._join_by_many()
        frame = min(state.frame for state, _ in offers)
        offers = [offer for offer in offers if offer[0].frame == frame]
        pose = placed(self.camera, offers, frame)
        if pose is None:
            return []
        self.pose = self._ahead = pose
        self.hops = 1 + min(state.hops for state, _ in offers)
        self.frame, self.settled, self._momentum = frame, 0, 0
        self._partner = -1
        self._depth = max(state.depth for state, _ in offers)
        return [Notice(self.camera, "joined", f"the frame of {frame}")]

    def _join_by_many(self) -> list[Out]:
        """A camera that shares too little with any one neighbour joins by what it shares with all."""
        states = [n.state for n in self._neighbours.values() if n.state is not None and n.state.frame < self.frame]
        if self.updates % _RESECT_EVERY or not states:
            return []
        frame = min(state.frame for state in states)
        placed_ones = [
            (n.state, n.edge)
            for n in self._neighbours.values()
            if n.state is not None and n.state.frame == frame and n.state.settled >= _TRUST_AFTER
        ]
        pose = placed_by_many(placed_ones, self._rng)
        if pose is None:
            return []
        self.pose = self._ahead = pose
        self.hops = 1 + min(state.hops for state in states if state.frame == frame)
        self.frame, self.settled, self._momentum, self._partner = frame, 0, 0, -1
        self._depth = max(state.depth for state in states if state.frame == frame)
        return [Notice(self.camera, "joined", f"the frame of {frame}, by several neighbours")]

    def _leave_frame(self) -> None:
        """Not localised any more; the edges stay."""
        self.frame, self.hops, self._depth, self._partner = self.camera, 0, 0, -1
        self.pose = self._ahead = Pose.identity()
        self.settled = self._momentum = self._lost = 0

    # the update

    def _terms(self, *, ahead: bool = True) -> list[Term]:
        del ahead
        terms = []
        for neighbour in self._neighbours.values():
            other, summary = self._standing(neighbour), neighbour.edge.summary
            if other is not None and summary is not None:
                terms.append(Term(summary, other, neighbour.edge.seen_by))
        mine = self._anchors.get(self.camera)
        if mine is not None and not self.reference_aside and self.settled >= _JUDGED_AT:
            for anchor in usable(self._anchors):
                # References talk to each other directly: a stiff tie to a pose that comes late would swing.
                other = self._standing(self._neighbour(anchor.camera)) if anchor.camera != self.camera else None
                if other is None or anchor.frame != self.frame:
                    continue
                told = reference_edge(mine, anchor, attitude=True)
                if told is not None:
                    terms.append(Term(told, other))
                back = reference_edge(anchor, mine, attitude=False)
                if back is not None:
                    terms.append(Term(back, other, seen_by=True))
        return terms

    def _update(self) -> None:
        """Accelerated block Gauss-Newton (step 5): half a step from where momentum has carried the camera."""
        if self.pose is None or self._ahead is None:
            return
        for neighbour in self._neighbours.values():
            if not neighbour.edge.streaming and neighbour.edge.seen and (self.updates + self.camera) % 8 == 0:
                neighbour.edge.linearise_again(self._predicted(neighbour), spare=0.1)
        terms = self._terms()
        self.settled += 1
        if not terms:
            return
        hessian, gradient = normal_equations(self._ahead, terms)
        if self._recovering > 0:
            self._recovering -= 1
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        normalised = hessian / scale / scale[:, None] + 1e-6 * np.eye(6)
        full = -np.linalg.solve(normalised, gradient / scale) / scale
        self._calm = self._calm + 1 if -float(gradient @ full) < _CALM else 0
        # Going on towards neighbours that have not been heard of since would end in a full step: then two hosts that
        # hear each other late would chase each other for ever. So the steps after the first one halve.
        patience = 0.5 ** self._oldest()
        step = _DAMPING * patience * full
        distance = float(np.median([np.linalg.norm(t.other.position - self._ahead.position) for t in terms])) + 1e-9
        length = max(
            float(np.linalg.norm(step[:3])) / _LONGEST_TURN, float(np.linalg.norm(step[3:])) / (0.3 * distance)
        )
        if length > 1.0:
            step, self._momentum = step / length, 0
        found = moved(self._ahead, step)
        last, self.pose = self.pose, found
        carried = step_between(last, found)
        self._momentum += 1
        # The farther the network reaches, the longer it takes to bend back: depth is its size in hops.
        most = 1.0 - 1.0 / (2.0 + 7.0 * self._depth)
        share = min(self._momentum / (self._momentum + 3.0), most)
        self._ahead = moved(found, share * patience * carried)

    def _oldest(self) -> int:
        """Own updates since the neighbour last heard of was heard; those who have fallen silent don't count."""
        ages = [n.stale for n in self._neighbours.values() if self._standing(n) is not None and n.stale <= _SILENT]
        for neighbour in self._neighbours.values():
            neighbour.stale += 1
        return max(ages, default=0)

    # health

    def _watch_edges(self) -> list[Out]:
        """An edge that the network contradicts update after update was badly begun: it begins again."""
        out: list[Out] = []
        if self.pose is None or self.settled < 40 + 30 * self._depth:  # a large network takes long to bend
            return out
        judged = []
        for neighbour in self._neighbours.values():
            other, summary = self._standing(neighbour), neighbour.edge.summary
            if other is not None and summary is not None and neighbour.edge.began:
                judged.append((summary.excess(_between(neighbour.edge, self.pose, other)), neighbour.edge))
        against = sum(excess > _CONTRADICTED for excess, _ in judged)
        if against > 0.5 * len(judged) and self.frame != self.camera:
            # Most edges contradict the pose: it was joined by edges that were wrong then. Leave, and join again.
            self._lost += 1
            if self._lost > _CONTRADICTIONS:
                self._leave_frame()
                return [Notice(self.camera, "joins again", f"{against} of {len(judged)} edges contradict its pose")]
        else:
            self._lost = max(0, self._lost - 1)
        calm = sum(excess < 0.3 * _CONTRADICTED for excess, _ in judged)
        for excess, edge in judged:
            if excess > _CONTRADICTED and calm >= 2:
                edge.contradictions += 1
                if edge.contradictions > _CONTRADICTIONS:
                    edge.reset(badly=True)
                    out.append(
                        Notice(self.camera, "edge begun again", f"the others contradict the edge to {edge.neighbour}")
                    )
            else:
                edge.contradictions = max(0, edge.contradictions - 1)
        return out

    def _judge_reference(self) -> list[Out]:
        """A reference that the others contradict is set aside: the camera was bumped since it was surveyed."""
        mine = self._anchors.get(self.camera)
        doublings = math.log2(self.settled / _JUDGED_AT) if self.settled >= _JUDGED_AT else 0.5
        if mine is None or self.reference_aside or doublings != int(doublings):
            return []
        told = contradicted([a for a in usable(self._anchors) if a.frame == self.frame]).get(self.camera)
        if told is None:
            return []
        self.reference_aside = True
        return [Notice(self.camera, "reference set aside", told)]

    def _find_bump(self) -> list[Out]:
        """Whether this camera was bumped (step 8): its edges' latest observations agree on a new pose."""
        if self.pose is None or self.settled < 20:
            return []
        if self._calm < _CALM_UPDATES:  # the network is on its way: what looks like motion is its own
            for neighbour in self._neighbours.values():
                neighbour.edge.short, neighbour.edge.long = Window.empty(), Window.empty()
            return []
        motions = []
        for neighbour in self._neighbours.values():
            other, edge = self._standing(neighbour), neighbour.edge
            if other is None or edge.summary is None or not edge.streaming or self._predicted(neighbour) is None:
                continue
            by_step, _, _ = one_term(self.pose, Term(edge.summary, other, edge.seen_by))
            motions.append(Motion(edge, by_step))
        step = camera_moved(motions)
        if step is None:
            return []
        self.epoch += 1
        self.pose = self._ahead = moved(self.pose, step)
        self._momentum, self._recovering = 0, 64
        for neighbour in self._neighbours.values():
            neighbour.edge.reset()
        out: list[Out] = [Notice(self.camera, "bumped", f"by {np.degrees(np.linalg.norm(step[:3])):.2f} degrees")]
        if self.reference is not None and not self.reference_aside:
            self.reference_aside = True
            out.append(Notice(self.camera, "reference set aside", "the camera no longer stands where it was surveyed"))
        return out


def _between(edge: Edge, own: Pose, other: Pose) -> Relative:
    """Two cameras' relative pose as their edge writes it."""
    return relative(other, own) if edge.seen_by else relative(own, other)
