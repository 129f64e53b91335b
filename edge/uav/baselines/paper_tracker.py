"""The paper's tracker: a particle filter whose likelihood also asks the background (sections 3 and 4).

The parts are in ``edge.uav.baselines``, each function with its equation; here they are put together. Known to lose the
car where the paper's own does: where it leaves the road, and where shift and rotation are too little for the flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.baselines import histograms, regions
from edge.uav.baselines.background import BackgroundFilter, Motion
from edge.uav.baselines.car import BackgroundAware, RoadSteered, Scene
from edge.uav.baselines.plain_tracker import AppearanceJudge
from edge.uav.baselines.road import Course, Road, course
from edge.uav.baselines.road_filter import RoadFilter, support
from edge.uav.baselines.target import check_image, check_target, fits, seen_share
from edge.uav.baselines.white_lines import Edges, sections
from edge.uav.prediction import particles as pf
from edge.uav.tracker import Box, Estimate, Hypothesis, Image, State, Telemetry
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_FASTEST = 0.3  # of the box's longer side, a frame, at the start
_SPEED_NOISE = 0.004  # of the box's longer side, a frame
_FIRST_PARTICLES = 600
_FEWEST, _MOST = 300, 800
_BEYOND = 0.8  # image diagonals that the road is extrapolated by
_COURSE_STEP = 6.0  # px
_SEEN = 0.5  # of the box that must lie in the image to be called visible
_USELESS = 0.35  # image diagonals: a cloud with a larger std says nothing
_DIRECTION_MEMORY = 0.15  # a frame
_DOUBTFUL = 0.6  # of a road in the picture has white lines: the target may be on another one
_RETRACED_EVERY = 10  # frames, while the road is doubtful and the target in full sight
_CLUSTER = 1.5  # radius of a hypothesis, in the box's longer side


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What the tracker makes of its last frame, for pictures and tests.

    labels, corrected: (h/4, w/4) regions before and after the road's correction. course: the road's, or None.
    motion: the background's into this frame. direction: of travel along the course, 0 where unknown.
    """

    labels: regions.Labels
    corrected: regions.Labels
    course: Course | None
    motion: Motion
    direction: int


