"""Labels that one camera exchanges for a time: put right where others tell, left out where two cameras differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hub import calibrate, triangulate
from protocols.session.calibration import TrajectoryTable
from tests.support.rigs import Session, simulate

LABELS = ("left", "nose", "right")
OTHER = {"left": "right", "right": "left"}


def simulated(seed: int, cameras: int = 3, fisheye: tuple[int, ...] = (), outliers: float = 0.02) -> Session:
    """Three points in a session."""
    labels = dict.fromkeys(LABELS, range(cameras))
    return simulate(seed, cameras, 30, labels=labels, fisheye=fisheye, outliers=outliers)


def exchanged(session: Session, camera: str, begin: float, end: float) -> Session:
    """The session with left and right exchanged in a camera between two true times."""
    wrong = session.of_camera(camera) & (session.true >= begin) & (session.true < end)
    labels = [OTHER.get(label, label) if bad else label for label, bad in zip(session.label, wrong, strict=True)]
    return replace(session, label=labels)


def largest_difference(a: tuple[TrajectoryTable, ...], b: tuple[TrajectoryTable, ...]) -> float:
    """The largest distance of two results' paths, over the length of the paths' range."""
    found = {table.label: table for table in b}
    return max(
        float(
            np.abs(
                np.interp(found[one.label].time, one.time, one.position[:, i]) - found[one.label].position[:, i]
            ).max()
        )
        / float(np.ptp(one.position, axis=0).max())
        for one in a
        for i in range(3)
    )


@pytest.mark.parametrize(
    ("seed", "cameras", "fisheye", "begin", "end"),
    [(1, 3, (), 10.0, 15.0), (2, 4, (1,), 0.0, 6.0), (3, 3, (), 6.0, 8.0)],
)
def test_exchanged_labels_are_put_right_and_named(
    tmp_path: Path, seed: int, cameras: int, fisheye: tuple[int, ...], begin: float, end: float
) -> None:
    session = simulated(seed, cameras, fisheye)
    right = calibrate(session.write(tmp_path / "right"))
    assert not [text for text in right.calibration.warnings if "exchanged" in text]
    wrong = exchanged(session, "cam1", begin, end).write(tmp_path / "wrong")
    found = calibrate(wrong)
    (warning,) = [text for text in found.calibration.warnings if "exchanged" in text]
    assert warning.startswith("cam1: left and right are exchanged in ")
    assert largest_difference(right.calibration.trajectories, found.calibration.trajectories) < 0.03
    again = triangulate(wrong, right)
    (warning,) = [text for text in again.warnings if "exchanged" in text]
    assert warning.startswith("cam1: left and right are exchanged in ")
    assert largest_difference(right.calibration.trajectories, again.tables) < 0.03


def test_of_two_cameras_the_rows_that_contradict_one_another_are_left_out(tmp_path: Path) -> None:
    session = simulated(4, 2)
    right = calibrate(session.write(tmp_path / "right"))
    found = calibrate(exchanged(session, "cam1", 10.0, 20.0).write(tmp_path / "wrong"))
    (warning,) = [text for text in found.calibration.warnings if "exchanged" in text]
    assert warning.startswith(("cam0 or cam1: left and right", "cam1 or cam0: left and right"))
    assert largest_difference(right.calibration.trajectories, found.calibration.trajectories) < 0.03


def test_false_detections_and_a_moved_camera_are_no_exchange(tmp_path: Path) -> None:
    still = simulated(6, 4)
    later = still.of_camera("cam2") & (still.true > 10.0)
    sessions = simulated(5, 4, outliers=0.2), replace(still, pixels=still.pixels + 80.0 * later[:, None])
    for number, session in enumerate(sessions):
        found = calibrate(session.write(tmp_path / str(number)))
        assert not [text for text in found.calibration.warnings if "exchanged" in text]
