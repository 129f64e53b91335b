"""Pose node: estimates one camera's pose from its own and its neighbours' observations.

Distributed pose paper, steps 1 to 8. No sockets, threads, files or clocks: ``handle`` processes a message, ``tick``
performs one update; both return messages to publish.
Lengths inside are in the network's unit (with sizes: the target's size; with bearings only: one baseline).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hub.distributed.factors.factor import RAW_CAPACITY, Edge, QuadraticFactor, Window, stream_pending
from hub.distributed.factors.two_view_model import RelativeTransform
from hub.distributed.network.association import MAX_GAP_S, Associator
from hub.distributed.network.block_solver import (
    FactorTerm,
    linearise_term,
    local_coordinates,
    normal_equations,
    relative_transform,
    retract,
)
from hub.distributed.network.datum import accepted_anchors, control_point_factor, find_outliers, world_from_network
from hub.distributed.network.localisation import Neighbour, localise, localise_by_resection
from hub.distributed.network.messages import (
    Anchor,
    ControlPoint,
    Message,
    Notice,
    Output,
    SharedObservation,
    StateMessage,
)
from hub.distributed.network.moved_camera import EdgeJacobian, detect_motion
from protocols.geometry.pose import Pose, Similarity

_BATCH = 256
"""Observations processed together, unless an update comes first: the cost of a batch hardly depends on its size. CPU of
an observation at 32, 64, 128, and at 128, 256, 512 on a busy machine: 13.1, 9.1, 5.9; 11.4, 8.9, 10.6 us."""
_MAX_WAIT_UPDATES = 4
"""Largest delay of an observation in updates."""
_RESECTION_INTERVAL = 20
"""Updates between two attempts to localise by resection."""
_STARTUP_UPDATES = 100
"""Updates after joining a frame during which observations are processed without delay."""
_MAX_ANCHORS = 8  # neighbours that a node's pose is chained to
_CONTROL_TEST_AT = 80
"""Updates after joining, and again at each doubling, at which control points are tested; they have no weight before."""
_MAX_ROTATION_STEP = 0.3
"""Largest rotation [rad] of one update; the largest translation is 0.3 of the distance to the neighbours."""
_MIN_FRAME_AGE = 3
"""Updates after joining before a camera's pose is used for linearisation."""
_ROUTING_UPDATES = 20
"""Updates after which the hop count to the frame's owner is shortest."""
_DAMPING = 0.5
"""Damping of the block step: neighbours that move simultaneously cannot overshoot, with or without momentum."""
_TIMEOUT_UPDATES = 20
"""Updates without a message after which a neighbour no longer reduces the step."""
_CONVERGED_CHI2, _CONVERGED_UPDATES = 9.0, 5
"""Largest predicted chi2 decrease of a step, and for how many successive updates, for the moved-camera test."""
_CONTRADICTION_COST = 60.0  # half chi2 of six numbers: 4.5 stds on each, never by chance
_MAX_CONTRADICTIONS = 30  # in succession, before the pose is started anew


