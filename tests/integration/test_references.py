"""References beyond the gauge: positions with stds are measurements that improve what was seen, as far as they can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration
from tests import rigs

_STD = 0.004  # m


def surveyed(session: rigs.Session, seed: int, std: float | None, told: float = _STD) -> rigs.Session:
    """The session with every camera's position measured, ``std`` off, and told to be ``told`` off (None: not told)."""
    rng = np.random.default_rng(seed)
    cameras = {}
    for name, camera in session.rig.cameras.items():
        position = session.poses[name].position + rng.normal(0.0, 1.0, 3) * (0.0 if std is None else std)
        cameras[name] = replace(camera, position=position, position_std=None if std is None else np.full(3, told))
    return replace(session, rig=replace(session.rig, cameras=cameras))


def errors(session: rigs.Session, found: Calibration) -> Floats:
    return np.array(
        [np.linalg.norm(one.pose.position - session.poses[name].position) for name, one in found.cameras.items()]
    )


def weak(seed: int) -> rigs.Session:
    """Little motion, much noise: the poses are known to a centimetre or so."""
    return rigs.simulate(seed, 3, 12.0, noise=2.5, late=1.0)


@pytest.fixture(scope="module")
def both() -> tuple[Floats, Floats, Floats]:
    """Position errors (sessions, 3): with all references weighed, with them as the gauge only, and the stated stds."""
    weighed, gauge_only, stated = [], [], []
    for seed in range(3):
        session = weak(seed)
        sure = surveyed(session, seed, _STD)
        found = calibrate(sure.rig, session.observations())
        weighed.append(errors(session, found))
        stated.append([np.linalg.norm(one.position_std) for one in found.cameras.values()])
        untold = {name: replace(camera, position_std=None) for name, camera in sure.rig.cameras.items()}
        gauge_only.append(errors(session, calibrate(replace(sure.rig, cameras=untold), session.observations())))
    return np.array(weighed), np.array(gauge_only), np.array(stated)


def test_weighed_references_beat_the_gauge_alone(both: tuple[Floats, Floats, Floats]) -> None:
    weighed, gauge_only, _ = both
    assert np.sqrt((weighed**2).mean()) < 0.8 * np.sqrt((gauge_only**2).mean())
    # No worse than the survey itself.
    assert np.sqrt((weighed**2).mean()) < 1.1 * np.sqrt(3.0) * _STD


def test_the_stated_stds_are_those_of_the_combination(both: tuple[Floats, Floats, Floats]) -> None:
    weighed, _, stated = both
    assert 0.6 < np.sqrt((weighed**2).mean() / (stated**2).mean()) < 1.6


def test_hardly_known_references_change_nothing_that_was_seen() -> None:
    session = weak(11)
    loose = calibrate(surveyed(session, 1, _STD, told=1e3).rig, session.observations())
    plain = calibrate(session.rig, session.observations())
    # The strength of the motion prior is told once more by the path, which moves a little less than its std.
    apart = [
        [np.linalg.norm(one[a].pose.position - one[b].pose.position) for a, b in (("cam0", "cam1"), ("cam0", "cam2"))]
        for one in (loose.cameras, plain.cameras)
    ]
    assert apart[0][1] / apart[0][0] == pytest.approx(apart[1][1] / apart[1][0], rel=5e-4)


def test_a_camera_bumped_since_the_survey_is_told_and_does_not_bend_the_others() -> None:
    session = surveyed(rigs.simulate(21, 4, 10.0), 2, _STD)
    bumped = replace(session.rig.cameras["cam2"], position=session.poses["cam2"].position + [0.0, 0.3, 0.0])
    rig = replace(session.rig, cameras=session.rig.cameras | {"cam2": bumped})
    found = calibrate(rig, session.observations())
    assert [told for told in found.warnings if "cam2 was set aside" in told]
    assert not found.refused
    assert errors(session, found).max() < 4.0 * _STD


def test_errors_that_last_leave_references_what_they_are() -> None:
    """Generalised least squares weighs them too: cameras surveyed to 2 mm stay there, others go where errors lead."""
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
    sure = surveyed(session, 7, std, told=std)
    untold = {name: replace(camera, position_std=None) for name, camera in sure.rig.cameras.items()}
    found = calibrate(sure.rig, session.observations())
    loose = calibrate(replace(sure.rig, cameras=untold), session.observations())
    assert any(step.stage == "lasting errors" for step in found.convergence)
    rms = [float(np.sqrt(np.mean(errors(session, one) ** 2))) for one in (found, loose)]
    assert rms[0] < 1.5 * np.sqrt(3.0) * std
    assert rms[1] > 2.0 * rms[0]
