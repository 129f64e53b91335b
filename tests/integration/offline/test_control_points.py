"""Control points with stds are measurements that improve the estimate, beyond fixing the datum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.geometry import so3
from protocols.geometry.pose import fit_similarity
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


def gauge_only(session: rigs.Session, surveyed_session: rigs.Session) -> Floats:
    """Position errors where the survey only places the world: one similarity onto the surveyed positions."""
    poses = {name: one.pose for name, one in calibrate(session.rig, session.observations()).cameras.items()}
    given = [surveyed_session.rig.cameras[name].position for name in poses]
    found = fit_similarity(np.array([pose.position for pose in poses.values()]), np.array(given))
    return np.array(
        [np.linalg.norm(found.pose(pose).position - session.poses[name].position) for name, pose in poses.items()]
    )


def weak_session(seed: int) -> rigs.Session:
    """Little motion and much noise: poses are determined to about a centimetre."""
    return rigs.simulate(seed, 3, 12.0, noise=2.5, late=1.0)


@pytest.fixture(scope="module")
def both() -> tuple[Floats, Floats, Floats]:
    """Position errors (sessions, 3) with weighted control points, with them as gauge only, and the stated stds."""
    weighed, only, stated = [], [], []
    for seed in range(3):
        session = weak_session(seed)
        surveyed_session = surveyed(session, seed, _STD)
        found = calibrate(surveyed_session.rig, session.observations())
        weighed.append(errors(session, found))
        stated.append([np.linalg.norm(one.position_std) for one in found.cameras.values()])
        only.append(gauge_only(session, surveyed_session))
    return np.array(weighed), np.array(only), np.array(stated)


def test_weighted_control_points_are_better_than_the_gauge_alone(both: tuple[Floats, Floats, Floats]) -> None:
    weighed, only, _ = both
    assert np.sqrt((weighed**2).mean()) < 0.8 * np.sqrt((only**2).mean())
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
    session = replace(session, pixels=session.pixels + slow_errors(session, 1.2))
    std = 0.002
    surveyed_session = surveyed(session, 7, std, stated_std=std)
    found = calibrate(surveyed_session.rig, session.observations())
    assert any(step.stage == "correlated noise" for step in found.convergence)
    rms = [float(np.sqrt(np.mean(one**2))) for one in (errors(session, found), gauge_only(session, surveyed_session))]
    assert rms[0] < 1.5 * np.sqrt(3.0) * std
    assert rms[1] > 1.5 * rms[0]


@pytest.mark.parametrize("correlated", [False, True])
def test_control_points_without_std_hold_exactly(correlated: bool) -> None:
    session = surveyed(rigs.simulate(5, 4, 40.0, noise=0.4, late=1.0, drops=0.0), 3, _STD)
    if correlated:
        session = replace(session, pixels=session.pixels + slow_errors(session, 1.2))
    cameras = {name: replace(camera, position_std=None) for name, camera in session.rig.cameras.items()}
    cameras["cam1"] = replace(cameras["cam1"], rotation=session.poses["cam1"].rotation)
    cameras["cam3"] = replace(cameras["cam3"], position=None)
    apart = 1.001 * float(np.linalg.norm(session.poses["cam3"].position - session.poses["cam0"].position))
    rig = replace(session.rig, cameras=cameras, distances=(("cam0", "cam3", apart),))
    found = calibrate(rig, session.observations()).cameras
    for name in ("cam0", "cam1", "cam2"):
        assert np.abs(found[name].pose.position - cameras[name].position).max() < 1e-9
        assert found[name].position_std.max() == 0.0
    assert so3.angle_between(found["cam1"].pose.rotation, session.poses["cam1"].rotation) < 1e-9
    assert np.linalg.norm(found["cam3"].pose.position - found["cam0"].pose.position) == pytest.approx(apart, abs=1e-9)
    assert found["cam3"].position_std.max() > 0.0


def slow_errors(session: rigs.Session, std: float) -> Floats:
    """Errors (n, 2) [px] that are correlated from frame to frame."""
    rng, out = np.random.default_rng(6), np.zeros_like(session.pixels)
    for name in session.rig.cameras:
        mine = np.flatnonzero(session.of_camera(name))
        steps = rng.normal(0.0, std, (len(mine), 2))
        for i in range(1, len(mine)):
            steps[i] = 0.98 * steps[i - 1] + np.sqrt(1.0 - 0.98**2) * steps[i]
        out[mine] = steps
    return out


def test_a_reference_wrong_by_twelve_stds_is_named_and_an_honest_survey_is_not() -> None:
    session = surveyed(rigs.simulate(24, 4, 12.0), 0, 0.004)
    assert not [text for text in calibrate(session.rig, session.observations()).warnings if "control point" in text]
    camera = session.rig.cameras["cam1"]
    assert camera.position is not None
    wrong = replace(camera, position=camera.position + [0.0, 12.0 * _STD, 0.0])
    rig = replace(session.rig, cameras=session.rig.cameras | {"cam1": wrong})
    found = calibrate(rig, session.observations())
    (named,) = [text for text in found.warnings if "control point" in text]
    assert named.startswith("the control point of cam1 was rejected as an outlier")
    assert errors(session, found).max() < 4.0 * _STD
