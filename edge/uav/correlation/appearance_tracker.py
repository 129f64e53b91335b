"""Tracks any target in any view by its appearance, on the image stabilised by what lies around.

Each frame: image motion of the static scene, prediction, correlation filter, size and turn, and verification against
the target's own background. While the target is away, its place moves with the scene and its own last velocity, and
the region in which it can be is searched. No lens and no telemetry are used.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from edge.uav.base import LOST_AFTER_S, LOST_STD, Box, Estimate, TrackState
from edge.uav.correlation.belief import Belief
from edge.uav.correlation.candidate import Kinematics
from edge.uav.correlation.colour import ColourModel
from edge.uav.correlation.filter import CorrelationFilter, Response
from edge.uav.correlation.memory import TemplateMemory
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.correlation.redetection import TRIAL_SIZES, Prediction, Redetection
from edge.uav.correlation.scale import BoxFlow, ScaleFilter
from edge.uav.correlation.search import search, tile
from edge.uav.correlation.shape import Outline
from edge.uav.correlation.template import Whitening
from edge.uav.correlation.velocity import VelocityFilter
from edge.uav.image_motion.first_motion import FirstMotion
from edge.uav.image_motion.median_background import MedianBackground
from edge.uav.image_motion.residual import MovingParts
from edge.uav.image_motion.scene_motion import STILL, Motion, SceneMotion
from edge.uav.target.box import check_target_box
from protocols.geometry.types import Floats, Image

_LEARN_INSIDE = 0.97  # share of the box in the image above which appearance and velocity are learnt
_SIZE_INSIDE = 0.85  # and above which the flow in it measures its size
_MEASURE_INSIDE = 0.6  # below it nothing is measured
_OBSERVE_EVERY, _OBSERVE_DOUBTFUL_EVERY = 6, 2  # frames between two looks at what lies around, surely on target or not
_CERTAIN = 3.0  # log likelihood ratio of clear evidence for the target
_COLOUR_SHARE = 0.5  # of its log likelihood ratio that the similarity and the filter, which see it too, do not have
_LOOK_ALIKE = 0.05  # probability that what is seen off the target is one of its kind
_SUPPORT, _SUPPORT_WITHIN = 2.0, 0.35  # log likelihood ratio of a place at which another tracker sees it; in lengths
_MOVED = 2.0  # distance within which what moves is looked for, in target lengths
CENTRE_STD = 0.04  # of a followed box about the middle of its target, in lengths: 93 % of real ones are within 2
_SLIP_STD = 0.35  # of a box that has slipped off its target, in target lengths: the two still overlap
_STAYED = 0.3  # distance of a box from where its target has moved at first, in sides, at which it goes there
_LIKE_FIRST = 0.65  # similarity to the first view above which a box holds its target: of what was left 0.6 or less
_FIRST_STD = 0.2  # of that velocity, in lengths a second: a cell of a side within the first second
_STANDS = -0.3  # log likelihood ratio below which a place stands and the target moves
_WINDOW = 1.2  # half of the region that the filter sees, in target lengths
_MOST_OF_SCENE = 0.7  # share of the tracks that overrules another tracker
_UNKNOWN_STEP = 0.1  # std of a step of the scene that could not be measured, over the image's width
_FAST_PAN_S = 1.0  # in which a step in the image may be the camera's; over plain water or sky it is the target's
_MOVES = 0.3  # speed over the scene at which a heading is given, in target lengths a second
_MAX_GROWTH = 8.0  # of a side since the first frame
_SCALE_GAIN = 0.5  # of the scale filter's correction, per frame
_ANCHOR_GAIN = 0.02  # similarity to the first view that another size, shape or angle must gain
_TURN_GAIN = 0.08  # and that a turn must have gained: as much as the same thing changes from one image to another
_ANCHOR_STEP = 0.3  # share of the way to it
_TURNS_S = 0.7  # for which a target goes on to turn: a bend that is driven through takes as long
_UPRIGHT = 0.02  # rad: a smaller turn moves no corner of the box by a cell of a template
_EXTENT_STEP = 0.3  # share of the way to the extent that the colours measure
_SURE_STD = 0.5  # of where it must be since the evidence was clear, in lengths, to go back to that
_LEARN_ABOVE = 1.0  # log likelihood ratio above which appearance is learnt


class AppearanceTracker:
    """Tracker of one target. size: (width, height) of the images [px]; fps: nominal frame rate."""

    def __init__(self, size: tuple[int, int], fps: float = 30.0) -> None:
        self._size = size
        self._fps = fps
        self._scene = SceneMotion(size)
        self.follows = True
        """Whether the other tracker's prediction moves with the scene."""

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Initialise the target from its first frame. Raises InputError for an invalid box."""
        check_target_box(image, self._size, target)
        self._time, self._frame = time, 0
        self.box = OrientedBox.upright(target)
        self._first = self.box.sides
        self._motion_filter = VelocityFilter(self.length)
        self._turn_rate = self._turned = 0.0
        self._scene.update(image, None)
        image = self._scene.photometric.corrected(image)  # begun again, what is learnt has the exposure of the first
        self.motion: Motion = STILL
        self._trusted_at = -np.inf
        self._learn_first(image)
        self._ratio, self._learn_above = 0.0, _LEARN_ABOVE
        self._expected: Estimate | None = None
        self._sure = self.box, copy(self._motion_filter)  # when the evidence was last clear, predicted since
        self._other_std = np.inf
        self._heading = float("nan")  # of the other tracker's estimate, at the last sight [rad]
        self._parts = MovingParts(image, self._time, self.box)
        self._begun, self._first_motion = time, FirstMotion(image, self.box)
        self._first_place: OrientedBox | None = self.box
        self._median_background = MedianBackground(image, self.box)
        return self._estimate(time)

    def _learn_first(self, image: Image) -> None:
        """Learn from the target's box what it looks like, without anything before."""
        self._filter = CorrelationFilter(self.box.width, self.box.height)
        self._scale, self._flow, self._memory = ScaleFilter(), BoxFlow(), TemplateMemory()
        self._whitened = TemplateMemory(Whitening(image, self.box))  # what it is recognised by after an absence
        self._filter.learn(image, self.box)
        self._scale.learn(image, self.box)
        self._flow.remember(image, self.box)
        self._memory.add(image, self.box)
        self._whitened.add(image, self.box)
        self._colour = ColourModel(image, self.box)
        self._observe_background(image, self.box)
        self._shape = Outline(image, self.box)
        self._missed, self._unseen_s, self._searching, self._belief = 0, 0.0, False, Belief()
        self._redetection = self._new_redetection()

    def _new_redetection(self) -> Redetection:
        return Redetection(self._size, self._memory, self._whitened, self._respond, self._colour)

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Track the target into the next frame; ``None`` for a frame that could not be decoded."""
        dt = float(np.clip(time - self._time, 1e-3, 2.0)) if np.isfinite(time) else 1.0 / self._fps
        self._time += dt
        self._frame += 1
        if image is None or image.shape[:2] != (self._size[1], self._size[0]):
            # Nothing speaks against the target: it is looked for where it was going, but needs evidence for it.
            self._belief.add(0.0, dt)
            self._miss(dt)
            return self._estimate(time)
        place, half = self.box.centre, 0.6 * self.box.extent
        self.motion = self._scene.update(image, np.append(place - half, place + half) if self._missed == 0 else None)
        image = self._scene.photometric.corrected(image)
        origin = self._predict(dt)
        self._parts.update(image, self._time, self.box, self.motion, place, origin)
        self._follow_first_motion(image)
        if not self._searching:
            self._track(image, dt, origin)
        else:
            self._look_for(image, dt)
        return self._estimate(time)

    @property
    def length(self) -> float:
        """Longer side of the target's box [px]."""
        return max(self.box.width, self.box.height)

    @property
    def std(self) -> float:
        """Of the target's centre, one coordinate [px]."""
        return 0.5 + (0.02 * self.length if self._missed == 0 else self._motion_filter.std)

    @property
    def sees(self) -> bool:
        """Whether the last frame shows the target."""
        return self._missed == 0

    @property
    def certain(self) -> bool:
        """Whether the last frame shows the target, by clear evidence."""
        return self._missed == 0 and self._ratio > _CERTAIN

    def expect(self, other: Estimate) -> None:
        """Take the place where another tracker has the target in the next image: what it sees there is tested first."""
        if not self._missed:
            self._heading = other.heading
        if np.isfinite([other.x, other.y]).all():
            self._expected = other

    def _predict(self, dt: float) -> Floats:
        """Move the box with the scene and its own velocity; returns where the scene alone would have moved it (2,)."""
        motion, box = self.motion, self.box
        (sure, velocity), expected = self._sure, self._expected
        self._support: Floats | None = None
        self.follows, self._other_std = True, np.inf
        origin = box.centre
        if motion.trusted:
            self._trusted_at = self._time
            origin, sure = motion.at(box.centre, self._scene.reach), sure.at(motion.at(sure.centre, self._scene.reach))
            for moving in (self._motion_filter, velocity):
                moving.follow_scene(motion.matrix[:, :2])
            box, sure = motion.moved(box), motion.moved(sure)
            self._redetection.move(motion, self._scene.reach, dt)
        elif expected is None and (self._missed or self._time - self._trusted_at < _FAST_PAN_S):
            for moving in (self._motion_filter, velocity):
                moving.lose_scene(_UNKNOWN_STEP * self._size[0])
        self._turn_rate *= float(np.exp(-dt / _TURNS_S))
        self._turned = self._turn_rate * dt
        box = box.turned(self._turned)
        if self._missed:
            self._motion_filter.turn(self._turned)
        self.box = box.at(origin + self._motion_filter.predict(dt, self.length))
        self._lead = np.zeros(2)
        self._sure = sure.at(sure.centre + velocity.predict(dt, self.length)), velocity
        if expected is not None:
            self._use(expected)
        return origin

    def _use(self, expected: Estimate) -> None:
        """Take up where another tracker has the target."""
        self._expected = None
        box, found = self.box.at(np.array([expected.x, expected.y])), expected.state is TrackState.VISIBLE
        self._support = box.centre if found else None
        if self._missed and found:
            turn = expected.heading - self._heading
            turn = turn if np.isfinite(turn) else 0.0
            box = box.turned(turn)
            if self._searching:
                self._redetection.propose(box, self._prediction())
            else:
                self.box, self._heading = box, self._heading + turn  # by which it has been turned now
        elif self._missed or not self.motion.trusted:
            # One that jumps over the scene has lost it, if most of the scene moves alike.
            clear = self.motion.trusted and self.motion.share > _MOST_OF_SCENE
            self.follows = not clear or bool(np.hypot(*(box.centre - self.box.centre)) < self.length)
            if self.follows:
                if self._time - self._trusted_at >= _FAST_PAN_S:  # before, the step may be the camera's
                    self._lead = box.centre - self.box.centre
                self.box, self._other_std = box, expected.std
            if not self.motion.trusted:
                self._sure = self.box, copy(self._motion_filter)

    def _follow_first_motion(self, image: Image) -> None:
        """Go to where the target has surely moved, if the box has stayed with what its first box showed, too."""
        if self._first_place is not None:
            self._first_place = self.motion.followed(self._first_place, self._scene.reach)
        if self._first_place is None:
            return
        seconds = self._time - self._begun
        moved = self._first_motion.look(image, seconds, self._first_place)
        if moved is not None:
            stood, sides = self._first_place.centre, self.box.sides
            went, goes = (float(np.hypot(*((to.centre - stood) / sides))) for to in (self.box, moved[0]))
            if went < goes and np.hypot(*((moved[0].centre - self.box.centre) / sides)) > _STAYED:
                self._go_to(*moved)  # else the box has gone with its target, past what is found
        seen = self.box if self.sees else None  # while it is not, it may be hidden, and what moves is something else
        crept = self._median_background.look(image, seconds, self._first_place, seen)
        if crept is not None and self._memory.first_scores(image, [self.box])[0] < _LIKE_FIRST:
            self._go_to(*crept)
            self._learn_first(image)

    def _go_to(self, place: OrientedBox, velocity: Floats) -> None:
        self.box, self._lead = place, np.zeros(2)  # of another tracker's place before the filter's own [px]
        self._motion_filter.restart(velocity, _FIRST_STD * self.length, self.length)
        self._sure = place, copy(self._motion_filter)

    def _track(self, image: Image, dt: float, origin: Floats) -> None:
        """Measure the target about its prediction. origin: (2,) where its last place in the scene is now [px]."""
        stood = origin if self.motion.trusted and self._missed == 0 else None
        if self.box.share_inside(self._size) < _MEASURE_INSIDE:
            self._searching = True  # it leaves the image
            self._miss(dt)
            return
        residual = self._parts.residual(self._time, self.box, _MOVED * self.length)
        box, score, ratio, answer = self._measured(image, self.box)
        moving, moved = residual.peaks(box.extent, 2), residual.log_ratio(box.centre)
        if moved < _STANDS:
            # It moved, and what is here stands: it may have slipped off.
            for place in moving:
                seen = self._measured(image, box.at(place))
                moves = residual.log_ratio(seen[0].centre)
                far = float(np.hypot(*(seen[0].centre - self.box.centre))) / self.length
                if seen[2] + moves - 0.5 * (far / _SLIP_STD) ** 2 > ratio + moved + _SUPPORT:
                    (box, score, ratio, answer), moved = seen, moves
        self._ratio = ratio + min(moved, 0.0)  # that something moves is no reason to learn what it looks like
        # What stands beside something that moves may have slipped off it: only clear evidence is learnt from.
        self._learn_above = _CERTAIN if moving and moved <= 0.0 else _LEARN_ABOVE
        if self.certain and self._learn_above < _CERTAIN:
            self._parts.confirm(residual, box.centre)
        # What has just covered the target differs from what was seen there, too, but does not look like it.
        ratio += moved if ratio > 0.0 else min(moved, 0.0)
        if self._support is not None and np.hypot(*(box.centre - self._support)) < _SUPPORT_WITHIN * self.length:
            ratio += _SUPPORT
        # It can only be there if it is in the filter's window at all.
        self._belief.doubt(math.erf(_WINDOW * self.length / self._motion_filter.std / math.sqrt(2.0)) ** 2)
        self._belief.add(ratio, dt)
        if box.share_inside(self._size) > _LEARN_INSIDE:  # what scores the target, by expectation maximisation
            self._memory.confirm(score, self._belief.probability)
            self._whitened.confirm(self._whitened.score(image, box), self._belief.probability)
            self._filter.confirm(answer, self._belief.probability)
        if self._belief.visible:
            self._accept(image, box, score, dt, stood)
        else:
            self._searching = self._belief.gone or self._motion_filter.std > self.length
            self._miss(dt)
        if self._frame % _OBSERVE_EVERY == 0:
            self._observe_background(image, box)
        elif not self.certain and self._frame % _OBSERVE_DOUBTFUL_EVERY == 0:
            self._observe_rivals(image, box)

    def _measured(self, image: Image, box: OrientedBox) -> tuple[OrientedBox, float, float, Response]:
        """The target about a box: where, its similarity, the log likelihood ratio by it, filter, colour; the answer."""
        std = float(np.hypot(self._motion_filter.std, _SLIP_STD * self.length))
        box, answer = self._respond(image, box, std)
        score = self._memory.score(image, box)
        ratio = self._memory.tracking_ratio(score) + answer.log_ratio
        ratio += _COLOUR_SHARE * self._colour.log_ratio(image, box)
        # One of its kind that passes before it scores as it does and is answered by the filter, but for its colour.
        paint = self._colour.log_ratio(image, box, in_any_light=True)
        ratio = -float(np.logaddexp(np.log1p(-_LOOK_ALIKE) - ratio, np.log(_LOOK_ALIKE) - paint))
        return box, score, ratio, answer

    def _accept(self, image: Image, box: OrientedBox, score: float, dt: float, stood: Floats | None) -> None:
        self._missed, self._unseen_s = 0, 0.0
        inside = box.share_inside(self._size)
        # Where it looks less like the target than what is beside it, it says little about how the target moves.
        unsure = 1.0 - inside if self._ratio > 0.0 else 1.0
        self._motion_filter.correct(self._lead + box.centre - self.box.centre, self.length, unsure)
        wider, higher, turn = self._flow.change(image, box, stood) if inside > _SIZE_INSIDE else (1.0, 1.0, 0.0)
        box = box.sized(box.sides * [wider, higher]).turned(turn)
        if inside > _LEARN_INSIDE:
            self._turn_rate += min(1.0, 4.0 * dt) * ((self._turned + turn) / dt - self._turn_rate)
            if self._frame % 3 == 0:
                box = self._anchored(image, box)
                extent = self._shape.measured(image, box)
                if extent is not None:
                    box = box.sized(box.sides * (extent / box.sides) ** _EXTENT_STEP)
            factor = self._scale.factor(image, box) ** _SCALE_GAIN if self._frame % 2 else 1.0
            sides = np.clip(box.sides * factor, self._first / _MAX_GROWTH, self._first * _MAX_GROWTH)
            box = box.sized(np.clip(sides, 4.0, 0.9 * np.array(self._size)))
            if self._ratio > self._learn_above and self._belief.log_odds > _CERTAIN:
                self._learn(image, box, score)
            if self.certain and self._belief.log_odds > _CERTAIN:
                self._sure = box, copy(self._motion_filter)
        self.box = box
        self._flow.remember(image, box)

    def _respond(self, image: Image, box: OrientedBox, std: float = np.inf) -> tuple[OrientedBox, Response]:
        """The box at the peak of the filter's answer; a second look where the first was off centre."""
        answer = self._filter.respond(image, box, std)
        moved = box.at(box.centre + [answer.x, answer.y])
        if np.hypot(answer.x, answer.y) > 0.35 * np.sqrt(box.width * box.height):
            again = self._filter.respond(image, moved, std)
            if again.peak > answer.peak:
                return moved.at(moved.centre + [again.x, again.y]), again
        return moved, answer

    def _learn(self, image: Image, box: OrientedBox, score: float) -> None:
        agrees = self._colour.log_ratio(image, box, in_any_light=True) > 0.0
        self._colour.learn(image, box)
        if not agrees:
            return  # what is seen may be one that passes before it
        if self._frame % 2:
            self._filter.learn(image, box, self._memory.agrees(float(self._memory.first_scores(image, [box])[0])))
        else:
            self._scale.learn(image, box)
        if self._frame % _OBSERVE_EVERY == 0:
            self._memory.add(image, box)
            self._whitened.add(image, box)

    def _anchored(self, image: Image, box: OrientedBox) -> OrientedBox:
        """The box, drawn towards the size, shape and angle at which it looks most like the first one.

        The flow inside a box sums up what the background in it does. The first template has none of that drift. Seen
        obliquely, a target that turns does not turn in the image: a turn must show in the similarity, or it is undone.
        """
        area = float(np.sqrt(np.prod(box.sides / self._first)))
        shaped = box.sized(self._first * area)
        trials = [box.turned(-box.angle), shaped, shaped.turned(-box.angle)]
        trials += [box.sized(box.sides * factor) for factor in TRIAL_SIZES]
        now, *gains = self._memory.first_scores(image, [box, *trials])
        if abs(box.angle) > _UPRIGHT:
            gains[0], gains[2] = (gain + _ANCHOR_GAIN + _TURN_GAIN for gain in (gains[0], gains[2]))
        best = int(np.argmax(gains))
        if gains[best] < now + _ANCHOR_GAIN:
            return box
        aim = trials[best]
        sides = box.sides * (aim.sides / box.sides) ** _ANCHOR_STEP
        return box.sized(sides).turned(_ANCHOR_STEP * ((aim.angle - box.angle + np.pi) % (2.0 * np.pi) - np.pi))

    def _observe_background(self, image: Image, box: OrientedBox) -> None:
        """Scores of what lies around the target, and in another part of the image each time."""
        self._observe_rivals(image, box)
        self._observe_places(image, box, *tile(box, self._size, self._frame // _OBSERVE_EVERY))

    def _observe_rivals(self, image: Image, box: OrientedBox) -> None:
        """Scores of what lies beside the target."""
        for memory, scores in self._observe_places(image, box, box, 2.0 * box.sides):
            memory.observe_rival(float(scores.max()))

    def _observe_places(
        self, image: Image, box: OrientedBox, where: OrientedBox, reach: Floats
    ) -> list[tuple[TemplateMemory, Floats]]:
        """Scores by either memory of the best places within ``reach`` of a box, off the target; none where none are."""
        found = search(image, self._memory, where, reach, 8)
        off = [f for f in found if np.abs(box.axes.T @ (f.box.centre - box.centre) / box.sides).max() > 0.7]
        if not off:
            return []
        boxes = [f.box for f in off]
        self._colour.observe(image, boxes)
        seen = [(self._memory, np.array([f.score for f in off])), (self._whitened, self._whitened.scores(image, boxes))]
        for memory, scores in seen:
            memory.observe_background(scores, float(np.prod(1.0 + 2.0 * reach / box.sides)))
        return seen

    def _miss(self, dt: float) -> None:
        if self._missed == 0:
            self._redetection = self._new_redetection()
            # What it was lost to has moved it since the evidence was last clear.
            box, velocity = self._sure
            if velocity.std < _SURE_STD * self.length:
                self.box, self._motion_filter = box, copy(velocity)
        self._missed += 1
        self._unseen_s += dt

    def _look_for(self, image: Image, dt: float) -> None:
        """Search for the target where it can be."""
        self._missed += 1
        self._unseen_s += dt
        expected = self._prediction()
        residual = self._parts.residual(self._time, self.box, 2.0 * expected.wide + self.length)
        found = self._redetection.look(image, expected, dt, residual)
        if found is not None:
            self._missed, self._unseen_s, self._searching = 0, 0.0, False
            self.box = found.box
            self._motion_filter.restart(*found.velocity(), self.length)
            self._belief = Belief(found.log_odds)
            self._flow.remember(image, self.box)

    def _prediction(self) -> Prediction:
        motion = Kinematics(self._motion_filter.velocity, self._motion_filter.velocity_std, self.length)
        # That of the other tracker, where its place was followed: their geometric mean, for it knows the plane only.
        std = float(np.sqrt(self.std * min(self._other_std, self.std)))
        return Prediction(self.box, std, motion, self._missed, self._unseen_s)

    def _estimate(self, time: float) -> Estimate:
        state = TrackState.VISIBLE if self._missed == 0 else TrackState.COASTING
        if self._missed and (self.std > LOST_STD * self.length or self._unseen_s > LOST_AFTER_S):
            state = TrackState.LOST
        centre, extent = self._shape.bounds(self.box)
        x, y = (np.nan, np.nan) if state is TrackState.LOST else (float(centre[0]), float(centre[1]))
        # Below it, the direction of the velocity is noise.
        velocity = self._motion_filter.velocity
        moves = state is not TrackState.LOST and np.hypot(*velocity) > _MOVES * self.length
        heading = float(np.arctan2(velocity[1], velocity[0])) if moves else np.nan
        std = self.std if self._missed else float(np.hypot(self.std, CENTRE_STD * self.length))
        return Estimate(time, state, x, y, float(extent[0]), float(extent[1]), heading, std)
