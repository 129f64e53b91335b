"""The background-aware particle filter tracker of the paper (sections 3 and 4).

The parts are in ``edge.uav.baselines``, each function with its equation; here they are combined. Known limitations are
those of the paper: cars that leave the road, and flights whose background motion is not a shift and rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.base import Box, Estimate, Hypothesis, Telemetry, TrackState
from edge.uav.baselines import histograms, regions
from edge.uav.baselines.background import BackgroundFilter, BackgroundMotion
from edge.uav.baselines.car_models import BackgroundAwareModel, FrameObservation, RoadSteeredModel
from edge.uav.baselines.plain_tracker import MIN_VISIBLE_SHARE, AppearanceTest
from edge.uav.baselines.road import RoadCourse, RoadMidline, extrapolated_course
from edge.uav.baselines.road_filter import RoadFilter, line_support
from edge.uav.baselines.white_lines import EdgeDistance, find_sections
from edge.uav.prediction import particle_filter as pf
from edge.uav.target.box import check_target_box, has_frame_format, visible_share
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

_MAX_INITIAL_SPEED = 0.3  # of the box's longer side, per frame
_SPEED_NOISE = 0.004  # of the box's longer side, a frame
_FIRST_PARTICLES = 600  # of the first frame, in which speed and heading are unknown
_MIN_PARTICLES, _MAX_PARTICLES = 300, 800  # of the KLD sample size: fewer lose another road, more cost CPU
_EXTRAPOLATION = 0.8  # image diagonals: length of the road extrapolation
_COURSE_STEP = 6.0  # px
_LOST_SPREAD = 0.35  # image diagonals: with a larger std of the particles the target is lost
_DIRECTION_UPDATE_RATE = 0.15  # per frame
_MIN_MARKED_SHARE = 0.6  # share of the visible road with white lines; below it the target may be on another road
_RETRACE_INTERVAL = 10  # frames between searches for another road, while the target is fully visible
_CLUSTER = 1.5  # radius of a hypothesis, in the box's longer side


@dataclass(frozen=True, slots=True, eq=False)
class FrameDiagnostics:
    """Intermediate results of the last frame, for figures and tests.

    labels, corrected: (h/4, w/4) regions before and after correction by the road. course: of the road, or None.
    motion: of the background into this frame. direction: of travel along the course, 0 if unknown.
    """

    labels: regions.Labels
    corrected: regions.Labels
    course: RoadCourse | None
    motion: BackgroundMotion
    direction: int


class PaperTracker:
    """Tracks by colour, road and regions. Lens, mounting and telemetry are accepted but ignored, as in the paper.

    size: (width, height) [px]. section: 4 for the paper's final model, 3 for the one of section 3.2.
    """

    def __init__(
        self,
        size: tuple[int, int],
        lens: Intrinsics | None = None,
        body_from_camera: Floats | None = None,
        fps: float = 30.0,
        seed: int = 0,
        *,
        section: Literal[3, 4] = 4,
    ) -> None:
        del lens, body_from_camera
        self.size, self.fps = size, fps
        self._section = section
        self._rng = np.random.default_rng(seed)
        self._centre = (np.array(size, dtype=np.float64) - 1.0) / 2.0
        self._diagonal = float(np.hypot(*size))
        self._track: _Track | None = None

    @property
    def diagnostics(self) -> FrameDiagnostics:
        """Intermediate results of the last frame. Raises RuntimeError before ``begin``."""
        return self._ready().diagnostics

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Learn target, road and regions. Raises InputError for an invalid box or an image of another size."""
        check_target_box(image, self.size, target)
        grey = _grey(image)
        background = BackgroundFilter(self.size, self._rng)
        background.begin(grey, target)
        road_filter = RoadFilter(self.size, self._rng)
        road, marked = _first_road(grey, target, road_filter)
        road_course = self._road_course(road)
        small = regions.reduced(image)
        statistics = regions.learn_statistics(small, _first_road_pixels(small, target, road_course))
        self._track = track = _Track(target, image, background, road_filter, road, statistics)
        track.marked = marked
        track.diagnostics = _diagnose(small, statistics, road_course, BackgroundMotion(), 0)
        track.particles = pf.Particles.uniform(self._first_states(target, road_course))
        longer = max(target.width, target.height)
        model_class = RoadSteeredModel if self._section == 3 else BackgroundAwareModel
        track.model = model_class(self._centre, _SPEED_NOISE * longer)
        track.number = pf.KldSampleSize(
            (longer / 2, longer / 2, longer / 20, 0.35), min_count=_MIN_PARTICLES, max_count=_MAX_PARTICLES
        )
        track.model.previous = self._observation(image, track)
        return self._estimate(time, TrackState.VISIBLE, track)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Accepted and ignored: section 4 estimates the camera's motion from images alone."""

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Predict and update with the next frame. None, or an image of another shape, is a frame without measurement.

        Raises RuntimeError before ``begin``.
        """
        track = self._ready()
        usable = image if image is not None and has_frame_format(image, self.size) else None
        if usable is not None:
            self._look(usable, track)
        observation = self._observation(usable, track)
        track.model.motion = track.diagnostics.motion
        seen = observation if usable is not None else None
        track.particles = pf.step(
            track.particles, track.model, seen, self._rng, resample_below=0.7, number=track.number
        )
        track.model.previous = observation
        state = self._state(observation, track)
        if state is TrackState.VISIBLE:
            track.learn_direction()
        return self._estimate(time, state, track)

    def _look(self, image: Image, track: _Track) -> None:
        """Update background, road and regions from a new frame."""
        grey = _grey(image)
        position = track.position()
        box = Box(
            position[0] - track.box.width / 2, position[1] - track.box.height / 2, track.box.width, track.box.height
        )
        motion = track.background.step(grey, box)
        edges = EdgeDistance.of(grey, track.marked)
        share = 0.0
        if track.road is not None:
            track.road = track.road_filter.step(track.road.moved(motion, self._centre), edges)
            if track.road is not None and track.marked:
                share = line_support(track.road, edges)[1]
        track.frames += 1
        seen = track.visible and visible_share(position[0], position[1], box, self.size) >= 1.0
        if share < _MIN_MARKED_SHARE and seen and track.frames % _RETRACE_INTERVAL == 0:
            found, marked = _first_road(grey, box, track.road_filter)
            better = found is not None and line_support(found, EdgeDistance.of(grey, marked))[1] > share
            if better and (marked or track.road is None):
                track.road, track.marked = found, marked
                track.forget_direction()
        road_course = self._road_course(track.road)
        small = regions.reduced(image)
        track.diagnostics = _diagnose(small, track.statistics, road_course, motion, track.direction)
        road_core = np.zeros(small.shape[:2], dtype=np.bool_)
        if road_course is not None:
            road_core = regions.road_mask(road_course, (small.shape[0], small.shape[1]), np.zeros(2), 0.8, known=True)
        track.statistics = track.statistics.adapted(small, track.diagnostics.corrected, road_core)

    def _observation(self, image: Image | None, track: _Track) -> FrameObservation:
        diagnostics = track.diagnostics
        return FrameObservation(
            image=image,
            box=track.box,
            template=track.template,
            mean=track.template if image is None else histograms.mean_histogram(image),
            course=diagnostics.course,
            direction=track.direction,
            existence=regions.existence(diagnostics.corrected, diagnostics.course, track.box)
            if self._section == 4
            else None,
        )

    def _state(self, observation: FrameObservation, track: _Track) -> TrackState:
        """Visible: the box lies in the frame and shows the target. Lost: the particles spread as wide as the image."""
        position = track.position()
        track.visible = False
        if (
            observation.image is not None
            and visible_share(position[0], position[1], track.box, self.size) >= MIN_VISIBLE_SHARE
        ):
            similarity = histograms.visible_similarity(observation.image, position[None], track.box, track.template)[0]
            track.visible = track.appearance_test.accepts(float(similarity))
        if track.visible:
            return TrackState.VISIBLE
        return TrackState.LOST if track.spread() > _LOST_SPREAD * self._diagonal else TrackState.COASTING

    def _road_course(self, road: RoadMidline | None) -> RoadCourse | None:
        return None if road is None else extrapolated_course(road, _EXTRAPOLATION * self._diagonal, _COURSE_STEP)

    def _first_states(self, target: Box, road_course: RoadCourse | None) -> Floats:
        """(n, 4): any speed up to a limit, along the road in both directions, or any heading without a road."""
        count, rng = _FIRST_PARTICLES, self._rng
        position = np.array([target.x + target.width / 2, target.y + target.height / 2])
        heading = rng.uniform(-np.pi, np.pi, count)
        if road_course is not None:
            tangent = road_course.nearest(position[None])[1][0]
            heading = tangent + np.pi * rng.integers(0, 2, count) + rng.normal(0.0, 0.2, count)
        speed = rng.uniform(0.0, _MAX_INITIAL_SPEED * max(target.width, target.height), count)
        return np.column_stack([position + rng.normal(0.0, 1.0, (count, 2)), speed, heading])

    def _estimate(self, time: float, state: TrackState, track: _Track) -> Estimate:
        """The densest cluster's mean; the paper does not state its point estimate."""
        states, weights = track.particles.states, track.particles.weights
        parts = track.clusters
        total = sum(part.weight for part in parts)
        x, y = track.position()
        chosen = parts[0].members
        share = weights[chosen] / weights[chosen].sum()
        heading = np.where(states[chosen, 2] < 0.0, states[chosen, 3] + np.pi, states[chosen, 3])
        layers: dict[str, Floats] = {}
        if track.diagnostics.course is not None:
            layers = _outlines(track.diagnostics.course)
        lost = state is TrackState.LOST
        return Estimate(
            time=time,
            state=state,
            x=float("nan") if lost else float(x),
            y=float("nan") if lost else float(y),
            width=track.box.width,
            height=track.box.height,
            heading=float("nan") if lost else pf.circular_mean(heading, share),
            std=track.spread(),
            hypotheses=tuple(
                Hypothesis(part.weight / total, float(part.centre[0]), float(part.centre[1])) for part in parts
            )
            if len(parts) > 1
            else (),
            particles=states[:, :2],
            layers=layers,
        )

    def _ready(self) -> _Track:
        if self._track is None:
            raise RuntimeError("begin comes before handle_frame")
        return self._track


