"""Each kind of refusal, brought about: a session in which it is what must be told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hub.calibration import initialisation
from hub.calibration import pipeline as calibrating
from hub.calibration.pipeline import calibrate
from hub.sync.alignment import PairSettings
from hub.sync.pair_solver import _Search, solve_pair
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from hub.trajectory.triangulation import triangulate
from protocols.core.errors import Refused
from tests import rigs
from tests.unit.test_refusals import TOLD, VERDICTS

Scene = Callable[[pytest.MonkeyPatch], str]
SECONDS = 12.0
TWO_ALIKE = "two alignments are about as good"


def told_of(session: rigs.Session, solver: str = "joint") -> str:
    """All that is told of a session: why it was refused, or which of its cameras were, and each pair."""
    try:
        found = calibrate(session.rig, session.observations(), solver=solver)
    except Refused as refusal:
        pairs = [pair.status for pair in refusal.pairs]
        return "\n".join([refusal.reason, *refusal.cameras.values(), *pairs])
    return "\n".join([*found.refused.values(), *(pair.status for pair in found.pairs)])


def keeping(session: rigs.Session, keep: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> rigs.Session:
    at = np.flatnonzero(keep)
    return replace(
        session,
        camera=[session.camera[i] for i in at],
        label=[session.label[i] for i in at],
        frame=session.frame[at],
        time=session.time[at],
        pixels=session.pixels[at],
    )


def of(session: rigs.Session, camera: str) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    return np.array([name == camera for name in session.camera])


def tracks(session: rigs.Session) -> tuple[dict[str, SmoothTrack], dict[str, SmoothTrack]]:
    out = []
    for name in ("cam0", "cam1"):
        lens, (track,) = session.rig.cameras[name].intrinsics, session.observations().of_camera(name)
        assert lens is not None
        found = smooth_track(track.time, lens.unproject(track.pixels), lens.focal, float(track.time[0]))
        assert found is not None
        out.append({"marker": found})
    return out[0], out[1]


def pair_told(settings: PairSettings) -> str:
    return solve_pair(*tracks(rigs.simulate(1, 2, SECONDS, late=0.5)), ("cam0", "cam1"), settings).status


def still(_: pytest.MonkeyPatch) -> str:
    path = rigs.Path(np.full((1, 3), 0.1), np.zeros((1, 3)), np.zeros((1, 3)))
    return told_of(rigs.simulate(1, 2, SECONDS, path=path))


def other_labels(_: pytest.MonkeyPatch) -> str:
    return told_of(rigs.simulate(1, 2, SECONDS, labels={"ball": [0], "bat": [1]}))


def hardly_a_row(_: pytest.MonkeyPatch) -> str:
    a, b = tracks(rigs.simulate(1, 2, 2.2, fps=(5.0, 5.0), drops=0.0, late=0.0))
    return solve_pair(a, b, ("cam0", "cam1")).status


def vague_lag(_: pytest.MonkeyPatch) -> str:
    return pair_told(PairSettings(largest_lag_std=1e-9, largest_slow_lag_std=1e-9))


def vague_rotation(_: pytest.MonkeyPatch) -> str:
    return pair_told(PairSettings(largest_turn_std=1e-9, sure_turn_std=1e-9))


def from_many_places(_: pytest.MonkeyPatch) -> str:
    return pair_told(PairSettings(largest_turn_apart=-1.0))


def vague_orientation(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "_LARGEST_TURN_STD", 1e-9)
    return told_of(rigs.simulate(1, 2, SECONDS, late=0.5))


def vague_clock(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "_LARGEST_CLOCK_STD", 1e-9)
    return told_of(rigs.simulate(1, 2, SECONDS, late=0.5))


def two_clocks(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "_FARTHEST_FROM_PAIR", 1e-9)
    told = told_of(rigs.simulate(1, 2, SECONDS, late=0.5))
    assert told.splitlines()[-1].startswith("the path tells its clock")  # nor is the pair's lag told
    return told


def vague_lens(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "LARGEST_STD", -1.0)
    return told_of(rigs.simulate(1, 2, SECONDS, late=0.5))


def torn(_: pytest.MonkeyPatch) -> str:
    a, b = tracks(rigs.simulate(1, 2, 2.0, late=0.0))
    search = _Search(list(a.values()), list(b.values()), PairSettings(), None, True)
    return search.in_pieces(("cam0", "cam1")).status


def another_path(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(calibrating, "_LEAST_AGREEMENT", 1.01)
    return told_of(rigs.simulate(1, 2, SECONDS, late=0.5))


def no_position(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(initialisation, "_resect", lambda *_: None)
    patch.setattr(initialisation, "_intersect_bearings", lambda *_: None)
    return told_of(rigs.simulate(1, 3, SECONDS, late=0.5))


def a_scrap(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 3, SECONDS, late=0.5)
    mine = of(session, "cam2")
    return told_of(keeping(session, ~mine | (np.cumsum(mine) <= 3)))


def a_stranger(_: pytest.MonkeyPatch) -> str:
    return told_of(rigs.simulate(1, 3, SECONDS, late=0.5, strangers=[2]))


def two_groups(_: pytest.MonkeyPatch) -> str:
    return told_of(rigs.simulate(1, 4, SECONDS, late=0.5, labels={"ball": [0, 1], "bat": [2, 3]}))


def no_lens(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS, late=0.5)
    blind = replace(session.rig.cameras["cam1"], intrinsics=None)
    return told_of(replace(session, rig=replace(session.rig, cameras=session.rig.cameras | {"cam1": blind})))


def unseen(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 3, SECONDS, late=0.5)
    return told_of(keeping(session, ~of(session, "cam2")))


def alone(_: pytest.MonkeyPatch) -> str:
    return told_of(rigs.simulate(1, 1, SECONDS))


def two_less_one(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS, late=0.5)
    return told_of(keeping(session, of(session, "cam0")))


def never_at_once(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS)  # epochs years apart
    return told_of(replace(session, rig=replace(session.rig, clock="shared")))


def wrong_survey(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 3, SECONDS, late=0.5)
    off = {"cam0": 0.0, "cam1": 0.0, "cam2": 4.0}
    cameras = {
        name: replace(camera, position=session.poses[name].position + off[name])
        for name, camera in session.rig.cameras.items()
    }
    return told_of(replace(session, rig=replace(session.rig, cameras=cameras)))


def moved_since(_: pytest.MonkeyPatch) -> str:
    session = rigs.simulate(1, 2, SECONDS, late=0.5)
    found = calibrate(session.rig, session.observations())
    late = replace(
        found.cameras["cam1"],
        time_map=replace(found.cameras["cam1"].time_map, time_offset=found.cameras["cam1"].time_map.time_offset + 1.5),
    )
    with pytest.raises(Refused) as refusal:
        triangulate(session.rig, found.cameras | {"cam1": late}, session.observations())
    return refusal.value.reason


def paper_at_other_rates(_: pytest.MonkeyPatch) -> str:
    return told_of(rigs.simulate(1, 2, SECONDS, fps=(30.0, 50.0)), solver="paper")


KINDS: dict[str, Scene] = {
    "hardly moves while both could have seen it": still,
    "no label that both cameras saw": other_labels,
    "no alignment of the two tracks agrees with any geometry": hardly_a_row,
    "the motion tells the lag only to": vague_lag,
    "the motion tells the relative rotation only to": vague_rotation,
    "apart fit the motion alike": from_many_places,
    "tells its orientation only to": vague_orientation,
    "tells its clock only to": vague_clock,
    "apart from what epipolar lines tell": two_clocks,
    "tells its focal length only to": vague_lens,
    "the tracks jump": torn,
    "fit the path that the others see": another_path,
    "agrees with no position": no_position,
    "too few connected observations": a_scrap,
    "could not be tied to any camera": a_stranger,
    "tied only to": two_groups,
    "no intrinsics": no_lens,
    "no observations": unseen,
    "one camera only": alone,
    "fewer than two cameras": two_less_one,
    "rows of the same time and label": never_at_once,
    "contradict each other": wrong_survey,
    "contradict the calibration": moved_since,
    "frame rates differ": paper_at_other_rates,
}


@pytest.mark.parametrize("told", KINDS)
def test_what_is_wrong_is_what_is_told(told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert told in KINDS[told](monkeypatch)


def test_every_kind_of_refusal_is_brought_about() -> None:
    """Those that are no scene here are verdicts, of which each has its test beside the table."""
    assert not [told for told in TOLD if not any(told in kind for kind in (*KINDS, *VERDICTS, TWO_ALIKE))]