class PoseNode:
    """Pose estimator of one camera. camera: its number; the lowest number owns the network's frame.

    seed: of its random generator. raw: observations kept per neighbour for relinearisation; more is more accurate and
    more expensive. gap: longest time [s] across which a target is interpolated; 0 where one clock stamps all cameras.
    """

    def __init__(
        self,
        camera: int,
        *,
        boot: int = 0,
        control_point: ControlPoint | None = None,
        seed: int = 0,
        raw: int = RAW_CAPACITY,
        gap: float = MAX_GAP_S,
    ) -> None:
        self.camera = camera
        self.boot = boot
        self.epoch = 0
        self.frame, self.hops = camera, 0
        self.pose: Pose | None = Pose.identity()
        self.control_point = control_point
        self.control_point_rejected = False
        self.refused: Counter[str] = Counter()
        self.updates = 0
        self.frame_age = 0
        self._depth = 0
        self._raw = raw
        self._extrapolated: Pose | None = self.pose
        self._momentum = 0
        self._sequence = 0
        self._partner = -1
        self._rng = np.random.default_rng([seed, camera])
        self._associator = Associator(gap)
        self._neighbours: dict[int, Neighbour] = {}
        self._anchors: dict[int, Anchor] = {}
        self._pending = 0
        self._contradicted_updates = 0
        self._converged_updates = 0

    # messages

    def handle(self, message: Message) -> list[Output]:
        """Process a message. Duplicate, old and invalid ones are counted in ``refused`` and dropped."""
        if isinstance(message, SharedObservation):
            return self._observation(message)
        return self._state(message)

    def tick(self, now: float) -> list[Output]:
        """One update, and the state to publish. now: reference clock [s]; only the order of events matters."""
        del now
        self.updates += 1
        out: list[Output] = []
        if self._pending and (self.frame_age < _STARTUP_UPDATES or self.updates % _MAX_WAIT_UPDATES == 0):
            out += self._accumulate_pending()
        if self.frame == self.camera:
            self._choose_partner()
        out += self._localise()
        self._update()
        out += self._check_edges()
        out += self._test_control_point()
        out.append(self.state())
        return out

    def leave(self) -> StateMessage:
        """The last message of a camera that leaves the network."""
        return replace(self.state(), leaving=True)

    def state(self) -> StateMessage:
        """The state message for the neighbours."""
        self._sequence += 1
        if self.control_point is not None and self.pose is not None:
            own_anchor = Anchor(
                self.camera,
                self.epoch,
                self._sequence,
                self.frame,
                self.pose,
                self.control_point,
                self.control_point_rejected,
            )
            self._anchors[self.camera] = own_anchor
        anchors = tuple(anchor for anchor in self._anchors.values() if anchor.frame == self.frame)
        return StateMessage(
            camera=self.camera,
            boot=self.boot,
            epoch=self.epoch,
            sequence=self._sequence,
            frame=self.frame,
            hops=self.hops,
            pose=self._extrapolated,
            frame_age=self.frame_age,
            partner=self._partner,
            depth=self._depth,
            anchors=anchors,
        )

    def relinearise_all(self) -> None:
        """Process all pending observations, and relinearise raw ones at the current poses."""
        self._accumulate_pending()
        for neighbour in self._neighbours.values():
            neighbour.edge.relinearise(self._predicted_transform(neighbour))

    def factors(self) -> dict[int, QuadraticFactor]:
        """The factor of each initialised edge, for another host to resume from."""
        edges = self.neighbours().items()
        return {camera: edge.factor for camera, edge in edges if edge.factor is not None and edge.initialised}

    def resume(self, state: StateMessage, edges: Mapping[int, QuadraticFactor]) -> None:
        """Resume from the last state of another host of this camera's node."""
        self.epoch, self.frame, self.hops = state.epoch, state.frame, state.hops
        self.pose = self._extrapolated = state.pose
        self.frame_age, self._depth, self._partner = state.frame_age, state.depth, state.partner
        self._anchors = {anchor.camera: anchor for anchor in state.anchors}
        self.control_point_rejected = self.camera in self._anchors and self._anchors[self.camera].rejected
        for camera, factor in edges.items():
            self._neighbour(camera).edge.resume(factor)

    def clear_associations(self) -> None:
        """Discard observations waiting for association: a clock's map has changed."""
        self._associator = Associator(self._associator.gap)

    # read-out

    def world_from_own_network(self) -> Similarity | None:
        """World from network; None while the known control points fix no gauge."""
        return world_from_network([a for a in accepted_anchors(self._anchors) if a.frame == self.frame])

    def world_pose(self) -> Pose | None:
        """The camera's pose in the world, in the control points' unit; None while unknown."""
        world_from_own_network = self.world_from_own_network()
        return None if world_from_own_network is None or self.pose is None else world_from_own_network.pose(self.pose)

    def neighbours(self) -> dict[int, Edge]:
        """The edges, by neighbour."""
        return {camera: neighbour.edge for camera, neighbour in self._neighbours.items()}

    # observations

    def _observation(self, seen: SharedObservation) -> list[Output]:
        if not (
            math.isfinite(seen.x + seen.y + seen.time)
            and 0.0 < seen.std < 1.0
            and 0.0 <= seen.size < 1e3
            and 0.0 <= seen.size_std < 10.0
            and 0.0 <= seen.time_std < 1e3
        ):
            self.refused["invalid"] += 1
            return []
        if seen.camera == self.camera:
            out: list[Output] = []
            for camera, row in self._associator.add_own(seen):
                out += self._pair(self._neighbours.get(camera) or self._neighbour(camera), row)
            return out
        neighbour = self._neighbours.get(seen.camera) or self._neighbour(seen.camera)
        reason = neighbour.rejection_reason(seen)
        if reason:
            self.refused[reason] += 1
            return []
        paired = self._associator.add_neighbour(seen)
        return [] if paired is None else self._pair(neighbour, paired)

    def _neighbour(self, camera: int) -> Neighbour:
        if camera not in self._neighbours:
            edge = Edge(camera, self._rng, self._raw, reverse=camera < self.camera)
            self._neighbours[camera] = Neighbour(edge)
        return self._neighbours[camera]

    def _pair(self, neighbour: Neighbour, row: tuple[float, ...]) -> list[Output]:
        neighbour.edge.add(row)
        self._pending += 1
        return self._accumulate_pending() if self._pending >= _BATCH else []

    def _accumulate_pending(self) -> list[Output]:
        """Add all pending observations to their edges' factors."""
        self._pending = 0
        streaming = []
        for neighbour in self._neighbours.values():
            if neighbour.edge.streaming:
                streaming.append((neighbour.edge, self._predicted_transform(neighbour)))
            elif neighbour.edge.pending:
                neighbour.edge.flush_raw(self._predicted_transform(neighbour))
        out: list[Output] = []
        for edge in stream_pending(streaming):
            edge.reset(failed=True)
            detail = f"most observations shared with {edge.neighbour} contradict the edge"
            out.append(Notice(self.camera, "edge begun again", detail))
        return self._detect_own_motion() + out

    def _predicted_transform(self, neighbour: Neighbour) -> RelativeTransform | None:
        other = self._pose_in_frame(neighbour)
        if other is None or self.pose is None or self.frame_age < _MIN_FRAME_AGE or neighbour.state is None:
            return None
        return (
            _relative_by_edge(neighbour.edge, self.pose, other) if neighbour.state.frame_age >= _MIN_FRAME_AGE else None
        )

    def _pose_in_frame(self, neighbour: Neighbour) -> Pose | None:
        """The neighbour's pose if it is in this camera's frame, else None."""
        state = neighbour.state
        return state.pose if state is not None and state.frame == self.frame else None

    # neighbours' states

    def _state(self, state: StateMessage) -> list[Output]:
        if state.camera == self.camera or not state.is_valid:
            self.refused["invalid"] += 1
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
        neighbour.state, neighbour.state_age = state, 0
        if state.frame == self.frame:
            self.hops = min(self.hops, state.hops + 1)
        if state.frame == self.frame and self.frame_age > _ROUTING_UPDATES:
            self._depth = max(self._depth, state.depth, self.hops)
        for anchor in state.anchors:
            own_anchor = self._anchors.get(anchor.camera)
            if anchor.camera == self.camera:
                continue
            newer = own_anchor is not None and (anchor.epoch, anchor.sequence) > (own_anchor.epoch, own_anchor.sequence)
            if newer or (own_anchor is None and len(self._anchors) < _MAX_ANCHORS):
                self._anchors[anchor.camera] = anchor
        return []

    # localisation

    def _choose_partner(self) -> None:
        """The frame's owner selects the camera whose distance is the unit, with bearings only."""
        if self._partner in self._neighbours:
            return
        initialised_edges = [
            n.edge for n in self._neighbours.values() if n.edge.initialised and n.edge.factor is not None
        ]
        best = max(initialised_edges, key=lambda edge: edge.observation_count, default=None)
        self._partner = -1 if best is None else best.neighbour

    def _localise(self) -> list[Output]:
        """Join the frame of a neighbour with a lower frame number, by the best initialised edge (step 4)."""
        localised = [
            (n.state, n.edge)
            for n in self._neighbours.values()
            if n.state is not None
            and n.state.pose is not None
            and n.state.frame < self.frame
            and n.edge.initialised
            and n.edge.factor is not None
        ]
        if not localised:
            return self._localise_by_resection()
        frame = min(state.frame for state, _ in localised)
        localised = [neighbour for neighbour in localised if neighbour[0].frame == frame]
        pose = localise(self.camera, localised, frame)
        return self._join(pose, [state for state, _ in localised], f"the frame of {frame}")

    def _localise_by_resection(self) -> list[Output]:
        """Join a frame by resection from the observations shared with all neighbours."""
        states = [n.state for n in self._neighbours.values() if n.state is not None and n.state.frame < self.frame]
        if self.updates % _RESECTION_INTERVAL or not states:
            return []
        frame = min(state.frame for state in states)
        localised = [
            (n.state, n.edge)
            for n in self._neighbours.values()
            if n.state is not None and n.state.frame == frame and n.state.frame_age >= _MIN_FRAME_AGE
        ]
        pose = localise_by_resection(localised, self._rng)
        inside = [state for state in states if state.frame == frame]
        return self._join(pose, inside, f"the frame of {frame}, by several neighbours")

    def _join(self, pose: Pose | None, states: list[StateMessage], text: str) -> list[Output]:
        """Take the pose, if there is one, in the frame of neighbours with these states."""
        if pose is None:
            return []
        self.pose = self._extrapolated = pose
        self.hops, self._depth = 1 + min(state.hops for state in states), max(state.depth for state in states)
        self.frame, self.frame_age, self._momentum, self._partner = states[0].frame, 0, 0, -1
        return [Notice(self.camera, "joined", text)]

    def _leave_frame(self) -> None:
        """Return to the own frame; the edges are kept."""
        self.frame, self.hops, self._depth, self._partner = self.camera, 0, 0, -1
        self.pose = self._extrapolated = Pose.identity()
        self.frame_age = self._momentum = self._contradicted_updates = 0

    # the update

    def _terms(self) -> list[FactorTerm]:
        terms = []
        for neighbour in self._neighbours.values():
            other, factor = self._pose_in_frame(neighbour), neighbour.edge.factor
            if other is not None and factor is not None:
                terms.append(FactorTerm(factor, other, neighbour.edge.reverse))
        own_anchor = self._anchors.get(self.camera)
        if own_anchor is not None and not self.control_point_rejected and self.frame_age >= _CONTROL_TEST_AT:
            for anchor in accepted_anchors(self._anchors):
                # Only direct neighbours: a stiff factor to a pose that arrives late would oscillate.
                other = self._pose_in_frame(self._neighbour(anchor.camera)) if anchor.camera != self.camera else None
                if other is None or anchor.frame != self.frame:
                    continue
                forward = control_point_factor(own_anchor, anchor, attitude=True)
                if forward is not None:
                    terms.append(FactorTerm(forward, other))
                backward = control_point_factor(anchor, own_anchor, attitude=False)
                if backward is not None:
                    terms.append(FactorTerm(backward, other, reverse=True))
        return terms

    def _update(self) -> None:
        """Accelerated block Gauss-Newton (step 5): a damped step from the pose extrapolated by momentum."""
        if self.pose is None or self._extrapolated is None:
            return
        for neighbour in self._neighbours.values():
            if (
                not neighbour.edge.streaming
                and neighbour.edge.observation_count
                and (self.updates + self.camera) % 8 == 0
            ):
                neighbour.edge.relinearise(self._predicted_transform(neighbour), spare=0.1)
        terms = self._terms()
        self.frame_age += 1
        if not terms:
            return
        hessian, gradient = normal_equations(self._extrapolated, terms)
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        scaled = hessian / scale / scale[:, None] + 1e-6 * np.eye(6)
        full = -np.linalg.solve(scaled, gradient / scale) / scale
        self._converged_updates = self._converged_updates + 1 if -float(gradient @ full) < _CONVERGED_CHI2 else 0
        # Repeated steps towards outdated neighbour poses would add up to a full step, and two hosts with delayed
        # messages would oscillate for ever. So steps without a new state are halved each time.
        step_factor = 0.5 ** self._oldest_state_age()
        step = _DAMPING * step_factor * full
        distance = (
            float(np.median([np.linalg.norm(t.other.position - self._extrapolated.position) for t in terms])) + 1e-9
        )
        length = max(
            float(np.linalg.norm(step[:3])) / _MAX_ROTATION_STEP, float(np.linalg.norm(step[3:])) / (0.3 * distance)
        )
        if length > 1.0:
            step, self._momentum = step / length, 0
        found = retract(self._extrapolated, step)
        last, self.pose = self.pose, found
        displacement = local_coordinates(last, found)
        self._momentum += 1
        # Deformations of a larger network relax more slowly: depth is its size in hops.
        max_momentum = 1.0 - 1.0 / (2.0 + 7.0 * self._depth)
        momentum = min(self._momentum / (self._momentum + 3.0), max_momentum)
        self._extrapolated = retract(found, momentum * step_factor * displacement)

    def _oldest_state_age(self) -> int:
        """Largest state age of the neighbours in this frame, without those that have timed out."""
        ages = [
            n.state_age
            for n in self._neighbours.values()
            if self._pose_in_frame(n) is not None and n.state_age <= _TIMEOUT_UPDATES
        ]
        for neighbour in self._neighbours.values():
            neighbour.state_age += 1
        return max(ages, default=0)

    # health

    def _check_edges(self) -> list[Output]:
        """Restart an edge that the network contradicts over many updates: its initialisation was wrong."""
        out: list[Output] = []
        if self.pose is None or self.frame_age < 40 + 30 * self._depth:  # a large network relaxes slowly
            return out
        excess_by_edge = []
        for neighbour in self._neighbours.values():
            other, factor = self._pose_in_frame(neighbour), neighbour.edge.factor
            if other is not None and factor is not None and neighbour.edge.initialised:
                excess_by_edge.append(
                    (factor.excess_cost(_relative_by_edge(neighbour.edge, self.pose, other)), neighbour.edge)
                )
        contradicting = sum(excess_cost > _CONTRADICTION_COST for excess_cost, _ in excess_by_edge)
        if contradicting > 0.5 * len(excess_by_edge) and self.frame != self.camera:
            # Most edges contradict the pose: localisation used wrong edges. Leave the frame and localise again.
            self._contradicted_updates += 1
            if self._contradicted_updates > _MAX_CONTRADICTIONS:
                self._leave_frame()
                return [
                    Notice(
                        self.camera,
                        "joins again",
                        f"{contradicting} of {len(excess_by_edge)} edges contradict its pose",
                    )
                ]
        else:
            self._contradicted_updates = max(0, self._contradicted_updates - 1)
        consistent = sum(excess_cost < 0.3 * _CONTRADICTION_COST for excess_cost, _ in excess_by_edge)
        for excess_cost, edge in excess_by_edge:
            if excess_cost > _CONTRADICTION_COST and consistent >= 2:
                edge.contradictions += 1
                if edge.contradictions > _MAX_CONTRADICTIONS:
                    edge.reset(failed=True)
                    out.append(
                        Notice(self.camera, "edge begun again", f"the others contradict the edge to {edge.neighbour}")
                    )
            else:
                edge.contradictions = max(0, edge.contradictions - 1)
        return out

    def _test_control_point(self) -> list[Output]:
        """Reject the own control point if it is an outlier: the camera has moved since it was surveyed."""
        own_anchor = self._anchors.get(self.camera)
        doublings = math.log2(self.frame_age / _CONTROL_TEST_AT) if self.frame_age >= _CONTROL_TEST_AT else 0.5
        if own_anchor is None or self.control_point_rejected or doublings != int(doublings):
            return []
        detail = find_outliers([a for a in accepted_anchors(self._anchors) if a.frame == self.frame]).get(self.camera)
        if detail is None:
            return []
        self.control_point_rejected = True
        return [Notice(self.camera, "reference set aside", detail)]

    def _detect_own_motion(self) -> list[Output]:
        """Moved-camera test (step 8): whether the edges' latest observations agree on a new pose."""
        if self.pose is None or self.frame_age < 20:
            return []
        if self._converged_updates < _CONVERGED_UPDATES:  # the network has not converged: apparent motion is its own
            for neighbour in self._neighbours.values():
                neighbour.edge.short_window, neighbour.edge.long_window = Window.empty(), Window.empty()
            return []
        edge_jacobians = []
        for neighbour in self._neighbours.values():
            other, edge = self._pose_in_frame(neighbour), neighbour.edge
            if (
                other is None
                or edge.factor is None
                or not edge.streaming
                or self._predicted_transform(neighbour) is None
            ):
                continue
            by_step, _, _ = linearise_term(self.pose, FactorTerm(edge.factor, other, edge.reverse))
            edge_jacobians.append(EdgeJacobian(edge, by_step))
        step = detect_motion(edge_jacobians)
        if step is None:
            return []
        self.epoch += 1
        self.pose = self._extrapolated = retract(self.pose, step)
        self._momentum = 0
        for neighbour in self._neighbours.values():
            neighbour.edge.reset()
        out: list[Output] = [Notice(self.camera, "bumped", f"by {np.degrees(np.linalg.norm(step[:3])):.2f} degrees")]
        if self.control_point is not None and not self.control_point_rejected:
            self.control_point_rejected = True
            out.append(Notice(self.camera, "reference set aside", "the camera has moved from its surveyed position"))
        return out


def _relative_by_edge(edge: Edge, own: Pose, other: Pose) -> RelativeTransform:
    """Relative pose of two cameras in the edge's parametrisation."""
    return relative_transform(other, own) if edge.reverse else relative_transform(own, other)
