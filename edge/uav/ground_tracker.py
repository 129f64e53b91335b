"""The default tracker: one car followed on the ground plane, also while it is out of the picture.

Each frame: place the camera over the ground (``Placing``), look for the target where the cloud of particles expects
it (``Target``), weigh the cloud by what was found and what was not (``evidence``), learn the road, say what is known.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from edge.uav.ground.image_plane import transfer
from edge.uav.ground.layers import Layers
from edge.uav.ground.localisation import Placing
from edge.uav.ground.road_map import RoadMap
from edge.uav.prediction import particle_set as clouds
from edge.uav.prediction import particles as pf
from edge.uav.prediction.driver_model import Driving
from edge.uav.prediction.occlusion import Outlook
from edge.uav.prediction.particle_set import Cloud
from edge.uav.target import footprint
from edge.uav.target.appearance import Candidate
from edge.uav.target.box import check_target
from edge.uav.target.likelihood import Verdict, allow, judge
from edge.uav.target.motion_history import MotionFit, Sightings
from edge.uav.target.redetection import Survey
from edge.uav.target.state_estimate import answer
from edge.uav.target.target import Target
from edge.uav.target.tracklets import Tracklet, Tracklets
from edge.uav.tracker import Box, Estimate, Image, State, Telemetry
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Ints

_NUMBER = pf.AdaptiveNumber(cell=(0.6, 0.6), error=0.05, confidence=0.99, fewest=150, most=500)
_FIRST_NUMBER = 400
_PULL = 0.35  # of the motion towards the fit, a frame
_PULL_PLACE = 0.2  # of the place, the same
_ALIGN_AFTER = 0.6  # way travelled before the direction of motion counts, in target lengths
_UNCLEAR = 10.0  # times the noise of a place that counts towards the motion, where a part of the target is hidden
_FREE_FOR = 12  # frames for which a car whose motion was never seen may have gone anywhere
_STEADY = 8  # frames seen in a row after which the ground frame may begin anew
_AGAIN = 3  # frames unseen after which finding the target is finding it again
_ALIKE = 0.65  # mean score of a look-alike that is worth a thought
_TURNS = (0.15, 0.3, 0.5, 0.8)  # by how much what is found is tried turned [rad]
_MOST_TURNS = 3  # of them in a frame
_TURNED_OF = 2  # of the best candidates in turn
_SAME_TURN = 0.997  # cosine
_TURNED_STD = 0.06  # of the heading that a template tells [rad]
_SURVEY_AFTER = 12  # frames unseen after which all of the picture is looked over
_WRONG_A_SECOND, _WRONG_AT_MOST = 0.002, 0.02  # chance that it took a way that nobody thought of
_HIDING_CHANCE = (0.03, 0.03, 0.1, 0.3)  # to be found in a frame where none, one, two or three of its points are open
_ENDS = 0.35  # of the length: where those points are, from the middle
_LOST_WEIGHT = 0.1  # the same once it counts as lost
_RECONSIDER = 0.02  # weight of the particles that it gets
_ROAD_EVERY = 3  # frames between updates of the road map
_ROAD_SHOWN = 45.0  # about the target [ground units]
_ROAD_RATE = 0.15  # of what is learnt of road each time
_TEACH_EVERY = 12


class GroundTracker:
    """One target. size: (width, height) [px]. lens, body_from_camera: the camera; without them telemetry is unused."""

    def __init__(
        self,
        size: tuple[int, int],
        lens: Intrinsics | None = None,
        body_from_camera: Floats | None = None,
        fps: float = 30.0,
        seed: int = 0,
    ) -> None:
        self._size = size
        self._fps = fps
        self._rng = np.random.default_rng(seed)
        self._placing = Placing(size, lens, body_from_camera)
        self._began = False

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Learn the target from its first frame. Raises InputError for a box that can't be one."""
        check_target(image, self._size, target)
        placing = self._placing
        small = placing.shrink(image)
        placing.begin(small, time, target)
        self._target = Target(image, placing, target)
        place = self._target.place
        self._time, self._frame = time, 0
        self._road = RoadMap(place)
        self._sightings = Sightings()
        self._sightings.add(time, place, self._target.noise(1.0))
        self._fit: MotionFit | None = None
        self._driving = Driving()
        self._outlook: Outlook | None = None
        self._cloud = clouds.scattered(place, 0.03 * self._target.length, _FIRST_NUMBER, self._rng)
        self._missed, self._found = 0, 1  # frames in a row without and with the target
        self._tracklets = Tracklets()
        self._survey = Survey()
        self._seen_last = time
        self._state = State.VISIBLE
        self._trail: list[Floats] = [place]
        self._began = True
        self._relearn = True  # what road looks like
        self._learn_road(small, teach=True)
        return self._estimate(time)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Take one sample; without lens and mounting it can't be used. Bad samples are left out."""
        if self._placing.clock is not None:
            self._placing.clock.add(sample)

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Follow into the next frame; ``None`` for a frame that could not be decoded."""
        if not self._began:
            raise RuntimeError("begin first")
        dt = float(np.clip(time - self._time, 1e-3, 2.0)) if np.isfinite(time) else 1.0 / self._fps
        self._time += dt
        self._frame += 1
        ways = self._outlook.ways if self._outlook is not None else []
        self._cloud = clouds.driven(self._cloud, dt, ways, self._missed == 0, self._rng)
        if image is None or image.shape[:2] != (self._size[1], self._size[0]):
            self._placing.skip(dt)
            self._not_seen(dt)
            return self._estimate(time)
        small = self._placing.shrink(image)
        keep_out = None
        if self._missed == 0:
            keep_out = self._placing.body_pixels(self._target.outline(self._target.place, self._heading, 1.4))
        self._placing.update(small, self._time, dt, keep_out)
        verdict = self._look(image, small)
        best = verdict.best
        if best is not None:
            self._seen(image, best, verdict)
        else:
            self._not_seen(dt)
        if self._placing.blind == 0 and (self._relearn or self._frame % _ROAD_EVERY == 0):
            teach = self._relearn or self._frame % _TEACH_EVERY == 0
            self._learn_road(small, teach=teach and self._missed == 0)
        estimate = self._estimate(time)
        if self._found > _STEADY and self._placing.clock is not None:
            self._reroot(estimate)
        return estimate

    def road_outline(self) -> tuple[Floats, Floats | None]:
        """The road near the target as it was seen: image pixels (n, 2), and north, east (n, 2) [m] where known."""
        ground = self._road.outline(self._cloud.weights @ self._cloud.place, _ROAD_SHOWN)
        return self._placing.pixels(ground), ground if self._placing.metric else None

    @property
    def _heading(self) -> float:
        return pf.circular_mean(self._cloud.heading, self._cloud.weights)

    def _look(self, image: Image, small: Image) -> Verdict:
        """Search where the cloud lies within the picture, and weigh the cloud by it."""
        target, placing = self._target, self._placing
        surveyed = self._survey_all(image, small) if self._missed > _SURVEY_AFTER else []
        cloud = self._cloud
        pixels = placing.body_pixels(cloud.place)
        near = placing.plane.inside(pixels, -0.3 * target.length * target.scale)
        share = float(cloud.weights[near].sum())
        if share < 2e-3:
            return Verdict.nothing()
        here = np.flatnonzero(near)
        weights = cloud.weights[here] / share
        members, together = here, 1.0
        if self._missed:
            cluster = pf.densest_cluster(cloud.place[here], weights, 2.0 * target.length)
            members, together = here[cluster.members], cluster.weight
        candidates = self._search(image, members, wide=True)
        rest = np.setdiff1d(here, members)
        if len(rest) and together < 0.97:
            # What lies scattered is searched piece by piece, another piece each frame.
            middle = self._rng.choice(rest)
            aside = np.square(cloud.place[rest] - cloud.place[middle]).sum(axis=1) < (1.5 * target.length) ** 2
            for found in self._search(image, rest[aside], wide=False):
                if all(np.linalg.norm(found.ground - c.ground) > 0.4 * target.length for c in candidates):
                    candidates.append(found)
        if target.aligned and candidates and not any(target.looks.is_shaped(found) for found in candidates):
            candidates = self._look_turned(image, candidates)
        apart = 0.4 * target.length
        for found in surveyed:
            if all(np.linalg.norm(found.ground - c.ground) > apart for c in candidates):
                candidates.append(found)
        # Until its motion is known, anywhere it can have gone since it was seen will do.
        slack = (
            0.0
            if target.aligned
            else (0.2 if self._fit is None else 0.1) * target.length * (1 + min(self._missed, _FREE_FOR))
        )
        again = self._missed > _AGAIN
        tracklets = self._tracklets.update(self._time, candidates)
        if again and share > 0.5:
            cloud = self._reconsider(cloud, tracklets)
            pixels = placing.body_pixels(cloud.place)
        verdict = judge(
            cloud,
            candidates,
            tracklets,
            self._chance(small, cloud, pixels),
            lambda found: (target.noise(found.seen) + slack, target.noise(found.seen, found.score) + slack),
            target.length,
            again,
            lambda found: target.aligned and target.looks.is_shaped(found),
        )
        if verdict.likelihood is not None:
            self._cloud = cloud.weighted(verdict.likelihood)
        return verdict

    def _reconsider(self, cloud: Cloud, tracklets: list[Tracklet]) -> Cloud:
        """A few particles go where something like the target drives as it did, though the cloud is not there.

        Only where the cloud should be seen and is not: then it is wrong, and a better place is worth a thought.
        """
        fit = self._fit
        if fit is None or fit.speed < 1.0:
            return cloud
        for tracklet in tracklets:
            motion = tracklet.velocity()
            if motion is None or tracklet.age < 4 or tracklet.score < _ALIKE:
                continue
            speed = float(np.hypot(*motion[0]))
            reach = 2.0 * self._target.length + 0.6 * fit.speed * (self._time - self._seen_last)
            away = float(np.hypot(*(cloud.place - tracklet.places[-1]).T).min())
            if not 0.4 * fit.speed < speed < 1.6 * fit.speed or away > reach:
                continue
            # Along the road there, or at least not back where it came from.
            headings = cloud.heading[np.hypot(*(cloud.place - tracklet.places[-1]).T) < away + self._target.length]
            course = np.arctan2(motion[0][1], motion[0][0])
            if np.cos(headings - course).max() < 0.7:
                continue
            cloud = clouds.joined(cloud, tracklet.places[-1], motion, _RECONSIDER, self._rng)
            allow(tracklet, _RECONSIDER)
        return cloud

    def _search(self, image: Image, members: Ints, wide: bool) -> list[Candidate]:
        """Candidates about some of the particles."""
        weights = self._cloud.weights[members] + 1e-12
        weights = weights / weights.sum()
        places = self._cloud.place[members]
        middle = weights @ places
        away = np.hypot(*(places - middle).T)
        reach = float(np.quantile(away, 0.97)) if wide else 1.5 * self._target.length
        angle = pf.circular_mean(self._cloud.heading[members], weights) if self._target.aligned else None
        if wide:
            self._target.follow_scale(middle)
            if angle is not None:
                self._target.angle = angle
        return self._target.search(image, middle, 1.1 + reach / self._target.length, angle)

    def _look_turned(self, image: Image, candidates: list[Candidate]) -> list[Candidate]:
        """The candidates, with one looked at again as if it headed another way: nobody saw the bend that it took."""
        first = candidates[self._frame % min(len(candidates), _TURNED_OF)]
        near = self._tracklets.near(self._time, first.ground, 0.5 * self._target.length)
        angles = []
        if near is not None and near.age > 1:
            course = near.course()
            angles = [near.angle] if course is None else [near.angle, course]
        about = np.flatnonzero(np.square(self._cloud.place - first.ground).sum(axis=1) < self._target.length**2)
        if len(about):
            angles.append(float(self._cloud.heading[self._rng.choice(about)]))
        step = _TURNS[self._frame // _TURNED_OF % len(_TURNS)]
        angles += [first.angle + step, first.angle - step]
        tried = [angle for angle in angles if np.cos(angle - first.angle) < _SAME_TURN][:_MOST_TURNS]
        best = first
        for angle in tried:
            found = self._target.search(image, first.ground, 1.1, angle)
            best = max([best, *found[:1]], key=lambda candidate: candidate.score)
        if best.score < first.score + 0.05:
            return candidates
        reach = 0.5 * self._target.length
        rest = [c for c in candidates if c is not first and np.linalg.norm(c.ground - best.ground) > reach]
        return sorted([best, *rest], key=lambda candidate: -candidate.score)

    def _survey_all(self, image: Image, small: Image) -> list[Candidate]:
        """What drives anywhere in the picture as the target may: a few particles go there, more the longer it is gone.

        The ways that are thought of may all be wrong. What is found is weighed together with what is expected.
        """
        fit, target = self._fit, self._target
        if fit is None or not target.aligned or self._placing.blind:
            return []
        gone = self._time - self._seen_last
        weight = _LOST_WEIGHT if self._state is State.LOST else min(_WRONG_A_SECOND * gone, _WRONG_AT_MOST)
        out = []
        for spot, found, fits in self._survey.look(image, small, self._placing, target, fit, self._time):
            if found.score < _ALIKE or not target.looks.is_shaped(found):
                continue
            out.append(found)
            motion = spot.velocity()
            away = np.square(self._cloud.place - found.ground).sum(axis=1)
            here = float(self._cloud.weights[away < (0.5 * target.length) ** 2].sum())
            if motion is not None and here < weight * fits:
                self._cloud = clouds.joined(self._cloud, found.ground, motion, weight * fits, self._rng)
        return out

    def _chance(self, small: Image, cloud: Cloud, pixels: Floats) -> Floats:
        """(n,) chance that the target would be found where the particles are: 0 outside, little where it may hide.

        pixels: (n, 2) image points of the particles. A car shows where all of it lies on open road.
        """
        inside = self._placing.plane.inside(pixels, 2.0)
        out = np.zeros(len(pixels))
        if not inside.any() or self._placing.blind or not self._road.ready:
            return np.where(inside & (self._placing.blind == 0), _HIDING_CHANCE[0], 0.0)
        half = _ENDS * self._target.length * np.column_stack([np.cos(cloud.heading), np.sin(cloud.heading)])[inside]
        places = cloud.place[inside]
        points = np.concatenate([places, places - half, places + half])
        top = np.array([small.shape[1] - 1, small.shape[0] - 1])
        ground = np.nan_to_num(self._placing.pixels(points), nan=-1.0)
        at = np.clip((ground / self._placing.factor).astype(int), 0, top)
        colours = self._placing.light.undone(small[at[:, 1], at[:, 0]][None])[0]
        open_road = (self._road.ratios(colours) > -0.3).reshape(3, -1)
        out[inside] = np.array(_HIDING_CHANCE)[open_road.sum(axis=0)]
        return out

    def _seen(self, image: Image, best: Candidate, verdict: Verdict) -> None:
        """The target is there: motion, place and looks follow it."""
        target = self._target
        again = self._missed > _AGAIN
        if again or self._fit is None:
            self._cloud = clouds.gathered(self._cloud, best.ground, target.noise(best.seen), self._rng)
            if target.aligned and target.looks.is_shaped(best):
                self._cloud = clouds.turned(self._cloud, best.angle, _TURNED_STD, self._rng)
        if again:
            self._sightings.begin_anew(*self._cloud.velocity())
        self._missed, self._found = 0, self._found + 1
        self._seen_last = self._time
        self._outlook = None
        self._survey.clear()
        self._cloud = self._cloud.free()
        if best.seen > 0.7:
            # What hides a part of it holds it back, in every frame to the same side: that is no change of speed.
            unclear = 1.0 if target.is_clear(best.score) else _UNCLEAR
            self._sightings.add(self._time, best.ground, unclear * target.noise(best.seen, best.score))
            self._fit = self._sightings.fit() or self._fit
            if self._fit is not None and self._found > _STEADY:
                self._driving.saw(self._fit)
        if self._fit is not None and not again:
            old = self._time - self._fit.time
            to_place = _PULL_PLACE if old < 1e-6 and self._found > _AGAIN else 0.0
            self._cloud = clouds.pulled(self._cloud, self._fit, min(old, 0.5), _PULL, to_place, self._rng)
        self._cloud = self._cloud.resampled(self._rng, _NUMBER)
        target.place = self._cloud.weights @ self._cloud.place
        if best.seen > 0.9 and np.linalg.norm(target.place - self._trail[-1]) > 0.5:
            self._trail = [*self._trail[-60:], target.place]
        if not target.aligned:
            target.complete(image, best)
            fit = self._fit
            far = self._sightings.travelled() > _ALIGN_AFTER * target.length
            if fit is not None and far and best.seen > 0.97 and fit.velocity_std < 0.15 * fit.speed:
                target.align(image, fit)
                # What was beside an upright box may have been anything.
                self._road.forget()
                self._relearn = True
        elif self._found > 3:
            if verdict.sureness > 0.9 and best.seen > 0.98:
                target.grow_used(best.score)
            if verdict.sureness > 0.9 and not verdict.crowded:
                target.feel_light(image, best)
            if self._frame % 4 == 0 and _is_sure(verdict):
                target.study(image, best)

    def _not_seen(self, dt: float) -> None:
        """It is not there: the cloud drives on, along the ways that the road offers."""
        self._missed, self._found = self._missed + 1, 0
        self._target.shade.fade(dt)
        if self._outlook is None:
            trail = np.array(self._trail[-25:])
            self._outlook = Outlook(self._cloud, self._fit, self._time, self._road, trail)
            self._cloud = self._outlook.begin(self._cloud, self._fit, self._time, self._road, self._driving, self._rng)
        else:
            self._cloud = self._outlook.again(self._cloud, self._time, self._road, self._rng)
        self._cloud = self._cloud.resampled(self._rng, _NUMBER)

    def _learn_road(self, small: Image, teach: bool) -> None:
        """Add the picture to the road map; ``teach``: first learn what road looks like beside the target."""
        target, placing = self._target, self._placing
        lit = placing.light.undone(small)
        outline = target.outline(target.place, self._heading, 1.35)
        if teach:
            ring = [target.outline(target.place, self._heading, grown) for grown in (1.5, 1.8)]
            edge = np.concatenate([footprint.between(corners) for corners in ring])
            behind = [p for p in self._trail[:-1] if np.linalg.norm(p - target.place) > 1.2 * target.length]
            places = np.concatenate([edge, np.array(behind).reshape(-1, 2)])
            pixels = placing.pixels(places)
            pixels = pixels[placing.plane.inside(pixels, 2.0)]
            at = np.clip((pixels / placing.factor).astype(int), 0, [small.shape[1] - 1, small.shape[0] - 1])
            rate = 1.0 if self._relearn else _ROAD_RATE
            self._road.learn(lit[at[:, 1], at[:, 0]], lit[::4, ::4].reshape(-1, 3), rate)
            self._relearn = False
        self._road.update(lit, placing.factor, placing.plane, placing.matrix, outline if self._missed == 0 else None)

    def _reroot(self, estimate: Estimate) -> None:
        """Begin the ground frame anew where telemetry now gives a better one."""
        box = Box(
            estimate.x - 0.5 * estimate.width, estimate.y - 0.5 * estimate.height, estimate.width, estimate.height
        )
        root = self._placing.better_root(self._time, box)
        if root is None:
            return
        change = np.linalg.inv(root.motion.matrix) @ self._placing.matrix
        step = 0.5
        near = transfer(change, self._target.place + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        if not np.isfinite(near).all():
            return
        self._placing.take(root)
        jacobian = np.column_stack([near[1] - near[0], near[2] - near[0]]) / step
        self._target.moved(near[0], jacobian)
        self._sightings.moved(change)
        self._fit = self._sightings.fit()
        self._cloud = self._cloud.moved(change)
        self._driving.rescaled(float(np.sqrt(abs(np.linalg.det(jacobian)))))
        self._tracklets.clear()
        self._survey.clear()
        self._trail = [p for p in transfer(change, np.array(self._trail)) if np.isfinite(p).all()]
        old, self._road = self._road, RoadMap(near[0])
        self._road.take(old, change)

    def _estimate(self, time: float) -> Estimate:
        """What is known now."""
        found = answer(self._cloud, self._target, self._placing, self._missed, time, self._time - self._seen_last)
        self._state = found.state
        return replace(found, layers=self._layers())

    def _layers(self) -> Layers:
        placing, road, place = self._placing, self._road, self._cloud.weights @ self._cloud.place
        ways = self._outlook.ways if self._outlook is not None else []
        named = {f"way {k}": partial(placing.pixels, way.points) for k, way in enumerate(ways)}
        return Layers(
            {
                "tracks": lambda: placing.tracks,
                "road": lambda: placing.pixels(road.outline(place, _ROAD_SHOWN)),
                **named,
            }
        )


def _is_sure(verdict: Verdict) -> bool:
    """Whether the target is wholly and surely seen, alone and as it always looks: then it may be learnt from."""
    best = verdict.best
    if best is None or verdict.crowded:
        return False
    return verdict.sureness > 0.9 and best.score > 0.75 and best.seen > 0.98