class _Track:
    """State of the tracker after initialisation; updated with every frame."""

    def __init__(
        self,
        box: Box,
        image: Image,
        background: BackgroundFilter,
        road_filter: RoadFilter,
        road: RoadMidline | None,
        statistics: regions.RegionStatistics,
    ) -> None:
        self.box, self.background, self.road_filter, self.road = box, background, road_filter, road
        self.statistics = statistics
        self.template = histograms.target_histogram(image, box)
        self.appearance_test = AppearanceTest.from_surroundings(image, box, self.template)
        self._particles = pf.Particles.uniform(np.zeros((1, 4)))
        self._position = np.zeros(2)
        self.model: RoadSteeredModel | BackgroundAwareModel
        self.number: pf.KldSampleSize
        self.diagnostics: FrameDiagnostics
        self.visible = True
        self.marked = True
        self.frames = 0
        self._progress = 0.0  # exponential mean of V cos(theta - tangent) [px a frame]
        self._progress_frames = 0

    @property
    def direction(self) -> int:
        """Direction of travel along the order of the road's points: +1, -1, or 0 while undetermined."""
        clear = self._progress_frames >= 8 and abs(self._progress) > 0.01 * max(self.box.width, self.box.height)
        return int(np.sign(self._progress)) if clear else 0

    def learn_direction(self) -> None:
        """Update the direction of travel from the particles' velocity in a frame with a visible target."""
        if self.diagnostics.course is None:
            return
        weights, states = self.particles.weights, self.particles.states
        _, tangent = self.diagnostics.course.nearest(states[:, :2])
        progress = float(weights @ (states[:, 2] * np.cos(states[:, 3] - tangent)))
        self._progress += _DIRECTION_UPDATE_RATE * (progress - self._progress)
        self._progress_frames += 1

    def forget_direction(self) -> None:
        """Reset the direction of travel, for another road."""
        self._progress, self._progress_frames = 0.0, 0

    @property
    def particles(self) -> pf.Particles:
        """The car's particles."""
        return self._particles

    @particles.setter
    def particles(self, particles: pf.Particles) -> None:
        self._particles = particles
        radius = _CLUSTER * max(self.box.width, self.box.height)
        self.clusters = pf.clusters(particles.states[:, :2], particles.weights, radius)
        self._position = self.clusters[0].centre

    def position(self) -> Floats:
        """Centre (2,) of the densest cluster."""
        return self._position

    def spread(self) -> float:
        """Std per coordinate about the estimate, over all particles."""
        off = self.particles.states[:, :2] - self.position()
        return float(np.sqrt(0.5 * self.particles.weights @ np.square(off).sum(axis=1)))


