"""A pose node: keeps one camera's pose true, from what it and its neighbours saw (METHODS C, steps 1 to 8).

No sockets, threads, files or clocks: ``handle`` takes a message, ``tick`` does one update; both return what to publish.
Lengths inside are in the network's unit (with sizes: the target's size; with bearings only: one baseline).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from hub.nodes.begin import resect
from hub.nodes.bump import Motion, camera_moved
from hub.nodes.edge import Edge, stream
from hub.nodes.gauge import reference_edge, usable, world_from_network
from hub.nodes.messages import Anchor, Message, Notice, Out, Reference, SharedObservation, StateMessage
from hub.nodes.pairing import Pairing
from hub.nodes.solve import (
    Term,
    moved,
    normal_equations,
    one_term,
    placed_by,
    ray_meeting,
    relative,
    step_between,
)
from hub.nodes.two_cameras import Relative
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats

_BATCH = 16
"""Observations that are taken in together: the cost of a batch hardly depends on its size."""
_PATIENCE = 4
"""Updates that an observation waits at the longest."""
_RESECT_EVERY = 20
"""Updates between two tries to join by several neighbours."""
_YOUNG = 100
"""Updates after joining during which nothing waits."""
_SEQUENCES = 256
"""Messages of one camera that may overtake each other."""
_MOST_ANCHORS = 8
_LONGEST_TURN = 0.3
"""Longest turn [rad] of one update, and longest shift as a share of the distance to the neighbours."""
_TRUST_AFTER = 3
"""Updates after joining before a camera's pose is offered as the place to linearise."""
_ROUTED = 20
"""Updates after which the hops to the frame's owner are the shortest."""
_DAMPING = 0.5
"""Share of the block's step: with it, neighbours that move at once cannot overshoot, with or without momentum."""
_CONTRADICTED = 60.0
_CONTRADICTIONS = 30


@dataclass(slots=True, eq=False)
class _Neighbour:
    edge: Edge
    boot: int = -1
    highest: int = -1
    bits: int = 0
    state: StateMessage | None = None


