"""Sessions made in memory: columns become tracks, and a bad column gives one clear error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hub.api import CalibrationOptions, calibrate, triangulate
from protocols.core.errors import InputError, Refused
from protocols.geometry.types import Floats
from protocols.session.session import Session

RIG = {name: {"size": np.array([640, 480]), "fps": 30.0} for name in ("GoPro 2", "CVLab1")}


def columns(**changes: Any) -> dict[str, Any]:
    table: dict[str, Any] = {
        "camera": ["CVLab1", "GoPro 2", "CVLab1", "CVLab1"],
        "time": [0.2, 0.1, 0.1, 0.3],
        "u": [12.0, 5.0, 11.0, 13.0],
        "v": [1.0, 2.0, 3.0, 4.0],
    }
    return {key: value for key, value in (table | changes).items() if value is not None}


def test_rows_in_any_order_become_tracks_in_order_of_time_with_consecutive_frames() -> None:
    session = Session.from_table(RIG, columns())
    assert list(session.rig.cameras) == ["GoPro 2", "CVLab1"]
    track = session.observations.by_label("CVLab1")["marker"]
    np.testing.assert_array_equal(track.time, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(track.frame, [0, 1, 2])
    np.testing.assert_array_equal(track.pixels[:, 0], [11.0, 12.0, 13.0])


def test_the_dataframe_of_a_session_makes_the_same_session() -> None:
    pytest.importorskip("pandas")
    session = Session.from_table(RIG, columns(size=[1.0, np.nan, 2.0, 3.0], label=["a", "b", "a", "a"]))
    again = Session.from_table(session.rig, session.to_dataframe())
    assert again.observations.tracks.keys() == session.observations.tracks.keys()
    for key, track in session.observations.tracks.items():
        np.testing.assert_array_equal(again.observations.tracks[key].pixels, track.pixels)
        np.testing.assert_array_equal(again.observations.tracks[key].size, track.size)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"u": None}, "column u is missing"),
        ({"v": [1.0, 2.0]}, "column v is not as long"),
        ({"time": [0.1, np.nan, 0.2, 0.3]}, "time is not finite"),
        ({"u": ["left", 1, 2, 3]}, "column u holds something that is not a number"),
        ({"frame": [1, 2, 3, np.inf]}, "frame is not finite"),
        ({"camera": ["cam9", "CVLab1", "CVLab1", "CVLab1"]}, "camera 'cam9' is not in the rig"),
        ({"time": [0.1, 0.1, 0.1, 0.3]}, "two rows of camera CVLab1 at time"),
    ],
)
def test_a_bad_column_is_named(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Session.from_table(RIG, columns(**changes))


def test_a_bad_name_or_size_in_the_rig_is_named() -> None:
    with pytest.raises(InputError, match="not usable"):
        Session.from_table({"../evil": {"size": [640, 480]}}, columns())
    with pytest.raises(InputError, match="size is missing"):
        Session.from_table({"CVLab1": {"fps": 30.0}}, columns())


def test_a_rig_that_is_no_dict_of_cameras_is_named_and_cameras_may_be_numbers() -> None:
    for rig in ([*RIG], {"CVLab1": np.eye(3)}):
        with pytest.raises(InputError, match="not a dict with a dict for each camera"):
            Session.from_table(rig, columns())  # type: ignore[arg-type]
    numbered: dict[Any, Any] = {0: {"size": [640, 480]}, 1: {"size": [640, 480], "distortion": [0.1, 0, 0, 0, 0]}}
    session = Session.from_table(numbered, columns(camera=[0, 1, 0, 0]))
    assert list(session.rig.cameras) == ["0", "1"]
    assert [one for one in session.warnings if "did you mean distortions?" in one]


def test_a_solver_that_does_not_exist_is_named() -> None:
    """It was solved by "joint", and the result said otherwise."""
    with pytest.raises(InputError, match="there is no solver 'Distributed'; use one of joint, distributed, paper"):
        calibrate(Session.from_table(RIG, columns()), CalibrationOptions("Distributed"))  # type: ignore[arg-type]


def test_too_little_is_refused_and_a_session_has_its_own_observations() -> None:
    session = Session.from_table(RIG, columns())
    with pytest.raises(Refused):
        calibrate(session)
    with pytest.raises(InputError, match="its own observations"):
        triangulate(session, "no.toml", observations="other.csv")


def test_times_that_are_frame_numbers_are_named() -> None:
    names, frames = ["CVLab1"] * 12 + ["CVLab2"] * 12, np.tile(np.arange(12), 2)
    times = np.r_[np.arange(12.0), np.arange(12) / 25.0]
    table = {"camera": names, "frame": frames, "time": times, "u": np.full(24, 9.0), "v": np.full(24, 9.0)}
    rig = {name: {"size": [640, 480], "fps": 25.0} for name in ("CVLab1", "CVLab2")}
    [warning] = Session.from_table(rig, table).warnings
    assert warning.startswith("CVLab1: all its times are whole numbers")


@pytest.mark.parametrize(("unit", "factor"), [("milliseconds", 1e3), ("nanoseconds", 1e9)])
def test_times_in_another_unit_are_named(unit: str, factor: float) -> None:
    """The solver took two minutes for "no alignment of the two tracks agrees with any geometry"."""
    rig = {name: {"size": [640, 480], "fps": 30.0} for name in ("a", "b")}

    def session(times: Floats) -> Session:
        count = len(times)
        table = {"camera": ["a"] * count + ["b"] * count, "frame": np.tile(np.arange(count), 2)}
        table |= {"u": np.full(2 * count, 9.0), "v": np.full(2 * count, 9.0)}
        return Session.from_table(rig, table | {"time": np.r_[np.arange(count) / 30.0, times]})

    session(1000.0 / 30.0 * np.arange(20))  # labelled by hand: every thousandth frame
    with pytest.raises(InputError, match=f"b: its times are {unit}: .* divide them by "):
        session(factor / 30.0 * np.arange(120))
