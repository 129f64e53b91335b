"""One scenario for each kind of refusal: a session in which that reason must be reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hub.bundle import initialisation
from hub.calibration import acceptance as calibrating
from hub.calibration.pairs.pair_network import describe_failures
from hub.calibration.pipeline import calibrate
from hub.calibration.solvers import _no_pair_reason
from hub.calibration.triangulation import triangulate
from hub.sync.hypothesis import PairSolution
from hub.sync.pair_solver import _PairSearch, solve_pair
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.session.calibration import FixedCalibration
from tests.support import rigs
from tests.unit.hub.sync.test_acceptance import REFUSAL_KINDS, REJECTED

Scenario = Callable[[pytest.MonkeyPatch], str]
SECONDS = 12.0
TWO_ALIKE = "two alignments are about as good"


def refusal_texts(session: rigs.Session, solver: str = "joint") -> str:
    """All refusal texts of a session: of the session or of its cameras, and the status of each pair."""
    try:
        found = calibrate(session.rig, session.observations(), solver=solver)
    except Refused as refusal:
        pairs = [pair.status for pair in refusal.pairs]
        return "\n".join([refusal.reason, *refusal.cameras.values(), *pairs])
    return "\n".join([*found.refused.values(), *(pair.status for pair in found.pairs)])


def tracks(session: rigs.Session) -> list[dict[str, SmoothTrack]]:
    return [session.smoothed(name) for name in ("cam0", "cam1")]


def pair_status(settings: PairSettings) -> str:
    return solve_pair(*tracks(rigs.simulate(1, 2, SECONDS, late=0.5)), ("cam0", "cam1"), settings).status


def still_marker(_: pytest.MonkeyPatch) -> str:
    path = rigs.Path(np.full((1, 3), 0.1), np.zeros((1, 3)), np.zeros((1, 3)))
    return refusal_texts(rigs.simulate(1, 2, SECONDS, path=path))


def different_labels(_: pytest.MonkeyPatch) -> str:
    return refusal_texts(rigs.simulate(1, 2, SECONDS, labels={"ball": [0], "bat": [1]}))


def too_few_rows(_: pytest.MonkeyPatch) -> str:
    a, b = tracks(rigs.simulate(1, 2, 2.2, fps=(5.0, 5.0), drops=0.0, late=0.0))
    return solve_pair(a, b, ("cam0", "cam1")).status


def imprecise_lag(_: pytest.MonkeyPatch) -> str:
    return pair_status(PairSettings(max_lag_std=1e-9, max_slow_lag_std=1e-9))


def imprecise_rotation(_: pytest.MonkeyPatch) -> str:
    return pair_status(PairSettings(max_rotation_std=1e-9, max_rotation_std_certain_lag=1e-9))


def ambiguous_rotation(_: pytest.MonkeyPatch) -> str:
    return pair_status(PairSettings(max_rotation_ambiguity=-1.0))


def imprecise_orientation(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "MAX_ROTATION_STD", 1e-9)
    return refusal_texts(rigs.simulate(1, 2, SECONDS, late=0.5))


def imprecise_clock(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "_MAX_CLOCK_STD", 1e-9)
    return refusal_texts(rigs.simulate(1, 2, SECONDS, late=0.5))


def conflicting_lags(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "_MAX_LAG_CHANGE", 1e-9)
    texts = refusal_texts(rigs.simulate(1, 2, SECONDS, late=0.5))
    assert texts.splitlines()[-1].startswith("the trajectory puts its clock")  # nor is the pair's lag reported
    return texts


def imprecise_focal_length(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "MAX_FOCAL_STD", -1.0)
    return refusal_texts(rigs.simulate(1, 2, SECONDS, late=0.5))


def discontinuous_tracks(_: pytest.MonkeyPatch) -> str:
    a, b = tracks(rigs.simulate(1, 2, 2.0, late=0.0))
    search = _PairSearch(list(a.values()), list(b.values()), PairSettings(), None, True)
    return search.search_lts(("cam0", "cam1")).status


def inconsistent_camera(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "_MIN_INLIER_SHARE", 1.01)
    return refusal_texts(rigs.simulate(1, 2, SECONDS, late=0.5))


def no_position(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(initialisation, "_resect", lambda *_: None)
    patch.setattr(initialisation, "_intersect_bearings", lambda *_: None)
    return refusal_texts(rigs.simulate(1, 3, SECONDS, late=0.5))


def too_short_track(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 3, SECONDS, late=0.5)
    mine = session.of_camera("cam2")
    return refusal_texts(session.where(~mine | (np.cumsum(mine) <= 3)))


def unrelated_camera(_: pytest.MonkeyPatch) -> str:
    return refusal_texts(rigs.simulate(1, 3, SECONDS, late=0.5, unrelated=[2]))


def disconnected_groups(_: pytest.MonkeyPatch) -> str:
    return refusal_texts(rigs.simulate(1, 4, SECONDS, late=0.5, labels={"ball": [0, 1], "bat": [2, 3]}))


def missing_intrinsics(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS, late=0.5)
    blind = replace(session.rig.cameras["cam1"], intrinsics=None)
    return refusal_texts(replace(session, rig=replace(session.rig, cameras=session.rig.cameras | {"cam1": blind})))


def no_observations(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 3, SECONDS, late=0.5)
    return refusal_texts(session.where(~session.of_camera("cam2")))


def single_camera(_: pytest.MonkeyPatch) -> str:
    return refusal_texts(rigs.simulate(1, 1, SECONDS))


def only_one_with_observations(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS, late=0.5)
    return refusal_texts(session.where(session.of_camera("cam0")))


def no_common_instants(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS)  # epochs years apart
    return refusal_texts(replace(session, rig=replace(session.rig, clock="shared")))


def contradicting_control_points(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 3, SECONDS, late=0.5)
    off = {"cam0": 0.0, "cam1": 0.0, "cam2": 4.0}
    cameras = {
        name: replace(camera, position=session.poses[name].position + off[name])
        for name, camera in session.rig.cameras.items()
    }
    return refusal_texts(replace(session, rig=replace(session.rig, cameras=cameras)))


def moved_camera(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS, late=0.5)
    found = calibrate(session.rig, session.observations())
    late = replace(
        found.cameras["cam1"],
        time_map=replace(found.cameras["cam1"].time_map, time_offset=found.cameras["cam1"].time_map.time_offset + 1.5),
    )
    with pytest.raises(Refused) as refusal:
        triangulate(session.rig, found.cameras | {"cam1": late}, session.observations())
    return refusal.value.reason


def paper_with_different_rates(_: pytest.MonkeyPatch) -> str:
    return refusal_texts(rigs.simulate(1, 2, SECONDS, fps=(30.0, 50.0)), solver="paper")


KINDS: dict[str, Scenario] = {
    "hardly moves while both could have seen it": still_marker,
    "no label that both cameras saw": different_labels,
    "no alignment of the two tracks agrees with any geometry": too_few_rows,
    "the motion determines the lag only to": imprecise_lag,
    "the motion determines the relative rotation only to": imprecise_rotation,
    "apart fit the motion equally well": ambiguous_rotation,
    "determines its orientation only to": imprecise_orientation,
    "determines its clock only to": imprecise_clock,
    "from the lag of the epipolar geometry": conflicting_lags,
    "determines its focal length only to": imprecise_focal_length,
    "the tracks are discontinuous": discontinuous_tracks,
    "fit the trajectory seen by the other cameras": inconsistent_camera,
    "agrees with no position": no_position,
    "too few connected observations": too_short_track,
    "could not be connected to any camera": unrelated_camera,
    "connected only to": disconnected_groups,
    "no intrinsics": missing_intrinsics,
    "no observations": no_observations,
    "one camera only": single_camera,
    "fewer than two cameras": only_one_with_observations,
    "rows of the same time and label": no_common_instants,
    "contradict each other": contradicting_control_points,
    "contradict the calibration": moved_camera,
    "frame rates differ": paper_with_different_rates,
}


@pytest.mark.parametrize("reason", KINDS)
def test_the_reason_of_a_refusal_is_reported(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert reason in KINDS[reason](monkeypatch)


def test_every_kind_of_refusal_has_a_scenario() -> None:
    """Those without a scenario here are rejections of an alignment, which are tested beside the table."""
    assert not [
        reason for reason in REFUSAL_KINDS if not any(reason in kind for kind in (*KINDS, *REJECTED, TWO_ALIKE))
    ]


def test_a_camera_that_was_turned_since_is_left_out_of_a_known_calibration() -> None:
    """A pair of it was solved, and it was placed with residuals of 37 px."""
    session = rigs.simulate(4, 4, 20.0, late=0.5)
    cameras = dict(calibrate(session.rig, session.observations()).cameras)
    pose = cameras["cam2"].pose
    turned = replace(cameras["cam2"], pose=replace(pose, rotation=so3.exp(np.array([0.0, 0.03, 0.0])) @ pose.rotation))
    cameras["cam2"] = turned
    found = calibrate(session.rig, session.observations(), known=FixedCalibration(cameras, "arbitrary"))
    assert set(found.cameras) == {"cam0", "cam1", "cam3"}
    assert "fit the trajectory seen by the other cameras" in found.refused["cam2"]
    assert list(triangulate(session.rig, cameras, session.observations()).unused) == ["cam2"]


def test_of_three_cameras_one_lens_or_their_geometry_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    session = rigs.simulate(3, 3, 15.0, late=0.5)
    camera = session.rig.cameras["cam2"]
    assert camera.intrinsics is not None
    matrix = camera.intrinsics.matrix.copy()
    matrix[:2, :2] *= 0.5
    wide = replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))
    rig = replace(session.rig, cameras=session.rig.cameras | {"cam2": wide})
    assert "cam2" in calibrate(rig, session.observations()).cameras
    monkeypatch.setattr(calibrating, "_WRONG_GEOMETRY", 0.2)
    texts = refusal_texts(replace(session, rig=rig))
    assert "its measured lens is refuted" in texts
    assert "their geometry may be what is wrong" in texts


def test_through_narrow_lenses_the_adjustment_goes_on_until_it_has_converged() -> None:
    """It ended 8° off, where each short step along a flat valley gained little."""
    path = rigs.random_path(np.random.default_rng(1), extent=0.25)
    session = rigs.simulate(1, 3, 15.0, noise=1.0, late=0.5, path=path)
    found = calibrate(session.rig, session.observations())
    assert session.turn_error({name: camera.pose for name, camera in found.cameras.items()}) < np.deg2rad(4.0)


def test_where_pairs_were_solved_their_cameras_reasons_are_given() -> None:
    prepared: Any = SimpleNamespace(camera_order=("cam0", "cam1"), uncalibrated=())
    pairs: list[Any] = [SimpleNamespace(a="cam0", b="cam1", solved=True, status="ok")]
    reason = _no_pair_reason(prepared, pairs, {"cam1": "8 % of its rows fit"})
    assert reason == "no two cameras are left whose views fit together (cam1: 8 % of its rows fit)"


def test_a_reason_that_many_pairs_share_is_given_once() -> None:
    pairs = [PairSolution(*names, status) for *names, status in (("a", "b", "x"), ("c", "a", "y"), ("a", "d", "x"))]
    assert describe_failures("a", pairs) == "with b, d: x; with c: y"