def _grey(image: Image) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _first_road(grey: npt.NDArray[np.uint8], target: Box, road_filter: RoadFilter) -> tuple[RoadMidline | None, bool]:
    """The road in the first frame and whether it has white lines; without any, Canny edges are used."""
    sections = find_sections(grey, target)
    for marked in (True, False):
        road = road_filter.begin(EdgeDistance.of(grey, marked), sections)
        if road is not None:
            return road, marked
    return None, True


def _first_road_pixels(small: Image, target: Box, road_course: RoadCourse | None) -> npt.NDArray[np.bool_]:
    """Road pixels of the reduced first frame: within the road model beside the target, else a ring about it."""
    height, width = small.shape[:2]
    x, y = np.meshgrid(np.arange(width) * regions.SCALE, np.arange(height) * regions.SCALE)
    dx = np.abs(x - target.x - target.width / 2) / (target.width / 2 + 4.0)
    dy = np.abs(y - target.y - target.height / 2) / (target.height / 2 + 4.0)
    beside = np.maximum(dx, dy) > 1.0
    if road_course is not None:
        within = regions.road_mask(road_course, (height, width), np.zeros(2), 0.8, known=True) & beside
        if within.sum() > 30:
            return np.asarray(within)
    ring = beside & (np.maximum(dx, dy) < 1.6)
    return np.asarray(ring if ring.sum() > 8 else beside)


def _diagnose(
    small: Image,
    statistics: regions.RegionStatistics,
    road_course: RoadCourse | None,
    motion: BackgroundMotion,
    direction: int,
) -> FrameDiagnostics:
    labels = regions.classify(small, statistics)
    return FrameDiagnostics(labels, regions.corrected(labels, road_course), road_course, motion, direction)


def _outlines(road_course: RoadCourse) -> dict[str, Floats]:
    """Midline and white lines of the road, for overlays."""
    normal = np.column_stack([-np.sin(road_course.headings), np.cos(road_course.headings)])
    return {
        "road": road_course.points,
        "white line left": road_course.points - road_course.half_width * normal,
        "white line right": road_course.points + road_course.half_width * normal,
    }