class PaperTracker:
    """Follows by colour, road and regions. Lens, mounting and telemetry are taken but not used: the paper has none.

    size: (width, height) [px]. section: 4 for the paper's final model, 3 for the one of section 3.2. teach: statistics
    of road and other; without, they are learnt from the first frame.
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
        teach: regions.RegionStatistics | None = None,
    ) -> None:
        del lens, body_from_camera
        self.size, self.fps = size, fps
        self._section, self._teach = section, teach
        self._rng = np.random.default_rng(seed)
        self._centre = (np.array(size, dtype=np.float64) - 1.0) / 2.0
        self._diagonal = float(np.hypot(*size))
        self._started: _Started | None = None

    @property
    def view(self) -> View:
        """Of the last frame. Raises RuntimeError before ``begin``."""
        return self._ready().view

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Learn target, road and regions. Raises InputError for a box that can't be one or an image of another size."""
        check_target(target, self.size)
        check_image(image, self.size)
        grey = _grey(image)
        background = BackgroundFilter(self.size, self._rng)
        background.begin(grey, target)
        road_filter = RoadFilter(self.size, self._rng)
        road, marked = _first_road(grey, target, road_filter)
        drawn = self._drawn(road)
        small = regions.reduced(image)
        statistics = self._teach or regions.learn(small, _first_road_pixels(small, target, drawn))
        self._started = started = _Started(target, image, background, road_filter, road, statistics)
        started.marked = marked
        started.view = _looked_at(small, statistics, drawn, Motion(), 0)
        started.cloud = pf.Particles.evenly(self._first_states(target, drawn))
        longer = max(target.width, target.height)
        kind = RoadSteered if self._section == 3 else BackgroundAware
        started.model = kind(self._centre, _SPEED_NOISE * longer)
        started.number = pf.AdaptiveNumber((longer / 2, longer / 2, longer / 20, 0.35), fewest=_FEWEST, most=_MOST)
        started.model.before = self._scene(image, started)
        return self._estimate(time, State.VISIBLE, started)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Taken and not used: section 4 estimates the camera's motion from the picture alone."""

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Follow into the next frame. None, or an image of another shape, is a frame in which nothing was seen.

        Raises RuntimeError before ``begin``.
        """
        started = self._ready()
        usable = image if image is not None and fits(image, self.size) else None
        if usable is not None:
            self._look(usable, started)
        scene = self._scene(usable, started)
        started.model.motion = started.view.motion
        started.cloud = pf.step(
            started.cloud,
            started.model,
            scene if usable is not None else None,
            self._rng,
            resample_below=0.7,
            number=started.number,
        )
        started.model.before = scene
        state = self._state(scene, started)
        if state is State.VISIBLE:
            started.learn_direction()
        return self._estimate(time, state, started)

    def _look(self, image: Image, started: _Started) -> None:
        """Background, road and regions of a new frame."""
        grey = _grey(image)
        place = started.place()
        box = Box(
            place[0] - started.box.width / 2, place[1] - started.box.height / 2, started.box.width, started.box.height
        )
        motion = started.background.step(grey, box)
        edges = Edges.of(grey, started.marked)
        share = 0.0
        if started.road is not None:
            started.road = started.road_filter.step(started.road.moved(motion, self._centre), edges)
            if started.road is not None and started.marked:
                share = support(started.road, edges)[1]
        started.frames += 1
        seen = started.visible and seen_share(place[0], place[1], box, self.size) >= 1.0
        if share < _DOUBTFUL and seen and started.frames % _RETRACED_EVERY == 0:
            found, marked = _first_road(grey, box, started.road_filter)
            better = found is not None and support(found, Edges.of(grey, marked))[1] > share
            if better and (marked or started.road is None):
                started.road, started.marked = found, marked
                started.forget_direction()
        drawn = self._drawn(started.road)
        small = regions.reduced(image)
        started.view = _looked_at(small, started.statistics, drawn, motion, started.direction)
        sure = np.zeros(small.shape[:2], dtype=np.bool_)
        if drawn is not None:
            sure = regions.road_mask(drawn, (small.shape[0], small.shape[1]), np.zeros(2), 0.8, known=True)
        started.statistics = started.statistics.adapted(small, started.view.corrected, sure)

    def _scene(self, image: Image | None, started: _Started) -> Scene:
        view = started.view
        return Scene(
            image=image,
            box=started.box,
            template=started.template,
            mean=started.template if image is None else histograms.mean_histogram(image),
            course=view.course,
            direction=started.direction,
            existence=regions.existence(view.corrected, view.course, started.box) if self._section == 4 else None,
        )

    def _state(self, scene: Scene, started: _Started) -> State:
        """Visible: its box lies in the frame and shows the target. Lost: the cloud is as wide as the picture."""
        place = started.place()
        started.visible = False
        if scene.image is not None and seen_share(place[0], place[1], started.box, self.size) >= _SEEN:
            similarity = histograms.seen_similarity(scene.image, place[None], started.box, started.template)[0]
            started.visible = started.judge.accepts(float(similarity))
        if started.visible:
            return State.VISIBLE
        return State.LOST if started.spread() > _USELESS * self._diagonal else State.COASTING

    def _drawn(self, road: Road | None) -> Course | None:
        return None if road is None else course(road, _BEYOND * self._diagonal, _COURSE_STEP)

    def _first_states(self, target: Box, drawn: Course | None) -> Floats:
        """(n, 4): any speed up to a limit, along the road both ways, or any way where none is known."""
        count, rng = _FIRST_PARTICLES, self._rng
        place = np.array([target.x + target.width / 2, target.y + target.height / 2])
        heading = rng.uniform(-np.pi, np.pi, count)
        if drawn is not None:
            tangent = drawn.nearest(place[None])[1][0]
            heading = tangent + np.pi * rng.integers(0, 2, count) + rng.normal(0.0, 0.2, count)
        speed = rng.uniform(0.0, _FASTEST * max(target.width, target.height), count)
        return np.column_stack([place + rng.normal(0.0, 1.0, (count, 2)), speed, heading])

    def _estimate(self, time: float, state: State, started: _Started) -> Estimate:
        """The densest cluster's mean; the paper does not say which point of the cloud it takes."""
        states, weights = started.cloud.states, started.cloud.weights
        parts = started.clusters
        total = sum(part.weight for part in parts)
        x, y = started.place()
        chosen = parts[0].members
        share = weights[chosen] / weights[chosen].sum()
        heading = np.where(states[chosen, 2] < 0.0, states[chosen, 3] + np.pi, states[chosen, 3])
        layers: dict[str, Floats] = {}
        if started.view.course is not None:
            layers = _outlines(started.view.course)
        lost = state is State.LOST
        return Estimate(
            time=time,
            state=state,
            x=float("nan") if lost else float(x),
            y=float("nan") if lost else float(y),
            width=started.box.width,
            height=started.box.height,
            heading=float("nan") if lost else pf.circular_mean(heading, share),
            std=started.spread(),
            hypotheses=tuple(
                Hypothesis(part.weight / total, float(part.centre[0]), float(part.centre[1])) for part in parts
            )
            if len(parts) > 1
            else (),
            particles=states[:, :2],
            layers=layers,
        )

    def _ready(self) -> _Started:
        if self._started is None:
            raise RuntimeError("begin comes before handle_frame")
        return self._started


