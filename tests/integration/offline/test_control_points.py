"""Control points with stds are measurements that improve the estimate, beyond fixing the datum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration
from tests.support import rigs

_STD = 0.004  # m


def surveyed(session: rigs.Session, seed: int, std: float | None, stated_std: float = _STD) -> rigs.Session:
    """The session with surveyed camera positions of error ``std``, stated as ``stated_std`` (``std`` None: none)."""
    rng = np.random.default_rng(seed)
    cameras = {}
    for name, camera in session.rig.cameras.items():
        position = session.poses[name].position + rng.normal(0.0, 1.0, 3) * (0.0 if std is None else std)
        cameras[name] = replace(camera, position=position, position_std=None if std is None else np.full(3, stated_std))
    return replace(session, rig=replace(session.rig, cameras=cameras))


def errors(session: rigs.Session, found: Calibration) -> Floats:
    return np.array(
        [np.linalg.norm(one.pose.position - session.poses[name].position) for name, one in found.cameras.items()]
    )


def weak_session(seed: int) -> rigs.Session:
    """Little motion and much noise: poses are determined to about a centimetre."""
    return rigs.simulate(seed, 3, 12.0, noise=2.5, late=1.0)


@pytest.fixture(scope="module")
def both() -> tuple[Floats, Floats, Floats]:
    """Position errors (sessions, 3) with weighted control points, with them as gauge only, and the stated stds."""
    weighed, gauge_only, stated = [], [], []
    for seed in range(3):
        session = weak_session(seed)
        surveyed_session = surveyed(session, seed, _STD)
        found = calibrate(surveyed_session.rig, session.observations())
        weighed.append(errors(session, found))
        stated.append([np.linalg.norm(one.position_std) for one in found.cameras.values()])
        without_stds = {
            name: replace(camera, position_std=None) for name, camera in surveyed_session.rig.cameras.items()
        }
        gauge_only.append(
            errors(session, calibrate(replace(surveyed_session.rig, cameras=without_stds), session.observations()))
        )
    return np.array(weighed), np.array(gauge_only), np.array(stated)


def test_weighted_control_points_are_better_than_the_gauge_alone(both: tuple[Floats, Floats, Floats]) -> None:
    weighed, gauge_only, _ = both
    assert np.sqrt((weighed**2).mean()) < 0.8 * np.sqrt((gauge_only**2).mean())
    # No worse than the survey itself.
    assert np.sqrt((weighed**2).mean()) < 1.1 * np.sqrt(3.0) * _STD


def test_the_stated_stds_include_the_control_points(both: tuple[Floats, Floats, Floats]) -> None:
    weighed, _, stated = both
    assert 0.6 < np.sqrt((weighed**2).mean() / (stated**2).mean()) < 1.6


def test_control_points_with_large_stds_change_nothing() -> None:
    session = weak_session(11)
    loose = calibrate(surveyed(session, 1, _STD, stated_std=1e3).rig, session.observations())
    plain = calibrate(session.rig, session.observations())
    # The strength of the smoothness prior is estimated again, which moves the trajectory by less than its std.
    apart = [
        [np.linalg.norm(one[a].pose.position - one[b].pose.position) for a, b in (("cam0", "cam1"), ("cam0", "cam2"))]
        for one in (loose.cameras, plain.cameras)
    ]
    assert apart[0][1] / apart[0][0] == pytest.approx(apart[1][1] / apart[1][0], rel=5e-4)


def test_a_camera_moved_after_the_survey_is_reported_and_does_not_affect_the_others() -> None:
    session = surveyed(rigs.simulate(21, 4, 10.0), 2, _STD)
    bumped = replace(session.rig.cameras["cam2"], position=session.poses["cam2"].position + [0.0, 0.3, 0.0])
    rig = replace(session.rig, cameras=session.rig.cameras | {"cam2": bumped})
    found = calibrate(rig, session.observations())
    assert [text for text in found.warnings if "cam2 was rejected" in text]
    assert not found.refused
    assert errors(session, found).max() < 4.0 * _STD


def test_control_points_keep_their_weight_with_correlated_noise() -> None:
    """Generalised least squares weights them too: cameras surveyed to 2 mm stay there, others follow the noise."""
    session = rigs.simulate(5, 4, 40.0, noise=0.4, late=1.0, drops=0.0)
    rng = np.random.default_rng(6)
    pixels = session.pixels.copy()
    for name in session.rig.cameras:
        mine = np.flatnonzero([one == name for one in session.camera])
        steps = rng.normal(0.0, 1.2, (len(mine), 2))
        for i in range(1, len(mine)):
            steps[i] = 0.98 * steps[i - 1] + np.sqrt(1.0 - 0.98**2) * steps[i]
        pixels[mine] += steps
    session = replace(session, pixels=pixels)
    std = 0.002
    surveyed_session = surveyed(session, 7, std, stated_std=std)
    without_stds = {name: replace(camera, position_std=None) for name, camera in surveyed_session.rig.cameras.items()}
    found = calibrate(surveyed_session.rig, session.observations())
    loose = calibrate(replace(surveyed_session.rig, cameras=without_stds), session.observations())
    assert any(step.stage == "correlated noise" for step in found.convergence)
    rms = [float(np.sqrt(np.mean(errors(session, one) ** 2))) for one in (found, loose)]
    assert rms[0] < 1.5 * np.sqrt(3.0) * std
    assert rms[1] > 2.0 * rms[0]
