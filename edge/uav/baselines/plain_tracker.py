"""Section 2 of the paper: a particle filter on colour alone, which knows nothing of the background.

The reference that the other models are measured against. It follows (x, y, V, theta) in the image, so it takes the
drone's motion for the car's, and outside the image it has nothing to hold on to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.baselines import histograms
from edge.uav.baselines.target import check_image, check_target, fits, seen_share
from edge.uav.prediction import particles as pf
from edge.uav.tracker import Box, Estimate, Image, State, Telemetry
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_FASTEST = 0.25  # of the box's longer side, a frame, at the start
_SPEED_NOISE = 0.03  # of the box's longer side, a frame
_TURN_NOISE = 0.2  # rad a frame
_PARTICLES = 400
_SEEN = 0.5  # of the box that must lie in the image to be called visible
_PATIENCE = 2.0  # s without a look at the target until it is lost
_ALIKE = 0.8  # quantile of the similarities around the target that stands for the background
_MEMORY = 0.05  # of the typical similarity, a frame


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What a particle is compared with. template: (BINS,)."""

    image: Image
    box: Box
    template: Floats


class ColourModel:
    """States (x, y, V, theta): pixels, pixels a frame, radians."""

    def __init__(self, speed_noise: float, turn_noise: float = _TURN_NOISE) -> None:
        self.speed_noise, self.turn_noise = speed_noise, turn_noise

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Eqs. (2.3) to (2.5): straight on by V along theta; V and theta are random walks."""
        x, y, speed, heading = states.T
        return np.column_stack(
            [
                x + speed * np.cos(heading),
                y + speed * np.sin(heading),
                speed + rng.normal(0.0, self.speed_noise, len(states)),
                heading + rng.normal(0.0, self.turn_noise, len(states)),
            ]
        )

    def log_likelihood(self, states: Floats, observation: _Seen) -> Floats:
        """Eqs. (2.7), (2.8)."""
        similarity = histograms.seen_similarity(observation.image, states[:, :2], observation.box, observation.template)
        return histograms.colour_log_likelihood(similarity)


class AppearanceJudge:
    """Whether a similarity is the target's or the background's; the paper has no such notion.

    The border lies halfway between what the background shows and what the target has shown lately. Where the two
    hardly differ (a grey car on a grey road), the histogram cannot tell, and hardly anything is accepted.
    """

    def __init__(self, background: float) -> None:
        self.background, self.typical = background, 1.0

    @classmethod
    def beside(cls, image: Image, box: Box, template: Floats) -> AppearanceJudge:
        """The background is the more similar of the places around a box in the first frame."""
        turn = np.arange(24) * (2.0 * np.pi / 24)
        reach = np.array([1.3, 2.2, 3.1])[:, None] * max(box.width, box.height)
        centre = np.array([box.x + box.width / 2, box.y + box.height / 2])
        around = centre + np.stack([reach * np.cos(turn), reach * np.sin(turn)], axis=-1).reshape(-1, 2)
        return cls(float(np.quantile(histograms.seen_similarity(image, around, box, template), _ALIKE)))

    def accepts(self, similarity: float) -> bool:
        """Whether this is the target; if so, it counts for what is typical of it."""
        good = similarity > 0.5 * (self.background + self.typical)
        if good:
            self.typical += _MEMORY * (similarity - self.typical)
        return good


class PlainTracker:
    """Follows by colour alone. size: (width, height) [px]; lens, mounting and telemetry are taken but not used."""

    def __init__(
        self,
        size: tuple[int, int],
        lens: Intrinsics | None = None,
        body_from_camera: Floats | None = None,
        fps: float = 30.0,
        seed: int = 0,
    ) -> None:
        del lens, body_from_camera
        self.size, self.fps = size, fps
        self._rng = np.random.default_rng(seed)
        self._started: _Started | None = None

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Learn the target's histogram. Raises InputError for a box that can't be one or an image of another size."""
        check_target(target, self.size)
        check_image(image, self.size)
        longer = max(target.width, target.height)
        centre = np.array([target.x + target.width / 2, target.y + target.height / 2])
        template = histograms.target_histogram(image, target)
        states = np.column_stack(
            [
                centre + self._rng.normal(0.0, 1.0, (_PARTICLES, 2)),
                self._rng.uniform(0.0, _FASTEST * longer, _PARTICLES),
                self._rng.uniform(-np.pi, np.pi, _PARTICLES),
            ]
        )
        judge = AppearanceJudge.beside(image, target, template)
        self._started = _Started(target, template, ColourModel(_SPEED_NOISE * longer), judge)
        self._started.cloud = pf.Particles.evenly(states)
        return self._started.estimate(time, State.VISIBLE)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Taken and not used: section 2 knows only the picture."""

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Follow into the next frame. None, or an image of another shape, is a frame in which nothing was seen.

        Raises RuntimeError before ``begin``.
        """
        started = self._started
        if started is None:
            raise RuntimeError("begin comes before handle_frame")
        usable = image if image is not None and fits(image, self.size) else None
        seen = None if usable is None else _Seen(usable, started.box, started.template)
        started.cloud = pf.step(started.cloud, started.model, seen, self._rng)
        return started.estimate(time, self._state(usable, started))

    def _state(self, image: Image | None, started: _Started) -> State:
        place = pf.weighted_mean(started.cloud.states, started.cloud.weights)[:2]
        good = False
        if image is not None and seen_share(place[0], place[1], started.box, self.size) >= _SEEN:
            similarity = histograms.seen_similarity(image, place[None], started.box, started.template)[0]
            good = started.judge.accepts(float(similarity))
        started.unseen = 0 if good else started.unseen + 1
        if good:
            return State.VISIBLE
        return State.LOST if started.unseen > _PATIENCE * self.fps else State.COASTING


class _Started:
    """What there is once the target is known."""

    def __init__(self, box: Box, template: Floats, model: ColourModel, judge: AppearanceJudge) -> None:
        self.box, self.template, self.model, self.judge = box, template, model, judge
        self.cloud = pf.Particles.evenly(np.zeros((1, 4)))
        self.unseen = 0

    def estimate(self, time: float, state: State) -> Estimate:
        weights, states = self.cloud.weights, self.cloud.states
        x, y = pf.weighted_mean(states, weights)[:2]
        spread = pf.weighted_covariance(states[:, :2], weights)
        lost = state is State.LOST
        # A car that backs away in (2.3) has its heading behind it.
        heading = pf.circular_mean(np.where(states[:, 2] < 0.0, states[:, 3] + np.pi, states[:, 3]), weights)
        return Estimate(
            time=time,
            state=state,
            x=float("nan") if lost else float(x),
            y=float("nan") if lost else float(y),
            width=self.box.width,
            height=self.box.height,
            heading=float("nan") if lost else heading,
            std=float(np.sqrt(0.5 * np.trace(spread))),
            particles=states[:, :2],
        )