class _Started:
    """What there is once the target is known; changed frame by frame."""

    def __init__(
        self,
        box: Box,
        image: Image,
        background: BackgroundFilter,
        road_filter: RoadFilter,
        road: Road | None,
        statistics: regions.RegionStatistics,
    ) -> None:
        self.box, self.background, self.road_filter, self.road = box, background, road_filter, road
        self.statistics = statistics
        self.template = histograms.target_histogram(image, box)
        self.judge = AppearanceJudge.beside(image, box, self.template)
        self._cloud = pf.Particles.evenly(np.zeros((1, 4)))
        self._place = np.zeros(2)
        self.model: RoadSteered | BackgroundAware
        self.number: pf.AdaptiveNumber
        self.view: View
        self.visible = True
        self.marked = True
        self.frames = 0
        self._progress = 0.0  # mean of V cos(theta - tangent) lately [px a frame]
        self._progress_frames = 0

    @property
    def direction(self) -> int:
        """Of travel along the road's order: +1, -1, or 0 until it is clear."""
        clear = self._progress_frames >= 8 and abs(self._progress) > 0.01 * max(self.box.width, self.box.height)
        return int(np.sign(self._progress)) if clear else 0

    def learn_direction(self) -> None:
        """From the velocity of the cloud in a frame in which the target was seen."""
        if self.view.course is None:
            return
        weights, states = self.cloud.weights, self.cloud.states
        _, tangent = self.view.course.nearest(states[:, :2])
        progress = float(weights @ (states[:, 2] * np.cos(states[:, 3] - tangent)))
        self._progress += _DIRECTION_MEMORY * (progress - self._progress)
        self._progress_frames += 1

    def forget_direction(self) -> None:
        """For another road."""
        self._progress, self._progress_frames = 0.0, 0

    @property
    def cloud(self) -> pf.Particles:
        """The car's particles."""
        return self._cloud

    @cloud.setter
    def cloud(self, cloud: pf.Particles) -> None:
        self._cloud = cloud
        radius = _CLUSTER * max(self.box.width, self.box.height)
        self.clusters = pf.clusters(cloud.states[:, :2], cloud.weights, radius)
        self._place = self.clusters[0].centre

    def place(self) -> Floats:
        """(2,) the densest cluster's middle."""
        return self._place

    def spread(self) -> float:
        """Std of one coordinate about the estimate, of the whole cloud."""
        off = self.cloud.states[:, :2] - self.place()
        return float(np.sqrt(0.5 * self.cloud.weights @ np.square(off).sum(axis=1)))


def _grey(image: Image) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _first_road(grey: npt.NDArray[np.uint8], target: Box, road_filter: RoadFilter) -> tuple[Road | None, bool]:
    """And whether it is a marked one: without white lines, any edges have to do."""
    beside = sections(grey, target)
    for marked in (True, False):
        road = road_filter.begin(Edges.of(grey, marked), beside)
        if road is not None:
            return road, marked
    return None, True


def _first_road_pixels(small: Image, target: Box, drawn: Course | None) -> npt.NDArray[np.bool_]:
    """Which pixels of the reduced first frame are road: within its shape near the target, else a ring about it."""
    height, width = small.shape[:2]
    x, y = np.meshgrid(np.arange(width) * regions.SCALE, np.arange(height) * regions.SCALE)
    dx = np.abs(x - target.x - target.width / 2) / (target.width / 2 + 4.0)
    dy = np.abs(y - target.y - target.height / 2) / (target.height / 2 + 4.0)
    beside = np.maximum(dx, dy) > 1.0
    if drawn is not None:
        within = regions.road_mask(drawn, (height, width), np.zeros(2), 0.8, known=True) & beside
        if within.sum() > 30:
            return np.asarray(within)
    ring = beside & (np.maximum(dx, dy) < 1.6)
    return np.asarray(ring if ring.sum() > 8 else beside)


def _looked_at(
    small: Image, statistics: regions.RegionStatistics, drawn: Course | None, motion: Motion, direction: int
) -> View:
    labels = regions.classify(small, statistics)
    return View(labels, regions.corrected(labels, drawn), drawn, motion, direction)


def _outlines(drawn: Course) -> dict[str, Floats]:
    """The road's middle and white lines, for overlays."""
    normal = np.column_stack([-np.sin(drawn.headings), np.cos(drawn.headings)])
    return {
        "road": drawn.points,
        "white line left": drawn.points - drawn.half_width * normal,
        "white line right": drawn.points + drawn.half_width * normal,
    }
