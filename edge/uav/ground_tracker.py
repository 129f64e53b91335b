"""One car tracked on the ground plane, also while it is outside the image.

Each frame: localise the camera over the ground (``CameraLocaliser``), search for the target where the particle set
predicts it (``Target``), weight the particles by detections and missed detections (``evaluate_candidates``), update the
road map, and estimate the target state (``estimate_target``).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from edge.uav.base import Box, Estimate, Telemetry, TrackState
from edge.uav.ground.image_plane import apply_homography
from edge.uav.ground.localisation import CameraLocaliser
from edge.uav.ground.overlay_layers import LazyLayers
from edge.uav.ground.road_map import RoadMap
from edge.uav.prediction import particle_filter as pf
from edge.uav.prediction import particle_set
from edge.uav.prediction.detection_probability import detection_probability
from edge.uav.prediction.driver_model import DriverModel
from edge.uav.prediction.occlusion import OcclusionPredictor
from edge.uav.prediction.particle_set import ParticleSet
from edge.uav.target import footprint
from edge.uav.target.appearance import Candidate
from edge.uav.target.box import check_target_box
from edge.uav.target.likelihood import MeasurementLikelihood, evaluate_candidates, raise_odds_limit
from edge.uav.target.motion_history import MotionFit, MotionHistory
from edge.uav.target.redetection import Redetector
from edge.uav.target.state_estimate import estimate_target
from edge.uav.target.target import Target
from edge.uav.target.tracklets import Tracklet, Tracklets
from protocols.geometry.camera import Intrinsics
from protocols.geometry.order_statistics import quantile
from protocols.geometry.types import Floats, Image, Ints

_SAMPLE_SIZE = pf.KldSampleSize(cell=(0.6, 0.6), error=0.05, confidence=0.99, min_count=150, max_count=500)
_INITIAL_COUNT = 400  # between the bounds of the sample size, which is computed from the next frame on
_VELOCITY_GAIN = 0.35  # of the nudging towards the motion fit, per frame
_POSITION_GAIN = 0.2  # the same for the position
_MIN_ALIGN_DISTANCE = 0.6  # distance travelled before the heading is used, in target lengths
_OCCLUDED_STD_FACTOR = 10.0  # on the std of a position in the motion fit when the target is partly occluded
_MAX_SLACK_FRAMES = 12  # over which the search tolerance of a car of unknown motion grows
_STABLE_FRAMES = 8  # consecutive detections before the ground frame may be changed
_REACQUIRE_AFTER = 3  # missed frames after which a detection is a re-acquisition
_MIN_TRACKLET_SCORE = 0.65  # mean score of a candidate at which particles are injected
_ROTATION_STEPS = (0.15, 0.3, 0.5, 0.8)  # by which candidates are matched rotated [rad]
_MAX_ROTATIONS = 3  # per frame
_ROTATED_CANDIDATES = 2  # number of best candidates matched rotated, in turn
_SAME_ANGLE_COSINE = 0.997  # above which two angles are the same
_HEADING_STD = 0.06  # of a heading from the template [rad]
_REDETECT_AFTER = 12  # missed frames after which the full frame is searched
# Weight of injected particles per second, and its limit: the target took an unknown path.
_INJECTION_RATE, _MAX_INJECTED_WEIGHT = 0.002, 0.02
_LOST_INJECTED_WEIGHT = 0.1  # the same limit once the target is lost
_TRACKLET_WEIGHT = 0.02  # of the particles injected at a tracklet
_ROAD_UPDATE_EVERY = 3  # frames
_ROAD_OVERLAY_REACH = 45.0  # about the target [ground units]
_ROAD_LEARNING_RATE = 0.15  # of the road's colour model
_ROAD_LEARN_EVERY = 12  # frames


class GroundTracker:
    """Tracker of one target. size: (width, height) [px]. lens, body_from_camera: without them telemetry is unused."""

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
        self._localiser = CameraLocaliser(size, lens, body_from_camera)
        self._initialised = False

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Initialise the target from its first frame. Raises InputError for an invalid box."""
        check_target_box(image, self._size, target)
        localiser = self._localiser
        working = localiser.working_image(image)
        localiser.begin(working, time, target)
        self._target = Target(image, localiser, target)
        position = self._target.position
        self._time, self._frame = time, 0
        self._road = RoadMap(position)
        self._history = MotionHistory()
        self._history.add(time, position, self._target.position_std(1.0))
        self._fit: MotionFit | None = None
        self._driver = DriverModel()
        self._occlusion: OcclusionPredictor | None = None
        self._particles = particle_set.initialise(position, 0.03 * self._target.length, _INITIAL_COUNT, self._rng)
        self._missed_frames, self._detected_frames = 0, 1  # consecutive frames without and with a detection
        self._tracklets = Tracklets()
        self._redetector = Redetector()
        self._last_seen = time
        self._state = TrackState.VISIBLE
        self._trail: list[Floats] = [position]
        self._initialised = True
        self._relearn_road = True  # the colour model of the road
        self._learn_road(working, learn=True)
        return self._estimate(time)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Add one sample; without lens and mounting it is not used. Invalid samples are rejected."""
        if self._localiser.telemetry is not None:
            self._localiser.telemetry.add(sample)

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Track the target into the next frame; ``None`` for a frame that could not be decoded."""
        if not self._initialised:
            raise RuntimeError("begin first")
        dt = min(max(time - self._time, 1e-3), 2.0) if math.isfinite(time) else 1.0 / self._fps
        self._time += dt
        self._frame += 1
        paths = self._occlusion.paths if self._occlusion is not None else []
        self._particles = particle_set.propagate(self._particles, dt, paths, self._missed_frames == 0, self._rng)
        if image is None or image.shape[:2] != (self._size[1], self._size[0]):
            self._localiser.skip(dt)
            self._handle_miss(dt)
            return self._estimate(time)
        working = self._localiser.working_image(image)
        excluded = None
        if self._missed_frames == 0:
            excluded = self._localiser.target_pixels(self._target.outline(self._target.position, self._heading, 1.4))
        self._localiser.update(working, self._time, dt, excluded)
        measurement = self._measure(image, working)
        best = measurement.best
        if best is not None:
            self._handle_detection(image, best, measurement)
        else:
            self._handle_miss(dt)
        if self._localiser.frames_without_pose == 0 and (self._relearn_road or self._frame % _ROAD_UPDATE_EVERY == 0):
            learn = self._relearn_road or self._frame % _ROAD_LEARN_EVERY == 0
            self._learn_road(working, learn=learn and self._missed_frames == 0)
        estimate = self._estimate(time)
        if self._detected_frames > _STABLE_FRAMES and self._localiser.telemetry is not None:
            self._change_ground_frame(estimate)
        return estimate

    def road_outline(self) -> tuple[Floats, Floats | None]:
        """The observed road near the target: image pixels (n, 2), and north, east (n, 2) [m] where metric."""
        ground = self._road.road_cells(self._particles.weights @ self._particles.position, _ROAD_OVERLAY_REACH)
        return self._localiser.pixels(ground), ground if self._localiser.metric else None

    @property
    def metric(self) -> bool:
        """Whether the ground frame is in metres."""
        return self._localiser.metric

    @property
    def target_length(self) -> float:
        """Of the target's longer side on the ground [ground units]."""
        return self._target.length

    @property
    def view_cosine(self) -> float:
        """Cosine of the angle between optical axis and vertical; nan where no attitude is known."""
        return self._localiser.view_cosine

    @property
    def _heading(self) -> float:
        return pf.circular_mean(self._particles.heading, self._particles.weights)

    def _measure(self, image: Image, working: Image) -> MeasurementLikelihood:
        """Search the target where the particles lie inside the image, and reweight them."""
        target, localiser = self._target, self._localiser
        redetected = self._redetect(image, working) if self._missed_frames > _REDETECT_AFTER else []
        particles = self._particles
        pixels = localiser.target_pixels(particles.position)
        near = localiser.plane.inside(pixels, -0.3 * target.length * target.scale)
        share = float(particles.weights[near].sum())
        if share < 2e-3:
            return MeasurementLikelihood.empty()
        near_particles = np.flatnonzero(near)
        weights = particles.weights[near_particles] / share
        main, others, main_weight = near_particles, near_particles[:0], 1.0
        if self._missed_frames:
            cluster = pf.densest_cluster(particles.position[near_particles], weights, 2.0 * target.length)
            main, others = near_particles[cluster.members], near_particles[~cluster.members]
            main_weight = cluster.weight
        candidates = self._search(image, main, wide=True)
        if len(others) and main_weight < 0.97:
            # Particles outside the main cluster are searched in groups, another group each frame.
            centre = self._rng.choice(others)
            squared = np.square(particles.position[others] - particles.position[centre]).sum(axis=1)
            for found in self._search(image, others[squared < (1.5 * target.length) ** 2], wide=False):
                if all(np.linalg.norm(found.ground - c.ground) > 0.4 * target.length for c in candidates):
                    candidates.append(found)
        if target.aligned and candidates and not any(target.appearance.shape_matches(found) for found in candidates):
            candidates = self._search_rotated(image, candidates)
        min_distance = 0.4 * target.length
        for found in redetected:
            if all(np.linalg.norm(found.ground - c.ground) > min_distance for c in candidates):
                candidates.append(found)
        # While the motion is unknown, the tolerance covers wherever the target can have moved since its last detection.
        growth = 0.0 if target.aligned else 0.2 if self._fit is None else 0.1
        slack = growth * target.length * (1 + min(self._missed_frames, _MAX_SLACK_FRAMES))
        reacquiring = self._missed_frames > _REACQUIRE_AFTER
        tracklets = self._tracklets.update(self._time, candidates)
        if reacquiring and share > 0.5:
            particles = self._inject_at_tracklets(particles, tracklets)
            pixels = localiser.target_pixels(particles.position)
        measurement = evaluate_candidates(
            particles,
            candidates,
            tracklets,
            detection_probability(working, localiser, self._road, pixels, particles, target.length),
            lambda found: (
                target.position_std(found.visible_share) + slack,
                target.position_std(found.visible_share, found.score) + slack,
            ),
            target.length,
            reacquiring,
            lambda found: target.aligned and target.appearance.shape_matches(found),
            target.crab_angle,
        )
        if measurement.likelihood is not None:
            self._particles = particles.reweighted(measurement.likelihood)
        return measurement

    def _inject_at_tracklets(self, particles: ParticleSet, tracklets: list[Tracklet]) -> ParticleSet:
        """Inject a few particles at tracklets that look and move like the target where the particle set has none.

        Only where most particles should be visible and are not detected: then the particle set is probably wrong.
        """
        fit = self._fit
        if fit is None or fit.speed < 1.0:
            return particles
        for tracklet in tracklets:
            motion = tracklet.velocity()
            if motion is None or tracklet.age < 4 or tracklet.score < _MIN_TRACKLET_SCORE:
                continue
            speed = float(np.hypot(*motion[0]))
            reach = 2.0 * self._target.length + 0.6 * fit.speed * (self._time - self._last_seen)
            away = np.hypot(*(particles.position - tracklet.positions[-1]).T)
            distance = float(away.min())
            if not 0.4 * fit.speed < speed < 1.6 * fit.speed or distance > reach:
                continue
            # In the direction of the particles there, or at least not back where the target came from.
            headings = particles.heading[away < distance + self._target.length]
            course = np.arctan2(motion[0][1], motion[0][0])
            if np.cos(headings - course).max() < 0.7:
                continue
            particles = particle_set.inject_particles(
                particles, tracklet.positions[-1], motion, _TRACKLET_WEIGHT, self._rng
            )
            raise_odds_limit(tracklet, _TRACKLET_WEIGHT)
        return particles

    def _search(self, image: Image, members: Ints, wide: bool) -> list[Candidate]:
        """Candidates about some of the particles."""
        weights = self._particles.weights[members] + 1e-12
        weights = weights / weights.sum()
        positions = self._particles.position[members]
        centre = weights @ positions
        distance = np.hypot(*(positions - centre).T)
        reach = quantile(distance, 0.97) if wide else 1.5 * self._target.length
        angle = None
        if self._target.aligned:
            angle = pf.circular_mean(self._particles.heading[members], weights) + self._target.crab_angle
        if wide:
            self._target.update_resolution(centre)
            if angle is not None:
                self._target.angle = angle
        return self._target.search(image, centre, 1.1 + reach / self._target.length, angle)

    def _search_rotated(self, image: Image, candidates: list[Candidate]) -> list[Candidate]:
        """The candidates, one of them matched again at other headings: the target may have turned while out of view."""
        first = candidates[self._frame % min(len(candidates), _ROTATED_CANDIDATES)]
        near = self._tracklets.nearest(self._time, first.ground, 0.5 * self._target.length)
        angles = []
        if near is not None and near.age > 1:
            course = near.course()
            angles = [near.angle] if course is None else [near.angle, course + self._target.crab_angle]
        nearby = np.flatnonzero(np.square(self._particles.position - first.ground).sum(axis=1) < self._target.length**2)
        if len(nearby):
            angles.append(float(self._particles.heading[self._rng.choice(nearby)]) + self._target.crab_angle)
        step = _ROTATION_STEPS[self._frame // _ROTATED_CANDIDATES % len(_ROTATION_STEPS)]
        angles += [first.angle + step, first.angle - step]
        trial_angles = [angle for angle in angles if np.cos(angle - first.angle) < _SAME_ANGLE_COSINE][:_MAX_ROTATIONS]
        best = first
        for angle in trial_angles:
            found = self._target.search(image, first.ground, 1.1, angle)
            best = max([best, *found[:1]], key=lambda candidate: candidate.score)
        if best.score < first.score + 0.05:
            return candidates
        reach = 0.5 * self._target.length
        others = [c for c in candidates if c is not first and np.linalg.norm(c.ground - best.ground) > reach]
        return sorted([best, *others], key=lambda candidate: -candidate.score)

    def _redetect(self, image: Image, working: Image) -> list[Candidate]:
        """Candidates of the full-frame re-detection; particles are injected there, more the longer the target is lost.

        All predicted paths may be wrong. The candidates are evaluated together with those near the particles.
        """
        fit, target = self._fit, self._target
        if fit is None or not target.aligned or self._localiser.frames_without_pose:
            return []
        weight = min(_INJECTION_RATE * (self._time - self._last_seen), _MAX_INJECTED_WEIGHT)
        weight = _LOST_INJECTED_WEIGHT if self._state is TrackState.LOST else weight
        out = []
        for blob, found, plausibility in self._redetector.detect(
            image, working, self._localiser, target, fit, self._time
        ):
            if found.score < _MIN_TRACKLET_SCORE or not target.appearance.shape_matches(found):
                continue
            out.append(found)
            motion = blob.velocity()
            distance = np.square(self._particles.position - found.ground).sum(axis=1)
            local_weight = float(self._particles.weights[distance < (0.5 * target.length) ** 2].sum())
            if motion is not None and local_weight < weight * plausibility:
                self._particles = particle_set.inject_particles(
                    self._particles, found.ground, motion, weight * plausibility, self._rng
                )
        return out

    def _handle_detection(self, image: Image, best: Candidate, measurement: MeasurementLikelihood) -> None:
        """Update motion, position and appearance from a detection."""
        target = self._target
        reacquiring = self._missed_frames > _REACQUIRE_AFTER
        if reacquiring or self._fit is None:
            self._particles = particle_set.reinitialise_at(
                self._particles, best.ground, target.position_std(best.visible_share), self._rng
            )
            if target.aligned and target.appearance.shape_matches(best):
                heading = best.angle - target.crab_angle + self._rng.normal(0.0, _HEADING_STD, len(self._particles))
                self._particles = replace(self._particles, heading=heading)
        if reacquiring:
            self._history.restart(*self._particles.mean_velocity())
        self._missed_frames, self._detected_frames = 0, self._detected_frames + 1
        self._last_seen = self._time
        self._occlusion = None
        self._redetector.reset()
        self._particles = self._particles.without_paths()
        if best.visible_share > 0.7:
            # An occluder shifts the match to the same side in every frame, which is no change of speed.
            std_factor = 1.0 if target.is_unoccluded(best.score) else _OCCLUDED_STD_FACTOR
            self._history.add(self._time, best.ground, std_factor * target.position_std(best.visible_share, best.score))
            self._fit = self._history.fit() or self._fit
            if self._fit is not None and self._detected_frames > _STABLE_FRAMES:
                self._driver.update(self._fit)
        if self._fit is not None and not reacquiring:
            fit_age = self._time - self._fit.time
            position_gain = _POSITION_GAIN if fit_age < 1e-6 and self._detected_frames > _REACQUIRE_AFTER else 0.0
            self._particles = particle_set.nudge_to_fit(
                self._particles, self._fit, min(fit_age, 0.5), _VELOCITY_GAIN, position_gain, self._rng
            )
        self._particles = self._particles.resampled(self._rng, _SAMPLE_SIZE)
        target.position = self._particles.weights @ self._particles.position
        if best.visible_share > 0.9 and np.linalg.norm(target.position - self._trail[-1]) > 0.5:
            self._trail = [*self._trail[-60:], target.position]
        if not target.aligned:
            target.relearn_if_more_visible(image, best)
            fit = self._fit
            moved_enough = self._history.distance_travelled() > _MIN_ALIGN_DISTANCE * target.length
            if fit is not None and moved_enough and best.visible_share > 0.97 and fit.velocity_std < 0.15 * fit.speed:
                target.align(image, fit)
                # The surroundings of an upright box need not have been road.
                self._road.reset()
                self._relearn_road = True
        elif self._detected_frames > 3:
            sure, complete = measurement.posterior > 0.9, best.visible_share > 0.98
            if sure and complete:
                target.update_typical_score(best.score)
                if not reacquiring and best.angle != target.angle:
                    target.update_crab_angle(best, self._heading)
            if sure and not measurement.ambiguous:
                target.update_local_gain(best)
                if self._frame % 4 == 0 and complete and best.score > 0.75:
                    target.update_appearance(image, best)

    def _handle_miss(self, dt: float) -> None:
        """Predict: without a detection the particles move on, along the road paths."""
        self._missed_frames, self._detected_frames = self._missed_frames + 1, 0
        self._target.local_gain.decay(dt)
        if self._occlusion is None:
            trail = np.array(self._trail[-25:])
            self._occlusion = OcclusionPredictor(self._particles, self._fit, self._time, self._road, trail)
            self._particles = self._occlusion.begin(
                self._particles, self._fit, self._time, self._road, self._driver, self._rng
            )
        else:
            self._particles = self._occlusion.update(self._particles, self._time, self._road, self._rng)
        self._particles = self._particles.resampled(self._rng, _SAMPLE_SIZE)

    def _learn_road(self, working: Image, learn: bool) -> None:
        """Add the image to the road map; ``learn``: first update the colour model from the road beside the target."""
        target, localiser = self._target, self._localiser
        corrected = localiser.photometric.corrected(working)
        outline = target.outline(target.position, self._heading, 1.35)
        if learn:
            ring = [target.outline(target.position, self._heading, enlarged) for enlarged in (1.5, 1.8)]
            beside = np.concatenate([footprint.edge_points(corners) for corners in ring])
            behind = [p for p in self._trail[:-1] if np.linalg.norm(p - target.position) > 1.2 * target.length]
            positions = np.concatenate([beside, np.array(behind).reshape(-1, 2)])
            pixels = localiser.pixels(positions)
            pixels = pixels[localiser.plane.inside(pixels, 2.0)]
            at = np.clip((pixels / localiser.downscale).astype(int), 0, [working.shape[1] - 1, working.shape[0] - 1])
            rate = 1.0 if self._relearn_road else _ROAD_LEARNING_RATE
            self._road.learn_colours(corrected[at[:, 1], at[:, 0]], corrected[::4, ::4].reshape(-1, 3), rate)
            self._relearn_road = False
        covered = outline if self._missed_frames == 0 else None
        self._road.update(corrected, localiser.downscale, localiser.plane, localiser.matrix, covered)

    def _change_ground_frame(self, estimate: Estimate) -> None:
        """Change to another ground frame where telemetry now gives a better one."""
        width, height = estimate.width, estimate.height
        box = Box(estimate.x - 0.5 * width, estimate.y - 0.5 * height, width, height)
        frame = self._localiser.better_frame(self._time, box)
        if frame is None:
            return
        change = np.linalg.inv(frame.pose.matrix) @ self._localiser.matrix
        step = 0.5
        near = apply_homography(change, self._target.position + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        if not np.isfinite(near).all():
            return
        self._localiser.switch_frame(frame)
        jacobian = np.column_stack([near[1] - near[0], near[2] - near[0]]) / step
        self._target.change_frame(near[0], jacobian)
        self._history.transform(change)
        self._fit = self._history.fit()
        self._particles = self._particles.transformed(change)
        self._driver.rescale(float(np.sqrt(abs(np.linalg.det(jacobian)))))
        self._tracklets.reset()
        self._redetector.reset()
        self._trail = [p for p in apply_homography(change, np.array(self._trail)) if np.isfinite(p).all()]
        previous_map, self._road = self._road, RoadMap(near[0])
        self._road.transfer_from(previous_map, change)

    def _estimate(self, time: float) -> Estimate:
        """The state estimate with its overlay layers."""
        found = estimate_target(
            self._particles, self._target, self._localiser, self._missed_frames, time, self._time - self._last_seen
        )
        self._state = found.state
        localiser, road, position = self._localiser, self._road, self._particles.weights @ self._particles.position
        paths = self._occlusion.paths if self._occlusion is not None else []
        named = {f"path {k}": partial(localiser.pixels, path.points) for k, path in enumerate(paths)}
        cells = partial(road.road_cells, position, _ROAD_OVERLAY_REACH)
        drawn = LazyLayers({"tracks": lambda: localiser.tracks, "road": lambda: localiser.pixels(cells()), **named})
        return replace(found, layers=drawn)
