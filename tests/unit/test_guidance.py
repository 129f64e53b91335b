"""Which camera lacks the marker, and where in its picture."""

from __future__ import annotations

import numpy as np
import pytest

from hub.calibration.coverage import ENOUGH, LEAST_ROWS, Guidance, advice_for, lacking, parts_without
from hub.report.measures import COLUMNS, ROWS
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import gather_tracks
from protocols.session.rig import Rig, RigCamera
from tests.samples import camera_info, observation


def seen(camera: str, u: float, v: float, sequence: int = 0) -> pb.Observation:
    message = observation(camera, sequence)
    message.detections[0].u, message.detections[0].v = u, v
    return message


def whole() -> np.ndarray:
    return np.ones((ROWS, COLUMNS), dtype=bool)


def test_a_marker_that_stays_at_the_left_is_wanted_at_the_right() -> None:
    guidance = Guidance()
    guidance.handle(camera_info("cam0"))
    for index in range(200):
        guidance.handle(seen("cam0", 20.0 + index % 60, 480 * (index / 200), index))
    (advice,) = guidance.advice()
    assert advice.kind == "narrow"
    assert advice.where[0] == "right"
    assert f"{100 * guidance.coverage('cam0'):.0f} % of its view" in advice.text
    assert "right" in advice.text


def test_every_corner_of_the_picture_is_a_part_of_it() -> None:
    guidance = Guidance()
    guidance.handle(camera_info("cam0"))
    for u, v in ((-0.5, -0.5), (639.5, -0.5), (-0.5, 479.5), (639.5, 479.5), (5000.0, -90.0)):
        guidance.handle(seen("cam0", u, v))
    covered = guidance.covered("cam0")
    assert covered[0, 0]
    assert covered[0, -1]
    assert covered[-1, 0]
    assert covered[-1, -1]
    assert covered.sum() == 4


def test_the_worst_come_first_and_two_are_enough() -> None:
    guidance = Guidance()
    for name in ("cam0", "cam1", "cam2", "cam3"):
        guidance.handle(camera_info(name))
    for index in range(200):
        guidance.handle(seen("cam0", 100.0, 100.0, index))
        guidance.handle(pb.Observation(schema_version=1, camera="cam1", boot_id="b", sequence=index))
    kinds = [(advice.camera, advice.kind) for advice in guidance.advice(9)]
    assert kinds == [("cam2", "silent"), ("cam3", "silent"), ("cam1", "unseen"), ("cam0", "narrow")]
    assert len(guidance.advice()) == 2


def test_a_picture_that_was_filled_wants_nothing() -> None:
    assert lacking("cam0", 500, 500, whole()) is None
    few = lacking("cam0", 500, LEAST_ROWS - 1, whole())
    assert few is not None
    assert few.kind == "few"
    half = whole()
    half[:, round(COLUMNS * ENOUGH) - 1 :] = False
    narrow = lacking("cam0", 500, 500, half)
    assert narrow is not None
    assert narrow.where[0] == "right"


@pytest.mark.parametrize(
    ("rows", "columns", "where"),
    [
        (slice(None), slice(0, 4), ("right",)),
        (slice(0, 2), slice(None), ("bottom",)),
        (slice(2, None), slice(None), ("top",)),
        (slice(2, None), slice(3, None), ("left", "top")),
    ],
)
def test_sides_are_named(rows: slice, columns: slice, where: tuple[str, ...]) -> None:
    covered = np.zeros((ROWS, COLUMNS), dtype=bool)
    covered[rows, columns] = True
    assert parts_without(covered) == where


def test_beginning_anew_forgets_what_was_seen_but_not_the_cameras() -> None:
    guidance = Guidance()
    guidance.handle(camera_info("cam0"))
    guidance.handle(seen("cam0", 10.0, 10.0))
    guidance.start_anew()
    assert guidance.coverage("cam0") == 0.0
    assert [advice.kind for advice in guidance.advice()] == ["silent"]


def test_a_recorded_session_gets_the_same_advice() -> None:
    rig = Rig({name: RigCamera(name, (640, 480), 30.0) for name in ("cam0", "cam1")})
    time = np.arange(200) / 30
    pixels = np.column_stack([np.full(200, 40.0), np.linspace(0, 479, 200)])
    tracks = gather_tracks(
        ["cam0"] * 200, ["marker"] * 200, np.arange(200), time, pixels, np.full(200, np.nan), order=["cam0", "cam1"]
    )
    unseen, narrow = advice_for(rig, tracks)
    assert (unseen.camera, unseen.kind) == ("cam1", "unseen")
    assert (narrow.camera, narrow.where[0]) == ("cam0", "right")
    assert [advice.camera for advice in advice_for(rig, tracks, {"cam0": "refused"})] == ["cam0"]
