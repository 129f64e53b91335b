"""The manoeuvre model: a marker that reverses, a ball that bounces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from edge.scenes.common.base import look_at_pose
from hub.tracking.detections import TrackingCamera
from hub.tracking.filter import kalman
from hub.tracking.filter.kalman import LOG_SIZE, STATE_DIM, VELOCITY
from hub.tracking.filter.prediction import (
    fused_predictions,
    gpb1_update,
    manoeuvre_hypothesis,
    predict_targets,
    widened_by_evidence,
    within_reach,
)
from hub.tracking.filter.target_models import KIND_INDEX, MARKER, PERSON
from hub.tracking.filter.target_states import Targets
from hub.tracking.parameters import TrackerParameters
from hub.tracking.tracker import Tracker
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb

LENS = Intrinsics(640, 480, np.array([[450.0, 0, 319.5], [0, 450.0, 239.5], [0, 0, 1.0]]))
FPS, SECONDS, CAMERAS, TURN_S = 10.0, 3.0, 5, 1.51
Path = Callable[[float], Floats]


def back_and_forth(t: float) -> Floats:
    """At 3 m/s, and back on the same line."""
    return np.array([1.5 - 3.0 * abs(t - TURN_S), 0.3, 1.2])


def ball(t: float) -> Floats:
    """Thrown up again by the floor every 0.9 s, at 4.4 m/s."""
    since = (t + 0.9 - TURN_S) % 0.9
    return np.array([0.4 * t - 0.6, 0.2, 4.905 * since * (0.9 - since)])


def followed(path: Path) -> tuple[list[tuple[float, float]], int]:
    """Time and position error [m] after every frame of cameras around ``path``, and the number of confirmed tracks."""
    rng = np.random.default_rng(3)
    cameras, frames = {}, []
    for i in range(CAMERAS):
        angle = 2 * np.pi * i / CAMERAS
        place = np.array([5.0 * np.cos(angle), 5.0 * np.sin(angle), 2.0])
        camera = TrackingCamera(f"cam{i}", LENS, look_at_pose(place, np.array([0.0, 0.0, 1.0])), TimeMap(), 1e-4)
        cameras[camera.name] = camera
        frames += [((number + i / CAMERAS) / FPS, number, camera) for number in range(int(SECONDS * FPS))]
    tracker = Tracker(TrackerParameters(up=np.array([0.0, 0.0, 1.0])))
    tracker.calibrate(cameras)
    errors = []
    for moment, number, camera in sorted(frames, key=lambda one: one[0]):
        (pixel,) = LENS.project(camera.pose.camera_from_world(path(moment)[None])) + rng.normal(0.0, 1.0, 2)
        message = pb.Observation(
            schema_version=1, camera=camera.name, boot_id="b", sequence=number,
            device_time_ns=round(moment * NANOSECONDS),
        )  # fmt: skip
        message.detections.add(u=pixel[0], v=pixel[1], kind="marker", covariance=[1.0, 0.0, 1.0])
        tracker.handle(message)
        targets = tracker.advance().targets
        known = targets.select(targets.confirmed)
        if len(known):
            errors.append((moment, float(np.linalg.norm(known.mean[0, :3] - path(moment)))))
    return errors, tracker.state.next_number - 1


@pytest.mark.parametrize("path", [back_and_forth, ball])
def test_a_manoeuvring_target_is_not_lost(path: Path) -> None:
    """It keeps one track number, and three frames after the manoeuvre the error is small again."""
    errors, names = followed(path)
    assert names == 1
    calm = [error for moment, error in errors if moment > 0.8 and (moment - TURN_S) % 0.9 > 0.3]
    assert len(calm) > 40
    assert max(calm) < 0.1
    assert max(error for moment, error in errors if moment > 0.8) < 0.3


def seen_before(kind: str, unseen_s: float) -> Targets:
    """One target of a kind at 1 s, last seen ``unseen_s`` before."""
    one = np.array([1])
    seen = np.array([NANOSECONDS - round(unseen_s * NANOSECONDS)])
    return Targets(
        initiation_number=one, number=one, kind=np.array([KIND_INDEX[kind]]), mean=np.zeros((1, STATE_DIM)),
        covariance=np.eye(STATE_DIM)[None], colour=np.zeros((1, 3)), colour_count=np.ones(1), born_ns=seen,
        seen_ns=seen, hits=one, existence=np.ones(1), seen_by=seen[None], overlap=np.zeros(1),
    )  # fmt: skip


def test_the_manoeuvre_covariance_matches_sampling() -> None:
    """Against sampled velocity changes at uniform times since the last detection."""
    rng = np.random.default_rng(5)
    unseen, units_per_m = 0.2, 100.0
    jump = rng.normal(0.0, MARKER.manoeuvre_std_m_s * units_per_m, 400_000)
    drawn = np.cov(jump * rng.uniform(0.0, unseen, jump.size), jump)
    manoeuvre = manoeuvre_hypothesis(seen_before("marker", unseen), unseen, units_per_m)
    added = manoeuvre.covariance[0] - np.eye(STATE_DIM)
    for axis in range(3):
        rows = [axis, axis + 3]
        np.testing.assert_allclose(added[np.ix_(rows, rows)], drawn, rtol=0.02)
    assert manoeuvre.prior_odds[0] == pytest.approx(MARKER.manoeuvres_per_s * unseen, rel=0.1)
    long = within_reach(seen_before("marker", 1.0), np.ones(1), manoeuvre)
    assert long.prior_odds[0] == 0.0, "by then it could be anywhere"


def test_after_a_pause_of_a_day_a_manoeuvre_has_finite_odds() -> None:
    """Infinite ones made states that are no numbers, and warnings of numpy."""
    day = 86_400.0
    past, future = seen_before("person", day), seen_before("person", -day)
    state, covariance = fused_predictions(past, future, (day, day), 1.0, np.array([0.0, 0.0, 1.0]))
    assert np.isfinite(state).all()
    assert np.isfinite(covariance).all()


def test_people_set_off_and_stop_along_the_ground_and_sometimes() -> None:
    person, up = seen_before("person", 0.5), np.array([0.0, 0.0, 1.0])
    manoeuvre = manoeuvre_hypothesis(person, 0.5, 1.0, up)
    added = np.diag(manoeuvre.covariance[0] - np.eye(STATE_DIM))
    assert (added[[0, 1, 3, 4]] > 0.0).all()
    assert not added[[2, 5, 6]].any()
    assert 0.0 < manoeuvre.prior_odds[0] < 0.2


def test_people_sit_down_and_stand_up_with_their_feet_where_they_are() -> None:
    person, up = seen_before("person", 0.1), np.array([0.0, 0.0, 1.0])
    added = manoeuvre_hypothesis(person, 0.1, 1.0, up, posture=True).covariance[0] - np.eye(STATE_DIM)
    assert added[6, 6] > 0.15**2
    foot = np.zeros(STATE_DIM)
    foot[2], foot[6] = 1.0, -0.5  # of a person of size 1: height of the centre less half the height
    assert foot @ added @ foot == pytest.approx(0.0, abs=1e-12)


def test_who_runs_turns_harder_than_who_walks() -> None:
    """Players of a team sport who turned got a second number; walkers are predicted as before."""
    still = seen_before("person", 0.0)
    added = []
    for speed in (1.0, 2.0, 6.0):
        mean = still.mean.copy()
        mean[:, VELOCITY.start], mean[:, LOG_SIZE] = speed, np.log(PERSON.size_m)
        later = predict_targets(replace(still, mean=mean), 0.5, TrackerParameters())
        added.append(later.covariance[0, VELOCITY.start, VELOCITY.start] - 1.0)
    assert added[1] == pytest.approx(added[0])
    assert added[2] == pytest.approx(9.0 * added[0])


def test_who_takes_one_step_and_stands_again_is_no_surprise() -> None:
    """Half a metre aside at the former velocity, which a lasting change of velocity does not explain."""
    tall = np.log(PERSON.size_m) * (np.arange(STATE_DIM) == STATE_DIM - 1)
    person = replace(seen_before("person", 0.5), mean=tall[None], covariance=0.01 * np.eye(STATE_DIM)[None])
    aside = 0.5 * (np.arange(STATE_DIM) == 0)
    assert aside @ np.linalg.solve(manoeuvre_hypothesis(person, 0.5, 1.0).covariance[0], aside) < 3.0
    slow, fast = (manoeuvre_hypothesis(person, elapsed, 1.0).covariance[0, 0, 0] for elapsed in (4.0, 1 / 60))
    assert slow < 1.1 * 16.0 / 3.0, "a step has an end"
    assert fast < 0.011, "and takes its time"


@pytest.mark.parametrize("off", [0.1, 2.0])
def test_a_surprise_widens_a_prediction_and_what_was_expected_does_not(off: float) -> None:
    """In information form, and where past and future disagree."""
    person = seen_before("person", 0.5)
    tight = replace(person, covariance=0.01 * np.eye(STATE_DIM)[None])
    manoeuvre = manoeuvre_hypothesis(tight, 0.5, 1.0)
    information = np.zeros((1, STATE_DIM, STATE_DIM))
    information[:, :3, :3] = 400.0 * np.eye(3)
    measured = tight.mean + off * (np.arange(STATE_DIM) == 0)
    widened = widened_by_evidence(tight, manoeuvre, information, (information @ measured[:, :, None])[:, :, 0])
    surprised = off > 1.0
    assert (widened[0, 3, 3] > 0.2) == surprised
    later = replace(tight, mean=measured)
    _, covariance = fused_predictions(tight, later, (0.5, 0.5), 1.0, None)
    assert (covariance[0, 3, 3] > 0.05) == surprised


def test_the_more_likely_hypothesis_dominates() -> None:
    """A measurement near the prediction selects the first hypothesis, a distant one the second."""
    mean, tight, loose = np.zeros((1, STATE_DIM)), 0.01 * np.eye(STATE_DIM)[None], np.eye(STATE_DIM)[None]
    jacobian, noise, used = np.eye(2, STATE_DIM)[None], 0.01 * np.eye(2)[None], np.ones((1, 2), dtype=np.bool_)
    prior_odds = np.array([0.01])
    for off, leads in ((0.05, tight), (1.5, loose)):
        innovation = np.full((1, 2), off)
        got = gpb1_update(mean, tight, loose, prior_odds, innovation, jacobian, noise, used)
        alone = kalman.update(mean, leads, innovation, jacobian, noise, used)
        np.testing.assert_allclose(got[0], alone[0], atol=0.01)
        np.testing.assert_allclose(got[1], alone[1], atol=0.02)


def test_moment_matching_preserves_mean_and_covariance() -> None:
    rng = np.random.default_rng(6)
    means = rng.normal(size=(2, 1, STATE_DIM))
    roots = rng.normal(size=(2, STATE_DIM, STATE_DIM))
    covariances = [root @ root.T for root in roots]
    share = 0.3
    mean, covariance = kalman.moment_match(
        (means[0], covariances[0][None]), (means[1], covariances[1][None]), np.array([share])
    )
    # Second moments of the mixture, by their definition.
    parts = zip((1.0 - share, share), means[:, 0], covariances, strict=True)
    second = sum((weight * (c + np.outer(m, m)) for weight, m, c in parts), np.zeros((STATE_DIM, STATE_DIM)))
    np.testing.assert_allclose(mean[0], (1.0 - share) * means[0, 0] + share * means[1, 0])
    np.testing.assert_allclose(covariance[0], second - np.outer(mean[0], mean[0]), atol=1e-12)