class PoseNode:
    """One camera. camera: its number; lower numbers own the network's frame. seed: of its random choices."""

    def __init__(
        self, camera: int, *, boot: int = 0, reference: Reference | None = None, seed: int = 0, depth: int = 0
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
        self._ahead = self.pose
        self._momentum = 0
        self._sequence = 0
        self._partner = -1
        self._rng = np.random.default_rng([seed, camera])
        self._pairing = Pairing()
        self._neighbours: dict[int, _Neighbour] = {}
        self._anchors: dict[int, Anchor] = {}
        self._recovering = 0
        self._waiting = 0

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
        if not self._is_new(neighbour, seen):
            return []
        met = self._pairing.other(seen)
        return [] if met is None else self._pair(neighbour, met[1])

    def _is_new(self, neighbour: _Neighbour, seen: SharedObservation) -> bool:
        """False for a duplicate, and for one so late that it may be one (METHODS C, step 1)."""
        if seen.boot != neighbour.boot:
            if seen.boot < neighbour.boot:
                self.refused["earlier boot"] += 1
                return False
            neighbour.boot, neighbour.highest, neighbour.bits = seen.boot, -1, 0
        ahead = seen.sequence - neighbour.highest
        if ahead > 0:
            neighbour.bits = ((neighbour.bits << ahead) | 1) & ((1 << _SEQUENCES) - 1) if ahead < _SEQUENCES else 1
            neighbour.highest = seen.sequence
            return True
        if -ahead >= _SEQUENCES:
            self.refused["too late"] += 1
            return False
        bit = 1 << -ahead
        if neighbour.bits & bit:
            self.refused["duplicate"] += 1
            return False
        neighbour.bits |= bit
        return True

    def _neighbour(self, camera: int) -> _Neighbour:
        found = self._neighbours.get(camera)
        if found is None:
            found = self._neighbours[camera] = _Neighbour(Edge(camera, self._rng))
        return found

    def _pair(self, neighbour: _Neighbour, row: tuple[float, ...]) -> list[Out]:
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
            edge.reset()
            told = f"most of what {edge.neighbour} shares contradicts the edge"
            out.append(Notice(self.camera, "edge begun again", told))
        return self._find_bump() + out

    def _predicted(self, neighbour: _Neighbour) -> Relative | None:
        other = self._standing(neighbour)
        if other is None or self.pose is None or self.settled < _TRUST_AFTER or neighbour.state is None:
            return None
        return relative(self.pose, other) if neighbour.state.settled >= _TRUST_AFTER else None

    def _standing(self, neighbour: _Neighbour) -> Pose | None:
        """The neighbour's pose if it is in this camera's frame."""
        state = neighbour.state
        return state.pose if state is not None and state.frame == self.frame else None

    # neighbours' states

    def _state(self, state: StateMessage) -> list[Out]:
        if state.camera == self.camera or not _sound(state):
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
        neighbour.state = state
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
        pose = self._placed(offers, frame)
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
        mine, there, spread = [], [], []
        for neighbour in self._neighbours.values():
            state = neighbour.state
            if state is None or state.frame != frame or state.pose is None or state.settled < _TRUST_AFTER:
                continue
            own, other, std = neighbour.edge.points()
            mine.append(own)
            there.append(state.pose.world_from_camera(other))
            spread.append(std)
        if not mine:
            return []
        found = resect(np.concatenate(mine), np.concatenate(there), np.concatenate(spread), self._rng)
        if found is None:
            return []
        self.pose = self._ahead = Pose(found.rotation, found.centre)
        self.hops = 1 + min(state.hops for state in states if state.frame == frame)
        self.frame, self.settled, self._momentum, self._partner = frame, 0, 0, -1
        self._depth = max(state.depth for state in states if state.frame == frame)
        return [Notice(self.camera, "joined", f"the frame of {frame}, by several neighbours")]

    def _placed(self, offers: list[tuple[StateMessage, Edge]], frame: int) -> Pose | None:
        def strength(edge: Edge) -> float:
            assert edge.summary is not None
            return float(np.linalg.slogdet(edge.summary.hessian + 1e-9 * np.eye(6))[1])

        state, edge = max(offers, key=lambda offer: strength(offer[1]))
        assert edge.summary is not None
        assert state.pose is not None
        best = edge.summary.anchor.moved(edge.summary.best_step())
        if not edge.summary.bearings:
            return placed_by(state.pose, best)
        partner = next(
            (offer for offer in offers if offer[0].camera == frame and offer[0].partner == self.camera), None
        )
        if partner is not None:
            assert partner[1].summary is not None
            assert partner[0].pose is not None
            seen = partner[1].summary.anchor
            return placed_by(partner[0].pose, seen.scaled(1.0 / float(np.linalg.norm(seen.centre))))
        if len(offers) < 2:
            return None
        rotation = best.rotation.T @ state.pose.rotation
        rays = []
        for other, its in offers:
            assert its.summary is not None
            assert other.pose is not None
            centre = its.summary.anchor.centre
            rays.append((other.pose, centre / np.linalg.norm(centre)))
        met = ray_meeting(rays, rotation)
        return None if met is None else Pose(rotation, met[0])

    # the update

    def _terms(self, *, ahead: bool = True) -> list[Term]:
        del ahead
        terms = []
        for neighbour in self._neighbours.values():
            other, summary = self._standing(neighbour), neighbour.edge.summary
            if other is not None and summary is not None:
                terms.append(Term(summary, other))
        mine = self._anchors.get(self.camera)
        if mine is not None and not self.reference_aside:
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
                neighbour.edge.linearise_again(self._predicted(neighbour))
        terms = self._terms()
        self.settled += 1
        if not terms:
            return
        hessian, gradient = normal_equations(self._ahead, terms)
        if self._recovering > 0:
            self._recovering -= 1
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        normalised = hessian / scale / scale[:, None] + 1e-6 * np.eye(6)
        step = -_DAMPING * np.linalg.solve(normalised, gradient / scale) / scale
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
        self._ahead = moved(found, share * carried)

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
                judged.append((summary.excess(relative(self.pose, other)), neighbour.edge))
        calm = sum(excess < 0.3 * _CONTRADICTED for excess, _ in judged)
        for excess, edge in judged:
            if excess > _CONTRADICTED and calm >= 2:
                edge.contradictions += 1
                if edge.contradictions > _CONTRADICTIONS:
                    edge.reset()
                    out.append(
                        Notice(self.camera, "edge begun again", f"the others contradict the edge to {edge.neighbour}")
                    )
            else:
                edge.contradictions = max(0, edge.contradictions - 1)
        return out

    def _find_bump(self) -> list[Out]:
        """Whether this camera was bumped (step 8): its edges' latest observations agree on a new pose."""
        if self.pose is None or self.settled < 20:
            return []
        motions = []
        for neighbour in self._neighbours.values():
            other, edge = self._standing(neighbour), neighbour.edge
            if other is None or edge.summary is None or not edge.streaming or self._predicted(neighbour) is None:
                continue
            by_step, _, _ = one_term(self.pose, Term(edge.summary, other))
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


def _sound(state: StateMessage) -> bool:
    """Finite, and a rotation."""
    if state.pose is None:
        return True
    rotation = state.pose.rotation
    if not (np.isfinite(rotation).all() and np.isfinite(state.pose.position).all()):
        return False
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6)
