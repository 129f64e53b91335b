"""Colour-only particle filter tracker (section 2 of the paper), without a background model.

The baseline of the other models. It estimates (x, y, V, theta) in the image, so the drone's motion is attributed to
the car, and outside the image there is no measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.base import Box, Estimate, Telemetry, TrackState
from edge.uav.baselines import histograms
from edge.uav.prediction import particle_filter as pf
from edge.uav.target.box import check_target_box, has_frame_format, visible_share
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

_MAX_INITIAL_SPEED = 0.25  # of the box's longer side, per frame
_SPEED_NOISE = 0.03  # of the box's longer side, a frame
_TURN_NOISE = 0.2  # rad a frame
_PARTICLES = 400  # more cost CPU, fewer lose a target that turns
MIN_VISIBLE_SHARE = 0.5  # of the box that must lie in the image to be called visible
_LOST_AFTER_S = 2.0  # s without a visible target until the state is lost
_BACKGROUND_QUANTILE = 0.8  # quantile of the similarities around the target, taken for the background
_UPDATE_RATE = 0.05  # exponential update of the typical similarity, per frame


@dataclass(frozen=True, slots=True, eq=False)
class _ColourObservation:
    """The observation that particles are weighted with. template: (BINS,)."""

    image: Image
    box: Box
    template: Floats


class ColourModel:
    """States (x, y, V, theta): pixels, pixels a frame, radians."""

    def __init__(self, speed_noise: float, turn_noise: float = _TURN_NOISE) -> None:
        self.speed_noise, self.turn_noise = speed_noise, turn_noise

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Eqs. (2.3) to (2.5): motion by V along theta; V and theta are random walks."""
        x, y, speed, heading = states.T
        faster, turn = (rng.normal(0.0, std, len(states)) for std in (self.speed_noise, self.turn_noise))
        x, y = x + speed * np.cos(heading), y + speed * np.sin(heading)
        return np.column_stack([x, y, speed + faster, heading + turn])

    def log_likelihood(self, states: Floats, observation: _ColourObservation) -> Floats:
        """Eqs. (2.7), (2.8)."""
        similarity = histograms.visible_similarity(
            observation.image, states[:, :2], observation.box, observation.template
        )
        return histograms.colour_log_likelihood(similarity)


class AppearanceTest:
    """Visibility test: does a similarity belong to the target or the background? (Not in the paper.)

    The threshold lies halfway between the background's similarity and the target's recent one. Where the two hardly
    differ (a grey car on a grey road), the histogram does not discriminate, and hardly anything is accepted.
    """

    def __init__(self, background: float) -> None:
        self.background, self.typical = background, 1.0

    @classmethod
    def from_surroundings(cls, image: Image, box: Box, template: Floats) -> AppearanceTest:
        """From the first frame: the background similarity is a high quantile over boxes around the target."""
        turn = np.arange(24) * (2.0 * np.pi / 24)
        reach = np.array([1.3, 2.2, 3.1])[:, None] * max(box.width, box.height)
        centre = np.array([box.x + box.width / 2, box.y + box.height / 2])
        around = centre + np.stack([reach * np.cos(turn), reach * np.sin(turn)], axis=-1).reshape(-1, 2)
        return cls(
            float(np.quantile(histograms.visible_similarity(image, around, box, template), _BACKGROUND_QUANTILE))
        )

    def accepts(self, similarity: float) -> bool:
        """Whether this is the target; if so, update the typical similarity."""
        accepted = similarity > 0.5 * (self.background + self.typical)
        if accepted:
            self.typical += _UPDATE_RATE * (similarity - self.typical)
        return accepted


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
        self._track: _Track | None = None

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Learn the target's histogram. Raises InputError for an invalid box or an image of another size."""
        check_target_box(image, self.size, target)
        longer = max(target.width, target.height)
        centre = np.array([target.x + target.width / 2, target.y + target.height / 2])
        template = histograms.target_histogram(image, target)
        states = np.column_stack(
            [
                centre + self._rng.normal(0.0, 1.0, (_PARTICLES, 2)),
                self._rng.uniform(0.0, _MAX_INITIAL_SPEED * longer, _PARTICLES),
                self._rng.uniform(-np.pi, np.pi, _PARTICLES),
            ]
        )
        appearance_test = AppearanceTest.from_surroundings(image, target, template)
        self._track = _Track(target, template, ColourModel(_SPEED_NOISE * longer), appearance_test)
        self._track.particles = pf.Particles.uniform(states)
        return self._track.estimate(time, TrackState.VISIBLE)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Accepted and ignored: section 2 uses images only."""

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Predict and update with the next frame. None, or an image of another shape, is a frame without measurement.

        Raises RuntimeError before ``begin``.
        """
        track = self._track
        if track is None:
            raise RuntimeError("begin comes before handle_frame")
        usable = image if image is not None and has_frame_format(image, self.size) else None
        observation = None if usable is None else _ColourObservation(usable, track.box, track.template)
        track.particles = pf.step(track.particles, track.model, observation, self._rng)
        return track.estimate(time, self._state(usable, track))

    def _state(self, image: Image | None, track: _Track) -> TrackState:
        position = pf.weighted_mean(track.particles.states, track.particles.weights)[:2]
        accepted = False
        if image is not None and visible_share(position[0], position[1], track.box, self.size) >= MIN_VISIBLE_SHARE:
            similarity = histograms.visible_similarity(image, position[None], track.box, track.template)[0]
            accepted = track.appearance_test.accepts(float(similarity))
        track.unseen = 0 if accepted else track.unseen + 1
        if accepted:
            return TrackState.VISIBLE
        return TrackState.LOST if track.unseen > _LOST_AFTER_S * self.fps else TrackState.COASTING


class _Track:
    """State of the tracker after initialisation."""

    def __init__(self, box: Box, template: Floats, model: ColourModel, appearance_test: AppearanceTest) -> None:
        self.box, self.template, self.model, self.appearance_test = box, template, model, appearance_test
        self.particles = pf.Particles.uniform(np.zeros((1, 4)))
        self.unseen = 0

    def estimate(self, time: float, state: TrackState) -> Estimate:
        weights, states = self.particles.weights, self.particles.states
        x, y = pf.weighted_mean(states, weights)[:2]
        spread = pf.weighted_covariance(states[:, :2], weights)
        lost = state is TrackState.LOST
        # A negative speed in (2.3) means that the direction of travel is opposite to theta.
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
